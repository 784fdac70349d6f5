"""Effect of the projection onto invariants on sensitivities, transposed.

Where a solution is held on r(t, y, p) = c(p), its sensitivities are moved onto the tangent,

    S ← S − K (R S + ∂r/∂p − c'),

with K = W² Rᵀ (R W² Rᵀ)⁺, or the corrections of the levels, one after the other. A cost ∂G/∂y of S afterwards is the
cost ∂G/∂y − νᵀ R of S before, ν = Kᵀ (∂G/∂y)ᵀ, and νᵀ (c' − ∂r/∂p) besides. c' is R S + ∂r/∂p where the value has been
taken, at the start, after an action or where r jumps, so that ν is carried there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._functions.compiled import CoreFunction, as_python, is_native, to_native
from .._functions.derivatives import Derivative, Given
from .._functions.layout import layout_of
from .._problem.invariants import Invariants
from .._problem.problem import Problem


@dataclass
class _ImposedInvariant:
    """An invariant r = c."""

    about: Invariants  # the invariant as the user defined it
    law: Derivative  # the derivatives of r
    #: (m,): the derivative of the functional with respect to c, for what comes later than the current time
    carried: Array = field(init=False)

    def __post_init__(self) -> None:
        self.carried = np.zeros(self.law.m)

    @property
    def demanded(self) -> bool:
        """True if c is a prescribed number; otherwise it is the value that r had at the start, or after the last
        action."""
        return self.about.value is not None


class Laws:
    """The invariants of a problem, without functions that only fall or rise.

    - `problem`: the problem
    - `k`: number of parameters
    - `derivatives`: makes derivatives of its functions
    - `weights`: y -> the weights of the error test
    """

    def __init__(
        self, problem: Problem, k: int, derivatives: Callable[..., Derivative], weights: Callable[[Array], Array]
    ) -> None:
        self._laws, self._args, self._weights = [], problem.args, weights
        self._k = k
        for one in problem.invariants:
            if one.sense:  # not an equation
                continue
            law = derivatives(one.fun, f"invariant {one.fun}", given=Given.of(one.jac), moves_t=False)
            self._laws.append(_ImposedInvariant(one, law))

    def on_tangent(self, t: float, y: Array, cost: Array, *, taking: bool = False) -> tuple[Array, Array]:
        """A cost before S is moved onto the tangent, and what that adds to the gradient here. `taking`: laws without a
        demanded value take new ones at this point, of S before it is moved."""
        beside = np.zeros(self._k)
        if not self._laws:
            return cost, beside
        rows = [one.law.jacobian(t, y) for one in self._laws]
        nu = self._corrections(t, y, np.vstack(rows)).T @ cost
        parts = np.split(nu, np.cumsum([one.law.m for one in self._laws])[:-1])
        for one, R, own in zip(self._laws, rows, parts, strict=True):
            if one.demanded or not taking:
                cost = cost - R.T @ own
                beside -= own @ one.law.of_parameters(t, y)
                one.carried = one.carried + own
        return self._taken(t, y, cost, beside) if taking else (cost, beside)

    def _taken(self, t: float, y: Array, cost: Array, beside: Array) -> tuple[Array, Array]:
        """Return the costs with the contributions carried by the invariants that take their values at (t, y), and reset
        these."""
        for one in self._laws:
            if not one.demanded:
                cost = cost + one.law.jacobian(t, y).T @ one.carried
                beside = beside + one.carried @ one.law.of_parameters(t, y)
            one.carried = np.zeros(one.law.m)
        return cost, beside

    def _corrections(self, t: float, y: Array, R: Array) -> Array:
        """K, of shape (n, m)."""
        m, n = R.shape
        levels = np.repeat([one.about.level for one in self._laws], [one.law.m for one in self._laws])
        K = np.zeros((n, m))
        for level in np.unique(levels):
            root, upto = self._root(t, y, level), levels <= level
            right = np.where((levels == level)[:, None], np.eye(m) - R @ K, 0)
            K += root @ np.linalg.lstsq(R[upto] @ root, right[upto], rcond=None)[0]
        return K

    def _root(self, t: float, y: Array, level: int) -> Array:
        """D, such that the corrections of a level are D z with the smallest |z|."""
        first = next(one.about for one in self._laws if one.about.level == level)
        moves = np.arange(len(y)) if first.moves is None else np.asarray(first.moves, dtype=int)
        root = np.eye(len(y))[:, moves]
        metric = self._metric(first, t, y, len(moves))
        try:
            if metric is not None:
                return np.asarray(root @ np.linalg.inv(np.linalg.cholesky(metric)).T)
        except np.linalg.LinAlgError:  # not positive definite
            pass
        return np.asarray(root * self._weights(y)[moves])

    def _metric(self, one: Invariants, t: float, y: Array, size: int) -> Array | None:
        """The metric of a level, (size, size)."""
        if one.metric is None:
            return None
        found: Any = one.metric
        if is_native(found) and not isinstance(found, CoreFunction):
            p = layout_of(self._args)
            found = as_python(to_native("metric", found, len(y), size * size, p), size * size)(t, y, p.numbers)
        elif callable(found):
            found = found(t, y.copy(), *self._args)
        found = np.asarray(found, dtype=float)
        return np.diag(found) if found.size == size else found.reshape(size, size)
