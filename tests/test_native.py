"""Machine code is accepted wherever a Python function is, gives the same runs, and needs no interpreter."""

from __future__ import annotations

import _thread
import copy
import ctypes
import functools
import os
import pickle
import signal
import threading
import time

import numpy as np
import pytest
import scipy

import invariode as iv
from cases import FAMILIES, dealt, explicit_and_implicit
from problems import implicit

numba = pytest.importorskip("numba")
DOUBLE, POINTER = numba.types.double, numba.types.CPointer(numba.types.double)
VECTOR = numba.void(DOUBLE, POINTER, POINTER, POINTER)
EVENT = DOUBLE(DOUBLE, POINTER, POINTER)


def kepler(t, y):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return (y[2], y[3], -y[0] / r3, -y[1] / r3)


def integrals(t, y):
    return ((y[2] * y[2] + y[3] * y[3]) / 2 - (y[0] * y[0] + y[1] * y[1]) ** -0.5, y[0] * y[3] - y[1] * y[2])


def gradients(t, y):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return (y[0] / r3, y[1] / r3, y[2], y[3], y[3], -y[2], -y[1], y[0])


def apsis(t, y):
    return y[0] * y[2] + y[1] * y[3]


@numba.cfunc(VECTOR)
def kepler_code(t, y, out, p):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    out[0], out[1], out[2], out[3] = y[2], y[3], -y[0] / r3, -y[1] / r3


@numba.cfunc(EVENT)
def apsis_code(t, y, p):
    return y[0] * y[2] + y[1] * y[3]


@numba.cfunc(VECTOR)
def robertson_jacobian_code(t, y, J, p):
    J[0], J[1], J[2] = -0.04, 1e4 * y[2], 1e4 * y[1]
    J[3], J[4], J[5] = 0.04, -1e4 * y[2] - 6e7 * y[1], -1e4 * y[1]
    J[6], J[7], J[8] = 0.0, 6e7 * y[1], 0.0


@functools.cache
def as_python(fun):
    """Compiled, with the elementary functions that Python has, and so its bits."""
    return iv.compile(fun, elementary="libm")


@functools.cache
def oscillator():
    return iv.compile(lambda t, y: (y[1], -y[0]))


@functools.cache
def integrals_by(way):
    return iv.compile(integrals, by=way)


ORBIT = [0.4, 0, 0, 2]
CALLBACK = ctypes.CFUNCTYPE(None, ctypes.c_double, *[ctypes.POINTER(ctypes.c_double)] * 3)
KINDS = {
    "numba.cfunc": kepler_code,
    "compile": as_python(kepler),
    "LowLevelCallable": scipy.LowLevelCallable(
        kepler_code.ctypes, signature="void (double, double *, double *, double *)"
    ),
    "ctypes": CALLBACK(kepler_code.address),
}


def same_jacobian(method):
    """Compiled functions have complex steps unless told otherwise, Python functions differences."""
    return {"jac": "differences"} if implicit(method) else {}


@dealt(method=FAMILIES, kind=KINDS)
def test_every_kind_of_native_function_gives_the_run_of_the_python_one(method, kind):
    options = {"rtol": 1e-6, "dense_output": True, **same_jacobian(method)}
    python = iv.solve_ivp(kepler, (0, 20), ORBIT, method, **options)
    native = iv.solve_ivp(KINDS[kind], (0, 20), ORBIT, method, **options)
    assert (native.nfev, native.stats.steps) == (python.nfev, python.stats.steps)
    np.testing.assert_allclose(native.y, python.y, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(native.sol(3.3), python.sol(3.3), rtol=1e-9)


@dealt(method=FAMILIES, which=["all", "invariants", "events", "right-hand side"])
def test_native_and_python_functions_mix(method, which):
    native = {"right-hand side": which in ("all", "right-hand side"), "events": which in ("all", "events")}
    native["invariants"] = which in ("all", "invariants")
    fun = as_python(kepler) if native["right-hand side"] else kepler
    event = apsis_code if native["events"] else apsis
    if native["invariants"]:
        held = iv.Invariants(as_python(integrals), as_python(gradients), names=["energy", "momentum"])
    else:
        held = iv.Invariants(integrals, lambda t, y: np.reshape(gradients(t, y), (2, 4)), names=["energy", "momentum"])
    python = iv.Invariants(integrals, lambda t, y: np.reshape(gradients(t, y), (2, 4)))
    options = {"rtol": 1e-6, "refine": 2, "dense_output": True, **same_jacobian(method)}
    expected = iv.solve_ivp(kepler, (0, 20), ORBIT, method, invariants=python, events=apsis, **options)
    sol = iv.solve_ivp(fun, (0, 20), ORBIT, method, invariants=held, events=event, **options)
    assert sol.stats.steps == expected.stats.steps
    assert sol.stats.ng == expected.stats.ng
    np.testing.assert_allclose(sol.y, expected.y, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(sol.t_events[0], expected.t_events[0], atol=1e-7)
    np.testing.assert_allclose(sol.residual, expected.residual, atol=1e-9)
    np.testing.assert_allclose(sol.sol(1.7), expected.sol(1.7), rtol=1e-7)
    assert np.abs(sol.impose().residual).max() < 1e-14
    assert sol.drift().names == ["energy", "momentum"]


def test_native_jacobians_of_stiff_problems():
    from stiff import PROBLEMS

    p = PROBLEMS["Robertson"]
    options = {"rtol": 1e-5, "atol": 1e-5 * p.scale}
    python = iv.ode15s(p.fun, (0, 1e6), p.y0, jac=p.jac, **options)
    sol = iv.ode15s(p.fun, (0, 1e6), p.y0, jac=robertson_jacobian_code, **options)
    assert (sol.nfev, sol.njev, sol.nlu) == (python.nfev, python.njev, python.nlu)

    def diffusion(t, u):
        return 40.0 * np.convolve(u, [1, -2, 1], "same")

    def bands(t, y, out):
        for j in range(10):
            out[j], out[10 + j], out[20 + j] = 40.0, -80.0, 40.0

    def entries(t, y, out):
        k = 0
        for j in range(10):
            for i in range(max(0, j - 1), min(10, j + 2)):
                out[k] = -80.0 if i == j else 40.0
                k += 1

    u0 = np.sin(np.arange(10.0))
    expected = iv.ode15s(diffusion, (0, 1), u0, lband=1, uband=1)
    for given in (
        {"jac": iv.compile(bands, inplace=True), "lband": 1, "uband": 1},
        {"jac": iv.compile(entries, inplace=True), "jac_sparsity": np.abs(np.subtract.outer(range(10), range(10))) < 2},
    ):
        sol = iv.ode15s(diffusion, (0, 1), u0, **given)
        np.testing.assert_allclose(sol.y[:, -1], expected.y[:, -1], atol=1e-6)


def test_gradients_of_a_compiled_invariant_are_exact():
    """As those of the Python function are; machine code of others takes no complex y. Powers differ by two units in the
    last place from libm's, in g and in the values at which it is held, and ten time units multiply that by some 1e3."""
    python = iv.solve_ivp(kepler, (0, 10), ORBIT, invariants=iv.Invariants(integrals, names=["energy", "momentum"]))
    for by, jac, kind in (("trace", None, "traced"), ("numba", None, "complex step")):
        held = iv.Invariants(integrals_by(by), jac, names=["energy", "momentum"])
        sol = iv.solve_ivp(kepler, (0, 10), ORBIT, invariants=held)
        assert sol.stats.derivatives == kind
        np.testing.assert_allclose(sol.y, python.y, rtol=1e-11, atol=1e-11)
    held = iv.Invariants(kepler_code, "complex-step", value=np.zeros(4))
    with pytest.raises(ValueError, match=r'jac="complex-step" is not for native functions'):
        iv.solve_ivp(kepler, (0, 1), ORBIT, invariants=held)


@pytest.mark.parametrize("by", ["trace", "numba"])
def test_a_compiled_invariant_says_how_many_values_it_has(by):
    held = integrals_by(by)
    named = iv.Invariants(held, names=["energy", "momentum"])
    alone, expected = (iv.ode45(kepler, (0, 20), ORBIT, invariants=one) for one in (held, named))
    np.testing.assert_array_equal(alone.y, expected.y)
    assert len(alone.drift().names) == 2

    def overwriting(t, y):
        y *= 2.0
        return (y[1] * y[1] + y[2] * y[2]) / 4

    y = iv.ode45(lambda t, y: [1.0, y[2], -y[1]], (0, 1), [0, 1, 0], invariants=iv.compile(overwriting, by=by)).y
    np.testing.assert_allclose(y[1, -1] ** 2 + y[2, -1] ** 2, 1, rtol=1e-12)


def test_a_compiled_invariant_that_is_not_analytic_has_differences():
    held = iv.Invariants(iv.compile(lambda t, y: abs(y[0] * y[3] - y[1] * y[2]), by="numba"), names=["momentum"])
    sol = iv.solve_ivp(kepler, (0, 1), ORBIT, invariants=held)
    assert sol.stats.derivatives == "central differences"


def test_copies_and_pickles_of_solutions():
    """With native functions, which a copy compiles again. (test_dense.py copies the solutions of every method.)"""
    options = {"dense_output": True, "rtol": 1e-6}
    held = iv.Invariants(iv.compile(integrals), iv.compile(gradients), names=["energy", "momentum"])
    sol = iv.solve_ivp(decorated, (0, 5), ORBIT, invariants=held, **options)
    for one in (copy.deepcopy(sol), pickle.loads(pickle.dumps(sol))):
        np.testing.assert_array_equal(one.sol([1.1, 3.3]), sol.sol([1.1, 3.3]))
        np.testing.assert_array_equal(one.residual, sol.residual)

    @numba.cfunc(VECTOR)
    def momentum(t, y, out, p):
        out[0] = y[0] * y[3] - y[1] * y[2]

    sol = iv.solve_ivp(kepler, (0, 5), ORBIT, invariants=iv.Invariants(momentum, names="momentum"), **options)
    np.testing.assert_array_equal(copy.deepcopy(sol).sol(1.1), sol.sol(1.1))
    with pytest.raises(TypeError, match="native functions cannot be pickled"):
        pickle.dumps(sol)


def test_parameters_pass_as_args():
    def spring(t, y, p):
        return (y[1], -p[0] * y[0] - p[1])

    options = {"args": (4.0, 0.5), "rtol": 1e-8, "atol": 1e-10}
    python = iv.solve_ivp(lambda t, y, k, g: [y[1], -k * y[0] - g], (0, 1), [1, 0], **options)
    sol = iv.solve_ivp(iv.compile(spring), (0, 1), [1, 0], **options)
    np.testing.assert_allclose(sol.y[:, -1], python.y[:, -1], rtol=1e-10)
    with pytest.raises(TypeError, match="args of native functions must be real numbers"):
        iv.solve_ivp(iv.compile(spring, by="numba"), (0, 1), [1, 0], args=("a",))


class TestCompile:
    """`compile` takes what numba takes, in three forms."""

    def test_forms(self):
        def filled(t, y, out):
            out[0] = -y[0]
            out[1] = -2 * y[1]

        def scaled(t, y):
            y *= 2.0
            return -y[0] / 2, -y[1]

        def shifted(t, y):
            y += np.array([1.0, 1.0])
            return 1 - y[0], 2 - 2 * y[1]

        def sliced(t, y):
            y[:] *= 2.0
            return -y[0] / 2, -y[1]

        forms = [
            iv.compile(lambda t, y: (-y[0], -2 * y[1])),
            iv.compile(lambda t, y: [-y[0], -2 * y[1]]),
            iv.compile(lambda t, y: -y * np.array([1.0, 2.0])),
            iv.compile(filled, inplace=True),
            *(iv.compile(one, by="numba") for one in (scaled, shifted, sliced)),
        ]
        for form in forms:
            sol = iv.solve_ivp(form, (0, 1), [1, 1], rtol=1e-8)
            np.testing.assert_allclose(sol.y[:, -1], np.exp([-1, -2]), rtol=1e-6)
        assert iv.solve_ivp(iv.compile(lambda t, y: -y[0]), (0, 1), [1]).success

    def test_events_actions_and_one_invariant(self):
        hit = iv.Event(
            iv.compile(lambda t, y: y[0]), direction=-1, terminal=3, action=iv.compile(lambda t, y: (0.0, -0.9 * y[1]))
        )
        energy = iv.Invariants(iv.compile(lambda t, y: y[1] * y[1] / 2 + y[0]), names="energy")
        sol = iv.solve_ivp(iv.compile(lambda t, y: (y[1], -1.0)), (0, 50), [1, 0], events=hit, invariants=energy)
        np.testing.assert_allclose(sol.t_events[0], np.sqrt(2) * np.cumsum([1, 1.8, 1.62]), rtol=1e-6)

    def test_called_from_python_it_runs_its_machine_code(self):
        """The values and the Jacobian are those of the Python function, for numbers, arrays and changed closures, and
        whatever is not a real number is left to the Python function."""

        def python(t, y, k, a):
            return [-k * y[0] + a[0] * np.sin(t), k * y[0] ** 2 - a[1] * y[1]]

        fun, y, a = iv.compile(python), np.array([1.0, 2.0]), np.array([0.1, 0.2])
        np.testing.assert_allclose(fun(0.3, y, 0.5, a), python(0.3, y, 0.5, a), rtol=1e-15)
        fun.jacobian(0.3, y, 0.5, a)
        assert fun(0.3, [1.0, 2.0j], 0.5, a) == python(0.3, [1.0, 2.0j], 0.5, a)
        fun.fun = None  # from here on there is only machine code
        for k in (0.7, 0.9):
            np.testing.assert_allclose(fun(0.3, [1.0, 2.0], k, a), [-k + 0.1 * np.sin(0.3), k - 0.4], rtol=1e-14)
            np.testing.assert_allclose(fun.jacobian(0.3, y, k, a), [[-k, 0], [2 * k, -0.2]], rtol=1e-14, atol=0)
        assert repr(iv.compile(kepler)) == "compile(kepler)"
        np.testing.assert_allclose(iv.compile(kepler)(0, ORBIT), kepler(0, ORBIT), rtol=1e-15)
        assert iv.compile(lambda t, y: y[0] * y[1])(0.0, [2.0, 3.0]) == 6.0
        assert iv.compile(lambda t, y: y[0] > 1)(0.0, [2.0]) is True

    def test_arguments_that_are_constants_of_the_code(self):
        """Counts, tables and functions among the arguments have the values of this call; so have closures."""
        factor = 2.0

        def power(t, y, n, f):
            found = factor * y[0]
            for _ in range(n):
                found = f(found)
            return [found]

        fun = iv.compile(power)
        assert [float(fun(0.0, [1.5], n, g)[0]) for n in (1, 2) for g in (np.sqrt, np.square)] == pytest.approx(
            [np.sqrt(3), 9, 3**0.25, 81]
        )
        factor = 4.0
        assert float(fun(0.0, [1.0], 1, np.sqrt)[0]) == pytest.approx(2)
        np.testing.assert_allclose(fun.jacobian(0.0, [1.0], 1, np.sqrt), [[1.0]])

    def test_functions_that_fill_an_array_and_those_of_numba(self):
        def filled(t, y, out, k):
            out[:] = -k * y

        fun, out = iv.compile(filled, inplace=True), np.zeros(2)
        assert fun(0.0, np.array([1.0, 2.0]), out, 3.0) is out
        assert out.tolist() == [-3.0, -6.0]
        with pytest.raises(TypeError, match="does not say how many values"):
            fun.jacobian(0.0, [1.0, 2.0], 3.0)
        by_numba = iv.compile(lambda t, y, p: p[0] * y * y, by="numba")
        np.testing.assert_allclose(by_numba(0.0, np.array([1.0, 2.0]), np.array([3.0])), [3, 12])
        found = by_numba.jacobian(0.0, np.array([1.0, 2.0]), np.array([3.0]))
        np.testing.assert_allclose(found, [[6, 0], [0, 12]], rtol=1e-12)

    def test_what_numba_cannot_compile_is_said(self):
        with pytest.raises(TypeError, match="numba cannot compile this function"):
            iv.solve_ivp(iv.compile(lambda t, y: (t.nothing,), by="numba"), (0, 1), [1.0])
        fun = iv.compile(lambda t, y, a: (y[1], -a * y[0]), by="numba")
        with pytest.raises(TypeError, match=r"f\(t, y, p\), p an array of 1: p\[0\] is the first"):
            iv.solve_ivp(fun, (0, 1), [1.0, 0.0], args=(3.0,))
        with pytest.raises(TypeError, match=r"left to numba, as .* IndexError: index 5 is out"):
            iv.solve_ivp(iv.compile(lambda t, y, a: (a * y[0], y[5])), (0, 1), [1.0, 0.0], args=(3.0,))
        with pytest.raises(TypeError, match=r"compile takes a function f\(t, y\)"):
            iv.compile(3)

    @pytest.mark.parametrize(
        ("fun", "what"),
        [
            (lambda t, y: (-y[0],), "returns 1 value, expected 2"),
            (lambda t, y: (-y[0], -y[1], 0.0), "returns 3 values, expected 2"),
            (lambda t, y: (-y[0], 1, 0.0), "returns 3 values, expected 2"),
            (lambda t, y: -y[0], "returns 1 value, expected 2"),
            (lambda t, y: None, "returns nothing, expected 2"),
        ],
    )
    def test_another_number_of_values_is_refused(self, fun, what):
        fun.__name__ = "decay"
        with pytest.raises(TypeError, match=rf"compile\(decay\): the function {what}"):
            iv.solve_ivp(iv.compile(fun), (0, 1), [1.0, 1.0])
        with pytest.raises(TypeError, match=r"the function returns 2 values, expected 16"):
            iv.ode15s(iv.compile(kepler), (0, 1), ORBIT, jac=iv.compile(lambda t, y: (0.0, 1.0)))

    @pytest.mark.parametrize(
        "rows",
        [
            lambda t, y: ((0.0, 1.0), (-2 * y[0], 0)),
            lambda t, y: [[0.0, 1.0], [-2 * y[0], 0.0]],
            lambda t, y: [(0.0, 1.0), (-2 * y[0], 0.0)],
            lambda t, y: ([0.0, 1.0], [-2 * y[0], 0.0]),
            lambda t, y: (np.array([0.0, 1.0]), np.array([-2 * y[0], 0.0])),
            lambda t, y: np.array([[0.0, 1.0], [-2 * y[0], 0.0]]),
        ],
        ids=["tuples", "lists", "list of tuples", "tuple of lists", "tuple of arrays", "array"],
    )
    def test_jacobians_may_be_given_by_rows(self, rows):
        f, span, y0 = iv.compile(lambda t, y: (y[1], -y[0] * y[0])), (0, 5), [1.0, 0.0]
        flat = iv.ode15s(f, span, y0, jac=iv.compile(lambda t, y: (0.0, 1.0, -2 * y[0], 0.0)))
        sol = iv.ode15s(f, span, y0, jac=iv.compile(rows))
        np.testing.assert_array_equal(sol.y, flat.y)

    @pytest.mark.parametrize(
        ("rows", "message"),
        [
            (lambda t, y: ((0.0, 1.0), (y[0],)), "returns rows of 2, 1 values: return rows of one length"),
            (lambda t, y: ((0.0, 1.0), y[0]), "returns rows of 2, 1 values: return rows of one length"),
            (lambda t, y: ((0.0, 1.0), (y[0], 0), (0, 0)), "returns 3 rows of 2 values, expected 4 values"),
        ],
    )
    def test_rows_of_another_shape_are_refused(self, rows, message):
        with pytest.raises(TypeError, match=message):
            iv.ode15s(oscillator(), (0, 1), [1.0, 0.0], jac=iv.compile(rows))

    @pytest.mark.parametrize("uneven", [lambda t, y: [[0.0, 1.0], [y[0]]], lambda t, y: [[0.0, 1.0, y[0]], [0.0]]])
    def test_lists_of_uneven_rows_cannot_be_evaluated(self, uneven):
        sol = iv.ode15s(oscillator(), (0, 1), [1.0, 0.0], jac=iv.compile(uneven))
        assert "The Jacobian of fun is NaN or infinite" in sol.message

    @pytest.mark.parametrize("fun", [lambda t, y: y[:1] * 1.0, lambda t, y: [y[0]], lambda t, y: np.ones(3)])
    def test_a_list_or_array_of_another_length_is_refused(self, fun):
        with pytest.raises(ValueError, match=r"returned (1 value|3 values) at t = 0\.0, expected 2"):
            iv.solve_ivp(iv.compile(fun), (0, 1), [1.0, 1.0])

    def test_what_raises_cannot_be_evaluated(self):
        sol = iv.solve_ivp(iv.compile(lambda t, y: (y[np.argmax(y[:0])], 1.0)), (0, 1), [1.0, 1.0])
        assert sol.status == -1
        assert "component 0 is NaN or infinite" in sol.message
        # an index beyond an array, as the function itself raises it; where only some values lead there it is NaN
        beyond = r"compile\(compiled\), at t = 0\.0: index {} is out of bounds for axis 0 with size {}\."
        for by in ("auto", "numba"):
            osc, wrong = lambda t, y: (y[1], -y[0]), iv.compile(lambda t, y: (y[0], y[5]), by=by)
            by_p = iv.compile(lambda t, y, p: (y[1], -p[3] * y[0]), by=by)
            matrix = iv.compile(lambda t, y: ((0.0, 1.0), (-1.0, y[9])), by=by)
            first = iv.Event(lambda t, y: y[0] - 0.8, action=wrong)
            named = iv.Invariants(iv.compile(lambda t, y: y[0] - y[2], by=by), names="difference")
            for call, where in (
                (lambda one=wrong: iv.solve_ivp(one, (0, 1), [1.0, 0.0]), ("fun", 5, 2)),
                (lambda one=by_p: iv.solve_ivp(one, (0, 1), [1.0, 0.0], args=(np.ones(2),)), ("fun", 3, 2)),
                (lambda f=osc, one=matrix: iv.ode15s(f, (0, 1), [1.0, 0.0], jac=one), ("jac", 9, 2)),
                (lambda f=osc, one=first: iv.ode45(f, (0, 1), [1.0, 0.0], events=one), ("action of event", 5, 2)),
                (lambda f=osc, one=named: iv.ode45(f, (0, 1), [1.0, 0.0], invariants=one), ("difference", 2, 2)),
            ):
                with pytest.raises(IndexError, match=f"{where[0]}, {beyond.format(*where[1:])}"):
                    call()
            second = iv.SecondOrder(iv.compile(lambda t, q: (-q[3],), by=by))
            with pytest.raises(
                IndexError, match=r"fun, compile\(.*\), at t = 0\.0: index 3 is out of bounds .* size 1\."
            ):
                iv.solve_ivp(second, (0, 1), [1.0, 0.0], "rkn64")
            failed = iv.solve_ensemble(wrong, (0, 1), np.ones((1, 2)), workers=1, on_failure="return")
            assert failed.messages[0].startswith("IndexError: fun, compile(compiled), at t = 0.0: index 5")
            late = iv.solve_ivp(iv.compile(lambda t, y: (y[int(t * 4)], y[1]), by=by), (0, 1), [1.0, 1.0])
            assert late.status == -1
            assert late.t[-1] == pytest.approx(0.5)

    def test_an_output_not_filled_cannot_be_evaluated(self):
        def half(t, y, out):
            out[0] = 1.0

        def raising(t, y, out):
            out[0], out[1] = 1.0, 1.0
            if t >= 0:
                raise ValueError

        for fun, component in ((half, 1), (raising, 0)):
            sol = iv.solve_ivp(iv.compile(fun, inplace=True), (0, 1), [1.0, 1.0])
            assert f"component {component} is NaN" in sol.message

    def test_an_event_that_raises_is_undefined(self):
        def late(t, y):
            if t > 0.5:
                raise ValueError
            return y[0]

        with pytest.raises(ValueError, match="event late returned NaN"):
            iv.solve_ivp(iv.compile(lambda t, y: (1.0,)), (0, 1), [1.0], events=iv.compile(late))

    @pytest.mark.parametrize("mixed", [False, True])
    def test_long_tuples(self, mixed):
        n = 40
        values = ", ".join(f"{i}" if mixed and i % 2 else f"y[{i}] * 0 + {i}" for i in range(n))
        fun = eval(f"lambda t, y: ({values})")
        sol = iv.solve_ivp(iv.compile(fun), (0, 1), np.zeros(n))
        np.testing.assert_allclose(sol.y[:, -1], np.arange(n), rtol=1e-14)

    def test_other_arguments_are_refused(self):
        with pytest.raises(
            TypeError, match=r"compile\(kepler\): it takes \(t, y\), and is called with t, y and 1 args"
        ):
            iv.solve_ivp(iv.compile(kepler), (0, 1), ORBIT, args=(1.0,))
        with pytest.raises(TypeError, match=r"missing .*'p'; without args it is f\(t, y\)"):
            iv.solve_ivp(iv.compile(lambda t, y, p: (p[0],)), (0, 1), [1.0])

        def sorting(t, y, a, b):
            return a * np.sort(y) + b

        with pytest.raises(TypeError, match=r"numpy.sort.*, and numba .* missing .*'b'; with args it is f\(t, y, p\)"):
            iv.solve_ivp(iv.compile(sorting), (0, 1), ORBIT, args=(1.0, 2.0))

    def test_what_is_compiled_already(self):
        again = iv.compile(iv.compile(numba.njit(kepler)))
        assert again.fun is kepler
        assert iv.compile(iv.compile(kepler, inplace=True)).inplace

    def test_threads_compile_one_function_once(self, monkeypatch):
        fun, failed, jitted, njit = iv.compile(lambda t, y: (y[1], -y[0]), by="numba"), [], [], numba.njit

        def slow(*args, **options):
            time.sleep(0.05)  # the others come meanwhile
            jitted.append(args)
            return njit(*args, **options)

        monkeypatch.setattr(numba, "njit", slow)

        def run():
            try:
                iv.solve_ivp(fun, (0, 1), [1.0, 0.0])
            except Exception as error:
                failed.append(error)

        threads = [threading.Thread(target=run) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert failed == []
        assert len(jitted) == 1

    def test_copies_and_pickles_also_after_use(self):
        for fun in (iv.compile(kepler), decorated):
            expected = iv.solve_ivp(fun, (0, 1), ORBIT)
            for one in (copy.copy(fun), copy.deepcopy(fun), pickle.loads(pickle.dumps(fun))):
                np.testing.assert_array_equal(iv.solve_ivp(one, (0, 1), ORBIT).y, expected.y)
        assert pickle.loads(pickle.dumps(decorated)) is decorated
        filled = pickle.loads(pickle.dumps(iv.compile(kepler, inplace=True)))
        assert (filled.fun, filled.inplace) == (kepler, True)


@iv.compile
def decorated(t, y):
    return kepler_jitted(t, y)


kepler_jitted = numba.njit(kepler)


ROOT = iv.compile(lambda t, y: (np.sqrt(1 - t),))


@explicit_and_implicit
def test_nan_is_a_failed_attempt(method):
    sol = iv.solve_ivp(ROOT, (0, 2), [0.0], method)
    assert sol.status == -1
    assert "NaN or infinite" in sol.message
    assert sol.t[-1] == pytest.approx(1, abs=1e-6)


def test_signatures_are_checked_where_they_are_told():
    wrong = numba.cfunc(DOUBLE(DOUBLE))(lambda t: t)
    with pytest.raises(TypeError, match=r"fun has the signature .* expected void \(double t, const double\* y"):
        iv.solve_ivp(wrong, (0, 1), [1.0])
    with pytest.raises(TypeError, match=r"event .* has the signature"):
        iv.solve_ivp(kepler, (0, 1), ORBIT, events=kepler_code)
    told = scipy.LowLevelCallable(wrong.ctypes, signature="double (double)")
    with pytest.raises(TypeError, match=r"fun has the signature double \(double\)"):
        iv.solve_ivp(told, (0, 1), [1.0])
    with pytest.raises(TypeError, match="fun takes 1 arguments"):
        iv.solve_ivp(ctypes.CFUNCTYPE(None, ctypes.c_double)(wrong.address), (0, 1), [1.0])
    with pytest.raises(ValueError, match="null pointer"):
        iv.solve_ivp(CALLBACK(0), (0, 1), [1.0])
    with pytest.raises(ValueError, match="pass value= or names= so that"):
        iv.solve_ivp(kepler, (0, 1), ORBIT, invariants=kepler_code)


SLOW = iv.compile(lambda t, y: (y[1], -y[0]))


def test_another_thread_solves_while_native_code_integrates():
    """A run that nothing but the other thread ends: it could not do so if native code held the interpreter."""
    others = []

    def other():
        time.sleep(0.2)  # the native run is under way
        for fun in (SLOW, lambda t, y: (y[1], -y[0])):
            others.append(iv.solve_ivp(fun, (0, 20), [1, 0], rtol=1e-9))
        _thread.interrupt_main()

    thread = threading.Thread(target=other)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        iv.solve_ivp(SLOW, (0, 1e12), [1, 0], rtol=1e-9, keep="end", max_step=np.inf)
    thread.join()
    native, python = others
    assert native.success
    np.testing.assert_array_equal(native.y, python.y)


def test_ctrl_c_stops_native_code():
    def press():
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        iv.solve_ivp(SLOW, (0, 1e12), [1, 0], rtol=1e-9, keep="end", max_step=np.inf)
    thread.join()
    assert iv.solve_ivp(SLOW, (0, 1), [1, 0]).success


class TestArguments:
    """Values that a compiled function writes to its arguments stay there, as those of a Python function do."""

    @staticmethod
    def honest(t, y, p):
        return y[1], -p[0] * y[0]

    @staticmethod
    def writing(t, y, p):
        slopes = y[1], -p[0] * y[0]
        y[0] = p[0] = 99.0
        return slopes

    @staticmethod
    def energy(t, y, p):
        size = p[0] * y[0] * y[0] + y[1] * y[1]
        y[:] = 99.0
        return size

    @staticmethod
    def gradient(t, y, p):
        rows = 2 * p[0] * y[0], 2 * y[1]
        p[:] = 99.0
        return rows

    @staticmethod
    def crossing(t, y, p):
        value = y[0] * p[0]
        y[1] = 99.0
        return value

    @classmethod
    @functools.cache
    def compiled(cls):
        return [iv.compile(one) for one in (cls.writing, cls.energy, cls.gradient, cls.crossing)]

    @classmethod
    @functools.cache
    def honestly(cls):
        """Return the functions that write nothing."""
        return [
            iv.compile(cls.honest),
            iv.compile(lambda t, y, p: p[0] * y[0] * y[0] + y[1] * y[1]),
            iv.compile(lambda t, y, p: (2 * p[0] * y[0], 2 * y[1])),
            iv.compile(lambda t, y, p: y[0] * p[0]),
        ]

    @pytest.mark.parametrize("method", ["ode45", "ode15s"])
    def test_a_run_is_that_of_functions_that_write_nothing(self, method):
        def solved(f, g, gjac, event):
            law, events = iv.Invariants(g, gjac, names="energy"), iv.Event(event)
            return iv.solve_ivp(f, (0, 2), [1.0, 0.5], method, args=(2.0,), invariants=law, events=events)

        sol, clean = solved(*self.compiled()), solved(*self.honestly())
        assert sol.success, sol.message
        np.testing.assert_array_equal(sol.y, clean.y)
        np.testing.assert_array_equal(sol.t_events[0], clean.t_events[0])

    def test_in_place_too(self):
        def fill(t, y, out, p):
            out[0], out[1] = y[1], -p[0] * y[0]
            y[0] = 99.0

        for fun in (iv.compile(fill, inplace=True), iv.compile(self.honest)):
            sol = iv.solve_ivp(fun, (0, 2), [1.0, 0.0], args=(4.0,), rtol=1e-8, atol=1e-10)
            np.testing.assert_allclose(sol.y[0, -1], np.cos(4), atol=1e-7)

    def test_functions_of_a_fixed_signature_can_be_called(self):
        @numba.njit("float64(float64[::1])")
        def first(y):
            return y[0]

        sol = iv.solve_ivp(iv.compile(lambda t, y: -first(y)), (0, 1), [1.0], rtol=1e-8)
        np.testing.assert_allclose(sol.y[0, -1], np.exp(-1), rtol=1e-6)
