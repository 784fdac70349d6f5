"""Warnings of what a run has shown: stiffness, discontinuities, invariants left out or imposed inaccurately."""

from __future__ import annotations

import numpy as np

from .. import _core
from .._base.arguments import warn
from .._plan.plan import Plan, say_established
from .._problem.invariants import AccuracyWarning
from .._results.messages import accumulating, harmful_projection
from .._results.records import BeforeProjection, DiscontinuityWarning
from .._results.solution import Solution


def warn_of_steps(run: _core.Run, plan: Plan) -> None:
    """Warn of what the steps have shown, as far as it was not said while the run went on."""
    told_stiffness, told_discontinuities, told_sticking = run.told
    say_established(
        plan.method.name,
        run.stiff_since if run.stiff and not told_stiffness else None,
        [] if told_discontinuities or plan.follows(run) else run.discontinuities,
        None if told_sticking else run.sticks_since,
    )
    if run.accumulation is not None:
        event, t, interval, count = run.accumulation
        warn(f"{plan.method.name}: {accumulating(plan.event_names[event], t, interval, count)}", DiscontinuityWarning)


def warn_of_projection(run: _core.Run, plan: Plan, sol: Solution) -> None:
    at_rest = (np.abs(sol.y.T - plan.y0) <= plan.atol + plan.rtol * np.abs(plan.y0)).all()  # g is stationary there
    if (dropped := run.dropped) and not at_rest:
        _warn_dropped(dropped, run.dropped_at, plan.names, sol._drift, along_steps=plan.bound.along_steps)
    for i, tolerances in run.unresolved:
        warn(
            f"invariant {plan.names[i]} is so large that its roundoff is a change of y by {tolerances:.2g} tolerances: "
            "it is imposed no more accurately than that. Subtract its offset within the function",
            AccuracyWarning,
        )
    harmed = run.harmed
    if harmed >= 0 and sol.success:
        component = sol._names.components[harmed // 2 if plan.functions.complex else harmed]
        warn(harmful_projection(component, f"{run.harm:.2g} times its estimated errors"), AccuracyWarning)


def _warn_dropped(
    dropped: list[int], first: float, names: list[str], drift: BeforeProjection, *, along_steps: bool
) -> None:
    listed = ", ".join(names[i] for i in dropped)
    several = len(dropped) > 1
    off = max(drift.distance[i] for i in dropped)
    if off <= 1:
        then = f"That does no harm: {'they were' if several else 'it was'} off by at most {off:.2g} of the tolerance."
    else:
        then = (
            f"{'They were' if several else 'It was'} off by up to {off:.2g} tolerances before a projection: impose "
            "fewer invariants, or try a smaller rtol."
        )
    if along_steps:
        warn(
            f"the stages of steps do not lead to the values of {listed}, first at t = {first:.6g}: "
            f"{'they depend' if several else 'it depends'} on other invariants, or stages are nearly orthogonal to "
            f"{'their gradients' if several else 'its gradient'}. {then} direction='gradient' reaches more."
        )
        return
    warn(
        f"{'invariants' if several else 'invariant'} {listed} {'are' if several else 'is'} redundant, first at "
        f"t = {first:.6g} (dependent on the others to within rtol, or stationary there), and "
        f"{'were' if several else 'was'} left out in such steps. {then}"
    )
