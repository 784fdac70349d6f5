"""From expressions to functions: one pass for common subexpressions, one text for Python and for numba."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import sympy
from sympy.printing.pycode import PythonCodePrinter

from .._arguments import Array
from ..compiled import CompiledFunction, compile

__all__ = ["Formula", "Function", "Pattern", "Piece", "System", "functions", "jacobian_pattern"]

#: What expressions become: a Python function, or one for numba.
Function = CompiledFunction | Callable[..., Any]

#: Accelerations, where a linear system determines them.
_ACCELERATION = "a"

#: Jacobians of at least so many rows are sparse where at most this part of their entries can differ from zero.
_SPARSE_ROWS, _SPARSE_PART = 20, 0.25


class System(NamedTuple):
    """y' = (explicit, the first of mass⁻¹ force), in the symbols t, y[0], y[1], ..., p[0], p[1], ... of the code.

    Where there are constraints, the last of mass⁻¹ force are their multipliers.
    """

    y: Sequence[Any]
    explicit: Sequence[Any]  # the first components of y'
    mass: Any  # Matrix (k, k), k >= 0: at least as many as the other components
    force: Sequence[Any]


class Pattern(NamedTuple):
    """Where entries of a sparse matrix are, in compressed columns."""

    indices: Array
    indptr: Array
    n: int

    def matrix(self, values: Sequence[float]) -> Any:
        return sp.csc_array((np.asarray(values, dtype=float), self.indices, self.indptr), (self.n, self.n))


class Piece(NamedTuple):
    """What is to become a function: its values, flat, and what they are laid out as."""

    name: str
    values: Sequence[Any]
    layout: tuple[int, ...] | Pattern


class Formula:
    """Generated code as a Python function of (t, y, *args); it can be pickled. Where it raises, its values are NaN."""

    def __init__(self, name: str, text: str, size: int, layout: tuple[int, ...] | Pattern, arguments: bool) -> None:
        self.__name__ = self.__qualname__ = name
        self.text = text
        self._size, self._layout, self._arguments = size, layout, arguments
        self._code = _executed(name, text)

    def __call__(self, t: float, y: Any, *args: float) -> Any:
        out = [0.0] * self._size
        try:
            self._code(t, np.asarray(y).tolist(), out, *((args,) if self._arguments else ()))
        except (ValueError, ArithmeticError):  # as math.sqrt(-1.0) and 1 / 0: it cannot be evaluated here
            out = [math.nan] * self._size
        if isinstance(self._layout, Pattern):
            return self._layout.matrix(out)
        return out if len(self._layout) == 1 else np.reshape(out, self._layout)

    def __reduce__(self) -> tuple[type[Formula], tuple[Any, ...]]:
        return Formula, (self.__name__, self.text, self._size, self._layout, self._arguments)


def _executed(name: str, text: str) -> Callable[..., Any]:
    namespace: dict[str, Any] = {**vars(math), "np": np}
    exec(text, namespace)
    code: Callable[..., Any] = namespace[name]
    return code


class _Printer(PythonCodePrinter):  # type: ignore[misc]  # sympy has no types
    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": False, "strict": True})

    def _print_sign(self, expression: Any) -> str:
        x = self._print(expression.args[0])
        return f"(({x} > 0.0) - ({x} < 0.0))"

    # Derivatives of functions with corners and jumps, off these.
    def _print_Heaviside(self, expression: Any) -> str:  # noqa: N802 - sympy's name
        return f"float({self._print(expression.args[0])} > 0.0)"

    def _print_DiracDelta(self, expression: Any) -> str:  # noqa: N802
        return "0.0"


def functions(system: System, pieces: Iterable[Piece], compiled: bool, parameters: int) -> dict[str, Function]:
    """The functions f, its exact jac, and `pieces`, by name. One pass finds the common subexpressions of all."""
    pieces = list(pieces)
    n, k = len(system.y), len(system.force)
    matrix, right = _flat(system.mass), list(system.force)
    rates, inner = _jacobian_parts(system)
    groups = [*(list(piece.values) for piece in pieces), [*system.explicit, *matrix, *right], rates, inner]
    text = _Text(groups, parameters > 0)
    made = {piece.name: (text.plain(piece.name, i), piece.layout) for i, piece in enumerate(pieces)}
    slope, jacobian, motion = (len(pieces) + i for i in range(3))
    explicit = len(system.explicit)
    if k:
        made["f"] = text.solved("f", slope, explicit, n), (n,)
        made["jac"] = text.solved_jacobian("jac", (slope, jacobian, motion), explicit, n), (n, n)
    else:
        made["f"] = text.plain("f", slope), (n,)
        layout = _sparse(rates, n)
        kept = None if layout is None else [i * n + j for j in range(n) for i in _column(layout, j)]
        made["jac"] = text.plain("jac", jacobian, kept), (n, n) if layout is None else layout
    result: dict[str, Function] = {}
    for name, (source, layout_) in made.items():
        size = len(layout_.indices) if isinstance(layout_, Pattern) else math.prod(layout_)
        if compiled:
            result[name] = compile(_executed(name, source), inplace=True)
        else:
            result[name] = Formula(name, source, size, layout_, parameters > 0)
    return result


def jacobian_pattern(system: System) -> Pattern | None:
    """Where the Jacobian of f has entries, if it is worth being sparse."""
    return None if len(system.force) else _sparse(_jacobian_parts(system)[0], len(system.y))


def _jacobian_parts(system: System) -> tuple[list[Any], list[Any]]:
    """Rows of the Jacobian of the explicit part, and ∂force/∂y - (∂mass/∂y) a with the accelerations a as symbols."""
    y, k = system.y, len(system.force)
    rows = [slope for e in system.explicit for slope in _gradient([e], y)]
    a = [sympy.Symbol(f"{_ACCELERATION}[{i}]", real=True) for i in range(k)]
    inner = []
    for i, force in enumerate(system.force):
        inertia = [-system.mass[i, j] * a[j] for j in range(k)]
        inner += _gradient([*sympy.Add.make_args(force), *inertia], y)
    return rows, inner


def _gradient(terms: Sequence[Any], y: Sequence[Any]) -> list[Any]:
    """The derivatives of a sum: of a long one, most terms do not depend on most of y."""
    known = [(term, term.free_symbols) for term in terms]
    return [sympy.Add(*(term.diff(one) for term, symbols in known if one in symbols)) for one in y]


def _flat(matrix: Any) -> list[Any]:
    return list(matrix) if matrix is not None else []


def _sparse(entries: Sequence[Any], n: int) -> Pattern | None:
    places = [(j, i) for j in range(n) for i in range(n) if entries[i * n + j] != 0]
    if n < _SPARSE_ROWS or len(places) > _SPARSE_PART * n * n:
        return None
    counts = np.bincount([j for j, _ in places], minlength=n)
    return Pattern(np.array([i for _, i in places]), np.concatenate([[0], np.cumsum(counts)]), n)


def _column(pattern: Pattern, j: int) -> list[int]:
    rows: list[int] = pattern.indices[pattern.indptr[j] : pattern.indptr[j + 1]].tolist()
    return rows


class _Text:
    """The text of functions ``name(t, y, out, p)`` of groups of expressions with common subexpressions."""

    def __init__(self, groups: list[list[Any]], parameters: bool) -> None:
        names = sympy.numbered_symbols("x", real=True)
        found, reduced = sympy.cse([e for group in groups for e in group], symbols=names, order="none")
        ends = np.cumsum([0, *map(len, groups)])
        self._groups = [reduced[a:b] for a, b in pairwise(ends)]
        self._found: dict[Any, Any] = dict(found)
        self._head = "t, y, out, p" if parameters else "t, y, out"
        self._printer = _Printer()

    def plain(self, name: str, group: int, kept: list[int] | None = None) -> str:
        """out = the values, or those that are kept."""
        values = self._groups[group] if kept is None else [self._groups[group][i] for i in kept]
        return self._function(name, [*self._assigned(values), *self._stored("out", values)])

    def solved(self, name: str, group: int, explicit: int, n: int) -> str:
        """out = (explicit, the first of mass⁻¹ force)."""
        values = self._groups[group]
        return self._function(
            name,
            [
                *self._assigned(values),
                *self._stored("out", values[:explicit]),
                *self._accelerations(values[explicit:]),
                f"for i in range({n - explicit}):",
                f"    out[{explicit} + i] = {_ACCELERATION}[i]",
            ],
        )

    def solved_jacobian(self, name: str, groups: tuple[int, int, int], explicit: int, n: int) -> str:
        """The Jacobian of that: its rows solve mass · rows = ∂force/∂y - (∂mass/∂y) a."""
        slope, rates, inner = (self._groups[group] for group in groups)
        first = self._assigned([*slope[explicit:], *rates])
        return self._function(
            name,
            [
                *first,
                *self._stored("out", rates),
                *self._accelerations(slope[explicit:]),
                *(line for line in self._assigned([*slope[explicit:], *rates, *inner]) if line not in set(first)),
                f"right = np.zeros(({len(inner) // n}, {n}))",
                *self._entries("right", inner, n),
                "rows = np.linalg.solve(mass, right)",
                f"for i in range({n - explicit}):",
                f"    for j in range({n}):",
                f"        out[({explicit} + i) * {n} + j] = rows[i, j]",
            ],
        )

    def _accelerations(self, values: Sequence[Any]) -> list[str]:
        """a = mass⁻¹ force, from k² + k values."""
        k = math.isqrt(len(values))
        return [
            f"mass = np.zeros(({k}, {k}))",
            *self._entries("mass", values[: k * k], k),
            f"force = np.zeros({k})",
            *(f"force[{i}] = {self._print(e)}" for i, e in enumerate(values[k * k :]) if e != 0),
            f"{_ACCELERATION} = np.linalg.solve(mass, force)",
        ]

    def _entries(self, name: str, values: Sequence[Any], columns: int) -> list[str]:
        places = ((*divmod(at, columns), e) for at, e in enumerate(values))
        return [f"{name}[{i}, {j}] = {self._print(e)}" for i, j, e in places if e != 0]

    def _stored(self, name: str, values: Sequence[Any]) -> list[str]:
        zeros = [f"for i in range({len(values)}):", f"    {name}[i] = 0.0"] if any(e == 0 for e in values) else []
        return zeros + [f"{name}[{i}] = {self._print(e)}" for i, e in enumerate(values) if e != 0]

    def _assigned(self, values: Sequence[Any]) -> list[str]:
        """The subexpressions that the values need, in the order of the pass, in which each follows those it needs."""
        needed: set[Any] = set()
        waiting = [s for e in values for s in e.free_symbols if s in self._found]
        while waiting:
            if (one := waiting.pop()) not in needed:
                needed.add(one)
                waiting.extend(s for s in self._found[one].free_symbols if s in self._found)
        return [f"{one} = {self._print(e)}" for one, e in self._found.items() if one in needed]

    def _print(self, expression: Any) -> str:
        try:
            text: str = self._printer.doprint(expression)
        except NotImplementedError as error:
            found = sorted({str(one.func) for one in expression.atoms(sympy.Function)})
            raise ValueError(
                f"there is no code for one of {', '.join(found)}: use elementary functions or Piecewise ({error})"
            ) from None
        return text

    def _function(self, name: str, lines: list[str]) -> str:
        return "\n    ".join([f"def {name}({self._head}):", *(lines or ["pass"])]) + "\n"
