"""Taylor series as a method: accuracy, orders, the symmetries of its steps, f with branches, events on polynomials, and
what it refuses. The laws that all methods share run over it where they stand."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
from invariode import problems
from problems import PROBLEMS, kepler, kepler_invariants, kepler_jacobian

EPS = np.finfo(float).eps
TIGHT = {"rtol": 1e-12, "atol": 1e-12}
START = [0.4, 0.0, 0.0, 2.0]  # of an orbit with e = 0.6


def solve(fun, t_span, y0, **options):
    return iv.solve_ivp(fun, t_span, y0, "taylor", **options)


def circle(t, y):
    return [y[1], -y[0]]


def spring(t, y, k):
    return [y[1], -k * y[0]]


def same(a, b):
    return np.array_equal(a.t, b.t) and np.array_equal(a.y, b.y)


# ----------------------------------------------------------------------------------------------------------------------
# Accuracy and order


@pytest.mark.parametrize("name", list(PROBLEMS))
def test_solutions_are_those_of_dop853(name):
    """Both have errors of the tolerance, which the problem amplifies: by what another tolerance changes."""
    problem = PROBLEMS[name]
    tight, loose = (problem.solve("dop853", False, rtol=r, atol=r).y[:, -1] for r in (1e-12, 1e-10))
    amplified = max(np.abs(tight - loose).max(), 1e-12)
    sol = problem.solve("taylor", False, **TIGHT)
    assert np.abs(sol.y[:, -1] - tight).max() < amplified


@pytest.mark.slow
def test_the_order_follows_the_tolerance_unless_it_is_given():
    """The order is higher where coefficients cost little: the circle has no products, many oscillators in a ring do."""
    n = 20
    start = np.sin(np.arange(2.0 * n))

    def ring(t, y):
        return [*y[n:], *(-sum(y[i] * y[i - k] for k in range(1, n)) for i in range(n))]

    for rtol in (1e-3, 1e-8, 1e-15):
        least = math.ceil(1 - math.log(rtol) / 2)
        sol, costly = (
            solve(fun, (0, 0.1), y0, rtol=rtol, atol=rtol) for fun, y0 in ((circle, [1.0, 0.0]), (ring, start))
        )
        assert set(costly.steps.order) == {least}
        assert least + 3 < min(sol.steps.order) <= 2 * least + 4
    given = solve(circle, (0, 5), [1.0, 0.0], rtol=1e-3, max_order=17)
    assert set(given.steps.order) == {17}


def test_steps_take_one_expansion_each_and_errors_are_proportional_to_the_tolerance():
    errors = []
    for rtol in (1e-5, 1e-8, 1e-11, 1e-14):
        sol = solve(kepler, (0, 20), START, rtol=rtol, atol=rtol)
        assert sol.nfev == sol.stats.steps + sol.stats.failed + 2
        errors.append(np.abs(sol.y[:, -1] - PROBLEMS["Kepler"].solution(20)).max() / rtol)
    assert max(errors) < 100 * max(min(errors), 1)


def test_coefficients_that_vanish_at_the_start_and_solutions_that_are_polynomials():
    sol = solve(lambda t, y: [4 * t**3 * y[0] ** 2], (0, 0.9), [1.0], **TIGHT)
    assert sol.y[0, -1] == pytest.approx(1 / (1 - 0.9**4), rel=1e-11)
    falling = solve(lambda t, y: [y[1], -9.8], (0, 10), [0.0, 1.0], max_step=np.inf)
    assert falling.stats.steps < 5
    np.testing.assert_allclose(falling.y[:, -1], [-480, -97], rtol=1e-13)


# ----------------------------------------------------------------------------------------------------------------------
# Symmetries, bit for bit


@pytest.mark.parametrize("k", [-300, 20, 300])
def test_powers_of_two_in_the_unit_of_time_change_nothing(k):
    unit = 2.0**k
    plain = solve(kepler, (0, 7), START)
    scaled = solve(lambda t, y: np.array(kepler(t, y)) / unit, (0, 7 * unit), START)
    np.testing.assert_array_equal(scaled.t / unit, plain.t)
    np.testing.assert_array_equal(scaled.y, plain.y)


def test_the_order_of_the_components_changes_nothing():
    turned = [2, 0, 3, 1]

    def permuted(t, z):
        y = [z[turned.index(i)] for i in range(4)]
        f = kepler(t, y)
        return [f[i] for i in turned]

    plain, other = solve(kepler, (0, 7), START), solve(permuted, (0, 7), np.array(START)[turned])
    np.testing.assert_array_equal(other.y, plain.y[turned])


# ----------------------------------------------------------------------------------------------------------------------
# Invariants


@pytest.mark.parametrize("name", ["Kepler", "Henon-Heiles", "rigid body", "forced", "Lotka-Volterra", "pendulum"])
def test_invariants_hold_to_roundoff_at_steps_and_between(name):
    problem = PROBLEMS[name]
    sol = problem.solve("taylor", rtol=1e-9, atol=1e-9, refine=3)
    size = np.abs(sol.y).max() ** 2 + 1
    assert np.abs(sol.residual).max() < 100 * EPS * size
    assert problem.drift(problem.solve("taylor", False, rtol=1e-9, atol=1e-9)) > 100 * np.abs(sol.residual).max()


def test_invariants_that_fun_does_not_keep_are_refused():
    with pytest.raises(iv.InvariantError, match="is not conserved by fun"):
        solve(circle, (0, 5), [1.0, 0.0], invariants=lambda t, y: y[1])


def test_unless_something_is_moved_invariants_change_nothing():
    """A sum that f keeps exactly, term by term, is kept by its coefficients: nothing is left to project."""

    def exchange(t, y):
        return [y[0] * y[1], -y[0] * y[1]]

    plain = solve(exchange, (0, 3), [0.25, 0.75])
    held = solve(exchange, (0, 3), [0.25, 0.75], invariants=lambda t, y: y[0] + y[1])
    np.testing.assert_array_equal(held.t, plain.t)
    np.testing.assert_allclose(held.y, plain.y, rtol=4 * EPS)


# ----------------------------------------------------------------------------------------------------------------------
# Between steps


def test_the_continuous_solution_satisfies_the_equations():
    """P' = f(t, P) within what the local error of order rtol makes of them in a step."""
    sol = solve(kepler, (0, 20), START, rtol=1e-9, atol=1e-9, dense_output=True)
    t = np.linspace(0.01, 19.99, 400)
    h = 1e-4
    slope = (8 * (sol.sol(t + h) - sol.sol(t - h)) - (sol.sol(t + 2 * h) - sol.sol(t - 2 * h))) / (12 * h)
    exact = np.array([kepler(s, y) for s, y in zip(t, sol.sol(t).T, strict=True)]).T
    assert np.median(np.abs(slope - exact).max(axis=0)) < 1e-9 * 10
    np.testing.assert_allclose(sol.sol(t), PROBLEMS["Kepler"].solution(t), atol=1e-6)


def test_copies_of_the_continuous_solution_are_the_same_function(tmp_path):
    problem = iv.Problem(kepler, (0, 7), START, invariants=iv.Invariants(kepler_invariants, kepler_jacobian))
    sol = problem.solve("taylor", dense_output=True)
    t = np.linspace(0, 7, 50)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(sol.sol))(t), sol.sol(t))
    sol.save(tmp_path / "orbit.npz")
    loaded = iv.load(tmp_path / "orbit.npz", problem)
    np.testing.assert_array_equal(loaded.sol(t), sol.sol(t))
    assert same(loaded.extend(9), sol.extend(9))


# ----------------------------------------------------------------------------------------------------------------------
# f with branches


def exact_bang(t, k=1.0):
    """y'' = -k sign y from (1, 0): parabolas of four times √(2/k)."""
    quarter = math.sqrt(2 / k)
    part, s = divmod(t, quarter)
    y, v = (1 - k * s * s / 2, -k * s) if part % 2 == 0 else (-math.sqrt(2 * k) * s + k * s * s / 2, 0.0)
    if part % 2 == 1:
        v = -math.sqrt(2 * k) + k * s
    sign = 1 if part % 4 < 2 else -1
    return sign * np.array([y, v])


BRANCHES = {
    "sign": (lambda t, y: [y[1], -np.sign(y[0])], [1.0, 0.0]),
    "abs": (lambda t, y: [y[1], -y[0] * np.abs(y[0])], [1.0, 0.0]),
    "maximum": (lambda t, y: [y[1], -np.maximum(y[0], 0.3 * y[0])], [1.0, 0.0]),
    "saturated": (lambda t, y: [y[1], np.minimum(np.maximum(-3 * y[0] - y[1], -0.5), 0.5)], [5.0, 0.0]),
    "comparison": (lambda t, y: [-y[0] + (2.0 if np.sin(3 * t) > 0 else 0.0), y[0]], [1.0, 0.0]),
    "floor of t": (lambda t, y: [np.floor(t) - y[0], y[0]], [1.0, 0.0]),
    "floor of y": (lambda t, y: [1 + np.floor(2 * y[0]) % 3, y[0]], [0.1, 0.0]),
    "modulo": (lambda t, y: [0.3 + y[0] % 0.7, y[0]], [0.1, 0.0]),
    "two": (lambda t, y: [y[1], -np.sign(y[0]) - 0.2 * np.sign(y[1])], [1.0, 0.0]),
}


def pieces(fun, t_span, y0):
    """By dop853 with steps so short that what it loses at each jump is small."""
    return iv.solve_ivp(fun, t_span, y0, "dop853", rtol=1e-13, atol=1e-13, max_step=0.01)


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # of the reference
@pytest.mark.parametrize("name", list(BRANCHES))
def test_steps_end_where_f_changes_its_branch(name):
    """No step fails there, and the error is that of a smooth f."""
    fun, y0 = BRANCHES[name]
    t_span = (0.0, 5.0)
    sol = solve(fun, t_span, y0, rtol=1e-10, atol=1e-10)
    assert sol.success
    assert sol.stats.failed <= 3
    np.testing.assert_allclose(sol.y[:, -1], pieces(fun, t_span, y0).y[:, -1], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("backwards", [False, True])
def test_jumps_of_f_are_no_source_of_errors(backwards):
    """y'' = -sign y is solved to roundoff, each parabola in one step; times run either way."""
    tf = -19.0 if backwards else 19.0
    sol = solve(BRANCHES["sign"][0], (0, tf), [1.0, 0.0], max_step=np.inf)
    y, v = exact_bang(19.0)
    np.testing.assert_allclose(sol.y[:, -1], [y, -v if backwards else v], atol=1e-12)
    assert sol.stats.steps < 20
    assert sol.stats.failed == 0


def test_f_is_that_of_its_branch_from_a_start_on_the_condition():
    sol = solve(BRANCHES["sign"][0], (0, 1), [0.0, 1.0])
    np.testing.assert_allclose(sol.y[:, -1], [0.5, 0.0], atol=1e-13)


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # which says that it slides
def test_where_the_solution_slides_along_a_jump_steps_have_the_size_of_the_tolerance():
    sol = solve(lambda t, y: [-np.sign(y[0])], (0, 1.5), [1.0], rtol=1e-3, atol=1e-3, keep="end")
    assert sol.success
    assert abs(sol.y[0, -1]) < 0.1
    assert sol.stats.steps < 1e4


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # which says that it slides
@pytest.mark.parametrize("t0", [0.0, 2.0**17])
def test_sliding_costs_as_much_wherever_t_is(t0):
    """Dry friction, which the spring cannot overcome in the end: units of roundoff of t do not set the pace."""

    def friction(t, y):
        return [y[1], -y[0] - 0.3 * np.sign(y[1])]

    tf = t0 + 7.0
    sol = solve(friction, (t0, tf), [1.0, 0.2], rtol=1e-4, atol=1e-4, keep="end", max_steps=5000)
    assert sol.success
    assert abs(sol.y[1, -1]) < 1e-3


def test_conditions_of_f_are_no_events_of_the_user():
    event = iv.Event(lambda t, y: y[1])
    sol = solve(BRANCHES["sign"][0], (0, 19), [1.0, 0.0], events=event)
    quarter = math.sqrt(2)
    np.testing.assert_allclose(sol.t_events[0], np.arange(2, 14, 2) * quarter, rtol=1e-12)
    assert len(sol.t_events) == 1


def test_sensitivities_beside_jumps_are_the_differences_of_solutions():
    def bang(t, y, k):
        return [y[1], -k * np.sign(y[0])]

    sol = iv.Problem(bang, (0, 5), [1.0, 0.0], args=(1.0,), sensitivities=True).solve("taylor", rtol=1e-8, atol=1e-8)
    h = 1e-6
    expected = (exact_bang(5, 1 + h) - exact_bang(5, 1 - h)) / (2 * h)
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], expected, rtol=1e-8)


def test_branches_in_ensembles_extensions_and_checkpoints(tmp_path):
    def bang(t, y, k):
        return [y[1], -k * np.sign(y[0])]

    options = {"rtol": 1e-8, "atol": 1e-8}
    ensemble = iv.solve_ensemble(bang, (0, 5), [1.0, 0.0], "taylor", args=np.array([[1.0], [2.0]]), **options)
    for k, y in zip((1.0, 2.0), ensemble.y, strict=True):
        np.testing.assert_array_equal(y[:, -1], solve(bang, (0, 5), [1.0, 0.0], args=(k,), **options).y[:, -1])
    problem = iv.Problem(bang, (0, 9), [1.0, 0.0], args=(1.0,))
    path = tmp_path / "run.checkpoint"
    whole, part = problem.solve("taylor", **options), problem.solve("taylor", max_steps=4, checkpoint=path, **options)
    assert same(part.extend(9, max_steps=None), whole)
    assert same(iv.load(path, problem).extend(9, max_steps=None), whole)


def test_a_pulse_of_f_in_time_is_noticed():
    sol = solve(lambda t, y: [1e3 if 0.5 < t < 0.6 else 0.0], (0, 3), [0.0])
    assert sol.y[0, -1] == pytest.approx(100, rel=1e-12)
    smooth = solve(lambda t, y: [1e3 * np.exp(-(((t - 0.55) / 0.1) ** 2)) - y[0]], (0, 3), [0.0], rtol=1e-8, atol=1e-8)
    exact = iv.solve_ivp(
        lambda t, y: [1e3 * np.exp(-(((t - 0.55) / 0.1) ** 2)) - y[0]], (0, 3), [0.0], "dop853", **TIGHT
    )
    assert smooth.y[0, -1] == pytest.approx(exact.y[0, -1], rel=1e-7)


# ----------------------------------------------------------------------------------------------------------------------
# Functions of time, parameters, runs


def test_inputs_and_breakpoints():
    """A broken line as an input: its breaks are steps, and its area is exact."""
    t = np.linspace(0, 4, 9)
    u = iv.Input(t, np.sin(t), "linear")
    sol = iv.Problem(lambda t, y, u: [u], (0, 4), [0.0], inputs=u).solve("taylor")
    assert np.isin(t, sol.t).all()
    assert sol.y[0, -1] == pytest.approx(scipy.integrate.trapezoid(np.sin(t), t), rel=1e-13)
    doses = solve(lambda t, y: [-y[0]], (0, 3), [1.0], breakpoints=[(1.0, lambda t, y: y + 1)], **TIGHT)
    assert doses.y[0, -1] == pytest.approx(math.exp(-3) + math.exp(-2), rel=1e-11)


@pytest.mark.parametrize("rtol", [1e-7, 1e-11])
def test_sensitivities_are_those_in_closed_form(rtol):
    k, tf = 1.7, 5.0
    problem = iv.Problem(spring, (0, tf), [1.0, 0.0], args=(k,), sensitivities=["k", "y0"])
    w = math.sqrt(k)
    exact = [
        [-tf * math.sin(w * tf) / (2 * w), math.cos(w * tf), math.sin(w * tf) / w],
        [-(math.sin(w * tf) + w * tf * math.cos(w * tf)) / (2 * w), -w * math.sin(w * tf), math.cos(w * tf)],
    ]
    found = problem.solve("taylor", rtol=rtol, atol=rtol).sensitivities[:, :, -1]
    np.testing.assert_allclose(found, exact, atol=100 * rtol)


def test_prepared_solvers_and_ensembles_are_single_solves():
    problem = iv.Problem(spring, (0, 5), [1.0, 0.0], args=(1.0,))
    solver = problem.prepare("taylor", rtol=1e-9, atol=1e-9)
    args, starts = np.array([[1.0], [2.0], [3.0]]), [[1.0, 0.0], [0.5, 1.0], [2.0, 0.0]]
    ensemble = iv.solve_ensemble(spring, (0, 5), starts, "taylor", args=args, rtol=1e-9, atol=1e-9)
    for (k,), y0, row in zip(args, starts, ensemble.y, strict=True):
        single = solve(spring, (0, 5), y0, args=(k,), rtol=1e-9, atol=1e-9)
        assert same(solver(y0=y0, args=(k,)), single)
        np.testing.assert_array_equal(row[:, -1], single.y[:, -1])


def test_complex_states():
    sol = solve(lambda t, y: [1j * y[0]], (0, 3), [1.0 + 0j], **TIGHT)
    np.testing.assert_allclose(sol.y[0, -1], np.exp(3j), rtol=1e-11)


# ----------------------------------------------------------------------------------------------------------------------
# Events on polynomials


def test_no_change_of_sign_within_a_step_is_missed():
    """A wave that changes its sign many times in each step, at times that are known."""
    zeros = np.arange(1, 160) * math.pi / 16
    sol = solve(circle, (0, 10 * math.pi), [0.0, 1.0], events=lambda t, y: np.sin(16 * t), **TIGHT)
    found = sol.t_events[0]
    assert len(found) == 16 * 10 - 1 + (found[-1] > zeros[-1] + 0.1)
    np.testing.assert_allclose(found[: len(zeros)], zeros, rtol=1e-12)


@pytest.mark.parametrize("apart", [1e-2, 1e-5, 1e-7])
def test_roots_close_together_are_told_apart(apart):
    sol = solve(circle, (0, 6), [0.0, 1.0], events=lambda t, y: (t - 3) * (t - 3 - apart), **TIGHT)
    np.testing.assert_allclose(sol.t_events[0], [3, 3 + apart], atol=1e-8 * apart + 1e-14 / apart)


def test_touching_zeros_are_reported_where_they_are_asked_for():
    touches = iv.Event(lambda t, y: 1 - y[0], touching=True)
    silent = iv.Event(lambda t, y: 1 - y[0])
    sol = solve(circle, (0, 20), [0.0, 1.0], events=[touches, silent], **TIGHT)
    np.testing.assert_allclose(sol.t_events[0], (np.arange(3) * 2 + 0.5) * math.pi, atol=1e-6)
    assert len(sol.t_events[1]) == 0


@pytest.mark.parametrize("beside", [0.0, 1e-10])
def test_a_touching_zero_at_the_end_of_a_step_is_reported_once(beside):
    touches = iv.Event(lambda t, y: (t - 4 - beside) ** 2, touching=True)
    sol = solve(circle, (0, 8), [0.0, 1.0], events=touches, max_step=1.0, first_step=1.0, **TIGHT)
    assert 4.0 in sol.t
    np.testing.assert_allclose(sol.t_events[0], [4.0], atol=1e-7)


def test_touching_that_has_no_effect_is_told():
    with pytest.warns(UserWarning, match="touching of event .* has no effect: its function has branches, such as abs"):
        solve(circle, (0, 1), [0.0, 1.0], events=iv.Event(lambda t, y: abs(y[0]), touching=True))
    with pytest.warns(UserWarning, match="touching=True has no effect with dop853"):
        iv.solve_ivp(circle, (0, 1), [0.0, 1.0], "dop853", events=iv.Event(lambda t, y: y[0], touching=True))


# ----------------------------------------------------------------------------------------------------------------------
# What is refused


def searched(t, y):
    return [float(np.searchsorted([1.0, 2.0], t))]


@pytest.mark.parametrize(
    ("fun", "options", "error", "message"),
    [
        (searched, {}, TypeError, r"needs the expression graph of fun: .*numpy\.searchsorted.*use method='dop853'"),
        (circle, {"mass": np.eye(2)}, ValueError, "taylor is explicit and cannot use a mass matrix"),
        (circle, {"max_order": 2}, ValueError, "max_order must be from 3 to 40 for taylor, got 2"),
        (circle, {"max_order": 41}, ValueError, "max_order must be from 3 to 40 for taylor, got 41"),
    ],
)
def test_what_has_no_series_is_refused(fun, options, error, message):
    with pytest.raises(error, match=message):
        solve(fun, (0, 1), [1.0] if fun is searched else [1.0, 0.0], **options)


def test_no_components_have_no_series():
    with pytest.raises(ValueError, match="needs the expression graph of fun, and y0 is empty: use method='dop853'"):
        solve(lambda t, y: y, (0, 1), [])


def test_machine_code_is_refused():
    from numba import carray, cfunc, types

    @cfunc(
        types.void(
            types.double, types.CPointer(types.double), types.CPointer(types.double), types.CPointer(types.double)
        )
    )
    def native(t, y, dydt, p):
        carray(dydt, 1)[0] = -carray(y, 1)[0]

    with pytest.raises(TypeError, match="needs the expression graph of fun, and machine code has none"):
        solve(native, (0, 1), [1.0])


def test_it_takes_turns_with_no_other_method():
    with pytest.raises(ValueError, match="prefer: taylor does not take any fun"):
        iv.solve_ivp(circle, (0, 1), [1.0, 0.0], "auto", prefer=("taylor", "ode15s"))


def test_a_point_without_a_series_at_rest_is_a_solution():
    """y = 0 solves y' = √y, as with every other method."""
    sol = solve(lambda t, y: [np.sqrt(y[0])], (0, 1), [0.0])
    assert sol.success
    assert not sol.y.any()


@pytest.mark.parametrize("fun", [lambda t, y: [1 + y[0] ** 1.5], lambda t, y: [np.cos(t) + np.sqrt(y[0])]])
def test_points_without_a_series_are_named(fun):
    sol = solve(fun, (0, 1), [0.0])
    assert sol.status == -1
    assert "Component 0 of y has no Taylor series: its coefficient 2 is NaN or infinite" in sol.message
    assert "dop853" in sol.message


def test_stiffness_is_told():
    with pytest.warns(iv.StiffnessWarning, match="taylor: since t = .* most steps are limited by stability"):
        solve(lambda t, y: [-1e4 * (y[0] - np.cos(t))], (0, 1), [1.0], keep="end")


def test_the_classic_problems_are_solved():
    for problem in (problems.kepler(), problems.three_body()):
        sol = problem.solve("taylor", **TIGHT)
        assert sol.success


def test_squares_of_steps_are_exact_wherever_t_is():
    """Rounded squares of lengths with few bits are biased, and energies drift."""
    for t0 in (0.0, 2.0**17, 2.0**40):
        t = solve(circle, (t0, t0 + 100), [0.0, 1.0], rtol=1e-13).t
        mantissas = np.frexp(np.diff(t[:-2]))[0] * 2**25  # the last two share what is left of the interval
        assert len(mantissas) > 10
        assert (mantissas == np.round(mantissas)).all()


def test_a_linear_system_whose_solution_is_not_used_whole():
    """Coefficients of all entries of the solution are there for those of the next order, if the matrix varies."""

    def fun(t, y):
        x = np.linalg.solve(np.array([[2 + y[0], y[1]], [1.0, 3.0]]), np.array([-y[0], 1.0]))
        return [x[0], -y[1]]

    expected = iv.solve_ivp(fun, (0, 1), [1.0, 2.0], "dop853", rtol=1e-12, atol=1e-12).y[:, -1]
    for one in (fun, iv.compile(fun)):
        np.testing.assert_allclose(solve(one, (0, 1), [1.0, 2.0], **TIGHT).y[:, -1], expected, rtol=1e-10)
