"""`ode` and `complex_ode`: the interface of SciPy's classes, with the methods of this package."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, choice, count, function, number, state, warn
from .._base.package import public
from .._base.suggestions import meant
from .._base.types import Function, MethodName
from .._functions.compiled import is_native
from .._plan.call_errors import explain
from .._plan.plan import Plan
from .._plan.planning import make_plan
from .._plan.walk import Walk
from .._problem.given_options import unknown_option
from .._problem.invariants import InvariantsLike
from .._problem.methods import METHODS, find_method
from .._problem.options import MethodOptions, Options, StepSizeOptions
from .._problem.problem import Problem

__all__ = ["complex_ode", "ode"]


# ----------------------------------------------------------------------------------------------------------------------
# Integrators

#: SciPy's default tolerances in these classes.
_TOLERANCES: Options = {"rtol": 1e-6, "atol": 1e-12}

_COMMON = ("rtol", "atol", "first_step", "max_step", "nsteps")
_BANDS = ("lband", "uband")
#: Parameters of invariode's integrators.
_OURS = (*StepSizeOptions.__annotations__, *MethodOptions.__annotations__, "nsteps", *_BANDS)
#: SciPy's parameters that have no effect here, and that scripts pass to every integrator.
_HINTS = ("method", "with_jacobian", "verbosity")


class _Theirs(NamedTuple):
    """Description of one of SciPy's integrators."""

    methods: Mapping[str, MethodName]  # the equivalents here, by the value of its parameter `method`, if any
    takes: tuple[str, ...]
    idle: tuple[str, ...]  # parameters that only SciPy's uses: a warning says so
    complex: bool = False


_OF_HAIRER = ("safety", "ifactor", "dfactor", "beta")
_OF_VODE: Mapping[str, MethodName] = {"adams": "ode113", "bdf": "BDF"}
#: In the order in which SciPy looks for a name.
_SCIPYS: Mapping[str, _Theirs] = MappingProxyType(
    {
        "vode": _Theirs(_OF_VODE, (*_COMMON, *_BANDS, "order"), ("min_step",)),
        "zvode": _Theirs(_OF_VODE, (*_COMMON, *_BANDS, "order"), ("min_step",), complex=True),
        "dopri5": _Theirs({"": "ode45"}, _COMMON, _OF_HAIRER),
        "dop853": _Theirs({"": "dop853"}, _COMMON, _OF_HAIRER),
        "lsoda": _Theirs(
            {"": "auto"}, (*_COMMON, *_BANDS), ("min_step", "ixpr", "max_hnil", "max_order_ns", "max_order_s")
        ),
    }
)


class _Codes(NamedTuple):
    """Return codes of a family of SciPy's integrators."""

    success: int
    wrong: int  # f is not defined at the start, or contradicts an invariant
    too_long: int  # more than nsteps steps
    failed: int  # the error test, at the smallest step
    unsolved: int  # Newton's iteration
    stopped: int = 2  # by solout


_HAIRER = _Codes(success=1, wrong=-1, too_long=-2, failed=-3, unsolved=-3)
_ODEPACK = _Codes(success=2, wrong=-3, too_long=-1, failed=-4, unsolved=-5)


class _Integrator(NamedTuple):
    """Integrator and parameters chosen by `set_integrator`."""

    name: str
    method: MethodName
    options: Options
    bands: Mapping[str, Any]
    nsteps: int | None  # the maximum in one call; None: no limit
    complex: bool  # the state is complex, whatever the initial value
    implicit: bool
    #: Steps go beyond the requested times, as in ODEPACK. Explicit pairs end exactly there, and restart in the next
    #: call, as DOPRI5 does.
    goes_on: bool
    codes: _Codes


def _integrator(name: str, given: Mapping[str, Any]) -> _Integrator:
    """Return the integrator with this name, SciPy's or invariode's, with its parameters."""
    parameters = dict(given)
    found = _scipys(name)
    if found is None:
        method, takes, is_complex = _ours(name), _OURS, False
    else:
        name, theirs = found
        method, takes, is_complex = _method(theirs, parameters), theirs.takes, theirs.complex
        for idle in theirs.idle:
            if parameters.pop(idle, 0):
                warn(f"{idle} has no effect: it controls SciPy's {name}; leave it out")
    if wrong := next((one for one in parameters if one not in takes), None):
        raise unknown_option(wrong, takes, f"integrator {name!r} has no parameter")
    about = find_method(method)[0]
    if (order := parameters.pop("order", None)) is not None:
        parameters["max_order"] = min(count("order", order), about.order)
    nsteps = parameters.pop("nsteps", None) or None
    bands = {one: parameters.pop(one) for one in _BANDS if one in parameters}
    free = {one: value for one, value in parameters.items() if not _is_zero(value) or one in ("rtol", "atol")}
    options: Any = {**_TOLERANCES, **free, "keep": "end"}
    return _Integrator(
        name=name,
        method=method,
        options=options,
        bands=bands,
        nsteps=None if nsteps is None else count("nsteps", nsteps),
        complex=is_complex,
        implicit="jac" in about.options,
        goes_on=about.stages is None,
        codes=_ODEPACK if about.stages is None else _HAIRER,
    )


def _scipys(name: object) -> tuple[str, _Theirs] | None:
    """Return SciPy's integrator whose name begins with `name`, as SciPy looks it up, or None for an unknown name."""
    if not isinstance(name, str) or (name in METHODS and name not in _SCIPYS):
        return None
    return next(((full, about) for full, about in _SCIPYS.items() if full.startswith(name.lower())), None)


def _ours(name: Any) -> MethodName:
    try:
        find_method(name)
    except ValueError:
        known = [*_SCIPYS, *METHODS]
        raise ValueError(
            f"No integrator name match with {name!r}{meant(name, known)} Integrators: {', '.join(dict.fromkeys(known))}"
        ) from None
    method: MethodName = name
    return method


def _method(theirs: _Theirs, parameters: dict[str, Any]) -> MethodName:
    """Return the method that replaces an integrator; like SciPy, abbreviations of vode's `method` are accepted."""
    hints = {one: parameters.pop(one, None) for one in _HINTS}
    kind = hints["method"]
    if kind is None or "" in theirs.methods:
        return next(iter(theirs.methods.values()))
    begun = [one for one in theirs.methods if isinstance(kind, str) and one.startswith(kind.lower())]
    return theirs.methods[begun[0] if begun else choice("method", kind, theirs.methods)]


def _is_zero(value: object) -> bool:
    """Return whether the value is zero, SciPy's notation for no limit, or for the method's own choice."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value == 0


# ----------------------------------------------------------------------------------------------------------------------
# The classes


class _Calls:
    """The user's functions with the parameters set last. The core refers to this and not to the `ode` object, which
    otherwise could not be freed."""

    def __init__(self, f: Function, jac: Function | None) -> None:
        self.f = f
        self.jac = jac
        self.f_params: tuple[Any, ...] = ()
        self.jac_params: tuple[Any, ...] = ()

    def jacobian(self) -> Any:
        """Return ``jac(t, y, *f_params)``, as problems call it."""
        jac: Any = self.jac
        if jac is None or is_native(jac):
            return jac
        function("jac", jac, "jac(t, y)")

        @functools.wraps(jac)
        def of_ours(t: float, y: Array, *f_params: Any) -> Any:
            return jac(t, y, *self.jac_params)

        return of_ours


@public
class ode:  # noqa: N801 - SciPy's name
    """Integrate y' = f(t, y) from one time to the next, with the interface of `scipy.integrate.ode`.

    Parameters
    ----------
    f : callable
        ``f(t, y, *f_params)``: the derivative, of shape (n,).
    jac : callable, optional
        ``jac(t, y, *jac_params)``: the Jacobian of f, of shape (n, n), or its bands. Explicit methods do not use it.
    invariants : callable, Invariants, or list or dict of these, optional
        Invariants of the solution, ``g(t, y, *f_params)``: see `solve_ivp`. They are fixed at their values at the
        initial value, or, if the parameters of f were changed later, at the state where they were set last.

    Attributes
    ----------
    t : float
        The time reached by the last call.
    y : ndarray
        The state at t, of shape (n,).

    See Also
    --------
    solve_ivp : Solve over the whole interval in one call, with output, events and statistics.

    Notes
    -----
    `set_integrator` lists the methods that replace SciPy's integrators. As in SciPy, multistep and implicit methods
    continue across calls: their steps go beyond the requested time, at which the solution is interpolated. Explicit
    Runge-Kutta pairs end exactly at the requested time, and restart in the next call with the step size that this one
    has found: f may have changed meanwhile.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def pendulum(t, y, torque):
    ...     return [y[1], torque - np.sin(y[0])]
    >>> def energy(t, y, torque):
    ...     return y[1] ** 2 / 2 - np.cos(y[0]) - torque * y[0]
    >>> run = iv.ode(pendulum, invariants=energy).set_integrator("dop853", rtol=1e-6)
    >>> run.set_initial_value([1.0, 0.0], 0.0).set_f_params(0.1)
    <invariode.ode, dop853, at t = 0.0>
    >>> while run.successful() and run.t < 10:
    ...     y = run.integrate(run.t + 0.5)
    >>> bool(abs(energy(10, y, 0.1) - energy(0, [1.0, 0.0], 0.1)) < 1e-12)
    True
    """

    _complex = False

    def __init__(self, f: Function, jac: Function | None = None, *, invariants: InvariantsLike | None = None) -> None:
        self._calls = _Calls(f, jac)
        self._invariants = invariants
        self._integrator: _Integrator | None = None
        self._solout: Callable[[float, Array], Any] | None = None
        self.t = 0.0
        self._y: Array = np.zeros(0)
        self._code: int | None = None  # None: nothing was integrated
        self._problem: Problem | None = None
        self._plan: Plan | None = None
        self._walk: Walk | None = None  # the run that continues, or starts again, from call to call

    def __repr__(self) -> str:
        return f"<invariode.{type(self).__name__}, {self._chosen().name}, at t = {self.t}>"

    @property
    def y(self) -> Array:
        return self._y

    def set_integrator(self, name: str, **integrator_params: Any) -> Self:
        """Choose an integrator.

        Parameters
        ----------
        name : str
            A name in `METHODS`; or a name in SciPy, in full or abbreviated: 'vode' (here ode113, or with
            ``method='bdf'`` ode15s with ``bdf=True``), 'zvode' (the same for complex states), 'dopri5' (ode45),
            'dop853' or 'lsoda' (auto).
        **integrator_params
            For names in SciPy: `rtol` (default 1e-6), `atol` (1e-12), `first_step`, `max_step`, and `nsteps`, the
            maximum number of steps in a call (default: no limit); for 'vode', 'zvode' and 'lsoda' also `lband` and
            `uband`; for 'vode' and 'zvode' `method` and `order`. `with_jacobian` and `verbosity` have no effect.
            `safety`, `ifactor`, `dfactor`, `beta`, `min_step`, `ixpr`, `max_hnil`, `max_order_ns` and `max_order_s`
            have no effect and cause a warning. For names in `METHODS`: the options of `solve_ivp` for the method and
            its step size, `lband`, `uband` and `nsteps`.

        Raises
        ------
        ValueError
            There is no integrator with this name.
        TypeError
            The integrator has no such parameter.
        """
        self._integrator = _integrator(name, integrator_params)
        self._solout = None
        return self.set_initial_value(self._y if len(self._y) else 0.0, self.t)

    def set_initial_value(self, y: ArrayLike, t: float = 0.0) -> Self:
        """Set the state y, a number or of shape (n,), at the time t."""
        start = state(np.atleast_1d(y))
        self._y = start.astype(complex) if self._complex or self._chosen().complex else start
        self.t, self._code = number("t", t), None
        self._forget()
        return self

    def set_f_params(self, *args: Any) -> Self:
        """Set the additional arguments of f and of the invariants. If they are not the same numbers as before, the
        method restarts at the next call."""
        if not _are_same_numbers(self._calls.f_params, args):
            self._calls.f_params = args
            self._forget()
        return self

    def set_jac_params(self, *args: Any) -> Self:
        """Set the additional arguments of jac."""
        self._calls.jac_params = args
        return self

    def set_solout(self, solout: Callable[[float, Array], Any]) -> None:
        """Set a function that `integrate` calls at its start and after each step.

        Parameters
        ----------
        solout : callable
            ``solout(t, y)``; if it returns -1, `integrate` ends there.

        Raises
        ------
        ValueError
            The integrator steps beyond the requested times; only explicit pairs, such as 'dopri5', support solout.
        """
        if self._chosen().goes_on:
            raise ValueError(
                "selected integrator does not support solout, choose another one: 'dopri5', 'dop853', or an explicit "
                "pair of METHODS"
            )
        self._solout = solout

    def integrate(self, t: float, step: bool = False, relax: bool = False) -> Array:
        """Advance to a time, and return the state at that time.

        Parameters
        ----------
        t : float
            The time, before or after the current one.
        step : bool, default False
            Whether to take a single step towards `t`, and to return the state at its end, which may be beyond `t`.
            As in SciPy, explicit pairs ignore this and go to `t`.
        relax : bool, default False
            Whether to return the state at the end of the first step that reaches or passes `t`. Explicit pairs ignore
            this.

        Returns
        -------
        ndarray, (n,)
            The state at `t`, or where the run failed: see `successful`.

        Raises
        ------
        InvariantError
            An invariant is not conserved at the start, or its Jacobian is wrong.
        ValueError
            `t` is infinite, and nothing else ends the call.

        Warns
        -----
        UserWarning
            The run failed; the message gives t, the reason, and what to try.
        """
        target = number("t", t)
        if target == self.t:
            return self._y
        if math.isinf(target):
            self._require_end(target, step=bool(step))
        chosen = self._integrator or self._chosen()
        try:
            if not chosen.goes_on:
                self._start_anew(target, chosen)
            elif step or relax or not self._has_passed(target):
                self._go_on(target, chosen, step=bool(step), relax=bool(relax))
        except BaseException as error:
            self._walk = None
            if isinstance(error, (TypeError, ValueError)) and self._problem is not None:
                explain(error, self._problem)
            raise
        return self._y

    def successful(self) -> bool:
        """Return whether the last call reached its time or was ended by solout; True before the first call."""
        return self._code is None or self._code > 0

    def get_return_code(self) -> int | None:
        """Return SciPy's code for how the last call ended.

        Returns
        -------
        int or None
            None: no call yet. 'dopri5', 'dop853' and other explicit pairs: 1, success; 2, ended by solout; -1, f is not
            finite at the start, or does not conserve an invariant; -2, `nsteps` steps did not suffice; -3, the step
            size became too small. Other integrators: 2, success; -1, `nsteps` steps did not suffice; -3, as -1 above;
            -4, the error test failed at the minimum step size; -5, Newton's iteration did not converge.
        """
        return self._code

    # Implementation

    def _chosen(self) -> _Integrator:
        """Return the integrator; 'vode', SciPy's default, if none was set."""
        if self._integrator is None:
            self._integrator = _integrator("vode", {})
        return self._integrator

    def _require_end(self, target: float, *, step: bool) -> None:
        chosen = self._chosen()
        if chosen.nsteps is None and not (step if chosen.goes_on else self._solout is not None):
            raise ValueError(f"t = {target} is never reached: give a finite t, nsteps, solout, or step=True")

    def _forget(self) -> None:
        """Discard the plan: the next call makes a new one, and fixes the invariants at its start."""
        self._problem = self._plan = self._walk = None

    def _walk_to(self, tf: float, chosen: _Integrator) -> Walk:
        """Return a run from here to `tf`. If there is a plan, invariants keep its values."""
        calls, ahead = self._calls, math.copysign(1.0, tf - self.t)
        walk = self._walk
        if walk is not None and walk.forward == ahead:  # its next step has the size that the last call has found
            first = walk.plan.settings.first_step or walk.core.h
            walk.restart(self.t, tf, self._y, min(first, abs(tf - self.t)))
            return walk
        if self._plan is None or self._plan.course.forward != ahead:
            held = None if self._plan is None else self._plan.bound.value
            linear = {"jac": calls.jacobian(), **chosen.bands} if chosen.implicit else {}
            span = self.t, math.copysign(math.inf, ahead)
            self._problem = Problem(calls.f, span, self._y, args=calls.f_params, invariants=self._invariants, **linear)
            plan = make_plan(self._problem, chosen.method, chosen.options)
            self._plan = plan if held is None else plan.holding(held)
        self._walk = Walk(self._plan, self._y, (self.t, tf))
        return self._walk

    def _start_anew(self, target: float, chosen: _Integrator) -> None:
        """Integrate from the current time to `target`, calling solout at the start and after each step."""
        walk = self._walk_to(target, chosen)
        solout, most, steps, core, state = self._solout is not None, chosen.nsteps, 0, walk.core, "running"
        stopped = solout and self._is_stopped()
        while not stopped and steps != most and state == "running":
            steps += walk.advance(target, 1 if solout else most)
            self.t, self._y, state = core.point
            stopped = solout and state in ("running", "reached_end") and self._is_stopped()
        if state == "reached_end" and not stopped:  # the common case
            self._code = chosen.codes.success
        else:
            self._end(walk, chosen, reached=False, stopped=stopped)

    def _is_stopped(self) -> bool:
        """Return whether solout ends the call at the current point."""
        answer = None if self._solout is None else self._solout(self.t, self._y.copy())
        return answer is not None and bool(answer < 0)

    def _has_passed(self, target: float) -> bool:
        """Move to `target` if it is within the last step of the run: the common case in loops."""
        y = None if self._walk is None else self._walk.at(target)
        if y is None:
            return False
        self.t, self._y, self._code = target, y, _ODEPACK.success
        return True

    def _go_on(self, target: float, chosen: _Integrator, *, step: bool, relax: bool) -> None:
        """Advance this run until it has passed `target`, or by a single step."""
        walk, ahead = self._walk, math.copysign(1.0, target - self.t)
        leads = walk is not None and walk.state == "running" and walk.forward * (target - walk.core.t_old) >= 0
        if walk is None or not leads or (step and walk.forward != ahead):
            walk = self._walk_to(math.copysign(math.inf, ahead), chosen)
        goal = math.nextafter(self.t, target) if step else target
        walk.advance(goal, chosen.nsteps)
        if not (step or relax) and self._has_passed(target):
            return
        self.t, self._y, state = walk.core.point
        reached = state == "running" and walk.forward * (goal - self.t) <= 0
        self._end(walk, chosen, reached=reached, stopped=False)

    def _end(self, walk: Walk, chosen: _Integrator, *, reached: bool, stopped: bool) -> None:
        """Set the return code of a call, with a warning if it failed."""
        codes = chosen.codes
        if reached or stopped:
            self._code = codes.stopped if stopped else codes.success
            return
        self._walk = None
        if walk.state == "running":
            self._code, why = codes.too_long, f"nsteps = {chosen.nsteps} is reached at t = {self.t:.6g}: raise it"
        else:
            why = walk.failure[1]
            newton = walk.core.result().cause == "newton"
            wrong = walk.state in ("start_undefined", "invariant_convicted")
            self._code = codes.wrong if wrong else codes.unsolved if newton else codes.failed
        warn(f"{chosen.name}: {why}")


def _are_same_numbers(before: tuple[Any, ...], after: tuple[Any, ...]) -> bool:
    """Return whether arguments are floats or ints with the same values; nothing else is known not to have changed."""
    alike = len(before) == len(after) > 0
    return alike and all(type(a) is type(b) in (float, int) and a == b for a, b in zip(before, after, strict=True))


@public
class complex_ode(ode):  # noqa: N801 - SciPy's name
    """`ode` for complex states.

    Parameters
    ----------
    f, jac, invariants
        As for `ode`, with complex y; invariants return real numbers. Complex components are integrated as pairs of
        real numbers, so that f need not be analytic, except if `jac` is passed.

    Attributes
    ----------
    t, y
        As for `ode`.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> run = iv.complex_ode(lambda t, y: 1j * y).set_integrator("dopri5").set_initial_value(1.0)
    >>> bool(abs(run.integrate(np.pi)[0] + 1) < 1e-5)
    True
    """

    _complex = True

    def set_integrator(self, name: str, **integrator_params: Any) -> Self:
        """See `ode.set_integrator`."""
        if _scipys(name) == ("zvode", _SCIPYS["zvode"]):
            raise ValueError("zvode must be used with ode, not complex_ode")
        return super().set_integrator(name, **integrator_params)
