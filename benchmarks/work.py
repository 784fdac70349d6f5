"""Stiff problems, all implicit methods and their peers, work against error: ``python benchmarks/work.py [--write]``.

f and its Jacobian are Python functions, the same for all. Times are those of the processor, so that other processes
disturb them little. A run that takes longer than `LONGEST` is stopped, and tighter tolerances are not tried.
"""

from __future__ import annotations

import gc
import signal
import sys
import warnings
from collections.abc import Mapping
from time import process_time
from typing import Any

import numpy as np
from measure import folded, machine, run, table
from multistep import Line, Outcome, Solve, stiff_contestants
from test_set import PROBLEMS as MORE

import invariode as iv
from stiff import PROBLEMS as STIFF
from stiff import StiffProblem

OWN = ("ode15s", "ode23s", "ode23t", "ode23tb", "radau")
PROBLEMS = ("Robertson", "HIRES", "Oregonator", "van der Pol, mu = 1e3", "van der Pol, eps = 1e-12", "pollution", *MORE)
RTOLS = tuple(10.0**-k for k in range(4, 11))
TIGHTEST_OF_ORDER_2 = 1e-6
TIGHT = 1e-8  # from here on errors of radau are to stay within WITHIN rtol
WITHIN = 20
LONGEST = 5.0  # seconds
ENOUGH = 0.1  # seconds: a multiple of the ticks in which the clock of the processor may count
EQUAL = (1e-3, 1e-5, 1e-7, 1e-8)  # errors at which times are compared; "below 1e-7" is the last


class TooLongError(Exception):
    """A run has used its time."""


def stop(*_: Any) -> None:
    raise TooLongError


def timed(solve: Solve, rtol: float) -> tuple[Outcome, float] | None:
    """The outcome and the mean time of runs that fill `ENOUGH`; None if one is too long, or there is no solution."""
    signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, LONGEST)
    try:
        start = process_time()
        outcome, count = solve(rtol), 1
        while (elapsed := process_time() - start) < ENOUGH and np.isfinite(outcome.error):
            solve(rtol)
            count += 1
    except Exception:  # however a peer reports that its function has raised
        return None
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    return (outcome, elapsed / count) if np.isfinite(outcome.error) else None


def line(name: str, solve: Solve) -> Line:
    """What the contestant does at each tolerance, as far as its time allows."""
    outcomes, seconds = [], []
    for rtol in RTOLS:
        if name in iv.METHODS and iv.METHODS[name].order == 2 and rtol < TIGHTEST_OF_ORDER_2:
            break
        found = timed(solve, rtol)
        if found is None:
            break
        outcomes.append(found[0])
        seconds.append(found[1])
    return Line(outcomes, seconds)


def problem(name: str) -> StiffProblem:
    return STIFF[name] if name in STIFF else MORE[name]


def measured() -> dict[str, dict[str, Line]]:
    """The lines of all contestants, by problem."""
    found = {}
    for name in PROBLEMS:
        contestants = stiff_contestants(problem(name), {own: own for own in OWN})
        gc.collect()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # peers warn where they give up
            found[name] = {who: line(who, solve) for who, solve in contestants.items()}
        print(f"{name} done", file=sys.stderr)
    return found


def at_equal_error(lines: Mapping[str, Mapping[str, Line]]) -> str:
    """Milliseconds at equal error; the shortest in bold."""
    names = list(dict.fromkeys(who for each in lines.values() for who in each))
    rows = []
    for name, each in lines.items():
        for error in EQUAL:
            times = {who: each[who].at_error(error) if who in each else None for who in names}
            best = min((time for time in times.values() if time is not None), default=None)
            cells = [shown(time, best) for time in times.values()]
            rows.append([name, f"{error:.0e}", *cells])
    return table(["problem", "error", *names], rows)


def shown(time: float | None, best: float | None) -> str:
    if time is None:
        return "–"
    text = f"{1e3 * time:.3g}"
    return f"**{text}**" if time == best else text


def fastest(lines: Mapping[str, Mapping[str, Line]]) -> list[str]:
    """Problems on which nobody reaches the smallest error of those compared sooner than radau."""
    found = []
    for name, each in lines.items():
        times = {who: time for who, one in each.items() if (time := one.at_error(EQUAL[-1])) is not None}
        if times and min(times, key=lambda who: times[who]) == "radau":
            found.append(name)
    return found


def figures(lines: Mapping[str, Mapping[str, Line]]) -> str:
    """The two figures that were asked of radau."""
    worst = {}
    for name, each in lines.items():
        outcomes = each["radau"].outcomes
        ratios = [o.error / rtol for o, rtol in zip(outcomes, RTOLS, strict=False) if rtol <= 1.5 * TIGHT]
        worst[name] = max(ratios, default=None)
    within = [name for name, value in worst.items() if value is not None and value <= WITHIN]
    first = fastest(lines)
    rows = [
        [name, "too long" if value is None else f"{value:.2g}", "yes" if name in first else "no"]
        for name, value in worst.items()
    ]
    header = ["problem", f"largest error ÷ rtol from {TIGHT:.0e} on", f"fastest at an error of {EQUAL[-1]:.0e}"]
    asked = (
        f"Asked of radau: errors within {WITHIN} rtol from {TIGHT:.0e} on throughout; the fastest of all below 1e-7 on "
        f"at least nine. Found: {len(within)} of {len(worst)}, and the fastest on {len(first)}."
    )
    return f"{asked}\n\n{table(header, rows)}"


def each_run(name: str, each: Mapping[str, Line]) -> str:
    """Error in units of rtol, f, factorisations and milliseconds."""

    def cell(one: Line, k: int) -> str:
        if k >= len(one.outcomes):
            return "–"
        o = one.outcomes[k]
        work = f"{o.f}, {'–' if o.factorizations is None else o.factorizations}"
        return f"{o.error / RTOLS[k]:.2g}, {work}, {1e3 * one.seconds[k]:.3g}"

    rows = [[f"{rtol:.0e}", *(cell(one, k) for one in each.values())] for k, rtol in enumerate(RTOLS)]
    return table([f"{name}: rtol", *each], rows)


def report(_: int) -> str:
    """All tables."""
    lines = measured()
    lead = f"{machine('invariode', 'numpy', 'scipy', 'scikit-sundae')}. Milliseconds of the processor at equal error:"
    summary = "Each problem and tolerance: error ÷ rtol, evaluations of f, LU factorisations, ms"
    details = folded(summary, *(each_run(name, each) for name, each in lines.items()))
    return "\n\n".join([lead, at_equal_error(lines), figures(lines), details])


if __name__ == "__main__":
    run("work", __doc__, report, repetitions=1)
