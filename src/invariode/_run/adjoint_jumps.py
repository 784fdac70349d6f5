"""Where a solution jumps, or its slope does, as what that does to its sensitivities: S⁺ = A S⁻ + B.

For an event e(t, y, p) = 0 at τ with the action y⁺ = h(τ, y⁻, p) (of a condition at which f jumps, h is y), from

    ∂τ = −(e_y S⁻ + e_p) / (e_t + e_y f⁻),   S⁺ = h_y (S⁻ + f⁻ ∂τ) + h_p + h_t ∂τ − f⁺ ∂τ

and v = h_y f⁻ + h_t − f⁺ follow A = h_y − v e_y / e', B = h_p − v e_p / e'. A breakpoint has v = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._functions.directional import Directional
from .._problem.breakpoints import Breakpoint
from .._problem.description import Description
from .._problem.events import Event
from .._results.result import Result
from .variations import Rate, Switching, given_derivatives, restoration

#: (fun, name in messages, ...) -> its derivatives.
Derivatives = Callable[..., Directional]


@dataclass
class Jump:
    """What happens to S at a time.

    Attributes
    ----------
    t : float
        When.
    before, after : ndarray, (n,)
        The state.
    A, B : ndarray, (n, n) and (n, k)
        S⁺ = A S⁻ + B.
    time_of_state, time_of_parameters : ndarray, (n,) and (k,)
        ∂τ = time_of_state · S⁻ + time_of_parameters.
    reholds : bool
        Whether invariants without a value are held at their values behind it.
    moves : bool
        Whether y jumps.
    """

    t: float
    before: Array
    after: Array
    A: Array
    B: Array
    time_of_state: Array
    time_of_parameters: Array
    reholds: bool
    moves: bool

    def transposed(self, mu: Array, cost_of_time: float) -> tuple[Array, Array]:
        """Aᵀ μ and Bᵀ μ, with the cost of ∂τ added."""
        state = self.A.T @ mu + cost_of_time * self.time_of_state
        return state, self.B.T @ mu + cost_of_time * self.time_of_parameters


class Partials(NamedTuple):
    """The derivatives of a function with respect to everything at once."""

    of_y: Array
    of_p: Array
    of_t: Array

    @classmethod
    def at(cls, function: Directional, t: float, y: Array) -> Partials:
        """Those of a function at a point."""
        k, n = function.k, function.n
        return cls(
            function.jacobian(t, y),
            function.columns(t, y, np.zeros(k), np.zeros((k, n)), np.eye(k)).T,
            function.columns(t, y, np.ones(1), np.zeros((1, n)), np.zeros((1, k)))[0],
        )

    def into(self, then: Partials) -> Partials:
        """Those of a second function of (t, y, p) at y = the first one."""
        return Partials(then.of_y @ self.of_y, then.of_y @ self.of_p + then.of_p, then.of_y @ self.of_t + then.of_t)


class Action(NamedTuple):
    """What moves y at a time: an action of an event or at a breakpoint.

    Attributes
    ----------
    t : float
        When.
    before : ndarray, (n,)
        The state, before all actions of that time.
    jump : callable
        The state before this one -> its jump.
    """

    t: float
    before: Array
    jump: Callable[[Array], Jump]


class Jumps:
    """All jumps of a solution.

    Parameters
    ----------
    problem : Description
        The problem.
    derivatives : callable
        Makes derivatives of its functions.
    conditions : list of Switching
        Those of f that are followed; they are the last events of the solution.
    threshold : float or ndarray, (n,)
        atol / rtol of the run.
    """

    def __init__(
        self,
        problem: Description,
        derivatives: Derivatives,
        conditions: Sequence[Switching],
        threshold: float | Array,
    ) -> None:
        fun, given = given_derivatives(problem, problem.parameters())
        n = len(problem.y0)
        self._rate = Rate(problem, lambda: derivatives(fun, "fun", m=n, given=given, moves_t=True))
        self._derivatives, self._conditions = derivatives, conditions
        self._events: list[Event] = problem.events
        self._t0, self._y0, self._forward = (
            problem.t_span[0],
            problem.y0,
            np.sign(problem.t_span[1] - problem.t_span[0]),
        )
        self._n, self._k = n, len(problem.parameters())
        self._restored = restoration(problem, problem.parameters(), threshold)

    def of(self, sol: Result, points: Sequence[Breakpoint], rests: Sequence[Rest]) -> list[Jump]:
        """Those of a solution, in the order of its times; at one time in that in which the run takes them.

        Raises
        ------
        ValueError
            A condition changes at the time of an action; several actions at one time with a singular mass matrix.
        """
        actions = [one for i in range(len(self._events)) for one in self._of_event(sol, i)]
        actions += [self._of_point(sol, one) for one in points if one.action is not None]
        actions.sort(key=lambda one: float(self._forward * one.t))
        found: list[Jump] = []
        for one in actions:
            again = bool(found) and found[-1].t == one.t
            if again and self._rate.is_singular:
                raise ValueError(
                    f"gradient: several actions are taken at t = {one.t:.6g}, which is not possible with a singular "
                    "mass matrix: use sensitivities=, or make one action of them"
                )
            found.append(one.jump(found[-1].after if again else one.before))
        moved = {one.t for one in found}
        conditions = [one for i in range(len(self._conditions)) for one in self._of_condition(sol, i)]
        if both := [one.t for one in conditions if one.t in moved]:
            raise ValueError(
                f"gradient: an action is taken at t = {both[0]:.6g}, where fun jumps too, and the adjoint does not know "
                "their order: use sensitivities="
            )
        found += [*conditions, *(self._of_rest(sol, one) for one in rests)]
        found.sort(key=lambda one: float(self._forward * one.t))
        return found

    def _of_event(self, sol: Result, i: int) -> list[Action]:
        event = self._events[i]
        if event.action is None or not len(sol.t_events[i]):
            return []
        times = self._derivatives(event.fun, f"event {event.__name__}", m=1, moves_t=True, event=True)
        action = self._derivatives(event.action, f"the action of event {event.__name__}", m=self._n, moves_t=True)
        restored = self._restored if event.rehold else None

        def jump(t: float, y: Array) -> Jump:
            f, (h, after), e = self._rate(t, y), self._landing(action, restored, t, y), Partials.at(times, t, y)
            moved = h.of_y @ f + h.of_t - self._rate(t, after)
            rate = float(e.of_t[0] + e.of_y[0] @ f)
            return self._jump(t, y, after, h, e, moved, rate, event.rehold)

        last = len(sol.t_events[i]) - (sol.status == 1 and sol.t_events[i][-1] == sol.t_end)  # there it is not taken
        occurred = zip(sol.t_events[i][:last].tolist(), sol.y_events[i], strict=False)
        return [Action(t, y, partial(jump, t)) for t, y in occurred]

    @staticmethod
    def _landing(action: Directional, restored: Directional | None, t: float, y: Array) -> tuple[Partials, Array]:
        """What leads to where the run goes on, and that state."""
        h, after = Partials.at(action, t, y), action.value(t, y)
        if restored is None:
            return h, after
        return h.into(Partials.at(restored, t, after)), restored.value(t, after)

    def _jump(
        self, t: float, y: Array, after: Array, h: Partials, e: Partials, moved: Array, rate: float, reholds: bool
    ) -> Jump:
        of_state, of_p = (-e.of_y[0] / rate, -e.of_p[0] / rate) if rate else (np.zeros(self._n), np.zeros(self._k))
        A, B = h.of_y + np.outer(moved, of_state), h.of_p + np.outer(moved, of_p)
        return Jump(t, y, after, A, B, of_state, of_p, reholds, moves=True)

    def _of_condition(self, sol: Result, i: int) -> list[Jump]:
        condition = self._conditions[i]
        place = len(self._events) + i
        found = []
        for t, y in zip(sol.t_events[place].tolist(), sol.y_events[place], strict=True):
            crossing = condition.crossing(t, y)
            if crossing is None:
                continue
            condition.tell(t, crossing)
            e = Partials.at(condition.difference, t, y)
            moved = crossing.before - crossing.behind
            of_state, of_p = -e.of_y[0] / crossing.rate, -e.of_p[0] / crossing.rate
            A, B = np.eye(self._n) + np.outer(moved, of_state), np.outer(moved, of_p)
            found.append(Jump(t, y, y, A, B, of_state, of_p, reholds=False, moves=False))
        return found

    def _of_point(self, sol: Result, point: Breakpoint) -> Action:
        action = self._derivatives(point.action, "the action in breakpoints", m=self._n, moves_t=False)
        before: Any = self._y0 if point.t == self._t0 else sol.sol(np.nextafter(point.t, self._t0))
        k, n = self._k, self._n

        def jump(y: Array) -> Jump:
            h, after = self._landing(action, self._restored, point.t, y)
            return Jump(point.t, y, after, h.of_y, h.of_p, np.zeros(n), np.zeros(k), reholds=True, moves=True)

        return Action(point.t, before, jump)

    def _of_rest(self, sol: Result, rest: Rest) -> Jump:
        """Where it begins: S_i is 0."""
        y: Any = sol.sol(rest.begin)
        A, n, k = np.eye(self._n), self._n, self._k
        A[rest.component, rest.component] = 0
        none = np.zeros((n, k))
        return Jump(rest.begin, y, y, A, none, np.zeros(n), np.zeros(k), reholds=False, moves=False)


class Rest(NamedTuple):
    """The time that a component spends at a bound."""

    component: int
    begin: float
    end: float


def at_bounds(problem: Description, sol: Result) -> list[Rest]:
    """When components are held at their bounds: between steps that end there, where f leads out of the bounds."""
    if problem.bounds is None or not sol.stats.clipped:
        return []
    t = sol.sol.ts
    y: Any = sol.sol(t)
    middle = 0.5 * (t[1:] + t[:-1])
    outwards = np.sign(problem.slope(middle, sol.sol(middle))) * np.sign(t[-1] - t[0])
    found = []
    for side, bound in ((-1, problem.bounds.lower), (1, problem.bounds.upper)):
        there = y == bound[:, None]
        held = there[:, 1:] & there[:, :-1] & (outwards == side)
        for i, row in enumerate(held):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]])))
            found += [Rest(i, float(t[a]), float(t[b])) for a, b in edges.reshape(-1, 2)]
    return found
