"""Conditions at which the values of a graph jump: where f switches from one branch to another."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..._base.arguments import Array
from .differentiation import jacobian
from .nodes import Node, in_order
from .python import Formula

#: What compares two numbers, the difference of which changes its sign there.
_ORDERED = ("less", "less_equal")
#: What jumps wherever a number, its argument or the quotient of both, is an integer.
_STEPPED = ("floor", "ceil", "modulo")
#: What differs at single points, where nothing changes its sign.
_PUNCTURED = ("equal", "not_equal")
#: Points at which the branches of a condition are compared, the seed of their choice, and Newton's steps to each.
_POINTS, _SEED, _STEPS = 16, 29, 20
#: How much farther from the start each of four points in turn is looked for.
_WIDER = 10.0
#: Relative to the values, branches that differ by less are one.
_SAME = 1e-9


class Switch(NamedTuple):
    """A condition whose branches differ where it switches."""

    difference: Node  # function that changes its sign at the switch
    #: below, above: the values of the graph where the difference is negative, and where it is positive
    below: list[Node]
    above: list[Node]


def switches(outputs: Sequence[Node], t: float, y: Array, p: Array) -> list[Switch]:
    """The conditions of a graph, those that change with y, at which its values jump. They are looked for around
    (t, y). (Those that depend on t alone are in `landings`.)"""
    return [one for one in conditions(outputs) if _jumps(one, t, y, p)]


def has_steps(outputs: Sequence[Node]) -> bool:
    """Return whether the values of a graph may jump elsewhere than at its switches."""
    return any(node.op in _PUNCTURED for node in in_order(outputs))


def conditions(outputs: Sequence[Node]) -> list[Switch]:
    """Return all comparisons, signs and steps of values that change with y."""
    return [*_comparisons(outputs), *_steps(outputs)]


def surface(value: Node) -> Node | None:
    """Return a function that changes its sign where a condition changes, smooth except where one comparison takes over
    from another; None if `value` has other values than two constants, or changes where nothing is compared."""
    found = _surface(value)
    return found if isinstance(found, Node) else None


def _surface(value: Node) -> Node | bool | None:
    """`surface`; True or False of a constant."""
    op, graph = value.op, value.graph
    if op == "number":
        return bool(value.value > 0)
    if op in _ORDERED:
        return value.arguments[1] - value.arguments[0]
    if op == "sign":
        return value.arguments[0]
    parts = [_surface(one) for one in value.arguments] if op in ("not", "and", "or", "select") else []
    if not parts or any(one is None for one in parts):
        return None

    def opposite(one: Node | bool | None) -> Node | bool:
        assert one is not None
        return -one if isinstance(one, Node) else not one

    def both(one: Node | bool | None, other: Node | bool | None) -> Node | bool:
        if isinstance(one, Node) and isinstance(other, Node):
            return graph.make("minimum", one, other)
        constant, rest = (one, other) if not isinstance(one, Node) else (other, one)
        assert rest is not None
        return rest if constant else False

    def either(one: Node | bool | None, other: Node | bool | None) -> Node | bool:
        return opposite(both(opposite(one), opposite(other)))

    if op == "not":
        return opposite(parts[0])
    if op == "select":
        chosen, yes, no = parts
        return either(both(chosen, yes), both(opposite(chosen), no))
    return both(*parts) if op == "and" else either(*parts)


def _comparisons(outputs: Sequence[Node]) -> list[Switch]:
    groups: dict[tuple[Node, Node], list[tuple[Node, bool]]] = {}
    for node in in_order(outputs):
        if node.op not in _ORDERED and node.op != "sign":
            continue
        a, b = (*node.arguments, node.graph.node(0.0))[:2]
        if b is node.graph.node(0.0) and a.op == "subtract":  # the same condition
            a, b = a.arguments
        if (b, a) in groups:
            groups[b, a].append((node, False))
        else:
            groups.setdefault((a, b), []).append((node, True))
    found = []
    for (a, b), nodes in groups.items():
        difference = a - b
        if not moves(difference):
            continue
        below = _decided(outputs, {node: _answer(node, below=below) for node, below in nodes})
        above = _decided(outputs, {node: _answer(node, below=not below) for node, below in nodes})
        if below != above:
            found.append(Switch(difference, below, above))
    return found


def _steps(outputs: Sequence[Node]) -> list[Switch]:
    """Return the switches of floor, ceil and modulo. Where x is an integer sin πx changes its sign, upwards at even
    ones. Near an integer r = ⌊x + 1/2⌋ the floor of x is r − 1 below it and r above it."""
    groups: dict[Node, list[Node]] = {}
    for node in in_order(outputs):
        if node.op in _STEPPED:
            x = node.arguments[0] / node.arguments[1] if node.op == "modulo" else node.arguments[0]
            groups.setdefault(x, []).append(node)
    found = []
    for x, nodes in groups.items():
        if not moves(x):
            continue
        nearest = x.graph.make("floor", x + 0.5)
        odd = nearest.graph.make("modulo", nearest, nearest.graph.node(2.0))
        below, above = (
            _decided(outputs, {node: _stepped(node, floor) for node in nodes})
            for floor in (nearest - 1.0 + odd, nearest - odd)
        )
        if below != above:
            found.append(Switch(x.graph.make("sin", x * math.pi), below, above))
    return found


def _stepped(node: Node, floor: Node) -> Node:
    """Return the value of a stepped node between two integers, where the floor of its argument is `floor`."""
    if node.op == "modulo":
        return node.arguments[0] - node.arguments[1] * floor
    return floor if node.op == "floor" else floor + 1.0


def moves(difference: Node) -> bool:
    """Return whether the time at which a difference changes its sign, if there is one, depends on y."""
    return any(node.op == "y" for node in in_order([difference]))


def _answer(node: Node, *, below: bool) -> Node | bool:
    """The value of a comparison, or of a sign, where the first number is below the second, or not."""
    if node.op == "sign":
        return node.graph.node(-1.0 if below else 1.0)
    return below


def _decided(outputs: Sequence[Node], answers: Mapping[Node, Node | bool]) -> list[Node]:
    """Return the values with these answers in place of conditions."""
    graph = outputs[0].graph
    made: dict[Node, Node | bool] = {}
    for node in in_order(outputs):
        if node in answers:
            made[node] = answers[node]
            continue
        given = [made[one] for one in node.arguments]
        if not any(isinstance(one, bool) for one in given):
            same = all(one is before for one, before in zip(given, node.arguments, strict=True))
            made[node] = node if same else graph.make(node.op, *_nodes(given), value=node.value)
        elif node.op == "select" and isinstance(given[0], bool):
            made[node] = given[1] if given[0] else given[2]
        else:
            made[node] = _logic(node, given)
    return _nodes([made[one] for one in outputs])


def _logic(node: Node, given: Sequence[Node | bool]) -> Node | bool:
    """and, or and not of conditions, some of which are decided."""
    if node.op == "not":
        return not given[0]
    settles = node.op == "or"  # the answer that decides alone
    if any(one is settles for one in given):
        return settles
    rest = _nodes([one for one in given if not isinstance(one, bool)])
    return rest[0] if rest else not settles


def _nodes(given: Sequence[Node | bool]) -> list[Node]:
    assert not any(isinstance(one, bool) for one in given)
    return [one for one in given if isinstance(one, Node)]


def evaluated(outputs: Sequence[Node]) -> Callable[[float, Array, Array], Array]:
    """Values of a graph as a function of (t, y, p)."""
    return Formula("branch", lambda: outputs, (len(outputs),)).array


def _jumps(switch: Switch, t: float, y: Array, p: Array) -> bool:
    """Return whether the branches differ at a point of the switch; also True if no such point is found."""
    graph = switch.difference.graph
    variables = [graph.t, *(graph.y(i) for i in range(len(y)))]
    row = jacobian([switch.difference], variables)[0]
    value = evaluated([switch.difference])
    gradient = evaluated([row.get(i, graph.node(0.0)) for i in range(len(variables))])
    below, above = evaluated(switch.below), evaluated(switch.above)
    rng = np.random.default_rng(_SEED)
    found = False
    for trial in range(_POINTS):
        size = np.maximum(np.abs(np.append(t, y)), 1.0) * _WIDER ** (trial % 4)
        at = _root(value, gradient, np.append(t, y) + size * rng.standard_normal(len(size)), p)
        if at is None:
            continue
        with np.errstate(all="ignore"):
            a, b = below(at[0], at[1:], p), above(at[0], at[1:], p)
            gap, scale = np.abs(a - b), np.maximum(np.abs(a), np.abs(b)).max(initial=0)
        if not np.isfinite(gap).all():
            continue
        found = True
        if (gap > _SAME * scale).any():
            return True
    return not found


def _root(
    value: Callable[[float, Array, Array], Array], gradient: Callable[[float, Array, Array], Array], x: Array, p: Array
) -> Array | None:
    """A point near x at which the value is 0, by Newton's method along the gradient."""
    for _ in range(_STEPS):
        with np.errstate(all="ignore"):
            here, slope = float(value(x[0], x[1:], p)[0]), gradient(x[0], x[1:], p)
            step = here / (slope @ slope) * slope
        if not np.isfinite(step).all():
            return None
        x = x - step
        if np.abs(step).max() <= _SAME * np.abs(x).max():
            return x
    return None
