"""The application: its commands, each a function in a module of its own, and what they share."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from .. import __version__
from .check import EXAMPLES as CHECK_EXAMPLES
from .check import check
from .compare import EXAMPLES as COMPARE_EXAMPLES
from .compare import compare
from .methods import methods
from .paper import paper
from .session import paragraphs
from .solve import EXAMPLES as SOLVE_EXAMPLES
from .solve import solve

__all__ = ["app"]

app = typer.Typer(
    name="invariode",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command, epilog in (
    (solve, SOLVE_EXAMPLES),
    (compare, COMPARE_EXAMPLES),
    (check, CHECK_EXAMPLES),
    (methods, None),
    (paper, None),
):
    app.command(help=paragraphs(command), epilog=epilog)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        Console(highlight=False).print(f"invariode {__version__}")
        raise typer.Exit


@app.callback(epilog="Example: [bold]invariode paper --output paper-report.html[/bold]")
def invariode(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """ODE solvers that keep what the equations keep."""
