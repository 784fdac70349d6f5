"""Prepared plans: a plan is checked once and runs many times, with other y0, arguments, intervals and functions.

`solve` keeps a few of them, by the kind of the problem; `Problem.prepare`, `odeint`, fits and the bridges to JAX and
PyTorch hold their own. What a plan has in common with other problems is checked once; everything else is checked in
each run, by the same code.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Mapping
from dataclasses import replace
from types import FunctionType
from typing import Any, NamedTuple, cast

import numpy as np

from .. import _core
from .._base.arguments import Array, call_name, warnings_given
from .._base.latest import Latest
from .._base.types import MethodName
from .._functions.compiled import (
    CompiledFunction,
    CoreFunction,
    is_native,
    is_plain_function,
    native_parameters,
)
from .._functions.graph.plain import use_of_time
from .._functions.increments import at_complex
from .._functions.layout import layout_of
from .._functions.second_order import SecondOrder
from .._laws.bound import MANY_COLUMNS, BoundInvariants, values_at_start
from .._plan.nystrom_requirements import fits_any_args
from .._plan.plan import Choice, Course, Plan, solver
from .._plan.planning import choose, course_of, make_plan, names_of, planned
from .._problem.core_problem import InvariantSpec, LinearTerms
from .._problem.events import Event, direction_sign, terminal_count
from .._problem.invariants import Invariants
from .._problem.jacobian_and_mass import NO_MATRICES
from .._problem.methods import find_method
from .._problem.options import Options
from .._problem.problem import Problem
from .._problem.sensitivities import OF_ALL_ARGS, Sensitivities
from .._sensitivity.landings import switches_in_time

#: From this many bytes of y0 on, 200 reals, sparsity is looked for where there are Jacobians, which depends on f; and
#: from 10,000 reals on the work of a plan is small compared with that of a step.
_LARGE, _HUGE = 200 * 8, 10_000 * 8

#: Prepared plans by the kinds of their problems; a compiled f has its own.
_kept: Latest[Hashable, Prepared] = Latest()

#: In the place of a function that is lent in each run.
_LENT: Any = ...


class Prepared:
    """A plan that runs many times, with the core's solvers that carry it out.

    Parameters
    ----------
    problem : Problem
        A problem of the plan's kind.
    choice : Choice
        The method with its options.
    plan : Plan
        The plan.
    lends : bool
        Each run is for a problem with Python functions of its own, of which nothing is kept. Otherwise they are those
        of `problem`.

    Attributes
    ----------
    plan : Plan
        The plan, which all runs have in common; `plan_of` returns that of a run.
    members : tuple of str
        The methods that take turns.
    native : bool
        Whether runs call no Python function.
    any_y0, any_args, any_span : bool
        Whether the plan holds for another initial state, other arguments, another interval.
    simple : bool
        Whether solutions have nothing that is computed from the run, such as sensitivities or a continuous solution.
    """

    def __init__(self, problem: Problem, choice: Choice, plan: Plan, *, lends: bool = False) -> None:
        self.choice, self._lends = choice, lends
        self.plan = _without_functions(plan) if lends else plan
        self._remarks = self.plan.remarks
        core = solver(self.plan)
        self.members = core.members
        #: Idle solvers: a run takes one, or makes another.
        self._idle = deque([core])
        self._course: Course | None = None  # of the latest run without output times
        self._starts = bool(plan.bound.specs) and not all(map(_is_native, plan.bound.specs))
        self.native: bool = core.native
        self.any_y0 = _of_any_y0(problem, plan, self.native)
        self.any_args = self.any_y0 and _of_any_args(problem, plan)
        self.any_span = self.any_y0 and _of_any_span(problem, plan)
        self._parameters, self._complex = plan.functions.parameters.size > 0, plan.functions.complex
        self._varied = plan.varied
        self.simple = plan.varied is None and plan.watch is None and not (plan.settings.dense or plan.settings.sections)
        #: Whether runs are lent Python functions, and whether there is any besides f.
        self._lent = bool(lends and _functions_of(problem, plan.bound))
        self._calls_others = bool(problem.invariants or problem.events)

    def course(self, t_span: tuple[float, float], y0: Array, t_eval: Any) -> Course:
        """Return the course over an interval: on the course of its latest run a solver is already."""
        if t_eval is not None:
            return course_of(self.choice, t_span, y0, t_eval)
        known = self._course
        if known is None or known[:2] != t_span:
            known = self._course = course_of(self.choice, t_span, y0, None)
        return known

    def run(
        self,
        problem: Problem,
        y0: Array,
        args: tuple[Any, ...],
        course: Course,
        *,
        breaks: Array | None = None,
        limit: Any = None,
        remember: bool = True,
        dy0dp: Any = None,
    ) -> _core.Run | None:
        """Return a run from y0 on a course. None: the plan does not hold for it, and a plan of its own is needed, or
        says what is wrong.

        Parameters
        ----------
        problem : Problem
            The problem with the functions of the run.
        y0 : ndarray, (n,)
            The initial state.
        args : tuple
            Its arguments.
        course : Course
            The interval, output times and limits.
        breaks : ndarray, optional
            Breakpoints of a plan that is lent functions, without actions.
        limit : StepLimit, optional
            The limit of steps of such a plan, its only callback.
        remember : bool, default True
            The run can be extended.
        dy0dp : array_like or callable, optional
            Derivatives of y0 in place of those of the problem's `Sensitivities`.
        """
        functions: tuple[Any, ...] | None = None
        value = tolerances = None
        if self._starts:
            plan = self.plan
            value = values_at_start(plan.bound, problem.invariants, course.t0, y0, args, plan.tolerances.threshold)
            if value is None:
                return None
        if self._lent:
            functions = _functions_of(problem, self.plan.bound) if self._calls_others else (problem.fun,)
        elif self._lends:
            functions = ()
        if self._complex:
            y0 = y0.view(float)
        if (varied := self._varied) is not None:
            tolerances = varied.tolerances_at(y0, args)
            y0 = varied.augmented(y0, args, dy0dp)
        try:
            core = self._idle.pop()
        except IndexError:
            core = solver(self.plan)
        parameters: Array | None = None
        while True:
            run = core.integrate_anew(
                y0, functions, args, parameters, course, breaks, limit, remember, self._remarks, value, tolerances
            )
            if run is not None or not self._parameters or parameters is not None:
                break
            parameters = layout_of(args).numbers  # args are not only floats
        self._idle.append(core)  # but not after an exception
        return run

    def plan_of(self, problem: Problem, course: Course, run: _core.Run | None) -> Plan:
        """Return the plan as a run of a problem carried it out; without invariants, a run is not needed."""
        plan, described = self.plan, problem
        bound = replace(plan.bound, args=problem.args, forward=course.forward)
        if bound.specs:
            used = [f for one in described.invariants for f in (one.fun, one.jac, one.metric)]
            assert run is not None
            bound = replace(bound, value=run.value, parameters=native_parameters(problem.args, used))
            if self._lends:
                bound = bound.with_functions(described.invariants)
        called = names_of(problem, list(plan.called.events))
        return plan._replace(course=course, bound=bound, called=called, y0=problem.y0)


class OnCourse(NamedTuple):
    """A prepared plan with the problem and the course of its runs, which differ in y0 and args."""

    prepared: Prepared
    problem: Problem
    course: Course


# ----------------------------------------------------------------------------------------------------------------------
# What a plan holds for


def _of_any_y0(problem: Problem, plan: Plan, native: bool) -> bool:
    """Return whether the plan is valid for every y0. The motion of a mechanical system counts its work, and algebraic
    equations and events at the start need work before the run."""
    alone = plan.progress or plan.on_interrupt != "raise" or plan.checkpoint is not None
    counts = isinstance(problem.fun, CoreFunction) and not isinstance(problem.fun, SecondOrder)
    if alone or counts or any(event.at_start for event in problem.events):
        return False
    if not all(one.stateless for one in plan.roots):  # their memory belongs to one run
        return False
    linear = plan.functions.linear
    if linear is not None and (linear.algebraic or not (native or _by_differences(linear))):
        return False
    if plan.varied is not None and not (native and plan.varied.own_to_each is None and not problem.events):
        return False
    compiled = [*map(_is_native, plan.bound.specs)]
    return all(compiled) or (not any(compiled) and all(map(_starts_anywhere, problem.invariants, plan.bound.specs)))


def _by_differences(linear: LinearTerms) -> bool:
    """Return whether the Jacobian is formed in each run from values of f, in a structure that does not depend on f."""
    return linear.kind == "differences" and not linear.found_pattern


def _is_native(spec: InvariantSpec) -> bool:
    return isinstance(spec.fun, _core.Native) or not callable(spec.fun)


def _starts_anywhere(one: Invariants, spec: InvariantSpec) -> bool:
    """Return whether everything that is found of a Python invariant at the start is its values."""
    return type(one) is Invariants and one.metric is None and (isinstance(spec.jac, str) or spec.jac is one.jac)


def _of_any_args(problem: Problem, plan: Plan) -> bool:
    """Return whether the plan is valid for all arguments: compiled functions take any numbers, and no landing depends
    on them."""
    if plan.schedule is not None and plan.schedule.depends_on_args:
        return False
    if plan.varied is not None and plan.functions.delays is not None and plan.functions.delays.varied:
        return False
    if not fits_any_args(problem, plan.method.name):
        return False
    p = plan.functions.parameters
    return not p.size or p.may_vary(plan.constants)


def _of_any_span(problem: Problem, plan: Plan) -> bool:
    """Return whether the plan is valid for all intervals. What is dissipated depends on the direction of time."""
    return (
        not (problem.inputs or problem.breakpoints or any(plan.bound.senses))
        and plan.schedule is None
        and (plan.expansion is None or plan.expansion.of_any_span)
    )


# ----------------------------------------------------------------------------------------------------------------------
# Plans for all problems of a kind


def prepared_or_plan(problem: Problem, method: MethodName, options: Options) -> Prepared | Plan:
    """Return the prepared plan for all problems of this kind, or the problem's own plan if there can be none."""
    kind = kind_of(problem, method, options)
    kept: Latest[Hashable, Prepared] = problem.fun.prepared if isinstance(problem.fun, CompiledFunction) else _kept
    known = None if kind is None else kept.get(kind)
    if known is not None:
        return known
    before = warnings_given()
    described, choice = problem, choose(method, options)
    plan = planned(described, choice)
    if kind is None or warnings_given() != before or not _holds_for_all(plan, described):
        return plan
    choice = choice._replace(options=cast("Options", {**choice.options, "t_eval": None}))
    prepared = Prepared(described, choice, plan, lends=True)
    if not (prepared.any_y0 and prepared.any_args and prepared.any_span):
        return plan
    kept[kind] = prepared
    return prepared


def shared_or_plan(problem: Problem, method: MethodName, options: Options) -> OnCourse | Plan:
    """Return the plan that all problems of a kind share, for one whose f is in Python; or the problem's own plan, if
    there is no such plan, or it follows from more than y0 and args."""
    more = problem.invariants or options.get("breakpoints") is not None
    if type(problem.fun) is not FunctionType or more:
        return make_plan(problem, method, options)
    found = prepared_or_plan(problem, method, options)
    if not isinstance(found, Prepared):
        return found
    return OnCourse(found, problem, found.course(problem.t_span, problem.y0, options.get("t_eval")))


def run_or_plan(
    problem: Problem, method: MethodName, options: Options, *, remember: bool = True
) -> tuple[OnCourse, _core.Run] | Plan:
    """Return the run of a problem by the plan that all problems of its kind share; or the problem's own plan, if there
    is no such plan, or it does not hold for this problem. `remember`: the run can be extended."""
    found = prepared_or_plan(problem, method, options)
    if not isinstance(found, Prepared):
        return found
    course = found.course(problem.t_span, problem.y0, options.get("t_eval"))
    breaks, limit = options.get("breakpoints"), options.get("callback")
    if breaks is not None:
        breaks = _core.plain_breakpoints(breaks, course.t0, course.tf, ends=True)
        if breaks is None:
            raise ValueError("breakpoints have changed while they were read: give them in a list of their own")
    run = found.run(problem, problem.y0, problem.args, course, breaks=breaks, limit=limit, remember=remember)
    return make_plan(problem, method, options) if run is None else (OnCourse(found, problem, course), run)


def kind_of(problem: Problem, method: MethodName, options: Options) -> Hashable | None:
    """Return a key of all problems that have a plan in common: the method, the options, and everything that a plan
    takes from a problem besides its functions, y0, args and interval. None: this problem is the only one of its kind.
    """
    fun, y0, matrices = problem.fun, problem.y0, problem.matrices
    compiled = isinstance(fun, CompiledFunction)
    if not (compiled or type(fun) is FunctionType or is_plain_function(fun)) or not isinstance(method, str):
        return None
    if problem.inputs or problem.breakpoints or problem.second_order or problem.delays is not None:
        return None
    given = _core.plain_options(options)
    if given is None or matrices is not NO_MATRICES or y0.nbytes >= _HUGE:
        return None
    if y0.nbytes >= _LARGE and (problem.sensitivities is not None or "jac" in find_method(method)[0].options):
        return None
    bounds = None if problem.bounds is None else tuple([one.tobytes() for one in problem.bounds])
    types: tuple[type, ...] = ()
    laws: tuple[Any, ...] = ()
    events: tuple[Any, ...] = ()
    varied: tuple[Any, ...] | None = ()
    if problem.invariants:
        if y0.nbytes >= 8 * MANY_COLUMNS and any(callable(one.jac) for one in problem.invariants):
            return None  # it may return a sparse matrix, which its first call tells
        laws = tuple([_law(one, compiled) for one in problem.invariants])
    if problem.events:
        events = tuple([_event(one, compiled) for one in problem.events])
    if problem.sensitivities is not None:
        varied = _varied(problem, problem.sensitivities)
    if None in laws or None in events or varied is None:
        return None
    if compiled:
        fun.renew()
        types = tuple(map(type, problem.args))
        if not _NUMBERS.issuperset(types):
            return None
    timed = "" if compiled else use_of_time(fun, problem.args)
    if timed == "switches" and switches_in_time(problem):
        return None
    recorded = problem.records_events, problem.signed_states, timed == "none"
    return method, y0.shape, y0.dtype.kind, recorded, bounds, laws, events, varied, types, given


def _varied(problem: Problem, wanted: Sensitivities) -> tuple[Any, ...] | None:
    """Return the data of sensitivities of a compiled f whose derivatives and start are not functions."""
    given, scale = wanted.dy0dp, wanted.scale
    if wanted is OF_ALL_ARGS:
        return (wanted,) if isinstance(problem.fun, CompiledFunction) else None
    own = wanted.dfdp is not None or callable(given) or isinstance(scale, Mapping)
    if own or not isinstance(problem.fun, CompiledFunction):
        return None
    arrays: list[Any] = [None if one is None else np.asarray(one) for one in (given, scale)]
    numbers = [None if one is None else (one.shape, one.dtype.char, one.tobytes()) for one in arrays]
    return problem.parameter_names(), wanted.error_test, *numbers


def _code_of(fun: Any, compiled: bool) -> object | None:
    """Return what distinguishes plans by a function: True, nothing, for a Python function; the code of a compiled one
    beside a compiled f, which stores the plan. None: problems with this function share no plan."""
    if not isinstance(fun, CompiledFunction):
        return True if is_plain_function(fun) else None
    if not compiled:
        return None
    fun.renew()
    return fun.version


def _law(one: Invariants, compiled: bool) -> tuple[Any, ...] | None:
    """Return the data of an invariant whose functions are Python's, or all of them compiled."""
    code = _code_of(one.fun, compiled) if type(one) is Invariants and one.metric is None else None
    jac = _code_of(one.jac, compiled) if callable(one.jac) else one.jac
    if code is None or (callable(one.jac) and (jac is None or (jac is True) != (code is True))):
        return None
    value = None if one.value is None else one.value.tobytes()
    lists = (tuple(one.names or ()), tuple(one.moves or ()))
    return code, jac, value, call_name(one.fun, "g"), *lists, one.iterations, one.when, one.level, one.direction


def _event(event: Event, compiled: bool) -> tuple[Any, ...] | None:
    """Return the data of an event whose functions are Python's or compiled."""
    code = _code_of(event.fun, compiled) if type(event) is Event and not event.at_start else None
    action = False if event.action is None else _code_of(event.action, compiled)
    if code is None or action is None:
        return None
    which = terminal_count(event), direction_sign(event), code, action, event.__name__
    return *which, event.rehold, event.samples, event.touching, event.at_jumps


_NUMBERS = frozenset({float, int})


def _holds_for_all(plan: Plan, problem: Problem) -> bool:
    """Return whether the plan is independent of Python functions, which the core calls as they are."""
    return (
        (isinstance(problem.fun, CompiledFunction) or plan.functions.fun is problem.fun)
        and plan.method.equations == "any"
        and plan.schedule is None
        and not plan.settings.sections
    )


def _without_functions(plan: Plan) -> Plan:
    """Return the plan without Python functions, their arguments and y0."""

    def lent(fun: Any) -> Any:
        return _LENT if callable(fun) and not isinstance(fun, _core.Native) else fun

    functions = plan.functions._replace(
        fun=lent(plan.functions.fun),
        args=(),
        callback=None,
        events=[event._replace(fun=lent(event.fun), action=lent(event.action)) for event in plan.functions.events],
        invariants=[law._replace(fun=lent(law.fun), jac=lent(law.jac)) for law in plan.functions.invariants],
    )
    bound = replace(plan.bound, specs=functions.invariants, args=())
    return plan._replace(functions=functions, bound=bound, y0=plan.y0[:0].copy())


def _functions_of(problem: Problem, bound: BoundInvariants) -> tuple[Any, ...]:
    """Return the Python functions of a problem in the order in which the core makes its own of them."""
    own = () if isinstance(problem.fun, CompiledFunction) else (problem.fun,)
    if not problem.invariants and not problem.events:
        return own
    laws = [
        f
        for one, spec in zip(problem.invariants, bound.specs, strict=True)
        if not isinstance(one.fun, CompiledFunction)
        for f in (one.fun, *_derivative_of(one, spec))
    ]
    events = [f for event in problem.events for f in (event.fun, event.action) if f is not None and not is_native(f)]
    return (*own, *laws, *events)


def _derivative_of(one: Invariants, spec: InvariantSpec) -> tuple[Any, ...]:
    """Return the second function that the core makes of a Python invariant, if there is one."""
    if callable(one.jac):
        return (one.jac,)
    if spec.jac == "complex-step":
        return (one.fun,)
    return (at_complex(one.fun, spec.m),) if spec.jac == "complex-step or 3-point" else ()
