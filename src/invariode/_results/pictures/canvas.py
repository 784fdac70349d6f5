"""Elements that all pictures share: figures, names, colours, legends, marks of events."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import EPS, Array, shown
from ..._base.package import extra
from ..._base.style import COLOURS, DASHES, LOOK
from ..._base.suggestions import meant
from ..result import Result

if TYPE_CHECKING:  # an extra, imported when a picture is drawn
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

#: The number of distinguishable curves: each colour, solid and dash-dotted.
MOST = len(COLOURS) * len(DASHES)

#: Up to this many points are marked if the line between them is not the solution; events are marked larger.
FEW = 60

#: Powers of ten from which on numbers at an axis have a common factor: written out they would run together.
_PLAIN_POWERS = (-3, 5)

#: A logarithmic axis that shows fewer powers of ten than this has numbers between them too, at these multiples.
_POWERS, _BETWEEN = 2, (2, 5)

_MARKERS = "o^Dvps"

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def require_matplotlib() -> Any:
    return extra("matplotlib", "pictures need", "plot")


def new(title: str | None, **options: Any) -> Axes:
    """Return axes of a new figure."""
    panel: Axes = new_panels(title, (1,), **options)[0]
    return panel


def new_panels(title: str | None, heights: Sequence[float], **options: Any) -> Array:
    """Return panels of a new figure below each other, of the given heights, with a common t axis."""
    matplotlib = require_matplotlib()
    import matplotlib.pyplot as plt  # here, since it chooses a backend, which axes that are given have

    # It chooses now: that of a notebook turns `interactive` on when it is loaded, which the context would take back.
    plt.draw_if_interactive()  # type: ignore[no-untyped-call]  # of matplotlib
    rows = len(heights)
    options = {"figsize": (6.4, 4.0 if rows == 1 else 3.2 + 0.8 * rows), **options}
    with matplotlib.rc_context(LOOK):
        _, axes = plt.subplots(rows, sharex=True, squeeze=False, layout="constrained", height_ratios=heights, **options)
    for ax in axes.flat:
        ax.grid(True, color="0.5", alpha=0.2, lw=0.7)  # on dark backgrounds too
        ax.ticklabel_format(scilimits=_PLAIN_POWERS)
    if title is not None:
        axes[0, 0].set_title(drawable(title))
    panels: Array = axes[:, 0]
    return panels


def log_axis(axis: Axis, formulas: bool = True) -> None:
    """Show at least a factor of ten, with numbers that are few enough not to touch. `formulas`: set by matplotlib's
    parser, which takes its time; otherwise the same as text."""
    from matplotlib.ticker import FuncFormatter

    name = axis.axis_name  # type: ignore[attr-defined]  # of XAxis and YAxis
    ax = axis.axes
    low, high = getattr(ax.dataLim, f"interval{name}")
    free = getattr(ax, f"get_autoscale{name}_on")()
    if free and 0 < low <= high < 10 * low:  # closer, rounding errors of equal values would fill the axis
        middle = np.sqrt(low * high)
        ax.set(**{f"{name}lim": (middle / np.sqrt(10), middle * np.sqrt(10))})
        getattr(ax, f"set_autoscale{name}_on")(True)  # for curves that are yet to come

    def between(value: float, place: int | None = None) -> str:
        least, most = np.log10(axis.get_view_interval())
        power = np.floor(np.log10(value) + EPS)
        multiple = round(value / 10.0**power)
        if np.floor(most) - np.ceil(least) + 1 >= _POWERS or multiple not in _BETWEEN:
            return ""
        return rf"${multiple} \times 10^{{{power:.0f}}}$" if formulas else f"{multiple}·{_power_of_ten(power)}"

    axis.set_minor_formatter(FuncFormatter(between))
    if not formulas:
        axis.set_major_formatter(FuncFormatter(lambda value, place=None: _power_of_ten(np.log10(value))))


def _power_of_ten(power: float) -> str:
    return "10" + f"{power:.0f}".translate(_RAISED)


def drawable(name: str) -> str:
    """Return a name as text in a picture: dollar signs that do not enclose a formula for matplotlib are drawn as they
    are."""
    if "$" not in name:
        return name
    from matplotlib.mathtext import MathTextParser

    try:
        MathTextParser("path").parse(name)
    except ValueError:
        return name.replace("$", r"\$")
    return name


def legend(ax: Axes, title: str | None = None, *, by_height: bool = False) -> None:
    """Draw a legend beside the axes, where it covers nothing; inside if the caller's figure makes no room for it.

    - `ax`: the axes, with everything drawn
    - `title`: the title of the legend
    - `by_height`: whether curves are listed from the one with the highest peak to the lowest. False: in the order in
      which they were drawn. Marks come last.
    """
    from matplotlib.lines import Line2D

    handles, labels = ax.get_legend_handles_labels()
    if not labels or labels in (["error"], [ax.get_ylabel()], [ax.get_ylabel().rpartition("residual of ")[2]]):
        return  # the label of the axis says it
    beside: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.01, 1), "borderaxespad": 0, "frameon": False}
    marks = [isinstance(handle, Line2D) and handle.get_linestyle() == "None" for handle in handles]
    heights = [-_height(handle) if by_height else 0.0 for handle in handles]
    order = np.lexsort((heights, marks))  # curves first
    handles, labels = [handles[k] for k in order], [labels[k] for k in order]
    figure = ax.get_figure()
    where = {"loc": "best"} if figure is None or figure.get_layout_engine() is None else beside
    ax.legend(handles, labels, title=title, alignment="left", ncols=1 + len(handles) // 18, **where)


def _height(handle: Any) -> float:
    """Return the largest value of a curve that has one, or -inf."""
    values = np.asarray(handle.get_ydata(), dtype=float) if hasattr(handle, "get_ydata") else np.zeros(0)
    values = values[np.isfinite(values)]
    return float(values.max(initial=-np.inf))


def component(names: Sequence[str], one: Any, what: str = "component") -> int:
    """Return the index of a component, or of something else with a name, given by index or name."""
    if isinstance(one, str) and one in names:
        return names.index(one)
    try:
        index = operator.index(one)
    except TypeError:
        index = len(names)
    if not -len(names) <= index < len(names):
        raise ValueError(
            f"there is no {what} {shown(one)}{meant(one, names)}: choose from {listed(names)}, or by index"
        )
    return index % len(names)


def listed(names: Sequence[str]) -> str:
    return ", ".join(names if len(names) <= MOST else [*names[: MOST - 1], "…", names[-1]])


def unused(ax: Axes, style: str | None = None) -> tuple[str, tuple[str, str]]:
    """Return the first colour and dashes, or colour with the style given, that nothing on the axes has yet; else the
    first."""
    choice = DASHES if style is None else ((style, ":"),)
    used = [(line.get_color(), str(line.get_linestyle()).replace("None", "-")) for line in ax.lines]
    free = ((colour, dashes) for dashes, colour in product(choice, COLOURS) if (colour, dashes[0]) not in used)
    return next(free, (COLOURS[0], choice[0]))


def properties(line: dict[str, Any]) -> tuple[dict[str, Any], str | None]:
    """Return properties of a line under their full names, and the label apart."""
    from matplotlib.cbook import normalize_kwargs
    from matplotlib.lines import Line2D

    full = normalize_kwargs(line, Line2D)
    return full, full.pop("label", None)


def joined(name: str, given: str | None) -> str:
    return name if given is None else f"{name}, {given}"


def once(ax: Axes, label: str) -> str:
    """Return the label, unless the legend has it already."""
    return "_nolegend_" if label in ax.get_legend_handles_labels()[1] else label


def occurrences(sol: Result) -> Iterator[tuple[str, str, Array, Array]]:
    """Yield label and marker of each event that occurred, its times (k,) and states (k, n)."""
    if sol.t_events is None or sol.y_events is None:
        return
    for k, (name, t, y) in enumerate(zip(sol._names.events, sol.t_events, sol.y_events, strict=True)):
        if len(t):
            yield drawable(name), _MARKERS[k % len(_MARKERS)], t, y


def mark(ax: Axes, place: Sequence[Array], label: str, marker: str) -> None:
    """Draw open marks at points, given by their coordinates."""
    import matplotlib

    size = 4.5 if len(place[0]) <= FEW else 3
    ink = matplotlib.rcParams["text.color"]
    paint = {"mfc": ax.get_facecolor(), "mec": ink, "mew": 0.8, "zorder": 3}
    ax.plot(*place, marker, color=ink, ms=size, label=once(ax, label), **paint)


def positive(values: Array) -> Array:
    """Return the values with NaN for those that are not positive, which a logarithmic axis cannot show."""
    return np.where(values > 0, values, np.nan)


def components(sol: Result, chosen: Any) -> list[int]:
    """Return indices of the components that were chosen, all by default."""
    return indices(sol._names.components, chosen, "component")


def indices(names: Sequence[str], chosen: Any, what: str) -> list[int]:
    """Return the places of chosen names, or of all by default; `what` they name, in messages."""
    if chosen is None:
        return list(range(len(names)))
    several = [chosen] if isinstance(chosen, str) or not np.iterable(chosen) else chosen
    return [component(names, one, what) for one in several]


def require_points(sol: Result) -> None:
    """Raise a ValueError for a run that took steps but kept only the last point."""
    if sol.sol is None and len(sol.t) == 1 and sol.stats.steps > 0 and sol.t[0] == sol.t_end:
        raise ValueError(
            'the run kept only its final state: for a picture solve with keep="all", the default, or with times in '
            "t_eval"
        )
