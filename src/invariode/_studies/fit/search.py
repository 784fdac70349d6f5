"""The search for the best parameters, from one start or many: losses, noise levels, bounds, and starts that sample."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import EPS, Array
from .likelihood import FittedModel, ModelValues
from .parameter_space import Priors
from .trust_region import QuadraticModel, minimise

#: A noise level below this part of the data is that of a model that fits without errors.
_NO_NOISE = 1e4 * EPS


def _soft_l1(z: Array) -> list[Array]:
    return [2 * (np.sqrt(1 + z) - 1), (1 + z) ** -0.5, -0.5 * (1 + z) ** -1.5]


def _huber(z: Array) -> list[Array]:
    far = np.maximum(z, 1.0)
    inside = z <= 1
    return [np.where(inside, z, 2 * np.sqrt(far) - 1), far**-0.5, np.where(inside, 0.0, -0.5 * far**-1.5)]


def _cauchy(z: Array) -> list[Array]:
    return [np.log1p(z), 1 / (1 + z), -1 / (1 + z) ** 2]


def _arctan(z: Array) -> list[Array]:
    return [np.arctan(z), 1 / (1 + z**2), -2 * z / (1 + z**2) ** 2]


#: Losses of squares of residuals with their first and second derivatives, by the names of SciPy.
LOSSES: dict[str, Callable[[Array], list[Array]] | None] = {
    "linear": None,
    "soft_l1": _soft_l1,
    "huber": _huber,
    "cauchy": _cauchy,
    "arctan": _arctan,
}


class Weighted(NamedTuple):
    """The loss of residuals r, ½ Σ ρ(r²), and its derivatives."""

    cost: float  # the loss
    first: Array  # (N,): ρ′: the gradient of the loss is Jᵀ (ρ′ r)
    #: (N,): √(ρ′ + 2 ρ″ r²): factors of the rows of J for which JᵀJ is the second derivative of the loss. Residuals for
    #: which it is negative count as almost nothing, as in `scipy.optimize.least_squares`.
    second: Array


def weighted(loss: str, residuals: Array) -> Weighted:
    """Return the loss of the residuals of data."""
    rho, z = LOSSES[loss], residuals**2
    if rho is None:
        ones = np.ones_like(z)
        return Weighted(0.5 * float(z.sum()), ones, ones)
    value, first, second = rho(z)
    return Weighted(0.5 * float(value.sum()), first, np.sqrt(np.maximum(first + 2 * second * z, EPS)))


class Optimum(NamedTuple):
    """End of a search."""

    at: ModelValues  # the model there
    cost: float  # half the sum of squares, or of their losses, with those of the priors; with noise levels −log L
    #: success, message: whether it arrived, and how it ended
    success: bool
    message: str
    #: (N,): factors of the rows of the Jacobian for which JᵀJ is the second derivative of the loss; 1 without a loss
    weights: Array


class NoStartError(Exception):
    """The model cannot be evaluated at a start."""


def search(model: FittedModel, start: Array, loss: str = "linear", held: Sequence[int] = ()) -> Optimum:
    """Return the best parameters near a start; those `held` stay there.

    Raises NoStartError: The runs fail at the start.
    """
    _require(model, start)
    levels = [i for i, one in enumerate(model.space.free) if one.level and i not in held]
    if levels:  # the model first, then the noise of its residuals with it
        found = _searched(model, start, loss, [*held, *levels])
        start = _with_levels(model, found.at, levels)
    return _searched(model, start, loss, held)


def _searched(model: FittedModel, start: Array, loss: str, held: Sequence[int]) -> Optimum:
    """Return the minimum of −log L, or of the loss, over the parameters that are not held."""
    space = model.space
    moving = np.array([i for i in range(len(start)) if i not in held], dtype=int)
    lower, upper = space.bounds()
    limits = np.array([one.parameter.limits for one in space.free])
    whole = space.coordinates(start)

    def free(u: Array) -> Array:
        """Return the parameters at these coordinates of those that move; the others, and bounds, to the last bit."""
        inside, found = whole.copy(), start.copy()
        inside[moving] = u
        found[moving] = space.natural(inside)[moving]
        for bounds, own in ((lower, limits[:, 0]), (upper, limits[:, 1])):
            there = moving[u == bounds[moving]]
            found[there] = own[there]
        return found

    def at(u: Array) -> QuadraticModel | None:
        here = model.evaluate(free(u))
        if not isinstance(here, ModelValues):
            return None
        found = quadratic(model, here, loss)
        degrees = max(model.size - len(moving), 1)
        known = loss != "linear" or model.estimates_noise
        unit = 1.0 if known else float(np.sum(here.residuals**2)) / degrees
        if len(moving) == len(start):
            return found._replace(unit=unit)
        return QuadraticModel(found.cost, found.gradient[moving], found.information[np.ix_(moving, moving)], unit)

    def ends(u: Array) -> str | None:
        values = free(u)
        noise = [values[i] for i in moving.tolist() if space.free[i].level]
        none = min(noise, default=math.inf) < _NO_NOISE * _size(model)
        return "The model fits the data without noise: keep sigma fixed" if none else None

    end = minimise(at, np.clip(whole[moving], lower[moving], upper[moving]), lower[moving], upper[moving], ends)
    best = model.evaluate(free(end.u))
    assert isinstance(best, ModelValues)
    cost = _cost(model, best, loss, space.priors(best.free))
    return Optimum(best, cost, end.success, end.message, weighted(loss, best.residuals).second)


def _cost(model: FittedModel, at: ModelValues, loss: str, priors: Priors) -> float:
    """Return half the sum of squares, or of their losses, with those of the priors; −log L if sigma is estimated."""
    if model.estimates_noise or model.has_laplace:
        data = -model.log_likelihood(at, at.sigma)
    else:
        data = weighted(loss, at.residuals).cost
    return data + priors.cost


def quadratic(model: FittedModel, at: ModelValues, loss: str) -> QuadraticModel:
    """Return the cost with its derivatives in coordinates."""
    slope, priors = model.space.slope(at.free), model.space.priors(at.free)
    rows = model.information(at) * slope
    if loss == "linear":
        gradient = -model.gradient(at) * slope
    else:
        known = weighted(loss, at.residuals)
        gradient = rows.T @ (known.first * at.residuals)
        rows *= known.second[:, None]
    of_priors = priors.slopes * slope
    gradient = gradient + of_priors.T @ priors.residuals
    return QuadraticModel(_cost(model, at, loss, priors), gradient, rows.T @ rows + of_priors.T @ of_priors, 1.0)


def _size(model: FittedModel) -> float:
    return float(np.abs(model._compared).max(initial=0.0)) or 1.0


def _require(model: FittedModel, free: Array) -> None:
    at = model.evaluate(free)
    if not isinstance(at, ModelValues):
        values = ", ".join(f"{one.name} = {value:.6g}" for one, value in zip(model.space.free, free, strict=True))
        raise NoStartError(f"the model cannot be evaluated at the start, {values}: {at.reason}")


def _with_levels(model: FittedModel, at: ModelValues, levels: Sequence[int]) -> Array:
    """Return the parameters, with the noise levels that the residuals give, within their bounds."""
    free = at.free.copy()
    for i in levels:
        those = [one for one in at.levels if one.slope[i] != 0]
        squares = sum(float(np.sum(at.residuals[one.data] ** 2)) for one in those)
        count = sum(len(one.data) for one in those)
        lower, upper = model.space.free[i].parameter.limits
        least = max(lower, _NO_NOISE * _size(model) * EPS)
        free[i] = min(max(free[i] * math.sqrt(squares / max(count, 1)), least), upper)
    return free


def start_points(model: FittedModel, count: int, seed: Any) -> list[Array]:
    """Return the first start, and others that fill the bounds evenly: a Latin hypercube."""
    space = model.space
    first = np.array([1.0 if one.start is None else one.start for one in space.free])
    first = _with_first_levels(model, first)
    if count == 1:
        return [first]
    lower, upper = space.bounds()
    for i, one in enumerate(space.free):
        if one.level:
            lower[i] = upper[i] = math.log(first[i])
        if not (math.isfinite(lower[i]) and math.isfinite(upper[i])):
            raise ValueError(f"starts={count} needs two bounds of {one.name}, got {one.parameter.bounds}")
    rng, others = np.random.default_rng(seed), count - 1
    part = np.array([(rng.permutation(others) + rng.random(others)) / others for _ in lower]).T
    return [first, *(space.natural(lower + one * (upper - lower)) for one in part)]


def _with_first_levels(model: FittedModel, free: Array) -> Array:
    """Return the start with noise levels, where they have no start, of the size of the first residuals."""
    unknown = [i for i, one in enumerate(model.space.free) if one.level and one.start is None]
    at = model.evaluate(free) if unknown else None
    return _with_levels(model, at, unknown) if isinstance(at, ModelValues) else free
