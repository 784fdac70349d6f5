"""`python -m paper`: the experiments of the paper, as a table and as a report."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from invariode.cli.session import guarded, needs, numbers, write_to

from . import Results, Row, report, run

__all__ = ["app", "paper"]

app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)

#: The columns of `Row.counts`, and the width of a terminal from which they are shown.
COUNTS = ("steps", "failed", "f", "proj.", "g")
ROOM_FOR_COUNTS = 112


@app.command()
def paper(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", dir_okay=False, writable=True, help="The file for the report."),
    ] = Path("paper-report.html"),
    no_report: Annotated[
        bool, typer.Option("--no-report", help="Only print the table; matplotlib and jinja2 are not needed.")
    ] = False,
) -> None:
    """Run the experiments of Shampine's paper and compare each published number.

    Prints the table 'paper | here' and writes a report with the figures as one HTML file.
    The exit code is 1 if any number differs.

    Example: [bold]python -m paper --output paper-report.html[/bold]
    """
    console = Console()
    if not no_report:
        needs("The report (--no-report leaves it out)", ("matplotlib", "jinja2"), "paper")
        if not output.parent.is_dir():
            raise typer.BadParameter(f"no such directory: {output.parent}", param_hint="--output")
    with guarded():
        results = run()
        _print_table(console, results.paper, "paper")
        _print_codes(console, results)
        _print_kinetics(console, results)
        _print_table(console, results.matlab, "MATLAB")
        console.print(_outcome(results))
        if not no_report:
            page = report(results)
    if not no_report:
        write_to(output, lambda: output.write_text(page, encoding="utf-8"))
        console.print("Report:", Text(str(output), style="bold"), soft_wrap=True)
    if not results.agree:
        raise typer.Exit(1)


def _print_table(console: Console, rows: Iterable[Row], published: str) -> None:
    """One table for each experiment, under its name and with the same columns; counts if there is room."""
    counts = COUNTS if console.width >= ROOM_FOR_COUNTS else ()
    console.print(_table(published, counts, heading=True))
    for experiment, group in groupby(rows, key=lambda row: row.experiment):
        table = _table(published, counts, heading=False)
        for row in group:
            counted = [str(count) for count in row.counts or ()][: len(counts)]
            table.add_row(escape(row.quantity), row.printed or "–", row.here, _verdict(row), *counted)
        console.print(Text(experiment, style="bold"), table, "", sep="\n")


def _print_codes(console: Console, results: Results) -> None:
    """All codes on all problems, plain → projected."""
    for problem, group in groupby(results.codes, key=lambda code: code.problem):
        codes = list(group)
        table = numbers("code", ("steps", "failed", "f", "residual", *(("gap",) if codes[0].gaps else ())))
        for code in codes:
            s, t = code.plain.stats, code.projected.stats
            cells = [f"{a} → {b}" for a, b in ((s.steps, t.steps), (s.failed, t.failed), (s.nfev, t.nfev))]
            sizes = [_change(code.residuals, ".1e"), *([_change(code.gaps, ".3g")] if code.gaps else [])]
            table.add_row(code.method, *cells, *sizes)
        console.print(Text(f"{problem}, default tolerances: plain → projected", style="bold"), table, "", sep="\n")


def _print_kinetics(console: Console, results: Results) -> None:
    """The drift of linear invariants, which nothing imposes."""
    table = numbers("problem", ("steps", "Jacobian given", "by differences"))
    for one in results.kinetics:
        drifts = (f"{drift:.1e}" for drift in one.drifts)
        table.add_row(f"{one.kinetic.problem.name}, {one.kinetic.invariant}", str(one.given.stats.steps), *drifts)
    title = "Drift of linear invariants, ode15s without projection (no gain of it)"
    console.print(Text(title, style="bold"), table, "", sep="\n")


def _change(sizes: tuple[float, float], digits: str) -> str:
    return " → ".join(format(size, digits) for size in sizes)


def _table(published: str, counts: Iterable[str], heading: bool) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=heading, header_style="dim")
    for name, width in (("quantity", 43), (published, 14), ("here", 12), ("", 1)):
        table.add_column(name, width=width)
    for name in counts:
        table.add_column(name, width=max(4, len(name)), justify="right", style="dim")
    return table


def _verdict(row: Row) -> Text:
    if row.agrees is None:
        return Text("")
    return Text("✓", style="green") if row.agrees else Text("✗", style="bold red")


def _outcome(results: Results) -> str:
    compared = len(results.compared)
    differing = sum(not row.agrees for row in results.compared)
    if differing:
        return f"[bold red]{differing} of {compared} published values differ.[/]"
    return f"[green]All {compared} published values are met.[/]"
