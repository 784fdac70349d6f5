"""Does a solution satisfy the equations as they were given, and if it could not be continued, why?"""

from __future__ import annotations

from itertools import islice

import numpy as np

from .._base.arguments import Array
from .._base.failures import InvariantError
from .._functions.graph.rounding import bounds
from .._problem.breakpoints import to_breakpoints
from .._results.solution import Solution
from .consistent_start import ConsistentPoint, conditions
from .dae_solution import Unknowns
from .expressions import Values
from .linear_systems import orientations
from .reduction import Reduction

#: Residuals are compared with changes of F where its arguments change by this part, times random numbers: even if
#: leading derivatives have lost half of the digits, they are smaller.
_CHANGE, _SEED, _TIMES = 1e-7, 5, 4
#: Algebraic equations are solved to the tolerance only, by iterations that leave some of it, which the condition of
#: their block enlarges: in units of rtol. A choice, not derived; the nonlinear resistor of the tests needs the most.
_TOLERANCES = 100.0
#: Arguments below this part of their largest value along the solution change as one of that size.
_SMALL = 1e-5
#: A function of t jumps if its change over a close interval, a tenth of this fraction of the time or less, is more than
#: this part of its change over a wide one, the whole fraction, and more than this many times its roundoff.
_NEAR, _STAYS, _ROUNDOFFS = 1e-7, 0.5, 64.0
#: A block of J that is this much closer to singular than at the start has become singular.
_SINGULAR = 1e-5


@np.errstate(invalid="ignore")  # unknowns may be infinite where the equations no longer determine them
def violation(sol: Solution, unknowns: Unknowns, reduction: Reduction, p: Array) -> str:
    """Return which of the given equations an output violates, with all derivatives of the reduced problem; or ''."""
    if not len(sol.t):
        return ""
    change = _CHANGE if not reduction.algebraic else max(_CHANGE, _TOLERANCES * float(np.max(sol._rtol)))
    arguments = unknowns.arguments(sol.t, sol.y, p)
    amounts = change * _sizes(arguments, unknowns, reduction)
    residuals = unknowns.equations(sol.t, arguments, p)
    allowed = np.zeros_like(residuals)
    rng = np.random.default_rng(_SEED)
    for _ in range(_TIMES):
        moved = arguments + amounts * rng.standard_normal(amounts.shape)
        allowed = np.fmax(allowed, np.abs(unknowns.equations(sol.t, moved, p) - residuals))
    off = np.abs(residuals) > allowed + np.finfo(float).tiny
    for k in np.flatnonzero(off.any(axis=0)).tolist():  # roundoff of terms that cancel can be larger than `allowed`
        state, at = sol.y[:, k], float(sol.t[k])
        errors = np.array(bounds(unknowns.arguments.nodes, at, state.tolist(), p.tolist()))
        for _ in range(_TIMES):
            moved = arguments[:, k : k + 1] + (amounts[:, k] + errors)[:, None] * rng.standard_normal((len(errors), 1))
            by = np.abs(unknowns.equations(sol.t[k : k + 1], moved, p)[:, 0] - residuals[:, k])
            allowed[:, k] = np.where(np.isnan(by), np.inf, np.maximum(allowed[:, k], by))
        off[:, k] = np.abs(residuals[:, k]) > allowed[:, k]
    if not off.any():
        return ""
    i, k = divmod(int(np.argmax(np.where(off, np.abs(residuals) / np.maximum(allowed, 1e-300), 0))), off.shape[1])
    name = reduction.structure.names[i]
    return (
        f"The solution does not satisfy the equations: {name} is {residuals[i, k]:.3g} at t = {sol.t[k]:.6g}, and "
        f"errors of {change:.0e} in its arguments explain {allowed[i, k]:.3g}. The structure of the equations may "
        "change along the solution, as where an expression that was constant near the start no longer is: start the "
        "analysis elsewhere, or rewrite them."
    )


def _sizes(arguments: Array, unknowns: Unknowns, reduction: Reduction) -> Array:
    """Return the sizes of the arguments of F. The x_j^(d_j) of a block solve one linear system: errors of each are
    relative to the largest of them."""
    sizes = np.abs(arguments)
    _, d, _ = reduction.arrangement.offsets
    places: dict[int, list[int]] = {}
    for k, (order, j) in enumerate(unknowns.variables):
        if order >= d[j]:
            places.setdefault(j, []).append(k)
    for block in reduction.arrangement.blocks:
        leading = [k for j in block.columns for k in places.get(j, ())]
        if leading:
            sizes[leading] = sizes[leading].max(axis=0)
    found: Array = np.maximum(sizes, _SMALL * np.nanmax(sizes, axis=1, keepdims=True, initial=0))
    return found


def jump(sol: Solution, reduction: Reduction, p: Array) -> str:
    """Return the message for a run that ended where a constraint jumps with t; '' if none does."""
    if sol._origin is None or not len(sol.t):
        return ""
    end, state = float(sol.t_end), np.asarray(sol._run.y)
    near = _NEAR * max(abs(end), abs(end - float(sol.t[0])))
    wide, close = ((end - part, end + part) for part in (near, near / 10))
    if (found := _jumping(reduction, end, state, p, wide, close)) is None:
        return ""
    name, size = found
    return (
        f"The run could not be continued at t = {end:.10g}: the constraint {name} = 0 jumps there by {size:.3g}, which "
        "takes an impulse, and the equations do not say how it is shared. Make the prescribed function smooth enough, "
        "or end the run there and start another one from the values after the jump."
    )


def require_no_jump(reduction: Reduction, span: tuple[float, float], state: Array, p: Array) -> None:
    """Raise an InvariantError if a constraint jumps right after the start."""
    t0, later = span[0], float(np.nextafter(*span))
    found = _jumping(reduction, t0, state, p, (t0, t0 + _NEAR * (span[1] - t0)), (t0, later))
    if found is not None:
        name, size = found
        raise InvariantError(
            f"the constraint {name} = 0 jumps by {size:.3g} right after the start, t = {t0:.10g}: write its condition "
            "so that the value at t0 is the one after it, such as t >= 0 in place of t > 0, or start elsewhere"
        )


def _jumping(
    reduction: Reduction, t: float, state: Array, p: Array, wide: tuple[float, float], close: tuple[float, float]
) -> tuple[str, float] | None:
    """Return the first constraint that jumps at t, and by how much, from its changes over two intervals."""
    for level in reduction.levels:
        values = Values(level.in_states)
        over_wide, over_close = (np.abs(values(b, state, p) - values(a, state, p)) for a, b in (wide, close))
        errors = np.array(bounds(level.in_states, t, state.tolist(), p.tolist()))
        noise = _ROUNDOFFS * np.where(np.isfinite(errors), errors, 0)
        found = np.flatnonzero((over_close > _STAYS * over_wide) & (over_close > noise))
        if len(found):
            return level.names[found[0]], float(over_close[found[0]])
    return None


def point_of(reduction: Reduction, t: float, state: Array, p: Array) -> ConsistentPoint:
    """Return the x_j^(l), l <= d_j, at a state."""
    n, d = reduction.n, reduction.arrangement.offsets.d
    variables = [(order, j) for j in range(n) for order in range(int(d[j]) + 1)]
    values = Values(reduction.of(variables))(t, state, p)
    x = np.zeros((int(d.max(initial=0)) + 1, n))
    for (order, j), value in zip(variables, values, strict=True):
        x[order, j] = value
    return ConsistentPoint(t, x, p)


def impasse(sol: Solution, reduction: Reduction, p: Array) -> str:
    """Return why a run could not go on, if the equations no longer determine an unknown where it ended; else ''."""
    if sol._origin is None or not len(sol.t):
        return ""
    now = conditions(reduction, point_of(reduction, float(sol.t_end), np.asarray(sol._run.y), p))
    at_start = conditions(reduction, point_of(reduction, float(sol.t[0]), sol.y[:, 0], p))
    for one, before in zip(now, at_start, strict=True):
        if one.is_singular or not one.quality > _SINGULAR * before.quality:
            return (
                f"The run could not be continued at t = {sol.t_end:.10g}: {one.in_words('no longer ')}. The "
                "solution ends there (an impasse point), or passes a singular position: stop before it with a "
                "terminal event, or start after it."
            )
    return ""


def passage(sol: Solution, unknowns: Unknowns, reduction: Reduction, p: Array) -> str:
    """Return where the equations lost an unknown on the way, and which; else ''.

    The determinant of a block of J is continuous along a solution, but for jumps of the state and for branches: where
    its sign differs at two outputs J was singular between them. The first and the last state count as outputs.
    """
    if not unknowns.rests.nodes or not len(sol.t):
        return ""
    problem, jumps = sol._source.problem, _jumps(sol)
    times = np.array([problem.t_span[0], *sol.t, sol.t_end])
    states = np.column_stack([problem.y0, sol.y, sol._run.y])
    values = iter(unknowns.rests(times, states, p))
    for block, rest in reduction.rests:
        rows, columns = np.array([(i, j) for i, row in enumerate(rest) for j in row]).T
        signs = orientations(rows, columns, np.array(list(islice(values, len(rows)))), len(rest))
        for k in np.flatnonzero(signs[1:] * signs[:-1] < 0).tolist():
            if any(times[k] <= t <= times[k + 1] or times[k + 1] <= t <= times[k] for t in jumps):
                continue
            ends = [conditions(reduction, point_of(reduction, times[e], states[:, e], p)) for e in (k, k + 1)]
            before, after = (next(one for one in found if one.block is block) for found in ends)
            if not before.is_singular and not after.is_singular:
                return (
                    f"{after.lost(before)} between t = {times[k]:.6g} and {times[k + 1]:.6g}. Several solutions may "
                    "pass there, and the run continues with one of them: check it, or stop before with a terminal "
                    "event"
                )
    return ""


def _jumps(sol: Solution) -> list[float]:
    """Return the times at which actions may have changed the state."""
    source = sol._source
    points = to_breakpoints("breakpoints", source.options.get("breakpoints") or [])
    events = zip(source.problem.events or (), sol.t_events or (), strict=False)
    at_events = [float(t) for event, times in events if event.action is not None for t in times]
    return at_events + [one.t for one in points if one.action is not None]
