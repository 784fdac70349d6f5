"""Null spaces by Gaussian elimination: sparse, in small whole numbers where they fit, the same on every processor.

Each operation is one of IEEE arithmetic on arrays, element by element, so that no order of summation is left to a
library: LAPACK's differs from processor to processor, and with it the last bits of a basis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .._base.arguments import EPS, Array

_SPARSER = 0.5  # of the largest entry: a pivot this large is taken if its row has fewer entries
_CANCELLED = 4 * EPS  # what a subtraction leaves, relative to its terms, that is roundoff
_ROUNDOFF = 16  # of n ε: what elimination may make of zero
_DENOMINATOR = 16  # largest one of fractions that become whole numbers


class NullSpace(NamedTuple):
    """The null space of a matrix of n columns, and the pivots that decided on the rank."""

    vectors: Array  # (r, n): a basis, each vector 1 in a column in which the others are 0
    pivots: Array  # sizes, in units of the first one, of the matrix with its rows and columns scaled
    left: float  # size of the largest entry that was left without a pivot, in the same unit


def roundoff(A: Array) -> float:
    """Size of a pivot of A, in units of the first one, that may be roundoff."""
    return float(_ROUNDOFF * max(A.shape) * EPS)


def null_space(A: Array, tolerance: float) -> NullSpace:
    """The null space of A (m, n), whose rank is the number of pivots that exceed `tolerance` times the first one.

    Rows and columns are scaled by powers of two, which rounds nothing. The pivot is among the largest entries of all,
    in a row of few entries.
    """
    U, columns = A.astype(float), np.arange(A.shape[1])
    U = np.ldexp(U, -_exponents(U, 1)[:, None])
    scale = _exponents(U, 0)
    U = np.ldexp(U, -scale)
    pivots: list[float] = []
    left = 0.0
    for k in range(min(U.shape)):
        i, j, left = _pivot(U[k:, k:])
        if left <= tolerance * (pivots or [left])[0]:
            break
        U[[k, k + i]] = U[[k + i, k]]
        U[:, [k, k + j]] = U[:, [k + j, k]]
        columns[[k, k + j]] = columns[[k + j, k]]
        pivots.append(abs(U[k, k]))
        _clear(U[k + 1 :, k:], U[k, k:])
        left = 0.0
    rank, first = len(pivots), (pivots or [1.0])[0]
    order = rank + np.argsort(columns[rank:])
    vectors = np.zeros((len(order), len(columns)))
    free = columns[order]
    vectors[np.arange(len(free)), free] = 1
    vectors[:, columns[:rank]] = -_solved(U[:rank, :rank], U[:rank, order]).T
    # Of the scaled columns until here; the unit stays where it is.
    return NullSpace(np.ldexp(vectors, scale[free][:, None] - scale), np.array(pivots) / first, left / first)


def echelon(rows: Array, tolerance: float) -> Array:
    """The reduced row echelon form: each row leads with 1, in the first columns possible.

    Entries below `tolerance` times the largest of the rows that do not lead yet are not taken as pivots.
    """
    rows = rows.copy()
    done = 0
    for column in range(rows.shape[1]):
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) <= tolerance * np.abs(rows[done:]).max():
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        for others in (rows[:done], rows[done + 1 :]):
            others -= np.multiply.outer(others[:, column].copy(), rows[done])
        done += 1
    return rows[:done]


def whole(vector: Array, tolerance: float) -> Array | None:
    """The multiple of small whole numbers that the vector is but for `tolerance`, relative to each component."""
    for factor in range(1, _DENOMINATOR + 1):
        multiple = factor * vector
        nearest: Array = np.rint(multiple)
        if (np.abs(multiple - nearest) <= tolerance * np.abs(multiple)).all():
            return nearest
    return None


def _exponents(A: Array, axis: int) -> Array:
    """e with 2^(e-1) ≤ the largest entry < 2^e, of each row (axis 1) or column (axis 0); 0 where all are 0."""
    exponents: Array = np.frexp(np.abs(A).max(axis=axis, initial=0))[1]
    return exponents


def _pivot(A: Array) -> tuple[int, int, float]:
    """Row and column of the next pivot, and the size of the largest entry."""
    sizes = np.abs(A).max(axis=1)
    largest = float(sizes.max())
    entries = np.where(sizes >= _SPARSER * largest, np.count_nonzero(A, axis=1), A.shape[1] + 1)
    i = int(np.argmin(entries))
    return i, int(np.argmax(np.abs(A[i]))), largest


def _clear(rows: Array, pivot: Array) -> None:
    """Eliminates the first column of `rows` by multiples of the row `pivot`. What cancels but for roundoff is zero."""
    touched, columns = np.flatnonzero(rows[:, 0]), 1 + np.flatnonzero(pivot[1:])
    if len(columns):
        block = np.ix_(touched, columns)
        terms = np.multiply.outer(rows[touched, 0] / pivot[0], pivot[columns])
        left = rows[block] - terms
        left[np.abs(left) <= np.abs(_CANCELLED * terms)] = 0
        rows[block] = left
    rows[:, 0] = 0


def _solved(U: Array, B: Array) -> Array:
    """X of U X = B, U upper triangular, column by column of U."""
    X = B.copy()
    for k in range(len(U) - 1, -1, -1):
        X[k] /= U[k, k]
        column = U[:k, k]
        touched = np.flatnonzero(column)
        X[:k][touched] -= np.multiply.outer(column[touched], X[k])
    return X
