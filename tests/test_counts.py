"""Counts and errors printed by MATLAB and in the paper are reproduced to the unit and to the printed digits."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from paper.published import PUBLISHED, matlab
from problems import PROBLEMS
from stiff import PROBLEMS as STIFF

HIRES = STIFF["HIRES"]
LINEAR = PUBLISHED["problems"]["third-order linear"]


def third_order(t, u):
    return [u[1], u[2], -u[2] - 4 * u[1] - 4 * u[0] + 4 * t**2 + 8 * t - 10]


def rows(problem: str, method: str = "ode45") -> list[dict]:
    found = matlab(problem, method)
    assert found
    return found


@pytest.mark.parametrize("code", ["ode45", "ode113"])
@pytest.mark.parametrize("row", rows("third-order linear"), ids=lambda row: row["rtol"])
def test_third_order_linear(row, code):
    rtol, printed = float(row["rtol"]), row[code]
    sol = getattr(iv, code)(
        third_order,
        LINEAR["t_span"],
        LINEAR["y0"],
        rtol=rtol,
        atol=float(row["atol"]),
        dense_output=True,
        interpolation="raw",
    )
    assert sol.nfev == printed["nfev"]
    t = np.linspace(0, 2, 500)
    error = np.abs(sol.sol(t)[0] - (-np.sin(2 * t) + t**2 - 3)).max()
    if rtol > 1e-10:
        assert f"{error:.3e}" == printed["error"]
    elif rtol > 1e-12:  # the last digit is roundoff's
        assert error == pytest.approx(float(printed["error"]), abs=1.001e-15)
    else:  # only the size is not
        assert error == pytest.approx(float(printed["error"]), rel=0.5)


@pytest.mark.parametrize(("n", "printed"), rows("flame")[0]["q"].items())
def test_flame(n, printed):
    n = int(n)
    nodes = np.cos(np.pi * np.arange(n) / (n - 1)) if n > 1 else np.zeros(1)
    # Clenshaw-Curtis: the rule that integrates the Chebyshev polynomials T_0 … T_{n-1} exactly.
    exact = [2 / (1 - k * k) if k % 2 == 0 else 0 for k in range(n)]
    weights = np.linalg.solve(np.cos(np.outer(np.arange(n), np.arccos(nodes))), exact)

    def burnt(t, y):
        return y[0] - 0.99

    burnt.terminal = True
    times = [
        iv.ode45(lambda t, y: [y[0] ** 2 * (1 - y[0])], (0, 250), [0.01 * 2**u], events=burnt).t_events[0][0]
        for u in nodes
    ]
    assert f"{weights @ times / 2:.3f}" == f"{printed:.3f}"


def test_decay_with_ramp():
    row = rows("x'=-2x+t")[0]
    sol = iv.ode45(lambda t, x: [-2 * x[0] + t], (0, 10), [0])
    assert (sol.stats.steps, sol.stats.failed, sol.nfev, len(sol.t)) == tuple(
        row[key] for key in ("steps", "failed", "nfev", "points")
    )


@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")
@pytest.mark.parametrize("code", ["ode45", "ode15s"])
def test_heat_equation_points(code):
    x = np.arange(100) / 100
    sol = getattr(iv, code)(
        lambda t, u: 1e4 * (np.roll(u, 1) - 2 * u + np.roll(u, -1)), (0, 0.05), np.exp(-60 * (x - 0.5) ** 2)
    )
    assert len(sol.t) == rows("heat", code)[0]["points"]


def test_hires():
    row = rows("hires", "ode15s")[0]
    sol = iv.ode15s(HIRES.fun, HIRES.t_span, HIRES.y0, rtol=row["rtol"], atol=row["atol"])
    s = sol.stats
    assert (s.steps, s.failed, sol.nfev, sol.nlu, s.nsolve) == tuple(
        row[key] for key in ("steps", "failed", "nfev", "nlu", "solves")
    )


@pytest.mark.parametrize("row", rows("van der Pol", "ode15s"), ids=lambda row: row["t_end"])
def test_van_der_pol(row):
    sol = iv.ode15s(lambda t, y: [y[1], 1000 * (1 - y[0] ** 2) * y[1] - y[0]], (0, row["t_end"]), [2, 0])
    s = sol.stats
    here = {
        "steps": s.steps,
        "failed": s.failed,
        "nfev": sol.nfev,
        "njev": sol.njev,
        "nlu": sol.nlu,
        "solves": s.nsolve,
    }
    assert {key: here[key] for key in here if key in row} == {key: row[key] for key in here if key in row}


def counts(sol: iv.Solution) -> tuple[int, ...]:
    return sol.stats.steps, sol.stats.failed, sol.nlu, sol.stats.nsolve, sol.nfev


def test_ode23s_on_hires():
    """MATLAB prints 303 steps, none failed, 303 factorisations, 909 solves; and 3336 f, one of which is another one at
    the start."""
    sol = iv.ode23s(HIRES.fun, HIRES.t_span, HIRES.y0, rtol=1e-6, atol=1e-6)
    assert counts(sol) == (303, 0, 303, 909, 3336 - 1)


def test_ode23s_on_a_very_stiff_linear_equation():
    """There 63, none, 63, 189, and 191 f with that one."""
    assert counts(iv.ode23s(lambda t, y: -1e9 * y, (0, 0.5), [1.0], jac=[[-1e9]])) == (63, 0, 63, 189, 191 - 1)


def test_linear_system_points():
    sol = iv.ode45(lambda t, x: [x[1], -3 * x[0] + 2 * x[1]], (0, 10), [1, -1])
    assert len(sol.t) == rows("linear 2x2")[0]["points"]


def test_blow_up_ends_where_matlab_ends():
    sol = iv.ode45(lambda t, u: (t + u) ** 2, (0, 1), [1])
    assert not sol.success
    assert sol.status == -1
    printed = rows("blow-up")[0]["fails_at"]
    t, hmin = printed.removeprefix("t=").split(", smallest step allowed ")
    assert f"{sol.t[-1]:.6e}" == t
    assert f"smallest step allowed is {hmin}" in sol.message


COUNTS = {  # docs/algorithms.md, 'The experiments': largest residual, steps, failed, nfev
    "Lotka-Volterra plain": ("ode23", False, {}, "9.1177", (391, 27, 1255)),
    "Lotka-Volterra projected": ("ode23", True, {}, "8.7976e-05", (389, 26, 1246)),
    "Lotka-Volterra projected, f evaluated again": ("ode23", True, {"fsal": "evaluate"}, "7.01e-05", None),
    "pendulum plain": ("ode45", False, {}, "1.1929", (98, 10, 649)),
    "three-body plain": ("ode113", False, {}, None, (190, 17, 398)),
    "three-body projected": ("ode113", True, {}, None, (182, 20, 385)),
    "pendulum projected": ("ode45", True, {"refine": 4, "interpolation": "raw"}, "0.00033632", (113, 9, 733)),
}


@pytest.mark.parametrize("name", COUNTS)
def test_paper(name):
    method, project, options, printed, counts = COUNTS[name]
    problem = PROBLEMS[name.split()[0]]
    sol = problem.solve(method, project, max_step="tenth", **options)
    values = [problem.g(t, y) for t, y in zip(sol.t, sol.y.T, strict=True)]
    first = np.array([np.atleast_1d(v)[0] for v in values])  # of the pendulum, its length
    if printed:
        digits = len(printed.replace("0.000", "").replace(".", "").split("e")[0])
        assert float(f"{np.abs(first - first[0]).max():.{digits - 1}e}") == float(printed)
    if counts:
        assert (sol.stats.steps, sol.stats.failed, sol.nfev) == counts


@pytest.mark.parametrize(("project", "gap"), [(False, "0.548"), (True, "0.0197")])
def test_gap_of_the_orbit_of_figure_1(project, gap):
    problem = PROBLEMS["three-body"]
    sol = iv.ode113(
        problem.fun,
        (0, 6.19216933131963970674),
        [1.2, 0, 0, -1.04935750983031990726],
        invariants=problem.invariants() if project else None,
    )
    assert f"{np.hypot(*(sol.y[:2, -1] - sol.y[:2, 0])):.3g}" == gap


def test_residual_inside_the_last_step_is_that_of_figure_2():
    problem = PROBLEMS["Lotka-Volterra"]
    sol = problem.solve("ode23", refine=4, max_step="tenth", interpolation="raw")
    inside = np.abs(sol.residual[0, -5:])
    assert f"{inside.max():.2e}" == "6.76e-03"


def test_impose_reaches_ten_units_in_the_last_place_of_g_everywhere():
    problem = PROBLEMS["Lotka-Volterra"]
    sol = problem.solve("ode23", refine=4, max_step="tenth", interpolation="raw").impose()
    assert np.abs(sol.residual).max() <= 1.5e-13
    assert np.abs(sol.residual[0, -5:]).max() <= 3e-14
