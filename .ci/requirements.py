"""Prints what the package, with extras, requires, so that it can be installed while the package is built.

python .ci/requirements.py test
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


def of_extra(project: dict[str, Any], extra: str) -> Iterator[str]:
    """Yield the requirements of an extra, with the requirements of the other extras that it includes."""
    for one in project["optional-dependencies"][extra]:
        own = re.fullmatch(rf"{project['name']}\[([\w,]+)\]", one)
        if own:
            for other in own[1].split(","):
                yield from of_extra(project, other)
        else:
            yield one


if __name__ == "__main__":
    about = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    print(*about["dependencies"], *(one for extra in sys.argv[1:] for one in of_extra(about, extra)), sep="\n")
