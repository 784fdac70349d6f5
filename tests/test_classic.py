"""`invariode.problems`: what each problem keeps is kept by its equations, and they are what packages can take."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import invariode as iv
from invariode import problems

EPS = np.finfo(float).eps
#: Pendulum: the second constraint, x x' + y y', is kept where the first one holds.
ON_THE_MANIFOLD = {"pendulum"}


@pytest.fixture(params=problems.__all__)
def problem(request) -> iv.Problem:
    return getattr(problems, request.param)()


def states(problem: iv.Problem, count: int = 20) -> list[np.ndarray]:
    rng = np.random.default_rng(12)
    size = 0.05 if problem.y0.min() >= 0 else 0.1
    near = [np.abs(problem.y0 + size * rng.standard_normal(len(problem.y0))) + 1e-3 for _ in range(count)]
    if problem.name in ON_THE_MANIFOLD:
        return [iv.impose(problem.invariants, 0.0, y, rtol=1e-10).y for y in near]
    return near


def test_the_rate_of_each_invariant_is_zero(problem):
    """J f = 0 to the roundoff of its terms."""
    (held,) = problem.invariants
    for y in states(problem):
        J, f = np.atleast_2d(held.jac(0.0, y)), np.array(problem.fun(0.0, y))
        terms = np.abs(J) @ np.abs(f) + (np.abs(J) * np.abs(y)).sum(axis=1)
        assert (np.abs(J @ f) <= 50 * EPS * terms + 1e-13 * (problem.name in ON_THE_MANIFOLD)).all()


def test_jacobians_are_those_of_differences(problem):
    (held,) = problem.invariants
    pairs = [(held.fun, held.jac)]
    if problem.matrices.jac is not None:
        pairs.append((problem.fun, problem.matrices.jac))
    h = np.cbrt(EPS)
    for function, jac in pairs:
        for y in states(problem, 3):
            J = np.atleast_2d(jac(0.0, y))
            columns = [
                (np.subtract(function(0.0, y + h * e), function(0.0, y - h * e))) / (2 * h) for e in np.eye(len(y))
            ]
            differences = np.atleast_2d(np.transpose(columns))
            np.testing.assert_allclose(J, differences, atol=1e-7 * max(1, np.abs(J).max()))


def test_invariants_take_columns(problem):
    """To a few ulp: NumPy may have other loops for columns than for numbers."""
    (held,) = problem.invariants
    columns = np.array(states(problem, 4)).T
    each = [np.atleast_1d(held.fun(0.0, y)) for y in columns.T]
    of_all = np.atleast_2d(np.array(held.fun(np.zeros(4), columns)))
    np.testing.assert_array_almost_equal_nulp(of_all, np.transpose(each), 4)


def test_they_can_be_sent_to_processes(problem):
    (held,) = problem.invariants
    assert pickle.loads(pickle.dumps((problem.fun, held.fun, held.jac))) == (problem.fun, held.fun, held.jac)


@pytest.mark.parametrize("name", problems.__all__)
def test_imposed_or_not(name):
    free = getattr(problems, name)(imposed=False)
    assert not free.invariants
    assert len(free.labels) == len(free.y0)


def test_the_orbit_has_the_eccentricity_and_the_period():
    for e in (0.1, 0.6, 0.9):
        problem = problems.kepler(e)
        sol = problem.solve("ode113", rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(sol.y[:, -1], problem.y0, atol=1e-6)
        assert np.hypot(*sol.y[:2]).max() <= 1 + e + 1e-8
    with pytest.raises(ValueError, match=r"eccentricity.*got 1\.0"):
        problems.kepler(1.0)


def test_the_star_has_the_energy():
    problem = problems.henon_heiles(0.15, -0.2)
    assert problem.invariants[0].fun(0.0, problem.y0) == pytest.approx(0.15, abs=4 * EPS)
    with pytest.raises(ValueError, match="give a larger one, or another y"):
        problems.henon_heiles(0.01, 0.5)


@pytest.mark.parametrize("name", ["lotka_volterra", "pendulum", "henon_heiles", "rigid_body"])
def test_numba_compiles_them(name):
    pytest.importorskip("numba")
    problem = getattr(problems, name)(imposed=False)
    sol = iv.solve_ivp(iv.compile(problem.fun), (0, 5), problem.y0, rtol=1e-8)
    np.testing.assert_allclose(sol.y[:, -1], iv.solve_ivp(problem.fun, (0, 5), problem.y0, rtol=1e-8).y[:, -1], 1e-6)
