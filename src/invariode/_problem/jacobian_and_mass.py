"""Matrices of a problem, ∂f/∂y and M, checked as far as that needs no call of a function."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import numpy as np

from .._base.arguments import Array, either, shown, warn_of_order
from .._base.matrices import as_matrix
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


NO_MATRICES = Matrices()


def own_matrix(given: Any) -> Any:
    """Return a copy of a constant matrix, which the caller could change; functions, words and None as they are."""
    if isinstance(given, np.ndarray):
        return given.copy()
    # What is wrong with a sparse matrix is said later: its own copy would raise, or read beyond its arrays.
    return deepcopy(given) if isinstance(given, (list, tuple)) or hasattr(given, "tocsc") else given


def own_list(given: Any) -> Any:
    """Return a copy of numbers in lists, arrays or objects that the caller could change."""
    fixed = type(given) is tuple and all(type(one) in (float, int, type(None)) for one in given)
    return given if fixed or type(given) in (bool, str, type(None)) else deepcopy(given)


def to_matrices(jac: Any, jac_sparsity: Any, lband: Any, uband: Any, mass: Any, y0: Array) -> Matrices:
    """Return the matrices of a problem with this start, of n components. Constants are checked to be matrices of n
    components, and words to be known ones, whatever the method will use.

    Raises TypeError, ValueError: The one that is wrong.
    """
    if jac is None and jac_sparsity is None and lband is None and uband is None and mass is None:
        return NO_MATRICES
    n, is_complex = len(y0), y0.dtype.kind == "c"
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
    if type(jac) is FunctionType:
        warn_of_order("jac", jac, "jac(t, y)")
    if isinstance(jac, str):
        _word("jac", jac, JACOBIANS, "a function, a matrix, ")
    elif _is_constant(jac):
        packed = None if bands is None else (bands[0] + bands[1] + 1, n)
        if packed is None or np.shape(jac) != packed:  # GMRES takes it whole, without its bands
            as_matrix("jac", jac, whole, is_complex=is_complex)
        else:
            as_matrix("jac", jac, packed, is_complex=is_complex, banded=True)
    if isinstance(jac_sparsity, str):
        _word("jac_sparsity", jac_sparsity, _PATTERNS, "a matrix, ")
    elif jac_sparsity is not None:
        as_matrix("jac_sparsity", jac_sparsity, whole, is_complex=is_complex)
    if _is_constant(mass):
        as_matrix("mass", mass, whole, is_complex=is_complex)
    return Matrices(jac, jac_sparsity, bands, mass)


def _is_constant(given: Any) -> bool:
    return not (given is None or callable(given) or is_native(given) or hasattr(given, "matvec"))


def _word(name: str, given: str, known: tuple[str, ...], others: str) -> None:
    if given not in known:
        raise ValueError(f"{name} must be {others}{either(known)}, got {shown(given)}")
