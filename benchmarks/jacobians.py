"""Jacobians that are computed: ``python benchmarks/jacobians.py [--write] [--repetitions N]``, or ``make bench``.

On the stiff problems: differences and complex steps, for Python functions and compiled ones, and on the largest one the
given sparsity pattern and the detected one. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from measure import Times, interleaved, machine, ratio, run, table

import invariode as iv
from invariode import problems

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from stiff import PROBLEMS, StiffProblem

RTOL = 1e-5
METHODS = ("ode15s", "ode23s", "radau")
WAYS = ("differences", "complex-step")
COMPILED = {"Robertson": problems.robertson().fun, "HIRES": problems.hires().fun}
LARGEST = PROBLEMS["Brusselator, 2-D"]


def solve(p: StiffProblem, method: str, fun: Any, **given: Any) -> Any:
    """The final state of a problem that has been solved."""
    options: dict[str, Any] = {"rtol": RTOL, "atol": RTOL * p.scale, "keep": "end", **given}
    sol = iv.solve_ivp(fun, p.t_span, p.y0, method, args=p.args, lband=p.lband, uband=p.uband, **options)
    if not sol.success:
        raise SystemExit(f"{p.name}: {sol.message}")
    return sol


def row(p: StiffProblem, method: str, fun: Any, label: str, repetitions: int) -> list[str]:
    """Steps and evaluations of f with the one and the other, and their times."""
    sols = [solve(p, method, fun, jac=jac) for jac in WAYS]
    times = interleaved({jac: partial(solve, p, method, fun, jac=jac) for jac in WAYS}, repetitions)
    counts = [f"{s.stats.steps} + {s.stats.failed}, {s.nfev}, {s.njev}" for s in sols]
    return [p.name, method, label, *counts, *_compared(times)]


def _compared(times: Times) -> list[str]:
    first, second = (times[way] for way in WAYS)
    return [f"{1e3 * median(first):.3g}", f"{ratio(second, first):.2f}"]


def ways(repetitions: int) -> str:
    """Differences against complex steps."""
    header = [
        "problem",
        "method",
        "f",
        *(f"{way}: steps + failed, f, J" for way in WAYS),
        "ms",
        "complex ÷ differences",
    ]
    rows = []
    for p in PROBLEMS.values():
        if p is LARGEST or p.args == (1e-12,):
            continue
        forms = {"Python": p.fun} | ({"compiled": iv.compile(COMPILED[p.name])} if p.name in COMPILED else {})
        rows += [row(p, method, fun, label, repetitions) for method in METHODS for label, fun in forms.items()]
    return table(header, rows)


def patterns(repetitions: int) -> str:
    """The pattern of the largest problem, given and detected."""
    p = LARGEST
    true = p.jac(0.0, p.y0 + p.scale)
    true.eliminate_zeros()
    forms: dict[str, dict[str, Any]] = {"given": {"jac_sparsity": true != 0}, "detected": {}}
    sols = {label: solve(p, "ode15s", p.fun, **given) for label, given in forms.items()}
    times = interleaved(
        {label: partial(solve, p, "ode15s", p.fun, **given) for label, given in forms.items()}, repetitions
    )
    rows = [
        [
            f"{p.name}, n = {len(p.y0)}",
            label,
            f"{s.stats.steps}, {s.nfev}, {s.njev}",
            str(s.stats.jacobian),
            f"{median(times[label]):.3g}",
        ]
        for label, s in sols.items()
    ]
    told = f"The detected pattern takes {ratio(times['detected'], times['given']):.2f} times the time of the given one."
    return table(["problem", "pattern", "steps, f, J", "`stats.jacobian`", "s"], rows) + f"\n\n{told}"


def report(repetitions: int) -> str:
    """Both tables."""
    head = f"{machine('numpy', 'scipy', 'numba')}. rtol = {RTOL:.0e}, medians of {repetitions}."
    return "\n\n".join([head, ways(repetitions), patterns(max(repetitions // 2, 1))])


if __name__ == "__main__":
    run("jacobians", __doc__, report, repetitions=7)
