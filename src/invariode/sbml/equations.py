"""Equations of a model: which symbols are states, and all values and rates as nodes of one graph.

The states are amounts of species (concentrations where a rate rule defines one in a compartment whose volume is
assigned), compartments and parameters with rate rules, what events assign (y' = 0 between them), and what algebraic
rules determine. Parameters p are the numbers of the file; whatever is computed of them at the start stays a formula,
so that derivatives with respect to parameters are exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._base.forks import cached_property
from .._base.rational import fraction, left_null_space
from .._functions.graph.array_code import ArrayFunction
from .._functions.graph.differentiation import jacobian
from .._functions.graph.function import GraphFunction
from .._functions.graph.nodes import Graph, Node, in_order
from .._functions.graph.python import Formula
from .._functions.graph.structure import replaced
from .._problem.problem import Problem
from .formulas import Expression, Translator
from .library import UnsupportedError
from .reading import ModelContents

#: The factor that multiplies the rates of fast reactions; ``fast="limit"`` approaches their infinitely fast limit.
FAST = 1e7

#: Operations across which values may jump.
_JUMPING = {"select", "less", "less_equal", "equal", "not_equal", "floor", "ceil", "sign", "modulo", "piece", "pick"}

#: Newton's steps for values that algebraic rules determine, and their last size.
_ITERATIONS, _ARRIVED = 50, 1e-14

#: Residuals below this are roundoff where Newton's steps end without a last small one.
_SMALL = 1e-9


class ModelEquations:
    """A model as y' = f(t, y, p), or M y' = f.

    Parameters
    ----------
    contents : Contents
        The model.
    fast : bool
        Whether fast reactions are taken as their limit.
    given : set of str
        Symbols whose values are parameters, whatever their initial assignments say.

    Attributes
    ----------
    states : list of str
        The symbols of y.
    names : list of str
        The symbols of p: numbers of the file, first those that are constant, then the initial ones of states.
    values : list of float
        The numbers of the file.
    mass : ndarray, (n, n), or None
        The diagonal mass matrix, if there are algebraic rules.
    """

    def __init__(self, contents: ModelContents, fast: bool = False, given: Iterable[str] = ()) -> None:
        self.contents, self.graph = contents, Graph()
        self._given, self._fast = {*given}, fast
        self.symbols = [*contents.compartments, *contents.values, *contents.species, *contents.reactions]
        self.symbols += [name for name in (*contents.rules, *contents.rates) if name not in {*self.symbols}]
        self.symbols = [*dict.fromkeys(self.symbols)]
        if any(one.fast for one in contents.reactions.values()) and not fast:
            raise UnsupportedError(
                "fast reaction",
                'the model has fast reactions, which SBML no longer has: load it with fast="limit" for rates that are '
                f"{FAST:g} times the given ones",
            )
        self._driving: dict[str, list[tuple[int, float | str, str]]] = {}
        for name, one in contents.reactions.items():
            for species, sign, count in one.changes:
                self._driving.setdefault(species, []).append((sign, count, name))
        self._find_states()
        self._find_parameters()
        self._values: dict[str, Node | None] = {}
        self._rates: dict[str, Node | None] = {}
        self._starts: dict[str, Node | None] = {}
        graph = self.graph
        self.delays: list[Node] = []
        self._now = Translator(graph, self.value, self.rate, graph.t, self._delayed)
        self._then = Translator(graph, self.start, self._rate_at_start, graph.node(0.0), self._delayed_at_start)
        self._befores: dict[str, Node | None] = {}
        self._earlier = Translator(
            graph,
            self._before,
            self._rate_before,
            graph.t,
            lambda one, value, delay: replaced([value], {graph.t: graph.t - delay})[0],
        )
        for name in (*contents.rules, *contents.initial):  # a cycle is an error, even if nobody asks for its values
            self.value(name)
            self.start(name)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the contents alone, from which nodes are made again: they are equal by identity."""
        return ModelEquations, (self.contents, self._fast, self._given)

    # Which symbols are what

    def driven(self, name: str) -> bool:
        """Return whether reactions change the species."""
        one = self.contents.species.get(name)
        free = one is not None and not one.boundary and not one.constant
        return free and name in self._driving and name not in self.contents.rules and name not in self.contents.rates

    def volume(self, name: str) -> str:
        """Return the compartment of a species."""
        return self.contents.species[name].compartment

    def is_concentration(self, name: str) -> bool:
        """Return whether the symbol of a species means a concentration."""
        one = self.contents.species.get(name)
        return one is not None and not one.is_amount

    def _is_constant(self, name: str) -> bool:
        contents = self.contents
        if name in contents.species:
            return contents.species[name].constant
        if name in contents.compartments:
            return contents.compartments[name].constant
        return name in contents.constants or name in contents.reactions

    def _find_states(self) -> None:
        contents = self.contents
        self.targets = {name for one in contents.events for name in one.assignments}
        states = [name for name in self.symbols if self.driven(name) or name in contents.rates]
        states += [n for n in self.symbols if n in self.targets and n not in states and n not in contents.rules]
        self.matched = self._match()
        states += [name for name in self.matched if name not in states]
        self.states = states
        self.place = {name: i for i, name in enumerate(states)}
        self.is_amount_state = {
            name: not (name in contents.rates and self.is_concentration(name) and self.volume(name) in contents.rules)
            for name in contents.species
        }

    def _match(self) -> dict[str, int]:
        """Return the variables that algebraic rules determine: a matching by augmenting paths."""
        contents = self.contents
        bound = {*contents.rules, *contents.rates}
        free = [n for n in self.symbols if n not in bound and not self.driven(n) and not self._is_constant(n)]
        free.sort(key=lambda n: (n in self.targets, not math.isnan(self._number(n)) or n in contents.initial))
        inside = [self._variables(one.names(), set()) for one in contents.algebraic]
        found: dict[str, int] = {}

        def place(i: int, tried: set[str]) -> bool:
            for name in free:
                if name in inside[i] and name not in tried:
                    tried.add(name)
                    if name not in found or place(found[name], tried):
                        found[name] = i
                        return True
            return False

        for i in range(len(inside)):
            if not place(i, set()):
                raise UnsupportedError(
                    "algebraic rule", f"algebraic rule {i + 1} has no variable of its own: the model is overdetermined"
                )
        return found

    def _variables(self, names: set[str], seen: set[str]) -> set[str]:
        """Return the symbols that a formula depends on, with assignment rules followed."""
        found: set[str] = set()
        for name in names - seen:
            seen.add(name)
            if name in self.contents.rules:
                found |= self._variables(self.contents.rules[name].names(), seen)
                continue
            found.add(name)
            if self.is_concentration(name):
                found |= self._variables({self.volume(name)}, seen)
        return found

    def _number(self, name: str) -> float:
        """Return the number that the file gives, or NaN if it gives none."""
        contents = self.contents
        if name in contents.species:
            return contents.species[name].initial
        if name in contents.compartments:
            return contents.compartments[name].size
        return contents.values.get(name, math.nan)

    def _find_parameters(self) -> None:
        """List the entries of p: the numbers, then those that algebraic rules determine at the start, which have no
        formula."""
        contents = self.contents
        own = [n for n in self.symbols if n not in contents.rules and n not in contents.reactions]
        computed = {n for n in contents.initial if n not in self._given}
        constant = [n for n in own if n not in self.place and n not in computed]
        self.constants = constant
        self.names = [*constant, *(n for n in own if n in self.place and n not in computed and n not in self.matched)]
        self.values = [self._number(n) for n in self.names]
        self._index = {name: i for i, name in enumerate(self.names)}
        self._unknown = {name: len(self.names) + i for i, name in enumerate(self.matched)}

    # Values

    def _memo(self, memory: dict[str, Node | None], name: str, make: Callable[[], Node]) -> Node:
        if name not in memory:
            memory[name] = None
            memory[name] = make()
        found = memory[name]
        if found is None:
            raise UnsupportedError("cycle", f"the formulas for {name!r} need {name!r} itself")
        return found

    def value(self, name: str) -> Node:
        """Return the value of a symbol."""
        return self._memo(self._values, name, lambda: self._value(name))

    def _value(self, name: str) -> Node:
        contents, graph = self.contents, self.graph
        if name in contents.rules:
            return self._now.number(contents.rules[name])
        if name in contents.reactions:
            return self._law(name)
        if name in self.place:
            state = graph.y(self.place[name])
            amount = self.is_concentration(name) and self.is_amount_state[name]
            return state / self.value(self.volume(name)) if amount else state
        if self.is_concentration(name) and self._changes(self.volume(name)):
            return self.start(name) * self.start(self.volume(name)) / self.value(self.volume(name))
        return self.start(name)

    def _delayed(self, formula: Expression, value: Node, delay: Node) -> Node:
        """Return a value at t - delay: of states after y, those of the first delay, of the second, and so on."""
        if used([delay], "y") or any(one.op == "t" for one in in_order([delay])):
            raise UnsupportedError("delay", "a formula uses delay() with a delay that changes")
        if delay.op == "number" and delay.value == 0:
            return value
        late, graph = self._shifted(value, delay), self.graph
        if not self._varies_before(formula, set()):
            return late  # the history of states is their value at the start
        early = replaced([self._earlier.number(formula)], {graph.t: graph.t - delay})[0]
        return graph.select(graph.make("less", graph.t, delay), early, late)

    def _shifted(self, value: Node, delay: Node) -> Node:
        """Return a value at t - delay, with a history that is constant."""
        n, graph = len(self.states) or 1, self.graph
        earlier: dict[Node, Node] = {}
        for one in in_order([value]):
            if one.op == "t":
                earlier[one] = graph.t - delay
            elif one.op == "y":
                before, i = divmod(one.value, n)
                whole = delay if before == 0 else self.delays[before - 1] + delay
                earlier[one] = graph.y(n * (1 + self._number_of(whole)) + i)
        return replaced([value], earlier)[0] if earlier else value

    def _varies_before(self, one: Expression, seen: set[str]) -> bool:
        """Return whether an expression may have another value before the start than at the start: it depends on rates
        of change, which are 0 before the start, or on initial assignments that contain time."""
        names = one.names() - seen
        seen |= names
        if any(part.op == "rate_of" for part in one.parts()):
            return True
        formulas = {**self.contents.rules, **{n: f for n, f in self.contents.initial.items() if n not in self._given}}
        inside = [formulas[name] for name in names if name in formulas]
        return any(part.op == "time" for each in inside for part in each.parts()) or any(
            self._varies_before(each, seen) for each in inside
        )

    def _before(self, name: str) -> Node:
        """Return the value of a symbol at graph.t, before the start, by its initial assignment or rule, or constant."""
        contents = self.contents
        formula = (
            contents.rules.get(name) if name in self._given else contents.initial.get(name, contents.rules.get(name))
        )
        if formula is None:
            return self.start(name)
        return self._memo(self._befores, name, lambda: self._earlier.number(formula))

    def _rate_before(self, name: str) -> Node:
        """Return the time derivative of a symbol before the start."""
        (row,) = jacobian([self._before(name)], [self.graph.t])
        return row.get(0, self.graph.node(0.0))

    def _delayed_at_start(self, formula: Expression, value: Node, delay: Node) -> Node:
        """Return a value at -delay."""
        if not self._varies_before(formula, set()):
            return value
        return replaced([self._earlier.number(formula)], {self.graph.t: -delay})[0]

    def _number_of(self, delay: Node) -> int:
        if delay not in self.delays:
            self.delays.append(delay)
        return self.delays.index(delay)

    def _changes(self, name: str) -> bool:
        return name in self.place or name in self.contents.rules

    def _law(self, name: str) -> Node:
        law = self.contents.reactions[name].law
        return self.graph.node(math.nan) if law is None else self._now.number(law)

    def start(self, name: str) -> Node:
        """Return the value of a symbol at the start, of the parameters."""
        return self._memo(self._starts, name, lambda: self._start(name))

    def _start(self, name: str) -> Node:
        contents = self.contents
        if name in contents.initial and name not in self._given:
            return self._then.number(contents.initial[name])
        if name in contents.rules:
            return self._then.number(contents.rules[name])
        if name in contents.reactions:
            law = contents.reactions[name].law
            return self.graph.node(math.nan) if law is None else self._then.number(law)
        if name in self._unknown:
            return self.graph.p(self._unknown[name])
        number = self.graph.p(self._index[name])
        one = contents.species.get(name)
        if one is None:
            return number
        is_amount = one.is_amount if name in self._given else one.initial_is_amount
        if is_amount and not one.is_amount:
            return number / self.start(one.compartment)
        return number * self.start(one.compartment) if one.is_amount and not is_amount else number

    def _rate_at_start(self, name: str) -> Node:
        """Return the rate of a symbol, with all values at the start."""
        node = self.rate(name)
        graph = self.graph
        inside = {one for one in in_order([node]) if one.op in ("y", "t")}
        values = {
            one: graph.node(0.0) if one.op == "t" else self.state_at_start(self.states[one.value]) for one in inside
        }
        return replaced([node], values)[0]

    def state_at_start(self, name: str) -> Node:
        """Return the state of a symbol at the start."""
        return self.as_state(name, self.start(name), self.start)

    def as_state(self, name: str, value: Node, values: Callable[[str], Node]) -> Node:
        """Return the state whose symbol has this value: an amount for a concentration."""
        amount = self.is_concentration(name) and self.is_amount_state[name]
        return value * values(self.volume(name)) if amount else value

    # Rates

    def rate(self, name: str) -> Node:
        """Return the time derivative of the value of a symbol."""
        return self._memo(self._rates, name, lambda: self._rate(name))

    def _rate(self, name: str) -> Node:
        contents, graph = self.contents, self.graph
        if name in contents.rates:
            return self._now.number(contents.rates[name])
        if name in contents.rules or name in contents.reactions:
            return self._of_formula(name)
        if name in self.matched:
            raise UnsupportedError("rateOf", f"rateOf({name}): an algebraic rule determines {name}")
        if name in self.place:
            derivative = self._change(name)
            if not self.is_concentration(name):
                return derivative
            volume = self.volume(name)
            if self._changes(volume):
                derivative = derivative - self.value(name) * self.rate(volume)
            return derivative / self.value(volume)
        if self.is_concentration(name) and self._changes(self.volume(name)):
            volume = self.volume(name)
            return -(self.value(name) * self.rate(volume) / self.value(volume))
        return graph.node(0.0)

    def _of_formula(self, name: str) -> Node:
        """Return the derivative of an assigned value along the solution."""
        graph, value = self.graph, self.value(name)
        used = sorted(one.value for one in in_order([value]) if one.op == "y")
        variables = [graph.t, *map(graph.y, used)]
        (row,) = jacobian([value], variables)
        along = [graph.node(1.0), *map(self._slope_of_entry, used)]
        total = graph.node(0.0)
        for j, slope in row.items():
            total = total + slope * along[j]
        return total

    def _slope_of_entry(self, i: int) -> Node:
        """Return the time derivative of y_i, or of a delayed value after y."""
        graph, n = self.graph, len(self.states) or 1
        which, i = divmod(i, n)
        name = self.states[i]
        if which == 0:
            return self.slope(name)
        delay = self.delays[which - 1]
        (row,) = jacobian([self.as_state(name, self._before(name), self._before)], [graph.t])
        early = replaced([row.get(0, graph.node(0.0))], {graph.t: graph.t - delay})[0]
        return graph.select(graph.make("less", graph.t, delay), early, self._shifted(self.slope(name), delay))

    def slope(self, name: str) -> Node:
        """Return y' of a state."""
        contents = self.contents
        if name not in contents.rates:
            return self._change(name)
        rate = self.rate(name)
        if not self.is_concentration(name) or not self.is_amount_state[name]:
            return rate
        volume = self.volume(name)
        slope = rate * self.value(volume)
        return slope + self.value(name) * self.rate(volume) if self._changes(volume) else slope

    def _change(self, name: str, fast_alone: bool = False) -> Node:
        """Return the rate at which reactions change the amount of a species; all, or the fast ones with their own
        rates."""
        graph = self.graph
        changes = self._driving[name] if self.driven(name) else []
        total: Node | None = None
        for sign, count, reaction in changes:
            fast, rate = self.contents.reactions[reaction].fast, self.value(reaction)
            if fast_alone and not fast:
                continue
            rate = FAST * rate if fast and not fast_alone else rate
            term = rate * (self.value(count) if isinstance(count, str) else count)
            total = term if total is None and sign > 0 else -term if total is None else (
                total + term if sign > 0 else total - term
            )  # fmt: skip
        if total is None:
            return graph.node(0.0)
        factor = self.contents.species[name].factor
        return total * self.value(factor) if factor else total

    @cached_property
    def slopes(self) -> list[Node]:
        """Nodes of f: y', or the residuals of algebraic rules in the places of their variables."""
        rows = [self.slope(name) if name not in self.matched else self.graph.node(0.0) for name in self.states]
        for name, rule in zip(self.matched, self.rules, strict=True):
            rows[self.place[name]] = rule
        return rows

    @cached_property
    def mass(self) -> Array | None:
        """Diagonal mass matrix, (n, n), or None."""
        if not self.matched:
            return None
        return np.diag([0.0 if name in self.matched else 1.0 for name in self.states])

    @cached_property
    def rules(self) -> list[Node]:
        """The residuals r of the algebraic rules, in the order of their variables z."""
        return [self.formula(self.contents.algebraic[i]) for i in self.matched.values()]

    @cached_property
    def differentiated(self) -> list[Node] | None:
        """Nodes of f with algebraic rules differentiated once, z' = −(∂r/∂z)⁻¹ (∂r/∂t + ∂r/∂x x'), for methods without
        a mass matrix; None: a rule has a condition, across which z jumps."""
        if any(node.op in _JUMPING for node in in_order(self.rules)):
            return None
        graph, zero = self.graph, self.graph.node(0.0)
        places = [self.place[name] for name in self.matched]
        others = [i for i in range(len(self.states)) if i not in places]
        k = len(places)
        variables = [*map(graph.y, places), graph.t, *map(graph.y, others)]
        rates = [graph.node(1.0), *(self.slopes[i] for i in others)]
        matrix, right = [], []
        for row in jacobian(self.rules, variables):
            matrix.append([row.get(j, zero) for j in range(k)])
            total = zero
            for j, rate in enumerate(rates, k):
                if j in row:
                    total = total - row[j] * rate
            right.append([total])
        found = list(self.slopes)
        for place, (value,) in zip(places, graph.solve(matrix, right), strict=True):
            found[place] = value
        return found

    def formula(self, one: Expression) -> Node:
        """Return an expression in the symbols as a node."""
        return self._now.number(one)

    @property
    def translator(self) -> Translator:
        """Translator of expressions in the symbols into nodes."""
        return self._now

    # The start

    @cached_property
    def _starting(self) -> ArrayFunction:
        return ArrayFunction([self.state_at_start(name) for name in self.states])

    @cached_property
    def _at_start(self) -> SolvedModel:
        """Solver for the numbers that algebraic rules determine at the start."""
        residuals = [self._then.number(self.contents.algebraic[i]) for i in self.matched.values()]
        return SolvedModel(residuals, [self.graph.p(i) for i in self._unknown.values()])

    @cached_property
    def _in_course(self) -> SolvedModel:
        """Solver for the states that algebraic rules determine at any time."""
        places = [self.place[name] for name in self.matched]
        return SolvedModel([self.slopes[i] for i in places], [self.graph.y(i) for i in places])

    def parameters(self, changes: dict[str, float]) -> Array:
        """Return p with other numbers of the file."""
        p = np.array([*self.values, *np.ones(len(self._unknown))])
        for name, value in changes.items():
            p[self._index[name]] = value
        if self._unknown and not self._at_start(0.0, np.zeros(0), p, p[len(self.names) :]):
            raise UnsupportedError(
                "algebraic rule", "the algebraic rules have no solution at the start, or none was found"
            )
        return p

    @cached_property
    def has_fast(self) -> bool:
        """True if there are fast reactions."""
        return any(one.fast for one in self.contents.reactions.values())

    def _relaxed(self, t: float, y: Array, p: Array) -> Array:
        """Return the state to which the fast reactions lead, with the totals that they keep."""
        from .._studies.steady import Found, SteadyStates

        slopes = [self._change(name, fast_alone=True) for name in self.states]
        fixed = replaced(slopes, {self.graph.t: self.graph.node(t)})
        fun = GraphFunction(Formula("fast", lambda: fixed, (len(y),)))
        found = SteadyStates(Problem(fun, (0.0, 1.0), y, args=(p,)), ()).at((p,), y)
        return found.y if isinstance(found, Found) else y

    def consistent(self, t: float, y: Array, p: Array) -> Array:
        """Return y with the values that algebraic rules determine, and where fast reactions have led it."""
        if self.has_fast:
            y = self._relaxed(t, y, p)
        if not self.matched:
            return y
        y, places = y.copy(), [self.place[name] for name in self.matched]
        unknown = y[places]
        self._in_course(t, y, p, unknown, lambda: y.__setitem__(places, unknown))
        return y

    def initial_state(self, p: Array) -> Array:
        """Return the initial state y0, (n,)."""
        return self._starting.at(0.0, np.zeros(0), p)

    # Structure

    def moieties(self) -> list[dict[int, int]]:
        """Return totals of amounts that all reactions conserve, exactly: coefficients by state.

        Species with stoichiometries or conversion factors that have names of their own are left out, as these may be
        given other values; so are species that events assign.
        """
        factors = {self.contents.species[name].factor for name in self.states if self.driven(name)}
        rows, places = [], []
        for name in self.states:
            changes = self._driving.get(name, [])
            named = any(isinstance(count, str) or not math.isfinite(count) for _, count, _ in changes)
            if not self.driven(name) or name in self.targets or named or len(factors) > 1:
                continue
            row: dict[Any, Any] = {}
            for sign, count, reaction in changes:
                row[reaction] = row.get(reaction, 0) + sign * fraction(float(count))
            rows.append(row)
            places.append(self.place[name])
        return [{places[i]: x for i, x in one.items()} for one in left_null_space(rows)]


class SolvedModel:
    """Newton's method for some of the numbers that values depend on, so that the values are zero."""

    def __init__(self, residuals: Sequence[Node], unknown: Sequence[Node]) -> None:
        self._residuals, self._k = ArrayFunction(residuals), len(unknown)
        rows = jacobian(residuals, unknown)
        zero = unknown[0].graph.node(0.0)
        self._slopes = ArrayFunction([row.get(j, zero) for row in rows for j in range(len(unknown))])

    def __call__(self, t: float, y: Array, p: Array, x: Array, put: Callable[[], None] = lambda: None) -> bool:
        """Change x, which `put` puts among y or p; return whether the iteration has converged."""
        for _ in range(_ITERATIONS):
            r, J = self._residuals.at(t, y, p), self._slopes.at(t, y, p).reshape(self._k, self._k)
            if not (np.isfinite(r).all() and np.isfinite(J).all()):
                return False
            step = np.linalg.lstsq(J, -r, rcond=None)[0]
            x += step
            put()
            if (np.abs(step) <= _ARRIVED * np.abs(x).max(initial=1e-300)).all():
                return True
        return bool((np.abs(self._residuals.at(t, y, p)) < _SMALL).all())


def used(nodes: Sequence[Node], op: str) -> set[int]:
    """Return the indices of y or p that values depend on."""
    return {one.value for one in in_order(nodes) if one.op == op}
