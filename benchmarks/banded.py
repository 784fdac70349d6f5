"""ode15s against CVODE on a banded problem: ``python benchmarks/banded.py [--write]``, or ``make bench``.

The Brusselator of tests/stiff.py, 1000 components, five bands: with f in Python and the analytic Jacobian for both, and
with f in C++ and banded difference Jacobians for both. CVODE calls C++ by way of a Python function, since scikit-sundae
takes no others. Times are those of the process. ``--write`` puts the table into docs/benchmarks.
"""

from __future__ import annotations

import ctypes
from functools import partial
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from measure import interleaved, machine, run, table
from multistep import STIFF, Line
from stiff_contestants import CVODE, MOST_STEPS, Outcome, Solve, stiff_contestants

import invariode as iv
from native import DOUBLE, build, user_function

RTOLS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
ERRORS = (1e-3, 1e-4, 1e-5)
SHOWN = 1e-6
DIFFUSION = 501**2 / 50
ADDRESS = ctypes.c_void_p


def compiled() -> dict[str, Solve]:
    """Both solvers with f in C++."""
    p, library = STIFF["Brusselator"], build("banded.cpp")
    parameters = np.array([len(p.y0) / 2, DIFFUSION])
    code = library.brusselator_f
    code.restype, code.argtypes = None, (DOUBLE, ADDRESS, ADDRESS, ADDRESS)
    p_address = parameters.ctypes.data
    bands = {"lband": p.lband, "uband": p.uband}

    def ours(rtol: float) -> Outcome:
        f, args = user_function(library, "brusselator_f"), tuple(parameters)
        tolerances = {"rtol": rtol, "atol": rtol * p.scale}
        sol = iv.solve_ivp(f, p.t_span, p.y0, "ode15s", t_eval=p.times, args=args, **bands, **tolerances)
        return Outcome(p.error(sol.y), sol.nfev + sol.stats.nfev_check, sol.njev, sol.nlu)

    def sundials(rtol: float) -> Outcome:
        calls = 0

        def f(t: float, y: Any, slope: Any) -> None:
            nonlocal calls
            calls += 1
            code(t, y.ctypes.data, slope.ctypes.data, p_address)  # faster than typed pointers

        options = {"linsolver": "band", "max_num_steps": MOST_STEPS, **bands}
        solver = CVODE(f, rtol=rtol, atol=rtol * p.scale, **options)
        sol = solver.solve(np.concatenate([[p.t_span[0]], p.times]), p.y0)
        return Outcome(p.error(sol.y[1:].T), calls, sol.njev)

    return {"ode15s": ours, "CVODE": sundials}


def measure(contestants: dict[str, Solve], repetitions: int) -> dict[str, Line]:
    """All at all tolerances in turn."""
    runs = {f"{name} {rtol}": partial(solve, rtol) for rtol in RTOLS for name, solve in contestants.items()}
    outcomes = {name: solve() for name, solve in runs.items()}
    times = interleaved(runs, repetitions, process_time)
    return {
        name: Line([outcomes[f"{name} {r}"] for r in RTOLS], [median(times[f"{name} {r}"]) for r in RTOLS])
        for name in contestants
    }


def rows(what: str, lines: dict[str, Line]) -> list[list[str]]:
    k = RTOLS.index(SHOWN)
    ours, theirs = lines["ode15s"], lines["CVODE"]
    found = []
    for name, one in lines.items():
        outcome = one.outcomes[k]
        at = [one.at_error(error) for error in ERRORS]
        counts = [f"{outcome.error:.1e}", str(outcome.f), f"{1e3 * one.seconds[k]:.2f}"]
        found.append([what, name, *counts, *("–" if s is None else f"{1e3 * s:.2f}" for s in at)])
    pairs = [(ours.at_error(error), theirs.at_error(error)) for error in ERRORS]
    ratios = ["–" if a is None or b is None else f"{a / b:.2f}" for a, b in pairs]
    return [*found, [what, "ode15s ÷ CVODE", "", "", "", *ratios]]


def report(repetitions: int) -> str:
    known = stiff_contestants(STIFF["Brusselator"])
    python = {"ode15s": known["ode15s"], "CVODE": known["CVODE BDF"]}
    header = ["f", "solver", f"error at rtol = {SHOWN:.0e}", "f", "ms", *(f"ms at error {e:.0e}" for e in ERRORS)]
    lines = [*rows("Python", measure(python, repetitions)), *rows("C++", measure(compiled(), repetitions))]
    return f"{machine('invariode', 'numpy', 'scikit-sundae')}.\n\n{table(header, lines)}"


if __name__ == "__main__":
    run("banded", __doc__, report, repetitions=15)
