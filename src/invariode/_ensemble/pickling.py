"""Pickles for other machines: functions of the script itself travel with their code."""

from __future__ import annotations

import io
import pickle
import traceback
from typing import Any

from .._functions.compiled import CompiledFunction

__all__ = ["dumps", "travelling"]


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


def travelling(error: BaseException | None) -> BaseException | None:
    """An exception that can be pickled, with its traceback, which cannot, as a note."""
    if error is None or error.__traceback__ is None:
        return error
    try:
        alike: BaseException = pickle.loads(pickle.dumps(error))
    except Exception:  # whatever the user's class does
        alike = RuntimeError(f"{type(error).__name__}: {error}")
    alike.add_note(f"In the process that solved the trajectory:\n{''.join(traceback.format_exception(error))}")
    return alike
