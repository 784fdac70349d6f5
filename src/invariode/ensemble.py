"""Many initial values or parameter sets of one problem, solved in parallel."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from functools import partial
from typing import Any, Literal, Unpack

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from ._arguments import (
    Array,
    call_name,
    extra_arguments,
    flag,
    interval,
    numbers,
    positive_integer,
    quietly,
    state,
    warn,
)
from ._docstrings import documented
from ._messages import harmful_projection, inconsistent_start
from ._options import TABLE, DescribingOptions, EnsembleOptions, Options, parted, table_of
from ._processes import may_start, solve_rows
from ._progress import bar
from ._types import EventsLike, Function, MethodName, Span
from .compiled import native_parameters
from .description import Description
from .ensemble_solution import EnsembleEvents, EnsembleSolution, EnsembleStats, Trajectories
from .events import to_events
from .invariants import AccuracyWarning, as_columns
from .lanes import Lanes, choose_lanes
from .plan import Plan, make_plan, solver
from .result import LIMIT_REACHED, default_labels

__all__ = ["EnsembleEvents", "EnsembleSolution", "EnsembleStats", "solve_ensemble"]

_STATUS = {
    "reached_end": 0,
    "terminal_event": 1,
    "stopped_by_callback": 2,
    "invariant_convicted": -2,
    "limit_reached": LIMIT_REACHED,
}
#: What a single solve ends with by an exception.
_RAISED = -4
_OF_SINGLE_RUNS = table_of(Options).keys() - table_of(EnsembleOptions).keys()
_EXCEPTIONS = (
    "invariant_refused",
    "start_contradicts",
    "start_out_of_bounds",
    "event_undefined",
    "action_undefined",
    "interrupted",
)
_NG, _NGDIFF, _DROPPED, _HARMED = (_core.COUNTS.index(name) for name in ("ng", "ngdiff", "dropped", "harmed"))
# States that only trajectories of an ensemble have.
_NOT_FINITE = -1
_INCONSISTENT = {-2: "not_found", -3: "index_too_high"}


@documented(options=table_of(EnsembleOptions))
def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike,
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    events: EventsLike = None,
    t_eval: ArrayLike | None = None,
    workers: int | None = None,
    lanes: Literal["auto", 1] = "auto",
    progress: bool = False,
    **options: Unpack[EnsembleOptions],
) -> EnsembleSolution:
    """Solves one problem from many initial values, or with many parameter sets, in parallel.

    The result is the same, bit for bit, for any number of workers, and the same as that of single solves. A trajectory
    that fails, also with an exception, gets a status and a message; the others go on.

    Parameters
    ----------
    fun, t_span, method, events
        As in `solve_ivp`.
    y0 : array_like of shape (N, n) or (n,)
        Initial states, one row per trajectory, or one for all.
    args : tuple, or array or list of shape (N, k), optional
        A tuple: the extra arguments of all trajectories. Rows: row i holds the k extra arguments of trajectory i;
        those of a list may be of any types.
    t_eval : array_like, optional
        Times of the output, sorted in the direction of integration. Default: the final states are kept, and no others.
    workers : int, optional
        Threads or processes. Default: the processors that this process may use.
    lanes : {'auto', 1}, default 'auto'
        With 'auto' explicit Runge-Kutta pairs integrate trajectories side by side in vector registers where they can,
        with the same result; 1: one at a time. ``stats.lanes`` tells which it was, and why.
    progress : bool, default False
        Whether a progress bar is shown (needs rich).

    Other Parameters
    ----------------
    {options}

    Returns
    -------
    EnsembleSolution

    Raises
    ------
    TypeError, ValueError
        What is wrong for all trajectories. With several processes on a platform that starts them afresh (not by fork):
        a function that cannot be pickled, such as a lambda or one defined in a function or a notebook.
    RuntimeError
        The processes end before they solve anything: they cannot import the functions.

    Notes
    -----
    An invariant without `value` is held at its initial value of each trajectory. The options are those of `solve_ivp`
    but for `dense_output` and `refine`.

    Where all functions are native (`invariode.compile` and the like), trajectories run on threads in the core, which
    take work from each other as they run out of it; memory is the result plus a few vectors per thread. Otherwise they
    run in processes, and each function must be importable there: on platforms without fork define it in a module, guard
    the script by ``if __name__ == "__main__":``, or give ``workers=1``, which stays in this process; so
    does, with a warning, an ensemble in a daemonic process. Workers end with this process, however it ends. The result
    takes 8 (n n_t + 2 n + 3 m) + 120 bytes per trajectory, and 8 (n + 2) per event that occurred.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def f(t, y, a):
    ...     return [a * y[0]]
    >>> out = iv.solve_ensemble(f, (0, 1), [1.0], args=[[-1.0], [-2.0]], workers=1, rtol=1e-8, atol=1e-10)
    >>> np.allclose(out.y_end[:, 0], np.exp([-1, -2]), rtol=1e-7)
    True
    """
    describing, running = parted(options, DescribingOptions)
    if any(event.at_start for event in to_events(events)):
        raise ValueError(
            "at_start is for single runs: evaluate the event at the initial states of an ensemble yourself"
        )
    described = _Described(fun, interval(t_span), events, describing)
    run_options = _options_of_each(running, t_eval)
    workers = positive_integer("workers", _processors() if workers is None else workers)
    rows, extra = _rows(y0, args)
    task = _Task(described, method, run_options, rows, extra, in_lanes=_side_by_side(lanes))
    if len(rows) == 0:
        raise ValueError("an ensemble needs at least one row of y0 or args")
    plan = task.first_plan()
    with bar(flag("progress", progress), "trajectories", len(rows)) as report:
        native = solver(plan).native
        return (_on_threads if native else _in_processes)(task, plan, min(workers, len(rows)), report)


def _options_of_each(given: Options, t_eval: ArrayLike | None) -> Options:
    """The options of each trajectory."""
    for name, value in given.items():
        if name in _OF_SINGLE_RUNS and not (np.isscalar(value) and value == TABLE[name].default):
            instead = "; give t_eval" if name in ("refine", "dense_output") else ""
            raise ValueError(f"{name} is not possible for an ensemble{instead}")
    options = given.copy()
    if t_eval is not None:
        options["t_eval"] = t_eval
        return options
    for name, kept in (("keep", given.get("keep")), ("save", given.get("save"))):
        if isinstance(kept, str) and kept in ("all", "outputs"):
            raise ValueError(f"{name}={kept!r} of an ensemble needs t_eval: trajectories have steps of their own")
    if options.get("save") is None:
        options["keep"] = "end"
    return options


def _side_by_side(lanes: Any) -> bool:
    if lanes == "auto":
        return True
    if lanes != 1 or isinstance(lanes, bool):
        raise ValueError(f'lanes must be "auto" or 1, got {lanes!r}')
    return False


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _rows(y0: ArrayLike, args: Any) -> tuple[Array, Any]:
    """The initial values as (N, n), and the extra arguments as a tuple, a list of such, or an array of rows."""
    states = numbers("y0", y0)
    if states.ndim not in (1, 2):
        raise ValueError(f"y0 of an ensemble must have shape (N, n) or (n,), got {states.shape}")
    if args is None or isinstance(args, tuple):
        return np.atleast_2d(states), extra_arguments(args)
    extra = [_row_of_arguments(row) for row in args] if isinstance(args, list) else np.asarray(args)
    if isinstance(extra, list) and len(set(map(len, extra))) > 1:
        raise ValueError(f"rows of args must be of one length, got lengths {sorted(set(map(len, extra)))}")
    if isinstance(extra, np.ndarray) and extra.ndim != 2:
        raise _no_rows(f"shape {extra.shape}")
    if states.ndim == 1:
        states = np.broadcast_to(states, (len(extra), len(states)))
    if len(states) != len(extra):
        raise ValueError(
            f"y0 has {len(states)} rows and args has {len(extra)}: give one row of args for each row of y0"
        )
    return states, extra


def _row_of_arguments(row: Any) -> tuple[Any, ...]:
    if isinstance(row, np.ndarray) and row.ndim > 0:
        return tuple(row.tolist())
    if isinstance(row, Sequence) and not isinstance(row, str):
        return tuple(row)
    raise _no_rows(f"{row!r} as a row")


def _no_rows(got: str) -> ValueError:
    return ValueError(f"args of an ensemble must be a tuple, for all trajectories, or rows of shape (N, k), got {got}")


@dataclasses.dataclass
class _Described:
    """What describes all trajectories."""

    fun: Any
    t_span: tuple[float, float]
    events: EventsLike
    others: DescribingOptions


@dataclasses.dataclass
class _Task:
    """What is to be solved; picklable if the functions are."""

    described: _Described
    method: MethodName
    options: Options
    y0: Array
    args: tuple[Any, ...] | list[tuple[Any, ...]] | Array  # of all, or of each
    in_lanes: bool = False  # if they can be

    def plan(self, i: int) -> Plan:
        args = self.args if isinstance(self.args, tuple) else self.args[i]
        if isinstance(args, np.ndarray):
            args = tuple(args.tolist())
        about = self.described
        problem = Description(about.fun, about.t_span, self.y0[i], args=args, events=about.events, **about.others)
        return make_plan(problem, self.method, self.options)

    def first_plan(self) -> Plan:
        """The plan of the first trajectory that has one. What fails for many is wrong for all, and raised."""
        many = 100
        first_error = None
        for i in range(min(many, len(self.y0))):
            try:
                return self.plan(i)
            except Exception as error:
                first_error = first_error or error
        assert first_error is not None
        raise first_error


def _solution(
    task: _Task, plan: Plan, y: Array, y_end: Array, counts: Array, clipped_amount: Array, lanes: str, **fields: Any
) -> EnsembleSolution:
    times = plan.settings.times
    if dropped := int((counts[:, _DROPPED] > 0).sum()):
        warn(f"invariants were redundant in {dropped} trajectories, and were left out there")
    _warn_harmed(plan, counts[fields["status"] >= 0, _HARMED])
    stats = dict(zip(_core.COUNTS, counts.T, strict=True))
    del stats["dropped"], stats["harmed"]
    return EnsembleSolution(
        t=np.array([plan.settings.tf]) if times is None else times,
        y=y_end[:, :, None].copy() if times is None else y,
        y_end=y_end,
        success=fields["status"] >= 0,
        stats=EnsembleStats(**stats, clipped_amount=clipped_amount, _lanes=lanes),
        _trajectories=_trajectories(plan, task),
        **fields,
    )


def _warn_harmed(plan: Plan, harmed: Array) -> None:
    """One warning for all trajectories that did not fail. `harmed`: 1 + the component that projection harmed, or 0."""
    some = harmed[harmed > 0]
    if not some.size:
        return
    names = default_labels(len(plan.y0))
    components = np.unique((some - 1) // (2 if plan.functions.complex else 1))
    much = f"much more than estimated errors in {some.size} trajectories"
    warn(harmful_projection(", ".join(names[i] for i in components), much), AccuracyWarning)


def _trajectories(plan: Plan, task: _Task) -> Trajectories:
    """What the results of single trajectories need to know."""
    acting = any(event.action is not None for event in plan.functions.events)
    return Trajectories(
        call_name(task.described.fun, "problem"),
        plan.event_names,
        plan.names[: len(plan.bound)],
        None if acting else plan.bound,
        task.args,
        plan.rtol,
        plan.atol,
    )


# ----------------------------------------------------------------------------------------------------------------------
# On threads, in the core


def _on_threads(task: _Task, plan: Plan, workers: int, report: Callable[[float], None] | None) -> EnsembleSolution:
    y0 = np.ascontiguousarray(task.y0)
    solvers = [solver(plan) for _ in range(workers)]
    lanes = choose_lanes(solvers[0], plan.functions.fun, len(y0)) if task.in_lanes else Lanes(reason="lanes=1")
    rows = y0.view(float).reshape(len(y0), -1)
    run = _core.integrate_all(solvers, rows, _parameters(task, plan), report, lanes.for_core())
    dtype = y0.dtype
    states = run.take_states()
    value, before, after, correction = run.take_drift()
    codes = np.array(
        [_STATUS.get(name, _RAISED if name in _EXCEPTIONS else -1) for name in _core.STATES], dtype=np.int8
    )
    return _solution(
        task,
        plan,
        y=run.take_y().view(dtype),
        t_end=run.take_t(),
        y_end=run.take_end().view(dtype),
        status=np.where(states < 0, np.int8(_RAISED), codes[states]),
        counts=run.take_counts(),
        clipped_amount=run.take_clipped(),
        messages=_messages(task, plan, run, states),
        lanes=lanes.described(run.alone),
        events=[_in_order(trajectory, t, y.view(dtype)) for trajectory, t, y in run.take_events()],
        value=value,
        residual_before=before,
        residual_after=after,
        correction=correction,
    )


def _parameters(task: _Task, plan: Plan) -> Array:
    """The parameters of the native functions, one row for each trajectory."""
    size, p = len(task.y0), plan.functions.parameters
    if isinstance(task.args, tuple):
        return np.ascontiguousarray(np.broadcast_to(p, (size, len(p))))
    try:
        return np.ascontiguousarray(task.args, dtype=float).reshape(size, -1)
    except ValueError:  # arguments of different shapes
        return np.stack([native_parameters(row, [task.described.fun]) for row in task.args])


def _messages(task: _Task, plan: Plan, run: _core.EnsembleRun, states: Array) -> dict[int, str]:
    """Why trajectories failed, in their order."""
    messages: dict[int, str] = {}
    for i, failure in run.failures():
        exception = plan.exception(failure)
        messages[i] = plan.verdict(failure)[1] if exception is None else _as_text(exception)
    for i in np.flatnonzero(states == _NOT_FINITE).tolist():
        try:
            state(task.y0[i])
        except ValueError as error:
            messages[i] = _as_text(error)
    for code, verdict in _INCONSISTENT.items():
        text = f"ValueError: {inconsistent_start(verdict, plan.settings.t0)}"
        messages.update(dict.fromkeys(np.flatnonzero(states == code).tolist(), text))
    return dict(sorted(messages.items()))


def _in_order(trajectory: Array, t: Array, y: Array) -> EnsembleEvents:
    """Occurrences as trajectories ended, by trajectory; those of each one are in order."""
    order = np.argsort(trajectory, kind="stable")
    return EnsembleEvents(trajectory[order], t[order], y[order])


def _as_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


# ----------------------------------------------------------------------------------------------------------------------
# In processes


@dataclasses.dataclass
class _Row:
    """A row of the result."""

    t_end: float
    y_end: Array
    y: Array
    counts: Array
    value: Array
    before: Array
    after: Array
    correction: float
    clipped_amount: float
    events: list[tuple[Array, Array]]


@dataclasses.dataclass
class _Outcome:
    trajectory: int
    status: int
    message: str
    run: _Row | None


def _solve_one(task: _Task, i: int) -> _Outcome:
    """One trajectory, with whatever goes wrong in it as its status."""
    try:
        with quietly():  # the first plan has said it
            plan = task.plan(i)
        run = solver(plan).integrate(plan.y0.view(float))
        exception = plan.exception(run)
        status, message = plan.verdict(run) if exception is None else (_RAISED, _as_text(exception))
        return _Outcome(i, status, message, _row(plan, run, task.y0.dtype))
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # sys.exit in a function too
        return _Outcome(i, _RAISED, _as_text(error), None)


def _row(plan: Plan, run: _core.Run, dtype: np.dtype[Any]) -> _Row:
    bound = plan.bound
    if jumps := run.take_jumps():
        bound = bound.jumped(jumps, forward=plan.settings.forward)
    t, rows, t_end, end = run.take_points()
    y = as_columns(rows, dtype)
    y_end = y[:, -1] if end is None else end.view(dtype)
    counts = np.array(run.counts)
    counts[_NG] += bound.evaluations  # before the run, as in a single run
    counts[_NGDIFF] += bound.evaluations - len(bound.specs)
    before, _, correction = run.take_drift()
    after = np.zeros(len(bound))
    if len(bound):
        at_outputs = bound.residual(t, y, bound.pieces_of_output(len(t)))
        at_end = bound.residual(np.array([t_end]), y_end[:, None], np.array([len(bound.jumps)]))
        after = np.abs(np.hstack([at_outputs, at_end])).max(axis=1)
    return _Row(
        t_end=t_end,
        y_end=y_end,
        y=y if plan.settings.times is not None else y[:, :0],
        counts=counts,
        value=bound.value,
        before=before[: len(bound)],
        after=after,
        correction=correction,
        clipped_amount=run.clipped,
        events=[(times, points.view(dtype)) for times, points in run.take_events()],
    )


class _Rows:
    """The rows of the result, filled as trajectories end."""

    def __init__(self, task: _Task, plan: Plan) -> None:
        size, n = task.y0.shape
        times, m = plan.settings.times, len(plan.bound)
        self.task, self.plan = task, plan
        self.y = np.full((size, n, 0 if times is None else len(times)), np.nan, dtype=task.y0.dtype)
        self.t_end, self.y_end = np.full(size, plan.settings.t0, dtype=float), task.y0.copy()
        self.status = np.full(size, _RAISED, dtype=np.int8)
        self.counts = np.zeros((size, len(_core.COUNTS)), dtype=np.int64)
        self.value = np.full((size, m), np.nan)
        self.before, self.after, self.correction = np.zeros((size, m)), np.zeros((size, m)), np.zeros(size)
        self.clipped_amount = np.zeros(size)
        self.messages: dict[int, str] = {}
        self.found: list[list[tuple[int, Array, Array]]] = [[] for _ in plan.event_names]

    def keep(self, outcome: _Outcome) -> None:
        """What one trajectory came to."""
        i = outcome.trajectory
        if outcome.status < 0:
            self.messages[i] = outcome.message
        self.status[i] = outcome.status
        if outcome.run is None:
            return
        one = outcome.run
        self.t_end[i], self.y_end[i] = one.t_end, one.y_end
        self.y[i, :, : one.y.shape[1]] = one.y
        self.counts[i] = one.counts
        self.value[i], self.before[i], self.after[i] = one.value, one.before, one.after
        self.correction[i] = one.correction
        self.clipped_amount[i] = one.clipped_amount
        for found, (t, y) in zip(self.found, one.events, strict=True):
            if len(t):
                found.append((i, t, y))

    def solution(self) -> EnsembleSolution:
        return _solution(
            self.task,
            self.plan,
            y=self.y,
            t_end=self.t_end,
            y_end=self.y_end,
            status=self.status,
            counts=self.counts,
            clipped_amount=self.clipped_amount,
            messages=dict(sorted(self.messages.items())),
            lanes=Lanes(reason="functions are Python's").described(),
            events=[self._events(found) for found in self.found],
            value=self.value,
            residual_before=self.before,
            residual_after=self.after,
            correction=self.correction,
        )

    def _events(self, found: list[tuple[int, Array, Array]]) -> EnsembleEvents:
        trajectory = np.repeat([i for i, _, _ in found], [len(t) for _, t, _ in found]).astype(np.int64)
        t = np.concatenate([np.zeros(0), *(t for _, t, _ in found)])
        y = np.concatenate([np.zeros((0, self.y_end.shape[1]), self.y_end.dtype), *(y for _, _, y in found)])
        return _in_order(trajectory, t, y)


def _in_processes(task: _Task, plan: Plan, workers: int, report: Callable[[float], None] | None) -> EnsembleSolution:
    rows, done = _Rows(task, plan), 0
    if workers > 1 and not may_start():
        warn("a daemonic process cannot start workers, and solves the ensemble alone: start it with daemon=False")
        workers = 1
    with closing(_here(task) if workers == 1 else _elsewhere(task, workers)) as chunks:
        for outcomes in chunks:
            for outcome in outcomes:
                rows.keep(outcome)
            done += len(outcomes)
            if report:
                report(done)
    return rows.solution()


def _here(task: _Task) -> Generator[list[_Outcome]]:
    for i in range(len(task.y0)):
        yield [_solve_one(task, i)]


def _elsewhere(task: _Task, workers: int) -> Generator[list[_Outcome]]:
    return solve_rows(partial(_solve_one, task), len(task.y0), workers, _died)


def _died(i: int) -> _Outcome:
    return _Outcome(i, _RAISED, "the worker process died: fun ended the process, or memory ran out", None)
