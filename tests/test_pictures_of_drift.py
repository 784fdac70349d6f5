"""Pictures of drift show residuals before and after projection, by levels."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from drawn import axes, ball, circle, legend, radius, shown, turning
from problems import PROBLEMS


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
    drift = sol.drift(invariants=radius)
    assert drift.residual_after[0] == np.abs(radius(0, sol.y) - 1).max()
    assert np.isnan(drift.residual_before).all()
    (line,) = sol.plot_drift(ax=axes(), invariants=iv.Invariants(radius, value=2)).lines
    np.testing.assert_allclose(line.get_ydata(), np.abs(radius(0, sol.y) - 2), rtol=1e-12)


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


def test_corrections_too_small_to_be_seen_are_not_named():
    """A linear invariant is kept to roundoff by any method: its corrections are below the axis."""
    sol = iv.solve_ivp(lambda t, y: [-y[0], y[0]], (0, 5), [0.7, 0.1], invariants=lambda t, y: y[0] + y[1], rtol=1e-3)
    assert 0 < sol.steps.correction.max() < 1e-6
    assert sol.plot_steps()[2].get_legend() is None


def test_empty_output_has_no_drift():
    sol = turning().solve(t_eval=[])
    for invariants in (None, radius):
        with pytest.raises(ValueError, match="t_eval was empty"):
            sol.plot_drift(invariants=invariants)
        with pytest.raises(ValueError, match="t_eval was empty"):
            sol.drift(invariants=radius)
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
