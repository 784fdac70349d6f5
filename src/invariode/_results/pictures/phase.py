"""Components against each other: in the plane, with a direction field, and in space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import Array, shown
from ..result import Result
from .canvas import (
    component,
    drawable,
    legend,
    listed,
    mark,
    new,
    occurrences,
    once,
    properties,
    require_points,
    unused,
)
from .curves import curve, line_and_marks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Axes whose extents differ by less than this get the same scale, so that circles are round.
_ALIKE = 3

#: Distances between numbers at an axis, but for powers of ten: the eye reads 0, 2, 4 faster than 0, 1.6, 3.2.
_ROUND = (1, 2, 2.5, 5, 10)

#: Arrows of a direction field along each axis.
_ARROWS = 21


def draw(sol: Result, chosen: tuple[Any, Any, Any], ax: Axes | None, field: bool, line: dict[str, Any]) -> Axes:
    """See `Solution.plot_phase`."""
    names, rows, labels = sol._names.components, *_coordinates(sol, chosen)
    require_points(sol)
    space = len(labels) == 3
    if field and (len(names) != 2 or space or np.iscomplexobj(sol.y)):
        raise ValueError(f"field=True needs a problem of two real components, but this one has {len(names)}")
    if ax is None:
        ax = _new(sol, space)
    elif (ax.name == "3d") != space:
        wanted = 'axes with projection="3d"' if space else "axes of the plane"
        raise ValueError(f"{len(labels)} components are drawn on {wanted}: give these, or none")

    def place(states: Array) -> tuple[Array, ...]:
        return (
            (states[rows[0]].real, states[rows[0]].imag) if np.iscomplexobj(sol.y) else tuple(states[k] for k in rows)
        )

    look, given = properties(line)
    whole = curve(sol)
    own, marks = line_and_marks(sol, whole.smooth, {"color": unused(ax)[0], "label": given, **look})
    colour = ax.plot(*place(whole.y), **own)[0].get_color()
    if marks is not None:
        ax.plot(*place(sol.y), **{**marks, "label": "_nolegend_"})
    for label, marker, _, states in occurrences(sol):
        mark(ax, place(states.T), label, marker)
    _mark_ends(ax, sol, place, colour)
    ax.set(**dict(zip(("xlabel", "ylabel", "zlabel"), labels, strict=False)))
    if not space:
        width, height = ax.dataLim.width, ax.dataLim.height
        if 0 < width < _ALIKE * height < _ALIKE**2 * width:
            ax.set_aspect("equal")
    if field:
        _draw_field(ax, sol, rows)
    legend(ax)
    return ax


def _coordinates(sol: Result, chosen: tuple[Any, Any, Any]) -> tuple[list[int], list[str]]:
    """Return the components, and the labels of the axes."""
    names = sol._names.components
    i, j, k = chosen
    first = component(names, i)
    if np.iscomplexobj(sol.y):
        if j is not None or k is not None:
            raise ValueError(
                f"the solution is complex: plot_phase({shown(i)}) draws one component in the complex plane, "
                f"got j = {shown(j)}"
            )
        return [first], [f"Re {drawable(names[first])}", f"Im {drawable(names[first])}"]
    if j is None:
        if len(names) == 1:
            raise ValueError(f"plot_phase needs two components, but this problem has one, {names[0]}: use plot()")
        raise ValueError(f"plot_phase needs two components of {listed(names)}, got only {shown(i)}")
    rows = [first, component(names, j), *([] if k is None else [component(names, k)])]
    return rows, [drawable(names[row]) for row in rows]


def _new(sol: Result, space: bool) -> Axes:
    from matplotlib.ticker import MaxNLocator

    ax = new(sol._names.title, figsize=(5.6, 4.4), **({"subplot_kw": {"projection": "3d"}} if space else {}))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(6, steps=_ROUND))  # more labels would touch where the aspect is equal
    return ax


def _mark_ends(ax: Axes, sol: Result, place: Any, colour: Any) -> None:
    ground = ax.get_facecolor()
    paint: dict[str, Any] = {"color": colour, "ls": "none", "zorder": 2.5}
    ends = sol.y if sol.sol is None else sol.sol(sol.sol.ts[[0, -1]])
    if ends.shape[1] > 1:
        rim: dict[str, Any] = {"mec": ground, "mew": 0.8}  # it shows the dot on a curve that fills the page
        ax.plot(*place(ends[:, :1]), marker="o", ms=7.8, label=once(ax, "start"), **paint, **rim)
    ax.plot(*place(ends[:, -1:]), marker="s", ms=4.5, mfc=ground, label=once(ax, "end"), **paint)


def _draw_field(ax: Axes, sol: Result, rows: list[int]) -> None:
    """Draw arrows of one length in the direction of f at the start of the run, behind the curve."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    x, y = np.meshgrid(np.linspace(left, right, _ARROWS), np.linspace(low, high, _ARROWS))
    states = np.empty((2, x.size))
    states[rows[0]], states[rows[1]] = x.ravel(), y.ravel()
    slopes = None if sol._origin is None else sol._origin.field(states)
    if slopes is None:
        raise ValueError(
            "field=True needs the function of the problem, without a mass matrix; a solution from a file or a pickle "
            "has none: solve again"
        )
    box = ax.get_window_extent()
    u, v = slopes[rows[0]] * box.width / (right - left), slopes[rows[1]] * box.height / (high - low)
    length = np.hypot(u, v)
    with np.errstate(invalid="ignore", divide="ignore"):
        arrows = (x, y, (u / length).reshape(x.shape), (v / length).reshape(x.shape))
    ax.quiver(*arrows, pivot="mid", color="0.6", width=0.0025, scale=30, zorder=0.5)
    ax.set(xlim=(left, right), ylim=(low, high))
