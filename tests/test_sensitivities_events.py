"""Sensitivities of times and states of events, and after their actions."""

from __future__ import annotations

import math

import numpy as np
import pytest

import invariode as iv
from cases import explicit_and_implicit
from parametric import TOLERANCES


@pytest.mark.parametrize("method", ["ode15s", "radau"])
def test_events_of_algebraic_components(method):
    """z = q y² with y = exp(−p t) is ½ at ln(2 q) / (2 p), and z' follows from its equation."""
    sol = iv.solve_ivp(
        lambda t, y, p, q: [-p * y[0], y[1] - q * y[0] ** 2],
        (0, 2),
        [1.0, 1.5],
        method,
        args=(0.7, 1.5),
        mass=np.diag([1.0, 0.0]),
        events=lambda t, y, p, q: y[1] - 0.5,
        sensitivities=True,
        **TOLERANCES,
    )
    time = np.log(3) / 1.4
    np.testing.assert_allclose(sol.t_events[0], [time], rtol=1e-6)
    np.testing.assert_allclose(sol.sensitivities_t_events[0], [[-time / 0.7, 1 / 2.1]], rtol=1e-5)


def ball(t, y, g, e):
    return [y[1], -g]


def bounced(t, g, e):
    """A ball that falls from 1."""
    end = np.sqrt(2 / g)
    if t.real < end.real:
        return np.array([1 - g * t * t / 2, -g * t])
    speed = e * g * end
    while (end + 2 * speed / g).real < t:
        end, speed = end + 2 * speed / g, e * speed
    s = t - end
    return np.array([speed * s - g * s * s / 2, speed - g * s])


BOUNCE = iv.Event(lambda t, y, g, e: y[0], direction=-1, action=lambda t, y, g, e: [0.0, -e * y[1]])


@explicit_and_implicit
def test_a_bouncing_ball(method):
    """∂y/∂g and ∂y/∂e through impacts, whose times depend on both; and those of the times."""
    g, e = 9.81, 0.8
    run = {"args": (g, e), "rtol": 1e-9, "atol": 1e-11, "events": BOUNCE, "sensitivities": True}
    sol = iv.solve_ivp(ball, (0, 1.7), [1.0, 0.0], method, **run)
    exact = np.array([bounced(1.7, g + 1e-30j, e).imag, bounced(1.7, g, e + 1e-30j).imag]).T / 1e-30
    np.testing.assert_allclose(sol.sensitivities[:, :, -1], exact, rtol=0, atol=1e-6)
    fall = np.sqrt(2 / g)
    np.testing.assert_allclose(sol.sensitivities_t_events[0][0], [-fall / (2 * g), 0], atol=1e-6)
    before, after = sol.sensitivities_events[0][0], sol.sensitivities_after_events[0][0]
    np.testing.assert_allclose(before, [[-(fall**2) / 2, 0], [-fall, 0]], atol=1e-6)
    assert after.shape == (2, 2)
    assert np.isclose(after[1, 1], g * fall, rtol=1e-6)


def test_doses_that_are_parameters():
    """y jumps by p at t = 1."""
    sol = iv.solve_ivp(
        lambda t, y, p: [-y[0]],
        (0, 2),
        [1.0],
        args=(0.7,),
        **TOLERANCES,
        breakpoints={1.0: lambda t, y, p: y + p},
        sensitivities=["p", "y0"],
    )
    np.testing.assert_allclose(sol.sensitivities[0, :, -1], [np.exp(-1), np.exp(-2)], rtol=1e-6)


def test_a_grazing_event_is_a_warning():
    """The top of a parabola touches zero."""
    top = iv.Event(lambda t, y, c: y[0] - c, action=lambda t, y, c: y)
    with pytest.warns(iv.AccuracyWarning, match="event only grazes zero at t = "):
        iv.solve_ivp(
            lambda t, y, c: [1.0 - t], (0, 2), [0.0], args=(0.5 - 1e-5,), events=top, max_step=1e-3, sensitivities=True
        )


def test_events_of_fast_problems_do_not_leave_where_f_is_defined():
    def fun(t, y, k):
        return [-k * math.sqrt(y[0])]

    sol = iv.solve_ivp(
        fun, (0, 1e-9), [1.0], args=(1e9,), events=lambda t, y, k: y[0] - 0.5, sensitivities=True, rtol=1e-8
    )
    assert sol.sensitivities[0, 0, -1] == pytest.approx(-5e-10, rel=1e-6)  # of (1 − k t / 2)²


class Untraced:
    """A condition that cannot be traced."""

    def __call__(self, t, y, p, q):
        return {True: 1}.get(y[0] < q, 0) == 1


CONDITIONS = {
    "one comparison": lambda t, y, p, q: y[0] < q,
    "not": lambda t, y, p, q: not y[0] >= q,
    "and": lambda t, y, p, q: y[0] < q and y[0] > -1,
    "or": lambda t, y, p, q: (y[0] < q) | (t > 100),
    "branches": lambda t, y, p, q: y[0] < q if t < 50 else False,
    "numbers": lambda t, y, p, q: np.where(y[0] < q, 1.0, -1.0),
    "compiled": iv.compile(lambda t, y, p, q: y[0] < q),
}


@explicit_and_implicit
def test_times_of_conditions(method):
    """exp(-p t) = q at τ = -ln(q) / p, whatever form the condition has; what its action does has these derivatives too,
    forward and adjoint."""
    p, q = 0.7, 0.4
    tau = -np.log(q) / p
    for name, condition in CONDITIONS.items():
        event = iv.Event(condition, action=lambda t, y, p, q: [y[0] + t])
        sol = iv.solve_ivp(
            lambda t, y, p, q: [-p * y[0]], (0, 2), [1.0], method, args=(p, q), events=event, sensitivities=True,
            dense_output=True, rtol=1e-8, atol=1e-10,
        )  # fmt: skip
        assert len(sol.t_events[0]) >= 1, name
        np.testing.assert_allclose(sol.t_events[0][0], tau, rtol=1e-7, err_msg=name)
        times = np.array([-tau / p, -1 / (p * q)])
        np.testing.assert_allclose(sol.sensitivities_t_events[0][0], times, rtol=1e-6, err_msg=name)
        after = (q + tau) * np.exp(-p * (2 - tau))
        exact = np.exp(-p * (2 - tau)) * np.array([0, 1]) + after * (np.array([tau - 2, 0]) + p * times)
        exact += np.exp(-p * (2 - tau)) * times
        np.testing.assert_allclose(sol.sensitivities[0, :, -1], exact, rtol=1e-5, err_msg=name)
        np.testing.assert_allclose(sol.gradient([1.0]), exact, rtol=1e-5, err_msg=name)


def test_a_condition_that_cannot_be_traced_is_a_warning():
    with pytest.warns(iv.AccuracyWarning, match="condition .* cannot be traced") as caught:
        sol = iv.solve_ivp(
            lambda t, y, p, q: [-p * y[0]], (0, 2), [1.0], args=(0.7, 0.4), events=iv.Event(Untraced()),
            sensitivities=True,
        )  # fmt: skip
    assert len(caught) == 1
    assert not sol.sensitivities_t_events[0].any()


@explicit_and_implicit
def test_the_time_of_an_event_that_a_jump_sets_off_is_that_of_the_jump(method):
    """A dose at t = 1 carries y over 1.5: ∂τ = 0. The action of an event at y = 0.7 does so too: ∂τ is that event's."""
    f = {"fun": lambda t, y, k: [-k * y[0]], "y0": [1.0], "args": (0.5,), "sensitivities": True}
    over = iv.Event(lambda t, y, k: y[0] - 1.5, direction=1)
    dose = {1.0: lambda t, y, k: [y[0] + 1]}
    sol = iv.solve_ivp(t_span=(0, 2), method=method, events=over, breakpoints=dose, **f)
    assert sol.t_events[0].tolist() == [1.0]
    assert sol.sensitivities_t_events[0].tolist() == [[0.0]]
    low = iv.Event(lambda t, y, k: y[0] - 0.7, direction=-1, action=lambda t, y, k: [2.0])
    sol = iv.solve_ivp(t_span=(0, 1), method=method, events=[over, low], rtol=1e-9, atol=1e-11, **f)
    assert sol.t_events[0].tolist() == sol.t_events[1].tolist()
    for found in sol.sensitivities_t_events:
        np.testing.assert_allclose(found, [[np.log(0.7) / 0.25]], rtol=1e-6)
