"""A fit as a picture: data, model and band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import Array
from ..._base.style import COLOURS
from ..._results.pictures.canvas import drawable, legend, new_panels
from ..._results.pictures.over_time import groups_of_scale
from .experiment import Experiment, Series
from .prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Times at which the band is drawn.
_POINTS = 300


def times(experiment: Experiment) -> Array:
    """Return the times at which the model is drawn."""
    t0, tf = experiment.problem.t_span
    return np.linspace(t0, tf if np.isfinite(tf) else experiment.last, _POINTS)


def draw(experiment: Experiment, band: Prediction, sigmas: Sequence[Array], ax: Axes | None) -> Axes:
    """See `Fit.plot`; `sigmas`: the standard deviations of the data of each series."""
    measured = {one.row: (one, sigma) for one, sigma in zip(experiment.series, sigmas, strict=True)}
    every = list(range(len(band.y)))
    groups = groups_of_scale(band.y, every) if ax is None else [every]
    panels = list(new_panels(experiment.problem._title, [1] * len(groups))) if ax is None else [ax]
    for panel, group in zip(panels, groups, strict=True):
        for place, j in enumerate(group):
            colour = COLOURS[place % len(COLOURS)]
            _curve(panel, band, j, colour)
            if j in measured:
                _data(panel, experiment, *measured[j], colour)
        if len(group) == 1:
            panel.set_ylabel(drawable(band.names[group[0]]))
        legend(panel)
    panels[-1].set_xlabel("$t$")
    return panels[0]


def _curve(ax: Axes, band: Prediction, j: int, colour: Any) -> None:
    """Draw the model of one quantity with its band."""
    ax.fill_between(band.t, band.lower[j], band.upper[j], color=colour, alpha=0.25, linewidth=0)
    ax.plot(band.t, band.y[j], color=colour, linewidth=1.4, label=drawable(band.names[j]))


def _data(ax: Axes, experiment: Experiment, data: Series, sigma: Array, colour: Any) -> None:
    """Draw the data of one quantity with their standard deviations."""
    t = experiment.data.t[data.places]
    bars = [data.values * (1 - np.exp(-sigma)), data.values * (np.exp(sigma) - 1)] if data.lognormal else sigma
    ax.errorbar(t, data.values, yerr=bars, fmt="o", color=colour, markersize=4, elinewidth=0.8, mfc=ax.get_facecolor())
