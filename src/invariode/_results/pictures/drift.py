"""The drift of invariants from their values, on a logarithmic axis."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import EPS, Array
from ..._base.style import LEVELS
from ..._laws.bound import BoundInvariants
from ..._problem.invariants import InvariantsLike, to_invariants
from ..result import Result
from .canvas import FEW, MOST, drawable, joined, legend, log_axis, new, once, properties, unused
from .curves import interrupted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: The axis does not follow the residuals of this part of the outputs, the first ones, if they are smaller than all
#: later ones by this factor: the steps at the start are short.
_BEGINNING, _FAR_BELOW = 0.1, 10.0


def draw(sol: Result, ax: Axes | None, invariants: InvariantsLike | None, relative: bool, line: dict[str, Any]) -> Axes:
    """See `Solution.plot_drift`."""
    given_ones = to_invariants(invariants)
    if not given_ones and not len(sol._invariants) and not sol.drift().names:
        raise ValueError("the run had no invariants: give those to draw, plot_drift(invariants=g)")
    if not len(sol.t):
        raise ValueError("the output has no points: t_eval was empty; solve with times in t_eval")
    g = sol._bound(given_ones) if given_ones else sol._invariants
    pieces = g.pieces_of_output(len(sol.t))
    residual = np.abs(g.residual(sol.t, sol.y, pieces) if given_ones else sol.residual)
    largest = np.zeros(len(g)) if given_ones else sol._drift.residual[: len(g)]
    if relative:
        g, residual, largest = _relative(g, residual, largest)
    defining = np.diff(pieces, prepend=-1) > 0  # the outputs at which values are taken: their residuals are rounding
    t = interrupted(sol, sol.t)
    ax = new(sol._names.title) if ax is None else ax
    ax.set_yscale("log")
    line, given = properties(line)
    lows: list[float] = []  # of each curve after the first steps
    for name, style, value, r, before in _drifting(g, residual, largest):
        colour, dashes = unused(ax, style)
        floor = max(EPS / 2 * max(abs(value), before, r.max(initial=0)), r[r > 0].min(initial=np.inf) / 2)
        floor = floor if 0 < floor < np.inf else EPS / 2
        later = np.min(r[~defining & (r > 0)], initial=np.inf)
        left_out = defining & ((r == 0) | ((r < later) & (later < np.inf)))
        drawn = interrupted(sol, np.where(left_out, np.nan, np.maximum(r, floor)))
        after = drawn[math.ceil(_BEGINNING * len(drawn)) :]
        lows.append(float(np.nanmin(after, initial=np.inf)))
        label = joined(drawable(name), given)
        few = {"linewidth": 1.4, "marker": "." if len(sol.t) <= FEW else "none", "markersize": 5}
        paint = {**few, "color": colour, "linestyle": dashes[0], "label": label, **line}
        (curve,) = ax.plot(t, drawn, **paint)
        if before > 0:
            ax.plot(sol.t[[0, -1]], [before, before], ":", color=curve.get_color(), lw=1)
    _begin_where_drift_has_grown(ax, lows)
    _shade_roundoff(ax, EPS * np.abs(g.value).max(initial=0.0))
    if largest.any():
        ax.plot([], [], ":", color="0.5", lw=1, label=once(ax, "largest before\nprojection"))
    log_axis(ax.yaxis)
    ax.set_xlabel("$t$")
    ax.set_ylabel(_label(g, relative))
    left_out = len(g) > MOST and not _has_levels(g)
    legend(ax, f"{MOST} of {len(g)} invariants" if left_out else None, by_height=True)
    return ax


def _begin_where_drift_has_grown(ax: Axes, lows: list[float]) -> None:
    """Let the axis begin below the residuals after the first steps, `lows`, if those of the first steps, which are
    short, would stretch it."""
    low = min(lows, default=np.inf) / 2
    if ax.get_autoscaley_on() and _FAR_BELOW * ax.dataLim.intervaly[0] < low < np.inf:
        ax.set_ylim(bottom=low, auto=None)


def _shade_roundoff(ax: Axes, level: float) -> None:
    """Shade the residuals that values of this size have by rounding alone, if the axis shows any."""
    low = ax.get_ylim()[0]
    if low < level:
        shade = ax.axhspan(low, level, color="0.5", alpha=0.12, lw=0, zorder=0, label=once(ax, "roundoff"))
        shade.sticky_edges.y.append(low)  # as far down as the axis


def _label(g: BoundInvariants, relative: bool) -> str:
    kind = "relative residual" if relative else "residual"
    if len(g) == 1:
        return f"{kind} of {drawable(g.names[0])}"
    return f"{kind} |g − value| / |value|" if relative else "residual |g − value|"


def _relative(g: BoundInvariants, residual: Array, largest: Array) -> tuple[BoundInvariants, Array, Array]:
    """Return the invariants, residuals and largest residuals in units of the invariants' values."""
    if zero := [name for name, value in zip(g.names, g.value, strict=True) if value == 0]:
        raise ValueError(f"{', '.join(zero)} is held at 0, which has no relative drift: leave out relative=True")
    size = np.abs(g.value)
    return replace(g, value=np.sign(g.value)), residual / size[:, None], largest / size


def _has_levels(g: BoundInvariants) -> bool:
    return len({spec.level for spec in g.specs}) > 1


def _drifting(g: BoundInvariants, residual: Array, largest: Array) -> list[tuple[str, str | None, Any, Array, Any]]:
    """Return name, dashes if levels tell them, value, residuals and largest one before projection, for each line."""
    lines = [(name, None, *rest) for name, *rest in zip(g.names, g.value, residual, largest, strict=True)]
    if not _has_levels(g):
        return lines[:MOST]
    levels = np.array([spec.level for spec in g.specs for _ in range(spec.m)])
    groups = [(level, np.flatnonzero(levels == level)) for level in np.unique(levels)]
    if len(g) <= MOST:
        styles = {level: LEVELS[k % len(LEVELS)] for k, (level, _) in enumerate(groups)}
        return [(name, styles[level], *rest) for level, (name, _, *rest) in zip(levels, lines, strict=True)]
    return [
        (
            f"level {level}: largest of {len(of)}" if len(of) > 1 else g.names[of[0]],
            LEVELS[k % len(LEVELS)],
            np.abs(g.value[of]).max(),
            residual[of].max(axis=0),
            largest[of].max(),
        )
        for k, (level, of) in enumerate(groups)
    ]
