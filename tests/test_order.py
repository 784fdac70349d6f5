"""The fitted order is that of the method, plain and projected, whichever first stage follows a projection."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, dealt, families
from invariode.problems import kepler
from problems import PROBLEMS, TestProblem, cost_of_pair, implicit, long_steps, switching

ORBIT = PROBLEMS["Kepler"]
#: One invariant in four dimensions: where the invariants pin down most of the state, projection gains an order.
STARS = PROBLEMS["Henon-Heiles"]
#: Errors are fitted where they are ten times above roundoff: that of a whole run, 3e-14, and that of one step.
FLOOR, FLOOR_OF_A_STEP = 3e-13, 3e-15
#: The fit leaves this much of a slope open even where the points lie on a line: terms of higher order.
HIGHER_ORDER = 0.15


def fixed_steps(problem: TestProblem, method: str, n: int, tf: float, **options) -> iv.Solution:
    """n equal steps: atol = 1 makes the error test pass, max_step keeps h from growing."""
    h = (tf - problem.t_span[0]) / n
    sol = iv.solve_ivp(
        problem.fun, (0, tf), problem.y0, method, first_step=h, max_step=h, rtol=1e-3, atol=1.0, **options
    )
    assert sol.stats.failed == 0
    assert abs(sol.stats.steps - n) <= 1
    return sol


def convergence(error: Callable[[int], float], coarsest: int, finest: int, floor: float) -> tuple[float, float]:
    """The order of an error as a power of 1/n and the standard error of that fit.

    Steps are refined by 4/3 until n is `finest` or the error `floor`; the last four are fitted."""
    points = []
    n = coarsest
    while n <= finest and (size := error(n)) > floor:
        points.append((np.log(n), np.log(size)))
        n = round(n * 4 / 3)
    assert len(points) >= 4, "the error is roundoff from the start: choose a longer interval"
    (slope, _), covariance = np.polyfit(*np.transpose(points[-4:]), 1, cov=True)
    return -float(slope), float(np.sqrt(covariance[0, 0]))


@pytest.fixture(scope="module")
def reference() -> iv.DenseSolution:
    sol = STARS.solve("dop853", False, rtol=1e-13, atol=1e-15, dense_output=True)
    assert sol.sol is not None
    return sol.sol


# Implicit formulas are solved as exactly as the error is wanted, so their order does not show in steps that any error
# test lets pass; but it does where f is linear, so that Newton's iteration ends at roundoff: y = p(t) + what turns.
TURN = np.array([[0, 2, 0.5, 0], [-2, 0, 0, 1], [-0.5, 0, 0, 0.7], [0, -1, -0.7, 0]])


def driver(t):
    return np.array([np.sin(t), np.cos(2 * t), 0.5 * np.sin(3 * t), 1.0])


def turning(t, y):
    return TURN @ (y - driver(t)) + np.array([np.cos(t), -2 * np.sin(2 * t), 1.5 * np.cos(3 * t), 0])


RATES, MODES = np.linalg.eig(TURN)
AMPLITUDES = np.linalg.solve(MODES, np.array([1.0, 2, 0, -1]) - driver(0))


def turned(t):
    return driver(t) + (MODES @ (np.exp(RATES * t) * AMPLITUDES)).real


DRIVEN = TestProblem(
    "driven",
    turning,
    (0, 10),
    [1.0, 2, 0, -1],
    lambda t, y: (y - driver(t)) @ (y - driver(t)),
    lambda t, y: 2 * (y - driver(t)),
    solution=turned,
)
#: Implicit formulas with their order and that of their extension. (tests/native/order.cpp has all of radau's.)
FORMULAS = [
    pytest.param(name, about.order, about.extension_order, {}, id=name)
    for name, about in METHODS.items()
    if implicit(name) and about.fixed_order
] + [pytest.param("radau", 5, 3, {"max_order": 5}, id="radau")]


@pytest.mark.parametrize("project", [False, True])
@pytest.mark.parametrize(("method", "order", "_", "options"), FORMULAS)
def test_order_of_implicit_formulas(method, order, _, options, project):
    invariants = DRIVEN.invariants() if project else None

    def error(n):
        sol = fixed_steps(DRIVEN, method, n, 4.0, jac=TURN, invariants=invariants, **options)
        assert sol.stats.projections == (sol.stats.steps if project else 0)
        return max(np.abs(y - turned(t)).max() for t, y in zip(sol.t, sol.y.T, strict=True))

    found, uncertainty = convergence(error, 20, 400, FLOOR)
    assert abs(found - order) <= HIGHER_ORDER + uncertainty


@pytest.mark.parametrize("interpolation", ["projected", "corrected", "raw"])
@pytest.mark.parametrize(("method", "_", "order", "options"), FORMULAS)
def test_order_of_implicit_formulas_between_steps(method, _, order, options, interpolation):
    """The law is that of the explicit pairs."""

    def error(n):
        sol = fixed_steps(
            DRIVEN, method, n, 2.0, jac=TURN, invariants=DRIVEN.invariants(), dense_output=True,
            interpolation=interpolation, **options,
        )  # fmt: skip
        return max(np.abs(sol.sol(s) - turned(s)).max() for s in np.linspace(0, sol.steps.h[0], 12)[1:-1])

    found, uncertainty = convergence(error, 6, 150, FLOOR_OF_A_STEP)
    assert found >= order + 1 - 0.4 - uncertainty


@dealt(
    10,
    pair=[name for name, method in METHODS.items() if method.stages is not None],
    project=[False, True],
    fsal=["reuse", "evaluate"],
)
@pytest.mark.filterwarnings("ignore:option 'fsal' has no effect")
def test_order_of_the_solution(pair, project, fsal, reference):
    invariants = STARS.invariants() if project else None

    def error(n):
        sol = fixed_steps(STARS, pair, n, 10.0, fsal=fsal, invariants=invariants)
        assert sol.stats.projections == (sol.stats.steps if project else 0)
        return np.abs(sol.y - reference(sol.t)).max()

    order, uncertainty = convergence(error, 12, 1200, FLOOR)
    assert HIGHER_ORDER + uncertainty < 1  # or the fit could not tell an order from the next
    assert order >= iv.METHODS[pair].order - HIGHER_ORDER - uncertainty
    if not long_steps(pair):  # their leading coefficients are so small that terms of higher order show until the end
        assert order <= iv.METHODS[pair].order + HIGHER_ORDER + uncertainty


@pytest.mark.parametrize("interpolation", ["projected", "corrected", "raw"])
def test_order_between_steps(pair, interpolation):
    """The local error of the extension of order p is O(h^{p+1}): it shows in the first step, without a global error."""

    def error(n):
        sol = fixed_steps(
            ORBIT, pair, n, 2.0, invariants=ORBIT.invariants(), dense_output=True, interpolation=interpolation
        )
        t = np.linspace(0, sol.steps.h[0], 12)[1:-1]
        return max(np.abs(sol.sol(s) - ORBIT.solution(s)).max() for s in t)

    order, uncertainty = convergence(error, 6, 150, FLOOR_OF_A_STEP)
    assert order >= iv.METHODS[pair].extension_order + 1 - 0.4 - uncertainty


def evaluations(sol: iv.Solution, method: str) -> int:
    """Return the cost of the method's attempts."""
    s = sol.stats
    if method == "ode113":  # P E C E; a failed attempt ends before the second evaluation
        return 1 + 2 * s.steps + s.failed
    if method == "ode15s":  # one for each Newton iteration; f_t at the start
        return 2 + s.nsolve
    if method == "ode23s":  # two and f_t; what projection has moved is evaluated again
        return 1 + 3 * s.steps + 2 * s.failed + int((sol.correction > 0).sum())
    if method in ("ode23t", "ode23tb"):  # one for each solve but those of the error; f_t at the start
        estimates = s.nsolve - (sol.nfev - 2)
        assert s.steps <= estimates <= s.steps + s.failed  # none where Newton's iteration has failed
        return 2 + s.nsolve - estimates
    if method == "radau":  # 3 for each iteration, which is two solves, beside one for each error; f at the end
        return 2 + s.steps + 3 * (s.nsolve - s.steps - s.failed) // 2
    return cost_of_pair(sol, method)


def test_projection_costs_no_extra_f(method):
    """Paper, section 4: a projected step costs as many f as one that is not."""
    options = {"jac": kepler_rhs_jacobian} if implicit(method) else {}
    if method == "radau":
        options["max_order"] = 5
    if method in ("radau", "auto"):  # steps so short that none evaluates f between its ends
        options["max_step"] = (ORBIT.t_span[1] - ORBIT.t_span[0]) / 128
    for project in (False, True):
        sol = ORBIT.solve(method, project, **options)
        assert sol.nfev == evaluations(sol, "ode113" if switching(method) else method)
        assert sol.stats.switches == 0


@pytest.mark.parametrize("pair", [name for name, method in METHODS.items() if "fsal" in method.options])
def test_evaluating_f_again_costs_one_per_correction(pair):
    again = ORBIT.solve(pair, fsal="evaluate")
    stages = iv.METHODS[pair].stages
    assert again.nfev == 1 + stages * (again.stats.steps + again.stats.failed) + int((again.correction > 0).sum())


def kepler_rhs_jacobian(t, y):
    x, z, _, _ = y
    r2 = x * x + z * z
    r5 = r2**2.5
    return [
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [(2 * x * x - z * z) / r5, 3 * x * z / r5, 0, 0],
        [3 * x * z / r5, (2 * z * z - x * x) / r5, 0, 0],
    ]


@pytest.mark.parametrize("method", ["dop853", "ode78", "ode89", "rkn86", "rkn1210"])
def test_few_attempts_fail_where_the_solution_sets_the_steps(method):
    """The controller foresees the way to a pericentre; without that, a fifth of the attempts fail."""
    orbit = kepler(0.91)
    problem = iv.Problem(orbit.fun, (0, 20), orbit.y0, second_order=method.startswith("rkn"))
    failed = []
    for rtol in 10.0 ** -np.linspace(4, 9, 21):
        stats = problem.solve(method, rtol=rtol, atol=rtol).stats
        failed.append(stats.failed / (stats.steps + stats.failed))
    assert np.median(failed) < 0.1


@pytest.mark.slow
@dealt(12, method=METHODS, project=[False, True])
def test_error_follows_the_tolerance(method, project):
    """The largest error over the interval falls by at least 1.5 per half decade of rtol, from 1e-2 down to 1e-10, or
    to 1e-7 where the order is so low that the steps are very many."""
    rtols = np.logspace(-2, -10, 17) if iv.METHODS[method].order > 3 else np.logspace(-2, -7, 11)
    options = {"jac": kepler_rhs_jacobian} if implicit(method) else {}
    errors = []
    for rtol in rtols:
        sol = ORBIT.solve(method, project, rtol=rtol, atol=1e-3 * rtol, refine=2, **options)
        errors.append(np.abs(sol.y - ORBIT.solution(sol.t)).max())
    falls = np.log(errors[0] / errors[-1]) / (len(rtols) - 1)
    assert falls > np.log(1.5)
    assert np.all(np.array(errors[4:]) < np.array(errors[:-4]))  # and never stands still for two decades


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize(("multistep", "dearer"), [("ode113", 1.06), ("ode15s", 1.12)])
def test_projection_enters_the_memory_of_multistep_methods(multistep, dearer, rtol):
    """Ten periods at e = 0.6: the projected run ends ten times closer than the projection of the plain run, for a few
    per cent more f. (ode15s: 5 % in the median of many tolerances; Newton's iteration needs a second f more often.)"""
    e, tf = 0.6, 20 * np.pi
    y0 = [1 - e, 0, 0, ((1 + e) / (1 - e)) ** 0.5]
    options = {"method": multistep, "rtol": rtol, "atol": 1e-3 * rtol}
    plain = iv.solve_ivp(ORBIT.fun, (0, tf), y0, **options)
    projected = iv.solve_ivp(ORBIT.fun, (0, tf), y0, invariants=ORBIT.invariants(), **options)
    held = ORBIT.g(0, np.array(y0))
    afterwards = iv.impose(ORBIT.invariants(), tf, plain.y[:, -1], value=held, rtol=rtol, atol=1e-3 * rtol)
    assert afterwards.converged
    assert np.abs(projected.y[:, -1] - y0).max() < 0.1 * np.abs(afterwards.y - y0).max()
    assert projected.nfev <= dearer * plain.nfev


@families
def test_projection_is_more_than_cosmetic(method):
    """The end state of a projected run is not the projection of the plain run's: it is much closer to the solution."""
    tf = 20 * np.pi
    options = {"rtol": 1e-5, "atol": 1e-8}
    if method == "ode23t":  # near 1e-5 its plain error changes sign
        options = {"rtol": 1e-6, "atol": 1e-9}
    plain = iv.solve_ivp(ORBIT.fun, (0, tf), ORBIT.y0, method, **options)
    projected = iv.solve_ivp(ORBIT.fun, (0, tf), ORBIT.y0, method, invariants=ORBIT.invariants(), **options)
    held = ORBIT.g(0, np.array(ORBIT.y0))
    afterwards = iv.impose(ORBIT.invariants(), tf, plain.y[:, -1], value=held, **options)
    assert afterwards.converged

    def error(y):
        return np.abs(y - ORBIT.y0).max()

    much = 0.1 if iv.METHODS[method].order > 2 else 0.25
    assert error(projected.y[:, -1]) < much * error(afterwards.y)
