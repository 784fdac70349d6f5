"""The package for users: its name, its version, and packages of extras, imported when they are first used."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any, TypeVar

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


def extra(module: str, what: str, of: str, called: str = "") -> Any:
    """Return the module, or raise an error that begins with `what` and says which extra installs its package, which is
    `called` otherwise if the name is given."""
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] != package:
            raise
        message = f'{what} {called or package}: pip install "invariode[{of}]"'
        raise ModuleNotFoundError(message, name=package) from None
