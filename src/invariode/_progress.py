"""The progress bar, the same for runs, ensembles and commands, drawn by rich where one was asked for.

A bar is drawn when it is told something and by nobody else: a run of native code need not share the interpreter with a
thread that draws, and no process is forked beside one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from time import perf_counter
from typing import Any

__all__ = ["INTERVAL", "PATIENCE", "bar", "in_passing", "run_bar"]

#: Seconds between two pictures, and before a bar that is shown in passing appears.
INTERVAL, PATIENCE = 0.1, 0.3

_in_passing = ContextVar("_in_passing", default=False)


@contextmanager
def in_passing() -> Iterator[None]:
    """Bars appear only where it takes longer, and leave nothing behind."""
    token = _in_passing.set(True)
    try:
        yield
    finally:
        _in_passing.reset(token)


@contextmanager
def bar(shown: bool, what: str, total: float | None) -> Iterator[Callable[..., None] | None]:
    """Shows a bar while the block runs; what it yields is called with how much is done, and of what, if that changes.

    It yields None if no bar was asked for.

    Raises
    ------
    ModuleNotFoundError
        rich, of the extra `cli`, is not installed.
    """
    if not shown:
        yield None
        return
    with _drawn(what, total) as update:

        def told(done: float, of: str = what) -> None:
            update(completed=done, description=of)

        yield told


@contextmanager
def run_bar(what: str, t0: float, tf: float) -> Iterator[Callable[[float, float], None]]:
    """A bar over t, for one run: what it yields is called with t and h. On an infinite interval it pulses."""
    total = abs(tf - t0) if math.isfinite(tf) else None
    with _drawn(what, total, "t = {task.fields[t]:.6g}  h = {task.fields[h]:.2e}", t=t0, h=0.0) as update:
        yield lambda t, h: update(completed=abs(t - t0), t=t, h=h)


@contextmanager
def _drawn(what: str, total: float | None, text: str = "", **fields: float) -> Iterator[Callable[..., None]]:
    """A bar of rich on stderr, since the output of a script stays its own, with this text about the fields."""
    rich = _rich()
    from rich.console import Console

    passing = _in_passing.get()
    columns = [rich.TextColumn("{task.description}", markup=False), rich.BarColumn(), rich.TaskProgressColumn()]
    columns += [rich.TextColumn(text)] if text else []
    progress = rich.Progress(
        *columns, rich.TimeRemainingColumn(), console=Console(stderr=True), auto_refresh=False, transient=passing
    )
    task = progress.add_task(what, total=total, **fields)
    due = perf_counter() + (PATIENCE if passing else 0.0)
    with ExitStack() as stack:  # the end of a bar draws it once more, with the last news
        if not passing:
            stack.enter_context(progress)

        def update(**news: Any) -> None:
            nonlocal due
            now = perf_counter()
            drawn = now >= due
            if drawn:
                due = now + INTERVAL
                if not progress.live.is_started:
                    stack.enter_context(progress)
            progress.update(task, **news, refresh=drawn)

        yield update


def _rich() -> Any:
    try:
        import rich.progress
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("progress=True needs rich: pip install invariode[cli]", name=error.name) from None
    return rich.progress
