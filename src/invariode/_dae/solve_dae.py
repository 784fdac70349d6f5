"""`solve_dae`, and MATLAB's `ode15i` and `decic`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, call_name, interval, numbers, shown, state
from .._base.types import EventsLike, MethodName, Span
from .._problem.given_options import refused
from .._problem.options import Options
from .._problem.sensitivities import SensitivitiesLike
from .._results.solution import Solution
from .dae import Dae
from .residual import ResidualForm, solve_residual
from .traced_equations import UntracedError

if TYPE_CHECKING:
    from .._problem.accepted import run_options

__all__ = ["decic", "ode15i", "solve_dae"]


#: Options that describe other kinds of problems, with the advice of their error messages.
_INSTEAD = {
    "delays": "delayed values are possible in solve_ivp, for y' = f(t, y, z)",
    "history": "delayed values are possible in solve_ivp, for y' = f(t, y, z)",
    "inputs": "call the Input, or an interpolator of SciPy's, in F",
    "invariants": "the constraints of F are imposed anyway. For more, such as an energy, solve problem.replace("
    "invariants=[*problem.invariants, Invariants(g, level=2)]) with problem = dae.problem(t_span)",
    "labels": "the unknowns are named by names=",
    "mass": "write M y' in F",
}


def solve_dae(
    F: Callable[..., Any],
    t_span: Span,
    y0: ArrayLike,
    yp0: ArrayLike | None = None,
    *,
    method: MethodName = "auto",
    fixed: Iterable[str | int] | None = None,
    args: Iterable[Any] = (),
    order: Literal[1, 2] = 1,
    names: Sequence[str] | None = None,
    equations: Sequence[str] | None = None,
    events: EventsLike = None,
    sensitivities: SensitivitiesLike | None = None,
    nonnegative: Any = None,
    bounds: Any = None,
    jac: Callable[..., Any] | None = None,
    jac_sparsity: Any = None,
    lband: int | None = None,
    uband: int | None = None,
    **options: Unpack[Options],
) -> Solution:
    """Solve differential-algebraic equations ``F(t, y, y', *args) = 0`` of any index.

    `Dae` finds what has to be differentiated, and consistent initial values; the resulting ODE is solved by any method,
    and all constraints, hidden ones included, are imposed by projection.

    Parameters
    ----------
    F : callable
        ``F(t, y, yp, *args)`` returns n residuals for n unknowns; see `Dae`.
    t_span : (float, float)
        (t0, tf).
    y0 : array_like of shape (n,)
        Initial values, or guesses of them.
    yp0 : array_like of shape (n,), optional
        Initial derivatives, or guesses. Default: unknown.
    method : str, default 'auto'
        A method of `METHODS`. Equations that are not linear in what they determine become algebraic equations for
        methods that take a singular mass matrix, and are differentiated once more for the others; for them 'auto' is
        radau.
    fixed : sequence of str or int, optional
        Initial values that must stay: see `Dae.consistent`.
    args : tuple, optional
        Further arguments of F.
    order : {1, 2}, default 1
        The highest derivative that F takes: ``F(t, y, yp, ypp, *args)`` with 2.
    names, equations : sequence of n str, optional
        Names of unknowns and equations, for messages and pictures.
    events : callable, Event, or list of these, optional
        ``event(t, y, *args)`` with the unknowns y. The `action` of an `Event` returns new unknowns y, or a pair (y, yp)
        where it changes derivatives; the run continues from the nearest consistent state.
    sensitivities : bool, str, list of these, or Sensitivities, optional
        Parameters among `args`, as for `solve_ivp`.
    nonnegative : bool, int, str or sequence of int or str, optional
        Unknowns that must not become negative: indices or names; True means all. False switches the warning about
        components that fall below 0 off.
    bounds : (lower, upper), optional
        Bounds of the unknowns, numbers or arrays of shape (n,); an infinite entry is no bound. Only unknowns that have
        initial values, or are algebraic variables of a method with a singular mass matrix, can have bounds; those that
        the equations give as formulas are an error.
    jac : callable, optional
        Of an F that cannot be traced: ``jac(t, y, yp, *args)`` returns the pair (∂F/∂y, ∂F/∂y'), (n, n) each, dense or
        sparse. Default: finite differences.
    jac_sparsity : array_like or sparse matrix of shape (n, n), or a pair of them, optional
        Where ∂F/∂y and ∂F/∂y' are not zero, for finite differences in groups of columns and sparse linear algebra.
    lband, uband : int, optional
        The bandwidths of both, in place of `jac_sparsity`.
    **options
        Those of `Problem.solve`, such as rtol, atol, t_eval, dense_output, max_step. A vector `atol` has one value per
        unknown; the derivatives of an unknown have the same.

    Returns
    -------
    Solution
        With y (n, n_t) in the order of the unknowns, algebraic ones included, and yp. ``drift()`` has the residuals of
        all constraints. ``sol.reduced`` is the solution of the reduced problem.

    Raises
    ------
    ValueError
        The equations do not determine the unknowns; see `Dae`.
    InvariantError
        There are no consistent initial values; or the solution does not satisfy F = 0 at an output, which is tested
        with all derivatives at each of them.
    TypeError
        F cannot be traced, and is not of index 0 or 1; or it can, and jac or its structure is given, which its
        expressions have.

    Warns
    -----
    UserWarning
        Initial values were moved onto the constraints by more than roundoff.

    Notes
    -----
    If F cannot be traced, ode15s or radau solves F(t, y, y') = 0 as it stands, for an index of at most 1.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def pendulum(t, y, yp):
    ...     x, z, u, v, tension = y
    ...     return [yp[0] - u, yp[1] - v, yp[2] + tension * x, yp[3] + tension * z + 9.81, x**2 + z**2 - 1]
    >>> sol = iv.solve_dae(pendulum, (0, 5), [1, 0, 0, 0, 0], rtol=1e-8, atol=1e-10)
    >>> bool(np.abs(sol.y[0] ** 2 + sol.y[1] ** 2 - 1).max() < 1e-14)
    True
    """
    if TYPE_CHECKING:
        run_options(**options)  # editors complete options from this call
    span = interval(t_span)
    _require_known(options)
    try:
        dae = Dae(F, span[0], y0, yp0, args=args, names=names, equations=equations, order=order)
    except UntracedError as error:
        needing = {
            "order=2": order == 2,
            "sensitivities": sensitivities is not None,
            "fixed": bool(fixed),
            "nonnegative": nonnegative is not None and nonnegative is not False,
            "bounds": bounds is not None,
        }
        if what := next((name for name, is_given in needing.items() if is_given), ""):
            raise TypeError(f"{error}. {what} needs its expressions") from None
        form = _as_it_stands(error, F, span[0], y0, yp0, tuple(args), names)
        structure = jac_sparsity, lband, uband
        return solve_residual(form, span, tuple(args), method, events, call_name(F, "dae"), options, jac, structure)
    for name, given in (("jac", jac), ("jac_sparsity", jac_sparsity), ("lband", lband), ("uband", uband)):
        if given is not None:
            raise TypeError(f"{name} is for an F that cannot be traced: the derivatives of {dae.name} are exact")
    return dae.solve(
        span,
        method,
        fixed=fixed or (),
        events=events,
        sensitivities=sensitivities,
        nonnegative=nonnegative,
        bounds=bounds,
        **options,
    )


def _require_known(options: Options) -> None:
    """Raise a TypeError for an option that `solve_dae` does not take; its message says what to do instead."""
    for name in options:
        if name in _INSTEAD:
            raise TypeError(f"solve_dae takes no {name}: {_INSTEAD[name]}")
        if name not in Options.__optional_keys__:
            raise refused(name)


def _as_it_stands(
    why: UntracedError,
    F: Callable[..., Any],
    t0: float,
    y0: ArrayLike,
    yp0: ArrayLike | None,
    args: tuple[Any, ...],
    names: Sequence[str] | None,
) -> ResidualForm:
    """Return the residual form of an F without expressions."""
    start = state(y0), np.zeros(np.size(y0)) if yp0 is None else state(yp0, "yp0")
    labels = [f"y[{j}]" for j in range(np.size(y0))] if names is None else list(names)
    try:
        return ResidualForm(F, t0, *start, args, labels)
    except ValueError as objection:
        raise TypeError(f"{why}. As it stands it cannot be solved either: {objection}") from None


def ode15i(
    F: Callable[..., Any],
    t_span: Span,
    y0: ArrayLike,
    yp0: ArrayLike,
    *,
    args: Iterable[Any] = (),
    jac: Callable[..., Any] | None = None,
    jac_sparsity: Any = None,
    **options: Unpack[Options],
) -> Solution:
    """Solve ``F(t, y, y', *args) = 0`` with the formulas of ode15s, as MATLAB's function of this name does.

    Unlike MATLAB's it solves equations of any index, and moves initial values that are not consistent.

    Parameters
    ----------
    F : callable
        ``F(t, y, yp, *args)`` returns n residuals.
    t_span : (float, float)
        (t0, tf).
    y0, yp0 : array_like of shape (n,)
        Initial values and derivatives; `decic` finds consistent ones.
    args : tuple, optional
        Further arguments of F.
    jac, jac_sparsity : optional
        As in `solve_dae`.
    **options
        Those of `solve_dae`; the default of `max_step` is a tenth of the interval, as in MATLAB.

    Returns
    -------
    Solution
        As of `solve_dae`.

    Notes
    -----
    L. F. Shampine, Solving 0 = F(t, y(t), y'(t)) in MATLAB, J. Numer. Math. 10 (2002) 291-310.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def weissinger(t, y, yp):
    ...     return t * y**2 * yp**3 - y**3 * yp**2 + t * (t**2 + 1) * yp - t**2 * y
    >>> y0, yp0 = iv.decic(weissinger, 1, [np.sqrt(1.5)], [1], [0], [0])
    >>> sol = iv.ode15i(weissinger, (1, 10), y0, yp0)
    >>> bool(abs(sol.y[0, -1] - np.sqrt(100.5)) < 0.01)
    True
    """
    options.setdefault("max_step", "tenth")
    return solve_dae(F, t_span, y0, yp0, method="ode15s", args=args, jac=jac, jac_sparsity=jac_sparsity, **options)


def decic(
    F: Callable[..., Any],
    t0: float,
    y0: ArrayLike,
    fixed_y0: ArrayLike | None,
    yp0: ArrayLike,
    fixed_yp0: ArrayLike | None,
    *,
    args: Iterable[Any] = (),
) -> tuple[Array, Array]:
    """Compute consistent initial values for `ode15i`, as MATLAB's function of this name does.

    Parameters
    ----------
    F : callable
        ``F(t, y, yp, *args)`` returns n residuals.
    t0 : float
        The initial time.
    y0, yp0 : array_like of shape (n,)
        Guesses.
    fixed_y0, fixed_yp0 : array_like of shape (n,) or None
        1 where a value must stay, 0 where it may change. None: all may change.
    args : tuple, optional
        Further arguments of F.

    Returns
    -------
    y0 : ndarray, (n,)
        The nearest consistent values, which satisfy hidden constraints too.
    yp0 : ndarray, (n,)
        Their derivatives.

    Raises
    ------
    InvariantError
        There are no such values near the guesses.

    Examples
    --------
    >>> import invariode as iv
    >>> iv.decic(lambda t, y, yp: [yp[0] + y[0] - y[1], y[0] ** 2 - y[1]], 0, [2, 0], [1, 0], [0, 0], [0, 0])
    (array([2., 4.]), array([2., 8.]))
    """
    dae = Dae(F, t0, y0, yp0, args=args)
    fixed = [
        name + prime
        for prime, mask in (("", fixed_y0), ("'", fixed_yp0))
        for name, held in zip(dae.names, _mask(mask, len(dae.names)), strict=True)
        if held
    ]
    start = dae.consistent(fixed)
    return start.y, start.yp


def _mask(mask: ArrayLike | None, n: int) -> list[bool]:
    if mask is None or np.size(mask) == 0:
        return [False] * n
    found = numbers("a mask of fixed values", mask)
    if found.shape != (n,) or not np.isin(found, (0, 1)).all():
        raise ValueError(f"fixed_y0 and fixed_yp0 must be {n} zeros and ones, got {shown(mask)}")
    return [bool(one) for one in found]
