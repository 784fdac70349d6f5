"""Taylor coefficients of the operations of a graph: v_k of v = f(a(s), b(s)) from the coefficients of a and b up to k
and those of v below k (Moore 1966; Jorba and Zou 2005).

From v' = w a' follows k v_k = Σ j a_j w_{k−j} over j = 1..k; from d v' = n', k d_0 v_k = k n_k − Σ j v_j d_{k−j} over
0 < j < k; from a v' = α v a', k a_0 v_k = Σ ((α + 1) j − k) a_j v_{k−j} over j = 1..k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from .differentiation import PIECEWISE_CONSTANT
from .nodes import Node, in_order

#: What takes a coefficient of its arguments to one of its own, with coefficients of order 0 as factors.
_LINEAR = {"add", "subtract", "negate", "select", "abs", "minimum", "maximum", "modulo"}


#: The weight of sums without one.
UNWEIGHTED = (0.0, 0.0)


class Sum(NamedTuple):
    """Σ w_j left_j right_{k−j} over j from `first` to k − `last`."""

    left: Node
    right: Node
    first: int = 0
    last: int = 0
    weight: tuple[float, float] = UNWEIGHTED  # factors (a, b) of j and k in w_j = a j − b k; (0, 0) stands for w_j = 1

    @property
    def is_square(self) -> bool:
        """True if the terms come in equal pairs."""
        return self.left is self.right and self.weight == UNWEIGHTED


_RATE = (1.0, 0.0)


class Coefficients(Protocol):
    """Known quantities for computing a coefficient; numbers have operators."""

    @property
    def k(self) -> Any:
        """The order."""

    def now(self, node: Node) -> Any:
        """Return coefficient k of a node."""

    def first(self, node: Node) -> Any:
        """Return coefficient 0 of a node."""

    def over(self, number: Any, node: Node) -> Any:
        """The number over the coefficient 0 of the node."""


class Rule(NamedTuple):
    """Rule for the coefficient k ≥ 1 of a node: numerator / (divisor_0 · multiple · k).

    Attributes
    ----------
    sums : list of Sum
        Sums over earlier coefficients that the rule needs.
    numerator : function
        Numerator as a function of the known coefficients and the sums.
    divisor : Node, optional
        None: 1.
    multiple : float
        0: there is no factor k.
    now : sequence of Node
        Nodes whose coefficient k is needed, besides the sums.
    """

    sums: list[Sum]
    numerator: Callable[..., Any]
    divisor: Node | None = None
    multiple: float = 0.0
    now: Sequence[Node] = ()

    @property
    def uses(self) -> list[Node]:
        """All nodes whose coefficients up to order k are needed."""
        return [
            *self.now,
            *([self.divisor] if self.divisor else []),
            *(n for s in self.sums for n in (s.left, s.right)),
        ]


def rule(v: Node) -> Rule:
    """Return the rule of a node that is not linear in its arguments."""
    return _RULES[v.op](v, *v.arguments)


def _product(v: Node, a: Node, b: Node) -> Rule:
    return Rule([Sum(a, b)], lambda x, s: s)


def _quotient(v: Node, a: Node, b: Node) -> Rule:
    return Rule([Sum(b, v, first=1)], lambda x, s: minus(x.now(a), s), b, now=[a])


def _root(v: Node, a: Node) -> Rule:
    return Rule([Sum(v, v, first=1, last=1)], lambda x, s: minus(x.now(a), s), v + v, now=[a])


def _hypot(v: Node, a: Node, b: Node) -> Rule:
    return _root(v, a * a + b * b)


def _power(v: Node, a: Node, b: Node) -> Rule:
    if b.op == "number":
        return Rule([Sum(a, v, first=1, weight=(b.value + 1, 1.0))], lambda x, s: s, a, 1.0)
    exponent = b * a.graph.elementary("log", a)
    return Rule([Sum(exponent, v, first=1, weight=_RATE)], lambda x, s: s, multiple=1.0)


def _integral(w: Callable[[Node, Node], Node], factor: float = 1.0) -> Callable[[Node, Node], Rule]:
    """v' = factor w a', w given by (v, a)."""

    def made(v: Node, a: Node) -> Rule:
        total = Sum(a, w(v, a), first=1, weight=(factor, 0.0))
        return Rule([total], lambda x, s: s, multiple=1.0)

    return made


def _inverse(d: Callable[[Node], Node], factor: float = 1.0) -> Callable[[Node, Node], Rule]:
    """d v' = factor a', d given by a."""

    def made(v: Node, a: Node) -> Rule:
        divisor = d(a)
        total = Sum(v, divisor, first=1, last=1, weight=_RATE)
        return Rule([total], lambda x, s: minus(x.now(a) * (x.k * factor), s), divisor, 1.0, [a])

    return made


def _atan2(v: Node, y: Node, x: Node) -> Rule:
    """(x² + y²) v' = x y' − y x'."""
    square = x * x + y * y
    rising, falling = Sum(y, x, first=1, weight=_RATE), Sum(x, y, first=1, weight=_RATE)
    rest = Sum(v, square, first=1, last=1, weight=_RATE)
    return Rule([rising, falling, rest], lambda c, a, b, s: minus(minus(a, b), s), square, 1.0)


def _call(name: str, a: Node) -> Node:
    return a.graph.elementary(name, a)


def _partner(name: str) -> Callable[[Node, Node], Node]:
    return lambda v, a: v.graph.make(name, a)


def _gauss(v: Node, a: Node) -> Node:
    return _call("exp", -(a * a))


_RULES: dict[str, Callable[..., Rule]] = {
    "multiply": _product,
    "divide": _quotient,
    "sqrt": _root,
    "cbrt": lambda v, a: Rule([Sum(a, v, first=1, weight=(4.0, 3.0))], lambda x, s: s, a, 3.0),
    "power": _power,
    "hypot": _hypot,
    "atan2": _atan2,
    "exp": _integral(lambda v, a: v),
    "expm1": _integral(lambda v, a: v + 1.0),
    "exp2": _integral(lambda v, a: v, math.log(2)),
    "sin": _integral(_partner("cos")),
    "cos": _integral(_partner("sin"), -1.0),
    "tan": _integral(lambda v, a: v * v + 1.0),
    "sinh": _integral(_partner("cosh")),
    "cosh": _integral(_partner("sinh")),
    "tanh": _integral(lambda v, a: 1.0 - v * v),
    "erf": _integral(_gauss, 2 / math.sqrt(math.pi)),
    "erfc": _integral(_gauss, -2 / math.sqrt(math.pi)),
    "log": _inverse(lambda a: a),
    "log1p": _inverse(lambda a: a + 1.0),
    "log10": _inverse(lambda a: a, 1 / math.log(10)),
    "log2": _inverse(lambda a: a, 1 / math.log(2)),
    "asin": _inverse(lambda a: _call("sqrt", (1.0 - a) * (a + 1.0))),
    "acos": _inverse(lambda a: _call("sqrt", (1.0 - a) * (a + 1.0)), -1.0),
    "atan": _inverse(lambda a: a * a + 1.0),
    "asinh": _inverse(lambda a: _call("sqrt", a * a + 1.0)),
    "acosh": _inverse(lambda a: _call("sqrt", (a - 1.0) * (a + 1.0))),
    "atanh": _inverse(lambda a: (1.0 - a) * (a + 1.0)),
}


class Program(NamedTuple):
    """Nodes in the order in which their coefficients k are computed."""

    nodes: list[Node]  # each after what it needs at order k
    degrees: Mapping[Node, float]  # degree of each node in s: 0 is constant, inf a series that does not end
    rules: Mapping[Node, Rule]  # rules of the nodes that are not linear
    moving: set[Node]  # the nodes whose coefficients k ≥ 1 are needed

    @property
    def solves(self) -> bool:
        """Linear systems are solved."""
        return any(one.op == "solve" for one in self.nodes)

    @property
    def sums(self) -> int:
        """The number of sums of products in each order."""
        return sum(len(self.rules[one].sums) for one in self.moving if one in self.rules)


def count_sums(outputs: Sequence[Node]) -> float:
    """Return the number of sums of products in each order; infinity if there are linear systems, which are not
    counted."""
    found = program(outputs)
    return math.inf if found.solves else found.sums


def program(outputs: Sequence[Node]) -> Program:
    """Return the program that computes the Taylor coefficients of these values."""
    nodes: list[Node] = []
    degrees: dict[Node, float] = {}
    rules: dict[Node, Rule] = {}
    later = list(outputs)
    while later:
        for node in [one for one in in_order(later) if one not in degrees]:
            degrees[node] = _degree(node, degrees)
            nodes.append(node)
            if degrees[node] and not is_linear(node, degrees):
                rules[node] = rule(node)
        needed = [one for made in rules.values() for one in made.uses]  # below order k only, some of it
        needed += [made.divisor for made in rules.values() if made.divisor is not None]
        later = [one for one in dict.fromkeys(needed) if one not in degrees]
    return Program(_sorted(nodes, rules), degrees, rules, _moving(outputs, degrees, rules))


def _moving(outputs: Sequence[Node], degrees: Mapping[Node, float], rules: Mapping[Node, Rule]) -> set[Node]:
    found: set[Node] = set()
    waiting = [*outputs]
    while waiting:
        node = waiting.pop()
        if node in found or degrees[node] == 0:
            continue
        found.add(node)
        waiting.extend(rules[node].uses if node in rules else node.arguments)
    return found


def _sorted(nodes: Sequence[Node], rules: Mapping[Node, Rule]) -> list[Node]:
    """Sort the nodes so that each comes after its arguments and the other nodes it needs at the same order."""
    found: dict[Node, None] = {}
    waiting = [(node, False) for node in reversed(nodes)]
    while waiting:
        node, ready = waiting.pop()
        if node in found:
            continue
        if ready:
            found[node] = None
            continue
        waiting.append((node, True))
        waiting.extend((one, False) for one in needs(node, rules) if one not in found)
    return list(found)


def needs(node: Node, rules: Mapping[Node, Rule]) -> list[Node]:
    """Return the nodes whose coefficients a node needs at the same order."""
    made = rules.get(node)
    if made is None:
        return list(node.arguments)
    summed = [one for each in made.sums if not each.last for one in [each.left, *([] if each.first else [each.right])]]
    return [*node.arguments, *(one for one in (*made.now, *summed) if one is not node)]


def alike(found: Program) -> list[list[Node]]:
    """Return the nodes other than y in lists of those that take the same operations and do not need each other; each
    list comes after the lists it needs."""
    levels: dict[Node, int] = {}
    kinds: dict[tuple[Any, ...], list[Node]] = {}
    for node in found.nodes:
        if node.op != "y":
            levels[node] = 1 + max((levels.get(one, 0) for one in needs(node, found.rules)), default=0)
            kinds.setdefault((levels[node], *_kind(node, found)), []).append(node)
    return [kinds[key] for key in sorted(kinds, key=lambda key: key[0])]


def _kind(node: Node, found: Program) -> tuple[Any, ...]:
    """Return a key that is equal for nodes that take the same operations, on coefficients of the same degrees."""
    exponent = node.arguments[-1].value if node.op == "power" else None
    operands = tuple((one.op == "number", found.degrees[one]) for one in node.arguments)
    square = len({*node.arguments}) < len(node.arguments)
    value = None if node.op in ("p", "number") else node.value
    return node.op, value, exponent, operands, square, node in found.moving


def is_linear(node: Node, degrees: Mapping[Node, float]) -> bool:
    """Return whether coefficient k ≥ 1 depends only on coefficients of order k, and on those of order 0 as factors."""
    if node.op in _LINEAR or not node.arguments or node.op in ("solve", "entry"):
        return True
    if node.op == "multiply":
        return 0 in (degrees[node.arguments[0]], degrees[node.arguments[1]])
    return node.op == "divide" and degrees[node.arguments[1]] == 0


def _degree(node: Node, degrees: Mapping[Node, float]) -> float:
    if node.op in ("number", "p") or node.op in PIECEWISE_CONSTANT:
        return 0
    if node.op in ("t", "y"):
        return 1 if node.op == "t" else math.inf
    given = [degrees[one] for one in node.arguments]
    if node.op in _LINEAR:
        return max(given[1:] if node.op == "select" else given)
    if node.op == "multiply":
        return sum(given)
    if node.op == "divide" and given[1] == 0:
        return given[0]
    return math.inf if any(given) else 0


def linear(node: Node, x: Coefficients, degrees: Mapping[Node, float]) -> Any:
    """Coefficient k ≥ 1 of a linear node. Zeros that are known are the number 0.0."""
    given = [x.now(one) if degrees[one] else 0.0 for one in node.arguments]
    if all(isinstance(one, float) for one in given):
        return 0.0
    return _COMBINED[node.op](x, node.arguments, given)


def _absolute(x: Coefficients, of: Sequence[Node], a: Sequence[Any]) -> Any:
    return x.first(of[0]).compared("<", 0.0).choose(-a[0], a[0])


def _smaller(x: Coefficients, of: Sequence[Node], a: Sequence[Any]) -> Any:
    return x.first(of[1]).compared("<", x.first(of[0])).choose(a[1], a[0])


def _larger(x: Coefficients, of: Sequence[Node], a: Sequence[Any]) -> Any:
    return x.first(of[1]).compared(">", x.first(of[0])).choose(a[1], a[0])


def _rest(x: Coefficients, of: Sequence[Node], a: Sequence[Any]) -> Any:
    """a − b n, with the n of order 0."""
    return minus(a[0], 0.0 if isinstance(a[1], float) else (x.first(of[0]) / x.first(of[1])).floor() * a[1])


def _multiple(x: Coefficients, of: Sequence[Node], a: Sequence[Any]) -> Any:
    return x.first(of[0]) * a[1] if isinstance(a[0], float) else a[0] * x.first(of[1])


_COMBINED: dict[str, Callable[[Coefficients, Sequence[Node], Sequence[Any]], Any]] = {
    "add": lambda x, of, a: plus(*a),
    "subtract": lambda x, of, a: minus(*a),
    "negate": lambda x, of, a: -a[0],
    "multiply": _multiple,
    "divide": lambda x, of, a: x.over(a[0], of[1]),
    "select": lambda x, of, a: x.first(of[0]).choose(*a[1:]),
    "abs": _absolute,
    "minimum": _smaller,
    "maximum": _larger,
    "modulo": _rest,
}


def plus(a: Any, b: Any) -> Any:
    """Sums of coefficients, some of which are known to be zero."""
    return b if isinstance(a, float) else a if isinstance(b, float) else a + b


def minus(a: Any, b: Any) -> Any:
    """Return the difference of two coefficients, some of which are known to be zero."""
    if isinstance(b, float):
        return a
    return -b if isinstance(a, float) else a - b
