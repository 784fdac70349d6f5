"""What grows over 10² to 10⁵ orbits: ``python benchmarks/long_runs.py [--write]``; takes about ten minutes.

Kepler's problem, e = 0.9, with every method for tight tolerances, plain and with energy and angular momentum held; the
energy of the outer solar system; passages of the periapsis as events. Beside them REBOUND's IAS15 and WHFast, and
heyoka. ``--write`` puts the tables into docs/benchmarks. Times are those of the processor.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from measure import machine, table, write_section
from nonstiff import DAY, MASSES, PROBLEMS
from numpy.typing import NDArray

import invariode as iv

Array = NDArray[np.float64]
#: From y0 over a time: the final state.
Run = Callable[[Array, float], Array]

PERIOD = 2 * math.pi
#: rtol and atol. Methods but taylor and heyoka take no less than 100 units of roundoff; these two can make steps whose
#: truncation error is far below roundoff.
METHODS = {"dop853": 2.5e-14, "ode89": 2.5e-14, "rkn1210": 2.5e-14, "taylor": 1e-18}
TIGHTEST = METHODS["taylor"]


class Measured(NamedTuple):
    error: float  # of the final position: the root mean square over the starts
    seconds: float  # of a run


# ----------------------------------------------------------------------------------------------------------------------
# Kepler, from the apoapsis, where energy and momentum are sums without cancellation, to a periapsis, where an error of
# the phase is largest

ECCENTRICITY = 0.9
APOAPSIS = np.array([-1 - ECCENTRICITY, 0.0, 0.0, -math.sqrt((1 - ECCENTRICITY) / (1 + ECCENTRICITY))])
#: Whole orbits, and how many starts: the same orbit in other directions.
ORBITS = {100: 8, 1000: 8, 10_000: 4, 100_000: 1}
SEED = 30
TURN = 2 * np.longdouble("3.14159265358979323846264338327950288")


def directions() -> list[Array]:
    """The start in other directions."""
    found = []
    for angle in np.random.default_rng(SEED).uniform(0, 2 * math.pi, max(ORBITS.values())):
        c, s = math.cos(angle), math.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        found.append(np.concatenate([turn @ APOAPSIS[:2], turn @ APOAPSIS[2:]]))
    return found


def position(y0: Array, t: float) -> Array:
    """After t, by Kepler's equation in extended precision: that y0 and t are rounded is no error of a run."""
    y = y0.astype(np.longdouble)
    q, v = y[:2], y[2:]
    r = np.sqrt(q @ q)
    a = 1 / (2 / r - v @ v)
    unit = a * np.sqrt(a)  # of time
    cosine, sine = 1 - r / a, q @ v / np.sqrt(a)  # e cos E and e sin E at the start
    mean = np.fmod(t / unit, TURN)
    x = mean  # by how much E has grown; about half a turn, like the mean anomaly
    for _ in range(20):
        x -= (x - cosine * np.sin(x) + sine * (1 - np.cos(x)) - mean) / (1 - cosine * np.cos(x) + sine * np.sin(x))
    f, g = 1 - a / r * (1 - np.cos(x)), unit * (mean - x + np.sin(x))
    return f * q + g * v


def attraction(t, q):
    r2 = q[0] * q[0] + q[1] * q[1]
    r3 = r2 * np.sqrt(r2)
    return [-q[0] / r3, -q[1] / r3]


def kepler(t, y):
    return [y[2], y[3], *attraction(t, y)]


def energy_and_momentum(t, y):
    return [(y[2] * y[2] + y[3] * y[3]) / 2 - 1 / np.sqrt(y[0] * y[0] + y[1] * y[1]), y[0] * y[3] - y[1] * y[2]]


def own_problem(method: str, t: float, y0: Array, **options: Any) -> iv.Problem:
    second = iv.METHODS[method].equations == "second-order"
    fun = iv.SecondOrder(iv.compile(attraction)) if second else iv.compile(kepler)
    return iv.Problem(fun, (0, t), y0, **options)


def ours(method: str, held: bool, y0: Array, t: float) -> Array:
    options = {"invariants": iv.compile(energy_and_momentum)} if held else {}
    tolerance = METHODS[method]
    sol = own_problem(method, t, y0, **options).solve(
        method, rtol=tolerance, atol=tolerance, keep="end", max_steps=10**10, on_failure="raise"
    )
    return sol.y[:, -1]


def ias15(y0: Array, t: float) -> Array:
    import rebound

    sim = rebound.Simulation()
    sim.integrator = "ias15"
    sim.add(m=1.0)
    x, y, u, v = y0
    sim.add(m=0.0, x=x, y=y, vx=u, vy=v)
    sim.integrate(t)
    planet = sim.particles[1]
    return np.array([planet.x, planet.y, planet.vx, planet.vy])


def with_heyoka(high_accuracy: bool) -> Run:
    import heyoka

    x, y, u, v = heyoka.make_vars("x", "y", "u", "v")
    power = (x * x + y * y) ** -1.5
    integrator = heyoka.taylor_adaptive(
        [(x, u), (y, v), (u, -x * power), (v, -y * power)], APOAPSIS, tol=TIGHTEST, high_accuracy=high_accuracy
    )

    def run(y0: Array, t: float) -> Array:
        integrator.time = 0.0
        integrator.state[:] = y0
        integrator.propagate_until(t, max_steps=10**10)
        return integrator.state.copy()

    return run


def kepler_contestants() -> dict[str, Run]:
    found: dict[str, Run] = {}
    for method in METHODS:
        found[method] = partial(ours, method, False)
        found[f"{method}, held"] = partial(ours, method, True)
    return found | {"IAS15": ias15, "heyoka": with_heyoka(False), "heyoka, high_accuracy": with_heyoka(True)}


def measured(run: Run, orbits: int) -> Measured:
    t = (orbits + 0.5) * PERIOD
    errors, seconds = [], []
    for y0 in directions()[: ORBITS[orbits]]:
        begin = process_time()
        end = run(y0, t)
        seconds.append(process_time() - begin)
        errors.append(float(np.hypot(*(end[:2] - position(y0, t)))))
    return Measured(math.sqrt(np.mean(np.square(errors))), min(seconds))


def kepler_table() -> str:
    rows = []
    for name, run in kepler_contestants().items():
        run(APOAPSIS, PERIOD)  # compiles
        growth = [measured(run, orbits) for orbits in ORBITS]
        print(name, *growth, file=sys.stderr, flush=True)
        exponent = np.polyfit(np.log([*ORBITS]), np.log([one.error for one in growth]), 1)[0]
        microseconds = growth[-1].seconds / max(ORBITS) * 1e6
        rows.append([name, *(f"{one.error:.1e}" for one in growth), f"{exponent:.1f}", f"{microseconds:.0f}"])
    return table(["", *(f"{orbits:,} orbits" for orbits in ORBITS), "growth", "µs an orbit"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# Outer solar system

SOLAR = PROBLEMS["solar-system"]
JUPITER = 4332.59 * DAY  # its period, in the unit of time of nonstiff.py
LOOKS = 16  # at the energy, evenly spaced
STARTS = 8
SOLAR_ORBITS = 10_000  # of Jupiter
#: Of the run that is to be a random walk.
MORE_ORBITS = 100_000


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


def barycentric(y: Array) -> Array:
    """Relative to the center of mass: with the sun at rest the system moves away, and its positions lose digits."""
    m = np.array(MASSES)
    bodies = y.reshape(2, len(m), 3)
    return (bodies - (m[:, None] * bodies).sum(axis=1, keepdims=True) / m.sum()).ravel()


def starts() -> Iterator[Array]:
    """The same start with its last bits changed."""
    rng = np.random.default_rng(SEED)
    y0 = barycentric(np.array(SOLAR.y0))
    for _ in range(STARTS):
        yield y0 * (1 + rng.integers(-4, 5, y0.size) * np.finfo(float).eps)


def solar_times(orbits: float) -> Array:
    return np.linspace(0, orbits * JUPITER, LOOKS + 1)[1:]


def ours_in_space(method: str, orbits: float, y0: Array, rtol: float) -> tuple[Array, int]:
    fun = iv.compile(SOLAR.rhs(lambda s: 1.0 / (s * np.sqrt(s))))
    second = iv.METHODS[method].equations == "second-order"
    problem = iv.Problem(fun, (0, orbits * JUPITER), y0, second_order=second)
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


Contestant = Callable[[float, Array], tuple[Array, int]]


def solar_contestants() -> Mapping[str, Contestant]:
    found: dict[str, Contestant] = {
        method: lambda orbits, y0, method=method: ours_in_space(method, orbits, y0, METHODS[method])
        for method in METHODS
    }
    return found | {
        "heyoka": heyoka_in_space,
        "IAS15": lambda orbits, y0: rebound_in_space("ias15", orbits, y0),
        "WHFast, 100 steps an orbit": lambda orbits, y0: rebound_in_space("whfast", orbits, y0),
    }


def deviations(name: str, solve: Contestant, orbits: int) -> list[str]:
    """A row of the table: how the energies of all starts deviate."""
    errors, seconds, steps = [], [], 0
    solve(1.0, barycentric(np.array(SOLAR.y0)))  # compiles
    for y0 in starts():
        begin = process_time()
        found, steps = solve(orbits, y0)
        seconds.append(process_time() - begin)
        initial = solar_energy(y0)
        errors.append([float((solar_energy(y) - initial) / initial) for y in found])
    looks = np.arange(1, LOOKS + 1)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    walk = 1.1e-16 * math.sqrt(steps)
    growth = np.polyfit(np.log(looks), np.log(rms), 1)[0]
    slopes = np.array(errors) @ looks / (looks @ looks)
    trend = abs(slopes.mean()) / (slopes.std(ddof=1) / math.sqrt(len(slopes)))
    cells = [f"{orbits:,}", f"{steps:,}", f"{rms[-1]:.1e}", f"{rms[-1] / walk:.2f}", f"{growth:.1f}", f"{trend:.1f}"]
    print(name, cells, rms, seconds, file=sys.stderr, flush=True)
    return [name, *cells, f"{min(seconds) / orbits * 1e6:.0f}"]


def solar_table() -> str:
    contestants = solar_contestants()
    rows = [deviations(name, solve, SOLAR_ORBITS) for name, solve in contestants.items()]
    rows.append(deviations("taylor", contestants["taylor"], MORE_ORBITS))
    header = [
        "",
        "orbits",
        "steps",
        "RMS error of the energy",
        "in 1.1e-16 √steps",
        "growth",
        "trend, σ",
        "µs an orbit",
    ]
    return table(header, rows)


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
            (PASSAGES + 0.25) * PERIOD,
            APOAPSIS,
            invariants=iv.compile(energy_and_momentum),
            events=iv.Event(iv.compile(radial), direction=1),
        )
        begin = process_time()
        sol = problem.solve(method, rtol=1e-13, atol=1e-13, keep="end", max_steps=10**10, on_failure="raise")
        seconds = process_time() - begin
        times = sol.t_events[0]
        late = times - PERIOD * (np.arange(len(times)) + 0.5)
        print(method, len(times), np.abs(late).max(), seconds, file=sys.stderr)
        rows.append([method, f"{len(times):,}", f"{np.abs(late).max():.1e}", f"{seconds:.2f}"])
    return table(["", f"passages of {PASSAGES:,}", "largest error of the time", "s"], rows)


# ----------------------------------------------------------------------------------------------------------------------


def report() -> str:
    return "\n\n".join([
        machine("invariode", "rebound", "heyoka", "numpy")
        + f". rtol = atol = {METHODS['ode89']:g}, but {TIGHTEST:g} in taylor and heyoka.",
        f"Kepler's problem, e = {ECCENTRICITY}: error of the position at the periapsis, the root mean square over "
        f"{', '.join(map(str, ORBITS.values()))} directions of the orbit.",
        kepler_table(),
        f"Outer solar system, barycentric, plain runs, {STARTS} starts that differ in the last bits.",
        solar_table(),
        "Passages of the periapsis as events, energy and angular momentum held, rtol = atol = 1e-13.",
        passages_table(),
    ])  # fmt: skip


if __name__ == "__main__":
    text = report()
    print(text)
    if "--write" in sys.argv:
        write_section("long_runs", text)
