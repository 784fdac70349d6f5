"""The application: its commands, each a function in a module of its own, and what they share."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from .._base.package import version
from . import check, compare, methods, solve
from .session import examples, paragraphs

EXAMPLES = examples("solve pendulum.py", "compare pendulum.py", "check pendulum.py")

app = typer.Typer(
    name="invariode",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for module in (solve, compare, check, methods):  # a command is the function with the name of its module
    command = getattr(module, module.__name__.rpartition(".")[2])
    app.command(help=paragraphs(command), epilog=getattr(module, "EXAMPLES", None))(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        Console(highlight=False).print(f"invariode {version()}")
        raise typer.Exit


@app.callback(epilog=EXAMPLES)
def invariode(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """ODE solvers that conserve what your equations conserve."""
