"""What the model says of an experiment: one run with its sensitivities, observed at the times of the data."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array, quietly
from ..._base.failures import InvariantError
from ..._base.types import MethodName
from ..._functions.directional import Directional, Point
from ..._functions.layout import with_numbers
from ..._problem.options import Options
from ..._problem.parameters import ParameterName, with_values
from ..._results.solution import Solution
from .experiment import Experiment


class Simulated(NamedTuple):
    """The model's values for the data of an experiment, series by series, and their derivatives."""

    values: Array  # (N,)
    tangent: Array  # (N, k), for the parameters of the experiment


class Failed(NamedTuple):
    """A run that does not tell what the model says."""

    reason: str


class Curves(NamedTuple):
    """The observed quantities over time."""

    values: Array  # (m, n_t)
    tangent: Array  # (m, n_t, k)


class Simulation:
    """Runs of an experiment for values of its parameters.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    names : sequence of str
        Its parameters, in the order of their values.
    method, options
        Of the runs.
    """

    def __init__(self, experiment: Experiment, names: Sequence[str], method: MethodName, options: Options) -> None:
        self.experiment, self._names = experiment, names
        self._method, self._options = method, options
        problem = experiment.problem
        found = [(i, one) for i, name in enumerate(names) if (one := experiment.dynamic(name)) is not None]
        self._dynamic = [one for _, one in found]
        self._places = [i for i, _ in found]
        self._watch = _Watch(experiment, names, self._places, self._dynamic)
        t0, tf = problem.t_span
        self._times, self._which = _once(experiment.data.t, backwards=tf < t0)
        if len(self._times) and not experiment.events and self._times[-1] != t0:
            problem = problem.replace(t_span=(t0, self._times[-1]))  # nothing is known of what comes later
        self._problem = problem
        self._solver = self._prepared(problem, self._times)

    def _prepared(self, problem: Any, times: Array) -> Any:
        own: Any = {"keep": "outputs", "on_failure": "return", "t_eval": times}
        if self._dynamic:
            problem = problem.replace(sensitivities=[one.name for one in self._dynamic])
        return problem.prepare(self._method, **{**self._options, **own})

    def _changed(self, values: Array) -> tuple[tuple[Any, ...], Array]:
        problem = self.experiment.problem
        return with_values(problem.args, problem.y0, self._dynamic, values[self._places])

    def run(self, values: Array) -> Simulated | Failed:
        """The model's values for the data."""
        args, y0 = self._changed(values)
        sol = self._solution(self._solver, args, y0)
        if isinstance(sol, Failed):
            return sol
        if len(sol.t) < len(self._times):
            return Failed(f"the run ended at t = {sol.t_end:.6g}, before the last datum")
        found = [np.zeros((0, 1 + len(values)))]
        curves = self._curves(sol, values) if len(self._times) else None
        for one in self.experiment.series:
            if curves is not None and one.row < len(curves.values):
                at = self._which[one.places]
                found.append(np.column_stack([curves.values[one.row, at], curves.tangent[one.row, at]]))
                continue
            occurrences = self._occurrences(sol, one.row, one.name, int(one.places[-1]), len(values))
            if isinstance(occurrences, Failed):
                return occurrences
            found.append(occurrences[one.places])
        every = np.concatenate(found)
        if not np.isfinite(every).all():
            return Failed("the model or its derivatives are not finite")
        return Simulated(every[:, 0], every[:, 1:])

    def _solution(self, solver: Any, args: tuple[Any, ...], y0: Array) -> Solution | Failed:
        """A run; its warnings are those of a trial, and it is the fit that they would be about."""
        try:
            with quietly(), warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore", RuntimeWarning)  # of NumPy, in functions far from their domain
                sol: Solution = solver(args=args, y0=y0)
        except InvariantError as error:
            return Failed(str(error))
        return sol if sol.success else Failed(sol.message)

    def _curves(self, sol: Any, values: Array) -> Curves:
        tangent = np.zeros((*sol.y.shape, len(values)))
        if self._dynamic:
            tangent[:, :, self._places] = np.moveaxis(sol.sensitivities, 1, 2)
        return self._watch(sol.t, sol.y, tangent, values)

    def _occurrences(self, sol: Any, row: int, name: str, last: int, k: int) -> Array | Failed:
        """Times of an event with their derivatives, (occurrences, 1 + k)."""
        event = [*self.experiment.events][row - len(self.experiment.data.values)]
        times = sol.t_events[event]
        if len(times) <= last:
            return Failed(f"event {name} occurred {len(times)} times, and {last + 1} times were measured")
        tangent = np.zeros((len(times), k))
        if self._dynamic:
            tangent[:, self._places] = sol.sensitivities_t_events[event]
        return np.column_stack([times, tangent])

    def curves(self, times: Array, values: Array) -> Curves | Failed:
        """The observed quantities at any times within the problem's interval, which are sorted."""
        args, y0 = self._changed(values)
        once, which = _once(times, backwards=False)
        t0, tf = self.experiment.problem.t_span
        if tf < t0:
            once, which = once[::-1], len(once) - 1 - which
        sol = self._solution(self._prepared(self.experiment.problem, once), args, y0)
        if isinstance(sol, Failed):
            return sol
        if len(sol.t) < len(once):
            return Failed(f"the run ended at t = {sol.t_end:.6g}")
        found = self._curves(sol, values)
        return Curves(found.values[:, which], found.tangent[:, which])

    def solution(self, values: Array) -> Solution:
        """A run without sensitivities, as users make it."""
        args, y0 = self._changed(values)
        problem = self.experiment.problem.replace(args=args, y0=y0)
        return problem.solve(self._method, **{"dense_output": True, **self._options})


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
            """`observe` of t and (y, parameters), so that derivatives are along both at once."""
            changes: dict[int, dict[int, Any]] = {}
            for place, one in in_args:
                changes.setdefault(one.index, {})[one.item or 0] = z[place]
            given = {**extras, **{name: z[place] for name, place in self._extra.items()}}
            return self._observation.function(_t, z[:n], *with_numbers(problem.args, changes), **given)

        start = np.concatenate([problem.y0, [experiment.value(name) or 1.0 for name in names]])
        self._derivatives = Directional(
            observed, (), (), len(start), at=Point(problem.t_span[0], start), called="observe"
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
    """Different times in the direction of integration, and which of them each is."""
    once, which = np.unique(times, return_inverse=True)
    return (once[::-1].copy(), len(once) - 1 - which) if backwards else (once, which)
