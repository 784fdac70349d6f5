"""The fitted order is that of the method, plain and projected, whichever first stage follows a projection."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from problems import PROBLEMS, TestProblem

ORBIT = PROBLEMS["Kepler"]
#: One invariant in four dimensions: where the invariants pin down most of the state, projection gains an order.
STARS = PROBLEMS["Henon-Heiles"]
STEPS = {"ode23": (400, 600, 900, 1350), "ode45": (160, 240, 360, 540)}


def fixed_steps(problem: TestProblem, method: str, n: int, tf: float, **options) -> iv.Solution:
    """n equal steps: atol = 1 makes the error test pass, max_step keeps h from growing."""
    h = (tf - problem.t_span[0]) / n
    sol = iv.solve_ivp(
        problem.fun, (0, tf), problem.y0, method, first_step=h, max_step=h, rtol=1e-3, atol=1.0, **options
    )
    assert sol.stats.failed == 0
    assert abs(sol.stats.steps - n) <= 1
    return sol


def slope(n: tuple[int, ...], errors: list[float]) -> float:
    return float(-np.polyfit(np.log(n), np.log(errors), 1)[0])


@pytest.fixture(scope="module")
def reference() -> iv.DenseSolution:
    sol = STARS.solve("ode45", False, rtol=1e-13, atol=1e-15, dense_output=True)
    assert sol.sol is not None
    return sol.sol


@pytest.mark.parametrize("fsal", ["reuse", "evaluate"])
@pytest.mark.parametrize("project", [False, True])
def test_order_of_the_solution(method, project, fsal, reference):
    invariants = STARS.invariants() if project else None
    errors = []
    for n in STEPS[method]:
        sol = fixed_steps(STARS, method, n, 10.0, fsal=fsal, invariants=invariants)
        errors.append(np.abs(sol.y - reference(sol.t)).max())
        assert sol.stats.projections == (sol.stats.steps if project else 0)
    assert slope(STEPS[method], errors) == pytest.approx(iv.METHODS[method].order, abs=0.15)


@pytest.mark.parametrize("interpolation", ["projected", "corrected", "raw"])
def test_order_between_steps(method, interpolation):
    """The local error of the extension of order p is O(h^{p+1}): it shows in the first step, without a global error."""
    p = iv.METHODS[method].extension_order
    errors = []
    sizes = (20, 30, 45, 68) if method == "ode45" else (40, 60, 90, 135)
    for n in sizes:
        sol = fixed_steps(
            ORBIT, method, n, 2.0, invariants=ORBIT.invariants(), dense_output=True, interpolation=interpolation
        )
        h = sol.steps.h[0]
        t = np.linspace(0, h, 12)[1:-1]
        errors.append(max(np.abs(sol.sol(s) - ORBIT.solution(s)).max() for s in t))
    assert slope(sizes, errors) >= p + 1 - 0.3


def test_saving_costs_no_extra_f(method):
    """Paper, section 4: a projected step costs as many f as one that is not."""
    stages = iv.METHODS[method].stages
    for project in (False, True):
        sol = ORBIT.solve(method, project)
        assert sol.nfev == 1 + stages * (sol.stats.steps + sol.stats.failed)
    again = ORBIT.solve(method, fsal="evaluate")
    assert again.nfev == 1 + stages * (again.stats.steps + again.stats.failed) + int((again.correction > 0).sum())


def test_projection_is_more_than_cosmetic(method):
    """The end state of a projected run is not the projection of the plain run's: it is much closer to the solution."""
    tf = 20 * np.pi
    plain = iv.solve_ivp(kepler := ORBIT.fun, (0, tf), ORBIT.y0, method, rtol=1e-5, atol=1e-8)
    projected = iv.solve_ivp(kepler, (0, tf), ORBIT.y0, method, rtol=1e-5, atol=1e-8, invariants=ORBIT.invariants())
    afterwards = iv.impose(
        ORBIT.invariants(), tf, plain.y[:, -1], value=ORBIT.g(0, np.array(ORBIT.y0)), rtol=1e-5, atol=1e-8
    )
    assert afterwards.converged

    def error(y):
        return np.abs(y - ORBIT.y0).max()

    assert error(projected.y[:, -1]) < 0.1 * error(afterwards.y)
