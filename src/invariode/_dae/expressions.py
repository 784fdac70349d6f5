"""Expressions of a DAE: nodes of a graph in which y(l n + j) is x_j^(l), the l-th derivative of unknown j of n."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from .._base.arguments import Array
from .._functions.graph.differentiation import jacobian, tangent
from .._functions.graph.nodes import Graph, Node, in_order
from .._functions.graph.python import Formula

#: A coefficient of a sum below this part of the terms it consists of is roundoff of 0.
_CANCELLED = 1e-14


def leaves(nodes: Iterable[Node]) -> set[int]:
    """Return the numbers of the y on which the nodes depend."""
    return {node.value for node in in_order(nodes) if node.op == "y"}


def is_zero(node: Node) -> bool:
    """Return whether the node is the number 0."""
    return node.op == "number" and node.value == 0


def substituted(outputs: Sequence[Node], by: Mapping[Node, Node]) -> list[Node]:
    """Return the nodes with leaves replaced, and with what follows from zeros: x 0 = 0, x + 0 = x, 0 / x = 0.

    These identities hold for numbers, not for NaN and infinity: graphs themselves do not apply them.
    """
    made: dict[Node, Node] = {}
    for node in in_order(outputs):
        if node in by:
            made[node] = by[node]
        else:
            a = [made[one] for one in node.arguments]
            made[node] = _simplified(node, a)
    return [made[one] for one in outputs]


def _simplified(node: Node, a: list[Node]) -> Node:
    graph, op = node.graph, node.op
    zeros = [is_zero(one) for one in a]
    if (op == "multiply" and any(zeros)) or (op == "divide" and zeros[0] and not zeros[1]):
        return graph.node(0.0)
    if op == "add" and any(zeros):
        return a[1] if zeros[0] else a[0]
    if op == "subtract" and a[0] is a[1]:
        return graph.node(0.0)
    if op in ("add", "subtract") and zeros[0]:
        return graph.negative(a[1])
    if all(one is old for one, old in zip(a, node.arguments, strict=True)) and op not in _MADE:
        return node
    if op in _MADE:
        return _MADE[op](graph, *a)
    if len(a) == 1 and node.value is None and a[0].op == "number":
        return graph.elementary(op, a[0])
    return graph.make(op, *a, value=node.value)


#: Operations for which graphs know identities.
_MADE: dict[str, Callable[..., Node]] = {
    "add": Graph.sum,
    "subtract": Graph.difference,
    "multiply": Graph.product,
    "divide": Graph.quotient,
    "negate": Graph.negative,
    "power": Graph.power,
    "select": Graph.select,
}


def in_lowest_terms(node: Node) -> Node:
    """Return a quotient without the factors that its numerator and its denominator share."""
    powers: dict[Node, int] = {}
    number, waiting = 1.0, [(node, 1)]
    while waiting:
        one, power = waiting.pop()
        a = one.arguments
        if one.op == "negate":
            number = -number
            waiting.append((a[0], power))
        elif one.op in ("multiply", "divide"):
            waiting += [(a[1], power if one.op == "multiply" else -power), (a[0], power)]
        elif one.op == "number" and one.value != 0:
            number = number * one.value if power > 0 else number / one.value
        else:
            powers[one] = powers.get(one, 0) + power
    above, below = node.graph.node(number), node.graph.node(1.0)
    for one, power in powers.items():
        for _ in range(power):
            above = above * one
        for _ in range(-power):
            below = below * one
    return substituted([above / below], {})[0]


def _is_sum(node: Node) -> bool:
    """Return whether normal forms take the node apart: a linear combination."""
    a = node.arguments
    return (
        node.op in ("add", "subtract", "negate")
        or (node.op == "multiply" and "number" in (a[0].op, a[1].op))
        or (node.op == "divide" and a[1].op == "number" and a[1].value != 0)
    )


class Sums:
    """Linear combinations in normal form: Σ c_k u_k with numbers c_k and different u_k that are no sums.

    Terms that cancel in exact arithmetic are gone from the normal form, so that it depends on no more than it has to.
    Factors of products are sorted, in the order in which they were first met, so that a b and b a are one.
    """

    def __init__(self) -> None:
        self._order: dict[Node, int] = {}

    def __call__(self, parts: Sequence[tuple[float, Node]]) -> Node:
        """Return Σ c u of pairs (c, u), flattened."""
        terms, sizes, graph = self.terms(parts), {}, parts[0][1].graph
        total = graph.node(0.0)
        for node, (x, size) in terms.items():
            sizes[node] = size
            if abs(x) > _CANCELLED * size:
                total = total + node * x
        return substituted([total], {})[0]

    def everywhere(self, node: Node) -> Node:
        """Return the node with all sums in it in normal form, those inside functions too."""
        made: dict[Node, Node] = {}
        for one in in_order([node]):
            a = [made[k] for k in one.arguments]
            if not _is_sum(one):
                a = [self([(1.0, k)]) if _is_sum(k) else k for k in a]
            made[one] = _simplified(one, a)
        return self([(1.0, made[node])])

    def terms(self, parts: Sequence[tuple[float, Node]]) -> dict[Node, tuple[float, float]]:
        """Return the u_k with their c_k, and with Σ |c| over the terms that were put together."""
        found: dict[Node, tuple[float, float]] = {}
        waiting = [*reversed(parts)]
        while waiting:
            x, node = waiting.pop()
            a = node.arguments
            if node.op in ("add", "subtract"):
                waiting += [(x if node.op == "add" else -x, a[1]), (x, a[0])]
            elif node.op == "negate":
                waiting.append((-x, a[0]))
            elif node.op == "multiply" and "number" in (a[0].op, a[1].op):
                k = 0 if a[0].op == "number" else 1
                waiting.append((x * a[k].value, a[1 - k]))
            elif node.op == "divide" and a[1].op == "number" and a[1].value != 0:
                waiting.append((x / a[1].value, a[0]))
            else:
                if node.op == "multiply":
                    node = node.graph.product(*sorted(a, key=lambda one: self._order.setdefault(one, len(self._order))))
                before, size = found.get(node, (0.0, 0.0))
                found[node] = (before + x, size + abs(x))
        return found


class TimeDerivatives:
    """d/dt of expressions, order by order: x_j^(l) becomes x_j^(l + 1)."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._known: dict[Node, list[Node]] = {}

    def __call__(self, node: Node, order: int) -> Node:
        """Return the derivative of this order."""
        chain = self._known.setdefault(node, [node])
        graph = node.graph
        while len(chain) <= order:
            along = {graph.t: graph.node(1.0)}
            along |= {graph.y(i): graph.y(i + self._n) for i in sorted(leaves(chain[-1:]))}
            chain.append(substituted(tangent(chain[-1:], along), {})[0])
        return chain[order]


def row_of(node: Node, variables: Sequence[int]) -> dict[int, Node]:
    """Return the derivatives of a node with respect to y(i) for these i, without those that are 0."""
    if not variables:
        return {}
    graph = node.graph
    row = jacobian([node], [graph.y(i) for i in variables])[0]
    places = sorted(row)
    slopes = substituted([row[k] for k in places], {})
    return {variables[k]: slope for k, slope in zip(places, slopes, strict=True) if not is_zero(slope)}


class Values:
    """Nodes as a function of (t, y, p)."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._formula = Formula("values", lambda: nodes, (len(nodes),))
        self._empty = not nodes

    def __call__(self, t: float, y: Array, p: Array) -> Array:
        """Return the values; NaN where one cannot be evaluated."""
        if self._empty:
            return np.zeros(0)
        return np.array(self._formula(t, y, *([p] if len(p) else [])), dtype=float)


def primed(name: str, order: int) -> str:
    """Return the name of a derivative: x, x', x'', x''', x^(4)."""
    return name + "'" * order if order < 4 else f"{name}^({order})"
