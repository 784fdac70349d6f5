"""Checks of arguments. Every error names the argument, the value, and what was expected."""

from __future__ import annotations

import math
import operator
import os
import reprlib
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from functools import lru_cache
from types import FunctionType
from typing import Any, NamedTuple, TypeGuard, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._core import all_finite, plain_times
from .labelled import named
from .suggestions import first_few, meant

Array = NDArray[Any]
EPS = float(np.finfo(float).eps)

#: The default tolerances, those of the suite. (The core has none: it is given tolerances with each problem.)
RTOL, ATOL = 1e-3, 1e-6

#: The largest number that the core's `int` holds.
LARGEST_INT = 2**31 - 1

#: Integers of this many bits are not written out: Python refuses to, and to read them, from 4300 digits on.
LONGEST_INT = 4096

#: The same for its counts.
LARGEST_COUNT = 2**63 - 1

_FLOAT = np.dtype(float)

#: The kinds of NumPy's types that are numbers; objects may be, which is tested.
_NUMERIC = "biufcO"

_Value = TypeVar("_Value")

_quiet = ContextVar("quiet", default=False)
_warned = ContextVar("warned", default=0)

#: What the paths of our own files start with.
PACKAGE = os.path.dirname(os.path.dirname(__file__)) + os.sep


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """A warning that points at the line of the caller of this package."""
    _warned.set(_warned.get() + 1)
    if _quiet.get():
        return
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(PACKAGE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def raised_in(error: BaseException) -> str:
    """The file of the code that raised an exception; "" without a traceback."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return "" if last is None else last.tb_frame.f_code.co_filename


def warnings_given() -> int:
    """Return the number of warnings that this thread has issued, or would have issued, so far."""
    return _warned.get()


@contextmanager
def quietly() -> Iterator[None]:
    """Suppress this package's warnings inside a `with` block: the user has had them already."""
    token = _quiet.set(True)
    try:
        yield
    finally:
        _quiet.reset(token)


#: Names of the places of arguments that other names have too.
_ALIKE = {"time": "t"}
#: Names of the derivative of what {0} is.
_RATES = ("{0}p", "d{0}", "{0}dot", "{0}_dot", "{0}prime", "d{0}dt")


def warn_of_order(name: str, fun: FunctionType, signature: str, instead: str = "") -> None:
    """Warn of a Python function whose parameters are those of a signature, such as "F(t, y, yp)", in another order, as
    their names show. Of functions of time and a state, by whatever name of the state, only the place of t counts."""
    expected = _places(signature)
    code = fun.__code__
    given = code.co_varnames[: min(code.co_argcount, len(expected))]
    if given == expected:
        return
    names = tuple(_ALIKE.get(one, one) for one in given)
    counted = expected if len(expected) > 2 else ("t",)
    places = [expected.index(one) if one in counted else i for i, one in enumerate(names)]
    exchanged = any(place < len(names) and names[place] != names[i] for i, place in enumerate(places))
    if exchanged or (len(names) > 2 and any(names[1] == one.format(names[2]) for one in _RATES)):
        called = signature if not name.isidentifier() else name + signature[signature.index("(") :]
        warn(f"{name} has the parameters ({', '.join(given)}) and is called as {called}: swap them{instead}")


@lru_cache(maxsize=64)
def _places(signature: str) -> tuple[str, ...]:
    """Return the names of the arguments of a signature, without further ones."""
    return tuple(one for one in signature[signature.index("(") + 1 : -1].split(", ") if not one.startswith("*"))


def call_name(fun: object, default: str) -> str:
    """A name for messages: the function's own, if it is informative."""
    name = getattr(fun, "__name__", None)
    if name == LAMBDIFIED:
        return _expression(fun) or default
    return encodable(name) if isinstance(name, str) and name != "<lambda>" else default


def encodable(name: str) -> str:
    """A name as the core and files take it: with question marks for lone surrogates, which UTF-8 does not have."""
    return name if name.isascii() else name.encode(errors="replace").decode()


#: What SymPy's `lambdify` calls every function that it makes.
LAMBDIFIED = "_lambdifygenerated"


def _expression(fun: object) -> str | None:
    """The formula that `lambdify` was given, which stands in the docstring that it writes."""
    _, found, rest = (getattr(fun, "__doc__", None) or "").partition("Expression:\n\n")
    text = rest.partition("\n\n")[0]
    text = text.removeprefix("Matrix([[").removesuffix("]])") if text.count("[") == 2 else text
    return " ".join(text.split()) if found and text else None


def distinct(names: list[str]) -> list[str]:
    """Return the names, numbered where they repeat, so that tables and columns are distinct."""
    if len(set(names)) == len(names):
        return names
    numbered = [f"{one}_{names[:i].count(one)}" if names.count(one) > 1 else one for i, one in enumerate(names)]
    return numbered if len(set(numbered)) == len(names) else [f"{one}_{i}" for i, one in enumerate(names)]


class _Shown(reprlib.Repr):
    """Short representations of users' values for messages, safe against errors that a repr can raise."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdict = self.maxdeque = 8
        self.maxlong, self.maxstring, self.maxother = 40, 80, 400

    def repr_int(self, x: int, level: int) -> str:
        """Python refuses to write out integers of thousands of digits."""
        return super().repr_int(x, level) if x.bit_length() < LONGEST_INT else f"an integer of {x.bit_length()} bits"


shown = _Shown().repr


def function(name: str, value: object, signature: str, instead: str = "") -> Any:
    """Return a function as given, with a warning if its parameters have another order than its signature; `instead`: as
    in `warn_of_order`."""
    if not callable(value):
        raise TypeError(f"{name} must be a function {signature}, got {shown(value)}")
    if isinstance(value, FunctionType):
        warn_of_order(name, value, signature, instead)
    return value


#: Types of what has no unit.
_WITHOUT_UNIT = frozenset({float, int, bool, complex, str, np.ndarray, np.float64, type(None)})


def require_no_unit(name: str, value: object) -> None:
    """Require that it is no quantity of a package for units, which NumPy would take for its number in whatever unit.

    Raises TypeError: It has a unit, or is a list or tuple that contains a quantity.
    """
    if type(value) in _WITHOUT_UNIT:
        return
    waiting, seen = [(name, value)], set[int]()
    while waiting:
        called, one = waiting.pop()
        if isinstance(one, (list, tuple)):
            if id(one) not in seen:  # it may contain itself
                seen.add(id(one))
                waiting += [(f"{called}[{i}]", x) for i, x in enumerate(one) if type(x) not in _WITHOUT_UNIT]
        # A label, as xarray's arrays may have one, is no unit that the numbers can be converted from.
        elif hasattr(one, "to_value") or hasattr(one, "magnitude"):
            for attribute in ("unit", "units"):
                if (unit := getattr(one, attribute, None)) is not None:
                    text = str(unit) or "a unit without dimension"
                    raise TypeError(
                        f"{called} is a quantity in {text}, and problems are of plain numbers: pass its number in the "
                        "unit that the functions of the problem expect"
                    )


def number(name: str, value: object) -> float:
    """A real number, and not NaN."""
    if type(value) is float and value == value:  # the common case
        return value
    require_no_unit(name, value)
    # NumPy makes real numbers of complex ones, and NaN of `masked`, with a warning.
    unfit = (str, bytes, bytearray, np.complexfloating)
    array = isinstance(value, np.ndarray) and (value.ndim or value.dtype.kind == "c")
    if isinstance(value, unfit) or array or is_masked(value):
        raise TypeError(f"{name} must be a real number, got {shown(value)}")
    try:
        result = float(value)  # type: ignore[arg-type]  # what has no float() is told apart right here
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a real number, got {shown(value)}") from None
    except OverflowError:
        raise _too_large(name, value) from None
    if math.isnan(result):
        raise ValueError(f"{name} must not be NaN")
    return result


def positive(name: str, value: object) -> float:
    result = number(name, value)
    if result <= 0:
        raise ValueError(f"{name} must be positive, got {shown(value)}")
    return result


def path(name: str, value: object) -> str:
    """The name of a file. A number would be the file that happens to be open under it."""
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(text, str):
        decode = ": decode it, os.fsdecode" if isinstance(text, bytes) else ""
        raise TypeError(f"{name} must be a str or path-like, got {shown(value)}{decode}")
    try:
        wrong = "it is empty" if not text else "it has a null character" if b"\0" in os.fsencode(text) else ""
    except UnicodeEncodeError as error:
        wrong = f"the file system has no {shown(text[error.start])}, a lone surrogate"
    if wrong:
        raise ValueError(f"{name} = {shown(text)} is not a name of a file: {wrong}. Give another name")
    return text


def positive_integer(name: str, value: object) -> int:
    return _counted(name, value, LARGEST_INT)


def count(name: str, value: object) -> int:
    """A positive integer that may be large."""
    return _counted(name, value, LARGEST_COUNT, ": leave it out")


def _counted(name: str, value: object, largest: int, instead: str = "") -> int:
    try:
        result = operator.index(value)  # type: ignore[arg-type]  # the same
    except TypeError:
        raise TypeError(f"{name} must be a positive integer, got {shown(value)}") from None
    if not 1 <= result <= largest:
        what = "a positive integer" if result < 1 else f"at most {largest}{instead}"
        raise ValueError(f"{name} must be {what}, got {shown(value)}")
    return result


def choice(name: str, value: object, known: Iterable[str]) -> str:
    known = list(known)
    if isinstance(value, str) and value in known:
        return value
    listed = ", ".join(map(repr, known))
    raise ValueError(f"{name} must be one of {listed}, got {shown(value)}{meant(value, known)}")


def either(known: Sequence[str]) -> str:
    """The known names, for messages: 'a', 'b' or 'c'."""
    *first, last = map(repr, known)
    return f"{', '.join(first)} or {last}"


def flag(name: str, value: object) -> bool:
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise TypeError(f"{name} must be True or False, got {shown(value)}")


def progress_or_function(name: str, value: Any) -> Any:
    """Return a flag, or a function that is called with the progress."""
    if callable(value):
        return value
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise TypeError(f"{name} must be True, False or a function {name}(done, total), got {shown(value)}")


def items(value: object) -> list[Any] | None:
    """The items of a list, a tuple, an array and the like; None for what has no items."""
    if type(value) is tuple or type(value) is list:  # the common case
        return list(value)
    if (
        isinstance(value, (bytes, bytearray, memoryview)) or not isinstance(value, Iterable) or hasattr(value, "tocsr")
    ):  # a sparse matrix, whose items are sparse matrices again
        return None
    try:
        return list(value)
    except TypeError:  # an array without dimensions
        return None


def interval(t_span: object) -> tuple[float, float]:
    """(t0, tf): t0 finite, tf finite or infinite; neither is -0.0, so that equal intervals are the same one."""
    require_no_unit("t_span", t_span)
    ends = items(t_span) or ()
    if len(ends) != 2:
        more = "; output times are t_eval=, so pass t_span=(times[0], times[-1]), t_eval=times" * (len(ends) > 2)
        raise ValueError(f"t_span must be a pair (t0, tf), got {shown(t_span)}{more}")
    t0, tf = number("t_span[0]", ends[0]), number("t_span[1]", ends[1])
    if math.isinf(t0):
        raise ValueError(f"t_span[0] must be finite, got {t0!r}")
    return t0 + 0.0, tf + 0.0


def kept(value: _Value) -> _Value:
    """A copy of what was given, which the caller could change."""
    if isinstance(value, np.ndarray) and type(value) is np.ndarray:  # the common case
        same: _Value = value.copy()
        return same
    if value is None or isinstance(value, float):
        return value
    if isinstance(value, memoryview):
        return cast("_Value", np.array(value))
    try:
        return copy(value)
    except TypeError:  # of an iterator: what reads the value says that it is none
        return value


def _too_large(name: str, value: object) -> ValueError:
    return ValueError(f"{name} must be within the range of a double, up to 1.8e308, got {shown(value)}")


def is_masked(value: object) -> TypeGuard[np.ma.MaskedArray[Any, Any]]:
    """Return whether a value is one of NumPy's masked arrays, whose module takes longer to import than the rest."""
    masked = sys.modules.get("numpy.ma")
    return masked is not None and isinstance(value, masked.MaskedArray)


def as_array(name: str, value: object) -> Array:
    """Return `value` as an array of any type and shape."""
    if type(value) is np.ndarray:  # the common case
        return value
    require_no_unit(name, value)
    if is_masked(value) and np.ma.getmaskarray(value).any():
        raise ValueError(f"{name} has masked entries, which have no values: give numbers for all of them")
    try:
        return np.asarray(value)
    except (ValueError, NotImplementedError):  # the second from older sparse arrays, as they are iterated over
        if hasattr(value, "__array__"):  # has its own error
            raise
        raise ValueError(
            f"{name} must be a number or an array of numbers, with rows of equal length, got {shown(value)}"
        ) from None


def numbers(name: str, value: object) -> Array:
    """A new array of float64 or complex128."""
    array = as_array(name, value)
    try:
        # NumPy makes numbers of dates and of digits in text, and NaN of None.
        if array.dtype.kind not in _NUMERIC or (array.dtype.kind == "O" and any(one is None for one in array.flat)):
            raise TypeError
        return np.array(array, dtype=complex if array.dtype.kind == "c" else float)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must hold numbers, got {_first_other(array, value)}") from None
    except OverflowError:
        raise _too_large(name, value) from None


def real_numbers(name: str, value: object) -> Array:
    """A new array of float64."""
    if type(value) is np.ndarray and value.dtype is _FLOAT:  # the common case
        return value.copy()
    require_no_unit(name, value)
    try:
        array = numbers(name, value)
    except TypeError:
        array = None
    if array is None or array.dtype.kind == "c":
        raise TypeError(f"{name} must hold real numbers, got {_first_other(np.asarray(value), value)}")
    return array


def _first_other(array: np.ndarray[Any, Any], value: object) -> str:
    """Return what an array holds that is no number: the first such entry of a list or column, else the value."""
    if array.dtype.kind in "mM":
        return "dates or durations: as numbers these are (value - start).dt.total_seconds() / 3600, in hours"
    listed = value if isinstance(value, (list, tuple)) else array.tolist()
    for i, one in enumerate(listed if array.ndim == 1 and array.dtype.kind in "OUS" else ()):
        if not isinstance(one, (int, float, complex)) and not _reads_as_number(one):
            return f"{shown(one)} at {i}"
    return shown(value)


def _reads_as_number(value: object) -> bool:
    """Return whether NumPy makes a number of this entry of a column, such as of digits in text."""
    try:
        float(value)  # type: ignore[arg-type]  # what has no float() is told apart here
    except (TypeError, ValueError):
        return False
    return True


def require_unlabelled(name: str, value: object) -> None:
    """Require values without names where none are known that these could be matched with.

    Raises TypeError: They have names.
    """
    if (found := named(name, value)) is not None:
        raise TypeError(f"{name} must be a list or an array, got values by name for {first_few([*found])}")


def state(y0: ArrayLike, name: str = "y0") -> Array:
    """The initial state as a new array of shape (n,)."""
    require_unlabelled(name, y0)
    y = as_array(name, y0)
    if y.ndim != 1:
        form = "a list or an array of numbers, for one component [1.0]" if y.ndim == 0 else "numpy.ravel makes it so"
        raise ValueError(f"`{name}` must be 1-dimensional, got shape {y.shape}: {shown(y0)}; {form}")
    y = y.copy() if y.dtype is _FLOAT else numbers(name, y)
    if not all_finite(y):
        i = int(np.flatnonzero(~np.isfinite(y))[0])
        raise ValueError(f"All components of the initial state `{name}` must be finite, got {name}[{i}] = {y[i]}")
    return y


def tolerance(name: str, value: ArrayLike, n: int) -> Array:
    """A tolerance as an array of shape () or (n,), finite and not negative."""
    require_no_unit(name, value)
    try:
        result = real_numbers(name, value)
    except TypeError:
        raise TypeError(f"{name} must be a number or {n} numbers, got {shown(value)}") from None
    if result.ndim > 1 or (result.ndim == 1 and result.shape != (n,)):
        raise ValueError(f"{name} must be a number or have shape ({n},), got shape {result.shape}")
    if not np.isfinite(result).all() or (result < 0).any():
        raise ValueError(f"{name} must be finite and not negative, got {shown(value)}")
    return result


def reals(y: Array) -> int:
    """Return the number of reals that make up y, of shape (n,): 2n if y is complex, else n."""
    return 2 * len(y) if y.dtype.kind == "c" else len(y)


#: What an error test can tell from roundoff.
LEAST_RTOL = 100 * EPS


class Weights(NamedTuple):
    """The weights of the error test, max(s_i |y_i|, thr_i), for the reals that make up y."""

    rtol: float  # the smallest
    threshold: float | Array
    scale: Array | None = None  # None: 1

    @property
    def atol(self) -> Array:
        """The absolute tolerances."""
        return self.rtol * np.asarray(self.threshold)

    def of(self, y: Array) -> Array:
        """Return the tolerances at a state y (n,), rtol times the weights."""
        size = np.abs(y) if self.scale is None else self.scale * np.abs(y)
        return self.rtol * np.maximum(size, self.threshold)


def weights_of(rtol: ArrayLike, atol: ArrayLike, y: Array, least: float = LEAST_RTOL) -> Weights:
    """Return the weights of these tolerances for states like y; a relative one below `least` is raised, with a
    warning."""
    if type(rtol) is float and type(atol) is float and least <= rtol < math.inf and 0 <= atol < math.inf:
        return Weights(rtol, atol / rtol)  # the common case, without arrays
    pairs = 2 if y.dtype.kind == "c" else 1
    relative, absolute = tolerance("rtol", rtol, len(y)), tolerance("atol", atol, len(y))
    if (relative < least).any():
        why = " (100 units of roundoff)" if least == LEAST_RTOL else ""
        warn(f"At least one element of `rtol` is too small: raised to {least:.3g}{why}")
        relative = np.maximum(relative, least)
    smallest = float(relative.min()) if relative.size else RTOL
    threshold = np.repeat(np.broadcast_to(absolute / smallest, y.shape), pairs)
    scale = np.repeat(relative / smallest, pairs) if relative.ndim == 1 and (relative != smallest).any() else None
    return Weights(smallest, threshold, scale)


#: Output times that lie beyond the interval by at most this, relative to its ends, do so by rounding.
_ROUNDED = 2.0**-40


def output_times(t_eval: ArrayLike, t0: float, tf: float) -> Array:
    """t_eval as an array, inside the interval and in the order of integration."""
    times = plain_times(t_eval, t0, tf)
    if times is not None:  # the common case
        return times
    given = real_numbers("t_eval", t_eval)
    if given.ndim != 1:
        raise ValueError(
            f"`t_eval` must be 1-dimensional, the times themselves, as in numpy.linspace(t0, tf, 101), got "
            f"{shown(t_eval)}"
        )
    times = plain_times(given, t0, tf)
    if times is not None:
        return times
    low, high = min(t0, tf), max(t0, tf)
    outside = ~((given >= low) & (given <= high))
    if outside.any():
        first = float(given[outside][0])
        beyond = min(abs(first - t0), abs(first - tf))
        rounded = f", {beyond:.1g} beyond the end by rounding: numpy.clip(t_eval, {low!r}, {high!r})"
        close = rounded if beyond <= _ROUNDED * max(abs(t0), abs(tf)) else ""
        raise ValueError(f"Values in `t_eval` are not within `t_span`, ({t0}, {tf}): {first}{close}")
    raise ValueError("Values in `t_eval` are not properly sorted: strictly, in the direction of integration")


def extra_arguments(args: object) -> tuple[Any, ...]:
    if args is None:
        return ()
    require_no_unit("args", args)
    if named("args", args) is not None:
        raise TypeError(
            f"args are the values one by one, in a tuple, got {shown(args)}: numbers by name are "
            "Problem(parameters=...), with f(t, y, p); one dict as an argument is args=(d,)"
        )
    listed = None if isinstance(args, str) else items(args)
    if listed is None:
        raise TypeError(
            f"Supplied 'args' cannot be unpacked: give a tuple of the extra arguments, for one args=({shown(args)},)"
        )
    return tuple(listed)


def default_labels(size: int) -> list[str]:
    """Return labels of components, made on demand: for a large problem they take more memory than the solution."""
    return [f"y{i}" for i in range(size)]


def distinct_labels(labels: object, n: int) -> list[str]:
    """Names of n components."""
    names = None if isinstance(labels, str) else items(labels)
    if names is None or not all(isinstance(name, str) for name in names):
        raise TypeError(f"labels must be a list of {n} str, got {shown(labels)}")
    if len(names) != n:
        raise ValueError(f"labels must name the {n} components of y0, got {shown(labels)}")
    names = [encodable(name) for name in names]
    if len(set(names)) < n:
        raise ValueError(f"labels must differ from each other, got {shown(labels)}")
    return names
