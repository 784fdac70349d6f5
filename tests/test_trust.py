"""Wrong functions are reported, however little is wrong; right ones are neither accused nor harmed."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import invariode as iv
import solved_mechanisms
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families, hidden
from gallery import GALLERY
from invariode.scipy import ODE45
from problems import PROBLEMS, henon_heiles, henon_heiles_energy, kepler, kepler_invariants, pendulum_constraints
from solved_mechanisms import (
    CAR,
    CRANK,
    ELASTIC_CRANK,
    car_axis,
    car_constraints,
    crank_constraints,
    elastic_crank_constraints,
    slider_crank,
)

sys.path.insert(0, str(Path(__file__).parent / "fuzz"))
import campaign_invariants as campaign

EPS = np.finfo(float).eps


# ----------------------------------------------------------------------------------------------------------------------
# Wrong by little


@dealt(16, method=METHODS, p=[1e-7, 1e-6], rtol=[1e-9, 1e-11])
def test_a_coefficient_wrong_by_less_than_one_in_a_million_is_found_where_it_matters(method, p, rtol):
    sol = iv.solve_ivp(
        henon_heiles,
        (0, 10),
        [0, 0.1, 0.45, 0.1],
        method,
        rtol=rtol,
        atol=1e-3 * rtol,
        invariants=lambda t, y: henon_heiles_energy(t, y) + p * y[0] ** 2 * y[1],
        keep="end",
        on_failure="return",
    )
    assert sol.status == -2, sol.message


@pytest.mark.slow
def test_right_invariants_are_never_accused_in_random_runs():
    assert [str(case) for case in campaign.cases(20, 5, right=True) if campaign.accused(case)] == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::invariode.AccuracyWarning")
def test_what_is_not_found_costs_little():
    """In random runs with derivatives of all kinds, and errors of a coefficient from 1e-9 to 1e-2 of it."""
    lost = [(campaign.loss(case), str(case)) for case in campaign.cases(60, 6, right=False)]
    assert sum(loss is None for loss, _ in lost) > 20  # found
    assert [case for loss, case in lost if loss is not None and loss > 30] == []


ROUNDED = 10  # decimals


@pytest.mark.parametrize(("p", "status"), [(0, 0), (0.01, -2)])
def test_an_invariant_that_cannot_be_met_to_roundoff_is_judged_all_the_same(p, status):
    """If the projection does not reach roundoff, rates before and after it tell as much."""
    held = iv.Invariants(lambda t, y: np.round(y[1] ** 2 / 2 + 2 * (1 + p) * y[0] ** 2, ROUNDED), value=None)
    try:
        sol = iv.solve_ivp(lambda t, y: [y[1], -4 * y[0]], (0, 10), [0.1, 1], invariants=held)
    except iv.InvariantError:
        assert status == -2
    else:
        assert sol.status == status, sol.message


def test_the_check_says_how_little_it_sees():
    for jac, least, most in ((None, EPS, 1e-10), ("3-point", 1e-10, 1e-8), ("2-point", 1e-8, 1e-6)):
        for p, conserved in ((0.0, True), (most, False)):
            held = iv.Invariants(lambda t, y, p=p: y[1] ** 2 / 2 + 2 * (1 + 100 * p) * y[0] ** 2, jac)
            report = iv.check_invariants(lambda t, y: [y[1], -4 * y[0]], held, 0, [1, 0.5])
            assert least < report.detectable[0] < most
            assert report.conserved[0] == conserved, report


# ----------------------------------------------------------------------------------------------------------------------
# Units


@pytest.mark.parametrize("unit", [1e-9, 1e-4, 1.0, 1e9])
def test_the_check_knows_no_unit_of_time(unit):
    for factor, conserved in ((1.0, True), (1.01, False)):
        report = iv.check_invariants(
            lambda t, y: [np.cos(t / unit) / unit],
            lambda t, y, factor=factor: y[0] - factor * np.sin(t / unit),
            0.3 * unit,
            [0.5],
        )
        assert report.conserved[0] == conserved, report


@dealt(method=FAMILIES, size=[1e-100, 1e-12, 1.0, 1e100])
def test_the_guard_knows_no_unit_of_the_state(method, size):
    for p, found in ((0.0, False), (1e-2, True)):
        held = iv.Invariants(lambda t, y, p=p: y[1] ** 2 / 2 + 2 * (1 + p) * y[0] ** 2)
        try:
            sol = iv.solve_ivp(
                lambda t, y: [y[1], -4 * y[0]], (0, 10), [size, 0.3 * size], method, atol=1e-6 * size, invariants=held
            )
        except iv.InvariantError:
            assert found
        else:
            assert sol.status == (-2 if found else 0), sol.message


@pytest.mark.parametrize("size", [1e-100, 1e-12, 1e12, 1e100])
def test_the_search_knows_no_unit_of_the_state(size):
    (found,) = iv.find_invariants(lambda t, y: [y[1], -4 * y[0]], (0, 10), [size, 0.5 * size], labels=["x", "v"])
    assert found.formula == "x**2 + 1/4*v**2"
    (found,) = iv.find_invariants(
        lambda t, y: [y[1], -(y[0] ** 3) / size**2], (0, 10), [size, 0.5 * size], degree=4, labels=["x", "v"]
    )
    assert found.coefficients.keys() == {(0, 2), (4, 0)}
    assert found.coefficients[0, 2] == 1
    assert float(found.coefficients[4, 0]) * size**2 == pytest.approx(0.5, rel=1e-9)


# ----------------------------------------------------------------------------------------------------------------------
# Projection


def test_impose_where_the_terms_of_an_invariant_vanish_with_its_residual():
    for off in (1e-3, 1e-6, 1e-9, 1e-13):
        found = iv.impose(iv.Invariants(pendulum_constraints, value=0), 0, np.array([0, -1 + off, 0, off]))
        assert found.converged
        np.testing.assert_allclose(found.y, [0, -1, 0, 0], rtol=4 * EPS, atol=1e-3 * 40 * EPS)  # 1e-3: the weight


@dealt(digits=range(3, 10), jac=[None, "3-point", "2-point"])
def test_the_printed_start_of_a_slider_crank_is_imposed_with_default_weights(digits, jac):
    """Printed to nine digits, or fewer: angles that are 0, elastic coordinates of 1e-5, angular velocities of 150."""
    held = iv.Invariants(elastic_crank_constraints, jac, value=0)
    start = [float(f"{y:.{digits}g}") for y in ELASTIC_CRANK]
    found = iv.impose(held, 0, start)
    assert found.converged
    assert np.abs(elastic_crank_constraints(0, found.y)).max() <= 1e-13  # ε of angular velocities of 150


@explicit_and_implicit
def test_a_solve_from_the_printed_start_of_a_slider_crank_projects_it(method):
    held = iv.Invariants(elastic_crank_constraints, value=0)
    moving = lambda t, y: [*y[7:], *np.zeros(7)]  # noqa: E731  # true of its first 1e-9 s
    sol = iv.solve_ivp(moving, (0, 1e-9), ELASTIC_CRANK, method, invariants=held, check=False)
    assert sol.success
    assert sol.stats.projected_start
    assert np.abs(elastic_crank_constraints(0, sol.y[:, 0])).max() <= 1e-13


def pole(t, y):
    return np.exp(y[0] + 2 * y[1]) / (y[0] * y[1] ** 2)


def logarithm(t, y):
    return y[0] - np.log(y[0]) + 2 * (y[1] - np.log(y[1]))


@dealt(method=METHODS, g=[pole, logarithm], y0=[(1e-6, 0.5), (1e-6, 2), (1e-6, 3), (1e-4, 1)])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
@pytest.mark.filterwarnings("ignore::invariode.AccuracyWarning")
def test_projection_does_not_leave_the_domain_of_an_invariant(method, g, y0):
    """A population far below its tolerance, which the correction of a step may take to the other side of 0."""
    sol = iv.solve_ivp(lambda t, y: [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])], (0, 50), y0, method, invariants=g)
    assert sol.success, sol.message
    assert sol.y.min() > 0


def root(t, y):
    return np.sqrt(y[0]) * np.exp(-y[0] / 2) * y[1] * np.exp(-y[1])


@pytest.mark.filterwarnings("ignore:(invalid value|divide by zero):RuntimeWarning")
@pytest.mark.filterwarnings("ignore::invariode.AccuracyWarning")
@dealt(method=METHODS, g=[pole, logarithm, root], ends=[(1, 0), (1, -1), (10, 3)])
def test_nor_a_domain_that_ends_elsewhere(method, g, ends):
    """Populations counted down from one number and up from another: log(1 - y), sqrt(10 - y), 1 / (y - 3)."""
    end, other = ends
    rtol = (1e-5 if method == "ode23" else 1e-6) / end  # the absolute accuracy of a problem that is not shifted

    def moved(t, y):
        x, z = end - y[0], y[1] - other
        return [-2 * x * (1 - z), -z * (1 - x)]

    for x, z in [(1e-6, 0.5), (1e-6, 3), (1e-4, 1)]:
        sol = iv.solve_ivp(
            moved,
            (0, 30),
            [end - x, z + other],
            method,
            rtol=rtol,
            invariants=lambda t, y: g(t, [end - y[0], y[1] - other]),
        )
        assert sol.success, sol.message
        assert sol.y[0].max() < end
        assert sol.y[1].min() > other


@pytest.mark.filterwarnings("ignore:(invalid value|divide by zero):RuntimeWarning")
@pytest.mark.parametrize("jac", [None, "3-point", "2-point"])
def test_a_right_jacobian_beside_a_pole_is_not_called_wrong(jac):
    """Differences reach over the pole, or to where the logarithm is not defined."""
    for near in (1e-5, 1e-6, 1e-7, 1e-8):
        for g in (lambda t, y: 1 / (1 - y[0]) - y[1], lambda t, y: np.log(1 - y[0]) + y[1]):
            assert iv.check_invariants(lambda t, y: [0, 0], iv.Invariants(g, jac), 0, [1 - near, 2])


@explicit_and_implicit
@pytest.mark.parametrize("when", ["always", "needed"])
def test_a_run_that_leaves_the_domain_of_an_invariant_says_so(method, when):
    held = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2 if t < 5 else np.nan, names="radius", when=when)
    sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1, 0], method, invariants=held)
    assert sol.status == -1
    assert "Invariant radius, or its Jacobian, is not defined where the solution goes" in sol.message


def tumbling(t, y):
    return np.asarray(campaign.FAMILIES[5].fun(t, y))


def laws(t, y):
    norm, energy, x = campaign.FAMILIES[5].g(t, y, 0)
    a, b, c, d = y[:4]
    u, v, w = y[4], 2 * y[5], 3 * y[6]
    return [
        norm,
        energy,
        x,
        2 * (b * c + a * d) * u + (a * a - b * b + c * c - d * d) * v + 2 * (c * d - a * b) * w,
        2 * (b * d - a * c) * u + 2 * (c * d + a * b) * v + (a * a - b * b - c * c + d * d) * w,
    ]


@families
def test_invariants_that_depend_on_each_other_in_a_step_or_two_are_not_called_redundant(method):
    """From the identity a quaternion has components far below their tolerance: there, and only there, they do."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for t_end in (5, 20, 60):
            sol = iv.solve_ivp(tumbling, (0, t_end), [1, 0, 0, 0, 0.2, 1, 0.1], method, invariants=laws)
            assert sol.success


@explicit_and_implicit
def test_a_warning_of_redundant_invariants_says_whether_it_matters(method):
    with pytest.warns(UserWarning, match=r"redundant.*(does no harm|tolerances before)"):
        iv.solve_ivp(kepler, (0, 20), [1, 0, 0, 1], method, rtol=1e-6, invariants=kepler_invariants)


@dealt(method=FAMILIES, rtol=[1e-9, 1e-11])
def test_redundant_invariants_by_differences_cost_no_accuracy(method, rtol):
    problem = PROBLEMS["rigid body"]
    if method == "ode15s" and rtol < 1e-9:
        pytest.skip("too many steps")

    def run(g, jac):
        return iv.solve_ivp(
            problem.fun, (0, 5), problem.y0, method, rtol=rtol, atol=1e-3 * rtol, invariants=iv.Invariants(g, jac)
        ).y[:, -1]

    def four(t, y):
        a, b = problem.g(t, y)
        return [a, b, a + 2 * b, a - 0.3 * b]

    exact = run(problem.g, problem.jac)
    with pytest.warns(UserWarning, match="redundant"):
        np.testing.assert_allclose(run(four, "2-point"), exact, rtol=0, atol=10 * rtol)


@dealt(method=FAMILIES, factor=[0.1, 0.01, 30])
def test_when_needed_keeps_its_promise_after_a_jump(method, factor):
    jump = iv.Event(lambda t, y: t - 5, action=lambda t, y: factor * y)
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -y[0]],
        (0, 20),
        [1, 0.3],
        method,
        rtol=1e-6,
        atol=1e-9,
        events=jump,
        invariants=iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2, when="needed"),
    )
    assert sol.success
    assert sol.drift().distance_after.max() < 0.02  # 0.01 of the tolerance, and what one iteration leaves


@dealt(method=FAMILIES, rtol=[1e-5, 1e-7])
def test_when_needed_keeps_its_promise_where_gradients_change_fast(method, rtol):
    e = 0.99
    start = [1 - e, 0, 0, np.sqrt((1 + e) / (1 - e))]
    held = iv.Invariants(kepler_invariants, when="needed")
    sol = iv.solve_ivp(kepler, (0, 13), start, method, rtol=rtol, atol=1e-3 * rtol, invariants=held)
    assert sol.success
    assert sol.stats.skipped > 0
    assert sol.drift().distance_after.max() < 0.05


# ----------------------------------------------------------------------------------------------------------------------
# Harm


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_a_projection_that_harms_a_component_says_so_once(tolerance):
    """Positions and velocities with one atol: projected together, the velocities lose a factor of 5 to 10."""
    held = iv.Invariants(car_constraints, value=0)
    options = {"rtol": tolerance, "atol": tolerance}
    exact = iv.solve_ivp(car_axis, (0, 3), CAR, "dop853", rtol=1e-12, atol=1e-13).y[:, -1]
    with pytest.warns(iv.AccuracyWarning, match="atol for each component") as said:
        projected = iv.solve_ivp(car_axis, (0, 3), CAR, "ode45", invariants=held, **options).y[:, -1]
    assert len(said) == 1
    plain = iv.solve_ivp(car_axis, (0, 3), CAR, "ode45", **options).y[:, -1]
    assert np.abs(projected - exact).max() > 3 * np.abs(plain - exact).max()


def in_levels(constraints, n):
    """Two positions, two velocities."""
    return [
        iv.Invariants(lambda t, y: constraints(t, y)[:2], value=0, level=0, moves=range(n), names=["a", "b"]),
        iv.Invariants(lambda t, y: constraints(t, y)[2:], value=0, level=1, moves=range(n, 2 * n), names=["c", "d"]),
    ]


@dealt(method=FAMILIES, tolerance=[1e-3, 1e-5])
def test_corrections_in_levels_do_no_harm(method, tolerance):
    """The remedy: on the same problem the velocities are as accurate as without invariants."""
    options = {"method": method, "rtol": tolerance, "atol": tolerance}
    exact = iv.solve_ivp(car_axis, (0, 1), CAR, "dop853", rtol=1e-12, atol=1e-13).y[:, -1]
    with warnings.catch_warnings():
        warnings.simplefilter("error", iv.AccuracyWarning)
        kept = iv.solve_ivp(car_axis, (0, 1), CAR, invariants=in_levels(car_constraints, 4), **options).y[:, -1]
    plain = iv.solve_ivp(car_axis, (0, 1), CAR, **options).y[:, -1]
    assert np.abs(kept - exact).max() < 3 * max(np.abs(plain - exact).max(), tolerance)


@dealt(method=FAMILIES, tolerance=[1e-3, 1e-5])
def test_no_harm_is_seen_in_a_mechanism_that_has_none(method, tolerance):
    """SUNDIALS' slider crank with one atol: positions and velocities are alike in size, and projection helps."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", iv.AccuracyWarning)
        for held in (iv.Invariants(crank_constraints, value=0), in_levels(crank_constraints, 3)):
            sol = iv.solve_ivp(slider_crank, (0, 10), CRANK, method, rtol=tolerance, atol=tolerance, invariants=held)
            assert sol.success


@dealt(16, method=METHODS, name=iv.problems.__all__)
def test_no_harm_is_seen_in_classic_problems(method, name):
    if name in ("hires", "robertson") and "jac" not in iv.METHODS[method].options:
        pytest.skip("too many steps")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for rtol in (1e-3, 1e-5):
            for ratio in (1e-3, 1) if name != "robertson" else (1e-3,):  # atol = rtol loses y2, which is below it
                assert getattr(iv.problems, name)().solve(method, rtol=rtol, atol=ratio * rtol).success


TIGHT = {"rtol": 1e-4, "atol": 1e-4, "invariants": iv.Invariants(car_constraints, value=0)}


@pytest.mark.parametrize("workers", [1, 2])
def test_an_ensemble_says_in_how_many_trajectories_projection_harms(workers):
    starts = [CAR, CAR]
    with pytest.warns(iv.AccuracyWarning, match=r"moved y1 by much more than .* in 2 trajectories") as said:
        iv.solve_ensemble(car_axis, (0, 3), starts, workers=workers, **TIGHT)
    assert len(said) == 1


def test_an_ensemble_on_threads_says_the_same(monkeypatch):
    numba = pytest.importorskip("numba")
    monkeypatch.setattr(solved_mechanisms, "base", numba.njit(solved_mechanisms.base))
    held = iv.Invariants(iv.compile(car_constraints), value=0, names=["a", "b", "c", "d"])
    with pytest.warns(iv.AccuracyWarning, match=r"moved y1 by much more than .* in 2 trajectories"):
        iv.solve_ensemble(iv.compile(car_axis), (0, 3), [CAR, CAR], workers=2, **TIGHT | {"invariants": held})


def test_the_classes_for_scipy_say_it_once_during_the_run():
    solver = ODE45(car_axis, 0, CAR, 3, **TIGHT)
    with pytest.warns(iv.AccuracyWarning, match=r"moved y1 by .* times its estimated errors") as said:
        while solver.status == "running":
            solver.step()
    assert len(said) == 1


def test_it_is_said_of_a_run_that_scipy_ends_early_too():
    end = iv.Event(lambda t, y: t - 2, terminal=True)
    with pytest.warns(iv.AccuracyWarning, match=r"moved y1 by .* times its estimated errors") as said:
        assert solve_ivp(car_axis, (0, np.inf), CAR, ODE45, max_step=0.3, events=end, **TIGHT).status == 1
    assert len(said) == 1


@dealt(method=METHODS, problem=PROBLEMS, rtol=[1e-3, 1e-5, 1e-7])
@pytest.mark.filterwarnings("ignore:overflow")
def test_no_harm_is_seen_where_projection_helps(method, problem, rtol):
    with warnings.catch_warnings():
        warnings.simplefilter("error", iv.AccuracyWarning)
        for ratio in (1e-3, 1):
            problem.solve(method, rtol=rtol, atol=ratio * rtol)


@pytest.mark.parametrize("name", GALLERY)
def test_where_harm_is_seen_a_component_is_less_accurate(name):
    """The method is ode113, whose estimates are small: of all codes it warns most."""
    p = GALLERY[name]
    held = iv.Invariants(p.g, None, p.value)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        projected = iv.solve_ivp(p.fun, p.t_span, p.y0, "ode113", rtol=1e-6, invariants=held).y[:, -1]
    if not any(issubclass(one.category, iv.AccuracyWarning) for one in said):
        return
    plain, exact = (iv.solve_ivp(p.fun, p.t_span, p.y0, "ode113", rtol=r, atol=r).y[:, -1] for r in (1e-6, 1e-12))
    assert (np.abs(projected - exact) > 3 * np.abs(plain - exact)).any()


# ----------------------------------------------------------------------------------------------------------------------
# Between steps


def test_a_huge_stage_of_the_extension_is_not_believed(pair):
    """f has a spike where only the extension asks: between the steps the solution stays what its ends say."""
    asked: list[float] = []

    def decay(t, y):
        asked.append(t)
        return -y

    options = {"first_step": 0.5, "max_step": 0.5, "rtol": 1e-2}
    iv.solve_ivp(decay, (0, 0.5), [1.0], pair, **options)
    plain = set(asked)
    asked.clear()
    iv.solve_ivp(decay, (0, 0.5), [1.0], pair, dense_output=True, **options)
    for height in (1e4, 1e150, 1e300):
        for at in sorted(set(asked) - plain):
            spiked = iv.solve_ivp(
                hidden(lambda t, y, at=at, height=height: -y * (height if abs(t - at) < 1e-9 else 1)),
                (0, 0.5),
                [1.0],
                pair,
                dense_output=True,
                **options,
            )
            t = np.linspace(0, 0.5, 51)
            assert np.abs(spiked.sol(t)[0] - np.exp(-t)).max() < 1e-2
