"""What becomes of a stiff problem that is given to an explicit method: ``python benchmarks/limits.py [--write]``.

Van der Pol's equation with mu = 1000 over [0, 2000] with all options at their defaults, each method in a process of its
own, whose largest memory is told. ``--write`` puts the table into docs/benchmarks.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import warnings
from time import perf_counter

from measure import machine, write_section

import invariode as iv

MU, END = 1000.0, 2000.0
EXPLICIT = [name for name, about in iv.METHODS.items() if "jac" not in about.options]


def van_der_pol(t: float, y: list[float]) -> list[float]:
    return [y[1], MU * (1 - y[0] * y[0]) * y[1] - y[0]]


def row(method: str) -> str:
    """A line of the table, from the run in this process."""
    start = perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", iv.StiffnessWarning)  # the column `stiff since` has it
        sol = iv.solve_ivp(van_der_pol, (0, END), [2.0, 0.0], method)
    seconds = perf_counter() - start
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    since = "–" if sol.stats.stiff_since is None else f"{sol.stats.stiff_since:.2f}"
    return (
        f"| {method} | {sol.status} | {sol.t_end:.0f} | {sol.stats.steps} | {since} | {seconds:.0f} | {megabytes:.0f} |"
    )


def main() -> None:
    if "--one" in sys.argv:
        print(row(sys.argv[-1]))
        return
    lines = [
        "| method | status | t at the end | steps | stiff since t = | s | largest memory, MB |",
        "|:---|---:|---:|---:|---:|---:|---:|",
    ]
    for method in EXPLICIT:
        told = subprocess.run([sys.executable, __file__, "--one", method], check=True, capture_output=True, text=True)
        lines.append(told.stdout.strip())
        print(lines[-1], flush=True)
    if "--write" in sys.argv:
        write_section("limits", f"{machine('numpy')}\n\n" + "\n".join(lines))


if __name__ == "__main__":
    main()
