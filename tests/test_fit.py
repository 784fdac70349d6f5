"""Fits: known parameters come back, units and order do not matter, errors are those of the linear theory."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import curve_fit

import invariode as iv

T = np.linspace(0.2, 4, 12)
TIGHT = {"rtol": 1e-9, "atol": 1e-12}
STIMULUS = {**TIGHT, "breakpoints": [0.0]}


def line(t, y, slope):
    return [slope]


def decay(t, y, k, c):
    return [-k * y[0] + c]


def volterra(t, y, a, b, c, d):
    return [a * y[0] - b * y[0] * y[1], -c * y[1] + d * y[0] * y[1]]


def straight(**options):
    """y = y0 + slope t, linear in both."""
    return iv.Problem(line, (0, 5), [1.0], args=(0.5,), labels=["y"], **options)


def decaying(y0=2.0, args=(0.7, 0.1), tf=5.0):
    return iv.Problem(decay, (0, tf), [y0], args=args, labels=["x"])


def hunting():
    return iv.Problem(volterra, (0, 6), [1.0, 1.0], args=(1.5, 1.0, 3.0, 1.0), labels=["prey", "predators"])


def noisy(problem, t, sigma, seed=5):
    y = problem.solve("dop853", t_eval=t, rtol=1e-11, atol=1e-13).y
    return y + sigma * np.random.default_rng(seed).normal(size=y.shape)


X = np.column_stack([np.ones_like(T), T])  # of the straight line, for (y0, slope)
LINE = {"y0[y]": iv.Parameter(0.0), "slope": iv.Parameter(1.0)}
LINE_DATA = noisy(straight(), T, 0.1)


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
        """With c = k / 7 the fit is that of the model written with one parameter."""
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
        """It is a noise level, whose name need not be given."""
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
        """It is named, and the others have the errors that they have with sigma known to be there."""
        with pytest.warns(UserWarning, match=r"s is at its upper bound, 0\.05"):
            fit = iv.fit(straight(), T, LINE_DATA, {**LINE, "s": iv.Parameter(bounds=(1e-3, 0.05))}, sigma="s")
        assert fit.at_bound == [("s", "upper", 0.05)]
        known = iv.fit(straight(), T, LINE_DATA, LINE, sigma=0.05)
        np.testing.assert_allclose(fit.covariance[:2, :2], known.covariance, rtol=1e-6)
        with pytest.warns(UserWarning, match=r"s is at its lower bound, 1"):
            iv.fit(straight(), T, LINE_DATA, {**LINE, "s": iv.Parameter(bounds=(1.0, 10.0))}, sigma="s")

    def test_noise_levels_are_those_of_the_residuals(self):
        """Their maximum likelihood: σ² = Σ r² / N of each group; and twice N is their information of ln σ."""
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
        """Also from a trial, where f is called as it was compiled."""

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
        """It is named, and the others have the errors that they have with it fixed there."""
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
            ((T, LINE_DATA, {"slop": (0, 1)}), {}, "takes a parameter 'slop': .*did you mean 'slope'"),
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
            ((T, LINE_DATA, LINE), {"sigma": {"x": 1}}, "sigma names 'x'.*: there are y"),
            ((T, LINE_DATA, LINE), {"sigma": {}}, "sigma is missing for y"),
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
            (None, table.set_index("day")[["predators", "prey"]]),
            (None, labelled),
            (None, labelled.to_dataset(name="y")),
            (None, labelled.to_dataset("component")),
        ]
        found = [iv.objective(problem, t, one, {"a": (0, 5)}, sigma=0.05)([1.4]) for t, one in forms]
        assert found == pytest.approx([found[0]] * len(forms), rel=1e-12)

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
