"""Equations of motion derived by SymPy's own mechanics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import sympy
from sympy.physics.mechanics import KanesMethod, LagrangesMethod

from .._base.arguments import choice, interval, warn
from .._base.failures import InvariantError
from .._base.types import Span
from .._laws.imposing import impose
from .._solve.problem import Problem
from .code import System
from .mechanism import Consistent, Correction, Mechanism
from .noether import vanishes
from .systems import LAWS, POSITIONS, VELOCITIES, Law, SymbolicSystem, constrained, given_laws, label
from .vocabulary import Vocabulary


class Multibody(SymbolicSystem):
    """Equations of motion of SymPy's mechanics: y = (q, u), or (q, q') by Lagrange's method."""

    def __init__(self, *arguments: Any, initial: Mapping[Any, Any] | None = None) -> None:
        super().__init__(*arguments)
        self._initial = initial

    def problem(
        self,
        t_span: Span,
        y0: Any = None,
        *,
        consistent: Consistent = "check",
        correction: Correction = "levels",
        compiled: bool | None = None,
        name: str | None = None,
    ) -> Problem:
        """The initial value problem.

        Parameters
        ----------
        t_span : (float, float)
            (t0, tf).
        y0 : dict or array_like
            Initial coordinates and speeds, by symbol or in the order of `states`. Default: the initial conditions of
            PyDy's system.
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
        if y0 is None and self._initial is None:
            raise TypeError(f"problem needs y0, the initial values of {', '.join(map(str, self.states))}")
        start = self._words.start("y0", self._initial if y0 is None else y0, self.states)
        if self._mechanism is None and consistent == "project":
            start = self._on_constraints(interval(t_span)[0], start)
        return self._problem(t_span, start, compiled=compiled, name=name, consistent=consistent, correction=correction)

    def _on_constraints(self, t: float, start: list[float]) -> list[float]:
        """The nearest start that satisfies the constraints, positions first."""
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


def from_mechanics(
    method: Any,
    *,
    invariants: Iterable[Any] | Mapping[str, Any] = (),
    parameters: Mapping[Any, Any] | None = None,
    points: Sequence[Any] | None = None,
) -> Multibody:
    """A system whose equations of motion SymPy has formed by Kane's or Lagrange's method.

    Parameters
    ----------
    method : sympy.physics.mechanics.KanesMethod or LagrangesMethod, or PyDy's System
        After ``kanes_equations`` or ``form_lagranges_equations``. An object such as ``pydy.system.System`` contributes
        its `eom_method`, `constants` and `initial_conditions`.
    invariants : sequence of sympy.Expr or sympy.Eq, or dict of names and these, optional
        What the solution keeps, as for `equations`: the energy, or configuration constraints ``Eq(a, b)`` that the
        method does not know.
    parameters : dict, optional
        Other symbols and their values, which become `args` of the problem; for PyDy's system, in place of its
        constants.
    points
        As for `equations`.

    Returns
    -------
    Multibody
        A `SymbolicSystem`, with ``problem(t_span, y0)``; y = (q, u), or (q, q') by Lagrange's method. For PyDy's system
        y0 may be left out.

    Raises
    ------
    TypeError, ValueError
        `method` is of another class, or has not formed its equations; a formula has an unknown symbol.

    Notes
    -----
    Each evaluation of f solves the linear system of mass matrix and forces: no formula is solved for accelerations. The
    method's own constraints, on configurations and velocities, are imposed by default.

    Examples
    --------
    >>> import sympy
    >>> from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
    >>> from invariode import symbolic
    >>> x, y = dynamicsymbols("x y")
    >>> method = LagrangesMethod((x.diff()**2 + y.diff()**2) / 2 - y, [x, y], hol_coneqs=[x**2 + y**2 - 1])
    >>> _ = method.form_lagranges_equations()
    >>> pendulum = symbolic.from_mechanics(method)
    >>> sol = pendulum.problem((0, 10), [1, 0, 0, 0], compiled=False).solve(rtol=1e-6)
    >>> bool(abs(sol.residual).max() < 1e-13)
    True
    """
    method, parameters, initial = _taken(method, parameters)
    q, u = list(method.q), list(method.u)
    words = Vocabulary([*q, *u], parameters)
    made = (_by_kane if isinstance(method, KanesMethod) else _by_lagrange)(method, words, len(q))
    given = [_at_its_level(words, law, len(q)) for law in given_laws(words, invariants)]
    laws, renamed = _without_duplicates(words, made.laws, given)
    mechanism = made.mechanism
    if mechanism is not None:
        mechanism = mechanism._replace(names=[renamed.get(name, name) for name in mechanism.names])
    shown = [(sympy.Symbol(f"{label(one)}'"), words.shown(e)) for one, e in zip(q, made.system.explicit, strict=True)]
    return Multibody(words, made.system, laws, shown, points, mechanism, initial=initial)


class _Made(NamedTuple):
    system: System
    laws: list[Law]
    mechanism: Mechanism | None


def _taken(
    method: Any, parameters: Mapping[Any, Any] | None
) -> tuple[Any, Mapping[Any, Any] | None, Mapping[Any, Any] | None]:
    """Method, parameters and initial conditions of PyDy's system, or what was given."""
    initial = None
    if all(hasattr(method, one) for one in ("eom_method", "constants", "initial_conditions")):
        parameters = {**dict(method.constants), **(parameters or {})}
        initial, method = dict(method.initial_conditions), method.eom_method
    if not isinstance(method, (KanesMethod, LagrangesMethod)):
        raise TypeError(f"method must be a KanesMethod, a LagrangesMethod or a System of PyDy's, got {method!r}")
    return method, parameters, initial


def _formed(method: Any, *names: str) -> list[Any]:
    try:
        return [getattr(method, name) for name in names]
    except ValueError as error:
        raise ValueError(f"{error}: call its kanes_equations or form_lagranges_equations first") from None


def _by_kane(method: Any, words: Vocabulary, n: int) -> _Made:
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
    return _Made(System(words.y, explicit, matrix, right), laws, None)


def _by_lagrange(method: Any, words: Vocabulary, n: int) -> _Made:
    full, right_side = _formed(method, "mass_matrix_full", "forcing_full")
    right = [words.coded("the forces", e) for e in right_side[n:, 0]]
    matrix = sympy.Matrix(len(right), len(right), [words.coded("the mass matrix", e) for e in full[n:, n:]])
    system = System(words.y, words.y[n:], matrix, right)
    held = [words.coded("a constraint", one) for one in method._hol_coneqs or []]
    rates = [words.coded("a constraint", one) for one in method.coneqs or []]
    m = len(held)
    laws, mechanism = constrained(words, held, rates[:m], rates[m:], matrix[:n, :n], right[:n])
    return _Made(system, laws, mechanism)


def _at_its_level(words: Vocabulary, law: Law, n: int) -> Law:
    """A demand on positions, or one that is linear in velocities, is a constraint."""
    if law.value is None:
        return law
    slopes = [law.formula.diff(one) for one in words.y[n:]]
    if not any(slopes):
        return law._replace(level=POSITIONS)
    linear = not any(slope.free_symbols & set(words.y[n:]) for slope in slopes)
    return law._replace(level=VELOCITIES) if linear else law


def _without_duplicates(words: Vocabulary, own: list[Law], given: list[Law]) -> tuple[list[Law], dict[str, str]]:
    """The laws of the method, those under the names that the user gave them who has them too, and the user's others."""
    symbols = [words.t, *words.y, *words.p]
    renamed: dict[str, str] = {}
    others = []
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


def _renamed(law: Law, names: Mapping[str, str]) -> Law:
    if law.of in names and law.name not in names:
        return law._replace(name=f"rate of {names[law.of]}", of=names[law.of])
    return law._replace(name=names.get(law.name, law.name), of=names.get(law.of, law.of))
