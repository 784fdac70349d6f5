"""Errors in units of the tolerance on standard test sets: ``python benchmarks/detest.py [--write]``.

The 25 problems of DETEST (T. E. Hull, W. H. Enright, B. M. Fellen, A. E. Sedgwick, Comparing numerical methods for
ordinary differential equations, SIAM J. Numer. Anal. 9 (1972) 603-637), each over 0 <= t <= 20, and the small stiff
problems of tests/stiff.py. Nothing is timed: the tables are the same on every machine, but for roundoff.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.integrate
from measure import installed, table, write_section
from numpy.typing import NDArray

import invariode as iv
from invariode import problems

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from stiff import E5_END, E5_START, E5_Y2, E5_Y3, PROBLEMS, StiffProblem, e5

Array = NDArray[np.float64]

SPAN = (0.0, 20.0)
TIMES = np.linspace(*SPAN, 41)
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9)
STIFF_TOLERANCES = (1e-4, 1e-6, 1e-8)
#: Where steps are long, and where the limit hardly matters.
LIMITED_TOLERANCES = (1e-3, 1e-6)
#: Of the references; two codes must agree on them to the tightest tolerance. (On D5 to 0.2 of it, else to 0.06.)
REFERENCE, CHECK = 1e-13, min(TOLERANCES)

#: Formulas of order 2 would take hundreds of thousands of steps at 1e-9; the Nyström pairs take second-order equations.
SUITE = tuple(name for name, method in iv.METHODS.items() if method.order > 2 and method.equations != "second-order")
SCIPY = ("RK23", "RK45", "DOP853", "LSODA", "BDF", "Radau")
STIFF_SUITE, STIFF_SCIPY = ("ode15s", "radau"), ("BDF", "LSODA", "Radau")


@dataclass(frozen=True)
class Problem:
    """y' = f(t, y), y(0) = y0."""

    name: str
    fun: Callable[[float, Array], Any]
    y0: Sequence[float]


# ----------------------------------------------------------------------------------------------------------------------
# DETEST


def cascade(rates: Array) -> Callable[[float, Array], Array]:
    """C1 and C2: each of ten substances decays into the next at its rate, the last is stable."""

    def fun(t: float, y: Array) -> Array:
        flow = rates * y[:-1]
        return np.append(-flow, 0) + np.append(0, flow)

    return fun


def diffusion(t: float, y: Array) -> Array:
    """C3 and C4."""
    padded = np.concatenate(([0], y, [0]))
    return padded[:-2] - 2 * y + padded[2:]


#: C5: five planets about the sun; lengths in astronomical units, times in 100 days.
GRAVITY, SUN = 2.95912208286, 1.00000597682
PLANETS = np.array([0.954786104043e-3, 0.285583733151e-3, 0.437273164546e-4, 0.517759138449e-4, 0.277777777778e-5])
PLACES = [
    *(3.42947415189, 3.35386959711, 1.35494901715, 6.64145542550, 5.97156957878, 2.18231499728),
    *(11.2630437207, 14.6952576794, 6.27960525067, -30.1552268759, 1.65699966404, 1.43785752721),
    *(-21.1238353380, 28.4465098142, 15.3882659679),
]
SPEEDS = [
    *(-0.557160570446, 0.505696783289, 0.230578543901, -0.415570776342, 0.365682722812, 0.169143213293),
    *(-0.325325669158, 0.189706021964, 0.0877265322780, -0.0240476254170, -0.287659532608, -0.117219543175),
    *(-0.176860753121, -0.216393453025, -0.0148647893090),
]


def five_bodies(t: float, y: Array) -> Array:
    """C5, in coordinates that move with the sun."""
    x = y[:15].reshape(5, 3)
    apart = x[None, :, :] - x[:, None, :]
    cubes = (np.sum(apart**2, axis=2) + np.eye(5)) ** 1.5  # apart is 0 where j = k; 0**1.5 has no Taylor series
    sun = x / np.sum(x**2, axis=1, keepdims=True) ** 1.5
    pull = np.einsum("k,jki->ji", PLANETS, apart / cubes[:, :, None] - sun[None, :, :])
    # m_0 alone: the sum has taken -m_j sun_j of -(m_0 + m_j) sun_j.
    return np.concatenate((y[15:], (GRAVITY * (pull - SUN * sun)).ravel()))


def ball_rolling(t: float, y: Array) -> list[float]:
    """B4: the integral surface of a torus."""
    a, b, c = y
    r = np.hypot(a, b)
    return [-b - a * c / r, a - b * c / r, a / r]


def bessel(t: float, y: Array) -> list[float]:
    """E1, of order one half, at t + 1."""
    return [y[1], -y[1] / (t + 1) - (1 - 0.25 / (t + 1) ** 2) * y[0]]


def detest() -> Iterator[Problem]:
    yield Problem("A1", lambda t, y: -y, [1])
    yield Problem("A2", lambda t, y: -(y**3) / 2, [1])
    yield Problem("A3", lambda t, y: y * np.cos(t), [1])
    yield Problem("A4", lambda t, y: y / 4 * (1 - y / 20), [1])
    yield Problem("A5", lambda t, y: (y - t) / (y + t), [4])
    yield Problem("B1", lambda t, y: [2 * (y[0] - y[0] * y[1]), -(y[1] - y[0] * y[1])], [1, 3])
    yield Problem("B2", lambda t, y: [-y[0] + y[1], y[0] - 2 * y[1] + y[2], y[1] - y[2]], [2, 0, 1])
    yield Problem("B3", lambda t, y: [-y[0], y[0] - y[1] ** 2, y[1] ** 2], [1, 0, 0])
    yield Problem("B4", ball_rolling, [3, 0, 0])
    yield Problem("B5", problems.rigid_body().fun, [0, 1, 1])
    first = np.eye(10)[0].tolist()
    yield Problem("C1", cascade(np.ones(9)), first)
    yield Problem("C2", cascade(np.arange(1.0, 10)), first)
    yield Problem("C3", diffusion, first)
    yield Problem("C4", diffusion, np.eye(51)[0].tolist())
    yield Problem("C5", five_bodies, PLACES + SPEEDS)
    for i, e in enumerate((0.1, 0.3, 0.5, 0.7, 0.9), start=1):
        orbit = problems.kepler(e)
        yield Problem(f"D{i}", orbit.fun, orbit.y0.tolist())
    yield Problem("E1", bessel, [0.6713967071418030, 0.09540051444747446])
    yield Problem("E2", lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] - y[0]], [2, 0])
    yield Problem("E3", lambda t, y: [y[1], y[0] ** 3 / 6 - y[0] + 2 * np.sin(2.78535 * t)], [0, 0])
    yield Problem("E4", lambda t, y: [y[1], 0.032 - 0.4 * y[1] ** 2], [30, 0])
    yield Problem("E5", lambda t, y: [y[1], np.sqrt(1 + y[1] ** 2) / (25 - t)], [0, 0])


# ----------------------------------------------------------------------------------------------------------------------
# Runs


def solve(method: str, problem: Problem, rtol: float, **options: Any) -> tuple[Array, int]:
    """The solution at TIMES and the evaluations of f. atol is rtol."""
    code = iv.solve_ivp if method in SUITE else scipy.integrate.solve_ivp
    sol = code(problem.fun, SPAN, problem.y0, method=method, rtol=rtol, atol=rtol, t_eval=TIMES, **options)
    if not sol.success:
        raise SystemExit(f"{method} fails on {problem.name} at rtol {rtol}: {sol.message}")
    return sol.y, sol.nfev


def distance(y: Array, z: Array) -> float:
    """The largest difference of any component at any time, in units of max(1, |z|)."""
    return float((np.abs(y - z) / np.maximum(np.abs(z), 1)).max())


def reference(problem: Problem) -> Array:
    y, z = (solve(method, problem, REFERENCE)[0] for method in ("DOP853", "ode78"))
    if (off := distance(z, y)) > CHECK:
        raise SystemExit(f"the references of {problem.name} differ by {off:.1e}")
    return y


def proportionality(errors: Array) -> Array:
    """The exponent p of error ~ tolerance^p for each problem, by least squares: 1 is wanted."""
    return np.polyfit(np.log(TOLERANCES), np.log(errors).T, 1)[0]


def nonstiff_tables() -> str:
    """One row per method: median and largest error over DETEST in tolerances, p, and f in all."""
    set_of_problems = list(detest())
    exact = [reference(problem) for problem in set_of_problems]
    rows, worst = [], []
    for method in (*SUITE, *SCIPY):
        runs = [[solve(method, problem, rtol) for rtol in TOLERANCES] for problem in set_of_problems]
        errors = np.array([[distance(y, z) for y, _ in row] for row, z in zip(runs, exact, strict=True)])
        work = np.array([[nfev for _, nfev in row] for row in runs]).sum(axis=0)
        units = errors / TOLERANCES
        cells = [f"{np.median(u):.2g} ({u.max():.2g}), {nfev}" for u, nfev in zip(units.T, work, strict=True)]
        p = proportionality(errors)
        rows.append([method, *cells, f"{np.median(p):.2f} ({p.min():.2f}–{p.max():.2f})"])
        worst.append([method, *(max_of_class(set_of_problems, units[:, 2], letter) for letter in "ABCDE")])
    header = ["method", *(f"{rtol:.0e}" for rtol in TOLERANCES), "p"]
    return "\n\n".join(
        (
            "Error ÷ tolerance over the 25 problems, median (largest), and evaluations of f in all:",
            table(header, rows),
            f"The largest error ÷ tolerance in each class at {TOLERANCES[2]:.0e}, and on which problem:",
            table(["method", *"ABCDE"], worst),
        )
    )


def table_of_limits() -> str:
    """What a largest step of a tenth of the interval, the suite's rule, costs and gains: as in `nonstiff_tables`."""
    set_of_problems = list(detest())
    exact = [reference(problem) for problem in set_of_problems]
    rows = []
    for method in SUITE:
        cells = []
        for rtol in LIMITED_TOLERANCES:
            for limit in ("tenth", np.inf):
                runs = [solve(method, problem, rtol, max_step=limit) for problem in set_of_problems]
                units = np.array([distance(y, z) for (y, _), z in zip(runs, exact, strict=True)]) / rtol
                cells.append(f"{np.median(units):.2g} ({units.max():.2g}), {sum(nfev for _, nfev in runs)}")
        rows.append([method, *cells])
    header = ["method", *(f"{rtol:.0e}, {limit}" for rtol in LIMITED_TOLERANCES for limit in ("a tenth", "no limit"))]
    return "\n\n".join(("The same with steps up to a tenth of the interval, and without a limit:", table(header, rows)))


def table_of_failures() -> str:
    """How many attempts fail where the solution sets the steps: on D5, an orbit of eccentricity 0.9."""
    (orbit,) = (problem for problem in detest() if problem.name == "D5")
    rows = []
    for method in SUITE:
        runs = [iv.solve_ivp(orbit.fun, SPAN, orbit.y0, method, rtol=rtol, atol=rtol).stats for rtol in TOLERANCES]
        rows.append([method, *(f"{100 * run.failed / (run.steps + run.failed):.1f}" for run in runs)])
    header = ["method", *(f"{rtol:.0e}" for rtol in TOLERANCES)]
    return "\n\n".join(("Attempts that fail on D5, in percent:", table(header, rows)))


def max_of_class(set_of_problems: Sequence[Problem], units: Array, letter: str) -> str:
    value, name = max(
        (float(unit), problem.name)
        for problem, unit in zip(set_of_problems, units, strict=True)
        if problem.name.startswith(letter)
    )
    return f"{value:.2g} ({name})"


def stiff_run(method: str, problem: StiffProblem, rtol: float) -> str:
    """Error ÷ tolerance and f, with a Jacobian by differences, or why the run failed."""
    code = iv.solve_ivp if method in STIFF_SUITE else scipy.integrate.solve_ivp
    sol = code(
        lambda t, y: problem.fun(t, y, *(problem.args or ())),
        problem.t_span,
        problem.y0,
        method=method,
        rtol=rtol,
        atol=rtol * problem.scale,
        t_eval=problem.times,
    )
    return f"{problem.error(sol.y) / rtol:.2g}, {sol.nfev}" if sol.success else "fails"


def e5_run(method: str, rtol: float) -> str:
    """The relative error of y2 and y3 of E5 at the end, and f."""
    code = iv.solve_ivp if method in STIFF_SUITE else scipy.integrate.solve_ivp
    sol = code(e5, (0, E5_END), E5_START, method=method, rtol=rtol, atol=1e-24, t_eval=[E5_END])
    if not sol.success:
        return "fails"
    return f"{np.abs(sol.y[1:3, -1] / (E5_Y2, E5_Y3) - 1).max():.1e}, {sol.nfev}"


def stiff_tables() -> str:
    methods = (*STIFF_SUITE, *STIFF_SCIPY)
    small = [p for p in PROBLEMS.values() if len(p.y0) < 100]
    rows = [
        [p.name, f"{rtol:.0e}", *(stiff_run(method, p, rtol) for method in methods)]
        for p in small
        for rtol in STIFF_TOLERANCES
    ]
    pyrolysis = [[f"{rtol:.0e}", *(e5_run(method, rtol) for method in methods)] for rtol in STIFF_TOLERANCES]
    return "\n\n".join(
        (
            "Stiff problems without a given Jacobian: largest error ÷ tolerance, and evaluations of f:",
            table(["problem", "rtol", *methods], rows),
            "Pyrolysis (E5, to t = 1e13, `atol=1e-24`): the relative error of y₂ and y₃ at the end, 9e-23 after 2e-10:",
            table(["rtol", *methods], pyrolysis),
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="replace the tables in docs/benchmarks")
    arguments = parser.parse_args()
    versions = f"SciPy {installed('scipy')}, `atol = rtol` on DETEST."
    text = "\n\n".join((versions, nonstiff_tables(), table_of_limits(), table_of_failures(), stiff_tables()))
    print(text)
    if arguments.write:
        write_section("detest", text)


if __name__ == "__main__":
    main()
