"""Bounds: no step and no output is outside of them, in any method, and with invariants both hold."""

from __future__ import annotations

import os
import pickle

import numpy as np
import pytest
from scipy.optimize import Bounds

import invariode as iv
from cases import FAMILIES, METHODS, SERIES, dealt, explicit_and_implicit, families, families_and_series
from problems import PROBLEMS

IMPLICIT = [name for name, method in METHODS.items() if "jac" in method.options]


def sink(t, y):
    return [-abs(y[0])]


def total(t, y):
    return y.sum()


def robertson(t, y):
    slow, fast, back = 0.04 * y[0], 3e7 * y[1] ** 2, 1e4 * y[1] * y[2]
    return [back - slow, slow - back - fast, fast]


def plankton(t, y):
    """Nutrients, phytoplankton, zooplankton, detritus (Burchard, Deleersnijder and Meister 2003, simplified)."""
    n, p, z, d = y
    light = max(0.0, np.sin(2 * np.pi * t))
    uptake, grazing = light * n / (0.3 + n) * p, 0.5 * (1 - np.exp(-(1.1 * p**2))) * z
    return [
        -uptake + 0.01 * p + 0.01 * z + 0.003 * d,
        uptake - grazing - 0.01 * p - 0.05 * p,
        grazing - 0.01 * z - 0.02 * z,
        0.05 * p + 0.02 * z - 0.003 * d,
    ]


AIR, DAY = 8.120e16, 86400.0


def stratosphere(t, y):
    """O(1D), O, O3, O2, NO, NO2 by day and night (Sandu, J. Comput. Phys. 170 (2001) 589-602)."""
    o1d, o, o3, o2, no, no2 = y
    hour = t / 3600 % 24
    s = np.clip((hour - 4.5) / 15, 0, 1)
    sun = 0.5 + 0.5 * np.cos(np.pi * abs(2 * s - 1) * (2 * s - 1)) if 4.5 < hour < 19.5 else 0.0
    r = [
        2.643e-10 * sun**3 * o2,
        8.018e-17 * o * o2,
        6.120e-4 * sun * o3,
        1.576e-15 * o * o3,
        1.070e-3 * sun**2 * o3,
        7.110e-11 * AIR * o1d,
        1.200e-10 * o1d * o3,
        6.062e-15 * no * o3,
        1.069e-11 * no2 * o,
        1.289e-2 * sun * no2,
    ]
    return [
        r[4] - r[5] - r[6],
        2 * r[0] - r[1] + r[2] - r[3] + r[5] - r[8] + r[9],
        r[1] - r[2] - r[3] - r[4] - r[6] - r[7],
        -r[0] - r[1] + r[2] + 2 * r[3] + r[4] + 2 * r[6] + r[7] + r[8],
        -r[7] + r[8] + r[9],
        r[7] - r[8] - r[9],
    ]


OXYGEN, NITROGEN = np.array([[1, 1, 3, 2, 1, 2], [0, 0, 0, 0, 1, 1.0]])


def atoms(t, y):
    return [OXYGEN @ y, NITROGEN @ y]


def kinase(t, y):
    """Two phosphorylations of a substrate by one kinase, and back by one phosphatase: mass action."""
    s0, s1, s2, e, f, c1, c2, d1, d2 = y
    a1, a2, b1, b2 = 20 * s0 * e - 5 * c1, 30 * s1 * e - 3 * c2, 30 * s2 * f - 3 * d1, 20 * s1 * f - 5 * d2
    p1, p2, q1, q2 = 2.0 * c1, 15.0 * c2, 1.0 * d1, 10.0 * d2
    return [
        q2 - a1,
        p1 + q1 - a2 - b2,
        p2 - b1,
        p1 + p2 - a1 - a2,
        q1 + q2 - b1 - b2,
        a1 - p1,
        a2 - p2,
        b1 - q1,
        b2 - q2,
    ]


def enzymes(t, y):
    s0, s1, s2, e, f, c1, c2, d1, d2 = y
    return [s0 + s1 + s2 + c1 + c2 + d1 + d2, e + c1 + c2, f + d1 + d2]


KINETICS = {
    "robertson": (robertson, (0, 4e11), [1.0, 0, 0], total, 1e-4, 1e-8, IMPLICIT),
    "plankton": (plankton, (0, 30), [6.0, 0.1, 0.2, 0.01], total, 1e-4, 1e-6, list(METHODS)),
    "stratosphere": (
        stratosphere,
        (12 * 3600.0, 36 * 3600.0),
        [99.06, 6.624e8, 5.326e11, 1.697e16, 4e6, 1.093e9],
        atoms,
        1e-3,
        1.0,
        IMPLICIT,
    ),
    "kinase": (kinase, (0, 100), [1.0, 0, 0, 0.2, 0.1, 0, 0, 0, 0], enzymes, 1e-3, 1e-6, list(METHODS)),
}


def between(sol, points=7):
    """Times in all steps."""
    t = sol.t
    return np.sort(np.concatenate([t[:-1] + np.diff(t) * part for part in np.linspace(0, 1, points)]))


# ----------------------------------------------------------------------------------------------------------------------
# Signs


@families_and_series
def test_an_asymptote_at_the_bound_is_stable(method):
    sol = iv.solve_ivp(sink, (0, 40), [1.0], method, nonnegative=True, dense_output=True)
    assert sol.success
    t = np.linspace(0, 40, 4001)
    y = sol.sol(t)[0]
    assert sol.y.min() >= 0
    assert y.min() >= 0
    assert np.abs(y - np.exp(-t)).max() < 2e-3


@dealt(method=[*FAMILIES, *SERIES], mirrored=[False, True], backwards=[False, True])
def test_sensitivities_are_zero_while_a_bound_holds_the_solution(method, mirrored, backwards):
    """y' = k cos t from 1/2: y is 0 from 7π/6 on, and leaves it at 3π/2."""
    sign, direction = 1 - 2 * mirrored, 1 - 2 * backwards
    times = direction * np.array([2.0, 4.2, 2 * np.pi])
    sol = iv.solve_ivp(
        lambda t, y, k: [sign * direction * k * np.cos(t)],
        (0, times[-1]),
        [sign * 0.5],
        method,
        times,
        args=(1.0,),
        bounds=(None, 0) if mirrored else (0, None),
        sensitivities=True,
        rtol=1e-6,
        atol=1e-6,
    )
    np.testing.assert_allclose(sol.y[0], [sign * (0.5 + np.sin(2)), 0, sign], atol=1e-4)
    np.testing.assert_allclose(sol.sensitivities[0, 0], [sign * np.sin(2), 0, sign], atol=1e-4)


def test_sensitivities_follow_f_up_to_the_rest_at_a_bound():
    """y' = -k from 1: S = -t until y rests at t = 1, between steps too, then 0; steps of 1/4 may end there exactly."""
    times = np.linspace(0, 2, 42)
    for method in METHODS:
        for longest in (0.25, 0.23):
            sol = iv.solve_ivp(
                lambda t, y, k: [-k, y[0]], (0, 2), [1.0, 0.0], method, times, args=(1.0,), nonnegative=[0],
                sensitivities=True, first_step=longest, max_step=longest,
            )  # fmt: skip
            exact = np.where(times < 1, -times, 0)
            np.testing.assert_allclose(sol.sensitivities[0, 0], exact, atol=1e-4, err_msg=f"{method} {longest}")
            np.testing.assert_allclose(sol.sensitivities[1, 0, -1], -0.5, atol=2e-3, err_msg=f"{method} {longest}")


@pytest.mark.parametrize("method", IMPLICIT)
def test_the_knee(method):
    def knee(t, y):
        return [((1 - t) * y[0] - y[0] ** 2) / 1e-6]

    kept = iv.solve_ivp(knee, (0, 2), [1.0], method, nonnegative=True)
    assert kept.success
    assert kept.y.min() >= 0
    assert abs(kept.y[0, -1]) < 1e-3


@families_and_series
def test_both_bounds_are_kept(method):
    """A logistic overshoot: y' = 5 cos t, held within [-1, 2]."""
    sol = iv.solve_ivp(lambda t, y: [5 * np.cos(t)], (0, 12), [0.0], method, bounds=(-1, 2), dense_output=True)
    y = sol.sol(between(sol))[0]
    assert sol.success
    assert y.min() >= -1
    assert y.max() == 2
    assert sol.stats.steps < 500  # at a bound steps are as long as elsewhere


# ----------------------------------------------------------------------------------------------------------------------
# Signs and conservation together


@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")  # explicit methods on stiff kinetics
@pytest.mark.parametrize(("name", "method"), [(k, m) for k, row in KINETICS.items() for m in row[-1]])
def test_mass_and_signs_are_kept_in_steps_and_between(name, method):
    fun, t_span, y0, law, rtol, atol, _ = KINETICS[name]
    sol = iv.solve_ivp(
        fun, t_span, y0, method, rtol=rtol, atol=atol, nonnegative=True, invariants=law, dense_output=True
    )
    assert sol.success, sol.message
    t = between(sol)
    y = sol.sol(t)
    start = np.atleast_1d(law(t_span[0], np.array(y0, dtype=float)))
    assert sol.y.min() >= 0
    assert y.min() >= 0
    for points in (sol.y, y):
        kept = np.array([np.atleast_1d(law(0.0, one)) for one in points.T])
        assert np.abs(kept / start - 1).max() < 1e-13


@pytest.mark.parametrize(("rtol", "atol"), [(1e-4, 1e-8), (1e-3, 1e-6), (1e-2, 1e-4)])
def test_robertson_is_as_accurate_as_without_bounds(rtol, atol):
    """The bounded run is not lost where the plain run falls below 0."""
    exact = iv.solve_ivp(robertson, (0, 4e11), [1, 0, 0], "ode15s", rtol=1e-9, atol=1e-18).y[:, -1]
    runs = [
        iv.solve_ivp(robertson, (0, 4e11), [1, 0, 0], "ode15s", rtol=rtol, atol=atol, **more)
        for more in ({"nonnegative": False}, {"nonnegative": True}, {"nonnegative": True, "invariants": total})
    ]
    errors = [np.abs((run.y[:, -1] - exact) / np.maximum(np.abs(exact), atol / rtol)).max() / rtol for run in runs]
    assert max(errors[1:]) <= max(1.01 * errors[0], 1)
    assert runs[2].y.min() >= 0
    assert np.abs(runs[2].y.sum(axis=0) - 1).max() < 1e-13


def test_algebraic_equations_and_bounds():
    def equations(t, y):
        return [*robertson(t, y)[:2], y.sum() - 1]

    for rtol, atol in ((1e-3, 1e-6), (1e-2, 1e-4)):
        sol = iv.solve_ivp(
            equations, (0, 4e11), [1, 0, 0], "ode15s", mass=np.diag([1, 1, 0]), rtol=rtol, atol=atol, nonnegative=True
        )
        assert sol.success
        assert sol.y.min() >= 0
        assert np.abs(sol.y.sum(axis=0) - 1).max() < 0.1 * rtol


def pushed(t, y):
    """Down onto 0, where it rests until f leads up again."""
    return [np.cos(t) - 0.5]


@dealt(factor=[3.0, -0.5], method=[name for name in IMPLICIT if iv.METHODS[name].mass != "none"])
def test_with_a_diagonal_mass_matrix_components_rest_as_they_do_without(method, factor):
    options = {"rtol": 1e-4, "atol": 1e-6, "nonnegative": True}
    plain = "ode15s" if method == "auto" else method  # which auto is with a mass matrix
    without = iv.solve_ivp(pushed, (0, 12), [0.1], plain, **options)
    kept = iv.solve_ivp(lambda t, y: [factor * pushed(t, y)[0]], (0, 12), [0.1], method, mass=[[factor]], **options)
    assert kept.success
    assert kept.y.min() >= 0
    assert abs(kept.y[0, -1] - without.y[0, -1]) <= 1e-3
    assert abs(kept.stats.steps - without.stats.steps) <= 0.1 * without.stats.steps


def test_what_rests_beside_algebraic_equations():
    def balanced(t, y):
        return [*pushed(t, y), y[0] + y[1] - 1]

    alone = iv.solve_ivp(pushed, (0, 12), [0.1], "ode15s", rtol=1e-4, atol=1e-6, nonnegative=True)
    for method in ("ode15s", "radau", "ode23tb"):
        given = {"mass": np.diag([1.0, 0.0]), "rtol": 1e-4, "atol": 1e-6}
        kept = iv.solve_ivp(balanced, (0, 12), [0.1, 0.9], method, nonnegative=[0], **given)
        assert kept.success
        assert kept.y[0].min() >= 0
        assert abs(kept.y[0, -1] - alone.y[0, -1]) <= 1e-3
        assert np.abs(kept.y.sum(axis=0) - 1).max() <= 0.1 * 1e-4  # of which Newton's iteration may leave half


@explicit_and_implicit
def test_the_mass_that_clipping_moves_is_told(method):
    sol = iv.solve_ivp(sink, (0, 40), [1.0], method, nonnegative=True, max_step=np.inf)
    assert sol.stats.clipped >= 0
    assert (sol.stats.clipped_amount > 0) == (sol.stats.clipped > 0)


# ----------------------------------------------------------------------------------------------------------------------
# Laws


@dealt(problem=PROBLEMS, method=FAMILIES)
def test_bounds_that_are_never_reached_change_nothing(problem, method):
    options = {"rtol": 1e-4, "atol": 1e-6, "dense_output": True}
    plain = iv.solve_ivp(problem.fun, problem.t_span, problem.y0, method, **options)
    far = iv.solve_ivp(problem.fun, problem.t_span, problem.y0, method, bounds=(-1e9, 1e9), **options)
    np.testing.assert_array_equal(plain.t, far.t)
    np.testing.assert_array_equal(plain.y, far.y)
    assert plain.nfev == far.nfev
    t = between(plain, 3)
    np.testing.assert_array_equal(plain.sol(t), far.sol(t))


@families_and_series
def test_a_mirrored_problem_has_the_mirrored_solution(method):
    down = iv.solve_ivp(sink, (0, 40), [1.0], method, nonnegative=True)
    up = iv.solve_ivp(lambda t, y: [abs(y[0])], (0, 40), [-1.0], method, bounds=(None, 0))
    if method in IMPLICIT:  # difference Jacobians have increments in the direction of f
        np.testing.assert_allclose(down.y[:, -1], -up.y[:, -1], atol=1e-5)
        return
    np.testing.assert_array_equal(down.t, up.t)
    np.testing.assert_array_equal(down.y, -up.y)


@families_and_series
def test_a_reversed_problem_has_the_reversed_solution(method):
    forwards = iv.solve_ivp(sink, (0, 40), [1.0], method, nonnegative=True)
    backwards = iv.solve_ivp(lambda t, y: [abs(y[0])], (0, -40), [1.0], method, nonnegative=True)
    np.testing.assert_array_equal(forwards.t, -backwards.t)
    np.testing.assert_array_equal(forwards.y, backwards.y)


@families_and_series
def test_units_by_powers_of_two_change_nothing(method):
    unit = 2.0**40
    here = iv.solve_ivp(sink, (0, 40), [1.0], method, nonnegative=True)
    there = iv.solve_ivp(sink, (0, 40), [unit], method, nonnegative=True, atol=1e-6 * unit)
    np.testing.assert_array_equal(here.y * unit, there.y)


@explicit_and_implicit
def test_the_same_by_index_label_mask_and_bounds(method):
    def decay(t, y):
        return [-abs(y[0]), abs(y[0])]

    problem = iv.Problem(decay, (0, 30), [1.0, 0.0], labels=["fuel", "ash"])
    ways = [
        {"nonnegative": [0]},
        {"nonnegative": -2},
        {"nonnegative": "fuel"},
        {"nonnegative": ["fuel"]},
        {"nonnegative": np.flatnonzero([True, False])},
        {"bounds": ([0, -np.inf], None)},
        {"bounds": Bounds([0, -np.inf], np.inf)},
    ]
    solutions = [problem.replace(**way).solve(method).y for way in ways]
    for y in solutions[1:]:
        np.testing.assert_array_equal(y, solutions[0])


@families_and_series
def test_the_whole_is_the_sum_of_its_parts(method):
    whole = iv.solve_ivp(sink, (0, 40), [1.0], method, nonnegative=True)
    parts = iv.solve_ivp(sink, (0, 20), [1.0], method, nonnegative=True).extend(40)
    assert parts.success
    assert parts.y.min() >= 0
    assert abs(parts.y[0, -1] - whole.y[0, -1]) < 1e-5


# ----------------------------------------------------------------------------------------------------------------------
# With the rest of the package


@explicit_and_implicit
def test_events_see_values_within_the_bounds(method):
    seen = []

    def empty(t, y):
        seen.append(y[0])
        return y[0] - 1e-3

    iv.solve_ivp(sink, (0, 40), [1.0], method, nonnegative=True, events=empty)
    assert min(seen) >= 0


@explicit_and_implicit
def test_continuous_solutions_travel_with_their_bounds(tmp_path, method):
    problem = iv.Problem(sink, (0, 40), [1.0], nonnegative=True)
    sol = problem.solve(method, dense_output=True)
    t = np.linspace(0, 40, 997)
    sol.save(tmp_path / "sink.npz")
    for again in (pickle.loads(pickle.dumps(sol.sol)), iv.load(tmp_path / "sink.npz").sol, sol.extend(41).sol):
        np.testing.assert_array_equal(again(t), sol.sol(t))


@explicit_and_implicit
def test_ensembles_are_as_single_solves(method):
    starts = np.array([[1.0], [0.3], [-1.0]])
    options = {"nonnegative": True, "t_eval": [10.0, 40.0]}
    many = iv.solve_ensemble(sink, (0, 40), starts, method, workers=1, on_failure="return", **options)
    assert many.status.tolist() == [0, 0, -4]
    assert "bounds" in many.messages[2]
    for i in (0, 1):
        one = iv.solve_ivp(sink, (0, 40), starts[i], method, **options)
        np.testing.assert_array_equal(many.y[i], one.y)
        assert many.stats.clipped[i] == one.stats.clipped
        assert many.stats.clipped_amount[i] == one.stats.clipped_amount


@explicit_and_implicit
def test_ensembles_on_threads_too(method):
    pytest.importorskip("numba")

    @iv.compile
    def drain(t, y):
        return (-abs(y[0]),)

    starts = np.linspace(0.5, 2, 16)[:, None]
    many = iv.solve_ensemble(drain, (0, 40), starts, method, workers=os.cpu_count(), nonnegative=True)
    assert many.success.all()
    assert many.y_end.min() >= 0
    one = iv.solve_ivp(drain, (0, 40), starts[3], method, nonnegative=True)
    np.testing.assert_array_equal(many.y_end[3], one.y[:, -1])
    assert many.stats.clipped_amount[3] == one.stats.clipped_amount


def test_the_plugin_takes_bounds():
    from scipy.integrate import solve_ivp

    from invariode.scipy import ODE45

    sol = solve_ivp(sink, (0, 40), [1.0], method=ODE45, nonnegative=True)
    assert sol.success
    assert sol.y.min() >= 0


@explicit_and_implicit
def test_an_action_must_stay_within_the_bounds(method):
    def low(t, y):
        return y[0] - 0.5

    inside = iv.Event(low, action=lambda t, y: [1.0])
    outside = iv.Event(low, action=lambda t, y: [-1.0])
    assert iv.solve_ivp(sink, (0, 2), [1.0], method, nonnegative=True, events=inside).success
    failed = iv.solve_ivp(sink, (0, 2), [1.0], method, nonnegative=True, events=outside)
    assert failed.status == -1
    assert "bounds" in failed.message


def test_f_that_drives_out_of_a_bound_without_tolerance_is_told():
    """If atol = 0 nothing may be outside, and f is not changed where M y' = f does not tell y' without ∂f/∂y: the run
    ends and says where. (Not if a step ends exactly on the bound.)"""
    sol = iv.solve_ivp(
        lambda t, y: [-1.0, y[1] - 1], (0, 2), [1.0, 1.0], "ode15s", mass=np.array([[1.0, 1.0], [0.0, 0.0]]),
        bounds=([0, -9], None), atol=0, max_step=0.4,
    )  # fmt: skip
    assert sol.status == -1
    assert "Component 0 of y leaves its bounds" in sol.message


@pytest.mark.parametrize("nonnegative", [None, True])
def test_taylor_rests_where_there_is_no_series(nonnegative):
    """y' = -2 sqrt|y| reaches 0 at t = sqrt(y0), where sqrt(y) has no Taylor series and y' = 0, and stays there."""
    for y0 in (1.0, 2.3):
        sol = iv.solve_ivp(
            lambda t, y: [-2 * np.sqrt(abs(y[0])), 1.0], (0, 3), [y0, 0.0], "taylor", nonnegative=nonnegative
        )
        assert sol.status == 0
        exact = np.maximum(np.sqrt(y0) - sol.t, 0) ** 2
        np.testing.assert_allclose(sol.y[0], exact, atol=1e-5)
        np.testing.assert_allclose(sol.y[1], sol.t, rtol=1e-12)


@pytest.mark.parametrize("method", IMPLICIT)
def test_f_is_never_called_at_infinity(method):
    """A consistent start that ends roundoff outside a bound on one side leaves finite increments."""

    def f(t, y):
        assert np.isfinite(y).all()
        flow = 0.04 * y[0] - 1e4 * y[1] * y[2]
        return [-flow, flow - 3e7 * y[1] ** 2, y[0] + y[1] + y[2] - 1]

    if iv.METHODS[method].mass == "any":
        sol = iv.solve_ivp(f, (0, 10), [1, 0, 1e-3], method, mass=np.diag([1.0, 1, 0]), nonnegative=True)
        assert sol.success


COUPLED = np.array([[2.0, 0.5, 0.3], [0.4, 2.0, 0.0], [0.0, 0.1, 1.0]])
MASSES = {
    "coupled": COUPLED,
    "in time": lambda t, *args: COUPLED * (1 + 0.3 * np.sin(t)),
    "singular": np.block([[COUPLED, np.zeros((3, 1))], [np.zeros((1, 4))]]),
    "singular, in time": lambda t, *args: (1 + 0.3 * np.sin(t)) * MASSES["singular"],
    "singular, by combinations of rows": np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 0, 1]]).T
    @ np.block([[COUPLED, np.zeros((3, 1))], [np.zeros((1, 4))]]),
}


@pytest.mark.parametrize("method", [name for name in IMPLICIT if iv.METHODS[name].mass != "none"])
def test_a_component_rests_at_its_bound_beside_any_mass_matrix(method):
    """M y' = M (-1, -0.6 y1, y0 + 0.2 y1), y0 >= 0: y0 rests from t = 0.5 with y0' = 0, the others have their rates, an
    algebraic component follows; so do the derivatives with respect to the two rates. No step is lost there."""
    r, k = 1.0, 0.6

    def exact(t, r, k):
        b = 1.5 * np.exp(-k * t)
        a = np.maximum(0.5 - r * t, 0)
        fallen = np.minimum(t, 0.5 / r)
        c = 0.5 * fallen - r * fallen**2 / 2 + 0.3 / k * (1 - np.exp(-k * t))
        return np.array([a, b, c, b + 2 * a])

    for name, M in MASSES.items():
        if "singular" in name and iv.METHODS[method].mass == "regular":
            continue
        if callable(M) and iv.METHODS[method].mass == "regular":
            continue
        n = 4 if "singular" in name else 3

        def f(t, y, r, k, M=M, n=n):
            A = M(t) if callable(M) else M
            rates = np.array([-r, -k * y[1], y[0] + 0.2 * y[1], 0.0])[:n]
            return A @ rates + (np.array([0, 0, 0, y[3] - y[1] - 2 * y[0]]) if n == 4 else 0)

        for sensitivities in (False, True):
            sol = iv.solve_ivp(
                f, (0, 3), exact(0, r, k)[:n], method, args=(r, k), mass=M, nonnegative=[0], rtol=1e-6, atol=1e-8,
                sensitivities=sensitivities, max_steps=1000,
            )  # fmt: skip
            assert sol.status == 0, (name, sol.message)
            assert (sol.y[0, sol.t > 0.51] == 0).all(), name
            np.testing.assert_allclose(sol.y, exact(sol.t, r, k)[:n], rtol=0, atol=3e-4, err_msg=name)
            if sensitivities:
                h = 1e-6
                S = (exact(3.0, r + h, k) - exact(3.0, r - h, k)) / (2 * h)
                np.testing.assert_allclose(sol.sensitivities[:, 0, -1], S[:n], rtol=0, atol=1e-3, err_msg=name)
                S = (exact(3.0, r, k + h) - exact(3.0, r, k - h)) / (2 * h)
                np.testing.assert_allclose(sol.sensitivities[:, 1, -1], S[:n], rtol=0, atol=1e-3, err_msg=name)


@pytest.mark.parametrize("method", IMPLICIT)
def test_what_rests_ends_its_steps_exactly_at_its_bound(method):
    """Newton's iteration for the other components leaves nothing in one at rest, whose row of J is not zero: the method
    does not start again and again."""
    sol = iv.solve_ivp(
        lambda t, y: [-1 - 0.5 * y[1] ** 2, 30 * (np.cos(3 * t) - y[1])], (0, 8), [0.3, 0.0], method,
        nonnegative=[0], rtol=1e-6, atol=1e-9, max_steps=3000,
    )  # fmt: skip
    assert sol.status == 0
    assert (sol.y[0, sol.t > 0.4] == 0).all()


# ----------------------------------------------------------------------------------------------------------------------
# Bad input


def square(t, y):
    return [-y[0], y[0]]


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"nonnegative": [0, 0]}, ValueError, "twice"),
        ({"nonnegative": [0, -2]}, ValueError, "twice"),
        ({"nonnegative": 2}, ValueError, "no component 2"),
        ({"nonnegative": "A"}, ValueError, "has none"),
        ({"nonnegative": [True, False]}, TypeError, "flatnonzero"),
        ({"nonnegative": 0.5}, TypeError, "indices or labels"),
        ({"bounds": (1, 0)}, ValueError, "contradictory"),
        ({"bounds": (np.nan, 1)}, ValueError, "NaN"),
        ({"bounds": (0, [1, 2, 3])}, ValueError, "shape"),
        ({"bounds": 0}, TypeError, "lower, upper"),
        ({"bounds": (lambda t: 0, 1)}, TypeError, "depend on t"),
        ({"bounds": lambda t: (0, 1)}, TypeError, "depend on t"),
        ({"bounds": ("x", 1)}, TypeError, "numbers"),
        ({"nonnegative": True, "bounds": (None, -1)}, ValueError, "contradictory"),
        ({"bounds": (0, 0.5)}, ValueError, "outside its bounds"),
    ],
)
def test_wrong_bounds_are_refused(given, error, text):
    with pytest.raises(error, match=text):
        iv.solve_ivp(square, (0, 1), [1.0, 0.0], **given)


def test_complex_states_have_no_bounds():
    with pytest.raises(ValueError, match="real problem"):
        iv.solve_ivp(square, (0, 1), [1j, 0.0], nonnegative=True)


def test_unknown_labels_are_refused():
    with pytest.raises(ValueError, match="no component is called 'C'"):
        iv.Problem(square, (0, 1), [1.0, 0.0], labels=["A", "B"], nonnegative="C")


def test_a_bound_that_contradicts_an_invariant_is_refused():
    held = iv.Invariants(total, value=1.0005)
    with pytest.raises(iv.InvariantError, match="within the bounds"):
        iv.solve_ivp(square, (0, 1), [1.0, 0.0], bounds=(None, [1.0, 0.0]), invariants=held)


@explicit_and_implicit
def test_a_start_outside_by_less_than_the_tolerance_is_moved(method):
    sol = iv.solve_ivp(square, (0, 1), [1.0, -1e-7], method, nonnegative=True)
    assert sol.y[1, 0] == 0
    assert sol.y.min() >= 0


@families
def test_bounds_that_the_exact_solution_touches_are_kept(method):
    cycle = PROBLEMS["Lotka-Volterra"]
    largest = np.abs(
        iv.solve_ivp(cycle.fun, cycle.t_span, cycle.y0, "dop853", rtol=1e-10, atol=1e-12, max_step=0.01).y
    ).max(axis=1)
    sol = iv.solve_ivp(cycle.fun, cycle.t_span, cycle.y0, method, rtol=1e-5, atol=1e-7, bounds=(-largest, largest))
    assert sol.success, sol.message
    assert (np.abs(sol.y) <= largest[:, None]).all()


@pytest.mark.parametrize("method", [name for name in IMPLICIT if METHODS[name].mass != "none"])
def test_components_rest_at_bounds_beside_a_coupled_mass(method):
    """M y' = M (-1, -0.6 y1): y' = (-1, -0.6 y1) until y0 is 0, then (0, -0.6 y1), as with M = 1."""
    for M in ([[2.0, 0.5], [0.0, 2.0]], [[2.0, 0.5], [0.5, 2.0]], [[2.0, 0.0], [0.0, 2.0]]):
        M = np.array(M)
        sol = iv.solve_ivp(
            lambda t, y, M=M: M @ [-1.0, -0.6 * y[1]], (0, 3), [0.5, 1.5], method, mass=M, nonnegative=[0], rtol=1e-5
        )
        assert sol.success
        assert sol.stats.steps < 400
        np.testing.assert_allclose(sol.y[:, -1], [0, 1.5 * np.exp(-1.8)], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_a_bound_is_met_where_t_does_not_resolve_the_tolerance(method):
    """y' = -1 from 1e6: at t = 1e6 neighbouring times are 1.2e-10 apart, more than atol."""
    sol = iv.solve_ivp(lambda t, y: [-1.0], (0, 2e6), [1e6], method, atol=1e-10, nonnegative=True)
    assert sol.success
    assert sol.y[0, -1] == 0


def test_messages_about_bounds_give_labels():
    """Components are named as the problem names them."""
    about = {"labels": ["prey", "fox"]}
    with pytest.raises(ValueError, match=r"bounds of fox are contradictory: 1\.0 <= y\[1\] <= -1\.0"):
        iv.Problem(lambda t, y: 0 * y, (0, 1), [0.5, 0.0], bounds=([0, 1], [1, -1]), **about)
    with pytest.raises(ValueError, match=r"y0\[fox\] is outside its bounds, 0\.0 to inf"):
        iv.Problem(lambda t, y: 0 * y, (0, 1), [0.5, -1.0], nonnegative=True, **about).solve()
    doses = [(0.5, lambda t, y: [y[0], -1.0])]
    sol = iv.Problem(lambda t, y: 0 * y, (0, 1), [0.5, 1.0], nonnegative=True, breakpoints=doses, **about).solve()
    assert "component 1 (fox) is outside its bounds" in sol.message


@pytest.mark.parametrize("method", METHODS)
def test_a_visit_of_a_bound_is_seen(method):
    """Where f leads y out of a bound and back, within few steps or one, y has risen since by what f has since it
    turned, however deep it would be outside; free runs are as accurate."""
    rng = np.random.default_rng(71)
    times = np.linspace(0, 1, 40001)
    fixed = [(0.6333, 1.3, 0.4), (0.8, 1.3, 0.4), (1.1333, 1.3, 0.4), (1.0921, 1.785, 0.4)]
    shallow = [(rate, w, rate / w - 10**depth) for rate, w, depth in rng.uniform((0.3, 0.8, -4), (1.5, 3, -1), (6, 3))]
    for rate, w, start in fixed + shallow:  # outside by 1e-4 to 0.47
        T = 1.6 * np.pi / w
        free = start + rate / w * np.sin(w * T * times) * (-1 if (rate, w, start) in shallow else 1)
        sign = -1 if (rate, w, start) in shallow else 1
        end = free[-1] - free.min()
        for rtol in (1e-3, 1e-6):
            options = {"rtol": rtol, "atol": rtol / 10}

            def f(t, y, rate=rate, w=w, sign=sign):
                return [sign * rate * np.cos(w * t), -0.4 * y[1]]

            sol = iv.solve_ivp(f, (0, T), [start, 1.0], method, nonnegative=[0], **options)
            plain = iv.solve_ivp(f, (0, T), [start, 1.0], method, nonnegative=False, **options)
            error = abs(plain.y[0, -1] - free[-1])
            assert abs(sol.y[0, -1] - end) < 100 * rtol * (end + 0.1) + 2 * error, (rate, w, start, rtol)


@explicit_and_implicit
def test_an_invariant_that_a_bound_contradicts_is_told(method):
    """f conserves the sum only together with a component that it leads below 0, where it is held: the invariant is
    named, and the component; what is held is in `clipped_amount`."""

    def f(t, y):
        return [-y[0], -1.0, y[0] + 1.0]

    def total(t, y):
        return y.sum()

    options = {"nonnegative": True, "rtol": 1e-6, "atol": 1e-9}
    with pytest.raises(
        iv.InvariantError, match=r"total is contradicted by the bound of y\[1\].*out of its bound"
    ) as told:
        iv.solve_ivp(f, (0, 2), [1.0, 0.5, 0.0], method, invariants=total, **options)
    assert 0.5 <= told.value.solution.t_end < 0.52
    sol = iv.solve_ivp(f, (0, 2), [1.0, 0.5, 0.0], method, **options)
    assert abs(sol.stats.clipped_amount - 1.5) < 1e-3
    assert (sol.stats.clipped_amount > 0) == (sol.stats.clipped > 0)
    np.testing.assert_allclose(sol.y[:, -1], [np.exp(-2), 0, 3 - np.exp(-2)], rtol=1e-4, atol=1e-12)
    early = iv.solve_ivp(f, (0, 0.45), [1.0, 0.5, 0.0], method, invariants=total, **options)
    assert early.stats.clipped == 0


def test_a_jump_that_fixes_an_invariant_anew_starts_the_account_of_the_bounds_anew():
    """Bounds add 0.1 to the sum between two doses and 0.4 in all; 100 tolerances of it are at least 0.14."""
    about = {"nonnegative": True, "invariants": lambda t, y: y.sum()}
    options = {"rtol": 1e-3, "atol": 1e-3, "max_step": 0.1}
    doses = [(t, lambda t, y: [y[0], 1.0]) for t in (0.5, 1.0, 1.5)]
    dosed = iv.Problem(lambda t, y: [-0.2, 0.2], (0, 2), [0.0, 1.0], breakpoints=doses, **about)
    assert dosed.solve("ode45", **options).status == 0
    with pytest.raises(iv.InvariantError, match="contradicted by the bound"):
        iv.Problem(lambda t, y: [-0.2, 0.2], (0, 2), [0.0, 1.0], **about).solve("ode45", **options)
