"""What an ensemble came to, as its user sees it: the result, and one warning for all trajectories."""

from __future__ import annotations

import numpy as np

from . import _core
from ._arguments import Array, call_name, warn
from ._ensemble_task import Task
from ._messages import harmful_projection
from ._outcomes import Outcomes, counts_by_name
from .ensemble_solution import EnsembleSolution, EnsembleStats, Trajectories
from .invariants import AccuracyWarning
from .plan import Plan
from .result import DiscontinuityWarning, StiffnessWarning, default_labels

__all__ = ["Remarks", "solution"]

#: Of the counts, those that make warnings.
_WARNINGS = slice(_core.COUNTS.index("dropped"), len(_core.COUNTS))
assert _core.COUNTS[_WARNINGS] == ("dropped", "harmed", "stiff")


def solution(task: Task, plan: Plan, found: Outcomes) -> EnsembleSolution:
    """The result, with its warnings."""
    times = plan.settings.times
    remarks = Remarks()
    remarks.add(found)
    remarks.say(plan)
    return EnsembleSolution(
        t=np.array([plan.settings.tf]) if times is None else times,
        y=found.y_end[:, :, None].copy() if times is None else found.y,
        t_end=found.t_end,
        y_end=found.y_end,
        status=found.status,
        success=found.status >= 0,
        messages=found.messages,
        events=found.events,
        stats=EnsembleStats(
            **counts_by_name(found.counts),
            clipped_amount=found.clipped_amount,
            stiff_since=found.stiff_since,
            discontinuity=found.discontinuity,
            _lanes=found.lanes,
        ),
        value=found.value,
        residual_before=found.residual_before,
        residual_after=found.residual_after,
        correction=found.correction,
        attempt=found.attempt,
        _trajectories=_trajectories(plan, task),
    )


class Remarks:
    """What is to be said of trajectories: one warning of a kind for all of them."""

    def __init__(self) -> None:
        self._dropped = self._stiff = self._discontinuous = 0
        self._harmed: list[Array] = []

    def add(self, found: Outcomes) -> None:
        """Those of some more trajectories."""
        jumps = ~np.isnan(found.discontinuity)
        if jumps.any():
            self._discontinuous += int(np.count_nonzero(jumps))
        if not found.counts[:, _WARNINGS].any():
            return
        dropped, harmed, stiff = found.counts[:, _WARNINGS].T
        self._dropped += int(np.count_nonzero(dropped))
        self._stiff += int(np.count_nonzero(stiff))
        self._harmed.append(harmed[(found.status >= 0) & (harmed > 0)])

    def say(self, plan: Plan) -> None:
        """Of all that were added."""
        if self._dropped:
            warn(f"invariants were redundant in {self._dropped} trajectories, and were left out there")
        if self._harmed:
            _warn_harmed(plan, np.concatenate(self._harmed))
        if self._stiff:
            text = f"in {self._stiff} trajectories stability, not accuracy, limits most steps"
            warn(f"{plan.method.name}: {text} (stats['stiff'] tells in which); try ode15s", StiffnessWarning)
        if self._discontinuous:
            text = f"in {self._discontinuous} trajectories fun looks discontinuous, where steps fail"
            what = "give breakpoints, or an event with an action where y decides when it jumps"
            where = "stats['discontinuity'] tells where at first"
            warn(f"{plan.method.name}: {text} ({where}); {what}", DiscontinuityWarning)


def _warn_harmed(plan: Plan, harmed: Array) -> None:
    """`harmed`: 1 + the component that projection harmed, of each trajectory with one that did not fail."""
    if not harmed.size:
        return
    names = default_labels(len(plan.y0))
    components = np.unique((harmed - 1) // (2 if plan.functions.complex else 1))
    much = f"much more than estimated errors in {harmed.size} trajectories"
    warn(harmful_projection(", ".join(names[i] for i in components), much), AccuracyWarning)


def _trajectories(plan: Plan, task: Task) -> Trajectories:
    """What the results of single trajectories need to know."""
    acting = any(event.action is not None for event in plan.functions.events)
    return Trajectories(
        call_name(task.described.fun, "problem"),
        plan.event_names,
        plan.names[: len(plan.bound)],
        None if acting else plan.bound,
        task.args,
        plan.rtol,
        plan.atol,
    )
