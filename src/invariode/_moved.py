"""Names that have moved: they work for one minor version, with a warning that says the new one."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

__all__ = ["MOVED", "announce_moves"]

#: Since 0.2. Former contents of the module on the left are in the one on the right.
MOVED = {
    "invariode.check": "invariode.invariant_check",
    "invariode.discovery": "invariode.invariant_search",
    "invariode.export": "invariode.loading",
    "invariode.invariants": "invariode.imposing",
    "invariode.suite": "invariode",
}


def announce_moves() -> None:
    """Puts modules in the place of those that are gone, and makes each hand out what has moved."""
    package = sys.modules[__package__]
    vars(package)["__getattr__"] = _module_attribute
    for old, new in MOVED.items():
        if old not in sys.modules:
            sys.modules[old] = ModuleType(old, f"Moved: see {new}.")
        vars(sys.modules[old])["__getattr__"] = _attributes_from(old, new)


def _attributes_from(old: str, new: str) -> Callable[[str], Any]:
    def moved_attribute(name: str) -> Any:
        if name.startswith("__") or not hasattr(module := importlib.import_module(new), name):
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        message = f"{old}.{name} has moved, and will be removed in invariode 0.3: use {new}.{name}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(module, name)

    return moved_attribute


def _module_attribute(name: str) -> ModuleType:
    """Of the package: ``invariode.suite`` as an expression."""
    full = f"{__package__}.{name}"
    if full in MOVED:
        return sys.modules[full]
    raise AttributeError(f"module {__package__!r} has no attribute {name!r}")
