"""A run on one page: components by scale, and below them the drift of the invariants; and a small picture of it."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.style import COLOURS, LOOK
from ..result import Result
from . import drift
from .canvas import components, drawable, log_axis, require_matplotlib, require_points
from .curves import Curve, curve, draw_over_t, interrupted
from .over_time import draw_groups, groups_of, kinds_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width of the page, height of its margins, of a panel of components and of that of the drift, in inches.
_WIDTH, _MARGINS, _PANEL, _DRIFT = 7.2, 0.9, 2.0, 1.5

#: Room around panels with their labels, in inches; the most that labels on one side take of the width.
_PAD, _MOST = 0.08, 0.45


def draw(sol: Result, title: str, chosen: Any = None, log: bool = False) -> Figure:
    """Return a figure that pyplot does not know. `log`: a logarithmic axis of time."""
    require_matplotlib()
    from matplotlib.figure import Figure

    require_points(sol)
    those = components(sol, chosen)
    whole = curve(sol)
    groups = groups_of(kinds_of(sol), whole.y, those)
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
    _lay_out(figure, panels)
    return figure


def _lay_out(figure: Figure, panels: list[Axes]) -> None:
    """Make room for labels and legends, measured once; matplotlib's engines draw everything two or three times."""
    figure.set_layout_engine(None)
    width, height = figure.bbox.size
    pad = _PAD * figure.dpi
    inner, outer = [ax.bbox for ax in panels], [ax.get_tightbbox() for ax in panels]
    boxes = [(a, b) for a, b in zip(inner, outer, strict=True) if b is not None]
    left = min(pad + max(a.x0 - b.x0 for a, b in boxes), _MOST * width)
    right = min(pad + max(b.x1 - a.x1 for a, b in boxes), _MOST * width)
    above, below = [b.y1 - a.y1 for a, b in boxes], [a.y0 - b.y0 for a, b in boxes]
    gap = pad + max((one + other for one, other in zip(below, above[1:], strict=False)), default=0)
    top, bottom = height - pad - above[0], pad + below[-1]
    panel = (top - bottom - gap * (len(panels) - 1)) / len(panels)  # their mean height
    figure.subplots_adjust(left / width, bottom / height, 1 - right / width, top / height, hspace=gap / panel)


#: The most components that are drawn.
_MOST = 12

#: A picture of a run with more outputs would take longer than the eye waits.
_PICTURED = 200_000


def thumbnail(sol: Result) -> str:
    """Return the components over t, as an image in HTML; empty if there is nothing to draw, or no matplotlib.

    It does not evaluate f, which may be slow: without dense output, lines join the outputs.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        return ""
    if not 2 <= len(sol.t) <= _PICTURED or not np.isfinite(sol.y).all():
        return ""
    whole = Curve(interrupted(sol, sol.t), interrupted(sol, sol.y), smooth=False) if sol.sol is None else curve(sol)
    file = io.BytesIO()
    with matplotlib.rc_context({**LOOK, "font.size": 7}):
        figure = Figure(figsize=(3.2, 2.0), layout="constrained")
        ax = figure.add_subplot()
        for k, values in enumerate(whole.y[:_MOST]):
            look = {"color": COLOURS[k % len(COLOURS)], "linewidth": 1, "marker": "none"}
            draw_over_t(ax, sol, whole.t, values.real, whole.smooth, look)
        figure.savefig(file, format="png", dpi=100)
    picture = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="components over t" src="data:image/png;base64,{picture}">'
