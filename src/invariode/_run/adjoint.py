"""The gradient of a scalar with respect to many parameters, by one run backwards.

For G(y(t_1), y(t_2), ..., p) + ∫ g(t, y, p) dt, with μ = 0 behind the last t_i,

    μ' = −(∂f/∂y)ᵀ λ − (∂g/∂y)ᵀ,   Mᵀ λ = μ,   μ(t_i⁻) = μ(t_i⁺) + (∂G/∂y(t_i))ᵀ,
    d/dp = μ(t_0)ᵀ ∂y0/∂p + ∫ (λᵀ ∂f/∂p + ∂g/∂p) dt + ∂G/∂p

(Y. Cao, S. Li, L. Petzold and R. Serban, SIAM J. Sci. Comput. 24, 2003, 1076-1089). y is that of the continuous
solution. The integral is a quadrature over the steps of λ, so that the parameters are no unknowns of the run.

Where a solution is held on r(t, y, p) = c(p), its sensitivities are tangent: R S = c' − ∂r/∂p. So ∂G/∂y enters by its
tangential part alone, ∂G/∂y − νᵀ R with ν = (R W² Rᵀ)⁺ R W² (∂G/∂y)ᵀ, and the rest is νᵀ (c' − ∂r/∂p): the transpose of
what the run does to S in a step that ends there.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, real_numbers, shown, warn
from .._base.types import MethodName
from .._functions.directional import Directional, Given, Point
from .._problem.breakpoints import Breakpoint, to_breakpoints
from .._problem.description import Description
from .._problem.invariants import AccuracyWarning
from .._problem.matrices import is_sparse
from .._problem.methods import find_method
from .._problem.options import Options
from .._problem.sensitivities import Sensitivities, SensitivitiesLike
from .._results.result import Result
from .plan import ordered_breakpoints
from .variations import given_derivatives, require_possible

#: Points of Gauss's quadrature in each step of λ: of order 10, beyond which the continuous solution is not smooth.
_POINTS = 5
#: Of the largest tolerance of λ, so that components on which nothing depends have one.
_LEAST_PART = 1e-8


class Objective(NamedTuple):
    """G + ∫ g dt.

    Attributes
    ----------
    times : ndarray, (m,)
        Where G takes the solution.
    costs : ndarray, (n, m)
        Its derivatives with respect to the solution there.
    direct : ndarray, (k,)
        Its derivatives with respect to parameters.
    integrand : callable or None
        g(t, y, *args).
    """

    times: Array
    costs: Array
    direct: Array
    integrand: Any


class Forward(NamedTuple):
    """The run whose solution it is.

    Attributes
    ----------
    problem, method, options
        What was solved.
    solve : callable
        (problem, method, options) -> solution.
    t : float
        Where it ended.
    solution : Result
        With its continuous solution.
    """

    problem: Description
    method: MethodName
    options: Options
    solve: Callable[[Description, MethodName, Options], Result]
    t: float
    solution: Result


def gradient(
    run: Forward,
    dG_dy: ArrayLike | None,
    dG_dp: ArrayLike | None,
    wrt: SensitivitiesLike | None,
    t: ArrayLike | None,
    integrand: Any,
) -> Array:
    """See `Solution.gradient`."""
    problem = run.problem
    if wrt is not None:
        problem = problem.replace(sensitivities=wrt)
    elif problem.sensitivities is None:
        problem = problem.replace(sensitivities=Sensitivities())
    if not run.solution.success and t is None:
        raise ValueError(
            f"gradient: the run ended at t = {run.t} without success ({run.solution.message}); give times that it has "
            "reached as t="
        )
    adjoint = _Adjoint(run, problem)
    return adjoint.gradient(_objective(run.solution, run.t, dG_dy, dG_dp, t, integrand, adjoint.k))


class _Adjoint:
    """The equations of λ along a solution."""

    def __init__(self, run: Forward, problem: Description) -> None:
        self._run, self._sol, self._problem = run, run.solution, problem
        if self._sol.sol is None:
            raise ValueError("gradient needs the continuous solution: solve with adjoint=True, or with dense_output")
        self._names = problem.parameters()
        self.n, self.k = len(problem.y0), len(self._names)
        self._at = Point(problem.t_span[0], problem.y0)
        self._require_possible()
        fun, given = given_derivatives(problem, self._names)
        self._slope = self._derivatives(fun, "fun", self.n, given)
        self._tell_of_jumps()
        if self._slope.switches(self._at):
            raise ValueError(
                "gradient: fun jumps where its conditions change, and the adjoint does not follow that: use "
                "sensitivities=, which does"
            )

    def _require_possible(self) -> None:
        problem = self._problem
        require_possible(problem, self._names)
        if callable(problem.matrices.mass):
            raise ValueError("gradient: the mass matrix must be constant: use sensitivities=, or solve for y' in fun")
        if problem.bounds is not None:
            raise ValueError(
                "gradient: the adjoint does not follow components that rest at bounds (nonnegative=, bounds=): use "
                "sensitivities=, which does"
            )
        acting = [event.__name__ for event in problem.events if event.action is not None]
        acting += [f"at t = {point.t}" for point in self._breakpoints if point.action is not None]
        if acting:
            raise ValueError(
                f"gradient: the solution jumps by actions ({', '.join(acting)}), which the adjoint does not follow: "
                "use sensitivities=, which does"
            )

    def _tell_of_jumps(self) -> None:
        """A warning if f has jumped where there is no breakpoint."""
        jumps = [t for t in self._sol.stats.discontinuities if t not in {point.t for point in self._breakpoints}]
        if jumps:
            warn(
                f"gradient: fun looks discontinuous at t = {jumps[0]:.6g}. If that time depends on y or on parameters, "
                "the gradient is wrong; if not, give it as a breakpoint",
                AccuracyWarning,
            )

    @cached_property
    def _breakpoints(self) -> list[Breakpoint]:
        given = self._run.options.get("breakpoints")
        return ordered_breakpoints(self._problem, () if given is None else to_breakpoints("breakpoints", given))

    def _derivatives(self, fun: Any, called: str, m: int | None, given: Given | None = None) -> Directional:
        return Directional(
            fun, self._problem.args, self._names, self.n, given, at=self._at, m=m, called=called, moves_t=False
        )

    @cached_property
    def _mass(self) -> Array | None:
        """Mᵀ; None: the identity."""
        mass = self._problem.matrices.mass
        if mass is None:
            return None
        found = np.asarray(mass.toarray() if is_sparse(mass) else mass, dtype=float).T
        if np.linalg.matrix_rank(found) < self.n:
            raise ValueError(
                "gradient: the mass matrix is singular: use sensitivities=, which takes algebraic equations"
            )
        return found

    def _multiplier(self, mu: Array) -> Array:
        """λ."""
        return mu if self._mass is None else np.asarray(np.linalg.solve(self._mass, mu))

    # ------------------------------------------------------------------------------------------------- on the manifold

    @cached_property
    def _laws(self) -> list[tuple[Directional, Array]]:
        """Of each invariant r = c: its derivatives, and dc/dp (m, k)."""
        found = []
        for one in self._problem.invariants:
            jac = one.jac if callable(one.jac) and not hasattr(one.jac, "address") else None
            law = self._derivatives(one.fun, f"invariant {one.fun}", None, Given(jac))
            start = np.vstack([self._at.y, self._start.T])
            rate = law.tangent(self._at.t, start).T if one.value is None else np.zeros((law.m, self.k))
            found.append((law, rate))
        return found

    @cached_property
    def _start(self) -> Array:
        """∂y0/∂p."""
        assert self._problem.sensitivities is not None
        return self._problem.sensitivities.start(self._names, self._problem.args, self.n)

    def _tangential(self, t: float, y: Array, cost: Array) -> tuple[Array, Array]:
        """The tangential part of ∂G/∂y, and what the rest adds to the gradient."""
        if not self._laws:
            return cost, np.zeros(self.k)
        R = np.vstack([law.jacobian(t, y) for law, _ in self._laws])
        w = self._weights(y)
        nu = np.linalg.lstsq(w[:, None] * R.T, w * cost, rcond=None)[0]
        none = np.zeros((self.k, self.n))
        rates = [rate - law.columns(t, y, np.zeros(self.k), none, np.eye(self.k)).T for law, rate in self._laws]
        return cost - R.T @ nu, nu @ np.vstack(rates)

    def _weights(self, y: Array) -> Array:
        """Of the error test. (Of a component that is 0, with atol = 0, the largest.)"""
        rtol, atol = (np.asarray(one, dtype=float) for one in (self._sol._rtol, self._sol._atol))
        w = np.maximum(np.abs(y), atol / rtol)
        return np.where(w == 0, w.max() or 1.0, w)

    # ------------------------------------------------------------------------------------------------------- backwards

    def gradient(self, objective: Objective) -> Array:
        """The derivative of G + ∫ g dt, of shape (k,)."""
        t0, tf = self._problem.t_span[0], self._run.t
        y = self._sol.sol(objective.times)
        parts = [self._tangential(*one) for one in zip(objective.times.tolist(), y.T, objective.costs.T, strict=True)]
        total = objective.direct + sum((beside for _, beside in parts), np.zeros(self.k))
        jumps: dict[float, Array] = {}
        for time, (cost, _) in zip(objective.times.tolist(), parts, strict=True):
            jumps[time] = jumps.get(time, 0) + cost
        g = None
        if objective.integrand is not None:
            g = self._derivatives(objective.integrand, "integrand", 1)
        if tf == t0:
            return np.asarray(total + sum(jumps.values(), np.zeros(self.n)) @ self._start)
        last = jumps.pop(tf, np.zeros(self.n))
        first = jumps.pop(t0, np.zeros(self.n))
        mu = self._backwards(g, last, jumps, self._sizes(objective, y, g))
        return np.asarray(total + (mu.y[:, -1] + first) @ self._start + self._integral(g, mu))

    def _sizes(self, objective: Objective, states: Array, g: Directional | None) -> Array:
        """The sizes of μ that matter: by which a change of y within its weights changes G + ∫ g dt by as much as all
        changes within theirs together."""
        t0, tf = self._problem.t_span[0], self._run.t
        costs = [*zip(states.T, objective.costs.T, strict=True)]
        if g is not None:
            times = [t0, 0.5 * (t0 + tf), tf]
            along = zip(times, self._sol.sol(times).T, strict=True)
            costs += [(y, abs(tf - t0) / len(times) * g.jacobian(t, y)[0]) for t, y in along]
        weights = np.array([self._weights(y) for y, _ in costs])
        size = sum(float(w @ np.abs(cost)) for w, (_, cost) in zip(weights, costs, strict=True))
        return np.asarray(size / weights.max(axis=0))

    def _backwards(self, g: Directional | None, last: Array, jumps: dict[float, Array], sizes: Array) -> Result:
        """μ as a function of s = t_f − t, whose smallest steps are shorter than those at t_f."""
        slope, solution, n = self._slope, self._sol.sol, self.n
        t0, tf = self._problem.t_span[0], self._run.t

        def rate(s: float, mu: Array) -> Array:
            y = solution(tf - s)
            found = slope.transposed(tf - s, y, self._multiplier(mu))[:n]
            return found if g is None else found + g.jacobian(tf - s, y)[0]

        def jacobian(s: float, mu: Array) -> Array:
            found = slope.jacobian(tf - s, solution(tf - s)).T
            return found if self._mass is None else np.linalg.solve(self._mass.T, found.T).T

        points: dict[float, Any] = {tf - point.t: None for point in self._breakpoints}
        points |= {tf - time: (lambda s, mu, cost=cost: mu + cost) for time, cost in jumps.items()}
        method, rtol = self._run.method, np.max(self._sol._rtol)
        implicit = "jac" in find_method(method)[0].options
        adjoint = Description(rate, (0.0, tf - t0), last, jac=jacobian if implicit else None, name="the adjoint")
        atol = rtol * np.maximum(sizes, _LEAST_PART * sizes.max(initial=0))
        options: Options = {
            "rtol": rtol,
            "atol": np.maximum(atol, np.finfo(float).tiny),
            "dense_output": True,
            "breakpoints": points,
            "max_step": np.inf,
            "on_failure": "raise",
        }
        return self._run.solve(adjoint, method, options)

    def _integral(self, g: Directional | None, mu: Result) -> Array:
        """∫ (λᵀ ∂f/∂p + ∂g/∂p) dt from the start to the end."""
        nodes, weights = np.polynomial.legendre.leggauss(_POINTS)
        lengths = np.diff(mu.t)
        begins, lengths = mu.t[:-1][lengths != 0], lengths[lengths != 0]
        places = (begins[:, None] + 0.5 * lengths[:, None] * (1 + nodes)).ravel()
        parts = (0.5 * lengths[:, None] * weights).ravel()
        times = self._run.t - places
        total = np.zeros(self.k)
        for t, part, y, here in zip(times.tolist(), parts, self._sol.sol(times).T, mu.sol(places).T, strict=True):
            total += part * self._slope.transposed(t, y, self._multiplier(here))[self.n :]
            if g is not None:
                total += part * g.transposed(t, y, np.ones(1))[self.n :]
        return total


def _objective(
    sol: Result,
    t_end: float,
    dG_dy: ArrayLike | None,
    dG_dp: ArrayLike | None,
    t: ArrayLike | None,
    integrand: Any,
    k: int,
) -> Objective:
    """As it is given, with shapes checked."""
    n = len(sol.y)
    if dG_dy is None and integrand is None and dG_dp is None:
        raise ValueError("gradient needs dG_dy, the derivative of a scalar with respect to y, or an integrand g(t, y)")
    direct = np.zeros(k) if dG_dp is None else real_numbers("dG_dp", dG_dp)
    if direct.shape != (k,):
        raise ValueError(f"dG_dp must have one number for each of {k} parameters, got {shown(dG_dp)}")
    costs = np.zeros((n, 1)) if dG_dy is None else real_numbers("dG_dy", dG_dy)
    if t is not None:
        times = np.atleast_1d(real_numbers("t", t))
    else:
        times = np.array([t_end]) if costs.shape in ((n,), (n, 1)) else np.asarray(sol.t)
    if costs.ndim == 1:
        costs = costs[:, None]
    if times.ndim != 1 or costs.shape != (n, len(times)):
        raise ValueError(
            f"dG_dy must have shape ({n},), at the end, or ({n}, m) with m times t, which are those of the solution if "
            f"t is left out; got {shown(dG_dy)} and {len(times)} times"
        )
    low, high = sol.sol.t_min, sol.sol.t_max
    if not ((times >= low) & (times <= high)).all():
        raise ValueError(f"t of gradient must be between {low} and {high}, where the solution is, got {shown(t)}")
    return Objective(times, costs, direct, integrand)
