"""Conditions of a problem as experiments of `invariode.fit`: one for each pair of a condition with data and the
condition of its pre-equilibration.

The numbers p that all formulas depend on are those of the model, followed by a number for each parameter of the
problem, on which the rates do not depend. What a condition sets, to a number or a parameter, is the `where` of its
experiment.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._base.forks import cached_property
from .._base.suggestions import meant
from .._base.types import MethodName
from .._functions.graph.array_code import ArrayFunction
from .._functions.graph.nodes import Node
from .._functions.graph.python import Formula
from .._problem.problem import Problem
from .._studies.fit.experiment import Experiment
from ..sbml.equations import used
from ..sbml.event_machine import Machine
from ..sbml.formulas import Translator, parse
from ..sbml.model import Model
from .problem_files import Measurement, Tables

LN10 = math.log(10.0)

#: A name in a formula.
_WORD = re.compile(r"[A-Za-z_]\w*")


class Period(NamedTuple):
    """An experiment with the places of its data: row and column of each measurement by its number."""

    experiment: Experiment
    rows: list[int]
    places: tuple[list[int], list[int]]


class Experiments:
    """The experiments of a problem.

    - `model`: the model, in which all symbols that parameters or conditions set are given
    - `tables`: the problem
    - `method`, `rtol`, `atol`: of the runs
    """

    def __init__(self, model: Model, tables: Tables, method: MethodName, rtol: float, atol: float) -> None:
        self.model, self._tables = model, tables
        self._method, self._rtol, self._atol = method, rtol, atol
        self._equations = e = model._equations
        self._parameters = list(tables.parameters)
        known = {*e.symbols, *self._parameters}
        for condition, changes in tables.conditions.items():
            if unknown := [name for name in changes if name not in known]:
                raise ValueError(
                    f"condition {condition!r} sets {unknown[0]!r}, which is neither in the model nor a parameter"
                    f"{meant(unknown[0], known)}"
                )
            for name, value in changes.items():
                if isinstance(value, str) and value not in tables.parameters:
                    raise ValueError(f"condition {condition!r} sets {name!r} to {value!r}, which is no parameter")
        self._require_used({*e.symbols})
        base = np.array(e.values)
        for name in e._given & {*e._index}:  # given symbols have their own unit, not that of the file
            base[e._index[name]] = self._in_own_unit(name)
        nominal = [one.nominal for one in tables.parameters.values()]
        #: Where the numbers of the problem's parameters begin among p.
        self._first = len(e.names) + len(e.matched)
        values = np.array([*base, *np.ones(len(e.matched)), *nominal])
        #: Symbols without a number, to which every condition has to give one.
        self._missing = {*np.flatnonzero(np.isnan(values)).tolist()}
        self._p = np.nan_to_num(values, nan=1.0)

    def _require_used(self, symbols: set[str]) -> None:
        """Raise an error for an estimated parameter on which nothing depends: it is misspelt, most likely."""
        tables = self._tables
        values: set[Any] = {value for changes in tables.conditions.values() for value in changes.values()}
        for one in tables.measurements:
            values |= {*one.observable_parameters, *one.noise_parameters}
        formulas = [text for one in tables.observables.values() for text in (one.formula, one.noise)]
        here = {*symbols, *values, *(word for text in formulas for word in _WORD.findall(text))}
        for name, row in tables.parameters.items():
            if row.estimated and name not in here:
                raise ValueError(
                    f"the parameter {name!r} is estimated, and neither the model nor a formula, a condition or a datum "
                    f"has it{meant(name, symbols)}"
                )

    def _in_own_unit(self, name: str) -> float:
        e = self._equations
        number, one = e._number(name), e.contents.species.get(name)
        if one is None or one.initial_is_amount == one.is_amount:
            return number
        volume = e._number(one.compartment)
        return number * volume if one.is_amount else number / volume

    def parts(self) -> list[Period]:
        """Return the experiments, in the order of the measurement table."""
        found: dict[tuple[str, str], list[int]] = defaultdict(list)
        for i, one in enumerate(self._tables.measurements):
            found[one.before, one.condition].append(i)
        return [self._part(*key, rows) for key, rows in found.items()]

    def _part(self, before: str, condition: str, rows: list[int]) -> Period:
        measured = [self._tables.measurements[i] for i in rows]
        groups = [*dict.fromkeys(map(_group, measured))]
        places = {group: row for row, group in enumerate(groups)}
        repeated: Counter[Any] = Counter()
        keys = []
        for one in measured:  # data that are repeated at one time have columns of their own
            keys.append((one.time, repeated[_group(one), one.time]))
            repeated[_group(one), one.time] += 1
        columns = {key: i for i, key in enumerate(sorted({*keys}))}
        data = np.full((len(groups), len(columns)), np.nan)
        where = [places[_group(one)] for one in measured], [columns[key] for key in keys]
        data[where] = [one.value for one in measured]
        times = np.array([t for t, _ in columns])
        if self.model.events and (before or np.isinf(times).any()):
            raise ValueError(
                f"condition {condition!r} needs a steady state of a model with events, which may happen on the way: "
                "such problems are not read"
            )
        finite = times[np.isfinite(times) & (times > 0)]
        observables = [self._tables.observables[group[0]] for group in groups]
        noise: Any = [
            ("log" if one.scale != "lin" else "") + ("laplace" if one.laplace else "normal") for one in observables
        ]
        formulas = [self._formulas(group) for group in groups]
        count = len(groups)
        experiment = Experiment(
            self._problem(float(finite[-1]) if len(finite) else 1.0),
            times,
            dict(zip(map(_name, groups), data, strict=True)),
            observe=Formula("observables", lambda: [one for one, _ in formulas], (count,)),
            sigma=Formula("noise", lambda: [one for _, one in formulas], (count,)),
            noise=noise,
            y0=self._start,
            where=self._where(condition, starts=not before),
            before=self._where(before) if before else None,
            resets=self._resets(condition) if before else None,
            method=self._method,
            rtol=self._rtol,
            atol=self._atol,
        )
        return Period(experiment, rows, where)

    def _resets(self, condition: str) -> list[str]:
        """Return the states that a condition sets after a pre-equilibration."""
        own = self._tables.resets.get(condition, self._tables.conditions[condition])
        return [name for name in self._equations.states if name in own]

    def _where(self, condition: str, starts: bool = True) -> dict[str, float | str]:
        """Return what the numbers of p are in a condition: numbers, or names of estimated parameters. `starts`: it has
        to define all initial values."""
        e, rows = self._equations, self._tables.parameters
        sets: dict[int, float | str] = {self._first + i: name for i, name in enumerate(self._parameters)}
        sets |= {e._index[name]: name for name in self._parameters if name in e._index}
        given = self._tables.conditions[condition]
        sets |= {e._index[name]: value for name, value in given.items() if name in e._index}
        found: dict[str, float | str] = {}
        for place, value in sets.items():
            if isinstance(value, str):
                value = value if rows[value].estimated else rows[value].nominal
            found[f"args[0][{place}]"] = value
        needed = self._of_rates | (self._of_start if starts else set())
        if missing := self._missing & needed - sets.keys():
            raise ValueError(f"condition {condition!r} leaves {e.names[min(missing)]!r} without a value")
        return found

    @cached_property
    def _of_rates(self) -> set[int]:
        """The numbers of p on which rates depend."""
        return used(self._equations.slopes, "p")

    @cached_property
    def _of_start(self) -> set[int]:
        """The numbers of p on which initial values depend."""
        e = self._equations
        return used([e.state_at_start(name) for name in e.states], "p")

    def _problem(self, end: float) -> Problem:
        e = self._equations
        more: dict[str, Any] = {} if e.mass is None else {"mass": e.mass}
        if e.states:
            more["labels"] = e.states
        if self.model.events:
            more["events"] = self._machine.functions(self.model._differences)
        # The initial value is a formula of p, in which that of the problem does not occur.
        return Problem(self.model.fun, (0.0, end), np.ones(max(len(e.states), 1)), args=(self._p,), **more)

    @cached_property
    def _machine(self) -> Machine:
        machine = Machine(self.model._events, self._equations)
        machine.start(0.0, self._first_state.at(0.0, np.zeros(0), self._p), self._p)
        return machine

    @property
    def _states_at_start(self) -> list[Node]:
        e = self._equations
        return [e.state_at_start(name) for name in e.states] or [e.graph.node(1.0)]

    @cached_property
    def _first_state(self) -> ArrayFunction:
        return ArrayFunction(self._states_at_start)

    @cached_property
    def _start(self) -> Any:
        """The initial value as a function of (t, y, p)."""
        nodes = self._states_at_start
        formula = Formula("y0", lambda: nodes, (len(nodes),))
        if not self.model.events or self._machine.begins_quietly:
            return formula

        def after_events(t: float, y: Any, p: Any) -> Array:
            """Return the initial value after events that are triggered there."""
            machine = Machine(self.model._events, self._equations)
            return machine.start(t, np.ravel(formula(t, y, p)), np.array([*p], dtype=float))

        return after_events

    # Observables

    def _formulas(self, group: tuple[Any, ...]) -> tuple[Node, Node]:
        """Return an observable and its noise with placeholders filled in; that of decadic logarithms in units of
        natural ones."""
        name, observable_parameters, noise_parameters = group
        if group not in self._known:
            one = self._tables.observables[name]
            fixed: dict[str, str | float] = {}
            for kind, given, known in (
                ("observable", observable_parameters, one.placeholders),
                ("noise", noise_parameters, one.noise_placeholders),
            ):
                if known is None:
                    known = tuple(f"{kind}Parameter{i}_{name}" for i in range(1, len(given) + 1))
                if len(known) != len(given):
                    raise ValueError(f"a measurement of {name!r} fills {len(given)} of {len(known)} placeholders")
                fixed |= dict(zip(known, given, strict=True))
            words = self._translator(fixed)
            noise = words.number(parse(one.noise))
            self._known[group] = words.number(parse(one.formula)), noise * LN10 if one.scale == "log10" else noise
        return self._known[group]

    @cached_property
    def _known(self) -> dict[Any, tuple[Node, Node]]:
        return {}

    def _translator(self, fixed: Mapping[str, str | float]) -> Translator:
        """Return formulas of observables: symbols of the model, parameters, other observables, and placeholders."""
        e = self._equations

        def value(name: str) -> Node:
            if name in fixed:
                given = fixed[name]
                return value(given) if isinstance(given, str) else e.graph.node(given)
            if name in e.symbols:
                return e.value(name)
            if name in self._parameters:
                return e.graph.p(self._first + self._parameters.index(name))
            if name in self._tables.observables:
                return self._translator(fixed).number(parse(self._tables.observables[name].formula))
            raise ValueError(f"a formula uses {name!r}, which is neither in the model nor a parameter")

        return Translator(e.graph, value, e.rate, e.graph.t)


def _group(one: Measurement) -> tuple[str, tuple[str | float, ...], tuple[str | float, ...]]:
    """Return what data of one quantity share: observable and placeholders."""
    return one.observable, one.observable_parameters, one.noise_parameters


def _name(group: tuple[str, tuple[str | float, ...], tuple[str | float, ...]]) -> str:
    """Return a name for data of one quantity."""
    placeholders = [*group[1], *group[2]]
    return f"{group[0]}({', '.join(map(str, placeholders))})" if placeholders else group[0]


def numbers(parts: Sequence[Period], by_part: Sequence[Array], count: int) -> Array:
    """Return values (q, m) of experiments in the order of the measurement table."""
    found = np.empty(count)
    for part, values in zip(parts, by_part, strict=True):
        found[part.rows] = values[part.places]
    return found
