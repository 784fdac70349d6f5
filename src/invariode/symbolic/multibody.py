"""Equations of motion derived by SymPy's own mechanics."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import sympy
from sympy.physics.mechanics import KanesMethod, LagrangesMethod

from .._base.arguments import choice, interval, warn
from .._base.failures import InvariantError
from .._base.types import Span
from .._laws.imposing import impose
from .._problem.problem import Problem
from .code import System
from .energy import energy
from .mechanics import Form
from .mechanism import Consistent, Correction, Mechanism
from .noether import vanishes
from .systems import LAWS, POSITIONS, VELOCITIES, Law, Mechanical, constrained, given_laws, label
from .vocabulary import Vocabulary


class Multibody(Mechanical):
    """Equations of motion of SymPy's mechanics: y = (q, u), or (q, q') by Lagrange's method."""

    def __init__(self, *arguments: Any, start: SpecifiedStart | None = None) -> None:
        super().__init__(*arguments)
        self._given = start

    @property
    def _positions(self) -> int:
        return len(self._system.explicit)

    def problem(
        self,
        t_span: Span | None = None,
        q0: Any = None,
        v0: Any = None,
        *,
        laws: bool = True,
        consistent: Consistent = "check",
        correction: Correction = "levels",
        compiled: bool | None = None,
        name: str | None = None,
    ) -> Problem:
        """Return the initial value problem.

        Parameters
        ----------
        t_span : (float, float), optional
            (t0, tf). Default: the first and the last of the `times` of PyDy's system.
        q0 : dict or array_like, optional
            Initial coordinates, by symbol or in their order; without `v0` those and the speeds, in the order of
            `states`. Default: the initial conditions of PyDy's system.
        v0 : dict or array_like, optional
            Initial speeds u, or by Lagrange's method velocities, by symbol or in their order.
        laws : bool, default True
            Whether the problem has the laws that were found as invariants, as for
            `invariode.symbolic.mechanics.Lagrangian.problem`.
        consistent : {'check', 'project'}, default 'check'
            What is done with a start that is off the constraints by more than the run's tolerances: an
            `invariode.InvariantError`, or it is moved onto them, with a warning, by the least change in the metric of
            the mass matrix (for Kane's method in the Euclidean one).
        correction, compiled, name
            As for `invariode.symbolic.mechanics.Lagrangian.problem`.

        Raises
        ------
        ValueError, InvariantError
            As for `invariode.MechanicalSystem.problem`. Redundant constraints of Lagrange's method are left out, with
            one warning that names them.
        """
        choice("consistent", consistent, ("check", "project"))
        span = self._span() if t_span is None else t_span
        start = self._start_of(q0, v0)
        if self._mechanism is None and consistent == "project":
            start = self._on_constraints(interval(span)[0], start)
        return self._problem(
            span, start, laws=laws, compiled=compiled, name=name, consistent=consistent, correction=correction
        )

    def _span(self) -> Span:
        if self._given is None or self._given.times is None:
            raise TypeError("problem needs t_span, the pair (t0, tf): only a system of PyDy's with times has one")
        return self._given.times

    def _start_of(self, q0: Any, v0: Any) -> list[float]:
        if v0 is not None:
            return self._start(q0, v0)
        if q0 is None and self._given is not None:
            q0 = self._given.y0
        if q0 is None:
            raise TypeError(f"problem needs q0 and v0, the initial values of {', '.join(map(str, self.states))}")
        return self._words.start("q0", q0, self.states)

    def _on_constraints(self, t: float, start: list[float]) -> list[float]:
        """Return the nearest start that satisfies the constraints, positions first."""
        made = self._functions(False, frozenset()).functions
        held = [law for law in self._laws if law.level < LAWS]
        if not held:
            return start
        kept = self._invariants(made, t, start, held, "levels")
        found = impose(kept, t, start, args=self._words.args, rtol=1.0, atol=max(1.0, *map(abs, start)))
        if not found.converged:
            raise InvariantError(
                f"no state near y0 satisfies the constraints at t = {t}: {held[0].name} and others are "
                f"{found.residual} at the best one found. Start from a y0 nearer to a solution"
            )
        if (moved := np.abs(found.y - start)).max() > 0:
            warn(f"the start was moved onto the constraints: components of y0 by up to {moved.max():.3g}")
        return [float(one) for one in found.y]


class SpecifiedStart(NamedTuple):
    """The initial values that a PyDy system specifies."""

    y0: Mapping[Any, Any]
    times: tuple[float, float] | None


def from_mechanics(
    method: Any,
    *,
    invariants: Iterable[Any] | Mapping[str, Any] = (),
    parameters: Mapping[Any, Any] | None = None,
    points: Sequence[Any] | None = None,
) -> Multibody:
    """Return a system whose equations of motion SymPy has formed by Kane's or Lagrange's method.

    Parameters
    ----------
    method : sympy.physics.mechanics.KanesMethod or LagrangesMethod
        After ``kanes_equations`` or ``form_lagranges_equations``.
    invariants : sequence of sympy.Expr or sympy.Eq, or dict of names and these, optional
        What the solution keeps, as for `equations`: laws that are not found, or configuration constraints
        ``Eq(a, b)`` that the method does not know.
    parameters : dict, optional
        Other symbols and their values, which become `args` of the problem.
    points
        As for `equations`.

    Returns
    -------
    Multibody
        A `SymbolicSystem`, with ``problem(t_span, q0, v0)``, and for Lagrange's method with ``multipliers(sol)``;
        y = (q, u), or (q, q') by Lagrange's method.

    Raises
    ------
    TypeError, ValueError
        `method` is of another class, or has not formed its equations; a formula has an unknown symbol.

    Notes
    -----
    Each evaluation of f solves the linear system of mass matrix and forces: no formula is solved for accelerations. The
    method's own constraints, on configurations and velocities, are imposed by default. Laws are found as by
    `lagrangian`; for Kane's method the energy, if nothing moves in a prescribed way and SymPy finds the potential of
    the loads.

    Examples
    --------
    >>> import sympy
    >>> from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
    >>> from invariode import symbolic
    >>> x, y = dynamicsymbols("x y")
    >>> method = LagrangesMethod((x.diff()**2 + y.diff()**2) / 2 - y, [x, y], hol_coneqs=[x**2 + y**2 - 1])
    >>> _ = method.form_lagranges_equations()
    >>> pendulum = symbolic.from_mechanics(method)
    >>> list(pendulum.laws)
    ['constraint 1', 'rate of constraint 1', 'energy']
    >>> sol = pendulum.problem((0, 10), [1, 0], [0, 0], compiled=False).solve(rtol=1e-6)
    >>> bool(abs(sol.residual).max() < 1e-13)
    True
    """
    return _multibody(method, invariants, parameters, points, {}, None)


def from_pydy(
    system: Any,
    *,
    specifieds: Mapping[Any, Any] | None = None,
    invariants: Iterable[Any] | Mapping[str, Any] = (),
    parameters: Mapping[Any, Any] | None = None,
    points: Sequence[Any] | None = None,
) -> Multibody:
    """Return a system of PyDy's, with its constants, specified quantities, initial conditions and times.

    Parameters
    ----------
    system : pydy.system.System
        What it has no values for is 1 (constants) or 0 (specified quantities, initial conditions), as in PyDy.
    specifieds : dict, optional
        Numbers or SymPy expressions of the time and the states for specified quantities, in place of the system's. They
        are needed where it has functions, which cannot be differentiated.
    invariants, points
        As for `from_mechanics`.
    parameters : dict, optional
        In place of the system's constants of the same symbols.

    Returns
    -------
    Multibody
        As for `from_mechanics`; in ``problem()`` all arguments may be left out if the system has `times`.

    Raises
    ------
    TypeError, ValueError
        It is no such system; a specified quantity is a function; as for `from_mechanics`.

    Examples
    --------
    >>> from pydy.system import System  # doctest: +SKIP
    >>> system = System(kane, constants={g: 9.81}, initial_conditions={q: 0.1}, times=[0, 10])  # doctest: +SKIP
    >>> symbolic.from_pydy(system).problem().solve("dop853", rtol=1e-8).success  # doctest: +SKIP
    True
    """
    try:
        states, known = list(system.states), system.constants_symbols
        constants = {**dict.fromkeys(sorted(known, key=str), 1.0), **system.constants, **(parameters or {})}
        specified = {**dict.fromkeys(system.specifieds_symbols, 0.0), **_each(system.specifieds)}
        y0 = {**dict.fromkeys(states, 0.0), **system.initial_conditions}
        times = None if system.times is None or not len(system.times) else (system.times[0], system.times[-1])
        method = system.eom_method
    except AttributeError as missing:
        raise TypeError(f"from_pydy takes a pydy.system.System: {missing}. For a method give from_mechanics") from None
    specified |= specifieds or {}
    for one, value in specified.items():
        if callable(value) and not isinstance(value, sympy.Basic):
            raise TypeError(f"{one} is specified by a function: give specifieds={{{one}: a SymPy expression}}")
    return _multibody(method, invariants, constants, points, specified, SpecifiedStart(y0, times))


def _each(specifieds: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return specified quantities and their values, one by one: PyDy also takes several with one array or function."""
    if {"symbols", "values"} <= specifieds.keys():
        specifieds = {tuple(specifieds["symbols"]): specifieds["values"]}
    values: dict[Any, Any] = {}
    for symbols, value in specifieds.items():
        several = symbols if isinstance(symbols, tuple) else (symbols,)
        each = [value] * len(several) if callable(value) else np.broadcast_to(value, len(several)).tolist()
        values |= dict(zip(several, each, strict=True))
    return values


def _multibody(
    method: Any,
    invariants: Iterable[Any] | Mapping[str, Any],
    parameters: Mapping[Any, Any] | None,
    points: Sequence[Any] | None,
    specified: Mapping[Any, Any],
    start: SpecifiedStart | None,
) -> Multibody:
    if not isinstance(method, (KanesMethod, LagrangesMethod)):
        raise TypeError(
            f"method must be a KanesMethod or a LagrangesMethod, got {method!r}; from_pydy takes PyDy's System"
        )
    q, u = list(method.q), list(method.u)
    words = Vocabulary([*q, *u], parameters, specified)
    given = [_at_its_level(words, law, len(q)) for law in given_laws(words, invariants)]
    named = {law.name for law in given}
    made = (_by_kane if isinstance(method, KanesMethod) else _by_lagrange)(method, words, len(q), named)
    laws, renamed = _without_duplicates(words, made.laws, given)
    mechanism = made.mechanism
    if mechanism is not None:
        mechanism = mechanism._replace(names=[renamed.get(name, name) for name in mechanism.names])
    shown = [(sympy.Symbol(f"{label(one)}'"), words.shown(e)) for one, e in zip(q, made.system.explicit, strict=True)]
    return Multibody(words, made.system, laws, shown, points, mechanism, start=start)


class _Made(NamedTuple):
    system: System
    laws: list[Law]
    mechanism: Mechanism | None


def _formed(method: Any, *names: str) -> list[Any]:
    try:
        return [getattr(method, name) for name in names]
    except ValueError as error:
        raise ValueError(f"{error}: call its kanes_equations or form_lagranges_equations first") from None


def _by_kane(method: Any, words: Vocabulary, n: int, named: Container[str]) -> _Made:
    """Take the equations of Kane's method. `named`: invariants that need not be found."""
    mass, force = _formed(method, "mass_matrix", "forcing")
    rates = method.kindiffdict()
    explicit = [words.coded(f"the derivative of {one}", rates[one.diff(words.time)]) for one in list(method.q)]
    right = [words.coded("the forces", e) for e in force]
    matrix = sympy.Matrix(len(right), len(right), [words.coded("the mass matrix", e) for e in mass])
    held = [words.coded("a constraint", e) for e in method._f_h or []]
    rolled = []
    if method._k_nh:
        rolled = [words.coded("a velocity constraint", e) for e in method._k_nh * method.u + method._f_nh]
    laws = [Law(f"constraint {i + 1}", one, 0.0, False, POSITIONS) for i, one in enumerate(held)]
    laws += [Law(f"velocity constraint {i + 1}", one, 0.0, False, VELOCITIES) for i, one in enumerate(rolled)]
    system = System(words.y, explicit, matrix, right)
    if "energy" not in named and (found := energy(method, words, system, held, rolled)) is not None:
        laws.append(Law("energy", found, None, proposed=True))
    return _Made(system, laws, None)


def _by_lagrange(method: Any, words: Vocabulary, n: int, named: Container[str]) -> _Made:
    full, right_side = _formed(method, "mass_matrix_full", "forcing_full")
    right = [words.coded("the forces", e) for e in right_side[n:, 0]]
    matrix = sympy.Matrix(len(right), len(right), [words.coded("the mass matrix", e) for e in full[n:, n:]])
    system = System(words.y, words.y[n:], matrix, right)
    held = [words.coded("a constraint", one) for one in method._hol_coneqs or []]
    rates = [words.coded("a constraint", one) for one in method.coneqs or []]
    m = len(held)
    laws, mechanism = constrained(words, held, rates[:m], rates[m:], matrix[:n, :n], right[:n])
    form = Form(words, n, words.coded("L", method._L[0]))
    form.forces = [total - own for total, own in zip(right, form.own_forces(), strict=False)]
    laws += [law for law in form.laws(held, rates[m:]) if law.name not in named]
    return _Made(system, laws, mechanism)


def _at_its_level(words: Vocabulary, law: Law, n: int) -> Law:
    """Return the invariant at its level: a prescribed function of positions, or one linear in velocities, is a
    constraint."""
    if law.value is None:
        return law
    slopes = [law.formula.diff(one) for one in words.y[n:]]
    if not any(slopes):
        return law._replace(level=POSITIONS)
    linear = not any(slope.free_symbols & set(words.y[n:]) for slope in slopes)
    return law._replace(level=VELOCITIES) if linear else law


def _without_duplicates(words: Vocabulary, own: list[Law], given: list[Law]) -> tuple[list[Law], dict[str, str]]:
    """Return the laws of the method, those under the names that the user gave them who has them too, and the user's
    others. A law that was found gives way to one of the user's that differs by a constant."""
    symbols = [words.t, *words.y, *words.p]
    renamed: dict[str, str] = {}
    others = []
    wanted = [law.formula for law in given if law.value is None]
    own = [one for one in own if not (one.proposed and any(_says_the_same(one.formula, law, words) for law in wanted))]
    for law in given:
        known = law.value is not None and [
            one.name
            for one in own
            if one.level == law.level
            and any(vanishes(sympy.Add(one.formula, sign * law.formula), symbols) for sign in (-1, 1))
        ]
        if known:
            renamed[known[0]] = law.name
        else:
            others.append(law)
    return [*(_renamed(law, renamed) for law in own), *others], renamed


def _says_the_same(law: Any, other: Any, words: Vocabulary) -> bool:
    """Return whether two expressions differ by a constant, or their sum is one."""
    symbols = [words.t, *words.y]
    there = {one: sympy.Rational(i + 2, i + 3) for i, one in enumerate(symbols)}
    both = (law - other, law + other)
    return any(vanishes(one - one.xreplace(there), [*symbols, *words.p]) for one in both)


def _renamed(law: Law, names: Mapping[str, str]) -> Law:
    if law.of in names and law.name not in names:
        return law._replace(name=f"rate of {names[law.of]}", of=names[law.of])
    return law._replace(name=names.get(law.name, law.name), of=names.get(law.of, law.of))
