"""What a step costs with a native right-hand side: ``python benchmarks/native.py [--write]``, or ``make bench``.

`floor.cpp` is ode45 written out by hand for one problem, f inlined, with the same formulas, step control and stored
output; it is compiled here with the flags of the core. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from measure import interleaved, machine, ratio, run, table
from numpy.typing import NDArray

import invariode as iv
from invariode import problems

Array = NDArray[np.float64]
FLAGS = ("-O3", "-DNDEBUG", "-std=c++20", "-ffp-contract=off", "-shared", "-fPIC")
RTOL = 1e-8
NS = 1e-9
PROBLEMS: dict[str, tuple[str, list[float], float]] = {
    "Lotka–Volterra": ("lotka_volterra", [1.0, 3.0], 1000.0),
    "three-body": ("three_body", list(problems.START), 20 * problems.PERIOD),
}
DOUBLE, POINTER = ctypes.c_double, ctypes.POINTER(ctypes.c_double)
USER = ctypes.CFUNCTYPE(None, DOUBLE, POINTER, POINTER, POINTER)


def build(name: str = "floor.cpp") -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        source = Path(__file__).with_name(name)
        library = Path(folder) / source.with_suffix(".so").name
        subprocess.run([os.environ.get("CXX", "c++"), *FLAGS, str(source), "-o", str(library)], check=True)
        return ctypes.CDLL(str(library))


def user_function(library: ctypes.CDLL, name: str) -> Any:
    return USER(ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0)


def floor(library: ctypes.CDLL, name: str, y0: list[float], tf: float) -> tuple[int, Array]:
    function = getattr(library, name)
    function.restype, function.argtypes = ctypes.c_size_t, (DOUBLE, DOUBLE, DOUBLE, POINTER)
    y = np.array(y0)
    return int(function(tf, RTOL, RTOL, y.ctypes.data_as(POINTER))), y


def calls(library: ctypes.CDLL, name: str, count: int, y: Array) -> None:
    library.call(user_function(library, name), ctypes.c_size_t(count), y.ctypes.data_as(POINTER))


def against_the_floor(library: ctypes.CDLL, repetitions: int) -> str:
    """Each line is compared with the floor in a run of its own: what others leave behind in memory plays no part."""
    rows = []
    for title, (name, y0, tf) in PROBLEMS.items():
        f = user_function(library, f"{name}_f")
        steps, y = floor(library, name, y0, tf)
        hand = partial(floor, library, name, y0, tf)
        for method in (name for name, about in iv.METHODS.items() if about.equations == "any"):
            for keep in ("all", "end"):
                solve = partial(iv.solve_ivp, f, (0.0, tf), y0, method, rtol=RTOL, atol=RTOL, keep=keep)
                sol = solve()
                if method == "ode45" and (sol.stats.steps != steps or np.abs(sol.y[:, -1] - y).max() > 1e-9):
                    raise SystemExit(f"not timed: the floor of {title} is another solver than ode45")
                times = interleaved({"floor": hand, method: solve}, repetitions)
                count = sol.stats.steps
                rows.append(
                    [
                        f"{title}, {method}, keep={keep}",
                        str(count),
                        str(sol.nfev),
                        f"{median(times[method]) / count / NS:.0f}",
                        f"{median(times['floor']) / steps / NS:.0f}",
                        f"{ratio(times[method], times['floor']) * steps / count:.2f}",
                    ]
                )
    return table(["solve", "steps", "f calls", "per step, ns", "floor, ns", "÷ floor"], rows)


def projector(library: ctypes.CDLL, repetitions: int) -> str:
    """What the Jacobi integral (m = 1, n = 4) adds to a step of ode45: all of it, and without the user's g and J."""
    name, y0, tf = PROBLEMS["three-body"]
    f, g, jac = (user_function(library, f"{name}_{part}") for part in ("f", "g", "gjac"))
    rows = []
    for iterations in (1, 2):
        held = iv.Invariants(g, jac, names="Jacobi integral", iterations=iterations)
        plain = partial(iv.solve_ivp, f, (0.0, tf), y0, rtol=RTOL, atol=RTOL, keep="end")
        projected = partial(plain, invariants=held)
        unguarded = partial(projected, check=False)
        s, u = plain().stats, unguarded().stats
        runs: dict[str, Callable[[], object]] = {
            "plain": plain,
            "projected": projected,
            "unguarded": unguarded,
            "g": partial(calls, library, f"{name}_g", u.ng, np.array(y0)),
            "J": partial(calls, library, f"{name}_gjac", u.ngjac, np.array(y0)),
        }
        times = interleaved(runs, repetitions)
        step = {what: median(seconds) / s.steps for what, seconds in times.items()}
        scale = s.steps / u.steps
        user = (step["g"] + step["J"]) * scale
        own = step["unguarded"] * scale - step["plain"] - user
        rows.append(
            [
                str(iterations),
                f"{step['plain'] / NS:.0f}",
                f"{step['projected'] * scale / NS:.0f}",
                f"{user / NS:.0f}",
                f"{own / NS:.0f} ({own / step['plain']:.0%})",
                f"{(step['projected'] - step['unguarded']) * scale / NS:.0f}",
            ]
        )
    header = ["iterations", "plain step, ns", "projected, ns", "user's g and J, ns", "projector, ns (of a plain step)"]
    return table([*header, "tests of the invariant, ns"], rows)


def report(repetitions: int) -> str:
    library = build()
    return "\n\n".join(
        [
            f"{machine('invariode', 'numpy')}. rtol = atol = {RTOL:g}; medians of {repetitions}.",
            against_the_floor(library, repetitions),
            "What one invariant adds, three-body problem and Jacobi integral, all functions native:",
            projector(library, repetitions),
        ]
    )


if __name__ == "__main__":
    run("native", __doc__, report, repetitions=31)
