"""Packages that extras install, imported when they are first used."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def extra(module: str, what: str, of: str) -> Any:
    """The module, or an error that begins with `what` and says which extra installs its package."""
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] != package:
            raise
        message = f'{what} {package}: pip install "invariode[{of}]"'
        raise ModuleNotFoundError(message, name=package) from None
