"""Fits with noise as a formula, starts that depend on parameters or are sampled, and what a fit remarks on."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv

T = np.linspace(0.2, 4, 12)


class TestRemarks:
    def test_an_interval_wider_than_its_bounds_and_a_symmetric_start_are_remarked(self) -> None:
        """The interval is no warning; a search that stalls at k = 0 of a model in k² is one."""
        data = np.exp(-0.49 * T)
        square = iv.Problem(lambda t, y, k: [-k * k * y[0]], (0, 4), [1.0], args=(1.0,))
        wide = iv.fit(square, T, data, {"k": iv.Parameter(0.8, (0.5, 1.0))}, sigma=1.0)
        assert wide.remarks == ["the 95 % interval of k is wider than its bounds: use profile('k')"]
        assert wide.remarks[0] in repr(wide)
        profile = wide.profile("k")
        assert (profile.lower, profile.upper) == (0.5, 1.0)
        assert iv.fit(square, T, data, {"k": iv.Parameter(0.8, (0.5, 1.0))}, sigma=0.001).remarks == []
        with pytest.warns(UserWarning, match="give k other starts, or starts=10"):
            stalled = iv.fit(square, T, data, {"k": iv.Parameter(0.0, (-5, 5))}, sigma=0.01)
        assert stalled.parameters["k"] == 0
        found = iv.fit(square, T, data, {"k": iv.Parameter(0.0, (-5, 5))}, sigma=0.01, starts=10)
        assert abs(found.parameters["k"]) == pytest.approx(0.7, rel=1e-5)

    def test_a_table_stands_in_the_place_of_times_and_data(self) -> None:
        pd = pytest.importorskip("pandas")
        xr = pytest.importorskip("xarray")
        problem = iv.Problem(lambda t, y, k: [-k * y[0]], (0, 4), [2.0], args=(1.0,), labels=["drug"])
        values = 2 * np.exp(-0.5 * T) + 0.01 * np.cos(7 * T)
        want = {"k": (0.1, 3)}
        expected = iv.fit(problem, T, values, want, sigma=0.1).parameters
        table = pd.DataFrame({"time": T, "drug": values})
        tables = [
            table, table.set_index("time"), table.rename(columns={"time": "t"}), {"t": T, "drug": values},
            xr.Dataset({"drug": ("t", values)}, {"t": T}),
        ]  # fmt: skip
        for data in tables:
            assert iv.fit(problem, data, want, sigma=0.1).parameters == expected
            assert iv.fit(problem, data, parameters=want, sigma=0.1).parameters == expected
            assert iv.fit([iv.Experiment(problem, data, sigma=0.1)], want).parameters == expected
        with pytest.raises(TypeError, match="t is a table of data, and data were given too"):
            iv.fit(problem, table, values, want)
        with pytest.raises(TypeError, match="parameters must be a dict of names"):
            iv.fit(problem, table, sigma=0.1)
        with pytest.raises(TypeError, match="unknown option 'sigmas'; did you mean 'sigma'"):
            iv.fit(problem, table, want, sigmas=0.1)


class TestNoise:
    """Noise as a formula, and Laplace's distribution: the likelihood is that of the density, and its gradient that of
    differences."""

    T = np.linspace(0.5, 4, 8)

    @staticmethod
    def problem():
        return iv.Problem(lambda t, y, k: [-k * y[0]], (0, 4), [2.0], args=(0.7,), labels=["x"])

    @staticmethod
    def sigma(t, y, k, *, offset, relative=0.1):
        """Noise of a constant and a relative part."""
        return offset + relative * y[0]

    @pytest.mark.parametrize("noise", ["normal", "lognormal", "laplace", "loglaplace"])
    def test_likelihood_of_a_formula(self, noise):
        data = 2 * np.exp(-0.7 * self.T) * (1 + 0.1 * np.random.default_rng(1).standard_normal(8))
        wanted = {"k": (0.1, 3), "offset": iv.Parameter(0.05, (1e-3, 1), "log"), "relative": (0.01, 1)}
        o = iv.objective(
            self.problem(), self.T, data[None], wanted, sigma=self.sigma, noise=noise, rtol=1e-10, atol=1e-13
        )
        x = np.array([0.8, 0.06, 0.2])
        model = 2 * np.exp(-0.8 * self.T)
        s = 0.06 + 0.2 * model
        log = noise.startswith("log")
        r = (np.log(data / model) if log else data - model) / s
        density = (
            -np.abs(r) - np.log(2 * s) if "laplace" in noise else -0.5 * r**2 - np.log(s) - 0.5 * np.log(2 * np.pi)
        )
        assert o(x) == pytest.approx(np.sum(density - (np.log(data) if log else 0)), rel=1e-8)
        h = 1e-6
        slopes = [(o(x + h * e) - o(x - h * e)) / (2 * h) for e in np.eye(3)]
        np.testing.assert_allclose(o.gradient(x), slopes, rtol=1e-6)

    def test_laplace_noise_resists_outliers(self):
        """Under Laplace noise the estimate is near the truth in spite of an outlier; under normal noise it is not."""
        data = 2 * np.exp(-0.7 * self.T)
        data[3] += 1.0
        found = {
            noise: iv.fit(self.problem(), self.T, data[None], {"k": (0.1, 3)}, sigma=0.02, noise=noise).parameters["k"]
            for noise in ("normal", "laplace")
        }
        assert abs(found["laplace"] - 0.7) < 1e-3 < 0.03 < abs(found["normal"] - 0.7)

    def test_a_formula_of_each_quantity(self):
        """One value holds for all quantities, several are those of each; a wrong number of them is named."""
        problem = iv.Problem(lambda t, y, k: [-k * y[0], k * y[0]], (0, 4), [2.0, 0.0], args=(0.7,))
        data = np.vstack([2 * np.exp(-0.7 * self.T), 2 - 2 * np.exp(-0.7 * self.T)]) + 0.01
        values = []
        for sigma in (lambda t, y, k, *, s: s, lambda t, y, k, *, s: [s, s]):
            o = iv.objective(problem, self.T, data, {"k": (0.1, 2), "s": (0.01, 1)}, sigma=sigma)
            values.append(o([0.7, 0.2]))
        known = iv.objective(problem, self.T, data, {"k": (0.1, 2)}, sigma=0.2)([0.7])
        assert values == [pytest.approx(known)] * 2
        with pytest.raises(ValueError, match="sigma returns 3 values, and 2 quantities"):
            iv.objective(problem, self.T, data, {"k": (0.1, 2)}, sigma=lambda t, y, k: [1.0, 1.0, 1.0])
        with pytest.raises(ValueError, match="Laplace noise needs a sigma"):
            iv.fit(problem, self.T, data, {"k": (0.1, 2)}, noise="laplace")

    def test_laplace_priors(self):
        """The prior's part of the gradient is the derivative of its density."""
        data = 2 * np.exp(-0.7 * self.T)[None]
        for prior in (("laplace", 0.6, 0.1), ("loglaplace", 0.6, 0.2)):
            o = iv.objective(self.problem(), self.T, data, {"k": iv.Parameter(prior=prior)}, sigma=0.3)
            plain = iv.objective(self.problem(), self.T, data, {"k": (0.1, 2)}, sigma=0.3)
            z = (np.log(0.8 / 0.6) if "log" in prior[0] else 0.2) / prior[2]
            density = -z - np.log(2 * prior[2]) - (np.log(0.8) if "log" in prior[0] else 0)
            assert o([0.8]) - plain([0.8]) == pytest.approx(density)
            h = 1e-6
            assert o.gradient([0.8])[0] == pytest.approx((o([0.8 + h]) - o([0.8 - h])) / (2 * h), rel=1e-5)


class TestStarts:
    """Initial values as functions of parameters, pre-equilibration, and data in the steady state."""

    @staticmethod
    def isomers(t, y, k, l, total):  # noqa: E741 - the rates back and forth
        """A and B in equilibrium, which goes on."""
        v = k * y[0] - l * y[1]
        return [-v, v]

    def problem(self):
        return iv.Problem(self.isomers, (0, 5), [1.0, 0.0], args=(2.0, 1.0, 3.0), labels=["A", "B"])

    def b(self, k, l, t, start, total):  # noqa: E741
        """The exact solution for B."""
        rest = total * k / (k + l)
        return rest + (start - rest) * np.exp(-(k + l) * t)

    @pytest.mark.parametrize("method", ["ode45", "radau"])
    def test_pre_equilibration(self, method):
        """Values and gradient are those of the exact solution: from the equilibrium with k_before, A reset, and then at
        all times and in the steady state."""
        t = np.array([0.0, 0.3, 1.0, np.inf])
        data = np.array([[0.4, 0.5, 0.6, 0.7]])
        experiment = iv.Experiment(
            self.problem(),
            t,
            data,
            observe="B",
            sigma=0.1,
            y0=lambda t0, y, k, l, total: [total, 0 * total],  # noqa: E741
            where={"k": "k_after"},
            before={"k": "k_before"},
            resets="A",
            method=method,
        )
        wanted = {"k_before": (0.1, 5), "k_after": (0.1, 5), "l": (0.1, 5), "total": (0.1, 5)}
        o = iv.objective([experiment], wanted, rtol=1e-10, atol=1e-13)
        assert o.names == ("k_before", "k_after", "l", "total")

        def exact(x):
            before, after, l, total = x  # noqa: E741
            b0 = total * before / (before + l)
            whole = total + b0  # A is reset to the total
            model = [self.b(after, l, s, b0, whole) for s in t[:3]] + [whole * after / (after + l)]
            return -0.5 * np.sum(((data[0] - model) / 0.1) ** 2) - 4 * np.log(0.1 * np.sqrt(2 * np.pi))

        x, h = np.array([0.5, 2.0, 1.0, 0.8]), 1e-5
        assert o(x) == pytest.approx(exact(x), rel=1e-7)
        slopes = [(exact(x + h * e) - exact(x - h * e)) / (2 * h) for e in np.eye(4)]
        np.testing.assert_allclose(o.gradient(x), slopes, rtol=1e-6)

    def test_one_name_for_several_numbers(self):
        """A parameter may set several numbers: rates and an initial value here."""
        t = np.array([0.3, 1.0, 2.0])
        where = {"k": "a", "l": "a", "y0[A]": "a"}
        experiment = iv.Experiment(self.problem(), t, [[0.2, 0.3, 0.4]], observe="B", sigma=0.1, where=where)
        o = iv.objective([experiment], {"a": (0.1, 3)}, rtol=1e-10, atol=1e-13)

        def exact(a):
            return -0.5 * np.sum(((np.array([0.2, 0.3, 0.4]) - self.b(a, a, t, 0, a)) / 0.1) ** 2)

        h = 1e-5
        assert o([0.8]) - o([0.7]) == pytest.approx(exact(0.8) - exact(0.7), rel=1e-7)
        assert o.gradient([0.8])[0] == pytest.approx((exact(0.8 + h) - exact(0.8 - h)) / (2 * h), rel=1e-6)

    def test_what_is_wrong_is_named(self):
        t, data = [0.0, 1.0], [[0.1, 0.2]]
        for given, message in (
            ({"resets": "A"}, "resets is about the steady state"),
            ({"before": {}, "resets": "C"}, "no component 'C' to reset"),
            ({"before": {}, "y0": "steady"}, "two steady states"),
            ({"before": {"q": 1.0}}, "before"),
            ({"noise": "gauss"}, "noise"),
        ):
            with pytest.raises((TypeError, ValueError), match=message):
                iv.Experiment(self.problem(), t, data, observe="B", sigma=0.1, **given)
        with pytest.raises(ValueError, match="y0 returns 1 initial values"):
            iv.objective(
                [iv.Experiment(self.problem(), t, data, observe="B", sigma=0.1, y0=lambda t, y, k, l, s: [s])],  # noqa: E741
                {"k": (0.1, 2)},
            )


def test_data_at_the_time_of_an_action_are_counted():
    """They are compared with the state after it, which is said: samples are usually taken before a dose."""
    problem = iv.Problem(
        lambda t, y, k: [-k * y[0]], (0, 3), [1.0], args=(1.0,), breakpoints={1.0: lambda t, y, k: y + 1}
    )
    t = np.array([0.5, 1.0, 1.5, 2.5])
    fit = iv.fit(problem, t, np.exp(-t) + np.where(t >= 1, np.exp(1 - t), 0), {"k": (0.1, 9)}, sigma=0.1)
    assert fit.parameters["k"] == pytest.approx(1.0, rel=1e-4)
    assert any("(1 of 4)" in one for one in fit.remarks)
