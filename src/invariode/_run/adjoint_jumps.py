"""Where a solution jumps, or its slope does, as what that does to its sensitivities: S⁺ = A S⁻ + B.

For an event e(t, y, p) = 0 at τ with the action y⁺ = h(τ, y⁻, p) (of a condition at which f jumps, h is y), from

    ∂τ = −(e_y S⁻ + e_p) / (e_t + e_y f⁻),   S⁺ = h_y (S⁻ + f⁻ ∂τ) + h_p + h_t ∂τ − f⁺ ∂τ

and v = h_y f⁻ + h_t − f⁺ follow A = h_y − v e_y / e', B = h_p − v e_p / e'. A breakpoint has v = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._functions.directional import Directional
from .._problem.breakpoints import Breakpoint
from .._problem.description import Description
from .._problem.events import Event
from .._results.result import Result
from .variations import Rate, Switching

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


class Partials:
    """The derivatives of a function with respect to everything at once."""

    def __init__(self, function: Directional, t: float, y: Array) -> None:
        k, n = function.k, function.n
        self.of_y = function.jacobian(t, y)
        self.of_p = function.columns(t, y, np.zeros(k), np.zeros((k, n)), np.eye(k)).T
        self.of_t = function.columns(t, y, np.ones(1), np.zeros((1, n)), np.zeros((1, k)))[0]


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
    """

    def __init__(self, problem: Description, derivatives: Derivatives, conditions: Sequence[Switching]) -> None:
        self._rate, self._derivatives, self._conditions = Rate(problem), derivatives, conditions
        self._events: list[Event] = problem.events
        self._t0, self._y0, self._forward = (
            problem.t_span[0],
            problem.y0,
            np.sign(problem.t_span[1] - problem.t_span[0]),
        )
        self._n, self._k = len(problem.y0), len(problem.parameters())

    def of(self, sol: Result, points: Sequence[Breakpoint], rests: Sequence[Rest]) -> list[Jump]:
        """Those of a solution, in the order of its times.

        Raises
        ------
        ValueError
            Two of them coincide.
        """
        found = [one for i in range(len(self._events)) for one in self._of_event(sol, i)]
        found += [one for i in range(len(self._conditions)) for one in self._of_condition(sol, i)]
        found += [self._of_point(sol, one) for one in points if one.action is not None]
        found += [self._of_rest(sol, one) for one in rests]
        found.sort(key=lambda one: float(self._forward * one.t))
        for one, then in pairwise(found):
            if one.t == then.t and (one.moves or then.moves):
                raise ValueError(
                    f"gradient: several actions are taken at t = {one.t:.6g}, and the adjoint does not know their "
                    "order: use sensitivities=, or make one action of them"
                )
        return found

    def _of_event(self, sol: Result, i: int) -> list[Jump]:
        event = self._events[i]
        if event.action is None or not len(sol.t_events[i]):
            return []
        times = self._derivatives(event.fun, f"event {event.__name__}", m=1, moves_t=True, event=True)
        action = self._derivatives(event.action, f"the action of event {event.__name__}", m=self._n, moves_t=True)
        last = len(sol.t_events[i]) - (sol.status == 1 and sol.t_events[i][-1] == sol.t_end)  # there it is not taken
        found = []
        for t, y in zip(sol.t_events[i][:last].tolist(), sol.y_events[i], strict=False):
            after, f = action.value(t, y), self._rate(t, y)
            h, e = Partials(action, t, y), Partials(times, t, y)
            moved = h.of_y @ f + h.of_t - self._rate(t, after)
            rate = float(e.of_t[0] + e.of_y[0] @ f)
            found.append(self._jump(t, y, after, h, e, moved, rate, event.rehold))
        return found

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
            e = Partials(condition.difference, t, y)
            moved = crossing.before - crossing.behind
            of_state, of_p = -e.of_y[0] / crossing.rate, -e.of_p[0] / crossing.rate
            A, B = np.eye(self._n) + np.outer(moved, of_state), np.outer(moved, of_p)
            found.append(Jump(t, y, y, A, B, of_state, of_p, reholds=False, moves=False))
        return found

    def _of_point(self, sol: Result, point: Breakpoint) -> Jump:
        action = self._derivatives(point.action, "the action in breakpoints", m=self._n)
        before: Any = self._y0 if point.t == self._t0 else sol.sol(np.nextafter(point.t, self._t0))
        k, n = self._k, self._n
        h_p = action.columns(point.t, before, np.zeros(k), np.zeros((k, n)), np.eye(k)).T
        h_y, after = action.jacobian(point.t, before), action.value(point.t, before)
        return Jump(point.t, before, after, h_y, h_p, np.zeros(n), np.zeros(k), reholds=True, moves=True)

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
