"""Where three capabilities meet, values, events, outputs, derivatives and restarts are those of the exact solution."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest

import invariode as iv
import seams
from cases import IMPLICIT, explicit_and_implicit


@pytest.mark.slow
def test_each_triple_that_is_possible_is_met():
    """Each three levels of different factors stand together in a row, and no row is excluded."""
    rows = seams.covering_array()
    met = set().union(*(seams.met(row) for row in rows))
    assert seams.triples() <= met
    assert all(map(seams.allowed, rows))
    assert all(row[name] in levels for row in rows for name, levels in seams.FACTORS.items())


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_where_three_capabilities_meet(part):
    rows = list(enumerate(seams.covering_array()))
    found = {i: seams.wrong_case(row, Random(f"seams:{i}")) for i, row in rows[part::4]}
    assert {f"{i}: {rows[i][1]}": wrong for i, wrong in found.items() if wrong} == {}


def test_wrong_answers_are_found():
    """The run is not that of an exact solution whose rate is half a percent larger: the comparison can fail."""
    row = next(row for row in seams.covering_array() if row["output"] == "steps" and row["events"] == "terminal")
    random = Random("wrong")
    posed = seams.Posed(seams.scenario(row, random), random)
    sol = posed.solve()
    assert seams.wrong_solution(posed, sol) is None
    posed.exact = posed.about.changed(k=1.005 * posed.about.k).solution()
    assert seams.wrong_solution(posed, sol) is not None


@pytest.mark.parametrize("case", ["77:35208", "77:69120"])
def test_what_a_campaign_has_found(case):
    """A run with S that is cut at a landing has the same knots; a bound is not passed late by an estimate of chance."""
    random = Random(f"seams:{case}")
    row = seams.random_row(random, [name for name, one in iv.METHODS.items() if one.equations != "second-order"])
    assert seams.wrong_case(row, random) is None


@explicit_and_implicit
def test_an_action_that_ends_the_run(method):
    """If an action sets off a terminal event, derivatives are those of the state after it, forward and adjoint."""
    lift = iv.Event(lambda t, y, k: t + 0.2 * y[0] - 1.5, direction=1, action=lambda t, y, k: [y[0] + 0.5])
    above = iv.Event(lambda t, y, k: y[0] - 0.7, direction=1, terminal=True)
    sol = iv.solve_ivp(
        lambda t, y, k: [-k * y[0]], (0, 4), [1.0], method, args=(0.8,), events=[lift, above], sensitivities=True,
        dense_output=True, rtol=1e-8, atol=1e-10,
    )  # fmt: skip
    tau = sol.t_end
    a = np.exp(-0.8 * tau)
    exact = -tau * a + 0.8 * 0.5 * 0.2 * tau * a / (1 - 0.16 * a)
    assert sol.status == 1
    np.testing.assert_allclose([sol.sensitivities[0, 0, -1], sol.gradient([1.0])[0]], exact, atol=1e-6)


@explicit_and_implicit
def test_an_action_that_takes_a_component_off_its_bound(method):
    """Before the action at τ, y1 rests: its derivative in y1(T) = 0.7 - r (T - τ) is r ∂τ/∂k, forward and adjoint."""

    def lifted(t, y, k, r):
        return [y[0], y[1] + 0.7]

    event = iv.Event(lambda t, y, k, r: t + 0.2 * y[0] - 3, direction=1, action=lifted)
    sol = iv.solve_ivp(
        lambda t, y, k, r: [-k * y[0], -r], (0, 3.5), [1.0, 1.0], method, args=(0.8, 0.6), events=event,
        nonnegative=[1], sensitivities=True, dense_output=True, rtol=1e-8, atol=1e-10,
    )  # fmt: skip
    tau = float(sol.t_events[0][0])
    a = np.exp(-0.8 * tau)
    exact = [0.6 * 0.2 * tau * a / (1 - 0.16 * a), tau - 3.5]
    np.testing.assert_allclose(sol.sensitivities[1, :, -1], exact, atol=1e-6)
    np.testing.assert_allclose(sol.gradient([0.0, 1.0]), exact, atol=1e-6)


@pytest.mark.parametrize("method", [name for name in IMPLICIT if iv.METHODS[name].mass == "any"])
def test_residuals_of_invariants_after_a_jump_of_algebraic_equations(method, tmp_path):
    """The values at which invariants are held after a jump are those of the invariants, without algebraic equations."""
    sol = iv.solve_ivp(
        lambda t, y: [-0.6, 0.6, y[2] - y[0]], (0, 2), [1.0, 0.0, 1.0], method, mass=np.diag([1.0, 1.0, 0.0]),
        invariants=lambda t, y: [y[0] + y[1], y[1] - 0.6 * t],
        breakpoints={1.0: lambda t, y: [y[0] + 1, y[1] + 1, y[0] + 1]},
    )  # fmt: skip
    assert sol.residual.shape == (2, len(sol.t))
    assert np.abs(sol.residual).max() < 1e-12
    sol.save(tmp_path / "run.npz")
    np.testing.assert_array_equal(iv.load(tmp_path / "run.npz").residual, sol.residual)
