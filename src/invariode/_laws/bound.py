"""Invariants bound to a problem: with values and Jacobians, as the core takes them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import (
    EPS,
    Array,
    Weights,
    as_array,
    call_name,
    distinct,
    real_numbers,
    reals,
    shown,
    weights_of,
)
from .._functions.compiled import (
    CompiledFunction,
    CoreFunction,
    as_python,
    complex_form,
    is_native,
    native_parameters,
    to_native,
)
from .._functions.derivatives import derived_unnoticed, way_of
from .._functions.graph.derived import derived
from .._functions.increments import complex_steps_fit
from .._functions.layout import NO_ARGUMENTS, ArgumentLayout, layout_of
from .._problem.core_problem import CoreProblem, InvariantSpec, VariationTerms
from .._problem.invariants import Invariants
from .jacobians import sparse_jacobian, takes_no_more, traced_jacobian

#: With when="needed", points closer to the manifold than this are left alone, in units of rtol.
_NEGLIGIBLE = 0.01


#: The most corrections in levels: they converge quadratically, and end when only roundoff is left.
_LEVEL_ITERATIONS = 10


#: Jacobians with this many columns, of which at most this part of the entries can differ from zero, are sparse: as
#: those of mechanical systems.
MANY_COLUMNS, _FEW_ENTRIES = 100, 0.1
_FULL: Sequence[int] = ()


class ValueJump(NamedTuple):
    """New values of invariants, from an action or from a breakpoint where they jump."""

    row: int  # of the output, the first at which they hold
    t: float
    value: Array


class Imposed(NamedTuple):
    """Points projected onto the invariants: the fields of an `ImposeResult`, for points in columns."""

    y: Array
    converged: Array
    residual: Array
    iterations: Array


@dataclass
class BoundInvariants:
    """Invariants together with the values they are held at and the arguments of their functions."""

    specs: Sequence[InvariantSpec]
    value: Array
    names: list[str]
    args: tuple[Any, ...]
    parameters: ArgumentLayout  # the same for native functions
    iterations: int | None
    negligible: float = 0.0
    evaluations: int = 0  # of the functions, so far

    tangents: Sequence[Any] = ()  # with sensitivities (t, Y) -> G S_j + g_pj of each spec
    jumps: tuple[ValueJump, ...] = ()
    forward: float = 1.0

    def __len__(self) -> int:
        return len(self.value)

    @property
    def demanded(self) -> list[bool]:
        """True if the value of each invariant was prescribed."""
        return [not spec.held for spec in self.specs for _ in range(spec.m)]

    @property
    def along_steps(self) -> bool:
        """True if corrections are along the stages of the steps."""
        return any(spec.along_steps for spec in self.specs)

    @property
    def senses(self) -> list[int]:
        """The sense of the invariant that each value belongs to."""
        return [spec.sense for spec in self.specs for _ in range(spec.m)]

    def varied(self, tangents: Sequence[Any]) -> BoundInvariants:
        """Return these invariants with their tangents, which may be machine code."""
        parameters = self.parameters if self.parameters.size else layout_of(self.args)
        return replace(self, tangents=tangents, parameters=parameters)

    def equalities(self) -> BoundInvariants:
        """Return only the invariants that keep their values, without inequalities."""
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

    def with_functions(self, invariants: Sequence[Invariants]) -> BoundInvariants:
        """Return these with the functions of other invariants of their kind."""
        specs = [
            spec._replace(fun=one.fun, jac=one.jac if callable(one.jac) else spec.jac)
            if not isinstance(spec.fun, _core.Native)
            else spec
            for spec, one in zip(self.specs, invariants, strict=True)
        ]
        return replace(self, specs=specs)

    @property
    def last_value(self) -> Array:
        """The values at which the invariants are held at the end of the run."""
        return self.jumps[-1].value[: len(self)] if self.jumps else self.value

    def jumped(self, jumps: Iterable[tuple[int, float, Array]]) -> BoundInvariants:
        """Return these invariants with the jumps of a run."""
        return replace(self, jumps=tuple(ValueJump(*jump) for jump in jumps))

    def pieces_of_output(self, size: int) -> Array:
        """Return for each of `size` points of the output the number of jumps before it."""
        return np.searchsorted([jump.row for jump in self.jumps], np.arange(size), side="right")

    def pieces_at(self, t: Array, side: Literal["left", "right"]) -> Array:
        """Return for each time t the number of jumps before it; `side`: which side of a jump at that time is meant."""
        times = self.forward * np.array([jump.t for jump in self.jumps])
        return np.searchsorted(times, self.forward * np.asarray(t), side=side)

    def _each(self, t: Array, pieces: Array | None) -> Iterator[tuple[Array, Array, Array]]:
        """The points of each piece, the times at which functions see them, and the values of invariants there."""
        if pieces is None or not self.jumps:
            yield np.arange(len(t)), t, self.value
            return
        t = self._within_pieces(t, pieces)
        for piece in np.unique(pieces):
            here = np.flatnonzero(pieces == piece)
            yield here, t[here], self.value if piece == 0 else self.jumps[piece - 1].value[: len(self)]

    def _within_pieces(self, t: Array, pieces: Array) -> Array:
        """Return the times t, where those of jumps are moved to the side of their piece, since the functions may jump
        too."""
        t = t.copy()
        for i, jump in enumerate(self.jumps):
            here = np.flatnonzero(t == jump.t)
            t[here] = np.nextafter(jump.t, np.where(pieces[here] > i, self.forward, -self.forward) * np.inf)
        return t

    def residual(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        """g(t, y) - value, of shape (m, n_t), at the points y (n, n_t); for one-sided functions, how far they have gone
        back from earlier points."""
        return self._violation(self.departure(t, y, pieces), pieces)

    def departure(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        """g(t, y) - value, also for one-sided functions."""
        residual = np.zeros((len(self.value), len(t)))
        if self.specs:
            for here, times, value in self._each(t, pieces):
                residual[:, here] = _core.residual(times, _as_rows(y[:, here]), self._problem_of(y, value)).T
        return residual

    def jumps_at(self, t: Array, y: Array) -> bool:
        """Return whether a function has two values at one of the times, for the same y."""
        if not self.specs or not len(t):
            return False
        before, after = (
            self.departure(np.nextafter(t, side), np.repeat(y[:, None], len(t), axis=1)) for side in (-np.inf, np.inf)
        )
        roundoff = 1e3 * EPS * (np.abs(before) + np.abs(after) + np.abs(self.value)[:, None])
        return bool((np.abs(after - before) > roundoff).any())

    def _violation(self, departure: Array, pieces: Array | None) -> Array:
        """`departure`; for one-sided functions the rise above the lowest point so far in the piece (or the fall)."""
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
        """Distances from the level sets, in units of rtol, of the same shape; for one-sided functions, those that
        correspond to `residual`."""
        distance = np.zeros((len(self.value), len(t)))
        weights = _weights(y, rtol, atol)
        for here, times, value in self._each(t, pieces):
            distance[:, here] = _core.distance(times, _as_rows(y[:, here]), self._problem_of(y, value), weights).T
        if not any(self.senses):
            return distance
        departure = self.departure(t, y, pieces)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.abs(self._violation(departure.copy(), pieces)) / np.abs(departure)
        share[departure == 0] = 0
        return distance * share

    def impose(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> Imposed:
        """Projects the points y (n, n_t)."""
        weights = _weights(y, rtol, atol)
        size = len(t)
        points, converged = y.copy(), np.zeros(size, dtype=bool)
        residual, iterations = np.zeros((len(self.value), size)), np.zeros(size, dtype=np.int64)
        for here, times, value in self._each(t, pieces):
            rows, done, left, spent = _core.impose(times, _as_rows(y[:, here]), self._problem_of(y, value), weights)
            points[:, here] = as_columns(rows, y.dtype)
            converged[here], residual[:, here], iterations[here] = done, left.T, spent
        return Imposed(points, converged, residual, iterations)

    def evaluate(self, dense: _core.Dense, t: Array) -> Array:
        """The rows of a continuous solution of the core at t, projected between the steps if the run does so."""
        problem = self._problem(dense.n, dense.complex, self.value, dense.parameters) if self.specs else None
        return dense.evaluate(t, problem)

    def alone(self, y: Array) -> CoreProblem | None:
        """Return the invariants of a state like y for the core; None: it has none to hold."""
        return self._problem_of(y, self.value) if self.specs else None

    def _problem_of(self, y: Array, value: Array) -> CoreProblem:
        return self._problem(reals(y), y.dtype.kind == "c", value)

    def _problem(self, n: int, is_complex: bool, value: Array, parameters: int = 0) -> CoreProblem:
        """The invariants alone, for the core; n: reals in a state. With `parameters` for states with as many
        sensitivities."""
        variations = None
        if parameters and self.specs:
            none = np.zeros((parameters, n))
            variations = VariationTerms(parameters, self.tangents[0], none, self.tangents)  # no slope is needed
        return CoreProblem(
            n, is_complex, None, self.args, self.parameters, invariants=self.specs, value=value, variations=variations
        )


def _weights(y: Array, rtol: ArrayLike, atol: ArrayLike) -> Weights:
    return weights_of(rtol, atol, y[:, 0] if y.shape[1] else np.ones(len(y), y.dtype))


def _as_rows(y: Array) -> Array:
    """Points y (n, n_t) in the layout of the core: one row of reals per point."""
    rows = np.ascontiguousarray(y.T)
    return rows.view(float) if rows.dtype.kind == "c" else rows


def as_columns(rows: Array, dtype: np.dtype[Any]) -> Array:
    """The reverse: (n, n_t), complex where the problem is."""
    return (rows.view(dtype) if dtype.kind == "c" else rows).T


_NO_VALUES = np.zeros(0)


def bind(
    invariants: Sequence[Invariants], t: float, y: Array, args: tuple[Any, ...], threshold: float | Array
) -> BoundInvariants:
    """Evaluates each invariant at (t, y): its size, the value it is held at if none is demanded, and whether it takes
    complex y. `threshold`: thr of the reals of y, the size below which a component gives no scale."""
    if not invariants:
        return BoundInvariants([], _NO_VALUES, [], args, NO_ARGUMENTS, None)
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
        if one.names is not None and len(one.names) not in (1, m):
            raise ValueError(f"invariant {name} returns {m} values and has {len(one.names)} names: {one.names}")
        choice = _JacobianChoice(one, name, fun, m, (t, y, args, p, threshold))
        kind, size, rows = choice.made()
        evaluations += choice.evaluations
        kind = to_native(f"the Jacobian of invariant {name}", kind, n, size, p)
        if y.dtype.kind != "c":
            fun, kind = one._in_core(len(y)) or (fun, kind)
        order = (one.level, _moves(one, name, y), *_metric_at(one, name, t, y, args, p))
        along = one.direction == "stages"
        specs.append(
            InvariantSpec(fun, kind, m, name, one.value is None, *order, one.sense, along, *rows, callable(one.jac))
        )
        values.append(at_start if one.value is None else np.broadcast_to(one.value, (m,)))
        indexed = [name] if m == 1 else [f"{name}[{i}]" for i in range(m)]
        names += one.names if one.names is not None and len(one.names) == m else indexed
    levelled = _in_levels(specs)
    _require_one_direction(specs, levelled)
    iterations = [one.iterations for one in invariants if one.iterations is not None]
    value = values[0] if len(values) == 1 else np.concatenate(values)
    negligible = _NEGLIGIBLE if all(one.when == "needed" or one.sense for one in invariants) else 0.0
    names, most = distinct(names), max(iterations, default=_LEVEL_ITERATIONS if levelled else None)
    return BoundInvariants(specs, value, names, args, p, most, negligible, evaluations)


#: Point (t, y), arguments, these for native functions, and the `threshold` of `bind`.
_Start: TypeAlias = tuple[float, Array, tuple[Any, ...], ArgumentLayout, float | Array]


class _JacobianChoice:
    """The choice of how the Jacobian of an invariant is formed. `evaluations`: of g, that it took."""

    def __init__(self, one: Invariants, name: str, fun: Any, m: int, start: _Start) -> None:
        self._one, self._name, self._fun, self._m, self._start = one, name, fun, m, start
        self.evaluations = 0

    def made(self) -> tuple[Any, int, tuple[Sequence[int], Sequence[int]]]:
        """Return the Jacobian, or its way in words, the number of its values, and the pattern of its rows."""
        one, m, (t, y, args, _, _) = self._one, self._m, self._start
        chosen: Any = one.jac if isinstance(one.jac, str) else None
        how, made = way_of(chosen, None if chosen else one.jac, traced=self._traced, at_complex=self._at_complex)
        if how == "given" and not is_native(made) and len(y) >= MANY_COLUMNS and y.dtype.kind != "c":
            sparse = sparse_jacobian(made, f"jac of {call_name(one.fun, 'g')}", t, y, args, m)
            if sparse is not None:
                return sparse, len(sparse.pattern[1]), sparse.pattern
        if how != "traced":
            made = made or chosen or "3-point", m * reals(y), (_FULL, _FULL)
        jacobian, size, rows = made
        return jacobian, size, rows

    def _traced(self) -> Any:
        """Return the exact Jacobian, if the expressions of g are known or follow from a trace; with the number of its
        values, and the pattern of its rows."""
        one, m, (t, y, args, p, _) = self._one, self._m, self._start
        n, python = len(y), not is_native(one.fun)
        if one.jac is not None or y.dtype.kind == "c":
            return None
        exact = derived(one.fun, n, m, p)
        traced = traced_jacobian(one.fun, m, t, y, args) if python and one._in_core(n) is None else None
        if traced is not None:
            exact, self.evaluations = derived_unnoticed(one.fun, n, m, args), 2
            if not args and takes_no_more(one.fun):
                traced = None  # machine code is as good as a function that takes arguments
        if exact is None:
            return None
        if n >= MANY_COLUMNS and exact.entries <= _FEW_ENTRIES * m * n:
            rows = exact.row_pattern
            return exact.by_rows() if traced is None else traced.by_rows(rows), exact.entries, rows
        return exact.dense() if traced is None else traced, m * n, (_FULL, _FULL)

    def _at_complex(self) -> Any:
        """Return the name of complex steps, if g takes complex y and they give its derivative."""
        one, name, (t, y, args, p, threshold) = self._one, self._name, self._start
        native, is_complex = is_native(one.fun), np.iscomplexobj(y)
        if is_complex and one.jac is not None:
            raise ValueError(f'invariant {name}: jac="complex-step" is for real problems, and y0 is complex')
        code = complex_form(self._fun) if native and not is_complex else None
        at_complex = one.fun if not native else None if code is None else as_python(self._fun, self._m, code)
        if at_complex is None and one.jac is not None:
            raise ValueError(
                f'invariant {name}: jac="complex-step" is not for native functions, which take real y, except those of '
                "invariode.compile that numba compiles for complex y"
            )
        if at_complex is None or one.jac is not None:
            return one.jac
        fits, spent = complex_steps_fit(
            partial(_values_at, at_complex, t, (p.numbers,) if native else args), y, threshold
        )
        self.evaluations += 0 if native else spent
        return "complex-step or 3-point" if fits else None


def values_at_start(
    bound: BoundInvariants,
    invariants: Sequence[Invariants],
    t: float,
    y: Array,
    args: tuple[Any, ...],
    threshold: float | Array,
) -> Array | None:
    """Return the values of Python invariants from another start, as `bind` finds them. None: these are not of the kind
    of the bound ones, or their evaluations would be counted otherwise."""
    values, evaluations = [], len(invariants)
    for one, spec in zip(invariants, bound.specs, strict=True):
        found = _evaluate(one, spec.name, t, y, args)
        if len(found) != spec.m:
            return None
        if one.jac is None and isinstance(spec.jac, str):
            fits, spent = complex_steps_fit(partial(_values_at, one.fun, t, args), y, threshold)
            evaluations += spent
            if fits != (spec.jac == "complex-step or 3-point"):
                return None
        values.append(found if one.value is None else np.broadcast_to(one.value, (spec.m,)))
    return np.concatenate(values) if evaluations == bound.evaluations else None


def _moves(one: Invariants, name: str, y: Array) -> Sequence[int]:
    """The reals of y that the correction of an invariant may move."""
    moves = one.moves or ()
    if moves and max(moves) >= len(y):
        raise ValueError(
            f"moves of invariant {name} must be indices of the {len(y)} components of y, got {shown(moves)}"
        )
    if y.dtype.kind != "c":
        return moves
    return [part for index in moves for part in (2 * index, 2 * index + 1)]


def _metric_at(
    one: Invariants, name: str, t: float, y: Array, args: tuple[Any, ...], p: ArgumentLayout
) -> tuple[Any, int]:
    """Return the metric of an invariant as the core takes it, and the number of its values."""
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
        verb = "must have shape" if constant else "returned another shape than"
        raise ValueError(f"{what} {verb} ({k},) or ({k}, {k}), since {k} components move; got {at_start.shape}")
    if constant:
        return np.ascontiguousarray(metric, dtype=float).ravel(), at_start.size
    return to_native(what, metric, len(y), at_start.size, p), at_start.size


def _in_levels(specs: Sequence[InvariantSpec]) -> bool:
    """Return whether the invariants have levels, in which all may move the same components in the same metric."""
    first: dict[int, InvariantSpec] = {}
    above = 1 + max((spec.level for spec in specs), default=0)
    for spec in specs:
        other = first.setdefault(spec.level, spec)
        if set(other.moves) != set(spec.moves):
            raise ValueError(
                f"invariants {other.name} and {spec.name} are both of level {spec.level} and may move different "
                f"components: give them one set of moves, or different levels, as level={above} to {spec.name}"
            )
        if not _same(other.metric, spec.metric) or (spec.metric is not None and [*other.moves] != [*spec.moves]):
            raise ValueError(
                f"invariants {other.name} and {spec.name} are both of level {spec.level} and have different metrics: "
                "give them one metric, with moves in one order, or different levels"
            )
    return any(spec.level or spec.moves or spec.metric is not None for spec in specs)


def _require_one_direction(specs: Sequence[InvariantSpec], levelled: bool) -> None:
    along = [spec for spec in specs if spec.along_steps]
    if not along:
        return
    if levelled:
        raise ValueError(
            f'direction="stages" of invariant {along[0].name} cannot be combined with level, moves or metric: the '
            'stages leave no freedom for these; leave them out, or use direction="gradient"'
        )
    if len(along) < len(specs):
        other = next(spec for spec in specs if not spec.along_steps)
        raise ValueError(
            f"invariants {along[0].name} and {other.name} have different directions, and one correction serves both: "
            "give both the same direction"
        )


def _same(a: Any, b: Any) -> bool:
    """Return whether two metrics are one."""
    return a is b or (isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and np.array_equal(a, b))


def _native_start(
    one: Invariants, name: str, t: float, y: Array, args: tuple[Any, ...], p: ArgumentLayout
) -> tuple[Any, Array]:
    """A native g as the core takes it, and its values at (t, y). Machine code cannot say how many there are, the
    Python function that it was made from can."""
    counts = [len(known) for known in (one.names, one.value) if known is not None]
    compiled = one.fun if isinstance(one.fun, CompiledFunction) else None
    if max(counts, default=1) == 1 and compiled is not None and not compiled.inplace:
        if error := compiled.index_error(f"invariant {name}", t, y, p):
            raise error
        counts = [np.size(compiled.value_at(t, y, p))]
    if not counts:
        raise ValueError(f"invariant {name} is compiled: pass value= or names= so that its number of values is known")
    m = max(counts)
    fun = to_native(f"invariant {name}", one.fun, reals(y), m, p)
    alone = BoundInvariants([InvariantSpec(fun, "3-point", m, name, held=False)], np.zeros(m), [name], args, p, None)
    at_start = alone.residual(np.array([t]), y[:, None])[:, 0]
    if not all(map(math.isfinite, at_start.tolist())):
        if compiled is not None and (error := compiled.index_error(f"invariant {name}", t, y, p)):
            raise error
        raise ValueError(f"invariant {name} is not finite at t = {t}: {at_start}")
    return fun, at_start


def _values_at(fun: Callable[..., Any], t: float, args: tuple[Any, ...], y: Array) -> Any:
    """g as a function of y alone."""
    return fun(t, y, *args)


def _evaluate(one: Invariants, name: str, t: float, y: Array, args: tuple[Any, ...]) -> Array:
    returned = one.fun(t, y.copy(), *args)
    if type(returned) is float and math.isfinite(returned):  # the common case
        return np.array([returned])
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
