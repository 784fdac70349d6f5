"""Archives of arrays as files: every byte is checked before it is believed, and nothing in them is ever executed."""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from importlib.metadata import version
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from .arguments import Array, shown

if TYPE_CHECKING:  # needs a tenth of the time of our own import
    from zipfile import ZipFile, ZipInfo

__all__ = ["ENSEMBLE", "ENSEMBLE_VERSION", "PathLike", "about_of", "arrays_in", "path_of", "read_arrays", "unreadable"]

PathLike = str | os.PathLike[str]

NOT_OURS = "was not written by Solution.save, nor as a checkpoint"

#: What the file of an ensemble says of itself, and the version of its contents: raised whenever they change.
ENSEMBLE, ENSEMBLE_VERSION = "invariode ensemble", 1


def path_of(given: Any) -> str:
    """The name of a file. A number would be the file that happens to be open under it."""
    if not isinstance(given, (str, os.PathLike)):
        raise TypeError(f"path must be a str or path-like, got {shown(given)}")
    path = os.fspath(given)
    if not isinstance(path, str):
        raise TypeError(f"path must be a str or path-like, got {shown(given)}: decode it, os.fsdecode(path)")
    return path


def read_arrays(path: PathLike, only: str | None = None) -> dict[str, Any]:
    """All arrays of a file, or one."""
    mode = os.stat(path_of(path)).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # reading from a pipe would wait; of a folder `open` says it
        raise unreadable(path, "is not a regular file: save to one first")
    with open(path, "rb") as file:
        return arrays_in(file, os.fstat(file.fileno()).st_size, path, only)


def arrays_in(file: IO[bytes], size: int, path: PathLike, only: str | None = None) -> dict[str, Any]:
    """All arrays of an archive of that size, which is in the file `path`; or the one of a name, if it is there."""
    import zipfile

    if not zipfile.is_zipfile(file):
        file.seek(0)
        raise unreadable(path, "is incomplete" if file.read(2) == b"PK" else NOT_OURS)
    file.seek(0)
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > size:
                raise ValueError("it says that its arrays are larger than the file")
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
    kinds = "U" if member.filename.endswith("about.npy") else "fciub"
    if dtype.kind not in kinds or size != len(contents) or min(shape, default=0) < 0:
        raise ValueError(f"{member.filename} is of {len(contents)} bytes, and says {shape} of {dtype}")
    if dtype.kind == "b":  # a byte may be any
        contents, dtype = (np.frombuffer(contents, np.uint8) != 0).tobytes(), np.dtype(bool)
    array = np.frombuffer(contents, dtype).reshape(shape, order="F" if by_columns else "C")
    return array.astype(dtype.newbyteorder("="))  # a copy, which may be written to


def about_of(
    path: PathLike, arrays: dict[str, Any], known: dict[str, int], otherwise: str = NOT_OURS
) -> dict[str, Any]:
    """What an archive says of itself. `known`: the formats that are expected, and the newest version of each;
    `otherwise`: what is said of a file of another one."""
    try:
        about = json.loads(str(arrays.get("about", "")))
    except (ValueError, RecursionError):
        about = None
    if isinstance(about, dict) and about.get("format") == ENSEMBLE:
        about.setdefault("version", 0)  # of 0.2, whose files do not say it
    if not isinstance(about, dict) or about.get("format") not in known or not isinstance(about.get("version"), int):
        raise unreadable(path, otherwise)
    newest = known[about["format"]]
    if about["version"] > newest:
        raise unreadable(
            path,
            f"has version {about['version']} of the format, written by invariode {about.get('invariode')}; this is "
            f"invariode {version('invariode')}, which reads versions up to {newest}: upgrade it",
        )
    return about


def unreadable(path: PathLike, what: str) -> ValueError:
    return ValueError(f"the file {os.fspath(path)} {what}")
