"""The plan of a run: a problem with a method and its options, checked, in the form the core takes; and its outcome in
words."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import _core
from .._base.arguments import LARGEST_COUNT, Array, Weights, warn
from .._base.failures import InvariantError
from .._base.types import Numbers, OnFailure, OnInterrupt, Progress
from .._functions.compiled import Watch
from .._functions.layout import undefined_arguments
from .._laws.bound import BoundInvariants
from .._problem.core_problem import CoreProblem, VariationTerms
from .._problem.events import Roots, titled
from .._problem.grouped import Checkpoint
from .._problem.methods import Method
from .._problem.options import Options
from .._results.messages import (
    MESSAGES,
    LawNames,
    Stated,
    discontinuous,
    limit_reached,
    limited_by_stability,
    out_of_bounds,
    refusal,
    remarked,
    status_and_message,
    sticking,
)
from .._results.records import DiscontinuityWarning, StiffnessWarning
from .._results.result import LIMIT_REACHED, NOT_CONSERVED, Names
from .._sensitivity.landings import Schedule

if TYPE_CHECKING:
    from .._sensitivity.variations import Variations
    from .._taylor.expansion import Expansion


class Course(NamedTuple):
    """The settings of the core that depend on the problem: the path from t0 to tf, and what may be stored of it."""

    t0: float
    tf: float
    max_step: float
    times: Array | None
    max_points: int
    max_bytes: int

    @property
    def forward(self) -> float:
        """The direction of integration."""
        return 1.0 if self.tf >= self.t0 else -1.0


class Settings(NamedTuple):
    """The settings of the core that the method and its options determine."""

    first_step: float  # 0: the method chooses
    refine: int
    interpolation: str
    dense: bool
    sections: bool  # what the run remembers is kept at some steps, from which its parts are solved again
    save_all: bool
    record: bool
    check: bool
    fsal: str
    max_order: int
    bdf: bool
    prefer_explicit: str  # of the methods that take turns; "": what suits the tolerance
    prefer_implicit: str
    iterations: int  # of the projection of a step
    negligible: float = 0.0  # closer to the manifold than this, in units of rtol, a step is not projected
    max_steps: int = LARGEST_COUNT
    time_limit: float = math.inf


class Choice(NamedTuple):
    """A method with its options, checked: what is known of a run before its problem."""

    method: Method
    options: Options  # all of them
    settings: Settings


class Plan(NamedTuple):
    """Plan of a run, and the names in its messages."""

    course: Course
    settings: Settings
    bound: BoundInvariants
    called: Names  # the names in tables and pictures
    functions: CoreProblem
    y0: Array  # as far as the algebraic equations of a singular mass matrix have moved it
    method: Method
    tolerances: Weights
    moved: bool
    names: list[str]  # of the invariants, algebraic equations last
    event_names: list[str]
    records_events: bool  # also none at all, where a list of none was given
    rtol: Numbers  # as given
    atol: Numbers
    progress: Progress
    on_interrupt: OnInterrupt
    on_failure: OnFailure | None
    checkpoint: Checkpoint | None
    varied: Variations | None = None  # what is computed besides y
    expansion: Expansion | None = None  # for methods by series
    schedule: Schedule | None = None  # where f changes its branch as a function of t alone
    constants: int = 0  # up to which rank numbers of the arguments are constants of compiled functions
    watch: Watch | None = None  # on what a run itself does not see: it is the callback, which calls the user's

    @property
    def start(self) -> Array:
        """Initial values of the core: y0, then the sensitivities."""
        y0 = self.y0.view(float) if self.functions.complex else self.y0
        return y0 if self.varied is None else self.varied.augmented(y0)

    @property
    def roots(self) -> list[Roots]:
        """The plan's own `Roots`, which remember its run if they remember anything."""
        return [one.action.roots for one in self.functions.vectors]

    @property
    def components(self) -> int:
        """Number of components of y."""
        return self.functions.n // (1 + self.functions.complex)

    @property
    def own_events(self) -> int:
        """Number of the user's events; the conditions of f come after them."""
        return len(self.called.events)

    def in_lanes(self) -> dict[str, Any]:
        """Return the functions evaluated in each step, by their names in messages: f, the slope of sensitivities, the
        first invariant with its Jacobian and its tangent, events."""
        functions, varied = {"f": self.functions.fun}, self.varied
        if varied is not None:
            functions["the slope of the sensitivities"] = varied.slope
        for invariant in self.functions.invariants[:1]:
            functions |= {"the invariant": invariant.fun, "the Jacobian of the invariant": invariant.jac}
            if varied is not None:
                functions["the tangent of the invariant"] = varied.tangents[0]
        return functions | {
            f"{titled(event.name)} ({k})": event.fun for k, event in enumerate(self.functions.events, 1)
        }

    @property
    def laws(self) -> LawNames:
        """Description of the invariants for messages."""
        return LawNames(self.names, self.bound.demanded, self.bound.senses)

    @property
    def _stated(self) -> Stated:
        """Return the properties of the problem that the user has stated, for messages."""
        linear, names, pairs = self.functions.linear, self.event_names, self.functions.complex
        labels = self.called.labels
        if linear is None:
            return Stated(names, labels, jac=False, pattern=False, mass=False, pairs=pairs)
        differences = linear.kind in ("differences", "complex-step")
        return Stated(
            names,
            labels,
            jac=linear.kind in ("function", "constant"),
            pattern=differences and linear.structure != "dense" and not linear.found_pattern,
            mass=linear.algebraic > 0,
            pairs=pairs,
        )

    def holding(self, value: Array) -> Plan:
        """Return the plan with the invariants fixed at these values."""
        functions = self.functions._replace(value=value)
        return self._replace(functions=functions, bound=replace(self.bound, value=value))

    @property
    def remarks(self) -> Callable[..., None] | None:
        """Callback that reports problems during the run; None with sensitivities: a discontinuity that they follow is
        not reported, and which ones they follow is known only at the end."""
        return partial(say_established, self.method.name) if self.varied is None else None

    def follows(self, run: _core.Run) -> bool:
        """Return whether the sensitivities follow all discontinuities of f in the run."""
        return self.varied is not None and run.sticks_since is None and self.varied.has_followed(run.discontinuities)

    def verdict(self, run: _core.Run) -> tuple[int, str]:
        """The status of the run and its message."""
        status, message = self._verdict(run)
        if self.varied is None or run.component < self.functions.n:
            return status, message
        return status, self.varied.in_words(message, run)

    def _verdict(self, run: _core.Run) -> tuple[int, str]:
        if self.watch is not None and (objection := self.watch.objection) is not None:
            return NOT_CONSERVED, f"{objection[0].upper()}{objection[1:]}."
        ended = MESSAGES.get(run.state)
        if ended is not None and not run.remarkable:
            return ended
        if run.state == "limit_reached":
            course, settings = self.course, self.settings
            limits = {"steps": settings.max_steps, "time": settings.time_limit}
            limits |= {"points": course.max_points, "memory": course.max_bytes}
            message = limit_reached(run, limits.get(run.limit), course.t0, course.tf)
            return LIMIT_REACHED, remarked(message, run, self.event_names)
        status, message = status_and_message(run, self.laws, self._stated)
        if run.state == "start_undefined" and (undefined := undefined_arguments(self.bound.args)):
            return status, f"{undefined}, and fun is not finite at the start, t = {run.t}. Correct args."
        return status, message

    def exception(self, run: _core.Run) -> ValueError | None:
        """The exception that a single solve raises if the run ended like this."""
        state = run.state
        if state == "invariant_refused":
            text = refusal(run, self.laws, self.tolerances.rtol, self.functions.complex)
            return InvariantError(text)
        if state == "start_contradicts":
            return InvariantError(
                f"no point near y0 is within the bounds and has the values of the invariants: {', '.join(self.names)}. "
                "Widen the bounds, or correct the values"
            )
        if state == "start_out_of_bounds":
            return ValueError(out_of_bounds("y0", run.component, self.functions.bounds, self.called.labels))
        if state == "event_undefined":
            return ValueError(f"{titled(self.event_names[run.event])} returned NaN at t = {run.t}")
        if state == "action_undefined":
            at_event = run.event < len(self.event_names)
            what = f"of {titled(self.event_names[run.event])}" if at_event else "in breakpoints"
            return ValueError(f"the action {what} returned NaN at t = {run.t}")
        if state == "events_endless":
            names = ", ".join(self.event_names[event] for event in run.circle)
            return ValueError(
                f"more than 100 events occur at t = {run.t!r}, one through the action of the other: {names}. Let an "
                "action end where its event does not occur again, or set at_jumps=False"
            )
        return None


def say_established(
    method: str, stiff_since: float | None, discontinuities: list[float], sticks_since: float | None
) -> None:
    """Warn of what the steps of a run have established: stiffness, and discontinuities of f or a solution that sticks
    there."""
    if stiff_since is not None:
        warn(f"{method}: {limited_by_stability(stiff_since)}", StiffnessWarning)
    if sticks_since is not None:
        warn(f"{method}: {sticking(sticks_since)}", DiscontinuityWarning)
    elif discontinuities:
        warn(f"{method}: {discontinuous(discontinuities)}", DiscontinuityWarning)


def solver(plan: Plan, quadratures: VariationTerms | None = None) -> _core.Solver:
    """The plan handed to the core: a solver with functions of its own. `quadratures`: integrals that the run computes
    after y, of a plan without sensitivities."""
    functions = plan.functions._replace(variations=quadratures if plan.varied is None else plan.varied.for_core)
    if plan.schedule is not None:
        functions = functions._replace(landings=plan.schedule.landings.for_core())
    if plan.expansion is not None:
        functions = functions._replace(**plan.expansion.for_core())
    return _core.Solver(plan.method.name, functions, plan.tolerances, plan.course, plan.settings)
