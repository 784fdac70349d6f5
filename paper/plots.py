"""The figures of the report. Needs the extra `plot`."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from invariode._base.arguments import EPS, Array
from invariode._base.style import IMPOSED, INK, PLAIN, PROJECTED, QUIET, STYLE
from invariode._results.solution import Solution
from invariode.problems import MU, MU_STAR

from .experiments import ORBITS, PENDULUM, REFINE, Results, residual

__all__ = ["FIGURES", "Plot", "svg"]

#: Width of a figure in inches: two stand side by side on a desk, one fills a phone. Usual height.
WIDTH, HEIGHT = 4.8, 3.7


@dataclass(frozen=True)
class Plot:
    """A figure of the report: its name, how it is drawn, its title, what there is to see, its height in inches."""

    name: str
    draw: Callable[[Axes, Results], None]
    title: str
    caption: str
    height: float = HEIGHT


def svg(plot: Plot, results: Results) -> str:
    """The figure as an SVG element for an HTML page."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, plot.height), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(True)
        plot.draw(axes, results)
        page = io.StringIO()
        figure.savefig(page, format="svg", transparent=True, metadata={"Date": None})
    return _inline(page.getvalue(), plot)


def _inline(page: str, plot: Plot) -> str:
    """The SVG element of a page by matplotlib, without its fixed size and metadata, with ids of its own and a label."""
    element = re.sub(r"<metadata>.*?</metadata>", "", page[page.index("<svg") :], flags=re.DOTALL)
    element = re.sub(r'(\bid="|"#|url\(#)', rf"\g<1>{plot.name}-", element)
    tag, _, rest = element.partition(">")
    tag = re.sub(r' (width|height)="[^"]*"', "", tag)
    return f'{tag} role="img" aria-label="{plot.title}">{rest.rstrip()}'


def _dense(sol: Solution, t: Array) -> Array:
    assert sol.sol is not None  # these runs have dense_output=True
    return sol.sol(t)


def _above(axes: Axes, columns: int) -> None:
    """The legend above the axes, where it covers nothing."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=columns,
        columnspacing=1.3,
        handletextpad=0.6,
        borderpad=0,
        borderaxespad=0.8,
        fontsize=9,
    )


def _phase_plane(axes: Axes, results: Results) -> None:
    runs = results.lotka_volterra
    t = np.linspace(0, 50, 4000)
    axes.plot(*_dense(runs.plain, t), color=PLAIN, lw=0.9, label="plain")
    axes.plot(*_dense(runs.continuous, t), color=PROJECTED, lw=1.4, label="projected")
    axes.plot(1, 3, "o", color=INK, ms=4, label="start")
    axes.set(xlabel="prey $x$", ylabel="predator $y$", xlim=(0, None), ylim=(0, None))
    _above(axes, 3)


def _orbit_residual(axes: Axes, results: Results) -> None:
    runs = results.lotka_volterra
    ulp = float(np.spacing(ORBITS.fun(0.0, runs.plain.y[:, 0])))
    imposed = np.maximum(np.abs(runs.imposed.residual[0]), ulp / 2)  # exact zeros have no logarithm
    for sol, colour, label in ((runs.plain, PLAIN, "plain"), (runs.projected, PROJECTED, "projected")):
        axes.semilogy(sol.t[1:], residual(ORBITS, sol)[0, 1:], color=colour, lw=1.1, label=label)  # zero at t0
    axes.semilogy(runs.imposed.t, imposed, ".", color=IMPOSED, ms=2, label="imposed a posteriori")
    axes.set(xlabel="$t$", ylabel="residual in the invariant", xlim=(0, 50), ylim=(1e-15, 1e2))
    axes.set_yticks([1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 1])
    axes.minorticks_off()
    _above(axes, 3)


def _last_step(axes: Axes, results: Results) -> None:
    runs = results.lotka_volterra
    t0, t1 = runs.raw.t[-REFINE - 1], runs.raw.t[-1]
    theta = np.linspace(0, 1, 201)
    held = ORBITS.fun(0.0, runs.raw.y[:, 0])
    for sol, colour, label in (
        (runs.raw, PLAIN, "raw"),
        (runs.corrected, QUIET, "corrected"),
        (runs.continuous, PROJECTED, "projected"),
    ):
        # Inside the step the raw extension leads to y*; at its end stands y1, the projected value.
        inside = theta[:-1] if sol is runs.raw else theta
        g = ORBITS.fun(0.0, _dense(sol, t0 + inside * (t1 - t0)))
        axes.plot(inside, 1e3 * np.abs(g - held), color=colour, label=label)
    at = np.linspace(0, 1, REFINE + 1)
    axes.plot(
        at,
        1e3 * np.abs(runs.raw.residual[0, -REFINE - 1 :]),
        "o",
        color=PLAIN,
        ms=4,
        clip_on=False,
        label="as in Fig. 2",
    )
    axes.set(xlabel=r"position in the last step, $\theta$", ylabel="residual × 10³", xlim=(0, 1), ylim=(-0.2, 7.5))
    _above(axes, 4)


def _bob(axes: Axes, results: Results) -> None:
    runs = results.pendulum
    angle = np.linspace(0, 2 * np.pi, 361)
    axes.plot(np.cos(angle), np.sin(angle), "--", color=QUIET, lw=0.8, label="unit circle")
    axes.plot(*_dense(runs.plain, np.linspace(0, 50, 2500))[:2], color=PLAIN, lw=0.9, label="plain")
    axes.plot(*runs.projected.y[:2], color=PROJECTED, lw=1.8, label="projected")
    axes.set(xlabel="$x$", ylabel="$y$", aspect="equal")
    _above(axes, 3)


def _rod_length(axes: Axes, results: Results) -> None:
    runs = results.pendulum
    for sol, colour, label in (
        (runs.plain, PLAIN, "plain"),
        (runs.raw, QUIET, "imposed, raw"),
        (runs.projected, PROJECTED, "imposed, projected"),
    ):
        error = residual(PENDULUM, sol)[0, 1:].reshape(-1, REFINE).max(axis=1)
        axes.semilogy(sol.t[REFINE::REFINE], np.maximum(error, EPS / 2), color=colour, label=label)
    axes.set(xlabel="$t$", ylabel="$|x^2 + y^2 - 1|$", xlim=(0, 50), ylim=(1e-17, 1e1))
    axes.set_yticks([1e-16, 1e-12, 1e-8, 1e-4, 1])
    axes.minorticks_off()
    _above(axes, 3)


def _orbit(name: str, label: str, colour: str) -> Callable[[Axes, Results], None]:
    def draw(axes: Axes, results: Results) -> None:
        sol: Solution = getattr(results.three_body, name)
        sol.plot_phase("x", "y", ax=axes, color=colour, label=label)
        axes.plot([-MU, MU_STAR], [0, 0], ".", color=INK, ms=5)
        _name(axes, "Earth", (-MU, 0), (0, -26))
        _name(axes, "Moon", (MU_STAR, 0), (-4, 9))
        axes.set(xlabel="$x$", ylabel="$y$", xlim=(-1.5, 1.5), ylim=(-1.05, 1.05), aspect="equal")
        axes.set_yticks([-0.5, 0, 0.5])
        _above(axes, 3)

    return draw


def _name(axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float]) -> None:
    style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8.5, "color": INK}
    axes.annotate(text, at, xytext=offset, textcoords="offset points", **style)


FIGURES = (
    Plot(
        "phase",
        _phase_plane,
        "Predator and prey in the phase plane",
        "ode23 at default tolerances, 0 ≤ t ≤ 50. The exact orbit is closed. The plain run drifts outward from it; "
        "the projected one stays on it. Both are qualitatively right, as the paper says.",
    ),
    Plot(
        "residual",
        _orbit_residual,
        "Residual in the invariant",
        "At the ends of the steps, and, imposed a posteriori, at four points per step. One unit in the last place of "
        "the invariant, 121.8, is 1.4e-14; zeros are drawn at half of it.",
    ),
    Plot(
        "step",
        _last_step,
        "Residual inside the last step (Fig. 2)",
        "The dots are the paper’s five points. ‘Raw’ is the method’s own interpolant, ‘corrected’ meets the projected "
        "values at both ends of the step, ‘projected’, the default, keeps the invariant between them too.",
    ),
    Plot(
        "bob",
        _bob,
        "Path of the pendulum’s bob",
        "ode45 at default tolerances, 0 ≤ t ≤ 50. Without its two invariants the rod grows; with them the bob stays on "
        "the circle.",
    ),
    Plot(
        "length",
        _rod_length,
        "Error in the length of the rod",
        "The largest among the four points of each step. With both invariants imposed and raw output, what is left is "
        "the error of interpolation, as the paper explains; with the output projected too, it is roundoff (zeros are "
        "drawn at half a unit of it).",
    ),
    Plot(
        "plain",
        _orbit("adams", "plain", PLAIN),
        "Three-body orbit, plain (Fig. 1)",
        "ode113 at default tolerances, one period: start and end, the same point of the exact orbit, lie far apart.",
        height=3.0,
    ),
    Plot(
        "projected",
        _orbit("adams_projected", "projected", PROJECTED),
        "Three-body orbit, projected (Fig. 1)",
        "The same with the Jacobi integral imposed, for fewer evaluations of f: to the eye, the orbit is closed.",
        height=3.0,
    ),
)
