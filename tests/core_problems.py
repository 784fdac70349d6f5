"""Solvers of the core for problems in its own records."""

from __future__ import annotations

from typing import Any

from invariode import _core
from invariode._base.arguments import Weights
from invariode._plan.plan import Course
from invariode._plan.planning import choose
from invariode._problem.core_problem import CoreProblem


def core_solver(
    method: str, problem: CoreProblem, tolerances: Weights, *, tf: float = 1.0, max_step: float = 0.1,
    times: Any = None, **settings: Any,
) -> _core.Solver:  # fmt: skip
    """A solver from 0 to tf with the usual settings, except those given."""
    course = Course(0.0, tf, max_step, times, 10**7, 2**32)
    return _core.Solver(method, problem, tolerances, course, choose("ode45", {}).settings._replace(**settings))
