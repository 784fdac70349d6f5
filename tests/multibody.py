"""Mechanisms of the multibody benchmark library (IFToMM), and their motion in minimal coordinates, as data."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import invariode as iv
from invariode._mechanics.system import MechanicalSystem

Array = NDArray[np.float64]

GRAVITY = 9.81


class Benchmark(NamedTuple):
    """A mechanism with its start, and the same motion without constraints."""

    system: MechanicalSystem
    q0: Array
    v0: Array
    slope: Callable[[float, Array], Array] | None = None  # in minimal coordinates x
    x0: Array = np.zeros(0)
    positions: Callable[[Array], Array] | None = None  # of some of q, from x; they stand first in q
    height: Callable[[Array], float] | None = None  # of the centre of a rolling body, of its quaternion

    def problem(self, tf: float, correction: str = "levels") -> iv.Problem:
        return self.system.problem((0.0, tf), self.q0, self.v0, correction=correction)

    def reference(self, tf: float, method: str = "DOP853") -> Array:
        """The first positions at tf, by SciPy in minimal coordinates."""
        from scipy.integrate import solve_ivp

        found = solve_ivp(self.slope, (0.0, tf), self.x0, method, rtol=1e-12, atol=1e-13)
        return self.positions(found.y[:, -1])


def rods(ends: list[tuple[int, int]], points: int, dimension: int, masses: list[float]) -> Array:
    """The mass matrix of uniform thin rods between points; an index beyond the points: a fixed one."""
    mass = np.zeros((points, points))
    for (i, j), m in zip(ends, masses, strict=True):
        for a, b in ((i, i), (j, j), (i, j), (j, i)):
            if a < points and b < points:
                mass[a, b] += m / (3 if a == b else 6)
    return np.kron(mass, np.eye(dimension))


def four_bars(loops: int) -> Benchmark:
    """N square loops of bars of length 1 and mass 1 side by side, upright, the tops moving with velocity 1.

    All bars line up where they are horizontal: there the mechanism could go on in 2^N ways.
    """
    tops = loops + 1
    bars = [(i, tops) for i in range(tops)] + [(i, i + 1) for i in range(loops)]
    mass = rods(bars, tops, 2, [1.0] * len(bars))
    weight = np.zeros((tops, 2))
    weight[:, 1] = -GRAVITY * (np.array([i in bar for i in range(tops) for bar in bars]).reshape(tops, -1).sum(1) / 2)

    def lengths(t: float, q: Array) -> Array:
        p = q.reshape(-1, 2)
        rockers = p - np.column_stack([np.arange(tops), np.zeros(tops)])
        couplers = p[1:] - p[:-1]
        return np.concatenate([(rockers**2).sum(axis=1), (couplers**2).sum(axis=1)]) - 1

    def energy(t: float, q: Array, v: Array) -> float:
        return v @ mass @ v / 2 - weight.ravel() @ q

    system = MechanicalSystem(mass, lambda t, q, v: weight.ravel(), lengths, energy=energy, name=f"{loops} four-bars")
    q0 = np.column_stack([np.arange(tops), np.ones(tops)]).ravel()
    inertia, moment = tops / 3 + loops, GRAVITY * (tops / 2 + loops)

    def places(x: Array) -> Array:
        return np.column_stack([np.arange(tops) + np.sin(x[0]), np.full(tops, np.cos(x[0]))]).ravel()

    return Benchmark(
        system,
        q0,
        np.tile([1.0, 0.0], tops),
        lambda t, x: np.array([x[1], moment / inertia * np.sin(x[0])]),
        np.array([0.0, 1.0]),
        places,
    )


def bricard() -> Benchmark:
    """Bricard's loop of five rods and the ground, by six revolute joints: rigid by count, and yet it moves.

    Points and axes of the joints are along the edges of a cube. One of the 24 constraints of 24 coordinates depends on
    the others.
    """
    cube = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], dtype=float)
    edges = np.roll(cube, -1, axis=0) - cube
    axes = np.cross(np.roll(edges, 1, axis=0), edges)
    free = 4
    mass = np.zeros((24, 24))
    mass[:12, :12] = rods([(4, 0), (0, 1), (1, 2), (2, 3), (3, 4)], free, 3, [1.0] * 5)
    weight = np.zeros(24)
    weight[1:12:3] = -GRAVITY

    def whole(q: Array) -> tuple[Array, Array]:
        p, u = q[:12].reshape(-1, 3), q[12:].reshape(-1, 3)
        return np.concatenate([cube[1:2], p, cube[:1]]), np.concatenate([axes[1:2], u, axes[:1]])

    def joints(t: float, q: Array) -> Array:
        p, u = whole(q)
        d = p[1:] - p[:-1]
        parts = [d * d, d * u[:-1], d * u[1:], u[:-1] * u[1:], u[1:-1] ** 2]
        sums = [part.sum(axis=1) for part in parts]
        sums[0], sums[-1] = sums[0] - 1, sums[-1] - 1
        return np.concatenate(sums)

    def energy(t: float, q: Array, v: Array) -> float:
        return v @ mass @ v / 2 - weight @ q

    system = MechanicalSystem(mass, lambda t, q, v: weight, joints, energy=energy, name="Bricard")
    q0 = np.concatenate([cube[2:], axes[2:]]).ravel()
    return Benchmark(system, q0, np.zeros(24))


def governor() -> Benchmark:
    """A flyball governor: two rods with balls on a rotating axis, and a slider held by stiff springs and dampers.

    Points of the balls p, of the rotating frame w, hinge axes u, height of the slider. That the axes of the hinges are
    parallel to w is written as two cross products: six rows, of which two follow from the others.
    """
    ball, slider, turning, stiffness, damping, rest = 5.0, 3.0, 0.5, 8e5, 4e4, 0.5
    n = 2 * 3 + 3 + 2 * 3 + 1
    mass = np.concatenate([np.full(6, ball), np.full(3, turning), np.zeros(6), [slider]])

    def parts(q: Array) -> tuple[Array, Array, Array, Array]:
        return q[:6].reshape(2, 3), q[6:9], q[9:15].reshape(2, 3), q[15]

    def force(t: float, q: Array, v: Array) -> Array:
        p, _, _, s = parts(q)
        dp, _, _, ds = parts(v)
        out = np.zeros(n)
        out[[2, 5]] = -GRAVITY * ball
        out[15] = -GRAVITY * slider
        down = np.array([0.0, 0.0, 1.0])
        for i in range(2):
            link, rate = p[i] / 2 - s * down, dp[i] / 2 - ds * down
            length = np.sqrt(link @ link)
            pull = (stiffness * (length - rest) + damping * (link @ rate) / length) / length
            out[3 * i : 3 * i + 3] -= pull * link / 2
            out[15] += pull * link[2]
        return out

    def joints(t: float, q: Array) -> Array:
        p, w, u, _ = parts(q)
        return np.concatenate(
            [
                (p * p).sum(axis=1) - 1,
                (p * u).sum(axis=1),
                [w @ w - 1, w[2]],
                np.cross(u, w).ravel(),
                (u * u).sum(axis=1) - 1,
            ]
        )

    system = MechanicalSystem(mass, force, joints, name="governor")
    tilt, spin = np.pi / 6, 2 * np.pi
    out, up = np.sin(tilt), -np.cos(tilt)
    q0 = np.concatenate([[0, out, up], [0, -out, up], [-1, 0, 0], [-1, 0, 0], [-1, 0, 0], [up]])
    v0 = np.concatenate([[-spin * out, 0, 0], [spin * out, 0, 0], [0, -spin, 0], [0, -spin, 0], [0, -spin, 0], [0]])

    def slope(t: float, x: Array) -> Array:  # φ, α (of both rods), s
        _, tilt, s, spin, swing, speed = x
        sine, cosine = np.sin(tilt), np.cos(tilt)
        length = np.sqrt(0.25 + s * s + s * cosine)
        by_tilt, by_s = -s * sine / (2 * length), (2 * s + cosine) / (2 * length)
        pull = stiffness * (length - rest) + damping * (by_tilt * swing + by_s * speed)
        inertia = 2 * ball * sine**2 + turning
        turn = -4 * ball * sine * cosine * swing * spin / inertia
        bend = (2 * ball * (sine * cosine * spin**2 - GRAVITY * sine) - 2 * pull * by_tilt) / (2 * ball)
        return np.array([spin, swing, speed, turn, bend, -GRAVITY - 2 * pull * by_s / slider])

    def places(x: Array) -> Array:
        out = np.sin(x[1]) * np.array([np.cos(x[0]), np.sin(x[0])])
        return np.array([*out, -np.cos(x[1]), *-out, -np.cos(x[1])])

    return Benchmark(system, q0, v0, slope, np.array([np.pi / 2, tilt, up, spin, 0, 0]), places)


def spatial_slider_crank() -> Benchmark:
    """A crank in the plane x = 0, a rod of length 0.3, a slider on the x axis (Haug, 1989)."""
    center, radius, rod = np.array([0.0, 0.1, 0.12]), 0.08, 0.3
    mass = rods([(0, 2), (0, 1)], 2, 3, [0.12, 0.5]) + np.diag([0, 0, 0, 2.0, 2.0, 2.0])
    weight = np.zeros(6)
    weight[[2, 5]] = -GRAVITY * np.array([0.31, 2.25])

    def joints(t: float, q: Array) -> Array:
        a, b = q[:3] - center, q[3:]
        d = q[:3] - b
        return np.array([q[0], a @ a - radius**2, b[1], b[2], d @ d - rod**2])

    def energy(t: float, q: Array, v: Array) -> float:
        return v @ mass @ v / 2 - weight @ q

    system = MechanicalSystem(mass, lambda t, q, v: weight, joints, energy=energy, name="spatial slider crank")

    def path(angle: float) -> tuple[Array, Array, Array]:
        """q, and its derivatives with respect to the angle."""
        y, z = center[1] + radius * np.cos(angle), center[2] + radius * np.sin(angle)
        dy, dz = -radius * np.sin(angle), radius * np.cos(angle)
        x = np.sqrt(rod**2 - y * y - z * z)
        dx = -(y * dy + z * dz) / x
        ddx = -(dy * dy + dz * dz - y * (y - center[1]) - z * (z - center[2]) + dx * dx) / x
        first = np.array([0, dy, dz, dx, 0, 0])
        return np.array([0, y, z, x, 0, 0]), first, np.array([0, center[1] - y, center[2] - z, ddx, 0, 0])

    def slope(t: float, x: Array) -> Array:
        _, first, second = path(x[0])
        along = mass @ first
        return np.array([x[1], (first @ weight - along @ second * x[1] ** 2) / (along @ first)])

    q0, first, _ = path(np.pi / 2)
    return Benchmark(system, q0, 6.0 * first, slope, np.array([np.pi / 2, 6.0]), lambda x: path(x[0])[0])


def cross(a: Array, b: Array) -> Array:
    """Faster than NumPy's for two vectors, and for complex ones too."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def up_in_body(e: Array) -> Array:
    """The vertical in the body's axes, of a unit quaternion."""
    w, x, y, z = e
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])


def rolling(axes: Array, inertia: Array, mass: float, e0: Array, spin: Array, name: str) -> Benchmark:
    """An ellipsoid that rolls on a plane; a disc, if one of its axes is 0. q: centre and quaternion, v: of the centre,
    and angular velocity in the body's axes."""
    squares = axes**2

    def contact(up: Array) -> Array:
        return -squares * up / np.sqrt((squares * up) @ up)

    def turned(e: Array, a: Array) -> Array:
        w, u = e[0], e[1:]
        return a + 2 * w * cross(u, a) + 2 * cross(u, cross(u, a))

    def kinematics(t: float, q: Array, v: Array) -> Array:
        w, u, omega = q[3], q[4:], v[3:]
        return np.concatenate([v[:3], [-(u @ omega) / 2], (w * omega + cross(u, omega)) / 2])

    def touches(t: float, q: Array) -> Array:
        up = up_in_body(q[3:])
        return q[2] - np.sqrt((squares * up) @ up)

    def rolls(t: float, q: Array, v: Array) -> Array:
        return (v[:3] + turned(q[3:], cross(v[3:], contact(up_in_body(q[3:])))))[:2]

    def force(t: float, q: Array, v: Array) -> Array:
        return np.concatenate([[0, 0, -mass * GRAVITY], -cross(v[3:], inertia @ v[3:])])

    def energy(t: float, q: Array, v: Array) -> float:
        return mass * (v[:3] @ v[:3]) / 2 + v[3:] @ (inertia @ v[3:]) / 2 + mass * GRAVITY * q[2]

    masses = np.zeros((6, 6))
    masses[:3, :3], masses[3:, 3:] = mass * np.eye(3), inertia
    system = MechanicalSystem(
        masses, force, touches, rolls, kinematics, energy, [iv.UnitQuaternion([3, 4, 5, 6])], name=name
    )

    def height(e: Array) -> float:
        return -contact(up_in_body(e)) @ up_in_body(e)

    arm = contact(up_in_body(e0))
    q0 = np.array([0, 0, height(e0), *e0])

    def slope(t: float, x: Array) -> Array:  # centre, quaternion, angular velocity
        e, omega = x[3:7], x[7:]
        up = up_in_body(e)
        r = contact(up)
        rate, length = cross(up, omega), np.sqrt((squares * up) @ up)
        r_rate = -squares * rate / length + squares * up * ((squares * up) @ rate) / length**3
        skew = np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
        moment = -cross(omega, inertia @ omega)
        moment += mass * cross(r, cross(r_rate, omega) + cross(omega, cross(r, omega)) + GRAVITY * up)
        turn = np.linalg.solve(inertia - mass * skew @ skew, moment)
        velocity = turned(e, cross(r, omega))
        return np.concatenate([kinematics(t, x[:7], np.concatenate([velocity, omega])), turn])

    v0 = np.concatenate([turned(e0, cross(arm, spin)), spin])
    return Benchmark(system, q0, v0, slope, np.concatenate([q0, spin]), lambda x: x[:7], height)


def rattleback() -> Benchmark:
    """A half ellipsoid whose axes of inertia are askew to those of its surface: it reverses its spin."""
    inertia = np.array([[0.0002, -0.00002, 0], [-0.00002, 0.0016, 0], [0, 0, 0.0017]])
    tilt = np.array([np.cos(0.25), np.sin(0.25) * 0.6, np.sin(0.25) * 0.8, 0])
    return rolling(np.array([0.2, 0.03, 0.02]), inertia, 1.0, tilt, np.array([0.1, 0.0, -5.0]), "rattleback")


def rolling_disc() -> Benchmark:
    """A thin disc of radius 0.3, leaning."""
    radius, mass = 0.3, 1.0
    inertia = mass * radius**2 * np.diag([0.25, 0.25, 0.5])
    lean = np.array([np.cos(0.7), np.sin(0.7), 0, 0])  # from flat
    return rolling(np.array([radius, radius, 0.0]), inertia, mass, lean, np.array([0.0, 1.0, 8.0]), "rolling disc")
