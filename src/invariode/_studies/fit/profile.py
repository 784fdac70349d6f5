"""Profile likelihoods: the best fits with one parameter fixed at other values, and the resulting interval."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..._base.arguments import Array
from ..._base.package import public
from . import picture
from .likelihood import FittedModel, ModelValues
from .search import NoStartError, Optimum, search

if TYPE_CHECKING:  # an extra, imported when a picture is drawn
    from matplotlib.axes import Axes

#: An end of an interval is found when its statistic is this close to the quantile, relatively.
_CLOSE = 1e-3

#: Attempts for each end. A statistic that is linear needs one, smooth ones three or four.
_ATTEMPTS = 24

#: A parameter that the data do not determine is followed from this step on, relative to its size, by factors of four at
#: most; an end that is this many first steps away is not there.
_FIRST_STEP, _FASTER, _FAR = 0.1, 4.0, 1e4


@public
@dataclass(frozen=True, eq=False, repr=False)
class Profile:
    """Profile likelihood of one parameter: all others are refitted at each of its values.

    Attributes
    ----------
    name : str
        The parameter.
    values : ndarray, (p,)
        The values of the parameter, in increasing order.
    statistic : ndarray, (p,)
        The signed root of the likelihood ratio at `values`, in standard errors: linear if the model is linear.
    lower, upper : float
        The interval: an end is a bound if the profile reaches it, infinite if the data do not limit the parameter.
    level : float
        The confidence level.
    quantile : float
        The size of `statistic` at the ends of the interval.
    fits : int
        The number of fits.
    """

    name: str
    values: Array
    statistic: Array
    lower: float
    upper: float
    level: float
    quantile: float
    fits: int

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Plot the likelihood ratio over the parameter, the square of `statistic`, with the interval.

        A parabola belongs to a model that is linear in the parameter; a curve that stays below the dashed line to one
        side, to data that do not limit it there.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            The axes. Default: a new figure.

        Returns
        -------
        matplotlib.axes.Axes
        """
        ends = (self.lower, self.upper)
        return picture.draw_profile(self.name, self.values, self.statistic, ends, self.quantile, self.level, ax)

    def __repr__(self) -> str:
        ends = f"{self.lower:.6g} to {self.upper:.6g}"
        return f"Profile of {self.name}: {ends} with {100 * self.level:g} %, {self.fits} fits"


class Scale(NamedTuple):
    """Factors that convert costs into standard errors."""

    quantile: float
    variance: float  # of which half the cost is in units


class _OnProfile(NamedTuple):
    u: float
    z: float  # of the other sign than at the minimum if the end is passed: |z| − quantile is looked for
    at: Array


class ProfileWalk:
    """Walk along the profile from the best fit towards one end of the interval.

    - `model`, `found`: the fit
    - `place`: the parameter
    - `direction`, (k,): how all of them move along the profile, in coordinates, for a unit step of this one
    - `step`: the first step, with its sign
    - `scale`: the quantile to reach
    """

    def __init__(
        self, model: FittedModel, found: Optimum, place: int, direction: Array, step: float, scale: Scale
    ) -> None:
        self._model, self._found, self._place, self._scale = model, found, place, scale
        self._direction = direction
        self._start = model.space.coordinates(found.at.free)
        lower, upper = model.space.bounds()
        self._lower, self._upper = lower, upper
        self._bound = float(upper[place] if step > 0 else lower[place])
        self._step = step
        self.points: list[_OnProfile] = []

    def end(self) -> float:
        """Return the end of the interval, in the parameter's values."""
        inside = _OnProfile(float(self._start[self._place]), 0.0, self._start)
        outside: _OnProfile | None = None
        u = self._within(inside.u + self._step)
        for _ in range(_ATTEMPTS):
            point = self._refit(u, inside)
            if point is None:  # there is no solution: closer
                u = inside.u + (u - inside.u) / 4
                continue
            self.points.append(point)
            if abs(point.z / self._scale.quantile - 1) <= _CLOSE:
                return self._value(point.u)
            if point.z < self._scale.quantile:
                if point.u == self._bound:
                    return self._value(point.u)
                if abs(point.u - float(self._start[self._place])) > _FAR * abs(self._step):
                    break
                inside = point
            else:
                outside = point
            u = self._within(self._next(inside, outside))
        return self._value(u) if outside is not None else math.copysign(math.inf, self._step)

    def _next(self, inside: _OnProfile, outside: _OnProfile | None) -> float:
        """Return the next u: where a straight line reaches the quantile; without an outer point farther by at most a
        factor."""
        start = float(self._start[self._place])
        if outside is None:
            far = inside.u - start
            part = self._scale.quantile / inside.z if inside.z > 0 else math.inf
            return start + far * min(part * (1 + _CLOSE / 2), _FASTER)
        part = (self._scale.quantile - inside.z) / (outside.z - inside.z)
        return inside.u + min(max(part, 0.05), 0.95) * (outside.u - inside.u)

    def _within(self, u: float) -> float:
        return min(u, self._bound) if self._step > 0 else max(u, self._bound)

    def _refit(self, u: float, near: _OnProfile) -> _OnProfile | None:
        """Return the best fit with the parameter at u, from that of the nearest point."""
        coordinates = near.at + (u - near.u) * self._direction
        inner = np.clip(coordinates, self._lower, self._upper)
        inner[self._place] = u
        for start in (inner, np.where(np.arange(len(inner)) == self._place, u, near.at)):
            try:
                found = search(self._model, self._model.space.natural(start), held=[self._place])
            except NoStartError:
                continue
            return _OnProfile(u, math.sqrt(max(self._gained(found), 0.0)), self._model.space.coordinates(found.at.free))
        return None

    def _gained(self, found: Optimum) -> float:
        """Return twice the increase of the cost; that of the data in units of the variance, which priors do not
        have."""
        before, now = (self._model.space.priors(one.at.free).cost for one in (self._found, found))
        data = (found.cost - now) - (self._found.cost - before)
        return 2 * (data / self._scale.variance + now - before)

    def _value(self, u: float) -> float:
        free = self._start.copy()
        free[self._place] = u
        return float(self._model.space.natural(free)[self._place])


def profile(model: FittedModel, found: Optimum, place: int, covariance: Array, scale: Scale, level: float) -> Profile:
    """Return the profile of a parameter; `covariance` of all in coordinates."""
    assert isinstance(found.at, ModelValues)
    own = covariance[place, place]
    determined = bool(np.isfinite(own) and own > 0)
    k = len(covariance)
    direction = np.eye(k)[place]
    if determined:
        with np.errstate(invalid="ignore"):
            direction = covariance[place] / own
        direction = np.where(np.isfinite(direction), direction, 0.0)
    u = float(model.space.coordinates(found.at.free)[place])
    step = scale.quantile * math.sqrt(own) if determined else _FIRST_STEP * max(abs(u), 1.0)
    ends, points = [], [_OnProfile(u, 0.0, np.zeros(k))]
    for sign in (-1.0, 1.0):
        walk = ProfileWalk(model, found, place, direction, sign * step, scale)
        ends.append(walk.end())
        points += [one._replace(z=sign * one.z) for one in walk.points]
    points.sort(key=lambda one: one.u)
    free = found.at.free.copy()
    values = []
    for one in points:
        moved = model.space.coordinates(free)
        moved[place] = one.u
        values.append(float(model.space.natural(moved)[place]))
    statistic = np.array([one.z for one in points])
    name = model.space.free[place].name
    return Profile(name, np.array(values), statistic, ends[0], ends[1], level, scale.quantile, len(points) - 1)
