"""Consistent starts of singular mass matrices: index and rank do not depend on units, sizes or tolerances."""

from __future__ import annotations

import math

import numpy as np
import pytest

import invariode as iv
from cases import ALGEBRAIC

JACOBIANS = (None, "differences", "trace", "complex-step")


@pytest.mark.parametrize("method", ALGEBRAIC)
def test_algebraic_variables_at_zero_are_found_at_every_size_and_tolerance(method):
    """u1 = −3/2 u0 and u2 = u1/5 from (u0, 0, 0); only u0 has a size at the start."""

    def fun(t, u):
        return [-u[1], 3 * u[0] + 2 * u[1], u[2] - u[1] / 5]

    for size in (1e-3, 1.0, 1e3, 1e10):
        for atol in (1e-6, 1e-9, 1e-14):
            for jac in JACOBIANS:
                sol = iv.solve_ivp(
                    fun, (0, 0.1), [size, 0, 0], method, mass=np.diag([1.0, 0, 0]), atol=atol, jac=jac, rtol=1e-4
                )
                assert sol.success
                np.testing.assert_allclose(sol.y[:, 0], size * np.array([1, -1.5, -0.3]), rtol=1e-9)
                np.testing.assert_allclose(sol.y[0, -1], size * math.exp(0.15), rtol=1e-3, atol=100 * atol)


@pytest.mark.parametrize("method", ALGEBRAIC)
def test_a_constant_source_does_not_hide_the_terms_of_algebraic_variables_at_zero(method):
    """A divider of three equal resistors, whose source goes from 12 V to 24 V at t = 1/2, starts without a guess."""

    def fun(t, y):
        return [(y[2] - y[0]) / 100 - (y[0] - y[1]) / 100, (y[0] - y[1]) / 100 - y[1] / 100, 0.0]

    for atol in (1e-6, 1e-9, 1e-14):
        for jac in (None, "differences"):
            sol = iv.solve_ivp(
                fun, (0, 1), [0.0, 0.0, 12.0], method, mass=np.diag([0, 0, 1.0]), rtol=1e-6, atol=atol, jac=jac,
                breakpoints=[(0.5, lambda t, y: [0.0, 0.0, 24.0])],
            )  # fmt: skip
            assert sol.success
            np.testing.assert_allclose(sol.y[:, 0], [8, 4, 12], rtol=1e-9)
            np.testing.assert_allclose(sol.y[:, -1], [16, 8, 24], rtol=1e-6)


@pytest.mark.parametrize("method", ALGEBRAIC)
def test_units_of_components_and_equations_do_not_change_the_index(method):
    rng = np.random.default_rng(3)
    for _ in range(6):
        scale, rows = 10.0 ** rng.integers(-9, 10, 3), 10.0 ** rng.integers(-9, 10, 3)

        def fun(t, y, scale=scale, rows=rows):
            u = np.asarray(y) / scale
            return rows * np.array([-u[0], u[1] - 2 * u[0], u[2] + u[1] - u[0]])

        mass = np.diag([rows[0] / scale[0], 0, 0])
        for jac in (None, "differences"):
            sol = iv.solve_ivp(
                fun, (0, 1), scale * np.array([1.0, 0, 0]), method, mass=mass, atol=1e-8 * scale, rtol=1e-5, jac=jac
            )
            assert sol.success
            np.testing.assert_allclose(sol.y[:, -1] / scale, math.exp(-1) * np.array([1, 2, -1]), rtol=1e-3)


def test_a_large_state_beside_an_algebraic_one():
    sol = iv.solve_ivp(
        lambda t, y: [-y[0], y[1] - 2 * y[0]], (0, 1), [1e10, 0.0], "ode15s", mass=np.diag([1.0, 0]), rtol=1e-6
    )
    np.testing.assert_allclose(sol.y[:, -1], 1e10 * math.exp(-1) * np.array([1, 2]), rtol=1e-4)


@pytest.mark.parametrize("method", ALGEBRAIC)
def test_a_higher_index_is_proved_by_derivatives_and_not_by_differences(method):
    """0 = y0 − sin t does not determine y1."""

    def fun(t, y):
        return [y[1], y[0] - np.sin(t)]

    def solve(fun, jac):
        iv.solve_ivp(fun, (0, 1), [0.0, 1.0], method, mass=np.diag([1.0, 0]), jac=jac)

    exact = [(fun, None), (fun, "trace"), (fun, lambda t, y: [[0.0, 1.0], [1.0, 0.0]]), (iv.compile(fun), None)]
    for one, jac in exact:
        with pytest.raises(ValueError, match=r"index 1.*differentiates constraints"):
            solve(one, jac)
    with pytest.raises(ValueError, match="Differences of fun do not prove that") as unproved:
        solve(fun, "differences")
    assert "differentiates" not in str(unproved.value)


def test_ensembles_say_the_same():
    def fun(t, y, a):
        return [y[1], a * y[1] + y[0] - np.sin(t)]

    rows = np.array([[1.0], [0.0]])
    with pytest.warns(iv.FailureWarning, match="Differences of fun do not prove that"):
        many = iv.solve_ensemble(
            fun, (0, 1), [[0.0, 1.0]] * 2, "ode15s", args=rows, mass=np.diag([1.0, 0]), jac="differences"
        )
    assert many.status[0] == 0
    assert many.status[1] < 0
