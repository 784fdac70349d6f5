"""How many zeros of events steps pass over, and the cost of finding them: ``python benchmarks/events.py [--write]``.

y' = 1 is solved by one step of 1, so that the solution is exact; event functions are random polynomials and products of
sines with 1 to 20 sign changes in it, which are known. ``--write`` puts the table into docs/benchmarks.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from time import perf_counter

import numpy as np
from measure import machine, write_section

import invariode as iv

#: Steps for each kind of event function, method and choice of points: as many for each number of zeros.
STEPS, STEPS_WRITTEN = 200, 2_000
#: Zeros in a step.
MOST = 20
METHODS = ("ode45", "ode113")
SAMPLES: dict[str, int | str | None] = {"default": None, "samples=20": 20, "samples=100": 100, "'adaptive'": "adaptive"}

Event = Callable[[float, np.ndarray], float]


def polynomial(zeros: np.ndarray, rng: np.random.Generator) -> Event:
    """With these zeros in (0, 1), and as many again outside."""
    others = rng.uniform(1.5, 3, len(zeros)) * rng.choice([-1, 1], len(zeros))
    return lambda t, y: float(np.prod((y[0] - zeros) * 4) * np.prod((y[0] - others) / 2))


def sines(zeros: np.ndarray, rng: np.random.Generator) -> Event:
    """One sine for each zero, of half a period below 2, so that it has no other in (0, 1)."""
    rates = rng.uniform(0.5, 3, len(zeros))
    return lambda t, y: float(np.prod(np.sin(rates * (y[0] - zeros)) * 4))


def missed(
    method: str, samples: int | str | None, kind: Callable[..., Event], steps: int
) -> tuple[int, int, int, float]:
    """Zeros missed, of how many, evaluations of the events, seconds."""
    rng = np.random.default_rng(9228)
    lost = total = calls = 0
    seconds = 0.0
    for count in range(1, MOST + 1):
        for _ in range(steps // MOST):
            zeros = np.sort(rng.uniform(0.01, 0.99, count))
            fun = kind(zeros, rng)

            def counted(t: float, y: np.ndarray, fun: Event = fun) -> float:
                nonlocal calls
                calls += 1
                return fun(t, y)

            about = {"first_step": 1.0, "max_step": np.inf, "keep": "end"}
            event = iv.Event(counted, samples=samples)
            start = perf_counter()
            sol = iv.solve_ivp(lambda t, y: [1.0], (0, 1), [0.0], method, events=event, **about)
            seconds += perf_counter() - start
            lost += abs(count - len(sol.t_events[0]))
            total += count
    return lost, total, calls, seconds


def table(steps: int) -> str:
    lines = [
        "| event functions | method | points | zeros | missed | evaluations in a step | µs in a step |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in (polynomial, sines):
        for method in METHODS:
            for name, samples in SAMPLES.items():
                lost, total, calls, seconds = missed(method, samples, kind, steps)
                per_step = f"{calls / steps:.0f} | {1e6 * seconds / steps:.0f}"
                lines.append(f"| {kind.__name__} | {method} | {name} | {total} | {lost} | {per_step} |")
    return "\n".join(lines)


if __name__ == "__main__":
    written = "--write" in sys.argv
    text = f"{machine('numpy')}\n\n{table(STEPS_WRITTEN if written else STEPS)}"
    print(text)
    if written:
        write_section("events", text)
