"""Pictures of a fit: data, model and band; residuals; correlations; the ends of all starts; a profile."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import Array
from ..._base.style import COLOURS
from ..._results.pictures.canvas import drawable, legend, new, new_panels, once
from ..._results.pictures.over_time import axis_label, groups_of, units_of
from ..._results.solution import Solution
from .experiment import Experiment, Series
from .uncertainty import Prediction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Times at which the band is drawn, and points of the curve of a profile.
_POINTS = 300

#: Up to this many parameters the correlations are written into their map.
_WRITTEN = 14

#: Correlations of a larger size than this are written in white, for contrast with their colour.
_DARK = 0.6

#: Residuals of normal noise are in this range, in standard deviations, with a probability of 95 %.
_USUAL = 1.96

#: Costs that differ by less than this, relative to the best one or 1, are equal.
_EQUAL = 1e-6

#: The waterfall shows at least this factor above equal costs, and leaves this factor free at its ends.
_SHOWN, _ROOM = 1e3, 3.0


def times(experiment: Experiment, sol: Solution) -> tuple[Array, Array]:
    """Return the times at which the model is drawn, and the places among them where it jumps.

    - `experiment`: the experiment
    - `sol`: its solution, with dense output: knots that occur twice are jumps
    """
    t0, tf = experiment.problem.t_span
    grid = np.linspace(t0, tf if np.isfinite(tf) else experiment.last, _POINTS)
    knots = sol.sol.ts
    jumps = knots[1:][np.diff(knots) == 0]
    before = np.nextafter(jumps, t0)
    every = np.unique(np.concatenate([grid, before, jumps]))
    every = every if tf >= t0 else every[::-1]
    return every, np.flatnonzero(np.isin(every, jumps))


def draw(
    experiment: Experiment,
    title: str | None,
    band: Prediction,
    cuts: Array,
    sigmas: Sequence[Array],
    level: float,
    ax: Axes | None,
) -> Axes:
    """See `Fit.plot`; `cuts`: where the curves are interrupted; `sigmas`: the standard deviations of the data of each
    series."""
    measured = {one.row: (one, sigma) for one, sigma in zip(experiment.series, sigmas, strict=True)}
    every, kinds = list(range(len(band.y))), units_of(band.names)
    groups = groups_of(kinds, band.y, every) if ax is None else [every]
    panels = list(new_panels(title, [1] * len(groups))) if ax is None else [ax]
    shown = f"{100 * level:g} % band"
    for panel, group in zip(panels, groups, strict=True):
        for place, j in enumerate(group):
            colour = COLOURS[place % len(COLOURS)]
            _curve(panel, band, cuts, j, colour, "fit" if len(group) == 1 else drawable(band.names[j]))
            if j in measured:
                _data(panel, experiment, *measured[j], colour)
        panel.set_ylabel(axis_label([band.names[j] for j in group], {kinds[j] for j in group}))
        grey = COLOURS[0] if len(group) == 1 else "0.4"
        if any(j in measured for j in group):
            panel.plot([], [], "o", color=grey, markersize=4, mfc=panel.get_facecolor(), label=once(panel, "data"))
        panel.fill_between([], [], [], color=grey, alpha=0.25, linewidth=0, label=once(panel, shown))
        if len(group) > 1 or panel is panels[0]:  # panels of one quantity have the same legend
            legend(panel)
    panels[-1].set_xlabel("$t$")
    return panels[0]


def column(titles: Sequence[str]) -> Array:
    """Return panels of a new figure below each other with these titles, for experiments."""
    panels = new_panels(None, [1] * len(titles), figsize=(6.4, 1.2 + 1.8 * len(titles)))
    for panel, title in zip(panels, titles, strict=True):
        panel.set_title(drawable(title), loc="left", fontsize="medium")
    return panels


def _curve(ax: Axes, band: Prediction, cuts: Array, j: int, colour: Any, label: str) -> None:
    """Draw the model of one quantity with its band."""
    t, y, lower, upper = (np.insert(one, cuts, np.nan) for one in (band.t, band.y[j], band.lower[j], band.upper[j]))
    ax.fill_between(t, lower, upper, color=colour, alpha=0.25, linewidth=0)
    ax.plot(t, y, color=colour, linewidth=1.4, label=once(ax, label))


def _data(ax: Axes, experiment: Experiment, data: Series, sigma: Array, colour: Any) -> None:
    """Draw the data of one quantity with their standard deviations."""
    t = experiment.data.t[data.places]
    bars = [data.values * (1 - np.exp(-sigma)), data.values * (np.exp(sigma) - 1)] if data.lognormal else sigma
    ax.errorbar(t, data.values, yerr=bars, fmt="o", color=colour, markersize=4, elinewidth=0.8, mfc=ax.get_facecolor())


def draw_residuals(experiment: Experiment, title: str | None, residuals: Array, ax: Axes | None) -> Axes:
    """See `Fit.plot_residuals`; `residuals` (m, n_t), in standard deviations."""
    ax = new(title) if ax is None else ax
    ax.axhspan(-_USUAL, _USUAL, color="0.5", alpha=0.12, linewidth=0, zorder=0)
    ax.axhline(0, color="0.5", linewidth=0.9, zorder=1)
    for j, (name, values) in enumerate(zip(experiment.names, residuals, strict=True)):
        there = np.isfinite(values)
        if there.any():
            colour = COLOURS[j % len(COLOURS)]
            ax.plot(experiment.data.t[there], values[there], "o", color=colour, ms=4, label=drawable(name))
    ax.set_xlabel("$t$")
    ax.set_ylabel("(model − data) / σ")
    legend(ax)
    return ax


def draw_correlation(names: Sequence[str], correlation: Array, ax: Axes | None) -> Axes:
    """See `Fit.plot_correlation`."""
    k = len(names)
    size = 2.2 + 0.42 * k
    ax = new(None, figsize=(size + 0.8, size)) if ax is None else ax
    ax.grid(False)
    image = ax.imshow(correlation, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    labels = [drawable(name) for name in names]
    ax.set_xticks(range(k), labels, rotation=45, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(k), labels)
    if k <= _WRITTEN:
        for i, j in zip(*np.nonzero(np.isfinite(correlation)), strict=True):
            value = correlation[i, j]
            colour = "white" if abs(value) > _DARK else "black"
            ax.text(j, i, f"{value:z.2f}".replace("-", "−"), ha="center", va="center", color=colour, fontsize="small")
    ax.figure.colorbar(image, ax=ax).set_label("correlation")
    return ax


def draw_starts(starts: Sequence[tuple[float, bool]], ax: Axes | None) -> Axes:
    """See `Fit.plot_starts`."""
    costs = np.array([cost for cost, _ in starts])
    arrived = np.array([success for _, success in starts])
    there = np.isfinite(costs)
    if not there.any():
        raise ValueError("no start has a finite cost: there is nothing to draw")
    order = np.argsort(costs[there], kind="stable")
    above = (costs[there] - costs[there].min())[order]
    floor = _EQUAL * max(abs(float(costs[there].min())), 1.0)
    ax = new(None) if ax is None else ax
    place = np.arange(1, len(order) + 1)
    height = np.maximum(above, floor)
    ax.plot(place, height, color="0.6", linewidth=0.9, zorder=1)
    for how, label, fill in ((True, "converged", COLOURS[0]), (False, "did not converge", ax.get_facecolor())):
        those = arrived[there][order] == how
        if those.any():
            ax.plot(place[those], height[those], "o", color=COLOURS[0], mfc=fill, ms=5, label=label)
    ax.set_yscale("log")
    ax.set_ylim(floor / _ROOM, max(height[-1], _SHOWN * floor) * _ROOM)
    ax.axhspan(floor / _ROOM, floor, color="0.5", alpha=0.12, linewidth=0, zorder=0, label="equal to the best")
    ax.set_xlabel("start, from the best to the worst")
    ax.set_ylabel("cost above the best")
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    lost = int(np.count_nonzero(~there))
    legend(ax, f"{lost} of {len(starts)} failed" if lost else None)
    return ax


def draw_profile(
    name: str,
    values: Array,
    statistic: Array,
    ends: tuple[float, float],
    quantile: float,
    level: float,
    ax: Axes | None,
) -> Axes:
    """See `Profile.plot`."""
    from scipy.interpolate import PchipInterpolator

    ax = new(None) if ax is None else ax
    colour = COLOURS[0]
    once_each, places = np.unique(values, return_index=True)
    if len(once_each) > 1:
        # the signed root is nearly a straight line, so its interpolant has no corners; its square has no kink at 0
        fine = np.linspace(once_each[0], once_each[-1], _POINTS)
        ax.plot(fine, PchipInterpolator(once_each, statistic[places])(fine) ** 2, color=colour, linewidth=1.4,
                label=once(ax, "profile"))  # fmt: skip
    ax.plot(values, statistic**2, "o", color=colour, ms=4, mfc=ax.get_facecolor(), label=once(ax, "refitted"))
    best = float(values[np.argmin(np.abs(statistic))])
    ax.axhline(quantile**2, color="0.5", linestyle="--", linewidth=0.9, label=once(ax, f"{100 * level:g} %"))
    low, high = ax.get_xlim()
    ax.axvspan(max(ends[0], low), min(ends[1], high), color="0.5", alpha=0.12, linewidth=0, zorder=0,
               label=once(ax, "interval"))  # fmt: skip
    ax.axvline(best, color=COLOURS[1], linewidth=0.9, label=once(ax, "best fit"))
    ax.set_xlim(low, high)
    ax.set_ylim(bottom=0)
    ax.set_xlabel(drawable(name))
    ax.set_ylabel("likelihood ratio, 2 Δ log L")
    legend(ax)
    return ax
