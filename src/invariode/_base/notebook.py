"""Problems and results in a notebook: short HTML tables, a small picture, formulas."""

from __future__ import annotations

import html
import inspect
import textwrap
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any

from .arguments import call_name

#: The most components and failures that are shown.
_MOST = 12


def html_of_problem(problem: Any) -> str:
    """Name, interval, components with their initial values, invariants, events; the source of f, folded."""
    labels = problem._labels or [f"y{i}" for i in range(len(problem.y0))]
    start = ", ".join(f"{label} = {value:.6g}" for label, value in zip(labels[:_MOST], problem.y0, strict=False))
    rows = [
        ("interval", f"{problem.t_span[0]:g} to {problem.t_span[1]:g}"),
        ("start", start + (f", … ({len(labels)} components)" if len(labels) > _MOST else "")),
        ("arguments", ", ".join(map(repr, problem.args))),
        ("kept", ", ".join(name for one in problem.invariants for name in one.names or [call_name(one.fun, "g")])),
        ("events", ", ".join(event.__name__ for event in problem.events)),
        ("mass matrix", "yes" if problem.matrices.mass is not None else ""),
    ]
    return _titled(problem.name, _table(rows)) + _source(problem.fun)


def html_of_solution(sol: Any, picture: str) -> str:
    """Return an HTML summary of a run, its outcome and output, beside a small picture."""
    stats = sol.stats
    rows = [
        ("status", f"{'✓' if sol.success else '✗'} {sol.message}"),
        ("reached", f"t = {sol.t_end:.10g}"),
        ("output", f"{len(sol.t)} times, {len(sol.y)} components"),
        ("steps", f"{stats.steps}, {stats.failed} failed"),
        ("evaluations", f"{sol.nfev} of f" + (f", {sol.njev} of its Jacobian" if sol.njev else "")),
    ]
    for name, t in zip(sol._names.events, sol.t_events or (), strict=False):
        rows.append((name, f"{len(t)} events" + (f", first at t = {t[0]:.6g}" if len(t) else "")))
    body = _table(rows)
    if len(sol._invariants):
        drift = sol.drift()
        columns = (drift.value, drift.residual_before, drift.residual_after)
        head = ("invariant", "value", "largest residual before", "after projection")
        body += _table(
            [(name, f"{value:.6g}", f"{before:.1e}", f"{after:.1e}") for name, value, before, after in
             zip(drift.names, *columns, strict=True)], head)  # fmt: skip
    return _titled(sol._names.problem, f'<div style="display:flex;gap:2em">{picture}<div>{body}</div></div>')


def html_of_ensemble(ensemble: Any) -> str:
    """Return an HTML summary of an ensemble: how its trajectories ended, and the messages of the first that failed."""
    counted = ((0, "reached the end"), (1, "had a terminal event"), (2, "were stopped by callback"))
    rows = [(what, str(k)) for status, what in counted if (k := int((ensemble.status == status).sum()))]
    rows += [(f"trajectory {i} failed", text) for i, text in list(ensemble.messages.items())[:_MOST]]
    if len(ensemble.messages) > _MOST:
        rows.append(("and others", str(len(ensemble.messages) - _MOST)))
    size, n = ensemble.y_end.shape
    rows.append(("evaluations of f", f"{int(ensemble.stats.nfev.sum())}"))
    return _titled(f"{size} trajectories of {n} components at {len(ensemble.t)} times", _table(rows))


def html_of_check(report: Any) -> str:
    """Return an HTML table of the report of a check, and its findings."""
    head = ("invariant", "value", "residual", "rate", "of its terms", "conserved")
    findings = "".join(f"<li>{html.escape(finding)}</li>" for finding in report.findings)
    listed = f"<ul>{findings}</ul>" if findings else ""
    return _titled("All is well" if report.ok else "Findings", _table(report.rows(), head) + listed)


def html_of_fit(fit: Any) -> str:
    """The parameters with their errors, how well the data are met, and what else must be known."""
    head = ("parameter", "value", "standard error", "95 % interval", "")
    rows = [(*row[:4], row[4] or "\N{NO-BREAK SPACE}") for row in fit.rows()]
    listed = "".join(f"<li>{html.escape(remark)}</li>" for remark in fit.remarks)
    return _titled("Fit", _table(rows, head) + html.escape(fit.summary()) + (f"<ul>{listed}</ul>" if listed else ""))


def latex_of_polynomial(coefficients: Any, labels: Sequence[str]) -> str:
    """A polynomial as a formula; `coefficients` by exponents of the components."""
    text = ""
    for exponents, c in coefficients.items():
        powers = [
            f"{_symbol(label)}^{{{e}}}" if e > 1 else _symbol(label)
            for label, e in zip(labels, exponents, strict=True)
            if e
        ]
        factors = powers if abs(c) == 1 and powers else [_number(abs(c)), *powers]
        text += ("-" if c < 0 else "+" if text else "") + r"\,".join(factors)
    return f"${text}$"


def _number(size: Any) -> str:
    if isinstance(size, Fraction) and size.denominator != 1:
        return rf"\tfrac{{{size.numerator}}}{{{size.denominator}}}"
    return str(size) if isinstance(size, Fraction) else f"{size:.12g}"


#: What stands for characters that mean something in formulas, or in HTML around them.
_SHOWN = {
    **{one: rf"\{one}" for one in "{}$&#%_ "},
    "\\": r"\backslash ",
    "^": r"\wedge ",
    "~": r"\sim ",
    "<": r"\lt ",
    ">": r"\gt ",
    "'": r"\prime ",
}


def _symbol(label: str) -> str:
    """A name in mathematical notation: y0 with an index, a word upright; characters that LaTeX reads as its own are
    shown."""
    label = label.replace("[", "").replace("]", "")
    stem = label.rstrip("0123456789")
    index, written = label[len(stem) :], "".join(_SHOWN.get(one, one) for one in stem)
    letter = f"{{{written}}}" if len(stem) == 1 and stem in _SHOWN else written
    if len(stem) != 1:
        letter = rf"\mathrm{{{written or label}}}"
    return f"{letter}_{{{index}}}" if index and stem else letter


def _titled(title: str, body: str) -> str:
    return f"<div><strong>{html.escape(title)}</strong>{body}</div>"


def _table(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Rows of text; rows without a value are left out."""
    top = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    style = "text-align:left;white-space:nowrap" if head else "text-align:left"  # long messages have no heading
    lines = [
        "<tr>" + "".join(f'<td style="{style}">{html.escape(cell)}</td>' for cell in row) + "</tr>"
        for row in rows
        if row[-1]
    ]
    return f"<table>{f'<tr>{top}</tr>' if top else ''}{''.join(lines)}</table>"


def _source(fun: Any) -> str:
    try:
        text = inspect.getsource(getattr(fun, "fun", fun))
    except (OSError, TypeError):  # typed at a prompt, or machine code
        return ""
    return f"<details><summary>fun</summary><pre>{html.escape(textwrap.dedent(text).strip())}</pre></details>"
