"""Solutions in files: what they hold, and where in a `Solution` it is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import attrgetter
from typing import Annotated, Any, TypedDict

import numpy as np

from .._base.arguments import LONGEST_INT, Array, shown, warn
from .._base.formats import GROUP, Field, Kind
from .records import Stats
from .result import Names, Result

#: How deep lists and dicts may be nested in fields that the user adds.
_DEEPEST = 50

#: The fields of a Solution that JSON takes as they are, and their types.
OUTCOME = {"nfev": int, "njev": int, "nlu": int, "status": int, "message": str, "success": bool, "t_end": float}


class _StoredIdentity(TypedDict):
    """Method, options and problem that identify a run: see `identity_of_run`. There are arrays too."""

    method: str
    options: dict[str, Any]
    arrays: list[str]
    functions: list[str]
    bdf: bool
    every: float | None
    problem: dict[str, Any]
    code: dict[str, str]


class _Dense(TypedDict):
    """Fields of a continuous solution that are not arrays."""

    m: int
    interpolation: str
    extension: str
    rtol: float
    complex: bool
    parameters: int


def field_of(part: str, name: str) -> Callable[[Any], Any]:
    """Return a field of a part of a result; None without that part."""
    return lambda sol: None if (found := getattr(sol, part)) is None else getattr(found, name)


def _identity(sol: Result) -> tuple[dict[str, Any] | None, dict[str, Array]]:
    return (None, {}) if sol._origin is None else sol._origin.identity()


def _memory(sol: Result) -> Array | None:
    return None if sol._origin is None else np.frombuffer(sol._origin.memory, dtype=np.uint8)


def _dense(sol: Result) -> tuple[dict[str, Any] | None, dict[str, Array]]:
    parts = {} if sol.sol is None else sol.sol._dense.parts()
    arrays = {name: one for name, one in parts.items() if isinstance(one, np.ndarray)}
    return {name: parts[name] for name in _Dense.__annotations__ if parts} or None, arrays


def together(each: Sequence[Mapping[str, Array]], none: Mapping[str, Array]) -> dict[str, Array]:
    """Return the occurrences of all events in one array for each field, after `none` of them, with the numbers of the
    events."""
    numbered = [{"number": np.full(len(one["t"]), e), **one} for e, one in enumerate(each)]
    empty = {"number": np.zeros(0, dtype=np.int64), **none}
    return {name: np.concatenate([first, *(one[name] for one in numbered)]) for name, first in empty.items()}


def apart(whole: Mapping[str, Array], size: int) -> list[dict[str, Array]]:
    """Split arrays made by `together` by event, for this many events."""
    own = [whole["number"] == e for e in range(size)]
    return [{name: one[here] for name, one in whole.items() if name != "number"} for here in own]


def _events(sol: Result) -> tuple[int | None, dict[str, Array]]:
    pairs = zip(sol.t_events or (), sol.y_events or (), strict=True)
    each = [{"t": t, "y": y.reshape(len(t), len(sol.y))} for t, y in pairs]
    none = {"t": np.zeros(0), "y": sol.y.T[:0]}
    S = sol._sensitivities
    if S is not None and S.events is not None:
        for i, one in enumerate(each):
            one |= {name: found[i] for name, found in S.events._asdict().items()}
        n, k = len(sol.y), len(S.names)
        nothing = np.zeros((0, n, k), dtype=sol.y.dtype)
        none |= {"before": nothing, "after": nothing, "times": np.zeros((0, k))}
    return None if sol.t_events is None else len(each), together(each, none)


def _of_group(sol: Result) -> None:
    """Return None: `events` writes this field with its group, if there are sensitivities."""


def _values_after(sol: Result) -> Array:
    """Return the values of the invariants after each jump."""
    g = sol._invariants
    return np.array([jump.value[: len(g)] for jump in g.jumps]).reshape(len(g.jumps), len(g))


def _distances(sol: Result) -> Array:
    g = sol._invariants
    return g.distance(sol.t, sol.y, sol._rtol, sol._atol, g.pieces_of_output(len(sol.t)))


def _imposed(sol: Result) -> bool:
    return (sol._origin is not None and sol._origin.imposed) or (sol.sol is not None and sol.sol._imposed is not None)


#: The occurrences of events, together.
OCCURRENCES = {
    "events.number": Field(np.int64, "occurrence", within=(0, "<event")),
    "events.t": Field(float, "occurrence"),
    "events.y": Field(None, "occurrence component"),
}
#: What stays the same in a run,
RUN = {
    "names": Field(Names, of=lambda sol: vars(sol._names)),
    "invariants": Field(Annotated[list[str], "invariant"], of=lambda sol: sol._invariants.names),
    "sensitivities": Field(Annotated[list[str], "parameter"] | None, of=field_of("_sensitivities", "names")),
    "identity": Field(_StoredIdentity | None, GROUP, _identity),  # None: there is nothing to go on with
    "rtol": Field(float, "component?", attrgetter("_rtol"), within=(0, np.finfo(float).max)),
    "atol": Field(float, "component?", attrgetter("_atol"), within=(0, np.finfo(float).max)),
}
#: where it has come to,
END = {
    **{name: Field(kind) for name, kind in OUTCOME.items()},
    "stats": Field(Stats, of=lambda sol: dict(sol.stats)),
    "methods": Field(list[str], of=lambda sol: list(sol.steps._methods) if sol.steps else []),
    "forward": Field(float, of=lambda sol: sol._invariants.forward),
    "invariants.value": Field(float, "invariant", lambda sol: sol._invariants.value),
    "drift.residual": Field(float, "law", attrgetter("_drift.residual")),
    "drift.distance": Field(float, "law", attrgetter("_drift.distance")),
    "drift.correction": Field(float, "", attrgetter("_drift.correction")),
    "next_h": Field(float | None, of=field_of("_origin", "next_h"), within=(0, math.inf)),
    "memory_version": Field(int | None, of=field_of("_origin", "memory_version")),
    "roots": Field(list[dict[str, Any] | None], of=lambda sol: [] if sol._origin is None else sol._origin.roots),
    "y_end": Field(None, "component", attrgetter("_y_end")),
    "S_end": Field(None, "component parameter", field_of("_sensitivities", "end"), optional=True),
    "memory": Field(np.uint8, "byte", _memory, optional=True),
}
#: and what it has left behind.
OUTPUT = {
    "t": Field(float, "t"),
    "y": Field(None, "component t"),
    "S": Field(None, "component parameter t", field_of("_sensitivities", "values"), optional=True),
    "steps": Field(float, "step 6", lambda sol: sol.steps and sol.steps._rows, optional=True),
    "events": Field(Annotated[int, "event"] | None, GROUP, _events),
    **OCCURRENCES,
    "events.before": Field(None, "occurrence component parameter", _of_group, optional=True),
    "events.after": Field(None, "occurrence component parameter", _of_group, optional=True),
    "events.times": Field(float, "occurrence parameter", _of_group, optional=True),
    "jumps.row": Field(np.int64, "jump", lambda sol: [jump.row for jump in sol._invariants.jumps], within=(0, "t")),
    "jumps.t": Field(float, "jump", lambda sol: [jump.t for jump in sol._invariants.jumps]),
    "jumps.value": Field(float, "jump invariant", _values_after),
    "dense": Field(_Dense | None, GROUP, _dense),  # the core checks its arrays
}


def _added(sol: Result) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the fields that the user has added."""
    own = {field.name for field in dataclasses.fields(Result)}
    return kept({name: value for name, value in sol.items() if name not in own})


def kept(fields: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the fields that the user has added, by name: the value in JSON's types, or the number of an array.

    A warning lists those that files cannot hold.
    """
    added: dict[str, Any] = {}
    arrays: dict[str, Array] = {}
    left_out: list[str] = []
    for name, value in fields.items():
        if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biufc":
            added[name] = {"array": str(len(arrays))}
            arrays[str(len(arrays))] = np.asarray(value)
        elif _is_plain(name) and _is_plain(value):
            added[name] = {"value": value}
        else:
            left_out.append(shown(name))
    if left_out:
        warn(f"save keeps numbers, text, lists, dicts and arrays, and leaves out the fields {', '.join(left_out)}")
    return added, arrays


def restored(fields: Mapping[str, Any], own: Collection[str]) -> dict[str, Any]:
    """Return the fields that the user had added, from those of a file.

    Raises ValueError: One of them has the name of one of the `own` fields: the file has been changed.
    """
    held = fields["added"].items()
    if taken := sorted(set(own) & fields["added"].keys()):
        raise ValueError(f"fields that a user has added have names of others: {', '.join(taken)}")
    return {name: fields[f"added.{one['array']}"] if "array" in one else one["value"] for name, one in held}


def require_whole(sol: Result) -> None:
    """Check that the user has neither deleted fields nor set t and y to values that are no outputs."""
    missing = {field.name for field in dataclasses.fields(Result) if not field.name.startswith("_")} - sol.keys()
    if missing:
        raise ValueError(f"save: the solution has no {', '.join(sorted(missing))} any more: put back what was deleted")
    t, y, n = sol["t"], sol["y"], sol._names.size
    outputs = len(t) if isinstance(t, np.ndarray) and t.ndim == 1 else -1
    if not isinstance(y, np.ndarray) or y.shape != (n, outputs):
        given = [f"an array of shape {one.shape}" if isinstance(one, np.ndarray) else shown(one) for one in (t, y)]
        raise ValueError(f"save: t is {given[0]} and y is {given[1]}: they must be arrays of shapes (k,) and ({n}, k)")


def _is_plain(value: Any, depth: int = 0) -> bool:
    """Return whether JSON gives the same value back."""
    if type(value) is int:
        return value.bit_length() < LONGEST_INT
    if value is None or type(value) in (bool, float, str):
        return True
    if depth == _DEEPEST:
        return False
    if type(value) is dict:
        return all(type(name) is str and _is_plain(one, depth + 1) for name, one in value.items())
    return type(value) is list and all(_is_plain(one, depth + 1) for one in value)


SOLUTION = Kind(
    "solution",
    RUN
    | END
    | OUTPUT
    | {
        "invariants.residual": Field(float, "invariant t", attrgetter("residual")),
        "invariants.distance": Field(float, "invariant t", _distances),
        "imposed": Field(bool, of=_imposed),
        "added": Field(dict[str, Any], GROUP, _added),
    },
)
