"""Functions of the unknowns of F, as the reduced problem calls them with its state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from .._base.arguments import Array, shown
from .._base.types import OnFailure
from .._functions.layout import layout_of
from .._problem.breakpoints import Breakpoint, to_breakpoints
from .._problem.events import Event

#: ``consistent(t, state, (y, yp), (new y, new yp), args)``: the state for unknowns that an action has changed.
Consistent: TypeAlias = Callable[[float, Array, tuple[Array, Array], tuple[Array, Array], Sequence[Any]], Array]


class ThroughUnknowns:
    """Makes functions of (t, state, *args) from functions of (t, y, *args).

    - `unknowns`: y and y' as functions of the state, as in `Unknowns`
    - `consistent`: see `Consistent`
    - `p`: the parameters of a call without arguments
    """

    def __init__(self, unknowns: Any, consistent: Consistent, p: Array) -> None:
        self._unknowns, self._consistent, self._p = unknowns, consistent, p

    def y(self, t: Any, state: Any, args: Sequence[Any] = ()) -> Array:
        """Return the unknowns at a state; also of complex numbers, and of those with which functions are traced."""
        if not _plain(t, state):
            numbers = [one for given in args for one in np.ravel(np.asarray(given, dtype=object))] if args else self._p
            general: Array = self._unknowns.y.general(t, state, numbers)
            return general
        found: Array = self._unknowns.y.at(t, state, layout_of(args).numbers if args else self._p)
        return found

    def yp(self, t: float, state: Array, args: Sequence[Any] = ()) -> Array:
        """Return their derivatives."""
        found: Array = self._unknowns.yp.at(t, state, layout_of(args).numbers if args else self._p)
        return found

    def event(self, made: Event) -> Event:
        """Return the event of the state with the attributes of an event of the unknowns."""
        fun, action = made.fun, made.action

        def of_state(t: Any, state: Any, *args: Any) -> Any:
            found = fun(t, self.y(t, state, args), *args)
            return float(found) if _plain(t, state) else found

        of_state.__name__ = made.__name__
        found = made.replaced(of_state)
        if action is not None:
            found.action = self.action(action)
        return found

    def action(self, action: Callable[..., Any]) -> Callable[..., Array]:
        """Return the action on the state of an action on the unknowns."""

        def of_state(t: float, state: Array, *args: Any) -> Array:
            y, yp = self.y(t, state, args), self.yp(t, state, args)
            returned = action(t, y.copy(), *args)
            new, slopes = returned if isinstance(returned, tuple) and len(returned) == 2 else (returned, yp)
            return self._consistent(t, state, (y, yp), (_vector(new, y), _vector(slopes, y)), args)

        return of_state

    def options(self, options: Any) -> OnFailure | None:
        """Put the functions among the options of a run in terms of the state, and return its `on_failure`: the reduced
        problem returns its failures, since messages and checks of the equations come first."""
        on_failure: OnFailure | None = options.pop("on_failure", None)
        options["on_failure"] = "return"
        if (callback := options.get("callback")) is not None:
            options["callback"] = self.callback(callback)
        if (points := options.get("breakpoints")) is not None:
            options["breakpoints"] = self.breakpoints(points)
        return on_failure

    def callback(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback of the state."""
        return lambda t, state: callback(t, self.y(t, state))

    def breakpoints(self, given: Any) -> list[Any]:
        """Return breakpoints with actions on the state."""
        points: list[Breakpoint] = to_breakpoints("breakpoints", given)
        return [one.t if one.action is None else (one.t, self.action(one.action)) for one in points]


def _plain(t: Any, state: Any) -> bool:
    """Return whether these are real numbers."""
    return isinstance(t, (float, int)) and isinstance(state, np.ndarray) and state.dtype.kind == "f"


def _vector(given: Any, like: Array) -> Array:
    found = np.asarray(given, dtype=float)
    if found.shape != like.shape:
        raise ValueError(f"an action must return y of shape {like.shape}, or a pair (y, yp), got {shown(given)}")
    return found
