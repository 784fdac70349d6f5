"""The problem: everything that describes it, checked once, and the methods that solve it."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from types import FunctionType
from typing import TYPE_CHECKING, Any, Never, Self, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    LAMBDIFIED,
    Array,
    call_name,
    default_labels,
    distinct_labels,
    encodable,
    extra_arguments,
    flag,
    function,
    interval,
    items,
    require_no_unit,
    shown,
    state,
    warn_of_order,
)
from .._base.forks import cached_property
from .._base.labelled import by_name, named, require_names
from .._base.notebook import html_of_problem
from .._base.record import Record, record_of
from .._base.types import BreakpointsLike, EventsLike, Function, MethodName, Span
from .._core import StateFirst, plainly_posed
from .._functions.compile import compile
from .._functions.compiled import CompiledFunction, CoreFunction, is_native
from .._functions.forms import Filling, unlambdified
from .._functions.graph.function import TracedFunction
from .._functions.second_order import SecondOrder, states_second_order
from .bounds import Bounds, to_bounds
from .breakpoints import Breakpoint, to_breakpoints, warn_of_idle_actions
from .delays import Delays, DelaysLike, FillingOfPast, HistoryLike, StartOfHistory, start_of, to_delays
from .docstrings import documented
from .events import Event, direction_sign, of_one_run, roots_among, terminal_count, to_events
from .given_options import unknown_option
from .inputs import Input, InputsLike, to_inputs
from .invariants import Invariants, InvariantsLike, to_invariants
from .jacobian_and_mass import NO_MATRICES, Matrices, own_list, own_matrix, to_matrices
from .options import CallingOptions, DescribingOptions, Options, ProblemArguments, ProblemEnsembleOptions, table_of
from .parameters import ParameterName, names_of_arguments, names_of_last_arguments, with_named
from .sensitivities import OF_ALL_ARGS, Sensitivities, SensitivitiesLike, to_sensitivities
from .slope import Slope
from .start import ChangedStart, follow_start

if TYPE_CHECKING:
    from .._ensemble.ensemble_solution import EnsembleSolution
    from .._ensemble.store import EnsembleStore
    from .._results.solution import Solution
    from .._solve.prepared_solver import PreparedSolver
    from .accepted import problem_ensemble_options, run_options

__all__ = ["Problem"]

_ARGUMENTS = ProblemArguments.__annotations__.keys()
_NOTHING_GIVEN: Mapping[str, Any] = dict.fromkeys(
    ("jac", "jac_sparsity", "lband", "uband", "mass", "nonnegative", "bounds")
)
#: The attributes of a problem that has nothing besides f, y0, t_span and args.
_NOTHING_ELSE: Mapping[str, Any] = {
    **dict.fromkeys(("invariants", "events", "inputs", "breakpoints"), ()),
    **dict.fromkeys(("bounds", "delays", "sensitivities", "y0_of_args", "_title", "_labels"), None),
    **dict.fromkeys(("records_events", "second_order", "signed_states"), False),
    "matrices": NO_MATRICES,
    "_as_given": _NOTHING_GIVEN,
}


#: Arguments of a problem in which rows of ensembles and runs of a loop differ.
_OF_A_START = {"y0", "args"}


@documented(describing=[*table_of(CallingOptions), *table_of(DescribingOptions)])
class Problem:
    """An initial value problem y' = f(t, y), or M y' = f(t, y), y(t0) = y0, with what is known about its solution.

    Parameters
    ----------
    fun : callable
        ``f(t, y, *args)``, the derivative, a sequence or array of shape (n,). y is a new array if the last one is still
        referenced, so it may be kept; the function may return the same buffer every time.
    t_span : (float, float)
        (t0, tf). tf < t0 integrates backwards. With an infinite tf the run goes on until a terminal event, a callback
        or one of its `limits` ends it.
    y0 : array_like of shape (n,) or callable
        Initial state, real or complex. A dict or Series of pandas is matched with `labels`; without `labels`, its names
        become the labels. Or a function ``y0(*args)`` that returns it: then the initial state follows the
        arguments, in `replace`, ensembles and fits, and in sensitivities.
    {describing}
    parameters : dict of str and float, optional
        Numbers by any name, instead of `args`: f and all other functions of the problem are called as ``f(t, y, p)``
        with a record p that has them as ``p["k1"]`` and ``p.k1``. Sensitivities, fits, ensembles and `replace` use
        these names.
    inputs : Input or list of Input, optional
        Tabulated functions of t: `fun` and `jac` are called with their values after y, ``f(t, y, u, *args)``; native
        ones find these at the beginning of p. A run starts anew where an input jumps, as at `breakpoints`.
    breakpoints : list of float or of (float, callable), or dict of callables by time, optional
        Times at which functions of the problem may jump, and what the solution does there, such as doses, as in
        `solve_ivp`. Every run has them, together with those among its own options; at one time the actions of the
        problem come first. Those beyond `t_span` take effect on other intervals.
    name : str, optional
        For tables and plots.
    labels : sequence of n str, optional
        Names of the components.

    Raises
    ------
    TypeError
        An argument of a wrong type, such as a `fun` that is not callable.
    ValueError
        y0 or `t_span` is not finite (tf may be infinite) or of a wrong shape; the number of `labels` is not n; an input
        does not cover `t_span`; a constant `jac`, `mass` or `jac_sparsity` is no matrix of n components. What functions
        return is checked by `solve`.

    Notes
    -----
    A problem does not change: `replace` makes another one.

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

    Parameters by name:

    >>> def decay(t, y, p):
    ...     return [-p["lambda"] * y[0]]
    >>> slow = iv.Problem(decay, (0, 1), [1.0], parameters={"lambda": 0.5})
    >>> fast = slow.replace(parameters={"lambda": 2.0})
    >>> fast.parameters
    {'lambda': 2.0}
    """

    fun: Any
    t_span: tuple[float, float]
    y0: Array
    args: tuple[Any, ...]
    invariants: Sequence[Invariants]
    events: Sequence[Event]
    matrices: Matrices
    inputs: Sequence[Input]
    breakpoints: Sequence[Breakpoint]
    bounds: Bounds | None
    signed_states: bool  # components may be negative, by `nonnegative=False`
    delays: Delays | None
    sensitivities: Sensitivities | None
    y0_of_args: Callable[..., Any] | None
    records_events: bool
    second_order: bool
    _title: str | None
    _labels: list[str] | None
    _as_given: Mapping[str, Any]

    def __init__(
        self,
        fun: Function,
        t_span: Span,
        y0: ArrayLike | Callable[..., Any],
        *by_position: Never,
        args: Iterable[Any] | None = (),
        parameters: Mapping[str, float] | None = None,
        invariants: InvariantsLike | None = None,
        events: EventsLike = None,
        jac: Any = None,
        jac_sparsity: Any = None,
        lband: int | None = None,
        uband: int | None = None,
        mass: Any = None,
        second_order: bool = False,
        inplace: bool = False,
        nonnegative: Any = None,
        bounds: Any = None,
        sensitivities: SensitivitiesLike | None = None,
        inputs: InputsLike | None = None,
        breakpoints: BreakpointsLike | None = None,
        delays: DelaysLike | None = None,
        history: HistoryLike | None = None,
        name: str | None = None,
        labels: Sequence[str] | None = None,
        **unknown: Never,
    ) -> None:
        if unknown or by_position:
            raise _no_such_argument(unknown, by_position)
        if parameters is not None or not (args is None or type(args) is tuple):
            args = _args_or(fun, parameters, args)
        if y0 is None and history is not None:
            y0 = start_of(history, t_span, args)
        state, of_args = (y0(*extra_arguments(args)), y0) if callable(y0) else (y0, None)
        if labels is not None:
            state = by_name("y0", state, labels, "components")
        described = self.__dict__
        if inplace is not False:
            fun = _filled(fun, inplace, delays is not None)
        self.plain(fun, t_span, state, args, self)
        called, start = self.fun, self.y0
        if of_args is not None:
            described["y0_of_args"] = of_args
        given: dict[str, Any] = {}
        if not (jac is jac_sparsity is lband is uband is mass is None):
            given = {"jac": jac, "jac_sparsity": jac_sparsity, "lband": lband, "uband": uband, "mass": mass}
            given = {key: own_matrix(one) for key, one in given.items()}
            described["matrices"] = to_matrices(**given, y0=start)
        if labels is not None:
            described["_labels"] = distinct_labels(labels, len(start))
        if nonnegative is not None or bounds is not None:
            described["bounds"] = to_bounds(nonnegative, bounds, start, self._labels)
            described["signed_states"] = nonnegative is False
            given |= {"nonnegative": own_list(nonnegative), "bounds": own_list(bounds)}
        if given:
            described["_as_given"] = {**_NOTHING_GIVEN, **given}
        if invariants is not None:
            described["invariants"] = to_invariants(invariants)
        if events is not None:
            listed = to_events(events)
            for event in listed:
                terminal_count(event), direction_sign(event)
            described |= {"events": listed, "records_events": True}
        if inputs is not None:
            described["inputs"] = to_inputs(inputs, self.t_span)
        if breakpoints is not None:
            described["breakpoints"] = to_breakpoints("breakpoints", breakpoints)
            warn_of_idle_actions(breakpoints, self.t_span)
        if delays is not None or history is not None:
            described["delays"] = to_delays(delays, history, self)
        if name is not None:
            described["_title"] = _named(name)
        if second_order is not False:
            described["second_order"] = _is_second_order(second_order, called, start)
        if sensitivities is not None:
            described["sensitivities"] = wanted = to_sensitivities(sensitivities)
            known = wanted is OF_ALL_ARGS and of_args is None and {*map(type, self.args)} == {float}
            if wanted is not None and (self.args or of_args is not None) and not known:
                described["sensitivities"] = follow_start(wanted, of_args, self.parameter_names(), len(start))

    @classmethod
    def plain(
        cls, fun: Any, t_span: Span, y0: ArrayLike, args: Iterable[Any] | None, problem: Self | None = None
    ) -> Self:
        """Return the problem ``y' = fun(t, y, *args)`` with nothing else, which takes less time than to see that
        every other argument is missing. `problem`: one that is being made, and is to be that problem."""
        plain = plainly_posed(t_span, y0, args)
        if plain is not None:
            span, start, extra = plain
            if extra:
                require_no_unit("args", extra)
        else:
            if (by_label := named("y0", y0)) is not None:
                y0 = [*by_label.values()]
            span, start = interval(t_span), state(y0)
            extra = extra_arguments(_args_by_name(fun, args))
            start.setflags(write=False)
        called, second_order = fun, False
        if type(fun) is FunctionType and fun.__name__ != LAMBDIFIED:  # the common case
            warn_of_order("fun", fun, "f(t, y)", ", or use odeint")
        elif type(fun) is not StateFirst:
            called = fun if type(fun) is TracedFunction and start.dtype.kind == "f" else _as_called(fun, start)
            second_order = states_second_order(called) and _is_second_order(False, called, start)
        if extra and np.ndarray in map(type, extra):  # which the caller could change
            extra = tuple(one.copy() if type(one) is np.ndarray else one for one in extra)
        if problem is None:
            problem = cls.__new__(cls)
        described = problem.__dict__
        described.update(_NOTHING_ELSE, fun=called, t_span=span, y0=start, args=extra, second_order=second_order)
        if plain is None and by_label is not None:  # names of components that have no others
            described["_labels"] = distinct_labels([*by_label], len(start))
        return problem

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return call_name(self.fun, "problem") if self._title is None else self._title

    def start_with(self, args: tuple[Any, ...]) -> Array:
        """Return the initial state with other arguments, (n,)."""
        return self.y0 if self.y0_of_args is None else state(self.by_component("y0", self.y0_of_args(*args)))

    def _require_real(self, what: str) -> None:
        """Raise an error unless the states are real; `what` is not defined for complex ones."""
        if self.y0.dtype.kind == "c":
            raise ValueError(
                f"{what} is for real problems, and y0 is complex: write the problem in real and imaginary parts"
            )

    def parameter_names(self) -> tuple[ParameterName, ...]:
        """The parameters of the sensitivities, in their order; without `sensitivities` none."""
        return self._parameters

    @property
    def parameters(self) -> dict[str, float] | None:
        """The parameters by name, of a problem that was made with `parameters`; otherwise None."""
        record = _record_in(self.args)
        return None if record is None else dict(record.items())

    def arguments(self, given: Any) -> Any:
        """The arguments that were given in place of `args`: labelled values change some of them, by name."""
        changes = named("args", given)
        if changes is None:
            return given
        record = _record_in(self.args)
        if record is not None:
            return (record.changed(changes, self.labels),)
        if not self.args:
            return _args_by_name(self.fun, changes)
        return with_named(self.fun, self.args, self._labels, changes, first=2 + len(self.before_args))

    def by_component(self, what: str, given: Any, now: Array | Callable[[], Array] | None = None) -> Any:
        """Labelled values in the order of the components; those without labels as they are. `now`: values of the
        components that have no label, or a function that returns them; None: each must have one."""
        if type(given) in (float, np.ndarray):  # the common cases
            return given
        return by_name(what, given, self.labels, "components", now)

    def start_by_name(self, given: Any) -> Any:
        """The initial state that was given in place of y0: labelled values change some components, by name. Where y0
        is a function of the arguments, the others follow them as before."""
        start = self.y0_of_args
        if start is None or isinstance(start, StartOfHistory):
            return self.by_component("y0", given, self.y0 if start is None else None)
        found = named("y0", given, self.labels)
        if found is None or set(found) >= set(self.labels):
            return self.by_component("y0", given)
        require_names("y0", found, self.labels, "components", complete=False)
        return ChangedStart(start, self.labels, found)

    @property
    def inplace(self) -> bool:
        """f is given as a function that fills its third argument."""
        fun = self.fun.fun if isinstance(self.fun, SecondOrder) else self.fun
        return isinstance(fun, (Filling, FillingOfPast))

    @cached_property
    def _parameters(self) -> tuple[ParameterName, ...]:
        if self.sensitivities is None:
            return ()
        named = self.sensitivities.names
        return named(self.fun, self.args, self._labels, len(self.y0), first=2 + len(self.before_args))

    def __setattr__(self, name: str, value: Any) -> None:
        argument = name in ProblemArguments.__annotations__
        instead = f"make another one, problem.replace({name}=...)" if argument else "it has only its arguments"
        raise AttributeError(f"a Problem does not change, and {name} cannot be set: {instead}")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"a Problem does not change, and {name} cannot be deleted")

    @property
    def slope(self) -> Slope:
        """f as runs call it."""
        return Slope(self.fun, self.inputs, self.args, self.delays)

    @property
    def before_args(self) -> list[Any]:
        """The arguments of f between y and `args`: delayed values, of which nothing is known here, and inputs."""
        return [*([] if self.delays is None else [None]), *self.inputs]

    @property
    def history(self) -> Callable[[float], Array] | None:
        """y before the start as a function of t, of a problem with delays."""
        return None if self.delays is None else partial(self.delays.before, args=self.args)

    def require_no_delays(self, what: str) -> None:
        """Raise an error if the problem has delays; `what` is not defined for them."""
        if self.delays is not None:
            raise ValueError(f"{what} is for problems without delays: here f depends on the past of y")

    def replace(self, **changes: Unpack[ProblemArguments]) -> Self:
        """A copy of this problem with some arguments changed.

        Parameters
        ----------
        **changes
            Arguments of `Problem` by name, `fun`, `t_span` and `y0` included. `parameters` changes the values of those
            that it names, if the problem has parameters; so do `args`, as a dict or Series by the names that f has for
            its arguments, and `y0`, by `labels`.

        Raises
        ------
        TypeError, ValueError
            As for `Problem`; also a name that `Problem` does not know.

        Examples
        --------
        >>> import invariode as iv
        >>> def decay(t, y, rate):
        ...     return [-rate * y[0]]
        >>> slow = iv.Problem(decay, (0, 1), [1.0], args=(1,))
        >>> fast = slow.replace(args={"rate": 10}, name="fast decay")
        >>> slow, fast
        (Problem('decay', t_span=(0.0, 1.0), n=1), Problem('fast decay', t_span=(0.0, 1.0), n=1))
        """
        if "args" in changes and "fun" not in changes:
            changes["args"] = self.arguments(changes["args"])
        if "y0" in changes and "labels" not in changes:
            changes["y0"] = self.start_by_name(changes["y0"])
        if changes.keys() <= _OF_A_START and (other := self._from(changes)) is not None:
            return other
        for name in changes.keys() - ProblemArguments.__annotations__.keys():
            if name in names_of_arguments(self.fun, len(self.args), 2 + len(self.before_args)):
                raise TypeError(f'{name} is an argument of fun: replace(args={{"{name}": value}}) changes it')
        start = self.y0_of_args
        now = {
            "fun": self.fun,
            "t_span": self.t_span,
            "y0": self.y0 if start is None else None if isinstance(start, StartOfHistory) else start,
            "args": self.args,
            "invariants": self.invariants,
            "events": self.events if self.records_events else None,
            **self._as_given,
            "second_order": self.second_order and not states_second_order(self.fun),
            "inplace": self.inplace,
            "sensitivities": self.sensitivities,
            "inputs": self.inputs or None,
            "breakpoints": self.breakpoints or None,
            "delays": None if self.delays is None else self.delays.given,
            "history": None if self.delays is None else self.delays.history,
            "name": self._title,
            "labels": self._labels,
        }
        if (parameters := changes.get("parameters")) is not None:
            record = _record_in(self.args)
            if record is None and self.args:
                raise TypeError('the problem has args, which change by name with replace(args={"name": value})')
            changes["parameters"] = (
                parameters if record is None else dict(record.changed(parameters, self.labels).items())
            )
            now["args"] = ()
        return type(self)(**{**now, **changes})

    def _from(self, changes: ProblemArguments) -> Self | None:
        """Return the problem from another initial state of the same type and size, or with other arguments, if nothing
        else depends on these; otherwise None."""
        if self.sensitivities is not None or self.y0_of_args is not None or self.delays is not None:
            return None
        y0, args = changes.get("y0", self.y0), changes.get("args", self.args)
        if callable(y0):
            return None
        other = type(self).plain(self.fun, self.t_span, y0, args)
        if other.y0.shape != self.y0.shape or other.y0.dtype != self.y0.dtype:
            return None
        other.__dict__.update({name: self.__dict__[name] for name in _NOTHING_ELSE})
        return other

    def of_one_run(self) -> Self:
        """Return the problem with `Roots` whose memory belongs to one run."""
        if not roots_among(self.events):
            return self
        problem = copy.copy(self)
        problem.__dict__["events"] = of_one_run(self.events, self.t_span[0], self.y0, self.args)
        return problem

    @property
    def labels(self) -> list[str]:
        """Names of the components."""
        return default_labels(len(self.y0)) if self._labels is None else self._labels

    @documented(options=table_of(Options))
    def solve(self, method: MethodName = "ode45", **options: Unpack[Options]) -> Solution:
        """Solve the problem.

        Parameters
        ----------
        method : str, default 'ode45'
            A name in `METHODS`, or SciPy's name of the same method.
        {options}

        Returns
        -------
        Solution

        Raises
        ------
        TypeError, ValueError, InvariantError
            As for `solve_ivp`. The warnings are the same too.
        """
        if TYPE_CHECKING:
            run_options(**options)  # never called: editors complete options from this call
        from .._run.run import solve

        return solve(self, method, options)

    @documented(options=table_of(Options))
    def prepare(self, method: MethodName = "ode45", **options: Unpack[Options]) -> PreparedSolver:
        """Return a solver for this problem with any y0, args and interval, which checks everything else only once.

        For loops of short solves: fitting, shooting, Monte Carlo. A call costs a few µs beyond its steps, whatever the
        problem has: events, bounds, invariants, arguments, sensitivities of compiled functions. It costs as much as a
        solve where something is found anew for another y0, other arguments or another interval: a Jacobian in Python
        (`jac`), algebraic equations, sensitivities of Python functions, a mechanical system, times of `breakpoints` or
        of conditions of f on another interval, and options that work around the run, such as `progress`.

        Parameters
        ----------
        method : str, default 'ode45'
            As in `solve`.
        {options}

        Returns
        -------
        PreparedSolver
            Called as ``solver(y0=..., args=..., t_span=..., dy0dp=...)``, by any number of threads at once, it returns
            the `Solution` that ``problem.replace(y0=..., args=..., t_span=...).solve(method, **options)`` returns, with
            these derivatives of y0 in its `Sensitivities`.

        Raises
        ------
        TypeError, ValueError, InvariantError
            As for `solve`. The warnings are the same too.

        Examples
        --------
        >>> import invariode as iv
        >>> def decay(t, y, rate):
        ...     return [-rate * y[0]]
        >>> solver = iv.Problem(decay, (0, 1), [1.0], args=(1.0,)).prepare("dop853", rtol=1e-9, keep="end")
        >>> [round(float(solver(args=(rate,)).y[0, -1]), 4) for rate in (1.0, 2.0, 3.0)]
        [0.3679, 0.1353, 0.0498]
        """
        if TYPE_CHECKING:
            run_options(**options)
        from .._solve.prepared_solver import PreparedSolver

        return PreparedSolver(self, method, options)

    @overload
    def solve_ensemble(
        self,
        y0: ArrayLike | Iterator[tuple[ArrayLike, Any]] | None = None,
        method: MethodName = "ode45",
        *,
        args: Iterable[Any] | ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
        store: None = None,
        **options: Unpack[ProblemEnsembleOptions],
    ) -> EnsembleSolution:
        raise NotImplementedError(problem_ensemble_options(**options))  # never called: editors follow it

    @overload
    def solve_ensemble(
        self,
        y0: ArrayLike | Iterator[tuple[ArrayLike, Any]] | None = None,
        method: MethodName = "ode45",
        *,
        args: Iterable[Any] | ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
        store: str | os.PathLike[str],
        **options: Unpack[ProblemEnsembleOptions],
    ) -> EnsembleStore: ...
    @documented({"on_failure": "warn"}, options=table_of(ProblemEnsembleOptions))
    def solve_ensemble(
        self,
        y0: ArrayLike | Iterator[tuple[ArrayLike, Any]] | None = None,
        method: MethodName = "ode45",
        *,
        args: Iterable[Any] | ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
        store: str | os.PathLike[str] | None = None,
        **options: Unpack[ProblemEnsembleOptions],
    ) -> EnsembleSolution | EnsembleStore:
        """Solve the problem from many initial values, or with many parameter sets, in parallel.

        The result is the same, bit for bit, for any number of workers, and the same as that of single solves. A
        trajectory that fails, also with an exception, gets a status, a message and NaN as its final state; the others
        go on. One warning says how many failed: see `on_failure`.

        Parameters
        ----------
        y0 : array_like of shape (N, n) or (n,), or iterator, optional
            Initial states, one row per trajectory, or one for all. A DataFrame, a dict of columns or the like is
            matched with `labels`; components that it leaves out keep the problem's values. Default: the problem's. An
            iterator yields pairs ``(y0, args)`` of one trajectory, with a tuple of args, or of several, with rows; N
            need not be known, nor fit in memory.
        method : str, default 'ode45'
            As in `solve`.
        args : tuple, or array or list of shape (N, k), or dict, optional
            A tuple: the extra arguments of all trajectories. Rows: row i holds the k extra arguments of trajectory i;
            those of a list may be of any types. By name, of parameters or of f's arguments: a DataFrame or a dict of
            columns of N numbers, or a list of N dicts. For a problem with `parameters` rows have all of them. Default:
            the problem's.
        t_eval : array_like, optional
            Times of the output, sorted in the direction of integration. Default: the final states are kept, and no
            others.
        store : str or path-like, optional
            A Zarr store for the results, written part by part: memory does not grow with N. Needs zarr, of the extra
            `cluster`.

        Other Parameters
        ----------------
        {options}

        Returns
        -------
        EnsembleSolution or EnsembleStore
            The second with a `store`.

        Raises
        ------
        FileExistsError
            There is a store of this name, and not `resume`.
        TypeError, ValueError
            An error that affects every trajectory, or a store that belongs to another problem. With several processes
            on a platform that starts them afresh (not by fork): a function that cannot be pickled, such as a lambda or
            one defined in a function or a notebook.
        RuntimeError
            The processes end before they solve anything: they cannot import the functions. An executor lost its
            processes and cannot start others.

        Notes
        -----
        An invariant without `value` is held at its initial value of each trajectory. The options are those of `solve`
        except for `dense_output`, `refine` and those of a single run's course.

        Where all functions are native (`invariode.compile` and the like), trajectories run on threads in the core,
        which take work from each other as they run out of it; memory is the result plus a few vectors per thread.
        Otherwise they run in processes, and each function must be importable there: on platforms without fork define it
        in a module, guard the script by ``if __name__ == "__main__":``, or give ``workers=1``, which stays in this
        process; so does, with a warning, an ensemble in a daemonic process. Workers end with this process, however it
        ends. The result takes 8 (n n_t + 2 n + 3 m) + 136 bytes per trajectory, and 8 (n + 2) per event that occurred.

        Examples
        --------
        >>> import invariode as iv
        >>> def orbit(t, y):
        ...     return [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]
        >>> problem = iv.Problem(orbit, (0, 10), [1.0, 3.0], labels=["prey", "predators"])
        >>> many = problem.solve_ensemble([[1.0, 3.0], [1.0, 2.0], [1.0, 1.0]], workers=1, rtol=1e-6)
        >>> many
        EnsembleSolution of 3 trajectories, 2 components, 1 time: 3 reached the end
        """
        from .._ensemble.ensemble import Wanted, solve_rows

        return solve_rows(self, Wanted(y0, args, t_eval, store), method, options)

    def _repr_html_(self) -> str:
        return html_of_problem(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, t_span={self.t_span}, n={len(self.y0)})"


def _no_such_argument(unknown: Iterable[str], by_position: Sequence[Any]) -> TypeError:
    """Return the error for an argument that a problem does not have, or that is given by position."""
    for name in unknown:
        return unknown_option(name, _ARGUMENTS, "Problem has no argument")
    return TypeError(
        "Problem takes fun, t_span and y0 by position and everything else by name, as in args=..., got "
        f"{shown(by_position[0])} as a fourth"
    )


def _args_by_name(fun: Any, args: Iterable[Any] | None) -> Iterable[Any] | None:
    """Return labelled arguments in the order in which f takes them, as its last ones."""
    given = named("args", args)
    if given is None:
        return args
    known = names_of_last_arguments(fun, len(given))
    instead = "; numbers by any name are Problem(parameters=...), with f(t, y, p); a dict as an argument is args=(d,)"
    require_names("args", given, known, "last arguments of fun", complete=True, instead=instead)
    return tuple(given[name] for name in known)


def _args_or(fun: Any, parameters: Any, args: Iterable[Any] | None) -> Iterable[Any] | None:
    """The arguments of f: a record of the parameters, if there are any."""
    if parameters is None:
        return _args_by_name(fun, args)
    if args is not None and items(args) != []:
        raise ValueError("a problem has args or parameters: put the numbers of args among the parameters")
    return (record_of(parameters),)


def _record_in(args: tuple[Any, ...]) -> Record | None:
    """The record of parameters, if they are all that f takes."""
    return args[0] if len(args) == 1 and isinstance(args[0], Record) else None


def _as_called(fun: Any, y0: Array) -> Any:
    """Return f as the solvers call it."""
    called = fun if is_native(fun) else unlambdified(function("fun", fun, "f(t, y)"))
    if isinstance(called, SecondOrder) and isinstance(called.fun, TracedFunction):
        called = compile(called)
    return called.of_complex() if y0.dtype.kind == "c" and isinstance(called, TracedFunction) else called


def _filled(fun: Any, inplace: bool, delayed: bool = False) -> Any:
    """Return f as a function that returns its values, if it is given as one that fills an array."""
    if not flag("inplace", inplace):
        return fun
    if delayed and callable(fun) and not is_native(fun):
        return fun if isinstance(fun, FillingOfPast) else FillingOfPast(fun)
    if isinstance(fun, SecondOrder):
        return SecondOrder(_filled(fun.fun, inplace))
    if isinstance(fun, Filling) or (isinstance(fun, CompiledFunction) and fun.inplace):
        return fun
    if isinstance(fun, CompiledFunction):
        raise TypeError("inplace: fun was compiled as a function that returns its values: compile(fun, inplace=True)")
    if is_native(fun) or isinstance(fun, CoreFunction) or not callable(fun):
        raise TypeError(f"inplace: fun must be a Python function f(t, y, out), got {shown(fun)}")
    return Filling(fun)


def _is_second_order(given: bool, fun: Any, y0: Array) -> bool:
    found = flag("second_order", given) or states_second_order(fun)
    if found and len(y0) % 2:
        raise ValueError(f"second-order equations have as many velocities as positions: y0 has {len(y0)} components")
    return found


def _named(name: object) -> str:
    if not isinstance(name, str):
        raise TypeError(f"name of the problem must be a str, got {shown(name)}")
    return encodable(name)
