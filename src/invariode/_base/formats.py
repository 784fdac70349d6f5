"""The format of all files: a header with the kind and the version, values and arrays. A table for each kind lists them,
and both the writer and the reader check a file against it."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np

from .arguments import Array, shown
from .files import ABOUT, PathLike, arrays_in, damage_of, read_arrays, unreadable, write_arrays

__all__ = ["VERSION", "Contents", "Field", "Kind", "Within", "header", "kind_of", "packed", "read", "read_about"]
__all__ += ["require_arrays", "require_values", "unpacked", "write"]

#: The version of the format: raised whenever the fields of any kind change.
VERSION = 5

_FORMAT = "invariode "


class _Words(NamedTuple):
    """How messages speak of a kind."""

    name: str
    otherwise: str  # what is said of a file that is not of any kind
    use: str  # for those that expected another kind


_WORDS = {
    "solution": _Words(
        "a solution", "was not written by Solution.save, nor as a checkpoint", "read it with invariode.load(path)"
    ),
    "checkpoint": _Words("a checkpoint", "is not a checkpoint", "read it with invariode.load(path, problem)"),
    "output": _Words(
        "the output of a checkpoint", "is not the output of a checkpoint", "load the file that it is named after"
    ),
    "ensemble": _Words(
        "an ensemble",
        "was not written by EnsembleSolution.save",
        "read it with invariode.EnsembleSolution.load(path)",
    ),
    "store": _Words(
        "a store",
        "is not a store of an ensemble: make one with solve_ensemble(store=...), or give another name",
        "read it with invariode.EnsembleStore(path)",
    ),
}


class Within(NamedTuple):
    """The range of a number or of those in an array. `high` may be the size of a dimension, as in "t", or less than it,
    as in "<t"; in a part of a file, where that is not known, it is no limit."""

    low: float
    high: float | str

    def holds(self, values: Any, sizes: Mapping[str, Any]) -> bool:
        if not isinstance(self.high, str):
            return bool(np.all((self.low <= np.asarray(values)) & (np.asarray(values) <= self.high)))
        last = sizes.get(self.high.removeprefix("<"), math.inf) - self.high.startswith("<")
        return Within(self.low, last).holds(values, sizes)


class Field(NamedTuple):
    """An array. Dimensions of one name have one size in a whole file; those that are numbers have that size, `*` has
    any, and one that ends in `?` may be missing."""

    type: Any  # None: that of states, real or complex, the same in a whole file
    shape: str = ""
    optional: bool = False
    within: Within | None = None

    def fits(self, array: Any, sizes: dict[str, Any]) -> bool:
        """`sizes`: those known so far, to which this adds."""
        dtype, dimensions = array.dtype, self.shape.split()
        if self.type is None and dtype not in (np.dtype(float), np.dtype(complex)):
            return False
        if dtype != (sizes.setdefault("type of states", dtype) if self.type is None else np.dtype(self.type)):
            return False
        if dimensions and dimensions[-1].endswith("?") and array.ndim < len(dimensions):
            dimensions.pop()
        if array.ndim != len(dimensions):
            return False
        for name, size in zip(dimensions, array.shape, strict=True):
            known = int(name) if name.isdigit() else size if name == "*" else sizes.setdefault(name.rstrip("?"), size)
            if size != known:
                return False
        return self.within is None or self.within.holds(array, sizes)


class Kind(NamedTuple):
    """What a file of a kind holds."""

    name: str
    values: type  # a TypedDict: each value and its type. The length of a list may be a dimension: Annotated[..., "t"]
    arrays: Mapping[str, Field]
    others: tuple[str, ...] = ()  # arrays whose names begin like this may be any

    def require(self, about: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
        """A ValueError that names what is not as it should be."""
        sizes = require_values(about, self.values)
        require_arrays({n: one for n, one in arrays.items() if not n.startswith(self.others)}, self.arrays, sizes)


class Contents(NamedTuple):
    """Those of a file."""

    kind: Kind
    about: dict[str, Any]
    arrays: dict[str, Array]


# ----------------------------------------------------------------------------------------------------------------------
# Fields against their table


def require_arrays(arrays: Mapping[str, Any], table: Mapping[str, Field], sizes: dict[str, Any]) -> None:
    """A ValueError unless the arrays are those of the table. `sizes`: of the dimensions that are known."""
    _require_names(arrays, table, {name for name, field in table.items() if not field.optional})
    for name, field in table.items():
        if name in arrays and not field.fits(arrays[name], sizes):
            raise ValueError(f"{name} is an array of {arrays[name].dtype}, {arrays[name].shape}, or has other numbers")


def require_values(about: Mapping[str, Any], table: type) -> dict[str, Any]:
    """A ValueError unless the values are those of the table; the dimensions that they fix."""
    sizes: dict[str, Any] = {}
    hints = _hints(table)
    _require_names(about, hints, hints)
    for name, hint in hints.items():
        if not _fits(about[name], hint, sizes):
            raise ValueError(f"{name} is {shown(about[name])}")
    return sizes


def _require_names(given: Mapping[str, Any], known: Any, required: Any) -> None:
    for name in required:
        if name not in given:
            raise KeyError(name)
    for name in given:
        if name not in known:
            raise ValueError(f"{shown(name)} should not be there")


@cache
def _hints(table: type) -> dict[str, Any]:
    return get_type_hints(table, localns={"Any": Any}, include_extras=True)  # public classes tell another module


def _fits(value: Any, hint: Any, sizes: dict[str, Any]) -> bool:
    outer, inner = get_origin(hint), get_args(hint)
    if outer is Annotated:
        return _fits(value, inner[0], sizes) and _as_annotated(value, inner[1], sizes)
    if outer in (Union, UnionType):
        return any(_fits(value, one, sizes) for one in inner)
    if outer in (list, tuple):
        return isinstance(value, (list, tuple)) and all(_fits(one, inner[0], sizes) for one in value)
    if outer is dict:
        return isinstance(value, dict) and all(_fits(one, inner[1], sizes) for one in value.values())
    if getattr(hint, "__annotations__", None):  # a record
        known = _hints(hint)
        return (
            isinstance(value, Mapping)
            and value.keys() == known.keys()
            and all(_fits(value[name], one, sizes) for name, one in known.items())
        )
    return hint is Any or (isinstance(value, hint) and isinstance(value, bool) == (hint is bool))


def _as_annotated(value: Any, what: str | Within, sizes: dict[str, Any]) -> bool:
    """Whether a list has the length of a dimension (a number is it), or a number lies within its range."""
    if isinstance(what, Within):
        return what.holds(value, sizes)
    size = value if isinstance(value, int) else len(value)
    return bool(sizes.setdefault(what, size) == size)


# ----------------------------------------------------------------------------------------------------------------------
# Headers


def header(kind: str) -> dict[str, Any]:
    """What stands first in every file and store."""
    return {"format": _FORMAT + kind, "version": VERSION, "invariode": version("invariode")}


def kind_of(path: Any, about: Any, *expected: str) -> str:
    """The kind of a file from its header, which is taken out. A ValueError unless it is expected, and of this version
    of the format."""
    given = about.pop("format", None) if isinstance(about, dict) else None
    kind = given.removeprefix(_FORMAT) if isinstance(given, str) else ""
    if kind not in _WORDS or kind == given:
        raise unreadable(path, _WORDS[expected[0]].otherwise)
    number, writer = about.pop("version", 0), about.pop("invariode", "0.2")
    what = f"holds {_WORDS[kind].name} in version {number} of the format, written by invariode {shown(writer)[1:-1]}"
    if kind not in expected:
        raise unreadable(path, f"{what}: {_WORDS[kind].use}")
    if number != VERSION:
        newer = isinstance(number, int) and number > VERSION
        remedy = "upgrade it" if newer else "use the invariode that wrote it, or solve the problem again"
        this = f"this is invariode {version('invariode')}, which reads version {VERSION}"
        raise unreadable(path, f"{what}; {this}: {remedy}")
    return kind


# ----------------------------------------------------------------------------------------------------------------------
# Files


def write(
    path: PathLike, kind: Kind, about: Mapping[str, Any], arrays: Mapping[str, Any], durable: bool = False
) -> None:
    """Writes a file, which takes the place of an existing one when it is complete."""
    write_arrays(path, _members(kind, about, arrays), durable)


def packed(kind: Kind, about: Mapping[str, Any], arrays: Mapping[str, Any]) -> memoryview:
    """The same as bytes."""
    whole = io.BytesIO()
    np.savez(whole, **_members(kind, about, arrays))
    return whole.getbuffer()


def _members(kind: Kind, about: Mapping[str, Any], arrays: Mapping[str, Any]) -> dict[str, Any]:
    kind.require(about, arrays)
    return {**arrays, ABOUT: np.array(json.dumps({**header(kind.name), **about}))}


def read(path: PathLike, *kinds: Kind) -> Contents:
    """The contents of a file of one of these kinds, once all of them are right."""
    return _contents(path, read_arrays(path), *kinds)


def unpacked(data: bytes, path: PathLike, *kinds: Kind) -> Contents:
    """The same of bytes in a file."""
    return _contents(path, arrays_in(io.BytesIO(data), len(data), path), *kinds)


def _contents(path: PathLike, arrays: dict[str, Array], *kinds: Kind) -> Contents:
    about = _about(arrays)
    name = kind_of(path, about, *(kind.name for kind in kinds))
    kind = next(one for one in kinds if one.name == name)
    with damage_of(path):
        kind.require(about, arrays)
    return Contents(kind, about, arrays)


def read_about(path: PathLike, kind: Kind) -> dict[str, Any]:
    """The values in a file, without its arrays."""
    about = _about(read_arrays(path, only=ABOUT))
    kind_of(path, about, kind.name)
    with damage_of(path):
        require_values(about, kind.values)
    return about


def _about(arrays: dict[str, Array]) -> Any:
    try:
        return json.loads(str(arrays.pop(ABOUT, "")))
    except (ValueError, RecursionError):
        return None
