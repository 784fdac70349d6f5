"""Results of a solve, as data."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import ATOL, RTOL, Array, default_labels, flag, real_numbers, shown, weights_of
from .._base.forks import cached_property
from .._base.suggestions import meant
from .._core import MEMORY_VERSION, Dense, Run
from .._laws.bound import BoundInvariants, ValueJump, as_columns, bind
from .._problem.invariants import Invariants, InvariantsLike, to_invariants
from .sensitivity_data import SensitivityData, states_and_sensitivities

#: The status of a run ended by a limit: its results are right, and it can be extended. That of one that found an
#: invariant which f does not conserve, of one in which a step could not be made, and of one that was stopped.
LIMIT_REACHED, NOT_CONSERVED, FAILED, STOPPED = -3, -2, -1, 2


def at_events(states: Array) -> Array:
    """Return states at the occurrences of an event, (k, n); of none (0,), as SciPy has it."""
    return states if len(states) else states.reshape(0)


class ByEvent(list[Array]):
    """Arrays of the events of a run, in their order; also by name, as in ``sol.t_events["ground"]``."""

    def __init__(self, names: Sequence[str], arrays: Iterable[Array]) -> None:
        super().__init__(arrays)
        self._names = names

    def __getitem__(self, event: Any) -> Any:
        if not isinstance(event, str):
            return super().__getitem__(event)
        if event in self._names:
            return super().__getitem__(self._names.index(event))
        raise ValueError(
            f"there is no event {shown(event)}: there are {', '.join(self._names)}{meant(event, self._names)}"
        )

    def replaced(self, arrays: Iterable[Array]) -> ByEvent:
        """Return other arrays of the same events."""
        return ByEvent(self._names, arrays)


class DataRecord(Mapping[str, Any]):
    """A dataclass whose fields are also items, as in SciPy's results: ``sol.t`` is ``sol["t"]``."""

    def __getitem__(self, key: str) -> Any:
        if key in list(self):
            return getattr(self, key)
        raise KeyError(key)

    def __iter__(self) -> Iterator[str]:
        return (f.name for f in dataclasses.fields(self) if not f.name.startswith("_"))  # type: ignore[arg-type]  # subclasses are dataclasses

    def __len__(self) -> int:
        return sum(1 for _ in self)

    __eq__ = object.__eq__  # arrays do not compare to one truth
    __hash__ = object.__hash__


def _none() -> None:
    return None


class Deferred:
    """An object whose attributes are made together by a function ``_make()``, when one of them is first read."""

    def _settle(self) -> bool:
        """Make the deferred attributes, except for those set meanwhile; return whether there were any to make."""
        make = self.__dict__.get("_make")
        if make is None:
            return False
        self.__dict__.update({**make(), **self.__dict__})
        self.__dict__.pop("_make", None)
        return True

    if not TYPE_CHECKING:  # else a type checker would accept every misspelt field

        def __getattr__(self, name: str) -> Any:
            """Make the deferred attributes, for a name that is not there yet."""
            if not self._settle() and name not in self.__dict__:  # another thread may have made it
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
            return getattr(self, name)


class Origin(Protocol):
    """Origin of a solution, which can continue it and differentiate it; by default a run without its functions.

    - `source`: problem, method and options
    - `y`: the state at the end of the run
    - `memory`, `memory_version`: the internal state of the method there, as bytes of this version
    - `roots`: what each `Roots` remembers of the run
    - `imposed`: the solution was projected afterwards, and so will be its extension
    """

    source: Any
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


@dataclasses.dataclass(eq=False)
class Stats(Deferred, DataRecord):
    """Counts of a run.

    Attributes
    ----------
    steps : int
        Accepted steps.
    failed : int
        Failed attempts.
    nfev : int
        Evaluations of f by the method.
    nfev_check : int
        Evaluations of f by the tests of invariants, Jacobians and components below 0, and in search of its jumps;
        not in `nfev`.
    njev : int
        Evaluations of the Jacobian of f.
    nlu : int
        Factorisations; with `GMRES` set-ups of the preconditioner.
    nsolve : int
        Solutions of linear systems.
    projections : int
        Projected attempts.
    skipped : int
        Attempts whose projection was not needed.
    clipped : int
        Steps that ended outside `bounds` by less than the tolerance and were moved onto them, or in which components
        were held at one that the function leads out of.
    ng : int
        Evaluations of the invariants, including those for output between steps.
    ngjac : int
        Evaluations of their Jacobians, likewise.
    ngdiff : int
        Those of `ng` that served Jacobians: complex steps and differences, and the choice between them at the start.
    switches : int
        How often ``method="auto"`` continued with its other method.
    products : int
        Products of the Jacobian of f with a vector, with `GMRES`. By differences each of them is one
        of `nfev`.
    linear_iterations : int
        Iterations of GMRES.
    derivatives : str or None
        How the Jacobians of the invariants were computed: 'given', 'traced' (exact, of compiled functions), 'complex
        step', 'central differences', 'forward differences', several of these, or None.
    projected_start : bool
        y0 was off a demanded value by less than the tolerance, and was projected; or it did not satisfy the algebraic
        equations of a singular mass matrix, and was moved.
    clipped_amount : float
        The amount that `bounds` have added to the sum of the components, before any invariants were imposed again:
        by moving steps onto them, and by holding components there that the function leads out.
    mechanics : dict or None
        For a problem of `invariode.MechanicalSystem`: under 'derivatives' how those of its functions were formed
        ('traced', 'complex step', 'differences', 'given'), and how often in the whole run each function was called and
        the matrix of the accelerations was factorised, 'sparse' and 'dense'.
    stiff_since : float or None
        From this t on, stability, not accuracy, limited most steps of an explicit method; None if it did not.
    jacobian : str or None
        How the Jacobian of f was computed: 'given', 'constant', 'traced' (exact, from the expressions of f),
        'differences' or 'complex step', from which t on differences replaced complex steps, and the sparsity pattern
        if it was detected; 'products' with `GMRES`; None for explicit methods.
    discontinuities : tuple of float
        Times at which f appears discontinuous and steps were rejected, in order. Each t is the first with the new value
        of f. At most 64. For jumps of f that depend on t these are exact, and can be given as `breakpoints`.
    marks : tuple of (float, float)
        Of a run with delays: the times and levels that `Solution.marks` has as arrays.
    sensitivities : str or None
        Of a run with `sensitivities`: how the derivatives of its functions were formed: 'traced' (exact, from
        their expressions), 'given', 'complex step' or 'differences'; of each function, if they differ.
    """

    steps: int
    failed: int
    nfev: int
    nfev_check: int
    njev: int
    nlu: int
    nsolve: int
    projections: int
    skipped: int
    clipped: int
    ng: int
    ngjac: int
    ngdiff: int
    switches: int
    products: int
    linear_iterations: int
    derivatives: str | None
    projected_start: bool
    # Factories leave no attributes of the class, which would hide that a field is not there yet.
    clipped_amount: float = dataclasses.field(default_factory=float)
    mechanics: dict[str, Any] | None = dataclasses.field(default_factory=_none)
    stiff_since: float | None = dataclasses.field(default_factory=_none)
    jacobian: str | None = dataclasses.field(default_factory=_none)
    discontinuities: tuple[float, ...] = dataclasses.field(default_factory=tuple)
    marks: tuple[tuple[float, ...], ...] = dataclasses.field(default_factory=tuple)
    sensitivities: str | None = dataclasses.field(default_factory=_none)

    @classmethod
    def when_needed(cls, make: Callable[[], Mapping[str, Any]]) -> Stats:
        """Return counts that are computed when one of them is first read."""
        later = cls.__new__(cls)
        later.__dict__["_make"] = make
        return later

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self})

    def __getstate__(self) -> dict[str, Any]:
        return dict(self)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Marks(DataRecord):
    """Times at which delays bring discontinuities of a solution, in increasing order.

    Attributes
    ----------
    t : ndarray of shape (count,)
        The times: of jumps of the history, t0, breakpoints and actions, and of their images by the delays.
    level : ndarray of int of shape (count,)
        The order of the lowest derivative that jumps there: 0 is y itself, 1 its slope. With sensitivities t0 has
        level 0, since they jump there.
    """

    t: Array
    level: Array


class StiffnessWarning(UserWarning):
    """Stability, not accuracy, limits the steps of an explicit method: the problem is stiff."""


class DiscontinuityWarning(UserWarning):
    """f looks discontinuous where attempts fail, which `breakpoints` and events save; or the solution sticks where f
    jumps; or the actions of an event accumulate in a finite time."""


class Steps(DataRecord):
    """The accepted steps, arrays of one value each.

    Attributes
    ----------
    t : ndarray of float
        Where the step ended.
    h : ndarray of float
        Its signed size.
    order : ndarray of int
        Its order.
    error : ndarray of float
        The estimated error e, ``max_i |e_i| / w_i``, in units of rtol.
    correction : ndarray of float
        The size of the correction by projection, in the same norm and unit.
    method : ndarray of str
        The method that made the step: with ``method="auto"`` one of two.
    """

    def __init__(self, rows: Array | Run, methods: Sequence[str]) -> None:
        self._given = rows  # or the run that has them
        self._methods = methods  # of which the last column has the numbers

    def __getstate__(self) -> dict[str, Any]:
        return {"_given": self._rows, "_methods": self._methods}

    @cached_property
    def _rows(self) -> Array:
        """Rows of the accepted steps, (n_steps, 6)."""
        return self._given.record() if isinstance(self._given, Run) else self._given

    @cached_property
    def t(self) -> Array:
        return self._rows[:, 0].copy()

    @cached_property
    def h(self) -> Array:
        return self._rows[:, 1].copy()

    @cached_property
    def order(self) -> Array:
        return self._rows[:, 2].astype(np.int32)

    @cached_property
    def error(self) -> Array:
        return self._rows[:, 3].copy()

    @cached_property
    def correction(self) -> Array:
        return self._rows[:, 4].copy()

    @cached_property
    def method(self) -> Array:
        return np.array(self._methods)[self._rows[:, 5].astype(np.int32)]

    def __iter__(self) -> Iterator[str]:
        return iter(("t", "h", "order", "error", "correction", "method"))

    def __repr__(self) -> str:
        return f"Steps({len(self._rows)} steps)"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Drift(DataRecord):
    """The drift of the invariants; prints as a table. Arrays have one value per invariant.

    Attributes
    ----------
    names : list of str
        The names of the invariants.
    value : ndarray
        The value that was held (the first one, if events with actions changed it).
    residual_before : ndarray
        Largest ``|g - value|`` of the accepted candidates before projection.
    distance_before : ndarray
        The same as a distance from the level set, in units of rtol in the weights of the error test.
    residual_after : ndarray
        Largest ``|g - value|`` at the outputs.
    distance_after : ndarray
        The same as a distance.
    correction : float
        Largest correction of a step, in units of rtol.
    projections : int
        Projected attempts.
    skipped : int
        Steps close enough to the manifold to need no projection.
    """

    names: list[str]
    value: Array
    residual_before: Array
    distance_before: Array
    residual_after: Array
    distance_after: Array
    correction: float
    projections: int
    skipped: int

    def __repr__(self) -> str:
        if not self.names:
            return "no invariants were imposed"
        width = max(len("invariant"), *map(len, self.names))
        lines = [
            f"{'invariant':<{width}} {'value':>12}  {'residual before, after':>22}  {'distance before, after':>22}",
            *(
                f"{name:<{width}} {value:>12.6g}  {before:>11.2e}{after:>11.2e}  {far:>11.2e}{near:>11.2e}"
                for name, value, before, after, far, near in zip(
                    self.names,
                    self.value,
                    self.residual_before,
                    self.residual_after,
                    self.distance_before,
                    self.distance_after,
                    strict=True,
                )
            ),
            "distances in units of the tolerance;",
            f"largest correction of a step {self.correction:.2e}; "
            f"{self.projections} projections, {self.skipped} skipped",
        ]
        return "\n".join(lines)


class BeforeProjection(NamedTuple):
    """The largest distances of a run's accepted candidates from the manifold."""

    residual: Array  # of each invariant
    distance: Array
    correction: float  # of a step
    all_that_is_known: Drift | None = None  # where the functions are not


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
    _origin: Origin | Any  # None: of a pickle

    def __init__(
        self,
        private: Mapping[str, Any] | Callable[[], Mapping[str, Any]],
        items: Mapping[str, Any] = _NO_ITEMS,
        /,
        **fields: Any,
    ) -> None:
        """`private` holds what is not an item; a callable makes it when it is first needed."""
        dict.__init__(self, items, **fields)
        if callable(private):
            self.__dict__["_make"] = private
        else:
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
