"""Events: functions whose sign changes along the solution are located."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, cast

from .._base.arguments import Array, call_name, encodable, flag, function, number, positive_integer, shown
from .._base.types import EventFunction, EventsLike, Function
from .._functions.compiled import is_native, to_native


class Event:
    """A function of the solution whose zeros are located.

    A plain function with the attributes `terminal` and `direction`, as SciPy takes it, works too.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> float``, with y of shape (n,). Its sign changes are events; a touch
        without a sign change is not. NaN is an error.
    terminal : bool or int, default False
        True ends the integration at the first occurrence, a positive integer at that occurrence.
    direction : float, default 0
        Find only zeros through which `fun` rises (positive) or falls (negative) in the direction of integration.
    action : callable, optional
        ``action(t, y, *args) -> y_new`` of shape (n,): the solution jumps there (impact, switching, dosing) and
        continues from y_new. The output has both states at the same t; ``sol(t)`` gives the later one there. The event
        is not reported again until it has left zero. No action is taken at an occurrence that ends the integration.
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
        Default: the degree of the method's continuous extension, at least 3. 'adaptive': enough points to resolve `fun`
        along the step by Chebyshev interpolation, from which all of its roots follow: from 9 for a smooth function to
        hundreds around a kink.
    touching : bool, default False
        With ``method="taylor"``: whether a zero of `fun` without a change of sign, to roundoff, is an event too. Other
        methods cannot tell it from a near miss.
    name : str, optional
        What messages, tables and ``Experiment(event_times=)`` call the event. Default: the name of `fun`.

    Notes
    -----
    An odd number of roots between two neighbouring points is seen as one, an even number as none. Roots are sign
    changes of `fun` along the continuous solution, to two units in the last place of t; 'adaptive' finds all sign
    changes if `fun` rises above 1e-11 of its largest value in the step on both sides of each. With ``method="taylor"``
    `fun` is expanded along the polynomial of the step, if it can be traced and has no branches: then every sign change
    is found, without samples; roots closer than 1e-8 of the step count once.

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
        self.__name__ = call_name(fun, "event") if name is None else _name(name)

    def __call__(self, t: float, y: Any, *args: Any) -> float:
        value: float = self.fun(t, y, *args)
        return value

    def replaced(self, fun: Any) -> Event:
        """The same event of another function, with its name."""
        made = Event.__new__(Event)
        made.__dict__.update(self.__dict__, fun=fun)
        return made

    def __repr__(self) -> str:
        at_start = ", at_start=True" if self.at_start else ""
        return f"Event({self.__name__}, terminal={self.terminal!r}, direction={self.direction!r}{at_start})"


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


def to_events(events: EventsLike) -> list[Event]:
    """The events in the form that the solver takes, checked."""
    if events is None:
        return []
    if callable(events) or is_native(events):
        events = [cast("EventFunction", events)]
    elif not isinstance(events, Sequence):
        raise TypeError(f"events must be a function event(t, y) or a list of these, got {shown(events)}")
    return [event if isinstance(event, Event) else _from_function(event) for event in events]


#: Up to here doubles are integers, and every count fits into the core's.
_MOST_OCCURRENCES = 2**53

_ATTRIBUTES = ("terminal", "direction", "action", "rehold", "at_start", "samples", "touching")


def _from_function(fun: EventFunction) -> Event:
    attributes = {name: getattr(fun, name) for name in _ATTRIBUTES if hasattr(fun, name)}
    return Event(fun, **attributes)


def terminal_count(event: Event) -> int:
    """The occurrence that ends the integration, 0 for none (SciPy's rule)."""
    terminal = event.terminal
    if terminal is None:
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
    direction = number(f"direction of {event.__name__}", event.direction)
    return int(direction > 0) - int(direction < 0)


class EventSpec(NamedTuple):
    """An event in the form that the core takes."""

    fun: Any
    terminal: int  # the occurrence that ends the integration, 0 for none
    direction: int
    name: str
    action: Any
    rehold: bool
    samples: int  # 0: the usual number, -1: adaptive
    series: Any = None  # along polynomials
    touching: bool = False


def event_spec(event: Event, n: int, p: Array) -> EventSpec:
    """The event as the core takes it; n and p for native ones."""
    fun = to_native(f"event {event.__name__}", event.fun, n, 1, p, event=True)
    action = to_native(f"the action of event {event.__name__}", event.action, n, n, p)
    samples = -1 if event.samples == "adaptive" else event.samples or 0
    count, sign = terminal_count(event), direction_sign(event)
    return EventSpec(fun, count, sign, event.__name__, action, event.rehold, samples, touching=event.touching)
