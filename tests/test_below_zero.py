"""A component that starts at or above 0, ends far below it, and was not led there by f, is named in one warning."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import invariode as iv
from cases import METHODS
from invariode._functions import lanes

ATOL = 1e-6
NOTABLE = 100 * ATOL
Y0, END = [0.6, 0.6, 0.1], 3000.0


def may_leonard(t, y, a=0.8, b=1.3):
    """Three competing species, whose densities stay positive; each is nearly extinct for longer and longer."""
    x, y, z = y
    return [x * (1 - x - a * y - b * z), y * (1 - b * x - y - a * z), z * (1 - a * x - b * y - z)]


def said_by(run):
    """Return the value of `run`, and its warnings of components below 0."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = run()
    return found, [str(one.message) for one in caught if "below 0" in str(one.message)]


def test_a_run_says_so_if_and_only_if_a_positive_component_ends_below_zero():
    ran_away, problem = set(), iv.Problem(may_leonard, (0, END), Y0, labels=list("abc"))
    for method in METHODS:
        sol, said = said_by(lambda method=method: problem.solve(method))
        below = np.flatnonzero(sol.y[:, -1] < -NOTABLE)
        assert bool(said) == bool(below.size), (method, sol.y[:, -1], said)
        assert len(said) <= 1
        if below.size:
            i = min(below, key=lambda i: sol.y[i, -1])
            assert said[0].startswith("abc"[i])
            assert f"nonnegative=[{i}]" in said[0]
            ran_away.add(method)
    assert {"ode15s", "ode23t"} <= ran_away
    assert "ode45" not in ran_away
    meant, said = said_by(lambda: iv.ode15s(may_leonard, (0, END), Y0, nonnegative=False))
    assert meant.y[:, -1].min() < -1
    assert not said
    kept, said = said_by(lambda: iv.ode15s(may_leonard, (0, END), Y0, nonnegative=True))
    assert kept.y.min() >= 0
    assert not said


def test_components_that_f_leads_below_zero_are_never_named():
    rng, went_below = np.random.default_rng(1), 0
    for case in range(40):
        n = int(rng.integers(2, 6))
        A = rng.normal(size=(n, n))
        A -= A.T + np.diag(rng.uniform(0, 0.5, n))
        y0 = np.where(rng.uniform(size=n) < 0.7, rng.uniform(0, 1, n), 0.0)
        method, rtol, atol = (
            list(METHODS)[case % len(METHODS)],
            10.0 ** -rng.integers(3, 7),
            10.0 ** -rng.integers(4, 10),
        )
        M = None if case % 3 or METHODS[method].mass == "none" else np.eye(n) + 0.1 * np.eye(n, k=1)
        mass = {} if M is None else {"mass": M}
        sol = iv.solve_ivp(lambda t, y, A=A: A @ y, (0, 15), y0, method, rtol=rtol, atol=atol, **mass)
        went_below += bool((sol.y < -100 * atol).any())
    assert went_below > 30


def test_an_action_that_goes_below_zero_is_meant():
    kick = {1.0: lambda t, y: [-1.0]}
    sol = iv.ode15s(lambda t, y: -y, (0, 2), [1.0], breakpoints=kick)
    assert sol.y[0, -1] < -0.3


@pytest.mark.parametrize("method", ["ode15s", "ode23"])
def test_the_warning_and_its_evaluations_are_those_of_a_run_without_interruption(method):
    whole, said = said_by(lambda: iv.solve_ivp(may_leonard, (0, END), Y0, method))
    assert len(said) == 1
    part, _ = said_by(
        lambda: iv.solve_ivp(may_leonard, (0, END), Y0, method, limits=iv.Limits(steps=whole.stats.steps // 2))
    )
    resumed, said_again = said_by(lambda: part.extend(END, limits=None))
    assert said_again == said
    assert resumed.y[:, -1].tolist() == whole.y[:, -1].tolist()
    assert resumed.stats.nfev_check == whole.stats.nfev_check > 0


def returning(t, y, p):
    """A component that decays into the noise and returns from it, and one that oscillates."""
    return [10 * (t - 2) * y[0], y[2], -p[0] * y[1]]


def test_an_ensemble_warns_once_and_counts_as_its_trajectories_do(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr(lanes, "FEWEST", 0)
    problem = iv.Problem(iv.compile(returning), (0, 4), [1.0, 1.0, 0.0], args=(1.0,))
    y0 = np.column_stack([np.linspace(0.5, 1.5, 40), np.ones(40), np.zeros(40)])
    p = np.linspace(1, 9, 40)[:, None]
    for method in ("ode23", "ode15s"):
        alone, said_alone = said_by(lambda method=method: problem.solve_ensemble(y0, args=p, method=method, lanes=1))
        found, said = said_by(lambda method=method: problem.solve_ensemble(y0, args=p, method=method))
        assert " lanes, " in found.stats.lanes or method == "ode15s"
        fallen = np.count_nonzero(alone.y_end[:, 0] < -NOTABLE)
        assert 0 < fallen < 40
        assert said == said_alone
        assert len(said) == 1
        assert said[0].startswith(f"y0 fell below 0 in {fallen} trajectories")
        np.testing.assert_array_equal(found.y_end, alone.y_end)
        np.testing.assert_array_equal(found.stats.nfev_check, alone.stats.nfev_check)
        for i in (0, 17, 39):
            sol, said = said_by(lambda i=i, method=method: problem.replace(y0=y0[i], args=tuple(p[i])).solve(method))
            assert bool(said) == (alone.y_end[i, 0] < -NOTABLE)
            assert sol.stats.nfev_check == alone.stats.nfev_check[i]
    _, said = said_by(lambda: problem.replace(nonnegative=False).solve_ensemble(y0, args=p, method="ode23"))
    assert not said
