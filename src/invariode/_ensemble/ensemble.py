"""Many initial values or parameter sets of one problem, solved in parallel."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeAlias, Unpack, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, extra_arguments, flag, interval, items, numbers, positive_integer, shown
from .._base.progress import bar
from .._base.types import EventsLike, Function, MethodName, Span
from .._problem.docstrings import documented
from .._problem.events import to_events
from .._problem.options import TABLE, DescribingOptions, EnsembleOptions, Options, parted, table_of
from .conclusion import solution
from .parts import Means, Place, in_parts, stored
from .rows import attempted
from .solution import EnsembleSolution
from .sources import GivenRows, Rows, StreamedRows
from .store import EnsembleStore
from .task import Attempt, Described, Ensemble, first_plan

__all__ = ["solve_ensemble"]

Retry: TypeAlias = Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""Options for trajectories that failed."""


_DESCRIBING = table_of(DescribingOptions).keys()
#: What another attempt at trajectories that failed may change.
_OF_RETRIES = table_of(EnsembleOptions).keys() - _DESCRIBING - {"keep", "callback", "breakpoints", "on_failure"}
_OF_SINGLE_RUNS = table_of(Options).keys() - table_of(EnsembleOptions).keys()


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
@documented({"on_failure": "warn"}, options=table_of(EnsembleOptions))
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
    that fails, also with an exception, gets a status, a message and NaN as its final state; the others go on. One
    warning says how many failed: see `on_failure`.

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
    described = Described(fun, interval(t_span), events, describing)
    on_failure = TABLE["on_failure"].check("on_failure", running.pop("on_failure", "warn"))
    attempts = _attempts(method, _options_of_each(running, t_eval), retry)
    ensemble = Ensemble(described, attempts, _side_by_side(lanes), on_failure)
    drawn = flag("progress", progress)
    if executor is None and store is None and not isinstance(y0, Iterator):
        if chunk is not None or seed is not None or flag("resume", resume):
            raise ValueError("chunk, seed and resume are for ensembles with an executor or a store: give store= too")
        workers = positive_integer("workers", _processors() if workers is None else workers)
        return _at_once(ensemble, *_rows(y0, args), workers, drawn)
    rows = _source(y0, args)
    means = Means(executor, _threads_of_part(executor, workers), drawn, chunk)
    if store is not None:
        return stored(ensemble, rows, means, Place(store, flag("resume", resume), seed))
    if seed is not None or resume:
        raise ValueError("seed and resume are for results in a store: give store= too")
    return in_parts(ensemble, rows, means)


def _at_once(ensemble: Ensemble, y0: Array, args: Any, workers: int, shown: bool) -> EnsembleSolution:
    """All rows, on this machine."""
    task = ensemble.task(y0, args)
    first, plan = first_plan(task)
    plans = [plan, *(ensemble.task(y0, args, k).plan(first) for k in range(1, len(ensemble.attempts)))]
    with bar(shown, "trajectories", len(y0)) as report:
        found = attempted(ensemble, plans, y0, args, workers, report)
    return solution(task, plan, found, ensemble.on_failure)


def _attempts(method: MethodName, options: Options, retry: Retry | None) -> list[Attempt]:
    """With which method and options rows are solved, and solved again if they failed."""
    attempts = [Attempt(method, options)]
    for given in [] if retry is None else [retry] if isinstance(retry, Mapping) else items(retry) or [retry]:
        if not isinstance(given, Mapping):
            raise TypeError(f"retry must be a dict of options, or a list of such, got {shown(given)}")
        other = dict(given)
        with_method = other.pop("method", method)
        for name in other:
            if name not in _OF_RETRIES:
                raise ValueError(f"retry cannot change {name!r}; choose from method, {', '.join(sorted(_OF_RETRIES))}")
        attempts.append(Attempt(with_method, cast("Options", {**options, **other})))
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
    kept = given.get("keep")
    if isinstance(kept, str) and kept in ("all", "outputs"):
        raise ValueError(f"keep={kept!r} of an ensemble needs t_eval: trajectories have steps of their own")
    return {**options, "keep": "end"}


def _side_by_side(lanes: Any) -> bool:
    if lanes == "auto":
        return True
    if lanes != 1 or isinstance(lanes, bool):
        raise ValueError(f'lanes must be "auto" or 1, got {shown(lanes)}')
    return False


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    raise _no_rows(f"{shown(row)} as a row")


def _no_rows(got: str) -> ValueError:
    return ValueError(f"args of an ensemble must be a tuple, for all trajectories, or rows of shape (N, k), got {got}")
