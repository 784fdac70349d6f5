"""The Jacobian of a Python invariant of many components follows from a trace that nobody notices; the invariant itself
stays the user's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

import invariode as iv
from cases import explicit_and_implicit, families
from invariode._laws.jacobians import FEWEST_COMPONENTS, TracedJacobian

PAIRS = FEWEST_COMPONENTS // 2
STIFFNESS = np.linspace(1.0, 2.0, PAIRS)
Y0 = np.concatenate([np.ones(PAIRS), np.zeros(PAIRS)])


def springs(t, y, k=1.0):
    return np.concatenate([y[PAIRS:], -k * STIFFNESS * y[:PAIRS]])


def energies(t, y, k=1.0):
    return (y[PAIRS:] ** 2 + k * STIFFNESS * y[:PAIRS] ** 2) / 2


@families
def test_runs_are_those_with_complex_steps_to_roundoff(method):
    """Both Jacobians are exact to roundoff, and so is what follows from them, over a few steps."""
    for args in ((), (1.5,)):
        given = {"args": args, "events": lambda t, y, *p: y[0] - 0.5, "breakpoints": [0.3]}
        traced = iv.solve_ivp(springs, (0, 1), Y0, method, invariants=energies, **given)
        steps = iv.Invariants(energies, jac="complex-step")
        other = iv.solve_ivp(springs, (0, 1), Y0, method, invariants=steps, **given)
        assert (traced.stats.derivatives, other.stats.derivatives) == ("traced", "complex step")
        assert traced.stats.ngdiff == 2  # the comparison at the start
        assert traced.stats.ng < other.stats.ng
        assert traced.stats.steps == other.stats.steps
        np.testing.assert_allclose(traced.y, other.y, rtol=0, atol=1e-12)
        np.testing.assert_allclose(traced.residual, other.residual, rtol=0, atol=1e-12)


@explicit_and_implicit
def test_other_arguments_of_a_prepared_run_reach_the_jacobian(method):
    for args in ((1.0,), ([1.0],), (np.array(1.0),)):
        vector = not isinstance(args[0], float)
        fun = (lambda t, y, k: springs(t, y, np.sum(k))) if vector else springs
        g = (lambda t, y, k: energies(t, y, np.sum(k))) if vector else energies
        problem = iv.Problem(fun, (0, 2), Y0, args=args, invariants=g)
        prepared = problem.prepare(method)
        for k in (1.0, 3.0):
            changed = (type(args[0])([k]),) if isinstance(args[0], list) else (np.array(k) if vector else k,)
            again = prepared(args=changed)
            alone = problem.replace(args=changed).solve(method)
            np.testing.assert_array_equal(again.y, alone.y)
            assert np.abs(again.residual).max() < 1e-6  # the tolerance is 1e-3


def test_large_jacobians_that_are_nearly_zero_are_sparse():
    n = 200

    def lattice(t, y):
        return np.concatenate([y[n:], -y[:n]])

    def sums(t, y):
        return y[:n] ** 2 + y[n:] ** 2

    y0 = np.concatenate([np.linspace(1, 2, n), np.zeros(n)])
    sol = iv.solve_ivp(lattice, (0, 1), y0, invariants=sums)
    assert sol.stats.derivatives == "traced"
    assert np.abs(sol.residual).max() < 1e-6  # the tolerance is 1e-3


def test_a_function_whose_trace_could_be_noticed_is_not_traced():
    seen = []

    def noticed(t, y):
        seen.append(t)
        return energies(t, y)

    def few(t, y):
        return y[0] ** 2 + y[1] ** 2

    assert iv.solve_ivp(springs, (0, 1), Y0, invariants=noticed).stats.derivatives == "complex step"
    assert all(isinstance(t, float) for t in seen)
    assert iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 1), [1, 0], invariants=few).stats.derivatives == "complex step"


def test_arguments_of_another_kind_are_served_by_complex_steps():
    """A trace is for numbers of the same shapes; complex steps have the roundoff of g."""

    def g(t, y, k):
        return energies(t, y, k if isinstance(k, float) else k["k"])

    made = TracedJacobian(energies, len(Y0), PAIRS)
    exact = made(0.0, Y0 + 0.1, 2.0)
    other = TracedJacobian(g, len(Y0), PAIRS)
    np.testing.assert_allclose(other(0.0, Y0 + 0.1, {"k": 2.0}), exact, atol=1e-14)


def test_sparse_jacobians_of_users_are_taken():
    """Traced with arguments, traced without, and given as a sparse matrix: the same entries by three ways."""
    n = 60

    def lattice(t, y, k):
        return np.concatenate([y[n:], -k * y[:n]])

    def sums(t, y, k):
        return k * y[:n] ** 2 + y[n:] ** 2

    def gradients(t, y, k):
        return sparse.hstack([sparse.diags_array(2 * k * y[:n]), sparse.diags_array(2 * y[n:])], format="coo")

    def more(t, y, k):
        found = gradients(t, y, k).tolil()
        found[0, 1] = t
        return found if t > 0.5 else gradients(t, y, k)

    y0 = np.concatenate([np.linspace(1, 2, n), np.zeros(n)])
    for method in ("ode45", "radau"):
        traced = iv.solve_ivp(lattice, (0, 1), y0, method, args=(2.0,), invariants=sums)
        dense = iv.Invariants(sums, lambda *at: gradients(*at).toarray())  # of the same kind, but for what it returns
        assert iv.solve_ivp(lattice, (0, 1), y0, method, args=(2.0,), invariants=dense).success
        given = iv.solve_ivp(lattice, (0, 1), y0, method, args=(2.0,), invariants=iv.Invariants(sums, gradients))
        assert (traced.stats.derivatives, given.stats.derivatives) == ("traced", "given")
        np.testing.assert_allclose(traced.y, given.y, rtol=0, atol=1e-12)
    moved = iv.impose(iv.Invariants(sums, gradients, value=1.0), 0.0, y0, args=(2.0,))
    np.testing.assert_allclose(sums(0.0, moved.y, 2.0), 1.0, atol=1e-10)
    with pytest.raises(ValueError, match="were not stored at the start"):
        iv.solve_ivp(lattice, (0, 1), y0, args=(2.0,), invariants=iv.Invariants(sums, more))
