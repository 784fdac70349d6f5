"""Reduction of a DAE, by its structure, to an ODE with invariants in levels.

With the offsets c, d the states are x_j^(l), l < d_j: (x_j^(l))' = x_j^(l + 1), and the last of these, x_j^(d_j), are
the solutions of f_i^(c_i) = 0, block after block of the system Jacobian. The equations that were differentiated, and
all that follow from them, hold along the solutions of this ODE: for k = max c, ..., 1 the f_i^(c_i - k) = 0 with
c_i >= k are one level of invariants, which moves the x_j^(d_j - k). Its Jacobian is a part of J, of full rank where J
is regular.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._base.forks import cached_property
from .._functions.graph.differentiation import PIECEWISE_CONSTANT, tangent
from .._functions.graph.nodes import Node, in_order
from .expressions import leaves, primed, row_of, substituted
from .linear_systems import Elimination, solution
from .offsets import Block, Offsets
from .structural_analysis import Arrangement, Structure

#: A derivative of an unknown: its order and the number of the unknown.
Variable = tuple[int, int]


class GivenValues(NamedTuple):
    """An unknown of the user's in terms of the unknowns that are left after aliases: sign x_j^(order)."""

    j: int
    order: int
    sign: float


class Level(NamedTuple):
    """Invariants that are imposed together.

    Attributes
    ----------
    equations : list of Node
        In terms of x_j^(l).
    in_states : list of Node
        The same in terms of the states.
    moves : list of Variable
        What they determine.
    names : list of str
        Their names.
    """

    equations: list[Node]
    in_states: list[Node]
    moves: list[Variable]
    names: list[str]


def nonlinear_blocks(structure: Structure, arrangement: Arrangement) -> set[int]:
    """Return the blocks whose equations are not linear in the x_j^(d_j) that they determine.

    An equation that was differentiated is linear in its highest derivatives; one with c_i = 0 need not be.
    """
    (c, d, _), n, found = arrangement.offsets, structure.n, set()
    for k, block in enumerate(arrangement.blocks):
        unknown = {int(d[j]) * n + j for j in block.columns}
        part = arrangement.part(block.rows, block.columns)
        if any(c[block.rows[a]] == 0 and leaves([node]) & unknown for a, _, node in part):
            found.add(k)
    return found


def raised(structure: Structure, arrangement: Arrangement, which: set[int]) -> Arrangement:
    """Return the arrangement in which these blocks, and all that they need, are differentiated once more.

    What was nonlinear becomes a constraint. Blocks are formed again: more equations are in J.
    """
    waiting, more = [*which], set(which)
    while waiting:
        for k in arrangement.blocks[waiting.pop()].needs:
            if k not in more:
                more.add(k)
                waiting.append(k)
    c, d, match = (one.copy() for one in arrangement.offsets)
    for k in more:
        c[[*arrangement.blocks[k].rows]] += 1
        d[[*arrangement.blocks[k].columns]] += 1
    return structure.arranged(Offsets(c, d, match))


class Reduction:
    """An ODE with invariants that has the solutions of a DAE.

    - `structure`: the equations
    - `nonlinear`: what becomes of blocks that are not linear in what they determine: 'raise' differentiates them once
      more; 'algebraic' leaves them as equations of index 1, under a singular mass matrix

    Attributes:
    - `arrangement`: offsets, J and blocks
    - `states`: the variables of the ODE; algebraic ones are last
    - `algebraic`: how many are algebraic
    - `slopes`: the derivatives of the states, then the residuals of the algebraic equations, in terms of the states
    - `levels`: the invariants
    - `rests`: blocks of J, each with rows of nodes, in terms of the states, whose determinant is that of the block up
      to a constant factor; without blocks that are constant or jump
    """

    def __init__(self, structure: Structure, nonlinear: Literal["raise", "algebraic"]) -> None:
        self.structure, self.n, self.graph = structure, structure.n, structure.graph
        self.arrangement = structure.arrangement
        held = nonlinear_blocks(structure, self.arrangement)
        self.is_nonlinear, self.is_raised = bool(held), False
        if nonlinear == "raise" and held:
            self.arrangement, self.is_raised, held = raised(structure, self.arrangement, held), True, set()
        self._c, self._d, _ = self.arrangement.offsets
        blocks = self.arrangement.blocks
        algebraic = [(int(self._d[j]), j) for k in sorted(held) for j in blocks[k].columns]
        differential = sorted((order, j) for j in range(self.n) for order in range(int(self._d[j])))
        self.states: list[Variable] = differential + algebraic
        self.algebraic = len(algebraic)
        self.place = {one: k for k, one in enumerate(self.states)}
        self._known = {self._leaf(*one): self.graph.y(k) for one, k in self.place.items()}
        self._tops: dict[Variable, list[Node]] = {}  # x_j^(d_j), x_j^(d_j + 1), ... in terms of the states
        self.rests: list[tuple[Block, list[dict[int, Node]]]] = []
        residuals = self._solve_blocks(held)
        self.slopes = self.of([(order + 1, j) for order, j in differential]) + residuals
        self.levels = [self._level(k) for k in range(int(self._c.max(initial=0)), 0, -1)]

    def _leaf(self, order: int, j: int) -> Node:
        return self.graph.y(order * self.n + j)

    def _solve_blocks(self, held: set[int]) -> list[Node]:
        """Solve f_i^(c_i) = 0 for the x_j^(d_j), block after block; return the residuals of those imposed."""
        structure, graph, c, d = self.structure, self.graph, self._c, self._d
        known, residuals = dict(self._known), []
        for k, block in enumerate(self.arrangement.blocks):
            rows, columns, _ = block
            equations = [structure.derivative(structure.equations[i], int(c[i])) for i in rows]
            part = self.arrangement.part(rows, columns)
            matrix: list[dict[int, Node]] = [{} for _ in rows]
            for (a, b, _), node in zip(part, substituted([node for *_, node in part], known), strict=True):
                matrix[a][b] = node
            zeros = {} if k in held else {self._leaf(int(d[j]), j): graph.node(0.0) for j in columns}
            left = substituted(equations, known | zeros)
            elimination = Elimination(graph, matrix, [graph.negative(one) for one in left])
            rest = elimination.rest()
            inside = [*in_order([node for row in rest for node in row.values()])]
            if any(node.op != "number" for node in inside) and not {node.op for node in inside} & PIECEWISE_CONSTANT:
                self.rests.append((block, rest))
            if k in held:
                residuals += left
                for j in columns:
                    self._tops[int(d[j]), j] = [known[self._leaf(int(d[j]), j)]]
                continue
            for j, top in zip(columns, elimination.solution(), strict=True):
                self._tops[int(d[j]), j] = [top]
                known[self._leaf(int(d[j]), j)] = top
        return residuals

    def _level(self, k: int) -> Level:
        structure, c, d = self.structure, self._c, self._d
        which = [i for i in range(self.n) if c[i] >= k]
        equations = [structure.derivative(structure.equations[i], int(c[i]) - k) for i in which]
        return Level(
            equations,
            substituted(equations, self._known),
            [(int(d[j]) - k, j) for j in range(self.n) if d[j] >= k],
            [primed(structure.names[i], int(c[i]) - k) for i in which],
        )

    # ------------------------------------------------------------------------------------------------------------------
    # All variables as functions of (t, states)

    def of(self, variables: Sequence[Variable]) -> list[Node]:
        """Return these x_j^(l) in terms of t and the states."""
        beyond = {j: order - int(self._d[j]) for order, j in sorted(variables)}  # the highest of each, above its top
        for level in range(1, 1 + max(beyond.values(), default=0)):
            chains = [self._tops[int(self._d[j]), j] for j, most in beyond.items() if most >= level]
            chains = [chain for chain in chains if len(chain) == level]
            if chains:
                rates = substituted(tangent([chain[-1] for chain in chains], self._flow), {})
                for chain, rate in zip(chains, rates, strict=True):
                    chain.append(rate)
        return [self._at(*one) for one in variables]

    def _at(self, order: int, j: int) -> Node:
        if (order, j) in self.place:
            return self.graph.y(self.place[order, j])
        top = int(self._d[j])
        return self._tops[top, j][order - top]

    @cached_property
    def _flow(self) -> dict[Node, Node]:
        """d/dt of t and of the states. Those of algebraic ones z, with 0 = f(t, y, z): f_z z' = -f_t - f_y y'."""
        graph, count = self.graph, len(self.states) - self.algebraic
        flow = {graph.t: graph.node(1.0), **{graph.y(k): self.slopes[k] for k in range(count)}}
        if self.algebraic:
            residuals = self.slopes[count:]
            columns = range(count, len(self.states))
            matrix = [{k - count: x for k, x in row_of(one, columns).items()} for one in residuals]
            right = [graph.negative(one) for one in substituted(tangent(residuals, flow), {})]
            flow |= {graph.y(k): x for k, x in zip(columns, solution(graph, matrix, right), strict=True)}
        return flow

    def mass(self) -> Array | None:
        """Return the diagonal of the singular mass matrix, or None without algebraic equations."""
        if not self.algebraic:
            return None
        return np.array([1.0] * (len(self.states) - self.algebraic) + [0.0] * self.algebraic)
