"""Priors of the parameters of a fit, as residuals, whose squares are minus twice the log of a density."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

import numpy as np

from ..._base.arguments import choice, items, number, shown
from .observed import OfNumbers

#: Kinds of densities; those of logarithms are about a median.
_KINDS = ("normal", "lognormal", "laplace", "loglaplace")

PriorLike: TypeAlias = (
    tuple[float, float]
    | tuple[Literal["normal", "lognormal", "laplace", "loglaplace"], float, float]
    | Callable[[Any], Any]
    | None
)

#: The residual of Laplace's density, whose derivative is infinite at 0, has that at this part of its width.
_LEAST = 1e-6


class At(NamedTuple):
    """A prior at a value p of its parameter.

    Attributes
    ----------
    residual, slope : float
        r and dr/dp: the density is a factor times exp(−r² / 2).
    log_factor, slope_of_factor : float
        The logarithm of the factor, without that of 1/√(2π), and its derivative; 0 if it is not known.
    """

    residual: float
    slope: float
    log_factor: float = 0.0
    slope_of_factor: float = 0.0


class Prior(Protocol):
    """The density of a parameter."""

    @property
    def size(self) -> float:
        """Size of the parameter's values; 0: it is not known."""

    def at(self, value: float) -> At:
        """Return the prior at a value."""


class Normal(NamedTuple):
    """p is normal."""

    mean: float
    width: float

    @property
    def size(self) -> float:
        return abs(self.mean)

    def at(self, value: float) -> At:
        return At((value - self.mean) / self.width, 1 / self.width, -math.log(self.width))


class LogNormal(NamedTuple):
    """ln p is normal."""

    median: float
    width: float

    @property
    def size(self) -> float:
        return self.median

    def at(self, value: float) -> At:
        if value <= 0:  # where the density is 0
            return At(math.inf, math.nan)
        residual = math.log(value / self.median) / self.width
        return At(residual, 1 / (self.width * value), -math.log(self.width * value), -1 / value)


class Laplace(NamedTuple):
    """p, or ln p, has the density exp(−|z|) / (2 width), z = (p − middle) / width.

    Its residual r has r² / 2 = |z|, so that r dr/dp is the derivative of |z|.
    """

    middle: float
    width: float
    log: bool

    @property
    def size(self) -> float:
        return abs(self.middle)

    def at(self, value: float) -> At:
        if self.log and value <= 0:  # where the density is 0
            return At(math.inf, math.nan)
        z = (math.log(value / self.middle) if self.log else value - self.middle) / self.width
        inner = 1 / (self.width * value) if self.log else 1 / self.width
        residual = math.copysign(math.sqrt(2 * max(abs(z), _LEAST)), z)
        factor = 0.5 * math.log(2 * math.pi) - math.log(2 * self.width)
        if self.log:
            return At(residual, inner / abs(residual), factor - math.log(value), -1 / value)
        return At(residual, inner / abs(residual), factor)


class Residual:
    """r(p) is given, and the density is proportional to exp(−r² / 2)."""

    size = 0.0

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._derivatives = OfNumbers("a prior", function)

    def at(self, value: float) -> At:
        """Return the prior at a value."""
        at = np.array([value])
        return At(self._derivatives.value(at), float(self._derivatives.slopes(at)[0]))


def to_prior(given: Any, log: bool) -> Prior | None:
    """Convert the prior of a parameter; `log`: a pair is about its logarithm."""
    if given is None or isinstance(given, (Normal, LogNormal, Laplace, Residual)):
        return given
    if callable(given):
        return Residual(given)
    entries = items(given)
    if entries is None or isinstance(given, str) or len(entries) not in (2, 3):
        raise TypeError(
            'prior of a Parameter must be (mean, standard deviation), ("lognormal", median, standard deviation of '
            f"ln p), or a function r(p) with density exp(-r**2 / 2), got {shown(given)}"
        )
    kind = ("lognormal" if log else "normal") if len(entries) == 2 else entries[0]
    choice("the kind of a prior", kind, _KINDS)
    mean, width = (number("prior of a Parameter", one) for one in entries[-2:])
    if not (math.isfinite(mean) and 0 < width < math.inf):
        raise ValueError(f"prior of a Parameter needs a positive standard deviation, got {shown(given)}")
    if kind.startswith("log") and mean <= 0:
        raise ValueError(f"a log-normal prior of a Parameter must be about a positive value, got {shown(given)}")
    if kind.endswith("laplace"):
        return Laplace(mean, width, kind == "loglaplace")
    return LogNormal(mean, width) if kind == "lognormal" else Normal(mean, width)
