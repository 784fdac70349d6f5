"""From two equations to a million: ``python benchmarks/large.py [--write]``, or ``make bench``.

The heat equation and the wave equation by finite differences on a ring, in units of the mesh, with a fixed step far
below the limit of stability (first_step = max_step, tolerances that no step fails), so that every n has the same work
per component. The exact solution of the differences is known; nothing is timed before it was compared with it. f is C++
of `large.cpp`, compiled here with the flags of the core. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import argparse
import ctypes
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import scipy.integrate
from measure import growth, in_fresh_process, interleaved, machine, table, write_section
from numpy.typing import NDArray

import invariode as iv
from native import DOUBLE, POINTER, build, user_function

Array = NDArray[np.float64]
METHODS = ("ode23", "ode45", "dop853", "ode113")
SIZES = (2, 4, 8, 16, 32, 64, 256, 1024, 10**4, 10**5, 10**6)
BASE, FLAT, LARGEST = 1024, (64, 10**4), SIZES[-1]
WAVE_SIZES = (BASE, LARGEST)
INVARIANT_SIZES = (BASE, 10**4, 10**5, LARGEST)
WORK = 2 * 10**6  # steps times components of a run,
STEPS = (12, 20000)  # within these
FEW, MANY_NUMBERS = 3, 10**5  # repetitions at most from so many components on
STEP = 0.05  # in units of the time in which a cell exchanges its content with a neighbour
WAVELENGTH = 16  # cells
TOLERANCE = 3e-2
WRONG = 1e-4
NS = 1e-9


@dataclass(frozen=True)
class Problem:
    f: str
    start: Callable[[int], Array]
    exact: Callable[[int, float], Array]


def mode(cells: int) -> tuple[Array, float]:
    """A wave that fits the ring, and −1 times its eigenvalue."""
    waves = max(1, cells // WAVELENGTH)
    angle = 2 * np.pi * waves / cells
    return np.cos(angle * np.arange(cells)), 2 - 2 * np.cos(angle)


def warm(n: int, t: float) -> Array:
    shape, decay = mode(n)
    return 1 + 0.5 * np.exp(-decay * t) * shape


def swinging(n: int, t: float) -> Array:
    shape, square = mode(n // 2)
    frequency = np.sqrt(square)
    return np.concatenate([np.cos(frequency * t) * shape, -frequency * np.sin(frequency * t) * shape])


PROBLEMS = {
    "heat": Problem("heat_f", lambda n: warm(n, 0.0), warm),
    "wave": Problem("wave_f", lambda n: swinging(n, 0.0), swinging),
}


def steps_for(n: int) -> int:
    return int(np.clip(WORK // n, *STEPS))


def solver(
    library: ctypes.CDLL, name: str, n: int, method: str, held: bool = False, short: bool = False, **options: Any
) -> Any:
    """A solve with that many steps of equal size, or with one, as a function without arguments."""
    p, steps = PROBLEMS[name], 1 if short else steps_for(n)
    if held:
        g, jac = user_function(library, "heat_g"), user_function(library, "heat_gjac")
        options["invariants"] = iv.Invariants(g, jac, names="total heat")
    options = {"keep": "end", **options}
    problem = partial(
        iv.solve_ivp,
        user_function(library, p.f),
        (0.0, STEP * steps),
        p.start(n),
        method,
        args=(float(n), 1.0),
        first_step=STEP,
        max_step=STEP,
        rtol=TOLERANCE,
        atol=TOLERANCE,
    )
    return partial(problem, **options)


def verified(solve: Any, name: str, n: int, method: str) -> Any:
    """The solution, once it is the exact one, with the steps that were meant."""
    sol, steps = solve(), steps_for(n)
    error = np.abs(sol.y[:, -1] - PROBLEMS[name].exact(n, STEP * steps)).max()
    if not (sol.success and error < WRONG and abs(sol.stats.steps - steps) <= 1 and sol.stats.failed == 0):
        stats = f"{sol.stats.steps} steps instead of {steps}, {sol.stats.failed} failed"
        raise SystemExit(f"not timed: {name}, {method}, n = {n}: error {error:.1e}, {stats}: {sol.message}")
    return sol


def few(n: int, repetitions: int) -> int:
    return repetitions if n < MANY_NUMBERS else min(FEW, repetitions)


# ----------------------------------------------------------------------------------------------------------------------
# Time per component


@dataclass(frozen=True)
class Cost:
    """Seconds per component and step, and of a solve of one step."""

    step: float
    solve: float


Costs = dict[tuple[str, str, int], Cost]  # of a problem, a method and n


def costs(library: ctypes.CDLL, repetitions: int) -> Costs:
    found: Costs = {}
    for name, sizes in (("heat", SIZES), ("wave", WAVE_SIZES)):
        for n in sizes:
            runs = {}
            for method in METHODS:
                runs[method] = solver(library, name, n, method)
                runs[f"{method}, one step"] = solver(library, name, n, method, short=True)
                verified(runs[method], name, n, method)
            times = interleaved(runs, few(n, repetitions))
            for method in METHODS:
                short = times[f"{method}, one step"]
                found[name, method, n] = Cost(per_step(times[method], short, n), median(short))
    return found


def per_step(long: Sequence[float], short: Sequence[float], n: int) -> float:
    """What the steps after the first took, per component: setting up, and touching new memory, is not in it."""
    return median(a - b for a, b in zip(long, short, strict=True)) / (n * (steps_for(n) - 1))


def per_component(found: Costs) -> str:
    rows = []
    for n in SIZES:
        cells = [f"{found['heat', method, n].step / NS:.3g}" for method in METHODS]
        relative = [f"{found['heat', method, n].step / found['heat', method, BASE].step:.2f}" for method in METHODS]
        rows.append([f"{n:,}", f"{steps_for(n):,}", *cells, *relative])
    header = ["heat, n", "steps", *(f"{method}, ns" for method in METHODS)]
    return table([*header, *(f"{method} ÷ n = {BASE}" for method in METHODS)], rows)


def flatness(found: Costs) -> str:
    low, high = FLAT
    rows = []
    for method in METHODS:
        inside = [found["heat", method, n].step for n in SIZES if low <= n <= high]
        waves = [found["wave", method, n].step for n in WAVE_SIZES]
        rows.append(
            [
                method,
                f"{max(inside) / min(inside):.2f}",
                f"{found['heat', method, LARGEST].step / found['heat', method, BASE].step:.2f}",
                *(f"{x / NS:.3g}" for x in waves),
                f"{waves[-1] / waves[0]:.2f}",
            ]
        )
    header = ["method", f"heat, n = {low} … {high:,}: largest ÷ smallest", f"n = {LARGEST:,} ÷ n = {BASE}"]
    return table([*header, *(f"wave, n = {n:,}, ns" for n in WAVE_SIZES), "ratio"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# Memory traffic


def passes(library: ctypes.CDLL, method: str) -> float:
    """Vectors that the loops of a step of core/ read or write, one after the other, with keep="end" and no invariant.

    Of f: y once, the output once.
    """
    loop = 2 + 2  # the driver keeps y, and puts out y
    if method == "ode113":
        sol = solver(library, "heat", LARGEST, method, t_eval=[STEP * steps_for(LARGEST)], keep="all")()
        k = sol.steps.order.astype(float)
        predict = 2 + 3 + 5 * (k - 1) + 3  # copy, the differences with the sum, the predictor
        test = 1 + 2 + 1 + 3 + 2 + 3 * (k > 1) + 3 * (k > 2)  # f, its difference, norms
        commit = 3 + 1 + 2 + 1 + 2 + 5 + 3 * k + 2  # candidate, f, copy, differences, norm
        return float(np.mean(3 + predict + test + commit)) + loop
    A, b, E = tableau(method)
    last_in_error = method != "dop853"
    f = 1 + 2  # whether y is finite, and f
    inner = sum(1 + np.count_nonzero(row) + 1 + f for row in A)
    candidate = 1 + np.count_nonzero(b) + 1
    norm = 3 + np.count_nonzero(E)
    accept = 2 + 2
    return float(inner + candidate + f + (0 if last_in_error else 1) + norm + accept + loop)


def tableau(method: str) -> tuple[Array, Array, Array]:
    """Weights of the inner stages, of the result, and which stages have a part in the error (SciPy's copies)."""
    if method == "dop853":
        from scipy.integrate._ivp import dop853_coefficients as c

        stages = c.N_STAGES
        return c.A[1:stages, :stages], c.B, (c.E3 != 0) | (c.E5 != 0)
    pair = {"ode23": scipy.integrate.RK23, "ode45": scipy.integrate.RK45}[method]
    return pair.A[1:], pair.B, pair.E


def bandwidth(library: ctypes.CDLL) -> tuple[float, int]:
    """Bytes per second of STREAM's triad, the best of several, and the size of its arrays in bytes."""
    size = 4 * last_level_cache() // 8
    seconds = np.zeros(8)
    library.triad.restype, library.triad.argtypes = DOUBLE, (ctypes.c_size_t, ctypes.c_size_t, POINTER)
    library.triad(size, len(seconds), seconds.ctypes.data_as(POINTER))
    return 3 * 8 * size / seconds.min(), 8 * size


def last_level_cache() -> int:
    try:
        size = os.sysconf("SC_LEVEL3_CACHE_SIZE")
    except (ValueError, OSError):
        size = 0
    return size if size > 0 else 32 * 2**20


def traffic(library: ctypes.CDLL, found: Costs) -> str:
    speed, size = bandwidth(library)
    rows = []
    for method in METHODS:
        count = passes(library, method)
        cost = found["heat", method, LARGEST]
        moved = 8 * count / cost.step
        fixed = f"{(cost.solve / (cost.step * LARGEST)) - 1:.1f}"
        step = f"{1e3 * cost.step * LARGEST:.2f}"
        rows.append([method, f"{count:.0f}", step, f"{moved / 1e9:.1f}", f"{moved / speed:.0%}", fixed])
    header = [f"heat, n = {LARGEST:,}", "vectors per step", "ms per step", "GB/s", "of the triad"]
    header.append("rest of a solve, in steps")
    return f"{table(header, rows)}\n\nTriad, three arrays of {size / 2**20:.0f} MiB: {speed / 1e9:.1f} GB/s."


# ----------------------------------------------------------------------------------------------------------------------
# Memory


def memory() -> str:
    rows = []
    for method in METHODS:
        grown = [int(in_fresh_process(__file__, "--memory", method, *held)) for held in ((), ("--held",))]
        own = iv.METHODS[method].stages
        kept, text = (own, str(own)) if own else (14, "12 + 2 differences")
        rows.append([method, text, *(f"{one / (8 * LARGEST):.1f}" for one in grown), str(kept + 8)])
    header = [f"n = {LARGEST:,}, final state only", "stages", "growth, vectors", "total heat imposed", "stages + 8"]
    return table(header, rows)


def memory_of(method: str, held: bool) -> int:
    """Growth of the peak by a solve with n = 10⁶, the initial value not counted."""
    library = build("large.cpp")
    solver(library, "heat", SIZES[0], method, held)()
    return growth(solver(library, "heat", LARGEST, method, held))


# ----------------------------------------------------------------------------------------------------------------------
# An invariant


def invariant(library: ctypes.CDLL, repetitions: int) -> str:
    rows = []
    for method in ("ode45", "ode113"):
        for n in INVARIANT_SIZES:
            plain, held = (solver(library, "heat", n, method, held=h) for h in (False, True))
            first = {h: solver(library, "heat", n, method, held=h, short=True) for h in (False, True)}
            verified(plain, "heat", n, method)
            s, once = verified(held, "heat", n, method).stats, first[True]().stats
            ng, njac, steps = s.ng - once.ng, s.ngjac - once.ngjac, s.steps - once.steps
            y, out, p = PROBLEMS["heat"].start(n), np.empty(n), np.array([float(n), 1.0])
            times = interleaved(
                {
                    "plain": plain,
                    "plain, one step": first[False],
                    "held": held,
                    "held, one step": first[True],
                    "g": partial(calls, library.heat_g, ng, y, out, p),
                    "J": partial(calls, library.heat_gjac, njac, y, out, p),
                },
                few(n, repetitions),
            )
            own = {what: per_step(times[what], times[f"{what}, one step"], n) / NS for what in ("plain", "held")}
            user = sum(median(times[what]) for what in "gJ") / (n * steps) / NS
            added = own["held"] - own["plain"]
            rows.append(
                [
                    f"{method}, n = {n:,}",
                    f"{own['plain']:.2f}",
                    f"{own['held']:.2f}",
                    f"{own['held'] / own['plain']:.2f}",
                    f"{ng / steps:.1f}",
                    f"{njac / steps:.1f}",
                    f"{added:.2f}",
                    f"{user:.2f}",
                    f"{added - user:.2f}",
                ]
            )
    header = ["total heat held", "plain, ns", "held, ns", "÷ plain", "g per step", "J per step", "added, ns"]
    return table([*header, "user's g and J, ns", "ours, ns"], rows)


def calls(function: Any, count: int, y: Array, out: Array, p: Array) -> None:
    function.restype, function.argtypes = None, (DOUBLE, POINTER, POINTER, POINTER)
    pointers = [x.ctypes.data_as(POINTER) for x in (y, out, p)]
    for _ in range(count):
        function(0.0, *pointers)


# ----------------------------------------------------------------------------------------------------------------------


def report(repetitions: int) -> str:
    library = build("large.cpp")
    found = costs(library, repetitions)
    least = few(LARGEST, repetitions)
    fewer = f", from n = {MANY_NUMBERS:,} on of {least}" if least != repetitions else ""
    return "\n\n".join(
        [
            f"{machine('invariode', 'numpy')}. Medians of {repetitions}{fewer}; ns per component and step.",
            per_component(found),
            flatness(found),
            traffic(library, found),
            memory(),
            invariant(library, repetitions),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the tables in docs/benchmarks")
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--memory", choices=METHODS, help=argparse.SUPPRESS)
    parser.add_argument("--held", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory:
        print(memory_of(arguments.memory, arguments.held))
        return
    text = report(arguments.repetitions)
    print(text)
    if arguments.write:
        write_section("large", text)


if __name__ == "__main__":
    main()
