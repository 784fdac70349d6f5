"""The Jacobian of an invariant in Python, from a trace of the invariant that nobody notices."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._functions.derivatives import Derivative, Point, RowPattern, derivative_of, has_llvm
from .._functions.increments import somewhere

#: From this many components on a trace pays: it takes 10 to 100 ms once, and replaces two to four times as many calls
#: of g in each step (benchmarks/manifolds.py).
FEWEST_COMPONENTS = 16
#: Relative increment for the comparison with a difference, and the relative difference at which the trace is not used:
#: the difference is exact to its square, and to roundoff over it.
_INCREMENT, _TOLERANCE = 1e-5, 1e-4


class TracedJacobian:
    """∂g/∂y as a function of (t, y, \\*args), for any arguments.

    Parameters
    ----------
    fun : callable
        The invariant g(t, y, \\*args).
    n, m : int
        The numbers of components of y and of values.
    rows : RowPattern, optional
        The values are the entries of this pattern, row by row.
    """

    def __init__(self, fun: Callable[..., Any], n: int, m: int, rows: RowPattern | None = None) -> None:
        self._fun, self._n, self._m, self._rows = fun, n, m, rows
        self._last: Derivative | None = None

    def by_rows(self, rows: RowPattern) -> TracedJacobian:
        """Return this Jacobian as a function that returns the entries of a pattern, row by row."""
        return TracedJacobian(self._fun, self._n, self._m, rows)

    def at(self, t: float, y: Array, args: tuple[Any, ...]) -> Derivative:
        """Return the derivative of g for these arguments; (t, y): a point at which g is defined."""
        last = self._last
        if last is None or len(last.args) != len(args) or not all(map(_is_same_number, last.args, args)):
            shape, about = (self._m, self._n), Point(t, y)
            last = self._last = derivative_of(self._fun, shape, at=about, args=args, traces="unnoticed")
        return last

    def __call__(self, t: float, y: Array, *args: Any) -> Array:
        made = self.at(t, y, args)
        return made.jacobian(t, y) if self._rows is None else made.entries(t, y, self._rows)


def _is_same_number(a: Any, b: Any) -> bool:
    return a is b and type(a) in (float, int)


def takes_no_more(fun: Any) -> bool:
    """Return whether a Python function can be called with (t, y) and nothing else."""
    code = getattr(fun, "__code__", None)
    return code is not None and code.co_argcount == 2 and not code.co_flags & inspect.CO_VARARGS


def traced_jacobian(
    fun: Callable[..., Any], m: int, t: float, y: Array, args: tuple[Any, ...]
) -> TracedJacobian | None:
    """The Jacobian of an invariant in Python by a trace; None: it has few components, or cannot be traced without an
    effect that could be noticed, or its trace and a difference disagree at (t, y). The latter takes two evaluations."""
    n = len(y)
    if n < FEWEST_COMPONENTS or y.dtype.kind != "f" or not has_llvm():
        return None
    made = TracedJacobian(fun, n, m)
    step, derivative = _INCREMENT * somewhere(y), made.at(t, y, args)
    if derivative.graph is None:
        return None
    jacobian = derivative.jacobian(t, y)
    expected = derivative.value(t, y + step) - derivative.value(t, y - step)
    scale = np.abs(jacobian) @ np.abs(2 * step)
    return made if (np.abs(jacobian @ (2 * step) - expected) <= _TOLERANCE * scale).all() else None
