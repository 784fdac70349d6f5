"""Dense implicit solves beside another process: ``python benchmarks/dense.py [--write]``, or ``make bench``.

Radau and ode15s on n coupled decays with a dense Jacobian, in fresh processes with the BLAS's own choice of threads and
with one thread, alone and while another process takes a core (`busy` below). Wall times: what waits costs, too. The
factors of n ≤ 512 are our own, and no BLAS runs; beyond that they are LAPACK's. The last columns are the factors alone:
`elimination.cpp` calls the kernels, which are compiled with the flags of the core, beside SciPy's LAPACK on one thread.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

import numpy as np
from measure import interleaved, machine, ratio, run, table

import invariode as iv

SIZES = (100, 200, 300, 500, 700)
METHODS = ("radau", "ode15s")
CORE = Path(__file__).parents[1] / "core"
#: The sets of instructions, with the flags of CMakeLists.txt.
SETS = {"baseline": (), "avx2": ("-mavx2",), "avx512": ("-mavx512f", "-mavx512dq", "-mavx512vl")}
FLAGS = ("-O3", "-fno-math-errno", "-fno-trapping-math", "-DNDEBUG", "-std=c++20", "-ffp-contract=off", "-fPIC")


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """So many processes that calculate, until the end."""
    code = "while True: pass"
    others = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(processes)]
    try:
        yield
    finally:
        for one in others:
            one.kill()
            one.wait()


def solve(method: str, n: int) -> Any:
    rates, mean = np.logspace(0, 4, n), np.full((n, n), 0.5 / n)
    jacobian = rates[:, None] * (mean - np.eye(n))
    return iv.solve_ivp(
        lambda t, y: rates * (0.5 * y.mean() - y), (0, 1), np.ones(n), method, jac=jacobian, rtol=1e-6, atol=1e-8,
        keep="end",
    )  # fmt: skip


def timed(method: str, n: int) -> None:
    """Prints the wall and the processor time of a solve: what a fresh process is called for."""
    solve(method, n)
    wall, spent = perf_counter(), process_time()
    solve(method, n)
    print(json.dumps([perf_counter() - wall, process_time() - spent]))


def in_fresh_process(method: str, n: int, threads: int | None) -> tuple[float, float]:
    wall, spent = json.loads(printed_by("--one", method, str(n), threads=threads))
    return wall, spent


def printed_by(*arguments: str, threads: int | None) -> str:
    """What this file prints when it is called with these arguments, with so many threads of the BLAS."""
    chosen = {} if threads is None else {"OPENBLAS_NUM_THREADS": str(threads)}
    command = [sys.executable, __file__, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, **chosen}).stdout


def solves(repetitions: int) -> str:
    rows = []
    for method in METHODS:
        for n in SIZES:
            row = [method, str(n)]
            for processes in (0, 1):
                with busy(processes):
                    both = partial(in_fresh_process, method, n)
                    pairs = [(both(None), both(1)) for _ in range(repetitions)]
                own, one = zip(*pairs, strict=True)
                row.append(f"{1e3 * median(wall for wall, _ in one):.0f}")
                row.append(f"{ratio([wall for wall, _ in own], [wall for wall, _ in one]):.2f}")
                row.append(f"{ratio([spent for _, spent in own], [spent for _, spent in one]):.2f}")
            rows.append(row)
    each = ["one thread, ms", "wall ÷ one thread", "CPU ÷ one thread"]
    return table(["method", "n", *each, *(f"busy: {name}" for name in each)], rows)


def kernels() -> dict[str, ctypes.CDLL]:
    """The kernels of the sets that this processor has, each in a library."""
    known = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, flags in SETS.items():
            if name != "baseline" and not all(flag.removeprefix("-m") in known for flag in flags):
                continue
            library, source = Path(folder) / f"{name}.so", Path(__file__).with_name("elimination.cpp")
            define = f'-DKERNEL="linear/elimination/elimination_{name}.cpp"', f"-DSET=of_{name}"
            compiler = os.environ.get("CXX", "c++")
            command = [compiler, *FLAGS, *flags, *define, f"-I{CORE}", "-shared", str(source), "-o", str(library)]
            subprocess.run(command, check=True)
            found[name] = ctypes.CDLL(str(library))
    return found


def factored_by(library: ctypes.CDLL, A: Any) -> Any:
    """A function that copies A to where it is factored, and factors it there."""
    n = len(A)
    height = (n + 7) // 8 * 8
    height += 8 * (height % 64 == 0)
    parts = np.zeros((2, n + 1, height))
    parts[0, :n, :n], parts[1, :n, :n] = A.T.real, A.T.imag
    held, exchanged = parts.copy(), np.zeros(n, np.uintp)
    kinds = 2 if np.iscomplexobj(A) else 1
    pointers = [ctypes.c_void_p(part.ctypes.data) for part in held][:kinds] + [None] * (2 - kinds)
    counts = ctypes.c_size_t(n), ctypes.c_size_t(height)

    def own() -> None:
        held[:kinds] = parts[:kinds]
        if not library.factor(*pointers, *counts, ctypes.c_void_p(exchanged.ctypes.data)):
            raise SystemExit(f"not timed: no factors of {n} rows")

    return own


def factors(repetitions: int) -> str:
    from scipy.linalg import get_lapack_funcs

    libraries, rows = kernels(), []
    for kind in (float, complex):
        for n in SIZES:
            random = np.random.default_rng(n)
            A = random.standard_normal((n, n)) + np.sqrt(n) * np.eye(n)
            A = A + 1j * random.standard_normal((n, n)) if kind is complex else A
            (getrf,) = get_lapack_funcs(("getrf",), dtype=kind)
            runs: dict[str, Any] = {"LAPACK": partial(getrf, np.asfortranarray(A))}
            runs |= {name: factored_by(library, A) for name, library in libraries.items()}
            times = interleaved(runs, repetitions, process_time)
            rows.append([kind.__name__, str(n), f"{1e6 * median(times['LAPACK']):.0f}"])
            rows[-1] += [f"{ratio(times[name], times['LAPACK']):.2f}" for name in libraries]
    return table(["numbers", "n", "LAPACK on one thread, µs", *(f"{name} ÷ LAPACK" for name in libraries)], rows)


def report(repetitions: int) -> str:
    alone = printed_by("--factors", str(5 * repetitions), threads=1)
    parts = [f"{machine('invariode', 'numpy', 'scipy')}.", solves(repetitions), alone.strip()]
    return "\n\n".join(parts)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        timed(sys.argv[2], int(sys.argv[3]))
    elif sys.argv[1:2] == ["--factors"]:
        print(factors(int(sys.argv[2])))
    else:
        run("dense", __doc__, report, repetitions=5)
