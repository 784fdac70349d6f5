"""A compiled function computes with the callables and values of this run, not with those of the first run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator, make_interp_spline

import invariode as iv
from invariode._functions.contents import content

pytest.importorskip("llvmlite")

TIMES = np.linspace(0, 1, 5)
#: What a module's function finds by its name; tests change it.
FACTOR = 2.0


def doubled(t: float) -> float:
    return 2 * t


def quadrupled(t: float) -> float:
    return 4 * t


def scaled(t: float, a: float) -> float:
    return a * t


class Line:
    def __init__(self, slope: float) -> None:
        self.slope = slope

    def at(self, t: float) -> float:
        return self.slope * t

    def __call__(self, t: float) -> float:
        return self.at(t)


class Rebuilt:
    """Copies are made from a list that lasts no longer than the copying."""

    def __init__(self, slopes: list[float]) -> None:
        self.slopes = tuple(slopes)

    def __reduce__(self) -> tuple[Any, ...]:
        return Rebuilt, ([*self.slopes],)


def line(slope: float) -> Callable[[float], float]:
    return lambda t: slope * t


def by_default(slope: float) -> Callable[[float], float]:
    def at(t: float, a: float = slope) -> float:
        return a * t

    return at


PAIRS: dict[str, tuple[Any, Any]] = {
    "lambda": (lambda t: 2 * t, lambda t: 4 * t),
    "def": (doubled, quadrupled),
    "closure": (line(2.0), line(4.0)),
    "default": (by_default(2.0), by_default(4.0)),
    "partial": (partial(scaled, a=2.0), partial(scaled, a=4.0)),
    "method": (Line(2.0).at, Line(4.0).at),
    "object": (Line(2.0), Line(4.0)),
    "cubic spline": (CubicSpline(TIMES, 2 * TIMES), CubicSpline(TIMES, 4 * TIMES)),
    "pchip": (PchipInterpolator(TIMES, 2 * TIMES), PchipInterpolator(TIMES, 4 * TIMES)),
    "list": ([doubled], [quadrupled]),
}


def integral(compiled: Any, *args: Any) -> float:
    sol = iv.solve_ivp(compiled, (0, 1), [0.0], args=args, rtol=1e-9, atol=1e-9)
    return float(sol.y[0, -1])


@pytest.mark.parametrize("kind", PAIRS)
def test_a_compiled_function_calls_the_callable_that_it_is_given(kind: str) -> None:
    first, second = PAIRS[kind]
    compiled = iv.compile(lambda t, y, g: [(g[0] if isinstance(g, list) else g)(t) * 1.0])
    for given, expected in ((first, 1), (second, 2), (first, 1)):
        assert integral(compiled, given) == pytest.approx(expected, rel=1e-8)
        problem = iv.Problem(compiled, (0, 1), [0.0], args=(given,))
        assert problem.solve(rtol=1e-9, atol=1e-9).y[0, -1] == pytest.approx(expected, rel=1e-8)


def test_rows_of_an_ensemble_never_share_a_callable_that_differs() -> None:
    compiled = iv.compile(lambda t, y, g: [g(t)])
    args = [(Line(slope).at,) for slope in (2.0, 4.0, 6.0)]
    with pytest.raises(ValueError, match="differ from row to row"):
        iv.solve_ensemble(compiled, (0, 1), np.zeros((3, 1)), args=args)
    alike = iv.solve_ensemble(compiled, (0, 1), np.zeros((2, 1)), args=[(Line(2.0).at,), (Line(2.0).at,)], t_eval=[1.0])
    np.testing.assert_allclose(np.ravel(alike.y), 1, rtol=1e-3)


def test_contents_are_equal_exactly_if_values_are() -> None:
    """Made twice: equal; made of other values, or opaque: different."""
    makes: list[Callable[[float], Any]] = [
        line,
        by_default,
        Line,
        lambda a: partial(scaled, a=a),
        lambda a: Line(a).at,
        lambda a: CubicSpline(TIMES, a * TIMES),
        lambda a: make_interp_spline(TIMES, a * TIMES),
        lambda a: [Rebuilt([1.0]), Rebuilt([a])],
        lambda a: {"x": [a, (a, None)], "y": np.array([a])},
        lambda a: np.array([a, {"k": a}], dtype=object),
    ]
    for make in makes:
        assert content(make(2.0)) == content(make(2.0))
        assert content(make(2.0)) != content(make(4.0))
    opaque = (n for n in range(3))
    assert content(opaque) == content(opaque) != content(n for n in range(3))
    assert content(0.0) != content(-0.0)
    assert content(float("nan")) == content(float("nan"))
    ring: list[Any] = [1.0]
    ring.append(ring)
    assert content(ring) == content(ring)


@pytest.mark.parametrize("by", ["trace", "numba"])
def test_a_compiled_function_follows_what_it_has_captured(by: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Closures, globals, defaults and arrays that change between two runs count in the next run."""
    if by == "numba":
        pytest.importorskip("numba")
    values, slope = np.array([2.0]), 2.0

    def of_closure(t: float, y: Any) -> Any:
        return [slope * t]

    def of_array(t: float, y: Any) -> Any:
        return [values[0] * t]

    def of_global(t: float, y: Any) -> Any:
        return [FACTOR * t]

    def of_default(t: float, y: Any, a: float = 2.0) -> Any:
        return [a * t]

    compiled = [iv.compile(fun, by=by) for fun in (of_closure, of_array, of_global)]
    if by == "trace":  # numba takes defaults for arguments
        compiled.append(iv.compile(of_default, by=by))
    for fun in compiled:
        assert integral(fun) == pytest.approx(1, rel=1e-8)
    slope, values[0], of_default.__defaults__ = 4.0, 4.0, (4.0,)
    monkeypatch.setitem(globals(), "FACTOR", 4.0)
    for fun in compiled:
        assert integral(fun) == pytest.approx(2, rel=1e-8)


def test_code_is_made_once_while_nothing_changes() -> None:
    compiled = iv.compile(lambda t, y: [FACTOR * t])
    integral(compiled)
    (made,) = compiled._made.values()
    integral(compiled)
    assert [*compiled._made.values()] == [made]
