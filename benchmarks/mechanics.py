"""What corrections in levels gain on mechanisms: ``python benchmarks/mechanics.py [--write]``, or ``make bench``.

Andrews' squeezing mechanism, Arévalo's problem, the paper's pendulum, chains: plain, projected jointly, projected in
levels, and on the squeezing mechanism with Baumgarte's stabilisation. ``--write`` puts the tables into
docs/benchmarks.md.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from statistics import median

import numpy as np
from measure import interleaved, machine, run, table

import invariode as iv
from mechanisms import Array, Case, arevalo, chain, closed_chain, energy_of_unit_masses, pendulum, squeezer

WAYS = ("none", "joint", "levels")
RTOLS = (1e-4, 1e-7, 1e-10)
METHODS = ("ode45", "dop853", "ode78", "ode113")
#: Baumgarte's α = β, in units of the inverse of the interval: of 1, 3, 10, ... 3000 the one after which ode45 pays more
#: evaluations for further digits. It has to be found by trial for every mechanism.
DAMPING = 10.0


def solve(case: Case, method: str, rtol: float, way: str) -> iv.Solution:
    problem = case.system.problem(case.t_span, case.q0, case.v0, correction=way)
    return problem.solve(method, rtol=rtol, atol=rtol, keep="end")


def stabilised(case: Case, method: str, rtol: float) -> iv.Solution:
    """φ'' + 2 α φ' + α² φ = 0 in place of φ'' = 0, after Baumgarte (1972)."""
    alpha = DAMPING / (case.t_span[1] - case.t_span[0])
    n = len(case.q0)
    problem = case.system.problem(case.t_span, case.q0, case.v0, correction="levels")
    position, rate = problem.invariants[:2]

    def damped(t: float, y: Array) -> Array:
        slope = np.array(problem.fun(t, y))
        rows = position.jac(t, y)[:, :n]
        wanted = -2 * alpha * rate.fun(t, y) - alpha**2 * position.fun(t, y)
        weighted = np.linalg.solve(case.system.mass(t, y[:n]), rows.T)
        slope[n:] += weighted @ np.linalg.solve(rows @ weighted, wanted)
        return slope

    return iv.solve_ivp(damped, case.t_span, problem.y0, method, rtol=rtol, atol=rtol, keep="end")


def digits(case: Case, sol: iv.Solution) -> str:
    """Of the positions: the reference is good to about nine."""
    if sol.status < 0:
        return "fails"
    n = len(case.q0)
    error = np.abs(sol.y[:n, -1] - case.end[:n]) / np.abs(case.end[:n])
    return f"{-np.log10(error.max()):.1f}"


def squeezing(repetitions: int) -> str:
    case, rows = squeezer(), []
    for method in METHODS:
        for rtol in RTOLS:
            runs = {way: partial(solve, case, method, rtol, way) for way in WAYS}
            found = {way: go() for way, go in runs.items()}
            found["Baumgarte"] = stabilised(case, method, rtol)  # not timed: written here in Python, it solves twice
            times = interleaved(runs, repetitions)
            rows.append(
                [
                    method,
                    f"{rtol:.0e}",
                    *(digits(case, sol) for sol in found.values()),
                    *(str(sol.nfev) for sol in found.values()),
                    *(f"{1e3 * median(times[way]):.0f}" for way in runs),
                ]
            )
    columns = [
        f"{what}: {way}" if way == "none" else way
        for what, ways in (("digits", (*WAYS, "Baumgarte")), ("f", (*WAYS, "Baumgarte")), ("ms", WAYS))
        for way in ways
    ]
    return table(["Andrews' squeezing mechanism", "rtol", *columns], rows)


def multipliers() -> str:
    """The greatest errors of positions and multipliers over the run."""
    case, rows = arevalo(), []
    for method in METHODS:
        for rtol in RTOLS:
            line = [method, f"{rtol:.0e}"]
            for way in WAYS:
                problem = case.system.problem(case.t_span, case.q0, case.v0, correction=way)
                sol = problem.solve(method, rtol=rtol, atol=rtol)
                exact = np.array([np.sin(sol.t**2), np.cos(sol.t**2)])
                tension = case.system.multipliers(sol)[0] + 4 * sol.t**2
                line += [f"{np.abs(sol.y[:2] - exact).max():.0e}", f"{np.abs(tension).max():.0e}"]
            rows.append(line)
    columns = [f"{what}: {way}" for way in WAYS for what in ("q", "λ")]
    return table(["Arévalo's problem, t ≤ 3", "rtol", *columns], rows)


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
    """What is left of the constraints and of the energy after 60 s at 1e-6."""
    case, rows = closed_chain(), []
    n = len(case.q0)
    for method in METHODS:
        for way in WAYS:
            problem = case.system.problem(case.t_span, case.q0, case.v0, correction=way)
            sol = problem.solve(method, rtol=1e-6, atol=1e-8)
            lengths = max(np.abs(case.system.constraints(0, y[:n])).max() for y in sol.y.T)
            energy = np.array([energy_of_unit_masses(0, y[:n], y[n:]) for y in sol.y.T])
            rows.append(
                [
                    method,
                    way,
                    str(sol.stats.steps),
                    str(sol.nfev),
                    f"{lengths:.0e}",
                    f"{np.abs(energy - energy[0]).max():.0e}",
                ]
            )
    return table(["closed five-link chain, 60 s, rtol 1e-6", "", "steps", "f", "φ", "energy"], rows)


CALLS = 20  # of f, timed together


def several(function: Callable[[], object]) -> None:
    for _ in range(CALLS):
        function()


def links(repetitions: int) -> str:
    """Milliseconds per f of a chain of N links: dense linear algebra."""
    rows = []
    for n in (5, 10, 20, 40, 80):
        case = chain(n)
        problem = case.system.problem(case.t_span, case.q0, case.v0)
        calls = partial(several, partial(problem.fun, 0.0, problem.y0))
        times = interleaved({"f": calls}, repetitions)
        rows.append([str(n), f"{1e3 * median(times['f']) / CALLS:.2f}"])
    return table(["links of a chain", "ms per f"], rows)


def report(repetitions: int) -> str:
    head = f"{machine('invariode', 'numpy')}. All functions in Python, derivatives ours; atol = rtol."
    return "\n\n".join(
        [head, squeezing(repetitions), multipliers(), papers_pendulum(), closed_loop(), links(repetitions)]
    )


if __name__ == "__main__":
    run("mechanics", __doc__, report, repetitions=3)
