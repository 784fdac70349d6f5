"""The combinatorial part of Pryce's Σ-method: assignment, offsets, blocks, and what is wrong if there is no assignment.

J. D. Pryce, A simple structural analysis method for DAEs, BIT 41 (2001) 364-394.
"""

from __future__ import annotations

from graphlib import TopologicalSorter
from typing import NamedTuple

import numpy as np

from .._base.arguments import Array

#: σ_ij of an unknown that is not in an equation.
ABSENT = -(10**6)


class Offsets(NamedTuple):
    """The canonical offsets of a signature matrix.

    Attributes
    ----------
    c, d : ndarray of int, (n,)
        How often equation i has to be differentiated, and the highest derivative of unknown j that the results
        determine.
    match : ndarray of int, (n,)
        The unknown of each equation on the transversal.
    """

    c: Array
    d: Array
    match: Array

    @property
    def freedom(self) -> int:
        """The number of degrees of freedom."""
        return int(self.d.sum() - self.c.sum())


class Surplus(NamedTuple):
    """Equations that contain too few unknowns, and unknowns that are in too few equations."""

    #: equations, of: more equations than there are unknowns in them, and these unknowns
    equations: list[int]
    of: list[int]
    #: unknowns, within: more unknowns than there are equations that contain them, and these equations
    unknowns: list[int]
    within: list[int]


def offsets(sigma: Array) -> Offsets | None:
    """Return the smallest c >= 0, d with d_j - c_i >= σ_ij, with equality on a transversal of highest value.

    None if each transversal has an entry that is absent: the equations are structurally singular.
    """
    from scipy.optimize import linear_sum_assignment

    rows, match = linear_sum_assignment(np.where(sigma > ABSENT, sigma, -(10**5)), maximize=True)
    on_transversal = sigma[rows, match]
    if (on_transversal == ABSENT).any():
        return None
    c = np.zeros(len(sigma), dtype=int)
    while True:
        d = (sigma + c[:, None]).max(axis=0, initial=0)
        following = d[match] - on_transversal
        if (following == c).all():
            return Offsets(c, d, match)
        c = following


def surplus(present: Array) -> Surplus:
    """Return what makes a pattern structurally singular, by the coarse decomposition of Dulmage and Mendelsohn."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    match = maximum_bipartite_matching(csr_array(present.astype(int)), perm_type="column")
    row_of = {int(j): i for i, j in enumerate(match) if j >= 0}
    equations = {i for i, j in enumerate(match) if j < 0}
    unknowns = {j for j in range(present.shape[1]) if j not in row_of}
    while (
        more := {row_of[j] for i in equations for j in np.flatnonzero(present[i]).tolist() if j in row_of} - equations
    ):
        equations |= more
    while more := {int(match[i]) for j in unknowns for i in np.flatnonzero(present[:, j])} - unknowns - {-1}:
        unknowns |= more
    return Surplus(
        sorted(equations),
        sorted({int(j) for i in equations for j in np.flatnonzero(present[i])}),
        sorted(unknowns),
        sorted({int(i) for j in unknowns for i in np.flatnonzero(present[:, j])}),
    )


class Block(NamedTuple):
    """A diagonal block of the system Jacobian."""

    #: rows, columns: its equations, and its unknowns in the order of the transversal
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    needs: tuple[int, ...]  # the numbers of the earlier blocks whose unknowns its equations contain


def blocks(match: Array, entries: list[tuple[int, int]]) -> list[Block]:
    """Return the block triangular form of a pattern with a transversal, in an order in which blocks can be solved."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    n = len(match)
    owner = np.argsort(match)
    edges = np.array([(i, owner[j]) for i, j in entries], dtype=int).reshape(-1, 2)
    graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (n, n))
    count, label = connected_components(graph, connection="strong")
    needs: dict[int, set[int]] = {k: set() for k in range(count)}
    for i, k in label[edges].tolist():
        if i != k:
            needs[i].add(k)
    members: list[list[int]] = [[] for _ in range(count)]
    for i, k in enumerate(label.tolist()):
        members[k].append(i)
    place: dict[int, int] = {}
    found: list[Block] = []
    for k in TopologicalSorter(needs).static_order():
        place[k] = len(found)
        columns = tuple(int(match[i]) for i in members[k])
        found.append(Block(tuple(members[k]), columns, tuple(sorted(place[one] for one in needs[k]))))
    return found
