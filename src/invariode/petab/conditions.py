"""Conditions: runs of the model with the values of a condition, from a steady state or not, with derivatives.

The numbers p that all formulas depend on are those of the model, followed by the values of all parameters of the
problem. A run computes derivatives for the entries of p that estimated parameters set; a parameter that acts only by
way of the initial value, such as one of a pre-equilibration, has its own entry, on which f does not depend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array, quietly
from .._base.types import MethodName
from .._functions.directional import has_llvm
from .._functions.graph.arrays import ArrayFunction
from .._functions.graph.derivatives import jacobian
from .._functions.graph.function import GraphFunction
from .._functions.graph.nodes import in_order
from .._functions.graph.python import Formula
from .._problem.parameters import ParameterName
from .._problem.sensitivities import Sensitivities
from .._solve.problem import Problem
from .._studies.steady import Found, SteadyStates
from ..sbml.equations import used
from ..sbml.events import times_of_roots
from ..sbml.model import Model

_COMPARISONS = ("less", "less_equal", "equal", "not_equal")


class RunFailedError(RuntimeError):
    """A run did not reach the last datum, or no steady state was found."""


class Start(NamedTuple):
    """Start of a run.

    Attributes
    ----------
    p : ndarray
        The numbers of the formulas.
    y : ndarray, (n,)
        The state.
    slopes : ndarray, (n, k)
        Its derivatives for the estimated parameters.
    sources : dict of int
        Which estimated parameter sets an entry of p.
    """

    p: Array
    y: Array
    slopes: Array
    sources: dict[int, int]


class Course(NamedTuple):
    """States at the times of data, (n, m), and their derivatives, (n, k, m)."""

    states: Array
    slopes: Array


class Conditions:
    """The conditions of a problem.

    Parameters
    ----------
    model : Model
        The model, in which all symbols that parameters or conditions set are given.
    names : list of str
        All parameters of the problem.
    estimated : list of int
        Which of them are estimated.
    values : dict
        What conditions set: numbers or names of parameters, by condition and symbol.
    method, rtol, atol
        Of the runs.
    """

    def __init__(
        self,
        model: Model,
        names: Sequence[str],
        estimated: Sequence[int],
        values: Mapping[str, Mapping[str, float | str]],
        method: MethodName,
        rtol: float,
        atol: float,
    ) -> None:
        self.model, self._values = model, values
        self.equations = e = model._equations
        self._names, self._place = list(names), {name: i for i, name in enumerate(names)}
        self._column = {place: j for j, place in enumerate(estimated)}
        self._k = len(estimated)
        self._base = np.array(e.values)
        for name in e._given & {*e._index}:  # given symbols have their own unit, not that of the file
            self._base[e._index[name]] = self._in_own_unit(name)
        #: Where the values of the problem's parameters begin among p.
        self.first = len(e.names) + len(e.matched)
        self._method = method
        self._options: dict[str, Any] = {"rtol": rtol, "atol": atol}
        self._steady: dict[tuple[str, bytes], tuple[Array, Array]] = {}

    def _in_own_unit(self, name: str) -> float:
        e = self.equations
        number, one = e._number(name), e.contents.species.get(name)
        if one is None or one.initial_is_amount == one.is_amount:
            return number
        volume = e._number(one.compartment)
        return number * volume if one.is_amount else number / volume

    def _numbers(self, condition: str, theta: Array) -> tuple[Array, dict[int, int]]:
        """Return p for a condition, and which estimated parameters set its entries."""
        e = self.equations
        base, sources = self._base.copy(), {}
        set_by: dict[str, float | str] = {name: name for name in self._names if name in e._index}
        set_by |= {n: v for n, v in self._values.get(condition, {}).items() if n in e._index}
        for name, value in set_by.items():
            i = e._index[name]
            if not isinstance(value, str):
                base[i] = value
                continue
            if value not in self._place:
                raise ValueError(f"condition {condition!r} sets {name!r} to {value!r}, which is no parameter")
            place = self._place[value]
            base[i] = theta[place]
            if place in self._column:
                sources[i] = self._column[place]
        p = np.concatenate([base, np.ones(len(e.matched)), theta])
        for place, j in self._column.items():
            sources[self.first + place] = j
        if e.matched and not e._at_start(0.0, np.zeros(0), p, p[len(e.names) : self.first]):
            raise RunFailedError("the algebraic rules have no solution at the start")
        return p, sources

    @cached_property
    def _start_slopes(self) -> tuple[ArrayFunction, list[tuple[int, int]]]:
        """Return ∂y0/∂p as its entries and their places."""
        e = self.equations
        nodes = [e.state_at_start(name) for name in e.states]
        places = sorted(used(nodes, "p"))
        rows = jacobian(nodes, [e.graph.p(i) for i in places])
        entries = [(i, places[j], node) for i, row in enumerate(rows) for j, node in row.items()]
        return ArrayFunction([node for *_, node in entries]), [(i, j) for i, j, _ in entries]

    def start(self, before: str, condition: str, theta: Array, slopes: bool) -> Start:
        """Return the start of a condition's run: its initial values, or the steady state of another condition, except
        for states that the condition itself sets."""
        p, sources = self._numbers(condition, theta)
        y, S = self._initial(p, sources, slopes)
        if before:
            ys, Ss = self._at_rest(before, theta, slopes)
            e = self.equations
            keep = [e.place[n] for n in self._values.get(condition, {}) if n in e.place]
            ys, Ss = ys.copy(), Ss.copy()
            ys[keep], Ss[keep] = y[keep], S[keep]
            y, S = ys, Ss
        return Start(p, y, S, sources)

    def _initial(self, p: Array, sources: Mapping[int, int], slopes: bool) -> tuple[Array, Array]:
        e = self.equations
        y, S = e.initial_state(p), np.zeros((len(e.states), self._k))
        if slopes:
            values, places = self._start_slopes
            for (i, place), value in zip(places, values.at(0.0, np.zeros(0), p).tolist(), strict=True):
                if place in sources:
                    S[i, sources[place]] += value
        return y, S

    def _at_rest(self, condition: str, theta: Array, slopes: bool) -> tuple[Array, Array]:
        """Return the steady state of a condition from its initial values, with derivatives; that of the last parameters
        is kept."""
        key = condition, theta.tobytes()
        if key not in self._steady or (slopes and not self._steady[key][1].any()):
            self._steady = {known: found for known, found in self._steady.items() if known[1] == key[1]}
            p, sources = self._numbers(condition, theta)
            y, S = self._initial(p, sources, slopes)
            self._steady[key] = self.steady(Start(p, y, S, sources), slopes)
        return self._steady[key]

    def steady(self, start: Start, slopes: bool) -> tuple[Array, Array]:
        """Return the steady state to which a start leads, and its derivatives."""
        moving = self._moving(start) if slopes else []
        S0 = self._by_entry(start, moving) if slopes else None
        found = self._states_at_rest(tuple(moving)).at((start.p,), start.y, S0)
        if not isinstance(found, Found):
            raise RunFailedError(found.reason)
        if not slopes:
            return found.y, np.zeros((len(found.y), self._k))
        if found.slopes is None:
            raise RunFailedError("the steady state is not isolated: others with the same totals are beside it")
        return found.y, self._by_parameter(np.nan_to_num(found.slopes), moving, start.sources)

    def _states_at_rest(self, moving: tuple[int, ...]) -> SteadyStates:
        if moving not in self._rest:
            names = [ParameterName(f"p[{i}]", "args", 0, i) for i in moving]
            problem = self._problem(np.ones(self.first + len(self._names)), self._any_state, 1.0)
            self._rest[moving] = SteadyStates(problem, names, self._method)
        return self._rest[moving]

    @cached_property
    def _rest(self) -> dict[tuple[int, ...], SteadyStates]:
        return {}

    @cached_property
    def _any_state(self) -> Array:
        return np.ones(max(len(self.equations.states), 1))

    @cached_property
    def _fun(self) -> Any:
        slopes, n = self.equations.slopes, len(self.equations.states)
        formula = Formula("f", lambda: slopes or [self.equations.graph.node(0.0)], (n or 1,))
        return GraphFunction(formula) if has_llvm() else formula

    @cached_property
    def _uses(self) -> set[int]:
        """The entries of p on which f depends."""
        return used(self.equations.slopes, "p")

    def _problem(self, p: Array, y: Array, end: float) -> Problem:
        more: dict[str, Any] = {} if self.equations.mass is None else {"mass": self.equations.mass}
        return Problem(self._fun, (0.0, end), y if len(y) else [0.0], args=(p,), **more)

    def _moving(self, start: Start) -> list[int]:
        """Return the entries of p for which derivatives are computed: those that f depends on, and one for each
        parameter that acts by way of the initial value alone."""
        found = [i for i, _ in sorted(start.sources.items()) if i in self._uses]
        there = {start.sources[i] for i in found}
        own = {j: self.first + place for place, j in self._column.items()}
        return found + [own[j] for j in range(self._k) if j not in there and start.slopes[:, j].any()]

    def _by_entry(self, start: Start, moving: Sequence[int]) -> Array:
        """Return the derivatives of y0 for entries of p: the first one of a parameter has all of them."""
        S = np.zeros((len(start.y), len(moving)))
        seen: set[int] = set()
        for column, i in enumerate(moving):
            j = start.sources[i]
            if j not in seen:
                S[:, column] = start.slopes[:, j]
                seen.add(j)
        return S

    def _by_parameter(self, S: Array, moving: Sequence[int], sources: Mapping[int, int]) -> Array:
        """Return derivatives for parameters, (n, k, ...), of those for entries of p."""
        found = np.zeros((len(S), self._k, *S.shape[2:]))
        for column, i in enumerate(moving):
            found[:, sources[i]] += S[:, column]
        return found

    def course(self, start: Start, times: Array, slopes: bool) -> Course:
        """Return the states at sorted times, which may end with infinity."""
        finite = times[np.isfinite(times)]
        n, k = len(start.y), self._k
        states, S = np.empty((n, len(times))), np.zeros((n, k if slopes else 0, len(times)))
        if len(finite) and finite[-1] > 0:
            self._run(start, finite, slopes, states, S)
        else:
            states[:, : len(finite)] = start.y[:, None]
            if slopes:
                S[:, :, : len(finite)] = start.slopes[:, :, None]
        if len(finite) < len(times):
            y, at_rest = self.steady(start, slopes)
            states[:, len(finite) :] = y[:, None]
            if slopes:
                S[:, :, len(finite) :] = at_rest[:, :, None]
        return Course(states, S)

    def _run(self, start: Start, times: Array, slopes: bool, states: Array, S: Array) -> None:
        end, m = float(times[-1]), len(times)
        if self.model.events:
            if slopes:
                raise NotImplementedError("derivatives of a model with events")
            e = self.equations
            p = start.p[: len(e.names) + len(e.matched)]
            Y = self.model._course(
                0.0, np.unique(np.append(0.0, times)), p, start.y, False, self._method, dict(self._options), 0
            )
            states[:, :m] = Y[:, -m:] if len(Y) == len(states) else Y[:0, -m:]
            return
        moving = self._moving(start) if slopes else []
        problem = self._problem(start.p, start.y, end)
        if moving:
            scale = np.abs(start.p[moving])
            scale[scale == 0] = 1.0
            wanted = Sensitivities([f"args[0][{i}]" for i in moving], dy0dp=self._by_entry(start, moving), scale=scale)
            problem = problem.replace(sensitivities=wanted)
        with quietly():
            sol = problem.solve(
                self._method,
                t_eval=times,
                breakpoints=self._breakpoints(start.p, end, {*moving}),
                on_failure="return",
                **self._options,
            )
        if sol.status < 0:
            raise RunFailedError(sol.message)
        if len(states):
            states[:, :m] = sol.y
        if moving:
            S[:, :, :m] = self._by_parameter(sol.sensitivities, moving, start.sources)

    @cached_property
    def _differences(self) -> list[Any]:
        inside = [one for one in in_order(self.equations.slopes) if one.op in _COMPARISONS]
        found = [one.arguments[0] - one.arguments[1] for one in inside]
        return [one for one in found if not used([one], "y")]

    def _breakpoints(self, p: Array, end: float, moving: set[int]) -> list[float]:
        """Return times at which f changes its formula, except those that parameters move: their events are found."""
        fixed = [one for one in self._differences if not used([one], "p") & moving]
        return [t for t in times_of_roots(fixed, p) if 0 < t < end]
