"""Invariants that change with t, at breakpoints and knots: their derivatives see one side of these only."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, families


def fun(t, y):
    return [0.5 - y[0], y[0]]


def g(t, y):
    return y[0] + y[1] - t / 2


def curved(t, y):
    """y0 + y1 + sin 3t of the system in which f0 has −3 cos 3t besides."""
    return y[0] + y[1] + np.sin(3 * t) - t / 2


def curved_fun(t, y):
    return [0.5 - y[0] - 3 * np.cos(3 * t), y[0]]


@pytest.mark.parametrize("name", METHODS)
def test_an_invariant_of_t_passes_at_a_breakpoint_and_one_of_another_rate_does_not(name):
    for points in ([0.0], [0.0, 1.0], [1.0, 4.0]):
        for span in ((0, 4), (4, 0)):
            for f, right in ((fun, g), (curved_fun, curved)):
                sol = iv.solve_ivp(f, span, [1.0, 0.0], name, invariants=right, breakpoints=points)
                assert sol.success
                for rate in (1.0, -0.5):  # t/2 becomes t, or 0
                    with pytest.raises(iv.InvariantError, match="not conserved"):
                        iv.solve_ivp(
                            f,
                            span,
                            [1.0, 0.0],
                            name,
                            invariants=lambda t, y, right=right, rate=rate: right(t, y) - rate * t / 2,
                            breakpoints=points,
                        )


@families
def test_so_it_is_with_knots_of_inputs_dissipation_and_prepared_runs(method):
    table = iv.Input([0.0, 1.0, 3.0], [0.5, 0.5, 0.5], "linear")

    def fed(t, y, u):
        return [u - y[0], y[0]]

    for rate, right in ((0.5, True), (1.0, False)):
        problem = iv.Problem(
            fed, (0, 3), [1.0, 0.0], inputs=[table], invariants=lambda t, y, rate=rate: y[0] + y[1] - rate * t
        )
        if right:
            assert problem.solve(method).success
        else:
            with pytest.raises(iv.InvariantError, match="not conserved"):
                problem.solve(method)
    falls = iv.Dissipated(lambda t, y: y[0] + y[1] - t / 2 - 0.1 * np.cos(t))  # + 0.1 sin t: it rises
    with pytest.raises(iv.InvariantError):
        iv.solve_ivp(fun, (0.5, 3), [1.0, 0.0], method, breakpoints=[0.5], invariants=falls)
    for right in (iv.Dissipated(g), iv.Dissipated(lambda t, y: g(t, y) - t)):
        assert iv.solve_ivp(fun, (0, 3), [1.0, 0.0], method, breakpoints=[0.0], invariants=right).success
    problem = iv.Problem(fun, (0, 3), [1.0, 0.0], invariants=g)
    assert problem.prepare(method, breakpoints=[0.0])(y0=[1.0, 0.0]).success


def test_a_rate_that_one_sided_differences_halve_is_still_seen():
    """g of twice the rate: half of its derivative in t, as differences across an edge give it, would be right."""
    for method in ("ode45", "ode15s", "dop853"):
        with pytest.raises(iv.InvariantError) as refused:
            iv.solve_ivp(fun, (0, 4), [1.0, 0.0], method, breakpoints=[0.0], invariants=lambda t, y: y[0] + y[1] - t)
        assert "-0.5" in str(refused.value)
