"""Problems of complex states as problems of real ones: pairs of real and imaginary parts.

∂y/∂p is complex for a real parameter p, whatever f is: the equations of sensitivities are those of the pairs. The
derivative with respect to a complex initial value exists only if f is analytic; then it is that with respect to its
real part.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import _core
from .._base.arguments import Array
from .._functions.compiled import is_native
from .._functions.derivatives import Derivative
from .._functions.increments import somewhere
from .._functions.with_arguments import Point
from .._problem.breakpoints import Breakpoint
from .._problem.events import Event, roots_among
from .._problem.invariants import Invariants
from .._problem.parameters import ParameterName
from .._problem.problem import Problem
from .._problem.sensitivities import Sensitivities
from .._results.result import Result

#: Where the equations of Cauchy and Riemann are tested, in units of the sizes of the components; and to which part of
#: the largest derivative, beyond the errors of differences.
_BESIDE, _ANALYTIC = (0.0, 0.1, -0.07), 1e-6


class OfPairs:
    """A Python function of (t, y, *args) with complex y as one of pairs.

    - `fun`: the function
    - `complex_values`: the values are complex, and pairs of real numbers take their place
    - `with_past`: it takes delayed values too, as rows of pairs
    """

    def __init__(self, fun: Callable[..., Any], complex_values: bool, with_past: bool = False) -> None:
        self.fun, self._complex_values, self._with_past = fun, complex_values, with_past
        self.__name__ = getattr(fun, "__name__", "fun")
        self.__wrapped__ = fun  # whose signature it has

    def __call__(self, t: Any, pairs: Any, *args: Any) -> Any:
        if self._with_past:
            z, *rest = args
            args = (z[:, 0::2] + 1j * z[:, 1::2], *rest)
        values = np.asarray(self.fun(t, pairs[0::2] + 1j * pairs[1::2], *args))
        if not self._complex_values:
            return np.real(values)
        return np.ravel(np.column_stack([np.ravel(np.real(values)), np.ravel(np.imag(values))]))


def of_pairs(fun: Any, complex_values: bool = True, with_past: bool = False) -> Any:
    """A function for pairs; machine code, and what is compiled, takes them as it is."""
    return fun if fun is None or is_native(fun) else OfPairs(fun, complex_values, with_past)


class _DerivativesOfPairs:
    """dfdp(t, y, *args) with a row for each complex component as one of pairs."""

    def __init__(self, given: Callable[..., Any]) -> None:
        self._given = given

    def __call__(self, t: float, pairs: Array, *args: Any) -> Array:
        return _as_pairs(np.asarray(self._given(t, np.ascontiguousarray(pairs).view(complex), *args)))


def start_of_pairs(dy0dp: Any) -> Any:
    """Return ∂y0/∂p of a complex problem, a matrix or a function of the arguments, for pairs."""
    if dy0dp is None:
        return None
    return (lambda *args: _as_pairs(np.asarray(dy0dp(*args)))) if callable(dy0dp) else _as_pairs(dy0dp)


def _as_pairs(columns: Array) -> Array:
    """Rows of pairs."""
    found = np.empty((2 * len(columns), *columns.shape[1:]))
    found[0::2], found[1::2] = np.real(columns), np.imag(columns)
    return found


class RealForm(NamedTuple):
    """A problem of pairs, for the derivatives of a complex one."""

    problem: Problem
    #: The parameters; an initial value stands for its real part, or for both, one after the other
    names: tuple[ParameterName, ...]
    points: list[Breakpoint]  # the breakpoints


def real_form(problem: Problem, points: Sequence[Breakpoint], *, both_parts: bool = False) -> RealForm:
    """The problem with real states. It has no Jacobians: those of complex problems are of analytic functions.
    `both_parts`: both parts of initial values are parameters, so that nothing needs to be analytic.

    Raises ValueError: It has something whose derivatives are not known.
    """
    wanted, names = problem.sensitivities, problem.parameter_names()
    assert wanted is not None
    of_start = [one.name for one in names if one.kind != "args"]
    roots = bool(roots_among(problem.events))
    for what, there in (
        ("a mass matrix", problem.matrices.mass is not None),
        ("Roots", roots),
        ("events", bool(problem.events)),
    ):
        if there and (what != "events" or (of_start and not both_parts)):
            to = f" to {of_start[0]}" if what == "events" else ""
            raise ValueError(
                f"sensitivities{to} of a complex problem are not possible with {what}: write the problem in real and "
                "imaginary parts"
            )
    of_args = Sensitivities(
        args=True if len(of_start) < len(names) else None,
        y0=True if len(of_start) == len(names) else None,
        dfdp=None if wanted.dfdp is None else _DerivativesOfPairs(wanted.dfdp),
        dy0dp=start_of_pairs(wanted.dy0dp),
        scale=wanted.scale,
        error_test=wanted.error_test,
    )
    delays = problem.delays
    form = Problem(
        of_pairs(problem.fun, with_past=delays is not None),
        problem.t_span,
        problem.y0.view(float),
        args=problem.args,
        invariants=[_law(one) for one in problem.invariants] or None,
        events=[_event(one) for one in problem.events] or None,
        inputs=problem.inputs or None,
        delays=None if delays is None else delays.given,
        history=None if delays is None else delays.in_pairs(),
        sensitivities=of_args,
    )
    doubled = [
        dataclasses.replace(one, index=2 * one.index + part) if one.kind != "args" else one
        for one in names
        for part in (range(2) if both_parts and one.kind != "args" else (0,))
    ]
    return RealForm(form, tuple(doubled), [one._replace(action=of_pairs(one.action)) for one in points])


def _law(one: Invariants) -> Invariants:
    moves = None if one.moves is None else [part for i in one.moves for part in (2 * i, 2 * i + 1)]
    fun = of_pairs(one.fun, complex_values=False)
    return Invariants(fun, value=one.value, names=one.names, level=one.level, moves=moves)


def _event(one: Event) -> Event:
    made = Event(of_pairs(one.fun, complex_values=False), action=of_pairs(one.action), rehold=one.rehold)
    made.__name__ = one.__name__
    return made


def for_complex(function: Any, complex_values: bool = True) -> Any:
    """A function of t and vectors of pairs as the core calls it for complex states; machine code takes pairs."""
    if function is None or isinstance(function, _core.Native):
        return function

    def called(t: float, *vectors: Array) -> Array:
        found = np.ascontiguousarray(function(t, *(np.ascontiguousarray(one).view(float) for one in vectors)))
        return found.view(complex) if complex_values else found

    return called


class AsPairs:
    """A continuous solution of complex states as one of pairs."""

    def __init__(self, solution: Callable[[Any], Array]) -> None:
        self._solution = solution

    def __call__(self, t: Any) -> Array:
        return _as_pairs(self._solution(t))


def with_pairs(sol: Result) -> Result:
    """Return a solution with the tolerances and the states at events in pairs of reals."""
    each = (np.repeat(one, 2) if np.ndim(one) else one for one in (sol._rtol, sol._atol))
    events = sol.y_events and sol.y_events.replaced(np.ascontiguousarray(one).view(float) for one in sol.y_events)
    return sol.changed(**dict(zip(("_rtol", "_atol"), each, strict=True)), y_events=events)


def event_of_pairs_in_complex(one: Event) -> Event:
    """An event, of pairs, of a complex problem."""
    fun, action = one.fun, one.action

    def called(t: float, y: Array, *args: Any) -> Any:
        return fun(t, y.view(float), *args)

    def acting(t: float, y: Array, *args: Any) -> Array:
        return np.ascontiguousarray(action(t, y.view(float), *args)).view(complex)

    acts = None if action is None else acting
    made = Event(fun if is_native(fun) else called, action=acts, rehold=one.rehold, at_jumps=one.at_jumps)
    made.__name__ = one.__name__
    return made


def in_complex(pairs: Array, axis: int) -> Array:
    """Pairs along an axis as complex numbers."""
    moved = np.moveaxis(pairs, axis, -1)
    return np.moveaxis(moved[..., 0::2] + 1j * moved[..., 1::2], -1, axis)


def require_analytic(slope: Derivative, at: Point, name: str) -> None:
    """Raise an error unless f satisfies the Cauchy–Riemann equations, so that y has a derivative with respect to y0.

    Raises ValueError: It does not.
    """
    for part in _BESIDE:
        J = slope.jacobian(at.t, at.y + part * somewhere(at.y))
        off = np.abs(J[0::2, 0::2] - J[1::2, 1::2]) + np.abs(J[0::2, 1::2] + J[1::2, 0::2])
        if not np.isfinite(off).all() or off.max(initial=0) <= _ANALYTIC * np.abs(J).max(initial=0):
            continue
        raise ValueError(
            f"sensitivities to {name}: fun is not analytic at t = {at.t} (it depends on the conjugate of y), so that y "
            "has no derivative with respect to a complex initial value: name parameters of fun only, or write the "
            "problem in real and imaginary parts"
        )
