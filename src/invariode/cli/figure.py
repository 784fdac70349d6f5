"""The figure of `invariode compare`: error against work. Needs the extra `plot`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .._style import BLACK, INK, SHADE
from .._style import COLOURS as PALETTE
from ..methods import METHODS
from ..paper.plots import STYLE
from ..pictures.canvas import drawable
from .precision import WAYS, Reference, Row

__all__ = ["draw"]

COLOURS = (*PALETTE, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

#: So many keys of the legend fit beside each other.
IN_A_LINE = 7


def draw(rows: Sequence[Row], truth: Reference, name: str, path: Path) -> None:
    """Writes the figure: evaluations of f and time against the error; plain solid, projected dashed."""
    with mpl.rc_context({**STYLE, "font.size": 9.0}):
        figure = Figure(figsize=(7.2, 3.9), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for one, cost in zip(axes, ("f", "seconds"), strict=True):
            _curves(one, rows, cost, truth)
        axes[0].set(xlabel="evaluations of $f$", ylabel="error of the final state")
        axes[1].set(xlabel="time in seconds")
        figure.suptitle(drawable(name), fontsize=10.5, color=INK)
        methods = list(dict.fromkeys(row.method for row in rows))
        keys = _keys(methods, any(row.projected for row in rows))
        columns = math.ceil(len(keys) / math.ceil(len(keys) / IN_A_LINE))
        figure.legend(handles=keys, loc="outside lower center", ncols=columns, handlelength=2.4, columnspacing=1.4)
        figure.savefig(path, dpi=200)


def _curves(axes: Axes, rows: Sequence[Row], cost: str, truth: Reference) -> None:
    for method, group in groupby(rows, key=lambda row: row.method):
        own = list(group)
        for way in WAYS:
            runs = [run for row in own if (run := row.run(way)) and math.isfinite(run.error)]
            if runs:
                work, errors = zip(*((getattr(run, cost), max(run.error, truth.floor)) for run in runs), strict=True)
                axes.loglog(work, errors, **_style(method, way))
    axes.grid(True)
    axes.set_axisbelow(True)
    low, high = axes.get_ylim()
    if low < truth.floor:
        axes.axhspan(low, truth.floor, color=SHADE, lw=0)
        axes.set_ylim(low, high)


def _style(method: str, way: str) -> dict[str, Any]:
    k = list(METHODS).index(method)
    colour, plain = COLOURS[k % len(COLOURS)], way == "plain"
    return {
        "color": colour,
        "marker": MARKERS[k % len(MARKERS)],
        "markersize": 4,
        "markerfacecolor": colour if plain else "white",
        "markeredgewidth": 0.9,
        "linestyle": "-" if plain else (0, (4, 2)),
        "linewidth": 1.2,
    }


def _keys(methods: Sequence[str], both: bool) -> list[Line2D]:
    """A key for each method, and for the two ways."""
    keys = [Line2D([], [], label=method, **_style(method, "plain")) for method in methods]
    for way in WAYS if both else ():
        neutral = {**_style(methods[0], way), "color": INK, "marker": "o"}
        neutral["markerfacecolor"] = INK if way == "plain" else "white"
        keys.append(Line2D([], [], label=way, **neutral))
    return keys
