"""Files that several runs meet: nobody's files are touched, one run at a time, and a killed one leaves what goes on."""

from __future__ import annotations

import errno
import os
import random
import signal
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest

import invariode as iv
import meetings
from interrupted import differences

SEED = 25

needs_signals = pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
needs_modes = pytest.mark.skipif(os.name != "posix", reason="there are no modes")


def decay(t, y, rate=1.0):
    return [-rate * y[0]]


def problem(**changes):
    return iv.Problem(**{"fun": decay, "t_span": (0, 3), "y0": [1.0], "args": (2.0,), **changes})


class PowerError(Exception):
    """The error of a failing disk."""


def fails(t, y, rate):
    if t > 1:
        raise PowerError
    return [-rate * y[0]]


def interrupted(path, **options):
    with pytest.raises(PowerError):
        problem(fun=fails).solve(checkpoint=iv.Checkpoint(path, every=1e-9), **options)


def names(folder):
    return sorted(one.name.partition(".output-")[0] for one in folder.iterdir())


# ----------------------------------------------------------------------------------------------------------------------
# Files of others


def test_files_of_others_are_not_touched(tmp_path):
    token = "0123456789abcdef"
    mine = ["sim.output", "sim.output2", "sim.lock", f"sim.output-{token}", "sim.output-x", ".sim.tmp"]
    for name in mine:
        (tmp_path / name).write_bytes(name.encode())
    for _ in range(2):
        problem().solve(checkpoint=tmp_path / "sim").extend(4)
    for name in mine:
        assert (tmp_path / name).read_bytes() == name.encode()
    assert len(names(tmp_path)) == len(mine) + 2


def test_a_folder_or_a_lock_of_others_is_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        problem().solve(checkpoint=tmp_path / "folder")
    (tmp_path / ".sim.invariode-lock").write_text("mine")
    with pytest.raises(ValueError, match=r"checkpoint: the file .*\.sim\.invariode-lock is there, and is not a lock"):
        problem().solve(checkpoint=tmp_path / "sim")
    assert (tmp_path / ".sim.invariode-lock").read_text() == "mine"


def test_what_killed_runs_have_left_is_removed_by_the_next(tmp_path):
    path = tmp_path / "sim"
    problem().solve(checkpoint=path)
    token = "0123456789abcdef"
    for begun in (b"", b"invariode out", b"invariode output " + token.encode() + b"\nand more"):
        (tmp_path / f"sim.output-{token}").write_bytes(begun)
        (tmp_path / ".sim.0123abcd.invariode-part").write_bytes(begun)
        problem().solve(checkpoint=path)
        assert names(tmp_path) == ["sim", "sim"]


@needs_modes
def test_a_rerun_keeps_the_mode_of_both_files(tmp_path):
    path = tmp_path / "sim"
    problem().solve(checkpoint=path)
    path.chmod(0o600)
    problem().solve(checkpoint=path)
    assert {one.stat().st_mode & 0o777 for one in tmp_path.iterdir()} == {0o600}


# ----------------------------------------------------------------------------------------------------------------------
# One run at a time


def locked_out(path):
    return rf"checkpoint: .*{path.name} is in use by process {os.getpid()} \(this process\) on .*: wait until"


def test_a_second_run_is_told_who_has_the_checkpoint_before_it_computes(tmp_path):
    path, calls, told = tmp_path / "sim", [], []

    def counted(t, y, rate):
        calls.append(t)
        return decay(t, y, rate)

    def second(t, y):
        before = len(calls)
        with pytest.raises(ValueError, match=locked_out(path)):
            problem(fun=counted).solve(checkpoint=path)
        with pytest.raises(ValueError, match=locked_out(path)):
            iv.load(path, problem(), callback=second).extend(3)
        told.append(len(calls) - before)
        return False

    whole = problem().solve(checkpoint=iv.Checkpoint(path, every=1e-9), callback=second)
    assert told
    assert set(told) == {0}
    assert not differences(whole, iv.load(path, problem(), callback=second))


def test_threads_are_told_too(tmp_path):
    path, outcomes = tmp_path / "sim", []
    both = threading.Barrier(2)

    def together():
        first = True

        def wait(t, y):
            nonlocal first
            if first:
                first = False
                both.wait(10)
            return False

        try:
            outcomes.append(problem().solve(checkpoint=path, callback=wait).success)
        except ValueError as refused:
            outcomes.append(str(refused))
            both.wait(10)

    threads = [threading.Thread(target=together) for _ in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert sorted(map(str, outcomes))[0] == "True"
    assert "is in use by process" in sorted(map(str, outcomes))[1]


@pytest.mark.parametrize("ends", ["well", "with an exception"])
def test_the_lock_ends_with_the_run(ends, tmp_path):
    path = tmp_path / "sim"
    if ends == "well":
        problem().solve(checkpoint=path)
    else:
        interrupted(path)
    assert names(tmp_path) == ["sim", "sim"]
    assert iv.load(path, problem(), trust="code").extend(4).success
    assert names(tmp_path) == ["sim", "sim"]


@needs_signals
def test_the_lock_of_a_killed_process_is_free(tmp_path):
    code = (
        "import os, signal, invariode as iv\n"
        "def f(t, y):\n"
        "    if t > 1: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return [-y[0]]\n"
        "if os.fork() == 0: iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0])\n"
        "else: iv.solve_ivp(f, (0, 3), [1.0], checkpoint=iv.Checkpoint('sim', every=1e-9))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path)
    assert done.returncode == -signal.SIGKILL
    assert ".sim.invariode-lock" in os.listdir(tmp_path)
    plain = iv.Problem(lambda t, y: [-y[0]], (0, 3), [1.0])
    sol = iv.load(tmp_path / "sim", plain, trust="code").extend(3)
    assert not differences(sol, plain.solve())
    assert names(tmp_path) == ["sim", "sim"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_child_does_not_hold_the_lock_of_its_parent(tmp_path):
    path, children = tmp_path / "sim", []

    def forks(t, y):
        if not children:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of fork with threads
                children.append(os.fork())
            if children == [0]:
                signal.pause()
        return False

    try:
        problem().solve(checkpoint=path, callback=forks)
        assert problem().solve(checkpoint=path).success
    finally:
        os.kill(children[0], signal.SIGKILL)
        os.waitpid(children[0], 0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_of_two_processes_that_continue_a_run_after_a_fork_the_first_writes_its_checkpoint(tmp_path):
    path, children = tmp_path / "sim", []

    def forks(t, y):
        if t > 1 and not children:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of fork with threads
                children.append(os.fork())
        return False

    wrong = None
    try:
        sol = problem().solve(checkpoint=iv.Checkpoint(path, every=1e-9), callback=forks)
    except ValueError as error:
        wrong = error
    if children == [0]:
        os._exit(42 if "this one was forked from it" in str(wrong) else 1)
    assert wrong is None
    assert os.waitstatus_to_exitcode(os.waitpid(children[0], 0)[1]) == 42
    found = iv.load(path, problem(), callback=None)
    assert not differences(sol, found)


def test_where_there_are_no_locks_a_run_stops_before_it_writes_over_another(tmp_path, monkeypatch):
    monkeypatch.setattr("invariode._base.locks._locked", lambda file: False)
    path = tmp_path / "sim"

    def meddles(t, y):
        if t > 1:
            path.unlink(missing_ok=True)
            problem().solve(checkpoint=path)
        return False

    with (
        pytest.warns(UserWarning, match=r"the file system of .* has no locks: make sure that no other process"),
        pytest.raises(ValueError, match=r"another process has written .* while this run went on, which stops here"),
    ):
        problem().solve(checkpoint=iv.Checkpoint(path, every=1e-9), callback=meddles)
    assert not differences(problem().solve(), iv.load(path, problem()))


def test_what_another_process_has_added_is_not_undone(tmp_path, monkeypatch):
    path = tmp_path / "sim"
    half = problem().solve(checkpoint=path, max_steps=4)
    monkeypatch.setattr("invariode._files.checkpoint._SESSION", "another one")
    iv.load(path, problem()).extend(3, max_steps=None)
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"another process has continued .*, to t = 3\.0: load it again"):
        half.extend(3, max_steps=None)
    assert iv.load(path, problem()).t_end == 3


def test_every_part_of_the_output_must_be_of_the_run(tmp_path):
    for name in ("a", "b"):
        problem().solve(checkpoint=iv.Checkpoint(tmp_path / name, every=1e-9))
    first, second = sorted(tmp_path.glob("*.output-*"))
    whole, other = first.read_bytes(), second.read_bytes()
    head = whole.index(b"\n") + 1
    assert len(whole) == len(other)
    size = 12 + int.from_bytes(whole[head : head + 8], "little")  # of the part with the identity
    for mixed in (other[:head] + whole[head:], whole[: head + size] + other[head + size :]):
        first.write_bytes(mixed)
        with pytest.raises(ValueError, match=r"belongs to another run than|it has parts of another run"):
            iv.load(tmp_path / "a", problem())


@needs_signals
@pytest.mark.parametrize("trial", [meetings.together, meetings.rerun])
def test_processes_that_meet_lose_nothing(trial, tmp_path):
    """``tests/meetings.py`` is the campaign."""
    assert not trial(tmp_path / "sim", random.Random(SEED)).startswith("wrong")


# ----------------------------------------------------------------------------------------------------------------------
# Stores


@needs_signals
@pytest.mark.parametrize("count", [0, 20])
def test_a_store_that_was_killed_as_it_was_made_goes_on(count, tmp_path):
    pytest.importorskip("zarr")
    assert meetings.store(tmp_path / "sim", random.Random(SEED), count) == "killed"


def solve_into(store, **options):
    given = {"t_eval": [1.0, 2.0], "args": [[1.0], [2.0], [3.0], [4.0]], "workers": 1, "chunk": 2}
    return iv.solve_ensemble(decay, (0, 2), [1.0], store=store, **{**given, **options})


def test_a_part_that_was_half_written_is_missing(tmp_path):
    zarr = pytest.importorskip("zarr")
    whole = solve_into(tmp_path / "store").load()
    group = zarr.open_group(tmp_path / "store", mode="r+")
    group["digest"][1] = 0
    assert iv.EnsembleStore(tmp_path / "store").missing == 2
    with pytest.raises(ValueError, match="2 trajectories are not solved yet"):
        iv.EnsembleStore(tmp_path / "store").load()
    np.testing.assert_array_equal(solve_into(tmp_path / "store", resume=True).load().y, whole.y)


def test_a_store_that_was_growing_goes_on(tmp_path):
    zarr = pytest.importorskip("zarr")
    rows = [([1.0], (rate,)) for rate in (1.0, 2.0, 3.0, 4.0, 5.0)]
    more = {"t_eval": [1.0, 2.0], "workers": 1, "chunk": 2, "store": tmp_path / "store"}
    whole = iv.solve_ensemble(decay, (0, 2), iter(rows), **more).load()
    group = zarr.open_group(tmp_path / "store", mode="r+")
    group["digest"][2] = 0
    group["correction"].resize((4,))
    again = iv.solve_ensemble(decay, (0, 2), iter(rows), **more, resume=True).load()
    np.testing.assert_array_equal(again.y, whole.y)


def test_a_second_process_is_told_who_fills_the_store(tmp_path):
    pytest.importorskip("zarr")
    from invariode._base.locks import Lock

    lock = Lock(tmp_path / "store", "store")
    with pytest.raises(ValueError, match=r"store: .*store is in use by process \d+ \(this process\) on"):
        solve_into(tmp_path / "store")
    lock.release()
    assert len(solve_into(tmp_path / "store")) == 4
    assert os.listdir(tmp_path) == ["store"]


def test_a_folder_of_others_does_not_become_a_store(tmp_path):
    pytest.importorskip("zarr")
    (tmp_path / "store").mkdir()
    assert len(solve_into(tmp_path / "store")) == 4  # it was empty
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "data").write_text("mine")
    with pytest.raises(ValueError, match="mine is there, and is not a store of an ensemble: give another name"):
        solve_into(tmp_path / "mine")
    assert os.listdir(tmp_path / "mine") == ["data"]


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    """The error says which file could not be written, and the folder has no remains of it."""
    sol = iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0])
    if os.path.exists("/dev/full"):
        with pytest.raises(OSError, match="'/dev/full'"):
            sol.save("/dev/full")

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match=r"'.*run\.npz'") as raised:
        sol.save(tmp_path / "run.npz")
    assert raised.value.errno == errno.ENOSPC
    assert not [*tmp_path.iterdir()]
