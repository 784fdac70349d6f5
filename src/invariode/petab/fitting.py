"""The search for parameters from many starts: trust regions with the Fisher information, within bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base.arguments import Array
from .likelihood import Evaluation

#: The first radius, on the scale of the parameters, and by how much it shrinks and grows (J. Nocedal and S. J. Wright,
#: Numerical Optimization, algorithm 4.1).
_FIRST, _SHRINKS, _GROWS = 1.0, 0.25, 2.0
#: Parts of the predicted gain below which a step is refused, and below and above which the radius changes.
_REFUSED, _POOR, _GOOD = 1e-4, 0.25, 0.75
#: The search has arrived where the predicted gain is below this, or the radius is.
_GAIN, _RADIUS = 1e-7, 1e-8


@dataclass(frozen=True)
class Local:
    """The end of the search from one start.

    Attributes
    ----------
    x : ndarray, (k,)
        The parameters on their scales.
    log_likelihood : float
        There; -inf if the start could not be evaluated.
    success : bool
        Whether it arrived at an optimum.
    iterations : int
        Evaluations.
    """

    x: Array
    log_likelihood: float
    success: bool
    iterations: int


@dataclass(frozen=True)
class Fit:
    """The best parameters of a search from many starts, as returned by ``Problem.fit``.

    Attributes
    ----------
    x : ndarray, (k,)
        The parameters on their scales.
    parameters : dict
        The parameters on the linear scale.
    log_likelihood : float
        There.
    all : list of Local
        The ends of all searches, the best first.
    """

    x: Array
    parameters: dict[str, float]
    log_likelihood: float
    all: list[Local] = field(repr=False)


def climb(objective: Callable[[Array], Evaluation], start: Array, lower: Array, upper: Array, most: int) -> Local:
    """Return the maximum to which steps within a trust region lead.

    The model of the negative posterior is −g·s + sᵀ F s / 2 with the Fisher information F; parameters at a bound that
    they would leave stay there. A step that ends beyond a bound is cut to the box.
    """
    x, at = start, objective(start)
    if not math.isfinite(at.log_likelihood):
        return Local(start, -math.inf, False, 1)
    radius, count = _FIRST, 1
    while count < most:
        g, F = _whole(at)
        step = _within(x, g, F, lower, upper, radius)
        gain = float(g @ step - 0.5 * step @ F @ step)
        if gain <= _GAIN or radius < _RADIUS:
            return Local(x, at.log_likelihood, True, count)
        other = objective(x + step)
        count += 1
        real = other.log_likelihood + other.log_prior - at.log_likelihood - at.log_prior
        ratio = real / gain if math.isfinite(real) else -1.0
        length = float(np.linalg.norm(step))
        if ratio < _POOR:
            radius = _SHRINKS * length
        elif ratio > _GOOD and length > 0.8 * radius:
            radius *= _GROWS
        if ratio > _REFUSED:
            x, at = x + step, other
    return Local(x, at.log_likelihood, False, count)


def _whole(at: Evaluation) -> tuple[Array, Array]:
    """Return gradient and information, those of the prior included."""
    assert at.gradient is not None
    k = len(at.gradient)
    prior = np.zeros(k) if at.log_prior_gradient is None else at.log_prior_gradient
    F = np.zeros((k, k)) if at.fisher is None else at.fisher
    return at.gradient + prior, F


def _within(x: Array, g: Array, F: Array, lower: Array, upper: Array, radius: float) -> Array:
    """Return the step to the maximum of the model within the radius and the bounds."""
    free = ~(((x <= lower) & (g < 0)) | ((x >= upper) & (g > 0)))
    step = np.zeros_like(x)
    for _ in range(len(x) + 1):
        if not free.any():
            break
        rest = g - F @ step
        inner = _regular(rest[free], F[np.ix_(free, free)], math.sqrt(max(radius**2 - float(step @ step), 1e-16)))
        trial = step.copy()
        trial[free] += inner
        beyond = (x + trial < lower) | (x + trial > upper)
        if not (beyond & free).any():
            return trial
        # up to the first bound, where the component then stays
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(trial > step, (upper - x - step) / (trial - step), (lower - x - step) / (trial - step))
        room[~free | (trial == step)] = np.inf
        first = int(np.argmin(room))
        step = step + min(float(room[first]), 1.0) * (trial - step)
        step[first] = (upper if trial[first] > step[first] else lower)[first] - x[first]
        free[first] = False
    return step


def _regular(g: Array, F: Array, radius: float) -> Array:
    """Return the maximum of g·s − sᵀ F s / 2 with |s| ≤ radius: by the eigenvalues of F, and bisection of the shift."""
    values, V = np.linalg.eigh(F)
    values = np.maximum(values, 0.0)
    c = V.T @ g
    size = float(np.linalg.norm(c))

    def length(shift: float) -> float:
        return float(np.linalg.norm(c / (values + shift)))

    low = 1e-12 * max(float(values[-1]), size / radius, 1e-300)
    if length(low) <= radius:
        return np.asarray(V @ (c / (values + low)))
    high = max(size / radius, low) * 2
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if length(middle) > radius else (low, middle)
    return np.asarray(V @ (c / (values + high)))


def from_all(objective: Any, starts: Array, lower: Array, upper: Array, most: int) -> Iterator[Local]:
    """Yield the ends of the searches from all starts."""
    for start in starts:
        yield climb(objective, np.clip(start, lower, upper), lower, upper, most)
