"""The message for a function that cannot be called as the solvers call it."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from types import FunctionType
from typing import Any

import numpy as np

from .._base.arguments import PACKAGE, Array, call_name, raised_in, reals, shown
from .._functions.compiled import CompiledFunction, is_native, native_parameters
from .._functions.second_order import SecondOrder
from .._problem.breakpoints import Breakpoint, to_breakpoints
from .._problem.events import titled
from .._problem.given_options import INSTEAD_OF_MASS
from .._problem.problem import Problem

#: This many functions are named in a message.
_MOST_NAMED = 3

#: The functions of a problem that are called with its inputs too.
_FED = ("fun", "jac")


def explain(error: TypeError | ValueError, problem: Problem, options: Mapping[str, Any] | None = None) -> None:
    """Adds a note to an exception that comes from how a function was called; the exception stays the same. `options`
    of the run: its callback, and its own breakpoints."""
    options = options or {}
    if isinstance(error, TypeError):
        if not takes(options.get("callback"), ()) and _is_of_the_call(error):
            error.add_note("callback: called with t and y alone, after each step; it returns True to stop the run")
            return
        if callable(mass := problem.matrices.mass) and not takes_time(mass) and takes(mass, ()):
            error.add_note(f"mass is a function of t alone: M(t, y) is not supported, {INSTEAD_OF_MASS}")
            return
        found = _not_taking(problem, options.get("breakpoints")) if _is_of_the_call(error) else []
        if "fun" in found and problem.delays is not None:
            error.add_note("with delays, fun is called as fun(t, y, z, *args), where z[j] is y(t - delays[j])")
        elif problem.delays is not None and any(not takes(one.fun, problem.args) for one in problem.events):
            error.add_note(
                "events are called as event(t, y, *args), also with delays: y(t - delay) passes a level by a delay "
                "later than y"
            )
        elif found and not problem.args:
            error.add_note(f"{' and '.join(found)}: called with t and y alone; args=(a, b) passes further arguments")
        elif found:
            if "fun" in found and (note := _one_record(problem) or _one_array(problem)):
                error.add_note(note)
                return
            several = len(found) > 1
            error.add_note(
                f"args = {shown(problem.args)} are passed to all functions of the problem, also to invariants and "
                f"events, and {' and '.join(found)} {'do' if several else 'does'} not take them: define "
                f"{'them' if several else 'it'} with (t, y, *args)"
            )
    elif str(error).startswith("event") and ("shape (3,)" in str(error) or "shape (3, 1)" in str(error)):
        error.add_note(
            "an event is one function of (t, y) that returns a number; MATLAB's [value, isterminal, direction] is "
            "events=[invariode.Event(fun, terminal=True, direction=1), ...]"
        )
    elif str(error) == "math domain error":
        error.add_note(
            "functions of Python's math raise this where NumPy's return NaN, and with NaN the step is repeated with a "
            "smaller size: write numpy.sqrt, or pass nonnegative= or bounds= if y should not go there"
        )
    elif "returned shape" in str(error) and ", 1)" in str(error):
        error.add_note("a column is a matrix of one column: return a list, or numpy.ravel(column)")


def require_taken(problem: Problem, args: Any) -> None:
    """Require that fun takes the arguments of an ensemble, a tuple of all trajectories or the rows of each."""
    if is_native(problem.fun):
        return
    row = args if isinstance(args, tuple) else args[0] if len(args) else ()
    if takes(problem.fun, [*problem.before_args, *row]):
        return
    what = "args has" if isinstance(args, tuple) else "rows of args have"
    raise TypeError(
        f"{what} {len(row)} value{'s' * (len(row) != 1)}, and {call_name(problem.fun, 'fun')} cannot be called with "
        f"{'it' if len(row) == 1 else 'them'}: each value is one argument after t and y"
    )


def require_called(name: str, fun: Any, signature: str, args: tuple[Any, ...]) -> None:
    """Require that a function can be called as its signature, such as "Q(t, q, v)", says, with `args` after that."""
    if not takes(fun, [*(None,) * (signature.count(",") - 1), *args]):
        further = f" and then with args = {shown(args)}" if args else ""
        hint = "" if args else "; args=(a, b) passes further arguments"
        raise TypeError(
            f"{name} is called as {signature}{further}, and {call_name(fun, name)} takes {inspect.signature(fun)}{hint}"
        )


def _one_record(problem: Problem) -> str:
    """Return a note on parameters by name for an f that takes them one by one; empty without such parameters."""
    values = None if problem.parameters is None else [*problem.parameters.values()]
    if values is None or not takes(problem.fun, [*problem.before_args, *values]):
        return ""
    return (
        "with parameters=, all functions are called as f(t, y, p), with the numbers p.name: for arguments one by one "
        f"give args={shown(tuple(values))}"
    )


def _one_array(problem: Problem) -> str:
    """Return a note on a list of numbers that was meant as one argument; empty if f does not take one argument."""
    if len(problem.args) < 2 or not takes(problem.fun, [*problem.before_args, None]):
        return ""
    return f"args are the arguments one by one, here {len(problem.args)}: pass one array or list as args=(p,)"


def error_at_start(state: str, problem: Problem, y0: Array, args: tuple[Any, ...]) -> ValueError | IndexError | None:
    """Return the error to raise in place of a failure caused by NaN from a compiled function, whose code raises
    nothing. The Python functions it was made of are called at the start of the run. `state`: how that ended."""
    t0, wanted = problem.t_span[0], "the action" if state == "action_undefined" else ""
    for name, fun in _functions(problem):
        second_order = isinstance(fun, SecondOrder)
        fun, y = (fun.fun, y0[: len(y0) // 2]) if second_order else (fun, y0)
        if isinstance(fun, CompiledFunction) and name.startswith(wanted):
            fed = [one(t0) for one in problem.inputs] if name in _FED else []
            error = fun.index_error(name, t0, y, native_parameters((*fed, *args), [fun]))
            if error is not None:
                return error
    return _wrong_length(problem, y0, args) if state == "start_undefined" else None


def _wrong_length(problem: Problem, y0: Array, args: tuple[Any, ...]) -> ValueError | None:
    """Return the error of a compiled f that returns, at this start, more or fewer values than there are components,
    which in the run are NaN; else None."""
    fun, n = problem.fun, reals(y0)
    if not isinstance(fun, CompiledFunction) or fun.inplace:
        return None
    t0 = problem.t_span[0]
    parameters = native_parameters((*(one(t0) for one in problem.inputs), *args), [fun])
    try:
        returned = np.size(fun.value_at(t0, y0, parameters)) * (2 if fun.is_complex else 1)
    except Exception:  # whatever the user's code raises: there NaN is right
        return None
    if returned == n:
        return None
    what = f"{returned} value{'s' * (returned != 1)}"
    return ValueError(f"{fun!r} returned {what} at t = {t0}, expected {n}, one for each component")


def _is_of_the_call(error: TypeError) -> bool:
    """Return whether the call itself failed: no function of the user's was entered, in which anything may fail."""
    file = raised_in(error)
    return not file or file.startswith(PACKAGE)


def _not_taking(problem: Problem, breakpoints: Any) -> list[str]:
    """Return the names of the functions that do not accept the arguments they are called with; of many the first."""
    found = [
        name
        for name, fun in (*_functions(problem), *_actions(to_breakpoints("breakpoints", breakpoints or ())))
        if not takes(fun, [*(problem.before_args if name in _FED else ()), *problem.args])
    ]
    return found if len(found) <= _MOST_NAMED else [*found[:_MOST_NAMED], f"{len(found) - _MOST_NAMED} more"]


def _functions(problem: Problem) -> Iterator[tuple[str, Any]]:
    """Iterate over all functions that are called with t, y and the arguments, with their names for messages."""
    yield "fun", problem.fun
    yield "jac", problem.matrices.jac
    yield from ((f"invariant {call_name(one.fun, 'g')}", one.fun) for one in problem.invariants)
    yield from (("the Jacobian of an invariant", one.jac) for one in problem.invariants)
    yield from ((titled(event.__name__), event.fun) for event in problem.events)
    yield from ((f"the action of {titled(event.__name__)}", event.action) for event in problem.events)
    yield from _actions(problem.breakpoints)


def _actions(breakpoints: Iterable[Breakpoint]) -> Iterator[tuple[str, Any]]:
    """Iterate over the actions of breakpoints, with their names for messages."""
    yield from ((f"the action of the breakpoint at t = {point.t}", point.action) for point in breakpoints)


def takes_time(fun: Any) -> bool:
    """Return whether a function can be called with t alone."""
    try:
        inspect.signature(fun).bind(None)
    except (TypeError, ValueError):
        return False
    return True


def takes(fun: Any, args: Iterable[Any]) -> bool:
    """Return whether a function can be called with t, y and these arguments."""
    if not callable(fun) or is_native(fun):
        return True
    args = (*args,)
    if type(fun) is FunctionType and not fun.__kwdefaults__ and not hasattr(fun, "__wrapped__"):
        code, required = fun.__code__, fun.__code__.co_argcount - len(fun.__defaults__ or ())
        if not code.co_kwonlyargcount and required <= 2 + len(args) <= code.co_argcount:
            return True
    try:
        inspect.signature(fun).bind(None, None, *args)
    except TypeError:
        return False
    except ValueError:  # a builtin, which has no signature
        return True
    return True
