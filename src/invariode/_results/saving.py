"""Solutions in files: what they hold, where in a `Solution` it is, and the solution that is made of it again."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import attrgetter
from typing import Annotated, Any, NoReturn, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import LONGEST_INT, Array, shown, warn
from .._base.formats import GROUP, Field, Kind, under
from .._core import Dense
from .._functions.layout import NO_ARGUMENTS
from .._laws.bound import BoundInvariants, ValueJump
from .records import BeforeProjection, ByEvent, Stats, Steps, at_events
from .result import DenseSolution, Names, Result
from .sensitivity_data import AtEvents, SensitivityData

R = TypeVar("R", bound=Result)

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


def stored_dense(parts: list[dict[str, Any]], n: int, end: float) -> Dense | None:
    """Return the continuous solution of n reals, if there is one, joined in pairs, so that each part is copied few
    times."""
    wholes = [_dense_part(part, n) for part in parts if part["dense"] is not None]
    if 0 < len(wholes) < len(parts):
        raise ValueError("not all of its parts have a continuous solution")
    if any(first.knots()[-1] != then.knots()[0] for first, then in itertools.pairwise(wholes)):
        raise ValueError("the parts of the continuous solution do not follow one another")
    if wholes and n > 0 and wholes[-1].knots()[-1] != end:
        raise ValueError("the continuous solution does not end where the run does")
    while len(wholes) > 1:
        pairs = itertools.zip_longest(wholes[::2], wholes[1::2])
        wholes = [first if then is None else first.joined(then) for first, then in pairs]
    return wholes[0] if wholes else None


def _dense_part(part: dict[str, Any], n: int) -> Dense:
    arrays = under("dense", part)
    if part["dense"]["m"] != part["jumps.value"].shape[1]:
        raise ValueError("invariants do not match")
    if arrays["y"].shape[1:] != (n,) or part["dense"]["complex"] != (part["y"].dtype.kind == "c"):
        raise ValueError("components do not match")
    try:
        return Dense.from_parts(**{"scale": None, **arrays, **part["dense"]})
    except TypeError:  # its text would be the signature of the binding
        raise ValueError("the parts of the continuous solution do not match") from None


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


# ----------------------------------------------------------------------------------------------------------------------
# From the fields of a file, each of which is right by itself


def solution_of(fields: dict[str, Any], kind: type[R]) -> R:
    """Return the stored solution of this class, without `sol`."""
    y, names, stats = fields["y"], fields["invariants"], fields["stats"]
    if len(fields["drift.residual"]) < len(names):
        raise ValueError("drifts do not match")
    each = None if fields["events"] is None else apart(under("events", fields), fields["events"])
    called = Names(**fields["names"])
    at_outputs = None
    if "invariants.residual" in fields:  # unless it is a checkpoint
        at_outputs = fields["invariants.residual"], fields["invariants.distance"]
    jumps = zip(fields["jumps.row"].tolist(), fields["jumps.t"].tolist(), fields["jumps.value"], strict=True)
    g = StoredInvariants(
        [],
        fields["invariants.value"],
        names,
        (),
        NO_ARGUMENTS,
        None,
        jumps=tuple(ValueJump(*jump) for jump in jumps),
        forward=fields["forward"],
        at_outputs=at_outputs,
        outputs=y,
    )
    solution = kind(
        {
            "_invariants": g,
            "_rtol": fields["rtol"].tolist(),
            "_atol": fields["atol"].tolist(),
            "_drift": BeforeProjection(
                fields["drift.residual"], fields["drift.distance"], float(fields["drift.correction"])
            ),
            "_names": called,
            "_sensitivities": _sensitivities(fields, each),
            "_y_end": fields["y_end"],
            "_origin": None,
        },
        t=fields["t"],
        y=y,
        sol=None,
        t_events=None if each is None else ByEvent(called.events, [one["t"] for one in each]),
        y_events=None if each is None else ByEvent(called.events, [at_events(one["y"]) for one in each]),
        **{name: fields[name] for name in OUTCOME if name != "t_end"},
        stats=Stats(
            **{
                **stats,
                "discontinuities": tuple(stats["discontinuities"]),
                "marks": tuple(map(tuple, stats["marks"])),
            }
        ),
        steps=_steps(fields["steps"], fields["methods"]) if "steps" in fields else None,
        t_end=fields["t_end"],
    )
    solution.update(restored(fields, solution.keys()))
    return solution


def _sensitivities(fields: dict[str, Any], each: list[dict[str, Array]] | None) -> SensitivityData | None:
    names = fields["sensitivities"]
    if names is None:
        return None
    if "S" not in fields or "S_end" not in fields:
        raise ValueError("sensitivities do not match")
    events = None if each is None else AtEvents(*([one[name] for one in each] for name in AtEvents._fields))
    return SensitivityData(names, fields["S"], fields["S_end"], events)


def _steps(rows: Array, methods: list[str]) -> Steps:
    if not np.isin(rows[:, 5], np.arange(len(methods))).all():
        raise ValueError("steps do not match")
    return Steps(rows, methods)


@dataclasses.dataclass
class StoredInvariants(BoundInvariants):
    """The invariants of a file, without functions: at its outputs, what was computed when it was saved."""

    at_outputs: tuple[Array, Array] | None = dataclasses.field(kw_only=True)  # residuals and distances, (m, n_t)
    outputs: Array = dataclasses.field(kw_only=True)  # y of the file

    def residual(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        return self._at(y)[0]

    def distance(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> Array:
        return self._at(y)[1]

    def _at(self, y: Array) -> tuple[Array, Array]:
        if self.at_outputs is None or not (
            len(self) == 0 or y is self.outputs or np.array_equal(y, self.outputs, equal_nan=True)
        ):
            raise ValueError(
                f"the functions of the invariants {', '.join(self.names)} are not in the file, which has their "
                "residuals only at its outputs, and y has changed: give them, invariode.load(path, invariants=...)"
            )
        return self.at_outputs

    def impose(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> NoReturn:
        raise ValueError(
            f"the functions of the invariants {', '.join(self.names)} are not in the file: give them, "
            "invariode.load(path, invariants=...), or use invariode.impose(invariants, solution)"
        )


class Unprojected(DenseSolution):
    """The continuous solution of a file, which needs functions to project and has none."""

    _told = False

    def __call__(self, t: ArrayLike, *, extrapolate: bool = True) -> Array:
        if not self._told and (self._imposed or not np.isin(t, self.ts).all()):
            self._told = True
            warn(
                "sol(t) is not projected onto the invariants: their functions are not in the file; give them, "
                "invariode.load(path, invariants=...)"
            )
        return DenseSolution(self._dense, self._dtype, self._invariants)(t, extrapolate=extrapolate)
