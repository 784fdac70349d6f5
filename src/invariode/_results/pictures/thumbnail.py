"""A small picture of a run, for notebooks."""

from __future__ import annotations

import base64
import io

import numpy as np

from ..._base.style import COLOURS, LOOK
from ..result import Result
from .curves import Curve, curve, draw_over_t, interrupted

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
