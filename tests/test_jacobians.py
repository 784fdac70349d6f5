"""Jacobians that are computed: complex steps are exact or refused, patterns are found whole, and both are watched."""

from __future__ import annotations

import ctypes
import math

import numpy as np
import pytest
from scipy import sparse

import invariode as iv
from cases import IMPLICIT
from invariode import _core
from invariode._functions.graph.derived import derived
from invariode._plan.planning import make_plan
from invariode._problem.core_problem import CoreProblem
from stiff import PROBLEMS

ROBERTSON, BRUSSELATOR = PROBLEMS["Robertson"], PROBLEMS["Brusselator"]


def jacobian(problem, t, y):
    """(n, n), as ode15s begins with it at (t, y), and its kind and structure."""
    plan = make_plan(problem, "ode15s", {})
    its = plan.functions
    rows, columns, values = _core.jacobian(t, y, its, plan.tolerances)
    return sparse.csc_array((values, (rows, columns)), (its.n, its.n)).toarray(), its.linear.kind, its.linear.structure


def whole(p, t, y):
    """The analytic Jacobian, unpacked."""
    J = p.jac(t, y, *p.args)
    if p.lband is None:
        return J.toarray() if sparse.issparse(J) else np.asarray(J)
    return sparse.dia_array((J, p.uband - np.arange(len(J))), (len(y), len(y))).toarray()


def structures(p):
    yield {}
    yield {"jac_sparsity": whole(p, 0.0, p.y0 + p.scale) != 0}
    if p.lband is not None:
        yield {"lband": p.lband, "uband": p.uband}


SMALL = [p for p in PROBLEMS.values() if len(p.y0) <= 1000]


@pytest.mark.parametrize("p", SMALL, ids=lambda p: p.name)
def test_complex_steps_give_the_analytic_jacobian(p):
    y = p.y0 + p.scale
    expected = whole(p, 0.0, y)
    for structure in structures(p):
        given = iv.Problem(p.fun, p.t_span, p.y0, args=p.args, jac="complex-step", **structure)
        J, kind, _ = jacobian(given, 0.0, y)
        assert kind == "complex-step"
        np.testing.assert_allclose(J, expected, rtol=1e-12, atol=1e-15 * np.abs(expected).max())


@pytest.mark.parametrize("method", IMPLICIT)
def test_complex_steps_give_the_run_of_the_analytic_jacobian(method):
    p = PROBLEMS["pollution"]
    runs = [
        iv.solve_ivp(p.fun, p.t_span, p.y0, method, rtol=1e-4, atol=1e-4 * p.scale, jac=jac)
        for jac in (p.jac, "complex-step")
    ]
    given, computed = (run.stats for run in runs)
    assert (computed.steps, computed.failed, computed.njev, computed.nlu) == (
        given.steps,
        given.failed,
        given.njev,
        given.nlu,
    )
    examinations = 2 * math.ceil(math.log2(given.njev) + 1 + given.failed)
    assert given.nfev + 20 * given.njev <= computed.nfev <= given.nfev + 20 * given.njev + examinations
    np.testing.assert_allclose(runs[1].y, runs[0].y, rtol=1e-6, atol=1e-16)
    assert computed.jacobian == "complex step"
    assert given.jacobian == "given"


def stored(t, y):
    dy = np.empty(2)
    dy[:] = -y
    return dy


@pytest.mark.parametrize(
    ("fun", "y0", "error", "message"),
    [
        (lambda t, y: [math.sin(y[0]), -y[1]], [1, 2], TypeError, "makes real numbers.*NumPy's functions"),
        (stored, [1, 2], TypeError, "makes real numbers.*np.empty_like"),
        (lambda t, y: [-y[0], -np.abs(y[1])], [1, 2], ValueError, "component 1 of fun drops.*np.sqrt"),
        (lambda t, y: [-y[0], np.hypot(*y)], [1, 2], TypeError, "does not take complex y"),
        (lambda t, y: [-y[0], -y[1].real], [1, 0], ValueError, "component 1 of fun drops.*differences"),
        (lambda t, y: -y, [1, 2j], ValueError, "y0 is complex.*real and imaginary parts"),
    ],
)
def test_what_takes_no_complex_y_is_refused_with_the_reason(fun, y0, error, message):
    with pytest.raises(error, match=message):
        iv.ode15s(fun, (0, 1), y0, jac="complex-step")
    assert iv.ode15s(fun, (0, 1), y0, jac="differences").success


def test_an_imaginary_part_that_is_dropped_later_is_noticed(method_code):
    """From t = 1 on f has abs, whose complex step is 0: differences take over, with a warning."""

    def fun(t, y):
        return np.array([-100 * (y[0] if t < 1 else abs(y[0])) + 100 * np.cos(t) * y[1], -y[1]])

    with pytest.warns(UserWarning, match="differences are used from there on") as told:
        sol = iv.solve_ivp(fun, (0, 3), [1.0, 1.0], method_code, rtol=1e-4, jac="complex-step")
    assert len(told) == 1
    assert sol.stats.jacobian.startswith("complex step, differences from t = ")
    assert 1 <= float(sol.stats.jacobian.split()[-2]) <= 3
    expected = iv.solve_ivp(fun, (0, 3), [1.0, 1.0], method_code, rtol=1e-4)
    assert sol.stats.steps < 1.3 * expected.stats.steps
    np.testing.assert_allclose(sol.y[:, -1], expected.y[:, -1], rtol=1e-2)


@pytest.mark.parametrize("method", ["ode15s", "ode23t", "ode23tb", "radau"])
def test_complex_steps_are_examined_after_an_iteration_that_failed(method):
    """From t = 2 on f drops imaginary parts: radau takes two Jacobians from it, the others one."""
    late = []

    def fun(t, y):
        if np.iscomplexobj(y) and t >= 2:
            late.append(t)
            y = y.real + 0j
        return np.array([-1e4 * (y[0] ** 3 - np.cos(3 * t) ** 3), y[0] - y[1]])

    with pytest.warns(UserWarning, match="differences are used from there on"):
        iv.solve_ivp(fun, (0, 3), [1.0, 1.0], method, rtol=1e-4, atol=1e-7, jac="complex-step")
    assert 2 <= len(late) <= 2 * 2


@pytest.fixture(params=IMPLICIT)
def method_code(request):
    return request.param


# ----------------------------------------------------------------------------------------------------------------------
# Compiled functions


@iv.compile
def oscillator(t, y, p):
    return (p[0] * (y[1] - y[0] ** 3 - math.exp(y[0])) if t >= 0 else 0.0, -y[0])


class TestCompiled:
    llvmlite = pytest.importorskip("llvmlite")

    def test_exact_unless_told_otherwise(self):
        y = np.array([0.7, 0.3])
        given = iv.Problem(oscillator, (0, 1), y, args=(100.0,))
        J, kind, _ = jacobian(given, 0.0, y)
        assert kind == "derived"
        np.testing.assert_allclose(J, [[-100 * (3 * 0.7**2 + math.exp(0.7)), 100], [-1, 0]], rtol=1e-14)
        for method, change in (("ode15s", {}), ("auto", {}), ("ode15s", {"nonnegative": [0]})):
            assert given.replace(**change).solve(method).stats.jacobian == "traced"
        assert given.replace(jac="differences").solve("ode15s").stats.jacobian == "differences"

    def test_an_ensemble_has_the_runs_of_single_solves(self):
        rates = [[10.0], [100.0], [1000.0]]
        out = iv.solve_ensemble(oscillator, (0, 1), [1.0, 0.0], args=rates, method="ode15s")
        for rate, end, nfev in zip(rates, out.y_end, out.stats["nfev"], strict=True):
            alone = iv.solve_ivp(oscillator, (0, 1), [1.0, 0.0], "ode15s", args=tuple(rate))
            np.testing.assert_array_equal(end, alone.y[:, -1])
            assert nfev == alone.nfev

    def test_comparisons_of_y_have_exact_ones_and_differences_by_numba(self):
        pytest.importorskip("numba")

        def fun(t, y):
            return (-y[0] if y[0] > 0.5 else -2 * y[0] * y[0],)

        assert iv.ode15s(iv.compile(fun), (0, 1), [1.0]).stats.jacobian == "traced"
        by_numba = iv.compile(fun, by="numba")
        assert iv.ode15s(by_numba, (0, 1), [1.0]).stats.jacobian == "differences"
        with pytest.raises(TypeError, match=r"numba compiles for complex numbers.*differences"):
            iv.ode15s(by_numba, (0, 1), [1.0], jac="complex-step")

    @pytest.mark.filterwarnings("ignore:.* fell below 0")  # runs without bounds do
    def test_abs_means_differences_as_soon_as_it_counts_by_numba(self):
        pytest.importorskip("numba")
        fun = iv.compile(lambda t, y: (-100 * (abs(y[0]) if t > 1 else y[0]), -y[1]), by="numba")
        told = iv.ode15s(fun, (0, 3), [1.0, 1.0], atol=1e-12).stats.jacobian
        assert told.startswith("complex step, differences from t = ")
        assert iv.ode15s(fun, (2, 3), [1.0, 1.0]).stats.jacobian == "complex step, differences from t = 2 on"

    def test_inputs_and_patterns(self):
        drive = iv.Input([0.0, 1.0, 2.0], [1.0, 2.0, 0.0])
        fun = iv.compile(lambda t, y, u, k: (-y[0] * u, y[0] - k * y[1]))
        given = iv.Problem(fun, (0, 2), [1.0, 0.0], inputs=drive, args=(3.0,), jac_sparsity=[[1, 0], [1, 1]])
        J, kind, structure = jacobian(given, 0.5, np.array([0.5, 2.0]))
        assert (kind, structure) == ("derived", "sparse")
        np.testing.assert_allclose(J, [[-drive(0.5), 0], [1, -3]], rtol=1e-15)


# ----------------------------------------------------------------------------------------------------------------------
# Traces


def decaying(t, y, k, rates):
    return -k * rates * (y - np.cos(t)) + np.roll(y, 1) * y


DECAYING = iv.Problem(decaying, (0, 2), [1.0, 0.5, 2.0], args=(3.0, np.array([1.0, 10.0, 200.0])))


@pytest.mark.parametrize("p", SMALL, ids=lambda p: p.name)
def test_traces_give_the_analytic_jacobian_and_its_pattern(p):
    y = p.y0 + p.scale
    expected = whole(p, 0.0, y)
    for structure in [*structures(p)][-2:]:
        given = iv.Problem(p.fun, p.t_span, p.y0, args=p.args, jac="trace", **structure)
        J, kind, _ = jacobian(given, 0.0, y)
        assert kind == "derived"
        np.testing.assert_array_equal(J != 0, expected != 0)
        np.testing.assert_allclose(J, expected, rtol=1e-13, atol=1e-15 * np.abs(expected).max())


@pytest.mark.parametrize("method", IMPLICIT)
def test_traces_give_the_run_of_the_analytic_jacobian(method):
    p = PROBLEMS["pollution"]
    runs = [
        iv.solve_ivp(p.fun, p.t_span, p.y0, method, rtol=1e-4, atol=1e-4 * p.scale, jac=jac) for jac in (p.jac, "trace")
    ]
    given, traced = (run.stats for run in runs)
    assert traced.jacobian == "traced"
    assert (traced.steps, traced.failed, traced.njev, traced.nlu) == (given.steps, given.failed, given.njev, given.nlu)
    np.testing.assert_allclose(runs[1].y[:, -1], runs[0].y[:, -1], rtol=1e-9)


@pytest.mark.parametrize("method", IMPLICIT)
def test_a_traced_jacobian_takes_the_arguments_of_the_problem(method):
    plain, traced = (DECAYING.replace(jac=jac).solve(method, rtol=1e-5) for jac in (None, "trace"))
    assert traced.stats.jacobian == "traced"
    np.testing.assert_allclose(traced.y[:, -1], plain.y[:, -1], rtol=1e-3)


def test_an_ensemble_of_traces_has_the_runs_of_single_solves():
    rows = [(k, np.array([1.0, 10.0, 200.0])) for k in (1.0, 2.0, 5.0)]
    given = DECAYING.replace(jac="trace")
    out = given.solve_ensemble([DECAYING.y0] * 3, args=rows, method="radau", workers=1)
    for row, end in zip(rows, out.y_end, strict=True):
        np.testing.assert_array_equal(end, given.replace(args=row).solve("radau").y[:, -1])


def test_products_with_a_traced_jacobian_replace_evaluations_of_f():
    u0 = np.sin(np.arange(40.0))
    A = 400 * (np.eye(40, k=1) - 2 * np.eye(40) + np.eye(40, k=-1))
    options = {"linear_solver": "gmres", "rtol": 1e-6}
    plain, traced, given = (
        iv.ode15s(lambda t, u: A @ u, (0, 0.1), u0, jac=jac, **options) for jac in (None, "trace", A)
    )
    assert traced.nfev < plain.nfev
    assert traced.stats.steps == given.stats.steps
    np.testing.assert_allclose(traced.y[:, -1], given.y[:, -1], rtol=1e-9, atol=1e-12)


def test_with_an_exact_derivative_in_t_only_stages_evaluate_f():
    turning = iv.Problem(lambda t, y: [-5e3 * y[0] + np.sin(1e5 * t)], (0, 1e-3), [1.0])
    traced, plain = (turning.replace(jac=jac).solve("ode23s", rtol=1e-6) for jac in ("trace", None))
    assert traced.nfev == 2 * (traced.stats.steps + traced.stats.failed) + 1
    np.testing.assert_allclose(traced.y[0, -1], plain.y[0, -1], rtol=1e-5)


def test_what_cannot_be_traced_is_refused_with_the_line():
    def fun(t, y):
        return [-np.fft.fft(y).real[0], y[1]]

    with pytest.raises(TypeError, match=r"at line \d+ of .*test_jacobians.*numpy\.fft"):
        iv.ode15s(fun, (0, 1), [1.0, 2.0], jac="trace")
    with pytest.raises(ValueError, match="y0 is complex"):
        iv.ode15s(lambda t, y: -y, (0, 1), [1j], jac="trace")
    pointer = ctypes.POINTER(ctypes.c_double)
    code = ctypes.CFUNCTYPE(None, ctypes.c_double, pointer, pointer, pointer)(lambda *_: None)
    with pytest.raises(TypeError, match="this fun is machine code"):
        iv.ode15s(code, (0, 1), [1.0], jac="trace")


def test_bands_that_miss_entries_of_a_trace_are_named():
    with pytest.warns(UserWarning, match=r"miss entries: those of fun have lower = 1, upper = 2"):
        DECAYING.replace(jac=iv.Banded(1, 0, "trace")).solve("ode15s")


# ----------------------------------------------------------------------------------------------------------------------
# Detected patterns


def found(problem):
    plan = make_plan(problem, "ode15s", {})
    return plan.functions.linear


@pytest.mark.parametrize("p", PROBLEMS.values(), ids=lambda p: p.name)
def test_the_detected_pattern_contains_the_true_one(p):
    n = len(p.y0)
    starts, rows, calls = searched(p.fun, p.y0, p.args)
    pattern = sparse.csc_array((np.ones(len(rows)), rows, starts), (n, n)) != 0
    J = p.jac(0.0, p.y0 + p.scale, *p.args)
    true = sparse.csc_array(J if sparse.issparse(J) else whole(p, 0.0, p.y0 + p.scale)) != 0
    missing = true.astype(int) - pattern.astype(int)
    assert missing.max() <= 0
    if n > 200:
        assert pattern.nnz == true.nnz
        assert calls < n / 5


def searched(fun, y0, args=()):
    n = len(y0)
    problem = CoreProblem(n=n, complex=False, fun=fun, args=args)
    (starts, rows), calls, _ = _core.sparsity(0.0, y0, problem, 10 * n + 100, False)
    return starts, rows, calls


@pytest.mark.parametrize("seed", range(8))
def test_random_patterns_are_found_whole(seed):
    """The law holds where y0 = 0 hides every entry of a quadratic f."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(200, 500))
    A = sparse.random_array((n, n), density=3 / n, rng=rng, format="csc")
    quadratic = bool(seed % 2)
    y0 = np.zeros(n) if quadratic else rng.normal(size=n)
    starts, rows, _ = searched((lambda t, y: A @ (y * y)) if quadratic else (lambda t, y: A @ np.sin(y)), y0)
    pattern = sparse.csc_array((np.ones(len(rows)), rows, starts), (n, n))
    expected = sparse.csc_array(A + sparse.eye_array(n)).sign()
    assert (abs(pattern - expected)).max() == 0


def test_large_problems_are_solved_as_with_their_pattern():
    p = BRUSSELATOR
    options = {"rtol": 1e-4, "atol": 1e-4, "keep": "end"}
    short = (0, 1)
    given = iv.ode15s(p.fun, short, p.y0, jac_sparsity=whole(p, 0.0, p.y0) != 0, **options)
    detected = iv.ode15s(p.fun, short, p.y0, **options)
    assert (detected.stats.steps, detected.stats.failed) == (given.stats.steps, given.stats.failed)
    assert detected.nfev <= given.nfev + 2 * detected.njev
    assert "detected pattern: 3996 entries, 4 evaluations of f each" in detected.stats.jacobian
    np.testing.assert_allclose(detected.y, given.y, rtol=1e-8)


def line(n):
    return lambda t, y: np.diff(y, prepend=0, append=0, n=2) * 30


def test_small_dense_and_unwanted_ones_stay_dense():
    n = 200
    rng = np.random.default_rng(1)
    full = rng.normal(size=(n, n)) - 20 * np.eye(n)
    y0 = np.ones(n)
    assert found(iv.Problem(line(n), (0, 1), y0)).structure == "sparse"
    assert found(iv.Problem(line(n), (0, 1), y0[1:])).structure == "dense"
    assert found(iv.Problem(line(n), (0, 1), y0[1:], jac_sparsity="detect")).structure == "sparse"
    assert found(iv.Problem(line(n), (0, 1), y0, jac_sparsity="dense")).structure == "dense"
    assert found(iv.Problem(line(n), (0, 1), y0, lband=1, uband=1)).structure == "banded"
    assert found(iv.Problem(lambda t, y: full @ y, (0, 1), y0)).structure == "dense"
    assert found(iv.Problem(line(n), (0, 1), y0, mass=lambda t: np.eye(n))).structure == "dense"
    assert found(iv.Problem(line(n), (0, 1), y0, mass=2 * np.eye(n))).structure == "sparse"
    assert found(iv.Problem(lambda t, y: 1j * line(n // 2)(t, y), (0, 1), y0[: n // 2] + 0j)).structure == "sparse"


def test_a_search_gives_up_in_good_time():
    n, calls = 400, []
    full = np.ones((n, n))

    def fun(t, y):
        calls.append(t)
        return full @ y

    assert found(iv.Problem(fun, (0, 1), np.ones(n))).structure == "dense"
    assert len(calls) <= 40


@pytest.mark.slow
@pytest.mark.parametrize("method_code", ["ode15s", "radau"])
def test_an_entry_that_appears_later_is_found(method_code):
    """From t = 1 on the last component acts on the first one."""
    n = 200
    y0 = np.linspace(1, 2, n)
    inner = line(n)

    def fun(t, y):
        dy = inner(t, y)
        dy[0] += 1e4 * max(t - 1, 0) * (y[-1] - y[0])
        return dy

    sol = iv.solve_ivp(fun, (0.9, 1.2), y0, method_code, keep="end")
    assert "enlarged 1 times" in sol.stats.jacobian
    dense = iv.solve_ivp(fun, (0.9, 1.2), y0, method_code, keep="end", jac_sparsity="dense")
    assert dense.stats.jacobian == "differences"
    assert sol.stats.steps <= 1.1 * dense.stats.steps + 2
    np.testing.assert_allclose(sol.y, dense.y, rtol=1e-2, atol=1e-5)


def test_functions_that_are_not_defined_beside_y0_are_searched_at_y0_and_without_warnings():
    def fun(t, y):
        if (np.abs(y - 1) > 1e-3).any():
            raise ValueError("outside")
        return line(250)(t, y) / 1e6 * np.sqrt(1.001 - y)

    assert found(iv.Problem(fun, (0, 1), np.ones(250))).structure == "sparse"


def test_a_run_with_a_detected_pattern_goes_on_from_a_file(tmp_path):
    n = 200

    def fun(t, y):
        dy = line(n)(t, y)
        if t > 1:
            dy[0] += 1e4 * (y[-1] - y[0])
        return dy

    problem = iv.Problem(fun, (0, 3), np.ones(n), name="appears")
    straight = problem.solve("ode15s")
    part = problem.replace(t_span=(0, 1.5)).solve("ode15s", max_step=0.3)
    part.save(tmp_path / "part.npz")
    on = iv.load(tmp_path / "part.npz", problem.replace(t_span=(0, 1.5))).extend(3)
    here = part.extend(3)
    np.testing.assert_array_equal(on.y, here.y)
    assert "enlarged 1 times" in on.stats.jacobian
    np.testing.assert_allclose(on.y[:, -1], straight.y[:, -1], rtol=1e-2, atol=1e-4)


def test_a_long_jacobian_is_formed_by_products():
    """If everything depends on everything, the code of all entries is long; products have the same values."""
    n = 80

    def chained(t, y):
        total, slopes = 0.0, []
        for i in range(n):
            total = np.sin(total + y[i]) + 0.1 * total
            slopes.append(total - y[i])
        return slopes

    y0 = np.linspace(-1, 1, n)
    problem = iv.Problem(iv.compile(chained), (0, 1), y0)
    assert derived(problem.fun, n, n).is_product(n)
    found, kind, structure = jacobian(problem, 0.3, y0)
    assert (kind, structure) == ("derived", "dense")
    expected = np.zeros((n, n))
    rates, total, before = np.zeros(n), 0.0, 0.0
    for i in range(n):
        before, total = total, np.sin(total + y0[i]) + 0.1 * total
        slope = np.cos(before + y0[i])
        rates = (slope + 0.1) * rates
        rates[i] = slope
        expected[i] = rates
        expected[i, i] -= 1
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    sol = problem.solve("radau", rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(
        sol.y[:, -1], iv.solve_ivp(chained, (0, 1), y0, "dop853", rtol=1e-10, atol=1e-12).y[:, -1], atol=1e-7
    )
    held = problem.replace(bounds=(-5.0, 5.0)).solve("radau", rtol=1e-8, atol=1e-10)  # products stay within bounds
    np.testing.assert_allclose(held.y[:, -1], sol.y[:, -1], atol=1e-7)
    again = problem.replace(t_span=(0, 0.5)).solve("radau", rtol=1e-8, atol=1e-10).extend(1.0)
    np.testing.assert_allclose(again.y[:, -1], sol.y[:, -1], atol=1e-7)
