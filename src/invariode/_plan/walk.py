"""A run one step at a time, with the warnings that a run gives."""

from __future__ import annotations

import numpy as np

from .. import _core
from .._base.arguments import Array, default_labels, warn
from .._problem.invariants import AccuracyWarning
from .._results.messages import about_jumps_of_fun, below_zero, harmful_projection, limited_by_stability
from .._results.result import DenseSolution, DiscontinuityWarning, StiffnessWarning
from .plan import Plan, solver

#: Before this many steps nothing can be said about harm: one step in eight is examined.
FEW_STEPS = 64


class Walk:
    """A plan that is carried out step by step, by a solver of its own or by one that was made for it.

    Raises
    ------
    ValueError, InvariantError
        The plan cannot start there.
    """

    def __init__(self, plan: Plan, y0: Array, core: _core.Solver | None = None) -> None:
        # The matrices of the plan, which the garbage collector cannot look into, would keep what refers to this alive.
        self.plan = plan._replace(functions=plan.functions._replace(linear=None))
        self.core = _core.Stepper(core or solver(plan), y0.view(float), None if core is None else plan.course)
        if self.core.state in ("invariant_refused", "start_contradicts", "start_out_of_bounds"):
            raise self.plan.exception(self.core.result()) or AssertionError
        self._inside: _core.Dense | None = None  # the solution over the last step, once it was asked for
        self._steps, self._warned, self._warned_stiff, self._warned_discontinuous = 0, False, False, False

    def step(self) -> None:
        """Advance the run by one step, if it can: see `state`."""
        self._inside = None
        self.core.step()
        self._watch()

    @property
    def state(self) -> str:
        """'running', or how the run has ended, as the core calls it."""
        return self.core.state

    @property
    def forward(self) -> float:
        """The direction of integration, 1 or -1."""
        return self.plan.course.forward

    @property
    def t(self) -> float:
        return self.core.t

    @property
    def y(self) -> Array:
        """A new array."""
        y: Array = self.core.y.view(self.plan.y0.dtype)
        return y

    @property
    def failure(self) -> tuple[int, str]:
        """The status of a run that has ended, and its message."""
        return self.plan.verdict(self.core.result())

    def over_last_step(self) -> DenseSolution:
        """The solution over the last step. It may take evaluations of f."""
        return DenseSolution(self._over_last_step(), self.plan.y0.dtype, self.plan.bound)

    def at(self, t: float) -> Array:
        """Return the state at a time in the last step."""
        found: Array = self.plan.bound.evaluate(self._over_last_step(), np.array([t]))[0].view(self.plan.y0.dtype)
        return found

    def _over_last_step(self) -> _core.Dense:
        if self._inside is None:
            self._inside = self.core.interpolant()
        return self._inside

    def _watch(self) -> None:
        """Warn once each if projection degrades the accuracy, if stability limits the steps, and if f is discontinuous.
        A run may end before its bound without notice, so this is checked in steps 64, 128, 256, … too."""
        self._steps += 1
        if self.state == "running" and not (self._steps >= FEW_STEPS and self._steps.bit_count() == 1):
            return
        if not self._warned:
            self._watch_accuracy()
        since = self.core.stiff_since
        if since is not None and not self._warned_stiff:
            self._warned_stiff = True
            warn(f"{self.plan.method.name}: {limited_by_stability(since)}", StiffnessWarning)
        text = about_jumps_of_fun(self.core)
        if text and not self._warned_discontinuous:
            self._warned_discontinuous = True
            warn(f"{self.plan.method.name}: {text}", DiscontinuityWarning)

    def _watch_accuracy(self) -> None:
        names = default_labels(len(self.y))
        if (fallen := self.core.below_zero) is not None:
            self._warned = True
            i, y, _ = fallen
            warn(below_zero(names[i], [i], f"and is {y:.2g} at t = {self.core.t:.6g}"), AccuracyWarning)
        harmed = self.core.harmed
        if harmed < 0 or self.state not in ("running", "reached_end"):
            return
        self._warned = True
        component = names[harmed // 2 if self.plan.functions.complex else harmed]
        distance = f"{self.core.harm:.2g} times its estimated errors"
        warn(harmful_projection(component, distance), AccuracyWarning)
