"""The accepted steps over t: size, order, estimated errors and corrections."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import Array
from ..._base.style import COLOURS
from ..records import Steps
from ..result import Result
from .canvas import joined, legend, log_axis, new_panels, positive, properties, unused

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: The axis of errors and corrections goes no lower, in units of rtol: those of the first steps can be roundoff.
_NEGLIGIBLE = 1e-6

#: Heights of the panels: size, order, errors.
_HEIGHTS = (3, 1.3, 2)


def draw(sol: Result, axes: Any, line: dict[str, Any]) -> Array:
    """See `Solution.plot_steps`."""
    if sol.steps is None:
        raise ValueError('the run did not keep its steps: solve with keep="all"')
    own = axes is None
    panels = new_panels(sol._names.title, _HEIGHTS) if own else np.ravel(np.asarray(axes, dtype=object))
    if not 1 <= len(panels) <= 3:
        raise ValueError(f"plot_steps draws on one to three axes, got {len(panels)}")
    line, given = properties(line)
    taken = {one.get_color() for panel in panels for one in panel.lines}
    colour = next((one for one in COLOURS if one not in taken), unused(panels[0])[0])
    paint = {"color": colour, "linewidth": 1.2, "drawstyle": "steps-pre", "label": given, **line}
    draw_sizes(panels[0], sol.steps, paint)
    if len(panels) > 1:
        draw_orders(panels[1], sol.steps, paint)
    if len(panels) > 2:
        draw_errors(panels[2], sol.steps, paint["color"], given)
    shade_turns(panels, sol.steps)
    for panel in panels:
        place = panel.get_subplotspec()
        if place is None or place.is_last_row():
            panel.set_xlabel("$t$")
        if own:
            panel.label_outer()
    return panels


def over_steps(steps: Steps, values: Array) -> tuple[Array, Array]:
    """Return t and values of a curve that is constant over each step."""
    return np.concatenate([steps.t[:1] - steps.h[:1], steps.t]), np.concatenate([values[:1], values])


def shade_turns(panels: Array, steps: Steps) -> None:
    """Shade the steps of the second of two methods that take turns, and write its name there."""
    methods = steps.method
    if not len(methods) or (methods == methods[0]).all():
        return
    first = methods[0]
    second = next(one for one in methods if one != first)
    ends = np.flatnonzero(methods[1:] != methods[:-1]) + 1
    bounds = np.concatenate([[0], ends, [len(methods)]])
    starts = np.concatenate([steps.t[:1] - steps.h[:1], steps.t])
    turns = [(a, b) for a, b in pairwise(bounds.tolist()) if methods[a] == second]
    for panel in panels:
        for k, (a, b) in enumerate(turns):
            label = {"label": str(second)} if k == 0 and panel is panels[0] else {}
            panel.axvspan(starts[a], starts[b], color="0.9", zorder=0, **label)
    legend(panels[0])


def draw_sizes(ax: Axes, steps: Steps, paint: dict[str, Any]) -> None:
    ax.plot(*over_steps(steps, np.abs(steps.h)), **paint)
    ax.set(yscale="log", ylabel="step size $|h|$")
    log_axis(ax.yaxis)
    legend(ax)


def draw_orders(ax: Axes, steps: Steps, paint: dict[str, Any]) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.plot(*over_steps(steps, steps.order), **paint)
    ax.set_ylabel("order")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5, min_n_ticks=1))
    if len(steps.t):
        low, high = ax.dataLim.intervaly
        ax.set_ylim(low - 0.5, high + 0.5, auto=None)


def draw_errors(ax: Axes, steps: Steps, colour: Any, given: str | None) -> None:
    """Draw the estimated errors, and the corrections by projection if there were any, in units of rtol."""
    dots: dict[str, Any] = {"ls": "none", "marker": ".", "ms": 4 if len(steps.t) < 500 else 2}
    if not ax.lines:
        ax.axhline(1, color="0.5", lw=0.9, ls="--", zorder=1)
    ax.plot(steps.t, positive(steps.error), color=colour, label=joined("error", given), **dots)
    top = max(steps.error.max(initial=0), steps.correction.max(initial=0))
    lowest = min(_NEGLIGIBLE, top / 100)
    if steps.correction.max(initial=0) > lowest:
        other = next(one for one in COLOURS if one not in [line.get_color() for line in ax.lines])
        ax.plot(steps.t, positive(steps.correction), color=other, label=joined("correction", given), **dots)
        ax.set_ylabel("in units of rtol")
    elif not ax.get_ylabel():
        ax.set_ylabel("error / rtol")
    ax.set_yscale("log")
    ax.set_ylim(bottom=max(ax.get_ylim()[0], lowest), auto=None)
    log_axis(ax.yaxis)
    legend(ax)
