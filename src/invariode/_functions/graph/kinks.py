"""Where a graph goes from one branch to another: what changes its sign there, and when, if that depends on t alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from .nodes import Node, in_order
from .python import Formula

#: More values of t at which a graph changes its branch are not listed.
MOST_TIMES = 10_000
#: A straight line through three points: what roundoff may leave.
_STRAIGHT = 1e-12


class Kinks(NamedTuple):
    """Where branches change.

    Attributes
    ----------
    differences : list of Node
        What changes its sign there.
    times : list of float
        Where, for what depends on t alone.
    scheduled : bool
        Whether there may be other times on another interval.
    """

    differences: list[Node]
    times: list[float]
    scheduled: bool


def substituted(outputs: Sequence[Node], instead: Mapping[Node, Node]) -> list[Node]:
    """The same values with other nodes in the place of some."""
    made: dict[Node, Node] = dict(instead)
    for node in in_order(outputs):
        if node in made:
            continue
        given = [made[one] for one in node.arguments]
        same = all(one is before for one, before in zip(given, node.arguments, strict=True))
        made[node] = node if same else node.graph.make(node.op, *given, value=node.value)
    return [made[one] for one in outputs]


def is_analytic(outputs: Sequence[Node]) -> bool:
    """Whether there are no branches."""
    return not any(_crossings(node) for node in in_order(outputs))


def kinks(outputs: Sequence[Node], t0: float, tf: float) -> Kinks:
    """Where the branches of these values change between t0 and tf."""
    found: dict[frozenset[Node], Node] = {}
    times: list[float] = []
    scheduled = False
    for node in in_order(outputs):
        for crossing in _crossings(node):
            if not _moves(crossing.difference):
                continue
            known = _times(crossing, t0, tf)
            if known is None:
                a, b = crossing.pair or (crossing.difference, crossing.difference)
                found.setdefault(frozenset((a, b)), crossing.difference)
            else:
                times += known
                scheduled = True
    return Kinks([*found.values()], sorted({*times}), scheduled)


class _Crossing(NamedTuple):
    """A difference that changes its sign where a branch changes; `whole`: what is an integer there, at any of them."""

    difference: Node
    pair: tuple[Node, Node] | None = None
    whole: Node | None = None


def _crossings(node: Node) -> list[_Crossing]:
    a, b, *_ = (*node.arguments, node, node)
    if node.op in ("less", "less_equal", "minimum", "maximum"):
        return [_Crossing(a - b, (a, b))]
    if node.op in ("sign", "abs"):
        return [_Crossing(*((a, None) if a.op != "subtract" else (a, a.arguments)))]
    if node.op in ("floor", "ceil", "modulo"):
        x = a / b if node.op == "modulo" else a
        below = x.graph.make("floor", x)
        return [_Crossing(x - end, (x, end), x) for end in (below, below + 1.0)]
    if node.op == "piece":
        return [_Crossing(a - one, (a, a.graph.node(one))) for one in node.value]
    return []


def _moves(difference: Node) -> bool:
    return any(node.op in ("t", "y") for node in in_order([difference]))


def _times(crossing: _Crossing, t0: float, tf: float) -> list[float] | None:
    """The times at which it changes its sign; None: they depend on y or on parameters, or are not equally spaced."""
    line = crossing.whole or crossing.difference
    if any(node.op in ("y", "p") for node in in_order([line])) or not math.isfinite(t0 + tf):
        return None
    formula = Formula("line", lambda: [line], (1,))
    ends = [formula(t, [])[0] for t in (t0, (t0 + tf) / 2, tf)]
    size = max(map(abs, ends))
    straight = abs(ends[0] - 2 * ends[1] + ends[2]) <= _STRAIGHT * size
    if not straight or any(node.op not in _AFFINE for node in in_order([line])) or ends[0] == ends[2]:
        return None
    if crossing.whole is None:
        wanted = [0.0]
    else:
        low, high = math.ceil(min(ends)), math.floor(max(ends))
        if high - low > MOST_TIMES:
            return None
        wanted = [float(one) for one in range(low, high + 1)]
    return [t for one in wanted if (t := _root(formula, one, t0, tf)) is not None]


#: What leaves a line a line, unless t is multiplied by itself.
_AFFINE = {"add", "subtract", "multiply", "divide", "negate", "number", "t"}


def _root(line: Formula, value: float, t0: float, tf: float) -> float | None:
    """Where a line has a value: the first double at which it is there or beyond."""
    a, b = float(line(t0, [])[0]), float(line(tf, [])[0])
    t = t0 + (value - a) / (b - a) * (tf - t0)
    if not min(t0, tf) <= t <= max(t0, tf):
        return None
    for _ in range(4):  # Newton's iteration for the last digits
        t -= (float(line(t, [])[0]) - value) / (b - a) * (tf - t0)
    return min(max(t, min(t0, tf)), max(t0, tf))
