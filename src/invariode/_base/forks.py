"""Locks that `os.fork` waits for. A child inherits the locks of all threads, and has only the one that forked: of
those that another thread held then nobody would ever release one."""

from __future__ import annotations

import functools
import os
import sys
import threading
from typing import TYPE_CHECKING, Any

#: Held while a function is traced and compiled, by LLVM or by numba, which have locks of their own.
compiling = threading.RLock()

_short: list[Any] = []


def short_lock() -> Any:
    """Return a lock for a few operations of Python, none of which takes another lock or calls a user's function."""
    lock = threading.Lock()
    _short.append(lock)
    return lock


if TYPE_CHECKING:
    from functools import cached_property as cached_property
else:

    class cached_property(functools.cached_property):  # noqa: N801 - named like that of functools
        """A property that is computed once, without the lock of CPython 3.11, which a child would inherit. Threads may
        compute it at the same time."""

        def __get__(self, instance: Any, owner: type | None = None) -> Any:
            if instance is None:
                return self
            value = instance.__dict__[self.attrname] = self.func(instance)
            return value


_taken: list[Any] = []


def _before() -> None:
    numba = sys.modules.get("numba.core.compiler_lock")
    locks = [compiling, *([] if numba is None else [numba.global_compiler_lock]), *_short]
    for lock in locks:
        lock.acquire()
    _taken.extend(locks)  # while all are held: no other thread forks


def _after() -> None:
    locks = _taken.copy()
    _taken.clear()
    for lock in reversed(locks):
        lock.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before, after_in_parent=_after, after_in_child=_after)
