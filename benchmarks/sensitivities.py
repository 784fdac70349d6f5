"""What sensitivities gain by projection and cost: ``python benchmarks/sensitivities.py [--write]``, or ``make bench``.

Kepler's problem without projection, with y projected alone, and with y and its sensitivities; Robertson's problem; the
time of a run with k sensitivities at the mesh of a run without; a gradient backwards against forward sensitivities; and
CVODES and diffrax.
``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from statistics import median
from typing import NamedTuple

import numpy as np
from measure import folded, interleaved, machine, ratio, run, table
from numpy.typing import NDArray

import invariode as iv

Array = NDArray[np.float64]

# ----------------------------------------------------------------------------------------------------------------------
# Kepler

ECCENTRICITY = 0.5
ORBIT = [1 - ECCENTRICITY, 0.0, 0.0, np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY))]
END = 20 * np.pi
RTOLS = tuple(10.0**-k for k in range(4, 10))
SHOWN = 1e-6


def kepler(t, y):
    r = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / r, -y[1] / r]


def energy_and_momentum(t, y):
    return [(y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2), y[0] * y[3] - y[1] * y[2]]


def by_hand(t, Y):
    """The same with its variational equations, S by columns: what a user would write, and y alone is projected."""
    x, y, u, v = Y[:4]
    r2 = x * x + y * y
    r3, r5 = r2**1.5, r2**2.5
    xx, xy, yy = 3 * x * x / r5 - 1 / r3, 3 * x * y / r5, 3 * y * y / r5 - 1 / r3
    columns = [c for a, b, c, d in Y[4:].reshape(4, 4) for c in (c, d, xx * a + xy * b, xy * a + yy * b)]
    return [u, v, -x / r3, -y / r3, *columns]


def laws_of_y(t, Y):
    return energy_and_momentum(t, Y[:4])


def orbits(method: str, rtol: float, reference: Array) -> list[str]:
    options = {"rtol": rtol, "atol": rtol / 100, "max_step": np.inf, "keep": "end"}
    ours = partial(iv.solve_ivp, kepler, (0, END), ORBIT, method, sensitivities="y0", **options)
    start = np.concatenate([ORBIT, np.eye(4).ravel()])
    sols = [ours(), iv.solve_ivp(by_hand, (0, END), start, method, invariants=laws_of_y, **options)]
    sols.append(ours(invariants=energy_and_momentum))
    found = [sols[0].sensitivities[:, :, -1], sols[1].y[4:, -1].reshape(4, 4).T, sols[2].sensitivities[:, :, -1]]
    errors = [np.abs(one - reference).max() / np.abs(reference).max() for one in found]
    return [method, f"{rtol:.0e}", *(str(sol.nfev) for sol in sols), *(f"{error:.1e}" for error in errors)]


def projected() -> list[str]:
    tight = {"rtol": 1e-13, "atol": 1e-15, "max_step": np.inf}
    exact = iv.solve_ivp(
        kepler, (0, END), ORBIT, "ode89", invariants=energy_and_momentum, sensitivities="y0", **tight
    ).sensitivities[:, :, -1]
    rows = [orbits(method, rtol, exact) for method in ("ode45", "dop853", "ode113", "radau") for rtol in RTOLS]
    ways = ("none", "y alone", "y and S")
    header = ["Kepler", "rtol", *(f"f: {way}" for way in ways), *(f"error of S: {way}" for way in ways)]
    return [
        table(header, [row for row in rows if row[1] == f"{SHOWN:.0e}"]),
        folded("Every tolerance", table(header, rows)),
    ]


# ----------------------------------------------------------------------------------------------------------------------
# Robertson

RATES = (0.04, 1e4, 3e7)
TIMES = (0.4, 4e7, 4e10)


def robertson(t, y, k1, k2, k3):
    a, b, c = k1 * y[0], k2 * y[1] * y[2], k3 * y[1] ** 2
    return [-a + b, a - b - c, c]


def kinetics(method: str, rtol: float, **options: object) -> iv.Solution:
    given = {"args": RATES, "rtol": rtol, "atol": [rtol * 1e-4, rtol * 1e-10, rtol * 1e-2], "max_step": np.inf}
    return iv.solve_ivp(robertson, (0, TIMES[-1]), [1.0, 0, 0], method, **given | options)


def stiff() -> list[str]:
    exact = kinetics("radau", 1e-9, sensitivities=True, dense_output=True)
    rows = []
    for method in ("ode15s", "radau", "ode23t", "ode23tb", "ode23s"):
        sol = kinetics(method, 1e-4, sensitivities=True, dense_output=True)
        plain = kinetics(method, 1e-4)
        errors = []
        for t in TIMES:
            truth = exact.sol.sensitivities(t)
            errors.append(f"{np.abs(sol.sol.sensitivities(t) - truth).max() / np.abs(truth).max():.0e}")
        rows.append(
            [method, str(plain.stats.steps), str(sol.stats.steps), str(sol.stats.failed), str(sol.nlu), *errors]
        )
    header = ["Robertson, rtol 1e-4", "steps without S", "with", "failed", "LU", *(f"error at {t:.0e}" for t in TIMES)]
    return [table(header, rows)]


# ----------------------------------------------------------------------------------------------------------------------
# Costs


def predators(t, y, a, b, c, d):
    return [a * y[0] - b * y[0] * y[1], -c * y[1] + d * y[0] * y[1]]


def costs(repetitions: int) -> list[str]:
    """With the steps of y: of one run with k sensitivities in units of one without."""
    rows = []
    for fun, args, span, y0, methods, rtol in (
        (predators, (1.5, 1.0, 3.0, 1.0), (0, 100), [1.0, 1.0], ("ode23", "ode45", "dop853", "ode89", "ode113"), 1e-8),
        (robertson, RATES, (0, 4e7), [1.0, 0.0, 0.0], ("ode15s", "ode23t", "ode23tb", "ode23s", "radau"), 1e-5),
    ):
        code = iv.compile(fun)
        for method in methods:
            wanted = iv.Sensitivities(error_test=False, scale=args)
            problem = iv.Problem(code, span, y0, args=args)
            options = {"rtol": rtol, "atol": rtol * 1e-6, "max_step": np.inf, "keep": "end"}
            plain = problem.prepare(method, **options)
            varied = problem.replace(sensitivities=wanted).prepare(method, **options)
            times = interleaved({"plain": plain, "varied": varied}, repetitions)
            steps = plain().stats.steps
            rows.append(
                [fun.__name__, method, str(len(args)), str(steps), f"{ratio(times['varied'], times['plain']):.2f}"]
            )
    return [table(["Native f, equal mesh", "method", "k", "steps", "time / time without"], rows)]


def pushed(t, y, weights, nodes):
    return [y[1], -y[0] + weights @ np.exp(-((t - nodes) ** 2))]


def gradients(repetitions: int) -> list[str]:
    rows, code = [], iv.compile(pushed)
    for k in (4, 16, 64, 256):
        nodes = np.linspace(0, 10, k)
        names = [f"weights[{i}]" for i in range(k)]
        options = {"args": (np.cos(nodes), nodes), "rtol": 1e-8, "atol": 1e-10, "max_step": np.inf}
        solve = partial(iv.solve_ivp, code, (0, 10), [1.0, 0.0], "dop853", **options)
        known = solve(adjoint=True)
        forward = {"forward": lambda names=names, solve=solve: solve(sensitivities=names)}
        backward = {"backward": lambda names=names, known=known: known.gradient([1.0, 0.0], wrt=names)}
        plain = {"plain": lambda solve=solve: solve(adjoint=True)}
        times = interleaved(forward | backward | plain, repetitions)
        forth, back = solve(sensitivities=names).sensitivities[0, :, -1], known.gradient([1.0, 0.0], wrt=names)
        cells = [f"{1e3 * median(times[way]):.1f}" for way in ("plain", "forward", "backward")]
        rows.append([str(k), *cells, f"{np.abs(forth - back).max() / np.abs(forth).max():.0e}"])
    return [table(["Parameters", "ms: y alone", "sensitivities", "gradient after it", "apart"], rows)]


# ----------------------------------------------------------------------------------------------------------------------
# Beside other codes


class Contestant(NamedTuple):
    """A code on one problem: a run without sensitivities, and one with them that returns S (n, k) at the end."""

    name: str
    plain: Callable[[], object]
    varied: Callable[[], Array]


class Case(NamedTuple):
    """A problem for other codes, and theirs to write: ``jacfwd`` and CasADi trace this f."""

    fun: Callable[..., list[object]]
    args: tuple[float, ...]
    y0: list[float]
    end: float
    rtol: float
    atol: list[float]


CASES = (
    Case(predators, (1.5, 1.0, 3.0, 1.0), [1.0, 1.0], 10.0, 1e-8, [1e-10, 1e-10]),
    Case(robertson, RATES, [1.0, 0.0, 0.0], 4e7, 1e-6, [1e-10, 1e-16, 1e-8]),
)


def ours(case: Case, method: str) -> Contestant:
    problem = iv.Problem(iv.compile(case.fun), (0, case.end), case.y0, args=case.args)
    options = {"rtol": case.rtol, "atol": case.atol, "max_step": np.inf, "keep": "end"}
    plain = problem.prepare(method, **options)
    varied = problem.replace(sensitivities=iv.Sensitivities(scale=case.args)).prepare(method, **options)
    return Contestant(f"invariode {method}", plain, lambda: varied().sensitivities[:, :, -1])


def cvodes(case: Case) -> Contestant:
    """CVODES of SUNDIALS with its forward sensitivities in the error test, as CasADi calls it, with exact Jacobians."""
    import casadi

    y, p = casadi.SX.sym("y", len(case.y0)), casadi.SX.sym("p", len(case.args))
    slope = case.fun(0.0, casadi.vertsplit(y), *casadi.vertsplit(p))
    equations = {"x": y, "p": p, "ode": casadi.vertcat(*slope)}
    options = {"reltol": case.rtol, "abstol": min(case.atol), "max_num_steps": 10**6, "fsens_err_con": True}
    end = casadi.integrator("end", "cvodes", equations, 0, case.end, options)
    jacobian = end.factory("jacobian", ["x0", "p"], ["xf", "jac:xf:p"])
    return Contestant(
        f"CVODES (CasADi {casadi.__version__})",
        lambda: end(x0=case.y0, p=case.args),
        lambda: np.array(jacobian(case.y0, case.args)[1]),
    )


def diffrax_of(case: Case) -> Contestant:
    """diffrax, compiled, in double precision: derivatives of the steps, forwards."""
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    stiff = case.fun is robertson
    solver = diffrax.Kvaerno5() if stiff else diffrax.Dopri8()
    controller = diffrax.PIDController(rtol=case.rtol, atol=jnp.array(case.atol))
    term = diffrax.ODETerm(lambda t, y, p: jnp.stack(case.fun(t, y, *p)))

    def end(p: object) -> object:
        given = {"stepsize_controller": controller, "max_steps": 10**5, "adjoint": diffrax.ForwardMode()}
        found = diffrax.diffeqsolve(term, solver, 0.0, case.end, None, jnp.array(case.y0), p, **given)
        return found.ys[0]

    p = jnp.array(case.args)
    plain, varied = jax.jit(end), jax.jit(jax.jacfwd(end))
    return Contestant(
        f"diffrax {diffrax.__version__} {type(solver).__name__}",
        lambda: plain(p).block_until_ready(),
        lambda: np.array(varied(p)),
    )


def beside(repetitions: int) -> list[str]:
    rows = []
    for case, methods in zip(CASES, (("dop853", "ode113"), ("ode15s", "radau")), strict=True):
        exact = reference_of(case)
        contestants = [*(ours(case, method) for method in methods), cvodes(case), diffrax_of(case)]
        for one in contestants:
            times = interleaved({"plain": one.plain, "varied": one.varied}, repetitions)
            error = np.abs(one.varied() - exact).max(axis=0) / np.abs(exact).max(axis=0)
            cells = [f"{1e3 * median(times[way]):.2f}" for way in ("plain", "varied")]
            rows.append(
                [
                    case.fun.__name__,
                    one.name,
                    *cells,
                    f"{ratio(times['varied'], times['plain']):.1f}",
                    f"{error.max():.0e}",
                ]
            )
    return [table(["Problem", "code", "ms: y alone", "y and S", "ratio", "error of S"], rows)]


def reference_of(case: Case) -> Array:
    """S by radau at tolerances far below."""
    return ours(case._replace(rtol=1e-12, atol=[1e-5 * one for one in case.atol]), "radau").varied()


def report(repetitions: int) -> str:
    parts = [f"{machine('invariode', 'numpy')}. Errors are the largest, relative to the largest entry of S."]
    few = max(3, repetitions // 4)
    return "\n\n".join([*parts, *projected(), *stiff(), *costs(repetitions), *gradients(few), *beside(few)])


if __name__ == "__main__":
    run("sensitivities", __doc__, report, repetitions=20)
