"""Recomputes the references of the stiff test set: ``python benchmarks/references.py [names...]``.

SciPy's Radau gives the reference. Another code of another family, CVODE's BDF (``pip install scikit-sundae``), solves
the same problem to say how many digits agree; where the Jacobian is sparse, that is SciPy's explicit DOP853, which such
mild stiffness does not keep from being fast.
"""

from __future__ import annotations

import sys
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import scipy.integrate
from measure import machine, table
from numpy.typing import NDArray
from scipy import sparse
from sksundae.cvode import CVODE  # type: ignore[import-untyped]  # scikit-sundae ships no types

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from stiff import DATA, PROBLEMS, StiffProblem, references

Array = NDArray[np.float64]

#: Where Radau's relative tolerance is not 1e-13. Van der Pol's jumps take about 1e-12 at eps = 1e-12: steps in them
#: would be below the spacing of t. In two dimensions 1e-11 saves time, and the check cannot tell.
RTOL = {"van der Pol, eps = 1e-12": 1e-10, "Brusselator, 2-D": 1e-11}

#: Time and solution at it, from the Test Set for IVP Solvers (release 2.4): RADAU5 and RADAU with a unit roundoff of
#: 1e-19. All but Robertson's are at the end of the interval.
PUBLISHED = {
    "Robertson": (1e11, [0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050]),
    "HIRES": (321.8122, [
        0.7371312573325668e-3, 0.1442485726316185e-3, 0.5888729740967575e-4, 0.1175651343283149e-2,
        0.2386356198831331e-2, 0.6238968252742796e-2, 0.2849998395185769e-2, 0.2850001604814231e-2,
    ]),
    "Oregonator": (360, [0.1000814870318523e1, 0.1228178521549917e4, 0.1320554942846706e3]),
    "van der Pol, mu = 1e3": (2000, [0.1706167732170469e1, -0.8928097010248125e-3]),
    "van der Pol, eps = 1e-6": (2, [0.1706167732170483e1, -0.8928097010247975]),
    "pollution": (60, [
        0.5646255480022769e-1, 0.1342484130422339, 0.4139734331099427e-8, 0.5523140207484359e-2,
        0.2018977262302196e-6, 0.1464541863493966e-6, 0.7784249118997964e-1, 0.3245075353396018,
        0.7494013383880406e-2, 0.1622293157301561e-7, 0.1135863833257075e-7, 0.2230505975721359e-2,
        0.2087162882798630e-3, 0.1396921016840158e-4, 0.8964884856898295e-2, 0.4352846369330103e-17,
        0.6899219696263405e-2, 0.1007803037365946e-3, 0.1772146513969984e-5, 0.5682943292316392e-4,
    ]),
}  # fmt: skip


def radau(problem: StiffProblem) -> Array:
    return scipys(problem, scipy.integrate.Radau, RTOL.get(problem.name, 1e-13), jac=partial(unpacked, problem))


def dop853(problem: StiffProblem) -> Array:
    return scipys(problem, scipy.integrate.DOP853, 1e-12)


def scipys(problem: StiffProblem, method: type[scipy.integrate.OdeSolver], rtol: float, **options: Any) -> Array:
    """SciPy's method, from output to output: its steps end there, and its dense output is not used."""
    y, outputs, h = problem.y0, [], None
    for t0, t in pairwise((problem.t_span[0], *problem.times)):
        first_step = h and min(h, t - t0)
        solver = method(
            partial(rhs, problem), t0, y, t, rtol=rtol, atol=rtol * problem.scale, first_step=first_step, **options
        )
        while solver.status == "running":
            message = solver.step()
        if solver.status == "failed":
            raise RuntimeError(f"{problem.name}, t = {solver.t}: {message}")
        y, h = solver.y, solver.h_abs
        outputs.append(y[:: problem.every])
    return np.array(outputs).T


def cvode(problem: StiffProblem) -> Array:
    """CVODE's BDF with the analytic Jacobian, or with its own differences if that is banded."""

    def fun(t: float, y: Array, dy: Array) -> None:
        dy[:] = rhs(problem, t, y)

    def jac(t: float, y: Array, dy: Array, J: Array) -> None:
        J[:] = problem.jac(t, y, *problem.args)

    options: dict[str, Any] = {"jacfn": jac}
    if problem.lband is not None:
        options = {"linsolver": "band", "lband": problem.lband, "uband": problem.uband}
    solver = CVODE(fun, rtol=1e-13, atol=1e-13 * problem.scale, max_num_steps=10**8, **options)
    sol = solver.solve(np.append(problem.t_span[0], problem.times), problem.y0)
    if not sol.success:
        raise RuntimeError(f"{problem.name}: {sol.message}")
    return np.asarray(sol.y)[1:, :: problem.every].T


def rhs(problem: StiffProblem, t: float, y: Array) -> Array:
    return np.asarray(problem.fun(t, y, *problem.args))


def unpacked(problem: StiffProblem, t: float, y: Array) -> Any:
    """The Jacobian as a matrix, whether the problem packs it or not."""
    J = problem.jac(t, y, *problem.args)
    if problem.lband is None:
        return J
    offsets = problem.uband - np.arange(len(J))
    return sparse.dia_array((J, offsets), shape=(len(y), len(y))).tocsc()


def verify(problem: StiffProblem) -> None:
    """J·v is the derivative along v, found by a complex step, and c·f = 0, both to rounding, near y0."""
    random = np.random.default_rng(0)
    y, v = problem.y0 + problem.scale * random.random(len(problem.y0)), random.standard_normal(len(problem.y0))
    J, step = unpacked(problem, 0.0, y), 1e-30
    derivative = problem.fun(0.0, y + 1j * step * v, *problem.args).imag / step
    assert np.all(np.abs(derivative - J @ v) <= 1e-14 * (abs(J) @ np.abs(v))), f"{problem.name}: Jacobian"
    if problem.jac_sparsity is not None:
        assert np.array_equal(J.indices, problem.jac_sparsity.indices), f"{problem.name}: pattern"
    if problem.invariants is not None:
        f, C = problem.fun(0.0, y, *problem.args), problem.invariants
        assert np.all(np.abs(C @ f) <= 1e-14 * (np.abs(C) @ np.abs(f))), f"{problem.name}: invariants"


def published(problem: StiffProblem, y: Array) -> str:
    """Largest weighted difference to the published solution."""
    if problem.name not in PUBLISHED:
        return "–"
    t, exact = PUBLISHED[problem.name]
    index = int(np.argmin(np.abs(problem.times - t)))
    return f"{problem.difference(y[:, index, None], np.array(exact)[:, None]).max():.1e}"


def main(names: list[str]) -> None:
    known = dict(references()) if DATA.exists() else {}
    rows = []
    for name in names or PROBLEMS:
        problem = PROBLEMS[name]
        verify(problem)
        solutions, row = [], [name]
        for solve in (radau, cvode if problem.jac_sparsity is None else dop853):
            start = perf_counter()
            solutions.append(solve(problem))
            row.append(f"{solve.__name__}, {perf_counter() - start:.1f} s")
        reference, check = solutions
        rows.append([*row, f"{problem.difference(check, reference).max():.1e}", published(problem, reference)])
        print(*rows[-1], sep=" | ", file=sys.stderr, flush=True)
        known[name] = reference
    print(machine("numpy", "scipy", "scikit-sundae"), "", sep="\n")
    print(table(["problem", "reference", "check", "difference", "to published"], rows))
    np.savez_compressed(DATA, **{name: known[name] for name in PROBLEMS if name in known})


if __name__ == "__main__":
    main(sys.argv[1:])
