"""Options as users give them: checked against the table, or named in an error with their counterparts here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal, TypeVar, cast

from .._base.arguments import kept, warn
from .._base.suggestions import meant
from .._base.types import MethodName
from .methods import Method, find_method
from .options import TABLE, DescribingOptions, ManyOptions, Options, ProblemArguments, table_of

#: What to write instead of a mass matrix that a method, or all of them, cannot take.
INSTEAD_OF_MASS = (
    "solve M y' = f for y' in fun; MechanicalSystem(M, force) takes M(t, q), and solve_dae any F(t, y, y') = 0"
)
#: Names of options elsewhere, in lower case: of MATLAB's odeset, SciPy's odeint and ode, Julia, and of arguments that
#: belong to a value of several fields; and their counterparts here.
_STEPS = "steps follow from rtol and atol: limit them by max_step=, and set output times by t_eval="
_OF_EVENTS = "it belongs to an event, invariode.Event(fun, terminal=, direction=)"
_ELSEWHERE: Mapping[str, str] = {
    **dict.fromkeys(("step", "dt", "h", "stepsize", "step_size"), _STEPS),
    **dict.fromkeys(("h0", "initialstep", "dt0"), "pass first_step="),
    **dict.fromkeys(("hmax", "maxstep", "dtmax"), "pass max_step="),
    **dict.fromkeys(("hmin", "minstep", "dtmin"), "pass min_step="),
    **dict.fromkeys(("mxstep", "nsteps", "maxiters", "max_iter", "maxiter"), "pass max_steps="),
    **dict.fromkeys(("isterminal", "terminal", "direction"), _OF_EVENTS),
    **dict.fromkeys(("n_jobs", "njobs", "n_workers", "processes", "threads"), "pass workers= to solve_ensemble"),
    **dict.fromkeys(("outputfcn", "solout"), "pass callback=, which is called after each step and stops by True"),
    **dict.fromkeys(("saveat", "teval", "times"), "pass t_eval="),
    **dict.fromkeys(("tstops", "tcrit", "d_discontinuities"), "pass breakpoints="),
    **dict.fromkeys(("jacobian", "dfun"), "pass jac="),
    **dict.fromkeys(("ml", "mu"), "pass lband= and uband="),
    **dict.fromkeys(("reltol", "relative_tolerance"), "pass rtol="),
    **dict.fromkeys(("abstol", "absolute_tolerance"), "pass atol="),
    "tol": "pass rtol= and atol=",
    "jpattern": "pass jac_sparsity=",
    "jumps": "pass breakpoints=",
    "initialy": "pass y0=",
    "normcontrol": "errors are controlled by component; atol may be an array",
    "outputsel": "callback(t, y) receives all components",
    **dict.fromkeys(("mstatedependence", "mvpattern"), f"mass depends on t at most: {INSTEAD_OF_MASS}"),
    **dict.fromkeys(("masssingular", "initialslope"), "not needed: found from mass, and consistent values computed"),
    "mass_matrix": "pass mass=",
    "solver": "pass method=",
    "stats": "every solution has them, as sol.stats",
    "dense": "pass dense_output=True",
    "lags": "pass delays= and history=, see the how-to on delays",
    "time_limit": "pass limits=invariode.Limits(time=)",
    "max_points": "pass limits=invariode.Limits(points=)",
    "krylov_dimension": "pass linear_solver=invariode.GMRES(dimension=)",
    "preconditioner": "pass linear_solver=invariode.GMRES(preconditioner=)",
    "jac_product": "pass linear_solver=invariode.GMRES(jac_product=)",
}

_OF_A_RUN = table_of(Options)
_DEFAULTS = {name: row.default for name, row in _OF_A_RUN.items()}
#: Options whose values may be arrays.
_OF_ARRAYS: tuple[Literal["t_eval", "rtol", "atol", "breakpoints"], ...] = ("t_eval", "rtol", "atol", "breakpoints")
_OF_SOME_METHODS = frozenset(name for name, row in TABLE.items() if not row.every_method)

_Part = TypeVar("_Part")


def checked(given: Options, method: Method) -> Options:
    """Return all options of a run: the given ones, each checked, and the defaults. An option that the method cannot use
    draws a warning, an unknown one raises an error."""
    complete = dict(_DEFAULTS)
    for name, value in given.items():
        row = _OF_A_RUN.get(name)
        if row is None:
            raise refused(name)
        if value is row.default:
            continue
        complete[name] = row.check(name, value) if value is not None or row.default is not None else None
        if name in _OF_SOME_METHODS:
            warn_unused(method, name, value)
    return cast("Options", complete)


def refused(name: str) -> TypeError:
    """The error for an option that a run cannot have."""
    if name in ProblemArguments.__annotations__:
        where = "Problem or solve_ivp" if name in TABLE else "Problem"
        return TypeError(
            f"{name} describes the problem: it is an argument of {where}, not an option of a run; "
            f"for another one, problem.replace({name}=...).solve(...)"
        )
    if name in TABLE:
        where = "solve_ensemble" if name in ManyOptions.__annotations__ else "solve_ivp"
        return TypeError(f"{name} is an option of {where}, not of a run")
    return unknown_option(name, TABLE)


def unknown_option(name: str, known: Iterable[str], text: str = "unknown option") -> TypeError:
    """Return the error for an unknown name, with its counterpart here if other packages have it, else the nearest."""
    return TypeError(f"{text} {name!r}{_hint(name, known)}")


def _hint(name: str, known: Iterable[str]) -> str:
    known = [*known]
    lower = name.lower()
    if lower != name and lower in known:  # MATLAB's capitals
        return f": write {lower}="
    snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")
    if snake != name and snake in known:
        return f": write {snake}="
    return f": {_ELSEWHERE[lower]}" if lower in _ELSEWHERE else meant(name, known)


def keeping_arrays(given: Options) -> Options:
    """Return the options with copies of what the caller could change later."""
    options = given.copy()
    for name in _OF_ARRAYS:
        value = options.get(name)
        if value is not None and type(value) is not float:
            options[name] = kept(value)
    return options


def changed(options: Options, changes: Mapping[str, Any]) -> Options:
    """The options with changes. New limits replace `max_steps`, their short form, and the other way round."""
    kept: dict[str, Any] = dict(options)
    if changes.get("limits") is not None:
        kept.pop("max_steps", None)
    elif "max_steps" in changes and kept.get("limits") is not None:
        kept["limits"] = replace(kept["limits"], steps=None)
    return cast("Options", {**kept, **changes})


def warn_unused(method: Method, name: str, given: object) -> None:
    """A warning if an option was given that the method cannot use."""
    if name not in method.options and given is not None and given is not False:
        warn(f"option {name!r} has no effect on {method.name}")


def unused(method: MethodName, describing: DescribingOptions) -> None:
    """Warn of options describing the problem that the method cannot use. A mass matrix that the method cannot use is an
    error in the plan."""
    for name, given in describing.items():
        if name in _OF_SOME_METHODS and name != "mass":
            warn_unused(find_method(method)[0], name, given)


def parted(options: Mapping[str, Any], kind: type[_Part]) -> tuple[_Part, Any]:
    """Split options in two: those that the class has, and the others."""
    own = kind.__annotations__
    mine: Any = {}
    others: Any = {}
    for name, value in options.items():
        (mine if name in own else others)[name] = value
    return mine, others
