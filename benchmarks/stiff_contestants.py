"""The solvers that compete on stiff problems: ours, SciPy's and those of SUNDIALS, with the same f and Jacobian."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.integrate
from scipy import sparse

import invariode as iv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from stiff import StiffProblem

try:
    from sksundae.cvode import CVODE  # type: ignore[import-untyped]  # scikit-sundae ships no types
    from sksundae.ida import IDA  # type: ignore[import-untyped]  # scikit-sundae ships no types
except ImportError:
    CVODE = IDA = None

MOST_STEPS = 10**7


@dataclass(frozen=True)
class Outcome:
    """Error of a run, evaluations of f and of its Jacobian, factorisations."""

    error: float
    f: int
    jacobians: int | None = None
    factorizations: int | None = None


#: A run at a relative tolerance.
Solve = Callable[[float], Outcome]

#: Options of solve_ivp, by the names in the tables.
OWN: Mapping[str, Mapping[str, Any]] = {
    "ode15s": {"method": "ode15s"},
    "ode15s, bdf": {"method": "ode15s", "bdf": True},
    "radau": {"method": "radau"},
}


def stiff_contestants(p: StiffProblem, own: Mapping[str, Mapping[str, Any]] = OWN) -> dict[str, Solve]:
    """All solvers that take the problem, with the analytic Jacobian in the storage that each has for it."""
    large = p.jac_sparsity is not None
    found: dict[str, Solve] = {
        name: partial(ours, p, options)
        for name, options in own.items()
        if p.mass is None or iv.METHODS[options["method"]].mass == "any"
    }
    if p.mass is not None:
        return found | ({"IDA": partial(ida, p)} if IDA is not None else {})
    for method in ("BDF", "Radau", "LSODA"):
        if not large or method == "BDF":  # LSODA has no sparse matrices, Radau takes a minute
            found[f"SciPy {method}"] = partial(scipys, p, method)
    if CVODE is not None and not large:
        found["CVODE BDF"] = partial(cvode, p)
    return found


def tolerances(p: StiffProblem, rtol: float) -> dict[str, Any]:
    return {"rtol": rtol, "atol": rtol * p.scale}


def ours(p: StiffProblem, options: Mapping[str, Any], rtol: float) -> Outcome:
    known: dict[str, Any] = {"lband": p.lband, "uband": p.uband} if p.lband is not None else {}
    if p.mass is not None:
        known["mass"] = p.mass
    about = {"t_eval": p.times, "args": p.args, "jac": p.jac, **tolerances(p, rtol), **known, **options}
    sol = iv.solve_ivp(p.fun, p.t_span, p.y0, **about)
    calls = sol.nfev + sol.stats.nfev_check
    return Outcome(p.error(sol.y) if sol.success else np.inf, calls, sol.njev, sol.nlu)


def scipys(p: StiffProblem, method: str, rtol: float) -> Outcome:
    def as_sparse(t: float, y: Any, *args: Any) -> Any:
        ab = p.jac(t, y, *args)
        return sparse.dia_array((ab, p.uband - np.arange(len(ab))), (len(y), len(y))).tocsc()

    options: dict[str, Any] = {"jac": p.jac}
    if p.lband is not None:
        options = {**options, "lband": p.lband, "uband": p.uband} if method == "LSODA" else {"jac": as_sparse}
    about = {"t_eval": p.times, "args": p.args or None, **tolerances(p, rtol), **options}
    sol = scipy.integrate.solve_ivp(p.fun, p.t_span, p.y0, method, **about)
    return Outcome(p.error(sol.y) if sol.success else np.inf, sol.nfev, sol.njev, sol.nlu or None)


def cvode(p: StiffProblem, rtol: float) -> Outcome:
    def rhs(t: float, y: Any, yp: Any) -> None:
        yp[:] = p.fun(t, y, *p.args)

    def jacobian(t: float, y: Any, yp: Any, J: Any) -> None:
        J[:] = p.jac(t, y, *p.args)

    options: dict[str, Any] = {"linsolver": "dense", "jacfn": jacobian}
    if p.lband is not None:  # with its own differences: scikit-sundae would copy a full matrix
        options = {"linsolver": "band", "lband": p.lband, "uband": p.uband}
    solver = CVODE(rhs, max_num_steps=MOST_STEPS, **tolerances(p, rtol), **options)
    return of_sundials(p, solver.solve(output_times(p), p.y0))


def ida(p: StiffProblem, rtol: float) -> Outcome:
    return of_sundials(p, solved_by_ida(p, rtol))


def solved_by_ida(p: StiffProblem, rtol: float, given: bool = True) -> Any:
    """IDA solves F(t, y, y') = 0; it asks for y' at the start, and for one Jacobian by y and y' together, which is
    computed by differences if it is not `given`."""

    def residual(t: float, y: Any, slope: Any, F: Any) -> None:
        F[:] = p.mass @ slope - p.fun(t, y)

    def jacobian(t: float, y: Any, slope: Any, F: Any, c: float, J: Any) -> None:
        J[:] = c * p.mass - p.jac(t, y)

    known = {"jacfn": jacobian} if given else {}
    solver = IDA(residual, linsolver="dense", max_num_steps=MOST_STEPS, **known, **tolerances(p, rtol))
    return solver.solve(output_times(p), p.y0, p.slope)


def output_times(p: StiffProblem) -> Any:
    """The start and `times`, at least three: with two, all steps between them come back."""
    t0, first = p.t_span[0], p.times[0]
    return np.concatenate(([t0], [] if len(p.times) > 1 else [(t0 + first) / 2], p.times))


def of_sundials(p: StiffProblem, sol: Any) -> Outcome:
    outputs = sol.y[-len(p.times) :].T
    return Outcome(p.error(outputs) if sol.success else np.inf, sol.nfev, sol.njev)
