"""What comes back from a solve."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ._arguments import Array, warn
from ._core import Dense
from .invariants import BoundInvariants, as_columns

if TYPE_CHECKING:
    import os

    import pandas
    import xarray
    from matplotlib.axes import Axes

    from ._continuing import Origin
    from ._types import InvariantsLike

__all__ = ["DenseSolution", "Drift", "Solution", "Stats", "Steps"]


class Record(Mapping[str, Any]):
    """Fields of a dataclass as items too, as in SciPy's results: ``sol.t`` is ``sol["t"]``."""

    def __getitem__(self, key: str) -> Any:
        if key in self.keys():
            return getattr(self, key)
        raise KeyError(key)

    def __iter__(self) -> Iterator[str]:
        return (f.name for f in dataclasses.fields(self) if not f.name.startswith("_"))  # type: ignore[arg-type]  # subclasses are dataclasses

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, key: object) -> bool:
        return key in list(self)

    __eq__ = object.__eq__  # arrays do not compare to one truth
    __hash__ = object.__hash__


@dataclasses.dataclass(eq=False)
class Stats(Record):
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
        Evaluations of f by the tests that an invariant is one; not in `nfev`.
    njev : int
        Evaluations of the Jacobian of f.
    nlu : int
        Factorisations.
    nsolve : int
        Solutions of linear systems.
    projections : int
        Projected attempts.
    skipped : int
        Attempts whose projection was not needed.
    ng : int
        Evaluations of the invariants, output between steps included.
    ngjac : int
        Evaluations of their Jacobians, likewise.
    ngdiff : int
        Of `ng`, those that Jacobians cost: complex steps and differences, and the choice between them at the start.
    derivatives : str or None
        How the Jacobians of the invariants were had: 'given', 'complex step', 'central differences', 'forward
        differences', several of these, or None.
    projected_start : bool
        y0 was off a demanded value by less than the tolerance, and was projected; or it did not satisfy the algebraic
        equations of a singular mass matrix, and was moved.
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
    ng: int
    ngjac: int
    ngdiff: int
    derivatives: str | None
    projected_start: bool


class Steps(Record):
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
    """

    def __init__(self, rows: Array) -> None:
        self._rows = rows  # (n_steps, 5)

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

    def __iter__(self) -> Iterator[str]:
        return iter(("t", "h", "order", "error", "correction"))

    def __repr__(self) -> str:
        return f"Steps({len(self._rows)} steps)"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Drift(Record):
    """How the invariants fared; prints as a table. Arrays of one value per invariant.

    Attributes
    ----------
    names : list of str
        The names of the invariants.
    value : ndarray
        What was held (at first, if events with actions changed it).
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
        Steps that were close enough.
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
            f"{'invariant':<{width}} {'value':>14}  {'residual before, after':>22}  {'distance before, after':>22}",
            *(
                f"{name:<{width}} {value:>14.6g}  {before:>11.2e}{after:>11.2e}  {far:>11.2e}{near:>11.2e}"
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
            f"distances in units of the tolerance; largest correction of a step {self.correction:.2e}; "
            f"{self.projections} projections, {self.skipped} skipped",
        ]
        return "\n".join(lines)


class DenseSolution:
    """The solution as a continuous function of t.

    ``sol(t)`` has shape (n,) for a number and (n, n_t) for an array t. At the ends of the steps it returns the stored
    values; between them it does what the option `interpolation` says. Outside [t_min, t_max] it extrapolates the
    outermost step, as SciPy does.

    Attributes
    ----------
    ts : ndarray
        The ends of the steps, the start first.
    t_min : float
        Where the interval begins.
    t_max : float
        Where it ends.
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

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_dense": self._dense.parts()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _dense=Dense.from_parts(**state["_dense"]))

    def __call__(self, t: ArrayLike) -> Array:
        times = np.asarray(t, dtype=float)
        if times.ndim > 1:
            raise ValueError(f"t must be a number or 1-dimensional, got shape {times.shape}")
        g = self._invariants
        problem = g.problem(self._dense.n, self._dtype.kind == "c", g.value)
        rows = self._dense.evaluate(np.atleast_1d(times), problem)
        y = as_columns(rows, self._dtype)
        if self._imposed is not None and y.shape[1]:
            y = g.impose(np.atleast_1d(times), y, **self._imposed, pieces=g.pieces_at(np.atleast_1d(times), "right")).y
        return y[:, 0] if times.ndim == 0 else y

    def imposed(self, rtol: ArrayLike, atol: ArrayLike) -> DenseSolution:
        """The same with its values projected to roundoff."""
        return DenseSolution(self._dense, self._dtype, self._invariants, {"rtol": rtol, "atol": atol})


@dataclasses.dataclass
class Names:
    """What tables and pictures call things."""

    problem: str
    title: str | None  # the problem's name, where one was given
    labels: list[str] | None
    size: int
    events: list[str]

    @property
    def components(self) -> list[str]:
        return default_labels(self.size) if self.labels is None else self.labels


def default_labels(size: int) -> list[str]:
    """Made when they are asked for: of a large problem they take more memory than the solution."""
    return [f"y{i}" for i in range(size)]


@dataclasses.dataclass(eq=False, repr=False)
class Solution(Record):
    """Result of a solve. The fields up to `success` are those of `scipy.integrate.solve_ivp`.

    Attributes
    ----------
    t : ndarray, (n_t,)
        Times.
    y : ndarray, (n, n_t)
        The solution at t.
    sol : DenseSolution or None
        The solution as a function of t, with ``dense_output=True``.
    t_events : list of ndarray, or None
        For each event its times, (k,). None without events.
    y_events : list of ndarray, or None
        For each event its states, (k, n).
    nfev : int
        Evaluations of f.
    njev : int
        Evaluations of its Jacobian.
    nlu : int
        Factorisations.
    status : int
        0 reached the end, 1 a terminal event, 2 stopped by `callback`, -1 the step failed, -2 an invariant is none.
    message : str
        Why the integration ended.
    success : bool
        status >= 0.
    stats : Stats
        All counts.
    steps : Steps or None
        The accepted steps, with ``save="all"``: the default without `t_eval`.

    Notes
    -----
    A solution can be copied and pickled. The functions of its invariants go with it, and pickle takes those of a module
    only, no lambdas; `save` needs none. Its other functions stay behind: the copy from a pickle cannot be extended.
    """

    t: Array
    y: Array
    # None or not is known to the caller, who said what to compute: `| Any` spares them a test of it.
    sol: DenseSolution | Any
    t_events: list[Array] | Any
    y_events: list[Array] | Any
    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    success: bool
    stats: Stats
    steps: Steps | Any
    _invariants: BoundInvariants
    _rtol: ArrayLike
    _atol: ArrayLike
    _drift: tuple[Array, Array, float]
    _names: Names
    _origin: Origin | None = None  # None: there are no functions

    @cached_property
    def residual(self) -> Array:
        """g(t, y) - value of the invariants imposed, (m, n_t), at the outputs. Computed when first asked for."""
        return self._invariants.residual(self.t, self.y, self._invariants.pieces_of_output(len(self.t)))

    def drift(self) -> Drift:
        """What projection kept: for each invariant its value, and its largest residuals before and after projection.

        Those before are of the candidates of the accepted steps; those after are of the output, for which g and its
        Jacobian are evaluated when this is called.
        """
        g = self._invariants
        before, distance, correction = self._drift
        after = g.distance(self.t, self.y, self._rtol, self._atol, g.pieces_of_output(len(self.t)))
        return Drift(
            names=list(g.names),
            value=g.value,
            residual_before=before[: len(g)],
            distance_before=distance[: len(g)],
            residual_after=np.abs(self.residual).max(axis=1, initial=0),
            distance_after=after.max(axis=1, initial=0),
            correction=correction,
            projections=self.stats.projections,
            skipped=self.stats.skipped,
        )

    @property
    def correction(self) -> Array:
        """The corrections by projection of the accepted steps, (n_steps,), in units of rtol."""
        if self.steps is None:
            raise ValueError('the corrections of the steps are kept with save="all"')
        return self.steps.correction

    def impose(self) -> Solution:
        """This solution with y, the event states and ``sol(t)`` projected to roundoff onto the run's own invariants.

        Returns
        -------
        Solution
            Points that did not converge stay as they are, with a warning.
        """
        g = self._invariants
        if len(g) == 0:
            raise ValueError("the run had no invariants; use invariode.impose(invariants, solution)")

        def project(t: Array, y: Array, pieces: Array) -> Array:
            if y.shape[1] == 0:
                return y
            result = g.impose(t, y, self._rtol, self._atol, pieces)
            if not result.converged.all():
                left = int((~result.converged).sum())
                warn(f"impose: {left} of {len(t)} points did not converge and are unchanged")
            return result.y

        events = self.y_events
        if events is not None and self.t_events is not None:
            events = [project(t, y.T, g.pieces_at(t, "left")).T for t, y in zip(self.t_events, events, strict=True)]
        dense = self.sol and self.sol.imposed(self._rtol, self._atol)
        y = project(self.t, self.y, g.pieces_of_output(len(self.t)))
        origin = self._origin and dataclasses.replace(self._origin, imposed=True)
        return dataclasses.replace(self, y=y, y_events=events, sol=dense, _origin=origin)

    def extend(self, t_end: float, **options: Any) -> Solution:
        """Continues the run to `t_end`: the solution on the old interval and the new one.

        The method starts again from the final state, with the problem and the options of the run. The Runge-Kutta pairs
        go on with the step they had in mind; ode113 and ode15s, whose memory a solution does not hold, build their
        order up again, from a first step of their own choice. Invariants keep the values at which they are held. An
        event that ended the run, or occurred at its very end, is not found again; one with ``terminal=True`` ends the
        extension at its next occurrence, and occurrences that an integer `terminal` counts are counted on. The action
        of an event that ended the run was not taken, and is not taken now.

        Parameters
        ----------
        t_end : float
            The new end, beyond the old one in the direction of integration; the old one is where the run ended, also if
            an event or the callback ended it. May be infinite.
        t_eval : array_like, optional
            Times of the output in the new interval, where the run had `t_eval`. Default: those it has not reached.
            Those beyond `t_end` are left for a further extension.
        max_step : float, optional
            Default: that of the run, or a tenth of the whole interval.
        first_step, callback, check, progress : optional
            As in `solve_ivp`.

        Returns
        -------
        Solution
            A new one, with the outputs, steps, events and ``sol(t)`` of both parts, and the sums of their counts;
            `status` and `message` are those of the second. This one does not change.

        Raises
        ------
        TypeError
            An option that the extension cannot have of its own.
        ValueError
            `t_end` is not beyond the end; the run failed; or the solution comes from a file or a pickle, without the
            functions.

        Examples
        --------
        >>> import invariode as iv
        >>> half = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0.0], rtol=1e-8, atol=1e-10)
        >>> sol = half.extend(20)
        >>> (float(half.t[-1]), float(sol.t[-1]), bool(abs(sol.y[0, -1] - np.cos(20)) < 1e-6))
        (10.0, 20.0, True)
        """
        from ._continuing import extend

        return extend(self, t_end, options)

    def plot(self, ax: Axes | None = None, components: Any = None, **line: Any) -> Axes:
        """Components over t, on `ax` or a new figure: `invariode.plotting.plot`."""
        from . import plotting

        return plotting.plot(self, ax, components, **line)

    def plot_phase(self, i: int | str, j: int | str | None = None, ax: Axes | None = None, **line: Any) -> Axes:
        """One component over another, or a complex one in its plane: `invariode.plotting.plot_phase`."""
        from . import plotting

        return plotting.plot_phase(self, i, j, ax, **line)

    def plot_drift(self, ax: Axes | None = None, invariants: InvariantsLike | None = None, **line: Any) -> Axes:
        """Residuals of the invariants, before and after projection: `invariode.plotting.plot_drift`."""
        from . import plotting

        return plotting.plot_drift(self, ax, invariants, **line)

    def plot_steps(self, axes: Any = None, **line: Any) -> Array:
        """Size, order and error of the accepted steps: `invariode.plotting.plot_steps`."""
        from . import plotting

        return plotting.plot_steps(self, axes, **line)

    def to_xarray(self) -> xarray.Dataset:
        """The solution as a labelled data set of xarray, which can be written as netCDF.

        Returns
        -------
        xarray.Dataset
            `y` (component, t), with the problem's labels and the times as coordinates, complex where the problem is.
            With invariants, `residual` (invariant, t), and their first values as the coordinate `value`. For each event
            `y_events_NAME` (event_NAME, component) with its times as the coordinate `t_events_NAME`; events that share
            a name are numbered. Of the accepted steps, if kept, `h, order, error, correction` (t_step). The attributes
            are the problem's name, the outcome, the tolerances, and all counts of `stats`.

        Raises
        ------
        ModuleNotFoundError
            xarray, of the extra `data`, is not installed.
        """
        from .export import to_xarray

        return to_xarray(self)

    def to_dataframe(self) -> pandas.DataFrame:
        """The outputs as a table of pandas.

        Returns
        -------
        pandas.DataFrame
            One row per output, with the index `t`; a column per component under its label (complex ones have two,
            LABEL.real and LABEL.imag, so that they can be written), then ``residual of NAME`` for each invariant. Its
            `attrs` hold what the attributes of `to_xarray` do, and the invariants' values.

        Raises
        ------
        ModuleNotFoundError
            pandas, of the extra `data`, is not installed.
        """
        from .export import to_dataframe

        return to_dataframe(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes everything but the functions to one file, from which `invariode.load` makes an equal Solution.

        The residuals of the invariants and their distances are evaluated for it, at all outputs.

        Parameters
        ----------
        path : str or path-like
            The file, under just this name; conventionally it ends in ``.npz``. One that is there is replaced, all at
            once when the new one is complete.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        from .export import save

        save(self, path)

    def __repr__(self) -> str:
        width = max(map(len, self))
        shown = {name: self[name] for name in self}
        for name in ("t", "y"):
            shown[name] = f"array of shape {shown[name].shape}"
        for name in ("t_events", "y_events"):
            if shown[name] is not None:
                shown[name] = "[" + ", ".join(f"array of shape {one.shape}" for one in shown[name]) + "]"
        shown["sol"] = None if self.sol is None else f"function on [{self.sol.t_min}, {self.sol.t_max}]"
        return "\n".join(f"{name:>{width}}: {value}" for name, value in shown.items())
