"""Functions that look conserved at a point of rest or symmetry are tested near it too."""

from __future__ import annotations

import math

import numpy as np
import pytest

import invariode as iv
from problems import PROBLEMS


def oscillator(t, y):
    return [y[1], -y[0]]


def pendulum(t, y):
    x, z, u, w = y
    pull = u * u + w * w - z
    return [u, w, -pull * x, -pull * z - 1]


def rod(t, y):
    return y[0] ** 2 + y[1] ** 2 - 1


def rod_and_rate(t, y):
    return [y[0] ** 2 + y[1] ** 2 - 1, y[0] * y[2] + y[1] * y[3]]


def wrong(t, y):
    return y[0] ** 2 + 2 * y[1] ** 2


def test_a_wrong_invariant_at_a_turning_point_is_seen():
    report = iv.check_invariants(oscillator, wrong, 0, [1.0, 0.0])
    assert not report.ok
    assert not report.conserved[0]
    assert report.rate[0] == 0
    assert "looks so at this point, but at t = " in report.findings[0]
    assert iv.check_invariants(oscillator, wrong, 0, [1.0, 0.0], nearby=False).ok


def test_so_is_a_rod_at_rest_without_its_rate():
    at_rest = [1.0, 0, 0, 0]
    assert not iv.check_invariants(pendulum, iv.Invariants(rod, value=0), 0, at_rest).ok
    assert iv.check_invariants(pendulum, iv.Invariants(rod_and_rate, value=[0, 0]), 0, at_rest).ok
    still = iv.check_invariants(lambda t, y: [0.0], lambda t, y: y + np.sin(t), 0, [1.0])  # there, by itself
    np.testing.assert_allclose(still.rate, 1, rtol=1e-6)


@pytest.mark.parametrize("name", PROBLEMS)
def test_right_invariants_stay_right(name):
    problem = PROBLEMS[name]
    report = iv.check_invariants(problem.fun, problem.invariants(), problem.t_span[0], problem.y0)
    assert report.conserved.all(), report


def test_where_functions_are_not_defined_nearby_nothing_is_held_against_them():
    def f(t, y):
        if y[0] != 1 or y[1] != 0:
            raise ZeroDivisionError
        return oscillator(t, y)

    assert iv.check_invariants(f, lambda t, y: y[0] ** 2 + y[1] ** 2, 0, [1.0, 0.0]).conserved.all()
    report = iv.check_invariants(
        lambda t, y: [-y[0]], lambda t, y: math.log(y[0]) + t if y[0] > 0 else math.nan, 0, [1e-3]
    )
    assert report.ok


def test_complex_points():
    report = iv.check_invariants(lambda t, y: 1j * y, lambda t, y: abs(y[0]) ** 2, 0, np.array([1 + 0j]))
    assert report.ok
    assert not iv.check_invariants(lambda t, y: 1j * y, lambda t, y: y[0].real ** 2, 0, np.array([1 + 0j])).ok


FAILURES = {
    "a pole": lambda: iv.solve_ivp(lambda t, y: y**2, (0, 2), [1.0]),
    "NaN later": lambda: iv.solve_ivp(lambda t, y: [math.nan if t > 0.5 else 1.0], (0, 2), [1.0]),
    "NaN at the start": lambda: iv.solve_ivp(lambda t, y: [math.nan], (0, 2), [1.0]),
    "NaN in Newton's iteration": lambda: iv.ode15s(lambda t, y: [math.nan if t > 0.5 else -y[0]], (0, 2), [1.0]),
}


@pytest.mark.parametrize("name", FAILURES)
def test_every_failure_says_what_to_try(name):
    sol = FAILURES[name]()
    assert not sol.success
    last = sol.message.rstrip(".").rpartition(". ")[2]
    assert any(word in last for word in ("try", "Try", "Give", "Check", "Correct", "stop")), sol.message
