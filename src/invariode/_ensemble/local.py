"""The rows of an ensemble, solved on this machine: on threads in the core, or in processes."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, nullcontext
from functools import partial
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from .. import _core
from .._base.arguments import Array, state, warn
from .._base.interrupts import stopped_by_interrupt
from .._functions.compiled import native_parameters
from .._functions.lanes import Lanes, choose_lanes
from .._functions.layout import TRUTHS, layout_of
from .._plan.call_errors import error_at_start
from .._plan.nystrom_requirements import fits_any_args
from .._plan.plan import Plan, solver
from .._results.messages import inconsistent_start
from .._results.result import LIMIT_REACHED, NOT_CONSERVED
from .._results.sensitivity_data import states_and_sensitivities
from .ensemble_solution import EnsembleEvents
from .outcomes import ROWS, UNSOLVED, Outcomes, in_order, picklable
from .sources import rows_of
from .task import Ensemble, Task
from .worker_processes import may_start, solve_rows

_STATUS = {
    "reached_end": 0,
    "terminal_event": 1,
    "stopped_by_callback": 2,
    "invariant_convicted": NOT_CONSERVED,
    "limit_reached": LIMIT_REACHED,
}
#: What a single solve ends with by an exception.
_RAISED = -4
_EXCEPTIONS = (
    "invariant_refused",
    "start_contradicts",
    "start_out_of_bounds",
    "event_undefined",
    "action_undefined",
    "events_endless",
    "interrupted",
)
# States that only trajectories of an ensemble have.
_NOT_FINITE = -1
_INCONSISTENT = {-2: "not_found", -3: "index_too_high", -4: "undetermined"}
#: The status for each state; states of ensembles only are negative and count from the end: the first of these is that
#: of a row which was cancelled.
_CODES = np.array(
    [_STATUS.get(name, _RAISED if name in _EXCEPTIONS else -1) for name in _core.STATES]
    + [UNSOLVED]
    + (1 + len(_INCONSISTENT)) * [_RAISED],
    dtype=np.int8,
)
_NG, _NGDIFF = (_core.COUNTS.index(name) for name in ("ng", "ngdiff"))
#: Seconds of this thread that rows whose functions only calculate are solved here before processes are started, which
#: takes about as long (benchmarks/overhead.py). Any other function might end the process, and with it the caller's.
_PATIENCE = 0.05
#: Trajectories that failed, and runs that tell why they ended.
Failures = Sequence[tuple[int, _core.Run]]


class Locally(NamedTuple):
    """Means of solving rows on this machine."""

    workers: int  # the number of threads or processes
    report: Callable[[float], None] | None = None  # called with the number of rows that are solved
    keep: bool = False  # whether Ctrl-C leaves the rows that are not solved, instead of ending everything


def attempted(
    ensemble: Ensemble,
    plans: Sequence[Plan],
    task: Task,
    means: Locally,
) -> Outcomes:
    """Solve the rows and return their outcomes; rows that failed are solved again as long as there are other
    attempts."""
    found = _solved(task, plans[0], means)
    for k, plan in enumerate(plans[1:], 1):
        failed = found.failed
        if failed.size and not found.interrupted:
            rest = ensemble.task(task.y0[failed], rows_of(task.args, failed), k)
            again = _solved(rest, plan, means._replace(report=None))
            found.replace(failed, again, k)
            found.interrupted |= again.interrupted
    return found


def _solved(task: Task, plan: Plan, means: Locally) -> Outcomes:
    means = means._replace(workers=min(means.workers, len(task.y0)))
    core = None if type(task.problem.fun) is FunctionType else solver(plan)  # which each row then has of its own
    if core is not None and core.native and _own_to_each(plan, task.args) is None and _fits_all(task):
        return _on_threads(task, plan, core, means)
    return _in_processes(task, plan, means)


def _own_to_each(plan: Plan, args: Any) -> str | None:
    """Return why each trajectory needs a plan of its own. None: all share one."""
    if plan.schedule is not None and plan.schedule.depends_on_args and not isinstance(args, tuple):
        return "f changes its branch at times that depend on args"
    if plan.varied is None:
        return None
    linear = plan.functions.linear
    if linear is not None and linear.algebraic:
        return "the start is moved onto algebraic equations, and tolerances of sensitivities with it"
    if plan.functions.delays is not None and plan.functions.delays.varied:
        return "the derivatives of the history depend on args"
    if callable(plan.varied.sizes.wanted.dy0dp):
        return "dy0dp is a function, which is called for each trajectory"
    return plan.varied.own_to_each


def _fits_all(task: Task) -> bool:
    """Return whether a problem that fits the method with the arguments of one row fits it with all."""
    return isinstance(task.args, tuple) or fits_any_args(task.problem, task.method)


# ----------------------------------------------------------------------------------------------------------------------
# On threads, in the core


def _on_threads(task: Task, plan: Plan, core: _core.Solver, means: Locally) -> Outcomes:
    y0 = np.ascontiguousarray(task.y0)
    solvers = [core, *(solver(plan) for _ in range(means.workers - 1))]
    series = None if plan.expansion is None else plan.expansion.in_lanes
    lanes = choose_lanes(core, plan.in_lanes(), series, len(y0)) if task.in_lanes else Lanes(reason="lanes=1")
    parameters = _parameters(task, plan)
    rows, tolerances = _augmented(plan, y0.view(float).reshape(len(y0), -1), parameters)
    with stopped_by_interrupt() if means.keep else nullcontext() as request:
        run = _core.integrate_all(solvers, rows, parameters, means.report, lanes.for_core(), tolerances, request)
    dtype = y0.dtype
    states, failures = run["states"], run["failures"]
    misshapen = _misshapen(task, failures)
    n, k = y0.shape[1], 0 if plan.varied is None else len(plan.varied.names)
    y, S = _apart(run["y"].view(dtype), n, k)
    y_end, S_end = _apart(run["y_end"].view(dtype), n, k)
    status = _CODES[states]
    status[list(misshapen)] = _RAISED
    y_end[status == _RAISED] = np.nan
    S_end[status == _RAISED] = np.nan
    found = Outcomes(
        y=y,
        y_end=y_end,
        status=status,
        messages=_messages(task, plan, failures, misshapen, states),
        events=[
            in_order(trajectory, t, points.view(dtype)[:, :n])
            for trajectory, t, points in run["events"][: plan.own_events]
        ],
        S=S,
        S_end=S_end,
        lanes=lanes.described(run["alone"]),
        **{name: run[name] for name in ROWS if name in run and name not in ("y", "y_end")},
    )
    if (left := np.flatnonzero(status == UNSOLVED)).size:
        found.leave(left)
    return found


def _augmented(plan: Plan, y0: Array, parameters: Array) -> tuple[Array, Array | None]:
    """Return the rows that the core starts from, and rows of tolerances of sensitivities, if there are any."""
    if plan.varied is None:
        return y0, None
    start, size = plan.varied.start.ravel(), len(y0)
    tolerances = plan.varied.sizes.at(y0, parameters).reshape(size, -1)
    return np.hstack([y0, np.broadcast_to(start, (size, len(start)))]), tolerances


def _apart(Y: Array, n: int, k: int) -> tuple[Array, Array]:
    """Return y (N, n, ...) and S (N, n, k, ...) of rows ((1 + k) n, ...)."""
    parts = Y.reshape(len(Y), 1 + k, n, *Y.shape[2:])
    return np.ascontiguousarray(parts[:, 0]), np.ascontiguousarray(np.swapaxes(parts[:, 1:], 1, 2))


def _parameters(task: Task, plan: Plan) -> Array:
    """Return the parameters of the native functions, one row for each trajectory."""
    size, p = len(task.y0), plan.functions.parameters
    if isinstance(task.args, tuple):
        same = np.empty((size, p.size))
        same[:] = p.numbers
        return same
    try:
        rows = np.ascontiguousarray(task.args, dtype=float).reshape(size, -1)
    except (ValueError, TypeError):  # arguments of different shapes, or that are no numbers
        rows = np.stack([native_parameters(row, [task.problem.fun]).numbers for row in task.args])
    # All trajectories must have the same values of arguments that are constants of compiled functions.
    others = [] if isinstance(task.args, np.ndarray) else map(layout_of, task.args)
    objection = p.objection(rows, plan.constants)
    if objection is None and any(one.fixed(TRUTHS) != p.fixed(TRUTHS) for one in others):
        objection = "arguments that are no numbers, or their shapes, differ from row to row"
    if objection is not None:
        raise ValueError(f"args of a compiled ensemble: {objection}. Compile one function for each, or pass floats")
    return rows


def _misshapen(task: Task, failures: Failures) -> dict[int, ValueError | IndexError]:
    """Trajectories whose f returns a wrong number of values, or one of whose functions has an index beyond an array,
    for which a single solve raises."""

    def args(i: int) -> tuple[Any, ...]:
        return task.args if isinstance(task.args, tuple) else tuple(task.args[i])

    errors = (
        (i, error_at_start(failure.state, task.problem, task.y0[i], args(i)))
        for i, failure in failures
        if failure.state.endswith("_undefined")
    )
    return {i: error for i, error in errors if error is not None}


def _messages(
    task: Task, plan: Plan, failures: Failures, misshapen: Mapping[int, Exception], states: Array
) -> dict[int, str]:
    """Return the messages of the trajectories that failed, by number, in ascending order."""
    messages: dict[int, str] = {}
    for i, failure in failures:
        exception = misshapen.get(i) or plan.exception(failure)
        messages[i] = plan.verdict(failure)[1] if exception is None else _as_text(exception)
    for i in np.flatnonzero(states == _NOT_FINITE).tolist():
        try:
            state(task.y0[i])
        except ValueError as error:
            messages[i] = _as_text(error)
    for code, verdict in _INCONSISTENT.items():
        text = f"ValueError: {inconsistent_start(verdict, plan.course.t0)}"
        messages.update(dict.fromkeys(np.flatnonzero(states == code).tolist(), text))
    return dict(sorted(messages.items()))


def _as_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


# ----------------------------------------------------------------------------------------------------------------------
# In processes


@dataclasses.dataclass
class _Outcome:
    trajectory: int
    status: int
    message: str
    row: dict[str, Any]  # of `Outcomes`, by the names of its arrays
    events: list[tuple[Array, Array]]
    error: BaseException | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "error": picklable(self.error)}


def _solve_one(task: Task, i: int) -> _Outcome:
    """Solve one trajectory; an exception in it becomes its status."""
    try:
        run, plan, own_plan = task.run(i)
        status, message = _STATUS.get(run.state, _RAISED), ""
        if status < 0 or plan.watch is not None:
            plan = own_plan()
            exception = plan.exception(run)
            status, message = plan.verdict(run) if exception is None else (_RAISED, _as_text(exception))
        elif plan.bound.specs:
            plan = own_plan()
        row = _row(plan, run)
        if status == _RAISED:
            del row["y_end"]
        events = []
        if plan.own_events:
            happened = run.take_events(plan.own_events)
            events = [(times, points[:, : plan.components].copy()) for times, points in happened]
        return _Outcome(i, status, message, row, events)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # sys.exit in a function too
        return _Outcome(i, _RAISED, _as_text(error), {}, [], error)


def _row(plan: Plan, run: _core.Run) -> dict[str, Any]:
    """Return the row of `Outcomes` of a trajectory, without what is as it was before the run."""
    row: dict[str, Any] = {"t_end": run.t_end, "y_end": run.end, "counts": run.counts, "correction": run.correction}
    bound, times = plan.bound, plan.course.times
    if plan.varied is not None:
        n, k = plan.components, len(plan.varied.names)
        row["y_end"], row["S_end"] = states_and_sensitivities(row["y_end"], n, k)
    if times is not None or len(bound):
        t, y = run.take_points()
        if plan.varied is not None:
            y, S = states_and_sensitivities(y, n, k)
            row["S"] = _at_times(plan, S)
        if times is not None:
            row["y"] = _at_times(plan, y)
    if run.remarkable:
        row["stiff_since"] = run.stiff_since if run.stiff else np.nan
        sticks = np.nan if run.sticks_since is None else run.sticks_since
        row["discontinuity"] = next(iter(run.discontinuities), sticks)
    if run.accumulation is not None:
        row["accumulation"] = run.accumulation[1]
    if run.clipped:
        row["clipped_amount"] = run.clipped
    if len(bound):
        bound = bound.jumped(run.jumps)
        counts = row["counts"] = np.array(run.counts)
        counts[_NG] += bound.evaluations  # before the run, as in a single run
        counts[_NGDIFF] += bound.evaluations - len(bound.specs)
        before, _, _ = run.drift
        pieces = np.append(bound.pieces_of_output(len(t)), len(bound.jumps))
        after = np.abs(bound.residual(np.append(t, run.t_end), np.column_stack([y, row["y_end"]]), pieces)).max(axis=1)
        row |= {"value": bound.value, "residual_before": before[: len(bound)], "residual_after": after}
    return row


def _at_times(plan: Plan, values: Array) -> Array:
    """Return the values at the output times, the last axis of an array of what the run came to; NaN at the others."""
    times = 0 if plan.course.times is None else len(plan.course.times)
    reached = min(values.shape[-1], times)
    found = np.full((*values.shape[:-1], times), np.nan, values.dtype)
    found[..., :reached] = values[..., :reached]
    return found


def unsolved(task: Task, plan: Plan) -> Outcomes:
    """Return the outcomes of rows that Ctrl-C left."""
    found = _unsolved(task, plan)
    found.events = [_events([], found.y_end) for _ in plan.called.events]
    found.leave(np.arange(len(found)))
    return found


def _unsolved(task: Task, plan: Plan) -> Outcomes:
    """Return the rows before they are solved: values that remain for rows that cannot be solved."""
    size, n = task.y0.shape
    times, m = plan.course.times, len(plan.bound)
    k, count = 0 if plan.varied is None else len(plan.varied.names), 0 if times is None else len(times)
    watched = None if plan.watch is None else "constraints that are left out as redundant are watched in Python"
    why = _own_to_each(plan, task.args) or watched or "functions are in Python"
    return Outcomes(
        y=np.full((size, n, count), np.nan, dtype=task.y0.dtype),
        S=np.full((size, n, k, count), np.nan, dtype=task.y0.dtype),
        S_end=np.full((size, n, k), np.nan, dtype=task.y0.dtype),
        t_end=np.full(size, plan.course.t0, dtype=float),
        y_end=np.full_like(task.y0, np.nan),
        status=np.full(size, _RAISED, dtype=np.int8),
        counts=np.zeros((size, len(_core.COUNTS)), dtype=np.int64),
        clipped_amount=np.zeros(size),
        stiff_since=np.full(size, np.nan),
        discontinuity=np.full(size, np.nan),
        accumulation=np.full(size, np.nan),
        messages={},
        events=[],
        value=np.full((size, m), np.nan),
        residual_before=np.zeros((size, m)),
        residual_after=np.zeros((size, m)),
        correction=np.zeros(size),
        lanes=Lanes(reason=why).described(),
    )


def _keep(found: Outcomes, one: _Outcome) -> None:
    """Store the outcome of one trajectory in its row."""
    i = one.trajectory
    found.status[i] = one.status
    if one.status < 0:
        found.messages[i] = one.message
    if one.error is not None and (found.error is None or i < found.error[0]):
        found.error = i, one.error
    if "value" in one.row and one.row["value"].shape != found.value[i].shape:
        raise ValueError(
            f"the invariants have {one.row['value'].size} values in row {i} of y0, and {found.value[i].size} in the "
            "first one: return as many everywhere"
        )
    for name, value in one.row.items():
        getattr(found, name)[i] = value


def _events(happened: list[tuple[int, Array, Array]], like: Array) -> EnsembleEvents:
    trajectory = np.repeat([i for i, _, _ in happened], [len(t) for _, t, _ in happened]).astype(np.int64)
    t = np.concatenate([np.zeros(0), *(t for _, t, _ in happened)])
    return in_order(trajectory, t, np.concatenate([like[:0], *(y for _, _, y in happened)]))


def _in_processes(task: Task, plan: Plan, means: Locally) -> Outcomes:
    found, done, workers = _unsolved(task, plan), 0, means.workers
    solved = np.zeros(len(task.y0), dtype=bool)
    happened: list[list[tuple[int, Array, Array]]] = [[] for _ in plan.called.events]
    if workers > 1 and not may_start():
        warn(
            "a daemonic process cannot start workers; solving in this process. Start it with daemon=False to use "
            "workers"
        )
        workers = 1
    try:
        with closing(_here(task) if workers == 1 else _here_and_elsewhere(task, workers)) as chunks:
            for outcomes in chunks:
                for one in outcomes:
                    _keep(found, one)
                    for these, (t, y) in zip(happened, one.events, strict=False):
                        these.append((one.trajectory, t, y))
                    solved[one.trajectory] = True
                done += len(outcomes)
                if means.report:
                    means.report(done)
    except KeyboardInterrupt:
        if not means.keep:
            raise
        found.leave(np.flatnonzero(~solved))
    found.messages = dict(sorted(found.messages.items()))
    found.events = [_events(these, found.y_end) for these in happened]
    return found


def _here(task: Task) -> Generator[list[_Outcome]]:
    for i in range(len(task.y0)):
        yield [_solve_one(task, i)]


def _here_and_elsewhere(task: Task, workers: int) -> Generator[list[_Outcome]]:
    """Solve rows in worker processes; where functions cannot end a process, what takes no longer than to start these is
    solved in this one."""
    first, end = 0, time.thread_time() + _PATIENCE  # a busy machine makes no row longer
    if task.first_here and task.only_calculates():
        for outcomes in _here(task):
            yield outcomes
            first += 1
            if time.thread_time() > end:
                break
    if first < len(task.y0):
        rest = solve_rows(partial(_solve_later, task, first), len(task.y0) - first, workers, partial(_died, first))
        with closing(rest) as chunks:
            yield from chunks


def _solve_later(task: Task, first: int, i: int) -> _Outcome:
    return _solve_one(task, first + i)


def _died(first: int, i: int) -> _Outcome:
    i += first
    return _Outcome(i, _RAISED, "the worker process died: fun ended the process, or memory ran out", {}, [])
