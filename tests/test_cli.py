"""The command line: what it prints is what the library says, its exit codes mean what the help says."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import typer

import invariode as iv
from cases import dealt, explicit_and_implicit
from command_files import FILES, flat, invariode, problem
from invariode.cli.load import load
from invariode.cli.session import guarded
from invariode.cli.solve import OUTPUTS

pytestmark = pytest.mark.usefixtures("command_files")


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


def test_solve_prints_one_json_object_for_scripts():
    """Also a failed run, which exits with 1; numbers that are not finite are null, as JSON has none."""
    for file, code in (("pendulum.py", 0), ("faulty.py:blowing_up", 1)):
        done = invariode("solve", file, "--json", "--quiet")
        found = json.loads(done.stdout, parse_constant=pytest.fail)
        assert (done.exit_code, found["success"]) == (code, code == 0)
        assert {"method", "rtol", "atol", "message", "t_end", "y_end", "nfev", "seconds"} <= found.keys()
    refused = invariode("solve", "prey.py:wrong", "--json")
    found = json.loads(refused.stdout)
    assert (refused.exit_code, found["success"], found["error"]) == (1, False, "InvariantError")
    assert found["message"] in refused.stderr


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
        (["faulty.py:interrupted"], 130, "Interrupted; nothing was saved."),
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
    """The constructor of a dataclass is in no file."""
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


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is full")
def test_a_full_disk_behind_standard_output_is_not_blamed_on_the_functions():
    code = "from invariode.cli import main\nmain()"
    for option in ((), ("--json",)):
        with open("/dev/full", "w") as full:
            done = subprocess.run(
                [sys.executable, "-c", code, "solve", "pendulum.py", *option],
                stdout=full,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
            )
        assert (done.returncode, done.stderr) == (1, "The output cannot be written: No space left on device\n")


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


def test_files_of_the_command_go_on_in_python_and_its_checkpoints_there(tmp_path):
    """The command adds nothing to a run, such as a callback of its own, which would be missing afterwards."""
    problem = load("pendulum.py")
    assert invariode("solve", "pendulum.py", "-o", f"{tmp_path}/run.npz").exit_code == 0
    run = iv.load(tmp_path / "run.npz", problem)
    assert run.extend(run.t_end + 1).success
    problem.solve(rtol=1e-4, atol=1e-7, checkpoint=tmp_path / "c.ck", limits=iv.Limits(steps=5))
    options = ["--rtol", "1e-4", "--atol", "1e-7", "--checkpoint", f"{tmp_path}/c.ck"]
    refused = invariode("solve", "pendulum.py", *options)  # --resume was forgotten: nothing is lost
    assert (refused.exit_code, "has not ended" in refused.output + refused.stderr) == (2, True)
    assert invariode("solve", "pendulum.py", *options, "--resume").exit_code == 0


@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT")
def test_ctrl_c_ends_with_130_and_one_line(tmp_path):
    code = "from invariode.cli import main\nmain()"
    with subprocess.Popen(
        [sys.executable, "-c", code, "solve", "faulty.py:slow", "-o", str(tmp_path / "run.npz")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        assert running.stdout.readline() == "f\n"  # it is under way
        time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=60)
    assert running.returncode == 130
    assert re.fullmatch(r"Interrupted at t = \S+, after \d+ steps; with --checkpoint it could be resumed\.\n", errors)
    assert 0 < iv.load(tmp_path / "run.npz").t_end < 1000


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


def test_a_run_goes_on_from_its_checkpoint(tmp_path):
    files = {name: str(tmp_path / name) for name in ("run.checkpoint", "on.npz", "whole.npz")}
    kept = ["solve", "pendulum.py", "--checkpoint", files["run.checkpoint"]]
    command = [*kept, "--resume", "-o", files["on.npz"]]  # can be repeated as it stands
    assert invariode(*command, "--max-steps", "20").exit_code == 1
    outcome = invariode(*command)
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
