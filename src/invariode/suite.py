"""The functions of the suite: `solve_ivp`, and each method under its own name with the suite's defaults."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ._types import AllOptions, EventsLike, Function, InvariantsLike, MethodName, RefinedOptions, Span
from .compiled import is_native
from .methods import METHODS, find_method
from .problem import Problem, warn_unused
from .solution import Solution

__all__ = ["dop853", "ode15s", "ode23", "ode45", "ode78", "ode113", "solve_ivp"]


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
    *,
    invariants: InvariantsLike | None = None,
    jac: Any = None,
    jac_sparsity: Any = None,
    lband: int | None = None,
    uband: int | None = None,
    mass: Any = None,
    **options: Unpack[RefinedOptions],
) -> Solution:
    """Solves an initial value problem y' = f(t, y), or M y' = f(t, y), y(t0) = y0, keeping its invariants.

    The positional arguments, the fields of the result and the attributes of events are those of
    `scipy.integrate.solve_ivp`.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args)``: the derivative, a sequence or array of shape (n,); y has shape (n,). Machine code is
        accepted too, here as for all other functions: see `compile`.
    t_span : (float, float)
        (t0, tf). tf < t0 integrates backwards; with an infinite tf only a terminal event or a callback ends the run;
        without one it goes on until memory is full.
    y0 : array_like of shape (n,)
        Initial state, real or complex. Complex states are weighted as pairs of reals.
    method : str, default 'ode45'
        A name in `METHODS`, or SciPy's name of the same method ('RK23', 'RK45', 'DOP853',
        'BDF').
    t_eval : array_like, optional
        Times of the output, sorted in the direction of integration. Default: the ends of the steps.
    dense_output : bool, default False
        Whether ``Solution.sol`` is computed.
    events : callable, Event, or list of these, optional
        Functions ``event(t, y, *args)`` whose zeros are located, to a few units in the last place of t.
    vectorized : bool, default False
        Whether `fun` takes y of shape (n, k). It is called with k = 1.
    args : tuple, optional
        Extra arguments of `fun`, `jac`, `mass`, invariants, events and actions.
    invariants : callable, Invariants, or list of these, optional
        What the solution keeps: each accepted step is projected onto it (paper, sections 3 and 4).

    Other Parameters
    ----------------
    jac, jac_sparsity, lband, uband : optional
        For ode15s: the Jacobian of f, or what is known of it. See `Problem`.
    mass : optional
        For ode15s: the matrix M. See `Problem`.
    max_order : int, optional
        Highest order of the formulas of ode113 (12) and ode15s (5).
    bdf : bool, default False
        ode15s with backward differentiation formulas instead of NDFs: larger errors at the same h, but orders 3 to 5
        are stable in wider sectors.
    rtol : float or array_like of shape (n,), default 1e-3
        The estimated error of component i is kept below ``max(rtol_i |y_i|, atol_i)``. rtol below 100 ε is raised
        to it.
    atol : float or array_like of shape (n,), default 1e-6
        See `rtol`; in the units of y.
    first_step : float, optional
        Size of the first step. Default: chosen from f(t0, y0).
    max_step : float, optional
        Largest step. Default: a tenth of the interval; ``inf`` lifts that.
    refine : int, default 1
        Points per step in the output; those inside the step are interpolated.
    interpolation : {'projected', 'corrected', 'raw'}, default 'projected'
        Values between steps: continuous and on the manifold of the invariants; continuous only; or the method's own
        extension, as in the paper and the suite.
    fsal : {'reuse', 'evaluate'}, default 'reuse'
        For ode23 and ode45, elsewhere a warning. After a projection: take the last stage of the step as the first of
        the next (paper, section 4), or evaluate f at the projected value, for one more f per step.
    callback : callable, optional
        ``callback(t, y)`` after each accepted step; returning True stops.
    save : {'all', 'outputs', 'end'}, optional
        Keep the outputs and a record of each step (``Solution.steps``), the outputs only, or the final state only;
        events are kept always. Default: 'outputs' with `t_eval`, else 'all'. With 'end', and with 'outputs' at
        `t_eval`, memory does not grow with the number of steps, unless `dense_output` is asked for.
    check : bool, default True
        Test that the invariants are invariants, and that their Jacobians are right.
    progress : bool, default False
        Whether a bar on the standard error shows t, h and the time left, ten times a second at most (needs rich).

    Returns
    -------
    Solution

    Raises
    ------
    TypeError, ValueError
        Arguments that are wrong; an option that is unknown; a function that returns the wrong shape.
    InvariantError
        y0 is off a demanded value, a Jacobian is wrong, or an invariant is none already at the start.

    Warns
    -----
    UserWarning
        An option that the method cannot use, a tolerance that was raised, invariants that are redundant.

    Notes
    -----
    A numerical failure is a value: ``success`` is False, and ``message`` says why. Exceptions of the user's functions
    come out unchanged.

    References
    ----------
    L. F. Shampine, Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72.

    Examples
    --------
    >>> import invariode as iv
    >>> def pendulum(t, y):
    ...     return [y[1], -np.sin(y[0])]
    >>> def energy(t, y):
    ...     return y[1] ** 2 / 2 - np.cos(y[0])
    >>> sol = iv.solve_ivp(pendulum, (0, 100), [1.0, 0.0], invariants=energy)
    >>> bool(abs(sol.residual).max() < 1e-6)
    True
    """
    for name, given in (("jac", jac), ("jac_sparsity", jac_sparsity), ("lband", lband), ("uband", uband)):
        if given is not None and name not in (chosen := find_method(method)[0]).options:
            warn_unused(chosen, name, given)
    problem = Problem(
        one_column(fun) if vectorized and not is_native(fun) else fun,
        t_span,
        y0,
        args=args,
        invariants=invariants,
        events=events,
        jac=jac,
        jac_sparsity=jac_sparsity,
        lband=lband,
        uband=uband,
        mass=mass,
    )
    return problem.solve(method, t_eval=t_eval, dense_output=dense_output, **options)


def one_column(fun: Any) -> Callable[..., Any]:
    """A function of columns y (n, k) as a function of one y."""

    def column(t: float, y: Any, *args: Any) -> Any:
        return np.asarray(fun(t, y[:, None], *args)).ravel()

    return column


def _refined(fun: Function, t_span: Span, y0: ArrayLike, method: str, options: AllOptions) -> Solution:
    """With the method's own number of points per step, where the output is not fixed otherwise."""
    if options.get("t_eval") is None and options.get("save") != "end":
        options.setdefault("refine", METHODS[method].refine)
    return solve_ivp(fun, t_span, y0, method, **options)


def ode23(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution:
    """`solve_ivp` with the Bogacki-Shampine (2,3) pair, for crude tolerances. Options as there."""
    return solve_ivp(fun, t_span, y0, "ode23", **options)


def ode45(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution:
    """`solve_ivp` with the Dormand-Prince (4,5) pair and the suite's default of 4 points per step. Options as there."""
    return _refined(fun, t_span, y0, "ode45", options)


def dop853(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution:
    """`solve_ivp` with the eighth-order pair DOP853, for tight tolerances and cheap f. Options as there."""
    return solve_ivp(fun, t_span, y0, "dop853", **options)


def ode78(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution:
    """`solve_ivp` with Verner's (7,8) pair, for tight tolerances, and MATLAB's default of 8 points per step. Options as
    there."""
    return _refined(fun, t_span, y0, "ode78", options)


def ode113(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution:
    """`solve_ivp` with Adams PECE formulas of order 1 to 12, for tight tolerances and costly f. Options as there."""
    return solve_ivp(fun, t_span, y0, "ode113", **options)


def ode15s(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution:
    """`solve_ivp` with NDFs of order 1 to 5, for stiff problems and M y' = f. Options as there."""
    return solve_ivp(fun, t_span, y0, "ode15s", **options)
