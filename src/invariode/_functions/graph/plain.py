"""Graphs of plain Python functions whose tracing nobody can notice.

A function is traced if its code does something that may switch, and nothing but arithmetic, comparisons, loops and
calls of NumPy, `math` and functions of the same kind, on numbers and arrays. It has no effect then, and what it reads
is read. It may hold its numbers in lists, dicts, records and attributes of objects, and may itself be a method, an
object that is called, or a partial function. All limits are counts: the same function is traced, or not, everywhere.
"""

from __future__ import annotations

import builtins
import dis
import inspect
import math
from abc import ABCMeta
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from types import CodeType, FunctionType, MemberDescriptorType, MethodType, ModuleType, SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np

from ..._base.forks import cached_property
from ..._base.latest import Latest
from ..._base.record import Record
from ..._core import StateFirst
from ..compiled import CompiledFunction
from ..contents import is_copied, is_of_numbers, is_of_others, nested
from ..forms import Filling, FirstOrderForm
from ..layout import TRUTHS, ArgumentLayout, Entry, Listed, Numbers
from .nodes import Node, TraceError
from .switching_times import Crossing, timed
from .tables import PolynomialTable, is_table

#: The attribute of a function of ours in which the one stands that it calls, and does something besides.
AS_TRACED = "__as_traced__"
#: Larger states are not traced, and larger arrays not read.
MOST_COMPONENTS = 1000
_MOST_NUMBERS = 10_000

#: Instructions by the beginning of their names, in CPython 3.11 to 3.14: they change nothing but the function's own
#: variables, and what it has made.
_ALLOWED = (
    *("RESUME", "NOP", "CACHE", "POP_TOP", "PUSH_NULL", "COPY", "SWAP", "PRECALL", "CALL", "KW_NAMES", "RETURN_VALUE"),
    *("RETURN_CONST", "LOAD_CONST", "LOAD_COMMON_CONSTANT", "LOAD_SMALL_INT", "LOAD_FAST", "STORE_FAST", "DELETE_FAST"),
    *("LOAD_GLOBAL", "LOAD_DEREF", "LOAD_CLOSURE", "COPY_FREE_VARS", "MAKE_CELL", "STORE_DEREF", "LOAD_ATTR"),
    *("LOAD_METHOD", "BINARY_", "STORE_SUBSCR", "STORE_SLICE", "BUILD_TUPLE", "BUILD_LIST", "BUILD_SLICE"),
    *("LIST_EXTEND", "LIST_APPEND", "LIST_TO_TUPLE", "COMPARE_OP", "IS_OP", "CONTAINS_OP", "UNARY_", "TO_BOOL", "JUMP"),
    *("POP_JUMP", "GET_ITER", "FOR_ITER", "END_FOR", "POP_ITER", "UNPACK_SEQUENCE", "EXTENDED_ARG", "MAKE_FUNCTION"),
    *("SET_FUNCTION_ATTRIBUTE", "NOT_TAKEN", "CALL_INTRINSIC_1", "BUILD_MAP", "BUILD_CONST_KEY_MAP", "MAP_ADD"),
    *("DICT_MERGE", "DICT_UPDATE"),
    "RERAISE",  # of comprehensions, from 3.12 on; what handles exceptions itself has other instructions too
)
#: Of generator expressions, besides.
_OF_GENERATORS = ("RETURN_GENERATOR", "YIELD_VALUE")
#: Python's functions that it may call.
_BUILTINS = {"abs", "min", "max", "float", "int", "bool", "len", "range", "sum", "enumerate", "zip", "pow", "list"}
_BUILTINS |= {"tuple", "divmod", "round", "any", "all", "next"}
#: NumPy's functions besides the universal ones, and the attributes and methods of arrays, that it may use.
_NUMPY = {"array", "asarray", "zeros", "ones", "empty", "full", "zeros_like", "ones_like", "empty_like", "full_like"}
_NUMPY |= {
    "where",
    "select",
    "piecewise",
    "interp",
    "clip",
    "sum",
    "prod",
    "mean",
    "dot",
    "outer",
    "cross",
    "concatenate",
}
_NUMPY |= {"stack", "hstack", "vstack", "column_stack", "append", "diff", "roll", "arange", "linspace", "eye", "diag"}
_NUMPY |= {"linalg", "norm", "solve", "float64", "pi", "e", "inf", "nan", "newaxis", "atleast_1d", "ravel", "reshape"}
_NUMPY |= {"transpose", "cumsum", "any", "all", "max", "min", "amax", "amin", "sinc", "average", "trace", "einsum"}
_ARRAYS = {"T", "shape", "size", "ndim", "copy", "flatten", "real", "imag", "item", "tolist", "astype", "matmul", "r_"}
_ATTRIBUTES = frozenset(
    _NUMPY
    | _ARRAYS
    | {name for name in vars(np) if isinstance(getattr(np, name, None), np.ufunc)}
    | {name for name in vars(math) if not name.startswith("_")}
)
#: The flag of types that are defined in Python.
_IN_PYTHON = 1 << 9
#: Methods of objects that code may call without naming them, of which there may be copies.
_UNNAMED = ("__call__", "__getattr__", "__getitem__")
#: Methods that the code of functions that are traced does not call.
_IDLE = {"__init__", "__post_init__", "__repr__", "__str__", "__eq__", "__hash__", "__setattr__", "__delattr__"}
_IDLE |= {"__reduce__", "__getstate__", "__setstate__", "__replace__"}
#: Names of functions that switch.
_SWITCHING = {"floor", "ceil", "trunc", "rint", "round", "fmod", "mod", "remainder", "divmod", "floor_divide", "abs"}
_SWITCHING |= {"fabs", "absolute", "min", "max", "minimum", "maximum", "fmin", "fmax", "clip", "where", "heaviside"}
_SWITCHING |= {"sign", "copysign", "select", "piecewise", "interp", "less", "less_equal", "greater", "greater_equal"}
#: Names of functions that read variables which code does not name.
_OF_FRAMES = {"eval", "exec", "locals", "vars"}
#: Of binary operators.
_SWITCHING_OPERATORS = {"%", "//", "%=", "//="}


class _CodeSummary(NamedTuple):
    """Summary of the code of a function, with the functions inside it."""

    plain: bool  # nothing that could be noticed
    switches: bool
    outside: tuple[str, ...]  # names of what it uses: globals, and variables of functions around it
    attributes: frozenset[str]  # attributes that it uses, besides those of numbers and arrays
    reads: frozenset[int]  # which of its arguments it reads, by their places; those of *args count as read


#: What is known of codes; the oldest go first.
_known: Latest[CodeType, _CodeSummary] = Latest(1024)


def use_of_time(fun: Any, args: Sequence[Any] = ()) -> Literal["none", "some", "switches"]:
    """Return how the values of a function may depend on t. "none": it is a Python function that does nothing but
    calculate, by code in which t does not occur; "switches": a Python function without observable effects, one that it
    calls, or a table in its `args` may switch with t."""
    direct = type(fun) is FunctionType and not fun.__dict__
    called = fun if direct else _called(fun)
    nothing_inside = False
    if type(called) is FunctionType:
        code = called.__code__
        known, time = _known.get(code) or _code_of(code), 0 if direct else _place_of_time(fun)
        if time not in known.reads and time < code.co_argcount:
            plain = known.plain and not known.attributes and _OF_FRAMES.isdisjoint(known.outside)
            return "none" if plain else "some"
        nothing_inside = not (known.switches or known.outside or called.__defaults__ or called.__kwdefaults__)
    inside = (not nothing_inside and _may_switch(called)) or (
        args and any(type(one) is not float and _may_switch(one) for one in args)
    )
    return "switches" if inside else "some"


def _place_of_time(fun: Any) -> int:
    return 1 if isinstance(getattr(fun, AS_TRACED, fun), StateFirst) else 0


def only_calculates(fun: Any) -> bool:
    """Return whether a Python function does nothing but calculate with numbers and arrays, so that a call has no effect
    and cannot end the process. Functions of which this is not known, such as methods and machine code, do not count."""
    called = _called(fun)
    try:
        return type(called) is FunctionType and not _contents([called])[1]
    except _NoticedError:
        return False


class PlainGraph:
    """The graph of a function.

    - `outputs`: its values
    - `exact`: its derivatives, once they have been formed
    """

    def __init__(self, outputs: list[Node]) -> None:
        self.outputs = outputs
        self.exact: Any = None

    @cached_property
    def timed(self) -> list[Crossing]:
        """The conditions that depend on t and not on y."""
        return timed(self.outputs)


#: Graphs by code and all that it uses, None for code that cannot be traced; the oldest go first.
_graphs: Latest[Hashable, PlainGraph | None] = Latest()


def plain_graph(
    fun: Any,
    n: int,
    args: ArgumentLayout,
    *,
    size: int | None = None,
    second: int = 0,
    is_complex: bool = False,
    of_objects: bool = True,
) -> PlainGraph | None:
    """The values of a Python function of (t, y, *args) as a graph, found without an effect that could be noticed.

    - `fun`: the function
    - `n`: the reals that make up y
    - `args`: its further arguments
    - `size`: the number of its values. Default: n.
    - `second`, `is_complex`: as in `trace`
    - `of_objects`: it may be one of objects, whose attributes may change while it is used

    Returns PlainGraph or None: None: it cannot be traced, or not within the limits, or tracing could be noticed.
    """
    if n > MOST_COMPONENTS:
        return None
    try:
        contents = _contents([_called(fun), *_constants(args.entries)])
    except _NoticedError:
        return None
    if not of_objects and (contents[1] or type(_called(fun)) is not FunctionType):
        return None
    size = n if size is None else size
    key = (contents, type(fun), n, size, second, args.fixed(TRUTHS), is_complex)
    if key not in _graphs:
        _graphs[key] = made = _traced(fun, n, args, size, second, is_complex=is_complex)
        return made
    return _graphs.get(key)


def _traced(fun: Any, n: int, args: ArgumentLayout, size: int, second: int, *, is_complex: bool) -> PlainGraph | None:
    from .trace import IN_PASSING, trace  # imported when a function is traced

    fun = getattr(fun, AS_TRACED, fun)
    fills = isinstance(fun, Filling)
    if isinstance(fun, StateFirst):
        fun = _time_first(fun.__wrapped__)
    elif fills:
        fun = fun.__wrapped__
    try:
        with np.errstate(all="ignore"):
            limits, inplace = IN_PASSING._replace(numpy=_ATTRIBUTES), size * fills
            outputs = trace(fun, n, args, second=second, inplace=inplace, is_complex=is_complex, limits=limits).outputs
    except (TraceError, RecursionError):
        return None
    return PlainGraph(outputs) if len(outputs) == size else None


def _time_first(fun: Any) -> Callable[..., Any]:
    return lambda t, y, *args: fun(y, t, *args)


def _called(fun: Any) -> Any:
    """Return the user's function that is called."""
    fun = getattr(fun, AS_TRACED, fun)
    if isinstance(fun, (StateFirst, Filling)):
        fun = fun.__wrapped__
    return fun.fun if isinstance(fun, FirstOrderForm) else fun


def _may_switch(value: Any) -> bool:
    """Return whether a function, or one that is reached through a value, may switch."""
    waiting, seen = [value], dict[int, Any]()  # the values too, since an id is that of a living object
    while waiting:
        one = waiting.pop()
        kind = type(one)
        if kind is FunctionType:
            code = _code_of(one.__code__)
            if code.plain and code.switches:
                return True
            if not code.plain or not (code.outside or one.__defaults__ or one.__kwdefaults__):
                continue
            inside: Iterable[Any] = _outside(one, code)
        elif kind in _HOLDERS:
            inside = _HOLDERS[kind](one)
        elif issubclass(kind, PolynomialTable) or kind.__module__.startswith("scipy.interpolate"):
            return True
        elif issubclass(kind, CompiledFunction):
            inside = [one.fun]
        elif _is_plain_object(kind):
            inside = [held for _, held in _attributes(one, {name for part in kind.__mro__ for name in vars(part)})]
            inside += getattr(one, "__dict__", {}).values()
        else:
            continue
        if id(one) not in seen:
            seen[id(one)] = one
            waiting += inside
    return False


#: What holds other values, and how these are found.
_HOLDERS: dict[type, Callable[[Any], Iterable[Any]]] = {
    list: iter,
    tuple: iter,
    dict: dict.values,
    partial: lambda value: [value.func, *value.args, *value.keywords.values()],
    MethodType: lambda value: [value.__func__, value.__self__],
    property: lambda value: [value.fget],
    staticmethod: lambda value: [value.__func__],
    classmethod: lambda value: [value.__func__],
}


def _is_plain_object(kind: type) -> bool:
    """Return whether objects of this type do nothing when code reads an attribute or calls a method, besides what the
    code of that method does."""
    if kind is SimpleNamespace:
        return True
    for part in kind.__mro__[:-1]:
        if type(part) not in (type, ABCMeta) or not part.__flags__ & _IN_PYTHON or is_of_others(part.__module__):
            return False
        for name, one in vars(part).items():
            unseen = name.startswith("__") and name not in _IDLE and name not in _UNNAMED
            if unseen and isinstance(one, (FunctionType, classmethod)):
                return False
    return True


def _is_namespace(kind: type) -> bool:
    """Return whether a class, of which objects are made without code, may be read like an object."""
    return _is_plain_object(kind) and not any(
        "__init__" in vars(one) or "__new__" in vars(one) for one in kind.__mro__[:-1]
    )


def _attributes(value: Any, names: Iterable[str]) -> Iterator[tuple[str, Any]]:
    """Iterate over the attributes of a plain object, or a namespace, that have one of these names; methods are
    functions."""
    of_class = isinstance(value, type)
    own = {} if of_class else getattr(value, "__dict__", {})
    for name in names:
        if name in own:
            yield name, own[name]
            continue
        places = (value if of_class else type(value)).__mro__[:-1]
        found = next((vars(one)[name] for one in places if name in vars(one)), None)
        if isinstance(found, MemberDescriptorType):  # of __slots__
            yield name, getattr(value, name, None)
        elif found is not None:
            yield name, found


def _code_of(code: CodeType) -> _CodeSummary:
    known = _known.get(code)
    if known is None:
        codes = [*nested(code)]
        plain = all(_is_plain(one, code) for one in codes)
        names = dict.fromkeys(name for one in codes for name in _names(one, code)) if plain else {}
        every = (one for code in codes for one in dis.get_instructions(code))
        used = frozenset(one.argval for one in every if one.opname in ("LOAD_ATTR", "LOAD_METHOD")) - _ATTRIBUTES
        known = _CodeSummary(plain, plain and any(map(_switches, codes)), tuple(names), used, _read(codes))
        _known[code] = known
    return known


def _is_plain(code: CodeType, whole: CodeType) -> bool:
    """Return whether code changes only variables of the whole function."""
    is_generator = code.co_flags & (inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR)
    if is_generator and code.co_name != "<genexpr>":
        return False
    allowed = (*_ALLOWED, *_OF_GENERATORS) if is_generator else _ALLOWED
    if any(isinstance(one, tuple) and "out" in one for one in code.co_consts):  # np.add(a, b, out=c)
        return False
    for one in dis.get_instructions(code):
        if not one.opname.startswith(allowed):
            return False
        if one.opname == "STORE_DEREF" and one.argval in whole.co_freevars:
            return False
    return True


def _switches(code: CodeType) -> bool:
    for one in dis.get_instructions(code):
        if one.opname == "COMPARE_OP" or one.argrepr in _SWITCHING_OPERATORS:
            return True
        if one.opname.startswith("LOAD_") and one.argval in _SWITCHING:
            return True
    return False


def _read(codes: Sequence[CodeType]) -> frozenset[int]:
    """The places of the arguments of the first code that any of them reads."""
    named = {one.argval for code in codes for one in dis.get_instructions(code) if one.opname.startswith("LOAD_")}
    named |= {name for one in named if isinstance(one, tuple) for name in one}  # two of them at once, from 3.13 on
    return frozenset(i for i, name in enumerate(codes[0].co_varnames[: codes[0].co_argcount]) if name in named)


def _names(code: CodeType, whole: CodeType) -> Iterator[str]:
    for one in dis.get_instructions(code):
        if one.opname == "LOAD_GLOBAL" or (one.opname == "LOAD_DEREF" and one.argval in whole.co_freevars):
            yield one.argval


def _outside(function: FunctionType, code: _CodeSummary) -> Iterator[Any]:
    """Iterate over the objects that a function uses: variables of enclosing functions, globals, default values."""
    cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
    for name in code.outside:
        if name in cells:
            with suppress(ValueError):  # it has no value yet
                yield cells[name].cell_contents
        else:
            yield function.__globals__.get(name, getattr(builtins, name, None))
    yield from function.__defaults__ or ()
    yield from (function.__kwdefaults__ or {}).values()


class _NoticedError(Exception):
    """Something is used that tracing could change, or whose use could be noticed."""


def _contents(values: Sequence[Any]) -> tuple[Hashable, frozenset[str]]:
    """Return the code of functions with all that it uses, equal for functions that have equal graphs, and the names of
    the attributes that it uses.

    Raises _NoticedError: Tracing a function could be noticed.
    """
    names: frozenset[str] = frozenset()
    while True:  # until no method that is called uses further attributes
        used = _UsedValues(names)
        contents = tuple(map(used.of, values))
        if used.names == names:
            return contents, names
        names = frozenset(used.names)


class _UsedValues:
    """A walk through values that code uses: the copies that are traced cannot change these.

    - `known`: names of the attributes that code may read of objects

    Attributes:
    - `names`: names of those that the code which has been found uses
    """

    def __init__(self, known: frozenset[str]) -> None:
        self._known, self.names = sorted({*known, *_UNNAMED}), set(known)
        self._seen: dict[int, int] = {}

    def of(self, value: Any) -> Hashable:
        """Return the contents of a value."""
        kind = type(value)
        if value is None or issubclass(kind, _NUMBERS):
            return kind, repr(value)
        if kind is np.ndarray and is_of_numbers(value.dtype) and value.size <= _MOST_NUMBERS:
            return kind, repr(value.dtype), value.shape, value.tobytes()
        if id(value) in self._seen:
            return "again", self._seen[id(value)]
        self._seen[id(value)] = len(self._seen)
        if kind is type and _is_namespace(value):
            return value, tuple((name, _number(one)) for name, one in _attributes(value, self._known))
        if kind is FunctionType and not (value.__module__ or "").startswith("numpy"):  # None: of exec
            return self._function(value)
        if kind in _HOLDERS and (not hasattr(value, "__len__") or len(value) <= _MOST_NUMBERS):
            names = tuple(map(self.of, value)) if kind is dict else tuple(value.keywords) if kind is partial else ()
            return kind, names, tuple(map(self.of, _HOLDERS[kind](value)))
        in_python = kind.__flags__ & _IN_PYTHON
        if not in_python and _is_of_library(value):
            return id(value)
        if issubclass(kind, Record) or (issubclass(kind, tuple) and hasattr(kind, "_fields")):
            names = value.keys() if kind is Record else kind._fields
            return kind, tuple(names), tuple(map(_number, value))
        if issubclass(kind, CompiledFunction) and not value.inplace:
            return kind, self.of(value.fun)
        table = issubclass(kind, PolynomialTable)
        if not table and _is_plain_object(kind):
            part = self.of if is_copied(kind) else _number
            return kind, tuple((name, part(one)) for name, one in _attributes(value, self._known))
        if in_python and not table and not is_of_others(kind.__module__):
            raise _NoticedError  # before anything asks the object for an attribute
        if is_table(value) and not isinstance(value, type):
            return object()  # whose contents are not compared
        if _is_of_library(value):
            return id(value)
        raise _NoticedError

    def _function(self, function: FunctionType) -> Hashable:
        code = _code_of(function.__code__)
        if not code.plain:
            raise _NoticedError
        self.names |= code.attributes
        return (function.__code__, *map(self.of, _outside(function, code)))


def _number(value: Any) -> Hashable:
    """Return the contents of a number, which needs no copy."""
    if value is None or isinstance(value, _NUMBERS):
        return type(value), repr(value)
    raise _NoticedError


def _is_of_library(value: Any) -> bool:
    """Return whether a value is NumPy, `math`, or one of the functions of these or of Python that may be called."""
    if isinstance(value, ModuleType):
        return value in (np, math, np.linalg)
    name = getattr(value, "__name__", "")
    if getattr(builtins, name, None) is value:
        return name in _BUILTINS
    return (getattr(np, name, None) is value or getattr(math, name, None) is value) and name in _ATTRIBUTES


_NUMBERS = (bool, int, float, str, np.bool_, np.integer, np.floating)


def _constants(entries: Sequence[Entry]) -> Iterator[Any]:
    """Iterate over the arguments that are not numbers."""
    for one in entries:
        if isinstance(one, Listed):
            yield from _constants(one.entries)
        elif not isinstance(one, Numbers):
            yield one.value
