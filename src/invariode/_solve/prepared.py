"""A solver that is made once and called often: whatever does not change between solves is checked once."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import Array, extra_arguments, interval, require_no_unit
from .._base.types import MethodName, Span
from .._functions.compiled import CoreFunction, constants, native_parameters
from .._functions.layout import Arguments, count_of
from .._functions.second_order import SecondOrder
from .._plan.plan import Plan, longest_step, make_plan, solver
from .._plan.second_order import fits_any_args
from .._problem.description import Description
from .._problem.options import Options, ProblemArguments, keep_arrays
from .._results.messages import MESSAGES
from .._results.solution import Solution
from .._run.run import Finished, Solved, concluded, presented, solve

Cover: TypeAlias = tuple[float, float, float]
"""t0, tf and the largest step."""

#: Options that must fit the interval.
_OF_SPAN: tuple[Literal["t_eval", "breakpoints", "first_step"], ...] = ("t_eval", "breakpoints", "first_step")


class PreparedSolver:
    """A problem, method and options, validated once; returned by `Problem.prepare`.

    ``solver()`` solves the problem, ``solver(y0=..., args=..., t_span=...)`` the same problem with these changed.
    Several threads may call it at once.

    Attributes
    ----------
    problem : Problem
        The problem.
    method : str
        The method as given.
    """

    def __init__(self, problem: Description, method: MethodName, options: Options) -> None:
        self.problem = problem
        self.method = method
        self._options = options.copy()
        keep_arrays(self._options)
        plan = self._plan = make_plan(problem, method, self._options)
        core = solver(plan)
        #: Idle solvers: a thread takes one, or makes another.
        self._idle = deque([core])
        self._members = core.members
        self._complex = plan.functions.complex
        # Whether the plan holds for another y0, for other args, for another interval.
        self._any_y0 = _of_any_y0(problem, plan, core.native)
        self._any_args = self._any_y0 and core.native and _may_vary(problem, plan) and fits_any_args(problem, method)
        self._any_args = self._any_args and not (plan.schedule is not None and plan.schedule.depends_on_args)
        free = not (problem.inputs or problem.breakpoints) and not any(
            plan.bound.senses
        )  # what is dissipated depends on the direction of time
        free = free and plan.schedule is None and (plan.expansion is None or plan.expansion.of_any_span)
        self._any_span = self._any_y0 and free and all(options.get(one) is None for one in _OF_SPAN)

    def __reduce__(self) -> tuple[type[PreparedSolver], tuple[Any, ...]]:
        return PreparedSolver, (self.problem, self.method, self._options)

    def __repr__(self) -> str:
        return f"PreparedSolver({self.problem!r}, {self.method!r})"

    def __call__(
        self, *, y0: ArrayLike | None = None, args: Iterable[Any] | None = None, t_span: Span | None = None
    ) -> Solution:
        """Solve the problem, or one that differs from it.

        Parameters
        ----------
        y0 : array_like of shape (n,), optional
            Another initial state.
        args : tuple or dict, optional
            Other extra arguments; for a problem with `parameters`, other values of some of them by name.
        t_span : (float, float), optional
            Another interval. It must contain `t_eval`, if that was given.

        Returns
        -------
        Solution
            Bit for bit the same as that of ``problem.replace(...).solve(method, **options)``.

        Raises
        ------
        TypeError, ValueError, InvariantError
            As for `Problem.solve`.
        """
        if args is not None and type(args) is not tuple:
            args = extra_arguments(self.problem.arguments(args))
        known = self._any_y0 and (args is None or self._any_args) and (t_span is None or self._any_span)
        start = self._plan.y0 if y0 is None else _as_state(y0, self._plan.y0)
        if known and start is not None:
            beginning = start if self._plan.varied is None else self._plan.varied.augmented(start)
            cover = None if t_span is None else self._covering(t_span)
            run = self._run(beginning, args, cover)
            if run is not None and (run.state in MESSAGES or run.counts[0] > 0):
                source = Solved(
                    lambda: _changed(self.problem, run.take_start()[: len(start)], args, t_span),
                    self.method,
                    self._options,
                )
                plan_of_run = partial(self._as_run, run, args, cover)
                sol = presented(Finished(run, self._plan, source, self._members, plan_of_run))
                return concluded(sol, self._plan.on_failure)
        # If the plan may differ, or a start failed, a single solve finds the right message.
        return solve(_changed(self.problem, y0, args, t_span), self.method, self._options)

    def _run(self, y0: Array, args: tuple[Any, ...] | None, cover: Cover | None) -> _core.Run | None:
        """Return the run of an idle solver. None: y0 is not finite, or the functions take other arguments."""
        try:
            core = self._idle.pop()
        except IndexError:
            core = solver(self._plan)
        if self._complex:
            y0 = y0.view(float)
        run = core.integrate_anew(y0, args, cover)
        if run is None and args is not None:  # not only floats
            require_no_unit("args", args)
            run = core.integrate_anew(y0, native_parameters(args, [self.problem.fun]), cover)
        self._idle.append(core)  # but not after an exception
        return run

    def _as_run(self, run: _core.Run, args: tuple[Any, ...] | None, cover: Cover | None) -> Plan:
        """Return the plan as the run carried it out."""
        plan = self._plan
        if cover is not None:
            t0, tf, max_step = cover
            plan = plan._replace(settings=plan.settings._replace(t0=t0, tf=tf, max_step=max_step))
        if plan.bound.specs:
            bound = replace(plan.bound, value=run.value)
            if args is not None:
                used = [f for one in self.problem.invariants for f in (one.fun, one.jac, one.metric)]
                bound = replace(bound, args=args, parameters=native_parameters(args, used))
            plan = plan._replace(bound=bound)
        return plan

    def _covering(self, t_span: Span) -> Cover:
        t0, tf = interval(t_span)
        return t0, tf, longest_step(self._options.get("max_step", math.inf), abs(tf - t0))


def _may_vary(problem: Description, plan: Plan) -> bool:
    """Return whether compiled functions take any numbers as arguments."""
    p = plan.functions.parameters
    arguments = count_of(p)
    called = [problem.fun, *(one.fun for one in (*problem.invariants, *problem.events))]
    return not isinstance(arguments, Arguments) or arguments.may_vary(constants(called, p))


def _of_any_y0(problem: Description, plan: Plan, native: bool) -> bool:
    """Return whether the plan is valid for every y0. The core can fix native invariants at their values there; the
    motion of a mechanical system counts its work, and algebraic equations and events at the start need work before the
    run."""
    alone = plan.progress or plan.on_interrupt != "raise" or plan.checkpoint is not None
    counts = isinstance(problem.fun, CoreFunction) and not isinstance(problem.fun, SecondOrder)
    if alone or counts or not _of_any_parameters(problem, plan, native):
        return False
    if any(event.at_start for event in problem.events):
        return False
    linear = plan.functions.linear
    return linear is None or not linear.algebraic if native else linear is None and not plan.bound.specs


def _of_any_parameters(problem: Description, plan: Plan, native: bool) -> bool:
    """Return whether the sensitivities, if there are any, are computed alike for all values of the parameters: their
    tolerances if their scale is given. Python has derivatives of events, and of functions that are not native, at one
    value."""
    wanted = problem.sensitivities
    if wanted is None:
        return True
    absolute = bool(np.all(np.asarray(plan.atol) > 0))
    return (
        native
        and absolute
        and wanted.scales_all(problem.parameter_names())
        and wanted.dy0dp is None
        and not problem.events
    )


def _as_state(y0: ArrayLike, like: Array) -> Array | None:
    """y0 as an array, if it is of the same type and shape."""
    require_no_unit("y0", y0)
    if not isinstance(y0, np.ndarray):
        try:
            y0 = np.array(y0)
        except ValueError:  # `solve` finds the right message
            return None
    if y0.dtype.kind in "iu" and like.dtype.kind == "f":
        y0 = y0.astype(float)
    return y0 if y0.dtype == like.dtype and y0.shape == like.shape else None


def _changed(
    problem: Description, y0: ArrayLike | None, args: tuple[Any, ...] | None, t_span: Span | None
) -> Description:
    changes: ProblemArguments = {}
    if y0 is not None:
        changes["y0"] = y0
    if args is not None:
        changes["args"] = args
    if t_span is not None:
        changes["t_span"] = t_span
    return problem.replace(**changes) if changes else problem
