"""Sensitivities jump where f does, if where it does depends on parameters."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, SERIES, dealt, explicit_and_implicit, families_and_series
from parametric import TOLERANCES

# The jumps are the test.
pytestmark = pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")


@explicit_and_implicit
def test_where_f_jumps_sensitivities_jump(method):
    """x' = -1 above p and -3 below: dx/dp = -2 there, to which the variational equation says 0."""
    sol = iv.solve_ivp(
        lambda t, y, p: [-1.0 if y[0] > p else -3.0], (0, 2), [2.0], method, args=(1.2,), sensitivities="p"
    )
    assert sol.sensitivities[0, 0, [0, -1]] == pytest.approx([0, -2], abs=1e-9)
    assert sol.t_events is None


STAIRS = {
    "floor": lambda t, y, a: [np.floor(a * t)],
    "ceil": lambda t, y, a: [np.ceil(a * t)],
    "truncated": lambda t, y, a: [np.trunc(a * t)],
    "modulo": lambda t, y, a: [2 * a * t - (a * t) % 1.0],
    "of 1 / a": lambda t, y, a: [(t - t % (1 / a)) * a],
    "heaviside": lambda t, y, a: [sum(np.heaviside(a * t - i, 0.5) for i in range(1, 4))],
}


@dealt(name=STAIRS, method=[*FAMILIES, *SERIES])
def test_sensitivities_jump_at_every_step_of_a_staircase(method, name):
    """The area below stairs of 0, 1, 2 and 3, each 1/a long, up to t = 3.6/a: (0 + 1 + 2)/a + 3 (t - 3/a)."""
    a, t0, tf = 0.8, 0.1, 4.5
    sol = iv.solve_ivp(STAIRS[name], (t0, tf), [0.0], method, args=(a,), rtol=1e-6, atol=1e-8, sensitivities=True)
    slopes = {"modulo": (tf**2 - t0**2) / 2}  # of the line that is added
    assert sol.sensitivities[0, 0, -1] == pytest.approx(6 / a**2 + slopes.get(name, 0), rel=1e-4)


@pytest.mark.parametrize("method", ["ode45", "ode15s", "taylor"])
def test_stairs_may_depend_on_the_solution(method):
    """y' = 1 + floor(y/p): p, p/2 and p/3 until y = 3 p, and 4 from there on."""
    sol = iv.solve_ivp(
        lambda t, y, p: [1 + np.floor(y[0] / p)], (0, 1.8), [1e-3], method, args=(0.9,), rtol=1e-6, sensitivities="p"
    )
    assert sol.sensitivities[0, 0, -1] == pytest.approx(3 - 4 * (1 + 1 / 2 + 1 / 3), rel=1e-4)


def test_signs_are_conditions():
    """Dry friction p stops a block at v / p, and turns its force: v' = -p sign(v) - 1."""

    def block(t, y, p):
        return [-p * np.sign(y[0]) - 1]

    sol = iv.solve_ivp(block, (0, 2), [1.0], args=(0.5,), **TOLERANCES, sensitivities=["p", "y0"])
    # v = 1 - (1 + p) t until t = 1 / (1 + p), then -(1 - p) (t - 1 / (1 + p))
    assert sol.sensitivities[0, :, -1] == pytest.approx([2 - 1 / 1.5 - 0.5 / 1.5**2, 0.5 / 1.5], abs=1e-8)


@pytest.mark.parametrize("forward", [True, False])
def test_switches_in_time_that_are_parameters(forward):
    def growth(t, y, p):
        return [y[0] if t < p else 2 * y[0]]

    span = (0, 2) if forward else (2, 0)
    sol = iv.solve_ivp(growth, span, [1.0], args=(1.2,), **TOLERANCES, sensitivities="p")
    sign = -1 if forward else 1
    assert sol.sensitivities[0, 0, -1] == pytest.approx(sign * np.exp(-2.8 * sign), rel=1e-6)


def test_jumps_of_an_f_that_is_not_traced_are_a_warning():
    def falling(t, y, p):
        try:  # which tracing refuses
            return [-1.0 + 0 * y[0] if y[0].real > p.real else -3.0 + 0 * y[0]]
        finally:
            pass

    with pytest.warns(iv.AccuracyWarning, match=r"fun looks discontinuous at t = 0\.[78]\d*, and not all of its"):
        iv.solve_ivp(falling, (0, 2), [2.0], args=(np.float64(1.2),), **TOLERANCES, sensitivities=True)


def test_a_continuous_kink_is_no_jump():
    """No event, so that the steps are those of y, if f is continuous where its branches meet."""
    run = {"args": (0.5,), **TOLERANCES}
    sensitivities = iv.Sensitivities("p", error_test=False)
    kink = iv.compile(lambda t, y, p: [-y[0] if y[0] > p else -p])
    alone, sol = (iv.solve_ivp(kink, (0, 2), [1.0], **run, sensitivities=one) for one in (None, sensitivities))
    assert np.array_equal(sol.t, alone.t)


def switching(t, y, p):
    """−1 above p, −3 below: y(2) from 2 has the derivative −2."""
    return [np.where(y[0] > p, -1.0, -3.0)]


def test_conditions_of_f_are_no_events_of_the_user(tmp_path):
    problem = iv.Problem(switching, (0, 2), [2.0], args=(1.2,), events=[lambda t, y, p: y[0] - 1.6], sensitivities=True)
    for sol in (problem.solve(), problem.replace(t_span=(0, 0.1)).solve().extend(2.0)):
        assert len(sol.t_events) == len(sol.y_events) == len(sol.sensitivities_t_events) == 1
        assert sol.sensitivities[0, 0, -1] == pytest.approx(-2)
    sol.save(tmp_path / "sol.npz")
    assert sol.to_dataframe().shape[0] == len(sol.t)


def test_jumps_far_from_the_start_are_followed():
    sol = iv.solve_ivp(
        lambda t, y, p: [(t > 50) * switching(t, y, p)[0]],
        (0, 52),
        [2.0],
        args=(1.2,),
        breakpoints=[50],
        sensitivities=True,
    )
    assert sol.sensitivities[0, 0, -1] == pytest.approx(-2)


def test_one_condition_written_in_two_ways():
    """Written as a difference it is known to be the same; times 2 it is not, which is said."""
    for other, same in ((lambda d: np.sign(d), True), (lambda d: np.where(2 * d > 0, 1.0, -1.0), False)):

        def fun(t, y, p, other=other):
            return [-4 + other(y[0] - p) + np.where(y[0] > p, 1.0, -1.0)]

        options = {"args": (1.2,), "sensitivities": True}
        if same:
            assert iv.solve_ivp(fun, (0, 2), [2.0], **options).sensitivities[0, 0, -1] == pytest.approx(-2)
            continue
        with pytest.warns(iv.AccuracyWarning, match="several conditions of fun change together at t = 0.4|0.3"):
            iv.solve_ivp(fun, (0, 2), [2.0], **options)


@families_and_series
def test_an_input_may_be_compared_with_a_parameter(method):
    """u = t passes p at t = p, where y' goes from -1 to -3: y(2) = 2 - p - 3 (2 - p)."""
    problem = iv.Problem(
        lambda t, y, u, p: [np.where(u > p, -3.0, -1.0)],
        (0, 2),
        [2.0],
        args=(0.7,),
        inputs=[iv.Input([0, 2], [0.0, 2.0], "linear")],
        sensitivities=True,
    )
    sol = problem.solve(method, adjoint=True)
    assert sol.y[0, -1] == pytest.approx(2 - 0.7 - 3 * 1.3, rel=1e-9)
    assert sol.sensitivities[0, 0, -1] == pytest.approx(2, rel=1e-9)
    assert sol.gradient([1.0]) == pytest.approx([2], rel=1e-9)
