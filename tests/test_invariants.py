"""Invariants look after themselves: derivatives, the check before the run, the drift, when to project."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt, explicit_and_implicit
from gallery import GALLERY, REDUNDANT
from problems import PROBLEMS, kepler, kepler_invariants, kepler_jacobian

pytestmark = pytest.mark.filterwarnings("ignore:.*redundant:UserWarning")


@pytest.fixture(scope="module")
def references():
    return {
        name: iv.ode113(p.fun, p.t_span, p.y0, rtol=1e-13, atol=1e-14, max_step=np.inf).y[:, -1]
        for name, p in GALLERY.items()
    }


@dealt(method=FAMILIES, name=GALLERY)
@pytest.mark.filterwarnings("ignore::invariode.AccuracyWarning")
def test_automatic_jacobians_are_as_good_as_analytic_ones(method, name, references):
    p = GALLERY[name]
    rtol = 1e-6 if iv.METHODS[method].order > 3 else 1e-4  # below order 4, steps are many

    def error(jac):
        invariants = iv.Invariants(p.g, jac, p.value)
        sol = iv.solve_ivp(p.fun, p.t_span, p.y0, method, invariants=invariants, rtol=rtol, atol=1e-3 * rtol)
        return np.abs(sol.y[:, -1] - references[name]).max()

    given = error(p.jac)
    for kind in (None, "3-point", "2-point"):
        assert error(kind) <= 3 * given, kind


@dealt(method=FAMILIES, name=GALLERY)
def test_no_warnings_but_the_right_ones(method, name):
    p = GALLERY[name]
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        sol = iv.solve_ivp(p.fun, p.t_span, p.y0, method, rtol=1e-6, invariants=iv.Invariants(p.g, None, p.value))
    assert sol.success
    said = [one for one in warned if one.category is not iv.AccuracyWarning]  # tests/test_trust.py
    assert len(said) == (name in REDUNDANT)


@pytest.mark.parametrize("name", GALLERY)
def test_imposed_afterwards_residuals_are_roundoff(name):
    p = GALLERY[name]
    sol = iv.solve_ivp(p.fun, p.t_span, p.y0, invariants=iv.Invariants(p.g, None, p.value), dense_output=True)
    imposed = sol.impose()
    scale = 1 + np.abs(np.array([p.g(t, y) for t, y in zip(sol.t, sol.y.T, strict=True)])).max()
    assert np.abs(imposed.residual).max() < 1e-13 * scale
    if name not in REDUNDANT:
        report = iv.check_invariants(p.fun, iv.Invariants(p.g, None, p.value), sol.t[5], imposed.y[:, 5])
        assert report.conserved.all()


class TestDerivatives:
    """The kind is chosen at the start, and never silently wrong."""

    def test_complex_step_where_g_takes_it(self):
        sol = iv.solve_ivp(
            kepler,
            (0, 5),
            [0.4, 0, 0, 2],
            invariants=lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - (y[0] ** 2 + y[1] ** 2) ** -0.5,
        )
        assert sol.stats.derivatives == "complex step"
        assert 0 < sol.stats.ngdiff < sol.stats.ng

    @pytest.mark.parametrize(
        "energy",
        [
            lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.hypot(y[0], y[1]),  # takes no complex numbers
            lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.linalg.norm(y[:2]),  # real, whatever comes
            lambda t, y: float(y[2] ** 2 + y[3] ** 2) / 2 - 1 / float(y[0] ** 2 + y[1] ** 2) ** 0.5,
            lambda t, y: abs(y[2]) ** 2 / 2 + abs(y[3]) ** 2 / 2 - 1 / abs(y[0] + 1j * y[1]),
        ],
    )
    def test_differences_where_it_does_not(self, energy):
        sol = iv.solve_ivp(kepler, (0, 5), [0.4, 0.1, 0.2, 2], invariants=energy)
        assert sol.success
        assert sol.stats.derivatives == "central differences"

    def test_a_function_that_ceases_to_take_complex_numbers_goes_over_to_differences(self):
        def energy(t, y):
            if t > 1 and np.iscomplexobj(y):
                raise TypeError("real numbers only")
            return (y[1] ** 2 + y[0] ** 2) / 2

        sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 5), [1.0, 0.0], invariants=energy)
        assert sol.success
        assert sol.stats.derivatives == "central differences"
        assert np.abs(sol.residual).max() < 1e-8

    def test_forced_kind_that_is_wrong_is_refused(self):
        norm = iv.Invariants(lambda t, y: np.linalg.norm(y), jac="complex-step")
        with pytest.raises(iv.InvariantError, match="Jacobian of invariant g is wrong"):
            iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 5), [1.0, 0.5], invariants=norm)

    def test_unknown_kind(self):
        with pytest.raises(ValueError, match="did you mean '3-point'"):
            iv.Invariants(lambda t, y: y[0], jac="3point")

    def test_complex_step_is_for_real_problems(self):
        g = iv.Invariants(lambda t, z: abs(z[0]) ** 2, jac="complex-step")
        with pytest.raises(ValueError, match="is for real problems"):
            iv.solve_ivp(lambda t, z: 1j * z, (0, 1), [1 + 0j], invariants=g)


class TestCheck:
    """`check_invariants` is the check of the start as a report."""

    def test_right_ones(self):
        report = iv.check_invariants(kepler, kepler_invariants, 0, [0.5, 0.1, 0.2, 1.5])
        assert report.ok
        assert report.findings == []
        assert (report.angle < 1e-9).all()
        assert f"{kepler_invariants.__name__}[0]" in str(report)

    def test_all_that_can_be_found(self):
        def five(t, y):
            energy, momentum = kepler_invariants(t, y)
            return [energy, momentum, energy - 2 * momentum, y[0] ** 2, 0 * y[0] + 3]

        named = iv.Invariants(five, names=["energy", "momentum", "both", "not conserved", "constant"])
        report = iv.check_invariants(kepler, named, 0, [0.5, 0.1, 0.2, 1.5])
        assert not report.ok
        assert report.conserved.tolist() == [True, True, True, False, True]
        assert report.stationary.tolist() == [False] * 4 + [True]
        assert report.redundant.sum() == 2
        text = str(report)
        assert "not conserved is not conserved by fun" in text
        assert "constant is stationary here" in text

    def test_constraints_are_looked_at_on_their_manifold(self):
        p = PROBLEMS["pendulum"]
        report = iv.check_invariants(p.fun, p.invariants(), 0, [1.0, 0.1, 0.3, -0.5])
        assert not report.on_manifold.any()
        assert report.conserved.all()
        assert not report.ok

    def test_wrong_jacobian(self):
        report = iv.check_invariants(
            kepler,
            iv.Invariants(kepler_invariants, lambda t, y: 1.1 * np.array(kepler_jacobian(t, y))),
            0,
            [0.5, 0.1, 0.2, 1],
        )
        named = f"Jacobian of invariant {kepler_invariants.__name__}"
        assert any(named in finding for finding in report.findings)
        assert not report.ok

    def test_wrong_jacobian_of_a_complex_problem(self):
        wrong = iv.Invariants(lambda t, z: abs(z[1]) ** 2 + abs(z[0]) ** 2, lambda t, z: [2 * z[0], 2 * z[1].conj()])
        report = iv.check_invariants(lambda t, z: 1j * z, wrong, 0, [1 + 1j, 1 + 1j])
        assert any(r"entry for y[1] (imaginary part)" in finding for finding in report.findings)

    def test_misuse(self):
        with pytest.raises(ValueError, match="not finite"):
            iv.check_invariants(lambda t, y: [np.nan], lambda t, y: y[0], 0, [1.0])
        with pytest.raises(TypeError, match="fun must be a function"):
            iv.check_invariants(3, lambda t, y: y[0], 0, [1.0])

    def test_arguments(self):
        report = iv.check_invariants(
            lambda t, y, k: [y[1], -k * y[0]], lambda t, y, k: k * y[0] ** 2 + y[1] ** 2, 0, [1, 2], (4.0,)
        )
        assert report.ok


class TestDrift:
    """`drift` tells what projection kept."""

    @explicit_and_implicit
    def test_table(self, method):
        p = PROBLEMS["Kepler"]
        sol = iv.solve_ivp(
            p.fun, p.t_span, p.y0, method, invariants=iv.Invariants(p.g, p.jac, names=["energy", "momentum"])
        )
        drift = sol.drift()
        assert drift.names == ["energy", "momentum"]
        np.testing.assert_allclose(drift.value, p.g(0, np.array(p.y0)))
        np.testing.assert_allclose(drift.residual_after, np.abs(sol.residual).max(axis=1))
        assert (drift.residual_after < 0.1 * drift.residual_before).all()
        assert (drift.distance_after < drift.distance_before).all()
        assert drift.correction == pytest.approx(sol.correction.max())
        assert drift.projections == sol.stats.projections
        lines = str(drift).splitlines()
        assert len(lines) == 5
        assert "energy" in lines[1]  # one line each, between the head and two about all

    def test_without_invariants(self):
        assert str(iv.solve_ivp(kepler, (0, 1), [0.4, 0, 0, 2]).drift()) == "no invariants were imposed"


class TestWhen:
    """`when="needed"` leaves alone what is close already."""

    @dealt(method=FAMILIES, name=["Kepler", "Lotka-Volterra", "rigid body", "Henon-Heiles"])
    def test_saves_jacobians_and_keeps_the_accuracy(self, method, name):
        p = PROBLEMS[name]
        options = {"method": method, "rtol": 1e-7, "atol": 1e-10}
        tight = iv.ode113(p.fun, p.t_span, p.y0, rtol=1e-13, atol=1e-15).y[:, -1]
        always, needed = (
            iv.solve_ivp(p.fun, p.t_span, p.y0, invariants=iv.Invariants(p.g, p.jac, p.value, when=when), **options)
            for when in ("always", "needed")
        )
        assert needed.stats.skipped + needed.stats.projections >= needed.stats.steps
        assert always.stats.skipped == 0
        assert needed.stats.skipped > 0
        assert needed.stats.ngjac < always.stats.ngjac
        plain = iv.solve_ivp(p.fun, p.t_span, p.y0, **options)
        errors = [np.abs(sol.y[:, -1] - tight).max() for sol in (plain, always, needed)]
        left = 0.05  # what is not corrected, in units of rtol: 0.01, judged by the gradients of another point
        assert errors[2] <= max(4 * errors[1], 0.1 * errors[0], left * 1e-7 * np.abs(needed.y).max())
        assert needed.drift().distance_after.max() <= left

    def test_always_if_one_of_them_says_so(self):
        energy = iv.Invariants(lambda t, y: kepler_invariants(t, y)[0], when="needed")
        sol = iv.solve_ivp(
            kepler, (0, 20), [0.4, 0, 0, 2], invariants=[energy, lambda t, y: kepler_invariants(t, y)[1]]
        )
        assert sol.stats.skipped == 0

    def test_misuse(self):
        with pytest.raises(ValueError, match="did you mean 'needed'"):
            iv.Invariants(lambda t, y: y[0], when="need")


class TestImposeOnResults:
    """`impose` takes results with their dense output, SciPy's too."""

    @pytest.mark.parametrize("theirs", [True, False])
    def test_dense_output(self, theirs):
        import scipy.integrate

        solve = scipy.integrate.solve_ivp if theirs else iv.solve_ivp
        sol = solve(kepler, (0, 20), [0.4, 0, 0, 2], dense_output=True, rtol=1e-5, atol=1e-8)
        result = iv.impose(kepler_invariants, sol)
        assert result.converged.all()
        t = np.linspace(0, 20, 41)
        held = np.array(kepler_invariants(0, [0.4, 0, 0, 2]))
        for y in result.sol(t).T:
            np.testing.assert_allclose(kepler_invariants(0, y), held, atol=2e-15)
        assert result.sol(3.0).shape == (4,)

    def test_points_have_none(self):
        assert iv.impose(kepler_invariants, 0, [0.4, 0, 0, 2]).sol is None


def test_invariants_and_events_of_one_name_are_numbered():
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -y[0], 0.0],
        (0, 1),
        [1, 0, 2],
        invariants=[lambda t, y: y[0] ** 2 + y[1] ** 2, lambda t, y: y[2]],
        events=[lambda t, y: y[0], lambda t, y: y[1]],
    )
    assert sol.drift().names == ["g_0", "g_1"]
    assert len(set(sol._names.events)) == 2
    assert list(sol.to_dataframe().attrs["invariants"]) == ["g_0", "g_1"]
