"""Machine code of graphs that is kept between processes, as object files in a folder of the user's.

A file is named by the digest of all that its code follows from: the graph with its form, the sources of the code that
writes it, the versions of this package and of LLVM, the processor. It holds the digest of its own bytes. Code is only
read where nobody but the user can have written it: the folder and the file belong to them, and others may not write
there. The digests tell damage, not malice.
"""

from __future__ import annotations

import functools
import hashlib
import os
import secrets
import stat
import sys
from contextlib import suppress
from pathlib import Path

from ..._base.arguments import shown
from ..._base.package import version

#: The environment variable that names the folder, or switches the cache off.
ENVIRONMENT = "INVARIODE_CACHE"
_OFF = ("0", "off", "no", "false")
_MAGIC = b"invariode code 1\n"
#: Files, and their bytes, beyond which the ones that have not been used for longest are removed.
_MOST_FILES, _MOST_BYTES = 1000, 200_000_000
_DIGEST = hashlib.sha256().digest_size


class _Folder:
    """The folder chosen in this process; None: nothing is kept."""

    folder: Path | None
    is_made = False


def code_cache(where: bool | str | os.PathLike[str] | None = None) -> Path | None:
    """The folder in which machine code is kept between processes, so that a later one need not compile it again.

    Code for traced functions, their derivatives and Taylor series is kept; what numba compiles is numba's to keep.
    Kept code is used only if the folder and the file belong to the user and nobody else may write there.

    Parameters
    ----------
    where : bool or path, optional
        For this process: a folder, True for the default one, False to keep and to use nothing. Default: no change.

    Returns
    -------
    Path or None
        The folder in use; None: nothing is kept. The default is ``invariode`` in the user's folder for caches
        (``$XDG_CACHE_HOME`` or ``~/.cache``; on macOS ``~/Library/Caches``), or the folder that the environment
        variable ``INVARIODE_CACHE`` names; ``INVARIODE_CACHE=off`` switches it off. On Windows nothing is kept.

    Raises
    ------
    TypeError
        `where` is no path.

    Examples
    --------
    >>> import invariode as iv
    >>> before = iv.code_cache()
    >>> print(iv.code_cache(False))
    None
    >>> iv.code_cache(before is not None) == before
    True
    """
    if where is not None:
        if isinstance(where, bool):
            _Folder.folder = (_by_environment() or _default()) if where else None
        elif isinstance(where, (str, os.PathLike)):
            _Folder.folder = Path(where).expanduser().absolute() if os.name == "posix" else None
        else:
            raise TypeError(f"code_cache takes a folder, True or False, got {shown(where)}")
        _Folder.is_made = True
    elif not _Folder.is_made:
        _Folder.folder = _by_environment()
        _Folder.is_made = True
    return _Folder.folder


def _by_environment() -> Path | None:
    given = os.environ.get(ENVIRONMENT, "")
    if given.lower() in _OFF or os.name != "posix":
        return None
    return Path(given).expanduser().absolute() if given else _default()


def _default() -> Path | None:
    if os.name != "posix":
        return None
    home = Path.home()
    caches = home / "Library" / "Caches" if sys.platform == "darwin" else home / ".cache"
    given = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(given) if os.path.isabs(given) else caches) / "invariode"


def name_of(digest: bytes, processor: str) -> str:
    """The name of the file with the code of a graph, of this digest, for a processor."""
    found = hashlib.sha256(digest)
    for part in (_sources() or version().encode(), processor.encode()):
        found.update(len(part).to_bytes(8, "little") + part)
    return found.hexdigest()


@functools.cache
def _sources() -> bytes:
    """A digest of the code that writes machine code; nothing where only its bytecode is there."""
    found = hashlib.sha256()
    folder = Path(__file__).parent
    sources = sorted([*folder.glob("*.py"), *folder.parent.glob("*.py")])
    for path in sources:
        found.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return found.digest() if sources else b""


def read(name: str) -> bytes | None:
    """Return the code that is kept under a name; None: nothing is kept there, it is damaged, or others may have written
    it."""
    folder = _opened(create=False)
    if folder is None:
        return None
    try:
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
        with os.fdopen(file, "rb") as stream:
            about = os.fstat(file)
            whole = stream.read() if stat.S_ISREG(about.st_mode) and _is_own(about) else b""
        with suppress(OSError):
            os.utime(name, dir_fd=folder)  # the time of its last use
    except OSError:
        return None
    finally:
        os.close(folder)
    start = len(_MAGIC) + _DIGEST
    code = whole[start:]
    return code if whole[:start] == _MAGIC + _digest(name, code) else None


def keep(name: str, code: bytes) -> None:
    """Keep code under a name, if that is possible: a full disk or a folder that is not the user's is no error."""
    folder = _opened(create=True)
    if folder is None:
        return
    new = f"{secrets.token_hex(8)}.new"
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with os.fdopen(os.open(new, flags, 0o600, dir_fd=folder), "wb") as stream:
            stream.write(_MAGIC + _digest(name, code) + code)
        os.replace(new, name, src_dir_fd=folder, dst_dir_fd=folder)  # readers see all of it or nothing
        _remove_oldest(folder)
    except OSError:
        with suppress(OSError):
            os.unlink(new, dir_fd=folder)
    finally:
        os.close(folder)


def _digest(name: str, code: bytes) -> bytes:
    return hashlib.sha256(name.encode() + code).digest()


def _opened(*, create: bool) -> int | None:
    """Open the folder; None: it is not there, or is not the user's alone."""
    path = code_cache()
    if path is None:
        return None
    try:
        if create:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    if not _is_own(os.fstat(folder)):
        os.close(folder)
        return None
    return folder


def _is_own(about: os.stat_result) -> bool:
    """Return whether a file or folder belongs to the user, and no one else may write to it."""
    return about.st_uid == os.geteuid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _remove_oldest(folder: int) -> None:
    with os.scandir(folder) as entries:
        files = sorted((one.stat(follow_symlinks=False).st_mtime, one.stat().st_size, one.name) for one in entries)
    many, size = len(files), sum(one for _, one, _ in files)
    for _, of_one, name in files:
        if many <= _MOST_FILES and size <= _MOST_BYTES:
            break
        os.unlink(name, dir_fd=folder)
        many, size = many - 1, size - of_one
