"""Interpolation in tables of numbers, at traced points: `numpy.interp` and SciPy's interpolators as nodes.

A table is a piecewise polynomial. The number of the piece is found by one node, by bisection, and each coefficient is
looked up there by another.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from .nodes import Graph, Node, TraceError
from .traced import OWN, TracedArray, cells_of, has_traced, mapped
from .universal import number

#: SciPy's interpolators, which a function may also make.
_KINDS = (
    *("CubicSpline", "PchipInterpolator", "Akima1DInterpolator", "CubicHermiteSpline", "PPoly", "BSpline", "interp1d"),
    *("UnivariateSpline", "InterpolatedUnivariateSpline", "make_interp_spline"),
)


def looked_up(x: Node, breaks: Any, values: Any) -> Node:
    """The value of the piece that x is in: the first one below all breaks, the next one from the first break on."""
    if len(values) == 1:
        return x.graph.node(float(values[0]))
    piece = x.graph.make("piece", x, value=tuple(map(float, breaks)))
    return x.graph.make("pick", piece, value=tuple(map(float, values)))


def linear(x: Node, xs: Any, fs: Any, left: Node, right: Node) -> Node:
    """Interpolate linearly in a table, by the formula of `numpy.interp`."""
    graph, last = x.graph, x.graph.node(float(xs[-1]))
    if len(xs) == 1:
        raise TraceError("numpy.interp in a table of one point")
    with np.errstate(all="ignore"):  # where points coincide nothing lies between them
        slopes = np.diff(fs) / np.diff(xs)
    start, value, slope = (looked_up(x, xs[1:-1], one) for one in (xs[:-1], fs[:-1], slopes))
    inside = slope * (x - start) + value
    beyond = graph.select(graph.make("less", last, x), right, graph.node(float(fs[-1])))
    found = graph.select(graph.make("less_equal", last, x), beyond, inside)
    return graph.select(graph.make("less", x, graph.node(float(xs[0]))), left, found)


class PolynomialTable:
    """A piecewise polynomial of invariode's own, such as `Input`, which `pieces` describes.

    `pieces` returns times, and the coefficients of the powers of t minus each time, the highest power first, of shape
    (powers, pieces, size). With one piece for each time the last piece has no end; otherwise values beyond the ends are
    the values at the ends.
    """

    values: Any

    def pieces(self) -> tuple[Any, Any]:
        """Return the times and the coefficients."""
        raise NotImplementedError


def is_table(value: Any) -> bool:
    """Return whether a value is a `PolynomialTable` or an interpolator of SciPy's, or makes one of the latter."""
    if isinstance(value, PolynomialTable):
        return True
    kind = value if isinstance(value, type) or hasattr(value, "__wrapped__") else type(value)
    module = getattr(kind, "__module__", None) or ""
    named = any(getattr(one, "__name__", "") in _KINDS for one in getattr(kind, "__mro__", (value,)))
    return module.startswith("scipy.interpolate") and (named or getattr(value, "__name__", "") in _KINDS)


class TracedTable:
    """An interpolator of SciPy's that takes traced points; with the attributes of the interpolator."""

    def __init__(self, table: Any, decide: Callable[[Node], bool]) -> None:
        self._table, self._decide = table, decide

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._table, name)
        if not callable(found):
            return found

        def call(*args: Any, **kwargs: Any) -> Any:
            made = found(*args, **kwargs)  # derivative(), say
            return TracedTable(made, self._decide) if is_table(made) else made

        return call

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if isinstance(self._table, type) or hasattr(self._table, "__wrapped__") or not callable(self._table):
            return TracedTable(self._table(*args, **kwargs), self._decide)
        (x, *others) = args
        if not has_traced(x):
            found = self._table(*args, **kwargs)
            return TracedTable(found, self._decide) if is_table(found) else found
        if others or kwargs:
            raise TraceError(f"{type(self._table).__name__} with further arguments: take its derivative() first")
        graph = _graph(x)
        points = np.frompyfunc(number, 1, 1)(cells_of(x, graph))
        points = points if isinstance(points, np.ndarray) else np.array(points, dtype=object)
        at = _polynomials(self._table)
        return TracedArray(_stacked([at(node) for node in points.flat], points.shape), self._decide)


def _graph(x: Any) -> Any:
    if isinstance(x, TracedArray):
        return x.cells.flat[0].graph
    return next(_graph(one) for one in x if has_traced(one))


def _stacked(values: list[Any], shape: tuple[int, ...]) -> Any:
    """Stack nodes, or arrays of them, of each point in one array of leading shape `shape`."""
    first = values[0]
    inner = first.shape if isinstance(first, np.ndarray) else ()
    found = np.empty((len(values), *inner), dtype=object)
    for i, one in enumerate(values):
        found[i] = one
    return found.reshape((*shape, *inner))


def _polynomials(table: Any) -> Callable[[Node], Any]:
    """The values of an interpolator at one node."""
    from scipy.interpolate import BSpline, PPoly, UnivariateSpline, interp1d

    if isinstance(table, PolynomialTable):
        times, c = table.pieces()
        breaks = times if c.shape[1] < len(times) else np.append(times, np.inf)
        within = _of_polynomials(PPoly.construct_fast(c, breaks, extrapolate=True), flat=table.values.ndim == 1)
        if len(breaks) > len(times):
            return within
        low, high = float(times[0]), float(times[-1])

        def held(x: Node) -> Any:  # beyond its ends it keeps its values there
            later = x.graph.make("maximum", x, x.graph.node(low))
            return within(x.graph.make("minimum", later, x.graph.node(high)))

        return held
    if isinstance(table, interp1d):
        return _of_interp1d(table)
    if isinstance(table, UnivariateSpline):
        given: Any = table
        if given.ext not in (0, "extrapolate"):
            raise TraceError(f"a spline with ext={given.ext}")
        return _of_polynomials(PPoly.from_spline(given._eval_args, extrapolate=True))
    if isinstance(table, BSpline):
        return _of_polynomials(_as_polynomials(table, table.extrapolate))
    if isinstance(table, PPoly) and table.axis == 0:
        return _of_polynomials(table)
    raise TraceError(f"scipy.interpolate.{type(table).__name__}")


def _as_polynomials(spline: Any, extrapolate: Any) -> Any:
    from scipy.interpolate import PPoly

    columns = spline.c.reshape(len(spline.c), -1).T
    each = [PPoly.from_spline((spline.t, one, spline.k)) for one in columns]
    c = np.stack([one.c for one in each], axis=-1).reshape(*each[0].c.shape, *spline.c.shape[1:])
    return PPoly(c, each[0].x, extrapolate=extrapolate)


def _of_polynomials(table: Any, flat: bool = False) -> Callable[[Node], Any]:
    c, breaks, outside = np.asarray(table.c), np.asarray(table.x), table.extrapolate
    if c.dtype.kind == "c":
        raise TraceError("an interpolator of complex numbers")
    if outside is None:
        outside = True

    def one(x: Node, coefficients: Any) -> Node:
        start = looked_up(x, breaks[1:-1], breaks[:-1])
        powers = (looked_up(x, breaks[1:-1], row) for row in coefficients)
        return functools.reduce(lambda total, power: total * (x - start) + power, powers)

    def at(x: Node) -> Any:
        graph = x.graph
        if outside == "periodic":
            length = graph.node(float(breaks[-1] - breaks[0]))
            x = graph.make("modulo", x - float(breaks[0]), length) + float(breaks[0])
        values = np.empty(c.shape[2:], dtype=object)
        for place in np.ndindex(c.shape[2:]):
            found = one(x, c[(slice(None), slice(None), *place)])
            values[place] = found if outside else _within(x, breaks, found, math.nan, math.nan)
        return values.flat[0] if flat or not values.ndim else values

    return at


def _within(x: Node, breaks: Any, value: Node, below: float, above: float) -> Node:
    graph = x.graph
    found = graph.select(graph.make("less", graph.node(float(breaks[-1])), x), graph.node(above), value)
    return graph.select(graph.make("less", x, graph.node(float(breaks[0]))), graph.node(below), found)


def _of_interp1d(table: Any) -> Callable[[Node], Any]:
    """Return the function of an interp1d table on nodes, with NaN where the table raises."""
    xs, ys = np.asarray(table.x, dtype=float), np.asarray(table.y, dtype=float)
    if ys.ndim != 1:
        raise TraceError("interp1d of more than one row")
    kind = table._kind
    if kind == "linear":
        inner = _of_lines(xs, ys)
    elif kind in ("previous", "next", "nearest"):
        between = {"previous": xs[1:], "next": np.nextafter(xs[:-1], math.inf), "nearest": (xs[1:] + xs[:-1]) / 2}[kind]
        between = np.nextafter(between, math.inf) if kind == "nearest" else between

        def inner(x: Node) -> Node:
            return looked_up(x, between, ys)
    else:
        inner = _of_polynomials(_as_polynomials(table._spline, extrapolate=True), flat=True)
    if table._extrapolate:
        return inner
    below, above = (float(np.ravel(one)[0]) for one in (table._fill_value_below, table._fill_value_above))
    if table.bounds_error:
        below = above = math.nan
    return lambda x: _within(x, xs, inner(x), below, above)


def _of_lines(xs: Any, ys: Any) -> Callable[[Node], Node]:
    slopes = np.diff(ys) / np.diff(xs)

    def inner(x: Node) -> Node:
        start, value, slope = (looked_up(x, xs[1:-1], one) for one in (xs[:-1], ys[:-1], slopes))
        return slope * (x - start) + value

    return inner


#: Longer tables have to be constants.
_MOST_CHAINED = 50


def _interpolated(
    graph: Graph, x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None
) -> Any:
    """Piecewise linear: between two points the value of NumPy's formula."""
    if period is not None:
        raise TraceError("numpy.interp with a period")
    xs, fs = (mapped(number, cells_of(one, graph)) for one in (xp, fp))
    first, last = (f if given is None else cells_of(given, graph)[()] for f, given in ((fs[0], left), (fs[-1], right)))

    def one(at: Node) -> Node:
        if all(node.op == "number" for node in (*xs, *fs)):
            numbers = [np.array([node.value for node in each]) for each in (xs, fs)]
            return linear(at, numbers[0], numbers[1], first, last)
        if len(xs) > _MOST_CHAINED:
            raise TraceError(f"numpy.interp in a table of more than {_MOST_CHAINED} values that are not constant")
        found = fs[-1]
        for i in range(len(xs) - 2, -1, -1):
            slope = (fs[i + 1] - fs[i]) / (xs[i + 1] - xs[i])
            found = graph.select(graph.make("less", at, xs[i + 1]), slope * (at - xs[i]) + fs[i], found)
        found = graph.select(graph.make("less", at, xs[0]), first, found)
        return graph.select(graph.make("less", xs[-1], at), last, found)

    return mapped(lambda node: one(number(node)), cells_of(x, graph))


OWN["interp"] = _interpolated
