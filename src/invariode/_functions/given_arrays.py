"""How the code that `compile` makes sees the core's memory: arrays that it may read, or copies. Imported with numba
only."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["copied", "read_only"]

# numba has no types.
_extending: Any = import_module("numba.extending")
_imputils: Any = import_module("numba.core.imputils")


@_extending.intrinsic  # type: ignore[untyped-decorator]
def read_only(context: Any, array: Any) -> Any:
    """The same memory as an array to which numba compiles no assignment."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _imputils.impl_ret_borrowed(context, builder, signature.return_type, arguments[0])

    return array.copy(readonly=True)(array), generate


@_extending.register_jitable  # type: ignore[untyped-decorator]
def copied(array: Any) -> Any:
    """New memory with the same numbers."""
    return array.copy()
