"""Pictures of a Solution. Needs the extra `plot`.

The functions here are methods of `invariode.Solution`. They draw on the axes that they are given, or on those of a new
figure, and return them. Nothing is shown or saved: that is for ``matplotlib.pyplot.show()`` and ``Figure.savefig``.
Components are called what the problem's `labels` say; its `name`, where it was given one, is the title of new figures.
Fonts are those of matplotlib's settings, which are left as they are.
"""

from __future__ import annotations

import inspect
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import wraps
from importlib.util import find_spec
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from ._arguments import EPS, Array, tolerances
from ._style import COLOURS, DASHES, LEVELS, LOOK
from .invariants import BoundInvariants, Invariants, InvariantsLike, Jump, bind, to_invariants
from .result import Result, Steps

if TYPE_CHECKING:  # an extra, imported when a picture is drawn
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

    from .animation import Film

__all__ = ["animate", "plot", "plot_drift", "plot_phase", "plot_steps"]

#: Curves that can be told apart: as many as there are colours, solid and dash-dotted.
_MOST = len(COLOURS) * len(DASHES)

#: Points of a curve with dense output, and at the most in one step: the eye sees no corners.
_POINTS, _POINTS_PER_STEP = 4000, 32

#: Without dense output so few points are marked: the line between them is not the solution.
_FEW = 60

#: Axes whose extents differ by less than this get the same scale, so that circles are round.
_ALIKE = 3

#: The axis of errors and corrections goes no lower, in units of rtol: those of the first steps can be roundoff.
_NEGLIGIBLE = 1e-6

_MARKERS = "o^Dvps"


_Draw = TypeVar("_Draw", bound=Callable[..., Any])


def picture(*once: str) -> Callable[[_Draw], _Draw]:
    """A method that draws. `once`: its arguments by keyword that could be given by position up to version 0.1."""

    def decorate(draw: _Draw) -> _Draw:
        kinds = [p.kind for p in inspect.signature(draw).parameters.values()]
        by_position = kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD) - 1  # self

        @wraps(draw)
        def drawn(self: Result, *args: Any, **kwargs: Any) -> Any:
            _require_matplotlib()
            if len(late := args[by_position:]) > 0:
                if len(late) > len(once):
                    raise TypeError(f"{draw.__name__} takes {', '.join(once)} by keyword, got {len(args)} by position")
                written = ", ".join(f"{name}=..." for name, _ in zip(once, late, strict=False))
                message = f"{draw.__name__} takes axes by keyword since invariode 0.2: write {written}"
                warnings.warn(message, DeprecationWarning, stacklevel=2)
                if twice := [name for name in once[: len(late)] if name in kwargs]:
                    raise TypeError(f"{draw.__name__} got several values for {twice[0]}: give it by keyword only")
                kwargs |= dict(zip(once, late, strict=False))
            return draw(self, *args[:by_position], **kwargs)

        return cast("_Draw", drawn)

    return decorate


def _require_matplotlib() -> None:
    if find_spec("matplotlib") is None:
        raise ModuleNotFoundError("pictures need matplotlib: pip install invariode[plot]", name="matplotlib")


class Plots(Result):
    """The pictures of a `Solution`, as its methods."""

    @picture("ax", "components")
    def plot(self, *, ax: Axes | None = None, components: Any = None, **line: Any) -> Axes:
        """Draws components of the solution over t.

        With dense output the curves are those of ``sol.sol``, else they join the points of the output, which are
        marked where they are few. Of complex components the real part is solid and the imaginary part dashed. Where an
        action of an event made the solution jump the curves are interrupted; occurrences of events are open marks, at
        the state before the action.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw. Default: a new figure.
        components : int, str, or sequence of these, optional
            Indices or labels. Default: all, of more than twelve the first twelve, which the legend then says.
        **line
            Properties of the lines, as for ``Axes.plot``. A `label` tells this solution from others on the same axes.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        ValueError
            There is no such component.

        Notes
        -----
        The value at t = 0 stays in the data: ``ax.set_xscale("log")`` shows all later ones.
        """
        chosen = _components(self, components)
        ax = _new(self) if ax is None else ax
        t, y = _curve(self)
        names = self._names.components
        line, given = _properties(line)
        for k in chosen:
            colour, dashes = _unused(ax)
            for style, part, values in zip(dashes, *_parts(y[k]), strict=False):
                label = _joined(f"{part}{drawable(names[k])}", given)
                _draw(ax, self, t, values, {"color": colour, "linestyle": style, "label": label, **line})
        for label, marker, times, states in _occurrences(self):
            values = np.concatenate([part for k in chosen for part in _parts(states[:, k])[1]] or [times[:0]])
            _mark(ax, np.resize(times, len(values)), values, label, marker)
        ax.set_xlabel("$t$")
        if len(chosen) == 1:
            ax.set_ylabel(drawable(names[chosen[0]]))
        left_out = components is None and len(names) > len(chosen)
        _legend(ax, f"{len(chosen)} of {len(names)} components" if left_out else None)
        return ax

    @picture("ax")
    def plot_phase(self, i: int | str, j: int | str | None = None, *, ax: Axes | None = None, **line: Any) -> Axes:
        """Draws one component of the solution over another, with marks at start (dot) and end (square).

        Both axes have the same scale where their extents are alike, as those of orbits. Curves, jumps and events are as
        in `plot`.

        Parameters
        ----------
        i, j : int or str
            Components for the horizontal and the vertical axis, indices or labels. Of a complex solution `i` alone is
            drawn, in the complex plane.
        ax : matplotlib.axes.Axes, optional
            Where to draw. Default: a new figure.
        **line
            Properties of the line, as for ``Axes.plot``.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        ValueError
            There is no such component; two components of a complex solution, one of a real one.
        """
        names = self._names.components
        a = _component(names, i)
        if np.iscomplexobj(self.y):
            if j is not None:
                raise ValueError(
                    f"the solution is complex: plot_phase({i!r}) draws one component in the complex plane, "
                    f"got j = {j!r}"
                )
            labels = f"Re {drawable(names[a])}", f"Im {drawable(names[a])}"
        elif j is None:
            if len(names) == 1:
                raise ValueError(f"plot_phase needs two components, and this problem has one, {names[0]}")
            raise ValueError(f"plot_phase needs two components of {_listed(names)}, got only {i!r}")
        else:
            b = _component(names, j)
            labels = drawable(names[a]), drawable(names[b])

        def plane(states: Array) -> tuple[Array, Array]:
            return (states[a].real, states[a].imag) if j is None else (states[a], states[b])

        if ax is None:
            from matplotlib.ticker import MaxNLocator

            ax = _new(self, figsize=(5.6, 4.4))
            ax.xaxis.set_major_locator(MaxNLocator(6))  # more labels would touch where the aspect is equal
        line, given = _properties(line)
        curve = _draw(ax, self, *plane(_curve(self)[1]), {"color": _unused(ax)[0], "label": given, **line})
        for label, marker, _, states in _occurrences(self):
            _mark(ax, *plane(states.T), label, marker)
        paint: dict[str, Any] = {"color": curve.get_color(), "ls": "none", "zorder": 2.5}
        ends = self.y if self.sol is None else self.sol(self.sol.ts[[0, -1]])
        if ends.shape[1] > 1:
            ax.plot(*plane(ends[:, :1]), marker="o", ms=7, label=_once(ax, "start"), **paint)
        ax.plot(*plane(ends[:, -1:]), marker="s", ms=4.5, mfc=ax.get_facecolor(), label=_once(ax, "end"), **paint)
        ax.set(xlabel=labels[0], ylabel=labels[1])
        width, height = ax.dataLim.width, ax.dataLim.height
        if 0 < width < _ALIKE * height < _ALIKE**2 * width:
            ax.set_aspect("equal")
        _legend(ax)
        return ax

    @picture("ax", "invariants")
    def plot_drift(self, *, ax: Axes | None = None, invariants: InvariantsLike | None = None, **line: Any) -> Axes:
        """Draws how far the invariants are from their values, on a logarithmic axis.

        Solid: ``|g - value|`` at the outputs, after projection. Dotted: the largest before projection
        (`invariode.Solution.drift`).

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw. Default: a new figure.
        invariants : callable, Invariants, or list of these, optional
            What to look at instead of the run's own invariants: how a run drifts that did not keep them. They are
            compared with their values, else with those that they have at the first output and after each jump. They
            get the arguments of the run.
        **line
            Properties of the lines, as for ``Axes.plot``. A `label` tells this solution from others on the same axes.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        ValueError
            There were no invariants, and none were given; the output is empty.

        Notes
        -----
        Zeros have no logarithm. They are drawn at half the smallest residual that is not zero; nothing is drawn below
        ε/2 times the larger of ``|value|`` and the largest residual. Zeros at points that define a value are left out.
        Of more than twelve invariants the first twelve are drawn, or where they have levels the largest of each level.
        The lines of level 0 are solid, those of level 1 dashed, of level 2 dash-dotted; a constraint and its rate have
        one colour.
        """
        listed = to_invariants(invariants)
        if not listed and not len(self._invariants):
            raise ValueError("the run had no invariants: tell which to look at, plot_drift(invariants=g)")
        if not len(self.t):
            raise ValueError("the output has no points to look at: t_eval was empty")
        g = _bound(self, listed) if listed else self._invariants
        pieces = g.pieces_of_output(len(self.t))
        residual = np.abs(g.residual(self.t, self.y, pieces))
        largest = np.zeros(len(g)) if listed else self._drift.residual[: len(g)]
        defining = np.diff(pieces, prepend=-1) > 0
        t = _interrupted(self, self.t)
        ax = _new(self) if ax is None else ax
        ax.set_yscale("log")
        line, given = _properties(line)
        for name, style, value, r, before in _drifting(g, residual, largest):
            colour, dashes = _unused(ax, style)
            floor = max(EPS / 2 * max(abs(value), before, r.max(initial=0)), r[r > 0].min(initial=np.inf) / 2)
            floor = floor if 0 < floor < np.inf else EPS / 2
            drawn = _interrupted(self, np.where(defining & (r == 0), np.nan, np.maximum(r, floor)))
            label = _joined(drawable(name), given)
            curve = _draw(ax, self, t, drawn, {"color": colour, "linestyle": dashes[0], "label": label, **line})
            if before > 0:
                ax.plot(self.t[[0, -1]], [before, before], ":", color=curve.get_color(), lw=1)
        if largest.any():
            ax.plot([], [], ":", color="0.5", lw=1, label=_once(ax, "largest before\nprojection"))
        ax.set_xlabel("$t$")
        ax.set_ylabel(f"residual of {drawable(g.names[0])}" if len(g) == 1 else r"residual $|g - \mathrm{value}|$")
        left_out = len(g) > _MOST and not _has_levels(g)
        _legend(ax, f"{_MOST} of {len(g)} invariants" if left_out else None)
        return ax

    @picture("axes")
    def plot_steps(self, *, axes: Any = None, **line: Any) -> Array:
        """Draws the accepted steps over t: their size ``|h|``, their order, and their estimated error in units of rtol.

        Where invariants were imposed, the corrections by projection stand beside the errors, in the same unit.

        Parameters
        ----------
        axes : sequence of one to three matplotlib.axes.Axes, optional
            Where to draw, from the size on. Default: three on a new figure.
        **line
            Properties of the lines, as for ``Axes.plot``.

        Returns
        -------
        ndarray of matplotlib.axes.Axes

        Raises
        ------
        ValueError
            The steps were not kept, as with `t_eval`: ``keep="all"`` keeps them; or there are not one to three axes.

        Notes
        -----
        Failed attempts are not kept. Errors and corrections below 1e-6, as the first steps may have them, are cut off.
        """
        if self.steps is None:
            raise ValueError('the steps are kept with keep="all"')
        new = axes is None
        panels = _new_panels(self) if new else np.ravel(np.asarray(axes, dtype=object))
        if not 1 <= len(panels) <= 3:
            raise ValueError(f"plot_steps draws on one to three axes, got {len(panels)}")
        line, given = _properties(line)
        taken = {one.get_color() for panel in panels for one in panel.lines}
        colour = next((one for one in COLOURS if one not in taken), _unused(panels[0])[0])
        paint = {"color": colour, "linewidth": 1.2, "drawstyle": "steps-pre", "label": given, **line}
        _draw_sizes(panels[0], self.steps, paint)
        if len(panels) > 1:
            _draw_orders(panels[1], self.steps, paint)
        if len(panels) > 2:
            _draw_errors(panels[2], self.steps, paint["color"], given)
        for panel in panels:
            place = panel.get_subplotspec()
            if place is None or place.is_last_row():
                panel.set_xlabel("$t$")
            if new:
                panel.label_outer()
        return panels

    def animate(
        self,
        points: Any,
        *,
        links: Iterable[Sequence[int]] = (),
        trace: Iterable[int] = (),
        duration: float | None = None,
        fps: float = 25,
        ax: Axes | None = None,
        **line: Any,
    ) -> Film:
        """Shows the motion of points in the plane or in space as a film.

        Parameters
        ----------
        points : callable or array_like of shape (k, 2) or (k, 3)
            ``points(t, y)`` returns where the points are, an array of shape (k, 2) or (k, 3); y has shape (n,). Fixed
            points, as the pivot of a pendulum, are points too. Or which components are the coordinates, a row of
            indices or labels for each point.
        links : sequence of sequences of int, optional
            Points to be joined by lines: ``[(0, 1), (1, 2, 3)]``. Default: none.
        trace : sequence of int, optional
            Points whose path up to the moment is drawn. Default: none.
        duration : float, optional
            Seconds that the film takes. Default: as long as the motion, from 4 to 8.
        fps : float, default 25
            Frames per second.
        ax : matplotlib.axes.Axes, optional
            Where to draw; for points in space, axes with ``projection="3d"``. Default: a new figure.
        **line
            Properties of the links, as for ``Axes.plot``.

        Returns
        -------
        Film
            A ``matplotlib.animation.FuncAnimation``. ``film.save("motion.gif")`` makes a file: a GIF, a page with
            controls (``.html``), or where ffmpeg is installed a video (``.mp4``). In a notebook it shows itself.

        Raises
        ------
        ValueError
            `points` returns another shape, or values that are not finite; `links` or `trace` name points that are not
            there; the axes have another number of dimensions.

        Notes
        -----
        Frames are equally spaced in t, at states of ``sol.sol``. Without dense output each shows the nearest point of
        the output: give ``dense_output=True``, or many points in `t_eval`, for smooth motion.
        """
        _require_matplotlib()
        from .animation import Film, film_size, motion, polylines

        placed = points if callable(points) else _coordinates(self, points)
        shown = motion(self, placed, trace=trace, duration=duration, fps=fps)
        joined = polylines("links", links, shown.points.shape[1])
        space = shown.points.shape[2] == 3
        if ax is not None:
            if (ax.name == "3d") != space:
                wanted = 'axes with projection="3d"' if space else "axes of the plane"
                raise ValueError(f"the points have {shown.points.shape[2]} coordinates: give {wanted}")
            return Film(ax, shown, joined, fps, line)
        projection = {"subplot_kw": {"projection": "3d"}} if space else {}
        ax = _new(self, figsize=film_size(shown.points), **projection)
        ax.set(xlabel="$x$", ylabel="$y$", **({"zlabel": "$z$"} if space else {}))
        film = Film(ax, shown, joined, fps, line)
        film.figure.draw_without_rendering()  # laid out once: the frames stand still
        film.figure.set_layout_engine("none")
        return film


plot, plot_phase, plot_drift, plot_steps = Plots.plot, Plots.plot_phase, Plots.plot_drift, Plots.plot_steps
animate = Plots.animate


def _over_steps(steps: Steps, values: Array) -> tuple[Array, Array]:
    """t and values of a curve that is constant over each step."""
    return np.concatenate([steps.t[:1] - steps.h[:1], steps.t]), np.concatenate([values[:1], values])


def _draw_sizes(ax: Axes, steps: Steps, paint: dict[str, Any]) -> None:
    ax.plot(*_over_steps(steps, np.abs(steps.h)), **paint)
    ax.set(yscale="log", ylabel="step size $|h|$")
    low, high = ax.dataLim.intervaly
    if 0 < low <= high < 1.2 * low:  # equal but for roundoff: a logarithmic axis would show that and nothing else
        ax.set_ylim(low / 2, 2 * high, auto=None)
    _legend(ax)


def _draw_orders(ax: Axes, steps: Steps, paint: dict[str, Any]) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.plot(*_over_steps(steps, steps.order), **paint)
    ax.set_ylabel("order")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5, min_n_ticks=1))
    if len(steps.t):
        low, high = ax.dataLim.intervaly
        ax.set_ylim(low - 0.5, high + 0.5, auto=None)


def _draw_errors(ax: Axes, steps: Steps, colour: Any, given: str | None) -> None:
    """The estimated errors, and the corrections by projection if there were any, in units of rtol."""
    dots: dict[str, Any] = {"ls": "none", "marker": ".", "ms": 4 if len(steps.t) < 500 else 2}
    if not ax.lines:
        ax.axhline(1, color="0.5", lw=0.9, ls="--", zorder=1)
    ax.plot(steps.t, _positive(steps.error), color=colour, label=_joined("error", given), **dots)
    if steps.correction.any():
        other = next(one for one in COLOURS if one not in [line.get_color() for line in ax.lines])
        ax.plot(steps.t, _positive(steps.correction), color=other, label=_joined("correction", given), **dots)
        ax.set_ylabel("in units of rtol")
    elif not ax.get_ylabel():
        ax.set_ylabel("error / rtol")
    ax.set_yscale("log")
    top = max(steps.error.max(initial=0), steps.correction.max(initial=0))
    ax.set_ylim(bottom=max(ax.get_ylim()[0], min(_NEGLIGIBLE, top / 100)), auto=None)
    _legend(ax)


def _new(sol: Result, **options: Any) -> Axes:
    """Axes of a new figure."""
    panel: Axes = _new_panels(sol, rows=1, **options)[0]
    return panel


def _new_panels(sol: Result, rows: int = 3, **options: Any) -> Array:
    import matplotlib
    import matplotlib.pyplot as plt  # here, since it chooses a backend, which axes that are given have

    # It chooses now: that of a notebook turns `interactive` on when it is loaded, which the context would take back.
    plt.draw_if_interactive()  # type: ignore[no-untyped-call]
    options = {"figsize": (6.4, 4.0 if rows == 1 else 5.6), **options}
    with matplotlib.rc_context(LOOK):
        _, axes = plt.subplots(
            rows, sharex=True, squeeze=False, layout="constrained", height_ratios=(3, 1.3, 2)[:rows], **options
        )
    for ax in axes.flat:
        ax.grid(True, color="0.5", alpha=0.2, lw=0.7)  # on dark backgrounds too
    if sol._names.title is not None:
        axes[0, 0].set_title(drawable(sol._names.title))
    panels: Array = axes[:, 0]
    return panels


def drawable(name: str) -> str:
    """A name as text of a picture: dollar signs that enclose no formula that matplotlib reads stand for themselves."""
    from matplotlib.mathtext import MathTextParser

    try:
        MathTextParser("path").parse(name)
    except ValueError:
        return name.replace("$", r"\$")
    return name


def _legend(ax: Axes, title: str | None = None) -> None:
    """Beside the axes, where it covers nothing; inside where the caller's figure does not make room for it."""
    from matplotlib.lines import Line2D

    handles, labels = ax.get_legend_handles_labels()
    if not labels or labels in (["error"], [ax.get_ylabel()], [ax.get_ylabel().removeprefix("residual of ")]):
        return  # the label of the axis says it
    beside: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.01, 1), "borderaxespad": 0, "frameon": False}
    marks = [isinstance(handle, Line2D) and handle.get_linestyle() == "None" for handle in handles]
    order = np.argsort(marks, kind="stable")  # curves first
    handles, labels = [handles[k] for k in order], [labels[k] for k in order]
    figure = ax.get_figure()
    where = {"loc": "best"} if figure is None or figure.get_layout_engine() is None else beside
    ax.legend(handles, labels, title=title, alignment="left", ncols=1 + len(handles) // 18, **where)


def _component(names: Sequence[str], one: Any) -> int:
    """The index of a component given by index or label."""
    if isinstance(one, str) and one in names:
        return names.index(one)
    try:
        index = operator.index(one)
    except TypeError:
        index = len(names)
    if not -len(names) <= index < len(names):
        raise ValueError(f"there is no component {one!r}: choose from {_listed(names)}, or by index")
    return index % len(names)


def _components(sol: Result, components: Any) -> list[int]:
    names = sol._names.components
    if components is None:
        return list(range(min(len(names), _MOST)))
    listed = [components] if isinstance(components, str) or not np.iterable(components) else components
    return [_component(names, one) for one in listed]


def _coordinates(sol: Result, points: Any) -> Array:
    """Indices of components, (k, 2 or 3), from indices or labels."""
    rows = [points] if len(points) and (isinstance(points[0], str) or not np.iterable(points[0])) else list(points)
    sizes = {len(row) for row in rows}
    if sizes not in ({2}, {3}):
        raise ValueError(f"points must be points(t, y), or rows of two or three components, got {points!r}")
    return np.array([[_component(sol._names.components, one) for one in row] for row in rows])


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names if len(names) <= _MOST else [*names[: _MOST - 1], "…", names[-1]])


def _curve(sol: Result) -> tuple[Array, Array]:
    """t (k,) and y (n, k) of a smooth curve, with NaN where it jumps."""
    if sol.sol is None:
        return _interrupted(sol, sol.t), _interrupted(sol, sol.y)
    knots = sol.sol.ts
    count = min(max(_POINTS // len(knots), 1), _POINTS_PER_STEP)
    inside = np.arange(count) / count
    pieces = []
    jumps = np.flatnonzero(np.diff(knots) == 0) + 1
    for piece in np.split(knots, jumps):
        t = np.append((piece[:-1, None] + np.diff(piece)[:, None] * inside).ravel(), piece[-1])
        pieces.append(t)
    for piece in pieces[:-1]:
        piece[-1] = np.nextafter(piece[-1], knots[0])  # at the jump itself sol.sol has the later value
    t = np.concatenate(pieces)
    cuts = np.cumsum([len(piece) for piece in pieces[:-1]], dtype=int)
    return np.insert(t, cuts, np.nan), np.insert(sol.sol(t), cuts, np.nan, axis=1)


def _interrupted(sol: Result, values: Array) -> Array:
    """Values at the outputs, in the last axis, with NaN where the solution jumps."""
    cuts = [jump.row for jump in sol._invariants.jumps if 0 < jump.row < len(sol.t)]
    return np.insert(values, cuts, np.nan, axis=-1)


def _parts(values: Array) -> tuple[list[str], list[Array]]:
    """What stands before the label, and real values: one of each, for complex values two."""
    return (["Re ", "Im "], [values.real, values.imag]) if np.iscomplexobj(values) else ([""], [values])


def _unused(ax: Axes, style: str | None = None) -> tuple[str, tuple[str, str]]:
    """The first colour and dashes, or colour with the style given, that nothing on the axes has yet; else the first."""
    choice = DASHES if style is None else ((style, ":"),)
    used = [(line.get_color(), str(line.get_linestyle()).replace("None", "-")) for line in ax.lines]
    free = ((colour, dashes) for dashes, colour in product(choice, COLOURS) if (colour, dashes[0]) not in used)
    return next(free, (COLOURS[0], choice[0]))


def _properties(line: dict[str, Any]) -> tuple[dict[str, Any], str | None]:
    """Properties of a line under their full names, and the label apart."""
    from matplotlib.cbook import normalize_kwargs
    from matplotlib.lines import Line2D

    full = normalize_kwargs(line, Line2D)
    return full, full.pop("label", None)


def _joined(name: str, given: str | None) -> str:
    return name if given is None else f"{name}, {given}"


def _once(ax: Axes, label: str) -> str:
    """The label, unless the legend has it already."""
    return "_nolegend_" if label in ax.get_legend_handles_labels()[1] else label


def _draw(ax: Axes, sol: Result, x: Array, y: Array, properties: dict[str, Any]) -> Line2D:
    few = sol.sol is None and len(sol.t) <= _FEW
    return ax.plot(x, y, **{"linewidth": 1.4, "marker": "." if few else "none", "markersize": 5, **properties})[0]


def _occurrences(sol: Result) -> Iterator[tuple[str, str, Array, Array]]:
    """Label and marker of each event that occurred, its times (k,) and states (k, n)."""
    if sol.t_events is None or sol.y_events is None:
        return
    for k, (name, t, y) in enumerate(zip(sol._names.events, sol.t_events, sol.y_events, strict=True)):
        if len(t):
            yield drawable(name), _MARKERS[k % len(_MARKERS)], t, y


def _mark(ax: Axes, x: Array, y: Array, label: str, marker: str) -> None:
    import matplotlib

    size = 4.5 if len(x) <= _FEW else 3
    ink = matplotlib.rcParams["text.color"]
    paint = {"mfc": ax.get_facecolor(), "mec": ink, "mew": 0.8, "zorder": 3}
    ax.plot(x, y, marker, color=ink, ms=size, label=_once(ax, label), **paint)


def _bound(sol: Result, listed: list[Invariants]) -> BoundInvariants:
    """Invariants that the run did not have, held at their values at the first output and after each jump."""
    own, y0 = sol._invariants, sol.y[:, 0].copy()
    g = bind(listed, float(sol.t[0]), y0, own.args, tolerances(1e-3, 1e-6, y0)[1])
    jumps = []
    for row, t, _ in own.jumps:
        here = slice(row, row + 1)
        there = g.value + g.residual(sol.t[here], sol.y[:, here])[:, 0] if row < len(sol.t) else g.value
        jumps.append(Jump(row, t, np.where(g.demanded, g.value, there)))
    return replace(g, jumps=tuple(jumps), forward=own.forward)


def _has_levels(g: BoundInvariants) -> bool:
    return len({spec.level for spec in g.specs}) > 1


def _drifting(g: BoundInvariants, residual: Array, largest: Array) -> list[tuple[str, str | None, Any, Array, Any]]:
    """Name, dashes if levels tell them, value, residuals and largest one before projection, for each line."""
    lines = [(name, None, *rest) for name, *rest in zip(g.names, g.value, residual, largest, strict=True)]
    if not _has_levels(g):
        return lines[:_MOST]
    levels = np.array([spec.level for spec in g.specs for _ in range(spec.m)])
    groups = [(level, np.flatnonzero(levels == level)) for level in np.unique(levels)]
    if len(g) <= _MOST:
        styles = {level: LEVELS[k % len(LEVELS)] for k, (level, _) in enumerate(groups)}
        return [(name, styles[level], *rest) for level, (name, _, *rest) in zip(levels, lines, strict=True)]
    return [
        (
            f"level {level}: largest of {len(of)}" if len(of) > 1 else g.names[of[0]],
            LEVELS[k % len(LEVELS)],
            np.abs(g.value[of]).max(),
            residual[of].max(axis=0),
            largest[of].max(),
        )
        for k, (level, of) in enumerate(groups)
    ]


def _positive(values: Array) -> Array:
    """NaN for zeros, which a logarithmic axis cannot show."""
    return np.where(values > 0, values, np.nan)
