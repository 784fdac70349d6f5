"""Constrained mechanics: known motions and multipliers, derivatives, consistent starts, redundancy, bad input."""

from __future__ import annotations

import re
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse

import invariode as iv
from cases import FAMILIES, dealt, families
from invariode._mechanics.differentiable import Differentiable
from invariode._mechanics.system import MechanicalSystem
from invariode.problems import pendulum
from mechanisms import circle, gravity, swing
from problems import slack

CORRECTIONS = ("levels", "joint", "none")


# ----------------------------------------------------------------------------------------------------------------------
# Known motions


@pytest.mark.parametrize("imposed", [False, True])
def test_the_papers_pendulum_has_the_counts_of_the_equations_written_by_hand(imposed):
    """Shampine (1999), p. 70: without and with joint projection."""
    options = {"refine": 4, "interpolation": "raw"}
    by_hand = pendulum(imposed=imposed).solve("ode45", **options)
    system = swing(lambda t, q: q[0] ** 2 + q[1] ** 2 - 1)
    correction = "joint" if imposed else "none"
    ours = system.problem((0, 50), [1, 0], [0, 0], correction=correction).solve("ode45", **options)
    assert (ours.stats.steps, ours.stats.failed, ours.nfev) == ((98, 10, 649), (113, 9, 733))[imposed]
    np.testing.assert_allclose(ours.y, by_hand.y, atol=1e-5)  # roundoff, amplified over the 50 units of t


# x'' = -x λ, y'' = -y λ - 1 from (1, 0, 0, 1): the state at t = 1, and λ, as solvers of index 3 are tested with. By the
# angle's equation θ'' = -cos θ these digits are good to 3e-11.
INDEX_3 = [0.867348640604551746, 0.497701050476373918, -0.0337480180329866458, 0.0588130114660715686]
TENSION = -0.493103151528274442


@dealt(method=FAMILIES, correction=CORRECTIONS)
def test_the_index_3_pendulum_and_its_multiplier(method, correction):
    errors = []
    for rtol in (1e-4, 1e-7):
        system = swing()
        problem = system.problem((0, 1), [1, 0], [0, 1], correction=correction)
        sol = problem.solve(method, rtol=rtol, atol=rtol / 10)
        off = np.append(sol.y[:, -1] - INDEX_3, system.multipliers(sol)[0, -1] + TENSION)  # ours has the other sign
        errors.append(np.abs(off).max() / rtol)
    assert max(errors) < 30 * slack(method)  # of the global error over the interval, in units of the tolerance


def particle(t, q, v):
    """Arévalo's problem: q = (sin t², cos t²), λ = -4 t² for φ = (q² - 1)/2."""
    return [2 * q[1], -2 * q[0]]


def test_arevalos_problem_converges_in_positions_and_multipliers():
    system = MechanicalSystem([1, 1], particle, circle)
    problem = system.problem((0, 3), [0, 1], [0, 0])
    errors = []
    for rtol in (1e-4, 1e-7, 1e-10):
        sol = problem.solve("dop853", rtol=rtol, atol=rtol)
        exact = np.array([np.sin(sol.t**2), np.cos(sol.t**2)])
        errors.append((np.abs(sol.y[:2] - exact).max(), np.abs(system.multipliers(sol)[0] + 4 * sol.t**2).max()))
    errors = np.array(errors)
    assert (errors[1:] < errors[:-1] / 20).all()
    assert (errors[-1] < [1e-7, 1e-5]).all()


def test_a_bead_on_a_moving_wire_follows_it():
    """φ depends on t: q₂ = sin t q₁, without forces along the wire."""
    system = MechanicalSystem([1, 1], lambda t, q, v: [0, 0], lambda t, q: q[1] - np.sin(t) * q[0])
    sol = system.problem((0, 5), [1, 0], [0, 1]).solve("dop853", rtol=1e-9, atol=1e-11)
    q, v = sol.y[:2], sol.y[2:]
    assert np.abs(q[1] - np.sin(sol.t) * q[0]).max() < 1e-14 * np.abs(q).max()
    assert np.abs(v[1] - np.sin(sol.t) * v[0] - np.cos(sol.t) * q[0]).max() < 1e-13 * np.abs(sol.y).max()
    by_hand = iv.solve_ivp(  # s' of the coordinate along: (1 + sin²) s'' = -(sin cos 2 s' - sin² s) with q₂ = sin t s
        lambda t, s: [s[1], -np.sin(t) * (2 * np.cos(t) * s[1] - np.sin(t) * s[0]) / (1 + np.sin(t) ** 2)],
        (0, 5), [1, 0], "dop853", rtol=1e-11, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(sol.y[[0, 2], -1], by_hand.y[:, -1], rtol=1e-7)


def skate_force(t, q, v):
    return [np.sin(np.pi / 6), 0, 0]  # down an inclined plane


def skate(t, q, v):
    return v[0] * np.sin(q[2]) - v[1] * np.cos(q[2])


def test_a_skate_on_an_inclined_plane_rises_again():
    """Non-holonomic: with spin ω from rest x = g/(2 ω²) sin² ω t, for g the pull along the plane."""
    pull, spin = 0.5, 1.0
    system = MechanicalSystem([1, 1, 1], skate_force, velocity_constraints=skate)
    sol = system.problem((0, 6), [0, 0, 0], [0, 0, spin]).solve("ode45", rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(sol.y[0], pull / (2 * spin**2) * np.sin(spin * sol.t) ** 2, atol=1e-7)
    assert np.abs(skate(sol.t, sol.y[:3], sol.y[3:])).max() < 1e-14


def turn(t, q, v):
    """q' of a unit quaternion, v the angular velocity in the body."""
    w, x, y, z = q
    a, b, c = v
    return np.array([-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]) / 2


INERTIA = np.array([1.0, 2.0, 3.0])


def test_quaternions_have_more_positions_than_velocities():
    def euler(t, q, v):
        return np.cross(INERTIA * v, v)

    system = MechanicalSystem(
        INERTIA,
        euler,
        kinematics=turn,
        energy=lambda t, q, v: INERTIA @ v**2 / 2,
        invariants=iv.UnitQuaternion([0, 1, 2, 3]),
    )
    sol = system.problem((0, 50), [1, 0, 0, 0], [0.1, 2, 0.1]).solve("ode45", rtol=1e-6, atol=1e-9)
    assert sol.success
    assert np.abs(np.linalg.norm(sol.y[:4], axis=0) - 1).max() < 1e-14
    assert np.abs(INERTIA @ sol.y[4:] ** 2 - INERTIA @ sol.y[4:, 0] ** 2).max() < 1e-12
    w, x, y, z = sol.y[:4]
    first_row = [1 - 2 * (y**2 + z**2), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    momentum = sum(entry * i * v for entry, i, v in zip(first_row, INERTIA, sol.y[4:], strict=True))
    np.testing.assert_allclose(momentum, momentum[0], atol=1e-3)  # in space: not imposed


def test_a_constraint_of_quaternions_is_differentiated_through_the_kinematics(tmp_path):
    """The body axis e₁ stays in the plane z = 0, as a holonomic constraint of q."""

    def level(t, q):
        w, x, y, z = q
        return 2 * (x * z - w * y)

    system = MechanicalSystem(INERTIA, lambda t, q, v: np.cross(INERTIA * v, v), level, kinematics=turn)
    sol = system.problem((0, 10), [1, 0, 0, 0], [1, 0, 0.5]).solve("dop853", rtol=1e-9, atol=1e-11)
    assert sol.success
    assert np.abs(level(0, sol.y[:4])).max() < 1e-13
    energy = INERTIA @ sol.y[4:] ** 2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)  # constraints do no work
    assert system.multipliers(sol).shape == (1, len(sol.t))
    sol.save(tmp_path / "top")
    np.testing.assert_array_equal(system.multipliers(iv.load(tmp_path / "top")), system.multipliers(sol))


# ----------------------------------------------------------------------------------------------------------------------
# Corrections


@dealt(method=FAMILIES, correction=CORRECTIONS)
def test_what_is_imposed_holds_to_roundoff_in_every_method(method, correction):
    system = swing(energy=lambda t, q, v: (v @ v) / 2 + q[1] if not np.iscomplexobj(v) else (v**2).sum() / 2 + q[1])
    sol = system.problem((0, 10), [1, 0], [0, 0], correction=correction).solve(method, rtol=1e-5, atol=1e-7)
    assert sol.success
    q, v = sol.y[:2], sol.y[2:]
    residual = max(np.abs(circle(0, q)).max(), np.abs((q * v).sum(axis=0)).max())
    if correction == "levels":
        assert residual < 1e-14
        assert np.abs((v**2).sum(axis=0) / 2 + q[1]).max() < 1e-13
    elif correction == "none":
        assert residual > 1e-13


def test_masses_and_lengths_of_very_different_units_change_nothing():
    def scaled(mass, length):
        system = MechanicalSystem(
            [mass, mass],
            lambda t, q, v: [0, -mass * length],
            lambda t, q: 1e3 * (q[0] ** 2 + q[1] ** 2 - length**2),
        )
        sol = system.problem((0, 5), [length, 0], [0, 0]).solve("ode45", rtol=1e-6, atol=1e-9 * length)
        return sol.y / length

    np.testing.assert_allclose(scaled(1e-9, 1e-6), scaled(1, 1), atol=1e-9)


# ----------------------------------------------------------------------------------------------------------------------
# Impacts


def arm_hits_a_wall():
    """Two links of length 1 in the plane with unit masses at their ends; the tip bounces off the wall x = 0.5."""

    def joints(t, q):
        return np.array([q[0] ** 2 + q[1] ** 2 - 1, (q[2] - q[0]) ** 2 + (q[3] - q[1]) ** 2 - 1])

    def energy(t, q, v):
        return (v**2).sum() / 2 + q[1] + q[3]

    def bounce(t, y):
        y[6] *= -0.5  # of the tip alone: the joints do not allow that
        return y

    arm = MechanicalSystem(np.ones(4), lambda t, q, v: [0, -1, 0, -1], joints, energy=energy)
    wall = iv.Event(lambda t, y: y[2] - 0.5, direction=1, action=bounce)
    return joints, energy, arm.problem((0, 4), [-1, 0, -2, 0], [0, 0, 0, 0]).replace(events=wall)


@families
def test_after_an_impact_the_constraints_hold_and_the_energy_has_its_new_value(method):
    joints, energy, problem = arm_hits_a_wall()
    sol = problem.solve(method, rtol=1e-5, atol=1e-5)
    assert sol.success
    assert len(sol.t_events[0]) >= 1
    q, v = sol.y[:4], sol.y[4:]
    assert np.abs(joints(0, q)).max() < 1e-14
    apart, rates = q[2:] - q[:2], v[2:] - v[:2]
    assert max(np.abs((q[:2] * v[:2]).sum(axis=0)).max(), np.abs((apart * rates).sum(axis=0)).max()) < 1e-13
    pieces = np.searchsorted(sol.t_events[0], sol.t)  # a stored point at the jump is the one before it or the one after
    levels = [np.array([energy(0, *np.split(y, 2)) for y in sol.y[:, pieces == k].T]) for k in np.unique(pieces)]
    assert np.ptp([one[len(one) // 2] for one in levels]) > 0.01  # energy is lost
    for one in levels:
        assert np.ptp(one[1:-1]) < 1e-13


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives


def linkage(t, q):
    return np.array([np.sin(q[0] + t) * q[1] - np.exp(-q[2]), np.sqrt(q[1] ** 2 + q[2] ** 2) - np.cos(q[0])])


def linkage_by_reals(t, q):
    return linkage(t, np.asarray(q, dtype=float) if not np.iscomplexobj(q) else abs(q))


def exact_jacobian(t, q):
    r = np.hypot(q[1], q[2])
    return np.array([[np.cos(q[0] + t) * q[1], np.sin(q[0] + t), np.exp(-q[2])], [np.sin(q[0]), q[1] / r, q[2] / r]])


@pytest.mark.parametrize(
    ("function", "kind", "first", "second"),
    [(linkage, "complex step", 1e-14, 1e-11), (linkage_by_reals, "differences", 1e-11, 1e-7)],
)
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_derivatives_are_as_good_as_their_kind(function, kind, first, second, size):
    rng = np.random.default_rng(1)
    for _ in range(20):
        t, q, dq = rng.normal(), rng.normal(size=3), size * rng.normal(size=3)
        at = Differentiable(function, t, (q,), (), "linkage")
        assert at.how == kind
        jacobian = exact_jacobian(t, q)
        np.testing.assert_allclose(at.jacobian(t, q), jacobian, atol=first * 10)
        rate = jacobian @ dq + size * np.array([np.cos(q[0] + t) * q[1], 0])
        np.testing.assert_allclose(at.slope(t, q, size, dq), rate, atol=first * 20 * np.abs(dq).max())
        angle, bend = q[0] + t, dq[0] + size
        r = np.hypot(q[1], q[2])
        cross = q[1] * dq[2] - q[2] * dq[1]
        exact = [
            -np.sin(angle) * bend**2 * q[1] + 2 * np.cos(angle) * bend * dq[1] - np.exp(-q[2]) * dq[2] ** 2,
            cross**2 / r**3 + np.cos(q[0]) * dq[0] ** 2,
        ]
        terms = np.abs(exact).max() + (np.abs(dq).max() + size) ** 2
        off = np.abs(at.curvature(t, q, size, dq) - exact).max()
        assert off < second * terms / min(1.0, r) ** 3


def test_a_rest_has_no_curvature():
    at = Differentiable(linkage, 0.0, (np.ones(3),), (), "linkage")
    assert not at.curvature(0.0, np.ones(3), 0.0, np.zeros(3)).any()


@pytest.mark.parametrize(
    "constraints",
    [
        lambda t, q: abs(q[0] + 1j * q[1]) - 1 if not np.iscomplexobj(q) else np.hypot(q[0], q[1]) - 1,
        lambda t, q: max(q[0] ** 2 + q[1] ** 2, 0.25) - 1,
        lambda t, q: float(np.real(q[0])) ** 2 + float(np.real(q[1])) ** 2 - 1,
    ],
    ids=["hypot", "max", "real parts"],
)
def test_constraints_that_do_not_take_complex_positions_are_differentiated_by_differences(constraints):
    sol = swing(constraints).problem((0, 5), [1, 0], [0, 0]).solve("ode45", rtol=1e-7, atol=1e-9)
    exact = swing().problem((0, 5), [1, 0], [0, 0]).solve("ode45", rtol=1e-7, atol=1e-9)
    assert sol.success
    np.testing.assert_allclose(sol.y[:, -1], exact.y[:, -1], atol=1e-6)


def test_a_given_jacobian_is_used():
    calls = []

    def jacobian(t, q):
        calls.append(t)
        return [q[0], q[1]]

    with_it = swing(jacobian=jacobian).problem((0, 5), [1, 0], [0, 0]).solve("dop853")
    without = swing().problem((0, 5), [1, 0], [0, 0]).solve("dop853")
    assert len(calls) > with_it.nfev
    np.testing.assert_allclose(with_it.y, without.y, atol=1e-10)


# ----------------------------------------------------------------------------------------------------------------------
# The start


def test_an_inconsistent_start_is_refused_with_its_distance():
    with pytest.raises(iv.InvariantError, match=r"constraint 1.*distance of .* times the tolerance"):
        swing().problem((0, 1), [1.2, 0], [0, 0]).solve()
    with pytest.raises(iv.InvariantError, match=r"rate of constraint 1"):
        swing().problem((0, 1), [1, 0], [0.3, 0]).solve()
    with pytest.raises(iv.InvariantError, match='consistent="project"'):
        swing().problem((0, 1), [1.2, 0], [0, 0], correction="none")


def test_a_start_within_the_tolerance_is_moved():
    sol = swing().problem((0, 1), [0.6 + 1e-6, 0.8], [-0.8 + 1e-6, 0.6]).solve(rtol=1e-3)
    assert sol.stats.projected_start
    assert abs(circle(0, sol.y[:2, 0])) < 1e-15


def test_projection_of_the_start_is_the_least_change_in_the_metric_of_the_mass():
    """Two masses on a line at distance 1: the heavy one moves less, and the centre of mass rests."""
    masses = np.array([1.0, 9.0])
    rod = MechanicalSystem(masses, lambda t, q, v: [0, 0], lambda t, q: q[1] - q[0] - 1)
    with pytest.warns(UserWarning, match=r": q1 from 0 to 0\.09, q2 from 1\.1 to 1\.09, v1 from 0 to 1\.8, v2"):
        problem = rod.problem((0, 1), [0, 1.1], [0, 2], consistent="project")
    np.testing.assert_allclose(problem.y0, [0.09, 1.09, 1.8, 1.8], atol=1e-14)


def test_what_is_fixed_at_the_start_stays():
    """The heavy mass follows the light one, whose velocity and position are given; what contradicts itself is said."""
    rod = MechanicalSystem(np.array([1.0, 9.0]), lambda t, q, v: [0, 0], lambda t, q: q[1] - q[0] - 1, labels=[*"abvw"])
    with pytest.warns(UserWarning, match="b from 1.1 to 1, w from 0 to 2$"):
        problem = rod.problem((0, 1), [0, 1.1], [2, 0], consistent="project", fixed=["a", "v"])
    np.testing.assert_allclose(problem.y0, [0, 1, 2, 2], atol=1e-14)
    with pytest.raises(iv.InvariantError, match=r"no position near q0 .* or what is fixed: check"):
        rod.problem((0, 1), [0, 1.1], [2, 0], consistent="project", fixed=["a", "b"])
    with pytest.raises(iv.InvariantError, match=r"no velocities .* or what is fixed, or"):
        rod.problem((0, 1), [0, 1.1], [2, 0], consistent="project", fixed=["v", "w"])
    with pytest.raises(ValueError, match="there is no component 'u'"):
        rod.problem((0, 1), [0, 1.1], [2, 0], consistent="project", fixed=["u"])
    short = MechanicalSystem([1, 9], lambda t, q, v: [0, 0], lambda t, q: q[1] - q[0] - 1, labels=[*"ab"])
    with pytest.raises(ValueError, match="the 2 components of q and then the 2 of v"):
        short.problem((0, 1), [0, 1.1], [2, 0], consistent="project")
    with pytest.raises(ValueError, match='give consistent="project" too'):
        rod.problem((0, 1), [0, 1], [2, 2], fixed=["a"])


def test_projection_on_a_curve_gives_its_nearest_point():
    ellipse = swing(lambda t, q: q[0] ** 2 / 4 + q[1] ** 2 - 1)
    with pytest.warns(UserWarning, match="moved onto the constraints"):
        q = ellipse.problem((0, 1), [1.0, 1.5], [0, 0], consistent="project").y0[:2]
    assert abs(q[0] ** 2 / 4 + q[1] ** 2 - 1) < 1e-14
    normal, offset = np.array([q[0] / 2, 2 * q[1]]), np.array([1.0, 1.5]) - q
    assert abs(normal[0] * offset[1] - normal[1] * offset[0]) < 1e-10


# ----------------------------------------------------------------------------------------------------------------------
# Redundancy and singular positions


def door(t, q):
    """A plane body (x, y, angle) hinged at a point, its equations given twice in other words."""
    x, y, a = q
    return np.array([x - np.cos(a), y - np.sin(a), (x - np.cos(a)) + 2 * (y - np.sin(a)), x**2 + y**2 - 1])


def test_redundant_constraints_are_left_out_with_one_warning_and_least_multipliers():
    def weight(t, q, v):
        return [0, -1, 0]

    system = MechanicalSystem([1, 1, 1], weight, door)
    with pytest.warns(UserWarning, match="redundant constraints are left out: constraint 3, constraint 4") as caught:
        problem = system.problem((0, 3), [1, 0, 0], [0, 0, 0])
    assert len(caught) == 1
    sol = problem.solve("ode45", rtol=1e-7, atol=1e-9)
    assert sol.success
    assert np.abs(door(0, sol.y[:3])).max() < 1e-14
    alone = MechanicalSystem([1, 1, 1], weight, lambda t, q: door(t, q)[:2])
    same = alone.problem((0, 3), [1, 0, 0], [0, 0, 0]).solve("ode45", rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(sol.y[:, -1], same.y[:, -1], atol=1e-9)
    np.testing.assert_allclose(system.reactions(sol), alone.reactions(sol), atol=1e-7)
    norms = np.linalg.norm(system.multipliers(sol), axis=0)
    assert (norms < np.linalg.norm(alone.multipliers(sol), axis=0)).all()


def test_a_singular_position_at_the_start_does_not_remove_a_constraint():
    """There Φ has a rank less: of two rows one depends on the other, at that point alone."""

    def rows(t, q):
        return np.array([q[0] ** 2 + q[1] ** 2 + q[2] ** 2 - 1, q[2] + q[1] ** 2])

    system = MechanicalSystem([1, 1, 1], lambda t, q, v: [0, 0, 0], rows)
    problem = system.problem((0, 1), [1, 0, 0], [0, 0.3, 0])
    assert [len(one.names) for one in problem.invariants] == [2, 2]
    assert problem.solve(rtol=1e-6, atol=1e-8).success


def test_a_singular_position_on_the_way_is_passed_or_ends_the_run_there():
    """A slider crank with equal links: at a = b = π/2 it can go on in two ways, and Φ vanishes."""

    def crank(t, q):
        return np.sin(q[0]) - np.sin(q[1])

    system = MechanicalSystem([1, 1], lambda t, q, v: [0, 0], crank)
    sol = system.problem((0, 3), [0, 0], [1, 1]).solve("ode45", rtol=1e-6, atol=1e-8)
    assert np.abs(crank(0, sol.y[:2])).max() < 1e-12
    assert sol.success or (sol.status == -1 and "at t = 1.5" in sol.message)


# ----------------------------------------------------------------------------------------------------------------------
# Bad input


BAD = {
    "contradiction": (
        iv.InvariantError,
        "constraint [12] is .*contradict",
        {"constraints": lambda t, q: [q[0] ** 2 + q[1] ** 2 - 1, q[0] ** 2 + q[1] ** 2 - 4]},
    ),
    "constant": (
        iv.InvariantError,
        "constraint 2 is 1 at t = 0.0, and changing q does not affect it: either it does not depend on q",
        {"constraints": lambda t, q: [q[0] - 1, 1 + 0 * q[0]]},
    ),
    "of time": (
        iv.InvariantError,
        "constraint 2 changes with t, at the rate 1 at t = 0.0, and no velocity changes that: it does not depend on q",
        {"constraints": lambda t, q: [q[0] ** 2 + q[1] ** 2 - 1, t + 0 * q[0]]},
    ),
    "singular position": (
        iv.InvariantError,
        "constraint 1 is -1 at .* or q0 is a singular position of it",
        {"constraints": lambda t, q: (q[0] - 1) ** 2 + q[1] ** 2 - 1},
    ),
    "contradiction of values": (
        iv.InvariantError,
        "constraint [12] is .*contradict",
        {"constraints": lambda t, q: [q[0] - q[1] ** 2, q[0] - q[1] ** 2 - 1]},
    ),
    "no positions": (ValueError, "constraint 2 does not depend on q", {"constraints": lambda t, q: [q[0] - 1, 0 * t]}),
    "square of v": (
        ValueError,
        "velocity constraint 1 is not linear in v",
        {"velocity_constraints": lambda t, q, v: v[0] ** 2 - v[1]},
    ),
    "no mass": (ValueError, "not positive definite", {"mass": [1, 0]}),
    "mass of another size": (ValueError, r"mass must have shape \(2,\) or \(2, 2\)", {"mass": [1, 1, 1]}),
    "skew mass": (ValueError, "symmetric", {"mass": [[1, 0.5], [0, 1]]}),
    "force of another size": (
        ValueError,
        r"force\(t, q, v\) returned shape \(3,\)",
        {"force": lambda t, q, v: [0, 0, 0]},
    ),
    "constraint of a matrix": (ValueError, r"constraints\(t, q\) must return", {"constraints": lambda t, q: np.eye(2)}),
    "constraint NaN": (ValueError, "not finite", {"constraints": lambda t, q: np.nan * q[0]}),
    "kinematics of another size": (ValueError, "kinematics", {"kinematics": lambda t, q, v: v[:1]}),
    "jacobian of another size": (
        ValueError,
        r"jacobian\(t, q\)",
        {"jacobian": lambda t, q: [1, 2, 3], "constraints": circle},
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_in_words(name):
    error, message, given = BAD[name]
    arguments = {"mass": [1, 1], "force": gravity} | given
    with pytest.raises(error, match=message):
        MechanicalSystem(**arguments).problem((0, 1), [1, 0], [0, 1])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"force": 3}, TypeError, "force"),
        ({"constraints": 3}, TypeError, "constraints"),
        ({"jacobian": lambda t, q: q}, ValueError, "constraints too"),
        ({"energy": "E"}, TypeError, "energy"),
        ({"mass": [1, np.nan]}, ValueError, "mass must hold finite"),
        ({"mass": lambda q: np.eye(2)}, TypeError, r"mass is called as M\(t, q\)"),
        ({"force": lambda t, q: q}, TypeError, r"Q\(t, q, v\), and force takes \(t, q\); args=\(a, b\) passes further"),
        ({"constraints": lambda t, q: q, "args": (3.0,)}, TypeError, r"and then with args = \(3.0,\), and constraints"),
        ({"energy": lambda t, y: 0.0}, TypeError, r"energy is called as E\(t, q, v\)"),
    ],
)
def test_what_is_no_function_is_refused_at_once(arguments, error, message):
    with pytest.raises(error, match=message):
        MechanicalSystem(**{"mass": [1, 1], "force": lambda t, q, v, *args: gravity(t, q, v)} | arguments)


def test_a_kink_that_the_motion_crosses_ends_it_there_and_says_so():
    """|x| + y = 1: at x = 0 the wire has a corner."""
    system = swing(lambda t, q: np.abs(q[0]) + q[1] - 1)
    with pytest.raises(iv.InvariantError) as found:
        system.problem((0, 3), [0.5, 0.5], [-1, 1]).solve("ode45", rtol=1e-6, atol=1e-8)
    sol = found.value.solution
    assert abs(sol.y[0, -1]) < 1e-3
    assert "not smooth there, like abs at 0" in sol.message


def test_lengths_of_q_and_v_must_agree():
    with pytest.raises(ValueError, match="the same length"):
        swing().problem((0, 1), [1, 0], [0])
    for option in ("consistent", "correction"):
        with pytest.raises(ValueError, match=option):
            swing().problem((0, 1), [1, 0], [0, 0], **{option: "maybe"})


def test_a_mass_is_needed_only_where_motion_is_free():
    """A weightless pulley between two masses on a rope: its equation of motion is a balance of forces."""
    system = MechanicalSystem([1, 3, 0], lambda t, q, v: [-1, -3, 0], lambda t, q: [q[0] + q[1], q[2] - q[0]])
    sol = system.problem((0, 2), [0, 0, 0], [0, 0, 0]).solve(rtol=1e-8)
    np.testing.assert_allclose(sol.y[2], sol.t**2 / 4, atol=1e-12)


def test_arguments_reach_every_function_and_can_be_changed():
    system = MechanicalSystem(
        lambda t, q, length: [1, 1],
        lambda t, q, v, length: [0, -1],
        lambda t, q, length: q[0] ** 2 + q[1] ** 2 - length**2,
        energy=lambda t, q, v, length: (v[0] ** 2 + v[1] ** 2) / 2 + q[1],
        args=(2.0,),
        labels=["x", "y", "u", "v"],
        name="swing",
    )
    problem = system.problem((0, 3), [2, 0], [0, 0])
    assert re.match("Problem\\('swing'", repr(problem))
    assert problem.labels == ["x", "y", "u", "v"]
    sol = problem.solve(rtol=1e-6)
    assert np.abs(np.hypot(sol.y[0], sol.y[1]) - 2).max() < 1e-14
    shorter = problem.replace(args=(1.0,), y0=[1, 0, 0, 0]).solve(rtol=1e-6)
    assert np.abs(np.hypot(shorter.y[0], shorter.y[1]) - 1).max() < 1e-14


# ----------------------------------------------------------------------------------------------------------------------
# Large systems


def links(t, q):
    """Lengths of the links of a chain that hangs at the origin, squared, less 1."""
    x, y = q[0::2], q[1::2]
    dx, dy = x.copy(), y.copy()
    dx[1:] -= x[:-1]
    dy[1:] -= y[:-1]
    return dx * dx + dy * dy - 1


def tangled(count):
    """Positions and velocities of a chain of links at random angles."""
    rng = np.random.default_rng(3)
    angle, rate = rng.normal(size=(2, count))
    q = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]), axis=0).ravel()
    v = np.cumsum(np.column_stack([-rate * np.sin(angle), rate * np.cos(angle)]), axis=0).ravel()
    return q, v


MASSES = {
    "diagonal": lambda n: np.ones(n),
    "sparse": lambda n: scipy.sparse.diags_array([np.full(n, 2.0), *np.full((2, n - 1), 0.5)], offsets=[0, 1, -1]),
    "function": lambda n: lambda t, q: np.diag(2 + np.sin(q)),
    "sparse function": lambda n: lambda t, q: scipy.sparse.diags_array(2 + np.sin(q)),
}  # fmt: skip


@pytest.mark.parametrize("mass", MASSES)
def test_a_chain_has_the_accelerations_of_dense_equations_of_motion(mass):
    count = 20
    q, v = tangled(count)
    n = len(q)
    weight = np.tile([0.0, -1.0], count)
    problem = MechanicalSystem(MASSES[mass](n), lambda t, q, v: weight, links).problem((0, 1), q, v)
    M = MASSES[mass](n)
    M = M(0, q) if callable(M) else M
    M = M.toarray() if hasattr(M, "toarray") else np.diag(M) if np.ndim(M) == 1 else M
    rows = np.array([links(0, q + 1e-30j * unit).imag / 1e-30 for unit in np.eye(n)]).T
    bend = 2 * (np.diff(v.reshape(-1, 2), axis=0, prepend=0) ** 2).sum(axis=1)
    whole = np.block([[M, -rows.T], [rows, np.zeros((count, count))]])
    expected = np.linalg.solve(whole, np.concatenate([weight, -bend]))[:n]
    np.testing.assert_allclose(problem.fun(0, problem.y0)[n:], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("sparse", [False, True])
def test_a_given_jacobian_of_a_chain_may_be_sparse(sparse):
    q, v = tangled(20)

    def jacobian(t, q):
        rows = np.array([links(t, q + 1e-30j * unit).imag / 1e-30 for unit in np.eye(len(q))]).T
        return scipy.sparse.csr_array(rows) if sparse else rows

    weight = np.tile([0.0, -1.0], 20)
    given, own = (
        MechanicalSystem(np.ones(40), lambda t, q, v: weight, links, jacobian=one).problem((0, 0.5), q, v)
        for one in (jacobian, None)
    )
    np.testing.assert_allclose(given.fun(0, given.y0), own.fun(0, own.y0), rtol=1e-10, atol=1e-10)
    assert given.solve(rtol=1e-5).success

    def band(t, q):
        """The rows of `links`."""
        apart = 2 * np.diff(q.reshape(-1, 2), axis=0, prepend=0.0)
        rows = np.arange(len(apart)).repeat(2)
        here, before = (rows, np.arange(len(q))), (rows[2:], np.arange(len(q) - 2))
        places = np.hstack([here, before])
        return scipy.sparse.csr_array((np.append(apart, -apart[1:]), tuple(places)), shape=(len(apart), len(q)))

    def most(count):
        """Bytes that Python needs for the problem of a chain."""
        tracemalloc.start()
        try:
            system = MechanicalSystem(np.ones(2 * count), lambda t, q, v: v, links, jacobian=band if sparse else None)
            system.problem((0, 1), np.outer(1 + np.arange(count), [1.0, 0.0]).ravel(), np.zeros(2 * count))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    most(60)  # imports
    assert most(600) < 2.5 * most(300)  # linear in their number


def test_a_mass_with_entries_that_were_not_there_at_the_start_is_whole():
    """M couples two masses from x > 0.5 on: a comparison hides that from whoever looks at the start."""
    q, v = tangled(20)

    def mass(t, q):
        M = np.eye(len(q))
        if t > 0.5:
            M[0, 5] = M[5, 0] = 0.5
        return M

    problem = MechanicalSystem(mass, lambda t, q, v: np.ones(len(q)), links).problem((0, 1), q, v)
    constant = MechanicalSystem(mass(1.0, q), lambda t, q, v: np.ones(len(q)), links).problem((0, 1), q, v)
    np.testing.assert_allclose(problem.fun(1.0, problem.y0), constant.fun(1.0, constant.y0), rtol=1e-10, atol=1e-10)
    # One that has them from the start keeps sparse factors where n is large, and is a metric where it is small.
    for bobs, kind in ((20, np.asarray), (3, scipy.sparse.csc_array)):
        q, v = tangled(bobs)
        always, constant = (
            MechanicalSystem(M, lambda t, q, v: np.ones(len(q)), links).problem((0, 1), q, v)
            for M in (lambda t, q, kind=kind: kind(mass(1.0, q)), mass(1.0, q))
        )
        sol, same = (one.solve("dop853", rtol=1e-3, keep="end") for one in (always, constant))
        assert bobs == 3 or sol.stats.mechanics["dense"] == 0
        np.testing.assert_allclose(sol.y, same.y, rtol=1e-9, atol=1e-9)


def test_multipliers_of_lengths_are_tensions() -> None:
    """In a hanging chain each rod carries the weights below it; the reactions of single rows add up to all."""
    n = 5
    masses = np.repeat(np.arange(1.0, n + 1), 2)

    def lengths(t, q):
        points = [np.zeros(2), *np.reshape(q, (n, 2))]
        return [np.sqrt((b - a) @ (b - a)) - 1 for a, b in pairwise(points)]

    weights = -9.81 * masses * np.tile([0, 1], n)
    chain = iv.MechanicalSystem(masses, lambda t, q, v: weights, lengths)
    hanging = np.ravel([[0, -1.0 - k] for k in range(n)])
    sol = chain.problem((0, 1), hanging, np.zeros(2 * n)).solve()
    below = 9.81 * np.cumsum(np.arange(1.0, n + 1)[::-1])[::-1]
    np.testing.assert_allclose(-chain.multipliers(sol), np.tile(below[:, None], len(sol.t)), rtol=1e-12)
    single = [chain.reactions(sol, constraints=[k]) for k in range(n)]
    np.testing.assert_allclose(sum(single), chain.reactions(sol), atol=1e-12)
    np.testing.assert_allclose(single[1][1], -below[1], rtol=1e-12)  # it pulls the first mass down
    np.testing.assert_allclose(single[1][3], below[1], rtol=1e-12)
    for wrong in ([n], [-1], [[0]]):
        with pytest.raises(ValueError, match="constraints must be rows from 0 to 4"):
            chain.reactions(sol, constraints=wrong)


UNDEFINED = {
    "force": {"force": lambda t, q, v: [np.sqrt(1 - t), 0.0]},
    "mass": {"mass": lambda t, q: np.eye(2) * np.sqrt(1 - t)},
    "constraints": {"constraints": lambda t, q: q @ q - 1 + 0 * np.sqrt(1 - t)},
    "kinematics": {"kinematics": lambda t, q, v: v + 0 * np.sqrt(1 - t)},
}


@pytest.mark.parametrize("name", UNDEFINED)
@pytest.mark.filterwarnings("ignore:invalid value", "ignore:divide by zero")
def test_the_function_that_is_not_finite_is_named(name):
    """From t = 1 on, or at the start; not fun, which the user did not write."""
    system = MechanicalSystem(**({"mass": np.eye(2), "force": gravity} | UNDEFINED[name]))
    for method in ("ode45", "radau"):
        message = system.problem((0, 3), [1, 0], [0, 0]).solve(method).message
        assert re.search(rf"y' \(by ({name}|MechanicalSystem)\)|Invariant constraint", message), message
        assert "fun" not in message
    driven = MechanicalSystem([1, 1], gravity, lambda t, q: [q @ q - 1, q[0] - t])  # it locks at x = 1
    locked = driven.problem((0, 3), [0, 1], [1, 0]).solve()
    assert locked.t_end == pytest.approx(1, abs=1e-6)
    assert re.search(r"\(v2\), .* dead or locking position", locked.message), locked.message
    assert "mass=" not in locked.message


def test_forces_at_times_are_those_of_the_continuous_solution():
    system = MechanicalSystem([1, 1], gravity, lambda t, q: np.sqrt(q @ q) - 1)
    sol = system.problem((0, 3), [1, 0], [0, 0]).solve(dense_output=True)
    np.testing.assert_array_equal(system.multipliers(sol, t=sol.t), system.multipliers(sol))
    assert system.reactions(sol, t=0.5).shape == (2, 1)
    coarse = system.problem((0, 3), [1, 0], [0, 0]).solve(t_eval=[0.0, 1.0, 3.0])
    np.testing.assert_array_equal(system.multipliers(coarse, t=[3.0, 0.0]), system.multipliers(coarse)[:, [2, 0]])
    with pytest.raises(ValueError, match="t needs a continuous solution"):
        system.multipliers(system.problem((0, 3), [1, 0], [0, 0]).solve(), t=0.5)
    with pytest.raises(TypeError, match="sol must be a solution"):
        system.multipliers(sol.sol(0.5))


def test_forces_of_joints_are_those_of_the_run_alone():
    """Extrapolated states have no forces: times outside the run are an error, as for ``sol(t, extrapolate=False)``."""
    system = iv.MechanicalSystem([1, 1], lambda t, q, v: [0, -1], lambda t, q: [np.hypot(*q) - 1])
    sol = system.problem((0, 1), [1, 0], [0, 0]).solve("dop853", dense_output=True)
    for compute in (system.multipliers, system.reactions):
        assert np.allclose(compute(sol, t=[0.0, 1.0]), compute(sol)[:, [0, -1]], atol=1e-12)
        for t in (-1e-3, 1.001, [0.5, 2.0]):
            with pytest.raises(ValueError, match="outside the solution's interval, 0 to 1: extend the run"):
                compute(sol, t=t)


def test_a_dissipated_energy_beside_constraints_has_a_level_of_its_own():
    arm = MechanicalSystem([1, 1], lambda t, q, v: [0, -1] - 0.1 * v, circle)
    problem = arm.problem((0, 3), [1, 0], [0, 0])

    def energy(t, y):
        return y[2:] @ y[2:] / 2 + y[1]

    with pytest.raises(ValueError, match="or different levels, as level=2 to energy"):
        problem.replace(invariants=[*problem.invariants, iv.Dissipated(energy)]).solve()
    assert problem.replace(invariants=[*problem.invariants, iv.Dissipated(energy, level=2)]).solve().success
