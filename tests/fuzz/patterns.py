"""Stiff linear systems whose Jacobian is said to be sparse or banded, rightly or wrongly.

The oracle: a run has the right solution, or says in a warning or an error which option is wrong.
"""

from __future__ import annotations

import warnings
from random import Random
from typing import Any

import numpy as np
from scipy.linalg import expm

import invariode as iv

__all__ = ["stated_pattern"]

#: The error that a run may have, in units of max(rtol |y|, atol) times the length of the interval (see runs.py).
ALLOWED = 1000
NAMES = ("jac_sparsity", "lband", "uband")


def _stated(random: Random, A: Any) -> dict[str, Any]:
    """The pattern of A, as it is or with entries that it lacks."""
    n = len(A)
    rows, columns = np.nonzero(A)
    lower, upper = int((rows - columns).max(initial=0)), int((columns - rows).max(initial=0))
    wrong = random.random() < 0.6
    if random.random() < 0.5:
        cut = random.choice([0, 1]) if wrong else 0
        return {"lband": max(0, lower - wrong * (1 - cut)), "uband": max(0, upper - wrong * cut)}
    pattern = (A != 0) | np.eye(n, dtype=bool)
    if wrong:
        for _ in range(random.choice([1, 1, n])):
            k = random.randrange(len(rows))
            pattern[rows[k], columns[k]] = False
    return {"jac_sparsity": pattern}


def stated_pattern(random: Random) -> str | None:
    """Solves one. What is wrong with the answer, or None."""
    n, rng = random.choice([2, 3, 5, 12]), np.random.default_rng(random.getrandbits(32))
    A = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.5)
    A = A - A.T - np.diag(10 ** rng.uniform(-1, random.choice([0, 2, 4]), size=n))  # stable, some of it fast
    y0, tf = rng.normal(size=n), random.choice([1.0, 3.0])
    method = random.choice([name for name, one in iv.METHODS.items() if "jac_sparsity" in one.options])
    rtol = 10 ** -random.uniform(2, 6)
    options = _stated(random, A)
    told = f"method={method}, rtol={rtol:.2g}, tf={tf}, {options}, A={A.tolist()}"
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            sol = iv.solve_ivp(lambda t, y: A @ y, (0, tf), y0, method, rtol=rtol, atol=1e-3 * rtol, **options)
        except ValueError as error:
            return None if any(name in str(error) for name in NAMES) else f"{error}; {told}"
    if any(name in str(one.message) for one in heard for name in NAMES):
        return None
    if not sol.success:
        return None if any(name in sol.message for name in NAMES) else f"{sol.message}; {told}"
    error = np.abs(sol.y[:, -1] - expm(A * tf) @ y0).max() / (rtol * max(1.0, np.abs(y0).max()) * max(1.0, tf))
    return None if error <= ALLOWED else f"error of {error:.3g} tolerances; {told}"
