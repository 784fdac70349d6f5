"""F as a graph of t, the unknowns and their derivatives, and the equations that only rename unknowns."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import call_name
from .._functions.compiled import CompiledFunction
from .._functions.graph.function import TracedFunction
from .._functions.graph.nodes import Node, in_order
from .._functions.layout import TRUTHS, Listed, Numbers, Shape, layout_of
from .expressions import is_zero, leaves, row_of, substituted
from .reduction import GivenValues


class UntracedError(TypeError):
    """F has no graph: its structure is not known."""


class TracedEquations(NamedTuple):
    """F as a graph of t, y, y', ..., and the parameters that stay variable."""

    outputs: list[Node]
    args: tuple[Any, ...]
    names: tuple[str, ...]


def traced_equations(F: Any, args: tuple[Any, ...], n: int, order: int) -> TracedEquations:
    """Return the graph of F. Arguments without which it cannot be traced, such as counts of loops, are constants of
    it."""
    fun = F.fun if isinstance(F, TracedFunction) else F
    if isinstance(F, CompiledFunction) and fun is F:
        raise TypeError("F must be a Python function, or one that compile has traced")

    def residuals(t: Any, z: Any, *rest: Any) -> Any:
        return fun(t, *(z[level * n : (level + 1) * n] for level in range(order + 1)), *rest)

    residuals.__name__ = residuals.__qualname__ = call_name(fun, "F")
    arguments = layout_of(args)
    size = _size(residuals, args, n, order)
    made = TracedFunction(residuals, inplace=False, elementary="own", by="trace")
    try:
        shape = made.known(Shape((order + 1) * n, size, arguments, event=False))
    except TypeError as error:
        why = str(error).removesuffix(', or leave by="trace" out').removesuffix(". Change that")
        raise UntracedError(
            f"F cannot be traced: {why.partition(': ')[2].removeprefix('F cannot be traced: ') or why}"
        ) from None
    outputs = made.graph(shape)
    assert outputs is not None
    rank = made.constants(arguments)
    names, place = _argument_names(fun, len(args), order), 0
    renumbered: dict[int, int] = {}
    kept, kept_names = [], []
    for one, entry, name in zip(args, arguments.entries, names, strict=True):
        count = layout_of([one]).size
        if _is_variable(entry, rank):
            for k in range(count):
                renumbered[place + k] = len(renumbered)
            kept.append(one)
            kept_names.append(name)
        place += count
    graph = outputs[0].graph
    used = [node for node in in_order(outputs) if node.op == "p"]
    outputs = substituted(outputs, {node: graph.p(renumbered[node.value]) for node in used})
    return TracedEquations(outputs, tuple(kept), tuple(kept_names))


def _is_variable(entry: Any, rank: int) -> bool:
    if isinstance(entry, Numbers):
        return entry.rank > max(rank, TRUTHS)
    return isinstance(entry, Listed) and all(_is_variable(one, rank) for one in entry.entries)


def _size(residuals: Any, args: tuple[Any, ...], n: int, order: int) -> int:
    """Return the number of values of F: as many as unknowns, unless a call shows otherwise."""
    try:
        with np.errstate(all="ignore"):
            return int(np.size(residuals(0.0, np.ones((order + 1) * n), *args)))
    except (ArithmeticError, ValueError, IndexError):
        return n


def _argument_names(fun: Any, count: int, order: int) -> list[str]:
    try:
        known = [one.name for one in inspect.signature(fun).parameters.values() if one.kind in (0, 1)][2 + order :]
    except (TypeError, ValueError):
        known = []
    return [known[i] if i < len(known) else f"args[{i}]" for i in range(count)]


def aliases(equations: Sequence[Node], n: int) -> tuple[dict[int, GivenValues], set[int]]:
    """Find equations x_k = ±x_j^(order), such as u = x': which unknowns they rename, and the equations.

    Without them the first-order form of an equation has the structure of the equation itself.
    """
    found: dict[int, GivenValues] = {}
    gone: set[int] = set()
    for i, equation in enumerate(equations):
        used = sorted(leaves([equation]))
        if len(used) != 2 or any(one.op in ("t", "p") for one in in_order([equation])):
            continue
        row = row_of(equation, used)
        if len(row) < 2 or any(one.op != "number" or abs(one.value) != 1 for one in row.values()):
            continue
        graph = equation.graph
        if not is_zero(substituted([equation], {graph.y(one): graph.node(0.0) for one in used})[0]):
            continue
        low, high = used
        k, (order, j) = low % n, divmod(high, n)
        if low >= n or k == j or k in found or j in found or any(k == one.j for one in found.values()):
            continue
        found[k] = GivenValues(j, order, -row[high].value / row[low].value)
        gone.add(i)
    return found, gone
