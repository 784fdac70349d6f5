"""The result of an ensemble as its user sees it, and one warning of each kind for all trajectories."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import Array, warn
from .._base.failures import FailureWarning, SolveError
from .._base.record import Record
from .._base.types import OnFailure, OnInterrupt
from .._plan.plan import Plan
from .._problem.invariants import AccuracyWarning
from .._problem.parameters import names_of_arguments
from .._results.messages import accumulating_in, below_zero, harmful_projection
from .._results.records import DiscontinuityWarning, StiffnessWarning
from .ensemble_solution import (
    OF_TRAJECTORIES,
    REAL_STATS,
    EnsembleSensitivities,
    EnsembleSolution,
    EnsembleStats,
    Trajectories,
    final_states,
)
from .outcomes import UNSOLVED, Outcomes, counts_by_name
from .store import EnsembleStore
from .task import Task

#: Of the counts, those that make warnings.
_WARNINGS = slice(_core.COUNTS.index("dropped"), len(_core.COUNTS))
assert _core.COUNTS[_WARNINGS] == ("dropped", "harmed", "fallen", "stiff")


def solution(
    task: Task, plan: Plan, found: Outcomes, on_failure: OnFailure, on_interrupt: OnInterrupt, index: Any
) -> EnsembleSolution:
    """Return the result of the ensemble, whose rows have the labels `index`, after its warnings.

    Raises
    ------
    SolveError
        A trajectory failed, and `on_failure` is "raise".
    KeyboardInterrupt
        Ctrl-C stopped the ensemble, and `on_interrupt` is "raise". Its `solution` is the result.
    """
    times = plan.course.times
    remarks = Remarks()
    remarks.add(found)
    remarks.say(plan)
    result = EnsembleSolution(
        t=np.array([plan.course.tf]) if times is None else times,
        y=final_states(found.y_end, found.status) if times is None else found.y,
        success=found.status >= 0,
        stats=EnsembleStats(**counts_by_name(found.counts), **_taken(found, REAL_STATS), _lanes=found.lanes),
        **_taken(found, (*(OF_TRAJECTORIES.keys() - {"y"}), "messages", "events")),
        _trajectories=_trajectories(plan, task, found),
        _final=times is None,
        _labels=plan.called.labels,
        _index=index,
        _arguments=_arguments(task),
        _sensitivities=None
        if plan.varied is None
        else EnsembleSensitivities.of(plan.varied.names, None if times is None else found.S, found.S_end, found.status),
    )
    if found.interrupted:
        _conclude_interrupted(result, on_interrupt)
    else:
        remarks.conclude(result, on_failure)
    return result


def _taken(found: Outcomes, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(found, name) for name in names}


def _conclude_interrupted(result: EnsembleSolution, on_interrupt: OnInterrupt) -> None:
    """Warn of trajectories that Ctrl-C left, or raise KeyboardInterrupt with the others."""
    left = int(np.count_nonzero(result.status == UNSOLVED))
    text = f"Ctrl-C stopped the ensemble: {len(result) - left} of {len(result)} trajectories are solved"
    if on_interrupt == "return":
        warn(f"{text}; the status of the others is {UNSOLVED}")
        return
    raise interruption(result, text)


def interruption(result: EnsembleSolution | EnsembleStore, text: str) -> KeyboardInterrupt:
    """Return the exception of an ensemble that Ctrl-C has stopped; its `solution` is the result so far."""
    error = KeyboardInterrupt(
        f"{text}, and are in the `solution` of this exception (in a notebook: sys.last_value.solution); "
        'on_interrupt="return" returns them'
    )
    error.solution = result  # type: ignore[attr-defined]
    return error


class Remarks:
    """Warnings about trajectories: one of each kind for all of them."""

    def __init__(self) -> None:
        self._dropped = self._stiff = self._discontinuous = self._accumulating = 0
        self._harmed: list[Array] = []
        self._fallen: list[Array] = []
        self._size = self._failed = 0
        self._first: tuple[int, str] | None = None  # of those that failed: its number, and why
        self._error: tuple[int, BaseException] | None = None

    def add(self, found: Outcomes, start: int = 0) -> None:
        """Add the warnings about some more trajectories, of which the first has the number `start`."""
        self._size += len(found)
        if found.messages:
            self._failed += len(found.messages)
            i = min(found.messages)
            if self._first is None or start + i < self._first[0]:
                self._first = start + i, found.messages[i]
        if found.error is not None:
            i, error = found.error
            if self._error is None or start + i < self._error[0]:
                self._error = start + i, error
        jumps = ~np.isnan(found.discontinuity)
        if jumps.any():
            self._discontinuous += int(np.count_nonzero(jumps))
        self._accumulating += int(np.count_nonzero(~np.isnan(found.accumulation)))
        if not found.counts[:, _WARNINGS].any():
            return
        dropped, harmed, fallen, stiff = found.counts[:, _WARNINGS].T
        self._dropped += int(np.count_nonzero(dropped))
        self._stiff += int(np.count_nonzero(stiff))
        self._harmed.append(harmed[(found.status >= 0) & (harmed > 0)])
        self._fallen.append(fallen[fallen > 0])

    def say(self, plan: Plan) -> None:
        """Issue the warnings about all trajectories that were added."""
        if self._dropped:
            warn(f"invariants were redundant in {self._dropped} trajectories, and were left out there")
        if self._harmed:
            _warn_harmed(plan, np.concatenate(self._harmed))
        if self._fallen:
            _warn_fallen(plan, np.concatenate(self._fallen))
        if self._stiff:
            text = f"in {self._stiff} trajectories stability, not accuracy, limits most steps"
            warn(f"{plan.method.name}: {text} (stats['stiff'] tells in which); try ode15s", StiffnessWarning)
        if self._discontinuous:
            text = f"fun looks discontinuous in {self._discontinuous} trajectories, where steps were rejected"
            what = "give breakpoints, or, if the time of the jump depends on y, an event with an action"
            where = "stats['discontinuity'] tells where at first"
            warn(f"{plan.method.name}: {text} ({where}); {what}", DiscontinuityWarning)
        if self._accumulating:
            warn(f"{plan.method.name}: {accumulating_in(self._accumulating)}", DiscontinuityWarning)

    def conclude(self, result: EnsembleSolution | EnsembleStore, on_failure: OnFailure) -> None:
        """Warn of failed trajectories, or raise an error, according to `on_failure`."""
        if self._first is None or on_failure == "return":
            return
        i, message = self._first
        label = "" if isinstance(result, EnsembleStore) or result._index is None else f" ({result._index[i]})"
        text = f"{self._failed} of {self._size} trajectories failed; the first, number {i}{label}: {message}"
        if on_failure == "raise":
            raise SolveError(text, result) from (self._error and self._error[1])
        warn(f"{text} (y is NaN at times that they did not reach; `failed` and `messages` say more)", FailureWarning)


def _warn_harmed(plan: Plan, harmed: Array) -> None:
    """Warn of components that projection made less accurate. `harmed`: 1 + such a component, of each successful
    trajectory."""
    if not harmed.size:
        return
    names = plan.called.components
    components = np.unique((harmed - 1) // (2 if plan.functions.complex else 1))
    much = f"much more than estimated errors in {harmed.size} trajectories"
    warn(harmful_projection(", ".join(names[i] for i in components), much), AccuracyWarning)


def _warn_fallen(plan: Plan, fallen: Array) -> None:
    """Warn of components below 0. `fallen`: 1 + such a component, of each trajectory that has one."""
    if not fallen.size:
        return
    components = np.unique(fallen - 1).tolist()
    listed = ", ".join(plan.called.components[i] for i in components)
    warn(below_zero(listed, components, f"in {fallen.size} trajectories"), AccuracyWarning)


def _arguments(task: Task) -> tuple[list[str], Array] | None:
    """Return the names of the numbers in args, and their values (N, k) if each trajectory has its own."""
    args, problem = task.args, task.problem
    if isinstance(args, tuple) or not len(args):
        return None
    if isinstance(args[0], tuple) and len(args[0]) == 1 and isinstance(args[0][0], Record):
        return [*args[0][0].keys()], np.array([[*row[0]] for row in args], dtype=float)
    names = names_of_arguments(problem.fun, len(args[0]), 2 + len(problem.before_args))
    if isinstance(args, np.ndarray):
        return (names, np.asarray(args, dtype=float)) if args.dtype.kind in "iuf" else None
    chosen = [j for j in range(len(names)) if all(isinstance(row[j], (int, float)) for row in args)]
    values = np.array([[float(row[j]) for j in chosen] for row in args])
    return ([names[j] for j in chosen], values) if chosen else None


def _trajectories(plan: Plan, task: Task, found: Outcomes) -> Trajectories:
    """Return names, invariants, arguments and tolerances, which results of single trajectories need."""
    events, points = plan.functions.events, plan.functions.breakpoints
    acting = any(event.action is not None for event in events) or any(point.action is not None for point in points)
    times = np.array([point.t for point in points])
    return Trajectories(
        task.problem.name,
        plan.called.events,
        plan.names[: len(plan.bound)],
        None if acting or plan.bound.jumps_at(times, plan.y0) else plan.bound,
        task.args,
        plan.rtol,
        plan.atol,
        found.error and found.error[1],
    )
