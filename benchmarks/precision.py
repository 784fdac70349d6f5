"""What projection gains and costs on orbits: ``python benchmarks/precision.py [--write]``, or ``make bench``.

The error in position at the end of ten periods of Kepler's problem (e = 0.6) and of one period of the restricted
three-body orbit, by four codes of the MATLAB ODE Suite, plain and projected. ``--write`` puts the tables into
docs/benchmarks.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time

import numpy as np
from measure import folded, interleaved, machine, run, table

import invariode as iv
from invariode import problems

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from problems import PROBLEMS, TestProblem

RTOLS = tuple(10.0**-k for k in range(3, 11))
CODES = ("ode23", "ode45", "ode113", "ode15s")
SHOWN = "1e-06"  # the tolerance of the tables that are not folded
WAYS = {"plain": None, "projected": "always", "where needed": "needed"}


def solve(p: TestProblem, y0: list[float], tf: float, method: str, rtol: float, when: str | None) -> iv.Solution:
    invariants = None if when is None else iv.Invariants(p.g, p.jac, p.value, when=when)
    options = {"rtol": rtol, "atol": 1e-3 * rtol, "keep": "end"}
    return iv.solve_ivp(p.fun, (0, tf), y0, method, invariants=invariants, **options)


def compare(p: TestProblem, y0: list[float], tf: float, method: str, repetitions: int) -> list[list[str]]:
    """A line for each tolerance: errors, evaluations of f, milliseconds, each for all ways."""
    rows = []
    for rtol in RTOLS:
        runs = {way: partial(solve, p, y0, tf, method, rtol, when) for way, when in WAYS.items()}
        solutions = {way: run() for way, run in runs.items()}
        times = interleaved(runs, repetitions, process_time)
        errors = [f"{np.hypot(*(sol.y[:2, -1] - y0[:2])):.1e}" for sol in solutions.values()]
        counts = [str(sol.nfev) for sol in solutions.values()]
        rows.append([method, f"{rtol:.0e}", *errors, *counts, *(f"{1e3 * median(times[way]):.2f}" for way in WAYS)])
    return rows


def report(repetitions: int) -> str:
    orbits = {
        "Kepler, ten periods": (PROBLEMS["Kepler"], problems.kepler(0.6).y0.tolist(), 20 * np.pi),
        "Three bodies, one period": (PROBLEMS["three-body"], list(problems.START), problems.PERIOD),
    }
    about = "Invariants and Jacobians in Python, given; atol = rtol / 1000; milliseconds of the processor"
    parts = [f"{machine('invariode', 'numpy')}. {about}."]
    for title, (p, y0, tf) in orbits.items():
        rows = [row for method in CODES for row in compare(p, y0, tf, method, repetitions)]
        columns = [f"{what}: {way}" if way == "plain" else way for what in ("error", "f", "ms") for way in WAYS]
        shown = [row for row in rows if row[1] == SHOWN]
        header = [title, "rtol", *columns]
        parts += [table(header, shown), folded("Every tolerance", table(header, rows))]
    return "\n\n".join(parts)


if __name__ == "__main__":
    run("precision", __doc__, report, repetitions=5)
