"""Locks on files: one holder at a time, thread or process. The system releases that of a killed process."""

from __future__ import annotations

import errno
import json
import os
import platform
import stat
import sys
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from time import sleep
from weakref import WeakSet

from .arguments import warn

#: What a system says of a lock that somebody holds.
_HELD = frozenset({errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK})
#: And on a file system that has no locks.
_NO_LOCKS = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL})
#: Where Windows locks a byte: after the text, which others are to read.
_BEHIND = 1 << 30
#: Bytes of that text, at most.
_TEXT = 4096
#: How often it is looked for, and seconds between.
_LOOKS, _PAUSE = 20, 0.05
#: What each lock says of itself.
_LOCK = "invariode lock"


class Lock:
    """A locked file beside a path, which goes away when the lock is released. `what` is what the lock is for.

    Raises ValueError: Somebody else holds it, or the file there is not a lock.
    Raises OSError: There can be no such file.
    """

    _holds = False

    def __init__(self, path: Path, what: str) -> None:
        self._place = path.with_name(f".{path.name}.invariode-lock")
        while not self._holds:
            self._file = _opened(self._place, what)
            try:
                works = _locked(self._file)
                _introduce(self._file, self._place, what)
                self._holds = _is_at(self._file, self._place)  # or its last holder has removed it meanwhile
            except BlockingIOError:
                raise ValueError(
                    f"{what}: {path} is in use by {_holder(self._file)}: wait until that run has ended, or give "
                    "another name"
                ) from None
            finally:
                if not self._holds:
                    os.close(self._file)
        _all.add(self)
        if not works:
            warn(f"{what}: the file system of {path} has no locks: make sure that no other process uses the same name")

    @property
    def is_held(self) -> bool:
        """True until the lock is released, but not in a process that was forked meanwhile."""
        return self._holds

    def release(self) -> None:
        """Release the lock, so that others can take it. Calling this again has no effect."""
        if not self._holds:
            return
        self._holds = False
        if sys.platform == "win32":  # an open file stays
            os.close(self._file)
        with suppress(OSError):
            self._place.unlink()
        if sys.platform != "win32":
            os.close(self._file)

    def __del__(self) -> None:
        self.release()


_all: WeakSet[Lock] = WeakSet()


def _close_in_child() -> None:
    """A child must not hold a lock longer than the process that took it."""
    for lock in _all:
        if lock._holds:
            lock._holds = False
            os.close(lock._file)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_child)


def _not_a_lock(place: Path, what: str) -> ValueError:
    return ValueError(f"{what}: the file {place} is there, and is not a lock of ours: move it away")


def _opened(place: Path, what: str) -> int:
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        file = os.open(place, flags | getattr(os, "O_BINARY", 0), 0o666)
    except OSError as wrong:
        if wrong.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _not_a_lock(place, what) from None
        raise
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise _not_a_lock(place, what)
    return file


def _introduce(file: int, place: Path, what: str) -> None:
    """Write into the lock file which process holds the lock, for others that want it."""
    before = os.read(file, _TEXT)
    if before and not before.startswith(json.dumps({"format": _LOCK})[:-1].encode()):
        raise _not_a_lock(place, what)
    since = datetime.now().astimezone().isoformat(timespec="seconds")
    about = {"format": _LOCK, "pid": os.getpid(), "host": platform.node(), "since": since}
    os.ftruncate(file, 0)
    os.lseek(file, 0, os.SEEK_SET)
    os.write(file, json.dumps(about).encode())


def _locked(file: int) -> bool:
    """Takes the lock. Returns False where there are no locks; raises BlockingIOError if another process holds it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(file, _BEHIND, os.SEEK_SET)
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
            os.lseek(file, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as wrong:
        if wrong.errno in _HELD:
            raise BlockingIOError from None
        if wrong.errno in _NO_LOCKS:
            return False
        raise
    return True


def _is_at(file: int, path: Path) -> bool:
    """Return whether `path` still names the open file."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _holder(file: int) -> str:
    """Return a description of the process that holds the lock. Its text is written just after the lock is taken."""
    for _ in range(_LOOKS):
        with suppress(OSError, ValueError, KeyError, TypeError):
            os.lseek(file, 0, os.SEEK_SET)
            about = json.loads(os.read(file, _TEXT))
            here = " (this process)" if (about["pid"], about["host"]) == (os.getpid(), platform.node()) else ""
            return f"process {about['pid']}{here} on {about['host']}, since {about['since']}"
        sleep(_PAUSE)
    return "another process"
