"""The command compare: a verdict in a sentence, and the table behind it."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest

import invariode as iv
from cases import METHODS
from command_files import FILES, flat, invariode, problem
from invariode._studies.precision import power

pytestmark = pytest.mark.usefixtures("command_files")


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


def test_compare_answers_first_and_quiet_answers_only():
    options = ("compare", "pendulum.py", "-m", "ode45", "--decades", "3-8", "--no-progress")
    loud, quiet = invariode(*options), invariode(*options, "--quiet", width=1000)
    assert flat(loud.output).startswith("Projection")
    assert "Reference:" in loud.output
    assert quiet.output.startswith("Projection")
    assert "Reference:" not in quiet.output
    assert len(quiet.output.splitlines()) == 2  # sentences; how long they are depends on times


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
