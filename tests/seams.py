"""Small problems in which capabilities meet, with their exact solutions, and a covering array of such meetings.

A problem is linear between landings. In the time s = |t| of the run

    a' = -k a + u(s),    b' = -a',    z' = -r (z = 0 is a bound, or not),    0 = d - a - 2 c,

where c = 1 ± (z - 1), u is a polynomial on each piece, and a + b and z + r s are conserved. On a piece
a(s) = A exp(-k s) + P(s) with a polynomial P, so that times of events are roots of elementary functions. Derivatives
with respect to parameters are central differences of these exact solutions, through landings too.
"""

from __future__ import annotations

import functools
import inspect
import itertools
import math
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from scipy.optimize import brentq

import invariode as iv
from cases import FAMILIES, SERIES, hidden
from interrupted import differences

__all__ = [
    "EXCLUDED",
    "FACTORS",
    "allowed",
    "covering_array",
    "met",
    "random_row",
    "triples",
    "wrong_case",
    "wrong_solution",
]

#: The capabilities, and how each takes part.
FACTORS: dict[str, tuple[str, ...]] = {
    "method": (*FAMILIES, *SERIES),
    "events": ("none", "value", "condition", "terminal", "at breakpoint"),
    "actions": ("none", "once", "resets", "dose"),
    "breakpoints": ("none", "inside", "edges"),
    "inputs": ("none", "previous", "linear", "cubic"),
    "bounds": ("none", "idle", "rest"),
    "invariants": ("none", "total", "in time", "demanded"),
    "mass": ("none", "coupled", "in time", "singular"),
    "sensitivities": ("none", "forward", "adjoint"),
    "f": ("python", "hidden", "compiled"),
    "output": ("steps", "times", "refined", "dense", "end"),
    "direction": ("forward", "backward"),
    "restart": ("none", "extended", "limit", "file", "checkpoint"),
}

Row = dict[str, str]

_MASSLESS = tuple(name for name in FACTORS["method"] if iv.METHODS[name].mass == "none")

#: Combinations of levels that make no problem, with the reason.
EXCLUDED: list[tuple[dict[str, tuple[str, ...]], str]] = [
    ({"method": _MASSLESS, "mass": ("coupled", "in time", "singular")}, "these methods take no mass matrix"),
    ({"method": ("ode23s",), "mass": ("in time", "singular")}, "ode23s takes constant regular mass matrices only"),
    ({"method": ("taylor",), "f": ("hidden",)}, "a series needs a graph of f"),
    ({"actions": ("dose",), "breakpoints": ("none",)}, "the dose is given at a breakpoint"),
    ({"events": ("at breakpoint",), "breakpoints": ("none",)}, "there is no breakpoint"),
    ({"invariants": ("in time",), "bounds": ("rest",)}, "z + r s is not conserved while z rests on its bound"),
]


def allowed(levels: Row) -> bool:
    """Return True if no exclusion applies to these levels, of all factors or of some."""
    return not any(all(levels.get(name) in those for name, those in rule.items()) for rule, _ in EXCLUDED)


def triples() -> set[tuple[tuple[str, str], ...]]:
    """Every triple of levels of three factors that can be met."""
    made = set()
    for names in itertools.combinations(FACTORS, 3):
        for levels in itertools.product(*(FACTORS[name] for name in names)):
            one = tuple(zip(names, levels, strict=True))
            if allowed(dict(one)):
                made.add(one)
    return made


@functools.cache
def covering_array(seed: int = 44) -> tuple[Row, ...]:
    """Rows that meet each of the `triples`: the next row begins with one that is missing, and each further factor takes
    the level that meets most of those left."""
    random, order = Random(seed), sorted(triples())
    left = np.zeros((len(_PLACES),) * 3, bool)
    for one in order:
        for turned in itertools.permutations(one):
            left[tuple(map(_PLACES.__getitem__, turned))] = True
    random.shuffle(order)
    rows = []
    for begun in order:
        if not left[tuple(map(_PLACES.__getitem__, begun))]:
            continue
        some = [_completed(dict(begun), left, random) for _ in range(4)]
        places = [np.ix_(*[[_PLACES[one] for one in row.items()]] * 3) for row in some]
        best = int(np.argmax([left[one].sum() for one in places]))
        left[places[best]] = False
        rows.append(some[best])
    return tuple(rows)


def _completed(row: Row, left: Any, random: Random) -> Row:
    names = [name for name in FACTORS if name not in row]
    random.shuffle(names)
    for name in names:
        choices = [level for level in FACTORS[name] if allowed({**row, name: level})]
        random.shuffle(choices)
        here = [_PLACES[one] for one in row.items()]
        met_by = left[np.ix_([_PLACES[name, level] for level in choices], here, here)].sum((1, 2))
        row[name] = choices[int(met_by.argmax())]
    return {name: row[name] for name in FACTORS}


#: The place of each level of each factor in an array whose three dimensions stand for the levels of a triple.
_PLACES = {one: i for i, one in enumerate((name, level) for name, levels in FACTORS.items() for level in levels)}


def met(row: Row) -> set[tuple[tuple[str, str], ...]]:
    return set(itertools.combinations(row.items(), 3))


def random_row(random: Random, methods: Sequence[str] = FACTORS["method"]) -> Row:
    """Levels at random, from more methods than one of each family."""
    while True:
        row = {name: random.choice(levels) for name, levels in FACTORS.items()} | {"method": random.choice(methods)}
        about = iv.METHODS[row["method"]]
        if row["mass"] != "none" and (about.mass == "none" or (about.mass == "regular" and row["mass"] != "coupled")):
            continue
        if allowed(row):
            return row


# ----------------------------------------------------------------------------------------------------------------------
# The exact solution

State = tuple[float, float, float]  # a, b, z


@dataclass(frozen=True)
class Watched:
    """An event: the value alpha s + beta a + gamma b + zeta z - level, and what happens there."""

    weights: tuple[float, float, float, float]
    level: float
    direction: int = 0
    terminal: bool = False
    condition: bool = False
    action: tuple[float, float, float] | None = None

    def value(self, s: float, state: State) -> float:
        alpha, beta, gamma, zeta = self.weights
        a, b, z = state
        return alpha * s + beta * a + gamma * b + zeta * z - self.level


@dataclass(frozen=True)
class Piece:
    """a(s) = A exp(-k x) + P(x), z(s) = z0 + slope x with x = s - start, until `end`."""

    start: float
    end: float
    k: float
    A: float
    P: tuple[float, ...]
    total: float
    z0: float
    slope: float

    def at(self, s: float) -> State:
        x = s - self.start
        a = self.A * math.exp(-self.k * x)
        power = 1.0
        for p in self.P:
            a += p * power
            power *= x
        return a, self.total - a, self.z0 + self.slope * x


@dataclass
class Exact:
    """The solution to T, its pieces and the occurrences of events; `end` is that of a terminal event, or T."""

    pieces: list[Piece] = field(default_factory=list)
    events: list[list[tuple[float, State]]] = field(default_factory=list)
    end: float = math.inf
    grazing: bool = False  # a root that a small change would move far or remove
    landings: set[float] = field(default_factory=set)

    def place(self, s: float, *, left: bool = False) -> int:
        """Return the index of the piece that s belongs to."""
        return max(i for i, one in enumerate(self.pieces) if not i or one.start < s or (one.start == s and not left))

    def jumps(self, s: float) -> bool:
        """Return True if the state jumps at s: a run that an event ends there ends after the jump."""
        return math.dist(*(self.pieces[self.place(s, left=left)].at(s) for left in (True, False))) > 1e-9

    def at(self, s: float) -> State:
        return self.pieces[self.place(s)].at(s)


@dataclass(frozen=True)
class Scenario:
    """A problem in numbers."""

    row: Row
    T: float
    B: float  # the breakpoint
    w: float  # the jump of u there
    a0: float
    b0: float
    k: float
    r: float
    q: float
    o: int  # c = 1 + o (z - 1)
    watched: tuple[Watched, ...]
    knots: tuple[float, ...]  # of the input, in s
    values: tuple[float, ...]
    dose: tuple[float, float, float] | None

    @property
    def sign(self) -> int:
        return 1 if self.row["direction"] == "forward" else -1

    def u(self, s: float, middle: float) -> tuple[float, ...]:
        """u as a polynomial in x from s, on the piece that has `middle` inside."""
        q = self.q + (self.w if self.row["breakpoints"] != "none" and middle > self.B else 0.0)
        kind = self.row["inputs"]
        if kind == "none":
            return (q,)
        i = max(j for j, knot in enumerate(self.knots) if knot <= middle)
        if kind == "previous":  # in t: after the middle when the run goes backward
            return (q + self.values[i if self.sign > 0 else i + 1],)
        if kind == "linear":
            slope = (self.values[i + 1] - self.values[i]) / (self.knots[i + 1] - self.knots[i])
            return (q + self.values[i] + slope * (s - self.knots[i]), slope)
        return (q + quadratic(s), 0.1 - 0.06 * s, -0.03)  # its spline reproduces it

    def solution(self) -> Exact:
        exact = Exact(events=[[] for _ in self.watched])
        fixed = {self.T, *(s for s in self.knots if 0 < s < self.T and self.row["inputs"] != "none")}
        if self.row["breakpoints"] != "none":
            fixed.add(self.B)
        s, state = 0.0, (self.a0, self.b0, 1.0)
        exempt: set[int] = set()  # events that are zero where this piece begins
        rests = self.row["bounds"] == "rest"
        while s < self.T:
            end = min(one for one in fixed if one > s)
            slope = 0.0 if rests and state[2] <= 0 else -self.r
            if rests and slope and state[2] - self.r * (end - s) < 0:
                end = s + state[2] / self.r
            piece = self._piece(s, end, state, slope)
            first, which = self._first_root(piece, exempt, exact)
            if which:
                end = first
                piece = self._piece(s, end, state, slope)
            exact.pieces.append(piece)
            exact.landings.add(end)
            state = piece.at(end)
            if rests and state[2] < 1e-12:
                state = (*state[:2], 0.0)
            state = self._jumps(end, state, which, exact)
            # An event is exempt at the zero where it has just occurred, unless the state has jumped.
            exempt = {i for i in which if abs(self.watched[i].value(end, state)) < 1e-9}
            s = end
        return exact

    def _piece(self, s: float, end: float, state: State, slope: float) -> Piece:
        U = self.u(s, (s + end) / 2)
        P = [0.0] * len(U)
        for j in reversed(range(len(U))):
            P[j] = (U[j] - (j + 1) * (P[j + 1] if j + 1 < len(U) else 0.0)) / self.k
        return Piece(s, end, self.k, state[0] - P[0], tuple(P), state[0] + state[1], state[2], slope)

    def _first_root(self, piece: Piece, exempt: set[int], exact: Exact) -> tuple[float, list[int]]:
        first, which = math.inf, []
        grid = [piece.start + (piece.end - piece.start) * j / 16 for j in range(17)]
        states = [piece.at(s) for s in grid]
        for i, one in enumerate(self.watched):
            v = [one.value(s, y) for s, y in zip(grid, states, strict=True)]
            if abs(v[-1]) < 1e-12:
                v[-1] = 0.0
            if i in exempt:
                v[0] = 0.0
            for j in range(16):
                if j and 1e-9 < abs(v[j]) < 4e-3 and v[j - 1] * v[j + 1] > 0:
                    exact.grazing |= abs(v[j]) <= min(abs(v[j - 1]), abs(v[j + 1]))
                if v[j] * v[j + 1] < 0 or (v[j + 1] == 0 and v[j] != 0):
                    if one.direction * (v[j + 1] - v[j]) < 0:
                        continue

                    def along(s: float, one: Watched = one) -> float:
                        return one.value(s, piece.at(s))

                    root = grid[j + 1] if v[j + 1] == 0 else brentq(along, grid[j], grid[j + 1], xtol=1e-14, rtol=1e-14)
                    slope = abs(along(root + 1e-6) - along(root - 1e-6)) / 2e-6
                    exact.grazing |= slope < 0.08
                    if root < first - 1e-12:
                        first, which = root, [i]
                    elif abs(root - first) <= 1e-12:
                        which.append(i)
                    break
        return first, which

    def _jumps(self, s: float, state: State, which: list[int], exact: Exact) -> State:
        """Return the jump at s: actions of events, then the dose, each followed by what it sets off."""
        waiting = list(which)
        doses = [self.dose] if self.dose and s == self.B else []
        while waiting or doses:
            action = None
            if waiting:
                i = waiting.pop(0)
                one = self.watched[i]
                exact.events[i].append((s, state))
                if one.terminal:
                    exact.end = min(exact.end, s)
                action = one.action
            else:
                i, action = -1, doses.pop()
            if action is None:
                continue
            before, state = state, (state[0] + action[0], state[1] + action[1], state[2] + action[2])
            for j, one in enumerate(self.watched):
                old, new = one.value(s, before), one.value(s, state)
                exact.grazing |= j != i and j not in which and min(abs(old), abs(new)) < 5e-3
                crosses = j != i and j not in which and old * new < 0 and one.direction * (new - old) >= 0
                if crosses and j not in waiting:
                    waiting.append(j)
        return state

    def changed(self, **parameters: float) -> Scenario:
        return Scenario(**{**self.__dict__, **parameters})


def quadratic(s: float) -> float:
    return 0.2 + 0.1 * s - 0.03 * s * s


def scenario(row: Row, random: Random) -> Scenario:
    """Numbers for these levels; draws in which a small change would change the sequence of events are discarded."""
    while True:
        keeps = row["invariants"] == "demanded"
        given = -0.5 if keeps else 0.2
        watched: list[Watched] = []
        B = random.uniform(1.7, 2.6)
        direction = random.choice([-1, 0, 1])
        if row["events"] == "value":
            watched.append(Watched((0, 1, 0, 0), random.uniform(0.5, 1.6), direction))
        elif row["events"] == "condition":
            watched.append(Watched((0, 0, 1, 0), random.uniform(2.6, 4.2), direction, condition=True))
        elif row["events"] == "terminal":
            watched.append(Watched((1, 0, 0.1, 0), random.uniform(2.8, 3.8), 1, terminal=True))
        elif row["events"] == "at breakpoint":
            watched.append(Watched((1, 0, 0, 0), B, random.choice([0, 1])))
        if row["actions"] == "once":
            watched.append(Watched((1, 0.2, 0, 0), random.uniform(1.8, 3.2), 1, action=(0.5, given, 0.7)))
        elif row["actions"] == "resets":
            watched.append(Watched((0, 0, 0, 1), 0.4, random.choice([-1, 0]), action=(0.3, 0.6 * given, 0.5)))
        random.shuffle(watched)
        made = Scenario(
            row, 4.0, B, random.choice([-0.3, 0.6]), random.uniform(0.8, 1.6), 3.0, random.uniform(0.6, 1.2),
            random.uniform(0.5, 0.8), random.uniform(0.4, 0.8), random.choice([1, -1]), tuple(watched),
            (0.0, 1.1, 1.5, 2.9, 5.0), tuple(random.uniform(0, 0.6) for _ in range(5)),
            (0.4, 0.8 * given, 0.3) if row["actions"] == "dose" else None,
        )  # fmt: skip
        exact = made.solution()
        near = [abs(x - y) for x, y in itertools.pairwise(sorted({0.0, made.T, *exact.landings}))]
        if not exact.grazing and min(near) > 0.02:
            return made


# ----------------------------------------------------------------------------------------------------------------------
# The problem, as a user would state it

_COUPLED = ((2.0, 0.0, 0.3, 0.0), (0.0, 2.0, 0.0, 0.0), (0.5, 0.0, 2.0, 0.0), (0.0, 0.0, 0.0, 0.0))
_NAMES = ("sign", "k", "r", "q", "w", "B", "o")


def _matrix(mass: str, t: Any) -> list[list[Any]]:
    n = 4 if mass == "singular" else 3
    rows = [list(row[:n]) for row in _COUPLED[:n]]
    if mass == "in time":
        rows[0][0] = 2 + 0.5 * np.sin(t)
    if mass == "singular":
        rows[0][2] = rows[2][0] = 0.0
    return rows


@functools.cache
def _fun(mass: str, jumps: bool, inputs: bool, compiled: bool) -> Callable[..., Any]:
    def slopes(t: Any, y: Any, sign: Any, k: Any, r: Any, u: Any, o: Any) -> Any:
        da = -k * y[0] + u
        F = [sign * da, -sign * da, -sign * o * r]
        if mass == "none":
            return F
        M = _matrix(mass, t)
        f = [M[i][0] * F[0] + M[i][1] * F[1] + M[i][2] * F[2] for i in range(3)]
        return [*f, y[3] - y[0] - 2 * y[2]] if mass == "singular" else f

    if inputs:

        def fun(t, y, table, sign, k, r, q, w, B, o):  # type: ignore[no-untyped-def]
            return slopes(t, y, sign, k, r, q + table + ((w if sign * t > B else 0.0) if jumps else 0.0), o)
    else:

        def fun(t, y, sign, k, r, q, w, B, o):  # type: ignore[no-untyped-def,misc]
            return slopes(t, y, sign, k, r, q + ((w if sign * t > B else 0.0) if jumps else 0.0), o)

    return iv.compile(fun) if compiled else fun


def _total(t, y, *args):  # type: ignore[no-untyped-def]
    return y[0] + y[1]


def _in_time(t, y, *args):  # type: ignore[no-untyped-def]
    sign, _, r, *_, o = args[-len(_NAMES) :]
    return [y[0] + y[1], o * (y[2] - 1) + r * sign * t]


def _time_mass(t, *args):  # type: ignore[no-untyped-def]
    return _matrix("in time", t)


class _Opaque(hidden):
    """A function that is not traced in passing, with the names of its parameters."""

    def __init__(self, fun: Callable[..., Any]) -> None:
        super().__init__(fun)
        self.__signature__ = inspect.signature(fun)


class Posed:
    """A scenario as a problem of the package."""

    def __init__(self, about: Scenario, random: Random) -> None:
        self.about, row = about, about.row
        self.sign, self.n = about.sign, 4 if row["mass"] == "singular" else 3
        self.rtol = 1e-6 if iv.METHODS[row["method"]].order <= 5 else 1e-8
        self.atol = self.rtol / 10
        f = _fun(row["mass"], row["breakpoints"] != "none", row["inputs"] != "none", row["f"] == "compiled")
        self.f = _Opaque(f) if row["f"] == "hidden" else f
        self.args = (float(self.sign), about.k, about.r, about.q, about.w, about.B, float(about.o))
        self.events = [self._event(one) for one in about.watched]
        self.cost = np.array([random.uniform(-1, 1) for _ in range(self.n)])
        self.names = ["k", "r", "q"] + (["y0[0]"] if row["invariants"] != "demanded" else [])
        self.times = sorted({round(random.uniform(0, about.T), 3) for _ in range(6)} | {about.T})
        self.exact = about.solution()
        self.options: dict[str, Any] = {"rtol": self.rtol, "atol": self.atol, **self._output()}
        breakpoints = self._breakpoints()
        self.breakpoints = {} if breakpoints is None else {"breakpoints": breakpoints}

    def _event(self, one: Watched) -> iv.Event:
        alpha, beta, gamma, zeta = one.weights

        def value(t, y, *args):  # type: ignore[no-untyped-def]
            sign, o = args[-len(_NAMES)], args[-1]
            v = -one.level
            if alpha:
                v = v + alpha * sign * t
            if beta:
                v = v + beta * y[0]
            if gamma:
                v = v + gamma * y[1]
            if zeta:
                v = v + zeta * (1 + o * (y[2] - 1))
            return v > 0 if one.condition else v

        action = None if one.action is None else self._jump(one.action)
        rehold = self.about.row["invariants"] != "demanded"
        return iv.Event(value, terminal=one.terminal, direction=one.direction, action=action, rehold=rehold)

    def _jump(self, by: tuple[float, float, float]) -> Callable[..., Any]:
        def action(t, y, *args):  # type: ignore[no-untyped-def]
            o = args[-1]
            a, c = y[0] + by[0], y[2] + o * by[2]
            return [a, y[1] + by[1], c, *([a + 2 * c] if len(y) == 4 else [])]

        return action

    def _breakpoints(self) -> Any:
        row, about = self.about.row, self.about
        if row["breakpoints"] == "none":
            return None
        middle = self.sign * about.B
        times: list[Any] = [middle if about.dose is None else (middle, self._jump(about.dose))]
        if row["breakpoints"] == "edges":
            times += [0.0, self.sign * about.T]
        return times

    def _output(self) -> dict[str, Any]:
        kind = self.about.row["output"]
        adjoint = {"adjoint": True if kind != "end" else "checkpoints"}
        return {
            "steps": {}, "times": {"t_eval": [self.sign * s for s in self.times]}, "refined": {"refine": 3},
            "dense": {"dense_output": True}, "end": {"keep": "end"},
        }[kind] | (adjoint if self.about.row["sensitivities"] == "adjoint" else {})  # fmt: skip

    def problem(self) -> iv.Problem:
        row, about = self.about.row, self.about
        options: dict[str, Any] = {}
        if self.events:
            options["events"] = self.events
        if row["inputs"] != "none":
            table = sorted(zip((self.sign * s for s in about.knots), about.values, strict=True))
            times, values = zip(*table, strict=True)
            if row["inputs"] == "cubic":
                values = tuple(quadratic(self.sign * t) for t in times)
            options["inputs"] = iv.Input(times, values, row["inputs"])
        if row["bounds"] == "rest":
            no = np.full(self.n, np.inf)
            options |= (
                {"nonnegative": [2]} if about.o > 0 else {"bounds": (-no, np.where(np.arange(self.n) == 2, 2, no))}
            )
        elif row["bounds"] == "idle":
            options["bounds"] = (-50.0, 50.0)
        if row["invariants"] != "none":
            options["invariants"] = {
                "total": _total, "in time": _in_time, "demanded": iv.Invariants(_total, value=about.a0 + about.b0),
            }[row["invariants"]]  # fmt: skip
        if row["mass"] != "none":
            options["mass"] = _time_mass if row["mass"] == "in time" else np.array(_matrix(row["mass"], 0.0))
        if row["sensitivities"] == "forward":
            y0 = {"y0": [0]} if "y0[0]" in self.names else {}
            options["sensitivities"] = iv.Sensitivities(args=["k", "r", "q"], **y0)
        return iv.Problem(
            self.f, (0, self.sign * about.T), self.state((about.a0, about.b0, 1.0)), args=self.args, **options
        )

    def state(self, y: State) -> Any:
        c = 1 + self.about.o * (y[2] - 1)
        return np.array([y[0], y[1], c, *([y[0] + 2 * c] if self.n == 4 else [])])

    def solve(self, **more: Any) -> Any:
        return self.problem().solve(
            self.about.row["method"], **self.options, **self.breakpoints, **{"max_steps": MOST_STEPS, **more}
        )

    def resumed(self, path: Path) -> Any:
        return iv.load(path, self.problem(), **self.breakpoints)

    @functools.cached_property
    def neighbours(self) -> list[tuple[Exact, Exact]]:
        """The exact solutions for each parameter a little larger and smaller, to beyond T."""
        T = self.about.T + _BEYOND
        return [
            tuple(
                self.about.changed(**{field: getattr(self.about, field) + h, "T": T}).solution()
                for h in (_STEP, -_STEP)
            )  # type: ignore[misc]
            for field in (name if name != "y0[0]" else "a0" for name in self.names)
        ]

    def sensitivities(self, s: float, *, left: bool = False) -> Any:
        """Differences of the pieces that are here at s, which begin and end elsewhere for other parameters."""
        i = self.exact.place(s, left=left)
        ends = [[self.state(one.pieces[i].at(s)) for one in pair] for pair in self.neighbours]
        return np.stack([(up - down) / (2 * _STEP) for up, down in ends], axis=1)


#: Steps of a run: the costliest, with ode23t, take some thousand.
MOST_STEPS = 20_000
#: Of central differences of exact solutions: their error is about 1e-16 / _STEP + _STEP² = 1e-10.
_STEP = 1e-5
#: How far the exact solutions for other parameters go beyond T: more than they move an event, less than T to a knot.
_BEYOND = 0.01
#: Distance in s from a landing below which a value may belong to either side of it.
_NEAR = 1e-3
#: Errors of whole runs in units of the tolerance rtol |y| + atol: codes control the errors of steps, of which runs to
#: T = 4 have up to some hundred. Sensitivities carry those of event times too.
ALLOWED = 300


def wrong_case(row: Row, random: Random) -> str | None:
    """Solves a problem with these levels. What is wrong with the result, or None."""
    posed = Posed(scenario(row, random), random)
    try:
        with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
            warnings.simplefilter("error")
            sol = posed.solve()
            return wrong_solution(posed, sol) or _wrong_restart(posed, sol, Path(folder), random)
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:400]}"


def wrong_solution(posed: Posed, sol: Any) -> str | None:
    about, exact = posed.about, posed.exact
    ended = exact.end < about.T
    end = min(exact.end, about.T)
    if sol.status != int(ended) or abs(abs(sol.t_end) - end) > 1e3 * posed.rtol:
        return f"status {sol.status} at {sol.t_end} instead of {end}: {sol.message}"
    return (
        next(_wrong_events(posed, sol), None)
        or next(_wrong_outputs(posed, sol), None)
        or next(_wrong_derivatives(posed, sol), None)
    )


def _wrong_events(posed: Posed, sol: Any) -> Iterator[str]:
    end = min(posed.exact.end, posed.about.T)
    for i, expected in enumerate(posed.exact.events):
        expected = [one for one in expected if one[0] <= end]
        found = np.abs(sol.t_events[i])
        if len(found) != len(expected):
            yield f"event {i} at {found} instead of {[s for s, _ in expected]}"
            continue
        for s, y, (at, state) in zip(found, sol.y_events[i], expected, strict=True):
            if abs(s - at) > 10 * ALLOWED * posed.rtol:
                yield f"event {i} at {s} instead of {at}"
            if np.abs(y - posed.state(state)).max() > 10 * ALLOWED * posed.rtol * 4:
                yield f"event {i} at {s}: y = {y} instead of {posed.state(state)}"


def _expected(posed: Posed, s: float) -> list[Any]:
    """The states that may stand in the output at s: both sides of a landing."""
    exact, sides = posed.exact, []
    for landing in exact.landings:
        if abs(landing - s) < _NEAR:
            before = max((p for p in exact.pieces if p.start < landing), key=lambda p: p.start)
            after = next((p for p in exact.pieces if p.start == landing), before)
            sides += [posed.state(before.at(s)), posed.state(after.at(s))]
    return sides or [posed.state(exact.at(s))]


def _wrong_outputs(posed: Posed, sol: Any) -> Iterator[str]:
    about = posed.about
    if (np.diff(np.abs(sol.t)) < 0).any():
        yield "outputs are not in order"
    if about.row["output"] == "times":
        wanted = [posed.sign * s for s in posed.times if s <= abs(sol.t_end)]
        if not set(wanted) <= set(sol.t):
            yield f"outputs at {sol.t} instead of {wanted}"
    elif about.row["output"] == "end" and sol.t[-1] != sol.t_end:
        yield "the end is missing"
    places = list(zip(np.abs(sol.t), sol.y.T, strict=True))
    if sol.sol is not None:
        places += [(s, sol.sol(posed.sign * s)) for s in posed.times if s <= abs(sol.t_end)]
    for s, y in [*places, (abs(sol.t_end), sol.y_end)]:
        candidates = _expected(posed, s)
        error = min(np.abs(y - one).max() for one in candidates) / (posed.rtol * 4 + posed.atol)
        if not error <= ALLOWED:
            yield f"error of {error:.3g} tolerances at s = {s}: {y} instead of {candidates}"
    if about.row["output"] in ("steps", "refined"):
        yield from _wrong_jumps(posed, sol)
    if about.row["bounds"] == "rest":
        z = 1 + about.o * (np.asarray(sol.y)[2] - 1)
        if (z < 0).any():
            yield f"out of bounds by {-z.min()}"


def _wrong_jumps(posed: Posed, sol: Any) -> Iterator[str]:
    """The output holds both states of each jump, the one before first."""
    exact, end = posed.exact, min(posed.exact.end, posed.about.T)
    for before, after in itertools.pairwise(exact.pieces):
        states = np.array([posed.state(before.at(after.start)), posed.state(after.at(after.start))])
        if after.start >= end or np.abs(states[1] - states[0]).max() < 0.01:
            continue
        near = np.flatnonzero(np.abs(np.abs(sol.t) - after.start) < _NEAR)
        twice = [i for i in near[:-1] if sol.t[i] == sol.t[i + 1]]
        allowed = ALLOWED * (posed.rtol * 4 + posed.atol)
        if len(twice) != 1 or np.abs(sol.y.T[twice[0] : twice[0] + 2] - states).max() > allowed:
            yield f"the jump at s = {after.start} is not in the output: {sol.t[near]}, {sol.y.T[near]}"


def _wrong_derivatives(posed: Posed, sol: Any) -> Iterator[str]:
    kind, end = posed.about.row["sensitivities"], min(posed.exact.end, posed.about.T)
    if kind == "none":
        return
    if kind == "adjoint":
        expected = posed.cost @ posed.sensitivities(end, left=not posed.exact.jumps(end))
        found = sol.gradient(posed.cost, wrt=posed.names)
        error = np.abs(found - expected).max() / (posed.rtol * (1 + np.abs(expected).max()))
        if not error <= 10 * ALLOWED:
            yield f"gradient {found} instead of {expected}"
        return
    yield from _wrong_times(posed, sol)
    for s, S in zip(np.abs(sol.t), np.moveaxis(sol.sensitivities, 2, 0), strict=True):
        if any(abs(s - landing) < _NEAR for landing in posed.exact.landings - {posed.about.T}):
            continue
        expected = posed.sensitivities(s)
        error = np.abs(S - expected).max() / (posed.rtol * (1 + np.abs(expected).max()))
        if not error <= 10 * ALLOWED:
            yield f"sensitivities {S.tolist()} instead of {expected.tolist()} at s = {s}"


def _wrong_times(posed: Posed, sol: Any) -> Iterator[str]:
    """The derivatives of times of events, of occurrences that the neighbours have too."""
    end = min(posed.exact.end, posed.about.T)
    for i, expected in enumerate(posed.exact.events):
        here = [s for s, _ in expected if s <= end]
        near = [[[s for s, _ in one.events[i]][: len(here)] for one in pair] for pair in posed.neighbours]
        if any(len(one) < len(here) for pair in near for one in pair):
            continue
        times = np.array([(np.array(up) - np.array(down)) / (2 * _STEP) for up, down in near]).T * posed.sign
        found = sol.sensitivities_t_events[i]
        error = np.abs(found - times).max(initial=0) / (posed.rtol * (1 + np.abs(times).max(initial=0)))
        if not error <= 10 * ALLOWED:
            yield f"derivatives of the times of event {i}: {found.tolist()} instead of {times.tolist()}"


def _wrong_restart(posed: Posed, whole: Any, folder: Path, random: Random) -> str | None:
    kind, tf = posed.about.row["restart"], posed.sign * posed.about.T
    if kind == "none":
        return None
    path, after = folder / "run.npz", random.randint(1, max(1, min(20, whole.stats.steps - 1)))
    part = posed.solve(max_steps=after, **({"checkpoint": path} if kind == "checkpoint" else {}))
    if kind in ("file", "extended"):
        part.save(path)
    if kind == "extended" or kind == "limit":
        again = part.extend(tf, max_steps=MOST_STEPS)
    else:
        again = posed.resumed(path).extend(tf, max_steps=MOST_STEPS)
    if found := differences(whole, again):
        return f"after {after} steps and a restart ({kind}) differ {found}"
    return None
