"""`invariode compare`: is projection worth it here, or is tightening the tolerance cheaper?"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .._base.progress import bar, in_passing
from .._problem.methods import Method
from .._problem.problem import Problem
from .._studies.precision import (
    WAYS,
    ComparedMethod,
    Judgement,
    NoReferenceError,
    Reference,
    Run,
    able,
    best,
    cheapest,
    compare_runs,
    judge,
    judgements,
    power,
    reference,
)
from .load import File, load
from .session import (
    INTERRUPTED,
    PICTURES,
    Progress,
    clock,
    complete_method,
    count,
    examples,
    guarded,
    method_of,
    numbers,
    stop,
    writable,
    write_to,
)

EXAMPLES = examples(
    "compare pendulum.py",
    "compare orbits.py:kepler -m ode45 -m ode113 --decades 3-12 --plot kepler.pdf",
    "compare kinetics.py --limit 20 --atol-ratio 1e-6",
)

#: Columns of the table of ratios: the number that fits beside the rest in 80 characters.
_RATIOS = 4


def compare(
    file: File,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            metavar="NAME",
            autocompletion=complete_method,
            show_default="all that can solve the problem",
            help="A method, or several with commas between them; may be given several times.",
        ),
    ] = None,
    decades: Annotated[
        str, typer.Option("--decades", metavar="M-N", help="Tolerances: rtol from 1e-M to 1e-N by powers of ten.")
    ] = "3-9",
    atol_ratio: Annotated[float, typer.Option("--atol-ratio", metavar="NUMBER", help="atol / rtol.")] = 1e-3,
    limit: Annotated[
        float,
        typer.Option("--limit", metavar="SECONDS", help="Stop testing a method once a run takes longer than this."),
    ] = 5.0,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", "-p", metavar="FILE", help="Draw work against precision: .png, .svg or .pdf."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite files.")] = False,
    progress: Progress = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print only the answer.")] = False,
) -> None:
    """Is projection worth it here, or is tightening the tolerance cheaper?

    Solves the problem by each method at each tolerance, plain and projected, and compares the final states with one on
    which two methods agree. The error is the largest over the components, each relative to its largest size along the
    solution; beside it stands how far each run ends off the invariants, in the same unit. A component that falls below
    0 by more than 100 atol in a run, but not in the reference, is named. Evaluations of f include those that test the
    invariants; times are the smallest of several.

    Exit codes: 0 compared, 1 an essential solve failed, 2 the arguments or the file are wrong, 130 Ctrl-C.
    """
    matched = re.fullmatch(r"(\d+)-(\d+)", decades)
    first, last = map(int, matched.groups()) if matched else (1, 0)
    if not 1 <= first <= last <= 13:
        raise typer.BadParameter(
            f"expected M-N with 1 ≤ M ≤ N ≤ 13, as in 3-9, got {decades!r}", param_hint="--decades"
        )
    rtols = [float(f"1e-{k}") for k in range(first, last + 1)]
    if not (math.isfinite(atol_ratio) and atol_ratio >= 0):
        raise typer.BadParameter("must be a number that is not negative", param_hint="--atol-ratio")
    if not limit > 0:
        raise typer.BadParameter("must be positive", param_hint="--limit")
    named = [_own_name(name.strip()) for given in method or () for name in given.split(",")]
    if plot is not None:
        writable(plot, PICTURES, "--plot", "plot", force)
    console = Console(highlight=False)
    with guarded():
        problem = load(file)
        methods = _methods(problem, named)
        shown = Console(stderr=True).is_terminal if progress is None else progress
        with in_passing(), bar(shown, "reference", len(methods) * len(rtols)) as report:
            truth, rows = _all(problem, methods, rtols, atol_ratio, limit, report)
    _print_all(console, problem, rows, truth, limit, quiet)
    if plot is not None:
        from .._studies.work_precision import draw

        write_to(plot, lambda: draw(rows, truth, problem.name, plot))
        if not quiet:
            console.print("Wrote", Text(str(plot), style="bold"), soft_wrap=True)


def _print_all(
    console: Console, problem: Problem, rows: list[ComparedMethod], truth: Reference, limit: float, quiet: bool
) -> None:
    """Print the answer, then the tables that it follows from."""
    reached = any(math.isfinite(run.error) for row in rows for run in (row.plain, row.projected) if run)
    if reached:
        console.print(Text(_answer(problem, rows, truth), style="bold"))
        if (off := off_the_invariants(rows)) is not None:
            console.print(Text(off, style="bold"))
    if not quiet:
        if reached:
            console.print()
        _print_runs(console, problem, rows, truth)
        _print_notes(console, rows, limit)
        _print_below_zero(console, problem, rows)
        if problem.invariants and reached:
            _print_ratios(console, judgements(rows, truth.floor))
    if not reached:
        raise stop("No run reached the end: raise --limit, or choose other methods or --decades.", code=1)


def _answer(problem: Problem, rows: list[ComparedMethod], truth: Reference) -> str:
    if problem.invariants:
        return answer(best(rows, truth.floor))
    fastest = cheapest(rows, truth.floor)
    ranking = ""
    if fastest:
        error, method, seconds = fastest
        ranking = f"; {method} reaches an error of {power(error)} fastest, in {clock(seconds)}"
    return (
        f"{problem.name} has no invariants, so there is nothing to project{ranking}. "
        "invariode.find_invariants(fun, t_span, y0) looks for polynomial ones."
    )


def _own_name(name: str) -> Method:
    """Return the method; SciPy's BDF means options too, which are not compared."""
    found = method_of(name)[0]
    if name == found.scipy_name and found.scipy_options:
        raise typer.BadParameter(f"{name} is {found.name} with options; give {found.name}", param_hint="--method")
    return found


def _methods(problem: Problem, named: Sequence[Method]) -> Sequence[Method]:
    possible = able(problem)
    for one in named:
        if one not in possible:
            names = ", ".join(able_one.name for able_one in possible)
            raise typer.BadParameter(f"{one.name} cannot use this mass matrix; {names} can", param_hint="--method")
    return [one for i, one in enumerate(named) if one not in named[:i]] or possible


def _all(
    problem: Problem,
    methods: Sequence[Method],
    rtols: Sequence[float],
    ratio: float,
    limit: float,
    report: Callable[..., None] | None,
) -> tuple[Reference, list[ComparedMethod]]:
    try:
        truth = reference(problem, ratio, limit)
    except NoReferenceError as none:
        raise stop(str(none), code=1) from None
    rows = []
    try:
        names: list[str] = [method.name for method in methods]
        for row in compare_runs(problem, names, rtols, ratio, limit, truth):
            rows.append(row)
            if report:
                report(len(rtols) * names.index(row.method) + rtols.index(row.rtol) + 1, row.method)
    except KeyboardInterrupt:
        done = f"{len(rows)} of {len(methods) * len(rtols)} comparisons"
        raise stop(f"Interrupted after {done}; nothing was written. Try --method and --decades.", INTERRUPTED) from None
    return truth, rows


# ----------------------------------------------------------------------------------------------------------------------
# Tables


def _print_runs(console: Console, problem: Problem, rows: Sequence[ComparedMethod], truth: Reference) -> None:
    both = bool(problem.invariants)
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="dim")
    off = ("off",) if any(run.off is not None for row in rows for run in (row.plain, row.projected) if run) else ()
    headings = [("\nmethod", "left"), ("\nrtol", "right"), *_headings("plain", ("error", *off, "f", "ms"))]
    if both:
        headings += [("\n ", "right"), *_headings("projected", ("error", *off, "f", "g", "J", "ms"))]
    for heading, side in headings:
        table.add_column(heading, justify="right" if side == "right" else "left", no_wrap=True)
    for name, group in groupby(rows, key=lambda row: row.method):
        own = list(group)
        for i, row in enumerate(own):
            cells = [name if i == 0 else "", power(row.rtol), *_cells(row.plain, truth, len(off) > 0, with_g=False)]
            if row.projected:
                cells += ["", *_cells(row.projected, truth, len(off) > 0, with_g=True)]
            table.add_row(*cells, end_section=i == len(own) - 1)
    at = "the terminal event" if truth.status else f"t = {problem.t_span[1]:g}"
    console.print(Text.assemble((problem.name, "bold"), f", error of the final state, at {at}"))
    console.print(Text(f"Reference: {truth.by}, which agree to {power(truth.agreement)}", style="dim"))
    console.print(table)
    derivatives = (row.projected.derivatives for row in rows if row.projected)
    kinds = {kind for several in derivatives if several for kind in several.split(" and ")} - {"given"}
    if kinds:
        how = " and ".join(sorted(kinds))
        console.print(Text(f"J = ∂g/∂y by {how}, counted under g; Invariants(g, jac=J) is cheaper.", style="dim"))


def _headings(way: str, names: Sequence[str]) -> list[tuple[str, str]]:
    return [(f"{way if i == 0 else ''}\n{name}", "right") for i, name in enumerate(names)]


def _cells(run: Run, truth: Reference, with_off: bool, with_g: bool) -> list[str]:
    if run.problem:
        return [f"[red]{run.problem}[/]", *(["–"] * (with_off + (4 if with_g else 2)))]
    error = f"{run.error:.1e}" if run.error >= truth.floor else f"<{power(truth.floor)}"
    counts = [count(number) for number in ((run.f, run.g, run.jacobians) if with_g else (run.f,))]
    off = [] if not with_off else ["–" if run.off is None else power(run.off) if run.off else "0"]
    ms = 1e3 * run.seconds
    return [error, *off, *counts, f"{ms:.0f}" if ms >= 100 else f"{ms:.3g}"]


def _print_notes(console: Console, rows: Sequence[ComparedMethod], limit: float) -> None:
    """Print why runs have no error, and for which methods."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        for way in WAYS:
            run = row.run(way)
            if run is not None and run.problem is not None:
                why = {
                    "too long": f"given up, a run takes longer than {limit:g} s (--limit)",
                    "event": "ends at a terminal event, and the reference does not",
                    "no event": "misses the terminal event at which the reference ends",
                }.get(run.problem, f"{way}, rtol {power(row.rtol)}: {run.message}")
                of = reasons.setdefault(why, [])
                if row.method not in of:
                    of.append(row.method)
    for why, methods in reasons.items():
        console.print(Text(f"{', '.join(methods)}: {why}", style="red"))
    console.print()


def _print_below_zero(console: Console, problem: Problem, rows: Sequence[ComparedMethod]) -> None:
    """Print which component becomes negative in runs, and not in the reference."""
    found = [(row, way, low) for row in rows for way in WAYS if (run := row.run(way)) and (low := run.below_zero)]
    if not found:
        return
    row, way, low = min(found, key=lambda one: one[2].value)
    methods = list(dict.fromkeys(row.method for row, _, _ in found))
    labels = problem.labels
    label = labels[low.component]
    finding = low.in_words(label)
    example = f"{row.method}, {way}, rtol {power(row.rtol)}"
    console.print(Text(f"{', '.join(methods)}: {finding} ({example}).", style="yellow"))
    console.print(Text("If it cannot be negative, give the problem nonnegative=.", style="yellow"))
    console.print()


def _print_ratios(console: Console, found: Sequence[Judgement]) -> None:
    """Print cost at equal error, projected / plain, in time and in f."""
    reached = sorted({e for one in found for e in one.errors}, reverse=True)
    if not reached:
        return
    errors = [reached[i] for i in sorted({round(i) for i in np.linspace(0, len(reached) - 1, _RATIOS)})]
    table = numbers("method", map(power, errors))
    table.add_column("projection is", no_wrap=True)
    for one in (one for one in found if one.errors):
        ratios = {e: f"{t:.2f} ({f:.2f})" for e, t, f in zip(one.errors, one.time, one.f, strict=True)}
        table.add_row(one.method, *(ratios.get(e, "–") for e in errors), _verdict(one))
    console.print(Text("Cost at equal error, projected ÷ plain: time (evaluations of f)", style="bold"))
    console.print(table)
    console.print()


def _verdict(one: Judgement) -> Text:
    kind, error = one.kind
    words = {
        "worth it": ("worth it", "green"),
        "not": ("not worth it", "red"),
        "even": ("even", ""),
        "mixed": ("now and then", "yellow"),
    }
    text, style = words.get(kind) or (f"worth it {'≥' if kind == 'above' else '≤'} {power(error or 0)}", "yellow")
    return Text(text, style=style)


# ----------------------------------------------------------------------------------------------------------------------
# The answer


def answer(one: Judgement) -> str:
    """Answer the paper's question (section 4) in a sentence, for the best method with and without projection."""
    if not one.errors:
        return "Plain and projected runs have no range of errors in common here; try other --decades."
    kind, border = one.kind
    takes = f"at equal error it takes {_range(one.time)} × the time of a tighter tolerance"
    if kind == "worth it":
        text = f"Projection is worth it here: {takes}"
    elif kind == "not":
        text = f"Projection is not worth it here: {takes}"
    elif kind == "even":
        text = f"Projection costs as much here as a tighter tolerance: {takes}"
    elif kind == "mixed":
        text = f"Projection is worth it here at some errors and not at others: {takes}"
    else:
        assert border is not None  # these two kinds have one
        above = kind == "above"
        here, there = (
            [r for e, r in zip(one.errors, one.time, strict=True) if (e >= border if above else e <= border) is worth]
            for worth in (True, False)
        )
        text = (
            f"Projection is worth it here at errors from {power(border)} {'up' if above else 'down'}, where it takes "
            f"{_range(here)} × the time of a tighter tolerance, not at {'smaller' if above else 'larger'} ones, where "
            f"it takes {_range(there)} ×"
        )
    return text + _by(one) + _counted(one) + "."


def off_the_invariants(rows: Sequence[ComparedMethod]) -> str | None:
    """Return a sentence about how far runs end off the invariants, or None if that is not known."""
    ways = [[run.off for row in rows if (run := row.run(way)) and run.off is not None] for way in WAYS]
    if not all(ways):
        return None
    plain, projected = ways
    low, high = power(min(plain)), power(max(plain))
    return (
        f"Plain runs end off the invariants by {low if low == high else f'{low} to {high}'} of the size of the "
        f"solution, projected ones by {power(max(projected))} at most: project if that matters, as for constraints."
    )


def _by(one: Judgement) -> str:
    """Return the methods that are best, where both are."""
    middle = len(one.errors) // 2
    plain, projected = one.by[middle]
    whose = f"{projected} both" if plain == projected else f"{projected} projected, {plain} plain"
    return f" (best methods: {whose}, at an error of {power(one.errors[middle])})"


def _counted(one: Judgement) -> str:
    """Return the verdict by evaluations of f in words, if it differs from that by time; else ''."""
    by_f = judge(one.errors, one.f)[0]
    if by_f == one.kind[0]:
        return ""
    costly = {
        "worth it": ", so it is worth it if f is costly",
        "not": ", so it is not if f is costly",
        "even": ", so if f is costly it makes no difference",
    }
    return f"; it takes {_range(one.f)} × the evaluations of f{costly.get(by_f, '')}"


def _range(ratios: Sequence[float]) -> str:
    low, high = f"{min(ratios):.2g}", f"{max(ratios):.2g}"
    return low if low == high else f"{low} to {high}"
