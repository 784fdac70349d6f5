"""ode113 and ode15s against their peers: ``python benchmarks/multistep.py [--write]``, or ``make bench``.

Each contestant solves each problem at several tolerances, with the same Jacobian and the same right-hand side; times at
equal error are interpolated between the tolerances. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import scipy.integrate
from measure import folded, interleaved, machine, run, table
from stiff_contestants import CVODE, MOST_STEPS, Outcome, Solve, stiff_contestants

import invariode as iv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from problems import PROBLEMS as ORBITS
from problems import TestProblem
from stiff import PROBLEMS as STIFF

RTOLS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
LARGE = (1e-4, 1e-6)  # of the problem that takes seconds
SHOWN = 1e-6


def orbit_contestants(p: TestProblem, tf: float, exact: np.ndarray) -> dict[str, Solve]:
    """Solvers for problems that are not stiff; errors are those of the final state."""

    def error(y: Any) -> float:
        return float(np.abs(y - exact).max())

    def ours(rtol: float, method: str, project: bool) -> Outcome:
        invariants = p.invariants() if project else None
        options = {"method": method, "rtol": rtol, "atol": 1e-3 * rtol, "keep": "end"}
        sol = iv.solve_ivp(p.fun, (0, tf), p.y0, invariants=invariants, **options)
        return Outcome(error(sol.y[:, -1]), sol.nfev)

    def scipys(rtol: float, method: str) -> Outcome:
        sol = scipy.integrate.solve_ivp(p.fun, (0, tf), p.y0, method, t_eval=[tf], rtol=rtol, atol=1e-3 * rtol)
        return Outcome(error(sol.y[:, -1]), sol.nfev)

    def sundials(rtol: float) -> Outcome:
        def rhs(t: float, y: Any, yp: Any) -> None:
            yp[:] = p.fun(t, y)

        solver = CVODE(rhs, method="Adams", rtol=rtol, atol=1e-3 * rtol, max_num_steps=MOST_STEPS)
        sol = solver.solve(np.array([0, tf]), np.array(p.y0, dtype=float))
        return Outcome(error(sol.y[-1]), sol.nfev)

    found: dict[str, Solve] = {}
    for method in ("ode113", "ode45", "ode15s"):
        found[method] = partial(ours, method=method, project=False)
        found[f"{method}, projected"] = partial(ours, method=method, project=True)
    for method in ("LSODA", "DOP853", "RK45"):
        found[f"SciPy {method}"] = partial(scipys, method=method)
    if CVODE is not None:
        found["CVODE Adams"] = sundials
    return found


@dataclass(frozen=True)
class Line:
    """What one contestant did at each tolerance: error and seconds, interpolated on logarithms."""

    outcomes: Sequence[Outcome]
    seconds: Sequence[float]

    def at_error(self, error: float) -> float | None:
        """Seconds for that error, None where no tolerance brackets it."""
        points = [(np.log(o.error), np.log(s)) for o, s in zip(self.outcomes, self.seconds, strict=True)]
        usable = [point for point in points if np.isfinite(point[0])]
        for (e0, s0), (e1, s1) in pairwise(usable):
            if min(e0, e1) <= np.log(error) <= max(e0, e1):
                weight = (np.log(error) - e0) / (e1 - e0)
                return float(np.exp(s0 + weight * (s1 - s0)))
        return None


def measure(contestants: Mapping[str, Solve], rtols: Sequence[float], repetitions: int) -> dict[str, Line]:
    """All contestants at all tolerances in turn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # LSODA and BDF warn where they give up; the table shows it
        outcomes = {name: [solve(rtol) for rtol in rtols] for name, solve in contestants.items()}
        runs = {f"{name} {rtol}": partial(solve, rtol) for rtol in rtols for name, solve in contestants.items()}
        times = interleaved(runs, repetitions)
    return {name: Line(outcomes[name], [median(times[f"{name} {rtol}"]) for rtol in rtols]) for name in contestants}


def shown(value: float | int | None) -> str:
    return "–" if value is None else str(value)


def work(lines: Mapping[str, Line], rtols: Sequence[float], jacobians: bool) -> list[list[str]]:
    """Error, counts and milliseconds at the tolerance that is shown."""
    k = list(rtols).index(SHOWN)
    rows = []
    for name, line in lines.items():
        o = line.outcomes[k]
        counts = [shown(o.f), shown(o.jacobians), shown(o.factorizations)] if jacobians else [shown(o.f)]
        rows.append([name, f"{o.error:.1e}", *counts, f"{1e3 * line.seconds[k]:.2f}"])
    return rows


def at_equal_error(problems: Mapping[str, Mapping[str, Line]], errors: Sequence[float], reference: str) -> str:
    """Times of the others divided by that of the reference, where all of them can be compared."""
    names = list(dict.fromkeys(name for lines in problems.values() for name in lines if name != reference))
    rows = []
    for problem, lines in problems.items():
        for error in errors:
            own = lines[reference].at_error(error)
            if own is None:
                continue
            cells = []
            for name in names:
                other = lines[name].at_error(error) if name in lines else None
                cells.append("–" if other is None else f"{other / own:.2f}")
            rows.append([problem, f"{error:.0e}", f"{1e3 * own:.2f}", *cells])
    return table(["problem", "error", f"{reference}, ms", *names], rows)


def stiff_report(repetitions: int) -> list[str]:
    parts, lines_of = [], {}
    for name, p in STIFF.items():
        large = p.jac_sparsity is not None
        rtols = LARGE if large else RTOLS
        lines = lines_of[name] = measure(stiff_contestants(p), rtols, 1 if large else repetitions)
        print(f"{name} done", file=sys.stderr)
        header = [f"{name}, N = {len(p.y0)}", "error", "f", "J", "LU", "ms"]
        parts.append(table(header, work(lines, rtols, True)))
    compared = at_equal_error(lines_of, (1e-3, 1e-5, 1e-7), "ode15s")
    each = f"Each problem, rtol = {SHOWN:.0e}: errors, evaluations of f, Jacobians, LU factorisations, times"
    return ["Times at equal error, divided by that of ode15s:", compared, folded(each, *parts)]


def orbit_report(repetitions: int) -> list[str]:
    parts, lines_of = [], {}
    ends = {"Lotka-Volterra": 50.0, "three-body": 6.0, "Kepler": 20 * np.pi}
    rtols = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
    for name, tf in ends.items():
        p = ORBITS[name]
        tight = iv.ode113(p.fun, (0, tf), p.y0, rtol=1e-13, atol=1e-15, max_step=np.inf, invariants=p.invariants())
        lines = lines_of[name] = measure(orbit_contestants(p, tf, tight.y[:, -1]), rtols, repetitions)
        print(f"{name} done", file=sys.stderr)
        parts.append(table([f"{name}, t ≤ {tf:.3g}", "error", "f", "ms"], work(lines, rtols, False)))
    compared = at_equal_error(lines_of, (1e-4, 1e-6, 1e-8), "ode113")
    each = f"Each problem, rtol = {SHOWN:.0e}: errors, evaluations of f, times"
    return ["Times at equal error, divided by that of ode113 without projection:", compared, folded(each, *parts)]


def report(repetitions: int) -> str:
    """All tables."""
    named = machine("invariode", "numpy", "scipy", "scikit-sundae")
    lead = f"{named}. Errors are the largest weighted ones over the interval; rtol = {SHOWN:.0e}."
    second = f"Not stiff: errors of the final state; rtol = {SHOWN:.0e}, atol a thousandth of it."
    return "\n\n".join([lead, *stiff_report(repetitions), second, *orbit_report(repetitions)])


if __name__ == "__main__":
    run("multistep", __doc__, report, repetitions=5)
