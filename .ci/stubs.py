"""The stubs of the modules whose names are made from the registry of methods, written to a folder: ``make stubs``."""

from __future__ import annotations

import sys
from pathlib import Path

from invariode import METHODS

FUNCTIONS = '''"""Generated from METHODS: `make stubs`."""

from typing import Unpack

from numpy.typing import ArrayLike

from .._base.types import Function, Span
from .._problem.options import AllOptions
from .._results.solution import Solution

__all__ = {names}

{functions}
'''

CLASSES = '''"""Generated from METHODS: `make stubs`."""

from ._solve.stepper import Stepper

__all__ = {names}

{classes}
'''


def listed(names: list[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


def stubs() -> dict[str, str]:
    functions = "\n".join(
        f"def {name}(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: ..."
        for name in METHODS
    )
    ours = {name.upper(): f"class {name.upper()}(Stepper): ..." for name in METHODS}
    theirs = {
        name: f"class {name}(Stepper): ..." if method.scipy_options else f"{name} = {method.name.upper()}"
        for method in METHODS.values()
        if (name := method.scipy_name) and name not in ours
    }
    classes = "\n".join([*ours.values(), "", *theirs.values()])
    return {
        "_solve/ode_functions.pyi": FUNCTIONS.format(names=listed([*METHODS]), functions=functions),
        "scipy.pyi": CLASSES.format(names=listed([*ours, *theirs]), classes=classes),
    }


if __name__ == "__main__":
    for name, text in stubs().items():
        (Path(sys.argv[1]) / name).write_text(text)
