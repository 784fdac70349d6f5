"""Problems of PEtab: simulations, log-likelihoods and gradients."""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, real_numbers
from .._base.types import MethodName
from .._functions.graph.arrays import ArrayFunction
from .._functions.graph.derivatives import jacobian
from .._functions.graph.nodes import Node
from ..sbml.equations import used
from ..sbml.expressions import Translator, parse
from ..sbml.model import Model
from ..sbml.reading import contents
from .conditions import Conditions, RunFailedError
from .fitting import Fit, from_all
from .likelihood import LN10, Evaluation, Terms, log_density, terms
from .tables import Measurement, ParameterRow, Tables, rows_of, tables

#: Relative increments of parameters where derivatives are differences, as in models with events.
_INCREMENT = 1e-5


class _Group(NamedTuple):
    """Data of one observable with the same placeholders in one condition."""

    observable: str
    rows: list[int]  # numbers of the data
    places: Array  # of their times among those of the condition
    data: Array


class _Observation:
    """An observable and its noise with placeholders filled in, and their derivatives."""

    def __init__(self, simulated: Node, sigma: Node) -> None:
        graph = simulated.graph
        both = [simulated, sigma]
        self.states, self.numbers = sorted(used(both, "y")), sorted(used(both, "p"))
        rows = jacobian(both, [*map(graph.y, self.states), *map(graph.p, self.numbers)])
        zero = graph.node(0.0)
        count = len(self.states) + len(self.numbers)
        self._values = ArrayFunction(both)
        self._slopes = ArrayFunction([row.get(j, zero) for row in rows for j in range(count)])

    def values(self, t: Array, y: Array, p: Array) -> tuple[Array, Array]:
        """Return the simulation and sigma at these times."""
        simulated, sigma = self._values.over(t, y, p)
        return simulated, sigma

    def slopes(self, t: Array, y: Array, S: Array, p: Array, sources: Mapping[int, int]) -> tuple[Array, Array]:
        """Return the derivatives of the simulation and of sigma for the parameters, (k, m) each."""
        found = self._slopes.over(t, y, p).reshape(2, len(self.states) + len(self.numbers), len(t))
        made = np.einsum("vim,ikm->vkm", found[:, : len(self.states)], S[self.states])
        for row, i in enumerate(self.numbers, len(self.states)):
            if i in sources:
                made[:, sources[i]] += found[:, row]
        return made[0], made[1]


class Objective:
    """The log-likelihood of a problem of PEtab, as returned by `Problem.objective`.

    ``o(x)`` evaluates it with its gradient at x, (k,): the estimated parameters on their scales, in the order of
    `names`. The result has ``log_likelihood``, ``gradient``, ``fisher``, ``log_prior`` and ``log_prior_gradient``.

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

    def __call__(self, x: ArrayLike, gradient: bool = True) -> Evaluation:
        """Evaluate the log-likelihood at x, with derivatives unless `gradient` is False."""
        return self._problem._evaluated(self._problem._values(x), gradient)

    def value(self, x: ArrayLike) -> float:
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
    parameters : dict of ParameterRow
        All parameters: nominal values, bounds and scales.
    """

    def __init__(self, path: str, given: Tables, method: MethodName, rtol: float, atol: float) -> None:
        self.name, self._tables = os.path.splitext(os.path.basename(path))[0], given
        self.parameters: dict[str, ParameterRow] = given.parameters
        every = list(given.parameters)
        self._estimated = [i for i, one in enumerate(given.parameters.values()) if one.estimated]
        self.names = [every[i] for i in self._estimated]
        columns = {name for one in given.conditions.values() for name in one}
        read = contents(given.model)
        self.model = Model(read, given={*every, *columns})
        self._conditions = Conditions(self.model, every, self._estimated, given.conditions, method, rtol, atol)
        rows = [given.parameters[name] for name in self.names]
        self.nominal = np.array([_scaled(one, one.nominal) for one in rows])
        self.lower = np.array([_scaled(one, one.lower) for one in rows])
        self.upper = np.array([_scaled(one, one.upper) for one in rows])
        self._observations: dict[Any, _Observation] = {}
        self._require_known()

    def _require_known(self) -> None:
        for one in self._tables.measurements:
            if one.observable not in self._tables.observables:
                raise ValueError(f"a measurement is of {one.observable!r}, which is no observable")
            for name in (one.condition, one.before):
                if name and name not in self._tables.conditions:
                    raise ValueError(f"a measurement is of condition {name!r}, which does not exist")

    # What users call

    def objective(self) -> Objective:
        """Return the log-likelihood as a function of the estimated parameters on their scales."""
        return Objective(self)

    def simulate(self, x: ArrayLike | None = None) -> tuple[Array, Array]:
        """Simulate all data.

        Parameters
        ----------
        x : array_like of shape (k,), optional
            The estimated parameters on their scales. Default: the nominal ones.

        Returns
        -------
        simulated : ndarray, (N,)
            The observables for each row of the measurement table.
        sigma : ndarray, (N,)
            The noise there.
        """
        theta = self._values(self.nominal if x is None else x)
        simulated, sigma = np.empty((2, len(self._tables.measurements)))
        for _, _, _, groups in self._courses(theta, slopes=False):
            for group, observation, start, states, _ in groups:
                t, y = self._at(group, states)
                simulated[group.rows], sigma[group.rows] = observation.values(t, y, start.p)
        return simulated, sigma

    def log_likelihood(self, x: ArrayLike | None = None) -> float:
        """Return the log-likelihood at x, by default at the nominal parameters."""
        return self.objective().value(self.nominal if x is None else x)

    def chi2(self, x: ArrayLike | None = None) -> float:
        """Return the sum of squares of the normalised residuals."""
        simulated, sigma = self.simulate(x)
        total = 0.0
        for name, one in self._tables.observables.items():
            rows = [i for i, m in enumerate(self._tables.measurements) if m.observable == name]
            data = np.array([self._tables.measurements[i].value for i in rows])
            total += float(terms(data, simulated[rows], sigma[rows], one.scale, one.laplace).chi2.sum())
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

    def starts(self, count: int, seed: int = 0) -> Array:
        """Return starting points on the parameters' scales, (count, k), that fill the bounds: a Latin hypercube."""
        rng = np.random.default_rng(seed)
        k = len(self.names)
        part = np.array([(rng.permutation(count) + rng.random(count)) / count for _ in range(k)]).T.reshape(count, k)
        return np.asarray(self.lower + part * (self.upper - self.lower))

    def fit(self, starts: int | ArrayLike = 20, *, seed: int = 0, most: int = 300) -> Fit:
        """Find the parameters with the largest likelihood, or posterior density if there are priors.

        From each start a trust-region method with exact gradients and the Fisher information climbs to a maximum
        within the bounds.

        Parameters
        ----------
        starts : int or array_like of shape (count, k), default 20
            The number of starting points, of a Latin hypercube on the parameters' scales; or these points.
        seed : int, default 0
            Of the Latin hypercube.
        most : int, default 300
            Evaluations from each start.

        Returns
        -------
        Fit
            The best parameters, and the ends of all searches.

        Raises
        ------
        RuntimeError
            No start can be evaluated.
        """
        points = self.starts(starts, seed) if isinstance(starts, int) else real_numbers("starts", starts)
        found = sorted(
            from_all(self.objective(), np.atleast_2d(points), self.lower, self.upper, most),
            key=lambda one: -one.log_likelihood,
        )
        best = found[0]
        if not math.isfinite(best.log_likelihood):
            raise RuntimeError("no start can be evaluated: the runs fail there")
        theta = self._values(best.x)
        values = {name: float(theta[i]) for name, i in zip(self.names, self._estimated, strict=True)}
        return Fit(best.x, values, best.log_likelihood, found)

    # Evaluation

    def _values(self, x: ArrayLike) -> Array:
        """Return all parameters on the linear scale."""
        given = real_numbers("x", x)
        if given.shape != (len(self.names),):
            raise ValueError(f"x must hold the {len(self.names)} estimated parameters, got shape {given.shape}")
        theta = np.array([one.nominal for one in self.parameters.values()])
        for place, value in zip(self._estimated, given.tolist(), strict=True):
            scale = [*self.parameters.values()][place].scale
            theta[place] = value if scale == "lin" else math.exp(value if scale == "log" else value * LN10)
        return theta

    def _chain(self, theta: Array) -> Array:
        """Return dθ/dx of the estimated parameters."""
        rows = [*self.parameters.values()]
        unit = {"lin": 0.0, "log": 1.0, "log10": LN10}
        return np.array([unit[rows[i].scale] * theta[i] if rows[i].scale != "lin" else 1.0 for i in self._estimated])

    def _evaluated(self, theta: Array, gradient: bool) -> Evaluation:
        k = len(self.names)
        prior, prior_slopes = self._prior(theta)
        by_differences = gradient and bool(self.model.events)
        value, G, F = 0.0, np.zeros(k), np.zeros((k, k))
        try:
            for *_, groups in self._courses(theta, slopes=gradient and not by_differences):
                for group, observation, start, states, slopes in groups:
                    t, y = self._at(group, states)
                    simulated, sigma = observation.values(t, y, start.p)
                    found = self._terms(group, simulated, sigma)
                    value += float(found.value.sum())
                    if slopes is None:
                        continue
                    dh, ds = observation.slopes(t, y, slopes[:, :, group.places], start.p, start.sources)
                    G += dh @ found.of_simulation + ds @ found.of_sigma
                    F += (dh * found.about_simulation) @ dh.T + (ds * found.about_sigma) @ ds.T
        except RunFailedError:
            value = math.nan
        chain = self._chain(theta)
        if math.isnan(value):
            none = np.full(k, np.nan) if gradient else None
            return Evaluation(-math.inf, none, None, prior, prior_slopes)
        if by_differences:
            return Evaluation(value, self._differences(theta) * chain, None, prior, prior_slopes)
        if not gradient:
            return Evaluation(value, None, None, prior, prior_slopes)
        return Evaluation(value, G * chain, F * np.outer(chain, chain), prior, prior_slopes)

    def _differences(self, theta: Array) -> Array:
        """Return the gradient by central differences, of models whose events have no derivatives."""
        found = np.zeros(len(self.names))
        for j, place in enumerate(self._estimated):
            h = _INCREMENT * (abs(theta[place]) or 1.0)
            ends = []
            for sign in (1, -1):
                other = theta.copy()
                other[place] += sign * h
                ends.append(self._evaluated(other, gradient=False).log_likelihood)
            found[j] = (ends[0] - ends[1]) / (2 * h)
        return found

    def _prior(self, theta: Array) -> tuple[float, Array]:
        total, slopes = 0.0, np.zeros(len(self.names))
        chain = self._chain(theta)
        for j, (name, place) in enumerate(zip(self.names, self._estimated, strict=True)):
            one = self.parameters[name]
            if one.prior is not None:
                value = float(theta[place])
                found, slope, on_scale = log_density(*one.prior, value, _scaled(one, value))
                total += found
                slopes[j] = slope if on_scale else slope * chain[j]
        return total, slopes

    def _terms(self, group: _Group, simulated: Array, sigma: Array) -> Terms:
        one = self._tables.observables[group.observable]
        return terms(group.data, simulated, sigma, one.scale, one.laplace)

    def _at(self, group: _Group, states: tuple[Array, Array]) -> tuple[Array, Array]:
        times, y = states
        return times[group.places], y[:, group.places]

    def _courses(self, theta: Array, slopes: bool) -> Any:
        """Yield the groups with the run of each condition that has data."""
        for (before, condition), (times, groups) in self._by_condition.items():
            start = self._conditions.start(before, condition, theta, slopes)
            course = self._conditions.course(start, times, slopes)
            made = [
                (group, observation, start, (times, course.states), course.slopes if slopes else None)
                for group, observation in groups
            ]
            yield before, condition, times, made

    @cached_property
    def _by_condition(self) -> dict[tuple[str, str], tuple[Array, list[tuple[_Group, _Observation]]]]:
        rows: dict[tuple[str, str], list[int]] = defaultdict(list)
        for i, one in enumerate(self._tables.measurements):
            rows[one.before, one.condition].append(i)
        found = {}
        for key, numbers in rows.items():
            times = np.unique([self._tables.measurements[i].time for i in numbers])
            parts: dict[Any, list[int]] = defaultdict(list)
            for i in numbers:
                one = self._tables.measurements[i]
                parts[one.observable, one.observable_parameters, one.noise_parameters].append(i)
            groups = []
            for own, members in parts.items():
                data = np.array([self._tables.measurements[i].value for i in members])
                places = np.searchsorted(times, [self._tables.measurements[i].time for i in members])
                groups.append((_Group(own[0], members, places, data), self._observation(*own)))
            found[key] = times, groups
        return found

    def _observation(
        self, name: str, observable_parameters: tuple[Any, ...], noise_parameters: tuple[Any, ...]
    ) -> _Observation:
        key = name, observable_parameters, noise_parameters
        if key not in self._observations:
            one = self._tables.observables[name]
            fixed = {f"observableParameter{i}_{name}": v for i, v in enumerate(observable_parameters, 1)}
            fixed |= {f"noiseParameter{i}_{name}": v for i, v in enumerate(noise_parameters, 1)}
            words = self._translator(fixed)
            self._observations[key] = _Observation(words.number(parse(one.formula)), words.number(parse(one.noise)))
        return self._observations[key]

    def _translator(self, fixed: Mapping[str, str | float]) -> Translator:
        """Return formulas of observables: symbols of the model, parameters, other observables, and placeholders."""
        e = self.model._equations
        first, every = self._conditions.first, list(self.parameters)

        def value(name: str) -> Node:
            if name in fixed:
                given = fixed[name]
                return value(given) if isinstance(given, str) else e.graph.node(given)
            if name in e.symbols:
                return e.value(name)
            if name in self.parameters:
                return e.graph.p(first + every.index(name))
            if name in self._tables.observables:
                return self._translator(fixed).number(parse(self._tables.observables[name].formula))
            raise ValueError(f"a formula uses {name!r}, which is neither in the model nor a parameter")

        return Translator(e.graph, value, e.rate, e.graph.t)

    def __repr__(self) -> str:
        counts = f"{len(self.names)} parameters, {len(self._tables.conditions)} conditions"
        return f"Problem({self.name!r}: {counts}, {len(self._tables.measurements)} data)"


def _scaled(one: ParameterRow, value: float) -> float:
    if one.scale == "lin":
        return value
    with np.errstate(all="ignore"):
        return float(np.log(value) if one.scale == "log" else np.log10(value))


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
    path: str | os.PathLike[str], *, method: MethodName = "ode15s", rtol: float = 1e-8, atol: float = 1e-12
) -> Problem:
    """Load a problem of PEtab, version 1, with a model in SBML.

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
