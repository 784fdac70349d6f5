"""Where corrections point: along gradients or among the stages of the step: ``python benchmarks/directions.py``.

Errors, cost and what linear laws that nobody names lose. With ``--write``, or ``make bench``, the table goes into
docs/benchmarks.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from measure import folded, table, write_section
from numpy.typing import NDArray

import invariode as iv
from invariode import problems

Array = NDArray[np.float64]

DIRECTIONS = (None, "gradient", "stages")

RUNS = [
    *((method, rtol) for method in ("ode45", "dop853", "ode89", "ode113", "ode15s", "radau") for rtol in (1e-4, 1e-7)),
    *((method, 1e-4) for method in ("ode23s", "ode23t", "ode23tb")),
]
#: Of the references: at the limit of double precision.
REFERENCE = {"method": "ode89", "rtol": 1e-13, "atol": 1e-14, "keep": "end"}


class Case(NamedTuple):
    """A problem with a nonlinear invariant g, and the linear laws that f keeps as well."""

    fun: Callable[..., object]
    tf: float
    y0: list[float]
    g: Callable[..., object]
    linear: Array  # (number of laws, n); none: what follows is about the error only


def toda(t: float, y: Array) -> Array:
    """Eight particles on a ring, with positions and momenta (M. Toda, J. Phys. Soc. Japan 22 (1967) 431)."""
    q, p = y[:8], y[8:]
    force = np.exp(q - np.roll(q, -1))
    return np.concatenate([p, np.roll(force, 1) - force])


def toda_energy(t: float, y: Array) -> Array:
    q, p = y[:8], y[8:]
    return p @ p / 2 + np.exp(q - np.roll(q, -1)).sum()


def particle(t: float, y: Array) -> Array:
    """A charge in the field of a line of charges along z, and in a magnetic field along z that grows with r: its
    velocity along z is constant."""
    x, v = y[:3], y[3:]
    r = np.hypot(x[0], x[1])
    return np.array([*v, 0.01 * x[0] / r**3 + r * v[1], 0.01 * x[1] / r**3 - r * v[0], 0.0])


def particle_energy(t: float, y: Array) -> Array:
    return y[3:] @ y[3:] / 2 + 0.01 * (y[0] ** 2 + y[1] ** 2) ** -0.5


MASSES = np.array([1.0, 2.0, 3.0])


def bodies(t: float, y: Array) -> Array:
    """Three bodies in the plane: positions and momenta."""
    q, p = y[:6].reshape(3, 2), y[6:].reshape(3, 2)
    apart = q[:, None] - q
    distance = np.sqrt((apart**2).sum(-1) + np.eye(3))
    force = -(np.outer(MASSES, MASSES) / distance**3)[:, :, None] * apart
    return np.concatenate([(p / MASSES[:, None]).ravel(), force.sum(1).ravel()])


def bodies_energy(t: float, y: Array) -> Array:
    q, p = y[:6].reshape(3, 2), y[6:].reshape(3, 2)
    energy = ((p**2).sum(1) / MASSES).sum() / 2
    for i in range(3):
        for j in range(i):
            energy = energy - MASSES[i] * MASSES[j] / ((q[i] - q[j]) ** 2).sum() ** 0.5
    return energy


def exponential(t: float, y: Array) -> list[float]:
    """Exponential entropy (H. Ranocha et al., SIAM J. Sci. Comput. 42 (2020) A612)."""
    return [-np.exp(y[1]), np.exp(y[0])]


def entropy(t: float, y: Array) -> Array:
    return np.exp(y[0]) + np.exp(y[1])


def cases() -> dict[str, Case]:
    none = np.zeros((0, 0))
    momenta = np.zeros((2, 12))
    momenta[0, 6::2] = momenta[1, 7::2] = 1
    start = [-3, 0, 0.6, 0.8, 3, 0, 0.2, -0.9, 0.8, 1.2, -0.3, 0.5]
    spin = [0.0] * 8 + [1.5, -0.5, 0.25, 1, -1, 0.75, -0.25, 0.5]
    found = {
        "Toda lattice": Case(toda, 50, spin, toda_energy, np.r_[np.zeros(8), np.ones(8)][None]),
        "charged particle": Case(particle, 50, [0, 1, 0.1, 0.09, 0.05, 0.2], particle_energy, np.eye(6)[5:]),
        "three bodies": Case(bodies, 15, start, bodies_energy, momenta),
        "exponential entropy": Case(exponential, 5, [1, 0.5], entropy, none),
    }
    for name in ("kepler", "lotka_volterra", "henon_heiles", "rigid_body"):
        problem = getattr(problems, name)()
        (held,) = problem.invariants
        found[problem.name] = Case(problem.fun, problem.t_span[1], list(problem.y0), held.fun, none)
    return found


def compared(case: Case, method: str, rtol: float, end: Array) -> list[str]:
    """Evaluations, errors at the end and the largest drift of linear laws, of each direction."""
    cells: dict[str, list[str]] = {"f": [], "error": [], "drift": []}
    for direction in DIRECTIONS:
        held = None if direction is None else iv.Invariants(case.g, direction=direction)
        sol = iv.solve_ivp(case.fun, (0, case.tf), case.y0, method, rtol=rtol, atol=rtol, invariants=held)
        if not sol.success:
            raise SystemExit(f"{method} at {rtol}: {sol.message}")
        cells["f"].append(str(sol.nfev))
        cells["error"].append(f"{abs(sol.y[:, -1] - end).max():.0e}")
        laws = case.linear @ sol.y if case.linear.size else np.zeros((0, 1))
        cells["drift"].append(f"{abs(laws - laws[:, :1]).max():.0e}" if case.linear.size else "")
    return [*cells["f"], *cells["error"], *cells["drift"]]


def report() -> str:
    head = [f"{what} {way or 'plain'}" for what in ("f", "error", "drift") for way in DIRECTIONS]
    parts: list[str] = []
    others: list[str] = []
    for name, case in cases().items():
        reference = iv.solve_ivp(case.fun, (0, case.tf), case.y0, **REFERENCE).y[:, -1]
        columns = 9 if case.linear.size else 6
        rows = [[method, f"{rtol:.0e}", *compared(case, method, rtol, reference)[:columns]] for method, rtol in RUNS]
        part = f"**{name}**\n\n{table(['method', 'rtol', *head[:columns]], rows)}"
        (parts if case.linear.size else others).append(part)
    return "\n\n".join([*parts, folded("Problems without linear laws", *others)])


if __name__ == "__main__":
    text = report()
    print(text)
    if "--write" in sys.argv:
        write_section("directions", text)
