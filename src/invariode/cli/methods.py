"""`invariode methods`: the registry as a table."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from .._problem.methods import METHODS, Method

#: Heading and attribute of the columns of numbers.
_NUMBERS = (
    ("order", "order"),
    ("extension", "extension_order"),
    ("f per step", "stages"),
    ("iterations", "iterations"),
    ("refine", "refine"),
)


def methods() -> None:
    """List the methods, their orders and costs, and where their formulas come from.

    Columns: SciPy's name of the method; the order of its formulas and of its continuous extension; evaluations of f
    per step, if their number is fixed; projection iterations per step with invariants; points per step by default.
    Options: those that only some methods can use, and what SciPy's name implies.
    """
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("method", style="bold", no_wrap=True)
    table.add_column("SciPy", no_wrap=True)
    for heading, _ in _NUMBERS:
        table.add_column(heading, justify="right")
    sources = Table.grid(padding=(0, 2, 0, 0))
    sources.add_column(style="bold", no_wrap=True)
    for method in METHODS.values():
        numbers = [str(getattr(method, attribute) or "–") for _, attribute in _NUMBERS]
        if not method.fixed_order:
            numbers[0] = f"{method.min_order}–{method.order}"
        table.add_row(method.name, method.scipy_name or "–", *numbers)
        sources.add_row(method.name, f"{method.family}: {method.source}")
        sources.add_row("", f"[dim]options:[/] {_options(method)}")
    Console().print(table, sources, sep="\n")


def _options(method: Method) -> str:
    implied = ", ".join(f"{name}={value}" for name, value in method.scipy_options.items())
    return ", ".join(method.options) + (f"; {method.scipy_name} implies {implied}" if implied else "")
