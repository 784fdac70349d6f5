"""Rows of work, solved in worker processes by `concurrent.futures`.

What an executor leaves to its users is here: a row that kills its process fails alone, Ctrl-C ends everything at once,
and workers do not outlive their parent.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import wait as wait_for_any
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import Any, Generic, TypeVar

T = TypeVar("T")

#: Rows that a worker gets at once: few enough that each worker gets several chunks, and results do not pile up.
CHUNKS_PER_WORKER, LARGEST_CHUNK = 8, 256
#: Seconds after which a worker hands back the rows of a chunk that it has solved: Ctrl-C loses no more than these.
HANDING_BACK = 0.5
#: Chunks under way per worker: the one that it solves, and the next, so that it need not wait.
AHEAD = 2
#: Windows cannot wait for more processes at once (documentation of `ProcessPoolExecutor`).
MOST_WORKERS = 61 if sys.platform == "win32" else sys.maxsize
#: Seconds between a worker's checks that its parent is alive.
INTERVAL = 0.5
#: Seconds that the parent waits for outcomes until it listens for Ctrl-C.
LISTENING = 0.05
#: How often in succession a process may die before it comes to a row: a few may be killed by accident.
MOST_DEATHS = 5

NOTHING_SOLVED = (
    "the worker processes end before they solve anything: if processes are spawned, not forked, define the functions "
    'in a module and guard the script by if __name__ == "__main__":, or solve with workers=1'
)


def may_start() -> bool:
    """Return whether this process may start others; a daemonic one may not."""
    return not multiprocessing.current_process().daemon


def solve_rows(solve: Callable[[int], T], size: int, workers: int, died: Callable[[int], T]) -> Generator[list[T]]:
    """Yield lists of ``solve(i)`` for i from 0 to size - 1, in the order in which worker processes finish them.

    - `solve`: where processes are started afresh, it must be picklable. What it raises ends everything.
    - `size`, `workers`: numbers of rows and of processes
    - `died`: ``died(i)`` stands for a row whose process died, and died again when the row was tried once more

    Raises TypeError: `solve` cannot be pickled, and must be.
    Raises RuntimeError: The processes end before they come to a row.
    """
    context = _context()
    if context.get_start_method() != "fork":
        try:
            pickle.dumps(solve)
        except Exception as error:
            raise TypeError(
                f"the functions of this ensemble cannot be sent to other processes ({error}): define them in a module, "
                "compile them (invariode.compile), or solve with workers=1"
            ) from error
    workers = min(workers, MOST_WORKERS)
    length = max(1, min(LARGEST_CHUNK, size // (CHUNKS_PER_WORKER * workers)))
    left = deque(range(i, min(i + length, size)) for i in range(0, size, length))
    at = context.RawArray("q", size)
    tried: set[int] = set()  # rows whose process died
    fruitless = 0
    with tempfile.TemporaryDirectory(prefix="invariode-", ignore_cleanup_errors=True) as folder:
        while left:
            # If it is not clear which row is fatal, one worker shows it.
            pool: _Workers[T] = _Workers(context, _Work(solve, folder, at), left, 1 if fruitless else workers)
            solved = 0
            with closing(pool.outcomes()) as found:
                for outcomes in found:
                    solved += len(outcomes)
                    yield outcomes
            fatal = pool.fatal_rows()
            fruitless = 0 if solved or fatal else fruitless + 1
            if fruitless == MOST_DEATHS:
                raise RuntimeError(NOTHING_SOLVED)
            if hopeless := sorted(fatal & tried):
                yield [died(i) for i in hopeless]
            tried |= fatal
            for chunk in pool.lost:
                left.extendleft(_what_is_left(chunk, fatal, hopeless))


def _context() -> BaseContext:
    """Return the context in which `multiprocessing` starts processes. Where a server forks them, which is Linux's
    default since Python 3.14, this process forks them instead: its workers know functions that cannot be pickled, and
    the script needs no guard."""
    context = multiprocessing.get_context()
    by_default = sys.version_info >= (3, 14) and context.get_start_method() == "forkserver"
    return multiprocessing.get_context("fork") if by_default else context


def _what_is_left(chunk: range, fatal: set[int], hopeless: Sequence[int]) -> list[range]:
    """Return the rows of a lost chunk that are still to be solved: the one its process died at alone, unless it is
    hopeless."""
    row = next((i for i in chunk if i in fatal), None)
    if row is None:
        return [chunk]
    again = range(row, row if row in hopeless else row + 1)
    return [part for part in (range(chunk.start, row), range(row + 1, chunk.stop), again) if part]


# ----------------------------------------------------------------------------------------------------------------------
# In the parent


class _Workers(Generic[T]):
    """An executor, which works until everything is solved or one of its processes dies; then all of them end.

    - `lost`: chunks that were given to it and not solved
    """

    def __init__(self, context: Any, work: _Work, left: deque[range], workers: int) -> None:
        self.lost: list[range] = []
        self._context = context
        self._work = work
        self._left = left
        self._workers = min(workers, len(left))
        self._given: dict[Future[str], range] = {}
        self._executor: ProcessPoolExecutor | None = None
        # The executor forgets them when it shuts down. Public, though less than this, from Python 3.14: kill_workers.
        self._processes: Mapping[int, BaseProcess] = {}

    def outcomes(self) -> Generator[list[T]]:
        """Yield the outcomes of a chunk at a time. If it is left early, by Ctrl-C for example, the processes are
        killed."""
        try:
            executor = self._start()
            while self._given:
                with _ctrl_c_later():
                    files = self._solved()
                    if not self.lost:
                        self._give(executor)
                for file in files:
                    outcomes = pickle.loads(file.read_bytes())
                    file.unlink()
                    yield outcomes
            with _ctrl_c_later():
                executor.shutdown()
        except BaseException:
            with _ctrl_c_later():
                for process in list(self._processes.values()):
                    process.kill()
                if self._executor:
                    self._executor.shutdown(cancel_futures=True)
            raise

    def _solved(self) -> list[Path]:
        """Return the outcomes of chunks that are solved, after some waiting; those of an executor that is broken are
        lost."""
        files = []
        for future in wait(self._given, LISTENING, FIRST_COMPLETED).done:
            chunk = self._given.pop(future)
            try:
                file = Path(future.result())
                files.append(file)
                if rest := chunk[int(file.suffix[1:]) :]:
                    self._left.appendleft(rest)
            except BrokenProcessPool:
                self.lost.append(chunk)
        return files

    def _start(self) -> ProcessPoolExecutor:
        """Start the processes, with their first chunks."""
        with _ctrl_c_later(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # fork beside the threads of a BLAS
            executor = self._executor = ProcessPoolExecutor(self._workers, self._context, _begin, (self._work,))
            self._processes = executor._processes
            self._give(executor)
        return executor

    def _give(self, executor: ProcessPoolExecutor) -> None:
        with suppress(BrokenProcessPool):  # `outcomes` will see it
            while self._left and len(self._given) < AHEAD * self._workers:
                chunk = self._left[0]
                self._given[executor.submit(_solve_chunk, chunk)] = chunk
                self._left.popleft()

    def fatal_rows(self) -> set[int]:
        """Return the rows at which processes died by themselves: when one does, the executor terminates the others."""
        ended = self._processes.values()
        theirs = {p.pid for p in ended if len(ended) == 1 or p.exitcode != -signal.SIGTERM}
        rows = {i for chunk in self.lost for i in chunk if self._work.at[i] in theirs}
        for chunk in self.lost:
            for i in chunk:
                self._work.at[i] = 0
        return rows


@contextmanager
def _ctrl_c_later() -> Iterator[None]:
    """Delay Ctrl-C, and a SIGTERM that has a handler, until the block is over.

    A hook that runs in a fork would swallow it, and a new process die of it; an exception in the middle of the executor
    may leave one of its locks locked, for which its thread then waits for ever.

    Python runs its handlers in the main thread; elsewhere there is nothing to put off.
    """
    here = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    usual: dict[int, Any] = {number: one for number in here if callable(one := signal.getsignal(number))}
    heard: list[tuple[int, FrameType | None]] = []
    for number in usual:
        signal.signal(number, lambda number, frame: heard.append((number, frame)))
    try:
        yield
    finally:
        for number, one in usual.items():
            signal.signal(number, one)
        if heard:
            usual[heard[0][0]](*heard[0])


# ----------------------------------------------------------------------------------------------------------------------
# In a worker process


@dataclass(frozen=True)
class _Work:
    """Data that a worker process needs."""

    solve: Callable[[int], Any]  # solves a row
    #: Where outcomes go. Through the executor's pipe they would be lost, and the reader wait for ever, when a process
    #: is killed as it writes; the names of files are short enough to be written at once.
    folder: str
    at: Any  # at[i] is the process that is at row i, if any


_work: _Work  # of this worker


def _begin(work: _Work) -> None:
    """Ignore Ctrl-C, since the parent kills its workers; a handler of SIGTERM is reset to the default."""
    global _work
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _work = work
    threading.Thread(target=_end_with_parent, args=(os.getppid(), work.folder), daemon=True).start()


def _end_with_parent(pid: int, folder: str) -> None:
    """End this process when its parent has died, by whatever cause."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker
    # Other forked processes may keep the sentinel open, but none keeps the parent's id.
    while not wait_for_any([parent.sentinel], INTERVAL) and os.getppid() == pid:
        pass
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def _solve_chunk(chunk: range) -> str:
    """Solve these rows, or the first of them for `HANDING_BACK` seconds, and return the file with the outcomes, which
    ends with their number."""
    outcomes, me, end = [], os.getpid(), time.monotonic() + HANDING_BACK
    for i in chunk:
        _work.at[i] = me
        outcomes.append(_work.solve(i))
        _work.at[i] = 0
        if time.monotonic() > end:
            break
    _work.at[i] = me  # if it exceeds the memory, the last row is tried alone
    file = Path(_work.folder) / f"{chunk.start}.{len(outcomes)}"
    file.write_bytes(pickle.dumps(outcomes))
    _work.at[i] = 0
    return str(file)
