"""Pulses of f after a long rest are seen: radau and auto look at f inside long steps, unless f does not depend on t."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

import invariode as iv
from cases import hidden
from invariode import symbolic

#: Parts of the interval in each of which f is evaluated at least once.
PARTS = {"radau": 128, "auto": 64}


def rest(t, y):
    """Two compartments that empty slowly; steps grow to a tenth of the interval. t does not occur."""
    return [-0.1 * y[0], 0.1 * y[0] - 0.05 * y[1]]


SPAN, START = (0.0, 100.0), [1.0, 0.0]


def times_seen(method, span, **options):
    seen = []

    @hidden
    def fun(t, y):
        seen.append(t)
        return rest(t, y)

    sol = iv.solve_ivp(fun, span, START, method, **options)
    assert sol.success
    return np.sort([*seen, *span])


@pytest.mark.parametrize("method", PARTS)
@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-9])
def test_no_two_neighbouring_times_at_which_f_is_seen_are_farther_apart_than_a_part_of_the_interval(method, rtol):
    for span in (SPAN, SPAN[::-1]):
        for options in ({}, {"t_eval": np.linspace(*span, 11)}, {"breakpoints": [37.0]}):
            seen = times_seen(method, span, rtol=rtol, atol=1e-3 * rtol, **options)
            assert np.diff(seen).max() <= 100 / PARTS[method] * (1 + 1e-12)


def test_auto_pays_at_most_one_evaluation_for_each_part_of_a_smooth_problem():
    for rtol in (1e-3, 1e-5, 1e-7, 1e-9):
        auto, adams = (
            iv.solve_ivp(hidden(rest), SPAN, START, method, rtol=rtol, atol=1e-3 * rtol)
            for method in ("auto", "ode113")
        )
        np.testing.assert_array_equal(auto.y, adams.y)
        assert adams.nfev < auto.nfev <= adams.nfev + PARTS["auto"]


def by_default(t, y, at=50.0):
    return [-0.1 * y[0] + (np.exp(-((t - at) ** 2)) if at else 0.0), 0.1 * y[0] - 0.05 * y[1]]


def by_name(t, y):
    return [-0.1 * y[0] + np.exp(-((eval("t") - 50.0) ** 2)), 0.1 * y[0] - 0.05 * y[1]]


def test_pulses_are_looked_for_where_f_may_depend_on_t_and_only_there():
    """One f after the other: they share a plan, except for what decides this."""
    compiled = iv.compile(rest)
    x, z = sympy.symbols("x z")
    formula = symbolic.equations({x: -x / 10, z: x / 10 - z / 20}).problem(SPAN, START)
    for _ in range(2):
        for fun in (rest, hidden(rest), by_default, by_name, compiled, lambda *given: rest(*given)):
            looks, adams = (iv.solve_ivp(fun, SPAN, START, name, rtol=1e-6).nfev for name in ("auto", "ode113"))
            assert (looks == adams) == (fun in (rest, compiled)), fun
        assert formula.solve("auto", rtol=1e-6).nfev == formula.solve("ode113", rtol=1e-6).nfev
    rows = [iv.odeint(fun, START, [0.0, 100.0], tfirst=True, full_output=True) for fun in (rest, hidden(rest))]
    calls = [int(info["nfe"][-1]) for _, info in rows]
    assert calls[0] < calls[1]
    np.testing.assert_array_equal(rows[0][0], rows[1][0])


def lost(solve, centre, width):
    """More than 30 % of what the pulse leaves at the end is missing."""

    @hidden
    def fun(t, y):
        a, b = rest(t, y)
        return [a + np.exp(-0.5 * ((t - centre) / width) ** 2) / width, b]

    s = np.linspace(centre - 8 * width, centre + 8 * width, 4001)
    pulse = np.trapezoid(np.exp(-0.5 * ((s - centre) / width) ** 2) / width * np.exp(-0.1 * (100 - s)), s)
    return not abs(solve(fun) - np.exp(-10.0) - pulse) <= 0.3 * pulse


@pytest.mark.parametrize("name", ["radau", "auto", "odeint"])
def test_smooth_pulses_as_wide_as_a_part_are_not_lost(name):
    """Within four of its widths from the centre, a pulse changes f by more than the tolerance: a third of a part is
    enough."""
    rng = np.random.default_rng(5)
    options = {"rtol": 1e-6, "atol": 1e-9}

    def solve(fun):
        if name == "odeint":
            return iv.odeint(fun, START, [0.0, 100.0], tfirst=True, **options)[-1, 0]
        return iv.solve_ivp(fun, SPAN, START, name, **options).y[0, -1]

    widest = 100 / PARTS.get(name, 64) / 3
    for _ in range(25):
        centre, width = rng.uniform(5, 93), widest * rng.uniform(1, 2)
        assert not lost(solve, centre, width), (centre, width)


@pytest.mark.parametrize("method", PARTS)
def test_a_run_that_is_interrupted_sees_the_same(method):
    problem = iv.Problem(hidden(rest), SPAN, START)
    whole = problem.solve(method, rtol=1e-6)
    part = problem.solve(method, rtol=1e-6, max_steps=len(whole.t) // 2)
    assert part.status == -3
    extended = part.extend(SPAN[1])
    np.testing.assert_array_equal(extended.y, whole.y)
    assert extended.nfev == whole.nfev
