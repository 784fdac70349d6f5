"""Matrix-free linear algebra in the form the core takes: products with the Jacobian, a preconditioner."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base.arguments import Array, as_array, shown, warn
from .._base.matrices import is_sparse
from .._functions.compiled import is_native, to_native
from .._functions.layout import ArgumentLayout
from .._problem.grouped import GMRES
from .._problem.jacobian_and_mass import Matrices


@dataclass(frozen=True)
class Krylov:
    """Functions for the core: J v of (t, y, v), None for differences of f; set-up of a preconditioner, or None."""

    product: Any
    preconditioner: Any
    dimension: int  # of the Krylov space; 0: the method's own


def krylov(
    given: Matrices, chosen: GMRES, y0: Array, args: tuple[Any, ...], p: ArgumentLayout, exact: Callable[[], Any]
) -> Krylov:
    """Check a problem's matrices and its linear solver, and return them in the core's form. `exact`: returns the
    product that follows from f, or None.

    Raises TypeError, ValueError: An argument cannot be used without a matrix; there is a mass matrix without a
    preconditioner.
    """
    for name, value in (("jac_sparsity", given.jac_sparsity), ("the width of bands", given.bands)):
        if value is not None:
            warn(f"{name} has no effect with GMRES")
    if given.mass is not None and chosen.preconditioner is None:
        raise ValueError(
            "GMRES needs a preconditioner if there is a mass matrix: its rows may have any scale; give "
            "linear_solver=GMRES(preconditioner=...), which solves (M - c J) x = b approximately"
        )
    return Krylov(
        product=_product(given.jac, chosen.jac_product, y0, p, exact),
        preconditioner=None if chosen.preconditioner is None else _SetUp(chosen.preconditioner, args, y0),
        dimension=chosen.dimension or 0,
    )


def is_operator(given: object) -> bool:
    """Return whether an object is a matrix that is known by its products alone."""
    linalg = sys.modules.get("scipy.sparse.linalg")  # an object of its classes has imported it
    return linalg is not None and isinstance(given, linalg.LinearOperator)


def _product(jac: Any, jac_product: Any, y0: Array, p: ArgumentLayout, exact: Callable[[], Any]) -> Any:
    if jac_product is not None:
        if jac is not None:
            raise ValueError("jac and GMRES(jac_product=) say the same: give one of them")
        n = y0.view(float).size
        return to_native("jac_product", jac_product, 2 * n, n, p, second=n)
    if jac is None or (isinstance(jac, str) and jac == "trace"):
        return exact()
    if isinstance(jac, str) and jac == "differences":
        return None
    if isinstance(jac, str):
        raise ValueError(
            f"jac={jac!r} is for matrices: with GMRES give GMRES(jac_product=), or jac='differences' for differences "
            "of f"
        )
    if is_native(jac):
        raise TypeError(
            "jac is native code that fills a matrix, which GMRES does without: give GMRES(jac_product=), "
            "void (double t, const double* yv, double* Jv, const double* p), with y and then v in yv"
        )
    if callable(jac) and not is_operator(jac):
        return _Evaluated(jac, len(y0))
    constant = _operator("jac", jac, len(y0))
    return lambda t, y, v, *args: constant @ v


def _operator(name: str, given: Any, n: int) -> Any:
    """Return a checked operator that multiplies vectors of n components: an array, a sparse matrix or a
    LinearOperator."""
    operator = given if is_operator(given) or is_sparse(given) else as_array(name, given)
    if operator.shape != (n, n):
        raise ValueError(f"{name} has shape {operator.shape}, expected shape {(n, n)}")
    return operator


class _Evaluated:
    """Products with the Jacobian that a function returns; the function is called where t or y is new."""

    def __init__(self, jac: Callable[..., Any], n: int) -> None:
        self._jac, self._n = jac, n
        self._at: tuple[float, Array, Any] | None = None

    def __call__(self, t: float, y: Array, v: Array, *args: Any) -> Any:
        if self._at is None or self._at[0] != t or not np.array_equal(self._at[1], y):
            self._at = (t, y, _operator("jac(t, y)", self._jac(t, y.copy(), *args), self._n))
        return self._at[2] @ v


class _SetUp:
    """The user's preconditioner: called with (t, y, c), it returns a function that solves for arrays of floats."""

    def __init__(self, preconditioner: Callable[..., Any], args: tuple[Any, ...], y0: Array) -> None:
        self._preconditioner, self._args = preconditioner, args
        self._shape, self._dtype = y0.shape, complex if y0.dtype.kind == "c" else float

    def __call__(self, t: float, y: Array, c: float) -> Callable[[Array], Array]:
        made = self._preconditioner(t, y, c, *self._args)
        inner = made.matvec if is_operator(made) else getattr(made, "solve", made)
        if not callable(inner):
            raise TypeError(
                f"preconditioner(t, y, c) returned {shown(made)}, expected an object with solve(b), a LinearOperator, "
                "or a function of b"
            )

        def solve(b: Array) -> Array:
            x = np.asarray(inner(b))
            if x.shape != self._shape:
                raise ValueError(f"the preconditioner returned shape {x.shape}, expected shape {self._shape}")
            if x.dtype.kind == "c" and self._dtype is float:
                raise TypeError("the preconditioner returned complex numbers, expected real ones")
            return np.ascontiguousarray(x, dtype=self._dtype).view(float)

        return solve
