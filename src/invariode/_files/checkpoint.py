"""Runs on disk: the memory of a run in one file, replaced whole, and its output in another, which only grows."""

from __future__ import annotations

import math
import os
import platform
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._base.files import TEMPORARY, PathLike, damage_of, take_mode, unreadable
from .._base.formats import Field, Kind, packed, read, read_values, unpacked, write
from .._base.locks import Lock
from .._results.result import Result
from .._results.saving import END, OUTPUT, RUN, SOLUTION

#: Between the name of a checkpoint and the token of its run, in the name of the file of the output,
_OUTPUT = ".output-"
#: and before that token at the start of the file.
_MAGIC = b"invariode output "
#: Bytes of a token, which is written in hexadecimal.
_TOKEN = 8
#: In front of each part of the output: its size and the checksum of its bytes.
_HEAD = struct.Struct("<QI")
#: Statuses of runs that have ended: another run may take their file.
_ENDED = (0, 1)
#: Readings of a checkpoint that a running process replaces meanwhile.
_READINGS = 10


_OF_THE_FILES = {
    "token": Field(str),  # of the run, in both files
    "length": Field(int, within=(0, math.inf)),  # of the output that counts
    "sequence": Field(int),  # number of this state file
    "writer": Field(str),  # the process
}
CHECKPOINT = Kind("checkpoint", END | _OF_THE_FILES)
_PART = Kind("output", OUTPUT | {"token": Field(str)})
_FIRST_PART = Kind("output", RUN | _PART.fields)
_WHOLE = Kind("checkpoint", RUN | END | OUTPUT | {name: SOLUTION.fields[name] for name in ("imposed", "added")})


class Stored(NamedTuple):
    """Stored run, as read from its files."""

    fields: dict[str, Any]  # as those of a solution, without its continuous output,
    parts: list[dict[str, Any]]  # which is in the parts
    checkpoint: RunFiles


class RunFiles:
    """The files of a run, to be written.

    The output is appended and on the disk before the file that tells how much of it counts takes the place of the one
    before. So the two agree at every moment, and what a killed process has appended since does not count. Only files
    that carry a token of ours are ever changed, and only while the lock is held; before each writing the state file is
    seen to be the one that this run has left.
    """

    def __init__(self, path: PathLike, token: str, length: int = 0, sequence: int = 0) -> None:
        self._path = Path(os.path.realpath(path))
        self._token = token  # of the run, in both files
        self._length = length  # of the output that counts
        self._sequence = sequence  # number of the state file that was written last
        self._begin: Callable[[Any], Result] | None = None  # for a new run: adds to its first part what was before
        self._left: dict[str, Any] | None = None  # what the state file said when this run last saw it; None: no file
        self._lock: Lock | None = None
        self.mechanics: dict[str, Any] | None = None  # what the parts of other processes have cost

    @property
    def _output(self) -> Path:
        return self._path.with_name(self._path.name + _OUTPUT + self._token)

    def go_on(self, mechanics: dict[str, Any] | None) -> None:
        """Take the lock again to extend the run; raise an error unless the files are still its own, and as it left
        them."""
        with self._taking() as left:
            if left is None or left["token"] != self._token:
                raise ValueError(
                    f"checkpoint: {self._path} now belongs to another run: load it, or choose another file name"
                )
            if left["sequence"] != self._sequence and left["writer"] != _writer():
                raise ValueError(
                    f"checkpoint: another process has continued {self._path}, to t = {left['t_end']!r}: load it again"
                )
        self.mechanics = mechanics

    @classmethod
    def of_new_run(cls, path: PathLike, begin: Callable[[Any], Result]) -> RunFiles:
        """Files for a run that begins, and the lock on them; `begin` adds to the first part of its output. A ValueError
        where there is a run that has not ended, or something else; a FileNotFoundError where there is no such
        folder, an IsADirectoryError where the path is one. A run has ended when it has come to the end of its interval
        or to a terminal event; one that was killed, stopped or ran into a limit has results that only its file has."""
        self = cls(path, os.urandom(_TOKEN).hex())
        if not self._path.parent.is_dir():
            raise FileNotFoundError(
                f"checkpoint: there is no folder {self._path.parent}: make it, or give another file"
            )
        if self._path.is_dir():
            raise IsADirectoryError(f"checkpoint: {self._path} is a folder: give the name of a file in it")
        with self._taking() as left:
            if left is not None and left["status"] not in _ENDED:
                raise ValueError(
                    f"checkpoint: {os.fspath(path)} holds a run that has come to t = {left['t_end']!r} and has not "
                    "ended: go on with load(path, problem).extend(tf), --resume in the command, or delete it"
                )
        self._begin = begin
        return self

    @contextmanager
    def _taking(self) -> Iterator[dict[str, Any] | None]:
        """Takes the lock, unless what the state file says is refused inside."""
        self._lock = Lock(self._path, "checkpoint")
        try:
            self._left = _about(self._path)
            yield self._left
            self._remove_remains()
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Others may go on with the files."""
        if self._lock is not None:
            self._lock.release()

    def keep(self, part: Result) -> None:
        """Add the output of a part of the run, and the state from which the run can continue after it."""
        if self._lock is None or not self._lock.is_held:
            raise ValueError(
                f"checkpoint: {self._path} is written by the process that began the run, and this one was forked from "
                "it within the run: end it with os._exit, or let it solve a problem of its own"
            )
        now = _about(self._path)
        if now is None:  # somebody has deleted it
            self._left = None
        elif self._left is None or any(now[name] != self._left[name] for name in ("token", "sequence", "writer")):
            raise ValueError(
                f"checkpoint: another process has written {self._path} while this run went on, which stops here: give "
                "each run a name of its own"
            )
        if self._begin is None:
            data = self._packed(_PART, part)
        else:
            data = self._packed(_FIRST_PART, self._begin(part))  # before there is a file: it may raise
            mode = 0o666 if self._left is None else 0o600  # the file of a former run may be private: from the beginning
            with open(self._output, "xb", opener=lambda path, flags: os.open(path, flags, mode)) as file:
                if self._left is not None:
                    take_mode(file.fileno(), os.stat(self._path))
                file.write(_head_of(self._token))
                self._length = file.tell()
            self._begin = None
        self._append(data)
        self._sequence += 1
        own = {"token": self._token, "sequence": self._sequence, "writer": _writer()}
        state = CHECKPOINT.taken(part, **own, length=self._length)
        write(self._path, CHECKPOINT, state, durable=True)
        replaced, self._left = self._left, own
        if replaced is None or replaced["token"] != self._token:
            self._remove_remains()

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

    def _packed(self, kind: Kind, part: Result) -> memoryview:
        return packed(kind, kind.taken(part, token=self._token))

    def _append(self, data: memoryview) -> None:
        with open(self._output, "r+b") as file:
            file.truncate(self._length)  # what a process has left that was killed
            file.seek(self._length)
            file.write(_HEAD.pack(len(data), zlib.crc32(data)))
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._length += _HEAD.size + len(data)


def _writer() -> str:
    """Return a name of this process that distinguishes it from others of its number."""
    return f"{os.getpid()} on {platform.node()} {_SESSION}"


_SESSION = os.urandom(_TOKEN).hex()


def _head_of(token: str) -> bytes:
    return _MAGIC + token.encode() + b"\n"


def _carries(path: Path, token: str) -> bool:
    """Return whether a file is the writer's own: it begins with the token, as far as a killed process got."""
    if path.is_symlink() or not path.is_file():
        return False
    whole = _head_of(token)
    with open(path, "rb") as file:
        return whole.startswith(file.read(len(whole)))


def _about(path: Path) -> dict[str, Any] | None:
    """Return the contents of the state file, or None without one; raise a ValueError if it is a different file."""
    try:
        return read_values(path, CHECKPOINT)
    except FileNotFoundError:
        return None


# ----------------------------------------------------------------------------------------------------------------------
# Read again


def read_checkpoint(path: PathLike, state: dict[str, Any]) -> Stored:
    """The run of a checkpoint, of which the state file has been read. A running process may replace it meanwhile."""
    for _ in range(_READINGS):
        try:
            return _read(path, state)
        except ValueError:
            before, (_, state) = state, read(path, CHECKPOINT)
            if all(state[name] == before[name] for name in ("token", "sequence", "writer")):
                raise
    raise unreadable(path, "is replaced again and again while it is read: try again")


def _read(path: PathLike, state: dict[str, Any]) -> Stored:
    token, length = state["token"], state["length"]
    if not re.fullmatch(rf"[0-9a-f]{{{2 * _TOKEN}}}", token):
        raise unreadable(path, "is damaged: it has no token of a run")
    checkpoint = RunFiles(path, token, length, state["sequence"])
    place, start = checkpoint._output, _head_of(token)
    try:
        file = open(place, "rb")  # noqa: SIM115 - the with statement is below: only this line may miss the file
    except FileNotFoundError:
        raise unreadable(path, f"is half of a checkpoint: {place} with the output of the run is missing") from None
    with file:
        if os.fstat(file.fileno()).st_size < length:
            raise unreadable(place, "is shorter than its checkpoint says")
        if file.read(len(start)) != start:
            raise unreadable(place, "belongs to another run than its checkpoint")
        parts = list(_parts(place, file.read(max(0, length - file.tell()))))
    with damage_of(place):
        if any(part.pop("token") != token for part in parts):
            raise ValueError("it has parts of another run")
        if len(parts) != state["sequence"]:
            raise ValueError(f"it has {len(parts)} parts, and its checkpoint says {state['sequence']}")
        whole = _joined(state, parts)
        _WHOLE.require(whole)
    return Stored(whole, parts, checkpoint)


def _parts(place: Path, contents: bytes) -> Iterator[dict[str, Any]]:
    at = 0
    while at < len(contents):
        if len(contents) - at < _HEAD.size:
            raise unreadable(place, "is damaged")
        size, checksum = _HEAD.unpack_from(contents, at)
        data = contents[at + _HEAD.size : at + _HEAD.size + size]
        if len(data) != size or zlib.crc32(data) != checksum:
            raise unreadable(place, "is damaged")
        yield unpacked(data, place, _PART if at else _FIRST_PART)
        at += _HEAD.size + size


def _joined(state: dict[str, Any], parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the fields of the whole run as one solution has them, except its continuous output."""
    whole = {name: one for name, one in parts[0].items() if not name.startswith("dense.")}
    for name in whole.keys() & OUTPUT.keys() - {"dense", "events"}:
        along = OUTPUT[name].dimensions
        axis = along.index("t") if "t" in along else 0
        whole[name] = np.concatenate([part[name] for part in parts], axis=axis)
    rows = np.cumsum([0, *(len(part["t"]) for part in parts)])
    whole["jumps.row"] += np.repeat(rows[:-1], [len(part["jumps.row"]) for part in parts])
    if "t_eval" in whole["identity"]["arrays"]:
        _drop_repeated(whole)
    if whole["identity"]["options"].get("keep") == "end":
        whole |= {"t": np.array([state["t_end"]]), "y": state["y_end"][:, None]}
        if "S" in whole:
            whole["S"] = state["S_end"][:, :, None]
    return {**whole, **{name: state[name] for name in END if name in state}, "imposed": False, "added": {}}


def _drop_repeated(whole: dict[str, Any]) -> None:
    """Drop repeated outputs at one requested time except the last, which a resumed run has written after a jump
    there."""
    repeated = np.flatnonzero(np.diff(whole["t"]) == 0)
    for name in {"t", "y", "S"} & whole.keys():
        whole[name] = np.delete(whole[name], repeated, axis=OUTPUT[name].dimensions.index("t"))
    whole["jumps.row"] -= np.searchsorted(repeated, whole["jumps.row"])
