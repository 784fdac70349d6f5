"""The method that chooses itself: what it costs, and that nothing is lost where one member hands over to the other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

import invariode as iv
from cases import dealt
from invariode import scipy as plugin
from invariode.problems import hires, kepler, robertson
from stiff import oregonator
from test_implicit import ROBERTSON


def van_der_pol(mu):
    return lambda t, y: [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]]


def relaxation(mu, method="auto", **options):
    return iv.solve_ivp(van_der_pol(mu), (0, max(20, 2 * mu)), [2.0, 0.0], method, **options)


def turns(sol):
    """Times at which each turn but the first begins."""
    return np.flatnonzero(sol.steps.method[1:] != sol.steps.method[:-1]) + 1


STIFF = {
    **{f"van der Pol, {mu:g}": (van_der_pol(mu), (0, max(20, 2 * mu)), [2.0, 0.0]) for mu in (1, 10, 100, 1e4, 1e6)},
    "Oregonator": (oregonator, (0, 360), [1.0, 2.0, 3.0]),
    **{p.name: (p.fun, p.t_span, p.y0) for p in (robertson(), hires(), kepler())},
}


@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")  # of the explicit member alone
@dealt(name=STIFF, rtol=[1e-3, 1e-6])
def test_it_costs_little_more_than_the_better_member(name, rtol):
    # Robertson's concentrations, at the end far below atol, run away once they are negative.
    options = {"rtol": rtol, "atol": rtol / 1000, "nonnegative": name.startswith("Robertson")}
    auto = iv.solve_ivp(*STIFF[name], "auto", **options)
    implicit = iv.solve_ivp(*STIFF[name], "ode15s", **options)
    explicit = iv.solve_ivp(*STIFF[name], "ode113", max_steps=implicit.nfev, **options)
    assert auto.success
    assert auto.nfev <= 1.3 * min([implicit.nfev, *[explicit.nfev] * explicit.success])


@pytest.mark.parametrize("mu", [10, 1e3, 1e5])
def test_members_take_turns_and_do_not_chatter(mu):
    """Two jumps, into each of which and out of which it hands over once, or twice where that pays."""
    sol = relaxation(mu, rtol=1e-5)
    assert 3 <= sol.stats.switches == len(turns(sol)) <= 9
    assert set(sol.steps.method) == {"ode113", "ode15s"}
    assert sol.steps.method[0] == "ode113"
    assert abs(sol.y[0]).max() < 2.1


def test_where_nothing_is_stiff_it_is_the_explicit_method():
    problem = kepler()
    auto, explicit = problem.solve("auto", rtol=1e-6), problem.solve("ode113", rtol=1e-6)
    np.testing.assert_array_equal(auto.y, explicit.y)
    assert (auto.nfev, auto.stats.switches, auto.njev) == (explicit.nfev, 0, 0)
    assert (auto.steps.method == "ode113").all()


def test_with_a_mass_matrix_it_is_the_implicit_method():
    options = {"mass": np.diag([1.0, 1, 0]), "rtol": 1e-5}

    def fun(t, y):
        a, b, _ = ROBERTSON.fun(t, y)
        return [a, b, sum(y) - 1]

    auto, implicit = (iv.solve_ivp(fun, (0, 1e3), [1, 0, 0], method, **options) for method in ("auto", "ode15s"))
    np.testing.assert_array_equal(auto.y, implicit.y)
    assert (auto.steps.method == "ode15s").all()


@pytest.mark.parametrize("pair", [("ode45", "radau"), ("dop853", "ode23tb"), ("ode23", "ode23s"), ("RK45", "BDF")])
def test_the_members_can_be_named(pair):
    names = tuple(
        iv.METHODS[name].name if name in iv.METHODS else {"RK45": "ode45", "BDF": "ode15s"}[name] for name in pair
    )
    sol = relaxation(100, prefer=pair, rtol=1e-4, dense_output=True)
    assert sol.success
    assert set(sol.steps.method) == set(names)
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)


@pytest.mark.parametrize(
    ("prefer", "error"),
    [
        ("ode45", TypeError),
        (("ode45",), TypeError),
        (("ode15s", "ode45"), ValueError),
        (("ode45", "auto"), ValueError),
        (("ode45", "ode99"), ValueError),
    ],
)
def test_and_wrong_names_are_refused(prefer, error):
    with pytest.raises(error, match=r"prefer|unknown method"):
        relaxation(10, prefer=prefer)


def test_the_solution_is_continuous_across_hand_overs():
    sol = relaxation(100, rtol=1e-6, dense_output=True, refine=3)
    at = sol.steps.t[turns(sol) - 1]
    assert len(at) >= 3
    for t in at:
        beside = sol.sol(t + np.array([-1, 1]) * 1e-9)
        np.testing.assert_allclose(beside, np.column_stack([sol.sol(t)] * 2), atol=1e-5)
    between = np.linspace(0, 200, 1000)
    exact = relaxation(100, "radau", rtol=1e-9, atol=1e-11, t_eval=between).y
    slow = np.abs(exact[1]) < 1  # in a jump an error of its time is one of the solution
    np.testing.assert_allclose(sol.sol(between)[0, slow], exact[0, slow], atol=5e-3)


def test_events_and_projection_go_on_through_hand_overs():
    total = iv.Invariants(lambda t, y: sum(y), value=1.0)
    problem = iv.Problem(
        ROBERTSON.fun, (0, 1e5), ROBERTSON.y0, invariants=total, events=lambda t, y: y[0] - 0.5, jac=ROBERTSON.jac
    )
    sol = problem.solve("auto", rtol=1e-6, atol=1e-10, dense_output=True)
    assert sol.stats.switches >= 1
    assert abs(sol.residual).max() < 1e-14
    assert abs(sol.sol(np.logspace(-5, 5, 300)).sum(axis=0) - 1).max() < 1e-14
    expected = problem.solve("radau", rtol=1e-9, atol=1e-13).t_events[0]
    np.testing.assert_allclose(sol.t_events[0], expected, rtol=1e-4)


FORMS = {
    "differences": {},
    "function": {"jac": ROBERTSON.jac},
    "sparse": {"jac": lambda t, y: sparse.csc_array(ROBERTSON.jac(t, y))},
    "pattern": {"jac_sparsity": np.ones((3, 3))},
    "bands": {"lband": 2, "uband": 2},
}


@pytest.mark.parametrize("form", FORMS)
def test_jacobians_are_those_of_the_implicit_member(form):
    sol = iv.solve_ivp(ROBERTSON.fun, (0, 1e3), ROBERTSON.y0, "auto", rtol=1e-6, atol=1e-10, **FORMS[form])
    exact = iv.solve_ivp(ROBERTSON.fun, (0, 1e3), ROBERTSON.y0, "radau", rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(sol.y[:, -1], exact.y[:, -1], rtol=1e-4)
    assert sol.njev > 0
    assert sol.steps.method[-1] == "ode15s"


def test_an_undefined_jacobian_leaves_the_explicit_member_alone():
    """The explicit member takes over where the implicit one cannot make its first step."""
    sol = iv.solve_ivp(lambda t, y: [-300 * (y[0] - np.cos(t))], (0, 3), [1.0], "auto", jac=lambda t, y: [[np.nan]])
    assert sol.success
    np.testing.assert_allclose(sol.y[0, -1], np.cos(3), atol=5e-3)
    assert (sol.steps.method == "ode113").all()


def test_a_large_problem_without_a_pattern_needs_no_matrix():
    """A dense Jacobian would take 3 GB."""
    sol = iv.solve_ivp(lambda t, y: -y, (0, 1), np.ones(20_000), "auto", keep="end")
    np.testing.assert_allclose(sol.y[:, -1], np.exp(-1), rtol=1e-3)
    assert sol.stats.switches == 0


def test_files_keep_who_made_which_step(tmp_path):
    sol = relaxation(50, dense_output=True)
    sol.save(tmp_path / "relaxation.npz")
    again = iv.load(tmp_path / "relaxation.npz")
    np.testing.assert_array_equal(again.steps.method, sol.steps.method)
    times = np.linspace(0, 100, 333)
    np.testing.assert_array_equal(again.sol(times), sol.sol(times))
    assert again.stats.switches == sol.stats.switches > 0


def test_an_extension_starts_anew_and_tells_its_methods():
    first = relaxation(50)
    longer = first.extend(150)
    assert longer.stats.switches > first.stats.switches
    assert len(longer.steps.method) == len(longer.steps.t)


def test_each_trajectory_of_an_ensemble_chooses_for_itself():
    def fun(t, y, mu):
        return [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]]

    mu = np.array([1.0, 30.0, 300.0])
    together = iv.solve_ensemble(fun, (0, 30), [2.0, 0.0], args=mu[:, None], method="auto")
    alone = [iv.solve_ivp(fun, (0, 30), [2.0, 0.0], "auto", args=(one,)) for one in mu]
    np.testing.assert_array_equal(together.y_end, [sol.y[:, -1] for sol in alone])
    np.testing.assert_array_equal(together.stats.switches, [sol.stats.switches for sol in alone])
    assert together.stats.switches[0] == 0 < together.stats.switches[-1]


def test_the_class_of_that_name_in_scipy():
    import scipy.integrate

    ours = scipy.integrate.solve_ivp(van_der_pol(100), (0, 200), [2.0, 0.0], method=plugin.LSODA)
    np.testing.assert_array_equal(ours.y, relaxation(100).y)
    assert ours.nlu > 0


def test_steps_of_the_second_method_are_shaded():
    panels = relaxation(100).plot_steps()
    spans = [patch for patch in panels[0].patches if patch.get_label() == "ode15s"]
    assert len(spans) == 1
    assert len(panels[0].patches) == len(panels[1].patches) >= 2
