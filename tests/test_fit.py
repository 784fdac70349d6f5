"""Fits: known parameters come back, units and order do not matter, errors are those of the linear theory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import curve_fit

import invariode as iv
from fitted import LINE, LINE_DATA, T, decaying, hunting, noisy, straight

TIGHT = {"rtol": 1e-9, "atol": 1e-12}
STIMULUS = {**TIGHT, "breakpoints": [0.0]}


X = np.column_stack([np.ones_like(T), T])  # of the straight line, for (y0, slope)


class TestKnownParameters:
    @pytest.mark.parametrize("method", ["ode45", "ode15s"])
    def test_data_without_noise_give_back_their_parameters(self, method):
        """To the tolerance of the runs, up to the condition of the problem, which is below 1000 here."""
        truth = hunting()
        t = np.linspace(0.3, 6, 15)
        start = truth.replace(args=(1.3, 1.2, 2.7, 1.2), y0=[1.1, 0.9])
        names = ["a", "b", "c", "d", "y0[prey]", "y0[predators]"]
        fit = iv.fit(
            start, t, noisy(truth, t, 0), dict.fromkeys(names, (0.1, 10)), method=method, rtol=1e-7, atol=1e-10
        )
        assert fit.success
        np.testing.assert_allclose([*fit.parameters.values()], [*truth.args, *truth.y0], rtol=1e-4)
        assert max(fit.standard_errors.values()) < 1e-4

    def test_each_of_several_experiments_with_its_conditions(self):
        """Shared parameters are found from all, unshared ones from each."""
        ones = [decaying(2.0), decaying(1.0), decaying(0.5, tf=4.0)]
        experiments = [iv.Experiment(one, T, noisy(one, T, 0)) for one in ones]
        wanted = {"k": (0.1, 5), "c": (0, 1), "y0[x]": iv.Parameter(0.8, shared=False)}
        fit = iv.fit(experiments, wanted, **TIGHT)
        assert fit.names == ("k", "c", "y0[x][0]", "y0[x][1]", "y0[x][2]")
        np.testing.assert_allclose([*fit.parameters.values()], [0.7, 0.1, 2, 1, 0.5], rtol=1e-6)

    def test_scales_and_offsets_of_what_is_observed(self):
        """Keyword-only arguments of observe are parameters."""
        true = decaying()

        def observe(t, y, k, c, *, scale, offset=0.0):
            return [scale * y[0] + offset, k * y[0] ** 2]

        x = noisy(true, T, 0)[0]
        data = {"signal": 3 * x + 0.5, "rate": 0.7 * x**2}
        wanted = {"k": (0.1, 5), "scale": (0.1, 10), "offset": (-1, 1)}
        fit = iv.fit(true.replace(args=(0.4, 0.1)), T, data, wanted, observe=observe, **TIGHT)
        np.testing.assert_allclose([*fit.parameters.values()], [0.7, 3, 0.5], rtol=1e-6)
        assert fit.predict([1.0]).names == ["signal", "rate"]

    def test_times_of_events(self):
        """The impacts of a ball tell its height and gravity."""

        def ball(t, y, g):
            return [y[1], -g]

        def ground(t, y, g):
            return y[0]

        bounce = iv.Event(ground, direction=-1, action=lambda t, y, g: [0.0, -0.8 * y[1]])
        problem = iv.Problem(ball, (0, 3), [2.0, 0.0], args=(9.81,), events=bounce, labels=["height", "v"])
        times = problem.solve("ode45", **TIGHT).t_events[0][:3]
        data = {"ground": [times[0], np.nan, times[2]]}
        one = iv.Experiment(problem.replace(args=(9.0,)), [0.1], {"height": [2 - 9.81 / 200]}, event_times=data)
        fit = iv.fit([one], {"g": (5, 15), "y0[height]": (1, 3)}, **TIGHT)
        np.testing.assert_allclose([*fit.parameters.values()], [9.81, 2.0], rtol=1e-6)
        assert np.isnan(fit.event_residuals["ground"][1])

    def test_times_of_events_alone(self):
        """2 exp(−k t) is 1 at t = ln 2 / k: with t = 1 ± 0.1, k = ln 2 (1 ± 0.1). x and y have no data."""

        def half(t, y, k):
            return y[0] - 1

        problem = iv.Problem(
            lambda t, y, k: [-k * y[0], k * y[0]], (0, 5), [2.0, 0.0], args=(0.5,), labels=["x", "y"], events=[half]
        )
        fit = iv.fit(problem, None, None, {"k": (0.1, 2)}, event_times={"half": [1.0]}, event_sigma=0.1, **TIGHT)
        assert fit.parameters["k"] == pytest.approx(np.log(2), rel=1e-6)
        assert fit.standard_errors["k"] == pytest.approx(0.1 * np.log(2), rel=1e-5)
        assert fit.residuals.shape == (2, 0)
        assert abs(fit.event_residuals["half"][0]) < 1e-5
        assert np.isnan(fit.predict([1.0], noise=True).upper).all()
        assert np.isfinite(fit.predict([1.0]).upper).all()
        with pytest.raises(TypeError, match="needs data, or event_times"):
            iv.Experiment(problem, event_times={})

    def test_events_are_told_apart_by_their_names(self):
        """Functions without names of their own: 2 exp(−k t) is 1 at ln 2 / k and ½ at ln 4 / k."""
        events = [iv.Event(lambda t, y, k, level=level: y[0] - level, name=f"at {level}") for level in (1, 0.5)]
        problem = iv.Problem(lambda t, y, k: [-k * y[0]], (0, 9), [2.0], args=(0.5,), events=events)
        fit = iv.fit(problem, None, None, {"k": (0.1, 2)}, event_times={"at 0.5": [2.0]}, event_sigma=0.1, **TIGHT)
        assert fit.parameters["k"] == pytest.approx(np.log(2), rel=1e-6)
        same = problem.replace(events=[iv.Event(event.fun, name="level") for event in events])
        with pytest.raises(ValueError, match=r"several events have this name: give Event\(name=\)"):
            iv.Experiment(same, event_times={"level": [2.0]})

    def test_a_quantity_without_data(self):
        """Data of x alone are the same with a row of NaN for y, in the fit and in its picture."""
        pytest.importorskip("matplotlib")
        problem = hunting()
        data = noisy(problem, T, 0.05)
        data[0] = np.nan
        fit = iv.fit(problem, T, data, {"a": (0, 5)}, sigma=[[0.1], [0.05]] * np.ones_like(data))
        few = iv.fit(problem, T, data[1:], {"a": (0, 5)}, sigma=0.05, observe="predators")
        assert fit.parameters == pytest.approx(few.parameters, rel=1e-6)
        assert np.isnan(fit.residuals[0]).all()
        fit.plot()

    def test_many_starts_find_the_best_of_several_minima(self):
        """A frequency has many minima; one start falls into a wrong one."""
        problem = iv.Problem(lambda t, y, w: [y[1], -(w**2) * y[0]], (0, 6), [1.0, 0.0], args=(1.0,), labels=["x", "v"])
        t = np.linspace(0.1, 6, 30)
        data = noisy(problem.replace(args=(5.0,)), t, 0)[:1]
        assert abs(iv.fit(problem, t, data, {"w": (0.5, 8)}, observe="x").parameters["w"] - 5) > 1
        fit = iv.fit(problem, t, data, {"w": (0.5, 8)}, observe="x", starts=8)
        assert fit.parameters["w"] == pytest.approx(5, rel=1e-4)
        assert len(fit.starts) == 8
        shared = iv.fit(problem, t, data, {"w": (0.5, 8)}, observe="x", starts=8, workers=2)
        assert shared.starts == fit.starts
        assert (shared.parameters, shared.runs) == (fit.parameters, fit.runs)

    def test_events_end_a_run_that_has_no_other_end(self):
        """The times at which a ball lands; without an end, its impacts would accumulate."""

        def ground(t, y, g):
            return y[0]

        def top(t, y, g):
            return y[1]

        bounce = iv.Event(ground, direction=-1, action=lambda t, y, g: [0.0, -0.8 * y[1]])
        problem = iv.Problem(
            lambda t, y, g: [y[1], -g], (0, np.inf), [2.0, 0.0], args=(9.81,), events=bounce, labels=["height", "v"]
        )
        first = np.sqrt(4 / 9.81)
        times = first * np.array([1, 2.6, 1 + 1.6 * 1.8])
        start = problem.replace(args=(9.0,))
        fit = iv.fit(start, None, None, {"g": (5, 15)}, event_times={"ground": times}, event_sigma=0.01, **TIGHT)
        assert fit.parameters["g"] == pytest.approx(9.81, rel=1e-6)
        assert fit.solution.t_end == pytest.approx(times[-1], rel=1e-6)
        several = start.replace(events=[iv.Event(ground, terminal=True, direction=-1), top])
        data = {"ground": [first], "top": [np.nan]}
        with pytest.raises(ValueError, match="event_times of top"):
            iv.fit(several, None, None, {"g": (5, 15)}, event_times=data, event_sigma=0.01)

    def test_a_model_that_ends_is_drawn_to_its_end(self):
        """Behind a terminal event predictions are NaN, and pictures empty."""
        pytest.importorskip("matplotlib")
        empty = iv.Event(lambda t, y, k, c: y[0] - 0.5, terminal=True)
        problem = decaying().replace(events=empty)
        t = np.linspace(0.1, 1.5, 9)
        fit = iv.fit(problem, t, noisy(problem, t, 0.001), {"k": (0.1, 5)}, **TIGHT)
        band = fit.predict([0.5, 3.0, 4.0, 1.0])
        assert np.isnan(band.y[0]).tolist() == np.isnan(band.upper[0]).tolist() == [False, True, True, False]
        drawn = fit.plot().lines[0].get_xydata()
        assert drawn[np.isfinite(drawn[:, 1]), 0].max() == pytest.approx(fit.solution.t_end, abs=5 / 300)


class TestSteadyStates:
    """Runs that start at a steady state, and leave it when a rate changes at t = 0."""

    START = (0.7, 0.4, 0.3)

    @staticmethod
    def network(t, y, k1, k2, k3):
        """A → B → C → A, of second order in B; k1 is three times as large from t = 0 on."""
        a, b, c = y
        forwards = k1 * (3.0 if t >= 0 else 1.0)
        return [-forwards * a + k2 * c, forwards * a - k3 * b * b, k3 * b * b - k2 * c]

    def problem(self, args=START, y0=(2.0, 0.0, 0.0)):
        return iv.Problem(self.network, (-1, 8), y0, args=args, labels=["a", "b", "c"])

    def long_run(self):
        """Return the state that the system comes to before."""
        before = iv.Problem(lambda t, y, *args: self.network(-1, y, *args), (0, 400), (2.0, 0, 0), args=self.START)
        return before.solve("ode15s", rtol=1e-10, atol=1e-13).y[:, -1]

    def test_known_parameters_and_the_total_come_back(self):
        t = np.linspace(0.4, 8, 12)
        data = self.problem(y0=self.long_run()).solve("ode45", t_eval=t, **STIMULUS).y
        wanted = dict.fromkeys(("k1", "k2", "k3", "y0[a]"), (0.05, 5))
        fit = iv.fit(self.problem((0.5, 0.5, 0.5), (1.5, 0, 0)), t, data, wanted, y0="steady", **STIMULUS)
        np.testing.assert_allclose([*fit.parameters.values()], [*self.START, 2.0], rtol=1e-6)
        np.testing.assert_allclose(fit.solution.y[:, 0], self.long_run(), rtol=1e-6)

    def test_gradient(self):
        """The start depends on the parameters: against central differences."""
        t = np.linspace(0.4, 8, 5)
        wanted = dict.fromkeys(("k1", "k3", "y0[a]"), (0.05, 5))
        log_likelihood = iv.objective(self.problem(), t, np.ones((3, 5)), wanted, sigma=0.3, y0="steady", **STIMULUS)
        x, h = log_likelihood.start, 1e-5
        differences = [(log_likelihood(x + h * e) - log_likelihood(x - h * e)) / (2 * h) for e in np.eye(3)]
        np.testing.assert_allclose(log_likelihood.gradient(x), differences, rtol=1e-6)

    @pytest.mark.parametrize(
        ("fun", "first", "reason"),
        [
            (lambda t, y, k: [k * y[0], -y[1]], 0.0, "not stable"),
            (lambda t, y, k: [k + 0 * y[0], -y[1]], 0.0, "no steady state was found"),
            (lambda t, y, k: -k * (y[0] ** 2 + y[1] ** 2 - 1) * y, 0.1, "not isolated"),
        ],
    )
    def test_what_is_no_steady_state_is_named(self, fun, first, reason):
        """An unstable one, none, and a circle of them."""
        problem = iv.Problem(fun, (0, 1), [first, 0.3], args=(1.0,))
        with pytest.raises(ValueError, match=reason):
            iv.fit(problem, [0.5, 1.0], {"y0": [0.1, 0.2]}, {"k": (0.5, 2)}, y0="steady")

    def test_it_is_the_only_word(self):
        with pytest.raises(ValueError, match="y0 must be one of 'steady'"):
            iv.fit(self.problem(), [1.0], {"a": [1.0]}, {"k1": (0, 5)}, y0="stationary")


class TestLaws:
    def fitted(self, time=1.0, amount=1.0, order=(0, 1), sigma=0.02):
        """A fit with units of time and amount changed, and parameters in another order."""
        true = decaying(2.0 * amount, (0.7 / time, 0.1 * amount / time), 5 * time)
        data = noisy(decaying(), T, 0.02) * amount
        wanted = [("k", iv.Parameter(0.4 / time, (0, 5 / time))), ("c", iv.Parameter(0.2 * amount / time))]
        options = {"rtol": 1e-9, "atol": 1e-12 * amount}
        known = None if sigma is None else sigma * amount
        return iv.fit(true, T * time, data, dict(wanted[i] for i in order), sigma=known, **options)

    @pytest.mark.parametrize("sigma", [None, 0.02])
    def test_units(self, sigma):
        """Other units of time and data change parameters and errors by their units, and nothing else."""
        plain, other = self.fitted(sigma=sigma), self.fitted(1e-3, 1e5, sigma=sigma)
        for name, unit in (("k", 1e3), ("c", 1e8)):
            assert other.parameters[name] == pytest.approx(plain.parameters[name] * unit, rel=1e-5)
            assert other.standard_errors[name] == pytest.approx(plain.standard_errors[name] * unit, rel=1e-4)
        np.testing.assert_allclose(other.correlation, plain.correlation, atol=1e-5)

    def test_the_order_of_parameters(self):
        plain, other = self.fitted(), self.fitted(order=(1, 0))
        np.testing.assert_allclose(other.covariance, plain.covariance[::-1, ::-1], rtol=1e-4)
        assert other.parameters == pytest.approx(plain.parameters, rel=1e-6)

    def test_the_order_of_experiments(self):
        ones = [iv.Experiment(decaying(y0), T, noisy(decaying(y0), T, 0.02, seed), sigma=0.02) for seed, y0 in
                enumerate((2.0, 0.5, 1.0))]  # fmt: skip
        wanted = {"k": (0.1, 5), "c": (0, 1)}
        plain, other = iv.fit(ones, wanted, **TIGHT), iv.fit(ones[::-1], wanted, **TIGHT)
        assert other.parameters == pytest.approx(plain.parameters, rel=1e-6)
        np.testing.assert_allclose(other.covariance, plain.covariance, rtol=1e-5)
        assert other.log_likelihood == pytest.approx(plain.log_likelihood, rel=1e-9)

    def test_ties_are_those_of_the_reduced_model(self):
        """If c = k / 7 the fit is that of the model written with one parameter."""
        data = noisy(decaying(), T, 0.02)
        reduced = iv.Problem(lambda t, y, k: [-k * y[0] + k / 7], (0, 5), [2.0], args=(0.5,))
        one = iv.fit(reduced, T, data, {"k": (0, 5)}, sigma=0.02, **TIGHT)
        tie = iv.Parameter(equals=lambda k: k / 7)
        tied = iv.fit(decaying(args=(0.5, 0.1)), T, data, {"k": (0, 5), "c": tie}, sigma=0.02, **TIGHT)
        assert tied.names == ("k",)
        assert tied.parameters["k"] == pytest.approx(one.parameters["k"], rel=1e-6)
        assert tied.standard_errors["k"] == pytest.approx(one.standard_errors["k"], rel=1e-5)
        assert tied.standard_errors["c"] == pytest.approx(one.standard_errors["k"] / 7, rel=1e-5)
        assert "tied" in repr(tied)

    def test_fixed_values_and_equal_ones(self):
        """A fixed parameter stays; one that equals another has its value and error."""
        problem = iv.Problem(lambda t, y, k, m: [-k * y[0], k * y[0] - m * y[1]], (0, 5), [1.0, 0.0], args=(0.5, 0.9))
        data = noisy(problem.replace(args=(0.6, 0.6)), T, 0)
        wanted = {"k": (0, 5), "m": iv.Parameter(equals="k"), "y0[0]": iv.Parameter(equals=1.0)}
        fit = iv.fit(problem, T, data, wanted, **TIGHT)
        assert fit.parameters == pytest.approx({"k": 0.6, "m": 0.6, "y0[0]": 1.0}, rel=1e-6)
        assert fit.standard_errors["m"] == fit.standard_errors["k"]
        assert fit.standard_errors["y0[0]"] == 0

    def test_missing_data_are_data_left_out(self):
        data = noisy(hunting(), T, 0.05)
        data[1, 2:] = np.nan
        whole = iv.fit(hunting(), T, data, {"a": (0, 5)}, sigma=0.05, **TIGHT)
        few = iv.Experiment(hunting(), T[:2], dict(zip(hunting().labels, data[:, :2], strict=True)), sigma=0.05)
        rest = iv.Experiment(hunting(), T[2:], data[:1, 2:], observe=["prey"], sigma=0.05)
        parts = iv.fit([few, rest], {"a": (0, 5)}, **TIGHT)
        assert parts.parameters["a"] == pytest.approx(whole.parameters["a"], rel=1e-6)
        assert np.isnan(whole.residuals[1, 2:]).all()


class TestLinearTheory:
    def test_covariance_of_a_linear_model(self):
        """σ² (XᵀX)⁻¹ with a known sigma, s² (XᵀX)⁻¹ with an unknown one; intervals by normal and t quantiles."""
        inverse = np.linalg.inv(X.T @ X)
        best = inverse @ X.T @ LINE_DATA[0]
        s2 = np.sum((X @ best - LINE_DATA[0]) ** 2) / (len(T) - 2)
        for sigma, variance, q in ((0.1, 0.01, stats.norm.ppf(0.975)), (None, s2, stats.t.ppf(0.975, len(T) - 2))):
            fit = iv.fit(straight(), T, LINE_DATA, LINE, sigma=sigma)
            np.testing.assert_allclose([*fit.parameters.values()], best, rtol=1e-6)
            np.testing.assert_allclose(fit.covariance, variance * inverse, rtol=1e-6)
            np.testing.assert_allclose(fit.covariance @ fit.fisher, np.eye(2), atol=1e-8)
            low, high = fit.confidence()["slope"]
            assert (high - low) / 2 == pytest.approx(q * np.sqrt(variance * inverse[1, 1]), rel=1e-6)
        assert fit.sigma == pytest.approx(np.sqrt(s2), rel=1e-6)

    def test_relative_sigma_is_that_of_curve_fit(self):
        sigma = 0.05 + 0.01 * T
        fit = iv.fit(straight(), T, LINE_DATA, LINE, sigma=sigma, absolute_sigma=False)
        best, covariance = curve_fit(lambda t, a, b: a + b * t, T, LINE_DATA[0], sigma=sigma)
        np.testing.assert_allclose([*fit.parameters.values()], best, rtol=1e-6)
        np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-5)

    def test_profiles_of_a_linear_model_are_its_intervals(self):
        for sigma in (0.1, None):
            fit = iv.fit(straight(), T, LINE_DATA, LINE, sigma=sigma)
            profile = fit.profile("slope")
            assert (profile.lower, profile.upper) == pytest.approx(fit.confidence()["slope"], rel=1e-3)
            slope = np.polyfit(profile.values, profile.statistic, 1)[0]
            assert slope * fit.standard_errors["slope"] == pytest.approx(1, rel=1e-3)

    def test_profiles_do_not_depend_on_the_scale(self):
        """k and ln k have one interval, as quantiles of the likelihood ratio say."""
        data = noisy(decaying(), T[::3], 0.2)
        ends = []
        for scale in ("linear", "log"):
            fit = iv.fit(decaying(), T[::3], data, {"k": iv.Parameter(0.5, (1e-3, 20), scale=scale)}, sigma=0.2)
            profile = fit.profile("k")
            ends.append((profile.lower, profile.upper))
        assert ends[0] == pytest.approx(ends[1], rel=2e-3)
        log_likelihood = iv.objective(decaying(), T[::3], data, {"k": (1e-3, 20)}, sigma=0.2)
        fell = [2 * (fit.log_likelihood - log_likelihood([one])) for one in ends[0]]
        assert fell == pytest.approx([stats.chi2.ppf(0.95, 1)] * 2, rel=5e-3)

    def test_bands_of_a_linear_model(self):
        fit = iv.fit(straight(), T, LINE_DATA, LINE, sigma=0.1)
        x = np.array([1.0, 4.5])
        errors = 0.1 * np.sqrt(x @ np.linalg.inv(X.T @ X) @ x)
        band, wide = fit.predict([4.5]), fit.predict([4.5], noise=True)
        assert band.standard_error[0, 0] == pytest.approx(errors, rel=1e-6)
        q = stats.norm.ppf(0.975)
        assert (wide.upper - wide.y)[0, 0] == pytest.approx(q * np.hypot(errors, 0.1), rel=1e-6)

    def test_a_prior_is_one_more_datum(self):
        """Normal about 0.6 with width 0.02: the row (0, 1) / 0.02 of X / σ."""
        prior = {**LINE, "slope": iv.Parameter(1.0, prior=(0.6, 0.02))}
        fit = iv.fit(straight(), T, LINE_DATA, prior, sigma=0.1)
        rows = np.vstack([X / 0.1, [0, 1 / 0.02]])
        inverse = np.linalg.inv(rows.T @ rows)
        np.testing.assert_allclose(fit.covariance, inverse, rtol=1e-6)
        best = inverse @ rows.T @ np.append(LINE_DATA[0] / 0.1, 0.6 / 0.02)
        np.testing.assert_allclose([*fit.parameters.values()], best, rtol=1e-6)

    def test_a_prior_beside_a_noise_level(self):
        """The level is the size of the residuals; the posterior is that of this level."""
        prior = {**LINE, "slope": iv.Parameter(1.0, prior=(0.6, 0.02)), "s": (1e-3, 10)}
        fit = iv.fit(straight(), T, LINE_DATA, prior, sigma="s")
        level = fit.parameters["s"]
        assert level == pytest.approx(np.sqrt(np.mean((fit.predict(T).y - LINE_DATA) ** 2)), rel=1e-4)
        known = iv.fit(straight(), T, LINE_DATA, {name: prior[name] for name in LINE}, sigma=level)
        assert fit.parameters["slope"] == pytest.approx(known.parameters["slope"], rel=1e-5)
        width = level * np.sqrt(len(T) / (len(T) - 2))  # the prior keeps its own width
        rows = np.vstack([X / width, [0, 1 / 0.02]])
        np.testing.assert_allclose(fit.covariance[:2, :2], np.linalg.inv(rows.T @ rows), rtol=1e-4)

    @pytest.mark.parametrize("options", [{}, {"sigma": 0.5, "absolute_sigma": False}])
    def test_a_prior_beside_an_unknown_sigma(self, options):
        """The sigma is a noise level, whose name need not be given."""
        prior = {**LINE, "slope": iv.Parameter(1.0, prior=(0.6, 0.02))}
        fit = iv.fit(straight(), T, LINE_DATA, prior, **options)
        named = iv.fit(straight(), T, LINE_DATA, {**prior, "s": iv.Parameter()}, sigma="s")
        unit = options.get("sigma", 1.0)
        assert fit.names == ("y0[y]", "slope", "sigma")
        expected = [*named.parameters.values()]
        np.testing.assert_allclose([*fit.parameters.values()], [*expected[:2], expected[2] / unit], rtol=1e-5)
        np.testing.assert_allclose(fit.covariance[:2, :2], named.covariance[:2, :2], rtol=1e-4)
        assert fit.sigma == pytest.approx(expected[2] / unit * np.sqrt(len(T) / (len(T) - 2)), rel=1e-5)

    def test_a_log_normal_prior_has_the_same_mode_in_any_scale(self):
        """That of ln p. A pair means it with scale="log", a name in any scale, and so does its residual."""
        priors = [
            iv.Parameter(1.0, scale="log", prior=(0.6, 0.05)),
            iv.Parameter(1.0, scale="log", prior=("lognormal", 0.6, 0.05)),
            iv.Parameter(1.0, prior=("lognormal", 0.6, 0.05)),
            iv.Parameter(1.0, prior=lambda p: np.log(p / 0.6) / 0.05),
        ]
        fits = [iv.fit(straight(), T, LINE_DATA, {**LINE, "slope": one}, sigma=0.1) for one in priors]
        slope = fits[0].parameters["slope"]

        def cost(slope):
            best = np.mean(LINE_DATA[0] - slope * T)
            return np.sum((best + slope * T - LINE_DATA[0]) ** 2) / 0.01 + (np.log(slope / 0.6) / 0.05) ** 2

        assert cost(slope) <= min(cost(slope * (1 + 1e-5)), cost(slope * (1 - 1e-5)))
        for fit in fits[1:]:
            assert fit.parameters == pytest.approx(fits[0].parameters, rel=1e-6)
            np.testing.assert_allclose(fit.covariance, fits[0].covariance, rtol=1e-4)

    def test_wrong_priors_are_named(self):
        for prior, error, message in (
            (("gamma", 1.0, 0.1), ValueError, "the kind of a prior must be"),
            (("lognormal", -1.0, 0.1), ValueError, "must be about a positive value"),
            (0.6, TypeError, "prior of a Parameter must be"),
        ):
            with pytest.raises(error, match=message):
                iv.Parameter(prior=prior)
        with pytest.raises(ValueError, match="slope starts at -1"):
            iv.fit(straight(), T, LINE_DATA, {"slope": iv.Parameter(-1.0, prior=("lognormal", 0.6, 0.1))}, sigma=0.1)

    def test_a_normal_prior_of_a_parameter_in_logarithms(self):
        plain = iv.Parameter(1.0, prior=(0.6, 0.02))
        logs = iv.Parameter(1.0, scale="log", prior=("normal", 0.6, 0.02))
        one, other = (iv.fit(straight(), T, LINE_DATA, {**LINE, "slope": p}, sigma=0.1) for p in (plain, logs))
        assert one.parameters == pytest.approx(other.parameters, rel=1e-6)

    @pytest.mark.filterwarnings("ignore:fit. the derivatives of a prior are differences")
    @pytest.mark.parametrize(
        "prior",
        [
            ("lognormal", 0.6, 0.05),
            ("normal", 0.6, 0.05),
            lambda p: (p**2 - 0.3) / 0.1,
            lambda p: abs(p - 0.3) / 0.1,
            lambda p: math.log(math.fsum([p]) / 0.6) / 0.05,  # neither traced nor complex
        ],
    )
    def test_the_gradient_of_a_prior(self, prior):
        """Against differences, whose error is about 1e-8."""
        target = iv.objective(straight(), T, LINE_DATA, {**LINE, "slope": iv.Parameter(0.7, prior=prior)}, sigma=0.1)
        x = np.array([1.1, 0.55])
        differences = [(target(x + h) - target(x - h)) / 2e-5 for h in 1e-5 * np.eye(2)]
        np.testing.assert_allclose(target.gradient(x), differences, rtol=1e-6)

    def test_profiles_with_a_prior(self):
        """For a linear model with a known sigma they are the intervals; beside a noise level, the likelihood ratio of
        the data counts per degree of freedom, and the prior as it is."""
        prior = {**LINE, "slope": iv.Parameter(1.0, prior=(0.6, 0.02))}
        fit = iv.fit(straight(), T, LINE_DATA, prior, sigma=0.1)
        profile = fit.profile("slope")
        assert (profile.lower, profile.upper) == pytest.approx(fit.confidence()["slope"], rel=1e-3)
        fit = iv.fit(straight(), T, LINE_DATA, prior)
        profile = fit.profile("slope")
        ends, best = np.array([profile.lower, profile.upper]), fit.parameters["slope"]

        def squares(slope):
            rest = LINE_DATA[0] - slope * T
            return np.sum((rest - rest.mean()) ** 2)

        degrees = len(T) - 2
        data = [degrees * np.log(squares(end) / squares(best)) for end in ends]
        expected = data + ((ends - 0.6) / 0.02) ** 2 - ((best - 0.6) / 0.02) ** 2
        np.testing.assert_allclose(np.sqrt(expected), stats.t.ppf(0.975, degrees), rtol=3e-3)

    def test_a_noise_level_at_its_bound(self):
        """The noise level is named, and the others have the errors that they have with sigma known to be there."""
        with pytest.warns(UserWarning, match=r"s is at its upper bound, 0\.05"):
            fit = iv.fit(straight(), T, LINE_DATA, {**LINE, "s": iv.Parameter(bounds=(1e-3, 0.05))}, sigma="s")
        assert fit.at_bound == [("s", "upper", 0.05)]
        known = iv.fit(straight(), T, LINE_DATA, LINE, sigma=0.05)
        np.testing.assert_allclose(fit.covariance[:2, :2], known.covariance, rtol=1e-6)
        with pytest.warns(UserWarning, match=r"s is at its lower bound, 1"):
            iv.fit(straight(), T, LINE_DATA, {**LINE, "s": iv.Parameter(bounds=(1.0, 10.0))}, sigma="s")

    def test_noise_levels_are_those_of_the_residuals(self):
        """Noise levels maximise the likelihood: σ² = Σ r² / N of each group; 2 N is their information of ln σ."""
        data = noisy(hunting(), T, np.array([[0.05], [0.2]]))
        wanted = {"a": (0, 5), "quiet": (1e-4, 10), "loud": iv.Parameter(5.0)}
        fit = iv.fit(hunting(), T, data, wanted, sigma=["quiet", "loud"], **TIGHT)
        sizes = np.sqrt(np.mean((fit.predict(T).y - data) ** 2, axis=1))
        np.testing.assert_allclose([fit.parameters["quiet"], fit.parameters["loud"]], sizes, rtol=1e-4)
        expected = fit.parameters["loud"] * np.sqrt(2 * len(T) / fit.degrees_of_freedom / (2 * len(T)))
        assert fit.standard_errors["loud"] == pytest.approx(expected, rel=1e-4)
        gradient = iv.objective(hunting(), T, data, wanted, sigma=["quiet", "loud"], **TIGHT).gradient(
            [*fit.parameters.values()]
        )
        assert np.abs(gradient * [*fit.standard_errors.values()]).max() < 1e-3

    def test_log_normal_noise_is_normal_of_logarithms(self):
        """ln y = ln y₀ − k t is a straight line in its parameters."""
        problem = iv.Problem(lambda t, y, k: -k * y, (0, 5), [2.0], args=(1.0,), labels=["y"])
        rng = np.random.default_rng(3)
        data = 2 * np.exp(-0.8 * T + 0.1 * rng.normal(size=len(T)))
        fit = iv.fit(problem, T, data, {"y0[y]": iv.Parameter(scale="log"), "k": (0, 5)}, sigma=0.1, noise="lognormal")
        best, covariance = np.polyfit(T, np.log(data), 1), 0.01 * np.linalg.inv(X.T @ X)
        assert fit.parameters == pytest.approx({"y0[y]": np.exp(best[1]), "k": -best[0]}, rel=1e-4)
        assert fit.standard_errors["k"] == pytest.approx(np.sqrt(covariance[1, 1]), rel=1e-4)
        likelihood = stats.lognorm.logpdf(data, 0.1, scale=np.exp(np.polyval(best, T))).sum()
        assert fit.log_likelihood == pytest.approx(likelihood, rel=1e-5)

    def test_a_robust_loss_is_that_of_scipy(self):
        data = LINE_DATA.copy()
        data[0, 5] += 3
        fit = iv.fit(straight(), T, data, LINE, sigma=0.1, loss="soft_l1")
        best, _ = curve_fit(
            lambda t, a, b: a + b * t, T, data[0], sigma=np.full(len(T), 0.1), loss="soft_l1", method="trf"
        )
        np.testing.assert_allclose([*fit.parameters.values()], best, rtol=1e-4)
        assert fit.log_likelihood is None
        assert np.isnan(fit.reduced_chi_squared)
        assert "χ²/ν" not in repr(fit)

    def test_coverage_of_intervals(self):
        """95 % of 60 fits with fixed seeds contain the truth, up to three standard deviations of that count."""
        inside = 0
        for seed in range(60):
            data = noisy(decaying(), T, 0.1, seed)
            fit = iv.fit(decaying(), T, data, {"k": (0.01, 5), "c": (-2, 2)}, rtol=1e-5, atol=1e-8)
            low, high = fit.confidence()["k"]
            inside += low <= 0.7 <= high
        assert abs(inside - 57) <= 3 * np.sqrt(60 * 0.95 * 0.05)


class TestDerivatives:
    def test_of_observe_by_differences_only_with_a_warning(self):
        def observe(t, y, slope):
            return abs(complex(y[0]))

        with pytest.warns(iv.AccuracyWarning, match="derivatives of observe are differences"):
            fit = iv.fit(straight(), T, LINE_DATA, LINE, observe=observe)
        plain = iv.fit(straight(), T, LINE_DATA, LINE)
        assert fit.parameters == pytest.approx(plain.parameters, rel=1e-5)


class TestObjective:
    def test_gradient(self):
        """Against central differences, for priors, log scales, noise levels and log-normal data too."""
        data = np.abs(noisy(hunting(), T, 0.1)) + 0.1
        wanted = {
            "a": iv.Parameter(1.4, (0.1, 5), scale="log", prior=(1.5, 0.2)),
            "c": iv.Parameter(3.1, prior=(3, 0.5)),
            "y0[prey]": iv.Parameter(1.1),
            "s": iv.Parameter(0.3),
        }
        tight = {"rtol": 1e-11, "atol": 1e-13, "method": "dop853"}
        for noise in ("normal", "lognormal"):
            log_likelihood = iv.objective(hunting(), T, data, wanted, sigma=[0.2, "s"], noise=noise, **tight)
            x, h = log_likelihood.start, 1e-5
            differences = [(log_likelihood(x + h * e) - log_likelihood(x - h * e)) / (2 * h) for e in np.eye(4)]
            np.testing.assert_allclose(log_likelihood.gradient(x), differences, rtol=1e-5)

    def test_it_is_the_likelihood_of_the_fit(self):
        for sigma in (0.1, None):
            fit = iv.fit(straight(), T, LINE_DATA, LINE, sigma=sigma)
            log_likelihood = iv.objective(straight(), T, LINE_DATA, LINE, sigma=sigma)
            best = [*fit.parameters.values()]
            assert log_likelihood(best) == pytest.approx(fit.log_likelihood)
            assert np.abs(log_likelihood.gradient(best) * [*fit.standard_errors.values()]).max() < 1e-3
        assert stats.norm.logpdf(LINE_DATA[0], X @ best, fit.sigma * np.sqrt(10 / 12)).sum() == pytest.approx(
            fit.log_likelihood
        )

    def test_outside_the_bounds_it_is_impossible(self):
        log_likelihood = iv.objective(straight(), T, LINE_DATA, {"slope": (0, 1)}, sigma=0.1)
        assert log_likelihood([2.0]) == -np.inf
        assert np.isnan(log_likelihood.gradient([2.0])).all()
        with pytest.raises(ValueError, match="x must hold the 1 parameters slope"):
            log_likelihood([1.0, 2.0])


def test_a_run_has_failed_after_the_largest_number_of_steps():
    """A search refuses steps to parameters whose runs take more than 10,000 steps, as those towards a singularity do,
    and an error names the limit if the first run does; options of a fit or of an experiment replace it."""
    t, y = np.linspace(0.1, 0.4, 4), np.exp(0.1 * np.linspace(0.1, 0.4, 4))
    problem = iv.Problem(lambda t, y, k: [-k * (y[0] - t)], (0, 0.4), [1.0], args=(1e6,))
    given = t, y[None, :], {"k": iv.Parameter(start=1e6)}
    with pytest.raises(ValueError, match="10000"):
        iv.fit(problem, *given, sigma=0.1)
    few = {"max_steps": 20}
    for experiment, options in (({}, few), (few, {}), (few, {"max_steps": 9})):
        one = iv.Experiment(problem.replace(args=(1e3,)), t=t, data=y[None, :], sigma=0.1, **experiment)
        with pytest.raises(ValueError, match="20"):
            iv.fit(one, {"k": iv.Parameter(start=1e3)}, **options)
    one = iv.Experiment(problem.replace(args=(1e3,)), t=t, data=y[None, :], sigma=0.1, limits=iv.Limits(time=60))
    assert iv.fit(one, {"k": iv.Parameter(start=1e3)}, max_steps=20).failures == {}
