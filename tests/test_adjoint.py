"""The gradient by one run backwards is that of the forward sensitivities, within some tolerances."""

from __future__ import annotations

import math
import types

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
from cases import FAMILIES, IMPLICIT, METHODS, SERIES, dealt, explicit_and_implicit, families
from invariode import _core
from invariode._adjoint.jumps import at_bounds
from invariode._plan.plan import solver
from invariode._plan.planning import make_plan
from invariode._run.run import solve
from test_sensitivities_complex import condensate, in_reals, inside, precession, turned, untraced_precession

RTOL, ATOL = 1e-7, 1e-9
RATES = (1.5, 1.0, 3.0, 1.0)
START = [1.0, 1.0]
#: The last digits of the reference are those of an error of 1e-13.
GRADIENT = np.array([0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395])
#: In units of rtol, times the sizes of the terms: the errors of the two runs, on which the methods differ.
MOST = {2: 3000, 3: 1000}


CHECKPOINTS = {"adjoint": "checkpoints"}


def sections(sol):
    """Return the number of sections of a run."""
    return sum(len(one.begins) for one in sol._origin.sectioned)


def predators(t, y, a, b, c, d):
    return [a * y[0] - b * y[0] * y[1], -c * y[1] + d * y[0] * y[1]]


def conserved(t, y, a, b, c, d):
    return d * y[0] - c * np.log(y[0]) + b * y[1] - a * np.log(y[1])


def solved(method="dop853", t_span=(0, 10), **options):
    given = {"args": RATES, "rtol": RTOL, "atol": ATOL, "max_step": np.inf, "adjoint": True} | options
    return iv.solve_ivp(predators, t_span, START, method, **given)


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


#: How many of these problems each method solves: with 13 methods each of the 40 comes about three times.
OF_EACH = 10


@pytest.mark.slow
@pytest.mark.parametrize("method", [*METHODS, *SERIES])
def test_both_ways_agree_within_100_tolerances(method):
    """G = y0 − 0.7 y1 at the end: one tolerance of dG/dp is Σ |∂G/∂y_i| (rtol |S_ij| + atol / |p_j|). What f does with
    t is faster than λ, whose run has to notice it."""
    cost, place = np.array([1.0, -0.7]), [*METHODS, *SERIES].index(method)
    tol = 1e-5 if iv.METHODS[method].order <= 3 else 1e-7
    for i in range(OF_EACH):
        fun, args, problem, run = forced((place + 4 * i + i // 5) % 40)
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

        behind = _core.Variations(k=3, slope=slope, thresholds=np.full((3, 2), tol), quadratures=True)
        run = solver(plan, behind).integrate(np.append([0.0, 1.0], np.zeros(6)))
        assert run.state == "reached_end"
        np.testing.assert_allclose(run.end[:7], whole.y[:, -1], atol=100 * tol)


def of_some_hundred_steps(method):
    """Tolerances with which a run has steps enough for several sections, and not many more; ode23 is of order 3, and
    its error of order 2."""
    rtol = 1e-4 if method == "ode23" or iv.METHODS[method].order == 2 else 1e-6
    return {"rtol": rtol, "atol": rtol / 100}


@pytest.mark.parametrize("method", METHODS)
def test_checkpoints_change_no_bit_of_the_gradient(method):
    """A long run, where invariants are held, with costs at several times and an integral."""
    given = {"t_span": (0, 15), "invariants": conserved} | of_some_hundred_steps(method)
    whole = solved(method, **given)
    sol = solved(method, **given, keep="end", **CHECKPOINTS)
    assert sol.sol is None
    assert sections(sol) > 1
    costs, times = np.random.default_rng(29).normal(size=(2, 7)), np.linspace(0, 15, 7)
    more = {"t": times, "integrand": lambda t, y, a, b, c, d: y[0] * y[1]}
    assert np.array_equal(sol.gradient(costs, **more), whole.gradient(costs, **more))
    assert np.array_equal(sol.gradient([1.0, 0.0], wrt="y0"), whole.gradient([1.0, 0.0], wrt="y0"))


@pytest.mark.slow
@families
def test_checkpoints_of_a_run_that_is_extended_limited_or_imposed(method):
    given = {"invariants": conserved, "max_steps": 60} | of_some_hundred_steps(method)
    expected, sol = (solved(method, (0, 60), **given, **more) for more in ({}, CHECKPOINTS))
    assert sol.status == -3
    for change in (lambda one: one, lambda one: one.extend(one.t_end + 8, max_steps=None), lambda one: one.impose()):
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
    """Also by roundoff, which changes no step."""
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


def both_ways(sol, *, times=None, rtol):
    """The gradient of a cost at some times, forwards and backwards, up to a tolerance in units of the largest term: ten
    times rtol of the run, 100 times where jumps add to the errors. With checkpoints it is the same."""
    times = np.linspace(*sol.sol.ts[[0, -1]], 5) if times is None else np.asarray(times)
    costs = np.random.default_rng(29).normal(size=(len(sol.y), len(times)))
    if np.iscomplexobj(sol.y):
        costs = costs * np.exp(1j * np.arange(len(times)))
    terms = np.real(costs[:, None, :] * sol.sol.sensitivities(times))
    expected = terms.sum(axis=(0, 2))
    found = sol.gradient(costs, t=times)
    np.testing.assert_allclose(found, expected, atol=rtol * np.abs(terms).max())
    source = sol._origin.source
    options = source.options | {"dense_output": False, "keep": "end"} | CHECKPOINTS
    again = solve(source.problem, source.method, options)
    assert np.array_equal(again.gradient(costs, t=times), found)


def ball(t, y, gravity, restitution):
    return [y[1], -gravity]


BOUNCE = iv.Event(
    lambda t, y, gravity, restitution: y[0],
    direction=-1,
    action=lambda t, y, gravity, restitution: [0.0, -restitution * y[1]],
)


@pytest.mark.parametrize("method", ["ode45", "ode15s", "radau"])
def test_the_gradient_goes_through_impacts(method):
    """Three of them, with costs before, between and after."""
    options = {"args": (9.81, 0.8), "events": BOUNCE, "rtol": RTOL, "atol": ATOL, "dense_output": True}
    sol = iv.solve_ivp(ball, (0, 2), [1.0, 0.5], method, **options, sensitivities=[*(0, 1), "y0"])
    assert len(sol.t_events[0]) == 3
    both_ways(sol, rtol=100 * RTOL)


def struck(t, y, gravity, restitution):
    return [0.0, t * np.sin(t) - restitution * y[1]]


def struck_in_reals(t, y, gravity, restitution):
    try:  # which tracing refuses
        return [0.0, t * math.sin(t) - restitution * y[1]]
    finally:
        pass


@pytest.mark.filterwarnings("ignore:.* are differences:invariode.AccuracyWarning")
@pytest.mark.parametrize("action", [struck, struck_in_reals])
def test_actions_may_depend_on_the_time_of_their_event(action):
    """They may take complex t, or not."""
    racket = iv.Event(lambda t, y, gravity, restitution: y[0], direction=-1, action=action)
    options = {"args": (9.81, 0.8), "events": racket, "rtol": RTOL, "atol": ATOL, "dense_output": True}
    sol = iv.solve_ivp(ball, (0, 1), [1.0, 0.5], "ode45", **options, sensitivities=[*(0, 1), "y0"])
    assert len(sol.t_events[0]) == 1
    both_ways(sol, rtol=1000 * RTOL)


@pytest.mark.parametrize("points", [True, False])
def test_several_actions_at_one_time_are_taken_in_their_order(points):
    """They do not commute, and the first moves y away from where the event is: as the one action composed of them."""

    def first(t, y, k, c):
        return [y[0] - 0.05 * y[1], k * y[1] + c * y[0]]

    def second(t, y, k, c):
        return [y[0] - 0.1 * y[1] ** 2 * k, y[1]]

    def run(*actions):
        events = [iv.Event(lambda t, y, k, c: y[0] - 0.6, direction=-1, action=one) for one in actions]
        return iv.solve_ivp(
            lambda t, y, k, c: [-k * y[0] + c * y[1], -y[1] * y[0]],
            (0, 2),
            [1.0, 0.5],
            "dop853",
            args=(0.8, 0.3),
            rtol=RTOL,
            atol=ATOL,
            dense_output=True,
            sensitivities=["k", "c", "y0"],
            **({"breakpoints": [(0.5, one) for one in actions]} if points else {"events": events}),
        )

    sol, one = run(first, second), run(lambda t, y, k, c: second(t, first(t, y, k, c), k, c))
    assert points or len(sol.t_events[0]) == len(sol.t_events[1]) == 1
    np.testing.assert_allclose(sol.sensitivities[:, :, -1], one.sensitivities[:, :, -1], rtol=1e-12)
    both_ways(sol, rtol=100 * RTOL)


def test_actions_whose_events_come_apart_are_not_followed():
    """At t = ½ for these parameters alone, which is a warning forwards and an error backwards."""
    events = [
        iv.Event(lambda t, y, a, b: t - a, action=lambda t, y, a, b: 2 * y),
        iv.Event(lambda t, y, a, b: t - b, action=lambda t, y, a, b: y + 1),
    ]
    given = {"args": (0.5, 0.5), "events": events}
    with pytest.warns(iv.AccuracyWarning, match="acts at t = 0.5 together with others"):
        iv.solve_ivp(lambda t, y, a, b: -y, (0, 1), [1.0], **given, sensitivities=True)
    sol = iv.solve_ivp(lambda t, y, a, b: -y, (0, 1), [1.0], **given, adjoint=True)
    with pytest.raises(ValueError, match="another time for other parameters"):
        sol.gradient([1.0])


def test_an_integral_over_impacts_moves_with_their_times():
    """∫ y dt is one more component, which impacts leave as it is."""
    more = iv.Event(
        BOUNCE.fun, direction=-1, action=lambda t, y, gravity, restitution: [0.0, -restitution * y[1], y[2]]
    )
    options = {"args": (9.81, 0.8), "rtol": RTOL, "atol": ATOL, "adjoint": True}
    sol = iv.solve_ivp(ball, (0, 2), [1.0, 0.5], "dop853", events=BOUNCE, **options)
    joint = iv.solve_ivp(
        lambda t, y, gravity, restitution: [*ball(t, y, gravity, restitution), y[0] + t * y[1] ** 3],
        (0, 2),
        [1.0, 0.5, 0.0],
        "dop853",
        events=more,
        sensitivities=True,
        **options,
    )
    found = sol.gradient(integrand=lambda t, y, gravity, restitution: y[0] + t * y[1] ** 3)
    np.testing.assert_allclose(found, joint.sensitivities[2, :, -1], rtol=1e-5)


@pytest.mark.parametrize("rehold", [True, False])
def test_laws_take_new_values_after_actions(rehold):
    """The energy of a pendulum, after a push, or as it was where a push turns it around."""

    def push(t, y, g, size):
        return [y[0], y[1] * (1 + size) if rehold else -y[1]]

    event = iv.Event(lambda t, y, g, size: y[0], action=push, rehold=rehold)
    sol = iv.solve_ivp(
        lambda t, y, g, size: [y[1], -g * np.sin(y[0])],
        (0, 4),
        [1.0, 0.2],
        "dop853",
        args=(1.3, 0.2),
        events=event,
        invariants=lambda t, y, g, size: y[1] ** 2 / 2 - g * np.cos(y[0]),
        rtol=1e-6,
        atol=1e-8,
        dense_output=True,
        sensitivities=[0, 1, "y0"],
    )
    assert len(sol.t_events[0])
    both_ways(sol, rtol=1e-5)


def test_a_start_that_is_moved_onto_a_demanded_value():
    """A circle of radius 1, on which both initial values cannot change alone."""
    sol = iv.solve_ivp(
        lambda t, y, w: [-w * y[1], w * y[0]],
        (0, 3),
        [0.6, 0.8],
        "dop853",
        args=(2.0,),
        invariants=iv.Invariants(lambda t, y, w: y @ y, value=1.0),
        rtol=RTOL,
        atol=ATOL,
        dense_output=True,
        sensitivities=["w", "y0"],
    )
    both_ways(sol, rtol=RTOL)


@pytest.mark.parametrize("when", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("span", [(0, 3), (3, 0)])
def test_the_gradient_goes_through_doses(when, span):
    """At both ends too, in either direction of time."""
    sol = iv.solve_ivp(
        lambda t, y, k, dose: [-k * y[0], k * y[0] ** 2 - y[1]],
        span,
        [1.0, 0.5],
        "dop853",
        args=(0.7, 0.3),
        breakpoints={when: lambda t, y, k, dose: [y[0] + dose * y[1], y[1] * k], 1.5: None},
        rtol=RTOL,
        atol=ATOL,
        dense_output=True,
        sensitivities=[0, 1, "y0"],
    )
    both_ways(sol, rtol=10 * RTOL)


@pytest.mark.parametrize("method", ["ode45", "ode15s"])
@pytest.mark.parametrize("span", [(0, 3), (0, -3)])
def test_where_f_jumps_so_does_the_multiplier(method, span):
    """Through two thresholds, one of which is a parameter, and one of which moves with t; beside an impact."""

    def pumped(t, y, low, rate):
        gain = 2.0 if y[0] > low else 0.5
        return [gain * np.cos(t), rate * y[0] - (1.0 if y[1] > t * rate else 3.0)]

    bounce = iv.Event(lambda t, y, low, rate: y[1] + 2.5, action=lambda t, y, low, rate: [y[0], -y[1] * rate])
    options = {"args": (0.6, 0.4), "events": bounce, "rtol": 1e-8, "atol": 1e-10, "dense_output": True}
    sol = iv.solve_ivp(pumped, span, [0.2, 1.0], method, **options, sensitivities=[0, 1, "y0"])
    both_ways(sol, rtol=1e-6)


def switched(t, y, p):
    return [y[1], -y[0] + (p if y[0] > 0.3 else -p) - 0.1 * y[1]]


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
@pytest.mark.parametrize("adjoint", [True, "checkpoints"])
def test_limits_of_the_run_do_not_end_the_one_with_its_conditions(adjoint):
    """Which has more steps, and calls the callback no more."""
    calls = []
    given = {"args": (0.2,), "rtol": 1e-6, "atol": 1e-8, "adjoint": adjoint}
    run = iv.Problem(switched, (0, 20), [2.0, 0.0], args=(0.2,))
    expected = run.solve(**{name: one for name, one in given.items() if name != "args"}).gradient([1.0, 0.0])
    sol = iv.solve_ivp(switched, (0, 10), [2.0, 0.0], **given).extend(20.0, max_steps=150)
    np.testing.assert_allclose(sol.gradient([1.0, 0.0]), expected, rtol=1e-3)
    sol = iv.solve_ivp(switched, (0, 20), [2.0, 0.0], **given, callback=lambda t, y: bool(calls.append(t)))
    before = len(calls)
    sol.gradient([1.0, 0.0])
    assert len(calls) == before
    sol = iv.solve_ivp(switched, (0, 20), [2.0, 0.0], **given, max_steps=before // 2)
    assert sol.status == -3
    whole = iv.solve_ivp(switched, (0, sol.t_end), [2.0, 0.0], **given)
    np.testing.assert_allclose(sol.gradient([1.0, 0.0], t=sol.t_end), whole.gradient([1.0, 0.0]), rtol=1e-3)


REFUSED = {
    "breakpoint": {"breakpoints": [(1.2, lambda t, y, a: [-5.0])], "bounds": ([0], [2])},
    "event": {
        "events": iv.Event(lambda t, y, a: y[0] - 0.34, action=lambda t, y, a: [-5.0]),
        "bounds": ([0], [2]),
    },
    "law": {
        "breakpoints": [(1.2, lambda t, y, a: [3.0])],
        "invariants": iv.Invariants(lambda t, y, a: y[0] * np.exp(a * t), value=1.0),
    },
}


@pytest.mark.parametrize("adjoint", [True, "checkpoints"])
@pytest.mark.parametrize("t_eval", [None, [0.0, 1.0, 3.0]])
@pytest.mark.parametrize("refused", REFUSED)
def test_an_action_with_which_the_run_ends_is_not_taken(refused, t_eval, adjoint):
    sol = iv.solve_ivp(
        lambda t, y, a: [-a * y[0]], (0, 3), [1.0], "dop853", args=(0.9,), rtol=1e-9, atol=1e-11,
        t_eval=t_eval, adjoint=adjoint, on_failure="return", **REFUSED[refused],
    )  # fmt: skip
    t = sol.t_end
    assert sol.status in (-1, -2)
    assert t < 1.3
    np.testing.assert_allclose(sol._origin.y, np.exp(-0.9 * t), rtol=1e-7)
    for at in (0.3, t):
        np.testing.assert_allclose(sol.gradient([1.0], t=at), -at * np.exp(-0.9 * at), rtol=1e-6)


def robertson(t, y, k1, k2, k3):
    a, b, c = y
    return [-k1 * a + k2 * b * c, k1 * a - k2 * b * c - k3 * b * b, a + b + c - 1]


@pytest.mark.parametrize("method", ["ode15s", "radau"])
@pytest.mark.parametrize("doses", [{}, {10.0: lambda t, y, k1, k2, k3: [0.9 * y[0], y[1], y[2] + 0.1 * k1]}])
def test_algebraic_equations_have_multipliers(method, doses):
    """Costs of algebraic components too, at several times, and doses that are made consistent."""
    sol = iv.solve_ivp(
        robertson,
        (0, 40),
        [1.0, 0.0, 0.0],
        method,
        args=(0.04, 1e4, 3e7),
        mass=np.diag([1.0, 1.0, 0.0]),
        breakpoints=doses,
        rtol=1e-7,
        atol=[1e-10, 1e-14, 1e-10],
        dense_output=True,
        sensitivities=True,
    )
    both_ways(sol, times=[0.0, 0.3, 10.0, 25.0, 40.0], rtol=1e-5)


@pytest.mark.parametrize("singular", [False, True])
def test_masses_are_parameters(singular):
    sol = iv.solve_ivp(
        lambda t, y, m, k: [-k * y[0] + y[1], y[0] ** 2 - y[1]],
        (0, 1),
        [0.5, 0.25],
        "radau",
        args=(2.0, 3.0),
        mass=lambda t, m, k: [[m, 0.0 if singular else 0.1 * k], [0, 0.0 if singular else m * k]],
        rtol=1e-9,
        atol=1e-11,
        sensitivities=True,
        dense_output=True,
    )
    both_ways(sol, rtol=1e-7)


def of_rank_one(t, m, k):
    """Singular, a function of t and of parameters."""
    return (m + np.sin(k * t)) * np.outer([0.9, 0.4], [1.0, 0.2])


def pumped_algebra(method, mass=of_rank_one, **options):
    return iv.solve_ivp(
        lambda t, y, m, k: [-k * y[0] + y[1], y[0] ** 2 - y[1] + 0.1 * m * t],
        y0=[0.5, 0.25],
        method=method,
        mass=mass,
        max_step=np.inf,
        **{"args": (2.0, 3.0), "t_span": (0, 1), **options},
    )


@pytest.mark.parametrize("method", ["ode15s", "radau"])
@pytest.mark.parametrize("span", [(0, 1), (1, 0)])
@pytest.mark.parametrize("more", [{}, {"breakpoints": {0.4: lambda t, y, m, k: [0.9 * y[0] + 0.01 * k, y[1]]}}])
def test_algebraic_equations_of_a_mass_matrix_that_depends_on_t(method, span, more):
    given = {"rtol": 1e-7, "atol": 1e-9, "sensitivities": ["m", "k", "y0[0]"], "dense_output": True}
    both_ways(pumped_algebra(method, t_span=span, **given, **more), rtol=1e-5)


def test_events_beside_algebraic_equations_of_a_mass_matrix_that_depends_on_t():
    """Against differences of runs: their times, and the last state."""
    given = {"rtol": 1e-10, "atol": 1e-12, "events": lambda t, y, m, k: y[0] - 0.3}
    sol = pumped_algebra("radau", sensitivities=True, **given)
    assert len(sol.t_events[0])
    for j, size in enumerate((1e-4, 1e-4)):
        args = np.array([[2.0, 3.0]] * 2)
        args[:, j] += [-size, size]
        low, high = (pumped_algebra("radau", **given, args=tuple(one)) for one in args)
        slope = (high.y[:, -1] - low.y[:, -1]) / (2 * size)
        np.testing.assert_allclose(sol.sensitivities[:, j, -1], slope, atol=1e-6)
        of_time = (high.t_events[0] - low.t_events[0]) / (2 * size)
        np.testing.assert_allclose(sol.sensitivities_t_events[0][:, j], of_time, atol=1e-6)


@pytest.mark.parametrize("tf", [2.0, np.inf])
def test_a_mass_matrix_that_does_not_depend_on_its_parameter_at_the_start(tf):
    """Nor on t, if the run has no end but an event: as y' = f / M."""
    given = {"args": (3.0,), "rtol": 1e-9, "atol": 1e-11, "sensitivities": True}
    given["events"] = iv.Event(lambda t, y, k: t - 2.0, terminal=True)
    sol = iv.solve_ivp(lambda t, y, k: -y, (0, tf), [1.0], "radau", mass=lambda t, k: [[2 + np.sin(k * t)]], **given)
    plain = iv.solve_ivp(lambda t, y, k: [-y[0] / (2 + np.sin(k * t))], (0, tf), [1.0], "radau", **given)
    np.testing.assert_allclose(sol.sensitivities[0, 0, -1], plain.sensitivities[0, 0, -1], rtol=1e-6)


def test_algebraic_equations_that_turn_are_refused():
    def turning(t, m, k):
        return m * np.outer([np.cos(t), np.sin(t)], [1.0, 0.2])

    sol = pumped_algebra("radau", turning, adjoint=True)
    with pytest.raises(ValueError, match=r"null spaces .* are not those of the start at t = "):
        sol.gradient([1.0, 0.0], wrt="y0")


def test_a_mass_matrix_that_depends_on_t():
    sol = iv.solve_ivp(
        predators,
        (0, 2),
        START,
        "radau",
        args=RATES,
        mass=lambda t, *p: np.array([[2.0 + np.sin(t), 1.0], [0.0, 1.0 + t]]),
        rtol=RTOL,
        atol=ATOL,
        dense_output=True,
        sensitivities=["a", "c", "y0"],
    )
    both_ways(sol, rtol=10 * RTOL)


def test_a_component_at_rest_on_a_bound_pulls_nothing():
    """It arrives at 0 at sin t = −½, and leaves where cos t is positive again."""
    sol = iv.solve_ivp(
        lambda t, y, a, b: [a * np.cos(t), y[0] ** 2 - b * y[1] + a * y[0]],
        (0, 6),
        [0.5, 1.0],
        "dop853",
        args=(1.0, 0.4),
        nonnegative=True,
        rtol=RTOL,
        atol=ATOL,
        dense_output=True,
        sensitivities=[0, 1, "y0"],
    )
    assert sol.stats.clipped
    both_ways(sol, times=[1.0, 3.0, 4.2, 5.5, 6.0], rtol=10 * RTOL)


@pytest.mark.parametrize("method", ["ode23s", "ode23t", "ode23tb", "radau"])
def test_what_rests_at_a_bound_is_told_by_the_slope_of_y_and_not_by_f(method):
    """Component 0 starts at its bound with y0' = 0, while M couples its f with that of component 1; dy1(3)/dk is
    −4.5 exp(−1.8), within 100 tolerances, of a method of order 2 by a backward run of its own."""
    M = np.array([[2.0, 0.5, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])

    def fun(t, y, k):
        return M @ np.array([-0.8 * y[0], 0.8 * y[0] - k * y[1], k * y[1]])

    sol = iv.solve_ivp(
        fun, (0, 3), [0.0, 1.5, 1.0], method, args=(0.6,), mass=M, nonnegative=True, rtol=RTOL, atol=RTOL, adjoint=True
    )
    np.testing.assert_allclose(sol.gradient([0.0, 1.0, 0.0]), -4.5 * np.exp(-1.8), rtol=100 * RTOL)


@pytest.mark.parametrize("method", ["ode23s", "ode15s", "radau"])
def test_a_component_at_rest_pulls_nothing_through_its_own_row_of_a_mass_matrix(method):
    """y0' = −p until y0 rests at 0, where row 0 of M is negative: f leads upwards, y0' downwards."""
    M = np.diag([-2.0, 4.0])

    def fun(t, y, p, k):
        return M @ np.array([-p, y[0] - k * y[1]])

    sol = iv.solve_ivp(
        fun,
        (0, 1),
        [0.5, 1.5],
        method,
        args=(0.9, 0.6),
        mass=M,
        nonnegative=[0],
        rtol=1e-6,
        atol=1e-8,
        dense_output=True,
        sensitivities=["p", "k", "y0"],
    )
    assert sol.stats.clipped
    both_ways(sol, times=[1.0], rtol=1e-5)


def test_a_component_at_rest_that_a_singular_mass_matrix_couples_is_refused():
    """Its own equation is not known: the core does not change f there, and moves y alone."""
    M = np.array([[2.0, 0.5, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    points = np.zeros((3, 4))
    points[0] = [0.5, 0.0, 0.0, 0.0]

    class Line:
        ts = np.array([0.0, 1.0, 2.0, 3.0])

        def __call__(self, t):
            return np.array([np.interp(t, self.ts, row) for row in points])

    def fun(t, y):
        return [-2.0, -1.0, y[2]]

    held = iv.Problem(fun, (0, 3), points[:, 0], mass=M, nonnegative=[0])
    sol = types.SimpleNamespace(stats=types.SimpleNamespace(clipped=1.0), t_end=3.0)
    with pytest.raises(ValueError, match="component 0 rests at a bound from t = 1"):
        at_bounds(held, sol, Line(), 1.0, 1e-6)


def test_bounds_that_are_never_met_do_not_matter():
    assert np.array_equal(solved(nonnegative=True).gradient([1.0, 0.0]), solved().gradient([1.0, 0.0]))


def test_what_the_adjoint_does_not_follow_is_refused_by_name():
    singular = np.diag([1.0, 0.0])
    twice = {"breakpoints": [(0.5, lambda t, y, k: [y[0] + 1, y[1]]), (0.5, lambda t, y, k: [2 * y[0], y[1]])]}

    def decay(t, y, k):
        return [-k * y[0], y[0] - y[1]]

    given, start = {"args": (1.0,), "adjoint": True}, (decay, (0, 1), [1.0, 1.0], "radau")
    for sol, message in (
        (solved(adjoint=False), "adjoint=True"),
        (iv.solve_ivp(lambda t, y, k: [k * y[0] ** 2], (0, 2), [1.0], **given), "without success"),
        (iv.solve_ivp(*start, mass=singular, **twice, **given), "together with others"),
        (
            iv.solve_ivp(lambda t, y, k: [-k if y[0] > 0.5 else -2 * k], (0, 1), [1.0], "radau", mass=[[2.0]], **given),
            "fun jumps",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            sol.gradient(np.ones(len(sol.y)))


@pytest.mark.filterwarnings("ignore:sensitivities. the derivatives of fun:invariode.AccuracyWarning")
@pytest.mark.parametrize("method", ["dop853", "ode113", "ode15s", "radau"])
@pytest.mark.parametrize(("fun", "more"), [
    (precession, {}),
    (untraced_precession, {}),
    (condensate, {"breakpoints": {0.5: turned}, "atol": [1e-9, 2e-9]}),
    (condensate, {"events": iv.Event(inside, action=turned), "invariants": lambda t, y, w, g: (abs(y) ** 2).sum()}),
    (lambda t, y, w, g: [-1j * w * y[0] * (2.0 if abs(y[1]) > g / 2 else 1.0), -g * y[0]], {}),
])  # fmt: skip
def test_complex_states_have_the_gradient_of_their_sensitivities(method, fun, more):
    """To arguments, which are real, for any f: dG is the real part of dG_dy dy."""
    given = {"args": (1.0, 1.1), "rtol": RTOL, "atol": ATOL, "sensitivities": True, "dense_output": True}
    sol = iv.solve_ivp(fun, (0, 1), [1.0 + 0j, 0.5j], method, **given | more)
    assert "events" not in more or len(sol.t_events[0])
    both_ways(sol, rtol=100 * RTOL)


@pytest.mark.parametrize("fun", [precession, condensate])
def test_complex_initial_values_have_a_gradient_for_any_f(fun):
    """∂G/∂Re y0 − i ∂G/∂Im y0, which is that of the real problem; if f is analytic it is dG_dy S."""
    given = {"args": (1.0, 1.1), "rtol": 1e-9, "atol": 1e-11, "adjoint": True}
    sol = iv.solve_ivp(fun, (0, 1), [1.0 + 0j, 0.5j], "dop853", **given)
    cost = np.array([1.0 - 2.0j, 0.3j])
    found = sol.gradient(cost, [0.1, 0.2], wrt=["g", "y0[1]"], integrand=lambda t, y, w, g: abs(y[0]) ** 2)
    parts = iv.solve_ivp(in_reals(fun), (0, 1), [1.0, 0.0, 0.0, 0.5], "dop853", **given)
    real = parts.gradient(
        [1.0, 2.0, 0.0, -0.3],
        wrt=["args[1]", "y0[2]", "y0[3]"],
        integrand=lambda t, x, w, g: x[0] ** 2 + x[1] ** 2,
    )
    np.testing.assert_allclose(found, [real[0] + 0.1, real[1] - 1j * real[2] + 0.2], atol=1e-7)
    if fun is precession:
        start = {name: one for name, one in given.items() if name != "adjoint"}
        S = iv.solve_ivp(fun, (0, 1), [1.0 + 0j, 0.5j], "dop853", **start, sensitivities="y0").sensitivities
        np.testing.assert_allclose(sol.gradient(cost, wrt="y0"), cost @ S[:, :, -1], atol=1e-7)


def test_wrong_input_is_said_by_name():
    sol = solved(t_span=(0, 1))
    for given, message in (
        ({}, "dG_dy"),
        ({"dG_dy": [1.0]}, r"dG_dy must have shape \(2,\)"),
        ({"dG_dy": [1.0, 1.0], "t": 2.0}, "t of gradient must be between 0.0 and 1.0"),
        ({"dG_dy": [1.0, 1.0], "dG_dp": [1.0]}, "dG_dp must have one number for each of 4"),
        ({"dG_dy": [1.0, 1.0], "wrt": "e"}, "no parameter 'e'"),
        ({"dG_dy": [1.0, np.nan]}, r"dG_dy and dG_dp must be finite, got \[1.0, nan\]"),
        ({"dG_dy": [1.0, 1.0], "t": [[0.5]]}, r"and times of shape \(1, 1\)"),
        ({"integrand": lambda t, y, *args: y}, "integrand must return one number, got array"),
        ({"integrand": lambda t, y, *args: y[0] + 1j}, "integrand must be real, got"),
        ({"integrand": 3}, r"integrand must be a function g\(t, y, \*args\), got 3"),
        (
            {"integrand": lambda t, y: y[0]},
            r"integrand is called with t, y and args = \(.*define it with \(t, y, \*args",
        ),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            sol.gradient(**given)


@dealt(method=["ode45", "ode15s"], adjoint=[True, "checkpoints"])
def test_laws_that_jump_at_a_breakpoint_take_new_values_there(method, adjoint):
    """The energy of a spring that becomes stiffer; with costs at the breakpoint and at the end."""

    def stiffness(t, k):
        return np.where(t < 1, 1.0, k)

    sol = iv.solve_ivp(
        lambda t, y, k: [y[1], -stiffness(t, k) * y[0]],
        (0, 2),
        [1.0, 0.3],
        method,
        args=(1.7,),
        invariants=lambda t, y, k: y[1] ** 2 / 2 + stiffness(t, k) * y[0] ** 2 / 2,
        breakpoints=[1.0],
        t_eval=[1.0, 2.0],
        sensitivities=["k", "y0"],
        rtol=1e-8,
        atol=1e-10,
        adjoint=adjoint,
    )
    costs = np.array([[1.0, 2.0], [3.0, -1.0]])
    expected = np.einsum("it,ikt->k", costs, sol.sensitivities)
    np.testing.assert_allclose(sol.gradient(costs, t=sol.t), expected, rtol=0, atol=1e-5)


def test_costs_at_times_that_are_as_far_from_the_end_add_up():
    """10 - 0.3 is 10 - (0.1 + 0.2)."""
    sol = iv.solve_ivp(lambda t, y, a: [-a * y[0]], (0, 10), [1.0], args=(0.5,), rtol=1e-9, atol=1e-12, adjoint=True)
    np.testing.assert_allclose(sol.gradient([[1.0, 1.0]], t=[0.3, 0.1 + 0.2]), 2 * -0.3 * np.exp(-0.15), rtol=1e-7)


def test_a_solution_from_a_file_has_no_gradient(tmp_path):
    solved(t_span=(0, 1)).save(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"without the functions of its problem: it has no gradient\. Solve it again"):
        iv.load(tmp_path / "a.npz").gradient([1.0, 0.0])
