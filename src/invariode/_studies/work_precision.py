"""Error against work: evaluations of f, and time. Needs the extra `plot`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._base.arguments import Array
from .._base.package import public
from .._base.style import BLACK, INK, LOOK, SHADE, STYLE
from .._base.style import COLOURS as PALETTE
from .._problem.methods import METHODS, find_method
from .._problem.problem import Problem
from .._results.pictures.canvas import drawable, log_axis, require_matplotlib
from .precision import WAYS, ComparedMethod, NoReferenceError, Reference, able, compare_runs, sizes_along
from .precision import reference as agreed_reference

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

COLOURS = (*PALETTE, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

#: The number of legend keys that fit side by side.
IN_A_LINE = 7


#: Tolerances that are compared by default: powers of ten.
_RTOLS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)


@public
def plot_work_precision(
    problem: Problem,
    methods: Sequence[str] | None = None,
    reference: Any = None,
    *,
    rtols: Sequence[float] = _RTOLS,
    atol_ratio: float = 1e-3,
    limit: float = 5.0,
    axes: Any = None,
) -> Array:
    """Draw the error of the final state against its cost, for several methods and tolerances.

    Plain runs are solid; where the problem has invariants, projected ones are dashed.

    Parameters
    ----------
    problem : Problem
        The problem to solve.
    methods : sequence of str, optional
        Names in `METHODS`. Default: all that can solve the problem.
    reference : Solution or array_like of shape (n,), optional
        The exact final state, or a solution that ends there, in which case errors are relative to the largest size of
        each component along that solution. Default: two methods at stringent tolerances, which must agree.
    rtols : sequence of float, optional
        The tolerances. Default: 1e-3 to 1e-9, by powers of ten.
    atol_ratio : float, default 1e-3
        atol / rtol.
    limit : float, default 5
        Seconds; a method is given up if a run takes longer.
    axes : pair of matplotlib.axes.Axes, optional
        Where to draw, over evaluations of f and over time. Default: a new figure.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, (2,)

    Raises
    ------
    ValueError
        No two methods agree on the final state, or no run reached the end; a method is unknown, or cannot solve the
        problem.
    InvariantError
        f does not conserve an invariant.

    Notes
    -----
    Evaluations of f include those that test invariants; times are the smallest of several. The command
    ``invariode compare --plot`` draws the same.

    Examples
    --------
    >>> import invariode as iv
    >>> from invariode.problems import kepler
    >>> axes = iv.plot_work_precision(kepler(), ["ode45", "dop853"], rtols=[1e-4, 1e-6])
    >>> axes[0].get_xlabel()
    'evaluations of $f$'
    """
    require_matplotlib()
    possible = able(problem)
    chosen = [one.name for one in possible] if methods is None else [_named(name) for name in methods]
    for name in chosen:
        if find_method(name)[0] not in possible:
            raise ValueError(f"{name} cannot use a mass matrix: choose from {', '.join(m.name for m in possible)}")
    truth = _truth(problem, reference, atol_ratio, limit)
    rows = list(compare_runs(problem, chosen, rtols, atol_ratio, limit, truth))
    if not any(math.isfinite(run.error) for row in rows for way in WAYS if (run := row.run(way))):
        raise ValueError("no run reached the end: raise limit, or choose other methods or tolerances")
    if axes is None:
        import matplotlib
        import matplotlib.pyplot as plt

        with matplotlib.rc_context(LOOK):
            figure, axes = plt.subplots(1, 2, sharey=True, figsize=(7.2, 3.9), layout="constrained")
        _finish(figure, rows, problem.name)
    panels = np.ravel(np.asarray(axes, dtype=object))
    if len(panels) != 2:
        raise ValueError(f"plot_work_precision draws on two axes, got {len(panels)}")
    _draw_costs(panels, rows, truth)
    return panels


def _named(name: str) -> str:
    """Return the method's own name; SciPy's where that implies options, as 'BDF' does."""
    method, implied = find_method(name)
    return str(method.scipy_name) if implied else method.name


def _truth(problem: Problem, given: Any, ratio: float, limit: float) -> Reference:
    if given is None:
        try:
            return agreed_reference(problem, ratio, limit)
        except NoReferenceError as none:
            raise ValueError(f"{none} Give a reference") from None
    along = np.asarray(given.y if hasattr(given, "y") else given)
    along = along[:, None] if along.ndim == 1 else along
    if along.shape[0] != len(problem.y0) or not along.shape[1]:
        raise ValueError(f"reference must be a Solution or a state of shape ({len(problem.y0)},), got {along.shape}")
    return Reference(along[:, -1], sizes_along(along), "the reference given", int(getattr(given, "status", 0)), 0.0)


def draw(rows: Sequence[ComparedMethod], truth: Reference, name: str, path: Path) -> None:
    """Write the figure to a file, in the style of the paper's."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({**STYLE, "font.size": 9.0}):
        figure = Figure(figsize=(7.2, 3.9), layout="constrained")
        _draw_costs(figure.subplots(1, 2, sharey=True), rows, truth)
        _finish(figure, rows, name)
        figure.savefig(path, dpi=200)


def _draw_costs(axes: Any, rows: Sequence[ComparedMethod], truth: Reference) -> None:
    for one, cost in zip(axes, ("f", "seconds"), strict=True):
        _curves(one, rows, cost, truth)
    axes[0].set(xlabel="evaluations of $f$", ylabel="error of the final state")
    axes[1].set(xlabel="time in seconds")


def _finish(figure: Any, rows: Sequence[ComparedMethod], name: str) -> None:
    """Add title and legend."""
    figure.suptitle(drawable(name), fontsize=10.5, color=INK)
    drawn = [row for row in rows for way in WAYS if (run := row.run(way)) and math.isfinite(run.error)]
    keys = _keys(list(dict.fromkeys(row.method for row in drawn)), any(row.projected for row in rows))
    columns = math.ceil(len(keys) / math.ceil(len(keys) / IN_A_LINE))
    figure.legend(handles=keys, loc="outside lower center", ncols=columns, handlelength=2.4, columnspacing=1.4)


def _curves(axes: Axes, rows: Sequence[ComparedMethod], cost: str, truth: Reference) -> None:
    for method, group in groupby(rows, key=lambda row: row.method):
        own = list(group)
        for way in WAYS:
            runs = [run for row in own if (run := row.run(way)) and math.isfinite(run.error)]
            if runs:
                work, errors = zip(*((getattr(run, cost), max(run.error, truth.floor)) for run in runs), strict=True)
                axes.loglog(work, errors, **_style(method, way))
    axes.grid(True, color="0.5", alpha=0.2, lw=0.7)
    axes.set_axisbelow(True)
    log_axis(axes.xaxis)
    log_axis(axes.yaxis)
    low, high = axes.get_ylim()
    if low < truth.floor:
        axes.axhspan(low, truth.floor, color=SHADE, lw=0)
        axes.set_ylim(low, high)


def _style(method: str, way: str) -> dict[str, Any]:
    about, implied = find_method(method)
    k = [*METHODS].index(about.name) + (len(METHODS) if implied else 0)  # the same method with options
    colour, plain = COLOURS[k % len(COLOURS)], way == "plain"
    return {
        "color": colour,
        "marker": MARKERS[(k + k // len(COLOURS)) % len(MARKERS)],  # no pair twice
        "markersize": 4,
        "markerfacecolor": colour if plain else "white",
        "markeredgewidth": 0.9,
        "linestyle": "-" if plain else (0, (4, 2)),
        "linewidth": 1.2,
    }


def _keys(methods: Sequence[str], both: bool) -> list[Line2D]:
    """Return a key for each method, and for the two ways."""
    from matplotlib.lines import Line2D

    keys = [Line2D([], [], label=method, **_style(method, "plain")) for method in methods]
    for way in WAYS if both else ():
        neutral = {**_style(methods[0], way), "color": INK, "marker": "o"}
        neutral["markerfacecolor"] = INK if way == "plain" else "white"
        keys.append(Line2D([], [], label=way, **neutral))
    return keys
