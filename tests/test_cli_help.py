"""Help, completion and documentation of the command show what it does."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

import invariode as iv
from command_files import FILES, invariode
from invariode._studies.precision import power
from invariode.cli.session import clock, count

pytestmark = pytest.mark.usefixtures("command_files")


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
    Path("pendulum.py").write_text(FILES["pendulum.py"].replace("(0, 10)", "(0, 0.5)"), encoding="utf-8")  # short runs
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
    """The pendulum.py of the example is the Python block of the page; only numbers may differ, between machines."""
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
