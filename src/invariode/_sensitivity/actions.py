"""Effects of events and actions on sensitivities.

An event e(t, y, p) = 0 occurs at τ(p), with

    ∂τ/∂p = −(e_y S⁻ + e_p) / (e_t + e_y f⁻),

and after its action y⁺ = h(τ, y⁻, p)

    S⁺ = h_y (S⁻ + f⁻ ∂τ) + h_p + h_t ∂τ − f⁺ ∂τ.

Where the run puts y⁺ back onto constraints, as after a blow against a mechanism, that is a part of h; so are all
further actions at the same time, among them those of events that the jump has carried over zero: their time is that of
the jump.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from .._base.arguments import EPS, RTOL, Array, Weights, warn
from .._functions.compiled import CoreFunction
from .._functions.derivatives import Derivative, derivative_of
from .._functions.with_arguments import Point
from .._laws.imposing import impose
from .._problem.events import Event, RootOf, Roots, titled
from .._problem.invariants import AccuracyWarning, Invariants
from .._problem.parameters import ParameterName
from .._problem.problem import Problem
from .algebraic import dense_mass
from .mass_derivatives import AlgebraicOverTime

#: Part of the time scale of y after which the slope of an event is evaluated again, to see how it bends.
_AHEAD = 1e-6
#: An event at its root is that small, in units of the last place of t and of its terms: the core ties roots within 4.
_AT_ROOT = 64
#: Relative differences of ∂τ of events at one time beyond the errors of the run.
_ALIKE = 1e-3

_UNTRACED = (
    "sensitivities: {0} is a condition (True or False) that cannot be traced, so that the derivatives of its times are "
    "unknown, and 0 here. Return a number that changes its sign instead"
)


class Rate:
    """y' of M y' = f, also of its algebraic components; `slope` makes the derivatives of f, for these.

    A component at a bound, within the absolute tolerance, where y' leads outside, rests: its y' is 0, as in the run.
    (Between steps, rests are as exact as Newton's iteration.)
    """

    def __init__(self, problem: Problem, atol: float | Array, slope: Callable[[], Derivative]) -> None:
        self._slope, self._mass, self._args = problem.slope, problem.matrices.mass, problem.args
        self._algebraic = AlgebraicOverTime(problem)
        self._derivatives = slope() if self.is_singular else None
        self._near = np.asarray(atol)
        self._bounds, self._direction = problem.bounds, np.sign(problem.t_span[1] - problem.t_span[0])
        self.t0, delays = problem.t_span[0], problem.delays
        self._at_start = None if delays is None else delays.past(self.t0, problem.y0, problem.args)
        self.past = self._at_start  # with delays: the delayed values, (delays, n)

    @property
    def is_singular(self) -> bool:
        """True if M is singular."""
        return self._algebraic.is_singular

    def restart(self) -> None:
        """Take the delayed values of the start."""
        self.past = self._at_start

    def __call__(self, t: float, y: Array) -> Array:
        """y' at (t, y), with the delayed values in `past`, or with those that stand after y."""
        if self.past is None:
            f = self._slope(np.array([t]), y[:, None])[:, 0]
        else:
            n = self.past.shape[1]
            y, z = (y, self.past) if len(y) == n else (y[:n], y[n:].reshape(-1, n))
            f = self._slope.of_past(t, y, z)
        if self._derivatives is not None:
            ft = self._derivatives.of_time(t, y)
            J, algebraic = self._derivatives.jacobian(t, y), self._algebraic.at(t)
            rate = algebraic.rate(J, f, ft)
            rests = self._rests(y, rate)  # algebraic components follow from the others
            return algebraic.rate(J, f - algebraic.M @ np.where(rests, rate, 0), ft) if rests.any() else rate
        M = dense_mass(self._mass, t, self._args)
        rate = f if M is None else np.asarray(np.linalg.solve(M, f))
        return np.where(self._rests(y, rate), 0, rate)

    def _rests(self, y: Array, rate: Array) -> Array:
        """Return which components, (n,), are at a bound and would leave it outwards."""
        if self._bounds is None:
            return np.zeros(len(y), dtype=bool)
        outwards = self._direction * rate
        at_lower, at_upper = y <= self._bounds.lower + self._near, y >= self._bounds.upper - self._near
        return np.asarray((at_lower & (outwards < 0)) | (at_upper & (outwards > 0)))


def is_at_root(event: Along, t: float, y: Array, f: Array) -> bool:
    """Return whether an event is zero at a state with this slope, to roundoff; if not, a jump has carried it over
    zero."""
    none = np.zeros((4, event.k))
    signs = (-1.0) ** np.arange(len(y))
    rate, at_t, *terms = event.columns(
        t, y, np.array([1.0, t, 0.0, 0.0]), np.stack([f, np.zeros_like(y), y, y * signs]), none
    )[:, 0]
    size = np.spacing(abs(t)) * abs(rate) + EPS * (abs(at_t) + max(map(abs, terms)))
    return bool(abs(event.value(t, y)[0]) <= _AT_ROOT * size)


def of_event(event: Event, derivatives: Callable[..., Derivative]) -> tuple[Derivative, bool]:
    """Return the derivatives of the function of an event, of a condition those of a function whose zeros are its
    changes; and whether they are known.

    Warns
    -----
    AccuracyWarning
        A condition cannot be traced: nothing is known of its times but themselves, and their derivatives are 0.
    """
    called = titled(event.__name__)
    made = derivatives(event.fun, called, m=1, moves_t=True, event=True)
    surface = None if made.graph is None else made.graph.surface(called)
    if surface is not None:
        return derivatives(surface, called, m=1, moves_t=True), True
    if made.is_condition:
        warn(_UNTRACED.format(called), AccuracyWarning)
        return derivatives(_unknown, called, m=1, moves_t=True), False
    return made, True


def _unknown(t: Any, y: Any, *args: Any) -> Any:
    return 0.0 * y[0]


class Along(Protocol):
    """The part of `Derivative` that jumps use."""

    k: int

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives along c directions, (c, m)."""

    def value(self, t: float, y: Array) -> Array:
        """Return the values, (m,)."""


class AlongAction(Along, Protocol):
    """The derivatives of an action that may leave something behind that waits, for a further action.

    Whatever waits has w numbers, such as the time of its execution, whose derivatives wait with it. By default nothing
    waits.
    """

    def waits(self) -> tuple[list[Any], list[Any]]:
        """Return what the latest action has left behind, and what it has used of what waited before it."""
        return [], []

    def width(self, waiting: Any) -> int:
        """Return w."""
        return 0

    def give(self, waiting: Any, columns: Array | None) -> None:
        """Set the derivatives of what waits, along c directions: (c, w); None: they follow from the start."""

    def of_waiting(self, waiting: Any) -> Array:
        """Return the derivatives of what waits, (c, w); of what waits from the start on, those for parameters."""
        return np.zeros((self.k, 0))


class OfRoots(NamedTuple):
    """Derivatives of the functions of a `Roots`, and of its action, which has just been taken."""

    #: fun, action: the derivatives of all m functions, and of the action
    fun: Along
    action: AlongAction
    is_known: bool = True  # False: the functions are conditions that cannot be traced

    def times(self, t: float, y: Array, f: Array, number: int, dy: Array, dp: Array) -> Array:
        """Return the derivatives of the time of a root along c directions, (c,), with f for y' before it."""
        return times_of(self.fun, t, y, f, dy, dp, number)


def times_of(function: Along, t: float, y: Array, f: Array, dy: Array, dp: Array, number: int = 0) -> Array:
    """Return the derivatives of the time at which a function is zero along c directions, (c,), with f for y' before it;
    0 if it does not cross zero."""
    rates = rates_along(function, t, y, f, dy, dp)[:, number]
    return np.asarray(-rates[1:] / rates[0]) if rates[0] != 0 else np.zeros(len(dp))


def rates_along(function: Along, t: float, y: Array, f: Array, dy: Array, dp: Array) -> Array:
    """Return the derivatives of a function along the solution, whose slope is f, and along c directions at a fixed t,
    of shape (1 + c, m)."""
    dt = np.append(1.0, np.zeros(len(dp)))
    return function.columns(t, y, dt, np.vstack([f, dy]), np.vstack([np.zeros(dp.shape[1]), dp]))


def of_roots(roots: Roots, derivatives: Callable[..., Derivative], start: Array) -> OfRoots:
    """Return the derivatives of a vector of functions and of its action; S at the start is (k, n).

    Warns
    -----
    AccuracyWarning
        The functions are conditions that cannot be traced.
    """
    remembered: OfRoots | None = roots.derivatives(derivatives, start)
    if remembered is not None:
        return remembered
    name = roots.__name__
    fun = derivatives(roots.fun, name, m=roots.count, moves_t=True)
    is_known = not fun.is_condition
    if not is_known:
        warn(_UNTRACED.format(name), AccuracyWarning)
        fun = derivatives(lambda t, y, *args: [0.0 * y[0]] * roots.count, name, m=roots.count, moves_t=True)
    elif fun.graph is not None and (surfaces := fun.graph.surface(name)) is not None:
        fun = derivatives(surfaces, name, m=roots.count, moves_t=True)
    return OfRoots(fun, _ActionOfRoots(roots, derivatives, fun.k), is_known)


class _ActionOfRoots(AlongAction):
    """The derivatives of an action that remembers nothing, for the roots of its latest call."""

    def __init__(self, roots: Roots, derivatives: Callable[..., Derivative], k: int) -> None:
        self._roots, self._derivatives, self.k = roots, derivatives, k
        self._made: dict[tuple[bytes, bytes], Derivative] = {}

    def _of_latest(self, y: Array) -> Derivative:
        which, directions = self._roots.latest
        key = which.tobytes(), directions.tobytes()
        if key not in self._made:
            on_roots = self._roots.on_roots

            def action(t: Any, y: Any, *args: Any) -> Any:
                return on_roots(t, y, which, directions, *args)

            called = f"on_roots of {self._roots!r}"
            self._made[key] = self._derivatives(action, called, m=len(y), moves_t=True)
        return self._made[key]

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives along directions, (c, n)."""
        return self._of_latest(y).columns(t, y, dt, dy, dp)

    def value(self, t: float, y: Array) -> Array:
        """Return the state after the action, (n,)."""
        return self._of_latest(y).value(t, y)

    def give(self, waiting: Any, columns: Array | None) -> None:
        """See `AlongAction`: nothing waits."""


class _OneOfSeveral:
    """Derivatives of one of several functions."""

    def __init__(self, functions: Along, number: int) -> None:
        self._functions, self._number, self.k = functions, number, functions.k

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives along directions, (c, 1)."""
        return self._functions.columns(t, y, dt, dy, dp)[:, self._number, None]

    def value(self, t: float, y: Array) -> Array:
        """Return the value, (1,)."""
        return self._functions.value(t, y)[self._number, None]


class EventTime:
    """The derivatives of the times at which an event occurs."""

    def __init__(self, event: Event, function: Along, is_known: bool, rate: Rate, weights: Weights) -> None:
        self._name, self._rate, self._weights = event.__name__, rate, weights
        self.function, self._is_known = function, is_known
        self._grazing: list[float] = []
        self.noted: dict[float, Array] = {}  # with delays: ∂τ/∂p at the occurrences of the run

    @classmethod
    def of_each(
        cls,
        events: Sequence[Event],
        derivatives: Callable[..., Derivative],
        roots: Mapping[int, OfRoots],
        rate: Rate,
        weights: Weights,
    ) -> list[EventTime]:
        """Return the times of all events; `roots`: the derivatives of each `Roots`, by its id."""
        found = []
        for event in events:
            if isinstance(event, RootOf):
                of = roots[id(event.roots)]
                known: tuple[Along, bool] = _OneOfSeveral(of.fun, event.number), of.is_known
            else:
                known = of_event(event, derivatives)
            found.append(cls(event, *known, rate, weights))
        return found

    def at(self, t: float, Y: Array) -> Array:
        """∂τ/∂p for an occurrence, of shape (k,); 0 if the event does not cross zero."""
        return self.with_slope(t, Y, self._rate(t, Y[0]))

    def is_at_root(self, t: float, Y: Array) -> bool:
        """Return whether the event is zero for an occurrence, to roundoff."""
        return is_at_root(self.function, t, Y[0], self._rate(t, Y[0]))

    def with_slope(self, t: float, Y: Array, f: Array) -> Array:
        """Return the derivative of the time of the event with respect to the parameters, with f for y' before it."""
        k = len(Y) - 1
        rates = rates_along(self.function, t, Y[0], f, Y[1:], np.eye(k))[:, 0]
        if self._is_known and self._is_grazing(t, Y[0], f, rates[0], k):
            self._grazing.append(t)
        return np.asarray(-rates[1:] / rates[0]) if rates[0] != 0 else np.zeros(k)

    def compare(self, before: _Moment) -> None:
        """A warning if this event, which acts together with others, does not do so for other parameters."""
        times = self.with_slope(before.t, before.start, before.f)
        if not np.allclose(times, before.times, rtol=_ALIKE, atol=_ALIKE * np.abs(before.times).max(initial=0)):
            warn(
                f"sensitivities: {titled(self._name)} acts at t = {before.t:.6g} together with others, and not so for "
                "other parameters. Sensitivities are not reliable from there on",
                AccuracyWarning,
            )

    def _is_grazing(self, t: float, y: Array, f: Array, rate: float, k: int) -> bool:
        """Return whether a change of y within the tolerance could remove the root, that of e + e' s + e'' s² / 2."""
        w, none = self._weights.of(y), np.zeros((2, k))
        moved = self.function.columns(t, y, np.zeros(2), np.stack([w, w * (-1.0) ** np.arange(len(w))]), none)
        with np.errstate(all="ignore"):
            ahead = _AHEAD * np.min(np.maximum(np.abs(y), w) / np.abs(f), initial=max(abs(t), 1.0))
            try:
                there = y + ahead * f
                then = self._rate_of_change(t + ahead, there, self._rate(t + ahead, there), k)
            except (ValueError, ArithmeticError):  # f is not defined there
                return rate == 0
            bend = abs(then - rate) / ahead
        return bool(rate**2 <= 2 * bend * np.abs(moved).max())

    def _rate_of_change(self, t: float, y: Array, f: Array, k: int) -> float:
        """Return the derivative of the event along the solution."""
        return float(self.function.columns(t, y, np.ones(1), f[None], np.zeros((1, k)))[0, 0])

    def tell(self) -> None:
        """A warning if the event has grazed zero, once for each occurrence."""
        if self._grazing:
            warn(
                f"sensitivities: {titled(self._name)} only grazes zero at t = {self._grazing[0]:.6g}: within the "
                "tolerance it may not occur at all, and its time has no derivative there. Sensitivities are not "
                "reliable from there on",
                AccuracyWarning,
            )
            self._grazing.clear()


class _Restored(CoreFunction):
    """The state after an action, moved onto the demanded values of invariants."""

    def __init__(self, demanded: Sequence[Invariants], threshold: float | Array) -> None:
        self._demanded, self._atol = demanded, RTOL * threshold
        self.__name__ = "restored"

    def __call__(self, t: float, y: Array, *args: Any) -> Array:
        if np.iscomplexobj(y) or np.iscomplexobj(t):
            raise TypeError("it is found by iterations, for real states")
        return np.asarray(impose([*self._demanded], t, y, args=args, rtol=RTOL, atol=self._atol).y)


def restoration(problem: Problem, names: Sequence[ParameterName], threshold: float | Array) -> Derivative | None:
    """The derivatives of what the run does to a state after an action, if it moves one onto constraints: by
    differences, which do not depend on the tolerance."""
    demanded = [one for one in problem.invariants if one.value is not None]
    if not any(one.level > 0 for one in demanded):
        return None
    at, n = Point(problem.t_span[0], problem.y0), len(problem.y0)
    restored = _Restored(demanded, threshold)
    return derivative_of(restored, (n, n), at=at, args=problem.args, names=names, moves_t=True)


class _Moment(NamedTuple):
    """Actions at one time."""

    t: float  # time of the actions
    #: start, f, (1 + k, n) and (n,): Y and y' before all of them
    start: Array
    f: Array
    times: Array  # (k,): ∂τ
    moved: Array  # (k, n): the derivatives of the state after them at τ(p)
    after: Array  # (1 + k, n): Y as the core has it then
    fixed: bool = False  # the time is that of a breakpoint


@dataclass
class Together:
    """Record of the actions taken at one time: constraints are imposed again after all of them."""

    _last: _Moment | None = None

    def before(self, t: float, Y: Array) -> _Moment | None:
        """The actions that come right before one in this state."""
        last = self._last
        return last if last is not None and last.t == t and np.array_equal(last.after, Y) else None

    def note(self, moment: _Moment) -> None:
        """Record an action that has been taken."""
        self._last = moment

    def times(self) -> Array:
        """∂τ/∂p of the latest action, (k,)."""
        assert self._last is not None
        return self._last.times


@dataclass
class ActionOfEvent:
    """S after the action of an event."""

    _action: Along
    _restored: Derivative | None
    _time: EventTime
    _rate: Rate
    _together: Together
    _log: list[tuple[float, Array]] = field(default_factory=list)  # one for all functions of a `Roots`

    def __call__(self, t: float, Y: Array, after: Array) -> Array:
        before = self._together.before(t, Y)
        if before is None:
            before = self._first(t, Y)
        elif not before.fixed and is_at_root(self._time.function, t, before.start[0], before.f):
            self._time.compare(before)
        parameters = np.eye(len(before.times))
        moved = landed = self._action.columns(t, Y[0], before.times, before.moved, parameters)
        state = after
        if self._restored is not None:
            landed = self._restored.columns(t, after, before.times, moved, parameters)
            state = self._restored.value(t, after)
        found: Array = landed - np.outer(before.times, self._rate(t, state))
        self._together.note(before._replace(moved=moved, after=np.vstack([after, found])))
        self._log.append((t, found.T.copy()))
        return found

    def _first(self, t: float, Y: Array) -> _Moment:
        f = self._rate(t, Y[0])
        times = self._time.with_slope(t, Y, f)
        return _Moment(t, Y.copy(), f, times, Y[1:] + np.outer(times, f), Y)

    def times(self) -> Array:
        """∂τ/∂p of the latest action, (k,)."""
        return self._together.times()

    def taken(self) -> dict[float, Array]:
        """S (n, k) by the time of the occurrence, since the last `forget`."""
        return dict(self._log)

    def forget(self) -> None:
        """Begin with another run."""
        self._log.clear()


@dataclass
class WithPast:
    """A jump of sensitivities of a problem with delays, as the core calls it: with the delayed values after y, it
    returns (2 k, n), S and rows that begin with ∂τ/∂p_j. An event without an action has its time noted."""

    _jump: Callable[[float, Array, Array], Array] | None
    _rate: Rate
    _time: EventTime | None = None  # of an event

    def __call__(self, t: float, Y: Array, behind: Array) -> Array:
        k, n = len(Y) - 1, Y.shape[1]
        self._rate.past = behind[n:].reshape(-1, n)
        found = np.zeros((2 * k, n))
        found[:k] = Y[1:] if self._jump is None else self._jump(t, Y, behind[:n])
        if self._time is not None:
            times = self._jump.times() if isinstance(self._jump, ActionOfEvent) else self._time.at(t, Y)
            self._time.noted[t] = found[k:, 0] = times
        return found


@dataclass
class ActionAtPoint:
    """S after the action at a breakpoint, whose time does not depend on parameters."""

    _action: Derivative
    _restored: Derivative | None
    _together: Together

    def __call__(self, t: float, Y: Array, after: Array) -> Array:
        none, parameters = np.zeros(len(Y) - 1), np.eye(len(Y) - 1)
        before = self._together.before(t, Y)
        if before is None or not before.fixed:
            before = _Moment(t, Y.copy(), np.zeros(Y.shape[1]), none, Y[1:], Y, fixed=True)
        moved = found = self._action.columns(t, Y[0], none, before.moved, parameters)
        if self._restored is not None:
            found = self._restored.columns(t, after, none, moved, parameters)
        self._together.note(before._replace(moved=moved, after=np.vstack([after, found])))
        return found
