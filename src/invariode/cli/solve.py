"""`invariode solve`: one run, its output in a file, its summary and drift as tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .._arguments import Array, tolerances
from .._progress import in_passing
from ..invariants import bind
from ..precision import unprojected
from ..problem import Problem
from ..solution import Solution
from .load import File, load
from .session import (
    ATOL,
    PICTURES,
    RTOL,
    clock,
    complete_method,
    examples,
    guarded,
    method_of,
    numbers,
    stop,
    writable,
    write_to,
)

__all__ = ["EXAMPLES", "solve"]

EXAMPLES = examples(
    "solve pendulum.py",
    "solve orbits.py:kepler --method ode113 --rtol 1e-8 -o kepler.csv",
    "solve pendulum.py --no-project --t-eval 501 -o plain.nc --plot plain.svg",
)

#: Endings of the output, and the packages they need.
OUTPUTS: Mapping[str, tuple[str, ...]] = {
    ".csv": ("pandas",),
    ".parquet": ("pandas", "pyarrow"),
    ".nc": ("xarray", "h5netcdf", "h5py"),
    ".npz": (),
}

#: Points per step with --dense, as in the figures of the paper.
DENSE = 10

MaxSteps = Annotated[
    int | None, typer.Option("--max-steps", metavar="N", min=1, help="Stop after so many steps, exit code 1.")
]
TimeLimit = Annotated[
    float | None, typer.Option("--time-limit", metavar="SECONDS", help="Stop after so long, exit code 1.")
]
Progress = Annotated[
    bool | None, typer.Option("--progress/--no-progress", help="A progress bar.", show_default="in a terminal")
]


def solve(
    file: File,
    method: Annotated[
        str,
        typer.Option("--method", "-m", metavar="NAME", autocompletion=complete_method, help="See invariode methods."),
    ] = "ode45",
    rtol: Annotated[float, typer.Option("--rtol", metavar="NUMBER", help="Relative tolerance.")] = RTOL,
    atol: Annotated[float, typer.Option("--atol", metavar="NUMBER", help="Absolute tolerance.")] = ATOL,
    project: Annotated[
        bool, typer.Option("--project/--no-project", help="Impose the problem's invariants, or only watch them.")
    ] = True,
    t_eval: Annotated[
        int | None,
        typer.Option("--t-eval", metavar="N", min=2, help="Output at N equally spaced times instead of at the steps."),
    ] = None,
    dense: Annotated[
        bool, typer.Option("--dense", help=f"Output between the steps too, {DENSE} points per step.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Where the solution goes: .csv, .parquet, .nc or .npz."),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", "-p", metavar="FILE", help="Draw the solution: .png, .svg or .pdf.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite files.")] = False,
    progress: Progress = None,
    max_steps: MaxSteps = None,
    time_limit: TimeLimit = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors and warnings.")] = False,
) -> None:
    """Solve the problem that a file defines.

    The file is Python and says [bold]problem = invariode.Problem(fun, t_span, y0, invariants=...)[/].
    Prints how the run went and what became of the invariants.

    Exit codes: 0 the run reached its end, 1 it failed, 2 the arguments or the file are wrong, 130 Ctrl-C.
    """
    chosen = method_of(method)
    if t_eval is not None and dense:
        raise typer.BadParameter("--t-eval and --dense exclude each other", param_hint="--dense")
    if output is not None:
        writable(output, OUTPUTS, "--output", "data", force)
    if plot is not None:
        writable(plot, PICTURES, "--plot", "plot", force)
    with guarded():
        problem = load(file)
        options = _options(problem, rtol, atol, t_eval, dense, plot is not None)
        shown = Console(stderr=True).is_terminal and not quiet if progress is None else progress
        run = problem if project else unprojected(problem)
        with in_passing():
            start = perf_counter()
            sol = run.solve(method, progress=shown, max_steps=max_steps, time_limit=time_limit, **options)
            seconds = perf_counter() - start
    _write(sol, problem.name, output, plot)  # first of all: what is printed may get lost
    if not quiet:
        with guarded():
            named = chosen.name if method == chosen.name else f"{chosen.name} as {method}"
            console = Console(highlight=False)
            console.print(_summary(problem, sol, f"{named}, rtol {rtol:g}, atol {atol:g}", seconds))
            console.print()
            _print_drift(console, problem, sol, project, rtol, atol)
        for path in filter(None, (output, plot)):
            console.print("Wrote", Text(str(path), style="bold"), soft_wrap=True)
    if not sol.success:
        raise stop(sol.message, code=1) if quiet else typer.Exit(1)


def _options(
    problem: Problem, rtol: float, atol: float, points: int | None, dense: bool, pictured: bool
) -> dict[str, Any]:
    """Those of the solve: output at so many points, or between the steps; a picture needs the dense output."""
    return {
        "rtol": rtol,
        "atol": atol,
        "t_eval": None if points is None else _times(problem, points),
        "refine": DENSE if dense else 1,
        "dense_output": dense or pictured,
    }


def _write(sol: Solution, name: str, output: Path | None, plot: Path | None) -> None:
    if output is not None:
        write_to(output, lambda: _save(sol, output))
    if plot is not None:
        write_to(plot, lambda: _draw(sol, name, plot))


def _times(problem: Problem, size: int) -> Array:
    if not np.isfinite(problem.t_span).all():
        raise typer.BadParameter(
            f"{problem.name} has no end to space them up to: {problem.t_span}", param_hint="--t-eval"
        )
    return np.linspace(*problem.t_span, size)


# ----------------------------------------------------------------------------------------------------------------------
# Tables


def _summary(problem: Problem, sol: Solution, method: str, seconds: float) -> Table:
    stats, mark = sol.stats, ("✓", "green") if sol.success else ("✗", "bold red")
    checks = f" and {stats.nfev_check} to test the invariants" if stats.nfev_check else ""
    linear = f", {stats.njev} of its Jacobian; {stats.nlu} factorisations" if stats.njev or stats.nlu else ""
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row("problem", Text(problem.name, style="bold"))
    table.add_row("method", method)
    table.add_row("status", Text.assemble(mark, f" {sol.message}"))
    table.add_row("interval", f"from {problem.t_span[0]:g} to {problem.t_span[1]:g}, reached {sol.t_end:.10g}")
    table.add_row("steps", f"{stats.steps}, {stats.failed} failed")
    table.add_row("f", f"{stats.nfev} evaluations{checks}{linear}")
    if stats.projections or stats.skipped:
        counts = f"{stats.projections} ({stats.skipped} not needed)" if stats.skipped else str(stats.projections)
        jacobians = f", {stats.ngjac} of its Jacobian" if stats.ngjac else ""
        differences = f", {stats.ngdiff} of these for its Jacobian" if stats.ngdiff else ""
        table.add_row("projections", f"{counts}; {stats.ng} evaluations of g{jacobians}{differences}")
    if sol.t_events is not None:
        found = (f"{len(t)} of {event.__name__}" for event, t in zip(problem.events, sol.t_events, strict=True))
        table.add_row("events", Text(", ".join(found)))
    table.add_row("output", f"{len(sol.t)} times")
    table.add_row("time", clock(seconds))
    return table


def _print_drift(console: Console, problem: Problem, sol: Solution, projected: bool, rtol: float, atol: float) -> None:
    """What projection kept; or, without it, what it would have kept."""
    if not problem.invariants:
        note = "No invariants: nothing is imposed. invariode.find_invariants looks for polynomial ones."
    elif projected:
        drift = sol.drift()
        table = numbers("\ninvariant", ("\nvalue", "residual\nbefore", "\nafter", "distance\nbefore", "\nafter"))
        sizes = (drift.residual_before, drift.residual_after, drift.distance_before, drift.distance_after)
        _add_rows(table, drift.names, drift.value, sizes)
        note = (
            "Largest g − value at the steps before projection, and in the output after it. "
            "Distances from the manifold are in units of the tolerance."
        )
        console.print(table)
    elif any(event.action for event in problem.events):
        note = "Nothing is imposed. Which values the invariants should have after the actions of events is not known."
    else:
        threshold = tolerances(rtol, atol, problem.y0)[1]
        g = bind(problem.invariants, problem.t_span[0], problem.y0, problem.args, threshold)
        table = numbers("invariant", ("value", "residual", "distance"))
        residual, distance = g.residual(sol.t, sol.y), g.distance(sol.t, sol.y, rtol, atol)
        _add_rows(table, g.names, g.value, (np.abs(residual).max(axis=1), distance.max(axis=1)))
        note = "Nothing is imposed. Largest g − value in the output; distances are in units of the tolerance."
        console.print(table)
    console.print(Text(note, style="dim"))


def _add_rows(table: Table, names: Iterable[str], values: Array, sizes: Iterable[Array]) -> None:
    for name, value, *of_one in zip(names, values, *sizes, strict=True):
        table.add_row(Text(name), f"{value:.6g}", *(f"{size:.2e}" for size in of_one))


# ----------------------------------------------------------------------------------------------------------------------
# Files


def _save(sol: Any, path: Path) -> None:
    if path.suffix == ".npz":
        sol.save(path)
    elif path.suffix == ".nc":
        sol.to_xarray().to_netcdf(path, engine="h5netcdf")
    elif path.suffix == ".parquet":
        sol.to_dataframe().to_parquet(path)
    else:
        sol.to_dataframe().to_csv(path)


def _draw(sol: Any, name: str, path: Path) -> None:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    from ..paper.plots import STYLE
    from ..pictures.canvas import drawable

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.9), layout="constrained")
        axes = figure.add_subplot()
        sol.plot(ax=axes)
        axes.set_title(drawable(name))
        figure.savefig(path, dpi=200)
