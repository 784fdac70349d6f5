"""The gradient of a scalar with respect to many parameters, by runs backwards.

For G(y(t_1), y(t_2), ..., p) + ∫ g(t, y, p) dt, with μ = 0 after the last t_i,

    μ' = −(∂f/∂y)ᵀ λ − (∂g/∂y)ᵀ,   Mᵀ λ = μ,   μ(t_i⁻) = μ(t_i⁺) + (∂G/∂y(t_i))ᵀ,
    d/dp = μ(t_0)ᵀ ∂y0/∂p + ∫ (λᵀ ∂f/∂p + ∂g/∂p) dt + ∂G/∂p

(Y. Cao, S. Li, L. Petzold and R. Serban, SIAM J. Sci. Comput. 24, 2003, 1076-1089). y is that of the continuous
solution. The integrals are quadratures in the same run: they are in its error test, since ∂f/∂p may change faster than
λ does, and in no linear system. If M is singular, of index 1, λ is the unknown, Mᵀ λ' = −(∂f/∂y + M')ᵀ λ − (∂g/∂y)ᵀ.

Where S⁺ = A S⁻ + B, at actions and where f jumps, μ⁻ = Aᵀ μ⁺, and Bᵀ μ⁺ is added to the gradient. There is a run
backwards for each piece between breakpoints and such jumps. While a component rests at a bound its S is 0, which is
such a jump where it arrives, and its μ pulls nothing: μ' = −(∂f/∂y)ᵀ M⁻ᵀ D μ, D_ii = 0.

Where a solution is held on invariants, costs go through the projection of its sensitivities (`adjoint_laws`). Functions
that only fall move no exact solution, nor its sensitivities: what they correct is error, and λ does without them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import LEAST_RTOL, Array, Weights, function, numbers, quietly, real_numbers, shown, warn
from .._base.failures import SolveError
from .._base.forks import cached_property
from .._base.types import MethodName
from .._functions.compiled import is_native
from .._functions.derivatives import Derivative, derivative_of
from .._functions.layout import layout_of
from .._functions.with_arguments import Point
from .._plan.call_errors import takes
from .._plan.plan import Plan, solver
from .._plan.planning import longest_step, make_plan, ordered_breakpoints
from .._problem.breakpoints import Breakpoint, to_breakpoints
from .._problem.core_problem import VariationTerms
from .._problem.events import roots_among
from .._problem.invariants import AccuracyWarning
from .._problem.methods import find_method
from .._problem.options import Options
from .._problem.parameters import ParameterName, values_of
from .._problem.problem import Problem
from .._problem.sensitivities import Sensitivities, SensitivitiesLike
from .._results.result import Result
from .._sensitivity.actions import Rate
from .._sensitivity.algebraic import dense_mass
from .._sensitivity.landings import Schedule, schedule_of
from .._sensitivity.mass_derivatives import AlgebraicOverTime, MassDerivatives, mass_derivatives, mass_rate
from .._sensitivity.pairs import AsPairs, event_of_pairs_in_complex, of_pairs, real_form, with_pairs
from .._sensitivity.variation_sizes import Sizes
from .._sensitivity.variations import Switching, followed, given_derivatives, require_possible
from .jumps import Call, Jump, Jumps, Occurrence, at_bounds, with_records
from .laws import Laws

#: The method of λ, where that of y takes some f only.
_OF_ANY: MethodName = "dop853"
#: Of the largest tolerance of λ, so that components on which nothing depends have one; and of a complex number, so that
#: it is not taken as real.
_LEAST_PART = 1e-8
#: The part of p̄ ∂G/∂p, in units of G, whose relative error is the smallest that the quadratures control: below it, the
#: integrand may be roundoff of terms that cancel.
_LEAST_OF_G = 1e-3


class CostFunctional(NamedTuple):
    """G + ∫ g dt."""

    times: Array  # (m,): times at which G depends on the solution
    costs: Array  # (n, m): its derivatives with respect to the solution there
    direct: Array  # (k,): its derivatives with respect to parameters
    integrand: Any  # callable: g(t, y, *args)


class Forward(NamedTuple):
    """The run whose solution it is."""

    #: problem, method, options: the problem that was solved, and how
    problem: Problem
    method: MethodName
    options: Options
    solve: Callable[[Problem, MethodName, Options], Result]  # (problem, method, options) -> solution
    t: float  # time at which the run ended
    solution: Result  # with its continuous solution


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
        if not problem.args:
            raise ValueError('gradient: the problem has no args; wrt="y0" are its initial values')
        problem = problem.replace(sensitivities=Sensitivities())
    if not run.solution.success and t is None:
        raise ValueError(
            f"gradient: the run ended at t = {run.t} without success ({run.solution.message}); give times that it has "
            "reached as t="
        )
    names = problem.parameter_names()
    require_possible(problem)
    for roots in roots_among(problem.events):
        if not roots.stateless and run.options.get("adjoint") == "checkpoints":
            raise ValueError(
                f"gradient: {roots!r} remember what they have done, so that no part of the run can be solved again: "
                "use adjoint=True, not 'checkpoints'"
            )
    functional = _functional(run, dG_dy, dG_dp, t, integrand, len(names))
    if problem.y0.dtype.kind == "c":
        return _of_complex(run, problem, functional)
    return _Adjoint(run, problem, names).gradient(functional)


def _of_complex(run: Forward, problem: Problem, functional: CostFunctional) -> Array:
    """The gradient of a complex problem, that of the pairs of real and imaginary parts. With respect to a complex
    initial value y0 it is ∂G/∂Re y0 − i ∂G/∂Im y0."""
    for one, value in zip(problem.parameter_names(), functional.direct, strict=True):
        if one.kind == "args" and np.imag(value):
            raise ValueError(f"dG_dp of {one.name} must be real, as G and args are, got {shown(value)}")
    form = real_form(problem, [], both_parts=True)
    costs = np.empty((2 * len(functional.costs), len(functional.times)))
    costs[0::2], costs[1::2] = functional.costs.real, -functional.costs.imag
    integrand = of_pairs(functional.integrand, complex_values=False)
    of_parts = _Adjoint(run, form.problem, form.names).gradient(
        CostFunctional(functional.times, costs, np.zeros(len(form.names)), integrand)
    )
    if all(one.kind == "args" for one in form.names):
        return functional.direct + of_parts
    found, place = [], 0
    for one in problem.parameter_names():
        if one.kind == "args":
            found.append(of_parts[place])
            place += 1
        else:
            found.append(complex(of_parts[place], -of_parts[place + 1]))
            place += 2
    return np.asarray(functional.direct + np.array(found))


class _Adjoint:
    """The equations of λ along a solution.

    - `run`: the run, perhaps of complex states
    - `problem`: the problem, of real ones: of pairs if the states of the run are complex
    - `names`: the parameters
    """

    def __init__(self, run: Forward, problem: Problem, names: Sequence[ParameterName]) -> None:
        self._run, self._problem, self._names = run, problem, names
        self._is_complex = run.problem.y0.dtype.kind == "c"
        self._follow(run.solution)
        self.n, self.k = len(problem.y0), len(names)
        self._total: Array = np.zeros(self.k)  # what is known of the gradient
        self._at = Point(problem.t_span[0], problem.y0)
        fun, given = given_derivatives(problem, names)
        self._slope = self._derivatives(fun, "fun", m=self.n, given=given, moves_t=False)
        self._calls: list[Call] = []
        conditions = self._conditions()
        self._rests = at_bounds(problem, self._sol, self._y, self._of_y.threshold, self._atol)
        jumps = Jumps(
            problem, names, self._derivatives, conditions, self._of_y.threshold, self._atol, self._calls, self._start.T
        )
        self._of_waiting = jumps.of_start
        jumps.follow_landings(self._schedule)
        self._jumps = jumps.of(self._sol, self._y, self._breakpoints, self._rests)
        if not run.solution.success and not jumps.last_was_taken(self._jumps, run.t, self._end_of_run()):
            self._jumps.pop()
        self._tell_of_jumps(bool(conditions))

    def _follow(self, sol: Result) -> None:
        """λ is that along this solution."""
        self._sol, self._y = sol, sol._run.continuous(sol)
        if self._y is None:
            raise ValueError(
                "gradient needs the continuous solution, or checkpoints, which are not in files: solve with "
                "adjoint=True, adjoint='checkpoints' or dense_output=True"
            )
        if self._is_complex:
            self._sol, self._y = with_pairs(sol), AsPairs(self._y)

    def _end_of_run(self) -> Array:
        end = np.asarray(self._run.solution._run.y)
        return end.view(float) if self._is_complex else end

    def _conditions(self) -> list[Switching]:
        """Return the conditions at which f jumps. With them as events, and with records of the calls of the actions of
        `Roots`, the solution is made again."""
        with quietly():  # what is not followed is an error
            found = followed(self._slope, self._derivatives, self._problem, [])
        roots = roots_among(self._problem.events)
        if not found:
            if self._slope.graph is not None and self._slope.graph.switches(self._at):
                raise ValueError(
                    "gradient: fun jumps where its conditions change, which is not followed with a mass matrix, if "
                    "inputs are compared, or with many conditions"
                )
            if not roots:
                return []
        run, record = self._run, self._calls
        events = [event_of_pairs_in_complex(one.event) if self._is_complex else one.event for one in found]
        located = run.problem.replace(events=[*with_records(run.problem.events, record), *events], sensitivities=None)
        sectioned = run.options.get("adjoint") == "checkpoints"
        options: Options = {
            **run.options,
            "dense_output": not sectioned,
            "keep": "end" if sectioned else None,
            "t_eval": None,
            "checkpoint": None,
            # These have let its steps pass.
            "callback": None,
            "max_steps": None,
            "limits": None,
            "on_failure": "return",
        }
        with quietly():  # the run has warned
            again = run.solve(located.replace(t_span=(located.t_span[0], run.t)), run.method, options)
        if again.t_end != run.t and again.status != 1:  # a terminal event may come a little earlier
            raise SolveError(
                f"gradient: with the conditions of fun as events, the run ended at t = {again.t_end}, not at {run.t}: "
                f"{again.message}"
            )
        self._calls = [*record]  # what is solved again in sections is not recorded
        self._follow(again)
        return found

    def _tell_of_jumps(self, followed: bool) -> None:
        """A warning if f has jumped where there is no breakpoint."""
        known = {point.t for point in self._breakpoints} | {self._run.t}  # at the end f is not used after it
        jumps = [t for t in self._sol.stats.discontinuities if t not in known]
        if jumps and not (followed and self._slope.knows_jumps):
            warn(
                f"gradient: fun looks discontinuous at t = {jumps[0]:.6g}. If that time depends on y or on parameters, "
                "the gradient is wrong; if not, give it as a breakpoint",
                AccuracyWarning,
            )

    @cached_property
    def _schedule(self) -> Schedule | None:
        """Times at which f changes its branch as a function of t alone."""
        with quietly():  # the run has warned
            found = schedule_of(self._run.problem, layout_of(self._run.problem.args))
            return found or schedule_of(self._problem, layout_of(self._problem.args), self._slope.outputs)

    @cached_property
    def _breakpoints(self) -> list[Breakpoint]:
        given = self._run.options.get("breakpoints")
        points = ordered_breakpoints(self._problem, () if given is None else to_breakpoints("breakpoints", given))
        low, high = sorted((self._problem.t_span[0], self._run.t))
        inside = [one for one in points if low <= one.t <= high]
        if self._schedule is not None:
            known = np.array([one.t for one in inside])
            inside += [Breakpoint(t, None) for t in self._schedule.landings.apart(low, high, known).tolist()]
        return [one._replace(action=of_pairs(one.action)) for one in inside] if self._is_complex else inside

    def _derivatives(self, fun: Any, called: str, m: int | None = None, **more: Any) -> Derivative:
        about: dict[str, Any] = {"at": self._at, "args": self._problem.args, "names": self._names, "called": called}
        return derivative_of(fun, (m, self.n), **about, **more)

    # -------------------------------------------------------------------------------------------------------- the mass

    @cached_property
    def _algebraic(self) -> AlgebraicOverTime | None:
        """The algebraic equations of a singular M."""
        found = AlgebraicOverTime(self._problem)
        return found if found.is_singular else None

    @cached_property
    def _mass_rate(self) -> Callable[[float], Array]:
        """M', of a singular M that is a function of t."""
        return mass_rate(self._problem, self._derivatives)

    def _multiplier(self, t: float, mu: Array) -> Array:
        """λ."""
        M = dense_mass(self._problem.matrices.mass, t, self._problem.args)
        return mu if M is None else np.asarray(np.linalg.solve(M.T, mu))

    # ------------------------------------------------------------------------------------------------- on the manifold

    @cached_property
    def _laws(self) -> Laws:
        return Laws(self._problem, self.k, self._derivatives, self._weights)

    @cached_property
    def _start(self) -> Array:
        """∂y0/∂p."""
        assert self._problem.sensitivities is not None
        return self._problem.sensitivities.start(self._names, self._problem.args, self.n)

    def _differential(self, t: float, y: Array, cost: Array) -> Array:
        """The cost as that of differential components alone; what the others add is counted."""
        if self._algebraic is None:
            return cost
        J = self._slope.jacobian(t, y)
        cost, multiplier = self._algebraic.at(t).differential(J, cost)
        self._total = self._total + self._of_parameters(t, y, multiplier)
        return cost

    def _of_parameters(self, t: float, y: Array, w: Array) -> Array:
        """wᵀ (∂f/∂p − (∂M/∂p) y')."""
        found = self._slope.transposed(t, y, w)[self.n :]
        return np.asarray(found if self._of_mass is None else found - self._of_mass(t, y) @ w)

    @cached_property
    def _of_mass(self) -> MassDerivatives | None:
        return mass_derivatives(self._problem, self._names, Rate(self._problem, self._atol, lambda: self._moving_slope))

    @property
    def _moving_slope(self) -> Derivative:
        """The derivatives of f, also with respect to t."""
        fun, given = given_derivatives(self._problem, self._names)
        return self._derivatives(fun, "fun", m=self.n, given=given, moves_t=True)

    @property
    def _atol(self) -> Array:
        return np.asarray(self._sol._atol, dtype=float)

    @property
    def _of_y(self) -> Weights:
        """The weights of y in the error test of the run."""
        return Weights(float(np.max(self._sol._rtol)), np.asarray(self._atol / self._sol._rtol))

    def _weights(self, y: Array) -> Array:
        """Return the weights of the error test at y (n,); for a component that is 0, with atol = 0, the largest."""
        w = np.maximum(np.abs(y), self._of_y.threshold)
        return np.where(w == 0, w.max() or 1.0, w)

    # ------------------------------------------------------------------------------------------------------- backwards

    def gradient(self, functional: CostFunctional) -> Array:
        """The derivative of G + ∫ g dt, of shape (k,)."""
        self._g = None
        self._total = functional.direct.astype(float)
        if functional.integrand is not None:
            self._g = self._derivatives(functional.integrand, "integrand", m=1, moves_t=False)
        t0, tf = self._problem.t_span[0], self._run.t
        states = self._y(functional.times)
        costs: dict[float, Array] = {}
        for t, cost in zip(functional.times.tolist(), functional.costs.T, strict=True):
            costs[t] = costs.get(t, 0) + cost
        if tf != t0:
            self._weigh(functional, states)
        mu = np.zeros(self.n)
        for piece in reversed(self._pieces(t0, tf)):
            mu = self._across(piece, mu, costs)
        for jump in reversed([one for one in self._jumps if one.t == t0]):
            mu = self._through(jump.found(), mu)
        mu, beside = self._laws.on_tangent(self._behind(t0), self._at.y, mu, taking=True)
        return np.asarray(self._total + beside + mu @ self._start + self._of_waiting())

    def _pieces(self, t0: float, tf: float) -> list[_Piece]:
        """The intervals between breakpoints, jumps and discontinuities that the run has found, with the jumps at their
        ends."""
        forward = 1.0 if tf >= t0 else -1.0
        inside = (
            {one.t for one in self._breakpoints} | {one.t for one in self._jumps} | {one.end for one in self._rests}
        )
        inside |= {t for t in self._sol.stats.discontinuities if forward * (tf - t) > 0}
        ends = sorted(inside - {t0} | {tf}, key=lambda t: forward * t)
        begins = [t0, *ends[:-1]]
        return [
            _Piece(a, b, [one for one in self._jumps if one.t == b != t0], self._moving(a, b))
            for a, b in zip(begins, ends, strict=True)
        ]

    def _moving(self, begin: float, end: float) -> Array:
        """Return a mask (n,) of the components that move between two times: 1, or 0 for those at rest at a bound."""
        found = np.ones(self.n)
        low, high = sorted((begin, end))
        for one in self._rests:
            if min(one.begin, one.end) <= low and high <= max(one.begin, one.end):
                found[one.component] = 0
        return found

    def _across(self, piece: _Piece, mu: Array, costs: dict[float, Array]) -> Array:
        """Return μ at the beginning of a piece from μ after its end. A cost at a jump is that of the state after it."""
        if piece.end == self._run.t and piece.end in costs:
            mu = mu + self._cost(piece.end, costs.pop(piece.end))
        takes = piece.end in self._times_of_values
        for one in reversed(piece.jumps):
            jump = one.found()
            mu, takes = self._through(jump, mu), takes and not jump.moves
        if takes:
            mu = self._taking_values(piece.end, mu)
        if piece.begin == piece.end:
            return mu
        low, high = sorted((piece.begin, piece.end))
        within = {t: self._cost(t, cost) for t, cost in costs.items() if low <= t <= high and t != piece.end}
        first = within.pop(piece.begin, np.zeros(self.n))
        end = self._backwards(piece, mu, within)
        return np.asarray((end if self._algebraic is None else self._algebraic.at(piece.begin).M.T @ end) + first)

    def _cost(self, t: float, cost: Array) -> Array:
        y = self._y(t)
        cost, beside = self._laws.on_tangent(self._behind(t), y, cost)
        self._total = self._total + beside
        return self._differential(t, y, cost)

    @cached_property
    def _times_of_values(self) -> set[float]:
        """Times at which invariants got new values."""
        return {jump.t for jump in self._sol._invariants.jumps}

    @cached_property
    def _times_of_breaks(self) -> set[float]:
        return {one.t for one in self._breakpoints}

    def _behind(self, t: float) -> float:
        """Return the time at which invariants are evaluated for t: just after t where they may jump."""
        forward = 1.0 if self._run.t >= self._problem.t_span[0] else -1.0
        return float(np.nextafter(t, forward * np.inf)) if t in self._times_of_breaks else t

    def _taking_values(self, t: float, mu: Array) -> Array:
        """μ before a breakpoint at which laws jump, though y does not, from that after it."""
        y = self._y(t)
        mu, beside = self._laws.on_tangent(self._behind(t), y, mu, taking=True)
        self._total = self._total + beside
        return self._differential(t, y, mu)

    def _through(self, jump: Jump, mu: Array) -> Array:
        """Return μ before a jump from μ after it."""
        if jump.moves:
            mu, beside = self._laws.on_tangent(self._behind(jump.t), jump.after, mu, taking=jump.reholds)
            self._total = self._total + beside
        cost_of_time = 0.0
        if self._g is not None:
            cost_of_time = float(self._g.value(jump.t, jump.before)[0] - self._g.value(jump.t, jump.after)[0])
        mu, beside = jump.transposed(mu, cost_of_time)
        self._total = self._total + beside
        return self._differential(jump.t, jump.before, mu)

    def _weigh(self, functional: CostFunctional, states: Array) -> None:
        """Finds which errors matter. μ: an error that changes G + ∫ g dt by as much as changes of all y within their
        weights do together. Quadratures: what errors of the forward sensitivities within their tolerances add up to,
        or where these are relative ones that part of the change of G with the parameter which the weights are of G."""
        t0, tf, g = self._problem.t_span[0], self._run.t, self._g
        costs = [*functional.costs.T]
        if g is not None:
            times = [t0, 0.5 * (t0 + tf), tf]
            along = self._y(times)
            costs += [abs(tf - t0) / len(times) * g.jacobian(t, y)[0] for t, y in zip(times, along.T, strict=True)]
            states = np.hstack([states, along])
        weights, shares = np.array([self._weights(y) for y in states.T]), np.abs(costs)
        size = float((weights * shares).sum())
        self._sizes = size / weights.max(axis=0)
        problem, wanted = self._problem, self._problem.sensitivities
        assert wanted is not None
        of_y = self._of_y
        sizes = Sizes.of(wanted, self._names, of_y, problem.args, len(problem.y0))
        values = values_of(problem.args, problem.y0, self._names)
        forward = sizes.tolerances(problem.y0, values) @ shares.sum(axis=0)
        least = _LEAST_OF_G * of_y.rtol * size / sizes.of_parameters(values)
        self._of_quadratures = np.maximum(np.maximum(forward, least) / of_y.rtol, np.finfo(float).tiny)

    def rates(self, piece: _Piece, s: float, mu: Array) -> Array:
        """(∂f/∂y)ᵀ λ + (∂g/∂y)ᵀ, then λᵀ ∂f/∂p + ∂g/∂p for each parameter, of shape (n + k,), where μ, or λ if M is
        singular, is this. Of components that rest at a bound y' is 0, whatever f is: their rows of μ pull nothing."""
        n, t, g = self.n, piece.inside(s), self._g
        y = self._y(t)
        lam = piece.moving * mu if self._algebraic else self._multiplier(t, piece.moving * mu)
        found = np.array(self._slope.transposed(t, y, lam))
        found[:n][piece.moving == 0] = 0  # nothing depends on them, even where f has no derivative
        if self._algebraic is not None and self._algebraic.moves:
            found[:n] += self._mass_rate(t).T @ mu
        if self._of_mass is not None:
            found[n:] -= self._of_mass(t, y) @ lam
        return found if g is None else found + g.transposed(t, y, np.ones(1))

    def _backwards(self, piece: _Piece, mu: Array, costs: dict[float, Array]) -> Array:
        """μ, or λ if M is singular, at the beginning of a piece; ∫ (λᵀ ∂f/∂p + ∂g/∂p) dt over the piece is counted.
        They are solved for as functions of s = end − t, whose smallest steps are shorter than those at the end."""
        slope, solution = self._slope, self._y
        singular = self._algebraic
        moves = singular is not None and singular.moves
        rates = _Rates(self, piece)

        def jacobian(s: float, mu: Array) -> Array:
            t = piece.inside(s)
            found = np.array(slope.jacobian(t, solution(t)).T)
            found[piece.moving == 0] = 0
            if singular is not None:
                found = found * piece.moving
                return np.asarray(found + self._mass_rate(t).T if moves else found)
            M = dense_mass(self._problem.matrices.mass, t, self._problem.args)
            return (found if M is None else np.linalg.solve(M, found.T).T) * piece.moving

        def mass(s: float) -> Array:
            assert singular is not None
            return singular.at(piece.inside(s)).M.T

        sizes = self._sizes
        if singular is not None:
            end = piece.inside(0.0)
            solved = singular.at(end).multiplier(slope.jacobian(end, solution(end)))
            mu, sizes = solved @ mu, np.abs(solved) @ sizes
            costs = {t: np.linalg.lstsq(singular.at(t).M.T, cost, rcond=None)[0] for t, cost in costs.items()}
        method, rtol = self._run.method, np.max(self._sol._rtol)
        about = find_method(method)[0]
        if about.equations != "any":  # λ has neither a graph nor an equation of second order
            method, rtol = _OF_ANY, max(rtol, LEAST_RTOL)
        implicit = "jac" in about.options
        adjoint = Problem(
            rates.of_mu,
            (0.0, piece.end - piece.begin),
            mu,
            jac=jacobian if implicit else None,
            mass=None if singular is None else mass if moves else mass(0.0),
            nonnegative=False,
            name="the adjoint",
        )
        atol = rtol * np.maximum(sizes, _LEAST_PART * sizes.max(initial=0))
        span = abs(self._run.t - self._problem.t_span[0])
        options: Options = {
            "rtol": rtol,
            "atol": np.maximum(atol, np.finfo(float).tiny),
            "keep": "end",
            "breakpoints": {s: (lambda s, mu, cost=cost: mu + cost) for s, cost in _summed(piece, costs).items()},
            "max_step": longest_step(self._run.options.get("max_step", np.inf), span),
        }
        return self._carried_out(make_plan(adjoint, method, options), rates, piece)

    def _carried_out(self, plan: Plan, rates: _Rates, piece: _Piece) -> Array:
        """Return μ at the end of its run. The quadratures of the gradient, which start from 0, follow it."""
        points = len(plan.functions.breakpoints)
        quadratures = VariationTerms(
            k=rates.blocks,
            slope=rates.of_quadratures,
            thresholds=rates.in_blocks(plan.tolerances.rtol * self._of_quadratures, fill=1.0),
            breakpoints=[_unchanged] * points,
            quadratures=True,
        )
        run = solver(plan, quadratures).integrate(np.concatenate([plan.y0, np.zeros(rates.blocks * self.n)]))
        if run.state != "reached_end":
            undefined = "_undefined" in run.state or run.cause == "not_finite"
            why = "a derivative of fun is NaN or infinite" if undefined else "the derivatives of fun change too fast"
            raise SolveError(
                f"gradient: the run backwards from t = {piece.end:.6g} fails at t = {piece.end - run.t!r}: {why} "
                "there. Try a smaller rtol, or sensitivities= in the place of gradient"
            )
        self._total = self._total + run.end[self.n : self.n + self.k]
        return np.array(run.end[: self.n])


def _unchanged(s: float, Y: Array, mu: Array) -> Array:
    """The quadratures after a cost, which adds to μ alone."""
    return Y[1:]


class _Rates:
    """dμ/ds and the integrand λᵀ ∂f/∂p + ∂g/∂p of the gradient in a piece. One sweep gives both: the last one is kept.

    The core integrates quadratures in blocks of n numbers, of which the last may have zeros at its end.
    """

    def __init__(self, about: _Adjoint, piece: _Piece) -> None:
        self._about, self._piece = about, piece
        self.blocks = -(-about.k // about.n)
        self._last: tuple[float, Array, Array] | None = None

    def of_mu(self, s: float, mu: Array) -> Array:
        """(∂f/∂y)ᵀ λ + (∂g/∂y)ᵀ, of shape (n,)."""
        return self._both(s, mu)[: self._about.n]

    def of_quadratures(self, s: float, Y: Array) -> Array:
        """The integrand, in blocks."""
        return self.in_blocks(self._both(s, Y[0])[self._about.n :])

    def in_blocks(self, values: Array, fill: float = 0.0) -> Array:
        """k numbers in rows of n."""
        found = np.full((self.blocks, self._about.n), fill)
        found.ravel()[: self._about.k] = values
        return found

    def _both(self, s: float, mu: Array) -> Array:
        if self._last is not None and self._last[0] == s and np.array_equal(self._last[1], mu):
            return self._last[2]
        found = self._about.rates(self._piece, s, mu)
        self._last = s, mu.copy(), found
        return found


@dataclass
class _Piece:
    """An interval on which the solution is smooth, what happens at its end, and which components move in it."""

    begin: float
    end: float
    jumps: list[Occurrence]
    moving: Array

    def __post_init__(self) -> None:
        inner = math.nextafter(self.begin, self.end), math.nextafter(self.end, self.begin)
        self._low, self._high = sorted(inner)

    def inside(self, s: float) -> float:
        """The time end − s, inside the interval: at its ends f and y may be those of its neighbours."""
        return min(max(self.end - s, self._low), self._high)


def _summed(piece: _Piece, costs: dict[float, Array]) -> dict[float, Array]:
    """The costs by s = end − t, which different t can have in common."""
    found: dict[float, Array] = {}
    for t, cost in costs.items():
        s = piece.end - t
        found[s] = found.get(s, 0) + cost
    return found


def _require_integrand(g: Any, run: Forward) -> None:
    """Raise an error unless the integrand can be called and returns a real number at both ends of the run."""
    problem = run.problem
    function("integrand", g, "g(t, y, *args)")
    if is_native(g):
        return
    if not takes(g, problem.args):
        raise TypeError(
            f"integrand is called with t, y and args = {shown(problem.args)}, and does not take them: define it with "
            "(t, y, *args)"
        )
    for t, y in ((problem.t_span[0], problem.y0), (run.t, run.solution._run.y)):
        value = np.asarray(g(t, y.copy(), *problem.args))
        if value.size != 1:
            raise ValueError(f"integrand must return one number, got {shown(value)}")
        if value.dtype.kind == "c" and abs(value.imag.item()) > _LEAST_PART * abs(value.item()):
            raise ValueError(
                f"integrand must be real, got {shown(value)} at t = {t}: return the real part or the size of it"
            )


def _functional(
    run: Forward,
    dG_dy: ArrayLike | None,
    dG_dp: ArrayLike | None,
    t: ArrayLike | None,
    integrand: Any,
    k: int,
) -> CostFunctional:
    """Return the cost functional that the user specified, with shapes checked."""
    sol, n = run.solution, len(run.problem.y0)
    if dG_dy is None and integrand is None and dG_dp is None:
        raise ValueError("gradient needs dG_dy, the derivative of a scalar with respect to y, or an integrand g(t, y)")
    if integrand is not None:
        _require_integrand(integrand, run)
    given = numbers if run.problem.y0.dtype.kind == "c" else real_numbers
    direct = np.zeros(k) if dG_dp is None else given("dG_dp", dG_dp)
    if direct.shape != (k,):
        raise ValueError(f"dG_dp must have one number for each of {k} parameters, got {shown(dG_dp)}")
    costs = np.zeros((n, 1)) if dG_dy is None else given("dG_dy", dG_dy)
    if t is not None:
        times = np.atleast_1d(real_numbers("t", t))
    else:
        times = np.array([run.t]) if costs.shape in ((n,), (n, 1)) else np.asarray(sol.t)
    if costs.ndim == 1:
        costs = costs[:, None]
    if times.ndim != 1 or costs.shape != (n, len(times)):
        raise ValueError(
            f"dG_dy must have shape ({n},), at the end, or ({n}, m) with m times t, which are those of the solution if "
            f"t is left out; got {shown(dG_dy)} and times of shape {times.shape}"
        )
    if not np.isfinite(costs).all() or not np.isfinite(direct).all():
        raise ValueError(f"dG_dy and dG_dp must be finite, got {shown(dG_dy)} and {shown(dG_dp)}")
    low, high = sorted((run.problem.t_span[0], run.t))
    if not ((times >= low) & (times <= high)).all():
        raise ValueError(f"t of gradient must be between {low} and {high}, where the solution is, got {shown(t)}")
    return CostFunctional(times, costs, direct, integrand)
