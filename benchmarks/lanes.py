"""Ensembles side by side in vector registers against one at a time: ``python benchmarks/lanes.py [--write]``.

Final states unless the case says more, one thread, ode45 unless the case names another method, rtol = atol = 1e-6; the
times are of the process's CPU clock, ``lanes=1`` and each instruction set in turn. Before anything is timed all results
must be the same bits. Compilation is not timed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from statistics import median
from time import process_time
from typing import Any, Literal

import numpy as np
from measure import interleaved, machine, ratio, run, table
from numpy.typing import NDArray

import invariode as iv
from invariode import _core
from invariode._functions import lanes

Array = NDArray[np.float64]
TOLERANCE = 1e-6
LONGEST = 100.0  # how much longer the dearest of trajectories of unequal cost is


def lotka_volterra(t: float, y: Any, p: Any) -> Any:
    return p[0] * y[0] - y[0] * y[1], y[0] * y[1] - y[1]


def first_integral(t: float, y: Any, p: Any) -> Any:
    """Of `lotka_volterra`."""
    return y[0] - math.log(y[0]) + y[1] - p[0] * math.log(y[1])


def first_integral_slope(t: float, y: Any, p: Any) -> Any:
    return 1.0 - 1.0 / y[0], 1.0 - p[0] / y[1]


def predators(t: float, y: Any, a: float, b: float, c: float, d: float) -> Any:
    return a * y[0] - b * y[0] * y[1], d * y[0] * y[1] - c * y[1]


def law_of_predators(t: float, y: Any, a: float, b: float, c: float, d: float) -> Any:
    return d * y[0] - c * math.log(y[0]) + b * y[1] - a * math.log(y[1])


def slowed(t: float, y: Any, p: Any) -> Any:
    return p[1] * (p[0] * y[0] - y[0] * y[1]), p[1] * (y[0] * y[1] - y[1])


def henon_heiles(t: float, y: Any, p: Any) -> Any:
    return y[2], y[3], -y[0] - 2.0 * p[0] * y[0] * y[1], -y[1] - p[0] * (y[0] * y[0] - y[1] * y[1])


def energy(t: float, y: Any, p: Any) -> Any:
    """Of `henon_heiles`."""
    quadratic = 0.5 * (y[2] * y[2] + y[3] * y[3] + y[0] * y[0] + y[1] * y[1])
    return quadratic + p[0] * y[1] * (y[0] * y[0] - y[1] * y[1] / 3.0)


def energy_slope(t: float, y: Any, p: Any) -> Any:
    return y[0] + 2.0 * p[0] * y[0] * y[1], y[1] + p[0] * (y[0] * y[0] - y[1] * y[1]), y[2], y[3]


def three_bodies(t: float, y: Any, p: Any) -> Any:
    """In the plane, with masses 1, 1 and p[0]: positions, then velocities."""
    ax, ay, bx, by, cx, cy = y[2] - y[0], y[3] - y[1], y[4] - y[0], y[5] - y[1], y[4] - y[2], y[5] - y[3]
    a2, b2, c2 = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    a, b, c = 1.0 / (a2 * math.sqrt(a2)), 1.0 / (b2 * math.sqrt(b2)), 1.0 / (c2 * math.sqrt(c2))
    m = p[0]
    return (
        y[6],
        y[7],
        y[8],
        y[9],
        y[10],
        y[11],
        a * ax + m * b * bx,
        a * ay + m * b * by,
        m * c * cx - a * ax,
        m * c * cy - a * ay,
        -b * bx - c * cx,
        -b * by - c * cy,
    )


def kepler(t: float, y: Any, p: Any) -> Any:
    pull = p[0] * (y[0] * y[0] + y[1] * y[1]) ** -1.5
    return y[2], y[3], -pull * y[0], -pull * y[1]


def throw(t: float, y: Any, p: Any) -> Any:
    """Height and speed, with the drag of the air."""
    return y[1], -9.81 - 0.02 * p[0] * y[1] * abs(y[1])


def height(t: float, y: Any, p: Any) -> Any:
    return y[0]


def pendulum(t: float, y: Any, p: Any) -> Any:
    return y[1], -p[0] * math.sin(y[0])


def axon(t: float, y: Any, p: Any) -> Any:
    """Hodgkin and Huxley's, with the current p[0]: voltage in mV, gates m, h and n."""
    v, m, h, n = y[0], y[1], y[2], y[3]
    rising_m, falling_m = 0.1 * (v + 40.0) / (1.0 - math.exp(-(v + 40.0) / 10.0)), 4.0 * math.exp(-(v + 65.0) / 18.0)
    rising_h, falling_h = 0.07 * math.exp(-(v + 65.0) / 20.0), 1.0 / (1.0 + math.exp(-(v + 35.0) / 10.0))
    rising_n, falling_n = 0.01 * (v + 55.0) / (1.0 - math.exp(-(v + 55.0) / 10.0)), 0.125 * math.exp(-(v + 65.0) / 80.0)
    return (
        p[0] - 120.0 * m * m * m * h * (v - 50.0) - 36.0 * n * n * n * n * (v + 77.0) - 0.3 * (v + 54.4),
        rising_m * (1.0 - m) - falling_m * m,
        rising_h * (1.0 - h) - falling_h * h,
        rising_n * (1.0 - n) - falling_n * n,
    )


@dataclass(frozen=True)
class Case:
    """Functions to solve, on (0, span), from y0 with args: made for N trajectories."""

    name: str
    fun: Callable[..., Any]
    span: float
    rows: Callable[[int], tuple[Array, Array]]
    size: int
    elementary: Literal["own", "libm"] = "own"
    held: tuple[Callable[..., Any], ...] | None = None  # an invariant, and its Jacobian if it is given
    outputs: int = 0  # times at which y is put out
    ends: Callable[..., Any] | None = None  # a terminal event
    method: str = "ode45"
    varied: bool = False  # with the sensitivities to all arguments

    def options(self) -> dict[str, Any]:
        """Of the solve."""
        options: dict[str, Any] = {"method": self.method}
        if self.varied:
            options["sensitivities"] = True
        if self.held is not None:
            options["invariants"] = iv.Invariants(*map(iv.compile, self.held), names="held")
        if self.outputs:
            options["t_eval"] = np.linspace(0, self.span, self.outputs)
        if self.ends is not None:
            options["events"] = iv.Event(iv.compile(self.ends), terminal=True)
        return options


def populations(size: int) -> tuple[Array, Array]:
    numbers = np.random.default_rng(2024).uniform(size=(size, 3))
    return 0.5 + 2.5 * numbers[:, :2], 0.5 + numbers[:, 2:]


def unequal(size: int) -> tuple[Array, Array]:
    y0, p = populations(size)
    return y0, np.column_stack([p, np.geomspace(LONGEST, 1.0, size)])


def around(point: list[float], spread: float, size: int) -> tuple[Array, Array]:
    random = np.random.default_rng(2024)
    return np.array(point) + random.uniform(-spread, spread, (size, len(point))), random.uniform(0.9, 1.1, (size, 1))


def rates(size: int) -> tuple[Array, Array]:
    numbers = np.random.default_rng(2024).uniform(size=(size, 6))
    return 0.5 + 2.5 * numbers[:, :2], 0.5 + numbers[:, 2:]


def currents(size: int) -> tuple[Array, Array]:
    return np.tile([-65.0, 0.05, 0.6, 0.32], (size, 1)), np.linspace(5.0, 15.0, size)[:, None]


BODIES = [1.0, 0.0, -0.5, 0.9, -0.5, -0.9, 0.0, 0.7, -0.6, -0.35, 0.6, -0.35]
#: How many lanes each instruction set has.
SETS = dict(_core.instruction_sets())

CASES = [
    Case("Lotka–Volterra", lotka_volterra, 10.0, populations, 10000),
    Case(f"the same, costs unequal by {LONGEST:.0f}", slowed, 10.0, unequal, 1000),
    Case("Hénon–Heiles", henon_heiles, 20.0, partial(around, [0.1, 0.1, 0.3, 0.1], 0.05), 5000),
    Case("three bodies, n = 12", three_bodies, 5.0, partial(around, BODIES, 0.02), 2000),
    Case("Kepler (x^-1.5)", kepler, 10.0, partial(around, [1.0, 0.0, 0.0, 0.9], 0.1), 5000),
    Case("the same, libm's pow", kepler, 10.0, partial(around, [1.0, 0.0, 0.0, 0.9], 0.1), 5000, "libm"),
    Case("pendulum (sin)", pendulum, 20.0, partial(around, [1.0, 0.5], 0.4), 5000),
    Case("the same, libm's sin", pendulum, 20.0, partial(around, [1.0, 0.5], 0.4), 5000, "libm"),
    Case("Hodgkin–Huxley (six exp)", axon, 20.0, currents, 2000),
    Case("the same, libm's exp", axon, 20.0, currents, 2000, "libm"),
    Case(
        "Hénon–Heiles, energy held",
        henon_heiles,
        20.0,
        partial(around, [0.1, 0.1, 0.3, 0.1], 0.05),
        3000,
        held=(energy, energy_slope),
    ),
    Case(
        "Lotka–Volterra, first integral held (log)",
        lotka_volterra,
        10.0,
        populations,
        5000,
        held=(first_integral, first_integral_slope),
    ),
    Case("Lotka–Volterra, 101 output times", lotka_volterra, 10.0, populations, 5000, outputs=101),
    Case(
        "Hénon–Heiles, energy held, 101 output times",
        henon_heiles,
        20.0,
        partial(around, [0.1, 0.1, 0.3, 0.1], 0.05),
        2000,
        held=(energy, energy_slope),
        outputs=101,
    ),
    Case("a throw to the ground, terminal event", throw, 5.0, partial(around, [1.0, 10.0], 0.5), 10000, ends=height),
    Case(
        "Hénon–Heiles to x = 0, terminal event",
        henon_heiles,
        20.0,
        partial(around, [0.1, 0.1, 0.3, 0.1], 0.05),
        5000,
        ends=height,
    ),
    Case("Lotka–Volterra, four parameters", predators, 10.0, rates, 4096),
    Case("the same, with sensitivities", predators, 10.0, rates, 4096, varied=True),
    Case("the same, first integral held", predators, 10.0, rates, 4096, held=(law_of_predators,), varied=True),
    Case("four parameters, dop853", predators, 10.0, rates, 4096, method="dop853"),
    Case("the same, with sensitivities", predators, 10.0, rates, 4096, method="dop853", varied=True),
]


def measured(case: Case, repetitions: int) -> list[str]:
    """A row of the table: rate one at a time, and how many times that each instruction set gives."""
    y0, p = case.rows(case.size)
    fun = iv.compile(case.fun, elementary=case.elementary)
    options = {"args": p, "rtol": TOLERANCE, "atol": TOLERANCE, "workers": 1, **case.options()}
    solve = partial(iv.solve_ensemble, fun, (0, case.span), y0, **options)
    alone = solve(lanes=1)

    def in_lanes(name: str) -> iv.EnsembleSolution:
        lanes.FORCED = name
        return solve()

    contestants: dict[str, Callable[[], object]] = {"alone": partial(solve, lanes=1)}
    for name, width in SETS.items():
        found = in_lanes(name)
        if not found.stats.lanes.startswith(f"{width} lanes"):
            raise SystemExit(f"not timed: {case.name} was solved {found.stats.lanes}")
        if (
            not np.array_equal(found.y_end, alone.y_end)
            or not np.array_equal(found.y, alone.y)
            or (case.varied and not np.array_equal(found.sensitivities, alone.sensitivities))
            or not alone.success.all()
        ):
            raise SystemExit(f"not timed: the results of {case.name} are not the same")
        contestants[name] = partial(in_lanes, name)
    times = interleaved(contestants, repetitions, process_time)
    rate = f"{case.size / median(times['alone']):,.0f}"
    return [case.name, rate, *(f"{ratio(times['alone'], times[name]):.1f}" for name in SETS)]


#: Of ensembles with an event: a problem of `CASES`, and an event without and one with occurrences.
WATCHED: dict[str, tuple[str, dict[str, Callable[..., Any]]]] = {
    "Lotka–Volterra": ("ode45", {"never": lambda t, y, p: y[0] + 1.0, "y = 1": lambda t, y, p: y[0] - 1.0}),
    "Hénon–Heiles": ("ode45", {"never": lambda t, y, p: y[0] + 5.0, "x = 0": lambda t, y, p: y[0]}),
    "four parameters, dop853": (
        "dop853",
        {"never": lambda t, y, *p: y[0] + 1.0, "y = 1": lambda t, y, *p: y[0] - 1.0},
    ),
}


def watched(name: str, repetitions: int) -> list[list[str]]:
    """Rows of the table of events: how often one occurs, and how much longer an ensemble takes with it."""
    case = next(one for one in CASES if one.name == name)
    method, events = WATCHED[name]
    y0, p = case.rows(case.size)
    options = {"method": method, "args": p, "rtol": TOLERANCE, "atol": TOLERANCE, "workers": 1}
    solve = partial(iv.solve_ensemble, iv.compile(case.fun), (0, case.span), y0, **options)
    lanes.FORCED = None
    with_event = {what: partial(solve, events=iv.compile(one)) for what, one in events.items()}
    contestants: dict[str, Callable[[], object]] = {"lanes": solve, "alone": partial(solve, lanes=1)}
    for what, run_it in with_event.items():
        contestants |= {f"lanes {what}": run_it, f"alone {what}": partial(run_it, lanes=1)}
    times = interleaved(contestants, repetitions, process_time)
    return [
        [
            f"{name}: {what}",
            f"{len(run_it().events[0].t) / case.size:.1f}",
            *(f"{ratio(times[f'{where} {what}'], times[where]):.1f}" for where in ("lanes", "alone")),
            f"{ratio(times[f'alone {what}'], times[f'lanes {what}']):.1f}",
        ]
        for what, run_it in with_event.items()
    ]


def report(repetitions: int) -> str:
    header = ["ode45, 1e-6", "one at a time, per second", *(f"× with {name}" for name in SETS)]
    rows = [measured(case, repetitions) for case in CASES]
    counted = [row for name in WATCHED for row in watched(name, repetitions)]
    columns = ["an event", "occurrences a trajectory", "÷ none, lanes", "÷ none, one at a time", "× with lanes"]
    tables = f"{table(header, rows)}\n\n{table(columns, counted)}"
    return f"{machine('invariode', 'numpy', 'numba')}. Medians of {repetitions}.\n\n{tables}"


if __name__ == "__main__":
    run("lanes", __doc__, report, repetitions=9)
