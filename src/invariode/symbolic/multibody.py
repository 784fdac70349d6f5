"""Equations of motion that SymPy's own mechanics has derived."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import sympy
from sympy.physics.mechanics import KanesMethod, LagrangesMethod

from .code import System
from .systems import Equations, Law, given_laws, label
from .vocabulary import Vocabulary

__all__ = ["from_mechanics"]


def from_mechanics(
    method: Any,
    *,
    invariants: Iterable[Any] | Mapping[str, Any] = (),
    parameters: Mapping[Any, Any] | None = None,
) -> Equations:
    """A system whose equations of motion SymPy has formed, by Kane's method or by Lagrange's.

    Parameters
    ----------
    method : sympy.physics.mechanics.KanesMethod or LagrangesMethod
        After ``kanes_equations`` or ``form_lagranges_equations``.
    invariants : sequence of sympy.Expr or sympy.Eq, or dict of names and these, optional
        What the solution keeps, as for `equations`: configuration constraints ``Eq(a, b)``, the energy.
    parameters : dict, optional
        Other symbols and their values, which become `args` of the problem.

    Returns
    -------
    Equations
        A `SymbolicSystem`, with ``problem(t_span, y0)``; y = (q, u), or (q, q') by Lagrange's method.

    Raises
    ------
    TypeError, ValueError
        `method` is of another class, or has not formed its equations; a formula has a symbol without meaning.

    Notes
    -----
    Each evaluation of f solves the linear system of mass matrix and forces: no formula is solved for accelerations. Of
    Lagrange's method the velocity constraints are held without being asked for. Kane's method does not tell which it
    was given: list its constraints, and configuration constraints in any case, in `invariants`.

    Examples
    --------
    >>> import sympy
    >>> from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
    >>> from invariode import symbolic
    >>> x, y = dynamicsymbols("x y")
    >>> method = LagrangesMethod((x.diff()**2 + y.diff()**2) / 2 - y, [x, y], hol_coneqs=[x**2 + y**2 - 1])
    >>> _ = method.form_lagranges_equations()
    >>> pendulum = symbolic.from_mechanics(method, invariants={"rod": sympy.Eq(x**2 + y**2, 1)})
    >>> sol = pendulum.problem((0, 10), [1, 0, 0, 0], compiled=False).solve(rtol=1e-6)
    >>> bool(abs(sol.residual).max() < 1e-9)
    True
    """
    if not isinstance(method, (KanesMethod, LagrangesMethod)):
        raise TypeError(f"method must be a KanesMethod or a LagrangesMethod, got {method!r}")
    q, u = list(method.q), list(method.u)
    words = Vocabulary([*q, *u], parameters)
    mass, force = _solved(method, len(q))
    coded = [words.coded("the mass matrix", e) for e in mass]
    right = [words.coded("the forces", e) for e in force]
    if isinstance(method, KanesMethod):
        rates = method.kindiffdict()
        explicit = [words.coded(f"the derivative of {one}", rates[one.diff(words.time)]) for one in q]
        held = []
    else:
        explicit = words.y[len(q) :]
        held = [words.coded("a constraint", one) for one in (method.coneqs if method.coneqs else [])]
    laws = [Law(f"velocity constraint {i + 1}", one, 0.0, False) for i, one in enumerate(held)]
    system = System(words.y, explicit, sympy.Matrix(len(right), len(right), coded), right)
    shown = [(sympy.Symbol(f"{label(one)}'"), words.shown(e)) for one, e in zip(q, explicit, strict=True)]
    return Equations(words, system, [*laws, *given_laws(words, invariants)], shown)


def _solved(method: Any, n: int) -> tuple[list[Any], list[Any]]:
    """The matrix, row by row, and the right-hand side of the equations for u' and for multipliers."""
    try:
        if isinstance(method, KanesMethod):
            return list(method.mass_matrix), list(method.forcing)
        return list(method.mass_matrix_full[n:, n:]), list(method.forcing_full[n:, 0])
    except ValueError as error:
        raise ValueError(f"{error}: call its kanes_equations or form_lagranges_equations before") from None
