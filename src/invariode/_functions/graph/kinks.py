"""Kinks of a graph: the differences whose signs change where it passes from one branch to another as y changes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from .nodes import Node, in_order
from .switches import moves


def is_analytic(outputs: Sequence[Node]) -> bool:
    """Return whether the graph has no branches."""
    return not any(_crossings(node) for node in in_order(outputs))


def kinks(outputs: Sequence[Node], others: Iterable[Node] = ()) -> list[Node]:
    """Return the differences whose signs change where the branches of `outputs`, and those of `others`, change with
    y."""
    also = set(others)
    found: dict[frozenset[Node], Node] = {}
    for node in in_order(outputs):
        for crossing in _crossings(node):
            if node in also or moves(crossing.difference):
                a, b = crossing.pair or (crossing.difference, crossing.difference)
                found.setdefault(frozenset((a, b)), crossing.difference)
    return [*found.values()]


class _SignChange(NamedTuple):
    """A difference that changes its sign where a branch changes."""

    difference: Node
    pair: tuple[Node, Node] | None = None


def _crossings(node: Node) -> list[_SignChange]:
    a, b, *_ = (*node.arguments, node, node)
    if node.op in ("less", "less_equal", "minimum", "maximum"):
        return [_SignChange(a - b, (a, b))]
    if node.op in ("sign", "abs"):
        return [_SignChange(*((a, None) if a.op != "subtract" else (a, a.arguments)))]
    if node.op in ("floor", "ceil", "modulo"):
        x = a / b if node.op == "modulo" else a
        below = x.graph.make("floor", x)
        return [_SignChange(x - end, (x, end)) for end in (below, below + 1.0)]
    if node.op == "piece":
        return [_SignChange(a - one, (a, a.graph.node(one))) for one in node.value]
    return []
