"""Python functions of other forms as functions of (t, y, \\*args): those that fill an array with their values,
second-order equations, and what SymPy's `lambdify` has made."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import LAMBDIFIED, call_name, shown


class Filling(_core.Filling):
    """A function of (t, y, out, \\*args) that writes its values, as many as y has components, to `out`.

    The core calls the function itself, `__wrapped__`; anybody else calls this, as a function of (t, y, \\*args) that
    returns its values.
    """

    inplace = True

    def __init__(self, fun: Callable[..., Any]) -> None:
        super().__init__(fun)
        self.fun = fun
        self.__name__ = call_name(fun, "f")

    @property
    def __signature__(self) -> inspect.Signature:
        try:
            found = inspect.signature(self.fun)
        except ValueError:  # a builtin
            raise AttributeError("__signature__") from None
        own = [*found.parameters.values()]
        return found.replace(parameters=own[:2] + own[3:])

    def __call__(self, t: Any, y: Any, *args: Any) -> Any:
        numbers = [one for one in args if isinstance(one, (float, complex, np.ndarray, np.generic))]
        out = np.full(len(y), np.nan, dtype=np.result_type(float, t, np.asarray(y), *numbers))
        returned = self.fun(t, y, out, *args)
        if returned is not None and returned is not out:
            raise TypeError(
                f"{self.__name__} returned {shown(returned)}, and with inplace=True its values are those that it "
                "writes to its third argument: assign to out[...] and return nothing"
            )
        return out

    def __reduce__(self) -> tuple[Any, ...]:
        return Filling, (self.fun,)


class FirstOrderForm:
    """(v, f(t, q, \\*args)) of a Python function f."""

    def __init__(self, fun: Callable[..., Any]) -> None:
        self.fun = fun
        self.__name__ = call_name(fun, "f")
        self.__wrapped__ = fun  # whose signature it has

    def __call__(self, t: Any, y: Any, *args: Any) -> Any:
        half = len(y) // 2
        values = self.fun(t, y[:half], *args)
        if isinstance(values, (list, tuple)):  # of symbolic values, too
            return [*y[half:], *values]
        return np.concatenate([y[half:], np.atleast_1d(values)])

    def __reduce__(self) -> tuple[Any, ...]:
        return FirstOrderForm, (self.fun,)


class _Flat:
    """A function of lambdify: a column becomes a vector, a matrix of SymPy an array."""

    def __init__(self, fun: Callable[..., Any]) -> None:
        self.fun = fun
        self.__name__ = call_name(fun, "formula")

    def __call__(self, *arguments: Any) -> Any:
        values = np.asarray(self.fun(*arguments))
        if values.dtype == object:  # numbers of SymPy
            values = values.astype(complex if any(one.is_real is False for one in values.flat) else float)
        return values.ravel() if values.ndim == 2 and 1 in values.shape else values


def unlambdified(fun: Any) -> Any:
    """The function as the solvers take it: unchanged, unless lambdify has made it."""
    return _Flat(fun) if getattr(fun, "__name__", None) == LAMBDIFIED else fun
