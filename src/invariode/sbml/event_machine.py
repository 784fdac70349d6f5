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
from .._functions.derivatives import Derivative
from .._functions.graph.array_code import ArrayFunction
from .._functions.graph.differentiation import jacobian
from .._functions.graph.nodes import Node, in_order
from .._functions.graph.python import Formula
from .._problem.events import Roots
from .._sensitivity.actions import OfRoots
from .equations import ModelEquations, used
from .formulas import Expression
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

#: (fun, name in messages, ...) -> its derivatives.
Derive = Callable[..., Derivative]

#: Relative to t (or 1), times as near as this are one.
SAME_TIME = 1e-12


class Inequality(NamedTuple):
    """A comparison in a trigger: the difference of its sides, and its relation to zero."""

    difference: Node
    relation: str


class _ConditionCode(NamedTuple):
    """An event, ready to be executed."""

    rule: EventRule
    delay: _EventPiece | None
    priority: _EventPiece | None
    values: _EventPiece
    places: list[int]
    volumes: _EventPiece


class _EventPiece:
    """Numbers that an event needs: their nodes, and their values."""

    def __init__(self, nodes: list[Node]) -> None:
        self.nodes = nodes
        self.code = ArrayFunction(nodes).code

    def derivatives(self, of: Derive, called: str) -> Derivative:
        """Return the derivatives of the numbers."""
        return of(Formula(called, lambda: self.nodes, (len(self.nodes),)), called, m=len(self.nodes), moves_t=True)


class EventCode:
    """The events of a model.

    - `comparisons`: all comparisons in triggers
    - `names`: the names of the events in which they stand first
    - `differences`: their differences
    - `roots`, `slopes`: these, and their derivatives along the solution
    - `nodes`: all values that events use
    - `holds`: whether each trigger holds, of the truths of all comparisons
    - `has_delays`: whether an event may be executed later than it is triggered
    """

    def __init__(self, equations: ModelEquations) -> None:
        self._equations = equations
        self.comparisons: list[Inequality] = []
        self.nodes: list[Node] = []
        self._triggers: list[str] = []
        self.events: list[_ConditionCode] = []
        self.names: list[str] = []
        for rule in equations.contents.events:
            before = len(self.comparisons)
            self.events.append(self._event(rule))
            own = len(self.comparisons) - before
            self.names += [rule.name if own == 1 else f"{rule.name}, comparison {i + 1}" for i in range(own)]
        differences = [one.difference for one in self.comparisons]
        self.differences = differences
        self.nodes += differences
        if max(used(self.nodes, "y"), default=-1) >= (len(equations.states) or 1):
            raise UnsupportedError("delay", "an event uses an assignment rule that contains delay()")
        self.roots = ArrayFunction(differences)
        self.slopes = ArrayFunction([self._along(one) for one in differences])
        self.has_delays = any(one.delay is not None for one in self.events)
        namespace: dict[str, Any] = {}
        exec(f"def holds(B):\n    return [{', '.join(self._triggers)}]\n", namespace)
        self.holds: Callable[[Sequence[bool]], list[bool]] = namespace["holds"]

    def __reduce__(self) -> tuple[Any, ...]:
        return EventCode, (self._equations,)

    def _event(self, rule: EventRule) -> _ConditionCode:
        equations = self._equations
        graph = equations.graph
        number = equations.translator.number
        self._triggers.append(self._truth(rule.trigger))
        names = [*rule.assignments]
        amounts = [equations.is_concentration(n) and equations.is_amount_state[n] for n in names]
        one = graph.node(1.0)
        volumes = [equations.value(equations.volume(n)) if yes else one for n, yes in zip(names, amounts, strict=True)]
        return _ConditionCode(
            rule,
            None if rule.delay is None else self._function([number(rule.delay)]),
            None if rule.priority is None else self._function([number(rule.priority)]),
            self._function([number(value) for value in rule.assignments.values()]),
            [equations.place[n] for n in names],
            self._function(volumes),
        )

    def _function(self, nodes: list[Node]) -> _EventPiece:
        self.nodes += nodes
        return _EventPiece(nodes)

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
        found = Inequality(number(x) - number(y), op)
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
    """An event that was triggered and waits for its execution.

    - `time`: the time of its execution
    - `event`: its number
    - `values`: the values to assign, if they are evaluated at the time of the trigger
    - `trigger`: time and state of the trigger
    - `slopes`: the derivatives of `time`, (k,), and of `values`, (k, m); None: not known yet
    """

    __slots__ = ("event", "slopes", "time", "trigger", "values")

    def __init__(self, time: float, event: int, values: list[float] | None, trigger: tuple[float, Array]) -> None:
        self.time, self.event, self.values, self.trigger = time, event, values, trigger
        self.slopes: tuple[Array, Array] | None = None

    def state(self) -> dict[str, Any]:
        """Return the event as JSON can hold it."""
        t, y = self.trigger
        slopes = None if self.slopes is None else [one.tolist() for one in self.slopes]
        values = None if self.values is None else [*map(float, self.values)]
        trigger = [float(t), np.asarray(y).tolist()]
        return {"time": self.time, "event": self.event, "values": values, "trigger": trigger, "slopes": slopes}

    @classmethod
    def of_state(cls, state: dict[str, Any]) -> Waiting:
        """Return the event of a state."""
        t, y = state["trigger"]
        one = cls(float(state["time"]), int(state["event"]), state["values"], (t, np.array(y, dtype=float)))
        if state["slopes"] is not None:
            time, values = (np.array(part, dtype=float) for part in state["slopes"])
            one.slopes = time, values.reshape(len(time), -1)
        return one


class _Taken(NamedTuple):
    """A step of an action, for its derivatives: a trigger, or an execution (`after` is the state after it)."""

    waiting: Waiting
    before: Array
    after: Array | None = None


class Machine:
    """The course of the events of a run.

    - `code`: the events
    - `equations`: the model
    - `seed`: of the order in which events of one priority, or of none, are executed at one time
    - `after`: receives the states after events, with their times, of all runs
    """

    def __init__(
        self, code: EventCode, equations: ModelEquations, seed: int = 0, after: list[tuple[float, Array]] | None = None
    ) -> None:
        self.code, self.equations, self._seed, self._after_events = code, equations, seed, after
        self.p = np.zeros(0)
        self.queue: list[Waiting] = []
        #: The steps of the latest action, in their order, and the event that was due first before it.
        self.taken: list[_Taken] = []
        self.first_due: Waiting | None = None
        self._derivatives: tuple[Array, MachineDerivatives] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out derivatives, which belong to runs of this process."""
        return {**self.__dict__, "_derivatives": None}

    def start(self, t: float, y: Array, p: Array) -> Array:
        """Return the state after the events at the start. Runs from there have copies of this machine."""
        after = self._begun(t, y, p, executes=True)
        self._start = t, after, p
        return after

    def of_run(self, t: float, y: Array, p: Array) -> Machine:
        """Return a machine for one run, which begins at (t, y), the state after the events at the start."""
        one = Machine(self.code, self.equations, self._seed, self._after_events)
        t0, y0, p0 = self._start
        if t == t0 and np.array_equal(y, y0) and np.array_equal(p, p0[: len(p)]):
            one.restore(self.state())
            one.p, one.executed = p, 0
        else:
            one._begun(t, y, p, executes=False)
        return one

    @property
    def begins_quietly(self) -> bool:
        """True if no event is triggered at the start, and no comparison is at its root there. Nearby parameters then
        trigger none either."""
        return not self._starts_at_root and all(one.rule.initial for one in self.code.events)

    def _begun(self, t: float, y: Array, p: Array, executes: bool) -> Array:
        """Begin a run. executes=False: y is the state after the events that are executed at the start."""
        self.p = p
        self.queue = []
        self.executed = 0
        count = len(self.code.comparisons)
        self._signs, self._truths, self._zeros = [1] * count, [False] * count, set(range(count))
        with np.errstate(all="ignore"):
            self._change(dict(enumerate(self._signs_at(t, y))))
            self._starts_at_root = bool(self._zeros)
            now = self.code.holds(self._truths)
            self._holds = [one.rule.initial and holds for one, holds in zip(self.code.events, now, strict=True)]
            self._trigger(t, y)
            if not executes:
                self.queue = [one for one in self.queue if one.time > t + _near(t)]
            return self._settled(t, y, {})

    @property
    def _due(self) -> float:
        """Time of the next execution of an event that waits; infinite if none does."""
        return min((one.time for one in self.queue), default=np.inf)

    @property
    def is_differentiable(self) -> bool:
        """False with fast reactions, which change the state after each event: sensitivities do not follow them."""
        return not self.equations.has_fast

    def derivatives(self, of: Derive, start: Array) -> MachineDerivatives:
        """Return the derivatives of the actions of a run whose S begins as `start`, (k, n): one object for all the
        `Roots` of a run."""
        known = self._derivatives
        if known is None or known[0] is not start:
            known = self._derivatives = start, MachineDerivatives(self, of, start)
        return known[1]

    def state(self) -> dict[str, Any]:
        """Return what the machine remembers of its run, as JSON can hold it."""
        known: dict[str, list[Any]] = {"signs": self._signs, "truths": self._truths, "holds": self._holds}
        copies = {name: [*one] for name, one in known.items()} | {"zeros": sorted(self._zeros)}
        return copies | {"executed": self.executed, "queue": [one.state() for one in self.queue]}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue the run of this state."""
        count, events = len(self.code.comparisons), len(self.code.events)
        signs, truths, holds, zeros = (list(state[name]) for name in ("signs", "truths", "holds", "zeros"))
        queue = [Waiting.of_state(one) for one in state["queue"]]
        known = {*signs} <= {-1, 0, 1} and {*truths, *holds} <= {False, True} and {*zeros} <= {*range(count)}
        fits = (len(signs), len(truths), len(holds)) == (count, count, events)
        if not (known and fits and all(0 <= one.event < events for one in queue)):
            raise ValueError("what events remember does not fit the model")
        self._signs, self._truths, self._holds, self._zeros, self.queue = signs, truths, holds, {*zeros}, queue
        self.executed = int(state["executed"])

    def functions(self, compiled: Any) -> list[Roots]:
        """Return the root functions: the differences of all comparisons, and how long an execution has been due."""
        found: list[Roots] = [_Due(self)] if self.code.has_delays else []
        if count := len(self.code.comparisons):
            found.insert(0, _Comparisons(self, compiled, count))
        return found

    def due(self, t: float, y: Array, *args: Any) -> list[float]:
        """Return how long the next execution has been due."""
        return [t - self._due if self.queue else -1.0]

    def on_due(self, t: float, y: Array, which: Any, directions: Any, *args: Any) -> Array:
        """Return the state after the events that are due."""
        self.taken.clear()
        return y if self._due > t + _near(t) else self._after(t, y, {})

    def on_roots(self, t: float, y: Array, which: Any, directions: Any, *args: Any) -> Array:
        """Return the state after the events that comparisons trigger, or that are due."""
        self.taken.clear()
        signs = self._signs
        pairs = zip(which.tolist(), directions.tolist(), strict=True)
        hit = {i: s for i, s in pairs if signs[i] != s}  # others have their signs from an assignment
        return self._after(t, y, hit) if hit else y

    def _after(self, t: float, y: Array, hit: dict[int, int]) -> Array:
        """Return the state after the events that comparisons with these new signs trigger, and those that are due."""
        self.first_due = min(self.queue, key=lambda one: one.time, default=None)
        with np.errstate(all="ignore"):
            if self._zeros:  # comparisons that have left zero
                now = self._signs_at(t, y)
                self._change({i: now[i] for i in self._zeros if i not in hit})
            self._change(dict.fromkeys(hit, 0))
            self._trigger(t, y)
            self._change(hit)
            self._trigger(t, y)
            executed = self.executed
            after = self._settled(t, y, hit)
        if self.executed > executed and self._after_events is not None:
            self._after_events.append((t, after))
        return after

    def _signs_at(self, t: float, y: Array) -> list[int]:
        return [_sign(d) for d in self.code.roots.code(t, y, self.p)]

    def _change(self, signs: dict[int, int]) -> None:
        """Give some comparisons other signs."""
        for i, s in signs.items():
            if s != self._signs[i] or s == 0 or i in self._zeros:
                self._signs[i] = s
                self._truths[i] = _HOLDS[self.code.comparisons[i].relation](s)
                (self._zeros.discard if s else self._zeros.add)(i)

    def _trigger(self, t: float, y: Array) -> None:
        """Compare triggers with their values before: rising ones wait for execution, falling ones may be withdrawn."""
        now = self.code.holds(self._truths)
        if now == self._holds:
            return
        before, self._holds = self._holds, now
        for i, (was, holds) in enumerate(zip(before, now, strict=True)):
            one = self.code.events[i]
            if holds and not was:
                delay = 0.0 if one.delay is None else float(one.delay.code(t, y, self.p)[0])
                values = one.values.code(t, y, self.p) if one.rule.at_trigger else None
                self.queue.append(Waiting(t + delay, i, values, (t, y)))
                self.taken.append(_Taken(self.queue[-1], y))
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
            before = self.code.roots.code(t, y, self.p) if after is None else after
            y = self._executed(t, y, chosen)
            after = self.code.roots.code(t, y, self.p)
            hit = {i: s for i, s in hit.items() if before[i] == after[i]}  # others are no longer at their roots
            self._change({i: hit.get(i, _sign(d)) for i, d in enumerate(after)})
            self._trigger(t, y)
        raise ValueError(f"more than {_MOST_AT_ONCE} events at t = {t:.17g}: they trigger each other without end")

    def _leave(self, t: float, y: Array, hit: dict[int, int]) -> bool:
        """Change comparisons that are exactly at zero to the signs that they take next; return whether any changed."""
        slopes = self.code.slopes.code(t, y, self.p)
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
            of = self.code.events[one.event].priority
            value = -np.inf if of is None else float(of.code(t, y, self.p)[0])
            return -np.inf if np.isnan(value) else value

        random.Random(f"{self._seed} {self.executed}").shuffle(due)
        return max(due, key=priority)

    def _executed(self, t: float, y: Array, chosen: Waiting) -> Array:
        """Return the state after the assignments: a concentration becomes an amount with the volume before."""
        one = self.code.events[chosen.event]
        values = one.values.code(t, y, self.p) if chosen.values is None else chosen.values
        after = np.array(y)
        for place, value, volume in zip(one.places, values, one.volumes.code(t, y, self.p), strict=True):
            after[place] = value * volume
        self.executed += 1
        after = self.equations.consistent(t, after, self.p)
        self.taken.append(_Taken(chosen, y, after))
        return after


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives


class _OfMachine(Roots):
    """Root functions of a machine.

    - `compiled`: what the class takes besides the machine
    """

    def __init__(self, machine: Machine, *compiled: Any, **roots: Any) -> None:
        super().__init__(**roots)
        self._machine, self._compiled = machine, compiled

    @property
    def is_differentiable(self) -> bool:
        return self._machine.is_differentiable

    def remembered(self) -> Any:
        """See `Roots.remembered`."""
        return [*self._machine.taken], self._machine.first_due

    def of_run(self, t: float, y: Array, args: tuple[Any, ...], memory: dict[int, Any]) -> Roots:
        """See `Roots.of_run`: one machine for the run."""
        machine = self._machine
        if id(machine) not in memory:
            p = np.array(args[0] if args else (), dtype=float)
            memory[id(machine)] = machine.of_run(t, np.array(y, dtype=float), p)
        return type(self)(memory[id(machine)], *self._compiled)

    def state(self) -> Any:
        """See `Roots.state`."""
        return self._machine.state()

    def restore(self, state: Any) -> None:
        """See `Roots.restore`."""
        self._machine.restore(state)

    def recall(self, which: Array, directions: Array, remembered: Any) -> None:
        """See `Roots.recall`."""
        taken, self._machine.first_due = remembered
        self._machine.taken = [*taken]


class _Comparisons(_OfMachine):
    """The comparisons of all triggers."""

    def __init__(self, machine: Machine, compiled: Any, count: int) -> None:
        about = {"fun": compiled, "count": count, "on_roots": machine.on_roots, "names": machine.code.names}
        super().__init__(machine, compiled, count, **about)

    def derivatives(self, of: Derive, start: Array) -> OfRoots:
        """See `Roots.derivatives`."""
        fun = of(self.fun, "the triggers", m=self.count, moves_t=True)
        return OfRoots(fun, self._machine.derivatives(of, start))


class _Due(_OfMachine):
    """The time since the next execution of a delayed event was due."""

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine, fun=machine.due, count=1, on_roots=machine.on_due, names=["execution"])

    def derivatives(self, of: Derive, start: Array) -> OfRoots:
        """See `Roots.derivatives`."""
        made = self._machine.derivatives(of, start)
        return _OfDue(made.due, made)


class _OfDue(OfRoots):
    """Derivatives of the times at which executions are due, and of these."""

    def times(self, t: float, y: Array, f: Array, number: int, dy: Array, dp: Array) -> Array:
        """Return the derivatives of the time of the execution, which wait with it, (c,)."""
        assert isinstance(self.action, MachineDerivatives)
        return self.action.of_first_due()


class MachineDerivatives:
    """The derivatives of the latest action of a machine, with all its triggers and executions.

    An execution takes place at the time of its trigger plus a delay, which may depend on the state and on parameters;
    values at the time of the trigger may too. Their derivatives wait with the event.
    """

    def __init__(self, machine: Machine, of: Derive, start: Array) -> None:
        self._machine, self._of, self._start, self.k = machine, of, start, len(start)
        self._made: dict[tuple[int, str], Derivative] = {}
        #: The derivatives of the times of executions by these times, (k,).
        self.times: dict[float, Array] = {}
        self.due = _DueAlong(self)

    def _part(self, event: int, name: str) -> Derivative:
        key = event, name
        if key not in self._made:
            part: _EventPiece = getattr(self._machine.code.events[event], name)
            self._made[key] = part.derivatives(self._of, f"{name} of {self._machine.code.events[event].rule.name}")
        return self._made[key]

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives of the state after the action, (k, n), in the directions of the k parameters."""
        moved = dy
        for one in self._machine.taken:
            if one.after is None:
                one.waiting.slopes = self._triggered(one.waiting, t, one.before, dt, moved, dp)
            else:
                moved = self._executed(one, t, dt, moved, dp)
        return moved

    def value(self, t: float, y: Array) -> Array:
        """Return the state after the action, (n,)."""
        after = [one.after for one in self._machine.taken if one.after is not None]
        return after[-1] if after else y

    def waits(self) -> tuple[list[Any], list[Any]]:
        """Return the events that the latest action has triggered, and those triggered before that it has executed."""
        made = [one.waiting for one in self._machine.taken if one.after is None]
        used = [one.waiting for one in self._machine.taken if one.after is not None]
        return made, [one for one in used if one not in made]

    def width(self, waiting: Waiting) -> int:
        """Return how many numbers wait: the time of the execution, and perhaps values."""
        return 1 if waiting.values is None else 1 + len(waiting.values)

    def give(self, waiting: Waiting, columns: Array | None) -> None:
        """See `AlongAction`: the derivatives of the time and of the values of an event that waits."""
        waiting.slopes = None if columns is None else (columns[:, 0], columns[:, 1:])

    def of_waiting(self, waiting: Waiting) -> Array:
        """Return the derivatives of the time and of the values of an event that waits, (c, w)."""
        return np.column_stack(self.slopes(waiting))

    def _triggered(self, waiting: Waiting, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> tuple[Array, Array]:
        """Return the derivatives of the time of the execution, (k,), and of the values, (k, m)."""
        i, code = waiting.event, self._machine.code.events[waiting.event]
        time = dt if code.delay is None else dt + self._part(i, "delay").columns(t, y, dt, dy, dp)[:, 0]
        none = np.zeros((len(dt), 0))
        return time, none if waiting.values is None else self._part(i, "values").columns(t, y, dt, dy, dp)

    def slopes(self, waiting: Waiting) -> tuple[Array, Array]:
        """Return the derivatives of an event that waits. If it was triggered at the start, they follow from S there."""
        if waiting.slopes is None:
            t, y = waiting.trigger
            waiting.slopes = self._triggered(waiting, t, y, np.zeros(self.k), self._start, np.eye(self.k))
        return waiting.slopes

    def _executed(self, one: _Taken, t: float, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives of the state after the assignments, (k, n)."""
        i, y, waiting = one.waiting.event, one.before, one.waiting
        code = self._machine.code.events[i]
        if waiting.values is None:
            values = np.array(code.values.code(t, y, self._machine.p))
            slopes = self._part(i, "values").columns(t, y, dt, dy, dp)
        else:
            values, slopes = np.array(waiting.values), self.slopes(waiting)[1]
        volumes = np.array(code.volumes.code(t, y, self._machine.p))
        moved = dy.copy()
        moved[:, code.places] = slopes * volumes + values * self._part(i, "volumes").columns(t, y, dt, dy, dp)
        assert one.after is not None
        return self._consistent(t, one.after, dt, moved, dp)

    def _consistent(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives `dy`, (k, n), with the entries that follow from algebraic rules."""
        equations = self._machine.equations
        if not equations.matched:
            return dy
        places = [equations.place[name] for name in equations.matched]
        if (-1, "rules") not in self._made:
            self._made[-1, "rules"] = _EventPiece(equations.rules).derivatives(self._of, "algebraic rules")
        rules, moved = self._made[-1, "rules"], dy.copy()
        moved[:, places] = 0
        off = rules.columns(t, y, dt, moved, dp)
        moved[:, places] = -np.linalg.lstsq(rules.jacobian(t, y)[:, places], off.T, rcond=None)[0].T
        return moved

    def of_first_due(self) -> Array:
        """Return the derivatives of the time of the execution that was due first when the latest action began."""
        first = self._machine.first_due
        assert first is not None
        return self.slopes(first)[0]

    def time_of(self, t: float) -> Array:
        """Return the derivatives of the time of the execution that is due at t, or next, (k,)."""
        machine = self._machine
        first = machine.first_due
        if first is not None and abs(first.time - t) <= 2 * _near(t):
            self.times[t] = self.slopes(first)[0]
        if t in self.times:
            return self.times[t]
        first = min(machine.queue, key=lambda one: one.time, default=None)
        return np.zeros(self.k) if first is None else self.slopes(first)[0]


class _DueAlong:
    """The derivatives of t - due, where `due` is the time of the execution at t, or else of the next one."""

    def __init__(self, all: MachineDerivatives) -> None:
        self._all, self.k = all, all.k

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives along directions, (c, 1)."""
        found: Array = dt - dp @ self._all.time_of(t)
        return found[:, None]

    def value(self, t: float, y: Array) -> Array:
        """Return the value, (1,): 0 at an execution."""
        return np.zeros(1) if t in self._all.times else np.ones(1)


def _near(t: float) -> float:
    return SAME_TIME * max(1.0, abs(t))


def _sign(d: float) -> int:
    """Return the sign of a number: -1, 0 or 1; 0 for NaN."""
    return 1 if d > 0 else -1 if d < 0 else 0


def is_clock(difference: Node) -> bool:
    """Return whether a difference depends on t and on no state."""
    return not used([difference], "y") and any(one.op == "t" for one in in_order([difference]))


def times_of_roots(differences: Sequence[Node], p: Array) -> list[float]:
    """Return the times at which comparisons, of t alone, change that are affine in t."""
    found = set()
    for one in differences:
        a, b, c = (ArrayFunction([one]).at(t, np.zeros(0), p)[0] for t in (0.0, 1.0, 3.5))
        slope = b - a
        if slope and abs(a + 3.5 * slope - c) <= 1e-12 * (abs(a) + abs(c)):
            found.add(float(-a / slope))
    return sorted(found)
