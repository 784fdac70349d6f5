"""ode23t, the trapezoidal rule: oscillations are not damped, stiff components do not ring."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv

RTOLS = [1e-3, 1e-5]


@pytest.mark.parametrize("rtol", RTOLS)
def test_oscillations_are_not_damped(rtol):
    """|R(iθ)| = 1: whatever the steps, linear oscillators keep their energies, to the roundoff of the steps."""
    rates = np.array([1.0, 2.7, 9.0])
    A = np.block([[np.zeros((3, 3)), np.diag(rates)], [-np.diag(rates), np.zeros((3, 3))]])
    start = [1.0, 0.5, 0.2, 0, 0, 0]
    sol = iv.ode23t(lambda t, y: A @ y, (0, 50), start, jac=A, rtol=rtol, atol=rtol)
    energies = sol.y[:3] ** 2 + sol.y[3:] ** 2
    assert len(np.unique(sol.steps.h)) > 5
    np.testing.assert_allclose(energies, np.tile(energies[:, :1], len(sol.t)), rtol=10 * 2.0**-52 * len(sol.t))


@pytest.mark.parametrize("rtol", RTOLS)
@pytest.mark.parametrize("rate", [1e3, 1e6, 1e9])
def test_what_has_decayed_stays_away(rate, rtol):
    """At the steps and between them, and steps become long: as an L-stable formula does it."""
    about = {"rtol": rtol, "atol": 1e-3 * rtol, "jac": [[-rate]], "dense_output": True}
    sol = iv.ode23t(lambda t, y: -rate * y, (0, 0.5), [1.0], **about)
    damped = iv.ode23tb(lambda t, y: -rate * y, (0, 0.5), [1.0], **about)
    assert sol.stats.steps < 1.4 * damped.stats.steps  # whose error constant is half as large
    assert sol.steps.h.max() > 0.049  # the longest step is a tenth of the interval
    late = np.geomspace(20 / rate, 0.5, 2001)
    assert np.abs(sol.sol(late)).max() < about["atol"]
    assert np.abs(sol.sol(np.linspace(0.25, 0.5, 2001))).max() < 1e-3 * about["atol"]


@pytest.mark.parametrize("rtol", RTOLS)
def test_the_slopes_of_algebraic_components_are_smooth(rtol):
    """0 = z - x² determines z, not z', whose error at the start would stay for ever while h grows a thousandfold."""
    sol = iv.ode23t(
        lambda t, y: [1 / (1 + t) - 0 * y[0], y[1] - y[0] ** 2],
        (0, 1e6), [1.0, 1.0], mass=np.diag([1.0, 0]), rtol=rtol, atol=1e-3 * rtol, first_step=1e-6, dense_output=True,
    )  # fmt: skip
    assert sol.steps.h.max() > 1e3 * sol.steps.h[0]
    t = np.geomspace(1e-5, 1e6, 2001)
    x, z = sol.sol(t)
    exact = 1 + np.log1p(t)
    assert np.abs(x / exact - 1).max() < 100 * rtol
    assert np.abs(z / exact**2 - 1).max() < 200 * rtol


def test_ringing_costs_a_solve_where_it_occurs_and_none_elsewhere():
    """One solve for each iteration and one for each estimate; in the long steps of a stiff problem, some more."""

    def extra(jac, **options):
        sol = iv.ode23t(lambda t, y: jac @ y, jac=jac, **options)
        return sol.stats.nsolve - (sol.nfev - 2) - sol.stats.steps - sol.stats.failed

    rotation = np.array([[0, 1.0], [-1, 0]])
    assert extra(rotation, t_span=(0, 30), y0=[1.0, 0]) <= 0
    assert extra(np.diag([-1e6, -1.0]), t_span=(0, 5), y0=[1.0, 1]) > 0
