"""Identity of a problem or run, as data: a file of one run is rejected by any other, and the difference is reported."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from .._base.arguments import LONGEST_INT, Array, call_name, shown
from .._base.types import MethodName
from .._functions.compiled import CompiledFunction
from .._problem.breakpoints import to_breakpoints
from .._problem.events import RootOf
from .._problem.grouped import GMRES, Checkpoint, Limits
from .._problem.methods import find_method
from .._problem.options import Options, table_of
from .._problem.problem import Problem
from .code_digest import digest, digest_of_code

#: The most numbers of an array that are written out; a larger one becomes a digest.
_FEW = 8

#: How deep lists and dicts may be nested.
_DEEPEST = 50

#: Options of who looks at a run, which it goes on without.
_OF_THE_SESSION = frozenset({"progress", "on_interrupt", "on_failure", "checkpoint"})

#: Values of f that differ by less, relative to the largest component, are the same: another machine rounds otherwise.
_SAME = 1e-9


# ----------------------------------------------------------------------------------------------------------------------
# Values and code


def in_words(value: Any, *, code: bool = True, depth: int = 0) -> Any:
    """Return a value as JSON can store it: equal for values that are written alike, in another process too. For a
    function that is its code, or only that it is one. `depth`: the number of lists and dicts around it."""
    if depth > _DEEPEST:
        raise ValueError(
            f"a list or dict among the arguments of the problem is nested in more than {_DEEPEST} levels, or contains "
            "itself: what is saved cannot tell it from another. Flatten it, or let the functions refer to it otherwise"
        )
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, int) and value.bit_length() >= LONGEST_INT:
        return f"{shown(value)} {digest(hex(value))}"
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, (float, complex, np.number)):  # the last has digits that the others lack
        return value if isinstance(value, float) and math.isfinite(value) else repr(value)
    if hasattr(value, "tocsc"):
        columns = value.tocsc()
        value = [columns.indptr, columns.indices, columns.data]
    if isinstance(value, (list, tuple)) and len(value) > _FEW and all(type(one) is float for one in value):
        value = np.array(value)
    if isinstance(value, np.ndarray):
        large = value.size > _FEW and value.dtype.kind in "biufc" and value.dtype.char not in "gG"
        if large or value.dtype == object:
            return f"array {value.shape} {digest(value)}"
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): in_words(one, code=code, depth=depth + 1) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [in_words(one, code=code, depth=depth + 1) for one in value]
    if callable(value) and not code:
        return "function"
    number, own = digest_of_code(value), getattr(value, "__dict__", None)
    if number is not None:
        libm = isinstance(value, CompiledFunction) and value.elementary == "libm"
        return f"{call_name(value, 'function')} ({number}{', libm' * libm})"
    if type(value).__module__.partition(".")[0] == "invariode" and own is not None:
        public = {name: one for name, one in own.items() if not name.startswith("_")}
        about = {name: in_words(one, code=code, depth=depth + 1) for name, one in public.items()}
        return {"type": type(value).__name__, **about}
    return call_name(value, type(value).__qualname__)


# ----------------------------------------------------------------------------------------------------------------------
# A run


class Identity(NamedTuple):
    """Identity of a run: in JSON's types, and arrays by name."""

    about: dict[str, Any]
    arrays: dict[str, Array]


def identity_of_run(problem: Problem, method: MethodName, options: Mapping[str, Any]) -> Identity:
    """Return the identity of a run. Evaluates f at the start."""
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
        elif isinstance(value, (Limits, GMRES)):
            about["options"][name] = _fields(value)
            if not all(isinstance(one, (int, float)) for one in vars(value).values() if one is not None):
                about["functions"].append(name)
        elif isinstance(value, (bool, int, float, str)):
            about["options"][name] = value
        elif name == "prefer":
            about["options"][name] = list(value)
        else:
            about["arrays"].append(name)
            arrays[name] = np.asarray(value)
    about["every"] = options["checkpoint"].every if isinstance(options.get("checkpoint"), Checkpoint) else None
    about["bdf"] = bool(find_method(method)[1].get("bdf"))  # which a name of SciPy's implies
    about["problem"] = _described(problem)
    about["code"] = _codes(problem, options)
    return Identity(about, arrays)


def known_identity(about: dict[str, Any], arrays: dict[str, Array]) -> Identity:
    """Return the identity that a file contains, whose types are known to be right. Raises whatever else the damage
    causes."""
    known = table_of(Options).keys() - _OF_THE_SESSION
    for name in (*about["options"], *about["arrays"], *about["functions"]):
        if name not in known:
            raise ValueError(f"{shown(name)} is no option of a run")
    _plain_options(about)
    for name in ("y0", "f0", *about["arrays"], *{"breakpoints"}.intersection(about["functions"])):
        arrays[name]
    return Identity(about, arrays)


def options_of(stored: Identity, given: Mapping[str, Any]) -> Options:
    """Return the options of the run of a file. `given`: those with functions, which are not in the file, and others,
    which must agree with the file's."""
    about, arrays = stored
    options: dict[str, Any] = {**_plain_options(about), **{name: arrays[name] for name in about["arrays"]}}
    if about["bdf"]:
        options["bdf"] = True
    for name, value in given.items():
        if name in about["functions"] or name in _OF_THE_SESSION:
            options[name] = value
        elif not _equal(options.get(name), value):
            was = in_words(options.get(name), code=False)
            raise ValueError(f"{name} = {value!r} differs from {was} in the file: omit it, or load another file")
    for name in about["functions"]:
        if name not in given:
            raise ValueError(f"the run has {name} with functions, which are not in the file: give {name}=... too")
    if "linear_solver" in about["functions"]:
        now, was = _fields(given["linear_solver"]), about["options"]["linear_solver"]
        if now != was:
            raise ValueError(f"linear_solver has {now} here, and {was} in the file: give that of the run")
    if "breakpoints" in about["functions"]:
        here, there = _times(given["breakpoints"]), arrays["breakpoints"]
        if not _equal(there, here):
            raise ValueError(
                f"breakpoints are at {in_words(here)} here, and at {in_words(there)} in the file: give those of the run"
            )
    return cast("Options", options)


def _fields(value: Any) -> dict[str, Any]:
    """Return the fields of a structured option in JSON's types."""
    return {name: in_words(one, code=False) for name, one in getattr(value, "__dict__", {}).items() if one is not None}


def _plain_options(about: dict[str, Any]) -> dict[str, Any]:
    """The options of a file that are neither functions nor arrays."""
    several: dict[str, Any] = {"limits": Limits, "linear_solver": GMRES}
    return {
        name: several[name](**value) if isinstance(value, dict) else value
        for name, value in about["options"].items()
        if name not in about["functions"]
    }


def require_same(stored: Identity, problem: Problem, given: Mapping[str, Any], trust: str | None) -> None:
    """Raises a ValueError that names what differs, if it is another problem, or, unless the code is trusted, if
    functions have another code."""
    now = identity_of_run(problem, stored.about["method"], {})
    here, there = now.about["problem"], stored.about["problem"]
    pairs = [(what, here.get(what), was) for what, was in there.items() if here.get(what) != was]
    if not pairs:
        pairs = [
            (what, in_words(now.arrays[name]), in_words(stored.arrays[name]))
            for name, what in (("y0", "y0"), ("f0", "fun at the start"))
            if not _close(now.arrays[name], stored.arrays[name])
        ]
    for what, value, was in pairs:
        raise ValueError(
            f"the file belongs to another problem: {what}: {value} here, {was} in the file. Give the problem of the run"
        )
    codes = _codes(problem, given)
    was_code = stored.about["code"]
    edited = [name for name, code in codes.items() if name in was_code and was_code[name] != code]
    if edited and trust is None:
        raise ValueError(
            f"the code of {', '.join(edited)} is not that of the run. Give the functions of the run; if they compute "
            'the same (they were only edited, or Python is another one), load(..., trust="code")'
        )


def _codes(problem: Problem, options: Mapping[str, Any]) -> dict[str, str]:
    """The code of each of the user's functions, by what messages call it."""
    breakpoints, solver = options.get("breakpoints"), options.get("linear_solver")
    functions = {"fun": problem.fun, **vars(problem.matrices), **getattr(solver, "__dict__", {})}
    for i, law in enumerate(problem.invariants):
        functions |= {f"invariant {i} ({name})": one for name, one in vars(law).items()}
    for i, event in enumerate(problem.events):
        functions |= {f"event {i}": event.fun, f"the action of event {i}": event.action}
        if isinstance(event, RootOf):
            functions |= {f"event {i}": event.roots.fun, f"the action of event {i}": event.roots.on_roots}
    if problem.delays is not None:
        functions["history"] = problem.delays.history
    given = [] if breakpoints is None else to_breakpoints("breakpoints", breakpoints)
    for point in [*problem.breakpoints, *given]:
        functions[f"the action at t = {point.t!r}"] = point.action
    found = {name: digest_of_code(one) for name, one in functions.items() if callable(one)}
    return {name: code for name, code in found.items() if code is not None}


def _described(problem: Problem) -> Any:
    """Return the compared properties of a problem, by the words for them."""
    properties = {"__name__": None, "terminal": False, "direction": 0, "samples": None, "at_jumps": True}
    about = {
        "components": len(problem.y0),
        "complex": problem.y0.dtype.kind == "c",
        "t0": problem.t_span[0],
        "events (name, terminal, direction, samples, at_jumps)": [
            [getattr(event, name, default) for name, default in properties.items()] for event in problem.events
        ],
        "invariants": [vars(law) for law in problem.invariants],
        "args": problem.args,
        "bounds": problem.bounds,
        "inputs": [vars(one) for one in problem.inputs],
        "breakpoints (t, action)": [[point.t, point.action] for point in problem.breakpoints],
        "sensitivities": None if problem.sensitivities is None else [one.name for one in problem.parameter_names()],
        **vars(problem.matrices),
    }
    if problem.delays is not None:
        about |= {"delays": problem.delays.given, "history": problem.delays.history_as_data()}
    return in_words(about, code=False)


def _slope(problem: Problem) -> Array:
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
