"""A run one step at a time, with the warnings that a run gives."""

from __future__ import annotations

from .. import _core
from .._base.arguments import Array, default_labels, warn
from .._problem.invariants import AccuracyWarning
from .._results.messages import about_jumps_of_fun, below_zero, harmful_projection, limited_by_stability
from .._results.records import DiscontinuityWarning, StiffnessWarning
from .._results.result import DenseSolution
from .plan import Plan, solver

#: Before this many steps nothing can be said about harm: one step in eight is examined.
FEW_STEPS = 64
#: This many steps are made without giving other threads a turn.
_AT_ONCE = 1024
#: States of runs that cannot start.
_REFUSALS = frozenset({"invariant_refused", "start_contradicts", "start_out_of_bounds"})


class Walk:
    """A plan that is carried out step by step.

    Raises ValueError, InvariantError: The plan cannot start there.
    """

    def __init__(self, plan: Plan, y0: Array, span: tuple[float, float] | None = None) -> None:
        """`span`: (t0, tf) in place of those of the plan, in the same direction."""
        self.plan = plan
        if span is not None:
            (t0, tf), first = span, plan.settings.first_step
            settings = plan.settings._replace(first_step=min(first, abs(tf - t0)))
            plan = plan._replace(course=plan.course._replace(t0=t0, tf=tf), settings=settings)
        self.core = _core.Stepper(solver(plan), y0)
        self.forward = plan.course.forward  # the direction of integration, 1 or -1
        self._laws = plan.bound.alone(plan.y0)  # onto which the solution between steps is projected
        self._begin(self.core.state)

    def restart(self, t0: float, tf: float, y0: Array, first_step: float) -> None:
        """Start again at (t0, y0), in the same direction, with the invariants at their values so far. `first_step`:
        the size that the run so far has found; 0 if the method is to choose it."""
        self._begin(self.core.restart(t0, tf, y0, first_step))

    def _begin(self, state: str) -> None:
        self._steps, self._next_look = 0, FEW_STEPS
        self._warned = self._warned_stiff = self._warned_discontinuous = False
        if state in _REFUSALS:
            raise self.plan.exception(self.core.result()) or AssertionError

    def step(self) -> None:
        """Advance the run by one step, if it can: see `state`."""
        self.core.step()
        self._steps += 1
        self._watch(self.core.remarkable)

    def advance(self, t: float, most: int | None = None) -> int:
        """Advance the run by steps until t is reached or passed, or it has ended; return the number of steps, at most
        `most`."""
        taken = 0
        while taken != most:
            chunk = min(self._next_look - self._steps, _AT_ONCE)
            if most is not None:
                chunk = min(chunk, most - taken)
            made, remarkable = self.core.advance(t, chunk)
            taken += made
            self._steps += made
            if remarkable or self._steps >= self._next_look:
                self._watch(remarkable)
            if made < chunk:
                break
        return taken

    @property
    def state(self) -> str:
        """'running', or how the run has ended, as the core calls it."""
        return self.core.state

    @property
    def t(self) -> float:
        return self.core.t

    @property
    def y(self) -> Array:
        """A new array."""
        return self.core.y

    @property
    def failure(self) -> tuple[int, str]:
        """The status of a run that has ended, and its message."""
        return self.plan.verdict(self.core.result())

    def over_last_step(self) -> DenseSolution:
        """The solution over the last step. It may take evaluations of f."""
        return DenseSolution(self.core.interpolant(), self.plan.y0.dtype, self.plan.bound)

    def at(self, t: float) -> Array | None:
        """Return the state at a time in the last step; None: it is outside, or the run has ended."""
        return self.core.at(t, self._laws)

    def _watch(self, remarkable: bool) -> None:
        """Warn once each if projection degrades the accuracy, if stability limits the steps, and if f is discontinuous.
        A run may end before its bound without notice, so this is checked in steps 64, 128, 256, … too."""
        if self.core.state == "running":
            if self._steps < self._next_look:
                return
            self._next_look *= 2
        if not remarkable:
            return
        run = self.core.result()
        if not self._warned:
            self._watch_accuracy(run)
        if run.stiff and not self._warned_stiff:
            self._warned_stiff = True
            warn(f"{self.plan.method.name}: {limited_by_stability(run.stiff_since)}", StiffnessWarning)
        text = about_jumps_of_fun(run)
        if text and not self._warned_discontinuous:
            self._warned_discontinuous = True
            warn(f"{self.plan.method.name}: {text}", DiscontinuityWarning)

    def _watch_accuracy(self, run: _core.Run) -> None:
        names = default_labels(len(self.y))
        if run.below_zero is not None:
            self._warned = True
            i, y, _ = run.below_zero
            warn(below_zero(names[i], [i], f"and is {y:.2g} at t = {self.core.t:.6g}"), AccuracyWarning)
        if run.harmed < 0 or self.state not in ("running", "reached_end"):
            return
        self._warned = True
        component = names[run.harmed // 2 if self.plan.functions.complex else run.harmed]
        warn(harmful_projection(component, f"{run.harm:.2g} times its estimated errors"), AccuracyWarning)
