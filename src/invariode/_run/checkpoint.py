"""Runs on disk: the memory of a run in one file, replaced whole, and its output in another, which only grows."""

from __future__ import annotations

import io
import json
import os
import platform
import re
import secrets
import struct
import zlib
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._base.files import PathLike, about_of, arrays_in, path_of, read_arrays, unreadable
from .._base.locks import Lock, held
from .._results.export import PLAIN, TEMPORARY, take_mode, write_arrays
from .._results.result import Result
from .identity import Identity

__all__ = ["CHECKPOINT", "CHECKPOINT_VERSION", "Checkpoint", "Stored", "read_checkpoint"]

#: What every checkpoint says of itself, and the version of its contents: raised whenever they change.
CHECKPOINT, CHECKPOINT_VERSION = "invariode checkpoint", 2
#: Between the name of a checkpoint and the token of its run, in the name of the file of the output,
_OUTPUT = ".output-"
#: and before that token at the start of the file.
_MAGIC = b"invariode output "
#: Bytes of a token, which is written in hexadecimal.
_TOKEN = 8
#: In front of each part of the output: its size and the checksum of its bytes.
_HEAD = struct.Struct("<QI")
#: Readings of a checkpoint that a running process replaces meanwhile.
_READINGS = 10


class Stored(NamedTuple):
    """A run as its files have it."""

    about: dict[str, Any]
    arrays: dict[str, Array]  # of the run up to here, its memory among them
    identity: Identity
    checkpoint: Checkpoint


class Checkpoint:
    """The files of a run, to be written.

    The output is appended and on the disk before the file that tells how much of it counts takes the place of the one
    before. So the two agree at every moment, and what a killed process has appended since does not count. Only files
    that carry a token of ours are ever changed, and only while the lock is held; before each writing the state file is
    seen to be the one that this run has left.
    """

    def __init__(self, path: PathLike, token: str, length: int = 0, sequence: int = 0) -> None:
        self._path = Path(os.path.realpath(path_of(path)))
        self._token = token  # of the run, in both files
        self._length = length  # of the output that counts
        self._sequence = sequence  # number of the state file that was written last
        self._begin: Callable[[], tuple[dict[str, Any], dict[str, Any]]] | None = None  # for a new run: its first part
        self._left: dict[str, Any] | None = None  # what the state file said when this run last saw it; None: no file
        self._lock: Lock | None = None
        self.mechanics: dict[str, Any] | None = None  # what the parts of other processes have cost

    @property
    def _output(self) -> Path:
        return self._path.with_name(self._path.name + _OUTPUT + self._token)

    def go_on(self, mechanics: dict[str, Any] | None) -> None:
        """The run is extended: the files must still be its own, and as it left them. Takes the lock."""
        self._lock = held(self._path, "checkpoint")
        try:
            self._left = _about(self._path)
            if self._left is None or self._left["token"] != self._token:
                raise ValueError(
                    f"checkpoint: {self._path} holds another run by now: load it, or solve with another file"
                )
            if self._left["sequence"] != self._sequence and self._left["writer"] != _writer():
                raise ValueError(
                    f"checkpoint: another process has gone on with {self._path}, to t = {self._left['t_end']!r}: load "
                    "it again"
                )
            self._remove_remains()
        except BaseException:
            self.release()
            raise
        self.mechanics = mechanics

    @classmethod
    def of_new_run(cls, path: PathLike, identity: Callable[[], Identity], y0: Array, at_start: list[int]) -> Checkpoint:
        """Files for a run that begins, and the lock on them; `identity` is called when the run has started. A
        ValueError where there is a run that has not ended, or something else; a FileNotFoundError where there is no
        such folder."""
        self = cls(path, secrets.token_hex(_TOKEN))
        if not self._path.parent.is_dir():
            raise FileNotFoundError(
                f"checkpoint: there is no folder {self._path.parent}: make it, or give another file"
            )
        self._lock = held(self._path, "checkpoint")
        try:
            self._left = _about(self._path)
            if self._left is not None and self._left["running"]:
                raise ValueError(
                    f"checkpoint: {os.fspath(path)} holds a run that has come to t = {self._left['t_end']!r} and has "
                    "not ended: go on with load(path, problem).extend(tf), or delete it"
                )
            self._remove_remains()
        except BaseException:
            self.release()
            raise

        def first() -> tuple[dict[str, Any], dict[str, Any]]:
            who = identity()
            arrays = {f"identity.{name}": one for name, one in who.arrays.items()}
            return {**arrays, "start": y0}, {"identity": who.about, "at_start": at_start}

        self._begin = first
        return self

    def release(self) -> None:
        """Others may go on with the files."""
        if self._lock is not None:
            self._lock.release()

    def keep(self, part: Result, running: bool, arrays: dict[str, Any], about: dict[str, Any]) -> None:
        """Adds the output of a part of the run. `arrays` and `about`: what it takes to go on behind it."""
        self._require_untouched()
        if self._begin is not None:
            self._create()
            self._append(*self._begin())
            self._begin = None
        self._append(_output_of(part), {})
        self._sequence += 1
        stored = {
            "format": CHECKPOINT,
            "version": CHECKPOINT_VERSION,
            "invariode": version("invariode"),
            "token": self._token,
            "length": self._length,
            "sequence": self._sequence,
            "writer": _writer(),
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
        replaced, self._left = self._left, stored
        if replaced is None or replaced["token"] != self._token:
            self._remove_remains()

    def _require_untouched(self) -> None:
        """Nobody has written the state file since: where there are no locks, somebody may have."""
        now = _about(self._path)
        if now is None:  # somebody has deleted it
            self._left = None
        elif self._left is None or any(now[name] != self._left[name] for name in ("token", "sequence", "writer")):
            raise ValueError(
                f"checkpoint: another process has written {self._path} while this run went on, which stops here: give "
                "each run a name of its own"
            )

    def _create(self) -> None:
        with open(self._output, "xb") as file:
            if self._left is not None:  # of a former run, which others may not be allowed to read
                take_mode(file.fileno(), os.stat(self._path))
            file.write(_head_of(self._token))
            self._length = file.tell()

    def _remove_remains(self) -> None:
        """The output of runs whose state file is gone, and what killed processes have left half written."""
        mine = {self._token} if self._left is None else {self._token, self._left["token"]}
        name = re.escape(self._path.name)
        output = re.compile(rf"{name}{re.escape(_OUTPUT)}([0-9a-f]{{{2 * _TOKEN}}})")
        temporary = re.compile(rf"\.{name}\.[0-9a-f]+{re.escape(TEMPORARY)}")
        for one in self._path.parent.iterdir():
            found = output.fullmatch(one.name)
            if temporary.fullmatch(one.name) or (found and found[1] not in mine and _carries(one, found[1])):
                one.unlink(missing_ok=True)

    def _append(self, arrays: dict[str, Any], about: dict[str, Any]) -> None:
        contents = io.BytesIO()
        np.savez(contents, about=np.array(json.dumps({"token": self._token, **about})), **arrays)
        data = contents.getbuffer()
        with open(self._output, "r+b") as file:
            file.truncate(self._length)  # what a process has left that was killed
            file.seek(self._length)
            file.write(_HEAD.pack(len(data), zlib.crc32(data)))
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._length += _HEAD.size + len(data)


def _writer() -> str:
    """This process, told from others of its number."""
    return f"{os.getpid()} on {platform.node()} {_SESSION}"


_SESSION = secrets.token_hex(_TOKEN)


def _head_of(token: str) -> bytes:
    return _MAGIC + token.encode() + b"\n"


def _carries(path: Path, token: str) -> bool:
    """Whether a file of that name is ours: it begins with the token, as far as a killed process came."""
    if path.is_symlink() or not path.is_file():
        return False
    whole = _head_of(token)
    with open(path, "rb") as file:
        return whole.startswith(file.read(len(whole)))


def _about(path: Path) -> dict[str, Any] | None:
    """What the state file says, or None without one. A ValueError, if something else is there."""
    try:
        about = about_of(path, read_arrays(path, only="about"), {CHECKPOINT: CHECKPOINT_VERSION})
    except FileNotFoundError:
        return None
    _require_known(path, about)
    return about


#: What the state file says of the files, and of which type.
_TYPES = {"token": str, "length": int, "sequence": int, "writer": str, "running": bool, "t_end": float}


def _require_known(path: PathLike, about: dict[str, Any]) -> None:
    if about["version"] < CHECKPOINT_VERSION:
        raise unreadable(
            path,
            f"is a checkpoint of invariode {about.get('invariode')}, in version {about['version']} of the format: go "
            "on with the invariode that wrote it, or delete it",
        )
    wrong = [name for name, kind in _TYPES.items() if type(about.get(name)) is not kind]
    if wrong or about["length"] < 0 or not re.fullmatch(rf"[0-9a-f]{{{2 * _TOKEN}}}", about["token"]):
        raise unreadable(path, f"is damaged: what it says of {', '.join(wrong) or 'its output'} is wrong")


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
    """The run of a checkpoint, of which the state file has been read. A running process may replace it meanwhile."""
    for _ in range(_READINGS):
        _require_known(path, about)
        try:
            return _read(path, arrays, about)
        except ValueError:
            arrays, before = read_arrays(path), about
            about = about_of(path, arrays, {CHECKPOINT: CHECKPOINT_VERSION})
            if all(about.get(name) == before[name] for name in ("token", "sequence", "writer")):
                raise
    raise unreadable(path, "is replaced again and again while it is read: try again")


def _read(path: PathLike, arrays: dict[str, Any], about: dict[str, Any]) -> Stored:
    checkpoint = Checkpoint(path, about["token"], about["length"], about["sequence"])
    place = checkpoint._output
    try:
        file = open(place, "rb")  # noqa: SIM115 - the with statement is below: only this line may miss the file
    except FileNotFoundError:
        raise unreadable(path, f"is half of a checkpoint: {place} with the output of the run is missing") from None
    with file:
        if os.fstat(file.fileno()).st_size < about["length"]:
            raise unreadable(place, "is shorter than its checkpoint says")
        if file.read(len(_head_of(about["token"]))) != _head_of(about["token"]):
            raise unreadable(place, "belongs to another run than its checkpoint")
        parts = list(_parts(place, file.read(about["length"] - file.tell())))
    try:
        heads = [json.loads(str(part.pop("about"))) for part in parts]
        if any(head["token"] != about["token"] for head in heads):
            raise ValueError("it has parts of another run")
        whole = {**arrays, **_output(parts, heads[0], arrays, about)}
        return Stored(about, whole, _identity(parts[0], heads[0]), checkpoint)
    except Exception as wrong:  # whatever it is: the file is the only input
        raise unreadable(place, f"is damaged: {type(wrong).__name__}: {wrong}") from None


def _output(
    parts: list[dict[str, Any]], head: dict[str, Any], arrays: dict[str, Any], about: dict[str, Any]
) -> dict[str, Array]:
    """The output of the run, of which the first part is what it started with."""
    output = _joined(parts[1:])
    options = head["identity"]["options"]
    if "end" in (options.get("keep"), options.get("save")):
        output |= {"t": np.array([about["t_end"]]), "y": arrays["y_end"][:, None]}
    for e in head["at_start"]:
        output[f"t_events.{e}"] = np.concatenate([[head["identity"]["problem"]["t0"]], output[f"t_events.{e}"]])
        output[f"y_events.{e}"] = np.concatenate([parts[0]["start"][None, :], output[f"y_events.{e}"]])
    return output


def _identity(first: dict[str, Any], head: dict[str, Any]) -> Identity:
    arrays = {name.removeprefix("identity."): one for name, one in first.items() if name.startswith("identity.")}
    return Identity(head["identity"], arrays)


def _parts(place: Path, contents: bytes) -> Iterator[dict[str, Any]]:
    at = 0
    while at < len(contents):
        if len(contents) - at < _HEAD.size:
            raise unreadable(place, "is damaged")
        size, checksum = _HEAD.unpack_from(contents, at)
        data = contents[at + _HEAD.size : at + _HEAD.size + size]
        if len(data) != size or zlib.crc32(data) != checksum:
            raise unreadable(place, "is damaged")
        yield arrays_in(io.BytesIO(data), size, place)
        at += _HEAD.size + size


def _joined(parts: list[dict[str, Any]]) -> dict[str, Array]:
    """The output of all parts."""
    rows = np.cumsum([0, *(len(part["t"]) for part in parts)])
    whole = {"y": np.concatenate([part["y"] for part in parts], axis=1)}
    for name in parts[0]:
        if name == "y" or name.startswith("dense."):
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
