"""Archives of arrays as files: written all at once, every byte checked when read, and nothing in them ever executed."""

from __future__ import annotations

import errno
import io
import math
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from . import arguments
from .arguments import Array

if TYPE_CHECKING:  # needs a tenth of the time of our own import
    from zipfile import ZipFile, ZipInfo

PathLike = str | os.PathLike[str]

#: The only member of an archive that is text.
ABOUT = "about"

#: How the names of files end that are being written.
TEMPORARY = ".invariode-part"


def named(path: Any) -> str:
    """A path, or a store of another library, in messages."""
    return os.fspath(path) if isinstance(path, (str, os.PathLike)) else str(path)


def unreadable(path: Any, what: str) -> ValueError:
    return ValueError(f"the file {named(path)} {what}")


@contextmanager
def damage_of(path: PathLike) -> Iterator[None]:
    """Reports any exception inside as damage of the file, which must be the only input."""
    try:
        yield
    except Exception as wrong:
        what = f"it has no {wrong}" if isinstance(wrong, KeyError) else f"{type(wrong).__name__}: {wrong}"
        raise unreadable(path, f"is damaged: {what}") from None


# ----------------------------------------------------------------------------------------------------------------------
# Written


def write_arrays(path: PathLike, arrays: Mapping[str, Any], durable: bool = False) -> None:
    """Writes an archive of arrays, which takes the place of an existing file when it is complete; `durable`: when it
    is on the disk."""
    path = arguments.path("path", path)
    with _named(path):
        _write(path, arrays, durable)


@contextmanager
def _named(path: str) -> Iterator[None]:
    """Adds the file's name to an error that lacks it: writing to an open file says that the disk is full, not which."""
    try:
        yield
    except OSError as wrong:
        if wrong.errno is not None and wrong.filename is None:
            wrong.filename = path
        raise


def _write(path: str, arrays: Mapping[str, Any], durable: bool) -> None:
    try:
        there = os.stat(path)
    except FileNotFoundError:
        there = None
    if there is None or stat.S_ISREG(there.st_mode):
        _replace(Path(os.path.realpath(path)), there, arrays, durable)
    else:  # a pipe, a device, where an archive cannot go back; of a directory this says what it is
        with open(path, "wb") as file:
            whole = io.BytesIO()
            np.savez(whole, **arrays)
            file.write(whole.getbuffer())


def _replace(target: Path, there: os.stat_result | None, arrays: Mapping[str, Any], durable: bool) -> None:
    """Writes the file beside the target, and puts it in its place once it is complete."""
    temporary = target.with_name(f".{target.name}.{os.urandom(4).hex()}{TEMPORARY}")
    try:
        nameless = _nameless(target.parent)
        with nameless or open(temporary, "xb") as file:
            if there is not None:
                take_mode(file.fileno(), there)
            np.savez(file, **arrays)
            file.flush()
            if durable:
                os.fsync(file.fileno())
            if nameless:  # src_dir_fd: without it Python's os.link does not follow symbolic links
                os.link(f"/proc/self/fd/{file.fileno()}", temporary, src_dir_fd=file.fileno(), follow_symlinks=True)
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if durable and os.name == "posix":  # the names in the folder too
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _nameless(folder: Path) -> Any:
    """A file without a name, which is gone when the process is killed; None if the system has no such files."""
    if not hasattr(os, "O_TMPFILE") or not os.path.isdir("/proc/self/fd"):
        return None
    try:
        return os.fdopen(os.open(folder, os.O_TMPFILE | os.O_RDWR, 0o666), "w+b")
    except OSError:  # not on this file system
        return None


def take_mode(file: int, other: os.stat_result) -> None:
    """Gives a file the mode of another one, and its owner if we may."""
    if not hasattr(os, "fchmod"):
        return
    if other.st_uid != os.fstat(file).st_uid:
        with suppress(PermissionError):
            os.fchown(file, other.st_uid, other.st_gid)
    os.fchmod(file, stat.S_IMODE(other.st_mode))


# ----------------------------------------------------------------------------------------------------------------------
# Read


def read_arrays(path: PathLike, only: str | None = None) -> dict[str, Array]:
    """Read all arrays of a file, or only the array `only`; return {} if the file is not an archive."""
    mode = os.stat(arguments.path("path", path)).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # reading from a pipe would wait; of a folder `open` says it
        raise unreadable(path, "is not a regular file: save to one first")
    with open(path, "rb") as file:
        return arrays_in(file, os.fstat(file.fileno()).st_size, path, only)


def arrays_in(file: IO[bytes], size: int, path: PathLike, only: str | None = None) -> dict[str, Array]:
    """Read all arrays of an archive of `size` bytes, or only the array `only` if it exists; return {} if the file is
    not an archive. `path`: its name, for messages."""
    import zipfile

    if not zipfile.is_zipfile(file):
        file.seek(0)
        if file.read(2) == b"PK":
            raise unreadable(path, "is incomplete")
        return {}
    file.seek(0)
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > size:
                raise ValueError("its header declares arrays larger than the file")
            names = {member.filename.removesuffix(".npy"): member for member in members}
            return {name: _array(archive, member) for name, member in names.items() if only in (None, name)}
    except OSError as wrong:
        if wrong.errno not in (None, errno.EINVAL):  # a position before the start of the file; a decompressor's
            raise
        raise unreadable(path, "is damaged") from None
    except Exception as wrong:  # of the archive and of each kind of compression
        raise unreadable(path, f"is damaged: {wrong}") from None


def _array(archive: ZipFile, member: ZipInfo) -> Array:
    """An array, once its header is seen to agree with its size; the archive checks its bytes as they are read."""
    header = np.lib.format
    with archive.open(member) as stream:
        try:
            read = {(1, 0): header.read_array_header_1_0, (2, 0): header.read_array_header_2_0}
            shape, by_columns, dtype = read[header.read_magic(stream)](stream)
            size = math.prod(shape) * dtype.itemsize
        except Exception as wrong:  # a header is Python source: tokenizer, parser and NumPy each have their own error
            raise ValueError(f"{member.filename} is not an array: {type(wrong).__name__}: {wrong}") from None
        contents = stream.read()
    kinds = "U" if member.filename.endswith(f"{ABOUT}.npy") else "fciub"
    if dtype.kind not in kinds or size != len(contents) or min(shape, default=0) < 0:
        raise ValueError(f"{member.filename} is of {len(contents)} bytes, and says {shape} of {dtype}")
    if dtype.kind == "b":  # a byte may be any
        contents, dtype = (np.frombuffer(contents, np.uint8) != 0).tobytes(), np.dtype(bool)
    array = np.frombuffer(contents, dtype).reshape(shape, order="F" if by_columns else "C")
    return array.astype(dtype.newbyteorder("="))  # a copy, which may be written to
