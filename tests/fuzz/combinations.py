"""Capabilities at random, which meet in problems with exact solutions (tests/seams.py)."""

from __future__ import annotations

import sys
from pathlib import Path
from random import Random

from methods import FIRST_ORDER

sys.path.insert(0, str(Path(__file__).parents[1]))

import seams

__all__ = ["right_meeting"]


def right_meeting(random: Random) -> str | None:
    """Makes one. What is wrong with it, or None."""
    row = seams.random_row(random, FIRST_ORDER)
    wrong = seams.wrong_case(row, random)
    return wrong and f"{wrong}; {', '.join(f'{name}={level}' for name, level in row.items())}"
