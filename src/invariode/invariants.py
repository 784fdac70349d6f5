"""Invariants: what a solution keeps, and points projected onto it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from ._arguments import (
    Array,
    call_name,
    extra_arguments,
    function,
    numbers,
    positive_integer,
    tolerances,
)

__all__ = ["ImposeResult", "InvariantError", "Invariants", "impose"]


class InvariantError(ValueError):
    """An invariant contradicts the problem: its value at the start, its Jacobian, or that it is none."""


class Invariants:
    """Functions of the solution that keep their values, imposed by projection (paper, sections 2-4).

    Parameters
    ----------
    fun : callable
        ``g(t, y, *args)``, a number or an array of shape (m,); y has shape (n,). For complex y the values are real.
    jac : callable, optional
        ``jac(t, y, *args)``, the Jacobian ∂g/∂y of shape (m, n), or (n,) for m = 1. For complex y row i holds
        ∂g_i/∂(Re y) + 1j ∂g_i/∂(Im y). Default: central differences, 2n evaluations of g for each.
    value : float or array_like of shape (m,), optional
        The value to be held; constraints have 0. Default: that of g at the initial point.
    names : str or sequence of m str, optional
        For messages and tables. Default: the name of `fun`.
    iterations : int, optional
        Projection iterations per step. Default: that of the method, 1 or, for ode45, 2 (paper, section 4).

    Notes
    -----
    The units of g do not matter: distances to the manifold are measured in the weights of the error test. Redundant
    invariants are dropped with a warning. A function that is no invariant of the equations is refused.
    """

    def __init__(
        self,
        fun: Callable[..., Any],
        jac: Callable[..., Any] | None = None,
        value: ArrayLike | None = None,
        names: str | Sequence[str] | None = None,
        iterations: int | None = None,
    ) -> None:
        self.fun = function("the invariant", fun, "g(t, y)")
        self.jac = None if jac is None else function("jac of the invariant", jac, "jac(t, y)")
        self.value = None if value is None else _values(value)
        self.names = None if names is None else _names(names)
        self.iterations = None if iterations is None else positive_integer("iterations", iterations)

    def __repr__(self) -> str:
        held = "" if self.value is None else f", value={self.value.tolist()}"
        return f"Invariants({', '.join(self.names or [call_name(self.fun, 'g')])}{held})"


def _values(value: ArrayLike) -> Array:
    try:
        values = np.atleast_1d(np.array(value, dtype=float))
    except (TypeError, ValueError):
        raise TypeError(f"value of an invariant must be a number or an array of numbers, got {value!r}") from None
    if values.ndim != 1 or not np.isfinite(values).all():
        raise ValueError(f"value of an invariant must be finite, of shape (m,), got {value!r}")
    return values


def _names(names: object) -> list[str]:
    if isinstance(names, str):
        return [names]
    if not isinstance(names, Iterable) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"names of invariants must be str, or a list of str, got {names!r}")
    return list(names)


def to_invariants(invariants: object) -> list[Invariants]:
    """The argument `invariants` as a list: a function, an Invariants, or a list of these."""
    if invariants is None:
        return []
    if isinstance(invariants, Invariants):
        return [invariants]
    if callable(invariants):
        return [Invariants(invariants)]
    if isinstance(invariants, Iterable) and not isinstance(invariants, (str, bytes)):
        return [one for item in invariants for one in to_invariants(item)]
    raise TypeError(f"invariants must be a function g(t, y), an Invariants, or a list of these, got {invariants!r}")


@dataclass(frozen=True)
class BoundInvariants:
    """Invariants together with the values they are held at and the arguments of their functions."""

    specs: list[tuple[Any, Any, int, str]]
    value: Array
    names: list[str]
    args: tuple[Any, ...]
    iterations: int | None

    def __len__(self) -> int:
        return len(self.value)

    def residual(self, t: Array, y: Array) -> Array:
        """g(t, y) - value, of shape (m, n_t), at the points y (n, n_t)."""
        if not self.specs:
            return np.zeros((0, len(t)))
        residual: Array = _core.residual(
            t,
            _as_rows(y),
            complex=np.iscomplexobj(y),
            invariants=self.specs,
            value=self.value,
            args=self.args,
        ).T
        return residual

    def impose(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike) -> ImposeResult:
        """Projects the points y (n, n_t)."""
        smallest, threshold, scale = tolerances(rtol, atol, y[:, 0] if y.shape[1] else np.ones(len(y), y.dtype))
        points, converged, residual, iterations = _core.impose(
            t,
            _as_rows(y),
            complex=np.iscomplexobj(y),
            rtol=smallest,
            threshold=threshold,
            scale=scale,
            invariants=self.specs,
            value=self.value,
            args=self.args,
        )
        return ImposeResult(_as_columns(points, y.dtype), converged.astype(bool), residual.T, iterations)


def _as_rows(y: Array) -> Array:
    """Points y (n, n_t) in the layout of the core: one row of reals per point."""
    rows = np.ascontiguousarray(y.T)
    return rows.view(float) if np.iscomplexobj(rows) else rows


def _as_columns(rows: Array, dtype: np.dtype[Any]) -> Array:
    """The reverse: (n, n_t), complex where the problem is."""
    return (rows.view(dtype) if np.issubdtype(dtype, np.complexfloating) else rows).T


def bind(invariants: list[Invariants], t: float, y: Array, args: tuple[Any, ...]) -> BoundInvariants:
    """Evaluates each invariant once, at (t, y): its size, and the value it is held at if none is demanded."""
    specs, values, names = [], [], []
    for one in invariants:
        name = one.names[0] if one.names and len(one.names) == 1 else call_name(one.fun, "g")
        at_start = _evaluate(one, name, t, y, args)
        m = len(at_start)
        if one.value is not None and len(one.value) not in (1, m):
            raise ValueError(f"value of invariant {name} must have shape ({m},), as the invariant has, got {one.value}")
        if one.names is not None and len(one.names) != m:
            raise ValueError(f"invariant {name} returns {m} values and has {len(one.names)} names: {one.names}")
        specs.append((one.fun, one.jac, m, name))
        values.append(at_start if one.value is None else np.broadcast_to(one.value, (m,)))
        names.extend(one.names or ([name] if m == 1 else [f"{name}[{i}]" for i in range(m)]))
    iterations = [one.iterations for one in invariants if one.iterations is not None]
    value = np.concatenate(values) if values else np.zeros(0)
    return BoundInvariants(specs, value, names, args, max(iterations, default=None))


def _evaluate(one: Invariants, name: str, t: float, y: Array, args: tuple[Any, ...]) -> Array:
    returned = one.fun(t, y.copy(), *args)
    values = np.asarray(returned)
    if values.dtype.kind not in "biufO" or values.ndim > 1 or values.size == 0 or returned is None:
        what = (
            f"shape {values.shape} of type {values.dtype}" if returned is not None else "None (is a `return` missing?)"
        )
        raise ValueError(f"invariant {name} returned {what}, expected a real number or shape (m,)")
    values = np.atleast_1d(values).astype(float)
    if not np.isfinite(values).all():
        raise ValueError(f"invariant {name} is not finite at t = {t}: {returned}")
    return values


@dataclass(frozen=True)
class ImposeResult:
    """Points projected onto the invariants.

    Attributes
    ----------
    y : ndarray, (n,) or (n, n_t)
        The projected points; those that did not converge are as they were given.
    converged : bool or ndarray of bool, (n_t,)
        Where every residual is roundoff: at most 10 ε (|value_i| + Σ_j |J_ij y_j|).
    residual : ndarray, (m,) or (m, n_t)
        g(t, y) - value at the points returned.
    iterations : int or ndarray of int, (n_t,)
        Gauss-Newton iterations spent.
    """

    y: Array
    converged: Any
    residual: Array
    iterations: Any


def impose(
    invariants: Any,
    t: Any,
    y: ArrayLike | None = None,
    *,
    value: ArrayLike | None = None,
    args: tuple[Any, ...] = (),
    rtol: ArrayLike = 1e-3,
    atol: ArrayLike = 1e-6,
) -> ImposeResult:
    """Projects given points onto invariants, about as accurately as double precision allows (paper, section 4).

    Parameters
    ----------
    invariants : callable, Invariants, or list of these
        As for `solve_ivp`.
    t : float or array_like of shape (n_t,), or a result
        Times of the points; or a `Solution` or a result of SciPy's, whose t and y are taken.
    y : array_like, (n,) or (n, n_t)
        One point, or points in columns.
    value : float or array_like of shape (m,), optional
        The values to impose. Default: those of the `Invariants`, else the values of g at the first point.
    args : tuple, optional
        Extra arguments of the functions.
    rtol, atol : float or array_like of shape (n,)
        The weights max(|y|, atol / rtol) in which 'nearest' is meant. Default 1e-3, 1e-6.

    Returns
    -------
    ImposeResult
        With the shapes of the points given.

    Notes
    -----
    Gauss-Newton iterations, each with a fresh Jacobian, until the correction stagnates at roundoff, 50 at the most.
    """
    if y is None:
        if not (hasattr(t, "t") and hasattr(t, "y")):
            raise TypeError(f"impose takes points (t, y) or a result with fields t and y, got t = {t!r} without y")
        t, y = t.t, t.y
    points, times = _points(t, y)
    extra = extra_arguments(args)
    listed = to_invariants(invariants)
    if not listed:
        raise ValueError("impose needs at least one invariant")
    if points.shape[1] == 0:
        empty = np.zeros(0, dtype=int)
        return ImposeResult(points, empty.astype(bool), np.zeros((0, 0)), empty)
    bound = bind(listed, float(times[0]), points[:, 0], extra)
    if value is not None:
        demanded = _values(value)
        if len(demanded) not in (1, len(bound)):
            raise ValueError(f"value must have shape ({len(bound)},), as the invariants have, got {value!r}")
        bound = BoundInvariants(bound.specs, demanded + np.zeros(len(bound)), bound.names, bound.args, None)
    result = bound.impose(times, points, rtol, atol)
    if np.ndim(y) == 2:
        return result
    return ImposeResult(result.y[:, 0], bool(result.converged[0]), result.residual[:, 0], int(result.iterations[0]))


def _points(t: Any, y: ArrayLike) -> tuple[Array, Array]:
    """Points as (n, n_t), times as (n_t,)."""
    y = np.asarray(y)
    if y.ndim not in (1, 2):
        raise ValueError(f"y must have shape (n,) or (n, n_t), got {y.shape}")
    points = numbers("y", y).reshape(len(y), -1)
    try:
        times = np.array(t, dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"t must hold real numbers, got {t!r}") from None
    if times.shape not in ((), (points.shape[1],)):
        raise ValueError(f"t must have one time per point, shape ({points.shape[1]},), got {times.shape}")
    if not all(math.isfinite(one) for one in times.ravel()):
        raise ValueError("t must be finite")
    return points, np.broadcast_to(times, (points.shape[1],)).copy()
