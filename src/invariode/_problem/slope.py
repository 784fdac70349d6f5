"""y' as runs compute it, for all who need f outside of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array, numbers, real_numbers, reals
from .._functions.compiled import CoreFunction, as_python, is_native, native_parameters, to_native
from .._functions.layout import ArgumentLayout
from .._functions.with_arguments import numbers_at
from .delays import Delays
from .inputs import Input, fed


class Slope(NamedTuple):
    """Slope f(t, y) of a problem, with the values of its inputs and its arguments; f may be machine code."""

    given: Any  # as users write it
    inputs: Sequence[Input]
    args: tuple[Any, ...]
    delays: Delays | None = None

    @property
    def fun(self) -> Any:
        """Function f of (t, y, *args), with the values of the inputs filled in; native if f is. With delays f takes z
        after y."""
        return fed(self.given, self.inputs, after=0 if self.delays is None else 1)

    def for_core(self, y0: Array, parameters: ArgumentLayout) -> Any:
        """Return f as the core calls it, with the parameters that native functions of the problem have."""
        if self.delays is not None:
            return self.delays.called_by_core(self.fun, y0, parameters)
        n = reals(y0)
        return to_native("fun", self.fun, n, n, parameters)

    def of_past(self, t: float, y: Array, z: Array) -> Array:
        """Return f (n,) of a problem with delays, of their values z (k, n)."""
        assert self.delays is not None
        return checked_slope(self.delays.value(self.fun, t, y.copy(), z, self.args), y)

    def __call__(self, t: Array, y: Array) -> Array:
        """The values at points y (n, n_t), one for each t. Delayed values are those of the history."""
        rows = np.ascontiguousarray(y.T)
        values, at = np.empty_like(rows), self._at(rows.view(float).shape[1])
        for value, time, state in zip(values, t.tolist(), rows, strict=True):
            value[:] = at(time, state)
        return values.T

    def _at(self, n: int) -> Callable[[float, Array], Array]:
        """Return f as a function of (t, y), with y of n reals."""
        fun, args, delays = self.fun, self.args, self.delays
        if delays is not None:
            return lambda t, y: self.of_past(t, y, delays.past(t, y, args))
        if isinstance(fun, CoreFunction) or not is_native(fun):
            return lambda t, y: checked_slope(fun(t, y.copy(), *args), y)
        p = native_parameters(args, [fun])
        call = as_python(to_native("fun", fun, n, n, p), n)
        return lambda t, y: call(t, y.view(float), numbers_at(t, fun, p.numbers)).view(y.dtype)


def checked_slope(given: Any, y: Array) -> Array:
    """Return the values of f at y (n,) as numbers of that shape, which are real if y is.

    Raises TypeError, ValueError: It is something else.
    """
    values = (numbers if y.dtype.kind == "c" else real_numbers)("what fun(t, y) returns", given)
    if values.shape != y.shape and not values.size == y.size == 1:
        raise ValueError(f"fun(t, y) returned shape {values.shape}, expected shape {y.shape}")
    return values.reshape(y.shape)
