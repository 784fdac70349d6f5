"""Differences between processors of one kind: the kernels of OpenBLAS, of which NumPy's and SciPy's wheels carry a
library each, and the instructions that NumPy uses for its elementary functions.

    python tests/kernels.py             # the kernels that this processor can run
    python tests/kernels.py features    # NumPy's instructions here beyond its baseline, for NPY_DISABLE_CPU_FEATURES
"""

from __future__ import annotations

import ctypes
import platform
import sys
from pathlib import Path

import numpy as np
import scipy
import scipy.linalg  # loads SciPy's

#: As `OPENBLAS_CORETYPE` calls them, with the flag of the processor without which they are not to be run.
NEEDS = {"Prescott": "sse3", "Nehalem": "sse4_2", "Haswell": "avx2", "SkylakeX": "avx512vl"}
#: What OpenBLAS calls them in its answer, where that is another name.
ALSO = {"Katmai": "Prescott"}


def loaded() -> list[str]:
    """The kernels that NumPy and SciPy have chosen, as far as their libraries tell."""
    names = []
    for package in (np, scipy):
        for path in Path(package.__path__[0]).parent.glob(f"{package.__name__}.libs/*openblas*"):
            library = ctypes.CDLL(str(path))
            for symbol in (f"{start}openblas_get_corename{end}" for start in ("scipy_", "") for end in ("", "64_")):
                if hasattr(library, symbol):
                    getattr(library, symbol).restype = ctypes.c_char_p
                    name = getattr(library, symbol)().decode()
                    names.append(ALSO.get(name, name))
    return names


def runnable() -> list[str]:
    """The kernels that this processor can run; none where that is not known, or where they cannot be chosen."""
    about = Path("/proc/cpuinfo")
    if platform.machine() != "x86_64" or not about.exists() or not loaded():
        return []
    flags = {*next(line for line in about.read_text().splitlines() if line.startswith("flags")).split(), "sse3"}
    return [kernel for kernel, flag in NEEDS.items() if flag in flags]


def features() -> list[str]:
    """The instructions beyond its baseline that NumPy uses on this processor."""
    umath = np._core._multiarray_umath  # NumPy has no public name for them
    return [feature for feature in umath.__cpu_dispatch__ if umath.__cpu_features__[feature]]


if __name__ == "__main__":  # for the Makefile
    print(*(features() if sys.argv[1:] == ["features"] else runnable()))
