"""Derivatives of graphs: exact, with the nodes of the graph itself.

A row maps the number of a variable to a node; the derivative with respect to a variable that is not in it is zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from .nodes import COMPARISONS, Node, in_order

Row = dict[int, Node]

#: What has no derivative but zero, where it has one.
_CONSTANT = {"number", "t", "y", "p", "sign", "floor", "ceil", "and", "or", "not", "piece", "pick", *COMPARISONS}
#: What depends on a decision: its derivative has to be that of the branch taken, even if the other's is not finite.
_BRANCHING = {"select", "minimum", "maximum", "solve"}


def jacobian(outputs: Sequence[Node], variables: Sequence[Node]) -> list[Row]:
    """The rows of the Jacobian of the outputs, forwards."""
    if not outputs:
        return []
    one = outputs[0].graph.node(1.0)
    return tangents(outputs, {variable: {i: one} for i, variable in enumerate(variables)})


def gradient(output: Node, variables: Sequence[Node]) -> Row:
    """The derivatives of one output: backwards, which is shorter for many variables, if it has no branches."""
    nodes = [*in_order([output])]
    if any(node.op in _BRANCHING for node in nodes):
        return jacobian([output], variables)[0]
    places = {variable: i for i, variable in enumerate(variables)}
    depends = _dependent(nodes, places)
    factors: dict[Node, Node] = {output: output.graph.node(1.0)}
    row: Row = {}
    for node in reversed(nodes):
        if node not in factors:
            continue
        if node in places:
            row[places[node]] = factors[node]
            continue
        for argument, slope in zip(node.arguments, _slopes(node, depends), strict=True):
            if slope is not None:
                term = slope(factors[node])
                factors[argument] = factors[argument] + term if argument in factors else term
    return row


def dependences(outputs: Sequence[Node], variables: Sequence[Node]) -> tuple[list[int], int]:
    """The variables on which each output depends, as bits of a number, and the terms of a forward Jacobian: one for
    each node and each variable on which it depends."""
    places = {variable: 1 << i for i, variable in enumerate(variables)}
    known: dict[Node, int] = {}
    terms = 0
    for node in in_order(outputs):
        found = places.get(node, 0)
        if node.op not in _CONSTANT:
            for one in node.arguments:
                found |= known[one]
        known[node] = found
        terms += found.bit_count() if node.arguments else 0
    return [known[one] for one in outputs], terms


def tangent(outputs: Sequence[Node], direction: Mapping[Node, Node]) -> list[Node]:
    """The derivatives of the outputs along a direction, given by the components of t and y in it."""
    if not outputs:
        return []
    rows = tangents(outputs, {variable: {0: along} for variable, along in direction.items()})
    return [row.get(0, outputs[0].graph.node(0.0)) for row in rows]


def tangents(outputs: Sequence[Node], start: Mapping[Node, Row]) -> list[Row]:
    """The derivatives of the outputs along several directions, in which a variable has the components of its row."""
    rows: dict[Node, Row] = {}
    for node in in_order(outputs):
        if node in start:
            rows[node] = start[node]
        elif node.op == "entry":
            if node not in rows:  # all entries of a solution at once
                rows.update(_of_solution(node.arguments[0], rows))
        elif node.op != "solve":
            rows[node] = _combined(node, rows)
    return [rows[one] for one in outputs]


def _dependent(nodes: Iterable[Node], variables: Mapping[Node, int]) -> set[Node]:
    depends: set[Node] = set()
    for node in nodes:
        if node in variables or any(one in depends for one in node.arguments):
            depends.add(node)
    return depends


def _combined(node: Node, rows: Mapping[Node, Row]) -> Row:
    """The row of a node, of the rows of its arguments."""
    given = [rows[one] for one in node.arguments]
    if node.op in _CONSTANT or not any(given):
        return {}
    if node.op in ("select", "minimum", "maximum"):
        return _of_branches(node, rows)
    row: Row = {}
    depends = {one for one, its in zip(node.arguments, given, strict=True) if its}
    for its, slope in zip(given, _slopes(node, depends), strict=True):
        if slope is None:
            continue
        for i, inner in its.items():
            term = slope(inner)
            row[i] = row[i] + term if i in row else term
    return row


def _of_branches(node: Node, rows: Mapping[Node, Row]) -> Row:
    if node.op == "select":
        condition, yes, no = node.arguments
    else:
        yes, no = node.arguments
        condition = node.graph.make("less_equal", *((yes, no) if node.op == "minimum" else (no, yes)))
    zero = node.graph.node(0.0)
    both = sorted({*rows[yes], *rows[no]})
    return {i: node.graph.select(condition, rows[yes].get(i, zero), rows[no].get(i, zero)) for i in both}


def _of_solution(system: Node, rows: Mapping[Node, Row]) -> dict[Node, Row]:
    """Of all entries of X with A X = B: A X′ = B′ − A′ X, one linear system for all variables."""
    graph, form = system.graph, system.value
    k, m = form.k, form.m
    matrix, right = form.matrix(system.arguments), form.right(system.arguments)
    entries = [[graph.make("entry", system, value=i * m + j) for j in range(m)] for i in range(k)]
    variables = sorted({v for one in system.arguments for v in rows[one]})
    if not variables:
        return {one: {} for row in entries for one in row}
    sides: list[list[Node]] = []
    for i in range(k):
        side = []
        for v in variables:
            for j in range(m):
                total = rows[right[i][j]].get(v)
                for column, entry in matrix[i].items():
                    change = rows[entry].get(v)
                    if change is not None:
                        term = change * entries[column][j]
                        total = -term if total is None else total - term
                side.append(graph.node(0.0) if total is None else total)
        sides.append(side)
    of_matrix = system.arguments[: form.entries]
    solved = graph.solved(form._replace(m=m * len(variables)), of_matrix, sides)
    return {
        entries[i][j]: {v: solved[i][place * m + j] for place, v in enumerate(variables)}
        for i in range(k)
        for j in range(m)
    }


#: How the derivative of an argument becomes that of the node; None: the argument is constant.
Slope = Callable[[Node], Node] | None


def _slopes(node: Node, depends: set[Node]) -> list[Slope]:
    """For each argument of a smooth operation."""
    found = _RULES[node.op](node, *node.arguments) if node.op not in _CONSTANT else [None] * len(node.arguments)
    return [slope if one in depends else None for one, slope in zip(node.arguments, found, strict=True)]


def _times(factor: Node) -> Callable[[Node], Node]:
    return lambda inner: factor * inner


def _over(divisor: Node) -> Callable[[Node], Node]:
    """By one quotient for all variables."""
    return _times(1.0 / divisor)


def _divide(v: Node, a: Node, b: Node) -> list[Slope]:
    factor = 1.0 / b
    return [_times(factor), _times(-(v * factor))]


def _power(v: Node, a: Node, b: Node) -> list[Slope]:
    graph = v.graph
    return [_times(b * graph.power(a, b - 1.0)), lambda inner: v * graph.elementary("log", a) * inner]


def _atan2(v: Node, y: Node, x: Node) -> list[Slope]:
    square = x * x + y * y
    return [_times(x / square), _times(-(y / square))]


def _call(name: str) -> Callable[[Node], Node]:
    return lambda a: a.graph.elementary(name, a)


_sin, _cos, _sinh, _cosh, _exp, _sqrt = map(_call, ("sin", "cos", "sinh", "cosh", "exp", "sqrt"))

_RULES: dict[str, Callable[..., list[Slope]]] = {
    "add": lambda v, a, b: [lambda x: x, lambda x: x],
    "subtract": lambda v, a, b: [lambda x: x, lambda x: -x],
    "multiply": lambda v, a, b: [_times(b), _times(a)],
    "divide": _divide,
    "negate": lambda v, a: [lambda x: -x],
    "power": _power,
    "atan2": _atan2,
    "hypot": lambda v, a, b: [_times(a / v), _times(b / v)],
    "modulo": lambda v, a, b: [lambda x: x, _times(-v.graph.make("floor", a / b))],
    "abs": lambda v, a: [_times(v.graph.make("sign", a))],
    "sqrt": lambda v, a: [_over(v + v)],
    "exp": lambda v, a: [_times(v)],
    "log": lambda v, a: [_over(a)],
    "sin": lambda v, a: [_times(_cos(a))],
    "cos": lambda v, a: [_times(-_sin(a))],
    "tan": lambda v, a: [_times(v * v + 1.0)],
    "asin": lambda v, a: [_over(_sqrt(1.0 - a * a))],
    "acos": lambda v, a: [_over(-_sqrt(1.0 - a * a))],
    "atan": lambda v, a: [_over(a * a + 1.0)],
    "sinh": lambda v, a: [_times(_cosh(a))],
    "cosh": lambda v, a: [_times(_sinh(a))],
    "tanh": lambda v, a: [_times(1.0 - v * v)],
    "asinh": lambda v, a: [_over(_sqrt(a * a + 1.0))],
    "acosh": lambda v, a: [_over(_sqrt(a - 1.0) * _sqrt(a + 1.0))],
    "atanh": lambda v, a: [_over(1.0 - a * a)],
    "expm1": lambda v, a: [_times(v + 1.0)],
    "log1p": lambda v, a: [_over(a + 1.0)],
    "log10": lambda v, a: [_over(a * math.log(10))],
    "log2": lambda v, a: [_over(a * math.log(2))],
    "exp2": lambda v, a: [_times(v * math.log(2))],
    "cbrt": lambda v, a: [_over(v * v * 3.0)],
    "erf": lambda v, a: [_times(2 / math.sqrt(math.pi) * _exp(-(a * a)))],
    "erfc": lambda v, a: [_times(-2 / math.sqrt(math.pi) * _exp(-(a * a)))],
}
