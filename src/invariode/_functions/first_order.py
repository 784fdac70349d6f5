"""Second-order equations in Python as first-order ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .._base.arguments import call_name


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
