"""The bounds of a problem: what `nonnegative` and `bounds` mean, checked."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array, items, real_numbers, shown


class Bounds(NamedTuple):
    """lower <= y <= upper, of shape (n,); infinite where there is no bound."""

    lower: Array
    upper: Array

    def nearest(self, y: Array) -> Array:
        return np.clip(y, *self)


def to_bounds(nonnegative: Any, bounds: Any, y0: Array, labels: Sequence[str] | None) -> Bounds | None:
    """Combine `nonnegative` and `bounds` in one pair of bounds; return None if nothing is bounded.

    Raises TypeError, ValueError: Names and indices that do not exist or occur twice; bounds of a wrong shape, NaN,
    crossed, or dependent on t; a complex y0.
    """
    n = len(y0)
    if nonnegative is None and type(bounds) is tuple and len(bounds) == 2 and y0.dtype.kind != "c":  # the common case
        lower, upper = bounds
        if type(lower) is type(upper) is float and lower <= upper:
            return _same_for_all(lower, upper, n)
    chosen = _components(nonnegative, n, labels)
    if bounds is None and not chosen:
        return None
    if y0.dtype.kind == "c":
        given = "bounds" if bounds is not None else "nonnegative"
        raise ValueError(f"{given}: bounds require a real problem. Split y into real and imaginary parts")
    lower, upper = (np.full(n, -np.inf), np.full(n, np.inf)) if bounds is None else _pair(bounds, n)
    if chosen:
        lower[chosen] = np.maximum(lower[chosen], 0.0)
    ordered = lower <= upper
    if not ordered.all():
        i = int(np.argmin(ordered))
        name = f"component {i}" if labels is None else labels[i]
        raise ValueError(f"bounds of {name} are contradictory: {lower[i]} <= y[{i}] <= {upper[i]}. Correct them")
    return Bounds(lower, upper) if np.isfinite(lower).any() or np.isfinite(upper).any() else None


@lru_cache(maxsize=64)
def _same_for_all(lower: float, upper: float, n: int) -> Bounds | None:
    """Return the same two bounds for n components, which problems share; None if both are infinite."""
    if lower == -np.inf and upper == np.inf:
        return None
    found = Bounds(np.full(n, lower + 0.0), np.full(n, upper + 0.0))  # -0.0 and 0.0 are one key
    for side in found:
        side.setflags(write=False)
    return found


def _components(nonnegative: Any, n: int, labels: Sequence[str] | None) -> list[int]:
    """Indices of the components that must not become negative."""
    if nonnegative is None or nonnegative is False:
        return []
    if nonnegative is True:
        return list(range(n))
    given = [nonnegative] if isinstance(nonnegative, str) else items(nonnegative)
    if given is None:
        given = [nonnegative]
    if given and all(isinstance(one, (bool, np.bool_)) for one in given):
        raise TypeError(
            f"nonnegative must be True, indices or labels, got {shown(nonnegative)}: "
            "for a mask use np.flatnonzero(mask)"
        )
    chosen = [_component(one, n, labels) for one in given]
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"nonnegative lists a component twice: {shown(nonnegative)}")
    return chosen


def _component(one: Any, n: int, labels: Sequence[str] | None) -> int:
    if isinstance(one, str):
        if labels is None:
            raise ValueError(
                f"nonnegative: {shown(one)} is a label, but the problem has none: give Problem(labels=), or indices"
            )
        if one not in labels:
            raise ValueError(f"nonnegative: no component is called {shown(one)}; choose from {', '.join(labels)}")
        return list(labels).index(one)
    if isinstance(one, bool) or not isinstance(one, (int, np.integer)):
        raise TypeError(f"nonnegative must be True, indices or labels, got {shown(one)}")
    if not -n <= one < n:
        counted = f": they are counted from 0, so the last one is {n - 1}" if one == n else ""
        raise ValueError(f"nonnegative: there is no component {shown(one)} of {n}{counted}")
    return int(one) % n


def _pair(bounds: Any, n: int) -> tuple[Array, Array]:
    """`(lower, upper)`, or what has `lb` and `ub`, as `scipy.optimize.Bounds` does."""
    pair = (bounds.lb, bounds.ub) if hasattr(bounds, "lb") and hasattr(bounds, "ub") else bounds
    if callable(pair) or (isinstance(pair, (tuple, list)) and any(callable(one) for one in pair)):
        raise TypeError(
            "bounds that depend on t are not possible: use y minus its bound as a component, and nonnegative"
        )
    if not isinstance(pair, (tuple, list, np.ndarray)) or len(pair) != 2:
        raise TypeError(f"bounds must be (lower, upper) or scipy.optimize.Bounds, got {shown(bounds)}")
    return _side("lower", pair[0], -np.inf, n), _side("upper", pair[1], np.inf, n)


def _side(name: str, given: Any, absent: float, n: int) -> Array:
    if given is None:
        return np.full(n, absent)
    if type(given) in (float, int) and given == given:  # the common case
        return np.full(n, float(given))
    values = real_numbers(f"{name} bounds", given)
    if values.shape not in ((), (1,), (n,)):
        raise ValueError(f"{name} bounds must be a number or of shape ({n},), got shape {values.shape}")
    if np.isnan(values).any():
        raise ValueError(f"{name} bounds must not be NaN, got {shown(given)}: for no bound give {absent}")
    return np.broadcast_to(values, (n,)).copy()
