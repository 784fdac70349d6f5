"""Matrices as users give them: of one shape, dense or sparse. SciPy's sparse matrices take longer to import than
everything else, and are not imported here."""

from __future__ import annotations

from typing import Any

import numpy as np

from .arguments import Array, as_array, shown


def is_sparse(given: Any) -> bool:
    """Return whether an object is one of SciPy's sparse matrices."""
    return hasattr(given, "tocsr")


def as_dense(matrix: Any) -> Array:
    """Return a matrix, dense or sparse, as an array."""
    return np.asarray(matrix.toarray() if is_sparse(matrix) else matrix)


def as_matrix(
    name: str,
    given: Any,
    shape: tuple[int, int] | None = None,
    *,
    is_complex: bool = False,
    banded: bool = False,
    at: float | None = None,
) -> Any:
    """Convert what a user gives to a 2-d array or sparse matrix of numbers, whose values are not checked.

    - `name`: name of the matrix in messages
    - `given`: the matrix. A single row or column may be given as a 1-d array, a single number as such.
    - `shape`: the shape that it must have
    - `is_complex`: the matrix may be complex
    - `banded`: the matrix is packed by its bands, for the message
    - `at`: the time at which a function returned it, for the message

    Raises TypeError, ValueError: It holds something else than numbers, or has another shape.
    """
    if hasattr(given, "matvec"):
        raise TypeError(
            f"{name} is a LinearOperator, whose entries are not known: give linear_solver='gmres', or a sparse matrix"
        )
    matrix: Any = _sound(name, given) if is_sparse(given) else as_array(name, given)
    if not is_sparse(matrix):
        if matrix.ndim == 0:  # one component
            matrix = matrix.reshape(1, 1)
        elif matrix.ndim == 1 and shape is not None and shape in ((1, len(matrix)), (len(matrix), 1)):
            matrix = matrix.reshape(shape)
    if matrix.dtype == object or not (np.issubdtype(matrix.dtype, np.number) or matrix.dtype == bool):
        raise TypeError(f"{name} must hold numbers, got {shown(given)}")
    if np.issubdtype(matrix.dtype, np.complexfloating) and not is_complex:
        raise TypeError(f"{name} is complex, expected real numbers (for a complex problem give a complex y0)")
    when = "" if at is None else f" at t = {at}"
    if shape is not None and matrix.shape != shape:
        packed = " (the bands, packed as [uband + i - j, j])" if banded else ""
        raise ValueError(f"{name} has shape {matrix.shape}{when}, expected shape {shape}{packed}")
    if matrix.ndim != 2:
        raise ValueError(f"{name} must be 2-dimensional, got shape {matrix.shape}{when}")
    return matrix


def _sound(name: str, given: Any) -> Any:
    """Return a sparse matrix whose indices have been checked to fit its shape.

    SciPy's constructors do not check them all, and nothing prevents later changes; its conversions, and the
    core, would write where they point.
    """
    matrix = given if given.format in ("csc", "csr", "bsr", "coo", "dia") else given.tocsr()
    if matrix.ndim != 2:
        return matrix
    if matrix.format == "dia":
        sound = matrix.data.ndim == 2 and len(matrix.offsets) == len(matrix.data) == len(set(matrix.offsets.tolist()))
    elif matrix.format == "coo":
        sound = len(matrix.row) == len(matrix.col) == len(matrix.data) and (
            _within(matrix.row, matrix.shape[0]) and _within(matrix.col, matrix.shape[1])
        )
    else:
        block = matrix.blocksize if matrix.format == "bsr" else (1, 1)
        rows, columns = (size // side for size, side in zip(matrix.shape, block, strict=True))
        lines, places = (columns, rows) if matrix.format == "csc" else (rows, columns)
        starts, size = matrix.indptr, min(len(matrix.indices), len(matrix.data))
        sound = (
            len(starts) == lines + 1
            and starts[0] == 0
            and starts[-1] <= size
            and bool((starts[1:] >= starts[:-1]).all())
            and _within(matrix.indices[: starts[-1]], places)
        )
    if not sound:
        raise ValueError(
            f"{name} is a sparse matrix whose indices do not fit its shape {matrix.shape}: rows and columns count "
            "from 0; check_format() of a matrix in compressed form tells more"
        )
    return matrix


def _within(indices: Array, size: int) -> bool:
    return len(indices) == 0 or bool(indices.min() >= 0 and indices.max() < size)


def compressed(entries: Array) -> tuple[Array, Array, Array]:
    """Return a dense matrix as compressed columns, without its zeros."""
    starts = np.concatenate([[0], np.cumsum((entries != 0).sum(axis=0))]).astype(np.int32)
    columns, rows = np.nonzero(entries.T)
    return starts, rows.astype(np.int32), entries[rows, columns].astype(float)
