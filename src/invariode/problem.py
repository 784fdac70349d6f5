"""The problem: what describes it, validated once; and the one way to solve it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from ._arguments import (
    Array,
    call_name,
    choice,
    distinct,
    extra_arguments,
    flag,
    function,
    interval,
    output_times,
    positive,
    positive_integer,
    reals,
    state,
    tolerances,
    unknown_option,
    warn,
)
from ._continuing import Origin
from ._outcome import inconsistent_start, refusal, status_and_message
from ._progress import run_bar
from ._types import EventsLike, Fsal, Function, Interpolation, InvariantsLike, MethodName, Numbers, Options, Save, Span
from .compiled import is_native, native_parameters, to_native
from .events import direction_sign, event_spec, terminal_count, to_events
from .invariants import BoundInvariants, InvariantError, as_columns, bind, to_invariants
from .methods import METHODS, Method, find_method
from .solution import DenseSolution, Names, Solution, Stats, Steps, default_labels

__all__ = ["Problem"]

#: Options of SciPy's methods that no method here can use: harmless, but said.
_OTHER_METHODS = ("min_step",)

_DESCRIBING = ("args", "invariants", "events", "jac", "jac_sparsity", "lband", "uband", "mass")

OPTIONS = (
    "rtol",
    "atol",
    "first_step",
    "max_step",
    "refine",
    "interpolation",
    "fsal",
    "max_order",
    "bdf",
    "callback",
    "save",
    "check",
    "t_eval",
    "dense_output",
    "progress",
    *_DESCRIBING,
    *_OTHER_METHODS,
)


#: Of a plan's solver, what goes into the core's settings.
_SETTINGS = (
    *("t0", "tf", "max_step", "first_step", "iterations", "refine", "times", "interpolation", "dense", "save_all"),
    *("record", "check", "negligible", "fsal", "max_order", "bdf"),
)


@dataclass(frozen=True)
class Matrices:
    """∂f/∂y and M as a problem gives them: functions, constants, or what is known of their structure."""

    jac: Any
    jac_sparsity: Any
    lband: Any
    uband: Any
    mass: Any


@dataclass
class Plan:
    """A problem with a method and its options, checked."""

    solver: dict[str, Any]  # what the core is told
    y0: Array  # as far as the algebraic equations of a singular mass matrix have moved it
    moved: bool
    bound: BoundInvariants
    names: list[str]  # of the invariants, algebraic equations last
    demanded: list[bool]  # of the invariants, whether their values were
    event_names: list[str]
    rtol: Numbers
    atol: Numbers

    def solver_object(self) -> _core.Solver:
        """The core's solver, with functions of its own."""
        given = self.solver
        problem = _core.Problem(
            **{
                name: given[name]
                for name in ("n", "complex", "fun", "args", "parameters", "linear", "callback", "value")
            },
            events=[_core.Event(*spec) for spec in given["events"]],
            invariants=[_core.Invariant(*spec) for spec in given["invariants"]],
        )
        settings = _core.Settings()
        for name in _SETTINGS:
            setattr(settings, name, given[name])
        tolerances = _core.Tolerances(given["rtol"], given["threshold"], given["scale"])
        return _core.Solver(given["method"], problem, tolerances, settings)

    def verdict(self, run: _core.Run) -> tuple[int, str]:
        """The status of the run and its message."""
        return status_and_message(run, self.names, self.demanded, self.solver["rtol"], self.solver["complex"])

    def exception(self, run: _core.Run) -> ValueError | None:
        """The exception with which a single solve ends where the run did."""
        if run.state == "invariant_refused":
            text = refusal(run, self.names, self.demanded, self.solver["rtol"], self.solver["complex"])
            return InvariantError(text)
        if run.state == "event_undefined":
            return ValueError(f"event {self.event_names[run.event]} returned NaN at t = {run.t}")
        if run.state == "action_undefined":
            return ValueError(f"the action of event {self.event_names[run.event]} returned NaN at t = {run.t}")
        return None


class Problem:
    """An initial value problem y' = f(t, y), or M y' = f(t, y), y(t0) = y0, with what is known of its solution.

    Parameters
    ----------
    fun : callable
        ``f(t, y, *args)``, the derivative, a sequence or array of shape (n,). y is a new array whenever someone still
        holds the last one, so it may be kept; a buffer may be returned again and again.
    t_span : (float, float)
        (t0, tf); tf < t0 integrates backwards; with an infinite tf only a terminal event or a callback ends the run;
        without one it goes on until memory is full.
    y0 : array_like of shape (n,)
        Initial state, real or complex.
    args : tuple, optional
        Extra arguments of `fun`, `jac`, `mass`, invariants, events and actions.
    invariants : callable, Invariants, or list of these, optional
        What the solution keeps. See `Invariants`.
    events : callable, Event, or list of these, optional
        Functions whose zeros are located. See `Event`.
    jac : callable, (n, n) array_like or sparse matrix, optional
        The Jacobian of f, for implicit methods: ``jac(t, y, *args)``, or a constant. Where it is (or returns) a sparse
        matrix, the linear algebra is sparse. Default: differences.
    jac_sparsity : (n, n) array_like or sparse matrix, optional
        Which entries of the Jacobian can differ from zero, for differences and sparse linear algebra. An entry that is
        missing here is taken for zero: Newton's iteration then converges slowly or not at all, and the steps are small.
    lband, uband : int, optional
        The Jacobian is zero but for ``i - lband <= j <= i + uband``. `jac` then has, or returns, the bands as an array
        (lband + uband + 1, n) with ``[uband + i - j, j]`` for entry (i, j).
    mass : (n, n) array_like or sparse matrix, or callable, optional
        M of M y' = f(t, y): constant, or ``mass(t, *args)``. A singular M makes some equations algebraic (index 1); y0
        is then moved to consistent values.
    name : str, optional
        For tables and plots.
    labels : sequence of n str, optional
        Names of the components.

    Raises
    ------
    TypeError
        An argument of a wrong type, as a `fun` that is no function.
    ValueError
        y0 or `t_span` is not finite (tf may be infinite) or of a wrong shape; `labels` are not n. What only a
        method can tell, as a Jacobian of a wrong shape, is an error of `solve`.

    Examples
    --------
    >>> import invariode as iv
    >>> def orbit(t, y):
    ...     return [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]
    >>> problem = iv.Problem(orbit, (0, 10), [1.0, 3.0], labels=["prey", "predators"])
    >>> problem
    Problem('orbit', t_span=(0.0, 10.0), n=2)
    >>> problem.solve("ode23", rtol=1e-4).success
    True
    """

    def __init__(
        self,
        fun: Function,
        t_span: Span,
        y0: ArrayLike,
        *,
        args: Iterable[Any] | None = (),
        invariants: InvariantsLike | None = None,
        events: EventsLike = None,
        jac: Any = None,
        jac_sparsity: Any = None,
        lband: int | None = None,
        uband: int | None = None,
        mass: Any = None,
        name: str | None = None,
        labels: Sequence[str] | None = None,
    ) -> None:
        self.fun = fun if is_native(fun) else function("fun", fun, "f(t, y)")
        self.t_span = interval(t_span)
        self.y0 = state(y0)
        self.args = extra_arguments(args)
        self.invariants = to_invariants(invariants)
        self.events = to_events(events)
        for event in self.events:
            terminal_count(event), direction_sign(event)
        self.matrices = Matrices(jac, jac_sparsity, lband, uband, mass)
        self.name = call_name(self.fun, "problem") if name is None else name
        self._title = name
        self._labels = None if labels is None else list(labels)
        if self._labels is not None and len(self._labels) != len(self.y0):
            raise ValueError(f"labels must name the {len(self.y0)} components of y0, got {labels!r}")
        if self._labels is not None and len(set(self._labels)) < len(self._labels):
            raise ValueError(f"labels must differ from each other, got {labels!r}")

    @property
    def labels(self) -> list[str]:
        """Names of the components."""
        return default_labels(len(self.y0)) if self._labels is None else self._labels

    def __repr__(self) -> str:
        return f"Problem({self.name!r}, t_span={self.t_span}, n={len(self.y0)})"

    def solve(self, method: MethodName = "ode45", **options: Unpack[Options]) -> Solution:
        """Solves the problem. The options, errors and warnings are those of `solve_ivp`.

        Returns
        -------
        Solution
        """
        given: dict[str, Any] = {**options}
        progress = given.pop("progress", False)
        return self._run(self.plan(method, **given), method, given, progress)

    def _run(
        self,
        plan: Plan,
        method: MethodName,
        options: dict[str, Any],
        progress: object,
        resumed: tuple[list[int], list[bool]] | None = None,
    ) -> Solution:
        """`resumed`: the run goes on from another; of each event its occurrences so far, and whether at the start."""
        solver = plan.solver_object()
        if resumed is not None:
            solver.resume(*resumed)
        y0 = plan.y0.view(float)
        if flag("progress", progress):
            with run_bar(self.name, *self.t_span) as told:
                run = solver.integrate(y0, told)
        else:
            run = solver.integrate(y0, None)
        if exception := plan.exception(run):
            raise exception
        if run.dropped:
            _warn_dropped(run, plan.names)
        return self._solution(run, plan, method, options)

    def plan(
        self,
        method: MethodName = "ode45",
        *,
        t_eval: ArrayLike | None = None,
        dense_output: bool = False,
        rtol: Numbers = 1e-3,
        atol: Numbers = 1e-6,
        first_step: float | None = None,
        max_step: float | None = None,
        refine: int = 1,
        interpolation: Interpolation = "projected",
        fsal: Fsal = "reuse",
        max_order: int | None = None,
        bdf: bool | None = None,
        callback: Callable[[float, Array], object] | None = None,
        save: Save | None = None,
        check: bool = True,
        **options: Any,
    ) -> Plan:
        """The options checked, and everything that the core needs but y0."""
        chosen, implied = find_method(method)
        if options or fsal != "reuse" or max_order is not None or bdf is not None:
            _foreign_options(chosen, {**options, "fsal": fsal != "reuse", "max_order": max_order, "bdf": bdf})
        bdf = implied.get("bdf", False) if bdf is None else flag("bdf", bdf)
        if self.matrices.mass is not None and "mass" not in chosen.options:
            raise ValueError(
                f"mass: {chosen.name} is explicit and cannot use a mass matrix; use ode15s, or solve M y' = f for y' "
                "in fun"
            )
        t0, tf = self.t_span
        span = abs(tf - t0)
        rmin, threshold, scale = tolerances(rtol, atol, self.y0)
        times = None if t_eval is None else output_times(t_eval, t0, tf)
        dense_output, kept = flag("dense_output", dense_output), _kept(save, times)
        if kept == "end" and (times is not None or dense_output):
            raise ValueError('save="end" keeps the final state only: t_eval and dense_output need save="all"')
        refine = positive_integer("refine", refine)
        if refine > 1 and (times is not None or kept == "end"):
            other = "t_eval" if times is not None else 'save="end"'
            warn(f"refine has no effect together with {other}")
        first = 0.0 if first_step is None else positive("first_step", first_step)
        if first > span:
            raise ValueError(f"first_step must not exceed the interval, of length {span}, got {first_step!r}")
        n = reals(self.y0)
        natives = [self.fun, self.matrices.jac, *(f for one in self.invariants for f in (one.fun, one.jac))]
        natives += [f for event in self.events for f in (event.fun, event.action)]
        p = native_parameters(self.args, natives)
        fun = to_native("fun", self.fun, n, n, p)
        y0, linear = self.y0, None
        if "jac" in chosen.options:
            from ._linear import prepare  # SciPy's sparse matrices take longer to import than all the rest

            linear = prepare(self.matrices, t0, y0, self.args, p)
            if linear.algebraic and any(event.action for event in self.events):
                raise ValueError("actions of events are not possible with a singular mass matrix")
            if self.matrices.mass is not None:
                y0 = self._consistent_start(linear, fun, p, rmin, threshold, scale)
        bound = bind(self.invariants, t0, y0, self.args, threshold)
        demanded = [not held for _, _, m, _, held in bound.specs for _ in range(m)]
        names = [*bound.names, *(f"algebraic equation {i + 1}" for i in range(linear.algebraic if linear else 0))]

        solver = {
            "method": chosen.name,
            "n": n,
            "fun": fun,
            "args": self.args,
            "t0": t0,
            "tf": tf,
            "complex": y0.dtype.kind == "c",
            "rtol": rmin,
            "threshold": threshold,
            "scale": scale,
            "max_step": span / 10 if max_step is None else positive("max_step", max_step),
            "first_step": first,
            "fsal": choice("fsal", fsal, ("reuse", "evaluate")),
            "max_order": _highest_order(chosen, max_order),
            "bdf": bdf,
            "linear": linear,
            "interpolation": choice("interpolation", interpolation, ("projected", "corrected", "raw")),
            "refine": refine,
            "times": times,
            "dense": dense_output,
            "save_all": kept != "end",
            "record": kept == "all",
            "check": flag("check", check),
            "events": [event_spec(event, n, p) for event in self.events],
            "callback": None if callback is None else function("callback", callback, "callback(t, y)"),
            "invariants": bound.specs,
            "value": bound.value,
            "iterations": bound.iterations or chosen.iterations,
            "negligible": bound.negligible,
            "parameters": p,
        }
        return Plan(
            solver=solver,
            y0=y0,
            moved=y0 is not self.y0,
            bound=bound,
            names=names,
            demanded=demanded,
            event_names=distinct([event.__name__ for event in self.events]),
            rtol=copy(rtol),
            atol=copy(atol),
        )

    def _consistent_start(
        self, linear: _core.Linear, fun: Any, p: Array, rtol: float, threshold: float | Array, scale: Array | None
    ) -> Array:
        """y0, moved where the algebraic equations of a singular mass matrix ask for it."""
        if not linear.algebraic:
            return self.y0
        problem = _core.Problem(
            n=reals(self.y0),
            complex=self.y0.dtype.kind == "c",
            fun=fun,
            args=self.args,
            parameters=p,
            linear=linear,
            invariants=[],
            value=np.zeros(0),
        )
        weights = _core.Tolerances(rtol, threshold, scale)
        y, verdict = _core.consistent_start(self.t_span[0], self.y0.view(float), problem, weights)
        if verdict in ("index_too_high", "not_found"):
            raise ValueError(inconsistent_start(verdict, self.t_span[0]))
        return y.view(self.y0.dtype) if verdict == "corrected" else self.y0

    def _solution(self, run: _core.Run, plan: Plan, method: MethodName, options: dict[str, Any]) -> Solution:
        dtype = self.y0.dtype
        status, message = plan.verdict(run)
        bound = plan.bound
        if jumps := run.take_jumps():
            bound = replace(bound, jumps=tuple(jumps), forward=1.0 if self.t_span[1] >= self.t_span[0] else -1.0)
        dense = run.take_dense()
        t, rows, t_end, y_end = run.take_points()
        y = as_columns(rows, dtype)
        happened = run.take_events() if self.events else None
        stats = Stats(
            *run.counts[:-1],
            derivatives=" and ".join(sorted(set(run.derivatives))) or None,
            projected_start=run.projected_start or plan.moved,
        )
        stats.ng += bound.evaluations
        stats.ngdiff += bound.evaluations - len(bound.specs)
        y_end = y[:, -1].copy() if y_end is None else y_end.view(dtype)
        own = {"t_eval": copy(options.get("t_eval")), "rtol": plan.rtol, "atol": plan.atol}  # not the user's arrays
        next_h = run.next_h if METHODS[plan.solver["method"]].fixed_order and stats.steps else None
        return Solution(
            t=t,
            y=y,
            sol=None if dense is None else DenseSolution(dense, dtype, bound),
            t_events=None if happened is None else [times for times, _ in happened],
            y_events=None if happened is None else [points.view(dtype) for _, points in happened],
            nfev=stats.nfev,
            njev=stats.njev,
            nlu=stats.nlu,
            status=status,
            message=message,
            success=status >= 0,
            stats=stats,
            steps=Steps(run.take_steps()) if plan.solver["record"] else None,
            _invariants=bound,
            _drift=run.take_drift() if plan.names else _NO_DRIFT,
            _rtol=plan.rtol,
            _atol=plan.atol,
            _names=Names(self.name, self._title, self._labels, len(self.y0), plan.event_names),
            _origin=Origin(self, method, {**options, **own}, t_end, y_end, next_h),
        )


#: Of a run without invariants: residuals, distances, correction.
_NO_DRIFT = (np.zeros(0), np.zeros(0), 0.0)


def _kept(save: object, times: Array | None) -> str:
    """What is kept: with `t_eval` no record of the steps, unless it is asked for."""
    if save is None:
        return "all" if times is None else "outputs"
    return choice("save", save, ("all", "outputs", "end"))


def _foreign_options(method: Method, options: dict[str, Any]) -> None:
    """An option that this method cannot use is a warning, an unknown one an error."""
    for name, given in options.items():
        if name in _DESCRIBING:
            raise TypeError(f"{name} describes the problem: it is an argument of Problem or solve_ivp, not an option")
        if name not in OPTIONS:
            raise unknown_option(name, OPTIONS)
        if name not in method.options:
            warn_unused(method, name, given)


def warn_unused(method: Method, name: str, given: object) -> None:
    if given is not None and given is not False:
        warn(f"option {name!r} has no effect on {method.name}")


def _highest_order(method: Method, max_order: int | None) -> int:
    if max_order is None or "max_order" not in method.options:
        return method.order
    order = positive_integer("max_order", max_order)
    if order > method.order:
        raise ValueError(f"max_order must be from {method.min_order} to {method.order} for {method.name}, got {order}")
    return order


def _warn_dropped(run: _core.Run, names: list[str]) -> None:
    listed = ", ".join(names[i] for i in run.dropped)
    several = len(run.dropped) > 1
    warn(
        f"{'invariants' if several else 'invariant'} {listed} {'are' if several else 'is'} redundant, first at "
        f"t = {run.dropped_at:.6g} (dependent on the others to within rtol, or stationary there), and "
        f"{'were' if several else 'was'} left out there"
    )
