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
from invariode._functions.compiled import as_python
from invariode._functions.graph.python import Formula
from invariode._functions.graph.trace import TraceLimits, trace
from invariode._functions.graph.traced import TraceError
from invariode._functions.layout import ArgumentLayout, layout_of

pytest.importorskip("llvmlite")
from traced_functions import K, hidden, lotka_volterra

LOG: list[float] = []
calls = 0


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
    native = code.native(n, n, ArgumentLayout.single(len(parameters)))
    assert code.how == "trace"
    assert native.address
    formula = Formula("f", lambda: trace(fun, n, layout_of(args)).outputs, (n,))
    rng = np.random.default_rng(27)
    for _ in range(10):
        t, y = rng.random(), rng.standard_normal(n)
        np.testing.assert_allclose(formula(t, y, *args), np.ravel(fun(t, y.copy(), *args)), rtol=1e-13, atol=1e-14)


# ----------------------------------------------------------------------------------------------------------------------
# What is rarely asked for, and easily translated wrongly


def zero_first(d):
    d[0] = 0.0
    return d[1]


def written_by_a_helper(t, y):
    d = -y
    s = zero_first(d) if t < 5 else 0.0
    return [d[0], d[1] + 0 * s]


def augmented_and_rebound(t, y):
    d = -y
    if t < 5:
        d += 1.0
        d = d * 2.0
    return d


def view_that_is_written(t, y):
    d = -y
    a = d[:1]
    if t > 5:
        a[0] = 10.0
        d[1] = 20.0
    return d


def view_that_is_read(t, y):
    d = -y
    q = d[:1]
    if t > 5:
        d[0] = 10.0
        d[1] = q[0] * 2
    return d


def dictionary_of_its_own(t, y):
    state = {"k": 1.0}
    if t < 5:
        state["k"] = 2.0
    return state["k"] * y


def lists_in_a_list(t, y):
    rows = [[y[0], 0.0], [0.0, y[1]]]
    if t > 5:
        rows[0][1] = 3.0
        return [rows[0][1], y[0]]
    return [rows[0][1], y[1]]


def copied_and_flattened(t, y):
    d = -y
    if t > 5:
        for i in range(2):
            z = d.flatten()
            z[i] = 0.0
            np.asarray(d)[i] = float(i)
    return d


def handled(t, y):
    try:
        s = math.sin(t) / t
    except ZeroDivisionError:
        s = 1.0
    return [s * y[0], y[1]]


def of_a_generator(t, y):
    if t > 5:
        return -max(k for k in (1.0, 2.0)) * y
    return -y


def at_least_one_dimension(t, y):
    if t > 5:
        return np.concatenate([np.atleast_1d(-y[0]), -y[1:]])
    return -y


SUBTLE = {
    "written by a helper": written_by_a_helper,
    "augmented and rebound": augmented_and_rebound,
    "a view that is written": view_that_is_written,
    "a view that is read": view_that_is_read,
    "a dictionary of its own": dictionary_of_its_own,
    "lists in a list": lists_in_a_list,
    "copied and flattened": copied_and_flattened,
    "exceptions that are handled": handled,
    "a generator": of_a_generator,
    "at least one dimension": at_least_one_dimension,
    "NaN in maximum": lambda t, y: np.maximum(0.0, np.sqrt(y)),
    "NaN in max": lambda t, y: [np.max(np.log(y)), np.min(np.log(y))],
    "NaN in fmax": lambda t, y: np.fmax(np.sqrt(y), 0.0),
    "quotients": lambda t, y: [(y[0] // 0.1) / 10, y[1] // 0.3],
    "truths": lambda t, y: [((y[0] > 50) + (y[1] > 50)) * 1.0, ((y[0] > 50) | (y[1] < 2)) * 1.0],
    "kept dimensions": lambda t, y: (y.reshape(2, 1) - np.mean(y.reshape(2, 1), 0, keepdims=True)).ravel(),
    "dimensions kept by methods": lambda t, y: (y.reshape(1, 2) - y.reshape(1, 2).max(axis=1, keepdims=True)).ravel(),
    "sums into an array": lambda t, y: np.cumsum(y, out=np.zeros(2)) + 0 * y,
    "order of Fortran": lambda t, y: np.outer(y, [1.0, 2.0]).ravel(order="F")[:2],
    "weights": lambda t, y: [np.average(np.abs(y), weights=[1.0, 3.0]), y[0]],
    "complex roots": lambda t, y: [np.sqrt(y[0] + 1j * y[1]).imag, np.sqrt(y[0] + 1j * y[1]).real],
    "complex powers": lambda t, y: [abs((y[0] + 1j * y[1]) ** 1.5), ((y[0] + 1j * y[1]) ** 0.5).real],
    "a table of one point": lambda t, y: -np.interp(t, [0.0], [5.0]) * y,
}  # fmt: skip
PLACES = [
    *((t, y) for t in (0.0, 6.0) for y in ([1.0, 2.0], [60.0, 60.0], [-1.0, 1e-7], [1.0, -1.0], [1.0, 1e-9])),
    (6.0, [0.0, 0.0]),
]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", SUBTLE)
def test_values_are_right_at_points_that_are_not_compared_or_there_is_no_graph(name):
    fun = SUBTLE[name]
    code = iv.compile(fun, by="trace")
    try:
        compiled = as_python(code.native(2, 2), 2)
    except TypeError as refused:
        assert 'leave by="trace" out' in str(refused)
        return
    for t, y in PLACES:
        try:
            expected = np.ravel(fun(t, np.array(y)))
        except (ArithmeticError, ValueError):
            expected = np.full(2, np.nan)
        np.testing.assert_allclose(
            compiled(t, np.array(y), np.zeros(0)), expected, rtol=1e-9, atol=1e-300, err_msg=f"at t = {t}, y = {y}"
        )


def test_an_integer_that_is_asked_for_its_bits_is_a_constant():
    bits = iv.compile(lambda t, y, k: (-1.0 if k & 1 else -2.0) * y)
    ends = [iv.solve_ivp(bits, (0, 1), [1.0], args=(k,), rtol=1e-8).y[0, -1] for k in (1, 2, 3)]
    np.testing.assert_allclose(ends, np.exp([-1.0, -2.0, -1.0]), rtol=1e-6)


def test_functions_that_are_seldom_defined_are_compared_too():
    def event(t, y):
        return np.average([math.sqrt(v) for v in y], weights=np.arange(1.0, 9.0)) - 2

    plain, code = (
        iv.solve_ivp(lambda t, y: np.ones(8), (0, 5), np.linspace(0.5, 3, 8), events=one).t_events[0]
        for one in (event, iv.compile(event))
    )
    np.testing.assert_allclose(code, plain, rtol=1e-9)


@pytest.mark.parametrize("name", ["arguments", "kinks", "loops", "matrices", "callable object", "math"])
@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # of math.floor
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
    two = trace(lambda t, q, v, k: [k * q[0] + v[1], q[1] * v[0]], 4, layout_of((0.5,)), second=2)
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
        iv.compile(fun, by="trace").native(2, 2)
    if what not in ("a count of calls", "random", "complex numbers"):
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
        (TraceLimits(paths=3), "more than 3 paths"),
        (TraceLimits(decisions=2), "more than 2 decisions"),
        (TraceLimits(nodes=10), "more than 10 operations"),
        (TraceLimits(operations=20), "more than 20 operations"),
    ],
)
def test_each_limit_is_named(limits, why):
    with pytest.raises(TraceError, match=why):
        trace(switched, 7, limits=limits)


def halved(x):
    return x if x < 0.1 else 0.5 * halved(x - 0.1)


def test_recursion_on_values_is_refused_in_our_own_words():
    """Recursion whose depth is known is traced; that which ends where values do is left to numba, which has none either
    of a function without a declared type."""
    pytest.importorskip("numba")

    def power(x, n):
        return x if n == 0 else x * power(x, n - 1)

    known = iv.compile(lambda t, y: [-power(y[0], 2)], by="trace")
    np.testing.assert_allclose(iv.solve_ivp(known, (0, 1), [1.0], rtol=1e-8).y[0, -1], 3**-0.5, rtol=1e-6)
    with pytest.raises(TypeError, match="cannot compile this function"):
        iv.solve_ivp(iv.compile(lambda t, y: [-halved(y[0])]), (0, 1), [1.0])


def wrong_in_one_branch(t, y):
    """The trace sees a constant: `kind` is read where tracing does not look."""
    return [-y[0] * hidden.value if y[0] > 0 else y[0], y[1]]


def test_a_graph_that_is_wrong_in_one_branch_is_found(monkeypatch):
    fun = iv.compile(wrong_in_one_branch, by="trace")
    found = trace(wrong_in_one_branch, 2)
    monkeypatch.setattr(hidden, "value", 2.0)
    monkeypatch.setattr("invariode._functions.graph.trace.trace", lambda *args, **options: found)
    with pytest.raises(TypeError, match=r"cannot be traced: at t = .* its value 0 is"):
        fun.native(2, 2)
