"""A stiff valve that opens and closes within steps: ``python benchmarks/valves.py [--write]``.

y₀' = cos t − q, y₁' = q − y₁ with the flow q = k max(0, y₀ − y₁): k from 1e3 to 1e7, two starts, seventeen tolerances
from 1e-2 to 1e-6, atol equal to rtol and a thousandth of it, Jacobians by differences. The reference is radau at 1e-10.
Nothing is timed.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from math import cos
from typing import Any

import numpy as np
import scipy.integrate
from measure import run, table

import invariode as iv

SPAN = (0.0, 10.0)
FAR = 100  # rtol
OURS = ("ode15s", "ode23t", "ode23tb", "radau", "auto")
SCIPYS = ("BDF", "LSODA")  # Radau takes minutes in some of these runs
STEPS = 20000

Fun = Callable[[float, Any], list[float]]


def valve(k: float) -> Fun:
    def f(t: float, y: Any) -> list[float]:
        flow = k * max(0.0, y[0] - y[1])
        return [cos(t) - flow, flow - y[1]]

    return f


def ours(method: str, f: Fun, start: float, rtol: float, atol: float) -> tuple[Any, int]:
    with warnings.catch_warnings():  # where the valve closes f looks as if it jumped
        warnings.simplefilter("ignore", iv.DiscontinuityWarning)
        sol = iv.solve_ivp(f, SPAN, [start, start], method, rtol=rtol, atol=atol, keep="end", max_steps=STEPS)
    return sol, sol.nfev + sol.stats.nfev_check


def scipys(method: str, f: Fun, start: float, rtol: float, atol: float) -> tuple[Any, int]:
    sol = scipy.integrate.solve_ivp(f, SPAN, [start, start], method, rtol=rtol, atol=atol)
    return sol, sol.nfev


def row(method: str, solve: Callable[..., tuple[Any, int]], count: int) -> list[str]:
    errors, calls = [], 0
    for k in (1e3, 1e4, 1e5, 1e6, 1e7):
        for start in (0.0, 1.0):
            exact = iv.solve_ivp(valve(k), SPAN, [start, start], "radau", rtol=1e-10, atol=1e-12, keep="end").y[:, -1]
            for rtol in np.geomspace(1e-2, 1e-6, count):
                for atol in (rtol, 1e-3 * rtol):
                    sol, nfev = solve(method, valve(k), start, float(rtol), float(atol))
                    errors.append(np.abs(sol.y[:, -1] - exact).max() / rtol if sol.success else np.inf)
                    calls += nfev
    found = np.array(errors)
    finished = found[np.isfinite(found)]
    counts = [len(found), len(found) - len(finished), int((finished > FAR).sum())]
    return [method, *map(str, counts), f"{np.median(finished):.2g}", f"{finished.max():.2g}", f"{calls / 1e6:.2f}"]


def report(count: int) -> str:
    rows = [row(method, ours, count) for method in OURS]
    rows += [row(f"SciPy {method}", lambda _, *about, name=method: scipys(name, *about), count) for method in SCIPYS]
    header = ["solver", "runs", "failed", f"more than {FAR} rtol off", "median error / rtol", "largest", "f, millions"]
    return table(header, rows)


if __name__ == "__main__":
    run("valves", __doc__, report, repetitions=17)
