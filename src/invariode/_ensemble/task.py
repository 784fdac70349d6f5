"""The task of an ensemble: a problem, a method and options, for all rows or for some of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import Array, quietly
from .._base.types import MethodName, OnFailure
from .._functions.graph.plain import only_calculates
from .._plan.plan import Plan, solver
from .._problem.options import Options
from .._problem.problem import Problem
from .._problem.start import ChangedStart
from .._run.prepared import OnCourse, kind_of, run_or_plan, shared_or_plan

#: Rows with arguments of these types are of one kind, whatever the values.
_NUMBERS = frozenset({float, int})
#: Types of arguments whose arithmetic runs no code of users.
_PLAIN = (int, float, complex, str, np.number, np.bool_, type(None))


@dataclasses.dataclass
class Task:
    """A problem with method, options and rows; picklable if the functions are."""

    problem: Problem
    method: MethodName
    options: Options
    y0: Array
    args: tuple[Any, ...] | list[tuple[Any, ...]] | Array  # of all, or of each
    in_lanes: bool
    first_here: bool = False  # see `_ensemble.local`
    _alike: tuple[OnCourse, Plan] | None = None  # of the rows, found with the first

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_alike": None}

    def plan(self, i: int) -> Plan:
        """Return the plan of one trajectory."""
        found = shared_or_plan(self._problem(i), self.method, self.options)
        if isinstance(found, Plan):
            return found
        self._share(found)
        return found.prepared.plan_of(found.problem, found.course, None)

    def run(self, i: int) -> tuple[_core.Run, Plan, Callable[[], Plan]]:
        """Return the run of one trajectory, the plan that all trajectories of its kind share, and a function that
        returns the trajectory's own plan."""
        args = self.args_of(i)
        if self._alike is not None:
            (prepared, first, course), plan = self._alike
            if args is first.args or _numbers_alike(args, first.args):
                y0, limit = np.ascontiguousarray(self.y0[i]), self.options.get("callback")
                run = prepared.run(first, y0, args, course, limit=limit, remember=False)
                if run is not None:
                    return run, plan, lambda: prepared.plan_of(self._problem(i), course, run)
        with quietly():  # the first plan has given the warnings
            begun = run_or_plan(self._problem(i), self.method, self.options, remember=False)
            if isinstance(begun, Plan):
                return solver(begun).integrate(begun.start), begun, lambda: begun
            shared, run = begun
            if self.options.get("breakpoints") is None:
                self._share(shared)
            plan = shared.prepared.plan_of(shared.problem, shared.course, run)
            return run, plan, lambda: plan

    def _share(self, shared: OnCourse) -> None:
        """Run further rows by a plan: only the types of y0 and of the arguments decide the kind of a row."""
        self._alike = shared, shared.prepared.plan._replace(course=shared.course)

    def only_calculates(self) -> bool:
        """Return whether the functions of the rows do nothing but calculate with numbers: they cannot end a process."""
        problem, callback = self.problem, self.options.get("callback")
        if self.options.get("breakpoints") is not None or kind_of(problem, self.method, self.options) is None:
            return False  # such problems may call other functions than those below
        laws, events = problem.invariants, problem.events
        called = [problem.fun, *(one.fun for one in laws), *(one.jac for one in laws if callable(one.jac))]
        called += [f for event in events for f in (event.fun, event.action) if f is not None]
        rows = [self.args] if isinstance(self.args, tuple) else self.args
        return all(map(only_calculates, called if callback is None else [*called, callback])) and (
            isinstance(rows, np.ndarray) or all(isinstance(one, _PLAIN) for row in rows for one in row)
        )

    def args_of(self, i: int) -> tuple[Any, ...]:
        """Return the arguments of one trajectory."""
        args = self.args if isinstance(self.args, tuple) else self.args[i]
        return tuple(args.tolist()) if isinstance(args, np.ndarray) else args

    def _problem(self, i: int) -> Problem:
        problem, args, y0 = self.problem, self.args_of(i), self.y0[i]
        if problem.y0_of_args is None:
            return problem.replace(y0=y0, args=args)
        follows = problem.start_with(args) == y0  # such components follow the arguments, with their derivatives
        if follows.all():
            return problem.replace(args=args)
        if problem.sensitivities is None or not follows.any():
            return problem.replace(y0=y0, args=args)
        labels = problem.labels
        values = {labels[j]: y0[j] for j in np.flatnonzero(~follows)}
        return problem.replace(y0=ChangedStart(problem.y0_of_args, labels, values), args=args)


def _numbers_alike(args: tuple[Any, ...], others: tuple[Any, ...]) -> bool:
    """Return whether arguments are numbers of the types of others."""
    types = tuple(map(type, args))
    return types == tuple(map(type, others)) and _NUMBERS.issuperset(types)


@dataclasses.dataclass
class Attempt:
    """A method with options."""

    method: MethodName
    options: Options


@dataclasses.dataclass
class Ensemble:
    """A problem with its attempts, without the rows; picklable if the functions are."""

    problem: Problem
    attempts: list[Attempt]  # the first, and those for rows that failed
    in_lanes: bool  # if they can be
    on_failure: OnFailure
    first_here: bool = False  # see `Task`

    def task(self, y0: Array, args: Any, attempt: int = 0) -> Task:
        """Return the task of solving these rows by one of the attempts."""
        chosen = self.attempts[attempt]
        return Task(self.problem, chosen.method, chosen.options, y0, args, self.in_lanes, self.first_here)


def first_plan(task: Task) -> tuple[int, Plan]:
    """Return the first trajectory that has a plan, and the plan. What fails for many is wrong for all, and raised."""
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
