"""`solve_ivp`: SciPy's call, with invariants."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import flag, function
from .._base.types import EventsLike, Function, MethodName, Span
from .._functions.compiled import is_native
from .._functions.second_order import SecondOrder
from .._problem.docstrings import documented
from .._problem.given_options import parted, unused
from .._problem.options import CallingOptions, DescribingOptions, OutputOptions, SolveOptions, table_of
from .._problem.problem import Problem
from .._results.solution import Solution
from .._run.run import solve

if TYPE_CHECKING:
    from .._problem.accepted import solve_options

__all__ = ["solve_ivp"]


@documented(
    by_position=[*table_of(OutputOptions), *table_of(CallingOptions), "vectorized", "invariants"],
    options=table_of(SolveOptions).keys() - {"invariants"},
)
def solve_ivp(
    fun: Function,
    t_span: Span,
    y0: ArrayLike,
    method: MethodName = "ode45",
    t_eval: ArrayLike | None = None,
    dense_output: bool = False,
    events: EventsLike = None,
    vectorized: bool = False,
    args: Iterable[Any] | None = None,
    **options: Unpack[SolveOptions],
) -> Solution:
    """Solve an initial value problem y' = f(t, y), or M y' = f(t, y), y(t0) = y0, keeping its invariants.

    The positional arguments, the fields of the result and the attributes of events are those of
    `scipy.integrate.solve_ivp`. The arguments and options by topic, in the order of the lists below:

    {topics}

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args)``: the derivative, a sequence or array of shape (n,); y has shape (n,). Machine code is
        accepted too, here as for all other functions: see `compile`.
    t_span : (float, float)
        (t0, tf). tf < t0 integrates backwards. With an infinite tf the run goes on until a terminal event, a callback
        or one of its `limits` ends it.
    y0 : array_like of shape (n,)
        Initial state, real or complex. Complex states are weighted as pairs of reals.
    method : str, default 'ode45'
        A name in `METHODS`, or SciPy's name of the same method ('RK23', 'RK45', 'DOP853',
        'Radau', 'BDF', 'LSODA').
    {by_position}

    Other Parameters
    ----------------
    {options}

    Returns
    -------
    Solution

    Raises
    ------
    TypeError, ValueError
        Wrong arguments; an unknown option; a function that returns the wrong shape.
    InvariantError
        At the start, y0 is off a demanded value, a Jacobian is wrong, or an invariant is not conserved.

    Warns
    -----
    UserWarning
        An option that the method cannot use, a tolerance that was raised, redundant invariants.

    Notes
    -----
    A numerical failure does not raise: ``success`` is False and ``message`` gives the reason. Exceptions in your
    functions propagate unchanged; an OverflowError of `fun`, with which Python's ``math`` says inf, only if the step
    cannot be taken with a smaller h either.

    References
    ----------
    L. F. Shampine, Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def pendulum(t, y):
    ...     return [y[1], -np.sin(y[0])]
    >>> def energy(t, y):
    ...     return y[1] ** 2 / 2 - np.cos(y[0])
    >>> sol = iv.solve_ivp(pendulum, (0, 100), [1.0, 0.0], invariants=energy)
    >>> bool(abs(sol.residual).max() < 1e-6)
    True
    """
    if TYPE_CHECKING:
        solve_options(**options)  # editors complete options from this call
    describing: DescribingOptions = {}
    running: Any = options
    if not DescribingOptions.__annotations__.keys().isdisjoint(options):
        describing, running = parted(options, DescribingOptions)
        unused(method, describing)
    if vectorized is not False and flag("vectorized", vectorized):
        fun = one_column(fun, describing)
    running["t_eval"], running["dense_output"] = t_eval, dense_output
    if events is None and not describing:
        return solve(Problem.plain(fun, t_span, y0, args), method, running)
    return solve(Problem(fun, t_span, y0, args=args, events=events, **describing), method, running)


def one_column(fun: Any, describing: Mapping[str, Any]) -> Any:
    """Return a function of columns y (n, k) as a function of one y, with its name. Machine code is one already."""
    if is_native(fun):
        return fun
    if describing.get("inplace"):
        raise ValueError("vectorized and inplace exclude each other: fun(t, y, out) fills one y at a time")
    if isinstance(fun, SecondOrder):
        return SecondOrder(one_column(fun.fun, describing))
    function("fun", fun, "f(t, y)")

    @functools.wraps(fun)
    def alone(t: float, y: Any, *args: Any) -> Any:
        returned = fun(t, y[:, None], *args)
        return None if returned is None else np.asanyarray(returned).ravel()

    return alone
