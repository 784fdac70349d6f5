"""`Dae`: ``F(t, y, y', *args) = 0`` of any index, analysed once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple, TypeAlias, Unpack

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    Array,
    call_name,
    choice,
    distinct_labels,
    extra_arguments,
    function,
    interval,
    number,
    real_numbers,
    shown,
    state,
    warn,
)
from .._base.suggestions import first_few, meant, naming_arguments
from .._base.types import EventsLike, MethodName, OnFailure, Span
from .._functions.graph.function import GraphFunction
from .._functions.graph.nodes import Node
from .._functions.graph.python import Formula
from .._functions.graph.switching_times import timed
from .._functions.layout import layout_of
from .._plan.call_errors import require_called, takes
from .._problem.bounds import to_bounds
from .._problem.events import titled, to_events
from .._problem.invariants import Invariants
from .._problem.methods import find_method
from .._problem.options import Options
from .._problem.problem import Problem
from .._problem.sensitivities import SensitivitiesLike
from .._results.result import FAILED, NOT_CONSERVED
from .._results.solution import Solution
from .._run.run import concluded
from .checks import impasse, jump, passage, point_of, require_no_jump, violation
from .consistent_start import ConsistentPoint, Starts
from .dae_solution import Unknowns, in_unknowns
from .expressions import leaves, primed, substituted
from .functions_of_unknowns import ThroughUnknowns
from .reduction import GivenValues, Reduction, Variable
from .structural_analysis import GenericPoints, Structure
from .traced_equations import aliases, traced_equations

#: Changes of initial values below this part of them are roundoff, above the second they are reported in a warning.
_MOVED, _LARGE_MOVE = 1e-10, 1e-6
#: Printed tables have at most this many rows.
_ROWS = 24


#: What becomes of equations that are not linear in what they determine.
Nonlinear: TypeAlias = Literal["raise", "algebraic"]


class _DaeFunctions(NamedTuple):
    """The functions of a reduced problem."""

    slope: Any
    levels: list[Any]
    unknowns: Unknowns


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """Consistent initial values of a `Dae`.

    Attributes
    ----------
    t : float
        The time.
    y, yp : ndarray, (n,)
        The unknowns and their derivatives; they satisfy F = 0 and all hidden constraints.
    moved : dict
        By how much given values were changed, by name, such as "x" or "x'"; changes by roundoff are left out.
    """

    t: float
    y: Array
    yp: Array
    moved: dict[str, float]


class _StartOfArgs:
    """The consistent initial state as a function of the arguments: constraints with parameters move it.

    - `nearest`: ``nearest(p)`` returns the consistent x_j^(l)
    - `states`: the variables that are states
    - `p`, `y0`: the numbers of some arguments, and the state for them
    """

    solves_equations = True

    def __init__(self, nearest: Callable[[Array], Array], states: Sequence[Variable], p: Array, y0: Array) -> None:
        self._nearest, self._states, self._latest = nearest, states, (p, y0)

    def __call__(self, *args: Any) -> Array:
        p = layout_of(args).numbers
        latest, y0 = self._latest
        if not np.array_equal(p, latest):
            x = self._nearest(p)
            y0 = np.array([x[one] for one in self._states])
            self._latest = p, y0  # one assignment: threads may call
        return y0


@naming_arguments
class Dae:
    """Differential-algebraic equations ``F(t, y, y', *args) = 0`` of any index, analysed for what they determine.

    F is called once with symbolic values. From its expressions follow how often each equation has to be differentiated
    to determine the highest derivatives (Pryce's Σ-method), an ordinary differential equation for them, and the hidden
    constraints, which `problem` imposes as invariants in levels.

    Parameters
    ----------
    F : callable
        ``F(t, y, yp, *args)`` returns n residuals for the n unknowns y and their derivatives yp; with ``order=2``
        ``F(t, y, yp, ypp, *args)``. It must be possible to trace it, as for `compile`.
    t0 : float
        The initial time.
    y0 : array_like of shape (n,)
        Initial values, or guesses of them: `consistent` finds the nearest values that satisfy all constraints.
    yp0 : array_like of shape (n,), optional
        Initial derivatives, or guesses. Default: unknown.
    args : tuple, optional
        Further arguments of F. Numbers and arrays are parameters of `problem`, if F can be traced with them.
    names : sequence of n str, optional
        Names of the unknowns. Default: y[0], y[1], ...
    equations : sequence of n str, optional
        Names of the equations. Default: F[0], F[1], ...
    order : {1, 2}, default 1
        The highest derivative that F takes.

    Attributes
    ----------
    index : int
        The structural index: how often F has to be differentiated, at most, to give an ODE for all unknowns. Where
        terms cancel it is that of the equations after `repairs`.
    freedom : int
        The degrees of freedom: how many initial values can be chosen.
    offsets : tuple of ndarray of int, (n,)
        c and d of Pryce's method: equation i is differentiated c_i times, and determines the derivative of order d_j of
        the unknown j on its place of the transversal. Unknowns that only rename others, as in u = x', are left out;
        those that repairs introduced are last.
    blocks : list of (list of str, list of str)
        Equations and the derivatives that they determine together, in the order in which they are solved.
    repairs : list of str
        Equations that were replaced by combinations in which terms cancel, and new unknowns w1, w2, ... for expressions
        in which unknowns occur together.

    Raises
    ------
    ValueError
        The equations do not determine the unknowns. The message lists the equations and unknowns concerned.
    TypeError
        F cannot be traced. `solve_dae` solves such equations if their index is at most 1.

    Notes
    -----
    J. D. Pryce, BIT 41 (2001) 364-394; G. Tan, N. S. Nedialkov and J. D. Pryce, BIT 57 (2017) 845-865; C. W. Gear,
    B. Leimkuhler and G. K. Gupta, J. Comput. Appl. Math. 12-13 (1985) 77-90.

    Examples
    --------
    >>> import invariode as iv
    >>> def pendulum(t, y, yp, ypp):
    ...     x, z, tension = y
    ...     return [ypp[0] + tension * x, ypp[1] + tension * z + 9.81, x**2 + z**2 - 1]
    >>> dae = iv.Dae(pendulum, 0, [1, 0, 0], names=["x", "z", "tension"], order=2)
    >>> dae.index, dae.freedom
    (3, 2)
    >>> print(dae)
    Dae('pendulum'): 3 equations, index 3, 2 degrees of freedom, 2 constraints
    equation  differentiated  determines
    F[0]                   0  x''
    F[1]                   0  tension
    F[2]                   2  z''
    """

    def __init__(
        self,
        F: Callable[..., Any],
        t0: float,
        y0: ArrayLike,
        yp0: ArrayLike | None = None,
        *,
        args: Iterable[Any] = (),
        names: Sequence[str] | None = None,
        equations: Sequence[str] | None = None,
        order: Literal[1, 2] = 1,
    ) -> None:
        self.t0, self.order = number("t0", t0), _order(order)
        signature = "F(t, y, yp)" if self.order == 1 else "F(t, y, yp, ypp)"
        self.F = function("F", F, signature)
        self.y0 = _real_state("y0", y0)
        n = len(self.y0)
        self.yp0 = None if yp0 is None else _real_state("yp0", yp0, n)
        self.args = extra_arguments(args)
        require_called("F", F, signature, self.args)
        self.name = call_name(F, "dae")
        self.names = [f"y[{j}]" for j in range(n)] if names is None else distinct_labels(names, n)
        self.equations = [f"F[{i}]" for i in range(n)] if equations is None else _names(equations, n)
        traced = traced_equations(self.F, self.args, n, self.order)
        if len(traced.outputs) != n:
            raise ValueError(
                f"F returns {len(traced.outputs)} residuals for {n} unknowns: as many equations as unknowns are needed"
            )
        self._args, self._parameter_names = traced.args, traced.names
        self._p = layout_of(traced.args).numbers
        self._analyse(traced.outputs)

    def _analyse(self, outputs: list[Node]) -> None:
        n, graph = len(self.y0), outputs[0].graph
        renamed, gone = aliases(outputs, n)
        kept = [j for j in range(n) if j not in renamed]
        place = {j: b for b, j in enumerate(kept)}
        self._of = [
            GivenValues(place[j], 0, 1.0) if j in place else GivenValues(place[renamed[j].j], *renamed[j][1:])
            for j in range(n)
        ]
        m, mapping = len(kept), {}
        for one in sorted(leaves(outputs)):
            order, u = divmod(one, n)
            b, more, sign = self._of[u]
            leaf = graph.y((order + more) * m + b)
            mapping[graph.y(one)] = leaf if sign > 0 else graph.negative(leaf)
        self._kept = kept
        self._differentiated = {place % n for place in leaves(outputs) if place >= n}
        guess, _ = self._guess(self.y0, self.yp0)
        self._structure = Structure(
            substituted([one for i, one in enumerate(outputs) if i not in gone], mapping),
            GenericPoints(self.t0, guess),
            self._p,
            [self.names[j] for j in kept],
            [one for i, one in enumerate(self.equations) if i not in gone],
        )
        self._reductions: dict[str, tuple[Reduction, Starts]] = {}
        self._made: dict[Reduction, _DaeFunctions] = {}

    def _guess(self, y: Array, yp: Array | None, fixed: Collection[int] = ()) -> tuple[Array, int]:
        """Return values and derivatives of the unknowns that are left, and how many levels of them were given. The
        values of the unknowns in `fixed` must not change."""
        m = len(self._kept)
        known = max([1 + (yp is not None)] + [1 + one.order for one in self._of])
        guess = np.zeros((known, m))
        if yp is not None:
            for u, (b, order, sign) in enumerate(self._of):
                if order + 1 < known:
                    guess[order + 1, b] = sign * yp[u]
        # A given value replaces the derivative that it renames. If several unknowns rename one, the value of a fixed
        # one counts, otherwise that of one whose derivative is in F: later values overwrite earlier ones.
        for u in sorted(range(len(self._of)), key=lambda u: (u in fixed, u in self._differentiated)):
            b, order, sign = self._of[u]
            guess[order, b] = sign * y[u]
        return guess, known

    # ------------------------------------------------------------------------------------------------------------------
    # What the analysis found

    @property
    def index(self) -> int:
        c, d, _ = self._structure.arrangement.offsets
        # An ODE for x_j^(order) needs x_j^(order + 1), which takes as many more differentiations as that is above d_j.
        more = max((one.order + 1 - int(d[one.j]) for one in self._of), default=0)
        return int(c.max(initial=0)) + max(more, 0)

    @property
    def freedom(self) -> int:
        return self._structure.arrangement.offsets.freedom

    @property
    def offsets(self) -> tuple[Array, Array]:
        c, d, _ = self._structure.arrangement.offsets
        return c.copy(), d.copy()

    @property
    def repairs(self) -> list[str]:
        return list(self._structure.repairs)

    @property
    def blocks(self) -> list[tuple[list[str], list[str]]]:
        structure, (_, d, _) = self._structure, self._structure.arrangement.offsets
        return [
            ([structure.names[i] for i in rows], [primed(structure.unknowns[j], int(d[j])) for j in columns])
            for rows, columns, _ in structure.arrangement.blocks
        ]

    def __repr__(self) -> str:
        structure, (c, d, match) = self._structure, self._structure.arrangement.offsets
        count = int(c.sum())
        head = (
            f"Dae({self.name!r}): {len(self.y0)} equations, index {self.index}, {self.freedom} degree"
            f"{'s' * (self.freedom != 1)} of freedom, {count} constraint{'s' * (count != 1)}"
        )
        width = max(len("equation"), *map(len, structure.names))
        lines = [head, f"{'equation':<{width}}  differentiated  determines"]
        for i in range(min(len(c), _ROWS)):
            determines = primed(structure.unknowns[match[i]], int(d[match[i]]))
            lines.append(f"{structure.names[i]:<{width}}  {c[i]:>14}  {determines}")
        if len(c) > _ROWS:
            lines.append(f"... and {len(c) - _ROWS} more")
        return "\n".join([*lines, *self.repairs])

    # ------------------------------------------------------------------------------------------------------------------
    # Consistent values

    def consistent(
        self,
        fixed: Iterable[str | int] = (),
        *,
        y: ArrayLike | None = None,
        yp: ArrayLike | None = None,
        t: float | None = None,
    ) -> Start:
        """Find the consistent initial values that are nearest to the given ones.

        Parameters
        ----------
        fixed : sequence of str or int, optional
            Values that must stay: names of unknowns, with primes for derivatives, such as ``["x", "x'"]``, or indices
            of unknowns. Positions give way to fixed velocities if there is no other solution.
        y, yp : array_like of shape (n,), optional
            Other values than y0 and yp0 to start from.
        t : float, optional
            Another time than t0.

        Returns
        -------
        Start
            With the fields `y`, `yp` and `moved`.

        Raises
        ------
        InvariantError
            There are no consistent values near these; too many values are fixed (the message says which follow from
            which); or the start is a singular point, where the equations do not determine the highest derivatives.

        Notes
        -----
        Newton's iteration of least norm, in weights of the size of the values, solves the constraints stage by stage,
        those differentiated least first. Values that the equations leave free change only if a constraint contains
        them.

        Examples
        --------
        >>> import invariode as iv
        >>> def pendulum(t, y, yp, ypp):
        ...     x, z, tension = y
        ...     return [ypp[0] + tension * x, ypp[1] + tension * z + 9.81, x**2 + z**2 - 1]
        >>> dae = iv.Dae(pendulum, 0, [0.6, -0.7, 0], names=["x", "z", "tension"], order=2)
        >>> start = dae.consistent(fixed=["x"])
        >>> start.y.round(3)
        array([ 0.6  , -0.8  ,  7.848])
        """
        reduction, starts = self._reduced("algebraic")
        at = self.t0 if t is None else number("t", t)
        values = self.y0 if y is None else _real_state("y", y, len(self.y0))
        slopes = self.yp0 if yp is None else _real_state("yp", yp, len(self.y0))
        x = self._start(starts, at, _listed(fixed), values, slopes, self._p)
        states, times = np.array([[x[one]] for one in reduction.states]).reshape(-1, 1), np.array([at])
        unknowns = self._functions(reduction).unknowns
        new = [of(times, states, self._p)[:, 0] for of in (unknowns.y, unknowns.yp)]
        moved = {}
        for order, old in enumerate((values, slopes)):
            if old is None:
                continue
            for name, after, before in zip(self.names, new[order].tolist(), old.tolist(), strict=True):
                if abs(after - before) > _MOVED * max(1.0, abs(after)):
                    moved[primed(name, order)] = after - before
        return Start(at, new[0], new[1], moved)

    def _start(
        self, starts: Starts, t: float, fixed: Iterable[str | int], y: Array, yp: Array | None, p: Array
    ) -> Array:
        """Return the consistent x_j^(l), l <= d_j, nearest to y and yp."""
        stay = [self._variable(one) for one in fixed]
        guess, known = self._guess(y, yp, {u for order, u in stay if order == 0})
        guess, levels = self._structure.completed(t, guess, p), self._structure.known(np.full(len(self._kept), known))
        held = {(order + self._of[u].order, self._of[u].j) for order, u in stay}
        return starts.nearest(ConsistentPoint(t, guess, p), levels, held)

    def _variable(self, given: object) -> tuple[int, int]:
        """Return the order and the number of an unknown that is named with primes, or given by its index."""
        if isinstance(given, str):
            order = len(given) - len(given.rstrip("'"))
            name = given.rstrip("'")
            if name in self.names:
                return order, self.names.index(name)
            raise ValueError(
                f"fixed: there is no unknown {given!r}{meant(name, self.names) or ''}; the unknowns are "
                f"{', '.join(self.names[:12])}"
            )
        if isinstance(given, int) and not isinstance(given, bool) and 0 <= given < len(self.names):
            return 0, given
        raise ValueError(f"fixed must list names such as 'x' or \"x'\", or indices of unknowns, got {shown(given)}")

    # ------------------------------------------------------------------------------------------------------------------
    # The problem

    def problem(
        self,
        t_span: Span,
        fixed: Iterable[str | int] = (),
        *,
        nonlinear: Nonlinear = "raise",
        nonnegative: Any = None,
        bounds: Any = None,
    ) -> Problem:
        """Make the problem that has the solutions of the equations: an ODE with all constraints as invariants.

        Parameters
        ----------
        t_span : (float, float)
            (t0, tf). Consistent values are found at t0.
        fixed : sequence of str or int, optional
            As in `consistent`.
        nonlinear : {'raise', 'algebraic'}, default 'raise'
            How equations are treated that are not linear in the highest derivatives they determine. 'raise'
            differentiates them once more, for all methods; 'algebraic' leaves them as algebraic equations under a
            singular mass matrix, for methods that take one, such as radau and ode15s.
        nonnegative, bounds
            As in `solve_dae`.

        Returns
        -------
        Problem
            Its state holds the unknowns that have initial values, and derivatives of them, as its `labels` say.
            `solution` turns a solution of it into one in the unknowns of F.

        Raises
        ------
        InvariantError
            There are no consistent initial values near the given ones.

        Warns
        -----
        UserWarning
            Given values were changed by more than roundoff.
        """
        span, fixed = interval(t_span), _listed(fixed)
        choice("nonlinear", nonlinear, ("raise", "algebraic"))
        reduction, starts = self._reduced(nonlinear)
        x = self._start(starts, span[0], fixed, self.y0, self.yp0, self._p)
        self._tell_move(x)
        return self._problem(reduction, starts, x, fixed, span, **self._bounds(reduction, nonnegative, bounds))

    def _problem(
        self,
        reduction: Reduction,
        starts: Starts,
        x: Array,
        fixed: Sequence[str | int],
        span: tuple[float, float],
        atol: Array | None = None,
        **describing: Any,
    ) -> Problem:
        y0: Any = np.array([x[one] for one in reduction.states])
        structure = reduction.structure
        labels = [primed(structure.unknowns[j], order) for order, j in reduction.states]
        if starts.depend_on_parameters:
            nearest = partial(self._start, starts, span[0], fixed, self.y0, self.yp0)
            y0 = _StartOfArgs(nearest, reduction.states, self._p, y0)
        if not labels:  # all unknowns follow from t: the time itself is the state
            y0, labels = np.array([span[0]]), ["t"]
        mass = reduction.mass()
        return Problem(
            self._functions(reduction).slope,
            span,
            y0,
            args=self._args,
            invariants=self._invariants(reduction, atol) or None,
            mass=None if mass is None else np.diag(mass),
            name=self.name,
            labels=labels,
            **describing,
        )

    def _bounds(self, reduction: Reduction, nonnegative: Any, bounds: Any) -> dict[str, Any]:
        """Return the bounds of the states that follow from those of the unknowns of F, as a problem takes them."""
        found: dict[str, Any] = {"nonnegative": False if nonnegative is False else None}
        given = to_bounds(nonnegative, bounds, self.y0, self.names)
        if given is None:
            return found
        lower, upper = (np.full(len(reduction.states), limit) for limit in (-np.inf, np.inf))
        formulas = []
        for name, (j, order, sign), low, high in zip(self.names, self._of, *given, strict=True):
            place = reduction.place.get((order, j))
            if place is not None:
                low, high = (low, high) if sign > 0 else (-high, -low)
                lower[place], upper[place] = max(lower[place], low), min(upper[place], high)
            elif np.isfinite(low) or np.isfinite(high):
                formulas.append(name)
        if formulas:
            states = [
                name for name, (j, order, _) in zip(self.names, self._of, strict=True) if (order, j) in reduction.place
            ]
            what = "it as a formula" if len(formulas) == 1 else "them as formulas"
            raise ValueError(
                f"{', '.join(formulas)} cannot have bounds: the equations give {what} of the others. "
                + (f"Bounds are possible for {', '.join(states)}" if states else "No unknown has an initial value")
            )
        return found | {"bounds": (lower, upper)}

    def _tell_move(self, x: Array) -> None:
        """Warn where given initial values were changed that the equations leave to the user."""
        _, d, _ = self._structure.arrangement.offsets
        if not self.freedom:  # all values are determined: those given are guesses
            return
        large = []
        for more, given in ((0, self.y0), (1, self.yp0)):
            for name, (j, order, sign), old in zip(
                self.names, self._of, [] if given is None else given.tolist(), strict=given is not None
            ):
                if order + more >= d[j] or (more and not old):
                    continue
                new = sign * x[order + more, j]
                if abs(new - old) > _LARGE_MOVE * max(1.0, abs(new)):
                    large.append(f"{primed(name, more)} from {old:.6g} to {new:.6g}")
        if large:
            warn(f"initial values were moved onto the constraints: {first_few(large)}")

    def _reduced(self, nonlinear: Nonlinear) -> tuple[Reduction, Starts]:
        if nonlinear not in self._reductions:
            reduction = Reduction(self._structure, nonlinear)
            if reduction.algebraic == len(reduction.states) > 0:  # an ODE is needed for the steps
                return self._reduced("raise")
            first = Starts(Reduction(self._structure, "algebraic")) if reduction.is_raised else None
            made = reduction, Starts(reduction, first)
            self._reductions[nonlinear] = made
            if not reduction.is_nonlinear:  # there is only one
                self._reductions["raise"] = self._reductions["algebraic"] = made
        return self._reductions[nonlinear]

    def _functions(self, reduction: Reduction) -> _DaeFunctions:
        """Return the functions of the reduced problem, compiled if llvmlite is installed, made once."""
        if reduction not in self._made:
            slopes = reduction.slopes or [reduction.graph.node(1.0)]
            levels = [self._function(f"level{k}", level.in_states) for k, level in enumerate(reduction.levels)]
            self._made[reduction] = _DaeFunctions(
                self._function(self.name, slopes), levels, Unknowns(self._of, self._structure.given, reduction)
            )
        return self._made[reduction]

    def _function(self, name: str, outputs: list[Node]) -> Any:
        formula = Formula(name, lambda: outputs, (len(outputs),), self._parameter_names)
        return GraphFunction(formula) if find_spec("llvmlite") is not None else formula

    def _invariants(self, reduction: Reduction, atol: Array | None = None) -> list[Invariants]:
        """Return the levels, each in a constant metric: in the weights of the error test rows can be nearly
        dependent."""
        found = []
        for k, (level, fun) in enumerate(zip(reduction.levels, self._functions(reduction).levels, strict=True)):
            moves = [reduction.place[one] for one in level.moves]
            metric = np.ones(len(moves)) if atol is None else atol[moves] ** -2.0
            found.append(Invariants(fun, value=0, names=level.names, level=k, moves=moves, metric=metric))
        return found

    # ------------------------------------------------------------------------------------------------------------------
    # Solutions

    def solve(
        self,
        t_span: Span,
        method: MethodName = "auto",
        *,
        fixed: Iterable[str | int] = (),
        events: EventsLike = None,
        sensitivities: SensitivitiesLike | None = None,
        nonnegative: Any = None,
        bounds: Any = None,
        **options: Unpack[Options],
    ) -> Solution:
        """Solve the equations; the result is in the unknowns of F.

        Parameters
        ----------
        t_span : (float, float)
            (t0, tf).
        method, fixed, events, sensitivities, nonnegative, bounds, **options
            As in `solve_dae`.

        Returns
        -------
        Solution
            See `solve_dae`.
        """
        span, fixed = interval(t_span), _listed(fixed)
        known, _ = find_method(method)
        if known.equations == "second-order":
            raise ValueError(f"{known.name} is for y'' = f(t, y), and solve_dae reduces F to y' = f(t, y): take dop853")
        reduction, starts = self._reduced("algebraic" if known.mass == "any" else "raise")
        if method == "auto" and reduction.algebraic:  # an explicit method would solve for them in each evaluation
            method = "radau"
        x = self._start(starts, span[0], fixed, self.y0, self.yp0, self._p)
        self._tell_move(x)
        unknowns = self._functions(reduction).unknowns
        through = ThroughUnknowns(unknowns, partial(self._after_action, reduction, starts), self._p)
        on_failure = through.options(options)
        if timed([one for level in reduction.levels for one in level.in_states]):
            require_no_jump(reduction, span, np.array([x[one] for one in reduction.states]), self._p)
        atol = self._atol(reduction, options)
        describing = {"sensitivities": sensitivities, **self._bounds(reduction, nonnegative, bounds)}
        if events is not None:
            listed = to_events(events)
            for one in listed:
                if not takes(one.fun, self.args):
                    raise TypeError(
                        f"{titled(one.__name__)} cannot be called as event(t, y, *args): for one on y', make it an "
                        "unknown of its own, u, with the equation u - y' = 0"
                    )
            describing["events"] = [through.event(one) for one in listed]
        problem = self._problem(reduction, starts, x, fixed, span, atol, **describing)
        return self._presented(problem.solve(method, **options), reduction, on_failure)

    def _after_action(
        self,
        reduction: Reduction,
        starts: Starts,
        t: float,
        state: Array,
        old: tuple[Array, Array],
        new: tuple[Array, Array],
        args: Sequence[Any],
    ) -> Array:
        """Return the consistent state nearest to one in which unknowns, or their derivatives, have changed."""
        p = layout_of(args).numbers if args else self._p
        x = point_of(reduction, t, state, p).x
        (before, _), (after, _) = self._guess(*old), self._guess(*new)
        levels = min(len(x), len(after))
        x[:levels, : len(self._kept)] += after[:levels] - before[:levels]
        x = self._structure.completed(t, x, p)
        found = starts.nearest(ConsistentPoint(t, x, p), np.full(x.shape[1], len(x)), ())
        return np.array([found[one] for one in reduction.states])

    def _atol(self, reduction: Reduction, options: Options) -> Array | None:
        """Return the tolerances of the states, if there is one for each unknown: derivatives have that of their
        unknown."""
        given = options.get("atol")
        if given is None or np.ndim(given) == 0:
            return None
        each = real_numbers("atol", given)
        if each.shape != (len(self.names),):
            raise ValueError(
                f"atol must be a number or have one value per unknown, {len(self.names)}, got {shown(given)}"
            )
        own = {(one.order, one.j): each[u] for u, one in enumerate(self._of)}
        for j, definition in enumerate(self._structure.definitions, len(self._kept)):
            own[0, j] = min(own[0, place % self._structure.n] for place in leaves([definition]))
        found = np.array([own.get((order, j), own[0, j]) for order, j in reduction.states] or [1.0])
        options["atol"] = found
        return found if (found > 0).all() else None

    def solution(self, sol: Solution) -> Solution:
        """Express a solution of a problem of this DAE in the unknowns of F.

        Parameters
        ----------
        sol : Solution
            Of a problem that `problem` returned, perhaps with other `args`.

        Returns
        -------
        Solution
            As that of `solve_dae`.
        """
        for reduction, functions in self._made.items():
            if functions.slope is sol._source.problem.fun:
                return self._presented(sol, reduction)
        raise ValueError("the solution is not one of a problem of this Dae: solve what dae.problem(t_span) returns")

    def _presented(self, sol: Solution, reduction: Reduction, on_failure: OnFailure | None = None) -> Solution:
        """Return a solution of the reduced problem in the unknowns of F; a violated equation is a failure."""
        unknowns = self._functions(reduction).unknowns
        source = sol._source
        p = layout_of(source.problem.args).numbers

        def again(resumed: Solution, then: OnFailure | None = None) -> Solution:
            return self._presented(resumed, reduction, then or on_failure)

        found = in_unknowns(sol, unknowns, p, self.names, reduction, again)
        has_failed = sol.status in (FAILED, NOT_CONSERVED)
        text = jump(sol, reduction, p) if has_failed else ""
        if text or (sol.status == FAILED and (text := impasse(sol, reduction, p))):
            found = found.changed(message=text)
        elif text := violation(sol, unknowns, reduction, p):
            found = found.changed(status=NOT_CONSERVED, success=False, message=text)
        elif text := passage(sol, unknowns, reduction, p):
            warn(text)
        return concluded(found, on_failure)


def _listed(fixed: Iterable[str | int]) -> list[str | int]:
    """Return the values to fix as a list; a single name is one of them."""
    return [fixed] if isinstance(fixed, str) else list(fixed)


def _order(order: object) -> int:
    if order not in (1, 2) or isinstance(order, bool):
        raise ValueError(f"order must be 1, for F(t, y, yp), or 2, for F(t, y, yp, ypp), got {shown(order)}")
    return 1 if order == 1 else 2


def _real_state(name: str, given: ArrayLike, n: int | None = None) -> Array:
    found = state(given, name)
    if found.dtype.kind == "c":
        raise ValueError(f"{name} must be real: write complex equations in real and imaginary parts")
    if not len(found):
        raise ValueError(f"{name} is empty: there is no unknown")
    if n is not None and len(found) != n:
        raise ValueError(f"{name} must have {n} values, as y0 has, got {len(found)}")
    return np.array(found, dtype=float)


def _names(names: Sequence[str], n: int) -> list[str]:
    found = list(names)
    if len(found) != n or not all(isinstance(one, str) for one in found):
        raise ValueError(f"equations must be {n} names, one for each residual, got {shown(names)}")
    return found
