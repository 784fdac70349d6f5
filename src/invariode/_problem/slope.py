"""y' as runs compute it, for all who need f outside of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array, numbers, real_numbers, reals
from .._functions.compiled import CoreFunction, NativeWithInputs, as_python, is_native, native_parameters, to_native
from .._functions.layout import ArgumentLayout
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
        values = np.empty_like(rows)
        fun = self.fun
        if self.delays is not None:
            for value, at, state in zip(values, t.tolist(), rows, strict=True):
                value[:] = self.of_past(at, state, self.delays.past(at, state, self.args))
            return values.T
        if isinstance(fun, CoreFunction) or not is_native(fun):
            for value, at, state in zip(values, t.tolist(), rows, strict=True):
                value[:] = checked_slope(fun(at, state.copy(), *self.args), state)
            return values.T
        n = rows.view(float).shape[1]
        arguments = native_parameters(self.args, [fun])
        call, p = as_python(to_native("fun", fun, n, n, arguments), n), arguments.numbers
        fed_by = fun.inputs if isinstance(fun, NativeWithInputs) else []
        for value, at, state in zip(values, t.tolist(), rows, strict=True):
            now = np.concatenate([*(one.evaluate(np.array([at]))[0] for one in fed_by), p]) if fed_by else p
            value[:] = call(at, state.view(float), now).view(value.dtype)
        return values.T


def checked_slope(given: Any, y: Array) -> Array:
    """Return the values of f at y (n,) as numbers of that shape, which are real if y is.

    Raises TypeError, ValueError: It is something else.
    """
    values = (numbers if y.dtype.kind == "c" else real_numbers)("what fun(t, y) returns", given)
    if values.shape != y.shape and not values.size == y.size == 1:
        raise ValueError(f"fun(t, y) returned shape {values.shape}, expected shape {y.shape}")
    return values.reshape(y.shape)
