"""Results of a solve, as data."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import ATOL, RTOL, Array, default_labels, flag, real_numbers, weights_of
from .._base.types import MethodName
from .._core import MEMORY_VERSION, Dense
from .._laws.bound import BoundInvariants, ValueJump, as_columns, bind
from .._problem.invariants import Invariants, InvariantsLike, to_invariants
from .._problem.options import Options
from .._problem.problem import Problem
from .records import BeforeProjection, ByEvent, Deferred, Drift, Marks, Stats, Steps
from .sensitivity_data import SensitivityData, states_and_sensitivities

#: The status of a run ended by a limit: its results are right, and it can be extended. That of one that found an
#: invariant which f does not conserve, of one in which a step could not be made, and of one that was stopped.
LIMIT_REACHED, NOT_CONSERVED, FAILED, STOPPED = -3, -2, -1, 2


class RunSource(Protocol):
    """Problem, method and options of a run."""

    method: MethodName
    options: Options

    @property
    def problem(self) -> Problem: ...


class Origin(Protocol):
    """Origin of a solution, which can continue it and differentiate it; by default a run without its functions.

    - `source`: problem, method and options; None: of a file, without functions
    - `y`: the state at the end of the run
    - `memory`, `memory_version`: the internal state of the method there, as bytes of this version
    - `roots`: what each `Roots` remembers of the run
    - `imposed`: the solution was projected afterwards, and so will be its extension
    """

    source: RunSource | None
    y: Array
    memory: bytes = b""
    memory_version: int = MEMORY_VERSION
    roots: Sequence[Any] = ()
    imposed: bool = False

    def __reduce__(self) -> str | tuple[Any, ...]:
        return type(None), ()  # functions do not travel with a pickled solution

    def extend(self, sol: Any, t_end: float, options: Any) -> Any:
        """See `Solution.extend`."""
        raise ValueError(
            "this solution comes from a file, without the functions of its problem: it cannot be extended. Pass the "
            "problem too, load(path, problem)"
        )

    def gradient(self, sol: Any, *given: Any) -> Array:
        """See `Solution.gradient`."""
        raise ValueError(
            "this solution comes from a file, without the functions of its problem: it has no gradient. Solve it again"
        )

    def slopes(self, t: Array, y: Array) -> tuple[Array, Array] | None:
        """Return the slopes of the solution after and before each output, (n, n_t), if these are the steps of a
        differential equation."""
        return None

    def field(self, y: Array) -> Array | None:
        """Return f at the start of the run, in other states (n, k)."""
        return None

    def positions(self) -> int:
        """Return the number of leading components that are positions, whose velocities follow."""
        return 0

    def parameters(self) -> Array | None:
        """Return the values of the parameters of the sensitivities, (k,)."""
        return None

    def continuous(self, sol: Any) -> Any:
        """Return the solution as a function of t; None: it is not known."""
        return sol.sol

    def identity(self) -> Any:
        """Return the identity of the run, which distinguishes it from others; None: it has none."""
        return None

    def imposing(self) -> Self:
        """Return the origin for the projected solution: its extension will be projected too."""
        return self


class DenseSolution:
    """The solution as a continuous function of t.

    ``sol(t)`` has shape (n,) for a number and (n, n_t) for an array t. At the ends of the steps it returns the stored
    values; between them the option `interpolation` decides. Outside [t_min, t_max] it extrapolates the outermost step,
    as SciPy does; ``sol(t, extrapolate=False)`` raises a ValueError instead. With delays sol(t) is the history before
    t_min.

    Attributes
    ----------
    ts : ndarray
        The ends of the steps, the start first.
    t_min : float
        Start of the interval.
    t_max : float
        End of the interval.
    """

    def __init__(
        self, dense: Dense, dtype: np.dtype[Any], invariants: BoundInvariants, imposed: Mapping[str, Any] | None = None
    ):
        self._dense = dense
        self._dtype = dtype
        self._invariants = invariants
        self._imposed = imposed
        self.ts: Array = dense.knots()
        self.t_min = float(min(self.ts[0], self.ts[-1]))
        self.t_max = float(max(self.ts[0], self.ts[-1]))
        self._history: Callable[[float], Any] | None = None  # y before the start, of a problem with delays

    def after(self, history: Callable[[float], Any] | None) -> DenseSolution:
        """Return this solution, with y before its start as a function of t."""
        self._history = history
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_dense": self._dense.parts(), "_history": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _dense=Dense.from_parts(**state["_dense"]))

    def __call__(self, t: ArrayLike, *, extrapolate: bool = True) -> Array:
        times = t if type(t) is np.ndarray and t.dtype == float else real_numbers("t", t)
        if times.ndim > 1:
            raise ValueError(f"t must be a number or 1-dimensional, got shape {times.shape}")
        if not flag("extrapolate", extrapolate):
            outside = np.atleast_1d(times)[~((times >= self.t_min) & (times <= self.t_max)).reshape(-1)]
            if outside.size:
                raise ValueError(
                    f"t = {outside[0]:.10g} is outside the solution's interval, {self.t_min:.10g} to "
                    f"{self.t_max:.10g}: extend the run, sol.extend(t)"
                )
        g = self._invariants
        rows = g.evaluate(self._dense, np.atleast_1d(times))
        y = as_columns(rows[:, : self._dense.n] if self._dense.parameters else rows, self._dtype)
        if self._imposed is not None and y.shape[1]:
            pieces = g.pieces_at(np.atleast_1d(times), "right")
            y = g.equalities().impose(np.atleast_1d(times), y, **self._imposed, pieces=pieces).y
        if self._history is not None:
            for i in np.flatnonzero(np.atleast_1d(times) < self.t_min):
                y[:, i] = self._history(float(np.atleast_1d(times)[i]))
        return y[:, 0] if times.ndim == 0 else y

    def sensitivities(self, t: ArrayLike) -> Array:
        """Return ∂y/∂p at t, of a run with `sensitivities`.

        Parameters
        ----------
        t : float or array_like of shape (n_t,)
            Times.

        Returns
        -------
        ndarray of shape (n, k) or (n, k, n_t)
            As accurate as ``sol(t)``, and on the tangent of the manifold where ``sol(t)`` is on the manifold.

        Raises
        ------
        ValueError
            The run had no sensitivities.
        """
        if not self._dense.parameters:
            raise ValueError("the run had no sensitivities: solve with sensitivities=True, or the names of parameters")
        times = real_numbers("t", t)
        if times.ndim > 1:
            raise ValueError(f"t must be a number or 1-dimensional, got shape {times.shape}")
        rows = self._invariants.evaluate(self._dense, np.atleast_1d(times))
        columns = as_columns(rows, self._dtype)
        n = self._dense.n * len(columns) // rows.shape[1]
        found = states_and_sensitivities(columns, n, self._dense.parameters)[1]
        return found[:, :, 0] if times.ndim == 0 else found

    def imposed(self, rtol: ArrayLike, atol: ArrayLike) -> DenseSolution:
        """Return the continuous solution with its values projected to roundoff."""
        made = DenseSolution(self._dense, self._dtype, self._invariants, {"rtol": rtol, "atol": atol})
        return made.after(self._history)


@dataclasses.dataclass
class Names:
    """The names in tables and pictures; in files the lengths of the lists are dimensions."""

    problem: str
    title: str | None  # the problem's name, where one was given
    labels: Annotated[list[str], "component"] | None
    size: Annotated[int, "component"]
    events: Annotated[list[str], "event"]

    @property
    def components(self) -> list[str]:
        return default_labels(self.size) if self.labels is None else self.labels


_NO_ITEMS: Mapping[str, Any] = {}
#: Marks a field that was not given, since None is a value.
_ABSENT: Any = object()


@dataclasses.dataclass(eq=False, repr=False, init=False)
class Result(Deferred, dict[str, Any]):
    """The data of a `Solution`, and what is computed from them.

    As in SciPy, it is a dict whose items are also attributes: the fields, and whatever the user adds. Names that start
    with an underscore are not items.
    """

    t: Array
    y: Array
    # None or not is known to the caller, who said what to compute: `| Any` spares them a test of it.
    sol: DenseSolution | Any
    t_events: ByEvent | Any
    y_events: ByEvent | Any
    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    success: bool
    stats: Stats
    steps: Steps | Any
    t_end: float
    _invariants: BoundInvariants
    _rtol: ArrayLike
    _atol: ArrayLike
    _drift: BeforeProjection
    _names: Names
    _sensitivities: SensitivityData | None
    _y_end: Array
    _origin: Origin | None  # None: of a pickle

    def __init__(
        self,
        private: Mapping[str, Any],
        items: Mapping[str, Any] = _NO_ITEMS,
        /,
        **fields: Any,
    ) -> None:
        """`private` holds what is not an item. Runs make their solutions by `Run.solution`, with a function that makes
        it when it is first needed."""
        dict.__init__(self, items, **fields)
        self.__dict__.update(private)  # past __setattr__

    def __getstate__(self) -> dict[str, Any]:
        self._settle()
        return self.__dict__

    def changed(self, **changes: Any) -> Self:
        """Return a copy with other values of some fields, and with what the user has added."""
        private = {
            **self.__getstate__(),
            **{name: changes.pop(name) for name in [*changes] if name.startswith("_")},
        }
        return type(self)(private, **{**self, **changes})

    if not TYPE_CHECKING:  # else a type checker would accept every misspelt field

        def __getattr__(self, name: str) -> Any:
            """Return an item, for a name that is no attribute of the class or the object."""
            value = self.get(name, _ABSENT)
            return super().__getattr__(name) if value is _ABSENT else value

    def __missing__(self, key: Any) -> Any:
        components = [*self._names.components]
        if key in components:
            raise KeyError(f"{key!r} is a component: y[{components.index(key)}], or to_dataframe()[{key!r}]")
        raise KeyError(key)

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_") or hasattr(type(self), name):
            super().__setattr__(name, value)
        else:
            self[name] = value

    def __delattr__(self, name: str) -> None:
        if name in self:
            del self[name]
        else:
            super().__delattr__(name)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *map(str, self)]

    __eq__ = object.__eq__  # arrays do not compare to one truth
    __hash__ = object.__hash__  # type: ignore[assignment]  # a dict has none

    @property
    def _run(self) -> Origin:
        """Origin of the solution. Raises a ValueError if the solution comes without its run."""
        if self._origin is None:
            raise ValueError(
                "this solution comes from a file or a pickle, without the functions of its problem: it can neither be "
                "extended nor differentiated. Solve the problem again, or from the final state of this solution"
            )
        return self._origin

    @property
    def _source(self) -> RunSource:
        """Problem, method and options of the run. Raises a ValueError without them."""
        if (source := self._run.source) is None:
            raise ValueError("the solution comes from a file: load it with its problem, load(path, problem)")
        return source

    @property
    def y_end(self) -> Array:
        """The state at `t_end`, of shape (n,), whatever the output holds: after the last jump there."""
        return self._y_end

    @property
    def sensitivities(self) -> Array | Any:
        """∂y/∂p at the outputs, of shape (n, k, n_t); None if the run had no `sensitivities`."""
        return None if self._sensitivities is None else self._sensitivities.values

    @property
    def sensitivity_names(self) -> list[str]:
        """The k parameters."""
        return [] if self._sensitivities is None else list(self._sensitivities.names)

    @property
    def sensitivities_events(self) -> list[Array] | Any:
        """∂y/∂p at `y_events`, with t fixed: for each event (occurrences, n, k). None without events."""
        return self._at_events("before")

    @property
    def sensitivities_after_events(self) -> list[Array] | Any:
        """∂y/∂p after the action of each event, (occurrences, n, k); NaN where the run ended there without the
        action."""
        return self._at_events("after")

    @property
    def sensitivities_t_events(self) -> list[Array] | Any:
        """∂τ/∂p of the times of events: for each event (occurrences, k). None without events."""
        return self._at_events("times")

    def _at_events(self, which: str) -> list[Array] | None:
        found = None if self._sensitivities is None else self._sensitivities.events
        return None if found is None else ByEvent(self._names.events, getattr(found, which))

    @property
    def marks(self) -> Marks:
        """Times at which derivatives jump because of delays, as far as the method can see it, and which derivatives:
        `Marks` with arrays `t` and `level`, empty without delays. A trajectory of an ensemble has none.
        """
        found = np.array(self.stats.marks, dtype=float).reshape(-1, 2)
        return Marks(found[:, 0], found[:, 1].astype(np.int64))

    @property
    def residual(self) -> Array:
        """g(t, y) - value of the invariants imposed, (m, n_t), at the outputs t and y as they are now.

        For an `invariode.Dissipated` function, how far it has risen above its lowest earlier output, or fallen
        below its highest. Each access evaluates the invariants.
        """
        if self._drift.all_that_is_known is not None:
            raise ValueError(
                "the residuals of this trajectory at its outputs are not known: the ensemble comes from a file or a "
                "pickle, without functions, or has events or breakpoints that change the values of invariants. drift() "
                "has the largest residuals; for those at outputs solve this trajectory alone"
            )
        return self._invariants.residual(self.t, self.y, self._invariants.pieces_of_output(len(self.t)))

    def drift(self, *, invariants: InvariantsLike | None = None) -> Drift:
        """Return a table with the value of each invariant, and its largest residuals before and after projection.

        Those before are at the candidates of the accepted steps; those after are at the outputs, where g and its
        Jacobian are evaluated when this is called.

        Parameters
        ----------
        invariants : callable, Invariants, or list or dict of these, optional
            As for `plot_drift`: what to measure instead of the run's own invariants, to see how a run that did not
            impose them drifts. Residuals before projection are NaN.
        """
        if given := to_invariants(invariants):
            return self._drift_of(self._bound(given))
        if self._drift.all_that_is_known is not None:
            return self._drift.all_that_is_known
        g = self._invariants
        after = g.distance(self.t, self.y, self._rtol, self._atol, g.pieces_of_output(len(self.t)))
        return Drift(
            names=list(g.names),
            value=g.value,
            residual_before=self._drift.residual[: len(g)],
            distance_before=self._drift.distance[: len(g)],
            residual_after=np.abs(self.residual).max(axis=1, initial=0),
            distance_after=after.max(axis=1, initial=0),
            correction=self._drift.correction,
            projections=self.stats.projections,
            skipped=self.stats.skipped,
        )

    def _drift_of(self, g: BoundInvariants) -> Drift:
        """Return the drift of invariants that the run did not impose."""
        pieces, unknown = g.pieces_of_output(len(self.t)), np.full(len(g), np.nan)
        residual = np.abs(g.residual(self.t, self.y, pieces)).max(axis=1, initial=0)
        distance = g.distance(self.t, self.y, self._rtol, self._atol, pieces).max(axis=1, initial=0)
        return Drift(list(g.names), g.value, unknown, unknown, residual, distance, 0.0, 0, 0)

    def _bound(self, listed: list[Invariants]) -> BoundInvariants:
        """Return invariants that the run did not have, fixed at their values at the first output and after each
        jump."""
        if not len(self.t):
            raise ValueError("the output has no points: t_eval was empty; solve with times in t_eval")
        own, y0 = self._invariants, self.y[:, 0].copy()
        g = bind(listed, float(self.t[0]), y0, own.args, weights_of(RTOL, ATOL, y0).threshold)
        jumps = []
        for row, t, _ in own.jumps:
            here = slice(row, row + 1)
            there = g.value + g.departure(self.t[here], self.y[:, here])[:, 0] if row < len(self.t) else g.value
            jumps.append(ValueJump(row, t, np.where(g.demanded, g.value, there)))
        return dataclasses.replace(g, jumps=tuple(jumps), forward=own.forward)

    @property
    def correction(self) -> Array:
        """The corrections by projection of the accepted steps, (n_steps,), in units of rtol."""
        if self.steps is None:
            raise ValueError('the run did not keep the corrections of its steps: solve with keep="all"')
        return self.steps.correction

    def __repr__(self) -> str:
        width = max((len(str(name)) for name in self), default=0)
        shown = {name: _shape_or_value(value) for name, value in self.items()}
        if "sol" in shown and self["sol"] is None:
            shown["sol"] = "None (solve with dense_output=True)"
        return "\n".join(f"{name:>{width}}: {value}" for name, value in shown.items())


def _shape_or_value(value: Any) -> Any:
    """Return the table entry of a value: of arrays the shape, of a continuous solution its interval."""
    if isinstance(value, np.ndarray):
        return f"array of shape {value.shape}"
    if isinstance(value, list) and all(isinstance(one, np.ndarray) for one in value):
        return "[" + ", ".join(map(_shape_or_value, value)) + "]"
    return f"function on [{value.t_min}, {value.t_max}]" if isinstance(value, DenseSolution) else value
