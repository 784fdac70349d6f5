"""Worker processes: a death costs only the row that causes it, Ctrl-C is heard at once, none outlives its parent."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import invariode as iv
from cases import dealt
from invariode._ensemble import worker_processes

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals, and functions that only a fork can send")

LIMIT = 60  # seconds; what ends at once has this long


def square(i: int) -> int:
    return i * i


def outcomes(solve, size: int, workers: int) -> list:
    return sorted(x for some in worker_processes.solve_rows(solve, size, workers, lambda i: (i, "died")) for x in some)


def dying_at(fatal, end, i):
    if i in fatal:
        end()
    return i, "solved"


@dealt(workers=[2, 3, 8], size=[2, 3, 100, 1000])
def test_each_row_comes_once(size, workers):
    assert outcomes(square, size, min(size, workers)) == [i * i for i in range(size)]


def terminate() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(
    "end",
    [
        partial(os._exit, 3),
        partial(os._exit, 0),
        lambda: os.kill(os.getpid(), signal.SIGKILL),
        terminate,
    ],
    ids=["exit", "exit 0", "kill", "terminate"],
)
def test_a_row_that_ends_its_process_fails_alone(end, monkeypatch):
    pools = []
    start = worker_processes._Workers._start
    monkeypatch.setattr(worker_processes._Workers, "_start", lambda self: pools.append(self) or start(self))
    fatal = {3, 4, 399}
    found = outcomes(partial(dying_at, fatal, end), 400, 2)
    assert found == [(i, "died" if i in fatal else "solved") for i in range(400)]
    if end is not terminate:  # executors end workers by SIGTERM too: who was the first has to be found
        assert len(pools) <= 1 + 2 * len(fatal)


def killed_once(folder: Path, i: int) -> tuple[int, bytes]:
    """Row 7 has its process killed from outside, the first time."""
    mark = folder / "killed"
    if i == 7 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return i, bytes(100_000)


def test_a_process_that_is_killed_costs_no_row(tmp_path):
    assert outcomes(partial(killed_once, tmp_path), 40, 2) == [(i, bytes(100_000)) for i in range(40)]


def test_workers_killed_at_random_as_they_send_cost_no_row():
    """Workers may be killed in the middle of what they write, at which the reader must not wait for the rest."""
    size, end = 60, threading.Event()
    random = np.random.default_rng(1)
    kills: Counter[str] = Counter()

    def kill_now_and_then() -> None:
        while not end.wait(0.05 + 0.1 * random.random()) and kills["all"] < 10:
            if workers := multiprocessing.active_children():
                kills["all"] += 1
                with suppress(ProcessLookupError):  # it has just ended by itself
                    os.kill(workers[random.integers(len(workers))].pid, signal.SIGKILL)

    killer = threading.Thread(target=kill_now_and_then)
    killer.start()
    try:
        found = outcomes(lambda i: (i, "solved", bytes(3_000_000)), size, 3)
    finally:
        end.set()
        killer.join()
    # A row whose process was killed twice in this storm is given up, and only such a one.
    assert [row[0] for row in found] == list(range(size))
    assert sum(row[1] == "died" for row in found) <= kills["all"] / 2


def test_processes_that_cannot_start_are_said_to_be(monkeypatch):
    monkeypatch.setattr(worker_processes, "_begin", lambda work: os._exit(1))
    with pytest.raises(RuntimeError, match="end before they solve anything"):
        outcomes(square, 4, 2)


def test_where_processes_start_afresh_functions_must_be_picklable(monkeypatch):
    spawn = multiprocessing.get_context("spawn")
    monkeypatch.setattr(multiprocessing, "get_context", lambda: spawn)
    with pytest.raises(TypeError, match=r"define them in a module, compile them .*workers=1"):
        outcomes(lambda i: i, 4, 2)
    assert outcomes(abs, 10, 2) == list(range(10))


# ----------------------------------------------------------------------------------------------------------------------
# Ensembles


def leaving(t, y, p):
    if p == 3:
        sys.exit("enough")
    return -y


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.filterwarnings("ignore::invariode.FailureWarning")
def test_sys_exit_fails_its_trajectory_whatever_the_number_of_workers(workers):
    out = iv.solve_ensemble(leaving, (0, 1), [1.0], args=[[k] for k in range(6)], workers=workers)
    assert out.status.tolist() == [0, 0, 0, -4, 0, 0]
    assert out.messages == {3: "SystemExit: enough"}


def interrupting(t, y, p):
    if p == 3:
        raise KeyboardInterrupt
    return -y


@pytest.mark.parametrize("workers", [1, 2])
def test_a_keyboard_interrupt_of_f_ends_all_whatever_the_number_of_workers(workers):
    with pytest.raises(KeyboardInterrupt):
        iv.solve_ensemble(interrupting, (0, 1), [1.0], args=[[k] for k in range(6)], workers=workers)


def ending(t, y, p):
    if p == 2:
        os._exit(3)
    return -y


def plain(t, y, p):
    return [-p * y[0]]


def through_another(t, y, p):
    return ending(t, y, p)


class Method:
    f = staticmethod(ending)

    def called(self, t, y, p):
        return ending(t, y, p)


ENDING = {
    "f": (ending, {}),
    "a function that f calls": (through_another, {}),
    "a method": (Method().called, {}),
    "an implicit method": (ending, {"method": "radau"}),
    "an event": (plain, {"events": lambda t, y, p: y[0] - 0.5 if p == 1 else ending(t, y, p)[0]}),
    "an action": (plain, {"events": iv.Event(lambda t, y, p: t - 0.5, action=ending)}),
    "a callback": (plain, {"callback": lambda t, y: os._exit(3) if y[0] < np.exp(-1.5) else None}),
    "an argument": (plain, {"args": [[1.0], [type("Fatal", (), {"__neg__": lambda self: os._exit(3)})()], [1.0]]}),
}


def all_survived(connection) -> None:
    """Send the status of the rows of each ensemble, of which the second ends its process."""
    for fun, options in ENDING.values():
        options = {"args": [[1.0], [2.0], [1.0]], "on_failure": "return", **options}
        connection.send(iv.solve_ensemble(fun, (0, 1), [1.0], **options).status.tolist())


def test_by_default_too_a_row_that_ends_its_process_does_not_end_the_caller():
    ours, theirs = multiprocessing.get_context("fork").Pipe()
    process = multiprocessing.get_context("fork").Process(target=all_survived, args=(theirs,))
    process.start()
    theirs.close()
    for name in ENDING:
        assert ours.poll(LIMIT), name
        assert ours.recv() == [0, -4, 0], name
    process.join(LIMIT)


def test_functions_that_only_calculate_are_called_in_this_process_while_that_takes_no_longer_than_to_start_others(
    monkeypatch,
):
    started = []
    monkeypatch.setattr(worker_processes._Workers, "_start", lambda self: started.append(self))
    out = iv.solve_ensemble(plain, (0, 1), [1.0], args=[[1.0], [2.0]], events=lambda t, y, p: y[0] - 0.5)
    alone = [iv.solve_ivp(plain, (0, 1), [1.0], args=(p,), keep="end") for p in (1.0, 2.0)]
    assert not started
    assert out.y_end.tolist() == [one.y[:, -1].tolist() for one in alone]
    assert out.stats.nfev.tolist() == [one.nfev for one in alone]


def in_a_daemon(connection) -> None:
    with pytest.warns(UserWarning, match="daemon=False"):
        out = iv.solve_ensemble(lambda t, y: -y, (0, 1), np.ones((6, 1)), workers=2)
    connection.send(out.y_end)


def test_a_daemonic_process_solves_alone_and_says_so():
    ours, theirs = multiprocessing.get_context("fork").Pipe()
    process = multiprocessing.get_context("fork").Process(target=in_a_daemon, args=(theirs,), daemon=True)
    process.start()
    assert ours.poll(LIMIT)
    expected = iv.solve_ensemble(lambda t, y: -y, (0, 1), np.ones((6, 1)), workers=1)
    np.testing.assert_array_equal(ours.recv(), expected.y_end)
    process.join(LIMIT)


# ----------------------------------------------------------------------------------------------------------------------
# Scripts of their own

FOREVER = """
    import os, signal, sys, threading, time
    import numpy as np, invariode as iv

    iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0])  # what is imported late is there

    def f(t, y):
        if t == 0:
            os.write(1, b"%d\\n" % os.getpid())
        time.sleep(0.01)
        return -y
"""

SLEEPING = (
    FOREVER
    + """
    iv.solve_ensemble(f, (0, 1e9), np.ones((4, 1)), max_step=0.01, workers=2)
"""
)

INTERRUPTED = (
    FOREVER
    + """
    try:
        threading.Timer(float(sys.argv[1]), os.kill, (os.getpid(), signal.SIGINT)).start()
        iv.solve_ensemble(f, (0, 1e9), np.ones((4, 1)), max_step=0.01, workers=2)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""
)


def script(folder: Path, text: str, *arguments: str, **options) -> subprocess.Popen[str]:
    file = folder / "script.py"
    file.write_text(textwrap.dedent(text))
    command = [sys.executable, str(file), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=["SIGKILL", "SIGTERM"])
def test_workers_do_not_outlive_their_parent(tmp_path, number):
    (tmp_path / "temporary").mkdir()
    process = script(tmp_path, SLEEPING, env={**os.environ, "TMPDIR": str(tmp_path / "temporary")})
    assert process.stdout is not None
    workers: set[int] = set()
    while len(workers) < 2:
        workers.add(int(process.stdout.readline()))
    assert list((tmp_path / "temporary").iterdir())
    process.send_signal(number)
    process.communicate(timeout=LIMIT)  # workers that live on keep its pipes open
    end = time.monotonic() + LIMIT
    while any(map(alive, workers)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(alive, workers))
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.parametrize("delay", [0, 0.01, 0.1])
def test_ctrl_c_is_heard_while_processes_start(tmp_path, delay):
    process = script(tmp_path, INTERRUPTED, str(delay), start_new_session=True)
    try:
        out, errors = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    assert out.endswith("interrupted\n")
    assert errors == ""


COMPILING = """
    import threading, time
    import numba, numpy as np, invariode as iv
    from numba.core.compiler_lock import global_compiler_lock

    compiling, over = threading.Event(), threading.Event()

    def compile_something():  # as it is in the middle of it
        with global_compiler_lock:
            compiling.set()
            time.sleep(1)
        over.set()

    @numba.njit
    def g(x):
        return -x

    threading.Thread(target=compile_something).start()
    compiling.wait()
    out = iv.solve_ensemble(lambda t, y: [g(y[0])], (0, 1), np.ones((4, 1)), workers=2)
    print(out.success.all())
"""


def test_a_fork_waits_for_the_compilations_of_other_threads(tmp_path):
    """g is compiled in the workers, who would wait for ever for a lock that they have inherited."""
    pytest.importorskip("numba")
    process = script(tmp_path, COMPILING, start_new_session=True)
    try:
        out, errors = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    assert (out, errors) == ("True\n", "")


FORKING = """
import os, threading, warnings
import numpy as np
import invariode as iv

warnings.simplefilter("ignore")

def made(i):
    def f(t, y):
        s = y[0]
        for j in range(60):
            s = s * 0.99 + np.sin(y[0] * (j + i)) * 1e-3
        return [-s]
    return iv.compile(f, by="trace")

def solved(i):
    return iv.solve_ivp(made(i), (0, 1e-3), [1.0])

solved(0)
children = []
for k in range(8):
    thread = threading.Thread(target=lambda: [solved(100 * k + i) for i in range(1, 3)])
    thread.start()
    threading.Event().wait(0.005 * k)
    child = os.fork()
    if child == 0:
        solved(10_000 + k)
        os._exit(0)
    children.append(child)
    thread.join()
print([os.waitpid(child, 0)[1] for child in children])
"""


def test_a_child_compiles_wherever_other_threads_of_its_parent_were_compiling(tmp_path):
    pytest.importorskip("llvmlite")
    process = script(tmp_path, FORKING, start_new_session=True)
    try:
        out, errors = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    assert (out, errors) == (f"{[0] * 8}\n", "")


def test_what_is_sent_is_small_enough_to_be_written_at_once():
    """A pipe takes as much as PIPE_BUF at once; a file's name, the executor's own words included, takes less."""
    select = pytest.importorskip("select")
    name = str(Path("/tmp") / "invariode-01234567" / str(10**9))
    assert len(pickle.dumps(name)) < select.PIPE_BUF / 4
