"""The sensitivities of a run: their equations, their tolerances, and what they do at events, as the core takes it.

With S = ∂y/∂p, M S' = (∂f/∂y) S + ∂f/∂p. An event e(t, y, p) = 0 occurs at τ(p), with

    ∂τ/∂p = −(e_y S⁻ + e_p) / (e_t + e_y f⁻),

and behind its action y⁺ = h(τ, y⁻, p)

    S⁺ = h_y (S⁻ + f⁻ ∂τ) + h_p + h_t ∂τ − f⁺ ∂τ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from .. import _core
from .._base.arguments import EPS, Array, warn
from .._functions.compiled import CoreFunction, NativeWithInputs, is_native
from .._functions.directional import Directional, Given, Point, has_llvm
from .._functions.graph.nodes import Node
from .._functions.layout import Parameters, with_numbers
from .._functions.second_order import SecondOrder
from .._laws.bound import InvariantSpec
from .._problem.breakpoints import Breakpoint
from .._problem.description import Description
from .._problem.events import Event, EventSpec, event_spec
from .._problem.grouped import GMRES
from .._problem.inputs import fed
from .._problem.invariants import AccuracyWarning
from .._problem.matrices import as_matrix
from .._problem.parameters import ParameterName, values_of
from .._results.sensitivities import AtEvents
from .algebraic import Algebraic, dense_mass

#: A change of a parameter that a mass matrix which depends on it shows.
_CHANGE = 1e-3
#: Part of the time scale of y after which the slope of an event is evaluated again, to see how it bends.
_AHEAD = 1e-6
#: Part of the interval within which a discontinuity, which is located by steps that fail, is that of a condition.
_NEAR = 0.02
#: Relative distance within which two conditions change together.
_TOGETHER = 1e-9


class Weights(NamedTuple):
    """The weights of y in the error test, max(rtol |y_i|, rtol thr_i)."""

    rtol: float
    threshold: float | Array

    def of(self, y: Array) -> Array:
        """At a state."""
        return self.rtol * np.maximum(np.abs(y), self.threshold)


@dataclass
class Variations:
    """What a run computes besides y.

    Attributes
    ----------
    names : list of str
        Those of the parameters.
    start : ndarray, (k, n)
        S at the start.
    for_core : _core.Variations
        What the core takes.
    tangents : list
        (t, Y) -> G S_j + g_pj of each invariant.
    how : dict
        How the derivatives of each function are formed.
    times : list of EventTime
        For each event.
    actions : list
        What happens to S at the action of each event, with its log.
    switches : list of EventSpec
        Conditions at which f jumps: further events, which change S alone.
    log : list of tuple
        When conditions of f have changed, and which.
    near : float
        Within which distance a discontinuity is that of a condition.
    follows_jumps : bool
        Whether the conditions of f are known.
    derivatives_of : list of Directional
        Of all functions.
    """

    names: list[str]
    start: Array
    for_core: _core.Variations
    tangents: list[Any]
    how: dict[str, str]
    times: list[EventTime]
    actions: list[_Jump | None]
    switches: list[EventSpec]
    log: list[tuple[float, str]]
    near: float
    follows_jumps: bool
    derivatives_of: list[Directional]

    def tangent_nodes(self) -> list[Node]:
        """f_y S + f_p as a graph, of (t, Y).

        Raises
        ------
        TypeError
            A parameter is a constant of the graph of f.
        """
        found = self.derivatives_of[0].tangent_nodes()
        if found is None:
            raise TypeError(
                "sensitivities by Taylor series need the derivatives of fun from its graph, of which a parameter is a "
                "constant, such as the count of a loop: name the other parameters, or use method='dop853' or 'ode89'"
            )
        return found

    def augmented(self, y: Array) -> Array:
        """Y for the core."""
        return np.concatenate([y, self.start.ravel()])

    @property
    def derivatives(self) -> str:
        """How they are formed, in words."""
        ways = set(self.how.values())
        return ways.pop() if len(ways) == 1 else "; ".join(f"{called}: {way}" for called, way in self.how.items())

    def has_followed(self, discontinuities: Sequence[float]) -> bool:
        """Whether f has jumped only where conditions that are followed have changed; if not, there is a warning."""
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
        points = [Point(float(t[i]), y[:, i]) for i in sorted({len(t) // 2, len(t) - 1}) if len(t)]
        wrong = [one.called for one in self.derivatives_of if not all(map(one.takes_complex_at, points))]
        if wrong:
            warn(
                f"sensitivities: complex steps through {', '.join(wrong)} do not give its derivatives everywhere in "
                "this run, as with abs of a complex number: sensitivities may be wrong. Write it so that it can be "
                "traced, or give jac and Sensitivities(dfdp=...)",
                AccuracyWarning,
            )

    def in_words(self, message: str, component: int) -> str:
        """A message about a component of Y behind y."""
        n = self.start.shape[1]
        j, i = divmod(component - n, n)
        return message.replace(f"omponent {component}", f"omponent {i} of the sensitivity to {self.names[j]}", 1)

    def at_events(self, happened: Sequence[tuple[Array, Array]], n: int) -> AtEvents:
        """The sensitivities at occurrences of events, of times and Y; what actions have done is taken from the log."""
        before, after, times = [], [], []
        k = len(self.names)
        for (t, rows), time, action in zip(happened, self.times, self.actions, strict=True):
            states = rows.reshape(len(t), 1 + k, n)
            before.append(np.swapaxes(states[:, 1:], 1, 2).copy())
            times.append(np.array([time.at(*one) for one in zip(t.tolist(), states, strict=True)]).reshape(len(t), k))
            log = {} if action is None else action.taken()
            unknown = np.full((n, k), np.nan)
            behind = before[-1] if action is None else np.array([log.get(one, unknown) for one in t.tolist()])
            after.append(behind.reshape(len(t), n, k))
            time.tell()
        return AtEvents(before, after, times)


def make_variations(
    problem: Description, y0: Array, weights: Weights, specs: Sequence[InvariantSpec], points: Sequence[Breakpoint]
) -> Variations:
    """The sensitivities that a problem asks for.

    Raises
    ------
    TypeError, ValueError
        An unknown parameter; a derivative of a wrong shape; something for which there are no sensitivities.
    """
    wanted, names = problem.sensitivities, problem.parameters()
    assert wanted is not None
    require_possible(problem, names)
    t0, args, n = problem.t_span[0], problem.args, len(y0)
    at = Point(t0, y0)
    about = _Derivatives(args, names, n, at)
    fun, given = given_derivatives(problem, names)
    slope = about.of(fun, "fun", m=n, given=given)
    laws = [
        about.of(one.fun, f"invariant {spec.name}", m=spec.m, given=Given(one.jac if _is_python(one.jac) else None))
        for one, spec in zip(problem.invariants, specs, strict=True)
    ]
    rate = Rate(problem, lambda: about.of(fun, "fun", m=n, given=given, moves_t=True))
    times = [EventTime(event, about, rate, weights) for event in problem.events]
    jumps = [
        None
        if event.action is None
        else _Jump(about.of(event.action, f"the action of event {event.__name__}", m=n, moves_t=True), time, rate)
        for event, time in zip(problem.events, times, strict=True)
    ]
    actions = {id(one.action): one.action for one in points if one.action is not None}
    made = {key: _Dose(about.of(one, "the action in breakpoints", m=n)) for key, one in actions.items()}
    doses = [made.get(id(point.action)) for point in points]
    log: list[tuple[float, str]] = []
    switches = followed(slope, about.of, problem, log)
    parameters = Parameters.of(args)
    sizes = wanted.sizes(names, _default_sizes(names, problem, y0, weights))
    tangents = [law.for_core for law in laws]
    for_core = _core.Variations(
        k=len(names),
        slope=slope.for_core,
        thresholds=np.ascontiguousarray(_absolute(y0, weights) / sizes[:, None]),
        invariants=tangents,
        jumps=[*jumps, *(one.jump for one in switches)],
        breakpoints=doses,
        error_test=wanted.error_test,
    )
    start = np.ascontiguousarray(wanted.start(names, args, n).T)
    about.tell()
    return Variations(
        names=[one.name for one in names],
        start=start,
        for_core=for_core,
        tangents=tangents,
        how=about.how,
        times=times,
        actions=jumps,
        switches=[event_spec(one.event, n, parameters) for one in switches],
        log=log,
        near=_NEAR * abs(problem.t_span[1] - t0),
        follows_jumps=slope.knows_jumps,
        derivatives_of=about.made,
    )


class _Derivatives:
    """Derivatives of the functions of a problem, and how they are formed."""

    def __init__(self, args: tuple[Any, ...], names: Sequence[ParameterName], n: int, at: Point) -> None:
        self._args, self._names, self._n, self.at = args, names, n, at
        self.how: dict[str, str] = {}
        self.made: list[Directional] = []

    def of(self, fun: Any, called: str, **more: Any) -> Directional:
        """Those of a function."""
        made = Directional(fun, self._args, self._names, self._n, at=self.at, called=called, **more)
        self.how[called] = made.how
        self.made.append(made)
        return made

    def tell(self) -> None:
        """A warning if some are differences."""
        rough = [called for called, how in self.how.items() if how.endswith("differences")]
        if rough:
            warn(
                f"sensitivities: the derivatives of {', '.join(rough)} are differences, which are accurate to 1e-10 at "
                "best: it cannot be traced, and does not take complex numbers. Write it with NumPy's functions, or "
                "give jac, and Sensitivities(dfdp=...)",
                AccuracyWarning,
            )


class Rate:
    """y' of M y' = f, also of its algebraic components; `slope` makes the derivatives of f, for these."""

    def __init__(self, problem: Description, slope: Callable[[], Directional]) -> None:
        self._slope, self._mass, self._args = problem.slope, problem.matrices.mass, problem.args
        self._algebraic = Algebraic.of(dense_mass(self._mass, problem.t_span[0], problem.args))
        self._derivatives = None if self._algebraic is None else slope()

    def __call__(self, t: float, y: Array) -> Array:
        f = self._slope(np.array([t]), y[:, None])[:, 0]
        if self._algebraic is not None and self._derivatives is not None:
            ft = self._derivatives.along(t, y, 1.0, np.zeros_like(y), np.zeros(self._derivatives.k))
            return self._algebraic.rate(self._derivatives.jacobian(t, y), f, ft)
        M = dense_mass(self._mass, t, self._args)
        return f if M is None else np.asarray(np.linalg.solve(M, f))


class EventTime:
    """The derivatives of the times at which an event occurs."""

    def __init__(self, event: Event, about: _Derivatives, rate: Rate, weights: Weights) -> None:
        self._name, self._rate, self._weights = event.__name__, rate, weights
        self._function = about.of(event.fun, f"event {event.__name__}", m=1, moves_t=True, event=True)
        self._grazing: list[float] = []

    def at(self, t: float, Y: Array) -> Array:
        """∂τ/∂p for an occurrence, of shape (k,); 0 if the event does not cross zero."""
        return self.with_slope(t, Y, self._rate(t, Y[0]))

    def with_slope(self, t: float, Y: Array, f: Array) -> Array:
        """The same with y' before the event."""
        k = len(Y) - 1
        rates = self._function.columns(
            t, Y[0], np.append(1.0, np.zeros(k)), np.vstack([f, Y[1:]]), np.vstack([np.zeros(k), np.eye(k)])
        )[:, 0]
        if self._is_grazing(t, Y[0], f, rates[0], k):
            self._grazing.append(t)
        return np.asarray(-rates[1:] / rates[0]) if rates[0] != 0 else np.zeros(k)

    def _is_grazing(self, t: float, y: Array, f: Array, rate: float, k: int) -> bool:
        """Whether a change of y within the tolerance could do away with the root: that of e + e' s + e'' s² / 2."""
        w, none = self._weights.of(y), np.zeros((2, k))
        moved = self._function.columns(t, y, np.zeros(2), np.stack([w, w * (-1.0) ** np.arange(len(w))]), none)
        with np.errstate(all="ignore"):
            ahead = _AHEAD * np.min(np.maximum(np.abs(y), w) / np.abs(f), initial=max(abs(t), 1.0))
            try:
                there = y + ahead * f
                then = self._function.along(t + ahead, there, 1.0, self._rate(t + ahead, there), np.zeros(k))
            except (ValueError, ArithmeticError):  # f is not defined there
                return rate == 0
            bend = abs(then[0] - rate) / ahead
        return bool(rate**2 <= 2 * bend * np.abs(moved).max())

    def tell(self) -> None:
        """A warning if the event has grazed zero, once for each occurrence."""
        if self._grazing:
            warn(
                f"sensitivities: event {self._name} only grazes zero at t = {self._grazing[0]:.6g}: within the "
                "tolerance it may not occur at all, and its time has no derivative there. Sensitivities are not "
                "reliable from there on",
                AccuracyWarning,
            )
            self._grazing.clear()


@dataclass
class _Jump:
    """S behind the action of an event."""

    _action: Directional
    _time: EventTime
    _rate: Rate
    _log: list[tuple[float, Array]] = field(default_factory=list)

    def __call__(self, t: float, Y: Array, after: Array) -> Array:
        f = self._rate(t, Y[0])
        times = self._time.with_slope(t, Y, f)
        moved = self._action.columns(t, Y[0], times, Y[1:] + np.outer(times, f), np.eye(len(times)))
        found: Array = moved - np.outer(times, self._rate(t, after))
        self._log.append((t, found.T.copy()))
        return found

    def taken(self) -> dict[float, Array]:
        """S (n, k) by the time of the occurrence, since the last call."""
        found = dict(self._log)
        self._log.clear()
        return found


@dataclass
class _Dose:
    """S behind the action at a breakpoint, whose time does not depend on parameters."""

    _action: Directional

    def __call__(self, t: float, Y: Array, after: Array) -> Array:
        return self._action.tangent(t, Y)


# ----------------------------------------------------------------------------------------------------------------------
# Where f jumps


#: With more conditions at which f jumps than this, S is not corrected there.
_MOST_SWITCHES = 32
#: From one unit of roundoff on, y is moved by at most 2 to this power of them beyond a jump.
_MOST_DOUBLINGS = 8


class Crossing(NamedTuple):
    """How e(t, y, p) = 0 is crossed: y' before and behind, the rate of e before, and whether it leads back."""

    before: Array
    behind: Array
    rate: float
    leads_back: bool


@dataclass
class Switching:
    """Where f goes from one branch to another at e(t, y, p) = 0: S⁺ = S⁻ + (f⁻ − f⁺) ∂τ.

    Attributes
    ----------
    name : str
        What messages call it.
    function : callable
        e, for events.
    difference : Directional
        The derivatives of e.
    """

    name: str
    function: Any
    difference: Directional
    _value: Callable[[float, Array], Array]
    _below: Callable[[float, Array], Array]
    _above: Callable[[float, Array], Array]
    _forward: float
    _log: list[tuple[float, str]]  # of all conditions
    _warned: bool = False

    @property
    def event(self) -> Event:
        """The condition as an event, which starts the new branch."""
        made = Event(self.function, action=self.action, rehold=False)
        made.__name__ = self.name
        return made

    def crossing(self, t: float, y: Array) -> Crossing | None:
        """How it is crossed in this state; None: it is not."""
        below, above = (np.asarray(branch(t, y)) for branch in (self._below, self._above))
        none = np.zeros((2, self.difference.k))
        rates = self.difference.columns(t, y, np.ones(2), np.stack([below, above]), none)[:, 0]
        rising, falling = self._forward * rates[0] > 0, self._forward * rates[1] < 0
        if rising:
            return Crossing(below, above, rates[0], bool(falling))
        return Crossing(above, below, rates[1], leads_back=False) if falling else None

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
        """S behind it."""
        y, S = Y[0], Y[1:]
        found = self.crossing(t, y)
        if found is None:
            return S
        self.tell(t, found)
        k = len(S)
        times = -self.difference.columns(t, y, np.zeros(k), S, np.eye(k))[:, 0] / found.rate
        moved: Array = S + np.outer(times, found.before - found.behind)
        return moved

    def tell(self, t: float, found: Crossing) -> None:
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
    slope: Directional, about: Callable[..., Directional], problem: Description, log: list[tuple[float, str]]
) -> list[Switching]:
    """The conditions of f at which it jumps, if they can be followed; if not, there is a warning."""
    found = slope.switches(Point(problem.t_span[0], problem.y0))
    if not found:
        return []
    unknown = problem.matrices.mass is not None or any(slope.of_inputs(one.difference) for one in found)
    if len(found) > _MOST_SWITCHES or unknown:
        warn(
            f"sensitivities: fun jumps at {len(found)} conditions, where sensitivities jump too. With a mass matrix, "
            f"if an input is compared, or with more than {_MOST_SWITCHES} of them, these are not followed: "
            "sensitivities may be wrong behind them",
            AccuracyWarning,
        )
        return []
    forward = 1.0 if problem.t_span[1] >= problem.t_span[0] else -1.0
    made = []
    for i, switch in enumerate(found):
        name = f"condition {i + 1} of fun"
        function = slope.on_graph([switch.difference], "condition")
        difference = about(function, name, m=1, moves_t=True)
        value, below, above = (slope.branch(one) for one in ([switch.difference], switch.below, switch.above))
        event = function if has_llvm() else _sign_of(value)
        made.append(Switching(name, event, difference, value, below, above, forward, log))
    return made


def _sign_of(value: Callable[[float, Array], Array]) -> Callable[..., float]:
    """An event without machine code."""
    return lambda t, y, *args: float(value(t, y)[0])


# ----------------------------------------------------------------------------------------------------------------------
# What is known, and what is possible


def require_possible(problem: Description, names: Sequence[ParameterName]) -> None:
    """That there are sensitivities. What there are none for is refused by name."""
    if isinstance(problem.fun, SecondOrder) and problem.fun.native:
        raise ValueError(
            "sensitivities are not possible for a SecondOrder of machine code: use invariode.compile(SecondOrder(f))"
        )
    if isinstance(problem.fun, CoreFunction) and not isinstance(problem.fun, SecondOrder):
        raise ValueError(
            "sensitivities are not possible for a MechanicalSystem, whose accelerations the core computes: write its "
            "equations as a function, or use invariode.symbolic"
        )
    for law in problem.invariants:
        if law.sense:
            raise ValueError(
                "sensitivities are not possible with Dissipated, which holds in one direction only: leave it out"
            )
    mass = problem.matrices.mass
    t0, args = problem.t_span[0], problem.args
    if callable(mass) and problem.events and Algebraic.of(dense_mass(mass, t0, args)) is not None:
        raise ValueError(
            "sensitivities are not possible with events and a singular mass matrix that is a function of t, since y' "
            "of its algebraic components is not known where an event occurs: leave out the events, or solve the "
            "algebraic equations in fun"
        )
    if not callable(mass):
        return
    own = [one for one in names if one.kind == "args"]
    values = values_of(args, problem.y0, own)
    for one, value in zip(own, values.tolist(), strict=True):
        changed = value * (1 + _CHANGE) if value else _CHANGE
        other = mass(t0, *with_numbers(args, {one.index: {one.item or 0: changed}}))
        if abs(as_matrix("mass", other, False) - as_matrix("mass", mass(t0, *args), False)).max() != 0:
            raise ValueError(
                f"sensitivities: mass depends on {one.name}, and the derivative of a mass matrix is not known: solve "
                "M y' = f for y' in fun, or leave the parameter out"
            )


def require_direct(solver: object) -> None:
    """That linear systems are solved with factors, which all columns of S share."""
    if isinstance(solver, GMRES):
        raise ValueError("sensitivities need linear_solver='direct': GMRES has no factors that their columns share")


def given_derivatives(problem: Description, names: Sequence[ParameterName]) -> tuple[Any, Given]:
    """f with its inputs, and what is given of its derivatives, of (t, y, *args)."""
    dfdp = None if problem.sensitivities is None else problem.sensitivities.dfdp
    return _with_inputs(problem), Given(_jacobian(problem), _dfdp(dfdp, problem, names))


def _with_inputs(problem: Description) -> Any:
    """f, with its inputs."""
    fun, inputs = problem.fun, problem.inputs
    fun = fun.first_order if isinstance(fun, SecondOrder) else fun
    if not inputs:
        return fun
    return NativeWithInputs(fun, [one._core for one in inputs], [one.values.shape[1:] for one in inputs])


def _is_python(given: Any) -> bool:
    return callable(given) and not is_native(given)


def _jacobian(problem: Description) -> Any:
    """The Jacobian that is given, whole; None: none, or machine code."""
    matrices = problem.matrices
    given = fed(matrices.jac, problem.inputs)
    if given is None or isinstance(given, str) or is_native(given) or hasattr(given, "matvec"):
        return None
    if matrices.bands is None:
        return given
    from scipy.sparse import dia_array

    lower, upper = matrices.bands
    n = len(problem.y0)

    def whole(t: float, y: Array, *args: Any) -> Any:
        bands = np.asarray(given(t, y, *args) if callable(given) else given, dtype=float)
        return dia_array((bands, upper - np.arange(lower + upper + 1)), (n, n)).tocsr()

    return whole


def _dfdp(given: Any, problem: Description, names: Sequence[ParameterName]) -> Any:
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


def _default_sizes(names: Sequence[ParameterName], problem: Description, y0: Array, weights: Weights) -> Array:
    """|p|, 1 of a parameter that is zero; of initial values at least atol / rtol."""
    values = np.abs(values_of(problem.args, y0, names))
    floor = np.broadcast_to(weights.threshold, y0.shape)
    for j, one in enumerate(names):
        if one.kind != "args":
            values[j] = max(values[j], floor[one.index])
    values[values == 0] = 1
    return values


def _absolute(y0: Array, weights: Weights) -> Array:
    """The absolute tolerances of y. Pure relative control, atol = 0, is not possible for S, which may begin at 0: then
    that of y at the start."""
    absolute = weights.rtol * np.broadcast_to(weights.threshold, y0.shape)
    largest = np.abs(y0).max(initial=0) or 1.0
    relative = weights.rtol * np.where(y0 == 0, largest, np.abs(y0))
    return np.where(absolute == 0, relative, absolute)
