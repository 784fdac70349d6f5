"""`find_invariants` finds what is there, in simple form, and nothing where there is nothing."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

import invariode as iv
from cases import explicit_and_implicit
from problems import PROBLEMS
from stiff import PROBLEMS as STIFF


def formulas(fun, t_span, y0, degree=2, **options) -> list[str]:
    return [p.formula for p in iv.find_invariants(fun, t_span, y0, degree, **options)]


def spatial_kepler(t, y):
    r3 = (y[:3] @ y[:3]) ** 1.5
    return [*y[3:], *(-y[:3] / r3)]


def oscillators(t, y):
    return [y[1], -y[0], y[3], -2 * y[2]]


NOTHING = {
    "Lotka-Volterra": (PROBLEMS["Lotka-Volterra"].fun, (0, 20), [1, 2.0], 3),  # its invariant is no polynomial
    "van der Pol": (lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] - y[0]], (0, 20), [1, 2.0], 4),
    "Lorenz": (
        lambda t, y: [10 * (y[1] - y[0]), y[0] * (28 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]],
        (0, 20),
        [1, 2.0, 20],
        3,
    ),
    "damped pendulum": (lambda t, y: [y[1], -np.sin(y[0]) - 0.1 * y[1]], (0, 20), [1, 0.2], 4),
    "hardly damped": (lambda t, y: [y[1], -y[0] - 1e-5 * y[1]], (0, 20), [1, 0.2], 2),
    "driven oscillator": (lambda t, y: [y[1], -y[0] + 0.3 * np.cos(1.3 * t)], (0, 20), [1, 0.2], 4),
    "Rossler": (
        lambda t, y: [-y[1] - y[2], y[0] + 0.2 * y[1], 0.2 + y[2] * (y[0] - 5.7)],
        (0, 20),
        [1, 0.2, 0.1],
        3,
    ),
    "nothing defined nearby": (lambda t, y: [np.sqrt(-((y[0] - 1) ** 2)) + 1], (0, 1), [1.0], 2),
}


@pytest.mark.parametrize("name", NOTHING)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_nothing_where_there_is_nothing(name):
    assert iv.find_invariants(*NOTHING[name]) == []


def test_rigid_body_has_two_quadratics():
    p = PROBLEMS["rigid body"]
    found = iv.find_invariants(p.fun, p.t_span, p.y0)
    assert len(found) == 2
    rng = np.random.default_rng(1)
    for y in rng.normal(size=(5, 3)):  # they span the gradients of energy and momentum
        rows = np.vstack([p.jac(0, y), *[q.jac(0, y) for q in found]])
        assert np.linalg.svd(rows, compute_uv=False)[2] < 1e-9


@pytest.mark.parametrize("name", ["Robertson", "HIRES", "pollution"])
def test_all_linear_laws_of_kinetics(name):
    p = STIFF[name]
    found = iv.find_invariants(p.fun, p.t_span, p.y0, 1)
    laws = np.array([[float(q.coefficients.get(tuple(e), 0)) for e in np.eye(len(p.y0), dtype=int)] for q in found])
    assert len(found) == len(p.invariants) == np.linalg.matrix_rank(np.vstack([laws, p.invariants]))
    assert all(isinstance(c, Fraction) for q in found for c in q.coefficients.values())


def test_angular_momentum_of_spatial_kepler():
    found = formulas(spatial_kepler, (0, 10), [1, 0, 0.2, 0.1, 0.9, 0.3], labels=["x", "y", "z", "u", "v", "w"])
    assert found == ["x*v - y*u", "x*w - z*u", "y*w - z*v"]


def test_energy_of_henon_heiles():
    p = PROBLEMS["Henon-Heiles"]
    found = formulas(p.fun, (0, 30), p.y0, 3, labels=["x", "y", "u", "v"])
    assert found == ["x**2 + y**2 + u**2 + v**2 + 2*x**2*y - 2/3*y**3"]
    assert formulas(p.fun, (0, 30), p.y0, 2) == []


def test_independent_generators_only():
    """No products, squares or sums of what was found."""
    assert formulas(oscillators, (0, 20), [1, 0.2, 0.5, 0.7], 4) == ["y[0]**2 + y[1]**2", "y[2]**2 + 1/2*y[3]**2"]
    assert formulas(lambda t, y: [y[2] - y[0], y[0] - y[1], y[1] - y[2]], (0, 5), [1, 2, 0.5], 3) == [
        "y[0] + y[1] + y[2]"
    ]


def test_random_hamiltonians_and_random_systems():
    rng = np.random.default_rng(7)
    for _ in range(5):
        a, b, c, d = rng.uniform(0.5, 2, 4)
        e, f = 0.1 * rng.normal(size=2)

        def hamiltonian(t, y, a=a, b=b, c=c, d=d, e=e, f=f):
            x, z, u, v = y
            return [c * u, d * v, -a * x - 3 * e * x * x - f * z * z, -b * z - 2 * f * x * z]

        found = iv.find_invariants(hamiltonian, (0, 10), [0.4, 0.2, 0.1, 0.3], 3)
        assert len(found) == 1
        A, B = rng.normal(size=(2, 3, 3))

        def arbitrary(t, y, A=A, B=B):
            return A @ y - 0.1 * y * (B @ y) - y**3

        assert iv.find_invariants(arbitrary, (0, 5), [0.4, 0.2, 0.1], 3) == []


@explicit_and_implicit
def test_what_is_found_is_ready_to_be_imposed(method):
    p = PROBLEMS["Henon-Heiles"]
    (energy,) = iv.find_invariants(p.fun, (0, 30), p.y0, 3)
    assert energy.degree == 3
    sol = iv.solve_ivp(p.fun, (0, 30), p.y0, method, invariants=energy)
    assert sol.success
    assert sol.stats.derivatives == "given"
    np.testing.assert_allclose(energy(sol.y), energy(p.y0), rtol=1e-4)
    assert energy.formula in repr(energy)
    assert iv.check_invariants(p.fun, energy, 0, p.y0).ok


def test_arguments_are_handed_on():
    assert formulas(lambda t, y, k: [y[1], -k * y[0]], (0, 5), [1, 0.3], args=(9,)) == ["y[0]**2 + 1/9*y[1]**2"]


def test_misuse():
    def fun(t, y):
        return [y[1], -y[0]]

    with pytest.raises(ValueError, match="degree must be a positive integer"):
        iv.find_invariants(fun, (0, 1), [1, 0], 0)
    with pytest.raises(ValueError, match="must be finite"):
        iv.find_invariants(fun, (0, np.inf), [1, 0])
    with pytest.raises(ValueError, match="for real problems"):
        iv.find_invariants(fun, (0, 1), [1j, 0])
    with pytest.raises(ValueError, match="more than 2000"):
        iv.find_invariants(fun, (0, 1), np.ones(70))
    with pytest.raises(ValueError, match="labels must name the 2"):
        iv.find_invariants(fun, (0, 1), [1, 0], labels=["x"])
    with pytest.raises(TypeError, match="fun must be a function"):
        iv.find_invariants(3, (0, 1), [1, 0])


def test_what_f_does_at_y0_is_told():
    """Elsewhere it may fail: points outside of its domain are left out."""
    with pytest.raises(ValueError, match=r"fun\(t, y\) returned shape \(1,\), expected shape \(2,\)"):
        iv.find_invariants(lambda t, y: [1.0], (0, 1), [1.0, 0.0])

    def mine(t, y):
        raise ValueError("of my own")

    with pytest.raises(ValueError, match="of my own"):
        iv.find_invariants(mine, (0, 1), [1.0, 0.0])


def test_what_f_does_elsewhere_is_told_where_nothing_can_be_searched():
    """A wrong shape is never a matter of the domain; an exception that every trajectory meets is the user's."""

    def late(t, y):
        if t > 0.5:
            raise ValueError("of my own")
        return [y[1], -y[0]]

    with pytest.raises(ValueError, match="of my own"):
        iv.find_invariants(late, (0, 1), [1.0, 0.0])
    for misshapen in (lambda t, y: [y[1], -y[0]][: 1 + (t < 0.5)], lambda t, y: [y[1], -y[0]][: 1 + (y[0] < 1.01)]):
        with pytest.raises(ValueError, match=r"fun\(t, y\) returned shape \(1,\), expected shape \(2,\)"):
            iv.find_invariants(misshapen, (0, 1), [1.0, 0.0])
    with pytest.raises(ValueError, match=r"fun is not finite at the start: .*nan.* at t = 0\.0"):
        iv.find_invariants(lambda t, y: [np.nan, -y[0]], (0, 1), [1.0, 0.0])


def test_points_outside_the_domain_are_left_out():
    """Half of the starts around y0 are beyond the end of √y."""
    found = formulas(lambda t, y: [-math.sqrt(y[0]), math.sqrt(y[0])], (0, 1), [1.0, 0.0], 1)
    assert found == ["y[0] + y[1]"]


def test_a_problem_brings_its_interval_state_arguments_and_labels():
    def spring(t, y, k):
        return [y[1], -k * y[0]]

    problem = iv.Problem(spring, (0, 10), [1.0, 0.5], args=(4.0,), labels=["x", "v"])
    assert [one.formula for one in iv.find_invariants(problem)] == ["x**2 + 1/4*v**2"]
    with pytest.raises(TypeError, match="a problem has its own t_span, y0, args and labels"):
        iv.find_invariants(problem, (0, 5))
    with pytest.raises(TypeError, match="needs a problem, or fun, t_span and y0"):
        iv.find_invariants(spring, (0, 5))
    with pytest.raises(ValueError, match="inputs or a mass matrix"):
        iv.find_invariants(problem.replace(mass=np.diag([1.0, 2.0])))
