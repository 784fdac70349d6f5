"""Work and precision against other packages: ``python benchmarks/peers.py [--write] [--problem NAME ...]``.

Every solver solves every problem of nonstiff.py at tolerances rtol = atol from 1e-3 to 1e-13, two per decade, with the
right-hand side compiled, in the fastest form found that the package offers to a user of Python; what can be set up
beforehand and used again (a compiled function, a problem, an integrator) is set up outside of the timing. The error is
that of the final state, the largest over the components; the tables give the time needed for an error. ``--write`` puts
the tables and the plots into docs/benchmarks.

- invariode: `iv.Problem` with functions of `iv.compile`, ``keep="end"``; projected with compiled invariants and their
  compiled Jacobian.
- SciPy, extensisq, homproj: an array from a function of numba's; they keep all steps, which costs them less than to
  interpolate the final state (``t_eval``). homproj projects: its invariants and gradients are compiled too, and called
  from Python.
- CyRK: `nbsolve2_ivp` with a function of `cyjit`: the interpreter takes no part in the steps. It keeps all steps.
- CVODE (scikit-sundae): Adams with a function of numba's that fills an array, called from Python; the final state only.
- heyoka: a Taylor integrator for each tolerance (whole decades, down to 1e-16), reset and used again.
- diffrax: one jitted function per problem and method, the tolerance an argument; float64, the final state only.
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numba
import numpy as np
import scipy.integrate
from measure import PAGES, folded, installed, interleaved, machine, table, write_section
from nonstiff import PROBLEMS, Function, Problem
from numpy.typing import NDArray

import invariode as iv
from invariode._base.style import COLOURS

Array = NDArray[np.float64]
Run = Callable[[], Any]  # solves, and returns the final state

TOLERANCES = tuple(10 ** (-k / 2) for k in range(6, 27))
TAYLOR_TOLERANCES = tuple(10.0**-k for k in range(3, 17))
ERRORS = tuple(10.0**-k for k in range(3, 13))
LONGEST = 0.1  # seconds of one run: no tighter tolerance after that
MOST_STEPS = 10**5  # of the solvers that take a bound
SHORTEST = 1e-3  # seconds of what is timed: shorter runs are repeated
USELESS = 1.0  # an error that tells nothing about the solution
WRONG = 1e-3  # a solver is wrong that has no smaller error at any tolerance
ULP = 1e-16  # an error of 0 has no logarithm
MUTED = ("#8c8c8c", "#5f8f8f", "#b08f5f", "#9aa35a", "#9b8fc0", "#404040", "#c09090")  # one for each package
AGREEMENT = 1e-11  # of the two references, relative to the largest component
DOUBLE_AGREEMENT = 1e-10  # where both have the roundoff of double precision

PLAIN, PROJECTED, PEER, PROJECTED_PEER, TAYLOR = "plain", "projected", "peer", "projected peer", "Taylor"


class SolverError(Exception):
    """A solver said that it failed."""


@dataclass(frozen=True)
class Solver:
    """A solver of one problem: `at(tolerance)` sets up, and returns what is timed."""

    name: str
    kind: str
    at: Callable[[float], Run]
    tolerances: Sequence[float] = TOLERANCES


# ----------------------------------------------------------------------------------------------------------------------
# The right-hand side in the forms that packages take


@numba.njit(error_model="numpy")
def power(s: float) -> float:
    return 1.0 / (s * math.sqrt(s))


@cache
def compiled(name: str) -> Function:
    """f(t, y) of that problem, a tuple, for calls from compiled functions."""
    return numba.njit(PROBLEMS[name].rhs(power), error_model="numpy")


def returning(p: Problem) -> Callable[[float, Array], Array]:
    """f(t, y), an array."""
    f, n = compiled(p.name), len(p.y0)

    @numba.njit(error_model="numpy")
    def fun(t, y):
        values, out = f(t, y), np.empty(n)
        for i in range(n):
            out[i] = values[i]
        return out

    return fun


def filling(p: Problem) -> Callable[[float, Array, Array], None]:
    """f(t, y, out)."""
    f, n = compiled(p.name), len(p.y0)

    @numba.njit(error_model="numpy")
    def fun(t, y, out):
        values = f(t, y)
        for i in range(n):
            out[i] = values[i]

    return fun


# ----------------------------------------------------------------------------------------------------------------------
# Packages: each function imports its package, and gives its solvers of a problem


def with_invariode(p: Problem) -> Iterator[Solver]:
    """All methods that are not for stiff problems, plain and projected."""
    fun = iv.compile(p.rhs(power))
    for kind, problem in (
        (PLAIN, iv.Problem(fun, p.span, p.y0)),
        (PROJECTED, iv.Problem(fun, p.span, p.y0, invariants=invariants(p))),
    ):

        def at(tolerance: float, problem: iv.Problem, method: str) -> Run:
            def run() -> Array:
                sol = problem.solve(method, rtol=tolerance, atol=tolerance, keep="end")
                return finished(sol.success, sol.message, sol.y[:, -1])

            return run

        for method in iv.METHODS:
            if method != "ode15s":
                name = method if kind == PLAIN else f"{method}, projected"
                yield Solver(name, kind, partial(at, problem=problem, method=method))


def invariants(p: Problem) -> iv.Invariants:
    return iv.Invariants(iv.compile(p.g), jac=iv.compile(p.g_jac), names=list(p.names))


def with_scipy(p: Problem) -> Iterator[Solver]:
    yield from scipy_like(p, "SciPy", {"RK45": "RK45", "DOP853": "DOP853", "LSODA": "LSODA"})


def with_extensisq(p: Problem) -> Iterator[Solver]:
    from extensisq import SWAG

    yield from scipy_like(p, "extensisq", {"SWAG": SWAG})


def scipy_like(p: Problem, package: str, methods: Mapping[str, Any]) -> Iterator[Solver]:
    fun = returning(p)

    def at(tolerance: float, method: Any) -> Run:
        def run() -> Array:
            sol = scipy.integrate.solve_ivp(fun, p.span, p.y0, method, rtol=tolerance, atol=tolerance)
            return finished(sol.success, sol.message, sol.y[:, -1])

        return run

    for name, method in methods.items():
        yield Solver(f"{package} {name}", PEER, partial(at, method=method))


def with_homproj(p: Problem) -> Iterator[Solver]:
    """Functions of the components; g and its Jacobian are compiled once for all invariants."""
    import homproj

    fun, n = returning(p), len(p.y0)
    g, g_jac = numba.njit(p.g), numba.njit(p.g_jac)

    def invariant(k: int) -> tuple[Function, Function]:
        @numba.njit
        def value(*y):
            return g(0.0, y)[k]

        @numba.njit
        def gradient(*y):
            values, row = g_jac(0.0, y), np.empty(n)
            for i in range(n):
                row[i] = values[k * n + i]
            return row

        return value, gradient

    values, gradients = zip(*(invariant(k) for k in range(len(p.names))), strict=True)
    options = {"invariants": list(values), "gradients": list(gradients), "itol": 1e-14}

    def at(tolerance: float, method: str) -> Run:
        def run() -> Array:
            sol = homproj.solve_ivp(fun, p.span, p.y0, method, rtol=tolerance, atol=tolerance, **options)
            return finished(sol.success, sol.message, sol.y[:, -1])

        return run

    for method in ("RK45", "DOP853"):
        yield Solver(f"homproj {method}, projected", PROJECTED_PEER, partial(at, method=method))


def with_cyrk(p: Problem) -> Iterator[Solver]:
    from CyRK import nb_diffeq_addr, nbsolve2_ivp

    f, n = compiled(p.name), len(p.y0)

    def code(out_, t, y_, args_):
        values = f(t, numba.carray(y_, (n,)))
        out = numba.carray(out_, (n,))
        for i in range(n):
            out[i] = values[i]

    address, y0 = nb_diffeq_addr(code), np.array(p.y0)

    @numba.njit
    def solve(t0, tf, y0, method, tolerance):
        sol = nbsolve2_ivp(address, (t0, tf), y0, method=method, rtol=tolerance, atol=tolerance)
        success, y = sol.success, sol.y[:, -1].copy()
        sol.free()  # nothing else does
        return success, y

    def at(tolerance: float, method: str) -> Run:
        def run() -> Array:
            success, y = solve(*p.span, y0, method, tolerance)
            return finished(success, "no success", y)

        return run

    for method in ("RK45", "DOP853", "Vern7", "Vern8"):
        yield Solver(f"CyRK {method}", PEER, partial(at, method=method))


def with_sundials(p: Problem) -> Iterator[Solver]:
    from sksundae.cvode import CVODE  # type: ignore[import-untyped]  # scikit-sundae ships no types

    fun, times, y0 = filling(p), np.array(p.span), np.array(p.y0)

    def at(tolerance: float) -> Run:
        solver = CVODE(fun, method="Adams", rtol=tolerance, atol=tolerance, max_num_steps=MOST_STEPS)

        def run() -> Array:
            sol = solver.solve(times, y0)
            return finished(sol.success, sol.message, sol.y[-1])

        return run

    yield Solver("CVODE Adams", PEER, at)


def with_heyoka(p: Problem) -> Iterator[Solver]:
    import heyoka

    def at(tolerance: float) -> Run:
        integrator = taylor(p, float, tolerance)
        (t0, tf), y0 = p.span, np.array(p.y0)

        def run() -> Array:
            integrator.time = t0
            integrator.state[:] = y0
            outcome = integrator.propagate_until(tf)[0]
            return finished(outcome == heyoka.taylor_outcome.time_limit, str(outcome), integrator.state)

        return run

    yield Solver("heyoka", TAYLOR, at, TAYLOR_TOLERANCES)


def taylor(p: Problem, real: Any, tolerance: float, **options: Any) -> Any:
    """An integrator of heyoka's in this arithmetic."""
    import heyoka

    y = heyoka.make_vars(*(f"y{i}" for i in range(len(p.y0))))
    system = list(zip(y, p.rhs(lambda s: s**-1.5)(0.0, y), strict=True))
    start = [real(x) for x in p.y0]
    return heyoka.taylor_adaptive(system, start, time=real(p.span[0]), tol=real(tolerance), fp_type=real, **options)


def with_diffrax(p: Problem) -> Iterator[Solver]:
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    f = p.rhs(lambda s: 1.0 / (s * jnp.sqrt(s)))
    term = diffrax.ODETerm(lambda t, y, args: jnp.stack(f(t, y)))
    (t0, tf), y0 = p.span, jnp.array(p.y0)

    def at(tolerance: float, solve: Callable[..., Any]) -> Run:
        return lambda: solve(y0, tolerance).block_until_ready()

    def jitted(method: Any) -> Callable[..., Any]:
        @jax.jit
        def solve(y0, tolerance):
            sol = diffrax.diffeqsolve(
                term,
                method,
                t0,
                tf,
                None,
                y0,
                saveat=diffrax.SaveAt(t1=True),
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
                max_steps=MOST_STEPS,
                throw=False,
            )
            return jnp.where(sol.result == diffrax.RESULTS.successful, sol.ys[-1], jnp.nan)

        return solve

    for name, method in (("Tsit5", diffrax.Tsit5()), ("Dopri8", diffrax.Dopri8())):
        yield Solver(f"diffrax {name}", PEER, partial(at, solve=jitted(method)))


#: By the name of the distribution.
PACKAGES: Mapping[str, Callable[[Problem], Iterator[Solver]]] = {
    "invariode": with_invariode,
    "scipy": with_scipy,
    "CyRK": with_cyrk,
    "scikit-sundae": with_sundials,
    "extensisq": with_extensisq,
    "diffrax": with_diffrax,
    "heyoka": with_heyoka,
    "homproj": with_homproj,
}


def finished(success: bool, message: str, y: Any) -> Any:
    """The final state of a solver that reached the end."""
    if not success:
        raise SolverError(message)
    return y


def solvers(p: Problem) -> list[Solver]:
    """Those of the packages that are installed. One that cannot be set up fails at all tolerances."""
    found: list[Solver] = []
    for package, start in PACKAGES.items():
        if installed(package) is None:
            continue
        try:
            found += list(start(p))
        except Exception as failure:  # any exception of any package
            found.append(Solver(package, PEER, partial(failing, message=f"{type(failure).__name__}: {failure}")))
    return found


def failing(tolerance: float, message: str) -> Run:
    raise SolverError(message)


# ----------------------------------------------------------------------------------------------------------------------
# References


@dataclass(frozen=True)
class Reference:
    """The final state, where it is from, and how far another one is from it."""

    y: Array
    text: str

    def error(self, y: Any) -> float:
        return float(np.abs(np.asarray(y, dtype=float) - self.y).max())


def reference(p: Problem) -> Reference:
    """heyoka's in extended precision, or else the exact one or SciPy's; compared with that of another solver."""
    fun = returning(p)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rtol is raised to 2.2e-14
        dop853 = scipy.integrate.solve_ivp(fun, p.span, p.y0, "DOP853", rtol=3e-14, atol=1e-15).y[:, -1]
    known = ("SciPy's DOP853", dop853) if p.exact is None else ("the exact solution", np.array(p.exact))
    if installed("heyoka") is not None:
        integrator = taylor(p, np.longdouble, 1e-19, compact_mode=True)
        integrator.propagate_until(np.longdouble(p.span[1]))
        (name, y), (other, check), agreement = ("heyoka, 80 bits, tol = 1e-19", integrator.state), known, AGREEMENT
    else:
        sol = iv.solve_ivp(fun, p.span, p.y0, "ode113", rtol=1e-13, atol=1e-15, invariants=invariants(p))
        (name, y), (other, check), agreement = known, ("projected ode113", sol.y[:, -1]), DOUBLE_AGREEMENT
    found = Reference(np.array(y, dtype=float), name)
    apart = found.error(check)
    if apart > agreement * max(1.0, np.abs(found.y).max()):
        raise SystemExit(f"{p.name}: the references disagree: {name} and {other} by {apart:.1e}")
    return Reference(found.y, f"{name}; {other} is {apart:.0e} from it")


# ----------------------------------------------------------------------------------------------------------------------
# Measurement


@dataclass
class Point:
    """One solver at one tolerance."""

    tolerance: float
    error: float
    run: Run
    number: int  # of runs that are timed together
    seconds: float = math.nan


@dataclass
class Line:
    """A solver's points, from loose to tight tolerances, and what is to be said of others."""

    solver: Solver
    points: list[Point] = field(default_factory=list)
    left_out: dict[str, list[float]] = field(default_factory=dict)  # reasons, with the tolerances

    def leave_out(self, reason: str, *tolerances: float) -> None:
        self.left_out.setdefault(reason, []).extend(tolerances)

    def at_error(self, error: float) -> float | None:
        """Least seconds that reach the error, interpolated on logarithms between neighbouring tolerances."""
        found = [point.seconds for point in self.points if point.error <= error]
        for a, b in pairwise(self.points):
            if min(a.error, b.error) < error < max(a.error, b.error):
                weight = math.log(error / a.error) / math.log(b.error / a.error)
                found.append(a.seconds * (b.seconds / a.seconds) ** weight)
        return min(found, default=None)


def try_out(solver: Solver, exact: Reference) -> Line:
    """Errors at all tolerances, with what failed; nothing is timed that is wrong."""
    line = Line(solver)
    for tolerance in solver.tolerances:
        try:
            run = solver.at(tolerance)
            run()  # compiles
            start = perf_counter()
            error = exact.error(run())
            seconds = perf_counter() - start
        except Exception as failure:  # any exception of any package is a failure of that solver here
            line.leave_out(" ".join(str(failure).split())[:120] or type(failure).__name__, tolerance)
            continue
        if not error < USELESS:
            line.leave_out(f"error above {USELESS:g}", tolerance)
            continue
        line.points.append(Point(tolerance, max(error, ULP), run, math.ceil(SHORTEST / seconds)))
        if seconds > LONGEST:
            break
    if line.points and min(point.error for point in line.points) > WRONG:
        line.leave_out(f"no error below {WRONG:.0e}", *(point.tolerance for point in line.points))
        line.points = []
    return line


def repeated(run: Run, number: int) -> Callable[[], None]:
    def loop() -> None:
        for _ in range(number):
            run()

    return loop


def measure(p: Problem, exact: Reference, repetitions: int) -> list[Line]:
    """All solvers at all tolerances in turn."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # what solvers warn of is in the errors
        lines = [try_out(solver, exact) for solver in solvers(p)]
        points = {f"{x.solver.name} {point.tolerance}": point for x in lines for point in x.points}
        times = interleaved({name: repeated(point.run, point.number) for name, point in points.items()}, repetitions)
    for name, point in points.items():
        point.seconds = median(times[name]) / point.number
    return lines


# ----------------------------------------------------------------------------------------------------------------------
# Tables


def milliseconds(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    return f"{1e3 * seconds:.3f}" if seconds < 1e-2 else f"{1e3 * seconds:.1f}"


def quotient(a: float | None, b: float | None) -> str:
    return "–" if a is None or b is None else f"{a / b:.2f}"


def all_times(lines: Sequence[Line]) -> str:
    """Milliseconds of every solver for every error."""
    kinds = (PLAIN, PROJECTED, PEER, TAYLOR, PROJECTED_PEER)
    ordered = [line for kind in kinds for line in lines if line.solver.kind == kind]
    rows = [[line.solver.name, *(milliseconds(line.at_error(error)) for error in ERRORS)] for line in ordered]
    return table(["ms for an error of", *(f"{error:.0e}" for error in ERRORS)], rows)


def best(lines: Sequence[Line], kinds: Sequence[str], error: float) -> tuple[str, float | None]:
    """The fastest of these kinds for that error: its name with the time, and the time."""
    found = [(line.at_error(error), line.solver.name) for line in lines if line.solver.kind in kinds]
    reached = [(seconds, name) for seconds, name in found if seconds is not None]
    if not reached:
        return "–", None
    seconds, name = min(reached)
    return f"{name.removesuffix(', projected')} {milliseconds(seconds)}", seconds


def summary(lines: Sequence[Line]) -> str:
    """The fastest of ours against the fastest of the others, heyoka apart."""
    rows = []
    for error in ERRORS:
        (plain, own), (projected, kept) = best(lines, [PLAIN], error), best(lines, [PROJECTED], error)
        (peer, other), (_, series) = best(lines, [PEER], error), best(lines, [TAYLOR], error)
        ratios = [quotient(other, own), quotient(other, kept), quotient(series, own), quotient(series, kept)]
        rows.append([f"{error:.0e}", plain, projected, peer, milliseconds(series), *ratios])
    header = ["error", "ours, plain, ms", "ours, projected, ms", "best peer, ms", "heyoka, ms"]
    header += ["peer ÷ plain", "peer ÷ projected", "heyoka ÷ plain", "heyoka ÷ projected"]
    return table(header, rows)


def remarks(lines: Sequence[Line]) -> list[str]:
    """What was not timed, and why."""
    return [
        f"- {line.solver.name}: {reason} ({', '.join(f'{tolerance:.0e}' for tolerance in tolerances)})"
        for line in lines
        for reason, tolerances in line.left_out.items()
    ]


# ----------------------------------------------------------------------------------------------------------------------
# Plots

PEERS = ("SciPy", "CyRK", "CVODE", "extensisq", "diffrax", "heyoka", "homproj")
MARKERS = "osD^v<>phXP*d8"


def plot(p: Problem, lines: Sequence[Line]) -> None:
    """Time against error, both logarithmic; errors fall to the right."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams |= {"svg.hashsalt": p.name, "svg.fonttype": "none"}  # the same data make the same, small file
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    methods = [line.solver.name for line in lines if line.solver.kind == PLAIN]
    peers = [line for line in lines if line.solver.kind not in (PLAIN, PROJECTED)]
    for line in lines:
        xs, ys = [point.error for point in line.points], [1e3 * point.seconds for point in line.points]
        name, kind = line.solver.name, line.solver.kind
        style: dict[str, Any]
        if kind in (PLAIN, PROJECTED):
            color = COLOURS[methods.index(name.removesuffix(", projected")) % len(COLOURS)]
            style = {"linestyle": "-" if kind == PLAIN else "--", "linewidth": 2.0, "zorder": 3}
        else:
            color = MUTED[PEERS.index(name.split()[0])]
            marker = MARKERS[peers.index(line) % len(MARKERS)]
            style = {"linestyle": "--" if kind == PROJECTED_PEER else "-", "linewidth": 0.8, "zorder": 2}
            style |= {"marker": marker, "markersize": 3.5}
        axes.plot(xs, ys, color=color, label=name, **style)
    axes.set(xscale="log", yscale="log", xlabel="error of the final state", ylabel="time, ms", title=p.title)
    axes.set_xlim(1e-1, 1e-13)
    axes.grid(True, which="major", linewidth=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7.5, frameon=False)
    target = plot_file(p)
    target.parent.mkdir(exist_ok=True)
    figure.savefig(target, metadata={"Date": None})
    plt.close(figure)


def plot_file(p: Problem) -> Path:
    return PAGES / f"peers-{p.name}.svg"


# ----------------------------------------------------------------------------------------------------------------------


def report(names: Sequence[str], repetitions: int, write: bool) -> str:
    """All tables; with `write`, the plots are made too."""
    missing = [package for package in PACKAGES if installed(package) is None]
    parts = [f"{machine(*PACKAGES, 'numpy', 'numba')}. Medians of {repetitions}."]
    if missing:
        parts.append(f"Not installed, and left out: {', '.join(missing)}.")
    for name in names:
        p = PROBLEMS[name]
        start = perf_counter()
        exact = reference(p)
        lines = measure(p, exact, repetitions)
        parts += [f"## {p.title}", f"Reference: {exact.text}."]
        if write:
            plot(p, lines)
            parts.append(f"![{p.title}: time against error]({plot_file(p).name})")
        untimed = "\n".join(["Not timed, with the tolerances:", "", *said]) if (said := remarks(lines)) else ""
        parts += [summary(lines), folded("Every package", all_times(lines), untimed)]
        print(f"{name} done in {perf_counter() - start:.0f} s", file=sys.stderr)
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the tables in docs/benchmarks, and the plots")
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--problem", nargs="+", choices=list(PROBLEMS), help="these only; not with --write")
    arguments = parser.parse_args()
    if arguments.write and arguments.problem:
        parser.error("--write replaces all tables: no --problem")
    text = report(arguments.problem or list(PROBLEMS), arguments.repetitions, arguments.write)
    print(text)
    if arguments.write:
        write_section("peers", text)


if __name__ == "__main__":
    main()
