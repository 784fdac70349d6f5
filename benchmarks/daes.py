"""Random differential-algebraic systems of index 1, against IDA: ``python benchmarks/daes.py [--write]``.

Transistor amplifiers, ladders of diodes, cooled reactors, power grids (swing equations) and Chemical Akzo Nobel, with
parameters drawn from a seed, each at three tolerances, with the analytic Jacobian and with differences. The reference
is radau at 1e-10. Nothing is timed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import exp, sin
from pathlib import Path
from typing import Any

import numpy as np
from measure import machine, run, table
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import brentq

import invariode as iv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from stiff_contestants import Outcome, solved_by_ida, tolerances

from stiff import StiffProblem

Array = NDArray[np.float64]
Random = np.random.Generator

RTOLS = (1e-3, 1e-5, 1e-7)
OURS = {"ode15s": {}, "ode15s, bdf": {"bdf": True}, "radau": {}, "ode23t": {}, "auto": {}}
TIGHTEST_OF_ORDER_2 = 1e-5
FAR = 100  # tolerances
HIGHEST = 300.0  # exponent


def with_slope(p: StiffProblem, by_t: Array) -> StiffProblem:
    """The same with y' at the start: M y' = f, and the derivatives of the algebraic equations; f_t is `by_t`."""
    across = null_space(p.mass.T).T
    rows = np.vstack((p.mass, across @ p.jac(0.0, p.y0)))
    slope = np.linalg.lstsq(rows, np.append(p.fun(0.0, p.y0), -across @ by_t), rcond=None)[0]
    return replace(p, slope=slope)


def amplifier(rng: Random) -> StiffProblem:
    """Two stages, as in the Test Set for IVP Solvers (Mazzia & Magherini, 2008)."""
    supply, thermal, gain = rng.uniform(4, 9), rng.uniform(0.022, 0.04), rng.uniform(0.95, 0.995)
    leak, source, load = 10 ** rng.uniform(-8, -6), 10 ** rng.uniform(2.5, 3.5), 10 ** rng.uniform(3.5, 4.5)
    signal, frequency = rng.uniform(0.05, 0.4), 2 * np.pi * 10 ** rng.uniform(1.5, 2.5)
    capacities = 10 ** rng.uniform(-6.5, -5, 5)
    mass = np.diag([0, 0, -capacities[3], 0, 0, -capacities[4], 0, 0])
    for node, capacity in zip((0, 3, 6), capacities, strict=False):
        mass[node : node + 2, node : node + 2] = capacity * np.array([[-1, 1], [1, -1]])
    terminals = np.array([1 - gain, -1, gain])
    resistors = np.diag([1 / source, *np.array([2, 1, 1, 2, 1, 1, 1]) / load])
    fed = -np.array([0, 1, 0, 1, 1, 0, 1, 0]) * supply / load

    def fun(t: float, y: Array) -> Array:
        out = resistors @ y + fed
        out[0] -= signal * sin(frequency * t) / source
        for base in (1, 4):
            out[base : base + 3] += leak * (exp(min((y[base] - y[base + 1]) / thermal, HIGHEST)) - 1) * terminals
        return out

    def jac(t: float, y: Array) -> Array:
        J = resistors.copy()
        for base in (1, 4):
            slope = leak / thermal * exp(min((y[base] - y[base + 1]) / thermal, HIGHEST)) * terminals
            J[base : base + 3, base] += slope
            J[base : base + 3, base + 1] -= slope
        return J

    y0 = supply * np.array([0, 0.5, 0.5, 1, 0.5, 0.5, 1, 0])
    tf = 6 * np.pi / frequency
    p = StiffProblem("amplifier", fun, jac, (0, tf), y0, np.ones(8), np.array([tf / 2, tf]), mass=mass)
    return with_slope(p, np.array([-signal * frequency / source, *[0] * 7]))


def ladder(rng: Random) -> StiffProblem:
    """Six nodes: a diode to the next one, resistors to the ground, a capacity in every other gap."""
    amplitude, thermal, leak = rng.uniform(1, 8), rng.uniform(0.022, 0.05), 10 ** rng.uniform(-12, -6)
    frequency, source = 2 * np.pi * 10 ** rng.uniform(1.3, 2.7), 10 ** rng.uniform(2, 3.3)
    conductance = 10 ** rng.uniform(-5, -3, 6) + np.array([1 / source, *[0] * 5])
    gap = np.eye(6)[:5] - np.eye(6)[1:]  # rows: the voltage between neighbours
    mass = gap[::2].T @ (10 ** rng.uniform(-7, -5.3, 3)[:, None] * gap[::2])

    def fun(t: float, y: Array) -> Array:
        through = leak * (np.exp(np.minimum(gap @ y / thermal, HIGHEST)) - 1)
        out = -conductance * y - gap.T @ through
        out[0] += amplitude * sin(frequency * t) / source
        return out

    def jac(t: float, y: Array) -> Array:
        slopes = leak / thermal * np.exp(np.minimum(gap @ y / thermal, HIGHEST))
        return -np.diag(conductance) - gap.T @ (slopes[:, None] * gap)

    tf = 6 * np.pi / frequency
    p = StiffProblem("ladder", fun, jac, (0, tf), np.zeros(6), np.ones(6), np.array([tf / 2, tf]), mass=mass)
    return with_slope(p, np.array([amplitude * frequency / source, *[0] * 5]))


def reactor(rng: Random) -> StiffProblem:
    """A → B → C in a stirred tank, whose temperature, in units of that of the feed, adapts at once."""
    k = 10 ** rng.uniform(-1, 0.8, 2)
    activation, heat = rng.uniform(5, 10, 2), rng.uniform(-0.02, 0.02, 2)
    exchange, swing, frequency = 10 ** rng.uniform(1, 2), rng.uniform(0, 0.2), rng.uniform(0.5, 5)

    def rates(a: float, b: float, T: float) -> Array:
        return k * np.exp(activation * (1 - 1 / T)) * [a, b]

    def fun(t: float, y: Array) -> Array:
        r = rates(*y)
        cooled = exchange * (y[2] - 1 - swing * sin(frequency * t))
        return np.array([1 - y[0] - r[0], -y[1] + r[0] - r[1], heat @ r + 1 - y[2] - cooled])

    def jac(t: float, y: Array) -> Array:
        to = np.array([[-1, 0], [1, -1], heat])
        by = np.zeros((2, 3))
        by[0, 0], by[1, 1] = rates(1, 1, y[2])
        by[:, 2] = rates(*y) * activation / y[2] ** 2
        return to @ by - np.diag([1, 1, 1 + exchange])

    T = brentq(lambda T: fun(0.0, np.array([1.0, 0.0, T]))[2], 0.5, 1.5)
    y0 = np.array([1, 0, T])
    mass = np.diag([1.0, 1.0, 0.0])
    p = StiffProblem("reactor", fun, jac, (0, 10), y0, np.full(3, 0.01), np.array([5, 10.0]), mass=mass)
    return with_slope(p, np.array([0, 0, exchange * swing * frequency]))


def grid(rng: Random) -> StiffProblem:
    """Swing equations (Kundur, Power System Stability and Control, 1994, chapter 12): angles and frequencies of three
    generators, angles of four buses with loads."""
    buses, generators = 7, 3
    lines = np.triu(rng.uniform(2, 20, (buses, buses)) * (rng.random((buses, buses)) < 0.6), 1)
    lines += np.diag(rng.uniform(5, 20, buses - 1), 1)
    lines += lines.T
    inertia, damping = rng.uniform(0.02, 0.2, generators), rng.uniform(0.01, 0.3, generators)
    angles, swing, frequency = rng.uniform(-0.4, 0.4, buses), rng.uniform(0, 2), rng.uniform(1, 10)

    def flows(x: Array) -> Array:
        return (lines * np.sin(np.subtract.outer(x, x))).sum(axis=1)

    power = flows(angles)

    def parts(y: Array) -> tuple[Array, Array]:
        return np.concatenate((y[:generators], y[2 * generators :])), y[generators : 2 * generators]

    def fun(t: float, y: Array) -> Array:
        x, w = parts(y)
        short = power - flows(x)
        driven = short[:generators] - damping * w
        driven[0] += swing * sin(frequency * t)
        return np.concatenate((w, driven, short[generators:]))

    def jac(t: float, y: Array) -> Array:
        x, _ = parts(y)
        stiffness = lines * np.cos(np.subtract.outer(x, x))
        stiffness -= np.diag(stiffness.sum(axis=1))
        angle = np.r_[0:generators, 2 * generators : generators + buses]
        J = np.zeros((generators + buses, generators + buses))
        J[:generators, generators : 2 * generators] = np.eye(generators)
        J[generators : 2 * generators, generators : 2 * generators] = -np.diag(damping)
        J[np.ix_(range(generators, generators + buses), angle)] += stiffness
        return J

    mass = np.diag([*[1.0] * generators, *inertia, *[0.0] * (buses - generators)])
    y0 = np.concatenate((angles[:generators], rng.uniform(-0.5, 0.5, generators), angles[generators:]))
    by_t = np.zeros(len(y0))
    by_t[generators] = swing * frequency
    p = StiffProblem("grid", fun, jac, (0, 5), y0, np.ones(len(y0)), np.array([2.5, 5]), mass=mass)
    return with_slope(p, by_t)


def akzo(rng: Random) -> StiffProblem:
    """Chemical Akzo Nobel as a DAE (Test Set for IVP Solvers), its rates times factors."""
    k = np.array([18.7, 0.58, 0.58 / 34.4, 0.09, 0.42]) * 10 ** rng.uniform(-0.7, 0.7, 5)
    dissolving, saturated, ks = 3.3 * 10 ** rng.uniform(-0.5, 0.5), 0.9 / 737, 115.83 * 10 ** rng.uniform(-0.5, 0.5)
    to = np.zeros((6, 5))
    to[:5] = [[-2, 1, -1, -1, 0], [-0.5, 0, 0, -1, -0.5], [1, -1, 1, 0, 0], [0, -1, 1, -2, 0], [0, 1, -1, 0, 1]]

    def fun(t: float, y: Array) -> Array:
        a, b, c, d, e, f = y.tolist()
        root = max(b, 0.0) ** 0.5
        out = to @ (k * [a**4 * root, c * d, a * e, a * d * d, f * f * root])
        out[1] += dissolving * (saturated - b)
        out[5] = ks * a * d - f
        return out

    def jac(t: float, y: Array) -> Array:
        a, b, c, d, e, f = y.tolist()
        root = max(b, 0.0) ** 0.5
        half = 0.5 / root if root > 0 else 0.0
        by = np.array([
            [4 * a**3 * root, a**4 * half, 0, 0, 0, 0], [0, 0, d, c, 0, 0], [e, 0, 0, 0, a, 0],
            [d * d, 0, 0, 2 * a * d, 0, 0], [0, f * f * half, 0, 0, 0, 2 * f * root],
        ])  # fmt: skip
        J = to @ (k[:, None] * by)
        J[1, 1] -= dissolving
        J[5] = [ks * d, 0, 0, ks * a, 0, -1]
        return J

    y0 = np.array([0.444, saturated, 0, 0.007, 0, ks * 0.444 * 0.007])
    mass = np.diag([*[1.0] * 5, 0.0])
    p = StiffProblem("akzo", fun, jac, (0, 180), y0, np.full(6, 1e-2), np.array([10, 180.0]), mass=mass)
    return with_slope(p, np.zeros(6))


KINDS: tuple[Callable[[Random], StiffProblem], ...] = (amplifier, ladder, reactor, grid, akzo)


def ours(p: StiffProblem, method: str, given: bool, rtol: float) -> Outcome:
    name = method.partition(",")[0]
    about = {"t_eval": p.times, "mass": p.mass, "jac": p.jac if given else None, **tolerances(p, rtol), **OURS[method]}
    sol = iv.solve_ivp(p.fun, p.t_span, p.y0, name, **about)
    return Outcome(error(p, sol.y, rtol) if sol.success else np.inf, sol.nfev + sol.stats.nfev_check)


def ida(p: StiffProblem, given: bool, rtol: float) -> Outcome:
    sol = solved_by_ida(p, rtol, given)
    return Outcome(error(p, sol.y[-len(p.times) :].T, rtol) if sol.success else np.inf, sol.nfev)


REFERENCES: dict[int, Array] = {}


def error(p: StiffProblem, y: Array, rtol: float) -> float:
    if id(p) not in REFERENCES:
        about: dict[str, Any] = {"mass": p.mass, "jac": p.jac, "t_eval": p.times, **tolerances(p, 1e-10)}
        found = iv.solve_ivp(p.fun, p.t_span, p.y0, "radau", on_failure="raise", **about)
        REFERENCES[id(p)] = found.y
    return float(p.difference(y, REFERENCES[id(p)]).max()) / rtol


def cases(count: int, seed: int) -> Iterator[StiffProblem]:
    """`count` of each kind."""
    for kind in KINDS:
        for number in range(count):
            yield kind(np.random.default_rng([seed, KINDS.index(kind), number]))


def row(name: str, outcomes: list[Outcome], idas: list[Outcome]) -> list[str]:
    """Runs, failures, errors; f against IDA's in the runs, with the analytic Jacobian, that both finish."""
    errors = np.array([outcome.error for outcome in outcomes])
    finished = errors[np.isfinite(errors)]
    pairs = zip(outcomes[::2], idas[::2], strict=True)
    logs = [np.log(a.f / b.f) for a, b in pairs if np.isfinite(a.error) and np.isfinite(b.error)]
    counts = [len(errors), len(errors) - len(finished), int((finished > FAR).sum())]
    return [
        name,
        *map(str, counts),
        f"{np.median(finished):.2g}",
        f"{finished.max():.2g}",
        f"{np.exp(np.mean(logs)):.2f}",
    ]


def report(count: int, seed: int = 25) -> str:
    runs = [(p, rtol, given) for p in cases(count, seed) for rtol in RTOLS for given in (True, False)]
    idas = [ida(p, given, rtol) for p, rtol, given in runs]
    rows = [row("IDA", idas, idas)]
    for method in OURS:
        order = iv.METHODS[method.partition(",")[0]].order
        chosen = [i for i, (_, rtol, _) in enumerate(runs) if order != 2 or rtol >= TIGHTEST_OF_ORDER_2]
        outcomes = [ours(runs[i][0], method, runs[i][2], runs[i][1]) for i in chosen]
        rows.append(row(method, outcomes, [idas[i] for i in chosen]))
    header = ["solver", "runs", "failed", f"more than {FAR} rtol off", "median error / rtol", "largest", "f ÷ f of IDA"]
    return f"{machine('invariode', 'numpy', 'scikit-sundae')}.\n\n{table(header, rows)}"


if __name__ == "__main__":
    run("daes", __doc__, report, repetitions=20)
