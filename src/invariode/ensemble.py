"""Many initial values or parameter sets of one problem, solved in parallel."""

from __future__ import annotations

import dataclasses
import os
import pickle
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import lru_cache, partial
from time import perf_counter
from typing import Any, Literal, NamedTuple, TypeAlias, Unpack, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from ._arguments import (
    Array,
    call_name,
    extra_arguments,
    flag,
    interval,
    items,
    numbers,
    positive_integer,
    quietly,
    shown,
    state,
    warn,
)
from ._docstrings import documented
from ._identity import identity
from ._messages import harmful_projection, inconsistent_start
from ._options import TABLE, DescribingOptions, EnsembleOptions, Options, parted, table_of
from ._outcomes import Outcomes, counts_by_name, in_order, joined
from ._parts import (
    GivenRows,
    Part,
    Rows,
    StreamedRows,
    on_executor,
    packed,
    places_of,
    rejoined,
    rows_of,
    shares_memory,
)
from ._processes import may_start, solve_rows
from ._progress import bar
from ._types import EventsLike, Function, MethodName, Span
from .compiled import native_parameters
from .description import Description
from .ensemble_solution import EnsembleEvents, EnsembleSolution, EnsembleStats, Trajectories
from .ensemble_store import EnsembleStore, Layout, StoreWriter, parameter_names
from .events import to_events
from .invariants import AccuracyWarning
from .lanes import Lanes, choose_lanes
from .plan import Plan, make_plan, solver
from .result import LIMIT_REACHED, DiscontinuityWarning, StiffnessWarning, default_labels

__all__ = ["EnsembleEvents", "EnsembleSolution", "EnsembleStats", "solve_ensemble"]

Retry: TypeAlias = Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""Options for trajectories that failed."""

_STATUS = {
    "reached_end": 0,
    "terminal_event": 1,
    "stopped_by_callback": 2,
    "invariant_convicted": -2,
    "limit_reached": LIMIT_REACHED,
}
#: What a single solve ends with by an exception.
_RAISED = -4
_DESCRIBING = table_of(DescribingOptions).keys()
#: What another attempt at trajectories that failed may change.
_OF_RETRIES = table_of(EnsembleOptions).keys() - _DESCRIBING - {"keep", "save", "callback", "breakpoints"}
_OF_SINGLE_RUNS = table_of(Options).keys() - table_of(EnsembleOptions).keys()
_EXCEPTIONS = (
    "invariant_refused",
    "start_contradicts",
    "start_out_of_bounds",
    "event_undefined",
    "action_undefined",
    "interrupted",
)
#: The status for each state; states of ensembles only are negative and count from the end.
_CODES = np.array(
    [_STATUS.get(name, _RAISED if name in _EXCEPTIONS else -1) for name in _core.STATES] + 3 * [_RAISED], dtype=np.int8
)
_NG, _NGDIFF, _DROPPED, _HARMED, _STIFF = (
    _core.COUNTS.index(name) for name in ("ng", "ngdiff", "dropped", "harmed", "stiff")
)
# States that only trajectories of an ensemble have.
_NOT_FINITE = -1
_INCONSISTENT = {-2: "not_found", -3: "index_too_high"}


@overload
def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike | Iterator[tuple[ArrayLike, Any]],
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    events: EventsLike = None,
    t_eval: ArrayLike | None = None,
    workers: int | None = None,
    lanes: Literal["auto", 1] = "auto",
    progress: bool = False,
    executor: Any = None,
    store: None = None,
    resume: bool = False,
    retry: Retry | None = None,
    chunk: int | None = None,
    seed: Any = None,
    **options: Unpack[EnsembleOptions],
) -> EnsembleSolution: ...
@overload
def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike | Iterator[tuple[ArrayLike, Any]],
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    events: EventsLike = None,
    t_eval: ArrayLike | None = None,
    workers: int | None = None,
    lanes: Literal["auto", 1] = "auto",
    progress: bool = False,
    executor: Any = None,
    store: str | os.PathLike[str],
    resume: bool = False,
    retry: Retry | None = None,
    chunk: int | None = None,
    seed: Any = None,
    **options: Unpack[EnsembleOptions],
) -> EnsembleStore: ...
@documented(options=table_of(EnsembleOptions))
def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike | Iterator[tuple[ArrayLike, Any]],
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    events: EventsLike = None,
    t_eval: ArrayLike | None = None,
    workers: int | None = None,
    lanes: Literal["auto", 1] = "auto",
    progress: bool = False,
    executor: Any = None,
    store: str | os.PathLike[str] | None = None,
    resume: bool = False,
    retry: Retry | None = None,
    chunk: int | None = None,
    seed: Any = None,
    **options: Unpack[EnsembleOptions],
) -> EnsembleSolution | EnsembleStore:
    """Solves one problem from many initial values, or with many parameter sets, in parallel.

    The result is the same, bit for bit, for any number of workers, and the same as that of single solves. A trajectory
    that fails, also with an exception, gets a status and a message; the others go on.

    Parameters
    ----------
    fun, t_span, method, events
        As in `solve_ivp`.
    y0 : array_like of shape (N, n) or (n,), or iterator
        Initial states, one row per trajectory, or one for all. An iterator yields pairs ``(y0, args)`` of one
        trajectory, with a tuple of args, or of several, with rows; N need not be known, nor fit in memory.
    args : tuple, or array or list of shape (N, k), optional
        A tuple: the extra arguments of all trajectories. Rows: row i holds the k extra arguments of trajectory i;
        those of a list may be of any types.
    t_eval : array_like, optional
        Times of the output, sorted in the direction of integration. Default: the final states are kept, and no others.
    workers : int, optional
        Threads or processes. Default: the processors that this process may use. With an executor: threads that each of
        its places uses at once. Default: 1.
    lanes : {'auto', 1}, default 'auto'
        With 'auto', explicit Runge-Kutta pairs integrate trajectories of compiled functions side by side in vector
        registers where they can, with the same result; 1: one at a time. ``stats.lanes`` says which it was, and why.
    progress : bool, default False
        Whether a progress bar is shown (outside notebooks by rich).
    executor : concurrent.futures.Executor or distributed.Client, optional
        Who solves the trajectories, in parts of `chunk`: processes of this machine, or a cluster by way of Dask.
        Functions travel: compiled ones are compiled again where they arrive; with cloudpickle, of the extra
        `cluster`, those of the script itself travel too.
    store : str or path-like, optional
        A Zarr store for the results, written part by part: memory does not grow with N. Needs zarr, of the extra
        `cluster`.
    resume : bool, default False
        Whether a store that is there already is gone on with: what it has is not solved again.
    retry : dict or list of dict, optional
        Options with which trajectories that failed are solved again, ``{"method": "radau", "rtol": 1e-9}``, one after
        the other until one attempt succeeds; what it does not name stays.
    chunk : int, optional
        Trajectories in a part. Default: as many as take a second, judged by the first ones, on executors of more than
        50 places a fiftieth of a second for each of them; at most 32 MiB.
    seed : int, list of int or str, optional
        What made the random rows, for the record: it is kept in the attributes of the store.

    Other Parameters
    ----------------
    {options}

    Returns
    -------
    EnsembleSolution or EnsembleStore
        The second with a `store`.

    Raises
    ------
    FileExistsError
        There is a store of this name, and not `resume`.
    TypeError, ValueError
        What is wrong for all trajectories; a store is of another problem. With several processes on a platform that
        starts them afresh (not by fork): a function that cannot be pickled, such as a lambda or one defined in a
        function or a notebook.
    RuntimeError
        The processes end before they solve anything: they cannot import the functions. An executor lost its processes
        and cannot start others.

    Notes
    -----
    An invariant without `value` is held at its initial value of each trajectory. The options are those of `solve_ivp`
    but for `dense_output` and `refine`.

    Where all functions are native (`invariode.compile` and the like), trajectories run on threads in the core, which
    take work from each other as they run out of it; memory is the result plus a few vectors per thread. Otherwise they
    run in processes, and each function must be importable there: on platforms without fork define it in a module, guard
    the script by ``if __name__ == "__main__":``, or give ``workers=1``, which stays in this process; so
    does, with a warning, an ensemble in a daemonic process. Workers end with this process, however it ends. The result
    takes 8 (n n_t + 2 n + 3 m) + 136 bytes per trajectory, and 8 (n + 2) per event that occurred.

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
    ensemble = _Ensemble(described, _attempts(method, _options_of_each(running, t_eval), retry), _side_by_side(lanes))
    drawn = flag("progress", progress)
    if executor is None and store is None and not isinstance(y0, Iterator):
        if chunk is not None or seed is not None or flag("resume", resume):
            raise ValueError("chunk, seed and resume are for ensembles with an executor or a store: give store= too")
        workers = positive_integer("workers", _processors() if workers is None else workers)
        return _at_once(ensemble, *_rows(y0, args), workers, drawn)
    rows = _source(y0, args)
    means = _Means(executor, _threads_of_part(executor, workers), drawn, chunk)
    if store is not None:
        return _stored(ensemble, rows, means, _Place(store, flag("resume", resume), seed))
    if seed is not None or resume:
        raise ValueError("seed and resume are for results in a store: give store= too")
    return _in_parts(ensemble, rows, means)


def _at_once(ensemble: _Ensemble, y0: Array, args: Any, workers: int, shown: bool) -> EnsembleSolution:
    """All rows, on this machine."""
    task = ensemble.task(y0, args)
    first, plan = _first_plan(task)
    plans = [plan, *(ensemble.task(y0, args, k).plan(first) for k in range(1, len(ensemble.attempts)))]
    with bar(shown, "trajectories", len(y0)) as report:
        return _solution(task, plan, _attempted(ensemble, plans, y0, args, workers, report))


def _attempts(method: MethodName, options: Options, retry: Retry | None) -> list[_Attempt]:
    """With which method and options rows are solved, and solved again if they failed."""
    attempts = [_Attempt(method, options)]
    for given in [] if retry is None else [retry] if isinstance(retry, Mapping) else items(retry) or [retry]:
        if not isinstance(given, Mapping):
            raise TypeError(f"retry must be a dict of options, or a list of such, got {shown(given)}")
        other = dict(given)
        with_method = other.pop("method", method)
        for name in other:
            if name not in _OF_RETRIES:
                raise ValueError(f"retry cannot change {name!r}; choose from method, {', '.join(sorted(_OF_RETRIES))}")
        attempts.append(_Attempt(with_method, cast("Options", {**options, **other})))
    return attempts


def _options_of_each(given: Options, t_eval: ArrayLike | None) -> Options:
    """The options of each trajectory."""
    for name, value in given.items():
        if name in _OF_SINGLE_RUNS and not (value is None or (np.isscalar(value) and value == TABLE[name].default)):
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
    in_lanes: bool

    def plan(self, i: int) -> Plan:
        args = self.args if isinstance(self.args, tuple) else self.args[i]
        if isinstance(args, np.ndarray):
            args = tuple(args.tolist())
        about = self.described
        problem = Description(about.fun, about.t_span, self.y0[i], args=args, events=about.events, **about.others)
        return make_plan(problem, self.method, self.options)


@dataclasses.dataclass
class _Attempt:
    """A method with options."""

    method: MethodName
    options: Options


@dataclasses.dataclass
class _Ensemble:
    """What is to be solved, but for the rows; picklable if the functions are."""

    described: _Described
    attempts: list[_Attempt]  # the first, and those for rows that failed
    in_lanes: bool  # if they can be

    def task(self, y0: Array, args: Any, attempt: int = 0) -> _Task:
        """These rows, by one of the attempts."""
        chosen = self.attempts[attempt]
        return _Task(self.described, chosen.method, chosen.options, y0, args, self.in_lanes)


def _first_plan(task: _Task) -> tuple[int, Plan]:
    """The first trajectory that has a plan, and the plan. What fails for many is wrong for all, and raised."""
    many = 100
    first_error = None
    if len(task.y0) == 0:
        raise ValueError("an ensemble needs at least one row of y0 or args")
    for i in range(min(many, len(task.y0))):
        try:
            return i, task.plan(i)
        except Exception as error:
            first_error = first_error or error
    assert first_error is not None
    raise first_error


def _attempted(
    ensemble: _Ensemble,
    plans: Sequence[Plan],
    y0: Array,
    args: Any,
    workers: int,
    report: Callable[[float], None] | None = None,
) -> Outcomes:
    """What the rows came to; those that failed are solved again as long as there are other attempts."""
    found = _solved(ensemble.task(y0, args), plans[0], workers, report)
    for k, plan in enumerate(plans[1:], 1):
        failed = found.failed
        if failed.size:
            again = ensemble.task(y0[failed], rows_of(args, failed), k)
            found.replace(failed, _solved(again, plan, workers), k)
    return found


def _solved(task: _Task, plan: Plan, workers: int, report: Callable[[float], None] | None = None) -> Outcomes:
    core, workers = solver(plan), min(workers, len(task.y0))
    return _on_threads(task, plan, core, workers, report) if core.native else _in_processes(task, plan, workers, report)


def _solution(task: _Task, plan: Plan, found: Outcomes) -> EnsembleSolution:
    times = plan.settings.times
    if plan.names:
        dropped = int((found.counts[:, _DROPPED] > 0).sum())
        _warn_of_projection(plan, dropped, found.counts[found.status >= 0, _HARMED])
    _warn_stiff(plan, int(found.counts[:, _STIFF].sum()))
    _warn_discontinuous(plan, int(np.isfinite(found.discontinuity).sum()))
    return EnsembleSolution(
        t=np.array([plan.settings.tf]) if times is None else times,
        y=found.y_end[:, :, None].copy() if times is None else found.y,
        t_end=found.t_end,
        y_end=found.y_end,
        status=found.status,
        success=found.status >= 0,
        messages=found.messages,
        events=found.events,
        stats=EnsembleStats(
            **counts_by_name(found.counts),
            clipped_amount=found.clipped_amount,
            stiff_since=found.stiff_since,
            discontinuity=found.discontinuity,
            _lanes=found.lanes,
        ),
        value=found.value,
        residual_before=found.residual_before,
        residual_after=found.residual_after,
        correction=found.correction,
        attempt=found.attempt,
        _trajectories=_trajectories(plan, task),
    )


def _warn_of_projection(plan: Plan, dropped: int, harmed: Array) -> None:
    if dropped:
        warn(f"invariants were redundant in {dropped} trajectories, and were left out there")
    _warn_harmed(plan, harmed)


def _warn_stiff(plan: Plan, count: int) -> None:
    if count:
        text = f"in {count} trajectories stability, not accuracy, limits most steps (stats['stiff'] tells in which)"
        warn(f"{plan.method.name}: {text}; try ode15s", StiffnessWarning)


def _warn_discontinuous(plan: Plan, count: int) -> None:
    if count:
        text = f"in {count} trajectories fun looks discontinuous (stats['discontinuity'] tells where at first)"
        what = "give breakpoints, or an event with an action where y decides when it jumps"
        warn(f"{plan.method.name}: {text}, where steps fail; {what}", DiscontinuityWarning)


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


def _on_threads(
    task: _Task, plan: Plan, core: _core.Solver, workers: int, report: Callable[[float], None] | None
) -> Outcomes:
    y0 = np.ascontiguousarray(task.y0)
    solvers = [core, *(solver(plan) for _ in range(workers - 1))]
    lanes = choose_lanes(core, plan.functions.in_lanes(), len(y0)) if task.in_lanes else Lanes(reason="lanes=1")
    rows = y0.view(float).reshape(len(y0), -1)
    run = _core.integrate_all(solvers, rows, _parameters(task, plan), report, lanes.for_core())
    dtype = y0.dtype
    states = run.take_states()
    value, before, after, correction = run.take_drift()
    stiff_since, discontinuity = run.take_remarks()
    return Outcomes(
        y=run.take_y().view(dtype),
        t_end=run.take_t(),
        y_end=run.take_end().view(dtype),
        status=_CODES[states],
        counts=run.take_counts(),
        clipped_amount=run.take_clipped(),
        stiff_since=stiff_since,
        discontinuity=discontinuity,
        messages=_messages(task, plan, run, states),
        events=[in_order(trajectory, t, y.view(dtype)) for trajectory, t, y in run.take_events()],
        value=value,
        residual_before=before,
        residual_after=after,
        correction=correction,
        lanes=lanes.described(run.alone),
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
    if len(states) and not (_CODES[states] < 0).any():
        return messages
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
    stiff_since: float
    discontinuity: float
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
    t, y, t_end, y_end = run.take_points()
    counts = np.array(run.counts)
    counts[_NG] += bound.evaluations  # before the run, as in a single run
    counts[_NGDIFF] += bound.evaluations - len(bound.specs)
    before, _, correction = run.take_drift()
    after = np.zeros(len(bound))
    if len(bound):
        pieces = np.append(bound.pieces_of_output(len(t)), len(bound.jumps))
        after = np.abs(bound.residual(np.append(t, t_end), np.column_stack([y, y_end]), pieces)).max(axis=1)
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
        stiff_since=run.stiff_since if run.stiff else np.nan,
        discontinuity=next(iter(run.discontinuities), np.nan),
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
        self.stiff_since, self.discontinuity = np.full(size, np.nan), np.full(size, np.nan)
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
        self.stiff_since[i], self.discontinuity[i] = one.stiff_since, one.discontinuity
        for found, (t, y) in zip(self.found, one.events, strict=True):
            if len(t):
                found.append((i, t, y))

    def outcomes(self) -> Outcomes:
        return Outcomes(
            y=self.y,
            t_end=self.t_end,
            y_end=self.y_end,
            status=self.status,
            counts=self.counts,
            clipped_amount=self.clipped_amount,
            stiff_since=self.stiff_since,
            discontinuity=self.discontinuity,
            messages=dict(sorted(self.messages.items())),
            events=[self._events(found) for found in self.found],
            value=self.value,
            residual_before=self.before,
            residual_after=self.after,
            correction=self.correction,
            lanes=Lanes(reason="functions are in Python").described(),
        )

    def _events(self, found: list[tuple[int, Array, Array]]) -> EnsembleEvents:
        trajectory = np.repeat([i for i, _, _ in found], [len(t) for _, t, _ in found]).astype(np.int64)
        t = np.concatenate([np.zeros(0), *(t for _, t, _ in found)])
        y = np.concatenate([np.zeros((0, self.y_end.shape[1]), self.y_end.dtype), *(y for _, _, y in found)])
        return in_order(trajectory, t, y)


def _in_processes(task: _Task, plan: Plan, workers: int, report: Callable[[float], None] | None) -> Outcomes:
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
    return rows.outcomes()


def _here(task: _Task) -> Generator[list[_Outcome]]:
    for i in range(len(task.y0)):
        yield [_solve_one(task, i)]


def _elsewhere(task: _Task, workers: int) -> Generator[list[_Outcome]]:
    return solve_rows(partial(_solve_one, task), len(task.y0), workers, _died)


def _died(i: int) -> _Outcome:
    return _Outcome(i, _RAISED, "the worker process died: fun ended the process, or memory ran out", None)


# ----------------------------------------------------------------------------------------------------------------------
# In parts: on executors, and into stores

#: Seconds that a part should take, and the seconds that it may take to find that out.
_PART, _PILOT = 1.0, 0.1
#: Twice the seconds that client and scheduler need for a part, one after the other (measured in benchmarks/many.py).
_HANDLING = 0.02
#: Trajectories that the pilot solves at most, and bytes of a part.
_PILOTS, _LARGEST = 256, 32 * 2**20


class _Means(NamedTuple):
    """Who solves the parts."""

    executor: Any
    workers: int  # threads for each part
    shown: bool  # a progress bar
    chunk: int | None  # trajectories in a part


class _Place(NamedTuple):
    """Where results go."""

    store: Any
    resume: bool
    seed: Any


def _threads_of_part(executor: Any, workers: int | None) -> int:
    """An executor has a place for each processor, or should have."""
    if workers is None:
        return _processors() if executor is None else 1
    return positive_integer("workers", workers)


def _source(y0: Any, args: Any) -> Rows:
    if not isinstance(y0, Iterator):
        return GivenRows(*_rows(y0, args))
    if args is not None:
        raise ValueError("an iterator of an ensemble yields (y0, args): leave out args")
    return StreamedRows(y0, _rows)


class _Packed(NamedTuple):
    """An ensemble with a row that has a plan, as it travels."""

    ensemble: _Ensemble
    y0: Array  # (1, n)
    args: Any

    def plans(self) -> list[Plan]:
        return [self.ensemble.task(self.y0, self.args, k).plan(0) for k in range(len(self.ensemble.attempts))]


class _Prepared(NamedTuple):
    """An ensemble with a plan for each attempt."""

    ensemble: _Ensemble
    plans: list[Plan]


@lru_cache(maxsize=4)
def _unpacked(data: bytes) -> _Prepared:
    """What travelled, with its plans: functions are compiled once in a process."""
    found: _Packed = pickle.loads(data)
    with quietly():  # where it comes from has said it
        return _Prepared(found.ensemble, found.plans())


def _solve_part(what: bytes | _Prepared, y0: Array, args: Any, workers: int) -> Outcomes:
    """The rows of a part, where an executor solves them."""
    with quietly():
        return _attempted(*(_unpacked(what) if isinstance(what, bytes) else what), y0, args, workers)


def _seconds(solve: Callable[[Array, Any], object], y0: Array, args: Any) -> float:
    """How long one of the first trajectories takes."""
    solve(y0[:1], rows_of(args, slice(1)))  # the first time functions are compiled
    k = 1
    while True:
        start = perf_counter()
        solve(y0[:k], rows_of(args, slice(k)))
        seconds = perf_counter() - start
        if seconds > _PILOT or k >= len(y0):
            return seconds / k
        k = min(4 * k, len(y0))


def _seconds_of_one(what: bytes | _Prepared, y0: Array, args: Any) -> float:
    """The same, where an executor solves them."""
    return _seconds(lambda y0, args: _solve_part(what, y0, args, 1), y0, args)


class _Parted:
    """An ensemble that is solved part by part."""

    def __init__(self, ensemble: _Ensemble, rows: Rows, means: _Means) -> None:
        self.ensemble, self.rows, self.means = ensemble, rows, means
        y0, args = rows.first(_PILOTS)
        first, self.plan = _first_plan(ensemble.task(y0, args))
        one = _Packed(ensemble, y0[first : first + 1], rows_of(args, slice(first, first + 1)))
        self._here = _Prepared(ensemble, [self.plan, *one.plans()[1:]])
        alone = means.executor is None or shares_memory(means.executor)
        self._sent = self._here if alone else packed(one)
        self._pilot = y0, args

    def length(self) -> int:
        """Trajectories in a part: as many as take a second, on large clusters longer: the scheduler is to keep up."""
        if self.means.chunk is not None:
            return positive_integer("chunk", self.means.chunk)
        y0, args = self._pilot
        if self.means.executor is None:
            alone = 1 if solver(self.plan).native else min(2, self.means.workers)  # fun may end its process
            seconds = _seconds(lambda y0, args: self._solved_here(y0, args, alone), y0, args)
        else:
            rows = Part(0, 0, y0, args)
            ((_, seconds),) = on_executor(self.means.executor, _seconds_of_one, self._arguments, [rows])
        n, m, times = y0.shape[1], len(self.plan.bound), self.plan.settings.times
        row = y0.itemsize * n * (2 + (0 if times is None else len(times))) + 24 * m + 136
        most: int = max(1, _LARGEST // row)
        size = most if self.rows.size is None else min(most, self.rows.size)
        enough = max(_PART, _HANDLING * places_of(self.means.executor))
        wanted = int(enough * self.means.workers / max(seconds, 1e-9))
        return max(1, min(wanted, size))

    def _arguments(self, part: Part) -> tuple[Any, ...]:
        return self._sent, part.y0, part.args

    def _solved_here(self, y0: Array, args: Any, workers: int) -> Outcomes:
        with quietly():  # the first plan has said it
            return _attempted(*self._here, y0, args, workers)

    def outcomes(self, parts: Iterator[Part]) -> Generator[tuple[Part, Outcomes]]:
        """Those of each part, as parts are finished."""
        means = self.means
        if means.executor is None:
            for part in parts:
                yield part, self._solved_here(part.y0, part.args, means.workers)
            return
        yield from on_executor(means.executor, _solve_part, lambda part: (*self._arguments(part), means.workers), parts)


def _in_parts(ensemble: _Ensemble, rows: Rows, means: _Means) -> EnsembleSolution:
    """All rows on an executor, or from an iterator, with their results in memory."""
    run = _Parted(ensemble, rows, means)
    done: list[tuple[Part, Outcomes]] = []
    with (
        bar(means.shown, "trajectories", rows.size) as report,
        closing(run.outcomes(rows.parts(run.length()))) as found,
    ):
        for one in found:
            done.append(one)
            if report:
                report(sum(len(part.y0) for part, _ in done))
    done.sort(key=lambda one: one[0].number)
    return _solution(
        ensemble.task(*rejoined([part for part, _ in done])), run.plan, joined([outcomes for _, outcomes in done])
    )


def _stored(ensemble: _Ensemble, rows: Rows, means: _Means, place: _Place) -> EnsembleStore:
    """All rows, with their results in a store."""
    run = _Parted(ensemble, rows, means)
    writer = StoreWriter(place.store, _layout(run), run.length, rows.size, identity(place.seed), place.resume)
    if means.chunk not in (None, writer.length):
        raise ValueError(f"the store has parts of {writer.length} trajectories, got chunk={means.chunk}: leave it out")
    size = done = dropped = stiff = discontinuous = 0
    harmed: list[Array] = []

    def counted() -> Iterator[Part]:
        nonlocal size
        for part in rows.parts(writer.length):
            size = part.start + len(part.y0)
            yield part

    with (
        bar(means.shown, "trajectories", rows.size) as report,
        closing(run.outcomes(writer.missing(counted()))) as found,
    ):
        for part, outcomes in found:
            writer.write(part, outcomes)
            dropped += int((outcomes.counts[:, _DROPPED] > 0).sum())
            harms = outcomes.counts[outcomes.status >= 0, _HARMED]
            harmed.append(harms[harms > 0])
            stiff += int(outcomes.counts[:, _STIFF].sum())
            discontinuous += int(np.isfinite(outcomes.discontinuity).sum())
            done += len(part.y0)
            if report:
                report(done)
    writer.finish(size)
    _warn_of_projection(run.plan, dropped, np.concatenate([np.zeros(0, dtype=np.int64), *harmed]))
    _warn_stiff(run.plan, stiff)
    _warn_discontinuous(run.plan, discontinuous)
    return EnsembleStore(place.store)


def _layout(run: _Parted) -> Layout:
    plan, described, attempts = run.plan, run.ensemble.described, run.ensemble.attempts
    y0, args = run.rows.first(1)
    defaults = {name: row.default for name, row in table_of(EnsembleOptions).items() if name not in _DESCRIBING}
    about = {
        "fun": described.fun,
        "t_span": described.t_span,
        "size of y": y0.shape[1],
        "method": attempts[0].method,
        "options": {**defaults, **attempts[0].options},
        "retry": [{"method": one.method, "options": one.options} for one in attempts[1:]],
        "events": to_events(described.events),
        **described.others,
        **({"args": args} if isinstance(args, tuple) else {}),
    }
    times = plan.settings.times
    names = {
        "component": default_labels(y0.shape[1]),
        "parameter": parameter_names(described.fun, args),
        "invariant": plan.names[: len(plan.bound)],
        "event": plan.event_names,
    }
    t = np.array([plan.settings.tf]) if times is None else times
    return Layout(identity(about), names, t, y0.dtype, times is not None)
