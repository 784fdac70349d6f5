"""Prints the requirements of pyproject.toml at their lowest versions: to run and test, or with --build to build."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
#: What the tests import.
EXTRAS = ("compiled", "plot", "data", "symbolic", "sbml", "petab", "cli", "paper", "test")
NOT_HERE = {"invariode"}


def lowest(requirement: str) -> str:
    """`name>=version` as `name==version`."""
    found = re.fullmatch(r"([\w-]+)>=([\w.]+)", requirement)
    if not found:
        raise SystemExit(f"{requirement!r} in pyproject.toml has no lowest version; write it as name>=version")
    return f"{found[1]}=={found[2]}"


def main() -> None:
    about = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))
    if "--build" in sys.argv[1:]:
        requirements = about["build-system"]["requires"]
    else:
        extras = about["project"]["optional-dependencies"]
        requirements = [*about["project"]["dependencies"], *(one for extra in EXTRAS for one in extras[extra])]
    names = (re.split(r"[\[>]", one)[0] for one in requirements)
    print(*(lowest(one) for one, name in zip(requirements, names, strict=True) if name not in NOT_HERE), sep="\n")


if __name__ == "__main__":
    main()
