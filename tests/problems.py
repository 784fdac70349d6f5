"""The problems over which the laws are tested, each with what it keeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import invariode as iv
from invariode import problems


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


def blow_up(t: float, y: np.ndarray) -> np.ndarray:
    """y' = y², infinite at t = 1 / y(0). Beyond it the stages of the long pairs overflow."""
    with np.errstate(over="ignore"):
        return y * y


def long_steps(method: str) -> bool:
    """True for the pairs of order 8 and more, whose steps at the default tolerances are too long for some laws."""
    return iv.METHODS[method].stages is not None and iv.METHODS[method].order >= 8


def implicit(method: str) -> bool:
    """True for the methods that take a Jacobian."""
    return "jac" in iv.METHODS[method].options


def switching(method: str) -> bool:
    """True for a method made of an explicit and an implicit one that take turns."""
    return "prefer" in iv.METHODS[method].options


def slack(method: str) -> int:
    """How much larger errors may be than with formulas of order 3 and more: with those of order 2, whose steps are so
    long that their error of O(h^3) is just below rtol, they are O(rtol^(2/3))."""
    return 100 if iv.METHODS[method].order == 2 else 1


def one_step(method: str) -> bool:
    """Return True if a step takes nothing but y from those before it, though perhaps the order that has proved best."""
    return iv.METHODS[method].fixed_order or method == "radau"


def cost_of_pair(sol: iv.Solution, method: str) -> int:
    """Evaluations of f in a run with a Runge-Kutta pair that nobody looked into; see `Method.stages`."""
    about = iv.METHODS[method]
    waits = "fsal" not in about.options
    return 1 + about.stages * (sol.stats.steps + sol.stats.failed) - (sol.stats.failed if waits else 0)


def parts(problem: iv.Problem) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """f, g and the Jacobian of g."""
    (held,) = problem.invariants
    return problem.fun, held.fun, held.jac


# f, g and J as `invariode.problems` has them.
lotka_volterra, lotka_volterra_invariant, lotka_volterra_jacobian = parts(problems.lotka_volterra())
pendulum, pendulum_constraints, pendulum_jacobian = parts(problems.pendulum())
three_body, jacobi_integral, jacobi_jacobian = parts(problems.three_body())
kepler, kepler_invariants, kepler_jacobian = parts(problems.kepler())
rigid_body, rigid_body_invariants, rigid_body_jacobian = parts(problems.rigid_body())
henon_heiles, henon_heiles_energy, henon_heiles_jacobian = parts(problems.henon_heiles())


def kepler_solution(t, e=0.6):
    """At a time or at many; states are columns."""
    anomaly = t
    for _ in range(60):
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - t) / (1 - e * np.cos(anomaly))
    b, r = np.sqrt(1 - e * e), 1 - e * np.cos(anomaly)
    s, c = np.sin(anomaly), np.cos(anomaly)
    return np.array([c - e, b * s, -s / r, b * c / r])


def forced(t, y):
    """y' = cos t in three components that turn: y0 - sin t and the radius of (y1, y2) are kept."""
    return [np.cos(t), -y[2], y[1]]


def forced_invariants(t, y):
    return [y[0] - np.sin(t), y[1] ** 2 + y[2] ** 2]


def forced_jacobian(t, y):
    return [[1, 0, 0], [0, 2 * y[1], 2 * y[2]]]


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
            (0, problems.PERIOD),
            list(problems.START),
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
