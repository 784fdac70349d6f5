"""Records of a run: its counts, its steps, its events and the drift of its invariants."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._base.arguments import Array, shown
from .._base.forks import cached_property
from .._base.suggestions import meant
from .._core import Run


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
    """An object whose attributes are made together when one of them is first read, by ``_make``: a function, followed
    by its arguments. Runs make such objects by `Run.solution`, without a call of their class."""

    def _settle(self) -> bool:
        """Make the deferred attributes, except for those set meanwhile; return whether there were any to make."""
        make = self.__dict__.get("_make")
        if make is None:
            return False
        function, *arguments = make
        self.__dict__.update({**function(*arguments), **self.__dict__})
        self.__dict__.pop("_make", None)
        return True

    if TYPE_CHECKING:
        _make: tuple[Any, ...]
    else:  # a type checker would accept every misspelt field

        def __getattr__(self, name: str) -> Any:
            """Make the deferred attributes, for a name that is not there yet."""
            if not self._settle() and name not in self.__dict__:  # another thread may have made it
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
            return getattr(self, name)


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


def _column(i: int, kind: type = float) -> cached_property[Array]:
    def column(steps: Steps) -> Array:
        return steps._rows[:, i].astype(kind)

    return cached_property(column)


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

    t, h, order = _column(0), _column(1), _column(2, np.int32)
    error, correction = _column(3), _column(4)

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
