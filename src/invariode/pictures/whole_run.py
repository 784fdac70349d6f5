"""A run on one page: components by their scales, and below them the drift of the invariants."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..result import Result
from . import drift
from .canvas import components, drawable, log_axis, require_matplotlib, require_points
from .curves import curve
from .over_time import draw_groups, groups_of_scale

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw"]

#: Width of the page, height of its margins, of a panel of components and of that of the drift, in inches.
_WIDTH, _MARGINS, _PANEL, _DRIFT = 7.2, 0.9, 2.0, 1.5


def draw(sol: Result, title: str, chosen: Any = None, log: bool = False) -> Figure:
    """A figure that pyplot does not know. `log`: a logarithmic axis of time."""
    require_matplotlib()
    from matplotlib.figure import Figure

    require_points(sol)
    those = components(sol, chosen)
    whole = curve(sol)
    groups = groups_of_scale(whole.y, those)
    heights = [_PANEL + (1 if len(groups) == 1 else 0)] * len(groups) + [_DRIFT] * (len(sol._invariants) > 0)
    figure = Figure(figsize=(_WIDTH, _MARGINS + sum(heights)), layout="tight")
    panels = list(figure.subplots(len(heights), sharex=True, squeeze=False, height_ratios=heights)[:, 0])
    draw_groups(panels[: len(groups)], sol, whole, groups, {})
    if len(sol._invariants):
        drift.draw(sol, panels[-1], None, False, {})
    if log:
        panels[0].set_xscale("log")
    for panel in panels:
        panel.set_xlabel("")
        for axis in (panel.xaxis, panel.yaxis):
            if axis.get_scale() == "log":  # without formulas, whose parser takes longer than the picture
                log_axis(axis, formulas=False)
    panels[-1].set_xlabel("t", style="italic")
    panels[0].set_title(drawable(title))
    if (engine := figure.get_layout_engine()) is not None:  # laid out once: saving would first draw all to lay it out
        engine.execute(figure)
        figure.set_layout_engine("none")
    return figure
