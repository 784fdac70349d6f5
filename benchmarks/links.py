"""What a chain of N links costs: ``python benchmarks/links.py``, with Python functions and compiled ones.

The CPU time of a call of f, and of a whole step of ode45 with its corrections in levels, in microseconds. ``--write``
puts the table into docs/benchmarks.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from measure import machine, run, table

import invariode as iv

LINKS = (10, 30, 100, 300, 1000)


def gravity(t: float, q: Any, v: Any) -> Any:
    force = np.zeros(len(q))
    force[1::2] = -1.0
    return force


def lengths(t: float, q: Any) -> Any:
    """Of the links, squared, less 1; the chain hangs at the origin."""
    x, y = q[0::2], q[1::2]
    dx, dy = x.copy(), y.copy()
    dx[1:] -= x[:-1]
    dy[1:] -= y[:-1]
    return dx * dx + dy * dy - 1


def seconds(act: Callable[[], Any], calls: int, repetitions: int) -> float:
    """The median of the time per call."""
    times = []
    for _ in range(repetitions):
        start = process_time()
        for _ in range(calls):
            act()
        times.append((process_time() - start) / calls)
    return median(times)


def costs(links: int, functions: tuple[Any, Any], repetitions: int) -> tuple[float, float]:
    """Microseconds of a call of f, and of a step."""
    force, constraints = functions
    q0 = np.column_stack([np.arange(1, links + 1.0), np.zeros(links)]).ravel()
    system = iv.MechanicalSystem(np.ones(2 * links), force, constraints)
    problem = system.problem((0, 1), q0, np.zeros(2 * links))
    steps = problem.solve("ode45", max_step=0.02, keep="end").stats.steps
    whole = seconds(lambda: problem.solve("ode45", max_step=0.02, keep="end"), 1, repetitions)
    return 1e6 * seconds(lambda: problem.fun(0.0, problem.y0), 20, repetitions), 1e6 * whole / steps


def report(repetitions: int) -> str:
    compiled = iv.compile(gravity), iv.compile(lengths)
    rows = []
    for count in LINKS:
        both = [cost for functions in ((gravity, lengths), compiled) for cost in costs(count, functions, repetitions)]
        rows.append([str(count), *(f"{cost:.0f}" for cost in both)])
    header = ["links", "f, µs", "a step, µs", "f compiled, µs", "a step, µs"]
    return f"{machine('invariode', 'numpy', 'numba')}. CPU time, medians of {repetitions}.\n\n{table(header, rows)}"


if __name__ == "__main__":
    run("links", __doc__, report, repetitions=7)
