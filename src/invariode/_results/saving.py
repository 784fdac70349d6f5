"""Solutions in files: what they hold, and how it is taken from a `Solution`."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any, NamedTuple, TypedDict

import numpy as np

from .._base.arguments import Array, shown, warn
from .._base.files import PathLike
from .._base.formats import Field, Kind, Within, write
from .result import Result, Stats

__all__ = ["OUTCOME", "SOLUTION", "Saved", "end_of", "output_of", "prefixed", "run_of", "save"]
__all__ += ["END", "OUTPUT", "RUN", "AboutEnd", "AboutOutput", "AboutRun", "events_by_number"]

#: How deep lists and dicts may be nested in fields that the user adds.
_DEEPEST = 50

#: The fields of a Solution that JSON takes as they are.
OUTCOME = ("nfev", "njev", "nlu", "status", "message", "success", "t_end")

_NOT_NEGATIVE = Within(0, math.inf)
_FINITE = Within(0, np.finfo(float).max)


class Saved(NamedTuple):
    """Fields of a file."""

    about: dict[str, Any]
    arrays: dict[str, Any]


# ----------------------------------------------------------------------------------------------------------------------
# What a file holds. `law` counts the invariants of the run, of which a projected solution keeps those with values


class AboutIdentity(TypedDict):
    """What tells a run from another: see `identity_of_run`."""

    method: str
    options: dict[str, Any]
    arrays: list[str]
    functions: list[str]
    bdf: bool
    problem: dict[str, Any]
    code: dict[str, str]


class AboutRun(TypedDict):
    """What stays the same in a run."""

    name: str
    title: str | None
    labels: Annotated[list[str], "component"] | None
    events: Annotated[list[str], "event"] | None
    invariants: Annotated[list[str], "invariant"]
    identity: AboutIdentity | None  # None: there is nothing to go on with


class AboutEnd(TypedDict):
    """Where a run has come to."""

    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    success: bool
    t_end: float
    stats: Stats
    methods: list[str]  # of the steps
    forward: float
    next_h: Annotated[float, _NOT_NEGATIVE] | None
    memory_version: int | None


class AboutDense(TypedDict):
    """Of a continuous solution, what is not an array."""

    m: int
    interpolation: str
    extension: str
    rtol: float
    complex: bool


class AboutOutput(TypedDict):
    """What a run has left behind."""

    dense: AboutDense | None


class AboutSolution(AboutRun, AboutEnd, AboutOutput):
    """All of it."""

    imposed: bool
    added: dict[str, Any]


RUN = {"rtol": Field(float, "component?", within=_FINITE), "atol": Field(float, "component?", within=_FINITE)}
END = {
    "invariants.value": Field(float, "invariant"),
    "drift.residual": Field(float, "law"),
    "drift.distance": Field(float, "law"),
    "drift.correction": Field(float),
    "y_end": Field(None, "component", optional=True),
    "memory": Field(np.uint8, "byte", optional=True),
}
OUTPUT = {
    "t": Field(float, "t"),
    "y": Field(None, "component t"),
    "steps": Field(float, "step 6", optional=True),
    "events.number": Field(np.int64, "occurrence", within=Within(0, "<event")),
    "events.t": Field(float, "occurrence"),
    "events.y": Field(None, "occurrence component"),
    "jumps.row": Field(np.int64, "jump", within=Within(0, "t")),
    "jumps.t": Field(float, "jump"),
    "jumps.value": Field(float, "jump invariant"),
    "dense.t": Field(float, "knot", optional=True),
    "dense.y": Field(float, "knot real", optional=True),
    "dense.end": Field(float, "segment", optional=True),
    "dense.offset": Field(np.int64, "segment", optional=True),
    "dense.data": Field(float, "datum", optional=True),
    **{f"dense.{name}": Field(float, "real", optional=True) for name in ("threshold", "scale", "lower", "upper")},
}
SOLUTION = Kind(
    "solution",
    AboutSolution,
    RUN
    | END
    | OUTPUT
    | {f"invariants.{name}": Field(float, "invariant t", optional=True) for name in ("residual", "distance")},
    others=("identity.", "added."),
)


# ----------------------------------------------------------------------------------------------------------------------
# From a solution


def save(solution: Result, path: PathLike) -> None:
    """See `Solution.save`."""
    g, origin, dense = solution._invariants, solution._origin, solution.sol
    pieces = g.pieces_of_output(len(solution.t))
    added, arrays = _added(solution)
    arrays["invariants.residual"] = solution.residual
    arrays["invariants.distance"] = g.distance(solution.t, solution.y, solution._rtol, solution._atol, pieces)
    imposed = (origin is not None and origin.imposed) or (dense is not None and dense._imposed is not None)
    parts = (
        run_of(solution),
        end_of(solution),
        output_of(solution),
        Saved({"imposed": imposed, "added": added}, arrays),
    )
    about = {name: value for part in parts for name, value in part.about.items()}
    write(path, SOLUTION, about, {name: one for part in parts for name, one in part.arrays.items()})


def run_of(solution: Result) -> Saved:
    """What stays the same in its run."""
    names, origin = solution._names, solution._origin
    identity = Saved({"identity": None}, {}) if origin is None else origin.identity()
    about = {
        "name": names.problem,
        "title": names.title,
        "labels": None if names.labels is None else [str(label) for label in names.labels],
        "events": None if solution.t_events is None else list(names.events),
        "invariants": list(solution._invariants.names),
    }
    rtol, atol = np.asarray(solution._rtol, dtype=float), np.asarray(solution._atol, dtype=float)
    return Saved(about | identity.about, identity.arrays | {"rtol": rtol, "atol": atol})


def end_of(solution: Result) -> Saved:
    """Where its run has come to."""
    g, drift, steps, origin = solution._invariants, solution._drift, solution.steps, solution._origin
    memory = Saved({"next_h": None, "memory_version": None}, {}) if origin is None else origin.end()
    about = {
        **{name: solution[name] for name in OUTCOME},
        "stats": dict(solution.stats),
        "methods": [] if steps is None else list(steps._methods),
        "forward": g.forward,
    }
    arrays = {
        "invariants.value": g.value,
        "drift.residual": drift.residual,
        "drift.distance": drift.distance,
        "drift.correction": np.asarray(drift.correction),
    }
    return Saved(about | memory.about, arrays | memory.arrays)


def output_of(solution: Result) -> Saved:
    """What it has come by."""
    t, y, g = solution.t, solution.y, solution._invariants
    dense = {} if solution.sol is None else solution.sol._dense.parts()
    arrays = {
        "t": t,
        "y": y,
        "jumps.row": np.array([jump.row for jump in g.jumps], dtype=np.int64),
        "jumps.t": np.array([jump.t for jump in g.jumps], dtype=float),
        "jumps.value": np.array([jump.value[: len(g)] for jump in g.jumps]).reshape(len(g.jumps), len(g)),
        **events_by_number(solution.t_events or (), "t", np.zeros(0)),
        **events_by_number(solution.y_events or (), "y", np.zeros((0, len(y)), y.dtype)),
        **{f"dense.{name}": one for name, one in dense.items() if isinstance(one, np.ndarray)},
    }
    if solution.steps is not None:
        arrays["steps"] = solution.steps._rows
    about = {name: one for name, one in dense.items() if name in AboutDense.__annotations__}
    return Saved({"dense": about or None}, arrays)


def events_by_number(each: Any, name: str, none: Array) -> dict[str, Array]:
    """An array of each event in one, after `none` of them; and the numbers of the events."""
    numbers = [np.full(len(one), e) for e, one in enumerate(each)]
    return {
        "events.number": np.concatenate([np.zeros(0, dtype=np.int64), *numbers]),
        f"events.{name}": np.concatenate([none, *(one.reshape(len(one), *none.shape[1:]) for one in each)]),
    }


def prefixed(arrays: dict[str, Array], prefix: str) -> dict[str, Array]:
    """Those whose names begin so, by the rest of their names."""
    return {name.removeprefix(prefix): one for name, one in arrays.items() if name.startswith(prefix)}


def _added(solution: Result) -> tuple[dict[str, Any], dict[str, Array]]:
    """The fields that the user has added: by name, values in JSON's types or the names of arrays."""
    own = {field.name for field in dataclasses.fields(Result)}
    added: dict[str, Any] = {}
    arrays: dict[str, Array] = {}
    left_out: list[str] = []
    for name, value in solution.items():
        if name in own:
            continue
        if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biufc":
            array = f"added.{len(arrays)}"
            arrays[array] = np.asarray(value)
            added[name] = {"array": array}
        elif _is_plain(name) and _is_plain(value):
            added[name] = {"value": value}
        else:
            left_out.append(shown(name))
    if left_out:
        warn(f"save keeps numbers, text, lists, dicts and arrays, and leaves out the fields {', '.join(left_out)}")
    return added, arrays


def _is_plain(value: Any, depth: int = 0) -> bool:
    """Whether JSON gives the same value back."""
    if value is None or type(value) in (bool, int, float, str):
        return True
    if depth == _DEEPEST:
        return False
    if type(value) is dict:
        return all(type(name) is str and _is_plain(one, depth + 1) for name, one in value.items())
    return type(value) is list and all(_is_plain(one, depth + 1) for one in value)
