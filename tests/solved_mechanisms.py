"""Mechanisms as differential equations, with the accelerations that their constraints leave."""

from __future__ import annotations

import numpy as np

# ----------------------------------------------------------------------------------------------------------------------
# The car axis of the IVP Test Set: k q'' = F + Gᵀ λ with the λ for which its constraints stay 0. Numba can compile it.

STIFFNESS = 1e-2**2 * 10 / 2  # k = eps² M / 2


def base(t):
    """Where the right wheel is, how fast it moves and how that changes."""
    y = 0.1 * np.sin(10 * t)
    x = np.sqrt(1 - y * y)
    dy, ddy = np.cos(10 * t), -10 * np.sin(10 * t)
    dx = -y * dy / x
    return x, y, dx, dy, -(dy * dy + y * ddy + dx * dx) / x, ddy


def car_axis(t, state):
    a, b, c, d, u, v, w, z = state
    x, y, dx, dy, ddx, ddy = base(t)
    left, right = np.hypot(a, b), np.hypot(c - x, d - y)
    pull, push = (0.5 - left) / left, (0.5 - right) / right
    fa, fb, fc, fd = pull * a, pull * b - STIFFNESS, push * (c - x), push * (d - y) - STIFFNESS
    e, f = 2 * (a - c), 2 * (b - d)  # G = ((x, y, 0, 0), (e, f, -e, -f))
    g11, g12, g22 = x * x + y * y, x * e + y * f, 2 * (e * e + f * f)
    r1 = -STIFFNESS * (2 * (u * dx + v * dy) + a * ddx + b * ddy) - (x * fa + y * fb)
    r2 = -STIFFNESS * 2 * ((u - w) ** 2 + (v - z) ** 2) - (e * (fa - fc) + f * (fb - fd))
    size = g11 * g22 - g12 * g12
    p, q = (g22 * r1 - g12 * r2) / size, (g11 * r2 - g12 * r1) / size
    forces = (fa + x * p + e * q, fb + y * p + f * q, fc - e * q, fd - f * q)
    return (u, v, w, z, forces[0] / STIFFNESS, forces[1] / STIFFNESS, forces[2] / STIFFNESS, forces[3] / STIFFNESS)


def car_constraints(t, state):
    """Two of position, then their derivatives."""
    a, b, c, d, u, v, w, z = state
    x, y, dx, dy, _, _ = base(t)
    return (
        a * x + b * y,
        (a - c) ** 2 + (b - d) ** 2 - 1,
        u * x + v * y + a * dx + b * dy,
        2 * ((a - c) * (u - w) + (b - d) * (v - z)),
    )


CAR = [0, 0.5, 1, 0.5, -0.5, 0, -0.5, 0]

# ----------------------------------------------------------------------------------------------------------------------
# The slider crank of SUNDIALS' examples (idaSlCrank): crank angle, slider, angle of the rod; a spring and a damper
# between crank and rod, a constant force on the slider.

ARM, INERTIA = 0.5, np.array([1.0, 1.0, 2.0])


def crank_force(q, v):
    angle, x, rod = q
    turn, speed, swing = v
    s1, c1, s2, c2 = np.sin(angle), np.cos(angle), np.sin(rod), np.cos(rod)
    s21, c21 = s2 * c1 - c2 * s1, c2 * c1 + s2 * s1
    length = np.sqrt(x * x - x * (c2 + ARM * c1) + (1 + ARM**2) / 4 + ARM * c21 / 2)
    rate = 2 * x * speed - speed * (c2 + ARM * c1) + x * (s2 * swing + ARM * s1 * turn) - ARM * s21 * (swing - turn) / 2
    pull = (length - 1 + rate / (2 * length)) / length
    return np.array(
        [
            -pull * ARM * (s21 / 2 + x * s1) / 2,
            pull * (c2 / 2 - x + ARM * c1 / 2) + 1,
            -pull * (x * s2 - ARM * s21 / 2) / 2 - s2,
        ]
    )


def slider_crank(t, y):
    q, v = y[:3], y[3:]
    G = np.array([[ARM * np.sin(q[0]), 1, np.sin(q[2])], [-ARM * np.cos(q[0]), 0, -np.cos(q[2])]])
    rest = np.array([np.cos(q[0]) * ARM * v[0] ** 2 + np.cos(q[2]) * v[2] ** 2,
                     np.sin(q[0]) * ARM * v[0] ** 2 + np.sin(q[2]) * v[2] ** 2])  # fmt: skip
    force = crank_force(q, v)
    multipliers = np.linalg.solve((G / INERTIA) @ G.T, -rest - G @ (force / INERTIA))
    return np.concatenate([v, (force + G.T @ multipliers) / INERTIA])


def crank_constraints(t, y):
    q, v = y[:3], y[3:]
    return [
        q[1] - np.cos(q[2]) - ARM * np.cos(q[0]),
        -np.sin(q[2]) - ARM * np.sin(q[0]),
        v[1] + np.sin(q[2]) * v[2] + ARM * np.sin(q[0]) * v[0],
        -np.cos(q[2]) * v[2] - ARM * np.cos(q[0]) * v[0],
    ]


CRANK = [np.pi / 2, np.cos(np.arcsin(ARM)), -np.arcsin(ARM), 0, 0, 0]

# ----------------------------------------------------------------------------------------------------------------------
# The slider crank of the IVP Test Set (Simeon): its constraints, with the elastic rod's end displacement q4, and its
# start, as printed there. Angles of crank and rod, slider, four elastic coordinates; then their velocities.


def elastic_crank_constraints(t, y):
    first, rod, slider, end = y[0], y[1], y[2], y[6]
    turn, swing, speed, stretch = y[7], y[8], y[9], y[13]
    length = 0.30 + end
    return [
        0.15 * np.sin(first) + length * np.sin(rod),
        slider - 0.15 * np.cos(first) - length * np.cos(rod),
        first - 150 * t,
        0.15 * np.cos(first) * turn + length * np.cos(rod) * swing + stretch * np.sin(rod),
        speed + 0.15 * np.sin(first) * turn + length * np.sin(rod) * swing - stretch * np.cos(rod),
        turn - 150,
    ]


ELASTIC_CRANK = [
    0, 0, 0.450016933, 0, 0, 0.103339863e-4, 0.169327969e-4,
    150, -74.9957670, -0.268938672e-5, 0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5,
]  # fmt: skip
