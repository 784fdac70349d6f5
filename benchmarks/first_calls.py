"""The first calls of a process: ``python benchmarks/first_calls.py [--write] [--repetitions N]``.

Each in a process of its own, after `import invariode`, which is not counted; the process's CPU clock. Modules have
bytecode, as in an installed package. Cold: with an empty cache of code; warm: what an earlier process has compiled is
in it. The last line is LLVM alone, which whoever loads machine code has to import. ``--write`` puts the table into
docs/benchmarks/overhead.md.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from measure import machine, run, table

MS = 1e-3
CALLS = {
    "a dense stiff solve, radau": "iv.solve_ivp(relaxing, (0, 1), [1.0, 2.0, 3.0], 'radau')",
    "compile, ode15s": "iv.solve_ivp(iv.compile(damped), (0, 1), [1.0, 0.0], 'ode15s')",
    "taylor": "iv.solve_ivp(pendulum, (0, 1), [1.0, 0.0], 'taylor')",
    "a fit": "iv.fit(iv.Problem(decay, (0, 2), [1.0], args=(1.0,)), [0.5, 1.0, 2.0], [[0.6, 0.37, 0.14]], "
    "{'rate': (0.1, 10)})",
    "LLVM alone": "__import__('llvmlite.binding')",
}


def relaxing(t: float, y: Any) -> list[float]:
    return [-50 * (y[0] - y[1]), -y[1], y[0] - y[2]]


def damped(t: float, y: Any) -> tuple[float, float]:
    return y[1], -y[0] - 50 * y[1]


def pendulum(t: float, y: Any) -> list[float]:
    return [y[1], -np.sin(y[0])]


def decay(t: float, y: Any, rate: float) -> list[float]:
    return [-rate * y[0]]


def timed(call: str) -> None:
    """Print the time of a call; this process was started for it."""
    import invariode as iv

    start = process_time()
    eval(CALLS[call], {**globals(), "iv": iv})
    print(process_time() - start)


def seconds(call: str, cache: str, bytecode: str) -> float:
    given = {**os.environ, "INVARIODE_CACHE": cache, "PYTHONPYCACHEPREFIX": bytecode}
    given.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, __file__, call]
    return float(subprocess.run(command, check=True, capture_output=True, text=True, env=given).stdout)


def report(repetitions: int) -> str:
    rows = []
    with tempfile.TemporaryDirectory() as bytecode:
        for call in CALLS:
            seconds(call, "off", bytecode)  # writes the bytecode of the modules that the call imports
            cold, warm = [], []
            for _ in range(repetitions):
                with tempfile.TemporaryDirectory() as folder:
                    cold.append(seconds(call, folder, bytecode))
                    warm.append(seconds(call, folder, bytecode))
            rows.append([call, f"{median(cold) / MS:.0f}", f"{median(warm) / MS:.0f}"])
    return f"{machine('invariode', 'numpy')}.\n\n{table(['first call in a process', 'cold, ms', 'warm, ms'], rows)}"


if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1] in CALLS:
        timed(sys.argv[1])
    else:
        run("first-calls", __doc__, report, repetitions=5)
