"""A million stiff components, matrix-free: ``python benchmarks/krylov.py [--write]``, or ``make bench``.

The Brusselator in three dimensions by finite differences, no flux through the boundary: time, memory and error of
methods with `GMRES` and of CVODE with its GMRES (scikit-sundae), plain and with one preconditioner,
the 2 × 2 blocks of the diagonal. f and the preconditioner are C++ of `krylov.cpp`, which CVODE calls by way of Python
functions, since scikit-sundae takes no others. Each run has a process of its own, and its time is that of the process.
With ``--direct``: ode15s on the two-dimensional problem, plain GMRES against direct factors of the sparse matrix, with
more and more diffusion. ``--write`` puts the table into docs/benchmarks.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import sys
from collections.abc import Callable
from functools import partial
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from measure import growth, in_fresh_process, interleaved, machine, ratio, table, write_section
from numpy.typing import NDArray

import invariode as iv
from native import DOUBLE, POINTER, build, user_function

Array = NDArray[np.float64]
SMALL, LARGE = 20, 80  # 16,000 and 1,024,000 components
CASES = ((SMALL, 1e-4), (SMALL, 1e-5), (SMALL, 1e-8), (LARGE, 1e-4), (LARGE, 1e-5))
SPAN = (0.0, 0.5)
DIFFUSIVITY = 1 / 50
REFERENCE = 1e-11
#: Points in each direction of the two-dimensional problem, with 9800 components, and its diffusivities.
PLANE, DIFFUSIVITIES, PLANE_RTOL = 70, (0.002, 0.02, 0.2, 2.0), 1e-4
SOLVERS: dict[str, tuple[str, dict[str, Any]]] = {
    "ode15s": ("ode15s", {}),
    "radau": ("radau", {}),
    "radau, max_order=9": ("radau", {"max_order": 9}),
    "ode23t": ("ode23t", {}),
    "auto": ("auto", {}),
}


def start(side: int) -> Array:
    """The start of the two-dimensional problem, modulated in the third direction."""
    x = np.linspace(0, 1, side)
    profile = x * (1 - x) ** 1.5
    u, v = 22 * profile[None, :, None] * (1 + 0.2 * np.cos(np.pi * x)), 27 * profile[:, None, None]
    return np.stack(np.broadcast_arrays(u, v), axis=-1).reshape(-1) * np.ones(2 * side**3)


def pointer(a: Array) -> Any:
    return a.ctypes.data_as(POINTER)


def ours(
    solver: str, library: ctypes.CDLL, side: int, rtol: float, preconditioned: bool, y0: Array
) -> tuple[Array, dict[str, Any]]:
    method, options = SOLVERS[solver]
    p = np.array([side, DIFFUSIVITY * (side - 1) ** 2])

    def preconditioner(t: float, y: Array, c: float, *args: float) -> Callable[[Array], Array]:
        def solve(b: Array) -> Array:
            library.brusselator_solve(c, pointer(y), pointer(b), pointer(p))
            return b

        return solve

    sol = iv.solve_ivp(
        user_function(library, "brusselator_f"),
        SPAN,
        y0,
        method,
        args=tuple(p),
        rtol=rtol,
        atol=rtol,
        max_step=np.inf,
        keep="end",
        linear_solver=iv.GMRES(preconditioner=preconditioner if preconditioned else None),
        **options,
    )
    if not sol.success:
        raise SystemExit(sol.message)
    return sol.y[:, -1], {"f": sol.nfev, "products": sol.stats.products, "steps": sol.stats.steps}


def cvodes(
    library: ctypes.CDLL, side: int, rtol: float, preconditioned: bool, y0: Array
) -> tuple[Array, dict[str, Any]]:
    from sksundae.cvode import CVODE, CVODEPrecond  # type: ignore[import-untyped]  # scikit-sundae ships no types

    p = np.array([side, DIFFUSIVITY * (side - 1) ** 2])
    calls = 0

    def f(t: float, y: Array, slope: Array) -> None:
        nonlocal calls
        calls += 1
        library.brusselator_f(t, pointer(y), pointer(slope), pointer(p))

    def solve(t: float, y: Array, slope: Array, r: Array, z: Array, c: float, delta: float, side_of_it: int) -> None:
        z[:] = r
        library.brusselator_solve(c, pointer(y), pointer(z), pointer(p))

    precond = CVODEPrecond(None, solve) if preconditioned else None
    solver = CVODE(f, rtol=rtol, atol=rtol, linsolver="gmres", precond=precond, max_num_steps=10**6)
    sol = solver.solve(np.linspace(*SPAN, 3), y0)  # of two times it would keep every step
    if not sol.success:
        raise SystemExit(sol.message)
    return sol.y[-1], {"f": calls, "products": calls - sol.nfev, "steps": None}


def measured(solver: str, side: int, rtol: float, preconditioned: bool) -> dict[str, Any]:
    """One run: the error is the largest one, in units of 1 + |y|, where there is a reference."""
    library = build("krylov.cpp")
    library.brusselator_solve.restype, library.brusselator_f.restype = None, None
    library.brusselator_f.argtypes = library.brusselator_solve.argtypes = (DOUBLE, POINTER, POINTER, POINTER)
    run = cvodes if solver == "CVODE" else partial(ours, solver)
    run(library, 4, 1e-2, preconditioned, start(4))  # what is imported or compiled once is not counted
    y0, found = start(side), []
    begin = process_time()
    vectors = growth(lambda: found.append(run(library, side, rtol, preconditioned, y0))) / y0.nbytes
    seconds = process_time() - begin
    (y, counts), error = found[0], None
    if side == SMALL:
        exact = ours("radau, max_order=9", library, side, REFERENCE, False, y0)[0]
        error = float((np.abs(y - exact) / (1 + np.abs(exact))).max())
    return {**counts, "seconds": seconds, "vectors": vectors, "error": error}


def line(side: int, rtol: float, preconditioned: bool, solver: str) -> list[str]:
    with_it = "blocks" if preconditioned else "–"
    told = in_fresh_process(__file__, "--run", solver, str(side), str(rtol), "yes" if preconditioned else "no")
    found = json.loads(told.splitlines()[-1])
    print(side, rtol, with_it, solver, found, file=sys.stderr)
    return [
        f"{2 * side**3:,}, rtol = {rtol:.0e}",
        with_it,
        solver,
        "–" if found["error"] is None else f"{found['error']:.1e}",
        "–" if found["steps"] is None else str(found["steps"]),
        str(found["f"]),
        str(found["products"]),
        f"{found['seconds']:.2f}",
        f"{found['vectors']:.0f}" if side == LARGE else "–",
    ]


def plane(t: float, y: Array, diffusivity: float) -> Array:
    """The Brusselator on a square, without flux through the boundary."""
    w = np.pad(y.reshape(PLANE, PLANE, 2), ((1, 1), (1, 1), (0, 0)), mode="reflect")
    neighbours = w[:-2, 1:-1] + w[2:, 1:-1] + w[1:-1, :-2] + w[1:-1, 2:]
    slope = diffusivity * (PLANE - 1) ** 2 * (neighbours.ravel() - 4 * y)
    u, v = y[::2], y[1::2]
    slope[::2] += 1 + u * u * v - 4.4 * u
    slope[1::2] += 3.4 * u - u * u * v
    return np.asarray(slope)


def against_direct(diffusivity: float) -> list[str]:
    """Seconds of the process by direct factors and by GMRES, which take turns."""
    x, z = np.meshgrid(*[np.linspace(0, 1, PLANE)] * 2, indexing="ij")
    y0 = np.stack((22 * z * (1 - z) ** 1.5, 27 * x * (1 - x) ** 1.5), axis=-1).ravel()
    problem, steps = iv.Problem(plane, (0.0, 2.0), y0, args=(diffusivity,)), {}
    solve = partial(problem.solve, "ode15s", rtol=PLANE_RTOL, atol=PLANE_RTOL, keep="end")

    def run(chosen: str) -> None:
        sol = solve(linear_solver=chosen)
        steps[chosen] = sol.stats.steps if sol.success else sol.message

    times = interleaved({one: partial(run, one) for one in ("direct", "gmres")}, 3, process_time)
    counts = [str(steps[one]) for one in times]
    seconds = [f"{median(one):.2f}" for one in times.values()]
    return [f"{diffusivity:g}", *counts, *seconds, f"{ratio(times['direct'], times['gmres']):.2f}"]


def direct_report() -> str:
    rows = [against_direct(one) for one in DIFFUSIVITIES]
    header = ["diffusivity", "steps, direct", "GMRES", "s, direct", "GMRES", "direct ÷ GMRES"]
    return f"{machine('invariode', 'numpy')}. rtol = {PLANE_RTOL:.0e}.\n\n{table(header, rows)}"


def report() -> str:
    rows = [
        line(side, rtol, preconditioned, solver)
        for side, rtol in CASES
        for preconditioned in (False, True)
        for solver in (*SOLVERS, "CVODE")
        if not (side == LARGE and "max_order" in solver)
        and not (rtol < 1e-5 and (preconditioned or solver == "ode23t"))  # of order 2
    ]
    header = ["n", "preconditioner", "solver", "error", "steps", "f", "of these J v", "s", "vectors"]
    return f"{machine('invariode', 'numpy', 'scikit-sundae')}.\n\n{table(header, rows)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the table in docs/benchmarks")
    parser.add_argument("--direct", action="store_true", help="GMRES against direct factors, in two dimensions")
    parser.add_argument("--run", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        solver, side, rtol, preconditioned = arguments.run
        print(json.dumps(measured(solver, int(side), float(rtol), preconditioned == "yes")))
        return
    name, text = ("krylov-direct", direct_report()) if arguments.direct else ("krylov", report())
    print(text)
    if arguments.write:
        write_section(name, text)


if __name__ == "__main__":
    main()
