"""Pictures show what the solution is, on the axes that they are given, and do nothing else."""

from __future__ import annotations

import os
import subprocess
import sys

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import invariode as iv
from cases import METHODS, dealt, explicit_and_implicit
from drawn import DRAWINGS, axes, ball, legend, shown, turning
from problems import PROBLEMS


@pytest.fixture(params=list(DRAWINGS))
def draw(request):
    return DRAWINGS[request.param]


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


@dealt(3 * len(METHODS), problem=PROBLEMS, drawing=DRAWINGS, method=METHODS)
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


def test_a_run_that_kept_its_end_only_says_what_a_picture_needs():
    sol = turning().solve(keep="end")
    for draw in (sol.plot, lambda: sol.plot_phase(0, 1)):
        with pytest.raises(ValueError, match=r'kept only its final state: for a picture solve with keep="all"'):
            draw()
    assert not plt.get_fignums()


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
    environment = {
        **os.environ,
        "MPLBACKEND": "module://notebook",
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


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
