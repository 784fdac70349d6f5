"""What a chain of N links costs: ``python benchmarks/chains.py [links ...]``, with Python functions and compiled ones.

The time of a call of f, and of a whole step of ode45 with its corrections in levels, in microseconds.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from measure import machine

import invariode as iv

LINKS = (10, 30, 100, 300, 1000)
REPETITIONS = 7


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


def seconds(act: Callable[[], Any], calls: int) -> float:
    """The median of the time per call."""
    times = []
    for _ in range(REPETITIONS):
        start = perf_counter()
        for _ in range(calls):
            act()
        times.append((perf_counter() - start) / calls)
    return median(times)


def costs(links: int, functions: tuple[Any, Any]) -> tuple[float, float]:
    force, constraints = functions
    q0 = np.column_stack([np.arange(1, links + 1.0), np.zeros(links)]).ravel()
    system = iv.MechanicalSystem(np.ones(2 * links), force, constraints)
    problem = system.problem((0, 1), q0, np.zeros(2 * links))
    start = perf_counter()
    sol = problem.solve("ode45", max_step=0.02, keep="end")
    step = (perf_counter() - start) / sol.stats.steps
    return seconds(lambda: problem.fun(0.0, problem.y0), 20), step


def main(links: list[int]) -> None:
    print(machine())
    print(f"{'links':>6} {'f':>9} {'step':>9} {'f, compiled':>12} {'step':>9}")
    compiled = iv.compile(gravity), iv.compile(lengths)
    for count in links:
        both = [cost for functions in ((gravity, lengths), compiled) for cost in costs(count, functions)]
        print(
            f"{count:6} {1e6 * both[0]:9.0f} {1e6 * both[1]:9.0f} {1e6 * both[2]:12.0f} {1e6 * both[3]:9.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]] or list(LINKS))
