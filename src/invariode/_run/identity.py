"""What tells one problem or run from another, as data: a file that goes on with one is refused to any other, and the
difference is named."""

from __future__ import annotations

import dis
import hashlib
import math
from collections.abc import Iterator, Mapping
from functools import partial
from types import CodeType, FunctionType
from typing import Any, NamedTuple, cast

import numpy as np

from .._base.arguments import Array, call_name, shown
from .._base.types import MethodName
from .._functions.compiled import CompiledFunction, CoreFunction
from .._functions.graph.python import Formula
from .._problem.breakpoints import to_breakpoints
from .._problem.description import Description
from .._problem.methods import find_method
from .._problem.options import Options, table_of

__all__ = ["Identity", "identity_of_run", "in_words", "known_identity", "options_of", "require_same"]

#: The most numbers of an array that are written out; a larger one becomes a digest.
_FEW = 8

#: Options of who looks at a run, which it goes on without.
_OF_THE_SESSION = frozenset({"progress", "on_interrupt", "on_failure", "checkpoint"})

#: Values of f that differ by less, relative to the largest component, are the same: another machine rounds otherwise.
_SAME = 1e-9


def _array(value: Array) -> str:
    return f"array {value.shape} {_digest(_parts(value))}"


# ----------------------------------------------------------------------------------------------------------------------
# Values and code


def in_words(value: Any) -> Any:
    """What `value` is, as JSON can hold it: equal for what is written alike, in another process too. Of a function its
    code."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, float, np.number)):
        number = value.item() if isinstance(value, np.generic) else value
        return (
            number if isinstance(number, int) or (isinstance(number, float) and math.isfinite(number)) else repr(number)
        )
    if isinstance(value, np.ndarray):
        return in_words(value.tolist()) if value.size <= _FEW and value.dtype != object else _array(value)
    if isinstance(value, (list, tuple)):
        return [in_words(one) for one in value]
    if isinstance(value, Mapping):
        return {str(name): in_words(one) for name, one in value.items()}
    code = _digest_of_code(value)
    if code is not None:
        libm = isinstance(value, CompiledFunction) and value.elementary == "libm"
        return f"{call_name(value, 'function')} ({code}{', libm' * libm})"
    own = getattr(value, "__dict__", None)
    if type(value).__module__.startswith("invariode.") and own is not None:
        about = {name: in_words(one) for name, one in own.items() if not name.startswith("_")}
        return {"type": type(value).__name__, **about}
    return call_name(value, type(value).__qualname__)


def _function(value: Any) -> FunctionType | None:
    """The Python function behind a function or a callable object, if there is one."""
    if isinstance(value, CompiledFunction):
        value = value.fun
    value = getattr(value, "py_func", value)  # numba's
    value = getattr(value, "__func__", value)  # a method's
    if not isinstance(value, FunctionType) and not isinstance(value, type):
        value = vars(type(value)).get("__call__")
    return value if isinstance(value, FunctionType) else None


def _digest_of_code(value: Any) -> str | None:
    """A number for the code of a function; None: it has no code of Python's."""
    if isinstance(value, partial):
        inner = _digest_of_code(value.func)
        bound = (value.args, sorted(value.keywords.items()))
        return inner and _digest(iter([inner.encode(), repr(in_words(bound)).encode()]))
    if isinstance(value, CoreFunction):
        codes = [_digest_of_code(one) for one in value.functions]
        return _digest(iter([repr(codes).encode()])) if any(codes) else None
    formula = value.fun if isinstance(value, CompiledFunction) else value
    if isinstance(formula, Formula):
        return _digest(iter([formula.text.encode()]))
    function = _function(value)
    if function is None or (function.__module__ or "").startswith("invariode."):
        return None
    return _digest(_code(function, set()))


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
    own = set(_rebound(function.__code__))  # what it changes itself is its memory, not its code
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=False)
    kept = [cell.cell_contents for name, cell in cells if name not in own and _is_filled(cell)]
    names = [name for name in _names(function.__code__) if name not in own]
    used = [function.__globals__[name] for name in names if name in function.__globals__]
    for value in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *kept, *used):
        inner = _function(value)
        if inner is not None and inner.__module__ == function.__module__:
            yield from _code(inner, seen)
        elif isinstance(value, (bool, int, float, complex, str, tuple)):
            yield repr(value).encode()
        elif isinstance(value, np.ndarray):
            yield from _parts(value)


def _is_filled(cell: Any) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _rebound(code: CodeType) -> Iterator[str]:
    """Names from outside that a function binds anew."""
    for one in dis.get_instructions(code):
        if one.opname in ("STORE_GLOBAL", "STORE_DEREF"):
            yield one.argval
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _rebound(inner)


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
            yield repr(_in_order(one)).encode()


def _in_order(constant: Any) -> Any:
    """A constant of a function, without the order that a set has in this process only."""
    if isinstance(constant, frozenset):
        return sorted(map(repr, constant))
    return tuple(map(_in_order, constant)) if isinstance(constant, tuple) else constant


# ----------------------------------------------------------------------------------------------------------------------
# A run


class Identity(NamedTuple):
    """In JSON's types, and arrays by name."""

    about: dict[str, Any]
    arrays: dict[str, Array]


def identity_of_run(problem: Description, method: MethodName, options: Mapping[str, Any]) -> Identity:
    """That of a run. Evaluates f at the start."""
    about: dict[str, Any] = {"method": find_method(method)[0].name, "options": {}, "arrays": [], "functions": []}
    arrays: dict[str, Array] = {"y0": problem.y0, "f0": _slope(problem)}  # first: f may fill an array that it returns
    for name, value in options.items():
        if value is None or name in _OF_THE_SESSION:
            continue
        if isinstance(value, np.generic):
            value = value.item()
        if name == "breakpoints":
            arrays[name] = _times(value)
            acts = any(point.action is not None for point in to_breakpoints(name, value))
            about["functions" if acts else "arrays"].append(name)
        elif callable(value):
            about["functions"].append(name)
        elif isinstance(value, (bool, int, float, str)):
            about["options"][name] = value
        elif name == "prefer":
            about["options"][name] = list(value)
        else:
            about["arrays"].append(name)
            arrays[name] = np.asarray(value)
    about["bdf"] = bool(find_method(method)[1].get("bdf"))  # which a name of SciPy's implies
    about["problem"] = _described(problem)
    about["code"] = _codes(problem, options.get("breakpoints"))
    return Identity(about, arrays)


def known_identity(about: Any, arrays: dict[str, Array]) -> Identity:
    """That of a file. Raises whatever the damage causes: what is not there, or of another type."""
    kinds = {"method": str, "options": dict, "arrays": list, "functions": list, "bdf": bool, "problem": dict}
    for name, kind in {**kinds, "code": dict}.items():
        if not isinstance(about[name], kind):
            raise TypeError(f"{name} of the run is of type {type(about[name]).__name__}")
    known = table_of(Options).keys() - _OF_THE_SESSION
    for name in (*about["options"], *about["arrays"], *about["functions"]):
        if not isinstance(name, str) or name not in known:
            raise ValueError(f"{shown(name)} is no option of a run")
    for name in ("y0", "f0", *about["arrays"], *{"breakpoints"}.intersection(about["functions"])):
        arrays[name]
    return Identity(about, arrays)


def options_of(stored: Identity, given: Mapping[str, Any]) -> Options:
    """The options of the run of a file. `given`: those with functions, which are not in the file, and others, which
    must agree with those in it."""
    about, arrays = stored
    options: dict[str, Any] = {**about["options"], **{name: arrays[name] for name in about["arrays"]}}
    if about["bdf"]:
        options["bdf"] = True
    for name, value in given.items():
        if name in about["functions"] or name in _OF_THE_SESSION:
            options[name] = value
        elif not _equal(options.get(name), value):
            was = _told(options.get(name))
            raise ValueError(f"{name} is {value!r} here, and {was} in the file: leave it out, or load another file")
    for name in about["functions"]:
        if name not in given:
            raise ValueError(f"the run has {name} with functions, which are not in the file: give {name}=... too")
    if "breakpoints" in about["functions"]:
        here, there = _times(given["breakpoints"]), arrays["breakpoints"]
        if not _equal(there, here):
            raise ValueError(
                f"breakpoints are at {_told(here)} here, and at {_told(there)} in the file: give those of the run"
            )
    return cast("Options", options)


def require_same(stored: Identity, problem: Description, given: Mapping[str, Any], trust: str | None) -> None:
    """Raises a ValueError that names what differs, if it is another problem, or, unless the code is trusted, if
    functions have another code."""
    now = identity_of_run(problem, stored.about["method"], {})
    here, there = now.about["problem"], stored.about["problem"]
    pairs = [(what, here.get(what), was) for what, was in there.items() if here.get(what) != was]
    if not pairs:
        pairs = [
            (what, _told(now.arrays[name]), _told(stored.arrays[name]))
            for name, what in (("y0", "y0"), ("f0", "fun at the start"))
            if not _close(now.arrays[name], stored.arrays[name])
        ]
    for what, value, was in pairs:
        raise ValueError(
            f"the file belongs to another problem: {what}: {value} here, {was} in the file. Give the problem of the run"
        )
    codes = _codes(problem, given.get("breakpoints"))
    was_code = stored.about["code"]
    edited = [name for name, code in codes.items() if name in was_code and was_code[name] != code]
    if edited and trust is None:
        raise ValueError(
            f"the code of {', '.join(edited)} is not that of the run. Give the functions of the run; if they compute "
            'the same (they were only edited, or Python is another one), load(..., trust="code")'
        )


def _codes(problem: Description, breakpoints: Any) -> dict[str, str]:
    """The code of each of the user's functions, by what messages call it."""
    functions = {"fun": problem.fun, **vars(problem.matrices)}
    for i, law in enumerate(problem.invariants):
        functions |= {f"invariant {i} ({name})": one for name, one in vars(law).items()}
    for i, event in enumerate(problem.events):
        functions |= {f"event {i}": event.fun, f"the action of event {i}": event.action}
    for point in () if breakpoints is None else to_breakpoints("breakpoints", breakpoints):
        functions[f"the action at t = {point.t!r}"] = point.action
    found = {name: _digest_of_code(one) for name, one in functions.items() if callable(one)}
    return {name: code for name, code in found.items() if code is not None}


def _described(problem: Description) -> dict[str, Any]:
    """What is compared, by the words for it."""
    of_events = [
        [
            event.__name__,
            getattr(event, "terminal", False),
            getattr(event, "direction", 0),
            getattr(event, "samples", None),
        ]
        for event in problem.events
    ]
    return {
        "components": len(problem.y0),
        "complex": problem.y0.dtype.kind == "c",
        "t0": problem.t_span[0],
        "events (name, terminal, direction, samples)": [[_told(one) for one in event] for event in of_events],
        "invariants": [{name: _told(one) for name, one in vars(law).items()} for law in problem.invariants],
        "args": [_told(one) for one in problem.args],
        "bounds": None if problem.limits is None else [_told(one) for one in problem.limits],
        "inputs": [{name: _told(one) for name, one in vars(one).items()} for one in problem.inputs],
        **{name: _told(one) for name, one in vars(problem.matrices).items()},
    }


def _told(value: Any) -> Any:
    """A value in JSON's types, the same for equal ones. Of a function only that it is one."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if callable(value):
        return "function"
    if hasattr(value, "tocsc"):
        value = value.tocsc()
        return [_told(part) for part in (value.indptr, value.indices, value.data)]
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        return type(value).__name__
    if array.dtype.kind in "fc" and array.dtype not in (np.dtype(float), np.dtype(complex)):
        # Some have digits that JSON's numbers lack, and bytes that mean nothing.
        return [repr(one) for one in array.ravel()] if array.ndim else repr(array[()])
    if array.dtype.kind not in "biufc":
        return [_told(one) for one in value] if isinstance(value, (list, tuple)) else type(value).__name__
    if array.size <= _FEW and array.dtype.kind != "c":
        return array.tolist()
    return _array(array)


def _slope(problem: Description) -> Array:
    """f at the start."""
    return problem.slope(np.array([problem.t_span[0]]), problem.y0[:, None])[:, 0]


def _times(breakpoints: Any) -> Array:
    return np.array([point.t for point in to_breakpoints("breakpoints", breakpoints)])


def _equal(a: Any, b: Any) -> bool:
    if a is None or b is None:
        return a is b
    return np.shape(a) == np.shape(b) and bool(np.all(np.asarray(a) == np.asarray(b)))


def _close(a: Array, b: Array) -> bool:
    if a.shape != b.shape:
        return False
    size = float(np.abs(b[np.isfinite(b)]).max(initial=0))
    return bool(np.allclose(a, b, rtol=0, atol=_SAME * size, equal_nan=True))
