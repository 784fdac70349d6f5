"""Points projected onto invariants."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    ATOL,
    RTOL,
    Array,
    extra_arguments,
    numbers,
    real_numbers,
    require_unlabelled,
    shown,
    weights_of,
)
from .._base.types import Numbers, Points
from .._functions.compiled import is_native
from .._problem.invariants import Invariants, InvariantsLike, demanded_values, to_invariants
from .bound import BoundInvariants, bind


@dataclass(frozen=True)
class ImposeResult:
    """Points projected onto the invariants.

    Attributes
    ----------
    y : ndarray, (n,) or (n, n_t)
        The projected points; those that did not converge are as they were given.
    converged : bool or ndarray of bool, (n_t,)
        Whether every residual is roundoff: at most ``10 ε (|value_i| + Σ_j |J_ij y_j|)``.
    residual : ndarray, (m,) or (m, n_t)
        g(t, y) - value at the points returned.
    iterations : int or ndarray of int, (n_t,)
        Gauss-Newton iterations spent.
    sol : callable or None
        The dense output of the result, if it has one, projected; ``sol(t)`` has shape (n,) or (n, n_t).
    """

    y: Array
    converged: Any
    residual: Array
    iterations: Any
    sol: Callable[[Any], Array] | None = None


@dataclass(frozen=True)
class ImposedDense:
    """A continuous solution, its values projected to roundoff."""

    sol: Callable[[Any], Array]
    bound: BoundInvariants
    rtol: ArrayLike
    atol: ArrayLike

    def __call__(self, t: Any) -> Array:
        y = np.asarray(self.sol(t))
        columns = y.reshape(len(y), -1)
        imposed = self.bound.impose(np.atleast_1d(np.asarray(t, dtype=float)), columns, self.rtol, self.atol)
        return imposed.y.reshape(y.shape)


@overload
def impose(
    invariants: InvariantsLike,
    t: Points,
    y: None = None,
    *,
    value: Numbers | None = None,
    args: Iterable[Any] = (),
    rtol: Numbers = RTOL,
    atol: Numbers = ATOL,
) -> ImposeResult: ...


@overload
def impose(
    invariants: InvariantsLike,
    t: ArrayLike,
    y: ArrayLike,
    *,
    value: Numbers | None = None,
    args: Iterable[Any] = (),
    rtol: Numbers = RTOL,
    atol: Numbers = ATOL,
) -> ImposeResult: ...


def impose(
    invariants: InvariantsLike,
    t: Any,
    y: ArrayLike | None = None,
    *,
    value: Numbers | None = None,
    args: Iterable[Any] = (),
    rtol: Numbers = RTOL,
    atol: Numbers = ATOL,
) -> ImposeResult:
    """Projects given points onto invariants, about as accurately as double precision allows (paper, section 4).

    Parameters
    ----------
    invariants : callable, Invariants, or list or dict of these
        As for `solve_ivp`.
    t : float or array_like of shape (n_t,), or a result
        Times of the points; or a `Solution` or a result of SciPy's, for its t and y.
    y : array_like, (n,) or (n, n_t)
        One point, or points in columns.
    value : float or array_like of shape (m,), optional
        The values to impose. Default: those of the `Invariants`, else the values of g at the first point.
    args : tuple, optional
        Extra arguments of the functions.
    rtol, atol : float or array_like of shape (n,)
        They give the weights ``max(|y|, atol / rtol)`` of the distance. Default 1e-3, 1e-6.

    Returns
    -------
    ImposeResult
        With the shapes of the points given.

    Raises
    ------
    TypeError
        `t` is not a result, and `y` is missing.
    ValueError
        The shapes of t and y do not match; an invariant is not finite at the first point; none is given.

    Notes
    -----
    At most 50 Gauss-Newton iterations, each with a fresh Jacobian, until the correction stagnates at roundoff.

    Examples
    --------
    >>> import invariode as iv
    >>> found = iv.impose(lambda t, y: y @ y, 0.0, [0.6, 0.81], value=1)
    >>> (found.y.round(4), found.converged)
    (array([0.5969, 0.8023]), True)
    """
    dense = None
    if y is None:
        if not (hasattr(t, "t") and hasattr(t, "y")):
            raise TypeError(f"impose takes points (t, y) or a result with fields t and y, got t = {shown(t)} without y")
        dense, t, y = getattr(t, "sol", None), t.t, t.y
    points, times = _points(t, y)
    extra = extra_arguments(args)
    listed = to_invariants(invariants)
    if not listed:
        raise ValueError("impose needs at least one invariant")
    if any(one.direction == "stages" for one in listed):
        raise ValueError(
            'impose has no steps, hence no stages to correct along: give it invariants with direction="gradient"'
        )
    if one_sided := [one for one in listed if one.sense]:
        raise ValueError(
            f"impose is for invariants, and {one_sided[0]!r} has no value at a single point: leave it out; "
            "sol.residual and plot_drift show where it rises"
        )
    if points.shape[1] == 0:
        empty, values = np.zeros(0, dtype=int), sum(_count_values(one, points, extra) for one in listed)
        return ImposeResult(points, empty.astype(bool), np.zeros((values, 0)), empty)
    threshold = weights_of(rtol, atol, points[:, 0]).threshold
    bound = bind(listed, float(times[0]), points[:, 0], extra, threshold)
    if value is not None:
        demanded = demanded_values(value)
        if len(demanded) not in (1, len(bound)):
            raise ValueError(f"value must have shape ({len(bound)},), as the invariants have, got {shown(value)}")
        bound = replace(bound, value=demanded + np.zeros(len(bound)))
    result = ImposeResult(*bound.impose(times, points, rtol, atol))
    if dense is not None:
        return replace(result, sol=ImposedDense(dense, bound, rtol, atol))
    if np.ndim(y) == 2:
        return result
    return ImposeResult(result.y[:, 0], bool(result.converged[0]), result.residual[:, 0], int(result.iterations[0]))


def _count_values(one: Invariants, points: Array, args: tuple[Any, ...]) -> int:
    """Return the number of values of an invariant where no point determines it: by its names or values, or from its
    result for y = 1; 1 if it is not defined there."""
    counts = [len(known) for known in (one.names, one.value) if known is not None]
    if counts or is_native(one.fun):
        return max(counts, default=1)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            return int(np.size(one.fun(0.0, np.ones(len(points), points.dtype), *args)))
        except Exception:  # whatever the user's function raises there
            return 1


def _points(t: Any, y: ArrayLike) -> tuple[Array, Array]:
    """Points as (n, n_t), times as (n_t,)."""
    given = numbers("y", y)
    if given.ndim == 1:
        require_unlabelled("y", y)
    if given.ndim not in (1, 2) or len(given) == 0:
        raise ValueError(f"y must have shape (n,) or (n, n_t) with n >= 1, got {given.shape}")
    points = given[:, None] if given.ndim == 1 else given
    times = real_numbers("t", t)
    if times.shape not in ((), (points.shape[1],)):
        raise ValueError(f"t must have one time per point, shape ({points.shape[1]},), got {times.shape}")
    if not all(math.isfinite(one) for one in times.ravel()):
        raise ValueError("t must be finite")
    return points, np.broadcast_to(times, (points.shape[1],)).copy()
