"""Ctrl-C as a request to stop a run, whose results so far are returned, and SIGTERM as a Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .. import _core


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM within the block have the effect of Ctrl-C, also in a process that ignores Ctrl-C, as background jobs
    of a script do. Nothing changes outside the main thread, and in a process that handles or ignores SIGTERM itself."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _interrupt(number: int, frame: Any) -> None:
    """Call the handler of Ctrl-C, or raise KeyboardInterrupt if the process ignores Ctrl-C."""
    usual = signal.getsignal(signal.SIGINT)
    (usual if callable(usual) else signal.default_int_handler)(number, frame)


@contextmanager
def stopped_by_interrupt() -> Iterator[_core.StopRequest | None]:
    """Let the first Ctrl-C within the block request a stop, or a SIGTERM that counts as one; the second one has its
    usual effect. The request is None where neither arrives: outside the main thread, or if the process ignores Ctrl-C
    and handles SIGTERM itself."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    heard = {
        number: usual
        for number, usual in before.items()
        if usual is _interrupt or (number == signal.SIGINT and usual not in (None, signal.SIG_IGN))
    }
    if threading.current_thread() is not threading.main_thread() or not heard:
        yield None
        return
    request = _core.StopRequest()

    def restore() -> None:
        for number, usual in heard.items():
            signal.signal(number, usual)

    def make(number: int, frame: Any) -> None:
        restore()
        request.make()

    for number in heard:
        signal.signal(number, make)
    try:
        yield request
    finally:
        restore()
