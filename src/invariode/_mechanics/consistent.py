"""Consistent states of a constrained mechanical system, and which of its constraints are redundant."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import EPS, Array
from .._base.failures import InvariantError
from .._base.matrices import as_dense
from .._functions.increments import sizes, somewhere
from .._linear.least_norm import by_factors
from .motion import DEPENDENT, MANY_COLUMNS, Motion, MotionPoint, lengths, vanishing

#: Gauss-Newton converges quadratically; where the multipliers matter, linearly.
_ITERATIONS = 50
#: A correction of this part of the size of q leaves roundoff.
_SETTLED = 4 * EPS
#: Residuals are roundoff below this part of the terms Φ_ij q_j, as in `impose`, and with room for differences.
_ROUNDOFF = 1e-11
#: How far from q0, in units of its components, the constraints are looked at once more: nearer in long chains, whose
#: components are many times the lengths of their links. Newton's iterations are few where it is near enough.
_BESIDE = (1e-2, 1e-3, 1e-4)
_FEW = 10
_OR_FIXED = " or what is fixed"
#: The rest of a row that depends on others, on the manifold to roundoff.
_REDUNDANT = 1e-8
#: The rest of a row above this is surely not roundoff, though the factors lose half of the digits.
_FAR = 1e-4


def consistent_state(motion: Motion, start: MotionPoint, names: list[str], fixed: Collection[int] = ()) -> MotionPoint:
    """Return the state with φ = 0, φ' = 0, ψ = 0 that is nearest to `start`, in the metric of the mass matrix, and has
    the components of (q, v) in `fixed` of `start`.

    q minimises (q - q0)ᵀ M (q - q0), by Gauss-Newton iterations M (q⁺ - q0) = Φᵀ μ, Φ (q⁺ - q) = -φ; then v in the same
    sense, which is linear. Where q' is not v, or M is not definite, q is the nearest one in the Euclidean sense.
    """
    n = motion.n_q
    free = np.array([i not in fixed for i in range(n + len(start.v))])
    q = _consistent_positions(motion, start, names, free=free[:n])
    at = start._replace(q=q)
    rows = motion.rows(at)
    if not motion.m:
        return at
    change = _least_change(motion.mass(at), rows, -motion.rates(at), free[n:])
    after = at._replace(v=at.v + change)
    left = np.abs(motion.rates(after))
    moving = np.abs(at.v) + np.abs(change)
    terms = np.abs(motion.rates(at)) + abs(rows) @ moving
    # Rates also have roundoff from φ_t and from differences. M couples velocities: each, also one that is 0, has the
    # roundoff of the largest.
    roundoff = _ROUNDOFF * np.asarray(abs(rows).sum(axis=1)) * moving.max(initial=0.0) + np.finfo(float).tiny
    off = left > _ROUNDOFF**0.5 * terms + roundoff
    if off.any():
        i = int(np.flatnonzero(off)[0])
        if i < motion.m_phi and vanishing(rows)[i]:
            raise InvariantError(
                f"{names[i]} changes with t, at the rate {left[i]:.3g} at t = {start.t}, and no velocity changes that: "
                "it does not depend on q, or q0 is a singular position of it. Correct its formula, or start elsewhere"
            )
        raise InvariantError(
            f"no velocities satisfy the constraints at t = {start.t}: the rate of {names[i]} can only be reduced to "
            f"{left[i]:.3g}. The constraints may contradict each other{_OR_FIXED * bool(fixed)}, or be singular at "
            "this position: check their formulas, or start from another q0"
        )
    return after


def _consistent_positions(
    motion: Motion, start: MotionPoint, names: list[str], nearest: bool = True, free: Array | None = None
) -> Array:
    """Return the q of `consistent_state`, of which only the components in `free` change; without `nearest` some
    consistent q nearby, by Newton's iteration."""
    if not motion.m_phi:
        return start.q
    t, q0 = start.t, start.q
    weight = _identity(motion.n_q) if motion.has_map else motion.mass(start)
    q = q0
    for _ in range(_ITERATIONS if nearest else _FEW):
        residual, rows = motion.positions(start._replace(q=q)), motion.positions_jacobian(start._replace(q=q))
        if not (np.isfinite(residual).all() and np.isfinite(_entries(rows)).all()):
            break
        if not nearest and not _off(residual, rows, q, q0).any():
            break
        base = q0 if nearest else q
        after = base + _least_change(weight, rows, rows @ (q - base) - residual, free)
        moved = np.abs(after - q).max(initial=0.0)
        q = after
        if moved <= _SETTLED * sizes(q).max(initial=0.0):
            break
    residual, rows = motion.positions(start._replace(q=q)), motion.positions_jacobian(start._replace(q=q))
    off = _off(residual, rows, q, q0)
    if off.any():
        i = int(np.argmax(np.abs(residual) * off))
        if vanishing(rows)[i]:
            raise InvariantError(
                f"{names[i]} is {residual[i]:.6g} at t = {t}, and changing q does not affect it: either it does "
                "not depend on q, "
                "or q0 is a singular position of it. Correct its formula, or start from another q0"
            )
        or_fixed = _OR_FIXED * (free is not None and not free.all())
        raise InvariantError(
            f"no position near q0 satisfies the constraints at t = {t}: {names[i]} is {residual[i]:.6g} at the best "
            f"one found. The constraints may contradict each other{or_fixed}: check them, or start from a q0 nearer to "
            "a solution"
        )
    return q


def _off(residual: Array, rows: Any, q: Array, q0: Array) -> Array:
    """Return which residuals are more than roundoff, (m,)."""
    roundoff: Array = _ROUNDOFF * (abs(rows) @ sizes(q) + abs(rows) @ sizes(q0))
    off: Array = ~(np.abs(residual) <= roundoff)
    return off


def _least_change(weight: Any, rows: Any, right: Array, free: Array | None = None) -> Array:
    """Return the x of least xᵀ W x with A x = right, zero but for the components in `free`; where W does not determine
    it, of least norm."""
    n = rows.shape[1]
    if free is not None and not free.all():
        some = np.zeros(n)
        some[free] = _least_change(as_dense(weight)[np.ix_(free, free)], as_dense(rows)[:, free], right)
        return some
    if hasattr(weight, "toarray") and hasattr(rows, "toarray"):
        found = by_factors(rows, right, weight, accuracy=_ROUNDOFF)
        if found is not None:
            return found
    A = np.ascontiguousarray(as_dense(rows))
    for metric in (weight, _identity(n)):
        solution = _core.solve_saddle(np.ascontiguousarray(as_dense(metric)), A, np.zeros(n), right, DEPENDENT)
        change: Array = solution[0]
        if solution[-1]:  # unique
            break
    return change


def _identity(n: int) -> Any:
    """Return the identity matrix (n, n), sparse if it is large."""
    if n < MANY_COLUMNS:
        return np.eye(n)
    from scipy.sparse import eye_array

    return eye_array(n, format="csr")


def _entries(matrix: Any) -> Array:
    """Return the stored entries of a sparse matrix, or a dense matrix."""
    return np.asarray(matrix.data if hasattr(matrix, "toarray") else matrix)


def nearby_state(motion: Motion, at: MotionPoint, names: list[str]) -> MotionPoint:
    """Return a consistent state beside a consistent one, where nothing is singular by chance; that one, if none is
    found."""
    direction = somewhere(at.q)
    for part in _BESIDE:
        try:
            beside = at._replace(q=at.q + part * direction)
            return at._replace(q=_consistent_positions(motion, beside, names, nearest=False))
        except InvariantError:
            continue
    return at


def _surely_independent(rows: Any) -> bool:
    """Return whether Cholesky's factors of A Aᵀ, rows of norm 1, show each row far from those before it, in some
    order."""
    size = lengths(rows)
    if not size.all():
        return False
    if hasattr(rows, "toarray"):
        return _surely_independent_sparse(rows, size)
    unit = rows / size[:, None]
    try:
        pivots = np.diag(np.linalg.cholesky(unit @ unit.T))
    except np.linalg.LinAlgError:
        return False
    return bool((pivots > _FAR).all())


def _surely_independent_sparse(rows: Any, size: Array) -> bool:
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    unit = diags_array(1 / size) @ rows
    try:  # pivots on the diagonal alone: those of L D Lᵀ, in an order with little fill
        factors = splu(
            (unit @ unit.T).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError:  # singular
        return False
    on_diagonal = bool((factors.perm_r == factors.perm_c).all())
    return on_diagonal and bool((factors.U.diagonal() > _FAR**2).all())


def dependent_rows(rows: Any, order: Iterable[int] | None = None) -> Array:
    """Return which rows depend on those before them, in the given order, as truths (m,)."""
    m = rows.shape[0]
    dependent = np.zeros(m, dtype=bool)
    if m >= MANY_COLUMNS and _surely_independent(rows):
        return dependent
    rows = as_dense(rows)
    basis = np.zeros((0, rows.shape[1]))
    for i in range(m) if order is None else order:
        length = float(np.linalg.norm(rows[i]))
        rest = rows[i] / length if length > 0 else rows[i]
        for _ in range(2):  # twice is enough
            rest = rest - basis.T @ (basis @ rest)
        left = float(np.linalg.norm(rest))
        dependent[i] = left <= _REDUNDANT
        if not dependent[i]:
            basis = np.vstack([basis, rest / left])
    return dependent


def redundant_rows(here: Any, beside: Any) -> Array:
    """Return which rows depend on others wherever the motion goes: beside, where nothing is singular by chance.

    Those that are independent here are taken first: at a singular position a choice among those of beside alone may
    leave out a row that is needed here, and keep one that is 0.
    """
    dependent = dependent_rows(here)
    return dependent_rows(beside, [*np.flatnonzero(~dependent), *np.flatnonzero(dependent)])
