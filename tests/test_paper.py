"""The experiments of the paper: each published number is met, and the report shows them all."""

from __future__ import annotations

import dataclasses
import functools
import re
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from typer.testing import CliRunner

import invariode as iv
from cases import METHODS
from invariode.cli.app import app
from paper import Results, Row, experiments, lotka_volterra, pendulum, report, run, three_body
from paper.command import app as papers
from paper.matlab import clenshaw_curtis
from paper.plots import FIGURES
from paper.published import PAPER
from paper.rows import LAST_DIGIT, SIZE, at_digits_of, within


@functools.cache
def results() -> Results:
    """All experiments, run by the first test that needs them."""
    return run()


@functools.cache
def page() -> str:
    """The report, made by the first test that needs it."""
    return report(results())


def name_of(row: Row) -> str:
    return f"{row.experiment}: {row.quantity}"


def test_published_values_are_met():
    missed = [f"{name_of(row)}: published {row.printed}, here {row.value!r}" for row in results().rows if not met(row)]
    assert not missed, "\n".join(missed)


def met(row: Row) -> bool:
    """A row without a published value has nothing to meet but must be a number."""
    return np.isfinite(row.value) and row.agrees in (True, None)


def test_a_printed_number_stands_for_all_that_round_to_it():
    """Two units in the last place where one of them, 1.42e-14, is published as 1.4e-14."""
    ulp = np.spacing(121.8)
    rule = within(ulp, "to one unit in the last place")
    assert [rule.agree("1.4e-14", k * ulp) for k in (0, 1, 2, 3)] == [True, True, True, False]


def test_every_number_of_the_paper_has_a_row():
    # Section 6 and its figures: each where it stands, in the order of the paper's problems.
    compared = [(row.printed, row.source) for row in results().paper if row.printed]
    assert compared == list(PAPER.values())
    assert {"9.12", "8.80e-5", "7e-3", "1.4e-14", "1.19", "3.36e-4"} <= {printed for printed, _ in compared}


def test_words_of_the_paper_are_its_words_and_are_met_by_a_rule_that_is_said():
    # P. 70 on the three bodies, p. 71 on Fig. 2; for Fig. 1 the paper prints no number.
    words = {row.printed: row for row in results().paper if row.printed and not re.match(r"\d", row.printed)}
    assert set(words) == {"virtually zero", "dramatic", "proper", "periodic", "substantial"}
    assert all(row.rule.words for row in words.values())


@pytest.mark.parametrize(
    ("problem", "rows"), [("atol, ode45", 14), ("atol, ode113", 14), ("HIRES, ode15s", 5), ("0.05, ode15s", 1)]
)
def test_what_matlab_prints_is_compared_for_each_code(problem, rows):
    compared = [row for row in results().matlab if problem in row.experiment]
    assert len(compared) == rows
    assert all(row.printed and row in results().compared for row in compared)


@pytest.mark.parametrize(
    ("printed", "value", "shown"),
    [
        ("9.12", 9.117709, "9.12"),
        ("8.80e-5", 8.7976e-5, "8.80e-5"),
        ("9.882e-06", 9.8822e-6, "9.882e-06"),
        ("7e-3", 6.76e-3, "7e-3"),
        ("67", 67, "67"),
        ("7.853789e-01", 0.78537893, "7.853789e-01"),
        (None, 7.01e-5, "7.0e-5"),
        ("periodic", 1.57e-3, "1.6e-3"),
    ],
)
def test_value_is_shown_at_the_printed_digits(printed, value, shown):
    assert Row("", "", printed, value).here == shown


@pytest.mark.parametrize(
    ("row", "agrees"),
    [
        (Row("", "", "9.12", 9.1251), False),
        (Row("", "", "9.12", 9.1249), True),
        (Row("", "", "97", 98), False),
        (Row("", "", "4.382e-12", 4.3834e-12, rule=LAST_DIGIT), True),
        (Row("", "", "4.382e-12", 4.3846e-12, rule=LAST_DIGIT), False),
        (Row("", "", "4.396e-14", 9e-14, rule=SIZE), True),
        (Row("", "", "4.396e-14", 4e-13, rule=SIZE), False),
        (Row("", "", "9.12", np.nan), False),
        (Row("", "", None, 1.0), None),
    ],
)
def test_verdict_is_computed(row, agrees):
    assert row.agrees is agrees


def test_digits_carry_into_the_exponent():
    assert at_digits_of("8.80e-5", 9.999e-5) == "1.00e-4"


@pytest.mark.parametrize("factory", [lotka_volterra, pendulum, three_body])
def test_jacobian_of_each_invariant_is_that_of_differences(factory):
    problem = factory()
    (g,) = problem.invariants
    rng = np.random.default_rng(1999)
    h = np.cbrt(np.finfo(float).eps)
    for _ in range(20):
        y = problem.y0 + 0.05 * rng.standard_normal(len(problem.y0))
        differences = [
            (np.asarray(g.fun(0, y + h * e)) - np.asarray(g.fun(0, y - h * e))) / (2 * h) for e in np.eye(len(y))
        ]
        jacobian = np.atleast_2d(g.jac(0, y))
        np.testing.assert_allclose(
            jacobian, np.atleast_2d(np.transpose(differences)), atol=1e-6 * np.abs(jacobian).max()
        )


@pytest.mark.parametrize("n", range(1, 9))
def test_clenshaw_curtis_is_exact_for_polynomials_through_its_nodes(n):
    u, w = clenshaw_curtis(n)
    for degree in range(n):
        assert w @ u**degree == pytest.approx((1 + (-1) ** degree) / (degree + 1), abs=1e-13)


class Page(HTMLParser):
    """The references of a page, and the ids in it."""

    def __init__(self) -> None:
        super().__init__()
        self.tags, self.ids, self.references, self.loaded = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            elif key in ("href", "xlink:href"):
                self.references.append(value)
            elif key in ("src", "srcset", "data", "poster", "action"):
                self.loaded.append(value)


def test_report_is_self_contained():
    parsed = Page()
    parsed.feed(page())
    assert not parsed.loaded
    assert not {"script", "link", "iframe", "object", "img"} & set(parsed.tags)
    assert all(reference.startswith("#") for reference in parsed.references)
    assert {reference[1:] for reference in parsed.references} <= set(parsed.ids)
    assert "@import" not in page()
    assert all(target.startswith("#") for target in re.findall(r"url\(\s*([^)]*)\)", page()))


def test_ids_of_the_figures_do_not_collide():
    parsed = Page()
    parsed.feed(page())
    assert len(parsed.ids) == len(set(parsed.ids))


def test_report_shows_every_figure_and_every_row():
    assert page().count("<svg ") == page().count("</svg>") == len(FIGURES)
    for plot in FIGURES:
        assert f'aria-label="{plot.title}"' in page()
    for row in results().rows:
        assert f'<td class="n">{row.here}</td>' in page()
    for code in results().codes:
        for sol, size in zip((code.plain, code.projected), code.residuals, strict=True):
            s = sol.stats
            assert f"<td>{s.steps}</td><td>{s.failed}</td><td>{s.nfev}</td><td>{size:.2e}</td>" in page()
        assert all(f"<td>{gap:.3g}</td>" in page() for gap in code.gaps or ())
    for one in results().kinetics:
        given, differences = one.drifts
        assert f"<td>{given:.1e}</td><td>{differences:.1e}</td>" in page()
    assert page().count("✓ agrees") == len(results().compared)
    assert "✗" not in page()


def test_report_says_how_it_was_made():
    for text in ("make paper", iv.__version__, np.__version__, "All codes", "Robertson", "ode113"):
        assert text in page()


def with_a_wrong_row() -> Results:
    first, *others = results().matlab
    return dataclasses.replace(results(), matlab=[dataclasses.replace(first, value=first.value + 1), *others])


def test_report_shows_what_differs(monkeypatch):
    monkeypatch.setattr("paper.plots.svg", lambda *figure: "")  # they do not show it, and take a second
    wrong = report(with_a_wrong_row())
    compared = len(results().compared)
    assert wrong.count("✗ differs") == 1
    assert f"{compared - 1} of {compared} published values are met" in wrong


def test_the_command_prints_the_table_and_writes_the_report(tmp_path):
    output = tmp_path / "paper.html"
    outcome = CliRunner().invoke(papers, ["--output", str(output)], env={"COLUMNS": "120"})
    assert outcome.exit_code == 0, outcome.output
    assert "8.80e-5" in outcome.output
    assert outcome.output.index("paper") < outcome.output.index("plain → projected") < outcome.output.index("MATLAB")
    for code in results().codes:
        s, t = code.plain.stats, code.projected.stats
        assert f"{s.failed} → {t.failed}" in outcome.output
        assert f"{s.nfev} → {t.nfev}" in outcome.output
    assert "Robertson, y₁ + y₂ + y₃ = 1" in outcome.output
    assert f"All {len(results().compared)} published values are met" in outcome.output
    assert "</html>" in output.read_text(encoding="utf-8")


@pytest.mark.parametrize("columns", [80, 120])
def test_table_fits_the_terminal(columns, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("paper.command.run", results)
    outcome = CliRunner().invoke(papers, ["--no-report"], env={"COLUMNS": str(columns)})
    assert outcome.exit_code == 0, outcome.output
    assert "…" not in outcome.output
    assert max(map(len, outcome.output.splitlines())) <= columns
    assert ("proj." in outcome.output) == (columns == 120)
    assert not list(tmp_path.iterdir())


def test_the_command_fails_when_a_number_differs(monkeypatch):
    monkeypatch.setattr("paper.command.run", with_a_wrong_row)
    outcome = CliRunner().invoke(papers, ["--no-report"])
    assert outcome.exit_code == 1
    assert "1 of" in outcome.output


def test_ctrl_c_ends_the_command_with_130(monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr("paper.command.run", interrupted)
    outcome = CliRunner().invoke(papers, ["--no-report"])
    assert (outcome.exit_code, outcome.output) == (130, "Interrupted.\n")


def test_the_command_needs_a_directory(tmp_path):
    outcome = CliRunner().invoke(papers, ["--output", str(tmp_path / "none" / "paper.html")])
    assert outcome.exit_code == 2
    assert "no such directory" in outcome.output


def test_the_command_without_matplotlib_says_what_to_install(monkeypatch):
    monkeypatch.setattr("invariode.cli.session.find_spec", lambda name: None)
    outcome = CliRunner().invoke(papers, [])
    assert outcome.exit_code == 1
    assert "--no-report" in outcome.output
    assert 'pip install "invariode[paper]"' in outcome.output


def test_command_methods_lists_the_registry():
    outcome = CliRunner().invoke(app, ["methods"], env={"COLUMNS": "100"})
    assert outcome.exit_code == 0, outcome.output
    text = " ".join(outcome.output.split())
    for method in iv.METHODS.values():
        orders = str(method.order) if method.fixed_order else f"{method.min_order}–{method.order}"
        assert f"{method.name} {method.scipy_name or '–'} {orders} {method.extension_order}" in text
        assert f"options: {', '.join(method.options)}" in text
    assert "BDF implies bdf=True" in text


def command(*arguments: str, prelude: str = "") -> subprocess.CompletedProcess[str]:
    """The console entry point in a process of its own, after `prelude`."""
    code = f"{prelude}\nimport sys\nfrom invariode.cli import main\nsys.argv = ['invariode', *{arguments!r}]\nmain()"
    warnings = ("-W", "error", "-W", "ignore::DeprecationWarning")  # old releases of other packages use what goes
    return subprocess.run([sys.executable, *warnings, "-c", code], capture_output=True, text=True, check=False)


def test_entry_point():
    assert command("--version").stdout.strip() == f"invariode {iv.__version__}"
    help_text = command("--help")
    assert help_text.returncode == 0
    assert "invariode solve pendulum.py" in help_text.stdout
    assert command("papers").returncode == 2


def test_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "invariode.cli", "methods"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "ode45" in done.stdout


@pytest.mark.parametrize("missing", ["typer", "rich"])
def test_missing_extra_is_named(missing):
    done = command("methods", prelude=f"import sys; sys.modules['{missing}'] = None")
    assert done.returncode == 1
    assert done.stderr.strip() == f'The command line needs {missing}: pip install "invariode[cli]"'


def test_library_and_table_need_no_extra():
    blocked = "import sys; sys.modules.update(matplotlib=None, typer=None, rich=None)"
    code = f"{blocked}\nfrom paper import run\nassert run().agree"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_all_codes_run_on_all_problems_and_gain_by_projection():
    codes = results().codes
    assert {code.method for code in codes} == set(METHODS)
    assert len(codes) == 3 * len(METHODS)
    for code in codes:
        assert code.plain.success
        assert code.projected.success
        plain, projected = code.residuals
        assert projected < 0.02 * plain, f"{code.problem}, {code.method}"


@pytest.mark.parametrize("method", experiments.GENERAL)
def test_projection_closes_the_orbit_in_the_median_over_tolerances(method):
    """At one tolerance the gap of either orbit may be small by chance."""
    ratios = []
    for rtol in 10.0 ** -np.linspace(3, 6, 13):
        plain, projected = (
            experiments.solved(experiments.three_body(imposed=imposed), method, rtol=rtol, atol=1e-3 * rtol)
            for imposed in (False, True)
        )
        ratios.append(experiments.gap(projected) / experiments.gap(plain))
    # Of order 2 most of the error lies along the orbit, which projection does not change.
    assert np.median(ratios) < (0.95 if iv.METHODS[method].order == 2 else 0.5)


def test_the_orbit_of_figure_1_closes_for_no_more_f():
    adams, projected = results().three_body.adams, results().three_body.adams_projected
    assert experiments.gap(adams) > 0.45
    assert experiments.gap(projected) <= 0.03
    assert projected.nfev <= adams.nfev


@pytest.fixture(params=[kinetic.problem.name for kinetic in experiments.KINETICS])
def one(request):
    """One of the problems of chemical kinetics, solved."""
    (found,) = (one for one in results().kinetics if one.kinetic.problem.name == request.param)
    return found


def test_linear_invariants_of_stiff_problems_need_no_projection(one):
    problem = one.kinetic.problem
    for sol in (one.given, one.differences):
        assert sol.t[-1] == problem.t_span[1]
        assert not sol.stats.projections
    held = problem.invariants[0].fun(0, problem.y0)
    given, differences = one.drifts
    assert given <= one.given.stats.steps * np.finfo(float).eps * held  # roundoff of each step
    assert differences <= 1e-3 * experiments.KINETICS_RTOL * held  # measured: 3e-11 and 2e-17


def test_jacobian_of_the_kinetics_keeps_the_invariant_and_is_that_of_differences(one):
    problem = one.kinetic.problem
    (kept,) = problem.invariants[0].jac(0, problem.y0)
    for y in one.given.y.T[:: len(one.given.t) // 8]:
        J = np.asarray(problem.matrices.jac(0, y))
        scale = np.abs(J).max()
        assert np.abs(kept @ J).max() <= 4 * np.finfo(float).eps * scale
        # f is quadratic, so that central differences have no error but roundoff.
        h = 1e-3
        columns = [
            (np.subtract(problem.fun(0, y + h * e), problem.fun(0, y - h * e))) / (2 * h) for e in np.eye(len(y))
        ]
        np.testing.assert_allclose(J, np.transpose(columns), atol=1e-9 * np.abs(np.transpose(columns)).max())
