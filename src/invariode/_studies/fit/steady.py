"""Starts at a steady state: f = 0 with the totals of the initial value, and its derivatives for the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array
from ..._functions.compiled import CompiledFunction, is_native
from ..._functions.derivatives import somewhere
from ..._functions.directional import Directional, Point
from ..._functions.layout import with_numbers
from ..._problem.inputs import fed
from ..._problem.parameters import ParameterName
from ..._solve.problem import Problem
from .failed import Failed

#: Points at which totals are sought, in parts of the sizes of y: a total is constant along f at all of them.
_BESIDE = (0.0, 0.3, -0.2, 0.7)

#: Singular values below this part of the largest are zero.
_ZERO = 1e-9

#: The first implicit step moves y by this part of its size; the steps that follow grow by up to this factor.
_FIRST, _FASTER = 0.1, 10.0

#: Steps, and the relative change that ends them; components below a part of the largest count as of that size.
_STEPS, _ARRIVED, _FLOOR = 200, 1e-11, 1e-6

#: A step is too long that makes a component negative by more than this part of the largest.
_BELOW = 1e-3

#: A rate of growth above this part of the largest rate is one: the state is not stable.
_GROWS = 1e-7


class Steady(NamedTuple):
    """A steady state y (n,), and its derivatives (n, k) for the parameters."""

    y: Array
    slopes: Array


class SteadyStates:
    """The steady states of a problem to which its initial value leads.

    Implicit Euler steps of growing size follow the solution without its accuracy and end as Newton's method
    (pseudo-transient continuation, C. T. Kelley and D. E. Keyes, SIAM J. Numer. Anal. 35 (1998) 508-523); they keep
    linear totals.

    Parameters
    ----------
    problem : Problem
        Its f is taken at t0.
    names : sequence of ParameterName
        Parameters, among them initial values: the totals are those of these.
    """

    def __init__(self, problem: Problem, names: Sequence[ParameterName]) -> None:
        if problem.matrices.mass is not None:
            raise ValueError(
                'y0="steady" is for problems without a mass matrix: solve for the steady state, and give it'
            )
        fun = problem.fun.fun if isinstance(problem.fun, CompiledFunction) else problem.fun
        if is_native(fun) or (isinstance(problem.fun, CompiledFunction) and problem.fun.inplace):
            raise TypeError('y0="steady" needs f as a Python function, or one of invariode.compile that is not inplace')
        self._problem, self._names, self._n = problem, names, len(problem.y0)
        self._own = [(j, one) for j, one in enumerate(names) if one.kind == "args"]
        places = {j: self._n + i for i, (j, _) in enumerate(self._own)}
        function, n = fed(fun, problem.inputs), self._n

        def joint(t: float, z: Any) -> Any:
            """f of t and (y, parameters)."""
            changes: dict[int, dict[int, Any]] = {}
            for j, one in self._own:
                changes.setdefault(one.index, {})[one.item or 0] = z[places[j]]
            return function(t, z[:n], *with_numbers(problem.args, changes))

        start = np.concatenate([problem.y0, np.ones(len(self._own))])
        self._t = problem.t_span[0]
        self._f = Directional(joint, (), (), len(start), at=Point(self._t, start), called="fun")

    def at(self, values: Array, y0: Array) -> Steady | Failed:
        """The steady state for values of the parameters, (k,), and the initial value that they make."""
        p = values[[j for j, _ in self._own]]
        totals = self._totals(y0, p)
        y = self._relaxed(y0, p)
        if isinstance(y, Failed):
            return y
        _, J, fp = self._linear(y, p)
        rates = np.linalg.eigvals(J)
        if rates.real.max() > _GROWS * np.abs(rates).max():
            return Failed("the steady state that was found is not stable")
        size = np.linalg.norm(J) or 1.0
        system = np.vstack([J / size, totals])
        if np.linalg.matrix_rank(system, tol=_ZERO) < self._n:
            return Failed("the steady state is not isolated: others with the same totals are beside it")
        right = np.zeros((len(system), len(self._names)))
        right[: self._n, [j for j, _ in self._own]] = -fp / size
        for j, one in enumerate(self._names):
            if one.kind == "y0":
                right[self._n :, j] = totals[:, one.index]
        return Steady(y, np.linalg.lstsq(system, right, rcond=None)[0])

    def _linear(self, y: Array, p: Array) -> tuple[Array, Array, Array]:
        """f, ∂f/∂y and ∂f/∂p."""
        z = np.concatenate([y, p])
        slopes = self._f.columns(self._t, z, np.zeros(len(z)), np.eye(len(z)), np.zeros((len(z), 0))).T
        return self._f.value(self._t, z), slopes[:, : self._n], slopes[:, self._n :]

    def _totals(self, y: Array, p: Array) -> Array:
        """An orthonormal basis of the linear functions that f does not change, in rows: those in the left null space of
        the Jacobian at every point."""
        direction = somewhere(y)
        beside = [self._linear(np.abs(y + part * direction) if (y >= 0).all() else y + part * direction, p)[1]
                  for part in _BESIDE]  # fmt: skip
        left, sizes, _ = np.linalg.svd(np.hstack(beside))
        return np.asarray(left[:, sizes <= _ZERO * sizes.max(initial=0.0)].T)

    def _relaxed(self, y: Array, p: Array) -> Array | Failed:
        """The end of the steps."""
        with np.errstate(all="ignore"):
            f, J, _ = self._linear(y, p)
            length = float(np.linalg.norm(f))
            h = _FIRST * (float(np.linalg.norm(y)) or 1.0) / (length or 1.0)
            for _ in range(_STEPS):
                taken = self._step(y, p, f, J, h)
                if taken is None:
                    h /= _FASTER
                    continue
                step, (f, J, _) = taken
                y = y + step
                largest = np.abs(y).max(initial=0.0)
                if (np.abs(step) <= _ARRIVED * np.maximum(np.abs(y), _FLOOR * largest)).all():
                    return y
                before, length = length, float(np.linalg.norm(f))
                grown = 2 * max(before / length, 1.0) if length > 0 else _FASTER
                h *= min(grown, _FASTER) if length < 2 * before else 1 / _FASTER
        return Failed(f"no steady state was found from y0 = {y}")

    def _step(
        self, y: Array, p: Array, f: Array, J: Array, h: float
    ) -> tuple[Array, tuple[Array, Array, Array]] | None:
        """An implicit step and f with its derivatives behind it; None: there is no such step, or it is too long."""
        try:
            step = np.linalg.solve(np.eye(self._n) / h - J, f)
            if ((y >= 0) & (y + step < -_BELOW * np.abs(y).max(initial=0.0))).any():
                return None  # amounts do not change their sign
            behind = self._linear(y + step, p)
        except (np.linalg.LinAlgError, ValueError, ArithmeticError):
            return None
        return (step, behind) if all(np.isfinite(one).all() for one in behind) else None
