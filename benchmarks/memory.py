"""Memory of a solve in vectors of n: ``python benchmarks/memory.py [--write]``.

The Brusselator on a line (`banded.cpp`, half-bandwidth 2), n = 1,000,000, the final state only: the growth of resident
memory during the solve, each in a process of its own, in vectors of n doubles. The initial value exists before.
``--write`` puts the table into docs/benchmarks/large.md.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from measure import growth, in_fresh_process, machine, run, table

import invariode as iv
from native import build, user_function

N = 10**6
SPANS = {"ode45": 0.5, "ode113": 0.5, "ode15s": 1.0, "radau": 1.0}
BANDED = ("ode15s", "radau")


def start(n: int) -> Any:
    """A wave over the constant ends, u and v in turn."""
    return np.column_stack([1 + np.sin(2 * np.pi * np.linspace(0, 1, n // 2)), np.full(n // 2, 3.0)]).ravel()


def memory_of(method: str) -> None:
    f, y0 = user_function(build("banded.cpp"), "brusselator_f"), start(N)
    bands = {"lband": 2, "uband": 2} if method in BANDED else {}

    def solve(y: Any, **options: Any) -> Any:
        return iv.solve_ivp(f, (0, SPANS[method]), y, method, args=(len(y) / 2, 1.0), keep="end", **bands, **options)

    solve(start(1000))  # imports, and what a process needs once
    steps = []
    grown = growth(lambda: steps.append(solve(y0).stats.steps))
    print(grown / 8 / N, steps[0])


def report(repetitions: int) -> str:
    rows = []
    for method in SPANS:
        grown, steps = in_fresh_process(__file__, method).split()
        rows.append([f"{method}, banded" if method in BANDED else method, steps, f"{float(grown):.0f}"])
    lines = table([f"n = {N:,}", "steps", "growth, vectors"], rows)
    return f"{machine('invariode', 'numpy')}.\n\n{lines}"


if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1] in SPANS:
        memory_of(sys.argv[1])
    else:
        run("memory", __doc__, report, repetitions=1)
