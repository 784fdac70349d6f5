"""Symmetries of the equations are symmetries of the solver."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import invariode as iv
from cases import METHODS, SERIES
from problems import implicit, kepler, kepler_invariants, kepler_jacobian

METHOD = st.sampled_from([*METHODS, *SERIES])
ECCENTRICITY = st.floats(0.05, 0.8)
LIMITS = settings(max_examples=25, deadline=None, derandomize=True)


def orbit(e: float) -> list[float]:
    return [1 - e, 0, 0, np.sqrt((1 + e) / (1 - e))]


def invariants() -> iv.Invariants:
    return iv.Invariants(kepler_invariants, kepler_jacobian)


@pytest.mark.slow
@LIMITS
@given(METHOD, ECCENTRICITY)
def test_reversing_time_is_reversing_velocities(method, e):
    """t → −t with u → −u maps the equations to themselves, and every rounding of the solver with them."""
    x, z, u, v = orbit(e)
    forward = iv.solve_ivp(kepler, (0, 7), [x, z, u, v], method, invariants=invariants())
    backward = iv.solve_ivp(kepler, (0, -7), [x, z, -u, -v], method, invariants=invariants())
    # difference Jacobians take their increments in the direction of f, which is another one
    roundoff = 1e-5 if implicit(method) else 1e-12
    np.testing.assert_allclose(backward.t, -forward.t, rtol=roundoff if implicit(method) else 0)
    np.testing.assert_allclose(backward.y * [[1], [1], [-1], [-1]], forward.y, rtol=roundoff, atol=roundoff)


@LIMITS
@given(METHOD, ECCENTRICITY, st.integers(-40, 40))
def test_powers_of_two_in_the_units_change_nothing(method, e, k):
    """All arithmetic with a power of two is exact: y → 2^k y with atol → 2^k atol gives the same digits."""
    factor = 2.0**k

    def scaled(t, y):
        return factor * np.asarray(kepler(t, y / factor))

    g = iv.Invariants(
        lambda t, y: kepler_invariants(t, y / factor), lambda t, y: np.asarray(kepler_jacobian(t, y / factor)) / factor
    )
    y0 = np.array(orbit(e))
    plain = iv.solve_ivp(kepler, (0, 7), y0, method, invariants=invariants())
    units = iv.solve_ivp(scaled, (0, 7), factor * y0, method, atol=factor * 1e-6, invariants=g)
    np.testing.assert_array_equal(units.t, plain.t)
    np.testing.assert_array_equal(units.y / factor, plain.y)


@LIMITS
@given(METHOD, ECCENTRICITY, st.floats(0.5, 6.5))
def test_splitting_the_interval_stays_within_the_tolerance(method, e, middle):
    """A run that is stopped and restarted has the error of the tolerance, not more."""
    options = {"method": method, "rtol": 1e-8, "atol": 1e-10, "invariants": invariants()}
    whole = iv.solve_ivp(kepler, (0, 7), orbit(e), **options)
    first = iv.solve_ivp(kepler, (0, middle), orbit(e), **options)
    second = iv.solve_ivp(kepler, (middle, 7), first.y[:, -1], **options)
    np.testing.assert_allclose(second.y[:, -1], whole.y[:, -1], atol=3e-5)


@LIMITS
@given(METHOD, st.floats(0.05, 0.6), st.floats(0, 6.2))
def test_rotating_the_orbit_rotates_the_solution(method, e, angle):
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.kron(np.eye(2), [[c, -s], [s, c]])
    turned = iv.solve_ivp(kepler, (0, 7), rotation @ orbit(e), method, rtol=1e-7, atol=1e-9, invariants=invariants())
    plain = iv.solve_ivp(kepler, (0, 7), orbit(e), method, rtol=1e-7, atol=1e-9, invariants=invariants())
    np.testing.assert_allclose(turned.y[:, -1], rotation @ plain.y[:, -1], atol=2e-4)


@LIMITS
@given(METHOD, st.lists(st.floats(0.01, 9.99), min_size=1, max_size=6, unique=True))
def test_output_times_do_not_change_the_steps(method, times):
    plain = iv.solve_ivp(kepler, (0, 10), orbit(0.5), method, dense_output=True)
    at_times = iv.solve_ivp(kepler, (0, 10), orbit(0.5), method, t_eval=sorted(times))
    assert at_times.stats.steps == plain.stats.steps
    np.testing.assert_allclose(at_times.y, plain.sol(sorted(times)), rtol=1e-12, atol=1e-13)


@LIMITS
@given(METHOD, st.lists(st.floats(0.1, 9.9), min_size=1, max_size=5, unique_by=lambda s: round(s, 2)))
def test_every_simple_root_is_found_wherever_it_is(method, roots):
    """One event per root, whatever the steps."""
    roots = sorted(roots)
    events = [(lambda t, y, s=s: t - s) for s in roots]
    sol = iv.solve_ivp(kepler, (0, 10), orbit(0.3), method, events=events)
    for s, found in zip(roots, sol.t_events, strict=True):
        assert found == pytest.approx([s], abs=8 * np.spacing(10.0))
