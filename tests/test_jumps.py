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
