"""Graphs as Python's code: straight lines that assign floats, with the functions of `math`."""

from __future__ import annotations

import math
import operator
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..._base.arguments import Array
from ..._base.forks import cached_property
from .array_code import CALLED
from .nodes import ARITHMETIC, COMPARISONS, ELEMENTARY, Graph, LinearSystem, Node, as_rows, in_order

#: The name of the function that is executed.
_CODE = "graph_code"


def as_text(name: str, outputs: Sequence[Node], *, careful: bool = False) -> str:
    """The source of a function (t, y, p) of a list of floats each that returns the list of the values. Careful: where
    Python raises, the values are those of IEEE arithmetic."""
    nodes = [*in_order(outputs)]
    careful = careful or any(node.op == "select" for node in nodes)  # the branch not taken may have no value
    names: dict[Node, str] = {}
    lines = [f"def {name}(t, y, p):"]
    for node in nodes:
        text = _written(node, [names[one] for one in node.arguments], careful)
        if node.arguments and node.op != "entry":
            names[node] = f"x{len(lines)}"
            lines.append(f"    {names[node]} = {text}")
        else:
            names[node] = text
    return "\n".join([*lines, f"    return [{', '.join(names[one] for one in outputs)}]"]) + "\n"


class Pattern(NamedTuple):
    """Positions of the entries of a sparse matrix, in compressed columns."""

    indices: Array
    indptr: Array
    n: int

    @classmethod
    def of(cls, rows: Sequence[Mapping[int, Node]], n: int) -> Pattern:
        """Return the pattern of a matrix given by its rows of nodes by column."""
        places = sorted((j, i) for i, row in enumerate(rows) for j in row)
        counts = np.bincount([j for j, _ in places], minlength=n)
        return cls(np.array([i for _, i in places], dtype=int), np.concatenate([[0], np.cumsum(counts)]), n)

    def places(self) -> Iterator[tuple[int, int]]:
        """Row and column of each entry, in order."""
        columns = np.repeat(np.arange(self.n), np.diff(self.indptr))
        return zip(self.indices.tolist(), columns.tolist(), strict=True)

    def matrix(self, values: ArrayLike) -> Any:
        from scipy.sparse import csc_array

        return csc_array((np.asarray(values, dtype=float), self.indices, self.indptr), (self.n, self.n))


class Formula:
    """A graph as a Python function of (t, y, *args); it can be pickled. Where Python raises, its values are those of
    IEEE arithmetic: exp(1000) is infinite, and 1 / exp(1000) is 0.

    - `name`: name of the function
    - `outputs`: makes its values, one after the other, when they are first needed
    - `layout`: the shape of what it returns, or where the values of a sparse matrix are
    - `parameters`: names of its further arguments, if it takes them one by one
    """

    def __init__(
        self,
        name: str,
        outputs: Callable[[], Sequence[Node]],
        layout: tuple[int, ...] | Pattern,
        parameters: Sequence[str] = (),
    ) -> None:
        self.__name__ = self.__qualname__ = name
        self._outputs, self.layout, self.parameters = outputs, layout, tuple(parameters)

    @cached_property
    def outputs(self) -> list[Node]:
        """Nodes of the formula's values."""
        return list(self._outputs())

    @cached_property
    def text(self) -> str:
        """Source of the formula as a Python function (t, y, p)."""
        return as_text(self.__name__, self.outputs)

    @cached_property
    def _code(self) -> Callable[[float, list[float], Any], list[float]]:
        return self._executed(careful=False)

    @cached_property
    def _careful_code(self) -> Callable[[float, list[float], Any], list[float]]:
        return self._executed(careful=True)

    def _executed(self, *, careful: bool) -> Callable[[float, list[float], Any], list[float]]:
        namespace: dict[str, Any] = {**vars(math), "solved": solved, "sign": _sign, "bisect_right": bisect_right}
        namespace |= {"nan": math.nan, "inf": math.inf}
        namespace |= {f"ieee_{name}": _careful(name, function) for name, function in (ELEMENTARY | _OF_TWO).items()}
        exec(
            as_text(_CODE, self.outputs, careful=careful), namespace
        )  # its own name may be that of a function it calls
        made: Callable[[float, list[float], Any], list[float]] = namespace[_CODE]
        return made

    def __call__(self, t: float, y: Any, *args: Any) -> Any:
        p = np.concatenate([np.ravel(one) for one in args]).tolist() if args else ()
        at, state = float(t), np.asarray(y, dtype=float).tolist()
        try:
            found = self._code(at, state, p)
        except (ValueError, ArithmeticError):  # as math.sqrt(-1.0), math.exp(1000.0) and 1 / 0
            try:
                found = self._careful_code(at, state, p)
            except (ValueError, ArithmeticError):  # as floor of NaN: it cannot be evaluated here
                found = [math.nan] * len(self.outputs)
        if isinstance(self.layout, Pattern):
            return self.layout.matrix(found)
        return found if len(self.layout) == 1 else np.reshape(found, self.layout)

    def array(self, t: float, y: Any, *args: Any) -> Array:
        """Evaluate the formula and return its value as an array."""
        return np.array(self(t, y, *args))

    def __reduce__(self) -> tuple[Callable[..., Formula], tuple[Any, ...]]:
        return _restored, (self.__name__, *as_rows(self.outputs), self.layout, self.parameters)


def _restored(
    name: str,
    rows: list[tuple[str, Any, list[int]]],
    outputs: list[int],
    layout: tuple[int, ...] | Pattern,
    parameters: tuple[str, ...],
) -> Formula:
    graph = Graph()
    nodes: list[Node] = []
    for op, value, arguments in rows:
        value = LinearSystem(*value) if op == "solve" else value
        nodes.append(graph.make(op, *(nodes[i] for i in arguments), value=value))
    return Formula(name, lambda: [nodes[i] for i in outputs], layout, parameters)


def _written(node: Node, a: list[str], careful: bool) -> str:
    """The operation on names. Careful: with IEEE's value where Python raises."""
    op = node.op
    if careful and (op in ELEMENTARY or op in _OF_TWO):
        return f"ieee_{op}({', '.join(a)})"
    if op == "number":
        return f"({node.value!r})" if math.isfinite(node.value) else f'float("{node.value!r}")'
    if op in ("t", "y", "p"):
        return op if node.value is None else f"{op}[{node.value}]"
    if op in ARITHMETIC or op in COMPARISONS:
        return f"{a[0]} {(ARITHMETIC | COMPARISONS)[op]} {a[1]}"
    if op == "solve":
        k, m, places = node.value
        return f"solved([{', '.join(a)}], {k}, {m}{f', {places}' if places else ''})"
    if op == "entry":
        return f"{a[0]}[{node.value}]"
    if op == "piece":
        return f"float(bisect_right({node.value!r}, {a[0]}))"
    if op == "pick":
        return f"{node.value!r}[int({a[0]})]"
    if op in ELEMENTARY:
        return f"{op}({a[0]})"
    return _OTHERS[op].format(*a)


_OTHERS = {
    "negate": "-{0}",
    "power": "pow({0}, {1})",
    "atan2": "atan2({0}, {1})",
    "hypot": "hypot({0}, {1})",
    "modulo": "{0} % {1}",
    "minimum": "min({0}, {1})",
    "maximum": "max({0}, {1})",
    "abs": "abs({0})",
    "sign": "sign({0})",
    "floor": "float(floor({0}))",
    "ceil": "float(ceil({0}))",
    "and": "{0} and {1}",
    "or": "{0} or {1}",
    "not": "not {0}",
    "select": "({1} if {0} else {2})",
}


#: What raises for some pairs of numbers.
_OF_TWO: dict[str, Callable[..., float]] = {"divide": operator.truediv, "power": math.pow, "modulo": operator.mod}


def _careful(name: str, function: Callable[..., float]) -> Callable[..., float]:
    def value(*arguments: float) -> float:
        try:
            return function(*arguments)
        except (ValueError, ArithmeticError):
            if name not in CALLED:
                return math.nan
            with np.errstate(all="ignore"):
                return float(CALLED[name](*arguments))

    return value


def _sign(x: float) -> float:
    return math.copysign(1.0, x) if x else x


def solved(numbers: list[float], k: int, m: int, places: Sequence[int] = ()) -> list[float]:
    """NaN if the matrix is singular."""
    entries = np.zeros(k * k)
    entries[list(places) if places else slice(None)] = numbers[: -k * m]
    matrix, right = np.reshape(entries, (k, k)), np.reshape(numbers[-k * m :], (k, m))
    try:
        found: list[float] = np.linalg.solve(matrix, right).ravel().tolist()
    except np.linalg.LinAlgError:
        return [math.nan] * (k * m)
    return found
