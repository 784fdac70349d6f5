"""Taylor coefficients from expression graphs: those of functions along polynomials, and of solutions."""

from __future__ import annotations

import ctypes
import math
from bisect import bisect_right
from collections import OrderedDict

import mpmath
import numpy as np
import pytest

from invariode._functions.graph.nodes import ELEMENTARY, Graph
from invariode._functions.graph.python import as_text

objects = pytest.importorskip("invariode._functions.graph.objects")

from invariode._functions.graph import codes, series  # noqa: E402  # needs what was just imported
from invariode._functions.graph.objects import SeriesForm  # noqa: E402  # likewise

EPS = np.finfo(float).eps
ORDER = 9
TIME, UNIT = 0.3, 0.25
#: Of y, a row for each order: around points at which all functions below are defined.
RNG = np.random.default_rng(30)
ALONG = np.vstack([[0.7, 0.4, 1.3], RNG.uniform(-0.3, 0.3, (ORDER, 3))])
ARGS = [1.6, 0.4]


def batched(values, count):
    values = list(values)
    return [values[i : i + count] for i in range(0, len(values), count)]


def jet(outputs, **form):
    """(t, unit, y, p) → coefficients, by machine code."""
    form = SeriesForm(**{"n": 3, "order": ORDER, **form})
    code = codes.machine_code(outputs, form)
    number = ctypes.c_double if form.lanes == 1 else ctypes.c_void_p
    unused = [] if form.lanes == 1 else [None]
    call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(unused), number, number, *[ctypes.c_void_p] * 3)(
        code.address
    )

    def evaluate(t, unit, y, p=ARGS):
        y, p = (np.ascontiguousarray(one, dtype=float) for one in (y, p))
        out = np.full((form.order + 1, len(outputs), *y.shape[1 if not form.along else 2 :]), np.nan)
        rows = [np.ascontiguousarray(one, dtype=float) for one in (t, unit)]
        numbers = (t, unit) if form.lanes == 1 else (one.ctypes.data for one in rows)
        call(*unused, *numbers, y.ctypes.data, out.ctypes.data, p.ctypes.data)
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
#: Products up to which coefficients are written out: all, or none.
forms = pytest.mark.parametrize("most", [math.inf, -1], ids=["straight", "loops"])


@pytest.fixture(autouse=True)
def form(request, monkeypatch):
    """How the code is written, and nothing that was written otherwise."""
    monkeypatch.setattr(objects, "_kept", OrderedDict())
    if "most" in request.fixturenames:
        monkeypatch.setattr(series, "_MOST_PRODUCTS", request.getfixturevalue("most"))


@pytest.fixture(scope="module")
def expected():
    return {name: exactly(node) for name, node in SAMPLES.items()}


@pytest.mark.slow
@forms
def test_coefficients_of_functions_are_those_of_60_digits(most, expected):
    """Along a polynomial, within the roundoff of sums with growing terms."""
    together = batched(SAMPLES.values(), 8)  # straight code takes more than linear time to compile
    found = np.hstack([jet(some, along=True)(TIME, UNIT, ALONG) for some in together])
    for name, values in zip(SAMPLES, found.T, strict=True):
        scale = np.abs(expected[name]).max()
        np.testing.assert_allclose(values, expected[name], rtol=0, atol=64 * EPS * scale, err_msg=name)


def systems():
    """Right-hand sides: an orbit with drag, one with a linear system, and many bodies on a line."""
    graph = Graph()
    t, p = graph.t, graph.p(0)
    x, z, u = (graph.y(i) for i in range(3))
    few = [u * p, graph.elementary("sin", x + t) / z, (x * x + z * z) ** -1.5 - graph.elementary("exp", -u)]
    solved = graph.solve([[x + 2.0, z], [u, t + 3.0]], [[x * z], [u * u]])
    many = [graph.y(i) for i in range(12)]
    forces = [
        sum((b - a) / ((b - a) * (b - a) + 1.0) * (j + 0.5) for j, b in enumerate(many) if b is not a) for a in many
    ]
    return {"few": few, "solve": [solved[0][0], solved[1][0], x * 1.0], "many": forces}


SYSTEMS = systems()
#: The large one takes long to compile as straight code, and linear systems are straight always.
written = pytest.mark.parametrize(("name", "most"), [("few", math.inf), ("few", -1), ("solve", math.inf), ("many", -1)])


@written
def test_coefficients_of_solutions_are_those_of_their_slope(name, most):
    """y_k+1 = unit f_k / (k + 1) with one rounding, where f_k is the coefficient of f along the series itself."""
    f, n = SYSTEMS[name], len(SYSTEMS[name])
    y = np.random.default_rng(1).uniform(0.5, 1.5, n)
    c = jet(f, n=n)(TIME, UNIT, y)
    slopes = jet(f, n=n, along=True)(TIME, UNIT, c)
    np.testing.assert_array_equal(c[0], y)
    np.testing.assert_array_equal(c[1:], UNIT * slopes[:-1] / np.arange(1, ORDER + 1)[:, None])


@written
def test_the_unit_of_time_scales_coefficients_exactly(name, most):
    f, n = SYSTEMS[name], len(SYSTEMS[name])
    y = np.random.default_rng(2).uniform(0.5, 1.5, n)
    by_unit = jet(f, n=n)
    factors = (2.0**-70) ** np.arange(ORDER + 1)[:, None]
    np.testing.assert_array_equal(by_unit(TIME, UNIT * 2.0**-70, y), by_unit(TIME, UNIT, y) * factors)


@forms
@pytest.mark.parametrize("along", [False, True])
def test_lanes_have_the_bits_of_one_at_a_time(most, along):
    """A small system and a large one, each lane with its own t, unit and parameters."""
    rng, lanes = np.random.default_rng(3), 4
    for f in [SYSTEMS["few"], *([SYSTEMS["many"]] if most < 0 else [])]:
        n = len(f)
        y = rng.uniform(0.5, 1.5, (ORDER + 1, n, lanes) if along else (n, lanes))
        t, unit, p = rng.uniform(0, 1, lanes), 2.0 ** rng.integers(-3, 3, lanes), rng.uniform(1, 2, (2, lanes))
        one = jet(f, n=n, along=along)
        alone = [one(t[i], unit[i], y[..., i], p[:, i]) for i in range(lanes)]
        together = jet(f, n=n, along=along, lanes=lanes)(t, unit, y, p)
        np.testing.assert_array_equal(together, np.stack(alone, axis=-1))


def test_two_equal_systems_side_by_side_take_the_instructions_of_one():
    """Coefficients of equal operations are vectors of two numbers."""

    def instructions(bodies):
        graph = Graph()
        y = [[graph.y(i * bodies + body) for i in range(2)] for body in range(bodies)]
        slopes = [[v for _, v in y], [-x / (x * x * graph.elementary("sqrt", x * x)) for x, _ in y]]
        written = series.written([one for row in slopes for one in row], SeriesForm(2 * bodies, ORDER))
        return int.from_bytes(written[:8], "little")

    assert instructions(2) < 1.25 * instructions(1)


def test_linear_systems_and_series_in_loops_have_no_lanes(monkeypatch):
    form = SeriesForm(3, ORDER, lanes=4)
    assert "linear system" in codes.lane_code(SYSTEMS["solve"], form, make=True)
    assert "fewer trajectories" in codes.lane_code(SYSTEMS["few"], form, make=False)
    monkeypatch.setattr(series, "_MOST_PRODUCTS", -1)
    assert "so large" in codes.lane_code(SYSTEMS["few"], form, make=True)


def test_solutions_of_linear_systems_are_those_of_cramers_rule():
    graph = Graph()
    a, b, c, t = graph.y(0), graph.y(1), graph.y(2), graph.t
    ((x,), (z,)) = graph.solve([[a, b], [c, t]], [[a * c], [b]])
    determinant = a * t - b * c
    expected = jet([(a * c * t - b * b) / determinant, (a * b - a * c * c) / determinant], along=True)
    np.testing.assert_allclose(
        jet([x, z], along=True)(TIME, UNIT, ALONG), expected(TIME, UNIT, ALONG), rtol=0, atol=1e-9
    )


def test_there_is_no_series_at_a_root_of_zero():
    """√y and y^1.5 are defined at y = 0, their derivatives are not: no later coefficient is finite."""
    graph = Graph()
    along = np.vstack([[0.0, 0.4, 1.3], ALONG[1:]])
    for f in (graph.elementary("sqrt", graph.y(0)), graph.y(0) ** 1.5):
        found = jet([f, graph.node(1.0), graph.t], along=True)(TIME, UNIT, along)
        assert found[0, 0] == 0
        assert not np.isfinite(found[2:, 0]).any()
