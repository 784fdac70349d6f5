"""The stubs made from the registry of methods and the table of options, written to a folder: ``make stubs``."""

from __future__ import annotations

import ast
import re
import sys
import textwrap
from pathlib import Path

from invariode import METHODS
from invariode._problem import options

#: The bodies are for editors that do not read `Unpack`, and complete the options from the call.
FUNCTIONS = '''"""Generated from METHODS: `make stubs`."""

from typing import Unpack

from numpy.typing import ArrayLike

from .._base.types import Function, Span
from .._problem.accepted import suite_options
from .._problem.options import AllOptions
from .._results.solution import Solution

__all__ = {names}

{functions}
'''

ACCEPTED = '''"""Generated from the table of options: `make stubs`."""

{imports}
from .options import {kinds}

__all__ = {names}

{functions}
'''

NAMES = '''"""Generated from METHODS: `make stubs`."""

from typing import Any, Literal, TypeAlias

OwnName: TypeAlias = Literal{ours}
MethodName: TypeAlias = OwnName | Literal{theirs} | type[Any]
'''

CLASSES = '''"""Generated from METHODS: `make stubs`."""

from ._solve.stepper import Stepper

__all__ = {names}

{classes}
'''


def listed(names: list[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


class Table:
    """The options as `options.py` spells them: their types in its words, and what these words are imported from."""

    def __init__(self) -> None:
        tree = ast.parse(Path(options.__file__).read_text(encoding="utf-8"))
        self._imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
        self._kinds = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}

    def rows(self, kind: str) -> dict[str, str]:
        """The names and types of a class of options."""
        found: dict[str, str] = {}
        for base in self._kinds[kind].bases:
            if isinstance(base, ast.Name) and base.id in self._kinds:
                found |= self.rows(base.id)
        for node in self._kinds[kind].body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                hint = node.annotation
                if isinstance(hint, ast.Subscript) and ast.unparse(hint.value) == "Annotated":
                    hint = hint.slice.elts[0]  # type: ignore[attr-defined]  # the slice of Annotated[...] is a tuple
                found[node.target.id] = ast.unparse(hint)
        return {name: found[name] for name in (*options.TABLE, *found) if name in found}

    def parameters(self, kind: str) -> str:
        """The options of a class as keyword parameters."""
        return ", ".join(f"{name}: {hint} = ..." for name, hint in self.rows(kind).items())

    def imports(self, text: str) -> str:
        """What a stub beside the table imports for the names in a text."""
        words = set(re.findall(r"\w+", text))
        lines = []
        for node in self._imports:
            names = [one.name for one in node.names if one.name in words]
            if names and node.module != "__future__":
                lines.append(f"from {'.' * node.level}{node.module} import {', '.join(names)}")
        return "\n".join(lines)


def function(name: str, parameters: str, result: str) -> str:
    lines = textwrap.fill(parameters, 116, break_long_words=False, break_on_hyphens=False)
    return f"def {name}(\n{textwrap.indent(lines, '    ')}\n) -> {result}: ..."


#: The functions from whose calls editors complete options, each with its class of options. They are in the stub alone:
#: no call takes place.
KINDS = {
    "solve_options": "SolveOptions",
    "run_options": "Options",
    "suite_options": "AllOptions",
    "ensemble_options": "EnsembleOptions",
    "problem_ensemble_options": "ProblemEnsembleOptions",
    "extension_options": "ExtensionOptions",
    "stepper_options": "StepperOptions",
}


def accepted(table: Table) -> str:
    """The functions from whose calls editors complete options."""
    kinds = KINDS
    functions = "\n".join(function(name, "*, " + table.parameters(kind), kind) for name, kind in kinds.items())
    return ACCEPTED.format(
        imports=table.imports(functions),
        kinds=", ".join(sorted(kinds.values())),
        names=listed(sorted(kinds)),
        functions=functions,
    )


def stubs() -> dict[str, str]:
    functions = "\n".join(
        f"def {name}(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: "
        "raise NotImplementedError(suite_options(**options))"
        for name in METHODS
    )
    ours = {name.upper(): f"class {name.upper()}(Stepper): ..." for name in METHODS}
    theirs = {
        name: f"class {name}(Stepper): ..." if method.scipy_options else f"{name} = {method.name.upper()}"
        for method in METHODS.values()
        if (name := method.scipy_name) and name not in ours
    }
    classes = "\n".join([*ours.values(), "", *theirs.values()])
    scipys = [method.scipy_name for method in METHODS.values() if method.scipy_name]
    return {
        "_base/method_names.pyi": NAMES.format(ours=listed([*METHODS]), theirs=listed(scipys)),
        "_problem/accepted.pyi": accepted(Table()),
        "_solve/ode_functions.pyi": FUNCTIONS.format(names=listed([*METHODS]), functions=functions),
        "scipy.pyi": CLASSES.format(names=listed([*ours, *theirs]), classes=classes),
    }


if __name__ == "__main__":
    for name, text in stubs().items():
        (Path(sys.argv[1]) / name).write_text(text)
