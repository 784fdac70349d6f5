"""`invariode check`: are these functions invariants? At the start, and along a solution."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.text import Text

from .._base.types import MethodName
from .._problem.problem import Problem
from .._studies.check import CheckReport, checked_at
from .._studies.precision import Lowest, below_zero, unprojected, without_word
from .load import File, load
from .session import ATOL, RTOL, complete_method, examples, guarded, method_of, numbers, stop

EXAMPLES = examples("check pendulum.py", "check orbits.py:kepler --along 20 --method dop853")

#: Tolerances of the solution used by --along, relative to those that its points must meet.
TIGHTER = 1e-3


def check(
    file: File,
    along: Annotated[
        int,
        typer.Option(
            "--along", metavar="N", min=0, help="Also check at N points along a solution.", show_default=False
        ),
    ] = 0,
    method: Annotated[
        str,
        typer.Option("--method", "-m", metavar="NAME", autocompletion=complete_method, help="Its method."),
    ] = "ode45",
    rtol: Annotated[
        float, typer.Option("--rtol", metavar="NUMBER", help="Relative tolerance; distances are in units of it.")
    ] = RTOL,
    atol: Annotated[
        float, typer.Option("--atol", metavar="NUMBER", help="Size below which a component counts as small.")
    ] = ATOL,
) -> None:
    """Report whether a problem's equations conserve its invariants.

    At the initial point: the value held, how far the point is off, and the rate d/dt of the invariant along the
    equations, absolute and in units of its terms (roundoff for invariants). A dissipated function must have a rate of
    the right sign; the table then says "falls" or "rises". What is conserved there is also tested at
    points nearby and along a short run. [bold]--along[/] adds points along a solution computed without projection, with
    tolerances a thousand times smaller, and names a component that falls below 0 by more than 100 atol at the given
    tolerances only.

    Exit codes: 0 all is well, 1 there are findings, 2 the arguments or the file are wrong, 130 Ctrl-C.
    """
    name = method_of(method)[1]
    console = Console(highlight=False)
    with guarded():
        problem = load(file)
        _checkable(problem)
        t0, tf = problem.t_span
        report = checked_at(problem, t0, problem.y0, rtol=rtol, atol=atol, nearby=True)
        _print_report(console, problem, report)
        findings = list(report.findings)
        if along:
            if not np.isfinite(tf):
                raise typer.BadParameter(f"the interval of {problem.name} has no end", param_hint="--along")
            times = np.linspace(t0, tf, along + 1)
            lowest = Lowest(problem.y0)
            tight: dict[str, Any] = {"rtol": TIGHTER * rtol, "atol": TIGHTER * atol}
            sol = without_word(unprojected(problem)).solve(name, t_eval=times, callback=lowest, **tight)
            points = zip(sol.t[1:].tolist(), sol.y.T[1:], strict=True)
            reports = [checked_at(problem, t, y, rtol=rtol, atol=atol, nearby=False) for t, y in points]
            if reports:
                console.print()
                findings += _print_along(console, sol.t[1:], reports)
            if not sol.success:
                raise stop(sol.message, code=1)
            _print_below_zero(console, problem, name, lowest, rtol, atol)
    if findings:
        raise typer.Exit(1)


def _print_below_zero(
    console: Console, problem: Problem, method: MethodName, accurate: Lowest, rtol: float, atol: float
) -> None:
    """Print which component becomes negative at the given tolerances, and not in the solution that was checked."""
    lowest = Lowest(problem.y0)
    without_word(unprojected(problem)).solve(method, rtol=rtol, atol=atol, callback=lowest, keep="end")
    found = below_zero(problem.y0, lowest.values, accurate.values, atol)
    if found is None:
        return
    finding = found.in_words(problem.labels[found.component])
    console.print(
        Text(
            f"With rtol {rtol:g} and atol {atol:g} {finding}: if it cannot be negative, give the problem nonnegative=.",
            style="yellow",
        )
    )


def _checkable(problem: Problem) -> None:
    if not problem.invariants:
        raise stop(
            f"{problem.name} has no invariants: there is nothing to check. invariode.find_invariants looks for "
            "polynomial ones.",
            code=2,
        )
    if problem.matrices.mass is not None:
        raise stop("check is for y' = f(t, y), and this problem has a mass matrix; a solve checks it at its start.", 2)


def _print_report(console: Console, problem: Problem, report: CheckReport) -> None:
    console.print(Text.assemble((problem.name, "bold"), f", at the start, t = {problem.t_span[0]:g}"))
    table = numbers("invariant", ("value", "residual", "rate", "of its terms", "conserved"))
    for name, *sizes, verdict in report.rows():
        table.add_row(Text(name), *sizes, Text(verdict, style="bold red" if verdict == "NO" else "green"))
    console.print(table)
    for finding in report.findings:
        console.print(Text(finding, style="red" if not report.ok else "yellow"))
    if not report.findings:
        console.print(
            Text(
                "All invariants are conserved, independent and satisfied at the start; their Jacobians are correct.",
                style="green",
            )
        )


def _print_along(console: Console, times: np.ndarray, reports: list[CheckReport]) -> list[str]:
    """Print the worst of each invariant, and each finding with where it was first made."""
    console.print(Text.assemble(("along a solution", "bold"), f", at {len(reports)} points to t = {times[-1]:g}"))
    table = numbers("invariant", ("largest rate", "of its terms", "conserved at"))
    for i, name in enumerate(reports[0].names):
        kept = sum(bool(report.conserved[i]) for report in reports)
        rate, angle = (max(abs(getattr(report, size)[i]) for report in reports) for size in ("rate", "angle"))
        mark = Text(f"{kept} of {len(reports)}", style="green" if kept == len(reports) else "bold red")
        table.add_row(Text(name), f"{rate:.2e}", f"{angle:.1e}", mark)
    console.print(table)
    made: dict[str, list[float]] = {}
    for t, report in zip(times, reports, strict=True):
        for finding in report.findings:
            made.setdefault(finding.partition(": its entry")[0], []).append(float(t))
    findings = [f"{finding}, first at t = {at[0]:g} ({len(at)} of {len(reports)})" for finding, at in made.items()]
    for finding in findings:
        console.print(Text(finding, style="red"))
    if not findings:
        console.print(Text("No problems found along the solution.", style="green"))
    return findings
