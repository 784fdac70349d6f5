"""Taylor coefficients from expression graphs: those of functions along polynomials, and of solutions."""

from __future__ import annotations

import ctypes
from bisect import bisect_right

import mpmath
import numpy as np
import pytest

from invariode._functions.graph.nodes import ELEMENTARY, Graph
from invariode._functions.graph.python import as_text

series = pytest.importorskip("invariode._functions.graph.series")

EPS = np.finfo(float).eps
ORDER = 9
TIME, UNIT = 0.3, 0.25
#: Of y, a row for each order: around points at which all functions below are defined.
RNG = np.random.default_rng(30)
ALONG = np.vstack([[0.7, 0.4, 1.3], RNG.uniform(-0.3, 0.3, (ORDER, 3))])
ARGS = [1.6, 0.4]


def jet(outputs, **form):
    """(t, unit, y, p) → coefficients, by machine code."""
    form = series.SeriesForm(**{"n": 3, "order": ORDER, **form})
    code = series.series_code(outputs, form)
    number = ctypes.c_double if form.lanes == 1 else ctypes.c_void_p
    call = ctypes.CFUNCTYPE(None, number, number, *[ctypes.c_void_p] * 3)(code.address)

    def evaluate(t, unit, y, p=ARGS):
        y, p = (np.ascontiguousarray(one, dtype=float) for one in (y, p))
        out = np.full((form.order + 1, len(outputs), *y.shape[1 if not form.along else 2 :]), np.nan)
        rows = [np.ascontiguousarray(one, dtype=float) for one in (t, unit)]
        numbers = (t, unit) if form.lanes == 1 else (one.ctypes.data for one in rows)
        call(*numbers, y.ctypes.data, out.ctypes.data, p.ctypes.data)
        assert code.owner is not None
        return out

    return evaluate


def exactly(node, c=ALONG, order=ORDER):
    """The coefficients of a node along the polynomial, in 15 digits or more, of 60."""
    names = {name: getattr(mpmath, name, None) for name in (*ELEMENTARY, "atan2", "hypot", "floor")}
    names |= {"pow": mpmath.power, "exp2": lambda x: mpmath.power(2, x), "log2": lambda x: mpmath.log(x, 2)}
    names |= {"bisect_right": bisect_right, "sign": mpmath.sign}
    exec(as_text("f", [node]), names)
    with mpmath.workdps(60):
        rows = [[mpmath.mpf(one) for one in row] for row in c.tolist()]

        def along(s):
            y = [mpmath.polyval([row[i] for row in rows[::-1]], s) for i in range(3)]
            return names["f"](mpmath.mpf(TIME) + mpmath.mpf(UNIT) * s, y, [mpmath.mpf(one) for one in ARGS])[0]

        return np.array([float(one) for one in mpmath.taylor(along, 0, order)])


def samples():
    """A node for each operation, of arguments that move."""
    graph = Graph()
    t, a, b, c, p = graph.t, graph.y(0), graph.y(1), graph.y(2), graph.p(0)
    found = {name: graph.elementary(name, c if name == "acosh" else b) for name in ELEMENTARY}
    found |= {f"{name} of t": graph.elementary(name, t * p + (0.9 if name == "acosh" else 0.0)) for name in ELEMENTARY}
    found |= {
        "sum": a + b - c + 1.5, "negate": -a, "product": a * b * p, "square": (a + b) * (a + b), "quotient": a / b,
        "of a number": 2.0 / b, "by a number": a / 3.0 + b / p, "by t": (t + 1.0) / (t * t + b), "power": a**1.7,
        "half power": (a * a + b * b) ** -1.5, "large power": c**23.0, "inverse power": a**-3.0,
        "general power": graph.power(a, b), "power of a number": graph.power(graph.node(2.5), b),
        "atan2": graph.make("atan2", a, b), "atan2 of t": graph.make("atan2", t, b), "hypot": graph.make("hypot", a, b),
        "modulo": graph.make("modulo", c * 7.0, a), "modulo of a number": graph.make("modulo", c * 7.0, p),
        "abs": graph.make("abs", a - c), "minimum": graph.make("minimum", a, b), "maximum": graph.make("maximum", a, b),
        "select": graph.select(graph.make("less", a, b), a * a, b * b), "sign": graph.make("sign", a - c) * a,
        "floor": graph.make("floor", c) + b, "polynomial in t": t**3.0 * a - t,
        "table": graph.make("pick", graph.make("piece", c, value=(0.5, 1.1, 2.0)), value=(1.0, 2.0, 3.0, 4.0)) * c,
    }  # fmt: skip
    return found


SAMPLES = samples()


@pytest.mark.parametrize("name", SAMPLES)
def test_coefficients_of_functions_are_those_of_60_digits(name):
    """Along a polynomial, within the roundoff of sums with growing terms."""
    node = SAMPLES[name]
    found = jet([node], along=True)(TIME, UNIT, ALONG)[:, 0]
    expected = exactly(node)
    np.testing.assert_allclose(found, expected, rtol=0, atol=64 * EPS * np.maximum.accumulate(np.abs(expected)).max())


@pytest.mark.parametrize("name", SAMPLES)
def test_loops_have_the_coefficients_of_straight_lines(name, monkeypatch):
    node = SAMPLES[name]
    expected = jet([node, node.graph.y(1)], along=True)(TIME, UNIT, ALONG)
    monkeypatch.setattr(series, "_MOST_PRODUCTS", -1)
    machine = pytest.importorskip("invariode._functions.graph.machine")
    machine._kept.clear()
    found = jet([node, node.graph.y(1)], along=True)(TIME, UNIT, ALONG)
    np.testing.assert_allclose(found, expected, rtol=0, atol=64 * EPS * np.abs(expected).max())
