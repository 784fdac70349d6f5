"""Simulation of an experiment: one run with its sensitivities, observed at the times of the data."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array, quietly
from ..._base.failures import InvariantError
from ..._base.forks import cached_property
from ..._base.latest import Latest
from ..._base.types import MethodName
from ..._functions.compile import compile
from ..._functions.compiled import is_native
from ..._functions.derivatives import has_llvm
from ..._functions.graph.nodes import in_order
from ..._functions.graph.python import Formula
from ..._functions.layout import layout_of, place_of
from ..._functions.with_arguments import Point
from ..._problem.events import titled
from ..._problem.options import Options
from ..._problem.parameters import ParameterName, with_values
from ..._problem.problem import Problem
from ..._problem.sensitivities import Sensitivities
from ..._results.messages import MESSAGES
from ..._results.solution import Solution
from ..._solve.prepared_solver import PreparedSolver
from ..steady import Found, NotFound, SteadyStates
from .experiment import Experiment, Failed, Series
from .observed import Curves, ParameterPlaces, Through


class Simulated(NamedTuple):
    """The model's values for the data of an experiment, series by series, and their derivatives."""

    values: Array  # (N,): the values
    #: (N, k): their derivatives for the parameters of the experiment; without columns if these were not wanted
    tangent: Array
    #: sigma, sigma_tangent, (N,) and (N, k): the same of sigma, if it is a function
    sigma: Array | None = None
    sigma_tangent: Array | None = None


class _RunStart(NamedTuple):
    """Start of a run: arguments, initial value, and its derivatives for the parameters of the experiment, (n, k); None
    if these are not wanted."""

    args: tuple[Any, ...]
    y0: Array
    slopes: Array | None


class _Runs:
    """Runs of a problem from other starts. f is traced and compiled once, if that is possible: of a Python f the
    derivatives would be traced in each run."""

    def __init__(self, problem: Problem, method: MethodName, options: Options) -> None:
        self._method, self._options = method, options
        self._problems = [problem]
        self._solvers: Latest[Problem, PreparedSolver] = Latest()
        if problem.sensitivities is not None and has_llvm() and not is_native(problem.fun):
            with suppress(TypeError), np.errstate(all="ignore"):  # it cannot be traced
                self._problems.insert(0, problem.replace(fun=compile(problem.fun, by="trace")))

    def __call__(self, start: _RunStart, dy0dp: Array | None) -> Solution | Failed:
        """Return a run; its warnings are those of a trial, and it is the fit that they would be about. If it fails, f
        as it was given says why, also by an exception. `dy0dp`: ∂y0/∂p for the run's sensitivities."""
        *compiled, given = self._problems
        for problem in compiled:
            with suppress(TypeError):  # the compiled f cannot be used
                if not isinstance(found := self._run(problem, start, dy0dp), Failed):
                    return found
        return self._run(given, start, dy0dp)

    def _run(self, problem: Problem, start: _RunStart, dy0dp: Array | None) -> Solution | Failed:
        solver = self._solvers.get(problem)
        try:
            with quietly(), nullcontext() if solver is not None and solver.native else _without_warnings_of_numpy():
                if solver is None:
                    solver = self._solvers[problem] = problem.prepare(self._method, **self._options)
                sol = solver(args=start.args, y0=start.y0, dy0dp=dy0dp)
        except InvariantError as error:
            return Failed(str(error))
        return sol if sol["success"] else Failed(sol.message)


@contextmanager
def _without_warnings_of_numpy() -> Iterator[None]:
    """Suppress the warnings of functions far from their domain."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


class Simulation:
    """Runs of an experiment for values of its parameters.

    - `experiment`: the experiment
    - `names`: its parameters, in the order of their values
    - `values`, (k,): where a search starts, for the sizes of the parameters
    - `method`, `options`: of the runs
    - `states`: steady states that are known, which experiments share
    """

    def __init__(
        self,
        experiment: Experiment,
        names: Sequence[str],
        values: Array,
        method: MethodName,
        options: Options,
        states: dict[Any, _KnownStates],
    ) -> None:
        self.experiment, self._names = experiment, names
        self._method, self._options, self._states = experiment.method or method, options, states
        problem, k = experiment.problem, len(names)
        #: Numbers that parameters set, in the run and in the pre-equilibration.
        self._own = ParameterPlaces(
            names, [(j, one) for j in range(k) for one in experiment.entries(names[j])], problem.args
        )
        self._before: ParameterPlaces | None = None
        if experiment.before is not None:
            entries = [(j, one) for j in range(k) for one in experiment.entries_before(names[j])]
            self._before = ParameterPlaces(names, entries, experiment.before.problem.args)
        t0, tf = problem.t_span
        at, n = Point(t0, problem.y0), len(problem.y0)
        start = _guesses(experiment, names, values)
        self._first = None
        if experiment.start is not None:
            self._first = Through([experiment.start], [{}], self._own, at, start, "y0")
            if (size := len(self._first(np.array([t0]), problem.y0[:, None], None, start, problem.args).values)) != n:
                raise ValueError(f"y0 returns {size} initial values, and the problem has {n} components")
        self._watch = _watch(experiment, self._own, at, start)
        finite = experiment.data.t[np.isfinite(experiment.data.t)]
        self._times, self._which = _once(finite, backwards=tf < t0)
        of_events = len(experiment.data.values)
        observed = [one for one in experiment.series if one.row < of_events]
        #: The quantity and the time of each datum but the times of events, which come last.
        self._rows = np.array([one.row for one in observed for _ in one.places], dtype=int)
        self._places = np.array([place for one in observed for place in one.places], dtype=int)
        self._events = [one for one in experiment.series if one.row >= of_events]
        #: Of data that are components of y at finite times: their components and outputs.
        self._direct: tuple[Array, Array] | None = None
        if self._watch is None and len(finite) == len(experiment.data.t):
            components = np.array(experiment.observation.components, dtype=int)
            self._direct = components[self._rows], self._which[self._places]
        #: Columns of the derivatives of runs: numbers in args, each with its parameter, or initial values.
        self._columns = self._moving()
        #: Parameters in args on which the initial value may depend, and whether the columns are all parameters.
        self._starting = [j for j, one in self._columns if one.kind == "args"] if self._moves_start else []
        self._complete = [j for j, _ in self._columns] == [*range(k)]
        if not np.isfinite(tf):
            problem = experiment.ended() if np.isfinite(experiment.last) else problem.replace(t_span=(t0, t0 + 1.0))
        args, y0 = self._values(self._own, problem, values)  # floats, not integers
        self._problem = problem.replace(args=args, y0=y0, sensitivities=None)
        self._sizes = self._scale(values)
        self._prepared: Latest[tuple[bool, bytes], _Runs] = Latest()

    # Derivatives

    def _moving(self) -> list[tuple[int, ParameterName]]:
        """Return the numbers for which runs have derivatives, each with its parameter: those that f may use; of a
        parameter that acts by way of the initial value alone, one that f does not use, or all initial values (-1)."""
        problem = self.experiment.problem
        found = _in_use(self._own, _used(problem))
        if not self._moves_start:
            return found + [(j, one) for j, one in self._own.entries if one.kind == "y0"]
        starts = self._of_start() - {j for j, _ in found}
        others = dict[int, ParameterName]()
        for j, one in _in_use(self._own, None):
            if j in starts:
                others.setdefault(j, one)
        found += [*others.items()]
        if starts - others.keys():
            found += [(-1, ParameterName(f"y0[{i}]", "y0", i)) for i in range(len(problem.y0))]
        return found

    def _of_start(self) -> set[int]:
        """Return the parameters on which the initial value may depend."""
        found = {j for j, one in self._own.entries if one.kind == "y0"}
        first = _used_by(self.experiment.start) if self.experiment.start is not None else set()
        found |= {j for j, _ in _in_use(self._own, first)}
        if self._before is not None and self.experiment.before is not None:
            uses = _used(self.experiment.before.problem)
            found |= {j for j, _ in _in_use(self._before, None if uses is None or first is None else uses | first)}
            found |= {j for j, one in self._before.entries if one.kind == "y0"}
        return found

    @property
    def _moves_start(self) -> bool:
        """True if the initial value is not only that of the problem with some of its components as parameters."""
        return self._first is not None or self._before is not None or len(self._by_start()) > 0

    def _by_start(self) -> set[int]:
        """Return the parameters that set initial values and other numbers too."""
        starts = [j for j, one in self._own.entries if one.kind == "y0"]
        return {j for j in starts if [i for i, _ in self._own.entries].count(j) > 1}

    def _scale(self, values: Array) -> list[float]:
        """Return the sizes of the parameters of the runs: those at the start of the search, so that runs differ in
        nothing else."""
        y0 = self.experiment.problem.y0
        floor = np.broadcast_to(np.divide(self._options["atol"], self._options["rtol"]), y0.shape)
        sizes = []
        for j, one in self._columns:
            size = abs(y0[one.index]) if j < 0 else abs(values[j])
            sizes.append(float(max(size, floor[one.index]) if one.kind == "y0" else size) or 1.0)
        return sizes

    def _slopes_of_start(self, start: _RunStart) -> Array | None:
        """Return the derivatives of the initial value for the numbers in args that a run has sensitivities for; None:
        they are zero, or not wanted."""
        return _of_first(self._starting, start.slopes) if start.slopes is not None and self._starting else None

    def _parameters(self, S: Array, start: _RunStart, k: int) -> Array:
        """Return derivatives for the parameters of the experiment, (…, k), of those that a run has, (…, columns)."""
        assert start.slopes is not None
        if self._complete:
            return S
        chain = np.zeros((len(self._columns), k))
        own = {j for j, _ in self._columns}
        rest = [j for j in range(k) if j not in own]
        for column, (j, one) in enumerate(self._columns):
            if j >= 0:
                chain[column, j] = 1.0
            else:
                chain[column, rest] = start.slopes[one.index, rest]
        return np.asarray(S @ chain)

    # The start

    @staticmethod
    def _values(settings: ParameterPlaces, problem: Problem, values: Array) -> tuple[tuple[Any, ...], Array]:
        numbers = values.tolist()
        entries = settings.entries
        return with_values(problem.args, problem.y0, [one for _, one in entries], [numbers[j] for j, _ in entries])

    def _start(self, values: Array, slopes: bool) -> _RunStart | Failed:
        """Return the start of a run, after the pre-equilibration if there is one."""
        begun = self._begun(self._own, self.experiment.problem, values, slopes)
        if self._before is None or self.experiment.before is None:
            return begun
        problem = self.experiment.before.problem
        rest = self._at_rest(self._before, problem, self._begun(self._before, problem, values, slopes))
        if isinstance(rest, Failed):
            return rest
        again = self.experiment.resets
        rest.y0[again] = begun.y0[again]
        if rest.slopes is not None and begun.slopes is not None:
            rest.slopes[again] = begun.slopes[again]
        return _RunStart(begun.args, rest.y0, rest.slopes)

    def _begun(self, settings: ParameterPlaces, problem: Problem, values: Array, slopes: bool) -> _RunStart:
        """Return the initial values with these settings."""
        args, y0 = self._values(settings, problem, values)
        S = None
        if slopes:
            S = np.zeros((len(y0), len(values)))
            for j, one in settings.entries:
                if one.kind == "y0":
                    S[one.index, j] = 1.0
        if self._first is None:
            return _RunStart(args, y0, S)
        first = self._first if settings is self._own else self._first_before
        found = first(np.array(problem.t_span[:1]), y0[:, None], None if S is None else S[:, None], values, args)
        start = _RunStart(
            args, found.values[:, 0].copy(), None if found.tangent is None else found.tangent[:, 0].copy()
        )
        for j, one in settings.entries if self.experiment.starts_as_problem else ():
            if one.kind == "y0":
                start.y0[one.index] = y0[one.index]
                if start.slopes is not None:
                    start.slopes[one.index] = np.arange(len(values)) == j
        return start

    @cached_property
    def _first_before(self) -> Through:
        """The function of the initial values in the pre-equilibration."""
        assert self._before is not None
        assert self.experiment.before is not None
        problem = self.experiment.before.problem
        guesses = _guesses(self.experiment, self._names, np.ones(len(self._names)))
        at = Point(problem.t_span[0], problem.y0)
        return Through([self.experiment.start], [{}], self._before, at, guesses, "y0")

    def _at_rest(self, settings: ParameterPlaces, problem: Problem, start: _RunStart) -> _RunStart | Failed:
        """Return the steady state to which a start leads, with its derivatives."""
        columns = _in_use(settings, _used(problem))
        there = {j for j, _ in columns}
        k = 0 if start.slopes is None else start.slopes.shape[1]
        columns += [(j, ParameterName("", "y0", 0)) for j in range(k) if j not in there]  # by way of y0 alone
        key = (id(problem.fun), id(problem.matrices.mass), problem.t_span[0], tuple(one for _, one in columns))
        if key not in self._states:
            self._states[key] = _KnownStates(SteadyStates(problem, [one for _, one in columns], "ode15s"))
        S0 = None if start.slopes is None else _of_first([j for j, _ in columns], start.slopes)
        found = self._states[key].at(start.args, start.y0, S0)
        if not isinstance(found, Found):
            return Failed(found.reason)
        if not found.stable:
            return Failed("the steady state that was found is not stable")
        if S0 is None:
            return _RunStart(start.args, found.y.copy(), None)
        if found.slopes is None or np.isnan(found.slopes).any():
            return Failed("the steady state is not isolated: others with the same totals are beside it")
        S = np.zeros((len(start.y0), k))
        for column, (j, _) in enumerate(columns):
            S[:, j] += found.slopes[:, column]
        return _RunStart(start.args, found.y.copy(), S)

    # Runs

    def _runs(self, times: Array, start: _RunStart) -> Solution | Failed:
        """Return a run with output at these times, to the last of them if no events are measured."""
        slopes = start.slopes is not None
        key = slopes, times.tobytes()
        if key not in self._prepared:
            t0, tf = self._problem.t_span
            if len(times) and not self.experiment.events and times[-1] != t0:
                tf = float(times[-1])
            own: Options = {"keep": "outputs", "on_failure": "return", "t_eval": times}
            names: Any = [one for _, one in self._columns] if slopes else []
            wanted = Sensitivities(names, scale=self._sizes) if names else None
            problem = self._problem.replace(t_span=(t0, tf), sensitivities=wanted)
            self._prepared[key] = _Runs(problem, self._method, {**self._options, **own})
        return self._prepared[key](start, self._slopes_of_start(start))

    def run(self, values: Array, slopes: bool = True) -> Simulated | Failed:
        """Return the model's values for the data."""
        start = self._start(values, slopes)
        if isinstance(start, Failed):
            return start
        experiment = self.experiment
        sol: Any = None
        if experiment.events or (len(self._times) and self._times[-1] != experiment.problem.t_span[0]):
            sol = self._runs(self._times, start)
            if isinstance(sol, Failed):
                return sol
            if len(sol["t"]) < len(self._times):
                return Failed(f"the run ended at t = {sol.t_end:.6g}, before the last datum")
        k = len(values) if slopes else 0
        curves: _ObservedCurves | Failed | None = None
        if sol is not None and self._direct is not None:
            every = self._components(sol, start, k)
        elif len(experiment.data.t) == 0:
            every = np.zeros((0, 1 + k))
        else:
            curves = self._all_curves(sol, start, values)
            if isinstance(curves, Failed):
                return curves
            every = curves.at(self._rows, self._places)
        for one in self._events:
            occurrences = self._occurrences(sol, start, one, k)
            if isinstance(occurrences, Failed):
                return occurrences
            every = np.concatenate([every, occurrences[one.places]])
        if not np.isfinite(every).all():
            return Failed("the model or its derivatives are not finite")
        if experiment.sigma_function is None:
            return Simulated(every[:, 0], every[:, 1:])
        sigma = np.eye(1, 1 + k).repeat(len(every), axis=0)
        if isinstance(curves, _ObservedCurves):
            sigma[: len(self._rows)] = curves.at(len(experiment.data.values) + self._rows, self._places)
        if not (np.isfinite(sigma).all() and (sigma[:, 0] > 0).all()):
            return Failed("sigma is not positive and finite")
        return Simulated(every[:, 0], every[:, 1:], sigma[:, 0], sigma[:, 1:])

    def _components(self, sol: Any, start: _RunStart, k: int) -> Array:
        """Return the components of y that were measured, where they were, with their derivatives, (N, 1 + k)."""
        assert self._direct is not None
        component, output = self._direct
        every = np.zeros((len(component), 1 + k))
        every[:, 0] = sol["y"][component, output]
        if k and self._columns:
            every[:, 1:] = self._parameters(sol.sensitivities[component, :, output], start, k)
        return every

    def _all_curves(self, sol: Any, start: _RunStart, values: Array) -> _ObservedCurves | Failed:
        """Return the observed quantities at the times of the data; at infinity in the steady state."""
        t, which = self.experiment.data.t, self._which
        if sol is None:  # all data are at the start
            y, which = start.y0[:, None], np.zeros_like(which)
            tangent = None if start.slopes is None else start.slopes[:, None]
        else:
            y, tangent = sol.y, None if start.slopes is None else self._tangent(sol, start, len(values))
        if len(which) < len(t):
            rest = self._at_rest(self._own, self.experiment.problem, start)
            if isinstance(rest, Failed):
                return rest
            finite, last = np.isfinite(t), y.shape[1]
            y = np.concatenate([y, rest.y0[:, None]], axis=1)
            if tangent is not None and rest.slopes is not None:
                tangent = np.concatenate([tangent, rest.slopes[:, None]], axis=1)
            at_times, which = which, np.full(len(t), last)
            which[finite] = at_times
        return self._curves(t, y[:, which], None if tangent is None else tangent[:, which], values, start)

    def _tangent(self, sol: Any, start: _RunStart, k: int) -> Array:
        S = sol.sensitivities.swapaxes(1, 2) if self._columns else np.zeros((*sol.y.shape, 0))
        return self._parameters(S, start, k)

    def _curves(self, t: Array, y: Array, tangent: Array | None, values: Array, start: _RunStart) -> _ObservedCurves:
        if self._watch is not None:
            found = self._watch(t, y, tangent, values, start.args)
            return _ObservedCurves(found.values, found.tangent)
        places = self.experiment.observation.components
        return _ObservedCurves(y[places], None if tangent is None else tangent[places])

    def _occurrences(self, sol: Any, start: _RunStart, one: Series, k: int) -> Array | Failed:
        """Return times of an event with their derivatives, (occurrences, 1 + k)."""
        event = [*self.experiment.events][one.row - len(self.experiment.data.values)]
        times, needed = sol.t_events[event], int(one.places[-1]) + 1
        if len(times) < needed:
            return Failed(f"{titled(one.name)} occurred {len(times)} times, and {needed} times were measured")
        if start.slopes is None:
            return np.asarray(times)[:, None]
        slopes = sol.sensitivities_t_events[event] if self._columns else np.zeros((len(times), 0))
        return np.column_stack([times, self._parameters(slopes, start, k)])

    def curves(self, times: Array, values: Array) -> Curves | Failed:
        """Return the observed quantities at any times within the problem's interval, which are sorted."""
        start = self._start(values, slopes=True)
        once, which = _once(times, backwards=False)
        t0, tf = self.experiment.problem.t_span
        if tf < t0:
            once, which = once[::-1], len(once) - 1 - which
        if isinstance(start, Failed):
            return start
        sol = self._runs(once, start)
        if isinstance(sol, Failed):
            return sol
        missing = len(once) - len(sol.t)
        if missing and sol.status != MESSAGES["terminal_event"][0]:
            return Failed(f"the run ended at t = {sol.t_end:.6g}")
        found = self._curves(sol.t, sol.y, self._tangent(sol, start, len(values)), values, start)
        m, behind = self.experiment.observation.size, [(0, 0), (0, missing)]
        filled = [
            np.pad(one[:m], behind + [(0, 0)] * (one.ndim - 2), constant_values=np.nan)[:, which]
            for one in (found.values, found.tangent)
            if one is not None
        ]
        return Curves(filled[0], filled[1])

    def solution(self, values: Array) -> Solution:
        """Return a run without sensitivities, as users make it."""
        start = self._start(values, slopes=False)
        assert isinstance(start, _RunStart)  # it was, in the fit
        problem = self._problem.replace(args=start.args, y0=start.y0, sensitivities=None)
        options: Options = {"dense_output": True, **self._options}
        return problem.solve(self._method, **options)


class _KnownStates:
    """Steady states, of which the last ones are remembered: several experiments may begin with the same one."""

    def __init__(self, states: SteadyStates) -> None:
        self._states = states
        self._last: Latest[tuple[bytes, ...], Found | NotFound] = Latest()

    def at(self, args: tuple[Any, ...], y0: Array, S0: Array | None) -> Found | NotFound:
        """Return the steady state for these arguments and this initial value, with derivatives for S0."""
        key = layout_of(args).numbers.tobytes(), y0.tobytes(), b"" if S0 is None else S0.tobytes()
        return self._last.find(key, lambda: self._states.at(args, y0, S0))


class _ObservedCurves(NamedTuple):
    """Quantities over time, (q, m), with their derivatives, (q, m, k); None: not wanted."""

    values: Array
    tangent: Array | None

    def at(self, rows: Array, places: Array) -> Array:
        """Return quantities, each at a time of its own, with their derivatives, (N, 1 + k)."""
        values = self.values[rows, places][:, None]
        return values if self.tangent is None else np.concatenate([values, self.tangent[rows, places]], axis=1)


def _in_use(settings: ParameterPlaces, numbers: set[int] | None) -> list[tuple[int, ParameterName]]:
    """Return the numbers in args that parameters set, each with its parameter, of these; None: of all."""
    found = [(j, one) for j, one in settings.entries if one.kind == "args"]
    if numbers is None:
        return found
    return [(j, one) for j, one in found if place_of(settings.args, one.index, one.item) in numbers]


def _of_first(own: Sequence[int], slopes: Array) -> Array:
    """Return the derivatives of an initial value, (n, k), for numbers of these parameters: the first number of each has
    them, others have zeros."""
    first = [j not in own[:i] for i, j in enumerate(own)]
    return np.where(first, slopes[:, own], 0.0)


def _guesses(experiment: Experiment, names: Sequence[str], values: Array) -> Array:
    """Return values of the parameters at which functions can be called: those of the problem, if they have any."""
    known = [experiment.value(name) for name in names]
    return np.array([value if one is None else one for one, value in zip(known, values.tolist(), strict=True)])


def _watch(experiment: Experiment, settings: ParameterPlaces, at: Point, guesses: Array) -> Through | None:
    """Return the observed quantities, with sigma after them if it is a function; None: components alone."""
    observation, sigma, m = experiment.observation, experiment.sigma_function, len(experiment.data.values)
    if observation.function is None and sigma is None:
        return None
    observe, extras = observation.function, [observation.extras]
    if observe is None:
        components = observation.components
        if isinstance(sigma, Formula) and sigma.outputs:
            graph = sigma.outputs[0].graph
            observe = Formula("components", lambda: [graph.y(i) for i in components], (m,))
        else:

            def observe(_t: Any, y: Any, *_args: Any) -> Any:
                return np.stack([y[i] for i in components])

    if sigma is None:
        return Through([observe], extras, settings, at, guesses, "observe")
    inside = sigma if isinstance(sigma, Formula) else _repeated(sigma, m)
    return Through([observe, inside], [*extras, experiment.sigma_extras], settings, at, guesses, "observe")


def _repeated(sigma: Any, m: int) -> Any:
    """Return sigma as a function with m values: one of a single value holds for all quantities."""

    def repeated(t: Any, y: Any, *args: Any, **extras: Any) -> Any:
        found = np.ravel(np.asarray(sigma(t, y, *args, **extras)))
        if len(found) == 1 < m:
            return np.stack([found[0]] * m)
        if len(found) != m:
            raise ValueError(f"sigma returns {len(found)} values, and {m} quantities are observed")
        return found

    return repeated


def _used_by(fun: Any) -> set[int] | None:
    """Return which numbers of the arguments a function uses, if it is a formula; None: any of them."""
    inside = getattr(fun, "fun", fun)
    if not isinstance(inside, Formula):
        return None
    return {one.value for one in in_order(inside.outputs) if one.op == "p"}


def _used(problem: Problem) -> set[int] | None:
    """Return which numbers of the arguments the functions of a problem use; None: any of them."""
    if problem.inputs or problem.events or problem.invariants or callable(problem.matrices.mass):
        return None
    return _used_by(problem.fun)


def _once(times: Array, backwards: bool) -> tuple[Array, Array]:
    """Return different times in the direction of integration, and which of them each is."""
    once, which = np.unique(times, return_inverse=True)
    return (once[::-1].copy(), len(once) - 1 - which) if backwards else (once, which)
