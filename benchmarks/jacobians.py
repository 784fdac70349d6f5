"""Jacobians that are computed: ``python benchmarks/jacobians.py [--write] [--repetitions N]``, or ``make bench``.

On the stiff problems: differences, complex steps and traces of Python functions, whose time includes tracing, but not
the compilation of the first; and on the largest one the given sparsity pattern and the detected one. ``--write`` puts
the tables into docs/benchmarks.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

from measure import Times, interleaved, machine, ratio, run, table

import invariode as iv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from stiff import PROBLEMS, StiffProblem

RTOL = 1e-5
METHODS = ("ode15s", "ode23s", "radau")
SOLVES = 5  # timed together
WAYS = ("differences", "complex-step", "trace")
LARGEST = PROBLEMS["Brusselator, 2-D"]


def solve(p: StiffProblem, method: str, fun: Any, **given: Any) -> Any:
    """The final state of a problem that has been solved."""
    options: dict[str, Any] = {"rtol": RTOL, "atol": RTOL * p.scale, "keep": "end", **given}
    sol = iv.solve_ivp(fun, p.t_span, p.y0, method, args=p.args, lband=p.lband, uband=p.uband, **options)
    if not sol.success:
        raise SystemExit(f"{p.name}: {sol.message}")
    return sol


def several(p: StiffProblem, method: str, fun: Any, jac: str) -> None:
    """The same solve again and again, so that none is the first after a pause."""
    for _ in range(SOLVES):
        solve(p, method, fun, jac=jac)


def row(p: StiffProblem, method: str, repetitions: int) -> list[str]:
    """Steps and evaluations of f each way, and their times."""
    sols = [solve(p, method, p.fun, jac=jac) for jac in WAYS]
    times = interleaved({jac: partial(several, p, method, p.fun, jac) for jac in WAYS}, repetitions, process_time)
    counts = [f"{s.stats.steps} + {s.stats.failed}, {s.nfev}, {s.njev}" for s in sols]
    return [p.name, method, *counts, *_compared(times)]


def _compared(times: Times) -> list[str]:
    first, *others = (times[way] for way in WAYS)
    return [f"{1e3 * median(first) / SOLVES:.3g}", *(f"{ratio(one, first):.2f}" for one in others)]


def ways(repetitions: int) -> str:
    """Differences against complex steps and traces."""
    header = [
        "problem",
        "method",
        *(f"{way}: steps + failed, f, J" for way in WAYS),
        "ms",
        *(f"{way} ÷ differences" for way in WAYS[1:]),
    ]
    rows = []
    for p in PROBLEMS.values():
        if p is LARGEST or p.args == (1e-12,):
            continue
        rows += [row(p, method, repetitions) for method in METHODS]
    return table(header, rows)


def patterns(repetitions: int) -> str:
    """The pattern of the largest problem, given and detected."""
    p = LARGEST
    true = p.jac(0.0, p.y0 + p.scale)
    true.eliminate_zeros()
    forms: dict[str, dict[str, Any]] = {"given": {"jac_sparsity": true != 0}, "detected": {}}
    sols = {label: solve(p, "ode15s", p.fun, **given) for label, given in forms.items()}
    times = interleaved(
        {label: partial(solve, p, "ode15s", p.fun, **given) for label, given in forms.items()},
        repetitions,
        process_time,
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
    head = f"{machine('numpy', 'scipy', 'numba')}. rtol = {RTOL:.0e}, CPU times, medians of {repetitions}."
    return "\n\n".join([head, ways(repetitions), patterns(max(repetitions // 2, 1))])


if __name__ == "__main__":
    run("jacobians", __doc__, report, repetitions=7)
