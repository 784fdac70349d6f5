"""Second-order equations y'' = f(t, y): Nyström pairs beside the Runge-Kutta pairs, at equal error.

    python benchmarks/second_order.py [--write]

Every method gets the same native f, compiled by numba, and runs at rtol = atol = 1e-2 ... 2.5e-14; evaluations of f and
times at errors of 1e-5 and 1e-10 are interpolated between two tolerances around them (logarithms, linearly). Solvers
are prepared: only runs are timed. The error is the largest of the components at the end, relative to the largest
position or velocity. ``--write`` puts the tables into docs/benchmarks/second_order.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from time import process_time
from typing import Any, NamedTuple

import numba
import numpy as np
from measure import interleaved, machine, run, table
from nonstiff import PROBLEMS

import invariode as iv

METHODS = ("rkn64", "rkn86", "rkn1210", "ode89", "dop853", "ode113")
WANTED = (1e-10, 1e-5)
#: Methods take no less than 100 units of roundoff.
LEAST = 2.5e-14
TOLERANCES = (*10.0 ** -np.arange(2, 13.6, 0.5), LEAST)
DOUBLE, POINTER = numba.types.double, numba.types.CPointer(numba.types.double)


class Case(NamedTuple):
    title: str
    fun: Any  # native, of (t, y)
    y0: list[float]
    tf: float
    exact: list[float] | None = None  # the final state, where it is known


def native(rhs: Any, n: int) -> Any:
    """f(t, y) that returns a tuple, as machine code."""
    inner = numba.njit(rhs, error_model="numpy")

    @numba.cfunc(numba.void(DOUBLE, POINTER, POINTER, POINTER), error_model="numpy")
    def code(t, y, out, p):
        values = inner(t, numba.carray(y, (n,)))
        for i in range(n):
            out[i] = values[i]

    return code


def of_nonstiff(name: str) -> Case:
    problem = PROBLEMS[name]
    power = numba.njit(lambda s: 1 / (s * math.sqrt(s)), error_model="numpy")
    return Case(
        problem.title, native(problem.rhs(power), len(problem.y0)), list(problem.y0), problem.span[1], problem.exact
    )


def pendulum() -> Case:
    return Case("Pendulum, t ≤ 100", native(lambda t, y: (y[1], -math.sin(y[0])), 2), [2.0, 0.0], 100.0)


@numba.cfunc(numba.void(DOUBLE, POINTER, POINTER, POINTER), error_model="numpy")
def pleiades_code(t, y, out, p):
    for i in range(7):
        ax, ay = 0.0, 0.0
        for j in range(7):
            if j != i:
                dx, dy = y[j] - y[i], y[7 + j] - y[7 + i]
                s = dx * dx + dy * dy
                factor = (j + 1) / (s * math.sqrt(s))
                ax += factor * dx
                ay += factor * dy
        out[i], out[7 + i], out[14 + i], out[21 + i] = y[14 + i], y[21 + i], ax, ay


def pleiades() -> Case:
    """Hairer, Nørsett & Wanner, Solving ODEs I, II.10: seven bodies in the plane."""
    x, y = [3, 3, -1, -3, 2, -2, 2], [3, -3, 2, 0, 0, -4, 4]
    u, v = [0, 0, 0, 0, 0, 1.75, -1.5], [0, 0, 0, -1.25, 1, 0, 0]
    return Case("Pleiades, t ≤ 3, n = 28", pleiades_code, [float(a) for a in [*x, *y, *u, *v]], 3.0)


CHAIN = 32


@numba.cfunc(numba.void(DOUBLE, POINTER, POINTER, POINTER), error_model="numpy")
def chain_code(t, y, out, p):
    left = y[0]
    force = left + 0.25 * left * left
    for i in range(CHAIN):
        stretch = (y[i + 1] if i + 1 < CHAIN else 0.0) - y[i]
        pull = stretch + 0.25 * stretch * stretch
        out[i], out[CHAIN + i] = y[CHAIN + i], pull - force
        force = pull


def chain() -> Case:
    """Fermi, Pasta, Ulam and Tsingou's chain of 32 masses, springs with a square term, from its slowest mode."""
    q = [math.sin(math.pi * (i + 1) / (CHAIN + 1)) for i in range(CHAIN)]
    return Case("Chain of Fermi, Pasta, Ulam, Tsingou, t ≤ 200, n = 64", chain_code, [*q, *[0.0] * CHAIN], 200.0)


def prepared(case: Case, method: str, rtol: float) -> Callable[[], iv.Solution]:
    second = iv.METHODS[method].equations == "second-order"
    problem = iv.Problem(case.fun, (0.0, case.tf), case.y0, second_order=second)
    solver = problem.prepare(method, rtol=rtol, atol=rtol, keep="end")
    return partial(solver, y0=np.array(case.y0))


def reference(case: Case) -> tuple[np.ndarray, float]:
    """The final state, and by how much two methods differ on it, or 0 where it is known."""
    if case.exact is not None:
        return np.array(case.exact), 0.0
    one, other = (prepared(case, method, LEAST)().y[:, -1] for method in ("rkn1210", "ode89"))
    return one, error(other, one)


def error(y: np.ndarray, exact: np.ndarray) -> float:
    half = len(exact) // 2
    parts = [slice(0, half), slice(half, None)]
    return max(float(np.abs(y[part] - exact[part]).max() / np.abs(exact[part]).max()) for part in parts)


def at_wanted(wanted: float, errors: list[float], costs: list[float]) -> float:
    """The cost at the wanted error, between two tolerances around it."""
    part = math.log(wanted / errors[0]) / math.log(errors[1] / errors[0])
    return costs[0] * (costs[1] / costs[0]) ** part


def costs(case: Case, exact: np.ndarray, repetitions: int) -> dict[tuple[float, str], tuple[float, float]]:
    """At each wanted error, evaluations of f and seconds of each method that comes so close."""
    near, contestants = {}, {}
    for method in METHODS:
        solvers = [prepared(case, method, rtol) for rtol in TOLERANCES]
        runs = [solve() for solve in solvers]
        errors = [max(error(sol.y[:, -1], exact), 1e-16) for sol in runs]
        for wanted in WANTED:
            place = next((k for k in range(1, len(errors)) if errors[k] <= wanted < errors[k - 1]), None)
            if place is not None:
                near[wanted, method] = [(errors[k], runs[k].nfev) for k in (place - 1, place)]
                contestants |= {(wanted, method, k): solvers[place - 1 + k] for k in (0, 1)}
    times = {key: min(s) for key, s in interleaved(contestants, repetitions, process_time).items()}
    return {
        (wanted, method): (
            at_wanted(wanted, [e for e, _ in rows], [nfev for _, nfev in rows]),
            at_wanted(wanted, [e for e, _ in rows], [times[wanted, method, k] for k in (0, 1)]),
        )
        for (wanted, method), rows in near.items()
    }


#: Of the pairs of both, what a row shows: its place in `costs`, the unit, and the format.
SHOWN = {"Evaluations of f": (0, 1.0, "{:.0f}"), "Milliseconds": (1, 1e-3, "{:.3f}")}


def row(title: str, of: dict[str, float], shown: str) -> list[str]:
    best = np.nanmin([of["ode89"], of["dop853"]])
    cells = ["–" if math.isnan(of[m]) else shown.format(of[m]) for m in METHODS]
    return [title, *cells, f"{of['rkn1210'] / best:.2f}"]


def report(repetitions: int) -> str:
    cases = [of_nonstiff("kepler"), of_nonstiff("henon-heiles"), pendulum(), pleiades(), of_nonstiff("solar-system")]
    tables: dict[str, list[list[str]]] = {f"{what} at an error of {e:g}:": [] for e in WANTED for what in SHOWN}
    for case in [*cases, chain()]:
        exact, doubt = reference(case)
        if doubt > 0.2 * min(WANTED):
            print(f"{case.title}: the reference is known to {doubt:.1e} only")
        found = costs(case, exact, repetitions)
        for wanted in WANTED:
            for what, (part, unit, shown) in SHOWN.items():
                of = {m: found[wanted, m][part] / unit if (wanted, m) in found else math.nan for m in METHODS}
                tables[f"{what} at an error of {wanted:g}:"].append(row(case.title, of, shown))
    header = ["", *METHODS, "rkn1210 ÷ the better of ode89, dop853"]
    intro = f"{machine('invariode', 'numba')}. The processor's time, the least of {repetitions}."
    return "\n\n".join([intro, *(f"{title}\n\n{table(header, rows)}" for title, rows in tables.items())])


if __name__ == "__main__":
    run("second_order", __doc__, report, 9)
