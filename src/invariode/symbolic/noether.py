"""Laws of motion from symmetries: affine motions of the coordinates that leave a Lagrangian or Hamiltonian unchanged.

Such a motion is q → q + ε (A q + b). That nothing changes is a linear equation for A and b at each point. The null
space of many, at random points with random values of the parameters, holds the translations and rotations of all groups
of coordinates, and the cyclic coordinates among them. What is found this way is then verified to many digits.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy

from .._base.arguments import Array
from .._linear.null_space import echelon, null_space

_SEED = 1918  # Noether's paper
_NULL = 1e-9  # pivots below, in units of the first, are zero
_INTEGER = 1e-6  # distance from an integer
_DIGITS, _ZERO = 40, 1e-25  # of the verification: digits carried, and what is zero of a sum of terms
_POINTS = 3  # of the verification
#: Above this many unknowns (n² + n for n coordinates) only translations are sought.
_MOST = 700


def symmetries(q: Sequence[Any], conditions: Callable[[Sequence[Any]], list[Any]], symbols: Sequence[Any]) -> list[Any]:
    """Return the fields A q + b, lists of n expressions, for which `conditions(field)` vanish identically in `symbols`.

    The conditions are linear in the field and its derivatives.
    """
    basis = list(_basis(q))
    columns = [conditions(field) for field in basis]
    evaluate = sympy.lambdify(symbols, columns, modules="numpy", cse=True)
    rows = _sampled(evaluate, len(symbols), len(basis))
    if rows is None:
        return []
    found = []
    for combination in _integer_null_space(rows):
        field = [
            sympy.Add(*(c * one[i] for c, one in zip(combination, basis, strict=True) if c)) for i in range(len(q))
        ]
        if all(vanishes(condition, symbols) for condition in conditions(field)):
            found.append(field)
    return found


def _basis(q: Sequence[Any]) -> Iterator[list[Any]]:
    """Yield translations of each coordinate, and q_i' = q_j."""
    zeros = [sympy.S.Zero] * len(q)
    for i in range(len(q)):
        yield [*zeros[:i], sympy.S.One, *zeros[i + 1 :]]
    if len(q) * (len(q) + 1) <= _MOST:
        for i, j in itertools.product(range(len(q)), repeat=2):
            yield [*zeros[:i], q[j], *zeros[i + 1 :]]


def _sampled(evaluate: Callable[..., Any], symbols: int, unknowns: int) -> Array | None:
    """Return the conditions at random points, a row for each; None if they are not defined at enough of them."""
    rng = np.random.default_rng(_SEED)
    rows: list[Array] = []
    count = 0
    for _ in range(4 * unknowns + 40):
        with np.errstate(all="ignore"):
            try:
                values = np.array(evaluate(*rng.uniform(0.2, 1.7, symbols)), dtype=float).T  # (conditions, unknowns)
            except (ValueError, TypeError, ArithmeticError):
                continue
        if np.isfinite(values).all():
            rows.extend(row / size for row in values if (size := np.abs(row).max()) > 0)
            count += 1
        if count >= 2 * unknowns:
            break
    if count < unknowns:
        return None
    return np.array(rows).reshape(-1, unknowns)


def _integer_null_space(rows: Array) -> list[list[int]]:
    """Return a sparse basis of the null space, if it has one of small integers: those vectors that are."""
    null = null_space(rows, _NULL).vectors
    reduced = echelon(null[:, ::-1], _INTEGER)[:, ::-1]  # rotations lead with one entry of A, not with translations
    return [[round(float(c)) for c in row] for row in reduced[::-1] if np.abs(row - np.round(row)).max() <= _INTEGER]


def vanishes(expression: Any, symbols: Sequence[Any]) -> bool:
    """Return whether the expression is zero: at random points, to many digits."""
    if expression == 0:
        return True
    terms = sympy.Add.make_args(expression)
    evaluate = sympy.lambdify(symbols, terms, modules="mpmath", cse=True)
    rng = random.Random(_SEED)
    seen = 0
    with mpmath.workdps(_DIGITS):
        for _ in range(10 * _POINTS):
            try:
                values = [mpmath.mpc(v) for v in evaluate(*(mpmath.mpf(rng.uniform(0.2, 1.7)) for _ in symbols))]
            except (ValueError, ArithmeticError, TypeError):
                continue
            if not all(mpmath.isfinite(v) for v in values):
                continue
            if abs(mpmath.fsum(values)) > _ZERO * max(1, *(abs(v) for v in values)):
                return False
            seen += 1
            if seen == _POINTS:
                return True
    return False
