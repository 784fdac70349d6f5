"""Structure of a graph, exactly: linear combinations of its values that vanish, and values that stay zero."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from typing import TypeAlias

from ..._base.rational import Row, fraction, left_null_space
from .nodes import Node, in_order

#: A product of other nodes: the identity of each factor with its exponent, sorted.
_Monomial: TypeAlias = tuple[tuple[int, int], ...]

#: Products of sums are multiplied out up to this number of terms.
_MOST_TERMS = 64


def linear_totals(outputs: Sequence[Node]) -> list[dict[int, int]]:
    """Return the w with Σ w_i f_i = 0 identically in t, y and p, found by rational elimination.

    Each value f_i is a sum of products of nodes with rational coefficients. Elimination of the coefficients is exact,
    so that each w that is found is a total of y' = f; combinations that vanish only by identities of the factors, such
    as sin² + cos² = 1, are not found.
    """
    memory: dict[Node, Row] = {}
    return left_null_space([_expanded(one, memory) for one in outputs])


def _expanded(output: Node, memory: dict[Node, Row]) -> Row:
    """A value as a sum: rational coefficients by monomial."""
    for node in in_order([output]):
        if node not in memory:
            memory[node] = _combined(node, [memory[one] for one in node.arguments])
    return memory[output]


def _combined(node: Node, given: Sequence[Row]) -> Row:
    if node.op == "number" and math.isfinite(node.value):
        return {(): fraction(node.value)} if node.value else {}
    if node.op in ("add", "subtract"):
        sign = 1 if node.op == "add" else -1
        return _sum(given[0], ((one, sign * x) for one, x in given[1].items()))
    if node.op == "negate":
        return {one: -x for one, x in given[0].items()}
    if node.op == "multiply":
        a, b = (_short(one, its) for one, its in zip(node.arguments, given, strict=True))
        return _product(a, b)
    if node.op == "divide":
        below = _inverse(node.arguments[1], given[1])
        return _product(_short(node.arguments[0], given[0]), below)
    return _alone(node)


def _alone(node: Node, exponent: int = 1) -> Row:
    return {((id(node), exponent),): Fraction(1)}


def _short(node: Node, its: Row) -> Row:
    """Return the terms of a factor; a long sum is one factor of its own."""
    return its if len(its) <= _MOST_TERMS // 8 else _alone(node)


def _inverse(node: Node, its: Row) -> Row:
    if len(its) != 1:
        return _alone(node, -1)
    ((monomial, x),) = its.items()
    return {tuple((one, -power) for one, power in monomial): 1 / x}


def _sum(a: Row, terms: Iterable[tuple[_Monomial, Fraction]]) -> Row:
    found = dict(a)
    for one, x in terms:
        value = found.get(one, 0) + x
        if value:
            found[one] = Fraction(value)
        else:
            found.pop(one, None)
    return found


def _product(a: Row, b: Row) -> Row:
    return _sum({}, ((_times(one, other), x * z) for one, x in a.items() for other, z in b.items()))


def _times(a: _Monomial, b: _Monomial) -> _Monomial:
    powers = dict(a)
    for one, power in b:
        powers[one] = powers.get(one, 0) + power
    return tuple(sorted((one, power) for one, power in powers.items() if power))


def staying_zero(outputs: Sequence[Node], zeros: set[int], constants: set[int]) -> tuple[set[int], set[int]]:
    """Return the components of y' = f that stay zero, and all components that stay constant because of that.

    - `outputs`: f
    - `zeros`: components that are zero
    - `constants`: parameters that are zero

    Notes
    -----
    The largest set Z of these components with f_i = 0 for i in Z wherever all of Z are zero: a product with a factor
    that is zero is zero.
    """
    nodes = [*in_order(outputs)]
    while True:
        zero: set[int] = set()
        for node in nodes:
            if _is_zero(node, zero, zeros, constants):
                zero.add(id(node))
        still = {i for i, one in enumerate(outputs) if id(one) in zero}
        if zeros <= still:
            return zeros, still
        zeros = zeros & still


def _is_zero(node: Node, zero: set[int], zeros: set[int], constants: set[int]) -> bool:
    a = [id(one) in zero for one in node.arguments]
    if node.op == "number":
        return bool(node.value == 0)
    if node.op in ("y", "p"):
        return node.value in (zeros if node.op == "y" else constants)
    if node.op == "multiply":
        return any(a)
    if node.op in ("add", "subtract", "negate", "sqrt", "abs", "minimum", "maximum"):
        return all(a)
    if node.op == "divide":
        return a[0] and not a[1]
    if node.op == "power":
        exponent = node.arguments[1]
        return a[0] and exponent.op == "number" and exponent.value > 0
    return node.op == "select" and all(a[1:])


def replaced(outputs: Sequence[Node], values: Mapping[Node, Node]) -> list[Node]:
    """Return the same values with other nodes in place of some, such as a number in place of t."""
    made: dict[Node, Node] = {}
    for node in in_order(outputs):
        if node in values:
            made[node] = values[node]
            continue
        given = [made[one] for one in node.arguments]
        same = all(one is before for one, before in zip(given, node.arguments, strict=True))
        made[node] = node if same else node.graph.make(node.op, *given, value=node.value)
    return [made[one] for one in outputs]
