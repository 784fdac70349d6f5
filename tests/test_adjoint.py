"""The gradient by one run backwards is that of the forward sensitivities, within some tolerances."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
from cases import FAMILIES, IMPLICIT, METHODS, SERIES, dealt, explicit_and_implicit, families
from gradients import ATOL, CHECKPOINTS, RATES, RTOL, START, predators, solved
from invariode._plan.plan import solver
from invariode._plan.planning import make_plan
from invariode._problem.core_problem import VariationTerms

#: The last digits of the reference are those of an error of 1e-13.
GRADIENT = np.array([0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395])
#: In units of rtol, times the sizes of the terms: the errors of the two runs, on which the methods differ.
MOST = {2: 3000, 3: 1000}


def sections(sol):
    """Return the number of sections of a run."""
    return sum(len(one.begins) for one in sol._origin.sectioned)


def conserved(t, y, a, b, c, d):
    return d * y[0] - c * np.log(y[0]) + b * y[1] - a * np.log(y[1])


@dealt(method=FAMILIES, held=[False, True])
def test_the_gradient_is_the_one_known(method, held):
    """G = ½ |y(10) − 1|², whose gradient is known, with the law held whose form depends on the parameters."""
    rtol = 1e-5 if iv.METHODS[method].order == 2 else RTOL
    sol = solved(method, invariants=conserved if held else None, rtol=rtol, atol=rtol / 100)
    found = sol.gradient(sol.y[:, -1] - 1)
    assert np.abs(found - GRADIENT).max() < MOST.get(iv.METHODS[method].order, 300) * rtol


@pytest.mark.parametrize("method", ["dop853", "ode15s"])
def test_costs_at_several_times_add_up(method):
    """The first and the last time among them, and one of them twice."""
    sol = solved(method, sensitivities=["b", "y0", "c"], t_eval=np.linspace(0, 10, 6))
    costs = np.random.default_rng(29).normal(size=sol.y.shape)
    expected = np.einsum("it,ikt->k", costs, sol.sensitivities)
    size = np.abs(sol.sensitivities).sum()
    assert np.abs(sol.gradient(costs) - expected).max() < 20 * RTOL * size
    twice = sol.gradient(np.repeat(costs[:, 2:3] / 2, 2, axis=1), t=[4.0, 4.0])
    assert np.array_equal(twice, sol.gradient(costs[:, 2], t=4.0))


@pytest.mark.parametrize("span", [(0, 3), (3, 0)])
def test_the_gradient_of_an_integral_is_that_of_one_more_component(span):
    def cost(t, y, a, b, c, d):
        return a * y[0] * y[1] + t * y[1]

    def with_cost(t, y, a, b, c, d):
        return [*predators(t, y[:2], a, b, c, d), cost(t, y, a, b, c, d)]

    sol = solved(t_span=span)
    more = iv.solve_ivp(
        with_cost, span, [*START, 0.0], "dop853", args=RATES, rtol=RTOL, atol=ATOL, sensitivities=["a", "d", "y0[1]"]
    )
    found = sol.gradient(integrand=cost, wrt=["a", "d", "y0[1]"])
    np.testing.assert_allclose(found, more.sensitivities[2, :, -1], rtol=100 * RTOL)


@pytest.mark.parametrize("method", ["ode45", "radau"])
def test_a_mass_matrix_and_what_depends_on_y0(method):
    """Against the forward run, with M neither diagonal nor symmetric, and with y0 a function of a parameter."""
    wanted = iv.Sensitivities(args=["a", "c"], y0=True, dy0dp=[[1.0, 0.0], [0.5, 2.0]])
    mass = np.array([[2.0, 1.0], [0.0, 1.0]]) if method == "radau" else None
    sol = solved(method, (0, 2), mass=mass, sensitivities=wanted)
    cost = np.array([1.0, -2.0])
    np.testing.assert_allclose(sol.gradient(cost), cost @ sol.sensitivities[:, :, -1], rtol=1e-4)


def forced(number):
    """A problem (fun, args, options of the problem, options of the run) of two components on (0, 4), from (1, 0.5):
    linear, an oscillator, not linear, or stiff; with fast forcing, with kinks, a table, doses, or a bend."""
    rng = np.random.default_rng(number)
    k, p, w, dose = rng.uniform(0.3, 2), rng.uniform(0.5, 2), rng.uniform(20, 80), rng.uniform(0.3, 1.5)
    kind, form, problem, run = number // 4 % 5, number % 4, {}, {}
    if kind == 1:
        run["breakpoints"] = np.arange(1, 4 * w / 8 / np.pi) * np.pi / (w / 8)
    elif kind == 2:
        values = rng.uniform(-1, 1, 6)
        problem["inputs"] = iv.Input([0, 0.7, 1.3, 2.2, 3.1, 4.0], values, ["previous", "linear", "cubic"][number % 3])
    elif kind == 3:
        run["breakpoints"] = {t: lambda t, y, k, p: [y[0] + dose * p, y[1]] for t in (0.5, 1.5, 2.5)}
    elif kind == 4:
        run["breakpoints"] = [1.0]
    forces = {
        0: lambda t: np.sin(w * t),
        1: lambda t: np.abs(np.sin(w / 8 * t)),
        3: np.cos,
        4: lambda t: np.maximum(t - 1.0, 0.0) * np.exp(-t),
    }

    def fun(t, y, *args):
        (u, k, p) = args if kind == 2 else (forces[kind](t), *args)
        slopes = (
            lambda x, v: [p * u - k * x, x - v],
            lambda x, v: [v, p * u - k * x - 0.3 * v],
            lambda x, v: [p * u**2 - k * x**2, k * x - p * v],
            lambda x, v: [20 * k * (p * u - x), k * x * v - v - p * x],
        )
        return slopes[form](y[0], y[1])

    return fun, (k, p), problem, run


#: The kinds of forcing, of which each method meets all, in other forms.
KINDS = 5


@pytest.mark.slow
@pytest.mark.parametrize("method", [*METHODS, *SERIES])
def test_both_ways_agree_within_100_tolerances(method):
    """G = y0 − 0.7 y1 at the end: one tolerance of dG/dp is Σ |∂G/∂y_i| (rtol |S_ij| + atol / |p_j|). What f does with
    t is faster than λ, whose run has to notice it."""
    cost, place = np.array([1.0, -0.7]), [*METHODS, *SERIES].index(method)
    tol = 1e-5 if iv.METHODS[method].order <= 3 else 1e-7
    for kind in range(KINDS):
        form, draw = (place + kind) % 4, (place + kind) // 4 % 2  # with 13 methods each of the 40 problems comes
        fun, args, problem, run = forced(20 * draw + 4 * kind + form)
        posed = iv.Problem(fun, (0, 4), [1.0, 0.5], args=args, sensitivities=True, **problem)
        sol = posed.solve(method, rtol=tol, atol=tol, adjoint=True, **run)
        S = sol.sensitivities[:, :, -1]
        tolerance = np.abs(cost) @ (tol * np.abs(S) + tol / np.array(args))
        assert (np.abs(sol.gradient(cost) - cost @ S) < 100 * tolerance).all()


@pytest.mark.parametrize("method", [*METHODS, *SERIES])
def test_the_integrand_of_the_gradient_may_be_faster_than_the_multiplier(method):
    """G = y(4) for y' = −0.8 y + p sin(60 t), so that dG/dp = ∫ exp(−0.8 (4 − t)) sin(60 t) dt."""
    k, w, tf = 0.8, 60.0, 4.0
    exact = (k * np.sin(w * tf) - w * np.cos(w * tf) + w * np.exp(-k * tf)) / (k**2 + w**2)
    tol = 1e-5 if iv.METHODS[method].order <= 3 else 1e-8
    sol = iv.solve_ivp(
        lambda t, y, p: [-k * y[0] + p * np.sin(w * t)],
        (0, tf),
        [1.0],
        method,
        args=(1.3,),
        rtol=tol,
        atol=tol,
        adjoint=True,
    )
    assert abs(sol.gradient([1.0])[0] - exact) < 100 * tol


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning", "ignore::invariode.AccuracyWarning")
@pytest.mark.parametrize("method", ["dop853", "ode113", "radau"])
def test_the_run_backwards_lands_where_the_run_has_found_a_discontinuity(method):
    """f cannot be traced, jumps at t = 1.3 and is constant besides: λ is smooth there, and the integrand is not."""

    def fun(t, y, p):
        try:
            pulse = 3.0 if t < 1.3 else -1.0
        finally:
            pass
        return [p * pulse - y[0]]

    sol = iv.solve_ivp(fun, (0, 4), [1.0], method, args=(0.7,), rtol=RTOL, atol=RTOL, adjoint=True)
    exact = 3 * (np.exp(-2.7) - np.exp(-4)) - (1 - np.exp(-2.7))
    assert sol.stats.discontinuities
    assert abs(sol.gradient([1.0])[0] - exact) < 10 * RTOL


@dealt(method=[one for one in IMPLICIT if "linear_solver" in METHODS[one].options], mass=[False, True])
def test_quadratures_need_no_linear_systems(method, mass):
    """The core's integrals of functions of y, two and a half blocks of them, are those of further components; the
    systems of the state are solved by factors or by GMRES, and M is that of the state alone."""
    M = np.array([[2.0, 0.5], [0.0, 4.0]])

    def inner(t, y):
        return np.array([-50 * (y[0] - np.cos(t)), y[0] - y[1]])

    def fun(t, y):
        return M @ inner(t, y) if mass else inner(t, y)

    def integrands(t, y):
        return np.array([np.sin(20 * t) * y[1], y[0] ** 2, y[0] * y[1], np.exp(-t), 1.0])

    tol, count = 1e-5, 5
    whole = iv.solve_ivp(
        lambda t, y: [*inner(t, y), *integrands(t, y)],
        (0, 2),
        np.append([0.0, 1.0], np.zeros(count)),
        "radau",
        rtol=1e-9,
    )
    for linear_solver in ("direct",) if mass else ("direct", "gmres"):
        about = iv.Problem(fun, (0, 2), [0.0, 1.0], mass=M if mass else None)
        plan = make_plan(about, method, {"rtol": tol, "atol": tol, "linear_solver": linear_solver})

        def slope(t, Y):
            return np.append(integrands(t, Y[0]), 0.0).reshape(3, 2)

        behind = VariationTerms(k=3, slope=slope, thresholds=np.full((3, 2), tol), quadratures=True)
        run = solver(plan, behind).integrate(np.append([0.0, 1.0], np.zeros(6)))
        assert run.state == "reached_end"
        np.testing.assert_allclose(run.end[:7], whole.y[:, -1], atol=100 * tol)


def of_some_hundred_steps(method):
    """Tolerances with which a run has steps enough for several sections, and not many more; ode23 is of order 3, and
    its error of order 2."""
    rtol = 1e-4 if method == "ode23" or iv.METHODS[method].order == 2 else 1e-6
    return {"rtol": rtol, "atol": rtol / 100}


@families
def test_checkpoints_change_no_bit_of_the_gradient(method):
    """A long run of each kind of memory, where invariants are held, with costs at several times and an integral."""
    given = {"t_span": (0, 8), "invariants": conserved} | of_some_hundred_steps(method)
    whole = solved(method, **given)
    sol = solved(method, **given, keep="end", **CHECKPOINTS)
    assert sol.sol is None
    assert sections(sol) > 1
    costs, times = np.random.default_rng(29).normal(size=(2, 7)), np.linspace(0, 8, 7)
    more = {"t": times, "integrand": lambda t, y, a, b, c, d: y[0] * y[1]}
    assert np.array_equal(sol.gradient(costs, **more), whole.gradient(costs, **more))
    assert np.array_equal(sol.gradient([1.0, 0.0], wrt="y0"), whole.gradient([1.0, 0.0], wrt="y0"))


@pytest.mark.slow
@families
def test_checkpoints_of_a_run_that_is_extended_limited_or_imposed(method):
    given = {"invariants": conserved, "max_steps": 60} | of_some_hundred_steps(method)
    expected, sol = (solved(method, (0, 60), **given, **more) for more in ({}, CHECKPOINTS))
    assert sol.status == -3
    for change in (lambda one: one, lambda one: one.extend(one.t_end + 4, max_steps=None), lambda one: one.impose()):
        expected, sol = change(expected), change(sol)
        cost = {"dG_dy": [1.0, 2.0], "t": sol.t_end}
        assert np.array_equal(sol.gradient(**cost), expected.gradient(**cost))
    assert [len(one.begins) > 1 for one in sol._origin.sectioned] == [True, True]


@explicit_and_implicit
def test_the_memory_of_checkpoints_grows_with_the_root_of_the_steps(method):
    sizes, steps = [], []
    for end in (50, 800):
        sol = solved(method, (0, end), rtol=1e-6, keep="end", **CHECKPOINTS)
        (one,) = sol._origin.sectioned
        counts = np.diff([begin for begin, _, _ in one.begins] + [one.steps])
        sizes.append([sum(len(memory) for _, _, memory in one.begins), counts.max()])
        steps.append(one.steps)
    assert steps[1] > 10 * steps[0]
    assert (np.divide(*sizes[::-1]) < 2.5 * np.sqrt(steps[1] / steps[0])).all()


def test_functions_that_change_between_two_runs_are_found_out():
    """A change by roundoff counts too, which changes no step."""
    rate = [1.0]
    sol = iv.solve_ivp(lambda t, y, k: [-k * rate[0] * y[0]], (0, 3), [1.0], args=(0.5,), rtol=1e-9, **CHECKPOINTS)
    for rate[0] in (2.0, 1.0 + 1e-15):
        with pytest.raises(ValueError, match=r"other steps up to t = .*: a function .* or use adjoint=True"):
            sol.gradient([1.0], wrt="y0")


def test_where_there_are_no_checkpoints(tmp_path):
    with pytest.raises(ValueError, match="give one of them"):
        solved(dense_output=True, **CHECKPOINTS)
    with pytest.raises(TypeError, match='adjoint must be True, False or "checkpoints", got'):
        solved(adjoint="some")
    problem = iv.Problem(predators, (0, 1), START, args=RATES)
    problem.solve(**CHECKPOINTS).save(tmp_path / "run")
    again = iv.load(tmp_path / "run", problem)
    for sol in (again, again.extend(2)):
        with pytest.raises(ValueError, match="checkpoints, which are not in files"):
            sol.gradient([1.0, 0.0])
    still = iv.solve_ivp(predators, (0, 0), START, args=RATES, **CHECKPOINTS)
    assert np.array_equal(still.gradient([1.0, 2.0], wrt="y0"), [1.0, 2.0])


def test_each_of_many_parameters_has_its_derivative():
    """y'' + y = a sum of 60 pulses, each with a weight: y(3) answers a push at t by sin(3 − t)."""
    nodes = np.linspace(0, 3, 60)

    def pushed(t, y, weights):
        return [y[1], -y[0] + weights @ np.exp(-((t - nodes) ** 2))]

    sol = iv.solve_ivp(pushed, (0, 3), START, "dop853", args=(np.cos(nodes),), rtol=1e-9, atol=1e-11, adjoint=True)
    fine = np.linspace(0, 3, 20001)
    expected = [scipy.integrate.trapezoid(np.sin(3 - fine) * np.exp(-((fine - node) ** 2)), fine) for node in nodes]
    np.testing.assert_allclose(sol.gradient([1.0, 0.0]), expected, rtol=1e-7)


def test_a_jump_of_f_at_a_breakpoint_is_not_stepped_over():
    sol = iv.solve_ivp(
        lambda t, y, k: [-k * y[0] + (3.0 if t < 1 else 0.0)],
        (0, 2),
        [1.0],
        "dop853",
        args=(2.0,),
        rtol=1e-10,
        atol=1e-12,
        breakpoints=[1.0],
        adjoint=True,
        sensitivities=["k", "y0"],
    )
    np.testing.assert_allclose(sol.gradient([1.0]), sol.sensitivities[0, :, -1], rtol=1e-8)
