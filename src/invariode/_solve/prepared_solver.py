"""A solver that is made once and called often: the public face of `Prepared`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, extra_arguments, interval, quietly, require_no_unit
from .._base.types import MethodName, Span
from .._functions.compiled import CompiledFunction
from .._plan.planning import choose, planned
from .._problem.given_options import keeping_arrays
from .._problem.options import Options, ProblemArguments
from .._problem.problem import Problem
from .._results.messages import MESSAGES
from .._results.solution import Solution
from .._run.prepared import OnCourse, Prepared, prepared_or_plan
from .._run.run import Solved, finished_solution, solve


class PreparedSolver:
    """A problem, method and options, validated once; returned by `Problem.prepare`.

    ``solver()`` solves the problem, ``solver(y0=..., args=..., t_span=..., dy0dp=...)`` the problem with these changed.
    Several threads may call it at once.

    Attributes
    ----------
    problem : Problem
        The problem.
    method : str
        The method as given.
    native : bool
        True if runs call no Python function.
    """

    def __init__(self, problem: Problem, method: MethodName, options: Options) -> None:
        self.problem = problem
        self.method = method
        self._options = keeping_arrays(options)
        prepared = _prepared(problem, method, self._options)
        self.native = prepared.native
        #: The problem's own interval and output times, which those of its kind do not share.
        course = prepared.course(problem.t_span, problem.y0, self._options.get("t_eval"))
        self._shared = OnCourse(prepared, problem, course)
        self._source = Solved(problem, method, self._options)  # of runs in which nothing differs
        # Breakpoints lie in the interval.
        self._any_span = prepared.any_span and self._options.get("breakpoints") is None

    def __reduce__(self) -> tuple[type[PreparedSolver], tuple[Any, ...]]:
        return PreparedSolver, (self.problem, self.method, self._options)

    def __repr__(self) -> str:
        return f"PreparedSolver({self.problem!r}, {self.method!r})"

    def __call__(
        self,
        *,
        y0: ArrayLike | None = None,
        args: Iterable[Any] | None = None,
        t_span: Span | None = None,
        dy0dp: Any = None,
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
        dy0dp : array_like of shape (n, k) or callable, optional
            Derivatives of y0, for a problem with `sensitivities`, in place of those of its `Sensitivities`.

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
        if args is not None:
            require_no_unit("args", args)
        if y0 is not None:
            y0 = self.problem.start_by_name(y0)
        shared = self._shared
        prepared, problem, course = shared
        if dy0dp is not None and problem.sensitivities is None:
            raise ValueError("dy0dp is of no use without sensitivities, which the problem does not ask for")
        known = prepared.any_y0 and (args is None or prepared.any_args) and (t_span is None or self._any_span)
        start = problem.y0 if y0 is None else _as_state(y0, problem.y0)
        if y0 is None and args is not None and problem.y0_of_args is not None:
            start = _as_state(problem.start_with(args), problem.y0)
        if known and start is not None:
            if t_span is not None:
                course = prepared.course(interval(t_span), start, self._options.get("t_eval"))
                shared = shared._replace(course=course)
            run = prepared.run(problem, start, problem.args if args is None else args, course, dy0dp=dy0dp)
            if run is not None and (run.outcome or run.state in MESSAGES or run.steps > 0):
                source = self._source
                if y0 is not None or args is not None or t_span is not None or dy0dp is not None:
                    changed = partial(_changed, problem, None if y0 is None else start, args, t_span, dy0dp)
                    source = Solved(changed, self.method, self._options)
                return finished_solution(run, source, shared)
        # If the plan may differ, or a start failed, a single solve finds the right message.
        return solve(_changed(problem, y0, args, t_span, dy0dp), self.method, self._options)


def _prepared(problem: Problem, method: MethodName, options: Options) -> Prepared:
    """Return the plan of a problem; of a compiled f that of all problems of its kind, if it has one."""
    lent = options.get("breakpoints") is not None or options.get("callback") is not None
    if isinstance(problem.fun, CompiledFunction) and not lent:
        found = prepared_or_plan(problem, method, options)
        if isinstance(found, Prepared):
            return found
        with quietly():  # the plan has given the warnings
            choice = choose(method, options)
        return Prepared(problem, choice, found)
    choice = choose(method, options)
    return Prepared(problem, choice, planned(problem, choice))


def _as_state(y0: ArrayLike, like: Array) -> Array | None:
    """Return y0 as an array of its own, if it is of the same type and shape."""
    require_no_unit("y0", y0)
    try:
        state = np.array(y0)
    except ValueError:  # `solve` finds the right message
        return None
    if state.dtype.kind in "iu" and like.dtype.kind == "f":
        state = state.astype(float)
    return state if state.dtype == like.dtype and state.shape == like.shape else None


def _changed(
    problem: Problem, y0: ArrayLike | None, args: tuple[Any, ...] | None, t_span: Span | None, dy0dp: Any
) -> Problem:
    changes: ProblemArguments = {}
    if y0 is not None:
        changes["y0"] = y0
    if args is not None:
        changes["args"] = args
    if t_span is not None:
        changes["t_span"] = t_span
    if dy0dp is not None and problem.sensitivities is not None:
        changes["sensitivities"] = replace(problem.sensitivities, dy0dp=dy0dp)
    return problem.replace(**changes) if changes else problem
