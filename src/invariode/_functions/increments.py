"""Increments for derivatives: sizes of components, directions, and complex steps, if a function takes them.

f(x + i h d) = f(x) + i h ∂f/∂x d + O(h²) for an analytic f of real values, without cancellation. Whether a function is
analytic, and made for complex numbers, is seen by comparing with a central difference.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.exceptions import ComplexWarning

from .. import _core
from .._base.arguments import EPS, Array
from .compiled import CompiledFunction, NativeWithInputs, complex_form, is_native
from .layout import ArgumentLayout
from .with_arguments import Point, WithArguments

#: Complex increment: its square is negligible against 1, and products of x and it do not vanish.
TINY = 1e-40
#: The size of a component for increments is at least this part of the largest one.
_SMALLEST_PART = 0.1
#: Sizes and tolerances below this give no scale for increments: `smallest_scale` in core/weights.hpp.
SMALLEST_SCALE = 1e-250
#: Relative increment of a central difference, and what counts as agreement with it.
INCREMENT, _SAME = EPS ** (1 / 3), 1e-6
#: How many times the difference of two quotients counts as the error of one.
_NOISE = 3.0
#: What functions raise for complex numbers that they are not made for.
NOT_COMPLEX = (TypeError, ValueError, ArithmeticError)
#: Where complex steps are tried, in parts of the sizes of x: what is not analytic may not show at x itself. Then parts
#: of these sizes, on both sides, for a function that is not defined farther away.
_BESIDE, _NEARER = (0.1, 0.0), (1e-2, 1e-4, 1e-6)
_POINTS = [(part, 1.0) for part in _BESIDE]
_POINTS += [(side * _BESIDE[0] * fraction, fraction) for fraction in _NEARER for side in (1, -1)]
#: Steps that were requested are rejected only if they are wrong beyond doubt: by this many times the expected error.
_TOLERANT = 10
#: Golden ratio minus 1: its multiples modulo 1 are spread evenly and never repeat.
GOLDEN = 0.6180339887498949

_INSTEAD = 'or use jac="differences"'


# ----------------------------------------------------------------------------------------------------------------------
# Sizes and directions


def spread(count: int) -> Array:
    """Numbers in [0, 1), spread evenly over it: the multiples of the golden ratio modulo 1."""
    fractions: Array = np.modf(GOLDEN * np.arange(1, count + 1))[0]
    return fractions


def somewhere(x: Array, size: Array | None = None) -> Array:
    """A direction in which every component moves by about its size."""
    return np.asarray((sizes(x) if size is None else size) * _directions(len(x)))


@lru_cache(maxsize=64)
def _directions(count: int) -> Array:
    """Numbers of about 1, spread evenly, whose signs alternate."""
    found: Array = (0.5 + spread(count)) * np.where(np.arange(count) % 2, -1, 1)
    found.setflags(write=False)
    return found


def sizes(x: Array) -> Array:
    """Return the sizes of the components of x for increments; components that are small take a part of the largest."""
    size: Array = np.abs(x)
    largest = size.max(initial=0.0)
    return np.maximum(size, _SMALLEST_PART * largest) if largest >= SMALLEST_SCALE else np.ones(len(x))


# ----------------------------------------------------------------------------------------------------------------------
# Complex steps


class Comparison(NamedTuple):
    """The derivative of a function along a direction, by a complex step and by a central difference."""

    stepped: Array | Exception  # the values at a complex argument, or why there are none
    by_difference: Array
    size: Array  # of the values
    noise: Callable[[], Array]  # of the difference, as another one shows it

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
        agree = np.asarray(np.abs(by_step - by_difference) <= times * error)
        if agree.all():
            return agree
        return np.asarray(np.abs(by_step - by_difference) <= times * (error + _NOISE * self.noise()))


def compared(
    function: Callable[[Array], Any], x: Array, direction: Array, beside: Array | None = None
) -> Comparison | None:
    """Compare both derivatives along a direction in which every component changes, at the first point at which the
    function is defined; return None if it is defined at none of them.

    The points are near x in the direction `beside` (default: `direction`), x itself, then nearer ones on both sides,
    over the same fractions of the direction.
    """
    beside = direction if beside is None else beside
    for part, length in _POINTS:
        if (found := _compared_at(function, x + part * beside, length * direction)) is not None:
            return found
    return None


def _compared_at(function: Callable[[Array], Any], x: Array, direction: Array) -> Comparison | None:
    stepped: Array | Exception

    def values(z: Array) -> Array:
        return np.asarray(function(z), dtype=z.dtype).ravel()

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", ComplexWarning)  # an imaginary part was dropped
        try:
            up, down = values(x + INCREMENT * direction), values(x - INCREMENT * direction)
        except (TypeError, ValueError, ArithmeticError, Warning):  # as (-1.0) ** 0.5, math.log(-1) and 1 / 0
            return None
        try:
            stepped = values(x + 1j * TINY * direction)
        except Exception as error:  # the function is not made for this
            stepped = error
    if up.shape != down.shape or not (np.isfinite(up) & np.isfinite(down)).all():
        return None
    by_difference = (up - down) / (2 * INCREMENT)

    def noise() -> Array:
        with suppress(TypeError, ValueError, ArithmeticError), warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            wide, beyond = (values(x + 2 * side * INCREMENT * direction) for side in (1, -1))
            found = np.abs((wide - beyond) / (4 * INCREMENT) - by_difference)
            return np.where(np.isfinite(found), found, 0.0)
        return np.zeros(up.shape)  # the function is not defined there

    return Comparison(stepped, by_difference, np.maximum(np.abs(up), np.abs(down)), noise)


def takes_complex(values: Callable[[Array], Any], x: Array, direction: Array, beside: Array | None = None) -> bool:
    """Return whether complex steps agree with finite differences near x, for arguments as in `compared`."""
    found = compared(values, x, direction, beside)
    return found is not None and bool(found.agree().all())


def complex_steps_fit(values: Callable[[Array], Any], y: Array, threshold: float | Array) -> tuple[bool, int]:
    """Return whether complex steps give the derivative of a function of y, and the number of evaluations used.
    `threshold`: the size below which a component gives no scale."""
    if np.iscomplexobj(y):
        return False, 0
    calls = 0

    def counted(z: Array) -> Any:
        nonlocal calls
        calls += 1
        return values(z)

    return takes_complex(counted, y, somewhere(y, _weighted_sizes(y, threshold))), calls


def _weighted_sizes(y: Array, threshold: float | Array) -> Array:
    """The sizes of the components, for increments: `take_sizes` of the core."""
    size: Array = np.abs(y)
    largest = size.max(initial=0)
    if largest < SMALLEST_SCALE:
        largest = 1.0
    size = np.maximum(size, np.minimum(threshold, largest))
    size[size < SMALLEST_SCALE] = largest  # pure relative control at 0
    return size


# ----------------------------------------------------------------------------------------------------------------------
# Functions at complex y, as the core calls them


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


def compiled_at_complex(fun: Any, n: int, parameters: ArgumentLayout) -> _core.Native | None:
    """Machine code of a compiled f for complex y. None: it is not made by `compile`, or not for complex numbers."""
    if isinstance(fun, NativeWithInputs):
        code = compiled_at_complex(fun.fun, n, fun.arguments(parameters))
        return code and _core.Native(address=code.address, event=False, owner=code, inputs=fun.inputs)
    return complex_form(fun.native(n, n, parameters, event=False)) if isinstance(fun, CompiledFunction) else None


def python_at_complex(fun: Callable[..., Any], t: float, y: Array, args: tuple[Any, ...]) -> Callable[..., Any]:
    """A Python f for complex y; NaN where it cannot be evaluated there, so that the core switches to differences.

    Raises TypeError, ValueError: It does not take complex y, or drops the imaginary part.
    """
    if is_native(fun):
        raise TypeError(
            'jac="complex-step" needs a Python function, or one of invariode.compile that numba compiles for complex '
            f"numbers: this fun is machine code for real y. Give its Jacobian, {_INSTEAD}"
        )
    found = compared(lambda z: fun(t, z, *args), y, somewhere(y))
    if found is not None and found.by_difference.shape == y.shape:  # else the core tells what is wrong with f
        _require_complex(found)
    form: Callable[..., Any] = at_complex(fun, len(y))
    return form


def _require_complex(found: Comparison) -> None:
    """Raise a TypeError unless f accepts complex y and complex steps give derivatives of it."""
    stepped = found.stepped
    if isinstance(stepped, ComplexWarning):
        raise TypeError(
            'jac="complex-step": fun makes real numbers of complex ones, which drops the imaginary part: use NumPy\'s '
            f"functions in place of math's, make arrays with dtype=y.dtype, as np.empty_like(y) does, {_INSTEAD}"
        )
    if isinstance(stepped, (TypeError, ValueError)):
        raise TypeError(
            f'jac="complex-step": fun does not take complex y ({type(stepped).__name__}: {stepped}): use NumPy\'s '
            f"functions in place of math's, and make arrays with dtype=y.dtype, {_INSTEAD}"
        ) from stepped
    if isinstance(stepped, Exception):
        raise stepped
    expected = found.by_difference.shape
    if stepped.shape != expected:
        raise ValueError(f'jac="complex-step": fun returns shape {stepped.shape} for complex y, expected {expected}')
    for i in np.flatnonzero(~found.agree(_TOLERANT)):
        raise ValueError(
            f'jac="complex-step": component {i} of fun drops the imaginary part of y: along a direction its derivative '
            f"is {found.by_difference[i]:.6g}, and the complex step gives {found.by_step[i]:.6g}. Without abs, real, "
            "conj, norms and rounding it would not: write them for complex y (np.sqrt(x * x) for np.abs(x)), "
            f"{_INSTEAD}"
        )


#: One-sided differences are repeated with this part of the increment; where a derivative exists, they grow at most by
#: this factor.
_PART, _GROWTH = 1 / 8, 1.01


class Sides:
    """Derivatives from one side, along a direction, by differences of three values: where a function is singular on
    one side, or its formula is."""

    def __init__(self, evaluate: WithArguments, n: int) -> None:
        self._evaluate, self._n = evaluate, n

    def __call__(self, t: float, y: Array, dt: float, dy: Array, dp: Array) -> Array:
        """Return the derivative along a direction, of shape (m,); NaN where neither side has a derivative."""
        p = self._evaluate.p
        x, direction = np.concatenate([[t], y, p]), np.concatenate([[dt], dy, dp])
        size = np.concatenate([[max(abs(t), 1.0)], sizes(y), _sizes_of(p)])
        length = np.max(np.abs(direction) / size)
        if length < np.finfo(float).tiny:
            return np.zeros(self._evaluate.m or 0)
        found, h = np.full(self._evaluate.m or 0, np.nan), INCREMENT / length
        for side in (h, -h):
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                try:
                    wide, narrow = (self._quotient(x, part * side * direction) / (part * side) for part in (1, _PART))
                except (ValueError, ArithmeticError):  # F is not defined on this side
                    continue
                grows = ~(np.abs(narrow) <= _GROWTH * np.abs(wide))  # as it does where it is infinite
                one = np.where(grows, np.nan, narrow)
            found = np.where(np.isfinite(found), found, one)
        return found

    def _quotient(self, x: Array, step: Array) -> Array:
        """The derivative along a step, by the parabola through three values."""
        here, near, far = (self._values(x + part * step) for part in (0, 1, 2))
        return np.asarray((4 * near - far - 3 * here) / 2)

    def _values(self, x: Array) -> Array:
        return self._evaluate(float(x[0]), x[1 : 1 + self._n], x[1 + self._n :]).astype(float)


class ByIncrements:
    """Derivatives by complex steps, if these give what differences give; else by central differences."""

    def __init__(self, evaluate: WithArguments, at: Point, moves_t: bool) -> None:
        self._evaluate, self._n = evaluate, len(at.y)
        p, self._size_of_p = evaluate.p, _sizes_of(evaluate.p)
        direction = np.concatenate(
            [[max(abs(at.t), 1.0) if moves_t else 0.0], somewhere(at.y), somewhere(p, self._size_of_p)]
        )
        beside = np.append(0.0, direction[1:])
        beside[1 + self._n :] = 0
        works = takes_complex(self._values, np.concatenate([[at.t], at.y, p]), direction, beside)
        self.how = "complex step" if works else "differences"

    def of(self, evaluate: WithArguments) -> ByIncrements:
        """Return these steps through F with other arguments."""
        made = copy(self)
        made._evaluate, made._size_of_p = evaluate, _sizes_of(evaluate.p)
        return made

    def _values(self, z: Array) -> Array:
        t, y, p = z[0], z[1 : 1 + self._n], z[1 + self._n :]
        values = self._evaluate(t if np.iscomplexobj(t) and t.imag else float(t.real), y, p)
        if np.iscomplexobj(z):
            return values
        return values.astype(float)

    def __call__(self, t: float, y: Array, dt: float, dy: Array, dp: Array) -> Array:
        """The derivative along a direction."""
        x, direction = np.concatenate([[t], y, self._evaluate.p]), np.concatenate([[dt], dy, dp])
        if not direction.any():
            return np.zeros(self._evaluate.m or 0)
        if self.how == "complex step":
            with np.errstate(all="ignore"):
                try:
                    return np.imag(self._values(x + 1j * TINY * direction)) / TINY
                except NOT_COMPLEX:  # at this point, such as in a branch that compares numbers
                    pass
        size = np.concatenate([[max(abs(t), 1.0)], sizes(y), self._size_of_p])
        h = INCREMENT / np.max(np.abs(direction) / size)
        up, down = (self._values(x + side * h * direction) for side in (1, -1))
        return np.asarray((up - down) / (2 * h))


def _sizes_of(p: Array) -> Array:
    return np.where(p == 0, 1.0, np.abs(p))
