"""The Jacobian of an invariant that a user's function returns as a sparse matrix."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._base.matrices import as_matrix, is_sparse
from .._functions.increments import somewhere

#: Where entries that are 0 at the start are looked for, in parts of the sizes of y.
_BESIDE = 0.1


class SparseJacobian:
    """The entries of ∂g/∂y, row by row, as a function of (t, y, \\*args).

    Parameters
    ----------
    jac : callable
        The user's function, which returns a sparse matrix.
    name : str
        Its name in messages.
    known : list of sparse matrix
        What it returned at some points: the entries stored in any of them are the pattern.
    shape : tuple of int
        (m, n).

    Attributes
    ----------
    pattern : tuple of list of int
        Where the entries of each row begin, and their columns.
    """

    def __init__(self, jac: Callable[..., Any], name: str, known: list[Any], shape: tuple[int, int]) -> None:
        self._jac, self._name, self._shape = jac, name, shape
        self._places = np.unique(np.concatenate([self._places_of(self._read(one)) for one in known]))
        row, column = np.divmod(self._places, shape[1])
        self.pattern = np.searchsorted(row, np.arange(shape[0] + 1)).tolist(), column.tolist()

    def __call__(self, t: float, y: Array, *args: Any) -> Array:
        rows = self._read(self._jac(t, y, *args))
        places = self._places_of(rows)
        at = np.minimum(np.searchsorted(self._places, places), len(self._places) - 1)
        if len(places) and not (len(self._places) and np.array_equal(self._places[at], places)):
            raise ValueError(
                f"{self._name} returned entries at t = {t} that were not stored at the start: store all entries that "
                "may differ from zero in each matrix that it returns"
            )
        entries = np.zeros(len(self._places))
        entries[at] = rows.data
        return entries

    def _read(self, given: Any) -> Any:
        """Compressed rows with ascending columns, each once."""
        from scipy.sparse import csr_array

        matrix = as_matrix(self._name, given, self._shape)
        rows = csr_array(matrix, copy=True) if is_sparse(matrix) else csr_array(matrix)
        rows.sum_duplicates()
        return rows.astype(float)

    def _places_of(self, rows: Any) -> Array:
        """i n + j of each entry, which ascends."""
        row = np.repeat(np.arange(self._shape[0]), np.diff(rows.indptr))
        return np.asarray(row * self._shape[1] + rows.indices)


def sparse_jacobian(
    jac: Callable[..., Any], name: str, t: float, y: Array, args: tuple[Any, ...], m: int
) -> SparseJacobian | None:
    """A user's Jacobian as the core takes a sparse one; None: it is not sparse. It is called at the start and, since
    SciPy drops stored zeros from some sums of matrices, near it, where no component is 0."""
    first = jac(t, y.copy(), *args)
    if not is_sparse(first):
        return None
    known = [first]
    with suppress(ValueError, ArithmeticError), np.errstate(all="ignore"):  # it may not be defined there
        known.append(jac(t, y + _BESIDE * somewhere(y), *args))
    return SparseJacobian(jac, name, known, (m, len(y)))
