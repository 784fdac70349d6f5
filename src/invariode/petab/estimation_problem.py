"""Problems of PEtab: simulations, log-likelihoods and gradients."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, real_numbers
from .._base.forks import cached_property
from .._base.labelled import in_order, named
from .._base.types import MethodName
from .._studies.fit.experiment import Experiment, Failed
from .._studies.fit.likelihood import FittedModel
from .._studies.fit.parameter_space import Parameter
from ..sbml.model import Model
from ..sbml.reading import contents
from .experiments import LN10, Experiments, Period, numbers
from .problem_files import Measurement, ParameterRow, Tables, fit_prior, log_density, rows_of, tables

#: Natural logarithms in units of a scale.
_UNITS = {"lin": 0.0, "log": 1.0, "log10": LN10}
#: The estimated parameters: an array on their scales, (k,), or their values by name.
Point: TypeAlias = ArrayLike | Mapping[str, float]


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


class Objective:
    """The log-likelihood of a problem of PEtab, as returned by `Problem.objective`.

    ``o(x)`` evaluates it with its gradient at x, (k,): the estimated parameters on their scales, in the order of
    `names`; or a dict of their values by name, as ``fit.parameters`` is. The result has ``log_likelihood``,
    ``gradient``, ``fisher``, ``log_prior`` and ``log_prior_gradient``.

    Attributes
    ----------
    names : list of str
        The estimated parameters.
    lower, upper : ndarray, (k,)
        Their bounds on their scales.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.names = list(problem.names)
        self.lower, self.upper = problem.lower, problem.upper

    def __call__(self, x: Point, gradient: bool = True) -> Evaluation:
        """Evaluate the log-likelihood at x, with derivatives unless `gradient` is False."""
        return self._problem._evaluated(self._problem._values(x), gradient)

    def value(self, x: Point) -> float:
        """Return the log-likelihood alone, without derivatives."""
        return self(x, gradient=False).log_likelihood

    def __repr__(self) -> str:
        return f"Objective({len(self.names)} parameters, {len(self._problem._tables.measurements)} data)"


class Problem:
    """A problem of PEtab, as returned by `load`.

    Attributes
    ----------
    name : str
        The name of its file.
    model : invariode.sbml.model.Model
        The model.
    names : list of str
        The estimated parameters.
    nominal : ndarray, (k,)
        Their nominal values, on their scales.
    lower, upper : ndarray, (k,)
        Their bounds, on their scales.
    experiments : list of Experiment
        One for each condition with data, for ``invariode.fit(problem.experiments, problem.parameters)``.
    parameters : dict of Parameter
        The estimated parameters for `invariode.fit`: bounds, scales and priors. Searches start in the middle of the
        bounds.
    """

    def __init__(self, path: str, given: Tables, method: MethodName, rtol: float, atol: float) -> None:
        self.name, self._tables = os.path.splitext(os.path.basename(path))[0], given
        self._rows = [one for one in given.parameters.values() if one.estimated]
        self.names = [one.name for one in self._rows]
        columns = {name for one in given.conditions.values() for name in one}
        self.model = Model(contents(given.model), given={*given.parameters, *columns})
        self._all = Experiments(self.model, given, method, rtol, atol)
        self.nominal = np.array([_scaled(one, one.nominal) for one in self._rows])
        self.lower = np.array([_scaled(one, one.lower) for one in self._rows])
        self.upper = np.array([_scaled(one, one.upper) for one in self._rows])

    @cached_property
    def _parts(self) -> list[Period]:
        return self._all.parts()

    @property
    def experiments(self) -> list[Experiment]:
        return [one.experiment for one in self._parts]

    @property
    def parameters(self) -> dict[str, Parameter]:
        return {one.name: _parameter(one) for one in self._rows}

    @cached_property
    def _fit(self) -> FittedModel:
        """The experiments with parameters that start at the nominal values."""
        wanted = {one.name: Parameter(start=None if math.isnan(one.nominal) else one.nominal) for one in self._rows}
        method = self._parts[0].experiment.method or "ode15s"
        return FittedModel(self.experiments, wanted, True, method, {})

    # What users call

    def objective(self) -> Objective:
        """Return the log-likelihood as a function of the estimated parameters on their scales."""
        return Objective(self)

    def simulate(self, x: Point | None = None) -> tuple[Array, Array]:
        """Simulate all data.

        Parameters
        ----------
        x : array_like of shape (k,), optional
            The estimated parameters on their scales, or a dict of their values. Default: the nominal ones.

        Returns
        -------
        simulated : ndarray, (N,)
            The observables for each row of the measurement table.
        sigma : ndarray, (N,)
            The noise there.
        """
        free, fit = self._values(self._or_nominal(x)), self._fit
        found = []
        for e, (part, simulation) in enumerate(zip(self._parts, fit.simulations, strict=True)):
            ran = simulation.run(fit.space.local(e, free).values, slopes=False)
            if isinstance(ran, Failed):
                raise RuntimeError(f"the simulation failed: {ran.reason}")
            values = np.full((2, *part.experiment.data.values.shape), np.nan)
            ends = np.cumsum([0, *(len(one.values) for one in part.experiment.series)])
            for one, first, last in zip(part.experiment.series, ends, ends[1:], strict=False):
                values[0, one.row, one.places] = ran.values[first:last]
                values[1, one.row, one.places] = 1.0 if ran.sigma is None else ran.sigma[first:last]
            found.append(values)
        count = len(self._tables.measurements)
        simulated, sigma = (numbers(self._parts, [one[i] for one in found], count) for i in range(2))
        decadic = [self._tables.observables[one.observable].scale == "log10" for one in self._tables.measurements]
        return simulated, np.where(decadic, sigma / LN10, sigma)

    def log_likelihood(self, x: Point | None = None) -> float:
        """Return the log-likelihood at x, by default at the nominal parameters."""
        return self.objective().value(self._or_nominal(x))

    def chi2(self, x: Point | None = None) -> float:
        """Return the sum of squares of the normalised residuals."""
        simulated, sigma = self.simulate(x)
        total = 0.0
        for one, h, s in zip(self._tables.measurements, simulated.tolist(), sigma.tolist(), strict=True):
            scale = self._tables.observables[one.observable].scale
            r = (one.value - h) / s if scale == "lin" else math.log(one.value / h) / (_UNITS[scale] * s)
            total += r * r
        return total

    def check(self) -> dict[str, float]:
        """Compare simulations with the problem's own simulation table, if there is one.

        Returns
        -------
        dict
            The log-likelihood at the nominal parameters, and the largest relative difference of simulations from those
            of ``simulatedData*`` beside the problem, as ``difference``; NaN without such a table.
        """
        folder = self._tables.folder
        files = sorted(one for one in os.listdir(folder or ".") if one.startswith("simulatedData"))
        simulated, _ = self.simulate()
        known = {_key(row): float(row["simulation"]) for one in files for row in rows_of(os.path.join(folder, one))}
        size = max(map(abs, known.values()), default=1.0)
        pairs = [
            (value, known[key])
            for one, value in zip(self._tables.measurements, simulated.tolist(), strict=True)
            if (key := _key_of(one)) in known
        ]
        difference = max((abs(a - b) / (abs(b) + 1e-3 * size) for a, b in pairs), default=math.nan)
        return {"log_likelihood": self.log_likelihood(), "difference": difference}

    # Evaluation

    def _or_nominal(self, x: Point | None) -> Point:
        """Return x, or the nominal point, which must have a value of each parameter."""
        if x is None and np.isnan(self.nominal).any():
            name = self.names[int(np.argmax(np.isnan(self.nominal)))]
            raise ValueError(f"the parameter {name!r} has no nominalValue: pass x, the values of all parameters")
        return self.nominal if x is None else x

    def _values(self, x: Point) -> Array:
        """Return the estimated parameters on the linear scale. A dict has them by name, on that scale already."""
        by_label = named("x", x)
        if by_label is not None:
            return real_numbers("x", in_order("x", by_label, self.names, "estimated parameters"))
        given = real_numbers("x", x)
        if given.shape != (len(self.names),):
            raise ValueError(f"x must hold the {len(self.names)} estimated parameters, got shape {given.shape}")
        return np.array([_natural(one, value) for one, value in zip(self._rows, given.tolist(), strict=True)])

    def _chain(self, free: Array) -> Array:
        """Return the derivatives of the parameters for their values on their scales."""
        return np.array([_UNITS[one.scale] * x or 1.0 for one, x in zip(self._rows, free.tolist(), strict=True)])

    def _evaluated(self, free: Array, gradient: bool) -> Evaluation:
        if not np.isfinite(free).all():
            return Evaluation(-math.inf, np.full(len(free), np.nan) if gradient else None, None, -math.inf, None)
        prior, prior_slopes = self._prior(free)
        fit, chain = self._fit, self._chain(free)
        if not gradient:
            return Evaluation(fit.value(free), None, None, prior, prior_slopes)
        at = fit.evaluate(free)
        if isinstance(at, Failed):
            return Evaluation(-math.inf, np.full(len(free), np.nan), None, prior, prior_slopes)
        rows = fit.information(at) * chain
        value = fit.log_likelihood(at, at.sigma)
        return Evaluation(value, fit.gradient(at) * chain, rows.T @ rows, prior, prior_slopes)

    def _prior(self, free: Array) -> tuple[float, Array]:
        total, slopes, chain = 0.0, np.zeros(len(free)), self._chain(free)
        for j, (one, value) in enumerate(zip(self._rows, free.tolist(), strict=True)):
            if one.prior is not None:
                found, slope, on_scale = log_density(*one.prior, value, _scaled(one, value))
                total += found
                slopes[j] = slope if on_scale else slope * chain[j]
        return total, slopes

    def __repr__(self) -> str:
        counts = f"{len(self.names)} parameters, {len(self._tables.conditions)} conditions"
        return f"Problem({self.name!r}: {counts}, {len(self._tables.measurements)} data)"


def _scaled(one: ParameterRow, value: float) -> float:
    if one.scale == "lin":
        return value
    with np.errstate(all="ignore"):
        return float(np.log(value) if one.scale == "log" else np.log10(value))


def _natural(one: ParameterRow, x: float) -> float:
    if one.scale == "lin":
        return x
    with np.errstate(over="ignore"):
        return float(np.exp(x if one.scale == "log" else x * LN10))


def _parameter(one: ParameterRow) -> Parameter:
    """Return a parameter for `invariode.fit`."""
    scale: Any = "linear" if one.scale == "lin" else "log"
    ends = _scaled(one, one.lower), _scaled(one, one.upper)
    middle = 0.5 * (ends[0] + ends[1])
    start = _natural(one, middle) if math.isfinite(middle) else one.nominal
    return Parameter(start, (one.lower, one.upper), scale, fit_prior(one))


def _key(row: Mapping[str, str]) -> tuple[str, ...]:
    condition = row.get("simulationConditionId") or row.get("conditionId") or ""
    before = row.get("preequilibrationConditionId") or ""
    parameters = (row.get("observableParameters") or "").split(";")
    return row["observableId"], before, condition, f"{float(row['time']):.9g}", *map(_plain, parameters)


def _plain(text: str) -> str:
    try:
        return f"{float(text):.9g}"
    except ValueError:
        return text.strip()


def _key_of(one: Measurement) -> tuple[str, ...]:
    parameters = [f"{x:.9g}" if isinstance(x, float) else x for x in one.observable_parameters] or [""]
    return one.observable, one.before, one.condition, f"{one.time:.9g}", *parameters


def load(
    path: str | os.PathLike[str], *, method: MethodName = "radau", rtol: float = 1e-8, atol: float = 1e-12
) -> Problem:
    """Load a problem of PEtab, version 1 or 2, with a model in SBML.

    Parameters
    ----------
    path : str or path-like
        The YAML file.
    method, rtol, atol : optional
        Of the runs.

    Returns
    -------
    Problem

    Raises
    ------
    invariode.sbml.UnsupportedError
        The model has what there are no equations for.
    ValueError
        The problem is of another version, or its tables contradict each other.
    """
    return Problem(os.fspath(path), tables(os.fspath(path)), method, rtol, atol)
