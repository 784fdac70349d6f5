"""`invariode solve`: one run, its output in a file, its summary and drift as tables."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .._base.arguments import Array, weights_of
from .._base.progress import in_passing
from .._base.style import STYLE
from .._base.types import MethodName
from .._laws.bound import bind
from .._problem.grouped import Checkpoint, Limits
from .._problem.options import ExtensionOptions
from .._problem.problem import Problem
from .._results.export import attributes
from .._results.pictures.canvas import component, listed
from .._results.result import STOPPED
from .._results.solution import Solution
from .._solve.loading import load as load_solution
from .._studies.precision import unprojected
from .load import File, load
from .session import (
    ATOL,
    INTERRUPTED,
    PICTURES,
    RTOL,
    Progress,
    clock,
    complete_method,
    examples,
    guarded,
    method_of,
    numbers,
    stop,
    without_collector,
    writable,
    write_to,
)

EXAMPLES = examples(
    "solve pendulum.py",
    "solve orbits.py:kepler --method ode113 --rtol 1e-8 -o kepler.csv",
    "solve orbits.py:kepler --checkpoint kepler.checkpoint --resume",
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


def _seconds(given: float | None) -> float | None:
    if given is not None and not given > 0:
        raise typer.BadParameter(f"must be a positive number of seconds, got {given:g}")
    return given


MaxSteps = Annotated[
    int | None, typer.Option("--max-steps", metavar="N", min=1, help="Stop after this many steps, exit code 1.")
]
TimeLimit = Annotated[
    float | None,
    typer.Option("--time-limit", metavar="SECONDS", callback=_seconds, help="Stop after this time, exit code 1."),
]
CheckpointFile = Annotated[
    Path | None,
    typer.Option("--checkpoint", metavar="FILE", help="Write the state of the run there while it goes on."),
]
CheckpointEvery = Annotated[
    float,
    typer.Option(
        "--checkpoint-every", metavar="SECONDS", callback=_seconds, help="Least time between two checkpoints."
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with the run in --checkpoint, if there is one.")]


# The options of the command.
MethodOption = Annotated[
    str,
    typer.Option("--method", "-m", metavar="NAME", autocompletion=complete_method, help="See invariode methods."),
]
ProjectOption = Annotated[
    bool, typer.Option("--project/--no-project", help="Impose the problem's invariants, or only report their drift.")
]
TimesOption = Annotated[
    int | None,
    typer.Option("--t-eval", metavar="N", min=2, help="Output at N equally spaced times instead of at the steps."),
]
DenseOption = Annotated[bool, typer.Option("--dense", help=f"Output between the steps too, {DENSE} points per step.")]
OutputOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FILE", help="The file for the solution: .csv, .parquet, .nc or .npz."),
]
PlotOption = Annotated[
    Path | None,
    typer.Option(
        "--plot",
        "--save-figure",
        "-p",
        metavar="FILE",
        help="Draw the solution and the drift of its invariants: .png, .svg or .pdf.",
    ),
]
NonnegativeOption = Annotated[
    str | None,
    typer.Option(
        "--nonnegative",
        metavar="LIST",
        help="Components that must stay nonnegative: labels or indices (x,y,3), or all.",
    ),
]
ComponentsOption = Annotated[
    str | None,
    typer.Option("--components", metavar="LIST", help="What to draw: labels or indices, such as x,y,3."),
]


def solve(
    file: File,
    method: MethodOption = "ode45",
    rtol: Annotated[float, typer.Option("--rtol", metavar="NUMBER", help="Relative tolerance.")] = RTOL,
    atol: Annotated[float, typer.Option("--atol", metavar="NUMBER", help="Absolute tolerance.")] = ATOL,
    project: ProjectOption = True,
    nonnegative: NonnegativeOption = None,
    t_eval: TimesOption = None,
    dense: DenseOption = False,
    output: OutputOption = None,
    plot: PlotOption = None,
    components: ComponentsOption = None,
    log: Annotated[bool, typer.Option("--log", help="Draw with a logarithmic time axis.")] = False,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite the files of --output and --plot.")] = False,
    progress: Progress = None,
    max_steps: MaxSteps = None,
    time_limit: TimeLimit = None,
    checkpoint: CheckpointFile = None,
    checkpoint_every: CheckpointEvery = Checkpoint.every,
    resume: Resume = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors and warnings.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of the report.")] = False,
) -> None:
    """Solve the problem that a file defines.

    FILE is a Python script that defines [bold]problem = invariode.Problem(fun, t_span, y0, invariants=...)[/].
    Reports on the run and on the drift of its invariants.

    Exit codes: 0 the run reached its end, 1 it failed, 2 the arguments or the file are wrong, 130 Ctrl-C or SIGTERM.
    """
    chosen, name = method_of(method)
    if t_eval is not None and dense:
        raise typer.BadParameter("--t-eval and --dense exclude each other", param_hint="--dense")
    resumed = checkpoint if resume and checkpoint is not None and checkpoint.exists() else None
    replaced = force or resumed is not None  # the same command has written what it had when it was stopped
    if output is not None:
        writable(output, OUTPUTS, "--output", "data", replaced)
    if plot is not None:
        writable(plot, PICTURES, "--plot", "plot", replaced)
    elif components is not None or log:
        raise typer.BadParameter("only affects the plot: add --plot FILE", param_hint="--components, --log")
    if resume and checkpoint is None:
        raise typer.BadParameter("needs a checkpoint to resume from: add --checkpoint FILE", param_hint="--resume")
    with guarded():
        problem = load(file)
        problem = _nonnegative(problem, nonnegative)
        drawn = _components(problem, components, "--components")
        kept = {} if checkpoint is None else {"checkpoint": Checkpoint(checkpoint, every=checkpoint_every)}
        options = _options(problem, rtol, atol, t_eval, dense) | kept
        shown = Console(stderr=True).is_terminal and not quiet if progress is None else progress
        with in_passing():
            start = perf_counter()
            others: ExtensionOptions = {"progress": shown, "limits": Limits(steps=max_steps, time=time_limit)}
            try:
                sol = _solved(problem if project else unprojected(problem), name, options, others, resumed)
            except Exception as error:
                if as_json and not isinstance(error, typer.Exit):
                    print(json.dumps({"success": False, "error": type(error).__name__, "message": str(error)}))
                raise
            seconds = perf_counter() - start
    _write(sol, output, plot, (problem.name, drawn, log))  # first of all, since printed output may be lost
    if sol.status == STOPPED:
        raise _interrupted(sol, checkpoint)
    if as_json:
        print(_as_json(sol, chosen.name, seconds))
    elif not quiet:
        with guarded():
            named = method if method == chosen.name else f"{chosen.name} as {method}"
            console = Console(highlight=False)
            console.print(_summary(problem, sol, f"{named}, rtol {rtol:g}, atol {atol:g}", seconds))
            console.print()
            _print_drift(console, problem, sol, project, rtol, atol)
        for path in filter(None, (output, plot)):
            console.print("Wrote", Text(str(path), style="bold"), soft_wrap=True)
    if not sol.success:
        raise stop(sol.message, code=1) if quiet and not as_json else typer.Exit(1)


def _as_json(sol: Solution, method: str, seconds: float) -> str:
    """Return what the run has come to as one line of JSON; numbers that are not finite are null."""
    end = np.column_stack([sol.y_end.real, sol.y_end.imag]) if np.iscomplexobj(sol.y_end) else sol.y_end
    known = {**attributes(sol), "method": method, "t_end": sol.t_end, "y_end": end.tolist(), "seconds": seconds}
    return json.dumps(_finite(known))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _interrupted(sol: Solution, checkpoint: Path | None) -> typer.Exit:
    """Return the end of a command whose run Ctrl-C has ended after a step."""
    go_on = "with --checkpoint it could be resumed" if checkpoint is None else f"--resume goes on from {checkpoint}"
    return stop(f"Interrupted at t = {sol.t_end:.6g}, after {sol.stats.steps} steps; {go_on}.", INTERRUPTED)


def _write(sol: Solution, output: Path | None, plot: Path | None, look: tuple[str, list[int] | None, bool]) -> None:
    if output is not None:
        write_to(output, lambda: _save(sol, output))
    if plot is not None:
        write_to(plot, lambda: _draw(sol, *look, plot))


def _solved(
    problem: Problem, method: MethodName, options: dict[str, Any], others: ExtensionOptions, from_file: Path | None
) -> Solution:
    """Return the solution, perhaps of a run that began earlier; Ctrl-C ends it after the step."""
    options = {"on_interrupt": "return", **options}
    try:
        if from_file is None:
            return problem.solve(method, **{**others, **options})
        begun = load_solution(from_file, problem, **options)
        return begun if begun.t_end == problem.t_span[1] else begun.extend(problem.t_span[1], **others)
    except KeyboardInterrupt:  # before the first step, or by fun itself
        raise stop("Interrupted; nothing was saved.", INTERRUPTED) from None


def _nonnegative(problem: Problem, given: str | None) -> Problem:
    if given is None:
        return problem
    chosen = True if given == "all" else _components(problem, given, "--nonnegative")
    return problem.replace(nonnegative=chosen)


def _components(problem: Problem, given: str | None, option: str) -> list[int] | None:
    """Return indices of the components that an option names, refused before the work is done."""
    if given is None:
        return None
    names = [name.strip() for name in given.split(",")]
    try:
        return [component(problem.labels, name if name in problem.labels else int(name)) for name in names]
    except ValueError:
        known = listed(problem.labels)
        raise typer.BadParameter(f"{given!r}: choose from {known}, or by index", param_hint=option) from None


def _options(problem: Problem, rtol: float, atol: float, points: int | None, dense: bool) -> dict[str, Any]:
    """Return the options of the solve: output at this many points, or between the steps."""
    return {
        "rtol": rtol,
        "atol": atol,
        "t_eval": None if points is None else _times(problem, points),
        **({"refine": DENSE, "dense_output": True} if dense else {}),
        "on_failure": "return",
    }


def _times(problem: Problem, size: int) -> Array:
    if not np.isfinite(problem.t_span).all():
        raise typer.BadParameter(
            f"equally spaced times need a finite interval, but that of {problem.name} is {problem.t_span}",
            param_hint="--t-eval",
        )
    return np.linspace(*problem.t_span, size)


# ----------------------------------------------------------------------------------------------------------------------
# Tables


def _summary(problem: Problem, sol: Solution, method: str, seconds: float) -> Table:
    stats, mark = sol.stats, ("✓", "green") if sol.success else ("✗", "bold red")
    why = "to test the invariants" if problem.invariants else "in search of its jumps"
    checks = f" and {stats.nfev_check} {why}" if stats.nfev_check else ""
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
    """Print the drift of the invariants that projection corrected; or, without it, the drift that it would have
    corrected."""
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
        note = "Nothing is imposed. The values that the invariants should have after event actions are not known."
    else:
        threshold = weights_of(rtol, atol, problem.y0).threshold
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


def _draw(sol: Any, name: str, drawn: list[int] | None, log: bool, path: Path) -> None:
    with without_collector():
        import matplotlib as mpl

        from .._results.pictures.whole_run import draw

        with mpl.rc_context(STYLE):
            draw(sol, name, drawn, log).savefig(path, dpi=150)
