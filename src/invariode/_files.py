"""Archives of arrays as files: every byte is checked before it is believed, and nothing in them is ever executed."""

from __future__ import annotations

import errno
import json
import math
import os
from importlib.metadata import version
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ._arguments import Array

if TYPE_CHECKING:  # needs a tenth of the time of our own import
    from zipfile import ZipFile, ZipInfo

__all__ = ["PathLike", "about_of", "arrays_in", "read_arrays", "unreadable"]

PathLike = str | os.PathLike[str]

NOT_OURS = "was not written by Solution.save, nor as a checkpoint"


def read_arrays(path: PathLike) -> dict[str, Any]:
    """All arrays of a file."""
    with open(path, "rb") as file:
        return arrays_in(file, os.fstat(file.fileno()).st_size, path)


def arrays_in(file: IO[bytes], size: int, path: PathLike) -> dict[str, Any]:
    """All arrays of an archive of that size, which is in the file `path`."""
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
            return {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}
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
    kinds = "U" if member.filename.endswith("about.npy") else "fciu"
    if dtype.kind not in kinds or size != len(contents) or min(shape, default=0) < 0:
        raise ValueError(f"{member.filename} is of {len(contents)} bytes, and says {shape} of {dtype}")
    array = np.frombuffer(contents, dtype).reshape(shape, order="F" if by_columns else "C")
    return array.astype(dtype.newbyteorder("="))  # a copy, which may be written to


def about_of(path: PathLike, arrays: dict[str, Any], known: dict[str, int]) -> dict[str, Any]:
    """What an archive says of itself. `known`: the formats that are expected, and the newest version of each."""
    try:
        about = json.loads(str(arrays.get("about", "")))
    except (ValueError, RecursionError):
        about = None
    if not isinstance(about, dict) or about.get("format") not in known or not isinstance(about.get("version"), int):
        raise unreadable(path, NOT_OURS)
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
