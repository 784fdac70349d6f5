"""The solution between steps: continuous, the stored values at the ends, on the manifold if requested."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families, families_and_series
from problems import PROBLEMS, long_steps

MODES = ["projected", "corrected", "raw"]


@dealt(method=METHODS, problem=PROBLEMS, project=[False, True], interpolation=["projected", "corrected"])
def test_continuous_across_steps_to_a_few_ulp(method, problem, project, interpolation):
    """Just before and just after a knot the values differ by what the solution moves in that time, and by roundoff."""
    sol = problem.solve(method, project, dense_output=True, interpolation=interpolation)
    inner = sol.t[1:-1]
    size = np.abs(sol.y).max()
    before, after = sol.sol(np.nextafter(inner, -np.inf)), sol.sol(np.nextafter(inner, np.inf))
    slope = max(np.abs(problem.fun(t, y)).max() for t, y in zip(sol.t, sol.y.T, strict=True))
    bound = 16 * np.finfo(float).eps * size + 4 * slope * np.spacing(np.abs(sol.t).max())
    # `projected`: a projection to roundoff of g is one of y divided by the gradient
    bound *= 16 if interpolation == "projected" and project else 1
    assert np.abs(before - sol.y[:, 1:-1]).max() <= bound
    assert np.abs(after - sol.y[:, 1:-1]).max() <= bound


@families_and_series
def test_a_value_does_not_depend_on_the_other_times(method):
    """Values within a step are evaluated together, in blocks of which the last is not full."""
    t = np.linspace(0, 1, 1501)
    few, many = (iv.solve_ivp(spring, (0, 1), [1.0, 0.0, 0.5], method, t_eval=t[::k]).y for k in (100, 1))
    np.testing.assert_array_equal(many[:, ::100], few)


def spring(t, y):
    return [y[1], -y[0], y[0] * y[2]]


@dealt(method=METHODS, problem=PROBLEMS, interpolation=MODES)
def test_output_at_given_times_is_the_dense_output(method, problem, interpolation):
    dense = problem.solve(method, dense_output=True, interpolation=interpolation)
    np.testing.assert_array_equal(dense.sol(dense.t), dense.y)
    np.testing.assert_array_equal(dense.sol.ts, dense.t)
    t = np.linspace(*problem.t_span, 77)
    at_times = problem.solve(method, t_eval=t, interpolation=interpolation)
    np.testing.assert_array_equal(at_times.t, t)
    np.testing.assert_allclose(at_times.y, dense.sol(t), rtol=1e-13, atol=1e-13)
    refined = problem.solve(method, refine=3, interpolation=interpolation)
    np.testing.assert_allclose(refined.y, dense.sol(refined.t), rtol=1e-13, atol=1e-13)


@dealt(method=METHODS, problem=PROBLEMS)
def test_projected_values_keep_the_invariants_as_the_steps_do(method, problem):
    """Between steps the residual is the one that interpolates those of the two ends."""
    sol = problem.solve(method, refine=5)
    at_steps = sol.residual[:, ::5]
    scale = 1 + max(np.abs(np.atleast_1d(problem.g(t, y))).max() for t, y in zip(sol.t, sol.y.T, strict=True))
    for j in range(1, 5):
        blend = (1 - j / 5) * at_steps[:, :-1] + j / 5 * at_steps[:, 1:]
        # three iterations from the error of the extension reach roundoff, unless the steps are very long
        assert np.abs(sol.residual[:, j::5] - blend).max() < 1e-9 * scale
    raw = problem.solve(method, refine=5, interpolation="raw")
    assert np.abs(raw.residual).max() > 10 * np.abs(sol.residual).max()


def jump(method: str) -> float:
    """Distance by which the extension of the method misses the start of its step, in units of rtol: the Adams one does,
    a little (docs/algorithms.md, 'Adams')."""
    return 5 if method in ("ode113", "auto") else 0


def test_corrected_differs_from_raw_by_the_correction_only(method):
    problem = PROBLEMS["Lotka-Volterra"]
    raw = problem.solve(method, refine=4, interpolation="raw")
    corrected = problem.solve(method, refine=4, interpolation="corrected")
    np.testing.assert_array_equal(raw.y[:, ::4], corrected.y[:, ::4])
    weights = np.maximum(np.abs(corrected.y), 1e-3)
    longest = 4 if long_steps(method) else 1.01  # there the weights change more
    assert (np.abs(raw.y - corrected.y) / weights).max() <= (corrected.correction.max() + jump(method)) * 1e-3 * longest


@families
def test_without_invariants_all_modes_agree(method):
    problem = PROBLEMS["Kepler"]
    runs = [problem.solve(method, False, refine=4, interpolation=mode) for mode in MODES]
    np.testing.assert_array_equal(runs[0].y, runs[1].y)
    np.testing.assert_allclose(runs[2].y, runs[0].y, rtol=1e-13, atol=max(1e-14, jump(method) * 1e-3))


@explicit_and_implicit
def test_scalars_arrays_and_order_of_times(method):
    sol = PROBLEMS["Kepler"].solve(method, dense_output=True).sol
    t = np.array([3.0, 0.1, 19.9, 0.1, 20.0, 0.0])
    together = sol(t)
    assert together.shape == (4, 6)
    for i, one in enumerate(t):
        assert sol(one).shape == (4,)
        np.testing.assert_array_equal(sol(one), together[:, i])
    assert sol([]).shape == (4, 0)
    assert (sol.t_min, sol.t_max) == (0, 20)
    with pytest.raises(ValueError, match="1-dimensional"):
        sol([[1.0]])


@families_and_series
def test_backwards(method):
    problem = PROBLEMS["Kepler"]
    sol = iv.solve_ivp(problem.fun, (0, -20), problem.y0, method, dense_output=True, invariants=problem.invariants())
    assert sol.t[-1] == -20
    assert (sol.sol.t_min, sol.sol.t_max) == (-20, 0)
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    t = np.linspace(0, -20, 31)
    again = iv.solve_ivp(problem.fun, (0, -20), problem.y0, method, t_eval=t, invariants=problem.invariants())
    np.testing.assert_allclose(again.y, sol.sol(t), rtol=1e-13, atol=1e-13)


@families_and_series
def test_dense_output_outlives_the_run_and_may_be_used_in_threads(method):
    from concurrent.futures import ThreadPoolExecutor

    problem = PROBLEMS["Lotka-Volterra"]
    sol = problem.solve(method, dense_output=True).sol
    t = np.linspace(0, 50, 400)
    expected = sol(t)
    with ThreadPoolExecutor(4) as pool:
        for values in pool.map(sol, [t] * 8):
            np.testing.assert_array_equal(values, expected)


def oscillator(t, y):
    return [y[1], -y[0]]


def energy(t, y):
    return y[0] ** 2 + y[1] ** 2


def bounce(t, y):
    return y[0]


@dealt(method=FAMILIES, imposed=[False, True])
def test_copies_and_pickles_are_the_same_function(method, imposed):
    """Jumps and projection included; functions that are of no module stay behind where they can."""
    jump = iv.Event(bounce, direction=-1, action=lambda t, y: [0.0, -0.8 * y[1]])
    sol = iv.solve_ivp(oscillator, (0, 9), [1.0, 0.0], method, invariants=energy, events=jump, dense_output=True)
    sol = sol.impose() if imposed else sol
    t = np.linspace(-0.1, 9.1, 77)
    for one in (copy.copy(sol), copy.deepcopy(sol), pickle.loads(pickle.dumps(sol))):
        np.testing.assert_array_equal(one.sol(t), sol.sol(t))
        np.testing.assert_array_equal(one.sol.ts, sol.sol.ts)
        np.testing.assert_array_equal(one.residual, sol.residual)
        np.testing.assert_array_equal(one.impose().y, sol.impose().y)
    np.testing.assert_array_equal(copy.deepcopy(sol).extend(12).y, sol.extend(12).y)


@explicit_and_implicit
def test_a_lambda_is_copied_and_named_where_pickle_refuses_it(method):
    sol = iv.solve_ivp(oscillator, (0, 9), [1.0, 0.0], method, invariants=lambda t, y: y @ y, dense_output=True)
    np.testing.assert_array_equal(copy.deepcopy(sol).sol(1.1), sol.sol(1.1))
    with pytest.raises((AttributeError, pickle.PicklingError), match="<lambda>"):
        pickle.dumps(sol)


def test_outside_its_interval_a_solution_extrapolates_or_refuses():
    """The default is that of SciPy; with extrapolate=False the error names the time and the interval, ends included."""
    for span in ((0, 2), (2, 0)):
        sol = iv.solve_ivp(lambda t, y: -y, span, [1.0], dense_output=True).sol
        assert np.isfinite(sol(2.5)).all()
        np.testing.assert_array_equal(sol([0.0, 1.0, 2.0], extrapolate=False), sol([0.0, 1.0, 2.0]))
        for t in (2.5, [1.0, 2.5], -1e-9, np.nan):
            with pytest.raises(ValueError, match="outside the solution's interval, 0 to 2: extend the run"):
                sol(t, extrapolate=False)
    dae = iv.solve_dae(lambda t, y, yp: [yp[0] + y[0]], (0, 2), [1.0], dense_output=True).sol
    with pytest.raises(ValueError, match="outside the solution's interval"):
        dae(3, extrapolate=False)
