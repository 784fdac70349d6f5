"""Helpers for every room: checks of arguments, their types, failures, files and locks, progress, notebooks, colours."""

import sys

# A process can load the extension once. It stays in `sys.modules` by a name of its own, so that the package can be
# imported again after its modules were deleted there, as reloaders do. This is the first module that is imported.
if (_loaded := sys.modules.get("_core of invariode")) is not None:
    sys.modules.setdefault(f"{__name__.rpartition('.')[0]}._core", _loaded)
from .. import _core

sys.modules["_core of invariode"] = _core
