"""Jacobians of invariants as functions of (t, y, \\*args): from a trace of g, or sparse ones of a user."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._base.matrices import as_matrix, is_sparse
from .._functions.derivatives import Derivative, RowPattern, derivative_of, has_llvm
from .._functions.increments import somewhere
from .._functions.with_arguments import Point

#: From this many components on a trace pays: it takes 10 to 100 ms once, and replaces two to four times as many calls
#: of g in each step (benchmarks/manifolds.py).
FEWEST_COMPONENTS = 16
#: Relative increment for the comparison with a difference, and the relative difference at which the trace is not used:
#: the difference is exact to its square, and to roundoff over it.
_INCREMENT, _TOLERANCE = 1e-5, 1e-4
#: Where entries that are 0 at the start are looked for, in parts of the sizes of y.
_BESIDE = 0.1


class TracedJacobian:
    """∂g/∂y as a function of (t, y, \\*args), for any arguments.

    Parameters
    ----------
    fun : callable
        The invariant g(t, y, \\*args).
    n, m : int
        The numbers of components of y and of values.
    rows : RowPattern, optional
        The values are the entries of this pattern, row by row.
    """

    def __init__(self, fun: Callable[..., Any], n: int, m: int, rows: RowPattern | None = None) -> None:
        self._fun, self._n, self._m, self._rows = fun, n, m, rows
        self._last: Derivative | None = None

    def by_rows(self, rows: RowPattern) -> TracedJacobian:
        """Return this Jacobian as a function that returns the entries of a pattern, row by row."""
        return TracedJacobian(self._fun, self._n, self._m, rows)

    def at(self, t: float, y: Array, args: tuple[Any, ...]) -> Derivative:
        """Return the derivative of g for these arguments; (t, y): a point at which g is defined."""
        last = self._last
        if last is None or len(last.args) != len(args) or not all(map(_is_same_number, last.args, args)):
            shape, about = (self._m, self._n), Point(t, y)
            last = self._last = derivative_of(self._fun, shape, at=about, args=args, traces="unnoticed")
        return last

    def __call__(self, t: float, y: Array, *args: Any) -> Array:
        made = self.at(t, y, args)
        return made.jacobian(t, y) if self._rows is None else made.entries(t, y, self._rows)


def _is_same_number(a: Any, b: Any) -> bool:
    return a is b and type(a) in (float, int)


def takes_no_more(fun: Any) -> bool:
    """Return whether a Python function can be called with (t, y) and nothing else."""
    code = getattr(fun, "__code__", None)
    return code is not None and code.co_argcount == 2 and not code.co_flags & inspect.CO_VARARGS


def traced_jacobian(
    fun: Callable[..., Any], m: int, t: float, y: Array, args: tuple[Any, ...]
) -> TracedJacobian | None:
    """The Jacobian of an invariant in Python by a trace; None: it has few components, or cannot be traced without an
    effect that could be noticed, or its trace and a difference disagree at (t, y). The latter takes two evaluations."""
    n = len(y)
    if n < FEWEST_COMPONENTS or y.dtype.kind != "f" or not has_llvm():
        return None
    made = TracedJacobian(fun, n, m)
    step, derivative = _INCREMENT * somewhere(y), made.at(t, y, args)
    if derivative.graph is None:
        return None
    jacobian = derivative.jacobian(t, y)
    expected = derivative.value(t, y + step) - derivative.value(t, y - step)
    scale = np.abs(jacobian) @ np.abs(2 * step)
    return made if (np.abs(jacobian @ (2 * step) - expected) <= _TOLERANCE * scale).all() else None


class SparseJacobian:
    """The entries of a user's sparse matrix in one pattern, row by row, as a function of (t, y, \\*args).

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
    by_columns : bool, default False
        The entries are those of the transposed matrix, row by row.

    Attributes
    ----------
    pattern : tuple of list of int
        Where the entries of each row begin, and their columns.
    """

    def __init__(
        self, jac: Callable[..., Any], name: str, known: list[Any], shape: tuple[int, int], *, by_columns: bool = False
    ) -> None:
        self._jac, self._name, self._shape, self._by_columns = jac, name, shape, by_columns
        m, self._n = shape[::-1] if by_columns else shape
        self._places = np.unique(np.concatenate([self._places_of(self._read(one)) for one in known]))
        row, column = np.divmod(self._places, self._n)
        self.pattern = np.searchsorted(row, np.arange(m + 1)).tolist(), column.tolist()

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
        rows = csr_array(matrix.T if self._by_columns else matrix, copy=is_sparse(matrix))
        rows.sum_duplicates()
        return rows.astype(float)

    def _places_of(self, rows: Any) -> Array:
        """i n + j of each entry, which ascends."""
        row = np.repeat(np.arange(len(rows.indptr) - 1), np.diff(rows.indptr))
        return np.asarray(row * self._n + rows.indices)


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
