"""Structural analysis of f_i(t, x_j^(l)) = 0 by Pryce's Σ-method, with repairs where terms cancel.

    σ_ij = the highest derivative of x_j in f_i,   d_j - c_i >= σ_ij, equality on a transversal of highest value;
    J_ij = ∂f_i/∂x_j^(σ_ij) where d_j - c_i = σ_ij, else 0.

The method succeeds where J is regular: then f_i^(c_i) = 0 determine all x_j^(d_j). Where J is singular everywhere, one
equation is replaced by a combination in which its highest derivatives cancel (with u, uᵀ J = 0); where that is not
possible, expressions in which unknowns occur together become new unknowns (with v, J v = 0). Both decrease the value of
the transversal (G. Tan, N. S. Nedialkov, J. D. Pryce, Conversion methods for improving structural analysis of
differential-algebraic equation systems, BIT 57 (2017) 845-865).

An unknown is absent from an equation only if that follows from exact identities. A derivative that vanishes at sampled
points may still be there: of a saturated tanh, say, or of a branch that is not taken.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .._base.arguments import Array
from .._functions.graph.nodes import Node, in_order
from .._functions.graph.rounding import bounds
from .expressions import Sums, TimeDerivatives, Values, in_lowest_terms, is_zero, leaves, primed, row_of, substituted
from .linear_systems import SINGULAR, condition, equilibrated, null_vectors, nullity, solution
from .offsets import ABSENT, Block, Offsets, blocks, offsets, surplus

#: Distances of the generic points from the guess, in units of 1 + |x|: exponentials hide ranks far away from it.
_DISTANCES = (0.01, 0.3, 0.1, 0.03, 0.003, 1e-3, 1e-4)
_PER_DISTANCE, _SEED = 2, 7
#: A derivative is 0 at a generic point if it is below this number of bounds of its roundoff.
_ROUNDOFFS = 64.0
#: Points at which the gap between zero and non-zero singular values is widest decide on null vectors.
_CLEAREST, _AS_CLEAR = 4, 1e-3
#: Numbers that differ by less than this part of the largest are equal.
_EQUAL = 1e-9


class GenericPoints:
    """Points (t, x, x', x'', ...) beside a guess, with as many derivatives as are needed.

    - `t0`: the time of the guess
    - `guess`, (levels, n): the values and derivatives that are known; 0 is the guess of the others
    """

    def __init__(self, t0: float, guess: Array) -> None:
        self.t0, self.n = t0, guess.shape[1]
        self.guess = guess
        self._distances = [s for s in _DISTANCES for _ in range(_PER_DISTANCE)]
        self._random = [np.random.default_rng([_SEED, k]) for k in range(len(self._distances))]
        self.t = [t0 + s * float(rng.uniform()) for s, rng in zip(self._distances, self._random, strict=True)]
        self._levels: list[list[Array]] = [[] for _ in self._distances]

    def __len__(self) -> int:
        return len(self._distances)

    def y(self, k: int, levels: int) -> Array:
        """Return the first `levels` derivatives at point k, one after the other."""
        known = self._levels[k]
        while len(known) < levels:
            at = self.guess[len(known)] if len(known) < len(self.guess) else np.zeros(self.n)
            known.append(at + self._distances[k] * self._random[k].standard_normal(self.n) * (1 + np.abs(at)))
        return np.concatenate(known[:levels]) if levels else np.zeros(0)

    def values(self, nodes: Sequence[Node], parameters: Array, which: Iterable[int] | None = None) -> Iterator[Array]:
        """Yield the values of nodes at these points, by default at all."""
        evaluate = Values(nodes)
        levels = 1 + max(leaves(nodes), default=0) // self.n
        for k in range(len(self)) if which is None else which:
            yield evaluate(self.t[k], self.y(k, levels), parameters)


class Arrangement(NamedTuple):
    """Offsets with their system Jacobian."""

    offsets: Offsets  # c, d and the transversal
    J: dict[tuple[int, int], Node]  # the entries of the system Jacobian, as nodes, by (i, j)
    blocks: list[Block]  # its block triangular form

    def part(self, rows: Sequence[int], columns: Sequence[int]) -> list[tuple[int, int, Node]]:
        """Return the entries of a part of J: row and column in this part, and the node."""
        place, row = {j: b for b, j in enumerate(columns)}, {i: a for a, i in enumerate(rows)}
        return [(row[i], place[j], node) for (i, j), node in self.J.items() if i in row and j in place]


def filled(part: Sequence[tuple[int, int, Node]], rows: int, values: Array, columns: int | None = None) -> Array:
    """Return the matrix with these entries, of these values; square by default."""
    A = np.zeros((rows, rows if columns is None else columns))
    for (a, b, _), value in zip(part, values, strict=True):
        A[a, b] = value
    return A


class Structure:
    """The structure of a system of equations, after repairs.

    - `equations`: f_i, i = 0, ..., n - 1
    - `points`: where it is tested whether matrices are singular
    - `parameters`: the values of the parameters
    - `unknowns`, `names`: names of the x_j and of the f_i

    Attributes:
    - `equations`: the equations after repairs
    - `given`: the equations before repairs
    - `definitions`: the last unknowns, which substitutions introduced, as expressions of the others
    - `sigma`, (n, n): the signature matrix
    - `arrangement`: the canonical offsets, J and its blocks
    - `repairs`: which equations were replaced, in words
    - `derivative`: d/dt of equations

    Raises ValueError: The equations do not determine the unknowns.
    """

    def __init__(
        self,
        equations: Sequence[Node],
        points: GenericPoints,
        parameters: Array,
        unknowns: Sequence[str],
        names: Sequence[str],
    ) -> None:
        self.n, self.unknowns, self.names = len(equations), list(unknowns), list(names)
        self.points, self.parameters = points, parameters
        self.graph = equations[0].graph
        self.derivative = TimeDerivatives(self.n)
        self.repairs: list[str] = []
        self._sums = Sums()
        self.given, self.definitions = list(equations), list[Node]()
        self._made_of: list[dict[tuple[int, int], float | None]] = [{(i, 0): 1.0} for i in range(self.n)]
        self.equations = [self._without_cancelled(one) for one in equations]
        self.sigma = np.full((self.n, self.n), ABSENT)
        self._slopes: list[dict[int, Node | None]] = [{} for _ in range(self.n)]  # ∂f_i/∂x_j^(σ_ij) by j; None: 0
        for i in range(self.n):
            self._sign(i, {})
        while True:  # the value of the transversal decreases with each repair
            self._arrange()
            singular = next((block for block in self.arrangement.blocks if not self._is_regular(block)), None)
            if singular is None:
                break
            if not (self._combine(singular) or self._substitute(singular)):
                raise ValueError(self._numerically_singular(singular))

    # ------------------------------------------------------------------------------------------------------------------
    # Signature and offsets

    def _without_cancelled(self, equation: Node) -> Node:
        """Return the equation in normal form, if that depends on less."""
        combined = self._sums([(1.0, equation)])
        return combined if leaves([combined]) != leaves([equation]) else equation

    def _sign(self, i: int, predicted: dict[int, int]) -> None:
        """Row i of the signature, of the equation after exact identities, such as 0 y' = 0; and without the x_j^(l)
        that are `predicted` {j: l} to cancel, if their derivative is roundoff at all generic points."""
        n = self.n
        self.equations[i] = substituted(self.equations[i : i + 1], {})[0]
        while True:
            order: dict[int, int] = {}
            for place in sorted(leaves(self.equations[i : i + 1])):
                order[place % n] = place // n
            doubtful = [order[j] * n + j for j in order if j in predicted and order[j] >= predicted[j]]
            slopes = row_of(self.equations[i], doubtful)
            gone = [place for place in doubtful if place not in slopes or self._vanishes(slopes[place])]
            if not gone:
                break
            zeros = {self.graph.y(place): self.graph.node(0.0) for place in gone}
            self.equations[i] = substituted(self.equations[i : i + 1], zeros)[0]
        self.sigma[i] = ABSENT
        for j, highest in order.items():
            self.sigma[i, j] = highest
        self._slopes[i] = {}

    def _vanishes(self, node: Node) -> bool:
        levels = 1 + max(leaves([node]), default=0) // self.n
        for k, values in enumerate(self.points.values([node], self.parameters)):
            error = bounds([node], self.points.t[k], self.points.y(k, levels).tolist(), self.parameters.tolist())[0]
            if np.isfinite(values[0]) and abs(values[0]) > _ROUNDOFFS * error:
                return False
        return True

    def _arrange(self) -> None:
        found = offsets(self.sigma)
        if found is None:
            raise ValueError(self._structurally_singular())
        self.arrangement = self.arranged(found)

    def arranged(self, found: Offsets) -> Arrangement:
        """Return J and its blocks for these offsets."""
        c, d, match = found
        J: dict[tuple[int, int], Node] = {}
        for i, known in enumerate(self._slopes):
            tight = np.flatnonzero(self.sigma[i] == d - c[i]).tolist()
            missing = [int(self.sigma[i, j]) * self.n + j for j in tight if j not in known]
            row = row_of(self.equations[i], missing)
            known.update({place % self.n: row.get(place) for place in missing})
            J |= {(i, j): slope for j in tight if (slope := known[j]) is not None}
        return Arrangement(found, J, blocks(match, [*J]))

    def _is_regular(self, block: Block) -> bool:
        """Return whether the block is regular at one of the generic points."""
        return any(condition(A) > SINGULAR for A in self._matrices(block))

    def _matrices(self, block: Block) -> Iterable[Array]:
        """Return the values of a block at the generic points."""
        part = self.arrangement.part(block.rows, block.columns)
        for values in self.points.values([node for *_, node in part], self.parameters):
            yield filled(part, len(block.rows), values)

    # ------------------------------------------------------------------------------------------------------------------
    # Repairs

    def _combine(self, block: Block) -> bool:
        """Replace an equation of a block that is singular everywhere: f_k + Σ u_i f_i^(c_i - c_k), where u solves
        uᵀ J = 0 with u_k = 1, and c_k is the smallest offset of the equations in it. False: none can be replaced."""
        rows, columns = block.rows, block.columns
        c, d, _ = self.arrangement.offsets
        matrices = self._clearest(block)
        for u, support in null_vectors({k: A.T for k, A in matrices.items()}):
            low = int(min(c[rows[a]] for a in support))
            high = {j: int(d[j]) - low for j in columns}
            for a in sorted((a for a in support if c[rows[a]] == low), key=lambda a: -abs(u[a])):
                k, others = rows[a], [rows[b] for b in support if b != a]
                factors = self._multipliers(block, a, [b for b in support if b != a], matrices, of_rows=True)
                derived = [self.derivative(self.equations[i], int(c[i]) - low) for i in others]
                numbers = [self._number(factor, [*matrices]) for factor in factors]
                combined = self._cancelling(k, numbers, derived, high)
                if combined is None:
                    if any(place // self.n >= d[place % self.n] - low for place in leaves(factors)):
                        continue  # the theorem requires factors without the highest derivatives
                    total = self.equations[k]
                    for factor, one in zip(factors, derived, strict=True):
                        total = total + factor * one
                    combined, numbers = substituted([total], {})[0], [None] * len(others)
                self._replace(k, combined, [(i, int(c[i]) - low, x) for i, x in zip(others, numbers, strict=True)])
                self._sign(k, high)
                return True
        return False

    def _substitute(self, block: Block) -> bool:
        """Introduce unknowns w_j = x_j^(d_j - c) - v_j x_l^(d_l - c) in a block that is singular everywhere, where v
        solves J v = 0 with v_l = 1, and c is the largest offset of the equations that contain these x_j^(d_j - c_i).
        Written in terms of w_j these equations no longer contain x_l^(d_l - c_i). False: this is not possible."""
        rows, columns = block.rows, block.columns
        c, d, _ = self.arrangement.offsets
        matrices = self._clearest(block)
        for v, support in null_vectors(matrices):
            together = [columns[b] for b in support]
            within = [i for i in rows if any((i, j) in self.arrangement.J for j in together)]
            high = int(max(c[i] for i in within))
            if any(d[j] < high for j in together):
                continue
            # The theorem requires factors without the x_j^(d_j - c) themselves, and without higher derivatives.
            may = {j: int(d[j]) - high - (j in together or j not in columns) for j in range(self.n)}
            choices = []
            for b in support:
                others = [a for a in support if a != b]
                factors = self._multipliers(block, b, others, matrices, of_rows=False)
                numbers = [self._number(factor, [*matrices]) for factor in factors]
                if (known := [self.graph.node(x) for x in numbers if x is not None]) and len(known) == len(factors):
                    factors = known
                if all(place // self.n <= may[place % self.n] for place in leaves(factors)):
                    divisions = sum(node.op in ("divide", "solve") for node in in_order(factors))
                    choices.append((divisions, -abs(v[b]), columns[b], [columns[a] for a in others], factors))
            if choices:  # without divisions the new unknowns exist everywhere
                _, _, left, replaced, factors = min(choices, key=lambda one: one[:2])
                self._introduce(within, left, replaced, factors, high)
                return True
        return False

    def _introduce(self, rows: Sequence[int], left: int, others: Sequence[int], factors: list[Node], high: int) -> None:
        """Write x_j^(d_j - c_i) = (w_j + v_j x_l^(d_l - c))^(c - c_i) in these rows; see `_substitute`."""
        (c, d, _), n, graph = self.arrangement.offsets, self.n, self.graph
        self.n = n + len(others)
        every = {*leaves([*self.equations, *self.given, *self.definitions, *factors])}
        renumbered = {graph.y(place): graph.y(place // n * self.n + place % n) for place in every}
        self.equations, self.given, self.definitions, factors = (
            substituted(nodes, renumbered) for nodes in (self.equations, self.given, self.definitions, factors)
        )
        self.derivative = TimeDerivatives(self.n)
        common = graph.y((int(d[left]) - high) * self.n + left)
        whole, taken = [], {*self.unknowns}
        for k, (j, factor) in enumerate(zip(others, factors, strict=True)):
            name = next(name for m in range(1, self.n + 1) if (name := f"w{m}") not in taken)
            taken.add(name)
            old = graph.y((int(d[j]) - high) * self.n + j)
            self.definitions.append(substituted([old - factor * common], {})[0])
            self.equations.append(substituted([old - factor * common - graph.y(n + k)], {})[0])
            whole.append(substituted([graph.y(n + k) + factor * common], {})[0])
            self._made_of.append({(n + k, 0): 1.0})
            self.repairs.append(f"{name} = {self._in_words(j, left, factor, high)} is a new unknown")
            self.unknowns.append(name)
            self.names.append(f"definition of {name}")
        for i in rows:
            by = {
                graph.y((int(d[j]) - int(c[i])) * self.n + j): self.derivative(one, high - int(c[i]))
                for j, one in zip(others, whole, strict=True)
            }
            self.equations[i] = self._sums.everywhere(substituted([self.equations[i]], by)[0])
        self.points = GenericPoints(self.points.t0, self.completed(self.points.t0, self.points.guess, self.parameters))
        self.sigma = np.full((self.n, self.n), ABSENT)
        self._slopes = [{} for _ in range(self.n)]
        for i in range(self.n):
            self._sign(i, {left: int(d[left]) - int(c[i])} if i in rows else {})

    def _in_words(self, j: int, left: int, factor: Node, high: int) -> str:
        _, d, _ = self.arrangement.offsets
        one, other = (self._named(k, int(d[k]) - high) for k in (j, left))
        if factor.op != "number":
            return f"{one} - (...) {other}"
        size = "" if abs(factor.value) == 1 else f"{abs(factor.value):.6g} "
        return f"{one} {'+' if factor.value < 0 else '-'} {size}{other}"

    def completed(self, t: float, x: Array, parameters: Array) -> Array:
        """Return the values x_j^(l), (levels, n), with the values of the unknowns that substitutions introduced."""
        levels, first = len(x), self.n - len(self.definitions)
        found = np.zeros((levels, self.n))
        found[:, :first] = x[:, :first]
        for j, definition in enumerate(self.definitions, first):
            nodes = [self.derivative(definition, order) for order in range(levels)]
            room = np.zeros((1 + max(leaves(nodes), default=0) // self.n, self.n))
            known = min(len(room), levels)
            room[:known] = found[:known]
            values = Values(nodes)(t, room.ravel(), parameters)
            found[:, j] = np.where(np.isfinite(values), values, 0.0)
        return found

    def known(self, levels: Array) -> Array:
        """Return how many levels of each unknown are known; `levels`: their numbers for the unknowns before
        substitutions."""
        found = np.concatenate([levels, np.zeros(len(self.definitions), dtype=int)])
        for j, definition in enumerate(self.definitions, len(levels)):
            found[j] = min(found[place % self.n] - place // self.n for place in leaves([definition]))
        levels_known: Array = np.maximum(found, 0)
        return levels_known

    def _clearest(self, block: Block) -> dict[int, Array]:
        """Return the equilibrated block at the points at which its rank is clearest."""
        parts = {}
        for k, A in enumerate(self._matrices(block)):
            if np.isfinite(A).all():
                scaled = equilibrated(A)
                parts[k] = scaled, np.linalg.svd(scaled, compute_uv=False)
        if not parts:
            raise ValueError(f"equations {_list(self.names, block.rows)} cannot be evaluated near the start")
        size, lost = len(block.rows), min(nullity(sizes) for _, sizes in parts.values())
        gaps = {k: 0.0 if lost == size else s[-1 - lost] / max(s[0], 1e-300) for k, (_, s) in parts.items()}
        best = sorted(parts, key=lambda k: -gaps[k])[:_CLEAREST]
        return {k: parts[k][0] for k in best if gaps[k] >= _AS_CLEAR * gaps[best[0]]}

    def _multipliers(
        self, block: Block, k: int, others: Sequence[int], matrices: Mapping[int, Array], of_rows: bool
    ) -> list[Node]:
        """Return u_i with J[k] + Σ u_i J[i] = 0 for rows of a block, or for columns, from one equation for each factor,
        chosen by pivoting."""
        if not others:
            return []
        from scipy.linalg import qr

        A = next(iter(matrices.values()))
        pivots = qr((A if of_rows else A.T)[[*others]], pivoting=True)[2][: len(others)].tolist()
        zero = self.graph.node(0.0)

        def entry(along: int, across: int) -> Node:
            a, b = (along, across) if of_rows else (across, along)
            return self.arrangement.J.get((block.rows[a], block.columns[b]), zero)

        matrix = [{m: x for m, i in enumerate(others) if not is_zero(x := entry(i, j))} for j in pivots]
        found = solution(self.graph, matrix, [self.graph.negative(entry(k, j)) for j in pivots])
        return [in_lowest_terms(one) for one in found]

    def _number(self, node: Node, clear: Sequence[int]) -> float | None:
        """Return the number that a node is at the points where the rank is clear; None: it is not the same at all."""
        values = np.array([one[0] for one in self.points.values([node], self.parameters, clear)])
        if not np.isfinite(values).all() or np.ptp(values) > _EQUAL * np.abs(values).max():
            return None
        found = float(np.median(values))
        whole = float(round(found))
        return whole if abs(found - whole) < _EQUAL * max(abs(found), 1.0) else found

    def _cancelling(
        self, k: int, numbers: Sequence[float | None], derived: Sequence[Node], high: dict[int, int]
    ) -> Node | None:
        """Return the combination with these numbers, if the highest derivatives are gone from its normal form, which
        proves that they cancel."""
        known = [x for x in numbers if x is not None]
        if len(known) < len(numbers):
            return None
        found = self._sums([(1.0, self.equations[k]), *zip(known, derived, strict=True)])
        left = {place % self.n: place // self.n for place in sorted(leaves([found]))}
        return None if any(j in high and order >= high[j] for j, order in left.items()) else found

    def _replace(self, k: int, by: Node, terms: Collection[tuple[int, int, float | None]]) -> None:
        self.equations[k] = by
        for i, order, factor in terms:
            for (given, more), x in self._made_of[i].items():
                key, known = (given, more + order), None if factor is None or x is None else factor * x
                before = self._made_of[k].get(key, 0.0)
                self._made_of[k][key] = None if before is None or known is None else before + known
        self.repairs.append(
            f"{self.names[k]} was replaced by {self.in_given_terms(k)}, in which the highest derivatives cancel"
        )

    # ------------------------------------------------------------------------------------------------------------------
    # Words

    def in_given_terms(self, i: int) -> str:
        """Return equation i as a combination of the given ones, in words."""
        text = ""
        for (given, order), factor in self._made_of[i].items():
            if factor == 0:
                continue
            name = self.names[given] + ("'" * order if order < 4 else f"^({order})")
            size = "(...) " if factor is None else "" if abs(factor) == 1 else f"{abs(factor):.6g} "
            sign = "-" if factor is not None and factor < 0 else "+"
            text += f" {sign} {size}{name}" if text else f"{'-' if sign == '-' else ''}{size}{name}"
        return text

    def _named(self, j: int, order: int) -> str:
        return primed(self.unknowns[j], order)

    def _numerically_singular(self, block: Block) -> str:
        """Return the message for a block that is singular everywhere and that no repair applies to."""
        _, d, _ = self.arrangement.offsets
        highest = [self._named(j, int(d[j])) for j in block.columns]
        return (
            f"the equations {_list(self.names, block.rows)} do not determine {', '.join(highest)}: their matrix is "
            "singular everywhere, since terms cancel, and neither a linear combination nor a substitution with factors "
            "free of these shows what is left. Rewrite the equations: introduce a new unknown for an expression in "
            f"which {' and '.join(highest)} occur together, or leave out an equation that follows from the others"
        )

    def _structurally_singular(self) -> str:
        """Return the message for equations that have no transversal."""
        empty = np.flatnonzero((self.sigma == ABSENT).all(axis=1)).tolist()
        if empty:
            return self._dependent(empty)
        found = surplus(self.sigma > ABSENT)
        return (
            f"the equations do not determine the unknowns. Too many equations: {_list(self.names, found.equations)} "
            f"({len(found.equations)}) contain only {_list(self.unknowns, found.of)} ({len(found.of)}). Too few "
            f"equations: {_list(self.unknowns, found.unknowns)} ({len(found.unknowns)}) "
            + (f"only in {_list(self.names, found.within)} ({len(found.within)})" if found.within else "in none")
        )

    def _dependent(self, empty: Sequence[int]) -> str:
        """Return the message for equations, or combinations of them, that contain no unknown."""
        texts = []
        for i in empty:
            rest = self.equations[i]
            is_redundant = is_zero(rest) or self._vanishes(rest)
            several = len(self._made_of[i]) > 1
            what = f"{self.in_given_terms(i)} contains no unknown" + (
                ": these equations depend on each other" if several else ""
            )
            texts.append(
                f"{what}, and {'one of them is redundant' if several else 'it says nothing (0 = 0)'}"
                if is_redundant
                else f"{what}, and {'they contradict each other' if several else 'it cannot be satisfied'}"
            )
        with_unknowns = [i for i in range(self.n) if i not in empty]
        found = surplus((self.sigma > ABSENT)[with_unknowns])
        unknowns = _list(self.unknowns, found.unknowns)
        if found.unknowns and self._is_up_to_a_constant(found.unknowns):
            verb = "is" if len(found.unknowns) == 1 else "are"
            texts.append(
                f"{unknowns} {verb} determined only up to a constant: replace one equation by one that fixes it (ground"
                f" one, {self.unknowns[found.unknowns[-1]]} = 0)"
            )
        elif found.unknowns:
            texts.append(f"so at least one equation is missing for {unknowns}")
        return "the equations do not determine the unknowns: " + "; ".join(texts)

    def _is_up_to_a_constant(self, which: Sequence[int]) -> bool:
        """Return whether the equations stay true if the same constant is added to these unknowns."""
        n, graph = self.n, self.graph
        for one in self.given:
            row = row_of(one, [j for j in which if j in leaves([one])])
            total = graph.node(0.0)
            for slope in row.values():
                total = total + slope
            if not self._vanishes(self._sums([(1.0, total)])):
                return False
        return n > 0


def _list(names: Sequence[str], which: Iterable[int]) -> str:
    return ", ".join(names[i] for i in sorted(which))
