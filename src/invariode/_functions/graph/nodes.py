"""Nodes: numbers, t, y and parameters, and what is computed of them. Equal nodes of a graph are one node."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

#: Functions of one number: Python's, from `math`.
ELEMENTARY: dict[str, Callable[[float], float]] = {
    **{name: getattr(math, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan")},
    **{name: getattr(math, name) for name in ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh")},
    **{name: getattr(math, name) for name in ("expm1", "log1p", "log10", "log2", "exp2", "cbrt", "erf", "erfc")},
}
ARITHMETIC = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/"}
COMPARISONS = {"less": "<", "less_equal": "<=", "equal": "==", "not_equal": "!="}
_TRUTHS = {*COMPARISONS, "and", "or", "not"}

#: Integer powers up to this one are products.
_MOST_FACTORS = 16


class TraceError(TypeError):
    """Error of a function that cannot be traced and so has no graph; the message gives the reason."""


class Node:
    """A value in a graph: an operation on other nodes, or a number, t, y[i], p[i].

    - `graph`: graph of the node, in which equal nodes are one object
    - `op`: "number", "t", "y", "p"; the names of `ARITHMETIC`, `COMPARISONS`, `ELEMENTARY`; "negate", "power", "atan2",
      "hypot", "modulo", "minimum", "maximum", "abs", "sign", "floor", "ceil", "and", "or", "not", "select"; "solve", a
      linear system, and "entry", a number of its solution
    - `arguments`: nodes that it is computed from
    - `value`: the number, the index in y or p or in the solution, the sizes of a linear system; see `System`
    """

    __slots__ = ("arguments", "graph", "op", "value")

    def __init__(self, graph: Graph, op: str, arguments: tuple[Node, ...], value: Any) -> None:
        self.graph, self.op, self.arguments, self.value = graph, op, arguments, value

    def __repr__(self) -> str:
        if not self.arguments:
            return (
                repr(self.value) if self.op == "number" else self.op + ("" if self.value is None else f"[{self.value}]")
            )
        return f"{self.op}({', '.join(map(repr, self.arguments))})"

    @property
    def is_truth(self) -> bool:
        """True if the node's values are true and false."""
        return self.op in _TRUTHS

    def is_number(self, value: float) -> bool:
        """Return whether the node is the number `value`, with the same sign if it is 0."""
        return self.op == "number" and self.value == value and math.copysign(1, self.value) == math.copysign(1, value)

    def __add__(self, other: Node | float) -> Node:
        return self.graph.sum(self, self.graph.node(other))

    def __radd__(self, other: float) -> Node:
        return self.graph.sum(self.graph.node(other), self)

    def __sub__(self, other: Node | float) -> Node:
        return self.graph.difference(self, self.graph.node(other))

    def __rsub__(self, other: float) -> Node:
        return self.graph.difference(self.graph.node(other), self)

    def __mul__(self, other: Node | float) -> Node:
        return self.graph.product(self, self.graph.node(other))

    def __rmul__(self, other: float) -> Node:
        return self.graph.product(self.graph.node(other), self)

    def __truediv__(self, other: Node | float) -> Node:
        return self.graph.quotient(self, self.graph.node(other))

    def __rtruediv__(self, other: float) -> Node:
        return self.graph.quotient(self.graph.node(other), self)

    def __neg__(self) -> Node:
        return self.graph.negative(self)

    def __pow__(self, exponent: Node | float) -> Node:
        return self.graph.power(self, self.graph.node(exponent))


class LinearSystem(NamedTuple):
    """The value of a linear system A X = B, whose arguments are entries of A, then those of B (k, m), by rows."""

    #: k, m: unknowns, and columns of B
    k: int
    m: int
    #: i k + j of the entries of A that are arguments, ascending, if the others are zero; empty: all are arguments
    places: tuple[int, ...] = ()

    @property
    def entries(self) -> int:
        """Number of entries of A among the arguments."""
        return len(self.places) or self.k * self.k

    def matrix(self, arguments: Sequence[Node]) -> list[dict[int, Node]]:
        """The rows of A: nodes by column."""
        rows: list[dict[int, Node]] = [{} for _ in range(self.k)]
        for place, node in zip(self.places or range(self.k * self.k), arguments, strict=False):
            rows[place // self.k][place % self.k] = node
        return rows

    def right(self, arguments: Sequence[Node]) -> list[Sequence[Node]]:
        """The rows of B."""
        first = self.entries
        return [arguments[first + i * self.m : first + (i + 1) * self.m] for i in range(self.k)]


#: Systems of at least this many unknowns are sparse if at most this part of their entries can differ from zero:
#: elimination with row pivots costs more than sparse factors from there on.
_SPARSE_SYSTEM, _SPARSE_PART = 24, 0.25


class Graph:
    """Makes nodes. Identities are applied only where they are exact in floating point: x·1, x/1, −(−x), x − 0 and
    operations on two numbers; x + 0 is not x if x is −0.

    - `most`: more nodes than this are an error, a TraceError
    """

    def __init__(self, most: int | None = None) -> None:
        self._known: dict[tuple[Any, ...], Node] = {}
        self._most = most
        self.operations = 0  # that were asked for; equal ones are one node

    def __len__(self) -> int:
        return len(self._known)

    def make(self, op: str, *arguments: Node, value: Any = None) -> Node:
        """The node of this operation, without identities."""
        self.operations += 1
        same = repr(value) if op == "number" else value  # 0.0 == -0.0, and NaN is not NaN
        key = (op, same, *map(id, arguments))
        found = self._known.get(key)
        if found is None:
            if self._most is not None and len(self._known) >= self._most:
                raise TraceError(f"more than {self._most} operations")
            found = self._known[key] = Node(self, op, arguments, value)
        return found

    def node(self, value: Node | float) -> Node:
        """A number as a node; a node as it is."""
        return value if isinstance(value, Node) else self.make("number", value=float(value))

    @property
    def t(self) -> Node:
        return self.make("t")

    def y(self, index: int) -> Node:
        return self.make("y", value=index)

    def p(self, index: int) -> Node:
        return self.make("p", value=index)

    def _folded(self, a: Node, b: Node, operation: Callable[[float, float], float]) -> Node | None:
        """The result for two numbers, if Python has one."""
        if a.op != "number" or b.op != "number":
            return None
        try:
            return self.node(operation(a.value, b.value))
        except (ArithmeticError, ValueError):
            return None

    def sum(self, a: Node, b: Node) -> Node:
        if b.op == "negate":
            return self.difference(a, b.arguments[0])
        return self._folded(a, b, lambda x, y: x + y) or self.make("add", a, b)

    def difference(self, a: Node, b: Node) -> Node:
        if b.is_number(0.0):
            return a
        return self._folded(a, b, lambda x, y: x - y) or self.make("subtract", a, b)

    def product(self, a: Node, b: Node) -> Node:
        for one, other in ((a, b), (b, a)):
            if one.is_number(1.0):
                return other
            if one.is_number(-1.0):
                return self.negative(other)
        return self._folded(a, b, lambda x, y: x * y) or self.make("multiply", a, b)

    def quotient(self, a: Node, b: Node) -> Node:
        if b.is_number(1.0):
            return a
        return self._folded(a, b, lambda x, y: x / y) or self.make("divide", a, b)

    def negative(self, a: Node) -> Node:
        if a.op == "number":
            return self.node(-a.value)
        return a.arguments[0] if a.op == "negate" else self.make("negate", a)

    def power(self, base: Node, exponent: Node) -> Node:
        """Small integers as products, and x^½ as a root."""
        size = exponent.value if exponent.op == "number" else math.nan
        if size == 0.5:
            return self.elementary("sqrt", base)
        if not (abs(size) <= _MOST_FACTORS and size == int(size)):
            return self._folded(base, exponent, math.pow) or self.make("power", base, exponent)
        if size == 0:
            return self.node(1.0)
        product, factor, left = None, base, int(abs(size))
        while left:
            if left % 2:
                product = factor if product is None else product * factor
            left //= 2
            factor = factor * factor if left else factor
        assert product is not None
        return product if size > 0 else 1.0 / product

    def elementary(self, name: str, a: Node) -> Node:
        """A function of `ELEMENTARY`."""
        if a.op == "number":
            try:
                return self.node(ELEMENTARY[name](a.value))
            except (ArithmeticError, ValueError):
                pass
        return self.make(name, a)

    def select(self, condition: Node, yes: Node, no: Node) -> Node:
        return yes if yes is no else self.make("select", condition, yes, no)

    def solve(self, matrix: Sequence[Sequence[Node]], right: Sequence[Sequence[Node]]) -> list[list[Node]]:
        """The solution X of A X = B, A of shape (k, k), B of shape (k, m), by rows: by elimination with row pivots."""
        return self.solved(LinearSystem(len(matrix), len(right[0])), [one for row in matrix for one in row], right)

    def solve_sparse(self, matrix: Sequence[Mapping[int, Node]], right: Sequence[Sequence[Node]]) -> list[list[Node]]:
        """The solution X of A X = B, with the entries of each row of A by column: a large system by sparse factors."""
        k, zero = len(matrix), self.node(0.0)
        if k < _SPARSE_SYSTEM or sum(map(len, matrix)) > _SPARSE_PART * k * k:
            return self.solve([[row.get(j, zero) for j in range(k)] for row in matrix], right)
        entries = {i * k + j: row[j] for i, row in enumerate(matrix) for j in sorted(row)}
        return self.solved(LinearSystem(k, len(right[0]), tuple(entries)), [*entries.values()], right)

    def solved(self, system: LinearSystem, matrix: Sequence[Node], right: Sequence[Sequence[Node]]) -> list[list[Node]]:
        """Return the entries, by rows, of the solution X of A X = B with these entries of A and of B."""
        node = self.make("solve", *matrix, *(one for row in right for one in row), value=system)
        k, m = system.k, system.m
        return [[self.make("entry", node, value=i * m + j) for j in range(m)] for i in range(k)]


#: Longer expressions are named by their operation alone.
_LONGEST = 60


def in_words(node: Node, parameters: Mapping[int, str]) -> str:
    """An expression as users would write it, with these names of parameters."""
    if node.op == "number":
        return f"{node.value:g}"
    if node.op == "p":
        return parameters.get(node.value, f"p[{node.value}]")
    if node.op in ("t", "y"):
        return "t" if node.op == "t" else f"y[{node.value}]"
    inside = [in_words(one, parameters) for one in node.arguments]
    symbol = ARITHMETIC.get(node.op) or COMPARISONS.get(node.op) or {"power": "**"}.get(node.op)
    found = f"({f' {symbol} '.join(inside)})" if symbol and len(inside) == 2 else f"{node.op}({', '.join(inside)})"
    return found if len(found) <= _LONGEST else f"{node.op}(...)"


def as_rows(outputs: Sequence[Node]) -> tuple[list[tuple[str, Any, list[int]]], list[int]]:
    """Return a graph as data: (op, value, numbers of the arguments) of its nodes in order, and the numbers of the
    outputs."""
    places: dict[Node, int] = {}
    rows = []
    for node in in_order(outputs):
        rows.append((node.op, node.value, [places[one] for one in node.arguments]))
        places[node] = len(places)
    return rows, [places[one] for one in outputs]


def in_order(nodes: Iterable[Node]) -> Iterator[Node]:
    """Iterate over these nodes and all nodes they are computed from: each once, after its arguments."""
    done: set[int] = set()
    waiting: list[tuple[Node, bool]] = [(node, False) for node in nodes][::-1]
    while waiting:
        node, ready = waiting.pop()
        if id(node) in done:
            continue
        if ready or not node.arguments:
            done.add(id(node))
            yield node
        else:
            waiting.append((node, True))
            waiting.extend((one, False) for one in node.arguments[::-1] if id(one) not in done)
