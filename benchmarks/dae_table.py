"""Differential-algebraic equations of index 0 to 13: ``python benchmarks/dae_table.py``.

Errors against the references of tests/dae_problems.py, residuals of all constraints in units of a bound of their
roundoff, evaluations, and processor time (of one thread; set OPENBLAS_NUM_THREADS=1 on a busy machine). SciPy and
llvmlite are imported before anything is timed.
"""

from __future__ import annotations

import dataclasses
import struct
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse.csgraph
import scipy.sparse.linalg
from measure import machine, table

import invariode as iv

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from dae_problems import GRAVITY, PROBLEMS, DaeProblem, chain, crane_solution, fekete, pendula, reactor_solution
from test_dae import off_constraints

IMPORTED = (scipy.optimize, scipy.sparse.csgraph, scipy.sparse.linalg)  # before anything is timed
Row = tuple[str, str, str]


def timed(what: Callable[[], Any]) -> tuple[Any, float]:
    """The value, and the seconds of the processor that it took."""
    begin = time.process_time()
    found = what()
    return found, time.process_time() - begin


def constraints() -> Iterator[Row]:
    """Residuals of all levels at every tolerance with every method, at 25 steps and between steps.

    Methods of order 2 and 3 solve a 20th of the interval at 1e-8 and a 200th at 1e-10. Machine code for taylor at index
    13 takes too long.
    """
    cases = {name: PROBLEMS[name] for name in ("pendulum", "two pendula", "squeezer", "car axis")}
    cases |= {"four pendula, index 9": pendula(4), "six pendula, index 13": pendula(6)}
    for name, problem in cases.items():
        worst, method, rtol = 0.0, "", 0.0
        for each, info in iv.METHODS.items():
            if info.equations == "second-order" or (name.startswith("six") and each == "taylor"):
                continue
            for tolerance in (1e-3, 1e-4, 1e-6, 1e-8, 1e-10):
                t0, tf = problem.t_span
                part = 1 if info.order > 3 or tolerance > 1e-7 else 20 if tolerance > 1e-9 else 200  # low orders: slow
                shorter = dataclasses.replace(problem, t_span=(t0, t0 + (tf - t0) / part))
                for options in ({}, {"t_eval": np.linspace(*shorter.t_span, 7)}):
                    off = off_constraints(shorter.solve(each, tolerance, **options))
                    if off > worst:
                        worst, method, rtol = off, each, tolerance
        yield f"residuals, {name}: largest over roundoff", "10", f"{worst:.2g} ({method}, {rtol:.0e})"


def accuracy() -> Iterator[Row]:
    wanted = (
        ("two pendula", "radau", 1e-8, "1e-8; 5000"),
        ("squeezer", "dop853", 1e-8, "1e-8"),
        ("car axis", "radau", 1e-6, "1e-7"),
        ("transistors", "radau", 1e-8, "1e-8"),
        ("akzo", "radau", 1e-6, "1e-6"),
        ("robertson", "radau", 1e-8, "–"),
    )
    for name, method, rtol, most in wanted:
        sol = PROBLEMS[name].solve(method, rtol, rtol * 1e-6 if name == "robertson" else None)
        yield f"{name}, {method}, {rtol:.0e}: error; f", most, f"{PROBLEMS[name].error(sol):.1e}; {sol.nfev}"
    for name, exact in (("crane", crane_solution), ("reactor", reactor_solution)):
        sol = PROBLEMS[name].solve("dop853", 1e-4)
        expected = np.array([exact(t) for t in sol.t]).T
        off = (np.abs(sol.y - expected) / np.maximum(np.abs(expected), 1e-2)).max()
        yield f"{name}, all steps: error", "1e-13", f"{off:.1e}"
    sol = PROBLEMS["robot arm"].solve("dop853", 1e-4)
    yield "robot arm: error", "1e-13", f"{PROBLEMS['robot arm'].error(sol):.1e}"
    problem = PROBLEMS["ring modulator"]
    (coarse, _), (fine, seconds) = (timed(lambda r=r: problem.solve("radau", r, keep="end")) for r in (1e-4, 1e-6))
    off = abs(coarse.y[0, -1] - fine.y[0, -1])
    yield "ring modulator, 1e-4 against 1e-6: y1; s at 1e-6", "1e-5", f"{off:.1e}; {seconds:.1f}"
    one, two = (PROBLEMS[name].solve("dop853", 1e-6) for name in ("pendulum", "pendulum, first order"))
    same = one.nfev == two.nfev and np.array_equal(one.y, two.y[[0, 1, 4]])
    yield "first and second order form: f; same digits", "the same", f"{one.nfev}, {two.nfev}; {same}"


def first_results() -> Iterator[Row]:
    def whole(problem: DaeProblem, method: str, rtol: float) -> Any:
        return problem.solve(method, rtol)

    problem = PROBLEMS["pendulum"]
    yield "pendulum, analysis and solve: s", "0.3", f"{timed(lambda: whole(problem, 'dop853', 1e-6))[1]:.2f}"
    sol, seconds = timed(lambda: whole(fekete(), "radau", 1e-6))
    yield "Fekete 20, radau, 1e-6: error; s", "1e-8; 3", f"{fekete().error(sol):.1e}; {seconds:.1f}"
    _, analysis = timed(lambda: pendula(6).analysed())
    _, seconds = timed(lambda: whole(pendula(6), "radau", 1e-6))
    yield "index 13: analysis; first run with radau: s", "0.5; 3", f"{analysis:.2f}; {seconds:.1f}"
    yield from chains()


def chains() -> Iterator[Row]:
    yield from against_mechanics(50)
    for count in (125, 250, 500):
        _, seconds = timed(lambda k=count: chain(k, end=0.01).solve("dop853", 1e-6, keep="end"))
        yield f"chain of {count}: first result: s; per link", "constant", f"{seconds:.1f}; {seconds / count:.4f}"


def against_mechanics(links: int) -> Iterator[Row]:
    problem = chain(links)

    def force(t: float, q: Any, v: Any) -> Any:
        return np.tile([0, -GRAVITY], links)

    def lengths(t: float, q: Any) -> Any:
        d = np.concatenate([q[:2], q[2:] - q[:-2]])
        return (d[::2] ** 2 + d[1::2] ** 2 - 1 / links**2) / 2

    q0 = np.asarray(problem.y0)[: 2 * links]
    options = {"method": "dop853", "rtol": 1e-6, "atol": 1e-8}
    system = iv.MechanicalSystem(np.ones(2 * links), force, lengths).problem(problem.t_span, q0, 0 * q0)
    expected = system.solve(**options)
    _, of_mechanics = timed(lambda: system.solve(**options))
    sol, first = timed(lambda: problem.solve("dop853", 1e-6))
    _, again = timed(lambda: sol._origin.source.problem.solve(**options))
    off = np.abs(sol.y[: 2 * links, -1] - expected.y[: 2 * links, -1]).max()
    yield "chain of 50: first result: s", "3", f"{first:.2f}"
    yield "chain of 50, again: times MechanicalSystem", "2", f"{again / of_mechanics:.2f}"
    yield "chain of 50: difference from MechanicalSystem", "1e-12", f"{off:.1e}"


def opaque(equations: Callable[..., Any]) -> Callable[..., Any]:
    """The same residuals as a function that cannot be traced, and that counts its calls."""

    def unpacked(t: float, y: Any, yp: Any) -> Any:
        unpacked.calls += 1
        n = len(y)
        values = struct.unpack(f"{2 * n}d", struct.pack(f"{2 * n}d", *y, *yp))
        return np.array(equations(t, values[:n], values[n:]))

    unpacked.calls = 0
    return unpacked


def by_ida(IDA: Any, F: Callable[..., Any], t_span: tuple[float, float], start: Any, rtol: float, atol: float) -> Any:
    """The solution of SUNDIALS' IDA, from a consistent start."""

    def residual(t: float, y: Any, yp: Any, out: Any) -> None:
        out[:] = F(t, y, yp)

    solver = IDA(residual, rtol=rtol, atol=atol, max_num_steps=10**6)
    return solver.solve(np.array(t_span, dtype=float), start.y, start.yp)


def residual_form() -> Iterator[Row]:
    """Calls of F that cannot be traced, structure included, against those of IDA."""
    try:
        from sksundae.ida import IDA
    except ModuleNotFoundError:
        IDA = None
    for name in ("robertson", "akzo", "transistors"):
        problem = PROBLEMS[name]
        start = problem.analysed().consistent()
        for rtol in (1e-4, 1e-6):
            atol = rtol * (1e-6 if name == "robertson" else 1e-2)
            texts = []
            for method in ("ode15s", "radau"):
                F = opaque(problem.F)
                sol = iv.solve_dae(
                    F, problem.t_span, start.y, start.yp, method=method, rtol=rtol, atol=atol, keep="end"
                )
                texts.append(f"{method} {F.calls}, {problem.error(sol):.0e}")
            theirs = "–"
            if IDA is not None:
                F = opaque(problem.F)
                found = by_ida(IDA, F, problem.t_span, start, rtol, atol)
                end = found.y[-1][[*problem.components]]
                scale = np.maximum(np.abs(problem.reference()), problem.floor)
                theirs = f"IDA {F.calls}, {(np.abs(end - problem.reference()) / scale).max():.0e}"
            yield f"{name} as it stands, {rtol:.0e}: calls, error", theirs, "; ".join(texts)


def main() -> None:
    warnings.simplefilter("ignore")
    parts = sys.argv[1:] or ["accuracy", "first_results", "residual_form", "constraints"]
    print(machine())
    rows = [row for part in parts for row in globals()[part]()]
    print(table(["", "wanted", "measured"], [[*row] for row in rows]))


if __name__ == "__main__":
    main()
