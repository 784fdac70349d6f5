"""Stiff problems, all implicit methods and their peers, work against error: ``python benchmarks/work.py [--write]``.

f and its Jacobian are Python functions, the same for all. Times are those of the processor, so that other processes
disturb them little. A run that takes longer than its problem allows is stopped, and tighter tolerances are not tried.
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
from multistep import Line
from stiff_contestants import Outcome, Solve, stiff_contestants

import invariode as iv
from stiff import PROBLEMS as STIFF
from stiff import StiffProblem
from stiff_ends import PROBLEMS as MORE

#: Options of solve_ivp, by the names in the tables. The first radau chooses among its orders.
OWN: Mapping[str, Mapping[str, Any]] = {
    **{name: {"method": name} for name in ("ode15s", "ode23s", "ode23t", "ode23tb", "radau")},
    "radau, order 5": {"method": "radau", "max_order": 5},
}
PROBLEMS = ("Robertson", "HIRES", "Oregonator", "van der Pol, mu = 1e3", "van der Pol, eps = 1e-12", "pollution", *MORE)
RTOLS = tuple(10.0**-k for k in range(3, 11))
#: Of a problem that takes seconds: every other one, and down to where multistep formulas have errors of 1e-8.
RTOLS_OF = {"ring modulator": tuple(10.0**-k for k in (5, 7, 9, 11, 12))}
TIGHTEST_OF_ORDER_2 = 1e-6
TIGHT, TIGHTEST = 1e-8, 1e-10  # from here to there errors of radau are to stay within WITHIN rtol
WITHIN = 20
LONGEST = 5.0  # seconds
LONGEST_OF = {"beam": 10.0, "ring modulator": 20.0}
ENOUGH = 0.1  # seconds: a multiple of the ticks in which the clock of the processor may count
EQUAL = (1e-3, 1e-5, 1e-7, 1e-8, 1e-9)  # errors at which times are compared
FASTEST = (1e-8, 1e-9)  # of these, "below 1e-7" is counted at the first


#: Of a run that ends before its time is over, but not at the end of the interval.
FAILED = Outcome(np.inf, 0)


class TooLongError(Exception):
    """A run has used its time."""


def stop(*_: Any) -> None:
    raise TooLongError


def timed(solve: Solve, rtol: float, longest: float) -> tuple[Outcome, float] | None:
    """The outcome and the mean time of runs that fill `ENOUGH`; None if one is too long."""
    signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, longest)
    start, count = process_time(), 1
    try:
        outcome = solve(rtol)
        while np.isfinite(outcome.error) and process_time() - start < ENOUGH:
            solve(rtol)
            count += 1
    except Exception:  # however a peer reports that its function has raised
        outcome = FAILED
    finally:
        left, _ = signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    return (outcome, (process_time() - start) / count) if left > 0 else None


def rtols(name: str) -> tuple[float, ...]:
    return RTOLS_OF.get(name, RTOLS)


def line(name: str, who: str, solve: Solve) -> Line:
    """What the contestant does at each tolerance, as far as its time allows."""
    crude = who in iv.METHODS and iv.METHODS[who].order == 2
    outcomes, seconds = [], []
    for rtol in rtols(name):
        found = None if crude and rtol < TIGHTEST_OF_ORDER_2 else timed(solve, rtol, LONGEST_OF.get(name, LONGEST))
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
        start = process_time()
        contestants = stiff_contestants(problem(name), OWN)
        gc.collect()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # peers warn where they give up
            found[name] = {who: line(name, who, solve) for who, solve in contestants.items()}
        print(f"{name}: {process_time() - start:.0f} s", file=sys.stderr)
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


def fastest(each: Mapping[str, Line], error: float) -> str:
    """Who reaches the error first."""
    times = {who: time for who, one in each.items() if (time := one.at_error(error)) is not None}
    return min(times, key=lambda who: times[who], default="–")


def figures(lines: Mapping[str, Mapping[str, Line]]) -> str:
    """The two figures that were asked of radau."""
    rows, within, first = [], 0, 0
    for name, each in lines.items():
        outcomes = zip(each["radau"].outcomes, rtols(name), strict=False)
        ratios = (o.error / rtol for o, rtol in outcomes if 0.9 * TIGHTEST <= rtol <= 1.1 * TIGHT)
        worst = max(ratios, default=np.inf)
        winners = [fastest(each, error) for error in FASTEST]
        within += worst <= WITHIN
        first += winners[0].startswith("radau")
        rows.append([name, f"{worst:.2g}" if np.isfinite(worst) else "too long", *winners])
    tight = f"{TIGHT:.0e} to {TIGHTEST:.0e}"
    header = ["problem", f"radau: largest error ÷ rtol, {tight}", *(f"fastest at {error:.0e}" for error in FASTEST)]
    asked = (
        f"Asked of radau: errors within {WITHIN} rtol from {tight}; the fastest of all below 1e-7 on at least nine. "
        f"Found: {within} of {len(rows)}, and the fastest on {first} at {FASTEST[0]:.0e}."
    )
    return f"{asked}\n\n{table(header, rows)}"


def each_run(name: str, each: Mapping[str, Line]) -> str:
    """Error in units of rtol, f, factorisations and milliseconds."""

    def cell(one: Line, k: int, rtol: float) -> str:
        if k >= len(one.outcomes):
            return "–"
        o = one.outcomes[k]
        if not np.isfinite(o.error):
            return "fails"
        work = f"{o.f}, {'–' if o.factorizations is None else o.factorizations}"
        return f"{o.error / rtol:.2g}, {work}, {1e3 * one.seconds[k]:.3g}"

    rows = [[f"{rtol:.0e}", *(cell(one, k, rtol) for one in each.values())] for k, rtol in enumerate(rtols(name))]
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
