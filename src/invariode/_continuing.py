"""Going on with a finished run: `Solution.extend`."""

from __future__ import annotations

import copy
import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from ._arguments import Array, number, output_times, unknown_option
from ._types import MethodName
from .events import terminal_count
from .invariants import BoundInvariants
from .solution import DenseSolution, Solution, Stats, Steps

if TYPE_CHECKING:
    from .problem import Problem

__all__ = ["Origin", "extend"]

#: The options that may differ from those of the run. With any other the parts would not be of one solution.
_ANEW = ("t_eval", "first_step", "max_step", "callback", "check", "progress")


@dataclasses.dataclass(eq=False)
class Origin:
    """What a solution was made from, and where it ended: what it takes to go on."""

    problem: Problem  # with the whole interval so far
    method: MethodName
    options: dict[str, Any]
    t: float
    y: Array
    next_h: float | None  # None: the method is to choose
    imposed: bool = False

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        return type(None), ()  # functions do not travel with a pickled solution

    def __deepcopy__(self, memo: dict[int, Any]) -> Origin:
        return self

    @property
    def forward(self) -> float:
        """The direction of integration, 0 if there was nothing to integrate."""
        return float(np.sign(self.problem.t_span[1] - self.problem.t_span[0]))


def extend(old: Solution, t_end: float, options: dict[str, Any]) -> Solution:
    """See `Solution.extend`."""
    for name in options:
        if name not in _ANEW:
            raise _not_anew(name)
    origin = old._origin
    if origin is None:
        raise ValueError(
            "this solution comes from a file or a pickle, without the functions of its problem: it cannot be extended. "
            "Solve from its final state"
        )
    if not old.success:
        raise ValueError(f"a run that failed cannot be extended: {old.message}")
    tf = number("t_end", t_end)
    forward = origin.forward or float(np.sign(tf - origin.t))
    if not forward * (tf - origin.t) > 0:
        raise ValueError(f"t_end must be beyond the end of the run, t = {origin.t}, in its direction; got {t_end!r}")

    whole, rest = copy.copy(origin.problem), copy.copy(origin.problem)
    whole.t_span = origin.problem.t_span[0], tf
    rest.t_span, rest.y0 = (origin.t, tf), origin.y
    progress = options.pop("progress", False)
    given = {**origin.options, "first_step": None, **options}
    run_options = dict(given)
    if origin.options.get("t_eval") is not None or options.get("t_eval") is not None:
        run_options["t_eval"], given["t_eval"] = _times(origin, options.get("t_eval"), forward, tf)
    if run_options.get("max_step") is None:
        run_options["max_step"] = abs(whole.t_span[1] - whole.t_span[0]) / 10
    if run_options["first_step"] is None and origin.next_h is not None:
        run_options["first_step"] = min(origin.next_h, abs(tf - origin.t))

    plan = rest.plan(origin.method, **run_options)
    held = _last_values(old._invariants)
    plan.solver["value"], plan.bound = held, dataclasses.replace(plan.bound, value=held)
    happened = old.t_events or []
    seen = [_uncounted(len(t), terminal_count(event)) for t, event in zip(happened, rest.events, strict=True)]
    asleep = [bool(len(t) and t[-1] == origin.t) for t in happened]
    new = rest._run(plan, origin.method, given, progress, (seen, asleep))
    if origin.imposed:
        new = new.impose()
    assert new._origin is not None
    return _joined(old, new, dataclasses.replace(new._origin, problem=whole))


def _not_anew(name: str) -> TypeError:
    from .problem import OPTIONS

    if name not in OPTIONS:
        return unknown_option(name, _ANEW)
    return TypeError(
        f"{name} is that of the run: extend takes {', '.join(_ANEW)}. For other options solve from the final state"
    )


def _times(origin: Origin, t_eval: Any, forward: float, tf: float) -> tuple[Array, Array]:
    """The times of output that are left, or those given; and the same with those beyond tf, for a further extension."""
    if origin.options.get("t_eval") is None:
        raise ValueError("the run has output at its steps, so has its extension: t_eval is not possible")
    times = np.asarray(origin.options["t_eval"], dtype=float)
    beyond = times[forward * (times - tf) > 0]
    if t_eval is not None:
        now = output_times(t_eval, origin.t, tf)
    else:
        now = times[(forward * (times - origin.t) > 0) & (forward * (tf - times) >= 0)]
        if now.size == 0:
            raise ValueError(f"the run has output at t_eval, which has no times left up to t_end = {tf}: give t_eval")
    return now, np.concatenate([now, beyond])


def _last_values(bound: BoundInvariants) -> Array:
    """At what the invariants were held at the end of the run."""
    return bound.jumps[-1][2][: len(bound)] if bound.jumps else bound.value


def _uncounted(seen: int, terminal: int) -> int:
    """Occurrences that count towards the one that ends the run; one that did ends a count."""
    return seen % terminal if terminal else 0


def _joined(old: Solution, new: Solution, origin: Origin) -> Solution:
    """One solution of two parts, of which the second starts where the first ended."""
    kept = 0 if origin.options.get("save") == "end" else len(old.t)
    known = int(kept > 0 and len(new.t) > 0 and new.t[0] == old.t[-1])  # the start of the second is there already
    jumps = tuple((row + kept - known, t, value) for row, t, value in new._invariants.jumps)
    bound = dataclasses.replace(
        old._invariants, jumps=old._invariants.jumps + jumps, forward=origin.forward, evaluations=0
    )
    sol = None
    if old.sol is not None and new.sol is not None:
        sol = DenseSolution(old.sol._dense.joined(new.sol._dense), old.y.dtype, bound, old.sol._imposed)
    t_events = y_events = None
    if old.t_events is not None and new.t_events is not None and old.y_events is not None and new.y_events is not None:
        t_events = [np.concatenate(parts) for parts in zip(old.t_events, new.t_events, strict=True)]
        y_events = [np.concatenate(parts) for parts in zip(old.y_events, new.y_events, strict=True)]
    steps = None
    if old.steps is not None and new.steps is not None:
        steps = Steps(np.concatenate([old.steps._rows, new.steps._rows]))
    (residual, distance, correction), then = old._drift, new._drift
    return dataclasses.replace(
        new,
        t=np.concatenate([old.t[:kept], new.t[known:]]),
        y=np.concatenate([old.y[:, :kept], new.y[:, known:]], axis=1),
        sol=sol,
        t_events=t_events,
        y_events=y_events,
        nfev=old.nfev + new.nfev,
        njev=old.njev + new.njev,
        nlu=old.nlu + new.nlu,
        stats=_summed(old.stats, new.stats),
        steps=steps,
        _invariants=bound,
        _drift=(np.maximum(residual, then[0]), np.maximum(distance, then[1]), max(correction, then[2])),
        _origin=origin,
    )


def _summed(a: Stats, b: Stats) -> Stats:
    ways = {way for one in (a, b) if one.derivatives for way in one.derivatives.split(" and ")}
    counts = {name: a[name] + b[name] for name in a if name not in ("derivatives", "projected_start")}
    return Stats(**counts, derivatives=" and ".join(sorted(ways)) or None, projected_start=a.projected_start)
