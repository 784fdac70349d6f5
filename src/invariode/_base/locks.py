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
#: Where Windows locks a byte: behind the text, which others are to read.
_BEHIND = 1 << 30
#: Bytes of that text, at most.
_TEXT = 4096
#: How often it is looked for, and seconds between.
_LOOKS, _PAUSE = 20, 0.05
#: What each lock says of itself.
_LOCK = "invariode lock"


class LockedError(Exception):
    """Somebody holds the lock; the text says who."""


class NotALock(Exception):  # noqa: N818 - the file is in order, but not ours
    """The file is there and is not one of ours."""


class Lock:
    """A locked file, which goes away when the lock is released.

    Attributes
    ----------
    file : int
        Its descriptor.
    works : bool
        Whether the file system has locks. Without, nobody is kept out.

    Raises
    ------
    LockedError
        Somebody else holds it.
    NotALock
        The file there is not a lock.
    OSError
        There can be no such file.
    """

    _holds = False

    def __init__(self, path: Path) -> None:
        self.path = path
        while True:
            self.file = _opened(path)
            try:
                self.works = _locked(self.file)
                self._introduce()
                if _is_at(self.file, path):
                    self._holds = True
                    _all.add(self)
                    return
            except BlockingIOError:
                holder = _holder(self.file)
                os.close(self.file)
                raise LockedError(holder) from None
            except BaseException:
                os.close(self.file)
                raise
            os.close(self.file)  # its last holder has removed it meanwhile

    def _introduce(self) -> None:
        """Who holds it, for those who come."""
        before = os.read(self.file, _TEXT)
        if before and not before.startswith(json.dumps({"format": _LOCK})[:-1].encode()):
            raise NotALock
        since = datetime.now().astimezone().isoformat(timespec="seconds")
        about = {"format": _LOCK, "pid": os.getpid(), "host": platform.node(), "since": since}
        os.ftruncate(self.file, 0)
        os.lseek(self.file, 0, os.SEEK_SET)
        os.write(self.file, json.dumps(about).encode())

    def release(self) -> None:
        """Lets others take it. A second time it does nothing."""
        if not self._holds:
            return
        self._holds = False
        if sys.platform == "win32":  # an open file stays
            os.close(self.file)
        with suppress(OSError):
            self.path.unlink()
        if sys.platform != "win32":
            os.close(self.file)

    def __del__(self) -> None:
        self.release()


_all: WeakSet[Lock] = WeakSet()


def _close_in_child() -> None:
    """A child must not hold a lock longer than the process that took it."""
    for lock in _all:
        if lock._holds:
            lock._holds = False
            os.close(lock.file)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_child)


def _opened(path: Path) -> int:
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        file = os.open(path, flags | getattr(os, "O_BINARY", 0), 0o666)
    except OSError as wrong:
        if wrong.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise NotALock from None
        raise
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise NotALock
    return file


def _locked(file: int) -> bool:
    """Takes the lock. False: there are none here. BlockingIOError: somebody has it."""
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
    """Whether the file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _holder(file: int) -> str:
    """Who has the lock. Its text is written just after it is taken."""
    for _ in range(_LOOKS):
        with suppress(OSError, ValueError, KeyError, TypeError):
            os.lseek(file, 0, os.SEEK_SET)
            about = json.loads(os.read(file, _TEXT))
            here = " (this process)" if (about["pid"], about["host"]) == (os.getpid(), platform.node()) else ""
            return f"process {about['pid']}{here} on {about['host']}, since {about['since']}"
        sleep(_PAUSE)
    return "another process"


def held(path: Path, what: str) -> Lock:
    """The lock on a path, in a file beside it. A ValueError, if another run has it."""
    place = path.with_name(f".{path.name}.invariode-lock")
    try:
        lock = Lock(place)
    except LockedError as holder:
        raise ValueError(
            f"{what}: {path} is in use by {holder}: wait until that run has ended, or give another name"
        ) from None
    except NotALock:
        raise ValueError(f"{what}: the file {place} is there, and is not a lock of ours: move it away") from None
    if not lock.works:
        warn(f"{what}: the file system of {path} has no locks: make sure that no other process uses the same name")
    return lock
