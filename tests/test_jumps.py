"""Events with an action: the solution jumps, the memory restarts, invariants are held at their new values."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt, explicit_and_implicit, families_and_series
from problems import slack

RESTITUTION = 0.9


def ball(t, y):
    """Gravity that falls off with the height z as 1/(1 + z)²."""
    return [y[1], -1 / (1 + y[0]) ** 2]


def energy(t, y):
    return y[1] ** 2 / 2 - 1 / (1 + y[0])


def floor(t, y):
    return y[0]


def bounce(t, y):
    return [0.0, -RESTITUTION * y[1]]


def impacts(count: int) -> np.ndarray:
    """Times of impact from rest at z = 1: radial Kepler orbits, r = a (1 − cos η), t = a^{3/2} (η − sin η)."""

    def rise(speed):
        a = 1 / (2 - speed**2)
        eta = np.arccos(1 - 1 / a)
        return a**1.5 * (np.pi - eta + np.sin(eta))

    speed = 1.0
    times = [rise(speed)]
    for _ in range(count - 1):
        speed *= RESTITUTION
        times.append(times[-1] + 2 * rise(speed))
    return np.array(times)


@dealt(method=FAMILIES, rtol=[1e-6, 1e-9], project=[False, True])
def test_ball_bounces_thirty_times(method, rtol, project):
    hit = iv.Event(floor, direction=-1, terminal=31, action=bounce)
    sol = iv.solve_ivp(
        ball,
        (0, 100),
        [1.0, 0.0],
        method,
        events=hit,
        rtol=rtol,
        atol=1e-2 * rtol,
        invariants=energy if project else None,
    )
    assert sol.status == 1
    assert len(sol.t_events[0]) == 31  # no impact lost or doubled
    # each impact passes its error on; without the energy it grows
    assert np.abs(sol.t_events[0] - impacts(31)).max() < (100 if project else 3000) * slack(method) * rtol
    jumps = np.flatnonzero(np.diff(sol.t) == 0)
    np.testing.assert_array_equal(sol.t[jumps], sol.t_events[0][:30])  # the last one ends the run
    np.testing.assert_array_equal(sol.y[:, jumps], sol.y_events[0][:30].T)  # before the action
    np.testing.assert_allclose(sol.y[1, jumps + 1], -RESTITUTION * sol.y[1, jumps], rtol=1e-15)
    if project:
        assert np.abs(sol.residual).max() < 1e-10  # of the energy since the last impact
        assert np.ptp([energy(0, y) for y in sol.y.T]) > 0.2  # which falls


@families_and_series
def test_the_solution_has_both_values_and_sol_the_later_one(method):
    hit = iv.Event(floor, direction=-1, terminal=4, action=bounce)
    sol = iv.solve_ivp(ball, (0, 100), [1.0, 0.0], method, events=hit, invariants=energy, dense_output=True, refine=3)
    at = sol.t_events[0][:3]
    np.testing.assert_allclose(sol.sol(at)[1], -RESTITUTION * sol.y_events[0][:3, 1])
    before = sol.sol(np.nextafter(at, 0))
    np.testing.assert_allclose(before.T, sol.y_events[0][:3], atol=1e-12)
    assert (sol.sol(np.linspace(0, sol.t[-1], 500))[0] > -1e-12).all()
    imposed = sol.impose()
    assert np.abs(imposed.residual).max() < 1e-15
    pieces = np.searchsorted(at, 0.99 * at, side="right")
    held = np.array([energy(0, [0, RESTITUTION**k]) for k in range(4)])
    np.testing.assert_allclose(energy(0, imposed.sol(0.99 * at)), held[pieces], atol=1e-3)


@explicit_and_implicit
def test_output_at_given_times_gives_one_value_each(method):
    hit = iv.Event(floor, direction=-1, action=bounce)
    first = float(iv.solve_ivp(ball, (0, 4), [1.0, 0.0], method, events=hit, invariants=energy).t_events[0][0])
    times = [0.5, first, 3.5]
    sol = iv.solve_ivp(ball, (0, 4), [1.0, 0.0], method, events=hit, t_eval=times, invariants=energy)
    np.testing.assert_array_equal(sol.t, times)
    assert sol.y[1, 1] > 0  # the later one
    assert np.abs(sol.residual).max() < 1e-6


@families_and_series
def test_dosing(method):
    """A linear decay to which 1 is added each time that a clock strikes."""
    doses = [iv.Event(lambda t, y, s=s: t - s, action=lambda t, y: y + 1) for s in (1.0, 2.0, 3.0)]
    sol = iv.solve_ivp(lambda t, y: -y, (0, 4), [1.0], method, events=doses, rtol=1e-8, atol=1e-10)
    exact = 1.0
    for _ in range(3):
        exact = exact * np.exp(-1) + 1
    assert sol.y[0, -1] == pytest.approx(exact * np.exp(-1), rel=1e-5)
    assert [len(t) for t in sol.t_events] == [1, 1, 1]


@explicit_and_implicit
def test_switching_without_a_change_of_the_state(method):
    """A relay: the action changes a parameter only; the right-hand side is evaluated afresh."""
    state = {"on": True}

    def fun(t, y):
        return [1.0 if state["on"] else -1.0]

    def switch(t, y):
        state["on"] = not state["on"]
        return y

    events = [iv.Event(lambda t, y: y[0] - 1, action=switch), iv.Event(lambda t, y: y[0], direction=-1, action=switch)]
    sol = iv.solve_ivp(fun, (0, 10), [0.5], method, events=events, max_step=0.3)
    np.testing.assert_allclose(sol.t_events[0], [0.5, 2.5, 4.5, 6.5, 8.5], atol=1e-9)
    np.testing.assert_allclose(sol.t_events[1], [1.5, 3.5, 5.5, 7.5, 9.5], atol=1e-9)


@explicit_and_implicit
def test_values_that_are_demanded_or_not_reheld_stay(method):
    spin = iv.Event(lambda t, y: t - 1, action=lambda t, y: [-y[1], y[0]], rehold=False)  # keeps the radius

    def circle(t, y):
        return [-y[1], y[0]]

    def radius(t, y):
        return y[0] ** 2 + y[1] ** 2

    sol = iv.solve_ivp(circle, (0, 3), [1, 0], method, events=spin, invariants=radius)
    assert sol.success
    assert np.abs(sol.residual).max() < 1e-5
    double = iv.Event(lambda t, y: t - 1, action=lambda t, y: 2 * y, rehold=False)
    for invariants, event in (
        (radius, double),
        (iv.Invariants(radius, value=1), iv.Event(double.fun, action=lambda t, y: 2 * y)),
    ):
        sol = iv.solve_ivp(circle, (0, 3), [1, 0], method, events=event, invariants=invariants, on_failure="return")
        assert sol.status == -2
        assert "After the action at t = 1" in sol.message
    sol = iv.solve_ivp(
        circle, (0, 3), [1, 0], method, events=iv.Event(double.fun, action=lambda t, y: 2 * y), invariants=radius
    )
    assert np.hypot(*sol.y[:, -1]) == pytest.approx(2, rel=1e-5)


@families_and_series
def test_backwards(method):
    hit = iv.Event(lambda t, y: y[0] - 1, action=lambda t, y: [3.0])
    sol = iv.solve_ivp(lambda t, y: [1.0], (0, -6), [2.0], method, events=hit, dense_output=True)
    np.testing.assert_allclose(sol.t_events[0], [-1, -3, -5], atol=1e-9)
    assert sol.sol(sol.t_events[0][0])[0] == 3
    assert sol.sol(-2.0)[0] == pytest.approx(2)


@explicit_and_implicit
def test_only_the_final_state(method):
    hit = iv.Event(floor, direction=-1, terminal=5, action=bounce)
    sol = iv.solve_ivp(ball, (0, 100), [1.0, 0.0], method, events=hit, invariants=energy, keep="end", rtol=1e-8)
    assert sol.t.shape == (1,)
    assert len(sol.t_events[0]) == 5
    assert np.abs(sol.residual).max() < 1e-8


def test_plain_function_with_the_attributes_is_as_good():
    def event(t, y):
        return y[0]

    event.direction, event.action, event.terminal = -1, bounce, 3
    sol = iv.solve_ivp(ball, (0, 100), [1.0, 0.0], events=event)
    assert len(sol.t_events[0]) == 3


@explicit_and_implicit
def test_misuse(method):
    with pytest.raises(TypeError, match="action must be a function"):
        iv.Event(floor, action=3)
    with pytest.raises(TypeError, match="rehold must be True or False"):
        iv.Event(floor, rehold=1)
    with pytest.raises(ValueError, match=r"the action of event floor returned shape \(3,\), expected shape \(2,\)"):
        iv.solve_ivp(ball, (0, 9), [1, 0], method, events=iv.Event(floor, action=lambda t, y: np.ones(3)))
    with pytest.raises(ValueError, match="the action of event floor returned NaN at t = 2"):
        iv.solve_ivp(ball, (0, 9), [1, 0], method, events=iv.Event(floor, action=lambda t, y: [np.nan, 0]))

    class BoomError(Exception):
        pass

    def raising(t, y):
        raise BoomError

    with pytest.raises(BoomError):
        iv.solve_ivp(ball, (0, 9), [1, 0], method, events=iv.Event(floor, action=raising))


# ----------------------------------------------------------------------------------------------------------------------
# Events that jumps cross


def at_rest(t, y):
    """The solution is constant between its jumps."""
    return [0.0]


def level(height: float, **about) -> iv.Event:
    return iv.Event(lambda t, y: y[0] - height, **about)


def plus(amount: float):
    return lambda t, y: y + amount


def test_an_event_that_a_jump_crosses_is_reported_once_for_each_jump(method):
    """The report has its direction, at the time of the jump, with the state after it; at_jumps=False: not at all."""
    rng = np.random.default_rng(44)
    states = np.concatenate([[0.1], rng.uniform(-1, 1, 12)])  # from one jump to the next
    times = np.arange(1.0, len(states))
    heights = np.linspace(-0.8, 0.8, 5)
    clock = [iv.Event(lambda t, y, s=s: t - s, action=plus(d)) for s, d in zip(times, np.diff(states), strict=True)]
    levels = [level(h, direction=d) for h in heights for d in (-1, 0, 1)]
    unseen = level(0.0, at_jumps=False)
    about = {"rtol": 1e-6, "max_step": np.inf}
    points = dict(zip(times, map(plus, np.diff(states)), strict=True))
    for sol in (
        iv.solve_ivp(at_rest, (0, 20), [0.1], method, events=[*clock, *levels, unseen], **about),
        iv.solve_ivp(at_rest, (0, 20), [0.1], method, events=[*levels, unseen], breakpoints=points, **about),
    ):
        found = [(t, y[:, 0]) for t, y in zip(sol.t_events, sol.y_events, strict=True) if y.ndim == 2]
        listed = dict(enumerate(zip(sol.t_events[-16:-1], sol.y_events[-16:-1], strict=True)))
        assert found
        for k, (h, d) in enumerate((h, d) for h in heights for d in (-1, 0, 1)):
            signs = np.sign(states - h)
            crossed = (signs[1:] != signs[:-1]) & ((d == 0) | (signs[1:] == d))
            t, y = listed[k]
            np.testing.assert_allclose(t, times[crossed], rtol=1e-14)
            if len(t):
                np.testing.assert_allclose(y[:, 0], states[1:][crossed], rtol=1e-13)
        assert len(sol.t_events[-1]) == 0


def test_a_clock_that_is_put_back_loses_no_stroke(method):
    """An event is judged at the state that its action returns, so the next step may be longer than a period."""
    stroke = level(1.0, direction=1, action=lambda t, y: [0.0])
    sol = iv.solve_ivp(lambda t, y: [0.1], (0, 1005), [0.0], method, events=stroke)
    np.testing.assert_allclose(sol.t_events[0], 10.0 * np.arange(1, 101), rtol=1e-9)
    assert sol.y_end[0] == pytest.approx(0.5, abs=1e-6)


@families_and_series
@pytest.mark.filterwarnings("ignore:.* in breakpoints")  # of the shorter run
def test_a_dose_that_jumps_over_a_threshold_ends_the_run_after_it(method):
    toxic = level(150.0, direction=1, terminal=True)
    doses = dict.fromkeys(8.0 * np.arange(1, 10), plus(100.0))
    about = {"events": toxic, "breakpoints": doses, "rtol": 1e-6}
    sol = iv.solve_ivp(lambda t, y: [-0.05 * y[0]], (0, 100), [100.0], method, dense_output=True, **about)
    exact = 100 * np.exp(-0.4) + 100
    assert (sol.status, sol.t_end) == (1, 8.0)
    np.testing.assert_allclose([sol.y[0, -1], sol.y_end[0], sol.y_events[0][0, 0], sol.sol(8.0)[0]], exact, rtol=1e-4)
    np.testing.assert_allclose(sol.y[0, -2], exact - 100, rtol=1e-4)
    assert iv.solve_ivp(lambda t, y: [-0.05 * y[0]], (0, 10), [100.0], method, t_eval=[8.0], **about).y[0, 0] > 150
    longer = sol.extend(12.0)  # from after the jump: it falls below the threshold, and rises above it at no later time
    np.testing.assert_allclose(longer.y_end[0], exact * np.exp(-0.2), rtol=1e-4)
    assert len(longer.t_events[0]) == 1


@families_and_series
def test_actions_follow_one_another_at_one_time(method):
    """A sets off B and C, in the order of the list, B sets off D; each gets the state that the one before has left."""
    order = []

    def action(name, move):
        def act(t, y):
            order.append((name, *y.tolist()))
            return y + np.array(move)

        return act

    events = [
        iv.Event(lambda t, y: y[3] - 1.5, action=action("D", [0, 0, 0, 1])),
        iv.Event(lambda t, y: t - 1, action=action("A", [0, 1, 1, 0])),
        iv.Event(lambda t, y: y[1] - 0.5, action=action("B", [0, 0, 0, 2])),
        iv.Event(lambda t, y: y[2] - 0.5, action=action("C", [5, 0, 0, 0])),
    ]
    sol = iv.solve_ivp(lambda t, y: np.zeros(4), (0, 3), np.zeros(4), method, events=events)
    assert order == [("A", 0, 0, 0, 0), ("B", 0, 1, 1, 0), ("C", 0, 1, 1, 2), ("D", 5, 1, 1, 2)]
    assert sol.y_end.tolist() == [5, 1, 1, 3]
    assert [y[0].tolist() for y in sol.y_events] == [[5, 1, 1, 2], [0, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 2]]
    assert np.ptp(np.concatenate(sol.t_events)) == 0
    assert (np.diff(sol.t) == 0).sum() == 1  # one jump of the output


@explicit_and_implicit
def test_two_events_that_set_each_other_off_are_an_error_that_names_them(method):
    calls = []

    def turn(t, y):
        calls.append(t)
        return [y[0], -y[1]]

    start = iv.Event(lambda t, y: y[0] - 1, action=turn, name="start")
    ping = iv.Event(lambda t, y: y[1], action=turn, direction=1, name="ping")
    pong = iv.Event(lambda t, y: -y[1], action=turn, direction=1, name="pong")
    with pytest.raises(ValueError, match=r"more than 100 events occur at t = 1\.0.*: (ping, pong|pong, ping)\. Let an"):
        iv.solve_ivp(lambda t, y: [1.0, 0.0], (0, 3), [0.0, 1.0], method, events=[start, ping, pong])
    assert len(calls) == 100
    y0 = [[0.0, 1.0], [-5.0, 1.0]]
    with pytest.warns(iv.FailureWarning, match="more than 100 events occur"):
        out = iv.solve_ensemble(lambda t, y: [1.0, 0.0], (0, 3), y0, method, events=[start, ping, pong])
    assert out.status.tolist()[1] == 0
    assert out.status[0] < 0


@families_and_series
def test_an_event_that_another_moves_away_and_back_is_not_lost(method):
    """Two neurons: a spike of one raises the other, over its threshold or not."""

    def fire(i):
        return lambda t, y: [0.0 if j == i else y[j] + 0.3 for j in (0, 1)]

    spikes = [iv.Event(lambda t, y, i=i: y[i] - 1, direction=1, action=fire(i)) for i in (0, 1)]
    sol = iv.solve_ivp(lambda t, y: [1.0, 1.0], (0, 20), [0.0, 0.8], method, events=spikes, rtol=1e-9)
    t, y, expected = 0.0, np.array([0.0, 0.8]), ([], [])
    while True:
        t += 1 - y.max()
        if t > 20:
            break
        y += 1 - y.max()
        due = [int(y.argmax())]
        while due:
            i = due.pop(0)
            expected[i].append(t)
            before = y.copy()
            y = np.array([0.0 if j == i else y[j] + 0.3 for j in (0, 1)])
            due += [j for j in (0, 1) if j != i and before[j] < 1 < y[j]]
    for found, times in zip(sol.t_events, expected, strict=True):
        np.testing.assert_allclose(found, times, atol=1e-6)


@families_and_series
def test_a_run_that_its_callback_stops_before_a_jump_goes_on_as_if_it_had_not(method):
    """At a breakpoint and at an event, with outputs at given times and at steps."""
    kick = iv.Event(lambda t, y: t - 1.0, action=plus(5.0))
    over = level(3.0)
    for about in ({"breakpoints": {1.0: plus(5.0)}, "events": over}, {"events": [over, kick]}):
        for times in ({"t_eval": [0.5, 1.0, 1.5, 2.0]}, {}):
            whole = iv.solve_ivp(lambda t, y: [-y[0]], (0, 2), [1.0], method, **about, **times)
            begun = iv.solve_ivp(
                lambda t, y: [-y[0]], (0, 2), [1.0], method, **about, **times, callback=lambda t, y: t == 1.0
            )
            assert (begun.status, begun.t_end) == (2, 1.0)
            assert begun.y_end[0] < 1
            sol = begun.extend(2.0)
            assert sol.t.tolist() == whole.t.tolist()
            assert sol.y.tolist() == whole.y.tolist()
            assert [t.tolist() for t in sol.t_events] == [t.tolist() for t in whole.t_events]
            assert [y.tolist() for y in sol.y_events] == [y.tolist() for y in whole.y_events]


@explicit_and_implicit
def test_a_checkpointed_run_that_stops_before_a_jump_has_each_output_once(method, tmp_path):
    about = {"breakpoints": {1.0: plus(5.0)}, "t_eval": [0.5, 1.0, 1.5, 2.0]}
    problem = iv.Problem(lambda t, y: [-y[0]], (0, 2), [1.0])
    whole = problem.solve(method, **about)
    path = tmp_path / "run"
    begun = problem.solve(method, **about, checkpoint=path, callback=lambda t, y: t == 1.0)
    assert begun.y[0, -1] < 1
    begun.extend(2.0)
    options = {"breakpoints": about["breakpoints"], "callback": lambda t, y: False}
    assert iv.load(path, problem, trust="code", **options).y.tolist() == whole.y.tolist()


def test_algebraic_variables_follow_an_action(algebraic_code):
    """x' = z − x, z = 2 x, from 1: x doubles in ln 2, and is halved again; z is consistent after each action, whatever
    the action says of it. Sensitivities to the factor, forward and adjoint, are those of the closed form."""

    def fun(t, y, k):
        return [y[1] - y[0], y[1] - 2 * y[0]]

    halved = iv.Event(lambda t, y, k: y[0] - 2, direction=1, action=lambda t, y, k: [k * y[0], 7.0])
    above = iv.Event(lambda t, y, k: y[1] - 3, direction=-1)  # which only the algebraic equation jumps over
    about = {"args": (0.5,), "mass": np.diag([1.0, 0.0]), "events": [halved, above], "rtol": 1e-8, "atol": 1e-10}
    sol = algebraic_code(fun, (0, 2.5), [1.0, 2.0], sensitivities=["k"], dense_output=True, **about)
    tol = 1e-5 * slack(sol.method if hasattr(sol, "method") else "ode15s") * 30
    np.testing.assert_allclose(sol.t_events[0], np.log(2) * np.arange(1, 4), atol=tol)
    np.testing.assert_array_equal(sol.t_events[1], sol.t_events[0])
    np.testing.assert_allclose(sol.y[1], 2 * sol.y[0], rtol=1e-9)
    # x = k³ 2³ e^(t − 3 ln 2 …): each occurrence comes at x = 2, so x(t) = 2 k e^(t − τ₃), τ₃ = τ₁ + 2 ln(1 / k)
    end = np.exp(2.5) / 8
    np.testing.assert_allclose(sol.y_end, [end, 2 * end], rtol=tol)
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], np.array([1, 2]) * end * 3 / 0.5, rtol=10 * tol)
    plain = algebraic_code(fun, (0, 2.5), [1.0, 2.0], dense_output=True, **about)
    np.testing.assert_allclose(plain.gradient([1.0, 0.0], wrt=["k"]), [end * 3 / 0.5], rtol=10 * tol)
    np.testing.assert_allclose(plain.gradient([0.0, 1.0], wrt=["k"]), [2 * end * 3 / 0.5], rtol=10 * tol)


@explicit_and_implicit
def test_sensitivities_follow_actions_that_set_each_other_off(method):
    """Events, and a breakpoint that sets off an event: forward and adjoint agree with differences."""

    def fun(t, y, k):
        return [k, -0.1 * k * y[1]]

    first = iv.Event(lambda t, y, k: y[0] - 1, direction=1, action=lambda t, y, k: [y[0] * k - 1, y[1] + 2 * k])
    second = iv.Event(lambda t, y, k: y[1] - 1.5, direction=1, action=lambda t, y, k: [y[0] - k * k, 0.3 * k * y[1]])
    for points in (None, {0.5: lambda t, y, k: [y[0], y[1] + 1.6 * k]}):

        def solved(k, points=points, **options):
            return iv.solve_ivp(fun, (0, 3.7), [0.0, 0.3], method, events=[first, second], args=(k,), rtol=1e-9,
                                atol=1e-11, breakpoints=points, **options)  # fmt: skip

        forward = solved(1.0, sensitivities=True)
        assert [len(t) for t in forward.t_events] == ([2, 2] if points is None else [1, 2])
        differences = (solved(1 + 1e-4).y_end - solved(1 - 1e-4).y_end) / 2e-4
        np.testing.assert_allclose(forward.sensitivities[:, 0, -1], differences, rtol=1e-4)
        run = solved(1.0, dense_output=True)
        adjoint = [run.gradient(row)[0] for row in np.eye(2)]
        np.testing.assert_allclose(adjoint, forward.sensitivities[:, 0, -1], rtol=1e-5)


# ----------------------------------------------------------------------------------------------------------------------
# Roots with one action


@families_and_series
@pytest.mark.parametrize("compiled", [False, True])
def test_roots_have_one_call_for_all_that_change_at_a_time(method, compiled):
    calls = []

    def fun(t, y):
        return [y[0] - 1.0, t - 1.0, y[1] - 0.5, t - 2.0]

    def on_roots(t, y, which, directions):
        calls.append((round(t, 9), which.tolist(), directions.tolist()))
        return [0.0, 1.0 - y[1]] if 0 in which or 3 in which else y

    roots = iv.Roots(iv.compile(fun, by="trace") if compiled else fun, 4, on_roots, names=["a", "b", "c", "d"])
    sol = iv.solve_ivp(lambda t, y: [1.0, 0.0], (0, 2.5), [0.0, 0.0], method, events=[level(0.25), roots], rtol=1e-9)
    assert calls == [(1.0, [0, 1], [1, 1]), (1.0, [2], [1]), (2.0, [0, 3], [1, 1]), (2.0, [2], [-1])]
    assert [len(t) for t in sol.t_events] == [5, 2, 1, 2, 1]  # level: up, and down by the jumps
    assert "a" in repr(sol)
    alone = iv.Roots(lambda t, y, k: [t], 1, on_roots)
    with pytest.raises(ValueError, match="sensitivities are not possible with Roots"):
        iv.solve_ivp(lambda t, y, k: [k], (0, 2), [0.0], method, events=alone, args=(1.0,), sensitivities=True)


@families_and_series
def test_roots_may_depend_on_what_their_action_remembers(method):
    """A trigger with a delay: the action is due at a time that is known when the run gets there."""
    due = [np.inf]

    def fun(t, y):
        return [y[0] > 0.5, t - due[0]]

    def on_roots(t, y, which, directions):
        if 0 in which and directions[0] > 0:
            due[0] = t + 0.25
        if 1 in which and directions[which.tolist().index(1)] > 0:
            due[0] = np.inf
            return [0.0]
        return y

    sol = iv.solve_ivp(lambda t, y: [1.0], (0, 3.1), [0.0], method, events=iv.Roots(fun, 2, on_roots), rtol=1e-9)
    np.testing.assert_allclose(sol.t_events[0], [0.5, 0.75, 1.25, 1.5, 2.0, 2.25, 2.75, 3.0], atol=1e-9)
    assert sol.y_end[0] == pytest.approx(0.1, abs=1e-9)


def test_wrong_roots():
    with pytest.raises(TypeError, match="fun of Roots must be a function"):
        iv.Roots(3, 1, lambda t, y, which, directions: y)
    with pytest.raises(ValueError, match="count of Roots must be a positive integer"):
        iv.Roots(at_rest, 0, lambda t, y, which, directions: y)
    with pytest.raises(TypeError, match="on_roots must be a function"):
        iv.Roots(at_rest, 1, None)
    with pytest.raises(ValueError, match="names of Roots must be 2"):
        iv.Roots(at_rest, 2, lambda t, y, which, directions: y, names=["a"])
    with pytest.raises(ValueError, match=r"fun of at_rest returned shape \(1,\), expected shape \(2,\)"):
        iv.solve_ivp(at_rest, (0, 1), [0.0], events=iv.Roots(at_rest, 2, lambda t, y, which, directions: y))
