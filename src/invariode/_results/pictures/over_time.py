"""Components over t: one panel, or one for each kind and each scale."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import Array
from ..result import Result
from .canvas import (
    MOST,
    components,
    drawable,
    joined,
    legend,
    log_axis,
    mark,
    new_panels,
    occurrences,
    properties,
    require_points,
    unused,
)
from .curves import Curve, curve, draw_over_t, line_and_marks, parts

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Components whose sizes differ by more than this cannot be seen on one axis.
_APART = 1e3

#: More panels of one kind would be too small to read: the smallest components then share one.
_PANELS = 4

#: The colour of marks, which are thinner with each level.
_OF_MARKS = "0.6"

#: The unit at the end of a label, such as "drug [mg/l]" or "T (K)".
_UNIT = re.compile(r"\s[\[(]([^\[\]()]+)[\])]$")

#: Half of the outputs in this part of the interval, and steps that differ by this factor, need a logarithmic axis.
_BEGINNING, _DECADES = 1e-3, 1e6

#: If there are more components than `MOST`, the number of names in the legend.
_NAMED = 10


def draw(sol: Result, ax: Axes | None, chosen: Any, log: str | None, marks: bool, line: dict[str, Any]) -> Axes:
    """See `Solution.plot`."""
    require_points(sol)
    those = components(sol, chosen)
    whole = curve(sol)
    floor = np.broadcast_to(sol._atol, len(whole.y))
    groups = groups_of(kinds_of(sol), whole.y, those, floor) if ax is None else [those]
    panels: list[Axes] = list(new_panels(sol._names.title, [1] * len(groups))) if ax is None else [ax]
    draw_groups(panels, sol, whole, groups, line)
    if marks:
        for t, level in zip(sol.marks.t, sol.marks.level, strict=True):
            for panel in panels if sol.t[0] <= t <= sol.t[-1] else ():
                panel.axvline(t, color=_OF_MARKS, linewidth=1 / (1 + level), zorder=0)
    if log == "x" or (log is None and ax is None and _piles_up(sol.t)):
        for panel in panels:
            panel.set_xscale("log")
            log_axis(panel.xaxis)
    panels[-1].set_xlabel("$t$")
    return panels[0]


def _piles_up(t: Array) -> bool:
    """Return whether a linear axis shows half of the outputs at its beginning, with steps over many decades."""
    h = np.diff(t)
    h = h[h > 0]
    early = len(t) > 0 and t[0] >= 0 and np.median(t) < _BEGINNING * t[-1]
    return bool(early and h.size and h.max() >= _DECADES * h.min())


def draw_groups(panels: list[Axes], sol: Result, whole: Curve, groups: list[list[int]], line: dict[str, Any]) -> None:
    """Draw a group of components on each panel, with legends or labels."""
    names, kinds = sol._names.components, kinds_of(sol)
    look, given = properties(line)
    for panel, group in zip(panels, groups, strict=True):
        _draw_group(panel, sol, whole, group, look, given)
        panel.set_ylabel(axis_label([names[k] for k in group], {kinds[k] for k in group}))
        legend(panel, f"{len(group)} components" if len(group) > MOST else None)


def axis_label(names: Sequence[str], kinds: set[str]) -> str:
    """Return the label of an axis with these components: the name of a single one, or what they have in common."""
    return drawable(names[0] if len(names) == 1 else next(iter(kinds)) if len(kinds) == 1 else "")


def units_of(names: Sequence[str]) -> list[str]:
    """Return the unit at the end of each label, '' for a label without a unit."""
    return [found[1] if (found := _UNIT.search(name)) else "" for name in names]


def kinds_of(sol: Result) -> list[str]:
    """Return the kind of each component, whose values may share an axis only with those of its kind: the unit in its
    label, 'positions' and 'velocities' of problems that have both, or ''."""
    names = sol._names.components
    units = units_of(names)
    if any(units):
        return units
    first = sol._origin and sol._origin.positions()
    if first:
        return ["positions" if k < first else "velocities" for k in range(len(names))]
    known = set(names)
    rates = [name.endswith("'") and name[:-1] in known for name in names]  # as `invariode.symbolic` labels them
    if not any(rates):
        return [""] * len(names)
    moving = {name[:-1] for name, rate in zip(names, rates, strict=True) if rate}
    return [
        "velocities" if rate else "positions" if name in moving else "" for name, rate in zip(names, rates, strict=True)
    ]


def groups_of(kinds: Sequence[str], y: Array, chosen: list[int], floor: Array | None = None) -> list[list[int]]:
    """Return components of one kind and of similar sizes, in the order of their first ones; those that stay below
    `floor`, (n,), count as zero."""
    if floor is not None:
        y = np.where(np.abs(y) > floor[:, None], y, 0.0)
    those = [[k for k in chosen if kinds[k] == kind] for kind in dict.fromkeys(kinds[k] for k in chosen)]
    return [group for one in those for group in _groups_of_scale(y, one)] or [[]]


def _groups_of_scale(y: Array, chosen: list[int]) -> list[list[int]]:
    """Return components whose sizes are alike; those of the group with the first component come first."""
    with np.errstate(invalid="ignore"):
        sizes = np.nanmax(np.abs(y[chosen]), axis=1, initial=0) if y.shape[1] else np.zeros(len(chosen))
    order = [k for k in np.argsort(-sizes, kind="stable") if 0 < sizes[k] < np.inf]
    groups: list[list[int]] = []
    for place, k in enumerate(order):
        if not place or (sizes[order[place - 1]] > _APART * sizes[k] and len(groups) < _PANELS):
            groups.append([])
        groups[-1].append(k)
    rest = [k for k in range(len(chosen)) if k not in set(order)]  # zero, or not finite: on any axis
    if not groups:
        return [chosen]
    groups[0] += rest
    return sorted(([chosen[k] for k in sorted(group)] for group in groups), key=lambda group: chosen.index(group[0]))


def _draw_group(ax: Axes, sol: Result, whole: Curve, group: list[int], look: dict[str, Any], given: str | None) -> None:
    names = sol._names.components
    named = set(np.linspace(0, len(group) - 1, _NAMED).astype(int)) if len(group) > MOST else range(len(group))
    for place, k in enumerate(group):
        colour, dashes = _paint(ax, place, len(group))
        for style, part, values, points in zip(dashes, *parts(whole.y[k]), parts(sol.y[k])[1], strict=False):
            label = joined(f"{part}{drawable(names[k])}", given) if place in named else "_nolegend_"
            own = {"color": colour, "linestyle": style, "label": label, **look}
            draw_over_t(ax, sol, whole.t, values, whole.smooth, own)
            if (marks := line_and_marks(sol, whole.smooth, own)[1]) is not None:
                ax.plot(sol.t, points, **{**marks, "label": "_nolegend_"})
    for label, marker, times, states in occurrences(sol):
        values = np.concatenate([part for k in group for part in parts(states[:, k])[1]] or [times[:0]])
        mark(ax, (np.resize(times, len(values)), values), label, marker)


def _paint(ax: Axes, place: int, count: int) -> tuple[Any, tuple[str, str]]:
    """Return colour and dashes: the next free ones for few components, the place in a sequence of colours for many."""
    if count <= MOST:
        return unused(ax)
    import matplotlib

    # the end of the sequence is too light for lines on white
    return matplotlib.colormaps["viridis"](0.9 * place / (count - 1)), ("-", "--")
