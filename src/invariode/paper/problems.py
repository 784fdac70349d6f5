"""The problems of section 6 of the paper, with their invariants and the Jacobians of these.

f is written for one state y of shape (n,); the invariants also take columns of states, (n, n_t).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._arguments import Array
from ..invariants import Invariants
from ..problem import Problem

__all__ = [
    "DEMO_ATOL",
    "DEMO_RTOL",
    "HIRES",
    "JACOBI",
    "KINETICS",
    "ORBITS",
    "PENDULUM",
    "Kinetic",
    "lotka_volterra",
    "pendulum",
    "three_body",
]

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


@dataclass(frozen=True)
class Kinetic:
    """A stiff problem of chemical kinetics, its Jacobian, and the species whose sum is conserved."""

    name: str
    fun: Callable[..., Any]
    jac: Callable[..., Any]
    t_span: tuple[float, float]
    y0: list[float]
    atol: Any
    invariant: str
    kept: tuple[int, ...]


def _robertson(t: float, y: Array) -> list[float]:
    a, b, c = y
    return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, 3e7 * b * b]


def _robertson_jacobian(t: float, y: Array) -> list[list[float]]:
    _, b, c = y
    return [[-0.04, 1e4 * c, 1e4 * b], [0.04, -1e4 * c - 6e7 * b, -1e4 * b], [0, 6e7 * b, 0]]


def _hires(t: float, y: Array) -> list[float]:
    a, b, c, d, e, f, g, h = y
    bound = 280 * f * h
    return [
        -1.71 * a + 0.43 * b + 8.32 * c + 0.0007,
        1.71 * a - 8.75 * b,
        -10.03 * c + 0.43 * d + 0.035 * e,
        8.32 * b + 1.71 * c - 1.12 * d,
        -1.745 * e + 0.43 * f + 0.43 * g,
        -bound + 0.69 * d + 1.71 * e - 0.43 * f + 0.69 * g,
        bound - 1.81 * g,
        -bound + 1.81 * g,
    ]


def _hires_jacobian(t: float, y: Array) -> Array:
    f, h = y[5], y[7]
    J = np.zeros((8, 8))
    J[0, :3] = -1.71, 0.43, 8.32
    J[1, :2] = 1.71, -8.75
    J[2, 2:5] = -10.03, 0.43, 0.035
    J[3, 1:4] = 8.32, 1.71, -1.12
    J[4, 4:7] = -1.745, 0.43, 0.43
    J[5, 3:] = 0.69, 1.71, -280 * h - 0.43, 0.69, -280 * f
    J[6, 5:] = 280 * h, -1.81, 280 * f
    J[7] = -J[6]
    return J


#: Eight species in plant growth, after the Test Set for IVP Solvers (Mazzia & Magherini, 2008).
HIRES = Kinetic(
    "HIRES", _hires, _hires_jacobian, (0, 321.8122), [1, 0, 0, 0, 0, 0, 0, 0.0057], 1e-9, "y₇ + y₈ = 0.0057", (6, 7)
)
#: Problems whose linear invariants need no projection (paper, section 5).
KINETICS = (
    Kinetic(
        "Robertson",
        _robertson,
        _robertson_jacobian,
        (0, 4e11),
        [1, 0, 0],
        [1e-10, 1e-14, 1e-10],
        "y₁ + y₂ + y₃ = 1",
        (0, 1, 2),
    ),
    HIRES,
)
