"""An ensemble in parts: on executors, and into stores."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from functools import lru_cache
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array, positive_integer, quietly, warn
from .._base.progress import bar
from .._base.types import OnInterrupt, Progress
from .._files.identity import in_words
from .._plan.plan import Plan, solver
from .._problem.options import TABLE, ManyOptions, ProblemEnsembleOptions, table_of
from .conclusion import Remarks, interruption, solution
from .ensemble_solution import EnsembleSolution
from .executors import on_executor, packed, places_of, shares_memory
from .local import Locally, attempted, unsolved
from .outcomes import Outcomes, joined
from .sources import RowBlock, Rows, rejoined, rows_of
from .store import EnsembleStore, Layout, StoreWriter, parameter_names
from .task import Ensemble, first_plan

#: Seconds that a part should take, and the seconds that it may take to find that out.
_PART, _PILOT = 1.0, 0.1
#: Twice the seconds that client and scheduler need for a part, one after the other (measured in benchmarks/many.py).
_HANDLING = 0.02
#: Trajectories that the pilot solves at most, and bytes of a part.
_PILOTS, _LARGEST = 256, 32 * 2**20


class Means(NamedTuple):
    """The executor that solves the parts, its threads, and the size of a part."""

    executor: Any
    workers: int  # threads for each part
    shown: Progress
    chunk: int | None  # trajectories in a part
    on_interrupt: OnInterrupt


class Place(NamedTuple):
    """The store that results are written to, and whether to resume it."""

    store: Any
    resume: bool
    seed: Any


class _Travelling(NamedTuple):
    """An ensemble with a row that has a plan, as it travels."""

    ensemble: Ensemble
    y0: Array  # (1, n)
    args: Any

    def plans(self) -> list[Plan]:
        return [self.ensemble.task(self.y0, self.args, k).plan(0) for k in range(len(self.ensemble.attempts))]


class _Planned(NamedTuple):
    """An ensemble with a plan for each attempt."""

    ensemble: Ensemble
    plans: list[Plan]


@lru_cache(maxsize=4)
def _unpacked(data: bytes) -> _Planned:
    """Return the ensemble from its pickle, with its plans: functions are compiled once in a process."""
    found: _Travelling = pickle.loads(data)
    with quietly():  # where it comes from has said it
        return _Planned(found.ensemble, found.plans())


def _solve_part(what: bytes | _Planned, y0: Array, args: Any, workers: int) -> Outcomes:
    """Solve the rows of a part where an executor runs this."""
    with quietly():
        ensemble, plans = _unpacked(what) if isinstance(what, bytes) else what
        return attempted(ensemble, plans, ensemble.task(y0, args), Locally(workers))


def _seconds(solve: Callable[[Array, Any], object], y0: Array, args: Any) -> float:
    """Return the seconds that one of the first trajectories takes."""
    solve(y0[:1], rows_of(args, slice(1)))  # the first time functions are compiled
    k = 1
    while True:
        start = perf_counter()
        solve(y0[:k], rows_of(args, slice(k)))
        seconds = perf_counter() - start
        if seconds > _PILOT or k >= len(y0):
            return seconds / k
        k = min(4 * k, len(y0))


def _seconds_of_one(what: bytes | _Planned, y0: Array, args: Any) -> float:
    """Return the seconds that one of the first trajectories takes where an executor solves it."""
    return _seconds(lambda y0, args: _solve_part(what, y0, args, 1), y0, args)


class _Parted:
    """An ensemble that is solved part by part."""

    def __init__(self, ensemble: Ensemble, rows: Rows, means: Means) -> None:
        self.ensemble, self.rows, self.means = ensemble, rows, means
        y0, args = rows.first(_PILOTS)
        first, self.plan = first_plan(ensemble.task(y0, args))
        one = _Travelling(ensemble, y0[first : first + 1], rows_of(args, slice(first, first + 1)))
        self._here = _Planned(ensemble, [self.plan, *one.plans()[1:]])
        alone = means.executor is None or shares_memory(means.executor)
        self._sent = self._here if alone else packed(one)
        self._pilot = y0, args

    def length(self) -> int:
        """Return the size of a part: trajectories for a second, or for longer on large clusters (see `_HANDLING`)."""
        if self.means.chunk is not None:
            return positive_integer("chunk", self.means.chunk)
        y0, args = self._pilot
        if self.means.executor is None:
            alone = 1 if solver(self.plan).native else min(2, self.means.workers)  # fun may end its process
            seconds = _seconds(lambda y0, args: self._solved_here(y0, args, alone), y0, args)
        else:
            rows = RowBlock(0, 0, y0, args)
            ((_, seconds),) = on_executor(self.means.executor, _seconds_of_one, self._arguments, [rows])
        n, m, times = y0.shape[1], len(self.plan.bound), self.plan.course.times
        row = y0.itemsize * n * (2 + (0 if times is None else len(times))) + 24 * m + 136
        most: int = max(1, _LARGEST // row)
        size = most if self.rows.size is None else min(most, self.rows.size)
        enough = max(_PART, _HANDLING * places_of(self.means.executor))
        wanted = int(enough * self.means.workers / max(seconds, 1e-9))
        return max(1, min(wanted, size))

    def _arguments(self, part: RowBlock) -> tuple[Any, ...]:
        return self._sent, part.y0, part.args

    def _solved_here(self, y0: Array, args: Any, workers: int) -> Outcomes:
        with quietly():  # the first plan has said it
            ensemble, plans = self._here
            return attempted(ensemble, plans, ensemble.task(y0, args), Locally(workers))

    def outcomes(self, parts: Iterator[RowBlock]) -> Generator[tuple[RowBlock, Outcomes]]:
        """Yield each part with its outcomes, as parts are finished."""
        means = self.means
        if means.executor is None:
            for part in parts:
                yield part, self._solved_here(part.y0, part.args, means.workers)
            return
        yield from on_executor(means.executor, _solve_part, lambda part: (*self._arguments(part), means.workers), parts)


def in_parts(ensemble: Ensemble, rows: Rows, means: Means) -> EnsembleSolution:
    """Solve all rows on an executor, or from an iterator, and return their results in memory."""
    run = _Parted(ensemble, rows, means)
    done: dict[int, Outcomes] = {}
    parts = rows.parts(run.length())
    drawn: list[RowBlock] = []

    def remembered() -> Iterator[RowBlock]:
        for part in parts:
            drawn.append(part)
            yield part

    interrupted = False
    try:
        with bar(means.shown, "trajectories", rows.size) as report, closing(run.outcomes(remembered())) as found:
            for part, outcomes in found:
                done[part.number] = outcomes
                if report:
                    report(sum(map(len, done.values())))
    except KeyboardInterrupt:
        interrupted = True
        drawn += [] if rows.size is None else parts  # those that an iterator has not made yet nobody knows
        if not drawn:
            raise
        for part in drawn:
            if part.number not in done:
                done[part.number] = unsolved(ensemble.task(part.y0, part.args), run.plan)
    task = ensemble.task(*rejoined(drawn))
    whole = joined([done[part.number] for part in drawn])
    whole.interrupted |= interrupted
    return solution(task, run.plan, whole, ensemble.on_failure, means.on_interrupt, rows.index)


def stored(ensemble: Ensemble, rows: Rows, means: Means, place: Place) -> EnsembleStore:
    """Solve all rows and return their results in a store."""
    run = _Parted(ensemble, rows, means)
    writer = StoreWriter(place.store, _layout(run), run.length, rows.size, in_words(place.seed), place.resume)
    with writer:
        remarks = Remarks()
        try:
            _fill(writer, run, rows, means, remarks)
        except KeyboardInterrupt:
            store = EnsembleStore(place.store)
            text = f"Ctrl-C stopped the ensemble: {len(store) - store.missing} of {len(store)} trajectories are solved"
            if means.on_interrupt == "raise":
                raise interruption(store, text) from None
            warn(f"{text}, and in the store; resume=True solves the others")
    remarks.say(run.plan)
    result = EnsembleStore(place.store)
    remarks.conclude(result, ensemble.on_failure)
    return result


def _fill(writer: StoreWriter, run: _Parted, rows: Rows, means: Means, remarks: Remarks) -> None:
    """Solve the rows that the store lacks, and add their warnings."""
    if means.chunk not in (None, writer.length):
        raise ValueError(f"the store has parts of {writer.length} trajectories, got chunk={means.chunk}: leave it out")
    size = done = lacking = 0

    def counted() -> Iterator[RowBlock]:
        nonlocal size
        for part in rows.parts(writer.length):
            size = part.start + len(part.y0)
            yield part

    def missing() -> Iterator[RowBlock]:
        nonlocal lacking
        for part in writer.missing(counted()):
            lacking += len(part.y0)
            yield part

    with bar(means.shown, "trajectories", rows.size) as report, closing(run.outcomes(missing())) as found:
        for part, outcomes in found:
            writer.write(part, outcomes)
            remarks.add(outcomes, part.start)
            done += len(part.y0)
            if report:
                report(size - lacking + done)  # with those of earlier calls
        if report:
            report(size)
    writer.finish(size)


def _layout(run: _Parted) -> Layout:
    plan, problem, attempts = run.plan, run.ensemble.problem, run.ensemble.attempts
    y0, args = run.rows.first(1)
    running = (
        table_of(ProblemEnsembleOptions).keys()
        - ManyOptions.__annotations__.keys()
        - {"on_failure", "progress", "on_interrupt"}
    )
    defaults = {name: row.default for name, row in TABLE.items() if name in running}
    about = {
        "fun": problem.fun,
        "t_span": problem.t_span,
        "size of y": y0.shape[1],
        "method": attempts[0].method,
        "options": {**defaults, **attempts[0].options},
        "retry": [{"method": one.method, "options": one.options} for one in attempts[1:]],
        "events": problem.events,
        "invariants": problem.invariants,
        "bounds": problem.bounds,
        "inputs": problem.inputs,
        **vars(problem.matrices),
        **({"args": args} if isinstance(args, tuple) else {}),
        **({} if problem.sensitivities is None else {"sensitivities": problem.sensitivities}),
    }
    times = plan.course.times
    names = {
        "component": plan.called.components,
        "parameter": parameter_names(problem.fun, args, len(problem.before_args)),
        "invariant": plan.names[: len(plan.bound)],
        "event": plan.called.events,
        "sensitivity": [] if plan.varied is None else plan.varied.names,
    }
    t = np.array([plan.course.tf]) if times is None else times
    return Layout(in_words(about), names, t, y0.dtype, times is not None)
