"""Processes that meet at one checkpoint or store, and processes that are killed there, compared with runs left alone.

``python tests/meetings.py N SEED [KIND]`` is the campaign: N trials of each kind, or of one.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np

import invariode as iv
from interrupted import differences

END = 5.0
OPTIONS: dict[str, Any] = {"method": "ode45", "rtol": 1e-9, "atol": 1e-9, "dense_output": True}
ROWS = {"t_eval": [1.0, 2.0], "args": np.linspace(1, 2, 12)[:, None], "workers": 1, "chunk": 3}


def oscillator(t, y, w):
    return [w * y[1], -w * y[0]]


def crossing(t, y, w):
    return y[0]


def problem(w: float) -> iv.Problem:
    return iv.Problem(oscillator, (0, END), [1.0, 0.0], args=(w,), events=crossing)


def alone(w: float) -> iv.Solution:
    return problem(w).solve(**OPTIONS)


# ----------------------------------------------------------------------------------------------------------------------
# The processes


def _act(told: Connection, what: str, path: Path, w: float) -> None:
    """Do what a process is told to begin with: it says 'done', or why it was refused."""
    told.recv()
    try:
        if what == "solve":
            problem(w).solve(**OPTIONS, checkpoint=iv.Checkpoint(path, every=1e-9))
        else:
            iv.load(path, problem(w)).extend(END)
    except (ValueError, FileNotFoundError) as refused:
        told.send(str(refused))
    else:
        told.send("done")


def _die_after(path: Path, count: int) -> None:
    """Kills this process at that event of the files of a store: one is made, written or renamed."""
    left = count

    def look(event: str, args: tuple[Any, ...]) -> None:
        nonlocal left
        if event in ("open", "os.mkdir", "os.rename", "os.rmdir", "os.remove") and path.name in str(args[:2]):
            left -= 1
            if left < 0:
                signal.raise_signal(signal.SIGKILL)

    sys.addaudithook(look)


class Process:
    """A process of its own that waits until it is told to begin."""

    def __init__(self, what: str, path: Path, w: float) -> None:
        self._here, there = Pipe()
        self._process = get_context("fork").Process(target=_act, args=(there, what, path, w))
        self._process.start()
        there.close()

    def begin(self) -> None:
        self._here.send(None)

    def kill(self) -> None:
        self._process.kill()

    def outcome(self) -> str:
        """'done', 'killed' or why it was refused."""
        self._process.join()
        try:
            return str(self._here.recv())
        except (EOFError, ConnectionResetError):
            return "killed"


def _whole(path: Path, w: float) -> str:
    """Check that a checkpoint holds the run, which goes on if it has not ended: '' or what differs."""
    loaded = iv.load(path, problem(w))
    if not loaded.success:
        loaded.extend(END)
        loaded = iv.load(path, problem(w))
    return ", ".join(differences(alone(w), loaded))


# ----------------------------------------------------------------------------------------------------------------------
# The trials: what happened, or 'wrong: …'


def together(path: Path, rng: random.Random) -> str:
    """Two jobs of different parameters begin at once with one name: one is told, the other's run is whole."""
    rates = (1.0, 1.1)
    processes = [Process("solve", path, w) for w in rates]
    for one in processes:
        one.begin()
    outcomes = [one.outcome() for one in processes]
    if outcomes.count("done") != 1:
        return f"wrong: {outcomes}"
    done = outcomes.index("done")
    if not any(text in outcomes[1 - done] for text in ("is in use by process", "has not ended")):
        return f"wrong: {outcomes}"
    return f"wrong: {off}" if (off := _whole(path, rates[done])) else "one done, one told"


def requeued(path: Path, rng: random.Random) -> str:
    """A job goes on with the run of another that is still alive: it is told, and nothing is lost."""
    old, new = Process("solve", path, 1.0), Process("extend", path, 1.0)
    old.begin()
    sleep(0.3 * rng.random())
    new.begin()
    told, done = new.outcome(), old.outcome()
    if done != "done" or told == "done":
        return f"wrong: {done}, {told}"
    return f"wrong: {off}" if (off := _whole(path, 1.0)) else "old one done, new one told"


def requeued_after_a_kill(path: Path, rng: random.Random) -> str:
    """The old job is killed while the new one begins."""
    old, new = Process("solve", path, 1.0), Process("extend", path, 1.0)
    old.begin()
    sleep(0.2 + 0.2 * rng.random())
    old.kill()
    new.begin()
    outcomes = old.outcome(), new.outcome()
    if not path.exists():
        return f"{outcomes[0]} before it began" if "No such file" in outcomes[1] else f"wrong: {outcomes}"
    return f"wrong: {off} {outcomes}" if (off := _whole(path, 1.0)) else "goes on"


def other_parameters(path: Path, rng: random.Random) -> str:
    """A job dies; one of other parameters with its name is told, or has a run of its own."""
    first = Process("solve", path, 1.0)
    first.begin()
    sleep(0.3 * rng.random())
    first.kill()
    died = first.outcome()
    second = Process("solve", path, 1.1)
    second.begin()
    outcome = second.outcome()
    if outcome == "done":
        return f"wrong: {off}" if (off := _whole(path, 1.1)) else "nothing was there"
    if "has not ended" not in outcome or died != "killed":
        return f"wrong: {died}, {outcome}"
    return f"wrong: {off}" if (off := _whole(path, 1.0)) else "second told"


def rerun(path: Path, rng: random.Random) -> str:
    """A job that has finished runs again, twice at once, and the one that does is killed."""
    problem(1.0).solve(**OPTIONS, checkpoint=path)
    for one in path.parent.glob(path.name + "*"):  # the output too: a process may be killed before it touches either
        one.chmod(0o600)
    processes = [Process("solve", path, 1.0) for _ in range(2)]
    for one in processes:
        one.begin()
    sleep(0.5 * rng.random())
    for one in processes:
        one.kill()
    outcomes = [one.outcome() for one in processes]
    told = sum(one not in ("done", "killed") for one in outcomes)
    if off := _whole(path, 1.0):
        return f"wrong: {off} {outcomes}"
    if {one.stat().st_mode & 0o777 for one in path.parent.glob(path.name + "*")} != {0o600}:
        return "wrong: modes"
    left = [one.name for one in path.parent.iterdir() if path.name in one.name]
    return f"wrong: {left}" if len(left) > 4 else f"killed, {told} told"


def store(path: Path, rng: random.Random, count: int | None = None) -> str:
    """A job is killed as it makes or fills a store: the store is resumed."""
    last = rng.randrange(150) if count is None else count
    done = subprocess.run([sys.executable, __file__, "--store", str(path), str(last)])  # Zarr's threads do not fork
    outcome = "killed" if done.returncode else "done"
    again = iv.solve_ensemble(oscillator, (0, 2), [1.0, 0.0], store=path, **ROWS, resume=True).load()
    right = iv.solve_ensemble(oscillator, (0, 2), [1.0, 0.0], **{**ROWS, "chunk": None})
    same = all(again[name].tobytes() == right[name].tobytes() for name in ("y", "y_end", "t_end", "status"))
    left = [one.name for one in path.parent.iterdir() if path.name in one.name]
    return outcome if same and left == [path.name] else f"wrong: {outcome} {left}"


TRIALS = (together, requeued, requeued_after_a_kill, other_parameters, rerun, store)


def _campaign(count: int, seed: int, only: str) -> int:
    wrong = 0
    for trial in (one for one in TRIALS if only in ("", one.__name__)):
        rng, outcomes = random.Random(seed), Counter[str]()
        with tempfile.TemporaryDirectory() as folder:
            for i in range(count):
                outcomes[trial(Path(folder) / f"{trial.__name__}{i}", rng)] += 1
        told = ", ".join(f"{times} {outcome}" for outcome, times in outcomes.items())
        print(f"{trial.__name__}: {told}", flush=True)
        wrong += sum(times for outcome, times in outcomes.items() if outcome.startswith("wrong"))
    return wrong


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    if sys.argv[1] == "--store":
        _die_after(Path(sys.argv[2]), int(sys.argv[3]))
        iv.solve_ensemble(oscillator, (0, 2), [1.0, 0.0], store=sys.argv[2], **ROWS)
    else:
        sys.exit(_campaign(int(sys.argv[1]), int(sys.argv[2]), "".join(sys.argv[3:])) > 0)
