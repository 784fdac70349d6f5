"""NumPy's universal functions of nodes, by name."""

from __future__ import annotations

import math
from collections.abc import Callable

from .nodes import ELEMENTARY, Node, TraceError


def number(node: Node) -> Node:
    """A truth as 1 or 0."""
    return node.graph.select(node, node.graph.node(1.0), node.graph.node(0.0)) if node.is_truth else node


def condition(node: Node) -> Node:
    """A truth as 1 or -1."""
    return node.graph.select(node, node.graph.node(1.0), node.graph.node(-1.0)) if node.is_truth else node


def truth(node: Node) -> Node:
    """Return whether a number is not 0, as a node."""
    return node if node.is_truth else node.graph.make("not_equal", node, node.graph.node(0.0))


def _of_numbers(function: Callable[..., Node]) -> Callable[..., Node]:
    return lambda *a: function(*map(number, a))


def _made(name: str, swapped: bool = False) -> Callable[..., Node]:
    return lambda *a: a[0].graph.make(name, *(number(one) for one in (a[::-1] if swapped else a)))


def _of_truths(name: str) -> Callable[..., Node]:
    return lambda *a: a[0].graph.make(name, *map(truth, a))


def _elementary(name: str) -> Callable[[Node], Node]:
    return lambda a: a.graph.elementary(name, number(a))


def _truncated(a: Node) -> Node:
    graph = a.graph
    return graph.select(graph.make("less", a, graph.node(0.0)), graph.make("ceil", a), graph.make("floor", a))


def _floor_quotient(a: Node, b: Node) -> Node:
    """a // b as Python and NumPy have it: (a - a mod b) / b is an integer but for roundoff."""
    graph = a.graph
    exact = graph.make("floor", (a - graph.make("modulo", a, b)) / b + 0.5)
    return graph.select(graph.make("not_equal", exact, exact), graph.make("floor", a / b), exact)


def _remainder(a: Node, b: Node) -> Node:
    """fmod as C has it, with the sign of a."""
    graph, size = a.graph, a.graph.make("abs", b)
    below = graph.make("less", a, graph.node(0.0))
    return graph.select(below, -graph.make("modulo", -a, size), graph.make("modulo", a, size))


def _with_nan(name: str) -> Callable[..., Node]:
    """NumPy's maximum and minimum: NaN if one is NaN, where Python's `max` and `min` look at the first."""

    def chosen(a: Node, b: Node) -> Node:
        a, b = (b, a) if a.op == "number" else (a, b)
        found = a.graph.make(name, a, b)
        return found if b.op == "number" else a.graph.select(a.graph.make("not_equal", b, b), b, found)

    return _of_numbers(chosen)


def _without_nan(name: str) -> Callable[..., Node]:
    """fmax and fmin: the other one if one is NaN."""
    return _of_numbers(lambda a, b: a.graph.select(a.graph.make("not_equal", a, a), b, a.graph.make(name, a, b)))


def _bitwise(name: str) -> Callable[..., Node]:
    def of_truths(*a: Node) -> Node:
        if not all(one.is_truth for one in a):
            raise TraceError("&, | or ~ of numbers")
        return a[0].graph.make(name, *a)

    return of_truths


def _sum(a: Node, b: Node) -> Node:
    if a.is_truth and b.is_truth:
        raise TraceError("the sum of two truths: NumPy's is True, that of Python 2")
    return number(a) + number(b)


def _heaviside(a: Node, at_zero: Node) -> Node:
    graph, zero = a.graph, a.graph.node(0.0)
    not_below = graph.select(graph.make("less_equal", a, zero), at_zero, graph.node(1.0))
    return graph.select(graph.make("less", a, zero), zero, not_below)  # one condition: nothing else happens at zero


def _not_finite(a: Node) -> Node:
    return a.graph.make("not", a.graph.make("less", a.graph.make("abs", a), a.graph.node(math.inf)))


BINARY: dict[str, Callable[..., Node]] = {
    "add": _sum,
    "subtract": _of_numbers(lambda a, b: a - b),
    "multiply": _of_numbers(lambda a, b: a * b),
    "divide": _of_numbers(lambda a, b: a / b),
    "true_divide": _of_numbers(lambda a, b: a / b),
    "power": _of_numbers(lambda a, b: a**b),
    "float_power": _of_numbers(lambda a, b: a**b),
    "floor_divide": _of_numbers(_floor_quotient),
    "remainder": _made("modulo"),
    "mod": _made("modulo"),
    "fmod": _of_numbers(_remainder),
    "maximum": _with_nan("maximum"),
    "fmax": _without_nan("maximum"),
    "minimum": _with_nan("minimum"),
    "fmin": _without_nan("minimum"),
    "arctan2": _made("atan2"),
    "hypot": _made("hypot"),
    "heaviside": _of_numbers(_heaviside),
    "less": _made("less"),
    "less_equal": _made("less_equal"),
    "greater": _made("less", swapped=True),
    "greater_equal": _made("less_equal", swapped=True),
    "equal": _made("equal"),
    "not_equal": _made("not_equal"),
    "logical_and": _of_truths("and"),
    "logical_or": _of_truths("or"),
    "bitwise_and": _bitwise("and"),
    "bitwise_or": _bitwise("or"),
}


UNARY: dict[str, Callable[..., Node]] = {
    **{name: _elementary(name) for name in ELEMENTARY},
    **{f"arc{name[1:]}": _elementary(name) for name in ("asin", "acos", "atan", "asinh", "acosh", "atanh")},
    "negative": _of_numbers(lambda a: -a),
    "positive": _of_numbers(lambda a: a),
    "conjugate": _of_numbers(lambda a: a),
    "square": _of_numbers(lambda a: a * a),
    "expit": _of_numbers(lambda a: 1.0 / (1.0 + a.graph.elementary("exp", -a))),
    "reciprocal": _of_numbers(lambda a: 1.0 / a),
    "absolute": _made("abs"),
    "fabs": _made("abs"),
    "sign": _made("sign"),
    "floor": _made("floor"),
    "ceil": _made("ceil"),
    "trunc": _of_numbers(_truncated),
    "deg2rad": _of_numbers(lambda a: a * (math.pi / 180)),
    "radians": _of_numbers(lambda a: a * (math.pi / 180)),
    "rad2deg": _of_numbers(lambda a: a * (180 / math.pi)),
    "degrees": _of_numbers(lambda a: a * (180 / math.pi)),
    "logical_not": _of_truths("not"),
    "invert": _bitwise("not"),
    "isnan": _of_numbers(lambda a: a.graph.make("not_equal", a, a)),
    "isfinite": _of_numbers(lambda a: a.graph.make("not", _not_finite(a))),
}
