"""What a solve costs beyond the user's own functions: ``python benchmarks/overhead.py [--write]``, or ``make bench``.

All figures of a table are of one interleaved run with the garbage collector off. Before anything is timed, its final
state is compared with a reference. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import repeat
from statistics import median
from time import process_time
from typing import Any

import numpy as np
import scipy.integrate
from measure import Times, installed, interleaved, machine, ratio, spread, table, write_section
from numpy.typing import NDArray

import invariode as iv
from invariode.problems import MU, MU_STAR, PERIOD, START

try:
    from CyRK import pysolve_ivp  # type: ignore[import-untyped]  # CyRK ships no types
except ImportError:
    pysolve_ivp = None

Array = NDArray[np.float64]
Function = Callable[..., Any]

REPETITIONS = 15
RTOL = 1e-8
TOLERANCES = (1e-7, 10**-7.5, 1e-8, 10**-8.5, 1e-9)  # for the times at equal error
EQUAL_ERROR = 1e-6
US, MS = 1e-6, 1e-3
MANY = 400  # components

# ----------------------------------------------------------------------------------------------------------------------
# Problems, written out in each of the forms that are compared. Those of CyRK write into dy, which its documentation
# recommends for speed (`pass_dy_as_arg`).


def lotka_volterra(t: float, y: Array) -> list[float]:
    x, y_ = y
    return [2.0 * x * (1.0 - y_), -y_ * (1.0 - x)]


def lotka_volterra_into(dy: Array, t: float, y: Array) -> None:
    x, y_ = y
    dy[0] = 2.0 * x * (1.0 - y_)
    dy[1] = -y_ * (1.0 - x)


def lotka_volterra_floats(t: float, y: Array) -> list[float]:
    x, y_ = y.tolist()
    return [2.0 * x * (1.0 - y_), -y_ * (1.0 - x)]


def lotka_volterra_floats_into(dy: Array, t: float, y: Array) -> None:
    x, y_ = y.tolist()
    dy[0] = 2.0 * x * (1.0 - y_)
    dy[1] = -y_ * (1.0 - x)


def lotka_volterra_array(t: float, y: Array) -> Array:
    x, y_ = y
    return np.array([2.0 * x * (1.0 - y_), -y_ * (1.0 - x)])


def lotka_volterra_invariant(t: float, y: Array) -> float:
    x, y_ = y
    return float(x - math.log(x) + 2.0 * (y_ - math.log(y_)))


def lotka_volterra_gradient(t: float, y: Array) -> list[float]:
    x, y_ = y
    return [1.0 - 1.0 / x, 2.0 - 2.0 / y_]


def three_body(t: float, y: Array) -> list[float]:
    x, z, u, v = y
    r1 = ((x + MU) ** 2 + z * z) ** 1.5
    r2 = ((x - MU_STAR) ** 2 + z * z) ** 1.5
    return [
        u,
        v,
        2.0 * v + x - MU_STAR * (x + MU) / r1 - MU * (x - MU_STAR) / r2,
        -2.0 * u + z - MU_STAR * z / r1 - MU * z / r2,
    ]


def three_body_into(dy: Array, t: float, y: Array) -> None:
    x, z, u, v = y
    r1 = ((x + MU) ** 2 + z * z) ** 1.5
    r2 = ((x - MU_STAR) ** 2 + z * z) ** 1.5
    dy[0] = u
    dy[1] = v
    dy[2] = 2.0 * v + x - MU_STAR * (x + MU) / r1 - MU * (x - MU_STAR) / r2
    dy[3] = -2.0 * u + z - MU_STAR * z / r1 - MU * z / r2


def jacobi_integral(t: float, y: Array) -> float:
    x, z, u, v = y
    r1 = ((x + MU) ** 2 + z * z) ** 0.5
    r2 = ((x - MU_STAR) ** 2 + z * z) ** 0.5
    return float((u * u + v * v - x * x - z * z) / 2.0 - MU_STAR / r1 - MU / r2)


def jacobi_gradient(t: float, y: Array) -> list[float]:
    x, z, u, v = y
    r1 = ((x + MU) ** 2 + z * z) ** 1.5
    r2 = ((x - MU_STAR) ** 2 + z * z) ** 1.5
    return [-x + MU_STAR * (x + MU) / r1 + MU * (x - MU_STAR) / r2, -z + MU_STAR * z / r1 + MU * z / r2, u, v]


def volterra_lattice(n: int) -> tuple[Function, Function, Function]:
    """y_i' = y_i (y_{i+1} - y_{i-1}), periodic, with NumPy's vector operations."""
    up, down = (np.arange(n) + 1) % n, (np.arange(n) - 1) % n

    def f(t: float, y: Array) -> Array:
        return y * (y[up] - y[down])

    def f_into(dy: Array, t: float, y: Array) -> None:
        np.multiply(y, y[up] - y[down], out=dy)

    def filling(t: float, y: Array, out: Array) -> None:
        np.multiply(y, y[up] - y[down], out=out)

    return f, f_into, filling


@dataclass(frozen=True)
class Case:
    """A problem as each solver likes it best."""

    name: str
    f: Function
    f_into: Function
    span: tuple[float, float]
    y0: Array
    filling: Function | None = None  # (t, y, out), for `inplace=True`
    reference: Array = field(init=False)

    def __post_init__(self) -> None:
        tight = scipy.integrate.solve_ivp(self.f, self.span, self.y0, method="DOP853", rtol=3e-14, atol=1e-14)
        object.__setattr__(self, "reference", tight.y[:, -1])

    def error(self, y: Array) -> float:
        return float(np.abs(y - self.reference).max())


def lattice_case(n: int, end: float, inplace: bool = False) -> Case:
    f, f_into, filling = volterra_lattice(n)
    y0 = 1.0 + 0.5 * np.sin(2 * np.pi * np.arange(n) / n)
    name = f"NumPy vector operations, n = {n}{', inplace=True' * inplace}"
    return Case(name, f, f_into, (0.0, end), y0, filling if inplace else None)


# ----------------------------------------------------------------------------------------------------------------------
# Solvers


@dataclass(frozen=True)
class Outcome:
    """A solver's run: how to repeat it, and what it did."""

    run: Callable[[], object]
    alone: Callable[[], object]  # the same number of calls of f, and nothing else
    steps: int
    calls: int
    error: float


def call(f: Function, count: int, y: Array) -> Callable[[], None]:
    """So many calls of f(t, y) from Python, and nothing else."""

    def loop() -> None:
        for _ in repeat(None, count):
            f(0.5, y)

    return loop


def call_filling(f: Function, count: int, y: Array) -> Callable[[], None]:
    out = np.empty_like(y)

    def loop() -> None:
        for _ in repeat(None, count):
            f(0.5, y, out)

    return loop


def call_into(f: Function, count: int, y: Array) -> Callable[[], None]:
    dy = np.empty_like(y)

    def loop() -> None:
        for _ in repeat(None, count):
            f(dy, 0.5, y)

    return loop


def with_invariode(case: Case, rtol: float = RTOL) -> Outcome:
    fills = case.filling is not None
    run = partial(
        iv.solve_ivp, case.filling or case.f, case.span, case.y0, "ode45", rtol=rtol, atol=rtol, inplace=fills
    )
    sol = run()
    y = sol.y[:, -1].copy()
    alone = call(case.f, sol.nfev, y) if case.filling is None else call_filling(case.filling, sol.nfev, y)
    return Outcome(run, alone, sol.stats.steps, sol.nfev, case.error(y))


def with_scipy(case: Case, rtol: float = RTOL) -> Outcome:
    run = partial(scipy.integrate.solve_ivp, case.f, case.span, case.y0, method="RK45", rtol=rtol, atol=rtol)
    sol = run()
    return Outcome(run, call(case.f, sol.nfev, sol.y[:, -1].copy()), len(sol.t) - 1, sol.nfev, case.error(sol.y[:, -1]))


def with_cyrk(case: Case, rtol: float = RTOL) -> Outcome:
    solve = partial(
        pysolve_ivp, time_span=case.span, y0=case.y0, method="RK45", rtol=rtol, atol=rtol, pass_dy_as_arg=True
    )
    calls = 0

    def counting(dy: Array, t: float, y: Array) -> None:
        nonlocal calls
        calls += 1
        case.f_into(dy, t, y)

    sol = solve(counting)
    y = np.array(sol.y[:, -1])
    return Outcome(partial(solve, case.f_into), call_into(case.f_into, calls, y), len(sol.t) - 1, calls, case.error(y))


SOLVERS: dict[str, Callable[..., Outcome]] = {"invariode ode45": with_invariode, "SciPy RK45": with_scipy}
if pysolve_ivp is not None:
    SOLVERS["CyRK RK45"] = with_cyrk


def require(condition: bool, complaint: str) -> None:
    if not condition:
        raise SystemExit(f"not timed, because it is wrong: {complaint}")


def solve_all(case: Case, rtol: float = RTOL) -> dict[str, Outcome]:
    """Runs of all solvers, whose final states agree with the reference."""
    runs = {name: solver(case, rtol) for name, solver in SOLVERS.items()}
    for name, outcome in runs.items():
        require(outcome.error < 1e5 * rtol, f"{name} on {case.name}: error {outcome.error:.1e} at rtol = {rtol:.1e}")
    return runs


def in_turn(runs: Mapping[str, Outcome], repetitions: int) -> Times:
    contestants: dict[str, Callable[[], object]] = {}
    for name, outcome in runs.items():
        contestants[name] = outcome.run
        contestants[f"{name}, f alone"] = outcome.alone
    return interleaved(contestants, repetitions, process_time)


# ----------------------------------------------------------------------------------------------------------------------
# Tables


def peers(case: Case) -> str:
    """One problem in detail, with the time that each solver needs for the same error."""
    runs = solve_all(case)
    times = in_turn(runs, REPETITIONS)
    ours = times["invariode ode45"]
    equal = times_at_equal_error(case)
    rows = []
    for name, outcome in runs.items():
        seconds = times[name]
        per_step = ratio(seconds, ours) / outcome.steps * runs["invariode ode45"].steps
        rows.append(
            [
                name,
                str(outcome.steps),
                str(outcome.calls),
                f"{outcome.error:.1e}",
                spread(seconds, MS),
                spread([s / outcome.steps for s in seconds], US),
                f"{median(seconds) / outcome.calls / US:.3f}",
                *_own(seconds, times[f"{name}, f alone"], outcome.calls),
                f"{ratio(seconds, ours):.2f}",
                f"{per_step:.2f}",
                f"{equal[name] / equal['invariode ode45']:.2f}",
            ]
        )
    header = ["solver", "steps", "f calls", "error", "total, ms", "per step, µs", "per call, µs", "f alone, µs"]
    header += ["own, µs", "÷ f alone", "÷ ours, total", "÷ ours, per step", "÷ ours, equal error"]
    return table(header, rows)


def _own(seconds: Sequence[float], alone: Sequence[float], calls: int) -> list[str]:
    """Per call of f: its own time, the solver's, and the ratio of the whole to f alone."""
    own = median(s - a for s, a in zip(seconds, alone, strict=True))
    return [f"{median(alone) / calls / US:.3f}", f"{own / calls / US:.3f}", f"{ratio(seconds, alone):.2f}"]


def set_up(case: Case) -> str:
    """What a solve costs apart from its steps: an interval that one step covers."""
    end = 1e-6
    runs: dict[str, Callable[[], Any]] = {
        "invariode ode45": partial(iv.solve_ivp, case.f, (0.0, end), case.y0, first_step=end),
        "SciPy RK45": partial(scipy.integrate.solve_ivp, case.f, (0.0, end), case.y0, first_step=end),
    }
    if pysolve_ivp is not None:
        # It takes no first step of more than half the interval, and chooses one that covers it: one more call of f.
        runs["CyRK RK45"] = partial(pysolve_ivp, case.f_into, (0.0, end), case.y0, pass_dy_as_arg=True)
    for name, run in runs.items():
        require(len(run().t) == 2, f"{name}: more than one step")
    many = 100
    times = interleaved({name: partial(_each, [run] * many) for name, run in runs.items()}, REPETITIONS)
    ours = times["invariode ode45"]
    rows = [
        [name, spread([s / many for s in seconds], US, 1), f"{ratio(seconds, ours):.2f}"]
        for name, seconds in times.items()
    ]
    return table(["solve of one step", "total, µs", "÷ ours"], rows)


def pendulum(t: float, y: Array, k: float = 1.0) -> list[float]:
    return [y[1], -k * y[0]]


def diffusion(t: float, y: Array) -> Array:
    return np.concatenate([[0.0], y[:-2] - 2.0 * y[1:-1] + y[2:], [0.0]])


def amplitude(t: float, y: Array) -> float:
    return float(y[0] * y[0] + y[1] * y[1])


def amplitude_gradient(t: float, y: Array) -> list[float]:
    return [2.0 * y[0], 2.0 * y[1]]


def far_off(t: float, y: Array) -> float:
    return float(y[0]) - 5.0


def calls() -> str:
    """Calls of one step: whatever a problem has, a call finds the plan of the first one of its kind."""
    end = 1e-6
    y0, span = np.array([1.0, 0.0]), (0.0, end)
    compiled = iv.compile(pendulum)
    g = iv.Invariants(amplitude, amplitude_gradient)

    def solve(fun: Function = pendulum, method: str = "ode45", **more: Any) -> Callable[[], iv.Solution]:
        return partial(iv.solve_ivp, fun, span, y0, method, first_step=end, **more)

    def prepared(fun: Function = pendulum, method: str = "ode45", **more: Any) -> Callable[[], iv.Solution]:
        changed = {"args": (1.5,)} if "args" in more else {}
        return partial(iv.Problem(fun, span, y0, **more).prepare(method, first_step=end), **changed)

    neighbours = iv.compile(diffusion)

    def large(method: str = "dop853") -> Callable[[], iv.Solution]:
        return partial(iv.solve_ivp, neighbours, span, np.linspace(0.6, 1.4, MANY), method, first_step=end)

    runs: dict[str, Callable[[], Any]] = {
        "SciPy's solve_ivp": partial(scipy.integrate.solve_ivp, pendulum, span, y0, first_step=end),
        "plain": solve(),
        "compiled": solve(compiled),
        "compiled, ode15s": solve(compiled, "ode15s"),
        "compiled, a compiled event": solve(compiled, events=iv.compile(lambda t, y: y[0] - 5.0)),
        "compiled, a compiled invariant": solve(
            compiled, invariants=iv.compile(lambda t, y: y[0] * y[0] + y[1] * y[1])
        ),
        "compiled, sensitivities": solve(compiled, args=(1.0,), sensitivities=True),
        "compiled, sensitivities, prepare": lambda: iv.Problem(
            compiled, span, y0, args=(1.0,), sensitivities=True
        ).prepare(),
        f"compiled, dop853, {MANY} components": large(),
        f"compiled, ode15s, {MANY} components": large("ode15s"),
        "an event": solve(events=far_off),
        "bounds": solve(bounds=(-2.0, 2.0)),
        "an invariant with its Jacobian": solve(invariants=g),
        "an invariant": solve(invariants=amplitude),
        "prepared": prepared(),
        "prepared, other args": prepared(args=(1.0,)),
        "prepared, an event": prepared(events=far_off),
        "prepared, an invariant with its Jacobian": prepared(invariants=g),
        "prepared, compiled": prepared(compiled),
        "prepared, compiled, ode15s": prepared(compiled, "ode15s"),
        "prepared, compiled, sensitivities, other args": prepared(compiled, args=(1.0,), sensitivities=True),
    }
    many = 50
    times = interleaved({name: partial(_each, [run] * many) for name, run in runs.items()}, REPETITIONS, process_time)
    plain = times["plain"]
    rows = [
        [name, spread([s / many for s in seconds], US, 1), f"{ratio(seconds, plain):.2f}"]
        for name, seconds in times.items()
    ]
    return table(["solve of one step", "total, µs", "÷ plain"], rows)


def loops() -> str:
    """One step more of SciPy's `ode`, as control loops call it."""
    rows = []
    for name in ("vode", "lsoda", "dopri5", "dop853"):
        runs: dict[str, Callable[[], Any]] = {}
        for who, kind in (("ours", iv.ode), ("SciPy", scipy.integrate.ode)):
            run = kind(pendulum).set_integrator(name).set_f_params(1.0).set_initial_value([1.0, 0.0], 0.0)
            runs[who] = partial(_advance, run)
            runs[f"{who}, set_f_params"] = partial(_advance, run, (1.0,))
        many = 50
        times = interleaved({who: partial(_each, [run] * many) for who, run in runs.items()}, REPETITIONS, process_time)
        each = {who: [s / many for s in seconds] for who, seconds in times.items()}
        quotients = [ratio(each[f"ours{more}"], each[f"SciPy{more}"]) for more in ("", ", set_f_params")]
        rows.append(
            [name, spread(each["ours"], US, 1), spread(each["SciPy"], US, 1), *(f"{one:.2f}" for one in quotients)]
        )
    return table(["ode.integrate", "ours, µs", "SciPy, µs", "ours ÷ SciPy", "after unchanged set_f_params"], rows)


def _advance(run: Any, args: tuple[float, ...] = ()) -> None:
    if args:
        run.set_f_params(*args)
    run.integrate(run.t + 1e-3)


def circle(y: Array, t: float) -> tuple[float, float]:
    return y[1], -y[0]


#: Times of output and `tcrit`, and how many calls are timed together.
CALLS: dict[str, tuple[Array, Array | None, int]] = {
    "an interval of 0.1": (np.array([0.0, 0.1]), None, 100),
    "50 times in 10": (np.linspace(0.0, 10.0, 50), None, 30),
    "20 times in 1, tcrit=t": (np.linspace(0.0, 1.0, 20), np.linspace(0.0, 1.0, 20), 20),
    "10⁶ times in 100": (np.linspace(0.0, 100.0, 10**6), None, 1),
}


def odeint_calls() -> str:
    """Calls of `odeint`, which controllers and optimisers make in a loop, and one with many times of output."""
    rows = []
    for name, (times, critical, many) in CALLS.items():
        solvers = {"ours": iv.odeint, "SciPy": scipy.integrate.odeint}
        runs = {who: partial(solve, circle, [1.0, 0.0], times, tcrit=critical) for who, solve in solvers.items()}
        for who, run in runs.items():
            error = np.abs(np.asarray(run())[:, 0] - np.cos(times)).max()
            require(error < 1e-5, f"odeint, {name}, {who}: error {error:.1e}")
        calls = {who: _calls_of(solve, times, critical) for who, solve in solvers.items()}
        loops = {who: partial(_each, [run] * many) for who, run in runs.items()}
        seconds = interleaved(loops, REPETITIONS, process_time)
        each = {who: [s / many for s in seconds[who]] for who in runs}
        row = [name, f"{calls['ours']} ({calls['SciPy']})", *(spread(each[who], US, 0) for who in runs)]
        rows.append([*row, f"{ratio(seconds['ours'], seconds['SciPy']):.2f}"])
    return table(["odeint of y'' = -y", "f calls (SciPy's)", "ours, µs", "SciPy, µs", "ours ÷ SciPy"], rows)


def _calls_of(solve: Callable[..., Any], times: Array, critical: Array | None) -> int:
    calls = 0

    def counted(y: Array, t: float) -> tuple[float, float]:
        nonlocal calls
        calls += 1
        return circle(y, t)

    solve(counted, [1.0, 0.0], times, tcrit=critical)
    return calls


def few_rows() -> str:
    """Ensembles of a Python function with few rows and with many, against a loop of single solves."""
    random = np.random.default_rng(1)

    def spring(t: float, y: Array) -> list[float]:
        return [y[1], -y[0]]

    lines = []
    for size in (10, 2000):
        rows = random.standard_normal((size, 2))
        runs: dict[str, Callable[[], object]] = {
            "a loop": lambda rows=rows: [iv.solve_ivp(spring, (0, 1), row, keep="end") for row in rows],
            "workers=1": partial(iv.solve_ensemble, spring, (0, 1), rows, workers=1),
        }
        if size == 10:  # solved in this process; beyond 50 ms others take part, whose time is not in this clock
            runs["default"] = partial(iv.solve_ensemble, spring, (0, 1), rows)
        times = interleaved(runs, 99 if size == 10 else 9, process_time)
        for name, seconds in times.items():
            lines.append([f"{size} rows, {name}", spread(seconds, MS), f"{ratio(seconds, times['a loop']):.2f}"])
    return table(["y'' = -y from 0 to 1 in Python", "ms", "÷ a loop"], lines)


def times_at_equal_error(case: Case) -> dict[str, float]:
    """Seconds for an error of EQUAL_ERROR at the end: a straight line through log(error), log(time) at several rtol."""
    runs = {f"{name} {rtol}": outcome for rtol in TOLERANCES for name, outcome in solve_all(case, rtol).items()}
    times = interleaved({key: outcome.run for key, outcome in runs.items()}, 7)
    found = {}
    for name in SOLVERS:
        keys = [f"{name} {rtol}" for rtol in TOLERANCES]
        line = np.polyfit([math.log(runs[k].error) for k in keys], [math.log(median(times[k])) for k in keys], 1)
        found[name] = math.exp(np.polyval(line, math.log(EQUAL_ERROR)))
    return found


def right_hand_sides(cases: Iterable[Case]) -> str:
    """Several right-hand sides, in short."""
    rows = []
    for case in cases:
        runs = solve_all(case)
        times = in_turn(runs, 9)
        ours = runs["invariode ode45"]
        seconds = times["invariode ode45"]
        row = [
            case.name,
            str(ours.steps),
            str(ours.calls),
            spread([s / ours.steps for s in seconds], US),
            f"{median(seconds) / ours.calls / US:.3f}",
            *_own(seconds, times["invariode ode45, f alone"], ours.calls),
        ]
        for peer in ("SciPy RK45", "CyRK RK45"):
            if peer in runs:
                total = ratio(times[peer], seconds)
                row.append(f"{total:.2f} ({total * ours.steps / runs[peer].steps:.2f})")
            else:
                row.append("not installed")
        rows.append(row)
    header = [
        "right-hand side",
        "steps",
        "f calls",
        "per step, µs",
        "per call, µs",
        "f alone, µs",
        "own, µs",
        "÷ f alone",
    ]
    header += ["SciPy ÷ ours, total (per step)", "CyRK ÷ ours, total (per step)"]
    return table(header, rows)


def extras(case: Case, g: Function, gradient: Function) -> list[list[str]]:
    """What an invariant and an event add to a step, and how much of it are the user's own functions."""

    def gradient_array(t: float, y: Array) -> Array:
        return np.array(gradient(t, y))

    def event(t: float, y: Array) -> float:
        return float(y[0]) - 0.9

    event_calls = 0

    def counted_event(t: float, y: Array) -> float:
        nonlocal event_calls
        event_calls += 1
        return event(t, y)

    solve = partial(iv.solve_ivp, case.f, case.span, case.y0, "ode45", rtol=RTOL, atol=RTOL)
    runs: dict[str, Callable[[], iv.Solution]] = {
        "plain": solve,
        "1 invariant, jac a list": partial(solve, invariants=iv.Invariants(g, gradient)),
        "1 invariant, jac an array": partial(solve, invariants=iv.Invariants(g, gradient_array)),
        "1 invariant, no jac": partial(solve, invariants=iv.Invariants(g)),
        "1 event": partial(solve, events=event),
    }
    solutions = {name: run() for name, run in runs.items()}
    for name, sol in solutions.items():
        error = case.error(sol.y[:, -1])
        require(error < 1e5 * RTOL, f"{case.name}, {name}: error {error:.1e}")
        if "invariant" in name:
            worst = np.abs(sol.residual).max()
            require(worst < 1e-12, f"{case.name}, {name}: residual {worst:.1e}")
    tight = scipy.integrate.solve_ivp(case.f, case.span, case.y0, method="DOP853", rtol=1e-10, atol=1e-10, events=event)
    found, expected = (np.concatenate(sol.t_events or []) for sol in (solutions["1 event"], tight))
    require(len(found) == len(expected), f"{case.name}: {len(found)} events, not {len(expected)}")
    require(np.allclose(found, expected, atol=1e5 * RTOL), f"{case.name}: times of events")
    solve(events=counted_event)

    y = case.y0
    contestants: dict[str, Callable[[], object]] = {}
    for name, sol in solutions.items():
        contestants[name] = runs[name]
        jac = gradient if "list" in name else gradient_array
        alone: list[Callable[[], None]] = [call(case.f, sol.nfev + sol.stats.nfev_check, y)]
        if "invariant" in name:
            alone += [call(g, sol.stats.ng, y), call(jac, sol.stats.ngjac if "no" not in name else 0, y)]
        elif "event" in name:
            alone.append(call(event, event_calls, y))
        contestants[f"{name}, alone"] = partial(_each, alone)
    times = interleaved(contestants, REPETITIONS)

    rows = []
    plain_steps = solutions["plain"].stats.steps
    for name, sol in solutions.items():
        steps, seconds, alone_seconds = sol.stats.steps, times[name], times[f"{name}, alone"]
        calls = sol.stats.ng + sol.stats.ngjac if "invariant" in name else event_calls if "event" in name else 0
        added = median(s / steps - p / plain_steps for s, p in zip(seconds, times["plain"], strict=True))
        users = median(s / steps - p / plain_steps for s, p in zip(alone_seconds, times["plain, alone"], strict=True))
        plain = median(times["plain"]) / plain_steps
        rows.append(
            [
                f"{case.name}: {name}",
                str(steps),
                f"{calls / steps:.1f}",
                spread([s / steps for s in seconds], US),
                *(["", "", ""] if name == "plain" else _parts(added, users, plain)),
                f"{ratio(seconds, alone_seconds):.2f}",
            ]
        )
    return rows


def _each(loops: Iterable[Callable[[], object]]) -> None:
    for loop in loops:
        loop()


def _parts(added: float, users: float, plain: float) -> list[str]:
    return [f"{added / US:.2f}", f"{users / US:.2f}", f"{(added - users) / US:.2f} ({(added - users) / plain:.0%})"]


EXTRAS_HEADER = ["run", "steps", "calls per step", "per step, µs", "added, µs", "user's g, jac, event, µs"]
EXTRAS_HEADER += ["ours, µs (of a plain step)", "÷ user's functions alone"]


def report() -> str:
    y0 = np.array([1.0, 3.0])
    plain = Case("Lotka–Volterra", lotka_volterra, lotka_volterra_into, (0.0, 200.0), y0)
    orbit0 = np.array(START)
    orbit = Case("three-body problem", three_body, three_body_into, (0.0, PERIOD), orbit0)
    cases = [
        Case(
            "Lotka–Volterra, floats of y.tolist()",
            lotka_volterra_floats,
            lotka_volterra_floats_into,
            (0.0, 200.0),
            y0,
        ),
        Case("Lotka–Volterra, returns an array", lotka_volterra_array, lotka_volterra_into, (0.0, 200.0), y0),
        orbit,
        lattice_case(3, 200.0),
        lattice_case(100, 30.0),
        lattice_case(100, 30.0, inplace=True),
        lattice_case(1000, 300.0),
        lattice_case(1000, 300.0, inplace=True),
    ]
    parts = [
        f"{machine('invariode', 'numpy', 'scipy', 'CyRK')}.",
        f"## A Python right-hand side\n\nLotka–Volterra, rtol = atol = {RTOL:.0e}, t from 0 to 200; times are medians "
        f"(smallest–largest). The last column is at an error of {EQUAL_ERROR:.0e} at the end, interpolated.",
        peers(plain),
        "## The fixed cost of a solve",
        set_up(plain),
        "## Calls of other kinds",
        calls(),
        "## `odeint`",
        odeint_calls(),
        "## `ode` in a loop",
        loops(),
        "## Ensembles of Python functions",
        few_rows(),
        "## Other right-hand sides",
        right_hand_sides(cases),
        "## One invariant, one event",
        table(
            EXTRAS_HEADER,
            extras(plain, lotka_volterra_invariant, lotka_volterra_gradient)
            + extras(orbit, jacobi_integral, jacobi_gradient),
        ),
    ]
    if installed("CyRK") is None:
        parts.insert(1, "CyRK is not installed, and left out.")
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="replace the tables in docs/benchmarks")
    write = parser.parse_args().write
    text = report()
    print(text)
    if write:
        write_section("overhead", text)


if __name__ == "__main__":
    main()
