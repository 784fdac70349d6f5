"""Functions of (t, q) and (t, q, v) with their first and second derivatives, in the forms that the core takes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import _core
from .._base.arguments import Array
from .._functions.compiled import CompiledFunction, is_native, native_parameters, to_native
from .._functions.derivatives import derivative_of
from .._functions.graph.derived import derived, native
from .._functions.increments import sizes, somewhere
from .._functions.layout import ArgumentLayout
from .._functions.with_arguments import Point

#: From this many entries on it is worth knowing which of them are always zero.
_LARGE = 500
#: From this many columns on a derivative along one direction tells whether all entries are known, to this part of the
#: terms of each row: one evaluation in the place of one for each column.
_MANY, _KNOWN = 1000, 1e-9
#: Distance from x at which the pattern is sought, in units of the sizes of the components.
_BESIDE = (0.0, 0.1, -0.07)


class Forms(NamedTuple):
    """A function in the forms the core takes."""

    function: Any
    complex: Any = None  # for complex t and x; None: there is no such form
    quiet: Any = None  # the same, for points outside its domain
    slope: Any = None  # its first derivative along a direction, of (t, (x, dt, dx)); None: it is not known
    curvature: Any = None  # the second one


class Quiet:
    """A function without NumPy's warnings, which are expected when it is evaluated outside its domain."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any) -> Any:
        with np.errstate(all="ignore"):
            return self._function(*args)


class Differentiable:
    """First and second derivatives of ``function(t, q)``, or ``function(t, q, v)``, with respect to t and x = (q, v).

    - `function`: the user's, with extra arguments; Python or native
    - `t`, `parts`, `args`: a point at which the function is defined, q or (q, v), and its extra arguments: what it
      returns there tells m, and whether it takes complex t and x
    - `name`: for messages
    - `m`: number of its values, which a native function does not say

    Attributes:
    - `how`: way in which derivatives are formed
    """

    def __init__(
        self,
        function: Callable[..., Any],
        t: float,
        parts: tuple[Array, ...],
        args: tuple[Any, ...],
        name: str,
        m: int | None = None,
    ) -> None:
        self._args, self._name, self._parts = args, name, tuple(len(part) for part in parts)
        self._parameters = native_parameters(args, [function])
        self.m = _count_values(function, t, parts, args, name, self._parameters) if m is None else m
        x, second = np.concatenate(parts), sum(self._parts[1:])
        form = to_native(name, function, len(x), self.m, self._parameters, second=second)
        self._exact = derived(function, len(x), self.m, self._parameters, second)
        self._core = self._bound(Forms(form))
        if not np.isfinite(here := self._core.value(t, x)).all():
            raise ValueError(f"{name} is not finite at t = {t}: {here}")
        if self._exact is not None:
            n, count = 2 * len(x) + 1, self._parameters.size
            along = (native(one, function, n, self.m, count) for one in (self._exact.slope(), self._exact.curvature()))
            self.forms, self.how = Forms(form, None, None, *along), "traced"
        else:
            at_complex = self._at_complex(function)
            self.how = "differences" if at_complex is None else self._how(form, at_complex, t, x)
            self.forms = Forms(form)
            if self.how == "complex step":
                self.forms = Forms(form, at_complex, at_complex if at_complex is not function else Quiet(at_complex))
        self._core = self._bound(self.forms)

    def _at_complex(self, function: Any) -> Any:
        """Return the function as the core calls it with complex t and x; None: there is no such form."""
        if not isinstance(function, CompiledFunction):
            return None if is_native(function) else function
        try:
            return function.complex_native(sum(self._parts), self.m, self._parameters, sum(self._parts[1:]))
        except TypeError:
            return None

    def _bound(self, forms: Forms) -> _core.Differentiable:
        first, second = (*self._parts, 0)[:2]
        numbers = self._parameters.numbers.tolist()
        return _core.Differentiable(forms, self._name, first, second, self.m, self._args, numbers)

    def value(self, t: float, x: Array) -> Array:
        """The function itself, of shape (m,)."""
        return self._core.value(t, x)

    def slope(self, t: float, x: Array, dt: float, dx: Array) -> Array:
        """d/ds of function(t + s dt, x + s dx) at s = 0."""
        return self._core.slope(t, x, dt, dx)

    def curvature(self, t: float, x: Array, dt: float, dx: Array) -> Array:
        """d²/ds² of function(t + s dt, x + s dx) at s = 0."""
        return self._core.curvature(t, x, dt, dx)

    def jacobian(self, t: float, x: Array) -> Array:
        """∂/∂x, of shape (m, n)."""
        values: Array = self._core.jacobian(t, x, full_pattern(self.m, len(x)))[2]
        return values.reshape(len(x), self.m).T

    def pattern(self, t: float, x: Array) -> tuple[Array, Array, Array]:
        """Return the pattern of the Jacobian, its entries that can be nonzero, in compressed columns.

        They are where NaN for a component spreads to, and where the derivatives at some points are not zero: the first
        sees terms that vanish by chance, the second those that a comparison with NaN leaves out.
        """
        n = len(x)
        if self.m * n < _LARGE:
            return full_pattern(self.m, n)
        if self._exact is not None:
            from scipy.sparse import csc_array  # takes longer to import than everything else

            exact = csc_array(self._exact.pattern.matrix(np.ones(self._exact.entries)))
            exact.sort_indices()
            return exact.indptr.astype(np.int32), exact.indices.astype(np.int32), exact.data
        entries = [np.arange(0)] * n
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            for j in range(n):
                at = x.copy()
                at[j] = np.nan
                try:
                    entries[j] = np.flatnonzero(np.isnan(self.value(t, at)))
                except (ValueError, ArithmeticError):  # it does not take NaN
                    entries[j] = np.arange(self.m)
            for part in _BESIDE:
                at = x + part * somewhere(x)
                try:
                    if n >= _MANY and self._has_all(t, at, _pattern_of(entries)):
                        continue
                    found = self._nonzero(t, at)
                except (ValueError, ArithmeticError):
                    continue  # not defined there
                entries = [np.union1d(known, more) for known, more in zip(entries, found, strict=True)]
        return _pattern_of(entries)

    def _has_all(self, t: float, x: Array, pattern: tuple[Array, Array, Array]) -> bool:
        """Return whether the entries in a pattern reproduce the derivative along a direction in which every component
        changes."""
        direction = somewhere(x)
        starts, rows, values = self._core.jacobian(t, x, pattern)
        terms = values * np.repeat(direction, np.diff(starts))
        expected, size = (np.bincount(rows, one, self.m) for one in (terms, np.abs(terms)))
        return bool((np.abs(self.slope(t, x, 0.0, direction) - expected) <= _KNOWN * size).all())

    def _nonzero(self, t: float, x: Array) -> list[Array]:
        """The rows of each column of the Jacobian that are not zero."""
        found, direction, size = [], np.zeros(len(x)), sizes(x)
        for j in range(len(x)):
            direction[j] = size[j]
            found.append(np.flatnonzero(~(self.slope(t, x, 0.0, direction) == 0)))
            direction[j] = 0.0
        return found

    def _how(self, form: Any, at_complex: Any, t: float, x: Array) -> str:
        """Return the way in which derivatives are formed of a function without a graph."""
        core = self._bound(Forms(form, at_complex, at_complex))

        def values(t: Any, x: Array) -> Array:
            if x.dtype.kind == "c":
                return core.complex_value(np.append(t, x).view(float)).view(complex)
            return core.value(t, x)

        at = Point(t, x)
        return derivative_of(values, (self.m, len(x)), at=at, called=self._name, moves_t=True, traces=False).how


def _count_values(
    function: Any, t: float, parts: tuple[Array, ...], args: tuple[Any, ...], name: str, parameters: ArgumentLayout
) -> int:
    """Return the number of values that the function returns."""
    if isinstance(function, CompiledFunction) and not function.inplace:
        returned = np.asarray(function.at(t, *(part.copy() for part in parts), parameters=parameters))
    elif is_native(function):
        raise ValueError(
            f"{name} is native, so the number of its values is unknown: give it as "
            "Invariants(function, value=0, names=[...]), with one name for each"
        )
    else:
        returned = np.asarray(function(t, *(part.copy() for part in parts), *args))
    if returned.dtype.kind not in "biuf" or returned.ndim > 1 or returned.size == 0:
        raise ValueError(f"{name} must return a real number or shape (m,), got {returned!r} at t = {t}")
    return int(returned.size)


def full_pattern(m: int, n: int) -> tuple[Array, Array, Array]:
    """A matrix of m rows and n columns without zeros, as compressed columns."""
    starts = np.arange(0, m * n + 1, m, dtype=np.int32) if m else np.zeros(n + 1, dtype=np.int32)
    return starts, np.tile(np.arange(m, dtype=np.int32), n), np.ones(m * n)


def _pattern_of(entries: Sequence[Array]) -> tuple[Array, Array, Array]:
    """The rows of each column as compressed columns."""
    starts = np.cumsum([0, *map(len, entries)]).astype(np.int32)
    return starts, np.concatenate(entries).astype(np.int32), np.ones(starts[-1])
