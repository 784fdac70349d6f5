"""`dde23`: MATLAB's call for delay equations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from numpy.typing import ArrayLike

from .._base.arguments import function
from .._base.types import Span
from .._functions.compiled import is_native
from .._problem.delays import HistoryLike, transposed
from .._problem.docstrings import documented
from .._problem.methods import METHODS
from .._problem.options import AllOptions, table_of
from .._results.solution import Solution
from .ivp import solve_ivp

__all__ = ["dde23"]


@documented({}, options=table_of(AllOptions).keys() - {"delays", "history"})
def dde23(
    fun: Callable[..., Any],
    lags: float | str | Sequence[float | str],
    history: HistoryLike,
    tspan: Span,
    y0: ArrayLike | None = None,
    **options: Any,
) -> Solution:
    """Solve y' = f(t, y, y(t - tau_1), ..., y(t - tau_k)) with constant delays, called as MATLAB's function.

    It is `solve_ivp` with ``method="ode23"``, ``delays=lags`` and ``history=``; any other method that takes delays
    serves as well, and most are more accurate for the same work.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, Z, *args)`` with the columns ``Z[:, j]`` = y(t - lags[j]), of shape (n, k).
    lags : number, str, or list of these
        The delays, `delays` of `solve_ivp`.
    history : callable, array_like of shape (n,), or Solution
        y for t <= t0, as for `solve_ivp`.
    tspan : (float, float)
        (t0, tf).
    y0 : array_like of shape (n,), optional
        y(t0), where it differs from the history: MATLAB's option InitialY.
    {options}

    Returns
    -------
    Solution

    References
    ----------
    L. F. Shampine, S. Thompson, Solving DDEs in MATLAB, Appl. Numer. Math. 37 (2001) 441-458.

    Examples
    --------
    >>> import invariode as iv
    >>> def growth(t, y, Z):
    ...     return [-Z[0, 0]]
    >>> sol = iv.dde23(growth, [1.0], 1.0, (0, 2))
    >>> bool(abs(sol.y[0, -1] + 0.5) < 1e-3)
    True
    """
    if is_native(fun):
        raise TypeError("fun of dde23 is a Python function of (t, y, Z): pass machine code of (t, y, z) to solve_ivp")
    if "method" in options:
        raise TypeError(
            "dde23 is the method ode23: for another one, solve_ivp(fun, tspan, y0, method, delays=, history=)"
        )
    called = transposed(function("fun", fun, "f(t, y, Z)"))
    keep = options.get("keep")
    if options.get("t_eval") is None and not (isinstance(keep, str) and keep == "end"):
        options.setdefault("refine", METHODS["ode23"].refine)
    start: Any = y0  # None: the history's
    return solve_ivp(called, tspan, start, "ode23", delays=lags, history=history, **options)
