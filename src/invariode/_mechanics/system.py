"""Constrained mechanics: from mass, forces and constraints to a problem whose solution satisfies the constraints."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from itertools import compress
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    Array,
    as_array,
    choice,
    extra_arguments,
    function,
    interval,
    shown,
    state,
    warn,
)
from .._base.failures import InvariantError
from .._base.package import public
from .._base.suggestions import first_few, meant, naming_arguments
from .._base.types import Points, Span
from .._functions.compiled import is_native
from .._plan.call_errors import require_called
from .._problem.invariants import Invariants, InvariantsLike, to_invariants
from .._problem.problem import Problem
from .._results.solution import HasPoints
from .consistent import consistent_state, nearby_state, redundant_rows
from .motion import FunctionOfState, Functions, Motion, MotionFunction, MotionPoint, vanishing

#: With correction="none" nothing else sees an inconsistent start: residuals above this part of their terms mean one.
_INCONSISTENT = 1e-6
#: ψ is linear in v if a combination of values is the value of the combination to this fraction of its terms.
_LINEAR = 1e-9
#: The mass matrix must be symmetric to this fraction of its largest entry.
_SYMMETRIC = 1e-12


@public
@naming_arguments
class MechanicalSystem(HasPoints):
    """A mechanical system with constraints: M(t, q) v' = Q(t, q, v) + Φᵀ λ, q' = v, φ(t, q) = 0.

    `problem` turns it into an ordinary differential equation, by solving for the constraint forces, together with the
    equation's invariants: φ = 0 and its rate Φ v + φ_t = 0. Any method can solve it. All derivatives are formed
    automatically.

    Parameters
    ----------
    mass : array_like of shape (n,) or (n, n), or callable
        M, constant or ``M(t, q, *args)``; a diagonal, a matrix, or a sparse matrix. Symmetric, and positive definite
        on the velocities that the constraints allow.
    force : callable
        ``Q(t, q, v, *args)``, of shape (n,): all forces except the constraint forces, including terms quadratic in v.
    constraints : callable or Invariants, optional
        Holonomic constraints ``φ(t, q, *args)``, a number or shape (m,); or ``Invariants(φ, names=[...])``, which
        names them in messages and tables.
    velocity_constraints : callable or Invariants, optional
        Non-holonomic constraints ``ψ(t, q, v, *args)``, a number or shape (k,), linear in v; named likewise.
    kinematics : callable, optional
        ``K(t, q, v, *args)``, the derivative of q if that is not v, as with quaternions: q and v may then differ in
        length.
    energy : callable, optional
        ``E(t, q, v, *args)``, a number, held at its initial value. Default: no energy is held.
    invariants : callable, Invariants, or list or dict of these, optional
        Further invariants ``g(t, y, *args)`` with y = (q, v).
    points : callable, optional
        ``points(t, q, *args)``, shape (k, 2) or (k, 3): what `animate` shows.
    args : tuple, optional
        Extra arguments of all functions.
    labels : sequence of str, optional
        Names of the components of q, then of those of v.
    name : str, optional
        For tables and plots.
    jacobian : callable, optional
        ``Φ(t, q, *args)``, the Jacobian ∂φ/∂q of shape (m, n), dense or sparse. Default: by complex steps if φ takes
        complex t and q, else by differences of order 4.

    Notes
    -----
    Write `constraints` so that they take complex q: with NumPy's functions, without abs and max. Then Φ is exact to
    roundoff, and the second derivative of φ along the motion is good to about twelve digits. With differences Φ is good
    to eleven digits, the second derivative to eight.

    Such a system is a differential-algebraic equation of index 3. The ordinary one with invariants is as accurate,
    suits explicit methods, and needs no multipliers: these are computed afterwards, on request.

    All functions may be native (`invariode.compile`, ctypes, ...), alone or with Python functions: ``f(t, q)`` or
    ``f(t, q, v)``, with `args` ``f(t, q, p)`` or ``f(t, q, v, p)``, p being the arguments as an array. In C these are
    ``void f(double t, const double* x, double* out, const double* p)`` with x = q, or q followed by v; a mass fills
    (n, n). Native constraints not made by `compile` need names, which give their number, and are differentiated by
    differences. If all functions are native, no Python is called in the run.

    Problems of a system take ``sensitivities=`` and ``adjoint=True``: derivatives with respect to `args` and initial
    values are exact if all functions can be traced (plain NumPy, or `invariode.compile`) and v and the constraints have
    at most 36 components together; otherwise they are differences, with a warning.

    A call of f evaluates mass, force, and φ about n + 6 times, or with `jacobian` 6 times (several times as many near
    singular positions, where bars line up), and factorises M, dense, in
    O(n³) operations. With 24 velocities or more, entries of M and Φ that are always zero are looked for. If most are,
    as in chains, one evaluation of φ gives all columns of Φ that have no row in common, and the factors are sparse: a
    call of f costs O(n).

    Examples
    --------
    A pendulum of length 1 in the plane:

    >>> import invariode as iv
    >>> pendulum = iv.MechanicalSystem(
    ...     [1, 1], lambda t, q, v: [0, -1], constraints=lambda t, q: q[0] ** 2 + q[1] ** 2 - 1
    ... )
    >>> sol = pendulum.problem((0, 10), [1, 0], [0, 0]).solve("ode113", rtol=1e-8, atol=1e-10)
    >>> bool(abs(sol.y[0] ** 2 + sol.y[1] ** 2 - 1).max() < 1e-14)
    True
    >>> pendulum.reactions(sol).shape == (2, len(sol.t))
    True
    """

    def __init__(
        self,
        mass: ArrayLike | Callable[..., Any],
        force: Callable[..., Any],
        constraints: Callable[..., Any] | Invariants | None = None,
        velocity_constraints: Callable[..., Any] | Invariants | None = None,
        kinematics: Callable[..., Any] | None = None,
        energy: Callable[..., Any] | None = None,
        invariants: InvariantsLike | None = None,
        points: Callable[..., Any] | None = None,
        *,
        args: Iterable[Any] = (),
        labels: Sequence[str] | None = None,
        name: str | None = None,
        jacobian: Callable[..., Any] | None = None,
    ) -> None:
        if isinstance(mass, (str, list, tuple, np.ndarray)):
            values = as_array("mass", mass)
            if values.dtype.kind in "USc" or (values.dtype.kind == "f" and not np.isfinite(values).all()):
                raise ValueError(f"mass must hold finite real numbers, got {shown(mass)}")
        self.args = extra_arguments(args)
        optional = {
            "force": (force, "Q(t, q, v)"),
            "mass": (mass if callable(mass) else None, "M(t, q)"),
            "constraints": (constraints, "φ(t, q)"),
            "velocity_constraints": (velocity_constraints, "ψ(t, q, v)"),
            "kinematics": (kinematics, "K(t, q, v)"),
            "energy": (energy, "E(t, q, v)"),
            "jacobian": (jacobian, "Φ(t, q)"),
            "points": (points, "points(t, q)"),
        }
        for argument, (given, signature) in optional.items():
            named = argument.endswith("constraints") and isinstance(given, Invariants)
            if given is not None and not is_native(given) and not named:
                require_called(argument, function(argument, given, signature), signature, self.args)
        if jacobian is not None and constraints is None:
            raise ValueError("jacobian is that of the constraints: give constraints too")
        self.mass, self.force = mass, force
        self.constraints, self.velocity_constraints = constraints, velocity_constraints
        self.kinematics, self.energy, self.jacobian = kinematics, energy, jacobian
        self.invariants = to_invariants(invariants)
        self.points = points
        self.labels = None if labels is None else list(labels)
        self.name = name
        self._n_q: int | None = None  # known from `problem`, if lengths of q and v differ

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r})" if self.name else f"{type(self).__name__}()"

    def problem(
        self,
        t_span: Span,
        q0: ArrayLike,
        v0: ArrayLike,
        consistent: Literal["check", "project"] = "check",
        correction: Literal["levels", "joint", "none"] = "levels",
        fixed: Sequence[str] = (),
    ) -> Problem:
        """Return the initial value problem of y = (q, v).

        Parameters
        ----------
        t_span : (float, float)
            (t0, tf).
        q0 : array_like
            Positions at t0.
        v0 : array_like
            Velocities at t0.
        consistent : {'check', 'project'}, default 'check'
            A start that is off the constraints by less than the run's tolerances is moved onto them. One that is
            farther off is an `InvariantError` in the run, or is moved by the least change in the metric of the mass
            matrix, with a warning that says how far.
        correction : {'levels', 'joint', 'none'}, default 'levels'
            How the solution is put back onto the constraints after each step: first positions onto φ = 0, then
            velocities onto φ' = 0 and ψ = 0 with the positions held, then all onto energy and further invariants
            without leaving those; all invariants together, as in the paper; or not at all.
        fixed : sequence of str, optional
            With ``consistent="project"``: labels of components that keep their values, such as the speed of a crank.
            Default labels are "q1", …, "v1", ….

        Returns
        -------
        Problem
            With invariants in that order: φ, φ' and ψ, the energy, the others.

        Raises
        ------
        ValueError
            Shapes do not match; ψ is not linear in v; a constraint does not depend on q; M is singular on the
            velocities that the constraints allow; `fixed` names no component, or stands without
            ``consistent="project"``.
        InvariantError
            The constraints contradict each other: there is no consistent state.

        Examples
        --------
        >>> import invariode as iv
        >>> bead = iv.MechanicalSystem([1, 1], lambda t, q, v: [0, -1], constraints=lambda t, q: q[0] - q[1])
        >>> bead.problem((0, 1), [1, 1], [0, 0])
        Problem('mechanism', t_span=(0.0, 1.0), n=4)
        """
        choice("consistent", consistent, ("check", "project"))
        choice("correction", correction, ("levels", "joint", "none"))
        start = MotionPoint(interval(t_span)[0], state(q0), state(v0), self.args)
        motion = self._motion(start)
        names = self._names(motion)
        if len(fixed) and consistent != "project":
            raise ValueError('fixed says what a start keeps that is moved: give consistent="project" too')
        known = consistent_state(motion, start, names, self._components(motion, fixed))
        self._look_for_redundancy(motion, known, names)
        if consistent == "project":
            self._tell_move(motion, start, known)
            start = known
        elif correction == "none":
            self._require_consistent(motion, start, names)
        if not motion.accelerations(known).unique:
            raise ValueError(
                f"mass is not positive definite on the velocities that the constraints allow, at t = {start.t}: the "
                "accelerations are not determined. Give a mass to every motion that is free"
            )

        held = None if correction == "none" else self._laws(motion, names, in_levels=correction == "levels")
        slope = MotionFunction(motion, "slope")
        return Problem(
            slope, t_span, start.x, args=self.args, invariants=held, name=self.name, labels=self._labels(motion)
        )

    def consistent(self, t: float, y: ArrayLike) -> Array:
        """Return the state nearest to y = (q, v), in the metric of the mass, that satisfies the constraints.

        Positions are corrected first. An event's action that changes velocities should return this state: the joints
        react to an impact with impulses, which change v by the least amount in this metric.

        Parameters
        ----------
        t : float
            The time.
        y : array_like of shape (n,)
            A state of a problem of this system.

        Returns
        -------
        ndarray, (n,)

        Raises
        ------
        InvariantError
            There is no consistent state nearby.

        Examples
        --------
        >>> import invariode as iv
        >>> bead = iv.MechanicalSystem([1, 3], lambda t, q, v: [0, -1], constraints=lambda t, q: q[0] - q[1])
        >>> bead.consistent(0.0, [0, 0, 4, 0])
        array([0., 0., 1., 1.])
        """
        values = state(y)
        n = self._positions_of(values)
        start = MotionPoint(float(t), values[:n], values[n:], self.args)
        motion = self._motion(start)
        return consistent_state(motion, start, self._names(motion)).x

    def multipliers(self, sol: Points, args: Iterable[Any] | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return the Lagrange multipliers λ of M v' = Q + Aᵀ λ at the points of a solution.

        A multiplier is a force per unit of its constraint. If a constraint φ is a length, such as the distance of two
        points minus that of a rod, its multiplier is a force, positive where it pushes φ up: the tension of the rod is
        −λ. If φ is the difference of two points, a row for each coordinate, λ is the force on the first point. For
        φ = q·q − l² the multiplier is −T / (2 l): write lengths where you want forces.

        Parameters
        ----------
        sol : Solution or SteadyState
            Of a problem of this system.
        args : tuple, optional
            The arguments with which it was solved. Default: those of its problem, if the solution knows it, else those
            of the system. Give them for trajectories of ensembles and for loaded solutions.
        t : array_like of shape (n_t,), optional
            Times of the run: any with dense output, otherwise those of outputs. Default: all outputs.

        Returns
        -------
        ndarray, (m, n_t)
            The multipliers of the constraints, then those of the velocity constraints, in units of force times length
            over the unit of each; of least norm if constraints are redundant.

        Raises
        ------
        ValueError
            A time outside the run, where the states are only extrapolated; without dense output, one that is no output.
        """
        columns = [motion.accelerations(at, every=True).multipliers for motion, at in self._along(sol, args, t)]
        return np.array(columns).T

    def reactions(
        self,
        sol: Points,
        args: Iterable[Any] | None = None,
        *,
        constraints: Sequence[int] | None = None,
        t: ArrayLike | None = None,
    ) -> Array:
        """Return the generalized forces Aᵀ λ of constraints at the points of a solution.

        The rows of A are Φ = ∂φ/∂q and ∂ψ/∂v.

        Parameters
        ----------
        sol : Solution
            Of a problem of this system.
        args : tuple, optional
            As for ``multipliers``.
        constraints : sequence of int, optional
            Rows of the constraints whose forces are added up, as the rows of one joint. Default: all of them, which is
            the force of the whole mechanism on each coordinate.
        t : array_like of shape (n_t,), optional
            As for ``multipliers``.

        Returns
        -------
        ndarray, (n, n_t)
            In the directions of v: forces where a component of v is a velocity, torques where it is an angular one.

        Raises
        ------
        ValueError
            A row is not one of the constraints; a time outside the run, as for ``multipliers``.
        """
        columns = []
        for motion, at in self._along(sol, args, t):
            multipliers, rows = motion.accelerations(at, every=True).multipliers, motion.rows(at)
            if constraints is not None:
                chosen = np.asarray(constraints, dtype=int)
                m = len(multipliers)
                if chosen.ndim != 1 or ((chosen < 0) | (chosen >= m)).any():
                    raise ValueError(f"constraints must be rows from 0 to {m - 1}, got {shown(constraints)}")
                multipliers, rows = multipliers[chosen], rows[chosen]
            columns.append(rows.T @ multipliers)
        return np.array(columns).T

    def _places(self, sol: Any) -> Callable[[float, Array], Any]:
        if self.points is None:
            raise ValueError("the system has no points: make it with points=, or use sol.animate")
        n, place, args = self._positions_of(sol.y), self.points, self.args
        return lambda t, y: place(t, y[:n], *args)

    def _along(self, sol: Points, args: Iterable[Any] | None, t: ArrayLike | None) -> list[tuple[Motion, MotionPoint]]:
        if not hasattr(sol, "y"):
            raise TypeError(f"sol must be a solution of a problem of this system, got {shown(sol)}")
        n = self._positions_of(np.asarray(sol.y))
        source = getattr(getattr(sol, "_origin", None), "source", None)  # None: of a file or a pickle
        known = self.args if source is None else source.problem.args
        used = known if args is None else extra_arguments(args)
        times = np.atleast_1d(np.asarray(sol.t if t is None else t, dtype=float))
        states: Any = sol.y
        if t is not None and (continuous := getattr(sol, "sol", None)) is not None:
            states = continuous(times, extrapolate=False)
        elif t is not None:
            among = np.atleast_1d(sol.t).tolist()
            if not set(times.tolist()) <= set(among):
                raise ValueError(
                    "t needs a continuous solution: solve with dense_output=True, or these times as t_eval"
                )
            last = len(among) - 1  # of two outputs at one time, before and after a jump, the latter, as sol.sol has it
            states = np.reshape(sol.y, (-1, len(among)))[:, [last - among[::-1].index(at) for at in times.tolist()]]
        rows = np.reshape(states, (-1, len(times))).T
        points = [MotionPoint(float(at), y[:n], y[n:], used) for at, y in zip(times, rows, strict=True)]
        motion = self._motion(points[0]) if points else None
        return [(motion, at) for at in points if motion is not None]

    def _positions_of(self, y: Array) -> int:
        """Return the number of components of y that are positions."""
        if self.kinematics is None:
            return len(y) // 2
        if self._n_q is None:
            raise ValueError(
                "the solution does not belong to a problem of this system: make one with `problem`, and solve it"
            )
        return self._n_q

    # ------------------------------------------------------------------------------------------------------------------
    # The start

    def _motion(self, start: MotionPoint) -> Motion:
        n_q, n_v = len(start.q), len(start.v)
        if self.kinematics is None and n_q != n_v:
            raise ValueError(
                f"q0 and v0 must have the same length if q' = v, got {n_q} and {n_v}; else give kinematics"
            )
        self._n_q = n_q
        given = {"constraints": self.constraints, "velocity_constraints": self.velocity_constraints}
        invariants = {name: one for name, one in given.items() if isinstance(one, Invariants)}
        functions = Functions(
            mass=self.mass,
            force=self.force,
            kinematics=self.kinematics,
            jacobian=self.jacobian,
            **{name: one.fun if isinstance(one, Invariants) else one for name, one in given.items()},
            counts={name: len(one.names) for name, one in invariants.items() if one.names},
        )
        motion = Motion(functions, start)
        mass = motion.mass(start)
        if len(start.v) and abs(mass - mass.T).max() > _SYMMETRIC * abs(mass).max():
            raise ValueError(f"mass must be symmetric, and is not at t = {start.t}")
        self._require_linear(motion, start)
        return motion

    def _require_linear(self, motion: Motion, start: MotionPoint) -> None:
        if not motion.m_psi:
            return
        v = np.where(start.v != 0, start.v, 1.0)
        w = np.roll(v, 1) + v
        at_v, at_w, between = (motion.rates(start._replace(v=part))[motion.m_phi :] for part in (v, w, 3 * v - 2 * w))
        terms = np.abs(at_v) + np.abs(at_w) + np.abs(between)
        off = np.abs(between - (3 * at_v - 2 * at_w)) > _LINEAR * terms
        if off.any():
            raise ValueError(
                f"velocity constraint {np.flatnonzero(off)[0] + 1} is not linear in v: only constraints that are "
                "linear in v have forces of the form Aᵀ λ. A constraint of positions belongs to constraints, a "
                "conserved quantity to invariants"
            )

    def _names(self, motion: Motion) -> list[str]:
        given: list[list[str] | None] = [
            one.names if isinstance(one, Invariants) else None for one in (self.constraints, self.velocity_constraints)
        ]
        holonomic = given[0] or [f"constraint {i + 1}" for i in range(motion.m_phi)]
        return holonomic + (given[1] or [f"velocity constraint {i + 1}" for i in range(motion.m_psi)])

    def _labels(self, motion: Motion) -> list[str]:
        if self.labels is not None:
            if len(self.labels) != motion.n_q + motion.n_v:
                raise ValueError(
                    f"labels must name the {motion.n_q} components of q and then the {motion.n_v} of v, got "
                    f"{shown(self.labels)}"
                )
            return self.labels
        positions = [f"q{i + 1}" for i in range(motion.n_q)]
        return positions + [f"v{i + 1}" for i in range(motion.n_v)]

    def _look_for_redundancy(self, motion: Motion, known: MotionPoint, names: list[str]) -> None:
        """Leave out constraints that depend on others beside the start: not those of a singular position."""
        if not motion.m:
            return
        beside = nearby_state(motion, known, names)
        here, there = motion.rows(known), motion.rows(beside)
        nowhere = vanishing(here) & vanishing(there)
        if nowhere.any():
            i = int(np.flatnonzero(nowhere)[0])
            raise ValueError(
                f"{names[i]} does not depend on {'q' if i < motion.m_phi else 'v'}: it cannot be imposed. Remove "
                "it, or correct its formula"
            )
        redundant = redundant_rows(here, there)
        if redundant.any():
            listed = ", ".join(compress(names, redundant))
            warn(
                f"redundant constraints are left out: {listed}. The motion is the same; the multipliers reported are "
                "those of least norm"
            )
        motion.kept, motion.names = ~redundant, names
        motion.choose_factors([known, beside])

    def _components(self, motion: Motion, fixed: Sequence[str]) -> list[int]:
        """Return the places in (q, v) of components by their labels."""
        labels, wanted = self._labels(motion), [fixed] if isinstance(fixed, str) else [*fixed]
        if unknown := [one for one in wanted if one not in labels]:
            raise ValueError(
                f"fixed: there is no component {shown(unknown[0])}{meant(str(unknown[0]), labels)}: there are "
                f"{', '.join(labels)}"
            )
        return [labels.index(one) for one in wanted]

    def _tell_move(self, motion: Motion, start: MotionPoint, known: MotionPoint) -> None:
        roundoff = _SYMMETRIC * max(np.abs(start.x).max(initial=0.0), np.finfo(float).tiny)
        moves = [
            f"{name} from {old:.6g} to {new:.6g}"
            for name, old, new in zip(self._labels(motion), start.x, known.x, strict=True)
            if abs(new - old) > roundoff
        ]
        if moves:
            warn(f"the start was moved onto the constraints: {first_few(moves)}")

    def _require_consistent(self, motion: Motion, start: MotionPoint, names: list[str]) -> None:
        t, v = start.t, start.v
        held, rows = motion.positions(start), motion.positions_jacobian(start)
        parts = [("", held, abs(rows) @ np.abs(start.q), names)]
        rates = motion.rates(start)
        parts.append(("the rate of ", rates, abs(motion.rows(start)) @ np.abs(v), names))
        for prefix, residual, terms, of in parts:
            off = np.abs(residual) > _INCONSISTENT * np.maximum(terms, 1.0)
            if off.any():
                i = int(np.flatnonzero(off)[0])
                raise InvariantError(
                    f"q0, v0 do not satisfy the constraints: {prefix}{of[i]} is {residual[i]:.6g} at t = {t}. Correct "
                    'them, or let consistent="project" move them'
                )

    # ------------------------------------------------------------------------------------------------------------------
    # What the motion keeps

    def _laws(self, motion: Motion, names: list[str], *, in_levels: bool) -> list[Invariants]:
        n, size = motion.n_q, motion.n_q + motion.n_v
        mass = motion.metric()
        first = {"level": 0, "moves": range(n), "metric": None if motion.has_map else mass}
        second = {"level": 1, "moves": range(n, size), "metric": mass}
        if not in_levels:
            first, second = {}, {}
        holonomic = [*compress(names[: motion.m_phi], motion.kept)]
        others = [*compress(names[motion.m_phi :], motion.kept[motion.m_phi :])]
        laws = []
        if holonomic:
            laws.append(_law(motion, "positions", holonomic, first))
            laws.append(_law(motion, "rates", [f"rate of {name}" for name in holonomic], second))
        if others:
            laws.append(_law(motion, "velocities", others, second))
        if self.energy is not None:
            energy = FunctionOfState(self.energy, motion.n_q, motion.n_v, "energy")
            laws.append(Invariants(energy, names="energy", level=2 if in_levels else 0))
        for one in self.invariants:
            if in_levels and one.level == 0:
                one = copy.copy(one)
                one.level = 2
            laws.append(one)
        return laws


def _law(motion: Motion, part: str, names: list[str], order: dict[str, Any]) -> Invariants:
    """Return a set of invariants of the motion, prescribed to be 0, with its Jacobian."""
    fun, jacobian = MotionFunction(motion, part), MotionFunction(motion, f"{part}_jacobian")
    return Invariants(fun, jacobian, value=0, names=names, **order)
