"""What the methods for y'' = f(t, y) ask of a problem."""

from __future__ import annotations

import numpy as np

from .._base.arguments import Array
from .._functions.second_order import states_second_order
from .._problem.description import Description
from .._problem.methods import Method

#: By what the velocities of the test differ from those at the start, in units of the largest; irregular, so that no
#: function of them is the same by chance.
_OTHER = 0.6180339887498949


def require_second_order(problem: Description, method: Method) -> None:
    """That the problem states second-order equations.

    Raises
    ------
    ValueError
        It does not, its accelerations depend on the velocities, or it has what the method does not take.
    """
    n = len(problem.y0)
    if not problem.second_order:
        raise ValueError(
            f"{method.name} is for y'' = f(t, y), and fun is given as y' = f(t, y): pass invariode.SecondOrder(f) with "
            "the accelerations f(t, q) and y0 = (q, v), or second_order=True if fun returns (v, f(t, q)). ode89 and "
            "dop853 take any fun"
        )
    if n % 2:
        raise ValueError(f"{method.name} needs as many velocities as positions: y0 has {n} components")
    if problem.bounds is not None:
        raise ValueError(f"{method.name} does not take bounds, which change y' of positions; use dop853 or ode89")
    if not states_second_order(problem.fun):
        _require_no_velocities(problem, method)


def _require_no_velocities(problem: Description, method: Method) -> None:
    """Evaluates f twice, with other velocities."""
    t0, y0 = problem.t_span[0], problem.y0
    half = len(y0) // 2
    y = np.array([y0, y0])
    y[1, half:] += _OTHER * _irregular(half) * (np.abs(y0[half:]).max(initial=0) or 1.0)
    slopes = problem.slope(np.array([t0, t0]), y.T).T
    if not np.array_equal(slopes[:, :half], y[:, half:]):
        raise ValueError(
            f"second_order: the first {half} values of fun are not the velocities y[{half}:]: fun must return "
            "(v, f(t, q)) of y = (q, v), or use invariode.SecondOrder(f)"
        )
    differ = np.flatnonzero(slopes[0, half:] != slopes[1, half:])
    if len(differ):
        i = half + int(differ[0])
        raise ValueError(
            f"second_order: component {i} of fun depends on the velocities: it is {slopes[0, i]} and {slopes[1, i]} "
            f"for two of them at t = {t0}. {method.name} integrates y'' = f(t, y) only; use dop853 or ode89"
        )


def _irregular(count: int) -> Array:
    fractions: Array = np.modf(_OTHER * np.arange(1, count + 1))[0]
    return 1 + fractions
