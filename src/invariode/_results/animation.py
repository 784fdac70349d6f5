"""Motion as a film: what `Solution.animate` returns, and the points that it shows. Needs the extra `plot`."""

from __future__ import annotations

import base64
import io
import math
import operator
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from matplotlib.animation import FuncAnimation, writers
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.pyplot import close
from matplotlib.ticker import MaxNLocator
from PIL import Image

from .._base.arguments import Array, positive, shown
from .._base.style import COLOURS
from .pictures.canvas import component, new
from .pictures.curves import curve
from .result import Result

#: Seconds of a film without a given length: those of the motion from the first number to the second, in real time if t
#: is in seconds. A longer motion is shown in the third number.
_SHORTEST, _LONGEST, _SHORTENED = 4.0, 20.0, 8.0
#: Frames of the longest film: an hour at 30 in a second.
_MOST_FRAMES = 3600 * 30

#: Endings of the films that ffmpeg writes.
_VIDEOS = frozenset({"", ".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".ogv", ".mpg", ".mpeg", ".wmv", ".flv"})

#: Points of the path drawn behind a point: enough that the eye sees no corners. A run of many steps has several in
#: each, up to the last number.
_PATH, _PATH_PER_STEP, _LONGEST_PATH = 2000, 4, 20_000

#: The most parts between numbers at an axis in space, on which more would run together.
_PARTS = 5

#: Inches: the width of a new figure, its least and largest height, and the room for titles and labels.
_WIDTH, _LOWEST, _HIGHEST, _WORDS = 5.6, 2.6, 6.2, 0.9

#: Points between a film and its title, for the clock, which narrow axes would not hold beside the title.
_TITLE = 22

#: Room around the motion, in units of its extent.
_MARGIN = 0.06

#: An extent is at least this fraction of the largest one, so that motion along a line is visible.
_THINNEST = 0.2

#: Frames on a page have a palette of this many colours, if that changes their values (0 to 255) by at most the second
#: number on average: lines and text need few colours, and take a quarter of the room.
_PALETTE, _UNSEEN = 32, 0.5

#: matplotlib's page of controls takes its icons from the network; these signs are in every font.
_ICONS = {
    "fa-minus": "−",
    "fa-plus": "+",
    "fa-fast-backward": "|◀◀",
    "fa-fast-forward": "▶▶|",
    "fa-step-backward": "◀|",
    "fa-step-forward": "|▶",
    "fa-pause": "II",
    "fa-play fa-flip-horizontal": "◀",
    "fa-play": "▶",
}


class FramePoints(NamedTuple):
    """Points at the times of the frames, and between the frames if their paths are drawn."""

    times: Array  # (frames,)
    points: Array  # (frames, k, 2 or 3)
    paths: Array  # (1 + finer * (frames - 1), traced, 2 or 3)
    finer: int


def animated(
    sol: Result,
    points: Any,
    links: Iterable[Any],
    trace: Iterable[int],
    duration: float | None,
    fps: float,
    ax: Any,
    line: dict[str, Any],
) -> Film:
    """See `Solution.animate`."""
    motion = _motion(sol, points if callable(points) else _coordinates(sol, points), trace, duration, fps)
    joined = _polylines("links", links, motion.points.shape[1])
    space = motion.points.shape[2] == 3
    if ax is not None:
        if (ax.name == "3d") != space:
            wanted = 'axes with projection="3d"' if space else "axes of the plane"
            raise ValueError(f"the points have {motion.points.shape[2]} coordinates: give {wanted}")
        return Film(ax, motion, joined, fps, line)
    projection = {"subplot_kw": {"projection": "3d"}} if space else {}
    ax = new(sol._names.title, figsize=_film_size(motion.points), **projection)
    ax.set(xlabel="$x$", ylabel="$y$", **({"zlabel": "$z$"} if space else {}))
    ax.set_title(ax.get_title(), pad=_TITLE)
    film = Film(ax, motion, joined, fps, line)
    film.show(0)
    for _ in range(2):  # the height of the title is known after the first; then the frames stand still
        film.figure.draw_without_rendering()
    film.figure.set_layout_engine("none")
    return film


def _coordinates(sol: Result, points: Any) -> Array:
    """Return indices of components, (k, 2 or 3), from indices or labels."""
    rows = [points] if len(points) and (isinstance(points[0], str) or not np.iterable(points[0])) else list(points)
    sizes = {len(row) for row in rows}
    if sizes not in ({2}, {3}):
        raise ValueError(f"points must be points(t, y), or rows of two or three components, got {shown(points)}")
    return np.array([[component(sol._names.components, one) for one in row] for row in rows])


def _motion(
    sol: Result,
    points: Callable[[float, Array], Any] | Array,
    trace: Iterable[int],
    duration: float | None,
    fps: float,
) -> FramePoints:
    """Return the positions in a film of these points. `points`: a function, or indices of components (k, 2 or 3)."""
    times = _frame_times(sol, duration, fps)
    states = _states(sol)
    shown = _positions(states, points, times)
    (traced,) = _polylines("trace", [trace], shown.shape[1])
    if not traced:
        return FramePoints(times, shown, shown[:, traced], 1)
    length = min(max(_PATH, _PATH_PER_STEP * len(sol.t)), _LONGEST_PATH)
    finer = math.ceil(length / len(times))
    between = np.interp(np.arange(1 + finer * (len(times) - 1)) / finer, np.arange(len(times)), times)
    return FramePoints(times, shown, _positions(states, points, between)[:, traced], finer)


def _film_size(points: Array) -> tuple[float, float]:
    """Return width and height in inches of a new figure that has the shape of the motion."""
    if points.shape[2] == 3:
        return _WIDTH, _WIDTH
    width, height = _extent(*_corners(points))
    return _WIDTH, float(np.clip(_WORDS + (_WIDTH - _WORDS) * height / width, _LOWEST, _HIGHEST))


def _frame_times(sol: Result, duration: float | None, fps: float) -> Array:
    """Return equally spaced times, from the first time of the solution to the last."""
    ends = sol.t if sol.sol is None else sol.sol.ts
    if len(ends) < 2:
        raise ValueError("cannot animate a solution with a single point: solve with keep='all' or dense_output=True")
    rate = positive("fps", fps)
    span = float(abs(ends[-1] - ends[0]))
    usual = _SHORTENED if span > _LONGEST else max(span, _SHORTEST)
    seconds = usual if duration is None else positive("duration", duration)
    if not seconds * rate <= _MOST_FRAMES:
        raise ValueError(f"duration times fps must be at most {_MOST_FRAMES} frames, got {seconds:.6g} s at {rate:.6g}")
    return np.linspace(ends[0], ends[-1], max(2, round(seconds * rate)))


def _states(sol: Result) -> Callable[[Array], Array]:
    """Return the solution as a function of times, (n_t,) to (n, n_t): `sol.sol`, its curve or the nearest outputs."""
    if sol.sol is not None:
        return sol.sol
    forward = np.sign(sol.t[-1] - sol.t[0])
    whole = curve(sol)
    if not whole.smooth:
        middles = forward * (sol.t[1:] + sol.t[:-1]) / 2
        return lambda times: sol.y[:, np.searchsorted(middles, forward * times)]
    there = np.isfinite(whole.t) & np.isfinite(whole.y).all(axis=0)
    t, y = forward * whole.t[there], whole.y[:, there]
    return lambda times: np.array([np.interp(forward * times, t, row) for row in y]).reshape(len(y), len(times))


def _positions(states: Callable[[Array], Array], points: Callable[[float, Array], Any] | Array, times: Array) -> Array:
    """Return the positions of the points at these times, (n_t, k, 2 or 3)."""
    y = states(times)
    if not callable(points):
        shown: Array = np.moveaxis(y[points], -1, 0)
        return _checked(shown)
    return _checked(np.stack([_placed(points, t, state) for t, state in zip(times, y.T, strict=True)]))


def _placed(points: Callable[[float, Array], Any], t: float, y: Array) -> Array:
    """Return the points at one time, as (k, 2 or 3)."""
    placed = np.asarray(points(float(t), y.copy()))
    found = placed[None, :] if placed.ndim == 1 else placed
    if found.dtype.kind not in "biuf" or found.ndim != 2 or found.shape[1] not in (2, 3):
        raise ValueError(
            f"points(t, y) returned shape {placed.shape} of type {placed.dtype}: return real numbers of shape (k, 2) "
            "or (k, 3), a row for each point"
        )
    return found


def _checked(shown: Array) -> Array:
    if np.iscomplexobj(shown):
        raise ValueError("the components are complex: give points(t, y) that returns real numbers")
    bad = ~np.isfinite(shown).all(axis=(0, 2))
    if bad.any():
        raise ValueError(f"point {np.flatnonzero(bad)[0]} is not finite in some frame: leave it out of points")
    return shown


def _polylines(name: str, groups: Iterable[Any], count: int) -> list[list[int]]:
    """Return groups of points as lists of indices; a single index is a group too."""
    listed = [list(one) if np.iterable(one) else [one] for one in groups]
    for group in listed:
        for one in group:
            try:
                inside = 0 <= operator.index(one) < count
            except TypeError:
                inside = False
            if not inside:
                raise ValueError(f"{name} must name points by indices from 0 to {count - 1}, got {shown(one)}")
    return listed


class Film(FuncAnimation):
    """Points that move, joined by lines: a ``matplotlib.animation.FuncAnimation``.

    In a notebook it shows itself, with controls. Outside of one, keep a reference as long as the window is open.

    Attributes
    ----------
    figure : matplotlib.figure.Figure
        The figure with the film.
    times : ndarray, (frames,)
        The time that each frame shows.
    points : ndarray, (frames, k, 2 or 3)
        Where the points are.
    """

    def __init__(self, ax: Any, shown: FramePoints, links: list[list[int]], fps: float, line: dict[str, Any]) -> None:
        self.figure, self.times, self.points = ax.figure, shown.times, shown.points
        self._shown, self._links = shown, links
        _frame(ax, shown.points)
        quiet = {"lw": 0.9, "alpha": 0.6, "zorder": 1.5}
        self._paths = [_line(ax, COLOURS[k % len(COLOURS)], quiet) for k in range(shown.paths.shape[1])]
        ink = matplotlib.rcParams["text.color"]
        self._joined = [_line(ax, ink, {"lw": 2, "solid_capstyle": "round", **line}) for _ in links]
        self._dots = _line(ax, COLOURS[0], {"ls": "none", "marker": "o", "ms": 7})
        write = getattr(ax, "text2D", ax.text)  # axes of space have both
        self._clock = write(0, 1.02, "", transform=ax.transAxes, va="bottom")
        span = abs(self.times[-1] - self.times[0])
        self._digits = max(0, 2 - math.floor(math.log10(span))) if span > 0 else 2
        frames: dict[str, Any] = {"frames": len(self.times), "interval": 1000 / fps}
        super().__init__(ax.figure, self.show, init_func=lambda: self.show(0), **frames)

    def show(self, frame: int) -> Sequence[Any]:
        """Draw one frame.

        Parameters
        ----------
        frame : int
            Its number, from 0.

        Returns
        -------
        list of matplotlib.artist.Artist
            What has moved.
        """
        here = self.points[frame]
        for group, line in zip(self._links, self._joined, strict=True):
            _move(line, here[group])
        for k, line in enumerate(self._paths):
            _move(line, self._shown.paths[: 1 + frame * self._shown.finer, k])
        _move(self._dots, here)
        self._clock.set_text(f"$t$ = {self.times[frame]:.{self._digits}f}")
        return [*self._joined, *self._paths, self._dots, self._clock]

    def save(self, filename: str | os.PathLike[str], writer: Any = None, **options: Any) -> None:  # type: ignore[override]  # theirs in **options
        """Save the film in the format given by the ending of the name.

        Parameters
        ----------
        filename : str or path
            ``.gif``; ``.html``, a page with controls that needs no network; ``.mp4``, ``.webm`` and whatever else
            ffmpeg knows, if it is installed.
        writer : str or matplotlib.animation.AbstractMovieWriter, optional
            What writes it. Default: chosen by the ending.
        **options
            As for ``matplotlib.animation.Animation.save``: fps, dpi and others; for a page, only fps.

        Raises
        ------
        ValueError
            The name ends like that of a still picture.
        RuntimeError
            ffmpeg is needed and not installed.
        """
        ending = Path(filename).suffix.lower()
        if ending in (".png", ".jpg", ".jpeg", ".svg", ".pdf") and writer is None:
            raise ValueError(
                f"{ending} is the format of a still picture: save the film as .gif, .html or .mp4, or a picture by "
                "film.figure.savefig"
            )
        if writer is None and ending in (".html", ".htm"):
            page = f"<!DOCTYPE html>\n<meta charset='utf-8'>\n<title>{Path(filename).stem}</title>\n"
            Path(filename).write_text(page + self.to_jshtml(**options), encoding="utf-8")
            return
        if writer is None and ending in (".gif", ".apng", ".webp"):
            writer = "pillow"
        elif writer is None and not writers.is_available("ffmpeg"):
            if ending not in _VIDEOS:
                raise ValueError(f"{ending} is not the format of a film: save as .gif, .html or .mp4")
            raise RuntimeError(
                f"{ending or 'this file'} needs the program ffmpeg, not found here: save as .gif or .html"
            )
        still = {"savefig_kwargs", "extra_anim"}.isdisjoint(options) and isinstance(self.figure, Figure)
        with self._on_a_picture(options.get("dpi")) if still else nullcontext():
            super().save(os.fspath(filename), writer=writer, **options)

    @contextmanager
    def _on_a_picture(self, dpi: float | Literal["figure"] | None) -> Iterator[None]:
        """Draw the axes and what is around them once, as a picture behind the rest, since they take most of the time of
        drawing a frame; and draw each frame once, not in the window as well."""
        ax, canvas = self._dots.axes, self.figure.canvas
        still = _standing(ax)
        with _hidden([one for one in ax.get_children() if one not in still]):
            picture = _Still(_pixels(self.figure, dpi))
        axes_on = getattr(ax, "_axis3don", False)  # of axes in space
        canvas.draw_idle = lambda: None
        try:
            with _hidden(still):
                self.figure.add_artist(picture)
                if axes_on:
                    ax.set_axis_off()
                yield
        finally:
            del canvas.draw_idle
            picture.remove()
            if axes_on:
                ax.set_axis_on()

    def to_jshtml(self, fps: int | None = None, embed_frames: bool = True, default_mode: str | None = None) -> str:
        """Return HTML that shows the film with its controls, and needs no network.

        Parameters
        ----------
        fps, embed_frames, default_mode
            As in matplotlib. Frames of any size are embedded, with few colours if that cannot be seen.
        """
        with matplotlib.rc_context({"animation.embed_limit": math.inf}):
            found: str = super().to_jshtml(fps, embed_frames, default_mode)
        found = re.sub(r"(?<=data:image/png;base64,)[^\"]*", lambda frame: _with_palette(frame[0]), found)
        found = re.sub(r"<link rel=\"stylesheet\"\s+href=\"http[^>]*>", "", found)
        for icon, sign in _ICONS.items():
            found = found.replace(f'<i class="fa {icon}"></i>', sign)
        return found

    def _repr_html_(self) -> str:
        shown = self.to_jshtml()
        close(self.figure)  # a notebook would show the open figure as a still picture below the film
        return shown


class _Still(Artist):
    """Pixels (rows, columns, 4) behind all else in a figure. Unlike an image, they are not resampled."""

    zorder = -1

    def __init__(self, pixels: Array) -> None:
        super().__init__()
        self._pixels = pixels[::-1]

    def draw(self, renderer: Any) -> None:
        gc = renderer.new_gc()
        renderer.draw_image(gc, 0, 0, self._pixels)
        gc.restore()


def _pixels(figure: Any, dpi: float | Literal["figure"] | None) -> Array:
    """Return the figure as it is, (rows, columns, 4), in the dots in which a film is saved."""
    wanted = matplotlib.rcParams["savefig.dpi"] if dpi is None else dpi
    dots = float(figure.dpi if wanted == "figure" else wanted)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="rgba", dpi=dots)
    return np.frombuffer(drawn.getvalue(), np.uint8).reshape(-1, int(figure.get_figwidth() * dots), 4)


def _with_palette(frame: str) -> str:
    """A frame, a PNG in base64, with a palette instead of colours of its own; as it is if that could be seen."""
    with Image.open(io.BytesIO(base64.b64decode(frame.replace("\\\n", "")))) as opened:
        whole = opened.convert("RGB")
    few = whole.quantize(_PALETTE, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    changes = np.asarray(whole, dtype=float) - np.asarray(few.convert("RGB"), dtype=float)
    if np.abs(changes).mean() > _UNSEEN:
        return frame
    written = io.BytesIO()
    few.save(written, format="PNG", optimize=True)
    return base64.b64encode(written.getvalue()).decode("ascii")


def _standing(ax: Any) -> list[Any]:
    """Return the frame of the axes, and whatever else the figure shows."""
    figure = ax.figure
    others = [one for one in figure.get_children() if one not in (ax, figure.patch)]
    axes = [ax.xaxis, ax.yaxis, *([ax.zaxis] if ax.name == "3d" else [])]
    return [*others, ax.patch, *ax.spines.values(), *axes]


@contextmanager
def _hidden(artists: Iterable[Any]) -> Iterator[None]:
    shown = [one for one in artists if one.get_visible()]
    for one in shown:
        one.set_visible(False)
    try:
        yield
    finally:
        for one in shown:
            one.set_visible(True)


def _line(ax: Any, colour: Any, properties: dict[str, Any]) -> Any:
    empty: list[list[float]] = [[], [], []] if ax.name == "3d" else [[], []]
    return ax.plot(*empty, **{"color": colour, **properties})[0]


def _move(line: Any, to: Array) -> None:
    if to.shape[1] == 2:
        line.set_data(*to.T)
    else:
        line.set_data_3d(*to.T)


def _frame(ax: Any, points: Array) -> None:
    """Set limits for the whole motion, and in the plane for whatever else the axes show, with one scale on all axes."""
    low, high = _corners(points)
    if len(low) == 2 and ax.has_data():
        low, high = np.minimum(low, ax.dataLim.min), np.maximum(high, ax.dataLim.max)
    extent, middle = _extent(low, high), (low + high) / 2
    for axis, centre, size in zip("xyz", middle, extent, strict=False):
        getattr(ax, f"set_{axis}lim")(centre - size / 2, centre + size / 2)
    if len(low) == 3:
        ax.set_box_aspect(extent)
        for axis, size in zip((ax.xaxis, ax.yaxis, ax.zaxis), extent, strict=True):
            parts = max(1, round(_PARTS * size / extent.max()))
            axis.set_major_locator(MaxNLocator(parts, steps=[1, 2, 5, 10]))
    else:
        ax.set_aspect("equal", adjustable="box")


def _corners(points: Array) -> tuple[Array, Array]:
    return points.min(axis=(0, 1)), points.max(axis=(0, 1))


def _extent(low: Array, high: Array) -> Array:
    """Return the lengths of the axes, with the room around the motion."""
    extent = high - low
    reach: Array = np.maximum(extent, _THINNEST * (extent.max() or 1.0)) * (1 + 2 * _MARGIN)
    return reach
