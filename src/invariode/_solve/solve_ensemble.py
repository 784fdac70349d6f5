"""`solve_ensemble`: a problem from its parts, solved from many initial values."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import TYPE_CHECKING, Any, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import as_array
from .._base.types import EventsLike, Function, MethodName, Span
from .._ensemble.ensemble_solution import EnsembleSolution
from .._ensemble.store import EnsembleStore
from .._problem.docstrings import documented
from .._problem.given_options import parted
from .._problem.options import DescribingOptions, EnsembleOptions, table_of
from .._problem.problem import Problem

if TYPE_CHECKING:
    from .._problem.accepted import ensemble_options

__all__ = ["solve_ensemble"]


@overload
def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike | Iterator[tuple[ArrayLike, Any]],
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    events: EventsLike = None,
    t_eval: ArrayLike | None = None,
    store: None = None,
    **options: Unpack[EnsembleOptions],
) -> EnsembleSolution:
    raise NotImplementedError(ensemble_options(**options))  # never called: editors complete options from this call


@overload
def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike | Iterator[tuple[ArrayLike, Any]],
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    events: EventsLike = None,
    t_eval: ArrayLike | None = None,
    store: str | os.PathLike[str],
    **options: Unpack[EnsembleOptions],
) -> EnsembleStore: ...
@documented({"on_failure": "warn"}, options=table_of(EnsembleOptions))
def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike | Iterator[tuple[ArrayLike, Any]],
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    events: EventsLike = None,
    t_eval: ArrayLike | None = None,
    store: str | os.PathLike[str] | None = None,
    **options: Unpack[EnsembleOptions],
) -> EnsembleSolution | EnsembleStore:
    """Solve one problem from many initial values, or with many parameter sets, in parallel.

    Short for ``Problem(fun, t_span, y0, ...).solve_ensemble(y0, method, ...)``; see `Problem.solve_ensemble`.

    Parameters
    ----------
    fun, t_span, method, events
        As in `solve_ivp`.
    y0 : array_like of shape (N, n) or (n,), or iterator
        Initial states, one row per trajectory, or one for all. An iterator yields pairs ``(y0, args)``.
    args, t_eval, store
        As in `Problem.solve_ensemble`.

    Other Parameters
    ----------------
    {options}

    Returns
    -------
    EnsembleSolution or EnsembleStore
        The second with a `store`.

    Raises
    ------
    FileExistsError, TypeError, ValueError, RuntimeError
        As for `Problem.solve_ensemble`.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def f(t, y, a):
    ...     return [a * y[0]]
    >>> out = iv.solve_ensemble(f, (0, 1), [1.0], args=[[-1.0], [-2.0]], workers=1, rtol=1e-8, atol=1e-10)
    >>> np.allclose(out.y_end[:, 0], np.exp([-1, -2]), rtol=1e-7)
    True
    """
    describing, others = parted(options, DescribingOptions)
    rows, like = _like_one(y0)
    problem = Problem(fun, t_span, like, events=events, **describing)
    from .._ensemble.ensemble import Wanted, solve_rows

    return solve_rows(problem, Wanted(rows, args, t_eval, store), method, others)


def _like_one(y0: Any) -> tuple[Any, Any]:
    """Return the rows as given, and zeros like one of them, (n,): trajectories start at the rows alone.

    Errors in rows are found when they are solved.
    """
    first = y0
    if isinstance(y0, Iterator):
        taken = next(y0, None)
        y0 = iter(()) if taken is None else chain([taken], y0)
        first = taken[0] if isinstance(taken, tuple) and taken else 0.0
    states = as_array("y0", first)
    return y0, np.zeros(states.shape[-1] if states.ndim else 1, complex if states.dtype.kind == "c" else float)
