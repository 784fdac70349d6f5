"""Pictures of comparisons and of sensitivities show what was computed."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

import invariode as iv
from drawn import axes, legend, shown, turning
from invariode._studies import work_precision
from invariode._studies.precision import ComparedMethod, Run


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
