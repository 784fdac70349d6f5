"""A small cache: the values for the latest keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from .forks import short_lock

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")

_keeping = short_lock()


class Latest(dict[_Key, _Value]):
    """A dict in which a new entry displaces the oldest, if there are more than `most`. Threads may share it."""

    #: Default: more than the kinds of calls in a script.
    most = 64

    def __init__(self, most: int = most) -> None:
        super().__init__()
        self.most = most

    def __setitem__(self, key: _Key, value: _Value) -> None:
        with _keeping:
            while len(self) >= self.most and key not in self:
                del self[next(iter(self))]
            super().__setitem__(key, value)

    def find(self, key: _Key, make: Callable[[], _Value]) -> _Value:
        """Return the value of a key; `make`, which may call functions of the user, makes a missing one."""
        try:
            return self[key]
        except KeyError:
            found = self[key] = make()
            return found
