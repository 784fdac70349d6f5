"""The start of a mechanism in symbols: on its constraints, and which of these are redundant there."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import sympy

from .._base.arguments import Array, choice
from .._base.types import Span
from .._mechanics.system import MechanicalSystem
from .._problem.invariants import Invariants
from .vocabulary import Vocabulary

Consistent: TypeAlias = Literal["check", "project"]
Correction: TypeAlias = Literal["levels", "joint", "none"]


class Mechanism(NamedTuple):
    """M v' = Q + Φᵀ λ, φ = 0, ψ = 0 in the symbols of the code; y = (q, v)."""

    words: Vocabulary
    names: Sequence[str]  # of the constraints, positions first
    positions: Sequence[Any]  # φ
    velocities: Sequence[Any]  # ψ
    mass: Any  # Matrix (n, n)
    force: Sequence[Any]

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.force)

    def start(
        self, t_span: Span, y0: list[float], consistent: Consistent, correction: Correction
    ) -> tuple[list[float], frozenset[str]]:
        """Return the start, projected onto the constraints if that was requested, and names of those to be left out.

        All as `MechanicalSystem` does it, which also says what is wrong.
        """
        choice("consistent", consistent, ("check", "project"))
        n, system = self.n, self._system(np.array(y0[self.n :]))
        given = (t_span, y0[:n], y0[n:], consistent)
        problem = system.problem(*given, correction="levels")
        if correction == "none":  # then nothing else sees an inconsistent start
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # they have been said
                system.problem(*given, correction="none")
        kept = {name for one in problem.invariants for name in one.names or ()}
        return problem.y0.tolist(), frozenset(self.names) - kept

    def _system(self, v0: Array) -> MechanicalSystem:
        n, m = self.n, len(self.positions)
        slopes = [one.diff(x) for one in self.positions for x in self.words.y[:n]]
        rows = self._function(slopes)
        matrix = self._function(list(self.mass))

        def mass(t: float, q: Array, *args: float) -> Array:
            return np.reshape(matrix(t, q, v0, *args), (n, n))

        def jacobian(t: float, q: Array, *args: float) -> Array:
            return np.reshape(rows(t, q, *args), (m, n))

        held, rolled = (
            Invariants(self._function(formulas), names=names) if formulas else None
            for formulas, names in ((self.positions, self.names[:m]), (self.velocities, self.names[m:]))
        )
        force, slopes_of = self._function(self.force), jacobian if m else None
        return MechanicalSystem(mass, force, held, rolled, args=self.words.args, jacobian=slopes_of)

    def _function(self, expressions: Sequence[Any]) -> Callable[..., Array]:
        """Return a function of (t, q, *args) or (t, q, v, *args) that returns the values."""
        n, parameters = self.n, len(self.words.p)
        words = [self.words.t, self.words.y, self.words.p]
        code = sympy.lambdify(words, list(expressions), modules="numpy", cse=True)

        def values(t: Any, q: Array, *rest: Any) -> Array:
            v = rest[0] if len(rest) > parameters else np.zeros(n)
            return np.array(code(t, [*q, *v], rest[len(rest) - parameters :]))

        return values
