"""Names of methods as types. Type checkers read the stub beside this file, which lists them: ``make stubs``."""

from __future__ import annotations

from typing import Any, TypeAlias

#: A name in `METHODS`.
OwnName: TypeAlias = str
#: A name in `METHODS`, or SciPy's name or class.
MethodName: TypeAlias = str | type[Any]
