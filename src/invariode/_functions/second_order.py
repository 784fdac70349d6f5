"""Second-order equations y'' = f(t, y), as first-order ones of y = (q, v)."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import Array, call_name, shown, warn_of_order
from .compiled import CompiledFunction, CoreFunction, as_python, is_native, native_parameters, to_native
from .forms import FirstOrderForm
from .layout import ArgumentLayout


class SecondOrder(CoreFunction):
    """Second-order equations q'' = f(t, q): the `fun` of a problem with y = (q, v), positions before velocities.

    The methods rkn64, rkn86 and rkn1210 are for such problems alone, and evaluate f about half as often as others of
    their order at the same error. Every other method integrates them as (q, v)' = (v, f(t, q)).

    Parameters
    ----------
    fun : callable
        ``f(t, q, *args)``, the accelerations, which cannot depend on the velocities. If y0 has n components, q has the
        shape (n/2,), and so has what it returns. Native functions have the signature of any f, with n/2 values.

    Notes
    -----
    A first-order function that returns ``(v, f(t, q))`` is as good with ``second_order=True``, which tests that f does
    not depend on v: at the start, and in the middle and at the end of a run. Invariants, events and outputs take the
    whole y. `invariode.compile` takes a SecondOrder, and SecondOrder what it returns.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def attraction(t, q):
    ...     return -q / np.linalg.norm(q) ** 3
    >>> orbit = iv.SecondOrder(attraction)
    >>> sol = iv.solve_ivp(orbit, (0, 2 * np.pi), [1.0, 0, 0, 1], "rkn1210", rtol=1e-12, atol=1e-14)
    >>> bool(abs(sol.y[:, -1] - sol.y[:, 0]).max() < 1e-11)
    True
    """

    def __init__(self, fun: Callable[..., Any]) -> None:
        self.fun: Any = fun.fun if isinstance(fun, SecondOrder) else fun
        if not callable(self.fun) and not is_native(self.fun):
            raise TypeError(f"SecondOrder takes a function f(t, q), got {shown(fun)}")
        if type(self.fun) is FunctionType:
            warn_of_order("fun", self.fun, "f(t, q)")
        self.__name__ = call_name(self.fun, "f")
        self.functions = [self.fun]
        if not is_native(self.fun) or isinstance(self.fun, CompiledFunction):
            self.__wrapped__ = self.first_order  # whose signature it has

    def __repr__(self) -> str:
        return f"SecondOrder({self.__name__})"

    def __reduce__(self) -> tuple[Any, ...]:
        return SecondOrder, (self.fun,)

    @property
    def native(self) -> bool:  # type: ignore[override]  # a constant for others
        return is_native(self.fun)

    def __call__(self, t: float, y: Array, *args: Any) -> Array:
        if not is_native(self.fun) or isinstance(self.fun, CompiledFunction):
            return np.asarray(FirstOrderForm(self.fun)(t, y, *args))
        half = len(y) // 2
        p = native_parameters(args, [self.fun])
        call = as_python(to_native("fun", self.fun, half, half, p), half)
        return np.concatenate([y[half:], call(t, np.ascontiguousarray(y[:half], dtype=float), p.numbers)])

    @property
    def first_order(self) -> FirstOrderForm:
        """Python function of (t, y) in first-order form, for tracing."""
        return FirstOrderForm(self.fun.fun if isinstance(self.fun, CompiledFunction) else self.fun)

    def for_core(self, n: int, size: int, parameters: ArgumentLayout) -> Any:
        return _core.SecondOrder(to_native("fun", self.fun, n // 2, size // 2, parameters))


def states_second_order(fun: Any) -> bool:
    """Return whether f is known not to depend on velocities."""
    return isinstance(fun, SecondOrder) or (isinstance(fun, CompiledFunction) and isinstance(fun.fun, FirstOrderForm))
