"""The problems of section 6 of the paper, with their invariants and the Jacobians of these.

f is written for one state y of shape (n,); the invariants also take columns of states, (n, n_t).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._arguments import Array
from ..invariants import Invariants
from ..problem import Problem

__all__ = ["DEMO_ATOL", "DEMO_RTOL", "JACOBI", "ORBITS", "PENDULUM", "lotka_volterra", "pendulum", "three_body"]

#: Lotka-Volterra (paper, p. 71): growth of the prey, decline of the predator.
A, C = 2.0, 1.0


def _predator_prey(t: float, state: Array) -> list[float]:
    x, y = state
    return [A * x * (1 - y), -C * y * (1 - x)]


def _orbit(t: Any, state: Array) -> Any:
    x, y = state
    return x**-C * np.exp(C * x) * y**-A * np.exp(A * y)


def _orbit_jacobian(t: float, state: Array) -> list[float]:
    x, y = state
    g = _orbit(t, state)
    return [C * g * (1 - 1 / x), A * g * (1 - 1 / y)]


#: x^(-c) e^(cx) y^(-a) e^(ay) (paper, p. 70), held at its initial value e^7 / 9 = 121.8.
ORBITS = Invariants(_orbit, _orbit_jacobian, names="orbit")


def lotka_volterra(*, imposed: bool = True) -> Problem:
    """Predator and prey, x' = a x (1 - y), y' = -c y (1 - x), a = 2, c = 1, (1, 3), 0 <= t <= 50 (paper, pp. 70-71).

    Parameters
    ----------
    imposed : bool, default True
        Whether the invariant `ORBITS` is imposed.
    """
    return Problem(
        _predator_prey,
        (0, 50),
        [1, 3],
        invariants=ORBITS if imposed else None,
        name="Lotka-Volterra",
        labels=["x", "y"],
    )


def _swing(t: float, state: Array) -> list[float]:
    x, y, vx, vy = state
    tension = (vx**2 + vy**2 - y) / (x**2 + y**2)
    return [vx, vy, -tension * x, -tension * y - 1]


def _rod(t: Any, state: Array) -> list[Any]:
    x, y, vx, vy = state
    return [x**2 + y**2 - 1, x * vx + y * vy]


def _rod_jacobian(t: float, state: Array) -> list[list[float]]:
    x, y, vx, vy = state
    return [[2 * x, 2 * y, 0, 0], [vx, vy, x, y]]


#: The constraints on position and velocity (paper, p. 70): the rod has length 1, the bob moves across it.
PENDULUM = Invariants(_rod, _rod_jacobian, value=0, names=["length", "velocity"])


def pendulum(*, imposed: bool = True) -> Problem:
    """The pendulum in Cartesian coordinates (paper, p. 70, after its [14]), from rest at (1, 0), 0 <= t <= 50.

    x'' = -λ x, y'' = -λ y - 1 with the tension λ = (x'^2 + y'^2 - y) / (x^2 + y^2) that keeps x^2 + y^2 = 1.

    Parameters
    ----------
    imposed : bool, default True
        Whether both constraints, `PENDULUM`, are imposed.
    """
    return Problem(
        _swing,
        (0, 50),
        [1, 0, 0, 0],
        invariants=PENDULUM if imposed else None,
        name="pendulum",
        labels=["x", "y", "x'", "y'"],
    )


#: Restricted three-body problem: the data of MATLAB's orbitode.m, which the paper solves (p. 69).
MU = 1 / 82.45
MU_STAR = 1 - MU
PERIOD = 6.19216933131963970674
START = (1.2, 0.0, 0.0, -1.04935750983031990726)

#: The tolerances at which MATLAB's demonstration solves it with ode45 (paper, p. 70).
DEMO_RTOL, DEMO_ATOL = 1e-5, 1e-4


def _pull(x: float, y: float) -> tuple[float, float]:
    """The attraction of the two bodies, at (-μ, 0) and (μ*, 0), as masses over cubed distances."""
    return MU_STAR / math.hypot(x + MU, y) ** 3, MU / math.hypot(x - MU_STAR, y) ** 3


def _orbiter(t: float, state: Array) -> list[float]:
    x, y, vx, vy = state
    first, second = _pull(x, y)
    return [
        vx,
        vy,
        2 * vy + x - first * (x + MU) - second * (x - MU_STAR),
        -2 * vx + y - first * y - second * y,
    ]


def _jacobi(t: Any, state: Array) -> Any:
    x, y, vx, vy = state
    kinetic = (vx**2 + vy**2) / 2
    return kinetic - (x**2 + y**2) / 2 - MU_STAR / np.hypot(x + MU, y) - MU / np.hypot(x - MU_STAR, y)


def _jacobi_jacobian(t: float, state: Array) -> list[float]:
    x, y, vx, vy = state
    first, second = _pull(x, y)
    return [-x + first * (x + MU) + second * (x - MU_STAR), -y + first * y + second * y, vx, vy]


#: The Jacobi integral, which plays the role of the energy (paper, p. 70).
JACOBI = Invariants(_jacobi, _jacobi_jacobian, names="Jacobi integral")


def three_body(*, imposed: bool = True) -> Problem:
    """A periodic orbit of the restricted three-body problem, for one period (paper, pp. 69-70, Fig. 1).

    x'' = 2 y' + x - μ* (x + μ)/r1^3 - μ (x - μ*)/r2^3, y'' = -2 x' + y - μ* y/r1^3 - μ y/r2^3, in rotating coordinates,
    with the distances r1 and r2 to the bodies of masses μ* = 1 - μ at (-μ, 0) and μ = 1/82.45 at (μ*, 0).

    Parameters
    ----------
    imposed : bool, default True
        Whether the Jacobi integral, `JACOBI`, is imposed.
    """
    return Problem(
        _orbiter,
        (0, PERIOD),
        START,
        invariants=JACOBI if imposed else None,
        name="restricted three-body problem",
        labels=["x", "y", "x'", "y'"],
    )
