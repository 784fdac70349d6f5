"""A progress bar, where one was asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
    try:
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("progress=True needs rich: pip install invariode[cli]", name=error.name) from None
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)
