"""Forms of data and options of a fit, and the messages for those that are wrong."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

import invariode as iv
from fitted import LINE, LINE_DATA, T, decaying, hunting, noisy, straight


class TestWhatGoesWrong:
    def test_a_failed_run_is_a_step_that_is_not_taken(self):
        """x' = k x² is infinite at t = 1 / k: steps to large k fail, and are counted with the reason."""
        problem = iv.Problem(lambda t, y, k: k * y**2, (0, 1), [1.0], args=(0.6,), labels=["x"])
        t = np.linspace(0.1, 1, 8)
        data = 1 / (1 - 0.95 * t)
        fit = iv.fit(problem, t, data, {"k": iv.Parameter(0.6)}, sigma=0.01)
        assert fit.parameters["k"] == pytest.approx(0.95, rel=1e-4)
        assert sum(fit.failures.values()) >= 1
        assert "runs failed" in repr(fit)

    def test_runs_that_fail_at_the_start(self):
        problem = iv.Problem(lambda t, y, k: k * y**2, (0, 1), [1.0], args=(5.0,))
        with pytest.raises(ValueError, match="cannot be evaluated at the start, k = 5: "):
            iv.fit(problem, T[T < 1], np.ones((T < 1).sum()), {"k": (0, 9)})

    def test_exceptions_of_f_come_out(self):
        """Exceptions come from a trial too, where f is called as it was compiled."""

        def fussy(t, y, k):
            if k > 0.9:
                raise RuntimeError("not so fast")
            return -k * y

        problem = iv.Problem(fussy, (0, 4), [1.0], args=(0.5,))
        with pytest.raises(RuntimeError, match="not so fast"):
            iv.fit(problem, T, np.exp(-2 * T), {"k": (0, 5)})

    def test_a_run_without_an_end(self):
        """Data end it, and pictures and solutions end with them."""
        problem = iv.Problem(lambda t, y, k: -k * y, (0, np.inf), [1.0], args=(0.5,))
        fit = iv.fit(problem, T, np.exp(-0.7 * T) + 0.01 * np.sin(9 * T), {"k": (0, 5)})
        assert fit.solution.t_end == T[-1]
        assert fit.predict([7.0]).y[0, 0] == pytest.approx(np.exp(-7 * fit.parameters["k"]), rel=1e-4)

    def test_what_the_data_do_not_determine_is_named(self):
        """Only the product scale · x is seen in x's data; a parameter that f ignores is alone."""
        problem = iv.Problem(lambda t, y, k, unused: -k * y, (0, 5), [2.0], args=(0.7, 1.0), labels=["x"])
        data = 3 * np.exp(-0.6 * T) + 0.01 * np.sin(9 * T)
        wanted = {"k": (0, 5), "y0[x]": iv.Parameter(1.0), "scale": iv.Parameter(2.0), "unused": iv.Parameter(1.0)}
        with pytest.warns(UserWarning, match=r"do not determine (unused|a combination of y0\[x\] and scale)"):
            fit = iv.fit(problem, T, data, wanted, observe=lambda t, y, k, unused, *, scale: scale * y[0])
        assert sorted(fit.undetermined) == [["unused"], ["y0[x]", "scale"]]
        assert fit.parameters["y0[x]"] * fit.parameters["scale"] == pytest.approx(3, rel=0.01)
        assert np.isinf(fit.standard_errors["unused"])
        assert np.isfinite(fit.standard_errors["k"])
        assert fit.confidence()["scale"] == (-np.inf, np.inf)

    def test_a_parameter_at_its_bound(self):
        """The parameter is named, and the others have the errors that they have with it fixed there."""
        data = noisy(decaying(), T, 0.01)
        with pytest.warns(UserWarning, match=r"c is at its lower bound, 0\.2"):
            fit = iv.fit(decaying(), T, data, {"k": (0.01, 5), "c": (0.2, 5)}, sigma=0.01)
        fixed = iv.fit(decaying(), T, data, {"k": (0.01, 5), "c": iv.Parameter(equals=0.2)}, sigma=0.01)
        assert fit.parameters == pytest.approx(fixed.parameters, rel=1e-5)
        assert fit.standard_errors["k"] == pytest.approx(fixed.standard_errors["k"], rel=1e-4)
        assert np.isnan(fit.standard_errors["c"])
        assert np.isnan(fit.confidence()["c"]).all()

    def test_as_many_parameters_as_data(self):
        """No data are left to estimate sigma: there are no standard errors, and the fit says so."""
        with pytest.warns(UserWarning, match="2 data for 2 parameters leave none to estimate sigma"):
            fit = iv.fit(straight(), [1, 3], [1.5, 2.6], LINE)
        assert fit.degrees_of_freedom == 0
        assert np.isinf([*fit.standard_errors.values()]).all()
        assert fit.confidence()["slope"] == (-np.inf, np.inf)
        assert fit.undetermined == []
        assert fit.log_likelihood is None
        assert np.isnan(fit.sigma)
        assert "nan" not in repr(fit)
        assert "not determined" not in repr(fit)
        assert np.isinf(fit.predict([2.0], noise=True).upper).all()
        with pytest.raises(ValueError, match="leave none to estimate sigma"):
            fit.profile("slope")

    def test_a_noise_level_without_degrees_of_freedom(self):
        wanted = {**LINE, "s": iv.Parameter(0.1)}
        with pytest.warns(UserWarning, match="2 data for 2 parameters leave none to estimate sigma"):
            fit = iv.fit(straight(), [1, 3], [1.5, 2.6], wanted, sigma="s")
        assert np.isinf(fit.standard_errors["slope"])

    def test_a_known_sigma_needs_no_degrees_of_freedom(self):
        fit = iv.fit(straight(), [1, 3], [1.5, 2.6], LINE, sigma=0.1)
        assert fit.standard_errors["slope"] == pytest.approx(0.1 / np.sqrt(2), rel=1e-5)
        fixed = iv.fit(straight(), [1, 3], [1.5, 2.6], {**LINE, "s": iv.Parameter(equals=0.1)}, sigma="s")
        np.testing.assert_allclose(fixed.covariance, fit.covariance, rtol=1e-6)
        assert "χ²/ν" not in repr(fit)
        assert np.isnan(fit.reduced_chi_squared)

    def test_a_parameter_at_its_bound_beside_an_outlier(self):
        """The outlier pulls the offset from its bound with almost no weight; the error of k has the weights of the
        loss, as with the offset fixed."""
        problem = iv.Problem(lambda t, y, k: [-k * y[0]], (0, 10), [2.0], args=(0.5,))
        t = np.arange(1.0, 9)
        data = 2 * np.exp(-0.3 * t) + 0.01 * np.random.default_rng(1).standard_normal(8)
        data[3] += 2
        options = {"observe": lambda t, y, k, *, off=0.0: y[0] + off, "sigma": 0.01, "loss": "cauchy"}
        with pytest.warns(UserWarning, match=r"off is at its lower bound, 0\.1"):
            fit = iv.fit(problem, t, data, {"k": (0, 5), "off": (0.1, 1)}, **options)
        fixed = iv.fit(problem, t, data, {"k": (0, 5), "off": iv.Parameter(equals=0.1)}, **options)
        assert fit.parameters == pytest.approx(fixed.parameters, rel=1e-4)
        assert fit.standard_errors["k"] == pytest.approx(fixed.standard_errors["k"], rel=1e-3)
        assert fit.standard_errors["k"] == pytest.approx(0.0038, rel=0.02)
        assert fit.starts[0][0] == pytest.approx(fixed.starts[0][0], rel=1e-6)

    @pytest.mark.parametrize(
        ("arguments", "options", "message"),
        [
            ((T, LINE_DATA, {"slop": (0, 1)}), {}, "(takes a|has no) parameter 'slop': .*did you mean 'slope'"),
            ((T, LINE_DATA, {"slope": 0.5}), {}, r"'slope' is 0.5: give Parameter\(start=0.5\).*equals"),
            ((T, LINE_DATA, {"slope": (1, 0)}), {}, "'slope': bounds .* with lower < upper"),
            ((T, LINE_DATA, {"slope": iv.Parameter(equals="k")}), {}, "names 'k', which is not among"),
            ((T, LINE_DATA, {"slope": iv.Parameter(equals=1.0)}), {}, "nothing to fit"),
            ((T, LINE_DATA, {}), {}, "parameters must be a dict"),
            ((T, LINE_DATA[:, 1:], LINE), {}, r"data must have shape \(1, 12\).*got \(1, 11\)"),
            ((T, np.full((1, 12), np.nan), LINE), {}, "NaN throughout"),
            ((T + 3, LINE_DATA, LINE), {}, r"the time .* outside the problem's t_span"),
            ((None, LINE_DATA, LINE), {}, "t is missing"),
            ((T, {"z": T}, LINE), {}, "no component 'z'"),
            ((T, LINE_DATA, LINE), {"observe": "z"}, "no component 'z'"),
            ((T, LINE_DATA, LINE), {"sigma": 0}, "sigma of y must be positive"),
            ((T, LINE_DATA, LINE), {"sigma": [1, 2]}, r"sigma must be a number or have shape \(1,\)"),
            ((T, LINE_DATA, LINE), {"sigma": {"x": 1}}, "sigma names 'x'.*: the measured quantities are y"),
            ((T, LINE_DATA, LINE), {"sigma": {}}, "sigma is missing for 'y': it names nothing"),
            ((T, LINE_DATA, LINE), {"sigma": "s"}, "sigma names 's', which is not among the parameters"),
            ((T, LINE_DATA, {**LINE, "s": iv.Parameter(-1.0)}), {"sigma": "s"}, "s is a noise level"),
            ((T, -LINE_DATA, LINE), {"noise": "lognormal"}, "needs positive data"),
            ((T, LINE_DATA, LINE), {"loss": "huber"}, "needs a known sigma"),
            ((T, LINE_DATA, LINE), {"loss": "square"}, "loss must be one of"),
            ((T, LINE_DATA, LINE), {"event_times": {"hit": [1.0]}}, "event_times names 'hit'.*no events"),
            ((T, LINE_DATA, LINE), {"t_eval": T}, "t_eval is not an option of fit: fit sets"),
            ((T, LINE_DATA, LINE), {"events": []}, "events is not an option of fit: give events to the Problem"),
            ((T, LINE_DATA, LINE), {"starts": 3}, r"starts=3 needs two bounds of y0\[y\]"),
            ((T, LINE_DATA, {"slope": iv.Parameter(start=2, bounds=(2.0, 3.0))}), {"rtoll": 1}, "rtoll"),
            (([1.0], [[1.0]], {"slope": (0, 1)}), {"observe": lambda t, y, s, *, gain: gain * y[0]}, "needs gain"),
        ],
    )
    def test_wrong_input_is_named(self, arguments, options, message):
        with pytest.raises((TypeError, ValueError), match=message):
            iv.fit(straight(), *arguments, **options)

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"start": 3, "bounds": (0, 1)}, "start of a Parameter is 3, which is not within"),
            ({"scale": "log", "start": -1}, "must be positive"),
            ({"scale": "log", "bounds": (None, 0)}, "must be positive"),
            ({"scale": "ln"}, "scale of a Parameter must be one of 'linear', 'log'"),
            ({"prior": 3}, "prior of a Parameter must be"),
            ({"prior": (3, 0)}, "positive standard deviation"),
            ({"equals": 1, "bounds": (0, 1)}, "with equals has no bounds"),
            ({"equals": np.nan}, "must not be NaN"),
            ({"equals": np.inf}, "equals of a Parameter must be finite, got inf"),
            ({"bounds": 3}, r"bounds of a Parameter must be \(lower, upper\)"),
            ({"shared": 1}, "shared of a Parameter must be True or False"),
        ],
    )
    def test_wrong_parameters_are_named(self, fields, message):
        with pytest.raises((TypeError, ValueError), match=message):
            iv.Parameter(**fields)

    def test_experiments_that_do_not_agree(self):
        ones = [iv.Experiment(decaying(args=(k, 0.1)), T, noisy(decaying(), T, 0.1)) for k in (1.0, 2.0)]
        with pytest.raises(ValueError, match="k is 1, 2 in the problems: give it a start"):
            iv.fit(ones, {"k": (0, 5)})
        with pytest.raises(ValueError, match="sigma is missing for x"):
            iv.fit([ones[0], iv.Experiment(decaying(), T, noisy(decaying(), T, 0.1), sigma=0.1)], {"c": (0, 5)})
        with pytest.raises(TypeError, match="sigma belongs to each Experiment"):
            iv.fit(ones, {"c": (0, 5)}, sigma=0.1)


class TestForms:
    def test_data_in_all_forms_are_the_same(self):
        """Arrays, transposed where that is clear, dicts, tables and labelled arrays, times in any order."""
        pandas, xarray = pytest.importorskip("pandas"), pytest.importorskip("xarray")
        problem, data = hunting(), noisy(hunting(), T, 0.05)
        by_name = dict(zip(problem.labels, data, strict=True))
        shuffled = np.random.default_rng(2).permutation(len(T))
        table = pandas.DataFrame({**by_name, "day": T})
        labelled = xarray.DataArray(data.T, {"t": T, "component": problem.labels}, ("t", "component"))
        forms = [
            (T, data),
            (T, data.T),
            (T, data.tolist()),
            (T, by_name),
            (T[shuffled], data[:, shuffled]),
            ("day", table),
            (None, table.rename(columns={"day": "Time [d]"})),
            (None, table.set_index("day")[["predators", "prey"]]),
            (None, labelled),
            (None, labelled.to_dataset(name="y")),
            (None, labelled.to_dataset("component")),
        ]
        found = [iv.objective(problem, t, one, {"a": (0, 5)}, sigma=0.05)([1.4]) for t, one in forms]
        assert found == pytest.approx([found[0]] * len(forms), rel=1e-12)
        with pytest.raises(
            ValueError, match=r"the column 'day' is no component, .*; if it has the times, pass t='day'"
        ):
            iv.objective(problem, table.set_axis(T), parameters={"a": (0, 5)})
        with pytest.raises(ValueError, match=r"no column t or time, but prey, predators, day, .* such as t='day'"):
            iv.objective(problem, table, parameters={"a": (0, 5)})

    def test_replicates_are_data(self):
        """Two values at one time weigh as their mean with a smaller sigma."""
        twice = iv.fit(straight(), [1, 3, 3], [1.5, 2.4, 2.6], LINE, sigma=0.1)
        once = iv.fit(straight(), [1, 3], [1.5, 2.5], LINE, sigma=[[0.1, 0.1 / np.sqrt(2)]])
        np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-6)
        assert twice.parameters == pytest.approx(once.parameters, rel=1e-6)

    def test_quantities_of_other_sizes_have_panels_of_their_own(self):
        plt = pytest.importorskip("matplotlib.pyplot")
        fit = iv.fit(
            iv.Problem(lambda t, y, k: [-k * y[0], -k * y[1]], (0, 5), [1.0, 1e-6], args=(1.0,), labels=["x", "z"]),
            T, np.outer([1.0, 1e-6], np.exp(-0.7 * T)), {"k": (0, 2)}, sigma={"x": 1e-2, "z": 1e-8},
        )  # fmt: skip
        assert len(fit.plot().figure.axes) == 2
        ax = plt.figure().add_subplot()
        assert fit.plot(ax=ax) is ax
        plt.close("all")

    def test_a_square_of_data_is_ambiguous(self):
        with pytest.raises(ValueError, match="could have the times along either axis: give a dict"):
            iv.fit(hunting(), [1.0, 2.0], np.ones((2, 2)), {"a": (0, 5)})

    def test_it_prints_and_draws(self):
        pytest.importorskip("matplotlib")
        fit = iv.fit(straight(), T, LINE_DATA, LINE, sigma=0.1)
        assert "slope" in repr(fit)
        assert "95 % interval" in repr(fit)
        assert "slope" in fit._repr_html_()
        ax = fit.plot()
        low, high = fit.predict([T[3]]).lower[0, 0], fit.predict([T[3]]).upper[0, 0]
        drawn = ax.collections[0].get_paths()[0].vertices
        at = np.abs(drawn[:, 0] - T[3]) < 0.02
        assert drawn[at, 1].min() == pytest.approx(low, abs=0.02)
        assert drawn[at, 1].max() == pytest.approx(high, abs=0.02)
        assert isinstance(fit.solution, iv.Solution)
        assert fit.solution.sol(2.0)[0] == pytest.approx(fit.predict([2.0]).y[0, 0], rel=1e-5)


def test_data_with_labels_of_time_are_matched_by_them() -> None:
    """In any order of rows, tables, series and labelled arrays give the fit of the data in the order of t."""
    pd, xr = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    t = np.array([0.0, 1, 2, 3, 4, 5])
    values, sigma = 2 * np.exp(-0.5 * t) + 0.01 * np.cos(7 * t), 0.1 + 0.02 * t
    problem = iv.Problem(lambda t, y, k: [-k * y[0]], (0, 5), [2.0], args=(1.0,), labels=["drug"])

    def fitted(times: Any, data: Any, sigma: Any = sigma) -> float:
        return float(iv.fit(problem, times, data, {"k": (0.1, 3)}, sigma=sigma).parameters["k"])

    expected = fitted(t, {"drug": values})
    order = [3, 0, 5, 1, 2, 4]
    table = pd.DataFrame({"drug": values[order]}, index=t[order])
    column = pd.DataFrame({"time": t, "drug": values, "sd": sigma}, index=list("abcdef"))
    shuffled = column.iloc[order]
    array = xr.DataArray(values[None, order], dims=("component", "t"), coords={"component": ["drug"], "t": t[order]})
    same = [
        (t, table, pd.Series(sigma[order], t[order])),
        (t, table["drug"], sigma),
        (t, {"drug": table["drug"]}, {"drug": pd.Series(sigma[::-1], t[::-1])}),
        (column["time"], shuffled[["drug"]], shuffled["sd"]),
        (t, array, xr.DataArray(sigma[order], dims="t", coords={"t": t[order]})),
        (t, array.T, sigma),
        (t, xr.Dataset({"drug": array[0]}), sigma),
        (None, table, pd.Series(sigma, t)),
        (t, pd.DataFrame({"drug": values}), sigma),  # rows without labels
        ("time", column[["time", "drug"]], column["sd"]),
    ]
    for times, data, known in same:
        assert fitted(times, data, known) == pytest.approx(expected, rel=1e-12)
    for times, data in [(t + 10, table), (t[:-1], table), (t, array.assign_coords(t=t + 1))]:
        with pytest.raises(ValueError, match=r"labelled with .* and t is"):
            fitted(times, data)
    with pytest.raises(ValueError, match="the index of t"):
        fitted(column["time"], table)
    with pytest.raises(ValueError, match="repeat"):
        fitted(pd.Series(t, [0, 0, 1, 2, 3, 4]), pd.DataFrame({"drug": values}, index=[0, 1, 0, 2, 3, 4]))


class TestWhere:
    """Parameters that experiments have under names of their own."""

    @staticmethod
    def cooling(t, y, k, ambient):
        return [-k * (y[0] - ambient)]

    def experiments(self):
        t, found = np.linspace(0.5, 4, 8), []
        for k, start, ambient in ((0.5, 3.0, 1.0), (0.9, 4.0, 1.0), (0.5, 2.0, 0.2)):
            data = ambient + (start - ambient) * np.exp(-k * t)
            given = iv.Problem(self.cooling, (0, 4), [1.0], args=(1.0, 0.7), labels=["T"])
            where = {"k": "k_slow" if k == 0.5 else "k_fast", "y0[T]": f"start_{start:g}"}
            where["ambient"] = "ambient" if ambient == 1 else 0.2
            found.append(iv.Experiment(given, t, {"T": data}, where=where))
        return found

    def test_shared_and_own_values_come_back(self):
        names = {"k_slow": (0.1, 2), "k_fast": (0.1, 2), "ambient": (0, 3)}
        names |= {f"start_{x}": (0.1, 9) for x in (3, 4, 2)}
        fit = iv.fit(self.experiments(), parameters=names, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose([*fit.parameters.values()], [0.5, 0.9, 1.0, 3.0, 4.0, 2.0], rtol=1e-6)

    def test_the_own_name_means_nothing_then(self):
        with pytest.raises(ValueError, match="'k'"):
            iv.fit(self.experiments(), parameters={"k": (0.1, 2)})

    @pytest.mark.parametrize(
        ("where", "message"),
        [
            ({"kk": "a"}, "takes no parameter 'kk'"),
            ({"k": "a", "ambient": None}, "where"),
            ({"y0": "a"}, "both called|stands for|takes no"),
            ({"k": None}, "where"),
        ],
    )
    def test_what_is_wrong_is_named(self, where, message):
        given = iv.Problem(lambda t, y, k, ambient: -k * y, (0, 4), [1.0, 2.0], args=(1.0, 0.7))
        with pytest.raises((TypeError, ValueError), match=message):
            iv.Experiment(given, [1.0], [[1.0], [2.0]], where=where)


class TestPictures:
    """Pictures of a fit show its numbers."""

    @pytest.fixture
    def fitted(self) -> Any:
        """Two doses, absorbed and eliminated: jumps of y at t = 4."""
        pytest.importorskip("matplotlib")
        dose = lambda t, y, *k: [y[0] + 1, y[1]]  # noqa: E731
        problem = iv.Problem(
            lambda t, y, k, a: [-a * y[0], a * y[0] - k * y[1]], (0, 8), [1.0, 0.0], args=(0.3, 1.2),
            labels=["gut [mg]", "blood [mg/l]"], breakpoints=[(4.0, dose)],
        )  # fmt: skip
        t = np.linspace(0.5, 7.5, 15)
        data = problem.solve("ode45", t_eval=t).y + 0.03 * np.random.default_rng(1).standard_normal((2, 15))
        data[1, 3] = np.nan
        return iv.fit(problem, t, data, {"k": (0.05, 2), "a": (0.2, 5)}, sigma=0.03, starts=3)

    @pytest.fixture(autouse=True)
    def _closed(self) -> Any:
        yield
        sys.modules["matplotlib.pyplot"].close("all")

    def test_curves_are_interrupted_at_doses_and_each_unit_has_a_panel(self, fitted: Any) -> None:
        panels = fitted.plot().figure.axes
        assert [ax.get_ylabel() for ax in panels] == ["gut [mg]", "blood [mg/l]"]
        assert [text.get_text() for text in panels[0].get_legend().get_texts()] == ["fit", "95 % band", "data"]
        t, gut = panels[0].lines[0].get_data()
        (cut,) = np.flatnonzero(np.isnan(gut))
        assert t[cut - 1] == np.nextafter(4.0, 0)
        assert t[cut + 1] == 4
        assert gut[cut + 1] - gut[cut - 1] == pytest.approx(1, abs=1e-5)

    def test_residuals_and_correlations_are_those_of_the_fit(self, fitted: Any) -> None:
        ax = fitted.plot_residuals()
        drawn = [line.get_ydata() for line in ax.lines if line.get_marker() == "o"]
        for own, values in zip(drawn, fitted.residuals, strict=True):
            np.testing.assert_array_equal(own, values[np.isfinite(values)])
        ax = fitted.plot_correlation()
        np.testing.assert_array_equal(ax.images[0].get_array(), fitted.correlation)
        assert [label.get_text() for label in ax.get_xticklabels()] == ["k", "a"]

    def test_the_waterfall_has_the_costs_in_increasing_order(self, fitted: Any) -> None:
        ax = fitted.plot_starts()
        heights = ax.lines[0].get_ydata()
        assert len(heights) == 3
        assert (np.diff(heights) >= 0).all()
        costs = np.sort([cost for cost, _ in fitted.starts])
        np.testing.assert_allclose(heights, np.maximum(costs - costs[0], 1e-6 * max(costs[0], 1)))
        alone = iv.fit(straight(), T, LINE_DATA, LINE, sigma=0.1)
        with pytest.raises(ValueError, match="the fit had one start: compare several"):
            alone.plot_starts()

    def test_a_profile_meets_its_quantile_at_the_ends_of_the_interval(self, fitted: Any) -> None:
        profile = fitted.profile("k", level=0.9)
        ax = profile.plot()
        curve = next(line for line in ax.lines if line.get_label() == "profile")
        for end in (profile.lower, profile.upper):
            assert np.interp(end, *curve.get_data()) == pytest.approx(profile.quantile**2, rel=2e-2)
        assert profile.quantile == pytest.approx(1.6449, abs=1e-4)  # of the normal distribution: sigma is known
        assert ax.get_xlabel() == "k"


def test_all_experiments_are_drawn_in_panels_as_they_are_alone():
    plt = pytest.importorskip("matplotlib.pyplot")
    experiments = [iv.Experiment(straight().replace(name=name), T, LINE_DATA, sigma=0.1) for name in ("cold", "warm")]
    fitted = iv.fit(experiments, LINE)
    panels = fitted.plot(experiment="all").figure.axes
    assert [panel.get_title(loc="left") for panel in panels] == ["0: cold", "1: warm"]
    for e, panel in enumerate(panels):
        alone = fitted.plot(experiment=e)
        assert len(panel.lines) == len(alone.lines)
        for one, other in zip(panel.lines, alone.lines, strict=True):
            np.testing.assert_array_equal(one.get_xydata(), other.get_xydata())
    with pytest.raises(ValueError, match="leave ax out"):
        fitted.plot(experiment="all", ax=panels[0])
    plt.close("all")


def test_tables_say_what_is_missing_or_is_no_number():
    pd = pytest.importorskip("pandas")
    problem, columns = hunting(), {"Time": T, "prey": np.ones(len(T))}

    def fitted(data, t=None):
        return iv.objective(problem, t, data, {"a": (0, 5)}, sigma=0.05)

    with pytest.raises(ValueError, match="no column t or time, but prey, and its index has no name"):
        fitted(pd.DataFrame({"prey": columns["prey"]}))
    with pytest.raises(ValueError, match=r"the column 'ID' is no component, .* if it is no measurement, leave it out"):
        fitted(pd.DataFrame({**columns, "ID": 1}))
    with pytest.raises(ValueError, match=r"t holds the times of the data, and t\[1\] is NaN"):
        fitted(columns | {"Time": [0, np.nan, *T[2:]]})
    with pytest.raises(TypeError, match="data of prey must hold real numbers, got 'BLQ' at 1"):
        fitted(columns | {"prey": [1.0, "BLQ", *columns["prey"][2:]]})
    with pytest.raises(TypeError, match=r"t must hold real numbers, got dates or durations: .*total_seconds"):
        fitted(pd.DataFrame({**columns, "Time": pd.to_timedelta(T, "h")}))
    series = pd.DataFrame(columns)
    assert fitted(series["prey"], series["Time"])([1.4]) == fitted(series)([1.4])


def test_pictures_say_which_experiment_they_show():
    pytest.importorskip("matplotlib").use("agg")
    ones = [iv.Experiment(decaying(), T, noisy(decaying(), T, 0.1), sigma=0.1) for _ in range(2)]
    fit = iv.fit(ones, {"c": (0, 5)})
    for draw in (fit.plot, fit.plot_residuals):
        texts = draw(experiment=1).figure.findobj(lambda one: hasattr(one, "get_text"))
        assert any("experiment 1 (0 to 1)" in one.get_text() for one in texts)
        assert len(draw(experiment="all").figure.axes) == 2
