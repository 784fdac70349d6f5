"""The package's name and version, and packages of extras, which are imported when they are first used."""

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
    """Return the installed version."""
    from importlib import metadata  # here, since importing it takes as long as importing the core

    return metadata.version(NAME)


def extra(module: str, what: str, of: str, called: str = "") -> Any:
    """Return the module, or raise an error that begins with `what` and says which extra, `of`, installs its package; ""
    if none does. `called`: the package's name, if it differs from the module's."""
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] != package:
            raise
        name = called or package
        message = f"{what} {name}: pip install " + (f'"invariode[{of}]"' if of else name)
        raise ModuleNotFoundError(message, name=package) from None
