"""Steady states: f(t0, y) = 0 with the totals of the initial value, where the solution goes, with derivatives.

The run follows y' = f(t0, y) until T |f| is small; then Newton's method with the exact Jacobian J and the totals W,

    [J; W M; G] dy = [-f; W M (y0 - y); c - g],

finishes, and its result is accepted only where it moves y little. Totals come from the structure of f alone: a null
space of sampled Jacobians has false members, which move the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from .._base.arguments import Array, choice, positive, quietly, real_numbers, shown, warn
from .._base.failures import FailureWarning, SolveError
from .._base.labelled import named, require_names
from .._base.matrices import as_dense
from .._base.package import public
from .._base.rational import as_rows
from .._base.suggestions import first_few
from .._base.types import MethodName, OnFailure
from .._functions.derivatives import Derivative, derivative_of, has_llvm
from .._functions.graph.function import GraphFunction
from .._functions.graph.nodes import in_order
from .._functions.graph.python import Formula
from .._functions.graph.structure import linear_totals, replaced, staying_zero
from .._functions.layout import layout_of, place_of
from .._functions.with_arguments import Point
from .._problem.grouped import Limits
from .._problem.invariants import Invariants
from .._problem.parameters import ParameterName
from .._problem.problem import Problem

Totals: TypeAlias = Literal["auto"] | Sequence[Any] | Array

#: Tolerances of the run, relative to the size of a component, and of all of them: Newton's method does the rest.
_RTOL, _ATOL = 1e-6, 1e-9

#: The method of Newton is tried where T |f| is below this part of y, and accepted where it moves y by less.
_NEAR = 1e-3

#: Tolerances of the run below which a component is noise: ode15s sustains a lightly damped oscillation at 36.
_NOISE = 100

#: After a trial that failed, T grows by this factor before the next one.
_LATER = 4.0

#: Components below this part of the largest count as of that size.
_FLOOR = 1e-6

#: Newton's steps, and singular values of its matrix, in units of the largest, that are zero.
_ITERATIONS, _ZERO = 12, 1e-11

#: What the equations of the derivatives may leave, relative to their right-hand sides.
_CONSISTENT = 1e-6

#: A rate of growth above this part of the largest rate is one: the state is not stable.
_GROWS = 1e-7

#: Accepted steps of the run, and its length in units of the fastest time at its start.
_MOST_STEPS, _LONGEST = 20_000, 1e15


class Found(NamedTuple):
    """A steady state for values of the parameters.

    Attributes
    ----------
    y : ndarray, (n,)
        The state.
    f : ndarray, (n,)
        f there.
    time : float
        How long the solution was followed.
    slopes : ndarray, (n, k), or None
        Its derivatives for the parameters; None: others with the same totals are beside it.
    eigenvalues : ndarray
        Of the Jacobian, those of algebraic equations left out.
    """

    y: Array
    f: Array
    time: float
    slopes: Array | None
    eigenvalues: Array

    @property
    def stable(self) -> bool:
        """True if no small change of the state grows."""
        return is_stable(self.eigenvalues)

    @property
    def reason(self) -> str:
        """Description of how the state was found."""
        return f"The {'solution goes to this state' if self.stable else 'state is unstable; the solution stays there'}."


class NotFound(NamedTuple):
    """Failure of the search for a steady state, with the reason."""

    reason: str
    y: Array
    f: Array
    time: float
    slopes: None = None
    eigenvalues: Array = np.zeros(0)
    stable: bool = False


@public
@dataclass(frozen=True, eq=False)
class SteadyState:
    """A steady state of a problem, as returned by `steady_state`.

    Attributes
    ----------
    t : float
        The time at which f is taken, t0 of the problem.
    y : ndarray of shape (n,)
        The state; the last one of the run if no steady state was reached.
    residual : float
        The largest ``|f_i(t0, y)|``.
    totals : ndarray of shape (m, n)
        The rows w whose totals ``w @ y`` (``w @ M @ y`` with a mass matrix) the equations conserve; they are those of
        y0.
    success : bool
        Whether it is a steady state.
    message : str
        Why not, or how it was found.
    stable : bool
        Whether no eigenvalue of the Jacobian has a positive real part (beyond roundoff). A solution stays at an
        unstable state only from special initial values.
    eigenvalues : ndarray, complex
        The eigenvalues of the Jacobian at y; with invariants and no mass matrix, for changes that conserve them.
    time : float
        How long the solution was followed, in units of t.
    sensitivity_names : list of str
        The parameters of `sensitivities`.
    """

    t: float
    y: Array
    residual: float
    totals: Array
    success: bool
    message: str
    stable: bool
    eigenvalues: Array
    time: float
    sensitivity_names: list[str]
    _slopes: Array | None
    _labels: list[str]

    @property
    def sensitivities(self) -> Array:
        """∂y/∂p, of shape (n, k), for the parameters of the problem's `sensitivities`. NaN for an initial value of zero
        without which components stay constant, if the state that it would lead to is another one.

        Raises
        ------
        ValueError
            There is no steady state, or it is not isolated: other states with the same totals are beside it.
        """
        if self._slopes is None:
            why = (
                "the state is not isolated: others with the same totals are beside it" if self.success else self.message
            )
            raise ValueError(f"there are no sensitivities: {why}")
        return self._slopes

    def __repr__(self) -> str:
        kind = ("stable" if self.stable else "unstable") if self.success else "not reached"
        totals = f"{len(self.totals)} total{'s' * (len(self.totals) != 1)}"
        state = first_few([f"{name}={x:.6g}" for name, x in zip(self._labels, self.y, strict=True)], 12)
        return f"SteadyState({kind}: {state}; residual={self.residual:.3g}, {totals})"


@public
def steady_state(
    problem: Problem,
    method: MethodName | None = None,
    *,
    totals: Totals = "auto",
    tol: float = 1e-10,
    on_failure: OnFailure = "warn",
) -> SteadyState:
    """Return the steady state to which the solution of a problem goes: f(t0, y) = 0 with the totals of y0.

    The solution of y' = f(t0, y) from y0 is followed until it hardly moves; Newton's method with the exact Jacobian and
    the totals finishes. If f depends on t, or on inputs, their values at t0 count. Invariants keep their values at
    y0, or the prescribed ones, so a mechanical system comes to rest on its constraints. One-sided invariants, those
    corrected along the stages, events and breakpoints are ignored: a state that returns after each dose is not
    steady.

    Parameters
    ----------
    problem : Problem
        Its mass matrix, if it has one, is constant.
    method : str, optional
        The method that follows the solution. Default: 'ode15s'.
    totals : "auto", or array_like of shape (m, n), or list of dict
        The linear combinations of components that f conserves. "auto": from the structure of f, exactly, if f can be
        traced. Dicts hold the nonzero coefficients by label. They select the state among its neighbours, where totals
        are conserved.
    tol : float, default 1e-10
        Newton's method ends with a step below this part of each component.
    on_failure : {"warn", "raise", "return"}, default "warn"
        If no steady state is reached: return the last state with a `FailureWarning`, raise `SolveError`, or only return
        it. Its `success` is False.

    Returns
    -------
    SteadyState

    Raises
    ------
    SolveError
        No steady state was reached, and `on_failure` is "raise".
    TypeError, ValueError
        The problem has a mass matrix that is a function, or complex states; totals that f does not conserve.

    Notes
    -----
    A mechanical system comes to rest if something damps every motion that its constraints allow; give it damping for
    this purpose, which does not change where it rests. ``multipliers(found)`` are then its forces at rest.

    Components that are zero and stay zero are left out, and so are those that stay constant because of that: where a
    reactant is absent and never made, its partners keep their initial values and the derivatives of these.

    Examples
    --------
    >>> import invariode as iv
    >>> def isomers(t, y, k, l):
    ...     v = k * y[0] - l * y[1]
    ...     return [-v, v]
    >>> problem = iv.Problem(isomers, (0, 1), [1.0, 0.0], args=(3.0, 1.0), sensitivities=True)
    >>> found = iv.steady_state(problem)
    >>> found.y.round(9), found.totals
    (array([0.25, 0.75]), array([[1., 1.]]))
    >>> found.sensitivities.round(9)
    array([[-0.0625,  0.1875],
           [ 0.0625, -0.1875]])
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"steady_state needs an invariode.Problem, got {shown(problem)}")
    choice("on_failure", on_failure, get_args(OnFailure))
    problem.require_no_delays("steady_state")
    names = problem.parameter_names()
    S0 = None if problem.sensitivities is None else problem.sensitivities.start(names, problem.args, len(problem.y0))
    states = SteadyStates(problem, names, method or "ode15s", totals, positive("tol", tol))
    found = states.at(problem.args, problem.y0, S0)
    success = isinstance(found, Found)
    message = found.reason
    if success and any(point.action is not None for point in problem.breakpoints):
        message += " Actions in the problem's breakpoints, such as doses, do not count."
    made = SteadyState(
        states.t0, found.y, np.abs(found.f).max(initial=0.0), states.totals, success, message, found.stable,
        found.eigenvalues, found.time, [one.name for one in names], found.slopes, problem.labels,
    )  # fmt: skip
    if not success and on_failure == "raise":
        raise SolveError(message, made)
    if not success and on_failure == "warn":
        warn(message, FailureWarning)
    return made


class SteadyStates:
    """Steady states of a problem for any arguments and initial values.

    - `problem`: f is taken at t0
    - `names`: the parameters of the derivatives
    - `method`, `totals`, `tol`: as in `steady_state`

    Attributes:
    - `totals`, (m, n), and `t0`: as in `SteadyState`
    """

    def __init__(
        self,
        problem: Problem,
        names: Sequence[ParameterName],
        method: MethodName = "ode15s",
        totals: Totals = "auto",
        tol: float = 1e-10,
    ) -> None:
        problem._require_real("a steady state")
        mass = problem.matrices.mass
        if callable(mass):
            raise ValueError("a steady state needs a constant mass matrix, and mass is a function")
        self._n, self._tol, self._names = len(problem.y0), tol, list(names)
        self._mass = None if mass is None else as_dense(mass).astype(float)
        self.t0 = problem.t_span[0]
        self._own = [(j, one) for j, one in enumerate(self._names) if one.kind == "args"]
        about: dict[str, Any] = {"at": Point(self.t0, problem.y0), "args": problem.args}
        about["names"] = [one for _, one in self._own]
        self._held = [one for one in problem.invariants if not one.sense and one.direction != "stages"]
        self._levels = [derivative_of(one.fun, (None, self._n), **about) for one in self._held]
        self._derivative = self._last = self._at_start(problem)
        graph = self._derivative.graph
        fun: Any = _Frozen(problem.fun, self.t0, problem.inputs) if graph is None else graph.fun
        if graph is not None and not has_llvm():
            fun = getattr(fun, "fun", fun)
        changes: dict[str, Any] = {
            "fun": fun, "t_span": (self.t0, np.inf), "events": None, "invariants": self._held, "inputs": None,
            "breakpoints": None,
            "sensitivities": None, "jac": None, "jac_sparsity": None, "lband": None, "uband": None,
        }  # fmt: skip
        self._problem, self._method = problem.replace(**changes), method
        self.totals = self._conserved(totals, problem)

    def _at_start(self, problem: Problem) -> Derivative:
        """Return the derivative of f(t0, y, *args), which does not depend on t."""
        names, t0 = [one for _, one in self._own], self.t0
        fun = _Frozen(problem.fun, t0, problem.inputs) if problem.inputs else problem.fun
        about: dict[str, Any] = {"at": Point(t0, problem.y0), "args": problem.args, "names": names, "called": "fun"}
        made = derivative_of(fun, (self._n, self._n), **about)
        if made.graph is None or not any(node.op == "t" for node in in_order(made.outputs)):
            return made
        traced, graph = made.graph.fun, made.outputs[0].graph
        if not isinstance(traced, GraphFunction):
            return self._at_start(problem.replace(fun=_Frozen(fun, t0), inputs=None))
        fixed = replaced(made.outputs, {graph.t: graph.node(t0)})
        formula = Formula(traced.__name__, lambda: fixed, (self._n,), traced.fun.parameters)
        return derivative_of(GraphFunction(formula, traced.elementary), (self._n, self._n), **about)

    def derivative(self, args: tuple[Any, ...]) -> Derivative:
        """Return the derivative of f for these arguments."""
        if self._last.args is not args:
            self._last = self._derivative.with_args(args)
        return self._last

    def value(self, y: Array, args: tuple[Any, ...]) -> Array:
        """Return f at y, (n,), as fast as possible."""
        made = self.derivative(args)
        return made.value(self.t0, y) if made.graph is None else made.graph.value(self.t0, y)

    def linear(self, y: Array, args: tuple[Any, ...]) -> tuple[Array, Array]:
        """Return f (n,) and ∂f/∂y (n, n)."""
        return self.value(y, args), self.derivative(args).jacobian(self.t0, y)

    def level(self, y: Array, args: tuple[Any, ...], y0: Array) -> tuple[Array, Array]:
        """Return c - g(y) and ∂g/∂y of the invariants, (m,) and (m, n), with their values c at y0 or as prescribed."""
        left, G = [np.zeros(0)], [np.zeros((0, self._n))]
        for one, of in self._held_at(args):
            left.append((of.value(self.t0, y0) if one.value is None else one.value) - of.value(self.t0, y))
            G.append(of.jacobian(self.t0, y))
        return np.concatenate(left), np.vstack(G)

    def _held_at(self, args: tuple[Any, ...]) -> list[tuple[Invariants, Derivative]]:
        """Return the invariants with their derivatives for these arguments."""
        at = [one if one.args is args else one.with_args(args) for one in self._levels]
        return list(zip(self._held, at, strict=True))

    def _level_slopes(self, y: Array, y0: Array, args: tuple[Any, ...], S0: Array) -> Array:
        """Return d(c - g(y))/dp where ∂y/∂p is S0, (m, k), for the invariants."""

        def slopes(of: Derivative, y: Array) -> Array:
            found = of.jacobian(self.t0, y) @ S0
            zeros = np.zeros((len(self._own), self._n))
            found[:, [j for j, _ in self._own]] += of.tangent(self.t0, np.vstack([y, zeros])).T
            return found

        rows = [(slopes(of, y0) if one.value is None else 0) - slopes(of, y) for one, of in self._held_at(args)]
        return np.vstack([np.zeros((0, S0.shape[1])), *rows])

    def _conserved(self, totals: Totals, problem: Problem) -> Array:
        """Return the rows of the totals."""
        if isinstance(totals, str):
            if totals != "auto":
                raise ValueError(f"totals must be 'auto' or rows of coefficients, got {totals!r}")
            return as_rows(linear_totals(self._derivative.outputs) if self._derivative.graph else [], self._n)
        rows = np.array([self._row(one, problem.labels) for one in totals], dtype=float).reshape(-1, self._n)
        f, J = self.linear(problem.y0, problem.args)
        size = np.abs(rows) @ np.abs(J)
        wrong = np.abs(rows @ J) > 1e-8 * size.max(initial=0.0)
        if wrong.any() or (np.abs(rows @ f) > 1e-8 * (np.abs(rows) @ np.abs(f))).any():
            raise ValueError("totals are not conserved: a row of them times f is not zero at y0")
        return rows

    def _row(self, given: Any, labels: list[str]) -> Array:
        by_label = named("a row of totals", given)
        if by_label is None:
            row = real_numbers("a row of totals", given)
            if row.shape != (self._n,):
                raise ValueError(f"a row of totals has {self._n} coefficients, got {shown(given)}")
            return row
        row = np.zeros(self._n)
        require_names("a row of totals", by_label, labels, "components", complete=False)
        for name, x in by_label.items():
            row[labels.index(name)] = x
        return row

    def at(self, args: tuple[Any, ...], y0: Array, S0: Array | None = None) -> Found | NotFound:
        """Return the steady state for these arguments and this initial value.

        `S0`: the derivatives of y0 for the parameters, (n, k); None: no derivatives are wanted.
        """
        zero, still = self._staying(args, y0)
        run = _Approach(self, args, y0, still)
        with quietly(), np.errstate(all="ignore"):
            run.follow()
        if run.found is None:
            return NotFound(f"no steady state was found from y0 = {y0}: {run.reason}", run.y, run.f, run.time)
        y, f, J, G, time = run.found
        found = Found(y, f, time, None, self.rates(J, np.ones(self._n, dtype=bool), G))
        if S0 is None:
            return found
        slopes = self._slopes(y, y0, J, args, S0, still)
        if slopes is not None and (adds := self._adding(args, y0, S0, zero, still)):
            whole = self._slopes(y, y0, J, args, S0, np.zeros(self._n, dtype=bool)) if found.stable else None
            slopes[:, adds] = np.nan if whole is None else whole[:, adds]
        return found._replace(slopes=slopes)

    def _adding(self, args: tuple[Any, ...], y0: Array, S0: Array, zero: Array, still: Array) -> list[int]:
        """Return the parameters that add what is absent, so that fewer components stay constant."""
        found = []
        for j in np.flatnonzero(S0[zero].any(axis=0)).tolist():
            _, then = self._staying(args, np.where(S0[:, j] != 0, 1.0, y0))
            if (still & ~then).any():
                found.append(j)
        return found

    def _staying(self, args: tuple[Any, ...], y0: Array) -> tuple[Array, Array]:
        """Return the components that stay zero, and those that stay constant because of that, as truths."""
        zero, still = np.zeros((2, self._n), dtype=bool)
        if self._derivative.graph is not None:
            moving = {place_of(args, one.index, one.item) for _, one in self._own}
            p = layout_of(args).numbers
            constants = {i for i in np.flatnonzero(p == 0).tolist() if i not in moving}
            found = staying_zero(self._derivative.outputs, set(np.flatnonzero(y0 == 0).tolist()), constants)
            for truths, places in zip((zero, still), found, strict=True):
                truths[[*places]] = True
        return zero, still

    def rates(self, J: Array, moving: Array, G: Array) -> Array:
        """Return the eigenvalues of the Jacobian of these components, without a mass matrix for changes that conserve
        the invariants, whose Jacobian is G."""
        block = np.ix_(moving, moving)
        if self._mass is None:
            _, sizes, rows = np.linalg.svd(G[:, moving])
            free = rows[np.count_nonzero(sizes > _ZERO * sizes.max(initial=0.0)) :]
            return np.linalg.eigvals(free @ J[block] @ free.T)
        from scipy.linalg import eigvals

        found = eigvals(J[block], self._mass[block])
        return np.asarray(found[np.isfinite(found)])

    def system(self, J: Array, G: Array, D: Array, still: Array) -> tuple[Array, Array]:
        """Return [J; W M; G] for changes of the components in units of D, its rows divided by their sizes; and these
        sizes."""
        W = self.totals if self._mass is None else self.totals @ self._mass
        A = np.vstack([J, W, G]) * D
        A[:, still] = A[np.flatnonzero(still)] = 0.0  # of the rows of constant components roundoff is left
        lengths = np.linalg.norm(A, axis=1)
        lengths[lengths == 0] = 1.0
        return A / lengths[:, None], lengths

    def _slopes(self, y: Array, y0: Array, J: Array, args: tuple[Any, ...], S0: Array, still: Array) -> Array | None:
        """Return S with J S = -∂f/∂p, W M S = W M S0, and the values of invariants; constant components keep S0.
        None: there is no single one."""
        k = len(self._own)
        fp = self.derivative(args).tangent(self.t0, np.vstack([y, np.zeros((k, self._n))])).T
        D = sizes_of(y, y0)
        A, lengths = self.system(J, self.level(y, args, y0)[1], D, still)
        moving = ~still
        if moving.any() and np.linalg.matrix_rank(A[:, moving], tol=_ZERO) < moving.sum():
            return None
        right = np.zeros((len(A), S0.shape[1]))
        right[: self._n, [j for j, _ in self._own]] = -fp
        right[: self._n] -= J @ S0  # of S - S0
        right[self._n + len(self.totals) :] = self._level_slopes(y, y0, args, S0)
        change = np.zeros_like(S0)
        if moving.any():
            right /= lengths[:, None]
            change[moving] = np.linalg.lstsq(A[:, moving], right, rcond=_ZERO)[0]
            left = (A @ change - right)[~np.append(still, np.zeros(len(A) - self._n, dtype=bool))]
            if (np.abs(left) > _CONSISTENT * (1 + np.abs(right).max(axis=0))).any():
                return None
        return np.asarray(S0 + D[:, None] * change)


def is_stable(rates: Array) -> bool:
    """Return whether no eigenvalue has a positive real part, beyond roundoff."""
    return not len(rates) or bool(rates.real.max() <= _GROWS * np.abs(rates).max())


def sizes_of(y: Array, y0: Array) -> Array:
    """Return the sizes of components: those far below the largest, now or at the start, count as of a part of that."""
    largest = max(np.abs(y).max(initial=0.0), np.abs(y0).max(initial=0.0)) or 1.0
    return np.maximum(np.abs(y), _FLOOR * largest)


class _Approach:
    """A run towards a steady state, and Newton's method from its steps."""

    def __init__(self, states: SteadyStates, args: tuple[Any, ...], y0: Array, still: Array) -> None:
        self._states, self._args, self._y0, self._still = states, args, y0, still
        self._next, self._end, self._t0 = 0.0, np.inf, states.t0
        self._atol = _ATOL * (np.abs(y0).max(initial=0.0) or 1.0)
        self.found: tuple[Array, Array, Array, Array, float] | None = None
        self.y, self.f, self.time, self.reason = y0, np.zeros(len(y0)), 0.0, ""

    def follow(self) -> None:
        """Run until a steady state is found."""
        states = self._states
        self.f, J = states.linear(self._y0, self._args)
        D = sizes_of(self._y0, self._y0)
        rate = max(np.abs(J * D / D[:, None]).sum(axis=1).max(initial=0.0), np.abs(self.f / D).max(initial=0.0))
        self._next = 1 / rate if rate > 0 and np.isfinite(rate) else 0.0
        self._end = _LONGEST * (self._next or np.inf)
        if not self.f.any():
            self._try(0.0, self._y0, unstable=True)
            if self.found is not None:
                return
        problem = states._problem.replace(args=self._args, y0=self._y0)
        options: Any = {
            "rtol": _RTOL,
            "atol": self._atol,
            "keep": "end",
            "on_failure": "return",
            "callback": self._step,
        }
        sol = problem.solve(states._method, limits=Limits(steps=_MOST_STEPS), **options)
        if self.found is None:
            self.y, self.time = sol.y[:, -1], float(sol.t[-1]) - self._t0
            self.reason = self.reason or sol.message
            if np.isfinite(self.y).all():
                self.f = states.value(self.y, self._args)

    def _near(self, y: Array) -> Array:
        """Return how far from y a steady state may be that the run has come to."""
        return _NEAR * sizes_of(y, self._y0) + _NOISE * self._atol

    def _step(self, t: float, y: Array) -> bool:
        """Return whether the run has arrived."""
        T = t - self._t0
        if self._next > T:
            return False
        if self._end < T:
            self._try(T, np.array(y), unstable=True)  # special initial values lead to an unstable state, and stay there
            self.reason = f"after t = {t:.6g} the solution still moves"
            return True
        f, near = self._states.value(y, self._args), self._near(y)
        # What has died away to the noise of the run keeps a rate that is not small times T.
        if self._states._mass is None and not ((T * np.abs(f) <= near) | (np.abs(y) <= near)).all():
            return False
        self._try(T, np.array(y))
        self._next = _LATER * T
        return self.found is not None

    def _try(self, T: float, y: Array, *, unstable: bool = False) -> None:
        """Newton's method from a state of the run; what it finds is accepted if it is near, and stable unless unstable
        states count: the solution passes by these, except where it starts at one or has stayed there."""
        states, begun, near = self._states, y, self._near(y)
        W = states.totals if states._mass is None else states.totals @ states._mass
        step = np.full(len(y), np.inf)
        for _ in range(_ITERATIONS):
            f, J = states.linear(y, self._args)
            if not (np.isfinite(f).all() and np.isfinite(J).all()):
                return
            E = sizes_of(y, self._y0)
            left, G = states.level(y, self._args, self._y0)
            A, lengths = states.system(J, G, E, self._still)
            right = np.concatenate([-f, W @ (self._y0 - y), left]) / lengths
            step = E * np.linalg.lstsq(A, right, rcond=_ZERO)[0]
            y = y + step
            if not (np.abs(y - begun) <= near).all():
                return
            if (np.abs(step) <= states._tol * sizes_of(y, self._y0)).all():
                break
        else:
            return
        f, J = states.linear(y, self._args)
        if not (np.isfinite(f).all() and np.isfinite(J).all()):
            return
        _, G = states.level(y, self._args, self._y0)
        part = states._tol if unstable else _CONSISTENT  # a singular matrix leaves f where its least squares end
        at_rest = np.abs(f) <= part * (np.abs(J) @ sizes_of(y, self._y0))
        if not (at_rest | self._still).all() or not (unstable or is_stable(states.rates(J, ~self._still, G))):
            return
        self.found = y, f, J, G, T


class _Frozen:
    """f(t0, y, inputs at t0, *args) as a function of (t, y, *args)."""

    def __init__(self, fun: Any, t0: float, inputs: Sequence[Any] = ()) -> None:
        self.fun, self.t0, self.inputs = fun, t0, [one(t0) for one in inputs]
        self.__name__ = getattr(fun, "__name__", "f")

    def __call__(self, t: float, y: Any, *args: Any) -> Any:
        return self.fun(self.t0, y, *self.inputs, *args)
