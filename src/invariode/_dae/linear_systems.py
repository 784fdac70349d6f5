"""Linear systems of nodes, and how regular matrices are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from .._base.arguments import Array
from .._functions.graph.nodes import Graph, Node
from .expressions import substituted

#: A number is a safe pivot if it is at least this part of the largest number of its row: threshold pivoting.
_SAFE = 0.1
#: Blocks of more rows are tested by sparse factors instead of singular values.
_LARGE = 120
#: Smallest over largest singular value of an equilibrated matrix below which it is singular.
SINGULAR = 1e-11
#: Entries of an echelon form are 0 below the first number, entries of a null vector below the second times the largest.
_ROUNDOFF, _NEGLIGIBLE = 1e-9, 1e-7
#: Iterations of the scaling of rows and columns, which converges by a factor of 4 each.
_SCALINGS = 4


def solution(graph: Graph, matrix: Sequence[Mapping[int, Node]], right: Sequence[Node]) -> list[Node]:
    """Return the x with Σ_j A_ij x_j = b_i, as nodes; the rows of A map columns to nodes."""
    return Elimination(graph, matrix, right).solution()


class Elimination:
    """The partial elimination of a linear system A x = b of nodes, and its way back.

    Entries that are numbers, and of the size of the others in their rows, are pivots at every point: they are
    eliminated as formulas, in Markowitz's order. What is left is one `solve` node.

    - `matrix`: the rows of A map columns to nodes
    - `right`: b
    """

    def __init__(self, graph: Graph, matrix: Sequence[Mapping[int, Node]], right: Sequence[Node]) -> None:
        self.graph = graph
        self.rows: dict[int, dict[int, Node]] = {i: dict(row) for i, row in enumerate(matrix)}
        self.right = list(right)
        self.columns: dict[int, set[int]] = {j: set() for j in range(len(matrix))}  # rows that are left, by column
        for i, row in self.rows.items():
            for j in row:
                self.columns[j].add(i)
        self.pivots: list[tuple[int, int]] = []
        self.left = dict.fromkeys(self.rows)
        self._run()

    def _run(self) -> None:
        """Eliminate while a safe pivot makes no more new entries than the system has rows."""
        candidates = {i: self._best(i) for i in self.left}
        while True:
            found = min((one for one in candidates.values() if one is not None), default=None)
            if found is None or found[0] > 4 * len(self.right):
                return
            _, i, j = found
            changed = self._eliminate(i, j)
            candidates.pop(i)
            # Costs depend on the lengths of columns too: those of rows with the same columns have changed.
            for k in changed | {k for q in self.rows[i] if q in self.columns for k in self.columns[q]}:
                candidates[k] = self._best(k)

    def _best(self, i: int) -> tuple[int, int, int] | None:
        """Return the cheapest safe pivot of a row: (Markowitz's cost, row, column)."""
        row = self.rows[i]
        numbers = {j: abs(x.value) for j, x in row.items() if x.op == "number"}
        largest = max(numbers.values(), default=0.0)
        safe = [j for j, size in numbers.items() if size >= _SAFE * largest and size > 0]
        return min(((len(row) - 1) * (len(self.columns[j]) - 1), i, j) for j in safe) if safe else None

    def _eliminate(self, i: int, j: int) -> set[int]:
        """Eliminate with a pivot; return the rows that have changed."""
        pivot = self.rows[i]
        del self.left[i]
        for q in pivot:
            self.columns[q].discard(i)
        changed = self.columns.pop(j)
        for k in sorted(changed):
            row = self.rows[k]
            factor = row.pop(j) / pivot[j]
            for q, x in pivot.items():
                if q != j:
                    row[q] = row[q] - factor * x if q in row else self.graph.negative(factor * x)
                    self.columns[q].add(k)
            self.right[k] = self.right[k] - factor * self.right[i]
        self.pivots.append((i, j))
        return changed

    def rest(self) -> list[dict[int, Node]]:
        """Return the rows of the matrix that is left, by places among its columns. Its determinant is that of A up to
        a constant factor."""
        place = {j: b for b, j in enumerate(sorted(self.columns))}
        return [{place[j]: self.rows[i][j] for j in sorted(self.rows[i])} for i in self.left]

    def solution(self) -> list[Node]:
        """Return x, as nodes."""
        graph, rows, columns = self.graph, [*self.left], sorted(self.columns)
        found: dict[int, Node] = {}
        if len(rows) == 1:
            found[columns[0]] = self.right[rows[0]] / self.rows[rows[0]][columns[0]]
        elif rows:
            matrix = self.rest()
            solved = graph.solve_sparse(matrix, [[self.right[i]] for i in rows])
            found = {j: one[0] for j, one in zip(columns, solved, strict=True)}
        for i, j in reversed(self.pivots):
            total = self.right[i]
            for q, x in self.rows[i].items():
                if q != j:
                    total = total - x * found[q]
            found[j] = total / self.rows[i][j]
        return substituted([found[j] for j in range(len(self.right))], {})


def equilibrated(A: Array) -> Array:
    """Return the matrix with rows and columns scaled so that their largest entries are about 1."""
    r, s = np.ones(A.shape[0]), np.ones(A.shape[1])
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_SCALINGS):
            sizes = np.abs(r[:, None] * A * s)
            rows, columns = sizes.max(axis=1, initial=0), sizes.max(axis=0, initial=0)
            r /= np.sqrt(np.where(rows > 0, rows, 1))
            s /= np.sqrt(np.where(columns > 0, columns, 1))
        scaled: Array = r[:, None] * A * s
    return scaled


def condition(A: Array) -> float:
    """Return the smallest over the largest singular value of the equilibrated matrix; 0 if that is not finite.

    Of a large matrix a bound from above, the inverse growth of a solution with its sparse factors.
    """
    if not np.isfinite(A).all() or (np.abs(A).max(axis=1, initial=0) == 0).any():
        return 0.0
    scaled = equilibrated(A)
    if not np.isfinite(scaled).all():
        return 0.0
    if len(A) > _LARGE:
        from scipy.sparse import csc_array
        from scipy.sparse.linalg import splu

        try:
            probe = splu(csc_array(scaled)).solve(np.where(np.arange(len(scaled)) % 3 == 0, -1.0, 1.0))
        except RuntimeError:  # singular
            return 0.0
        largest = float(np.abs(probe).max())
        return 1 / largest if np.isfinite(largest) and largest > 0 else 0.0
    sizes = np.linalg.svd(scaled, compute_uv=False)
    return float(sizes[-1] / sizes[0]) if sizes[0] > 0 else 0.0


def orientations(rows: Array, columns: Array, entries: Array, n: int) -> Array:
    """Return the signs of the determinants of n × n matrices, from sparse factors of large ones; 0 or NaN for a
    matrix that is singular or not finite. `entries`, (number of entries, number of matrices), stand in these rows and
    columns, each place once."""
    count = entries.shape[1]
    signs = np.zeros(count)
    if n <= _LARGE:
        together = max(1, 2**20 // n**2)
        for k in range(0, count, together):
            some = entries[:, k : k + together].T
            A = np.zeros((len(some), n, n))
            A[:, rows, columns] = some
            signs[k : k + together] = np.linalg.slogdet(A)[0]
        return signs
    from scipy.sparse import csc_array
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import splu

    places = np.arange(n)
    for k in np.flatnonzero(np.isfinite(entries).all(axis=0)).tolist():
        try:
            factors = splu(csc_array((entries[:, k], (rows, columns)), shape=(n, n)))
        except RuntimeError:  # singular
            continue
        cycles = [
            connected_components(csc_array((np.ones(n), (places, order))))[0]
            for order in (factors.perm_r, factors.perm_c)
        ]
        signs[k] = np.prod(np.sign(factors.U.diagonal())) * (-1) ** sum(cycles)
    return signs


def nullity(sizes: Array) -> int:
    """Return how many of the singular values, the largest first, are 0."""
    return int((sizes <= SINGULAR * sizes[0]).sum())


def null_vectors(matrices: Mapping[int, Array]) -> Iterable[tuple[Array, list[int]]]:
    """Yield vectors v with A v = 0 for the first of the matrices, each with the places at which it is not 0 for at
    least one of them: the rows of the reduced echelon form of the null space, those with the fewest entries first."""
    lost = min(nullity(np.linalg.svd(A, compute_uv=False)) for A in matrices.values())
    spaces = [np.linalg.svd(A)[2][len(A) - lost :] for A in matrices.values()]
    pivots: list[int] = []
    forms = [_echelon_form(space, pivots) for space in spaces]
    first = forms[0]
    for r in sorted(range(len(first)), key=lambda r: int(np.count_nonzero(first[r]))):
        rows = np.array([form[r] for form in forms])
        present = np.abs(rows) > _NEGLIGIBLE * np.abs(rows).max(axis=1, keepdims=True)
        yield first[r], np.flatnonzero(present.any(axis=0)).tolist()


def _echelon_form(space: Array, pivots: list[int]) -> Array:
    """Return the reduced echelon form of a space, given by rows, with these pivot columns. Missing pivots are chosen by
    the largest entries, and appended to `pivots`."""
    N = space.copy()
    for r in range(len(N)):
        if r == len(pivots):
            pivots.append(int(np.argmax(np.abs(N[r:]).max(axis=0))))
        column = pivots[r]
        below = int(np.argmax(np.abs(N[r:, column])))
        N[[r, r + below]] = N[[r + below, r]]
        N[r] /= N[r, column]
        for other in range(len(N)):
            if other != r:
                N[other] -= N[other, column] * N[r]
    N[np.abs(N) < _ROUNDOFF] = 0
    return N
