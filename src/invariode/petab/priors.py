"""Priors of PEtab: densities of parameters, on the linear scale or on that of the parameter."""

from __future__ import annotations

import math
from typing import Any

from .tables import ParameterRow, Scale


def fit_prior(one: ParameterRow) -> Any:
    """Return the prior of a parameter as `invariode.Parameter` takes it; None: uniform within the bounds."""
    if one.prior is None:
        return None
    kind, numbers = one.prior
    plain = kind.removeprefix("parameterScale").lower()
    scale: Scale = one.scale if kind.startswith("parameterScale") else "lin"
    if plain == "uniform":
        return None
    if plain not in ("normal", "lognormal", "laplace", "loglaplace"):
        raise ValueError(f"there is no prior {kind!r}")
    middle, width = numbers
    if plain.startswith("log"):
        return plain, math.exp(middle), width
    if scale == "lin":
        return plain, middle, width
    unit = 1.0 if scale == "log" else math.log(10.0)  # of logarithms on the parameter's scale
    return f"log{plain}", math.exp(middle * unit), width * unit


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
