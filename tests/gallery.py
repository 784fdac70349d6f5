"""More problems with several invariants, for the tests that are about invariants only."""

from __future__ import annotations

import numpy as np

from problems import PROBLEMS, TestProblem, kepler, kepler_jacobian, pendulum


def runge_lenz(t, y):
    """Energy, angular momentum and both components of the Runge-Lenz vector: one too many."""
    x, z, u, v = y
    r, moment = (x * x + z * z) ** 0.5, x * v - z * u
    return [(u * u + v * v) / 2 - 1 / r, moment, v * moment - x / r, -u * moment - z / r]


def runge_lenz_jacobian(t, y):
    x, z, u, v = y
    r = np.hypot(x, z)
    moment = x * v - z * u
    return [
        *kepler_jacobian(t, y),
        [v * v - z * z / r**3, -u * v + x * z / r**3, -v * z, moment + v * x],
        [-u * v + x * z / r**3, u * u - x * x / r**3, -moment + u * z, -u * x],
    ]


def pendulum_with_energy(t, y):
    x, z, u, v = y
    return [x * x + z * z - 1, x * u + z * v, (u * u + v * v) / 2 + z]


def pendulum_with_energy_jacobian(t, y):
    x, z, u, v = y
    return [[2 * x, 2 * z, 0, 0], [u, v, x, z], [0, 1, u, v]]


def double_pendulum(t, y):
    """Two unit masses on rods of length 1 in Cartesian coordinates: r1, r2, v1, v2."""
    r1, r2, v1, v2 = y.reshape(4, 2)
    d, w = r2 - r1, v2 - v1
    # tensions a, b: r1'' = −a r1 + b d − e, r2'' = −b d − e keep |r1| and |d|
    matrix = np.array([[r1 @ r1, -(r1 @ d)], [-(r1 @ d), 2 * (d @ d)]])
    a, b = np.linalg.solve(matrix, [v1 @ v1 - r1[1], w @ w])
    down = np.array([0.0, 1.0])
    return np.concatenate([v1, v2, -a * r1 + b * d - down, -b * d - down])


def double_pendulum_invariants(t, y):
    r1, r2, v1, v2 = y.reshape(4, 2)
    d, w = r2 - r1, v2 - v1
    return [r1 @ r1 - 1, d @ d - 1, r1 @ v1, d @ w, (v1 @ v1 + v2 @ v2) / 2 + r1[1] + r2[1]]


def double_pendulum_jacobian(t, y):
    r1, r2, v1, v2 = y.reshape(4, 2)
    d, w, o, up = r2 - r1, v2 - v1, np.zeros(2), np.array([0.0, 1.0])
    rows = [(2 * r1, o, o, o), (-2 * d, 2 * d, o, o), (v1, o, r1, o), (-w, w, -d, d), (up, up, v1, v2)]
    return np.array([np.concatenate(row) for row in rows])


INERTIA = np.array([1.0, 2.0, 3.5])


def attitude(t, y):
    """A free rigid body: quaternion (w, x, y, z) and angular velocity in the body's frame."""
    w, x, z, s = y[:4]
    a, b, c = y[4:]
    turn = [-x * a - z * b - s * c, w * a + z * c - s * b, w * b + s * a - x * c, w * c + x * b - z * a]
    spin = [
        (INERTIA[1] - INERTIA[2]) / INERTIA[0] * b * c,
        (INERTIA[2] - INERTIA[0]) / INERTIA[1] * c * a,
        (INERTIA[0] - INERTIA[1]) / INERTIA[2] * a * b,
    ]
    return np.array([*(0.5 * np.array(turn)), *spin])


def attitude_invariants(t, y):
    """The norm of the quaternion, the energy, the angular momentum in space."""
    w, x, z, s = y[:4]
    L = INERTIA * y[4:]
    space = [
        (w * w + x * x - z * z - s * s) * L[0] + 2 * (x * z - w * s) * L[1] + 2 * (x * s + w * z) * L[2],
        2 * (x * z + w * s) * L[0] + (w * w - x * x + z * z - s * s) * L[1] + 2 * (z * s - w * x) * L[2],
        2 * (x * s - w * z) * L[0] + 2 * (z * s + w * x) * L[1] + (w * w - x * x - z * z + s * s) * L[2],
    ]
    return [w * w + x * x + z * z + s * s, (L * y[4:]).sum() / 2, *space]


def attitude_jacobian(t, y):
    w, x, z, s = y[:4]
    a, b, c = L = INERTIA * y[4:]
    rotation = np.array([
        [w * w + x * x - z * z - s * s, 2 * (x * z - w * s), 2 * (x * s + w * z)],
        [2 * (x * z + w * s), w * w - x * x + z * z - s * s, 2 * (z * s - w * x)],
        [2 * (x * s - w * z), 2 * (z * s + w * x), w * w - x * x - z * z + s * s],
    ])  # fmt: skip
    by_quaternion = 2 * np.array([
        [w * a - s * b + z * c, x * a + z * b + s * c, -z * a + x * b + w * c, -s * a - w * b + x * c],
        [s * a + w * b - x * c, z * a - x * b - w * c, x * a + z * b + s * c, w * a - s * b + z * c],
        [-z * a + x * b + w * c, s * a + w * b - x * c, -w * a + s * b - z * c, x * a + z * b + s * c],
    ])  # fmt: skip
    J = np.zeros((5, 7))
    J[0, :4] = 2 * y[:4]
    J[1, 4:] = L
    J[2:, :4] = by_quaternion
    J[2:, 4:] = rotation * INERTIA
    return J


MASSES = np.array([1.0, 0.4, 0.3, 0.2, 0.1])


def five_bodies(t, y):
    """Five masses that attract each other: positions (5, 3), then velocities."""
    r, v = y.reshape(2, 5, 3)
    d = r[None, :, :] - r[:, None, :]
    size = (d**2).sum(axis=2) + np.eye(5)
    pull = (MASSES[None, :, None] * d / size[:, :, None] ** 1.5).sum(axis=1)
    return np.concatenate([v.ravel(), pull.ravel()])


def ten_integrals(t, y):
    """Energy, momentum, angular momentum, and the centre of mass where it was at t = 0."""
    r, v = y.reshape(2, 5, 3)
    m = MASSES[:, None]
    energy = (m * v * v).sum() / 2
    for i in range(5):
        for j in range(i):
            energy = energy - MASSES[i] * MASSES[j] / ((r[i] - r[j]) ** 2).sum() ** 0.5
    momentum = (m * v).sum(axis=0)
    return np.concatenate([[energy], momentum, np.cross(r, m * v).sum(axis=0), (m * r).sum(axis=0) - t * momentum])


def ten_integrals_jacobian(t, y):
    r, v = y.reshape(2, 5, 3)
    J = np.zeros((10, 2, 5, 3))
    for i in range(5):
        for j in range(5):
            if i != j:
                d = r[i] - r[j]
                J[0, 0, i] += MASSES[i] * MASSES[j] * d / (d @ d) ** 1.5
        J[0, 1, i] = MASSES[i] * v[i]
        for k in range(3):
            J[1 + k, 1, i, k] = MASSES[i]
            J[7 + k, 0, i, k] = MASSES[i]
            J[7 + k, 1, i, k] = -t * MASSES[i]
            e = np.eye(3)[k]
            J[4:7, 0, i, k] = np.cross(e, MASSES[i] * v[i])
            J[4:7, 1, i, k] = np.cross(r[i], MASSES[i] * e)
    return J.reshape(10, 30)


def _five_bodies_start() -> list[float]:
    radius, angle = np.array([0.0, 1.0, 1.7, 2.6, 3.8]), np.array([0.0, 0.3, 2.0, 3.9, 5.0])
    r = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.1 * radius], axis=1)
    speed = np.where(radius > 0, np.sqrt(1.5 / np.maximum(radius, 1)), 0)
    v = np.stack([-speed * np.sin(angle), speed * np.cos(angle), 0 * radius], axis=1)
    v -= (MASSES[:, None] * v).sum(axis=0) / MASSES.sum()
    return [*r.ravel(), *v.ravel()]


GALLERY = {name: PROBLEMS[name] for name in ("Lotka-Volterra", "three-body", "Henon-Heiles", "rigid body")} | {
    problem.name: problem
    for problem in (
        TestProblem("Runge-Lenz", kepler, (0, 20), [0.4, 0, 0, 2], runge_lenz, runge_lenz_jacobian),
        TestProblem(
            "pendulum with energy", pendulum, (0, 10), [1, 0, 0, 0], pendulum_with_energy,
            pendulum_with_energy_jacobian, value=0,
        ),
        TestProblem(
            "double pendulum", double_pendulum, (0, 5), [1, 0, 2, 0, 0, 0, 0, 0.5], double_pendulum_invariants,
            double_pendulum_jacobian,
        ),
        TestProblem(
            "attitude", attitude, (0, 10), [0.8, 0.36, 0.48, 0, 0.3, 1.2, -0.5], attitude_invariants, attitude_jacobian
        ),
        TestProblem("five bodies", five_bodies, (0, 3), _five_bodies_start(), ten_integrals, ten_integrals_jacobian),
    )
}  # fmt: skip

#: What is redundant, and is left out with a warning.
REDUNDANT = {"Runge-Lenz"}
