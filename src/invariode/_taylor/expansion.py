"""Taylor series of the solution of a problem, and of its events along it, as the core takes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import _core
from .._base.arguments import reals, warn
from .._base.package import extra
from .._functions.compile import compile
from .._functions.compiled import CompiledFunction, CoreFunction, is_native
from .._functions.graph.derived import derived
from .._functions.graph.function import OnGraph, TracedFunction
from .._functions.graph.kinks import is_analytic, kinks
from .._functions.graph.nodes import Node
from .._functions.layout import ArgumentLayout, Shape, layout_of
from .._functions.second_order import SecondOrder
from .._problem.bounds import Bounds
from .._problem.core_problem import EventSpec
from .._problem.events import Event, RootOf
from .._problem.methods import Method
from .._problem.problem import Problem
from .._sensitivity.landings import with_inputs
from .._sensitivity.variations import Variations

if TYPE_CHECKING:
    from .._functions.graph.objects import MachineCode, SeriesForm

#: With more conditions than this at which f changes its branch, steps do not end there.
_MOST_CONDITIONS = 64
#: Costs of a step besides its coefficients, of an order, and of a product in it, in nanoseconds of one processor: their
#: ratios count. The margin of the step's length in the core.
_STEP, _ORDER, _PRODUCT, _MARGIN = 90.0, 3.5, 0.1, 0.7
#: The order is raised by two as long as this part of the cost is saved: the errors of longer steps are somewhat larger.
_GAIN = 0.1
#: What takes any f.
_INSTEAD = "use method='dop853' or 'ode89', which take any function"


def order_of(method: Method, rtol: float, given: int | None, sums: float) -> int:
    """The order of the series: the one given, or that of the least work for coefficients, with steps of 1/e² of the
    radius of convergence (Jorba and Zou 2005); a higher one where what surrounds the coefficients, `sums` sums of
    products in each order, costs more than they do."""
    if given is not None:
        return given

    def cost(p: int) -> float:
        """Return the estimated cost per unit of t at order p."""
        return (_STEP + _ORDER * p + _PRODUCT * sums * p * p / 2) / math.exp((math.log(rtol) - _MARGIN) / (p - 1))

    order = min(max(math.ceil(1 - math.log(rtol) / 2), method.min_order), method.order)
    while order + 2 <= method.order and cost(order + 2) < (1 - _GAIN) * cost(order):
        order += 2
    return order


# ----------------------------------------------------------------------------------------------------------------------
# Functions as graphs


def on_graph(problem: Problem, method: Method) -> Problem:
    """The problem with f, and events if they can be, as functions that are compiled from their graphs.

    Raises TypeError: f is machine code, or belongs to the core.
    Raises ValueError: There are no components.
    Raises ModuleNotFoundError: The compiler of graphs is not installed.
    """
    extra("llvmlite", f"method={method.name!r} needs", "compiled")
    events = [_on_graph(event, problem) for event in problem.events] if problem.records_events else None
    found = problem.replace(fun=_traceable(problem.fun, method), events=events)
    _require_graph(found, method)
    return found


def _require_graph(problem: Problem, method: Method) -> None:
    """Raise an error unless f can be traced."""
    n = reals(problem.y0)
    needs = f"method={method.name!r} needs the expression graph of fun"
    if n == 0:
        raise ValueError(f"{needs}, and y0 is empty: {_INSTEAD}")
    try:
        found = derived(problem.slope.fun, n, n, layout_of(problem.args))
    except TypeError as error:
        why = str(error).removesuffix(', or leave by="trace" out').removesuffix(". Change that")
        raise TypeError(f"{needs}: {why}. Change that, or {_INSTEAD}") from None
    if found is None:
        raise TypeError(f"{needs}, and it was compiled by {problem.fun.how}: {_INSTEAD}")


def _traceable(fun: Any, method: Method) -> Any:
    needs = f"method={method.name!r} needs the expression graph of fun, "
    if isinstance(fun, OnGraph):
        return fun
    if isinstance(fun, SecondOrder) and not fun.native:
        return compile(fun, by="trace")
    if isinstance(fun, CoreFunction) and not isinstance(fun, SecondOrder):
        raise TypeError(
            f"{needs}and the equations of a MechanicalSystem, which the core forms, have none: {_INSTEAD}, or "
            "write the equations with invariode.symbolic"
        )
    if is_native(fun) and not isinstance(fun, CompiledFunction):
        raise TypeError(f"{needs}and machine code has none: give the Python function, or {_INSTEAD}")
    if isinstance(fun, CompiledFunction):  # by numba
        return TracedFunction(fun.fun, fun.inplace, "own", "trace")
    return compile(fun, by="trace")


def _on_graph(event: Event, problem: Problem) -> Event:
    """Return the event with a traced function if that is possible, else the event."""
    if is_native(event.fun) or isinstance(event, RootOf) or problem.y0.dtype.kind == "c":
        return event
    traced = compile(event.fun, by="trace")
    try:
        _graph_of_event(traced, problem)
    except TypeError:
        return event
    return event.replaced(traced)


def _graph_of_event(fun: Any, problem: Problem) -> list[Node] | None:
    """Return the nodes of an event's value, a function of (t, y) and the parameters of native functions; None without a
    graph."""
    if not isinstance(fun, OnGraph):
        return None
    shape = fun.known(Shape(len(problem.y0), 1, layout_of(problem.args), event=True))
    return fun.graph(shape)


class SeriesSystem(NamedTuple):
    """f of a problem as a graph."""

    outputs: list[Node]  # its values, of t, y and the parameters of native functions; inputs are polynomials in t
    #: Functions whose sign changes where f changes its branch, if that depends on y; none if there are too many
    conditions: list[Node]
    own: bool  # invariode's elementary functions are called, not the mathematical library's


def system_of(problem: Problem, parameters: ArgumentLayout, unknown: Iterable[Node] = ()) -> SeriesSystem:
    """The graph of f, which is known to have one. `unknown`: branches that change with t alone, and not where landings
    are."""
    n = reals(problem.y0)
    found = derived(problem.slope.fun, n, n, parameters)
    assert found is not None
    outputs = with_inputs(found.outputs, problem.inputs)
    differences = kinks(outputs, unknown)
    conditions = differences if len(differences) <= _MOST_CONDITIONS else []
    return SeriesSystem(outputs, conditions, found.elementary == "own")


# ----------------------------------------------------------------------------------------------------------------------
# Series for the core


class Expansion(NamedTuple):
    """Taylor series that the core expands."""

    series: _core.Series  # series of the solution, and of its sensitivities
    #: Series along the solution of the functions whose sign changes where f changes its branch: a step ends there
    conditions: _core.Series | None
    condition_count: int  # number of the conditions
    events: list[EventSpec]  # events of the problem with their series
    problem: Problem  # the problem, with f and its events on their graphs
    outputs: list[Node]  # y' of the solution, and of its sensitivities
    form: SeriesForm  # form of the code of the series
    of_any_span: bool  # the expansion is the same on every interval: there are no bounds, which depend on the direction

    def for_core(self) -> dict[str, Any]:
        """Return the arguments of the core's problem that concern the series, without events."""
        return {"series": self.series, "conditions": self.conditions, "condition_count": self.condition_count}

    def in_lanes(self, lanes: int, make: bool) -> MachineCode | str:
        """Code for the series of this many solutions side by side, or the reason why it cannot be made."""
        from .._functions.graph.codes import lane_code

        return lane_code(self.outputs, self.form._replace(lanes=lanes), make=make)


def make_expansion(
    problem: Problem,
    system: SeriesSystem,
    order: Callable[[float], int],
    events: Sequence[EventSpec],
    varied: Variations | None,
) -> Expansion:
    """The series of a problem, whose events the core has in this form; after them are those of sensitivities. `order`
    says which order series have, by the number of their sums."""
    from .._functions.graph.recurrences import count_sums

    forward = 1.0 if problem.t_span[1] >= problem.t_span[0] else -1.0
    tangents = [] if varied is None else with_inputs(varied.tangent_nodes(), problem.inputs)
    outputs = _within_bounds(system.outputs, tangents, problem.bounds, forward)
    makes = _Maker(len(outputs), order(count_sums(outputs)), system.own)
    given = [
        makes.expanded(spec, _graph_of_event(event.fun, problem))
        for spec, event in zip(events, problem.events, strict=False)
    ]
    conditions = makes.series(system.conditions, along=True) if system.conditions else None
    return Expansion(
        series=makes.series(outputs, along=False),
        conditions=conditions,
        condition_count=len(system.conditions),
        events=[*given, *events[len(given) :]],
        problem=problem,
        outputs=outputs,
        form=makes.form(along=False),
        of_any_span=problem.bounds is None,
    )


class _Maker:
    """Series for the core, of a state with its sensitivities after it."""

    def __init__(self, size: int, order: int, own: bool) -> None:
        self._size, self._order, self._own = size, order, own

    def form(self, *, along: bool) -> SeriesForm:
        """Return the form of the code: its arguments and its results."""
        from .._functions.graph.objects import SeriesForm

        return SeriesForm(self._size, self._order, along, own=self._own)

    def series(self, outputs: Sequence[Node], *, along: bool) -> _core.Series:
        """Coefficients of the solution of y' = outputs, or of the outputs along a polynomial."""
        from .._functions.graph.codes import machine_code

        code = machine_code(outputs, self.form(along=along))
        return _core.Series(address=code.address, order=self._order, owner=code.owner)

    def expanded(self, spec: EventSpec, value: list[Node] | None) -> EventSpec:
        """An event with its series, if it has one."""
        if value is None or not is_analytic(value):
            if spec.touching:
                why = "has branches, such as abs" if value else "cannot be traced"
                warn(f"touching of event {spec.name} has no effect: its function {why}, and has no Taylor series")
            return spec
        return spec._replace(series=self.series(value, along=True))


def _within_bounds(
    outputs: Sequence[Node], tangents: Sequence[Node], bounds: Bounds | None, forward: float
) -> list[Node]:
    """f without what leads out of the bounds, and the slopes of sensitivities, zero where a bound holds y."""
    if bounds is None:
        return [*outputs, *tangents]
    graph, n = outputs[0].graph, len(outputs)
    zero = graph.node(0.0)
    found = [*outputs, *tangents]

    def hold(i: int, at_bound: Node, outward: Node) -> None:
        for place in range(i, len(found), n):
            found[place] = graph.select(at_bound, graph.select(outward, zero, found[place]), found[place])

    for i, (f, lower, upper) in enumerate(zip(outputs, bounds.lower, bounds.upper, strict=True)):
        y, falls, rises = graph.y(i), graph.make("less", f, zero), graph.make("less", zero, f)
        downwards, upwards = (falls, rises) if forward > 0 else (rises, falls)
        if lower > -math.inf:
            hold(i, graph.make("less_equal", y, graph.node(lower)), downwards)
        if upper < math.inf:
            hold(i, graph.make("less_equal", graph.node(upper), y), upwards)
    return found
