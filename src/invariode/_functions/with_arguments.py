"""Functions of (t, y) with their arguments: Python functions, compiled ones and machine code, called alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from .._base.arguments import Array
from .compiled import CompiledFunction, CoreFunction, NativeWithInputs, as_python, event_value, is_native, to_native
from .layout import layout_of, numbers_at_places, place_of, with_numbers


class ParameterPlace(Protocol):
    """A number among the arguments, or an initial value, on which no function depends directly."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def index(self) -> int: ...
    @property
    def item(self) -> int | None: ...


class Point(NamedTuple):
    """Point (t, y) at which F is defined."""

    t: float
    y: Array


def as_floats(args: tuple[Any, ...], names: Sequence[ParameterPlace]) -> dict[int, dict[int, float]]:
    """Return the parameters among the arguments as floats: an integer may be an index, a parameter may not."""
    places = [(one.index, one.item) for one in names if one.kind == "args"]
    changes: dict[int, dict[int, float]] = {}
    for (index, item), number in zip(places, numbers_at_places(args, places), strict=True):
        changes.setdefault(index, {})[item or 0] = float(number)
    return changes


def numbers_at(t: float, fun: Any, p: Array) -> Array:
    """Return the parameters of machine code: the values of inputs at t, then the numbers of the arguments."""
    if not isinstance(fun, NativeWithInputs):
        return p
    return np.concatenate([*(one.evaluate(np.array([t]))[0] for one in fun.inputs), p])


class WithArguments:
    """Function (t, y) -> F with its arguments, or with other values of the parameters."""

    def __init__(
        self, fun: Any, args: tuple[Any, ...], names: Sequence[ParameterPlace], m: int | None, called: str, event: bool
    ) -> None:
        self.args, self.names, self.called = args, names, called
        self._fun, self.m, self._event = fun, m, event
        self._own = [one for one in names if one.kind == "args"]
        #: Which of the parameters are in the arguments.
        self.own = np.array([one.kind == "args" for one in names], dtype=bool)
        places = [place_of(args, one.index, one.item) for one in self._own]
        self.p = np.zeros(len(names))
        self.p[self.own] = layout_of(args).numbers[places]

    def __call__(self, t: Any, y: Array, p: Array | None = None) -> Array:
        """The values (m,); t, y and p may be complex if F takes that."""
        return self.with_args(t, y, self.args if p is None else self._with(p[self.own]))

    @property
    def size(self) -> int:
        """Number of its values."""
        if self.m is None:
            raise ValueError(f"{self.called} fills an array: say how many values it has")
        return self.m

    def of_args(self, args: tuple[Any, ...]) -> WithArguments:
        """Return F with other arguments."""
        return WithArguments(self._fun, args, self.names, self.m, self.called, self._event)

    def with_args(self, t: Any, y: Array, args: tuple[Any, ...]) -> Array:
        """The values with other arguments."""
        inside = self._fun.fun if isinstance(self._fun, NativeWithInputs) else self._fun
        if is_native(inside) and not isinstance(inside, (CompiledFunction, CoreFunction)):
            return self._of_machine_code(t, y, args)
        given = [*self._inputs(t), *args]
        if isinstance(inside, CompiledFunction):
            return self._of_compiled(inside, t, y, given)
        return np.ravel(np.asarray(inside(t, y.copy(), *given)))

    def require_numbers(self, at: Point) -> None:
        """Raise a TypeError unless F also accepts floating-point values for integer parameters."""
        given = numbers_at_places(self.args, ((one.index, one.item) for one in self._own))
        for one, number in zip(self._own, given, strict=True):
            if not isinstance(number, (int, np.integer)):
                continue
            try:
                self.with_args(at.t, at.y, with_numbers(self.args, as_floats(self.args, [one])))
            except (TypeError, IndexError) as error:
                raise TypeError(
                    f"{self.called} has no derivative with respect to {one.name} = {number}, which has to be an "
                    f"integer ({error}): name the other parameters"
                ) from error

    def _with(self, p: Array) -> tuple[Any, ...]:
        changes: dict[int, dict[int, Any]] = {}
        for one, value in zip(self._own, p.tolist(), strict=True):
            changes.setdefault(one.index, {})[one.item or 0] = value
        return with_numbers(self.args, changes)

    def _inputs(self, t: Any) -> list[Any]:
        """Return the values of the inputs at t, in the shapes that F takes."""
        if not isinstance(self._fun, NativeWithInputs):
            return []
        rows = [one.evaluate(np.array([np.real(t)]))[0] for one in self._fun.inputs]
        return [row.reshape(shape)[()] for row, shape in zip(rows, self._fun.shapes, strict=True)]

    def _of_compiled(self, fun: CompiledFunction, t: Any, y: Array, given: list[Any]) -> Array:
        """Call the Python function of a compiled F with the arguments as it was traced or, failing that, with all
        numbers in one array, as numba takes it."""
        numbers = [np.concatenate([np.ravel(np.asarray(one)) for one in given])] if given else []
        out: Array | None = None
        if fun.inplace:
            out = np.full(self.size, np.nan, dtype=np.result_type(y, float, *numbers))
        filled = [] if out is None else [out]
        try:
            returned = fun.fun(t, y.copy(), *filled, *given)
        except (TypeError, IndexError):
            returned = fun.fun(t, y.copy(), *filled, *numbers)
        return out if out is not None else np.ravel(np.asarray(returned))

    def _of_machine_code(self, t: Any, y: Array, args: tuple[Any, ...]) -> Array:
        if np.iscomplexobj(t) or np.iscomplexobj(y) or self.m is None:
            raise TypeError(f"{self.called} is machine code for real numbers")
        arguments = layout_of(args)
        p = numbers_at(t, self._fun, arguments.numbers)
        if self._event:
            code = to_native(self.called, self._fun, len(y), 1, arguments, event=True)
            return np.array([event_value(code, t, np.ascontiguousarray(y), p)])
        return as_python(to_native(self.called, self._fun, len(y), self.m, arguments), self.m)(t, y, p)
