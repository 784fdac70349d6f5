"""What tells one problem from another, in text and numbers: for files that go on with a problem."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from types import CodeType, FunctionType
from typing import Any

import numpy as np

from ._arguments import call_name
from .compiled import CompiledFunction

__all__ = ["identity"]

#: The most numbers of an array that are written out; a larger one becomes a digest.
_FEW = 8


def identity(value: Any) -> Any:
    """What `value` is, as JSON can hold it: equal for what is written alike, in another process too."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, float, np.number)):
        number = value.item() if isinstance(value, np.generic) else value
        return (
            number if isinstance(number, int) or (isinstance(number, float) and math.isfinite(number)) else repr(number)
        )
    if isinstance(value, np.ndarray):
        listed = value.size <= _FEW and value.dtype != object
        return identity(value.tolist()) if listed else f"array {value.shape} {_digest(_parts(value))}"
    if isinstance(value, (list, tuple)):
        return [identity(one) for one in value]
    if isinstance(value, Mapping):
        return {str(name): identity(one) for name, one in value.items()}
    function = _function(value)
    if function is not None:
        libm = isinstance(value, CompiledFunction) and value.elementary == "libm"
        return f"{call_name(value, 'function')} ({_digest(_code(function, set()))}{', libm' * libm})"
    own = getattr(value, "__dict__", None)
    if type(value).__module__.startswith("invariode.") and own is not None:
        about = {name: identity(one) for name, one in own.items() if not name.startswith("_")}
        return {"type": type(value).__name__, **about}
    return call_name(value, type(value).__qualname__)


def _function(value: Any) -> FunctionType | None:
    """The Python function behind a function, if there is one."""
    if isinstance(value, CompiledFunction):
        value = value.fun
    value = getattr(value, "py_func", value)  # numba's
    return value if isinstance(value, FunctionType) else None


def _digest(parts: Iterator[bytes]) -> str:
    found = hashlib.blake2b(digest_size=6)
    for part in parts:
        found.update(part)
    return found.hexdigest()


def _parts(value: np.ndarray[Any, Any]) -> Iterator[bytes]:
    yield str(value.dtype).encode()
    yield np.ascontiguousarray(value).tobytes() if value.dtype != object else repr(value.tolist()).encode()


def _code(function: FunctionType, seen: set[int]) -> Iterator[bytes]:
    """The code of a function, and what it uses by name: constants, arrays and functions."""
    if id(function) in seen:
        return
    seen.add(id(function))
    yield from _instructions(function.__code__)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    used = [function.__globals__[name] for name in _names(function.__code__) if name in function.__globals__]
    for value in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *cells, *used):
        inner = _function(value)
        if inner is not None and inner.__module__ == function.__module__:
            yield from _code(inner, seen)
        elif isinstance(value, (bool, int, float, complex, str, tuple)):
            yield repr(value).encode()
        elif isinstance(value, np.ndarray):
            yield from _parts(value)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _names(one)


def _instructions(code: CodeType) -> Iterator[bytes]:
    yield code.co_code
    yield repr((code.co_names, code.co_varnames)).encode()
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _instructions(one)
        else:
            yield repr(one).encode()
