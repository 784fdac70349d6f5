"""Functions that follow from the graph of a function of (t, y, *args): its exact derivatives, compiled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..._base.forks import cached_property
from ..compiled import NativeWithInputs, made_by_compile, to_native
from ..layout import NO_ARGUMENTS, ArgumentLayout, Shape
from .differentiation import Row, dependences, gradient, jacobian, tangent, tangents
from .function import GraphFunction, OnGraph
from .nodes import Node, in_order
from .python import Formula, Pattern
from .switching_times import Crossing, timed

#: How these functions were compiled.
DERIVED = "derived"
#: ∂/∂y is formed by products with unit vectors if it has more terms than the first number, and more than the second
#: times the nodes of the function: its code would take long to compile. Unless
#: all products take longer than the third times the operations that they replace.
_MOST_TERMS, _MANY_TIMES, _LONGER = 10_000, 4, 16


class Derived:
    """The derivatives of a function of t, y (n,) and parameters.

    - `name`: name of the function
    - `outputs`: values of the function
    - `n`: number of components of y
    - `elementary`: as in `compile`

    Attributes:
    - `outputs`, `elementary`: as given
    """

    def __init__(self, name: str, outputs: Sequence[Node], n: int, elementary: str) -> None:
        self._name, self.outputs, self._n, self.elementary = name, outputs, n, elementary
        self._graph = outputs[0].graph
        self._made: dict[tuple[Any, ...], GraphFunction] = {}

    @property
    def _y(self) -> list[Node]:
        return [self._graph.y(j) for j in range(self._n)]

    @cached_property
    def rows(self) -> list[Row]:
        """The rows of ∂/∂y: what is in no row is zero everywhere."""
        y = self._y
        found = [gradient(self.outputs[0], y)] if len(self.outputs) == 1 else jacobian(self.outputs, y)
        return [{j: one for j, one in row.items() if one.op != "number" or one.value != 0} for row in found]

    @cached_property
    def timed(self) -> list[Crossing]:
        """The conditions that depend on t and not on y."""
        return timed(self.outputs)

    @cached_property
    def _dependences(self) -> tuple[list[int], int]:
        return dependences(self.outputs, self._y)

    @cached_property
    def _size(self) -> int:
        """Number of nodes of the function's graph."""
        return sum(1 for _ in in_order(self.outputs))

    @property
    def _is_large(self) -> bool:
        """True if the code of all entries is too much longer than that of a product to be formed."""
        terms = self._dependences[1]
        return terms > _MOST_TERMS and terms > _MANY_TIMES * self._size

    def is_product(self, columns: int) -> bool:
        """Return whether ∂/∂y is formed by products with the unit vectors of this number of groups of columns."""
        return self._is_large and columns * self._size <= _LONGER * self._dependences[1]

    @cached_property
    def widest(self) -> int:
        """The most entries in a row."""
        return max((one.bit_count() for one in self._dependences[0]), default=0)

    @cached_property
    def pattern(self) -> Pattern:
        """Pattern of ∂/∂y: its entries that can be nonzero."""
        if not self._is_large:
            return Pattern.of(self.rows, self._n)
        one = self._graph.node(1.0)
        rows = [{j: one for j in range(self._n) if mask >> j & 1} for mask in self._dependences[0]]
        return Pattern.of(rows, self._n)

    @property
    def entries(self) -> int:
        """Number of entries of ∂/∂y that can be nonzero."""
        return len(self.pattern.indices) if self._n == len(self.outputs) else sum(map(len, self.rows))

    @cached_property
    def bands(self) -> tuple[int, int]:
        """Lower and upper bandwidth of ∂/∂y."""
        away = [i - j for i, row in enumerate(self.rows) for j in row]
        return max(away, default=0), -min(away, default=0)

    @cached_property
    def shifted(self) -> Derived | None:
        """The derivative along y of n values of (y, z_1, z_2, …), of (t, (y, z, s)) with s_j = ∂z_j/∂y, one number for
        each delay; None: its code would be too long."""
        return None if self._is_large else _Shifted(self._name, self)

    def dense(self) -> GraphFunction:
        """∂/∂y by rows."""
        return self._filled("dense", len(self.rows) * self._n, lambda i, j: i * self._n + j)

    def banded(self, lower: int, upper: int) -> GraphFunction:
        """Return the function of the bands of ∂/∂y, as LAPACK packs them; entries outside are left out."""
        return self._filled(
            ("banded", lower, upper),
            (lower + upper + 1) * self._n,
            lambda i, j: (upper + i - j) * self._n + j if -upper <= i - j <= lower else None,
        )

    def sparse(self) -> GraphFunction:
        """Return the function of the nonzero entries of ∂/∂y, in the order of `pattern`."""
        order = self.pattern.places()
        return self._function("sparse", lambda: [self.rows[i][j] for i, j in order])

    def by_rows(self) -> GraphFunction:
        """Return the function of the nonzero entries of ∂/∂y, row by row."""
        return self._function("by_rows", lambda: [row[j] for row in self.rows for j in sorted(row)])

    @property
    def row_pattern(self) -> tuple[list[int], list[int]]:
        """Pattern of ∂/∂y in compressed rows: the start of each row among the entries, and their columns."""
        starts = [0]
        for row in self.rows:
            starts.append(starts[-1] + len(row))
        return starts, [j for row in self.rows for j in sorted(row)]

    def product(self) -> GraphFunction:
        """∂/∂y times v, of (t, (y, v))."""
        along = {y: self._graph.y(self._n + j) for j, y in enumerate(self._y)}
        return self._function("product", lambda: tangent(self.outputs, along))

    def rate(self) -> GraphFunction:
        """∂/∂t."""
        return self._function("rate", lambda: tangent(self.outputs, {self._graph.t: self._graph.node(1.0)}))

    @property
    def _direction(self) -> dict[Node, Node]:
        """(dt, dy), after y."""
        graph, n = self._graph, self._n
        return {graph.t: graph.y(n), **{y: graph.y(n + 1 + j) for j, y in enumerate(self._y)}}

    def slope(self) -> GraphFunction:
        """d/ds of the function at (t + s dt, y + s dy), s = 0, of (t, (y, dt, dy))."""
        return self._function("slope", lambda: tangent(self.outputs, self._direction))

    def curvature(self) -> GraphFunction:
        """d²/ds² of the same."""
        return self._function("curvature", lambda: tangent(tangent(self.outputs, self._direction), self._direction))

    def tangents(self, places: Sequence[int | None]) -> GraphFunction:
        """∂/∂y S_j + ∂/∂p_j for each parameter, given by its place (None: an initial value, of which the function does
        not know), of (t, (y, S_1, S_2, ...)): one pass for all columns, which share what they have in common."""
        graph, n = self._graph, self._n

        def values() -> list[Node]:
            start: dict[Node, Row] = {}
            for i, y in enumerate(self._y):
                start[y] = {j: graph.y(n + j * n + i) for j in range(len(places))}
            for j, place in enumerate(places):
                if place is not None:
                    start.setdefault(graph.p(place), {})[j] = graph.node(1.0)
            rows = tangents(self.outputs, start)
            return [row.get(j, graph.node(0.0)) for j in range(len(places)) for row in rows]

        return self._function(("tangents", *places), values)

    def transposed(self, places: Sequence[int | None]) -> GraphFunction:
        """(∂/∂y)ᵀ w, then wᵀ ∂/∂p for each parameter in these places, of (t, (y, w)): backwards through the graph, so
        that many parameters cost little more than one."""
        graph, n = self._graph, self._n

        def values() -> list[Node]:
            weighted = graph.node(0.0)
            for i, one in enumerate(self.outputs):
                weighted = weighted + graph.y(n + i) * one
            variables = [*self._y, *(graph.p(at) for at in places if at is not None)]
            row, zero = gradient(weighted, variables), graph.node(0.0)
            own = iter(range(n, len(variables)))
            by_parameter = [zero if at is None else row.get(next(own), zero) for at in places]
            return [*(row.get(i, zero) for i in range(n)), *by_parameter]

        return self._function(("transposed", *places), values)

    def along(self, places: Sequence[int | None]) -> GraphFunction:
        """d/ds of the function at (t + s dt, y + s dy, p + s dp), s = 0, of (t, (y, dt, dy, dp)), with the parameters
        in these places."""
        graph, n = self._graph, self._n

        def values() -> list[Node]:
            moving = {graph.p(at): graph.y(2 * n + 1 + j) for j, at in enumerate(places) if at is not None}
            return tangent(self.outputs, self._direction | moving)

        return self._function(("along", *places), values)

    def _filled(self, key: Any, size: int, place: Any) -> GraphFunction:
        def values() -> list[Node]:
            found = [self._graph.node(0.0)] * size
            for i, row in enumerate(self.rows):
                for j, one in row.items():
                    if (at := place(i, j)) is not None:
                        found[at] = one
            return found

        return self._function(key, values)

    def _function(self, key: Any, outputs: Any) -> GraphFunction:
        """Return the function with this key, made once, so that its machine code is made once too."""
        if key not in self._made:
            values = outputs()
            name = key if isinstance(key, str) else key[0]
            formula = Formula(f"{self._name}_{name}", lambda: values, (len(values),))
            self._made[key] = GraphFunction(formula, self.elementary, how=DERIVED)
        return self._made[key]


class _Shifted(Derived):
    """∂/∂y + Σ s_j ∂/∂z_j of a function of (t, (y, z_1, z_2, …))."""

    def __init__(self, name: str, of: Derived) -> None:
        super().__init__(f"{name}_shifted", of.outputs, len(of.outputs), of.elementary)
        self._of = of

    @cached_property
    def rows(self) -> list[Row]:
        """The rows, of the components of y."""
        n, first = self._n, self._of._n
        found: list[Row] = []
        for row in self._of.rows:
            own = {j: one for j, one in row.items() if j < n}
            for j, one in row.items():
                if j >= n:
                    delay, i = divmod(j - n, n)
                    shifted = self._graph.y(first + delay) * one
                    own[i] = own[i] + shifted if i in own else shifted
            found.append(own)
        return found

    @property
    def _is_large(self) -> bool:
        return False


def derived(fun: Any, n: int, size: int, parameters: ArgumentLayout = NO_ARGUMENTS, second: int = 0) -> Derived | None:
    """The derivatives of a function with `size` values. None: it is not compiled, or has no graph.

    Raises TypeError: It had to be traced, and cannot be.
    """
    if isinstance(fun, NativeWithInputs):
        return derived(fun.fun, n, size, fun.arguments(parameters), second)
    if not isinstance(fun, OnGraph):
        return None
    shape = fun.known(Shape(n, size, parameters, False, second))
    if shape not in fun.exact:
        outputs = fun.graph(shape)
        fun.exact[shape] = Derived(fun.__name__, outputs, n, fun.elementary) if outputs else None
    found: Derived | None = fun.exact[shape]
    return found


def is_derived(fun: Any) -> bool:
    """Return whether `fun` is a derivative that was made for the core."""
    made = made_by_compile(fun)
    return made is not None and made.function.how == DERIVED


def native(made: GraphFunction, fun: Any, n: int, size: int, parameters: int) -> Any:
    """Return a derivative of a function of so many parameters for the core, with the inputs of the function."""
    form = fun._replace(fun=made) if isinstance(fun, NativeWithInputs) else made
    return to_native(made.__name__, form, n, size, ArgumentLayout.single(parameters))
