"""The package as users know it: its name and its version."""

from __future__ import annotations

from functools import cache
from typing import TypeVar

T = TypeVar("T")

NAME = __name__.partition(".")[0]


def public(one: T) -> T:
    """Names the class or function as users import it, in pickles, tracebacks and the documentation."""
    one.__module__ = NAME
    return one


@cache
def version() -> str:
    """The version that is installed."""
    from importlib import metadata  # here, since importing it takes as long as importing the core

    return metadata.version(NAME)
