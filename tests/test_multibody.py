"""Mechanisms of the multibody benchmark library: they move as in minimal coordinates, wherever they start."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from sympy.physics.mechanics import dynamicsymbols

import invariode as iv
import multibody
from cases import dealt
from invariode import symbolic
from invariode._mechanics.system import MechanicalSystem

MECHANISMS = {  # how long they run, and how many tolerances they may be off: errors grow with the motion's own rates
    "spatial_slider_crank": (0.5, 20),
    "rattleback": (0.1, 20),
    "rolling_disc": (0.3, 20),
}


@dealt(9, name=MECHANISMS, method=["dop853", "ode113", "radau"], rtol=[1e-6, 1e-9])
def test_mechanisms_move_as_in_minimal_coordinates(name, method, rtol):
    tf, allowed = MECHANISMS[name]
    mechanism = getattr(multibody, name)()
    sol = mechanism.problem(tf).solve(method, rtol=rtol, atol=rtol, keep="end")
    assert sol.success, sol.message
    reference = mechanism.reference(tf)
    assert np.abs(sol.y[: len(reference), -1] - reference).max() <= allowed * rtol


@pytest.mark.parametrize(("method", "rtol"), [("radau", 1e-7), ("auto", 1e-4)])
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


@dealt(rtol=[1e-4, 10**-6.5, 1e-7, 10**-7.5, 1e-9], method=["radau", "dop853", "ode113"])
def test_four_bars_pass_the_position_in_which_they_line_up(method, rtol):
    """There they could go on in two ways; errors across the constraints grow as its distance squared falls."""
    bars = multibody.four_bars(1)
    sol = bars.problem(2.0).solve(method, rtol=rtol, atol=rtol, keep="end", max_steps=1000)
    assert sol.success, sol.message
    assert np.abs(sol.y[:4, -1] - bars.reference(2.0)).max() <= 20 * rtol


@pytest.mark.parametrize("loops", [2, 20])  # with dense factors, and with sparse ones
def test_near_a_singular_position_an_error_across_the_constraints_is_not_magnified(loops):
    """At a distance of 1e-3 the formula of the accelerations alone magnifies it 1e4 times."""
    problem = multibody.four_bars(loops).problem(1.0)
    angle, turn, across = np.pi / 2 - 1e-3, 5.0, 1e-9
    tops = loops + 1
    q = np.column_stack([np.arange(tops) + np.sin(angle), np.full(tops, np.cos(angle))])
    v = np.tile([turn * np.cos(angle), -turn * np.sin(angle)], tops)
    there = problem.fun(0.0, np.concatenate([q.ravel(), v]))
    signs = np.zeros((tops, 2))
    signs[:, 1] = np.where(np.arange(tops) % 2, -1, 1)
    off = problem.fun(0.0, np.concatenate([q.ravel(), v + across * signs.ravel()])) - there
    assert np.abs(off[2 * tops :]).max() < 100 * across


@pytest.mark.parametrize("loops", [1, 10, 20])
def test_accelerations_at_a_singular_position_are_those_of_minimal_coordinates(loops):
    """At a distance of σ, the formula alone leaves ε / σ³, and nothing at 0; interpolation across leaves 1e-10."""
    bars = multibody.four_bars(loops)
    problem, tops, turn = bars.problem(1.0), loops + 1, 5.0
    for distance in (1e-2, 5e-3, 1e-3, 1e-5, 1e-7, 0.0):
        angle = np.pi / 2 - distance
        sine, cosine, bend = np.sin(angle), np.cos(angle), bars.slope(0, np.array([angle, turn]))[1]
        q = np.column_stack([np.arange(tops) + sine, np.full(tops, cosine)])
        v = np.tile([turn * cosine, -turn * sine], tops)
        exact = np.tile([bend * cosine - turn**2 * sine, -bend * sine - turn**2 * cosine], tops)
        found = problem.fun(0.0, np.concatenate([q.ravel(), v]))[2 * tops :]
        assert np.abs(found - exact).max() < 1e-8 * turn**2


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
    """Two pendulums that are parallel, which two rows say: the first of them vanishes at the start."""

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


@pytest.mark.slow
def test_a_redundant_constraint_that_becomes_independent_ends_the_run_there(tmp_path):
    """The run ends even if the constraint holds again at the end, whatever is kept, and in ensembles."""

    def problem(bend, tf):
        system = MechanicalSystem([1, 1], lambda t, q, v: [0, 0], lambda t, q: np.array([q[1], q[1] + bend(q[0])]))
        with pytest.warns(UserWarning, match="left out: constraint 2"):
            return system.problem((0, tf), [0, 0], [1, 0])

    def rail(x):
        return np.where(np.real(x) > 1, (x - 1) ** 3, 0)

    def bump(x):
        return np.where((np.real(x) > 1) & (np.real(x) < 2), ((x - 1) * (x - 2)) ** 3, 0)

    seen: list[float] = []
    tight, fine = {"rtol": 1e-6, "atol": 1e-6}, {"max_step": 0.05, "on_failure": "return"}
    for bent, options in ((rail, tight | fine), (bump, fine), (bump, fine | {"t_eval": [1.0, 2.5]})):
        sol = problem(bent, 3).solve("ode45", **options)
        assert sol.status == -2
        assert 1 < sol.t_end < 1.5
        assert sol.t[-1] <= sol.t_end
        assert sol.message.startswith("Constraint 2 depended on the others at the start")
        assert f"at t = {sol.t_end:.6g} " in sol.message
        rows = [[0, 0, 1, 0], [0, 0, 0.1, 0], [1.5, 0, 1, 0]]  # the last one starts where it does not hold
        for workers in (1, 2) if bent is rail else (2,):
            how = {"workers": workers, "on_failure": "return", **options}
            many = problem(bent, 3).solve_ensemble(rows, "ode45", **how)
            assert many.status.tolist() == [-2, 0, -2]
            assert many.t_end[0] == sol.t_end
            assert many.messages[0] == sol.message
        stored = problem(bent, 3).solve_ensemble(rows, "ode45", store=tmp_path / f"{len(seen)}", **how)
        assert stored.failed.tolist() == [0, 2]
        seen.append(sol.t_end)
    stopped = problem(rail, 3).solve("ode45", callback=lambda t, y: seen.append(t) or t > 0.5, **fine)
    assert (stopped.status, stopped.t_end) == (2, seen[-1])
    sol = problem(rail, 0.9).solve("ode45", **fine)
    assert sol.success
    assert sol.extend(3).status == -2


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives


def test_accelerations_by_complex_steps_are_those_of_minimal_coordinates_to_twelve_digits():
    mechanism = multibody.rattleback()
    problem = mechanism.problem(0.1)
    rng = np.random.default_rng(3)
    for _ in range(60):
        e, spin = rng.normal(size=4), 5 * rng.normal(size=3)
        state = np.concatenate([np.zeros(3), e / np.linalg.norm(e), spin])
        state[2] = mechanism.height(state[3:7])
        exact = mechanism.slope(0, state)
        found = problem.fun(0.0, np.concatenate([state[:7], exact[:3], spin]))[10:]
        assert np.abs(found - exact[7:]).max() < 1e-12 * np.abs(exact[7:]).max()


def test_a_constraint_that_does_not_bend_costs_no_halvings():
    """Two values of the rotated step agree, also where φ'' is the roundoff of terms that cancel."""
    calls = []

    def constraints(t, q):
        calls.append(t)
        return np.array([q @ q - 1, 0.3 * q[0] - 0.7 * q[1] + 1.1 * q[2]])

    axis = np.array([0.3, -0.7, 1.1])
    q0 = np.cross(axis, [0.2, 0.5, 0.4])
    q0 /= np.linalg.norm(q0)
    problem = MechanicalSystem([1, 1, 1], lambda t, q, v: [0, 0, 0], constraints).problem(
        (0, 1), q0, np.cross(axis, q0)
    )
    calls.clear()
    problem.fun(0.0, problem.y0)
    assert len(calls) <= 3 + 4  # Φ by columns; φ'' from two values, of two points each


def test_the_guard_knows_what_derivatives_by_differences_are_good_to():
    def by_reals(t, q):
        return float(q[0]) ** 2 + float(q[1]) ** 2 - 1

    def energy(t, q, v):
        return (v @ v) / 2 + q[1]

    angles = []
    for constraint in (by_reals, lambda t, q: q[0] ** 2 + q[1] ** 2 - 1):
        system = MechanicalSystem([1, 1], lambda t, q, v: [0.0, -1.0], constraint, energy=energy)
        problem = system.problem((0, 1), [0.6, -0.8], [0.8, 0.6])
        angles.append(iv.check_invariants(problem.fun, problem.invariants, 0, problem.y0).detectable[-1])
    assert angles == [50 * np.finfo(float).eps ** 0.5, 1e-11]


# ----------------------------------------------------------------------------------------------------------------------
# Euler's angles


def test_near_gimbal_lock_a_top_has_the_accelerations_of_its_formula():
    phi, theta, psi = dynamicsymbols("phi theta psi")
    across, along, weight = sympy.Rational(7, 10), sympy.Rational(3, 10), sympy.Rational(13, 10)
    kinetic = across * (theta.diff() ** 2 + (phi.diff() * sympy.sin(theta)) ** 2) / 2
    kinetic += along * (psi.diff() + phi.diff() * sympy.cos(theta)) ** 2 / 2
    top = symbolic.lagrangian(kinetic - weight * sympy.cos(theta), [phi, theta, psi])
    tilt, turn, swing, spin = 1e-3, 0.3, 0.2, 5.0
    problem = top.problem((0, 1), [0.1, tilt, 0.2], [turn, swing, spin], compiled=False, laws=False)
    own = spin + turn * np.cos(tilt)
    exact = swing * (0.3 * own - 1.4 * turn * np.cos(tilt)) / (0.7 * np.sin(tilt))
    found = problem.fun(0.0, np.array([0.1, tilt, 0.2, turn, swing, spin]))[3]
    assert abs(found - exact) < 1e-14 * exact
