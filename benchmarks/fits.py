"""How good and how fast are fits: ``python benchmarks/fits.py [--write] [--repetitions N]``, or ``make bench``.

Eight standard problems with data made from known parameters, fixed seeds and designs. How often do 95 % intervals
contain the truth (a fit that fails is a miss), and how long does a fit take, with Python and with compiled functions,
against `scipy.optimize.least_squares` with difference Jacobians of runs of SciPy's solver: same kind of method, same
tolerances, same start? ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from measure import interleaved, machine, ratio, run, table
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import invariode as iv

LEVEL = 0.95
RTOL = 1e-6
#: Fits of each contestant that are timed; evaluations of the log-likelihood that are timed together, and how often.
TIMED, EVALUATIONS, OFTEN = 5, 20, 51


@dataclass
class Case:
    """A problem, its truth and its design."""

    name: str
    fun: Callable[..., Any]
    y0: list[float]
    truth: dict[str, float]  # arguments of f, then initial values y0[i]
    t: np.ndarray
    observe: list[int]
    sigma: float | list[float]  # the noise of the data
    known: bool = True  # whether the fit knows sigma
    noise: str = "normal"
    log: bool = False  # parameters are searched for in their logarithms
    start: float = 1.4  # times the truth
    method: str = "ode45"
    scipy_method: str = "RK45"
    atol: float = 1e-9
    doses: dict[float, Callable[..., Any]] = field(default_factory=dict)

    @property
    def args(self) -> tuple[float, ...]:
        return tuple(value for name, value in self.truth.items() if "[" not in name)

    def problem(self, fun: Any) -> iv.Problem:
        start = list(self.y0)
        for i in range(len(start)):
            start[i] = self.truth.get(f"y0[{i}]", start[i])
        return iv.Problem(fun, (0, self.t[-1]), start, args=self.args)

    def options(self, fun: Any) -> dict[str, Any]:
        of = {one: iv.compile(one) for one in self.doses.values()} if isinstance(fun, iv.CompiledFunction) else {}
        doses = {"breakpoints": {t: of.get(one, one) for t, one in self.doses.items()}} if self.doses else {}
        return {"method": self.method, "rtol": RTOL, "atol": self.atol, **doses}

    def exact(self) -> np.ndarray:
        doses = {"breakpoints": self.doses} if self.doses else {}
        y = self.problem(self.fun).solve(self.method, t_eval=self.t, rtol=1e-9, atol=1e-3 * self.atol, **doses).y
        return y[:, np.isin(np.arange(y.shape[1]), np.arange(len(self.t)))][self.observe]

    def data(self, exact: np.ndarray, seed: int) -> np.ndarray:
        error = np.reshape(self.sigma, (-1, 1)) * np.random.default_rng(seed).normal(size=exact.shape)
        return exact * np.exp(error) if self.noise == "lognormal" else exact + error

    def parameters(self, **fixed: float) -> dict[str, iv.Parameter]:
        scale = "log" if self.log else "linear"
        wide = {name: (value / 100, value * 100) if value > 0 else (None, None) for name, value in self.truth.items()}
        return {
            name: iv.Parameter(equals=fixed[name])
            if name in fixed
            else iv.Parameter(start=self.first(name), bounds=wide[name], scale=scale)
            for name in self.truth
        }

    def first(self, name: str) -> float:
        return self.truth[name] * self.start

    def fit(self, fun: Any, data: np.ndarray, **fixed: float) -> iv.Fit:
        known = self.sigma if self.known else None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return iv.fit(
                self.problem(fun),
                self.t,
                dict(zip([f"y{i}" for i in self.observe], data, strict=True)),
                self.parameters(**fixed),
                sigma=known,
                noise=self.noise,
                **self.options(fun),
            )

    def by_scipy(self, data: np.ndarray) -> np.ndarray:
        """What a user of SciPy writes."""
        names = list(self.truth)
        start = np.array([self.first(name) for name in names])
        bounds = [(v / 100, v * 100) if v > 0 else (-np.inf, np.inf) for v in self.truth.values()]
        sigma = np.reshape(self.sigma, (-1, 1)) if self.known else 1.0

        def model(p: np.ndarray) -> np.ndarray:
            values = dict(zip(names, np.exp(p) if self.log else p, strict=True))
            y = [values.get(f"y0[{i}]", one) for i, one in enumerate(self.y0)]
            args = tuple(values[name] for name in names if "[" not in name)
            edges, pieces = [*self.doses, self.t[-1]] if self.doses else [0.0, self.t[-1]], []
            for left, right in pairwise(edges):
                y = self.doses[left](left, np.array(y)) if left in self.doses else y
                inside = self.t[(self.t >= left) & ((self.t < right) | (right == self.t[-1]))]
                times = np.unique([*inside, right])
                found = solve_ivp(
                    self.fun, (left, right), y, self.scipy_method, times, args=args, rtol=RTOL, atol=self.atol
                ).y
                pieces.append(found[:, np.isin(times, inside)])
                y = found[:, -1]
            return np.concatenate(pieces, axis=1)[self.observe]

        def residuals(p: np.ndarray) -> np.ndarray:
            y = model(p)
            difference = np.log(np.maximum(y, 1e-300)) - np.log(data) if self.noise == "lognormal" else y - data
            return (difference / sigma).ravel()

        limits = np.array(bounds).T
        if self.log:
            start, limits = np.log(start), np.log(limits)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            found = least_squares(residuals, start, bounds=limits, x_scale="jac").x
        return np.exp(found) if self.log else found


def decay(t, y, k):
    return [-k * y[0]]


def michaelis_menten(t, y, v, km):
    return [-v * y[0] / (km + y[0])]


def volterra(t, y, a, b, c, d):
    return [a * y[0] - b * y[0] * y[1], -c * y[1] + d * y[0] * y[1]]


def sir(t, y, beta, gamma):
    return [-beta * y[0] * y[1], beta * y[0] * y[1] - gamma * y[1], gamma * y[1]]


def pendulum(t, y, damping, stiffness):
    return [y[1], -damping * y[1] - stiffness * np.sin(y[0])]


def robertson(t, y, k1, k2, k3):
    r1, r2, r3 = k1 * y[0], k2 * y[1] * y[2], k3 * y[1] * y[1]
    return [-r1 + r2, r1 - r2 - r3, r3]


def drug(t, y, absorption, elimination):
    return [-absorption * y[0], absorption * y[0] - elimination * y[1]]


def dose(t, y, *args):
    return np.array([y[0] + 10.0, y[1]])


def fitzhugh_nagumo(t, y, a, b, c):
    return [c * (y[0] - y[0] * y[0] * y[0] / 3 + y[1]), -(y[0] - a + b * y[1]) / c]


CASES = [
    Case("Exponential decay", decay, [5.0], {"k": 0.6, "y0[0]": 5.0}, np.linspace(0.5, 6, 12), [0], 0.2, known=False),
    Case("Michaelis–Menten", michaelis_menten, [3.0], {"v": 1.0, "km": 0.8}, np.linspace(0.25, 5, 20), [0], 0.05),
    Case(
        "Lynx and hare",
        volterra,
        [33.9, 5.9],
        {"a": 0.55, "b": 0.028, "c": 0.8, "d": 0.024, "y0[0]": 33.9, "y0[1]": 5.9},
        np.linspace(1, 20, 20),
        [0, 1],
        [0.25, 0.25],
        known=False,
        noise="lognormal",
        log=True,
        start=1.05,
    ),
    Case("SIR", sir, [0.99, 0.01, 0.0], {"beta": 0.9, "gamma": 0.3}, np.linspace(1, 25, 25), [1], 0.01),
    Case(
        "Damped pendulum",
        pendulum,
        [1.5, 0.0],
        {"damping": 0.2, "stiffness": 4.0, "y0[0]": 1.5},
        np.linspace(0.2, 8, 40),
        [0],
        0.1,
        known=False,
        start=1.1,
    ),
    Case(
        "Robertson",
        robertson,
        [1.0, 0.0, 0.0],
        {"k1": 0.04, "k2": 1e4, "k3": 3e7},
        np.logspace(-2, 4, 20),
        [0, 1, 2],
        [0.01, 1e-6, 0.01],
        log=True,
        start=2.0,
        method="ode15s",
        scipy_method="BDF",
        atol=1e-12,
    ),
    Case(
        "Drug in three doses",
        drug,
        [0.0, 0.0],
        {"absorption": 1.2, "elimination": 0.15},
        np.linspace(0.5, 30, 24),
        [1],
        0.4,
        known=False,
        log=True,
        doses={0.0: dose, 8.0: dose, 16.0: dose},
    ),
    Case(
        "FitzHugh–Nagumo",
        fitzhugh_nagumo,
        [-1.0, 1.0],
        {"a": 0.2, "b": 0.2, "c": 3.0},
        np.linspace(0.5, 20, 40),
        [0, 1],
        [0.2, 0.2],
        start=1.1,
    ),
]


def distance(free: iv.Fit, held: iv.Fit) -> float:
    """Of a held value from the best one, in standard errors along the profile."""
    if free.sigma is None:
        return float(np.sqrt(max(2 * (free.log_likelihood - held.log_likelihood), 0)))
    squares = [one.sigma**2 * one.degrees_of_freedom for one in (free, held)]
    return float(np.sqrt(max(squares[1] - squares[0], 0)) / free.sigma)


def coverage(case: Case, repetitions: int) -> tuple[list[list[str]], int]:
    """For each parameter how often its interval contains the truth, by quantiles and by profile; failed fits."""
    fun, exact = iv.compile(case.fun), case.exact()
    inside = {name: np.zeros(2) for name in case.truth}
    failed = 0
    for seed in range(repetitions):
        data = case.data(exact, seed)
        try:
            fit = case.fit(fun, data)
        except ValueError:
            failed += 1
            continue
        if not fit.success:
            failed += 1
            continue
        q = stats.norm.ppf(0.5 + LEVEL / 2) if case.known else stats.t.ppf(0.5 + LEVEL / 2, fit.degrees_of_freedom)
        intervals = fit.confidence(LEVEL)
        for name, value in case.truth.items():
            low, high = intervals[name]
            inside[name][0] += low <= value <= high
            if len(case.truth) > 1:
                inside[name][1] += distance(fit, case.fit(fun, data, **{name: value})) <= q
    rows = [
        [f"{case.name}: {name}", *(f"{100 * count / repetitions:.1f} %" for count in counts)]
        for name, counts in inside.items()
    ]
    return rows, failed


def timed(case: Case) -> list[str]:
    """Milliseconds of a fit, and how many times as long SciPy's takes."""
    data = case.data(case.exact(), 1)
    compiled = iv.compile(case.fun)
    contestants = {
        "compiled": partial(case.fit, compiled, data),
        "python": partial(case.fit, case.fun, data),
        "scipy": partial(case.by_scipy, data),
    }
    ours, theirs = case.fit(compiled, data), case.by_scipy(data)
    best = np.array([ours.parameters[name] for name in case.truth])
    errors = np.array([ours.standard_errors[name] for name in case.truth])
    apart = float(np.max(np.abs(best - theirs) / errors))
    times = interleaved(contestants, TIMED, process_time)
    evaluation = interleaved({"one": _evaluations(case, compiled, data)}, OFTEN, process_time)["one"]
    cells = [f"{1e3 * median(times[name]):.1f}" for name in contestants]
    return [
        case.name,
        str(ours.runs),
        f"{1e6 * median(evaluation) / EVALUATIONS:.0f}",
        *cells,
        f"{ratio(times['scipy'], times['compiled']):.0f}",
        f"{ratio(times['scipy'], times['python']):.1f}",
        f"{apart:.0e}",
    ]


def _evaluations(case: Case, fun: Any, data: np.ndarray) -> Callable[[], object]:
    """Evaluations of the log-likelihood with its gradient, each at another point, after the first ones."""
    known = case.sigma if case.known else None
    observed = dict(zip([f"y{i}" for i in case.observe], data, strict=True))
    described: dict[str, Any] = {"sigma": known, "noise": case.noise, **case.options(fun)}
    objective = iv.objective(case.problem(fun), case.t, observed, case.parameters(), **described)
    points = [np.array([case.truth[name] for name in objective.names]) * (1 + 1e-6 * i) for i in range(EVALUATIONS)]
    return lambda: [objective.both(one) for one in points]


def report(repetitions: int) -> str:
    times = [timed(case) for case in CASES]
    rows, failures = [], []
    for case in CASES:
        found, failed = coverage(case, repetitions)
        rows += found
        failures.append(f"{case.name} {failed}")
    good = sum(92 <= float(cell[:-2]) <= 98 for row in rows for cell in row[1:])
    header = [
        "Fit",
        "runs",
        "an evaluation, µs",
        "ms: compiled",
        "Python",
        "SciPy",
        "SciPy / compiled",
        "SciPy / Python",
        "apart, in errors",
    ]
    parts = [
        f"{machine('invariode', 'numpy', 'scipy')}. rtol {RTOL:g}.",
        table(header, times),
        f"Coverage of {100 * LEVEL:.0f} % intervals over {repetitions} data sets each, failed fits counted as misses "
        f"({', '.join(failures)}); {good} of {2 * len(rows)} between 92 and 98 %.",
        table(["Parameter", "quantiles", "profile"], rows),
    ]
    return "\n\n".join(parts)


if __name__ == "__main__":
    run("fits", __doc__, report, repetitions=100)
