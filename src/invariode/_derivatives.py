"""Derivatives of a function of t and x without symbols: by complex steps where it takes them, else by differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from ._arguments import EPS, Array

__all__ = ["Derivatives", "reach", "sizes"]

#: Complex increment: its square is nothing beside 1, and products of x and it do not vanish.
_TINY = 1e-40
#: Relative increments of differences of order 4, where their error h^4 meets roundoff ε / h, for the second derivative
#: ε / h^2.
_FIRST = EPS ** (1 / 5)
_SECOND = EPS ** (1 / 6)
#: Components below this part of the largest have no scale of their own, and increments not smaller than of this size.
_SMALLEST_PART = 0.1
#: The rotated complex step begins with this part of the size of x ...
_ROTATED = 0.1
#: ... and is halved until it agrees with its half to this part of its terms: what is left after extrapolation is the
#: square of that, times 1e-3 from the factorials of the Taylor series.
_AGREEMENT = 1e-6
_HALVINGS = 30
#: What counts as agreement of a complex step with a difference of order 4.
_SAME = 1e-6
_GOLDEN = 0.6180339887498949


class Derivatives:
    """First and second derivatives of ``function(t, x) -> (m,)``, where x has shape (n,).

    Parameters
    ----------
    function : callable
        ``function(t, x, *args)``.
    t, x, args
        A point at which the function is defined, and its extra arguments: what it returns there tells m, and whether
        it takes complex t and x.
    name : str
        For messages.

    Attributes
    ----------
    kind : {'complex step', 'differences'}
        Where derivatives come from.
    """

    def __init__(self, function: Callable[..., Any], t: float, x: Array, args: tuple[Any, ...], name: str) -> None:
        self._function, self._name = function, name
        returned = np.asarray(function(t, x.copy(), *args))
        if returned.dtype.kind not in "biufO" or returned.ndim > 1 or returned.size == 0 or returned.dtype == object:
            raise ValueError(f"{name} must return a real number or shape (m,), got {returned!r} at t = {t}")
        if not np.isfinite(returned.astype(float)).all():
            raise ValueError(f"{name} is not finite at t = {t}: {returned}")
        self.m = returned.size
        self.kind: Literal["complex step", "differences"] = "differences"
        if self._takes_complex(t, x, args):
            self.kind = "complex step"

    def value(self, t: Any, x: Array, args: tuple[Any, ...]) -> Array:
        """The function itself, of shape (m,)."""
        returned = np.atleast_1d(np.asarray(self._function(t, x, *args)))
        if returned.shape != (self.m,):
            raise ValueError(f"{self._name} returned shape {returned.shape} at t = {t}, and ({self.m},) at the start")
        return returned if returned.dtype.kind in "fc" else returned.astype(float)

    def jacobian(self, t: float, x: Array, args: tuple[Any, ...]) -> Array:
        """∂/∂x, of shape (m, n)."""
        columns = np.empty((self.m, len(x)))
        direction = np.zeros(len(x))
        for j, size in enumerate(sizes(x)):
            direction[j] = size
            columns[:, j] = self.slope(t, x, 0.0, direction, args) / size
            direction[j] = 0.0
        return columns

    def slope(self, t: float, x: Array, dt: float, dx: Array, args: tuple[Any, ...]) -> Array:
        """d/ds of function(t + s dt, x + s dx) at s = 0."""
        if self.kind == "complex step":
            h = _TINY
            z: Array = self.value(t + 1j * h * dt if dt else t, x + 1j * h * dx, args)
            return z.imag / h
        h = _FIRST * reach(t, x, dt, dx)
        near, far = self._odd(t, x, h * dt, h * dx, args), self._odd(t, x, 2 * h * dt, 2 * h * dx, args)
        slope: Array = (8 * near - far) / (12 * h)
        return slope

    def curvature(self, t: float, x: Array, dt: float, dx: Array, args: tuple[Any, ...]) -> Array:
        """d²/ds² of function(t + s dt, x + s dx) at s = 0.

        With s complex of argument π/4, φ(s) + φ(-s) = 2φ + s²φ″ + O(s⁴): as s² is imaginary and s⁴ real, the imaginary
        part is |s|²φ″ up to O(|s|⁶), and φ itself does not cancel. One extrapolation from |s| and |s|/2 removes that.
        """
        if not dt and not dx.any():
            return np.zeros(self.m)
        if self.kind == "differences":
            return self._second_difference(t, x, dt, dx, args)
        h = _ROTATED * reach(t, x, dt, dx)
        coarse, terms = self._rotated(t, x, dt, dx, h, args)
        for _ in range(_HALVINGS):
            h /= 2
            fine, terms = self._rotated(t, x, dt, dx, h, args)
            if (np.abs(fine - coarse) <= _AGREEMENT * terms).all():
                return (16 * fine - coarse) / 15
            coarse = fine
        return coarse

    def _rotated(
        self, t: float, x: Array, dt: float, dx: Array, h: float, args: tuple[Any, ...]
    ) -> tuple[Array, Array]:
        """The second derivative with |s| = h, and the size of the terms that it is the sum of."""
        s = h * (1 + 1j) / np.sqrt(2)
        with np.errstate(all="ignore"):  # too large an s may lead out of the domain, and is halved
            up = self.value(t + s * dt, x + s * dx, args).imag
            down = self.value(t - s * dt, x - s * dx, args).imag
        return (up + down) / h**2, (np.abs(up) + np.abs(down)) / h**2

    def _odd(self, t: float, x: Array, dt: float, dx: Array, args: tuple[Any, ...]) -> Array:
        difference: Array = self.value(t + dt, x + dx, args) - self.value(t - dt, x - dx, args)
        return difference

    def _second_difference(self, t: float, x: Array, dt: float, dx: Array, args: tuple[Any, ...]) -> Array:
        h = _SECOND * reach(t, x, dt, dx)
        here = self.value(t, x, args)

        def even(k: int) -> Array:
            up, down = (
                self.value(t + k * h * dt, x + k * h * dx, args),
                self.value(t - k * h * dt, x - k * h * dx, args),
            )
            bend: Array = (up - here) - (here - down)
            return bend

        curvature: Array = (16 * even(1) - even(2)) / (12 * h**2)
        return curvature

    def _takes_complex(self, t: float, x: Array, args: tuple[Any, ...]) -> bool:
        """Whether complex steps give what differences give, along a direction in which everything moves, at a point
        beside x: what is not analytic may not show at x itself."""
        size = sizes(x)
        direction = (
            size * (0.5 + np.modf(_GOLDEN * np.arange(1, len(x) + 1))[0]) * np.where(np.arange(len(x)) % 2, -1, 1)
        )
        dt = max(abs(t), 1.0)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("error")  # a warning tells that the imaginary part was thrown away
            for beside in (0.1, 0.0):
                at = x + beside * direction
                try:
                    by_differences = self.slope(t, at, dt, direction, args)
                    size_of_terms = np.abs(self.value(t, at, args)) + np.abs(by_differences)
                except (ValueError, ArithmeticError, Warning):
                    continue  # not defined there
                if not np.isfinite(by_differences).all():
                    continue
                try:
                    z = np.asarray(self.value(t + 1j * _TINY * dt, at + 1j * _TINY * direction, args), dtype=complex)
                except Exception:  # the function is not made for this: no reason to tell the user
                    return False
                by_step = z.imag / _TINY
                return bool((np.abs(by_step - by_differences) <= _SAME * size_of_terms).all())
        return False


def sizes(x: Array) -> Array:
    """Of the components, for increments: those that are small tell no scale of their own."""
    size: Array = np.abs(x)
    largest = size.max(initial=0.0)
    return np.maximum(size, _SMALLEST_PART * largest) if largest > 0 else np.ones(len(x))


def reach(t: float, x: Array, dt: float, dx: Array) -> float:
    """The s with which x + s dx, or where x rests t + s dt, changes by the size of x or of t."""
    moving = dx != 0
    if moving.any():
        return float((sizes(x)[moving] / np.abs(dx[moving])).min())
    return max(abs(t), 1.0) / abs(dt)
