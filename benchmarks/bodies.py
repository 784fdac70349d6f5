"""Ten bodies, whose force is a power of the distance: ``python benchmarks/bodies.py [--write] [--repetitions N]``.

n = 60, compiled f, dop853 at rtol = atol = 1e-9 from t = 0 to 5, against CyRK's DOP853 with the same f by numba and the
same tolerances, final states only. The process's CPU clock, in turn. The power is written as x**-1.5 and by √ and ÷.
``--write`` puts the table into docs/benchmarks/native.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from statistics import median
from time import process_time
from typing import Any

import numba
import numpy as np
from measure import interleaved, machine, ratio, run, table

import invariode as iv

BODIES, END, TOLERANCE, AGREE = 10, 5.0, 1e-9, 1e-5
MS = 1e-3


def made(pull: Callable[[Any], Any], jitted: Callable[[Any], Any]) -> Callable[..., Any]:
    """The accelerations of bodies of equal masses, by a function of the square of the distance."""
    law = jitted(pull)

    def bodies(t: float, y: Any, out: Any) -> None:
        for i in range(3 * BODIES):
            out[i] = y[3 * BODIES + i]
            out[3 * BODIES + i] = 0.0
        for i in range(BODIES):
            for j in range(i):
                dx, dy, dz = y[3 * j] - y[3 * i], y[3 * j + 1] - y[3 * i + 1], y[3 * j + 2] - y[3 * i + 2]
                w = 0.1 * law(dx * dx + dy * dy + dz * dz + 0.01)
                a, b = 3 * BODIES + 3 * i, 3 * BODIES + 3 * j
                out[a] += w * dx
                out[a + 1] += w * dy
                out[a + 2] += w * dz
                out[b] -= w * dx
                out[b + 1] -= w * dy
                out[b + 2] -= w * dz

    return bodies


def power(r2: Any) -> Any:
    return r2**-1.5


def root(r2: Any) -> Any:
    return 1.0 / (r2 * math.sqrt(r2))


def start() -> Any:
    random = np.random.default_rng(3)
    return np.concatenate([random.uniform(-1, 1, 3 * BODIES), random.uniform(-0.3, 0.3, 3 * BODIES)])


def by_cyrk(fun: Callable[..., Any], y0: Any, end: float, tolerance: float) -> Callable[[], Any]:
    """Return CyRK's solve by DOP853, to y at the end, of f that fills its last argument and that numba compiles."""
    from CyRK import nbsolve_ivp

    filling = numba.njit(fun)

    @numba.njit
    def returning(t: float, y: Any) -> Any:
        out = np.empty_like(y)
        filling(t, y, out)
        return out

    options = {"rk_method": 2, "rtol": tolerance, "atol": tolerance, "warnings": False}
    return lambda: nbsolve_ivp(returning, (0.0, end), y0, **options).y[:, -1]


def by_invariode(pull: Callable[[Any], Any], y0: Any) -> Callable[[], Any]:
    fun = iv.compile(made(pull, lambda one: one), inplace=True)
    options = {"rtol": TOLERANCE, "atol": TOLERANCE, "keep": "end"}
    return lambda: iv.solve_ivp(fun, (0.0, END), y0, "dop853", **options).y[:, -1]


def report(repetitions: int) -> str:
    y0, rows = start(), []
    for name, pull in {"x**-1.5": power, "1 / (x √x)": root}.items():
        runs = {"invariode": by_invariode(pull, y0), "CyRK": by_cyrk(made(pull, numba.njit), y0, END, TOLERANCE)}
        ends = [solve() for solve in runs.values()]
        if not np.allclose(*ends, rtol=AGREE, atol=AGREE):
            raise SystemExit(f"not timed: the final states by {name} differ")
        times = interleaved({who: partial(solve) for who, solve in runs.items()}, repetitions, process_time)
        own, other = (f"{median(times[who]) / MS:.2f}" for who in runs)
        rows.append([name, own, other, f"{ratio(times['invariode'], times['CyRK']):.2f}"])
    lines = table(["ten bodies", "dop853, ms", "CyRK DOP853, ms", "÷ CyRK"], rows)
    return f"{machine('invariode', 'numpy', 'numba', 'CyRK')}.\n\n{lines}"


if __name__ == "__main__":
    run("bodies", __doc__, report, repetitions=9)
