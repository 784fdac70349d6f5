"""Campaigns of random cases, each in a process that may die of it.

    python tests/fuzz/campaign.py --cases 100000 --seed 1

Case i of a campaign with a seed is always the same; ``--only KIND:SEED:I`` makes it again, in this process, for a
debugger. `make fuzz N=…` starts this, `make fuzz-sanitize N=…` with the extension built with sanitizers.
"""

from __future__ import annotations

import argparse
import mmap
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from random import Random
from tempfile import TemporaryDirectory, TemporaryFile

import calls
import combinations
import exceptions
import fields
import files
import networks
import patterns
import runs

with suppress(ModuleNotFoundError):  # on Windows, which has no fork either
    import resource

#: What can be done with a generator of random numbers; what is wrong with the outcome, or None.
KINDS: dict[str, Callable[[Random], str | None]] = {
    "calls": calls.wrong_call,
    "runs": runs.right_run,
    "files": files.damaged_file,
    "exceptions": exceptions.raising_run,
    "networks": networks.held_network,
    "patterns": patterns.stated_pattern,
    "fields": fields.damaged_field,
    "seams": combinations.right_meeting,
}

#: Seconds after which a case hangs.
PATIENCE = 60
#: Bytes that a process may reserve, where no sanitizer needs its own terabytes: what asks for more gets a MemoryError.
MEMORY = 4 << 30


def case(kind: str, seed: int, i: int) -> str | None:
    """Does case i. What is wrong with it, or None."""
    return KINDS[kind](Random(f"{kind}:{seed}:{i}"))


def failures(kind: str, seed: int, count: int) -> Iterator[tuple[int, str]]:
    """The cases that went wrong, with what did. A process does one after the other until it dies, hangs or is done."""
    first = 0
    while first < count:
        with mmap.mmap(-1, 8) as at, TemporaryFile() as told, TemporaryDirectory() as place:
            at[:] = first.to_bytes(8, "little")
            child = os.fork()
            if child == 0:
                os.chdir(place)  # where a run may leave files
                _work(kind, seed, range(first, count), at, told.fileno())
            died = _watched(child, at)
            told.seek(0)
            reports = told.read().decode(errors="replace")
            for line in reports.splitlines():
                if line.startswith("case "):
                    i, _, what = line[5:].partition(" ")
                    yield int(i), what
            if died is None:
                return
            first = int.from_bytes(at[:], "little") + 1
            yield first - 1, f"{died}\n{reports[-3000:] if 'ERROR' in reports or 'runtime error' in reports else ''}"


def _work(kind: str, seed: int, cases: range, at: mmap.mmap, told: int) -> None:
    """In a process of its own."""
    os.dup2(told, 2)  # where a sanitizer reports, too
    if "LD_PRELOAD" not in os.environ:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    for i in cases:
        at[:] = i.to_bytes(8, "little")
        try:
            wrong = case(kind, seed, i)
        except BaseException as error:
            wrong = f"not caught: {type(error).__name__}: {error}"
        if wrong is not None:
            os.write(2, f"case {i} {wrong!r}\n".encode(errors="replace"))
    os._exit(0)


def _watched(child: int, at: mmap.mmap) -> str | None:
    """Waits for the process. How it died, None where it did not."""
    seen, since = at[:], time.monotonic()
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            if status == 0:
                return None
            code = os.waitstatus_to_exitcode(status)
            return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        if at[:] != seen:
            seen, since = at[:], time.monotonic()
        elif time.monotonic() - since > PATIENCE:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return f"hung for {PATIENCE} s"
        time.sleep(0.01)


def main() -> int:
    parser = argparse.ArgumentParser(description="Random cases until something is wrong.")
    parser.add_argument("--cases", type=int, default=1000, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--only", help="KIND:SEED:I, one case in this process")
    given = parser.parse_args()
    if given.only:
        kind, seed, i = given.only.split(":")
        print(case(kind, int(seed), int(i)))
        return 0
    found: Counter[str] = Counter()
    for kind in given.kinds.split(","):
        start = time.monotonic()
        for i, what in failures(kind, given.seed, given.cases):
            found[kind] += 1
            print(f"--only {kind}:{given.seed}:{i}  {what}", flush=True)
        print(f"{kind}: {given.cases} cases, {found[kind]} wrong, {time.monotonic() - start:.0f} s", flush=True)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
