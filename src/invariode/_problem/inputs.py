"""Inputs: functions of t given by a table, and where they jump."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import Array, choice, flag, items, real_numbers, shown
from .._base.suggestions import naming_arguments
from .._base.types import InputKind
from .._functions.compiled import NativeWithInputs, is_native
from .._functions.graph.tables import PolynomialTable
from .._functions.second_order import SecondOrder


@naming_arguments
class Input(PolynomialTable):
    """A function u(t) from a table, as an argument of f: measured forces, schedules, driving currents.

    Parameters
    ----------
    times : array_like of shape (k,)
        The times; increasing.
    values : array_like of shape (k,) or (k, m)
        The values of u then: one number, or m numbers.
    kind : {'previous', 'linear', 'cubic'}
        Between the times: the previous value, where the last one holds for ever; straight lines; or the cubic spline of
        `scipy.interpolate.CubicSpline` (not-a-knot), for k of at least 2.
    breakpoints : bool, default True
        Whether runs start anew at each of the times, where the values, the slopes or (for a spline) third derivatives
        jump. False saves evaluations of f if the table is dense and smooth; the error control then has to notice jumps.

    Notes
    -----
    ``u(t)`` for a number t is a number, or has shape (m,); for an array of t these follow along the first axis. An
    input keeps copies of `times` and `values`, which cannot be changed.

    Examples
    --------
    >>> import invariode as iv
    >>> tap = iv.Input([0, 2, 3], [0.0, 1.0, 0.0])  # open from 2 to 3
    >>> tank = iv.Problem(lambda t, y, inflow: [inflow], (0, 10), [0.0], inputs=tap)
    >>> float(tank.solve("ode23").y[0, -1])
    1.0
    """

    def __init__(
        self, times: ArrayLike, values: ArrayLike, kind: InputKind = "previous", breakpoints: bool = True
    ) -> None:
        self.kind = choice("kind", kind, get_args(InputKind))
        self.times = real_numbers("times", times).copy()
        self.values = real_numbers("values", values).copy()
        least = 1 if kind == "previous" else 2
        if self.times.ndim != 1 or len(self.times) < least or not np.isfinite(self.times).all():
            raise ValueError(f"times of an input must be at least {least} finite numbers, got {shown(times)}")
        if (np.diff(self.times) <= 0).any():
            cure = "" if kind == "previous" else ": for a jump give kind='previous', or two inputs"
            k = int(np.flatnonzero(np.diff(self.times) <= 0)[0])
            raise ValueError(f"times of an input must increase, got {self.times[k]:g}, {self.times[k + 1]:g}{cure}")
        if self.values.ndim not in (1, 2) or len(self.values) != len(self.times) or 0 in self.values.shape:
            raise ValueError(
                f"values of an input must be one row for each of its {len(self.times)} times, got shape "
                f"{self.values.shape}"
            )
        if not np.isfinite(self.values).all():
            raise ValueError("values of an input must be finite")
        self.breakpoints = flag("breakpoints", breakpoints)
        self.times.flags.writeable = self.values.flags.writeable = False
        self._core = _polynomial(self.times, self.pieces()[1])

    def __setattr__(self, name: str, value: Any) -> None:
        if hasattr(self, "_core"):
            raise AttributeError(f"an Input cannot be changed: make another one, with {name}={shown(value)}")
        super().__setattr__(name, value)

    @property
    def size(self) -> int:
        """Number of values of u."""
        return 1 if self.values.ndim == 1 else int(self.values.shape[1])

    def __call__(self, t: ArrayLike) -> Any:
        single = self.values.ndim == 1
        if isinstance(t, float):
            return self._core.at(t) if single else self._core.evaluate(np.array([t]))[0]
        times = real_numbers("t", t)
        u = self._core.evaluate(times.ravel())
        return u.reshape(times.shape if single else (*times.shape, self.size))[()]

    def pieces(self) -> tuple[Array, Array]:
        """The times, and the coefficients in t since the start of each piece, the highest power first: of shape
        (powers, pieces, size)."""
        rows = self.values.reshape(len(self.times), -1)
        if self.kind == "previous":
            return self.times, rows[None]
        if self.kind == "linear":
            return self.times, np.stack([np.diff(rows, axis=0) / np.diff(self.times)[:, None], rows[:-1]])
        from scipy.interpolate import CubicSpline  # takes longer to import than everything else

        return self.times, CubicSpline(self.times, rows).c

    def covers(self, t0: float, tf: float) -> bool:
        """Return whether the table covers t0 to tf."""
        low, high = min(t0, tf), max(t0, tf)
        return bool(self.times[0] <= low and (self.kind == "previous" or high <= self.times[-1]))

    def __repr__(self) -> str:
        return f"Input({len(self.times)} times from {self.times[0]:g} to {self.times[-1]:g}, kind={self.kind!r})"

    def __reduce__(self) -> tuple[type[Input], tuple[Any, ...]]:
        return Input, (self.times, self.values, self.kind, self.breakpoints)


InputsLike: TypeAlias = Input | Sequence[Input]


def _polynomial(times: Array, powers: Array) -> _core.PiecewisePolynomial:
    ordered = np.ascontiguousarray(np.moveaxis(powers, 0, -1), dtype=float)  # (pieces, size, powers)
    return _core.PiecewisePolynomial(times, ordered.ravel(), len(powers) - 1, powers.shape[2])


def to_inputs(inputs: InputsLike | None, t_span: tuple[float, float]) -> list[Input]:
    """The inputs, checked."""
    if inputs is None:
        return []
    listed = [inputs] if isinstance(inputs, Input) else items(inputs)
    if listed is None or not all(isinstance(one, Input) for one in listed):
        raise TypeError(f"inputs must be an invariode.Input or a list of these, got {shown(inputs)}")
    for one in listed:
        if not one.covers(*t_span):
            early = one.times[0] > min(t_span)  # no kind has values before its first time
            cure = "from the start on" if early else "to the end, or kind='previous', whose last value holds for ever"
            raise ValueError(f"t_span = {t_span} leaves the table of {one!r}: give values {cure}")
    return listed


def fed(fun: Any, inputs: Sequence[Input], after: int = 0) -> Any:
    """A function of (t, y, *inputs, *args) as one of (t, y, *args), native if the function is. `after`: arguments
    between y and the inputs."""
    if not inputs or not (callable(fun) or is_native(fun)):
        return fun
    if isinstance(fun, SecondOrder):
        return SecondOrder(fed(fun.fun, inputs))
    if is_native(fun):
        return with_tables(fun, inputs)
    return _Fed(fun, inputs, after)


def with_tables(fun: Any, inputs: Sequence[Input]) -> NativeWithInputs:
    """A function and the tables of its inputs."""
    return NativeWithInputs(fun, [one._core for one in inputs], [one.values.shape[1:] for one in inputs])


class _Fed:
    def __init__(self, fun: Callable[..., Any], inputs: Sequence[Input], after: int) -> None:
        self.fun, self.inputs, self.after = fun, inputs, after

    def __call__(self, t: float, y: Array, *args: Any) -> Any:
        return self.fun(t, y, *args[: self.after], *(u(t) for u in self.inputs), *args[self.after :])
