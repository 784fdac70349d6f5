"""Corrections among the stages of a step: linear laws that nobody names survive the projection onto others."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import invariode as iv
from cases import families

EPS = np.finfo(float).eps


def toda(t, y):
    """The periodic lattice: sums of momenta and, as p is constant in the mean, of positions are linear laws."""
    q, p = y[:4], y[4:]
    force = np.exp(q - np.roll(q, -1))
    return np.concatenate([p, np.roll(force, 1) - force])


def toda_energy(t, y):
    q, p = y[:4], y[4:]
    return p @ p / 2 + np.exp(q - np.roll(q, -1)).sum()


def momentum(y):
    return y[4:].sum(axis=0)


START = [0.0, 0, 0, 0, 1.5, -0.5, 0.25, -1.0]

START_STATE = np.array(START)

#: Methods whose Newton iterations, on matrices made of differences, leave more than roundoff in linear laws.
LINEAR = {"ode23s": 1e-6, "ode23t": 1e-10, "ode23tb": 1e-9, "radau": 1e-10}


def energy(direction):
    return iv.Invariants(toda_energy, names="energy", direction=direction)


@pytest.fixture(scope="module")
def reference():
    return iv.solve_ivp(toda, (0, 20), START, "ode89", rtol=1e-12, atol=1e-13, keep="end").y[:, -1]


@families
def test_momentum_survives_energy_at_steps_and_between(method, reference):
    times = np.linspace(0, 20, 101)
    error, drift = {}, {}
    for direction in ("gradient", "stages"):
        sol = iv.solve_ivp(
            toda, (0, 20), START, method, rtol=1e-4, atol=1e-4, invariants=energy(direction), dense_output=True
        )
        assert sol.success
        error[direction] = abs(sol.y[:, -1] - reference).max()
        drift[direction] = max(abs(momentum(y) - momentum(sol.y[:, 0])).max() for y in (sol.y, sol.sol(times)))
        assert max(abs(toda_energy(0, y) - toda_energy(0, START_STATE)) for y in sol.sol(times).T) < 1e-4
    assert drift["stages"] <= LINEAR.get(method, 1e-12)
    assert drift["gradient"] > 1e3 * drift["stages"]
    assert error["stages"] < 1.5 * error["gradient"]


#: Exponential entropy: u' = -e^v, v' = e^u keep e^u + e^v (Ranocha et al., SIAM J. Sci. Comput. 42 (2020) A612).
def exponential(t, y):
    return [-np.exp(y[1]), np.exp(y[0])]


def eta(t, y):
    return np.exp(y[0]) + np.exp(y[1])


def exact(t):
    a = np.sqrt(np.e) + np.e
    b = np.sqrt(np.e) + np.exp(a * t)
    return np.array([np.log(np.e + np.e**1.5) - np.log(b), np.log(a) + a * t - np.log(b)])


@pytest.mark.parametrize("direction", ["gradient", "stages"])
@pytest.mark.parametrize("method", ["ode45", "dop853", "ode78", "ode89", "ode113"])
def test_exponential_entropy_costs_and_errs_less_than_arkode_prints(method, direction):
    t = 1.816733
    sol = iv.solve_ivp(
        exponential,
        (0, 5),
        [1, 0.5],
        method,
        rtol=1e-6,
        atol=1e-6,
        invariants=iv.Invariants(eta, direction=direction),
        dense_output=True,
    )
    assert sol.nfev <= 3125
    assert abs(sol.residual).max() <= 1e-13
    assert abs(sol.sol(t) - exact(t)).max() < 1.4e-5


def test_several_invariants_and_dissipation_go_along_the_stages():
    def euler(t, y):  # a free rigid body, and a fourth and a fifth component that exchange with each other
        return [y[1] * y[2], -y[0] * y[2], -0.51 * y[0] * y[1], -y[3] * y[4], y[3] * y[4]]

    quadrics = iv.Invariants(
        lambda t, y: [y[0] ** 2 + y[1] ** 2, 0.51 * y[0] ** 2 + y[2] ** 2], names=["a", "b"], direction="stages"
    )
    falls = iv.Dissipated(lambda t, y: y[3], names="y3", direction="stages")
    sol = iv.solve_ivp(euler, (0, 20), [0.0, 1, 1, 0.9, 0.1], rtol=1e-4, invariants=[quadrics, falls])
    assert sol.success
    assert abs(sol.residual[:2]).max() < 1e-7
    assert sol.residual[2].max() <= 100 * EPS
    assert abs(sol.y[3] + sol.y[4] - 1).max() <= 100 * EPS


def test_complex_states_events_and_extensions():
    def oscillators(t, z):
        return [1j * z[0] * abs(z[1]) ** 2, 1j * z[1] * abs(z[0]) ** 2, -1j * z[2], 1j * z[2]]

    norm = iv.Invariants(lambda t, z: abs(z[0]) ** 2 + abs(z[1]) ** 2, names="norm", direction="stages")
    crossing = iv.Event(lambda t, z: z[0].real, terminal=3)
    sol = iv.solve_ivp(
        oscillators, (0, 50), [1 + 0j, 1j, 0.5, 0.25], "ode113", rtol=1e-4, invariants=norm, events=crossing
    )
    assert sol.status == 1
    longer = sol.extend(60)
    assert abs(longer.residual).max() < 1e-5
    assert abs(longer.y[2] + longer.y[3] - 0.75).max() <= 100 * EPS


def test_an_invariant_out_of_reach_is_left_alone_and_told_when_it_matters():
    law = iv.Invariants(lambda t, y: y[1], names="y1", direction="stages")
    assert iv.solve_ivp(lambda t, y: [1.0, 0.0], (0, 1), [0.0, 1.0], invariants=law).success
    moving = iv.Invariants(lambda t, y: y[1] + 0.01 * t, names="y1", direction="stages")
    with pytest.warns(UserWarning, match="the stages of steps do not lead to the values of y1"):
        iv.solve_ivp(lambda t, y: [1.0, 0.0], (0, 1), [0.0, 1.0], invariants=moving, check=False)


def test_what_the_stages_leave_no_freedom_for_is_refused():
    along = energy("stages")

    def solving(match, *invariants, **options):
        with pytest.raises(ValueError, match=match):
            iv.solve_ivp(toda, (0, 1), START, "ode15s", invariants=list(invariants), **options)

    solving("together with bounds", along, bounds=(-10, 10))
    solving("together with a mass matrix", along, mass=np.eye(8))
    solving("different directions", along, lambda t, y: y @ y)
    solving("cannot be combined with level, moves or metric", iv.Invariants(toda_energy, level=1, direction="stages"))
    with pytest.raises(ValueError, match='cannot be "relaxation", which changes the length of a step'):
        energy("relaxation")
    with pytest.raises(ValueError, match="direction"):
        energy("stage")
    with pytest.raises(ValueError, match="impose has no steps"):
        iv.impose(along, 0.0, START)
    with pytest.raises(ValueError, match="outputs have no stages"):
        iv.solve_ivp(toda, (0, 1), START, invariants=along).impose()


def test_bodies_without_errors_are_left_alone_with_one_atol_for_all():
    """Nearly all of the error is Jupiter's. Along gradients the energy takes it from Jupiter and moves Neptune by a
    thousand times its error; along the stages, whose parts are as large as the motion of each body, by a few times."""
    example = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "outer_planets.py"))
    fun, y0 = example["planets"], example["start"]

    def energy(t, y):
        return example["laws"](t, y)[0]

    about = {"method": "dop853", "atol": 1e-8, "rtol": 1e-8, "keep": "end"}

    def end(**more):
        return iv.solve_ivp(fun, (0, 36_525), y0, **(about | more)).y[:18, -1].reshape(6, 3)

    def off(**more):
        return abs(end(**more) - exact).max(axis=1)

    exact = end(rtol=1e-13, atol=1e-15)
    plain, gradient = off(), off(invariants=energy)
    stages = off(invariants=iv.Invariants(energy, direction="stages"))
    assert stages[1] < plain[1]
    assert gradient[4] > 1000 * plain[4]
    assert stages[4] < 20 * plain[4]
    assert stages.max() < min(plain.max(), gradient.max())
