"""The code of functions as a number: equal in every process for functions that are written alike and use the same
constants, arrays and attributes of objects."""

from __future__ import annotations

import dis
import hashlib
import inspect
import itertools
from collections.abc import Iterator
from functools import partial
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from .._functions.compiled import CompiledFunction, CoreFunction
from .._functions.contents import ATOMS, Contents, captured, named_elsewhere, nested
from .._functions.graph.python import Formula

#: Instructions that change the items of what stands before them in the source,
_CHANGES_ITEMS = ("STORE_SUBSCR", "DELETE_SUBSCR", "STORE_SLICE")
#: and methods of lists, dicts and arrays that do.
_CHANGES = {"add", "append", "clear", "extend", "fill", "insert", "pop", "remove", "setdefault", "sort", "update"}
#: Instructions that load, bind or delete something else than local variables of the function, by their endings.
_KINDS = {"GLOBAL": "name", "DEREF": "name", "ATTR": "attribute", "METHOD": "attribute"}
#: Wrappers, and the attribute that is the function inside.
_INSIDE: list[tuple[Any, str]] = [
    (property, "fget"),
    (partial, "func"),
    ((MethodType, staticmethod, classmethod), "__func__"),
]
#: Attributes that count without being named by the code: those of callable objects of other modules, without caches.
_DATA = (np.ndarray, float, complex, tuple, FunctionType, MethodType)
#: Containers, whose subclasses count as they do.
_CONTAINERS = (list, tuple, set, frozenset, dict)


def digest(value: Any) -> str:
    """Return a short number for numbers, text and arrays, alone or in containers; other objects do not count."""
    return hashlib.blake2b(repr(_Portable().of(value)).encode(), digest_size=6).hexdigest()


def digest_of_code(value: Any) -> str | None:
    """Return a number for the code of a function; None: it has no code of Python's."""
    if isinstance(value, CoreFunction):
        codes = [digest_of_code(one) for one in value.functions]
        return digest(codes) if any(codes) else None
    formula = value.fun if isinstance(value, CompiledFunction) else value
    if isinstance(formula, Formula):
        return digest(formula.text)
    function = _python_function(value)
    if function is None or (function.__module__ or "").startswith("invariode."):
        return None
    code = _Portable(function.__module__)
    found, names = code.of(value), -1
    while code.names > names:  # those that functions found last use or change count for all
        names = code.names
        found = code.again(value)
    return digest(repr(found))


def _wrapped(value: Any) -> Any:
    """Return the function inside a method, a property, a compiled function or another wrapper, or None."""
    if isinstance(value, (FunctionType, type)):
        return None
    if type(value).__module__.partition(".")[0] == "invariode":
        return getattr(value, "fun", None)
    for kind, name in _INSIDE:
        if isinstance(value, kind):
            return getattr(value, name)
    # functions and cfuncs of numba, and what functools.cache returns
    places = (inspect.getattr_static(value, name, None) for name in ("py_func", "_pyfunc", "__wrapped__"))
    return next((one for one in places if callable(one)), None)


def _python_function(value: Any) -> FunctionType | None:
    """Return the function of Python's that runs when a function or a callable object is called, if there is one."""
    while (inner := _wrapped(value)) is not None:
        value = inner
    if not isinstance(value, (FunctionType, type)):
        value = inspect.getattr_static(type(value), "__call__", None)
    return value if isinstance(value, FunctionType) else None


class _Portable(Contents):
    """Takes values apart into what is equal in every process: no types, and no identity of equal containers. Arrays
    become digests. Functions become their code and what they use, or their name if another module has it, and other
    objects those attributes that this code names. Variables and attributes that the code changes are its state, and do
    not count.

    - `module`: the name of the module of the first function
    """

    def __init__(self, module: str | None = None) -> None:
        super().__init__()
        self._module = module
        self._attributes = {"__call__"}  # names of those that the code uses
        self._changed: set[tuple[str, str]] = set()

    @property
    def names(self) -> int:
        """Number of the names that have been found so far."""
        return len(self._attributes) + len(self._changed)

    def again(self, value: Any) -> Any:
        """Return the content of a value, where all names known by now count."""
        self._seen.clear()
        self._count = itertools.count()
        return self.of(value)

    def of(self, value: Any) -> Any:
        if isinstance(value, CodeType):
            return value.co_code, value.co_names, value.co_varnames, self.of(value.co_consts)
        if isinstance(value, ATOMS):
            return repr(value)
        if isinstance(value, np.ndarray) and value.dtype != object:
            return str(value.dtype), value.shape, hashlib.sha256(value.tobytes()).digest()
        plain = next((kind for kind in _CONTAINERS if isinstance(value, kind)), None)
        if plain is None or id(value) in self._seen:
            return super().of(value)
        if type(value) is plain:
            found = super().of(value)
        else:
            self._seen[id(value)] = next(self._count), value
            found = super().of(plain(value)), self.other(value)
        del self._seen[id(value)]
        return found

    def other(self, value: Any) -> Any:
        if isinstance(value, FunctionType):
            return value.__qualname__ if named_elsewhere(value, self._module) else self._function(value)
        if isinstance(value, MethodType):
            return self.of(value.__func__), self.of(value.__self__)
        if (inner := _wrapped(value)) is not None:
            return self.of(inner)
        if isinstance(value, (ModuleType, BuiltinFunctionType, np.ufunc)):
            return value.__name__
        if not hasattr(value, "__dict__") and not hasattr(type(value), "__slots__"):
            return None
        names = self._attributes
        if callable(value) and type(value).__module__ != self._module:  # such as an interpolator
            slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
            own = (*slots, *getattr(value, "__dict__", ()))
            names = names.union(name for name in own if _is_data(_attribute(value, name), type(value)))
        kept = sorted(name for name in names if ("attribute", name) not in self._changed)
        return [(name, self.of(_attribute(value, name))) for name in kept]

    def _function(self, value: FunctionType) -> Any:
        free = set(value.__code__.co_freevars)
        for code in nested(value.__code__):
            instructions = list(dis.get_instructions(code))
            self._attributes.update(one.argval for one in instructions if _kind(one) == "attribute")
            self._changed.update(_changes(instructions, free))
        uses = [(name, self.of(one)) for name, _, one in captured(value) if ("name", name) not in self._changed]
        return self.of(value.__code__), uses


def _attribute(value: Any, name: str) -> Any:
    """Return an attribute of an object, a property or method as a function; None without it."""
    found = inspect.getattr_static(value, name, None)
    return getattr(value, name, None) if inspect.ismemberdescriptor(found) else found  # a slot


def _is_data(value: Any, owner: type) -> bool:
    """Return whether an attribute of a callable object of another module counts: data, or an object of the same package
    to which its calls may be passed."""
    package = owner.__module__.partition(".")[0]
    return isinstance(value, _DATA) or (callable(value) and type(value).__module__.partition(".")[0] == package)


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
