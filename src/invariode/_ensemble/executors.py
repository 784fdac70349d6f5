"""Executors that solve the parts of an ensemble: other processes, clusters or threads."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from time import monotonic
from typing import Any, Protocol, TypeVar

from .._base.arguments import shown
from .._functions.compiled import CompiledFunction
from .sources import RowBlock

T = TypeVar("T")

#: Parts under way for each place of an executor: the one that is solved there, and the next, so that it need not wait.
AHEAD = 2
#: Seconds between two questions to a cluster how large it is.
ASKING = 1.0


class Executor(Protocol):
    """The method of `concurrent.futures.Executor` that an ensemble needs."""

    def submit(self, call: Callable[..., Any], /, *args: Any) -> Future[Any]: ...


def executor_of(given: Any) -> Executor:
    """Return an executor, from one or from a client of Dask.

    Raises TypeError: It is neither. ValueError: It is a client that has been closed.
    """
    if hasattr(given, "get_executor") and hasattr(given, "nthreads"):
        if getattr(given, "status", None) == "closed":
            raise ValueError("executor is a client of Dask that has been closed: give one that is connected")
        executor: Executor = given.get_executor(pure=False)
        return executor
    if not callable(getattr(given, "submit", None)):
        raise TypeError(
            f"executor must be a concurrent.futures.Executor or a distributed.Client, got {shown(given)}; leave it out "
            "to solve on this machine"
        )
    return given  # type: ignore[no-any-return]  # it has `submit`


class _Places:
    """The number of parts an executor solves at once. A cluster, whose workers come and go, is asked now and then."""

    def __init__(self, given: Any, executor: Executor) -> None:
        self._given = given if hasattr(given, "nthreads") else None
        self._count = int(getattr(executor, "_max_workers", 1))
        self._due = 0.0

    def count(self) -> int:
        if self._given is not None and monotonic() >= self._due:
            self._count = max(1, int(sum(self._given.nthreads().values())))
            self._due = monotonic() + ASKING
        return self._count


def shares_memory(executor: Any) -> bool:
    """Return whether an executor solves in this process, so that nothing is pickled."""
    return isinstance(executor, ThreadPoolExecutor)


def places_of(given: Any) -> int:
    """Return the number of parts that are solved at once."""
    return 1 if given is None else _Places(given, executor_of(given)).count()


def packed(value: Any) -> bytes:
    """Return a pickle with the functions of the user's own script in it, where cloudpickle is there."""
    try:
        import cloudpickle
    except ImportError:
        try:
            return pickle.dumps(value)
        except Exception as error:
            raise TypeError(
                f"the functions of this ensemble cannot be sent to other processes ({error}): install cloudpickle (pip "
                "install invariode[cluster]), or define them in a module"
            ) from error
    return _with_code(cloudpickle, value)


def _with_code(cloudpickle: Any, value: Any) -> bytes:
    """Return a pickle by cloudpickle. Its own rule, that what `__main__` defines travels with its code, holds for
    compiled functions too: they are compiled anew where they arrive."""

    class Pickler(cloudpickle.Pickler):  # type: ignore[misc]  # an extra, imported when it is used
        def reducer_override(self, obj: Any) -> Any:
            if isinstance(obj, CompiledFunction) and obj.__module__ == "__main__":
                return obj.made_again()
            return super().reducer_override(obj)

    with io.BytesIO() as file:
        Pickler(file).dump(value)
        return file.getvalue()


def on_executor(
    given: Any, call: Callable[..., T], arguments: Callable[[RowBlock], tuple[Any, ...]], parts: Iterable[RowBlock]
) -> Generator[tuple[RowBlock, T]]:
    """Yield each part with the value of ``call(*arguments(part))``, as an executor finishes them. If the generator is
    closed early, parts that have not begun are cancelled.

    Raises RuntimeError: The executor cannot go on: its processes died.
    """
    executor, left = executor_of(given), iter(parts)
    places = _Places(given, executor)
    pending: dict[Future[T], RowBlock] = {}
    try:
        while True:
            for part in islice(left, max(0, AHEAD * places.count() - len(pending))):
                pending[_submitted(executor, part, call, *arguments(part))] = part
            if not pending:
                return
            finished = wait(pending, return_when=FIRST_COMPLETED).done
            for future in sorted(finished, key=lambda one: (_failed(one), pending[one].number)):  # lose no outcome
                part = pending.pop(future)
                yield part, _result(future, part)
    finally:
        for future in pending:
            future.cancel()


def _submitted(executor: Executor, part: RowBlock, call: Callable[..., T], *args: Any) -> Future[T]:
    try:
        return executor.submit(call, *args)
    except (BrokenProcessPool, RuntimeError) as error:
        raise _lost(part, error) from error


def _failed(future: Future[Any]) -> bool:
    return future.cancelled() or future.exception() is not None


def _result(future: Future[T], part: RowBlock) -> T:
    try:
        return future.result()
    except (BrokenProcessPool, CancelledError) as error:
        raise _lost(part, error) from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # of distributed: it has tried other workers
            raise _lost(part, error) from error
        raise


def _lost(part: RowBlock, error: BaseException) -> RuntimeError:
    return RuntimeError(
        f"the executor lost trajectories {part.start} to {part.stop - 1} ({type(error).__name__}: {error}): a process "
        "died, of a function that ended it or of too little memory, and this executor starts no other. Make a new one; "
        "with store= and resume=True what is solved stays solved"
    )
