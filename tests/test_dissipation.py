"""Dissipated quantities never rise at the steps, whatever method; a function that f does not dissipate is refused."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt, explicit_and_implicit, families
from invariode import scipy as plugin

EPS = np.finfo(float).eps
#: Of an energy of the size of 1: 10 ε times its terms, in the core, and as much again where it is evaluated here.
ROUNDOFF = 100 * EPS


def pendulum(t, y, friction=0.01):
    return [y[1], -np.sin(y[0]) - friction * y[1]]


def energy(t, y, *args):
    return y[1] ** 2 / 2 - np.cos(y[0])


def heat(t, u):
    """The exponential entropy of Ranocha et al. (SIAM J. Sci. Comput. 42 (2020) A612), dissipated."""
    return [-np.exp(u[0])]


def entropy(t, u):
    return np.exp(u[0])


def forced(t, y):
    return [y[1], -np.sin(y[0]) - 0.1 * y[1] + 0.5 * np.cos(2 * t / 3)]


def lorenz(t, y):
    return [10 * (y[1] - y[0]), y[0] * (28 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]]


def rise(values):
    return max(np.diff(values).max(initial=0), 0)


@dealt(method=FAMILIES, rtol=[1e-2, 1e-4])
def test_energy_never_rises_at_steps_and_no_output_is_above_the_start_of_its_step(method, rtol):
    kept = iv.Dissipated(energy)
    sol = iv.solve_ivp(
        pendulum, (0, 30), [2.0, 0.0], method, rtol=rtol, atol=rtol / 100, invariants=kept, dense_output=True
    )
    assert sol.success
    G = energy(0, sol.y)
    assert rise(G) <= ROUNDOFF
    between = sol.t[:-1] + np.diff(sol.t) * np.linspace(0.1, 0.9, 5)[:, None]
    inside = energy(0, sol.sol(between.ravel())).reshape(between.shape)
    assert (inside <= G[:-1] + ROUNDOFF).all()
    assert (inside >= G[1:] - ROUNDOFF).all()
    assert sol.residual.max() <= ROUNDOFF
    assert sol.drift().residual_after[0] == sol.residual.max()


@dealt(method=FAMILIES, rtol=[1e-2, 1e-5])
def test_a_dissipated_exponential_entropy_is_as_accurate_as_without(method, rtol):
    given = {"method": method, "rtol": rtol, "atol": rtol, "t_eval": np.linspace(0, 5, 20)}
    plain = iv.solve_ivp(heat, (0, 5), [0.5], **given)
    kept = iv.solve_ivp(heat, (0, 5), [0.5], invariants=iv.Dissipated(entropy), **given)
    error = [abs(sol.y[0] + np.log(np.exp(-0.5) + sol.t)).max() for sol in (plain, kept)]
    assert rise(np.exp(kept.y[0])) <= ROUNDOFF
    assert error[1] <= 1.01 * error[0]
    assert kept.nfev <= plain.nfev


@families
def test_what_leaves_the_rest_state_at_crude_tolerances_does_not_when_its_square_is_dissipated(method):
    sol = iv.solve_ivp(
        lambda t, y: [-y[0]], (0, 60), [1.0], method, rtol=1e-2, atol=1e-4, invariants=iv.Dissipated(lambda t, y: y @ y)
    )
    assert sol.success
    assert rise(sol.y[0] ** 2) <= 1e-12 * sol.y[0, 0] ** 2


@explicit_and_implicit
def test_forced_systems_are_refused(method):
    held = iv.Dissipated(energy)
    sol = iv.solve_ivp(forced, (0, 30), [2.0, 0.0], method, rtol=1e-5, invariants=held, on_failure="return")
    assert sol.status == -2
    assert sol.t[-1] < 4
    assert "energy is not dissipated by fun" in sol.message
    with pytest.raises(iv.InvariantError, match="rises at the rate"):
        iv.solve_ivp(lorenz, (0, 30), [1.0, 1, 1], method, invariants=iv.Dissipated(lambda t, y: y @ y, names="size"))


def test_check_false_takes_what_is_refused():
    law = iv.Dissipated(energy)
    sol = iv.solve_ivp(forced, (0, 10), [2.0, 0.0], invariants=law, check=False)
    assert sol.success
    assert rise(energy(0, sol.y)) <= ROUNDOFF


def test_entropy_that_rises_and_runs_backwards():
    rising = iv.solve_ivp(heat, (0, 5), [0.5], rtol=1e-2, invariants=iv.Dissipated(lambda t, u: -u[0], rises=True))
    assert rising.success
    with pytest.raises(iv.InvariantError, match="falls at the rate"):
        iv.solve_ivp(heat, (0, 5), [0.5], invariants=iv.Dissipated(entropy, rises=True))
    back = iv.solve_ivp(
        pendulum, (30, 0), [0.5, 0.0], "ode113", args=(0.01,), rtol=1e-2, invariants=iv.Dissipated(energy)
    )
    assert back.success
    assert rise(-energy(0, back.y)) <= ROUNDOFF
    assert back.residual.max() <= ROUNDOFF


def test_along_with_invariants_levels_and_bounds():
    def exchange(t, y):
        flow = y[0] - y[1] ** 2
        return [-flow, flow]

    laws = [iv.Dissipated(lambda t, y: y[0] ** 2 / 2 + y[1] ** 3 / 3, names="free energy"), lambda t, y: y[0] + y[1]]
    for options in ({}, {"nonnegative": True}):
        sol = iv.solve_ivp(exchange, (0, 60), [3.0, 0.0], "ode45", rtol=1e-2, invariants=laws, **options)
        assert sol.success
        assert rise(sol.y[0] ** 2 / 2 + sol.y[1] ** 3 / 3) <= 10 * ROUNDOFF
        assert abs(sol.residual[1]).max() <= 10 * ROUNDOFF
    rod = iv.MechanicalSystem(
        [1.0, 1.0],
        lambda t, q, v: [-0.1 * v[0], -1 - 0.1 * v[1]],
        constraints=lambda t, q: q @ q - 1,
        invariants=iv.Dissipated(lambda t, y: y[2:] @ y[2:] / 2 + y[1], names="energy"),
    ).problem((0, 20), [1.0, 0.0], [0.0, 0.0])
    sol = rod.solve("ode45", rtol=1e-2)
    assert sol.success
    assert rise((sol.y[2:] ** 2).sum(axis=0) / 2 + sol.y[1]) <= 10 * ROUNDOFF
    assert abs(sol.residual[0]).max() <= 1e-12


def test_a_jump_starts_anew_unless_it_must_not_raise():
    def kicked(rehold):
        hit = iv.Event(lambda t, y: t - 5, action=lambda t, y: [y[0], y[1] + 1], rehold=rehold)
        options = {"rtol": 1e-2, "events": hit, "invariants": iv.Dissipated(energy), "on_failure": "return"}
        return iv.solve_ivp(pendulum, (0, 12), [1.0, 0.0], **options)

    sol = kicked(True)
    assert sol.success
    assert sol.residual.max() <= ROUNDOFF
    assert rise(energy(0, sol.y)) > 0.1
    refused = kicked(False)
    assert refused.status == -2
    assert "takes energy back by" in refused.message


def test_extensions_files_and_ensembles(tmp_path):
    law, options = iv.Dissipated(energy), {"method": "ode113", "rtol": 1e-2, "atol": 1e-4}
    sol = iv.solve_ivp(pendulum, (0, 15), [2.0, 0.0], invariants=law, dense_output=True, **options).extend(30)
    assert rise(energy(0, sol.y)) <= ROUNDOFF
    sol.save(tmp_path / "pendulum.npz")
    again = iv.load(tmp_path / "pendulum.npz", invariants=law)
    t = np.linspace(0, 30, 100)
    assert (again.sol(t) == sol.sol(t)).all()
    assert (again.residual == sol.residual).all()
    all_of_them = iv.solve_ensemble(pendulum, (0, 30), [[2.0, 0.0], [1.0, 0.5]], invariants=law, **options)
    assert all_of_them.success.all()
    alone = iv.solve_ivp(pendulum, (0, 30), [2.0, 0.0], invariants=law, **options)
    assert (all_of_them.y_end[0] == alone.y[:, -1]).all()


def test_compiled_functions_on_threads_and_the_plug_in():
    pytest.importorskip("numba")

    f, g = iv.compile(lambda t, y: (y[1], -np.sin(y[0]) - 0.01 * y[1])), iv.compile(energy_of_state)
    many = iv.solve_ensemble(
        f, (0, 30), [[2.0, 0.0], [1.0, 0.5]], invariants=iv.Dissipated(g, names="energy"), rtol=1e-2, workers=2
    )
    assert many.success.all()
    stepper = plugin.ODE45(pendulum, 0, [2.0, 0.0], 10, invariants=iv.Dissipated(energy), rtol=1e-2)
    values = [energy(0, stepper.y)]
    while stepper.status == "running":
        stepper.step()
        values.append(energy(0, stepper.y))
    assert rise(np.array(values)) <= ROUNDOFF


def energy_of_state(t, y):
    return y[1] ** 2 / 2 - np.cos(y[0])


def test_the_report_tells_what_falls():
    report = iv.check_invariants(pendulum, [iv.Dissipated(energy)], 0, [1.0, 0.5])
    assert report.ok
    assert report.senses == [-1]
    assert "falls" in str(report)
    assert not iv.check_invariants(pendulum, energy, 0, [1.0, 0.5]).ok
    wrong = iv.check_invariants(pendulum, iv.Dissipated(energy, rises=True), 0, [1.0, 0.5])
    assert wrong.findings[0] == "energy is not dissipated by fun: it falls"
    assert "NO" in str(wrong)


def test_single_points_have_no_past():
    law = iv.Dissipated(energy)
    assert repr(law) == "Dissipated(energy)"
    assert repr(iv.Dissipated(energy, rises=True, names="E")) == "Dissipated(E, rises=True)"
    with pytest.raises(ValueError, match="leave it out"):
        iv.impose(law, 0.0, [1.0, 0.5])
    sol = iv.solve_ivp(pendulum, (0, 5), [2.0, 0.0], invariants=law)
    with pytest.raises(ValueError, match="no invariants"):
        sol.impose()
    with pytest.raises(TypeError, match="rises"):
        iv.Dissipated(energy, rises="yes")


def oscillator(t, y, friction):
    return [y[1], -y[0] - y[0] ** 3 - friction * y[1]]


def duffing(t, y, *args):
    return y[1] ** 2 / 2 + y[0] ** 2 / 2 + y[0] ** 4 / 4


@families
def test_errors_of_one_sign_do_not_add_up(method):
    """G is as accurate as without projection: errors that lower it are not kept while those that raise it are lost.
    What is off at one tolerance differs by a factor of 3 between runs, since the steps differ."""
    t = np.linspace(0, 100, 101)
    for friction in (1e-6, 1e-2):
        about = {"args": (friction,), "t_eval": t}
        exact = duffing(t, iv.solve_ivp(oscillator, (0, 100), [1.0, 0.0], "dop853", rtol=1e-11, atol=1e-11, **about).y)
        for rtol in (1e-4, 1e-5):
            about |= {"rtol": rtol, "atol": rtol}
            plain = iv.solve_ivp(oscillator, (0, 100), [1.0, 0.0], method, **about)
            kept = iv.solve_ivp(oscillator, (0, 100), [1.0, 0.0], method, invariants=iv.Dissipated(duffing), **about)
            off, off_plain = (abs(duffing(t, sol.y) - exact).max() for sol in (kept, plain))
            assert off <= 3 * off_plain
            assert rise(duffing(t[-1], kept.y)) <= 10 * rtol  # between steps


@explicit_and_implicit
def test_debts_of_a_run_last_over_its_extensions(method):
    law = iv.Dissipated(duffing)
    about = {"method": method, "args": (1e-6,), "rtol": 1e-4, "atol": 1e-4, "invariants": law}
    whole = iv.solve_ivp(oscillator, (0, 60), [1.0, 0.0], breakpoints=[30.0], **about)
    parts = iv.solve_ivp(oscillator, (0, 60), [1.0, 0.0], breakpoints=[30.0], max_steps=40, **about).extend(
        60, max_steps=None
    )
    assert (whole.y[:, -1] == parts.y[:, -1]).all()


def test_a_law_that_is_not_violated_costs_one_evaluation_a_step():
    sol = iv.solve_ivp(heat, (0, 5), [0.5], rtol=1e-6, invariants=iv.Dissipated(entropy))
    assert sol.stats.projections == 0
    assert sol.stats.ngjac == 0
    plain = iv.solve_ivp(heat, (0, 5), [0.5], rtol=1e-6)
    assert sol.nfev == plain.nfev
    assert (sol.y == plain.y).all()
