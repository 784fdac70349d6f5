"""Events: functions whose sign changes along the solution are located."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from types import FunctionType
from typing import Any, Literal, cast

import numpy as np

from .._base.arguments import (
    Array,
    call_name,
    encodable,
    flag,
    function,
    number,
    positive_integer,
    shown,
    warn,
    warn_of_order,
)
from .._base.suggestions import naming_arguments, nearest
from .._base.types import EventFunction, EventsLike, Function
from .._functions.compiled import CompiledFunction, is_native, to_native
from .._functions.layout import ArgumentLayout
from .core_problem import EventSpec, VectorSpec


@naming_arguments
class Event:
    """A function of the solution whose zeros are located.

    A plain function with the attributes `terminal` and `direction`, as SciPy takes it, works too.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> float``, with y of shape (n,). Its sign changes are events; a touch
        without a sign change is not. One that returns True or False is a condition, whose changes are events: True
        counts as rising. A function that is exactly 0 for some time occurs once, where that begins. NaN is an error.
    terminal : bool or int, default False
        True ends the integration at the first occurrence, a positive integer at that occurrence.
    direction : float, default 0
        Find only zeros through which `fun` rises (positive) or falls (negative) in the direction of integration.
    action : callable, optional
        ``action(t, y, *args) -> y_new`` of shape (n,): the solution jumps there (impact, switching, dosing) and
        continues from y_new. The output has both states at the same t; ``sol(t)`` gives the later one there. The event
        is not reported again until it has left zero, which the action itself may do. With a singular mass matrix
        algebraic components of y_new follow from the others. No action is taken at an occurrence that ends the
        integration. `y_events` holds the states before their own actions.
        Events that accumulate, like the impacts of a ball that comes to rest, need a `terminal` count.
    rehold : bool, default True
        After the action, invariants without a demanded value are held at their values at y_new; False: at the old ones,
        which y_new must have. Demanded values of invariants of a later level, such as velocity constraints, are first
        imposed on y_new: so that an impact on one body of a mechanism is transmitted through the joints.
    at_start : bool, default False
        Whether to report an event that is exactly zero at t0, as SciPy does. If so, it is the first in `t_events`,
        counts for `terminal`, and has the direction in which the first step leaves zero. False: it does not occur until
        it has left zero, so that a run that starts at an event does not find it again. Not possible with an `action`.
    samples : int or 'adaptive', optional
        The least number of equally spaced points inside each step at which `fun` is evaluated to find sign changes.
        'adaptive': enough points to resolve `fun` along the step by Chebyshev interpolation, from which all of its
        roots follow: from 9 for a smooth function to hundreds around a kink. Default: as many points as the degree of
        the method's continuous extension, at least 3; and 'adaptive' in those steps in which `fun`, if it is as steep
        somewhere as between the steepest two of these, could reach zero and return between others.
    touching : bool, default False
        With ``method="taylor"``: whether a zero of `fun` without a change of sign, to roundoff, is an event too. Other
        methods cannot tell it from a near miss.
    name : str, optional
        What messages, tables and ``Experiment(event_times=)`` call the event. Default: the name of `fun`.
    at_jumps : bool, default True
        Whether a change of sign by a jump is an occurrence: where the action of another event, or of a breakpoint,
        carries the solution over the surface `fun` = 0, once for each jump, at its time, with `direction`. The action
        of this event then follows; if it is terminal, the run ends with the state after the jump.

    Notes
    -----
    Roots are sign changes of `fun` along the continuous solution, to two units in the last place of t; 'adaptive' finds
    all sign changes if `fun` rises above 1e-11 of its largest value in the step on both sides of each. A pair of roots
    is missed only if `fun` shows nothing of it at the points of the step: a condition that is True between two of them,
    a pulse on a constant. Write ``y[0] - 1`` for ``y[0] > 1`` where a pair may be shorter than a step. With
    ``method="taylor"`` `fun` is expanded along the polynomial of the step, if it can be traced and has no branches:
    then every sign change is found, without samples; roots closer than 1e-8 of the step count once.

    Actions at one time follow one another: those of the events that occur there, in the order of the list, then those
    at breakpoints, each followed by those of the events that it sets off. More than 100 in a row, each set off by the
    one before, are an error that names the events. For events that depend on one another in other ways, such as by
    priorities or delays, see `Roots`.

    Examples
    --------
    >>> import invariode as iv
    >>> ground = iv.Event(lambda t, y: y[0], terminal=True, direction=-1)
    >>> sol = iv.solve_ivp(lambda t, y: [y[1], -9.81], (0, 10), [1.0, 0.0], events=ground)
    >>> (sol.status, float(sol.t_events[0][0].round(4)))  # falls for √(2 / 9.81)
    (1, 0.4515)
    """

    def __init__(
        self,
        fun: EventFunction,
        terminal: bool | int = False,
        direction: float = 0,
        action: Function | None = None,
        rehold: bool = True,
        at_start: bool = False,
        samples: int | Literal["adaptive"] | None = None,
        touching: bool = False,
        name: str | None = None,
        at_jumps: bool = True,
    ) -> None:
        if not callable(fun) and not is_native(fun):
            raise TypeError(f"an event must be a function event(t, y), got {shown(fun)}")
        self.fun: Any = fun
        self.terminal = terminal
        self.direction = direction
        self.action: Any = action if action is None or is_native(action) else function("action", action, "action(t, y)")
        self.rehold = flag("rehold", rehold)
        self.at_start = flag("at_start", at_start)
        if self.at_start and self.action is not None:
            raise ValueError(
                "at_start is not possible with an action: if the event is zero at t0, apply the action to y0 first"
            )
        self.samples = _samples(samples)
        self.touching = flag("touching", touching)
        self.at_jumps = flag("at_jumps", at_jumps)
        self.__name__ = call_name(fun, "event") if name is None else _name(name)
        terminal_count(self), direction_sign(self)
        if type(fun) is FunctionType:
            warn_of_order(self.__name__, fun, "g(t, y)")

    @staticmethod
    def plain(fun: FunctionType | CompiledFunction) -> Event:
        """Return the event of a function with all defaults, which takes less time than to check these."""
        event = Event.__new__(Event)
        event.__dict__.update(_DEFAULTS, fun=fun, __name__=call_name(fun, "event"))
        if isinstance(fun, FunctionType):
            warn_of_order(event.__name__, fun, "g(t, y)")
        return event

    def __call__(self, t: float, y: Any, *args: Any) -> float:
        value: float = self.fun(t, y, *args)
        return value

    def replaced(self, fun: Any) -> Event:
        """Return a copy of the event with another function, under the same name."""
        made = Event.__new__(Event)
        made.__dict__.update(self.__dict__, fun=fun)
        return made

    def __repr__(self) -> str:
        at_start = ", at_start=True" if self.at_start else ""
        at_start += "" if self.at_jumps else ", at_jumps=False"
        return f"Event({self.__name__}, terminal={self.terminal!r}, direction={self.direction!r}{at_start})"


@naming_arguments
class Roots:
    """Functions of the solution that are evaluated together, with one action for all that cross zero at a time.

    What the triggers of a model need that depend on one another: priorities, delays, conditions made of several
    comparisons. The list of events has one entry for each function, in the place of this.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args)`` -> `count` numbers, or truth values: these are conditions, as in `Event`. NaN is an error.
    count : int
        How many they are.
    on_roots : callable
        ``on_roots(t, y, which, directions, *args) -> y_new`` of shape (n,): called once for all functions that change
        sign at t. `which`, the numbers of these functions, ascending; `directions`, 1 for each that rises (becomes
        True) and -1 for each that falls. The integration continues from y_new, which may be y. Functions whose signs
        differ at y_new come in a further call at the same t, at most 100 in a row. A function at its root counts as 0:
        one that the call sends back to where it came from is no further root. Nothing is called at t0.
    rehold : bool, default True
        As in `Event`.
    names : list of str, optional
        What messages and tables call the functions. Default: the name of `fun` with their numbers.
    stateless : bool, default False
        True: the values of `fun` and `on_roots` depend on their arguments alone. Sensitivities then follow them, with
        derivatives formed as for `Event`.

    Notes
    -----
    Unless they are `stateless`, `fun` may use what `on_roots` remembers, such as ``t - due`` with the time at which a
    delayed action is due: it is evaluated again after each call. What they remember belongs to one run: give each run
    functions of its own. Sensitivities and gradients need `stateless`.

    The form is that of the root functions of SUNDIALS (Hindmarsh and Shampine, SAND 80-0180, 1980).

    Examples
    --------
    >>> import invariode as iv
    >>> def fun(t, y):
    ...     return [y[0] - 1.0, t - 2.5]
    >>> def on_roots(t, y, which, directions):
    ...     if which[0] == 1:
    ...         return [y[0] + 10.0]
    ...     return [0.0] if directions[0] > 0 else y
    >>> sol = iv.solve_ivp(lambda t, y: [1.0], (0, 3), [0.0], events=iv.Roots(fun, 2, on_roots))
    >>> [t.round(6).tolist() for t in sol.t_events]  # the jump at 2.5 crosses y = 1; what follows leads back
    [[1.0, 2.0, 2.5, 2.5], [2.5]]
    """

    def __init__(
        self,
        fun: Any,
        count: int,
        on_roots: Callable[..., Any],
        *,
        rehold: bool = True,
        names: Sequence[str] | None = None,
        stateless: bool = False,
    ) -> None:
        if not callable(fun) and not is_native(fun):
            raise TypeError(f"fun of Roots must be a function fun(t, y), got {shown(fun)}")
        self.fun: Any = fun
        self.count = positive_integer("count of Roots", count)
        self.on_roots = function("on_roots", on_roots, "on_roots(t, y, which, directions)")
        self.rehold, self.stateless = flag("rehold", rehold), flag("stateless", stateless)
        #: The numbers of the functions of the latest call of `on_roots`, and their directions.
        self.latest: tuple[Array, Array] = (np.zeros(0, dtype=int),) * 2
        self.__name__ = call_name(fun, "roots")
        if names is None:
            self.names = [f"{self.__name__}[{k}]" for k in range(self.count)]
        else:
            self.names = [_name(name) for name in names]
            if len(self.names) != self.count:
                raise ValueError(f"names of Roots must be {self.count}, one for each function, got {len(self.names)}")

    @property
    def is_differentiable(self) -> bool:
        """True if sensitivities follow the action."""
        return self.stateless

    def derivatives(self, of: Callable[..., Any], start: Array) -> Any:
        """Return the derivatives of `fun` and of the action, as sensitivities use them, if these functions
        remember something; None if they do not. `of` makes the derivatives of a function; `start` is S at the start,
        (k, n)."""
        return None

    def remembered(self) -> Any:
        """Return what the derivatives of the latest action need besides its roots."""
        return None

    def recall(self, which: Array, directions: Array, remembered: Any) -> None:
        """Make the action at these roots the latest one again, for its derivatives."""
        self.latest = which, directions

    def of_run(self, t: float, y: Array, args: tuple[Any, ...], memory: dict[int, Any]) -> Roots:
        """Return functions for one run, which starts at (t, y): a copy with a memory of its own, if the class has any.
        `memory`: what several `Roots` of the run have in common, by the id of the original."""
        return copy.copy(self)

    def state(self) -> Any:
        """Return what the functions remember of their run, for its extension: what JSON can hold."""
        return None

    def restore(self, state: Any) -> None:
        """Remember the run of this state, as `state` returned it, whose extension begins."""

    def events(self) -> list[Event]:
        """Return one event for each function."""
        return [RootOf(self, k) for k in range(self.count)]

    def __repr__(self) -> str:
        return f"Roots({self.__name__}, {self.count})"


class RootOf(Event):
    """An event that is one function of a `Roots`."""

    def __init__(self, roots: Roots, number: int) -> None:
        super().__init__(_Component(roots.fun, number), rehold=roots.rehold, name=roots.names[number])
        self.roots, self.number = roots, number


class _Component:
    """Single value of a function that has several."""

    def __init__(self, fun: Any, number: int) -> None:
        self.fun, self._number = fun, number

    def __call__(self, t: float, y: Any, *args: Any) -> Any:
        return self.fun(t, y, *args)[self._number]


class _OnRoots:
    """`on_roots` as the core calls it: the state, and after it the sign that each function takes on."""

    def __init__(self, roots: Roots) -> None:
        self.roots = roots

    def __call__(self, t: float, state: Array, *args: Any) -> Any:
        roots = self.roots
        signs = state[-roots.count :].real.astype(int)
        which = np.flatnonzero(signs)
        roots.latest = which, signs[which]
        return roots.on_roots(t, state[: -roots.count], which, signs[which], *args)


def roots_among(events: Sequence[Event]) -> list[Roots]:
    """Return the `Roots` whose functions are among these events, each once."""
    return [*{id(one.roots): one.roots for one in events if isinstance(one, RootOf)}.values()]


def of_one_run(events: Sequence[Event], t: float, y: Array, args: tuple[Any, ...]) -> list[Event]:
    """Return the events with `Roots` of their own for a run that starts at (t, y)."""
    memory: dict[int, Any] = {}
    own = {id(one): one.of_run(t, y, args, memory).events() for one in roots_among(events)}
    return [own[id(one.roots)][one.number] if isinstance(one, RootOf) else one for one in events]


def acts(event: Event) -> bool:
    """Return whether the solution may jump where the event occurs."""
    return event.action is not None or isinstance(event, RootOf)


def titled(name: str) -> str:
    """Return what messages call an event of this name: 'event bounce', and 'event' if its function is called so."""
    return name if name.partition(" ")[0] == "event" else f"event {name}"


def _name(name: object) -> str:
    if not isinstance(name, str) or not name:
        raise TypeError(f"name of an event must be a string that is not empty, got {shown(name)}")
    return encodable(name)


def _samples(samples: object) -> int | Literal["adaptive"] | None:
    if samples is None:
        return None
    if isinstance(samples, str):
        if samples == "adaptive":
            return "adaptive"
        raise ValueError(f"samples of an event must be a positive integer or 'adaptive', got {shown(samples)}")
    return positive_integer("samples of an event", samples)


def _called(name: object, event: Event) -> Event:
    """Return an event of a dict under its key."""
    named = copy.copy(event)
    named.__name__ = _name(name)
    return named


def to_events(events: EventsLike) -> list[Event]:
    """The events in the form that the solver takes, checked."""
    if events is None:
        return []
    if type(events) is FunctionType or isinstance(events, CompiledFunction):  # the common cases
        return [_from_function(events)]
    if isinstance(events, Mapping):
        return [_called(name, event) for name, one in events.items() for event in to_events(one)]
    if callable(events) or is_native(events) or isinstance(events, Roots):
        events = [cast("EventFunction", events)]
    elif not isinstance(events, Sequence) or isinstance(events, str):
        raise TypeError(f"events must be a function event(t, y) or a list or dict of these, got {shown(events)}")
    found: list[Event] = []
    for event in events:
        if isinstance(event, Roots):
            found += event.events()
        else:
            found.append(event if isinstance(event, Event) else _from_function(cast("EventFunction", event)))
    return found


#: Up to here doubles are integers, and every count fits into the core's.
_MOST_OCCURRENCES = 2**53

_ATTRIBUTES = ("terminal", "direction", "action", "rehold", "at_start", "samples", "touching", "at_jumps")


def _from_function(fun: EventFunction) -> Event:
    stated, misspelt = _looked_at(tuple(getattr(fun, "__dict__", ())))
    for name, near in misspelt:
        warn(f"the attribute {name} of {call_name(fun, 'an event')} has no meaning; did you mean {near}?")
    if not stated and (type(fun) is FunctionType or isinstance(fun, CompiledFunction)):  # the common cases
        return Event.plain(fun)
    return Event(fun, **{name: getattr(fun, name) for name in _ATTRIBUTES if hasattr(fun, name)})


@lru_cache(maxsize=64)
def _looked_at(names: tuple[str, ...]) -> tuple[bool, list[tuple[str, str]]]:
    """Return whether there are attributes of events among some, and those that are only like one, each with the one
    that it is most like."""
    misspelt = [(one, near) for one in names if one not in _ATTRIBUTES and (near := nearest(one, _ATTRIBUTES))]
    return any(one in _ATTRIBUTES for one in names), misspelt


def terminal_count(event: Event) -> int:
    """The occurrence that ends the integration, 0 for none (SciPy's rule)."""
    terminal = event.terminal
    if terminal is False or terminal is None:  # the common cases
        return 0
    try:
        count = number("terminal", terminal)
    except (TypeError, ValueError):
        count = -1
    if not 0 <= count < _MOST_OCCURRENCES or count != int(count):
        raise ValueError(
            "The `terminal` attribute of each event must be a boolean or positive integer, below 2**53; that of "
            f"{event.__name__} is {shown(terminal)}"
        )
    return int(count)


def direction_sign(event: Event) -> int:
    """The direction as -1, 0 or 1."""
    direction = event.direction
    if type(direction) is not int:
        direction = number(f"direction of {event.__name__}", direction)
    return int(direction > 0) - int(direction < 0)


#: The attributes of an event that states nothing besides its function.
_DEFAULTS: Mapping[str, Any] = vars(Event(lambda t, y: 0.0))


def vector_specs(events: Sequence[Event], n: int, p: ArgumentLayout) -> list[VectorSpec]:
    """Return the functions of several roots among the events, as the core takes them."""
    found = []
    for first, event in enumerate(events):
        if not isinstance(event, RootOf) or event.number != 0:
            continue
        roots = event.roots
        fun = to_native(f"fun of {roots!r}", roots.fun, n, roots.count, p)
        found.append(VectorSpec(fun, first, roots.count, roots.__name__, _OnRoots(roots)))
    return found


def event_spec(event: Event, n: int, p: ArgumentLayout) -> EventSpec:
    """The event as the core takes it; n and p for native ones."""
    if isinstance(event, RootOf):
        return EventSpec(None, 0, 0, event.__name__, None, event.rehold, 0)
    fun = to_native(titled(event.__name__), event.fun, n, 1, p, event=True)
    action = to_native(f"the action of {titled(event.__name__)}", event.action, n, n, p)
    samples = -1 if event.samples == "adaptive" else event.samples or 0
    count, sign = terminal_count(event), direction_sign(event)
    about = {"touching": event.touching, "at_jumps": event.at_jumps}
    return EventSpec(fun, count, sign, event.__name__, action, event.rehold, samples, **about)
