"""The landings of a run: where its f changes its branch as a function of t alone, and what sensitivities do there.

At a landing τ(p) the solution goes on and y' jumps, hence S⁺ = S⁻ + (f⁻ − f⁺) ∂τ/∂p.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._base.arguments import Array, reals, warn
from .._functions.compiled import CompiledFunction, Part
from .._functions.forms import Filling
from .._functions.graph import plain
from .._functions.graph.derived import derived
from .._functions.graph.function import OnGraph
from .._functions.graph.nodes import Graph, Node, in_order
from .._functions.graph.python import Formula
from .._functions.graph.switching_times import Crossing, Landings, landings, rates_of_time, timed
from .._functions.graph.tables import looked_up
from .._functions.layout import ArgumentLayout, Numbers, layout_of, place_of
from .._functions.second_order import SecondOrder
from .._problem.inputs import Input
from .._problem.invariants import AccuracyWarning
from .._problem.parameters import ParameterName
from .._problem.problem import Problem

if TYPE_CHECKING:
    from .actions import Rate

#: On which side of a landing f is evaluated: so many ulp from it, as far as no step leads.
_BESIDE = 16.0
#: Relative differences of derivatives of times that are roundoff.
_ALIKE = 1e-9


class Schedule(NamedTuple):
    """The landings of a problem."""

    landings: Landings  # times of the landings, as functions of the numbers of the arguments
    p: Array  # the numbers of the arguments, of which its graph is a function

    @property
    def depends_on_args(self) -> bool:
        """True if the times depend on the arguments of f."""
        return bool(self.landings.parameters())


def schedule_of(problem: Problem, parameters: ArgumentLayout, graph: Sequence[Node] | None = None) -> Schedule | None:
    """The landings of a problem, of f and of its invariants, or None without any. Conditions that change too often, or
    in a way that is not understood, are left out, with a warning.

    - `problem`: the problem
    - `parameters`: parameters of the problem's native functions
    - `graph`: graph of f, if f has been traced for its derivatives
    """
    if problem.delays is not None and problem.y0.dtype.kind == "c":
        return None
    found = _conditions(problem, parameters) if graph is None else timed(*_fed(graph, problem))
    found = found + _of_invariants(problem)
    if not found:
        return None
    p = layout_of(problem.args).numbers
    made = landings(found, p, *problem.t_span)
    if made.left_out and np.isfinite(problem.t_span).all():  # otherwise the run has no end yet
        why = next(iter(made.left_out.values()))
        warn(
            f"steps do not end where a condition of fun changes: {why}. They may pass over such times: write the "
            "condition as one of t, of t % period, or of a line or a sine of t; or pass breakpoints",
            AccuracyWarning,
        )
    return Schedule(made, p)


def switches_in_time(problem: Problem) -> bool:
    """Return whether a Python f that may switch has landings."""
    is_complex = problem.y0.dtype.kind == "c"
    made = plain.plain_graph(problem.fun, reals(problem.y0), layout_of(problem.args), is_complex=is_complex)
    return made is not None and bool(made.timed)


def reads_time(problem: Problem) -> bool:
    """Return whether f may depend on t other than by way of y. If it does not, no pulse comes with time alone."""
    if problem.inputs or problem.delays is not None:
        return True
    fun = _python(problem)
    if isinstance(fun, Formula):
        return any(node.op == "t" for node in in_order(fun.outputs))
    return plain.use_of_time(fun) != "none"


def _conditions(problem: Problem, parameters: ArgumentLayout) -> list[Crossing]:
    """The conditions of f that depend on t alone."""
    n = reals(problem.y0)
    if parts := getattr(problem.fun, "parts", ()):
        return [one for part in parts for one in _of_part(part, problem)]
    fun = problem.slope.fun if not isinstance(problem.fun, SecondOrder) else problem.fun
    inside = getattr(fun, "fun", fun) if problem.inputs else fun
    if n and problem.delays is None and isinstance(inside, OnGraph):
        found = derived(fun, n, n, parameters)
        if found is None:
            return []
        return found.timed if not problem.inputs else timed(*_fed(found.outputs, problem))
    switches = n and plain.use_of_time(_python(problem), problem.args) == "switches"
    made = graph_of_python(problem) if switches else None
    if made is None:
        return []
    if problem.delays is not None:
        return timed(of_past(made.outputs, problem.delays.count * n, n))
    return made.timed if not problem.inputs else timed(*_fed(made.outputs, problem))


def _of_part(part: Part, problem: Problem) -> list[Crossing]:
    """The conditions of a function of which f is made that depend on t alone."""
    fun, n, second, size = part
    if isinstance(fun, OnGraph):
        found = derived(fun, n, size, _arguments(problem), second)
        return [] if found is None else timed(*_fed(found.outputs, problem))
    python = _python_of(fun)
    if plain.use_of_time(python, problem.args) != "switches":
        return []
    made = plain.plain_graph(python, n, _arguments(problem, fun), size=size, second=second)
    return [] if made is None else timed(*_fed(made.outputs, problem))


def of_past(outputs: Sequence[Node], count: int, n: int) -> list[Node]:
    """The values with components of y beyond the n-th in the place of the first parameters, the delayed values."""
    from .._functions.graph.structure import replaced

    graph = outputs[0].graph
    places = sorted({node.value for node in in_order(outputs) if node.op == "p"})
    return replaced(outputs, {graph.p(i): graph.y(n + i) if i < count else graph.p(i - count) for i in places})


def _of_invariants(problem: Problem) -> list[Crossing]:
    """The conditions of invariants that have a graph, and that depend on t alone."""
    formulas = (getattr(one.fun, "fun", one.fun) for one in problem.invariants)
    return [one for fun in formulas if isinstance(fun, Formula) for one in timed(fun.outputs)]


def _python(problem: Problem) -> Any:
    """Return f as a Python function; None: it is machine code."""
    fun = problem.fun
    if isinstance(fun, SecondOrder):
        return None if fun.native else fun.first_order
    return _python_of(fun)


def _python_of(fun: Any) -> Any:
    if isinstance(fun, CompiledFunction):
        return Filling(fun.fun) if fun.inplace else fun.fun
    return fun


def _arguments(problem: Problem, fun: Any = None) -> ArgumentLayout:
    """Return the arguments of a function of a problem after t and y, of which inputs and delayed values are the
    first."""
    first = [Numbers(np.ones(one.values.shape[1:]), varying=True) for one in problem.inputs]
    if problem.delays is not None:
        first.append(Numbers(np.ones((problem.delays.count, reals(problem.y0))), varying=True))
    args = ArgumentLayout((*first, *layout_of(problem.args).entries))
    of_numba = isinstance(fun, CompiledFunction) and not isinstance(fun, OnGraph)
    return args.whole() if of_numba else args  # of all numbers in one array


def graph_of_python(problem: Problem) -> plain.PlainGraph | None:
    """Return the graph of a Python f, of which inputs and delayed values are the first parameters; None: it has
    none."""
    fun, n = _python(problem), reals(problem.y0)
    return plain.plain_graph(fun, n, _arguments(problem, problem.fun), is_complex=problem.y0.dtype.kind == "c")


def _fed(outputs: Sequence[Node], problem: Problem) -> tuple[list[Node], list[Node]]:
    """The graph with inputs as functions of t, and the nodes of their tables, of which `breakpoints` decides."""
    if not problem.inputs:
        return list(outputs), []
    before = {node.value for node in in_order(outputs) if node.op == "piece"}
    made = with_inputs(outputs, problem.inputs)
    return made, [node for node in in_order(made) if node.op == "piece" and node.value not in before]


def with_inputs(outputs: Sequence[Node], inputs: Sequence[Input]) -> list[Node]:
    """The values with polynomials in t in the place of the first parameters, the inputs."""
    if not inputs:
        return list(outputs)
    from .._functions.graph.structure import replaced

    graph = outputs[0].graph
    values = [value for one in inputs for value in _polynomials(one, graph)]
    places = sorted({node.value for node in in_order(outputs) if node.op == "p"})
    instead = {graph.p(i): values[i] if i < len(values) else graph.p(i - len(values)) for i in places}
    return replaced(outputs, instead)


def _polynomials(given: Input, graph: Graph) -> list[Node]:
    """The values of an input at t."""
    breaks, powers = given.pieces()
    t, inside = graph.t, breaks[1 : powers.shape[1]]
    since = t - looked_up(t, inside, breaks[: powers.shape[1]])
    found = []
    for column in np.moveaxis(powers, 2, 0):
        value = looked_up(t, inside, column[0])
        for row in column[1:]:
            value = value * since + looked_up(t, inside, row)
        found.append(value)
    return found


@dataclass
class LandingJump:
    """S after a landing whose time depends on parameters."""

    schedule: Schedule
    _places: Sequence[int | None]
    _rate: Rate
    _forward: float
    _warned: bool = False

    def __call__(self, t: float, Y: Array, after: Array) -> Array:
        y, S = Y[0], Y[1:]
        times = self.rates_of_time(t)
        if not times.any():
            return S
        f_before, f_after = self.sides(t, y)
        return np.asarray(S + np.outer(times, f_before - f_after))

    def sides(self, t: float, y: Array) -> tuple[Array, Array]:
        """y' before and after a landing."""
        beside = self._forward * _BESIDE * float(np.spacing(abs(t)))
        return self._rate(t - beside, y), self._rate(t + beside, y)

    def rates_of_time(self, t: float) -> Array:
        """∂τ/∂p of the landing at t, of shape (k,)."""
        found = [rates_of_time(one, self._places)(t, self.schedule.p) for one in self.schedule.landings.at(t)]
        if not found:
            return np.zeros(len(self._places))
        if any(not np.allclose(one, found[0], rtol=_ALIKE) for one in found) and not self._warned:
            self._warned = True
            warn(
                f"sensitivities: several conditions of fun change together at t = {t:.6g}, at times that differ for "
                "other parameters. Sensitivities are not reliable from there on: move one of the times a little",
                AccuracyWarning,
            )
        return found[0]


def landing_jump(
    schedule: Schedule | None, problem: Problem, names: Sequence[ParameterName], rate: Rate
) -> LandingJump | None:
    """Return the jump of sensitivities at landings; None if their times do not depend on the parameters."""
    if schedule is None or not schedule.landings:
        return None
    places = [None if one.kind != "args" else place_of(problem.args, one.index, one.item) for one in names]
    if schedule.landings.parameters().isdisjoint(place for place in places if place is not None):
        return None
    forward = 1.0 if problem.t_span[1] >= problem.t_span[0] else -1.0
    return LandingJump(schedule, places, rate, forward)
