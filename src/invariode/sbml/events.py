"""Events of a model: triggers, priorities, delays and persistence, on the roots of one vector function.

A trigger is a Boolean function of comparisons. Each comparison is one root function, so that both edges of a short
trigger are found; its sign at a root is 0, then the new one, so that <, <=, == differ as they should. After each
assignment all triggers are evaluated again, at the same time.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._functions.graph.arrays import ArrayFunction
from .._functions.graph.derivatives import jacobian
from .._functions.graph.nodes import Node, in_order
from .._problem.events import Roots
from .equations import Equations, used
from .expressions import Expression
from .library import UnsupportedError
from .reading import EventRule

#: Whether a comparison holds, by the sign of the difference of its sides.
_HOLDS: dict[str, Callable[[int], bool]] = {
    "gt": lambda s: s > 0,
    "geq": lambda s: s >= 0,
    "lt": lambda s: s < 0,
    "leq": lambda s: s <= 0,
    "eq": lambda s: s == 0,
    "neq": lambda s: s != 0,
}

#: Events at one time beyond which they are taken to trigger each other without end.
_MOST_AT_ONCE = 3000

#: Relative to t (or 1), times as near as this are one.
SAME_TIME = 1e-12


class Comparison(NamedTuple):
    """A comparison in a trigger: the difference of its sides, and its relation to zero."""

    difference: Node
    relation: str


class _Code(NamedTuple):
    """An event, ready to be executed."""

    rule: EventRule
    delay: ArrayFunction | None
    priority: ArrayFunction | None
    values: ArrayFunction
    places: list[int]
    volumes: ArrayFunction


class EventCode:
    """The events of a model.

    Attributes
    ----------
    comparisons : list of Comparison
        All comparisons in triggers.
    differences : list of Node
        Their differences.
    roots, slopes : ArrayFunction
        These, and their derivatives along the solution.
    nodes : list of Node
        All values that events use.
    holds : callable
        Whether each trigger holds, of the truths of all comparisons.
    has_delays : bool
        Whether an event may be executed later than it is triggered.
    """

    def __init__(self, equations: Equations) -> None:
        self._equations = equations
        self.comparisons: list[Comparison] = []
        self.nodes: list[Node] = []
        self._triggers: list[str] = []
        self.events = [self._event(one) for one in equations.contents.events]
        differences = [one.difference for one in self.comparisons]
        self.differences = differences
        self.nodes += differences
        if max(used(self.nodes, "y"), default=-1) >= (len(equations.states) or 1):
            raise UnsupportedError("delay", "an event uses delay(): values of the past")
        self.roots = ArrayFunction(differences)
        self.slopes = ArrayFunction([self._along(one) for one in differences])
        self.has_delays = any(one.delay is not None for one in self.events)
        namespace: dict[str, Any] = {}
        exec(f"def holds(B):\n    return [{', '.join(self._triggers)}]\n", namespace)
        self.holds: Callable[[Sequence[bool]], list[bool]] = namespace["holds"]

    def __reduce__(self) -> tuple[Any, ...]:
        return EventCode, (self._equations,)

    def _event(self, rule: EventRule) -> _Code:
        equations = self._equations
        graph = equations.graph
        number = equations.translator.number
        self._triggers.append(self._truth(rule.trigger))
        names = [*rule.assignments]
        amounts = [equations.is_concentration(n) and equations.is_amount_state[n] for n in names]
        one = graph.node(1.0)
        volumes = [equations.value(equations.volume(n)) if yes else one for n, yes in zip(names, amounts, strict=True)]
        return _Code(
            rule,
            None if rule.delay is None else self._function([number(rule.delay)]),
            None if rule.priority is None else self._function([number(rule.priority)]),
            self._function([number(value) for value in rule.assignments.values()]),
            [equations.place[n] for n in names],
            self._function(volumes),
        )

    def _function(self, nodes: list[Node]) -> ArrayFunction:
        self.nodes += nodes
        return ArrayFunction(nodes)

    def _truth(self, one: Expression) -> str:
        """Return a condition as Python's code, of the truths B of comparisons."""
        a = one.arguments
        if one.op in ("true", "false"):
            return str(one.op == "true")
        if one.op in _HOLDS:
            pairs = [self._compared(one.op, x, y) for x, y in itertools.pairwise(a)]
            return f"({' and '.join(pairs)})" if pairs else "True"
        if one.op in ("and", "or"):
            return f"({f' {one.op} '.join(map(self._truth, a))})" if a else str(one.op == "and")
        if one.op == "not":
            return f"(not {self._truth(a[0])})"
        if one.op == "xor":
            return f"(sum([{', '.join(map(self._truth, a))}]) % 2 == 1)"
        if one.op == "implies":
            return f"((not {self._truth(a[0])}) or {self._truth(a[1])})"
        if one.op == "piecewise" and one.is_logical:
            pairs = [f"{self._truth(a[i])} if {self._truth(a[i + 1])} else " for i in range(0, len(a) - 1, 2)]
            return f"({''.join(pairs)}{self._truth(a[-1]) if len(a) % 2 else 'False'})"
        return self._compared("neq", one, Expression("number", (), 0.0))

    def _compared(self, op: str, x: Expression, y: Expression) -> str:
        for inner in (*x.parts(), *y.parts()):  # comparisons inside numbers, where these jump
            if inner.op in _HOLDS:
                for a, b in zip(inner.arguments, inner.arguments[1:], strict=False):
                    self._place(inner.op, a, b)
        return f"B[{self._place(op, x, y)}]"

    def _place(self, op: str, x: Expression, y: Expression) -> int:
        number = self._equations.translator.number
        found = Comparison(number(x) - number(y), op)
        if found not in self.comparisons:
            self.comparisons.append(found)
        return self.comparisons.index(found)

    def _along(self, difference: Node) -> Node:
        """Return the derivative of a difference along the solution."""
        equations = self._equations
        graph = equations.graph
        moving = [i for i in sorted(used([difference], "y")) if equations.states[i] not in equations.matched]
        (row,) = jacobian([difference], [graph.t, *map(graph.y, moving)])
        total = row.get(0, graph.node(0.0))
        for j, i in enumerate(moving, 1):
            if j in row:
                total = total + row[j] * equations.slopes[i]
        return total


class Waiting:
    """An event that was triggered and waits for its execution: its time, its number, and its values, if these are those
    of the time of the trigger."""

    __slots__ = ("event", "time", "values")

    def __init__(self, time: float, event: int, values: list[float] | None) -> None:
        self.time, self.event, self.values = time, event, values


class Machine:
    """The course of the events of a run.

    Parameters
    ----------
    code : EventCode
        The events.
    equations : Equations
        The model.
    seed : int
        Of the order in which events of one priority, or of none, are executed at one time.
    """

    def __init__(self, code: EventCode, equations: Equations, seed: int = 0) -> None:
        self._code, self._equations, self._seed = code, equations, seed
        self._t0 = -np.inf
        self._p = np.zeros(0)
        self.queue: list[Waiting] = []
        self.behind: list[tuple[float, Array]] = []

    def start(self, t: float, y: Array, p: Array) -> Array:
        """Begin a run; return the state after the events at its start."""
        self._t0, self._p, self._random = t, p, random.Random(self._seed)
        #: States behind events, by time, for output at these times.
        self.behind = []
        self.queue = []
        self.executed = 0
        count = len(self._code.comparisons)
        self._signs, self._truths, self._zeros = [1] * count, [False] * count, set(range(count))
        with np.errstate(all="ignore"):
            self._change(dict(enumerate(self._signs_at(t, y))))
            now = self._code.holds(self._truths)
            self._holds = [one.rule.initial and holds for one, holds in zip(self._code.events, now, strict=True)]
            self._trigger(t, y)
            behind = self._settled(t, y, {})
        self._at_start = len(self.queue)
        return behind

    @property
    def _due(self) -> float:
        """Time of the next execution of an event that waits; infinite if none does."""
        return min((one.time for one in self.queue), default=np.inf)

    def functions(self, compiled: Any, once: bool) -> list[Roots]:
        """Return the root functions of a run: the differences of all comparisons, and how long an execution has been
        due. The latter also begins further runs, unless there is only one."""
        needed = self._code.has_delays or not once
        found = [Roots(self.due, 1, self.on_due, names=["execution"])] if needed else []
        if count := len(self._code.comparisons):
            names = [f"comparison {i + 1}" for i in range(count)]
            found.insert(0, Roots(compiled, count, self.on_roots, names=names))
        return found

    def due(self, t: float, y: Array, *args: Any) -> list[float]:
        """Return how long the next execution has been due; a start at t0 begins another run."""
        if t == self._t0 and args and (self.behind or len(self.queue) != self._at_start):
            self.start(t, np.array(y), np.array(args[0], dtype=float))
        return [t - self._due if self.queue else -1.0]

    def on_due(self, t: float, y: Array, which: Any, directions: Any, *args: Any) -> Array:
        """Return the state behind the events that are due."""
        return y if self._due > t + _near(t) else self._after(t, y, {})

    def on_roots(self, t: float, y: Array, which: Any, directions: Any, *args: Any) -> Array:
        """Return the state behind the events that comparisons trigger, or that are due."""
        signs = self._signs
        pairs = zip(which.tolist(), directions.tolist(), strict=True)
        hit = {i: s for i, s in pairs if signs[i] != s}  # others have their signs from an assignment
        return self._after(t, y, hit) if hit else y

    def _after(self, t: float, y: Array, hit: dict[int, int]) -> Array:
        """Return the state behind the events that comparisons with these new signs trigger, and those that are due."""
        with np.errstate(all="ignore"):
            if self._zeros:  # comparisons that have left zero
                now = self._signs_at(t, y)
                self._change({i: now[i] for i in self._zeros if i not in hit})
            self._change(dict.fromkeys(hit, 0))
            self._trigger(t, y)
            self._change(hit)
            self._trigger(t, y)
            executed = self.executed
            behind = self._settled(t, y, hit)
        if self.executed > executed:
            self.behind.append((t, behind))
        return behind

    def _signs_at(self, t: float, y: Array) -> list[int]:
        return [_sign(d) for d in self._code.roots.code(t, y, self._p)]

    def _change(self, signs: dict[int, int]) -> None:
        """Give some comparisons other signs."""
        for i, s in signs.items():
            if s != self._signs[i] or s == 0 or i in self._zeros:
                self._signs[i] = s
                self._truths[i] = _HOLDS[self._code.comparisons[i].relation](s)
                (self._zeros.discard if s else self._zeros.add)(i)

    def _trigger(self, t: float, y: Array) -> None:
        """Compare triggers with their values before: rising ones wait for execution, falling ones may be withdrawn."""
        now = self._code.holds(self._truths)
        if now == self._holds:
            return
        before, self._holds = self._holds, now
        for i, (was, holds) in enumerate(zip(before, now, strict=True)):
            one = self._code.events[i]
            if holds and not was:
                delay = 0.0 if one.delay is None else float(one.delay.code(t, y, self._p)[0])
                values = one.values.code(t, y, self._p) if one.rule.at_trigger else None
                self.queue.append(Waiting(t + delay, i, values))
            elif was and not holds and not one.rule.persistent:
                self.queue = [each for each in self.queue if each.event != i]

    def _settled(self, t: float, y: Array, hit: dict[int, int]) -> Array:
        """Return the state after all due events. `hit`: comparisons at their roots, with the signs that
        follow."""
        late, after = t + _near(t), None
        for _ in range(_MOST_AT_ONCE):
            due = [one for one in self.queue if one.time <= late]
            if not due:
                if not self._zeros or not self._leave(t, y, hit):
                    return y
                continue
            chosen = self._first(due, t, y)
            self.queue = [one for one in self.queue if one is not chosen]
            before = self._code.roots.code(t, y, self._p) if after is None else after
            y = self._executed(t, y, chosen)
            after = self._code.roots.code(t, y, self._p)
            hit = {i: s for i, s in hit.items() if before[i] == after[i]}  # others are no longer at their roots
            self._change({i: hit.get(i, _sign(d)) for i, d in enumerate(after)})
            self._trigger(t, y)
        raise ValueError(f"more than {_MOST_AT_ONCE} events at t = {t:.17g}: they trigger each other without end")

    def _leave(self, t: float, y: Array, hit: dict[int, int]) -> bool:
        """Change comparisons that are exactly at zero to the signs that they take next; return whether any changed."""
        slopes = self._code.slopes.code(t, y, self._p)
        new = {i: s for i in self._zeros if (s := _sign(slopes[i]))}
        hit.update(new)
        self._change(new)
        self._trigger(t, y)
        return bool(new)

    def _first(self, due: list[Waiting], t: float, y: Array) -> Waiting:
        """Return the event of the highest priority; those of one priority, or of none, come in any order."""
        if len(due) == 1:
            return due[0]

        def priority(one: Waiting) -> float:
            of = self._code.events[one.event].priority
            value = -np.inf if of is None else float(of.code(t, y, self._p)[0])
            return -np.inf if np.isnan(value) else value

        self._random.shuffle(due)
        return max(due, key=priority)

    def _executed(self, t: float, y: Array, chosen: Waiting) -> Array:
        """Return the state behind the assignments: a concentration becomes an amount with the volume before."""
        one = self._code.events[chosen.event]
        values = one.values.code(t, y, self._p) if chosen.values is None else chosen.values
        after = np.array(y)
        for place, value, volume in zip(one.places, values, one.volumes.code(t, y, self._p), strict=True):
            after[place] = value * volume
        self.executed += 1
        return self._equations.consistent(t, after, self._p)


def _near(t: float) -> float:
    return SAME_TIME * max(1.0, abs(t))


def _sign(d: float) -> int:
    """Return the sign of a number: -1, 0 or 1; 0 for NaN."""
    return 1 if d > 0 else -1 if d < 0 else 0


def times_of_roots(differences: Sequence[Node], p: Array) -> list[float]:
    """Return the times at which comparisons that are affine in t alone change."""
    found = set()
    for one in differences:
        if used([one], "y") or not any(each.op == "t" for each in in_order([one])):
            continue
        a, b, c = (ArrayFunction([one]).at(t, np.zeros(0), p)[0] for t in (0.0, 1.0, 3.5))
        slope = b - a
        if slope and abs(a + 3.5 * slope - c) <= 1e-12 * (abs(a) + abs(c)):
            found.add(float(-a / slope))
    return sorted(found)
