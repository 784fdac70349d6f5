"""Tools that the commands share: consoles, tables, output files, and the handling of errors, warnings and Ctrl-C."""

from __future__ import annotations

import gc
import inspect
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import FrameType, TracebackType
from typing import Annotated, Any, cast

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .._base.arguments import PACKAGE
from .._base.failures import InvariantError
from .._base.types import MethodName
from .._problem.methods import METHODS, Method, find_method
from .._problem.options import TABLE

#: The default tolerances.
RTOL, ATOL = TABLE["rtol"].default, TABLE["atol"].default

#: Exit code of a command ended by Ctrl-C: 128 + SIGINT.
INTERRUPTED = 130

Progress = Annotated[
    bool | None, typer.Option("--progress/--no-progress", help="A progress bar.", show_default="in a terminal")
]

#: Endings of figures, and the packages they need.
PICTURES: Mapping[str, tuple[str, ...]] = {".png": ("matplotlib",), ".svg": ("matplotlib",), ".pdf": ("matplotlib",)}


def examples(*lines: str) -> str:
    """Return the end of a help text: one command in a line."""
    return "\n\n".join([f"Example{'s' * (len(lines) > 1)}:", *(f"[bold]invariode {line}[/]" for line in lines)])


def paragraphs(command: Callable[..., Any]) -> str:
    """Return the docstring of a command as its help: a line per paragraph, to be wrapped at the width of the
    terminal."""
    return "\n\n".join(" ".join(text.split()) for text in (inspect.getdoc(command) or "").split("\n\n"))


# ----------------------------------------------------------------------------------------------------------------------
# Errors


def stop(message: str, code: int) -> typer.Exit:
    """Return an exit, to be raised, with the reason on stderr."""
    Console(stderr=True, highlight=False).print(Text(message), soft_wrap=True)
    return typer.Exit(code)


def _is_ours(frame: FrameType) -> bool:
    """Return whether code of this package, or of rich, which writes for it, runs in a frame; that of dataclasses is in
    no file."""
    package = frame.f_globals.get("__name__", "").partition(".")[0]
    return _ours(frame.f_code.co_filename) or package in ("invariode", "rich")


def print_traceback(error: BaseException) -> None:
    """Print the traceback from the first frame that does not belong to invariode."""
    trace: TracebackType | None = error.__traceback__
    while trace is not None and _is_ours(trace.tb_frame):
        trace = trace.tb_next
    print("".join(traceback.format_exception(error.with_traceback(trace))), end="", file=sys.stderr)


@contextmanager
def guarded() -> Iterator[None]:
    """Guard everything that calls the user's functions: errors end the command, warnings are lines on stderr.

    A function of the user raised: its traceback, exit code 1. An invariant is refused: 1. Other misuse, such as a
    method that cannot solve the problem: 2. Ctrl-C: 130.
    """
    with plain_warnings():
        try:
            yield
        except (typer.Exit, typer.BadParameter, BrokenPipeError):
            raise
        except KeyboardInterrupt:
            raise stop("Interrupted.", INTERRUPTED) from None
        except Exception as error:
            if all(_is_ours(frame) for frame, _ in traceback.walk_tb(error.__traceback__)):
                if isinstance(error, InvariantError):
                    raise stop(str(error), code=1) from None
                if isinstance(error, (TypeError, ValueError)):
                    raise stop(str(error), code=2) from None
                raise
            print_traceback(error)
            raise stop(f"The problem's functions raised {type(error).__name__}.", code=1) from None


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Show warnings in a line each, without their origin; filters that ignore them or make them errors stay in
    force."""
    with warnings.catch_warnings():
        warnings.showwarning = _Lines()
        yield


@contextmanager
def without_collector() -> Iterator[None]:
    """Suspend the garbage collector: imports and pictures make many objects, and searching them takes a third of the
    time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _ours(filename: str) -> bool:
    return filename.startswith(PACKAGE)


class _Lines:
    """Prints warnings in a line each; those that differ only in numbers, once."""

    def __init__(self) -> None:
        self._seen: set[str] = set()

    def __call__(self, message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        kind = re.sub(r"\d[\d.e+-]*", "#", str(message))
        if kind not in self._seen:
            self._seen.add(kind)
            label = "Warning" if category is UserWarning else category.__name__
            line = Text.assemble((label, "yellow"), f": {message}")
            Console(stderr=True, highlight=False).print(line, soft_wrap=True)


# ----------------------------------------------------------------------------------------------------------------------
# Arguments


def complete_method(incomplete: str) -> list[str]:
    """Return the names of methods that begin with this text, for the shell's completion."""
    return [name for name in METHODS if name.startswith(incomplete)]


def method_of(name: str) -> tuple[Method, MethodName]:
    """Return the method of that name, which may be SciPy's, and invariode's name for it."""
    try:
        return find_method(name)[0], cast("MethodName", name)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--method") from None


def writable(path: Path, endings: Mapping[str, tuple[str, ...]], option: str, extra: str, force: bool) -> None:
    """Stop before the work is done if `path` could not be written after it."""
    if path.suffix not in endings:
        ending = f"ending {path.suffix!r}" if path.suffix else "no ending"
        raise typer.BadParameter(f"{path} has {ending}; choose from {', '.join(endings)}", param_hint=option)
    if not path.parent.is_dir():
        raise typer.BadParameter(f"no such directory: {path.parent}", param_hint=option)
    if path.is_dir():
        raise typer.BadParameter(f"{path} is a directory", param_hint=option)
    if path.exists() and not force:
        raise typer.BadParameter(f"{path} exists; --force overwrites it", param_hint=option)
    needs(option, endings[path.suffix], extra)


def write_to(path: Path, write: Callable[[], object]) -> None:
    """Write a file; if that fails, the command ends with a line about it, exit code 1."""
    try:
        with plain_warnings():
            write()
    except OSError as error:
        raise stop(f"{path} cannot be written: {error.strerror or error}", code=1) from None


def needs(what: str, packages: Iterable[str], extra: str) -> None:
    """Stop if a package is not installed, with a message about what to install."""
    for package in packages:
        if find_spec(package) is None:
            raise stop(f'{what} needs {package}: pip install "invariode[{extra}]"', code=1)


# ----------------------------------------------------------------------------------------------------------------------
# Tables


def numbers(first: str, others: Iterable[str]) -> Table:
    """Return a table of numbers to the right of names."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def count(number: int) -> str:
    """Return a count of calls as text, shortened from 100k on."""
    if number < 100_000:
        return str(number)
    return f"{round(number / 1e3)}k" if number < 100_000_000 else f"{round(number / 1e6)}M"


def clock(seconds: float) -> str:
    """Return a time as text, with three digits and a unit."""
    size, unit = (1e-6, "µs") if seconds < 1e-3 else (1e-3, "ms") if seconds < 1 else (1.0, "s")
    return f"{seconds / size:.0f} {unit}" if seconds >= 100 * size else f"{seconds / size:.3g} {unit}"
