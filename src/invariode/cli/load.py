"""The Problem that a file defines: FILE.py, or FILE.py:name."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer

from .._base.suggestions import nearest
from .._problem.problem import Problem
from .session import print_traceback, stop

#: The name used if none is given.
DEFAULT = "problem"

#: The argument of the commands that need a problem.
File = Annotated[
    str,
    typer.Argument(
        metavar="FILE.py[:NAME]",
        show_default=False,
        help=f"A file that defines an invariode.Problem, called '{DEFAULT}' if it defines several.",
    ),
]


def load(file: str) -> Problem:
    """Return the problem of that name in the file; by default `problem`, or the only one."""
    path, name = _parts(file)
    if path.is_dir():
        raise _wrong(f"{path} is a directory; give the file in it that defines the problem.")
    if not path.is_file():
        near = nearest(path.name, [other.name for other in path.parent.glob("*.py")])
        raise _wrong(f"no such file: {path}" + (f"; did you mean {path.with_name(near)}?" if near else ""))
    defined = {key: value for key, value in _run(path).items() if not key.startswith("__")}
    problems = {key: value for key, value in defined.items() if isinstance(value, Problem)}
    if name is not None:
        return _named(path, name, defined, problems)
    if DEFAULT in problems:
        return problems[DEFAULT]
    if len({id(one) for one in problems.values()}) == 1:
        return next(iter(problems.values()))
    if problems:
        raise _wrong(
            f"{path} defines several problems: {', '.join(problems)}. Say which: {path}:{next(iter(problems))}"
        )
    raise _wrong(
        f"{path} defines no invariode.Problem. It should say: problem = iv.Problem(fun, t_span, y0, invariants=...). "
        f"It defines: {_listed(defined)}."
    )


def _parts(file: str) -> tuple[Path, str | None]:
    """Return the file and the name after its last colon, if that is one (a colon may be part of a path)."""
    head, colon, name = file.rpartition(":")
    if colon and name.isidentifier() and not Path(file).exists():
        return Path(head), name
    return Path(file), None


def _run(path: Path) -> dict[str, Any]:
    """Run the file as an import would, next to its neighbours, and return its names; no bytecode is left behind."""
    module = ModuleType(f"{path.stem} (problem file)")  # no name that an import could ask for
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    sys.path.insert(0, str(path.parent.resolve()))
    try:
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        print_traceback(error)
        raise stop(f"{path} cannot be run; it raised {type(error).__name__}.", code=2) from None
    return module.__dict__


def _named(path: Path, name: str, defined: dict[str, Any], problems: dict[str, Problem]) -> Problem:
    if name in problems:
        return problems[name]
    there = f"Problems there: {', '.join(problems)}." if problems else f"It defines: {_listed(defined)}."
    if name in defined:
        kind = type(defined[name]).__name__
        raise _wrong(f"{path}:{name} is of type {kind}, expected an invariode.Problem. {there}")
    near = nearest(name, problems)
    raise _wrong(f"{path} does not define {name}" + (f"; did you mean {near}? " if near else ". ") + there)


def _listed(defined: dict[str, Any]) -> str:
    """Return the names that a file defines itself, with their types."""
    own = {key: value for key, value in defined.items() if not isinstance(value, ModuleType) and key[0] != "_"}
    return ", ".join(f"{key} ({type(value).__name__})" for key, value in own.items()) or "nothing"


def _wrong(message: str) -> typer.BadParameter:
    return typer.BadParameter(message, param_hint="FILE.py[:NAME]")
