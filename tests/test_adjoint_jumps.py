"""The gradient of a cost by the adjoint passes actions, breakpoints and discontinuities of f."""

from __future__ import annotations

import math

import numpy as np
import pytest

import invariode as iv
from gradients import ATOL, RTOL, both_ways


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
    """Actions may take complex t, or not."""
    racket = iv.Event(lambda t, y, gravity, restitution: y[0], direction=-1, action=action)
    options = {"args": (9.81, 0.8), "events": racket, "rtol": RTOL, "atol": ATOL, "dense_output": True}
    sol = iv.solve_ivp(ball, (0, 1), [1.0, 0.5], "ode45", **options, sensitivities=[*(0, 1), "y0"])
    assert len(sol.t_events[0]) == 1
    both_ways(sol, rtol=1000 * RTOL)


@pytest.mark.parametrize("points", [True, False])
def test_several_actions_at_one_time_are_taken_in_their_order(points):
    """The actions do not commute, and the first moves y away from the event: the gradient is that of one action
    composed of them."""

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
