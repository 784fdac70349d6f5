"""Description of a problem, validated once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from types import FunctionType
from typing import TYPE_CHECKING, Any, Self, Unpack

from numpy.typing import ArrayLike

from .._base.arguments import (
    LAMBDIFIED,
    Array,
    call_name,
    distinct_labels,
    encodable,
    extra_arguments,
    flag,
    function,
    interval,
    items,
    quietly,
    require_no_unit,
    shown,
    state,
    warn,
)
from .._base.notebook import html_of_problem
from .._base.record import Record, record_of
from .._base.types import BreakpointsLike, EventsLike, Function, Span
from .._core import StateFirst, plainly_posed
from .._functions.compile import compile
from .._functions.compiled import CompiledFunction, CoreFunction, is_native, is_plain_function
from .._functions.filling import Filling
from .._functions.graph.function import TracedFunction
from .._functions.lambdified import unlambdified
from .._functions.second_order import SecondOrder, states_second_order
from .bounds import Bounds, to_bounds
from .breakpoints import Breakpoint, to_breakpoints
from .delays import Delays, DelaysLike, FillingOfPast, HistoryLike, start_of, to_delays
from .events import direction_sign, terminal_count, to_events
from .inputs import Input, InputsLike, to_inputs
from .invariants import Invariants, InvariantsLike, to_invariants
from .matrices import Matrices, own_matrix, to_matrices
from .options import ProblemArguments, unknown_option
from .parameters import ParameterName
from .sensitivities import Sensitivities, SensitivitiesLike, to_sensitivities
from .slope import Slope

_ARGUMENTS = ProblemArguments.__annotations__.keys()


class Posed:
    """y' = f(t, y, *args), y(t0) = y0, checked: all that many problems are, and what each of them has. It becomes a
    problem when somebody asks for one."""

    __slots__ = ("_kind", "_problem", "args", "fun", "is_plain", "t_span", "y0")

    _title: None = None
    _labels: None = None

    def __init__(
        self, kind: type[Description], fun: Any, t_span: Span, y0: ArrayLike, args: Iterable[Any] | None
    ) -> None:
        self.fun, self.t_span, self.y0, self.args = _posed(fun, t_span, y0, args)
        self.is_plain = is_plain_function(self.fun)
        self._kind = kind
        self._problem: Description | None = None

    @property
    def name(self) -> str:
        return call_name(self.fun, "problem")

    def _described(self) -> Description:
        if self._problem is None:
            with quietly():  # what there is to say of f was said before
                self._problem = self._kind(self.fun, self.t_span, self.y0, args=self.args)
        return self._problem


class Description:
    """The data of a `Problem`, which does not change."""

    fun: Any
    t_span: tuple[float, float]
    y0: Array
    args: tuple[Any, ...]
    invariants: list[Invariants]
    events: list[Any]
    matrices: Matrices
    inputs: list[Input]
    breakpoints: list[Breakpoint]
    name: str
    bounds: Bounds | None
    delays: Delays | None
    sensitivities: Sensitivities | None
    records_events: bool
    second_order: bool
    is_plain: bool  # y' = f(t, y, *args) with a Python function, and nothing else
    _title: str | None
    _labels: list[str] | None
    _as_given: dict[str, Any]

    def __init__(
        self,
        fun: Function,
        t_span: Span,
        y0: ArrayLike,
        *,
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
    ) -> None:
        given_args = _args_or(parameters, args)
        y0 = start_of(y0, history, t_span, given_args)
        called, span, start, extra = _posed(_filled(fun, inplace, delays is not None), t_span, y0, given_args)
        jac, jac_sparsity, mass = map(own_matrix, (jac, jac_sparsity, mass))
        named = None if labels is None else distinct_labels(labels, len(start))
        given = {"jac": jac, "jac_sparsity": jac_sparsity, "lband": lband, "uband": uband, "mass": mass}
        given |= {"nonnegative": nonnegative, "bounds": bounds}
        points = [] if breakpoints is None else to_breakpoints("breakpoints", breakpoints)
        fed_by = to_inputs(inputs, span)
        others = (invariants, events, second_order or None, sensitivities, inputs, breakpoints, delays, *given.values())
        self.__dict__.update(
            fun=called,
            t_span=span,
            y0=start,
            args=extra,
            invariants=to_invariants(invariants),
            events=_checked_events(events),
            matrices=to_matrices(jac, jac_sparsity, lband, uband, mass, start),
            inputs=fed_by,
            breakpoints=points,
            delays=to_delays(delays, history, called, span, start, extra, named, len(fed_by)),
            name=_named(name, called),
            bounds=to_bounds(nonnegative, bounds, start, named),
            sensitivities=to_sensitivities(sensitivities),
            records_events=events is not None,
            second_order=_is_second_order(second_order, called, start),
            _title=None if name is None else encodable(name),
            _labels=named,
            _as_given=given,
            is_plain=is_plain_function(called) and not [one for one in others if one is not None],
        )
        if self.sensitivities is not None and self.args:
            self.parameter_names()

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
        """The arguments that were given in place of `args`: a dict changes some of the parameters."""
        if not isinstance(given, Mapping):
            return given
        record = _record_in(self.args)
        if record is None:
            raise TypeError(f"args are a tuple, since the problem has no parameters by name, got {shown(given)}")
        return (record.changed(given),)

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

    if not TYPE_CHECKING:  # for whom `__init__` says it

        def __new__(cls, *by_position: Any, **by_name: Any) -> Self:
            if not by_name.keys() <= _ARGUMENTS:
                raise unknown_option(min(by_name.keys() - _ARGUMENTS), _ARGUMENTS, "Problem has no argument")
            if len(by_position) > 3:
                raise TypeError(
                    "Problem takes fun, t_span and y0 by position and everything else by name, as in args=..., got "
                    f"{shown(by_position[3])} as a fourth"
                )
            return super().__new__(cls)

    def __setattr__(self, name: str, value: Any) -> None:
        argument = name in ProblemArguments.__annotations__
        instead = f"make another one, problem.replace({name}=...)" if argument else "it has only its arguments"
        raise AttributeError(f"a Problem does not change, and {name} cannot be set: {instead}")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"a Problem does not change, and {name} cannot be deleted")

    def _described(self) -> Self:
        """Return this problem: see `Posed`."""
        return self

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

    @property
    def slope(self) -> Slope:
        """f as runs call it."""
        return Slope(self.fun, self.inputs, self.args, self.delays)

    def replace(self, **changes: Unpack[ProblemArguments]) -> Self:
        """A copy of this problem with some arguments changed.

        Parameters
        ----------
        **changes
            Arguments of `Problem` by name, `fun`, `t_span` and `y0` included. `parameters` changes the values of those
            that it names, if the problem has parameters.

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
        >>> fast = slow.replace(args=(10,), name="fast decay")
        >>> slow, fast
        (Problem('decay', t_span=(0.0, 1.0), n=1), Problem('fast decay', t_span=(0.0, 1.0), n=1))
        """
        now = {
            "fun": self.fun,
            "t_span": self.t_span,
            "y0": self.y0,
            "args": self.args,
            "invariants": self.invariants,
            "events": self.events if self.records_events else None,
            **self._as_given,
            "second_order": self.second_order and not states_second_order(self.fun),
            "inplace": self.inplace,
            "sensitivities": self.sensitivities,
            "inputs": self.inputs,
            "breakpoints": self.breakpoints or None,
            "delays": None if self.delays is None else self.delays.given,
            "history": None if self.delays is None else self.delays.history,
            "name": self._title,
            "labels": self._labels,
        }
        if (parameters := changes.get("parameters")) is not None:
            record = _record_in(self.args)
            changes["parameters"] = parameters if record is None else dict(record.changed(parameters).items())
            now["args"] = ()
        elif isinstance(changes.get("args"), Mapping):
            changes["args"] = self.arguments(changes["args"])
        return type(self)(**{**now, **changes})

    def _repr_html_(self) -> str:
        return html_of_problem(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, t_span={self.t_span}, n={len(self.y0)})"


def _args_or(parameters: Any, args: Iterable[Any] | None) -> Iterable[Any] | None:
    """The arguments of f: a record of the parameters, if there are any."""
    if parameters is None:
        return args
    if args is not None and items(args) != []:
        raise ValueError("a problem has args or parameters: put the numbers of args among the parameters")
    return (record_of(parameters),)


def _record_in(args: tuple[Any, ...]) -> Record | None:
    """The record of parameters, if they are all that f takes."""
    return args[0] if len(args) == 1 and isinstance(args[0], Record) else None


def _posed(
    fun: Any, t_span: Span, y0: ArrayLike, args: Iterable[Any] | None
) -> tuple[Any, tuple[float, float], Array, tuple[Any, ...]]:
    """f as the solvers call it, the interval, the initial state, which nobody changes, and the extra arguments."""
    plain = plainly_posed(t_span, y0, args)
    if plain is not None:
        require_no_unit("args", plain[2])
        return _as_called(fun, plain[1]), *plain
    span, start = interval(t_span), state(y0)
    called = _as_called(fun, start)
    start.setflags(write=False)
    return called, span, start, extra_arguments(args)


#: The first parameters of a function of (y, t), which is called as one of (t, y).
STATE_FIRST = {("y", "t"), ("Y", "t")}


def state_first(names: Sequence[str]) -> str:
    """Return what is said of a function with the state before t."""
    return f"fun has the parameters ({names[0]}, {names[1]}) and is called as fun(t, y): swap them, or use odeint"


def _as_called(fun: Any, y0: Array) -> Any:
    """Return f as the solvers call it."""
    kind = type(fun)
    if kind is StateFirst or (kind is FunctionType and fun.__name__ != LAMBDIFIED):  # the common cases
        if kind is FunctionType and fun.__code__.co_varnames[:2] in STATE_FIRST:
            warn(state_first(fun.__code__.co_varnames))
        return fun
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


def _named(name: str | None, fun: Any) -> str:
    if name is not None and not isinstance(name, str):
        raise TypeError(f"name of the problem must be a str, got {shown(name)}")
    return call_name(fun, "problem") if name is None else encodable(name)


def _checked_events(events: EventsLike) -> list[Any]:
    listed = to_events(events)
    for event in listed:
        terminal_count(event), direction_sign(event)
    return listed


#: In Python's own messages ("missing 2 required positional arguments") the class is the one that users know.
Description.__init__.__qualname__, Description.replace.__qualname__ = "Problem", "Problem.replace"
#: That of `__init__`, since `__new__` only refuses a fourth argument by position.
_OWN = inspect.signature(Description.__init__)
Description.__signature__ = _OWN.replace(parameters=[*_OWN.parameters.values()][1:])  # type: ignore[attr-defined]  # ours
