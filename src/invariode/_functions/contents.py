"""Contents of values: when two constants of machine code are the same, and when a function has captured other values.

Numbers, text, arrays and containers are compared by value. Functions are compared by their code, their defaults, the
contents of their closures and the globals that they use; other objects by the state with which they would be copied
(`object.__reduce_ex__`). Whatever cannot be taken apart like that is the same only as itself.
"""

from __future__ import annotations

import inspect
import itertools
import sys
from collections.abc import Iterator
from functools import partial
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

ATOMS = (type(None), bool, int, float, complex, str, bytes, np.generic, CodeType)
#: Values that cannot change: if the object is the same, so is its content.
_IMMUTABLE = (*ATOMS, ModuleType, type, BuiltinFunctionType, np.ufunc)

#: Functions of these packages are not copied.
_OTHERS = ("numpy", "scipy", "numba", "matplotlib", "pandas", "sympy", "builtins", "math", "cmath")


class _Opaque:
    """An object that is equal to itself only. The reference keeps its identity from being used again."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Opaque) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


def content(value: Any) -> Any:
    """Return the content of a value at this moment, as nested tuples that are equal for equal contents."""
    return Contents().of(value)


class Contents:
    """Takes values apart into nested tuples: numbers, text, arrays and containers by value, others by `other`."""

    def __init__(self) -> None:
        self._seen: dict[int, tuple[int, Any]] = {}  # values by identity, which lasts as long as they are kept
        self._count = itertools.count()
        self._module: str | None = None  # of the function whose captured values are taken apart

    def of(self, value: Any) -> Any:
        """Return the content of a value, of which no part is taken apart twice."""
        kind = type(value)
        if isinstance(value, ATOMS):
            return kind, value if kind in (int, bool, str, bytes) or isinstance(value, CodeType) else repr(value)
        if id(value) in self._seen:
            return "again", self._seen[id(value)][0]
        self._seen[id(value)] = next(self._count), value
        if isinstance(value, np.ndarray):
            entries = tuple(map(self.of, value.ravel().tolist())) if value.dtype == object else value.tobytes()
            return kind, value.dtype.str, value.shape, entries
        if kind in (list, tuple):
            return kind, tuple(map(self.of, value))
        if kind in (set, frozenset):  # in an order that does not depend on the process
            return kind, sorted(repr(self.of(one)) for one in value)
        if kind is dict:
            return kind, tuple((self.of(name), self.of(one)) for name, one in value.items())
        if isinstance(value, partial):
            return kind, self.of(value.func), self.of(value.args), self.of(value.keywords)
        return self.other(value)

    def other(self, value: Any) -> Any:
        """Return the content of a function or of another object, as it is in this process."""
        kind = type(value)
        if isinstance(value, (ModuleType, type, np.ufunc)):
            return _Opaque(value)
        if isinstance(value, MethodType):
            return kind, self.of(value.__func__), self.of(value.__self__)
        if isinstance(value, BuiltinFunctionType):
            owner = value.__self__
            return (
                _Opaque(value) if owner is None or isinstance(owner, ModuleType) else (value.__name__, self.of(owner))
            )
        if isinstance(value, FunctionType):
            return self._function(value)
        try:
            reduced = value.__reduce_ex__(4)
        except Exception:  # it cannot be copied, and so not be taken apart
            return _Opaque(value)
        if isinstance(reduced, str):  # it is found by its name
            return _Opaque(value)
        maker, arguments, *state = reduced
        parts = [tuple(one) if index and one is not None else one for index, one in enumerate(state[:3])]
        return kind, _Opaque(maker), self.of(arguments), *map(self.of, parts)

    def _function(self, value: FunctionType) -> Any:
        if named_elsewhere(value, self._module):
            return _Opaque(value)
        before, self._module = self._module, value.__module__ if self._module is None else self._module
        uses = tuple((name, self.of(one)) for name, _, one in captured(value))
        self._module = before
        return type(value), value.__code__, uses


def named_elsewhere(function: FunctionType, module: str | None) -> bool:
    """Return whether a function belongs to a module other than `module` and is found there by its name, so that its
    code and its globals are that module's."""
    if module is None or function.__module__ == module:
        return False
    found: Any = sys.modules.get(function.__module__ or "")
    for name in function.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is function


def captured(function: FunctionType) -> Iterator[tuple[str, CellType | dict[str, Any] | FunctionType, Any]]:
    """Yield defaults, closure and globals of a function: the name, the place of the value, and the value."""
    for name, default in (("__defaults__", function.__defaults__), ("__kwdefaults__", function.__kwdefaults__)):
        if default is not None:
            yield name, function, default
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=False):
        try:
            yield name, cell, cell.cell_contents
        except ValueError:  # an empty cell
            continue
    scope = function.__globals__
    for name in dict.fromkeys(name for code in nested(function.__code__) for name in code.co_names):
        if name in scope:
            yield name, scope, scope[name]


def nested(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of a function, and of those inside it."""
    yield code
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from nested(one)


class Captured:
    """The values that a function has captured: defaults, closure and globals, its own and those of the functions of its
    module that it uses, and the state of the object of a method.

    - `function`: a Python function, a method, or an object that is called
    """

    def __init__(self, function: Any) -> None:
        self._objects: list[tuple[Any, Any]] = []
        self._places: list[tuple[str, CellType | dict[str, Any] | FunctionType, Any, Any]] = []
        waiting, seen = [function], {id(function)}
        while waiting:
            current = waiting.pop()
            if type(current).__module__.partition(".")[0] == "invariode":  # a formula of a graph, which does not change
                continue
            if not isinstance(current, FunctionType):
                owner = getattr(current, "__self__", current)
                self._objects.append((owner, content(owner)))
                current = getattr(current, "__func__", None) or inspect.getattr_static(type(current), "__call__", None)
            if not isinstance(current, FunctionType):
                continue
            for name, place, value in captured(current):
                fixed = isinstance(value, (*_IMMUTABLE, FunctionType)) or (
                    type(value) is tuple and all(isinstance(one, _IMMUTABLE) for one in value)
                )
                self._places.append((name, place, value, None if fixed else content(value)))
                if isinstance(value, FunctionType) and value.__module__ == current.__module__ and id(value) not in seen:
                    seen.add(id(value))
                    waiting.append(value)

    def changed(self) -> bool:
        """Return whether any of the values is another one now."""
        for owner, before in self._objects:
            if content(owner) != before:
                return True
        for name, place, value, before in self._places:
            if isinstance(place, dict):
                now = place.get(name)
            elif isinstance(place, CellType):
                now = place.cell_contents
            else:
                now = getattr(place, name)
            if now is value and before is None:
                continue
            if content(now) != (content(value) if before is None else before):
                return True
        return False


def is_of_others(module: str | None) -> bool:
    """Return whether a module belongs to a package whose functions are not copied."""
    return (module or "").partition(".")[0] in _OTHERS


def is_copied(kind: type) -> bool:
    """Return whether copies of functions use copies of objects of this type, with all of their attributes."""
    has_slots = any(vars(one).get("__slots__") for one in kind.__mro__[:-1])
    return kind is SimpleNamespace or (has_own_code(kind) and not has_slots)


def is_of_numbers(dtype: np.dtype[Any]) -> bool:
    """Return whether arrays hold real numbers, or columns of them with names, as tables that are read have."""
    if dtype.names is not None:
        return all(dtype[name].kind in "fiub" for name in dtype.names)
    return dtype.kind in "fiub"


def has_own_code(kind: type) -> bool:
    return isinstance(getattr(kind, "__dict__", {}).get("__init__", None), FunctionType) or any(
        isinstance(found, FunctionType) for one in kind.__mro__[:-1] for found in vars(one).values()
    )
