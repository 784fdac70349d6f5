"""The sparsity pattern of a large Jacobian, found from values of f."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import Array
from .._base.matrices import is_sparse
from .._functions.compiled import is_native, to_native
from .._functions.layout import ArgumentLayout
from .._problem.bounds import Bounds
from .._problem.core_problem import CoreProblem
from .._problem.jacobian_and_mass import Matrices

#: From this n on a pattern is sought: below it dense factors take less time than f.
_LARGE = 200
#: The search may take this part of the evaluations of f that one dense Jacobian takes, and so may each Jacobian with
#: the pattern; more entries than this part of all are not sparse.
_PART_OF_DENSE, _PART_OF_COLUMNS, _FULL = 0.5, 0.25, 0.1


def find_pattern(
    given: Matrices,
    fun: Any,
    t: float,
    y: Array,
    args: tuple[Any, ...],
    parameters: ArgumentLayout,
    bounds: Bounds | None = None,
) -> tuple[tuple[Array, Array, Array], int] | None:
    """The pattern of ∂f/∂y as (starts, rows, values), and the evaluations of f that it took. None: the Jacobian is
    dense, or not large, or is not to be examined."""
    way = given.jac_sparsity
    reals = y.view(float)
    n = len(reals)
    if way == "dense" or n == 0 or (way is None and not is_large(given, n)):
        return None
    form = to_native("fun", fun, n, n, parameters) if is_native(fun) else _Anywhere(fun, y)
    problem = CoreProblem(n, y.dtype.kind == "c", form, args, parameters, bounds=bounds)
    most = int(_PART_OF_DENSE * n) if way is None else 4 * n + 100
    found, evaluations, each = _core.sparsity(t, reals, problem, most, way is None)
    if found is None or (way is None and not (is_sparse_enough(len(found[1]), n) and each <= _PART_OF_COLUMNS * n)):
        return None
    starts, rows = found
    return (starts, rows, np.ones(len(rows))), evaluations


def is_large(given: Matrices, n: int) -> bool:
    """Return whether sparse linear algebra may pay for n components: not with a dense M, which makes the iteration
    matrix dense."""
    mass = given.mass
    if n < _LARGE or mass is None or is_sparse(mass):
        return n >= _LARGE
    return not callable(mass) and bool(np.count_nonzero(mass) <= _FULL * np.size(mass))


def is_sparse_enough(entries: int, n: int) -> bool:
    """Return whether this number of entries is few enough for a sparse n × n matrix."""
    return entries <= _FULL * n**2


class _Anywhere:
    """f at points that no solution may come to: NaN where it is not defined, without warnings."""

    def __init__(self, fun: Callable[..., Any], y: Array) -> None:
        self._fun, self._undefined = fun, np.full_like(y, np.nan)

    def __call__(self, t: float, y: Array, *args: Any) -> Any:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            try:
                return self._fun(t, y, *args)
            except (ValueError, ArithmeticError):
                return self._undefined
