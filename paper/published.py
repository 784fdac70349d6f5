"""The published numbers, as `published.json` has them for the experiments and for the tests."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

__all__ = ["PAPER", "PUBLISHED", "matlab"]

#: Everything in the file: `about`, `problems`, `rows` of what MATLAB prints, and the numbers of the `paper`.
PUBLISHED: dict[str, Any] = json.loads(files(__package__).joinpath("published.json").read_text(encoding="utf-8"))

#: What the paper prints, a number or words, and where.
PAPER: dict[str, tuple[str, str]] = {
    key: (entry[0], entry[1]) for key, entry in PUBLISHED["paper"].items() if key != "about"
}


def matlab(problem: str, method: str = "ode45") -> list[dict[str, Any]]:
    """The rows of what MATLAB prints for a problem, solved by that method or by several."""
    return [row for row in PUBLISHED["rows"] if row["problem"] == problem and row.get("method", method) == method]
