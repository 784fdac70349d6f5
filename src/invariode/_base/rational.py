"""Null spaces in exact arithmetic: sparse elimination with fractions, for structure that roundoff must not decide."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np

from .arguments import Array

Row: TypeAlias = dict[Any, Fraction]
"""A sparse row: nonzero entries by column, which is named by anything hashable."""

#: Largest denominators that are tried for a number, before its binary fraction is taken.
_DENOMINATORS = (1, 1000, 10**6)


def fraction(value: float) -> Fraction:
    """Return the simplest fraction that rounds to this finite number: 1/3 for 0.333..., 3/10 for 0.3."""
    exact = Fraction(value)
    for largest in _DENOMINATORS:
        simple = exact.limit_denominator(largest)
        if float(simple) == value:
            return simple
    return exact


def left_null_space(rows: Sequence[Mapping[Any, Fraction]]) -> list[dict[int, int]]:
    """Return a basis of the w with Σ w_i row_i = 0, exactly: whole numbers without a common factor, by row.

    Elimination works on [A | I]; the pivot row is always one with the fewest entries, which keeps both parts sparse.
    """
    waiting: list[tuple[Row, Row]] = [
        ({j: x for j, x in row.items() if x}, {i: Fraction(1)}) for i, row in enumerate(rows)
    ]
    by_column: dict[Any, set[int]] = {}
    for i, (row, _) in enumerate(waiting):
        for j in row:
            by_column.setdefault(j, set()).add(i)
    left, null = set(range(len(waiting))), []
    while left:
        pivot = min(left, key=lambda i: (len(waiting[i][0]), len(waiting[i][1]), i))
        left.remove(pivot)
        row, weights = waiting[pivot]
        if not row:
            null.append(weights)
            continue
        column = min(row, key=lambda j: len(by_column[j]))
        for j in row:
            by_column[j].discard(pivot)
        for i in sorted(by_column[column]):
            other, others = waiting[i]
            factor = other[column] / row[column]
            for j, x in row.items():
                value = other.get(j, 0) - factor * x
                if value:
                    other[j] = Fraction(value)
                    by_column[j].add(i)
                elif j in other:
                    del other[j]
                    by_column[j].discard(i)
            for j, x in weights.items():
                value = others.get(j, 0) - factor * x
                if value:
                    others[j] = Fraction(value)
                else:
                    others.pop(j, None)
    return _simplest([_whole(one) for one in null])


def _whole(weights: Row) -> dict[int, int]:
    """The multiple without fractions and common factors, in which most entries are positive."""
    common = math.lcm(*(x.denominator for x in weights.values()))
    numbers = {i: int(x * common) for i, x in weights.items()}
    divisor = math.gcd(*numbers.values())
    sign = -1 if sum(x < 0 for x in numbers.values()) * 2 > len(numbers) else 1
    return {i: sign * x // divisor for i, x in sorted(numbers.items())}


def _simplest(basis: list[dict[int, int]]) -> list[dict[int, int]]:
    """Return a simpler basis of the same space: to each vector others are added or subtracted as long as that leaves
    fewer negative entries, or as few and fewer entries: totals of amounts rather than their differences."""
    changed = True
    while changed:
        changed = False
        for k, one in enumerate(basis):
            for j, other in enumerate(basis):
                if j == k or not one.keys() & other.keys():
                    continue
                better = min((_combined(a, one, b, other) for a, b in ((1, 1), (1, -1), (-1, 1))), key=_complexity)
                if _complexity(better) < _complexity(one):
                    one, changed = better, True
            basis[k] = one
    return sorted(basis, key=lambda one: min(one))


def _complexity(one: Mapping[int, int]) -> tuple[int, int]:
    return sum(x < 0 for x in one.values()), len(one)


def _combined(a: int, one: Mapping[int, int], b: int, other: Mapping[int, int]) -> dict[int, int]:
    both = {i: a * one.get(i, 0) + b * other.get(i, 0) for i in sorted({*one, *other})}
    return {i: x for i, x in both.items() if x}


def as_rows(weights: Sequence[Mapping[int, int]], n: int) -> Array:
    """Return a basis as an array of shape (m, n)."""
    found = np.zeros((len(weights), n))
    for row, one in zip(found, weights, strict=True):
        for i, x in one.items():
            row[i] = float(x)
    return found
