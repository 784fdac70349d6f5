"""Differential-algebraic functions that cannot be traced are solved as they stand, up to index 1."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from dae_problems import (
    PROBLEMS,
    opaque,
)

pytestmark = pytest.mark.filterwarnings("ignore:initial values were moved")


def test_functions_that_cannot_be_traced_are_solved_as_they_stand_up_to_index_1():
    """Index 0 and 1, with y' behind a singular matrix, nonlinear in y'; with fewer calls than IDA at equal error."""
    cases = (
        ("robertson", 1e-6, 1e-12, 3e-5, 1741),
        ("akzo", 1e-4, 1e-6, 6e-5, 259),
        ("akzo", 1e-6, 1e-8, 3e-6, 471),
        ("transistors", 1e-4, 1e-6, 1e-3, 38890),
    )
    for name, rtol, atol, error, calls_of_ida in cases:
        problem = PROBLEMS[name]
        start = problem.analysed().consistent()
        F = opaque(problem.F)
        sol = iv.solve_dae(F, problem.t_span, start.y, start.yp, rtol=rtol, atol=atol, keep="end")
        assert problem.error(sol) < error, name
        assert sol.nfev <= F.calls <= calls_of_ida, name
        exact = iv.solve_dae(F, problem.t_span, start.y, start.yp, method="radau", rtol=rtol, atol=atol, keep="end")
        assert problem.error(exact) < error / 10, name
    problem = PROBLEMS["weissinger"]
    sol = iv.solve_dae(opaque(problem.F), (1, 10), problem.y0, [0.8], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(sol.y[0], np.sqrt(sol.t**2 + 0.5), rtol=1e-6)
    np.testing.assert_allclose(sol.yp[0], sol.t / sol.y[0], rtol=1e-5)


def test_what_needs_expressions_says_so():
    F = opaque(PROBLEMS["akzo"].F)
    y0 = PROBLEMS["akzo"].y0
    with pytest.raises(
        TypeError, match=r"F cannot be traced: .* cannot be solved either: its index is above 1: .*y\[4\]"
    ):
        iv.solve_dae(opaque(PROBLEMS["pendulum, first order"].F), (0, 1), [1, 0, 0, 0, 0])
    with pytest.raises(TypeError, match="fixed needs its expressions"):
        iv.solve_dae(F, (0, 1), y0, fixed=[0])
    with pytest.raises(TypeError, match="sensitivities needs its expressions"):
        iv.solve_dae(F, (0, 1), y0, sensitivities=True)
    with pytest.raises(ValueError, match="not by dop853"):
        iv.solve_dae(F, (0, 1), y0, method="dop853")
    with pytest.raises(TypeError, match="F cannot be traced"):
        iv.Dae(F, 0, y0)
    with pytest.raises(TypeError, match="combinations of derivatives in F change"):
        iv.solve_dae(opaque(lambda t, y, yp: [y[0] * yp[0] - 1, yp[1]]), (0, 1), [0, 0])


def test_residual_forms_have_neighbours_too():
    """Events, actions, extension, dense output and tolerances for each unknown."""

    def equations(t, y, yp, rate):
        return [yp[0] + rate * y[0], y[1] - y[0] ** 2]

    F = opaque(equations)
    given = {"args": (2.0,), "rtol": 1e-8, "atol": [1e-10, 1e-10]}
    sol = iv.solve_dae(F, (0, 1), [1, 0], events=lambda t, y, rate: y[1] - 0.25, dense_output=True, **given)
    assert sol.t_events[0][0] == pytest.approx(np.log(2) / 2, abs=1e-7)
    assert sol.sol(0.5)[1] == pytest.approx(np.exp(-2), rel=1e-6)
    assert sol.extend(2.0).y[1, -1] == pytest.approx(np.exp(-8), rel=1e-5)
    double = iv.Event(lambda t, y, rate: y[0] - 0.5, action=lambda t, y, rate: [2 * y[0], 0])
    doubled = iv.solve_dae(F, (0, 0.5), [1, 0], events=double, **given)
    assert len(doubled.t_events[0]) == 1
    np.testing.assert_allclose(doubled.y_end, [2 * np.exp(-1), 4 * np.exp(-2)], rtol=1e-6)
    for method in ("dop853", "radau"):  # traced, with an algebraic equation that is not linear
        nonlinear = iv.solve_dae(
            lambda t, y, yp: [yp[0] + 2 * y[0], y[1] ** 3 + y[1] - y[0]],
            (0, 0.5),
            [1, 0.7],
            method=method,
            events=iv.Event(lambda t, y: y[0] - 0.5, action=lambda t, y: [1.0, 0.6823278038280193]),
            rtol=1e-8,
            atol=1e-10,
        )
        assert nonlinear.y[0, -1] == pytest.approx(2 * np.exp(-1), rel=1e-6)


def test_residual_forms_take_jacobians_and_their_structure():
    """A rod whose ends are held has one solution by differences, by groups of columns and with exact derivatives, dense
    or sparse; with bands a Jacobian takes 6 calls instead of 2 n."""
    import scipy.sparse as sp

    def made(n):
        A = sp.diags_array([np.ones(n - 1), -2 * np.ones(n), np.ones(n - 1)], offsets=[-1, 0, 1]).tolil()
        A[0] = A[n - 1] = 0
        A[0, 0] = A[n - 1, n - 1] = -1
        D = sp.diags_array(np.r_[0.0, np.ones(n - 2), 0.0])
        F = opaque(lambda t, y, yp, k: D @ yp - k * (A @ y) - np.r_[1.0, np.zeros(n - 2), 0.5])
        return F, sp.csc_array(A), sp.csc_array(D)

    def solved(n, **given):
        F, _, _ = made(n)
        sol = iv.solve_dae(F, (0, 1), np.r_[0.5, np.zeros(n - 1)], args=(2.0,), rtol=1e-6, atol=1e-8, **given)
        return sol.y_end, sol.nfev, sol.stats.njev

    n = 12
    _, A, D = made(n)
    plain, _, _ = solved(n)
    pattern = (A != 0, D != 0)
    for given in (
        {"lband": 1, "uband": 1},
        {"jac_sparsity": pattern},
        {"jac": lambda t, y, yp, k: (-k * A.toarray(), D.toarray())},
        {"jac": lambda t, y, yp, k: (-k * A, D)},
        {"jac": lambda t, y, yp, k: (-k * A, D), "method": "radau"},
    ):
        y, calls, _ = solved(n, **given)
        np.testing.assert_allclose(y, plain, rtol=2e-4, atol=1e-6)
        assert calls < solved(n, **{name: one for name, one in given.items() if name == "method"})[1]
    (_, many, count), (_, calls, _) = solved(48), solved(48, lband=1, uband=1)
    assert many - calls > 0.8 * count * (2 * 48 - 2 - 6)
    with pytest.raises(TypeError, match="jac is for an F that cannot be traced"):
        iv.solve_dae(lambda t, y, yp: [yp[0] + y[0]], (0, 1), [1.0], jac=lambda t, y, yp: ([[1]], [[1]]))
    with pytest.raises(ValueError, match="the pair"):
        solved(n, jac=lambda t, y, yp, k: A.toarray())
    with pytest.raises(ValueError, match="either jac, or"):
        solved(n, jac=lambda t, y, yp, k: (A, D), lband=1)
