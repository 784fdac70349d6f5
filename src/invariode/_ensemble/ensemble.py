"""Many initial values or parameter sets of one problem, solved in parallel."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    Array,
    as_array,
    extra_arguments,
    flag,
    items,
    numbers,
    positive_integer,
    real_numbers,
    shown,
)
from .._base.interrupts import terminated_as_interrupted
from .._base.labelled import named, row_labels
from .._base.progress import bar
from .._base.record import Record
from .._base.suggestions import first_few
from .._base.types import MethodName, OnInterrupt, Progress
from .._plan.call_errors import require_taken
from .._problem.given_options import changed, parted, refused
from .._problem.options import TABLE, ManyOptions, Options, ProblemEnsembleOptions, table_of
from .._problem.problem import Problem
from .conclusion import solution
from .distributed import Means, Place, in_parts, stored
from .ensemble_solution import EnsembleSolution
from .local import Locally, attempted
from .sources import GivenRows, Rows, StreamedRows
from .store import EnsembleStore
from .task import Attempt, Ensemble, first_plan

__all__ = ["Wanted", "solve_rows"]

_OF_MANY = table_of(ManyOptions)
#: What another attempt at trajectories that failed may change.
_OF_RETRIES = (
    table_of(ProblemEnsembleOptions).keys()
    - _OF_MANY
    - {"keep", "callback", "breakpoints", "on_failure", "progress", "on_interrupt"}
)
_OF_SINGLE_RUNS = table_of(Options).keys() - table_of(ProblemEnsembleOptions).keys()


class Wanted(NamedTuple):
    """Rows of an ensemble as given, and where results go."""

    y0: ArrayLike | Iterator[tuple[ArrayLike, Any]] | None
    args: Iterable[Any] | ArrayLike | None
    t_eval: ArrayLike | None
    store: str | os.PathLike[str] | None


def solve_rows(
    problem: Problem, wanted: Wanted, method: MethodName, options: ProblemEnsembleOptions
) -> EnsembleSolution | EnsembleStore:
    """See `Problem.solve_ensemble`."""
    if any(event.at_start for event in problem.events):
        raise ValueError(
            "at_start is for single runs: evaluate the event at the initial states of an ensemble yourself"
        )
    many, running = parted(options, ManyOptions)
    on_failure = TABLE["on_failure"].check("on_failure", running.pop("on_failure", None) or "warn")
    drawn = TABLE["progress"].check("progress", running.pop("progress", False))
    on_interrupt = TABLE["on_interrupt"].check("on_interrupt", running.pop("on_interrupt", "raise"))
    attempts = _attempts(method, _options_of_each(running, wanted.t_eval), many.get("retry"))
    ensemble = Ensemble(problem, attempts, _side_by_side(many.get("lanes", "auto")), on_failure)
    executor, chunk, seed = many.get("executor"), many.get("chunk"), many.get("seed")
    workers, resume = many.get("workers"), flag("resume", many.get("resume", False))
    with terminated_as_interrupted() if on_interrupt == "return" else nullcontext():
        if executor is None and wanted.store is None and not isinstance(wanted.y0, Iterator):
            if chunk is not None or seed is not None or resume:
                raise ValueError(
                    "chunk, seed and resume are for ensembles with an executor or a store: give store= too"
                )
            ensemble.first_here = workers is None
            workers = positive_integer("workers", _processors() if workers is None else workers)
            index = _row_labels(wanted.y0, wanted.args)
            return _at_once(ensemble, *_rows(problem, wanted.y0, wanted.args), workers, drawn, on_interrupt, index)
        rows = _source(problem, wanted)
        means = Means(executor, _threads_of_part(executor, workers), drawn, chunk, on_interrupt)
        if wanted.store is not None:
            return stored(ensemble, rows, means, Place(wanted.store, resume, seed))
        if seed is not None or resume:
            raise ValueError("seed and resume are for results in a store: give store= too")
        return in_parts(ensemble, rows, means)


def _at_once(
    ensemble: Ensemble, y0: Array, args: Any, workers: int, shown: Progress, on_interrupt: OnInterrupt, index: Any
) -> EnsembleSolution:
    """Solve all rows on this machine; `index` is their labels."""
    task = ensemble.task(y0, args)
    first, plan = first_plan(task)
    plans = [plan, *(ensemble.task(y0, args, k).plan(first) for k in range(1, len(ensemble.attempts)))]
    with bar(shown, "trajectories", len(y0)) as report:
        found = attempted(ensemble, plans, task, Locally(workers, report, keep=True))
    return solution(task, plan, found, ensemble.on_failure, on_interrupt, index)


def _attempts(method: MethodName, options: Options, retry: Any) -> list[Attempt]:
    """Return the methods and options of the first attempt and of the retries of rows that failed."""
    attempts = [Attempt(method, options)]
    for given in [] if retry is None else [retry] if isinstance(retry, Mapping) else items(retry) or [retry]:
        if not isinstance(given, Mapping):
            raise TypeError(f"retry must be a dict of options, or a list of such, got {shown(given)}")
        other = dict(given)
        with_method = other.pop("method", method)
        for name in other:
            if name not in _OF_RETRIES:
                raise ValueError(f"retry cannot change {name!r}; choose from method, {', '.join(sorted(_OF_RETRIES))}")
        attempts.append(Attempt(with_method, changed(options, other)))
    return attempts


def _options_of_each(given: Options, t_eval: ArrayLike | None) -> Options:
    """Return the options of each trajectory."""
    for name, value in given.items():
        if name in _OF_SINGLE_RUNS:
            if not (value is None or (np.isscalar(value) and value == TABLE[name].default)):
                instead = "; give t_eval" if name in ("refine", "dense_output", "adjoint") else ""
                raise ValueError(f"{name} is not possible for an ensemble{instead}")
        elif name not in TABLE:
            raise refused(name)
    options = given.copy()
    if t_eval is not None:
        options["t_eval"] = t_eval
        return options
    kept = given.get("keep")
    if isinstance(kept, str) and kept in ("all", "outputs"):
        raise ValueError(f"keep={kept!r} of an ensemble needs t_eval: trajectories have steps of their own")
    if kept is None:
        options["keep"] = "end"
    return options


def _side_by_side(lanes: Any) -> bool:
    if lanes == "auto":
        return True
    if lanes != 1 or isinstance(lanes, bool):
        raise ValueError(f'lanes must be "auto" or 1, got {shown(lanes)}')
    return False


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _threads_of_part(executor: Any, workers: int | None) -> int:
    """Return the threads for each part: an executor has a worker slot for each processor, or should have."""
    if workers is None:
        return _processors() if executor is None else 1
    return positive_integer("workers", workers)


def _source(problem: Problem, wanted: Wanted) -> Rows:
    if not isinstance(wanted.y0, Iterator):
        return GivenRows(*_rows(problem, wanted.y0, wanted.args), _row_labels(wanted.y0, wanted.args))
    if wanted.args is not None:
        raise ValueError("an iterator of an ensemble yields (y0, args): leave out args")
    return StreamedRows(wanted.y0, partial(_rows, problem))


def _row_labels(y0: Any, args: Any) -> Any:
    """Return the labels of the rows of y0 and args, an index of pandas or an array; None if they have none.

    Raises ValueError: Both have, and these differ.
    """
    index, other = row_labels(args), row_labels(y0)
    if index is not None and other is not None and [*index] != [*other]:
        raise ValueError(
            f"the rows of y0 and args have other labels, {first_few([*map(str, other)])} and "
            f"{first_few([*map(str, index)])}: give both in one order, or one of them without labels, .to_numpy()"
        )
    return other if index is None else index


def _rows(problem: Problem, y0: ArrayLike | None, args: Any) -> tuple[Array, Any]:
    """Return the initial values as (N, n), and the extra arguments as a tuple, a list of such, or an array of rows;
    those of the problem for what is not given."""
    args = _named(problem, args)
    if args is None or isinstance(args, tuple):
        own = extra_arguments(args) or problem.args
        require_taken(problem, own)
        return np.atleast_2d(_states(problem, y0, lambda: problem.start_with(own))), own
    extra = [_row_of_arguments(row) for row in args] if isinstance(args, list) else as_array("args", args)
    if isinstance(extra, list) and len(set(map(len, extra))) > 1:
        raise ValueError(f"rows of args must be of one length, got lengths {sorted(set(map(len, extra)))}")
    if isinstance(extra, np.ndarray) and extra.ndim != 2:
        raise _no_rows(f"shape {extra.shape}")
    require_taken(problem, extra)

    def starts() -> Array:
        if problem.y0_of_args is None:
            return problem.y0
        return np.array([problem.start_with(tuple(row)) for row in extra]).reshape(len(extra), len(problem.y0))

    states = _states(problem, y0, starts)
    if states.ndim == 1:
        states = np.broadcast_to(states, (len(extra), len(states)))
    if len(states) != len(extra):
        raise ValueError(
            f"y0 has {len(states)} rows and args has {len(extra)}: give one row of args for each row of y0"
        )
    return states, extra


def _states(problem: Problem, y0: Any, starts: Callable[[], Array]) -> Array:
    """Return initial values as (N, n), or (n,) for all rows: `starts()`, which is of one of these shapes, for what is
    not given."""
    if y0 is None:
        return starts()
    if isinstance(y0, list) and problem.y0_of_args is not None:
        rows = cache(lambda: np.atleast_2d(starts()))
        states = [problem.by_component("y0", one, partial(_row, rows, i)) for i, one in enumerate(y0)]
    else:
        states = problem.by_component("y0", y0, lambda: starts().T)
    found = numbers("y0", states)
    if found.ndim not in (1, 2):
        raise ValueError(f"y0 of an ensemble must have shape (N, n) or (n,), got {found.shape}")
    if found.shape[-1] != len(problem.y0) and found.size:
        raise ValueError(
            f"y0 of an ensemble must have n = {len(problem.y0)} columns, one for each component of the problem, got "
            f"shape {found.shape}"
        )
    return found


def _row(rows: Callable[[], Array], i: int) -> Array:
    """Return one of the rows, of which there may be one for all; their number is compared later."""
    row: Array = rows()[min(i, len(rows()) - 1)]
    return row


def _named(problem: Problem, args: Any) -> Any:
    """Return args that are given by name, columns or rows of them or a table, as rows of arguments; of a problem with
    parameters, any rows as records."""
    given = named("args", args)
    if given is not None:
        columns = {name: real_numbers(f"args of {name}", one) for name, one in given.items()}
        sizes = {one.shape for one in columns.values()}
        if not sizes - {()}:
            return problem.arguments(given)
        if len(sizes - {()}) > 1 or max(map(len, sizes)) > 1:
            raise ValueError(f"columns of args must be of one length, got shapes {sorted(sizes)}")
        (size,) = max(sizes, key=len)
        every = [np.broadcast_to(one, size).tolist() for one in columns.values()]
        return [problem.arguments(dict(zip(columns, row, strict=True))) for row in zip(*every, strict=True)]
    by_name = isinstance(args, list) and any(named("a row of args", row) is not None for row in args[:1])
    if args is None or isinstance(args, tuple) or (problem.parameters is None and not by_name):
        return args
    rows = args if isinstance(args, list) else as_array("args", args).tolist()
    names = [*(problem.parameters or ())]

    def record(row: Any) -> Any:
        if named("a row of args", row) is not None or (
            isinstance(row, tuple) and len(row) == 1 and isinstance(row[0], Record)
        ):
            return problem.arguments(row)
        values = items(row)
        if values is None or len(values) != len(names):
            raise _no_rows(f"{shown(row)} as a row for the {len(names)} parameters {', '.join(names)}")
        return problem.arguments(dict(zip(names, values, strict=True)))

    return [record(row) for row in rows]


def _row_of_arguments(row: Any) -> tuple[Any, ...]:
    if isinstance(row, np.ndarray) and row.ndim > 0:
        return tuple(as_array("a row of args", row).tolist())
    if isinstance(row, Sequence) and not isinstance(row, str):
        return tuple(row)
    raise _no_rows(f"{shown(row)} as a row")


def _no_rows(got: str) -> ValueError:
    return ValueError(
        f"args of an ensemble must be a tuple, for all trajectories, or rows of shape (N, k), for one "
        f"parameter args[:, None]; got {got}"
    )
