"""Functions that SymPy's `lambdify` has made: columns as vectors, and the formula as the name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .._base.arguments import LAMBDIFIED, call_name


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
