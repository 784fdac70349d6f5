"""Breakpoints: times at which f may jump, and what the solution does there."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import function, items, number, shown, warn
from .._functions.compiled import is_native
from .inputs import Input


class Breakpoint(NamedTuple):
    """A time, and its action ``action(t, y, *args) -> y_new`` or None."""

    t: float
    action: Any


def to_breakpoints(name: str, given: object) -> list[Breakpoint]:
    """Breakpoints from times and pairs (t, action), or from a dict of such pairs, checked."""
    if isinstance(given, Iterator):
        raise TypeError(f"{name} are read more than once, and an iterator cannot be: give list({name})")
    listed = items(given.items() if isinstance(given, Mapping) else given)
    if listed is None:
        raise TypeError(
            f"{name} must be a list of times or of pairs (t, action), or a dict of actions by time, got {shown(given)}"
        )
    return [_one(name, entry) for entry in listed]


def _one(name: str, entry: Any) -> Breakpoint:
    t, action = entry, None
    if isinstance(entry, (tuple, list)):
        if len(entry) != 2:
            raise ValueError(f"{name} must be times or pairs (t, action), got {shown(entry)}")
        t, action = entry
    if action is not None and not is_native(action):
        function(f"the action in {name}", action, "action(t, y)")
    if np.ndim(t):
        raise TypeError(f"{name} are times one by one; one action for many times is dict.fromkeys(times, action)")
    time = number(f"a time in {name}", t)
    if not math.isfinite(time):
        raise ValueError(f"a time in {name} must be finite, got {shown(t)}")
    return Breakpoint(time, action)


def warn_of_idle_actions(given: object, t_span: tuple[float, float]) -> None:
    """Warn of actions outside an interval, such as doses after its end, which a run over it does not take; not of
    those that a problem has already."""
    if not isinstance(given, Mapping) and all(type(one) is Breakpoint for one in items(given) or ()):
        return
    points, low, high = to_breakpoints("breakpoints", given), min(t_span), max(t_span)
    outside = [point.t for point in points if point.action is not None and not low <= point.t <= high]
    if outside:
        one = f"The action in breakpoints at t = {outside[0]:g} is"
        several = f"{len(outside)} actions in breakpoints, the first at t = {outside[0]:g}, are"
        warn(f"{several if outside[1:] else one} outside t_span = {t_span} and not taken in a run over it")


def of_inputs(inputs: Sequence[Input]) -> list[Breakpoint]:
    """The times at which the inputs jump."""
    return [Breakpoint(t, None) for one in inputs if one.breakpoints for t in one.times.tolist()]


def ordered(points: Iterable[Breakpoint], t0: float, tf: float) -> list[Breakpoint]:
    """Return the breakpoints from t0 to tf in the order of integration; actions at one time keep their order."""
    low, high = min(t0, tf), max(t0, tf)
    inside = [point for point in points if low <= point.t <= high]
    return sorted(inside, key=lambda point: point.t if tf >= t0 else -point.t)
