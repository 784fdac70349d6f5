"""Functions of the state and the parameters, such as observed quantities: values and derivatives along a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array, number, warn
from ..._functions.derivatives import Derivative, derivative_of
from ..._functions.graph.array_code import ArrayFunction
from ..._functions.graph.differentiation import jacobian
from ..._functions.graph.function import GraphFunction
from ..._functions.graph.nodes import Node, in_order
from ..._functions.graph.python import Formula
from ..._functions.layout import place_of, with_numbers
from ..._functions.with_arguments import Point
from ..._problem.invariants import AccuracyWarning
from ..._problem.parameters import ParameterName


class Curves(NamedTuple):
    """Quantities over time, (q, m), and their derivatives for the parameters of an experiment, (q, m, k); None: these
    were not wanted."""

    values: Array
    tangent: Array | None


class ParameterPlaces(NamedTuple):
    """Places of an experiment's parameters."""

    names: Sequence[str]  # the parameters, in the order of their values
    #: Numbers in the arguments and initial values, each with the parameter that sets it
    entries: Sequence[tuple[int, ParameterName]]
    args: tuple[Any, ...]  # the arguments in which they are

    def changes(self, values: Any) -> dict[int, dict[int, Any]]:
        """Return the numbers of the arguments that the parameters set, by argument and place."""
        found: dict[int, dict[int, Any]] = {}
        for j, one in self.entries:
            if one.kind == "args":
                found.setdefault(one.index, {})[one.item or 0] = values[j]
        return found

    def with_values(self, values: Any) -> tuple[Any, ...]:
        """Return the arguments with these values of the parameters."""
        return with_numbers(self.args, self.changes(values))


class Through:
    """The values of functions F(t, y, *args, **extras), one after the other, with derivatives along runs.

    - `functions`: the functions. Formulas are evaluated at all times at once, and so are Python functions that can be
      traced.
    - `extras`: keyword-only arguments of each function, with defaults
    - `settings`: the parameters, which may be keyword-only arguments as well
    - `at`: a point at which the functions are defined
    - `guesses`, (k,): values of the parameters there
    - `called`: name of the functions in messages
    """

    def __init__(
        self,
        functions: Sequence[Any],
        extras: Sequence[Mapping[str, float | None]],
        settings: ParameterPlaces,
        at: Point,
        guesses: Array,
        called: str,
    ) -> None:
        self._settings, self._n = settings, len(at.y)
        self._derivatives: Derivative | None = None
        self._fast: _ThroughGraph | None = None
        formulas = [_formula(one) for one in functions]
        if all(one is not None for one in formulas):
            nodes = [node for one in formulas if one is not None for node in one.outputs]
            places = {
                place_of(settings.args, one.index, one.item): j for j, one in settings.entries if one.kind == "args"
            }
            self._fast = _ThroughGraph(nodes, self._n, "p", places)
            return
        n, names = self._n, settings.names
        for one in extras:
            if missing := [name for name, value in one.items() if value is None and name not in names]:
                raise ValueError(
                    f"{called} needs {missing[0]}, which has no default: add it to the parameters, or give it one"
                )

        def together(t: Any, z: Any) -> Any:
            """Return the functions of t and (y, parameters), so that derivatives are along both at once."""
            args = settings.with_values(z[n:])
            found = []
            for function, own in zip(functions, extras, strict=True):
                given = {name: z[n + names.index(name)] if name in names else value for name, value in own.items()}
                found.append(np.ravel(np.asarray(function(t, z[:n], *args, **given))))
            return found[0] if len(found) == 1 else np.concatenate(found)

        whole = np.concatenate([at.y, guesses])
        self._derivatives = derivative_of(together, (None, len(whole)), at=Point(at.t, whole), called=called)
        if not getattr(functions[0], "solves_equations", False):  # of which users have no code
            _tell(self._derivatives)
        if (graph := self._derivatives.graph) is not None:
            try:
                self._fast = _ThroughGraph(graph.outputs, n, "y", {n + j: j for j in range(len(names))})
            except NotImplementedError:  # an operation that takes one time after the other
                self._fast = None

    def __call__(self, t: Array, y: Array, tangent: Array | None, values: Array, args: tuple[Any, ...]) -> Curves:
        """Return the quantities at times (m,) and states (n, m), with derivatives if `tangent` (n, m, k), those of the
        states for the parameters, is given."""
        if self._fast is not None:
            found = self._fast(t, y, tangent, values, args)
            whole = found.tangent is None or bool(np.isfinite(found.tangent).all())
            if whole or self._derivatives is None:
                return found
        assert self._derivatives is not None
        k, rows, slopes = len(values), [], []
        for i, time in enumerate(t.tolist()):
            z = np.concatenate([y[:, i], values])
            rows.append(self._derivatives.value(time, z))
            if tangent is not None:
                directions = np.hstack([tangent[:, i].T, np.eye(k)])  # of y by S, and of the parameters themselves
                slopes.append(self._derivatives.columns(time, z, np.zeros(k), directions, np.zeros((k, 0))))
        size = self._derivatives.m
        made = np.reshape(np.array(slopes), (len(t), k, size)).transpose(2, 0, 1) if tangent is not None else None
        return Curves(np.reshape(rows, (len(t), size)).T, made)


class OfNumbers:
    """A real function of numbers, with its derivatives.

    - `called`: name of the function in messages
    - `function`: the user's, of one or more numbers
    """

    def __init__(self, called: str, function: Callable[..., Any]) -> None:
        self._called, self._function = called, function
        self._derivative: Derivative | None = None

    def value(self, at: Array) -> float:
        """Return the function itself."""
        return number(f"the value of {self._called}", self._function(*at))

    def slopes(self, at: Array) -> Array:
        """Return the derivative with respect to each number, (n,)."""
        if self._derivative is None:
            self._derivative = derivative_of(
                lambda t, y: self._function(*y), (1, len(at)), at=Point(0.0, at), called=self._called
            )
            _tell(self._derivative)
        n = len(at)
        return self._derivative.columns(0.0, at, np.zeros(n), np.eye(n), np.zeros((n, 0)))[:, 0]


def _tell(made: Derivative) -> None:
    """Warn if derivatives are differences."""
    if made.how == "differences":
        warn(
            f"fit: the derivatives of {made.called} are differences, which are accurate to 1e-10 at best: it cannot be "
            "traced, and does not take complex numbers. Write it with NumPy's functions",
            AccuracyWarning,
        )


def _formula(function: Any) -> Formula | None:
    inside = function.fun if isinstance(function, GraphFunction) else function
    return inside if isinstance(inside, Formula) else None


class _ThroughGraph:
    """Nodes at many times at once, with their derivatives for y and for the parameters at `places` of p, or of y."""

    def __init__(self, nodes: Sequence[Node], n: int, op: str, places: Mapping[int, int]) -> None:
        self._n, self._op, self._count = n, op, len(nodes)
        self._values = ArrayFunction(nodes)
        used = {(one.op, one.value) for one in in_order(nodes) if one.op in ("y", "p")}
        states = sorted(i for kind, i in used if kind == "y" and i < n)
        own = sorted(i for kind, i in used if kind == op and i in places)
        entries = []
        if nodes:
            graph = nodes[0].graph
            variables = [*map(graph.y, states), *map(graph.y if op == "y" else graph.p, own)]
            for row, inside in enumerate(jacobian(nodes, variables)):
                for v, node in inside.items():
                    of_state = v < len(states)
                    entries.append((row, of_state, states[v] if of_state else places[own[v - len(states)]], node))
        self._entries = [one[:3] for one in entries]
        self._slopes = ArrayFunction([node for *_, node in entries])

    def __call__(self, t: Array, y: Array, tangent: Array | None, values: Array, args: tuple[Any, ...]) -> Curves:
        """See `Through`."""
        if self._op == "y":
            state: Any = [*y, *values.tolist()]
            p: Any = ()
        else:
            state, p = y, np.concatenate([np.ravel(one) for one in args]) if args else ()
        found = self._values.over(t, state, p)
        if tangent is None:
            return Curves(found, None)
        made = np.zeros((self._count, len(t), len(values)))
        slopes = self._slopes.over(t, state, p)
        for (row, of_state, place), slope in zip(self._entries, slopes, strict=True):
            if of_state:
                made[row] += slope[:, None] * tangent[place]
            else:
                made[row, :, place] += slope
        return Curves(found, made)
