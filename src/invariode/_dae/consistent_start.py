"""Consistent values of a DAE: the nearest ones to a guess, by Newton's iteration of least norm, stage by stage.

Stage k = max c, ..., 1, 0 solves f_i^(c_i - k) = 0 for x_j^(d_j - k). Its Jacobian is a part of J, of full rank where J
is regular, and earlier stages stay solved. In weights w the smallest change is δ = W (A W)⁺ r.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from .._base.arguments import Array
from .._base.failures import InvariantError
from .._base.forks import cached_property
from .._functions.graph.differentiation import jacobian
from .._functions.graph.nodes import Node, in_order
from .._functions.graph.rounding import bounds
from .._linear.least_norm import Ended, newton
from .expressions import Values, is_zero, leaves, primed, substituted
from .linear_systems import SINGULAR, condition, equilibrated
from .offsets import Block
from .reduction import Reduction, Variable
from .structural_analysis import filled

#: Residuals are roundoff below this part of their terms.
_ROUNDOFF = 1e-9
#: Weights of values that are 0, and of derivatives whose guess is unknown.
_SMALL, _UNKNOWN = 1e-3, 1.0
#: A single number is 0 if it is below this number of bounds of its roundoff.
_ROUNDOFFS = 64.0
#: Entries of a null vector below the first number are roundoff; below that part of the largest they are not named.
_PART_OF_IT, _IN_IT = 1e-6, 0.1


class _UnsolvableError(Exception):
    """A stage has no solution near its guess.

    - `stage`: its equations
    - `is_deficient`: its Jacobian has not the full rank
    """

    def __init__(self, message: str, stage: _Stage, is_deficient: bool = False) -> None:
        super().__init__(message)
        self.stage, self.is_deficient = stage, is_deficient


class ConsistentPoint(NamedTuple):
    """Values of a DAE and of its derivatives."""

    t: float  # the time
    x: Array  # (levels, n): x_j^(l)
    p: Array  # the parameters


class Starts:
    """Consistent values of a reduced DAE.

    Parameters
    ----------
    reduction : Reduction
        The equations.
    first : Starts, optional
        Those of the reduction in which no block is raised: what an equation determines then gives way to what it
        contains besides, whatever the method.
    """

    def __init__(self, reduction: Reduction, first: Starts | None = None) -> None:
        self._reduction, self._first = reduction, first
        structure = reduction.structure
        c, d, _ = reduction.arrangement.offsets
        last = [structure.derivative(structure.equations[i], int(c[i])) for i in range(reduction.n)]
        names = [primed(structure.names[i], int(c[i])) for i in range(reduction.n)]
        stages = [(level.equations, level.moves, level.names) for level in reduction.levels]
        stages.append((last, [(int(d[j]), j) for j in range(reduction.n)], names))
        self._stages = [_Stage(*one, reduction.n) for one in stages]

    @cached_property
    def depend_on_parameters(self) -> bool:
        """True if the states of the reduced problem change with the parameters."""
        reduction = self._reduction
        nodes = [one for stage in self._stages[: None if reduction.algebraic else -1] for one in stage.equations]
        return any(node.op == "p" for node in in_order([*nodes, *reduction.structure.definitions]))

    def nearest(self, guess: ConsistentPoint, known: Array, fixed: Collection[Variable]) -> Array:
        """Return the consistent x_j^(l), l <= d_j, (levels, n), nearest to a guess.

        Parameters
        ----------
        guess : Point
            The guess.
        known : ndarray of int, (n,)
            How many levels of each unknown were given: the others are free to move.
        fixed : collection of Variable
            What may not move.

        Raises
        ------
        InvariantError
            No consistent values exist near the guess, too many values are fixed, or the highest derivatives are not
            determined.
        """
        if self._first is not None:
            guess = guess._replace(x=self._first.nearest(guess, known, fixed))
            known = np.full(len(known), len(guess.x))
        n, top = self._reduction.n, int(self._reduction.arrangement.offsets.d.max(initial=0))
        x = np.zeros((top + 1, n))
        levels = min(len(guess.x), top + 1)
        x[:levels] = guess.x[:levels]
        w = np.maximum(np.abs(x), _SMALL)
        is_guess = np.arange(top + 1)[:, None] >= known
        w[is_guess] = np.maximum(w[is_guess], _UNKNOWN)
        try:
            found = guess._replace(x=x.copy())
            for stage in self._stages:
                stage.solve(found, w, fixed)
        except _UnsolvableError as error:
            if not fixed or not set(fixed) & {one for stage in self._stages for one in stage.moves}:
                raise InvariantError(str(error)) from None
            found = self._together(guess._replace(x=x.copy()), w, fixed)
        self._require_regular(found)
        return found.x

    def _together(self, found: ConsistentPoint, w: Array, fixed: Collection[Variable]) -> ConsistentPoint:
        """Solve all stages at once: values of an early stage give way to fixed ones of a later one."""
        n, d = self._reduction.n, self._reduction.arrangement.offsets.d
        equations = [one for stage in self._stages for one in stage.equations]
        names = [one for stage in self._stages for one in stage.names]
        moves = [(order, j) for j in range(n) for order in range(int(d[j]) + 1)]
        stage = _Stage(equations, moves, names, n)
        try:
            stage.solve(found, w, fixed)
        except _UnsolvableError as error:
            text = self._overdetermined(stage, found, fixed) if error.is_deficient else ""
            raise InvariantError(text or str(error)) from None
        return found

    def _overdetermined(self, stage: _Stage, at: ConsistentPoint, fixed: Collection[Variable]) -> str:
        """Return which fixed values follow from others, and by which equations: rows u with uᵀ A = 0 on what is
        free."""
        _, A = stage.evaluate(at)
        free = [k for k, one in enumerate(stage.moves) if one not in fixed]
        held = [k for k, one in enumerate(stage.moves) if one in fixed]
        scale = np.maximum(np.abs(A).max(axis=1, keepdims=True), 1e-300)
        U, sizes, _ = np.linalg.svd((A / scale)[:, free])
        rank = int((sizes > _ROUNDOFF * sizes.max(initial=0)).sum())
        rows: set[int] = set()
        columns: set[int] = set()
        for u in U[:, rank:].T:
            on = u @ (A / scale)[:, held]
            columns |= {held[k] for k in np.flatnonzero(np.abs(on) > _PART_OF_IT)}
            rows |= set(np.flatnonzero(np.abs(u) > _PART_OF_IT).tolist())
        if not columns:
            return ""
        structure, free_values = self._reduction.structure, self._reduction.arrangement.offsets.freedom
        names = sorted(primed(structure.unknowns[j], order) for order, j in (stage.moves[k] for k in columns))
        several = len(names) > 1
        return (
            f"too many values are fixed at t = {at.t:.6g}: {', '.join(stage.names[i] for i in sorted(rows))} "
            f"{'relate' if len(rows) > 1 else 'relates'} {', '.join(names)}, "
            + ("all of which are fixed, and their values contradict that" if several else "which has another value")
            + f". The equations leave {free_values} value{'s' * (free_values != 1)} free: fix fewer, or correct them"
        )

    def _require_regular(self, at: ConsistentPoint) -> None:
        for one in conditions(self._reduction, at):
            if one.is_singular:
                text = f"the start is a singular point: {one.in_words()}. Start elsewhere"
                raise InvariantError(text)


class BlockCondition(NamedTuple):
    """Measure of how well a block of J determines its unknowns at a point."""

    quality: float  # smallest over largest singular value of the equilibrated block; of one number, its absolute value
    is_singular: bool  # the block is singular to roundoff, or not finite
    reduction: Reduction
    block: Block
    A: Array
    t: float

    def in_words(self, since: str = "") -> str:
        """Return which equations do not, or with ``since="no longer "`` no longer, determine which unknowns."""
        if not np.isfinite(self.A).all():
            which = [self.reduction.structure.names[i] for i in self.block.rows]
            return f"derivatives of {', '.join(which)} are not finite at t = {self.t:.10g}"
        one, several = (
            (f"{since}determines", f"{since}determine") if since else ("does not determine", "do not determine")
        )
        which, what = self._singular_part()
        text = f"{', '.join(which)} {several if len(which) > 1 else one} {', '.join(what)}"
        if len(self.A) == 1:
            return f"{text}: {self._slope()} = {self.A[0, 0]:.3g} at t = {self.t:.10g}"
        return f"{text}: their matrix is singular at t = {self.t:.10g}"

    def lost(self, before: BlockCondition) -> str:
        """Return which equations lost which unknowns since an earlier point where the determinant had another sign."""
        which, what = (before if before.quality < self.quality else self)._singular_part()
        text = f"{', '.join(which)} did not determine {', '.join(what)}"
        if len(self.A) == 1:
            return f"{text} where {self._slope()}, now {self.A[0, 0]:.3g}, was 0"
        return f"{text} where their matrix was singular,"

    def _singular_part(self) -> tuple[list[str], list[str]]:
        """Return the equations and the unknowns with a part in the smallest singular value."""
        structure, (_, d, _) = self.reduction.structure, self.reduction.arrangement.offsets
        rows, columns, _ = self.block
        U, _, V = np.linalg.svd(equilibrated(self.A))
        in_u, in_v = (np.flatnonzero(np.abs(one) > _IN_IT * np.abs(one).max()) for one in (U[:, -1], V[-1]))
        return [structure.names[rows[k]] for k in in_u], [
            primed(structure.unknowns[columns[k]], int(d[columns[k]])) for k in in_v
        ]

    def _slope(self) -> str:
        """Return the name of the entry of a block of one equation."""
        structure, i, j = self.reduction.structure, self.block.rows[0], self.block.columns[0]
        return f"∂{structure.names[i]}/∂{primed(structure.unknowns[j], int(structure.sigma[i, j]))}"


def conditions(reduction: Reduction, at: ConsistentPoint) -> list[BlockCondition]:
    """Return how well each block of J determines its unknowns at a point."""
    found = []
    for block in reduction.arrangement.blocks:
        part = reduction.arrangement.part(block.rows, block.columns)
        nodes = [node for *_, node in part]
        levels = 1 + max(leaves(nodes), default=0) // reduction.n
        x = np.zeros((max(levels, len(at.x)), reduction.n))
        x[: len(at.x)] = at.x
        y = x[:levels].ravel()
        A = filled(part, len(block.rows), Values(nodes)(at.t, y, at.p))
        if len(A) == 1:
            quality = float(abs(A[0, 0]))
            error = bounds(nodes, at.t, y.tolist(), at.p.tolist())[0]
            singular = not quality > _ROUNDOFFS * error
        else:
            quality = condition(A)
            singular = quality < SINGULAR
        found.append(BlockCondition(quality, singular, reduction, block, A, at.t))
    return found


class _Stage:
    """Equations, and the variables that they determine."""

    def __init__(self, equations: Sequence[Node], moves: Sequence[Variable], names: Sequence[str], n: int) -> None:
        self.equations, self.moves, self.names, self._n = list(equations), list(moves), list(names), n
        self._made: tuple[list[tuple[int, int]], Values, int] | None = None

    def _code(self) -> tuple[list[tuple[int, int]], Values, int]:
        if self._made is None:
            graph, n = self.equations[0].graph, self._n
            rows = jacobian(self.equations, [graph.y(order * n + j) for order, j in self.moves])
            places = [(i, k) for i, row in enumerate(rows) for k in sorted(row)]
            slopes = substituted([rows[i][k] for i, k in places], {})
            kept = [(place, slope) for place, slope in zip(places, slopes, strict=True) if not is_zero(slope)]
            nodes = [*self.equations, *(slope for _, slope in kept)]
            levels = 1 + max(leaves(nodes), default=0) // n
            self._made = [place for place, _ in kept], Values(nodes), levels
        return self._made

    def evaluate(self, at: ConsistentPoint) -> tuple[Array, Array]:
        """Return the residuals and their derivatives with respect to all that the stage may move."""
        places, values, levels = self._code()
        room = np.zeros((max(levels, len(at.x)), self._n))
        room[: len(at.x)] = at.x
        found = values(at.t, room[:levels].ravel(), at.p)
        m = len(self.equations)
        A = np.zeros((m, len(self.moves)))
        if places:
            rows, columns = zip(*places, strict=True)
            A[rows, columns] = found[m:]
        return found[:m], A

    def solve(self, at: ConsistentPoint, w: Array, fixed: Collection[Variable]) -> None:
        """Move the x of a point onto the equations, by the smallest change in the weights, without moving what is
        fixed."""
        t, x, _ = at
        free = [k for k, one in enumerate(self.moves) if one not in fixed]
        where = tuple(np.array([self.moves[k] for k in free], dtype=int).reshape(-1, 2).T)

        rows = np.zeros((len(self.equations), len(self.moves)))

        def residual(values: Array) -> Array:
            x[where] = values
            r, rows[:] = self.evaluate(at)  # by one function
            return r if np.isfinite(rows).all() else np.where(np.isfinite(rows).all(axis=1), r, np.nan)

        def slopes(values: Array) -> tuple[Array, Array]:
            return rows[:, free], np.abs(rows) @ np.abs(np.array([x[one] for one in self.moves]))

        found = newton(residual, slopes, x[where], w[where])
        if found.ended is Ended.SETTLED:
            return
        names = ", ".join(self.names[i] for i in found.rows)
        if found.ended is Ended.UNDEFINED:
            raise _UnsolvableError(
                f"{names} cannot be evaluated at the guess, t = {t:.6g}: give other initial values", self
            )
        where_it_is = f"no consistent values near the guess at t = {t:.6g}:"
        value = f"{found.residual[found.rows[0]]:.6g}"
        if found.ended is Ended.DEPENDENT:
            raise _UnsolvableError(
                f"{where_it_is} {names} is {value}, and what may move does not change that (a singular point, or too "
                "many values are fixed)",
                self,
                is_deficient=True,
            )
        raise _UnsolvableError(
            f"{where_it_is} Newton's iteration does not converge, and leaves {names} = {value}. Give better initial "
            "values",
            self,
        )
