"""The stiff test set: accuracy against independent references, and linear invariants that need no projection."""

from __future__ import annotations

from math import exp, sin

import numpy as np
import pytest
from scipy import sparse

import invariode as iv
from cases import METHODS, dealt
from problems import implicit
from stiff import E5_END, E5_START, E5_Y2, E5_Y3, PROBLEMS, StiffProblem, e5, e5_jacobian
from stiff_ends import PROBLEMS as ENDS

#: Largest weighted error over the interval in units of rtol. Relaxation oscillations amplify errors of the phase.
LIMIT = {
    "Oregonator": 200,
    "van der Pol, mu = 1e3": 100,
    "van der Pol, eps = 1e-6": 100,
    "van der Pol, eps = 1e-12": 100,
    "Brusselator": 80,
}
#: Every decade; the largest problem takes seconds per run, with the same matrices.
DECADES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
TOLERANCES = {"Brusselator, 2-D": (1e-4,)}
IMPLICIT = [name for name in METHODS if implicit(name)]
SMALL = [name for name, problem in PROBLEMS.items() if len(problem.y0) < 100]


def problem_of(name: str) -> StiffProblem:
    return PROBLEMS[name] if name in PROBLEMS else ENDS[name]


def solve(name: str, rtol: float, method: str = "ode15s", **options) -> iv.Solution:
    problem = problem_of(name)
    given = {"jac": problem.jac, "lband": problem.lband, "uband": problem.uband, "args": problem.args}
    given["mass"] = problem.mass
    given = {key: value for key, value in given.items() if value is not None}
    about = {"rtol": rtol, "atol": rtol * problem.scale, **given, **options}
    return iv.solve_ivp(problem.fun, problem.t_span, problem.y0, method, **about)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rtol"), [(name, rtol) for name in PROBLEMS for rtol in TOLERANCES.get(name, DECADES)]
)
def test_error_stays_near_the_tolerance(name, rtol):
    sol = solve(name, rtol, t_eval=PROBLEMS[name].times)
    assert sol.success, sol.message
    assert PROBLEMS[name].error(sol.y) <= LIMIT.get(name, 50) * rtol


def test_calibrated_errors_are_about_the_tolerance_and_proportional_to_it():
    """Geometric means over the problems, and the exponent of error ~ rtol^p; without it they are 9 to 29, and 0.9."""
    errors = np.empty((len(SMALL), len(DECADES)))
    for i, name in enumerate(SMALL):
        for j, rtol in enumerate(DECADES):
            sol = solve(name, rtol, t_eval=PROBLEMS[name].times, calibrate=True)
            assert sol.success, sol.message
            errors[i, j] = PROBLEMS[name].error(sol.y) / rtol
    means = np.exp(np.log(errors).mean(axis=0))
    assert np.all((means > 0.5) & (means < 3))
    assert errors.max() < 15
    p = 1 + np.polyfit(np.log(DECADES), np.log(errors).T, 1)[0]
    assert np.all((p > 0.85) & (p < 1.25))


def test_calibration_changes_the_tolerances_of_the_steps_and_nothing_else():
    name, order = "Robertson", 3
    sol = solve(name, 1e-6, calibrate=True, max_order=order)
    factor = 0.1 * (1e-6 / 1e-4) ** (1 / order)
    same = solve(name, 1e-6 * factor, max_order=order)
    np.testing.assert_allclose(sol.y[:, -1], same.y[:, -1], rtol=1e-12)
    assert sol.stats.steps == same.stats.steps
    floor = solve(name, 1e-13, calibrate=True, t_eval=[1.0])  # no tolerance is below what doubles resolve
    assert floor.success


#: The same of radau: 22 for HIRES between its long steps at 1e-6, else below 20.
RADAU_LIMIT = 25


@dealt(name=[name for name in PROBLEMS if name not in TOLERANCES], rtol=DECADES)
def test_error_of_radau_stays_near_the_tolerance(name, rtol):
    sol = solve(name, rtol, "radau", t_eval=PROBLEMS[name].times)
    assert sol.success, sol.message
    assert PROBLEMS[name].error(sol.y) <= RADAU_LIMIT * rtol


@dealt(
    method=[name for name in IMPLICIT if iv.METHODS[name].order == 2],
    name=[name for name in PROBLEMS if name not in TOLERANCES],
    rtol=[1e-3, 1e-4, 1e-5],
)
def test_error_of_second_order_methods_follows_the_tolerance(method, name, rtol):
    """Steps with an error of O(h^3) below rtol are so long that all of them leave O(h^2), that is O(rtol^(2/3))."""
    sol = solve(name, rtol, method, t_eval=PROBLEMS[name].times)
    assert sol.success, sol.message
    assert PROBLEMS[name].error(sol.y) <= 30 * rtol ** (2 / 3)


#: BDFs of order above 2 are unstable near the imaginary axis, where the beam has its eigenvalues: many short steps. The
#: ring modulator takes seconds.
SLOW = {("ode15s", "beam"), ("auto", "beam"), *((method, "ring modulator") for method in IMPLICIT)}


@pytest.mark.parametrize(
    ("method", "name"),
    [
        (method, name)
        for method in IMPLICIT
        for name, problem in ENDS.items()
        if (method, name) not in SLOW and (problem.mass is None or iv.METHODS[method].mass == "any")
    ],
)
@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # the supply of the medical problem ends
def test_ends_of_the_test_set_are_reached(method, name):
    sol = solve(name, 1e-5, method, t_eval=ENDS[name].times, max_step=np.inf)
    assert sol.success, sol.message
    most = 100 if name == "E5" else 50  # tolerances; E5's errors differ by a factor of two between neighbouring ones
    assert ENDS[name].error(sol.y) <= (30 * 1e-5 ** (2 / 3) if iv.METHODS[method].order == 2 else most * 1e-5)


@pytest.mark.parametrize("name", ENDS)
def test_jacobians_are_the_derivatives(name):
    """Along a random direction, by central differences."""
    problem, random = ENDS[name], np.random.default_rng(0)
    t, size = 1e-4, np.maximum(np.abs(problem.y0), np.minimum(problem.scale, 0.1))
    y, v, step = problem.y0 + size * random.random(len(size)), size * random.standard_normal(len(size)), 1e-5
    ahead, behind = (np.array(problem.fun(t, y + sign * step * v)) for sign in (1, -1))
    J = np.array(problem.jac(t, y))
    if problem.lband is not None:
        J = sparse.dia_array((J, problem.uband - np.arange(len(J))), (len(y), len(y))).toarray()
    assert np.all(np.abs((ahead - behind) / (2 * step) - J @ v) <= 1e-5 * (np.abs(J) @ np.abs(v)))


@pytest.mark.parametrize("bdf", [False, True])
@pytest.mark.parametrize("jac", ["given", None])
def test_a_point_off_the_algebraic_equations_is_put_back(jac, bdf):
    """Newton's iteration takes the exponentials of the transistors for linear, and its steps for solutions: in about a
    quarter of these runs no step from such a point had a small error, however short."""
    problem = ENDS["transistor amplifier"]
    for rtol in 10.0 ** -np.arange(2, 7, 0.5):
        options = {"bdf": bdf} if jac else {"bdf": bdf, "jac": None}
        sol = solve(problem.name, rtol, t_eval=problem.times, **options)
        assert sol.success, sol.message
        assert problem.error(sol.y) <= 2 * rtol


def diode_ladder(seed: int):
    """f, tf and M of six nodes: a diode to the next, resistors to the ground, capacities in every other gap."""
    rng = np.random.default_rng(seed)
    amplitude, thermal, leak = rng.uniform(1, 8), rng.uniform(0.022, 0.05), 10 ** rng.uniform(-12, -6)
    frequency = 2 * np.pi * 10 ** rng.uniform(1.3, 2.7)
    resistors, source = (10 ** rng.uniform(3, 5, 6)).tolist(), 10 ** rng.uniform(2, 3.3)
    mass = np.zeros((6, 6))
    for i, capacity in zip((0, 2, 4), 10 ** rng.uniform(-7, -5.3, 3), strict=True):
        mass[i : i + 2, i : i + 2] = capacity * np.array([[1, -1], [-1, 1]])

    def fun(t, y):
        y = y.tolist()
        currents = [-v / r for v, r in zip(y, resistors, strict=True)]
        currents[0] += (amplitude * sin(frequency * t) - y[0]) / source
        for i in range(5):
            through = leak * (exp(min((y[i] - y[i + 1]) / thermal, 300)) - 1)
            currents[i] -= through
            currents[i + 1] += through
        return currents

    return fun, 6 * np.pi / frequency, mass


@pytest.mark.parametrize(("seed", "bdf"), [(9, False), (14, False), (27, False), (44, True), (45, False), (57, False)])
def test_an_iteration_that_starts_off_the_algebraic_equations_starts_again_on_them(seed, bdf):
    """At crude tolerances a diode opens within a step: Newton's iteration then failed, however short the step."""
    fun, tf, mass = diode_ladder(seed)
    crude, fine = (
        iv.ode15s(fun, (0, tf), np.zeros(6), mass=mass, rtol=rtol, atol=0.01 * rtol, bdf=bdf, keep="end")
        for rtol in (1e-2, 1e-5)
    )
    assert crude.success, crude.message
    assert fine.success, fine.message
    np.testing.assert_allclose(crude.y[:, -1], fine.y[:, -1], rtol=0, atol=0.1)


@pytest.mark.parametrize(("rtol", "atol"), [(1e-9, 1e-11), (1e-10, 1e-10)])
def test_a_step_that_grows_too_fast_does_not_lower_the_order_of_radau(rtol, atol):
    """After a rise of the order h may grow so much that Newton's iteration fails: if the order fell then, it would stay
    low for ten steps, rise again, and fall again (most steps had order 5, with three times as many f in all)."""
    problem = PROBLEMS["Robertson"]
    about = {"rtol": rtol, "atol": atol, "jac": problem.jac}
    chosen, fixed = (iv.radau(problem.fun, (0, 1e4), problem.y0, max_order=order, **about) for order in (13, 9))
    assert chosen.success
    assert chosen.nfev <= 1.5 * fixed.nfev


@pytest.mark.parametrize("order", [5, 13])
def test_radau_sees_how_fast_a_mass_matrix_changes(order):
    """The rate of Newton's iteration grows with the age of the M(t) in the factors: a rate that was measured long ago
    accepts what is wrong by as much as M has changed (74 tolerances, with order 5 at 1e-11)."""

    def mass(t):
        return np.array([[2 + np.sin(t), 0.3], [0.1 * t, 1.5]])

    def fun(t, y):
        return mass(t) @ [np.cos(t) - 1e3 * (y[0] - np.sin(t)), -np.sin(t) - 10 * (y[1] - np.cos(t))]

    for rtol in (1e-9, 1e-11):
        sol = iv.radau(
            fun,
            (0, 5),
            [0, 1],
            rtol=rtol,
            atol=rtol,
            max_order=order,
            mass=mass,
            jac=lambda t, y: mass(t) * [-1e3, -10],
        )
        assert sol.success
        np.testing.assert_allclose(sol.y, [np.sin(sol.t), np.cos(sol.t)], rtol=0, atol=rtol)


@pytest.mark.parametrize("name", SMALL)
def test_radau_is_as_good_with_differences(name):
    sol = solve(name, 1e-5, "radau", t_eval=PROBLEMS[name].times, jac=None)
    assert sol.success, sol.message
    assert PROBLEMS[name].error(sol.y) <= 2 * RADAU_LIMIT * 1e-5
    given = solve(name, 1e-5, "radau")
    columns = sol.stats.njev * len(sol.y)
    assert sol.stats.nfev - columns <= 1.2 * given.stats.nfev


@pytest.mark.parametrize("name", SMALL)
def test_difference_jacobian_solves_as_the_given_one(name):
    sol = solve(name, 1e-5, t_eval=PROBLEMS[name].times, jac=None)
    assert sol.success, sol.message
    assert PROBLEMS[name].error(sol.y) <= 2 * LIMIT.get(name, 50) * 1e-5
    given = solve(name, 1e-5)
    assert sol.stats.steps <= 1.2 * given.stats.steps


@dealt(jac=[None, e5_jacobian], rtol=10.0 ** -np.arange(4, 8.5, 0.5), unit=[1, 2.0**-40, 2.0**40])
def test_components_that_start_at_zero_leave_no_roundoff_in_the_jacobian(jac, rtol, unit):
    """E5, whose y2 = y3 + y4 comes down by 12 orders: what Newton's iteration leaves of it does not. In any units."""

    def scaled(function):
        return lambda t, y: unit * function(t, y / unit)

    given = None if jac is None else lambda t, y: jac(t, y / unit)
    sol = iv.ode15s(scaled(e5), (0, E5_END), unit * E5_START, rtol=rtol, atol=unit * 1e-24, jac=given, keep="end")
    assert sol.success, sol.message
    np.testing.assert_allclose(sol.y[1:3, -1] / unit, [E5_Y2, E5_Y3], rtol=0.1)


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
def test_an_invariant_makes_up_for_a_noisy_jacobian(rtol):
    """E5 with simple differences handed in as the Jacobian, which lose y2 = y3 + y4: imposed, it is right."""

    def noisy(t, y):
        f, columns = e5(t, y), []
        for j in range(4):
            moved = y.copy()
            moved[j] += 2**-26 * max(abs(y[j]), 1e-24)
            columns.append((e5(t, moved) - f) / (moved[j] - y[j]))
        return np.transpose(columns)

    held = iv.Invariants(lambda t, y: y[1] - y[2] - y[3], value=0)
    options = {"rtol": rtol, "atol": 1e-24, "jac": noisy, "keep": "end"}
    sol = iv.ode15s(e5, (0, E5_END), E5_START, invariants=held, **options)
    assert sol.success, sol.message
    np.testing.assert_allclose(sol.y[1:3, -1], [E5_Y2, E5_Y3], rtol=0.1)


@pytest.mark.parametrize("name", SMALL)
def test_bdf_solves_in_more_steps(name):
    sol = solve(name, 1e-5, t_eval=PROBLEMS[name].times, bdf=True)
    assert PROBLEMS[name].error(sol.y) <= 2 * LIMIT.get(name, 50) * 1e-5
    assert sol.stats.steps > 0.95 * solve(name, 1e-5).stats.steps


@dealt(method=IMPLICIT, name=[name for name in SMALL if PROBLEMS[name].invariants is not None])
def test_linear_invariants_are_kept_without_projection(method, name):
    """To roundoff where cᵀJ = 0 exactly, to the roundoff of J times h with differences: projection gains nothing."""
    problem = PROBLEMS[name]
    for options, bound in (({}, 1e-13), ({"jac": None}, 1e-9)):
        sol = solve(name, 1e-6, method, **options)
        held = problem.invariants @ sol.y
        size = np.abs(problem.invariants) @ np.abs(sol.y)
        drift = (np.abs(held - held[:, :1]) / size.max(axis=1, keepdims=True)).max()
        assert drift <= bound


@pytest.mark.parametrize("method", IMPLICIT)
def test_work_on_the_stiff_circle_is_bounded(method):
    """Projection hides Newton's errors in the stiff direction from Newton; an old Jacobian is renewed all the same."""
    for rate in (1e3, 1e6):

        def circle(t, y, rate=rate):
            turn = -rate * (np.arctan2(y[1], y[0]) - 1)
            return [-y[1] * turn, y[0] * turn]

        sol = iv.solve_ivp(circle, (0, 10), [1.0, 0.0], method, invariants=lambda t, y: y @ y)
        assert sol.success
        assert 10 <= sol.stats.steps <= 250


@pytest.mark.slow
def test_sparse_system_of_many_components():
    """N = 1e5 in one dimension: memory and time grow with the number of entries."""
    n = 100_000
    x = np.linspace(0, 1, n)

    def heat(t, u):
        du = np.zeros(n)
        du[1:-1] = (u[2:] - 2 * u[1:-1] + u[:-2]) * (n - 1) ** 2 * 1e-4
        return du

    u0 = np.sin(np.pi * x)
    pattern = sparse.diags_array([np.ones(n - 1), np.ones(n), np.ones(n - 1)], offsets=[-1, 0, 1])
    exact = u0 * np.exp(-(np.pi**2) * 1e-4 * 100)
    for options in ({"jac_sparsity": pattern}, {"lband": 1, "uband": 1}):
        sol = iv.ode15s(heat, (0, 100), u0, keep="end", **options)
        assert sol.success
        assert np.abs(sol.y[:, -1] - exact).max() < 1e-3
