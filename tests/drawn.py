"""Solutions that tests of pictures draw, and what a picture shows."""

from __future__ import annotations

from matplotlib.figure import Figure

import invariode as iv

DRAWINGS = {
    "plot": lambda sol, ax=None: sol.plot(ax=ax),
    "phase": lambda sol, ax=None: sol.plot_phase(0, 1, ax=ax),
    "drift": lambda sol, ax=None: sol.plot_drift(ax=ax),
    "steps": lambda sol, ax=None: sol.plot_steps(axes=ax),
}


def axes():
    """Axes that pyplot does not know."""
    return Figure(layout="constrained").add_subplot()


def circle(t, y):
    return [-y[1], y[0]]


def radius(t, y):
    return y[0] ** 2 + y[1] ** 2


def turning(t_span=(0, 20), **described):
    return iv.Problem(circle, t_span, [1, 0], **{"invariants": radius, "labels": ["east", "north"], **described})


def ball(**options):
    """Free fall from height 1; the floor gives back half of the speed."""
    hit = iv.Event(lambda t, y: y[0], direction=-1, action=lambda t, y: [0, -y[1] / 2])
    hit.__name__ = "impact"
    return iv.solve_ivp(lambda t, y: [y[1], -1.0], (0, 3), [1, 0], events=hit, **options)


def shown(ax):
    """The curves that the legend or the axis names."""
    return [line for line in ax.lines if line.get_linestyle() != "None" and len(line.get_xdata())]


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]
