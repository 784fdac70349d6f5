"""The equations of motion of a constrained mechanical system, at a point: the constraints, their derivatives, and the
accelerations that these leave."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from . import _core
from ._arguments import Array
from ._derivatives import Derivatives, reach

__all__ = ["Accelerations", "Motion", "Point"]

#: Rows of the constraints that depend on others to within this part of their length are left out of a solve. Their
#: derivatives are exact to roundoff, or from differences of order 4, good to 1e-11.
DEPENDENT = 1e-10
#: Relative increment of the central difference of Φ along the motion, ε^(1/3).
_ALONG = float(np.finfo(float).eps) ** (1 / 3)


class Point(NamedTuple):
    """A state of the system, and the extra arguments of its functions."""

    t: float
    q: Array
    v: Array
    args: tuple[Any, ...]

    @property
    def x(self) -> Array:
        """(q, v) as one array."""
        return np.concatenate([self.q, self.v])


class Accelerations(NamedTuple):
    """v' and the multipliers λ of all constraints."""

    a: Array
    multipliers: Array
    unique: bool  # M is definite on the null space of the constraints


class Motion:
    """M v' = Q + Aᵀ λ, q' = K(t, q, v), φ(t, q) = 0, ψ(t, q, v) = 0.

    Parameters
    ----------
    mass, force, constraints, velocity_constraints, kinematics, jacobian
        The user's functions. `mass` may be constant.
    start : Point
        Where the functions are tried.
    """

    def __init__(
        self,
        mass: Any,
        force: Callable[..., Any],
        constraints: Callable[..., Any] | None,
        velocity_constraints: Callable[..., Any] | None,
        kinematics: Callable[..., Any] | None,
        jacobian: Callable[..., Any] | None,
        start: Point,
    ) -> None:
        self.n_q, self.n_v = len(start.q), len(start.v)
        self._force, self._jacobian = force, jacobian
        self._mass = mass if callable(mass) else self._as_matrix(mass)
        t, q, _, args = start
        self.phi = None if constraints is None else Derivatives(constraints, t, q, args, "constraints(t, q)")
        self.psi = self._of_state(velocity_constraints, start, "velocity_constraints(t, q, v)")
        self.kinematics = self._of_state(kinematics, start, "kinematics(t, q, v)")
        self.kept: Array = np.ones(self.m, dtype=bool)

    def _of_state(self, function: Callable[..., Any] | None, start: Point, name: str) -> Derivatives | None:
        """Derivatives of function(t, q, v) with x = (q, v)."""
        if function is None:
            return None
        n = self.n_q

        def of_state(t: Any, x: Array, *args: Any) -> Any:
            return function(t, x[:n], x[n:], *args)

        return Derivatives(of_state, start.t, start.x, start.args, name)

    @property
    def m_phi(self) -> int:
        """Number of holonomic constraints."""
        return 0 if self.phi is None else self.phi.m

    @property
    def m(self) -> int:
        """Number of all constraints."""
        return self.m_phi + (0 if self.psi is None else self.psi.m)

    # ------------------------------------------------------------------------------------------------------------------
    # What the user's functions give

    def mass(self, at: Point) -> Array:
        """M, (n_v, n_v)."""
        if callable(self._mass):
            return self._as_matrix(self._mass(at.t, at.q, *at.args))
        return self._mass

    def metric(self) -> Any:
        """M as the metric of corrections: constant, its diagonal if it has no more, or a function of t and (q, v)."""
        mass = self._mass
        if not callable(mass):
            diagonal: Array = np.diag(mass)
            return diagonal.copy() if np.array_equal(np.diag(diagonal), mass) else mass
        n = self.n_q

        def at_state(t: float, y: Array, *args: Any) -> Array:
            return self._as_matrix(mass(t, y[:n], *args))

        return at_state

    def _as_matrix(self, mass: Any) -> Array:
        dense = np.asarray(mass.toarray() if hasattr(mass, "toarray") else mass, dtype=float)
        n = self.n_v
        if dense.shape == (n,):
            return np.diag(dense)
        if dense.shape != (n, n):
            raise ValueError(f"mass must have shape ({n},) or ({n}, {n}), as v0 has {n} components, got {dense.shape}")
        return dense

    def force(self, at: Point) -> Array:
        """Q, (n_v,)."""
        force = np.asarray(self._force(at.t, at.q, at.v, *at.args), dtype=float)
        if force.shape != (self.n_v,):
            raise ValueError(f"force(t, q, v) returned shape {force.shape}, expected ({self.n_v},), as v0 has")
        return force

    def q_dot(self, at: Point) -> Array:
        """q' = K(t, q, v), or v."""
        if self.kinematics is None:
            return at.v
        q_dot = self.kinematics.value(at.t, at.x, at.args)
        if q_dot.shape != (self.n_q,):
            raise ValueError(f"kinematics(t, q, v) returned shape {q_dot.shape}, expected ({self.n_q},), as q0 has")
        return q_dot

    def positions(self, t: float, q: Array, args: tuple[Any, ...]) -> Array:
        """φ."""
        return np.zeros(0) if self.phi is None else self.phi.value(t, q, args)

    def positions_jacobian(self, t: float, q: Array, args: tuple[Any, ...]) -> Array:
        """Φ = ∂φ/∂q."""
        if self.phi is None:
            return np.zeros((0, self.n_q))
        if self._jacobian is None:
            return self.phi.jacobian(t, q, args)
        given = self._jacobian(t, q, *args)
        rows = np.asarray(given.toarray() if hasattr(given, "toarray") else given, dtype=float)
        if rows.size != self.m_phi * self.n_q or rows.ndim not in (1, 2):
            raise ValueError(f"jacobian(t, q) returned shape {rows.shape}, expected ({self.m_phi}, {self.n_q})")
        return rows.reshape(self.m_phi, self.n_q)

    # ------------------------------------------------------------------------------------------------------------------
    # The constraints as equations of the velocities

    def rates(self, at: Point) -> Array:
        """(φ', ψ): what the velocities must make zero."""
        parts = []
        if self.phi is not None:
            parts.append(self.phi.slope(at.t, at.q, 1.0, self.q_dot(at), at.args))
        if self.psi is not None:
            parts.append(self.psi.value(at.t, at.x, at.args))
        return np.concatenate(parts) if parts else np.zeros(0)

    def rates_jacobian(self, at: Point) -> Array:
        """∂φ'/∂(q, v). By the symmetry of second derivatives ∂/∂q (Φ K + φ_t) = dΦ/dt along the motion + Φ K_q."""
        q_dot = self.q_dot(at)
        size = _ALONG * reach(at.t, at.q, 1.0, q_dot)
        later = self.positions_jacobian(at.t + size, at.q + size * q_dot, at.args)
        earlier = self.positions_jacobian(at.t - size, at.q - size * q_dot, at.args)
        by_q = (later - earlier) / (2 * size)
        rows = self.positions_jacobian(at.t, at.q, at.args)
        if self.kinematics is None:
            return np.hstack([by_q, rows])
        map_jacobian = self.kinematics.jacobian(at.t, at.x, at.args)
        jacobian: Array = np.hstack([by_q, np.zeros((len(rows), self.n_v))]) + rows @ map_jacobian
        return jacobian

    def rows(self, at: Point) -> Array:
        """A = (Φ K_v, ψ_v), of shape (m, n_v), of all constraints."""
        rows = self.positions_jacobian(at.t, at.q, at.args)
        if self.kinematics is not None:
            rows = rows @ self._by_v(self.kinematics, at)
        return rows if self.psi is None else np.vstack([rows, self._by_v(self.psi, at)])

    def _by_v(self, function: Derivatives, at: Point) -> Array:
        """∂/∂v of a function of (q, v). ψ is linear in v, and so is K but for odd choices of v."""
        rows = np.empty((function.m, self.n_v))
        direction = np.zeros(self.n_q + self.n_v)
        for j in range(self.n_v):
            direction[self.n_q + j] = 1.0
            rows[:, j] = function.slope(at.t, at.x, 0.0, direction, at.args)
            direction[self.n_q + j] = 0.0
        return rows

    def right_hand_side(self, at: Point) -> Array:
        """What A v' must be: γ = -(φ'' without its A v'), and -dψ/dt with v held."""
        q_dot = self.q_dot(at)
        along = np.concatenate([q_dot, np.zeros(self.n_v)])
        parts = []
        if self.phi is not None:
            curvature = self.phi.curvature(at.t, at.q, 1.0, q_dot, at.args)
            if self.kinematics is not None:
                bend = self.kinematics.slope(at.t, at.x, 1.0, along, at.args)
                curvature = curvature + self.positions_jacobian(at.t, at.q, at.args) @ bend
            parts.append(-curvature)
        if self.psi is not None:
            parts.append(-self.psi.slope(at.t, at.x, 1.0, along, at.args))
        return np.concatenate(parts) if parts else np.zeros(0)

    # ------------------------------------------------------------------------------------------------------------------
    # The accelerations

    def accelerations(self, at: Point, every: bool = False) -> Accelerations:
        """v' and λ; `every`: with redundant constraints too, λ is then the one of least norm."""
        kept = np.ones(self.m, dtype=bool) if every else self.kept
        mass, force = self.mass(at), self.force(at)
        rows, right = self.rows(at)[kept], self.right_hand_side(at)[kept]
        if not all(np.isfinite(part).all() for part in (mass, force, rows, right)):
            return Accelerations(np.full(self.n_v, np.nan), np.full(kept.sum(), np.nan), True)
        a, multipliers, _, unique = _core.solve_saddle(
            np.ascontiguousarray(mass), np.ascontiguousarray(rows), force, np.ascontiguousarray(right), DEPENDENT
        )
        return Accelerations(a, multipliers, unique)

    def slope(self, at: Point) -> Array:
        """(q', v')."""
        return np.concatenate([self.q_dot(at), self.accelerations(at).a])
