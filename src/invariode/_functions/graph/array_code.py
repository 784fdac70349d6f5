"""Graphs as NumPy code: values at many times at once, with the rules of IEEE arithmetic for what is not defined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..._base.arguments import Array
from .nodes import ARITHMETIC, COMPARISONS, Node, in_order

#: NumPy's functions for operations.
CALLED: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{name: getattr(np, name) for name in ("expm1", "log1p", "log10", "log2", "exp2", "cbrt", "hypot", "minimum")},
    **{name: getattr(np, name) for name in ("maximum", "abs", "sign", "floor", "ceil")},
    **{f"a{name}": getattr(np, f"arc{name}") for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "atan2": np.arctan2,
    "power": np.power,
    "divide": np.divide,
    "modulo": np.mod,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "select": np.where,
    "negate": np.negative,
}


class ArrayFunction:
    """The values of a graph as a function of t, y (n,) and p, or of times (m,) and states (n, m) at once.

    A division by zero is infinite or NaN, as in machine code; nothing raises, and nothing warns. It returns a list with
    an entry for each output: a number, or an array of shape (m,).
    """

    def __init__(self, outputs: Sequence[Node]) -> None:
        self._count = len(outputs)
        lines, known = ["def values(t, y, p):"], dict[str, Any]()
        names: dict[Node, str] = {}
        for node in in_order(outputs):
            if node.op == "number":
                names[node] = f"c{len(known)}"
                known[names[node]] = np.float64(node.value)
            elif node.op in ("t", "y", "p"):
                names[node] = "t" if node.op == "t" else f"{node.op}[{node.value}]"
            else:
                name = names[node] = f"x{len(lines)}"
                lines.append(f"    {name} = {_written(node, [names[one] for one in node.arguments], known)}")
        lines.append(f"    return [{', '.join(names[one] for one in outputs)}]")
        exec("\n".join(lines), known)
        #: The same function, without switching NumPy's warnings off.
        self.code: Callable[..., list[Any]] = known["values"]

    def __call__(self, t: Any, y: Array, p: Array) -> list[Any]:
        with np.errstate(all="ignore"):
            return self.code(np.asarray(t, dtype=float)[()], y, p)

    def at(self, t: float, y: Array, p: Array) -> Array:
        """The values at one point as an array, (m,)."""
        return np.array(self(t, y, p), dtype=float)

    def over(self, t: Array, y: Array, p: Array) -> Array:
        """The values at m times, (outputs, m)."""
        found = np.empty((self._count, len(t)))
        for row, one in zip(found, self(t, y, p), strict=True):
            row[:] = one
        return found


def _written(node: Node, a: list[str], known: dict[str, Any]) -> str:
    op = node.op
    if op in ARITHMETIC or op in COMPARISONS:
        return f"{a[0]} {(ARITHMETIC | COMPARISONS)[op]} {a[1]}"
    if op in ("erf", "erfc"):
        from scipy import special  # no function of NumPy's

        known[op] = getattr(special, op)
    elif op in ("piece", "pick"):
        table = f"table{len(known)}"
        known |= {"np": np, table: np.array(node.value)}
        if op == "piece":
            return f"np.searchsorted({table}, {a[0]}, side='right') * 1.0"
        return f"{table}[np.asarray({a[0]}, dtype=int)]"
    elif op in ("solve", "entry"):
        raise NotImplementedError("solutions of linear systems for many times at once")
    else:
        known[f"of_{op}"] = CALLED[op]
        op = f"of_{op}"
    return f"{op}({', '.join(a)})"
