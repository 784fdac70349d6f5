"""The classes for SciPy: its solve_ivp with them, and stepping by hand, are our solve."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
import scipy.integrate
from scipy.integrate import OdeSolver

import invariode as iv
import invariode.scipy as plugin
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families
from problems import PROBLEMS, blow_up, implicit

CLASSES = {name: getattr(plugin, name.upper()) for name in iv.METHODS}


def theirs(problem, method, t_span=None, y0=None, **options):
    return scipy.integrate.solve_ivp(
        problem.fun, t_span or problem.t_span, y0 or problem.y0, method=CLASSES[method], **options
    )


def test_every_method_has_its_class(method):
    assert issubclass(CLASSES[method], OdeSolver)
    assert CLASSES[method].__name__ == method.upper()
    by_class = iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], CLASSES[method])
    np.testing.assert_array_equal(by_class.y, iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], method).y)


@pytest.mark.parametrize("name", [about.scipy_name for about in iv.METHODS.values() if about.scipy_name])
def test_names_of_scipy_are_classes_too(name):
    """This holds too where the name implies an option, as BDF does."""
    problem = PROBLEMS["Kepler"]
    expected = problem.solve(name)
    for solve in (scipy.integrate.solve_ivp, iv.solve_ivp):
        method = getattr(plugin, name)
        sol = solve(problem.fun, problem.t_span, problem.y0, method=method, invariants=problem.invariants())
        np.testing.assert_array_equal(sol.y, expected.y)


@dealt(method=METHODS, problem=PROBLEMS, project=[False, True])
def test_the_steps_the_counts_and_the_dense_output_are_ours(method, problem, project):
    invariants = problem.invariants() if project else None
    ours = problem.solve(method, project, dense_output=True)
    sol = theirs(problem, method, invariants=invariants, dense_output=True)
    assert (sol.status, sol.message) == (0, ours.message)
    np.testing.assert_array_equal(sol.t, ours.t)
    np.testing.assert_array_equal(sol.y, ours.y)
    assert (sol.nfev, sol.njev, sol.nlu) == (ours.nfev, ours.njev, ours.nlu)
    t = np.linspace(*problem.t_span, 301)
    np.testing.assert_array_equal(sol.sol(t), ours.sol(t))


@families
def test_nfev_is_the_number_of_calls(method):
    """Each by itself, and none twice; tests of the Jacobian and the search for jumps of f are not of the method."""
    calls = [0]

    def fun(t, y):
        calls[0] += 1
        return PROBLEMS["Kepler"].fun(t, y)

    options = {} if not implicit(method) else {"jac": np.zeros((4, 4))}  # else differences are calls as well
    solver = CLASSES[method](fun, 0, [0.4, 0, 0, 2], 20, **options)
    assert solver.nfev + solver._walk.core.nfev_check == calls[0] > 0
    while solver.status == "running":
        solver.step()
        solver.dense_output()
        assert solver.nfev + solver._walk.core.nfev_check == calls[0]
        if method == "ode15s" and solver.t > 0.1:
            break


@dealt(method=FAMILIES, t_span=[(0, 20), (20, 0)])
def test_events_of_scipy_are_ours(method, t_span):
    """Located by SciPy on our continuous extension: to the accuracy of its root finder, 4 ulp."""
    problem = PROBLEMS["Kepler"]

    def crossing(t, y):
        return y[0] - 0.1

    crossing.direction = 1
    events = [crossing, lambda t, y: y[3] + 0.05]
    about = {"invariants": problem.invariants(), "events": events, "rtol": 1e-6, "atol": 1e-9}
    ours = iv.solve_ivp(problem.fun, t_span, problem.y0, method, **about)
    sol = theirs(problem, method, t_span, **about)
    for a, b, ya, yb in zip(sol.t_events, ours.t_events, sol.y_events, ours.y_events, strict=True):
        assert len(a) > 0
        assert len(a) > 2
        np.testing.assert_allclose(a, b, atol=1e-13)
        np.testing.assert_allclose(ya, yb, atol=1e-12)


@explicit_and_implicit
@pytest.mark.filterwarnings("ignore::invariode.AccuracyWarning")  # a few steps from rest, in which y3 has no error
def test_a_terminal_event_of_scipy_ends_the_run_on_the_manifold(method):
    problem = PROBLEMS["pendulum"]

    def bottom(t, y):
        return y[0]

    bottom.terminal = True
    sol = theirs(problem, method, invariants=problem.invariants(), events=bottom, rtol=1e-6, atol=1e-9)
    ours = problem.solve(method, events=bottom, rtol=1e-6, atol=1e-9)
    assert sol.status == 1
    np.testing.assert_allclose(sol.t[-1], ours.t[-1], rtol=1e-13)
    assert np.abs(problem.g(sol.t[-1], sol.y[:, -1])).max() < 1e-9


@explicit_and_implicit
@pytest.mark.parametrize("backwards", [False, True])
def test_times_of_output(method, backwards):
    problem = PROBLEMS["rigid body"]
    t_span = problem.t_span[::-1] if backwards else problem.t_span
    times = np.linspace(*t_span, 40)
    sol = theirs(problem, method, t_span, t_eval=times)
    ours = iv.solve_ivp(problem.fun, t_span, problem.y0, method, t_eval=times)
    np.testing.assert_array_equal(sol.t, times)
    np.testing.assert_allclose(sol.y, ours.y, rtol=1e-13, atol=1e-13)


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_stepping_by_hand_is_the_solve(method, problem):
    ours = problem.solve(method, dense_output=True)  # as the solver has, whose steps answer for values between them
    solver = CLASSES[method](
        problem.fun, problem.t_span[0], problem.y0, problem.t_span[1], invariants=problem.invariants()
    )
    assert (solver.t, solver.t_old, solver.step_size, solver.direction) == (problem.t_span[0], None, None, 1)
    t, kept = [solver.t], [solver.y]
    while solver.status == "running":
        assert solver.step() is None
        assert solver.t_old == t[-1]
        t.append(solver.t)
        kept.append(solver.y)
    assert solver.status == "finished"
    np.testing.assert_array_equal(t, ours.t)
    np.testing.assert_array_equal(np.transpose(kept), ours.y)
    np.testing.assert_array_equal(solver.order, ours.steps.order[-1])
    with pytest.raises(RuntimeError, match="finished"):
        solver.step()


@explicit_and_implicit
def test_an_interpolant_outlives_its_step_and_its_solver(method):
    problem = PROBLEMS["Lotka-Volterra"]
    solver = CLASSES[method](problem.fun, 0, problem.y0, 50, invariants=problem.invariants())
    with pytest.raises(RuntimeError, match="after a successful"):
        solver.dense_output()
    solver.step()
    first = solver.dense_output()
    middle, ends = first((first.t_min + first.t_max) / 2), first([first.t_min, first.t_max])
    np.testing.assert_array_equal(ends[:, 1], solver.y)
    for _ in range(5):
        solver.step()
    del solver
    np.testing.assert_array_equal(first((first.t_min + first.t_max) / 2), middle)
    assert middle.shape == (2,)
    with pytest.raises(ValueError, match="1-D"):
        first([[1.0]])


@explicit_and_implicit
def test_complex_states(method):
    sol = scipy.integrate.solve_ivp(
        lambda t, y: 1j * y, (0, 10), [1 + 0j], method=CLASSES[method], dense_output=True, rtol=1e-6, atol=1e-8,
        invariants=lambda t, y: abs(y[0]) ** 2,
    )  # fmt: skip
    assert sol.y.dtype == complex
    np.testing.assert_allclose(sol.sol(7.3), np.exp([7.3j]), atol=1e-3)
    np.testing.assert_allclose(np.abs(sol.sol(np.linspace(0, 10, 50))), 1, atol=1e-8)


CORNERS = {
    "zero-length interval": ((0, 0), [1.0, 2.0], {}),
    "empty y0": ((0, 1), [], {}),
    "one ulp": ((1.0, np.nextafter(1.0, 2)), [1.0, 2.0], {}),
    "vectorized": ((0, 1), [1.0, 2.0], {"vectorized": True}),
    "integers": ((0, 1), [1, 2], {}),
    "args": ((0, 1), [1.0, 2.0], {"args": (3.0,)}),
    "vector tolerances": ((0, 1), [1.0, 2.0], {"rtol": [1e-3, 1e-5], "atol": [1e-6, 1e-8]}),
    "first_step": ((0, 1), [1.0, 2.0], {"first_step": 0.01}),
    "max_step": ((0, 1), [1.0, 2.0], {"max_step": np.inf}),
}


@dealt(method=FAMILIES, name=CORNERS, dense_output=[False, True])
def test_corner_cases(method, name, dense_output):
    t_span, y0, options = CORNERS[name]

    def decay(t, y, a=0.5):
        assert y.ndim == (2 if options.get("vectorized") else 1)
        return -a * y

    sol = scipy.integrate.solve_ivp(decay, t_span, y0, method=CLASSES[method], dense_output=dense_output, **options)
    ours = iv.solve_ivp(decay, t_span, y0, method, **options)
    assert (sol.status, sol.t[-1]) == (0, t_span[1])
    np.testing.assert_array_equal(sol.y[:, -1], ours.y[:, -1])


@explicit_and_implicit
def test_an_infinite_bound(method):
    solver = CLASSES[method](lambda t, y: [y[1], -y[0]], 0, [1.0, 0.0], np.inf, rtol=1e-6, atol=1e-8)
    while solver.t < 30:
        solver.step()
    assert solver.status == "running"
    np.testing.assert_allclose(solver.dense_output()(30.0), [np.cos(30), -np.sin(30)], atol=1e-3)


@explicit_and_implicit
def test_a_step_that_fails_has_our_message(method):
    sol = scipy.integrate.solve_ivp(blow_up, (0, 2), [1.0], method=CLASSES[method])
    ours = iv.solve_ivp(blow_up, (0, 2), [1.0], method)
    assert (sol.status, sol.success, sol.message) == (-1, False, ours.message)
    assert "t = " in sol.message
    nan = scipy.integrate.solve_ivp(lambda t, y: [np.nan], (0, 1), [1.0], method=CLASSES[method])
    assert "not finite at the start" in nan.message


@explicit_and_implicit
def test_a_failed_solver_has_no_interpolant(method):
    solver = CLASSES[method](blow_up, 0, [1.0], 2)
    while solver.status == "running":
        solver.step()
    assert solver.status == "failed"
    with pytest.raises(RuntimeError, match="no dense output"):
        solver.dense_output()


@explicit_and_implicit
def test_an_invariant_that_is_none_is_refused_by_the_constructor_or_ends_the_run(method):
    with pytest.raises(iv.InvariantError, match="not conserved"):
        CLASSES[method](lambda t, y: [y[1], -y[0]], 0, [1.0, 0.5], 10, invariants=lambda t, y: y[0])
    late = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -y[0] - (t > 5)], (0, 10), [1.0, 0.0], method=CLASSES[method],
        invariants=lambda t, y: y[0] ** 2 + y[1] ** 2,
    )  # fmt: skip
    assert late.status == -1
    assert "is not conserved" in late.message


@explicit_and_implicit
def test_exceptions_come_out_and_end_the_solver(method):
    def late(t, y):
        if t > 0.5:
            raise ZeroDivisionError("mine")
        return -y

    solver = CLASSES[method](late, 0, [1.0], 2)
    with pytest.raises(ZeroDivisionError, match="mine"):
        all(solver.step() is None for _ in range(1000))
    with pytest.raises(RuntimeError, match="earlier step"):
        solver.step()


@explicit_and_implicit
def test_a_function_may_not_step_its_own_solver(method):
    def fun(t, y):
        if solver is not None:
            solver.step()
        return -y

    solver = None
    solver = CLASSES[method](fun, 0, [1.0], 2)
    with pytest.raises(RuntimeError, match="being advanced"):
        solver.step()


@dealt(method=METHODS, name=["rtoll", "invariant", "events", "t_eval", "refine", "dense_output", "keep"])
def test_unknown_options_are_refused(method, name):
    hint = {"rtoll": "did you mean 'rtol'", "invariant": "did you mean 'invariants'"}.get(name, "option of solve_ivp")
    with pytest.raises(TypeError, match=f"{name}.*{hint}"):
        CLASSES[method](lambda t, y: -y, 0, [1.0], 1, **{name: 1})


def test_options_that_the_method_cannot_use_are_warned_of(method):
    options = {"jac": np.zeros((1, 1)), "lband": 0, "bdf": True, "max_order": 2, "fsal": "evaluate"}
    for name, given in options.items():
        if name not in iv.METHODS[method].options:
            with pytest.warns(UserWarning, match=f"'{name}' has no effect on {method}"):
                CLASSES[method](lambda t, y: -y, 0, [1.0], 1, **{name: given})


def test_mass_matrices_and_jacobians_reach_ode15s():
    def robertson(t, y):
        a, b, c = y
        return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, a + b + c - 1]

    about = {"mass": np.diag([1.0, 1, 0]), "rtol": 1e-5, "atol": [1e-8, 1e-12, 1e-8]}
    sol = scipy.integrate.solve_ivp(robertson, (0, 1e6), [1.0, 0, 0], method=plugin.ODE15S, **about)
    ours = iv.ode15s(robertson, (0, 1e6), [1.0, 0, 0], **about)
    np.testing.assert_array_equal(sol.y, ours.y)
    assert (sol.njev, sol.nlu) == (ours.njev, ours.nlu)


class Simulation:
    """A simulation whose functions refer to the solver that has them."""

    def __init__(self, method, *matrices):
        given = {name: getattr(self, name) for name in ("invariants", *matrices)}
        self.solver = CLASSES[method](self.fun, 0, [1.0, 0.0], 10, **given)

    def fun(self, t, y):
        return [y[1], -y[0]]

    def invariants(self, t, y):
        return y[0] ** 2 + y[1] ** 2

    def jac(self, t, y):
        return np.array([[0.0, 1.0], [-1.0, 0.0]])

    def mass(self, t):
        return np.eye(2)


def after_use(simulation):
    simulation.solver.step()
    simulation.solver.dense_output()
    return weakref.ref(simulation)


@pytest.mark.usefixtures("few_objects")
@explicit_and_implicit
def test_a_solver_that_its_functions_refer_to_is_collected(method):
    alive = after_use(Simulation(method))
    gc.collect()
    assert alive() is None


@pytest.mark.usefixtures("few_objects")
@pytest.mark.parametrize("matrices", [["jac"], ["mass"], ["jac", "mass"]])
def test_a_solver_that_its_matrices_refer_to_is_collected(matrices):
    alive = after_use(Simulation("ode15s", *matrices))
    gc.collect()
    assert alive() is None


@pytest.mark.usefixtures("few_objects")
@explicit_and_implicit
def test_the_solver_keeps_what_it_needs(method):
    """Without a reference to the functions from anywhere else."""
    solver = CLASSES[method]((lambda a: lambda t, y: [-a * y[0]])(0.5), 0, [1.0], 4, rtol=1e-6, atol=1e-9)
    gc.collect()
    while solver.status == "running":
        solver.step()
    np.testing.assert_allclose(solver.y, np.exp(-2), rtol=1e-4)


def test_a_step_that_a_function_interrupted_stays_interrupted():
    """Asking once more for the continuous solution ended the process."""
    armed = False

    def fun(t, y):
        if armed:
            raise RuntimeError("boom")
        return [y[1], -y[0]]

    solver = plugin.DOP853(fun, 0, [1.0, 0], 10)
    solver.step()
    armed = True
    with pytest.raises(RuntimeError, match="boom"):
        solver.dense_output()
    with pytest.raises(RuntimeError, match="no accepted step"):
        solver.dense_output()
