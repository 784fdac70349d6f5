"""Residuals, their derivatives, and the log-likelihood of parameters."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array, shown
from ..._base.forks import cached_property
from ..._base.types import MethodName
from ..._problem.given_options import changed, unknown_option
from ..._problem.options import TABLE, Options
from ..._problem.problem import Problem
from .data import is_table
from .experiment import Experiment, Failed
from .parameter_space import Parameter, Space, to_parameters
from .simulation import Simulation

#: Options of runs that a fit sets itself.
_OWN = ("t_eval", "keep", "sensitivities", "dense_output", "refine", "on_failure", "callback", "checkpoint", "events")

#: Tolerances of the runs: residuals must be smoother than the data are noisy, for which the defaults of runs are large.
RTOL, ATOL = 1e-6, 1e-9

#: Steps after which a run has failed: where trial parameters make the solution grow without bound, its sensitivities
#: would take 1e5 (Crauste's model). AMICI's default.
MOST_STEPS = 10_000

#: The name of an unknown sigma that is fitted.
IMPLIED = "sigma"

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


class NoiseLevel(NamedTuple):
    """A noise level in one experiment: its data, its value and how it follows from the free parameters."""

    data: Array  # which, of all
    value: float
    slope: Array  # (k,)


@dataclass(frozen=True, eq=False)
class ModelValues:
    """The model at values of the free parameters.

    Attributes
    ----------
    free : ndarray, (k,)
        The values.
    model, difference : ndarray, (N,)
        The model's values of all data; model minus data, of logarithms where the noise is log-normal.
    slopes : ndarray, (N, k)
        The derivatives of the differences.
    sigma : ndarray, (N,)
        Standard deviations; in units of the unknown one if they are relative. Of Laplace's distribution: the mean
        absolute deviation.
    spread : ndarray, (N, k), or None
        The derivatives of ln sigma; None: no parameter changes sigma.
    levels : list of NoiseLevel
        Noise levels among the parameters.
    """

    free: Array
    model: Array
    difference: Array
    slopes: Array
    sigma: Array
    spread: Array | None
    levels: list[NoiseLevel]

    @cached_property
    def residuals(self) -> Array:
        """Differences in units of sigma, (N,)."""
        return self.difference / self.sigma

    @cached_property
    def jacobian(self) -> Array:
        """The derivatives of `residuals` for the free parameters except through sigma, (N, k)."""
        return self.slopes / self.sigma[:, None]


class FittedModel:
    """Experiments with parameters: everything that a fit evaluates.

    Attributes
    ----------
    space : Space
        The parameters.
    relative : bool
        Whether sigma is known only up to a factor, which the residuals give.
    rtol : float
        The smallest relative tolerance of the runs.
    failures : Counter
        Why runs failed, with their number.
    runs : int
        The number of evaluations.
    implied : str or None
        The noise level that stands for an unknown sigma.
    """

    implied: str | None = None

    def __init__(
        self,
        experiments: Sequence[Experiment],
        parameters: Mapping[str, Parameter],
        absolute_sigma: bool,
        method: MethodName,
        options: Options,
    ) -> None:
        for name in _OWN:
            if name in options or any(name in one.options for one in experiments):
                instead = "give events to the Problem" if name == "events" else "fit sets it itself"
                raise TypeError(f"{name} is not an option of fit: {instead}")
        tolerant = changed({"rtol": RTOL, "atol": ATOL, "max_steps": MOST_STEPS}, options)
        self.rtol = float(np.min(tolerant["rtol"]))
        self.experiments = experiments
        self.space = Space(parameters, experiments)
        unnamed = {one.level for each in experiments for one in each.series if one.level is not None} - {*parameters}
        if unnamed:
            name = min(unnamed)
            raise ValueError(f'sigma names {name!r}, which is not among the parameters: add "{name}": (lower, upper)')
        start = np.array([1.0 if one.start is None else one.start for one in self.space.free])
        states: dict[Any, Any] = {}
        self.simulations = [
            Simulation(one, names, self.space.local(e, start).values, method, changed(tolerant, one.options), states)
            for e, (one, names) in enumerate(zip(experiments, self.space.names, strict=True))
        ]
        series = [one for each in experiments for one in each.series]
        self.measured = np.concatenate([one.values for one in series])
        self.lognormal = np.concatenate([np.full(len(one.values), one.lognormal) for one in series])
        self.laplace = np.concatenate([np.full(len(one.values), one.laplace) for one in series])
        self.has_lognormal, self.has_laplace = bool(self.lognormal.any()), bool(self.laplace.any())
        self._compared = np.where(self.lognormal, np.log(np.where(self.lognormal, self.measured, 1.0)), self.measured)
        self._logs_of_data = self._compared[self.lognormal].sum()
        self._log_factors = float(np.where(self.laplace, math.log(2), _HALF_LOG_2PI).sum())
        self.relative = _is_relative(series, absolute_sigma)
        #: A unit for data of unknown noise, so that the search sees numbers of size 1.
        unknown = any(one.sigma is None for one in series)
        self.unit = float(np.sqrt(np.mean(self._compared**2))) or 1.0 if unknown else 1.0
        known = [np.full(len(one.values), self.unit) if one.sigma is None else one.sigma for one in series]
        self._factors = np.concatenate(known)
        self._logs_of_sigma = np.log(self._factors).sum()
        self.size = len(self.measured)
        self.failures: Counter[str] = Counter()
        self.runs = 0
        self._last: ModelValues | None = None
        #: Whether parameters change sigma, so that its logarithm counts.
        self.estimates_noise = any(one.level is not None or one.formula for one in series)

    def evaluate(self, free: Array) -> ModelValues | Failed:
        """Return the model at these values. The last one is kept: searches ask for residuals and Jacobian one after the
        other."""
        if self._last is not None and (self._last.free == free).all():
            return self._last
        self.runs += 1
        found = self._evaluated(free)
        if not isinstance(found, Failed):
            self._last = found
        return found

    def _evaluated(self, free: Array, derivatives: bool = True) -> ModelValues | Failed:
        """Return the model at these values, with zeros for derivatives that are not wanted."""
        found = self._simulated(free, derivatives)
        if isinstance(found, Failed):
            self.failures[found.reason] += 1
        return found

    def _simulated(self, free: Array, derivatives: bool) -> ModelValues | Failed:
        values, slopes, levels, place = [], [], [], 0
        sigma = self._factors
        spread = None
        if self.estimates_noise:
            sigma, spread = sigma.copy(), np.zeros((self.size, len(free)))
        for e, simulation in enumerate(self.simulations):
            local = self.space.local(e, free)
            ran = simulation.run(local.values, derivatives)
            if isinstance(ran, Failed):
                return ran
            values.append(ran.values)
            moving = local.slopes[: ran.tangent.shape[1]]
            slopes.append(ran.tangent @ moving)
            if spread is None:
                continue
            if ran.sigma is not None:
                own = slice(place, place + len(ran.values))
                sigma[own] *= ran.sigma
                spread[own] += ran.sigma_tangent / ran.sigma[:, None] @ moving
            for one in simulation.experiment.series:
                data = np.arange(place, place + len(one.values))
                place += len(one.values)
                if one.level is None:
                    continue
                i = self.space.names[e].index(one.level)
                value, slope = float(local.values[i]), local.slopes[i]
                sigma[data] *= value
                spread[data] += slope / value
                levels.append(NoiseLevel(data, value, slope))
        model, rows = _joined(values), _joined(slopes)
        compared = self._scaled(model)
        if isinstance(compared, Failed):
            return compared
        if self.has_lognormal:
            rows = np.where(self.lognormal[:, None], rows / np.where(self.lognormal, model, 1.0)[:, None], rows)
        return ModelValues(free.copy(), model, compared - self._compared, rows, sigma, spread, levels)

    def _scaled(self, model: Array) -> Array | Failed:
        """Return the model's values as they are compared with the data: logarithms where the noise is log-normal."""
        if not self.has_lognormal:
            return model
        if (model[self.lognormal] <= 0).any():
            return Failed("the model is not positive, where the noise is log-normal")
        return np.where(self.lognormal, np.log(np.where(self.lognormal, model, 1.0)), model)

    def by_series(self, e: int, values: Array) -> list[Array]:
        """Return the values of an experiment, series by series, among those of all data, (N,)."""
        sizes = [len(one.values) for each in self.experiments[: e + 1] for one in each.series]
        return np.split(values[: sum(sizes)], np.cumsum(sizes)[:-1])[-len(self.experiments[e].series) :]

    def value(self, free: Array) -> float:
        """Return the log-likelihood of data with known or estimated sigma, -inf where a run fails, without
        derivatives."""
        at = self._evaluated(free, derivatives=False)
        return -math.inf if isinstance(at, Failed) else self.log_likelihood(at, at.sigma)

    def log_likelihood(self, at: ModelValues, sigma: Array) -> float:
        """Return the log-likelihood of the data with these standard deviations, without priors.

        The density is exp(-r²/2) / (√(2π) σ), or exp(-|r|) / (2 σ), of logarithms divided by the datum.
        """
        r = at.residuals if sigma is at.sigma else at.difference / sigma
        exponents = float((np.where(self.laplace, np.abs(r), 0.5 * r**2) if self.has_laplace else 0.5 * r**2).sum())
        logs = self._logs_of_sigma if sigma is self._factors else np.log(sigma).sum()
        return -exponents - float(logs + self._logs_of_data) - self._log_factors

    def gradient(self, at: ModelValues, variance: float = 1.0) -> Array:
        """Return the gradient of the log-likelihood for the free parameters, (k,)."""
        r = at.residuals
        found: Array = at.jacobian.T @ (np.where(self.laplace, np.sign(r), r) if self.has_laplace else r) / -variance
        if at.spread is not None:
            found += at.spread.T @ (np.where(self.laplace, np.abs(r), r**2) / variance - 1.0)
        return found

    def information(self, at: ModelValues) -> Array:
        """Return a matrix A with AᵀA the expected information of data with normal or Laplace noise: a datum determines
        its value with 1 / σ², and ln σ with 2, or 1 of Laplace's distribution."""
        if at.spread is None:
            return at.jacobian
        return np.concatenate([at.jacobian, at.spread * np.where(self.laplace, 1.0, math.sqrt(2))[:, None]])

    def variance(self, at: ModelValues, unknowns: int = 0) -> float:
        """Return the factor of sigma² that the residuals give, of which so many degrees of freedom are spent; NaN if
        none are left, 1 if sigma is known."""
        if not self.relative:
            return 1.0
        degrees = self.size - unknowns
        return float((at.residuals**2).sum()) / degrees if degrees > 0 else math.nan


def _joined(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _is_relative(series: Sequence[Any], absolute_sigma: bool) -> bool:
    """Return whether sigma is known only up to a factor."""
    unknown = [one.name for one in series if one.sigma is None]
    if unknown and len(unknown) < len(series):
        raise ValueError(f"sigma is missing for {unknown[0]}: give it for all data or for none")
    levels = [one.level for one in series if one.level is not None]
    if levels and not absolute_sigma:
        raise ValueError(f"absolute_sigma=False, and sigma names the parameter {levels[0]}: choose one of them")
    if any(one.formula for one in series) and not absolute_sigma:
        raise ValueError("absolute_sigma=False, and sigma is a function: multiply it by a parameter instead")
    if len(unknown) > 1 and len({one.lognormal for one in series}) > 1:
        raise ValueError("sigma must be given where times of events are measured beside log-normal data")
    relative = bool(unknown) or not absolute_sigma
    if relative and any(one.laplace for one in series):
        raise ValueError("Laplace noise needs a sigma: a number, a function, or the name of a parameter")
    return relative


def to_experiments(problem: Any, given: Mapping[str, Any]) -> list[Experiment]:
    """Return a list of experiments, or a problem with data as one."""
    if isinstance(problem, Experiment):
        problem = [problem]
    if isinstance(problem, (list, tuple)):
        if not problem or not all(isinstance(one, Experiment) for one in problem):
            raise TypeError(f"several experiments are a list of invariode.Experiment, got {shown(problem)}")
        if said := [
            name for name, value in given.items() if value is not None and (name, value) != ("noise", "normal")
        ]:
            raise TypeError(f"{said[0]} belongs to each Experiment when these are given")
        return list(problem)
    return [Experiment(problem, **given)]


#: Arguments of fits that are neither options of runs nor descriptions of data.
_OF_FITS = ("parameters", "absolute_sigma", "starts", "seed", "workers", "loss", "method")


def to_model(
    problem: Any,
    t: Any,
    data: Any,
    parameters: Any,
    described: Mapping[str, Any],
    absolute_sigma: bool,
    method: MethodName,
    options: Options,
    *,
    weighs_priors: bool = False,
) -> FittedModel:
    """Make the model from the arguments of `fit` and `objective`. `weighs_priors`: an unknown sigma is a parameter if
    there are priors, which have to be weighed against the data."""
    for name in options:
        if name not in TABLE:
            raise unknown_option(name, [*_OF_FITS, *described, *TABLE])
    several = not isinstance(problem, Problem) or described.get("event_times") is not None
    if parameters is None and data is None and several:  # fit(experiments, parameters)
        t, parameters = None, t
    elif is_table(t):  # fit(problem, table, parameters)
        if parameters is None:
            data, parameters = None, data
        if data is not None:
            raise TypeError("t is a table of data, and data were given too: pass one of them")
        t, data = None, t
    experiments = to_experiments(problem, {"t": t, "data": data, **described})
    wanted = to_parameters(parameters)
    series = [one for each in experiments for one in each.series]
    implied = None
    if weighs_priors and any(one.prior is not None for one in wanted.values()) and _is_relative(series, absolute_sigma):
        taken = any(name == IMPLIED for one in experiments for name in (*wanted, *one.known()))
        implied = f"{IMPLIED}[data]" if taken else IMPLIED
        experiments = [_with_level(one, implied) for one in experiments]
        wanted, absolute_sigma = {**wanted, implied: Parameter()}, True
    model = FittedModel(experiments, wanted, absolute_sigma, method, options)
    model.implied = implied
    return model


def _with_level(experiment: Experiment, name: str) -> Experiment:
    """Return the experiment with the unknown factor of sigma as a parameter."""
    found = copy(experiment)
    found.series = [
        one._replace(level=name, sigma=np.ones(len(one.values)) if one.sigma is None else one.sigma)
        for one in experiment.series
    ]
    return found
