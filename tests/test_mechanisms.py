"""Mechanisms with published solutions: these come out, and projection in levels pays."""

from __future__ import annotations

import numpy as np
import pytest

import mechanisms
from cases import dealt

EXPLICIT = ("ode45", "dop853", "ode78", "ode89", "ode113")


def errors(case, method, rtol, correction="levels"):
    """Return the largest errors of positions, velocities and multipliers at the end."""
    sol = case.problem(correction).solve(method, rtol=rtol, atol=rtol, keep="end")
    assert sol.success
    n = len(case.q0)
    off = np.abs(sol.y[:, -1] - case.end)
    parts = [off[:n].max(), off[n:].max()]
    if case.multipliers.size:
        parts.append(np.abs(case.system.multipliers(sol)[:, -1] - case.multipliers).max())
    return np.array(parts)


KNOWN = {
    # Of positions, velocities and multipliers: what they are allowed in units of the tolerance, and how good the
    # reference is. Velocities of the car axis, whose springs have the frequency 14, and multipliers see second
    # derivatives of the error of positions.
    "index_3_pendulum": ([1, 1, 1], [1e-10, 1e-10, 2e-10]),
    "car_axis": ([4, 60, 0.2], [1e-9, 1e-9, 2e-10]),
    "arevalo": ([20, 100, 400], [0, 0, 0]),
}


@dealt(6, method=EXPLICIT, name=KNOWN)
def test_errors_of_positions_velocities_and_multipliers_fall_with_the_tolerance(name, method):
    case = getattr(mechanisms, name)()
    allowed, reference = map(np.array, KNOWN[name])
    for rtol in (1e-4, 1e-6, 1e-8):
        assert (errors(case, method, rtol) <= allowed * rtol + reference).all(), rtol


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ode45", "ode113"])
def test_in_levels_the_squeezing_mechanism_has_no_fewer_digits_than_plain(method):
    """As the test set counts them, of the worst position: within 0.2 at each tolerance, and in the mean one more."""
    case = mechanisms.squeezer()
    gains = []
    for rtol in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        plain, levels = (digits(case, method, rtol, correction) for correction in ("none", "levels"))
        gains.append(levels - plain)
    assert min(gains) > -0.2
    assert np.mean(gains) > 1


def digits(case, method, rtol, correction):
    sol = case.problem(correction).solve(method, rtol=rtol, atol=rtol, keep="end")
    n = len(case.q0)
    return -np.log10(np.abs(sol.y[:n, -1] / case.end[:n] - 1).max())


def test_the_slider_crank_is_that_of_ida():
    """Five printed digits of a run at 1e-6."""
    case = mechanisms.slider_crank()
    sol = case.problem().solve("ode45", rtol=1e-7, atol=1e-7, keep="end")
    np.testing.assert_allclose(sol.y[:3, -1], case.end[:3], atol=6e-5)


@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")  # friction: in the end the points rest
@pytest.mark.parametrize(("rtol", "digits"), [(1e-4, 3.7), (1e-7, 7.0)])
def test_feketes_points_find_their_places(rtol, digits):
    """At t = 300 they are where they are published to be at 1000. Plain ode45 has 1.5 and 5.0 digits there: without
    projection points leave the sphere."""
    case = mechanisms.fekete()._replace(t_span=(0.0, 300.0))
    assert -np.log10(errors(case, "ode45", rtol)[0]) > digits
    assert -np.log10(errors(case, "ode45", rtol, "none")[0]) < digits - 2
