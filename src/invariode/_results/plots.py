"""Pictures of a Solution. Needs the extra `plot`.

The functions here are methods of `invariode.Solution`. They draw on the axes that they are given, or on those of a new
figure, and return them. Nothing is shown or saved: call ``matplotlib.pyplot.show()`` or ``Figure.savefig``. The
problem's `labels` name the components; its `name`, if it has one, is the title of new figures. Fonts follow
matplotlib's settings, which are not changed.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from .._base.arguments import Array, flag, shown
from .._problem.invariants import InvariantsLike
from .pictures import drift, over_time, phase, steps
from .pictures.canvas import component, new, require_matplotlib
from .result import Result

if TYPE_CHECKING:  # an extra, imported when a picture is drawn
    from matplotlib.axes import Axes

    from .animation import Film

__all__ = ["animate", "plot", "plot_drift", "plot_phase", "plot_steps"]


#: Points between a film and its title, for the clock, which narrow axes would not hold beside the title.
_TITLE = 22

_Draw = TypeVar("_Draw", bound=Callable[..., Any])


def picture(*once: str, since: int | None = None) -> Callable[[_Draw], _Draw]:
    """A method that draws. `once`: its arguments by keyword that could be given by position up to version 0.1, then
    from the position `since` on, where there are new ones now."""

    def decorate(draw: _Draw) -> _Draw:
        kinds = [p.kind for p in inspect.signature(draw).parameters.values()]
        by_position = kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD) - 1  # self

        @wraps(draw)
        def drawn(self: Result, *args: Any, **kwargs: Any) -> Any:
            require_matplotlib()
            moved = since is not None and len(args) > since and hasattr(args[since], "get_figure")
            first = since if moved and since is not None else by_position
            if len(late := args[first:]) > 0:
                if len(late) > len(once):
                    raise TypeError(f"{draw.__name__} takes {', '.join(once)} by keyword, got {len(args)} by position")
                written = ", ".join(f"{name}=..." for name, _ in zip(once, late, strict=False))
                message = f"{draw.__name__} takes axes by keyword since invariode 0.2: write {written}"
                warnings.warn(message, DeprecationWarning, stacklevel=2)
                if twice := [name for name in once[: len(late)] if name in kwargs]:
                    raise TypeError(f"{draw.__name__} got several values for {twice[0]}: give it by keyword only")
                kwargs |= dict(zip(once, late, strict=False))
            return draw(self, *args[:first], **kwargs)

        return cast("_Draw", drawn)

    return decorate


class Plots(Result):
    """The pictures of a `Solution`, as its methods."""

    @picture("ax", "components")
    def plot(self, *, ax: Axes | None = None, components: Any = None, **line: Any) -> Axes:
        """Draws components of the solution over t.

        The curves are continuous: those of ``sol.sol`` with dense output, else cubics through the steps with the slopes
        of f, which is evaluated for them once per point (with implicit methods, monotone cubics). Output at `t_eval`,
        which says nothing about the solution in between, is joined by straight lines, and marked if it is sparse. A
        long run is drawn by its extremes in each column of the page, and as a range if it fills the page. The real part
        of a complex component is solid, the imaginary part dashed. Curves are interrupted at jumps; occurrences of
        events are open marks, at the state before the action.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw everything. Default: a new figure, with a panel for each group of components whose sizes
            differ from those of the others by a factor of more than 1000.
        components : int, str, or sequence of these, optional
            Indices or labels. Default: all. More than twelve share a sequence of colours, and only some are named.
        **line
            Properties of the lines, as for ``Axes.plot``. A `label` tells this solution from others on the same axes;
            a `marker` marks the points of the output.

        Returns
        -------
        matplotlib.axes.Axes
            The first of several panels; all are in ``ax.figure.axes``.

        Raises
        ------
        ValueError
            There is no such component; the run kept its final state only.

        Notes
        -----
        The value at t = 0 stays in the data: ``ax.set_xscale("log")`` shows all later ones.
        """
        return over_time.draw(self, ax, components, line)

    @picture("ax", since=2)
    def plot_phase(
        self,
        i: int | str,
        j: int | str | None = None,
        k: int | str | None = None,
        *,
        ax: Axes | None = None,
        field: bool = False,
        **line: Any,
    ) -> Axes:
        """Draws two or three components of the solution against each other, with marks at start (dot) and end (square).

        Both axes have the same scale if their extents are similar, as for orbits. Curves, jumps and events are as in
        `plot`.

        Parameters
        ----------
        i, j : int or str
            Components for the horizontal and the vertical axis, indices or labels. If the solution is complex, only `i`
            is drawn, in the complex plane.
        k : int or str, optional
            A third component: the curve is drawn in space.
        ax : matplotlib.axes.Axes, optional
            Where to draw; in space, axes with ``projection="3d"``. Default: a new figure.
        field : bool, default False
            Whether to draw arrows in the direction of f, at the initial time, behind the curve. Only for problems of
            two real components.
        **line
            Properties of the line, as for ``Axes.plot``. A `marker` marks the points of the output.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        ValueError
            There is no such component; two components of a complex solution, or one of a real one; a field for another
            kind of problem; the run kept only its final state.
        """
        return phase.draw(self, (i, j, k), ax, flag("field", field), line)

    @picture("ax", "invariants")
    def plot_drift(
        self,
        *,
        ax: Axes | None = None,
        invariants: InvariantsLike | None = None,
        relative: bool = False,
        **line: Any,
    ) -> Axes:
        """Draws how far the invariants are from their values, on a logarithmic axis.

        Solid: ``|g - value|`` at the outputs, after projection. Dotted: the largest before projection
        (`invariode.Solution.drift`).

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw. Default: a new figure.
        invariants : callable, Invariants, or list of these, optional
            What to draw instead of the run's own invariants, to see how a run that did not impose them drifts. They are
            compared with their demanded values, else with their values at the first output and after each jump. They
            get the arguments of the run.
        relative : bool, default False
            Whether residuals are drawn in units of the values: ``|g - value| / |value|``.
        **line
            Properties of the lines, as for ``Axes.plot``. A `label` tells this solution from others on the same axes.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        ValueError
            There are no invariants; the output is empty; the value of one is 0, with `relative`.

        Notes
        -----
        Zeros have no logarithm. They are drawn at half the smallest residual that is not zero; nothing is drawn below
        ε/2 times the larger of ``|value|`` and the largest residual. Zeros at points that define a value are left out.
        If there are more than twelve invariants, the first twelve are drawn, or the largest of each level. Lines of
        level 0 are solid, of level 1 dashed, of level 2 dash-dotted; a constraint and its rate share a colour.
        """
        return drift.draw(self, ax, invariants, flag("relative", relative), line)

    @picture("axes")
    def plot_steps(self, *, axes: Any = None, **line: Any) -> Array:
        """Draws the accepted steps over t: their size ``|h|``, their order, and their estimated error in units of rtol.

        If invariants were imposed, the corrections by projection are drawn with the errors, in the same unit.

        Parameters
        ----------
        axes : sequence of one to three matplotlib.axes.Axes, optional
            Where to draw, beginning with the size. Default: three on a new figure.
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
        Failed attempts are not kept. Errors and corrections below 1e-6, as in the first steps, are cut off.
        """
        return steps.draw(self, axes, line)

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
            points, such as the pivot of a pendulum, are points too. Or the components that are coordinates, a row of
            indices or labels for each point.
        links : sequence of sequences of int, optional
            Points to be joined by lines: ``[(0, 1), (1, 2, 3)]``. Default: none.
        trace : sequence of int, optional
            Points whose path so far is drawn. Default: none.
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
            controls (``.html``), or, if ffmpeg is installed, a video (``.mp4``). In a notebook it shows itself.

        Raises
        ------
        ValueError
            `points` returns the wrong shape, or values that are not finite; `links` or `trace` name points that do not
            exist; the axes have the wrong number of dimensions.

        Notes
        -----
        Frames are equally spaced in t, at states of ``sol.sol``, or without dense output on the curves of `plot`.
        Output at `t_eval` says nothing about the solution in between: each frame shows the nearest point, so give many.
        """
        require_matplotlib()
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
        ax = new(self, figsize=film_size(shown.points), **projection)
        ax.set(xlabel="$x$", ylabel="$y$", **({"zlabel": "$z$"} if space else {}))
        ax.set_title(ax.get_title(), pad=_TITLE)
        film = Film(ax, shown, joined, fps, line)
        film.show(0)
        film.figure.draw_without_rendering()  # laid out once: the frames stand still
        film.figure.set_layout_engine("none")
        return film


plot, plot_phase, plot_drift, plot_steps = Plots.plot, Plots.plot_phase, Plots.plot_drift, Plots.plot_steps
animate = Plots.animate


def _coordinates(sol: Result, points: Any) -> Array:
    """Indices of components, (k, 2 or 3), from indices or labels."""
    rows = [points] if len(points) and (isinstance(points[0], str) or not np.iterable(points[0])) else list(points)
    sizes = {len(row) for row in rows}
    if sizes not in ({2}, {3}):
        raise ValueError(f"points must be points(t, y), or rows of two or three components, got {shown(points)}")
    return np.array([[component(sol._names.components, one) for one in row] for row in rows])
