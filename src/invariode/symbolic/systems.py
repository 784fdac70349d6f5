"""Symbolic systems, and the problems made from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import sympy

from .._base.arguments import Array, choice, distinct, extra_arguments, interval
from .._base.types import Points, Span
from .._problem.invariants import Invariants
from .._problem.problem import Problem
from .._results.solution import HasPoints
from .._studies.check import check_invariants
from .code import Code, System, functions
from .mechanism import Consistent, Correction, Mechanism
from .vocabulary import Vocabulary, parsed

#: Levels of correction: constraints move only positions, their rates and velocity constraints move only
#: velocities, and other laws move what is left.
POSITIONS, VELOCITIES, LAWS = 0, 1, 2

#: Longer formulas are not names.
_NAME = 40


class Law(NamedTuple):
    """An invariant of a system, in the symbols of the code."""

    name: str
    formula: Any
    value: float | None  # None: that at the start
    proposed: bool  # by us: then only if it holds and says something new
    level: int = LAWS
    of: str = ""  # the constraint whose rate it is


class SymbolicSystem(HasPoints):
    """A system of differential equations in symbols, and its laws. Made by `equations`, `lagrangian` and others.

    Attributes
    ----------
    states : list of sympy.Expr
        The components of y.
    parameters : dict
        Symbols and their values, which become `args` of the problem in this order.
    laws : dict of str to sympy.Expr
        What the system keeps: given invariants, constraints, and laws that were found.
    """

    def __init__(
        self,
        words: Vocabulary,
        system: System,
        laws: Sequence[Law],
        shown: Sequence[tuple[Any, Any]],
        points: Sequence[Any] | None = None,
        mechanism: Mechanism | None = None,
    ) -> None:
        self._words, self._system, self._shown = words, system, list(shown)
        names = distinct([law.name for law in laws])
        self._laws = [law._replace(name=name) for law, name in zip(laws, names, strict=True)]
        self._points = None if points is None else _points(words, points)
        self._mechanism = mechanism
        self._made: dict[tuple[bool, frozenset[str]], Code] = {}
        self.states = list(words.states)
        self.parameters = dict(words.parameters)

    @property
    def laws(self) -> dict[str, Any]:
        return {law.name: self._words.shown(law.formula) for law in self._laws}

    def __repr__(self) -> str:
        equations = ", ".join(f"{left} = {right}" for left, right in self._shown)
        return f"{type(self).__name__}({equations})"

    def _repr_latex_(self) -> str:
        rows = r" \\ ".join(f"{sympy.latex(left)} &= {sympy.latex(right)}" for left, right in self._shown)
        return rf"$\displaystyle\begin{{aligned}} {rows} \end{{aligned}}$"

    def _places(self, sol: Any) -> Callable[[float, Array], Any]:
        if self._points is None:
            raise ValueError("the system has no points: make it with points=[(x, y), ...], or use sol.animate")
        words, shape = self._words, (len(self._points), -1)
        flat = [e for row in self._points for e in row]
        code = sympy.lambdify([words.t, words.y, words.p], flat, modules="numpy", cse=True)
        args = self._args_of(sol)
        return lambda t, y: np.reshape(code(t, y, args), shape)

    def _args_of(self, sol: Any) -> tuple[Any, ...]:
        """Return the arguments of the run, which may have been replaced; a file does not know them."""
        known: tuple[Any, ...] = getattr(getattr(sol, "_invariants", None), "args", ())
        return known or self._words.args

    def _problem(
        self,
        t_span: Span,
        y0: list[float],
        *,
        laws: bool = True,
        compiled: bool | None = None,
        name: str | None = None,
        consistent: Consistent = "check",
        correction: Correction = "levels",
    ) -> Problem:
        choice("correction", correction, ("levels", "joint", "none"))
        left_out: frozenset[str] = frozenset()
        if self._mechanism is not None:
            y0, left_out = self._mechanism.start(t_span, y0, consistent, correction)
        native = find_spec("llvmlite") is not None if compiled is None else compiled
        made, pattern = self._functions(native, left_out)
        sparsity = None
        if native and pattern is not None:  # native code gives the values of this pattern
            sparsity = pattern.matrix([1.0] * len(pattern.indices))
        invariants: list[Invariants] = []
        if correction != "none":
            kept = [law for law in self._laws if not {law.name, law.of} & left_out]
            invariants = self._invariants(made, interval(t_span)[0], y0, kept if laws else _given(kept), correction)
        return Problem(
            made["f"],
            t_span,
            y0,
            args=self._words.args,
            invariants=invariants or None,
            jac=made["jac"],
            jac_sparsity=sparsity,
            name=name,
            labels=[label(one) for one in self.states],
        )

    def _functions(self, native: bool, left_out: frozenset[str]) -> Code:
        """Return f, jac, and for law i its function g_i and gradient dg_i; made once."""
        key = native, left_out
        if key not in self._made:
            system = self._system
            if left_out and self._mechanism is not None:
                first = len(system.force) - len(self._mechanism.names)
                system = system.without([first + self._mechanism.names.index(one) for one in left_out])
            self._made[key] = functions(
                system, [law.formula for law in self._laws], native, [str(one) for one in self._words.parameters]
            )
        return self._made[key]

    def _invariants(
        self, made: Mapping[str, Any], t: float, y0: list[float], laws: list[Law], correction: Correction
    ) -> list[Invariants]:
        """Return the invariants: those that were given, and the proposed ones that are constant and independent at the
        start."""
        kept: list[Invariants] = []
        in_levels = correction == "levels" and any(law.level < LAWS for law in laws)
        positions = len(self._system.explicit)
        moves = {POSITIONS: range(positions), VELOCITIES: range(positions, len(y0))}
        for law in sorted(laws, key=lambda law: law.proposed):
            i = self._laws.index(law)
            order: Any = {"level": law.level, "moves": moves.get(law.level)} if in_levels else {}
            one = Invariants(made[f"g{i}"], made[f"dg{i}"], value=law.value, names=law.name, **order)
            if not law.proposed:
                kept.append(one)
            else:
                report = check_invariants(made["f"], [*kept, one], t, y0, self._words.args)
                if report.conserved[-1] and not (report.stationary[-1] or report.redundant.any()):
                    kept.append(one)
        return kept


def _given(laws: list[Law]) -> list[Law]:
    return [law for law in laws if not law.proposed]


def _points(words: Vocabulary, points: Sequence[Any]) -> list[list[Any]]:
    """Return coordinates in the symbols of the code, a row of two or three for each point."""
    rows = [list(row) if np.iterable(row) else [row] for row in points]
    if not rows or {len(row) for row in rows} not in ({2}, {3}):
        raise ValueError("points must be a list of points, each of two or each of three coordinates")
    return [[words.coded(f"point {i}", e) for e in row] for i, row in enumerate(rows)]


class Equations(SymbolicSystem):
    """y' = f(t, y) by formulas: what `equations` and `from_mechanics` make."""

    def problem(self, t_span: Span, y0: Any, *, compiled: bool | None = None, name: str | None = None) -> Problem:
        """Return the initial value problem.

        Parameters
        ----------
        t_span : (float, float)
            (t0, tf).
        y0 : dict or array_like
            Initial values, by symbol or in the order of the equations.
        compiled : bool, optional
            Whether the functions become machine code. Default: if llvmlite, of the extra `compiled`, is installed.
        name : str, optional
            For tables and plots.
        """
        return self._problem(t_span, self._words.start("y0", y0, self.states), compiled=compiled, name=name)


class Phase(SymbolicSystem):
    """A mechanical system: its state consists of coordinates q, and momenta p or velocities v."""

    _second: str

    @property
    def _positions(self) -> int:
        """Number of components of the state that are coordinates."""
        return len(self.states) // 2

    def _start(self, q0: Any, second: Any) -> list[float]:
        """Return the state, of q by symbol or in their order, and p by symbol, v by coordinate, or in the order of
        q."""
        n = self._positions
        q, p = self.states[:n], self.states[n:]
        last = q if isinstance(second, Mapping) and not any(one in p for one in second) else p
        return [*self._words.start("q0", q0, q), *self._words.start(f"{self._second}0", second, last)]


class Mechanical(Phase):
    """M v' = Q + Φᵀ λ, with constraints."""

    _second = "v"

    def multipliers(self, sol: Points, args: Iterable[Any] | None = None) -> Array:
        """Return the multipliers λ at the points of a solution.

        Parameters
        ----------
        sol : Solution
            Of a problem of this system.
        args : tuple, optional
            The arguments with which it was solved. Default: those of its problem, if the solution knows it, else the
            values in `parameters`. Give them for trajectories of ensembles and for loaded solutions.

        Returns
        -------
        ndarray, (m, n_t)
            Those of the constraints, then those of the velocity constraints; of least norm if constraints are
            redundant.

        Raises
        ------
        ValueError
            There are no constraints with multipliers: Kane's method eliminates them.
        """
        if self._mechanism is None:
            raise ValueError(
                "the equations have no multipliers: they have no constraints, or Kane's method has eliminated them; "
                "Lagrange's method keeps them"
            )
        words, n, mass = self._words, self._positions, self._mechanism.mass
        rows = self._system.mass[n:, :n]
        matrix = sympy.Matrix([[mass, -rows.T], [rows, sympy.zeros(rows.rows)]])
        both = matrix.row_join(sympy.Matrix(self._system.force))
        code = sympy.lambdify([words.t, words.y, words.p], both, modules="numpy", cse=True)
        used = self._args_of(sol) if args is None else extra_arguments(args)
        columns = []
        for t, y in zip(sol.t, np.asarray(sol.y).T, strict=True):
            at = np.asarray(code(t, y, used), dtype=float)
            columns.append(np.linalg.lstsq(at[:, :-1], at[:, -1], rcond=None)[0][n:])
        return np.array(columns).reshape(-1, rows.rows).T


def label(state: Any) -> str:
    """Return the label of a state: x of x(t), x' of its rate."""
    if isinstance(state, sympy.Derivative):
        return f"{state.expr.func}'"
    return str(state.func) if getattr(state, "is_Function", False) else str(state)


def equations(
    rates: Mapping[Any, Any],
    *,
    invariants: Iterable[Any] | Mapping[str, Any] = (),
    parameters: Mapping[Any, Any] | None = None,
    points: Sequence[Any] | None = None,
) -> Equations:
    """Differential equations given by formulas.

    Parameters
    ----------
    rates : dict
        States, symbols or functions of time, and their derivatives: ``{x: -y, y: x}``.
    invariants : sequence of sympy.Expr or sympy.Eq, or dict of names and these, optional
        What the solution keeps: expressions keep their initial values, equations ``Eq(a, b)`` hold.
    parameters : dict, optional
        Other symbols and their values, which become `args` of the problem.
    points : sequence of points, optional
        Expressions of two or three coordinates for each point that ``animate(sol)`` shows.

    Returns
    -------
    Equations
        A `SymbolicSystem`, with ``problem(t_span, y0)``.

    Raises
    ------
    TypeError, ValueError
        A formula is not a SymPy expression, or has an unknown symbol; a symbol has two meanings.

    Notes
    -----
    Time is the argument of the states if they are functions, else the symbol t. Jacobians are exact, and sparse if
    there are many equations and few entries.

    Examples
    --------
    >>> import sympy
    >>> from invariode import symbolic
    >>> x, y, k = sympy.symbols("x y k")
    >>> system = symbolic.equations({x: -k * y, y: k * x}, invariants=[x**2 + y**2], parameters={k: 2})
    >>> system
    Equations(x' = -k*y, y' = k*x)
    >>> sol = system.problem((0, 10), {x: 1, y: 0}, compiled=False).solve()
    >>> bool(abs(sol.residual).max() < 1e-8)
    True
    """
    given: Any = rates
    if not isinstance(given, Mapping) or not given:
        raise TypeError(f"rates must be a dict of states and their derivatives, got {rates!r}")
    words = Vocabulary(list(rates), parameters)
    coded = [words.coded(f"the derivative of {one}", rate) for one, rate in rates.items()]
    system = System(words.y, coded, None, [])
    shown = [(sympy.Symbol(f"{label(one)}'"), parsed("", rate)) for one, rate in rates.items()]
    return Equations(words, system, given_laws(words, invariants), shown, points)


def given_laws(words: Vocabulary, invariants: Iterable[Any] | Mapping[str, Any]) -> list[Law]:
    """Return the invariants that the user states."""
    named: list[tuple[str | None, Any]] = (
        [*invariants.items()] if isinstance(invariants, Mapping) else [(None, one) for one in invariants]
    )
    laws: list[Law] = []
    for name, one in named:
        formula, value = (one.lhs - one.rhs, 0.0) if isinstance(one, sympy.Equality) else (one, None)
        text = str(one) if len(str(one)) <= _NAME else f"invariant {len(laws) + 1}"
        coded = words.coded(f"invariant {name or text}", formula)
        if not coded.free_symbols & set(words.y):
            raise ValueError(f"invariant {name or text} does not depend on the state: leave it out")
        laws.append(Law(name or text, coded, value, proposed=False))
    return laws


def constrained(
    words: Vocabulary, held: Sequence[Any], rates: Sequence[Any], rolled: Sequence[Any], mass: Any, force: Sequence[Any]
) -> tuple[list[Law], Mechanism | None]:
    """Return the laws that constraints of positions, with their rates, and of velocities are, and the mechanism if
    any."""
    names = [f"constraint {i + 1}" for i in range(len(held))]
    laws = [Law(name, one, 0.0, False, POSITIONS) for name, one in zip(names, held, strict=True)]
    laws += [Law(f"rate of {name}", one, 0.0, False, VELOCITIES, name) for name, one in zip(names, rates, strict=True)]
    rolling = [f"velocity constraint {i + 1}" for i in range(len(rolled))]
    laws += [Law(name, one, 0.0, False, VELOCITIES) for name, one in zip(rolling, rolled, strict=True)]
    if not laws:
        return [], None
    return laws, Mechanism(words, [*names, *rolling], held, rolled, mass, force)
