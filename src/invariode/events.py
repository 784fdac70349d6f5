"""Events: functions whose sign changes along the solution are located."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from ._arguments import call_name

__all__ = ["Event", "to_events"]


class Event:
    """A function of the solution whose zeros are located.

    A plain function with the attributes `terminal` and `direction`, as SciPy takes it, is as good.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> float``, with y of shape (n,). Its sign changes are events; a touch
        without a sign change is none. An event that is zero at the start is reported only after it has left zero.
        NaN is an error.
    terminal : bool or int, default False
        True ends the integration at the first occurrence, a positive integer at that occurrence.
    direction : float, default 0
        Only zeros through which `fun` rises (positive) or falls (negative) in the direction of integration.
    """

    def __init__(self, fun: Callable[..., float], terminal: bool | int = False, direction: float = 0) -> None:
        if not callable(fun):
            raise TypeError(f"an event must be a function event(t, y), got {fun!r}")
        self.fun = fun
        self.terminal = terminal
        self.direction = direction
        self.__name__ = call_name(fun, "event")

    def __call__(self, t: float, y: Any, *args: Any) -> float:
        return self.fun(t, y, *args)

    def __repr__(self) -> str:
        return f"Event({self.__name__}, terminal={self.terminal!r}, direction={self.direction!r})"


def to_events(events: Callable[..., float] | Iterable[Callable[..., float]] | None) -> list[Event]:
    """The events in the form that the solver takes, checked."""
    if events is None:
        return []
    if callable(events):
        events = [events]
    elif not isinstance(events, Sequence):
        raise TypeError(f"events must be a function event(t, y) or a list of these, got {events!r}")
    return [event if isinstance(event, Event) else _from_function(event) for event in events]


def _from_function(fun: Callable[..., float]) -> Event:
    return Event(fun, getattr(fun, "terminal", False), getattr(fun, "direction", 0))


def terminal_count(event: Event) -> int:
    """The occurrence that ends the integration, 0 for none (SciPy's rule)."""
    terminal = event.terminal
    if not terminal:
        return 0
    try:
        count = int(terminal)
    except (TypeError, ValueError):
        count = -1
    if count != terminal or count < 0:
        raise ValueError(f"terminal of {event.__name__} must be a boolean or a positive integer, got {terminal!r}")
    return count


def direction_sign(event: Event) -> int:
    """The direction as -1, 0 or 1."""
    direction = event.direction
    try:
        return int(direction > 0) - int(direction < 0)
    except TypeError:
        raise TypeError(f"direction of {event.__name__} must be a number, got {direction!r}") from None
