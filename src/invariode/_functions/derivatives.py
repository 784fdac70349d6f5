"""Derivatives of functions of t, q and v without symbols: complex steps if they take them, else differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.exceptions import ComplexWarning

from .. import _core
from .._base.arguments import EPS, Array, number
from .compiled import CompiledFunction, complex_form, is_native, native_parameters, to_native
from .graph.derived import derived, native
from .layout import ArgumentLayout

#: Complex increment: its square is negligible against 1, and products of x and it do not vanish.
TINY = 1e-40
#: Components below this part of the largest have no scale of their own, and increments not smaller than of this size.
_SMALLEST_PART = 0.1
#: Sizes and tolerances below this give no scale for increments: `smallest_scale` in core/weights.hpp.
SMALLEST_SCALE = 1e-250
#: Relative increment of a central difference, and what counts as agreement with it.
INCREMENT, _SAME = EPS ** (1 / 3), 1e-6

#: Fractions of these sizes at which a function is tried if it is not defined farther away.
_NEARER = (1e-2, 1e-4, 1e-6)
#: What functions raise for complex numbers that they are not made for.
NOT_COMPLEX = (TypeError, ValueError, ArithmeticError)
#: Where complex steps are tried, in parts of the sizes of x: what is not analytic may not show at x itself.
_BESIDE_START = (0.1, 0.0)
#: From this many entries on it is worth knowing which of them are always zero.
_LARGE = 500
#: From this many columns on a derivative along one direction tells whether all entries are known, to this part of the
#: terms of each row: one evaluation in the place of one for each column.
_MANY, _KNOWN = 1000, 1e-9
#: Distance from x at which the pattern is sought, in units of the sizes of the components.
_BESIDE = (0.0, 0.1, -0.07)
#: Its multiples modulo 1 are spread evenly and never repeat.
GOLDEN = 0.6180339887498949


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


class Derivatives:
    """First and second derivatives of ``function(t, q)``, or ``function(t, q, v)``, with respect to t and x = (q, v).

    Parameters
    ----------
    function : callable
        The user's, with extra arguments; Python or native.
    t, parts, args
        A point at which the function is defined, q or (q, v), and its extra arguments: what it returns there tells m,
        and whether it takes complex t and x.
    name : str
        For messages.
    m : int, optional
        Number of its values, which a native function does not say.

    Attributes
    ----------
    kind : {'traced', 'complex step', 'differences'}
        Way in which derivatives are formed.
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
        self.kind: Literal["traced", "complex step", "differences"] = "differences"
        x = np.concatenate(parts)
        form = self._of_numbers(function, is_complex=False)
        self._exact = derived(function, len(x), self.m, self._parameters, sum(self._parts[1:]))
        self.forms = Forms(form)
        self._core = self._bound(self.forms)
        if not np.isfinite(here := self._core.value(t, x)).all():
            raise ValueError(f"{name} is not finite at t = {t}: {here}")
        if self._exact is not None:
            self.kind = "traced"
            n, count = 2 * len(x) + 1, self._parameters.size
            along = (native(one, function, n, self.m, count) for one in (self._exact.slope(), self._exact.curvature()))
            self.forms = Forms(form, None, None, *along)
            self._core = self._bound(self.forms)
            return
        candidate = self._of_numbers(function, is_complex=True)
        if candidate is not None and self._takes_complex(t, x, self._bound(Forms(form, candidate, candidate))):
            self.kind = "complex step"
            self.forms = Forms(form, candidate, candidate if candidate is not function else Quiet(candidate))
            self._core = self._bound(self.forms)

    def _of_numbers(self, function: Any, is_complex: bool) -> Any:
        """Return the function as the core calls it; None if it has no complex form."""
        n, second, count = sum(self._parts), sum(self._parts[1:]), self._parameters
        if not is_complex:
            return to_native(self._name, function, n, self.m, self._parameters, second=second)
        if not is_native(function):
            return function
        if not isinstance(function, CompiledFunction):
            return None
        try:
            return function.complex_native(n, self.m, count, second)
        except TypeError:
            return None

    def _bound(self, forms: Forms) -> _core.Differentiable:
        first, second = (*self._parts, 0)[:2]
        return _core.Differentiable(
            forms, self._name, first, second, self.m, self._args, self._parameters.numbers.tolist()
        )

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

    def _takes_complex(self, t: float, x: Array, form: _core.Differentiable) -> bool:
        """Return whether complex steps agree with finite differences at (t, x)."""

        def values(z: Array) -> Array:
            if z.dtype.kind == "c":
                return form.complex_value(z.view(float)).view(complex)
            return self.value(z[0], z[1:])

        direction = np.append(max(abs(t), 1.0), somewhere(x))
        return takes_complex(values, np.append(t, x), direction, np.append(0.0, direction[1:]))


def takes_complex(
    values: Callable[[Array], Any], x: Array, direction: Array, beside: Array, nearer: Sequence[float] = ()
) -> bool:
    """Return whether complex steps agree with finite differences along a direction in which every component changes.

    They are compared at the first point at which the function is defined: at x or `beside` it, which is given as a
    direction; then on both sides of x at these fractions of `beside`, over the same fractions of the direction.
    """
    points = [(part, 1.0) for part in _BESIDE_START]
    points += [(side * _BESIDE_START[0] * fraction, fraction) for fraction in nearer for side in (1, -1)]
    for part, length in points:
        if (found := compared(values, x + part * beside, length * direction)) is not None:
            return bool(found.agree().all())
    return False


def complex_steps_fit(values: Callable[[Array], Any], y: Array, threshold: float | Array) -> tuple[bool, int]:
    """Return whether complex steps give the derivative of a function of y that may be defined near y only, and the
    number of evaluations used. `threshold`: the size below which a component gives no scale."""
    if np.iscomplexobj(y):
        return False, 0
    calls = 0

    def counted(z: Array) -> Any:
        nonlocal calls
        calls += 1
        return values(z)

    direction = somewhere(y, _weighted_sizes(y, threshold))
    return takes_complex(counted, y, direction, direction, _NEARER), calls


def _weighted_sizes(y: Array, threshold: float | Array) -> Array:
    """The sizes of the components, for increments: `take_sizes` of the core."""
    size: Array = np.abs(y)
    largest = size.max(initial=0)
    if largest < SMALLEST_SCALE:
        largest = 1.0
    size = np.maximum(size, np.minimum(threshold, largest))
    size[size < SMALLEST_SCALE] = largest  # pure relative control at 0
    return size


class Comparison(NamedTuple):
    """The derivative of a function along a direction, by a complex step and by a central difference."""

    stepped: Array | Exception  # the values at a complex argument, or why there are none
    by_difference: Array
    size: Array  # of the values

    @property
    def by_step(self) -> Array:
        return np.imag(np.asarray(self.stepped)) / TINY

    def agree(self, times: float = 1.0) -> Array:
        """Return a boolean array: the components that agree within `times` the expected errors."""
        if isinstance(self.stepped, Exception) or self.stepped.shape != self.by_difference.shape:
            return np.zeros(1, dtype=bool)
        by_step, by_difference = self.by_step, self.by_difference
        noise = 10 * EPS / INCREMENT * self.size + np.finfo(float).tiny
        error = _SAME * np.maximum(np.abs(by_step), np.abs(by_difference)) + noise
        return np.asarray(np.abs(by_step - by_difference) <= times * error)


def compared(function: Callable[[Array], Any], x: Array, direction: Array) -> Comparison | None:
    """Compare both derivatives at x, by complex steps and by finite differences; return None if the function is not
    defined around x."""
    stepped: Array | Exception

    def values(z: Array) -> Array:
        return np.ravel(np.asarray(function(z), dtype=z.dtype))

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", ComplexWarning)  # an imaginary part was dropped
        try:
            up, down = (values(x + side * INCREMENT * direction) for side in (1, -1))
        except (ValueError, ArithmeticError, Warning):  # as from math.log(-1) and 1 / 0
            return None
        try:
            stepped = values(x + 1j * TINY * direction)
        except Exception as error:  # the function is not made for this
            stepped = error
    if up.shape != down.shape or not (np.isfinite(up) & np.isfinite(down)).all():
        return None
    return Comparison(stepped, (up - down) / (2 * INCREMENT), np.maximum(np.abs(up), np.abs(down)))


class OfNumbers:
    """The derivatives of a real function of numbers, by complex steps, which are compared with differences at first.

    Parameters
    ----------
    called : str
        Name of the function in messages.
    function : callable
        The user's, of one or more numbers.
    """

    how = "complex step"
    #: By how much complex steps and differences may disagree, in units of the error of the differences.
    _TOLERANT = 10

    def __init__(self, called: str, function: Callable[..., Any]) -> None:
        self._called, self._function, self._checked = called, function, False

    def value(self, at: Array) -> float:
        """The function itself."""
        return number(f"the value of {self._called}", self._function(*at))

    def slopes(self, at: Array) -> Array:
        """The derivative with respect to each number.

        Raises
        ------
        ValueError
            Complex steps do not give the derivatives.
        """
        if not self._checked:
            self._check(at)
            self._checked = True
        steps = np.eye(len(at)) * TINY * 1j
        return np.array([complex(self._function(*(at + step))).imag / TINY for step in steps])

    def _check(self, at: Array) -> None:
        found = compared(lambda z: np.array([self._function(*z)]), at, np.where(at == 0, 1.0, np.abs(at)))
        if found is None:
            return  # not defined around this point
        if isinstance(found.stepped, Exception) or not found.agree(self._TOLERANT).all():
            raise ValueError(
                f"{self._called} must take complex numbers, for its derivatives: use NumPy's functions in place of "
                "math's, and no abs"
            )


def at_complex(fun: Any, m: int) -> Any:
    """A function (t, y, *args) with m values for complex y; NaN where it cannot be evaluated there, so that the core
    switches to differences."""
    if isinstance(fun, _core.Native):
        return complex_form(fun)

    def evaluate(t: float, y: Array, *args: Any) -> Any:
        try:
            return fun(t, y, *args)
        except NOT_COMPLEX:
            return [np.nan] * m

    return evaluate


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


def compressed(entries: Array) -> tuple[Array, Array, Array]:
    """A dense matrix as compressed columns, without its zeros."""
    starts = np.concatenate([[0], np.cumsum((entries != 0).sum(axis=0))]).astype(np.int32)
    columns, rows = np.nonzero(entries.T)
    return starts, rows.astype(np.int32), entries[rows, columns].astype(float)


def spread(count: int) -> Array:
    """Numbers in [0, 1), spread evenly over it: the multiples of the golden ratio modulo 1."""
    fractions: Array = np.modf(GOLDEN * np.arange(1, count + 1))[0]
    return fractions


def somewhere(x: Array, size: Array | None = None) -> Array:
    """A direction in which every component moves by about its size."""
    size = sizes(x) if size is None else size
    direction: Array = size * (0.5 + spread(len(x))) * np.where(np.arange(len(x)) % 2, -1, 1)
    return direction


def sizes(x: Array) -> Array:
    """Return the sizes of the components of x for increments; components that are small take a part of the largest."""
    size: Array = np.abs(x)
    largest = size.max(initial=0.0)
    return np.maximum(size, _SMALLEST_PART * largest) if largest >= SMALLEST_SCALE else np.ones(len(x))
