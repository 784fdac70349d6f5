"""The result of `solve_ensemble`: many trajectories, each of which is a `Solution` too."""

from __future__ import annotations

import dataclasses
import operator
import os
import pickle
from collections.abc import Iterator
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, overload

import numpy as np

from .._base.arguments import ATOL, RTOL, Array, choice, default_labels, distinct_labels
from .._base.files import damage_of
from .._base.formats import GROUP, Field, Kind, read, under, write
from .._base.notebook import html_of_ensemble
from .._base.types import Numbers
from .._functions.layout import NO_ARGUMENTS, layout_of
from .._laws.bound import BoundInvariants
from .._results.export import ensemble_to_dataframe, ensemble_to_xarray
from .._results.messages import MESSAGES
from .._results.pictures.ensembles import draw as draw_ensemble
from .._results.records import BeforeProjection, ByEvent, DataRecord, Drift, Stats, at_events
from .._results.result import Names
from .._results.saving import OCCURRENCES, apart, field_of, kept, restored, together
from .._results.sensitivity_data import SensitivityData
from .._results.solution import Solution

if TYPE_CHECKING:  # extras, imported when they are used
    import pandas
    import xarray
    from matplotlib.axes import Axes


@dataclasses.dataclass
class Trajectories:
    """Names, functions and tolerances for results of single trajectories. Pickles leave out functions that cannot be
    sent."""

    name: str
    events: list[str]
    laws: list[str]  # names of the invariants
    bound: BoundInvariants | None  # of the first trajectory; None: they jump, or there are no functions
    args: Any  # of all, or of each
    rtol: Numbers
    atol: Numbers
    error: BaseException | None = None  # of the first trajectory that raised one

    @classmethod
    def unknown(cls, events: int, invariants: int) -> Trajectories:
        """Make names for the events and invariants of a result that has no functions."""
        laws = [f"g{i}" for i in range(invariants)]
        return cls("trajectory", [f"event {i}" for i in range(events)], laws, None, (), RTOL, ATOL)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without functions that cannot be pickled; their invariants are then sent as names only."""
        state = dict(self.__dict__)
        for name, without in (("bound", {}), ("args", {"args": ()}), ("error", {"error": None})):
            try:
                pickle.dumps(state[name])
            except Exception:  # of each kind of object its own
                state |= without if name == "error" else {"bound": None, **without}
        return state

    def __deepcopy__(self, memo: dict[int, Any]) -> Trajectories:
        return self

    def invariants(self, i: int, value: Array) -> BoundInvariants:
        """Return the invariants of a trajectory, at its values."""
        if self.bound is None or not np.isfinite(value).all():
            return BoundInvariants([], np.zeros(0), [], (), NO_ARGUMENTS, None)
        args = self.args if isinstance(self.args, tuple) else tuple(self.args[i])
        functions = [f for spec in self.bound.specs for f in (spec.fun, spec.jac)]
        parameters = layout_of(args) if any(hasattr(f, "address") for f in functions) else NO_ARGUMENTS
        return dataclasses.replace(self.bound, value=value, args=args, parameters=parameters)


def final_states(y_end: Array, status: Array) -> Array:
    """Return the final states (N, n, 1), NaN for trajectories that failed."""
    return np.where((status >= 0)[:, None], y_end, np.nan)[:, :, None]


@dataclasses.dataclass(eq=False, repr=False)
class EnsembleEvents(DataRecord):
    """Occurrences of one event, those of a trajectory one after the other.

    Attributes
    ----------
    trajectory : ndarray of int, (k,)
        Index of the trajectory of each occurrence; sorted.
    t : ndarray, (k,)
        When.
    y : ndarray, (k, n)
        The states there.
    """

    trajectory: Array
    t: Array
    y: Array

    def __repr__(self) -> str:
        return f"EnsembleEvents({len(self.t)} occurrences in {len(np.unique(self.trajectory))} trajectories)"


def none_of(states: Array) -> dict[str, Array]:
    """Return the fields of an event that did not occur, for trajectories with such states."""
    return {"trajectory": np.zeros(0, dtype=np.int64), "t": np.zeros(0), "y": states[:0]}


@dataclasses.dataclass(eq=False, repr=False)
class EnsembleStats(DataRecord):
    """Counts of the trajectories, arrays of shape (N,) of what `Stats` has for one solve; and `lanes`, in words.

    `stiff` is 1 where stability, not accuracy, limits the steps of an explicit method, else 0, and `stiff_since` says
    since when, or NaN. `discontinuity` is the first time at which f looks discontinuous, or NaN. `accumulation` is the
    last time of an event whose actions came closer and closer until the solution passed it without one, or NaN: what
    comes after that time is wrong.
    """

    steps: Array
    failed: Array
    nfev: Array
    nfev_check: Array
    njev: Array
    nlu: Array
    nsolve: Array
    projections: Array
    skipped: Array
    clipped: Array
    ng: Array
    ngjac: Array
    ngdiff: Array
    stiff: Array
    switches: Array
    products: Array
    linear_iterations: Array
    clipped_amount: Array
    stiff_since: Array
    discontinuity: Array
    accumulation: Array
    _lanes: str = ""

    @property
    def lanes(self) -> str:
        """Number of trajectories integrated in SIMD lanes, and their instructions, or the reason why none were; not in
        files."""
        return self._lanes

    def __repr__(self) -> str:
        """Return a table of the counts that are not 0 or NaN in all trajectories, with minimum and maximum."""
        rows = [f"EnsembleStats of {len(self.steps)} trajectories"]
        for name, values in self.items():
            known = values[np.isfinite(values)]
            if known.any():
                low, high = (
                    f"{one:,}" if values.dtype.kind == "i" else f"{one:.6g}" for one in (known.min(), known.max())
                )
                rows.append(f"{name:>17}: {low}" + (f" to {high}" if low != high else ""))
        return "\n".join([*rows, f"{'lanes':>17}: {self.lanes}"])


class EnsembleSensitivities(NamedTuple):
    """The derivatives of trajectories with respect to parameters."""

    names: list[str]
    values: Array  # as y, (N, n, k, n_t)
    end: Array  # (N, n, k)

    @classmethod
    def of(cls, names: list[str], at_times: Array | None, end: Array, status: Array) -> EnsembleSensitivities:
        """Make the sensitivities at the output times, or where trajectories ended, NaN for those that failed."""
        if at_times is None:
            at_times = np.where((status >= 0)[:, None, None, None], end[..., None], np.nan)
        return cls(names, at_times, end)


@dataclasses.dataclass(eq=False, repr=False)
class EnsembleSolution:
    """Result of `solve_ensemble`: N trajectories of n components.

    ``len(m)`` is N, ``m[i]`` is trajectory i as a `Solution`, and a loop over m goes over these. Fields are items too:
    ``m["y"]`` is ``m.y``.

    Attributes
    ----------
    t : ndarray, (n_t,)
        `t_eval`; without it the end of the interval.
    y : ndarray, (N, n, n_t)
        The states at t, NaN at times that a trajectory did not reach. Without `t_eval` the final states, at `t_end`,
        which is earlier where an event or the callback stopped a trajectory; NaN for those that failed.
    t_end : ndarray, (N,)
        Where each trajectory ended.
    y_end : ndarray, (N, n)
        The state there, also of trajectories that failed on their way (status -1 to -3); NaN for status -4.
    status : ndarray of int, (N,)
        0 reached the end, 1 a terminal event, 2 stopped by `callback`, -1 the step failed, -2 a given invariant is not
        conserved, -3 a limit was reached, -4 an error that raises an exception in a single solve: the initial value is
        off a demanded manifold, not consistent or not finite, an invariant or an event is refused, a function raised;
        -128 not solved, since Ctrl-C stopped the ensemble (see `on_interrupt`).
    success : ndarray of bool, (N,)
        status >= 0.
    messages : dict of int to str
        Why, for each trajectory without success.
    events : list of EnsembleEvents
        One for each event function.
    stats : EnsembleStats
        Counts of each trajectory.
    value : ndarray, (N, m)
        The values at which the invariants were held (the first ones, if events with actions changed them). NaN for
        trajectories that did not start.
    residual_before : ndarray, (N, m)
        Largest ``|g - value|`` of the accepted candidates before projection.
    residual_after : ndarray, (N, m)
        The same at the outputs and the end.
    correction : ndarray, (N,)
        Largest correction of a step by projection, in units of rtol.
    attempt : ndarray of int, (N,)
        Which attempt gave each result: 0, with the method and options given; k, with the k-th of `retry`.
    """

    t: Array
    y: Array
    t_end: Array
    y_end: Array
    status: Array
    success: Array
    messages: dict[int, str]
    events: list[EnsembleEvents]
    stats: EnsembleStats
    value: Array
    residual_before: Array
    residual_after: Array
    correction: Array
    attempt: Array
    _trajectories: Trajectories | None = None  # None: from a pickle or a file, without the functions
    _final: bool = False  # whether y are the final states
    _labels: list[str] | None = None  # None: the default ones
    _sensitivities: EnsembleSensitivities | None = None
    _index: Any = None  # the labels of the rows that were given; None: 0 to N - 1
    _arguments: tuple[list[str], Array] | None = None  # names, and values (N, k) where rows have their own

    def _repr_html_(self) -> str:
        return html_of_ensemble(self)

    def __repr__(self) -> str:
        size, n = self.y_end.shape
        counted = ((0, "reached the end"), (1, "had a terminal event"), (2, "were stopped by callback"))
        parts = [f"{k} {what}" for status, what in counted if (k := int((self.status == status).sum()))]
        rows, times = "trajectory" if size == 1 else "trajectories", len(self.t)
        shape = f"{size} {rows}, {n} component{'s' * (n != 1)}, {times} time{'s' * (times != 1)}"
        text = f"EnsembleSolution of {shape}: {', '.join(parts) or '-'}"
        if self.messages:
            first = min(self.messages)
            text += f", {len(self.messages)} failed (the first, number {first}: {self.messages[first]})"
        return text

    @property
    def labels(self) -> list[str]:
        """Names of the components."""
        return default_labels(self.y.shape[1]) if self._labels is None else self._labels

    @property
    def sensitivities(self) -> Array | None:
        """∂y/∂p as y, of shape (N, n, k, n_t); None if the problem had no `sensitivities`."""
        return None if self._sensitivities is None else self._sensitivities.values

    @property
    def sensitivity_names(self) -> list[str]:
        """The k parameters."""
        return [] if self._sensitivities is None else list(self._sensitivities.names)

    @property
    def index(self) -> Array:
        """The labels of the trajectories, (N,): those of the rows of a table or labelled array that was given as `y0`
        or `args`; otherwise 0 to N - 1. Files have labels such as dates and tuples as text."""
        return np.arange(len(self)) if self._index is None else np.asarray(self._index)

    @property
    def parameters(self) -> dict[str, Array]:
        """The numbers in `args` by name, (N,), if each trajectory has its own; otherwise empty."""
        names, values = self._arguments or ([], np.zeros((len(self), 0)))
        return dict(zip(names, values.T, strict=True))

    @property
    def failed(self) -> Array:
        """Numbers of the trajectories that failed; `messages` gives the reasons."""
        return np.flatnonzero(~self.success)

    @property
    def exception(self) -> BaseException | None:
        """The exception of the first trajectory that raised one, with its traceback, which is a note where another
        process solved it. None without one, and in a result from a file."""
        return None if self._trajectories is None else self._trajectories.error

    def keys(self) -> list[str]:
        """Return the names of the fields."""
        return [field.name for field in dataclasses.fields(self) if not field.name.startswith("_")]

    def __contains__(self, name: object) -> bool:
        return name in self.keys()

    def __len__(self) -> int:
        return len(self.status)

    def __iter__(self) -> Iterator[Solution]:
        return (self[i] for i in range(len(self)))

    @overload
    def __getitem__(self, key: str) -> Any: ...
    @overload
    def __getitem__(self, key: int) -> Solution: ...
    def __getitem__(self, key: str | int) -> Any:
        if isinstance(key, str):
            if key in self:
                return getattr(self, key)
            raise KeyError(key)
        i = operator.index(key)
        if not -len(self) <= i < len(self):
            raise IndexError(f"there is no trajectory {i}: choose from 0 to {len(self) - 1}")
        return self._trajectory(i % len(self))

    def _trajectory(self, i: int) -> Solution:
        """Return one trajectory as the result of a single solve: without steps and dense output, which are not
        stored."""
        about = _about(self)
        invariants = about.invariants(i, self.value[i])
        status = int(self.status[i])
        stats = self._stats_of(i)
        occurred = [(event, event.trajectory == i) for event in self.events]
        t, y = (self.t_end[i : i + 1], self.y_end[i][:, None]) if self._final else (self.t, self.y[i])
        reached = np.isfinite(y).all(axis=0)
        S = None
        if self._sensitivities is not None:
            names, values, end = self._sensitivities
            at_outputs = end[i][:, :, None] if self._final else values[i]
            S = SensitivityData(names, at_outputs[:, :, reached], end[i], None)
        return Solution(
            {
                "_invariants": invariants,
                "_rtol": about.rtol,
                "_atol": about.atol,
                "_drift": self._drift(i, about, stats, known=len(invariants) > 0),
                "_names": Names(f"{about.name} {i}", None, self._labels, self.y.shape[1], about.events),
                "_sensitivities": S,
                "_y_end": self.y_end[i],
                "_origin": None,
            },
            t=t[reached],
            y=y[:, reached],
            sol=None,
            t_events=ByEvent(about.events, [event.t[own] for event, own in occurred]) if self.events else None,
            y_events=ByEvent(about.events, [at_events(event.y[own]) for event, own in occurred])
            if self.events
            else None,
            nfev=stats.nfev,
            njev=stats.njev,
            nlu=stats.nlu,
            status=status,
            message=self.messages.get(i) or next(text for code, text in MESSAGES.values() if code == status),
            success=status >= 0,
            stats=stats,
            steps=None,
            t_end=float(self.t_end[i]),
        )

    def _stats_of(self, i: int) -> Stats:
        """Return the counts of one trajectory as a single solve has them, with the first discontinuity of f only."""
        about = {name: values[i].item() for name, values in self.stats.items() if name != "stiff"}
        since, jump, _ = (about.pop(name) for name in ("stiff_since", "discontinuity", "accumulation"))
        return Stats(
            **about,
            derivatives=None,
            projected_start=False,
            stiff_since=None if np.isnan(since) else since,
            discontinuities=() if np.isnan(jump) else (jump,),
        )

    def _drift(self, i: int, about: Trajectories, stats: Stats, *, known: bool) -> BeforeProjection:
        """Return the drift before projection; where functions and values after jumps are not known, the whole drift."""
        unknown = np.full(self.value.shape[1], np.nan)
        correction = float(self.correction[i])
        if known or not len(unknown):
            return BeforeProjection(self.residual_before[i], unknown, correction)
        whole = Drift(
            names=list(about.laws),
            value=self.value[i],
            residual_before=self.residual_before[i],
            distance_before=unknown,
            residual_after=self.residual_after[i],
            distance_after=unknown,
            correction=correction,
            projections=stats.projections,
            skipped=stats.skipped,
        )
        return BeforeProjection(unknown[:0], unknown[:0], correction, whole)

    def plot(
        self,
        kind: Literal["bands", "quantiles", "spaghetti"] = "bands",
        *,
        ax: Axes | None = None,
        components: Any = None,
        **line: Any,
    ) -> Axes:
        """Draw components of all trajectories over t.

        Parameters
        ----------
        kind : {'bands', 'quantiles', 'spaghetti'}, default 'bands'
            The median with the ranges that hold the middle 50 % and 90 % of the trajectories; lines at the quantiles
            5, 25, 50, 75 and 95 %; or a thin line for each trajectory, of more than 500 for 500 of them.
        ax : matplotlib.axes.Axes, optional
            Where to draw everything. Default: a new figure, with a panel for each component.
        components : int or str, or sequence of these, optional
            Default: all, of more than six the first six.
        **line
            Properties of the lines, as for ``Axes.plot``.

        Returns
        -------
        matplotlib.axes.Axes
            The first panel; all are in ``ax.figure.axes``.

        Raises
        ------
        ValueError
            The ensemble was solved without `t_eval`; there is no such component or kind.
        """
        return draw_ensemble(self, choice("kind", kind, ("bands", "quantiles", "spaghetti")), ax, components, line)

    def to_xarray(self) -> xarray.Dataset:
        """Return the trajectories as a labelled data set of xarray.

        Returns
        -------
        xarray.Dataset
            `y` (trajectory, component, t), `y_end`, `t_end`, `status` and `correction`, the counts of `stats`, with
            invariants their `value`, `residual_before` and `residual_after` (trajectory, invariant). The coordinate
            `trajectory` is `index`; `parameters` are coordinates along it.

        Raises
        ------
        ModuleNotFoundError
            xarray, of the extra `data`, is not installed.
        """
        return ensemble_to_xarray(self)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the trajectories as a table of pandas.

        Returns
        -------
        pandas.DataFrame
            A row for each trajectory and time, with the index (`trajectory`, `t`), and a column for each component and
            each of the `parameters`. `trajectory` is the label in `index`. Times that a trajectory did not reach are
            left out.

        Raises
        ------
        ModuleNotFoundError
            pandas, of the extra `data`, is not installed.
        """
        return ensemble_to_dataframe(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all arrays to one file, from which `EnsembleSolution.load` makes an equal result, with the fields
        that you have added (numbers, text, lists, dicts, arrays); a warning names those that it cannot keep.

        Parameters
        ----------
        path : str or path-like
            The file, by exactly this name; conventionally it ends in ``.npz``. An existing file is replaced.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        write(path, _ENSEMBLE, _ENSEMBLE.taken(self))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> EnsembleSolution:
        """Load the result that `save` wrote to a file.

        Its trajectories have no invariants: functions are not in files.

        Raises
        ------
        ValueError
            The file was not written by `EnsembleSolution.save`, or is damaged.
        OSError
            It cannot be read.
        """
        _, found = read(path, _ENSEMBLE)
        with damage_of(path):
            labels, names = found["labels"], found["parameters"]
            named = None if labels is None else distinct_labels(labels, found["y_end"].shape[1])
            about = Trajectories.unknown(len(found["event_names"]), 0)
            about.name, about.events, about.laws = found["name"], found["event_names"], found["invariants"]
            made = cls(**{
                **{name: one for name, one in found.items() if name in cls.__annotations__},
                "stats": EnsembleStats(**under("stats", found)),
                "events": [EnsembleEvents(**one) for one in apart(under("events", found), found["events"])],
                "messages": {int(i): text for i, text in found["messages"].items()},
                "_trajectories": about,
                "_final": found["final"],
                "_labels": named,
                "_sensitivities": names and EnsembleSensitivities(names, found["S"], found["S_end"]),
                "_index": found["index"],
                "_arguments": (found["arguments"], found["args"]) if found["arguments"] else None,
            })  # fmt: skip
            vars(made).update(restored(found, vars(made).keys() | cls.__annotations__.keys()))
        return made


#: The arrays with a row for each trajectory, in files and in stores.
OF_TRAJECTORIES = {
    "y": Field(None, "trajectory component t"),
    "t_end": Field(float, "trajectory"),
    "y_end": Field(None, "trajectory component"),
    "status": Field(np.int8, "trajectory"),
    "value": Field(float, "trajectory invariant"),
    "residual_before": Field(float, "trajectory invariant"),
    "residual_after": Field(float, "trajectory invariant"),
    "correction": Field(float, "trajectory"),
    "attempt": Field(np.int8, "trajectory"),
}


def _about(m: EnsembleSolution) -> Trajectories:
    return m._trajectories or Trajectories.unknown(len(m.events), m.value.shape[1])


def _added(m: EnsembleSolution) -> tuple[dict[str, Any], dict[str, Array]]:
    own = {field.name for field in dataclasses.fields(EnsembleSolution)}
    return kept({name: value for name, value in vars(m).items() if name not in own})


def _events(m: EnsembleSolution) -> tuple[int, dict[str, Array]]:
    return len(m.events), together(m.events, none_of(m.y_end))


_COUNTED = [name for name in EnsembleStats.__annotations__ if name != "_lanes"]
#: The statistics that are no counts.
REAL_STATS = ("clipped_amount", "stiff_since", "discontinuity", "accumulation")


def _labels_in_file(index: Array, given: Any) -> list[Any]:
    """Return the labels of rows, as an array and as they were given, as numbers and text."""
    if index.dtype.kind in "biuf":
        return [*index.tolist()]
    return [one if isinstance(one, (str, int, float)) else str(one) for one in given]


_ENSEMBLE = Kind(
    "ensemble",
    {
        "messages": Field(dict[str, str], of=lambda m: {str(i): text for i, text in m.messages.items()}),
        "final": Field(bool, of=attrgetter("_final")),
        "labels": Field(list[str] | None, of=attrgetter("_labels")),
        "name": Field(str, of=lambda m: _about(m).name),
        "event_names": Field(Annotated[list[str], "event"], of=lambda m: _about(m).events),
        "invariants": Field(Annotated[list[str], "invariant"], of=lambda m: _about(m).laws),
        "added": Field(dict[str, Any], GROUP, _added),
        "parameters": Field(Annotated[list[str], "parameter"] | None, of=field_of("_sensitivities", "names")),
        "S": Field(None, "trajectory component parameter t", field_of("_sensitivities", "values"), optional=True),
        "S_end": Field(None, "trajectory component parameter", field_of("_sensitivities", "end"), optional=True),
        "index": Field(Any, of=lambda m: None if m._index is None else _labels_in_file(m.index, m._index)),
        "arguments": Field(Annotated[list[str], "argument"], of=lambda m: [*m.parameters]),
        "args": Field(float, "trajectory argument", lambda m: m._arguments and m._arguments[1], optional=True),
        "t": Field(float, "t"),
        "success": Field(bool, "trajectory"),
        **OF_TRAJECTORIES,
        **{f"stats.{name}": Field(float if name in REAL_STATS else np.int64, "trajectory") for name in _COUNTED},
        "events": Field(Annotated[int, "event"], GROUP, _events),
        **OCCURRENCES,
        "events.trajectory": Field(np.int64, "occurrence", within=(0, "<trajectory")),
    },
)
