"""Does a solution satisfy the equations as they were given, and if it could not be continued, why?"""

from __future__ import annotations

import numpy as np

from .._base.arguments import Array
from .._results.solution import Solution
from .expressions import Values
from .reduction import Reduction
from .solution import Unknowns
from .start import Point, conditions

#: A residual above this part of its terms is no roundoff, even if leading derivatives have lost half of the digits.
_VIOLATED = 1e-7
#: A residual below this part of the largest terms along the solution is roundoff: of values that pass through 0.
_ROUNDOFF = 1e-12
#: A block of J that is this much closer to singular than at the start has become singular.
_SINGULAR = 1e-5


def violation(sol: Solution, unknowns: Unknowns, reduction: Reduction, p: Array) -> str:
    """Return which of the given equations an output violates, with all derivatives of the reduced problem; or ''."""
    if not len(sol.t):
        return ""
    found = unknowns.check(sol.t, sol.y, p)
    residuals, sizes = np.split(found, 2)
    allowed = _VIOLATED if not reduction.algebraic else max(_VIOLATED, float(np.max(sol._rtol)))
    with np.errstate(invalid="ignore"):
        largest = np.nanmax(sizes, axis=1, keepdims=True)
        off = np.abs(residuals) > allowed * sizes + _ROUNDOFF * largest
    off &= np.isfinite(residuals)
    if not off.any():
        return ""
    i, k = divmod(int(np.argmax(np.where(off, np.abs(residuals) / np.maximum(sizes, 1e-300), 0))), off.shape[1])
    name = reduction.structure.names[i]
    return (
        f"The solution does not satisfy the equations: {name} is {residuals[i, k]:.3g} at t = {sol.t[k]:.6g}, and its "
        f"terms {sizes[i, k]:.3g}. The structure of the equations may change along the solution, as where an "
        "expression that was constant near the start no longer is: start the analysis elsewhere, or rewrite them."
    )


def point_of(reduction: Reduction, t: float, state: Array, p: Array) -> Point:
    """Return the x_j^(l), l <= d_j, at a state."""
    n, d = reduction.n, reduction.arrangement.offsets.d
    variables = [(order, j) for j in range(n) for order in range(int(d[j]) + 1)]
    values = Values(reduction.of(variables), p)(t, state)
    x = np.zeros((int(d.max(initial=0)) + 1, n))
    for (order, j), value in zip(variables, values, strict=True):
        x[order, j] = value
    return Point(t, x)


def impasse(sol: Solution, reduction: Reduction, p: Array) -> str:
    """Return why a run could not go on, if the equations no longer determine an unknown where it ended; else ''."""
    if sol._origin is None or not len(sol.t):
        return ""
    now = conditions(reduction, point_of(reduction, float(sol.t_end), np.asarray(sol._origin.y), p), p)
    at_start = conditions(reduction, point_of(reduction, float(sol.t[0]), sol.y[:, 0], p), p)
    for one, before in zip(now, at_start, strict=True):
        if one.is_singular or not one.quality > _SINGULAR * before.quality:
            return (
                f"The run could not be continued at t = {sol.t_end:.10g}: {one.in_words('no longer ')}. The "
                "solution ends there (an impasse point), or passes a singular position: stop before it with a "
                "terminal event, or start behind it."
            )
    return ""
