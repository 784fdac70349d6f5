"""Problems with costs, and their gradients in both ways, for the tests of adjoints."""

from __future__ import annotations

import numpy as np

import invariode as iv
from invariode._run.run import solve

RTOL, ATOL = 1e-7, 1e-9
RATES = (1.5, 1.0, 3.0, 1.0)
START = [1.0, 1.0]


CHECKPOINTS = {"adjoint": "checkpoints"}


def predators(t, y, a, b, c, d):
    return [a * y[0] - b * y[0] * y[1], -c * y[1] + d * y[0] * y[1]]


def solved(method="dop853", t_span=(0, 10), **options):
    given = {"args": RATES, "rtol": RTOL, "atol": ATOL, "max_step": np.inf, "adjoint": True} | options
    return iv.solve_ivp(predators, t_span, START, method, **given)


def both_ways(sol, *, times=None, rtol):
    """The gradient of a cost at some times, forwards and backwards, up to a tolerance in units of the largest term: ten
    times rtol of the run, 100 times where jumps add to the errors. With checkpoints it is the same."""
    times = np.linspace(*sol.sol.ts[[0, -1]], 5) if times is None else np.asarray(times)
    costs = np.random.default_rng(29).normal(size=(len(sol.y), len(times)))
    if np.iscomplexobj(sol.y):
        costs = costs * np.exp(1j * np.arange(len(times)))
    terms = np.real(costs[:, None, :] * sol.sol.sensitivities(times))
    expected = terms.sum(axis=(0, 2))
    found = sol.gradient(costs, t=times)
    np.testing.assert_allclose(found, expected, atol=rtol * np.abs(terms).max())
    source = sol._origin.source
    options = source.options | {"dense_output": False, "keep": "end"} | CHECKPOINTS
    again = solve(source.problem, source.method, options)
    assert np.array_equal(again.gradient(costs, t=times), found)
