"""Templates: plans for all problems of a kind, which differ in a Python f, y0, args, the interval, its output times and
breakpoints, and the state of a limit of steps.

What does not depend on these is checked once, when the first problem of the kind is solved, and the core's solver is
made once. Everything else is checked in each solve, by the same code.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import replace
from typing import cast

from .. import _core
from .._base.arguments import reals, warnings_given
from .._base.forks import short_lock
from .._base.types import MethodName
from .._laws.bound import bind
from .._plan.plan import Choice, Course, Plan, choose, course_of, names_of, planned, solver
from .._problem.description import Description, Posed
from .._problem.options import Options
from .._sensitivity.landings import switches_in_time

#: From so many reals on sparsity is looked for, which depends on f, and the work of a plan is small beside that of a
#: step.
_LARGE = 200

#: So many templates are kept, which is more than a script has calls of different kinds; the oldest goes first.
_MOST = 64

_templates: dict[Hashable, Template] = {}
_keeping = short_lock()


class Template:
    """A plan for all problems of a kind, with the core's solvers that carry it out. It holds nothing of the user's."""

    def __init__(self, choice: Choice, plan: Plan) -> None:
        core = _solver_for_all(plan)
        self.members = core.members
        self._choice = choice._replace(options=cast("Options", {**choice.options, "t_eval": None}))
        self._nothing_held = bind([], 0.0, plan.y0, (), 0.0)
        functions = plan.functions._replace(fun=None, args=(), callback=None)
        #: What the plans of all have in common.
        self.plan = plan._replace(
            settings=choice.settings, functions=functions, y0=plan.y0[:0].copy(), bound=self._nothing_held
        )
        self._remarks = self.plan.remarks
        #: Idle solvers: a run takes one, or makes another.
        self._idle = deque([core])

    def run(self, problem: Posed | Description, options: Options, *, remember: bool = True) -> tuple[_core.Run, Course]:
        """Run a problem of the template's kind; return the run and its course. `options`: those that the template was
        found for. `remember`: the run can be extended."""
        course = course_of(self._choice, problem, options.get("t_eval"))
        breaks, limit = options.get("breakpoints"), cast("_core.StepLimit | None", options.get("callback"))
        if breaks is not None:
            breaks = _core.plain_breakpoints(breaks, course.t0, course.tf, ends=True)
            if breaks is None:
                raise ValueError("breakpoints have changed while they were read: give them in a list of their own")
        try:
            core = self._idle.pop()
        except IndexError:
            core = None
        if core is None:
            core = _solver_for_all(planned(problem._described(), self._choice))
        run = core.integrate_other(
            problem.fun, problem.args, problem.y0, course, breaks, limit, remember, self._remarks
        )
        self._idle.append(core)  # but not after an exception
        return run, course

    def plan_of(self, problem: Posed | Description, course: Course) -> Plan:
        """Return the plan of a run on `course`, without the parts that are the user's."""
        bound = replace(self._nothing_held, args=problem.args, forward=1.0 if course.tf >= course.t0 else -1.0)
        return self.plan.on(course, bound, names_of(problem, []))


def _solver_for_all(plan: Plan) -> _core.Solver:
    """A solver that is lent f and its arguments in each run."""
    return solver(plan._replace(functions=plan.functions._replace(args=(), callback=None)))


def plan_or_template(problem: Posed | Description, method: MethodName, options: Options) -> Plan | Template:
    """The template for the problem, or a plan of its own if there can be none."""
    kind = _kind(problem, method, options)
    known = None if kind is None else _templates.get(kind)
    if known is not None:
        return known
    before = warnings_given()
    described, choice = problem._described(), choose(method, options)
    plan = planned(described, choice)
    if kind is None or warnings_given() != before or not _holds_for_all(plan, described):
        return plan
    template = Template(choice, plan)
    with _keeping:
        if len(_templates) >= _MOST:
            del _templates[next(iter(_templates))]
        _templates[kind] = template
    return template


def _kind(problem: Posed | Description, method: MethodName, options: Options) -> Hashable | None:
    """Return a key of all problems that have a plan in common; None: this problem is the only one of its kind."""
    n = reals(problem.y0)
    if not problem.is_plain or n >= _LARGE or type(method) is not str or switches_in_time(problem):
        return None
    given = _core.plain_options(options)
    return None if given is None else (method, n, problem.y0.dtype.kind, given)


def _holds_for_all(plan: Plan, problem: Description) -> bool:
    """Return whether the plan is independent of f, which the core calls as it is, and the run needs nothing around
    it."""
    linear = plan.functions.linear
    return (
        plan.functions.fun is problem.fun
        and plan.method.equations == "any"
        and (linear is None or linear.kind == "differences")
        and not plan.progress
        and plan.on_interrupt == "raise"
        and plan.checkpoint is None
        and not plan.settings.sections
    )
