"""Compiled stiff problems beside numbalsoda's LSODA: ``python benchmarks/loose.py [--write] [--repetitions N]``.

The same f, by `invariode.compile` and by numba, over the same interval, without output in between; our solvers are
prepared. Errors are those of the state at the end, against radau at 1e-11: |y - z| / max(|z|, 1e-3), the largest over
the components. numbalsoda needs a Fortran compiler (``pip install numbalsoda``), and is no part of ``make bench``.
``--write`` puts the table into docs/benchmarks.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, NamedTuple

import numba
import numpy as np
from measure import interleaved, machine, ratio, run, table
from numbalsoda import lsoda, lsoda_sig  # type: ignore[import-untyped]  # it ships no types

import invariode as iv

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from stiff import PROBLEMS

METHODS = ("ode15s", "auto", "radau")
TOLERANCES = (1e-3, 1e-5)
LINKS = 20
RATES = np.logspace(0, 4, LINKS)
#: Solves that are timed together.
TOGETHER = 20


class Case(NamedTuple):
    name: str
    fun: Callable[..., Any]  # f(t, y, out)
    end: float
    y0: Sequence[float]


def oregonator(t: Any, y: Any, out: Any) -> None:
    out[0] = 77.27 * (y[1] + y[0] * (1.0 - 8.375e-6 * y[0] - y[1]))
    out[1] = (y[2] - (1.0 + y[0]) * y[1]) / 77.27
    out[2] = 0.161 * (y[0] - y[2])


def hires(t: Any, y: Any, out: Any) -> None:
    fast = 280.0 * y[5] * y[7]
    out[0] = -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007
    out[1] = 1.71 * y[0] - 8.75 * y[1]
    out[2] = -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4]
    out[3] = 8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3]
    out[4] = -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6]
    out[5] = -fast + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6]
    out[6] = fast - 1.81 * y[6]
    out[7] = -fast + 1.81 * y[6]


def chain(t: Any, y: Any, out: Any) -> None:
    """Each component follows the one before, at rates from 1 to 1e4."""
    before = 1.0
    for i in range(LINKS):
        out[i] = RATES[i] * (before - y[i] - 0.5 * y[i] * y[i])
        before = y[i]


#: numba cannot unpack y, as the tests' functions do, so f is written anew and compared with theirs.
CASES = [
    *(
        Case(name, fun, PROBLEMS[name].t_span[1], PROBLEMS[name].y0)
        for name, fun in (("Oregonator", oregonator), ("HIRES", hires))
    ),
    Case(f"chain of {LINKS}", chain, 10.0, [0.0] * LINKS),
]


def by_lsoda(case: Case, rtol: float) -> Callable[[], Any]:
    fun, n = numba.njit(case.fun), len(case.y0)

    @numba.cfunc(lsoda_sig)
    def entry(t: Any, y: Any, out: Any, _data: Any) -> None:
        fun(t, numba.carray(y, (n,)), numba.carray(out, (n,)))

    y0, times = np.array(case.y0), np.array([0.0, case.end])
    return lambda _code=entry: lsoda(entry.address, y0, times, rtol=rtol, atol=1e-3 * rtol)[0][-1]


def by_invariode(case: Case, method: Any, rtol: float) -> Callable[[], Any]:
    problem = iv.Problem(iv.compile(case.fun, inplace=True), (0.0, case.end), case.y0)
    solver = problem.prepare(method, rtol=rtol, atol=1e-3 * rtol, keep="end")
    return lambda: solver().y[:, -1]


def rows(case: Case, repetitions: int) -> list[list[str]]:
    exact, made = by_invariode(case, "radau", 1e-11)(), []
    for rtol in TOLERANCES:
        solvers = {method: by_invariode(case, method, rtol) for method in METHODS} | {"LSODA": by_lsoda(case, rtol)}
        several = {name: partial(_repeated, solve) for name, solve in solvers.items()}
        times = interleaved(several, repetitions, process_time)
        errors = {
            name: np.max(np.abs(solve() - exact) / np.maximum(np.abs(exact), 1e-3)) for name, solve in solvers.items()
        }
        cells = [f"{ratio(times[name], times['LSODA']):.2f} ({errors[name]:.0e})" for name in METHODS]
        own = f"{1e6 * median(times['LSODA']) / TOGETHER:.0f} ({errors['LSODA']:.0e})"
        made.append([case.name, f"{rtol:.0e}", own, *cells])
    return made


def _repeated(solve: Callable[[], Any]) -> None:
    for _ in range(TOGETHER):
        solve()


def report(repetitions: int) -> str:
    for case in CASES[:2]:
        own = np.empty(len(case.y0))
        case.fun(0.0, case.y0, own)
        np.testing.assert_allclose(own, PROBLEMS[case.name].fun(0.0, case.y0), rtol=1e-12)
    header = ["problem", "rtol", "LSODA, µs", *(f"{method} / LSODA" for method in METHODS)]
    found = [row for case in CASES for row in rows(case, repetitions)]
    return f"{machine('invariode', 'numbalsoda', 'numba')}. In brackets: the error.\n\n{table(header, found)}"


if __name__ == "__main__":
    run("loose", __doc__, report, repetitions=31)
