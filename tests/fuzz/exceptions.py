"""Runs in which one of the user's functions raises, at a call of its own choice.

The oracle: the exception that comes out is the one that was raised, and the next run is right.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
from methods import GENERAL

import invariode as iv

__all__ = ["raising_run"]


class DeliberateError(Exception):
    """Raised by a function of the user's."""


class Functions:
    """The functions of a problem, which count their calls and raise at one of them."""

    def __init__(self, name: str = "", at: int = 0) -> None:
        self.calls: Counter[str] = Counter()
        self.raised = DeliberateError(name, at)
        self._victim = name, at

    def seen(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def counted(t: Any, *args: Any) -> Any:
            if any(np.iscomplexobj(one) for one in (t, *args)):  # whether a function takes complex y is tried
                return function(t, *args)
            self.calls[name] += 1
            if (name, self.calls[name]) == self._victim:
                raise self.raised
            return function(t, *args)

        return counted


def _options(random: Random) -> tuple[str, dict[str, tuple[Callable[..., Any], dict[str, Any]]], dict[str, Any]]:
    """A method; functions with the option that each is given as; and options without functions.

    The problem is a decay chain y1 → y2 → y3, whose sum is conserved, within bounds that it comes close to.
    """
    method = random.choice(GENERAL)
    J = np.array([[-3.0, 0.0, 0.0], [3.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    functions: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {"fun": (lambda t, y: J @ y, {})}
    options: dict[str, Any] = {"rtol": 10 ** -random.uniform(2, 6)}
    if random.random() < 0.8:
        functions["invariants"] = lambda t, y: y.sum(), {"jac": random.random() < 0.5}
    if random.random() < 0.3:
        functions["dissipated"] = lambda t, y: y[0] ** 2, {}
    if random.random() < 0.5:
        functions["event"] = lambda t, y: y[0] - 0.5, {"action": random.random() < 0.5}
    if random.random() < 0.3:
        functions["callback"] = lambda t, y: False, {}
    if "jac" in iv.METHODS[method].options and random.random() < 0.5:
        functions["jac"] = lambda t, y: J, {}
    if "mass" in iv.METHODS[method].options and method != "ode23s" and random.random() < 0.3:
        functions["mass"] = lambda t: np.eye(3), {}
    if random.random() < 0.7:
        options["nonnegative"] = True
    if random.random() < 0.3:
        options["breakpoints"] = [random.uniform(0.1, 0.9)]
    if random.random() < 0.5:
        options["t_eval"] = np.linspace(0, 1, 4)
    return method, functions, options


def _run(method: str, functions: dict[str, tuple[Any, dict[str, Any]]], options: dict[str, Any], seen: Any) -> Any:
    given, laws = dict(options), []
    if "invariants" in functions:
        g, form = functions["invariants"]
        jac = seen("jac of g", lambda t, y: np.ones((1, 3))) if form["jac"] else None
        laws.append(iv.Invariants(seen("invariants", g), jac=jac))
    if "dissipated" in functions:
        laws.append(iv.Dissipated(seen("dissipated", functions["dissipated"][0])))
    if laws:
        given["invariants"] = laws
    if "event" in functions:
        event, form = functions["event"]
        action = seen("action", lambda t, y: y * np.array([1.0, 0.5, 1.0])) if form["action"] else None
        given["events"] = iv.Event(seen("event", event), action=action)
    given |= {name: seen(name, functions[name][0]) for name in ("callback", "jac", "mass") if name in functions}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return iv.solve_ivp(seen("fun", functions["fun"][0]), (0, 1), [1.0, 0.0, 0.0], method, **given)


def raising_run(random: Random) -> str | None:
    """Makes one. What is wrong with what comes out, or None."""
    method, functions, options = _options(random)
    told = f"method={method}, {sorted(functions)}, {options}"
    whole = Functions()
    right = _run(method, functions, options, whole.seen)
    name = random.choice(sorted(whole.calls))
    broken = Functions(name, random.randint(1, whole.calls[name]))
    try:
        _run(method, functions, options, broken.seen)
    except DeliberateError as error:
        if error is not broken.raised:
            return f"another exception than the one raised; {told}"
    except BaseException as error:
        return f"{type(error).__name__}: {error} instead of {broken.raised}; {told}"
    else:
        return f"{broken.raised} was lost; {told}"
    again = _run(method, functions, options, Functions().seen)
    return None if np.array_equal(again.y, right.y) else f"the next run differs; {told}"
