"""What it costs not to know whether a problem is stiff: ``method="auto"`` beside the best explicit method and ode15s.

    python benchmarks/auto.py [--repeat 5]

Evaluations of f (by Python functions, those of difference Jacobians included) and milliseconds, the best of some runs
each, interleaved. "best explicit": of ode23, ode45, ode78, dop853, ode89 and ode113 the one that evaluates f least
often, and the least time of any; "–": none came to the end with as many steps as ode15s evaluates f.
"""

from __future__ import annotations

import argparse
import math
import platform
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import invariode as iv
from invariode import problems
from stiff import oregonator

EXPLICIT = ("ode23", "ode45", "ode78", "dop853", "ode89", "ode113")
TOLERANCES = (1e-3, 1e-6, 1e-8)


class Case(NamedTuple):
    name: str
    fun: Callable[..., Any]
    t_span: tuple[float, float]
    y0: Any
    options: dict[str, Any]


def van_der_pol(mu: float) -> Case:
    def fun(t, y):
        return [y[1], mu * (1 - y[0] * y[0]) * y[1] - y[0]]

    return Case(f"van der Pol, μ = {mu:g}", fun, (0, max(20.0, 2 * mu)), [2.0, 0.0], {})


def heat(n: int) -> Case:
    """u_t = u_xx on (0, 1), u = 0 at the ends, n points inside."""
    x = np.arange(1, n + 1) / (n + 1)

    def fun(t, u):
        slope = -2 * u
        slope[1:] += u[:-1]
        slope[:-1] += u[1:]
        return (n + 1) ** 2 * slope

    return Case(f"heat, n = {n}", fun, (0, 0.5), np.sin(np.pi * x) + x * (1 - x), {"lband": 1, "uband": 1})


def classic(problem: iv.Problem) -> Case:
    return Case(problem.name, problem.fun, problem.t_span, problem.y0, {})


def cases() -> list[Case]:
    return [
        *(van_der_pol(10.0**k) for k in range(7)),
        classic(problems.robertson()),
        Case("Oregonator", oregonator, (0, 360), [1.0, 2.0, 3.0], {}),
        classic(problems.hires()),
        classic(problems.kepler()),
        classic(problems.lotka_volterra()),
        *(heat(n) for n in (10, 100, 1000)),
    ]


class Cost(NamedTuple):
    nfev: float = math.inf
    seconds: float = math.inf
    switches: int = 0


def cost(case: Case, method: str, rtol: float, **options: Any) -> Cost:
    began = time.perf_counter()
    sol = iv.solve_ivp(case.fun, case.t_span, case.y0, method, rtol=rtol, atol=rtol / 1000, **options)
    return Cost(sol.nfev, time.perf_counter() - began, sol.stats.switches) if sol.success else Cost()


def best(one: Cost, other: Cost) -> Cost:
    return Cost(min(one.nfev, other.nfev), min(one.seconds, other.seconds), one.switches)


def measured(case: Case, rtol: float, repeat: int) -> tuple[Cost, Cost, Cost]:
    """Of auto, ode15s and the best of the explicit methods."""
    auto = implicit = explicit = Cost()
    for _ in range(repeat):
        auto = best(cost(case, "auto", rtol, **case.options), auto)
        implicit = best(cost(case, "ode15s", rtol, **case.options), implicit)
        for method in EXPLICIT:
            explicit = best(cost(case, method, rtol, max_steps=int(implicit.nfev)), explicit)
    return auto, implicit, explicit


def shown(value: float, digits: int = 0) -> str:
    return "–" if math.isinf(value) else f"{value:.{digits}f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeat", type=int, default=5)
    repeat = parser.parse_args().repeat
    warnings.simplefilter("ignore", iv.StiffnessWarning)
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    for rtol in TOLERANCES:
        print(f"rtol = {rtol:g}, atol = {rtol / 1000:g}\n")
        costs = "best explicit | ode15s | auto | ratio"
        print(f"| problem | f: {costs} | ms: {costs} | switches |")
        print("|---|---|---|---|---|---|---|---|---|---|")
        for case in cases():
            auto, implicit, explicit = measured(case, rtol, repeat)
            better = best(implicit, explicit)
            calls = [shown(one.nfev) for one in (explicit, implicit, auto)]
            times = [shown(1e3 * one.seconds, 2) for one in (explicit, implicit, auto)]
            ratios = [shown(auto.nfev / better.nfev, 2), shown(auto.seconds / better.seconds, 2)]
            row = [case.name, *calls, ratios[0], *times, ratios[1], str(auto.switches)]
            print(f"| {' | '.join(row)} |", flush=True)
        print()


if __name__ == "__main__":
    main()
