"""Ensembles in Zarr stores: written part by part, read as a whole, as a result or by xarray."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .. import _core
from .._base import arguments
from .._base.arguments import Array, shown
from .._base.files import damage_of, named
from .._base.formats import Field, Kind, header, kind_of
from .._base.locks import Lock
from .._base.package import extra
from .._results.saving import apart, together
from .ensemble_solution import (
    OF_TRAJECTORIES,
    REAL_STATS,
    EnsembleEvents,
    EnsembleSensitivities,
    EnsembleSolution,
    EnsembleStats,
    final_states,
    none_of,
)
from .outcomes import ROWS, UNSOLVED, Outcomes, counts_by_name
from .sources import RowBlock, digest

if TYPE_CHECKING:  # an extra, imported when it is used
    import xarray

#: The coordinates that checks of shapes refer to.
_SIZED = ("component", "invariant", "t", "sensitivity")
#: What a store says that is being made.
_UNFINISHED = "invariode store, unfinished"
#: The version in which what an array holds where nothing was written is no missing value.
_ZARR_FORMAT = 3
#: The arrays with a row for each trajectory.
_ROWS = {
    "y0": Field(None, "trajectory component"),
    "args": Field(float, "trajectory parameter"),
    **OF_TRAJECTORIES,
    "counts": Field(np.int64, "trajectory count"),
    "clipped_amount": Field(float, "trajectory"),
    "stiff_since": Field(float, "trajectory"),
    "discontinuity": Field(float, "trajectory"),
    "accumulation": Field(float, "trajectory"),
    "S": Field(None, "trajectory component sensitivity t"),
    "S_end": Field(None, "trajectory component sensitivity"),
}
#: Those at the times of `t_eval`.
_AT_TIMES = ("y", "S")


#: Those with a number for each part: by which rows it was made, and what was written. Zero: nothing yet.
_OF_PARTS = ("checksum", "digest")


#: And what it says of itself.
_STORE = Kind(
    "store",
    {
        "problem": Field(dict[str, Any]),
        "chunk": Field(int, within=(1, np.inf)),  # rows in a part
        "size": Field(int | None, within=(0, np.inf)),
        "seed": Field(Any),
        "kept_times": Field(bool),
        "coordinates": Field(int),  # their checksum
    },
)


class Layout(NamedTuple):
    """Arrays of a store, and the description of the problem that it belongs to."""

    about: dict[str, Any]  # what describes the problem, its method and options, in text and numbers
    names: dict[str, list[str]]  # the coordinates 'component', 'parameter', 'invariant', 'event' and 'sensitivity'
    t: Array  # the times of y
    dtype: np.dtype[Any]  # of y
    times: bool  # `t_eval` was given; otherwise only the final states are kept

    def arrays(self) -> Iterator[tuple[str, tuple[int, ...], np.dtype[Any], Any]]:
        """Yield the arrays: name, shape without the trajectories, data type and value for unsolved trajectories."""
        sizes = {name: len(these) for name, these in self.names.items()} | {
            "t": len(self.t),
            "count": len(_core.COUNTS),
        }
        for name, field in _ROWS.items():
            shape = tuple(sizes[one] for one in field.dimensions[1:])
            if 0 in shape or (name in _AT_TIMES and not self.times):
                continue
            dtype = np.dtype(field.type or self.dtype)
            yield name, shape, dtype, UNSOLVED if name == "status" else np.nan if dtype.kind in "fc" else 0


class StoreWriter:
    """A store that is being filled, by one process at a time. A part is complete when its digest is there, which is
    written last; the store is there once all of its arrays are. Chunks carry a CRC-32C, which Zarr tests whenever it
    reads one; the checksum of each part, over all of its arrays, shows chunks that are lost or in the wrong place.

    Raises FileExistsError: There is a store, and it is not to be resumed.
    Raises ValueError: It belongs to another problem, is not a store of an ensemble, or another process is filling it.
    """

    def __init__(
        self, path: Any, layout: Layout, length: Callable[[], int], size: int | None, seed: Any, resume: bool
    ) -> None:
        self.path, self._layout = path, layout
        folder = _folder(path)
        self._lock = None if folder is None else Lock(folder, "store")
        try:
            group = _opened(path, "r+")
            if group is None or group.attrs.get("format") == _UNFINISHED:
                length_of_part = length()
                if folder is None:
                    group = self._created(path, length_of_part, size, seed)
                else:
                    group = self._created_beside(folder, length_of_part, size, seed)
            else:
                if not resume:
                    raise FileExistsError(
                        f"{named(path)} exists already: continue it with resume=True, remove it, or give another name"
                    )
                _require_same(path, group, layout, size, seed)
            self._group = group
            #: Rows in a part.
            self.length = int(group.attrs["chunk"])
            self._arrays = {name: group[name] for name, *_ in layout.arrays()}
            self._digests = group["digest"]
            rows = {array.shape[0] for array in self._arrays.values()}
            if len(rows) > 1:  # a process was killed while they grew
                self._grow(max(rows))
            self._known = self._digests[:]
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> StoreWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        """Release the lock: other processes may resume the store."""
        if self._lock is not None:
            self._lock.release()

    def _created_beside(self, folder: Path, length: int, size: int | None, seed: Any) -> Any:
        """Return a new store on this machine: it gets its name when it is complete. What a killed process has left
        there is overwritten."""
        part = folder.with_name(f".{folder.name}.invariode-part")
        if folder.is_dir() and any(folder.iterdir()):
            raise ValueError(f"the folder {folder} is there, and is not a store of an ensemble: give another name")
        self._created(part, length, size, seed)
        if folder.is_dir():
            folder.rmdir()
        part.rename(folder)
        return _opened(folder, "r+")

    def _created(self, path: Any, length: int, size: int | None, seed: Any) -> Any:
        attributes = {"format": _UNFINISHED}
        group = _zarr().create_group(path, zarr_format=_ZARR_FORMAT, overwrite=True, attributes=attributes)
        rows = length if size is None else size
        for name, shape, dtype, fill in self._layout.arrays():
            group.create_array(
                name,
                shape=(rows, *shape),
                chunks=(length, *shape),
                dtype=dtype,
                fill_value=fill,
                dimension_names=_ROWS[name].dimensions,
                compressors=_compressors(),
            )
        coordinates: dict[str, Any] = {**self._layout.names, "count": list(_core.COUNTS), "t": self._layout.t}
        for name, values in coordinates.items():
            if len(values):
                array = np.asarray(values)
                kind: Any = str if array.dtype.kind == "U" else array.dtype
                new = group.create_array(
                    name, shape=array.shape, dtype=kind, dimension_names=[name], compressors=_compressors()
                )
                new[:] = array
        for name in _OF_PARTS:
            group.create_array(
                name,
                shape=(-(-rows // length),),
                chunks=(1,),
                dtype=np.uint64,
                fill_value=0,
                dimension_names=["part"],
                compressors=_compressors(),
            )
        about = {"problem": self._layout.about, "chunk": length, "size": size, "seed": seed}
        about |= {"kept_times": self._layout.times, "coordinates": _of_coordinates(group)}
        group.attrs.update({**header("store"), **about})
        return group

    def missing(self, parts: Iterator[RowBlock]) -> Iterator[RowBlock]:
        """Yield the parts that are missing.

        Raises ValueError: A part that is there belongs to other rows.
        """
        for part in parts:
            there = int(self._known[part.number]) if part.number < len(self._known) else 0
            if there == 0:
                yield part
            elif there != digest(part):
                raise ValueError(
                    f"{named(self.path)} has other y0 or args for trajectories {part.start} to {part.stop - 1}: "
                    "resume with the same rows (and seed), or give another name"
                )

    def write(self, part: RowBlock, found: Outcomes) -> None:
        """Store the outcomes of a part."""
        if part.stop > self._arrays["status"].shape[0]:
            self._grow(max(part.stop, 2 * self._arrays["status"].shape[0]))
        here = slice(part.start, part.stop)
        written: dict[str, Array] = {}
        for name, array in self._arrays.items():
            if name == "y0":
                values = np.asarray(part.y0)
            elif name == "args":
                values = np.asarray(part.args, dtype=float)
                values = np.broadcast_to(values, (len(part.y0), values.shape[-1]))
            else:
                values = np.asarray(getattr(found, name))
            written[name] = values.astype(array.dtype)
            array[here] = written[name]
        messages, happened = self._write_apart(part, found)
        number = slice(part.number, part.number + 1)
        self._group["checksum"][number] = np.array([_checksum(written, happened, messages)], dtype=np.uint64)
        self._digests[number] = np.array([digest(part)], dtype=np.uint64)

    def _write_apart(self, part: RowBlock, found: Outcomes) -> tuple[dict[str, str], dict[str, Array]]:
        """Write what only some trajectories have, messages and events, in a group of the part, and return it."""
        happened = together(found.events, none_of(part.y0))
        if not found.messages and not len(happened["t"]):
            return {}, {}
        own = self._group.create_group(f"parts/{part.number}", overwrite=True)
        messages = {str(part.start + i): text for i, text in found.messages.items()}
        own.attrs["messages"] = messages
        happened["trajectory"] += part.start
        for name, values in happened.items():
            dtype = np.dtype(values.dtype.str)  # Zarr knows one of the two C types of 8 bytes
            own.create_array(name, shape=values.shape, dtype=dtype, compressors=_compressors())[...] = values
        return messages, happened

    def _grow(self, rows: int) -> None:
        for array in self._arrays.values():
            array.resize((rows, *array.shape[1:]))
        for name in _OF_PARTS:
            self._group[name].resize((-(-rows // self.length),))
        self._digests = self._group["digest"]

    def finish(self, size: int) -> None:
        """Record that the store is complete, with this many rows."""
        if size < self._arrays["status"].shape[0]:
            self._grow(size)
        self._group.attrs["size"] = size
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the warning that not every reader knows it
            _zarr().consolidate_metadata(self.path, zarr_format=_ZARR_FORMAT)


class EnsembleStore:
    """An ensemble in a Zarr store: what `solve_ensemble` with `store` returns. Nothing is read before it is used.

    Parameters
    ----------
    path : str, path-like or a store of Zarr
        What was given as `store`.

    Attributes
    ----------
    path : str, path-like or a store of Zarr
        The same.
    attributes : dict
        What the store says about its problem, its options and its seed.

    Raises
    ------
    FileNotFoundError
        There is nothing at the path.
    ValueError
        The path does not hold an ensemble store.
    ModuleNotFoundError
        zarr, of the extra `cluster`, is not installed.
    """

    def __init__(self, path: Any) -> None:
        self.path = path
        self._group = _opened(path, "r")
        if self._group is None:
            raise FileNotFoundError(f"{named(path)} does not exist: solve_ensemble(store=...) writes a store")
        self.attributes = _about(path, self._group)

    def __len__(self) -> int:
        size = self.attributes["size"]
        return self._group["status"].shape[0] if size is None else int(size)

    def __repr__(self) -> str:
        missing = self.missing
        left = f", {missing} not solved yet: resume=True" if missing else ""
        return f"EnsembleStore({named(self.path)!r}) of {len(self)} trajectories, {len(self.failed)} failed{left}"

    def _of_parts(self, name: str) -> Iterator[tuple[int, Array]]:
        """Yield an array part by part, with the first row of each: no more than a part is in memory."""
        length = int(self.attributes["chunk"])
        for start in range(0, len(self), length):
            yield start, self._group[name][start : min(start + length, len(self))]

    @property
    def missing(self) -> int:
        """Number of trajectories that are not solved yet, or whose part was not written completely."""
        length, size = int(self.attributes["chunk"]), len(self)
        digests = self._group["digest"][: -(-size // length)]
        return sum(min(length, size - part * length) for part in np.flatnonzero(digests == 0).tolist())

    @property
    def failed(self) -> Array:
        """Numbers of the trajectories that failed."""
        found = [
            start + np.flatnonzero((status < 0) & (status != UNSOLVED)) for start, status in self._of_parts("status")
        ]
        return np.concatenate([np.zeros(0, dtype=np.int64), *found])

    @property
    def messages(self) -> dict[int, str]:
        """Messages of the failed trajectories, by number."""
        texts = (dict(part.attrs["messages"]) for part in self._parts())
        return dict(sorted((int(i), text) for these in texts for i, text in these.items()))

    @property
    def events(self) -> list[EnsembleEvents]:
        """Occurrences of the events, as those of `EnsembleSolution`."""
        each = [_arrays_of(part) for part in self._parts()]
        empty = {"number": np.zeros(0, dtype=np.int64), **none_of(self._group["y_end"])}
        whole = {name: np.concatenate([none, *(one[name] for one in each)]) for name, none in empty.items()}
        size = self._group["event"].shape[0] if "event" in self._group else 0
        return [EnsembleEvents(**one) for one in apart(whole, size)]

    def _parts(self) -> list[Any]:
        if "parts" not in self._group:
            return []
        return [part for _, part in sorted(self._group["parts"].groups(), key=lambda named: int(named[0]))]

    def to_xarray(self) -> xarray.Dataset:
        """Return the store as a data set of xarray, which reads only what is used.

        Returns
        -------
        xarray.Dataset
            `y0`, `y_end` and, with `t_eval`, `y` by trajectory, component and t, `args` by parameter, `status` and the
            like, `counts` by their names; -128 is the status of a trajectory that is not solved yet. With
            `sensitivities`, ``S_end`` and ``S`` have one more dimension, "sensitivity".

        Raises
        ------
        ModuleNotFoundError
            xarray, of the extra `data`, is not installed.
        """
        whole = extra("xarray", "this needs", "data").open_zarr(
            self.path, consolidated=False, drop_variables=[*_OF_PARTS]
        )
        data: xarray.Dataset = whole.isel(trajectory=slice(len(self)))
        texts = {
            name: json.dumps(one) for name, one in data.attrs.items() if one is None or isinstance(one, (dict, list))
        }
        return data.assign_attrs(texts)  # netCDF takes neither dicts nor None

    def load(self) -> EnsembleSolution:
        """Load the whole store into memory, as `solve_ensemble` without `store` returns it, except for the functions.

        Returns
        -------
        EnsembleSolution

        Raises
        ------
        ValueError
            Some trajectories are not solved yet.
        """
        with damage_of(self.path):
            self._require_whole()
        if missing := self.missing:
            raise ValueError(f"{missing} trajectories are not solved yet: solve them with resume=True")
        size, group = len(self), self._group
        m = group["invariant"].shape[0] if "invariant" in group else 0
        times = bool(self.attributes["kept_times"])
        held = {
            name: group[name][:size] if name in group else np.zeros((size, m))
            for name in (*ROWS, "attempt")
            if name not in ("S", "S_end")
        }
        of_stats: dict[str, Any] = {name: held.pop(name) for name in REAL_STATS}
        y = held["y"] if times else final_states(held["y_end"], held["status"])
        counts = counts_by_name(held.pop("counts"))
        stats = EnsembleStats(**counts, **of_stats)
        about = {"messages": self.messages, "events": self.events, "stats": stats, "success": held["status"] >= 0}
        about["_sensitivities"] = self._sensitivities(held["status"])
        of_y = {"t": group["t"][:], "y": y, "_final": not times, "_labels": group["component"][:].tolist()}
        return EnsembleSolution(**{**held, **about, **of_y})

    def _require_whole(self) -> None:
        """Raise a ValueError that says what is damaged, unless every array is there and as it was written."""
        group, size, length = self._group, len(self), int(self.attributes["chunk"])
        if _of_coordinates(group) != self.attributes["coordinates"]:
            raise ValueError("its coordinates are not as they were written")
        sizes = {name: group[name].shape[0] if name in group else 0 for name in (*_SIZED, "parameter", "event")}
        sizes["count"] = len(_core.COUNTS)
        names = []
        for name, field in _ROWS.items():
            if 0 in [sizes.get(one, 1) for one in field.dimensions[1:]]:
                continue
            if name in _AT_TIMES and not self.attributes["kept_times"]:
                continue
            if not field.fits(group[name], sizes) or group[name].shape[0] < size:
                raise ValueError(f"{name} is of {group[name].dtype} and shape {group[name].shape}")
            names.append(name)
        apart = {int(number): one for number, one in group["parts"].groups()} if "parts" in group else {}
        for number in np.flatnonzero(group["digest"][: -(-size // length)]).tolist():
            rows = slice(number * length, min((number + 1) * length, size))
            there = {name: group[name][rows] for name in names}
            part = apart.get(number)
            happened, messages = ({}, {}) if part is None else (_arrays_of(part), dict(part.attrs["messages"]))
            if _checksum(there, happened, messages) != int(group["checksum"][number]):
                raise ValueError(f"trajectories {rows.start} to {rows.stop - 1} are not as they were written")

    def _sensitivities(self, status: Array) -> EnsembleSensitivities | None:
        group, size = self._group, len(self)
        if "sensitivity" not in group:
            return None
        at_times, end = group["S"][:size] if "S" in group else None, group["S_end"][:size]
        return EnsembleSensitivities.of(group["sensitivity"][:].tolist(), at_times, end, status)


# ----------------------------------------------------------------------------------------------------------------------
# The same problem?


def _arrays_of(part: Any) -> dict[str, Array]:
    """Return the events of a part, by name."""
    return {name: part[name][:] for name in part.array_keys()}


def _about(path: Any, group: Any) -> dict[str, Any]:
    """Return the attributes of a store. Raises ValueError if there is no store at the path."""
    about = {} if group is None else dict(group.attrs)
    kind_of(path, about, "store")
    with damage_of(path):
        _STORE.require(about)
    return about


def _require_same(path: Any, group: Any, layout: Layout, size: int | None, seed: Any) -> None:
    """Raise an error for a store that belongs to another problem."""
    held = _about(path, group)
    theirs, ours = _flat(held["problem"]), _flat(layout.about)
    differing = [key for key in {**theirs, **ours} if theirs.get(key) != ours.get(key)]
    if size is not None and held["size"] not in (None, size):
        differing.append("the number of trajectories")
        theirs["the number of trajectories"], ours["the number of trajectories"] = held["size"], size
    if seed is not None and seed != held["seed"]:
        differing.append("seed")
        theirs["seed"], ours["seed"] = held["seed"], seed
    if differing:
        differences = "; ".join(f"{key} is {theirs.get(key)!r} there and {ours.get(key)!r} now" for key in differing)
        raise ValueError(
            f"the store belongs to another problem: {differences}. Solve the same one, or give another name"
        )


def _flat(about: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Return all leaves of nested dictionaries by their dotted paths."""
    leaves: dict[str, Any] = {}
    for name, value in about.items():
        if isinstance(value, list) and any(isinstance(one, dict) for one in value):
            value = {str(i): one for i, one in enumerate(value)}
        leaves |= _flat(value, f"{above}{name}.") if isinstance(value, dict) else {f"{above}{name}": value}
    return leaves


def parameter_names(fun: Any, args: Any, inputs: int) -> list[str]:
    """Return names of the numbers in args: those of the arguments of `fun` after t, y and its inputs, if each is one.
    Empty: they are not numbers."""
    try:
        numbers = np.asarray(args, dtype=float)
    except (TypeError, ValueError):
        return []
    if numbers.size == 0:
        return []
    size = numbers.shape[-1] if numbers.ndim <= 2 else 0
    try:
        names = list(inspect.signature(fun).parameters)[2 + inputs :]
    except (TypeError, ValueError):
        names = []
    return names if len(names) == size else [f"p{i}" for i in range(size)]


# ----------------------------------------------------------------------------------------------------------------------
# Zarr


def _compressors() -> list[Any]:
    """Return the codecs of chunks: compression, and a CRC-32C that is checked when they are read."""
    codecs = _zarr().codecs
    return [codecs.ZstdCodec(level=0), codecs.Crc32cCodec()]


def _of_coordinates(group: Any) -> int:
    """Return the checksum of the coordinates of a store."""
    names = (*_SIZED, "parameter", "event", "count")
    found = {name: group[name][:] for name in names if name in group}
    texts = {name: json.dumps([str(one) for one in values]) for name, values in found.items() if name != "t"}
    times = {"t": found["t"]} if "t" in found else {}
    return _checksum(times, {}, texts) >> 1  # 63 bits fit the integers of any reader of JSON


def _checksum(arrays: Mapping[str, Array], events: Mapping[str, Array], texts: Mapping[str, str]) -> int:
    """Return a number of 64 bits for the contents of arrays, of those of events, and of texts, by name."""
    found = hashlib.blake2b(digest_size=8)
    for kind, group in (("array", arrays), ("event", events)):
        for name in sorted(group):
            values = np.ascontiguousarray(group[name])
            found.update(f"{kind} {name} {values.dtype.str} {values.shape} ".encode())
            found.update(values.tobytes())
    found.update(json.dumps(texts, sort_keys=True).encode("utf-8", "surrogatepass"))
    return int.from_bytes(found.digest(), "little")


def _zarr() -> Any:
    return extra("zarr", "store= needs", "cluster")


def _opened(path: Any, mode: str) -> Any:
    """Return the group; None if nothing is there."""
    zarr = _zarr()
    if isinstance(path, (str, os.PathLike)):
        arguments.path("store", path)
    try:
        return zarr.open_group(path, mode=mode, zarr_format=_ZARR_FORMAT, use_consolidated=False)
    except FileNotFoundError:
        return None
    except TypeError as error:
        raise TypeError(
            f"store must be a path, a URL or a store of zarr, got {shown(path)}: give the name of a folder"
        ) from error


def _folder(path: Any) -> Path | None:
    """Return the local folder of a store; None if it is not in a folder of this machine."""
    if not isinstance(path, (str, os.PathLike)) or "://" in os.fspath(path):
        return None
    folder = Path(os.path.realpath(arguments.path("store", path)))
    for one in (folder, *folder.parents):
        if one.exists() and not one.is_dir():
            raise FileExistsError(f"store: {one} is a file, where a folder should be: give another name")
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder
