"""Points moved onto equations by the smallest change: Newton's iteration of least norm, and its linear systems."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array

#: Newton's iteration ends when changes are this part of the values, or decrease no more below the second number.
_SETTLED, _STAGNATES = 1e-13, 1e-10
_ITERATIONS, _HALVINGS = 100, 20
#: Singular values below this part of the largest are 0.
_RANK = 1e-12
#: Residuals are roundoff below this part of their terms.
_ROUNDOFF = 1e-9
#: Systems of more unknowns are solved by sparse factors.
_DENSE = 60


class Ended(Enum):
    """Ends of a Newton iteration."""

    SETTLED = "at a solution"
    UNDEFINED = "not finite where it began"
    DEPENDENT = "rows that depend on each other cannot all be satisfied"
    DIVERGED = "did not converge"


class Newton(NamedTuple):
    """Result of `newton`.

    Attributes
    ----------
    x : ndarray, (n,)
        The last point of the iteration.
    ended : Ended
        The reason why the iteration ended.
    residual : ndarray, (m,)
        The residuals there.
    rows : ndarray of int
        The residuals that are not defined, or the one that is farthest from 0.
    """

    x: Array
    ended: Ended
    residual: Array
    rows: Array


def newton(
    residual: Callable[[Array], Array], slopes: Callable[[Array], tuple[Array, Array]], x: Array, w: Array
) -> Newton:
    """Solve r(x) = 0 by the iteration x ← x − δ with the δ of least norm in the weights w, δ = W (A W)⁺ r.

    Steps are halved while a residual more than doubles, or is not finite.

    - `residual`: ``residual(x)`` returns r (m,)
    - `slopes`: ``slopes(x)`` returns A = ∂r/∂x (m, n) and the sizes of the terms of r (m,), at the x of the last
      residual
    - `x`, (n,): where the iteration begins
    - `w`, (n,): the weights
    """
    r = residual(x)
    A, terms = slopes(x)
    undefined = ~(np.isfinite(r) & np.isfinite(A).all(axis=1))
    if undefined.any():
        return Newton(x, Ended.UNDEFINED, r, np.flatnonzero(undefined))
    previous = np.inf
    for iteration in range(_ITERATIONS):
        if iteration > 0:
            A, terms = slopes(x)
            if not np.isfinite(A).all():
                break
        B = A * w
        scale = np.maximum(np.linalg.norm(B, axis=1), 1e-300)
        step, is_deficient = least_norm(B / scale[:, None], r / scale)
        left = np.abs(B @ step - r) / scale
        if is_deficient and (left > _ROUNDOFF * np.maximum(np.abs(r), np.minimum(terms, scale)) / scale).any():
            return Newton(x, Ended.DEPENDENT, r, np.array([np.argmax(left)]))
        change, before, norm, part = w * step, x, float(np.abs(r / scale).max(initial=0)), 1.0
        for _ in range(_HALVINGS):
            x = before - part * change
            r = residual(x)
            if np.isfinite(r).all() and float(np.abs(r / scale).max(initial=0)) <= max(2 * norm, _SETTLED):
                break
            part /= 2
        if not np.isfinite(r).all():
            break
        size = float((np.abs(change) / np.maximum(w, np.abs(before))).max(initial=0))
        if size <= _SETTLED or (size < _STAGNATES and size >= 0.5 * previous):
            return Newton(x, Ended.SETTLED, r, np.zeros(0, dtype=int))
        previous = size
    return Newton(x, Ended.DIVERGED, r, np.array([np.argmax(np.where(np.isfinite(r), np.abs(r), np.inf))]))


def least_norm(A: Array, r: Array) -> tuple[Array, bool]:
    """Return the x of least norm with A x = r, or nearest to it, and whether the rows of A depend on each other."""
    if max(A.shape) > _DENSE:
        from scipy.sparse import csc_array

        if (found := by_factors(csc_array(A), r, accuracy=_ROUNDOFF)) is not None:
            return found, False
    x, _, rank, _ = np.linalg.lstsq(A, r, rcond=_RANK)
    return x, bool(rank < len(r))


def by_factors(A: Any, r: Array, metric: Any = None, *, accuracy: float) -> Array | None:
    """Return the x of least xᵀ G x with A x = r, from sparse factors of (G, Aᵀ; A, 0), or of a square A.

    - `A`, (m, n): the rows
    - `r`, (m,): the right-hand side
    - `metric`, (n, n): G. Default: the identity.
    - `accuracy`: the largest permitted A x − r, relative to its terms

    Returns ndarray, (n, ), or None: None if the factors do not determine x to this accuracy.
    """
    from scipy.sparse import block_array, eye_array
    from scipy.sparse.linalg import splu

    m, n = A.shape
    try:
        if m == n and metric is None:
            x = splu(A.tocsc()).solve(r)
        else:
            G = eye_array(n) if metric is None else metric
            whole = block_array([[G, A.T], [A, None]], format="csc")
            x = splu(whole).solve(np.concatenate([np.zeros(n), r]))[:n]
    except RuntimeError:  # singular
        return None
    off = np.abs(A @ x - r) > accuracy * (abs(A) @ np.abs(x) + np.abs(r))
    return np.asarray(x) if np.isfinite(x).all() and not off.any() else None
