"""The report: one HTML file with the table 'paper | here' and the figures, nothing loaded from elsewhere."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Iterable, Iterator
from html import escape
from importlib.metadata import version
from itertools import groupby

import numpy as np

from .experiments import Results
from .rows import Row

__all__ = ["report"]

TITLE = "Conservation laws and the numerical solution of ODEs, II: the experiments, run again"
PAPER = (
    "L. F. Shampine, <cite>Conservation laws and the numerical solution of ODEs, II</cite>, "
    "Computers Math. Applic. 38 (1999) 61–72"
)

#: Which figures stand under which heading, and the sentences that introduce them.
SECTIONS = (
    (
        "Lotka–Volterra",
        "x′ = 2x(1 − y), y′ = −y(1 − x), from (1, 3). The invariant is "
        "x<sup>−1</sup> e<sup>x</sup> y<sup>−2</sup> e<sup>2y</sup>. Imposing it at each step takes its "
        "residual from 9 to 10<sup>−4</sup> and costs no evaluation of f.",
        ("phase", "residual", "step"),
    ),
    (
        "Pendulum in Cartesian coordinates",
        "x″ = −λx, y″ = −λy − 1, from rest at (1, 0). The paper calls 1.19 the length of the pendulum; it is the "
        "largest residual of x²&nbsp;+&nbsp;y²&nbsp;−&nbsp;1, so that the length reaches √2.19&nbsp;=&nbsp;1.48.",
        ("bob", "length"),
    ),
    (
        "Restricted three-body problem",
        "One period of the orbit of MATLAB’s demonstration, with ode113 as in the paper’s Fig. 1. From the paper are "
        "the problem, the code, the tolerances, the figure and two statements: that this is the most dramatic of its "
        "experiments, and that the orbit has the proper qualitative behaviour when the Jacobi integral is imposed. It "
        "prints no gap: the distances between start and end are ours, and so is the rule that a hundredth of the "
        "orbit’s width is what a reader of the figure sees.",
        ("plain", "projected"),
    ),
)

STYLE = """
:root { --ink: #20242c; --quiet: #626a76; --line: #dfe3e9; --good: #1d7a55; --bad: #c02942; --accent: #1f5f9e; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: #fff; color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto,
  "Helvetica Neue", "Noto Sans", "Liberation Sans", Arial, sans-serif; font-variant-numeric: tabular-nums; }
main { max-width: 64rem; margin: 0 auto; padding: 3.5rem 2rem 4rem; }
h1 { font-size: 2rem; line-height: 1.2; font-weight: 650; letter-spacing: -0.015em; margin: 0 0 0.6rem;
  max-width: 26em; text-wrap: balance; }
h2 { font-size: 1.3rem; line-height: 1.3; font-weight: 650; letter-spacing: -0.01em; margin: 3.2rem 0 0.5rem; }
p { margin: 0.5rem 0; max-width: 46em; text-wrap: pretty; }
sup { line-height: 0; font-size: 0.75em; }
.source, .lead + p { color: var(--quiet); }
.lead { font-size: 1.08rem; margin-top: 1.4rem; }
cite { font-style: italic; }
code { font: 0.9em ui-monospace, "SF Mono", Menlo, Consolas, "Liberation Mono", monospace; background: #f3f5f8;
  border-radius: 4px; padding: 0.12em 0.4em; }
table { border-collapse: collapse; width: 100%; margin: 1rem 0 0; }
th, td { text-align: left; vertical-align: baseline; padding: 0.42rem 0.9rem 0.42rem 0;
  border-bottom: 1px solid var(--line); }
thead th { font-size: 0.82rem; font-weight: 600; color: var(--quiet); border-bottom-color: #aab1bc; }
tbody th { font-weight: 600; padding-top: 1.3rem; }
td.n { white-space: nowrap; width: 8.5rem; }
td.v, thead th:last-child { width: 5.5rem; padding-right: 0; }
td.v { white-space: nowrap; color: var(--quiet); }
.numbers { overflow-x: auto; }
.numbers table { width: auto; }
.numbers th, .numbers td { width: auto; padding-right: 2.2rem; }
.numbers td + td, .numbers thead th + th { text-align: right; white-space: nowrap; }
.numbers th:last-child, .numbers td:last-child { width: auto; padding-right: 0; }
.numbers tr.pair td { border-bottom: 0; padding-bottom: 0; }
.yes { color: var(--good); }
.no { color: var(--bad); font-weight: 600; }
small { display: block; font-size: 0.8rem; line-height: 1.4; color: var(--quiet); }
.figures { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1.6rem 2.5rem; margin-top: 1.2rem; }
figure { margin: 0; }
figure svg { display: block; width: 100%; height: auto; }
figcaption { font-size: 0.9rem; line-height: 1.5; color: var(--quiet); margin-top: 0.7rem; }
figcaption b { display: block; color: var(--ink); font-weight: 600; }
figure.alone { grid-column: 1 / -1; display: grid; grid-template-columns: subgrid; align-items: center; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.25rem 1.5rem; margin: 0.8rem 0 0; }
dt { color: var(--quiet); }
dd { margin: 0; }
@media (max-width: 46rem) {
  main { padding: 1.8rem 1rem 2.5rem; }
  h1 { font-size: 1.5rem; }
  h2 { margin-top: 2.4rem; }
  .figures { grid-template-columns: minmax(0, 1fr); gap: 2rem; }
  figure.alone { display: block; }
  .rows, .rows thead, .rows tbody { display: block; }
  .rows tr { display: grid; grid-template-columns: 1fr 1fr 5.5rem; column-gap: 0.8rem;
    border-bottom: 1px solid var(--line); }
  .rows thead tr { border-bottom-color: #aab1bc; }
  .rows thead th:first-child { display: none; }
  .rows th, .rows td { border: 0; padding: 0 0 0.5rem; }
  .rows tbody th, .rows td:first-child { grid-column: 1 / -1; padding: 0.5rem 0 0.15rem; }
  .rows tbody th { padding: 1.2rem 0 0.5rem; }
  .rows td.n, .rows td.v { width: auto; }
  .numbers { font-size: 0.85rem; }
  .numbers table { width: 100%; }
  .numbers th, .numbers td { padding-right: 0.5rem; }
  .numbers thead th { font-size: 0.75rem; }
}
@media print { main { padding: 0; } figure, tr { break-inside: avoid; } }
"""


def report(results: Results, command: str = "invariode paper") -> str:
    """The page.

    Parameters
    ----------
    results : Results
        From `run`.
    command : str
        The command that makes the page, which it shows.

    Returns
    -------
    str
        A complete HTML document; plots are inline SVG, and nothing is loaded from elsewhere.

    Raises
    ------
    ModuleNotFoundError
        matplotlib, the extra `plot`, is not installed.
    """
    from .plots import FIGURES, svg

    figures = {plot.name: (plot, svg(plot, results)) for plot in FIGURES}
    sections = []
    for title, text, names in SECTIONS:
        drawn = "".join(
            f"<figure{' class=alone' if len(names) % 2 and name == names[-1] else ''}>{figures[name][1]}"
            f"<figcaption><b>{figures[name][0].title}</b>{figures[name][0].caption}</figcaption></figure>\n"
            for name in names
        )
        sections.append(
            f'<section>\n<h2>{title}</h2>\n<p>{text}</p>\n<div class="figures">\n{drawn}</div>\n</section>\n'
        )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{TITLE}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<header>
<h1>{TITLE}</h1>
<p class="source">{PAPER}.</p>
{_abstract(results)}
</header>
<section>
<h2>Paper and here</h2>
{_table(results.paper, "paper")}
</section>
{"".join(sections)}
<section>
<h2>All codes on all three problems</h2>
<p>At default tolerances, the first line of each code without the invariants, the second with them imposed: the largest
residual of the invariants at the steps and, of the closed orbit, the distance in position between start and end. The
correction enters the memory of the multistep codes, so that what they store belongs to the projected solution. dop853
and ode78 are not codes of the paper: their order 8 leaves so little error here that there is little to gain.</p>
{_codes(results)}
</section>
<section>
<h2>Linear invariants of stiff problems</h2>
<p>Stiff problems of chemical kinetics have linear invariants, which methods preserve automatically (paper, section 5).
So does ode15s here at rtol 10<sup>−6</sup>, without projection: to round-off where the Jacobian is given; where it is
formed by differences, to their round-off, times h, unless that cancels, as in HIRES, whose last two rows are exact
negatives. This is not counted as a gain of projection, and the paper prints no numbers for it.</p>
{_kinetics(results)}
</section>
<section>
<h2>Printed by MATLAB</h2>
<p>What MATLAB’s ode45, ode113 and ode15s print for other problems: counts, errors, event times and a failure that
the same formulas and the same step control must meet.</p>
{_table(results.matlab, "MATLAB")}
</section>
<section>
<h2>Made with</h2>
{_colophon(command)}
</section>
</main>
</body>
</html>
"""


def _abstract(results: Results) -> str:
    compared = results.compared
    agreeing = sum(bool(row.agrees) for row in compared)
    all_met = agreeing == len(compared)
    outcome = (
        f"All {len(compared)} published values are met"
        if all_met
        else f"{agreeing} of {len(compared)} published values are met"
    )
    return (
        '<p class="lead">The paper projects each step of the codes of the MATLAB ODE Suite onto the invariants of the '
        "equations, and shows on three problems what that changes. Here its section 6 is run again with "
        f"the four codes of the suite in invariode. {outcome}, at the digits as printed unless a line says otherwise; "
        "where the paper has words and no number, the rule by which they are met is ours, and stands in the line.</p>"
    )


def _table(rows: Iterable[Row], printed: str) -> str:
    body = "\n".join(_lines(rows))
    head = "".join(f'<th scope="col">{name}</th>' for name in ("quantity", printed, "here", "verdict"))
    return f"<table class=rows>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"


def _codes(results: Results) -> str:
    """Counts, residuals and gaps of each code: a line plain, a line projected."""
    lines = []
    for problem, group in groupby(results.codes, key=lambda code: code.problem):
        lines.append(f'<tr><th colspan="6" scope="rowgroup">{problem}</th></tr>')
        for code in group:
            gaps = [f"{gap:.3g}" for gap in code.gaps] if code.gaps else ["", ""]
            for name, sol, size, gap in zip(
                (code.method, "projected"), (code.plain, code.projected), code.residuals, gaps, strict=True
            ):
                s = sol.stats
                cells = "".join(f"<td>{cell}</td>" for cell in (name, s.steps, s.failed, s.nfev, f"{size:.2e}", gap))
                lines.append(f"<tr>{cells}</tr>" if sol is code.projected else f"<tr class=pair>{cells}</tr>")
    return _numbers(("code", "steps", "failed", "f", "residual", "gap"), lines)


def _kinetics(results: Results) -> str:
    """The drift of the linear invariants."""
    lines = []
    for one in results.kinetics:
        given, differences = one.drifts
        note = f"{one.problem.invariant}, t ≤ {one.problem.t_span[1]:g}, {one.given.stats.steps} steps"
        lines.append(
            f"<tr><td>{one.problem.name}<small>{note}</small></td><td>{given:.1e}</td><td>{differences:.1e}</td></tr>"
        )
    return _numbers(("largest drift of the invariant", "Jacobian given", "by differences"), lines)


def _numbers(head: Iterable[str], lines: Iterable[str]) -> str:
    """A table of numbers, which scrolls where the page is too narrow for it."""
    columns = "".join(f'<th scope="col">{name}</th>' for name in head)
    body = "\n".join(lines)
    return f"<div class=numbers><table>\n<thead><tr>{columns}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>"


def _lines(rows: Iterable[Row]) -> Iterator[str]:
    for experiment, group in groupby(rows, key=lambda row: row.experiment):
        yield f'<tr><th colspan="4" scope="rowgroup">{escape(experiment)}</th></tr>'
        for row in group:
            note = f"<small>{_note(row)}</small>" if _note(row) else ""
            yield (
                f'<tr><td>{escape(row.quantity)}{note}</td><td class="n">{escape(row.printed or "–")}</td>'
                f'<td class="n">{row.here}</td><td class="v">{_verdict(row)}</td></tr>'
            )


def _note(row: Row) -> str:
    """Where the published value stands, the counts of the run, and the rule if it is not the usual one."""
    parts = [row.source] if row.source != "MATLAB" else []
    if row.counts is not None:
        steps, failed, nfev, projections, ng = row.counts
        parts.append(
            f"{steps} steps, {failed} failed, {nfev} f"
            + (f", {projections} projections, {ng} g" if projections else "")
        )
    if row.rule.words:
        parts.append(f"met {row.rule.words}")
    return escape(" · ".join(part for part in parts if part))


def _verdict(row: Row) -> str:
    if row.agrees is None:
        return '<span aria-label="nothing published">–</span>'
    mark, word, kind = ("✓", "agrees", "yes") if row.agrees else ("✗", "differs", "no")
    return f'<span class="{kind}">{mark} {word}</span>'


def _colophon(command: str) -> str:
    entries = (
        ("command", f"<code>{escape(command)}</code>"),
        ("invariode", version("invariode")),
        ("NumPy", np.__version__),
        ("Python", platform.python_version()),
        ("date", datetime.date.today().isoformat()),
    )
    return "<dl>" + "".join(f"<dt>{term}</dt><dd>{value}</dd>" for term, value in entries) + "</dl>"
