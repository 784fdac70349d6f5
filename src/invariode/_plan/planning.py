"""Make a plan, in two parts: what the method and its options say (`choose`), and what this problem adds
(`planned`), in three stages: functions, linear algebra, invariants.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from .. import _core
from .._base.arguments import (
    EPS,
    LARGEST_COUNT,
    LEAST_RTOL,
    Array,
    Weights,
    distinct,
    kept,
    output_times,
    reals,
    shown,
    warn,
    weights_of,
)
from .._base.matrices import as_dense
from .._base.types import LargestStep, MethodName
from .._functions.compile import compile
from .._functions.compiled import (
    CompiledFunction,
    CoreFunction,
    Watch,
    constants,
    is_native,
    native_parameters,
    renew,
    to_native,
)
from .._functions.graph.derived import derived
from .._functions.graph.function import OnGraph
from .._functions.layout import ArgumentLayout, layout_of
from .._laws.bound import BoundInvariants, bind
from .._problem.breakpoints import Breakpoint, of_inputs, ordered
from .._problem.core_problem import CoreProblem, DelayTerms, LinearTerms
from .._problem.delays import Undelayed, stacked
from .._problem.events import RootOf, event_spec, vector_specs
from .._problem.given_options import INSTEAD_OF_MASS, checked
from .._problem.grouped import GMRES, Checkpoint, Limits, LinearSolver
from .._problem.inputs import fed
from .._problem.invariants import AccuracyWarning
from .._problem.jacobian_and_mass import Matrices
from .._problem.methods import METHODS, Method, find_method
from .._problem.options import Options
from .._problem.problem import Problem
from .._results.messages import inconsistent_start
from .._results.result import Names
from .._sensitivity.landings import Schedule, reads_time, schedule_of
from .nystrom_requirements import require_second_order

if TYPE_CHECKING:
    from .._linear.krylov import Krylov
    from .._linear.linear_terms import FunctionAtStart
    from .._taylor.expansion import SeriesSystem
from .plan import Choice, Course, Plan, Settings

#: Errors of ode15s at rtol 1e-4 are as large as requested if its steps are ten times as accurate (measured on the
#: problems of docs/theory/ode15s.md; the form of the rule is that of Hairer and Wanner's RADAU5).
CALIBRATION, CALIBRATED_AT = 0.1, 1e-4
#: The length of steps by series follows from coefficients, and their errors may be below one unit of roundoff: in long
#: runs their sum counts.
_LEAST_BY_SERIES = 1e-30


def make_plan(problem: Problem, method: MethodName, given: Options) -> Plan:
    """The plan, with everything that the core needs but y0."""
    return planned(problem, choose(method, given))


def choose(method: MethodName, given: Options) -> Choice:
    """The method and the options, as far as they can be checked without a problem."""
    chosen, implied = find_method(method)
    _require_linear_solver(chosen, given.get("linear_solver"))
    options = checked(given, chosen)
    if options["prefer"]:
        _require_linear_solver(find_method(options["prefer"][1])[0], options["linear_solver"])
    if options["bdf"] is None:
        options["bdf"] = implied.get("bdf", False)
    return Choice(chosen, options, _settings(chosen, options))


def planned(problem: Problem, choice: Choice) -> Plan:
    """The plan of a problem for the method and the options."""
    chosen, options, settings = choice
    renew(_called(problem, [], options))
    _require_delays(problem, chosen, options)
    by_series = chosen.equations == "graph"
    problem = (_on_graph(problem, chosen) if by_series else problem).of_one_run()
    _require_fitting(problem, chosen)
    rtol, atol = problem.by_component("rtol", options["rtol"]), problem.by_component("atol", options["atol"])
    weights = weights_of(rtol, atol, problem.y0, _LEAST_BY_SERIES if by_series else LEAST_RTOL)
    course = course_of(choice, problem.t_span, problem.y0, options["t_eval"])
    if options["calibrate"] and "calibrate" in chosen.options:
        factor = CALIBRATION * (weights.rtol / CALIBRATED_AT) ** (1 / (settings.max_order or chosen.order))
        weights = weights._replace(rtol=max(100 * EPS, min(1.0, factor) * weights.rtol))
    breakpoints = ordered_breakpoints(problem, options["breakpoints"])
    renew(point.action for point in breakpoints)
    traced = problem.fun if by_series else _with_graph(problem, chosen)
    parameters = native_parameters(problem.args, called := [traced, *_called(problem, breakpoints, options)])
    fun = problem.slope.for_core(problem.y0, parameters)
    if (problem.sensitivities is not None or problem.delays is not None) and not parameters.size:
        parameters = layout_of(problem.args)  # the equations of sensitivities are machine code
    schedule = schedule_of(problem, parameters)
    system = _system(problem, parameters, schedule) if by_series else None
    linear, y0 = _linear_algebra(problem, chosen, options, fun, traced, parameters, weights)
    bound = bind(problem.invariants, course.t0, y0, problem.args, weights.threshold)
    bound.forward = course.forward
    if bound.specs:
        _require_free_directions(bound, problem)
        iterations = bound.iterations or settings.iterations
        settings = settings._replace(iterations=iterations, negligible=bound.negligible)
    event_names = distinct([event.__name__ for event in problem.events]) if problem.events else []
    watch = None
    if isinstance(problem.fun, CoreFunction):
        watch = problem.fun.watch(course.t0, y0, problem.args, rtol, atol, options["callback"])
    plan = Plan(
        course=course,
        settings=settings,
        functions=_functions(problem, fun, parameters, linear, bound, watch, breakpoints, options),
        y0=y0,
        bound=bound,
        called=names_of(problem, event_names),
        method=chosen,
        tolerances=weights,
        moved=y0 is not problem.y0,
        names=[*bound.names, *(f"algebraic equation {i + 1}" for i in range(linear.algebraic if linear else 0))],
        event_names=event_names,
        records_events=problem.records_events,
        rtol=kept(rtol),
        atol=kept(atol),
        progress=options["progress"],
        on_interrupt=options["on_interrupt"],
        on_failure=options["on_failure"],
        checkpoint=cast("Checkpoint | None", options["checkpoint"]),
        watch=watch,
        schedule=schedule,
        constants=constants(called, parameters),
    )
    if problem.sensitivities is not None:
        plan = _with_sensitivities(plan, problem, breakpoints)
    if system is not None:
        plan = _with_expansion(plan, problem, system)
    return plan


def _require_fitting(problem: Problem, method: Method) -> None:
    """The problem is one for this method, and a warning for what the method ignores."""
    if problem.matrices.mass is not None and "mass" not in method.options:
        raise ValueError(
            f"mass: {method.name} is explicit and cannot use a mass matrix; use ode15s or radau, or {INSTEAD_OF_MASS}"
        )
    if method.equations == "second-order":
        require_second_order(problem, method)
    if method.equations != "graph" and any(event.touching for event in problem.events):
        warn(f"touching=True has no effect with {method.name}: only the steps of taylor are polynomials that can tell")


def _require_delays(problem: Problem, method: Method, options: Options) -> None:
    """If there are delays, the method takes them, and so does what else there is to the problem."""
    if problem.delays is None:
        return
    members = [method] if options["prefer"] is None else [find_method(one)[0] for one in options["prefer"]]
    if not all(one.delays for one in members):
        others = ", ".join(name for name, about in METHODS.items() if about.delays)
        name = next(one.name for one in members if not one.delays)
        raise ValueError(f"method {name!r} takes no delays: use one of {others}")
    if options["adjoint"]:
        raise ValueError("adjoint with delays: the adjoint equations look ahead. Use differences of solutions")
    if options["linear_solver"] != "direct":
        raise ValueError("linear_solver with delays must be 'direct', with jac_sparsity or bands where n is large")
    if problem.matrices.jac not in (None, "differences", "trace"):
        raise ValueError(
            "jac with delays: Newton's matrix has derivatives with respect to delayed values too, where these are "
            'within the step. Use jac="trace" or differences, with jac_sparsity or bands if n is large'
        )
    from .transit import contradiction  # the trace of a function that is known takes no time

    if (message := contradiction(problem)) is not None:
        warn(message, AccuracyWarning)


def _with_sensitivities(plan: Plan, problem: Problem, breakpoints: list[Breakpoint]) -> Plan:
    """The plan with the equations of the sensitivities, whose switches are events after those of the user."""
    from .._sensitivity.variations import make_variations

    varied = make_variations(problem, plan.y0, plan.tolerances, plan.bound.specs, breakpoints, plan.schedule)
    return plan._replace(
        varied=varied,
        schedule=varied.schedule,
        bound=plan.bound.varied(varied.tangents),
        functions=plan.functions._replace(events=[*plan.functions.events, *varied.switches]),
        event_names=[*plan.event_names, *(one.name for one in varied.switches)],
    )


def _with_expansion(plan: Plan, problem: Problem, system: SeriesSystem) -> Plan:
    """The plan with the series of the solution, and of the events along it."""
    from .._taylor.expansion import make_expansion, order_of

    order = partial(order_of, plan.method, plan.tolerances.rtol, plan.settings.max_order or None)
    expansion = make_expansion(problem, system, order, plan.functions.events, plan.varied)
    return plan._replace(expansion=expansion, functions=plan.functions._replace(events=expansion.events))


# ----------------------------------------------------------------------------------------------------------------------
# Options


def names_of(problem: Problem, event_names: list[str]) -> Names:
    """The names in tables and pictures."""
    return Names(problem.name, problem._title, problem._labels, len(problem.y0), event_names)


def _settings(method: Method, options: Options) -> Settings:
    """Return the settings of the method and its options."""
    at_times = options["t_eval"] is not None
    keep = options["keep"] or ("outputs" if at_times else "all")  # with t_eval no record, unless it is requested
    sections = options["adjoint"] == "checkpoints"
    dense = options["dense_output"] or options["adjoint"] is True
    if sections and dense:
        raise ValueError(
            'adjoint="checkpoints" is for runs whose continuous solution is not kept, and dense_output=True keeps it: '
            "give one of them"
        )
    if keep == "end" and (at_times or dense):
        other = "t_eval, dense_output and adjoint=True need"
        raise ValueError(f'keep="end" keeps only the final state: {other} keep="outputs" or "all"')
    if options["refine"] > 1 and (at_times or keep == "end"):
        other = "t_eval" if at_times else 'keep="end"'
        warn(f"refine has no effect together with {other}")
    limits, steps = options["limits"] or _UNLIMITED, options["max_steps"]
    if steps is not None and limits.steps is not None:
        raise ValueError(f"max_steps={steps} is short for limits=Limits(steps={steps}): give one of them")
    explicit_one, implicit_one = options["prefer"] or ("", "")
    return Settings(
        first_step=options["first_step"] or 0.0,
        refine=options["refine"],
        interpolation=options["interpolation"],
        dense=dense,
        sections=sections,
        save_all=keep != "end",
        record=keep == "all",
        check=bool(options["check"]),
        fsal=options["fsal"],
        max_order=_highest_order(method, options["max_order"]),
        bdf=bool(options["bdf"]),
        prefer_explicit=explicit_one,
        prefer_implicit=implicit_one,
        iterations=find_method(explicit_one)[0].iterations if explicit_one else method.iterations,
        max_steps=steps or limits.steps or LARGEST_COUNT,
        time_limit=limits.time or math.inf,
    )


def course_of(choice: Choice, t_span: tuple[float, float], y0: Array, t_eval: Any) -> Course:
    """Return the course from y0, (n,), over an interval, with its output times, which fill what may be kept."""
    t0, tf = t_span
    span, options = abs(tf - t0), choice.options
    times = None if t_eval is None else output_times(t_eval, t0, tf)
    first = choice.settings.first_step
    if first > span:
        raise ValueError(f"`first_step` exceeds bounds: the interval has length {span}, got {shown(first)}")
    limits = options["limits"]
    if limits is None and times is None:  # the common case
        most = _MOST_POINTS, _MOST_BYTES
    else:
        most = _most_kept(limits or _UNLIMITED, 0 if times is None else len(times), reals(y0))
    max_step = options["max_step"]
    return Course(t0, tf, longest_step(max_step, span) if max_step == "tenth" else max_step, times, *most)


def longest_step(given: LargestStep, span: float) -> float:
    """`max_step` on an interval of this length."""
    return span / 10 if given == "tenth" else given


#: What is kept if no limit says how much. With a few components this many points are less than a gigabyte.
_MOST_POINTS, _MOST_BYTES = 10**7, 4 * 2**30
_UNLIMITED = Limits()


def _most_kept(limits: Limits, demanded: int, n: int) -> tuple[int, int]:
    """Return the maximum numbers of points and bytes. `demanded`: number of output times, which the user wants and
    which do not count against defaults."""
    points, size = limits.points, limits.bytes
    if points is None and size is None:
        return _MOST_POINTS + demanded, _MOST_BYTES + demanded * 8 * (n + 1)  # of t and y, doubles
    return points or LARGEST_COUNT, size or LARGEST_COUNT


def _highest_order(method: Method, order: int | None) -> int:
    """0: the method's own."""
    if order is None or "max_order" not in method.options:
        return 0
    if not method.min_order <= order <= method.order:
        raise ValueError(f"max_order must be from {method.min_order} to {method.order} for {method.name}, got {order}")
    return order


# ----------------------------------------------------------------------------------------------------------------------
# Functions


def ordered_breakpoints(problem: Problem, given: Any) -> list[Breakpoint]:
    """Return the points where a run of the problem restarts, in their order: the breakpoints of the problem and of the
    run, and where its inputs jump."""
    if not given and not problem.inputs and not problem.breakpoints:
        return []
    return ordered([*problem.breakpoints, *(given or ()), *of_inputs(problem.inputs)], *problem.t_span)


def _delays(problem: Problem, parameters: ArgumentLayout, given: Any) -> DelayTerms | None:
    """The delays for the core, with the breakpoints of the problem and of the run that lie before the start."""
    if problem.delays is None:
        return None
    before = {point.t for point in (*problem.breakpoints, *(given or ())) if point.t < problem.t_span[0]}
    varied = problem.parameter_names()
    return problem.delays.for_core(problem.args, problem.y0, parameters, sorted(before), varied, problem.t_span[0])


def _with_graph(problem: Problem, method: Method) -> Any:
    """Return f as Jacobians are made of it: traced, if that was chosen; and if that is possible, where sensitivities
    have to satisfy algebraic equations, whose derivatives by finite differences would be off by up to 1e-6."""
    fun, jac = problem.fun, problem.matrices.jac
    if "jac" not in method.options or isinstance(fun, OnGraph):
        return fun
    if jac is None and problem.sensitivities is not None and problem.matrices.mass is not None:
        if is_native(fun) or problem.y0.dtype.kind == "c":
            return fun
        with suppress(TypeError), np.errstate(all="ignore"):  # it cannot be traced
            return compile(fun, by="trace")
    if not isinstance(jac, str) or jac != "trace":
        return fun
    if is_native(fun) and not isinstance(fun, CompiledFunction):
        raise TypeError(
            'jac="trace" needs a Python function, or one of invariode.compile: this fun is machine code, or belongs to '
            'the core. Give its Jacobian, or use jac="differences"'
        )
    if problem.y0.dtype.kind == "c":
        raise ValueError(
            'jac="trace" is for real y, and y0 is complex: fun need not be analytic. Use jac="differences", or write '
            "the problem in real and imaginary parts"
        )
    return compile(fun, by="trace")


def _called(problem: Problem, breakpoints: list[Breakpoint], options: Options) -> Iterator[Any]:
    yield from (problem.fun, problem.matrices.jac)
    if isinstance(chosen := options["linear_solver"], GMRES):
        yield chosen.jac_product
    yield from (f for one in problem.invariants for f in (one.fun, one.jac, one.metric))
    for event in problem.events:
        yield from (event.roots.fun,) if isinstance(event, RootOf) else (event.fun, event.action)
    yield from (point.action for point in breakpoints if point.action is not None)


def _functions(
    problem: Problem,
    fun: Any,
    parameters: ArgumentLayout,
    linear: LinearTerms | None,
    bound: BoundInvariants,
    watch: Watch | None,
    breakpoints: list[Breakpoint],
    options: Options,
) -> CoreProblem:
    n = reals(problem.y0)
    return CoreProblem(
        fun=fun,
        args=problem.args,
        n=n,
        complex=problem.y0.dtype.kind == "c",
        parameters=parameters,
        linear=linear,
        events=[event_spec(event, n, parameters) for event in problem.events],
        vectors=vector_specs(problem.events, n, parameters),
        breakpoints=[
            point
            if point.action is None
            else point._replace(action=to_native("the action in breakpoints", point.action, n, n, parameters))
            for point in breakpoints
        ],
        callback=watch or options["callback"],
        invariants=bound.specs,
        value=bound.value,
        bounds=problem.bounds,
        signed_states=problem.signed_states,
        autonomous=not reads_time(problem),
        delays=_delays(problem, parameters, options["breakpoints"]),
    )


def _on_graph(problem: Problem, method: Method) -> Problem:
    """Return the problem with f as its graph; the module for series is imported only when it is used."""
    from .._taylor.expansion import on_graph

    return on_graph(problem, method)


def _system(problem: Problem, parameters: ArgumentLayout, schedule: Schedule | None) -> SeriesSystem:
    """Return the graph of f as a system for Taylor series; its module is imported only when it is used."""
    from .._taylor.expansion import system_of

    return system_of(problem, parameters, () if schedule is None else schedule.landings.left_out)


# ----------------------------------------------------------------------------------------------------------------------
# Linear algebra


def _linear_algebra(
    problem: Problem,
    method: Method,
    options: Options,
    fun: Any,
    traced: Any,
    parameters: ArgumentLayout,
    weights: Weights,
    jac: str | None = None,
) -> tuple[LinearTerms | None, Array]:
    """Return the matrices of an implicit method for the core, and y0, moved where the algebraic equations of a singular
    mass matrix require it. `jac`: instead of the problem's."""
    if "jac" not in method.options:
        return None, problem.y0
    # SciPy's sparse matrices take longer to import than everything else
    from .._linear.linear_terms import FunctionAtStart, prepare, too_large_to_be_dense

    t0, y0, bounds = problem.t_span[0], problem.y0, problem.bounds
    if problem.delays is not None and not (problem.matrices.jac == "trace" or isinstance(problem.fun, OnGraph)):
        jac = "differences"
    matrices = replace(problem.matrices, jac=jac or fed(problem.matrices.jac, problem.inputs))
    direct = options["linear_solver"] == "direct"
    if "prefer" in method.options and direct and matrices.mass is None and too_large_to_be_dense(matrices, y0):
        return None, y0  # explicit throughout; a StiffnessWarning tells where that is not enough
    compiled = bounds is None and "prefer" not in method.options  # which may never need a Jacobian
    inside = y0 if bounds is None else bounds.nearest(y0)
    fun_of_y, traced = _of_state(problem, traced, parameters)
    delays = 0 if problem.delays is None else problem.delays.count
    start = FunctionAtStart(fun_of_y, t0, inside, problem.args, parameters, bounds, compiled, traced, delays)
    linear = prepare(matrices, start, _matrix_free(problem, matrices, options["linear_solver"], start))
    if not linear.algebraic:
        return linear, y0
    if problem.delays is not None:
        raise ValueError("delays with a singular mass matrix are not supported: solve the algebraic equations in fun")
    if not direct:
        raise ValueError(
            "GMRES cannot be used with a singular mass matrix, whose algebraic equations need the Jacobian as a "
            "matrix: use linear_solver='direct' with jac_sparsity or jac=Banded(lower, upper)"
        )
    algebraic = CoreProblem(
        reals(y0), y0.dtype.kind == "c", fun, problem.args, parameters, linear=linear, bounds=bounds
    )
    y, verdict = _core.consistent_start(t0, y0.view(float), algebraic, weights)
    if verdict == "undetermined" and matrices.jac is None and y0.dtype.kind != "c":
        with suppress(TypeError), np.errstate(all="ignore"):  # unless it can be traced, nothing more is known
            traced, jac = compile(problem.fun, by="trace"), "trace"
        if jac is not None:
            return _linear_algebra(problem, method, options, fun, traced, parameters, weights, jac)
    if verdict in ("index_too_high", "undetermined", "not_found"):
        raise ValueError(inconsistent_start(verdict, t0) + _largest_residual(problem, verdict))
    return linear, y.view(y0.dtype) if verdict == "corrected" else y0


def _largest_residual(problem: Problem, verdict: str) -> str:
    """Return the end of a message about a start without consistent values near it: the equation that is farthest off
    there, if it is known that rows of a constant mass matrix without entries are the algebraic equations."""
    mass = problem.matrices.mass
    if verdict != "not_found" or callable(mass) or not len(rows := np.flatnonzero(~as_dense(mass).any(axis=1))):
        return ""
    values = problem.slope(np.array(problem.t_span[:1]), problem.y0[:, None])[rows, 0]
    worst = int(np.argmax(np.abs(values)))
    return f"; the largest, component {rows[worst]}, is {values[worst]:.3g} at y0"


def _of_state(problem: Problem, traced: Any, parameters: ArgumentLayout) -> tuple[Any, Any]:
    """Return f of (t, y) as it is evaluated for its Jacobian, and as it is differentiated."""
    if problem.delays is not None:
        n, count = len(problem.y0), problem.delays.count
        return Undelayed(problem.slope.fun, count), stacked(fed(traced, problem.inputs, after=1), n, count, True)
    traced = fed(traced, problem.inputs)
    if problem.matrices.jac is None and not isinstance(problem.fun, OnGraph):
        n = len(problem.y0)
        try:
            derived(traced, n, n, parameters)
        except TypeError:  # it was traced for sensitivities, and cannot be
            traced = fed(problem.fun, problem.inputs)
    return problem.slope.fun, traced


def _require_linear_solver(method: Method, chosen: object) -> None:
    """`chosen` may be anything: options are checked later."""
    needs_exact_solutions = "jac" in method.options and "linear_solver" not in method.options
    if needs_exact_solutions and (isinstance(chosen, GMRES) or (isinstance(chosen, str) and chosen == "gmres")):
        others = ", ".join(name for name, about in METHODS.items() if "linear_solver" in about.options)
        raise ValueError(
            f"linear_solver: {method.name} has no iteration that would correct what GMRES leaves, which would "
            f"lower its order; use one of {others}, or linear_solver='direct' with jac_sparsity"
        )


def _matrix_free(problem: Problem, matrices: Matrices, chosen: LinearSolver, start: FunctionAtStart) -> Krylov | None:
    from .._linear.krylov import krylov

    if not isinstance(chosen, GMRES):
        return None
    if problem.inputs and (chosen.jac_product is not None or chosen.preconditioner is not None):
        raise ValueError(
            "jac_product and preconditioner are not possible together with inputs: call the inputs inside these "
            "functions, and pass them to the problem by args"
        )
    return krylov(matrices, chosen, problem.y0, problem.args, start.parameters, lambda: start.product)


# ----------------------------------------------------------------------------------------------------------------------
# Invariants


def _require_free_directions(bound: BoundInvariants, problem: Problem) -> None:
    if not bound.along_steps or (problem.bounds is None and problem.matrices.mass is None):
        return
    what = "bounds" if problem.bounds is not None else "a mass matrix"
    raise ValueError(
        f'invariants with direction="stages" cannot be imposed together with {what}, which need other corrections: '
        'use direction="gradient"'
    )
