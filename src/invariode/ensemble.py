"""Many initial values or parameter sets of one problem, solved in parallel."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import pickle
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from ._arguments import Array, extra_arguments, flag, numbers, positive_integer, warn
from ._outcome import inconsistent_start
from ._progress import bar
from ._types import EnsembleOptions, EventsLike, Function, InvariantsLike, MethodName, Span
from .invariants import as_columns
from .problem import Plan, Problem
from .solution import Record

__all__ = ["EnsembleEvents", "EnsembleSolution", "EnsembleStats", "solve_ensemble"]

_STATUS = {"reached_end": 0, "terminal_event": 1, "stopped_by_callback": 2, "invariant_convicted": -2}
_EXCEPTIONS = ("invariant_refused", "event_undefined", "action_undefined", "interrupted")
_NOT_FINITE, _INCONSISTENT = -1, -2  # states that only trajectories of an ensemble have


@dataclasses.dataclass(eq=False, repr=False)
class EnsembleEvents(Record):
    """All occurrences of one event, those of a trajectory one after the other.

    Attributes
    ----------
    trajectory : ndarray of int, (k,)
        In which trajectory each occurred; sorted.
    t : ndarray, (k,)
        When.
    y : ndarray, (k, n)
        The states there.
    """

    trajectory: Array
    t: Array
    y: Array

    def __repr__(self) -> str:
        return f"EnsembleEvents({len(self.t)} occurrences in {len(np.unique(self.trajectory))} trajectories)"


@dataclasses.dataclass(eq=False, repr=False)
class EnsembleStats(Record):
    """Counts of the trajectories, arrays of shape (N,) of what `Stats` has for one solve."""

    steps: Array
    failed: Array
    nfev: Array
    nfev_check: Array
    njev: Array
    nlu: Array
    nsolve: Array
    projections: Array
    skipped: Array
    ng: Array
    ngjac: Array
    ngdiff: Array


@dataclasses.dataclass(eq=False, repr=False)
class EnsembleSolution(Record):
    """Result of `solve_ensemble`: N trajectories of n components.

    Attributes
    ----------
    t : ndarray, (n_t,)
        `t_eval`; with ``save="end"`` the end of the interval.
    y : ndarray, (N, n, n_t)
        The states at t, NaN at times that a trajectory did not reach. With ``save="end"`` the final states, wherever
        the trajectory ended: see `t_end`.
    t_end, y_end : ndarray, (N,) and (N, n)
        Where each trajectory ended, and the state there.
    status : ndarray of int, (N,)
        0 reached the end, 1 a terminal event, 2 stopped by `callback`, -1 the step failed, -2 an invariant is none,
        -3 what ends a single solve with an exception: the initial value is off a demanded manifold or not finite, an
        invariant or an event is refused, a function raised.
    success : ndarray of bool, (N,)
        status >= 0.
    messages : dict of int to str
        Why, for each trajectory without success.
    events : list of EnsembleEvents
        One for each event function.
    stats : EnsembleStats
        Counts of each trajectory.
    value : ndarray, (N, m)
        At what the invariants were held (at first, if events with actions changed it).
    residual_before, residual_after : ndarray, (N, m)
        Largest ``|g - value|`` of the accepted candidates before projection; at the outputs and the end.
    correction : ndarray, (N,)
        Largest correction by projection of a step, in units of rtol.
    """

    t: Array
    y: Array
    t_end: Array
    y_end: Array
    status: Array
    success: Array
    messages: dict[int, str]
    events: list[EnsembleEvents]
    stats: EnsembleStats
    value: Array
    residual_before: Array
    residual_after: Array
    correction: Array

    def __repr__(self) -> str:
        size, n = self.y_end.shape
        counted = ((0, "reached the end"), (1, "had a terminal event"), (2, "were stopped by callback"))
        parts = [f"{k} {what}" for status, what in counted if (k := int((self.status == status).sum()))]
        text = (
            f"EnsembleSolution of {size} trajectories, {n} components, {len(self.t)} times: {', '.join(parts) or '-'}"
        )
        if self.messages:
            first = min(self.messages)
            text += f", {len(self.messages)} failed (the first, number {first}: {self.messages[first]})"
        return text


def solve_ensemble(
    fun: Function,
    t_span: Span,
    y0: ArrayLike,
    method: MethodName = "ode45",
    *,
    args: Iterable[Any] | ArrayLike | None = None,
    invariants: InvariantsLike | None = None,
    events: EventsLike = None,
    jac: Any = None,
    jac_sparsity: Any = None,
    lband: int | None = None,
    uband: int | None = None,
    mass: Any = None,
    workers: int | None = None,
    progress: bool = False,
    **options: Unpack[EnsembleOptions],
) -> EnsembleSolution:
    """Solves one problem from many initial values, or with many parameter sets, in parallel.

    The result is the same, bit for bit, for any number of workers, and the same as that of single solves. A trajectory
    that fails, also with an exception, gets a status and a message; the others go on.

    Parameters
    ----------
    fun, t_span, method, invariants, events, jac, jac_sparsity, lband, uband, mass
        As in `solve_ivp`. An invariant without `value` is held at its initial value of each trajectory.
    y0 : array_like of shape (N, n) or (n,)
        Initial states, one row per trajectory, or one for all.
    args : tuple, or array_like of shape (N, k), optional
        A tuple: the extra arguments of all trajectories. Rows: row i holds the k extra arguments of trajectory i.
    workers : int, optional
        Threads or processes. Default: the processors that this process may use.
    progress : bool
        Whether a progress bar is shown (needs rich).
    **options
        Those of `solve_ivp` but for `dense_output` and `refine`. With `t_eval` the states at these times are kept;
        without it, or with ``save="end"``, the final ones.

    Returns
    -------
    EnsembleSolution

    Raises
    ------
    TypeError, ValueError
        What is wrong for all trajectories. With several processes on a platform that starts them afresh (not by fork):
        a function that cannot be pickled, such as a lambda or one defined in a function or a notebook.

    Notes
    -----
    Where all functions are native (`invariode.compile` and the like), trajectories run on threads in the core, which
    take work from each other as they run out of it; memory is the result plus a few vectors per thread. Otherwise they
    run in processes, and each function must be importable there: on platforms without fork define it in a module, guard
    the script by ``if __name__ == "__main__":``, or give ``workers=1``, which stays in this process. The result takes
    8 (n n_t + 2 n + 3 m) + 120 bytes per trajectory, and 8 (n + 2) per event that occurred.

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
    describing = {
        "invariants": invariants,
        "events": events,
        "jac": jac,
        "jac_sparsity": jac_sparsity,
        "lband": lband,
        "uband": uband,
        "mass": mass,
    }
    for name, harmless in (("dense_output", False), ("refine", 1)):
        if options.get(name, harmless) != harmless:
            raise ValueError(f"{name} is not possible for an ensemble; give t_eval")
    if options.get("save") == "all" and options.get("t_eval") is None:
        raise ValueError('save="all" of an ensemble needs t_eval: trajectories have steps of their own')
    if options.get("t_eval") is None:
        options["save"] = "end"
    workers = positive_integer("workers", _processors() if workers is None else workers)
    rows, extra = _rows(y0, args)
    task = _Task(fun, tuple(t_span), describing, method, options, rows, extra)
    if len(rows) == 0:
        raise ValueError("an ensemble needs at least one row of y0 or args")
    plan = task.first_plan()
    with bar(flag("progress", progress), "trajectories", len(rows)) as report:
        native = _core.Solver(**plan.solver).native
        results = (_on_threads if native else _in_processes)(task, plan, min(workers, len(rows)), report)
    return results.solution()


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _rows(y0: ArrayLike, args: Any) -> tuple[Array, Any]:
    """The initial values as (N, n), and the extra arguments as a tuple or as an array of rows."""
    states = numbers("y0", y0)
    if states.ndim not in (1, 2):
        raise ValueError(f"y0 of an ensemble must have shape (N, n) or (n,), got {states.shape}")
    if args is None or isinstance(args, tuple):
        return np.atleast_2d(states), extra_arguments(args)
    extra = np.asarray(args)
    if extra.ndim != 2:
        raise ValueError(
            f"args of an ensemble must be a tuple, for all trajectories, or an array of shape (N, k), got shape "
            f"{extra.shape}"
        )
    if states.ndim == 1:
        states = np.broadcast_to(states, (len(extra), len(states)))
    if len(states) != len(extra):
        raise ValueError(f"y0 has {len(states)} rows and args has {len(extra)}: they must be as many")
    return states, extra


@dataclasses.dataclass
class _Task:
    """What is to be solved; picklable if the functions are."""

    fun: Any
    t_span: tuple[float, ...]
    describing: dict[str, Any]
    method: MethodName
    options: Any
    y0: Array
    args: Any  # a tuple, or rows

    def problem(self, i: int) -> Problem:
        args = self.args if isinstance(self.args, tuple) else tuple(self.args[i].tolist())
        return Problem(self.fun, self.t_span, self.y0[i], args=args, **self.describing)

    def plan(self, i: int) -> Plan:
        return self.problem(i).plan(self.method, **self.options)

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


class _Results:
    """The rows of the result, filled as trajectories end."""

    def __init__(self, task: _Task, plan: Plan) -> None:
        size, n = task.y0.shape
        times = plan.solver["times"]
        self.t = np.array([plan.solver["tf"]]) if times is None else times
        m = len(plan.bound)
        self.y = np.full((size, n, len(self.t)), np.nan, dtype=task.y0.dtype)
        self.t_end, self.y_end = np.full(size, plan.solver["t0"], dtype=float), task.y0.copy()
        self.status = np.full(size, -3, dtype=np.int8)
        self.counts = np.zeros((size, len(_core.COUNTS)), dtype=np.int64)
        self.value = np.full((size, m), np.nan)
        self.before, self.after, self.correction = np.zeros((size, m)), np.zeros((size, m)), np.zeros(size)
        self.messages: dict[int, str] = {}
        self.found: list[list[tuple[int, Array, Array]]] = [[] for _ in plan.event_names]
        self.ends_only = times is None

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
        self.value[i], self.before[i], self.after[i], self.correction[i] = (
            one.value,
            one.before,
            one.after,
            one.correction,
        )
        for found, (t, y) in zip(self.found, one.events, strict=True):
            if len(t):
                found.append((i, t, y))

    def solution(self) -> EnsembleSolution:
        if self.ends_only:
            self.y = self.y_end[:, :, None].copy()
        if dropped := int((self.counts[:, -1] > 0).sum()):
            warn(f"invariants were redundant in {dropped} trajectories, and were left out there")
        stats = dict(zip(_core.COUNTS, self.counts.T, strict=True))
        del stats["dropped"]
        return EnsembleSolution(
            t=self.t,
            y=self.y,
            t_end=self.t_end,
            y_end=self.y_end,
            status=self.status,
            success=self.status >= 0,
            messages=dict(sorted(self.messages.items())),
            events=[self._events(found) for found in self.found],
            stats=EnsembleStats(**stats),
            value=self.value,
            residual_before=self.before,
            residual_after=self.after,
            correction=self.correction,
        )

    def _events(self, found: list[tuple[int, Array, Array]]) -> EnsembleEvents:
        found.sort(key=lambda one: one[0])
        trajectory = np.repeat([i for i, _, _ in found], [len(t) for _, t, _ in found]).astype(np.int64)
        t = np.concatenate([np.zeros(0), *(t for _, t, _ in found)])
        y = np.concatenate([np.zeros((0, self.y_end.shape[1]), self.y_end.dtype), *(y for _, _, y in found)])
        return EnsembleEvents(trajectory, t, y)


# ----------------------------------------------------------------------------------------------------------------------
# On threads, in the core


def _on_threads(task: _Task, plan: Plan, workers: int, report: Callable[[float], None] | None) -> _Results:
    size = len(task.y0)
    y0 = np.ascontiguousarray(task.y0)
    p = plan.solver["parameters"]
    if isinstance(task.args, tuple):
        parameters = np.ascontiguousarray(np.broadcast_to(p, (size, len(p))))
    else:
        parameters = np.ascontiguousarray(task.args, dtype=float)
    solvers = [_core.Solver(**plan.solver) for _ in range(min(workers, size))]
    run = _core.integrate_all(solvers, y0.view(float).reshape(size, -1), parameters, report)

    results = _Results(task, plan)
    dtype = task.y0.dtype
    results.t_end, results.y_end = run.take_t(), run.take_end().view(dtype)
    if not results.ends_only:
        results.y = _components(run.take_y(), dtype)
    results.counts = run.take_counts()
    results.value, results.before, results.after, results.correction = run.take_drift()
    states = run.take_states()
    codes = np.array([_STATUS.get(name, -3 if name in _EXCEPTIONS else -1) for name in _core.STATES], dtype=np.int8)
    results.status = np.where(states < 0, np.int8(-3), codes[states])
    for i, failure in run.failures():
        exception = plan.exception(failure)
        results.messages[i] = plan.verdict(failure)[1] if exception is None else _as_text(exception)
    t0 = plan.solver["t0"]
    for row in np.flatnonzero(states == _NOT_FINITE).tolist():
        results.messages[row] = f"ValueError: y0 must be finite, got {task.y0[row]}"
    for row in np.flatnonzero(states == _INCONSISTENT).tolist():
        results.messages[row] = f"ValueError: {inconsistent_start('not_found', t0)}"
    for found, (trajectory, t, y) in zip(results.found, run.take_events(), strict=True):
        starts = np.flatnonzero(np.diff(trajectory, prepend=-1))
        for start, stop in zip(starts, [*starts[1:], len(t)], strict=True):
            found.append((int(trajectory[start]), t[start:stop], y[start:stop].view(dtype)))
    return results


def _components(y: Array, dtype: np.dtype[Any]) -> Array:
    """Reals (N, reals, n_t) as components (N, n, n_t): of a complex problem each is two neighbouring rows."""
    return y if dtype.kind != "c" else y[:, 0::2] + 1j * y[:, 1::2]


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
    counts: list[int]
    value: Array
    before: Array
    after: Array
    correction: float
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
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "invariants? .* redundant")  # counted, and said once
            plan = task.plan(i)
            run = _core.Solver(**plan.solver).integrate(plan.y0.view(float))
            if exception := plan.exception(run):
                return _Outcome(i, -3, _as_text(exception), None)
            status, message = plan.verdict(run)
            return _Outcome(i, status, message, _row(plan, run, task.y0.dtype))
    except Exception as error:
        return _Outcome(i, -3, _as_text(error), None)


def _row(plan: Plan, run: _core.Run, dtype: np.dtype[Any]) -> _Row:
    bound = plan.bound
    if jumps := run.take_jumps():
        bound = dataclasses.replace(
            bound, jumps=tuple(jumps), forward=1 if plan.solver["tf"] >= plan.solver["t0"] else -1
        )
    t, rows, t_end, end = run.take_points()
    y = as_columns(rows, dtype)
    y_end = y[:, -1] if end is None else end.view(dtype)
    before, _, correction = run.take_drift()
    after = np.zeros(len(bound))
    if len(bound):
        at_outputs = bound.residual(t, y, bound.pieces_of_output(len(t)))
        at_end = bound.residual(np.array([t_end]), y_end[:, None], np.array([len(bound.jumps)]))
        after = np.abs(np.hstack([at_outputs, at_end])).max(axis=1)
    return _Row(
        t_end=t_end,
        y_end=y_end,
        y=y if plan.solver["times"] is not None else y[:, :0],
        counts=list(run.counts),
        value=bound.value,
        before=before[: len(bound)],
        after=after,
        correction=correction,
        events=[(times, points.view(dtype)) for times, points in run.take_events()],
    )


_inherited: _Task | None = None  # in a worker process: what it works on


def _begin(task: _Task) -> None:
    global _inherited
    _inherited = task
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends workers without a traceback


def _solve_some(indices: range) -> list[_Outcome]:
    assert _inherited is not None
    return [_solve_one(_inherited, i) for i in indices]


def _in_processes(task: _Task, plan: Plan, workers: int, report: Callable[[float], None] | None) -> _Results:
    results = _Results(task, plan)
    size, done = len(task.y0), 0
    for outcomes in _here(task, size) if workers == 1 else _elsewhere(task, size, workers):
        for outcome in outcomes:
            results.keep(outcome)
        done += len(outcomes)
        if report:
            report(done)
    return results


def _here(task: _Task, size: int) -> Iterator[list[_Outcome]]:
    for i in range(size):
        yield [_solve_one(task, i)]


def _elsewhere(task: _Task, size: int, workers: int) -> Iterator[list[_Outcome]]:
    """Chunks of outcomes from worker processes, as they end. A trajectory that kills its process is a failure."""
    context = multiprocessing.get_context()
    if context.get_start_method() != "fork":
        _require_picklable(task)
    chunk = max(1, min(256, size // (8 * workers)))
    left = [range(i, min(i + chunk, size)) for i in range(0, size, chunk)]
    unfinished: list[range] = []
    with ProcessPoolExecutor(workers, context, _begin, (task,)) as pool:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # fork beside the threads of a BLAS
                waiting: dict[Future[list[_Outcome]], range] = {pool.submit(_solve_some, some): some for some in left}
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    some = waiting.pop(future)
                    try:
                        yield future.result()
                    except BrokenProcessPool:
                        unfinished.append(some)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    for i in (i for some in unfinished for i in some):  # one of them did it: each alone, in a process of its own
        yield from _alone(task, i)


def _alone(task: _Task, i: int) -> Iterator[list[_Outcome]]:
    with ProcessPoolExecutor(1, multiprocessing.get_context(), _begin, (task,)) as pool:
        try:
            yield pool.submit(_solve_some, range(i, i + 1)).result()
        except BrokenProcessPool:
            yield [_Outcome(i, -3, "the worker process died: fun ended the process, or memory ran out", None)]


def _require_picklable(task: _Task) -> None:
    try:
        pickle.dumps(task)
    except Exception as error:
        raise TypeError(
            f"the functions of this ensemble cannot be sent to other processes ({error}): define them in a module, "
            "compile them (invariode.compile), or solve with workers=1"
        ) from error
