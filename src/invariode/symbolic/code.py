"""Functions from expressions, by way of a graph: SymPy's expressions evaluated on its nodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial, reduce
from typing import Any, NamedTuple

import sympy

from .._functions.compiled import CompiledFunction
from .._functions.graph.differentiation import Row, gradient, jacobian
from .._functions.graph.function import GraphFunction
from .._functions.graph.nodes import ELEMENTARY, Graph, Node
from .._functions.graph.python import Formula, Pattern

#: The result of expressions: a Python function, or one that is compiled.
Function = CompiledFunction | Callable[..., Any]

#: The time in the code.
_TIME = sympy.Symbol("t", real=True)

#: Jacobians with at least this many rows are sparse if at most this fraction of their entries can differ from zero.
_SPARSE_ROWS, _SPARSE_PART = 20, 0.25


class System(NamedTuple):
    """y' = (explicit, the first of mass⁻¹ force), in the symbols t, y[0], y[1], ..., p[0], p[1], ... of the code.

    Where there are constraints, the last of mass⁻¹ force are their multipliers.
    """

    y: Sequence[Any]
    explicit: Sequence[Any]  # the first components of y'
    mass: Any  # Matrix (k, k), k >= 0: at least as many as the other components
    force: Sequence[Any]
    factors: tuple[Any, Any] | None = None  # L, D with mass = L D Lᵀ, where D in floating point says more than mass

    def without(self, rows: Sequence[int]) -> System:
        """Return the system without some of the constraints, given by rows of the matrix."""
        stays = [i for i in range(len(self.force)) if i not in rows]
        return self._replace(mass=self.mass.extract(stays, stays), force=[self.force[i] for i in stays])


class Code(NamedTuple):
    """The functions of a system by name, and the pattern of the Jacobian of f if it is sparse."""

    functions: dict[str, Function]
    pattern: Pattern | None


def functions(system: System, laws: Sequence[Any], compiled: bool, parameters: Sequence[str] = ()) -> Code:
    """Return f, its exact jac, and for law i its function g_i and gradient dg_i. `parameters`: names of the parameters.

    The Jacobian of a system that is solved for its accelerations is formed when a method needs it: explicit methods do
    not.
    """
    words = _Words(Graph())
    n = len(system.y)
    y = [words.graph.y(i) for i in range(n)]
    slopes = [*map(words.node, system.explicit), *_accelerations(system, words)][:n]
    made: dict[str, Formula] = {}
    for i, law in enumerate(laws):
        made[f"g{i}"] = Formula(f"g{i}", partial(_of_law, law, words), (1,))
        made[f"dg{i}"] = Formula(f"dg{i}", partial(_of_gradient, law, words, y), (1, n))
    rows = cache(lambda: jacobian(slopes, y))
    pattern = None if system.force else _sparse(rows(), n)
    made["f"] = Formula("f", lambda: slopes, (n,), parameters)
    if pattern is None:
        made["jac"] = Formula("jac", lambda: _dense(rows(), n, words.graph), (n, n))
    else:
        made["jac"] = Formula("jac", lambda: [rows()[i][j] for i, j in pattern.places()], pattern)
    return Code({name: GraphFunction(one) for name, one in made.items()} if compiled else dict(made), pattern)


def _of_law(law: Any, words: _Words) -> list[Node]:
    return [words.node(law)]


def _of_gradient(law: Any, words: _Words, y: Sequence[Node]) -> list[Node]:
    return _dense([gradient(words.node(law), y)], len(y), words.graph)


def _dense(rows: Sequence[Row], n: int, graph: Graph) -> list[Node]:
    zero = graph.node(0.0)
    return [row.get(j, zero) for row in rows for j in range(n)]


def _sparse(rows: Sequence[Row], n: int) -> Pattern | None:
    few = n >= _SPARSE_ROWS and sum(map(len, rows)) <= _SPARSE_PART * n * n
    return Pattern.of(rows, n) if few else None


def _accelerations(system: System, words: _Words) -> list[Node]:
    """Return mass⁻¹ force: by L and D, if the system has them."""
    if not system.force:
        return []
    force = [words.node(one) for one in system.force]
    if system.factors is None:
        return _divided(system.mass, force, words)
    left, middle = system.factors
    k = len(force)
    lower = [[None if left[i, j] == 0 else words.node(left[i, j]) for j in range(k)] for i in range(k)]
    for i in range(k):  # L has ones on its diagonal, but need not be lower triangular in this order of rows
        if any(lower[i][j] is not None for j in range(i + 1, k)):
            return _divided(left.T, _divided(middle, _divided(left, force, words), words), words)
    for i in range(k):
        for j in range(i):
            if (factor := lower[i][j]) is not None:
                force[i] = force[i] - factor * force[j]
    found = _divided(middle, force, words)
    for i in range(k - 1, -1, -1):
        for j in range(i + 1, k):
            if (factor := lower[j][i]) is not None:
                found[i] = found[i] - factor * found[j]
    return found


def _divided(matrix: Any, right: Sequence[Node], words: _Words) -> list[Node]:
    k = len(right)
    if k == 1:
        return [right[0] / words.node(matrix[0, 0])]
    rows = [[words.node(matrix[i, j]) for j in range(k)] for i in range(k)]
    return [row[0] for row in words.graph.solve(rows, [[one] for one in right])]


def eliminated(system: System) -> System:
    """Return the system with factors of its mass, if eliminating coordinates of constant mass cancels other terms.

    As with Euler's angles near gimbal lock: of I₁ sin²θ + I₃ cos²θ only the first term is left, which a mass matrix in
    floating point has lost where θ is small. Other masses stay as they are.
    """
    mass, n = system.mass, len(system.force)
    rest, left = mass.copy(), sympy.eye(n)
    waiting, cancels = set(range(n)), False
    while constant := [i for i in waiting if rest[i, i] != 0 and not rest[i, i].free_symbols & {*system.y, _TIME}]:
        pivot = constant[0]
        waiting.remove(pivot)
        coupled = [i for i in waiting if rest[i, pivot] != 0]
        for i in coupled:
            left[i, pivot] = rest[i, pivot] / rest[pivot, pivot]
        for i in coupled:
            for j in coupled:
                rest[i, j] = sympy.expand(rest[i, j] - left[i, pivot] * rest[pivot, j])
            cancels = cancels or _terms(rest[i, i]) < _terms(mass[i, i])
        for i in coupled:
            rest[i, pivot] = rest[pivot, i] = sympy.S.Zero
    return system._replace(factors=(left, rest)) if cancels else system


def _terms(expression: Any) -> int:
    return len(sympy.Add.make_args(sympy.expand(expression)))


class _Words:
    """Expressions in the symbols of the code as nodes, each translated once."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._known: dict[Any, Node] = {}

    def node(self, expression: Any) -> Node:
        """Return the node of an expression.

        Raises ValueError: It has a function that is not known.
        """
        expression = sympy.sympify(expression)
        waiting = [expression]
        while waiting:  # deep expressions exceed Python's limit of recursion
            one = waiting[-1]
            missing = [inner for inner in _parts(one) if inner not in self._known]
            if missing:
                waiting.extend(missing)
            else:
                waiting.pop()
                if one not in self._known:
                    self._known[one] = self._made(one, [self._known[inner] for inner in _parts(one)])
        return self._known[expression]

    def _made(self, one: Any, a: list[Node]) -> Node:
        graph = self.graph
        if one.is_Symbol:
            return self._symbol(one.name)
        if one.is_Atom:
            return graph.node(1.0 if one == sympy.true else float(one))
        if one.is_Add:
            return self._sum(one, a)
        if one.is_Mul:
            return self._product(one, a)
        name = type(one).__name__
        if one.is_Pow:
            return _power(a[0], a[1])
        if name in _NAMES:
            return graph.elementary(_NAMES[name], a[0])
        if name in _MADE:
            return _MADE[name](graph, *a)
        return self._branches(one, a) if name == "Piecewise" else a[0]  # rewritten

    def _symbol(self, name: str) -> Node:
        array, _, index = name.partition("[")
        if not index:
            return self.graph.t
        return self.graph.y(int(index[:-1])) if array == "y" else self.graph.p(int(index[:-1]))

    def _sum(self, one: Any, a: list[Node]) -> Node:
        """Return a sum as a node: terms with a negative factor are subtracted, from the first of the others."""
        signed = [(node, _is_negative(term)) for node, term in zip(a, one.args, strict=True)]
        signed.sort(key=lambda pair: pair[1])
        first, negative = signed[0]
        total = -first if negative else first
        for node, negative in signed[1:]:
            total = total - node if negative else total + node
        return total

    def _product(self, one: Any, a: list[Node]) -> Node:
        """Return a product as a node: factors with a negative power divide, all at once."""
        above = [node for node, factor in zip(a, one.args, strict=True) if not _divides(factor)]
        below = [node for node, factor in zip(a, one.args, strict=True) if _divides(factor)]
        value = reduce(lambda x, y: x * y, above, self.graph.node(1.0))
        return value / reduce(lambda x, y: x * y, below) if below else value

    def _branches(self, one: Any, a: list[Node]) -> Node:
        """Return the first expression whose condition holds; NaN if none does."""
        value = self.graph.node(math.nan)
        for i in reversed(range(len(one.args))):
            expression, condition = a[2 * i : 2 * i + 2]
            always = one.args[i].cond == sympy.true
            value = expression if always else self.graph.select(condition, expression, value)
        return value


def _parts(one: Any) -> tuple[Any, ...]:
    """Return the expressions from which the node of this one is made."""
    if one.is_Atom:
        return ()
    if one.is_Add:
        return tuple(-term if _is_negative(term) else term for term in one.args)
    if one.is_Mul:
        return tuple(sympy.Pow(factor.base, -factor.exp) if _divides(factor) else factor for factor in one.args)
    name = type(one).__name__
    if name == "Piecewise":
        return tuple(part for pair in one.args for part in pair.args)
    if one.is_Pow or name in _NAMES or name in _MADE:
        return tuple(one.args)
    return (_rewritten(one),)


def _is_negative(term: Any) -> bool:
    return bool(term.as_coeff_Mul()[0].is_negative)


def _divides(factor: Any) -> bool:
    return bool(factor.is_Pow and factor.exp.is_Number and factor.exp.is_negative)


def _rewritten(one: Any) -> Any:
    """Return a function that has no node of its own by functions that have one.

    Raises ValueError: SymPy does not know it by such functions.
    """
    for others in (sympy.Piecewise, sympy.tan, sympy.cos, sympy.sin, sympy.cosh, sympy.exp):
        found = one.rewrite(others)
        if found != one and not found.has(type(one), sympy.I):
            return found
    raise ValueError(f"there is no code for {one.func}: use elementary functions or Piecewise")


def _power(base: Node, exponent: Node) -> Node:
    """Return a power as a node: as a quotient, if the exponent is a negative number."""
    if exponent.op == "number" and exponent.value < 0:
        return 1.0 / base.graph.power(base, -exponent)
    return base.graph.power(base, exponent)


def _compared(name: str, swapped: bool = False) -> Callable[[Graph, Node, Node], Node]:
    return lambda graph, a, b: graph.make(name, *((b, a) if swapped else (a, b)))


def _joined(name: str) -> Callable[..., Node]:
    return lambda graph, *a: reduce(lambda x, y: graph.make(name, x, y), a)


def _heaviside(graph: Graph, a: Node, at_zero: Node) -> Node:
    """0 below zero, 1 above; SymPy writes out the value at zero, 1/2 if none was given. One condition is enough where
    that is the value on one side."""
    zero, one = graph.node(0.0), graph.node(1.0)
    if at_zero.is_number(0.0):
        return graph.select(graph.make("less", zero, a), one, zero)
    not_below = one if at_zero.is_number(1.0) else graph.select(graph.make("less_equal", a, zero), at_zero, one)
    return graph.select(graph.make("less", a, zero), zero, not_below)


#: SymPy's names of functions of one number, and ours.
_NAMES = {name: name for name in ELEMENTARY}
_MADE: dict[str, Callable[..., Node]] = {
    "Abs": lambda graph, a: graph.make("abs", a),
    "sign": lambda graph, a: graph.make("sign", a),
    "floor": lambda graph, a: graph.make("floor", a),
    "ceiling": lambda graph, a: graph.make("ceil", a),
    "atan2": lambda graph, a, b: graph.make("atan2", a, b),
    "Mod": lambda graph, a, b: graph.make("modulo", a, b),
    "Min": _joined("minimum"),
    "Max": _joined("maximum"),
    "And": _joined("and"),
    "Or": _joined("or"),
    "Not": lambda graph, a: graph.make("not", a),
    "StrictLessThan": _compared("less"),
    "LessThan": _compared("less_equal"),
    "StrictGreaterThan": _compared("less", swapped=True),
    "GreaterThan": _compared("less_equal", swapped=True),
    "Equality": _compared("equal"),
    "Unequality": _compared("not_equal"),
    "Heaviside": _heaviside,
    "DiracDelta": lambda graph, a: graph.node(0.0),
}
