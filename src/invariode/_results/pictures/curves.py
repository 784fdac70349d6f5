"""Solutions as curves: smooth between the steps, interrupted at jumps, with few enough points to draw."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..._base.arguments import Array
from ..result import Result
from .canvas import FEW

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Points of a smooth curve, and the most in one step: enough that the eye sees no corners.
_POINTS, _POINTS_PER_STEP = 4000, 32

#: Up to this many outputs a curve is smoothed by their slopes; with more, the steps are too short to be seen.
_SLOPES = 20_000

#: Curves over t of more points than this are drawn by columns; a page has about this many.
_LONG, _COLUMNS = 16_000, 2000

#: With this many changes of direction the lines of a curve touch each other on a page: it is drawn as the range between
#: its extremes, in columns of this many changes.
_BUSY, _TURNS = 300, 4
#: Changes between two points below this fraction of the extent do not count: they are the roundoff of a component that
#: is constant between jumps.
_TREMOR = 1e-5


class Curve(NamedTuple):
    """t (k,) and y (n, k), with NaN where the solution jumps."""

    t: Array
    y: Array
    smooth: bool  # False: the points of the output, which lines join


def curve(sol: Result) -> Curve:
    """Return the continuous solution: that of `sol.sol`; else the cubics through outputs and slopes of f; else the
    outputs."""
    if sol.sol is not None:
        return _by_interpolant(sol)
    known = sol._origin is not None and len(sol.t) <= _SLOPES
    slopes = sol._run.slopes(sol.t, sol.y) if known else None
    if slopes is None:  # no functions, or too many points
        return Curve(interrupted(sol, sol.t), interrupted(sol, sol.y), smooth=False)
    return _by_slopes(sol, slopes)


def _by_interpolant(sol: Result) -> Curve:
    t, cuts = continuous_times(sol)
    return Curve(np.insert(t, cuts, np.nan), np.insert(sol.sol(t), cuts, np.nan, axis=1), smooth=True)


def continuous_times(sol: Result) -> tuple[Array, Array]:
    """Return times (k,) at which a continuous solution is drawn, and the places among them where it jumps."""
    knots = sol.sol.ts
    inside = _inside(len(knots))
    pieces = []
    jumps = np.flatnonzero(np.diff(knots) == 0) + 1
    for piece in np.split(knots, jumps):
        pieces.append(np.append((piece[:-1, None] + np.diff(piece)[:, None] * inside).ravel(), piece[-1]))
    for piece in pieces[:-1]:
        piece[-1] = np.nextafter(piece[-1], knots[0])  # at the jump itself sol.sol has the later value
    t = np.concatenate(pieces)
    return t, np.cumsum([len(piece) for piece in pieces[:-1]], dtype=int)


def _by_slopes(sol: Result, slopes: tuple[Array, Array]) -> Curve:
    """Cubic Hermite interpolation: between the steps of a run it is of order 4, enough for the eye. `slopes`: those
    after and before each point."""
    x = _inside(len(sol.t))[:, None]
    t, y, (after, before) = sol.t, sol.y, slopes
    h = np.diff(t)
    start, end = y[:, None, :-1], y[:, None, 1:]
    inside = (
        (1 + 2 * x) * (1 - x) ** 2 * start
        + x**2 * (3 - 2 * x) * end
        + x * (1 - x) * h * ((1 - x) * after[:, None, :-1] - x * before[:, None, 1:])
    )
    pieces = []
    for first, last in pairwise([0, *_jumps(sol), len(t)]):
        steps = slice(first, last - 1)  # of which each has its points one after the other
        times = np.append((t[steps] + x * h[steps]).T.ravel(), t[last - 1])
        values = inside[:, :, steps].transpose(0, 2, 1).reshape(len(y), len(times) - 1)
        values = np.concatenate([values, y[:, last - 1 : last]], axis=1)
        values[:, :: len(x)] = y[:, first:last]  # to the last bit
        pieces.append((times, values))
    cuts = np.cumsum([len(times) for times, _ in pieces[:-1]], dtype=int)
    whole, points = (np.concatenate(parts, axis=-1) for parts in zip(*pieces, strict=True))
    return Curve(np.insert(whole, cuts, np.nan), np.insert(points, cuts, np.nan, axis=1), smooth=True)


def _inside(knots: int) -> Array:
    """Return the points at which a step is drawn, from its start, in units of its size."""
    count = min(max(_POINTS // max(knots, 1), 1), _POINTS_PER_STEP)
    return np.arange(count) / count


def interrupted(sol: Result, values: Array) -> Array:
    """Return values at the outputs, in the last axis, with NaN where the solution jumps."""
    return np.insert(values, _jumps(sol), np.nan, axis=-1)


def _jumps(sol: Result) -> list[int]:
    """Return the outputs after jumps."""
    return [jump.row for jump in sol._invariants.jumps if 0 < jump.row < len(sol.t)]


def parts(values: Array) -> tuple[list[str], list[Array]]:
    """Return a prefix of the label, and real values: one of each, two for complex values."""
    return (["Re ", "Im "], [values.real, values.imag]) if np.iscomplexobj(values) else ([""], [values])


def line_and_marks(
    sol: Result, smooth: bool, properties: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Return properties of the line, and of the marks at the outputs, which a smooth curve has only on request."""
    look = {"linewidth": 1.4, "markersize": 5, **properties}
    few = len(sol.t) <= FEW
    if not smooth:
        return {"marker": "." if few else "none", **look}, None
    marker = look.pop("marker", None)
    if marker is None or str(marker).lower() in ("none", "", " "):
        return look, None
    return look, {**look, "marker": marker, "linestyle": "none"}


def draw_over_t(ax: Axes, sol: Result, t: Array, y: Array, smooth: bool, properties: dict[str, Any]) -> None:
    """Draw one component, with its marks separately; a long one is drawn as columns from minimum to maximum."""
    line = line_and_marks(sol, smooth, properties)[0]
    changes = np.diff(y)  # NaN at jumps
    changes = changes[np.abs(changes) > _TREMOR * (np.nanmax(y, initial=-np.inf) - np.nanmin(y, initial=np.inf))]
    turns = int(np.count_nonzero(np.diff(np.sign(changes))))
    busy = turns > _BUSY
    if len(t) <= _LONG and not busy:
        ax.plot(t, y, **line)
        return
    times, low, high = _columns(t, y, min(turns // _TURNS, _COLUMNS // _TURNS) if busy else _COLUMNS)
    if busy:
        shade = {name: line[name] for name in ("color", "label", "zorder") if name in line}
        ax.fill_between(times, low, high, linewidth=0, alpha=0.3, **shade)
        edge = {**line, "linewidth": line["linewidth"] / 2, "label": "_nolegend_"}
        ax.plot(times, low, **edge)
        ax.plot(times, high, **edge)
    else:
        ax.plot(np.repeat(times, 2), np.column_stack([low, high]).ravel(), **line)


def _columns(t: Array, y: Array, count: int) -> tuple[Array, Array, Array]:
    """Return times, least and largest values of columns of equally many points."""
    there = np.isfinite(y)
    t, y = t[there], y[there]
    starts = np.linspace(0, len(y), count, endpoint=False).astype(int)
    times = t[starts]
    times[-1] = t[-1]
    return times, np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
