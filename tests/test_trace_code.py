"""Tables, complex numbers and everyday code in traced functions."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from scipy import interpolate

import invariode as iv
from invariode._functions.compiled import as_python
from invariode._functions.graph.python import Formula
from invariode._functions.graph.trace import trace

pytest.importorskip("llvmlite")
from traced_functions import hidden, lotka_volterra

XS = np.array([0.0, 0.3, 0.5, 1.2, 2.0, 3.0])
FS = np.array([1.0, 3.0, -1.0, 0.5, 2.0, 1.0])
TABLES = {
    "interp": lambda: lambda x: np.interp(x, XS, FS),
    "interp with values outside": lambda: lambda x: np.interp(x, XS, FS, left=5.0, right=6.0),
    "CubicSpline": lambda: interpolate.CubicSpline(XS, FS),
    "periodic": lambda: interpolate.CubicSpline(XS, FS, bc_type="periodic"),
    "not extrapolated": lambda: interpolate.CubicSpline(XS, FS, extrapolate=False),
    "derivative": lambda: interpolate.CubicSpline(XS, FS).derivative(),
    "PchipInterpolator": lambda: interpolate.PchipInterpolator(XS, FS),
    "make_interp_spline": lambda: interpolate.make_interp_spline(XS, FS),
    "UnivariateSpline": lambda: interpolate.UnivariateSpline(XS, FS, s=0),
    **{
        f"interp1d, {kind}": lambda kind=kind: interpolate.interp1d(
            XS, FS, kind, fill_value=(1.0, 2.0), bounds_error=False
        )
        for kind in ("linear", "previous", "next", "nearest", "cubic")
    },
    "interp1d, extrapolated": lambda: interpolate.interp1d(XS, FS, fill_value="extrapolate"),
    "interp1d that raises outside": lambda: interpolate.interp1d(XS, FS),
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_have_the_values_of_the_interpolator(name):
    """Between its points, at them, and outside, in machine code, one at a time and in lanes."""
    table = TABLES[name]()

    def fun(t, y):
        return [table(y[0])]

    code = iv.compile(fun, by="trace")
    evaluate = as_python(code.native(1, 1), 1)
    for x in [*np.random.default_rng(27).uniform(-1, 4, 40), *XS]:
        try:
            expected = float(table(x))
        except ValueError:
            expected = math.nan
        found = evaluate(0.0, np.array([x]), np.zeros(0))[0]
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


def test_an_interpolator_made_in_the_function_is_a_table():
    def fun(t, y):
        return [interpolate.CubicSpline(XS, FS)(t) - y[0]]

    found = Formula("f", lambda: trace(fun, 1).outputs, (1,))
    np.testing.assert_allclose(found(0.7, [0.5]), fun(0.7, [0.5]), rtol=1e-13)


def from_outside(t, y):
    return [y[1], -hidden.value * y[0] if y[0] < 0.5 else -y[0]]


def test_the_first_run_finds_a_function_that_has_changed(monkeypatch):
    """In a branch that no other test of the graph reached: at t, in the component, whichever call makes the run. Later
    runs do not look."""
    code = iv.compile(from_outside, by="trace")
    code.native(2, 2)
    monkeypatch.setattr(hidden, "value", 2.0)
    where = r"differs from the function that it was made of: at t = [12]\.\d+ its value 1 is"
    with pytest.raises(ValueError, match=where):
        iv.solve_ivp(code, (0, 10), [1.0, 0.0], check="strict")
    prepared = iv.Problem(code, (0, 10), [1.0, 0.0]).prepare()
    for first in (
        lambda: iv.solve_ivp(code, (0, 10), [1.0, 0.0]),
        prepared,
        lambda: prepared(y0=[1.0, 0.1]),
        lambda: iv.odeint(code, [1.0, 0.0], np.linspace(0, 10, 50), tfirst=True),
    ):
        with pytest.warns(UserWarning, match=where):
            first()
    monkeypatch.setattr(hidden, "value", 1.0)
    iv.solve_ivp(code, (0, 10), [1.0, 0.0], check="strict")
    evaluated = []
    monkeypatch.setattr(code, "fun", lambda t, y: evaluated.append(t))
    iv.solve_ivp(code, (0, 10), [1.0, 0.0], check="strict")
    assert evaluated == []


def cancelling(t, y):
    """Two ways of rounding differ by far more than the last place of the result."""
    return [(1e8 + y[0]) - 1e8 - np.exp(y[1]) * 1e8 + 1e8 * np.exp(y[1] * 0.1) ** 10, -y[1]]


def test_roundoff_is_no_difference():
    iv.solve_ivp(iv.compile(cancelling, by="trace"), (0, 1), [0.3, 0.7], check="strict", rtol=1e-3)


HAMILTONIAN = np.array([[1.0, 0.3j], [-0.3j, 2.0]])


def wave(t, u, dx):
    inner = -1j * (-0.5 * np.diff(u, 2) / dx**2 - (np.abs(u) ** 2 * u)[1:-1])
    return np.hstack([0.0 + 0j, inner, 0j])


def filled_complex(t, y, w):
    slopes = np.zeros(2, dtype=complex)
    slopes[0] = 1j * w * y[0] + np.exp(1j * t) * y[1].conj()
    slopes[1] = -y[1] + abs(y[0]) * cmath.exp(1j * w)
    return slopes


def products(t, y):
    """Return products of two vectors of complex numbers, in which none is conjugated."""
    return np.dot(y, 1j * y) * np.array([0.1, 0.2j]) - y * np.inner(y, y.conj())


def complex_list(t, z):
    a, b = z
    return [1j * a * b.real, -b + a.imag * np.sqrt(a) + (1 + 2j) / a + a**3 + np.sum(z) * (2 - 1j)]


COMPLEX = {
    "matrix": (lambda t, psi: -1j * (HAMILTONIAN @ psi), [1.0, 0.5j], ()),
    "wave": (wave, np.exp(-(np.linspace(-3, 3, 20) ** 2)) + 0j, (0.3,)),
    "filled": (filled_complex, [1.0, 0.2j], (2.0,)),
    "products": (products, [1.0 + 0.5j, 0.2 - 1j], ()),
    "list": (complex_list, [1.0 + 0.5j, 0.2 - 1j], ()),
}


@pytest.mark.parametrize("name", COMPLEX)
def test_complex_problems_are_traced_as_pairs(name):
    fun, y0, args = COMPLEX[name]
    options = {"args": args, "rtol": 1e-8, "atol": 1e-10}
    plain, code = (
        iv.solve_ivp(one, (0, 0.3), np.array(y0, complex), check="strict", **options)
        for one in (fun, iv.compile(fun, by="trace"))
    )
    assert plain.stats.steps == code.stats.steps
    np.testing.assert_allclose(code.y[:, -1], plain.y[:, -1], rtol=1e-12, atol=1e-14)


def test_complex_numbers_may_come_in_between():
    def fun(t, y):
        z = y[0] + 1j * y[1]
        w = z**2 * np.exp(1j * t) + 1 / (z + 2)
        return [w.real, w.imag]

    found = Formula("f", lambda: trace(fun, 2).outputs, (2,))
    np.testing.assert_allclose(found(0.3, [0.5, 0.7]), fun(0.3, [0.5, 0.7]), rtol=1e-14)


def test_ensembles_vary_the_arguments_without_compiling_again():
    code = iv.compile(lotka_volterra, by="trace")
    args = np.linspace([1.0, 1.0, 2.0, 0.8], [1.5, 1.2, 3.0, 1.0], 5)
    found = iv.solve_ensemble(code, (0, 2), [[1.0, 2.0]] * 5, args=args, rtol=1e-6)
    for row, end in zip(args, found.y_end, strict=True):
        expected = iv.solve_ivp(lotka_volterra, (0, 2), [1.0, 2.0], args=tuple(row), rtol=1e-6)
        np.testing.assert_allclose(end, expected.y[:, -1], rtol=1e-10)


# ----------------------------------------------------------------------------------------------------------------------
# Everyday code

CUBIC = np.poly1d([1.0, -2.0, 3.0])
WINDOWED = np.polynomial.Polynomial([1.0, -2.0, 0.5], domain=[0, 4])
CHEBYSHEV = np.polynomial.Chebyshev([1.0, -2.0, 0.5, 0.25])


def into_zeros(t, y):
    slopes = np.zeros(len(y), dtype=float)
    slopes[:] = -y
    return slopes


def into_empty(t, y):
    slopes = np.empty((len(y),), np.float64)
    slopes[0], slopes[1:] = t * y[1], -y[1:]
    return slopes


EVERYDAY = {
    "array of float": lambda t, y: np.array([-y[0], y[1], y[2]], dtype=float),
    "array of float64": lambda t, y: np.array([-y[0], y[1], y[2]], dtype=np.float64),
    "asarray": lambda t, y: -np.asarray(y, dtype=float),
    "asarray by position": lambda t, y: -np.asarray(y, np.float64),
    "astype": lambda t, y: -y.astype(float) + np.array([1, 2, 3]).astype(np.float64),
    "sum": lambda t, y: -y * y.sum(dtype=float) + np.sum(y, dtype=np.float64),
    "zeros": into_zeros,
    "empty": into_empty,
    "ones": lambda t, y: -y * np.ones(3, dtype=np.float64) + np.full(3, 0.5, dtype=float),
    "polyval": lambda t, y: [np.polyval([1.0, 2.0, 3.0], y[0]), np.polyval([t, 1.0], y[1]), np.polyval([], y[2])],
    "polyval of an array": lambda t, y: np.polyval([1.0, 2.0, 3.0], y),
    "poly1d": lambda t, y: [CUBIC(y[0]), CUBIC(t), CUBIC.deriv()(y[1])],
    "poly1d of an array": lambda t, y: -CUBIC(y),
    "Polynomial": lambda t, y: [WINDOWED(y[0]), WINDOWED(t), WINDOWED(2.0) * y[2]],
    "Polynomial of an array": lambda t, y: WINDOWED(y) + CHEBYSHEV(y),
    "gradient": lambda t, y: np.gradient(y) + np.gradient(y, 0.1, edge_order=2) + np.gradient(y, [0.0, 1.0, 3.0]),
    "gradient by a value": lambda t, y: np.gradient(y, 1 + t * t),
    "gradient along an axis": lambda t, y: np.gradient(np.outer(y, y), axis=1).sum(axis=1),
    "select": lambda t, y: [np.select([y[0] < 0, y[0] < 1], [y[1], 2 * y[0]], -t), -y[1], y[2]],
    "select of arrays": lambda t, y: np.select([y < 0, y < 1], [y, 2 * y]),
    "math.fmod": lambda t, y: [math.fmod(y[0], 0.7), math.fmod(t - 5, 2.0), math.fmod(3.0, y[2])],
    "fmod": lambda t, y: np.fmod(y, [0.7, -0.7, 0.3]),
    "decay by an exponential": lambda t, y: -y / np.exp(t),
    "steep sigmoid": lambda t, y: y / (1 + np.exp(-500 * (t - 0.5))),
    "steep sigmoid of y": lambda t, y: 1 / (1 + np.exp(-2000 * (y - 0.5))),
    "pulse": lambda t, y: -y / np.cosh(t) ** 2 - y / math.cosh(min(t, 5.0)),
    "branch of a pulse": lambda t, y: -y / np.cosh(t) if t > 1 else y,
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", EVERYDAY)
def test_everyday_code_is_traced(name):
    """Machine code has its values but for roundoff, whatever sign they have; NumPy warns of nothing on the way."""
    fun = EVERYDAY[name]
    code = iv.compile(fun, by="trace")
    call = as_python(code.native(3, 3), 3)
    for t, y in zip([0.3, 2.5, 7.0], np.random.default_rng(44).normal(size=(3, 3)), strict=True):
        with np.errstate(all="ignore"):
            expected = fun(t, y)
        np.testing.assert_allclose(call(t, y, np.zeros(0)), expected, rtol=1e-11, atol=1e-13)


def test_formulas_follow_ieee_arithmetic_where_python_raises():
    """Values that overflow, and those beside them, are those of NumPy."""

    def fun(t, y):
        return [1 / np.exp(t), np.exp(t), np.cosh(t), 1 / (t - 1000), np.log(y[0]), np.sqrt(-1 - y[0]), t]

    found = trace(fun, 1)
    values = Formula("f", lambda: found.outputs, (7,))(1000.0, [0.0])
    np.testing.assert_array_equal(values, [0, np.inf, np.inf, np.inf, -np.inf, np.nan, 1000])
