"""A progress bar, where one was asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def bar(shown: bool, what: str, total: float) -> Iterator[Callable[[float], None] | None]:
    """Shows a bar while the block runs; what it yields is called with how much is done. None: no bar was asked for.

    Raises
    ------
    ModuleNotFoundError
        rich, of the extra `cli`, is not installed.
    """
    if not shown:
        yield None
        return
    rich = _rich()
    columns = (rich.TextColumn("{task.description}"), rich.BarColumn(), rich.TaskProgressColumn())
    with rich.Progress(*columns, rich.TimeRemainingColumn(), console=_stderr()) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


@contextmanager
def run_bar(what: str, t0: float, tf: float) -> Iterator[Callable[[float, float], None]]:
    """A bar over t, for one run: what it yields is called with t and h. On an infinite interval it pulses.

    It is drawn when it is called and by nobody else, so that a run of native code need not share the interpreter with
    a thread.
    """
    rich = _rich()
    columns = (
        rich.TextColumn("{task.description}", markup=False),
        rich.BarColumn(),
        rich.TaskProgressColumn(),
        rich.TextColumn("t = {task.fields[t]:.6g}  h = {task.fields[h]:.2e}"),
        rich.TimeRemainingColumn(),
    )
    with rich.Progress(*columns, console=_stderr(), auto_refresh=False) as progress:
        total = abs(tf - t0) if math.isfinite(tf) else None
        task = progress.add_task(what, total=total, t=t0, h=0.0)
        yield lambda t, h: progress.update(task, completed=abs(t - t0), t=t, h=h, refresh=True)


def _stderr() -> Any:
    """Where bars are drawn: the output of a script stays its own."""
    from rich.console import Console

    return Console(stderr=True)


def _rich() -> Any:
    try:
        import rich.progress
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("progress=True needs rich: pip install invariode[cli]", name=error.name) from None
    return rich.progress
