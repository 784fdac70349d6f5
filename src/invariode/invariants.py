"""Invariants: what a solution keeps, and points projected onto it."""

from __future__ import annotations

import itertools
import math
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from ._arguments import (
    EPS,
    Array,
    as_array,
    call_name,
    choice,
    distinct,
    extra_arguments,
    function,
    items,
    numbers,
    positive_integer,
    real_numbers,
    reals,
    shown,
    tolerances,
)
from ._formulas import unlambdified
from ._types import Function, JacobianKind, Numbers
from .compiled import CoreFunction, is_native, native_parameters, to_native

__all__ = ["AccuracyWarning", "ImposeResult", "InvariantError", "Invariants", "InvariantsLike", "impose"]


#: How a Jacobian is computed without a function for it.
_KINDS = ("complex-step", "3-point", "2-point")

#: With when="needed", what is closer to the manifold is left alone, in units of rtol.
_NEGLIGIBLE = 0.01


#: Of corrections in levels at most: they converge quadratically, and end when roundoff is left.
_LEVEL_ITERATIONS = 10


class InvariantError(ValueError):
    """An invariant contradicts the problem: its value at the start, or its Jacobian, or f does not keep it."""


class Invariants:
    """Functions of the solution that keep their values, imposed by projection (paper, sections 2-4).

    Parameters
    ----------
    fun : callable
        ``g(t, y, *args)``, a number or an array of shape (m,); y has shape (n,). For complex y the values are real.
    jac : callable or {'complex-step', '3-point', '2-point'}, optional
        ``jac(t, y, *args)``, the Jacobian ∂g/∂y of shape (m, n), or (n,) for m = 1. For complex y row i holds
        ∂g_i/∂(Re y) + 1j ∂g_i/∂(Im y). Or how to compute it: by complex steps, Im g(y + i h e_j) / h, exact to
        roundoff, n evaluations of g at complex y; by central differences, 2n evaluations; by forward differences,
        n + 1. Default: complex steps where g takes complex y and they agree with a difference at the start, else
        central differences.
    value : float or array_like of shape (m,), optional
        The value to be held; constraints have 0. Default: that of g at the initial point.
    names : str or sequence of m str, optional
        For messages and tables. Default: the name of `fun`.
    iterations : int, optional
        Projection iterations per step. Default: that of the method, 1, or 2 for the pairs of order 5 and more (paper,
        section 4).
    when : {'always', 'needed'}, default 'always'
        Project after every step (paper, section 4), or leave alone what is closer to the manifold than 0.01 of the
        tolerance, which saves the evaluation of the Jacobian there.
    level : int, default 0
        Order of correction. Invariants of level 0 are imposed first; those of a later level are imposed by corrections
        that leave what the levels before hold as it is, to first order, and are iterated until roundoff is left, at
        most `iterations` times, by default 10. All at level 0: one correction for all together (paper, section 3).
    moves : sequence of int, optional
        The components of y that the correction may move; one set for all invariants of a level. Default: all. The
        others tell nothing of the distance to the manifold: an invariant must depend on some of these.
    direction : {'gradient', 'stages'}, default 'gradient'
        Where corrections may point: anywhere, which makes them the least ones, along the gradients; or among the stages
        of the step (the slopes of a Runge-Kutta or Rosenbrock method, the differences of a multistep method), all of
        which keep what is linear in y. Linear invariants that nobody names, as momenta and total masses, then survive
        the projection onto others to roundoff, in the output between steps too. One for all invariants of a run, all at
        level 0, without `metric`, `bounds` and mass matrices. See Notes.
    metric : array_like of shape (k,) or (k, k), or callable, optional
        Makes δᵀ G δ the square of a correction δ, and so the one that is the least: G, its diagonal or all of it,
        constant or ``G(t, y, *args)``, of the k components of `moves`, in their order; one for all invariants of a
        level, for real problems. Where it is not positive definite, and by default, it is the diagonal with 1 / w²,
        w the weights of the error test.

    Notes
    -----
    The units of g do not matter: distances to the manifold are measured in the weights of the error test. Redundant
    invariants are dropped with a warning. A function that the equations do not conserve is refused.

    Constraints of mechanics have levels: positions are put on φ(q) = 0 by moving q alone, then velocities on φ̇ = 0 by
    moving v alone, so that errors of v do not move q. The least correction in the metric of the mass matrix is what
    forces of the constraints do, so that it changes no momentum which these keep. `MechanicalSystem` sets all this.

    With ``direction="stages"`` the correction is the least one in the span of the stages (M. Kojima, BIT 56 (2016)
    1087-1102; M. Najafian, B. C. Vermeire, arXiv:2409.18328). The hazard: where gradients are nearly orthogonal to all
    of these, as where stages differ by roundoff only, it is long. An invariant of whose gradient less than 0.01 is left
    there is not corrected in that step.

    Examples
    --------
    >>> import invariode as iv
    >>> circle = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2, value=1, names="radius²")
    >>> circle
    Invariants(radius², value=[1.0])
    >>> sol = iv.solve_ivp(lambda t, y: [-y[1], y[0]], (0, 100), [1.0, 0.0], invariants=circle)
    >>> bool(abs(sol.residual).max() < 1e-9)
    True
    """

    def __init__(
        self,
        fun: Function,
        jac: Function | JacobianKind | None = None,
        value: Numbers | None = None,
        names: str | Sequence[str] | None = None,
        iterations: int | None = None,
        when: Literal["always", "needed"] = "always",
        level: int = 0,
        moves: Sequence[int] | None = None,
        metric: ArrayLike | Function | None = None,
        direction: Literal["gradient", "stages"] = "gradient",
    ) -> None:
        self.fun: Any = fun if is_native(fun) else unlambdified(function("the invariant", fun, "g(t, y)"))
        self.jac: Any = jac
        if isinstance(jac, str):
            choice("jac of the invariant", jac, _KINDS)
        elif jac is not None and not is_native(jac):
            function("jac of the invariant", jac, "jac(t, y)")
        self.value = None if value is None else _values(value)
        self.names = None if names is None else _names(names)
        self.iterations = None if iterations is None else positive_integer("iterations", iterations)
        self.when = choice("when", when, ("always", "needed"))
        self.level = _level(level)
        self.moves = None if moves is None else _components(moves)
        self.metric: Any = None if metric is None else _metric(metric)
        self.direction = _direction(direction)

    @property
    def sense(self) -> int:
        """0: it keeps its value. See `Dissipated`."""
        return 0

    def _in_core(self, n: int) -> tuple[Any, Any] | None:
        """The function and its Jacobian of n real components where the core has them itself."""
        return None

    def __repr__(self) -> str:
        held = "" if self.value is None else f", value={self.value.tolist()}"
        return f"{type(self).__name__}({', '.join(self.names or [call_name(self.fun, 'g')])}{held})"


class AccuracyWarning(UserWarning):
    """Projection moves a component of the solution by much more than its estimated error: it may do harm there.

    Said once: of a run, of all trajectories of an ensemble, or by one of the classes in ``invariode.scipy``.
    """


#: Invariants as arguments: a function, an `Invariants`, or several of these.
InvariantsLike: TypeAlias = Function | Invariants | Iterable[Function | Invariants]


def _values(value: ArrayLike) -> Array:
    try:
        values = np.atleast_1d(real_numbers("value of an invariant", value))
    except TypeError:
        raise TypeError(f"value of an invariant must be a number or an array of numbers, got {shown(value)}") from None
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"value of an invariant must be finite, of shape (m,) with m >= 1, got {shown(value)}")
    return values


def _names(names: object) -> list[str]:
    if isinstance(names, str):
        return [names]
    listed = items(names)
    if listed is None or not all(isinstance(name, str) for name in listed):
        raise TypeError(f"names of invariants must be str, or a list of str, got {shown(names)}")
    if not listed:
        raise ValueError("names of an invariant must be one str for each of its values, got none; leave names out")
    return listed


def _level(level: object) -> int:
    try:
        result = operator.index(level)  # type: ignore[arg-type]  # what is no integer is told apart right here
    except TypeError:
        result = -1
    if result < 0:
        raise ValueError(f"level of an invariant must be an integer from 0 on, got {level!r}")
    return result


def _direction(direction: object) -> Literal["gradient", "stages"]:
    if direction == "relaxation":
        raise ValueError(
            'direction of an invariant cannot be "relaxation": that moves the end of the step, away from where output, '
            'events and the end of the interval ask for it, and keeps one invariant only; "stages" has its direction '
            "among others, and keeps linear invariants as well"
        )
    return cast("Literal['gradient', 'stages']", choice("direction", direction, ("gradient", "stages")))


def _metric(metric: object) -> Any:
    if callable(metric) or is_native(metric):
        return metric
    constant = real_numbers("metric of an invariant", metric)
    if constant.ndim not in (1, 2) or constant.shape != constant.shape[:1] * constant.ndim or constant.size == 0:
        raise ValueError(f"metric of an invariant must have shape (k,) or (k, k), got {constant.shape}")
    if not np.isfinite(constant).all():
        raise ValueError("metric of an invariant must be finite")
    return constant


def _components(moves: object) -> list[int]:
    try:
        indices = [operator.index(index) for index in moves]  # type: ignore[attr-defined]  # the same
    except TypeError:
        raise TypeError(f"moves must be a list of indices of components of y, got {moves!r}") from None
    if not indices or min(indices) < 0 or len(set(indices)) < len(indices):
        raise ValueError(f"moves must list different components of y, from 0 on, got {moves!r}")
    return indices


def to_invariants(invariants: object) -> list[Invariants]:
    """The argument `invariants` as a list: a function, an Invariants, or a list of these."""
    if invariants is None:
        return []
    if isinstance(invariants, Invariants):
        return [invariants]
    if callable(invariants) or is_native(invariants):
        return [Invariants(cast("Callable[..., Any]", invariants))]
    listed = None if isinstance(invariants, (str, bytes)) else items(invariants)
    if listed is not None:
        return [one for item in listed for one in to_invariants(item)]
    raise TypeError(
        f"invariants must be a function g(t, y), an Invariants, or a list of these, got {shown(invariants)}"
    )


class InvariantSpec(NamedTuple):
    """An invariant in the form that the core takes."""

    fun: Any
    jac: Any  # a function, or how the Jacobian is computed without one
    m: int  # number of its values
    name: str
    held: bool  # at its initial value; False: at one that was demanded
    level: int = 0
    moves: Sequence[int] = ()  # the reals of y that its correction may move; none: all
    metric: Any = None  # in which it is the least: a function, or flat values
    metric_size: int = 0  # number of its values
    sense: int = 0  # -1: it never rises as t grows; 1: it never falls; 0: it keeps its value
    along_steps: bool = False  # its correction is made of what the step is made of


class Jump(NamedTuple):
    """Where the action of an event gave the invariants new values."""

    row: int  # of the output, from which on they hold
    t: float
    value: Array


@dataclass
class BoundInvariants:
    """Invariants together with the values they are held at and the arguments of their functions."""

    specs: list[InvariantSpec]
    value: Array
    names: list[str]
    args: tuple[Any, ...]
    parameters: Array  # the same for native functions
    iterations: int | None
    negligible: float = 0.0
    evaluations: int = 0  # of the functions, so far

    jumps: tuple[Jump, ...] = ()
    forward: float = 1.0

    def __len__(self) -> int:
        return len(self.value)

    @property
    def demanded(self) -> list[bool]:
        """Of each value, whether it was demanded."""
        return [not spec.held for spec in self.specs for _ in range(spec.m)]

    @property
    def along_steps(self) -> bool:
        """Whether corrections are made of what the steps are made of."""
        return any(spec.along_steps for spec in self.specs)

    @property
    def senses(self) -> list[int]:
        """Of each value, the sense of its invariant."""
        return [spec.sense for spec in self.specs for _ in range(spec.m)]

    def equalities(self) -> BoundInvariants:
        """Those alone that keep their values."""
        kept = [sense == 0 for sense in self.senses]
        if all(kept):
            return self
        return replace(
            self,
            specs=[spec for spec in self.specs if spec.sense == 0],
            value=self.value[kept],
            names=[name for name, stays in zip(self.names, kept, strict=True) if stays],
            jumps=tuple(jump._replace(value=jump.value[: len(kept)][kept]) for jump in self.jumps),
        )

    @property
    def last_value(self) -> Array:
        """At what the invariants are held at the end of the run."""
        return self.jumps[-1].value[: len(self)] if self.jumps else self.value

    def jumped(self, jumps: Iterable[tuple[int, float, Array]], forward: float) -> BoundInvariants:
        """The same with the jumps of a run in the direction `forward`."""
        return replace(self, jumps=tuple(Jump(*jump) for jump in jumps), forward=forward)

    def pieces_of_output(self, size: int) -> Array:
        """Between which jumps each point of the output lies."""
        return np.searchsorted([jump.row for jump in self.jumps], np.arange(size), side="right")

    def pieces_at(self, t: Array, side: Literal["left", "right"]) -> Array:
        """The same at times; `side`: which of two one-sided values is meant."""
        times = self.forward * np.array([jump.t for jump in self.jumps])
        return np.searchsorted(times, self.forward * np.asarray(t), side=side)

    def _each(self, pieces: Array | None, size: int) -> Iterator[tuple[Array, Array]]:
        """The points of each piece, and the values that invariants have there."""
        if pieces is None or not self.jumps:
            yield np.arange(size), self.value
            return
        for piece in np.unique(pieces):
            yield np.flatnonzero(pieces == piece), self.value if piece == 0 else self.jumps[piece - 1].value

    def residual(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        """g(t, y) - value, of shape (m, n_t), at the points y (n, n_t); of what is one-sided, by how much it has gone
        back behind the points before."""
        return self._violation(self.departure(t, y, pieces), pieces)

    def departure(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        """g(t, y) - value, of all."""
        residual = np.zeros((len(self.value), len(t)))
        if self.specs:
            for here, value in self._each(pieces, len(t)):
                residual[:, here] = _core.residual(t[here], _as_rows(y[:, here]), self._problem_of(y, value)).T
        return residual

    def _violation(self, departure: Array, pieces: Array | None) -> Array:
        """`departure`, of what is one-sided the rise above its lowest point so far in the piece (or the fall)."""
        last = departure.shape[1]
        cuts = [] if pieces is None else (np.flatnonzero(np.diff(pieces)) + 1).tolist()
        for i, sense in enumerate(self.senses):
            if sense == 0:
                continue
            for begin, end in itertools.pairwise([0, *cuts, last]):
                risen = -sense * self.forward * departure[i, begin:end]
                lowest = np.fmin.accumulate(np.append(0.0, risen))[:-1]
                departure[i, begin:end] = np.maximum(risen - lowest, 0)
        return departure

    def distance(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> Array:
        """Distances from the level sets, in units of rtol, of the same shape; of what is one-sided, those of what
        `residual` tells."""
        distance = np.zeros((len(self.value), len(t)))
        weights = _weights(y, rtol, atol)
        for here, value in self._each(pieces, len(t)):
            distance[:, here] = _core.distance(t[here], _as_rows(y[:, here]), self._problem_of(y, value), weights).T
        if not any(self.senses):
            return distance
        departure = self.departure(t, y, pieces)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.abs(self._violation(departure.copy(), pieces)) / np.abs(departure)
        share[departure == 0] = 0
        return distance * share

    def impose(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> ImposeResult:
        """Projects the points y (n, n_t)."""
        weights = _weights(y, rtol, atol)
        size = len(t)
        points, converged = y.copy(), np.zeros(size, dtype=bool)
        residual, iterations = np.zeros((len(self.value), size)), np.zeros(size, dtype=np.int64)
        for here, value in self._each(pieces, size):
            rows, done, left, spent = _core.impose(t[here], _as_rows(y[:, here]), self._problem_of(y, value), weights)
            points[:, here] = as_columns(rows, y.dtype)
            converged[here], residual[:, here], iterations[here] = done, left.T, spent
        return ImposeResult(points, converged, residual, iterations)

    def evaluate(self, dense: _core.Dense, t: Array) -> Array:
        """The rows of a continuous solution of the core at t, projected between the steps where it is to be."""
        return dense.evaluate(t, self._problem(dense.n, dense.complex, self.value))

    def _problem_of(self, y: Array, value: Array) -> _core.Problem:
        return self._problem(reals(y), y.dtype.kind == "c", value)

    def _problem(self, n: int, is_complex: bool, value: Array) -> _core.Problem:
        """The invariants alone, for the core; n: reals in a state."""
        return _core.Problem(
            n=n,
            complex=is_complex,
            fun=None,
            args=self.args,
            parameters=self.parameters,
            invariants=[_core.Invariant(*spec) for spec in self.specs],
            value=value,
        )


def _weights(y: Array, rtol: ArrayLike, atol: ArrayLike) -> _core.Tolerances:
    return _core.Tolerances(*tolerances(rtol, atol, y[:, 0] if y.shape[1] else np.ones(len(y), y.dtype)))


def _as_rows(y: Array) -> Array:
    """Points y (n, n_t) in the layout of the core: one row of reals per point."""
    rows = np.ascontiguousarray(y.T)
    return rows.view(float) if rows.dtype.kind == "c" else rows


def as_columns(rows: Array, dtype: np.dtype[Any]) -> Array:
    """The reverse: (n, n_t), complex where the problem is."""
    return (rows.view(dtype) if dtype.kind == "c" else rows).T


_NO_VALUES = np.zeros(0)


def bind(
    invariants: list[Invariants], t: float, y: Array, args: tuple[Any, ...], threshold: float | Array
) -> BoundInvariants:
    """Evaluates each invariant at (t, y): its size, the value it is held at if none is demanded, and whether it takes
    complex y. `threshold`: thr of the reals of y, the size below which components tell no scale."""
    if not invariants:
        return BoundInvariants([], _NO_VALUES, [], args, _NO_VALUES, None)
    specs, values, names = [], [], []
    evaluations, n = len(invariants), reals(y)
    p = native_parameters(args, [f for one in invariants for f in (one.fun, one.jac, one.metric)])
    for one in invariants:
        name = one.names[0] if one.names and len(one.names) == 1 else call_name(one.fun, "g")
        if is_native(one.fun):
            fun, at_start = _native_start(one, name, t, y, args, p)
        else:
            at_start = _evaluate(one, name, t, y, args)
            fun = to_native(name, one.fun, n, len(at_start), p)
        m = len(at_start)
        if one.value is not None and len(one.value) not in (1, m):
            raise ValueError(f"value of invariant {name} must have shape ({m},), as the invariant has, got {one.value}")
        if one.names is not None and len(one.names) != m:
            raise ValueError(f"invariant {name} returns {m} values and has {len(one.names)} names: {one.names}")
        kind = one.jac
        if kind == "complex-step" and np.iscomplexobj(y):
            raise ValueError(f'invariant {name}: jac="complex-step" is for real problems, and y0 is complex')
        if kind == "complex-step" and is_native(one.fun):
            raise ValueError(f'invariant {name}: jac="complex-step" is not for native functions, which take real y')
        if kind is None and is_native(one.fun):
            kind = "3-point"
        elif kind is None:
            probe = _Probe(one.fun, t, y, args, threshold, at_start)
            kind = "complex-step or 3-point" if probe.takes_complex() else "3-point"
            evaluations += probe.evaluations
        kind = to_native(f"the Jacobian of invariant {name}", kind, n, m * n, p)
        if y.dtype.kind != "c":
            fun, kind = one._in_core(len(y)) or (fun, kind)
        order = (one.level, _moves(one, name, y), *_metric_at(one, name, t, y, args, p))
        along = one.direction == "stages"
        specs.append(InvariantSpec(fun, kind, m, name, one.value is None, *order, one.sense, along))
        values.append(at_start if one.value is None else np.broadcast_to(one.value, (m,)))
        names.extend(one.names or ([name] if m == 1 else [f"{name}[{i}]" for i in range(m)]))
    levelled = _in_levels(specs)
    _require_one_direction(specs, levelled)
    iterations = [one.iterations for one in invariants if one.iterations is not None]
    value = values[0] if len(values) == 1 else np.concatenate(values)
    negligible = _NEGLIGIBLE if all(one.when == "needed" or one.sense for one in invariants) else 0.0
    names, most = distinct(names), max(iterations, default=_LEVEL_ITERATIONS if levelled else None)
    return BoundInvariants(specs, value, names, args, p, most, negligible, evaluations)


def _moves(one: Invariants, name: str, y: Array) -> Sequence[int]:
    """The reals of y that the correction of an invariant may move."""
    moves = one.moves or ()
    if moves and max(moves) >= len(y):
        raise ValueError(f"moves of invariant {name} must be indices of the {len(y)} components of y, got {moves}")
    if y.dtype.kind != "c":
        return moves
    return [part for index in moves for part in (2 * index, 2 * index + 1)]


def _metric_at(one: Invariants, name: str, t: float, y: Array, args: tuple[Any, ...], p: Array) -> tuple[Any, int]:
    """The metric of an invariant as the core takes it, and the number of its values."""
    metric = one.metric
    if metric is None:
        return None, 0
    if y.dtype.kind == "c":
        raise ValueError(f"metric of invariant {name} is for real problems, and y0 is complex")
    k = len(one.moves or y)
    if is_native(metric) and not isinstance(metric, CoreFunction):
        return to_native(f"the metric of invariant {name}", metric, len(y), k * k, p), k * k
    what = f"metric of invariant {name}"
    constant = not callable(metric)
    at_start = metric if constant else real_numbers(what, metric(t, y.copy(), *args))
    if at_start.shape not in ((k,), (k, k)):
        told = "must have shape" if constant else "returned another shape than"
        raise ValueError(f"{what} {told} ({k},) or ({k}, {k}), as {k} components move: {at_start.shape}")
    if constant:
        return np.ascontiguousarray(metric, dtype=float).ravel(), at_start.size
    return to_native(what, metric, len(y), at_start.size, p), at_start.size


def _in_levels(specs: list[InvariantSpec]) -> bool:
    """Whether the invariants have levels, in which all may move the same components in the same metric."""
    first: dict[int, InvariantSpec] = {}
    for spec in specs:
        other = first.setdefault(spec.level, spec)
        if set(other.moves) != set(spec.moves):
            raise ValueError(
                f"invariants {other.name} and {spec.name} are both of level {spec.level} and may move different "
                "components: give them one set of moves, or different levels"
            )
        if not _same(other.metric, spec.metric) or (spec.metric is not None and [*other.moves] != [*spec.moves]):
            raise ValueError(
                f"invariants {other.name} and {spec.name} are both of level {spec.level} and have different metrics: "
                "give them one metric, with moves in one order, or different levels"
            )
    return any(spec.level or spec.moves or spec.metric is not None for spec in specs)


def _require_one_direction(specs: list[InvariantSpec], levelled: bool) -> None:
    along = [spec for spec in specs if spec.along_steps]
    if not along:
        return
    if levelled:
        raise ValueError(
            f'direction="stages" of invariant {along[0].name} is without level, moves and metric: the stages leave no '
            'freedom for these; leave them out, or use direction="gradient"'
        )
    if len(along) < len(specs):
        other = next(spec for spec in specs if not spec.along_steps)
        raise ValueError(
            f"invariants {along[0].name} and {other.name} have different directions, and one correction serves both: "
            "give both the same direction"
        )


def _same(a: Any, b: Any) -> bool:
    """Whether two metrics are one."""
    return a is b or (isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and np.array_equal(a, b))


def _native_start(one: Invariants, name: str, t: float, y: Array, args: tuple[Any, ...], p: Array) -> tuple[Any, Array]:
    """A native g as the core takes it, and its values at (t, y). How many there are it does not tell itself."""
    told = [len(known) for known in (one.names, one.value) if known is not None]
    if not told:
        raise ValueError(f"invariant {name} is native: give its value or its names, to tell how many values it has")
    m = max(told)
    fun = to_native(f"invariant {name}", one.fun, reals(y), m, p)
    alone = BoundInvariants([InvariantSpec(fun, "3-point", m, name, held=False)], np.zeros(m), [name], args, p, None)
    at_start = alone.residual(np.array([t]), y[:, None])[:, 0]
    if not all(map(math.isfinite, at_start.tolist())):
        raise ValueError(f"invariant {name} is not finite at t = {t}: {at_start}")
    return fun, at_start


#: Parts of the components' sizes in which g is looked at where it is not defined farther away.
_NEARER = (1e-2, 1e-4, 1e-6)


class _Probe:
    """Does g take complex y, and is the derivative that this gives the one that differences give?"""

    def __init__(
        self, fun: Callable[..., Any], t: float, y: Array, args: tuple[Any, ...], threshold: float | Array, at_y: Array
    ) -> None:
        self._fun, self._t, self._y, self._args, self._at_y = fun, t, y, args, at_y
        self._threshold = threshold
        self.evaluations = 0

    def takes_complex(self) -> bool:
        if np.iscomplexobj(self._y):
            return False
        golden = np.modf(0.6180339887498949 * np.arange(1, len(self._y) + 1))[0]
        direction = self._sizes() * (0.5 + golden) * np.where(np.arange(len(self._y)) % 2, -1, 1)
        verdict = self._agrees(self._y + 0.1 * direction, direction)  # what is not analytic may not show at y itself
        if verdict is None:
            verdict = self._agrees(self._y, direction)
        for nearer in _NEARER:
            if verdict is not None:
                break
            for side in (1, -1):
                if verdict is None:
                    verdict = self._agrees(self._y + side * 0.1 * nearer * direction, nearer * direction)
        return bool(verdict)

    def _sizes(self) -> Array:
        """Of the components, for increments, as the core takes them."""
        size: Array = np.abs(self._y)
        largest = size.max(initial=0)
        if largest < 1e-300:
            largest = 1.0
        size = np.maximum(size, np.minimum(self._threshold, largest))
        size[size < 1e-300] = largest  # pure relative control at 0
        return size

    def _agrees(self, y: Array, direction: Array) -> bool | None:
        """Whether the two derivatives at y agree; None where g is not defined there."""
        tiny, delta = 1e-40, EPS ** (1 / 3)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("error")  # a warning tells that the imaginary part was thrown away
            try:
                up, down = self._evaluate(y + delta * direction), self._evaluate(y - delta * direction)
            except (ValueError, ArithmeticError, Warning):  # as math.log(-1), 1 / 0 and np.log(-1) have it
                return None
            try:
                by_step = self._evaluate(y + 1j * tiny * direction)
            except Exception:  # g is not made for this: no reason to tell the user
                return False
        if not np.isfinite(up).all() or not np.isfinite(down).all():
            return None
        if by_step.shape != self._at_y.shape or not np.isfinite(by_step).all():
            return False
        by_step = by_step.imag / tiny
        difference = (up - down) / (2 * delta)
        noise = 10 * EPS / delta * np.maximum(np.abs(self._at_y), np.abs(up)) + np.finfo(float).tiny
        agrees = np.abs(by_step - difference) <= 1e-6 * np.maximum(np.abs(by_step), np.abs(difference)) + noise
        return bool(agrees.all())

    def _evaluate(self, y: Array) -> Array:
        self.evaluations += 1
        return np.atleast_1d(np.asarray(self._fun(self._t, y, *self._args), dtype=y.dtype))


def at_complex(fun: Callable[..., Any], m: int) -> Callable[..., Any]:
    """g for complex y; NaN where it cannot be evaluated there, so that the core goes over to differences."""

    def evaluate(t: float, y: Array, *args: Any) -> Any:
        try:
            return fun(t, y, *args)
        except (TypeError, ValueError, ArithmeticError):
            return [np.nan] * m

    return evaluate


def _evaluate(one: Invariants, name: str, t: float, y: Array, args: tuple[Any, ...]) -> Array:
    returned = one.fun(t, y.copy(), *args)
    values = as_array(f"what invariant {name} returns", returned)
    if values.dtype.kind not in "biufO" or values.ndim > 1 or values.size == 0 or returned is None:
        what = (
            f"shape {values.shape} of type {values.dtype}" if returned is not None else "None (is a `return` missing?)"
        )
        raise ValueError(f"invariant {name} returned {what}, expected a real number or shape (m,)")
    values = np.atleast_1d(real_numbers(f"what invariant {name} returns", values))
    if not np.isfinite(values).all():
        raise ValueError(f"invariant {name} is not finite at t = {t}: {returned}")
    return values


@dataclass(frozen=True)
class ImposeResult:
    """Points projected onto the invariants.

    Attributes
    ----------
    y : ndarray, (n,) or (n, n_t)
        The projected points; those that did not converge are as they were given.
    converged : bool or ndarray of bool, (n_t,)
        Where every residual is roundoff: at most ``10 ε (|value_i| + Σ_j |J_ij y_j|)``.
    residual : ndarray, (m,) or (m, n_t)
        g(t, y) - value at the points returned.
    iterations : int or ndarray of int, (n_t,)
        Gauss-Newton iterations spent.
    sol : callable or None
        Of a result with dense output: that, projected; ``sol(t)`` has shape (n,) or (n, n_t).
    """

    y: Array
    converged: Any
    residual: Array
    iterations: Any
    sol: Callable[[Any], Array] | None = None


@dataclass(frozen=True)
class ImposedDense:
    """A continuous solution, its values projected to roundoff."""

    sol: Callable[[Any], Array]
    bound: BoundInvariants
    rtol: ArrayLike
    atol: ArrayLike

    def __call__(self, t: Any) -> Array:
        y = np.asarray(self.sol(t))
        columns = y.reshape(len(y), -1)
        imposed = self.bound.impose(np.atleast_1d(np.asarray(t, dtype=float)), columns, self.rtol, self.atol)
        return imposed.y.reshape(y.shape)


class _Points(Protocol):
    """What a result must have to be imposed on: a `Solution` or SciPy's."""

    @property
    def t(self) -> Any: ...
    @property
    def y(self) -> Any: ...


@overload
def impose(
    invariants: InvariantsLike,
    t: _Points,
    y: None = None,
    *,
    value: Numbers | None = None,
    args: Iterable[Any] = (),
    rtol: Numbers = 1e-3,
    atol: Numbers = 1e-6,
) -> ImposeResult: ...


@overload
def impose(
    invariants: InvariantsLike,
    t: ArrayLike,
    y: ArrayLike,
    *,
    value: Numbers | None = None,
    args: Iterable[Any] = (),
    rtol: Numbers = 1e-3,
    atol: Numbers = 1e-6,
) -> ImposeResult: ...


def impose(
    invariants: InvariantsLike,
    t: Any,
    y: ArrayLike | None = None,
    *,
    value: Numbers | None = None,
    args: Iterable[Any] = (),
    rtol: Numbers = 1e-3,
    atol: Numbers = 1e-6,
) -> ImposeResult:
    """Projects given points onto invariants, about as accurately as double precision allows (paper, section 4).

    Parameters
    ----------
    invariants : callable, Invariants, or list of these
        As for `solve_ivp`.
    t : float or array_like of shape (n_t,), or a result
        Times of the points; or a `Solution` or a result of SciPy's, whose t and y are taken.
    y : array_like, (n,) or (n, n_t)
        One point, or points in columns.
    value : float or array_like of shape (m,), optional
        The values to impose. Default: those of the `Invariants`, else the values of g at the first point.
    args : tuple, optional
        Extra arguments of the functions.
    rtol, atol : float or array_like of shape (n,)
        The weights ``max(|y|, atol / rtol)`` in which 'nearest' is meant. Default 1e-3, 1e-6.

    Returns
    -------
    ImposeResult
        With the shapes of the points given.

    Raises
    ------
    TypeError
        `t` is no result, and there is no `y`.
    ValueError
        The shapes of t and y do not match; an invariant is not finite at the first point; there is no invariant.

    Notes
    -----
    Gauss-Newton iterations, each with a fresh Jacobian, until the correction stagnates at roundoff, 50 at the most.

    Examples
    --------
    >>> import invariode as iv
    >>> found = iv.impose(lambda t, y: y @ y, 0.0, [0.6, 0.81], value=1)
    >>> (found.y.round(4), found.converged)
    (array([0.5969, 0.8023]), True)
    """
    dense = None
    if y is None:
        if not (hasattr(t, "t") and hasattr(t, "y")):
            raise TypeError(f"impose takes points (t, y) or a result with fields t and y, got t = {t!r} without y")
        dense, t, y = getattr(t, "sol", None), t.t, t.y
    points, times = _points(t, y)
    extra = extra_arguments(args)
    listed = to_invariants(invariants)
    if not listed:
        raise ValueError("impose needs at least one invariant")
    if any(one.direction == "stages" for one in listed):
        raise ValueError(
            'impose has no steps whose stages could be a direction: give it invariants with direction="gradient"'
        )
    if one_sided := [one for one in listed if one.sense]:
        raise ValueError(
            f"impose is for invariants, and {one_sided[0]!r} has no value at a single point: leave it out; "
            "sol.residual and plot_drift tell where it rises"
        )
    if points.shape[1] == 0:
        empty = np.zeros(0, dtype=int)
        return ImposeResult(points, empty.astype(bool), np.zeros((0, 0)), empty)
    _, threshold, _ = tolerances(rtol, atol, points[:, 0])
    bound = bind(listed, float(times[0]), points[:, 0], extra, threshold)
    if value is not None:
        demanded = _values(value)
        if len(demanded) not in (1, len(bound)):
            raise ValueError(f"value must have shape ({len(bound)},), as the invariants have, got {shown(value)}")
        bound = replace(bound, value=demanded + np.zeros(len(bound)))
    result = bound.impose(times, points, rtol, atol)
    if dense is not None:
        return replace(result, sol=ImposedDense(dense, bound, rtol, atol))
    if np.ndim(y) == 2:
        return result
    return ImposeResult(result.y[:, 0], bool(result.converged[0]), result.residual[:, 0], int(result.iterations[0]))


def _points(t: Any, y: ArrayLike) -> tuple[Array, Array]:
    """Points as (n, n_t), times as (n_t,)."""
    given = numbers("y", y)
    if given.ndim not in (1, 2) or len(given) == 0:
        raise ValueError(f"y must have shape (n,) or (n, n_t) with n >= 1, got {given.shape}")
    points = given[:, None] if given.ndim == 1 else given
    times = real_numbers("t", t)
    if times.shape not in ((), (points.shape[1],)):
        raise ValueError(f"t must have one time per point, shape ({points.shape[1]},), got {times.shape}")
    if not all(math.isfinite(one) for one in times.ravel()):
        raise ValueError("t must be finite")
    return points, np.broadcast_to(times, (points.shape[1],)).copy()
