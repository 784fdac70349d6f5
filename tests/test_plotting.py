"""Pictures show what the solution is, on the axes that they are given, and do nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import invariode as iv
from cases import dealt, explicit_and_implicit
from invariode._results.pictures.canvas import log_axis
from invariode._studies import work_precision
from invariode._studies.precision import ComparedMethod, Run
from problems import PROBLEMS

DRAWINGS = {
    "plot": lambda sol, ax=None: sol.plot(ax=ax),
    "phase": lambda sol, ax=None: sol.plot_phase(0, 1, ax=ax),
    "drift": lambda sol, ax=None: sol.plot_drift(ax=ax),
    "steps": lambda sol, ax=None: sol.plot_steps(axes=ax),
}


@pytest.fixture(autouse=True)
def _figures_are_closed():
    yield
    plt.close("all")


@pytest.fixture(params=list(DRAWINGS))
def draw(request):
    return DRAWINGS[request.param]


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


def test_axes_returned_are_those_given(draw):
    ax = axes()
    assert np.ravel(draw(turning().solve(), ax)) == [ax]


def test_given_axes_need_no_figure_of_pyplot_and_none_are_shown_or_saved(draw, monkeypatch):
    for name in ("show", "savefig"):
        monkeypatch.setattr(plt, name, lambda *args, **kwargs: pytest.fail("shown or saved"))
    monkeypatch.setattr(Figure, "savefig", lambda *args, **kwargs: pytest.fail("saved"))
    sol = turning().solve()
    draw(sol, axes())
    assert not plt.get_fignums()
    draw(sol)
    assert len(plt.get_fignums()) == 1


def test_settings_of_matplotlib_stay_as_they_are(draw):
    before = dict(mpl.rcParams)
    draw(turning().solve())
    assert dict(mpl.rcParams) == before


@dealt(6, draw=DRAWINGS, t_span=[(0, 20), (0, -20), (1, 1)], dense=[False, True])
def test_pictures_can_be_drawn_without_warnings_and_keep_their_legends_inside_the_figure(draw, t_span, dense):
    sol = turning(t_span, name="Circle").solve(dense_output=dense)
    ax = np.ravel(draw(sol))[0]
    figure = ax.figure
    figure.canvas.draw()
    if ax.get_legend():
        box = ax.get_legend().get_window_extent()
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width
        assert not box.overlaps(ax.bbox)  # and cover no data
    assert ax.get_title() == "Circle"


#: What each drawing shows, one (x, y) for each of its curves.
SHOWN = {
    "plot": lambda sol: [(sol.t, y) for y in sol.y],
    "phase": lambda sol: [(sol.y[0], sol.y[1])],
    "drift": lambda sol: [(sol.t, np.abs(r)) for r in sol.residual],
    "steps": lambda sol: [(sol.t, np.abs(sol.steps.h[[0, *range(sol.stats.steps)]]))],
}


def below(sol):
    """Residuals so small, a unit of roundoff of what is compared, are drawn higher: zeros have no logarithm."""
    drift = sol.drift()
    return np.finfo(float).eps * max(1, np.abs(drift.value).max(), drift.residual_before.max())


@dealt(problem=PROBLEMS, drawing=DRAWINGS)
def test_every_picture_of_every_problem_has_its_curves(problem, drawing, method):
    sol = problem.solve(method)
    ax = axes()
    DRAWINGS[drawing](sol, ax)
    curves = [line for line in ax.lines if len(line.get_xdata()) > 2]  # the others mark ends and bounds
    for line, (x, y) in zip(curves, SHOWN[drawing](sol), strict=True):
        if drawing in ("plot", "phase"):  # smooth between the outputs
            assert set(zip(x, y, strict=True)) <= set(zip(*line.get_data(), strict=True))
            continue
        np.testing.assert_array_equal(line.get_xdata(), x)
        visible = y > below(sol) if drawing == "drift" else slice(None)
        np.testing.assert_array_equal(line.get_ydata()[visible], y[visible])


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


def test_lines_are_the_points_of_the_output_marked_where_they_are_few():
    few, many = turning().solve(t_eval=np.linspace(0, 20, 9)), turning().solve(t_eval=np.linspace(0, 20, 99))
    for sol, marker in ((few, "."), (many, "none")):
        for line, values in zip(shown(sol.plot(ax=axes())), sol.y, strict=True):
            np.testing.assert_array_equal(line.get_xdata(), sol.t)
            np.testing.assert_array_equal(line.get_ydata(), values)
            assert str(line.get_marker()).lower() == marker
    (line,) = shown(few.plot_phase(0, 1, ax=axes()))
    np.testing.assert_array_equal(line.get_xydata().T, few.y)


def test_lines_are_the_dense_output_where_there_is_one():
    sol = turning().solve(dense_output=True, t_eval=[0, 20])
    curves = shown(sol.plot(ax=axes()))
    assert len(curves) == len(sol.y)
    for k, line in enumerate(curves):
        t, y = line.get_data()
        assert len(t) > 30 * sol.stats.steps
        assert set(sol.sol.ts) <= set(t)
        np.testing.assert_array_equal(y, sol.sol(t)[k])


@pytest.mark.parametrize("options", [{}, {"refine": 3}, {"dense_output": True}, {"t_eval": np.linspace(0, 3, 100)}])
def test_jumps_interrupt_the_line(options):
    sol = ball(**options)
    _, speed = shown(sol.plot(ax=axes()))
    t, v = speed.get_data()
    gaps = np.flatnonzero(np.isnan(v))
    assert len(gaps) == len(sol.t_events[0]) == 2
    assert (v[gaps - 1] < 0).all()
    assert (v[gaps + 1] > 0).all()
    rises = np.diff(v)
    assert (rises[~np.isnan(rises)] <= 0).all()  # in flight the speed only falls: no line goes up
    if "t_eval" not in options:
        np.testing.assert_allclose(t[gaps - 1], sol.t_events[0], rtol=1e-15)
        np.testing.assert_array_equal(t[gaps + 1], sol.t_events[0])
        np.testing.assert_allclose(v[gaps + 1], -v[gaps - 1] / 2, rtol=1e-12)


def test_events_are_marked_where_they_were_found():
    sol = ball()
    over_t, phase = sol.plot(ax=axes(), components=[1]), sol.plot_phase(0, 1, ax=axes())
    for ax, x in ((over_t, sol.t_events[0]), (phase, sol.y_events[0][:, 0])):
        (mark,) = [line for line in ax.lines if line.get_label() == "impact"]
        np.testing.assert_array_equal(mark.get_xdata(), x)
        np.testing.assert_array_equal(mark.get_ydata(), sol.y_events[0][:, 1])
        assert "impact" in legend(ax)


def test_complex_components_are_real_parts_solid_and_imaginary_parts_dashed():
    sol = iv.solve_ivp(lambda t, y: 1j * y, (0, 5), [1 + 0j])
    ax = sol.plot(ax=axes())
    assert legend(ax) == ["Re y0", "Im y0"]
    real, imaginary = shown(ax)
    assert (real.get_linestyle(), imaginary.get_linestyle()) == ("-", "--")
    assert real.get_color() == imaginary.get_color()
    np.testing.assert_allclose(real.get_ydata(), np.cos(real.get_xdata()), atol=2e-3)
    np.testing.assert_allclose(imaginary.get_ydata(), np.sin(imaginary.get_xdata()), atol=2e-3)
    ax = sol.plot_phase("y0", ax=axes())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Re y0", "Im y0")
    assert set(sol.y[0].imag) <= set(shown(ax)[0].get_ydata())
    with pytest.raises(ValueError, match=r"the solution is complex: plot_phase\(0\) draws one component"):
        sol.plot_phase(0, 0)


def test_more_than_a_dozen_components_have_a_sequence_of_colours():
    sol = iv.solve_ivp(lambda t, y: -y, (0, 1), np.ones(30))
    ax = sol.plot(ax=axes())
    assert len({line.get_color() for line in shown(ax)}) == 30
    assert ax.get_legend().get_title().get_text() == "30 components"
    assert legend(ax)[0] == "y0"
    assert legend(ax)[-1] == "y29"
    assert len(legend(ax)) == 10
    assert legend(sol.plot(ax=axes(), components=[3, "y20", -1])) == ["y3", "y20", "y29"]


class TestCurvesBetweenSteps:
    """Curves show the solution, not the chords of its steps."""

    @explicit_and_implicit
    def test_they_stay_on_the_circle_where_chords_leave_it(self, method):
        sol = turning(invariants=None).solve(method, rtol=1e-5, atol=1e-8)
        x, y = shown(sol.plot_phase(0, 1, ax=axes()))[0].get_data()
        chords = np.hypot(*(sol.y[:, 1:] + sol.y[:, :-1]) / 2)
        assert len(x) > 3.9 * len(sol.t)
        off, of_chords = np.abs(np.hypot(x, y) - 1).max(), np.abs(chords - 1).max()
        monotone = "jac" in iv.METHODS[method].options  # which are not as good, and never overshoot
        assert off < (max(3e-3, of_chords) if monotone else max(1e-3, of_chords / 10))

    def test_slopes_of_native_functions_too(self):
        pytest.importorskip("numba")
        sol = iv.solve_ivp(iv.compile(lambda t, y, p: (-p[0] * y[1], p[0] * y[0])), (0, 9), [1, 0], args=(1.5,))
        t, x = shown(sol.plot(ax=axes()))[0].get_data()
        assert len(t) > 4 * len(sol.t)
        np.testing.assert_allclose(x, np.cos(1.5 * t), atol=0.02)

    def test_output_at_times_is_joined_by_lines(self):
        sol = turning().solve(t_eval=np.linspace(0, 20, 9))
        np.testing.assert_array_equal(shown(sol.plot(ax=axes()))[0].get_xdata(), sol.t)

    def test_so_is_what_has_no_functions_or_other_units(self, tmp_path):
        sol = turning().solve()
        sol.save(tmp_path / "run.npz")
        scaled = turning().solve()
        scaled["y"] = scaled.y * 1000
        for other in (iv.load(tmp_path / "run.npz"), scaled):
            np.testing.assert_array_equal(shown(other.plot(ax=axes()))[0].get_xdata(), sol.t)

    def test_outputs_are_marked_on_request(self):
        sol = turning().solve()
        for ax in (sol.plot(ax=axes(), components=0, marker="o"), sol.plot_phase(0, 1, ax=axes(), marker="o")):
            (marks,) = [line for line in ax.lines if line.get_marker() == "o" and len(line.get_xdata()) > 1]
            assert len(marks.get_xdata()) == len(sol.t)
            assert marks.get_linestyle() == "None"


def test_components_of_other_scales_have_panels_of_their_own():
    sol = iv.Problem(lambda t, y: [y[1], -y[0], 0], (0, 9), [1, 0, 1e-5], labels=["a", "b", "c"]).solve()
    ax = sol.plot()
    assert [legend(ax), ax.figure.axes[1].get_ylabel()] == [["a", "b"], "c"]
    assert [bool(panel.get_xlabel()) for panel in ax.figure.axes] == [False, True]
    assert legend(sol.plot(ax=axes())) == ["a", "b", "c"]  # given axes are one
    sizes = [1e9, 1e5, 1, 1e-5, 1e-10, 0]
    five = iv.solve_ivp(lambda t, y: 0 * y, (0, 1), sizes).plot()
    assert len(five.figure.axes) == 4


def test_stiff_components_do_not_overshoot():
    rates = [[-0.04, 1e4, 3e7]]

    def robertson(t, y):
        a, b, c = rates[0]
        slow, fast = a * y[0] + b * y[1] * y[2], c * y[1] ** 2
        return [slow, -slow - fast, fast]

    sol = iv.solve_ivp(robertson, (0, 1e6), [1.0, 0, 0], "ode15s", rtol=1e-5, atol=1e-9)
    trace = shown(sol.plot(ax=axes()))[1].get_ydata()
    assert trace.min() >= sol.y[1].min()
    assert trace.max() <= sol.y[1].max()
    assert len(trace) > 4 * len(sol.t)


def test_long_runs_are_ranges_between_their_extremes():
    t = np.linspace(0, 1000, 200_001)
    sol = iv.solve_ivp(lambda t, y: [10.0 * np.cos(10 * t)], (0, 1000), [0.0], t_eval=t, rtol=1e-6)
    ax = sol.plot(ax=axes())
    (area,) = ax.collections
    assert max(len(line.get_xdata()) for line in ax.lines) <= 2000
    low, high = area.get_paths()[0].vertices[:, 1].min(), area.get_paths()[0].vertices[:, 1].max()
    assert (low, high) == (sol.y.min(), sol.y.max())
    slow = iv.solve_ivp(lambda t, y: [np.cos(t / 100)], (0, 1000), [0.0], t_eval=t, rtol=1e-6).plot(ax=axes())
    assert not slow.collections
    assert len(shown(slow)[0].get_xdata()) <= 4000


def test_phase_plots_in_space():
    sol = iv.Problem(lambda t, y: [y[1], -y[0], 1], (0, 9), [1, 0, 0], labels=["a", "b", "c"]).solve()
    ax = sol.plot_phase("a", "b", "c")
    assert (ax.name, ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == ("3d", "a", "b", "c")
    x, y, z = ax.lines[0].get_data_3d()
    np.testing.assert_allclose(np.hypot(x, y), 1, atol=0.02)
    np.testing.assert_allclose(x, np.cos(z), atol=0.02)
    assert legend(ax) == ["start", "end"]
    with pytest.raises(ValueError, match='3 components are drawn on axes with projection="3d": give these, or none'):
        sol.plot_phase(0, 1, 2, ax=axes())
    with pytest.raises(ValueError, match="2 components are drawn on axes of the plane"):
        sol.plot_phase(0, 1, ax=Figure().add_subplot(projection="3d"))


def test_a_field_of_directions_is_that_of_f(tmp_path):
    sol = turning().solve()
    ax = sol.plot_phase(0, 1, field=True)
    ax.figure.canvas.draw()
    (arrows,) = ax.collections
    x, y = arrows.XY.T
    np.testing.assert_allclose(arrows.U * x + arrows.V * y, 0, atol=0.25)  # tangents of circles, but for the aspect
    assert (arrows.V[x > 0.5] > 0).all()
    with pytest.raises(ValueError, match="field=True needs a problem of two real components, but this one has 3"):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1, 2, 3]).plot_phase(0, 1, field=True)
    sol.save(tmp_path / "run.npz")
    with pytest.raises(ValueError, match="field=True needs the function of the problem"):
        iv.load(tmp_path / "run.npz").plot_phase(0, 1, field=True)


def test_drift_in_units_of_the_value():
    big = iv.Invariants(lambda t, y: 1e6 * (y[0] ** 2 + y[1] ** 2), names="E")
    sol = turning(invariants=big).solve("ode23")
    absolute, relative = sol.plot_drift(ax=axes()), sol.plot_drift(ax=axes(), relative=True)
    np.testing.assert_allclose(relative.lines[0].get_ydata(), absolute.lines[0].get_ydata() / 1e6, rtol=1e-12)
    np.testing.assert_allclose(relative.lines[1].get_ydata(), absolute.lines[1].get_ydata() / 1e6, rtol=1e-12)
    assert relative.get_ylabel() == "relative residual of E"
    held = turning(invariants=iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2 - 1, value=0, names="zero")).solve()
    with pytest.raises(ValueError, match="zero is held at 0, which has no relative drift: leave out relative=True"):
        held.plot_drift(relative=True)


def test_a_run_that_kept_its_end_only_says_what_a_picture_needs():
    sol = turning().solve(keep="end")
    for draw in (sol.plot, lambda: sol.plot_phase(0, 1)):
        with pytest.raises(ValueError, match=r'kept only its final state: for a picture solve with keep="all"'):
            draw()
    assert not plt.get_fignums()


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


@pytest.mark.parametrize("wrong", ["west", 2, -3, 0.5, None])
def test_components_that_do_not_exist_are_refused_with_those_that_do(wrong):
    sol = turning().solve()
    with pytest.raises(ValueError, match=r"there is no component .*: choose from east, north, or by index"):
        sol.plot(components=[wrong])
    with pytest.raises(ValueError, match="there is no component"):
        sol.plot_phase(wrong, 0)
    with pytest.raises(ValueError, match="plot_phase needs two components of east, north"):
        sol.plot_phase(0)
    assert not plt.get_fignums()  # what is refused leaves no empty figure


def test_orbits_are_not_distorted_and_their_ends_are_marked():
    sol = turning().solve()
    ax = sol.plot_phase(0, 1, ax=axes())
    assert ax.get_aspect() == 1
    start, end = ax.lines[1:]
    np.testing.assert_array_equal(start.get_xydata(), [sol.y[:, 0]])
    np.testing.assert_array_equal(end.get_xydata(), [sol.y[:, -1]])
    assert legend(sol.plot_phase(0, 1, ax=ax, label="again")) == ["again", "start", "end"]
    stretched = iv.solve_ivp(lambda t, y: [-y[1] / 100, 100 * y[0]], (0, 7), [1, 0])
    assert stretched.plot_phase(0, 1, ax=axes()).get_aspect() == "auto"


def test_drift_is_the_residual_and_the_largest_before_projection():
    sol = turning().solve("ode23")
    after, before, _ = sol.plot_drift(ax=axes()).lines
    r = np.abs(sol.residual[0])
    np.testing.assert_array_equal(after.get_ydata()[r > 0], r[r > 0])
    assert np.isnan(after.get_ydata()[0])  # zero by definition
    assert set(before.get_ydata()) == {sol.drift().residual_before[0]}
    assert before.get_linestyle() == ":"
    imposed = sol.impose()
    drawn = imposed.plot_drift(ax=axes()).lines[0].get_ydata()[1:]
    assert (imposed.residual == 0).any()
    assert np.nanmin(drawn) >= np.finfo(float).eps / 2  # of the value 1


def chain_of(links):
    """Masses on rods of length 1: constraints are level 0, their rates level 1, the energy is level 2."""

    def rods(t, q):
        return (np.diff(np.vstack([[0, 0], q.reshape(-1, 2)]), axis=0) ** 2).sum(axis=1) - 1

    def energy(t, q, v):
        return v @ v / 2 + q[1::2].sum()

    masses = iv.MechanicalSystem(np.ones(2 * links), lambda t, q, v: np.tile([0, -1], links), rods, energy=energy)
    straight = np.array([(i + 1, 0) for i in range(links)]).ravel()
    return masses.problem((0, 0.5), straight, np.zeros(2 * links)).solve()


def test_drift_tells_levels_apart():
    ax = chain_of(2).plot_drift(ax=axes())
    curves = {line.get_label(): line for line in ax.lines if line.get_linestyle() != ":"}
    assert [(name, line.get_linestyle()) for name, line in curves.items()] == [
        ("constraint 1", "-"),
        ("constraint 2", "-"),
        ("rate of constraint 1", "--"),
        ("rate of constraint 2", "--"),
        ("energy", "-."),
    ]
    colours = [line.get_color() for line in curves.values()]
    assert colours[:2] == colours[2:4]  # a constraint and its rate
    assert colours[0] != colours[1]


def test_drift_of_many_is_the_largest_of_each_level():
    sol = chain_of(7)
    ax = sol.plot_drift(ax=axes())
    curves = [line for line in ax.lines if line.get_linestyle() != ":"]
    assert [line.get_label() for line in curves] == ["level 0: largest of 7", "level 1: largest of 7", "energy"]
    largest, drawn = np.abs(sol.residual[7:14]).max(axis=0), curves[1].get_ydata()
    visible = largest > np.nanmin(drawn)
    np.testing.assert_array_equal(drawn[visible], largest[visible])
    assert ax.get_legend().get_title().get_text() == ""


def test_drift_of_a_run_without_invariants_needs_to_be_told_which():
    sol = turning(invariants=None).solve("ode23")
    with pytest.raises(ValueError, match=r"the run had no invariants.*plot_drift\(invariants=g\)"):
        sol.plot_drift()
    (line,) = sol.plot_drift(ax=axes(), invariants=radius).lines
    np.testing.assert_allclose(line.get_ydata()[1:], np.abs(radius(0, sol.y) - 1)[1:], rtol=1e-12)
    (line,) = sol.plot_drift(ax=axes(), invariants=iv.Invariants(radius, value=2)).lines
    np.testing.assert_allclose(line.get_ydata(), np.abs(radius(0, sol.y) - 2), rtol=1e-12)


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


def test_roundoff_is_shaded_where_the_axis_shows_it():
    """Below ε |value|; without projection residuals are larger, and nothing is shaded."""
    sol = turning().solve("dop853", rtol=1e-6)
    ax = sol.plot_drift()
    (shade,) = ax.patches
    assert shade.get_y() + shade.get_height() == pytest.approx(np.finfo(float).eps)
    assert ax.get_ylim()[0] == shade.get_y()
    assert "roundoff" in ax.get_legend_handles_labels()[1]
    plain = turning(invariants=None).solve(t_eval=[10, 20])
    assert not plain.plot_drift(invariants=radius).patches


def test_bands_are_named():
    """Once, whatever the number of components."""
    many = iv.solve_ensemble(circle, (0, 1), [[1.0, 0.0], [2.0, 0.0]], t_eval=[0, 0.5, 1], workers=1)
    labels = many.plot().get_legend_handles_labels()[1]
    assert labels[-2:] == ["90 % of the trajectories", "50 % of the trajectories"]
    assert "trajectories" not in str(many.plot("quantiles").get_legend_handles_labels()[1])


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


def test_corrections_too_small_to_be_seen_are_not_named():
    """A linear invariant is kept to roundoff by any method: its corrections are below the axis."""
    sol = iv.solve_ivp(lambda t, y: [-y[0], y[0]], (0, 5), [0.7, 0.1], invariants=lambda t, y: y[0] + y[1], rtol=1e-3)
    assert 0 < sol.steps.correction.max() < 1e-6
    assert sol.plot_steps()[2].get_legend() is None


def test_equal_steps_are_shown_as_equal():
    sol = iv.solve_ivp(lambda t, y: [-y[0]], (0, 1), [1.0], atol=1e-3, first_step=0.1, max_step=0.1)
    low, high = sol.plot_steps()[0].get_ylim()
    assert low < 0.6 * np.abs(sol.steps.h).min()
    assert high > 1.5 * np.abs(sol.steps.h).max()


def test_a_second_run_on_the_same_axes_has_colours_of_its_own():
    plain = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0])
    held = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0], invariants=lambda t, y: y @ y)
    panels = held.plot_steps(label="held")
    plain.plot_steps(axes=panels, label="plain")
    colours = [line.get_color() for line in panels[2].lines if line.get_marker() == "."]
    assert len(colours) == len(set(colours)) == 3
    assert panels[2].get_ylabel() == "in units of rtol"
    assert [bool(panel.get_xlabel()) for panel in panels] == [False, False, True]


def test_the_ends_of_a_phase_curve_are_those_of_the_run():
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -y[0]], (0, 3), [1.0, 0], "ode78", t_eval=[1, 1.5], dense_output=True, rtol=1e-8
    )
    marks = {line.get_label(): line.get_xydata()[0] for line in sol.plot_phase(0, 1).lines}
    np.testing.assert_allclose(marks["start"], [1, 0])
    np.testing.assert_allclose(marks["end"], [np.cos(3), -np.sin(3)], atol=1e-5)


def test_labels_must_differ():
    with pytest.raises(ValueError, match="differ"):
        iv.Problem(lambda t, y: [y[1], -y[0]], (0, 1), [1, 0], labels=["a", "a"])


def test_empty_output_has_no_drift():
    sol = turning().solve(t_eval=[])
    for invariants in (None, radius):
        with pytest.raises(ValueError, match="t_eval was empty"):
            sol.plot_drift(invariants=invariants)
    assert legend(sol.plot(ax=axes())) == ["east", "north"]


def test_drift_after_a_jump_is_from_the_value_held_since():
    def energy(t, y):
        return y[1] ** 2 / 2 + y[0]

    imposed, plain = ball(invariants=energy), ball()
    assert plain.plot_drift(ax=axes(), invariants=energy).get_ylim()[1] < 1e-6
    np.testing.assert_allclose(np.nanmax(imposed.plot_drift(ax=axes()).lines[0].get_ydata()), 0, atol=1e-12)


def test_drift_passes_the_arguments_of_the_run():
    for c in (2.0, 3.0):  # the second run is by a template
        sol = iv.solve_ivp(lambda t, y, c: -c * y, (0, 1), [1.0], args=(c,))
        (line,) = sol.plot_drift(ax=axes(), invariants=lambda t, y, c: y[0] * np.exp(c * t)).lines
        assert 0 < np.nanmax(line.get_ydata()) < 1e-2


@explicit_and_implicit
def test_steps_are_drawn_over_the_interval_that_they_span(method):
    sol = turning().solve(method)
    size, order, errors = sol.plot_steps()
    for panel, values in ((size, np.abs(sol.steps.h)), (order, sol.steps.order)):
        (line,) = panel.lines
        assert line.get_drawstyle() == "steps-pre"
        np.testing.assert_allclose(line.get_xdata(), [0, *sol.steps.t], atol=1e-12)
        np.testing.assert_array_equal(line.get_ydata()[1:], values)
    dots = {line.get_label(): line.get_ydata() for line in errors.lines[1:]}
    np.testing.assert_array_equal(dots["error"], np.where(sol.steps.error > 0, sol.steps.error, np.nan))
    if sol.steps.correction.max() > 1e-6:  # of smaller ones, as with a rule that keeps the radius itself, none is seen
        visible = np.where(sol.steps.correction > 0, sol.steps.correction, np.nan)
        np.testing.assert_array_equal(dots["correction"], visible)
    assert ("correction" in dots) == (sol.steps.correction.max() > 1e-6)
    assert size.get_yscale() == errors.get_yscale() == "log"


def test_steps_on_fewer_axes_and_on_too_many():
    sol = turning().solve()
    for count in (1, 2, 3):
        given = Figure().subplots(count, squeeze=False)[:, 0]
        np.testing.assert_array_equal(sol.plot_steps(axes=given), given)
    with pytest.raises(ValueError, match="one to three axes, got 4"):
        sol.plot_steps(axes=Figure().subplots(2, 2))
    with pytest.raises(ValueError, match='keep="all"'):
        turning().solve(keep="end").plot_steps()


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


def test_runs_on_the_same_axes_have_different_colours():
    ax = axes()
    for _ in range(3):
        turning().solve().plot(ax=ax)
    assert len({line.get_color() for line in shown(ax)}) == 6
    assert shown(turning().solve().plot(ax=axes(), components=0, c="black", ls="--"))[0].get_color() == "black"


def test_matplotlib_is_asked_for_where_it_is_missing(monkeypatch):
    sol = PROBLEMS["pendulum"].solve("ode45")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for draw in DRAWINGS.values():
        with pytest.raises(ModuleNotFoundError, match=r'pip install "invariode\[plot\]"'):
            draw(sol)


def test_a_first_figure_leaves_a_notebook_interactive(tmp_path):
    """Such a backend turns `interactive` on when it is loaded, which is when the first figure is made."""
    backend = "from matplotlib.backends.backend_agg import *\nimport matplotlib\nmatplotlib.interactive(True)\n"
    (tmp_path / "notebook.py").write_text(backend)
    code = (
        "import invariode as iv, matplotlib\n"
        "iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]).plot()\n"
        "assert matplotlib.is_interactive()"
    )
    environment = {**os.environ, "MPLBACKEND": "module://notebook", "PYTHONPATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


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


class TestWorkAndPrecision:
    def test_errors_fall_with_the_work_and_projected_runs_are_dashed(self):
        panels = iv.plot_work_precision(turning((0, 5)), ["ode45", "dop853"], rtols=[1e-3, 1e-6, 1e-9])
        assert [ax.get_xlabel() for ax in panels] == ["evaluations of $f$", "time in seconds"]
        assert len(panels[0].lines) == 4
        for line in panels[0].lines:
            work, errors = line.get_data()
            assert (np.diff(work) >= 0).all()
            assert errors[-1] < errors[0]
        assert [text.get_text() for text in panels[0].figure.legends[0].get_texts()] == [
            "ode45", "dop853", "plain", "projected"]  # fmt: skip

    def test_every_method_has_a_look_of_its_own(self):
        looks = [work_precision._style(name, "plain") for name in (*iv.METHODS, "BDF")]
        assert len({(look["color"], look["marker"]) for look in looks}) == len(looks)

    def test_names_of_scipy_run_what_they_mean(self):
        """BDF is ode15s with an option, and takes other steps."""
        problem = turning((0, 10), invariants=None)
        given = {"reference": [np.cos(10), np.sin(10)], "rtols": [1e-3], "axes": Figure().subplots(1, 2)}
        panels = iv.plot_work_precision(problem, ["BDF", "ode15s", "RK45"], **given)
        work = [int(line.get_xdata()[0]) for line in panels[0].lines]
        judged = problem.replace(nonnegative=False)  # the picture judges errors by itself
        stats = [judged.solve(name, rtol=1e-3, atol=1e-6).stats for name in ("BDF", "ode15s", "ode45")]
        assert work == [one.nfev + one.nfev_check for one in stats]
        assert len(set(work)) == 3

    def test_a_method_without_a_point_is_not_in_the_legend(self):
        reached, failed = Run(1e-5, 100, 0, 0, 0.01), Run(np.inf, 100, 0, 0, 0.01, "takes too long")
        figure = Figure()
        work_precision._finish(
            figure, [ComparedMethod("ode45", 1e-3, reached, None), ComparedMethod("ode23", 1e-3, failed, None)], "decay"
        )
        assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ode45"]

    def test_a_reference_of_ones_own(self):
        problem = turning((0, 5), invariants=None)
        exact = [np.cos(5), np.sin(5)]
        sol = problem.solve("dop853", rtol=1e-12, atol=1e-13)
        for reference in (exact, sol):
            panels = iv.plot_work_precision(problem, ["ode45"], reference, rtols=[1e-4], axes=Figure().subplots(1, 2))
            (error,) = panels[0].lines[0].get_ydata()
            end = problem.solve("ode45", rtol=1e-4, atol=1e-7).y[:, -1]
            expected = np.abs(end - exact).max() / (1.0 if reference is sol else np.abs(np.asarray(exact)).max())
            assert error == pytest.approx(expected, rel=1.0)

    def test_what_cannot_be_drawn_says_why(self):
        with pytest.raises(ValueError, match="reference must be a Solution or a state of shape"):
            iv.plot_work_precision(turning(), ["ode45"], [1.0])
        with pytest.raises(ValueError, match="ode45 cannot use a mass matrix: choose from ode15s"):
            iv.plot_work_precision(turning(mass=np.eye(2), invariants=None), ["ode45"])
        with pytest.raises(ValueError, match="draws on two axes, got 1"):
            iv.plot_work_precision(turning((0, 1)), ["ode45"], rtols=[1e-3], axes=axes())


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


class TestDrift:
    def test_the_first_point_does_not_stretch_the_axis(self):
        """A residual of rounding where a value is taken is left out; one above later residuals is drawn."""
        sol = turning((0, 20), invariants=None).solve("ode45", rtol=1e-3)
        energy = lambda t, y: (y[0] ** 2 + y[1] ** 2) * (1 + 1e-16)  # noqa: E731
        ax = sol.plot_drift(ax=axes(), invariants=energy)
        (line,) = shown(ax)
        drawn, later = line.get_ydata(), np.abs(energy(sol.t, sol.y) - energy(0, sol.y[:, 0]))[1:]
        assert np.isnan(drawn[0])
        np.testing.assert_allclose(drawn[1:], later, atol=1e-12)  # zeros are drawn below the others
        assert ax.get_ylim()[0] > np.nanmin(drawn) / 10

    def test_the_first_steps_do_not_either(self):
        """Drift that grows from rounding to 1e-2 in the first steps is drawn from where it has grown."""
        sol = iv.solve_ivp(PROBLEMS["pendulum"].fun, (0, 50), [1, 0, 0, 0])
        ax = sol.plot_drift(ax=axes(), invariants=lambda t, y: y[0] ** 2 + y[1] ** 2)
        drawn = shown(ax)[0].get_ydata()
        low = ax.get_ylim()[0]
        assert np.nanmin(drawn) < 1e-10
        assert low > 1e-7
        assert (drawn[len(drawn) // 10 + 1 :] > low).all()
        assert sol.plot_drift(ax=ax, invariants=lambda t, y: y[0] ** 2 + y[1] ** 2, label="again").get_ylim()[0] == low

    def test_the_legend_lists_curves_from_the_largest_residual_to_the_smallest(self):
        sol = turning((0, 20), invariants=None).solve("ode45", rtol=1e-3)
        given = {"small": lambda t, y: 1e-3 * y @ y, "large": lambda t, y: y @ y, "middle": lambda t, y: 0.1 * y @ y}
        assert legend(sol.plot_drift(ax=axes(), invariants=given))[:3] == ["large", "middle", "small"]


def decay_and_growth(**options):
    """y0' = -a y0, y1' = b y0 from (1, 0), with a dose of 1 at t = 1."""
    problem = iv.Problem(
        lambda t, y, a, b: [-a * y[0], b * y[0]], (0, 2), [1.0, 0.0], args=(0.5, 2.0), sensitivities=True,
        labels=["drug", "effect"], breakpoints=[(1.0, lambda t, y, a, b: [y[0] + 1, y[1]])],
    )  # fmt: skip
    return problem.solve("ode45", rtol=1e-8, atol=1e-10, **options)


class TestSensitivities:
    def test_curves_are_the_derivatives_and_interrupted_at_jumps(self):
        """∂drug/∂a = −t e^(−at) before the dose, whatever the output, and NaN separates the pieces."""
        for options in ({}, {"dense_output": True}, {"t_eval": np.linspace(0, 2, 21)}):
            sol = decay_and_growth(**options)
            first, second = sol.plot_sensitivities().figure.axes
            assert [first.get_ylabel(), second.get_ylabel()] == ["∂drug/∂p", "∂effect/∂p"]
            assert legend(first) == ["a", "b"]
            t, values = shown(first)[0].get_data()
            early = t < 1
            np.testing.assert_allclose(values[early], -t[early] * np.exp(-0.5 * t[early]), atol=1e-6)
            assert np.isnan(values).any()

    def test_relative_ones_are_numbers_without_unit(self):
        sol = decay_and_growth()
        ax = sol.plot_sensitivities("effect", "b", relative=True, ax=axes())
        (line,) = shown(ax)
        np.testing.assert_allclose(line.get_ydata()[-1], 1, rtol=1e-6)  # effect is proportional to b
        assert line.get_label() == "b ∂effect/∂b / max |effect|"

    def test_a_map_has_a_row_for_each_derivative(self):
        sol = decay_and_growth()
        ax = sol.plot_sensitivities(kind="map")
        assert [label.get_text() for label in ax.get_yticklabels()] == [
            "∂drug/∂a", "∂drug/∂b", "∂effect/∂a", "∂effect/∂b"
        ]  # fmt: skip
        shown_values = ax.collections[0].get_array().reshape(4, -1)
        expected = sol.sensitivities.reshape(4, -1) * np.outer(
            (1 / np.abs(sol.y).max(axis=1))[[0, 0, 1, 1]] * np.array([0.5, 2, 0.5, 2]), np.ones(len(sol.t))
        )
        np.testing.assert_allclose(shown_values, expected)
        raw = sol.plot_sensitivities(kind="map", relative=False, ax=axes())
        np.testing.assert_array_equal(raw.collections[0].get_array().reshape(4, -1), sol.sensitivities.reshape(4, -1))

    def test_unknowns_of_daes_are_drawn_too(self):
        """y0' = -k y0 and y1 = 2 y0: relative sensitivities of both to k end at -k t exp(-k t)."""
        for options in ({}, {"dense_output": True}):
            sol = iv.solve_dae(
                lambda t, y, yp, k: [yp[0] + k * y[0], y[1] - 2 * y[0]], (0, 2), [1.0, 2.0], args=(0.5,),
                sensitivities=True, rtol=1e-8, atol=1e-10, **options,
            )  # fmt: skip
            for panel in sol.plot_sensitivities(relative=True).figure.axes:
                np.testing.assert_allclose(shown(panel)[0].get_ydata()[-1], -np.exp(-1), atol=1e-6)

    def test_what_cannot_be_drawn_says_why(self, tmp_path):
        sol = decay_and_growth()
        with pytest.raises(ValueError, match="there is no parameter 'bb'"):
            sol.plot_sensitivities(parameters="bb")
        with pytest.raises(ValueError, match="there is no component 'drog'"):
            sol.plot_sensitivities("drog")
        with pytest.raises(ValueError, match="kind must be one of 'lines', 'map'"):
            sol.plot_sensitivities(kind="heat")
        with pytest.raises(ValueError, match="the run had no sensitivities: solve with sensitivities=True"):
            turning().solve().plot_sensitivities()
        sol.save(tmp_path / "run.npz")
        loaded = iv.load(tmp_path / "run.npz")
        assert len(loaded.plot_sensitivities().figure.axes) == 2
        with pytest.raises(ValueError, match="need the values of the parameters"):
            loaded.plot_sensitivities(kind="map")
        k = np.arange(1.0, 70)
        wide = iv.solve_ivp(lambda t, y, *k: [-sum(k) * y[0]], (0, 1e-3), [1.0], args=tuple(k), sensitivities=True)
        with pytest.raises(ValueError, match="a map of 1 components and 69 parameters has 69 rows"):
            wide.plot_sensitivities(kind="map")
        wave = iv.solve_ivp(lambda t, y, k: 1j * k * y, (0, 1), [1 + 0j], args=(1.0,), sensitivities=True)
        assert legend(wave.plot_sensitivities(ax=axes())) == ["Re ∂y0/∂k", "Im ∂y0/∂k"]
        with pytest.raises(ValueError, match="a map shows real sensitivities"):
            wave.plot_sensitivities(kind="map", relative=False)


def test_components_that_jump_are_lines_however_often_and_noise_has_no_panel():
    """A switch whose values have roundoff between its jumps is no oscillation; what stays below atol counts as zero."""

    def room(t, y):
        return [0.2 * (10 - y[0]) + 5 * y[1], 0.0, 1e-9 * np.cos(t)]

    def switch(level, direction, value):
        return iv.Event(
            lambda t, y: y[0] - level, direction=direction, action=lambda t, y: [y[0], value, y[2]], name=f"to {value}"
        )

    events = [switch(19.0, -1, 1.0), switch(21.0, 1, 0.0)]
    sol = iv.solve_ivp(room, (0, 60), [15.0, 1.0, 0.0], events=events, rtol=1e-6, refine=4)
    assert len(sol.t_events["to 0.0"]) > 15
    figure = sol.plot().figure
    assert len(figure.axes) == 1
    assert not figure.axes[0].collections
