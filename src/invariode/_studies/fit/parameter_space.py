"""The parameters of a fit: their specification, and the values in each experiment for given free parameters."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from ..._base.arguments import Array, choice, flag, items, number, shown
from ..._base.forks import cached_property
from ..._base.package import public
from ..._base.suggestions import meant
from .observed import OfNumbers
from .priors import Prior, PriorLike, to_prior


@public
@dataclass(frozen=True)
class Parameter:
    """A parameter of a fit: its bounds, start, scale, prior and ties.

    Parameters
    ----------
    start : float, optional
        The value at which the search starts. Default: the value in the problem if it is within the bounds, otherwise
        their midpoint (the geometric mean with ``scale="log"``).
    bounds : (float, float), optional
        Minimum and maximum; None or infinity means no bound. The search stays between them.
    scale : {"linear", "log"}, optional
        "log" searches in ln p, for positive parameters of unknown magnitude; the intervals of `Fit.confidence` are
        then symmetric in ln p. Default: "linear", for noise levels "log".
    prior : (float, float), (str, float, float) or callable, optional
        Prior information. ``(mean, sd)`` or ``("normal", mean, sd)``: p is normal. ``("lognormal", median, sd)``: ln p
        is normal with this standard deviation, which is what a pair means with ``scale="log"`` and for noise levels.
        "laplace" and "loglaplace" are Laplace's distribution with this mean absolute deviation. A function ``r(p)``:
        the density is proportional to exp(-r**2 / 2); it is written with NumPy's functions, for its derivative by
        complex steps. Bounds are a uniform prior.
    shared : bool, default True
        Whether all experiments share one value. False: each has its own, called ``name[0]``, ``name[1]`` and so on.
    equals : float, str or callable, optional
        Makes the parameter dependent: a fixed value; or the name of another parameter, which it then equals; or a
        function whose arguments are the names of other parameters: ``lambda k1, k2: k1 / k2``.

    Examples
    --------
    >>> import invariode as iv
    >>> iv.Parameter(bounds=(1e-3, 10), scale="log")
    Parameter(bounds=(0.001, 10.0), scale='log')
    """

    start: float | None = None
    bounds: tuple[float | None, float | None] = (None, None)
    scale: Literal["linear", "log"] | None = None
    prior: PriorLike = None
    shared: bool = True
    equals: float | str | Callable[..., float] | None = None

    def __post_init__(self) -> None:
        def own(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        if self.scale is not None:
            choice("scale of a Parameter", self.scale, ("linear", "log"))
        own("shared", flag("shared of a Parameter", self.shared))
        own("bounds", _bounds(self.bounds))
        if self.scale == "log" and (not self.limits[1] > 0 or -np.inf < self.limits[0] < 0):
            raise ValueError(f'bounds of a Parameter with scale="log" must be positive, got {shown(self.bounds)}')
        if self.start is not None:
            own("start", number("start of a Parameter", self.start))
            self.check_start(self.start, "start of a Parameter")
        if isinstance(self.prior, (list, np.ndarray)):
            own("prior", tuple(self.prior))
        to_prior(self.prior, self.scale == "log")
        if self.equals is not None:
            self._tie(self.equals)

    def _tie(self, equals: Any) -> None:
        others: dict[str, Any] = {"start": self.start, "scale": self.scale, "prior": self.prior}
        others["bounds"] = None if self.bounds == (None, None) else self.bounds
        if given := [name for name, value in others.items() if value is not None]:
            raise ValueError(f"a Parameter with equals has no {' and no '.join(given)}: it is not searched for")
        if not isinstance(equals, str) and not callable(equals):
            value = number("equals of a Parameter", equals)
            if not math.isfinite(value):
                raise ValueError(f"equals of a Parameter must be finite, got {shown(equals)}")
            object.__setattr__(self, "equals", value)

    @property
    def limits(self) -> tuple[float, float]:
        """The bounds as numbers."""
        lower, upper = self.bounds
        return -math.inf if lower is None else lower, math.inf if upper is None else upper

    def check_start(self, value: float, what: str) -> None:
        """Raise an error unless a search can start at this value."""
        lower, upper = self.limits
        if not lower <= value <= upper or not math.isfinite(value):
            raise ValueError(f"{what} is {value:g}, which is not within its bounds ({lower:g}, {upper:g})")
        if self.scale == "log" and value <= 0:
            raise ValueError(f'{what} is {value:g}: with scale="log" it must be positive')

    def __repr__(self) -> str:
        """Return fields that differ from the defaults."""
        said = [(one.name, getattr(self, one.name)) for one in fields(self)]
        changed = [
            f"{name}={value!r}" for (name, value), one in zip(said, fields(self), strict=True) if value != one.default
        ]
        return f"Parameter({', '.join(changed)})"


def _bounds(given: Any) -> tuple[float | None, float | None]:
    pair = items(given)
    if pair is None or isinstance(given, str) or len(pair) != 2:
        raise TypeError(f"bounds of a Parameter must be (lower, upper), got {shown(given)}")
    lower, upper = (None if one is None else number("bounds of a Parameter", one) for one in pair)
    if lower is not None and upper is not None and not lower < upper:
        raise ValueError(f"bounds of a Parameter must be (lower, upper) with lower < upper, got {shown(given)}")
    return (None if lower == -math.inf else lower), (None if upper == math.inf else upper)


def to_parameters(given: Any) -> dict[str, Parameter]:
    """Convert the parameters of a fit; a pair becomes a Parameter with these bounds."""
    if not isinstance(given, Mapping) or not given:
        raise TypeError(
            'parameters must be a dict of names, such as {"k": (0, 1), "y0[x]": invariode.Parameter(start=1)}, got '
            f"{shown(given)}"
        )
    made = {}
    for name, one in given.items():
        if not isinstance(name, str):
            raise TypeError(f"parameters are called by names, got {shown(name)}")
        if isinstance(one, (int, float, np.number)):
            raise TypeError(
                f"parameter {name!r} is {shown(one)}: give Parameter(start={shown(one)}) to start there, or "
                f"Parameter(equals={shown(one)}) to keep it there"
            )
        if not isinstance(one, Parameter):
            try:
                one = Parameter(bounds=one)
            except (TypeError, ValueError) as error:
                raise type(error)(f"parameter {name!r}: {error}") from None
        made[name] = one
    return made


class Taker(Protocol):
    """The part of an experiment that its parameters use."""

    def takes(self, name: str) -> bool:
        """Return whether the experiment has a parameter of this name."""

    def value(self, name: str) -> float | None:
        """Return the parameter's value in the problem; None: it has none there."""

    def is_level(self, name: str) -> bool:
        """Return whether a parameter of this name is a noise level."""

    def known(self) -> list[str]:
        """Return names of the experiment's parameters, for messages."""


class Free(NamedTuple):
    """A parameter that is searched for."""

    name: str  # k, or k[0] if it is not shared
    parameter: Parameter
    start: float | None  # None: a noise level that the first residuals give
    level: bool

    @property
    def log(self) -> bool:
        return self.level or self.parameter.scale == "log"

    @property
    def prior(self) -> Prior | None:
        return to_prior(self.parameter.prior, self.log)

    @property
    def size(self) -> float:
        """Size of the parameter's values, the unit of the search; 1 for logarithms."""
        of = [self.start or 0.0, *self.parameter.limits, 0.0 if self.prior is None else self.prior.size]
        return 1.0 if self.log else next((abs(one) for one in of if one != 0 and math.isfinite(one)), 1.0)


class _Fixed(NamedTuple):
    value: float


class _Tied:
    """A function of other parameters, each of them the place of a free one or fixed."""

    def __init__(self, name: str, function: Callable[..., float], sources: Sequence[int | _Fixed]) -> None:
        self._sources, self._derivatives = sources, OfNumbers(f"equals of {name}", function)

    def value_and_slope(self, free: Array) -> tuple[float, Array]:
        """Return the value, and its derivatives with respect to the free parameters, (free,)."""
        at = np.array([one.value if isinstance(one, _Fixed) else free[one] for one in self._sources])
        value, slope = self._derivatives.value(at), np.zeros(len(free))
        for place, one in zip(self._sources, self._derivatives.slopes(at).tolist(), strict=True):
            if not isinstance(place, _Fixed):
                slope[place] += one
        return value, slope


class Local(NamedTuple):
    """The parameters of an experiment, in its order."""

    values: Array  # (k,)
    slopes: Array  # their derivatives with respect to the free ones, (k, free)


class Priors(NamedTuple):
    """Priors of all parameters of a fit.

    Attributes
    ----------
    residuals, slopes : ndarray, (m,) and (m, k)
        Their residuals with derivatives with respect to the free parameters.
    log_factor, slope_of_factor : float and ndarray, (k,)
        The sum of the logarithms of the densities' factors, and its derivatives.
    """

    residuals: Array
    slopes: Array
    log_factor: float
    slope_of_factor: Array

    @property
    def cost(self) -> float:
        """Half the sum of squares of the priors' residuals."""
        return 0.5 * float(self.residuals @ self.residuals)


class Space:
    """Parameters of a fit: the free ones, their coordinates, and those of each experiment.

    - `free`: those that are searched for, in the order given
    - `names`: the parameters that each experiment takes
    """

    def __init__(self, parameters: Mapping[str, Parameter], experiments: Sequence[Taker]) -> None:
        self._parameters = parameters
        for name in parameters:
            if not any(taker.takes(name) for taker in experiments):
                known = [*dict.fromkeys(other for taker in experiments for other in taker.known())]
                others = [*known, *(other for other in parameters if other != name)]
                who = "no experiment takes a parameter" if len(experiments) > 1 else "the problem has no parameter"
                raise ValueError(f"{who} {name!r}: there are {', '.join(known)}{meant(name, others)}")
        self.names = [[name for name in parameters if taker.takes(name)] for taker in experiments]
        self.free: list[Free] = []
        places: dict[tuple[str, int | None], int] = {}
        for name, one in parameters.items():
            if one.equals is not None:
                continue
            own = [e for e, names in enumerate(self.names) if name in names]
            groups: list[tuple[int | None, list[int]]] = [(None, own)] if one.shared else [(e, [e]) for e in own]
            for e, of in groups:
                places[name, e] = len(self.free)
                called = name if e is None else f"{name}[{e}]"
                self.free.append(_free(called, name, one, [experiments[i] for i in of]))
        for free in self.free:
            if free.start is not None and free.prior and not math.isfinite(free.prior.at(free.start).residual):
                raise ValueError(f"{free.name} starts at {free.start:g}, where its prior is zero: give another start")
        self._rows: list[list[int | _Fixed | _Tied]] = [
            [self._row(name, e, places) for name in names] for e, names in enumerate(self.names)
        ]
        if not self.free:
            raise ValueError("all parameters are fixed by equals: there is nothing to fit")
        #: By experiment: places of its parameters among the free ones, with their slopes, if each is one of these.
        self._places: list[tuple[Array, Array] | None] = []
        for rows in self._rows:
            places_of = np.array([row for row in rows if isinstance(row, int)], dtype=int)
            complete = len(places_of) == len(rows)
            self._places.append((places_of, np.eye(len(self.free))[places_of]) if complete else None)

    def _row(self, name: str, e: int, places: Mapping[tuple[str, int | None], int]) -> int | _Fixed | _Tied:
        one = self._parameters[name]
        if one.equals is None:
            return places[name, None if one.shared else e]
        if isinstance(one.equals, float):
            return _Fixed(one.equals)
        of = [one.equals] if isinstance(one.equals, str) else _arguments(name, one.equals)
        for other in of:
            if other not in self._parameters:
                raise ValueError(
                    f"equals of {name} names {other!r}, which is not among the parameters: "
                    f"{', '.join(self._parameters)}{meant(other, self._parameters)}"
                )
            if self._parameters[other].equals is not None and not isinstance(self._parameters[other].equals, float):
                raise ValueError(f"equals of {name} names {other}, which has equals itself: name those it depends on")
            if other not in self.names[e] and not self._parameters[other].shared:
                raise ValueError(f"equals of {name} names {other}, which experiment {e} does not have")
        sources = [self._source(other, e, places) for other in of]
        return _Tied(name, _same if isinstance(one.equals, str) else one.equals, sources)

    def _source(self, name: str, e: int, places: Mapping[tuple[str, int | None], int]) -> int | _Fixed:
        one = self._parameters[name]
        return _Fixed(one.equals) if isinstance(one.equals, float) else places[name, None if one.shared else e]

    def local(self, e: int, free: Array) -> Local:
        """Return the parameters of an experiment at these values of the free ones."""
        if (found := self._places[e]) is not None:
            return Local(free[found[0]], found[1])
        rows = self._rows[e]
        values, slopes = np.zeros(len(rows)), np.zeros((len(rows), len(free)))
        for i, row in enumerate(rows):
            if isinstance(row, _Fixed):
                values[i] = row.value
            elif isinstance(row, _Tied):
                values[i], slopes[i] = row.value_and_slope(free)
            else:
                values[i], slopes[i, row] = free[row], 1.0
        return Local(values, slopes)

    def all(self, free: Array) -> dict[str, tuple[float, Array]]:
        """Return each parameter by name with its value and derivatives: the free ones, then those that are fixed or
        tied. The name of one that differs between the experiments is that of a parameter that is not shared."""
        unit = np.eye(len(free))
        found = {one.name: (float(free[i]), unit[i]) for i, one in enumerate(self.free)}
        locals_ = [self.local(e, free) for e in range(len(self.names))]
        for name, one in self._parameters.items():
            if one.equals is None:
                continue
            those = [(e, names.index(name)) for e, names in enumerate(self.names) if name in names]
            of = [(f"{name}[{e}]", float(locals_[e].values[i]), locals_[e].slopes[i]) for e, i in those]
            if all(value == of[0][1] and (slope == of[0][2]).all() for _, value, slope in of):
                of = [(name, *of[0][1:])]
            found.update((own, (value, slope)) for own, value, slope in of)
        return found

    # The search's own coordinates: multiples of sizes, or logarithms.

    @cached_property
    def log(self) -> Array:
        return np.array([one.log for one in self.free])

    @cached_property
    def sizes(self) -> Array:
        return np.array([one.size for one in self.free])

    def natural(self, u: Array) -> Array:
        """Return the values of parameters at these coordinates, (k,)."""
        return np.where(self.log, np.exp(np.where(self.log, u, 0.0)), u * self.sizes)

    def coordinates(self, free: Array) -> Array:
        """Return the coordinates of these values of parameters, (k,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.log, np.log(np.where(self.log, free, 1.0)), free / self.sizes)

    def slope(self, free: Array) -> Array:
        """Return the derivatives of the parameters' values with respect to their coordinates, (k,)."""
        return np.where(self.log, free, self.sizes)

    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the free parameters in coordinates, (k,) each."""
        limits = np.array([one.parameter.limits for one in self.free])
        limits[self.log] = np.maximum(limits[self.log], 0.0)
        lower, upper = self.coordinates(limits[:, 0]), self.coordinates(limits[:, 1])
        return lower, upper

    @cached_property
    def _priors(self) -> list[tuple[int, Prior]]:
        return [(i, one.prior) for i, one in enumerate(self.free) if one.prior is not None]

    @cached_property
    def _no_priors(self) -> Priors:
        k = len(self.free)
        return Priors(np.zeros(0), np.zeros((0, k)), 0.0, np.zeros(k))

    @property
    def has_priors(self) -> bool:
        return bool(self._priors)

    def priors(self, free: Array) -> Priors:
        """Return the priors at these values."""
        if not self._priors:
            return self._no_priors
        every = [(i, prior.at(float(free[i]))) for i, prior in self._priors]
        rows = [one.slope * np.eye(len(free))[i] for i, one in every]
        factors = np.zeros(len(free))
        for i, one in every:
            factors[i] = one.slope_of_factor
        residuals = np.array([one.residual for _, one in every])
        return Priors(residuals, np.reshape(rows, (-1, len(free))), sum(one.log_factor for _, one in every), factors)


def _same(value: Any) -> Any:
    return value


def _arguments(name: str, function: Callable[..., float]) -> list[str]:
    try:
        listed = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        listed = []
    if not listed or any(one.kind is not one.POSITIONAL_OR_KEYWORD for one in listed):
        raise TypeError(f"equals of {name} must be a function whose arguments are parameters, got {shown(function)}")
    return [one.name for one in listed]


def _free(name: str, short: str, one: Parameter, takers: Sequence[Taker]) -> Free:
    """Return a parameter with its start."""
    level = any(taker.is_level(short) for taker in takers)
    if level and (one.limits[1] <= 0 or (one.start is not None and one.start <= 0) or one.scale == "linear"):
        raise ValueError(f'{name} is a noise level, which is positive, and searched for with scale="log": {one!r}')
    if one.start is not None:
        return Free(name, one, one.start, level)
    values = {value for taker in takers if (value := taker.value(short)) is not None}
    if len(values) > 1:
        differ = ", ".join(f"{value:g}" for value in sorted(values))
        raise ValueError(f"{name} is {differ} in the problems: give it a start, or shared=False")
    lower, upper = one.limits
    if values and lower <= (value := float(values.pop())) <= upper and (one.scale != "log" or value > 0):
        return Free(name, one, value, level)
    if level:
        return Free(name, one, None, level)
    if one.scale == "log" and lower > 0 and math.isfinite(upper):
        return Free(name, one, math.sqrt(lower) * math.sqrt(upper), level)
    if math.isfinite(lower) and math.isfinite(upper) and one.scale != "log":
        return Free(name, one, lower + (upper - lower) / 2, level)
    raise ValueError(f"{name} has neither a value in the problem nor two bounds: give it a start")
