"""The likelihood of data with normal or Laplace noise on a linear or logarithmic scale, and its derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .._base.arguments import Array
from .tables import Scale

LN10 = math.log(10.0)


@dataclass(frozen=True)
class Evaluation:
    """A point of an objective.

    Attributes
    ----------
    log_likelihood : float
        -inf where a run fails.
    gradient : ndarray, (k,), or None
        Its derivatives for the estimated parameters, on their scales; NaN where a run fails.
    fisher : ndarray, (k, k), or None
        The expected information about them.
    log_prior : float
        The logarithm of the prior density, 0 without priors; the gradient does not contain it.
    log_prior_gradient : ndarray, (k,), or None
        Its derivatives.
    """

    log_likelihood: float
    gradient: Array | None
    fisher: Array | None
    log_prior: float
    log_prior_gradient: Array | None


class Terms(NamedTuple):
    """The terms of data: log-likelihood, its derivatives for the simulation and for sigma, χ², and the information that
    each datum holds about both."""

    value: Array
    of_simulation: Array
    of_sigma: Array
    chi2: Array
    about_simulation: Array
    about_sigma: Array


def terms(data: Array, simulated: Array, sigma: Array, scale: Scale, laplace: bool) -> Terms:
    """Return the terms of the data of one observable.

    With m̃, h̃ the datum and the simulation on the scale of the noise, and r = (m̃ - h̃) / σ, the density is
    exp(-r²/2) / (√(2π) σ), or exp(-|r|) / (2σ), times dm̃/dm.
    """
    with np.errstate(all="ignore"):
        if scale == "lin":
            m, h, slope, factor = data, simulated, np.ones_like(data), np.zeros_like(data)
        else:
            unit = 1.0 if scale == "log" else LN10
            m, h = np.log(data) / unit, np.log(simulated) / unit
            slope, factor = 1 / (simulated * unit), -np.log(data * unit)
        r = (m - h) / sigma
        if laplace:
            value = -np.log(2 * sigma) - np.abs(r) + factor
            of_h, of_sigma = np.sign(r) / sigma, (np.abs(r) - 1) / sigma
            about_sigma = 1 / sigma**2
        else:
            value = -0.5 * np.log(2 * math.pi * sigma**2) - 0.5 * r**2 + factor
            of_h, of_sigma = r / sigma, (r**2 - 1) / sigma
            about_sigma = 2 / sigma**2
        return Terms(value, of_h * slope, of_sigma, r**2, slope**2 / sigma**2, about_sigma)


def log_density(kind: str, numbers: tuple[float, ...], value: float, scaled: float) -> tuple[float, float, bool]:
    """Return the logarithm of a prior's density, its derivative, and whether that is on the parameter's scale.

    Raises
    ------
    ValueError
        There is no such prior.
    """
    on_scale = kind.startswith("parameterScale")
    plain = kind.removeprefix("parameterScale").lower()
    x = scaled if on_scale else value
    if plain == "uniform":
        low, high = numbers
        return (-math.log(high - low) if low <= x <= high else -math.inf), 0.0, on_scale
    if plain in ("normal", "lognormal"):
        mean, sd = numbers
        z = math.log(x) if plain == "lognormal" else x
        r = (z - mean) / sd
        inner = 1 / x if plain == "lognormal" else 1.0
        found = -0.5 * math.log(2 * math.pi) - math.log(sd) - 0.5 * r * r - (z if plain == "lognormal" else 0.0)
        return found, -r / sd * inner - (inner if plain == "lognormal" else 0.0), on_scale
    if plain in ("laplace", "loglaplace"):
        mean, width = numbers
        z = math.log(x) if plain == "loglaplace" else x
        inner = 1 / x if plain == "loglaplace" else 1.0
        found = -math.log(2 * width) - abs(z - mean) / width - (z if plain == "loglaplace" else 0.0)
        slope = -math.copysign(1.0, z - mean) / width * inner - (inner if plain == "loglaplace" else 0.0)
        return found, slope, on_scale
    raise ValueError(f"there is no prior {kind!r}")
