"""The first step, at the start and after every jump: not above the scale of f, not below the spacing of t."""

from __future__ import annotations

import math

import numpy as np
import pytest

import invariode as iv
from cases import IMPLICIT, METHODS, SERIES, explicit_and_implicit

TAU = 0.02


def stimulus(power: int):
    """y' = c t^m exp(-t/τ), at rest at t = 0 and over at 20 τ; all of it moves y by 4."""
    c = 4 / (math.factorial(power) * TAU ** (power + 1))
    return lambda t, y: [c * t**power * np.exp(-t / TAU) * (t > 0)]


def allowed(tol: float, steps: int) -> float:
    """Each step may err by its tolerance, of y up to 4."""
    return 5 * tol * max(steps, 1)


def compiled_stimulus(power: int):
    return iv.compile(lambda t, y, c: [c * t**power * np.exp(-50 * t)])


@pytest.mark.parametrize("name", [*METHODS, *SERIES])
def test_what_begins_at_rest_is_not_passed_over(name):
    for power in (1, 2, 5):
        python, c = stimulus(power), 4 / (math.factorial(power) * TAU ** (power + 1))
        for fun, args in [(python, ())] * (name in METHODS) + [(compiled_stimulus(power), (c,))]:
            for tol in (1e-3, 1e-5, 1e-7):
                sol = iv.solve_ivp(fun, (0, 10), [0.0], name, rtol=tol, atol=tol, args=args)
                assert sol.success
                assert abs(sol.y[0, -1] - 4) <= allowed(tol, sol.stats.steps), (power, tol)


@pytest.mark.parametrize("name", METHODS)
def test_nor_is_it_after_breakpoints_and_actions_backwards_or_with_a_tiny_slope_before(name):
    pulse = stimulus(1)

    def forced(t, y):
        return [pulse(t - 5, y)[0] if t >= 5 else 0.0]

    def armed(t, y):  # the second component is the time since the event
        return [pulse(y[1], y)[0] * y[2], y[2], 0.0]

    def arm(t, y):
        return [y[0], 0.0, 1.0]

    tol, far = 1e-4, (0, 15)
    alarm = iv.Event(lambda t, y: t - 5, action=arm)
    runs = [
        iv.solve_ivp(forced, far, [0.0], name, rtol=tol, atol=tol, breakpoints=[5.0]),
        iv.solve_ivp(armed, far, [0.0, 0.0, 0.0], name, rtol=tol, atol=tol, events=alarm),
        iv.solve_ivp(lambda t, y: [-pulse(-t, y)[0]], (0, -10), [0.0], name, rtol=tol, atol=tol),
        iv.solve_ivp(lambda t, y: [pulse(t, y)[0] + 1e-9], (0, 10), [0.0], name, rtol=tol, atol=tol),
    ]
    for number, sol in enumerate(runs):
        assert sol.success
        assert abs(sol.y[0, -1] - 4) <= allowed(tol, sol.stats.steps), number


@pytest.mark.parametrize("name", ["rkn64", "rkn86", "rkn1210"])
def test_second_order_systems_at_rest(name):
    pulse = stimulus(1)
    for tol in (1e-3, 1e-6):
        sol = iv.solve_ivp(
            lambda t, y: [y[1], pulse(t, y)[0]], (0, 10), [0.0, 0.0], name, rtol=tol, atol=tol, second_order=True
        )
        assert abs(sol.y[1, -1] - 4) <= allowed(tol, sol.stats.steps)


@pytest.mark.parametrize("name", [one for one in IMPLICIT if METHODS[one].mass == "any"])
def test_algebraic_variables_at_rest_pass_on_what_drives_them(name):
    """y0' = y1 and 0 = y1 - pulse: the algebraic variable is at rest too, and f does not depend on t where y0' is."""
    pulse = stimulus(1)
    for tol in (1e-3, 1e-5):
        sol = iv.solve_ivp(
            lambda t, y: [y[1], y[1] - pulse(t, y)[0]],
            (0, 10),
            [0.0, 0.0],
            name,
            rtol=tol,
            atol=tol,
            mass=np.diag([1.0, 0]),
        )
        assert sol.success
        assert abs(sol.y[0, -1] - 4) <= allowed(tol, sol.stats.steps)


def test_ensembles_find_what_single_runs_find():
    fun = iv.compile(lambda t, y, c: [c * t * np.exp(-50 * t)])
    rows = np.array([[1e4], [0.0], [2e4], [1.0], [5e3]])
    for method in ("ode23", "ode45", "dop853", "ode15s"):
        many = iv.solve_ensemble(fun, (0, 10), np.zeros((len(rows), 1)), method, args=rows)
        for i, row in enumerate(rows):
            one = iv.solve_ivp(fun, (0, 10), [0.0], method, args=tuple(row))
            assert many.y_end[i, 0] == one.y[0, -1]
            assert many.stats["nfev"][i] == one.nfev
            assert abs(one.y[0, -1] - row[0] * TAU**2) <= 1e-2 * (1 + one.y[0, -1])


@explicit_and_implicit
def test_a_run_interrupted_before_its_first_step_goes_on_bit_for_bit(method):
    fun = stimulus(1)
    whole = iv.solve_ivp(fun, (0, 10), [0.0], method)
    for steps in (1, 2, 5):
        part = iv.solve_ivp(fun, (0, 10), [0.0], method, max_steps=steps).extend(10, max_steps=10_000)
        np.testing.assert_array_equal(part.y[:, -1], whole.y[:, -1])
        assert part.nfev == whole.nfev


def test_looks_beside_a_start_at_rest_are_few_and_cost_nothing_elsewhere():
    calls = []

    def still(t, y):
        calls.append(t)
        return [0.0 * y[0]]

    sol = iv.solve_ivp(still, (0, 10), [1.0], "ode45")
    assert len(calls) - 1 - 6 * sol.stats.steps <= 4
    moving = iv.solve_ivp(lambda t, y: [-y[0]], (0, 10), [1.0], "ode45")
    assert moving.nfev == 1 + 6 * (moving.stats.steps + moving.stats.failed)


@pytest.mark.parametrize("name", METHODS)
def test_a_first_step_below_the_spacing_of_t_is_an_error_in_its_own_words(name):
    sol = iv.solve_ivp(lambda t, y: [1e50 / y[0]], (1, 2), [1e6], name)
    assert sol.status == -1
    assert sol.t[-1] == 1
    for words in ("fun changes within", "2.2e-16 apart", "measure t from 1"):
        assert words in sol.message
    shifted = iv.solve_ivp(lambda t, y: [1e50 / y[0]], (0, 1), [1e6], name)
    assert shifted.success
    assert abs(shifted.y[0, -1] / math.sqrt(2e50) - 1) <= 1e-3 * shifted.stats.steps


@pytest.mark.parametrize("name", METHODS)
def test_it_is_one_after_an_action_too(name):
    ignite = (1.0, lambda t, y: [y[0], 1e50])
    sol = iv.solve_ivp(lambda t, y: [y[1] / y[0], 0.0], (0, 2), [1e6, 0.0], name, breakpoints=[ignite])
    assert sol.status == -1
    assert sol.t[-1] == 1
    assert "measure t from 1" in sol.message


@pytest.mark.parametrize("name", METHODS)
def test_a_component_that_starts_at_zero_under_relative_control_does_not_stop_a_run(name):
    """The component's weight asks for steps below the spacing of t, but f does not change within them."""
    sol = iv.solve_ivp(lambda t, y: [-y[0], y[0]], (1, 2), [1.0, 0.0], name, rtol=1e-6, atol=1e-30)
    assert sol.success
    assert abs(sol.y[1, -1] - (1 - math.exp(-1))) <= 1e-6 * sol.stats.steps


@pytest.mark.parametrize("name", [one for one in METHODS if one not in ("ode15s", "ode23t", "ode23tb")])
def test_steps_at_the_start_may_be_as_short_as_the_spacing_of_t(name):
    """h' = 1e-8/h, of which 16 spacings of a clock in seconds since 1970 are much too long, and one is not."""
    t0 = 1.6e9
    sol = iv.solve_ivp(lambda t, h: [1e-8 / h[0]], (t0, t0 + 86400), [1e-8], name)
    assert sol.success
    assert abs(sol.y[0, -1] / math.sqrt(2e-8 * 86400) - 1) <= 1e-3


@pytest.mark.parametrize("method", METHODS)
def test_f_that_changes_within_the_spacing_of_unix_seconds_is_integrated(method):
    """y' = 1e-8 / y from y = 1e-8, below atol: f becomes a seventh of itself within one spacing of t."""
    start, day = 1.6e9, 86400.0
    sol = iv.solve_ivp(lambda t, y: [1e-8 / y[0]], (start, start + day), [1e-8], method)
    assert sol.success
    assert sol.y[0, -1] == pytest.approx(math.sqrt(1e-16 + 2e-8 * day), rel=1e-2)


@pytest.mark.parametrize("method", METHODS)
def test_no_step_leads_over_a_pole_that_the_solution_leaves(method):
    """y' = c / y from y0 at most as large as atol: the other sign, within the tolerance, would be another solution."""
    for c, y0 in ((1e-8, 1e-6), (1e-8, 1e-7), (1e-2, 1e-6), (1e-8, -1e-6)):
        sol = iv.solve_ivp(lambda t, y, c=c: [c / y[0]], (0, 86400.0), [y0], method)
        assert sol.success, sol.message
        assert sol.y[0, -1] == pytest.approx(math.copysign(math.sqrt(y0**2 + 2 * c * 86400), y0), rel=1e-2)
