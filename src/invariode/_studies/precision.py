"""Work and precision: the cost of runs with all methods, plain and projected, and of projection at equal error."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import EPS, Array
from .._base.types import MethodName
from .._functions.graph.function import OnGraph
from .._laws.bound import BoundInvariants
from .._problem.grouped import Limits
from .._problem.methods import METHODS, Method
from .._problem.problem import Problem
from .._results.records import StiffnessWarning
from .._results.result import LIMIT_REACHED
from .._results.solution import Solution

#: With and without projection.
WAYS = ("plain", "projected")

#: Two solutions by different formulas give a reference and its accuracy, at the first of these rtol with which
#: both reach the end.
_EXPLICIT: tuple[tuple[MethodName, dict[str, Any]], ...] = (("dop853", {}), ("ode113", {}))
_IMPLICIT: tuple[tuple[MethodName, dict[str, Any]], ...] = (("ode15s", {}), ("ode15s", {"bdf": True}))
_TIGHT = (1e-12, 1e-11, 1e-10)

#: A run of the reference may take this many times the limit of the others.
_REFERENCE_FACTOR = 6

#: A problem is stiff if ode45 takes this many times the steps of ode15s, and this many more, at rtol 1e-3.
_STIFF, _FEW = 20, 1000

#: To be timed, runs are repeated up to this often, or until this many seconds are spent; the smallest time counts.
_REPEATS, _BUDGET = 10, 0.2

#: Errors below this many times the disagreement of the references say nothing.
_FLOOR = 3

#: Ratios of costs closer to 1 than this favour neither.
_MARGIN = 0.1


class NoReferenceError(Exception):
    """Error raised where no two methods agree on the final state."""


@dataclass(frozen=True)
class Reference:
    """The final state, how it was computed, and how far two methods disagree on it.

    Attributes
    ----------
    y, size : ndarray, (n,)
        The state, and the largest size of each component along the solution, by which errors are measured.
    by : str
        The methods and their tolerance.
    status : int
        0 for the end of the interval, 1 for a terminal event.
    agreement : float
        The error of the second solution if the first is right.
    lowest : ndarray, (n,), or None
        The least value of each component along the solution, where it is real and known.
    """

    y: Array
    size: Array
    by: str
    status: int
    agreement: float
    lowest: Array | None = None

    @property
    def floor(self) -> float:
        """Error below which errors are unknown."""
        return _FLOOR * max(self.agreement, EPS)

    def below_zero(self, y0: Array, lowest: Lowest, atol: float) -> BelowZero | None:
        """Return the component that becomes negative here but not along the solution, or None."""
        return None if self.lowest is None else below_zero(y0, lowest.values, self.lowest, atol)

    def error(self, y: Array) -> float:
        """Return the largest error of a component, relative to its largest size along the solution."""
        error = float((np.abs(y - self.y) / self.size).max(initial=0))
        return error if math.isfinite(error) else math.inf


@dataclass(frozen=True)
class Run:
    """A run of one method at one tolerance: error, evaluations of f (the invariants' tests too), of g and its Jacobian.

    `problem`: why there is no error, else None. `derivatives`: how the Jacobian was computed. `below_zero`: what the
    reference does not do. `off`: the distance of the final state from the level set of the invariants, in units of the
    components' largest sizes along the solution; None without invariants, and where events change their values.
    """

    error: float
    f: int
    g: int
    jacobians: int
    seconds: float
    problem: str | None = None
    message: str = ""
    derivatives: str | None = None
    below_zero: BelowZero | None = None
    off: float | None = None


@dataclass(frozen=True)
class ComparedMethod:
    """The runs of a method at one tolerance; `projected` is None if there is nothing to project."""

    method: str
    rtol: float
    plain: Run
    projected: Run | None

    def run(self, way: str) -> Run | None:
        return self.plain if way == "plain" else self.projected


def able(problem: Problem) -> list[Method]:
    """Return the methods that can solve the problem."""
    mass = problem.matrices.mass
    if mass is None:
        return [m for m in METHODS.values() if _takes(m, problem)]
    from scipy.sparse import csc_array  # takes longer to import than everything else

    from .._linear.linear_terms import null_basis

    regular = not callable(mass) and null_basis(csc_array(mass)).shape[1] == 0
    return [m for m in METHODS.values() if m.mass == "any" or (m.mass == "regular" and regular)]


def _takes(method: Method, problem: Problem) -> bool:
    """Return whether the method can integrate the problem's f."""
    if method.equations == "second-order":
        return problem.second_order and problem.bounds is None
    return method.equations == "any" or isinstance(problem.fun, OnGraph)


# ----------------------------------------------------------------------------------------------------------------------
# The reference


@contextmanager
def _stiffness_untold() -> Iterator[None]:
    """Ignore warnings of stiffness: explicit methods are tried on stiff problems on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StiffnessWarning)
        yield


def reference(problem: Problem, ratio: float, seconds: float) -> Reference:
    """Return the final state by two methods with stringent tolerances, without projection: Runge-Kutta and Adams; for
    stiff problems and those with a mass matrix NDF and BDF. `ratio` is atol / rtol."""
    plain = unprojected(problem)
    pairs = [_IMPLICIT] if problem.matrices.mass is not None or _stiff(plain, seconds) else [_EXPLICIT, _IMPLICIT]
    obstacles: list[str] = []
    for pair in pairs:
        for rtol in _TIGHT:
            found = []
            for name, options in pair:
                limit = _REFERENCE_FACTOR * seconds
                with _stiffness_untold():
                    sol = without_word(plain).solve(
                        name, rtol=rtol, atol=ratio * rtol, limits=Limits(time=limit), **options
                    )
                if sol.status not in (0, 1):
                    why = f"It takes longer than {limit:g} s (limit)." if sol.status == LIMIT_REACHED else sol.message
                    obstacles.append(f"{name}, rtol {power(rtol)}: {why}")
                    break
                found.append(sol)
            if len(found) == len(pair) and found[0].status == found[1].status:
                return _agreed(found[0], found[1], _names(pair, rtol))
            if not found:
                break  # tighter or looser, the first method cannot solve this problem
    first = obstacles[0] if obstacles else "They end at different events."
    raise NoReferenceError(f"No two methods reach the end with stringent tolerances. {first}")


def _stiff(problem: Problem, seconds: float) -> bool:
    implicit = without_word(problem).solve("ode15s", limits=Limits(time=seconds))
    if implicit.status not in (0, 1):
        return False
    steps = _STIFF * implicit.stats.steps + _FEW
    with _stiffness_untold():
        limits = Limits(steps=steps, time=seconds)
        return without_word(problem).solve("ode45", limits=limits, keep="end").status not in (0, 1)


def sizes_along(y: Array) -> Array:
    """Return the largest size of each component along a solution (n, n_t), of zeros that of all, (n,)."""
    size = np.abs(y).max(axis=1)
    size[size == 0] = size.max(initial=0) or 1.0
    return np.asarray(size)


def _agreed(first: Solution, second: Solution, by: str) -> Reference:
    size = sizes_along(first.y)
    found = Reference(first.y[:, -1], size, by, first.status, 0.0)
    lowest = None if np.iscomplexobj(first.y) else np.fmin(first.y.min(axis=1), second.y.min(axis=1))
    return Reference(found.y, size, by, first.status, found.error(second.y[:, -1]), lowest)


def _names(pair: Sequence[tuple[MethodName, dict[str, Any]]], rtol: float) -> str:
    return " and ".join(name + (" as BDF" if options else "") for name, options in pair) + f" at rtol {power(rtol)}"


# ----------------------------------------------------------------------------------------------------------------------
# The runs


def compare_runs(
    problem: Problem, methods: Sequence[str], rtols: Sequence[float], ratio: float, seconds: float, truth: Reference
) -> Iterator[ComparedMethod]:
    """Yield all runs, method by method, by names that `solve` takes, from the largest tolerance on. A method that takes
    too long is not run at smaller tolerances.

    Raises InvariantError if a run finds that f does not conserve an invariant.
    """
    plain = unprojected(problem)
    for method in methods:
        for rtol in rtols:
            options = {"method": method, "rtol": rtol, "atol": ratio * rtol, "keep": "end"}
            row = ComparedMethod(method, rtol, *_measured(problem, plain, options, seconds, truth))
            yield row
            if any(run is not None and run.problem == "too long" for run in (row.plain, row.projected)):
                break


def _measured(
    problem: Problem, plain: Problem, options: dict[str, Any], seconds: float, truth: Reference
) -> tuple[Run, Run | None]:
    """Run plain and projected in turn, so that disturbances of the machine affect both."""
    ways = [plain, problem] if problem.invariants else [plain]
    runs: list[tuple[Problem, Solution, float]] = []
    below: list[BelowZero | None] = []
    for way in ways:
        lowest = Lowest(way.y0)
        limited = {**options, "callback": lowest, "limits": Limits(time=seconds)}
        sol, spent = _timed(partial(without_word(way).solve, **limited))
        runs.append((way, sol, spent))
        below.append(None if sol.status == LIMIT_REACHED else truth.below_zero(way.y0, lowest, options["atol"]))
        if sol.status == LIMIT_REACHED:
            break
    times = [spent for _, _, spent in runs]
    repeats = min(_REPEATS, int(_BUDGET / max(sum(times), 1e-9)))
    if repeats:
        times = [math.inf] * len(runs)
    for _ in range(repeats):
        for i, (way, _, _) in enumerate(runs):
            times[i] = min(times[i], _timed(partial(without_word(way).solve, **options))[1])
    laws = runs[-1][1]._invariants.equalities()  # of the projected run, if it came to that
    measured = [
        _run(sol, time, truth, low, _off(laws, sol, truth))
        for (_, sol, _), time, low in zip(runs, times, below, strict=True)
    ]
    if len(measured) < len(ways):  # plain took too long
        measured.append(measured[0])
    return measured[0], measured[1] if problem.invariants else None


def _timed(solve: Callable[[], Solution]) -> tuple[Solution, float]:
    start = perf_counter()
    with _stiffness_untold():
        sol = solve()
    return sol, perf_counter() - start


def _off(laws: BoundInvariants, sol: Solution, truth: Reference) -> float | None:
    """Return how far the final state of a run is off the invariants, in units of the sizes of the components."""
    if not len(laws) or laws.jumps or sol.status not in (0, 1):
        return None
    end = np.array([sol.t_end])
    # With rtol = 1 the weights are the sizes: no component is larger along the solution.
    return float(laws.distance(end, sol.y_end[:, None], 1.0, truth.size).max(initial=0.0))


def _run(sol: Solution, seconds: float, truth: Reference, below: BelowZero | None, off: float | None) -> Run:
    problem, message = None, ""
    if sol.status == LIMIT_REACHED:
        problem = "too long"
    elif sol.status == -1:
        problem, message = "failed", sol.message
    elif sol.status != truth.status:
        problem = "no event" if truth.status else "event"
    error = math.inf if problem else truth.error(sol.y[:, -1])
    stats = sol.stats
    f = sol.nfev + stats.nfev_check
    return Run(error, f, stats.ng, stats.ngjac, seconds, problem, message, stats.derivatives, below, off)


# ----------------------------------------------------------------------------------------------------------------------
# Cost at equal error


class _CostCurve:
    """The cost of an error: interpolated, in logarithms, between the runs that no other run beats in both. Which errors
    have a cost, `least` to `largest`, depends on the errors of the runs alone, and not on times."""

    def __init__(self, runs: Sequence[Run], cost: str, floor: float) -> None:
        points = sorted((getattr(run, cost), max(run.error, floor)) for run in runs if math.isfinite(run.error))
        errors: list[float] = []
        costs: list[float] = []
        for price, error in points:
            if not errors or error < errors[-1]:
                errors.append(error)
                costs.append(max(price, 1e-9))
        self._errors, self._costs = np.log(errors[::-1]), np.log(costs[::-1])
        self.least, self.dearest = (errors[-1], costs[-1]) if errors else (math.inf, 0.0)
        self.largest = max((error for _, error in points), default=0.0)

    def __call__(self, error: float) -> float:
        """Return the cost of at most this error; infinite if no run has it."""
        if error < self.least * (1 - 1e-12):
            return math.inf
        return float(np.exp(np.interp(math.log(error), self._errors, self._costs)))


@dataclass(frozen=True)
class Judgement:
    """The cost of projection at equal error, projected / plain, at the powers of ten that both ways reach."""

    method: str  # its name, or '' for the best method each
    #: errors, time, f: the errors, from the largest on, and the ratios of costs there
    errors: list[float]
    time: list[float]
    f: list[float]
    by: list[tuple[str, str]] = field(default_factory=list)  # the methods compared at each error: plain, projected

    @property
    def kind(self) -> tuple[str, float | None]:
        """'worth it', 'not', 'even', 'mixed', or 'above' or 'below' an error, in time."""
        return judge(self.errors, self.time)


def judge(errors: Sequence[float], ratios: Sequence[float]) -> tuple[str, float | None]:
    """Return the verdict that ratios of costs support: one for all errors, or one that changes at an error, which is
    the last one for which projection is worth its cost."""
    signs = [(e, r < 1) for e, r in zip(errors, ratios, strict=True) if abs(math.log(r)) > -math.log(1 - _MARGIN)]
    if not errors:
        return "unknown", None
    if not signs:
        return "even", None
    pieces = [(worth, [e for e, _ in group]) for worth, group in groupby(signs, key=lambda sign: sign[1])]
    if len(pieces) == 1:
        return ("worth it" if pieces[0][0] else "not"), None
    if len(pieces) == 2:
        return ("above", pieces[0][1][-1]) if pieces[0][0] else ("below", pieces[1][1][0])
    return "mixed", None


def judgements(rows: Sequence[ComparedMethod], floor: float) -> list[Judgement]:
    """Judge each method, projected against plain."""
    found = []
    for method, group in groupby(rows, key=lambda row: row.method):
        own = list(group)
        time, f = (_curves(own, cost, floor) for cost in ("seconds", "f"))
        errors = _decades(max(c.least for c in time), min(c.largest for c in time))
        ratios = [[c[1](e) / c[0](e) for e in errors] for c in (time, f)]
        found.append(Judgement(method, errors, ratios[0], ratios[1]))
    return found


def best(rows: Sequence[ComparedMethod], floor: float) -> Judgement:
    """Compare, at each error, the cheapest methods that reach it, plain and projected.

    Errors are left out that a method which is cheaper so far might reach with a tighter tolerance than those tried.
    """
    by_method = {method: list(group) for method, group in groupby(rows, key=lambda row: row.method)}
    time, f = ({m: _curves(own, cost, floor) for m, own in by_method.items()} for cost in ("seconds", "f"))
    least = max(min(c[way].least for c in time.values()) for way in (0, 1))
    largest = min(max(c[way].largest for c in time.values()) for way in (0, 1))
    found = Judgement("", [], [], [])
    for error in _decades(least, largest):
        (plain, by_plain), (projected, by_projected) = (_cheapest(time, way, error) for way in (0, 1))
        (plain_f, _), (projected_f, _) = (_cheapest(f, way, error) for way in (0, 1))
        if all(math.isfinite(cost) for cost in (plain, projected, plain_f, projected_f)):
            found.errors.append(error)
            found.time.append(projected / plain)
            found.f.append(projected_f / plain_f)
            found.by.append((by_plain, by_projected))
    return found


def _cheapest(curves: Mapping[str, tuple[_CostCurve, _CostCurve]], way: int, error: float) -> tuple[float, str]:
    """Return the least cost of the error and the method that has it; infinite if it may be another one's."""
    cost, method = min((c[way](error), method) for method, c in curves.items())
    open_ended = any(c[way].least > error and 0 < c[way].dearest < cost for c in curves.values())
    return (math.inf if open_ended else cost), method


def cheapest(rows: Sequence[ComparedMethod], floor: float) -> tuple[float, str, float] | None:
    """Return an error in the middle of those that plain runs reach, the method cheapest there, and its time; or
    None."""
    by_method = {method: list(group) for method, group in groupby(rows, key=lambda row: row.method)}
    curves = {method: _CostCurve([row.plain for row in own], "seconds", floor) for method, own in by_method.items()}
    errors = _decades(min(c.least for c in curves.values()), max(c.largest for c in curves.values()))
    if not errors:
        return None
    error = errors[len(errors) // 2]
    seconds, method = min((curve(error), method) for method, curve in curves.items())
    return error, method, seconds


def _curves(rows: Sequence[ComparedMethod], cost: str, floor: float) -> tuple[_CostCurve, _CostCurve]:
    return (
        _CostCurve([row.plain for row in rows], cost, floor),
        _CostCurve([row.projected for row in rows if row.projected is not None], cost, floor),
    )


def _decades(least: float, largest: float) -> list[float]:
    """Return the powers of ten between the two, the largest first; if no power lies between, their geometric mean."""
    if not 0 < least < largest < math.inf:
        return []
    powers = range(math.floor(math.log10(largest)), math.ceil(math.log10(least)) - 1, -1)
    return [10.0**k for k in powers] or [math.sqrt(least * largest)]


def unprojected(problem: Problem) -> Problem:
    """Return the problem without its invariants."""
    return problem.replace(invariants=None)


def power(error: float) -> str:
    """Return an error in one digit: 1e-4, not 1e-04."""
    return f"{error:.0e}".replace("e-0", "e-").replace("e+0", "e+")


#: Below zero by more than this, in units of atol, is more than the noise that a tolerance allows.
NOTABLE = 100


class BelowZero(NamedTuple):
    """The component that falls farthest below 0, in units of atol, and its smallest value."""

    component: int
    value: float

    def in_words(self, label: str) -> str:
        """Return a sentence about the component, with this label."""
        return f"{label} falls to {self.value:.1e}, where a more accurate solution stays above 0"


def without_word(problem: Problem) -> Problem:
    """Return the problem so that its runs do not warn of components below 0, which their caller reports."""
    return problem if problem.bounds is not None else problem.replace(nonnegative=False)


class Lowest:
    """A callback that records the minima of a real solution at its steps."""

    def __init__(self, y0: Array) -> None:
        self.values = y0.copy()

    def __call__(self, t: float, y: Array) -> bool:
        if y.dtype.kind != "c":
            np.fmin(self.values, y, out=self.values)
        return False


def below_zero(y0: Array, lowest: Array, accurate: Array, atol: ArrayLike) -> BelowZero | None:
    """Return the component that falls lowest, in units of atol, of those that fall below −100 atol although they start
    at or above zero and, to within atol, stay there in a more accurate solution; None if none does, or y0 is complex.
    `lowest`, `accurate`: the minima of both solutions, (n,).
    """
    if np.iscomplexobj(y0) or not len(y0):
        return None
    depth = np.where((y0 >= 0) & (accurate >= -np.asarray(atol)) & (lowest < -NOTABLE * np.asarray(atol)), -lowest, 0.0)
    deepest = int(np.argmax(depth / np.maximum(atol, np.finfo(float).tiny)))
    return BelowZero(deepest, float(lowest[deepest])) if depth[deepest] > 0 else None
