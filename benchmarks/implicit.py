"""The implicit methods on the stiff problems: ``python benchmarks/implicit.py [--write]``, or ``make bench``.

Errors in units of rtol, evaluations of f and factorisations, with the same analytic Jacobian for all; and what error
control between the steps costs the methods that have it. But for the ratios of times, the tables are the same on every
machine. ``--write`` puts them into docs/benchmarks.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import process_time
from typing import Any

import scipy.integrate
from measure import interleaved, machine, ratio, run, table

import invariode as iv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from stiff import PROBLEMS, StiffProblem

OURS = [name for name, about in iv.METHODS.items() if "jac" in about.options and "prefer" not in about.options]
TESTED = ("radau", "ode23t", "ode23tb")  # they test their continuous extensions where these are used
RTOLS = (1e-4, 1e-6, 1e-8, 1e-10)
TIGHTEST_OF_ORDER_2 = 1e-6  # formulas of order 2 take steps of about rtol^(1/3): below, far too many


def solved(method: str, p: StiffProblem, rtol: float) -> str:
    """Error in units of rtol, f and factorisations."""
    about: dict[str, Any] = {"t_eval": p.times, "rtol": rtol, "atol": rtol * p.scale, "jac": p.jac}
    if method in iv.METHODS:
        if iv.METHODS[method].order == 2 and rtol < TIGHTEST_OF_ORDER_2:
            return "–"
        sol: Any = iv.solve_ivp(p.fun, p.t_span, p.y0, method, args=p.args, lband=p.lband, uband=p.uband, **about)
    elif p.lband is not None:  # SciPy's has no banded matrices
        return "–"
    else:
        sol = scipy.integrate.solve_ivp(p.fun, p.t_span, p.y0, method, args=p.args or None, **about)
    calls = sol.nfev + (sol.stats.nfev_check if method in iv.METHODS else 0)
    return f"{p.error(sol.y) / rtol:.2g}, {calls}, {sol.nlu}" if sol.success else "fails"


def with_output(method: str, p: StiffProblem, rtol: float, repetitions: int) -> str:
    """Steps and f without and with output between steps, and the ratio of the times."""
    if iv.METHODS[method].order == 2 and rtol < TIGHTEST_OF_ORDER_2:
        return "–"

    def solve(times: Any) -> iv.Solution:
        about: dict[str, Any] = {"rtol": rtol, "atol": rtol * p.scale, "jac": p.jac, "t_eval": times}
        return iv.solve_ivp(p.fun, p.t_span, p.y0, method, args=p.args, lband=p.lband, uband=p.uband, **about)

    plain, full = solve(p.t_span), solve(p.times)
    runs = {"plain": lambda: solve(p.t_span), "full": lambda: solve(p.times)}
    times = interleaved(runs, repetitions, process_time)
    steps, calls = f"{plain.stats.steps} → {full.stats.steps}", f"{plain.nfev} → {full.nfev}"
    return f"{steps}, {calls}, {ratio(times['full'], times['plain']):.2f}"


def report(repetitions: int) -> str:
    """The tables of all problems but the largest."""
    small = [p for p in PROBLEMS.values() if p.jac_sparsity is None]
    header = ["problem", "rtol", *OURS, "SciPy Radau"]
    rows = [[p.name, f"{rtol:.0e}", *(solved(m, p, rtol) for m in (*OURS, "Radau"))] for p in small for rtol in RTOLS]
    costs = [
        [p.name, f"{rtol:.0e}", *(with_output(m, p, rtol, repetitions) for m in TESTED)]
        for p in small
        for rtol in RTOLS[:-1]
    ]
    about = (
        f"{machine('invariode', 'numpy')}. Steps and evaluations of f without and with output between steps (20 to 40 "
        "times), and the ratio of the times of the processor:"
    )
    return f"{table(header, rows)}\n\n{about}\n\n{table(['problem', 'rtol', *TESTED], costs)}"


if __name__ == "__main__":
    run("implicit", __doc__, report, repetitions=5)
