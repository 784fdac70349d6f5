"""The log-likelihood of parameters with its gradient, for samplers and optimisers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ..._base.arguments import Array, real_numbers
from ..._base.labelled import by_name
from ..._base.package import public
from ..._base.types import MethodName
from ..._problem.options import Options
from .experiment import Noise
from .likelihood import FittedModel, ModelValues, to_model
from .search import start_points


@public
class Objective:
    """The log-likelihood of data as a function of the parameters, as returned by `objective`.

    ``objective(x)`` is the value at x of shape (k,), or a dict or Series by name, -inf outside the bounds and where
    the run fails; ``objective.gradient(x)`` is the gradient, and ``objective.both(x)`` returns the value and the
    gradient. The last point is cached: value and gradient at one point take one run.

    Attributes
    ----------
    names : tuple of str
        The parameters, in the order of x.
    start : ndarray, (k,)
        The start of each parameter.
    bounds : list of (float, float)
        The bounds of each parameter, infinite if it has none.
    failures : dict
        The number of failed runs by reason.
    """

    def __init__(self, model: FittedModel) -> None:
        self._model = model
        self.names = tuple(one.name for one in model.space.free)
        self.start: Array = start_points(model, 1, None)[0]
        self.bounds = [one.parameter.limits for one in model.space.free]
        limits = np.reshape(self.bounds, (-1, 2))
        positive = np.nextafter(0.0, 1.0)  # the least value of parameters that have logarithms
        lower = np.where([one.log for one in model.space.free], np.maximum(limits[:, 0], positive), limits[:, 0])
        self._limits = [*zip(lower.tolist(), limits[:, 1].tolist(), strict=True)]

    @property
    def failures(self) -> dict[str, int]:
        return dict(self._model.failures)

    def __call__(self, x: ArrayLike) -> float:
        return self.both(x)[0]

    def gradient(self, x: ArrayLike) -> Array:
        """Return the gradient, (k,); NaN where the value is -inf."""
        return self.both(x)[1]

    def both(self, x: ArrayLike) -> tuple[float, Array]:
        """Return value and gradient."""
        free = real_numbers("x", by_name("x", x, self.names, "parameters"))
        if free.shape != (len(self.names),):
            raise ValueError(f"x must hold the {len(self.names)} parameters {', '.join(self.names)}, got {free.shape}")
        model = self._model
        inside = all(low <= value <= high for value, (low, high) in zip(free.tolist(), self._limits, strict=True))
        at = model.evaluate(free) if inside else None
        if not isinstance(at, ModelValues):
            return -np.inf, np.full(len(free), np.nan)
        variance = model.variance(at)
        sigma = at.sigma * math.sqrt(variance) if model.relative else at.sigma
        value, gradient = model.log_likelihood(at, sigma), model.gradient(at, variance)
        if model.space.has_priors:
            priors = model.space.priors(at.free)
            value = value + priors.log_factor - priors.cost - 0.5 * len(priors.residuals) * math.log(2 * math.pi)
            gradient += priors.slope_of_factor - priors.slopes.T @ priors.residuals
        return value, gradient

    def __repr__(self) -> str:
        return f"Objective({', '.join(self.names)}; {self._model.size} data)"


@public
def objective(
    problem: Any,
    t: Any = None,
    data: Any = None,
    parameters: Any = None,
    *,
    observe: Any = None,
    sigma: Any = None,
    noise: Noise | Sequence[Noise] = "normal",
    event_times: Any = None,
    event_sigma: Any = None,
    y0: Literal["steady"] | Callable[..., Any] | None = None,
    absolute_sigma: bool = True,
    method: MethodName = "ode45",
    **options: Unpack[Options],
) -> Objective:
    """Make a function that computes the log-likelihood of the data, and its gradient, from the parameters.

    It is for samplers, such as those of PyMC and emcee, and for other optimisers. If parameters have priors, the
    logarithms of the prior densities are added (without its unknown constant for a prior that is a function). If sigma
    is unknown or relative, its best value for these parameters is used.

    Parameters
    ----------
    problem, t, data, parameters, observe, sigma, noise, event_times, event_sigma, y0, absolute_sigma, method, **options
        As in `fit`.

    Returns
    -------
    Objective
        A function of an array of the free parameters, in the order of its `names`.

    Examples
    --------
    >>> import invariode as iv
    >>> def decay(t, y, k):
    ...     return [-k * y[0]]
    >>> problem = iv.Problem(decay, (0, 4), [1.0], args=(1.0,))
    >>> log_likelihood = iv.objective(problem, [1, 2, 4], [[0.6, 0.37, 0.13]], {"k": (0, 5)}, sigma=0.01)
    >>> log_likelihood([0.5]) > log_likelihood([0.6])
    True
    >>> log_likelihood.gradient([0.6]).shape
    (1,)
    """
    described = {
        "observe": observe,
        "sigma": sigma,
        "noise": noise,
        "event_times": event_times,
        "event_sigma": event_sigma,
        "y0": y0,
    }
    return Objective(to_model(problem, t, data, parameters, described, absolute_sigma, method, options))
