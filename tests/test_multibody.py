"""Mechanisms of the multibody benchmark library: they move as in minimal coordinates, wherever they start."""

from __future__ import annotations

import numpy as np
import pytest

import multibody
from invariode.mechanics import MechanicalSystem

MECHANISMS = {  # how long they run, and how many tolerances they may be off: errors grow with the motion's own rates
    "spatial_slider_crank": (0.5, 20),
    "rattleback": (0.1, 20),
    "rolling_disc": (0.3, 20),
}


@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
@pytest.mark.parametrize("method", ["dop853", "ode113", "radau"])
@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms_move_as_in_minimal_coordinates(name, method, rtol):
    tf, allowed = MECHANISMS[name]
    mechanism = getattr(multibody, name)()
    sol = mechanism.problem(tf).solve(method, rtol=rtol, atol=rtol, keep="end")
    assert sol.success, sol.message
    reference = mechanism.reference(tf)
    assert np.abs(sol.y[: len(reference), -1] - reference).max() <= allowed * rtol


@pytest.mark.parametrize("rtol", [1e-4, 1e-7])
@pytest.mark.parametrize("method", ["radau", "auto"])
def test_the_stiff_governor_with_redundant_rows_moves_as_in_minimal_coordinates(method, rtol):
    """At its start other rows depend on the others than beside it: two are left out all the same."""
    governor = multibody.governor()
    with pytest.warns(UserWarning, match="redundant constraints are left out") as said:
        problem = governor.problem(0.02)
    assert str(said[0].message).count("constraint ") == 2
    sol = problem.solve(method, rtol=rtol, atol=rtol, keep="end")
    assert sol.success, sol.message
    assert np.abs(sol.y[:6, -1] - governor.reference(0.02, "Radau")).max() <= 100 * rtol


def test_bricards_loop_keeps_its_energy_and_its_sparse_factors():
    bricard = multibody.bricard()
    with pytest.warns(UserWarning, match="redundant constraints are left out: constraint"):
        problem = bricard.problem(0.2)
    sol = problem.solve("dop853", rtol=1e-8, atol=1e-8)
    assert sol.success, sol.message
    energy = [bricard.system.energy(0, y[:24], y[24:]) for y in sol.y.T]
    assert np.ptp(energy) < 1e-12  # of terms of size 10
    work = sol.stats.mechanics
    assert work["dense"] == 0
    assert work["sparse"] == work["force"]


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-7, 1e-9])
@pytest.mark.parametrize("method", ["radau", "dop853", "ode113"])
def test_four_bars_pass_the_position_in_which_they_line_up(method, rtol):
    """There they could go on in two ways; errors across the constraints grow with the inverse square of the distance."""
    bars = multibody.four_bars(1)
    sol = bars.problem(0.9).solve(method, rtol=rtol, atol=rtol, keep="end", max_steps=1000)
    assert sol.success, sol.message
    assert np.abs(sol.y[:4, -1] - bars.reference(0.9)).max() <= 20 * rtol


# ----------------------------------------------------------------------------------------------------------------------
# Starts


def test_exact_starts_are_accepted_however_the_mass_couples_coordinates():
    rng = np.random.default_rng(25)
    for _ in range(25):
        root = rng.normal(size=(3, 3))
        system = MechanicalSystem(
            root @ root.T + 0.1 * np.eye(3),
            lambda t, q, v: [0, -1, 0],
            lambda t, q: np.array([q[0], q[1] ** 2 + q[2] ** 2 - 1]),
        )
        for angle, spin in rng.normal(size=(8, 2)) * [3, 1]:
            sine, cosine = np.sin(angle), np.cos(angle)
            system.problem((0, 1), [0, cosine, sine], [0, -spin * sine, spin * cosine])


def test_of_rows_that_depend_on_each_other_only_here_those_that_are_needed_here_stay():
    """Mirrored pendulums of the same angle, said three times: of the rows of the last two, one vanishes at the start."""

    def joints(t, q):
        a, b = q[:2], q[2:]
        apart = a[0] * b[1] - a[1] * b[0]  # 0: parallel
        return np.array([a @ a - 1, b @ b - 1, apart * a[0], apart * a[1]])

    system = MechanicalSystem(np.ones(4), lambda t, q, v: [0.0, -1.0, 0.0, -1.0], joints)
    with pytest.warns(UserWarning, match="left out: constraint 3"):
        problem = system.problem((0, 2), [0, -1, 0, -1], [1, 0, 1, 0])
    sol = problem.solve("radau", rtol=1e-7, atol=1e-7)
    one = MechanicalSystem(np.ones(2), lambda t, q, v: [0.0, -1.0], lambda t, q: q @ q - 1)
    alone = one.problem((0, 2), [0, -1], [1, 0]).solve("dop853", rtol=1e-10, atol=1e-10)
    assert np.abs(sol.y[:4, -1] - np.tile(alone.y[:2, -1], 2)).max() < 20 * 1e-7


def test_a_redundant_constraint_that_becomes_independent_fails_the_run():
    def rail(t, q):
        return np.array([q[1], q[1] + np.where(np.real(q[0]) > 1, (q[0] - 1) ** 3, 0)])

    system = MechanicalSystem([1, 1], lambda t, q, v: [0, 0], rail)
    with pytest.warns(UserWarning, match="left out: constraint 2"):
        problem = system.problem((0, 3), [0, 0], [1, 0])
    sol = problem.solve("ode45", rtol=1e-6, atol=1e-6)
    assert sol.status == -2
    assert sol.message.startswith("Constraint 2 depended on the others at the start")
    with pytest.warns(UserWarning, match="left out: constraint 2"):
        assert system.problem((0, 0.9), [0, 0], [1, 0]).solve("ode45").success


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives


def test_accelerations_by_complex_steps_are_those_of_minimal_coordinates_to_twelve_digits():
    mechanism = multibody.rattleback()
    problem = mechanism.problem(0.1)
    sol = problem.solve("ode45", rtol=1e-5, atol=1e-5)
    for y in sol.y.T[::4]:
        exact = mechanism.slope(0, np.concatenate([y[:7], y[10:]]))[7:]
        assert np.abs(problem.fun(0.0, y)[10:] - exact).max() < 1e-12 * np.abs(exact).max()


def test_a_component_of_a_constraint_that_does_not_bend_costs_no_halvings():
    """φ'' of an exact quadratic: two values of the rotated step agree, also where φ'' is 0."""
    calls = []

    def constraints(t, q):
        calls.append(t)
        return np.array([q[0] ** 2 + q[1] ** 2 - 1, q[0] - q[1] + q[2], q[2] * q[0]])

    system = MechanicalSystem([1, 1, 1], lambda t, q, v: [0, 0, 0], lambda t, q: constraints(t, q)[:2])
    problem = system.problem((0, 1), [0.6, 0.8, 0.2], [0.4, -0.3, -0.7])
    calls.clear()
    problem.fun(0.0, problem.y0)
    assert len(calls) <= 3 + 4  # Φ by columns; φ'' from two values, of two points each


@pytest.mark.parametrize("method", ["dop853", "radau"])
def test_a_right_energy_is_not_refused_for_the_errors_of_differences(method):
    mechanism = multibody.rattleback()
    own = mechanism.system

    def by_reals(t, q):
        return own.constraints(t, np.array(q, dtype=float) if not np.iscomplexobj(q) else abs(q))

    system = MechanicalSystem(
        own.mass, own.force, by_reals, own.velocity_constraints, own.kinematics, own.energy, own.invariants
    )
    problem = system.problem((0, 0.05), mechanism.q0, mechanism.v0)
    sol = problem.solve(method, rtol=1e-9, atol=1e-9)
    assert sol.success, sol.message
    assert sol.stats.mechanics["derivatives"]["constraints"] == "differences"

