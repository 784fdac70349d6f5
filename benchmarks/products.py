"""Products of dense mass matrices with vectors: ``python benchmarks/products.py [--write]``.

`Matrix::multiply` of the core, which takes eight sums side by side, and one sum after the other, which gives the same
bits: this is checked before anything is timed. One thread, the process's CPU clock. ``--write`` puts the table into
docs/benchmarks/large.md.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import subprocess
import tempfile
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from measure import interleaved, machine, ratio, run, table

from native import FLAGS

CORE = Path(__file__).parents[1] / "core"
SIZES = (10, 30, 100, 300, 1000)
WORK = 10**6  # entries in one measurement
MARK = "signature_of_eigen3_matrix_library"
US = 1e-6


def built() -> ctypes.CDLL:
    files = importlib.metadata.files("cmeel-eigen") or []
    eigen = next(Path(str(f.locate())).parent for f in files if f.name == MARK)
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "products.so"
        paths = [f"-I{CORE}", "-isystem", str(eigen), str(Path(__file__).with_name("products.cpp")), "-o", str(library)]
        subprocess.run([os.environ.get("CXX", "c++"), *FLAGS, *paths], check=True)
        found = ctypes.CDLL(str(library))
    found.matrix.restype = ctypes.c_void_p
    return found


def report(repetitions: int) -> str:
    library, random, rows = built(), np.random.default_rng(1), []
    for n in SIZES:
        A, x = random.standard_normal((n, n)), random.standard_normal(n)
        matrix = ctypes.c_void_p(library.matrix(ctypes.c_void_p(A.ctypes.data), ctypes.c_size_t(n)))
        results = {name: np.zeros(n) for name in ("multiply", "multiply_in_order")}

        count = max(1, WORK // n**2)

        def several(name: str, matrix: Any = matrix, x: Any = x, results: Any = results, count: int = count) -> None:
            pointers = [ctypes.c_void_p(one.ctypes.data) for one in (x, results[name])]
            for _ in range(count):
                getattr(library, name)(matrix, *pointers)

        for name in results:
            several(name)
        if not np.array_equal(*results.values()):
            raise SystemExit(f"not timed: the products of n = {n} differ")
        times = interleaved({name: partial(several, name) for name in results}, repetitions, process_time)
        own, other = (median(times[name]) / count / US for name in results)
        rows.append(
            [str(n), f"{own:.2f}", f"{other:.2f}", f"{ratio(times['multiply_in_order'], times['multiply']):.2f}"]
        )
    return f"{machine('invariode', 'numpy')}.\n\n{table(['n', 'eight sums, µs', 'in order, µs', 'ratio'], rows)}"


if __name__ == "__main__":
    run("products", __doc__, report, repetitions=15)
