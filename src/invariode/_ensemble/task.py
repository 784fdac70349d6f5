"""The task of an ensemble: a problem, a method and options, for all rows or for some of them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._base.types import MethodName, OnFailure
from .._plan.plan import Plan, make_plan
from .._problem.options import Options
from .._problem.problem import Problem


@dataclasses.dataclass
class Task:
    """A problem with method, options and rows; picklable if the functions are."""

    problem: Problem
    method: MethodName
    options: Options
    y0: Array
    args: tuple[Any, ...] | list[tuple[Any, ...]] | Array  # of all, or of each
    in_lanes: bool

    def plan(self, i: int) -> Plan:
        args = self.args if isinstance(self.args, tuple) else self.args[i]
        if isinstance(args, np.ndarray):
            args = tuple(args.tolist())
        return make_plan(self.problem.replace(y0=self.y0[i], args=args), self.method, self.options)


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

    def task(self, y0: Array, args: Any, attempt: int = 0) -> Task:
        """Return the task of solving these rows by one of the attempts."""
        chosen = self.attempts[attempt]
        return Task(self.problem, chosen.method, chosen.options, y0, args, self.in_lanes)


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
