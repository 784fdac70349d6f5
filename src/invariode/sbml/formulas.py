"""Formulas of models: MathML as trees of our own, and these trees as nodes of a graph."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any, NamedTuple

from .._functions.graph.nodes import Graph, Node
from .library import UnsupportedError, libsbml

#: Avogadro's constant as SBML defines it.
AVOGADRO = 6.02214179e23

#: The type of a node of libSBML, without its prefix, and what we call it; what is missing has its name in lower case.
_PLAIN = {
    "FUNCTION_LN": "log",
    "FUNCTION_ABS": "abs",
    "FUNCTION_CEILING": "ceil",
    **{f"FUNCTION_ARC{name.upper()}": f"a{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"FUNCTION_ARC{name.upper()}": f"a{name}" for name in ("sec", "csc", "cot", "sech", "csch", "coth")},
    **{f"FUNCTION_{name.upper()}": name for name in ("exp", "floor", "sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"FUNCTION_{name.upper()}": name for name in ("sec", "csc", "cot", "sech", "csch", "coth", "max", "min", "rem")},
    **{f"FUNCTION_{name.upper()}": name for name in ("quotient", "factorial", "power", "piecewise", "root")},
    **{f"RELATIONAL_{name.upper()}": name for name in ("eq", "neq", "lt", "leq", "gt", "geq")},
    **{f"LOGICAL_{name.upper()}": name for name in ("and", "or", "not", "xor", "implies")},
    **{name.upper(): name for name in ("plus", "times", "minus", "divide", "power")},
    "FUNCTION_LOG": "log_of_base",
    "FUNCTION_RATE_OF": "rate_of",
    "FUNCTION_DELAY": "delay",
    "CONSTANT_TRUE": "true",
    "CONSTANT_FALSE": "false",
    "NAME_TIME": "time",
}

#: What is true or false.
_LOGICAL = {"eq", "neq", "lt", "leq", "gt", "geq", "and", "or", "not", "xor", "implies", "true", "false"}
_RELATIONS = ("eq", "neq", "lt", "leq", "gt", "geq")
_ELEMENTARY = {
    "exp",
    "log",
    "sin",
    "cos",
    "tan",
    "sinh",
    "cosh",
    "tanh",
    "asin",
    "acos",
    "atan",
    "asinh",
    "acosh",
    "atanh",
}
#: One over these functions, and these functions of one over the argument.
_RECIPROCAL = {"sec": "cos", "csc": "sin", "cot": "tan", "sech": "cosh", "csch": "sinh", "coth": "tanh"}
_OF_RECIPROCAL = {f"a{name}": f"a{other}" for name, other in _RECIPROCAL.items()}

#: Factorials of whole numbers up to this one are selected from a table: the next is beyond the largest double.
_LARGEST_FACTORIAL = 170


class Expression(NamedTuple):
    """A formula: an operation and its arguments, or a number or a name."""

    op: str
    arguments: tuple[Expression, ...] = ()
    value: Any = None

    @property
    def is_logical(self) -> bool:
        """True if the value is true or false, not a number."""
        if self.op == "piecewise":
            return all(one.is_logical for one in self.arguments[::2])
        return self.op in _LOGICAL

    def parts(self) -> Iterator[Expression]:
        """Yield the expression itself and all expressions in it."""
        waiting = [self]
        while waiting:
            one = waiting.pop()
            yield one
            waiting.extend(one.arguments)

    def names(self) -> set[str]:
        """Return the symbols that the expression uses."""
        return {one.value for one in self.parts() if one.op in ("name", "rate_of")}


def number(value: float) -> Expression:
    """Return a number as an expression."""
    return Expression("number", (), float(value))


def read(node: Any) -> Expression:
    """Return the expression of a node of libSBML.

    Raises UnsupportedError: It uses what there is no equation for.
    """
    L = libsbml()
    kind = node.getType()
    if kind == L.AST_NAME:
        return Expression("name", (), node.getName())
    if kind in (L.AST_INTEGER, L.AST_REAL, L.AST_REAL_E, L.AST_RATIONAL):
        return number(node.getInteger() if kind == L.AST_INTEGER else node.getReal())
    if kind in (L.AST_CONSTANT_E, L.AST_CONSTANT_PI):
        return number(math.e if kind == L.AST_CONSTANT_E else math.pi)
    if kind == L.AST_NAME_AVOGADRO:
        return number(AVOGADRO)
    op = _operations().get(kind)
    if op is None:
        raise UnsupportedError("formula", f"there is no equation for {node.getName() or f'MathML of type {kind}'}")
    if op == "rate_of":
        return Expression(op, (), node.getChild(0).getName())
    return Expression(op, tuple(read(node.getChild(i)) for i in range(node.getNumChildren())))


def parse(text: str) -> Expression:
    """Return the expression of a formula as text, in the syntax of SBML Level 3, in which log is natural.

    Raises ValueError: The text is not a formula.
    """
    L = libsbml()
    settings = L.L3ParserSettings()
    settings.setParseLog(L.L3P_PARSE_LOG_AS_LN)
    node = L.parseL3FormulaWithSettings(str(text), settings)
    if node is None:
        raise ValueError(f"{text!r} is no formula: {L.getLastParseL3Error().strip().splitlines()[-1]}")
    return read(node)


_known: dict[int, str] = {}


def _operations() -> dict[int, str]:
    if not _known:
        L = libsbml()
        _known.update({getattr(L, f"AST_{name}"): op for name, op in _PLAIN.items()})
    return _known


class Translator:
    """Expressions as nodes of a graph.

    - `graph`: where the nodes are made
    - `value`, `rate`: the node of a symbol, and that of its time derivative
    - `time`: the time
    - `delay`: the node of a value at an earlier time, of its expression, its node and the delay
    """

    def __init__(
        self,
        graph: Graph,
        value: Callable[[str], Node],
        rate: Callable[[str], Node],
        time: Node,
        delay: Callable[[Expression, Node, Node], Node] | None = None,
    ) -> None:
        self.graph, self._value, self._rate, self._time, self._delay = graph, value, rate, time, delay

    def number(self, one: Expression) -> Node:
        """Return the value as a number: 1 for true, 0 for false."""
        node = self._made(one)
        return self.graph.select(node, self.graph.node(1.0), self.graph.node(0.0)) if one.is_logical else node

    def truth(self, one: Expression) -> Node:
        """Return the value as a condition: a number is true if it is not zero."""
        return (
            self._made(one) if one.is_logical else self.graph.make("not_equal", self._made(one), self.graph.node(0.0))
        )

    def _made(self, one: Expression) -> Node:
        graph, op, a = self.graph, one.op, one.arguments
        if op == "number":
            return graph.node(one.value)
        if op in ("name", "rate_of"):
            return self._value(one.value) if op == "name" else self._rate(one.value)
        if op == "time":
            return self._time
        if op == "delay":
            if self._delay is None:
                raise UnsupportedError("delay", "a formula uses delay(): values of the past")
            return self._delay(a[0], self.number(a[0]), self.number(a[1]))
        if op in _LOGICAL:
            return self._condition(op, a)
        if op == "piecewise":
            return self._piecewise(one)
        numbers = [self.number(each) for each in a]
        return _NUMERIC[op](graph, *numbers) if op in _NUMERIC else self._function(op, numbers)

    def _function(self, op: str, a: Sequence[Node]) -> Node:
        graph = self.graph
        if op in _ELEMENTARY:
            return graph.elementary(op, a[0])
        if op in _RECIPROCAL:
            return 1.0 / graph.elementary(_RECIPROCAL[op], a[0])
        if op in _OF_RECIPROCAL:
            return graph.elementary(_OF_RECIPROCAL[op], 1.0 / a[0])
        raise UnsupportedError("formula", f"there is no equation for {op}")

    def _condition(self, op: str, a: Sequence[Expression]) -> Node:
        graph = self.graph
        if op in ("true", "false"):
            return graph.make("equal", graph.node(0.0), graph.node(0.0 if op == "true" else 1.0))
        if op in _RELATIONS:
            chain = [self.number(one) for one in a]
            found = [relation(graph, op, left, right) for left, right in itertools.pairwise(chain)]
            return reduce(lambda x, y: graph.make("and", x, y), found) if found else self._condition("true", ())
        truths = [self.truth(one) for one in a]
        if op == "not":
            return graph.make("not", truths[0])
        if op == "implies":
            return graph.make("or", graph.make("not", truths[0]), truths[1])
        if not truths:
            return self._condition("true" if op == "and" else "false", ())
        if op == "xor":
            return reduce(self._either, truths)
        return reduce(lambda x, y: graph.make(op, x, y), truths)

    def _either(self, x: Node, y: Node) -> Node:
        graph = self.graph
        one, other = graph.make("and", x, graph.make("not", y)), graph.make("and", graph.make("not", x), y)
        return graph.make("or", one, other)

    def _piecewise(self, one: Expression) -> Node:
        """Return the first value whose condition holds; NaN if none does."""
        graph, a = self.graph, one.arguments
        if one.is_logical:  # the truth of the first condition that holds
            value = self.truth(a[-1]) if len(a) % 2 else self._condition("false", ())
            for i in range(len(a) // 2 - 1, -1, -1):
                yes, condition = self.truth(a[2 * i]), self.truth(a[2 * i + 1])
                no = graph.make("and", graph.make("not", condition), value)
                value = graph.make("or", graph.make("and", condition, yes), no)
            return value
        value = self.number(a[-1]) if len(a) % 2 else graph.node(math.nan)
        for i in range(len(a) // 2 - 1, -1, -1):
            value = graph.select(self.truth(a[2 * i + 1]), self.number(a[2 * i]), value)
        return value


def relation(graph: Graph, op: str, left: Node, right: Node) -> Node:
    """Return a comparison of two numbers."""
    if op in ("gt", "geq"):
        left, right = right, left
    return graph.make(
        {"eq": "equal", "neq": "not_equal", "lt": "less", "gt": "less"}.get(op, "less_equal"), left, right
    )


def _sum(graph: Graph, *a: Node) -> Node:
    return reduce(lambda x, y: x + y, a) if a else graph.node(0.0)


def _product(graph: Graph, *a: Node) -> Node:
    return reduce(lambda x, y: x * y, a) if a else graph.node(1.0)


def _remainder(graph: Graph, a: Node, b: Node) -> Node:
    """Return the remainder of a / b with the sign of the dividend."""
    return a - b * _truncated(graph, a / b)


def _truncated(graph: Graph, a: Node) -> Node:
    below = graph.make("less", a, graph.node(0.0))
    return graph.select(below, graph.make("ceil", a), graph.make("floor", a))


def _factorial(graph: Graph, a: Node) -> Node:
    """Return a! of whole numbers, from a tree of comparisons; NaN for others."""

    def chosen(first: int, last: int) -> Node:
        if first == last:
            whole = graph.make("equal", a, graph.node(float(first)))
            return graph.select(whole, graph.node(float(math.factorial(first))), graph.node(math.nan))
        middle = (first + last) // 2
        below = graph.make("less_equal", a, graph.node(float(middle)))
        return graph.select(below, chosen(first, middle), chosen(middle + 1, last))

    return chosen(0, _LARGEST_FACTORIAL)


def _power(graph: Graph, base: Node, exponent: Node) -> Node:
    return graph.power(base, exponent)


def _root(graph: Graph, *a: Node) -> Node:
    """Return the square root, or that of a degree, which comes first."""
    if len(a) == 1 or (a[0].op == "number" and a[0].value == 2):
        return graph.elementary("sqrt", a[-1])
    return graph.power(a[-1], 1.0 / a[0])


def _log_of_base(graph: Graph, *a: Node) -> Node:
    if len(a) == 1 or (a[0].op == "number" and a[0].value == 10):
        return graph.elementary("log10", a[-1])
    return graph.elementary("log", a[-1]) / graph.elementary("log", a[0])


_NUMERIC: dict[str, Callable[..., Node]] = {
    "plus": _sum,
    "times": _product,
    "minus": lambda graph, a, b=None: -a if b is None else a - b,
    "divide": lambda graph, a, b: a / b,
    "power": _power,
    "root": _root,
    "log_of_base": _log_of_base,
    "abs": lambda graph, a: graph.make("abs", a),
    "floor": lambda graph, a: graph.make("floor", a),
    "ceil": lambda graph, a: graph.make("ceil", a),
    "max": lambda graph, *a: reduce(lambda x, y: graph.make("maximum", x, y), a),
    "min": lambda graph, *a: reduce(lambda x, y: graph.make("minimum", x, y), a),
    "rem": _remainder,
    "quotient": lambda graph, a, b: _truncated(graph, a / b),
    "factorial": _factorial,
}
