"""The Jacobian of an invariant in Python, from a trace of the invariant that nobody notices."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from .._base.arguments import Array, call_name
from .._functions.compiled import as_python
from .._functions.derivatives import somewhere
from .._functions.directional import has_llvm
from .._functions.graph.derived import Derived, native
from .._functions.graph.plain import plain_graph
from .._functions.layout import TRUTHS, ArgumentLayout, layout_of

#: From this many components on a trace pays: it takes 10 to 100 ms once, and replaces two to four times as many calls
#: of g in each step (benchmarks/manifolds.py).
FEWEST_COMPONENTS = 16
#: Relative increment for the comparison with a difference, and the relative difference at which the trace is not used:
#: the difference is exact to its square, and to roundoff over it.
_INCREMENT, _TOLERANCE = 1e-5, 1e-4


#: Where the entries of each row begin, and their columns.
RowPattern: TypeAlias = tuple[Sequence[int], Sequence[int]]


class TracedJacobian:
    """∂g/∂y as a function of (t, y, \\*args): machine code of the derivatives of the traced g.

    Parameters
    ----------
    fun : callable
        The invariant g(t, y, \\*args).
    n, m : int
        The numbers of components of y and of values.
    """

    def __init__(self, fun: Callable[..., Any], n: int, m: int) -> None:
        self._fun, self._n, self._m = fun, n, m
        self._made: dict[ArgumentLayout, Derived] = {}
        self._last: tuple[tuple[Any, ...], Callable[[float, Array], Array]] | None = None
        self._pattern: RowPattern | None = None

    def derived_for(self, args: tuple[Any, ...]) -> Derived | None:
        """The derivatives of g, for all arguments of these kinds; None: it is not traced."""
        given = layout_of(args).fixed(TRUTHS)
        if given not in self._made:
            graph = plain_graph(self._fun, self._n, given, size=self._m)
            if graph is None:
                return None
            self._made[given] = Derived(call_name(self._fun, "g"), graph.outputs, self._n, "own")
        return self._made[given]

    def by_rows(self, pattern: RowPattern) -> TracedJacobian:
        """Return this Jacobian as a function that returns the entries of a pattern, row by row."""
        made = TracedJacobian(self._fun, self._n, self._m)
        made._made, made._pattern = self._made, pattern
        return made

    def __call__(self, t: float, y: Array, *args: Any) -> Array:
        last = self._last
        if last is not None and len(last[0]) == len(args) and all(map(_is_same_number, last[0], args)):
            return last[1](t, y)
        code = self._code(args)
        self._last = (args, code)
        return code(t, y)

    def _code(self, args: tuple[Any, ...]) -> Callable[[float, Array], Array]:
        found, p = self.derived_for(args), layout_of(args).numbers
        if found is None or (self._pattern is not None and found.row_pattern != self._pattern):
            return lambda t, y: self._by_differences(t, y, args)  # arguments of other kinds than those at the start
        made, shape = found.dense(), [self._m, self._n]
        if self._pattern is not None:
            made, shape = found.by_rows(), [found.entries]
        size = math.prod(shape)
        code = as_python(native(made, None, self._n, size, len(p)), size)
        return lambda t, y: code(t, y, p).reshape(shape)

    def _by_differences(self, t: float, y: Array, args: tuple[Any, ...]) -> Array:
        steps = np.diag(np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(y), 1.0))
        each = [self.along(t, y, step, args) / (2 * step.max()) for step in steps]
        whole = np.column_stack(each)
        if self._pattern is None:
            return whole
        starts, columns = self._pattern
        return whole[np.repeat(np.arange(self._m), np.diff(starts)), columns]

    def along(self, t: float, y: Array, step: Array, args: tuple[Any, ...]) -> Array:
        """g(t, y + step) - g(t, y - step), of shape (m,)."""
        after, before = (np.ravel(self._fun(t, y + part * step, *args)) for part in (1, -1))
        return np.asarray(after - before, dtype=float)


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
    if made.derived_for(args) is None:
        return None
    step = _INCREMENT * somewhere(y)
    jacobian = made(t, y, *args)
    found, expected = jacobian @ (2 * step), made.along(t, y, step, args)
    scale = np.abs(jacobian) @ np.abs(2 * step)
    return made if (np.abs(found - expected) <= _TOLERANCE * scale).all() else None
