"""Bounds on the effect of roundoff on the values of a graph, computed along with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..._base.arguments import EPS
from .nodes import COMPARISONS, Node, in_order
from .python import Formula, solved

#: Roundoff of one operation in units of the last place, ours, Python's and the mathematical library's together.
_OPERATION = 4 * EPS
#: Of the solution of a linear system, in parts of its largest value: condition numbers up to 1e6 or so.
_SYSTEM = 1e-9


class _Bounded(NamedTuple):
    value: float
    error: float


def bounds(outputs: Sequence[Node], t: float, y: Sequence[float], p: Sequence[float]) -> list[float]:
    """Return how far apart two evaluations of each value may be: infinite where a condition is that near to
    changing."""
    known: dict[Node, _Bounded] = {}
    systems: dict[Node, list[float]] = {}
    for node in in_order(outputs):
        if node.op in ("t", "y", "p"):
            known[node] = _Bounded(t if node.op == "t" else (y if node.op == "y" else p)[node.value], 0.0)
        elif node.op == "solve":
            systems[node] = solved([known[one].value for one in node.arguments], *node.value)
            known[node] = _Bounded(max(map(abs, systems[node])), 0.0)
        elif node.op == "entry":
            size = known[node.arguments[0]].value
            known[node] = _Bounded(systems[node.arguments[0]][node.value], _SYSTEM * size)
        else:
            known[node] = _bounded(node, [known[one] for one in node.arguments])
    return [known[one].error for one in outputs]


def _bounded(node: Node, a: Sequence[_Bounded]) -> _Bounded:
    if node.op == "number":
        return _Bounded(node.value, 0.0)
    if node.op in COMPARISONS:
        return _compared(node.op, *a)
    if node.op in ("and", "or", "not", "select"):
        return _decided(node.op, a)
    of = _operation(node)
    value = of(*(one.value for one in a))
    error = _OPERATION * abs(value)
    for i, one in enumerate(a):
        if one.error == 0:
            continue
        moved = [of(*(b.value + sign * one.error if i == j else b.value for j, b in enumerate(a))) for sign in (1, -1)]
        error += max(abs(other - value) for other in moved)
    return _Bounded(value, error if math.isfinite(error) else math.inf)


_made: dict[tuple[object, ...], Callable[..., float]] = {}


def _operation(node: Node) -> Callable[..., float]:
    """Return the operation of a node as a function of its arguments."""
    key = (node.op, node.value, len(node.arguments))
    if key not in _made:
        graph = type(node.graph)()
        alone = graph.make(node.op, *(graph.y(i) for i in range(len(node.arguments))), value=node.value)
        formula = Formula("operation", lambda: [alone], (1,))
        _made[key] = lambda *a: float(formula(0.0, a)[0])
    return _made[key]


def _compared(op: str, a: _Bounded, b: _Bounded) -> _Bounded:
    """Return the value of a comparison, 1 or 0, with an infinite error if roundoff may change it."""
    truths = {"less": a.value < b.value, "less_equal": a.value <= b.value, "equal": a.value == b.value}
    value = truths.get(op, a.value != b.value)
    near = a.error + b.error > 0 and abs(a.value - b.value) <= a.error + b.error
    return _Bounded(float(value), math.inf if near else 0.0)


def _decided(op: str, a: Sequence[_Bounded]) -> _Bounded:
    doubtful = math.inf if any(one.error for one in (a[:1] if op == "select" else a)) else 0.0
    if op == "select":
        chosen = a[1] if a[0].value else a[2]
        return _Bounded(chosen.value, chosen.error + doubtful)
    truths = [bool(one.value) for one in a]
    value = all(truths) if op == "and" else any(truths) if op == "or" else not truths[0]
    return _Bounded(float(value), doubtful)
