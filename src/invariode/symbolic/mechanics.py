"""Mechanics in symbols: from a Hamiltonian, or a Lagrangian with constraints, to a system with its laws."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from sympy.core.function import AppliedUndef

from .._base.types import Span
from .._problem.problem import Problem
from .code import System, eliminated
from .mechanism import Consistent, Correction
from .noether import symmetries, vanishes
from .systems import Law, Mechanical, Phase, constrained, label
from .vocabulary import Vocabulary

#: Where the rank of a mass matrix is tested: a point without special symmetry.
_SEED = 7


class Hamiltonian(Phase):
    """q' = ∂H/∂p, p' = -∂H/∂q."""

    _second = "p"

    def problem(
        self,
        t_span: Span,
        q0: Any,
        p0: Any,
        *,
        laws: bool = True,
        compiled: bool | None = None,
        name: str | None = None,
    ) -> Problem:
        """Return the initial value problem, with y = (q, p).

        Parameters
        ----------
        t_span : (float, float)
            (t0, tf).
        q0, p0 : dict or array_like
            Initial coordinates and momenta, by symbol or in the order of q and of p.
        laws, compiled, name
            As for `invariode.symbolic.mechanics.Lagrangian.problem`.
        """
        return self._problem(t_span, self._start(q0, p0), laws=laws, compiled=compiled, name=name)


class Lagrangian(Mechanical):
    """d/dt ∂L/∂q' = ∂L/∂q + forces, with constraints."""

    def problem(
        self,
        t_span: Span,
        q0: Any,
        v0: Any,
        *,
        laws: bool = True,
        consistent: Consistent = "check",
        correction: Correction = "levels",
        compiled: bool | None = None,
        name: str | None = None,
    ) -> Problem:
        """Return the initial value problem, with y = (q, v).

        Parameters
        ----------
        t_span : (float, float)
            (t0, tf).
        q0 : dict or array_like
            Initial coordinates, by symbol or in the order of q.
        v0 : dict or array_like
            Initial velocities, by coordinate or by its derivative, or in the order of q.
        laws : bool, default True
            Whether the problem has the laws that were found as invariants: those that `check_invariants` confirms at
            the start, and that do not follow from others there. Constraints are imposed in either case.
        consistent : {'check', 'project'}, default 'check'
            What is done with a start that is off the constraints by more than the run's tolerances: an
            `invariode.InvariantError`, or it is moved onto them, with a warning, as
            `invariode.MechanicalSystem.problem` does.
        correction : {'levels', 'joint', 'none'}, default 'levels'
            How the solution is put back onto the constraints after each step: first positions, then velocities, then
            both onto the laws, without leaving the constraints; all together, as in the paper; or not at all, and no
            laws either. Without constraints the laws are imposed together.
        compiled : bool, optional
            Whether the functions become machine code. Default: if llvmlite, of the extra `compiled`, is installed.
        name : str, optional
            For tables and plots.

        Raises
        ------
        ValueError, InvariantError
            As for `invariode.MechanicalSystem.problem`, if there are constraints. Redundant ones are left out, with one
            warning that names them.
        """
        start = self._start(q0, v0)
        return self._problem(
            t_span, start, laws=laws, compiled=compiled, name=name, consistent=consistent, correction=correction
        )


def hamiltonian(
    H: Any,
    q: Sequence[Any],
    p: Sequence[Any],
    *,
    parameters: Mapping[Any, Any] | None = None,
    points: Sequence[Any] | None = None,
) -> Hamiltonian:
    """Return a Hamiltonian system.

    Parameters
    ----------
    H : sympy.Expr
        The Hamiltonian H(q, p, t).
    q, p : sequence of symbols, or of functions of time
        Coordinates and their momenta.
    parameters, points
        As for `equations`.

    Returns
    -------
    Hamiltonian
        A `SymbolicSystem`, with ``problem(t_span, q0, p0)``.

    Raises
    ------
    TypeError, ValueError
        q and p differ in number; H has an unknown symbol; a symbol has two meanings.

    Notes
    -----
    Laws are found if they hold for all values of the parameters: H itself if it does not contain the time, and a
    momentum for each affine motion of the coordinates that leaves H unchanged, such as a translation or rotation.

    Examples
    --------
    >>> import sympy
    >>> from invariode import symbolic
    >>> x, y, px, py, mu = sympy.symbols("x y p_x p_y mu")
    >>> H = (px**2 + py**2) / 2 - mu / sympy.sqrt(x**2 + y**2)
    >>> kepler = symbolic.hamiltonian(H, [x, y], [px, py], parameters={mu: 1})
    >>> kepler.laws["angular momentum of x, y"]
    -p_x*y + p_y*x
    >>> sol = kepler.problem((0, 20), [1, 0], [0, 1.1], compiled=False).solve(rtol=1e-6)
    >>> bool(abs(sol.residual).max() < 1e-9)
    True
    """
    q, p = _sequence("q", q), _sequence("p", p)
    if len(q) != len(p):
        raise ValueError(f"each coordinate has one momentum, got {len(q)} q and {len(p)} p")
    words = Vocabulary([*q, *p], parameters)
    n = len(q)
    energy = words.coded("H", H)
    x, momenta = words.y[:n], words.y[n:]
    by_q, by_p = [energy.diff(one) for one in x], [energy.diff(one) for one in momenta]

    def change(field: Sequence[Any]) -> list[Any]:
        turned = [sum(r * e.diff(one) for r, e in zip(momenta, field, strict=True)) for one in x]
        return [_dot(by_q, field) - _dot(by_p, turned)]

    laws = [Law("energy", energy, None, True)] if words.t not in energy.free_symbols else []
    laws += _momenta(words, x, momenta, change)
    system = System(words.y, [*by_p, *(-one for one in by_q)], None, [])
    shown = [(sympy.Symbol("H"), words.shown(energy))]
    return Hamiltonian(words, system, laws, shown, points)


def lagrangian(
    L: Any,
    q: Sequence[Any],
    *,
    constraints: Iterable[Any] = (),
    nonholonomic: Iterable[Any] = (),
    forces: Mapping[Any, Any] | Sequence[Any] | None = None,
    parameters: Mapping[Any, Any] | None = None,
    points: Sequence[Any] | None = None,
) -> Lagrangian:
    """Return a Lagrangian system, with constraints and nonconservative forces.

    Parameters
    ----------
    L : sympy.Expr
        The Lagrangian L(q, q', t), kinetic minus potential energy.
    q : sequence of functions of time
        The coordinates, as ``sympy.physics.mechanics.dynamicsymbols`` makes them; their derivatives are the velocities.
    constraints : sequence of sympy.Expr or sympy.Eq, optional
        Holonomic constraints φ(q, t), which are 0, or equations.
    nonholonomic : sequence of sympy.Expr or sympy.Eq, optional
        Constraints ψ(q, q', t) that are linear in the velocities.
    forces : dict or sequence of sympy.Expr, optional
        Generalised forces, by coordinate or in the order of q. Default: none.
    parameters, points
        As for `equations`.

    Returns
    -------
    Lagrangian
        A `SymbolicSystem`, with ``problem(t_span, q0, v0)`` and ``multipliers(sol)``.

    Raises
    ------
    TypeError, ValueError
        q are not functions of time; a formula has an unknown symbol; the mass matrix is singular without constraints; a
        velocity constraint is not linear in the velocities.

    Notes
    -----
    Each evaluation of f solves M(q) v' = Q + Φᵀ λ together with the second derivatives of the constraints, all exact.
    The constraints and their rates are invariants of value 0. Laws are found if they hold for all values of the
    parameters: the energy, and a momentum for each affine motion of the coordinates that leaves the Lagrangian and the
    constraints unchanged, such as a translation or rotation.

    Examples
    --------
    >>> import sympy
    >>> from sympy.physics.mechanics import dynamicsymbols
    >>> from invariode import symbolic
    >>> x, y = dynamicsymbols("x y")
    >>> L = (x.diff()**2 + y.diff()**2) / 2 - y
    >>> pendulum = symbolic.lagrangian(L, [x, y], constraints=[sympy.Eq(x**2 + y**2, 1)])
    >>> sol = pendulum.problem((0, 10), [1, 0], [0, 0], compiled=False).solve(rtol=1e-6)
    >>> bool(abs(sol.y[0]**2 + sol.y[1]**2 - 1).max() < 1e-9)
    True
    """
    q = _sequence("q", q)
    for one in q:
        if not isinstance(one, AppliedUndef) or len(one.args) != 1:
            raise TypeError(f"q must be functions of time, got {one!r}: make them with dynamicsymbols")
    words = Vocabulary([*q, *(one.diff(one.args[0]) for one in q)], parameters)
    n = len(q)
    form = Form(words, n, words.coded("L", L), _forces(words, q, forces))
    held = [words.coded(f"constraint {i + 1}", _zero(one)) for i, one in enumerate(constraints)]
    rolled = [words.coded(f"velocity constraint {i + 1}", _zero(one)) for i, one in enumerate(nonholonomic)]
    _require_constraints(form, held, rolled)
    rates = [form.rate(one) for one in held]
    system = form.system([*rates, *rolled])
    laws, mechanism = constrained(words, held, rates, rolled, system.mass[:n, :n], system.force[:n])
    if mechanism is None:
        _require_regular(words, system)
        system = eliminated(system)
    laws += form.laws(held, rolled)
    shown = [(sympy.Symbol("L"), words.shown(form.lagrangian))]
    shown += [(sympy.Integer(0), words.shown(one)) for one in [*held, *rolled]]
    return Lagrangian(words, system, laws, shown, points, mechanism)


class Form:
    """A Lagrangian in the symbols of the code, and what follows from it."""

    def __init__(self, words: Vocabulary, n: int, L: Any, forces: Sequence[Any] = ()) -> None:
        self.words, self.lagrangian, self.forces = words, L, list(forces)
        self.q, self.v = words.y[:n], words.y[n:]
        self.by_q, self.p = [L.diff(one) for one in self.q], [L.diff(one) for one in self.v]

    def rate(self, one: Any) -> Any:
        """Return d/dt of a function of t and q along the motion."""
        return one.diff(self.words.t) + _dot([one.diff(x) for x in self.q], self.v)

    def system(self, velocity_constraints: list[Any]) -> System:
        """Return the equations for v', bordered by those of the multipliers."""
        mass = sympy.Matrix([[p.diff(one) for one in self.v] for p in self.p])
        force = [own + other for own, other in zip(self.own_forces(), self.forces, strict=True)]
        rows = sympy.Matrix([[one.diff(x) for x in self.v] for one in velocity_constraints])
        if velocity_constraints:
            m = len(velocity_constraints)
            mass = sympy.Matrix([[mass, -rows.T], [rows, sympy.zeros(m, m)]])
            force += [-self.rate(one) for one in velocity_constraints]
        return System(self.words.y, self.v, mass, force)

    def own_forces(self) -> list[Any]:
        """Return ∂L/∂q - d/dt ∂L/∂v without its part in v'."""
        return [by_q - self.rate(p) for by_q, p in zip(self.by_q, self.p, strict=True)]

    def laws(self, held: list[Any], rolled: list[Any]) -> list[Law]:
        """Return energy and momenta that hold whatever the parameters are."""
        work = _dot(self.forces, self.v) - self.lagrangian.diff(self.words.t)
        steady = [one.diff(self.words.t) for one in held]  # constraints that move do work, and so do
        steady += [one - _dot([one.diff(x) for x in self.v], self.v) for one in rolled]  # ψ with a part without v
        laws = []
        symbols = self._symbols()
        if all(vanishes(one, symbols) for one in [work, *steady]):
            laws.append(Law("energy", _dot(self.p, self.v) - self.lagrangian, None, True))

        def change(field: Sequence[Any]) -> list[Any]:
            turned = [self.rate(one) for one in field]
            own = _dot(self.by_q, field) + _dot(self.p, turned) + _dot(self.forces, field)
            return [
                own,
                *(_dot([one.diff(x) for x in self.q], field) for one in held),
                *(_dot([one.diff(x) for x in self.v], field) for one in rolled),
            ]

        return [*laws, *_momenta(self.words, self.q, self.p, change)]

    def _symbols(self) -> list[Any]:
        return [self.words.t, *self.words.y, *self.words.p]


def _momenta(
    words: Vocabulary, q: Sequence[Any], p: Sequence[Any], change: Callable[[Sequence[Any]], list[Any]]
) -> list[Law]:
    """Return the momentum p · ξ of each field ξ under which nothing changes."""
    laws = []
    for field in symmetries(q, change, [words.t, *words.y, *words.p]):
        moved = [one for one, e in zip(q, field, strict=True) if e != 0]
        listed = ", ".join(label(words.shown(one)) for one in moved)
        straight = all(not e.free_symbols for e in field)
        laws.append(Law(f"{'' if straight else 'angular '}momentum of {listed}", _dot(p, field), None, True))
    return laws


def _dot(a: Iterable[Any], b: Iterable[Any]) -> Any:
    return sympy.Add(*(x * y for x, y in zip(a, b, strict=True)))


def _sequence(name: str, values: Any) -> list[Any]:
    if isinstance(values, (sympy.Expr, str)) or not np.iterable(values):
        raise TypeError(f"{name} must be a list of symbols, got {values!r}: write [{values}]")
    listed = list(values)
    if not listed:
        raise ValueError(f"{name} is empty: a system has at least one coordinate")
    return listed


def _zero(one: Any) -> Any:
    return one.lhs - one.rhs if isinstance(one, sympy.Equality) else one


def _forces(words: Vocabulary, q: list[Any], forces: Mapping[Any, Any] | Sequence[Any] | None) -> list[Any]:
    """Return the force of each coordinate."""
    if forces is None:
        return [sympy.S.Zero] * len(q)
    if isinstance(forces, Mapping):
        for one in forces:
            if one not in q:
                raise ValueError(f"forces has {one}, which is not one of {', '.join(map(str, q))}")
        forces = [forces.get(one, 0) for one in q]
    if len(forces) != len(q):
        raise ValueError(f"forces must have {len(q)} entries, one for each of q, got {len(forces)}")
    return [words.coded(f"the force on {one}", force) for one, force in zip(q, forces, strict=True)]


def _require_constraints(form: Form, held: list[Any], rolled: list[Any]) -> None:
    velocities = set(form.v)
    for i, one in enumerate(held):
        if one.free_symbols & velocities:
            raise ValueError(f"constraint {i + 1} depends on velocities: list it in nonholonomic")
        if not one.free_symbols & set(form.q):
            raise ValueError(f"constraint {i + 1} does not depend on q: leave it out, or correct it")
    for i, one in enumerate(rolled):
        slopes = [one.diff(x) for x in form.v]
        if not any(slopes):
            raise ValueError(f"velocity constraint {i + 1} does not depend on velocities: list it in constraints")
        if any(slope.free_symbols & velocities for slope in slopes):
            raise ValueError(
                f"velocity constraint {i + 1} is not linear in the velocities: only those have multipliers"
            )


def _require_regular(words: Vocabulary, system: System) -> None:
    """Check that the accelerations are determined, at a point without symmetry."""
    symbols = [words.t, *words.y, *words.p]
    point = np.random.default_rng(_SEED).uniform(0.2, 1.7, len(symbols))
    with np.errstate(all="ignore"):
        matrix = np.array(sympy.lambdify(symbols, system.mass, modules="numpy", cse=True)(*point), dtype=float)
    if np.isfinite(matrix).all() and np.linalg.matrix_rank(matrix) < len(matrix):
        raise ValueError(
            "the accelerations are not determined: the mass matrix ∂²L/∂v² is singular: L must be quadratic in each "
            "velocity"
        )
