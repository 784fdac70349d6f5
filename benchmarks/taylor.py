"""Taylor series against heyoka's: ``python benchmarks/taylor.py [--write]``.

One trajectory of each problem of nonstiff.py, at equal error; many side by side; a long orbit with energy and momentum
held; many events.
Times are those of the processor, the least of many, since the machine is shared: the contestants take turns.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median
from time import process_time
from typing import Any, Literal

import numpy as np
from measure import interleaved, machine, run, table
from nonstiff import PROBLEMS, Problem
from numpy.typing import NDArray
from peers import Reference, finished, invariants, power, reference, with_heyoka
from peers import taylor as heyoka_integrator

import invariode as iv
from invariode._functions import lanes as choice

Array = NDArray[np.float64]
Run = Callable[[], Array]

TOLERANCES = tuple(10.0**-k for k in range(4, 17))
ERRORS = tuple(10.0**-k for k in range(6, 14))
#: Of what is timed: shorter runs are repeated.
SHORTEST = 2e-3
#: Trajectories of an ensemble, and by how much their initial values differ, in parts of them; for what is compared.
MANY, SPREAD = 1024, 0.01
FEW_TOLERANCES = tuple(10.0**-k for k in range(5, 18, 2))
FEW_ERRORS = (1e-6, 1e-8, 1e-10, 1e-12)
REFERENCE = 1e-17
#: The long orbit, its eccentricity, and the tolerance; a looser one, at which code is compiled too.
ORBITS, ECCENTRICITY, TIGHT, LOOSE = 10_000, 0.9, 1e-15, 1e-9
#: Zeros of the events, and distances of pairs of them in units of √ε h.
CROSSINGS, APART = 10_000, (10.0, 3.0, 1.0)
#: Around a zero that was found, the sign is compared.
BESIDE = 1e-10


def ours(p: Problem, tolerance: float, **held: Any) -> Run:
    """A prepared solver, whose code is compiled before it is timed."""
    problem = iv.Problem(p.rhs(power), p.span, p.y0, **held)
    solver = problem.prepare("taylor", rtol=tolerance, atol=tolerance, keep="end")
    y0 = np.array(p.y0)

    def solve() -> Array:
        sol = solver(y0=y0)
        return finished(sol.success, sol.message, sol.y[:, -1])

    return solve


def theirs(p: Problem, tolerance: float) -> Run:
    (solver,) = with_heyoka(p)
    return solver.at(tolerance)


# ----------------------------------------------------------------------------------------------------------------------
# One trajectory


def timed(runs: Mapping[Any, Run], repetitions: int) -> dict[Any, float]:
    """The least processor time of one run of each."""
    counts = {}
    for name, one in runs.items():
        start = process_time()
        one()
        counts[name] = max(1, math.ceil(SHORTEST / max(process_time() - start, 1e-6)))

    def several(one: Run, count: int) -> None:
        for _ in range(count):
            one()

    rounds = {name: partial(several, one, counts[name]) for name, one in runs.items()}
    return {name: min(times) / counts[name] for name, times in interleaved(rounds, repetitions, process_time).items()}


def seconds_at(error: float, points: Sequence[tuple[float, float]]) -> float | None:
    """The least time of an error that is not larger, interpolated on logarithms between neighbouring tolerances."""
    best = None
    for (e0, t0), (e1, t1) in itertools.pairwise(points):
        if not min(e0, e1) <= error <= max(e0, e1):
            continue
        part = 0.0 if e0 == e1 else math.log(error / e0) / math.log(e1 / e0)
        found = t0 * (t1 / t0) ** part
        best = found if best is None else min(best, found)
    return best


def compared(p: Problem, repetitions: int) -> tuple[list[str], list[float]]:
    """A row of the table, and the ratios in it."""
    exact: Reference = reference(p)
    runs: dict[tuple[str, float], Run] = {}
    errors: dict[tuple[str, float], float] = {}
    for tolerance in TOLERANCES:
        for name, make in (("ours", ours), ("theirs", theirs)):
            one = make(p, tolerance)
            runs[name, tolerance] = one
            errors[name, tolerance] = max(exact.error(one()), 1e-16)
    times = timed(runs, repetitions)
    lines = {name: [(errors[name, t], times[name, t]) for t in TOLERANCES] for name in ("ours", "theirs")}
    ratios, cells = [], []
    for error in ERRORS:
        a, b = (seconds_at(error, lines[name]) for name in ("ours", "theirs"))
        if a is None or b is None:
            cells.append("")
            continue
        ratios.append(a / b)
        cells.append(f"{a * 1e6:.0f} / {b * 1e6:.0f} = {a / b:.2f}")
    return [p.title, *cells], ratios


def one_trajectory(repetitions: int) -> str:
    rows, ratios = [], []
    for p in PROBLEMS.values():
        row, found = compared(p, repetitions)
        rows.append(row)
        ratios += found
    header = ["µs, invariode / heyoka, at an error of", *(f"{error:.0e}" for error in ERRORS)]
    says = f"Of {len(ratios)} ratios the median is {median(ratios):.2f}, the largest {max(ratios):.2f}."
    return f"{table(header, rows)}\n\n{says}"


# ----------------------------------------------------------------------------------------------------------------------
# Many trajectories


def starts(p: Problem) -> Array:
    """Initial values near that of the problem."""
    y0 = np.array(p.y0)
    return y0 * np.random.default_rng(30).uniform(1 - SPREAD, 1 + SPREAD, (MANY, len(y0)))


def ensemble(p: Problem, y0: Array, tolerance: float, lanes: Literal["auto", 1]) -> Run:
    fun = iv.compile(p.rhs(power), by="trace")

    def solve() -> Array:
        tolerances = {"rtol": tolerance, "atol": tolerance}
        found = iv.solve_ensemble(fun, p.span, y0, "taylor", workers=1, lanes=lanes, **tolerances)
        return finished(bool(found.success.all()), "some failed", found.y_end)

    return solve


def batches(p: Problem, y0: Array, tolerance: float) -> Run:
    """An integrator of as many trajectories as it recommends, set to one batch after the other."""
    import heyoka

    width = heyoka.recommended_simd_size()
    y = heyoka.make_vars(*(f"y{i}" for i in range(len(p.y0))))
    system = list(zip(y, p.rhs(lambda s: s**-1.5)(0.0, y), strict=True))
    (t0, tf), start = p.span, np.ascontiguousarray(y0[:width].T)
    integrator = heyoka.taylor_adaptive_batch(system, start, time=[t0] * width, tol=tolerance)

    def solve() -> Array:
        found = np.empty_like(y0)
        for i in range(0, MANY, width):
            integrator.set_time(t0)
            integrator.state[:] = y0[i : i + width].T
            integrator.propagate_until([tf] * width)
            found[i : i + width] = integrator.state.T
        return found

    return solve


def compared_many(p: Problem, repetitions: int) -> tuple[list[str], list[float]]:
    """A row of the table, and the ratios in it. Errors are medians over the trajectories, against heyoka's results one
    at a time at its smallest tolerance."""
    y0 = starts(p)
    size = np.abs(np.array(p.y0)).max()
    exact = batches(p, y0, REFERENCE)()
    ratios, cells = [], []
    makes: dict[str, Callable[[float], Run]] = {
        "lanes": lambda tolerance: ensemble(p, y0, tolerance, "auto"),
        "alone": lambda tolerance: ensemble(p, y0, tolerance, 1),
        "theirs": lambda tolerance: batches(p, y0, tolerance),
    }
    runs = {(name, t): make(t) for name, make in makes.items() for t in FEW_TOLERANCES}
    errors = {key: max(float(np.median(np.abs(one() - exact).max(1))) / size, 1e-16) for key, one in runs.items()}
    times = timed(runs, repetitions)
    lines = {name: [(errors[name, t], times[name, t]) for t in FEW_TOLERANCES] for name in makes}
    for error in FEW_ERRORS:
        lanes, alone, theirs = (seconds_at(error, lines[name]) for name in makes)
        if lanes is None or alone is None or theirs is None:
            cells.append("")
            continue
        ratios.append(lanes / theirs)
        unit = 1e6 / MANY
        cells.append(f"{lanes * unit:.1f} / {theirs * unit:.1f} = {lanes / theirs:.2f}; {alone / lanes:.1f}")
    return [p.title, *cells], ratios


def many_trajectories(repetitions: int) -> str:
    choice.FEWEST = MANY // choice.FEWEST_BY_SERIES
    rows, ratios = [], []
    for p in PROBLEMS.values():
        row, found = compared_many(p, max(repetitions // 5, 2))
        rows.append(row)
        ratios += found
    about = "µs a trajectory, lanes / heyoka's batches; one at a time ÷ lanes; at a median error of"
    says = f"Of {len(ratios)} ratios the median is {median(ratios):.2f}, the largest {max(ratios):.2f}."
    return f"{table([about, *(f'{error:.0e}' for error in FEW_ERRORS)], rows)}\n\n{says}"


# ----------------------------------------------------------------------------------------------------------------------
# Compilation


def compiled_in(make: Callable[[], object]) -> float:
    """Processor time, in milliseconds, of what is done once."""
    start = process_time()
    make()
    return 1e3 * (process_time() - start)


def compilation() -> str:
    """Before the first step, in a process that has compiled something before."""
    ours(PROBLEMS["kepler"], TOLERANCES[0])()
    rows = []
    for p in PROBLEMS.values():
        times = [compiled_in(lambda p=p, tolerance=tolerance: ours(p, tolerance)()) for tolerance in (LOOSE, TIGHT)]
        rows.append([p.title, *(f"{one:.0f}" for one in times)])
    return table(["ms to prepare, and for the first run", f"at {LOOSE:.0e}", f"at {TIGHT:.0e}"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# A long orbit


def long_orbit(repetitions: int) -> str:
    """The error of the position after whole periods."""
    p = PROBLEMS["kepler"]
    e = ECCENTRICITY
    y0 = np.array([1 - e, 0.0, 0.0, math.sqrt((1 + e) / (1 - e))])
    tf = 2 * math.pi * ORBITS
    fun = p.rhs(power)

    def solved(**held: Any) -> Run:
        solver = iv.Problem(fun, (0, tf), y0, **held).prepare("taylor", rtol=TIGHT, atol=TIGHT, keep="end")
        return lambda: solver(y0=y0).y[:, -1]

    integrator = heyoka_integrator(
        Problem(p.name, p.title, (0.0, tf), list(y0), p.rhs, p.g, p.g_jac, p.names), float, TIGHT
    )

    def with_theirs() -> Array:
        integrator.time = 0.0
        integrator.state[:] = y0
        integrator.propagate_until(tf)
        return integrator.state.copy()

    runs = {
        "taylor, energy and momentum held": solved(invariants=invariants(p)),
        "taylor": solved(),
        "heyoka": with_theirs,
    }
    errors = {name: float(np.abs(one() - y0)[:2].max()) for name, one in runs.items()}
    times = timed(runs, max(repetitions // 5, 2))
    rows = [[name, f"{errors[name]:.1e}", f"{t:.2f}", f"{t / times['heyoka']:.2f}"] for name, t in times.items()]
    return table([f"Kepler, e = {e}, {ORBITS} orbits, tolerance {TIGHT:.0e}", "error", "s", "÷ heyoka"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# Events


def clock(t: float, y: Any) -> list[Any]:
    """A circle, in the angle t."""
    return [y[1], -y[0]]


def found_by(event: Callable[..., Any], span: float) -> tuple[Array, float]:
    """Where the event occurs along the circle, and the longest step."""
    sol = iv.solve_ivp(clock, (0, span), [0.0, 1.0], "taylor", rtol=1e-12, atol=1e-12, events=event)
    return sol.t_events[0], float(np.max(sol.steps.h))


def events(repetitions: int) -> str:
    """Sums of sines with random phases; their zeros are counted by the signs at 200 times as many points."""
    random = np.random.default_rng(30)
    rows = []
    known = missed = invented = 0
    span = 100.0
    while known < CROSSINGS:
        a, w, c = random.uniform(0.2, 1, 5), random.uniform(1, 40, 5), random.uniform(0, 6, 5)

        def wave(t: Any, y: Any, a: Array = a, w: Array = w, c: Array = c) -> Any:
            return sum(a[i] * np.sin(w[i] * t + c[i]) for i in range(5))

        fine = np.linspace(0, span, 200_001)
        values = wave(fine, None)
        expected = fine[:-1][np.sign(values[:-1]) != np.sign(values[1:])]
        found, _ = found_by(wave, span)
        near = np.array([np.abs(found - t).min(initial=1) <= 2 * fine[1] for t in expected])
        backed = np.sign(wave(found - BESIDE, None)) != np.sign(wave(found + BESIDE, None))
        known, missed, invented = known + len(expected), missed + int((~near).sum()), invented + int((~backed).sum())
    rows.append(["crossings of random waves", f"{known}", f"{missed}", f"{invented}"])
    _, h = found_by(lambda t, y: y[0], span)
    for apart in APART:
        half = apart * math.sqrt(np.finfo(float).eps) * h / 2
        found, _ = found_by(lambda t, y, half=half: np.sin(t) ** 2 - half**2, span)
        pairs = 2 * int(span / math.pi) + 1
        rows.append([f"pairs {apart:g} √ε h apart", f"{pairs}", f"{pairs - len(found)}", "0"])
    return table(["events along a circle", "there are", "missed", "invented"], rows)


def report(repetitions: int) -> str:
    first = compilation()  # before anything else has compiled the same
    parts = [
        one_trajectory(repetitions),
        many_trajectories(repetitions),
        first,
        long_orbit(repetitions),
        events(repetitions),
    ]
    return "\n\n".join([machine("invariode", "heyoka", "llvmlite"), *parts])


if __name__ == "__main__":
    run("taylor", __doc__, report, 15)
