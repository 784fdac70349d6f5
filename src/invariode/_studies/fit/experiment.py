"""Experiments: a problem, its data and their standard deviations."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from typing import Any, Literal, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ..._base.arguments import Array, call_name, choice, items, number, real_numbers, shown
from ..._base.forks import cached_property
from ..._base.labelled import is_table as has_columns
from ..._base.labelled import named, require_names
from ..._base.package import public
from ..._base.suggestions import first_few, meant
from ..._base.types import MethodName
from ..._functions.compiled import CompiledFunction, is_native
from ..._problem.options import Options
from ..._problem.parameters import ParameterName, parameter_names, values_of, with_values
from ..._problem.problem import Problem
from ..._problem.start import of_t_and_y
from .data import Data, checked, column_of_times, in_order, is_table, read


class Failed(NamedTuple):
    """Marker in the place of the model's values, with the reason of the failure."""

    reason: str


#: Types of `observe`: components by label or index, or a function.
Observed = str | int | Sequence[str | int] | Callable[..., Any] | None

#: Noise levels: numbers, names of parameters, or one of these for each quantity; or a function.
Sigma = float | str | Sequence[float | str] | Mapping[str, Any] | ArrayLike | Callable[..., Any] | None

#: Distributions of the data about the model.
Noise = Literal["normal", "lognormal", "laplace", "loglaplace"]
NOISES = ("normal", "lognormal", "laplace", "loglaplace")

#: Runs without an end of their own go on to so many times the last measured time of an event.
_BEYOND = 10


@public
class Experiment:
    """A problem with data, for `fit`.

    Parameters
    ----------
    problem : Problem
        The problem, with the conditions of this experiment: y0, args, t_span, inputs, events.
    t : array_like of shape (n_t,), str, or None
        The times of the data, in any order, within the problem's t_span; times may be repeated. Infinity: the steady
        state to which the run leads. None: the column "t" or "time" of a table, otherwise the index of a DataFrame if
        it has a name or holds floats or dates, or the coordinate "t" or "time" of a labelled array. A str: the name of
        the column of times. A table may stand here alone: ``Experiment(problem, table)``.
    data : array_like of shape (m, n_t), dict, DataFrame, DataArray, Dataset, or None
        The measured values, a row for each observed quantity, as in ``sol.y``; (n_t,) for a single one. An array of
        shape (n_t, m) is transposed; if both are possible, since m = n_t > 1, an error is raised. Column names are
        those of components, or any names with an `observe` function. NaN where nothing was measured. None: only
        `event_times`. Values that carry labels of time (the index of pandas, the coordinate `t` of xarray) are matched
        with `t` by these labels, and labels that are other times are an error; so is `sigma`.
    observe : callable, str, int, or list of these, optional
        The measured quantities: components, which also select columns of `data`; by default all, or those that `data`
        has columns for. Or a function ``observe(t, y, *args)`` that returns a number or an array of shape (m,). Its
        keyword-only arguments, such as scales and offsets, are parameters of the fit too: ``def observe(t, y, k, *,
        scale=1.0)``.
    sigma : float, str, array_like, dict or callable, optional
        The standard deviation of the data: one for all, one for each quantity (m,), or one for each data point
        (m, n_t). The name of a parameter is a noise level, which is fitted. A list or a dict has one entry for each
        quantity. A function ``sigma(t, y, *args)`` returns a number or an array of shape (m,); like those of `observe`,
        its keyword-only arguments are parameters of the fit. Default: unknown and equal for all data, estimated from
        the residuals.
    noise : {"normal", "lognormal", "laplace", "loglaplace"}, default "normal"
        The distribution of the data about the model. "lognormal": the logarithms of the data are normal with `sigma`,
        which is then a relative error. "laplace": Laplace's distribution, with the density
        ``exp(-|r| / sigma) / (2 sigma)`` of a residual r, for data with outliers; "loglaplace": that of logarithms. A
        list has one for each quantity. Decadic logarithms have ln(10) times their sigma.
    event_times : dict, optional
        Measured times of events of the problem, by name: that of ``Event(name=)``, or else of the event's function. The
        first value is the time of the first occurrence; NaN means not measured.
    event_sigma : float, str or dict, optional
        The standard deviation of these times, specified as for `sigma`.
    y0 : {"steady"} or callable, optional
        Default: the problem's y0, which may be a function of its arguments. "steady": each run starts at the steady
        state of f(t0, y), for the parameters of the trial, that is reached from the problem's y0. Linear totals that f
        conserves are those of y0, whose components ``y0[label]`` can be parameters. A function ``y0(t0, y, *args)`` of
        the problem's y0 and of the parameters returns the initial values, (n,).
    where : dict, optional
        Parameters that this experiment has under another name, or with a value of its own:
        ``{"k": "k_cold", "y0[drug]": "dose_2", "flow": 0.5}``. A name is that of a parameter of the fit, which other
        experiments may have too, and which may stand for several numbers; ``"k"`` itself then means nothing in this
        experiment, unless it is such a name.
    before : dict, optional
        Pre-equilibration: the run starts at the steady state with these parameters, given as in `where`, which counts
        for the others. It is reached from the initial values that `y0` gives with them.
    resets : str, int, or list of these, optional
        Components, by label or index, that start at their initial values instead of the steady state of `before`.
    method : str, optional
        The method of the runs of this experiment. Default: that of `fit`.
    **options
        Options for the runs of this experiment, such as `breakpoints` for its doses. They override those of `fit`,
        which lists the options that are not accepted.

    Examples
    --------
    >>> import invariode as iv
    >>> problem = iv.Problem(lambda t, y, k: [-k * y[0]], (0, 5), [1.0], args=(1.0,), labels=["drug"])
    >>> iv.Experiment(problem, [0, 1, 2], {"drug": [1.0, 0.6, 0.4]}, sigma=0.05)
    Experiment('problem', 3 data of drug)
    """

    def __init__(
        self,
        problem: Problem,
        t: ArrayLike | str | None = None,
        data: Any = None,
        *,
        observe: Observed = None,
        sigma: Sigma = None,
        noise: Noise | Sequence[Noise] = "normal",
        event_times: Mapping[str, ArrayLike] | None = None,
        event_sigma: float | str | Mapping[str, Any] | None = None,
        y0: Literal["steady"] | Callable[..., Any] | None = None,
        where: Mapping[str, str | float] | None = None,
        before: Mapping[str, str | float] | None = None,
        resets: str | int | Sequence[str | int] | None = None,
        method: MethodName | None = None,
        **options: Unpack[Options],
    ) -> None:
        if not isinstance(problem, Problem):
            raise TypeError(f"an experiment needs an invariode.Problem, got {shown(problem)}")
        if np.iscomplexobj(problem.y0):
            raise ValueError("fits take problems with real y0")
        if data is None and is_table(t):
            t, data = None, t
        if data is None and event_times is None:
            raise TypeError("an experiment needs data, or event_times")
        if data is None and t is not None:
            raise TypeError("t was given without data")
        given, self.method = problem, method
        self.options = options
        self._where = _Where(given, where, "where")
        self.problem = problem = self._where.problem
        self.start = y0 if callable(y0) or is_native(y0) else None
        #: True: `start` is the problem's y0, a function of the arguments; initial values may be parameters too.
        self.starts_as_problem = False
        if self.start is None and given.y0_of_args is not None:
            self.start, self.starts_as_problem = of_t_and_y(given.y0_of_args), True
        if y0 is not None and (self.start is None or self.starts_as_problem):
            choice("y0", y0, ("steady",))
            if before is not None:
                raise TypeError('y0="steady" and before= are two steady states: leave y0 out')
            before = {}
        self.before = None if before is None else _Where(given, {**(where or {}), **before}, "before")
        self.resets = _components(problem, resets, "to reset") if resets is not None else []
        if self.resets and before is None:
            raise TypeError("resets is about the steady state of before=, which was not given")
        self.observation = Observation(problem, observe)
        self.sigma_function = _python_function(sigma, "sigma") if callable(sigma) or is_native(sigma) else None
        self.sigma_extras = {} if self.sigma_function is None else _extras(self.sigma_function)
        empty = Data(np.zeros(0), np.zeros((self.observation.size, 0)), None)
        self.data = empty if data is None else self._matched(read(t, data, self.observation.size))
        self.noise = _noises(noise, len(self.data.values))
        self.events = _event_series(problem, event_times)
        self.sigma = None if self.sigma_function is not None else self._in_order(t, data, sigma)
        self.event_sigma = event_sigma
        self._dynamic: dict[str, tuple[ParameterName, ...]] = {}
        self._within_span()
        for kind, row in zip(self.noise, self.data.values, strict=True):
            if kind.startswith("log") and not (row[~np.isnan(row)] > 0).all():
                first = int(np.argmax(row <= 0))
                raise ValueError(
                    f'noise="{kind}" needs positive data, and one is {row[first]:g} at t = {self.data.t[first]:g}; NaN '
                    "leaves it out"
                )
        self.series = [*self._series()]
        if not self.series:
            raise TypeError("an experiment needs data, or event_times")

    def _matched(self, data: Data) -> Data:
        """Match the data with the observed quantities: columns with components by name, and only the observed ones if
        `observe` selects some."""
        observation, names = self.observation, data.names
        if observation.function is None and names is not None:
            self.observation, wanted = observation.chosen(names)
            return Data(data.t, checked(data.values[[names.index(one) for one in wanted]]), wanted)
        if observation.size != len(data.values):
            listed = "" if names is None else f", {first_few(names)}"
            raise ValueError(
                f"data have {len(data.values)} quantities{listed}, and {observation.size} are observed: leave out "
                "columns that are no measurements, as in t='time', data=table[['time', 'DV']]"
            )
        return data

    def _in_order(self, t: Any, data: Any, sigma: Any) -> Any:
        """Return `sigma` in the order of the times, by its labels and those of the times where these came with any;
        labels that are names of quantities stay."""
        labels = getattr(sigma, "index", None)
        if np.ndim(sigma) == 1 and labels is not None and not callable(labels) and {*labels} & {*self.names}:
            return sigma
        if has_columns(data):
            name = column_of_times(data.columns) if t is None else t
            t = data[name] if isinstance(name, str) and name in data.columns else t
        times = t if hasattr(t, "index") and not isinstance(t, (str, list, tuple)) else self.data.t
        return in_order(times, sigma, "sigma")

    def _within_span(self) -> None:
        t0, tf = self.problem.t_span
        outside = (self.data.t < min(t0, tf)) | (np.isfinite(self.data.t) & (self.data.t > max(t0, tf)))
        if outside.any():
            raise ValueError(
                f"the time {self.data.t[outside][0]:g} of the data is outside the problem's t_span = {(t0, tf)}"
            )

    def _series(self) -> Iterator[Series]:
        """Yield the data of each quantity and of each event that has any."""
        rows = len(self.data.values)
        for j, (name, sigma) in enumerate(zip(self.names, _rows(self.sigma, self.names, self.data), strict=True)):
            there = np.flatnonzero(~np.isnan(self.data.values[j]))
            if not len(there):
                continue
            found = _made(name, j, there, self.data.values[j], sigma, self.noise[j].startswith("log"), "sigma")
            found = found._replace(laplace=self.noise[j].endswith("laplace"))
            if self.sigma_function is not None:
                found = found._replace(sigma=np.ones(len(there)), formula=True)
            yield found
        of_events = named("event_sigma", self.event_sigma)
        if of_events is not None:
            events = [self.problem.events[place].__name__ for place in self.events]
            require_names("event_sigma", of_events, events, "measured events", complete=False)
        for k, (place, times) in enumerate(self.events.items()):
            name = self.problem.events[place].__name__
            sigma = self.event_sigma if of_events is None else of_events.get(name)
            there = np.flatnonzero(~np.isnan(times))
            yield _made(name, rows + k, there, times, sigma, False, "event_sigma")

    @cached_property
    def names(self) -> list[str]:
        """Names of the observed quantities."""
        return (
            self.data.names
            if self.observation.function is not None and self.data.names is not None
            else self.observation.names(len(self.data.values))
        )

    @property
    def last(self) -> float:
        """The time of the last datum."""
        times = [self.data.t[np.isfinite(self.data.t)], *self.events.values()]
        return float(max(np.nanmax(one, initial=-np.inf) for one in times))

    def ended(self) -> Problem:
        """Return the problem with the end that the data give, if it has no other. If times of one event are all there
        is, it is terminal at the last one of them; otherwise runs continue beyond the last of these times, in case
        events come later in a trial."""
        problem, t0 = self.problem, self.problem.t_span[0]
        if not self.events:
            return problem.replace(t_span=(t0, self.last))
        end = t0 + _BEYOND * (self.last - t0)
        if len(self.events) > 1 or len(self.data.t):
            return problem.replace(t_span=(t0, end))
        (place, times), *_ = self.events.items()
        events = [copy(one) for one in problem.events]
        events[place].terminal = events[place].terminal or int(np.flatnonzero(~np.isnan(times))[-1]) + 1
        return problem.replace(t_span=(t0, end), events=events)

    # For the parameters of the fit

    def entries(self, name: str) -> tuple[ParameterName, ...]:
        """Return the numbers in args and y0 that a parameter of the fit sets in the run."""
        if name not in self._dynamic:
            self._dynamic[name] = self._where.entries(name)
        return self._dynamic[name]

    def entries_before(self, name: str) -> tuple[ParameterName, ...]:
        """Return the numbers that a parameter of the fit sets in the pre-equilibration."""
        return () if self.before is None else self.before.entries(name)

    def takes(self, name: str) -> bool:
        """Return whether the experiment has a parameter of this name."""
        own = name in self.extras or self.is_level(name)
        return own or bool(self.entries(name)) or bool(self.entries_before(name))

    @property
    def extras(self) -> dict[str, float | None]:
        """The keyword-only arguments of `observe` and `sigma` with their defaults."""
        return {**self.sigma_extras, **self.observation.extras}

    def is_level(self, name: str) -> bool:
        """Return whether a parameter of this name is a noise level."""
        return any(one.level == name for one in self.series)

    def value(self, name: str) -> float | None:
        """Return the parameter's value in the problem, or its default in `observe`."""
        for found, where in ((self.entries(name), self._where), (self.entries_before(name), self.before)):
            if found and where is not None:
                return float(values_of(where.problem.args, where.problem.y0, found[:1])[0])
        return self.extras.get(name)

    def known(self) -> list[str]:
        """Return names of the experiment's parameters, for messages."""
        levels = [one.level for one in self.series if one.level is not None]
        own = [*self._where.names(), *(self.before.names() if self.before is not None else ())]
        return [*dict.fromkeys([*own, *self.extras, *levels])]

    def __repr__(self) -> str:
        counts = f"{sum(len(one.values) for one in self.series)} data of {', '.join(one.name for one in self.series)}"
        return f"Experiment({self.problem.name!r}, {counts})"


class _Where:
    """A problem of which some numbers have values of their own, and others the names of parameters of the fit.

    - `problem`: the problem with these values
    """

    def __init__(self, problem: Problem, where: Mapping[str, str | float] | None, option: str) -> None:
        if where is not None and not isinstance(where, Mapping):
            raise TypeError(f'{option} must be a dict such as {{"k": "k_cold"}}, got {shown(where)}')
        self.problem, self._named = problem, dict[str, list[ParameterName]]()
        fixed: list[tuple[ParameterName, float]] = []
        for own, other in (where or {}).items():
            known = own in self._numbers
            found = (self._numbers[own],) if known else self.found(own, option)
            if len(found) != 1:
                raise ValueError(f"{option}: {own!r} stands for {len(found)} parameters: give each its own entry")
            if not isinstance(other, str):
                fixed.append((found[0], number(f"{option}[{own!r}]", other)))
            else:
                self._named.setdefault(other, []).append(found[0])
        self._taken = {one for group in self._named.values() for one in group} | {one for one, _ in fixed}
        if fixed:
            names, values = zip(*fixed, strict=True)
            args, y0 = with_values(problem.args, problem.y0, names, values)
            self.problem = problem.replace(args=args, y0=y0)

    def found(self, wanted: Any, option: str = "parameters") -> tuple[ParameterName, ...]:
        """Return the parameters of f and initial values that a name stands for, or several names."""
        problem = self.problem
        first, n = 2 + len(problem.before_args), len(problem.y0)
        return parameter_names(problem.fun, problem.args, problem._labels, n, wanted, first=first, option=option)

    @cached_property
    def _numbers(self) -> dict[str, ParameterName]:
        """The numbers in args and y0 by name."""
        try:
            every = self.found(True)
        except ValueError:
            every = ()
        return {one.name: one for one in (*every, *self.found("y0"))}

    def entries(self, name: str) -> tuple[ParameterName, ...]:
        """Return the numbers that a parameter of the fit sets."""
        own: tuple[ParameterName, ...] = (self._numbers[name],) if name in self._numbers else ()
        if not own and name not in self._named:  # an argument by index, or one of several numbers
            with suppress(TypeError, ValueError):
                own = self.found(name)
        own = tuple(one for one in own if one not in self._taken)
        if len(own) > 1:
            those = ", ".join(one.name for one in own)
            raise ValueError(f"{name!r} stands for {len(own)} parameters: give each its own entry, {those}")
        return *self._named.get(name, ()), *own

    def names(self) -> list[str]:
        """Return the names of all parameters."""
        return [*self._named, *(name for name, one in self._numbers.items() if one not in self._taken)]


def _components(problem: Problem, given: Any, purpose: str) -> list[int]:
    """Return components by label or index."""
    single = isinstance(given, (str, int, np.integer))
    labels, found = problem.labels, []
    for one in [given] if single else items(given) or []:
        if isinstance(one, str) and one in labels:
            found.append(labels.index(one))
        elif isinstance(one, (int, np.integer)) and not isinstance(one, bool) and 0 <= one < len(labels):
            found.append(int(one))
        else:
            listed = ", ".join(labels)
            raise ValueError(
                f"there is no component {shown(one)} {purpose}: there are {listed}{_meant_component(one, labels)}"
            )
    return found


def _meant_component(given: object, labels: list[str]) -> str:
    """Return the end of a message: what may be meant, also the concentration of a species."""
    species = given[1:-1] if isinstance(given, str) and given[:1] == "[" else None
    if species in labels:
        return f"; y holds the amount of {species}: for concentrations pass an observe= that divides by the volume"
    return meant(given, labels)


def _noises(given: Noise | Sequence[Noise], m: int) -> list[str]:
    """Return the distribution of each quantity."""
    listed = [given] * m if isinstance(given, str) else list(items(given) or [])
    if isinstance(given, str):
        choice("noise", given, NOISES)
    if len(listed) != m:
        raise ValueError(f"noise must be one of {', '.join(NOISES)}, or one for each of the {m} quantities")
    return [choice("noise", one, NOISES) for one in listed]


class Observation:
    """The observed quantities: components, or a function of the state.

    - `function`: ``observe(t, y, *args, **extras)``
    - `components`: without a function
    - `selected`: whether `observe` says which
    - `size`: the number of quantities
    - `extras`: the keyword-only arguments of the function with their defaults
    """

    def __init__(self, problem: Problem, observe: Observed) -> None:
        self._problem = problem
        self.function: Any = None
        self.extras: dict[str, float | None] = {}
        self.components, self.selected = list(range(len(problem.y0))), observe is not None
        if callable(observe) or is_native(observe):
            self.function = _python_function(observe, "observe")
            self.extras = _extras(self.function)
        elif observe is not None:
            self.components = _components(problem, observe, "to observe")
            if not self.components:
                raise TypeError(f"observe must be a function, or labels or indices of components, got {shown(observe)}")
            if len({*self.components}) < len(self.components):
                raise ValueError(f"observe names a component twice: {shown(observe)}")
        self.size = len(self.components) if self.function is None else self._count()

    def chosen(self, names: Sequence[str]) -> tuple[Observation, list[str]]:
        """Return the observed ones of the components with these labels, and their labels; a single column of another
        name is the only observed component."""
        labels = self._problem.labels
        unknown = [name for name in names if name not in labels]
        if self.selected and self.size == len(names) == len(unknown) == 1:
            return self, list(names)
        if self.selected and not unknown:
            observed = [labels[i] for i in self.components]
            if missing := [one for one in observed if one not in names]:
                raise ValueError(
                    f"observe names {missing[0]!r}, and the columns of data are {first_few([*names])}: without "
                    "observe= each column is compared with the component of its name"
                )
            return self, observed
        if unknown and len(unknown) < len(names):
            raise ValueError(
                f"the column {unknown[0]!r} is no component, which are {', '.join(labels)}"
                f"{_meant_component(unknown[0], labels)}; if it has the times, pass t={unknown[0]!r}; if it is no "
                "measurement, leave it out"
            )
        return Observation(self._problem, list(names)), list(names)

    def names(self, size: int) -> list[str]:
        """Return names of the quantities."""
        if self.function is None:
            return [self._problem.labels[i] for i in self.components]
        name = call_name(self.function, "observed")
        return [name] if size == 1 else [f"{name}[{j}]" for j in range(size)]

    def _count(self) -> int:
        """Return the number of values of the function, at the start."""
        extras = {name: 1.0 if value is None else value for name, value in self.extras.items()}
        return len(self.at(self._problem.t_span[0], self._problem.y0, self._problem.args, extras))

    def at(self, t: float, y: Array, args: tuple[Any, ...], extras: Mapping[str, Any]) -> Array:
        """Return the values of the function, (m,)."""
        values = np.asarray(self.function(t, y, *args, **extras))
        if values.ndim > 1 or values.dtype.kind not in "biufc":
            raise ValueError(f"observe must return a number or shape (m,), got {shown(values)} at t = {t:g}")
        return np.atleast_1d(values)


def _python_function(given: Any, called: str) -> Any:
    if isinstance(given, CompiledFunction):
        if given.inplace:
            raise TypeError(f"{called} must return its values: compile it without inplace")
        return given.fun
    if not callable(given):
        raise TypeError(f"{called} must be a Python function or one of invariode.compile, got {shown(given)}")
    return given


def _extras(function: Any) -> dict[str, float | None]:
    """Return the keyword-only arguments."""
    try:
        listed = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return {}
    extras = [one for one in listed if one.kind is one.KEYWORD_ONLY]
    return {one.name: None if one.default is one.empty else float(one.default) for one in extras}


class Series(NamedTuple):
    """The data of one quantity, or of the times of one event."""

    name: str
    row: int  # among the quantities, the events after them
    places: Array  # of the times, or of the occurrences
    values: Array  # there, (k,)
    sigma: Array | None  # their standard deviations, up to the level; None: unknown
    level: str | None  # the parameter that multiplies sigma
    lognormal: bool
    laplace: bool = False
    formula: bool = False  # sigma is a function, whose values multiply the `sigma` above


def _made(name: str, row: int, there: Array, values: Array, sigma: Any, lognormal: bool, what: str) -> Series:
    """Return a series; `sigma` is None, a name, a number, or a value for each datum."""
    if sigma is None:
        return Series(name, row, there, values[there], None, None, lognormal)
    if isinstance(sigma, str):
        return Series(name, row, there, values[there], np.ones(len(there)), sigma, lognormal)
    each = real_numbers(f"{what} of {name}", sigma)
    if each.shape not in ((), values.shape):
        raise ValueError(f"{what} of {name} must be a number or have shape {values.shape}, got {each.shape}")
    each = np.broadcast_to(each, values.shape)[there]
    if not ((each > 0) & np.isfinite(each)).all():
        raise ValueError(f"{what} of {name} must be positive and finite, got {shown(each)}")
    return Series(name, row, there, values[there], each, None, lognormal)


def _rows(sigma: Any, names: Sequence[str], data: Data) -> list[Any]:
    """Return `sigma` for each quantity."""
    m, count = data.values.shape
    if sigma is None or isinstance(sigma, str):
        return [sigma] * m
    by_label = named("sigma", sigma, names)
    if by_label is not None:
        require_names("sigma", by_label, names, "measured quantities", complete=True)
        return [by_label[name] for name in names]
    listed = items(sigma)
    if listed is None:
        return [sigma] * m
    if any(isinstance(one, str) for one in listed):
        if len(listed) != m:
            raise ValueError(f"sigma must have a value for each of the {m} quantities, got {shown(sigma)}")
        return listed
    each = real_numbers("sigma", sigma)
    if each.shape in ((m,), (m, count)):
        return [*each]
    if m == 1 and each.shape == (count,):
        return [each]
    raise ValueError(
        f"sigma must be a number or have shape ({m},), one for each quantity, or ({m}, {count}), one for each datum, "
        f"got shape {each.shape}"
    )


def _event_series(problem: Problem, event_times: Mapping[str, ArrayLike] | None) -> dict[int, Array]:
    """Return the measured times by the index of their event."""
    if event_times is None:
        return {}
    if not isinstance(event_times, Mapping):
        raise TypeError(f"event_times must be a dict of times by the name of their event, got {shown(event_times)}")
    names = [one.__name__ for one in problem.events]
    series = {}
    for name, times in event_times.items():
        if names.count(name) != 1:
            listed = ", ".join(names) or "no events"
            if name in names:
                raise ValueError(f"event_times names {name!r}, and several events have this name: give Event(name=)")
            raise ValueError(f"event_times names {name!r}{meant(name, names)}: the problem has {listed}")
        values = real_numbers(f"event_times of {name}", times)
        if values.ndim != 1 or np.isinf(values).any() or np.isnan(values).all():
            raise ValueError(f"event_times of {name} must be times of its occurrences, got {shown(times)}")
        series[names.index(name)] = values
    return series
