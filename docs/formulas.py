"""Indices and exponents of formulas that are written as text: y_i, h^{q+1}, D_{1…k}. In print they are small."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

#: The pages with formulas as text.
PAGES = (
    "algorithms",
    "benchmarks/stiff",
    *(f"algorithms/{page.stem}" for page in sorted((Path(__file__).parent / "algorithms").glob("*.md"))),
)

#: What stays as it is: code, formulas in dollars, targets of links.
KEPT = re.compile(r"(`[^`]*`|\$[^$]*\$|\]\([^)]*\))")

EXPONENT = re.compile(r"\^\{([^{}]*)\}")
INDEX = re.compile(r"_\{([^{}]*)\}|(?<=[^\W\d_]|[*˙̃)])_(ij|ii|new|[a-zγ0-9])(?![A-Za-z0-9_])")


def in_print(text: str) -> str:
    """The text with indices and exponents as HTML."""
    parts = KEPT.split(text)
    parts[::2] = [
        INDEX.sub(lambda found: f"<sub>{found[1] or found[2]}</sub>", EXPONENT.sub(r"<sup>\1</sup>", part))
        for part in parts[::2]
    ]
    return "".join(parts)


def convert(app: Any, page: str, source: list[str]) -> None:
    """Converts a page outside blocks of code."""
    if page in PAGES:
        blocks = source[0].split("```")
        blocks[::2] = [in_print(block) for block in blocks[::2]]
        source[0] = "```".join(blocks)


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", convert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
