"""The command `invariode`. Needs the extra `cli`."""

from __future__ import annotations

import atexit
import gc
import io
import os
import sys

__all__ = ["main"]

#: What the extra `cli` installs.
_EXTRA = ("typer", "rich")


def main() -> None:
    """Run the command line; one line says what is missing from the installation, or that its output cannot be written,
    with exit code 1."""
    try:
        from .app import app
    except ModuleNotFoundError as missing:
        package = (missing.name or "").partition(".")[0]
        if package not in _EXTRA:
            raise
        print(f'The command line needs {package}: pip install "invariode[cli]"', file=sys.stderr)
        raise SystemExit(1) from None
    for stream in (sys.stdout, sys.stderr):  # a terminal that cannot show ∂ shows ? instead
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    atexit.register(gc.freeze)  # the process ends: a last search for cycles would take longer than a short run
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.filename is not None:
            raise
        print(f"The output cannot be written: {error.strerror}", file=sys.stderr)
        os._exit(1)  # the interpreter would try again
