"""Derivatives of graphs: exact, with the nodes of the graph itself.

A row maps the number of a variable to a node; the derivative with respect to a variable that is not in it is zero.

The factor of an operation may be infinite where its value is not, such as 1 / (2 √a) at a = 0. There a product with a
derivative of a that is 0 is 0: √(x² + y²) has the derivative 0 at x = y = 0, and √h one along directions in which h
stays 0. The condition names the singular point too, not only the factor 0: elsewhere the product is a plain one, which
has derivatives and a Taylor series of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from .nodes import COMPARISONS, Node, in_order

Row = dict[int, Node]

#: What has no derivative but zero, where it has one: what jumps from one constant to another.
PIECEWISE_CONSTANT = {"sign", "floor", "ceil", "and", "or", "not", "piece", "pick", *COMPARISONS}
_CONSTANT = {"number", "t", "y", "p"} | PIECEWISE_CONSTANT
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
    singular = _singular_above(nodes, depends)
    row: Row = {}
    for node in reversed(nodes):
        if node not in factors:
            continue
        if node in places:
            row[places[node]] = factors[node]
            continue
        for argument, slope in zip(node.arguments, _slopes(node, depends), strict=True):
            if slope is not None:
                term = _backwards(slope, factors[node], singular.get(node))
                factors[argument] = factors[argument] + term if argument in factors else term
    return row


def _singular_above(nodes: Sequence[Node], depends: set[Node]) -> dict[Node, Node]:
    """Map each argument, direct or indirect, of operations that may be singular to the condition that one of them
    is."""
    found: dict[Node, Node] = {}
    for node in reversed(nodes):
        above, here = found.get(node), singular_where(node)
        condition = here if above is None else above if here is None else here.graph.make("or", above, here)
        for argument in node.arguments:
            if condition is not None and argument in depends:
                known = found.get(argument)
                if known is None or known is condition:
                    found[argument] = condition
                else:
                    found[argument] = condition.graph.make("or", known, condition)
    return found


def _backwards(slope: Callable[[Node], Node], factor: Node, singular: Node | None) -> Node:
    """Return the factor of an argument from the factor of its operation, which may be infinite where `singular` is
    true."""
    if singular is None:
        return slope(factor)
    own = slope(factor.graph.node(1.0))
    return slope(factor) if own.op == "number" else _unless_zero(singular, own, factor)


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
    """Return the row of a node, its derivatives by variable, from the rows of its arguments."""
    given = [rows[one] for one in node.arguments]
    if node.op in _CONSTANT or not any(given):
        return {}
    if node.op in ("select", "minimum", "maximum"):
        if node.op == "select":
            condition, yes, no = node.arguments
        else:
            yes, no = node.arguments
            condition = node.graph.make("less_equal", *((yes, no) if node.op == "minimum" else (no, yes)))
        zero = node.graph.node(0.0)
        both = sorted({*rows[yes], *rows[no]})
        return {i: node.graph.select(condition, rows[yes].get(i, zero), rows[no].get(i, zero)) for i in both}
    row: Row = {}
    depends = {one for one, its in zip(node.arguments, given, strict=True) if its}
    for its, slope in zip(given, _slopes(node, depends), strict=True):
        if slope is None:
            continue
        for i, inner in its.items():
            term = slope(inner)
            row[i] = row[i] + term if i in row else term
    return row


def _of_solution(system: Node, rows: Mapping[Node, Row]) -> dict[Node, Row]:
    """Return the derivatives of all entries of X with A X = B: A X′ = B′ − A′ X, one linear system for all
    variables."""
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
    """Return the slope of a smooth operation in each of its arguments, or None where that is 0."""
    found = _RULES[node.op](node, *node.arguments) if node.op not in _CONSTANT else [None] * len(node.arguments)
    return [slope if one in depends else None for one, slope in zip(node.arguments, found, strict=True)]


def _times(factor: Node) -> Callable[[Node], Node]:
    mask = _mask(factor)
    return (lambda inner: factor * inner) if mask is None else mask


def _mask(factor: Node) -> Callable[[Node], Node] | None:
    """The product with 1 where a condition holds, or does not, and 0 elsewhere: a choice, so that what is masked may
    be infinite. None: the factor is something else."""
    if factor.op != "select":
        return None
    condition, *branches = factor.arguments
    zero = factor.graph.node(0.0)
    if branches == [zero.graph.node(1.0), zero]:
        return lambda inner: inner.graph.select(condition, inner, zero)
    if branches == [zero, zero.graph.node(1.0)]:
        return lambda inner: inner.graph.select(condition, zero, inner)
    return None


def singular_where(node: Node) -> Node | None:
    """Return the condition under which factors of the derivative of an operation may be infinite though its value is
    not, or None."""
    if node.op not in _INFINITE_WHERE:
        return None
    zero_there = _INFINITE_WHERE[node.op](node, *node.arguments)
    return None if zero_there is None else node.graph.make("equal", zero_there, node.graph.node(0.0))


def _unless_zero(singular: Node, own: Node, other: Node) -> Node:
    """own · other; 0 where the condition holds and `own` is 0."""
    graph = own.graph
    zero = graph.node(0.0)
    return graph.select(graph.make("and", singular, graph.make("equal", own, zero)), zero, other * own)


def _guarded(node: Node, factor: Node) -> Callable[[Node], Node]:
    """The product with the factor of an operation that may be infinite."""
    singular = singular_where(node)
    if singular is None:
        return _times(factor)
    return lambda inner: factor * inner if inner.op == "number" else _unless_zero(singular, inner, factor)


def _over(divisor: Node, node: Node | None = None) -> Callable[[Node], Node]:
    """Return the function that divides a node by `divisor`, with one quotient for all variables. `node`: the operation,
    if its factor may be infinite."""
    return _times(1.0 / divisor) if node is None else _guarded(node, 1.0 / divisor)


def _divide(v: Node, a: Node, b: Node) -> list[Slope]:
    factor = 1.0 / b
    return [_times(factor), _times(-(v * factor))]


def _power(v: Node, a: Node, b: Node) -> list[Slope]:
    """aᵇ log a is 0 where aᵇ is: at a = 0 with b > 0."""
    graph = v.graph
    rate = v * graph.elementary("log", a)
    if a.op != "number" or a.value == 0:
        rate = graph.select(graph.make("equal", v, graph.node(0.0)), graph.node(0.0), rate)
    return [_guarded(v, b * graph.power(a, b - 1.0)), _times(rate)]


def _atan2(v: Node, y: Node, x: Node) -> list[Slope]:
    square = x * x + y * y
    return [_guarded(v, x / square), _guarded(v, -(y / square))]


def _hypot(v: Node, a: Node, b: Node) -> list[Slope]:
    """Return the slopes of v = hypot(a, b), which are 0 at a = b = 0, where v has its minimum."""
    graph = v.graph
    there, zero = graph.make("equal", v, graph.node(0.0)), graph.node(0.0)
    return [_times(graph.select(there, zero, one / v)) for one in (a, b)]


#: What is 0 where a factor may be infinite, of (value, *arguments).
_INFINITE_WHERE: dict[str, Callable[..., Node | None]] = {
    "sqrt": lambda v, a: v,
    "cbrt": lambda v, a: v,
    "power": lambda v, a, b: None if b.op == "number" and b.value >= 1 else a,
    "atan2": lambda v, y, x: x * x + y * y,
    "asin": lambda v, a: 1.0 - a * a,
    "acos": lambda v, a: 1.0 - a * a,
    "acosh": lambda v, a: a - 1.0,
}


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
    "hypot": _hypot,
    "modulo": lambda v, a, b: [lambda x: x, _times(-v.graph.make("floor", a / b))],
    "abs": lambda v, a: [_times(v.graph.make("sign", a))],
    "sqrt": lambda v, a: [_over(v + v, v)],
    "exp": lambda v, a: [_times(v)],
    "log": lambda v, a: [_over(a)],
    "sin": lambda v, a: [_times(_cos(a))],
    "cos": lambda v, a: [_times(-_sin(a))],
    "tan": lambda v, a: [_times(v * v + 1.0)],
    "asin": lambda v, a: [_over(_sqrt(1.0 - a * a), v)],
    "acos": lambda v, a: [_over(-_sqrt(1.0 - a * a), v)],
    "atan": lambda v, a: [_over(a * a + 1.0)],
    "sinh": lambda v, a: [_times(_cosh(a))],
    "cosh": lambda v, a: [_times(_sinh(a))],
    "tanh": lambda v, a: [_times(1.0 - v * v)],
    "asinh": lambda v, a: [_over(_sqrt(a * a + 1.0))],
    "acosh": lambda v, a: [_over(_sqrt(a - 1.0) * _sqrt(a + 1.0), v)],
    "atanh": lambda v, a: [_over(1.0 - a * a)],
    "expm1": lambda v, a: [_times(v + 1.0)],
    "log1p": lambda v, a: [_over(a + 1.0)],
    "log10": lambda v, a: [_over(a * math.log(10))],
    "log2": lambda v, a: [_over(a * math.log(2))],
    "exp2": lambda v, a: [_times(v * math.log(2))],
    "cbrt": lambda v, a: [_over(v * v * 3.0, v)],
    "erf": lambda v, a: [_times(2 / math.sqrt(math.pi) * _exp(-(a * a)))],
    "erfc": lambda v, a: [_times(-2 / math.sqrt(math.pi) * _exp(-(a * a)))],
}
