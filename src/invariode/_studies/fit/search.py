"""The search for the best parameters: a trust region with exact Jacobians, from one start or many."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import EPS, Array
from .likelihood import Evaluation, Model
from .parameters import Space

#: The search has arrived when the whole Gauss-Newton step is this part of the standard errors.
_ARRIVED = 1e-5

#: Relative changes at which a search ends that cannot come so close, those of `scipy.optimize.least_squares`.
_CHANGE = 1e-8

#: A round lets noise levels fall by this part of their logarithm at most, and moves on from there: the square of
#: the residual that stands for them stays positive.
_FALL = 0.4

#: Rounds of noise levels; each follows from the residuals of the last one.
_ROUNDS = 30

#: A noise level below this part of the data is that of a model that fits without errors.
_NO_NOISE = 1e4 * EPS

#: A search moves towards a bound without reaching it: it is put there from this part of a standard error on.
_NEAR = 0.01


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
    """The loss of residuals r, ½ Σ ρ(r²), and its derivatives.

    Attributes
    ----------
    cost : float
        The loss.
    first : ndarray, (N,)
        ρ′: the gradient of the loss is Jᵀ (ρ′ r).
    second : ndarray, (N,)
        √(ρ′ + 2 ρ″ r²): factors of the rows of J for which JᵀJ is the second derivative of the loss. Residuals for
        which it is negative count as almost nothing, as in `scipy.optimize.least_squares`.
    """

    cost: float
    first: Array
    second: Array


def weighted(loss: str, residuals: Array) -> Weighted:
    """Return the loss of the residuals of data."""
    rho, z = LOSSES[loss], residuals**2
    if rho is None:
        return Weighted(0.5 * float(z.sum()), np.ones_like(z), np.ones_like(z))
    value, first, second = rho(z)
    return Weighted(0.5 * float(value.sum()), first, np.sqrt(np.maximum(first + 2 * second * z, EPS)))


class Found(NamedTuple):
    """End of a search.

    Attributes
    ----------
    at : Evaluation
        The model there.
    cost : float
        Half the sum of squares, or of their losses, with those of the priors; with noise levels −log L.
    success, message
        Whether it arrived, and how it ended.
    weights : ndarray, (N,)
        Factors of the rows of the Jacobian for which JᵀJ is the second derivative of the loss; 1 without a loss.
    """

    at: Evaluation
    cost: float
    success: bool
    message: str
    weights: Array


class NoStartError(Exception):
    """The model cannot be evaluated at a start."""


class _Arrived(Exception):  # noqa: N818 - no error: it ends a search
    """Signal that the next step would be too small to matter."""


def search(model: Model, start: Array, loss: str = "linear", held: Sequence[int] = ()) -> Found:
    """Return the best parameters near a start; those `held` stay there.

    Raises
    ------
    NoStartError
        The runs fail at the start.
    """
    _require(model, start)
    found = _searched(model, start, loss, held)
    held = list(held)
    while bounds := _reached(model, found, loss, held):
        free = found.at.free.copy()
        for i, bound in bounds.items():
            free[i] = bound
        held += bounds
        if not isinstance(model.evaluate(free), Evaluation):
            break  # on the bound itself there is no solution
        found = _searched(model, free, loss, held)
    return found


def _searched(model: Model, start: Array, loss: str, held: Sequence[int]) -> Found:
    levels = [i for i, one in enumerate(model.space.free) if one.level and i not in held]
    if not levels:
        return _Round(model, start, loss, held, []).found()
    found = _Round(model, start, loss, [*held, *levels], []).found()
    for _ in range(_ROUNDS):
        free = _with_levels(model, found.at, levels)
        found = _Round(model, free, loss, held, levels).found()
        if (np.log(found.at.free[levels] / free[levels]) > -0.9 * _FALL).all():
            break
        if (found.at.free[levels] < _NO_NOISE * _size(model)).any():
            return found._replace(success=False, message="The model fits the data without noise: keep sigma fixed")
    return found


def _reached(model: Model, found: Found, loss: str, held: Sequence[int]) -> dict[int, float]:
    """Return bounds that the search was moving towards when it ended, by parameter."""
    space, at = model.space, found.at
    u = space.coordinates(at.free)
    rows = at.with_levels(at.jacobian) * space.slope(at.free)
    first = weighted(loss, at.residuals).first
    gradient = rows.T @ (first * at.residuals)
    for level in at.levels:  # of c ln s
        gradient += len(level.data) / level.value * level.slope * space.slope(at.free)
    rows *= found.weights[:, None]
    priors = space.priors(at.free)
    gradient += (priors.slopes * space.slope(at.free)).T @ priors.residuals
    error = math.sqrt(float(np.mean(first * at.residuals**2)))
    reached = {}
    for i, one in enumerate(space.free):
        for bound, outwards in zip(one.parameter.limits, (-1.0, 1.0), strict=True):
            if i in held or not math.isfinite(bound) or gradient[i] * outwards >= 0 or (one.log and not bound):
                continue
            away = abs(u[i] - (math.log(bound) if one.log else bound / one.size))
            if away * float(np.linalg.norm(rows[:, i])) <= _NEAR * error:
                reached[i] = bound
    return reached


def _size(model: Model) -> float:
    return float(np.abs(model._compared).max(initial=0.0)) or 1.0


def _require(model: Model, free: Array) -> None:
    at = model.evaluate(free)
    if not isinstance(at, Evaluation):
        values = ", ".join(f"{one.name} = {value:.6g}" for one, value in zip(model.space.free, free, strict=True))
        raise NoStartError(f"the model cannot be evaluated at the start, {values}: {at.reason}")


def _with_levels(model: Model, at: Evaluation, levels: Sequence[int]) -> Array:
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


class _Round:
    """A search with `scipy.optimize.least_squares`.

    A noise level s of c data adds c ln s to −log L, which is half the square of √(c (1 + 2 ln(s / s₀))) up to a
    constant. With s₀ near s its square of the derivative is the second derivative, as the method assumes.
    """

    def __init__(self, model: Model, start: Array, loss: str, held: Sequence[int], levels: Sequence[int]) -> None:
        self._model, self._loss, self._levels = model, loss, list(levels)
        self._space: Space = model.space
        self._whole = start.copy()
        self._moving = [i for i in range(len(start)) if i not in held]
        at = model.evaluate(start)
        assert isinstance(at, Evaluation)
        self._first = at
        self._lengths = [one.value for one in at.levels]

    def _free(self, u: Array) -> Array:
        whole = self._space.coordinates(self._whole)
        whole[self._moving] = u
        free = self._space.natural(whole)
        kept = [i for i in range(len(free)) if i not in self._moving]
        free[kept] = self._whole[kept]  # to the last bit
        return free

    def _limits(self) -> tuple[Array, Array]:
        lower, upper = self._space.bounds()
        for i in self._levels:
            lower[i] = max(lower[i], math.log(self._whole[i]) - _FALL)
        return lower[self._moving], upper[self._moving]

    def _rows(self, at: Evaluation) -> tuple[Array, Array]:
        """Return residuals and their derivatives in coordinates."""
        parts, rows = [at.residuals], [at.with_levels(at.jacobian)]
        if self._levels:
            for one, before in zip(at.levels, self._lengths, strict=True):
                length = math.sqrt(len(one.data) * (1 + 2 * math.log(one.value / before)))
                parts.append(np.array([length]))
                rows.append(len(one.data) / (length * one.value) * one.slope[None])
        priors = self._space.priors(at.free)
        jacobian = np.concatenate([*rows, priors.slopes]) * self._space.slope(at.free)
        return np.concatenate([*parts, priors.residuals]), jacobian[:, self._moving]

    def _residuals(self, u: Array) -> Array:
        at = self._model.evaluate(self._free(u))
        if isinstance(at, Evaluation):
            return self._rows(at)[0]
        return np.full(self._count, np.nan)  # a step that is not taken

    def _jacobian(self, u: Array) -> Array:
        """Return the Jacobian of an accepted step; the search ends here if the next step would be too small."""
        at = self._model.evaluate(self._free(u))
        assert isinstance(at, Evaluation)
        self._last = at
        residuals, jacobian = self._rows(at)
        if self._loss == "linear":
            step = np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
            squares = float(residuals @ residuals) / max(self._count - len(u), 1)
            if float(np.sum((jacobian @ step) ** 2)) <= _ARRIVED**2 * squares:
                raise _Arrived
        return jacobian

    def _losses(self) -> Any:
        """Return the loss of the data; priors stay normal."""
        rho, size = LOSSES[self._loss], self._model.size
        if rho is None:
            return "linear"

        def losses(z: Array) -> Array:
            found = np.stack([z, np.ones_like(z), np.zeros_like(z)])
            found[:, :size] = rho(z[:size])
            return found

        return losses

    def found(self) -> Found:
        """Return the end of the search."""
        from scipy.optimize import least_squares  # takes longer to import than everything else

        self._last = self._first
        self._count = len(self._rows(self._first)[0])
        lower, upper = self._limits()
        start = np.clip(self._space.coordinates(self._whole)[self._moving], lower, upper)
        if not self._moving:
            return self._ended(True, "Nothing to search for.")
        try:
            result = least_squares(
                self._residuals,
                start,
                self._jacobian,
                (lower, upper),
                x_scale="jac",
                loss=self._losses(),
                ftol=_CHANGE,
                xtol=_CHANGE,
                gtol=EPS,
            )
        except _Arrived:
            return self._ended(True, "The search has arrived: the next step is far below the standard errors.")
        at = self._model.evaluate(self._free(result.x))
        assert isinstance(at, Evaluation)
        self._last = at
        return self._ended(bool(result.status > 0), str(result.message))

    def _ended(self, success: bool, message: str) -> Found:
        at = self._last
        data = weighted(self._loss, at.residuals)
        cost = -self._model.log_likelihood(at, at.sigma) if at.levels else data.cost
        return Found(at, cost + self._space.priors(at.free).cost, success, message, data.second)


def start_points(model: Model, count: int, seed: Any) -> list[Array]:
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


def _with_first_levels(model: Model, free: Array) -> Array:
    """Return the start with noise levels, where they have no start, of the size of the first residuals."""
    unknown = [i for i, one in enumerate(model.space.free) if one.level and one.start is None]
    at = model.evaluate(free) if unknown else None
    return _with_levels(model, at, unknown) if isinstance(at, Evaluation) else free
