"""The problems over which the laws are tested, each with what it keeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import invariode as iv


@dataclass(frozen=True)
class TestProblem:
    """y' = fun(t, y), invariants g, their analytic Jacobian; `value` is 0 for constraints, None for what g is at y0."""

    __test__ = False

    name: str
    fun: Callable[..., Any]
    t_span: tuple[float, float]
    y0: list[float]
    g: Callable[..., Any]
    jac: Callable[..., Any]
    value: Any = None
    solution: Callable[[float], Any] | None = field(default=None)

    def invariants(self, jac: bool = True, **options: Any) -> iv.Invariants:
        return iv.Invariants(self.g, self.jac if jac else None, self.value, **options)

    def solve(self, method: str, project: bool = True, **options: Any) -> iv.Solution:
        invariants = self.invariants() if project else None
        return iv.solve_ivp(self.fun, self.t_span, self.y0, method, invariants=invariants, **options)

    def drift(self, sol: iv.Solution) -> float:
        """Largest residual at the outputs."""
        held = np.zeros(1) if self.value is not None else np.atleast_1d(self.g(self.t_span[0], np.array(self.y0)))
        return max(float(np.abs(self.g(t, y) - held).max()) for t, y in zip(sol.t, sol.y.T, strict=True))


def long_steps(method: str) -> bool:
    """True for the pairs of order 8 and more, whose steps at the default tolerances are too long for some laws."""
    return iv.METHODS[method].fixed_order and iv.METHODS[method].order >= 8


def cost_of_pair(sol: iv.Solution, method: str) -> int:
    """Evaluations of f in a run with a Runge-Kutta pair that nobody looked into; see `Method.stages`."""
    about = iv.METHODS[method]
    waits = "fsal" not in about.options
    return 1 + about.stages * (sol.stats.steps + sol.stats.failed) - (sol.stats.failed if waits else 0)


def lotka_volterra(t, y):
    u, v = y
    return [2 * u * (1 - v), -v * (1 - u)]


def lotka_volterra_invariant(t, y):
    u, v = y
    return u**-1.0 * np.exp(u) * v**-2.0 * np.exp(2 * v)


def lotka_volterra_jacobian(t, y):
    u, v = y
    value = lotka_volterra_invariant(t, y)
    return [[value * (1 - 1 / u), value * (2 - 2 / v)]]


def pendulum(t, y):
    x, z, u, v = y
    tension = (u * u + v * v - z) / (x * x + z * z)
    return [u, v, -tension * x, -tension * z - 1]


def pendulum_constraints(t, y):
    x, z, u, v = y
    return [x * x + z * z - 1, x * u + z * v]


def pendulum_jacobian(t, y):
    x, z, u, v = y
    return [[2 * x, 2 * z, 0, 0], [u, v, x, z]]


MU = 1 / 82.45


def three_body(t, y):
    x, z, u, v = y
    a, b = ((x + MU) ** 2 + z * z) ** 1.5, ((x - 1 + MU) ** 2 + z * z) ** 1.5
    return [
        u,
        v,
        2 * v + x - (1 - MU) * (x + MU) / a - MU * (x - 1 + MU) / b,
        -2 * u + z - (1 - MU) * z / a - MU * z / b,
    ]


def jacobi_integral(t, y):
    x, z, u, v = y
    a, b = np.hypot(x + MU, z), np.hypot(x - 1 + MU, z)
    return (u * u + v * v) / 2 - (x * x + z * z) / 2 - (1 - MU) / a - MU / b


def jacobi_jacobian(t, y):
    x, z, u, v = y
    a, b = np.hypot(x + MU, z) ** 3, np.hypot(x - 1 + MU, z) ** 3
    return [[
        -x + (1 - MU) * (x + MU) / a + MU * (x - 1 + MU) / b,
        -z + (1 - MU) * z / a + MU * z / b,
        u,
        v,
    ]]  # fmt: skip


def kepler(t, y):
    x, z, u, v = y
    r3 = np.hypot(x, z) ** 3
    return [u, v, -x / r3, -z / r3]


def kepler_invariants(t, y):
    """Energy and angular momentum."""
    x, z, u, v = y
    return [(u * u + v * v) / 2 - 1 / np.hypot(x, z), x * v - z * u]


def kepler_jacobian(t, y):
    x, z, u, v = y
    r3 = np.hypot(x, z) ** 3
    return [[x / r3, z / r3, u, v], [v, -u, -z, x]]


def kepler_solution(t, e=0.6):
    anomaly = t
    for _ in range(60):
        anomaly -= (anomaly - e * np.sin(anomaly) - t) / (1 - e * np.cos(anomaly))
    b, r = np.sqrt(1 - e * e), 1 - e * np.cos(anomaly)
    s, c = np.sin(anomaly), np.cos(anomaly)
    return np.array([c - e, b * s, -s / r, b * c / r])


def rigid_body(t, y):
    a, b, c = y
    return [b * c, -a * c, -0.51 * a * b]


def rigid_body_invariants(t, y):
    a, b, c = y
    return [a * a + b * b, 0.51 * a * a + c * c]


def rigid_body_jacobian(t, y):
    a, b, c = y
    return [[2 * a, 2 * b, 0], [1.02 * a, 0, 2 * c]]


def forced(t, y):
    """y' = cos t in three components that turn: y0 - sin t and the radius of (y1, y2) are kept."""
    return [np.cos(t), -y[2], y[1]]


def forced_invariants(t, y):
    return [y[0] - np.sin(t), y[1] ** 2 + y[2] ** 2]


def forced_jacobian(t, y):
    return [[1, 0, 0], [0, 2 * y[1], 2 * y[2]]]


def henon_heiles(t, y):
    x, z, u, v = y
    return [u, v, -x - 2 * x * z, -z - x * x + z * z]


def henon_heiles_energy(t, y):
    x, z, u, v = y
    return (u * u + v * v + x * x + z * z) / 2 + x * x * z - z**3 / 3


def henon_heiles_jacobian(t, y):
    x, z, u, v = y
    return [[x + 2 * x * z, z + x * x - z * z, u, v]]


PROBLEMS = {
    p.name: p
    for p in (
        TestProblem(
            "Lotka-Volterra", lotka_volterra, (0, 50), [1, 3], lotka_volterra_invariant, lotka_volterra_jacobian
        ),
        TestProblem("pendulum", pendulum, (0, 50), [1, 0, 0, 0], pendulum_constraints, pendulum_jacobian, 0),
        TestProblem(
            "three-body",
            three_body,
            (0, 6.19216933131963970674),
            [1.2, 0, 0, -1.04935750983031990726],
            jacobi_integral,
            jacobi_jacobian,
        ),
        TestProblem(
            "Kepler",
            kepler,
            (0, 20),
            [0.4, 0, 0, 2],
            kepler_invariants,
            kepler_jacobian,
            solution=kepler_solution,
        ),
        TestProblem(
            "Henon-Heiles",
            henon_heiles,
            (0, 10),
            [0, 0.1, 0.45, 0.1],
            henon_heiles_energy,
            henon_heiles_jacobian,
        ),
        TestProblem("rigid body", rigid_body, (0, 30), [0, 1, 1], rigid_body_invariants, rigid_body_jacobian),
        TestProblem(
            "forced",
            forced,
            (0, 20),
            [0, 1, 0],
            forced_invariants,
            forced_jacobian,
            solution=lambda t: np.array([np.sin(t), np.cos(t), np.sin(t)]),
        ),
    )
}
