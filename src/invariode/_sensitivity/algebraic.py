"""The algebraic equations of a singular mass matrix of index 1.

With Zᵀ M = 0 and M N = 0 they are Zᵀ f(t, y, p) = 0, so that

    Zᵀ (J y' + ∂f/∂t) = 0   and   Zᵀ (J S + ∂f/∂p) = 0,

which together with M y' = f and M S' = J S + ∂f/∂p are equations for all components. M may be a function of t;
Z and N may not, as in the core.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import EPS, Array
from .._base.matrices import as_dense, as_matrix


def dense_mass(mass: Any, t: float, args: tuple[Any, ...]) -> Array | None:
    """M at a time; None: the identity."""
    if mass is None:
        return None
    return as_dense(as_matrix("mass", mass(t, *args) if callable(mass) else mass)).astype(float)


class Algebraic(NamedTuple):
    """The equations of one M.

    Attributes
    ----------
    M : ndarray, (n, n)
        The mass matrix.
    Z, N : ndarray, (n, m)
        Bases of its null spaces.
    """

    M: Array
    Z: Array
    N: Array

    @staticmethod
    def of(M: Array | None) -> Algebraic | None:
        """Return the algebraic equations of a mass matrix, or None if it is regular."""
        if M is None or np.linalg.matrix_rank(M) == len(M):
            return None
        U, sizes, V = np.linalg.svd(M)
        rank = int(np.sum(sizes > sizes[0] * len(sizes) * EPS))
        return Algebraic(M, U[:, rank:], V[rank:].T)

    def rate(self, J: Array, f: Array, ft: Array) -> Array:
        """y'."""
        rows = np.vstack([self.M, self.Z.T @ J])
        return np.asarray(np.linalg.lstsq(rows, np.concatenate([f, -self.Z.T @ ft]), rcond=None)[0])

    def differential(self, J: Array, cost: Array) -> tuple[Array, Array]:
        """The cost c as one in the range of Mᵀ, c + JᵀZ ξ with Nᵀ(c + JᵀZ ξ) = 0, and Z ξ: for all S that satisfy the
        equations, c S = (c + JᵀZ ξ) S + (Z ξ)ᵀ ∂f/∂p."""
        xi = -np.linalg.solve(self.N.T @ J.T @ self.Z, self.N.T @ cost)
        return cost + J.T @ (self.Z @ xi), self.Z @ xi

    def multiplier(self, J: Array) -> Array:
        """The λ of a μ, as a matrix: Mᵀ λ = μ, Nᵀ Jᵀ λ = 0."""
        rows = np.vstack([self.M.T, self.N.T @ J.T])
        return np.linalg.pinv(rows)[:, : len(self.M)]
