"""Landings: the times at which a graph changes its branch as a function of t alone, where the steps of a run end.

A condition of t changes where a continuous function e(t) passes a level: a − b passes 0 in a < b, x passes integers in
⌊x⌋, and the breaks of a table. Between the changes of the conditions that e itself contains it is smooth. Along t it is
one of

* a straight line, s t + b: every change follows from s and b;
* s t + π(t), where π has the period P, as t % 24 and sin(t / 3) have: the changes in one period, found in 64 samples
  between two inner ones, are the first times of progressions, which the core continues for ever;
* anything else: the changes are found in samples of the interval. Two changes between neighbouring samples are missed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from ..._base.arguments import Array
from .array_code import ArrayFunction
from .differentiation import jacobian
from .nodes import Node, in_order
from .python import Formula

#: A condition that changes more often than this between t0 and tf is left out, with a warning.
MOST_LANDINGS = 1_000_000
#: Samples between two inner changes of a period; in all of an interval, and at least between two inner changes there.
_IN_PERIOD, _IN_INTERVAL, _AT_LEAST = 64, 4096, 8
#: More inner changes than this are not searched between.
_MOST_INNER = 50_000
#: Part of a period before t0 at which the search begins, so that what begins at t0 is inside; and how far the search
#: goes into the next one, so that nothing is lost at its ends.
_BEFORE, _OVERLAP = 0.3819660112501052, 1e-6
#: Relative to their parts, sums of slopes that are roundoff; and numbers of periods that are integers.
_ROUNDOFF = 1e-12
#: Roundoff of a time that a straight line leads to, in ulp; the margin of the core at a landing is twice that.
_ULPS = 4
#: Conditions of more operations than this are not written out in messages.
_LEGIBLE = 12
_SIDES: tuple[Literal["left", "right"], ...] = ("left", "right")
#: Times that are so many ulp apart are one: no step of the core fits between.
_SAME = 16
#: Around 0, where doubles are dense, less than this is no time.
_LEAST = 1e-300
#: States of functions of t alone.
_NO_STATE = np.zeros(0)
#: Bisection of an interval of doubles ends after so many halvings.
_HALVINGS = 1100


class Crossing(NamedTuple):
    """Condition of t at which a branch changes."""

    node: Node  # the operation of the graph
    #: a continuous function of t but for changes of other conditions; where it passes a level the branch changes
    moving: Node
    state: Node  # truth or number of the branch, which is constant between the changes
    #: Levels of `moving` at which the state rises from k to k + 1: 0 for a truth; breaks of a table; None: k + 1
    levels: tuple[float, ...] | None
    inner: frozenset[Node]  # the operations inside `moving` that have branches


class Source(NamedTuple):
    """The changes of one condition: single times in increasing order, and progressions first + k period."""

    crossing: Crossing
    times: Array
    first: Array
    period: float

    def about(self, length: float) -> float:
        """Return approximately how many changes there are in an interval of this length."""
        return len(self.times) + (len(self.first) * length / self.period if self.period else 0.0)

    def between(self, low: float, high: float) -> Array:
        """Return the times from low to high at which this source changes."""
        single = self.times[(low <= self.times) & (self.times <= high)]
        if not len(self.first):
            return single
        k = np.arange(math.floor((low - self.first.max()) / self.period), (high - self.first.min()) // self.period + 2)
        found = (self.first[:, None] + k * self.period).ravel()
        return np.sort(np.concatenate([single, found[(low <= found) & (found <= high)]]))


@dataclass(frozen=True)
class Landings:
    """The times at which a graph changes its branch as a function of t alone."""

    sources: list[Source]  # by conditions
    #: Operations whose changes are not known, each with the reason in words; "": it contains another one of them
    left_out: dict[Node, str]

    def __bool__(self) -> bool:
        return bool(self.sources)

    def for_core(self) -> tuple[list[float], list[float], list[float]]:
        """Single times, and the first times and the periods of progressions."""
        single = np.unique(np.concatenate([np.zeros(0), *(one.times for one in self.sources)]))
        progressions = sorted({(first, one.period) for one in self.sources for first in one.first.tolist()})
        return single.tolist(), [first for first, _ in progressions], [period for _, period in progressions]

    def between(self, low: float, high: float) -> Array:
        """Return the times from low to high at which any source changes."""
        return np.unique(np.concatenate([np.zeros(0), *(one.between(low, high) for one in self.sources)]))

    def apart(self, low: float, high: float, known: Array) -> Array:
        """Return the times of change from low to high, without those that only roundoff separates from the one before
        or from the `known` times."""
        found, last = [], -math.inf
        for t in self.between(low, high).tolist():
            near = _SAME * np.spacing(abs(t))
            if t - last > near and not (np.abs(known - t) <= near).any():
                found.append(t)
                last = t
        return np.array(found)

    def parameters(self) -> set[int]:
        """The parameters on which their times may depend."""
        nodes = in_order([one.crossing.moving for one in self.sources])
        return {node.value for node in nodes if node.op == "p"}

    def at(self, t: float) -> list[Crossing]:
        """The conditions that change at a landing."""
        near = _SAME * np.spacing(abs(t))
        return [one.crossing for one in self.sources if len(one.between(t - near, t + near))]


def rates_of_time(crossing: Crossing, places: Sequence[int | None]) -> Callable[[float, Array], Array]:
    """∂τ/∂p = −e_p / e_t of the time at which a condition changes, for the parameters in these places, as a function of
    (t, p); None: a parameter of which the graph does not know."""
    graph = crossing.moving.graph
    variables = [graph.t, *(graph.p(place) for place in places if place is not None)]
    row = jacobian([crossing.moving], variables)[0]
    formula = Formula("rates", lambda: [row.get(i, graph.node(0.0)) for i in range(len(variables))], (len(variables),))

    def rates(t: float, p: Array) -> Array:
        of_t, *of_p = formula(t, [], p)
        given = iter(of_p)
        return np.array([0.0 if place is None else -next(given) / of_t for place in places])

    return rates


def timed(outputs: Sequence[Node], ignored: Iterable[Node] = ()) -> list[Crossing]:
    """The conditions in a graph that depend on t and not on y, each after those that it contains. Those of `ignored`
    nodes are left out."""
    left_out = set(ignored)
    with_t: set[Node] = set()
    with_y: set[Node] = set()
    inside: dict[Node, frozenset[Node]] = {}
    found = []
    none: frozenset[Node] = frozenset()
    for node in in_order(outputs):
        arguments = node.arguments
        if node.op == "y" or not with_y.isdisjoint(arguments):
            with_y.add(node)
        if node.op == "t" or not with_t.isdisjoint(arguments):
            with_t.add(node)
        if node not in with_t:
            continue
        inner = none.union(*(inside.get(one, none) for one in arguments))
        inside[node] = inner
        if node in with_y:  # of which a part may depend on t alone
            continue
        if (made := _crossing(node, inner)) is not None:
            inside[node] = inner | {node}
            if node not in left_out:
                found.append(made)
    return found


def _crossing(node: Node, inner: frozenset[Node]) -> Crossing | None:
    graph, a = node.graph, node.arguments[0] if node.arguments else node
    if node.op in ("less", "less_equal"):
        return Crossing(node, a - node.arguments[1], node, (0.0,), inner)
    if node.op in ("minimum", "maximum"):
        return Crossing(node, a - node.arguments[1], graph.make("less", a, node.arguments[1]), (0.0,), inner)
    if node.op in ("sign", "abs"):
        return Crossing(node, a, graph.make("less", a, graph.node(0.0)), (0.0,), inner)
    if node.op in ("floor", "ceil"):
        return Crossing(node, a, node, None, inner)
    if node.op == "modulo":
        x = a / node.arguments[1]
        return Crossing(node, x, graph.make("floor", x), None, inner)
    if node.op == "piece":
        return Crossing(node, a, node, node.value, inner)
    return None


# ----------------------------------------------------------------------------------------------------------------------
# Functions of t, for many times at once


class _OverTime:
    """Values of nodes at many times, for fixed parameters."""

    def __init__(self, p: Array) -> None:
        self._p = p
        self._functions: dict[Node, ArrayFunction] = {}

    def __call__(self, node: Node, t: Array) -> Array:
        """Return the values of a node at times t, (m,), as numbers also where the node is a truth value.

        Raises NotImplementedError: An operation that is no function of arrays, such as the solution of a linear system.
        """
        if node not in self._functions:
            self._functions[node] = ArrayFunction([node])
        (found,) = self._functions[node].over(t, _NO_STATE, self._p)
        return np.asarray(found)


class _Periodic(NamedTuple):
    """A function s t + π(t), where π has the period; 0: it is a constant."""

    slope: float
    period: float

    @property
    def is_line(self) -> bool:
        return self.period == 0


#: What a straight line stays straight in, between the changes of branches.
_LINEAR = {"add", "subtract", "negate", "number", "t", "p", "floor", "ceil", "modulo", "abs", "minimum", "maximum"}
_LINEAR |= {"sign", "piece", "pick", "select", "less", "less_equal", "and", "or", "not"}


class _Classifier:
    """Classifier of the functions of t that are lines, or periodic."""

    def __init__(self, values: _OverTime) -> None:
        self._values = values
        self._known: dict[Node, _Periodic | None] = {}
        self._straight: dict[Node, bool] = {}

    def of(self, node: Node) -> _Periodic | None:
        """The form of a function of t; None: another one."""
        for one in in_order([node]):
            if one not in self._known:
                self._known[one] = self._found(one, [self._known[argument] for argument in one.arguments])
        return self._known[node]

    def is_straight(self, node: Node) -> bool:
        """Return whether a function of t is a straight line between the changes of branches."""
        for one in in_order([node]):
            if one not in self._straight:
                straight = one.op in _LINEAR or self._is_constant(one) or self._is_multiple(one)
                self._straight[one] = straight and all(self._straight[argument] for argument in one.arguments)
        return self._straight[node]

    def _is_constant(self, node: Node) -> bool:
        return self.of(node) == _Periodic(0.0, 0.0)

    def _is_multiple(self, node: Node) -> bool:
        if node.op == "divide":
            return self._is_constant(node.arguments[1])
        return node.op == "multiply" and any(map(self._is_constant, node.arguments))

    def _number(self, node: Node) -> float:
        return float(self._values(node, np.zeros(1))[0])

    def _found(self, node: Node, given: list[_Periodic | None]) -> _Periodic | None:
        op = node.op
        if op == "t":
            return _Periodic(1.0, 0.0)
        if any(one is None for one in given):
            return None
        forms = [one for one in given if one is not None]
        period = _common(one.period for one in forms)
        if period is None:
            return None
        if all(one.slope == 0 for one in forms):
            return _Periodic(0.0, period)
        if op in ("add", "subtract", "negate"):
            slopes = [one.slope for one in forms]
            total = -slopes[0] if op == "negate" else slopes[0] + (slopes[1] if op == "add" else -slopes[1])
            return _Periodic(0.0 if abs(total) <= _ROUNDOFF * max(map(abs, slopes)) else total, period)
        if op in ("multiply", "divide"):
            return self._scaled(node, forms)
        if op in ("floor", "ceil", "modulo", "sin", "cos", "tan"):
            return self._repeated(node, forms)
        return None

    def _scaled(self, node: Node, forms: list[_Periodic]) -> _Periodic | None:
        a, b = node.arguments
        if forms[1] == _Periodic(0.0, 0.0):
            by, of = self._number(b), forms[0]
        elif node.op == "multiply" and forms[0] == _Periodic(0.0, 0.0):
            by, of = self._number(a), forms[1]
        else:
            return None
        slope = of.slope / by if node.op == "divide" and by else of.slope * by
        return _Periodic(slope, of.period) if math.isfinite(slope) else None

    def _repeated(self, node: Node, forms: list[_Periodic]) -> _Periodic | None:
        """Return the form of a function that repeats, or grows by as much, when its argument has grown by `unit`; None:
        unknown."""
        unit = 1.0 if node.op in ("floor", "ceil") else 2 * math.pi
        if node.op == "modulo":
            if forms[1] != _Periodic(0.0, 0.0):
                return None
            unit = abs(self._number(node.arguments[1]))
        x = forms[0]
        if x.slope == 0 or not unit > 0:
            return None
        period = unit / abs(x.slope) if x.is_line else x.period
        turns = x.slope * period / unit
        if abs(turns - round(turns)) > _ROUNDOFF * max(abs(turns), 1):
            return None
        return _Periodic(x.slope if node.op in ("floor", "ceil") else 0.0, period)


def _common(periods: Iterable[float]) -> float | None:
    """The period of functions together, if the longest one is a multiple of all."""
    found = sorted({*periods} - {0.0})
    if not found:
        return 0.0
    turns = [found[-1] / one for one in found]
    return found[-1] if all(abs(one - round(one)) <= _ROUNDOFF * one for one in turns) else None


# ----------------------------------------------------------------------------------------------------------------------
# When conditions change


class _UnknownError(Exception):
    """Reason why the changes of a condition are not known."""


def landings(crossings: Sequence[Crossing], p: Array, t0: float, tf: float) -> Landings:
    """Find the times from t0 to tf at which conditions of t change, for these values of the parameters.

    - `crossings`: from `timed`
    - `p`, (k,): the parameters
    - `t0`, `tf`: the interval; tf may be infinite
    """
    return _landings(tuple(crossings), np.asarray(p, dtype=float).tobytes(), t0, tf)


@lru_cache(maxsize=64)
def _landings(crossings: tuple[Crossing, ...], p: bytes, t0: float, tf: float) -> Landings:
    values = _OverTime(np.frombuffer(p))
    search = _ChangeSearch(values, _Classifier(values), min(t0, tf), max(t0, tf))
    known: dict[Node, Source] = {}
    left_out: dict[Node, str] = {}
    for one in crossings:
        if not one.inner.isdisjoint(left_out):
            left_out[one.node] = ""
            continue
        try:
            known[one.node] = search.of(one, [known[node] for node in one.inner if node in known])
        except _UnknownError as why:
            left_out[one.node] = f"{_in_words(one.node)} {why}"
    return Landings([one for one in known.values() if len(one.times) or len(one.first)], left_out)


def _in_words(node: Node) -> str:
    return repr(node) if len([*in_order([node])]) <= _LEGIBLE else f"a condition ({node.op})"


@dataclass
class _ChangeSearch:
    """The changes of conditions between two times."""

    _values: _OverTime
    _forms: _Classifier
    low: float
    high: float

    def of(self, crossing: Crossing, inner: Sequence[Source]) -> Source:
        """Return the source of the changes of one crossing: single times, or progressions with a period.

        Raises _UnknownError: They are too many, or cannot be found.
        """
        try:
            form = self._forms.of(crossing.moving)
            straight = self._forms.is_straight(crossing.moving)
        except NotImplementedError:
            raise _UnknownError("solves a linear system") from None
        none = np.zeros(0)
        if form == _Periodic(0.0, 0.0):
            return Source(crossing, none, none, 0.0)
        if form is not None and form.is_line and crossing.levels is not None:
            return Source(crossing, self._of_line(crossing, form.slope), none, 0.0)
        period = self._period(crossing, form)
        if period:
            return self._of_periods(crossing, inner, period, straight)
        return Source(crossing, self._of_interval(crossing, inner, straight), none, 0.0)

    def _period(self, crossing: Crossing, form: _Periodic | None) -> float:
        """The time after which a condition changes again and again alike; 0: it does not."""
        if form is None or (form.slope and crossing.levels is not None):
            return 0.0
        if form.slope == 0:
            return form.period
        again = self._forms.of(crossing.node)  # of a floor or a remainder
        return 0.0 if again is None else again.period

    def _of_line(self, crossing: Crossing, slope: float) -> Array:
        """Return the times at which a straight line passes the levels."""
        start = self.low if math.isfinite(self.low) else self.high
        levels = np.unique(np.asarray(crossing.levels))
        value = float(self._values(crossing.moving, np.array([start]))[0])
        guess = start + (levels - value) / slope
        near = np.maximum(1e-9 * (np.abs(guess) + abs(start) + np.abs(levels / slope)), _LEAST)
        inside = (guess + near >= self.low) & (guess - near <= self.high)
        guess, near = guess[inside], near[inside]
        if len(guess) > MOST_LANDINGS:
            raise _UnknownError(f"changes {len(guess)} times, more than {MOST_LANDINGS}")
        if crossing.node.op == "piece":
            first, second = (np.searchsorted(crossing.node.value, levels[inside], side=side) for side in _SIDES)
            first, second = (first, second) if slope > 0 else (second, first)
        else:
            first, second = (self._state(crossing, one) for one in (guess - near, guess + near))
        changes = first != second
        low, high = (guess - near)[changes], (guess + near)[changes]
        return self._inside(self._located(crossing, low, high, first[changes], second[changes]))

    def _of_periods(self, crossing: Crossing, inner: Sequence[Source], period: float, straight: bool) -> Source:
        count = (self.high - self.low) / period
        if math.isfinite(count) and count > MOST_LANDINGS:
            raise _UnknownError(f"changes about {count:.3g} times between t0 and tf, more than {MOST_LANDINGS}")
        start = (self.low if math.isfinite(self.low) else self.high) - _BEFORE * period
        found = np.sort(self._within(crossing, inner, start, start + (1 + _OVERLAP) * period, straight, _IN_PERIOD))
        twice = found[:, None] - found - period
        repeated = (np.abs(twice) <= 4 * _OVERLAP * period).any(axis=1)
        return Source(crossing, np.zeros(0), found[~repeated], period)

    def _of_interval(self, crossing: Crossing, inner: Sequence[Source], straight: bool) -> Array:
        if not math.isfinite(self.high - self.low):
            raise _UnknownError("is neither a straight line nor periodic in t, and the interval is infinite")
        before = self.low - _SAME * np.spacing(max(abs(self.low), abs(self.high)))  # the start may be a change too
        found = self._within(crossing, inner, before, self.high, straight, _IN_INTERVAL)
        return self._inside(np.maximum(found, self.low))

    def _inside(self, times: Array) -> Array:
        return np.unique(times[(self.low <= times) & (times <= self.high)])

    def _within(
        self, crossing: Crossing, inner: Sequence[Source], start: float, stop: float, straight: bool, samples: int
    ) -> Array:
        """The changes between two times: in each part between inner changes, between samples of it."""
        count = sum(one.about(stop - start) for one in inner)
        if count > _MOST_INNER:
            raise _UnknownError(f"contains conditions that change {count:.3g} times, more than {_MOST_INNER}")
        ends = np.unique(np.concatenate([[start, stop], *(one.between(start, stop) for one in inner)]))
        begins, ends = ends[:-1], ends[1:]
        gap = 2 * _ULPS * np.spacing(np.maximum(np.abs(begins), np.abs(ends)))
        wide = ends - begins > 8 * gap
        begins, ends = (begins + gap)[wide], (ends - gap)[wide]
        if not len(begins):
            return np.zeros(0)
        spread = samples // len(begins) if samples == _IN_INTERVAL else samples
        each = 2 if straight else max(spread, _AT_LEAST)
        at: Array = begins[:, None] + (ends - begins)[:, None] * np.linspace(0, 1, each)
        at[:, -1] = ends
        states = self._state(crossing, at)
        before, steps = states[:, :-1].ravel(), np.diff(states).ravel()
        changes = np.flatnonzero((steps != 0) & np.isfinite(steps))
        times = np.abs(steps[changes]).astype(int)
        if times.sum() > _MOST_INNER:
            raise _UnknownError(f"changes {times.sum()} times between t0 and tf, more than {_MOST_INNER}")
        each_one = np.repeat(changes, times)
        passed = np.arange(len(each_one)) - np.repeat(np.cumsum(times) - times, times)
        sign = np.sign(steps[each_one])
        first = before[each_one] + sign * passed
        low, high = (ends.ravel()[each_one] for ends in (at[:, :-1], at[:, 1:]))
        return self._located(crossing, low, high, first, first + sign)

    def _state(self, crossing: Crossing, t: Array) -> Array:
        found: Array = self._values(crossing.state, t.ravel()).reshape(t.shape)
        return found

    def _located(self, crossing: Crossing, low: Array, high: Array, first: Array, second: Array) -> Array:
        """The doubles at which the state goes from the first one to the second, or beyond it, between low and high: the
        first double after the change, or the last one before it if `moving` is at the level there."""
        upper, rising = np.maximum(first, second), second > first
        level = upper if crossing.levels is None else np.asarray(crossing.levels)[np.maximum(upper, 1).astype(int) - 1]
        level = np.where(crossing.node.op == "ceil", upper - 1, level)

        def changed(t: Array) -> Array:
            """Return whether the state at t is the one after the change."""
            return np.equal(self._state(crossing, t) >= upper, rising)

        a, b = low.copy(), high.copy()
        e_a, e_b = (self._values(crossing.moving, one) - level for one in (a, b))
        with np.errstate(all="ignore"):
            guess = a - e_a * (b - a) / (e_b - e_a)
        guess = np.where(np.isfinite(guess), np.clip(guess, a, b), 0.5 * (a + b))
        guess[np.abs(guess) <= _ROUNDOFF * np.maximum(np.abs(a), np.abs(b))] = 0.0  # where the next double is no guide
        near = np.maximum(_ULPS * np.spacing(np.abs(guess)), _LEAST)
        left, right = np.maximum(guess - near, a), np.minimum(guess + near, b)
        close = ~changed(left) & changed(right)
        exact = close & (self._values(crossing.moving, guess) == level)
        a, b = np.where(close, left, a), np.where(close, right, b)
        a, b = np.where(exact, guess, a), np.where(exact, guess, b)
        for _ in range(_HALVINGS):
            middle = a + 0.5 * (b - a)
            going = (a < middle) & (middle < b)
            if not going.any():
                break
            there = changed(middle)
            b, a = np.where(going & there, middle, b), np.where(going & ~there, middle, a)
        return np.asarray(np.where(self._values(crossing.moving, a) == level, a, b))
