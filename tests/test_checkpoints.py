"""A run that was interrupted goes on to the last bit, in this process or another, also one that was killed."""

from __future__ import annotations

import json
import random
import signal
import sys

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, dealt, explicit_and_implicit, families, families_and_series, hidden
from interrupted import differences, go_on, in_another_process, interrupt, killed, random_case

SEED = 18


def decay(t, y, rate=1.0):
    return [-rate * y[0]]


def problem(**changes):
    return iv.Problem(**{"fun": decay, "t_span": (0, 3), "y0": [1.0], "args": (2.0,), **changes})


@dealt(method=METHODS, seed=range(SEED, SEED + 3))
def test_it_goes_on_as_if_it_had_not_been_interrupted(method, seed, tmp_path):
    case = random_case(seed, method)
    whole, part = case.solve(), case.solve(max_steps=case.after)
    assert not differences(whole, part.extend(whole.t_end, max_steps=None))
    part.save(tmp_path / "run.npz")
    assert not differences(whole, go_on(case, tmp_path / "run.npz"))


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # of random problems without breakpoints
def test_in_another_process(tmp_path):
    methods = {SEED + 100 + k: name for k, name in enumerate(METHODS)}
    cases = {seed: random_case(seed, name) for seed, name in methods.items()}
    for seed, case in cases.items():
        interrupt(case, tmp_path / f"{seed}.npz")
    in_another_process(list(cases), tmp_path, methods)
    for seed, case in cases.items():
        other = iv.load(tmp_path / f"{seed}-on.npz", case.problem(), **case.functions)
        assert not differences(case.solve(), other), case.method


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_a_killed_run_is_not_lost(tmp_path):
    rng = random.Random(SEED)
    for seed in (5, 8):
        assert killed(seed, tmp_path / f"{seed}.checkpoint", rng) in ("whole", "not begun")


@families_and_series
def test_checkpoints_change_nothing_and_hold_all(method, tmp_path):
    case = random_case(SEED + 7, method)
    whole = case.solve()
    path = tmp_path / "run.checkpoint"
    assert not differences(whole, case.solve(checkpoint=iv.Checkpoint(path, every=5e-3)))
    assert not differences(whole, iv.load(path, case.problem(), **case.functions))


def test_where_no_checkpoint_can_be(tmp_path):
    case = random_case(SEED, "ode45")
    with pytest.raises(IsADirectoryError, match=r"checkpoint: .* is a folder: give the name of a file in it"):
        problem().solve(checkpoint=tmp_path)
    with pytest.raises(FileNotFoundError, match=r"checkpoint: there is no folder .*nowhere: make it"):
        case.solve(checkpoint=tmp_path / "nowhere" / "run.checkpoint")


@families
@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")
def test_between_two_attempts_of_a_step(method):
    """The limit of time is checked after each attempt, also one that failed."""

    def corner(t, y):
        return [y[1], -abs(y[0]) - 0.1 * y[1] + (3.0 if t > 1.3 else 0.0)]

    def solve(**more):
        return iv.solve_ivp(hidden(corner), (0, 4), [1.0, 0.0], method, rtol=1e-6, atol=1e-8, **more)

    whole, sol = solve(), solve(limits=iv.Limits(time=1e-12))
    assert whole.stats.failed > 0
    parts = 1
    while sol.status == -3:
        sol = sol.extend(4)
        parts += 1
    assert parts >= whole.stats.steps + whole.stats.failed  # the last step ends the run
    assert not differences(whole, sol)


@explicit_and_implicit
def test_the_checkpoint_does_not_grow_with_the_run(method, tmp_path):
    sizes = []
    for end in (1, 30):
        path = tmp_path / f"{end}.checkpoint"
        about = iv.Problem(lambda t, y: [y[1], -y[0]], (0, end), [1.0, 0.0])
        sol = about.solve(method, rtol=1e-8, atol=1e-10, checkpoint=path)
        sizes.append((sol.stats.steps, path.stat().st_size))
    assert sizes[1][0] > 2 * sizes[0][0]
    assert sizes[1][1] < sizes[0][1] + 200  # digits of the counts


@families_and_series
def test_an_extension_goes_on_writing(method, tmp_path):
    path = tmp_path / "run.checkpoint"
    first = problem().solve(method, checkpoint=path, dense_output=True)
    longer = first.extend(5)
    assert not differences(longer, iv.load(path, problem()))
    again = iv.load(path, problem())
    assert not differences(longer.extend(7), again.extend(7))
    problem().solve(method, checkpoint=path)  # that run has ended: another may take its place
    with pytest.raises(ValueError, match="now belongs to another run"):
        longer.extend(8)


def test_a_run_that_has_not_ended_is_not_overwritten(tmp_path):
    path = tmp_path / "run.checkpoint"

    def fails(t, y):
        if t > 1:
            raise RuntimeError("the power fails")
        return [-y[0]]

    with pytest.raises(RuntimeError, match="power"):
        iv.solve_ivp(fails, (0, 3), [1.0], checkpoint=iv.Checkpoint(path, every=1e-9))
    with pytest.raises(ValueError, match=r"holds a run that has come to t = 0\.\d+ and has not ended: go on with load"):
        iv.solve_ivp(fails, (0, 3), [1.0], checkpoint=path)
    cured = iv.Problem(lambda t, y: [-y[0]], (0, 3), [1.0])
    with pytest.raises(ValueError, match=r"the code of fun is not that of the run\..* load\(\.\.\., trust=.code.\)"):
        iv.load(path, cured)
    sol = iv.load(path, cured, trust="code")
    assert (sol.status, sol.success) == (-3, False)
    assert not differences(iv.solve_ivp(lambda t, y: [-y[0]], (0, 3), [1.0]), sol.extend(3))
    (tmp_path / "mine.txt").write_text("not yours")
    with pytest.raises(ValueError, match=r"mine\.txt was not written by a run with checkpoint="):
        iv.solve_ivp(decay, (0, 3), [1.0], checkpoint=tmp_path / "mine.txt")


def test_only_a_run_that_has_come_to_an_end_makes_room_for_another(tmp_path):
    """Its end is that of the interval or a terminal event: a run that a limit, a callback or Ctrl-C has stopped is
    refused, loses nothing, and can go on to its end."""
    once = iter([False, False, True])
    stops = {"callback": lambda t, y: t > 1}
    presses = {"callback": lambda t, y: next(once, False) and signal.raise_signal(signal.SIGINT)}
    ways = [({}, 0), ({"max_steps": 2}, -3), (stops, 2), ({**presses, "on_interrupt": "return"}, 2), ({}, 1)]
    halves = iv.Event(lambda t, y, rate: y[0] - 0.5, terminal=True)
    for number, (options, status) in enumerate(ways):
        path, asked = tmp_path / str(number), problem(events=halves if status == 1 else None)
        first = asked.solve(checkpoint=path, **options)
        assert first.status == status
        if status in (0, 1):
            assert problem(args=(3.0,)).solve(checkpoint=path).success
            continue
        with pytest.raises(ValueError, match=r"has not ended: go on with load.* --resume in the command, or delete it"):
            asked.solve(checkpoint=path, max_steps=1)
        kept = iv.load(path, asked, callback=options.get("callback"))
        assert not differences(first, kept)
        kept.extend(3, max_steps=None, callback=None)
        assert asked.solve(checkpoint=path).success  # now it has ended


def test_events_at_the_start_are_in_it(tmp_path):
    event = iv.Event(lambda t, y, rate: y[0] - 1, at_start=True)
    whole = problem(events=event).solve(checkpoint=tmp_path / "c")
    assert len(whole.t_events[0]) == 1
    assert not differences(whole, iv.load(tmp_path / "c", problem(events=event)))


OTHER = {
    "args": (dict(args=(3.0,)), r"args: \[3\.0\] here, \[2\.0\] in the file"),
    "f": (dict(fun=lambda t, y, rate: [rate * y[0]]), r"fun at the start: \[2\.0\] here, \[-2\.0\] in the file"),
    "y0": (dict(y0=[1.5]), r"y0: \[1\.5\] here"),
    "t0": (dict(t_span=(1, 3)), "t0: 1.0 here, 0.0 in the file"),
    "size": (dict(fun=lambda t, y, rate: [1, 2], y0=[1.0, 2.0]), "components: 2 here, 1 in the file"),
    "event": (dict(events=lambda t, y, rate: y[0]), "events"),
    "bounds": (dict(nonnegative=True), "bounds"),
    "invariant": (dict(invariants=lambda t, y, rate: y[0] * np.exp(rate * t)), "invariants"),
}


@dealt(kind=["saved", "checkpoint"], what=OTHER)
def test_the_file_of_another_problem_is_refused_by_what_differs(kind, what, tmp_path):
    sol = problem().solve(checkpoint=tmp_path / "checkpoint")
    sol.save(tmp_path / "saved")
    changes, message = OTHER[what]
    with pytest.raises(ValueError, match=rf"{kind} cannot go on here: the file belongs to another problem: {message}"):
        iv.load(tmp_path / kind, problem(**changes))


def test_other_options_are_refused(tmp_path):
    def jump(t, y, rate):
        return [2.0]

    problem().solve(rtol=1e-5).save(tmp_path / "a")
    assert iv.load(tmp_path / "a", problem(), rtol=1e-5).extend(4).success
    with pytest.raises(ValueError, match=r"rtol = 0\.001 differs from 1e-05 in the file"):
        iv.load(tmp_path / "a", problem(), rtol=1e-3)
    with pytest.raises(ValueError, match=r"rtol is an option of the run, .* give problem too"):
        iv.load(tmp_path / "a", rtol=1e-3)
    problem().solve(breakpoints=[(1, jump)], callback=lambda t, y: False).save(tmp_path / "b")
    with pytest.raises(ValueError, match=r"the run has breakpoints with functions, .* give breakpoints=\.\.\. too"):
        iv.load(tmp_path / "b", problem(), callback=lambda t, y: False)
    with pytest.raises(ValueError, match=r"breakpoints are at \[2\.0\] here, and at \[1\.0\] in the file"):
        iv.load(tmp_path / "b", problem(), callback=lambda t, y: False, breakpoints=[(2, jump)])
    assert iv.load(tmp_path / "b", problem(), callback=lambda t, y: False, breakpoints=[(1, jump)]).extend(4).success


def test_the_members_of_auto_are_in_the_file(tmp_path):
    pair = {"prefer": ("ode45", "radau")}
    whole, part = problem().solve("auto", **pair), problem().solve("auto", max_steps=5, **pair)
    part.save(tmp_path / "run")
    assert not differences(whole, iv.load(tmp_path / "run", problem(), **pair).extend(3, max_steps=None))
    with pytest.raises(ValueError, match=r"prefer = \('ode78', 'radau'\) differs from \['ode45', 'radau'\] in"):
        iv.load(tmp_path / "run", problem(), prefer=("ode78", "radau"))


def changed(path, **about):
    with np.load(path) as archive:
        arrays = dict(archive)
    now = json.loads(str(arrays["about"]))
    for name, value in about.items():
        now[name] = value
    with open(path, "wb") as file:
        np.savez(file, **arrays | {"about": np.array(json.dumps(now))})


def told(path):
    """Return the header of a state file."""
    with np.load(path) as archive:
        return json.loads(str(archive["about"]))


def test_other_versions_are_refused_by_their_number(tmp_path):
    path = tmp_path / "run.checkpoint"
    problem().solve(checkpoint=path)
    changed(path, memory_version=99)
    with pytest.raises(ValueError, match="has version 99 of the memory of a run"):
        iv.load(path, problem())
    changed(path, version=99, invariode="9.9")
    with pytest.raises(
        ValueError, match=r"kind 'checkpoint' in version 99 of the format, written by invariode 9\.9; .* upg"
    ):
        iv.load(path, problem())


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "run.checkpoint"
    problem().solve(checkpoint=iv.Checkpoint(path, every=1e-9), dense_output=True)
    (output,) = tmp_path.glob("run.checkpoint.output-*")
    with pytest.raises(ValueError, match="is a checkpoint, which needs its problem"):
        iv.load(path)
    whole = {one: one.read_bytes() for one in (path, output)}
    rng = random.Random(SEED)
    for one, contents in whole.items():
        for _ in range(12):
            at = rng.randrange(len(contents))
            one.write_bytes(contents[:at] + bytes([contents[at] ^ 0x55]) + contents[at + 1 :])
            try:
                again = iv.load(path, problem())
            except ValueError as refused:
                assert "run.checkpoint" in str(refused)
            else:  # a byte that nobody reads, such as a date in the archive
                assert again.t_end == 3
        one.write_bytes(contents[: len(contents) // 2])
        with pytest.raises(ValueError, match=r"is damaged|is incomplete|is shorter"):
            iv.load(path, problem())
        one.write_bytes(contents)
    output.write_bytes(whole[output] + b"what a killed process has left")
    assert iv.load(path, problem()).success
    output.unlink()
    with pytest.raises(
        ValueError, match=r"is half of a checkpoint: .*\.output-\w+ with the output of the run is missing"
    ):
        iv.load(path, problem())


@pytest.mark.parametrize(("dense_output", "order"), [
    (False, [0, 2, 3]), (False, [0, 1, 1, 2, 3]), (True, [0, 1, 3, 2]), (True, [0, 1, 1, 3]),
], ids=str)  # fmt: skip
def test_the_parts_of_the_output_are_all_there_and_those_of_continuous_output_in_order(dense_output, order, tmp_path):
    """Behind right checksums."""
    path = tmp_path / "run.checkpoint"
    problem().solve(checkpoint=iv.Checkpoint(path, every=1e-9), dense_output=dense_output, max_steps=4)
    (output,) = tmp_path.glob("run.checkpoint.output-*")
    whole, parts = output.read_bytes(), []
    start = at = whole.index(b"\n") + 1
    while at < len(whole):
        size = 12 + int.from_bytes(whole[at : at + 8], "little")
        parts.append(whole[at : at + size])
        at += size
    assert len(parts) >= 4
    output.write_bytes(whole[:start] + b"".join(parts[i] for i in [*order, *range(4, len(parts))]))
    changed(path, length=output.stat().st_size)
    with pytest.raises(ValueError, match=r"is damaged: ValueError: (it has \d+ parts, and|the parts of the contin)"):
        iv.load(path, problem())


@pytest.mark.parametrize(("options", "error", "message"), [
    ({"checkpoint": 3}, TypeError, "checkpoint must be a str or path-like, got 3"),
])  # fmt: skip
def test_wrong_options(options, error, message):
    with pytest.raises(error, match=message):
        problem().solve(**options)


def test_wrong_arguments_of_load(tmp_path):
    problem().solve().save(tmp_path / "a")
    with pytest.raises(TypeError, match=r"got .*; invariants are given by name.*Problem\(fun, t_span, y0\)"):
        iv.load(tmp_path / "a", lambda t, y: y)
    with pytest.raises(ValueError, match="invariants and args are those of the problem"):
        iv.load(tmp_path / "a", problem(), invariants=lambda t, y: y)
    with pytest.raises(ValueError, match=r"comes from a file, .* load\(path, problem\)"):
        iv.load(tmp_path / "a").extend(4)


@pytest.mark.parametrize("every", [1e9, 1e300, np.inf])
def test_intervals_longer_than_any_clock_counts_write_at_the_start_and_at_the_end(every, tmp_path):
    """The start and the end of each run: nanoseconds in 64 bits are 9.2e9 s."""
    path = tmp_path / "run"
    steps = problem().solve(checkpoint=iv.Checkpoint(path, every=every), max_steps=4).stats.steps
    assert steps == 4
    assert told(path)["sequence"] == 2
    assert iv.load(path, problem()).extend(3, max_steps=None).stats.steps > steps + 2
    assert told(path)["sequence"] <= 4


@pytest.mark.parametrize("every", [np.nan, -1.0, -np.inf, 0])
def test_an_interval_is_positive(every, tmp_path):
    with pytest.raises(ValueError, match="every of Checkpoint must "):
        iv.Checkpoint(tmp_path / "run", every=every)


def test_an_extension_writes_as_often_as_its_run(tmp_path):
    problem().solve(checkpoint=iv.Checkpoint(tmp_path / "run", every=7.0), max_steps=2)
    for every, given in ((7.0, {}), (9.0, {"checkpoint": iv.Checkpoint(tmp_path / "run", every=9.0)})):
        assert iv.load(tmp_path / "run", problem(), **given)._origin.source.options["checkpoint"].every == every
