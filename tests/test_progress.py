"""Long runs: `progress=True` tells where they are, and with `t_eval` or keep="end" memory does not grow with them."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import textwrap
import types
from contextlib import nullcontext

import numpy as np
import pytest

import invariode as iv
from cases import explicit_and_implicit
from invariode._base import progress
from problems import PROBLEMS

pytest.importorskip("rich")


@explicit_and_implicit
@pytest.mark.parametrize("t_span", [(0, 20), (20, 0)])
def test_a_bar_with_t_and_h_that_ends_where_the_run_does(method, t_span, capsys):
    problem = PROBLEMS["Kepler"]
    plain = iv.solve_ivp(problem.fun, t_span, problem.y0, method)
    assert capsys.readouterr() == ("", "")
    sol = iv.solve_ivp(problem.fun, t_span, problem.y0, method, progress=True)
    np.testing.assert_array_equal(sol.y, plain.y)
    out, err = capsys.readouterr()
    assert out == ""
    assert "100%" in err
    assert f"t = {t_span[1]}" in err
    assert "h = " in err


@explicit_and_implicit
def test_the_bar_of_an_extension_is_over_its_interval(method, capsys):
    sol = iv.solve_ivp(lambda t, y: -y, (0, 10), [1.0], method)
    sol.extend(12, progress=True)
    err = capsys.readouterr().err
    assert "t = 12" in err
    assert "100%" in err


@explicit_and_implicit
def test_an_infinite_interval_has_no_percentage(method, capsys):
    stop = iv.Event(lambda t, y: t - 5, terminal=True)
    iv.solve_ivp(lambda t, y: -y, (0, np.inf), [1.0], method, events=stop, progress=True)
    err = capsys.readouterr().err
    assert "t = 5" in err
    assert "%" not in err


@pytest.fixture(params=["python", "native"])
def oscillator(request):
    if request.param == "python":
        return lambda t, y: [y[1], -y[0]]
    pytest.importorskip("numba")
    return iv.compile(lambda t, y: (y[1], -y[0]))


def test_updates_are_few_and_the_last_one_is_the_end(monkeypatch, oscillator):
    """Updates follow a clock, not the steps: twenty steps take far less than the tenth of a second between updates."""
    from rich.progress import Progress

    updates: list[float] = []
    monkeypatch.setattr(Progress, "update", lambda self, task, **fields: updates.append(fields["t"]))
    sol = iv.solve_ivp(oscillator, (0, 5000), [1.0, 0.0], rtol=1e-8, keep="end", progress=True)
    assert updates == sorted(updates)
    assert updates[-1] == 5000
    assert len(updates) <= 1 + sol.stats.steps / 20


def test_updates_come_while_the_run_goes_on(monkeypatch, oscillator):
    """An endless run, which the third update ends."""
    from rich.progress import Progress

    class EnoughError(Exception):
        pass

    updates: list[float] = []

    def update(self, task, **fields):
        updates.append(fields["t"])
        if len(updates) == 3:
            raise EnoughError

    monkeypatch.setattr(Progress, "update", update)
    with pytest.raises(EnoughError):
        iv.solve_ivp(oscillator, (0, 1e12), [1.0, 0.0], rtol=1e-8, keep="end", progress=True)
    assert 0 < updates[0] < updates[1] < updates[2] < 1e12


class Clock:
    """A clock for the bar, in place of the machine's."""

    def __init__(self, monkeypatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(progress, "perf_counter", lambda: self.now)


def on_a_terminal(monkeypatch) -> io.StringIO:
    from rich import console

    screen, real = io.StringIO(), console.Console
    monkeypatch.setattr(console, "Console", lambda **_: real(file=screen, force_terminal=True, width=80))
    return screen


def pictures(monkeypatch, clock: Clock) -> list[float]:
    """Times at which the bar is drawn."""
    from rich.progress import Progress

    drawn: list[float] = []
    real = Progress.update

    def update(self, task, *, refresh=False, **fields):
        if refresh:
            drawn.append(clock.now)
        real(self, task, refresh=refresh, **fields)

    monkeypatch.setattr(Progress, "update", update)
    return drawn


@pytest.mark.parametrize("passing", [False, True])
def test_bars_are_drawn_at_most_ten_times_a_second_and_in_passing_not_at_first(monkeypatch, passing):
    on_a_terminal(monkeypatch)
    clock = Clock(monkeypatch)
    drawn = pictures(monkeypatch, clock)
    with progress.in_passing() if passing else nullcontext(), progress.bar(True, "trajectories", 2000) as told:
        for done in range(2000):
            clock.now = done / 1000
            told(done)
    assert min(np.diff(drawn)) >= progress.INTERVAL - 1e-9
    assert len(drawn) > 10
    assert drawn[0] == (progress.DELAY if passing else 0)


def test_a_bar_in_passing_leaves_the_screen_as_it_was(monkeypatch):
    screen, clock = on_a_terminal(monkeypatch), Clock(monkeypatch)
    with progress.in_passing(), progress.run_bar(True, "pendulum", 0, 10) as told:
        told(1.0, 0.1)
        assert screen.getvalue() == ""
        clock.now = 1.0
        told(5.0, 0.1)
    assert "50%" in screen.getvalue()
    assert "t = 5" in screen.getvalue()
    assert screen.getvalue().endswith("\x1b[2K")


def test_an_error_while_telling_comes_out(monkeypatch):
    from rich.progress import Progress

    def broken(self, task, **fields):
        raise OSError("no terminal")

    monkeypatch.setattr(Progress, "update", broken)
    with pytest.raises(OSError, match="no terminal"):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], progress=True)


def test_a_function_that_raises_ends_the_bar(capsys):
    def fun(t, y):
        if t > 0.5:
            raise ZeroDivisionError("mine")
        return -y

    with pytest.raises(ZeroDivisionError, match="mine"):
        iv.solve_ivp(fun, (0, 1), [1.0], progress=True)
    iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], progress=True)  # rich refuses two at once
    assert "100%" in capsys.readouterr().err


def test_it_is_a_flag_and_needs_rich(monkeypatch):
    with pytest.raises(TypeError, match="progress must be True, False or a function"):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], progress=1)
    monkeypatch.setitem(sys.modules, "rich.progress", None)
    with pytest.raises(ModuleNotFoundError, match=r'progress=True needs rich: pip install "invariode\[cli\]"'):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], progress=True)


@pytest.mark.parametrize("native", [False, True], ids=["python", "native"])
def test_ctrl_c_with_a_bar(tmp_path, native):
    if native:
        pytest.importorskip("numba")
    script = tmp_path / "forever.py"
    fun = "iv.compile(f)" if native else "f"
    script.write_text(
        textwrap.dedent(f"""
        import invariode as iv
        from rich.progress import Progress
        def f(t, y):
            return (y[1], -y[0])
        fun = {fun}
        Progress.update = lambda *about, **fields: print("under way", flush=True)
        try:
            iv.solve_ivp(fun, (0, 1e12), [1.0, 0.0], rtol=1e-10, keep="end", progress=True)
        except KeyboardInterrupt:
            print("interrupted", flush=True)
        """)
    )
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "under way\n"
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert out.splitlines()[-1] == "interrupted"


PEAKS = """
    import numpy as np
    import invariode as iv

    slope = (1.0, -1.0)

    def steps(end):
        times = np.linspace(0, end, 11) if TIMES else None
        sol = iv.solve_ivp(lambda t, y: slope, (0.0, end), [1.0, 0.0], "ode23", t_eval=times, max_step=0.01, **OPTIONS)
        return sol.stats.steps

    def peak():
        with open("/proc/self/status") as status:
            return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))

    assert steps(100.0) > 9_000
    before = peak()
    assert steps(10_000.0) > 900_000
    print(peak() - before)
"""


@pytest.mark.parametrize(
    ("times", "options", "grows"),
    [(True, {}, False), (False, {"keep": "end"}, False), (True, {"keep": "all"}, True)],
    ids=["t_eval", "end", "all"],
)
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory from /proc")
def test_memory_of_a_million_steps(times, options, grows):
    """The record of a step takes 40 bytes, and none where it is not kept."""
    code = textwrap.dedent(PEAKS).replace("OPTIONS", repr(options)).replace("TIMES", repr(times))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    growth = 1024 * int(done.stdout)
    assert (growth > 30e6) if grows else (growth < 2e6)


@explicit_and_implicit
def test_what_is_kept(method):
    about = (lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0.0], method)
    times = [0.0, 5.0, 10.0]
    assert iv.solve_ivp(*about).steps is not None
    assert iv.solve_ivp(*about, t_eval=times, keep="all").steps is not None
    for options in ({"t_eval": times}, {"keep": "outputs"}, {"keep": "end"}):
        sol = iv.solve_ivp(*about, **options)
        assert sol.steps is None
        assert sol.stats.steps > 0
        with pytest.raises(ValueError, match='keep="all"'):
            sol.correction  # noqa: B018  # the access is the test
    np.testing.assert_array_equal(iv.solve_ivp(*about, keep="outputs").y, iv.solve_ivp(*about).y)


class Cell:
    """The output of a cell: all that was shown in it."""

    def __init__(self):
        self.shown = []

    def update(self, text):
        self.shown.append(text)


@pytest.fixture
def notebook(monkeypatch):
    """Stand in for IPython in a notebook: a shell with a kernel, and cells that show HTML."""
    cell = Cell()

    def display(text, display_id):
        assert display_id is True
        cell.update(text)
        return cell

    shown = types.SimpleNamespace(display=display, HTML=str)
    ipython = types.SimpleNamespace(get_ipython=lambda: types.SimpleNamespace(kernel=None), display=shown)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    return cell


def test_in_a_notebook_the_bar_is_html(notebook, monkeypatch):
    monkeypatch.setattr(progress, "INTERVAL", 0.0)
    with progress.run_bar(True, "a < b", 0, 20) as report:
        report(5.0, 0.125)
    first, underway, last = notebook.shown
    assert 'value="0.0000"' in first
    assert "a &lt; b" in underway
    assert "25%  0:00 left  t = 5  h = 1.25e-01" in underway
    assert 'value="0.2500"' in last


def test_in_a_notebook_a_bar_needs_no_rich(notebook, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rich.progress", None)
    iv.solve_ivp(lambda t, y: -y, (0, 20), [1.0], progress=True)
    assert capsys.readouterr() == ("", "")
    assert "100%" in notebook.shown[-1]
    assert "t = 20  h = " in notebook.shown[-1]


def test_in_a_notebook_a_bar_ends_where_the_run_did(notebook):
    stop = iv.Event(lambda t, y: t - 5, terminal=True)
    iv.solve_ivp(lambda t, y: -y, (0, np.inf), [1.0], events=stop, progress=True)
    assert "<progress></progress>" in notebook.shown[-1]
    assert "t = 5 " in notebook.shown[-1]


def test_in_a_notebook_an_ensemble_counts_its_trajectories(notebook):
    iv.solve_ensemble(lambda t, y: -y, (0, 1), [[1.0], [2.0]], progress=True, workers=1)
    assert notebook.shown[-1].startswith('<div style="white-space: pre">trajectories  ')
    assert "100%" in notebook.shown[-1]
