"""Copies of functions, in which NumPy, `math` and a few of Python's functions take traced values."""

from __future__ import annotations

import builtins
import cmath
import dis
import functools
import math
import sys
import types
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ..compiled import CompiledFunction
from ..contents import has_own_code, is_of_numbers, is_of_others, nested
from .complexes import pair
from .nodes import ELEMENTARY, Node, TraceError
from .selections import MOST_CODES, helpers, selecting
from .tables import TracedTable, is_table
from .traced import TracedArray, cells_of, has_traced, is_complex, standing_for, wrapped
from .universal import BINARY, UNARY, number

#: Larger arrays from outside stay arrays of floats.
_MOST_CONSTANTS = 10_000
#: What a traced function must not do.
_FORBIDDEN = {"print", "input", "open", "exec", "eval", "globals", "locals", "vars", "setattr", "delattr"}


_ITEMS = ("__setitem__", "__delitem__")


def _refuses(why: str) -> Callable[..., Any]:
    def refuse(*_: Any, **__: Any) -> Any:
        raise TraceError(why)

    return refuse


def _read_only(kind: type, *methods: str) -> type:
    """Return a type of lists, dictionaries or sets whose methods that write raise a TraceError."""
    refuse = _refuses(f"it writes to a {kind.__name__} that it does not make")
    return type(kind.__name__, (kind,), dict.fromkeys(methods, refuse))


#: Types that stand for lists, dictionaries and sets in copies of functions.
_READ_ONLY: dict[type, type] = {
    list: _read_only(
        list,
        *("append", "extend", "insert", "pop", "remove", "clear", "sort", "reverse", "__iadd__", "__imul__"),
        *_ITEMS,
    ),
    dict: _read_only(dict, "update", "pop", "popitem", "clear", "setdefault", *_ITEMS, "__ior__"),
    set: _read_only(set, "add", "update", "pop", "remove", "discard", "clear", "__ior__", "__iand__", "__isub__"),
}


class Copies:
    """Functions in whose copies the libraries take traced values."""

    def __init__(self, run: Any, selections: bool) -> None:
        self._run, self._selections = run, selections
        self._made: dict[int, Any] = {}
        self._kept: list[Any] = []  # so that no id is used twice
        self._numpy, self._math = _NumPy(run), _Math(run)
        self._builtins = _python(run)
        self._helpers = helpers(run.decide) if selections else {}

    def of(self, value: Any) -> Any:
        """Return the copy of a value, or the value itself if it needs none."""
        if id(value) in self._made:
            return self._made[id(value)]
        made = self._copied(value)
        if made is not value:
            self._made[id(value)] = made
            self._kept.append(value)
        return made

    def _copied(self, value: Any) -> Any:
        if value is np:
            return self._numpy
        if value is np.linalg:
            return self._numpy.linalg
        if value is math:
            return self._math
        if value is cmath:
            return self._numpy
        if isinstance(value, types.ModuleType):
            return _Interpolation(value, self._run) if value.__name__ == "scipy.interpolate" else value
        if is_table(value):
            return TracedTable(value, self._run.decide)
        if _is_polynomial(value):
            return _Polynomial(value)
        if isinstance(value, np.ndarray):
            return self._constants(value)
        if type(value) in _READ_ONLY:
            return self._collection(value)
        if type(value) is tuple:
            return tuple(map(self.of, value))
        if type(value) is types.SimpleNamespace:
            return types.SimpleNamespace(**{name: self._unless_used(one) for name, one in vars(value).items()})
        if isinstance(value, CompiledFunction) and not value.inplace:
            return self.of(value.fun)
        module = getattr(value, "__module__", None)
        if isinstance(value, (np.ufunc, types.BuiltinFunctionType)) or (module or "").partition(".")[0] == "numpy":
            return self._of_library(value, module or "")
        if isinstance(value, types.FunctionType):
            return value if is_of_others(module) else self._function(value)
        if isinstance(value, types.MethodType):
            return types.MethodType(self.of(value.__func__), self.of(value.__self__))
        if isinstance(value, functools.partial):
            keywords = {name: self.of(one) for name, one in value.keywords.items()}
            return functools.partial(self.of(value.func), *map(self.of, value.args), **keywords)
        if hasattr(value, "py_func"):
            return self.of(value.py_func)  # numba's
        if isinstance(value, (staticmethod, classmethod)):
            return type(value)(self.of(value.__func__))
        if isinstance(value, property):
            return property(self.of(value.fget))
        if not isinstance(value, type) and not is_of_others(module) and has_own_code(type(value)):
            return self._object(value)
        return value

    def _unless_used(self, value: Any) -> Any:
        """Return the copy of a value that the function need not use: a function that cannot be copied must not be
        called."""
        try:
            return self.of(value)
        except TraceError as error:
            return _refuses(str(error))

    def _constants(self, value: Any) -> Any:
        """An array from outside that cannot be changed; one of floats, whose methods then take traced values."""
        if type(value) is not np.ndarray or not is_of_numbers(value.dtype) or value.size > _MOST_CONSTANTS:
            return value
        if value.dtype.kind != "f":  # which may be indices, or columns with names
            made = value.copy()
            made.flags.writeable = False
            return made
        cells = cells_of(value, self._run._graph)
        cells.flags.writeable = False
        return TracedArray(cells, self._run.decide)

    def _collection(self, value: Any) -> Any:
        """A list, dictionary or set from outside, with what stands for its values; writing to it is refused."""
        kind = _READ_ONLY[type(value)]
        made = self._made[id(value)] = kind()  # it may contain itself
        self._kept.append(value)
        if isinstance(value, dict):
            dict.update(made, {name: self.of(one) for name, one in value.items()})
        elif isinstance(value, list):
            list.extend(made, map(self.of, value))
        else:
            set.update(made, value)
        return made

    def _of_library(self, value: Any, module: str) -> Any:
        name = getattr(value, "__name__", "")
        if module == "cmath" and hasattr(np, name):
            return getattr(self._numpy, name)
        if module == "math":
            return getattr(self._math, name)
        if isinstance(value, np.ufunc) or getattr(np, name, None) is value:
            return getattr(self._numpy, name)
        return value

    def _function(self, function: types.FunctionType) -> Any:
        names = _names(function.__code__)
        if written := _written(function.__code__):
            raise TraceError(f"{function.__name__} writes to {written}, which is not its own")
        if _has_handlers(function.__code__):
            raise TraceError(f"{function.__name__} handles exceptions, which symbolic values do not raise")
        code = (selecting(function) if self._selections else None) or function.__code__
        found = {**function.__globals__}
        cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        closed = tuple(types.CellType() for _ in code.co_freevars)
        copy = types.FunctionType(code, found, function.__name__, None, closed)
        self._made[id(function)] = copy  # it may call itself
        self._kept.append(function)
        if function.__defaults__ is not None:
            copy.__defaults__ = tuple(map(self.of, function.__defaults__))
        if function.__kwdefaults__ is not None:
            copy.__kwdefaults__ = {name: self.of(one) for name, one in function.__kwdefaults__.items()}
        for name, cell in zip(code.co_freevars, closed, strict=True):
            if name not in cells:  # a global function that calls itself: its rewritten code stands within another one
                cell.cell_contents = self.of(function.__globals__[name])
            elif _is_full(cells[name]):
                cell.cell_contents = self.of(cells[name].cell_contents)
        for name in names & found.keys():
            found[name] = self.of(found[name])
        for name in names - function.__globals__.keys():
            if name in self._builtins:
                found[name] = self._builtins[name]
        found.update(self._helpers)
        return copy

    def _object(self, value: Any) -> Any:
        """An object with copies of its methods, and its own data."""
        kind = type(value)
        methods: dict[str, Any] = {"__setattr__": _refuses(f"it writes to attributes of {kind.__name__}")}
        for one in reversed(kind.__mro__[:-1]):
            for name, found in vars(one).items():
                own = not name.startswith("__") or name in ("__call__", "__getattr__", "__getitem__")
                if own and isinstance(found, _OF_CLASSES):
                    methods[name] = self._unless_used(found)
        try:
            copy: Any = object.__new__(type(kind.__name__, (kind,), methods))
            self._made[id(value)] = copy
            vars(copy).update({name: self._unless_used(one) for name, one in vars(value).items()})
        except (TypeError, AttributeError):  # slots, or a type that is made in another way, such as an enumeration
            self._made[id(value)] = value
            return value
        return copy


#: What classes contain that is copied with their objects.
_OF_CLASSES = (types.FunctionType, staticmethod, classmethod, property, np.ndarray, list, dict, set)


def _is_full(cell: Any) -> bool:
    try:
        cell.cell_contents  # noqa: B018  # raises if it is empty
    except ValueError:
        return False
    return True


@functools.lru_cache(MOST_CODES)
def _names(code: types.CodeType) -> frozenset[str]:
    """Return the set of names that code and the functions in it use."""
    return frozenset(name for one in nested(code) for name in one.co_names)


@functools.lru_cache(MOST_CODES)
def _written(code: types.CodeType) -> str | None:
    """A variable from outside that code assigns to."""
    for one in dis.get_instructions(code):
        outer = one.opname == "STORE_DEREF" and one.argval in code.co_freevars
        if one.opname == "STORE_GLOBAL" or outer:
            return str(one.argval)
    return None


@functools.lru_cache(MOST_CODES)
def _has_handlers(code: types.CodeType) -> bool:
    """Return whether code has `except` or `finally`; `with` and generators have tables of exceptions too."""
    names = [one.opname for one in dis.get_instructions(code)]
    return names.count("PUSH_EXC_INFO") > names.count("WITH_EXCEPT_START")


class _NumPy:
    """NumPy, whose functions take lists of traced values, and whose new arrays can hold them."""

    def __init__(self, run: Any, module: Any = np) -> None:
        self._run, self._module = run, module
        if module is np:
            self.linalg = _NumPy(run, np.linalg)
            self.r_ = _Joined(run)

    def __getattr__(self, name: str) -> Any:
        value, allowed = getattr(self._module, name), self._run.numpy
        if name == "random" or name.startswith("fft") or (allowed is not None and name not in allowed):
            raise TraceError(f"numpy.{name}")
        if (isinstance(value, (types.ModuleType, type)) and name not in ("float64",)) or not callable(value):
            return value
        run = self._run
        made = _CREATED.get(name)

        def call(*args: Any, **kwargs: Any) -> Any:
            if made is not None:
                return made(run, value, args, kwargs)
            if any(map(has_traced, args)) or any(map(has_traced, kwargs.values())):
                args = tuple(_gathered(one, run) for one in args)
                kwargs = {key: _gathered(one, run) for key, one in kwargs.items()}
            return value(*args, **kwargs)

        return standing_for(value, call) if isinstance(value, type) else call


class _Joined:
    """`numpy.r_` for arrays, numbers and slices."""

    def __init__(self, run: Any) -> None:
        self._run = run

    def __getitem__(self, key: Any) -> Any:
        if not has_traced(key):
            return _filled(self._run, np.r_[key])
        if is_complex(key):
            return np.concatenate([np.atleast_1d(pair(one, self._run._real)) for one in key])
        if isinstance(key[0], str):
            raise TraceError("numpy.r_ with a string")
        parts = [np.r_[one] if isinstance(one, slice) else one for one in key]
        cells = [np.atleast_1d(cells_of(one, self._run._graph)) for one in parts]
        return TracedArray(np.concatenate(cells), self._run.decide)


_POLYNOMIALS = ("Polynomial", "Chebyshev", "Legendre", "Laguerre", "Hermite", "HermiteE")


def _is_polynomial(value: Any) -> bool:
    """Return whether a value is a polynomial of `numpy.polynomial`, a module that is imported where there is one."""
    module = sys.modules.get("numpy.polynomial")
    return module is not None and isinstance(value, tuple(getattr(module, name) for name in _POLYNOMIALS))


class _Polynomial:
    """A polynomial of `numpy.polynomial`, of traced values: of their place in its window, by its own rule."""

    def __init__(self, polynomial: Any) -> None:
        self._polynomial = polynomial

    def __call__(self, x: Any) -> Any:
        if not has_traced(x):
            return self._polynomial(x)
        offset, scale = self._polynomial.mapparms()
        return self._polynomial._val(offset + scale * x, self._polynomial.coef)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._polynomial, name)


class _Interpolation:
    """`scipy.interpolate`, whose interpolators take traced values."""

    def __init__(self, module: Any, run: Any) -> None:
        self._module, self._run = module, run

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._module, name)
        return TracedTable(found, self._run.decide) if is_table(found) else found


def _gathered(value: Any, run: Any) -> Any:
    """A list of traced values as an array, if its rows have one shape."""
    if isinstance(value, (list, tuple)) and has_traced(value):
        if is_complex(value):
            return value
        try:
            return TracedArray(cells_of(value, run._graph), run.decide)
        except TraceError:
            return value
    return value


def _array(run: Any, function: Any, args: Any, kwargs: Any) -> Any:
    first, *_ = args
    if isinstance(first, TracedArray) and function.__name__ != "array" and len(args) == 1 and not kwargs:
        return first
    if is_complex(first) and has_traced(first):
        return pair(first, run._real).copy()
    if has_traced(first):
        found = TracedArray(cells_of(first, run._graph).copy(), run.decide)
        dtype = kwargs.get("dtype", args[1] if len(args) > 1 else None)
        if dtype is not None and np.dtype(dtype).kind not in "fc":
            raise TraceError(f"an array of {np.dtype(dtype)} made of values")
        return found if dtype is None or np.dtype(dtype).kind != "c" else found.astype(complex)
    return _filled(run, function(*args, **kwargs))


def _filled(run: Any, found: Any) -> Any:
    """An array of floats, as one that can hold traced values. Integers, which may be indices, stay."""
    if isinstance(found, np.ndarray) and found.dtype.kind == "c":
        return pair(found, run._real)
    if not isinstance(found, np.ndarray) or found.dtype.kind != "f":
        return found
    return TracedArray(cells_of(found, run._graph), run.decide)


def _new(run: Any, function: Any, args: Any, kwargs: Any) -> Any:
    if any(map(has_traced, args)):
        return function(*args, **kwargs)  # zeros_like and so on
    return _filled(run, function(*args, **kwargs))


def _number(run: Any, function: Any, args: Any, kwargs: Any) -> Any:
    return args[0] if args and isinstance(args[0], TracedArray) else function(*args, **kwargs)


_CREATED: dict[str, Callable[..., Any]] = {
    **dict.fromkeys(("array", "asarray", "ascontiguousarray", "asanyarray", "asfarray"), _array),
    **dict.fromkeys(("zeros", "empty", "ones", "full", "zeros_like", "empty_like", "ones_like", "full_like"), _new),
    "float64": _number,
}


class _Math:
    """`math`, whose functions take traced values."""

    def __init__(self, run: Any) -> None:
        self._run = run

    def __getattr__(self, name: str) -> Any:
        value = getattr(math, name)
        if not callable(value):
            return value
        run = self._run

        def call(*args: Any) -> Any:
            if not any(map(has_traced, args)):
                return value(*args)
            if name not in _MATHEMATICAL:
                raise TraceError(f"math.{name}")
            cells = [cells_of(one, run._graph) for one in args]
            if any(one.size != 1 for one in cells):
                raise TypeError("only length-1 arrays can be converted to Python scalars")
            return wrapped(_MATHEMATICAL[name](*(number(one.ravel()[0]) for one in cells)), run.decide)

        return call


_MATHEMATICAL: dict[str, Callable[..., Node]] = {
    **{name: UNARY[name] for name in ELEMENTARY},
    **{name: UNARY[name] for name in ("fabs", "floor", "ceil", "trunc", "degrees", "radians", "isnan", "isfinite")},
    "pow": lambda a, b: a**b,
    "atan2": lambda a, b: a.graph.make("atan2", a, b),
    "hypot": lambda a, b: a.graph.make("hypot", a, b),
    "fmod": BINARY["fmod"],
    "copysign": lambda a, b: a.graph.select(
        a.graph.make("less", b, a.graph.node(0.0)), -a.graph.make("abs", a), a.graph.make("abs", a)
    ),
}


def _python(run: Any) -> dict[str, Any]:
    """Python's functions that ask for values, in forms that take traced ones."""

    def extreme(name: str) -> Callable[..., Any]:
        plain = getattr(builtins, "max" if name == "maximum" else "min")

        def call(*args: Any, **kwargs: Any) -> Any:
            items = list(args[0]) if len(args) == 1 and isinstance(args[0], Iterable) else list(args)
            if kwargs or not has_traced(items):
                return plain(items, **kwargs) if len(args) == 1 else plain(*args, **kwargs)
            nodes = [number(cells_of(one, run._graph)[()]) for one in items]
            return wrapped(functools.reduce(lambda a, b: run._graph.make(name, a, b), nodes), run.decide)

        return call

    def as_float(value: Any = 0.0) -> Any:
        if not isinstance(value, TracedArray):
            return float(value)
        if value.size != 1:
            raise TypeError("only length-1 arrays can be converted to Python scalars")
        return wrapped(number(value.cells.ravel()[0]), run.decide)

    kept = {"max": extreme("maximum"), "min": extreme("minimum"), "float": standing_for(float, as_float)}
    return kept | {name: _refuses(f"{name}()") for name in _FORBIDDEN}
