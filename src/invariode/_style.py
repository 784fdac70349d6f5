"""How pictures look: the one place for colours and lines."""

from __future__ import annotations

from typing import Any

__all__ = ["COLOURS", "DASHES", "IMPOSED", "INK", "LOOK", "PLAIN", "PROJECTED", "QUIET"]

#: The palette of Okabe and Ito (https://jfly.uni-koeln.de/color), which all kinds of colour vision tell apart, without
#: its yellow, which is too faint for lines on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")

#: Lines of real and imaginary parts: the first time through the palette, and the second.
DASHES = (("-", "--"), ("-.", ":"))

#: What colours stand for where runs are compared: without projection, with it, imposed afterwards.
PROJECTED, PLAIN, IMPOSED = COLOURS[:3]
QUIET, INK = "#8a8f98", "#20242c"

LOOK: dict[Any, Any] = {  # rc parameters, which mypy knows by name; in force while figures of our own are made
    "axes.axisbelow": True,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
