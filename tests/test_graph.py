"""Expression graphs: Python's code, machine code and lanes have the same values, and derivatives are exact."""

from __future__ import annotations

import ctypes
import math
import pickle
from collections import OrderedDict
from functools import partial
from mmap import PAGESIZE
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import invariode as iv
from cases import families
from invariode._functions.compiled import as_python
from invariode._functions.graph.derived import Derived, derived
from invariode._functions.graph.differentiation import dependences, gradient, jacobian, tangent
from invariode._functions.graph.function import GraphFunction
from invariode._functions.graph.nodes import ELEMENTARY, Graph, in_order
from invariode._functions.graph.python import Formula, as_text
from invariode._functions.graph.rolled import rolled
from invariode._functions.layout import ArgumentLayout

machine = pytest.importorskip("invariode._functions.graph.machine")
objects = pytest.importorskip("invariode._functions.graph.objects")
codes = pytest.importorskip("invariode._functions.graph.codes")

EPS = np.finfo(float).eps
#: Operations that are exact or correctly rounded: all codes must have the same bits.
ROUNDED = ("add", "subtract", "multiply", "divide", "sqrt", "abs", "negate", "floor", "sign", "minimum", "maximum")
SMOOTH = (*(name for name in ELEMENTARY if name not in ("acosh", "asin", "acos", "atanh")), "atan2", "hypot", "power")
#: Arguments between -0.9 and 0.9 for some, above 1 for one.
NARROW = {"asin", "acos", "atanh"}
N, P = 3, 2
Y, ARGS, TIME = [0.7, -1.3, 2.1], [1.6, 0.4], 0.3


def applied(graph, name, a, b):
    """An operation on one or two nodes."""
    if name in ("add", "subtract", "multiply", "divide"):
        return {"add": a + b, "subtract": a - b, "multiply": a * b, "divide": a / b}[name]
    if name == "negate":
        return -a
    if name == "power":
        return graph.power(a * a + 0.5, b)
    if name in NARROW:
        return graph.elementary(name, a / (1.5 + graph.make("abs", a)))
    if name == "acosh":
        return graph.elementary(name, a * a + 1.5)
    if name in ("sqrt", "log", "log10", "log1p", "log2", "cbrt"):
        return graph.elementary(name, a * a + 0.25)
    if name in ELEMENTARY:  # what grows fast gets small arguments
        return graph.elementary(name, a / (2.0 + graph.make("abs", a)) if name in _FAST else a)
    return graph.make(name, a, b) if name in ("atan2", "hypot", "minimum", "maximum", "modulo") else graph.make(name, a)


_FAST = {"exp", "exp2", "expm1", "sinh", "cosh", "tan"}


@st.composite
def graphs(draw, names, select=True):
    """A few values of a random graph of operations on t, y, p and numbers."""
    graph = Graph()
    nodes = [graph.t, *(graph.y(i) for i in range(N)), *(graph.p(i) for i in range(P)), graph.node(0.5)]
    for _ in range(draw(st.integers(3, 25))):
        a, b, c = (nodes[draw(st.integers(0, len(nodes) - 1))] for _ in range(3))
        name = draw(st.sampled_from([*names, *(["select"] if select else [])]))
        made = graph.select(graph.make("less", a, b), b, c) if name == "select" else applied(graph, name, a, b)
        nodes.append(made)
    return nodes[-3:]


def in_python(outputs, t=TIME, y=Y, p=ARGS):
    return np.array(Formula("f", lambda: outputs, (len(outputs),))(t, y, *p))


def compiled(outputs, **form):
    """(t, y, p) → values, by machine code."""
    code = codes.machine_code(outputs, objects.CodeForm(**form))
    kinds = [ctypes.c_double, *[ctypes.c_void_p] * 3] if form.get("lanes", 1) == 1 else [ctypes.c_void_p] * 5
    call = ctypes.CFUNCTYPE(None, *kinds)(code.address)

    def evaluate(t, y, p):
        y, p = np.ascontiguousarray(y), np.ascontiguousarray(p, dtype=float)
        out = np.empty((len(outputs), *y.shape[1:]))
        time = t if len(kinds) == 4 else np.ascontiguousarray(t).ctypes.data
        given = (time, y.ctypes.data, out.ctypes.data, p.ctypes.data)
        call(*given) if len(kinds) == 4 else call(None, *given)
        assert code.owner is not None
        return out

    return evaluate


RANDOM = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@RANDOM
@given(graphs(ROUNDED))
def test_machine_code_has_the_bits_of_python(outputs):
    """For operations that are correctly rounded. Python raises where the machine has inf: then its values are NaN."""
    expected = in_python(outputs)
    if np.isfinite(expected).all():
        np.testing.assert_array_equal(compiled(outputs)(TIME, np.array(Y), ARGS), expected)


@RANDOM
@given(graphs((*ROUNDED, *SMOOTH, *NARROW, "acosh", "modulo")), st.sampled_from([2, 4, 8]))
def test_lanes_have_the_bits_of_one_at_a_time(outputs, lanes):
    rng = np.random.default_rng(27)
    y = rng.uniform(-2, 2, (N, lanes))
    p = rng.uniform(0.5, 2, (P, lanes))
    t = rng.uniform(0, 1, lanes)
    one = compiled(outputs)
    alone = [one(t[i], y[:, i].copy(), p[:, i].copy()) for i in range(lanes)]
    np.testing.assert_array_equal(compiled(outputs, lanes=lanes)(t, y, p), np.transpose(alone))


def exactly(node, y, t=TIME):
    """The value of a node in 40 digits."""
    text = as_text("f", [node])
    names = {
        name: getattr(mpmath, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan")
    }
    names |= {
        name: getattr(mpmath, name) for name in ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "erfc")
    }
    names |= {name: getattr(mpmath, name) for name in ("expm1", "log1p", "log10", "atan2", "hypot")}
    names |= {"pow": mpmath.power, "cbrt": mpmath.cbrt, "exp2": lambda x: mpmath.power(2, x)}
    names |= {"log2": lambda x: mpmath.log(x, 2)}
    exec(text, names)
    return names["f"](mpmath.mpf(t), y, [mpmath.mpf(one) for one in ARGS])[0]


@RANDOM
@given(graphs(("add", "multiply", "divide", "negate", *SMOOTH, *NARROW, "acosh"), select=False))
def test_derivatives_are_those_of_40_digits(outputs):
    """Within the roundoff of the value's own terms: forwards, backwards and along a direction."""
    output = outputs[-1]
    variables = [output.graph.y(i) for i in range(N)]
    row = jacobian([output], variables)[0]
    back = gradient(output, variables)
    assert {*row} >= {*back}
    direction = np.array([0.3, -0.7, 1.1])
    along = tangent([output], {y: output.graph.node(float(d)) for y, d in zip(variables, direction, strict=True)})
    with mpmath.workdps(40):
        point = [mpmath.mpf(one) for one in Y]

        def partial(i):
            return mpmath.diff(lambda x: exactly(output, [*point[:i], x, *point[i + 1 :]]), point[i])

        exact = [float(partial(i)) for i in range(N)]
    if not np.isfinite(exact).all():
        return
    zero = output.graph.node(0.0)
    values = in_python([row.get(i, zero) for i in range(N)])
    backwards = in_python([back.get(i, zero) for i in range(N)])
    size = max(1.0, np.abs(exact).max())
    condition = 1e4  # of sums that cancel, in graphs of this length
    np.testing.assert_allclose(values, exact, rtol=0, atol=condition * EPS * size)
    np.testing.assert_allclose(backwards, exact, rtol=0, atol=condition * EPS * size)
    assert in_python(along)[0] == pytest.approx(exact @ direction, abs=condition * EPS * size)


@pytest.mark.slow
@settings(RANDOM, max_examples=15)
@given(graphs(("add", "multiply", "divide", "negate", "sin", "exp", "power", "atan2"), select=False))
def test_functions_for_derivatives_along_a_direction_are_those_of_40_digits(outputs):
    """∂/∂t, products with ∂/∂y, and the first and second derivative along (dt, dy), as compiled functions."""
    output, direction = outputs[-1], [0.3, -0.7, 1.1]
    made = Derived("f", [output], N, "own")
    y = np.array(Y)

    def value(function, point):
        code = function.native(len(point), 1, ArgumentLayout.single(P))
        return as_python(code, 1)(TIME, np.array(point), np.array(ARGS))[0]

    with mpmath.workdps(40):

        def along(s, dt, dy):
            point = [mpmath.mpf(a) + s * mpmath.mpf(b) for a, b in zip(Y, dy, strict=True)]
            return exactly(output, point, mpmath.mpf(TIME) + s * mpmath.mpf(dt))

        rate, product, slope, curvature = (
            float(mpmath.diff(partial(along, dt=dt, dy=dy), 0, order))
            for dt, dy, order in ((1, [0] * N, 1), (0, direction, 1), (0.5, direction, 1), (0.5, direction, 2))
        )
    exact = [rate, product, slope, curvature]
    if not np.isfinite(exact).all():
        return
    found = [
        value(made.rate(), y),
        value(made.product(), [*y, *direction]),
        value(made.slope(), [*y, 0.5, *direction]),
        value(made.curvature(), [*y, 0.5, *direction]),
    ]
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e5 * EPS * max(1.0, np.abs(exact).max()))


def test_equal_nodes_are_one_and_identities_are_exact():
    graph = Graph()
    x, y = graph.y(0), graph.y(1)
    once, again = (x * y + 1.0 for _ in range(2))
    assert once is again
    negative = -x
    assert {x * 1.0, 1.0 * x, x / 1.0, x - 0.0, -negative} == {x}
    assert (x + 0.0).op == "add"  # -0 + 0 is 0
    assert (x * 0.0).op == "multiply"  # inf and NaN times 0
    assert graph.node(0.0) is not graph.node(-0.0)
    assert x**3 == x * (x * x) or x**3 == (x * x) * x
    assert (graph.node(2.0) ** 0.5).value == math.sqrt(2)
    assert graph.select(graph.make("less", x, y), x, x) is x
    assert (graph.node(1.0) / 0.0).op == "divide"


def test_the_branch_that_is_not_taken_spoils_nothing():
    """Neither the value nor the derivative: √x has neither below 0."""
    graph = Graph()
    x = graph.y(0)
    root = graph.select(graph.make("less", graph.node(0.0), x), graph.elementary("sqrt", x) * x, -x)
    values = [root, *jacobian([root], [x])[0].values(), *gradient(root, [x]).values()]
    for y, expected in ((-4.0, (4.0, -1.0, -1.0)), (4.0, (8.0, 3.0, 3.0))):
        np.testing.assert_array_equal(in_python(values, y=[y]), expected)
        np.testing.assert_array_equal(compiled(values)(0.0, np.array([y]), []), expected)


def test_linear_systems_are_solved_and_differentiated():
    graph = Graph()
    y = [graph.y(i) for i in range(3)]
    matrix = [[y[0] + 3.0, y[1], y[2]], [y[2], y[0] * 0.0, y[1] - 2.0], [graph.node(1.0), y[2] * y[2], y[0]]]
    solved = [row[0] for row in graph.solve(matrix, [[y[1]], [y[0]], [graph.node(1.0)]])]
    rows = jacobian(solved, y)
    values = [*solved, *(row[j] for row in rows for j in range(3))]

    def exact(point):
        a, b, c = point
        return np.linalg.solve([[a + 3, b, c], [c, 0, b - 2], [1, c * c, a]], [b, a, 1])

    point = np.array([0.4, 1.1, -0.6])
    slopes = np.transpose([(exact(point + e) - exact(point - e)) / 2e-6 for e in 1e-6 * np.eye(3)])
    for found in (in_python(values, y=point), compiled(values)(0.0, point, [])):
        np.testing.assert_allclose(found[:3], exact(point), rtol=1e-13)
        np.testing.assert_allclose(found[3:].reshape(3, 3), slopes, rtol=1e-8, atol=1e-8)
    singular = [row[0] for row in graph.solve([[y[0], y[0]], [y[0], y[0]]], [[y[1]], [y[2]]])]
    assert np.isnan(in_python(singular)).all()
    assert np.isnan(compiled(singular)(0.0, np.array(Y), [])).all()


def test_long_graphs_are_compiled_in_blocks_and_right():
    graph = Graph()
    total = graph.y(0)
    for i in range(1, 4000):
        total = total + graph.y(1) * (i % 7)
    outputs = [total, total * total]
    assert len([*in_order(outputs)]) > machine._OPTIMISED
    np.testing.assert_array_equal(compiled(outputs)(0.0, np.array([0.5, 0.1]), []), in_python(outputs, y=[0.5, 0.1]))


@st.composite
def repeating(draw):
    """Values of many components by one random formula each, of neighbours, parameters, numbers and shared values."""
    graph, n = Graph(), 60
    near, far = draw(neighbours(n)), draw(neighbours(n))
    y, numbers = [graph.y(i) for i in range(n)], draw(st.sampled_from([[2.5] * 3, [1.0, -2.0, 0.5]]))
    steps = [
        (
            draw(st.sampled_from([*ROUNDED[:4], "minimum", "select", "sin"])),
            draw(st.integers(0, 5)),
            draw(st.integers(0, 5)),
        )
        for _ in range(draw(st.integers(2, 7)))
    ]
    shared = draw(
        st.sampled_from([y, [one * graph.p(0) for one in y], [b - a for a, b in zip(y, y[1:] + y[:1], strict=True)]])
    )
    p = draw(st.sampled_from([[0], [0, 1]]))
    outputs = []
    for i in range(n):
        nodes = [y[i], shared[near[i]], y[far[i]], graph.p(p[i % len(p)]), graph.node(numbers[i % 3]), graph.t]
        for name, one, other in steps:
            a, b = nodes[one], nodes[-1 - other]
            made = graph.select(graph.make("less", a, b), b, a + b) if name == "select" else applied(graph, name, a, b)
            nodes.append(made)
        outputs.append(nodes[-1])
    return [*outputs, *outputs[: n // 3]]


@st.composite
def neighbours(draw, n):
    """An index for each of n components: on a ring, on a line, on a grid, strided, or any."""
    shift, width = draw(st.integers(-3, 3)), draw(st.sampled_from([5, 12, 20]))
    places = np.arange(n)
    grid = places.reshape(-1, width)
    return draw(
        st.sampled_from(
            [
                np.roll(places, shift),
                np.clip(places + shift, 0, n - 1),
                np.roll(grid, shift, 0).ravel(),
                np.roll(grid, shift, 1).ravel(),
                np.clip(grid + shift, grid[:, :1], grid[:, -1:]).ravel(),
                2 * places % n,
                places[::-1],
                np.random.default_rng(width).permutation(n),
            ]
        )
    ).tolist()


@settings(RANDOM, max_examples=25)
@given(repeating(), st.sampled_from([1, 4]))
def test_loops_have_the_bits_of_code_without_loops(outputs, lanes):
    y = np.random.default_rng(27).uniform(-2, 2, (60, lanes))[:, :lanes]
    t, y, p = (TIME, y[:, 0], ARGS) if lanes == 1 else (np.full(lanes, TIME), y, np.repeat([ARGS], lanes, 0).T)
    found = []
    for smallest in (1, 10**9):
        with pytest.MonkeyPatch.context() as changed:
            changed.setattr(machine, "_ROLLED", smallest)
            changed.setattr(objects, "_kept", OrderedDict())
            found.append(compiled(outputs, lanes=lanes)(t, y, p))
    np.testing.assert_array_equal(*found)


def lorenz(y, out):
    out[:] = (np.roll(y, -1) - np.roll(y, 2)) * np.roll(y, 1) - y + 8.0


def heat(y, out):
    out[1:-1] = y[2:] - 2.0 * y[1:-1] + y[:-2]
    out[0], out[-1] = y[1] - 2.0 * y[0], y[-2] - 2.0 * y[-1]


def chain(y, out):
    m = len(y) // 2
    for i in range(m):
        right, left = y[(i + 1) % m] - y[i], y[i] - y[i - 1]
        out[i], out[m + i] = y[m + i], right - left + 0.25 * (right * right - left * left)


def reaction(y, out):
    m = len(y) // 2
    for i in range(m):
        u, v = y[2 * i], y[2 * i + 1]
        left, right = (y[2 * i - 2] if i > 0 else 1.0), (y[2 * i + 2] if i < m - 1 else 1.0)
        out[2 * i], out[2 * i + 1] = u * u * v - 4.0 * u + (left - 2.0 * u + right), 3.0 * u - u * u * v


def membrane(y, out):
    u = y.reshape(4, -1)
    around = np.roll(u, 1, 0) + np.roll(u, -1, 0) + np.roll(u, 1, 1) + np.roll(u, -1, 1)
    out[:] = (around - 4.0 * u).ravel() * np.linspace(1.0, 2.0, len(y))


@pytest.mark.parametrize("n", [64, 100, 404])
@pytest.mark.parametrize("stencil", [lorenz, heat, chain, reaction, membrane])
def test_stencils_become_loops_without_tables_and_have_the_bits_of_numpy(stencil, n, monkeypatch):
    monkeypatch.setattr(machine, "_ROLLED", 1)
    f = iv.compile(lambda t, y, out: stencil(y, out), inplace=True)
    y, expected = np.random.default_rng(n).uniform(-2, 2, n), np.empty(n)
    stencil(y, expected)
    np.testing.assert_array_equal(f(0.0, y, np.empty(n)), expected)
    groups, _ = rolled(derived(f, n, n).outputs)
    assert sum(len(one.places) for one in groups if not one.runs) <= 8


def test_code_of_a_large_repeating_graph_does_not_grow_with_it():
    sizes = []
    for n in (100, 1000):
        graph = Graph()
        y = [graph.y(i) for i in range(n)]
        outputs = [y[i - 1] - 2.0 * y[i] + y[(i + 1) % n] for i in range(n)]
        found = rolled(outputs)
        assert found is not None
        sizes.append(sum(one.size for one in found[0]))
    assert sizes[0] == sizes[1]
    chain = [graph.y(0)]
    for _ in range(500):
        chain.append(chain[-1] * chain[-1] + graph.y(1))
    assert rolled(chain[-1:]) is None


def test_code_of_equal_graphs_is_made_once():
    made = [codes.machine_code(Formula("f", orbit_outputs, (4,)).outputs, objects.CodeForm()) for _ in range(2)]
    assert made[0] is made[1]
    assert codes.machine_code(orbit_outputs(), objects.CodeForm(own=False)) is not made[0]


def orbit_outputs():
    return orbit()[0].outputs


def orbit():
    """Kepler's problem as a graph, with the strength of the attraction as parameter."""
    graph = Graph()
    x, y, u, v = (graph.y(i) for i in range(4))
    cube = graph.power(x * x + y * y, graph.node(1.5))
    slopes = [u, v, -graph.p(0) * x / cube, -graph.p(0) * y / cube]
    rows = jacobian(slopes, [x, y, u, v])
    zero = graph.node(0.0)
    f = Formula("f", lambda: slopes, (4,))
    jac = Formula("jac", lambda: [row.get(j, zero) for row in rows for j in range(4)], (4, 4))
    return f, jac


START = [0.5, 0.0, 0.0, math.sqrt(3)]


@families
def test_runs_of_a_graph_are_those_of_its_python_form(method):
    """One machine code, one formula: the same steps, with exact Jacobians and derivatives in t."""
    f, jac = orbit()
    alone, code = (
        iv.Problem(kind(f), (0, 3), START, args=(1.0,), jac=kind(jac)).solve(method, rtol=1e-5, atol=1e-8)
        for kind in (lambda formula: formula, GraphFunction)
    )
    assert code.success
    np.testing.assert_allclose(code.y[:, -1], alone.y[:, -1], rtol=1e-9)


def test_ensembles_of_graphs_run_in_lanes_with_the_same_bits():
    f = GraphFunction(orbit()[0])
    starts = np.array(START) + np.linspace(0, 0.1, 1200)[:, None] * [0, 0, 0, 1]
    runs = [iv.solve_ensemble(f, (0, 2), starts, args=(1.0,), method="dop853", lanes=lanes) for lanes in ("auto", 1)]
    assert "lanes" in runs[0].stats.lanes
    np.testing.assert_array_equal(runs[0].y, runs[1].y)


def test_graphs_are_pickled_as_data():
    f = GraphFunction(orbit()[0], elementary="libm")
    again = pickle.loads(pickle.dumps(f))
    assert again.elementary == "libm"
    np.testing.assert_array_equal(again(0.0, START, 2.0), f(0.0, START, 2.0))
    assert again.fun.text == f.fun.text


def sparse_system(k):
    """A x = b with A nearly tridiagonal, of k components of y: its rows by column, and b."""
    graph = Graph()
    y = [graph.y(i) for i in range(k)]
    rows = [{i: 2.0 + y[i] * y[i]} for i in range(k)]
    for i in range(1, k):
        rows[i][i - 1], rows[i - 1][i] = -y[i], 1.0 + y[i] * 0.5
    rows[0][k - 1] = y[1]
    return graph, y, rows, [y[(i + 3) % k] * y[i] for i in range(k)]


@pytest.mark.slow
def test_sparse_systems_are_solved_as_dense_ones():
    """In Python and in machine code, with several patterns in turn; derivatives and Taylor series follow."""
    start = np.linspace(0.1, 1, 30)
    kinds = set()
    for k in (30, 20, 30):
        graph, y, rows, right = sparse_system(k)
        sparse = [row[0] for row in graph.solve_sparse(rows, [[b] for b in right])]
        whole = [[row.get(j, graph.node(0.0)) for j in range(k)] for row in rows]
        dense = [row[0] for row in graph.solve(whole, [[b] for b in right])]
        kinds |= {len(one[0].arguments[0].value.places) > 0 for one in (sparse, dense)}
        at = start[:k]
        values = [Formula("f", lambda one=one: one, (k,)).array(0.0, at) for one in (sparse, dense)]
        code = as_python(GraphFunction(Formula("f", lambda one=sparse: one, (k,))).native(k, k), k)
        for found in (values[0], code(0.0, at, np.zeros(0))):
            np.testing.assert_allclose(found, values[1], rtol=1e-13)
        slopes = []
        for one in (sparse, dense):
            row = jacobian(one, y)[7]
            slopes.append(Formula("J", lambda row=row: [row[j] for j in sorted(row)], (k,)).array(0.0, at))
        np.testing.assert_allclose(*slopes, rtol=1e-12, atol=1e-14)
    assert kinds == {True, False}
    function = GraphFunction(Formula("f", lambda: sparse, (k,)))
    runs = [iv.solve_ivp(function, (0, 0.5), start, m, rtol=1e-11, atol=1e-12).y[:, -1] for m in ("dop853", "taylor")]
    np.testing.assert_allclose(*runs, rtol=1e-9)


def test_a_singular_sparse_system_has_no_value():
    graph = Graph()
    rows = [
        {0: graph.y(0), 1: graph.y(0)},
        {0: graph.y(0), 1: graph.y(0)},
        *({i: graph.node(1.0)} for i in range(2, 30)),
    ]
    found = [row[0] for row in graph.solve_sparse(rows, [[graph.node(1.0)]] * 30)]
    code = as_python(GraphFunction(Formula("f", lambda: found, (30,))).native(1, 30), 30)
    assert np.isnan(code(0.0, np.ones(1), np.zeros(0))).all()
    assert np.isnan(Formula("f", lambda: found, (30,)).array(0.0, np.ones(1))).all()


def test_dependences_count_the_terms_of_a_forward_jacobian():
    graph = Graph()
    a, b, c = (graph.y(i) for i in range(3))
    product = a * b
    masks, terms = dependences([product + c, graph.elementary("sin", c), graph.make("floor", a)], [a, b, c])
    assert masks == [0b111, 0b100, 0]
    assert terms == 2 + 3 + 1


def test_values_at_many_times_are_those_of_single_points():
    """NumPy's code of a graph and Python's: all operations, within roundoff of the functions."""
    from invariode._functions.graph.array_code import ArrayFunction
    from invariode._functions.graph.nodes import COMPARISONS, ELEMENTARY, Graph
    from invariode._functions.graph.python import Formula

    graph = Graph()
    a, b, t, p = graph.y(0), graph.y(1), graph.t, graph.p(0)
    outputs = [graph.elementary(name, a) for name in ELEMENTARY if name not in ("acosh", "atanh", "asin", "acos")]
    outputs += [graph.elementary(name, a / 10.0) for name in ("asin", "acos", "atanh")]
    outputs += [graph.elementary("acosh", a + 1.0), a + b, a - b, a * b, a / b, -a, graph.make("power", a, b)]
    outputs += [graph.make(name, a, b) for name in ("atan2", "hypot", "modulo", "minimum", "maximum")]
    outputs += [graph.make(name, b) for name in ("abs", "sign", "floor", "ceil")]
    one, zero = graph.node(1.0), graph.node(0.0)
    truths = [graph.make(name, a, b) for name in COMPARISONS]
    truths += [graph.make("and", truths[0], truths[1]), graph.make("or", truths[0], truths[2])]
    truths += [graph.make("not", truths[0])]
    outputs += [graph.select(each, one, zero) for each in truths]
    outputs += [t * p, one]
    times = np.array([0.5, 1.0, 2.0])
    y = np.array([[0.3, 1.5, 2.0], [-0.7, 1.5, 3.0]])
    found = ArrayFunction(outputs).over(times, y, np.array([2.0]))
    formula = Formula("f", lambda: outputs, (len(outputs),))
    for i, time in enumerate(times):
        expected = np.array(formula(time, y[:, i], np.array([2.0])))
        expected = np.where(np.isnan(expected), found[:, i], expected)  # a negative base: Python raises
        np.testing.assert_allclose(found[:, i], expected, rtol=1e-14)


def test_what_is_not_defined_is_infinite_or_nan_at_many_times():
    from invariode._functions.graph.array_code import ArrayFunction
    from invariode._functions.graph.nodes import Graph

    graph = Graph()
    a = graph.y(0)
    outputs = [1.0 / a, graph.elementary("log", a), graph.elementary("sqrt", a - 1.0)]
    found = ArrayFunction(outputs).at(0.0, np.array([0.0]), np.zeros(0))
    np.testing.assert_array_equal(found, [np.inf, -np.inf, np.nan])


def test_kept_code_is_limited_in_bytes(monkeypatch):
    """The code used last stays, and of the others as much as fits; long functions count for more."""
    monkeypatch.setattr(objects, "_kept", OrderedDict())
    monkeypatch.setattr(objects, "_MOST_BYTES", 100)
    made = []

    def once(key, size):
        def make(digest):
            made.append(key)
            return objects.MachineCode(0, None, size)

        return objects.once(key, make)

    for key in "abcda":
        once(key, 25)
    assert made == [*"abcd"]
    once("e", 50)  # b and c, which were used before d and a, go
    assert [objects.is_kept(key) for key in "abcde"] == [True, False, False, True, True]
    once("larger than the limit", 200)
    assert [*map(objects.is_kept, ["a", "d", "e", "larger than the limit"])] == [False, False, False, True]
    sizes = []
    for length in (1, 200):
        node = Graph().t
        for _ in range(length):
            node = node.graph.elementary("sin", node)
        sizes.append(codes.machine_code([node], objects.CodeForm()).size)
    assert sizes[1] > sizes[0] + 100 * 1000


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_compiling_keeps_no_memory_but_the_code():
    """The optimiser of a module of one instruction takes less than 10 kB for good."""

    def optimise(times):
        for _ in range(times):
            module = machine.llvm.parse_assembly("define double @graph(double %x) { ret double %x }")
            machine._optimise(module, objects.target_machine(), 3, loop_vectorization=False)
        return int(Path("/proc/self/statm").read_text().split()[1]) * PAGESIZE

    before = optimise(20)
    assert optimise(100) - before < 100 * 10_000
