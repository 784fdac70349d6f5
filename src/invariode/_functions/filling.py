"""Python functions that fill an array with their values, as functions that return it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import call_name, shown


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
