"""The format of all files: a header with the kind and the version, values and arrays. A table for each kind lists them,
and both the writer and the reader check a file against it."""

from __future__ import annotations

import io
import json
import math
import operator
from collections.abc import Callable, Mapping
from functools import cache, reduce
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np

from .arguments import shown
from .files import ABOUT, PathLike, arrays_in, damage_of, read_arrays, unreadable, write_arrays
from .package import version

#: The version of the format: raised whenever the fields of any kind change.
VERSION = 14

_FORMAT = "invariode "

#: What writes each kind, and what reads it.
_KINDS = {
    "solution": ("Solution.save, nor as a checkpoint", "invariode.load(path)"),
    "checkpoint": ("a run with checkpoint=", "invariode.load(path, problem)"),
    "output": ("a run with checkpoint=", "invariode.load, from the checkpoint beside it"),
    "ensemble": ("EnsembleSolution.save", "invariode.EnsembleSolution.load(path)"),
    "store": ("solve_ensemble(store=...)", "invariode.EnsembleStore(path)"),
}

#: The shape of a value together with arrays of any names below its own.
GROUP = "*"


class Field(NamedTuple):
    """A value, or an array: dimensions of one name have one size in a whole file. One that is a number has that size;
    one that ends in `?` may be missing. The lengths of lists may be dimensions too: ``Annotated[list[str], "event"]``.
    """

    type: Any  # of a value a type hint; of an array None: that of states, real or complex, the same in a whole file
    shape: str | None = None  # dimensions; None: a value in JSON
    of: Callable[[Any], Any] | None = None  # takes it from what is saved; None: the item of the same name
    within: tuple[float, float | str] | None = None  # the range; up to the size of a dimension, "t", or below it: "<t"
    optional: bool = False

    @property
    def dimensions(self) -> list[str]:
        """Names of the field's dimensions."""
        return (self.shape or "").split()

    def fits(self, value: Any, sizes: dict[str, Any]) -> bool:
        """Return whether a value fits the field. `sizes`: sizes of dimensions known so far, to which this adds."""
        if self.shape in (None, GROUP):
            return _fits(value, self.type, sizes) and (value is None or self._within(value, sizes))
        if not hasattr(value, "dtype"):
            return False
        dtype, dimensions = value.dtype, self.dimensions
        if self.type is None and dtype not in (np.dtype(float), np.dtype(complex)):
            return False
        if dtype != (sizes.setdefault("type of states", dtype) if self.type is None else np.dtype(self.type)):
            return False
        if dimensions and dimensions[-1].endswith("?") and value.ndim < len(dimensions):
            dimensions.pop()
        known = (int(name) if name.isdigit() else sizes.get(name.rstrip("?")) for name in dimensions)
        if value.ndim != len(dimensions) or any(k not in (None, n) for k, n in zip(known, value.shape, strict=True)):
            return False
        sizes |= {name.rstrip("?"): size for name, size in zip(dimensions, value.shape, strict=True)}
        return self._within(value, sizes)

    def _within(self, value: Any, sizes: Mapping[str, Any]) -> bool:
        if self.within is None:
            return True
        low, high = self.within
        if isinstance(high, str):  # in a part of a file a size may be unknown
            high = sizes.get(high.removeprefix("<"), math.inf) - high.startswith("<")
        return bool(np.all((low <= np.asarray(value)) & (np.asarray(value) <= high)))


class Kind(NamedTuple):
    """Kind of file: its name and the fields that it holds."""

    name: str
    fields: dict[str, Field]

    def taken(self, source: Any, **more: Any) -> dict[str, Any]:
        """Return the fields of this kind, from `more` or else from the object to be saved."""
        found = dict(more)
        for name, field in self.fields.items():
            if name in found:  # given, or of a group
                continue
            value = reduce(operator.getitem, name.split("."), source) if field.of is None else field.of(source)
            if field.shape == GROUP:
                value, arrays = value
                found |= {f"{name}.{key}": array for key, array in arrays.items()}
            elif field.shape is not None and value is not None:
                value = np.asarray(value, dtype=field.type)
            if value is not None or not field.optional:
                found[name] = value
        return found

    def require(self, found: Mapping[str, Any]) -> None:
        """Raise an error that names the first field that is unknown, missing, or of a wrong type or size."""
        groups = tuple(f"{name}." for name, field in self.fields.items() if field.shape == GROUP)
        for name in found:
            if name not in self.fields and not (isinstance(found[name], np.ndarray) and name.startswith(groups)):
                raise ValueError(f"{shown(name)} should not be there")
        sizes: dict[str, Any] = {}
        for name, field in self.fields.items():
            if name not in found and not field.optional:
                raise KeyError(name)
            if name in found and not field.fits(found[name], sizes):
                value = found[name]
                what = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else shown(value)
                raise ValueError(f"{name}, {what}, does not fit")


def under(name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """The fields below a name, by the rest of their names."""
    return {key.removeprefix(f"{name}."): one for key, one in found.items() if key.startswith(f"{name}.")}


@cache
def _hints(table: type) -> dict[str, Any]:
    return get_type_hints(table, localns={"Any": Any}, include_extras=True)  # public classes tell another module


def _fits(value: Any, hint: Any, sizes: dict[str, Any]) -> bool:
    """Return whether a value is of a type, which may be nested."""
    outer, inner = get_origin(hint), get_args(hint)
    if outer is Annotated:  # a list of the length of a dimension, or a number that is it
        if not _fits(value, inner[0], sizes):
            return False
        size = value if isinstance(value, int) else len(value)
        return bool(sizes.setdefault(inner[1], size) == size)
    if outer in (Union, UnionType):
        return any(_fits(value, one, sizes) for one in inner)
    if outer in (list, tuple):
        return isinstance(value, (list, tuple)) and all(_fits(one, inner[0], sizes) for one in value)
    if outer is dict:
        return isinstance(value, dict) and all(_fits(one, inner[1], sizes) for one in value.values())
    if getattr(hint, "__annotations__", None):  # a record
        known = _hints(hint)
        same = isinstance(value, dict) and value.keys() == known.keys()
        return same and all(_fits(value[name], one, sizes) for name, one in known.items())
    return hint is Any or (isinstance(value, hint) and isinstance(value, bool) == (hint is bool))


# ----------------------------------------------------------------------------------------------------------------------
# Headers


def header(kind: str) -> dict[str, Any]:
    """Return the header that every file and store begins with."""
    return {"format": _FORMAT + kind, "version": VERSION, "invariode": version()}


def _word(value: Any) -> str:
    """Return a header's value as text for a message; the value may be anything."""
    return value if isinstance(value, str) and len(value) < 40 else shown(value)


def kind_of(path: Any, about: Any, *expected: str) -> str:
    """The kind of a file from its header, which is taken out. A ValueError unless it is expected, and of this version
    of the format."""
    given = about.pop("format", None) if isinstance(about, dict) else None
    kind = given.removeprefix(_FORMAT) if isinstance(given, str) else ""
    if kind not in _KINDS or kind == given:
        raise unreadable(path, f"was not written by {_KINDS[expected[0]][0]}")
    number, writer = about.pop("version", 0), about.pop("invariode", "0.2")
    what = f"is of kind '{kind}' in version {_word(number)} of the format, written by invariode {_word(writer)}"
    if kind not in expected:
        raise unreadable(path, f"{what}: read it with {_KINDS[kind][1]}")
    if number != VERSION:
        newer = isinstance(number, int) and number > VERSION
        remedy = "upgrade it" if newer else "use the invariode that wrote it, or solve the problem again"
        this = f"this is invariode {version()}, which reads version {VERSION}"
        raise unreadable(path, f"{what}; {this}: {remedy}")
    return kind


# ----------------------------------------------------------------------------------------------------------------------
# Files


def write(path: PathLike, kind: Kind, fields: Mapping[str, Any], durable: bool = False) -> None:
    """Writes a file, which takes the place of an existing one when it is complete."""
    write_arrays(path, _members(kind, fields), durable)


def packed(kind: Kind, fields: Mapping[str, Any]) -> memoryview:
    """Return the file of a kind with these fields as bytes."""
    whole = io.BytesIO()
    np.savez(whole, **_members(kind, fields))
    return whole.getbuffer()


def _members(kind: Kind, fields: Mapping[str, Any]) -> dict[str, Any]:
    kind.require(fields)
    arrays = {name: one for name, one in fields.items() if isinstance(one, np.ndarray)}
    about = {name: one for name, one in fields.items() if name not in arrays}
    return {**arrays, ABOUT: np.array(json.dumps({**header(kind.name), **about}))}


def read(path: PathLike, *kinds: Kind) -> tuple[Kind, dict[str, Any]]:
    """Return the kind of a file, one of these kinds, and its fields, all of them checked."""
    return _checked(path, read_arrays(path), *kinds)


def unpacked(data: bytes, path: PathLike, kind: Kind) -> dict[str, Any]:
    """Return the fields of a file of a kind, given as bytes; `path` is for messages."""
    return _checked(path, arrays_in(io.BytesIO(data), len(data), path), kind)[1]


def read_values(path: PathLike, kind: Kind) -> dict[str, Any]:
    """Return the values in a file, without its arrays."""
    values = {name: field for name, field in kind.fields.items() if field.shape is None}
    return _checked(path, read_arrays(path, only=ABOUT), Kind(kind.name, values))[1]


def _checked(path: PathLike, arrays: dict[str, Any], *kinds: Kind) -> tuple[Kind, dict[str, Any]]:
    try:
        about = json.loads(str(arrays.pop(ABOUT, "")))
    except (ValueError, RecursionError):
        about = None
    name = kind_of(path, about, *(kind.name for kind in kinds))
    kind = next(one for one in kinds if one.name == name)
    with damage_of(path):
        kind.require({**about, **arrays})
    return kind, {**about, **arrays}
