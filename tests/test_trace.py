"""Tracing: the graph of a function has its values, however it is written; what cannot be traced says where and why."""

from __future__ import annotations

import cmath
import functools
import math
import random
import re
from math import cos, sin

import numpy as np
import pytest
from scipy import interpolate

import invariode as iv
from invariode._functions.compiled import as_python
from invariode._functions.graph.python import Formula
from invariode._functions.graph.trace import TraceLimits, trace
from invariode._functions.graph.traced import TraceError
from invariode._functions.layout import ArgumentLayout, layout_of

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


class hidden:  # noqa: N801 - a namespace
    value = 1.0


def test_a_graph_that_is_wrong_in_one_branch_is_found(monkeypatch):
    fun = iv.compile(wrong_in_one_branch, by="trace")
    found = trace(wrong_in_one_branch, 2)
    monkeypatch.setattr(hidden, "value", 2.0)
    monkeypatch.setattr("invariode._functions.graph.trace.trace", lambda *args, **options: found)
    with pytest.raises(TypeError, match=r"cannot be traced: at t = .* its value 0 is"):
        fun.native(2, 2)


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


def branches_everywhere(t, y):
    """Branches that assign, in loops and in each other; that return; conditions of several parts; temporary names."""
    slopes = np.zeros(len(y))
    for i in range(len(y)):
        if y[i] > 0 and not 0.2 < t < 0.3:
            slopes[i] = -y[i]
        elif y[i] < -1 or t > 2:
            twice = 2 * y[i]
            slopes[i] = twice**2
        else:
            slopes[i] += 1.0
    total = sum(slopes)
    if total > 1:
        return slopes / total
    before = total
    if y[0] > y[1]:
        total -= 1
        slopes -= 0.5
    return np.append(slopes[:-1], total - before)


def test_branches_that_assign_or_return_cost_one_path():
    """Seven on components, with conditions of several parts: 2^7 paths and more if they were followed one by one."""
    found = trace(branches_everywhere, 7)
    assert found.paths == 1
    formula = Formula("f", lambda: found.outputs, (7,))
    rng = np.random.default_rng(27)
    for _ in range(50):
        t, y = rng.uniform(0, 3), 1.5 * rng.standard_normal(7)
        np.testing.assert_array_equal(formula(t, y), branches_everywhere(t, y))


def index_by_branch(t, y):
    k = 0 if y[0] > 0 else 1
    return [K[k, 0] * y[0], K[0, k] * y[1]]


def test_branches_that_are_no_selections_are_paths():
    """An index that a branch chooses is known on each path."""
    found = trace(index_by_branch, 2)
    assert found.paths == 2
    formula = Formula("f", lambda: found.outputs, (2,))
    for y in ([1.0, 2.0], [-1.0, 2.0]):
        np.testing.assert_array_equal(formula(0.0, y), index_by_branch(0.0, y))


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
    """In a branch that no other test of the graph reached: at t, in the component; later runs do not look."""
    code = iv.compile(from_outside, by="trace")
    code.native(2, 2)
    monkeypatch.setattr(hidden, "value", 2.0)
    where = r"differs from the function that it was made of: at t = 2\.\d+ its value 1 is"
    with pytest.raises(ValueError, match=where):
        iv.solve_ivp(code, (0, 10), [1.0, 0.0], check="strict")
    with pytest.warns(UserWarning, match=where):
        iv.solve_ivp(code, (0, 10), [1.0, 0.0])
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
