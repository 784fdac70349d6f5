"""Constant delays: y(t − τ) as an argument of f, and the history that it is taken from before the start."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, call_name, extra_arguments, interval, items, number, reals, shown
from .._base.labelled import named
from .._base.types import Span
from .._functions.compiled import CompiledFunction, NativeWithInputs, as_python, is_native, to_native
from .._functions.derivatives import derivative_of
from .._functions.graph.function import GraphFunction, OnGraph, TracedFunction
from .._functions.layout import NO_ARGUMENTS, ArgumentLayout, place_of
from .._functions.numba_code import numba_or_say_so
from .._functions.with_arguments import Point
from .core_problem import DelayTerms
from .parameters import ParameterName, parameter_names, values_of

DelaysLike: TypeAlias = float | str | Sequence[float | str]
HistoryLike: TypeAlias = Callable[..., Any] | ArrayLike


#: The part of the longest delay before t0 at which the ways to differentiate a history are compared: it is likely to be
#: special at t0.
_WITHIN = 0.618


@dataclass(frozen=True, eq=False)
class Delays:
    """Delays of a problem: ``f(t, y, z, *args)`` with ``z[j] = y(t - tau_j)``."""

    given: tuple[float | str, ...]  # numbers, or names of parameters
    names: tuple[ParameterName | None, ...]  # of those that are parameters
    history: Any  # as given: a constant or a function
    constant: Array | None  # its values, if it is constant

    @property
    def count(self) -> int:
        """Number of delays."""
        return len(self.given)

    def values(self, args: tuple[Any, ...], y0: Array) -> list[float]:
        """The delays as numbers.

        Raises
        ------
        ValueError
            A parameter is no possible delay.
        """
        found = []
        for j, (given, name) in enumerate(zip(self.given, self.names, strict=True)):
            value = float(given) if name is None else float(values_of(args, y0, [name])[0])
            found.append(positive(f"delays[{j}] = {given!r}" if name is not None else f"delays[{j}]", value))
        return found

    def history_as_data(self) -> Any:
        """Return the values of the history, or its function: by these two histories differ."""
        if self.constant is not None:
            return self.constant
        return [self.history.t, self.history.y] if is_solution(self.history) else self.history

    def in_pairs(self) -> Any:
        """The history of complex states as one of pairs of real numbers: a constant, or a function (t, \\*args)."""
        if self.constant is not None:
            return self.constant.view(float)
        return lambda t, *args: np.ascontiguousarray(self.before(t, args), dtype=complex).view(float)

    def before(self, t: float, args: tuple[Any, ...]) -> Array:
        """The history at a time before the start, of shape (n,)."""
        if self.constant is not None:
            return self.constant
        return np.atleast_1d(np.asarray(of_time(self.history, args)(t)))

    def for_core(
        self,
        args: tuple[Any, ...],
        y0: Array,
        parameters: ArgumentLayout,
        jumps: list[float],
        varied: Sequence[ParameterName],
        t0: float,
    ) -> DelayTerms:
        """The delays as the core takes them. `jumps`: times before the start, t0, at which the history jumps. `varied`:
        the parameters of the sensitivities."""
        places = [
            -1 if name is None or not parameters.size else place_of(args, name.index, name.item) for name in self.names
        ]
        constant = None if self.constant is None else self.constant.astype(y0.dtype).view(float)
        history: Any = None if self.constant is not None else _History(self.history)
        rates = [float(_same(name, one)) for name in self.names for one in varied]
        count = 0
        if varied and depends_on_args(self.history, args):
            before = t0 - _WITHIN * max(self.values(args, y0))
            history, count = _VariedHistory(history, args, varied, Point(before, y0)), len(varied)
        return DelayTerms(self.values(args, y0), places, constant, history, jumps, rates, count)

    def in_one_vector(self, fun: Any, n: int) -> Any:
        """Return f as a function of (t, x) with x = (y, z), for its derivatives."""
        if isinstance(fun, NativeWithInputs):
            return fun._replace(fun=self.in_one_vector(fun.fun, n))
        if isinstance(fun, CompiledFunction):
            return stacked(fun, n, self.count, True)
        return _of_one_vector(fun, n, self.count, False)

    def stacked_at_start(self, t: float, y: Array, args: tuple[Any, ...]) -> Array:
        """(y, z) at the start, of shape (n (1 + k),)."""
        return np.concatenate([y, self.past(t, y, args).ravel()])

    def called_by_core(self, fun: Any, y0: Array, parameters: ArgumentLayout) -> Any:
        """Return f as the core calls it: machine code as a function of (t, x) with x = (y, z), Python as it is."""
        n = reals(y0)
        return to_native("fun", stacked(fun, n, self.count, bool(parameters.size)), n * (1 + self.count), n, parameters)

    def past(self, t: float, y: Array, args: tuple[Any, ...]) -> Array:
        """The delayed values that the history has, of shape (k, n)."""
        return np.array([self.before(t - tau, args) for tau in self.values(args, y)], dtype=y.dtype)

    def value(self, fun: Any, t: float, y: Array, z: Array, args: tuple[Any, ...]) -> Any:
        """Values of f at a point, with delayed values z (k, n)."""
        if not is_native(fun) or isinstance(fun, CompiledFunction):
            return fun(t, y, z, *args)
        n = reals(y)
        call = as_python(to_native("fun", fun, n * (1 + self.count), n, NO_ARGUMENTS), n)
        return call(t, np.concatenate([y, *z]).view(float)).view(y.dtype)


def to_delays(delays: Any, history: Any, problem: Any) -> Delays | None:
    """The delays and the history of a problem, of which everything else is known, checked; None if there are no
    delays."""
    fun, t_span, y0, args, labels = problem.fun, problem.t_span, problem.y0, problem.args, problem._labels
    inputs = len(problem.inputs)
    if delays is None:
        if history is not None:
            raise ValueError("history is y before the start, for delays: give delays too")
        return None
    listed = [delays] if isinstance(delays, (str, int, float, np.number)) or callable(delays) else items(delays)
    if not listed:
        raise ValueError(f"delays must be positive numbers or names of parameters, got {shown(delays)}")
    if history is None:
        raise ValueError(
            "delays need a history: y for t <= t0, as history=, a function of t or a constant, or an earlier Solution"
        )
    if t_span[1] < t_span[0]:
        raise ValueError(
            "delays reach into the past, which a run backwards does not know: give t_span with tf >= t0, got "
            f"{shown(t_span)}"
        )
    names = tuple(
        _name(j, one, fun, args, labels, len(y0), 3 + inputs) if isinstance(one, str) else None
        for j, one in enumerate(listed)
    )
    given = tuple(one if isinstance(one, str) else positive(f"delays[{j}]", one) for j, one in enumerate(listed))
    constant = None if is_function(history) else _constant(problem.by_component("history", history), y0)
    known = Delays(given, names, history, constant)
    known.values(args, y0)
    return known


def positive(name: str, value: Any) -> float:
    """A constant delay, checked."""
    if callable(value):
        raise ValueError(
            f"{name} is a function: delays that vary with t or y are not supported, only constants: a positive number "
            "or the name of a parameter"
        )
    found = number(name, value)
    if found == 0:
        raise ValueError(f"{name} = 0: a term without delay is y itself, in fun(t, y, z)")
    if not found > 0 or math.isinf(found):
        raise ValueError(
            f"{name} = {found:g}: a constant delay is positive. A term without delay is y; one that looks ahead cannot "
            "be solved forwards"
        )
    return found


def _same(a: ParameterName | None, b: ParameterName) -> bool:
    """Return whether a delay is this parameter."""
    return a is not None and (a.kind, a.index, a.item or 0) == (b.kind, b.index, b.item or 0)


def _name(
    j: int, given: str, fun: Any, args: tuple[Any, ...], labels: Sequence[str] | None, n: int, first: int
) -> ParameterName:
    found = parameter_names(fun, args, labels, n, given, first=first, option=f"delays[{j}]")
    if len(found) != 1 or found[0].kind != "args":
        raise ValueError(f"delays[{j}] = {given!r} must be the name of one number among the arguments of fun")
    return found[0]


def _constant(history: Any, y0: Array) -> Array:
    values = np.atleast_1d(np.asarray(history))
    if values.dtype.kind not in "iufc" or (values.dtype.kind == "c" and y0.dtype.kind != "c"):
        raise TypeError(f"history must be a function of t, numbers, or an earlier Solution, got {shown(history)}")
    if values.shape != y0.shape:
        raise ValueError(f"history has shape {values.shape}, y0 has {y0.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"history must be finite, got {shown(history)}")
    return values.astype(y0.dtype)


def start_of(history: Any, t_span: Span, args: Any) -> Any:
    """The history at the start: a function of the arguments if it is."""
    if not is_function(history):
        return history if named("history", history) else np.atleast_1d(np.asarray(history))
    at_start = StartOfHistory(history, interval(t_span)[0])
    extra = extra_arguments(args)
    return at_start if depends_on_args(history, extra) else at_start(*extra)


class StartOfHistory:
    """The history at the start, as a function of the arguments."""

    def __init__(self, history: Any, t0: float) -> None:
        self.history, self.t0 = history, t0

    def __call__(self, *args: Any) -> Any:
        return np.atleast_1d(np.asarray(of_time(self.history, args)(self.t0)))


def depends_on_args(history: Any, args: tuple[Any, ...]) -> bool:
    """Return whether the history is called with the arguments of the problem."""
    return callable(history) and not is_solution(history) and bool(args) and _takes_args(history)


def of_time(history: Any, args: tuple[Any, ...]) -> Callable[[float], Any]:
    """The history as a function of t alone: with `args`, where it takes them."""
    if is_solution(history):
        if history.sol is None:
            raise ValueError("the history is a Solution without a continuous one: solve it with dense_output=True")
        continuous = history.sol
        return lambda t: continuous(t)
    python = history.fun if isinstance(history, CompiledFunction) else history
    return (lambda t: python(t, *args)) if args and _takes_args(history) else (lambda t: python(t))


def _takes_args(history: Any) -> bool:
    """Return whether a history needs more than t."""
    python = history.fun if isinstance(history, CompiledFunction) else history
    try:
        parameters = [*inspect.signature(python).parameters.values()]
    except (TypeError, ValueError):
        return False
    by_position = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    needed = [one for one in parameters if one.kind in by_position and one.default is one.empty]
    return len(needed) > 1 or any(one.kind is one.VAR_POSITIONAL for one in parameters)


class _History:
    """A history as a function of (t, y, \\*args), of which it does not read y."""

    def __init__(self, history: Any) -> None:
        self.history = history

    def __call__(self, t: float, y: Array, *args: Any) -> Any:
        return of_time(self.history, args)(t)


class _VariedHistory:
    """A history and its derivatives with respect to parameters, of (t, y, \\*args): the rows y, ∂y/∂p_j, of shape
    (1 + k, n)."""

    def __init__(self, history: _History, args: tuple[Any, ...], names: Sequence[ParameterName], at: Point) -> None:
        self._is_complex = at.y.dtype.kind == "c"
        y = np.ascontiguousarray(at.y).view(float)
        self._of_args = derivative_of(
            self._in_reals, (len(y), len(y)), at=Point(at.t, y), args=args, names=names, called="history"
        )
        self._history = history

    def _in_reals(self, t: Any, y: Any, *args: Any) -> Any:
        values = self._history(t, y, *args)
        values = values if np.ndim(values) else [values]
        return [part for one in values for part in (np.real(one), np.imag(one))] if self._is_complex else values

    def __call__(self, t: float, y: Array, *args: Any) -> Array:
        real = np.zeros(self._of_args.n)
        rows = np.vstack([self._of_args.value(t, real), self._of_args.of_parameters(t, real).T])
        return rows.view(complex) if self._is_complex else rows


def is_function(history: Any) -> bool:
    """Return whether the history is a function of t, or a solution, and not a constant."""
    return callable(history) or is_native(history) or is_solution(history)


def is_solution(history: Any) -> bool:
    """Return whether the history is an earlier solution."""
    return hasattr(history, "sol") and hasattr(history, "t") and hasattr(history, "y")


def stacked(fun: Any, n: int, count: int, with_parameters: bool) -> Any:
    """Machine code of (t, y, z) as machine code of (t, x) with x = (y, z); anything else as it is."""
    if isinstance(fun, NativeWithInputs):
        return NativeWithInputs(stacked(fun.fun, n, count, True), fun.inputs, fun.shapes)
    if not isinstance(fun, CompiledFunction):
        return fun
    known, key = fun.delayed_forms, (n, count, with_parameters)
    if key not in known:
        known[key] = _stacked(fun, *key)
    return known[key]


def _stacked(fun: CompiledFunction, n: int, count: int, with_parameters: bool) -> CompiledFunction:
    if isinstance(fun, TracedFunction):
        traced = TracedFunction(_of_one_vector(fun.fun, n, count, fun.inplace), fun.inplace, fun.elementary, "trace")
        traced.__name__ = traced.__qualname__ = fun.__name__
        return traced
    if isinstance(fun, GraphOfPast):
        return GraphFunction(fun.fun, fun.elementary, fun.how)
    if isinstance(fun, OnGraph):
        raise TypeError(f"{fun!r} has no delays: write it as a function of (t, y, z)")
    inner = numba_or_say_so().njit(getattr(fun.fun, "py_func", fun.fun), error_model="numpy", forceinline=True)
    made = CompiledFunction(_for_numba(inner, n, count, fun.inplace, with_parameters), fun.inplace)
    made.__name__ = made.__qualname__ = fun.__name__
    return made


def _of_one_vector(f: Any, n: int, count: int, inplace: bool) -> Any:
    def of(t: Any, x: Any, *args: Any) -> Any:
        return f(t, x[:n], x[n:].reshape(count, n), *args)

    def into(t: Any, x: Any, out: Any, *args: Any) -> Any:
        return f(t, x[:n], x[n:].reshape(count, n), out, *args)

    return into if inplace else of


def _for_numba(f: Any, n: int, count: int, inplace: bool, with_parameters: bool) -> Any:
    """f of (t, x) as numba compiles it: without a variable number of arguments, all parameters in one array."""

    def of(t: Any, x: Any) -> Any:
        return f(t, x[:n], x[n:].reshape(count, n))

    def of_p(t: Any, x: Any, p: Any) -> Any:
        return f(t, x[:n], x[n:].reshape(count, n), p)

    def into(t: Any, x: Any, out: Any) -> Any:
        return f(t, x[:n], x[n:].reshape(count, n), out)

    def into_p(t: Any, x: Any, out: Any, p: Any) -> Any:
        return f(t, x[:n], x[n:].reshape(count, n), out, p)

    if inplace:
        return into_p if with_parameters else into
    return of_p if with_parameters else of


class FillingOfPast:
    """A function of (t, y, z, out, \\*args) that writes its values to `out`, as one of (t, y, z, \\*args) that returns
    them."""

    def __init__(self, fun: Callable[..., Any]) -> None:
        self.fun = fun
        self.__name__ = call_name(fun, "f")

    @property
    def __signature__(self) -> inspect.Signature:
        found = inspect.signature(self.fun)
        own = [*found.parameters.values()]
        return found.replace(parameters=own[:3] + own[4:])

    def __call__(self, t: Any, y: Any, z: Any, *args: Any) -> Any:
        out = np.full(len(y), np.nan, dtype=np.result_type(float, np.asarray(y), np.asarray(z)))
        self.fun(t, y, z, out, *args)
        return out


class GraphOfPast(GraphFunction):
    """A formula of (t, x) with x = (y, z) as a compiled function of (t, y, z, \\*args)."""

    def made_again(self) -> tuple[Any, ...]:
        return GraphOfPast, (self.fun, self.elementary, self.how)

    def __call__(self, t: Any, y: Any, z: Any, *args: Any) -> Any:
        return self.fun(t, np.concatenate([y, np.ravel(z)]), *args)


class Undelayed:
    """f(t, y, z, \\*args) with z = y, as a function of (t, y, \\*args): its Jacobian has an entry wherever that of f
    with respect to y or to a delayed value has one."""

    def __init__(self, fun: Any, count: int) -> None:
        self.fun, self.count = fun, count

    def __call__(self, t: float, y: Array, *args: Any) -> Any:
        return self.fun(t, y, np.tile(y, (self.count, 1)), *args)


def transposed(fun: Any) -> Any:
    """MATLAB's fun(t, y, Z) with Z (n, k) as one of (t, y, z) with z (k, n)."""

    def of(t: float, y: Array, z: Array, *args: Any) -> Any:
        return fun(t, y, z.T, *args)

    return of
