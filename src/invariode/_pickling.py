"""Pickles for other machines: functions of the script itself travel with their code."""

from __future__ import annotations

import io
from typing import Any

from .compiled import CompiledFunction

__all__ = ["dumps"]


def dumps(cloudpickle: Any, value: Any) -> bytes:
    """A pickle by cloudpickle. Its own rule, that what `__main__` defines travels with its code, holds for compiled
    functions too: they are compiled anew where they arrive."""

    class Pickler(cloudpickle.Pickler):  # type: ignore[misc]  # an extra, imported when it is used
        def reducer_override(self, obj: Any) -> Any:
            if isinstance(obj, CompiledFunction) and obj.__module__ == "__main__":
                return CompiledFunction, (obj.fun, obj.inplace, obj.elementary)
            return super().reducer_override(obj)

    with io.BytesIO() as file:
        Pickler(file).dump(value)
        return file.getvalue()
