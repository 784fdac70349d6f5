"""Tracing: the graph of a function has its values, however it is written; what cannot be traced says where and why."""

from __future__ import annotations

import functools
import math
import random
import re
from math import cos, sin

import numpy as np
import pytest

import invariode as iv
from invariode._functions.graph.python import Formula
from invariode._functions.graph.trace import Limits, trace
from invariode._functions.graph.traced import TraceError
from invariode._functions.layout import arguments_of

pytest.importorskip("llvmlite")

K = np.array([[1.0, 2.0], [3.0, -4.0]])
LOG: list[float] = []
calls = 0


def lotka_volterra(t, z, a, b, c, d):
    x, y = z
    return [a * x - b * x * y, -c * y + d * x * y]


def branching(t, y):
    if y[0] > 0 and t < 0.5:
        a = y[1]
    elif y[1] > 1:
        a = -y[0]
    else:
        a = abs(y[0])
    slopes = np.zeros(2)
    slopes[0] = a
    slopes[1] = max(y[0], y[1], 0.1) + (1.0 if 0 < y[1] <= 2 else y[0])
    return slopes


def kinks(t, y):
    """Branches that meet continuously."""
    force = -y[0] if y[0] > 0 else -0.5 * y[0]
    if y[1] > 0.2:
        force -= y[1] - 0.2
    return [y[1], force + max(t - 0.2, 0.0)]


def heat(t, u):
    n = len(u)
    slopes = np.zeros_like(u)
    slopes[1:-1] = u[2:] - 2 * u[1:-1] + u[:-2]
    slopes[0] = slopes[-1] = 0
    return slopes * (n - 1) ** 2


def bodies(t, y):
    r, v = y[:6].reshape(3, 2), y[6:].reshape(3, 2)
    a = np.zeros((3, 2))
    for i in range(3):
        for j in range(3):
            if i != j:
                d = r[j] - r[i]
                a[i] += d / (np.sum(d**2) + 0.1) ** 1.5
    return np.concatenate([v.ravel(), a.ravel()])


def switched(t, y):
    """Seven independent decisions, and a loop with an end that is known."""
    slopes = []
    for one in y:
        if one > 0:
            slopes.append(-one)
        else:
            slopes.append(one**2)
    return np.array(slopes)


def elementwise(t, y):
    smooth = np.where(y > 0, y, -y) * np.exp(-t) + np.roll(y, 1) - np.mean(y) + np.sum([y[0], y[1]])
    return smooth + np.clip(y, -1, 1) + np.maximum(y, 0.2) + (y > 0.5) * y + np.sign(y) * np.hypot(y, 1)


def with_tables(t, y):
    return [np.heaviside(y[0], 0.5) * y[1], np.clip(y[1], -1, 1) + np.interp(y[0], [0, 1, 2], [1, 3, 2])]


def solved(t, y):
    matrix = np.array([[2.0 + sin(y[0]), 1.0], [1.0, 3.0]])
    return np.linalg.solve(matrix, [y[1], np.linalg.norm(y)])


def by_math(t, y):
    r = math.sqrt(y[0] ** 2 + y[1] ** 2)
    return math.atan2(y[1], y[0]) + r, math.exp(-r) * cos(t) + math.log1p(r) + math.pow(r, 1.5) + math.floor(y[0])


def not_everywhere(t, y):
    """The branch that is taken where the root is not defined raises in Python."""
    return [math.sqrt(y[0]) if y[0] > 0 else -y[1], y[1]]


def filling(t, y, out):
    out[0] = y[1]
    out[1] = -sin(y[0])


class System:
    def __init__(self):
        self.k, self.A = 2.0, np.eye(2) + 0.1

    def force(self, x):
        out = np.zeros(2)
        out[0] = math.sin(x[0])
        out[1] = cos(x[1])
        return out * self.k

    def __call__(self, t, y):
        return self.A.dot(self.force(y))

    def method(self, t, y):
        return helper(self.force(y))


def helper(x):
    return [x[1], np.where(x[0] > 0, x[0], -x[0])]


def closure(k):
    rates = {"a": k, "b": np.array([1.0, 2.0])}
    return lambda t, y: rates["a"] * rates["b"] * y[::-1]


FUNCTIONS = {
    "arguments": (lotka_volterra, 2, (1.5, 1.0, 3.0, 1.0)),
    "partial": (functools.partial(lotka_volterra, a=1.0, b=2.0, c=3.0, d=4.0), 2, ()),
    "array argument": (lambda t, y, p: [p[0] * y[1], -p[1] * y[0]], 2, (np.array([2.0, 3.0]),)),
    "one argument": (lambda t, y, mu: np.array([y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]]), 2, (3.0,)),
    "branches": (branching, 2, ()),
    "kinks": (kinks, 2, ()),
    "slices": (heat, 10, ()),
    "loops": (bodies, 12, ()),
    "seven decisions": (switched, 7, ()),
    "arrays": (elementwise, 7, ()),
    "tables": (with_tables, 2, ()),
    "matrices": (lambda t, y: K @ y + np.sin(t) * np.dot(K, y) + np.linalg.norm(y) * np.ones(2), 2, ()),
    "linear systems": (solved, 2, ()),
    "math": (by_math, 2, ()),
    "undefined branch": (not_everywhere, 2, ()),
    "callable object": (System(), 2, ()),
    "method": (System().method, 2, ()),
    "closure": (closure(2.0), 2, ()),
    "number": (lambda t, y: -2 * y[0] + t, 1, ()),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_compiled_function_has_the_values_of_the_function(name):
    fun, n, args = FUNCTIONS[name]
    code = iv.compile(fun, by="trace")
    parameters = np.concatenate([np.zeros(0), *map(np.ravel, args)])
    native = code.native(n, n, len(parameters), False)
    assert code.how == "trace"
    assert native.address
    formula = Formula("f", lambda: trace(fun, n, arguments_of(args)).outputs, (n,))
    rng = np.random.default_rng(27)
    for _ in range(10):
        t, y = rng.random(), rng.standard_normal(n)
        np.testing.assert_allclose(formula(t, y, *args), np.ravel(fun(t, y.copy(), *args)), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", ["arguments", "kinks", "loops", "matrices", "callable object", "math"])
def test_runs_are_those_of_the_function(name):
    fun, n, args = FUNCTIONS[name]
    y0 = np.linspace(0.4, 1.3, n)
    options = {"args": args, "rtol": 1e-5, "atol": 1e-8}
    plain, code = (iv.solve_ivp(f, (0, 0.5), y0, **options) for f in (fun, iv.compile(fun, by="trace")))
    assert plain.success == code.success
    np.testing.assert_allclose(code.y[:, -1], plain.y[:, -1], rtol=1e-7)


def test_functions_that_fill_an_output_and_take_two_vectors():
    out = np.zeros(2)
    filling(0.3, [0.5, 0.7], out)
    found = Formula("f", lambda: trace(filling, 2, inplace=2).outputs, (2,))
    np.testing.assert_array_equal(found(0.3, [0.5, 0.7]), out)
    two = trace(lambda t, q, v, k: [k * q[0] + v[1], q[1] * v[0]], 4, arguments_of((0.5,)), second=2)
    np.testing.assert_array_equal(Formula("f", lambda: two.outputs, (2,))(0.0, [1, 2, 3, 4], 0.5), [4.5, 6.0])


def test_derivatives_of_a_traced_function_are_exact():
    """The Jacobian that an implicit method uses, against the one written by hand: the same steps."""
    mu = 50.0
    code = iv.compile(lambda t, y, mu: [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]], by="trace")

    def jac(t, y, mu):
        return [[0, 1], [-2 * mu * y[0] * y[1] - 1, mu * (1 - y[0] ** 2)]]

    runs = [iv.solve_ivp(code, (0, 60), [2.0, 0.0], "radau", args=(mu,), jac=j, rtol=1e-6) for j in (None, jac)]
    assert runs[0].stats.jacobian == "traced"
    assert runs[0].stats.steps == runs[1].stats.steps
    np.testing.assert_allclose(runs[0].y, runs[1].y, rtol=1e-7, atol=1e-9)


def counted(t, y):
    global calls
    calls += 1
    return -y


def logged(t, y):
    LOG.append(t)
    return -y


class Counter:
    def __init__(self):
        self.count = 0

    def __call__(self, t, y):
        self.count += 1
        return -y


def newton(t, y):
    x = y[0]
    while abs(x * x - y[1]) > 1e-12:
        x = (x + y[1] / x) / 2
    return [x, -y[1]]


def overwriting(t, y):
    K[0, 0] = t
    return K @ y


REFUSED = {
    "a loop that ends where values do": (newton, r"more than 60 decisions on one path.*"),
    "a count of calls": (counted, "writes to calls, which is not its own"),
    "an outer list": (logged, "writes to a list that it does not make"),
    "an attribute": (Counter(), "writes to attributes of Counter"),
    "an outer array": (overwriting, "writes to an array that it does not make"),
    "print": (lambda t, y: print(t) or -y, r"print\(\)"),
    "numpy.random": (lambda t, y: -y * np.random.default_rng().random(), r"numpy\.random"),
    "random": (lambda t, y: -y * random.random(), "It may be random"),
    "complex numbers": (lambda t, y: y * 1j, "complex"),
    "an index that depends on values": (lambda t, y: [K[int(y[0]), 0], y[1]], r"int\(\)|a value"),
    "fft": (lambda t, y: np.fft.fft(y).real, "numpy.fft"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_traced_says_at_which_line_and_why(what):
    fun, why = REFUSED[what]
    with pytest.raises(TypeError, match=why) as refused:
        iv.compile(fun, by="trace").native(2, 2, 0, False)
    if what not in ("a count of calls", "random"):
        assert re.search(rf"at line \d+ of .*{re.escape('test_trace.py')}", str(refused.value))
    assert 'leave by="trace" out' in str(refused.value)
    assert LOG == []


def test_numba_compiles_what_cannot_be_traced():
    pytest.importorskip("numba")
    code = iv.compile(newton)
    sol = iv.solve_ivp(code, (0, 1), [1.0, 2.0], rtol=1e-6)
    assert sol.success
    assert code.how.startswith("numba, as newton cannot be traced")
    assert iv.compile(newton, by="numba").how == "numba"


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        (Limits(paths=3), "more than 3 paths"),
        (Limits(decisions=2), "more than 2 decisions"),
        (Limits(nodes=10), "or 10 operations"),
        (Limits(seconds=0.0), r"more than 0.0 s"),
    ],
)
def test_each_limit_is_named(limits, why):
    with pytest.raises(TraceError, match=why):
        trace(switched, 7, limits=limits)


def wrong_in_one_branch(t, y):
    """The trace sees a constant: `kind` is read where tracing does not look."""
    return [-y[0] * hidden.value if y[0] > 0 else y[0], y[1]]


class hidden:  # noqa: N801 - a namespace
    value = 1.0


def test_a_graph_that_is_wrong_in_one_branch_is_found(monkeypatch):
    fun = iv.compile(wrong_in_one_branch, by="trace")
    found = trace(wrong_in_one_branch, 2)
    monkeypatch.setattr(hidden, "value", 2.0)
    monkeypatch.setattr("invariode._functions.graph.function.trace", lambda *args, **options: found)
    with pytest.raises(TypeError, match=r"cannot be traced: at t = .* its value 0 is"):
        fun.native(2, 2, 0, False)


class Spring:
    def __init__(self, k):
        self.k = k

    def force(self, x):
        return -self.k * x


def many_kinds(t, y, a, matrix, options, spring, count, pair, damped):
    slopes = np.zeros(2)
    for i in range(count):
        slopes[i] = options["drive"] * np.sin(t) - a * y[i]
    low, high = pair
    slopes += np.array([low * y[1], spring.force(y[0]) + high])
    return matrix @ slopes - (0.1 * y if damped else 0)


KINDS = (2.0, np.array([[1.0, 0.2], [0.3, 1.0]]), {"drive": 0.5}, Spring(3.0), 2, [0.3, 0.4], True)


def ends(fun, args, **options):
    return iv.solve_ivp(fun, (0, 1), [1.0, 0.5], args=args, rtol=1e-7, atol=1e-9, **options).y[:, -1]


def test_arguments_of_any_kind_are_those_of_the_function():
    """Numbers are parameters, everything else is a constant; another value of either is noticed."""
    code = iv.compile(many_kinds, by="trace")
    changes = [{}, {0: 2.5}, {1: np.eye(2)}, {2: {"drive": 0.7}}, {3: Spring(1.0)}, {4: 1}, {5: (0.1, 0.2)}, {6: False}]
    for change in changes:
        args = tuple(change.get(i, one) for i, one in enumerate(KINDS))
        np.testing.assert_allclose(ends(code, args), ends(many_kinds, args), rtol=1e-9, err_msg=repr(change))
    options = KINDS[2]
    before = ends(code, KINDS)
    options["drive"] = 0.9
    after = ends(code, KINDS)
    np.testing.assert_allclose(after, ends(many_kinds, KINDS), rtol=1e-9)
    options["drive"] = 0.5
    assert abs(after - before).max() > 1e-3


def test_events_invariants_jacobians_and_actions_take_the_same_arguments():
    def fun(t, y, k, names):
        return [y[1], -k[names["stiffness"]] * y[0]]

    def energy(t, y, k, names):
        return y[1] ** 2 + k[names["stiffness"]] * y[0] ** 2

    def jac(t, y, k, names):
        return [[0, 1], [-k[names["stiffness"]], 0]]

    def turning(t, y, k, names):
        return y[1] - 0.1 * k[0]

    def kick(t, y, k, names):
        return np.array([y[0], y[1] + k[0]])

    def run(wrap):
        return iv.solve_ivp(
            wrap(fun),
            (0, 6),
            [1.0, 0.0],
            "ode15s",
            args=(np.array([0.2, 4.0]), {"stiffness": 1}),
            invariants=iv.Invariants(wrap(energy), names="energy"),
            events=iv.Event(wrap(turning)),
            jac=wrap(jac),
            breakpoints=[(3.0, wrap(kick))],
            rtol=1e-6,
        )

    plain, code = run(lambda f: f), run(lambda f: iv.compile(f, by="trace"))
    assert plain.stats.steps == code.stats.steps
    assert len(code.t_events[0]) == len(plain.t_events[0]) > 2
    np.testing.assert_allclose(code.t_events[0], plain.t_events[0], rtol=1e-9)
    np.testing.assert_allclose(code.y[:, -1], plain.y[:, -1], rtol=1e-9)


def test_inputs_come_before_arguments():
    u = iv.Input([0.0, 1.0, 2.0], [[0.0, 1.0], [1.0, 0.0], [2.0, 0.5]], kind="linear")
    for fun in (lambda t, y, u, a, b: [u[0] * a["k"] - b * y[0] + u[1]], lambda t, y, *p: [p[0][0] - p[2] * y[0]]):
        runs = [
            iv.Problem(one, (0, 2), [1.0], args=({"k": 2.0}, 0.5), inputs=u).solve("ode45", rtol=1e-6)
            for one in (fun, iv.compile(fun, by="trace"))
        ]
        np.testing.assert_allclose(runs[1].y[:, -1], runs[0].y[:, -1], rtol=1e-12)


def test_arguments_that_do_not_fit_one_by_one_are_one_array():
    code = iv.compile(lambda t, y, p: [p[0] * y[1] - p[2], -p[1] * y[0]], by="trace")
    np.testing.assert_allclose(ends(code, (1.0, [2.0, 3.0])), ends(lambda t, y, *_: code(t, y, [1.0, 2.0, 3.0]), ()))


def test_an_undefined_path_is_not_a_wrong_number_of_arguments():
    """p is all arguments where p[0] is asked for, even if another path needs no p."""
    code = iv.compile(lambda t, y, p: y if t < 2 else p[0] * y, by="trace")
    end = iv.solve_ivp(code, (0, 3), [1.0], args=(2.0,), breakpoints=[2.0], rtol=1e-6, atol=1e-8).y[0, -1]
    assert math.isclose(end, math.exp(4), rel_tol=1e-4)


def test_prepared_solvers_and_ensembles_notice_arguments_that_are_constants():
    rows = [(a, *KINDS[1:]) for a in (1.0, 2.0, 3.0)]
    code = iv.compile(many_kinds, by="trace")
    found = iv.solve_ensemble(code, (0, 1), [[1.0, 0.5]] * 3, args=rows, rtol=1e-7, atol=1e-9)
    for row, end in zip(rows, found.y_end, strict=True):
        np.testing.assert_allclose(end, ends(many_kinds, row), rtol=1e-9)
    solver = iv.Problem(code, (0, 1), [1.0, 0.5], args=KINDS).prepare("ode45", rtol=1e-7, atol=1e-9)
    for i, value in ((2, {"drive": 0.1}), (4, 1)):
        other = (*KINDS[:i], value, *KINDS[i + 1 :])
        np.testing.assert_allclose(solver(args=other).y[:, -1], ends(many_kinds, other), rtol=1e-9)
        with pytest.raises(ValueError, match="args of a compiled ensemble"):
            iv.solve_ensemble(code, (0, 1), [[1.0, 0.5]] * 2, args=[KINDS, other])


def test_ensembles_vary_the_arguments_without_compiling_again():
    code = iv.compile(lotka_volterra, by="trace")
    args = np.linspace([1.0, 1.0, 2.0, 0.8], [1.5, 1.2, 3.0, 1.0], 5)
    found = iv.solve_ensemble(code, (0, 2), [[1.0, 2.0]] * 5, args=args, rtol=1e-6)
    for row, end in zip(args, found.y_end, strict=True):
        expected = iv.solve_ivp(lotka_volterra, (0, 2), [1.0, 2.0], args=tuple(row), rtol=1e-6)
        np.testing.assert_allclose(end, expected.y[:, -1], rtol=1e-10)
