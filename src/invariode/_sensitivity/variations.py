"""The sensitivities of a run: their equations, their tolerances, and what they do at events, as the core takes it.

With S = ∂y/∂p, M S' = (∂f/∂y) S + ∂f/∂p − (∂M/∂p) y'; for events and actions see `actions`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from .. import _core
from .._base.arguments import EPS, Array, Weights, warn
from .._base.forks import cached_property
from .._functions.compiled import is_native
from .._functions.derivatives import Derivative, Given, derivative_of, has_llvm
from .._functions.graph.nodes import Node
from .._functions.layout import ArgumentLayout, layout_of
from .._functions.second_order import SecondOrder
from .._functions.with_arguments import Point
from .._problem.breakpoints import Breakpoint
from .._problem.core_problem import EventSpec, InvariantSpec, VariationTerms
from .._problem.events import Event, RootOf, event_spec, roots_among, titled
from .._problem.inputs import fed, with_tables
from .._problem.invariants import AccuracyWarning
from .._problem.parameters import ParameterName, values_of
from .._problem.problem import Problem
from .._results.sensitivity_data import AtEvents
from .actions import ActionAtPoint, ActionOfEvent, EventTime, Rate, Together, WithPast, of_roots, restoration
from .landings import Schedule, landing_jump, schedule_of
from .mass_derivatives import MassDerivatives, WithMass, mass_derivatives
from .pairs import for_complex, in_complex, real_form, require_analytic, start_of_pairs
from .variation_sizes import Sizes

#: Part of the interval within which a discontinuity, which is located by steps that fail, is that of a condition.
_NEAR = 0.02
#: Relative distance within which two conditions change together.
_TOGETHER = 1e-9


@dataclass
class Variations:
    """Sensitivities as a run computes them besides y."""

    names: list[str]  # names of the parameters
    start: Array  # (k, n): S at the start
    sizes: Sizes  # sizes from which the tolerances of S follow
    for_core: VariationTerms  # the sensitivities as the core takes them
    slope: Any  # callable: (t, Y) -> f_y S_j + f_pj, as the core calls it
    tangents: list[Any]  # (t, Y) -> G S_j + g_pj of each invariant
    how: dict[str, str]  # for each function, the way in which its derivatives are formed
    times: list[EventTime]  # derivatives of the time of each event
    actions: list[ActionOfEvent | None]  # jump of S at the action of each event, with its log
    breaks: frozenset[float]  # times of the breakpoints
    switches: list[EventSpec]  # conditions at which f jumps: further events, which change S alone
    log: list[tuple[float, str]]  # times at which conditions of f have changed, and which conditions
    near: float  # largest distance in t between a discontinuity and the change of a condition that explains it
    follows_jumps: bool  # the conditions of f are known
    derivatives_of: list[Derivative]  # derivatives of all functions
    schedule: Schedule | None = None  # times at which f changes its branch as a function of t alone
    is_complex: bool = False  # the state is complex; `start` has pairs then
    rate_of_past: Rate | None = None  # with delays: y'

    @property
    def own_to_each(self) -> str | None:
        """Reason why the variations differ between initial values and parameters in more than the tolerances, or None:
        conditions of f are compared around y0, functions called with the arguments, and complex derivatives tested at
        y0."""
        graph = self.derivatives_of[0].graph
        if graph is not None and graph.has_conditions():
            return "f has branches, which are examined for each trajectory"
        of_start = any(one.kind != "args" for one in self.sizes.names)
        return "f must be analytic, which is tested for each trajectory" if self.is_complex and of_start else None

    def tangent_nodes(self) -> list[Node]:
        """f_y S + f_p as a graph, of (t, Y).

        Raises TypeError: A parameter is a constant of the graph of f.
        """
        graph = self.derivatives_of[0].graph
        if graph is None:
            raise TypeError(
                "sensitivities by Taylor series need the derivatives of fun from its graph, of which a parameter is a "
                "constant, such as the count of a loop: name the other parameters, or use method='dop853' or 'ode89'"
            )
        return graph.tangent_nodes()

    @cached_property
    def _same_tolerances(self) -> Array | None:
        """The tolerances of S, if every start has them."""
        k, n = self.start.shape
        return self.sizes.tolerances(np.zeros(n), np.ones(k)) if self.sizes.of_any_start else None

    def tolerances_at(self, y: Array, args: tuple[Any, ...]) -> Array:
        """Return the tolerances of S, (k, n), from another start with other arguments."""
        if self._same_tolerances is not None:
            return self._same_tolerances
        numbers = np.array(args) if all(type(one) is float for one in args) else layout_of(args).numbers
        return self.sizes.at(y, numbers)

    def augmented(self, y: Array, args: tuple[Any, ...] | None = None, dy0dp: Any = None) -> Array:
        """Return Y = (y, S) at the start y, with ∂y0/∂p for these arguments, or the given one; default: the plan's."""
        wanted, start = self.sizes.wanted, self.start
        if dy0dp is not None:
            wanted = replace(wanted, dy0dp=start_of_pairs(dy0dp) if self.is_complex else dy0dp)
        if args is not None and (dy0dp is not None or callable(wanted.dy0dp)):
            start = wanted.start(self.sizes.names, args, start.shape[1]).T
        return np.concatenate([y, start.ravel()])

    @property
    def derivatives(self) -> str:
        """Description of how the derivatives are formed."""
        ways = set(self.how.values())
        return ways.pop() if len(ways) == 1 else "; ".join(f"{called}: {way}" for called, way in self.how.items())

    def has_followed(self, discontinuities: Sequence[float]) -> bool:
        """Return whether f has jumped only where conditions that are followed have changed; if not, warn."""
        times = np.array([t for t, _ in self.log])
        self.log.clear()
        for t in discontinuities:
            if self.follows_jumps and (np.abs(times - t) <= self.near).any():
                continue
            warn(
                f"sensitivities: fun looks discontinuous at t = {t:.6g}, and not all of its conditions are known. "
                "Sensitivities may jump there too, and be wrong from there on: write fun so that "
                "invariode.compile(fun, by='trace') takes it; give jumps at fixed times as breakpoints",
                AccuracyWarning,
            )
            return False
        return bool(discontinuities)

    def tell_of_steps(self, t: Array, y: Array) -> None:
        """A warning if complex steps, which were tested at the start, are wrong in the middle or at the last output."""
        n = self.start.shape[1]
        own = [one for one in self.derivatives_of if one.graph is None and one.n == n]  # others take delayed values too
        if not own:
            return
        rows = np.ascontiguousarray(y.T).view(float)
        points = [Point(float(t[i]), rows[i]) for i in sorted({len(t) // 2, len(t) - 1}) if len(t)]
        wrong = [one.called for one in own if not all(map(one.takes_complex_at, points))]
        if wrong:
            warn(
                f"sensitivities: complex steps through {', '.join(wrong)} do not give its derivatives everywhere in "
                "this run, as with abs of a complex number: sensitivities may be wrong. Write it so that it can be "
                "traced, or give jac and Sensitivities(dfdp=...)",
                AccuracyWarning,
            )

    def in_words(self, message: str, run: _core.Run) -> str:
        """A message about a component of Y after y."""
        pairs = 1 + self.is_complex
        n, component = self.start.shape[1] // pairs, run.component // pairs
        j, i = divmod(component - n, n)
        if run.state == "start_undefined":  # f itself is finite there
            return self._undefined(run.t_end, np.ascontiguousarray(run.end[: n * pairs]), i, self.names[j])
        return message.replace(f"omponent {component}", f"omponent {i} of the sensitivity to {self.names[j]}", 1)

    def _undefined(self, t: float, y: Array, i: int, name: str) -> str:
        """Return the message that f has no derivative at a point, from which a run cannot continue."""
        slope = self.derivatives_of[0]
        where = slope.graph.singular_at(t, y, slope.names) if slope.graph and len(y) == slope.n else None
        expression = "" if where is None else f": {where} has none"
        return (
            f"fun is finite at t = {t}, but its derivative in the equation of the sensitivity of component {i} to "
            f"{name} is NaN or infinite there{expression} (formed: {slope.how}). Sensitivities do not exist beyond a "
            "point where fun is not differentiable along the solution; where they do, write the formula without the "
            "singularity, or give jac and Sensitivities(dfdp=...)"
        )

    def at_events(self, happened: Sequence[tuple[Array, Array]], n: int) -> AtEvents:
        """The sensitivities at occurrences of events, of times and Y; what actions have done is taken from the log."""
        before, after, times = [], [], []
        k, n = len(self.names), n * (1 + self.is_complex)
        found = [(t.tolist(), np.ascontiguousarray(rows).view(float).reshape(len(t), 1 + k, n)) for t, rows in happened]
        if self.rate_of_past is not None:
            self.rate_of_past.restart()
        for i, ((t, states), time, action) in enumerate(zip(found, self.times, self.actions, strict=True)):
            before.append(np.swapaxes(states[:, 1:], 1, 2).copy())
            times.append(np.array([self._time(i, *one, found) for one in zip(t, states, strict=True)]).reshape(-1, k))
            log = {} if action is None else action.taken()
            unknown = np.full((n, k), np.nan)
            behind = before[-1] if action is None else np.array([log.get(one, unknown) for one in t])
            after.append(behind.reshape(len(t), n, k))
            time.tell()
        for action, time in zip(self.actions, self.times, strict=True):
            time.noted.clear()
            if action is not None:
                action.forget()
        if self.is_complex:
            before, after = ([in_complex(one, 1) for one in each] for each in (before, after))
        return AtEvents(before, after, times)

    def _time(self, i: int, t: float, state: Array, found: Sequence[tuple[list[float], Array]]) -> Array:
        """Return ∂τ (k,) of an occurrence of event i among those found. An event that a jump has carried over zero has
        the time of that jump: of a breakpoint, or of the event that acts."""
        acting = [j for j, (t_j, _) in enumerate(found) if j != i and self.actions[j] is not None and t in t_j]
        if self.rate_of_past is not None and t != self.rate_of_past.t0:
            noted = (self.times[j].noted.get(t) for j in (i, *acting))
            return next((one for one in noted if one is not None), np.zeros(len(self.names)))
        if (t not in self.breaks and not acting) or self.times[i].is_at_root(t, state):
            return self.times[i].at(t, state)
        for j in acting:
            cause = found[j][1][found[j][0].index(t)]
            if self.times[j].is_at_root(t, cause):
                return self.times[j].at(t, cause)
        return np.zeros(len(self.names))


def make_variations(
    problem: Problem,
    y0: Array,
    weights: Weights,
    specs: Sequence[InvariantSpec],
    points: Sequence[Breakpoint],
    schedule: Schedule | None = None,
) -> Variations:
    """The sensitivities that a problem asks for.

    Raises TypeError, ValueError: An unknown parameter; a derivative of a wrong shape; something for which there are no
    sensitivities.
    """
    names, sizes, is_complex = problem.parameter_names(), np.abs(y0), y0.dtype.kind == "c"
    require_possible(problem)
    if is_complex:
        problem, names, points = real_form(problem, points)
        y0, sizes = y0.view(float), np.repeat(sizes, 2)
    wanted = problem.sensitivities
    assert wanted is not None
    about = _Derivatives(args := problem.args, names, n := len(y0), Point(t0 := problem.t_span[0], y0))
    slope, rate = about.of_fun(problem, weights.rtol * np.asarray(weights.threshold))
    if of_start := [one.name for one in names if is_complex and one.kind != "args"]:
        require_analytic(slope, Point(t0, _with_past(problem, t0, y0[None])[0]), of_start[0])
    mass = about.of_mass(problem, rate)
    start = np.ascontiguousarray(wanted.start(names, args, n).T)
    times, jumps, doses = about.of_events(problem, points, start, rate, weights)
    switches = followed(slope, about.of, problem, about.log) if problem.delays is None else []
    schedule = schedule or schedule_of(problem, layout_of(args), slope.outputs)
    measure = Sizes.of(wanted, names, weights, args, n)
    form = for_complex if is_complex else _as_it_is
    at_start = (t0, np.vstack([y0, start]))
    tangents = [form(law.for_core(*at_start), complex_values=False) for law in about.of_laws(problem, specs)]
    slope_for_core = slope.for_core(t0, _with_past(problem, *at_start))
    for_core = VariationTerms(
        k=len(names),
        slope=form(slope_for_core if mass is None else WithMass(slope, mass)),
        thresholds=measure.tolerances(y0, values_of(args, sizes, names)),
        invariants=tangents,
        events=[form(one) for one in (*_with_values(jumps, problem, rate, times), *(one.jump for one in switches))],
        breakpoints=[form(one) for one in _with_values(doses, problem, rate)],
        landings=form(*_with_values([landing_jump(schedule, problem, names, rate)], problem, rate)),
        error_test=wanted.error_test,
    )
    about.tell()
    return Variations(
        names=[one.name for one in names],
        start=start,
        sizes=measure,
        for_core=for_core,
        slope=slope_for_core,
        tangents=tangents,
        how=about.how,
        times=times,
        actions=jumps,
        breaks=frozenset(float(one.t) for one in points),
        switches=[_condition(one, n, layout_of(args), form) for one in switches],
        log=about.log,
        near=_NEAR * abs(problem.t_span[1] - t0),
        follows_jumps=slope.knows_jumps,
        derivatives_of=about.made,
        schedule=schedule,
        is_complex=is_complex,
        rate_of_past=None if problem.delays is None else rate,
    )


def _with_past(problem: Problem, t: float, Y: Array) -> Array:
    """(y, S) as the slope of S takes them: with delays, each row has the delayed values after it."""
    if problem.delays is None:
        return Y
    past = np.zeros((len(Y), Y.shape[1] * problem.delays.count))
    return np.vstack([problem.delays.stacked_at_start(t, Y[0], problem.args), np.hstack([Y, past])[1:]])


def _with_values(
    jumps: Sequence[Any], problem: Problem, rate: Rate, times: Sequence[EventTime] | None = None
) -> Sequence[Any]:
    """Return jumps as the core calls them; with delays those of events without an action too, of which it tells the
    time."""
    if problem.delays is None:
        return jumps
    if times is None:
        return [None if one is None else WithPast(one, rate) for one in jumps]
    return [WithPast(one, rate, time) for one, time in zip(jumps, times, strict=True)]


def _as_it_is(function: Any, complex_values: bool = True) -> Any:
    return function


def _condition(one: Switching, n: int, parameters: ArgumentLayout, form: Callable[..., Any]) -> EventSpec:
    """A condition of f as an event."""
    found = event_spec(one.event, n, parameters)
    return found._replace(fun=form(found.fun, complex_values=False), action=form(found.action))


class _Derivatives:
    """Derivatives of the functions of a problem, and how they are formed."""

    def __init__(self, args: tuple[Any, ...], names: Sequence[ParameterName], n: int, at: Point) -> None:
        self._args, self._names, self._n, self.at = args, names, n, at
        self.how: dict[str, str] = {}
        self.log: list[tuple[float, str]] = []  # of conditions of f that have changed
        self.made: list[Derivative] = []

    def of(self, fun: Any, called: str, m: int | None = None, **more: Any) -> Derivative:
        """Return the derivatives of a function."""
        about: dict[str, Any] = {"at": self.at, "args": self._args, "names": self._names, "called": called}
        return self._note(derivative_of(fun, (m, self._n), **about, **more))

    def of_fun(self, problem: Problem, atol: float | Array) -> tuple[Derivative, Rate]:
        """Return the derivatives of f along directions of y and the parameters, and its rate along the solution."""
        fun, given = given_derivatives(problem, self._names)
        if problem.delays is not None:
            return self._of_past(problem, fun, given), Rate(problem, atol, lambda: self.of(fun, "fun", m=self._n))
        slope = self.of(fun, "fun", m=self._n, given=given)
        return slope, Rate(problem, atol, lambda: self.of(fun, "fun", m=self._n, given=given, moves_t=True))

    def _of_past(self, problem: Problem, fun: Any, given: Given) -> Derivative:
        """Return the derivatives of f of (t, x), where x is y and its delayed values."""
        assert problem.delays is not None
        n, x = self._n, problem.delays.stacked_at_start(self.at.t, self.at.y, self._args)
        of_x = problem.delays.in_one_vector(fun, n)
        at = Point(self.at.t, x)
        about: dict[str, Any] = {"at": at, "args": self._args, "names": self._names, "called": "fun"}
        slope = self._note(derivative_of(of_x, (n, len(x)), given, **about))
        if slope.graph is not None and slope.graph.switches(at):
            warn(
                "sensitivities: fun jumps at conditions, which are not followed in problems with delays: sensitivities "
                "may be wrong after them. Pass the times of those on t alone as breakpoints",
                AccuracyWarning,
            )
        return slope

    def _note(self, made: Derivative) -> Derivative:
        self.how[made.called] = made.how
        self.made.append(made)
        return made

    def of_laws(self, problem: Problem, specs: Sequence[InvariantSpec]) -> list[Derivative]:
        """Return the derivatives of the invariants."""
        return [
            self.of(one.fun, f"invariant {spec.name}", m=spec.m, given=Given.of(one.jac))
            for one, spec in zip(problem.invariants, specs, strict=True)
        ]

    def of_mass(self, problem: Problem, rate: Rate) -> MassDerivatives | None:
        """Return the derivatives of the mass matrix; None if it does not depend on the parameters."""
        found = mass_derivatives(problem, self._names, rate)
        if found is not None:
            self._note(found.derivatives)
        return found

    def of_events(
        self, problem: Problem, points: Sequence[Breakpoint], start: Array, rate: Rate, weights: Weights
    ) -> tuple[list[EventTime], list[ActionOfEvent | None], list[Any]]:
        """Return the derivatives of the times of events, and the jumps of S at their actions and at breakpoints; S
        begins as `start`, (k, n)."""
        roots = {id(one): of_roots(one, self.of, start) for one in roots_among(problem.events)}
        times = EventTime.of_each(problem.events, self.of, roots, rate, weights)
        restored = restoration(problem, self._names, weights.threshold)
        together, n = Together(), self._n
        logs: dict[int, list[tuple[float, Array]]] = {key: [] for key in roots}
        jumps: list[ActionOfEvent | None] = []
        for event, time in zip(problem.events, times, strict=True):
            put_back = restored if event.rehold else None
            if isinstance(event, RootOf):
                key = id(event.roots)
                jumps.append(ActionOfEvent(roots[key].action, put_back, time, rate, together, logs[key]))
            elif event.action is None:
                jumps.append(None)
            else:
                action = self.of(event.action, f"the action of {titled(event.__name__)}", m=n, moves_t=True)
                jumps.append(ActionOfEvent(action, put_back, time, rate, together))
        alone, at_start = not any(jumps) and restored is None, (self.at.t, np.vstack([self.at.y, start]))
        made = dict[int, Any]()
        for action in (point.action for point in points if point.action is not None):
            of_action = self.of(action, "the action in breakpoints", m=n)
            by_machine = (
                alone and problem.delays is None and of_action.graph is not None and of_action.graph.is_smooth()
            )
            made[id(action)] = (
                of_action.for_core(*at_start) if by_machine else ActionAtPoint(of_action, restored, together)
            )
        return times, jumps, [made.get(id(point.action)) for point in points]

    def tell(self) -> None:
        """A warning if some are differences."""
        rough = dict.fromkeys(
            one.called for one in self.made if one.how.endswith("differences") and not one.is_condition
        )
        if rough:
            warn(
                f"sensitivities: the derivatives of {', '.join(rough)} are differences, which are accurate to 1e-10 at "
                "best: it cannot be traced, and does not take complex numbers. Write it with NumPy's functions, or "
                "give jac, and Sensitivities(dfdp=...)",
                AccuracyWarning,
            )


# ----------------------------------------------------------------------------------------------------------------------
# Where f jumps


#: With more conditions at which f jumps than this, S is not corrected there.
_MOST_SWITCHES = 32
#: From one unit of roundoff on, y is moved by at most 2 to this power of them beyond a jump.
_MOST_DOUBLINGS = 8


class SwitchCrossing(NamedTuple):
    """Crossing of e(t, y, p) = 0: y' before and after, the rate of e before, and whether it leads back."""

    before: Array
    after: Array
    rate: float
    leads_back: bool


@dataclass
class Switching:
    """Passage of f from one branch to another at e(t, y, p) = 0: S⁺ = S⁻ + (f⁻ − f⁺) ∂τ.

    Attributes
    ----------
    name : str
        Name of the condition in messages.
    function : callable
        e, for events.
    difference : Derivative
        The derivatives of e.
    """

    name: str
    function: Any
    difference: Derivative
    _value: Callable[[float, Array], Array]
    _below: Callable[[float, Array], Array]
    _above: Callable[[float, Array], Array]
    _forward: float
    _log: list[tuple[float, str]]  # of all conditions
    _warned: bool = False

    @property
    def event(self) -> Event:
        """The condition as an event, which starts the new branch."""
        made = Event(self.function, action=self.action, rehold=False, at_jumps=False)
        made.__name__ = self.name
        return made

    def crossing(self, t: float, y: Array) -> SwitchCrossing | None:
        """Return the crossing in this state, or None if the condition does not change in it."""
        below, above = (np.asarray(branch(t, y)) for branch in (self._below, self._above))
        none = np.zeros((2, self.difference.k))
        rates = self.difference.columns(t, y, np.ones(2), np.stack([below, above]), none)[:, 0]
        rising, falling = self._forward * rates[0] > 0, self._forward * rates[1] < 0
        if rising:
            return SwitchCrossing(below, above, rates[0], bool(falling))
        return SwitchCrossing(above, below, rates[1], leads_back=False) if falling else None

    def action(self, t: float, y: Array, *args: Any) -> Array:
        """y, moved by roundoff to the side of the new branch, so that the next step begins with that."""
        found = self.crossing(t, y)
        if found is None or found.leads_back:
            return y
        side, step = np.sign(self._forward * found.rate), EPS * max(abs(t), 1.0)
        for _ in range(_MOST_DOUBLINGS):
            if side * self._value(t, y)[0] > 0:
                break
            y = y + self._forward * step * found.before
            step *= 2
        return y

    def jump(self, t: float, Y: Array, after: Array) -> Array:
        """Return S after the switch, for Y = (y, S) before it."""
        y, S = Y[0], Y[1:]
        found = self.crossing(t, y)
        if found is None:
            return S
        self.tell(t, found)
        k = len(S)
        times = -self.difference.columns(t, y, np.zeros(k), S, np.eye(k))[:, 0] / found.rate
        moved: Array = S + np.outer(times, found.before - found.after)
        return moved

    def tell(self, t: float, found: SwitchCrossing) -> None:
        """A warning if another condition has changed at the same time, or if the crossing leads back."""
        together = [name for time, name in self._log if abs(time - t) <= _TOGETHER * max(abs(t), 1.0)]
        self._log.append((t, self.name))
        if together and self.name not in together:
            warn(
                f"sensitivities: several conditions of fun change together at t = {t:.6g}, and each is followed alone. "
                "Sensitivities are not reliable from there on: write the same condition in one way",
                AccuracyWarning,
            )
        if found.leads_back and not self._warned:
            self._warned = True
            warn(
                f"sensitivities: fun jumps at t = {t:.6g} such that both of its branches lead back to where it jumps. "
                "Sensitivities are not reliable from there on",
                AccuracyWarning,
            )


def followed(
    slope: Derivative, about: Callable[..., Derivative], problem: Problem, log: list[tuple[float, str]]
) -> list[Switching]:
    """The conditions of f at which it jumps, if they can be followed; if not, there is a warning."""
    graph = slope.graph
    found = [] if graph is None else graph.switches(Point(problem.t_span[0], problem.y0))
    if graph is None or not found:
        return []
    unknown = problem.matrices.mass is not None or any(graph.of_inputs(one.difference) for one in found)
    if len(found) > _MOST_SWITCHES or unknown:
        warn(
            f"sensitivities: fun jumps at {len(found)} conditions, where sensitivities jump too. With a mass matrix, "
            f"if an input is compared, or with more than {_MOST_SWITCHES} of them, these are not followed: "
            "sensitivities may be wrong after them",
            AccuracyWarning,
        )
        return []
    forward = 1.0 if problem.t_span[1] >= problem.t_span[0] else -1.0
    made = []
    for i, switch in enumerate(found):
        name = f"condition {i + 1} of fun"
        function = graph.with_values([switch.difference], "condition")
        difference = about(function, name, m=1, moves_t=True)
        value, below, above = (graph.branch(one) for one in ([switch.difference], switch.below, switch.above))
        event = function if has_llvm() else _sign_of(value)
        made.append(Switching(name, event, difference, value, below, above, forward, log))
    return made


def _sign_of(value: Callable[[float, Array], Array]) -> Callable[..., float]:
    """An event without machine code."""
    return lambda t, y, *args: float(value(t, y)[0])


# ----------------------------------------------------------------------------------------------------------------------
# What is known, and what is possible


def require_possible(problem: Problem) -> None:
    """Refuses by name what has no sensitivities."""
    if isinstance(problem.fun, SecondOrder) and problem.fun.native:
        raise ValueError(
            "sensitivities are not possible for a SecondOrder of machine code: use invariode.compile(SecondOrder(f))"
        )
    for roots in roots_among(problem.events):
        if not roots.is_differentiable:
            raise ValueError(
                f"sensitivities are not possible with {roots!r}, whose action may remember what it has done: pass "
                "stateless=True if it does not, or use Event(..., action=)"
            )


def given_derivatives(problem: Problem, names: Sequence[ParameterName]) -> tuple[Any, Given]:
    """f with its inputs, and what is given of its derivatives, of (t, y, *args)."""
    dfdp = None if problem.sensitivities is None else problem.sensitivities.dfdp
    matrices, jac = problem.matrices, fed(problem.matrices.jac, problem.inputs)
    if is_native(jac) and matrices.jac_sparsity is not None:  # it writes the entries of the pattern alone
        jac = None
    fun = problem.fun.first_order if isinstance(problem.fun, SecondOrder) else problem.fun
    fun = with_tables(fun, problem.inputs) if problem.inputs else fun
    return fun, Given.of(jac, _dfdp(dfdp, problem, names), matrices.bands)


def _dfdp(given: Any, problem: Problem, names: Sequence[ParameterName]) -> Any:
    """∂f/∂p that is given, of (t, y, *args)."""
    if given is None:
        return None
    if is_native(given):
        raise TypeError(
            "dfdp of Sensitivities must be a Python function; a compiled fun has exact derivatives of its own"
        )
    if all(one.kind != "args" for one in names):
        raise ValueError("dfdp of Sensitivities is given, and no parameter is in args")
    return fed(given, problem.inputs)
