"""Guarantees of projection: at steps, in whatever units, with redundant invariants and special values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families, families_and_series
from invariode._functions.increments import SMALLEST_SCALE
from problems import PROBLEMS, TestProblem, implicit, kepler, kepler_invariants, kepler_jacobian, long_steps, slack

WEIGHTS = Path(__file__).parents[1] / "core" / "weights.hpp"


@dealt(method=METHODS, problem=PROBLEMS)
def test_residual_at_steps_is_far_below_the_plain_run(method, problem):
    plain, projected = problem.solve(method, False), problem.solve(method)
    assert projected.success
    assert problem.drift(projected) < 0.02 * problem.drift(plain)


KINDS = {
    None: {"complex step", "central differences"},
    "complex-step": {"complex step"},
    "3-point": {"central differences"},
    "2-point": {"forward differences"},
}


def takes_complex(problem: TestProblem) -> bool:
    return "hypot" not in problem.g.__code__.co_names


@dealt(14, method=METHODS, problem=PROBLEMS, kind=KINDS)
def test_every_kind_of_jacobian_gives_the_same_run(method, problem, kind):
    kind = "3-point" if kind == "complex-step" and not takes_complex(problem) else kind
    options = {"rtol": 1e-6, "atol": 1e-9} if long_steps(method) else {}  # the lengths of long steps magnify roundoff
    given = problem.solve(method, **options)
    invariants = iv.Invariants(problem.g, kind, problem.value)
    differences = iv.solve_ivp(problem.fun, problem.t_span, problem.y0, method, invariants=invariants, **options)
    assert (given.stats.steps, given.stats.failed) == (differences.stats.steps, differences.stats.failed)
    assert given.stats.derivatives == "given"
    assert given.stats.ngdiff == 0 < differences.stats.ngdiff < differences.stats.ng
    assert differences.stats.derivatives in KINDS[kind]
    # the roundoff of the differences is amplified by the problem, most by the pendulum that turns over
    np.testing.assert_allclose(differences.y, given.y, rtol=1e-3, atol=1e-3)


@explicit_and_implicit
@pytest.mark.parametrize("name", [name for name, problem in PROBLEMS.items() if not takes_complex(problem)])
def test_a_complex_step_through_a_function_of_reals_raises_its_error(method, name):
    problem = PROBLEMS[name]
    invariants = iv.Invariants(problem.g, "complex-step", problem.value)
    with pytest.raises(TypeError, match="hypot"):
        iv.solve_ivp(problem.fun, problem.t_span, problem.y0, method, invariants=invariants)


@dealt(method=FAMILIES, problem=PROBLEMS, factor=[2.0**-40, 2.0**40])
def test_units_of_g_do_not_matter(method, problem, factor):
    """Multiplication by a power of two is exact: every digit stays."""
    invariants = iv.Invariants(
        lambda t, y: factor * np.asarray(problem.g(t, y)),
        lambda t, y: factor * np.asarray(problem.jac(t, y)),
        problem.value,
    )
    scaled = iv.solve_ivp(problem.fun, problem.t_span, problem.y0, method, invariants=invariants)
    plain = problem.solve(method)
    assert (scaled.stats.steps, scaled.stats.failed) == (plain.stats.steps, plain.stats.failed)
    np.testing.assert_array_equal(scaled.y, plain.y)


@dealt(method=FAMILIES, small=[0, 1e-307, 1e-290, 1e-251, 1e-249, 1e-100])
def test_components_near_zero_under_pure_relative_control(method, small):
    """However small a component is, its complex step does not underflow, and the gradient is right: below one size
    components have no scale, in the core and here."""
    assert f" smallest_scale = {SMALLEST_SCALE:g};" in WEIGHTS.read_text(encoding="utf-8")
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -y[0]], (0, 1), [1, small], method, rtol=1e-6, atol=0, invariants=lambda t, y: y @ y
    )
    assert sol.success, sol.message
    np.testing.assert_allclose(sol.y[:, -1], [np.cos(1), -np.sin(1)], rtol=1e-5 * slack(method))


@explicit_and_implicit
def test_redundant_invariant_is_dropped_with_one_warning(method):
    def three(t, y):
        energy, momentum = kepler_invariants(t, y)
        return [energy, momentum, energy - 2 * momentum]

    def jacobian(t, y):
        energy, momentum = np.asarray(kepler_jacobian(t, y))
        return [energy, momentum, energy - 2 * momentum]

    problem = PROBLEMS["Kepler"]
    redundant = iv.Invariants(three, jacobian, names=["energy", "momentum", "both"])
    with pytest.warns(UserWarning, match="redundant") as warned:
        sol = iv.solve_ivp(kepler, problem.t_span, problem.y0, method, invariants=redundant)
    assert len(warned) == 1
    assert sol.success
    two = problem.solve(method)
    assert (sol.stats.steps, sol.stats.failed) == (two.stats.steps, two.stats.failed)
    np.testing.assert_allclose(sol.y, two.y, rtol=1e-5, atol=1e-5)


@families_and_series
def test_circular_orbit_where_invariants_are_redundant_everywhere(method):
    if iv.METHODS[method].order == 2:
        pytest.skip("its orbits are less circular than rtol, and the invariants independent")
    with pytest.warns(UserWarning, match="redundant"):
        sol = iv.solve_ivp(kepler, (0, 20), [1, 0, 0, 1], method, rtol=1e-6, invariants=kepler_invariants)
    assert sol.success
    assert np.abs(sol.residual).max() < 1e-5


@explicit_and_implicit
def test_invariant_whose_value_is_zero(method):
    """Units of g do not enter, so an invariant that is 0 is like any other."""
    sol = iv.solve_ivp(lambda t, y: [y[1], y[0]], (0, 5), [1, 1], method, invariants=lambda t, y: y[1] ** 2 - y[0] ** 2)
    assert sol.success
    np.testing.assert_allclose(sol.y[0], sol.y[1], rtol=1e-10)


@explicit_and_implicit
def test_one_invariant_as_number_as_vector_or_in_a_list(method):
    problem = PROBLEMS["Kepler"]

    def energy(t, y):
        return kepler_invariants(t, y)[0]

    def momentum(t, y):
        return [kepler_invariants(t, y)[1]]

    together = iv.solve_ivp(kepler, problem.t_span, problem.y0, method, invariants=kepler_invariants)
    apart = iv.solve_ivp(kepler, problem.t_span, problem.y0, method, invariants=[energy, iv.Invariants(momentum)])
    np.testing.assert_array_equal(together.y, apart.y)


def test_linear_invariant_is_kept_without_projection_already(method):
    matrix = np.array([[-1.0, 0, 0], [1, -2, 0], [0, 2, 0]])  # its columns sum to 0
    options = {"jac": matrix} if implicit(method) else {}
    sol = iv.solve_ivp(lambda t, y: matrix @ y, (0, 5), [1, 0, 0], method, **options)
    assert np.abs(sol.y.sum(axis=0) - 1).max() < 50 * np.finfo(float).eps


@families
def test_more_iterations_leave_smaller_residuals(method):
    problem = PROBLEMS["pendulum"]
    residuals = [
        np.abs(
            iv.solve_ivp(
                problem.fun, problem.t_span, problem.y0, method, invariants=problem.invariants(iterations=k)
            ).residual
        ).max()
        for k in (1, 2, 4)
    ]
    assert residuals[1] < residuals[0] / 10
    assert residuals[2] < 1e-14


@explicit_and_implicit
def test_demanded_value_close_to_y0_is_projected_once(method):
    off = [1 + 2e-4, 0, 0, 0]
    problem = PROBLEMS["pendulum"]
    sol = iv.solve_ivp(problem.fun, (0, 5), off, method, invariants=problem.invariants())
    assert sol.stats.projected_start
    assert np.abs(sol.residual[:, 0]).max() < 1e-15


@explicit_and_implicit
def test_demanded_value_far_from_y0_is_refused(method):
    problem = PROBLEMS["pendulum"]
    invariants = iv.Invariants(problem.g, problem.jac, 0, names=["length", "velocity"])
    with pytest.raises(
        iv.InvariantError,
        match=r"not on the manifold: it violates invariant length, .* = 0\.21, .*impose\(invariants, t0, y0\)",
    ):
        iv.solve_ivp(problem.fun, (0, 5), [1.1, 0, 0, 0], method, invariants=invariants)
    y0 = iv.impose(invariants, 0, [1.1, 0, 0, 0]).y
    assert iv.solve_ivp(problem.fun, (0, 5), y0, method, invariants=invariants).success


@families
def test_complex_state(method):
    """|z| is kept by z' = i z: the complex run is the run of the pairs of reals."""

    def modulus(t, z):
        return abs(z[0]) ** 2

    def pair(t, y):
        return [-y[1], y[0]]

    complex_run = iv.solve_ivp(lambda t, z: 1j * z, (0, 20), [1 + 0j], method, invariants=modulus, dense_output=True)
    real_run = iv.solve_ivp(pair, (0, 20), [1, 0], method, invariants=lambda t, y: y @ y, dense_output=True)
    assert complex_run.y.dtype == complex
    assert complex_run.stats.steps == real_run.stats.steps
    # Jacobians by differences, of which the first eight digits are right, enter h by way of the error estimates.
    np.testing.assert_allclose(complex_run.y[0], real_run.y[0] + 1j * real_run.y[1], rtol=1e-8, atol=1e-8)
    assert complex_run.sol(1.234).dtype == complex
    np.testing.assert_allclose(np.abs(complex_run.y[0]), 1, rtol=1e-6)
    gradient = iv.Invariants(modulus, jac=lambda t, z: 2 * z)  # ∂/∂Re + i ∂/∂Im
    given = iv.solve_ivp(lambda t, z: 1j * z, (0, 20), [1 + 0j], method, invariants=gradient, dense_output=True)
    np.testing.assert_allclose(given.y, complex_run.y, rtol=1e-8)


def test_minimum_norm_correction_uses_the_weights():
    """A component with a large weight takes the correction: nearest is meant in the norm of the error test."""
    moved = iv.impose(lambda t, y: y[0] + y[1], 0, [1.0, 1.0], value=3, rtol=1e-3, atol=[1e-3, 1e3])
    np.testing.assert_allclose(moved.y, [1, 2], atol=1e-5)
    assert moved.converged


class TestImpose:
    """`impose` brings points to roundoff, whatever they come in, and leaves alone what it cannot project."""

    def test_shapes(self, problem: TestProblem):
        sol = problem.solve("ode45", False, rtol=1e-4)
        invariants, held = problem.invariants(), problem.g(0, np.array(problem.y0))
        many = iv.impose(invariants, sol.t, sol.y, value=problem.value if problem.value is not None else held)
        assert many.y.shape == sol.y.shape
        assert many.converged.all()
        assert many.residual.shape[1] == many.iterations.shape[0] == len(sol.t)
        one = iv.impose(invariants, sol.t[3], sol.y[:, 3], value=0 if problem.value is not None else held)
        assert isinstance(one.converged, bool)
        np.testing.assert_array_equal(one.y, many.y[:, 3])
        np.testing.assert_array_equal(iv.impose(invariants, sol).y, many.y)  # a result: its t and y, its first point

    @dealt(method=FAMILIES, problem=PROBLEMS)
    def test_own_invariants(self, method, problem: TestProblem):
        sol = problem.solve(method, refine=3, dense_output=True)
        imposed = sol.impose()
        scale = 1 + np.abs(np.atleast_2d([problem.g(t, y) for t, y in zip(sol.t, sol.y.T, strict=True)]).T).max()
        assert np.abs(imposed.residual).max() < 1e-13 * scale
        np.testing.assert_array_equal(imposed.t, sol.t)
        t = np.linspace(*problem.t_span, 50)
        values = imposed.sol(t)
        assert (
            max(
                np.abs(np.subtract(problem.g(s, y), problem.g(0, np.array(problem.y0)))).max()
                for s, y in zip(t, values.T, strict=True)
            )
            < 1e-13 * scale
        )

    def test_point_that_cannot_be_projected_is_unchanged(self):
        result = iv.impose(lambda t, y: y[0] ** 2 + 1, 0, np.array([[0.3, 0.5]]), value=[0])
        assert not result.converged.any()
        np.testing.assert_array_equal(result.y, [[0.3, 0.5]])

    def test_point_that_is_not_finite_is_reported_and_the_others_projected(self):
        result = iv.impose(lambda t, y: y @ y, 0, np.array([[3.0, np.nan], [4.0, 1.0]]), value=1)
        assert result.converged.tolist() == [True, False]
        assert result.y[:, 0] @ result.y[:, 0] == pytest.approx(1, rel=1e-15)
        assert np.isnan(result.y[0, 1])

    def test_scipy_result(self):
        scipy_integrate = pytest.importorskip("scipy.integrate")
        problem = PROBLEMS["Lotka-Volterra"]
        sol = scipy_integrate.solve_ivp(problem.fun, problem.t_span, problem.y0)
        result = iv.impose(problem.invariants(), sol)
        assert result.converged.all()
        assert np.abs(result.residual).max() < 2e-13

    def test_wrong_calls(self):
        g = PROBLEMS["Kepler"].invariants()
        with pytest.raises(TypeError, match="points"):
            iv.impose(g, 3.0)
        with pytest.raises(ValueError, match="one time per point"):
            iv.impose(g, [0, 1, 2], np.ones((4, 2)))
        with pytest.raises(ValueError, match="at least one invariant"):
            iv.impose([], 0, [1.0])
        with pytest.raises(ValueError, match="value must have shape"):
            iv.impose(g, 0, np.ones(4), value=[1, 2, 3])


@families
def test_an_invariant_whose_offset_drowns_its_changes_is_a_warning(method):
    """Near 1e16 doubles are 2 apart: x² + v² = 1 is then not imposed, and a warning says so. An offset of 1e6 leaves
    digits enough."""

    def solve(offset):
        return iv.solve_ivp(
            lambda t, y: [y[1], -y[0]], (0, 5), [1.0, 0.0], method, rtol=1e-5, atol=1e-7,
            invariants=lambda t, y: y[0] ** 2 + y[1] ** 2 + offset,
        )  # fmt: skip

    with pytest.warns(iv.AccuracyWarning, match="so large that its roundoff is a change of y by .* tolerances"):
        solve(1e16)
    sol = solve(1e6)
    assert np.abs(sol.y[0] ** 2 + sol.y[1] ** 2 - 1).max() < 1e-8
