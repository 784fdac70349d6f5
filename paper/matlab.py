"""Numbers that MATLAB's codes print for problems other than the paper's: counts, errors, event times, a failure.

They come from public material that shows MATLAB's output. Errors are those of the method's own continuous extension;
the numbers of points are those of the suite's defaults, four per step of ode45 and one of ode15s.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from invariode._base.arguments import Array
from invariode._base.method_names import OwnName
from invariode._problem.events import Event
from invariode._results.records import StiffnessWarning
from invariode._results.solution import Solution
from invariode._solve.ivp import solve_ivp
from invariode._solve.ode_functions import ode15s, ode45
from invariode.problems import hires

from .published import matlab
from .rows import DIGITS, LAST_DIGIT, SIZE, Row

__all__ = ["matlab_rows"]

SOURCE = "MATLAB"
SUITE = {"ode45": ode45, "ode15s": ode15s}

#: How the errors are met at these tolerances: roundoff reaches the last digit at 1e-11, all of them at 1e-13.
RULES = {"1e-11": LAST_DIGIT, "1e-13": SIZE}


def matlab_rows() -> list[Row]:
    """Solves these problems and holds the results against what MATLAB prints."""
    third_order = [row for method in ("ode45", "ode113") for row in _third_order(method)]
    return [*third_order, *_hires(), *_van_der_pol(), *_flame(), *_scalar_linear(), *_points(), *_blow_up()]


def _third_order(method: OwnName) -> list[Row]:
    """u''' + u'' + 4 u' + 4 u = 4 t² + 8 t - 10 on [0, 2], whose solution is -sin 2t + t² - 3."""
    title = f"u‴ = −u″ − 4u′ − 4u + 4t² + 8t − 10 on [0, 2], rtol = atol, {method}"

    def f(t: float, u: Array) -> list[float]:
        return [u[1], u[2], -u[2] - 4 * u[1] - 4 * u[0] + 4 * t**2 + 8 * t - 10]

    t = np.linspace(0, 2, 500)
    exact = -np.sin(2 * t) + t**2 - 3
    rows = []
    for row in matlab("third-order linear"):
        printed, counted = row["rtol"], row[method]
        tol = float(printed)
        sol = solve_ivp(
            f,
            (0, 2),
            [-3, -2, 2],
            method,
            dense_output=True,
            rtol=tol,
            atol=tol,
            max_step="tenth",
            interpolation="raw",
        )
        assert sol.sol is not None  # dense_output=True
        error, rule = np.abs(sol.sol(t)[0] - exact).max(), RULES.get(printed, DIGITS)
        rows.append(Row(title, f"evaluations of f, {printed}", str(counted["nfev"]), sol.nfev, SOURCE, stats=sol.stats))
        rows.append(Row(title, f"error, {printed}", counted["error"], error, SOURCE, rule))
    return rows


def _hires() -> list[Row]:
    """The counts of Stats for HIRES with ode15s, the Jacobian by differences."""
    title = "HIRES, ode15s, rtol = atol = 1e-6, Jacobian by differences"
    problem = hires()
    sol = ode15s(problem.fun, problem.t_span, problem.y0, rtol=1e-6, atol=1e-6)
    (printed,) = matlab("hires", "ode15s")
    return [
        *_counts(title, printed, sol),
        Row(title, "LU factorisations", str(printed["nlu"]), sol.nlu, SOURCE),
        Row(title, "solutions of linear systems", str(printed["solves"]), sol.stats.nsolve, SOURCE),
    ]


def _van_der_pol() -> list[Row]:
    """The counts of Stats for van der Pol's equation, mu = 1000, with ode15s and the default tolerances."""
    rows = []
    for printed in matlab("van der Pol", "ode15s"):
        sol = ode15s(lambda t, y: [y[1], 1000 * (1 - y[0] ** 2) * y[1] - y[0]], (0, printed["t_end"]), [2, 0])
        here = {
            "steps": ("successful steps", sol.stats.steps),
            "failed": ("failed attempts", sol.stats.failed),
            "nfev": ("evaluations of f", sol.nfev),
            "njev": ("Jacobians", sol.njev),
            "nlu": ("LU factorisations", sol.nlu),
            "solves": ("solutions of linear systems", sol.stats.nsolve),
        }
        title = f"van der Pol, μ = 1000, ode15s, default tolerances, to t = {printed['t_end']}"
        rows += [
            Row(title, quantity, str(printed[key]), count, SOURCE, stats=sol.stats)
            for key, (quantity, count) in here.items()
            if key in printed
        ]
    return rows


def _counts(title: str, printed: Mapping[str, Any], sol: Solution) -> list[Row]:
    return [
        Row(title, "successful steps", str(printed["steps"]), sol.stats.steps, SOURCE, stats=sol.stats),
        Row(title, "failed attempts", str(printed["failed"]), sol.stats.failed, SOURCE),
        Row(title, "evaluations of f", str(printed["nfev"]), sol.nfev, SOURCE),
    ]


def clenshaw_curtis(n: int) -> tuple[Array, Array]:
    """Nodes and weights on [-1, 1]: the rule that integrates the polynomial through the n Chebyshev points exactly."""
    if n == 1:
        return np.zeros(1), np.array([2.0])
    u = np.cos(np.pi * np.arange(n) / (n - 1))
    k = np.arange(n)
    chebyshev = np.cos(np.outer(k, np.arccos(u)))
    integrals = np.array([0.0 if j % 2 else 2 / (1 - j * j) for j in range(n)])  # of T_j
    return u, np.linalg.solve(chebyshev, integrals)


def _flame() -> list[Row]:
    """y' = y² (1 - y) from 0.01·2^u until y = 0.99, averaged over u in [-1, 1]."""
    title = "y′ = y²(1 − y), y(0) = 0.01·2ᵘ: time until y = 0.99, mean over u in [−1, 1]"
    grown = Event(lambda t, y: y[0] - 0.99, terminal=True)

    def duration(u: float) -> float:
        sol = solve_ivp(lambda t, y: y**2 * (1 - y), (0, 250), [0.01 * 2**u], events=grown, max_step="tenth")
        assert sol.t_events is not None  # there is an event
        return float(sol.t_events[0][0])

    rows = []
    for points, mean in matlab("flame")[0]["q"].items():
        n, printed = int(points), str(mean)
        u, w = clenshaw_curtis(n)
        q = sum(w_j * duration(u_j) for w_j, u_j in zip(w, u, strict=True)) / 2
        rows.append(Row(title, f"by the {n}-point rule" if n > 1 else "at the midpoint", printed, q, SOURCE))
    return rows


def _scalar_linear() -> list[Row]:
    """x' = -2 x + t, x(0) = 0: the counts of Stats."""
    title = "x′ = −2x + t, x(0) = 0 on [0, 10]"
    sol = ode45(lambda t, x: -2 * x + t, (0, 10), [0])
    (printed,) = matlab("x'=-2x+t")
    return [*_counts(title, printed, sol), Row(title, "points", str(printed["points"]), len(sol.t), SOURCE)]


def _linear(method: str, matrix: Array, tf: float, y0: ArrayLike, title: str, problem: str) -> Row:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StiffnessWarning)  # diffusion is stiff for ode45, which is what these rows show
        sol = SUITE[method](lambda t, y: matrix @ y, (0, tf), y0)
    (printed,) = matlab(problem, method)
    return Row(title, "points", str(printed["points"]), len(sol.t), SOURCE, stats=sol.stats)


def _points() -> list[Row]:
    """Two linear problems y' = A y: the heat equation by the method of lines, and a growing one of two equations."""
    m = 100
    x = np.arange(m) / m
    shift = np.roll(np.eye(m), 1, axis=0)
    diffusion = "uₜ = uₓₓ, periodic, 100 points, t ≤ 0.05"
    heat = m**2 * (shift - 2 * np.eye(m) + shift.T)
    hump, growing = np.exp(-60 * (x - 0.5) ** 2), np.array([[0, 1], [-3, 2]])
    return [
        _linear("ode45", heat, 0.05, hump, f"{diffusion}, ode45", "heat"),
        _linear("ode15s", heat, 0.05, hump, f"{diffusion}, ode15s", "heat"),
        _linear("ode45", growing, 10, [1, -1], "x₁′ = x₂, x₂′ = −3x₁ + 2x₂ on [0, 10]", "linear 2x2"),
    ]


def _blow_up() -> list[Row]:
    """u' = (t + u)², u(0) = 1, which is tan(t + π/4) - t: the step fails just before t = π/4."""
    title = "u′ = (t + u)², u(0) = 1, which has a pole at t = π/4"
    sol = ode45(lambda t, u: (t + u) ** 2, (0, 1), [1])
    smallest = re.search(r"smallest step allowed is (\S+\d)", sol.message)
    at, hmin = re.findall(r"\d\S*\d", matlab("blow-up")[0]["fails_at"])
    return [
        Row(title, "fails at t", at, float(sol.t[-1]), SOURCE, stats=sol.stats),
        Row(title, "smallest step allowed", hmin, float(smallest[1]) if smallest else np.nan, SOURCE),
    ]
