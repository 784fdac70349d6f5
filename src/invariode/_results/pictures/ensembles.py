"""Many trajectories over t, a panel for each component: as bands, as quantiles, or one by one. Imaginary parts are
dashed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import Array
from ..._base.style import COLOURS
from .canvas import component, drawable, joined, legend, new_panels, once, properties
from .curves import parts

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: The most components that are drawn by default: more panels would be too small to read.
_MOST = len(COLOURS)

#: The most trajectories that are drawn one by one.
_THREADS = 500

#: Parts of the trajectories that are below a line.
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)

#: The name of the curve of each kind of picture, where the axis has that of the component.
_CURVE = {"bands": "median", "quantiles": "median", "spaghetti": "trajectories"}

#: Which of them bound each band, from the outermost inwards, and how opaque it is.
_BANDS = ((0, 4, 0.15), (1, 3, 0.25))


def draw(ensemble: Any, kind: str, ax: Axes | None, chosen: Any, line: dict[str, Any]) -> Axes:
    """See `EnsembleSolution.plot`."""
    if len(ensemble.t) < 2:
        raise ValueError("the ensemble has only final states: for a picture solve it with times in t_eval")
    names = ensemble.labels
    several = [chosen] if isinstance(chosen, str) or not np.iterable(chosen) else chosen
    rows = [*range(min(len(names), _MOST))] if chosen is None else [component(names, one) for one in several]
    own_panels = ax is None and len(rows) > 1
    panels: list[Axes] = list(new_panels(None, [1] * len(rows))) if ax is None else [ax] * len(rows)
    look, given = properties(line)
    for place, (panel, k) in enumerate(zip(panels, rows, strict=True)):
        for part, values, dashes in zip(*parts(ensemble.y[:, k]), ("-", "--"), strict=False):
            name = _CURVE[kind] if own_panels else drawable(names[k])
            label = joined(f"{part}{name}".strip(), given)
            own = {
                "color": COLOURS[place % len(COLOURS)],
                "linestyle": dashes,
                "label": label,
                "linewidth": 1.4,
                **look,
            }
            {"bands": _bands, "quantiles": _quantiles, "spaghetti": _threads}[kind](panel, ensemble.t, values, own)
        if own_panels or len(rows) == 1:
            panel.set_ylabel(drawable(names[k]))
    if kind == "bands":
        _name_bands(panels[0])
    panels[-1].set_xlabel("$t$")
    legend(panels[0], f"{len(rows)} of {len(names)} components" if chosen is None and len(rows) < len(names) else None)
    return panels[0]


def _of_those_there(values: Array) -> tuple[Array, Array]:
    """Return quantiles (5, n_t) of the trajectories that reached each time, and which times any did."""
    reached = np.asarray(np.isfinite(values).any(axis=0))
    return np.nanquantile(values[:, reached], _QUANTILES, axis=0), reached


def _bands(ax: Axes, t: Array, values: Array, look: dict[str, Any]) -> None:
    levels, reached = _of_those_there(values)
    for low, high, alpha in _BANDS:
        ax.fill_between(t[reached], levels[low], levels[high], color=look["color"], alpha=alpha, linewidth=0)
    ax.plot(t[reached], levels[2], **look)


def _name_bands(ax: Axes) -> None:
    """Add the bands to the legend, in grey since all components have them. The inner band lies on the outer one."""
    opaque = 0.0
    for low, high, alpha in _BANDS:
        opaque = 1 - (1 - opaque) * (1 - alpha)
        label = f"{100 * (_QUANTILES[high] - _QUANTILES[low]):.0f} % of the trajectories"
        ax.fill_between([], [], [], color="0.3", alpha=opaque, linewidth=0, label=once(ax, label))


def _quantiles(ax: Axes, t: Array, values: Array, look: dict[str, Any]) -> None:
    levels, reached = _of_those_there(values)
    for k, (level, width) in enumerate(zip(levels, (0.5, 0.8, 1.4, 0.8, 0.5), strict=True)):
        ax.plot(t[reached], level, **{**look, "linewidth": width, "label": look["label"] if k == 2 else "_nolegend_"})


def _threads(ax: Axes, t: Array, values: Array, look: dict[str, Any]) -> None:
    some = np.unique(np.linspace(0, len(values) - 1, min(len(values), _THREADS)).astype(int))
    thin = {**look, "linewidth": 0.6, "alpha": max(0.1, min(1.0, 30 / len(some)))}
    for row in values[some]:
        ax.plot(t, row, **{**thin, "label": "_nolegend_"})
    ax.plot([], [], **look)  # the key: one thin line alone is too faint
