"""What a problem gives of its matrices, ∂f/∂y and M, checked as far as that needs no call of a function.

SciPy's sparse matrices take longer to import than everything else, and are not imported here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base.arguments import Array, as_array, either, shown
from .._functions.compiled import is_native
from .grouped import JACOBIANS, Banded, bandwidth

#: How a pattern is treated, in words.
_PATTERNS = ("detect", "dense")


@dataclass(frozen=True)
class Matrices:
    """∂f/∂y and M as a problem gives them: functions, constants, or what is known of their structure."""

    jac: Any = None  # whole, or its bands
    jac_sparsity: Any = None
    bands: tuple[int, int] | None = None  # below and above the diagonal
    mass: Any = None


_NOTHING_KNOWN = Matrices()


def to_matrices(
    jac: Any, jac_sparsity: Any, lband: Any, uband: Any, mass: Any, n: int, *, is_complex: bool
) -> Matrices:
    """What a problem of n components gives. Constants are seen to be matrices of n components, and words known ones,
    whatever the method will use.

    Raises
    ------
    TypeError, ValueError
        The one that is wrong.
    """
    if jac is None and jac_sparsity is None and lband is None and uband is None and mass is None:
        return _NOTHING_KNOWN
    whole, names, bands = (n, n), ("lband", "uband"), None
    if isinstance(jac, Banded):
        if lband is not None or uband is not None:
            raise ValueError("give either jac=Banded(lower, upper) or lband and uband, not both")
        names = ("lower of Banded", "upper of Banded")
        lband, uband, jac = jac.lower, jac.upper, jac.fun
    if lband is not None or uband is not None:
        lower, upper = (0 if width is None else width for width in (lband, uband))
        bands = bandwidth(names[0], lower, n), bandwidth(names[1], upper, n)
    if bands is not None and jac_sparsity is not None:
        raise ValueError("give either jac_sparsity or lband and uband (or Banded), not both")
    if isinstance(jac, str):
        _word("jac", jac, JACOBIANS, "a function, a matrix, ")
    elif _is_constant(jac):
        matrix = as_matrix("jac", jac, is_complex)
        if bands is None or matrix.shape != (bands[0] + bands[1] + 1, n):  # GMRES takes it whole, without its bands
            require_shape("jac", matrix, whole)
    if isinstance(jac_sparsity, str):
        _word("jac_sparsity", jac_sparsity, _PATTERNS, "a matrix, ")
    elif jac_sparsity is not None:
        require_shape("jac_sparsity", as_matrix("jac_sparsity", jac_sparsity, is_complex), whole)
    if _is_constant(mass):
        require_shape("mass", as_matrix("mass", mass, is_complex), whole)
    return Matrices(jac, jac_sparsity, bands, mass)


def _is_constant(given: Any) -> bool:
    return not (given is None or callable(given) or is_native(given) or hasattr(given, "matvec"))


def _word(name: str, given: str, known: tuple[str, ...], others: str) -> None:
    if given not in known:
        raise ValueError(f"{name} must be {others}{either(known)}, got {shown(given)}")


def is_sparse(given: Any) -> bool:
    """Whether it is one of SciPy's sparse matrices."""
    return hasattr(given, "tocsr")


def require_shape(name: str, matrix: Any, shape: tuple[int, int], *, banded: bool = False) -> None:
    """A ValueError if a matrix has another shape."""
    if matrix.shape != shape:
        packed = " (the bands, packed as [uband + i - j, j])" if banded else ""
        raise ValueError(f"{name} has shape {matrix.shape}, expected shape {shape}{packed}")


def as_matrix(name: str, given: Any, is_complex: bool) -> Any:
    """A 2-d array or sparse matrix of numbers of the right kind, its values not checked."""
    if hasattr(given, "matvec"):
        raise TypeError(
            f"{name} is a LinearOperator, whose entries are not known: give linear_solver='gmres', or a sparse matrix"
        )
    matrix: Any = _sound(name, given) if is_sparse(given) else as_array(name, given)
    if matrix.ndim == 0 and not is_sparse(matrix):  # one component
        matrix = matrix.reshape(1, 1)
    if matrix.dtype == object or not (np.issubdtype(matrix.dtype, np.number) or matrix.dtype == bool):
        raise TypeError(f"{name} must hold numbers, got {shown(given)}")
    if np.issubdtype(matrix.dtype, np.complexfloating) and not is_complex:
        raise TypeError(f"{name} is complex, expected real numbers (for a complex problem give a complex y0)")
    if matrix.ndim != 2:
        raise ValueError(f"{name} must be 2-dimensional, got shape {matrix.shape}")
    return matrix


def _sound(name: str, given: Any) -> Any:
    """A sparse matrix, once its indices are seen to fit its shape.

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
