"""Events that are zero at t0: with `at_start` they occur there, as in SciPy; without, not until they have left zero."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
from cases import dealt, explicit_and_implicit


def oscillator(t, y):
    return [y[1], -y[0]]


def crossing(t, y):
    return y[0]


def event_of(solve_ivp, **attributes):
    """Return one event for both libraries; ours with at_start."""

    def event(t, y):
        return y[0]

    for name, value in attributes.items():
        setattr(event, name, value)
    event.at_start = True  # SciPy does not look at it
    return event


#: SciPy counts events from version 1.13 on.
COUNTS = tuple(int(part) for part in scipy.__version__.split(".")[:2]) >= (1, 13)


@dealt(
    12,
    direction=[0, 1, -1],
    terminal=[False, True, 2, 3] if COUNTS else [False, True],
    end=[10.0, -10.0],
    start=[[0.0, 1.0], [0.0, -1.0], [0.5, 1.0]],
)
def test_as_scipy_counts(direction, terminal, end, start):
    found = []
    for solve_ivp in (scipy.integrate.solve_ivp, iv.solve_ivp):
        event = event_of(solve_ivp, direction=direction, terminal=terminal)
        sol = solve_ivp(oscillator, (0, end), start, events=[event, lambda t, y: y[1]], rtol=1e-8, atol=1e-10)
        assert (sol.t_events[0].shape[0], 2) == sol.y_events[0].shape or sol.t_events[0].size == 0
        found.append((sol.status, sol.success, sol.message, sol.t[-1], [t.tolist() for t in sol.t_events]))
    theirs, ours = found
    assert ours[:3] == theirs[:3]
    assert ours[3] == pytest.approx(theirs[3], abs=1e-6)
    for a, b in zip(theirs[4], ours[4], strict=True):
        np.testing.assert_allclose(b, a, atol=1e-6)


@explicit_and_implicit
def test_the_default_does_not_find_it(method):
    assert iv.solve_ivp(oscillator, (0, 1), [0.0, 1.0], method, events=crossing).t_events[0].size == 0
    sol = iv.solve_ivp(oscillator, (0, 1), [0.0, 1.0], method, events=iv.Event(crossing, at_start=True))
    assert sol.t_events[0].tolist() == [0.0]
    np.testing.assert_array_equal(sol.y_events[0], [[0.0, 1.0]])


def falling(t, y):
    return [y[1], -9.81]


def ground(t, y):
    return y[0]


ground.terminal, ground.direction = True, -1


def impacts(solve_ivp, event, count=12):
    """The loop of scripts: solve to the impact, reflect the velocity, go on from there."""
    t, y, times = 0.0, np.array([1.0, 0.0]), []
    for _ in range(count):
        sol = solve_ivp(falling, (t, 100), y, events=event, rtol=1e-9, atol=1e-12)
        t, y = sol.t[-1], sol.y[:, -1] * [1, -0.9]
        times.append(t)
    return times


@pytest.mark.parametrize("start", [False, True])
def test_a_restart_loop_with_a_direction_finds_each_impact_once(start):
    """In both libraries the event rises where it starts, and only falls count."""
    first = np.sqrt(2 / 9.81)
    expected = first + np.cumsum([0, *(2 * first * 0.9 ** np.arange(1, 12))])
    event = iv.Event(ground, terminal=True, direction=-1, at_start=start)
    np.testing.assert_allclose(impacts(iv.solve_ivp, event), expected, rtol=1e-6)
    np.testing.assert_allclose(impacts(scipy.integrate.solve_ivp, ground), expected, rtol=1e-6)


def test_a_loop_of_extensions_finds_each_event_once():
    """No direction, no change of the state: here a new run would find the same event again."""
    sol = iv.solve_ivp(oscillator, (0, 20), [0.0, 1.0], events=iv.Event(crossing, terminal=True), rtol=1e-9, atol=1e-12)
    for _ in range(10):
        if sol.status == 1:
            sol = sol.extend(20)
    np.testing.assert_allclose(sol.t_events[0], np.pi * np.arange(1, 7), atol=1e-6)
    assert sol.t[-1] == 20


def test_native_events_too():
    pytest.importorskip("numba")
    event = iv.Event(iv.compile(lambda t, y, p: y[0] - p[0]), direction=1, at_start=True)
    sol = iv.solve_ivp(lambda t, y, a: oscillator(t, y), (0, 1), [0.25, 1.0], events=event, args=(0.25,))
    assert sol.t_events[0].tolist() == [0.0]


def test_what_it_cannot_be_combined_with():
    with pytest.raises(ValueError, match=r"at_start is not possible with an action: .* apply the action to y0 first"):
        iv.Event(crossing, action=lambda t, y: y, at_start=True)
    with pytest.raises(TypeError, match="at_start must be True or False"):
        iv.Event(crossing, at_start=1)
    with pytest.raises(ValueError, match="at_start is for single runs"):
        iv.solve_ensemble(oscillator, (0, 1), [[0.0, 1.0]], events=iv.Event(crossing, at_start=True), workers=1)


def test_invariants_are_still_tested_at_the_start():
    with pytest.raises(iv.InvariantError):
        iv.solve_ivp(
            oscillator,
            (0, 1),
            [0.0, 1.0],
            events=iv.Event(crossing, at_start=True),
            invariants=lambda t, y: y[0] + y[1],
        )


def test_ended_at_the_start_it_can_be_extended():
    event = iv.Event(crossing, terminal=True, at_start=True)
    sol = iv.solve_ivp(oscillator, (0, 10), [0.0, 1.0], events=event, rtol=1e-8, atol=1e-10)
    assert (sol.status, sol.t_end, sol.t_events[0].tolist()) == (1, 0.0, [0.0])
    more = sol.extend(10)
    assert more.status == 1
    np.testing.assert_allclose(more.t_events[0], [0, np.pi], atol=1e-6)


def test_output_times_of_a_run_that_ends_at_its_start():
    event = iv.Event(crossing, terminal=True, at_start=True)
    sol = iv.solve_ivp(oscillator, (0, 10), [0.0, 1.0], events=event, t_eval=[0, 1, 2], dense_output=True)
    assert sol.t.tolist() == [0.0]
    np.testing.assert_array_equal(sol.y[:, 0], [0.0, 1.0])
