"""The command line: what it prints is what the library says, its exit codes mean what the help says."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import types
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import invariode as iv
from cases import METHODS, dealt, explicit_and_implicit
from invariode._studies.precision import power
from invariode.cli.app import app
from invariode.cli.session import clock, count, guarded
from invariode.cli.solve import OUTPUTS

FILES = {
    "pendulum.py": """
import invariode as iv

def pendulum(t, y):
    x, z, u, v = y
    tension = (u * u + v * v - z) / (x * x + z * z)
    return [u, v, -tension * x, -tension * z - 1]

def rod(t, y):
    x, z, u, v = y
    return [x * x + z * z - 1, x * u + z * v]

problem = iv.Problem(pendulum, (0, 10), [1, 0, 0, 0], name="pendulum",
                     invariants=iv.Invariants(rod, value=0, names=["length", "tangent"]))
""",
    "prey.py": """
import numpy as np
import invariode as iv

def prey(t, y):
    return [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]

def orbit(t, y):
    return y[0] - np.log(y[0]) + 2 * (y[1] - np.log(y[1]))

def sum_of_both(t, y):
    return y[0] + y[1]

closed = iv.Problem(prey, (0, 10), [1, 3], invariants=orbit, name="Lotka-Volterra")
free = iv.Problem(prey, (0, 10), [1, 3], name="free")
wrong = iv.Problem(prey, (0, 10), [1, 3], invariants=[orbit, sum_of_both])
twice = iv.Problem(prey, (0, 10), [1, 3], invariants=[orbit, lambda t, y: 2 * orbit(t, y)])
""",
    "only.py": """
import invariode as iv
oscillator = iv.Problem(lambda t, y: [y[1], -y[0]], (0, 1), [1, 0], name="oscillator")
same = oscillator
if __name__ == "__main__":
    raise AssertionError("it is not run as a script")
""",
    "sink.py": """
import invariode as iv

def decay(t, y):
    return [-abs(y[0]), abs(y[0])]

sink = iv.Problem(decay, (0, 30), [1, 0], labels=["A", "B"], invariants=lambda t, y: y[0] + y[1])
swing = iv.Problem(lambda t, y: [y[1], -y[0]], (0, 10), [1, 0], invariants=lambda t, y: y @ y)
""",
    "broken.py": "import invariode\n\ndef helper():\n    raise RuntimeError('no data')\n\nhelper()\n",
    "syntax.py": "def f(:\n",
    "exits.py": "raise SystemExit(3)\n",
    "nothing.py": "import numpy as np\nstep = 3\ndef f(t, y):\n    return y\n",
    "stiff.py": """
import numpy as np
import invariode as iv

def rates(t, y):
    a, b, c = y
    return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, 3e7 * b * b]

def dae(t, y):
    return [*rates(t, y)[:2], y.sum() - 1]

problem = iv.Problem(rates, (0, 4e6), [1, 0, 0], invariants=lambda t, y: y[0] + y[1] + y[2], name="Robertson")
algebraic = iv.Problem(dae, (0, 40), [1, 0, 0], mass=np.diag([1, 1, 0]), name="DAE")
""",
    "faulty.py": """
import time
import numpy as np
import invariode as iv

def raises(t, y):
    if t > 3:
        raise ZeroDivisionError("boom")
    return [y[1], -y[0]]

def stops(t, y):
    if t > 3:
        raise KeyboardInterrupt
    return [y[1], -y[0]]

def fall(t, y):
    return [y[1], -1]

def slow(t, y):
    print("f", flush=True)
    time.sleep(0.01)
    return [-y[0]]

raising = iv.Problem(raises, (0, 10), [1, 0])
interrupted = iv.Problem(stops, (0, 10), [1, 0])
blowing_up = iv.Problem(lambda t, y: y**2, (0, 2), [1], name="y' = y²")
endless = iv.Problem(fall, (0, np.inf), [1, 0], events=iv.Event(lambda t, y: y[0], terminal=True), name="fall")
slow = iv.Problem(slow, (0, 1000), [1])
""",
}


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    """The problem files, in the current directory."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])


def invariode(*arguments: str, width: int = 80):
    return CliRunner().invoke(app, [str(one) for one in arguments], env={"COLUMNS": str(width)})


def flat(text: str) -> str:
    """Without line breaks and the frame around error messages."""
    return " ".join(text.replace("│", " ").split())


def problem(name: str = "pendulum.py", of: str = "problem") -> iv.Problem:
    namespace: dict[str, object] = {"__name__": "test"}
    exec(FILES[name], namespace)
    return namespace[of]


# ----------------------------------------------------------------------------------------------------------------------
# Which problem


@pytest.mark.parametrize(
    ("file", "name"),
    [("pendulum.py", "pendulum"), ("only.py", "oscillator"), ("only.py:same", "oscillator"), ("prey.py:free", "free")],
)
def test_problem_is_the_one_named_or_the_only_one(file, name):
    outcome = invariode("solve", file)
    assert outcome.exit_code == 0, outcome.output
    assert re.search(rf"^problem +{name} *$", outcome.output, re.MULTILINE)


NO_PROBLEM = {
    "prey.py": "several problems: closed, free, wrong, twice. Say which: prey.py:closed",
    "prey.py:close": "does not define close; did you mean closed?",
    "prey.py:orbit": "prey.py:orbit is of type function, expected an invariode.Problem",
    "nothing.py": "defines no invariode.Problem. It should say: problem = iv.Problem(",
    "pendulums.py": "no such file: pendulums.py; did you mean pendulum.py?",
    ".": "is a directory",
}


@dealt(len(NO_PROBLEM), command=["solve", "compare", "check"], file=NO_PROBLEM)
def test_file_without_the_problem_is_a_usage_error_that_says_what_there_is(command, file):
    outcome = invariode(command, file, width=200)
    assert outcome.exit_code == 2
    assert NO_PROBLEM[file] in flat(outcome.output)
    assert file != "nothing.py" or "It defines: step (int), f (function)." in flat(outcome.output)


@pytest.mark.parametrize(
    ("file", "error"), [("broken.py", "RuntimeError"), ("syntax.py", "SyntaxError"), ("exits.py", "SystemExit")]
)
def test_file_that_raises_shows_its_own_traceback_only(file, error):
    outcome = invariode("solve", file)
    assert outcome.exit_code == 2
    assert outcome.output.endswith(f"{file} cannot be run; it raised {error}.\n")
    assert f'File "{file}"' in outcome.output
    assert "invariode/cli" not in outcome.output


def test_file_may_import_its_neighbours_and_leaves_no_bytecode():
    Path("neighbour_of_this.py").write_text("from pendulum import problem as first\n", encoding="utf-8")
    assert invariode("solve", "neighbour_of_this.py").exit_code == 0
    assert "neighbour_of_this" not in sys.modules
    assert not list(Path("__pycache__").glob("neighbour*"))


def test_directory_with_a_colon_is_part_of_the_path(tmp_path):
    (tmp_path / "a:b").mkdir()
    (tmp_path / "a:b" / "one.py").write_text(FILES["only.py"], encoding="utf-8")
    assert invariode("solve", "a:b/one.py").exit_code == 0
    assert invariode("solve", "a:b/one.py:same").exit_code == 0


# ----------------------------------------------------------------------------------------------------------------------
# solve


@explicit_and_implicit
def test_solve_prints_the_counts_of_the_library(method):
    outcome = invariode("solve", "pendulum.py", "--method", method, "--rtol", "1e-5", "--atol", "1e-8")
    sol = problem().solve(method, rtol=1e-5, atol=1e-8)
    assert outcome.exit_code == 0, outcome.output
    assert f"{method}, rtol 1e-05, atol 1e-08" in outcome.output
    assert f"{sol.stats.steps}, {sol.stats.failed} failed" in outcome.output
    assert f"{sol.nfev} evaluations" in outcome.output
    drift = sol.drift()
    for name, before in zip(drift.names, drift.residual_before, strict=True):
        assert re.search(rf"^{name} +0 +{before:.2e} ", outcome.output, re.MULTILINE)


def test_solve_without_projection_shows_the_drift_that_there_is():
    outcome = invariode("solve", "pendulum.py", "--no-project")
    sol = iv.solve_ivp(problem().fun, (0, 10), [1, 0, 0, 0])
    drift = abs(sol.y[0] ** 2 + sol.y[1] ** 2 - 1).max()
    assert re.search(rf"^length +0 +{drift:.2e} ", outcome.output, re.MULTILINE), outcome.output
    assert "Nothing is imposed" in outcome.output


def test_solve_takes_scipys_names():
    assert "ode15s as BDF" in invariode("solve", "pendulum.py", "-m", "BDF").output


@pytest.mark.parametrize(("options", "points"), [(["--t-eval", "11"], 11), ([], None), (["--dense"], 10)])
def test_solve_has_as_many_outputs_as_asked_for(options, points):
    steps = problem().solve().stats.steps
    expected = {11: 11, None: steps + 1, 10: 10 * steps + 1}[points]
    assert f"{expected} times" in invariode("solve", "pendulum.py", *options).output


@pytest.mark.parametrize("command", ["solve", "compare", "check"])
def test_terminals_of_any_width_cut_and_wrap_nothing(command):
    options = ["--decades", "3-4", "-m", "ode45"] if command == "compare" else []
    for width in (80, 120):
        output = invariode(command, "pendulum.py", *options, width=width).output
        assert max(map(len, output.splitlines())) <= width
        assert "…" not in output


def test_a_long_name_leaves_the_numbers_whole():
    name = "the_distance_of_the_bob_from_the_point_where_the_rod_hangs_squared_minus_one"
    Path("long.py").write_text(FILES["pendulum.py"].replace("length", name), encoding="utf-8")
    output = invariode("solve", "long.py").output
    before, after = problem().solve().drift().residual_before[0], problem().solve().drift().residual_after[0]
    assert f"{before:.2e}" in output
    assert f"{after:.2e}" in output
    assert max(map(len, output.splitlines())) <= 80


def test_solve_quietly_prints_nothing():
    assert invariode("solve", "pendulum.py", "--quiet").output == ""


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["pendulum.py", "--method", "ode54"], 2, "did you mean 'ode45'?"),
        (["pendulum.py", "--rtol", "-1"], 2, "rtol must be finite and not negative"),
        (["pendulum.py", "--t-eval", "1"], 2, "--t-eval"),
        (["pendulum.py", "--t-eval", "5", "--dense"], 2, "exclude each other"),
        (["faulty.py:endless", "--t-eval", "5"], 2, "need a finite interval"),
        (["pendulum.py", "-o", "a.txt"], 2, "a.txt has ending '.txt'; choose from .csv, .parquet, .nc, .npz"),
        (["pendulum.py", "-o", "a"], 2, "a has no ending"),
        (["pendulum.py", "--plot", "a.gif"], 2, "choose from .png, .svg, .pdf"),
        (["pendulum.py", "-o", "none/a.npz"], 2, "no such directory: none"),
        (["stiff.py:algebraic"], 2, "ode45 is explicit and cannot use a mass matrix; use ode15s"),
        (["prey.py:wrong"], 1, "Invariant sum_of_both is not conserved by fun"),
        (["faulty.py:blowing_up"], 1, "without reducing the step below its smallest size"),
        (["faulty.py:blowing_up", "-q"], 1, "without reducing the step below its smallest size"),
        (["faulty.py:interrupted"], 130, "Interrupted at t = "),
        (["faulty.py:endless"], 0, "A termination event occurred."),
    ],
)
def test_solve_says_what_is_wrong_and_ends_with(arguments, code, says):
    outcome = invariode("solve", *arguments, width=200)
    assert outcome.exit_code == code, outcome.output
    assert says in flat(outcome.output)


@pytest.mark.parametrize("value", ["0", "-1", "nan"])
@pytest.mark.parametrize("option", ["--time-limit", "--checkpoint-every"])
def test_times_of_zero_are_usage_errors(option, value):
    outcome = invariode("solve", "pendulum.py", option, value, width=200)
    assert outcome.exit_code == 2, outcome.output
    assert option in outcome.output
    assert f"must be a positive number of seconds, got {value}" in flat(outcome.output)


def test_what_a_dataclass_of_ours_refuses_is_not_blamed_on_the_user():
    """Its constructor is in no file."""
    with pytest.raises(typer.Exit) as ended:
        exec("with guarded():\n    iv.Limits(steps=0)", {"guarded": guarded, "iv": iv, "__name__": "invariode.cli"})
    assert ended.value.exit_code == 2


@pytest.mark.parametrize("command", ["solve", "compare"])
def test_exception_of_a_users_function_shows_its_frames_only(command):
    outcome = invariode(command, "faulty.py:raising")
    assert outcome.exit_code == 1
    assert "ZeroDivisionError: boom" in outcome.output
    assert 'File "faulty.py"' in outcome.output
    assert "invariode/" not in outcome.output


def test_a_folder_whose_name_starts_with_that_of_the_package_is_the_users():
    package = Path(iv.__file__).parent
    names = {"guarded": guarded}
    text = "def run():\n    with guarded():\n        raise ValueError"
    for folder, exit_code in ((package, 2), (package.with_name(f"{package.name}_mine"), 1)):
        exec(compile(text, str(folder / "own.py"), "exec"), names)
        with pytest.raises(typer.Exit) as ended:
            names["run"]()
        assert ended.value.exit_code == exit_code


def test_warnings_are_lines():
    code = "from invariode.cli import main\nmain()"
    done = subprocess.run(
        [sys.executable, "-c", code, "solve", "prey.py:twice", "-q"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert re.fullmatch(r"Warning: invariant g is redundant, first at .*\n", done.stderr)


@pytest.mark.parametrize("option", ["--output", "--plot"])
def test_files_are_overwritten_by_force_only(option, monkeypatch):
    for name in ("_save", "_draw"):
        monkeypatch.setattr(f"invariode.cli.solve.{name}", lambda *about: about[-1].write_text("new"))
    path = Path("a.csv" if option == "--output" else "a.png")
    path.write_text("old")
    outcome = invariode("solve", "pendulum.py", option, path)
    assert outcome.exit_code == 2
    assert "--force overwrites it" in flat(outcome.output)
    assert path.read_text() == "old"
    assert f"Wrote {path}" in invariode("solve", "pendulum.py", option, path, "--force").output
    assert path.read_text() == "new"


def test_what_cannot_be_written_is_said(monkeypatch):
    def fail(sol, path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("invariode.cli.solve._save", fail)
    outcome = invariode("solve", "pendulum.py", "-o", "a.npz")
    assert outcome.exit_code == 1
    assert outcome.output.endswith("a.npz cannot be written: Permission denied\n")


@pytest.mark.parametrize(
    ("option", "file", "package", "extra"),
    [
        ("--output", "a.csv", "pandas", "data"),
        ("--output", "a.parquet", "pyarrow", "data"),
        ("--output", "a.nc", "h5netcdf", "data"),
        ("--output", "a.nc", "h5py", "data"),
        ("--plot", "a.png", "matplotlib", "plot"),
    ],
)
def test_missing_package_is_named_before_the_work(option, file, package, extra, monkeypatch):
    monkeypatch.setattr("invariode.cli.session.find_spec", lambda name: None if name == package else object())
    outcome = invariode("solve", "faulty.py:raising", option, file)
    assert outcome.exit_code == 1
    assert outcome.output == f'{option} needs {package}: pip install "invariode[{extra}]"\n'


@pytest.mark.parametrize("ending", list(OUTPUTS))
def test_output_holds_the_solution(ending):
    for package in OUTPUTS[ending]:
        pytest.importorskip(package)
    sol = problem().solve(t_eval=np.linspace(0, 10, 5))
    path = Path(f"out{ending}")
    outcome = invariode("solve", "pendulum.py", "--t-eval", "5", "-o", path)
    assert outcome.exit_code == 0, outcome.output
    t, y = contents(path)
    np.testing.assert_array_equal(t, sol.t)
    np.testing.assert_array_equal(y, sol.y)


def contents(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """t and y of a file of the pendulum's solution."""
    labels = [f"y{i}" for i in range(4)]
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as data:
            return data["t"], data["y"]
    if path.suffix == ".nc":
        import xarray

        with xarray.open_dataset(path, engine="h5netcdf") as data:
            return data["t"].to_numpy(), data["y"].transpose("component", "t").to_numpy()
    import pandas

    if path.suffix == ".csv":  # by default pandas reads numbers to a few ulp
        frame = pandas.read_csv(path, dtype=str).astype(float).set_index("t")  # pandas rounds what it reads itself
    else:
        frame = pandas.read_parquet(path)
    return frame.index.to_numpy(), frame[labels].to_numpy().T


@pytest.mark.parametrize(("ending", "magic"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")])
def test_solve_draws(ending, magic):
    path = Path(f"plot{ending}")
    assert invariode("solve", "pendulum.py", "--plot", path).exit_code == 0
    assert path.read_bytes().startswith(magic)


def test_the_picture_holds_its_labels(monkeypatch):
    """Nothing is drawn outside the page, and panels do not overlap."""
    drawn = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, *about, **options: drawn.append(figure))
    assert invariode("solve", "pendulum.py", "--plot", "a.png").exit_code == 0
    (figure,) = drawn
    figure.canvas.draw()
    upper, lower = (ax.get_tightbbox() for ax in figure.axes)
    for box in (upper, lower):
        assert 0 <= box.x0 < box.x1 <= figure.bbox.width
        assert 0 <= box.y0 < box.y1 <= figure.bbox.height
    assert lower.y1 < upper.y0


def test_a_short_run_shows_no_progress_bar():
    assert "%" not in invariode("solve", "pendulum.py", "--progress").output


@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT")
def test_ctrl_c_ends_with_130_and_one_line():
    code = "from invariode.cli import main\nmain()"
    with subprocess.Popen(
        [sys.executable, "-c", code, "solve", "faulty.py:slow"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        assert running.stdout.readline() == "f\n"  # it is under way
        time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=60)
    assert running.returncode == 130
    assert re.fullmatch(r"Interrupted at t = \S+, after \d+ steps; nothing was saved.\n", errors)


# ----------------------------------------------------------------------------------------------------------------------
# check


def test_check_prints_the_report():
    outcome = invariode("check", "prey.py:closed")
    report = iv.check_invariants(problem("prey.py", "closed").fun, problem("prey.py", "closed").invariants, 0, [1, 3])
    assert outcome.exit_code == 0
    (row,) = (line.split() for line in outcome.output.splitlines() if line.startswith("orbit"))
    sizes = (report.residual[0], report.rate[0])
    assert row == ["orbit", f"{report.value[0]:.6g}", *(f"{x:.2e}" for x in sizes), f"{report.angle[0]:.1e}", "yes"]


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["pendulum.py", "--along", "5"], 0, "5 of 5"),
        (["stiff.py", "--along", "3", "-m", "ode15s"], 0, "3 of 3"),
        (["prey.py:wrong"], 1, "sum_of_both is not conserved by fun"),
        (["prey.py:wrong", "--along", "4"], 1, "sum_of_both is not conserved by fun, first at t = 2.5 (4 of 4)"),
        (["prey.py:twice"], 1, "is redundant here: the others imply it"),
        (["prey.py:free"], 2, "free has no invariants: there is nothing to check"),
        (["stiff.py:algebraic"], 2, "has no invariants"),
    ],
)
def test_check_ends_with_1_if_there_are_findings(arguments, code, says):
    outcome = invariode("check", *arguments)
    assert outcome.exit_code == code, outcome.output
    assert says in flat(outcome.output)


def test_check_and_compare_tell_what_falls_below_zero_and_should_not():
    says = re.compile(r"A falls to -\S+, where a more accurate solution stays above 0")
    check = ("check", "sink.py:sink", "--along", "5", "--rtol", "1e-2", "--atol", "1e-4")
    outcome = invariode(*check)
    assert outcome.exit_code == 0, outcome.output
    assert says.search(flat(outcome.output))
    runs = ("--decades", "2-3", "-m", "ode45")
    assert says.search(flat(invariode("compare", "sink.py:sink", *runs).output))
    for command in (["check", "sink.py:swing", "--along", "5"], ["compare", "sink.py:swing", *runs]):
        assert "falls to" not in flat(invariode(*command).output)


@pytest.mark.filterwarnings("ignore:.* fell below 0")  # runs without bounds do
@pytest.mark.parametrize("components", ["A", "0", "all", "A,B"])
def test_solve_keeps_components_from_becoming_negative(components):
    command = ("solve", "sink.py:sink", "--rtol", "1e-2", "--atol", "1e-4", "-o", "sink.npz")
    assert invariode(*command, "--nonnegative", components).exit_code == 0
    assert iv.load("sink.npz").y[0].min() >= 0
    assert invariode(*command, "--force").exit_code == 0
    assert iv.load("sink.npz").y[0].min() < 0
    outcome = invariode(*command, "--force", "--nonnegative", "C")
    assert outcome.exit_code == 2
    assert "choose from A, B" in flat(outcome.output)


def test_check_says_that_it_does_not_know_mass_matrices():
    text = FILES["stiff.py"].replace("mass=", "invariants=lambda t, y: y.sum(), mass=")
    Path("mass.py").write_text(text, encoding="utf-8")
    outcome = invariode("check", "mass.py:algebraic")
    assert outcome.exit_code == 2
    assert "this problem has a mass matrix" in outcome.output


# ----------------------------------------------------------------------------------------------------------------------
# compare


def test_compare_takes_methods_with_commas_between_them():
    ways = [["-m", "ode23,ode45"], ["-m", "ode23", "-m", "ode45"], ["-m", "ode23, ode45,ode23"]]
    options = ("compare", "prey.py:closed", "--decades", "3-3")
    found = [[*dict.fromkeys(re.findall(r"^ode\w+", invariode(*options, *way).output, re.MULTILINE))] for way in ways]
    assert found[0] == found[1] == found[2] == ["ode23", "ode45"]
    assert "did you mean 'ode45'" in invariode(*options, "-m", "ode23,ode54").output


def test_compare_prints_what_the_runs_cost():
    outcome = invariode("compare", "prey.py:closed", "--decades", "4-5", "-m", "ode45", "-m", "ode113", width=120)
    assert outcome.exit_code == 0, outcome.output
    lines = outcome.output.splitlines()
    for method in ("ode45", "ode113"):
        first = next(i for i, line in enumerate(lines) if re.match(rf"{method}\s+1e-", line))  # not the answer
        for line, rtol in zip(lines[first : first + 2], (1e-4, 1e-5), strict=True):
            plain = problem("prey.py", "free").solve(method, rtol=rtol, atol=1e-3 * rtol)
            projected = problem("prey.py", "closed").solve(method, rtol=rtol, atol=1e-3 * rtol)
            cells = line.removeprefix(method).split()
            assert cells[0] == power(rtol)
            assert cells[3] == str(plain.nfev + plain.stats.nfev_check)
            assert cells[7:10] == [
                str(projected.nfev + projected.stats.nfev_check),
                str(projected.stats.ng),
                str(projected.stats.ngjac),
            ]


def test_compare_measures_the_error_of_the_final_state():
    outcome = invariode("compare", "only.py", "--decades", "4-4", "-m", "ode45")
    sol = problem("only.py", "oscillator").solve(rtol=1e-4, atol=1e-7)
    error = max(abs(sol.y[:, -1] - [np.cos(1), -np.sin(1)]) / [1, np.sin(1)])
    assert f"1e-4 {error:.1e}" in flat(outcome.output)


@pytest.mark.parametrize(
    ("price", "verdict"),
    [(0, "is worth it here"), (100, "is not worth it here: at equal error it takes")],
    ids=["free", "dear"],
)
def test_compare_answers_in_a_sentence(price, verdict, monkeypatch):
    """On a clock that counts evaluations: of f as one, of g as `price`. The projected run is far more accurate."""
    clock = types.SimpleNamespace(now=0)
    counted = FILES["pendulum.py"].replace("return [u", "clock.now += 1\n    return [u")
    counted = counted.replace("return [x * x", f"clock.now += {price}\n    return [x * x")
    Path("counted.py").write_text(f"from clocks import clock\n{counted}", encoding="utf-8")
    monkeypatch.setitem(sys.modules, "clocks", types.SimpleNamespace(clock=clock))
    monkeypatch.setattr("invariode._studies.precision.perf_counter", lambda: clock.now / 1e6)
    outcome = invariode("compare", "counted.py", "--decades", "3-6", "-m", "ode45")
    assert outcome.exit_code == 0, outcome.output
    assert f"Projection {verdict}" in flat(outcome.output)


def test_compare_says_how_far_runs_end_off_the_invariants():
    """Plain runs as far as the drift of the length says, projected ones by roundoff; in units of the sizes of y."""
    outcome = invariode("compare", "pendulum.py", "--decades", "4-4", "-m", "ode45", width=120)
    text = flat(outcome.output)
    sentence = re.search(
        r"Plain runs end off the invariants by (\S+) of the size of the solution, projected ones by (\S+) at most", text
    )
    assert sentence, text
    plain = problem("pendulum.py", "problem").replace(invariants=None).solve("ode45", rtol=1e-4, atol=1e-7)
    bob = np.hypot(*plain.y[:2, -1])
    assert 0.2 * abs(bob - 1) < float(sentence[1]) < 5 * abs(bob - 1)
    assert float(sentence[2]) < 1e-14
    assert re.search(rf"ode45 1e-4 \S+ {sentence[1]} ", text)
    free = invariode("compare", "prey.py:free", "--decades", "3-3", "-m", "ode45").output
    assert "off the invariants" not in free
    assert " off " not in free


def test_compare_without_invariants_says_so_and_compares_plain():
    outcome = invariode("compare", "prey.py:free", "--decades", "3-5")
    assert outcome.exit_code == 0
    assert "free has no invariants, so there is nothing to project" in flat(outcome.output)
    assert "find_invariants" in outcome.output
    assert "projected" not in outcome.output
    for name in METHODS:
        assert re.search(rf"^{name} +1e-3 ", outcome.output, re.MULTILINE)


def test_compare_gives_up_explicit_methods_on_stiff_problems():
    """ode15s takes 200 steps, in a fraction of the limit, ode45 many millions."""
    outcome = invariode("compare", "stiff.py", "--decades", "3-4", "--limit", "1", "-m", "ode45", "-m", "ode15s")
    assert outcome.exit_code == 0, outcome.output
    assert "Reference: ode15s and ode15s as BDF" in outcome.output
    assert "ode45: given up, a run takes longer than 1 s" in outcome.output
    assert len(re.findall("too long", outcome.output)) == 2


def test_a_run_goes_on_from_its_checkpoint(tmp_path):
    files = {name: str(tmp_path / name) for name in ("run.checkpoint", "on.npz", "whole.npz")}
    kept = ["solve", "pendulum.py", "--checkpoint", files["run.checkpoint"]]
    assert invariode(*kept, "--max-steps", "20").exit_code == 1
    outcome = invariode(*kept, "--resume", "-o", files["on.npz"])
    assert outcome.exit_code == 0, outcome.output
    assert invariode("solve", "pendulum.py", "-o", files["whole.npz"]).exit_code == 0
    on, whole = iv.load(files["on.npz"]), iv.load(files["whole.npz"])
    np.testing.assert_array_equal(on.y, whole.y)
    assert dict(on.stats) == dict(whole.stats)
    assert invariode(*kept, "--resume").exit_code == 0  # there is nothing left to do
    other = invariode(*kept, "--resume", "--rtol", "1e-4")
    said = "rtol = 0.0001 differs from 0.001 in the file" in flat(other.output)
    assert (other.exit_code, said) == (2, True), other.output
    assert invariode("solve", "pendulum.py", "--resume").exit_code == 2


def test_compare_takes_methods_that_can_solve_the_problem():
    options = ["--decades", "3-4", "--atol-ratio", "1"]
    outcome = invariode("compare", "stiff.py:algebraic", *options)
    assert outcome.exit_code == 0, outcome.output
    named = {line.split()[0] for line in outcome.output.splitlines() if line.split()[:1]} & set(iv.METHODS)
    assert named == {name for name, about in iv.METHODS.items() if about.mass == "any"}
    refused = invariode("compare", "stiff.py:algebraic", *options, "-m", "ode45")
    assert refused.exit_code == 2
    assert "ode45 cannot use this mass matrix; ode15s, " in flat(refused.output)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["pendulum.py", "--decades", "9-3"], 2, "expected M-N"),
        (["pendulum.py", "--decades", "3"], 2, "expected M-N"),
        (["pendulum.py", "--limit", "0"], 2, "must be positive"),
        (["pendulum.py", "--atol-ratio", "-1"], 2, "not negative"),
        (["pendulum.py", "-m", "BDF"], 2, "give ode15s"),
        (["pendulum.py", "--plot", "a.jpg"], 2, "choose from .png, .svg, .pdf"),
        (["prey.py:wrong"], 1, "Invariant sum_of_both is not conserved by fun"),
        (["faulty.py:blowing_up"], 1, "No two methods reach the end with stringent tolerances."),
        (["faulty.py:interrupted"], 130, "Interrupted."),
        (["faulty.py:endless", "-m", "ode15s", "--decades", "3-4"], 0, "at the terminal event"),
    ],
)
def test_compare_says_what_is_wrong_and_ends_with(arguments, code, says):
    outcome = invariode("compare", *arguments)
    assert outcome.exit_code == code, outcome.output
    assert says in flat(outcome.output)


@pytest.mark.parametrize(("ending", "magic"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")])
def test_compare_draws(ending, magic):
    path = Path(f"work{ending}")
    outcome = invariode("compare", "prey.py:closed", "--decades", "3-4", "-m", "ode23", "--plot", path)
    assert outcome.exit_code == 0, outcome.output
    assert path.read_bytes().startswith(magic)


# ----------------------------------------------------------------------------------------------------------------------
# Around


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (count(99_999), "99999"),
        (count(123_456), "123k"),
        (count(123_456_789), "123M"),
        (clock(2.5e-5), "25 µs"),
        (clock(0.1234), "123 ms"),
        (clock(2.345), "2.35 s"),
        (clock(1234.5), "1234 s"),
        (power(1e-4), "1e-4"),
        (power(1e-12), "1e-12"),
    ],
)
def test_numbers_are_short(shown, text):
    assert shown == text


@pytest.mark.parametrize("command", ["solve", "compare", "check"])
def test_help_has_examples_and_fits(command):
    outcome = invariode(command, "--help")
    assert outcome.exit_code == 0
    assert f"invariode {command} " in outcome.output
    assert "Example" in outcome.output
    assert max(map(len, outcome.output.splitlines())) <= 80


#: The files that the examples of the help name.
EXAMPLES = {
    "orbits.py": """
import invariode as iv

def orbit(t, y):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / r3, -y[1] / r3]

def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]

kepler = iv.Problem(orbit, (0, 0.5), [1, 0, 0, 1], name="kepler", invariants=momentum)
""",
    "kinetics.py": """
import invariode as iv

kinetics = iv.Problem(lambda t, y: [-y[0], y[0]], (0, 1), [1, 0], invariants=lambda t, y: y[0] + y[1])
""",
}


def examples_of_the_help():
    """The commands that the help of each command ends with, without `invariode`."""
    for command in ([], ["solve"], ["compare"], ["check"]):
        text = invariode(*command, "--help", width=200).output
        lines = [line.split() for line in re.split(r"Examples?:", text)[1].splitlines() if line.strip()]
        assert lines
        assert all(line[0] == "invariode" for line in lines)
        yield from (" ".join(line[1:]) for line in lines)


def test_examples_of_the_help_do_what_they_say():
    """Each of them runs, writes the files that it names, and prints the problem's name."""
    Path("pendulum.py").write_text(FILES["pendulum.py"].replace("(0, 10)", "(0, 1)"), encoding="utf-8")  # short runs
    for name, text in EXAMPLES.items():
        Path(name).write_text(text, encoding="utf-8")
    done = {}
    for command in dict.fromkeys(examples_of_the_help()):
        arguments = command.split()
        outcome = invariode(*arguments)
        assert outcome.exit_code == 0, (arguments, outcome.output)
        assert re.search(r"(pendulum|kepler)", outcome.output) or "kinetics.py" in arguments
        written = [one for flag, one in pairwise(arguments) if flag in ("-o", "--plot", "--checkpoint")]
        assert all(Path(one).stat().st_size > 0 for one in written)
        done[command] = written
    assert len(done) > 8
    assert sum(map(len, done.values())) == 5


def test_the_page_shows_what_the_command_prints():
    """All of docs/command-line.md's console but the time, in a terminal of 80 columns."""
    page = (Path(__file__).parents[1] / "docs/command-line.md").read_text(encoding="utf-8")
    code, console = (re.search(rf"```{kind}\n(.*?)```", page, re.DOTALL)[1] for kind in ("python", "console"))
    Path("pendulum.py").write_text(code, encoding="utf-8")
    shown = re.split(r"^\$ invariode (.*)\n", console, flags=re.MULTILINE)[1:]
    assert len(shown) == 4
    for command, expected in zip(shown[::2], shown[1::2], strict=True):
        printed, wanted = (
            [line.rstrip() for line in text.splitlines() if not line.startswith("time ")]
            for text in (invariode(*command.split()).output, expected)
        )
        assert printed == wanted


def test_package_is_the_command():
    done = subprocess.run([sys.executable, "-m", "invariode", "--version"], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == f"invariode {iv.__version__}"


@pytest.mark.parametrize(("words", "offered"), [("invariode so", {"solve"}), ("invariode solve a.py -m ode1", None)])
def test_shell_completes_commands_and_methods(words, offered):
    code = "import sys\nfrom invariode.cli.app import app\nsys.argv[0] = 'invariode'\napp(prog_name='invariode')"
    about = {"_INVARIODE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env={**os.environ, **about}
    )
    expected = offered or {name for name in iv.METHODS if name.startswith("ode1")}
    assert set(done.stdout.split()) == expected, done.stderr


def test_commands_that_need_no_extra_import_none():
    blocked = "import sys; sys.modules.update(matplotlib=None, pandas=None, xarray=None)"
    code = f"{blocked}\nfrom invariode.cli import main\nmain()"
    done = subprocess.run(
        [sys.executable, "-c", code, "compare", "pendulum.py", "--decades", "3-4", "-m", "ode45"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_the_documentation_shows_what_the_commands_print():
    """Its pendulum.py is the Python block of the page; only numbers may differ, between machines."""
    text = (Path(__file__).parents[1] / "docs" / "command-line.md").read_text(encoding="utf-8")
    (file,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    Path("pendulum.py").write_text(file, encoding="utf-8")
    (session,) = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    commands = re.findall(r"\$ invariode (.*?)\n(.*?)(?=\$ |\Z)", session, re.DOTALL)
    assert commands
    for command, shown in commands:
        assert _without_numbers(invariode(*command.split()).output) == _without_numbers(shown)


def _without_numbers(text: str) -> list[str]:
    return re.sub(r"(?<!\w)\d[\d.e+-]*( [mµ]?s\b)?", "#", text).split()


def test_an_interrupted_run_says_where_it_stopped():
    result = invariode("solve", "faulty.py:interrupted")
    assert re.fullmatch(r"Interrupted at t = \S+, after \d+ steps; nothing was saved.\n", result.output)


def test_solve_draws_components_and_drift_in_panels(monkeypatch):
    drawn = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, *about, **options: drawn.append(figure))
    assert invariode("solve", "pendulum.py", "--plot", "all.png").exit_code == 0
    assert invariode("solve", "pendulum.py", "--save-figure", "two.png", "--components", "0,1", "--log").exit_code == 0
    everything, some = drawn
    assert len(everything.axes) == len(some.axes) == 2
    assert everything.axes[-1].get_yscale() == "log"  # the drift
    assert [len(figure.axes[0].get_legend().get_texts()) for figure in drawn] == [4, 2]
    assert [figure.axes[0].get_xscale() for figure in drawn] == ["linear", "log"]
    assert [figure.axes[-1].get_xlabel() for figure in drawn] == ["t", "t"]


def test_components_that_are_not_there_are_refused_before_the_run():
    result = invariode("solve", "pendulum.py", "--plot", "a.png", "--components", "0,west")
    assert result.exit_code == 2
    assert "choose from" in flat(result.output)
    assert invariode("solve", "pendulum.py", "--log").exit_code == 2


def test_compare_answers_first_and_quiet_answers_only():
    options = ("compare", "pendulum.py", "-m", "ode45", "--decades", "3-8", "--no-progress")
    loud, quiet = invariode(*options), invariode(*options, "--quiet")
    assert flat(loud.output).startswith("Projection")
    assert "Reference:" in loud.output
    assert quiet.output.startswith("Projection")
    assert "Reference:" not in quiet.output
    assert len(quiet.output.splitlines()) <= 5


def test_the_tutorials_comparison_is_what_one_gets():
    """On its own pendulum; the first sentence, about times, depends on the machine."""
    page = (Path(__file__).parents[1] / "docs/tutorial.md").read_text(encoding="utf-8")
    cells = re.findall(r"```\{code-cell\} python\n(?:---\n.*?\n---\n)?(.*?)```", page, re.DOTALL)
    needed = [cell for cell in cells if "def pendulum" in cell or "def rod(" in cell or "problem = iv.Problem(" in cell]
    text = "\n".join(re.sub(r"^(plain|kept|print).*\n", "", cell, flags=re.MULTILINE) for cell in needed)
    Path("pendulum.py").write_text(text, encoding="utf-8")
    command, *shown = re.search(r"```console\n\$ invariode (.*?)```", page, re.DOTALL)[1].strip().splitlines()
    outcome = invariode(*command.split(), width=1000)
    assert outcome.exit_code == 0, outcome.output
    first, second = outcome.output.strip().splitlines()
    assert first.startswith("Projection ")
    assert shown[0].startswith("Projection ")
    assert second == shown[1]
