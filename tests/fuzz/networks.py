"""Random reaction networks, whose linear laws come from a numerical null space: their coefficients have roundoff.

The oracle: a run that imposes the laws within the bounds y ≥ 0 has the solution of one that does neither.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any

import numpy as np
from methods import GENERAL
from scipy.linalg import null_space

import invariode as iv

__all__ = ["Network", "held_network"]

#: The error that a run may have, in units of rtol max |y| times the length of the interval (see runs.py).
ALLOWED = 1000
#: Networks take up to 1300; with one that explodes, explicit methods would take millions.
MOST_STEPS = 20_000


@dataclass
class Network:
    """Mass-action kinetics of reactions A + B → C, A → C or A → C + D."""

    consumed: Any
    """How many molecules of each species each reaction takes, of shape (reactions, species)."""
    change: Any
    """How the reaction changes the species, of the same shape."""
    rates: Any
    y0: Any

    @classmethod
    def of(cls, random: Random, species: int) -> Network:
        count = random.randint(species // 2, species - 1)  # fewer reactions than species: there are laws
        consumed, produced = np.zeros((count, species)), np.zeros((count, species))
        for j in range(count):
            taken = random.sample(range(species), random.choice([1, 2]))
            made = random.sample([i for i in range(species) if i not in taken], random.choice([1, 1, 2]))
            consumed[j, taken] = 1
            produced[j, made] = 1
        rates = np.array([10 ** random.uniform(-2, 2) for _ in range(count)])
        y0 = np.array([random.choice([0.0, 0.0, 1.0, random.random()]) for _ in range(species)])
        y0[random.randrange(species)] = 1.0
        return cls(consumed, produced - consumed, rates, y0)

    def f(self, t: float, y: Any) -> Any:
        return self.change.T @ (self.rates * np.prod(y**self.consumed, axis=1))

    def laws(self) -> Any:
        """An orthonormal basis of them, as rows."""
        return null_space(self.change).T


def held_network(random: Random) -> str | None:
    """Solves one, with its laws and within bounds. What is wrong with the solution, or None."""
    network, method = Network.of(random, random.randint(5, 30)), random.choice(GENERAL)
    laws, rtol = network.laws(), 10 ** -random.uniform(3, 6)
    tf = random.choice([0.1, 1.0, 3.0])
    told = f"method={method}, rtol={rtol:.2g}, tf={tf}, {network}"
    solved: Callable[..., Any] = partial(iv.solve_ivp, network.f, (0, tf), network.y0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about laws that are redundant, or stability that limits the steps
        right = solved("radau", rtol=1e-9, atol=1e-12)
        held = {"nonnegative": True, "invariants": lambda t, y: laws @ y, "max_steps": MOST_STEPS}
        sol = solved(method, rtol=rtol, atol=1e-3 * rtol, **held)
    if sol.status == -3:
        return None
    if not sol.success:
        return f"ended at {sol.t_end} with {sol.message}; {told}"
    if sol.y.min() < 0:
        return f"a component of {sol.y.min()}; {told}"
    error = np.abs(sol.y[:, -1] - right.y[:, -1]).max() / (rtol * max(1.0, np.abs(right.y[:, -1]).max()))
    return None if error <= ALLOWED else f"error of {error:.3g} tolerances; {told}"
