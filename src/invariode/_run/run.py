"""A run: a plan carried out by the core, its results as a Solution, and the extension of a finished one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .. import _core
from .._adjoint.adjoint import Forward, gradient
from .._adjoint.sections import Sectioned, SectionedSolution
from .._base.arguments import Array, number, output_times, quietly, shown, warn
from .._base.failures import FailureWarning, InvariantError, SolveError
from .._base.forks import cached_property
from .._base.interrupts import stopped_by_interrupt, terminated_as_interrupted
from .._base.progress import run_bar
from .._base.types import MethodName, OnFailure
from .._files.checkpoint import RunFiles
from .._files.identity import Identity, identity_of_run
from .._functions.compiled import CoreFunction
from .._functions.graph.derived import is_derived
from .._functions.layout import layout_of
from .._laws.bound import BoundInvariants, ValueJump, as_columns
from .._laws.jacobians import TracedJacobian
from .._plan.call_errors import error_at_start, explain
from .._plan.events_at_start import ended_at_start, found_at_start, with_start, without_start
from .._plan.nystrom_requirements import require_no_velocities
from .._plan.plan import Plan, solver
from .._plan.planning import make_plan, ordered_breakpoints
from .._problem.breakpoints import to_breakpoints, warn_of_idle_actions
from .._problem.given_options import changed, keeping_arrays
from .._problem.invariants import AccuracyWarning
from .._problem.methods import find_method
from .._problem.options import ExtensionOptions, Options
from .._problem.parameters import values_of
from .._problem.problem import Problem
from .._results.messages import MESSAGES, OF_MECHANISM, below_zero, blamed_on, complex_steps_left, formed, misfit
from .._results.records import BeforeProjection, ByEvent, Stats, Steps, at_events
from .._results.result import FAILED, LIMIT_REACHED, NOT_CONSERVED, STOPPED, DenseSolution, Origin
from .._results.sensitivity_data import SensitivityData, states_and_sensitivities
from .._results.solution import Solution
from .._sensitivity.landings import schedule_of
from .comparison import compare, uncompared
from .prepared import OnCourse, run_or_plan
from .run_warnings import warn_of_projection, warn_of_steps

#: Where f may jump it is evaluated so many ulp from there.
_BESIDE = 16


class Resumed(NamedTuple):
    """State from which a run continues."""

    memory: bytes  # of the run that was interrupted
    anew: bool  # the method is to start again


class Outputs(NamedTuple):
    """Output points of a run, its end, and its outcome."""

    y: Array  # (n, n_t)
    t_end: float
    status: int
    message: str


class Solved:
    """A problem solved by a method with options; the problem may be made when it is used."""

    __slots__ = ("_problem", "method", "options")

    def __init__(self, problem: Problem | Callable[[], Problem], method: MethodName, options: Options) -> None:
        self._problem, self.method, self.options = problem, method, options

    @property
    def problem(self) -> Problem:
        """The problem, with the whole interval if the run continues another."""
        if not isinstance(self._problem, Problem):
            self._problem = self._problem()
        return self._problem

    @property
    def history(self) -> Callable[[float], Array] | None:
        """y before the start, of a problem with delays."""
        known = self._problem  # one that has yet to be made has none
        return known.history if isinstance(known, Problem) else None


@dataclasses.dataclass(eq=False, slots=True)
class RunOrigin(Origin):
    """Origin of a solution, problem and end of the run: everything that is needed to continue it."""

    source: Solved
    t: float
    y: Array
    next_h: float | None  # None: the method is to choose
    memory: bytes
    roots: list[Any]  # what each `Roots` remembers of the run
    imposed: bool = False
    checkpoint: RunFiles | None = None
    sectioned: tuple[Sectioned, ...] = ()  # with adjoint="checkpoints": of the run, and of its extensions

    def __deepcopy__(self, memo: dict[int, Any]) -> RunOrigin:
        return self

    def extend(self, sol: Solution, t_end: float, options: ExtensionOptions) -> Solution:
        """See `Solution.extend`."""
        return _extended(self, sol, t_end, options)

    def gradient(self, sol: Solution, *given: Any) -> Array:
        """See `Solution.gradient`."""
        source = self.source
        return gradient(Forward(source.problem, source.method, source.options, solve, self.t, sol), *given)

    def continuous(self, sol: Solution) -> DenseSolution | SectionedSolution | None:
        """The solution as a function of t, perhaps solved again from checkpoints; None: it was not asked for."""
        if sol.sol is not None or not self.sectioned:
            return sol.sol
        return SectionedSolution(self.sectioned, sol, self.y, imposed=self.imposed)

    def identity(self) -> Identity:
        """See `Origin.identity`."""
        return identity_of_run(self.source.problem, self.source.method, self.source.options)

    def slopes(self, t: Array, y: Array) -> tuple[Array, Array] | None:
        """See `Origin.slopes`."""
        problem, options = self.source.problem, self.source.options
        if problem.delays is not None:
            return None
        known = len(t) > 1 and t[0] == problem.t_span[0] and t[-1] == self.t and y.shape == (len(self.y), len(t))
        if not known or options.get("t_eval") is not None or problem.matrices.mass is not None:
            return None
        if not np.allclose(y[:, -1], self.y, rtol=1e-2, atol=0):  # the user has changed its units
            return None
        given = options.get("breakpoints")
        points = ordered_breakpoints(problem, () if given is None else to_breakpoints("breakpoints", given))
        jumps = np.isin(t, [point.t for point in points]) | self._landings(t)
        stiff = "jac" in find_method(self.source.method)[0].options
        return self._slopes_of_shape(t, y, jumps) if stiff else self._sides(t, y, jumps)

    def _landings(self, t: Array) -> Array:
        """Return a boolean array: at which of the times t f changes its branch as a function of t alone."""
        problem = self.source.problem
        with quietly():  # the run has warned
            schedule = schedule_of(problem, layout_of(problem.args))
        found = np.zeros(0) if schedule is None else schedule.landings.between(t.min(), t.max())
        if not len(found):
            return np.zeros(len(t), dtype=bool)
        place = np.searchsorted(found, t)
        nearest = np.minimum(*(np.abs(t - found[np.clip(place + i, 0, len(found) - 1)]) for i in (-1, 0)))
        return np.asarray(nearest <= _BESIDE * np.spacing(np.abs(t)))

    def _sides(self, t: Array, y: Array, jumps: Array) -> tuple[Array, Array]:
        """Return f after and before each time. `jumps`: where it may differ from one side to the other."""
        slope = self.source.problem.slope
        beside = self.forward * _BESIDE * np.spacing(np.abs(t))
        after = before = slope(np.where(jumps, t + beside, t), y)
        if jumps.any():
            before = after.copy()
            before[:, jumps] = slope((t - beside)[jumps], y[:, jumps])
        return after, before

    def _slopes_of_shape(self, t: Array, y: Array, jumps: Array) -> tuple[Array, Array]:
        """Return the slopes of monotone cubics after and before each time, between the jumps, for implicit methods: f
        at stiff solutions magnifies their errors, and its cubics overshoot."""
        from scipy.interpolate import PchipInterpolator

        reals = np.ascontiguousarray(y.T).view(float)
        after, before = np.zeros_like(reals), np.zeros_like(reals)
        twice = np.append(np.diff(t) == 0, False)  # a jump of y, after which its next piece begins
        ends = np.flatnonzero(twice | (jumps & ~np.append(False, twice[:-1])))
        begins = np.append(0, ends + twice[ends])
        for begin, end in zip(begins, np.append(ends, len(t) - 1), strict=True):
            piece = slice(begin, end + 1)
            if end > begin:
                at = self.forward * t[piece]
                slopes = self.forward * PchipInterpolator(at, reals[piece])(at, 1)
                after[begin:end], before[begin + 1 : end + 1] = slopes[:-1], slopes[1:]
        return as_columns(after, y.dtype), as_columns(before, y.dtype)

    def field(self, y: Array) -> Array | None:
        """See `Origin.field`."""
        problem = self.source.problem
        if problem.matrices.mass is not None or problem.delays is not None:
            return None
        return problem.slope(np.full(y.shape[1], problem.t_span[0]), y)

    def positions(self) -> int:
        """See `Origin.positions`: of mechanical systems and second-order problems."""
        problem = self.source.problem
        if isinstance(problem.fun, CoreFunction):
            return problem.fun.positions
        return len(problem.y0) // 2 if problem.second_order else 0

    def parameters(self) -> Array:
        """See `Origin.parameters`."""
        problem = self.source.problem
        return values_of(problem.args, problem.y0, problem.parameter_names())

    def imposing(self) -> RunOrigin:
        """See `Origin.imposing`."""
        return dataclasses.replace(self, imposed=True)

    @property
    def forward(self) -> float:
        """The direction of integration, 0 if there was nothing to integrate."""
        return float(np.sign(self.source.problem.t_span[1] - self.source.problem.t_span[0]))


def solve(problem: Problem, method: MethodName, options: Options) -> Solution:
    """See `Problem.solve`."""
    try:
        if (points := options.get("breakpoints")) is not None:
            warn_of_idle_actions(points, problem.t_span)
        given = keeping_arrays(options)
        given.pop("progress", None)
        begun = run_or_plan(problem, method, options)
        return _solved(begun, Solved(problem, method, given))
    except (TypeError, ValueError) as error:
        explain(error, problem, options)
        raise


def points(problem: Problem, method: MethodName, options: Options) -> Outputs:
    """The outputs of a solve that needs nothing else: the same run, without making a solution of it."""
    try:
        begun = run_or_plan(problem, method, options, remember=False)
        if not isinstance(begun, Plan) and (run := begun[1]).outcome is not None and uncompared(problem) is None:
            return Outputs(run.take_points()[1], run.t_end, *MESSAGES[run.state])
        sol = _solved(begun, Solved(problem, method, options))
        return Outputs(sol["y"], sol["t_end"], sol["status"], sol["message"])
    except (TypeError, ValueError) as error:
        explain(error, problem, options)
        raise


def finished_solution(run: _core.Run, source: Solved, shared: OnCourse) -> Solution:
    """Return the solution of a run of a prepared plan as the user gets it; the first run of a compiled f is compared
    with the Python function."""
    prepared = shared.prepared
    plan, items = prepared.plan, _ITEMS.get(run.outcome)
    of = run, plan, source, prepared.members, shared
    if items is not None and prepared.simple:
        # Nothing is to be reported or computed; what most solutions are never asked for is made when it is needed.
        sol = _solution(run, plan, prepared.members, items, (_private_of, of), (_stats_of, of))
    else:
        sol = presented(Finished(*of))
    if uncompared(shared.problem) is not None:
        compare(source.problem, sol, source.options.get("check", True))
    return concluded(sol, plan.on_failure)


def _solved(begun: tuple[OnCourse, _core.Run] | Plan, source: Solved) -> Solution:
    """Return the solution of a run that has ended, or of a plan by a solver of its own."""
    if not isinstance(begun, Plan):
        return finished_solution(begun[1], source, begun[0])
    plan, problem = begun, source.problem
    if problem.events and any(event.at_start for event in problem.events) and (found := found_at_start(problem, plan)):
        rest = without_start(plan, found)
        sol = with_start(_carried_out(rest, source, checkpoint=_new_checkpoint(plan, found)), plan, found)
        if ended_at_start(plan, found) and sol.success:
            status, message = MESSAGES["terminal_event"]
            sol = sol.changed(status=status, message=message)
    else:
        sol = _carried_out(plan, source, checkpoint=_new_checkpoint(plan, []))
    compiled = problem if plan.expansion is None else plan.expansion.problem
    compare(compiled, sol, source.options.get("check", True))
    return concluded(sol, plan.on_failure)


def concluded(sol: Solution, on_failure: OnFailure | None) -> Solution:
    """Return the solution as the user gets it; if it failed, with the warning that `on_failure` requests.

    Raises SolveError: It failed, and is to raise.
    Raises InvariantError: f contradicts an invariant, and the solution is not to be returned.
    """
    if sol["success"] or on_failure == "return" or (on_failure is None and sol["status"] != NOT_CONSERVED):
        return sol
    if on_failure == "warn":
        warn(sol.message, FailureWarning)
        return sol
    raise (InvariantError if sol.status == NOT_CONSERVED else SolveError)(sol.message, sol)


def _new_checkpoint(plan: Plan, at_start: list[int]) -> RunFiles | None:
    """The files of a new run. `at_start`: the events that have occurred where it starts."""
    if plan.checkpoint is None:
        return None
    return RunFiles.of_new_run(plan.checkpoint.path, partial(with_start, plan=plan, found=at_start))


# ----------------------------------------------------------------------------------------------------------------------
# One run


def _carried_out(
    plan: Plan, source: Solved, resumed: Resumed | None = None, checkpoint: RunFiles | None = None
) -> Solution:
    """Return the solution of a plan, or of the rest of it from `resumed`."""
    core = solver(plan)
    keep = None if checkpoint is None else partial(_keep, checkpoint, core, plan, source)
    with ExitStack() as around:
        if checkpoint is not None:
            around.callback(checkpoint.release)
        run = _integrated(core, plan, source.problem.name, resumed, keep)
    finished = Finished(run, plan, source, core.members, checkpoint=checkpoint)
    sol = presented(finished)
    fun = source.problem.fun
    sol.stats.mechanics = _work(core, fun)
    if sol["status"] == FAILED and isinstance(fun, CoreFunction):
        called = fun.undefined_near(sol.t_end, sol.y_end, run.h, source.problem.args)
        sol["message"] = blamed_on(called or "MechanicalSystem", sol.message, OF_MECHANISM)
    if find_method(source.method)[0].equations == "second-order":
        require_no_velocities(source.problem, sol)
    return sol


class Finished:
    """A run of the core that has ended, and what is reported of it, which is put together when somebody asks."""

    y_end: Array | None = None  # None: the end of the run is that of y
    sectioned: tuple[Sectioned, ...] = ()

    def __init__(
        self,
        run: _core.Run,
        plan: Plan,
        source: Solved,
        members: tuple[str, ...],
        shared: OnCourse | None = None,  # of a run of a prepared plan, whose own plan is made when it is needed
        checkpoint: RunFiles | None = None,
    ) -> None:
        self.run = run
        self.outcome = run.outcome
        self.general = plan  # what it shares with all runs of its kind, if it is not its own plan
        self.source = source
        self.members = members  # the methods that took turns
        self.checkpoint = checkpoint
        self._shared = shared

    @cached_property
    def plan(self) -> Plan:
        """Plan of the run."""
        if self._shared is None:
            return self.general
        return self._shared.prepared.plan_of(self.source.problem, self._shared.course, self.run)

    @cached_property
    def bound(self) -> BoundInvariants:
        """Invariants of the run, with the values that actions gave them."""
        bound, functions = self.plan.bound, self.plan.functions
        if (functions.events or functions.breakpoints) and (jumps := self.run.jumps):
            return bound.jumped(jumps)
        return bound

    def private(self) -> dict[str, Any]:
        """Return the private attributes of the solution, besides its items and those that it has already."""
        run, plan = self.run, self.plan
        y_end = run.end if self.y_end is None else self.y_end
        next_h = run.next_h if plan.method.fixed_order and run.steps else None
        return {
            "_invariants": self.bound,
            "_rtol": plan.rtol,
            "_atol": plan.atol,
            "_drift": BeforeProjection(*run.drift) if plan.names else _NO_DRIFT,
            "_names": plan.called,
            "_sensitivities": None,
            "_y_end": y_end,
            "_origin": RunOrigin(
                self.source,
                run.t_end,
                y_end,
                next_h,
                run.memory,
                [one.state() for one in plan.roots],
                checkpoint=self.checkpoint,
                sectioned=self.sectioned,
            ),
        }

    def stats(self) -> dict[str, Any]:
        return vars(_stats(self.run, self.plan))


def _private_of(finished: tuple[Any, ...]) -> dict[str, Any]:
    return Finished(*finished).private()


def _stats_of(finished: tuple[Any, ...]) -> dict[str, Any]:
    return Finished(*finished).stats()


def presented(finished: Finished) -> Solution:
    """Return the solution of a finished run and warn of its problems, or raise its exception."""
    run = finished.run
    if finished.outcome is None:
        _require_start(finished)
    sol = _whole_solution(finished)
    if finished.outcome is None:
        if finished.general.names:
            warn_of_projection(run, finished.plan, sol)
        _warn(finished)
        if run.below_zero is not None:
            i, y, _ = run.below_zero
            warn(below_zero(sol._names.components[i], [i], f"and is {y:.2g} at the end"), AccuracyWarning)
    return sol


def _require_start(finished: Finished) -> None:
    """Raises where the run could not start."""
    run = finished.run
    if run.state in MESSAGES:
        return
    problem = finished.source.problem
    error = error_at_start(run.state, problem, problem.y0, problem.args)
    if exception := error or finished.plan.exception(run):
        raise exception


def _warn(finished: Finished) -> None:
    """The warnings of a run, but for those of invariants."""
    run, plan = finished.run, finished.plan
    if plan.functions.linear is not None:
        if not math.isnan(run.left_complex_steps) and finished.source.problem.matrices.jac is not None:
            warn(complex_steps_left(run.left_complex_steps))
        if run.misfit is not None:
            warn(misfit(run.misfit, plan.functions.complex))
    if run.remarkable:
        warn_of_steps(run, plan)


def _work(core: _core.Solver, fun: Any) -> dict[str, Any] | None:
    """Return the counts of work of a mechanical system, or None."""
    work: Any = core.motion_work if isinstance(fun, CoreFunction) else None
    return None if work is None else {"derivatives": dict(fun.derivatives)} | work


def _keep(checkpoint: RunFiles, core: _core.Solver, plan: Plan, source: Solved, part: _core.Run) -> None:
    """Writes what has come since the last time."""
    if plan.exception(part) is not None:
        return
    sol = _whole_solution(Finished(part, plan, source, core.members, checkpoint=checkpoint))
    sol.stats.mechanics = _summed(checkpoint.mechanics, _work(core, source.problem.fun))
    checkpoint.keep(sol)


def _integrated(
    core: _core.Solver, plan: Plan, name: str, resumed: Resumed | None, keep: Callable[[_core.Run], None] | None
) -> _core.Run:
    """The run, with its bar and with Ctrl-C as a request, if the options ask for them."""
    every = 0.0 if plan.checkpoint is None else plan.checkpoint.every
    with ExitStack() as around:
        report = request = None
        if plan.progress:
            report = around.enter_context(run_bar(plan.progress, name, plan.course.t0, plan.course.tf))
        if plan.on_interrupt == "return":
            around.enter_context(terminated_as_interrupted())
            request = around.enter_context(stopped_by_interrupt())
        if resumed is not None:
            return core.resume(*resumed, report, request, keep, every, plan.remarks)
        return core.integrate(plan.start, report, request, keep, every, plan.remarks)


#: The classes of a solution and its parts, of which the core makes objects.
_KINDS = (Solution, Stats, Steps, ByEvent)


def _solution(
    run: _core.Run,
    plan: Plan,
    members: tuple[str, ...],
    items: dict[str, Any],
    private: tuple[Any, ...],
    stats: tuple[Any, ...],
) -> Solution:
    """Return the solution of a run, without what is computed from it. `private`, `stats`: see `Deferred`."""
    events = plan.called.events if plan.records_events and plan.varied is None else None
    made: Any = run.solution(_KINDS, items, private, stats, members if plan.settings.record else None, events)
    sol: Solution = made
    return sol


def _whole_solution(finished: Finished) -> Solution:
    run, plan = finished.run, finished.general
    items = _ITEMS.get(finished.outcome) if plan.watch is None else None
    items = items or _items(*finished.plan.verdict(run))
    sol = _solution(run, plan, finished.members, items, (finished.private,), (finished.stats,))
    if plan.varied is not None:
        _take_sensitivities(finished, sol)
    settings = plan.settings
    if settings.sections:
        finished.sectioned = (Sectioned.of(finished.plan, run),)
    if settings.dense and (dense := run.take_dense()) is not None:
        sol["sol"] = DenseSolution(dense, sol["y"].dtype, finished.bound).after(finished.source.history)
    return sol


def _take_sensitivities(finished: Finished, sol: Solution) -> None:
    """Separate the state from its sensitivities in the output of a run, at its end and at its events."""
    run, plan = finished.run, finished.general
    assert plan.varied is not None
    names, n = plan.varied.names, plan.components
    happened = run.take_events(plan.own_events) if plan.records_events else None
    S_events = None if happened is None else plan.varied.at_events(happened, n)
    sol["y"], S = states_and_sensitivities(sol["y"], n, len(names))
    finished.y_end, S_end = states_and_sensitivities(run.end, n, len(names))
    sol.__dict__["_sensitivities"] = SensitivityData(names, S, S_end, S_events)  # without the other attributes
    plan.varied.tell_of_steps(sol["t"], sol["y"])
    if happened is not None:
        sol["t_events"] = ByEvent(plan.called.events, [times for times, _ in happened])
        rows = [np.ascontiguousarray(states[:, :n]) for _, states in happened]
        sol["y_events"] = ByEvent(plan.called.events, [at_events(states) for states in rows])


def _items(status: int, message: str) -> dict[str, Any]:
    """Return the items of a solution, in their order; None: absent, unless the run has it."""
    names = ("t", "y", "sol", "t_events", "y_events", "nfev", "njev", "nlu")
    ended = {"status": status, "message": message, "success": status >= 0}
    return {**dict.fromkeys(names), **ended, "stats": None, "steps": None, "t_end": None}


#: By the state of the run, if that says everything.
_ITEMS: dict[str | None, dict[str, Any]] = {state: _items(*ended) for state, ended in MESSAGES.items()}


#: Of a run without invariants.
_NO_DRIFT = BeforeProjection(np.zeros(0), np.zeros(0), 0.0)


def _derivatives(run: _core.Run, plan: Plan) -> set[str]:
    """Return how the Jacobians of the invariants were formed: some that the core was given follow from a trace."""
    functions = [one.jac for one in plan.bound.specs if not isinstance(one.jac, str)]
    given = {"traced" if is_derived(one) or isinstance(one, TracedJacobian) else "given" for one in functions}
    return {kind for one in run.derivatives for kind in (given if one == "given" else {one})}


def _stats(run: _core.Run, plan: Plan) -> Stats:
    if not plan.names:  # in the order of COUNTS, of which the last four are warnings
        stats = Stats(*run.counts[:-4], None, plan.moved, run.clipped)
    else:
        stats = Stats(
            *run.counts[:-4],
            derivatives=" and ".join(sorted(_derivatives(run, plan))) or None,
            projected_start=run.projected_start or plan.moved,
            clipped_amount=run.clipped,
        )
        stats.ng += plan.bound.evaluations
        stats.ngdiff += plan.bound.evaluations - len(plan.bound.specs)
    stats.jacobian = formed(plan.functions.linear, run)
    stats.sensitivities = None if plan.varied is None else plan.varied.derivatives
    if plan.functions.delays is not None:
        stats.marks = tuple(zip(run.marks[::2], run.marks[1::2], strict=True))
    if run.remarkable:
        stats.stiff_since = run.stiff_since if run.stiff else None
        stats.discontinuities = tuple(run.discontinuities)
    return stats


# ----------------------------------------------------------------------------------------------------------------------
# Its extension


def _extended(origin: RunOrigin, old: Solution, t_end: float, options: ExtensionOptions) -> Solution:
    if not (old.success or old.status == LIMIT_REACHED):
        raise ValueError(f"a run that failed cannot be extended: {old.message}")
    tf = number("t_end", t_end)
    if tf == origin.t:
        return old
    forward = origin.forward or float(np.sign(tf - origin.t))
    if not forward * (tf - origin.t) > 0:
        raise ValueError(
            f"t_end must be beyond the end of the run, t = {origin.t}, in its direction; got {shown(t_end)}"
        )
    problem, method, options_of_run = origin.source.problem, origin.source.method, origin.source.options
    whole = problem.replace(t_span=(problem.t_span[0], tf))
    given = changed(options_of_run, {"first_step": None, **options})
    now = given.copy()
    if options_of_run.get("t_eval") is not None or options.get("t_eval") is not None:
        now["t_eval"], given["t_eval"] = _times(origin, old, options.get("t_eval"), forward, tf)
    anew = now["first_step"] is not None
    if not anew and origin.next_h is not None:  # for a method that has to start again: the run ended inside a step
        now["first_step"] = min(origin.next_h, abs(tf - origin.t))
    given.pop("progress", None)

    plan = make_plan(whole, method, now).holding(old._invariants.last_value)
    if origin.checkpoint is not None:
        origin.checkpoint.go_on(old.stats.mechanics)
    for one, state in zip(plan.roots, origin.roots, strict=True):
        one.restore(state)
    new = _carried_out(plan, Solved(whole, method, given), Resumed(origin.memory, anew), origin.checkpoint)
    points = 0 if given.get("keep") == "end" else len(old.t)
    times = now.get("t_eval")
    if points and times is not None and np.any(np.asarray(times)[:1] == old.t[-1]):  # it is put out again
        points -= 1
    return concluded(_joined(old, new.impose() if origin.imposed else new, points, forward), plan.on_failure)


def _times(origin: RunOrigin, old: Solution, t_eval: Any, forward: float, tf: float) -> tuple[Array, Array]:
    """Return the remaining output times, or those of `t_eval`, and the same with those beyond tf, for a further
    extension. Where a callback has ended the run, the solution may have yet to jump: an output there is put out
    again."""
    if origin.source.options.get("t_eval") is None:
        raise ValueError("the run has output at its steps, and so must its extension: leave out t_eval")
    times = np.asarray(origin.source.options["t_eval"], dtype=float)
    beyond = times[forward * (times - tf) > 0]
    if t_eval is not None:
        now = output_times(t_eval, origin.t, tf)
        if len(old.t) and len(now) and now[0] == old.t[-1]:
            now = now[1:]  # already an output
    else:
        now = times[(forward * (times - origin.t) > 0) & (forward * (tf - times) >= 0)]
    again = old.t[-1:] if old.status == STOPPED and len(old.t) and old.t[-1] == origin.t else old.t[:0]
    return np.concatenate([again, now]), np.concatenate([now, beyond])


def _joined(old: Solution, new: Solution, points: int, forward: float) -> Solution:
    """Join two solutions, the second of which continues where the first ended, into one with the counts of both.
    `points`: outputs of the first."""
    jumps = tuple(ValueJump(row + points, t, value) for row, t, value in new._invariants.jumps)
    bound = dataclasses.replace(old._invariants, jumps=old._invariants.jumps + jumps, forward=forward, evaluations=0)
    sol = None
    if old.sol is not None and new.sol is not None:
        sol = DenseSolution(old.sol._dense.joined(new.sol._dense), old.y.dtype, bound, old.sol._imposed)
        sol.after(old.sol._history)
    t_events = y_events = None
    if old.t_events is not None and new.t_events is not None and old.y_events is not None and new.y_events is not None:
        t_events = new.t_events.replaced(map(np.concatenate, zip(old.t_events, new.t_events, strict=True)))
        n = len(old.y)
        y_events = new.y_events.replaced(
            at_events(np.concatenate([part.reshape(-1, n) for part in parts]))
            for parts in zip(old.y_events, new.y_events, strict=True)
        )
    steps = None
    if old.steps is not None and new.steps is not None:
        steps = Steps(np.concatenate([old.steps._rows, new.steps._rows]), old.steps._methods)
    sensitivities = None
    if old._sensitivities is not None and new._sensitivities is not None:
        sensitivities = old._sensitivities.joined(new._sensitivities, points)
    before, origin = old._origin, new._origin
    assert isinstance(before, RunOrigin)
    assert isinstance(origin, RunOrigin)
    sectioned = before.sectioned + origin.sectioned if before.sectioned else ()  # not of a run that was loaded
    return new.changed(
        t=np.concatenate([old.t[:points], new.t]),
        y=np.concatenate([old.y[:, :points], new.y], axis=1),
        sol=sol,
        t_events=t_events,
        y_events=y_events,
        stats=dataclasses.replace(new.stats, mechanics=_summed(old.stats.mechanics, new.stats.mechanics)),
        steps=steps,
        _invariants=bound,
        _sensitivities=sensitivities,
        _origin=dataclasses.replace(origin, sectioned=sectioned),
    )


def _summed(first: dict[str, Any] | None, then: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the sum of the work of a mechanical system in both parts: it counts for itself, in each part."""
    if first is None or then is None:
        return then
    return {name: of if name == "derivatives" else of + then[name] for name, of in first.items()}
