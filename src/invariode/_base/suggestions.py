"""What a user probably meant by a name that nothing has: "did you mean …?"."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(given: object, known: Iterable[str]) -> str | None:
    """The known name most like the given one; None if none is like it."""
    near = difflib.get_close_matches(given, list(known), n=1) if isinstance(given, str) else []
    return near[0] if near else None


def meant(given: object, known: Iterable[str]) -> str:
    """The end of a message: the known name that was probably meant; empty if none is like the given one."""
    near = nearest(given, known)
    return "" if near is None else f"; did you mean {near!r}?"
