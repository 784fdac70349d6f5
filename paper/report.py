"""The report: one HTML file, from the template `report.html.jinja`."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Iterable
from importlib.metadata import version
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np

from invariode._base.style import INK

from .experiments import Results
from .rows import Row

__all__ = ["report"]

#: Pages: background, behind code, text, secondary text, lines and heavier lines of tables, what agrees, what differs.
PAGE = {
    "paper": "#ffffff",
    "tint": "#f3f5f8",
    "ink": INK,
    "quiet": "#626a76",
    "line": "#dfe3e9",
    "rule": "#aab1bc",
    "good": "#1d7a55",
    "bad": "#c02942",
}


def report(results: Results, command: str = "make paper") -> str:
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
        matplotlib or jinja2, of the extra `paper`, is not installed.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    from .plots import FIGURES, svg

    environment = Environment(
        loader=PackageLoader(__package__, ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["groupby_in_order"] = _groupby_in_order
    return environment.get_template("report.html.jinja").render(
        results=results,
        command=command,
        colours=PAGE,
        note=_note,
        figures={plot.name: {"plot": plot, "svg": Markup(svg(plot, results))} for plot in FIGURES},
        made_with={
            "invariode": version("invariode"),
            "NumPy": np.__version__,
            "Python": platform.python_version(),
            "date": datetime.date.today().isoformat(),
        },
    )


def _groupby_in_order(items: Iterable[Any], attribute: str) -> list[tuple[Any, list[Any]]]:
    """Neighbours with the same attribute; the filter of jinja2's own would sort them."""
    return [(key, list(group)) for key, group in groupby(items, key=attrgetter(attribute))]


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
    return " · ".join(part for part in parts if part)
