"""Simulation of an experiment: one run with its sensitivities, observed at the times of the data."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array, quietly, warn
from ..._base.failures import InvariantError
from ..._base.types import MethodName
from ..._functions.compile import compile
from ..._functions.compiled import is_native
from ..._functions.directional import Directional, Point, has_llvm
from ..._functions.layout import with_numbers
from ..._problem.events import titled
from ..._problem.invariants import AccuracyWarning
from ..._problem.options import Options
from ..._problem.parameters import ParameterName, with_values
from ..._problem.sensitivities import Sensitivities
from ..._results.messages import MESSAGES
from ..._results.solution import Solution
from ..._solve.prepared import PreparedSolver
from ..._solve.problem import Problem
from ..steady import Found, SteadyStates
from .experiment import Experiment, Series
from .failed import Failed


class Simulated(NamedTuple):
    """The model's values for the data of an experiment, series by series, and their derivatives."""

    values: Array  # (N,)
    tangent: Array  # (N, k), for the parameters of the experiment


class Curves(NamedTuple):
    """The observed quantities over time."""

    values: Array  # (m, n_t)
    tangent: Array  # (m, n_t, k)


class _Start(NamedTuple):
    """Start of a run, and the derivatives of y0 for the parameters of the runs, (n, k), if it is a steady state."""

    args: tuple[Any, ...]
    y0: Array
    slopes: Array | None


class _Runs:
    """Runs of a problem from other starts. f is traced and compiled once, if that is possible: of a Python f the
    derivatives would be traced in each run."""

    def __init__(self, problem: Problem, method: MethodName, options: Options) -> None:
        self._problem, self._method, self._options = problem, method, options
        self._compiled: PreparedSolver | None = None
        self._as_given: PreparedSolver | None = None
        if problem.sensitivities is not None and has_llvm() and not is_native(problem.fun):
            with suppress(TypeError), np.errstate(all="ignore"):  # it cannot be traced
                self._compiled = problem.replace(fun=compile(problem.fun, by="trace")).prepare(method, **options)
        if self._compiled is None:
            self._as_given = problem.prepare(method, **options)

    def __call__(self, start: _Start) -> Solution | Failed:
        """Return a run; its warnings are those of a trial, and it is the fit that they would be about. If it fails, f
        as it was given says why, also by an exception."""
        if self._compiled is not None and not isinstance(sol := self._run(self._compiled, start), Failed):
            return sol
        if self._as_given is None:
            self._as_given = self._problem.prepare(self._method, **self._options)
        return self._run(self._as_given, start)

    @staticmethod
    def _run(solver: PreparedSolver, start: _Start) -> Solution | Failed:
        try:
            with quietly(), warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore", RuntimeWarning)  # of NumPy, in functions far from their domain
                sol = solver(args=start.args, y0=start.y0)
        except InvariantError as error:
            return Failed(str(error))
        return sol if sol.success else Failed(sol.message)


class Simulation:
    """Runs of an experiment for values of its parameters.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    names : sequence of str
        Its parameters, in the order of their values.
    values : ndarray, (k,)
        Where a search starts, for the sizes of the parameters.
    method, options
        Of the runs.
    """

    def __init__(
        self, experiment: Experiment, names: Sequence[str], values: Array, method: MethodName, options: Options
    ) -> None:
        self.experiment, self._names = experiment, names
        self._method, self._options = method, options
        problem = experiment.problem
        found = [(i, one) for i, name in enumerate(names) if (one := experiment.dynamic(name)) is not None]
        self._dynamic = [one for _, one in found]
        self._places = [i for i, _ in found]
        self._sensitivities = self._wanted(values)
        self._steady = SteadyStates(problem, self._dynamic) if experiment.steady else None
        self._watch = _Watch(experiment, names, self._places, self._dynamic)
        t0, tf = problem.t_span
        self._times, self._which = _once(experiment.data.t, backwards=tf < t0)
        if not np.isfinite(tf):
            problem = experiment.ended()
        args, y0 = with_values(problem.args, problem.y0, self._dynamic, values[self._places])  # floats, not integers
        self._problem = problem.replace(args=args, y0=y0, sensitivities=self._sensitivities)
        self._runs = self._prepared(self._times)

    def _prepared(self, times: Array) -> _Runs:
        """Return the problem with output at these times, to the last of them if no events are measured."""
        t0, tf = self._problem.t_span
        if len(times) and not self.experiment.events and times[-1] != t0:
            tf = float(times[-1])
        own: Options = {"keep": "outputs", "on_failure": "return", "t_eval": times}
        return _Runs(self._problem.replace(t_span=(t0, tf)), self._method, {**self._options, **own})

    def _wanted(self, values: Array) -> Sensitivities | None:
        """Return the sensitivities of the runs to the parameters. A start at a steady state depends on the parameters
        by way of y0. The sizes are those at the start of the search, so that runs differ in nothing else."""
        problem, y0 = self.experiment.problem, self.experiment.problem.y0
        floor = np.broadcast_to(np.divide(self._options["atol"], self._options["rtol"]), y0.shape)
        names: list[str] = []
        sizes: list[float] = []
        for place, one in zip(self._places, self._dynamic, strict=True):
            if self.experiment.steady and one.kind == "y0":
                continue
            size = abs(values[place])
            names.append(one.name)
            sizes.append(max(size, floor[one.index]) if one.kind == "y0" else size)
        if self.experiment.steady:
            every = self.experiment.found("y0")
            names += [one.name for one in every]
            sizes += np.maximum(np.abs(problem.y0), floor).tolist()
        return Sensitivities(names, scale=[one or 1.0 for one in sizes]) if names else None

    def _start(self, values: Array) -> _Start | Failed:
        """Return the arguments and the initial value, and how it follows from the parameters if it is a steady
        state."""
        problem, own = self.experiment.problem, values[self._places]
        args, y0 = with_values(problem.args, problem.y0, self._dynamic, own)
        if self._steady is None:
            return _Start(args, y0, None)
        S0 = np.zeros((len(y0), len(self._dynamic)))
        for j, one in enumerate(self._dynamic):
            if one.kind == "y0":
                S0[one.index, j] = 1.0
        found = self._steady.at(args, y0, S0)
        if not isinstance(found, Found):
            return Failed(found.reason)
        if not found.stable:
            return Failed("the steady state that was found is not stable")
        if found.slopes is None or np.isnan(found.slopes).any():
            return Failed("the steady state is not isolated: others with the same totals are beside it")
        return _Start(args, found.y, found.slopes)

    def run(self, values: Array) -> Simulated | Failed:
        """Return the model's values for the data."""
        start = self._start(values)
        if isinstance(start, Failed):
            return start
        sol = self._runs(start)
        if isinstance(sol, Failed):
            return sol
        if len(sol.t) < len(self._times):
            return Failed(f"the run ended at t = {sol.t_end:.6g}, before the last datum")
        found = [np.zeros((0, 1 + len(values)))]
        curves = self._curves(sol, start, values) if len(self._times) else None
        for one in self.experiment.series:
            if curves is not None and one.row < len(curves.values):
                at = self._which[one.places]
                found.append(np.column_stack([curves.values[one.row, at], curves.tangent[one.row, at]]))
                continue
            occurrences = self._occurrences(sol, start, one, len(values))
            if isinstance(occurrences, Failed):
                return occurrences
            found.append(occurrences[one.places])
        every = np.concatenate(found)
        if not np.isfinite(every).all():
            return Failed("the model or its derivatives are not finite")
        return Simulated(every[:, 0], every[:, 1:])

    def _parameters(self, S: Array, start: _Start, k: int) -> Array:
        """Return derivatives for the parameters of the experiment, (…, k), of those that a run has, (…, k of the
        run)."""
        found = np.zeros((*S.shape[:-1], k))
        if start.slopes is None:
            found[..., self._places] = S
            return found
        own = [j for j, one in enumerate(self._dynamic) if one.kind == "args"]
        found[..., self._places] = S[..., len(own) :] @ start.slopes
        found[..., [self._places[j] for j in own]] += S[..., : len(own)]
        return found

    def _curves(self, sol: Any, start: _Start, values: Array) -> Curves:
        none = np.zeros((*sol.y.shape, 0))
        S = none if self._sensitivities is None else np.moveaxis(sol.sensitivities, 1, 2)
        return self._watch(sol.t, sol.y, self._parameters(S, start, len(values)), values)

    def _occurrences(self, sol: Any, start: _Start, one: Series, k: int) -> Array | Failed:
        """Return times of an event with their derivatives, (occurrences, 1 + k)."""
        event = [*self.experiment.events][one.row - len(self.experiment.data.values)]
        times, needed = sol.t_events[event], int(one.places[-1]) + 1
        if len(times) < needed:
            return Failed(f"{titled(one.name)} occurred {len(times)} times, and {needed} times were measured")
        none = np.zeros((len(times), 0))
        slopes = none if self._sensitivities is None else sol.sensitivities_t_events[event]
        return np.column_stack([times, self._parameters(slopes, start, k)])

    def curves(self, times: Array, values: Array) -> Curves | Failed:
        """Return the observed quantities at any times within the problem's interval, which are sorted."""
        start = self._start(values)
        once, which = _once(times, backwards=False)
        t0, tf = self.experiment.problem.t_span
        if tf < t0:
            once, which = once[::-1], len(once) - 1 - which
        if isinstance(start, Failed):
            return start
        sol = self._prepared(once)(start)
        if isinstance(sol, Failed):
            return sol
        missing = len(once) - len(sol.t)
        if missing and sol.status != MESSAGES["terminal_event"][0]:
            return Failed(f"the run ended at t = {sol.t_end:.6g}")
        found = self._curves(sol, start, values)
        behind = [(0, 0), (0, missing)]
        filled = [np.pad(one, behind + [(0, 0)] * (one.ndim - 2), constant_values=np.nan) for one in found]
        return Curves(*(one[:, which] for one in filled))

    def solution(self, values: Array) -> Solution:
        """Return a run without sensitivities, as users make it."""
        start = self._start(values)
        assert isinstance(start, _Start)  # it was, in the fit
        problem = self._problem.replace(args=start.args, y0=start.y0, sensitivities=None)
        options: Options = {"dense_output": True, **self._options}
        return problem.solve(self._method, **options)


class _Watch:
    """The observed quantities of states, with their derivatives for the parameters of an experiment."""

    def __init__(
        self, experiment: Experiment, names: Sequence[str], places: Sequence[int], dynamic: Sequence[ParameterName]
    ) -> None:
        self._observation = experiment.observation
        if self._observation.function is None:
            return
        problem = experiment.problem
        self._n = n = len(problem.y0)
        extras = self._observation.extras
        self._extra = {name: n + i for i, name in enumerate(names) if name in extras}
        if missing := [name for name, value in extras.items() if value is None and name not in self._extra]:
            raise ValueError(
                f"observe needs {missing[0]}, which has no default: add it to the parameters, or give it one"
            )
        in_args = [(n + i, one) for i, one in zip(places, dynamic, strict=True) if one.kind == "args"]

        def observed(_t: float, z: Any) -> Any:
            """Return `observe` of t and (y, parameters), so that derivatives are along both at once."""
            changes: dict[int, dict[int, Any]] = {}
            for place, one in in_args:
                changes.setdefault(one.index, {})[one.item or 0] = z[place]
            given = {**extras, **{name: z[place] for name, place in self._extra.items()}}
            return self._observation.function(_t, z[:n], *with_numbers(problem.args, changes), **given)

        start = np.concatenate([problem.y0, [experiment.value(name) or 1.0 for name in names]])
        self._derivatives = Directional(
            observed, (), (), len(start), at=Point(problem.t_span[0], start), called="observe"
        )
        if self._derivatives.how == "differences":
            warn(
                "fit: the derivatives of observe are differences, which are accurate to 1e-10 at best: it cannot be "
                "traced, and does not take complex numbers. Write it with NumPy's functions",
                AccuracyWarning,
            )

    def __call__(self, t: Array, y: Array, tangent: Array, values: Array) -> Curves:
        if self._observation.function is None:
            return Curves(y[self._observation.components], tangent[self._observation.components])
        k = len(values)
        found, slopes = [], []
        for i, time in enumerate(t.tolist()):
            z = np.concatenate([y[:, i], values])
            directions = np.hstack([tangent[:, i].T, np.eye(k)])  # of y by S, and of the parameters themselves
            found.append(self._derivatives.value(time, z))
            slopes.append(self._derivatives.columns(time, z, np.zeros(k), directions, np.zeros((k, 0))))
        return Curves(np.array(found).T, np.array(slopes).transpose(2, 0, 1))


def _once(times: Array, backwards: bool) -> tuple[Array, Array]:
    """Return different times in the direction of integration, and which of them each is."""
    once, which = np.unique(times, return_inverse=True)
    return (once[::-1].copy(), len(once) - 1 - which) if backwards else (once, which)
