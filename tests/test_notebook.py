"""Summaries in notebooks: well-formed HTML with the numbers of the text form, and nothing of the user's as markup."""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

import invariode as iv
from invariode._base.notebook import latex_of_polynomial


class Parsed(HTMLParser):
    """The text, and whether every element is closed."""

    def __init__(self, source):
        super().__init__()
        self.open, self.text, self.tags = [], "", []
        self.feed(source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data + " "


def rotation(t, y):
    return [y[1], -y[0]]


def problem(**described):
    radius = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2, names="<radius>")
    given = {"invariants": radius, "events": lambda t, y: y[0], "labels": ["a&b", "c"], "name": "x < y", **described}
    return iv.Problem(rotation, (0, 10), [1.0, 0.0], **given)


def test_a_problem_shows_what_is_known_of_it():
    shown = Parsed(problem(args=())._repr_html_())
    for text in ("x < y", "0 to 10", "a&b = 1, c = 0", "<radius>", "event", "return [y[1], -y[0]]"):
        assert text in shown.text
    assert "mass" not in shown.text
    assert "(40 components)" in Parsed(iv.Problem(lambda t, y: -y, (0, 1), np.ones(40))._repr_html_()).text


def test_the_source_of_a_problem_keeps_its_indentation():
    """Functions that are themselves indented begin at the margin, and their lines stand as far behind it as before."""

    def spring(t, y):
        if t > 1:
            return [y[1], 0.0]
        return [y[1], -y[0]]

    shown = iv.Problem(spring, (0, 1), [1.0, 0.0])._repr_html_()
    lines = ["def spring(t, y):", "    if t &gt; 1:", "        return [y[1], 0.0]", "    return [y[1], -y[0]]"]
    assert "<pre>" + "\n".join(lines) + "</pre>" in shown


def test_a_solution_shows_how_it_went_and_a_picture(monkeypatch):
    sol = problem().solve()
    shown = Parsed(sol._repr_html_())
    for text in (sol.message, f"{sol.stats.steps}, ", f"{sol.nfev} of f", "<radius>", "3 events, first at t = 1.57"):
        assert text in shown.text
    assert f"{sol.drift().residual_after[0]:.1e}" in shown.text
    assert "img" in shown.tags
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert "img" not in Parsed(sol._repr_html_()).tags


def test_the_picture_calls_no_f_and_does_not_bridge_jumps(monkeypatch):
    calls, drawn = [], []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *file, **options: drawn.append(figure))
    hit = iv.Event(lambda t, y: y[0], direction=-1, action=lambda t, y: [0, -y[1] / 2])
    sol = iv.solve_ivp(lambda t, y: calls.append(t) or [y[1], -1], (0, 2), [1.0, 0], events=hit)
    before = len(calls)
    sol._repr_html_()
    assert len(calls) == before
    (ax,) = drawn[0].axes
    assert np.isnan(ax.lines[1].get_ydata()).sum() == len(sol.t_events[0])


@pytest.mark.parametrize("options", [{"keep": "end"}, {"t_eval": []}, {"t_eval": [1.0]}])
def test_so_does_one_of_few_points(options):
    assert "img" not in Parsed(problem().solve(**options)._repr_html_()).tags


def test_one_that_failed():
    sol = iv.solve_ivp(lambda t, y: y**2, (0, 2), [1.0])
    assert f"✗ {sol.message}" in Parsed(sol._repr_html_()).text


@pytest.mark.filterwarnings("ignore::invariode.FailureWarning")
def test_an_ensemble_counts_how_trajectories_ended():
    m = iv.solve_ensemble(lambda t, y: y**2, (0, 2), [[0.1], [1.0]], workers=1)
    shown = Parsed(m._repr_html_())
    for text in ("2 trajectories of 1 components", "reached the end", "trajectory 1 failed", m.messages[1]):
        assert text in shown.text


def test_a_report_shows_its_findings():
    report = iv.check_invariants(rotation, lambda t, y: y[0] ** 2 + 1.1 * y[1] ** 2, 0, [1.0, 0.5])
    shown = Parsed(report._repr_html_())
    assert "NO" in shown.text
    assert report.findings[0] in shown.text


def test_found_invariants_are_formulas():
    (found,) = iv.find_invariants(rotation, (0, 5), [1.0, 0.3])
    assert found._repr_latex_() == "$y_{0}^{2}+y_{1}^{2}$"
    from fractions import Fraction

    made = iv.PolynomialInvariant({(1, 2): Fraction(-1, 2), (0, 1): 0.25, (0, 0): Fraction(3)}, ["x", "speed"])
    assert made._repr_latex_() == r"$-\tfrac{1}{2}\,x\,\mathrm{speed}^{2}+0.25\,\mathrm{speed}+3$"


def test_labels_in_formulas_are_shown_as_they_are():
    """No label is read as LaTeX, or as HTML around it."""
    formula = latex_of_polynomial({(1, 0): 1, (0, 1): 1}, ["x_1", r"\a{$%"])
    assert formula == r"$\mathrm{x\_}_{1}+\mathrm{\backslash a\{\$\%}$"
    for label in ("%", "a b", "^2", "<b>", "50%", "#", "q'", "12"):
        inside = latex_of_polynomial({(1,): 1}, [label])[1:-1]
        bare = re.sub(r"\\[^a-z]", "", inside)  # without what is escaped
        assert not set(bare) & set("$%#&<>~^ ") - {" "}, inside
        assert bare.count("{") == bare.count("}")
