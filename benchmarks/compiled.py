"""What `invariode.compile` makes: ``python benchmarks/compiled.py [--write]``, or ``make bench``.

The time of f, traced and by numba, also of neighbours on lines, rings and grids, whose solves are compared with CyRK's;
of its exact Jacobian; and how long large functions take to compile. ``--write`` puts the tables into docs/benchmarks.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import partial
from statistics import median
from time import process_time
from typing import Any, Literal

import llvmlite.binding as llvm
import numpy as np
from bodies import by_cyrk
from measure import installed, interleaved, machine, ratio, run, table
from numpy.typing import NDArray

import invariode as iv
from invariode._functions.compiled import CompiledFunction
from invariode._functions.graph.derived import Derived, derived

Array = NDArray[np.float64]
US = 1e-6
WAYS: tuple[Literal["trace", "numba"], ...] = ("trace", "numba")
#: Numbers of components of the heat equation.
LARGE = (100, 1000, 4000)
#: Components of stencils, and the tolerance and the end of their solves.
SITES, TOLERANCE, END = 400, 1e-8, 1.0
#: Of the problems that have Jacobians measured.
DENSE = 20

#: Calls a function of the core's signature so many times.
_CALLER = """
define void @repeat(ptr %f, i64 %count, double %t, ptr %y, ptr %out, ptr %p) {
start:
  br label %again
again:
  %i = phi i64 [0, %start], [%next, %again]
  call void %f(double %t, ptr %y, ptr %out, ptr %p)
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %count
  br i1 %more, label %again, label %done
done:
  ret void
}
"""


def lotka_volterra(t: Any, y: Any, out: Any) -> None:
    out[0] = 1.5 * y[0] - y[0] * y[1]
    out[1] = y[0] * y[1] - 3.0 * y[1]


def van_der_pol(t: Any, y: Any, out: Any) -> None:
    out[0] = y[1]
    out[1] = 100.0 * (1.0 - y[0] ** 2) * y[1] - y[0]


def driven_pendulum(t: Any, y: Any, out: Any) -> None:
    out[0] = y[1]
    out[1] = -math.sin(y[0]) - 0.1 * y[1] + 0.5 * math.cos(0.7 * t)


def kepler(t: Any, y: Any, out: Any) -> None:
    cube = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    out[0] = y[2]
    out[1] = y[3]
    out[2] = -y[0] / cube
    out[3] = -y[1] / cube


def robertson(t: Any, y: Any, out: Any) -> None:
    out[0] = -0.04 * y[0] + 1e4 * y[1] * y[2]
    out[1] = 0.04 * y[0] - 1e4 * y[1] * y[2] - 3e7 * y[1] ** 2
    out[2] = 3e7 * y[1] ** 2


def friction(t: Any, y: Any, out: Any) -> None:
    """With branches."""
    force = 2.0 - y[0]
    if y[1] > 1e-3:
        drag = -1.0 - 0.5 * y[1]
    elif y[1] < -1e-3:
        drag = 1.0 - 0.5 * y[1]
    else:
        drag = min(max(-force, -1.0), 1.0)
    out[0] = y[1]
    out[1] = force + drag


def bodies(t: Any, y: Any, out: Any) -> None:
    """With loops: five bodies in the plane."""
    for i in range(5):
        out[2 * i] = y[10 + 2 * i]
        out[2 * i + 1] = y[11 + 2 * i]
        ax = 0.0
        ay = 0.0
        for j in range(5):
            if i != j:
                dx = y[2 * j] - y[2 * i]
                dy = y[2 * j + 1] - y[2 * i + 1]
                cube = (dx * dx + dy * dy + 0.01) ** 1.5
                ax += dx / cube
                ay += dy / cube
        out[10 + 2 * i] = ax
        out[11 + 2 * i] = ay


def lorenz_96(t: Any, y: Any, out: Any) -> None:
    for i in range(40):
        out[i] = (y[(i + 1) % 40] - y[i - 2]) * y[i - 1] - y[i] + 8.0


def heat(t: Any, y: Any, out: Any) -> None:
    n = len(y)
    for i in range(1, n - 1):
        out[i] = (n + 1.0) ** 2 * (y[i - 1] - 2.0 * y[i] + y[i + 1])
    out[0] = (n + 1.0) ** 2 * (y[1] - 2.0 * y[0])
    out[n - 1] = (n + 1.0) ** 2 * (y[n - 2] - 2.0 * y[n - 1])


PROBLEMS: dict[str, tuple[Callable[..., Any], int]] = {
    "Lotka–Volterra": (lotka_volterra, 2),
    "van der Pol": (van_der_pol, 2),
    "driven pendulum": (driven_pendulum, 2),
    "Kepler": (kepler, 4),
    "Robertson": (robertson, 3),
    "friction, branches": (friction, 2),
    "five bodies, loops": (bodies, 20),
    "Lorenz 96, loop": (lorenz_96, 40),
}


def lorenz_96_rolled(t: Any, y: Any, out: Any) -> None:
    out[:] = (np.roll(y, -1) - np.roll(y, 2)) * np.roll(y, 1) - y + 8.0


def lorenz_96_ring(t: Any, y: Any, out: Any) -> None:
    n = len(y)
    for i in range(n):
        out[i] = (y[(i + 1) % n] - y[i - 2]) * y[i - 1] - y[i] + 8.0


def heat_sliced(t: Any, y: Any, out: Any) -> None:
    out[1:-1] = y[2:] - 2.0 * y[1:-1] + y[:-2]
    out[0] = y[1] - 2.0 * y[0]
    out[-1] = y[-2] - 2.0 * y[-1]


def brusselator(t: Any, y: Any, out: Any) -> None:
    """Stacked: u, then v."""
    m = len(y) // 2
    for i in range(m):
        u, v = y[i], y[m + i]
        left, right = y[i - 1] if i > 0 else 1.0, y[i + 1] if i < m - 1 else 1.0
        below, above = y[m + i - 1] if i > 0 else 3.0, y[m + i + 1] if i < m - 1 else 3.0
        out[i] = 1.0 + u * u * v - 4.0 * u + 0.5 * (left - 2.0 * u + right)
        out[m + i] = 3.0 * u - u * u * v + 0.5 * (below - 2.0 * v + above)


def chain(t: Any, y: Any, out: Any) -> None:
    """Fermi, Pasta, Ulam and Tsingou's, on a ring."""
    m = len(y) // 2
    for i in range(m):
        right, left = y[(i + 1) % m] - y[i], y[i] - y[i - 1]
        out[i] = y[m + i]
        out[m + i] = right - left + 0.25 * (right * right - left * left)


def membrane(t: Any, y: Any, out: Any) -> None:
    """The Laplacian on a torus."""
    for i in range(20):
        for j in range(20):
            around = y[(i + 1) % 20 * 20 + j] + y[(i - 1) % 20 * 20 + j]
            around += y[i * 20 + (j + 1) % 20] + y[i * 20 + (j - 1) % 20]
            out[i * 20 + j] = around - 4.0 * y[i * 20 + j]


STENCILS: dict[str, tuple[Callable[..., Any], int]] = {
    "Lorenz 96, np.roll": (lorenz_96_rolled, SITES),
    "Lorenz 96, loop": (lorenz_96_ring, SITES),
    "heat equation, slices": (heat_sliced, SITES),
    "Brusselator on a line": (brusselator, SITES),
    "chain of oscillators": (chain, SITES),
    "membrane, 20 × 20": (membrane, SITES),
}


def oscillators(t: Any, y: Any) -> Any:
    """Kuramoto's: each is coupled to all others."""
    return [1.0 + 0.1 * i + sum(math.sin(other - one) for other in y) / DENSE for i, one in enumerate(y)]


def field(t: Any, y: Any) -> Any:
    """Charges on a line: each pair repels."""
    force = [0.0 * one for one in y]
    for i in range(DENSE):
        for j in range(i):
            pair = 1.0 / (1.0 + (y[i] - y[j]) ** 2)
            force[i] += pair
            force[j] -= pair
    return force


def network(t: Any, y: Any) -> Any:
    """A layer of neurons."""
    weights = np.cos(np.arange(DENSE**2.0)).reshape(DENSE, DENSE)
    return np.tanh(weights @ y) - y


def bodies_20(t: Any, y: Any) -> Any:
    out = [0.0] * DENSE
    bodies(t, y, out)
    return out


WITH_JACOBIAN = {"Kuramoto": oscillators, "charges": field, "neurons": network, "five bodies": bodies_20}


def caller() -> tuple[Any, Callable[..., None]]:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    engine = llvm.create_mcjit_compiler(
        llvm.parse_assembly(_CALLER), llvm.Target.from_default_triple().create_target_machine(opt=3)
    )
    engine.finalize_object()
    kinds = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, *[ctypes.c_void_p] * 3]
    return engine, ctypes.CFUNCTYPE(None, *kinds)(engine.get_function_address("repeat"))


ENGINE, REPEAT = caller()


def repeated(code: Any, y: Array, size: int, count: int) -> Callable[[], None]:
    out = np.empty(size)
    return lambda: REPEAT(code.address, count, 0.3, y.ctypes.data, out.ctypes.data, None)


def calls(seconds: float, code: Any, y: Array, size: int) -> int:
    """So many take about that long."""
    start = process_time()
    repeated(code, y, size, 1000)()
    return max(100, int(1000 * seconds / max(process_time() - start, 1e-6)))


def against_numba(problems: dict[str, tuple[Callable[..., Any], int]], repetitions: int) -> str:
    rows, ratios = [], []
    for name, (fun, n) in problems.items():
        codes = {by: iv.compile(fun, by=by, inplace=True) for by in WAYS}
        seconds, made = {}, {}
        for by, one in codes.items():
            start = process_time()
            made[by] = one.native(n, n)
            seconds[by] = process_time() - start
        y = np.linspace(0.6, 1.4, n)
        count = calls(2e-3, made["trace"], y, n)
        runs = {by: repeated(code, y, n, count) for by, code in made.items()}
        times = interleaved(runs, repetitions)
        ratios.append(ratio(times["trace"], times["numba"]))
        figures = [f"{median(times[by]) / count / 1e-9:.1f}" for by in ("trace", "numba")]
        rows.append([name, *figures, f"{ratios[-1]:.2f}", *(f"{seconds[by] / 1e-3:.0f}" for by in ("trace", "numba"))])
    rows.append(["median", "", "", f"{median(ratios):.2f}", "", ""])
    return table(["f", "traced, ns", "numba, ns", "÷", "compiled in, ms", "numba, ms"], rows)


def against_cyrk(repetitions: int) -> str:
    """DOP853 of both; CyRK's f is a loop, which numba compiles better than arrays."""
    rows = []
    for name, (fun, n) in STENCILS.items():
        solver = iv.Problem(iv.compile(fun, inplace=True), (0.0, END), y0 := np.linspace(0.6, 1.4, n)).prepare(
            "dop853", rtol=TOLERANCE, atol=TOLERANCE, keep="end"
        )
        runs = {"invariode": partial(solver, y0=y0), "CyRK": by_cyrk(fun, y0, END, TOLERANCE)}
        if not np.allclose(runs["invariode"]().y[:, -1], runs["CyRK"](), rtol=1e-5, atol=1e-5):
            raise SystemExit(f"not timed: the final states of {name} differ")
        times = interleaved(runs, repetitions, process_time)
        own, other = (f"{median(times[who]) / US:.0f}" for who in runs)
        rows.append([name, own, other, f"{ratio(times['invariode'], times['CyRK']):.2f}"])
    return table(["DOP853, n = 400", "invariode, µs", "CyRK, µs", "÷ CyRK"], rows)


def of(fun: CompiledFunction, n: int) -> Derived:
    found = derived(fun, n, n)
    assert found is not None
    return found


def jacobians(repetitions: int) -> str:
    rows = []
    for name, fun in WITH_JACOBIAN.items():
        f = iv.compile(fun, by="trace")
        J = of(f, DENSE).dense()
        codes = {
            "f": (f.native(DENSE, DENSE), DENSE),
            "J": (J.native(DENSE, J.size), J.size),
        }
        y = np.linspace(0.6, 1.4, DENSE)
        count = calls(2e-3, *codes["f"][:1], y, DENSE)
        times = interleaved(
            {which: repeated(code, y, size, count) for which, (code, size) in codes.items()}, repetitions
        )
        figures = [f"{median(times[which]) / count / 1e-9:.0f}" for which in codes]
        rows.append([name, str(of(f, DENSE).entries), *figures, f"{ratio(times['J'], times['f']):.1f}"])
    return table([f"n = {DENSE}", "entries", "f, ns", "J, ns", "J ÷ f"], rows)


def large(repetitions: int) -> str:
    rows = []
    for n in LARGE:
        codes, seconds = {}, {}
        for by in WAYS:
            start = process_time()
            codes[by] = iv.compile(heat, by=by, inplace=True).native(n, n)
            seconds[by] = process_time() - start
        f = iv.compile(heat, by="trace", inplace=True)
        start = process_time()
        J = of(f, n).sparse()
        J.native(n, J.size)
        seconds["J"] = process_time() - start
        y = np.linspace(0.6, 1.4, n)
        count = calls(2e-3, codes["numba"], y, n)
        times = interleaved({by: repeated(code, y, n, count) for by, code in codes.items()}, repetitions)
        rows.append(
            [
                str(n),
                *(f"{seconds[which]:.2f}" for which in ("trace", "numba", "J")),
                *(f"{median(times[by]) / count / US:.2f}" for by in codes),
                f"{ratio(times['trace'], times['numba']):.2f}",
            ]
        )
    header = [
        "heat equation, n",
        "f traced and compiled, s",
        "by numba, s",
        "J besides, s",
        "f, µs",
        "numba's f, µs",
        "÷",
    ]
    return table(header, rows)


def report(repetitions: int) -> str:
    iv.compile(partial(van_der_pol), inplace=True).native(2, 2)  # what is imported and initialised once
    iv.compile(lambda t, y, out: None, by="numba", inplace=True).native(2, 2)
    return "\n\n".join(
        [
            f"{machine('invariode', 'numba', 'llvmlite')}. Process times to compile; medians of {repetitions}.",
            against_numba(PROBLEMS, repetitions),
            "Neighbours:",
            against_numba(STENCILS, repetitions),
            *([against_cyrk(repetitions)] if installed("CyRK") else []),
            "Exact Jacobians:",
            jacobians(repetitions),
            "Many components:",
            large(repetitions),
        ]
    )


if __name__ == "__main__":
    run("compiled", __doc__, report, repetitions=31)
