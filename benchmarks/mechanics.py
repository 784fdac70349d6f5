"""What corrections in levels gain on mechanisms: ``python benchmarks/mechanics.py [--write]``, or ``make bench``.

Andrews' squeezing mechanism, Arévalo's problem, the paper's pendulum, chains: plain, projected jointly, projected in
levels, and on the squeezing mechanism with Baumgarte's stabilisation. ``--write`` puts the tables into
docs/benchmarks.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time

import numpy as np
from measure import folded, interleaved, machine, run, table

import invariode as iv

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from mechanisms import (
    Array,
    Case,
    arevalo,
    car_axis,
    closed_chain,
    fekete,
    index_3_pendulum,
    pendulum,
    slider_crank,
    spatial_chain,
    squeezer,
)

WAYS = ("none", "joint", "levels")
RTOLS = tuple(10.0**-k for k in range(4, 11))
METHODS = ("ode45", "dop853", "ode78", "ode113")
#: Between the tolerances of the tables, where one digit more or less is luck.
FINE = tuple(10 ** (-k / 2) for k in range(8, 21))
#: Baumgarte's α = β, in units of the inverse of the interval: of 1, 3, 10, ... 3000 the one after which ode45 pays more
#: evaluations for further digits. It has to be found by trial for every mechanism.
DAMPING = 10.0
#: The chains have no best α: the usual choice, of the size of the fastest motion (Wittenburg 1977, α = β = 5 … 50).
CHAIN_DAMPING = 5.0


CHAINS = {"planar, closed, 5 links": closed_chain(), "in space, 10 links": spatial_chain()}


def solve(case: Case, method: str, rtol: float, way: str) -> iv.Solution:
    problem = case.system.problem(case.t_span, case.q0, case.v0, correction=way)
    return problem.solve(method, rtol=rtol, atol=rtol, keep="end")


def stabilised(case: Case, method: str, rtol: float) -> iv.Solution:
    """φ'' + 2 α φ' + α² φ = 0 in place of φ'' = 0, after Baumgarte (1972)."""
    problem = damped(case, DAMPING / (case.t_span[1] - case.t_span[0]))
    return problem.solve(method, rtol=rtol, atol=rtol, keep="end")


def damped(case: Case, alpha: float) -> iv.Problem:
    """The problem with Baumgarte's stabilisation, and nothing imposed."""
    n = len(case.q0)
    problem = case.system.problem(case.t_span, case.q0, case.v0, correction="levels")
    position, rate = problem.invariants[:2]
    mass = case.system.mass

    def slope(t: float, y: Array) -> Array:
        derivative = np.array(problem.fun(t, y))
        rows = position.jac(t, y)[:, :n]
        wanted = -2 * alpha * rate.fun(t, y) - alpha**2 * position.fun(t, y)
        weighted = np.linalg.solve(mass(t, y[:n]), rows.T) if callable(mass) else rows.T / np.asarray(mass)[:, None]
        derivative[n:] += weighted @ np.linalg.solve(rows @ weighted, wanted)
        return derivative

    return problem.replace(fun=slope, invariants=None)


def digits(case: Case, sol: iv.Solution) -> float:
    """Of the positions: the reference is good to about ten."""
    n = len(case.q0)
    error = np.abs(sol.y[:n, -1] - case.end[:n]) / np.abs(case.end[:n])
    return float(-np.log10(error.max())) if sol.success else np.nan


def kept(found: dict[str, iv.Solution], way: str, go: Callable[[], iv.Solution]) -> None:
    found[way] = go()


def squeezing(repetitions: int) -> str:
    case, rows = squeezer(), []
    for method in METHODS:
        for rtol in RTOLS:
            found: dict[str, iv.Solution] = {}
            runs = {way: partial(kept, found, way, partial(solve, case, method, rtol, way)) for way in WAYS}
            times = interleaved(runs, repetitions, process_time)
            found["Baumgarte"] = stabilised(case, method, rtol)  # not timed: written here in Python, it solves twice
            rows.append(
                [
                    method,
                    f"{rtol:.0e}",
                    *(f"{digits(case, sol):.1f}" for sol in found.values()),
                    *(str(sol.nfev) for sol in found.values()),
                    *(f"{1e3 * median(times[way]):.0f}" for way in runs),
                ]
            )
    columns = [
        f"{what}: {way}" if way == "none" else way
        for what, ways in (("digits", (*WAYS, "Baumgarte")), ("f", (*WAYS, "Baumgarte")), ("ms", WAYS))
        for way in ways
    ]
    return folded("Every tolerance", table(["Andrews' squeezing mechanism", "rtol", *columns], rows))


def in_metric(problem: iv.Problem, metric: object) -> iv.Problem:
    """The problem, its corrections in levels with another metric; None: that of the error test."""
    held = [
        iv.Invariants(one.fun, one.jac, one.value, one.names, level=one.level, moves=one.moves, metric=metric)
        for one in problem.invariants
    ]
    return problem.replace(invariants=held)


def metrics() -> str:
    """Mean digits over tolerances, and the least gain over plain at one of them."""
    case, rows = squeezer(), []
    in_levels = case.system.problem(case.t_span, case.q0, case.v0)
    contestants = {
        "none": case.system.problem(case.t_span, case.q0, case.v0, correction="none"),
        "joint": case.system.problem(case.t_span, case.q0, case.v0, correction="joint"),
        "error test": in_metric(in_levels, None),
        "Euclidean": in_metric(in_levels, np.ones(len(case.q0))),
        "mass": in_levels,
    }
    for method in METHODS:
        found = {
            name: np.array([digits(case, problem.solve(method, rtol=rtol, atol=rtol, keep="end")) for rtol in FINE])
            for name, problem in contestants.items()
        }
        least = [(reached - found["none"]).min() for name, reached in found.items() if name != "none"]
        rows.append([method, *(f"{reached.mean():.2f}" for reached in found.values()), *(f"{x:+.1f}" for x in least)])
    names = list(contestants)
    return table(["metric of levels", *names, f"least gain: {names[1]}", *names[2:]], rows)


def worst(case: Case, sol: iv.Solution) -> list[str]:
    """The largest errors of positions, velocities and multipliers at the end, where they are known."""
    n = len(case.q0)
    off = np.abs(sol.y[:, -1] - case.end)
    found = [f"{part.max():.0e}" for part in (off[:n], off[n:])]
    if not case.multipliers.size:
        return [*found, "–"]
    return [*found, f"{np.abs(case.system.multipliers(sol)[:, -1] - case.multipliers).max():.0e}"]


def published() -> str:
    """Errors at the end against published values."""
    rows = []
    cases = {
        "car axis": (car_axis(), METHODS),
        "Arévalo": (arevalo(), METHODS),
        "index-3 pendulum": (index_3_pendulum(), METHODS),
        "Fekete": (fekete(), METHODS[:1]),
    }
    for name, (case, methods) in cases.items():
        for method in methods:
            for rtol in (1e-4, 1e-7, 1e-10):
                found = [solve(case, method, rtol, way) for way in WAYS]
                errors = [worst(case, sol) for sol in found]
                by_kind = [each[kind] for kind in range(3) for each in errors]
                rows.append([name, method, f"{rtol:.0e}", str(found[-1].nfev), *by_kind])
    columns = [way if way != "none" else f"{what}: none" for what in ("q", "v", "λ") for way in WAYS]
    return folded("Against published values", table(["errors at the end", "", "rtol", "f: levels", *columns], rows))


def crank() -> str:
    """Positions of SUNDIALS's slider crank beside its printed ones."""
    case = slider_crank()
    rows = [["IDA, printed", "1e-06", *(f"{x:.4e}" for x in case.end[:3])]]
    for rtol in (1e-4, 1e-6, 1e-8):
        sol = solve(case, "ode45", rtol, "levels")
        rows.append(["ode45", f"{rtol:.0e}", *(f"{x:.4e}" for x in sol.y[:3, -1])])
    return table(["slider crank, t = 10", "rtol", "crank", "slider", "rod"], rows)


def papers_pendulum() -> str:
    """Steps, failed attempts, evaluations, and the length of the rod, with ode45 at default tolerances."""
    case, rows = pendulum(), []
    for way in WAYS:
        problem = case.system.problem(case.t_span, case.q0, case.v0, correction=way)
        sol = problem.solve("ode45", refine=4, interpolation="raw")
        off = np.abs(sol.y[0] ** 2 + sol.y[1] ** 2 - 1).max()
        rows.append([way, str(sol.stats.steps), str(sol.stats.failed), str(sol.nfev), f"{off:.1e}"])
    return table(["The paper's pendulum, ode45", "steps", "failed", "f", "off by"], rows)


def closed_loop() -> str:
    """What is left of the constraints and of the energy over 60 s at 1e-6."""
    rows = []
    for name, case in CHAINS.items():
        for method in ("ode45", "ode113"):
            problems = {way: case.problem(way) for way in WAYS}
            problems["Baumgarte"] = damped(case, CHAIN_DAMPING)
            for way, problem in problems.items():
                sol = problem.solve(method, rtol=1e-6, atol=1e-6)
                rows.append([name, method, way, str(sol.stats.steps), str(sol.nfev), *drift(case, sol)])
    return table(["chain, 60 s, rtol 1e-6", "", "", "steps", "f", "φ", "φ̇", "energy"], rows)


def drift(case: Case, sol: iv.Solution) -> list[str]:
    """The largest residuals after steps: of lengths, of their rates, and the change of the energy."""
    n = len(case.q0)
    position, rate = case.problem().invariants[:2]
    lengths = max(np.abs(position.fun(t, y)).max() for t, y in zip(sol.t, sol.y.T, strict=True))
    rates = max(np.abs(rate.fun(t, y)).max() for t, y in zip(sol.t, sol.y.T, strict=True))
    energy = np.array([case.system.energy(t, y[:n], y[n:]) for t, y in zip(sol.t, sol.y.T, strict=True)])
    end = "" if sol.success else f", ends at t = {sol.t[-1]:.2g}"
    return [f"{lengths:.0e}", f"{rates:.0e}", f"{np.abs(energy - energy[0]).max():.0e}{end}"]


CALLS = 20  # of f, timed together


def several(function: Callable[[], object]) -> None:
    for _ in range(CALLS):
        function()


def report(repetitions: int) -> str:
    head = f"{machine('invariode', 'numpy')}. All functions in Python, derivatives ours; atol = rtol."
    return "\n\n".join(
        [
            head,
            metrics(),
            squeezing(repetitions),
            published(),
            crank(),
            papers_pendulum(),
            closed_loop(),
        ]
    )


if __name__ == "__main__":
    run("mechanics", __doc__, report, repetitions=1)
