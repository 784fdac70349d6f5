"""Solutions that fall below zero where they should not: seen by comparison with a more accurate one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array

#: Below zero by more than this, in units of atol, is more than the noise that a tolerance allows.
NOTABLE = 100


class BelowZero(NamedTuple):
    """The component that falls farthest, in units of atol, and where to."""

    component: int
    value: float

    def in_words(self, label: str) -> str:
        """Return a sentence about the component, with this label."""
        return f"{label} falls to {self.value:.1e}, where a more accurate solution stays above 0"


class Lowest:
    """A callback that notes the least values of a real solution at its steps."""

    def __init__(self, y0: Array) -> None:
        self.values = y0.copy()

    def __call__(self, t: float, y: Array) -> bool:
        if y.dtype.kind != "c":
            np.fmin(self.values, y, out=self.values)
        return False


def below_zero(y0: Array, lowest: Array, accurate: Array, atol: ArrayLike) -> BelowZero | None:
    """Return the component that falls lowest, in units of atol, of those that fall below −100 atol although they start
    at or above zero and, to within atol, stay there in a more accurate solution; None if none does, or y0 is complex.
    `lowest`, `accurate`: the minima of both solutions, (n,).
    """
    if np.iscomplexobj(y0) or not len(y0):
        return None
    depth = np.where((y0 >= 0) & (accurate >= -np.asarray(atol)) & (lowest < -NOTABLE * np.asarray(atol)), -lowest, 0.0)
    deepest = int(np.argmax(depth / np.maximum(atol, np.finfo(float).tiny)))
    return BelowZero(deepest, float(lowest[deepest])) if depth[deepest] > 0 else None
