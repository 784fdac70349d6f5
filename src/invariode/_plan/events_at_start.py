"""Events with `at_start` that are zero where the run starts: they occur there, as in SciPy."""

from __future__ import annotations

import dataclasses

import numpy as np

from .._base.arguments import Array
from .._functions.compiled import condition_value, event_value, is_native
from .._problem.problem import Problem
from .._results.solution import Solution
from .plan import Plan, solver


def found_at_start(problem: Problem, plan: Plan) -> list[int]:
    """Return the indices of the events that occur at the start. For those with a direction one step is taken, which
    shows it."""
    zero = [e for e, event in enumerate(problem.events) if event.at_start and _value(problem, plan, e) == 0]
    if any(plan.functions.events[e].direction for e in zero):
        # t and y at the end of the first step tell in which direction an event leaves zero.
        settings = plan.settings._replace(dense=False, save_all=False, record=False, refine=1)
        functions = plan.functions._replace(events=[], callback=lambda t, y: True)
        course = plan.course._replace(times=None)
        run = solver(plan._replace(course=course, settings=settings, functions=functions)).integrate(plan.start)
        after = run.t_end, run.end[: len(plan.y0)]
        zero = [e for e in zero if _value(problem, plan, e, *after) * plan.functions.events[e].direction >= 0]
    return zero


def _value(problem: Problem, plan: Plan, e: int, t: float | None = None, y: Array | None = None) -> float:
    """The value of an event, by default at the start."""
    t, y = problem.t_span[0] if t is None else t, (plan.y0 if y is None else y).copy()
    fun = problem.events[e].fun
    if is_native(fun):
        return event_value(plan.functions.events[e].fun, t, y.view(float), plan.functions.parameters.numbers)
    return float(np.asarray(condition_value(fun(t, y, *problem.args))).item())


def ended_at_start(plan: Plan, found: list[int]) -> bool:
    """Return whether one of the events found at the start ends the run."""
    return any(plan.functions.events[e].terminal == 1 for e in found)


def without_start(plan: Plan, found: list[int]) -> Plan:
    """The plan of the rest of the run: nothing, if it ends at the start; else with one occurrence fewer to come."""
    if ended_at_start(plan, found):
        t0, times = plan.course.t0, plan.course.times
        times = None if times is None else times[times == t0]
        settings = plan.settings._replace(first_step=0.0)
        return plan._replace(course=plan.course._replace(tf=t0, times=times), settings=settings)
    events = list(plan.functions.events)
    for e in found:
        events[e] = events[e]._replace(terminal=max(events[e].terminal - 1, 0))
    return plan._replace(functions=plan.functions._replace(events=events))


def with_start(sol: Solution, plan: Plan, found: list[int]) -> Solution:
    """The solution of that plan, with the occurrences at the start in front."""
    if not found:
        return sol
    t_events, y_events = sol.t_events.replaced(sol.t_events), sol.y_events.replaced(sol.y_events)
    for e in found:
        t_events[e] = np.concatenate([[plan.course.t0], t_events[e]])
        y_events[e] = np.concatenate([plan.y0[None, :], y_events[e].reshape(-1, len(plan.y0))])
    sensitivities = sol._sensitivities
    if plan.varied is not None and sensitivities is not None and sensitivities.events is not None:
        none = np.zeros(0), plan.start[None, :][:0]
        start = np.array([plan.course.t0]), plan.start[None, :]
        first = plan.varied.at_events([start if e in found else none for e in range(len(t_events))], len(plan.y0))
        sensitivities = dataclasses.replace(sensitivities, events=first.joined(sensitivities.events))
    return sol.changed(t_events=t_events, y_events=y_events, _sensitivities=sensitivities)
