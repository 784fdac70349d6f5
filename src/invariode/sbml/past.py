"""Values of the past that events use, as states.

Events see the state alone. A value x(t - d) in one is therefore a state w of its own, with

    w' = x'(t - d),   w = x(-d) at the start,

which does not follow jumps of x: so x must not be a variable that an event assigns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from .formulas import Expression
from .library import UnsupportedError
from .reading import EventRule, ModelContents


def with_past_as_states(contents: ModelContents) -> None:
    """Replace each delay() in events by a new state.

    Raises UnsupportedError: An event assigns a variable whose past an event uses.
    """
    found: dict[Expression, str] = {}

    def symbol(one: Expression) -> Expression:
        if one not in found:
            found[one] = _state(contents, one, f"delayed value {len(found) + 1} of events")
        return Expression("name", (), found[one])

    contents.events = [_replaced(rule, symbol) for rule in contents.events]


def _replaced(rule: EventRule, symbol: Callable[[Expression], Expression]) -> EventRule:
    def inside(one: Expression) -> Expression:
        return symbol(one) if one.op == "delay" else one._replace(arguments=(*map(inside, one.arguments),))

    return replace(
        rule,
        trigger=inside(rule.trigger),
        priority=None if rule.priority is None else inside(rule.priority),
        delay=None if rule.delay is None else inside(rule.delay),
        assignments={name: inside(value) for name, value in rule.assignments.items()},
    )


def _state(contents: ModelContents, one: Expression, name: str) -> str:
    """Return the symbol of a new state, the delayed value."""
    value, delay = one.arguments
    assigned = {target for rule in contents.events for target in rule.assignments}
    if jumping := _symbols(contents, value, set()) & assigned:
        raise UnsupportedError("delay", f"an event uses delay() of {min(jumping)!r}, which an event assigns")
    if value.op != "name":
        contents.rules[f"{name}, now"] = value
        value = Expression("name", (), f"{name}, now")
    contents.values[name] = 0.0
    contents.initial[name] = Expression("delay", (value, delay))
    contents.rates[name] = Expression("delay", (Expression("rate_of", (), value.value), delay))
    return name


def _symbols(contents: ModelContents, one: Expression, seen: set[str]) -> set[str]:
    """Return the symbols that a value depends on, directly or by rules."""
    for name in one.names() - seen:
        seen.add(name)
        if name in contents.rules:
            _symbols(contents, contents.rules[name], seen)
        if name in contents.species:
            seen.add(contents.species[name].compartment)
    return seen
