"""The code of functions as a number: equal in every process for functions that are written alike and use the same
constants, arrays and attributes of objects."""

from __future__ import annotations

import dis
import hashlib
import inspect
from collections.abc import Iterator
from functools import partial
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from .._functions.compiled import CompiledFunction, CoreFunction
from .._functions.contents import ATOMS, Contents, captured, nested
from .._functions.forms import FirstOrderForm
from .._functions.graph.python import Formula

#: Instructions that change the items of what stands before them in the source,
_CHANGES_ITEMS = ("STORE_SUBSCR", "DELETE_SUBSCR", "STORE_SLICE")
#: and methods of lists, dicts and arrays that do.
_CHANGES = {"add", "append", "clear", "extend", "fill", "insert", "pop", "remove", "setdefault", "sort", "update"}
#: Instructions that load, bind or delete something else than local variables of the function, by their endings.
_KINDS = {"GLOBAL": "name", "DEREF": "name", "ATTR": "attribute", "METHOD": "attribute"}


class BoundFunction(NamedTuple):
    """A function, and the object whose attributes it uses: None if it is a function alone."""

    function: FunctionType
    owner: Any


class _PortableContents(Contents):
    """Takes values apart into what is equal in every process: no types of users, and no identity of equal values.
    Arrays become digests; other objects are noted."""

    def __init__(self) -> None:
        super().__init__()
        self.others: list[Any] = []

    def of(self, value: Any) -> Any:
        if isinstance(value, ATOMS):
            return repr(value)
        if isinstance(value, np.ndarray) and value.dtype != object:
            return str(value.dtype), hashlib.sha256(value.tobytes()).digest()
        around = id(value) in self._seen
        found = super().of(value)
        if not around:
            del self._seen[id(value)]
        return found

    def other(self, value: Any) -> None:
        self.others.append(value)


def digest(value: Any) -> str:
    """Return a short number for numbers, text and arrays, alone or in containers; other objects do not count."""
    return hashlib.blake2b(repr(_PortableContents().of(value)).encode(), digest_size=6).hexdigest()


def digest_of_code(value: Any) -> str | None:
    """Return a number for the code of a function; None: it has no code of Python's."""
    if isinstance(value, partial):
        inner = digest_of_code(value.func)
        return inner and digest((inner, value.args, value.keywords))
    if isinstance(value, CoreFunction):
        codes = [digest_of_code(one) for one in value.functions]
        return digest(codes) if any(codes) else None
    formula = value.fun if isinstance(value, CompiledFunction) else value
    if isinstance(formula, Formula):
        return digest(formula.text)
    method = _method(value)
    if method is None or (method.function.__module__ or "").startswith("invariode."):
        return None
    return digest(_code(method))


def _method(value: Any) -> BoundFunction | None:
    """Return the Python function that underlies a function or a callable object, if there is one."""
    if isinstance(value, CompiledFunction):
        value = value.fun
    value = value.fun if isinstance(value, FirstOrderForm) else value
    value = getattr(value, "py_func", value)  # numba's
    if not isinstance(value, (FunctionType, type)):  # a cfunc of numba's, what functools.cache returns, a `Filling`
        value = inspect.getattr_static(value, "__wrapped__", value)
    value = value.__func__ if isinstance(value, (staticmethod, classmethod)) else value
    value = value.fget if isinstance(value, property) else value
    owner = None
    if isinstance(value, MethodType):
        owner, value = value.__self__, value.__func__
    elif not isinstance(value, (FunctionType, type)):
        owner, value = value, inspect.getattr_static(type(value), "__call__", None)
    return BoundFunction(value, owner) if isinstance(value, FunctionType) else None


# ----------------------------------------------------------------------------------------------------------------------
# What a function uses


class _Uses:
    """Names that the code of one function uses, and names that it changes, which are its state and not its code."""

    def __init__(self, method: BoundFunction) -> None:
        function, owner = method
        self.codes = list(nested(function.__code__))
        free = set(function.__code__.co_freevars)
        instructions = [list(dis.get_instructions(code)) for code in self.codes]
        self.changed = {change for one in instructions for change in _changes(one, free)}
        used = list(captured(function))
        objects = [one for one in (owner, *(value for *_, value in used)) if one is not None and _has_attributes(one)]
        attributes = dict.fromkeys(one.argval for part in instructions for one in part if _kind(one) == "attribute")
        self.values = [("name", name, value) for name, _, value in used] + _attributes(objects, list(attributes))


def _kind(one: dis.Instruction) -> str | None:
    return _KINDS.get(one.opname.partition("_")[2])


def _changes(instructions: list[dis.Instruction], free: set[str]) -> Iterator[tuple[str, str]]:
    """Yield kind and name of each variable or attribute that instructions bind, or whose items they change. An
    instruction that changes items begins at the place in the source at which the name begins."""
    places = {
        _place(one)
        for one in instructions
        if one.opname in _CHANGES_ITEMS or (_kind(one) == "attribute" and one.argval in _CHANGES)
    }
    for one in instructions:
        if (kind := _kind(one)) is not None:
            own = one.opname.endswith("DEREF") and one.argval not in free
            if _place(one) in places if one.opname.startswith("LOAD") else not own:
                yield kind, one.argval


def _place(one: dis.Instruction) -> tuple[int | None, int | None] | None:
    where = one.positions
    return None if where is None else (where.lineno, where.col_offset)


def _has_attributes(value: Any) -> bool:
    """Return whether a value is an object, or a class, whose attributes are not code that is seen otherwise."""
    if isinstance(value, (ModuleType, FunctionType, MethodType, BuiltinFunctionType, np.ndarray, np.generic, np.ufunc)):
        return False
    return hasattr(value, "__dict__") or hasattr(type(value), "__slots__")


def _attributes(objects: list[Any], names: list[str]) -> list[tuple[str, str, Any]]:
    """Return the attributes of these names, of the objects and of those among their attributes; for methods and
    properties the function with its object."""
    found: list[tuple[str, str, Any]] = []
    seen: set[int] = set()
    while objects:
        one = objects.pop(0)
        if id(one) in seen:
            continue
        seen.add(id(one))
        for name in names:
            value = inspect.getattr_static(one, name, None)
            if inspect.ismemberdescriptor(value):  # a slot
                value = getattr(one, name, None)
            inner = value.fget if isinstance(value, property) else value
            if isinstance(inner, FunctionType) and not isinstance(one, type):
                value = MethodType(inner, one)
            elif _has_attributes(value):
                objects.append(value)
            found.append(("attribute", name, value))
    return found


def _reached(first: BoundFunction) -> list[_Uses]:
    """Return the uses of a function and of the functions of its module that it calls."""
    found: list[_Uses] = []
    waiting, seen = [first], set()
    while waiting:
        method = waiting.pop(0)
        if (key := (id(method.function), id(method.owner))) in seen:
            continue
        seen.add(key)
        found.append(_Uses(method))
        values = _PortableContents()
        values.of([value for _, _, value in found[-1].values])
        inner = [_method(one) for one in values.others if callable(one)]
        waiting += [one for one in inner if one and one.function.__module__ == method.function.__module__]
    return found


def _code(method: BoundFunction) -> list[Any]:
    """Return the code of a function and of those that it uses, with their constants, and what they use."""
    reached = _reached(method)
    changed = set().union(*(uses.changed for uses in reached))
    return [
        (
            [(code.co_code, code.co_names, code.co_varnames, _without_code(code.co_consts)) for code in uses.codes],
            [value for kind, name, value in uses.values if (kind, name) not in changed],
        )
        for uses in reached
    ]


def _without_code(constants: tuple[Any, ...]) -> list[Any]:
    return [one for one in constants if not isinstance(one, CodeType)]
