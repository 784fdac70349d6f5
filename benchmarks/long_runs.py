"""What grows over 10² to 10⁵ orbits: ``python benchmarks/long_runs.py [--write]``; takes about an hour with --write.

Kepler's problem, e = 0.9, with every method for tight tolerances, plain and with energy and angular momentum held; the
energy of the outer solar system; passages of the periapsis as events. Beside them REBOUND's IAS15 and WHFast, and
heyoka. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from measure import machine, table, write_section
from nonstiff import DAY, MASSES, PROBLEMS
from numpy.typing import NDArray

import invariode as iv

Array = NDArray[np.float64]
Run = Callable[[], Array]  # solves, and returns the final state

PERIOD = 2 * math.pi
TIGHT = 2.5e-14  # rtol and atol of ours: methods but taylor take no less than 100 units of roundoff
METHODS = ("dop853", "ode89", "rkn1210", "taylor")
LONGEST = 120.0  # seconds of one run: no more orbits after that


class Measured(NamedTuple):
    error: float
    seconds: float


# ----------------------------------------------------------------------------------------------------------------------
# Kepler

ECCENTRICITY = 0.9
ORBITS = (100, 1000, 10_000, 100_000)
PERIAPSIS = [1 - ECCENTRICITY, 0.0, 0.0, math.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY))]


def attraction(t, q):
    r2 = q[0] * q[0] + q[1] * q[1]
    r3 = r2 * np.sqrt(r2)
    return [-q[0] / r3, -q[1] / r3]


def kepler(t, y):
    return [y[2], y[3], *attraction(t, y)]


def energy_and_momentum(t, y):
    return [(y[2] * y[2] + y[3] * y[3]) / 2 - 1 / np.sqrt(y[0] * y[0] + y[1] * y[1]), y[0] * y[3] - y[1] * y[2]]


def own_problem(method: str, orbits: float, **options: Any) -> iv.Problem:
    second = iv.METHODS[method].equations == "second-order"
    fun = iv.SecondOrder(iv.compile(attraction)) if second else iv.compile(kepler)
    return iv.Problem(fun, (0, orbits * PERIOD), PERIAPSIS, **options)


def ours(method: str, held: bool) -> Callable[[float], Run]:
    def at(orbits: float) -> Run:
        options = {"invariants": iv.compile(energy_and_momentum)} if held else {}
        problem = own_problem(method, orbits, **options)

        def run() -> Array:
            sol = problem.solve(method, rtol=TIGHT, atol=TIGHT, keep="end", max_steps=10**10, on_failure="raise")
            return sol.y[:, -1]

        return run

    return at


def ias15(orbits: float) -> Run:
    import rebound

    def run() -> Array:
        sim = rebound.Simulation()
        sim.integrator = "ias15"
        sim.add(m=1.0)
        x, y, u, v = PERIAPSIS
        sim.add(m=0.0, x=x, y=y, vx=u, vy=v)
        sim.integrate(orbits * PERIOD)
        planet = sim.particles[1]
        return np.array([planet.x, planet.y, planet.vx, planet.vy])

    return run


def heyoka_kepler(orbits: float) -> Run:
    import heyoka

    x, y, u, v = heyoka.make_vars("x", "y", "u", "v")
    power = (x * x + y * y) ** -1.5
    integrator = heyoka.taylor_adaptive([(x, u), (y, v), (u, -x * power), (v, -y * power)], PERIAPSIS)

    def run() -> Array:
        integrator.time = 0.0
        integrator.state[:] = PERIAPSIS
        integrator.propagate_until(orbits * PERIOD, max_steps=10**10)
        return integrator.state.copy()

    return run


def kepler_contestants() -> dict[str, Callable[[float], Run]]:
    found = {}
    for method in METHODS:
        found[method] = ours(method, held=False)
        found[f"{method}, held"] = ours(method, held=True)
    return found | {"IAS15": ias15, "heyoka": heyoka_kepler}


def measured(at: Callable[[float], Run], orbits: float) -> Measured:
    """The error of the final position, that of the start, and the processor's time after a run that warms up."""
    at(1.0)()
    run = at(orbits)
    begin = process_time()
    end = run()
    return Measured(float(np.hypot(*(end[:2] - PERIAPSIS[:2]))), process_time() - begin)


def kepler_table() -> str:
    rows = []
    for name, at in kepler_contestants().items():
        row, growth = [], []
        for orbits in ORBITS:
            if growth and growth[-1].seconds * 10 > LONGEST:
                break
            growth.append(measured(at, orbits))
            print(name, orbits, *growth[-1], file=sys.stderr)
        row = [f"{one.error:.1e}" for one in growth] + ["–"] * (len(ORBITS) - len(growth))
        exponent = math.log10(growth[-1].error / growth[0].error) / math.log10(ORBITS[len(growth) - 1] / ORBITS[0])
        rows.append([name, *row, f"{exponent:.1f}", f"{growth[-1].seconds / ORBITS[len(growth) - 1] * 1e6:.1f}"])
    header = ["", *(f"{orbits:,} orbits" for orbits in ORBITS), "growth", "µs an orbit"]
    return table(header, rows)


# ----------------------------------------------------------------------------------------------------------------------
# Outer solar system

SOLAR = PROBLEMS["solar-system"]
JUPITER = 4332.59 * DAY  # its period, in the unit of time of nonstiff.py
LOOKS = 16  # at the energy, evenly spaced
STARTS, SEED = 8, 30
#: Orbits of Jupiter, and how many starts.
SOLAR_ORBITS = 100_000


def solar_energy(y: Array) -> float:
    """In extended precision: what is measured is the run's error, not that of the measurement."""
    z = y.astype(np.longdouble)
    q, v = z[:18].reshape(6, 3), z[18:].reshape(6, 3)
    m = np.array(MASSES, dtype=np.longdouble)
    total = (m * (v * v).sum(axis=1)).sum() / 2
    for i in range(6):
        for j in range(i):
            total -= m[i] * m[j] / np.sqrt(((q[i] - q[j]) ** 2).sum())
    return total


def starts() -> Iterator[Array]:
    """The same start with its last bits changed."""
    rng = np.random.default_rng(SEED)
    y0 = np.array(SOLAR.y0)
    for _ in range(STARTS):
        yield y0 * (1 + rng.integers(-4, 5, y0.size) * np.finfo(float).eps)


def solar_times(orbits: float) -> Array:
    return np.linspace(0, orbits * JUPITER, LOOKS + 1)[1:]


def ours_in_space(method: str, orbits: float, y0: Array, rtol: float) -> tuple[Array, int]:
    fun = iv.compile(SOLAR.rhs(lambda s: 1.0 / (s * np.sqrt(s))))
    problem = iv.Problem(fun, (0, orbits * JUPITER), y0)
    sol = problem.solve(
        method, rtol=rtol, atol=rtol, t_eval=solar_times(orbits), keep="outputs", max_steps=10**10, on_failure="raise"
    )
    return sol.y.T, sol.stats.steps


def rebound_in_space(integrator: str, orbits: float, y0: Array) -> tuple[Array, int]:
    import rebound

    sim = rebound.Simulation()
    sim.integrator = integrator
    for m, q, v in zip(MASSES, y0[:18].reshape(6, 3), y0[18:].reshape(6, 3), strict=True):
        sim.add(m=m, x=q[0], y=q[1], z=q[2], vx=v[0], vy=v[1], vz=v[2])
    if integrator == "whfast":
        sim.dt = JUPITER / 100
        sim.integrator.corrector, sim.integrator.safe_mode = 17, 0
    found = []
    for t in solar_times(orbits):
        sim.integrate(t, exact_finish_time=0)
        sim.synchronize()
        found.append([*(x for p in sim.particles for x in p.xyz), *(x for p in sim.particles for x in p.vxyz)])
    return np.array(found), sim.steps_done


def heyoka_in_space(orbits: float, y0: Array) -> tuple[Array, int]:
    import heyoka

    y = heyoka.make_vars(*(f"y{i}" for i in range(36)))
    system = list(zip(y, SOLAR.rhs(lambda s: s**-1.5)(0.0, y), strict=True))
    integrator = heyoka.taylor_adaptive(system, list(y0), tol=1e-18, compact_mode=True)
    found, steps = [], 0
    for t in solar_times(orbits):
        steps += integrator.propagate_until(t, max_steps=10**10)[3]
        found.append(integrator.state.copy())
    return np.array(found), steps


def solar_contestants() -> Mapping[str, Callable[[float, Array], tuple[Array, int]]]:
    return {
        "taylor, 1e-18": lambda orbits, y0: ours_in_space("taylor", orbits, y0, 1e-18),
        "rkn1210": lambda orbits, y0: ours_in_space("rkn1210", orbits, y0, TIGHT),
        "ode89": lambda orbits, y0: ours_in_space("ode89", orbits, y0, TIGHT),
        "heyoka, 1e-18": heyoka_in_space,
        "IAS15": lambda orbits, y0: rebound_in_space("ias15", orbits, y0),
        "WHFast, 100 steps an orbit": lambda orbits, y0: rebound_in_space("whfast", orbits, y0),
    }


def solar_table(orbits: float) -> str:
    rows = []
    for name, solve in solar_contestants().items():
        errors, seconds, steps = [], [], 0
        for y0 in starts():
            begin = process_time()
            found, steps = solve(orbits, y0)
            seconds.append(process_time() - begin)
            initial = solar_energy(y0)
            errors.append([float((solar_energy(y) - initial) / initial) for y in found])
            if seconds[0] > LONGEST:  # one start only
                break
        deviations = np.array(errors)
        rms = math.sqrt(np.mean(deviations[:, -1] ** 2))
        walk = 1.1e-16 * math.sqrt(steps)
        slopes = deviations @ np.arange(1, LOOKS + 1) / (np.arange(1, LOOKS + 1) ** 2).sum()
        trend = abs(slopes.mean()) / (slopes.std(ddof=1) / math.sqrt(len(slopes))) if len(slopes) > 1 else math.nan
        print(name, rms, walk, trend, seconds, steps, file=sys.stderr)
        row = [f"{len(errors)}", f"{steps:,}", f"{rms:.1e}", f"{rms / walk:.2f}", f"{trend:.1f}"]
        rows.append([name, *row, f"{min(seconds) / orbits * 1e6:.0f}"])
    return table(
        ["", "starts", "steps", "RMS error of the energy", "in 1.1e-16 √steps", "trend, σ", "µs an orbit"], rows
    )


# ----------------------------------------------------------------------------------------------------------------------
# Passages of the periapsis

PASSAGES = 10_000


def radial(t, y):
    return y[0] * y[2] + y[1] * y[3]


def passages_table() -> str:
    rows = []
    for method in METHODS:
        problem = own_problem(
            method,
            PASSAGES + 0.5,
            invariants=iv.compile(energy_and_momentum),
            events=iv.Event(iv.compile(radial), direction=1),
        )
        begin = process_time()
        sol = problem.solve(method, rtol=1e-13, atol=1e-13, keep="end", max_steps=10**10, on_failure="raise")
        seconds = process_time() - begin
        times = sol.t_events[0]
        times = times[times > 1]
        late = times - PERIOD * np.arange(1, len(times) + 1)
        print(method, len(times), np.abs(late).max(), seconds, file=sys.stderr)
        rows.append([method, f"{len(times):,}", f"{np.abs(late).max():.1e}", f"{seconds:.2f}"])
    return table(["", f"passages of {PASSAGES:,}", "largest error of the time", "s"], rows)


# ----------------------------------------------------------------------------------------------------------------------


def report() -> str:
    return "\n\n".join([
        machine("invariode", "rebound", "heyoka", "numpy") + f". rtol = atol = {TIGHT:g} unless said.",
        f"Kepler's problem, e = {ECCENTRICITY}: error of the position at the periapsis.",
        kepler_table(),
        f"Outer solar system, {SOLAR_ORBITS:,} orbits of Jupiter, plain runs.",
        solar_table(SOLAR_ORBITS),
        "Passages of the periapsis as events, energy and angular momentum held, rtol 1e-13.",
        passages_table(),
    ])  # fmt: skip


if __name__ == "__main__":
    text = report()
    print(text)
    if "--write" in sys.argv:
        write_section("long_runs", text)
