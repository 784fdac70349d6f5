"""The implicit methods on the stiff problems: ``python benchmarks/implicit.py [--write]``, or ``make bench``.

Errors in units of rtol, evaluations of f and factorisations, with the same analytic Jacobian for all; nothing is timed,
so the tables are the same on every machine. ``--write`` puts them into docs/benchmarks.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import scipy.integrate
from measure import run, table

import invariode as iv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from stiff import PROBLEMS, StiffProblem

OURS = [name for name, about in iv.METHODS.items() if "jac" in about.options and "prefer" not in about.options]
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


def report(_: int) -> str:
    """The table of all problems but the largest."""
    small = [p for p in PROBLEMS.values() if p.jac_sparsity is None]
    header = ["problem", "rtol", *OURS, "SciPy Radau"]
    rows = [[p.name, f"{rtol:.0e}", *(solved(m, p, rtol) for m in (*OURS, "Radau"))] for p in small for rtol in RTOLS]
    return table(header, rows)


if __name__ == "__main__":
    run("implicit", __doc__, report, repetitions=1)
