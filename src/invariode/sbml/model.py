"""Models: SBML as problems, and their simulation."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import Array, interval, number, positive_integer
from .._base.forks import cached_property
from .._base.latest import Latest
from .._base.package import extra
from .._base.rational import as_rows
from .._base.suggestions import meant
from .._base.types import MethodName
from .._functions.derivatives import has_llvm
from .._functions.graph.array_code import ArrayFunction
from .._functions.graph.function import GraphFunction
from .._functions.graph.nodes import Node, in_order
from .._functions.graph.python import Formula
from .._functions.graph.structure import replaced
from .._problem.delays import GraphOfPast
from .._problem.invariants import Invariants
from .._problem.methods import METHODS
from .._problem.options import TABLE
from .._problem.problem import Problem
from .._results.solution import Solution
from .._solve.prepared_solver import PreparedSolver
from .equations import FAST, ModelEquations, used
from .event_machine import SAME_TIME, EventCode, Machine, is_clock, times_of_roots
from .past import with_past_as_states
from .reading import ModelContents


class Table(Mapping[str, Array]):
    """Values over time by column name, as ``Model.simulate`` returns them.

    Attributes
    ----------
    columns : list of str
        The names.
    array : ndarray of shape (points, columns)
        The numbers; ``np.asarray(table)`` is the same.
    """

    def __init__(self, columns: Sequence[str], array: Array) -> None:
        self.columns, self.array = list(columns), array

    def __getitem__(self, name: str) -> Array:
        if name not in self.columns:
            raise KeyError(
                f"there is no column {name!r}{meant(name, self.columns)}: there are {', '.join(self.columns)}"
            )
        column: Array = self.array[:, self.columns.index(name)]
        return column

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.array, dtype=dtype) if copy or dtype is not None else self.array

    def to_pandas(self) -> Any:
        """Return a DataFrame. Needs pandas, of the extra `data`."""
        return extra("pandas", "a DataFrame needs", "data").DataFrame(self.array, columns=self.columns)

    def __repr__(self) -> str:
        return f"Table of {len(self.array)} points: {', '.join(self.columns)}"


#: Tolerances of simulations; the absolute one is smaller if all amounts are small.
_RTOL, _ATOL, _SMALL = 1e-8, 1e-12, 1e-12


@dataclass(frozen=True)
class ModelEvent:
    """An event of a model, in short.

    Attributes
    ----------
    name : str
        Its id.
    targets : tuple of str
        The symbols that it assigns.
    delayed, prioritised, persistent : bool
        Whether it has a delay, and a priority; whether it waits for its execution even when its trigger falls.
    """

    name: str
    targets: tuple[str, ...]
    delayed: bool
    prioritised: bool
    persistent: bool


def _symbol(name: str) -> str:
    """Return the symbol of a species' concentration, in brackets, or the name itself."""
    return name.strip("[]") if name.startswith("[") else name


class _InitialState:
    """The initial state of a problem as a function of its parameters, a record: after events at the start, and
    consistent with algebraic rules.

    - `formula`: the initial state as a formula of (t, y, p); None if events at the start or algebraic rules change it
    """

    def __init__(self, model: Model, t0: float, p: Array, machine: Machine | None) -> None:
        self._model, self._t0, self._p, self._machine = model, t0, p, machine

    def __call__(self, parameters: Any) -> Array:
        p = self._p.copy()
        own = np.array([*parameters], dtype=float)
        p[: len(own)] = own
        y = self._model._consistent(self._t0, self._model._equations.initial_state(self._solved(p)), p)
        if self._machine is None:
            return y
        return Machine(self._machine.code, self._machine.equations).start(self._t0, y, p)

    def _solved(self, p: Array) -> Array:
        """Return p with the numbers that algebraic rules determine at the start."""
        e = self._model._equations
        return e.parameters(dict(zip(e.names, p.tolist(), strict=False))) if e.matched else p

    @cached_property
    def formula(self) -> Formula | None:
        e = self._model._equations
        if e.matched or e.has_fast or not (self._machine is None or self._machine.begins_quietly):
            return None
        nodes = [e.state_at_start(name) for name in e.states]
        count = len(self._model._names)
        fixed = {e.graph.p(i): e.graph.node(self._p[i]) for i in used(nodes, "p") if i >= count}
        inside = replaced(nodes, fixed) if fixed else nodes
        return Formula("y0", lambda: inside, (len(nodes),))

    def __reduce__(self) -> tuple[Any, ...]:
        return _InitialState, (self._model, self._t0, self._p, self._machine)

    @property
    def varies(self) -> bool:
        """True if the initial state depends on the parameters."""
        e = self._model._equations
        nodes = [e.state_at_start(name) for name in e.states]
        return self.formula is None or min(used(nodes, "p"), default=len(e.names)) < len(self._model._names)


class _Past:
    """The history of a problem with delays, as a function of its parameters: the initial state before events."""

    def __init__(self, start: _InitialState) -> None:
        self._start = start
        self._latest: tuple[Any, Array] | None = None  # parameters, and the state

    def __call__(self, t: float, parameters: Any) -> Array:
        known = self._latest
        if known is None or known[0] is not parameters:
            self._latest = known = parameters, self._start(parameters)
        return known[1]

    def __reduce__(self) -> tuple[Any, ...]:
        return _Past, (self._start,)


class Model:
    """A model in SBML, as returned by `load`.

    Attributes
    ----------
    name : str
        Its id.
    states : list of str
        The symbols of the components of y: species as amounts, what rate and algebraic rules define, and what events
        assign.
    parameters : dict of str and float
        Symbols that stay constant, with their numbers in the file: parameters, compartments, boundary species.
    events : list of ModelEvent
        The events.
    moieties : list of dict
        Totals of amounts that the reactions conserve: whole coefficients by species, from the stoichiometry, exactly.
    """

    def __init__(self, contents: ModelContents, fast: bool = False, given: Iterable[str] = ()) -> None:
        with_past_as_states(contents)
        self._contents, self._fast = contents, fast
        self._equations = ModelEquations(contents, fast, given)
        self._others: dict[frozenset[str], Model] = {}
        #: What simulations of one kind have in common: readers of columns, and solvers.
        self._readers: Latest[tuple[str, ...], ArrayFunction] = Latest()
        self._solvers: Latest[Hashable, PreparedSolver] = Latest()
        self.name = contents.name
        self.states = list(self._equations.states)
        e = self._equations
        self.parameters = {name: e.values[i] for i, name in enumerate(e.constants)}
        self.events = [
            ModelEvent(one.name, (*one.assignments,), one.delay is not None, one.priority is not None, one.persistent)
            for one in contents.events
        ]

    def __setattr__(self, name: str, value: Any) -> None:
        if "events" in self.__dict__:  # the last attribute
            instead = f"give values={{{name!r}: {value!r}}} to simulate, or model.problem(t_span, {name}={value!r})"
            raise AttributeError(f"a model does not change, and {name} cannot be set: {instead}")
        super().__setattr__(name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        return Model, (self._contents, self._fast, self._equations._given)

    @cached_property
    def moieties(self) -> list[dict[str, int]]:
        return [{self.states[i]: x for i, x in one.items()} for one in self._weights]

    @cached_property
    def _weights(self) -> list[dict[int, int]]:
        return self._equations.moieties()

    @property
    def species(self) -> list[str]:
        """The ids of all species."""
        return [*self._contents.species]

    def means_amount(self, name: str) -> bool:
        """Return whether the symbol of a species means an amount in formulas; otherwise it is a concentration."""
        return name in self._contents.species and self._contents.species[name].is_amount

    def report(self) -> str:
        """Return what was made of the model, and what was ignored, in lines of text."""
        c, e = self._contents, self._equations
        reactions = f"{len(c.reactions)} reaction{'s' * (len(c.reactions) != 1)}"
        lines = [f"{self.name}: SBML Level {c.level}, {len(c.species)} species, {reactions}"]
        lines.append(f"states: {', '.join(self.states) or 'none'}")
        computed = [name for name in c.initial if name not in e.place]
        if computed:
            lines.append(f"computed from initial assignments: {', '.join(computed)}")
        if c.rules:
            lines.append(f"assigned by rules at all times: {', '.join(c.rules)}")
        if e.matched:
            lines.append(f"determined by algebraic rules, with a singular mass matrix: {', '.join(e.matched)}")
        if self._fast and any(one.fast for one in c.reactions.values()):
            fast = [name for name, one in c.reactions.items() if one.fast]
            lines.append(f"fast reactions, with {FAST:g} times their rates: {', '.join(fast)}")
        if self.moieties:
            totals = [" + ".join(f"{x} {n}" if x != 1 else n for n, x in one.items()) for one in self.moieties]
            lines.append(f"conserved: {'; '.join(totals).replace('+ -', '- ')}")
        if self.events:
            lines.append(f"events: {', '.join(one.name for one in self.events)}")
        lines += c.done
        lines += [f"ignored: {one}" for one in c.ignored]
        if missing := [name for name, one in c.reactions.items() if one.law is None]:
            lines.append(f"without a rate, so that what they change is NaN: {', '.join(missing)}")
        return "\n".join(lines)

    # Functions

    @cached_property
    def _names(self) -> list[str]:
        """The names of the parameters of f: those that are constant, and, if f needs them, the initial numbers too."""
        e = self._equations
        nodes = [*e.slopes, *self._events.nodes]
        most = max(used(nodes, "p"), default=-1)
        if most < len(e.constants):
            return e.constants
        return [*e.names, *(f"{name} at the start" for name in e.matched)]

    @cached_property
    def fun(self) -> Any:
        """f(t, y, p), compiled if llvmlite is installed."""
        slopes, n = self._equations.slopes, len(self.states)
        made = self._function("f", slopes or [self._equations.graph.node(0.0)], n or 1)
        if not self._equations.delays:
            return made
        if isinstance(made, GraphFunction):
            return GraphOfPast(made.fun)
        return lambda t, y, z, *args: made(t, np.concatenate([y, z.ravel()]), *args)

    def _function(self, name: str, outputs: Sequence[Node], size: int) -> Any:
        formula = Formula(name, lambda: outputs, (size,))
        return GraphFunction(formula) if has_llvm() else formula

    def _delays(self, p: Array) -> list[float | str]:
        """Return the delays: the names of those that are parameters, and the numbers of others."""
        e = self._equations
        numbers = ArrayFunction(e.delays).at(0.0, np.zeros(0), p).tolist()
        names = [self._names[one.value] if one.op == "p" else None for one in e.delays]
        return [number if name is None else name for name, number in zip(names, numbers, strict=True)]

    @cached_property
    def _events(self) -> EventCode:
        return EventCode(self._equations)

    def _start(self, values: Mapping[str, float]) -> tuple[Model, Array, Array]:
        """Return the model in which these symbols have values of their own, its p, and y0."""
        e = self._equations
        changes: dict[str, float] = {}
        free = {*map(_symbol, values)}
        computed = frozenset(n for n in free if n in self._contents.initial and n not in e._given)
        if computed:
            other = self._others.get(computed)
            if other is None:
                other = self._others[computed] = Model(self._contents, self._fast, {*e._given, *computed})
            return other._start(values)
        for name, value in values.items():
            symbol = _symbol(name)
            if symbol not in e._index:
                known = [*e.names, *(f"[{one}]" for one in self._contents.species)]
                why = "is determined by a rule" if symbol in e.symbols else "is no symbol of the model"
                raise ValueError(f"{name!r} {why}{meant(name, known)}: give values to {', '.join(e.names)}")
            changes[symbol] = number(name, value)
        p = e.parameters({n: v for n, v in changes.items() if n not in self._contents.species})
        amounts = {}
        for name, value in values.items():
            symbol = _symbol(name)
            if (one := self._contents.species.get(symbol)) is None:
                continue
            stored_as_amount = one.is_amount if symbol in e._given else one.initial_is_amount
            volume = ArrayFunction([e.start(one.compartment)]).at(0.0, np.zeros(0), p)[0]
            as_amount = not name.startswith("[")
            scale = 1.0 if as_amount == stored_as_amount else volume if stored_as_amount else 1 / volume
            amounts[symbol] = float(value) * scale
        p = e.parameters({**changes, **amounts})
        return self, p, e.initial_state(p)

    @cached_property
    def _as_in_file(self) -> tuple[Model, Array, Array]:
        """Model, p and initial state with the numbers of the file, as `_start` returns them."""
        return self._start({})

    def problem(self, t_span: tuple[float, float], *, moieties: bool = True, **values: float) -> Problem:
        """Return the model as an `invariode.Problem`: labels, parameters by name, moieties as invariants, events.

        Parameters
        ----------
        t_span : (float, float)
            The interval. Initial assignments hold at t0; events that are triggered there have changed y0.
        moieties : bool, default True
            Whether the totals of `moieties` are imposed.
        **values
            Other numbers than those of the file: parameters and compartments by id; of species ``S1`` is the initial
            amount, and ``**{"[S1]": 2.0}`` the initial concentration.

        Returns
        -------
        Problem

        Raises
        ------
        ValueError
            A name that the model does not have, or a symbol that a rule determines.
        """
        model, p, y0 = self._start(values)
        t0, machine = interval(t_span)[0], None
        y0 = model._consistent(t0, y0, p)
        more: dict[str, Any] = {}
        if model.events:
            machine = Machine(model._events, model._equations)
            y0 = machine.start(t0, y0, p)
            more["events"] = machine.functions(model._differences)
        start = _InitialState(model, t0, p, machine)
        follows = bool(model.states and model._names) and start.varies
        if model._equations.delays and follows:
            more["history"] = _Past(_InitialState(model, t0, p, None))
        return model._problem(t_span, p, start if follows else y0, moieties, **more)

    def _consistent(self, t: float, y: Array, p: Array) -> Array:
        """Return a state as it is for output: at least of one component, and as algebraic rules demand."""
        return self._equations.consistent(t, y, p) if len(y) else np.zeros(1)

    @cached_property
    def _differences(self) -> Any:
        """The differences of comparisons; 1 where they are NaN, which triggers nothing."""
        graph, found = self._equations.graph, []
        for one in self._events.differences:
            found.append(graph.select(graph.make("equal", one, one), one, graph.node(1.0)))
        return self._function("comparisons", found, len(found)) if found else None

    def _problem(
        self,
        t_span: tuple[float, float],
        p: Array,
        y0: Array | _InitialState,
        moieties: bool,
        explicit: bool = False,
        **more: Any,
    ) -> Problem:
        """Return the model as a problem. `explicit`: with algebraic rules differentiated, and imposed."""
        e, fun = self._equations, self.fun
        explicit = explicit and e.differentiated is not None
        named = dict(zip(self._names, p.tolist(), strict=False))
        numbers = [*named.items(), *(zip(self.states, y0.tolist(), strict=False) if isinstance(y0, np.ndarray) else ())]
        if missing := [name for name, value in numbers if np.isnan(value)]:
            raise ValueError(f"{', '.join(missing)}: no number in the file, and none was given, as {missing[0]}=1.0 is")
        options: dict[str, Any] = {"name": self.name, **more}
        if self.states:
            options["labels"] = self.states
        invariants = [self._invariants] if moieties and self._weights else []
        if explicit:
            invariants.append(self._rules)
        elif e.mass is not None:
            options["mass"] = e.mass
        if invariants:
            options["invariants"] = invariants
        if named:
            options["parameters"] = named
        options["breakpoints"] = self._times(p, *map(float, t_span)) or None
        if e.delays:
            past = self._consistent(float(t_span[0]), e.initial_state(p), p)
            options = {"delays": self._delays(p), "history": past, **options}
        return Problem(self._differentiated if explicit else fun, t_span, y0, **options)

    @cached_property
    def _differentiated(self) -> Any:
        """f(t, y, p) with algebraic rules differentiated once."""
        slopes = self._equations.differentiated
        assert slopes is not None
        return self._function("f", slopes, len(slopes))

    @cached_property
    def _rules(self) -> Invariants:
        """The algebraic rules, which determine their variables alone, after the totals."""
        e = self._equations
        names = [f"algebraic rule {i + 1}" for i in e.matched.values()]
        places = [e.place[name] for name in e.matched]
        rules = self._function("rules", e.rules, len(e.rules))
        return Invariants(rules, value=[0.0] * len(places), names=names, level=1, moves=places)

    @cached_property
    def _invariants(self) -> Invariants:
        W = as_rows(self._weights, len(self.states))
        graph = self._equations.graph
        totals = []
        for row in W:
            total = graph.node(0.0)
            for i in np.flatnonzero(row).tolist():
                total = total + (graph.y(i) if row[i] == 1 else float(row[i]) * graph.y(i))
            totals.append(total)
        names = [f"total {i + 1}" for i in range(len(W))]
        return Invariants(self._function("totals", totals, len(totals)), names=names)

    def breakpoints(self, t_span: tuple[float, float], **values: float) -> list[float]:
        """Return the times within the interval at which conditions on t alone change, in rates, rules and triggers.

        They are breakpoints of the problem that `problem` returns.
        """
        model, p, _ = self._start(values)
        return model._times(p, *t_span)

    def _times(self, p: Array, t0: float, tf: float) -> list[float]:
        return [t for t in times_of_roots(self._clocks, p) if min(t0, tf) < t < max(t0, tf)]

    @cached_property
    def _clocks(self) -> list[Node]:
        """The differences of all comparisons of t with parameters, in rates, rules and triggers."""
        comparisons = ("less", "less_equal", "equal", "not_equal")
        inside = [one for one in in_order(self._equations.slopes) if one.op in comparisons]
        differences = [one.arguments[0] - one.arguments[1] for one in inside]
        return [one for one in (*differences, *self._events.differences) if is_clock(one)]

    # Simulation

    def simulate(
        self,
        start: float = 0.0,
        end: float = 10.0,
        points: int = 51,
        selections: Sequence[str] | None = None,
        *,
        method: MethodName = "auto",
        rtol: float = _RTOL,
        atol: float | None = None,
        moieties: bool = True,
        seed: int = 0,
        values: Mapping[str, float] | None = None,
        **options: Any,
    ) -> Table:
        """Simulate the model, events included.

        Parameters
        ----------
        start, end : float
            The interval.
        points : int, default 51
            The number of output times, equally spaced, `start` and `end` included; or these times.
        selections : list of str, optional
            Columns: ``"time"``; ``"S1"``, the amount of a species, and ``"[S1]"``, its concentration; ids of
            parameters, compartments, reactions (their rates) and of stoichiometries; ``"S1'"``, the rate of change of
            an amount, and so on. Default: time and the concentrations of all species that change.
        method : str, default 'auto'
            As in `solve_ivp`; 'ode15s' takes its place if there are algebraic rules. For methods that take no mass
            matrix these are differentiated once, and imposed, unless they contain conditions.
        rtol, atol : float
            Tolerances, 1e-8 and at most 1e-12: less if all amounts are below 1.
        moieties : bool, default True
            Whether the totals of `moieties` are imposed.
        seed : int, default 0
            Of the random order of events that are due at one time with the same priority, or without one.
        values : dict, optional
            Other numbers than those of the file, as in `problem`.
        **options
            Of `solve_ivp`.

        Returns
        -------
        Table
            Arrays by column name. Where events happen at an output time, the values after them.

        Raises
        ------
        RuntimeError
            The run does not reach the end; the message says why.
        """
        if own := {*options} & {*self._equations.symbols} - TABLE.keys():
            raise TypeError(f'{min(own)} is no option: give values={{"{min(own)}": {options[min(own)]!r}}}')
        if np.ndim(points):
            times = np.asarray(points, dtype=float)
        else:
            times = np.linspace(start, end, positive_integer("points", points))
        model, p, y0 = self._start(values) if values else self._as_in_file
        columns = list(selections) if selections is not None else self._default_columns()
        read = model._reader(columns)
        largest = np.abs(y0[np.isfinite(y0)]).max(initial=0.0)
        options["atol"] = min(_ATOL, _SMALL * largest) if atol is None and largest > 0 else atol or _ATOL
        options = {"rtol": rtol, **options}
        return Table(
            columns, read.over(times, model._course(float(start), times, p, y0, moieties, method, options, seed), p).T
        )

    def _course(
        self,
        start: float,
        times: Array,
        p: Array,
        y: Array,
        moieties: bool,
        method: MethodName,
        options: dict[str, Any],
        seed: int,
    ) -> Array:
        """Return the states at these times, (n, m), after events that happen there."""
        end, y = float(times[-1]), self._consistent(start, y, p)
        after: list[tuple[float, Array]] = []
        machine, more = Machine(self._events, self._equations, seed, after), {}
        if self.events:
            y = machine.start(start, y, p)
            more["events"] = machine.functions(self._differences)
        if end == start or (not self.states and not self.events):
            return np.repeat(np.tile(y, 1 + len(self._equations.delays))[:, None], len(times), axis=1)
        known = next((one for one in METHODS.values() if method in (one.name, one.scipy_name)), None)
        explicit = self._equations.mass is not None and known is not None and known.mass == "none"
        if self._equations.mass is not None and method == "auto":
            method = "ode15s"
        options |= {"t_eval": times, "on_failure": "return"}
        delays: list[float] = []
        if self.events or self._equations.delays:
            problem = self._problem((start, end), p, y, moieties, explicit, **more)
            if problem.delays is not None:
                delays = problem.delays.values(problem.args, problem.y0)
                options["dense_output"] = True
            sol = problem.solve(method, **options)
        else:
            sol = self._prepared((start, end), p, y, moieties, explicit, method, options)
        if sol.status < 0:
            missing = [name for name, one in self._contents.reactions.items() if one.law is None]
            about = f" Reactions without a rate: {', '.join(missing)}." if missing else ""
            raise RuntimeError(f"the run of {self.name} did not reach the end: {sol.message}{about}")
        Y = np.vstack([sol.y, *(sol.sol(times - one) for one in delays)])
        for t, state in after:
            Y[: len(y), np.abs(times - t) <= SAME_TIME * max(1.0, abs(t))] = state[:, None]
        return Y

    def _prepared(
        self,
        t_span: tuple[float, float],
        p: Array,
        y: Array,
        moieties: bool,
        explicit: bool,
        method: MethodName,
        options: dict[str, Any],
    ) -> Solution:
        """Return the solution by a solver that all simulations of one kind have in common."""
        about = _core.plain_options({**options, "t_eval": None})
        kind = t_span, options["t_eval"].tobytes(), moieties, explicit, method, about, (*self._times(p, *t_span),)
        solver = None if about is None else self._solvers.get(kind)
        if solver is None:
            solver = self._problem(t_span, p, y, moieties, explicit).prepare(method, **options)
            if about is not None:
                self._solvers[kind] = solver
        return solver(y0=y, args=dict(zip(self._names, p.tolist(), strict=False)) or None)

    def _default_columns(self) -> list[str]:
        moving = [n for n, one in self._contents.species.items() if not one.constant]
        return ["time", *(f"[{name}]" for name in moving)]

    def _reader(self, columns: Sequence[str]) -> ArrayFunction:
        return self._readers.find((*columns,), lambda: ArrayFunction([self.selection(name) for name in columns]))

    def selection(self, name: str) -> Node:
        """Return the values of a column, as a node of the model's graph."""
        e = self._equations
        if name == "time" and name not in e.symbols:
            return e.graph.t
        if name.endswith("'") and name[:-1] in e.symbols:
            symbol = name[:-1]
            return e.slope(symbol) if symbol in e.place and symbol in self._contents.species else e.rate(symbol)
        inside = name[1:-1] if name.startswith("[") and name.endswith("]") else name
        if inside not in e.symbols or (inside != name and inside not in self._contents.species):
            known = ["time", *e.symbols, *(f"[{one}]" for one in self._contents.species)]
            raise ValueError(f"there is no column {name!r}{meant(name, known)}: there are {', '.join(known)}")
        if inside not in self._contents.species:
            return e.value(inside)
        value, volume = e.value(inside), e.value(e.volume(inside))
        if (inside == name) == (not e.is_concentration(inside)):
            return value
        if inside == name:  # a state is an amount already
            amount = inside in e.place and e.is_amount_state[inside]
            return e.graph.y(e.place[inside]) if amount else value * volume
        return value / volume

    def __repr__(self) -> str:
        counts = f"{len(self.states)} states, {len(self.parameters)} parameters, {len(self.events)} events"
        return f"Model({self.name!r}: {counts})"
