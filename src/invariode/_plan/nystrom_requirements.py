"""Requirements of the methods for y'' = f(t, y) on a problem."""

from __future__ import annotations

import numpy as np

from .._base.arguments import Array, reals
from .._base.types import MethodName
from .._functions.graph.derived import derived
from .._functions.graph.nodes import in_order
from .._functions.increments import GOLDEN, spread
from .._functions.layout import layout_of
from .._functions.second_order import states_second_order
from .._problem.methods import Method, find_method
from .._problem.parameters import Y0, values_of, with_values
from .._problem.problem import Problem
from .._results.solution import Solution

#: By what a parameter differs with which accelerations may begin to depend on velocities.
_CHANGE = 1e-3


def require_second_order(problem: Problem, method: Method) -> None:
    """Raise an error unless the problem states second-order equations.

    Raises ValueError: It does not, its accelerations depend on the velocities, or it has what the method does not take.
    """
    if not problem.second_order:
        raise ValueError(
            f"{method.name} is for y'' = f(t, y), and fun is given as y' = f(t, y): pass invariode.SecondOrder(f) with "
            "the accelerations f(t, q) and y0 = (q, v), or second_order=True if fun returns (v, f(t, q)). ode89 and "
            "dop853 take any fun"
        )
    if problem.bounds is not None:
        raise ValueError(f"{method.name} does not take bounds, which change y' of positions; use dop853 or ode89")
    if states_second_order(problem.fun):
        return
    t, y = np.array([problem.t_span[0]]), problem.y0[:, None]
    _require_no_velocities(problem, t, y, "")
    if problem.parameter_names():
        _require_no_velocities(
            _with_other_parameters(problem), t, y, " with other parameters: the sensitivities do too"
        )


def require_no_velocities(problem: Problem, sol: Solution) -> None:
    """Raise an error if accelerations depend on velocities in the middle or at the end of a solution: a drag may have
    begun after the start.

    Raises ValueError: They do.
    """
    if not states_second_order(problem.fun) and len(sol.t):
        some = [len(sol.t) // 2, -1]
        _require_no_velocities(problem, sol.t[some], np.asarray(sol.y)[:, some], ": the solution is wrong")


def _require_no_velocities(problem: Problem, t: Array, y: Array, more: str) -> None:
    """Raise an error if accelerations depend on velocities at points y (n, n_t), at each of which f is evaluated with
    two velocities."""
    half, k = len(y) // 2, len(t)
    points = np.concatenate([y, y], axis=1)
    # irregular changes of about the size of the largest, so that no function of the velocities is the same by chance
    points[half:, k:] += GOLDEN * (1 + spread(half))[:, None] * _largest(y[half:])
    slopes = problem.slope(np.concatenate([t, t]), points)
    finite = np.logical_and.reduce(np.isfinite(slopes))  # where it is not, the run says so
    if not np.array_equal(slopes[:half, finite], points[half:, finite]):
        raise ValueError(
            f"second_order: the first {half} values of fun are not the velocities y[{half}:]: fun must return "
            "(v, f(t, q)) of y = (q, v), or use invariode.SecondOrder(f)"
        )
    one, other = slopes[half:, :k], slopes[half:, k:]
    differ = (one != other) & finite[:k] & finite[k:]
    if differ.any():
        i, at = np.argwhere(differ)[0].tolist()
        raise ValueError(
            f"second_order: component {half + i} of fun depends on the velocities: it is {one[i, at]} and "
            f"{other[i, at]} for two of them at t = {t[at]}{more}. rkn64, rkn86 and rkn1210 integrate y'' = f(t, y) "
            "only; use dop853 or ode89"
        )


def fits_any_args(problem: Problem, method: MethodName) -> bool:
    """Return whether a problem that fits the method does so with other args: accelerations are known not to depend on
    velocities, since that is stated or seen in their graph; and not only tested."""
    if find_method(method)[0].equations != "second-order" or states_second_order(problem.fun):
        return True
    n = reals(problem.y0)
    found = derived(problem.slope.fun, n, n, layout_of(problem.args))
    if found is None:
        return False
    return not any(node.op == "y" and node.value >= n // 2 for node in in_order(found.outputs[n // 2 :]))


def _with_other_parameters(problem: Problem) -> Problem:
    own = [one for one in problem.parameter_names() if one.kind != Y0]
    values = values_of(problem.args, problem.y0, own)
    others = np.where(values != 0, values * (1 + _CHANGE), _CHANGE)
    return problem.replace(args=with_values(problem.args, problem.y0, own, others)[0])


def _largest(velocities: Array) -> Array:
    """The largest component of each, or 1 where all are zero."""
    found = np.abs(velocities).max(axis=0, initial=0)
    return np.where(found > 0, found, 1.0)
