"""Graphs of plain Python functions whose tracing nobody can notice.

A function is traced if its code does something that may switch, and nothing but arithmetic, comparisons, loops and
calls of NumPy, `math` and functions of the same kind, on numbers and arrays. It has no effect then, and what it reads
is read. All limits are counts: the same function is traced, or not, everywhere.
"""

from __future__ import annotations

import builtins
import dis
import inspect
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import suppress
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from ..._base.forks import cached_property
from ..._base.latest import Latest
from ..._core import StateFirst
from ..contents import nested
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
    *("SET_FUNCTION_ATTRIBUTE", "NOT_TAKEN", "CALL_INTRINSIC_1"),
)
#: Of generator expressions, besides.
_OF_GENERATORS = ("RETURN_GENERATOR", "YIELD_VALUE", "RERAISE")
#: Python's functions that it may call.
_BUILTINS = {"abs", "min", "max", "float", "int", "bool", "len", "range", "sum", "enumerate", "zip", "pow", "list"}
_BUILTINS |= {"tuple", "divmod", "round"}
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
_ATTRIBUTES = _NUMPY | _ARRAYS | {name for name in vars(np) if isinstance(getattr(np, name, None), np.ufunc)}
_ATTRIBUTES |= {name for name in vars(math) if not name.startswith("_")}
#: Names of functions that switch.
_SWITCHING = {"floor", "ceil", "trunc", "rint", "round", "fmod", "mod", "remainder", "divmod", "floor_divide", "abs"}
_SWITCHING |= {"fabs", "absolute", "min", "max", "minimum", "maximum", "fmin", "fmax", "clip", "where", "heaviside"}
_SWITCHING |= {"sign", "copysign", "select", "piecewise", "interp", "less", "less_equal", "greater", "greater_equal"}
#: Of binary operators.
_SWITCHING_OPERATORS = {"%", "//", "%=", "//="}


class _CodeSummary(NamedTuple):
    """Summary of the code of a function, with the functions inside it."""

    plain: bool  # nothing that could be noticed
    switches: bool
    outside: tuple[str, ...]  # names of what it uses: globals, and variables of functions around it
    reads: frozenset[int]  # which of its arguments it reads, by their places; those of *args count as read


#: What is known of codes; the oldest go first.
_known: Latest[CodeType, _CodeSummary] = Latest(1024)


def may_switch(fun: Any, args: Sequence[Any] = ()) -> bool:
    """Return whether a Python function, one that it calls, or a table in its `args` has anything that may switch with
    t, and its code no observable effects. This takes less than a microsecond for a function that is known."""
    function = fun if type(fun) is FunctionType and not fun.__dict__ else _function_of(fun)
    if function is None:
        return False
    known = _known.get(function.__code__)
    nothing_inside = known is not None and not (known.switches or known.outside)
    if (nothing_inside or not _may_switch(function, ())) and not (args and any(map(_is_table, args))):
        return False
    time = 1 if isinstance(getattr(fun, AS_TRACED, fun), StateFirst) else 0
    return time in _code_of(function.__code__).reads or time >= function.__code__.co_argcount


def only_calculates(fun: Any) -> bool:
    """Return whether a Python function does nothing but calculate with numbers and arrays, so that a call has no effect
    and cannot end the process. Functions of which this is not known, such as methods and machine code, do not count."""
    function = _function_of(fun)
    if function is None:
        return False
    try:
        _contents(function, ())
    except _NoticedError:
        return False
    return True


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
    fun: Any, n: int, args: ArgumentLayout, *, size: int | None = None, is_complex: bool = False
) -> PlainGraph | None:
    """The values of a Python function of (t, y, *args) as a graph, found without an effect that could be noticed.

    - `fun`: the function
    - `n`: the reals that make up y
    - `args`: its further arguments
    - `size`: the number of its values. Default: n.
    - `is_complex`: as in `trace`

    Returns PlainGraph or None: None: it cannot be traced, or not within the limits, or tracing could be noticed.
    """
    function = _function_of(fun)
    if function is None or n > MOST_COMPONENTS:
        return None
    try:
        contents = _contents(function, ()), _contents_of_arguments(args.entries)
    except _NoticedError:
        return None
    size = n if size is None else size
    key = (*contents, type(fun), n, size, args.fixed(TRUTHS), is_complex)
    if key not in _graphs:
        _graphs[key] = made = _traced(fun, n, args, size, is_complex=is_complex)
        return made
    return _graphs.get(key)


def _traced(fun: Any, n: int, args: ArgumentLayout, size: int, *, is_complex: bool) -> PlainGraph | None:
    from .trace import IN_PASSING, trace  # imported when a function is traced

    fun = getattr(fun, AS_TRACED, fun)
    fills = isinstance(fun, Filling)
    if isinstance(fun, StateFirst):
        fun = _time_first(fun.__wrapped__)
    elif fills:
        fun = fun.__wrapped__
    try:
        with np.errstate(all="ignore"):
            outputs = trace(fun, n, args, inplace=n * fills, is_complex=is_complex, limits=IN_PASSING).outputs
    except (TraceError, RecursionError):
        return None
    return PlainGraph(outputs) if len(outputs) == size else None


def _time_first(fun: Any) -> Callable[..., Any]:
    return lambda t, y, *args: fun(y, t, *args)


def _function_of(fun: Any) -> FunctionType | None:
    """The Python function that is called."""
    fun = getattr(fun, AS_TRACED, fun)
    if isinstance(fun, (StateFirst, Filling)):
        fun = fun.__wrapped__
    if isinstance(fun, FirstOrderForm):
        fun = fun.fun
    return fun if type(fun) is FunctionType else None


def _may_switch(function: FunctionType, around: tuple[CodeType, ...]) -> bool:
    code = _code_of(function.__code__)
    if not code.plain or function.__code__ in around:
        return False
    if code.switches:
        return True
    if not code.outside:
        return False
    for one in _outside(function, code):
        if type(one) is FunctionType and _may_switch(one, (*around, function.__code__)):
            return True
        if _is_table(one):
            return True
    return False


def _is_table(value: Any) -> bool:
    if type(value) is float:
        return False
    return isinstance(value, PolynomialTable) or type(value).__module__.startswith("scipy.interpolate")


def _code_of(code: CodeType) -> _CodeSummary:
    known = _known.get(code)
    if known is None:
        codes = [*nested(code)]
        plain = all(_is_plain(one, code) for one in codes)
        names = dict.fromkeys(name for one in codes for name in _names(one, code)) if plain else {}
        known = _CodeSummary(plain, plain and any(map(_switches, codes)), tuple(names), _read(codes))
        _known[code] = known
    return known


def _is_plain(code: CodeType, whole: CodeType) -> bool:
    """Return whether code changes only variables of the whole function, and uses attributes of numbers and arrays."""
    is_generator = code.co_flags & (inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR)
    if is_generator and code.co_name != "<genexpr>":
        return False
    allowed = (*_ALLOWED, *_OF_GENERATORS) if is_generator else _ALLOWED
    if any(isinstance(one, tuple) and "out" in one for one in code.co_consts):  # np.add(a, b, out=c)
        return False
    for one in dis.get_instructions(code):
        if not one.opname.startswith(allowed):
            return False
        if one.opname in ("LOAD_ATTR", "LOAD_METHOD") and one.argval not in _ATTRIBUTES:
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


def _contents(function: FunctionType, around: tuple[CodeType, ...]) -> Hashable:
    """The code of a function with all that it uses: equal for functions that have equal graphs.

    Raises _NoticedError: Tracing the function could be noticed.
    """
    if function.__code__ in around:
        return function
    code = _code_of(function.__code__)
    if not code.plain:
        raise _NoticedError
    around = (*around, function.__code__)
    return (function.__code__, *(_contents_of(one, around) for one in _outside(function, code)))


def _contents_of(value: Any, around: tuple[CodeType, ...]) -> Hashable:
    """A value that code uses: the copies that are traced cannot change it."""
    kind = type(value)
    if value is None or isinstance(value, _NUMBERS):
        return kind, repr(value)
    if kind is tuple and all(one is None or isinstance(one, _NUMBERS) for one in value):
        return kind, repr(value)
    if kind is list and len(value) <= _MOST_NUMBERS:
        return (kind, *(_contents_of(one, around) for one in value))
    if kind is np.ndarray and value.dtype.kind == "f" and value.size <= _MOST_NUMBERS:
        return kind, value.dtype.str, value.shape, value.tobytes()
    if kind is FunctionType and not value.__module__.startswith("numpy"):
        return _contents(value, around)
    if _is_of_library(value):
        return id(value)
    if is_table(value) and not isinstance(value, type):
        return object()  # whose contents are not compared
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


def _contents_of_arguments(entries: Sequence[Entry]) -> Hashable:
    """Return a key of all entries of arguments that are not numbers."""
    found: list[Hashable] = []
    for one in entries:
        if isinstance(one, Listed):
            found.append(_contents_of_arguments(one.entries))
        elif not isinstance(one, Numbers):
            found.append(_contents_of(one.value, ()))
    return tuple(found)
