"""`odeint`: the call of SciPy's interface to ODEPACK, on the methods of this package."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, Literal, NamedTuple, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    Array,
    as_array,
    flag,
    function,
    number,
    positive_integer,
    real_numbers,
    shown,
    warn,
)
from .._base.method_names import OwnName
from .._base.types import Function, MethodName, Numbers
from .._core import StateFirst, StepLimit, plain_breakpoints, plain_course
from .._functions.compiled import is_native
from .._functions.graph.plain import AS_TRACED
from .._problem.invariants import InvariantsLike
from .._problem.methods import METHODS, find_method
from .._problem.options import Options
from .._problem.problem import Problem
from .._results.solution import Solution
from .._run.run import Outputs, points, solve

#: SciPy's tolerances: the square root of the rounding unit of a double.
_TOLERANCE = 1.49012e-8

_BY_ORDER = " or ".join(f"method={name!r}" for name in ("ode113", "ode15s"))

#: The value of `mused` for a method: 1 for those without Jacobians, 2 for the others.
_NONSTIFF, _STIFF = 1, 2


class OdeintOptions(TypedDict, total=False):
    """The arguments of `odeint` after `full_output`, for type checkers."""

    ml: int | None
    mu: int | None
    rtol: Numbers | None
    atol: Numbers | None
    tcrit: ArrayLike | None
    h0: float
    hmax: float
    hmin: float
    ixpr: bool | int
    mxstep: int
    mxhnil: int
    mxordn: int
    mxords: int
    printmessg: bool | int
    tfirst: bool | int
    method: MethodName | None
    invariants: InvariantsLike | None


@overload
def odeint(
    func: Function,
    y0: ArrayLike,
    t: ArrayLike,
    args: Iterable[Any] = (),
    Dfun: Any = None,
    col_deriv: bool | int = 0,
    full_output: Literal[False, 0] = 0,
    **options: Unpack[OdeintOptions],
) -> Array: ...
@overload
def odeint(
    func: Function,
    y0: ArrayLike,
    t: ArrayLike,
    args: Iterable[Any] = (),
    Dfun: Any = None,
    col_deriv: bool | int = 0,
    *,
    full_output: Literal[True, 1],
    **options: Unpack[OdeintOptions],
) -> tuple[Array, dict[str, Any]]: ...
def odeint(
    func: Function,
    y0: ArrayLike,
    t: ArrayLike,
    args: Iterable[Any] = (),
    Dfun: Any = None,
    col_deriv: bool | int = 0,
    full_output: bool | int = 0,
    ml: int | None = None,
    mu: int | None = None,
    rtol: Numbers | None = None,
    atol: Numbers | None = None,
    tcrit: ArrayLike | None = None,
    h0: float = 0.0,
    hmax: float = 0.0,
    hmin: float = 0.0,
    ixpr: bool | int = 0,
    mxstep: int = 0,
    mxhnil: int = 0,
    mxordn: int = 12,
    mxords: int = 5,
    printmessg: bool | int = 0,
    tfirst: bool | int = False,
    *,
    method: MethodName | None = None,
    invariants: InvariantsLike | None = None,
) -> Array | tuple[Array, dict[str, Any]]:
    """Solve y' = f(y, t) with the call of `scipy.integrate.odeint`.

    Parameters
    ----------
    func : callable
        ``func(y, t, *args)``, or ``func(t, y, *args)`` with ``tfirst=True``: the derivative, of shape (n,).
    y0 : array_like of shape (n,), or a number
        Initial state, at ``t[0]``.
    t : array_like of shape (n_t,)
        Times of the output, in rising or falling order; they may repeat.
    args : tuple, optional
        Extra arguments of `func`, ``Dfun`` and `invariants`.
    Dfun : callable, optional
        The Jacobian of `func`, called in the same way. With `ml` or `mu` its bands, with entry
        (i, j) at ``[i - j + mu, j]``.
    col_deriv : bool, default False
        Whether ``Dfun`` returns the transpose.
    full_output : bool, default False
        Whether a dictionary is also returned.
    ml, mu : int, optional
        Diagonals of the Jacobian below and above the main one that can differ from zero.
    rtol, atol : float or array_like of shape (n,), default 1.49012e-8
        Tolerances, as in `solve_ivp`.
    tcrit : array_like, optional
        Times at which the derivative jumps or is singular: no step goes across, and the method starts again there.
    h0 : float, default 0
        Size of the first step; 0: chosen from f(y0, t0).
    hmax : float, default 0
        Largest step; 0: limited only by the tolerances. One that lands on the end may be up to a tenth longer.
    mxstep : int, default 0
        Maximum number of steps between two output times; 0 means no limit.
    mxordn, mxords : int, default 12 and 5
        Highest order of ode113 and of ode15s, with ``method`` of that name. 'auto' uses all orders, and a warning says
        so where lower ones are asked for.
    printmessg : bool, default False
        Whether the message is printed.
    hmin, ixpr, mxhnil : optional
        No effect; a warning says so.
    tfirst : bool, default False
        Whether t is the first argument of `func` and ``Dfun``.
    method : str, optional
        A name in `METHODS`. Default: 'auto', which switches between ode113 and ode15s as the problem requires.
    invariants : callable, Invariants, or list or dict of these, optional
        What the solution keeps, ``g(t, y, *args)``: see `solve_ivp`.

    Returns
    -------
    y : ndarray, (n_t, n)
        The solution, one row per time; NaN at times that were not reached.
    infodict : dict
        With `full_output`. Arrays of one value for each time except the first: `hu`, the size of the step that reached
        it; `tcur`, where that step ended; `nqu`, its order; `nst`, the steps so far; `nfe`, the evaluations of f and
        `nje` those of its Jacobian (without ``Dfun`` the total, at every time); `mused`, 1 if that step was made by a
        method without Jacobians and 2 otherwise. Also the `message`. ODEPACK's `tolsf`, `tsw`, `lenrw`, `leniw` and
        `imxer` have no meaning here.

    Raises
    ------
    TypeError, ValueError
        As for `solve_ivp`, and if `func` or ``Dfun`` returns the wrong shape.

    Warns
    -----
    scipy.integrate.ODEintWarning
        The run stopped before the last time.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def pendulum(y, t, b, c):
    ...     theta, omega = y
    ...     return [omega, -b * omega - c * np.sin(theta)]
    >>> y = iv.odeint(pendulum, [3.0, 0.0], np.linspace(0, 10, 101), args=(0.25, 5.0))
    >>> y.shape
    (101, 2)
    """
    how: tuple[Any, ...] = (col_deriv, full_output, ml, mu, rtol, atol, h0, hmax, hmin, ixpr, mxstep)
    how = (*how, mxhnil, mxordn, mxords, printmessg, tfirst, method)
    call = None
    with suppress(TypeError):  # an array of tolerances, or a wrong argument
        call = _call_by_value(*how)
    call = call or _call(*how)
    for text in call.warnings:
        warn(text)
    asked = _times(t)
    span = asked.span
    limit = StepLimit(asked.times, call.most) if call.most else None
    counter = _Counter(limit) if call.full else None
    given: Options = {
        **call.options,
        "t_eval": asked.times,
        "callback": limit if counter is None else counter.step,
        "breakpoints": None if tcrit is None else _critical_points(tcrit, *span),
        "first_step": min(call.first_step, abs(span[1] - span[0])) or None,
    }
    problem = _problem(call, counter, func, span, y0, args, Dfun, invariants)
    if counter is None:
        found = points(problem, call.method, given)
        _tell(found, call)
        return _rows(found.y, asked)
    sol = solve(problem, call.method, given)
    message = _tell(Outputs(sol.y, sol.t_end, sol.status, sol.message), call)
    return _rows(sol.y, asked), _information(sol, asked, counter, message)


class _OdeintCall(NamedTuple):
    """Checked arguments of `odeint` that are the same in many calls."""

    tfirst: bool
    transposed: bool
    full: bool
    prints: bool
    most: int  # steps between two times; 0: any number
    bands: tuple[int, int] | None  # diagonals below and above
    first_step: float  # 0: the method's own
    method: MethodName
    options: Options
    warnings: list[str]


def _call(
    col_deriv: Any,
    full_output: Any,
    ml: Any,
    mu: Any,
    rtol: Any,
    atol: Any,
    h0: Any,
    hmax: Any,
    hmin: Any,
    ixpr: Any,
    mxstep: Any,
    mxhnil: Any,
    mxordn: Any,
    mxords: Any,
    printmessg: Any,
    tfirst: Any,
    method: Any,
) -> _OdeintCall:
    idle = {"hmin": number("hmin", hmin), "ixpr": _switch("ixpr", ixpr), "mxhnil": number("mxhnil", mxhnil)}
    texts = [f"{name} has no effect: it controls ODEPACK's internals; leave it out" for name in idle if idle[name]]
    chosen: MethodName = "auto" if method is None else method
    full = _switch("full_output", full_output)
    options: Options = {
        "rtol": _TOLERANCE if rtol is None else rtol,
        "atol": _TOLERANCE if atol is None else atol,
        "max_step": _size("hmax", hmax) or np.inf,
        "keep": "all" if full else "outputs",
        **_highest_order(chosen, {"ode113": _integer("mxordn", mxordn), "ode15s": _integer("mxords", mxords)}, texts),
    }
    return _OdeintCall(
        tfirst=_switch("tfirst", tfirst),
        transposed=_switch("col_deriv", col_deriv),
        full=full,
        prints=_switch("printmessg", printmessg),
        most=positive_integer("mxstep", mxstep) if _integer("mxstep", mxstep) else 0,
        bands=None if ml is None and mu is None else (_count("ml", ml), _count("mu", mu)),
        first_step=_size("h0", h0),
        method=chosen,
        options=options,
        warnings=texts,
    )


def _size(name: str, value: Any) -> float:
    """Return the size of a step as a float; 0: the method's own choice."""
    found = number(name, value)
    if found < 0:
        raise ValueError(f"{name} must be positive, or 0 to leave the choice to the method, got {shown(value)}")
    return found


def _problem(
    call: _OdeintCall,
    counter: _Counter | None,
    func: Any,
    span: tuple[float, float],
    y0: ArrayLike,
    args: Iterable[Any],
    dfun: Any,
    invariants: InvariantsLike | None,
) -> Problem:
    fun = _in_order(func, "func", call.tfirst, None if counter is None else counter.calls)
    start = y0 if isinstance(y0, (list, tuple)) else as_array("y0", y0)
    if isinstance(start, np.ndarray) and not start.ndim:
        start = start[np.newaxis]
    if dfun is None and invariants is None and call.bands is None:
        return Problem.plain(fun, span, start, args)
    jac = None if dfun is None else _jacobian(dfun, call.tfirst, call.transposed, counter)
    lower, upper = call.bands or (None, None)
    return Problem(fun, span, start, args=args, invariants=invariants, jac=jac, lband=lower, uband=upper)


#: Of equal values of equal types; like prepared plans, so many are kept.
_call_by_value = functools.lru_cache(maxsize=64, typed=True)(_call)


def _switch(name: str, value: object) -> bool:
    """Return a flag of ODEPACK's, which may be an integer, as a truth."""
    return flag(name, value) if isinstance(value, (bool, np.bool_)) else _integer(name, value) != 0


def _count(name: str, value: object) -> int:
    """Return a number of steps or diagonals; None and negative ones are 0."""
    return 0 if value is None else max(_integer(name, value), 0)


def _integer(name: str, value: object) -> int:
    try:
        return operator.index(value)  # type: ignore[arg-type]  # other types raise TypeError, which is caught here
    except TypeError:
        raise TypeError(f"{name} must be an integer or a flag, got {shown(value)}") from None


def _highest_order(method: MethodName, limits: dict[OwnName, int], warnings: list[str]) -> Options:
    about = find_method(method)[0]
    if "prefer" in about.options and any(limits[name] < METHODS[name].order for name in limits):
        text = f"mxordn and mxords have no effect on {about.name}: for formulas of low order give {_BY_ORDER}"
        warnings.append(text)
    if about.name not in limits:
        return {}
    return {"max_order": min(positive_integer("mxordn and mxords", limits[about.name]), about.order)}


class _Times(NamedTuple):
    """The requested times: without repetitions, the first and the last, and where each is in that list."""

    times: Array
    span: tuple[float, float]
    place: Array | None = None  # None: none is repeated


def _times(t: ArrayLike) -> _Times:
    plain = plain_course(t)
    if plain is not None:  # the common case
        return _Times(*plain)
    given = real_numbers("t", t)
    if not given.ndim:
        given = given[np.newaxis]
    if not np.isfinite(given).all():
        raise ValueError(f"t must be a list of finite times, got {given[~np.isfinite(given)][0]}")
    plain = plain_course(given)
    if plain is not None:
        return _Times(*plain)
    if not given.size:  # nothing to integrate, and no output: SciPy's shape, (0, n)
        return _Times(np.zeros(1), (0.0, 0.0), np.zeros(0, dtype=np.intp))
    steps = given[1:] - given[:-1]
    if given.ndim != 1 or not ((steps >= 0).all() or (steps <= 0).all()):
        raise ValueError("t must be a list of times in rising or falling order; they may repeat. Sort it")
    new = np.concatenate([[True], steps != 0])
    return _Times(given[new], (float(given[0]), float(given[-1])), np.cumsum(new) - 1)


class _Counter:
    """Counts during a run, with its step limit between two times of the output."""

    def __init__(self, limit: StepLimit | None) -> None:
        self.limit = limit
        self.calls = [0]  # of f, so far
        self.jacobians = 0
        self.after: list[tuple[int, int]] = []  # both, after each step

    def step(self, t: float, y: Array) -> bool:
        """Count an accepted step; return whether it was one too many."""
        self.after.append((self.calls[0], self.jacobians))
        return self.limit is not None and self.limit(t, y)


def _in_order(fun: Any, name: str, tfirst: bool, calls: list[int] | None = None) -> Any:
    """Return a function of (y, t, ...), or of (t, y, ...) already, as one of (t, y, ...), which may count its calls."""
    if is_native(fun):
        if not tfirst:
            raise TypeError(f"{name} is machine code, which takes t first: give tfirst=True")
        return fun
    function(name, fun, "f(t, y)" if tfirst else "f(y, t)", "" if tfirst else ", or pass tfirst=True")
    if calls is None and tfirst:
        return fun

    if calls is None:
        return StateFirst(fun)

    def counted(t: float, y: Array, *args: Any) -> Any:
        calls[0] += 1
        return fun(t, y, *args) if tfirst else fun(y, t, *args)

    made = functools.wraps(fun)(counted)
    setattr(made, AS_TRACED, fun if tfirst else StateFirst(fun))
    return made


def _jacobian(dfun: Any, tfirst: bool, transposed: bool, counter: _Counter | None) -> Any:
    ordered = _in_order(dfun, "Dfun", tfirst)
    if is_native(ordered) and transposed:
        raise TypeError("Dfun is machine code: give the Jacobian by rows, without col_deriv")
    if is_native(ordered) or (counter is None and not transposed):
        return ordered

    @functools.wraps(dfun)
    def jacobian(t: float, y: Array, *args: Any) -> Any:
        if counter is not None:
            counter.jacobians += 1
        value = ordered(t, y, *args)
        return np.transpose(value) if transposed else value

    return jacobian


def _critical_points(tcrit: ArrayLike, t0: float, tf: float) -> Array:
    """Return the points at which the run restarts, without the ends of the interval, where no restart is needed."""
    plain = plain_breakpoints(tcrit, t0, tf, ends=False)
    if plain is not None:  # the common case
        return plain
    points = np.atleast_1d(real_numbers("tcrit", tcrit))
    inside: Array = points[(points > min(t0, tf)) & (points < max(t0, tf))]
    return inside


def _rows(y: Array, asked: _Times) -> Array:
    """Return the solution at the requested times, (n_t, n); NaN after the end of the run."""
    rows = np.ascontiguousarray(y.T)
    if missing := len(asked.times) - len(rows):
        rows = np.concatenate([rows, np.full((missing, rows.shape[1]), np.nan, dtype=rows.dtype)])
    return rows if asked.place is None else rows[asked.place]


def _tell(found: Outputs, call: _OdeintCall) -> str:
    """Return the message on how the run ended; issue a warning if it did not reach the last time."""
    status = found.status
    message = "Integration successful." if status == 0 else found.message
    if status == 2:
        message = f"More than mxstep = {call.most} steps between two times, at t = {found.t_end:.6g}: raise mxstep."
    if status != 0:
        from scipy.integrate import ODEintWarning

        warn(message, ODEintWarning)
    if call.prints:
        print(message)
    return message


def _information(sol: Solution, asked: _Times, counter: _Counter, message: str) -> dict[str, Any]:
    """Return the dictionary of full_output: counts and step sizes at each time except the first."""
    ends = sol.steps.t
    forward = 1.0 if asked.times[-1] >= asked.times[0] else -1.0
    times = (asked.times if asked.place is None else asked.times[asked.place])[1:]
    steps = np.minimum(np.searchsorted(forward * ends, forward * times), max(len(ends) - 1, 0))
    counts = np.array(counter.after, dtype=np.int64).reshape(-1, 2)
    used = [_STIFF if "jac" in METHODS[name].options else _NONSTIFF for name in sol.steps.method]
    if not len(ends):  # nothing to integrate
        steps = steps[:0]
    return {
        "hu": sol.steps.h[steps],
        "tcur": ends[steps],
        "nqu": sol.steps.order[steps],
        "nst": (steps + 1).astype(np.int64),
        "nfe": counts[steps, 0],
        "nje": counts[steps, 1] if counter.jacobians else np.full(len(steps), sol.njev),
        "mused": np.array(used, dtype=np.int64)[steps],
        "message": message,
    }
