"""Jumps of a solution, or of its slope, as their effect on its sensitivities: S⁺ = A S⁻ + B.

For an event e(t, y, p) = 0 at τ with the action y⁺ = h(τ, y⁻, p) (of a condition at which f jumps, h is y), from

    ∂τ = −(e_y S⁻ + e_p) / (e_t + e_y f⁻),   S⁺ = h_y (S⁻ + f⁻ ∂τ) + h_p + h_t ∂τ − f⁺ ∂τ

and v = h_y f⁻ + h_t − f⁺ follow A = h_y − v e_y / e', B = h_p − v e_p / e'. A breakpoint has v = 0.

Actions of `Roots` may leave numbers w behind, such as the time and values of an execution that is due later. Then
(S⁺, W⁺) is linear in (S⁻, W⁻): costs of W, which does not change in between, wait backwards for the action that has
left it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import EPS, Array
from .._functions.derivatives import Derivative
from .._problem.breakpoints import Breakpoint
from .._problem.events import Event, RootOf, Roots, titled
from .._problem.parameters import ParameterName
from .._problem.problem import Problem
from .._results.result import DenseSolution, Result
from .._sensitivity.actions import AlongAction, OfRoots, Rate, is_at_root, of_event, of_roots, restoration, times_of
from .._sensitivity.algebraic import Algebraic, dense_mass
from .._sensitivity.landings import LandingJump, Schedule, landing_jump
from .._sensitivity.variations import SwitchCrossing, Switching, given_derivatives
from .sections import SectionedSolution

#: (fun, name in messages, ...) -> its derivatives.
Derivatives = Callable[..., Derivative]


@dataclass
class Jump:
    """Effect of a jump at one time on S, along c directions: those of S⁻, of the parameters, and of everything that has
    waited."""

    t: float  # time of the jump
    #: before, after, (n,): state before and after the jump
    before: Array
    after: Array
    times: Array  # (c,): ∂τ
    moved: Array  # (c, n): S⁺
    k: int  # number of parameters
    reholds: bool = False  # invariants without a prescribed value are fixed at their values after the jump
    moves: bool = False  # y jumps
    left: Sequence[tuple[Any, Array]] = ()  # what it leaves behind, and its derivatives along the directions, (c, w)
    #: What has waited, its directions, and the action that has used it
    used: Sequence[tuple[Any, slice, AlongAction]] = ()
    #: The costs of everything that waits, (w,), by its id, with the object and its action
    costs: dict[int, tuple[Any, AlongAction, Array]] = field(default_factory=dict)

    def transposed(self, mu: Array, cost_of_time: float) -> tuple[Array, Array]:
        """Aᵀ μ and Bᵀ μ, with the cost of ∂τ added; costs of what has waited are added to `costs`."""
        along = self.moved @ mu + cost_of_time * self.times
        for one, slopes in self.left:
            if id(one) in self.costs:
                along = along + slopes @ self.costs.pop(id(one))[-1]
        for one, where, action in self.used:
            before = self.costs[id(one)][-1] if id(one) in self.costs else 0.0
            self.costs[id(one)] = one, action, before + along[where]
        n = len(mu)
        return along[:n], along[n : n + self.k]


class Call(NamedTuple):
    """A call of the action of a `Roots` in a run.

    Attributes
    ----------
    t : float
        Time of the call.
    before, after : ndarray, (n,)
        State that it got and that it returned.
    roots : Roots
        The functions.
    which, directions : ndarray
        As in `Roots`.
    remembered : object
        What its derivatives need besides.
    """

    t: float
    before: Array
    after: Array
    roots: Roots
    which: Array
    directions: Array
    remembered: Any


class RecordedRoots(Roots):
    """`Roots` that record the calls of their action, until `record` is None."""

    def __init__(self, roots: Roots, record: list[Call]) -> None:
        about: dict[str, Any] = {"rehold": roots.rehold, "names": roots.names, "stateless": roots.stateless}
        super().__init__(roots.fun, roots.count, self._recorded, **about)
        self._roots, self.record = roots, record

    def of_run(self, t: float, y: Array, args: tuple[Any, ...], memory: dict[int, Any]) -> RecordedRoots:
        """See `Roots.of_run`. The record is that of all runs."""
        return RecordedRoots(self._roots.of_run(t, y, args, memory), self.record)

    def _recorded(self, t: float, y: Array, which: Array, directions: Array, *args: Any) -> Any:
        before = np.array(y)
        after = self._roots.on_roots(t, y, which, directions, *args)
        state = np.array(after, dtype=float)
        self.record.append(Call(t, before, state, self._roots, which, directions, self._roots.remembered()))
        return after


def with_records(events: Sequence[Event], record: list[Call]) -> list[Any]:
    """Return the events with `Roots` that record their calls."""
    first = [one for one in events if not isinstance(one, RootOf) or one.number == 0]
    return [RecordedRoots(one.roots, record) if isinstance(one, RootOf) else one for one in first]


class Occurrence(NamedTuple):
    """A jump that is computed when it is passed: its matrices are not kept."""

    t: float  # time of the jump
    found: Callable[[], Jump]  # () -> the jump


class Action(NamedTuple):
    """Action that changes y at a time, of an event or at a breakpoint."""

    t: float  # time of the action
    before: Callable[[], Array]  # () -> the state, before all of that time
    action: Derivative  # the derivatives of the action
    event: Derivative | None  # derivatives of the event, whose time moves; None: a breakpoint
    reholds: bool  # as in `Jump`


#: Of a component at a bound, in units of atol / rtol: `roundoff_at_bound` of the core.
_AT_BOUND = 1e-13
#: Relative differences of states that are one, but for the errors of the continuous solution.
_SAME = 1e-6
#: Relative differences of derivatives of times that are roundoff.
_ALIKE = 1e-6
#: Of M⁻¹ f, in units of its terms.
_ROUNDOFF = 100 * EPS


def _behind(one: Occurrence) -> Array:
    return one.found().after


def _distance(a: Array, b: Array) -> float:
    """The largest difference of two states, in units of the larger one."""
    size = max(np.abs(a).max(initial=0), np.abs(b).max(initial=0))
    return float(np.abs(a - b).max(initial=0) / size) if size else 0.0


def _at_one_time(actions: list[Action]) -> list[list[Action]]:
    """Group the actions by their times, in order."""
    return [[*those] for _, those in groupby(sorted(actions, key=lambda one: one.t), key=lambda one: one.t)]


class Jumps:
    """All jumps of a solution.

    Parameters
    ----------
    problem : Problem
        The problem.
    names : sequence of ParameterName
        The parameters.
    derivatives : callable
        Makes derivatives of its functions.
    conditions : list of Switching
        Conditions of f that are followed; they are the last events of the solution.
    threshold : float or ndarray, (n,)
        atol / rtol of the run.
    calls : list of Call
        The calls of the actions of `Roots`.
    start : ndarray, (k, n), or None
        S at the start, for these.
    """

    def __init__(
        self,
        problem: Problem,
        names: Sequence[ParameterName],
        derivatives: Derivatives,
        conditions: Sequence[Switching],
        threshold: float | Array,
        atol: float | Array,
        calls: Sequence[Call] = (),
        start: Array | None = None,
    ) -> None:
        fun, given = given_derivatives(problem, names)
        n = len(problem.y0)
        self._calls, self._start, self._of_roots = calls, start, dict[int, OfRoots]()
        self._costs: dict[int, tuple[Any, AlongAction, Array]] = {}
        self._rate = Rate(problem, atol, lambda: derivatives(fun, "fun", m=n, given=given, moves_t=True))
        self._problem, self._names = problem, names
        self._landing: LandingJump | None = None
        self._derivatives, self._conditions = derivatives, conditions
        self._events: Sequence[Event] = problem.events
        self._t0, self._y0, self._forward = (
            problem.t_span[0],
            problem.y0,
            np.sign(problem.t_span[1] - problem.t_span[0]),
        )
        self._n, self._k = n, len(names)
        along = np.eye(n + len(names))  # the directions of S⁻ and of the parameters
        self._dy, self._dp = np.ascontiguousarray(along[:, :n]), np.ascontiguousarray(along[:, n:])
        self._restored = restoration(problem, names, threshold)
        self._behind: Callable[[float], Array] = lambda t: self._y0

    def follow_landings(self, schedule: Schedule | None) -> None:
        """Include from now on the landings, where f changes its branch at times that depend on parameters."""
        self._landing = landing_jump(schedule, self._problem, self._names, self._rate)

    def of(
        self, sol: Result, y: Callable[[float], Array], points: Sequence[Breakpoint], rests: Sequence[Rest]
    ) -> list[Occurrence]:
        """Return the jumps of a solution, y as a function of t, in the order of its times; at one time in the order in
        which the run takes them.

        Raises
        ------
        ValueError
            A condition changes at the time of an action; several actions at one time with a singular mass matrix, or
            of events whose times differ for other parameters.
        """
        self._behind = y
        events = [one for i in range(len(self._events)) for one in self._of_event(sol, i)]
        actions = [self._of_point(y, one) for one in points if one.action is not None]
        found: list[Occurrence] = []
        for together in sorted(_at_one_time([*events, *actions]), key=lambda one: self._order(one[0])):
            t = together[0].t
            singular = self._rate.is_singular and len(together) > 1
            self._require(not singular, t, "together with others, and the mass matrix is singular")
            parts = self._in_order(y, together)
            before = parts[0][0].before
            for part in parts:
                found.append(Occurrence(t, partial(self._jump, part, before)))
                before = partial(_behind, found[-1])
        for t, calls in groupby(self._calls, key=lambda one: one.t):
            self._require(all(t != one.t for one in found), t, "with one of Roots")
            found.append(Occurrence(t, partial(self._of_calls, [*calls])))
        conditions = [one for i in range(len(self._conditions)) for one in self._of_condition(sol, i)]
        for one in conditions:
            self._require(all(one.t != action.t for action in found), one.t, "where fun jumps too")
        landings = [] if self._landing is None else self._of_landings(self._landing, y, [one.t for one in points])
        found = [
            *landings,
            *found,
            *conditions,
            *(Occurrence(one.begin, partial(self._of_rest, y, one)) for one in rests),
        ]
        found.sort(key=self._order)
        return found

    def _in_order(self, y: Callable[[float], Array], together: list[Action]) -> list[list[Action]]:
        """Actions at one time in the order in which the run takes them: those up to the first breakpoint, and the rest.
        An event has the state that its action gets; those that are carried over zero by another follow that."""
        if len(together) == 1:
            return [together]
        t = together[0].t
        events, points = ([one for one in together if (one.event is None) == fixed] for fixed in (False, True))
        if not events:
            return [points]
        state = self._y0 if t == self._t0 else y(np.nextafter(t, self._t0))
        parts: list[list[Action]] = [[]]
        while events or points:
            distances = [_distance(one.before(), state) for one in events]
            nearest = int(np.argmin(distances)) if distances else -1
            if distances and distances[nearest] <= _SAME:
                following = events.pop(nearest)
            else:
                self._require(bool(points), t, "in an order that is not known")
                following = points.pop(0)
                if parts[-1] and all(one.event is not None for one in parts[-1]):
                    parts.append([])
                    state = state if self._restored is None else self._restored.value(t, state)
            parts[-1].append(following)
            state = following.action.value(t, state)
        return parts

    @staticmethod
    def last_was_taken(found: list[Occurrence], t_end: float, end: Array) -> bool:
        """Return whether a run that failed at t_end in the state `end` continued from the last jump, if it was there:
        its actions may be the cause of the failure."""
        if not found or found[-1].t != t_end:
            return True
        jump = found[-1].found()
        return bool(np.abs(end - jump.after).max() < np.abs(end - jump.before).max()) or not jump.moves

    def _order(self, one: Action | Occurrence) -> float:
        return float(self._forward * one.t)

    @staticmethod
    def _require(possible: bool, t: float, why_not: str) -> None:
        if not possible:
            raise ValueError(
                f"gradient: an action is taken at t = {t:.6g}, {why_not}: use sensitivities=, or make one action of "
                "what happens at that time"
            )

    def _of_event(self, sol: Result, i: int) -> list[Action]:
        event = self._events[i]
        if event.action is None or not len(sol.t_events[i]):
            return []
        times, _ = of_event(event, self._derivatives)
        action = self._derivatives(event.action, f"the action of {titled(event.__name__)}", m=self._n, moves_t=True)
        # At the end the action of a terminal event is not taken; one that has set off a terminal event was.
        ended = sol.status == 1 and sol.t_events[i][-1] == sol.t_end
        last = len(sol.t_events[i]) - (
            ended and (bool(event.terminal) or np.array_equal(sol.y_end, sol.y_events[i][-1]))
        )
        occurred = zip(sol.t_events[i][:last].tolist(), sol.y_events[i], strict=False)
        return [Action(t, partial(np.asarray, y), action, times, event.rehold) for t, y in occurred]

    def _of_point(self, y: Callable[[float], Array], point: Breakpoint) -> Action:
        action = self._derivatives(point.action, "the action in breakpoints", m=self._n, moves_t=False)

        def before() -> Array:
            return self._y0 if point.t == self._t0 else y(np.nextafter(point.t, self._t0))

        return Action(point.t, before, action, None, reholds=True)

    def _jump(self, together: list[Action], start: Callable[[], Array]) -> Jump:
        """Return the joint jump of actions at one time, all of events or all at breakpoints; they begin in the state of
        `start`."""
        t, y = together[0].t, start()
        times = self._time(together, y)
        moved = self._dy + np.outer(times, self._rate(t, y))
        before = y
        for one in together:
            moved, y = one.action.columns(t, y, times, moved, self._dp), one.action.value(t, y)
        return self._landed(t, before, y, times, moved, self._dp, all(one.reholds for one in together))

    def _landed(
        self, t: float, before: Array, y: Array, times: Array, moved: Array, dp: Array, reholds: bool, **more: Any
    ) -> Jump:
        """Return the jump of actions to y, of which the derivatives at τ(p) are `moved`."""
        if self._restored is not None and reholds:
            moved, y = self._restored.columns(t, y, times, moved, dp), self._restored.value(t, y)
        if self._rate.is_singular:  # algebraic variables follow; costs of theirs are those of the others
            y = np.asarray(self._behind(t))
        moved = moved - np.outer(times, self._rate(t, y))
        return Jump(t, before, y, times, moved, self._k, reholds, moves=True, **more)

    def _time(self, together: list[Action], y: Array) -> Array:
        """Return ∂τ along the directions of S⁻ and of the parameters."""
        t = together[0].t
        found: list[Array] = []
        rate_before = self._rate(t, y)
        for one in together:
            if one.event is None:
                return np.zeros(self._n + self._k)
            if found and not is_at_root(one.event, t, y, rate_before):
                continue  # a jump has carried it over zero
            found.append(times_of(one.event, t, y, rate_before, self._dy, self._dp))
        alike = all(np.allclose(found[0], one, rtol=_ALIKE) for one in found)
        self._require(alike, t, "together with that of another event, which has another time for other parameters")
        return found[0]

    def _of_calls(self, calls: list[Call]) -> Jump:
        """Return the joint jump of the actions of `Roots` at one time, which follow one another."""
        t, before, n, k = calls[0].t, calls[0].before, self._n, self._k
        left: list[tuple[Any, AlongAction]] = []
        used: dict[int, tuple[Any, AlongAction]] = {}
        for one in calls:
            action = self._recalled(one).action
            made, waited = action.waits()
            new = {id(each) for each, _ in left}
            used.update((id(each), (each, action)) for each in waited if id(each) not in new)
            left += [(each, action) for each in made]
        along = np.eye(n + k + sum(action.width(each) for each, action in used.values()))
        dy, dp = np.ascontiguousarray(along[:, :n]), np.ascontiguousarray(along[:, n : n + k])
        places, end = [], n + k
        for each, action in used.values():
            where = slice(end, end + action.width(each))
            action.give(each, along[:, where])
            places.append((each, where, action))
            end = where.stop
        f = self._rate(t, before)
        times = self._recalled(calls[0]).times(t, before, f, int(calls[0].which[0]), dy, dp)
        moved = dy + np.outer(times, f)
        for one in calls:
            moved = self._recalled(one).action.columns(t, one.before, times, moved, dp)
        rows = [(each, action.of_waiting(each)) for each, action in left]
        waiting: dict[str, Any] = {"left": rows, "used": places, "costs": self._costs}
        reholds = all(one.roots.rehold for one in calls)
        return self._landed(t, before, calls[-1].after, times, moved, dp, reholds, **waiting)

    def _recalled(self, one: Call) -> OfRoots:
        """Return the derivatives of the functions and of the action of a `Roots`, with this call as the latest."""
        key = id(one.roots)
        if key not in self._of_roots:
            assert self._start is not None
            self._of_roots[key] = of_roots(one.roots, self._derivatives, self._start)
        one.roots.recall(one.which, one.directions, one.remembered)
        return self._of_roots[key]

    def of_start(self) -> Array:
        """Return the derivatives, (k,), by what waits from the start on, whose costs have come there."""
        total: Array = np.zeros(self._k)
        for one, action, cost in self._costs.values():
            action.give(one, None)
            total = total + cost @ action.of_waiting(one).T
        return total

    def _of_condition(self, sol: Result, i: int) -> list[Occurrence]:
        condition = self._conditions[i]
        place = len(self._events) + i
        found = []
        for t, y in zip(sol.t_events[place].tolist(), sol.y_events[place], strict=True):
            crossing = condition.crossing(t, y)
            if crossing is None:
                continue
            condition.tell(t, crossing)
            found.append(Occurrence(t, partial(self._of_crossing, condition, crossing, t, y)))
        return found

    def _of_landings(self, landing: LandingJump, y: Callable[[float], Array], times: list[float]) -> list[Occurrence]:
        """Return the jumps at landings, where f alone changes; they come before actions at the same time."""
        found = []
        for t in times:
            rates = landing.rates_of_time(t)
            if rates.any() and t != self._t0:
                found.append(Occurrence(t, partial(self._of_landing, landing, rates, y, t)))
        return found

    def _of_landing(self, landing: LandingJump, rates: Array, solution: Callable[[float], Array], t: float) -> Jump:
        y = solution(float(np.nextafter(t, self._t0)))
        before, after = landing.sides(t, y)
        return self._across(t, y, np.append(np.zeros(self._n), rates), before - after)

    def _across(self, t: float, y: Array, times: Array, change: Array) -> Jump:
        """Return the jump where f changes its branch, and y' by −`change`."""
        return Jump(t, y, y, times, self._dy + np.outer(times, change), self._k)

    def _of_crossing(self, condition: Switching, crossing: SwitchCrossing, t: float, y: Array) -> Jump:
        still = np.zeros(self._n + self._k)
        times = -condition.difference.columns(t, y, still, self._dy, self._dp)[:, 0] / crossing.rate
        return self._across(t, y, times, crossing.before - crossing.after)

    def _of_rest(self, solution: Callable[[float], Array], rest: Rest) -> Jump:
        """Return the jump at the time where a rest begins: S_i is 0."""
        y, moved = solution(rest.begin), self._dy.copy()
        moved[rest.component] = 0
        return Jump(rest.begin, y, y, np.zeros(len(moved)), moved, self._k)


class Rest(NamedTuple):
    """The time that a component spends at a bound."""

    component: int
    begin: float
    end: float


def at_bounds(
    problem: Problem,
    sol: Result,
    y: DenseSolution | SectionedSolution,
    threshold: float | Array,
    atol: float | Array,
) -> list[Rest]:
    """Return the rests of components at their bounds: in steps that start there, except for roundoff in units of the
    threshold atol / rtol, and end there within the tolerance, as those do that an event cuts, where y' leads out of the
    bounds, or is 0 since they have reached them.

    Raises ValueError: A component is held that a singular mass matrix couples with others.
    """
    if problem.bounds is None:
        return []
    near = _AT_BOUND * np.reshape(threshold, (-1, 1))
    within = np.reshape(atol, (-1, 1))
    found: list[Rest] = []
    since: dict[tuple[int, int], float] = {}  # where components rest at the end of a part, by side and number
    for t in y.knots() if isinstance(y, SectionedSolution) else [y.ts]:
        # At the time of an action y(t) is the state after it: a step ends at the state before.
        states, ends = y(t[:-1]), y(np.nextafter(t[1:], t[:-1]))
        bounds = (-1, problem.bounds.lower), (1, problem.bounds.upper)
        sides = [
            (side, (np.abs(states - bound[:, None]) <= near) & (np.abs(ends - bound[:, None]) <= within))
            for side, bound in bounds
        ]
        middle = 0.5 * (t[1:] + t[:-1])
        if any(stays.any() for _, stays in sides):
            outwards = _directions(problem, middle, y(middle)) * np.sign(t[-1] - t[0])
        else:
            outwards = np.full((len(states), len(middle)), np.nan)
        for side, stays in sides:
            for i, row in enumerate(stays & ((outwards == side) | (outwards == 0))):
                before = since.pop((side, i), None)
                if t[0] == problem.t_span[0]:  # nothing has come to a bound yet
                    row &= np.maximum.accumulate(~stays[i] | (outwards[i] == side))
                if before is not None and not row[0]:
                    found.append(Rest(i, before, float(t[0])))
                edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]])))
                for a, b in edges.reshape(-1, 2):
                    begin = before if a == 0 and before is not None else float(t[a])
                    if b == len(row):
                        since[side, i] = begin
                    else:
                        found.append(Rest(i, begin, float(t[b])))
    found += [Rest(i, begin, sol.t_end) for (_, i), begin in since.items()]
    for rest in found:
        _require_uncoupled(problem, rest)
    return found


def _directions(problem: Problem, times: Array, states: Array) -> Array:
    """The signs of y', of shape (n, n_t): 0 where M⁻¹ f is roundoff of its terms. Of a singular M, f_i M_ii stands for
    y_i', as in the core; NaN of algebraic components."""
    slopes = problem.slope(times, states)
    mass, found = problem.matrices.mass, np.empty_like(slopes)
    inverse: Array | None = None
    singular = False
    for k, t in enumerate(times.tolist()):
        if inverse is None or callable(mass):
            M = dense_mass(mass, t, problem.args)
            if M is None:
                return np.sign(slopes)
            singular = Algebraic.of(M) is not None
            inverse = np.diag(np.diag(M)) if singular else np.linalg.inv(M)
        f = slopes[:, k]
        rate = inverse @ f
        found[:, k] = np.where(np.abs(rate) <= _ROUNDOFF * (np.abs(inverse) @ np.abs(f)), 0, np.sign(rate))
        if singular:
            found[np.diag(inverse) == 0, k] = np.nan
    return found


def _require_uncoupled(problem: Problem, rest: Rest) -> None:
    """The equation of a component at rest is that of its own row, which a singular M must not share."""
    M, i = dense_mass(problem.matrices.mass, rest.begin, problem.args), rest.component
    if M is None or Algebraic.of(M) is None:
        return
    others = np.arange(len(M)) != i
    if M[i, others].any() or M[others, i].any():
        raise ValueError(
            f"gradient: component {i} rests at a bound from t = {rest.begin:.6g}, and the singular mass matrix couples "
            "it with others: use sensitivities=, or write its equation with a mass matrix that has its own row"
        )
