"""The part of a mass matrix in the equations of sensitivities: M S' = J S + ∂f/∂p − (∂M/∂p) y'."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array
from .._base.matrices import as_dense, as_matrix
from .._functions.derivatives import Derivative, derivative_of
from .._functions.layout import with_numbers
from .._functions.with_arguments import Point
from .._problem.parameters import ParameterName, values_of
from .._problem.problem import Problem
from .algebraic import Algebraic, dense_mass

#: A change of a parameter that a mass matrix which depends on it shows.
_CHANGE = 1e-3
#: Entries relative to the largest which are roundoff.
_SAME_SPACE = 1e-10
#: Parts of the interval at which a mass matrix is compared with itself.
_TIMES = (0.0, 0.3819660112501051, 1.0)


class _MassByRows:
    """A mass matrix (t, *args) as a function of (t, y, *args), row by row."""

    def __init__(self, mass: Any) -> None:
        self._mass = mass
        self.__name__ = "mass"

    def __call__(self, t: Any, y: Any, *args: Any) -> Any:
        return np.ravel(as_dense(self._mass(t, *args)))


class MassDerivatives:
    """(∂M/∂p_j) y' of a problem.

    - `problem`: the problem
    - `names`: the parameters
    - `rate`: (t, y) -> y'

    Attributes:
    - `derivatives`: derivatives of the mass matrix
    """

    def __init__(self, problem: Problem, names: Sequence[ParameterName], rate: Callable[[float, Array], Array]) -> None:
        n = len(problem.y0)
        at = Point(problem.t_span[0], problem.y0)
        rows = _MassByRows(problem.matrices.mass)
        self.derivatives = derivative_of(rows, (n * n, n), at=at, args=problem.args, names=names, called="mass")
        self._rate, self._n = rate, n

    def __call__(self, t: float, y: Array) -> Array:
        """(∂M/∂p_j) y' in row j, (k, n)."""
        of_p = self.derivatives.of_parameters(t, y[: self._n]).T
        return np.asarray(of_p.reshape(-1, self._n, self._n) @ self._rate(t, y))


class WithMass:
    """J S_j + ∂f/∂p_j − (∂M/∂p_j) y', as the core calls it."""

    def __init__(self, slope: Derivative, mass: MassDerivatives) -> None:
        self._slope, self._mass = slope, mass

    def __call__(self, t: float, Y: ArrayLike) -> Array:
        rows = np.asarray(Y, dtype=float).reshape(1 + self._slope.k, self._slope.n)
        return self._slope.tangent(t, rows) - self._mass(t, rows[0])


class AlgebraicOverTime:
    """The algebraic equations of a singular mass matrix, which may be a function of t."""

    def __init__(self, problem: Problem) -> None:
        self._mass, self._args = problem.matrices.mass, problem.args
        self._at_start = Algebraic.of(dense_mass(self._mass, problem.t_span[0], self._args))
        self.moves = self.is_singular and moves_in_time(problem)  # M is a function of t

    @property
    def is_singular(self) -> bool:
        """True if there are algebraic equations."""
        return self._at_start is not None

    def at(self, t: float) -> Algebraic:
        """The equations at a time."""
        assert self._at_start is not None
        if not self.moves:
            return self._at_start
        M = dense_mass(self._mass, t, self._args)
        assert M is not None
        found = self._at_start._replace(M=M)
        if not max(np.abs(found.Z.T @ M).max(), np.abs(M @ found.N).max()) <= _SAME_SPACE * np.abs(M).max():
            raise ValueError(
                f"the null spaces of the singular mass matrix are not those of the start at t = {t:.6g}, and events, "
                "parameters in it and gradients need that: write the equations so that the same ones are algebraic, "
                "for the same components, at all t"
            )
        return found


def mass_rate(problem: Problem, derivatives: Callable[..., Derivative]) -> Callable[[float], Array]:
    """M' as a function of t."""
    n = len(problem.y0)
    made = derivatives(_MassByRows(problem.matrices.mass), "mass", m=n * n, moves_t=True)
    return lambda t: made.of_time(t, problem.y0).reshape(n, n)


def mass_derivatives(
    problem: Problem, names: Sequence[ParameterName], rate: Callable[[float, Array], Array]
) -> MassDerivatives | None:
    """Return the derivatives of the mass matrix of a problem; None if it depends on none of these parameters."""
    return MassDerivatives(problem, names, rate) if depends_on(problem, names) else None


def depends_on(problem: Problem, names: Sequence[ParameterName]) -> bool:
    """Return whether the mass matrix depends on one of these parameters."""
    mass, args = problem.matrices.mass, problem.args
    if not callable(mass):
        return False
    own = [one for one in names if one.kind == "args"]
    times = _some_times(problem)
    here = [as_matrix("mass", mass(t, *args)) for t in times]
    for one, value in zip(own, values_of(args, problem.y0, own).tolist(), strict=True):
        changed = value * (1 + _CHANGE) if value else _CHANGE
        others = with_numbers(args, {one.index: {one.item or 0: changed}})
        if any(abs(as_matrix("mass", mass(t, *others)) - M).max() != 0 for t, M in zip(times, here, strict=True)):
            return True
    return False


def moves_in_time(problem: Problem) -> bool:
    """Return whether the mass matrix is a function of t."""
    mass = problem.matrices.mass
    if not callable(mass):
        return False
    first, *others = (as_matrix("mass", mass(t, *problem.args)) for t in _some_times(problem))
    return any(abs(one - first).max() != 0 for one in others)


def _some_times(problem: Problem) -> list[float]:
    t0, tf = problem.t_span
    length = tf - t0 if np.isfinite(tf) else np.copysign(max(abs(t0), 1.0), tf)
    return [t0 + part * length for part in _TIMES]
