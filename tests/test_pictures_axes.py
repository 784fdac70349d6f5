"""Axes of pictures have names and numbers that can be read."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from matplotlib.figure import Figure

import invariode as iv
from cases import dealt
from drawn import DRAWINGS, axes, circle, legend, shown, turning
from invariode._results.pictures.canvas import log_axis


def test_names_are_those_of_the_problem():
    sol = turning().solve()
    assert legend(sol.plot(ax=axes())) == ["east", "north"]
    assert sol.plot("north", ax=axes()).get_ylabel() == "north"
    ax = sol.plot_phase("north", "east", ax=axes())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("north", "east")
    assert sol.plot_drift(ax=axes()).get_ylabel() == "residual of radius"
    assert sol.impose().plot(ax=axes(), components="north").get_ylabel() == "north"
    assert legend(iv.solve_ivp(circle, (0, 1), [1, 0]).plot(ax=axes())) == ["y0", "y1"]
    assert iv.solve_ivp(circle, (0, 1), [1, 0]).plot().get_title() == ""  # no name was given
    ax = sol.plot(ax=axes(), label="first")
    assert legend(sol.plot(ax=ax, components=[0], label="second")) == ["east, first", "north, first", "east, second"]


def test_more_than_a_dozen_components_have_a_sequence_of_colours():
    sol = iv.solve_ivp(lambda t, y: -y, (0, 1), np.ones(30))
    ax = sol.plot(ax=axes())
    assert len({line.get_color() for line in shown(ax)}) == 30
    assert ax.get_legend().get_title().get_text() == "30 components"
    assert legend(ax)[0] == "y0"
    assert legend(ax)[-1] == "y29"
    assert len(legend(ax)) == 10
    assert legend(sol.plot(ax=axes(), components=[3, "y20", -1])) == ["y3", "y20", "y29"]


def test_components_of_other_scales_have_panels_of_their_own():
    sol = iv.Problem(lambda t, y: [y[1], -y[0], 0], (0, 9), [1, 0, 1e-5], labels=["a", "b", "c"]).solve()
    ax = sol.plot()
    assert [legend(ax), ax.figure.axes[1].get_ylabel()] == [["a", "b"], "c"]
    assert [bool(panel.get_xlabel()) for panel in ax.figure.axes] == [False, True]
    assert legend(sol.plot(ax=axes())) == ["a", "b", "c"]  # given axes are one
    sizes = [1e9, 1e5, 1, 1e-5, 1e-10, 0]
    five = iv.solve_ivp(lambda t, y: 0 * y, (0, 1), sizes).plot()
    assert len(five.figure.axes) == 4


@pytest.mark.parametrize("end", [1e-7, 1.0, 123456.0, 1e9])
def test_numbers_at_the_axes_do_not_run_together(end):
    sol = iv.solve_ivp(lambda t, y: [1.0, -1.0], (0, end), [0.0, 0.0])
    for ax in (sol.plot(), sol.plot_phase(0, 1)):
        ax.figure.canvas.draw()
        low, high = ax.get_xlim()
        inside = [text for text in ax.get_xticklabels() if low <= text.get_position()[0] <= high]
        boxes = [text.get_window_extent() for text in inside if text.get_text()]
        assert len(boxes) > 2
        assert all(a.x1 < b.x0 for a, b in pairwise(boxes))


@dealt(span=[1.0, 1.2, 3, 30, 300, 1e15], formulas=[True, False])
def test_numbers_at_a_logarithmic_axis_are_at_least_two_and_do_not_run_together(span, formulas):
    ax = Figure(figsize=(3.5, 2)).add_subplot()
    ax.loglog([7e-4, 7e-4 * span], [1, 2])
    log_axis(ax.xaxis, formulas)
    ax.figure.canvas.draw()
    low, high = ax.get_xlim()
    assert high >= 10 * low * (1 - 1e-9)
    labels = [*ax.get_xticklabels(), *ax.get_xticklabels(minor=True)]
    boxes = [text.get_window_extent() for text in labels if text.get_text() and low <= text.get_position()[0] <= high]
    assert len(boxes) >= 2
    assert all(a.x1 < b.x0 for a, b in pairwise(sorted(boxes, key=lambda box: box.x0)))
    ax.plot([7e-9, 7e9], [1, 2])
    assert ax.get_xlim()[0] < 7e-9  # later curves are seen too


def test_powers_of_ten_as_text_look_like_formulas():
    """10⁻³ at the axes, and 2·10⁻³ between, where few powers leave room: not 1e-03."""
    for high, numbers in ((1e3, {"10⁻³", "10⁰", "10³"}), (3e-3, {"10⁻³", "2·10⁻³"})):
        ax = Figure(figsize=(4, 2)).add_subplot()
        ax.loglog([1e-3, high], [1, 2])
        log_axis(ax.xaxis, formulas=False)
        ax.figure.canvas.draw()
        labels = [*ax.get_xticklabels(), *ax.get_xticklabels(minor=True)]
        assert numbers <= {text.get_text() for text in labels}


def test_a_stiff_run_has_a_logarithmic_axis_of_time():
    """Chosen by itself if its outputs would stand at one place, in a new figure, and not if the user says otherwise."""
    stiff = iv.problems.robertson().solve("ode15s")
    assert stiff.plot().get_xscale() == "log"
    assert stiff.plot(log="").get_xscale() == "linear"
    assert stiff.plot(ax=axes()).get_xscale() == "linear"
    assert stiff.plot(ax=axes(), log="x").get_xscale() == "log"
    orbit = turning().solve("ode113", rtol=1e-12)  # whose first steps are tiny
    assert orbit.plot().get_xscale() == "linear"
    with pytest.raises(ValueError, match="log must be"):
        stiff.plot(log="y")


def test_numbers_of_phase_pictures_are_round():
    """Multiples of 1, 2, 2.5 or 5."""
    for size in (1.0, 1.7, 3.1, 7.9):
        ax = iv.solve_ivp(circle, (0, 7), [size, 0]).plot_phase(0, 1)
        ax.figure.canvas.draw()
        step = np.diff(ax.get_xticks())[0]
        assert round(step / 10 ** np.floor(np.log10(step) + 1e-9), 9) in (1, 2, 2.5, 5)


def test_limits_that_the_caller_has_set_stay():
    ax = axes()
    ax.set_ylim(1e-3, 2e-3)
    turning().solve().plot_drift(ax=ax)
    assert ax.get_ylim() == (1e-3, 2e-3)


def test_labels_must_differ():
    with pytest.raises(ValueError, match="differ"):
        iv.Problem(lambda t, y: [y[1], -y[0]], (0, 1), [1, 0], labels=["a", "a"])


@pytest.mark.parametrize("over_t", ["plot", "drift", "steps"])
def test_a_logarithmic_axis_of_time_shows_all_but_time_zero(over_t):
    sol = turning().solve(dense_output=True)
    before, after = axes(), axes()
    before.set_xscale("log")
    DRAWINGS[over_t](sol, before)
    DRAWINGS[over_t](sol, after)
    after.set_xscale("log")
    for ax in (before, after):
        ax.figure.canvas.draw()
        low, high = ax.get_xlim()
        assert 0 < low <= sol.t[1]
        assert high >= sol.t[-1]


@pytest.mark.parametrize("name", [r"$\foo$", "$$", "$x^$", r"\$ and $\frac{1$"])
def test_names_that_are_no_formulas_are_drawn_as_they_are(name):
    """A name with dollar signs is the user's business: only what matplotlib reads as a formula is one."""

    def event(t, y):
        return y[0]

    event.__name__ = name
    energy = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2, names=name)
    problem = iv.Problem(
        lambda t, y: [y[1], -y[0]], (0, 5), [1.0, 0.0], invariants=energy, events=event, name=name, labels=[name, "v"]
    )
    sol = problem.solve()
    for ax in (sol.plot(), sol.plot_phase(name, "v"), sol.plot_drift()):
        ax.figure.draw_without_rendering()
        assert ax.get_title() in (name, name.replace("$", r"\$"))
    assert sol.plot(components=name).get_ylabel() == ax.get_title()


def test_formulas_stay_formulas():
    sol = iv.Problem(lambda t, y: [y[1], -y[0]], (0, 5), [1.0, 0.0], labels=[r"$\theta$", "v"]).solve()
    assert sol.plot(components=0).get_ylabel() == r"$\theta$"


class TestKindsOfComponents:
    def test_units_positions_and_velocities_have_panels_of_their_own(self):
        """Components of two kinds never share an axis, of whatever origin the kinds are; on given axes all do."""
        units = iv.Problem(lambda t, y: 0 * y, (0, 1), [1, 2, 3], labels=["a [m]", "b (K)", "c [m]"]).solve()
        panels = units.plot().figure.axes
        assert [ax.get_ylabel() for ax in panels] == ["m", "b (K)"]
        assert legend(panels[0]) == ["a [m]", "c [m]"]
        indices = iv.Problem(lambda t, y: 0 * y, (0, 1), [1, 2], labels=["x[0]", "x[1]"]).solve()
        assert len(indices.plot().figure.axes) == 1  # an index is no unit
        pendulum = iv.MechanicalSystem(
            np.eye(2), lambda t, q, v: np.array([0, -1.0]), constraints=lambda t, q: q @ q - 1
        ).problem((0, 1), [1.0, 0.0], [0.0, 0.0])
        start = [1.0, 2.0, 0.0, 0.0]
        second = iv.Problem(lambda t, y: [y[2], y[3], -y[0], -y[1]], (0, 1), start, second_order=True)
        dashed = second.replace(second_order=False, labels=["x", "z", "x'", "z'"])
        for problem in (pendulum, second, dashed):
            sol = problem.solve("ode45")
            panels = sol.plot().figure.axes
            assert [ax.get_ylabel() for ax in panels] == ["positions", "velocities"]
            colours = [[line.get_color() for line in shown(ax)] for ax in panels]
            assert colours[0] == colours[1]  # a velocity has the colour of its position
            assert len(set(colours[0])) == 2
            assert len(sol.plot([0, 1]).figure.axes) == 1
            ax = axes()
            assert sol.plot(ax=ax) is ax
            assert len(ax.lines) == 4
