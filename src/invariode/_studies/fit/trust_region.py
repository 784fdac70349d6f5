"""Minimisation within bounds from values, gradients and expected second derivatives: steps within a trust region.

For sums of squares these are Gauss-Newton steps, for likelihoods those of Fisher's scoring. What the expected second
derivatives leave out is estimated from changes of the gradient, and used if it predicts the cost better (J. E. Dennis,
D. M. Gay and R. E. Welsch, ACM Trans. Math. Softw. 7 (1981) 348-368).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..._base.arguments import EPS, Array

#: The search has arrived when the whole step is this part of the standard errors.
_ARRIVED = 1e-5
#: The first radius, a factor of ten of parameters on logarithmic scales, and by how much it shrinks and grows
#: (J. Nocedal and S. J. Wright, Numerical Optimization, algorithm 4.1).
_FIRST, _SHRINKS, _GROWS = math.log(10.0), 0.25, 2.0
#: Parts of the predicted decrease below which a step is refused, and below and above which the radius changes; a step
#: of at least this part of the radius makes it grow.
_REFUSED, _POOR, _GOOD, _WHOLE = 1e-4, 0.25, 0.75, 0.8
#: A model of the second derivatives replaces the other one if its error is below this part of the other's; the cosine
#: between a step and the change of the gradient below which that says nothing.
_BETTER, _CURVED = 0.5, 1e-8
#: Relative changes of the cost, and of the parameters, that count as none where a step is refused.
_CHANGE = 1e-8
#: Second derivatives below this part of the largest are zero: the step of smallest length leaves these directions out.
_SINGULAR = 1e-12
#: Bisections of the shift that makes a step as long as the radius, and the relative accuracy of its length.
_BISECTIONS, _ACCURATE = 60, 1e-3
#: Evaluations per parameter.
_MOST = 100


class QuadraticModel(NamedTuple):
    """A cost at a point, with its gradient (k,) and the expected matrix of its second derivatives (k, k); `unit` is
    twice the increase of the cost by a change of the parameters of one standard error."""

    cost: float
    gradient: Array
    information: Array
    unit: float


class End(NamedTuple):
    """End of a minimisation: where, whether it arrived, and why it ended."""

    u: Array
    success: bool
    message: str


def minimise(
    at: Callable[[Array], QuadraticModel | None],
    start: Array,
    lower: Array,
    upper: Array,
    ends: Callable[[Array], str | None],
) -> End:
    """Return a local minimum within the bounds.

    - `at`: the model of the cost at u, or None where it cannot be evaluated, which `start` must not be
    - `start`, `lower`, `upper`, (k,): where the search starts, and the bounds
    - `ends`: the reason to end at u without success, or None
    """
    u, here = start, at(start)
    assert here is not None
    radius, rest, uses_rest = _FIRST, np.zeros_like(here.information), False
    for _ in range(_MOST * max(len(u), 1)):
        model = here.information + rest if uses_rest else here.information
        point = within(u, -here.gradient, model, lower, upper, radius)
        step = point - u
        gain = float(-here.gradient @ step - 0.5 * step @ model @ step)
        if 2 * gain <= _ARRIVED**2 * here.unit:
            return End(u, True, "The search has arrived: the next step is far below the standard errors.")
        there = at(point)
        real = -math.inf if there is None else here.cost - there.cost
        length = float(np.linalg.norm(step))
        if real < _POOR * gain:
            radius = _SHRINKS * length
        elif real > _GOOD * gain and length > _WHOLE * radius:
            radius *= _GROWS
        if there is not None:
            other = gain - (0.5 if not uses_rest else -0.5) * float(step @ rest @ step)
            if abs(other - real) < _BETTER * abs(gain - real):
                uses_rest = not uses_rest
        if there is not None and real > _REFUSED * gain:
            rest = _secant(rest, step, there.gradient - here.gradient, there.information)
            u, here = point, there
            if (reason := ends(u)) is not None:
                return End(u, False, reason)
        elif gain <= _CHANGE * abs(here.cost) or radius <= _CHANGE * (1 + float(np.linalg.norm(u))):
            return End(u, True, "The search has arrived: the cost no longer decreases.")
    return End(u, False, "The search did not arrive within its number of evaluations.")


def _secant(rest: Array, step: Array, change: Array, information: Array) -> Array:
    """Return the estimate of the second derivatives beyond the expected ones: the least change, in a metric that the
    change of the gradient gives, for which both together map the step to that change."""
    along = float(change @ step)
    wanted = change - information @ step
    if along <= _CURVED * float(np.linalg.norm(change) * np.linalg.norm(step)):
        return rest
    size = abs(float(step @ rest @ step))
    sized = min(1.0, abs(float(step @ wanted)) / size) * rest if size > 0 else rest
    error = wanted - sized @ step
    both = np.outer(error, change)
    return np.asarray(sized + (both + both.T) / along - float(error @ step) * np.outer(change, change) / along**2)


def within(u: Array, g: Array, F: Array, lower: Array, upper: Array, radius: float) -> Array:
    """Return u + s with the maximum of g·s − sᵀ F s / 2 for |s| ≤ radius and lower ≤ u + s ≤ upper, along a path:
    components that reach a bound stay there."""
    free = ~(((u <= lower) & (g < 0)) | ((u >= upper) & (g > 0)))
    point = u.copy()
    while free.any():
        step = point - u
        left = math.sqrt(max(radius**2 - float(step @ step), EPS * radius**2))
        if free.all():
            outwards = _unbounded(g - F @ step, F, left)
        else:
            outwards = np.zeros_like(u)
            outwards[free] = _unbounded((g - F @ step)[free], F[np.ix_(free, free)], left)
        beyond = free & ((point + outwards < lower) | (point + outwards > upper))
        if not beyond.any():
            return point + outwards
        # up to the first bound, where the component then stays
        bounds, room = np.where(outwards > 0, upper, lower), np.full_like(u, np.inf)
        room[beyond] = (bounds - point)[beyond] / outwards[beyond]
        first = int(np.argmin(room))
        point = np.clip(point + max(float(room[first]), 0.0) * outwards, lower, upper)
        point[first] = bounds[first]
        free[first] = False
    return point


def _unbounded(g: Array, F: Array, radius: float) -> Array:
    """Return the maximum of g·s − sᵀ F s / 2 with |s| ≤ radius: by the eigenvalues of F, and bisection of the shift."""
    values, V = np.linalg.eigh(F)
    c = V.T @ g
    size = math.sqrt(float(c @ c))
    if size == 0.0:
        return np.zeros_like(g)
    values = values - min(float(values[0]), 0.0)  # directions of negative curvature end at the radius

    def length(shift: float) -> float:
        s = c / (values + shift)
        return math.sqrt(float(s @ s))

    low = _SINGULAR * max(float(values[-1]), size / radius)
    if length(low) <= radius:
        return np.asarray(V @ (c / (values + low)))
    high = 2 * max(size / radius, low)
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if length(middle) > radius else (low, middle)
        if high <= (1 + _ACCURATE) * low:
            break
    return np.asarray(V @ (c / (values + high)))
