"""Classic problems with their invariants, for trying and comparing methods.

>>> from invariode import problems
>>> sol = problems.kepler(0.6).solve("ode113", rtol=1e-8)
>>> sol.success
True

Each function returns an `invariode.Problem` with its invariants, names of the components and, if it is stiff, its
Jacobian; with ``imposed=False`` it has no invariants. The equations take one state y of shape (n,), and numba can
compile all except the chemical ones; the invariants also take columns of states, (n, n_t).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ._base.arguments import Array
from ._problem.invariants import Invariants
from ._problem.problem import Problem

__all__ = [
    "henon_heiles",
    "hires",
    "kepler",
    "lotka_volterra",
    "pendulum",
    "rigid_body",
    "robertson",
    "three_body",
]

#: Position and velocity in the plane.
PLANE = ("x", "y", "x'", "y'")

# ----------------------------------------------------------------------------------------------------------------------
# The problems of section 6 of the paper: L. F. Shampine, Comput. Math. Appl. 38 (1999) 61-72

#: Lotka-Volterra (paper, p. 71): growth of the prey, decline of the predator.
A, C = 2.0, 1.0


def _predator_prey(t: float, state: Array) -> tuple[Any, ...]:
    x, y = state[0], state[1]
    return A * x * (1 - y), -C * y * (1 - x)


def _orbit(t: Any, state: Array) -> Any:
    x, y = state[0], state[1]
    return x**-C * np.exp(C * x) * y**-A * np.exp(A * y)


def _orbit_jacobian(t: float, state: Array) -> tuple[tuple[Any, ...], ...]:
    x, y = state[0], state[1]
    g = x**-C * np.exp(C * x) * y**-A * np.exp(A * y)
    return ((C * g * (1 - 1 / x), A * g * (1 - 1 / y)),)


def lotka_volterra(*, imposed: bool = True) -> Problem:
    """Predator and prey, x' = a x (1 - y), y' = -c y (1 - x), a = 2, c = 1, from (1, 3), 0 <= t <= 50.

    The paper, pp. 70-71. The invariant is x^(-c) e^(cx) y^(-a) e^(ay), initially e^7 / 9 = 121.8.

    Parameters
    ----------
    imposed : bool, default True
        Whether the invariant is imposed.
    """
    held = Invariants(_orbit, _orbit_jacobian, names="orbit")
    return Problem(
        _predator_prey, (0, 50), [1, 3], invariants=held if imposed else None, name="Lotka-Volterra", labels=["x", "y"]
    )


def _swing(t: float, state: Array) -> tuple[Any, ...]:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    tension = (vx**2 + vy**2 - y) / (x**2 + y**2)
    return vx, vy, -tension * x, -tension * y - 1


def _rod(t: Any, state: Array) -> tuple[Any, ...]:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    return x**2 + y**2 - 1, x * vx + y * vy


def _rod_jacobian(t: float, state: Array) -> tuple[tuple[Any, ...], ...]:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    return (2 * x, 2 * y, 0.0, 0.0), (vx, vy, x, y)


def pendulum(*, imposed: bool = True) -> Problem:
    """The pendulum in Cartesian coordinates, from rest at (1, 0), 0 <= t <= 50.

    x'' = -λ x, y'' = -λ y - 1 with the tension λ = (x'^2 + y'^2 - y) / (x^2 + y^2) that keeps x^2 + y^2 = 1. The paper,
    p. 70, after its [14]. The invariants are the length of the rod and the velocity along it; both values are demanded
    to be 0.

    Parameters
    ----------
    imposed : bool, default True
        Whether both constraints are imposed.
    """
    held = Invariants(_rod, _rod_jacobian, value=0, names=["length", "velocity"])
    return Problem(_swing, (0, 50), [1, 0, 0, 0], invariants=held if imposed else None, name="pendulum", labels=PLANE)


#: Restricted three-body problem: the data of MATLAB's orbitode.m, which the paper solves (p. 69).
MU = 1 / 82.45
MU_STAR = 1 - MU
PERIOD = 6.19216933131963970674
START = (1.2, 0.0, 0.0, -1.04935750983031990726)


def _cube(x: float, y: float) -> float:
    """The cube of the distance of (x, y) from the origin."""
    return math.hypot(x, y) ** 3


def _orbiter(t: float, state: Array, cube: Callable[..., Any] = _cube) -> tuple[Any, ...]:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    a, b = x + MU, x - MU_STAR
    first, second = MU_STAR / cube(a, y), MU / cube(b, y)
    return vx, vy, 2 * vy + x - first * a - second * b, -2 * vx + y - first * y - second * y


def _jacobi(t: Any, state: Array) -> Any:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    kinetic = (vx**2 + vy**2) / 2
    return kinetic - (x**2 + y**2) / 2 - MU_STAR / np.hypot(x + MU, y) - MU / np.hypot(x - MU_STAR, y)


def _jacobi_jacobian(t: float, state: Array) -> tuple[tuple[Any, ...], ...]:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    first, second = MU_STAR / math.hypot(x + MU, y) ** 3, MU / math.hypot(x - MU_STAR, y) ** 3
    return ((-x + first * (x + MU) + second * (x - MU_STAR), -y + first * y + second * y, vx, vy),)


def three_body(*, imposed: bool = True) -> Problem:
    """A periodic orbit of the restricted three-body problem, for one period.

    x'' = 2 y' + x - μ* (x + μ)/r1^3 - μ (x - μ*)/r2^3, y'' = -2 x' + y - μ* y/r1^3 - μ y/r2^3, in rotating coordinates,
    with the distances r1 and r2 to the bodies of masses μ* = 1 - μ at (-μ, 0) and μ = 1/82.45 at (μ*, 0). The paper,
    pp. 69-70, Fig. 1. The invariant is the Jacobi integral, which plays the role of the energy.

    Parameters
    ----------
    imposed : bool, default True
        Whether the Jacobi integral is imposed.
    """
    held = Invariants(_jacobi, _jacobi_jacobian, names="Jacobi integral")
    name = "restricted three-body problem"
    return Problem(_orbiter, (0, PERIOD), START, invariants=held if imposed else None, name=name, labels=PLANE)


# ----------------------------------------------------------------------------------------------------------------------
# Other orbits and motions


def _planet(t: float, state: Array, cube: Callable[..., Any] = _cube) -> tuple[Any, ...]:
    x, y = state[0], state[1]
    r3 = cube(x, y)
    return state[2], state[3], -x / r3, -y / r3


def _energy_and_momentum(t: Any, state: Array) -> tuple[Any, ...]:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    return (vx**2 + vy**2) / 2 - 1 / np.hypot(x, y), x * vy - y * vx


def _energy_and_momentum_jacobian(t: float, state: Array) -> tuple[tuple[Any, ...], ...]:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    r3 = math.hypot(x, y) ** 3
    return (x / r3, y / r3, vx, vy), (vy, -vx, -y, x)


def kepler(e: float = 0.6, *, imposed: bool = True) -> Problem:
    """Kepler's problem, x'' = -x/r^3, y'' = -y/r^3, from the perihelion, for ten periods of 2π.

    The invariants are the energy, -1/2, and the angular momentum, sqrt(1 - e^2). For a circle, e = 0, one is redundant.

    Parameters
    ----------
    e : float, default 0.6
        The eccentricity of the orbit, from 0 to below 1.
    imposed : bool, default True
        Whether both invariants are imposed.

    Raises
    ------
    ValueError
        `e` is not the eccentricity of an ellipse.
    """
    if not 0 <= e < 1:
        raise ValueError(f"e, the eccentricity of an ellipse, must be from 0 to below 1, got {e!r}")
    held = Invariants(_energy_and_momentum, _energy_and_momentum_jacobian, names=["energy", "angular momentum"])
    start = [1 - e, 0, 0, math.sqrt((1 + e) / (1 - e))]
    return Problem(_planet, (0, 20 * math.pi), start, invariants=held if imposed else None, name="Kepler", labels=PLANE)


def _star(t: float, state: Array) -> tuple[Any, ...]:
    x, y = state[0], state[1]
    return state[2], state[3], -x - 2 * x * y, -y - x * x + y * y


def _star_energy(t: Any, state: Array) -> Any:
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    return (vx * vx + vy * vy + x * x + y * y) / 2 + x * x * y - y * y * y / 3


def _star_energy_jacobian(t: float, state: Array) -> tuple[tuple[Any, ...], ...]:
    x, y = state[0], state[1]
    return ((x + 2 * x * y, y + x * x - y * y, state[2], state[3]),)


def henon_heiles(energy: float = 1 / 12, y: float = 0.1, *, imposed: bool = True) -> Problem:
    """A star in the field of a galaxy, x'' = -x - 2 x y, y'' = -y - x^2 + y^2, 0 <= t <= 100.

    M. Hénon, C. Heiles, Astron. J. 69 (1964) 73-79. It starts at x = 0, y' = 0. The invariant is the energy; up to 1/6
    the star cannot escape, and near that value most orbits are chaotic.

    Parameters
    ----------
    energy : float, default 1/12
        The energy.
    y : float, default 0.1
        Where it starts.
    imposed : bool, default True
        Whether the energy is imposed.

    Raises
    ------
    ValueError
        The potential energy at y is larger than `energy`.
    """
    square = 2 * energy - y * y + 2 * y**3 / 3
    if square < 0:
        raise ValueError(f"energy {energy!r} is less than the potential at y = {y!r}: give a larger one, or another y")
    held = Invariants(_star_energy, _star_energy_jacobian, names="energy")
    start = [0, y, math.sqrt(square), 0]
    return Problem(_star, (0, 100), start, invariants=held if imposed else None, name="Hénon-Heiles", labels=PLANE)


#: Free rigid body: the data of MATLAB's rigidode.m, after F. T. Krogh.
K = 0.51


def _free_body(t: float, state: Array) -> tuple[Any, ...]:
    a, b, c = state[0], state[1], state[2]
    return b * c, -a * c, -K * a * b


def _quadrics(t: Any, state: Array) -> tuple[Any, ...]:
    a, b, c = state[0], state[1], state[2]
    return a * a + b * b, K * a * a + c * c


def _quadrics_jacobian(t: float, state: Array) -> tuple[tuple[Any, ...], ...]:
    a, b, c = state[0], state[1], state[2]
    return (2 * a, 2 * b, 0.0), (2 * K * a, 0.0, 2 * c)


def rigid_body(*, imposed: bool = True) -> Problem:
    """Euler's equations of a free rigid body, y1' = y2 y3, y2' = -y1 y3, y3' = -0.51 y1 y2, from (0, 1, 1), t <= 30.

    As in MATLAB's rigidode. The invariants are y1^2 + y2^2 and 0.51 y1^2 + y3^2.

    Parameters
    ----------
    imposed : bool, default True
        Whether both invariants are imposed.
    """
    held = Invariants(_quadrics, _quadrics_jacobian, names=["y1² + y2²", "0.51 y1² + y3²"])
    return Problem(
        _free_body,
        (0, 30),
        [0, 1, 1],
        invariants=held if imposed else None,
        name="rigid body",
        labels=["y1", "y2", "y3"],
    )


# ----------------------------------------------------------------------------------------------------------------------
# Stiff problems of chemical kinetics, as in the Test Set for IVP Solvers (F. Mazzia, C. Magherini, release 2.4, 2008)


def _robertson(t: float, y: Array) -> list[Any]:
    a, b, c = y
    return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, 3e7 * b * b]


def _robertson_jacobian(t: float, y: Array) -> list[list[Any]]:
    _, b, c = y
    return [[-0.04, 1e4 * c, 1e4 * b], [0.04, -1e4 * c - 6e7 * b, -1e4 * b], [0, 6e7 * b, 0]]


def _mass(t: Any, y: Array) -> Any:
    return y[0] + y[1] + y[2]


def _mass_jacobian(t: float, y: Array) -> list[list[float]]:
    return [[1, 1, 1]]


def robertson(*, imposed: bool = True) -> Problem:
    """Robertson's reaction of three species, rates from 0.04 to 3e7, from (1, 0, 0), 0 <= t <= 4e11; very stiff.

    y1' = -0.04 y1 + 1e4 y2 y3, y2' = 0.04 y1 - 1e4 y2 y3 - 3e7 y2^2, y3' = 3e7 y2^2. y2 stays below 4e-5: give it its
    own tolerance. The invariant is the mass y1 + y2 + y3, which all methods keep even without projection.

    Parameters
    ----------
    imposed : bool, default True
        Whether the mass is imposed.

    Returns
    -------
    Problem
        The problem, with the Jacobian of f.
    """
    held = Invariants(_mass, _mass_jacobian, names="mass") if imposed else None
    labels = ["y1", "y2", "y3"]
    return Problem(
        _robertson, (0, 4e11), [1, 0, 0], invariants=held, jac=_robertson_jacobian, name="Robertson", labels=labels
    )


def _hires(t: float, y: Array) -> list[Any]:
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


def _bound(t: Any, y: Array) -> Any:
    return y[6] + y[7]


def _bound_jacobian(t: float, y: Array) -> list[list[float]]:
    return [[0, 0, 0, 0, 0, 0, 1, 1]]


def hires(*, imposed: bool = True) -> Problem:
    """HIRES, eight species in the high irradiance response of plants (E. Schäfer, 1975), 0 <= t <= 321.8122; stiff.

    The invariant is y7 + y8 = 0.0057, which all methods keep even without projection.

    Parameters
    ----------
    imposed : bool, default True
        Whether that sum is imposed.

    Returns
    -------
    Problem
        The problem, with the Jacobian of f.
    """
    held = Invariants(_bound, _bound_jacobian, names="y7 + y8") if imposed else None
    start, labels = [1, 0, 0, 0, 0, 0, 0, 0.0057], [f"y{i}" for i in range(1, 9)]
    return Problem(_hires, (0, 321.8122), start, invariants=held, jac=_hires_jacobian, name="HIRES", labels=labels)
