"""Uncertainty of fitted parameters: Fisher information, covariance, and what the data leave undetermined."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..._base.arguments import Array
from ..._base.package import public
from ..._results.records import DataRecord
from .likelihood import FittedModel, ModelValues
from .search import Optimum

#: Singular values of the Jacobian, its columns scaled to length 1, below this part of the largest are zero: derivatives
#: from runs are accurate to their tolerance, and a factor of safety.
_NOISE = 100

#: Parameters with at least this part of the largest entry of a null vector are named.
_INVOLVED = 0.1


class Uncertainty(NamedTuple):
    """Covariance and Fisher information of the free parameters, in their values.

    Attributes
    ----------
    covariance, fisher : ndarray, (k, k)
        NaN rows of the covariance: parameters at a bound; infinite variances: parameters that are not determined.
    at_bound : list of (str, str, float)
        Parameters at their bounds: name, "lower" or "upper", value.
    undetermined : list of list of str
        Names of parameters of which the data leave a combination open, a list for each.
    degrees : float
        Degrees of freedom of the noise level; infinite if it is known.
    """

    covariance: Array
    fisher: Array
    at_bound: list[tuple[str, str, float]]
    undetermined: list[list[str]]
    degrees: float


def unknown_uncertainty(k: int) -> Uncertainty:
    """Return the uncertainty of k parameters of which nothing could be computed: NaN."""
    nothing = np.full((k, k), np.nan)
    return Uncertainty(nothing, nothing.copy(), [], [], math.inf)


def uncertainty(model: FittedModel, found: Optimum) -> Uncertainty:
    """Compute the uncertainty of the best parameters."""
    space, at = model.space, found.at
    at_bound = _at_bounds(model, at)
    inner = _inner(model, at)
    k = len(space.free)
    degrees = degrees_of_freedom(model, at) if _estimates_sigma(model, at) else math.inf
    variance = unit_of_variance(model, at)
    information = _information(model, found, variance)
    covariance = np.full((k, k), np.nan)
    undetermined: list[list[str]] = []
    if inner:
        inverse, groups = _inverse(information[:, inner], max(_NOISE * model.rtol, 1e-10))
        plain = (inverse != 0) & np.isfinite(inverse)  # zeros and infinities stay: the variance can be either
        covariance[np.ix_(inner, inner)] = np.multiply(inverse, variance, where=plain, out=inverse)
        undetermined = [[space.free[inner[i]].name for i in group] for group in groups]
    slope = space.slope(at.free)
    named = [(space.free[i].name, side, float(at.free[i])) for i, side in at_bound]
    with np.errstate(invalid="ignore", divide="ignore"):
        fisher = information.T @ information / variance
        scaled = covariance * np.outer(slope, slope)
    return Uncertainty(scaled, fisher / np.outer(slope, slope), named, undetermined, degrees)


def _information(model: FittedModel, found: Optimum, variance: float) -> Array:
    """Return a matrix A with AᵀA / variance the expected information in coordinates: of the data, of sigma,
    and of the priors, whose standard deviations that variance does not change."""
    at, slope = found.at, model.space.slope(found.at.free)
    rows = [model.information(at) * slope]
    rows[0][: model.size] *= found.weights[:, None]
    priors = model.space.priors(at.free).slopes * slope
    return np.concatenate([*rows, priors * math.sqrt(variance) if math.isfinite(variance) else priors])


def _inner(model: FittedModel, at: ModelValues) -> list[int]:
    """Return parameters that are not at a bound."""
    held = {place for place, _ in _at_bounds(model, at)}
    return [i for i in range(len(model.space.free)) if i not in held]


def _estimates_sigma(model: FittedModel, at: ModelValues) -> bool:
    """Return whether sigma follows from the residuals: it is unknown or relative, or a noise level is fitted."""
    inner = _inner(model, at)
    return model.relative or any(bool(one.slope[inner].any()) for one in at.levels)


def degrees_of_freedom(model: FittedModel, at: ModelValues) -> int:
    """Return how many data the parameters leave to estimate sigma, or 0; noise levels do not count as parameters."""
    return max(model.size - sum(not model.space.free[i].level for i in _inner(model, at)), 0)


def unit_of_variance(model: FittedModel, at: ModelValues) -> float:
    """Return the factor of σ² that the residuals give, infinite if no degrees of freedom are left. Noise levels by
    maximum likelihood are too small by the degrees of freedom that the parameters take."""
    if not _estimates_sigma(model, at):
        return 1.0
    degrees = degrees_of_freedom(model, at)
    if not degrees:
        return math.inf
    return model.variance(at, model.size - degrees) if model.relative else model.size / degrees


def _at_bounds(model: FittedModel, at: ModelValues) -> list[tuple[int, str]]:
    """Return parameters at their bounds, where the search has put them."""
    limits = [one.parameter.limits for one in model.space.free]
    sides = ("lower", "upper")
    return [
        (i, side) for i, ends in enumerate(limits) for side, end in zip(sides, ends, strict=True) if at.free[i] == end
    ]


def _inverse(rows: Array, part: float) -> tuple[Array, list[list[int]]]:
    """Return (AᵀA)⁻¹, and groups of columns of which a combination is not determined; their variances are infinite."""
    lengths = np.linalg.norm(rows, axis=0)
    zero = lengths == 0
    scaled = rows / np.where(zero, 1.0, lengths)
    _, sizes, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"), full_matrices=True)  # of k columns, not N rows
    sizes = np.concatenate([sizes, np.zeros(len(directions) - len(sizes))])
    open_ = sizes <= part * sizes.max(initial=0.0)
    kept = directions[~open_] / sizes[~open_, None]
    covariance = (kept.T @ kept) / np.outer(np.where(zero, 1.0, lengths), np.where(zero, 1.0, lengths))
    groups = []
    for vector in _plain(directions[open_]):
        size = np.abs(vector)
        involved = np.flatnonzero(size >= _INVOLVED * size.max())
        groups.append([int(i) for i in involved])
        covariance[involved, involved] = np.inf
    return covariance, groups


def _plain(vectors: Array) -> Array:
    """Return a basis of the same space with few parameters in each vector, by elimination with the largest pivots."""
    basis = vectors.copy()
    for row in range(len(basis)):
        column = int(np.argmax(np.abs(basis[row])))
        basis[row] /= basis[row, column]
        for other in range(len(basis)):
            if other != row:
                basis[other] -= basis[other, column] * basis[row]
    return basis


@public
@dataclass(frozen=True, eq=False)
class Prediction(DataRecord):
    """Values of a fitted model at given times, with bands.

    Attributes
    ----------
    t : ndarray, (n_t,)
        The times.
    y : ndarray, (m, n_t)
        The observed quantities.
    standard_error : ndarray, (m, n_t)
        Their standard errors, from those of the parameters.
    lower, upper : ndarray, (m, n_t)
        The ends of the band.
    names : list of str
        The quantities.
    """

    t: Array
    y: Array
    standard_error: Array
    lower: Array
    upper: Array
    names: list[str]
