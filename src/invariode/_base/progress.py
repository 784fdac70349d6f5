"""The progress bar, the same for runs, ensembles and commands: drawn by rich, in notebooks as HTML.

A bar is drawn when it receives something new, by whoever reports that: a run of native code need not share the
interpreter with a thread that draws, and no process is forked beside one.
"""

from __future__ import annotations

import html
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from time import perf_counter
from types import ModuleType, SimpleNamespace
from typing import Any

from .package import extra
from .types import Progress

#: Seconds between two updates, before a transient bar appears, and between two calls of a user's function.
INTERVAL, DELAY, CALLS = 0.1, 0.3, 1.0

_in_passing = ContextVar("_in_passing", default=False)


@contextmanager
def in_passing() -> Iterator[None]:
    """Let progress bars in this block appear only when the work takes longer, and leave no output behind."""
    token = _in_passing.set(True)
    try:
        yield
    finally:
        _in_passing.reset(token)


@contextmanager
def bar(shown: Progress, what: str, total: float | None) -> Iterator[Callable[..., None] | None]:
    """Show a bar while the block runs, or call the user's function; call the function that it yields with the amount
    done, and with another description of the bar if that changes.

    It yields None if nothing was asked for.

    Raises ModuleNotFoundError: rich, of the extra `cli`, is not installed.
    """
    if not shown:
        yield None
        return
    if callable(shown):
        with _called(shown, total) as told:
            yield told
        return
    with _drawn(what, total) as update:

        def report(done: float, of: str = what) -> None:
            update(completed=done, description=of)

        yield report


@contextmanager
def run_bar(shown: Progress, what: str, t0: float, tf: float) -> Iterator[Callable[[float, float], None]]:
    """Show a bar over t for one run, or call the user's function; it yields a function of t and h. On an infinite
    interval the bar pulses."""
    total = abs(tf - t0) if math.isfinite(tf) else None
    if callable(shown):
        with _called(shown, total) as told:
            yield lambda t, h: told(abs(t - t0))
        return
    with _drawn(what, total, "t = {task.fields[t]:.6g}  h = {task.fields[h]:.2e}", t=t0, h=0.0) as update:
        yield lambda t, h: update(completed=abs(t - t0), t=t, h=h)


@contextmanager
def _called(function: Callable[[float, float | None], object], total: float | None) -> Iterator[Callable[..., None]]:
    """Call the user's function at most once in `CALLS` seconds while the block runs, and once with the last news at its
    end, unless it raises."""
    due, latest, reported = perf_counter() + CALLS, 0.0, -1.0

    def report(done: float, of: str = "") -> None:
        nonlocal due, latest, reported
        latest = done
        if perf_counter() >= due:
            due = perf_counter() + CALLS
            reported = done
            function(done, total)

    yield report
    if latest != reported:
        function(latest, total)


@contextmanager
def _drawn(what: str, total: float | None, text: str = "", **fields: float) -> Iterator[Callable[..., None]]:
    """Show a bar with this text about the fields; it yields a function that takes their new values."""
    if (display := _notebook()) is not None:
        cell = _Cell(display, what, total, text, fields)
        try:
            yield cell.update
        finally:
            cell.draw()  # with the last news
        return
    with _on_stderr(what, total, text, fields) as update:
        yield update


@contextmanager
def _on_stderr(what: str, total: float | None, text: str, fields: dict[str, float]) -> Iterator[Callable[..., None]]:
    """A bar of rich on stderr, since the output of a script stays its own."""
    rich = extra("rich.progress", "progress=True needs", "cli")
    from rich.console import Console

    passing = _in_passing.get()
    columns = [rich.TextColumn("{task.description}", markup=False), rich.BarColumn(), rich.TaskProgressColumn()]
    columns += [rich.TextColumn(text)] if text else []
    progress = rich.Progress(
        *columns, rich.TimeRemainingColumn(), console=Console(stderr=True), auto_refresh=False, transient=passing
    )
    task = progress.add_task(what, total=total, **fields)
    due = perf_counter() + (DELAY if passing else 0.0)
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


def _notebook() -> ModuleType | None:
    """Return the module that shows HTML in a notebook's cell, or None outside a notebook."""
    ipython = sys.modules.get("IPython")  # code that runs in a notebook has imported it
    if ipython is None or not hasattr(ipython.get_ipython(), "kernel"):
        return None
    display: ModuleType = ipython.display
    return display


class _Cell:
    """The bar as an element of HTML in the output of a cell, which needs no widgets."""

    def __init__(self, display: Any, what: str, total: float | None, text: str, fields: dict[str, float]) -> None:
        self._display, self._total, self._text = display, total, text
        self._news: dict[str, Any] = {"completed": 0.0, "description": what, **fields}
        self._start = perf_counter()
        self._due = self._start
        self._shown = display.display(display.HTML(self._html()), display_id=True)

    def update(self, **news: Any) -> None:
        self._news |= news
        now = perf_counter()
        if now >= self._due:
            self._due = now + INTERVAL
            self.draw()

    def draw(self) -> None:
        self._shown.update(self._display.HTML(self._html()))

    def _html(self) -> str:
        words = [html.escape(str(self._news["description"]))]
        if self._total is None:
            words.append("<progress></progress>")
        else:
            done = min(self._news["completed"] / self._total, 1.0) if self._total else 1.0
            words += [f'<progress value="{done:.4f}" max="1"></progress>', f"{100 * done:.0f}%"]
            if 0.0 < done < 1.0:
                left = (perf_counter() - self._start) * (1.0 - done) / done
                words.append(f"{left // 60:.0f}:{left % 60:02.0f} left")
        if self._text:
            words.append(self._text.format(task=SimpleNamespace(fields=self._news)))
        return f'<div style="white-space: pre">{"  ".join(words)}</div>'
