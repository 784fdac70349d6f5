"""Runs on disk: the memory of a run in one file, replaced whole, and its output in another, which only grows."""

from __future__ import annotations

import io
import json
import os
import secrets
import struct
import zlib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ._arguments import Array
from ._core import Dense
from ._files import PathLike, about_of, arrays_in, read_arrays, unreadable
from ._run_identity import Identity
from .export import PLAIN, write_arrays
from .result import Result

__all__ = ["CHECKPOINT", "CHECKPOINT_VERSION", "Checkpoint", "Stored", "dense_of", "read_checkpoint"]

#: What every checkpoint says of itself, and the version of its contents: raised whenever they change.
CHECKPOINT, CHECKPOINT_VERSION = "invariode checkpoint", 1

#: In front of each part of the output: its size and the checksum of its bytes.
_HEAD = struct.Struct("<QI")

#: The two names of the file of the output, after that of the checkpoint. A run takes the one that the checkpoint of a
#: former run, which is there until the first of this one is complete, does not use.
_ENDINGS = (".output", ".output2")


class Stored(NamedTuple):
    """A run as its files have it."""

    about: dict[str, Any]
    arrays: dict[str, Array]  # of the run up to here, its memory among them
    identity: Identity
    checkpoint: Checkpoint


class Checkpoint:
    """The files of a run, to be written.

    The output is appended and on the disk before the file that tells how much of it counts takes the place of the one
    before. So the two agree at every moment, and what a killed process has appended since does not count.
    """

    def __init__(self, path: PathLike, output: str, token: str, length: int) -> None:
        self._path = Path(os.path.realpath(path))
        self._output = output
        self._token = token  # of the run, in both files
        self._length = length  # of the output that counts
        self.mechanics: dict[str, Any] | None = None  # what the parts of other processes have cost

    def go_on(self, mechanics: dict[str, Any] | None) -> None:
        """The run is extended: the files must still be its own."""
        about = about_of(self._path, read_arrays(self._path), {CHECKPOINT: CHECKPOINT_VERSION})
        if about["token"] != self._token:
            raise ValueError(f"checkpoint: {self._path} holds another run by now: load it, or solve with another file")
        self.mechanics = mechanics

    @classmethod
    def of_new_run(cls, path: PathLike, identity: Identity, y0: Array, at_start: list[int]) -> Checkpoint:
        """Files for a run that begins. A ValueError where there is one that has not ended, or something else; a
        FileNotFoundError where there is no such folder."""
        target = Path(os.path.realpath(path))
        if not target.parent.is_dir():
            raise FileNotFoundError(f"checkpoint: there is no folder {target.parent}: make it, or give another file")
        taken = None
        if target.exists():
            about = about_of(path, read_arrays(path), {CHECKPOINT: CHECKPOINT_VERSION})
            if about["running"]:
                raise ValueError(
                    f"checkpoint: {os.fspath(path)} holds a run that has come to t = {about['t_end']!r} and has not "
                    "ended: go on with load(path, problem).extend(tf), or delete it"
                )
            taken = about["output"]
        output = next(target.name + ending for ending in _ENDINGS if target.name + ending != taken)
        self = cls(path, output, secrets.token_hex(8), 0)
        (target.parent / output).unlink(missing_ok=True)
        arrays = {f"identity.{name}": one for name, one in identity.arrays.items()}
        self._append({**arrays, "start": y0}, {"token": self._token, "identity": identity.about, "at_start": at_start})
        return self

    def keep(self, part: Result, running: bool, arrays: dict[str, Any], about: dict[str, Any]) -> None:
        """Adds the output of a part of the run. `arrays` and `about`: what it takes to go on behind it."""
        self._append(_output_of(part), {"token": self._token})
        stored = {
            "format": CHECKPOINT,
            "version": CHECKPOINT_VERSION,
            "invariode": version("invariode"),
            "output": self._output,
            "token": self._token,
            "length": self._length,
            "running": running,
            **{name: part[name] for name in PLAIN},
            "t_end": part.t_end,
            "stats": dict(part.stats),
            "methods": [] if part.steps is None else list(part.steps._methods),
            **about,
        }
        drift = part._drift
        write_arrays(
            {
                **arrays,
                "drift.residual": drift.residual,
                "drift.distance": drift.distance,
                "drift.correction": np.asarray(drift.correction),
                "about": np.array(json.dumps(stored)),
            },
            self._path,
            durable=True,
        )
        for ending in _ENDINGS:
            if self._path.name + ending != self._output:
                (self._path.parent / (self._path.name + ending)).unlink(missing_ok=True)

    def _append(self, arrays: dict[str, Any], about: dict[str, Any]) -> None:
        contents = io.BytesIO()
        np.savez(contents, about=np.array(json.dumps(about)), **arrays)
        data = contents.getbuffer()
        place = self._path.parent / self._output
        with open(place, "r+b" if place.exists() else "xb") as file:
            file.truncate(self._length)  # what a process has left that was killed
            file.seek(self._length)
            file.write(_HEAD.pack(len(data), zlib.crc32(data)))
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._length += _HEAD.size + len(data)


def _output_of(part: Result) -> dict[str, Any]:
    g, jumps = part._invariants, part._invariants.jumps
    values = np.array([jump.value[: len(g)] for jump in jumps], dtype=float)
    arrays: dict[str, Any] = {
        "t": part.t,
        "y": part.y,
        "jumps.row": np.array([jump.row for jump in jumps], dtype=np.int64),
        "jumps.t": np.array([jump.t for jump in jumps], dtype=float),
        "jumps.value": values.reshape(len(jumps), len(g)),
    }
    if part.steps is not None:
        arrays["steps"] = part.steps._rows
    for what, events in (("t_events", part.t_events), ("y_events", part.y_events)):
        arrays |= {f"{what}.{i}": one for i, one in enumerate(events or ())}
    if part.sol is not None:
        parts = part.sol._dense.parts()
        arrays |= {f"dense.{name}": one for name, one in parts.items() if isinstance(one, np.ndarray)}
        arrays["dense.about"] = np.array(
            json.dumps({n: one for n, one in parts.items() if not isinstance(one, np.ndarray)})
        )
    return arrays


# ----------------------------------------------------------------------------------------------------------------------
# Read again


def read_checkpoint(path: PathLike, arrays: dict[str, Any], about: dict[str, Any]) -> Stored:
    """The run of a checkpoint, of which the first file has been read."""
    place = Path(os.path.realpath(path)).parent / Path(about["output"]).name
    try:
        file = open(place, "rb")  # noqa: SIM115 - the with statement is below: only this line may miss the file
    except FileNotFoundError:
        raise unreadable(path, f"is half of a checkpoint: {place} with the output of the run is missing") from None
    with file:
        parts = list(_parts(place, file.read(about["length"])))
    if sum(size for size, _ in parts) != about["length"]:
        raise unreadable(place, "is shorter than its checkpoint says")
    first, *rest = (part for _, part in parts)
    head = json.loads(str(first["about"]))
    if head["token"] != about["token"]:
        raise unreadable(place, "belongs to another run than its checkpoint")
    of_identity = {name.removeprefix("identity."): one for name, one in first.items() if name.startswith("identity.")}
    options = head["identity"]["options"]
    output = _joined(rest)
    if "end" in (options.get("keep"), options.get("save")):
        output |= {"t": np.array([about["t_end"]]), "y": arrays["y_end"][:, None]}
    for e in head["at_start"]:
        output[f"t_events.{e}"] = np.concatenate([[head["identity"]["problem"]["t0"]], output[f"t_events.{e}"]])
        output[f"y_events.{e}"] = np.concatenate([first["start"][None, :], output[f"y_events.{e}"]])
    return Stored(
        about,
        {**arrays, **output},
        Identity(head["identity"], of_identity),
        Checkpoint(path, about["output"], about["token"], about["length"]),
    )


def _parts(place: Path, contents: bytes) -> Iterator[tuple[int, dict[str, Any]]]:
    at = 0
    while at + _HEAD.size <= len(contents):
        size, checksum = _HEAD.unpack_from(contents, at)
        data = contents[at + _HEAD.size : at + _HEAD.size + size]
        if len(data) != size or zlib.crc32(data) != checksum:
            raise unreadable(place, "is damaged")
        yield _HEAD.size + size, arrays_in(io.BytesIO(data), size, place)
        at += _HEAD.size + size


def _joined(parts: list[dict[str, Any]]) -> dict[str, Array]:
    """The output of all parts."""
    rows = np.cumsum([0, *(len(part["t"]) for part in parts)])
    whole = {"y": np.concatenate([part["y"] for part in parts], axis=1)}
    for name in parts[0]:
        if name in ("about", "y") or name.startswith("dense."):
            continue
        whole[name] = np.concatenate([part[name] for part in parts])
    whole["jumps.row"] = np.concatenate([part["jumps.row"] + row for part, row in zip(parts, rows, strict=False)])
    if "dense.t" in parts[0]:
        whole |= _joined_dense(parts)
    return whole


def _joined_dense(parts: list[dict[str, Any]]) -> dict[str, Array]:
    """The continuous solution: each part begins at the last knot of the one before, or beside it after a jump."""
    t, y, end, offset, data = ([parts[0][f"dense.{name}"]] for name in ("t", "y", "end", "offset", "data"))
    size = len(data[0])
    for part in parts[1:]:
        known = part["dense.t"][0] == t[-1][-1] and np.array_equal(part["dense.y"][0], y[-1][-1])
        if not known:
            end.append(part["dense.t"][:1])
            offset.append(np.array([size]))
        t.append(part["dense.t"][known:])
        y.append(part["dense.y"][known:])
        end.append(part["dense.end"])
        offset.append(part["dense.offset"] + size)
        data.append(part["dense.data"])
        size += len(data[-1])
        if not len(t[-1]):  # nothing has happened in this part
            t.pop(), y.pop()
    others = {name: one for name, one in parts[0].items() if name.startswith("dense.")}
    joined = {"t": t, "y": y, "end": end, "offset": offset, "data": data}
    return {**others, **{f"dense.{name}": np.concatenate(one) for name, one in joined.items()}}


def dense_of(arrays: dict[str, Any]) -> Dense | None:
    """The continuous solution in the arrays of a checkpoint, if there is one."""
    if "dense.t" not in arrays:
        return None
    parts = {name.removeprefix("dense."): one for name, one in arrays.items() if name.startswith("dense.")}
    about = json.loads(str(parts.pop("about")))
    return Dense.from_parts(**parts, **about)
