"""Colours and lines of all pictures, in one place."""

from __future__ import annotations

from typing import Any

#: The palette of Okabe and Ito (https://jfly.uni-koeln.de/color), distinguishable with any colour vision, without its
#: yellow, which is too faint for lines on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")

#: Lines of real and imaginary parts: the first time through the palette, and the second.
DASHES = (("-", "--"), ("-.", ":"))

#: Lines of the levels of invariants; dots show the drift before projection.
LEVELS = ("-", "--", "-.")

#: The meaning of colours where runs are compared: without projection, with it, imposed afterwards.
PROJECTED, PLAIN, IMPOSED = COLOURS[:3]
QUIET, INK = "#8a8f98", "#20242c"
#: Axes and their numbers, grids, and ranges that are shaded.
AXES, GRID, SHADE = "#555b66", "#e4e7ec", "#eef0f3"
#: A colour for one item beyond the palette.
BLACK = "#000000"

LOOK: dict[Any, Any] = {  # rc parameters, which mypy knows by name; in force while figures of our own are made
    "axes.axisbelow": True,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
}

#: Pictures that stand alone, in files: pictures of the command line, of work and precision, of the paper.
STYLE: dict[Any, Any] = {
    **LOOK,
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.edgecolor": AXES,
    "axes.labelcolor": INK,
    "axes.unicode_minus": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
    "mathtext.fontset": "dejavusans",
    "path.simplify": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "invariode",
    "xtick.color": AXES,
    "ytick.color": AXES,
}
