"""Many trajectories of one problem: ``python benchmarks/ensembles.py [--write] [--large]``, or ``make bench``.

Lotka–Volterra with a parameter and initial values of its own for each trajectory, t from 0 to 10, final states only.
Every contestant gets the tolerance rtol = atol, found before the timing, at which the median of its errors at 100
trajectories is 1e-6 within a factor of 2; what is timed starts with arrays of N rows and ends with one.

- invariode: `iv.solve_ensemble` with functions of `iv.compile`, on one thread and on two.
- diffrax: a jitted `vmap` of `diffeqsolve`, float64, `PIDController`, ``SaveAt(t1=True)``; its documentation recommends
  no other form for the CPU. Also with the rows divided between two devices of the CPU (`jax.pmap`).
- heyoka: the batch integrator, reused for one batch after the other; two of them on two threads. Its ensemble functions
  copy an integrator per trajectory or batch, which costs more than to integrate this problem.
- SciPy: a loop over the first 100 rows with a function of numba's; its rate is that of these.

``--large`` adds a million trajectories, for invariode only. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from statistics import median
from time import perf_counter
from typing import Any

DEVICES = 2
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"

import numba  # noqa: E402  # XLA reads its flags when it is imported
import numpy as np  # noqa: E402  # the flags above come first
import scipy.integrate  # noqa: E402  # the flags above come first
from measure import (  # noqa: E402  # the flags above come first
    Times,
    growth,
    in_fresh_process,
    installed,
    interleaved,
    machine,
    ratio,
    table,
    write_section,
)
from numpy.typing import NDArray  # noqa: E402  # the flags above come first

import invariode as iv  # noqa: E402  # the flags above come first

Array = NDArray[np.float64]
Run = Callable[[Array, Array], Array]  # initial values (N, 2), parameters (N, 1): the final states

SPAN = (0.0, 10.0)
SIZES = (10**3, 10**4, 10**5)
LARGE = 10**6
SAMPLES = 100
SEARCHED = 400  # trajectories with which tolerances are found
GOAL, FACTOR = 1e-6, 2.0  # median error, and how far from it a tolerance may lead
OTHERS = 2.0  # how much larger the median of other samples may be
SKEWED, LONGEST = 2000, 100.0  # trajectories of unequal cost, and how much longer the dearest are
FEW = 3  # repetitions at most with the most trajectories
PACKAGES = ("invariode", "numpy", "numba", "scipy", "diffrax", "jax", "heyoka")


# ----------------------------------------------------------------------------------------------------------------------
# The problem


def lotka_volterra(t: float, y: Any, p: Any) -> Any:
    return (p[0] * y[0] - y[0] * y[1], y[0] * y[1] - y[1])


def conserved(t: float, y: Any, p: Any) -> Any:
    return y[0] - math.log(y[0]) + y[1] - p[0] * math.log(y[1])


def gradient(t: float, y: Any, p: Any) -> Any:
    return (1.0 - 1.0 / y[0], 1.0 - p[0] / y[1])


def interpreted(t: float, y: Array, a: float) -> list[float]:
    prey, predators = y.tolist()
    return [a * prey - prey * predators, prey * predators - predators]


def slowed(t: float, y: Any, p: Any) -> Any:
    """With a time scale in p[1]: a trajectory that is p[1] times as long."""
    return (p[1] * (p[0] * y[0] - y[0] * y[1]), p[1] * (y[0] * y[1] - y[1]))


@cache
def ensemble(size: int) -> tuple[Array, Array]:
    """Initial values and parameters; those of a smaller ensemble are the first ones of a larger."""
    numbers = np.random.default_rng(2024).uniform(size=(size, 3))
    return 0.5 + 2.5 * numbers[:, :2], 0.5 + numbers[:, 2:]


@numba.njit
def returning(t: float, y: Array, a: float) -> Array:
    out = np.empty(2)
    out[0] = a * y[0] - y[0] * y[1]
    out[1] = y[0] * y[1] - y[1]
    return out


@cache
def samples(size: int, count: int = SAMPLES) -> tuple[Array, Array]:
    """Indices spread over the whole ensemble, and their final states by SciPy's DOP853 at its smallest tolerance."""
    y0, p = ensemble(size)
    chosen = np.linspace(0, size - 1, min(count, size)).astype(int)
    return chosen, np.array([one_by_scipy(y0[i], p[i, 0], "DOP853", 2.3e-14) for i in chosen])


def one_by_scipy(y0: Array, a: float, method: str, tolerance: float) -> Array:
    sol = scipy.integrate.solve_ivp(returning, SPAN, y0, method, args=(a,), rtol=tolerance, atol=tolerance)
    if not sol.success:
        raise SystemExit(f"SciPy {method}: {sol.message}")
    return sol.y[:, -1]


# ----------------------------------------------------------------------------------------------------------------------
# Contestants


@dataclass(frozen=True)
class Contestant:
    name: str
    at: Callable[[float], Run]  # with that tolerance
    most: int = SIZES[-1]  # trajectories, at most
    rows: int | None = None  # that it really solves, if fewer


def by_invariode(tolerance: float, method: str, workers: int, invariants: Any = None, fun: Any = None) -> Run:
    options = {"rtol": tolerance, "atol": tolerance, "workers": workers, "invariants": invariants}

    def run(y0: Array, p: Array) -> Array:
        out = iv.solve_ensemble(fun or compiled(), SPAN, y0, method, args=p, **options)
        if not out.success.all():
            raise SystemExit(f"invariode {method}: {out}")
        return out.y_end

    return run


@cache
def compiled() -> Any:
    return iv.compile(lotka_volterra)


def with_invariode() -> Iterator[Contestant]:
    held = iv.Invariants(iv.compile(conserved), jac=iv.compile(gradient), names="H")
    for method in ("ode45", faster_of_high_order()):
        for workers in (1, 2):
            at = partial(by_invariode, method=method, workers=workers)
            yield Contestant(f"invariode {method}, {threads(workers)}", at, LARGE)
    for method in ("ode45", faster_of_high_order()):
        for workers in (1, 2):
            at = partial(by_invariode, method=method, workers=workers, invariants=held)
            name = f"invariode {method}, invariant held, {threads(workers)}"
            yield Contestant(name, at, SIZES[-1] if workers > 1 else SIZES[-2])


def threads(count: int) -> str:
    return f"{count} thread{'s' if count > 1 else ''}"


@cache
def faster_of_high_order() -> str:
    """dop853 or ode78, whichever is faster at the same error."""
    names = ("dop853", "ode78")
    runs = {}
    for name in names:
        at = partial(by_invariode, method=name, workers=1)
        runs[name] = partial(at(tolerance_for(at, name)[0]), *ensemble(SIZES[0]))
    times = interleaved(runs, 15)
    return min(names, key=lambda name: median(times[name]))


def with_diffrax() -> Iterator[Contestant]:
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    term = diffrax.ODETerm(lambda t, y, args: jnp.stack(lotka_volterra(t, y, args)))

    def one(method: Any, y0: Any, p: Any, tolerance: Any) -> Any:
        sol = diffrax.diffeqsolve(
            term,
            method,
            *SPAN,
            None,
            y0,
            args=p,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            throw=False,
        )
        return jnp.where(sol.result == diffrax.RESULTS.successful, sol.ys[-1], jnp.nan)

    def at(tolerance: float, solve: Callable[..., Any], devices: int) -> Run:
        def run(y0: Array, p: Array) -> Array:
            if devices == 1:
                return np.asarray(solve(y0, p, tolerance))
            shape = (devices, len(y0) // devices, -1)
            return np.asarray(solve(y0.reshape(shape), p.reshape(shape), tolerance)).reshape(y0.shape)

        return run

    for name, method in (("Tsit5", diffrax.Tsit5()), ("Dopri8", diffrax.Dopri8())):
        mapped = jax.vmap(partial(one, method), in_axes=(0, 0, None))
        yield Contestant(f"diffrax {name}, vmap", partial(at, solve=jax.jit(mapped), devices=1))
        both = jax.pmap(mapped, in_axes=(0, 0, None))
        yield Contestant(f"diffrax {name}, vmap on 2 devices", partial(at, solve=both, devices=DEVICES))


def with_heyoka() -> Iterator[Contestant]:
    import heyoka

    x, y = heyoka.make_vars("x", "y")
    system = list(zip((x, y), lotka_volterra(0.0, (x, y), (heyoka.par[0],)), strict=True))
    width = heyoka.recommended_simd_size()

    def at(tolerance: float, workers: int) -> Run:
        zero = np.zeros((2, width))
        first = heyoka.taylor_adaptive_batch(system, zero, time=zero[0], pars=zero[:1], tol=tolerance)
        integrators = [first.__copy__() for _ in range(workers)]

        def some(integrator: Any, states: Array, parameters: Array, out: Array) -> None:
            for i in range(len(states)):
                integrator.set_time(SPAN[0])
                integrator.state[:] = states[i]
                integrator.pars[:] = parameters[i]
                integrator.propagate_until(SPAN[1])
                out[i] = integrator.state

        def run(y0: Array, p: Array) -> Array:
            rows = -(-len(y0) // width) * width  # the last batch is filled up with the last row
            fill = ((0, rows - len(y0)), (0, 0))
            states = np.pad(y0, fill, "edge").reshape(-1, width, 2).transpose(0, 2, 1)
            parameters = np.pad(p, fill, "edge").reshape(-1, width, 1).transpose(0, 2, 1)
            out = np.empty(states.shape)
            parts = [slice(len(out) * k // workers, len(out) * (k + 1) // workers) for k in range(workers)]
            if workers == 1:
                some(integrators[0], states, parameters, out)
            else:
                with ThreadPoolExecutor(workers) as pool:
                    works = [
                        pool.submit(some, integrator, states[part], parameters[part], out[part])
                        for integrator, part in zip(integrators, parts, strict=True)
                    ]
                    for work in works:
                        work.result()
            return out.transpose(0, 2, 1).reshape(-1, 2)[: len(y0)]

        return run

    for workers in (1, 2):
        yield Contestant(f"heyoka, batches of {width}, {threads(workers)}", partial(at, workers=workers))


def with_scipy() -> Iterator[Contestant]:
    def at(tolerance: float, method: str) -> Run:
        def run(y0: Array, p: Array) -> Array:
            return np.array([one_by_scipy(y, a, method, tolerance) for y, a in zip(y0, p[:, 0], strict=True)])

        return run

    for method in ("RK45", "DOP853"):
        yield Contestant(f"SciPy {method}, loop (extrapolated)", partial(at, method=method), rows=SAMPLES)


def contestants() -> Iterator[Contestant]:
    """Those of the packages that are installed."""
    yield from with_invariode()
    for package, found in {"diffrax": with_diffrax, "heyoka": with_heyoka, "scipy": with_scipy}.items():
        if installed(package) is not None:
            yield from found()


# ----------------------------------------------------------------------------------------------------------------------
# Equal errors


def median_error(run: Run, size: int, count: int = SAMPLES) -> float:
    """Of the sampled trajectories, after a run of them all."""
    chosen, exact = samples(size, count)
    return float(np.median(np.abs(run(*ensemble(size))[chosen] - exact).max(axis=1)))


def tolerance_for(at: Callable[[float], Run], name: str, rows: int = SEARCHED) -> tuple[float, float]:
    """A tolerance that leads to the error wanted, two digits of it, and the error: bisection of logarithms."""
    low, high = -13.0, -2.0
    for _ in range(12):
        middle = (low + high) / 2
        tolerance = float(f"{10**middle:.1e}")
        error = median_error(at(tolerance), rows, SEARCHED)
        if GOAL / FACTOR**0.5 <= error <= GOAL * FACTOR**0.5:
            return tolerance, error
        low, high = (low, middle) if error > GOAL else (middle, high)
    if not GOAL / FACTOR <= error <= GOAL * FACTOR:
        raise SystemExit(f"{name}: no tolerance found for an error of {GOAL:g}; {error:.1e} at {tolerance:.1e}")
    return tolerance, error


@dataclass(frozen=True)
class Entry:
    """A contestant with its tolerance."""

    contestant: Contestant
    run: Run
    tolerance: float
    error: float

    def on(self, size: int) -> Callable[[], Array]:
        y0, p = ensemble(size)
        rows = self.contestant.rows or size
        return partial(self.run, y0[:rows], p[:rows])


def entries() -> list[Entry]:
    found = []
    known: dict[str, tuple[float, float]] = {}  # one thread and two have the same errors
    for contestant in contestants():
        key = contestant.name.rpartition(",")[0]
        if key not in known:
            known[key] = tolerance_for(contestant.at, contestant.name, contestant.rows or SEARCHED)
        tolerance, error = known[key]
        found.append(Entry(contestant, contestant.at(tolerance), tolerance, error))
    return found


def faster_forms(field: Sequence[Entry], times: Times) -> list[Entry]:
    """Ours, and of each peer's forms, on one thread or two, the one that was faster."""
    best: dict[str, Entry] = {}
    for entry in field:
        name = entry.contestant.name
        key = name if name.startswith("invariode") else name.partition(",")[0]
        if key not in best or median(times[name]) < median(times[best[key].contestant.name]):
            best[key] = entry
    return list(best.values())


def timed(field: Sequence[Entry], size: int, repetitions: int) -> Times:
    """Seconds of those that are asked for so many, whose results are right for all sampled trajectories."""
    entered = [entry for entry in field if size <= entry.contestant.most]
    for entry in entered:
        error = median_error(entry.run, entry.contestant.rows or size)
        if not error <= GOAL * FACTOR * OTHERS:
            raise SystemExit(f"not timed: {entry.contestant.name} has an error of {error:.1e} with {size} trajectories")
    return interleaved({entry.contestant.name: entry.on(size) for entry in entered}, repetitions)


# ----------------------------------------------------------------------------------------------------------------------
# Tables


def rates(field: Sequence[Entry], times: Mapping[int, Times]) -> str:
    """Trajectories per second."""
    rows = []
    for entry in field:
        name, few = entry.contestant.name, entry.contestant.rows
        cells = [f"{(few or size) / median(times[size][name]):,.0f}" if name in times[size] else "–" for size in times]
        rows.append([name, f"{entry.tolerance:.1e}", f"{entry.error:.1e}", *cells])
    return table(["trajectories per second", "tolerance", "error", *(f"N = {size:,}" for size in times)], rows)


def speed_up(field: Sequence[Entry], times: Mapping[int, Times]) -> str:
    """Two threads, or devices, against one."""
    names = [entry.contestant.name for entry in field]
    rows = []
    for name in names:
        one = name.replace("2 threads", "1 thread").replace(" on 2 devices", "")
        if one == name or one not in names:
            continue
        both = [times[size] if {one, name} <= set(times[size]) else None for size in times]
        rows.append([name, *("–" if found is None else f"{ratio(found[one], found[name]):.2f}" for found in both)])
    return table(["speed of two ÷ speed of one", *(f"N = {size:,}" for size in times)], rows)


def against_peers(field: Sequence[Entry], times: Mapping[int, Times], size: int) -> str:
    """Each of ours on two threads against each peer."""
    names = [entry.contestant.name for entry in field if entry.contestant.name in times[size]]
    ours = [name for name in names if name.startswith("invariode") and name.endswith("2 threads")]
    peers = [name for name in names if not name.startswith(("invariode", "SciPy"))]
    rows = [[name, *(f"{ratio(times[size][peer], times[size][name]):.2f}" for peer in peers)] for name in ours]
    return table([f"N = {size:,}: speed ÷ speed of", *peers], rows)


def unequal(repetitions: int) -> str:
    """Trajectories up to 100 times as long as others, sorted, with the dear ones first."""
    y0, p = ensemble(SKEWED)
    scales = np.geomspace(LONGEST, 1.0, SKEWED)
    args = np.column_stack([p, scales])
    fun = iv.compile(slowed)
    solve = partial(iv.solve_ensemble, fun, SPAN, y0, args=args, rtol=GOAL, atol=GOAL)
    one, two = solve(workers=1), solve(workers=2)
    for i in (0, SKEWED // 2, SKEWED - 1):
        alone = iv.solve_ivp(fun, SPAN, y0[i], args=tuple(args[i]), rtol=GOAL, atol=GOAL, keep="end")
        if not np.array_equal(one.y_end[i], alone.y[:, -1]):
            raise SystemExit(f"not timed: trajectory {i} is not that of a single solve")
    if not (one.success.all() and np.array_equal(one.y_end, two.y_end)):
        raise SystemExit("not timed: the result depends on the number of threads")
    times = interleaved({"1": partial(solve, workers=1), "2": partial(solve, workers=2)}, repetitions)
    cost = one.stats.nfev
    halves = cost.sum() / cost[: SKEWED // 2].sum()
    orders = f"{cost.max() / cost.min():.0f}"
    row = [f"{SKEWED:,}", orders, f"{halves:.2f}", f"{ratio(times['1'], times['2']):.2f}"]
    return table(["trajectories", "dearest ÷ cheapest, f calls", "halves, without stealing", "2 threads ÷ 1"], [row])


def interpreted_functions(repetitions: int) -> str:
    """In a process of its own: JAX has threads, which a fork may not survive."""
    size, error, one, two = in_fresh_process(__file__, "--interpreted", "--repetitions", str(repetitions)).split()
    return table(
        ["Python f", "error", "this process", "2 processes", "ratio"],
        [[f"N = {size}", error, one, two, f"{float(two) / float(one):.2f}"]],
    )


def measure_interpreted(repetitions: int) -> str:
    size, workers = SIZES[0], (1, 2)
    tolerance, _ = tolerance_for(partial(by_invariode, method="ode45", workers=1), "ode45")
    runs = {str(w): by_invariode(tolerance, "ode45", w, fun=interpreted) for w in workers}
    errors = [median_error(run, size) for run in runs.values()]
    if not max(errors) <= GOAL * FACTOR * OTHERS:
        raise SystemExit(f"not timed: Python functions have errors of {errors}")
    times = interleaved({name: partial(run, *ensemble(size)) for name, run in runs.items()}, min(FEW, repetitions))
    return " ".join([str(size), f"{errors[0]:.1e}", *(f"{size / median(seconds):.0f}" for seconds in times.values())])


def memory() -> str:
    rows = []
    for size in (SIZES[-1], LARGE):
        for held in (False, True):
            grown = int(in_fresh_process(__file__, "--memory", str(size), *(["--held"] if held else [])))
            name = f"N = {size:,}{', invariant held' if held else ''}"
            rows.append([name, f"{grown / 2**20:.1f}", f"{grown / size:.0f}", str(8 * (2 + 2 * 2 + 3 * held) + 120)])
    return table(["final states only", "growth, MiB", "per trajectory, bytes", "documented for the result"], rows)


def memory_of(size: int, held: bool) -> int:
    """Growth of the peak by a solve, y0 and args not counted; what is only made once is there before."""
    invariants = iv.Invariants(iv.compile(conserved), jac=iv.compile(gradient), names="H") if held else None
    run = by_invariode(GOAL, "ode45", 2, invariants)
    run(*ensemble(SAMPLES))
    y0, p = ensemble(size)
    return growth(lambda: iv.solve_ensemble(compiled(), SPAN, y0, args=p, workers=2, invariants=invariants))


# ----------------------------------------------------------------------------------------------------------------------


def report(repetitions: int, large: bool) -> str:
    start = perf_counter()
    missing = [package for package in PACKAGES if installed(package) is None]
    field = entries()
    print(f"tolerances found in {perf_counter() - start:.0f} s", file=sys.stderr)
    times: dict[int, Times] = {}
    for size in (*SIZES, *([LARGE] if large else [])):
        many = size >= SIZES[-1]
        asked = faster_forms(field, times[SIZES[-2]]) if many else field
        times[size] = timed(asked, size, min(FEW, repetitions) if many else repetitions)
        print(f"{size} trajectories done at {perf_counter() - start:.0f} s", file=sys.stderr)
    fewer = f", from N = {SIZES[-1]:,} on of {FEW}" if repetitions > FEW else ""
    parts = [f"{machine(*PACKAGES)}. Medians of {repetitions}{fewer}."]
    if missing:
        parts.append(f"Not installed, and left out: {', '.join(missing)}.")
    parts += [
        rates(field, times),
        speed_up(field, times),
        against_peers(field, times, SIZES[-1]),
        "Trajectories per second with Python functions, ode45:",
        interpreted_functions(repetitions),
        "Unequal costs, ode45:",
        unequal(repetitions),
        "Memory:",
        memory(),
    ]
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the tables in docs/benchmarks")
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--large", action="store_true", help=f"also {LARGE:,} trajectories, invariode only")
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--interpreted", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--held", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory:
        print(memory_of(arguments.memory, arguments.held))
        return
    if arguments.interpreted:
        print(measure_interpreted(arguments.repetitions))
        return
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*pmap.*", DeprecationWarning)
        text = report(arguments.repetitions, arguments.large)
    print(text)
    if arguments.write:
        write_section("ensembles", text)


if __name__ == "__main__":
    main()
