"""Sensitivities of constrained mechanics: they are those of the motion, on the tangents of positions and velocities."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt, families
from gradients import both_ways

TIGHT = {"rtol": 1e-10, "atol": 1e-12}
ANGLE = 1.2


def weight(t, q, v, length, gravity):
    return [0, -gravity]


def rod(t, q, length, gravity):
    return q[0] ** 2 + q[1] ** 2 - length**2


def energy(t, q, v, length, gravity):
    return (v[0] ** 2 + v[1] ** 2) / 2 + gravity * q[1]


def pendulum(length=1.0, gravity=9.81, **functions):
    """At rest at an angle."""
    given = {"force": weight, "constraints": rod, "energy": energy} | functions
    system = iv.MechanicalSystem([1.0, 1.0], **given, args=(length, gravity))
    return system.problem((0, 1), [length * np.sin(ANGLE), -length * np.cos(ANGLE)], [0.0, 0.0])


def of_angle(rtol=1e-12):
    """∂(q, v)/∂(length, gravity) at the end, by the angle as the only coordinate."""
    problem = iv.Problem(
        lambda t, y, length, g: [y[1], -g / length * np.sin(y[0])], (0, 1), [ANGLE, 0.0], args=(1, 9.81)
    )
    sol = problem.replace(sensitivities=True).solve("dop853", rtol=rtol, atol=rtol / 100)
    (a, w), S = sol.y[:, -1], sol.sensitivities[:, :, -1]
    sin, cos = np.sin(a), np.cos(a)
    by_state = np.array([[cos, 0], [sin, 0], [-w * sin, cos], [w * cos, sin]])
    by_length = np.array([sin, -cos, w * cos, w * sin])
    return by_state @ S + np.outer(by_length, [1, 0])


START = iv.Sensitivities(["length", "gravity"], dy0dp=[[np.sin(ANGLE), 0], [-np.cos(ANGLE), 0], [0, 0], [0, 0]])


@families
def test_a_pendulum_has_those_of_its_angle(method):
    """Up to a hundred times the tolerance, as the solution."""
    sol = pendulum().replace(sensitivities=START).solve(method, rtol=1e-6, atol=1e-8)
    assert sol.stats.sensitivities == "traced"
    assert sol.sensitivity_names == ["length", "gravity"]
    np.testing.assert_allclose(sol.sensitivities[:, :, -1], of_angle(), atol=1e-4 * np.abs(of_angle()).max())


@dealt(method=FAMILIES, correction=["levels", "joint"])
def test_they_are_tangent_to_positions_velocities_and_energy(method, correction):
    """q·S_q = ∂(length²)/∂p / 2, v·S_q + q·S_v = 0, v·S_v + g S_y = what it was at the start − y ∂g/∂p, to roundoff."""
    problem = pendulum().replace(sensitivities=START)
    if correction == "joint":
        q0, v0 = np.split(problem.y0, 2)
        system = iv.MechanicalSystem([1.0, 1.0], weight, rod, energy=energy, args=(1.0, 9.81))
        problem = system.problem((0, 1), q0, v0, correction=correction).replace(sensitivities=START)
    sol = problem.solve(method, rtol=1e-5, atol=1e-7, dense_output=True)
    times = np.sort([*sol.t, *np.random.default_rng(29).uniform(0, 1, 20)])
    (x, y, vx, vy), S = sol.sol(times), sol.sol.sensitivities(times)
    of_position = x * S[0] + y * S[1] - np.array([[1.0], [0.0]])
    of_velocity = vx * S[0] + vy * S[1] + x * S[2] + y * S[3]
    of_energy = vx * S[2] + vy * S[3] + 9.81 * S[1] + np.outer([0, 1], y)
    size = np.abs(S).max()
    assert np.abs(of_position).max() < 1e-13 * size
    assert np.abs(of_velocity).max() < 1e-12 * size * np.abs([vx, vy]).max()
    assert np.abs(of_energy - of_energy[:, :1]).max() < 1e-11 * size


def skate(t, q, v, slope, mass):
    return v[0] * np.sin(q[2]) - v[1] * np.cos(q[2])


def turn(t, q, v, first):
    """q' of a unit quaternion."""
    w, x, y, z = q
    a, b, c = v
    return np.array([-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]) / 2


def spinning(t, q, v, first):
    inertia = np.array([first, 2.0, 3.0])
    return np.cross(inertia * v, v)


def level(t, q, first):
    w, x, y, z = q
    return 2 * (x * z - w * y)


def door(t, q, length):
    """Hinged at a point, which is said twice."""
    x, y, a = q
    return np.array([x - length * np.cos(a), y - length * np.sin(a), x**2 + y**2 - length**2])


def untraced(t, q, v, length, gravity):
    try:  # which tracing refuses
        return [0, -gravity]
    finally:
        pass


def in_place(t, q, v, out, length, gravity):
    out[0], out[1] = 0, -gravity


#: (arguments of MechanicalSystem, q0, v0), and how the derivatives of the accelerations are formed.
SYSTEMS = {
    "a blade, which is not holonomic": (
        {
            "mass": lambda t, q, slope, mass: [mass, mass, 1.0],
            "force": lambda t, q, v, slope, mass: [mass * np.sin(slope), 0, 0],
            "velocity_constraints": skate,
            "args": (0.5, 2.0),
        },
        ([0, 0, 0], [0, 0, 1.0]),
        "traced",
    ),
    "a body whose positions are a quaternion": (
        {
            "mass": lambda t, q, first: [first, 2.0, 3.0],
            "force": spinning,
            "constraints": level,
            "kinematics": turn,
            "args": (1.3,),
        },
        ([1, 0, 0, 0], [1, 0, 0.5]),
        "traced",
    ),
    "a cart with a full mass matrix": (
        {
            "mass": lambda t, q, a, m: [[m + 1, a * np.cos(q[1])], [a * np.cos(q[1]), m]],
            "force": lambda t, q, v, a, m: [a * np.sin(q[1]) * v[1] ** 2, -m * np.sin(q[1])],
            "args": (0.7, 2.0),
        },
        ([0, 1.0], [0, 0]),
        "traced",
    ),
    "a bob on a rod of changing length": (
        {
            "mass": [1.0, 2.0],
            "force": weight,
            "constraints": lambda t, q, length, g: q[0] ** 2 + q[1] ** 2 - (length + 0.1 * np.sin(t) ** 2) ** 2,
            "args": (1.0, 9.81),
        },
        ([1, 0], [0, 0.1]),
        "traced",
    ),
    "a redundant constraint": (
        {"mass": [1.0, 1.0, 1.0], "force": lambda t, q, v, length: [0, -1, 0], "constraints": door, "args": (1.0,)},
        ([1, 0, 0], [0, 0, 0]),
        "traced",
    ),
    "compiled functions": (
        {
            "mass": [1.0, 1.0],
            "force": iv.compile(in_place, inplace=True),
            "constraints": iv.compile(rod, by="trace"),
            "args": (1.0, 9.81),
        },
        ([1, 0], [0, 0.1]),
        "traced",
    ),
    "a force that cannot be traced": (
        {"mass": [1.0, 1.0], "force": untraced, "constraints": rod, "args": (1.0, 9.81)},
        ([1, 0], [0, 0.1]),
        "fun: differences; invariant constraint 1: traced; invariant rate of constraint 1: traced",
    ),
}


# What these systems and starts are made for.
@pytest.mark.filterwarnings("ignore:redundant constraints:UserWarning", "ignore:the start was moved:UserWarning")
# Of systems that cannot be traced.
@pytest.mark.filterwarnings("ignore:sensitivities. the derivatives of fun:invariode.AccuracyWarning")
@pytest.mark.parametrize("name", SYSTEMS)
def test_they_are_those_of_neighbouring_motions(name):
    """To each argument, differences of tight runs from starts that are made consistent: good to 1e-9."""
    given, start, how = SYSTEMS[name]
    args = given["args"]

    def end(values):
        problem = iv.MechanicalSystem(**{**given, "args": values}).problem((0, 1), *start, consistent="project")
        return problem.solve("dop853", rtol=1e-12, atol=1e-14).y[:, -1]

    problem = iv.MechanicalSystem(**given).problem((0, 1), *start).replace(sensitivities=True)
    sol = problem.solve("dop853", **TIGHT)
    assert sol.stats.sensitivities == how
    for j, value in enumerate(args):
        h = 1e-5 * value
        ends = [end((*args[:j], value + side * h, *args[j + 1 :])) for side in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(sol.sensitivities[:, j, -1], expected, atol=2e-9 * (1 + np.abs(expected).max()))


def links(t, q, length, gravity):
    ends = np.concatenate([np.zeros(2), q]).reshape(-1, 2)
    return (np.diff(ends, axis=0) ** 2).sum(axis=1) - length**2


def test_large_mechanisms_have_differences():
    """The core's accelerations are differenced: a graph with a linear system of this size would take long to compile.
    From rest, q is a function of g t², so that ∂q/∂g = t v / (2 g)."""
    count, gravity, end = 13, 9.81, 0.3
    chain = iv.MechanicalSystem(
        np.ones(2 * count),
        lambda t, q, v, length, gravity: np.tile([0.0, -1.0], count) * gravity,
        links,
        args=(1.0, gravity),
    )
    start = np.stack([np.arange(1, count + 1), np.zeros(count)], axis=1).ravel()
    problem = chain.problem((0, end), start, np.zeros(2 * count)).replace(sensitivities=["gravity"])
    with pytest.warns(iv.AccuracyWarning, match="the derivatives of fun are differences"):
        sol = problem.solve("dop853", rtol=1e-9, atol=1e-11)
    assert sol.stats.sensitivities.startswith("fun: differences")
    v = sol.y[2 * count :, -1]
    np.testing.assert_allclose(sol.sensitivities[: 2 * count, 0, -1], end * v / (2 * gravity), atol=1e-8)


def arm(gravity, restitution):
    """Two links whose tip bounces off a wall: the blow alone breaks the joints, which react."""

    def joints(t, q, g, restitution):
        return np.array([q[0] ** 2 + q[1] ** 2 - 1, (q[2] - q[0]) ** 2 + (q[3] - q[1]) ** 2 - 1])

    def bounce(t, y, g, restitution):
        return np.concatenate([y[:6], [-restitution * y[6]], y[7:]])

    wall = iv.Event(lambda t, y, g, restitution: y[2] - 0.5, direction=1, action=bounce)
    system = iv.MechanicalSystem(
        np.ones(4), lambda t, q, v, g, restitution: [0, -g, 0, -g], joints, args=(gravity, restitution)
    )
    return system.problem((0, 2.8), [-1, 0, -2, 0], [0, 0, 0, 0]).replace(events=wall)


def test_what_joints_do_after_a_blow_is_differentiated():
    """The corrections of velocities are as large as these: differences of tight runs, good to 1e-8."""
    sol = arm(1.0, 0.5).replace(sensitivities=True).solve("dop853", **TIGHT)
    assert len(sol.t_events[0]) == 1
    for j, h in enumerate(np.eye(2) * 1e-5):
        up, down = (arm(*([1.0, 0.5] + side * h)).solve("dop853", rtol=1e-12, atol=1e-13).y[:, -1] for side in (1, -1))
        expected = (up - down) / 2e-5
        np.testing.assert_allclose(sol.sensitivities[:, j, -1], expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["impact", "start"])
def test_gradients_are_the_same_backwards(name):
    """Through a blow, and from starts that are moved onto the constraints level by level."""
    problem = arm(1.0, 0.5).replace(sensitivities=True)
    if name == "start":
        problem = pendulum().replace(sensitivities=["length", "gravity", "y0"])
    both_ways(problem.solve("dop853", **TIGHT, dense_output=True), rtol=1e-8)


def test_a_length_is_fitted():
    """From exact data: what is left is the error of the runs."""
    t = np.linspace(0.1, 1, 12)
    data = pendulum(gravity=9.5).solve("dop853", t_eval=t, **TIGHT).y[:1]
    found = iv.fit(pendulum(), t, data, {"gravity": (8, 11)}, observe=[0], sigma=1e-6, method="dop853", **TIGHT)
    assert found.parameters["gravity"] == pytest.approx(9.5, abs=1e-6)
