"""Our elementary functions: right to one unit in the last place, and the same for one number and in lanes."""

from __future__ import annotations

import ctypes
import math
import pickle
from collections import OrderedDict
from functools import cache

import numpy as np
import pytest

import invariode as iv
from invariode import _core
from invariode._functions import lanes
from invariode._functions.compiled import Compiled
from invariode._functions.layout import ArgumentLayout

mpmath = pytest.importorskip("mpmath")
pytest.importorskip("numba")
objects = pytest.importorskip("invariode._functions.graph.objects")
elementary_code = pytest.importorskip("invariode._functions.elementary_code")

POINTS = 16_000  # a fourth of them in each range of arguments
BITS = 90  # of reference values

VECTOR = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
LANES = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5)


def sin_of_all(t, y, out):
    for i in range(len(out)):
        out[i] = math.sin(y[i])


def cos_of_all(t, y, out):
    for i in range(len(out)):
        out[i] = math.cos(y[i])


def exp_of_all(t, y, out):
    for i in range(len(out)):
        out[i] = math.exp(y[i])


def log_of_all(t, y, out):
    for i in range(len(out)):
        out[i] = math.log(y[i])


def power_of_all(exponent):
    def of_all(t, y, out):
        for i in range(len(out)):
            out[i] = y[i] ** exponent

    return of_all


#: The operations of each half power, which round once each.
OPERATIONS = {1.5: 2, -1.5: 3, 2.5: 3, -2.5: 4, -0.5: 2}
EXPONENTS = tuple(OPERATIONS)
OF_ALL = {"sin": sin_of_all, "cos": cos_of_all, "exp": exp_of_all, "log": log_of_all}
OF_ALL |= {f"x^{exponent}": power_of_all(exponent) for exponent in EXPONENTS}


CHUNK = 512  # components of the functions that give values


@cache
def native(name):
    return iv.compile(OF_ALL[name], inplace=True).native(CHUNK, CHUNK)


def values(name, x, code=native):
    """By a compiled function of many components."""
    padded = np.ones(-(-len(x) // CHUNK) * CHUNK)
    padded[: len(x)] = x
    out = np.empty_like(padded)
    for first in range(0, len(padded), CHUNK):
        VECTOR(code(name).address)(0.0, padded[first:].ctypes.data, out[first:].ctypes.data, None)
    return out[: len(x)]


def angles(random, size):
    return [
        random.uniform(-1, 1, size),
        random.uniform(-1e5, 1e5, size),
        random.choice([-1, 1], size) * np.exp(random.uniform(-50, math.log(1e300), size)),
        np.arange(1, size // 2) * (math.pi / 2),  # these nearly cancel
    ]


ARGUMENTS = {
    "sin": angles,
    "cos": angles,
    "exp": lambda random, size: [
        random.uniform(-1, 1, size),
        random.uniform(-746, 709.7, size),
        random.uniform(-746, -700, size),
    ],
    "log": lambda random, size: [
        random.uniform(0.5, 2, size),
        np.exp(random.uniform(-745, 709, size)),
        1 + random.uniform(-1, 1, size) * 2.0 ** -random.uniform(1, 52, size),
    ],
}


for one in EXPONENTS:
    ARGUMENTS[f"x^{one}"] = lambda random, size: [random.uniform(1, 4, size), np.exp(random.uniform(-200, 200, size))]


def exact(name):
    """mpmath's function of its own raw numbers, precision and rounding."""
    if not name.startswith("x^"):
        return getattr(mpmath.libmp, f"mpf_{name}")
    exponent = mpmath.libmp.from_float(float(name[2:]))
    return lambda x, bits, rounding: mpmath.libmp.mpf_pow(x, exponent, bits, rounding)


def errors(function, x, found):
    """In units of the last place."""
    to_float, from_float = mpmath.libmp.to_float, mpmath.libmp.from_float
    reference = [function(from_float(one), BITS, "n") for one in x.tolist()]
    rounded = np.array([to_float(one) for one in reference])
    unit = np.spacing(np.abs(rounded))
    rest = [
        to_float(mpmath.libmp.mpf_shift(mpmath.libmp.mpf_sub(one, from_float(head), BITS, "n"), shift))
        for one, head, shift in zip(reference, rounded.tolist(), (1 - np.frexp(unit)[1]).tolist(), strict=True)
    ]
    return (found - rounded) / unit - rest


@pytest.mark.parametrize("name", OF_ALL)
def test_errors_are_below_a_unit_in_the_last_place(name):
    random = np.random.default_rng(17)
    x = np.concatenate(ARGUMENTS[name](random, POINTS // (16 if name.startswith("x^") else 4)))
    error = np.abs(errors(exact(name), x, values(name, x)))
    assert 0.49 < error.max() < (OPERATIONS[float(name[2:])] if name.startswith("x^") else 0.9)


INF, NAN, TINY, HUGE = math.inf, math.nan, 5e-324, 1.7976931348623157e308
EDGES = {
    "sin": [(0.0, 0.0), (-0.0, -0.0), (TINY, TINY), (-TINY, -TINY), (INF, NAN), (-INF, NAN), (NAN, NAN)],
    "cos": [(0.0, 1.0), (-0.0, 1.0), (TINY, 1.0), (INF, NAN), (-INF, NAN), (NAN, NAN)],
    "exp": [
        (0.0, 1.0),
        (-0.0, 1.0),
        (TINY, 1.0),
        (INF, INF),
        (-INF, 0.0),
        (NAN, NAN),
        (HUGE, INF),
        (-HUGE, 0.0),
        (709.782712893384, 1.7976931348622732e308),
        (709.7827128933841, INF),
        (-745.1332191019411, TINY),
        (-745.1332191019412, 0.0),
    ],
    "log": [
        (1.0, 0.0),
        (0.0, -INF),
        (-0.0, -INF),
        (-1.0, NAN),
        (-INF, NAN),
        (INF, INF),
        (NAN, NAN),
        (TINY, -744.4400719213812),
        (HUGE, 709.782712893384),
    ],
}


@pytest.mark.parametrize("name", EDGES)
def test_edges(name):
    arguments, expected = np.array(EDGES[name]).T
    found = values(name, arguments)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found[expected == 0]), np.signbit(expected[expected == 0]))


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_powers_of_numbers_far_from_1_are_the_librarys(exponent):
    x = [0.0, -0.0, -4.0, INF, -INF, NAN, TINY, 1e-320, 1e-200, 1e200, HUGE]
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(values(f"x^{exponent}", x), np.power(x, exponent))


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_the_largest_and_the_most_cancelling_arguments(name):
    """6381956970095103 2^797 is the double nearest to a multiple of π/2 (Muller, Elementary Functions)."""
    x = [HUGE, 6381956970095103 * 2.0**797, 51471.0, math.nextafter(51471.0, INF), 1e22]
    with mpmath.workprec(1300):
        expected = [float(getattr(mpmath, name)(one)) for one in x]
    np.testing.assert_allclose(values(name, x), expected, rtol=2.0**-52)


def all_of_them(t, y, p):
    s, c = math.sin(y[0]), math.cos(y[0])
    within = math.exp(p[0]) if y[1] > 0 else math.log(p[0])
    powers = y[2] ** 1.5 - y[3] ** -2.5
    return s, c, math.exp(y[0]), math.log(y[1]), within, powers + math.sin(p[0] * 1e4)


def in_lanes(form, width, y, p):
    """The values of a form for lanes, for rows y and p."""
    found = np.empty((len(y), y.shape[1]))
    space = np.zeros((2 * y.shape[1] + p.shape[1] + 2, width + 8))
    start = space.ctypes.data + (-space.ctypes.data) % 64
    sizes = [1, y.shape[1], y.shape[1], p.shape[1]]
    places = start + 8 * width * np.concatenate([[0], np.cumsum(sizes)[:-1]])
    t_, y_, out_, p_ = (
        np.ctypeslib.as_array(ctypes.cast(int(place), ctypes.POINTER(ctypes.c_double)), (size, width))
        for place, size in zip(places, sizes, strict=True)
    )
    for first in range(0, len(y), width):
        t_[:], y_[:], p_[:] = 0.0, y[first : first + width].T, p[first : first + width].T
        LANES(form.address)(None, *(one.ctypes.data for one in (t_, y_, out_, p_)))
        found[first : first + width] = out_.T
    return found


@pytest.mark.parametrize("width", sorted({width for _, width in _core.instruction_sets()}))
def test_lanes_have_the_bits_of_one_number(width):
    random = np.random.default_rng(5)
    edges = [one for rows in EDGES.values() for one, _ in rows]
    few = np.array([*edges, 51471.5, -1e9, 1e300, -700.0, 695.0, 1e-310])
    y = np.concatenate([random.choice(few, (64 * width, 6)), random.uniform(-20, 20, (64 * width, 6))])
    p = np.concatenate([random.choice(few, (64 * width, 1)), random.uniform(0, 20, (64 * width, 1))])
    compiled = iv.compile(all_of_them)
    alone = compiled.native(6, 6, ArgumentLayout.single(1))
    form = lanes._lane_code(Compiled(compiled, 6, 6, ArgumentLayout.single(1).whole()), width)
    assert not isinstance(form, str), form
    expected = np.empty_like(y)
    for at, row, out in zip(p, y, expected, strict=True):
        VECTOR(alone.address)(0.0, row.ctypes.data, out.ctypes.data, at.ctypes.data)
    np.testing.assert_array_equal(in_lanes(form, width, y, p), expected)


def far_pendulum(t, y, p):
    return y[1], -p[0] * math.sin(y[0] + 1e6) + 0.1 * math.cos(t) + math.exp(-t - 800) - math.log(p[0])


@pytest.mark.parametrize("elementary", ["own", "libm"])
def test_single_solves_and_lanes_agree(elementary, monkeypatch):
    monkeypatch.setattr(lanes, "FEWEST", 1)
    fun = iv.compile(far_pendulum, elementary=elementary)
    y0 = np.random.default_rng(3).uniform(-1, 1, (40, 2))
    found = iv.solve_ensemble(fun, (0, 3), y0, args=(1.5,), workers=1)
    alone = iv.solve_ensemble(fun, (0, 3), y0, args=(1.5,), workers=1, lanes=1)
    assert "40 trajectories one at a time" not in found.stats.lanes
    np.testing.assert_array_equal(found.y_end, alone.y_end)
    one = iv.solve_ivp(fun, (0, 3), y0[7], args=(1.5,))
    np.testing.assert_array_equal(found.y_end[7], one.y[:, -1])
    if elementary == "libm":
        python = iv.solve_ivp(far_pendulum, (0, 3), y0[7], args=([1.5],))
        np.testing.assert_array_equal(one.y[:, -1], python.y[:, -1])


def test_helpers_get_them_too():
    import numba

    @numba.njit
    def helper(x):
        return np.sin(x) + np.exp(x)

    x = np.linspace(-3, 3, 50)
    code = iv.compile(lambda t, y, p: helper(p[0])).native(1, 1, ArgumentLayout.single(1))
    found, unused = np.empty_like(x), np.zeros(1)
    for i in range(len(x)):
        VECTOR(code.address)(0.0, unused.ctypes.data, found[i:].ctypes.data, x[i:].ctypes.data)
    np.testing.assert_array_equal(found, values("sin", x) + values("exp", x))
    assert (found != np.sin(x) + np.exp(x)).any()


def test_calls_that_are_not_inlined_have_the_same_bits(monkeypatch):
    x = np.linspace(-3, 3, 50)
    inlined = values("cos", x)
    monkeypatch.setattr(elementary_code, "MOST_INLINED", 0)
    monkeypatch.setattr(objects, "_kept", OrderedDict())
    np.testing.assert_array_equal(values("cos", x, native.__wrapped__), inlined)


def test_the_choice_stays_with_the_function():
    with pytest.raises(ValueError, match="elementary must be one of 'own', 'libm'"):
        iv.compile(far_pendulum, elementary="libmvec")
    fun = iv.compile(far_pendulum, elementary="libm")
    assert iv.compile(fun).elementary == "libm"
    assert pickle.loads(pickle.dumps(fun)).elementary == "libm"
    assert iv.compile(far_pendulum).elementary == "own"
