"""The equations of motion as expression graphs, for exact derivatives with respect to states and parameters.

The core evaluates the motion; a graph of it is made of traces of the user's functions, of which

    M v' = Q + Aᵀ λ,   A v' = γ,   A = (Φ K_v, ψ_v),   γ = −(d²φ/ds², dψ/ds) along (t + s, q + s q'), v fixed,

is one linear system for v' and λ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._functions.compiled import CompiledFunction, is_native
from .._functions.graph.differentiation import Row, jacobian, tangent
from .._functions.graph.function import TracedFunction
from .._functions.graph.nodes import Graph, Node
from .._functions.layout import Shape


class OfState(NamedTuple):
    """A user's function of (t, q, *args), or of (t, q, v, *args), and how many values it has."""

    function: Any
    of_v: bool
    size: int

    @property
    def may_be_traced(self) -> bool:
        """Return whether Python can call the function: it is not machine code alone."""
        return isinstance(self.function, CompiledFunction) or not is_native(self.function)


class _InOne:
    """The values of several functions one after the other, as a function of (t, (q, v), *args)."""

    def __init__(self, functions: Sequence[OfState], n_q: int) -> None:
        self._n_q = n_q
        self._functions = [_python(one) for one in functions]
        self._of_v = [one.of_v for one in functions]
        self.__name__ = "mechanism"

    def __call__(self, t: Any, y: Any, *args: Any) -> Any:
        q, v = y[: self._n_q], y[self._n_q :]
        parts = []
        for of_v, function in zip(self._of_v, self._functions, strict=True):
            values = function(t, q, v, *args) if of_v else function(t, q, *args)
            parts.append(np.ravel(np.asarray(values)))
        return np.concatenate(parts)


def _python(one: OfState) -> Any:
    """Return the Python function that underlies a user's function of the state."""
    inside = one.function.fun if isinstance(one.function, CompiledFunction) else one.function
    if not isinstance(one.function, CompiledFunction) or not one.function.inplace:
        return inside
    vectors, size = 1 + one.of_v, one.size

    def returned(t: Any, *given: Any) -> Any:
        out = np.zeros(size)
        inside(t, *given[:vectors], out, *given[vectors:])
        return out

    return returned


class OnTraces(TracedFunction):
    """A function of (t, (q, v), *args) whose graph is made of those of the user's functions.

    - `functions`: the user's functions
    - `n_q`: the length of q
    - `make`: from the values of each function, as nodes, to those of this one
    """

    def __init__(self, functions: Sequence[OfState], n_q: int, make: Callable[[list[list[Node]]], list[Node]]) -> None:
        super().__init__(_InOne(functions, n_q), inplace=False, elementary="own", by="trace")
        self._counts, self._combine = [one.size for one in functions], make

    def _followed(self, shape: Shape) -> list[Node]:
        values = iter(super()._followed(shape._replace(size=sum(self._counts))))
        return self._combine([[next(values) for _ in range(count)] for count in self._counts])


def of_state(one: OfState, n_q: int) -> TracedFunction | None:
    """Return a user's function as one of (t, (q, v), *args); None: it is machine code alone."""
    return OnTraces([one], n_q, lambda values: values[0]) if one.may_be_traced else None


class MotionNodes(NamedTuple):
    """The values of the functions of a motion; `rates` is q'. Of the constraints those that are imposed."""

    graph: Graph
    q: list[Node]
    v: list[Node]
    mass: list[list[Node]]
    force: list[Node]
    phi: list[Node]
    psi: list[Node]
    rates: list[Node]

    def part(self, name: str) -> list[Node]:
        """Return the nodes of (q', v'), φ, φ' or ψ, by the name of the part."""
        if name == "slope":
            return [*self.rates, *self._accelerations()]
        return {"positions": lambda: self.phi, "rates": lambda: self._along(self.phi), "velocities": lambda: self.psi}[
            name
        ]()

    def _along(self, values: Sequence[Node]) -> list[Node]:
        """Return d/ds at (t + s, q + s q'), with v fixed, of these nodes."""
        direction = {self.graph.t: self.graph.node(1.0), **dict(zip(self.q, self.rates, strict=True))}
        return tangent(values, direction)

    def _accelerations(self) -> list[Node]:
        rows, right = self._constrained()
        n, zero = len(self.force), self.graph.node(0.0)
        diagonal = all(self.mass[i][j].is_number(0.0) for i in range(n) for j in range(n) if i != j)
        if diagonal and not rows:
            return [force / self.mass[i][i] for i, force in enumerate(self.force)]
        matrix = [[*self.mass[i], *(-row[i] if i in row else zero for row in rows)] for i in range(n)]
        matrix += [[*(row.get(j, zero) for j in range(n)), *[zero] * len(rows)] for row in rows]
        found = self.graph.solve(matrix, [[one] for one in [*self.force, *right]])
        return [entry for (entry,) in found[:n]]

    def _constrained(self) -> tuple[list[Row], list[Node]]:
        """Return the rows A of the imposed constraints, and γ."""
        rows = jacobian(self.phi, self.q)
        if self.rates is not self.v and rows:
            by_v = jacobian(self.rates, self.v)
            rows = [_product(row, by_v) for row in rows]
        rows += jacobian(self.psi, self.v)
        return rows, [-one for one in [*self._along(self._along(self.phi)), *self._along(self.psi)]]


def _product(row: Row, matrix: list[Row]) -> Row:
    found: Row = {}
    for j, factor in row.items():
        for i, one in matrix[j].items():
            term = factor * one
            found[i] = found[i] + term if i in found else term
    return found


#: Accelerations and multipliers of a system whose derivatives are a graph. The linear system is dense there: 30 of
#: them, a chain of ten links, are compiled in 3 s, 60 in 20 s.
MOST_UNKNOWNS = 36
#: Of which functions the parts of a motion are made.
_PARTS = {
    "slope": ("mass", "force", "constraints", "velocity_constraints", "kinematics"),
    "positions": ("constraints",),
    "rates": ("constraints", "kinematics"),
    "velocities": ("velocity_constraints",),
}


class GraphsOfMotion:
    """The parts of a motion as functions that can be traced.

    - `n_q`, `n_v`: the lengths of q and v
    - `functions`: the user's, by the names of `_PARTS`; those that the motion does not have are of size 0
    - `mass`: M (n_v, n_v), if it is constant. Otherwise a function gives its diagonal or all entries; neither: it is
      sparse, or too large.
    """

    def __init__(self, n_q: int, n_v: int, functions: dict[str, OfState], mass: Array | None = None) -> None:
        self._n_q, self._n_v, self._mass = n_q, n_v, mass
        self.functions = {name: one for name, one in functions.items() if one.size}
        self._made: dict[tuple[str, bytes], OnTraces] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_made": {}}

    def of(self, part: str, kept: Array) -> OnTraces | None:
        """Return a part with the constraints that are `kept`; None: it cannot be traced, or is too large."""
        functions = {name: one for name, one in self.functions.items() if name in _PARTS[part]}
        if part == "slope":
            without_mass = self._mass is None and "mass" not in functions
            if without_mass or self._n_v + np.count_nonzero(kept) > MOST_UNKNOWNS:
                return None
        if not all(one.may_be_traced for one in functions.values()):
            return None
        key = (part, kept.tobytes())
        if key not in self._made:
            kept = kept.copy()

            def values(found: list[list[Node]]) -> list[Node]:
                return self._nodes(dict(zip(functions, found, strict=True)), kept).part(part)

            self._made[key] = OnTraces([*functions.values()], self._n_q, values)
        return self._made[key]

    def _nodes(self, values: dict[str, list[Node]], kept: Array) -> MotionNodes:
        graph = next(iter(values.values()))[0].graph
        q, v = ([graph.y(first + j) for j in range(n)] for first, n in ((0, self._n_q), (self._n_q, self._n_v)))
        phi, psi = values.get("constraints", []), values.get("velocity_constraints", [])
        mass = [] if "mass" not in values else _square(values["mass"], graph, self._n_v)
        return MotionNodes(
            graph=graph,
            q=q,
            v=v,
            mass=mass if self._mass is None else [[graph.node(one) for one in row] for row in self._mass.tolist()],
            force=values.get("force", []),
            phi=[*compress(phi, kept)],
            psi=[*compress(psi, kept[len(kept) - len(psi) :])],
            rates=values.get("kinematics", v),
        )


def _square(values: list[Node], graph: Graph, n: int) -> list[list[Node]]:
    """Return a matrix (n, n) of its entries row by row, or of its diagonal."""
    if len(values) == n * n:
        return [values[i * n : (i + 1) * n] for i in range(n)]
    return [[values[i] if i == j else graph.node(0.0) for j in range(n)] for i in range(n)]
