"""A run ends at its limits, says how far it came, and can go on from there; Ctrl-C may do the same."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families
from problems import PROBLEMS

KEPLER = PROBLEMS["Kepler"]
END = 20.0


def kepler(method, end=END, **options):
    return iv.solve_ivp(KEPLER.fun, (0, end), KEPLER.y0, method, rtol=1e-8, atol=1e-10, **options)


def circle(t, y):
    return [y[1], -y[0]]


@dealt(method=FAMILIES, keep=["all", "outputs", "end"], project=[False, True])
def test_max_steps_ends_the_run_where_the_unlimited_run_is_then(method, keep, project):
    about = {"keep": keep, "invariants": KEPLER.invariants() if project else None}
    whole, sol = kepler(method, **{**about, "keep": "all"}), kepler(method, max_steps=17, **about)
    assert (sol.status, sol.success, sol.stats.steps) == (-3, False, 17)
    assert sol.t_end == sol.t[-1] == whole.t[17]
    np.testing.assert_array_equal(sol.y[:, -1], whole.y[:, 17])
    assert f"max_steps = 17 is reached at t = {sol.t_end!r}" in sol.message
    assert f"{sol.t_end / END:.2%} of the interval" in sol.message
    assert "after 17 steps" in sol.message


@explicit_and_implicit
def test_the_limit_is_no_limit_where_the_run_ends_before(method):
    whole = kepler(method)
    assert (
        kepler(method, max_steps=whole.stats.steps, limits=iv.Limits(points=whole.stats.steps + 1, time=1e6)).status
        == 0
    )
    assert kepler(method, max_steps=whole.stats.steps - 1).status == -3


@explicit_and_implicit
def test_an_extension_has_the_limits_of_its_run_or_its_own(method):
    sol = kepler(method, max_steps=10, events=lambda t, y: y[1], dense_output=True)
    for parts in (2, 3):
        sol = sol.extend(END)
        assert (sol.status, sol.stats.steps) == (-3, 10 * parts)
    sol = sol.extend(END, max_steps=None)
    assert (sol.status, sol.t[-1]) == (0, END)
    np.testing.assert_allclose(sol.y[:, -1], KEPLER.solution(END), atol=5e-4)  # of ode23s
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)


@dealt(8, method=METHODS, end=[1e9, np.inf])
def test_time_limit(method, end):
    """Each call of f takes a while; the limit is checked after each attempt, which takes a few calls."""

    def slow(t, y):
        time.sleep(1e-3)
        return circle(t, y)

    start = time.perf_counter()
    sol = iv.solve_ivp(slow, (0, end), [1.0, 0.0], method, limits=iv.Limits(time=0.1), max_step=1.0)
    assert sol.status == -3
    assert "The limit of 0.1 s is over at t = " in sol.message
    assert 0.1 <= time.perf_counter() - start < 5


@families
def test_attempts_that_fail_are_no_way_round_the_time(method):
    def undefined_beyond_one(t, y):
        time.sleep(1e-3)
        return [np.nan if t > 1 else 1.0]

    sol = iv.solve_ivp(
        undefined_beyond_one, (0, 10), [0.0], method, limits=iv.Limits(time=0.01), first_step=1.5, max_step=2.0
    )
    assert sol.status == -3
    assert sol.t_end <= 1


@explicit_and_implicit
def test_the_limit_of_points_counts_what_is_kept(method):
    by_steps = kepler(method, limits=iv.Limits(points=50))
    assert by_steps.status == -3
    assert len(by_steps.t) == 50
    assert "50 points are kept" in by_steps.message
    refined = kepler(method, limits=iv.Limits(points=50), refine=4)
    assert refined.status == -3
    assert 50 <= len(refined.t) < 54
    dense = kepler(method, limits=iv.Limits(points=50), dense_output=True, t_eval=np.linspace(0, END, 3))
    assert dense.status == -3
    assert len(dense.sol.ts) == 50
    with_events = kepler(method, limits=iv.Limits(points=2), keep="end", events=lambda t, y: y[1])
    assert with_events.status == -3
    assert len(with_events.t_events[0]) == 1  # the other one is the final state
    assert kepler(method, limits=iv.Limits(points=2), keep="end").status == 0


@explicit_and_implicit
def test_what_is_kept_is_bounded_without_any_option(method, monkeypatch):
    """The bounds made small: as many points, or as much memory. A run over the interval of the one before has the
    bounds of that one, so the intervals differ."""
    from invariode._plan import planning

    monkeypatch.setattr(planning, "_MOST_POINTS", 40)
    assert kepler(method, END + 1).status == -3
    assert kepler(method, limits=iv.Limits(points=10**6)).status == 0
    asked_for = kepler(method, t_eval=np.linspace(0, END, 100))
    assert (asked_for.status, len(asked_for.t)) == (0, 100)
    monkeypatch.setattr(planning, "_MOST_POINTS", 10**7)
    monkeypatch.setattr(planning, "_MOST_BYTES", 4096)
    sol = kepler(method, END + 2)
    kept = sol.t.nbytes + sol.y.nbytes + sol.steps._rows.nbytes
    assert sol.status == -3
    assert "What is kept fills 4096 bytes, the most that the limits allow" in sol.message
    assert 4096 <= kept < 4096 + 2 * 80
    assert kepler(method, keep="end").status == 0


@pytest.fixture(scope="module")
def native_circle():
    pytest.importorskip("numba")
    return iv.compile(circle)


@pytest.fixture(scope="module")
def native_oscillator():
    pytest.importorskip("numba")
    return iv.compile(lambda t, y, p: [y[1], -p[0] * y[0]])


@explicit_and_implicit
def test_native_runs_end_at_their_limits(method, native_circle):
    sol = iv.solve_ivp(
        native_circle, (0, np.inf), [1.0, 0.0], method, max_step=0.1, limits=iv.Limits(time=0.05), keep="end"
    )
    assert sol.status == -3
    assert "The limit of 0.05 s" in sol.message
    assert sol.t_end > 1
    assert iv.solve_ivp(native_circle, (0, 1e9), [1.0, 0.0], method, max_step=0.1, max_steps=9).stats.steps == 9


@explicit_and_implicit
@pytest.mark.parametrize("native", [False, True])
def test_a_trajectory_of_an_ensemble_has_limits_of_its_own(method, native, native_oscillator):
    """The fast oscillations need more steps than the slow ones."""

    def oscillator(t, y, k):
        return [y[1], -k * y[0]]

    fun = native_oscillator if native else oscillator
    about = {"rtol": 1e-6, "atol": 1e-8, "max_steps": 60, "max_step": np.inf}
    sol = iv.solve_ensemble(
        fun, (0, 4), [1.0, 0.0], method, args=[[1e-2], [1e6]], workers=1, on_failure="return", **about
    )
    assert sol.status.tolist() == [0, -3]
    assert sol.messages[1].startswith("max_steps = 60 is reached at t = ")
    single = iv.solve_ivp(oscillator, (0, 4), [1.0, 0.0], method, args=(1e6,), **about)
    assert sol.t_end[1] == pytest.approx(single.t_end, rel=1e-12)


def test_a_memory_of_a_stiff_run_is_bounded():
    """van der Pol with mu = 1000 and explicit methods: the default bounds what they keep to less than a gigabyte."""
    from invariode._plan import planning

    per_step = 8 * (1 + 2 + 5)  # t, y, the record of the step
    assert planning._MOST_POINTS * per_step < 1e9


# ----------------------------------------------------------------------------------------------------------------------
# Ctrl-C


def interrupted_after(seconds):
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
    timer.daemon = True
    return timer


@dealt(8, method=METHODS, native=[False, True])
def test_ctrl_c_returns_what_there_is(method, native, native_circle):
    """The handler of the session is in force again afterwards, and the run can go on."""
    before = signal.getsignal(signal.SIGINT)
    interrupted_after(0.2).start()
    fun = native_circle if native else circle
    sol = iv.solve_ivp(fun, (0, np.inf), [1.0, 0.0], method, max_step=0.1, keep="end", on_interrupt="return")
    assert (sol.status, sol.success) == (2, True)
    assert sol.message == f"Ctrl-C stopped the integration at t = {sol.t_end!r}."
    assert signal.getsignal(signal.SIGINT) is before
    assert sol.extend(sol.t_end + 1, on_interrupt="raise").status == 0


@explicit_and_implicit
def test_ctrl_c_raises_unless_it_is_to_return(method):
    interrupted_after(0.2).start()
    with pytest.raises(KeyboardInterrupt):
        iv.solve_ivp(circle, (0, np.inf), [1.0, 0.0], method, max_step=0.1, keep="end")


@explicit_and_implicit
def test_a_second_ctrl_c_raises(method):
    """The present step does not come to its end."""

    def stuck(t, y):
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
        return circle(t, y)

    with pytest.raises(KeyboardInterrupt):
        iv.solve_ivp(stuck, (0, 1), [1.0, 0.0], method, on_interrupt="return")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@explicit_and_implicit
def test_in_another_thread_nothing_changes(method):
    found = []
    thread = threading.Thread(target=lambda: found.append(kepler(method, on_interrupt="return").status))
    thread.start()
    thread.join()
    assert found == [0]


WRONG = [
    ({"max_steps": 0}, ValueError, "max_steps must be a positive integer, got 0"),
    ({"max_steps": 1e6}, TypeError, r"max_steps must be a positive integer, got 1000000\.0"),
    ({"limits": 100}, TypeError, r"limits must be invariode.Limits\(...\), as in Limits\(steps=1000\), got 100"),
    ({"max_steps": 9, "limits": iv.Limits(steps=9)}, ValueError, "max_steps=9 is short for limits"),
    ({"on_interrupt": "stop"}, ValueError, "on_interrupt must be one of 'raise', 'return', got 'stop'"),
]


@pytest.mark.parametrize(("options", "error", "message"), WRONG)
def test_wrong_values_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        kepler("ode45", **options)


def test_classes_for_scipy_say_what_they_cannot():
    import invariode.scipy

    for name in ("max_steps", "limits", "on_interrupt"):
        with pytest.raises(TypeError, match=f"{name} is an option of solve_ivp, not of ODE45"):
            invariode.scipy.ODE45(circle, 0, [1.0, 0.0], 1, **{name: 1})


def endless(native):
    """Trajectories of which the even ones end at t = 1, by an event, and the others never."""

    def rate(t, y, k):
        return [k]

    def reached(t, y, k):
        return y[0] - 1

    if native:
        pytest.importorskip("llvmlite")
        rate, reached = iv.compile(rate, by="trace"), iv.compile(reached, by="trace")
    event = iv.Event(reached, terminal=True)
    return iv.Problem(rate, (0, 1e12), [0.0], args=(1.0,), events=event), [(1.0,), (0.0,)] * 10


@pytest.mark.parametrize(
    ("native", "workers", "from_iterator"),
    [(True, 2, False), (True, 2, True), (False, 1, True), (False, 2, False)],
)
def test_ctrl_c_keeps_the_finished_trajectories_of_an_ensemble(native, workers, from_iterator, monkeypatch):
    """The finished ones are those of an ensemble without the others; the others have status -128 and are NaN."""
    monkeypatch.setattr("invariode._base.progress.CALLS", 0.0)
    timer = interrupted_after(0.05)

    def once_some_are_solved(done, whole):
        if done and timer.ident is None:
            timer.start()

    problem, args = endless(native)
    if from_iterator:  # parts: the first ones end, another never does
        args = [(1.0,)] * 10 + [(0.0,)]
        given = {"y0": iter([([0.0], one) for one in args]), "chunk": 5}
    else:
        given = {"args": args}
        if not native:
            given["args"] = args = [*args[::2], *args[1::2]]
    options = {"workers": workers, "max_step": 0.01 if native else 1e-4, "first_step": 1e-4, **given}
    finished = np.array([k for (k,) in args]) == 1
    if not native:
        options["max_step"] = 0.1
    t_eval = [0.0, 0.5]
    with pytest.warns(UserWarning, match=r"Ctrl-C stopped the ensemble: \d+ of \d+ trajectories are solved"):
        many = problem.solve_ensemble(t_eval=t_eval, on_interrupt="return", progress=once_some_are_solved, **options)
    timer.join()
    solved = many.status != -128
    assert solved.any()
    assert not (solved & ~finished[: len(many)]).any()
    np.testing.assert_array_equal(many.status[solved], 1)
    np.testing.assert_allclose(many.y[solved, 0], [[0, 0.5]] * int(solved.sum()), atol=1e-12)
    assert np.isnan(many.y[~solved]).all()
    assert np.isnan(many.y_end[~solved]).all()
    assert many.failed.tolist() == np.flatnonzero(~solved).tolist()
    assert set(many.messages.values()) == {"not solved: Ctrl-C stopped the ensemble"}
    assert not many[int(np.flatnonzero(~solved)[0])].success


def interrupted_in_the_second():
    """The trajectories of `endless`, of which the second one presses Ctrl-C."""
    problem, args = endless(native=False)

    def rate(t, y, k):
        if k == 0 and t > 1:
            signal.raise_signal(signal.SIGINT)
        return [k]

    return problem.replace(fun=rate), args


def test_the_exception_of_ctrl_c_has_the_finished_trajectories():
    problem, args = interrupted_in_the_second()
    with pytest.raises(KeyboardInterrupt, match="1 of 20 trajectories are solved") as raised:
        problem.solve_ensemble(args=args, workers=1, max_step=0.1)
    assert raised.value.solution.status.tolist() == [1] + [-128] * 19


TERMINATED = """
    import os, signal, sys, threading, time
    import numpy as np
    import invariode as iv

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in `python job.py &` of a script

    def slow(t, y, rate):
        time.sleep(2e-3)
        return [-rate * y[0]]

    def after(seconds):
        threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM)).start()

    after(0.3)
    options = {"max_step": 0.01, "keep": "end", "checkpoint": sys.argv[1], "on_interrupt": "return"}
    print(iv.solve_ivp(slow, (0, np.inf), [1.0], args=(1.0,), **options).status)
    after(1.5)
    many = iv.solve_ensemble(slow, (0, 1), [1.0], args=np.ones((4096, 1)), workers=2, on_interrupt="return")
    print(np.unique(many.status).tolist())
    after(0.3)
    iv.solve_ivp(slow, (0, np.inf), [1.0], args=(1.0,), max_step=0.01, keep="end")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGTERM")
def test_sigterm_returns_too_where_ctrl_c_is_ignored(tmp_path):
    """A run, and an ensemble in processes with chunks of 256 trajectories of many milliseconds, of which workers send
    back what is finished. Without the option SIGTERM ends the process."""
    command = [sys.executable, "-c", textwrap.dedent(TERMINATED), tmp_path / "run"]
    job = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert job.stdout.split("\n") == ["2", "[-128, 0]", ""], job.stderr
    assert job.returncode == -signal.SIGTERM
    assert (tmp_path / "run").exists()


def test_the_exception_of_ctrl_c_has_the_store(tmp_path):
    pytest.importorskip("zarr")
    problem, args = interrupted_in_the_second()
    with pytest.raises(KeyboardInterrupt, match="1 of 20 trajectories are solved") as raised:
        problem.solve_ensemble(args=args, workers=1, max_step=0.1, chunk=1, store=tmp_path / "many.zarr")
    assert raised.value.solution.missing == 19


def test_progress_is_reported_to_a_function(monkeypatch):
    """Runs and ensembles report how much is done, and what the whole is, at the end in any case."""
    from invariode._base import progress

    monkeypatch.setattr(progress, "CALLS", 0.0)
    for of in (lambda t, y: [-y[0]], iv.compile(lambda t, y: [-y[0]], by="trace")):
        for span, whole in (((0, 3), 3.0), ((3, 0), 3.0)):
            heard = []
            sol = iv.solve_ivp(of, span, [1.0], progress=lambda *news, heard=heard: heard.append(news))
            assert heard[-1] == (whole, whole)
            assert [done for done, _ in heard] == sorted(done for done, _ in heard)
            np.testing.assert_array_equal(sol.y, iv.solve_ivp(of, span, [1.0]).y)
        heard = []
        iv.solve_ensemble(of, (0, 1), np.ones((30, 1)), workers=1, progress=lambda *news: heard.append(news))  # noqa: B023
        assert heard[-1] == (30, 30)
    heard = []
    iv.solve_ensemble(
        lambda t, y: [-y[0]], (0, 1), iter([([1.0], ())] * 7), chunk=3, progress=lambda *news: heard.append(news)
    )
    assert heard[-1] == (7, None)
    with pytest.raises(TypeError, match=r"progress must be True, False or a function progress\(done, total\), got 3"):
        iv.solve_ivp(circle, (0, 1), [1.0, 0.0], progress=3)

    def broken(done, total):
        raise ArithmeticError("from the function")

    with pytest.raises(ArithmeticError, match="from the function"):
        iv.solve_ivp(circle, (0, 1), [1.0, 0.0], progress=broken)


@pytest.mark.parametrize("method", ["ode15s", "radau"])
def test_a_factorisation_is_given_up_where_the_time_is_over_and_the_run_goes_on_with_that_attempt(method):
    """The time is over from the start: the first factorisation of the call ends at its first block of columns."""
    n = 513  # eliminated by LAPACK
    rates, u = -np.linspace(1, 100, n), np.random.default_rng(0).normal(size=(2, n)) / n
    problem = iv.Problem(
        lambda t, y: rates * y + u[0] * (u[1] @ y), (0, 1), np.ones(n), jac=np.diag(rates) + np.outer(*u)
    )
    whole = problem.solve(method, max_steps=6)
    sol = problem.solve(method, limits=iv.Limits(time=1e-9))
    assert (sol.status, sol.stats.steps, sol.stats.nlu) == (-3, 0, 0)
    assert "The limit of 1e-09 s is over" in sol.message
    sol = sol.extend(1, limits=iv.Limits(steps=2)).extend(1, limits=iv.Limits(time=1e-9))
    sol = sol.extend(1, max_steps=6 - sol.stats.steps, limits=None)
    assert dict(sol.stats) == dict(whole.stats)
    np.testing.assert_array_equal(sol.y, whole.y)
