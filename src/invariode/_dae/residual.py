"""F(t, y, y') = 0 as it stands, for functions that cannot be traced, of index 0 and 1.

F depends on y' by the r combinations w_d' that the constant null space of ∂F/∂y' leaves. With its basis V, whose
vectors have a component of their own each, y = E w_d + Vᵀ w_a, where E has the units of the other components. Then

    w_d' = z,   0 = F(t, E w_d + Vᵀ w_a, E z)

is of index 1 in (w_d, w_a, z) where (F_y Vᵀ, F_y' E) is regular: where F is of index 0 or 1. The formulas of ode15s and
radau, applied to it, are those of F(t, y, (α y + β) / h) = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from .._base.arguments import ATOL, EPS, RTOL, Array, shown
from .._base.matrices import as_matrix, is_sparse
from .._base.types import EventsLike, MethodName, OnFailure
from .._linear.least_norm import Ended, newton
from .._linear.null_space import null_space
from .._problem.events import to_events
from .._problem.grouped import bandwidth
from .._problem.methods import find_method
from .._problem.options import Options
from .._problem.problem import Problem
from .._results.solution import Solution
from .._run.run import concluded
from .dae_solution import in_unknowns
from .functions_of_unknowns import ThroughUnknowns
from .linear_systems import SINGULAR, condition

#: Where ∂F/∂y' is formed: distances from the start in units of 1 + |y|.
_DISTANCES, _SEED = (0.0, 1e-3, 1e-2), 11
#: Increments of central differences, in units of 1 + |y|; what they leave of zeros, with room.
_INCREMENT = EPS ** (1 / 3)
_ROUNDOFF = 1e-6
#: Derivatives below it are compared with it.
_SMALL = 1e-3
#: Tolerances of z in units of those of y: errors of derivatives are not tested, as in other codes for F = 0. It stands
#: for infinity, which atol does not take: on the problems of the tests 1e8 to 1e14 give the same steps.
_UNTESTED = 1e10


class ResidualForm:
    """F as a semi-explicit system of u = (w_d, w_a, z).

    - `F`: ``F(t, y, yp, *args)``
    - `t`: the initial time
    - `y`, `yp`, (n,): initial values, or guesses
    - `args`: further arguments of F
    - `names`: names of the unknowns

    Attributes:
    - `start`, (n + r,): u at the start
    - `mass`: the singular mass matrix of the system

    Raises ValueError: F returns another number of values than y has; or the index is above 1, or the combinations
    change.
    """

    def __init__(
        self, F: Callable[..., Any], t: float, y: Array, yp: Array, args: tuple[Any, ...], names: Sequence[str]
    ) -> None:
        self.F, self.n, self.calls = F, len(y), 0
        self.names = list(names)
        size = len(self.residual(t, y, yp, *args))
        if size != self.n:
            raise ValueError(f"F returns {size} residuals for {self.n} unknowns: as many equations are needed")
        self.V, of_yp = self._null_space(t, y, yp, args)
        one_vector = np.count_nonzero(self.V, axis=0) == 1  # components in which only one vector of the basis is not 0
        self.free = np.array([np.flatnonzero((row == 1) & one_vector)[0] for row in self.V], dtype=int)
        self.bound = np.setdiff1d(np.arange(self.n), self.free)
        self.r = len(self.bound)
        self.mass = np.diag(np.concatenate([np.ones(self.r), np.zeros(self.n)]))
        A = np.hstack([self._along(t, y, yp, args, self.V, of_yp=False), of_yp[:, self.bound]])
        self._require_index_1(t, A)
        self.start = self._consistent(t, np.concatenate([self.states(y), self._combined(yp)]), args, A)

    def residual(self, t: float, y: Array, yp: Array, *args: Any) -> Array:
        """Return F, as an array."""
        self.calls += 1
        found = np.asarray(self.F(t, y, yp, *args))
        if found.dtype.kind == "c":
            raise TypeError("F returns complex values: write complex equations in real and imaginary parts")
        try:
            return np.atleast_1d(found.astype(float, copy=False)).ravel()
        except (TypeError, ValueError):
            raise TypeError(f"F must return {self.n} numbers, got {shown(found)}") from None

    def __call__(self, t: float, u: Array, *args: Any) -> Array:
        """Return the right-hand side of the system."""
        z = u[self.n :]
        return np.concatenate([z, self.residual(t, self.y(u), self.yp(u), *args)])

    def y(self, u: Array) -> Array:
        """Return y at u, or at several of them in columns."""
        found = np.zeros((self.n, *u.shape[1:]))
        found[self.bound] = u[: self.r]
        found += self.V.T @ u[self.r : self.n]
        return found

    def yp(self, u: Array) -> Array:
        """Return a y' with F = 0 at u: that part of it on which F depends."""
        found = np.zeros((self.n, *u.shape[1:]))
        found[self.bound] = u[self.n :]
        return found

    def states(self, y: Array) -> Array:
        """Return (w_d, w_a) of y."""
        return np.concatenate([self._combined(y), y[self.free]])

    def _combined(self, y: Array) -> Array:
        found: Array = y[self.bound] - self.V[:, self.bound].T @ y[self.free]
        return found

    def jacobian(self, rtol: float, atol: Array, given: Any, patterns: tuple[Any, Any] | None) -> Callable[..., Any]:
        """Return the Jacobian of the system: from ``given(t, y, yp, *args)``, the pair (∂F/∂y, ∂F/∂y'), or by forward
        differences of F, in increments of √ε max(|y|, atol / rtol), of columns in groups if there are patterns.

        The increments are fixed: those that follow the change of f, as in differences of other problems, would follow
        that of F, which is 0 along the solution.
        """
        floor, root, n = atol / rtol, EPS**0.5, self.n
        bound = {*self.bound.tolist()}
        found: list[Any] = [None, None] if patterns is None else [one.tocsc() for one in patterns]
        alone = [[j] for j in range(n)], [[j] for j in sorted(bound)]  # the combinations do not need other y_j'
        groups = [one if pattern is None else _groups(pattern) for one, pattern in zip(alone, found, strict=True)]

        def differences(t: float, y: Array, yp: Array, args: tuple[Any, ...], F: Array, of_yp: bool) -> Any:
            pattern, at = found[of_yp], yp if of_yp else y
            steps = root * np.maximum(np.abs(at), np.maximum(floor, _SMALL) if of_yp else floor)
            exact = (at + steps) - at
            dense = np.zeros((n, n)) if pattern is None else None
            values = np.zeros(0 if pattern is None else pattern.nnz)
            for group in groups[of_yp]:
                moved = at.copy()
                moved[group] += steps[group]
                change = self.residual(t, *((y, moved) if of_yp else (moved, yp)), *args) - F
                for j in group:
                    if dense is not None:
                        dense[:, j] = change / exact[j]
                    else:
                        rows = slice(pattern.indptr[j], pattern.indptr[j + 1])
                        values[rows] = change[pattern.indices[rows]] / exact[j]
            return dense if dense is not None else type(pattern)((values, pattern.indices, pattern.indptr), (n, n))

        def formed(t: float, u: Array, *args: Any) -> Any:
            y, yp = self.y(u), self.yp(u)
            if given is None:
                F = self.residual(t, y, yp, *args)
                parts = [differences(t, y, yp, args, F, of_yp) for of_yp in (False, True)]
            else:
                pair = given(t, y, yp, *args)
                if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                    raise ValueError(f"jac of F must return the pair (∂F/∂y, ∂F/∂y'), got {shown(pair)}")
                parts = [as_matrix("jac of F", one, (n, n), at=t) for one in pair]
            return self._of_system(*parts)

        return formed

    def _of_system(self, of_y: Any, of_yp: Any) -> Any:
        """Return the Jacobian of the system from ∂F/∂y and ∂F/∂y', sparse if one of them is."""
        if not (is_sparse(of_y) or is_sparse(of_yp)):
            upper = np.hstack([np.zeros((self.r, self.n)), np.eye(self.r)])
            return np.vstack([upper, np.hstack([of_y[:, self.bound], of_y @ self.V.T, of_yp[:, self.bound]])])
        from scipy import sparse as scipy_sparse

        sparse: Any = scipy_sparse
        Fy, Fyp = sparse.csc_array(of_y), sparse.csc_array(of_yp)
        lower = [Fy[:, self.bound], Fy @ sparse.csc_array(self.V.T), Fyp[:, self.bound]]
        above = [sparse.csc_array((self.r, self.n)), sparse.eye_array(self.r)]
        return sparse.vstack([sparse.hstack(above), sparse.hstack(lower)], format="csc")

    # ------------------------------------------------------------------------------------------------------------------
    # Structure

    def _along(self, t: float, y: Array, yp: Array, args: tuple[Any, ...], directions: Array, of_yp: bool) -> Array:
        """Return the derivatives of F in y' or in y along the rows of `directions`, in columns, by central
        differences."""
        moved = yp if of_yp else y
        found = np.empty((self.n, len(directions)))
        for k, direction in enumerate(directions):
            step = _INCREMENT * (1 + np.abs(moved[direction != 0]).max())
            ends = (moved + sign * step * direction for sign in (1, -1))
            one, other = (self.residual(t, *((y, at) if of_yp else (at, yp)), *args) for at in ends)
            found[:, k] = (one - other) / (2 * step)
        return found

    def _null_space(self, t: float, y: Array, yp: Array, args: tuple[Any, ...]) -> tuple[Array, Array]:
        """Return the null space of ∂F/∂y' at the first of several points, a basis by rows, and ∂F/∂y' there. It must
        be the null space at the others too."""
        rng = np.random.default_rng(_SEED)
        V, first, floor = None, np.zeros((self.n, self.n)), np.zeros(self.n)
        for distance in _DISTANCES:
            near = [one + distance * rng.standard_normal(self.n) * (1 + np.abs(one)) for one in (y, yp)]
            directions = np.eye(self.n) if V is None else V
            with np.errstate(all="ignore"):
                A = self._along(t, near[0], near[1], args, directions, of_yp=True)
            if not np.isfinite(A).all():
                continue
            if V is None:
                largest = np.abs(A).max(axis=1, initial=0)
                floor = _ROUNDOFF * np.where(largest > 0, largest, 1)
                V, first = null_space(np.where(np.abs(A) > floor[:, None], A, 0.0), _ROUNDOFF).vectors, A
            elif (np.abs(A) > floor[:, None] * np.maximum(1.0, np.abs(V).max(axis=1, initial=0))).any():
                raise ValueError(
                    "the combinations of derivatives in F change along the solution: ∂F/∂y' is singular at the start, "
                    "and loses rank there only, or its null space depends on t and y"
                )
        if V is None:
            raise ValueError(f"F cannot be evaluated near the start, t = {t:.6g}: give other initial values")
        return V, first

    def _determining(self, t: float, y: Array, yp: Array, args: tuple[Any, ...]) -> Array:
        """Return (F_y Vᵀ, F_y' E): how F determines (w_a, z)."""
        of_yp = self._along(t, y, yp, args, np.eye(self.n)[self.bound], of_yp=True)
        return np.hstack([self._along(t, y, yp, args, self.V, of_yp=False), of_yp])

    def _consistent(self, t: float, u: Array, args: tuple[Any, ...], A: Array) -> Array:
        """Return u with F = 0 and this w_d, by Newton's iteration from u, where F determines the rest by A; u itself,
        which the run then tests, if none is near."""
        first = u[self.r :]

        def values(rest: Array) -> tuple[Array, Array]:
            at = np.concatenate([u[: self.r], rest])
            return self.y(at), self.yp(at)

        def slopes(rest: Array) -> tuple[Array, Array]:
            found = A if rest is first else self._determining(t, *values(rest), args)
            return found, np.abs(found) @ np.abs(rest)

        found = newton(
            lambda rest: self.residual(t, *values(rest), *args), slopes, first, np.maximum(1.0, np.abs(first))
        )
        return np.concatenate([u[: self.r], found.x]) if found.ended is Ended.SETTLED else u

    def _require_index_1(self, t: float, A: Array) -> None:
        if len(self.free) and not condition(A) > max(SINGULAR, EPS**0.5):
            algebraic = ", ".join(self.names[j] for j in self.free)
            raise ValueError(
                f"its index is above 1: the equations do not determine {algebraic} together with the derivatives at "
                f"t = {t:.6g}"
            )

    def tolerances(self, atol: Any) -> tuple[Array, Array]:
        """Return the tolerances of y, and those of u."""
        each = np.asarray(atol, dtype=float)
        if each.shape not in ((), (self.n,)):
            raise ValueError(f"atol must be a number or have one value per unknown, {self.n}, got {shown(atol)}")
        each = np.broadcast_to(each, (self.n,)).copy()
        return each, np.concatenate([each[self.bound], each[self.free], _UNTESTED * each[self.bound]])


def _groups(pattern: Any) -> list[list[int]]:
    """Return groups of columns that have no row in common (A. R. Curtis, M. J. D. Powell and J. K. Reid, J. Inst. Math.
    Appl. 13 (1974) 117-119), each column in the first group that takes it."""
    groups: list[list[int]] = []
    taken: list[set[int]] = []
    for j in range(pattern.shape[1]):
        rows = {*pattern.indices[pattern.indptr[j] : pattern.indptr[j + 1]].tolist()}
        if not rows:
            continue
        for group, others in zip(groups, taken, strict=True):
            if not rows & others:
                group.append(j)
                others |= rows
                break
        else:
            groups.append([j])
            taken.append(rows)
    return groups


def patterns_of(n: int, jac_sparsity: Any, lband: int | None, uband: int | None) -> tuple[Any, Any] | None:
    """Return the patterns of ∂F/∂y and ∂F/∂y': a pair of them, or one for both, or bands; None: not known."""
    if jac_sparsity is None and lband is None and uband is None:
        return None
    from scipy import sparse

    if jac_sparsity is None:
        below, above = (bandwidth(name, one or 0, n) for name, one in (("lband", lband), ("uband", uband)))
        both: Any = sparse.diags_array(
            [np.ones(n)] * (below + above + 1), offsets=range(-below, above + 1), shape=(n, n)
        )
        return both.tocsc(), both.tocsc()
    if lband is not None or uband is not None:
        raise ValueError("give either jac_sparsity or lband and uband, not both")
    pair = jac_sparsity if isinstance(jac_sparsity, tuple) and len(jac_sparsity) == 2 else (jac_sparsity,) * 2
    made = [sparse.csc_array(as_matrix("jac_sparsity", one, (n, n))) for one in pair]
    return made[0], made[1]


class _Linear:
    """A linear function of the state, as `ValuesOverTime` of expressions."""

    def __init__(self, of: Callable[[Array], Array]) -> None:
        self._of = of

    def __call__(self, t: Array, states: Array, p: Array) -> Array:
        return self._of(states)

    def at(self, t: float, state: Array, p: Array) -> Array:
        """Return the values at one point."""
        return self._of(state)

    def general(self, t: Any, state: Any, p: Any) -> Array:
        """Return the values of other numbers than floats."""
        return self._of(np.asarray(state))


class _UnknownsAsTheyStand:
    """y and y' of a residual form, as `Unknowns` of a reduction."""

    def __init__(self, form: ResidualForm) -> None:
        self.y, self.yp = _Linear(form.y), _Linear(form.yp)


def solve_residual(
    form: ResidualForm,
    span: tuple[float, float],
    args: tuple[Any, ...],
    method: MethodName,
    events: EventsLike,
    name: str,
    options: Options,
    jac: Any,
    structure: tuple[Any, int | None, int | None],
) -> Solution:
    """Return the solution of F(t, y, y') = 0 in residual form; `structure`: jac_sparsity, lband and uband.

    `nfev` counts all calls of F, those for its structure and for Jacobians included.
    """
    if method == "auto":
        method = "ode15s"
    if find_method(method)[0].mass != "any":
        raise ValueError(f"F cannot be traced, and is solved as it stands by ode15s, radau or ode23t, not by {method}")
    patterns = patterns_of(form.n, *structure)
    if jac is not None and patterns is not None:
        raise ValueError("give either jac, or jac_sparsity or bands, which are for finite differences")
    unknowns, none = _UnknownsAsTheyStand(form), np.zeros(0)

    def after_action(
        t: float, state: Array, old: tuple[Array, Array], new: tuple[Array, Array], given: Sequence[Any]
    ) -> Array:
        return np.concatenate([form.states(new[0]), state[form.n :]])

    through = ThroughUnknowns(unknowns, after_action, none)
    on_failure = through.options(options)
    rtol = options.get("rtol", RTOL)
    of_y, options["atol"] = form.tolerances(options.get("atol", ATOL))
    problem = Problem(
        form,
        span,
        form.start,
        args=args,
        mass=form.mass,
        jac=form.jacobian(float(np.min(rtol)), of_y, jac, patterns),
        name=name,
        events=None if events is None else [through.event(one) for one in to_events(events)],
    )
    return _presented(form, unknowns, None, problem.solve(method, **options), on_failure)


def _presented(
    form: ResidualForm,
    unknowns: _UnknownsAsTheyStand,
    before: OnFailure | None,
    sol: Solution,
    on_failure: OnFailure | None = None,
) -> Solution:
    """Return a solution of the semi-explicit system in the unknowns of F."""
    on_failure = on_failure or before
    present = partial(_presented, form, unknowns, on_failure)
    found = in_unknowns(sol, unknowns, np.zeros(0), form.names, form, present)
    found["nfev"] = form.calls
    return concluded(found, on_failure)
