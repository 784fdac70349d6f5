"""Ctrl-C as a request to stop a run, whose results so far are returned."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .. import _core


@contextmanager
def stopped_by_interrupt() -> Iterator[_core.StopRequest | None]:
    """Let the first Ctrl-C within the block request a stop; the second one has its usual effect. The request is None
    where no Ctrl-C arrives: outside the main thread, or if the process ignores it."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (None, signal.SIG_IGN):
        yield None
        return
    request = _core.StopRequest()

    def make(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, before)
        request.make()

    signal.signal(signal.SIGINT, make)
    try:
        yield request
    finally:
        signal.signal(signal.SIGINT, before)
