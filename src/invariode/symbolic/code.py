"""From expressions to functions: one pass for common subexpressions, one text for Python and for numba."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import sympy
from sympy.printing.pycode import PythonCodePrinter

from .._base.arguments import Array
from .._functions.compiled import CompiledFunction, compile

__all__ = ["Code", "Formula", "Function", "Pattern", "Piece", "System", "eliminated", "functions"]

#: The result of expressions: a Python function, or one for numba.
Function = CompiledFunction | Callable[..., Any]

#: The time in the code.
_TIME = sympy.Symbol("t", real=True)

#: Accelerations, if a linear system determines them.
_ACCELERATION = "a"

#: Jacobians with at least this many rows are sparse if at most this fraction of their entries can differ from zero.
_SPARSE_ROWS, _SPARSE_PART = 20, 0.25


class System(NamedTuple):
    """y' = (explicit, the first of mass⁻¹ force), in the symbols t, y[0], y[1], ..., p[0], p[1], ... of the code.

    Where there are constraints, the last of mass⁻¹ force are their multipliers.
    """

    y: Sequence[Any]
    explicit: Sequence[Any]  # the first components of y'
    mass: Any  # Matrix (k, k), k >= 0: at least as many as the other components
    force: Sequence[Any]
    factors: tuple[Any, Any] | None = None  # L, D with mass = L D Lᵀ, where D in floating point says more than mass

    def without(self, rows: Sequence[int]) -> System:
        """The same without some of the constraints, named by rows of the matrix."""
        stays = [i for i in range(len(self.force)) if i not in rows]
        return self._replace(mass=self.mass.extract(stays, stays), force=[self.force[i] for i in stays])


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
    """Generated code as a Python function of (t, y, *args); it can be pickled. Where it raises, its values are NaN.

    Its text is a string, or a function that makes it when it is needed first.
    """

    def __init__(
        self, name: str, text: str | Callable[[], str], size: int, layout: tuple[int, ...] | Pattern, arguments: bool
    ) -> None:
        self.__name__ = self.__qualname__ = name
        self._text, self._size, self._layout, self._arguments = text, size, layout, arguments
        self._code: Callable[..., Any] | None = None

    @property
    def text(self) -> str:
        """The source of the function."""
        if not isinstance(self._text, str):
            self._text = self._text()
        return self._text

    def __call__(self, t: float, y: Any, *args: float) -> Any:
        if self._code is None:
            self._code = _executed(self.__name__, self.text, vars(math))
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


def _executed(name: str, text: str, names: Mapping[str, Any]) -> Callable[..., Any]:
    namespace: dict[str, Any] = {**names, "np": np}
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


class Code(NamedTuple):
    """The functions of a system by name, and the pattern of the Jacobian of f if it is sparse."""

    functions: dict[str, Function]
    pattern: Pattern | None


class _Source(NamedTuple):
    """A function (t, y, out, p): its body, which calls formulas by name, and the lines of these."""

    body: list[str]
    formulas: dict[str, Callable[[], list[str]]]
    layout: tuple[int, ...] | Pattern


def functions(system: System, pieces: Iterable[Piece], compiled: bool, parameters: int) -> Code:
    """The functions f, its exact jac, and `pieces`.

    One pass finds the common subexpressions of all. But where accelerations are solved for, the Jacobian is derived,
    with its own pass, when a method needs it: explicit methods do not.
    """
    pieces = list(pieces)
    n = len(system.y)
    solved = len(system.force) > 0
    groups = [*(list(piece.values) for piece in pieces), [*system.explicit, *_matrices(system), *system.force]]
    rates = [] if solved else _rates(system)
    text = _Text([*groups, rates])
    sources = {piece.name: _plain(piece, *text.formula(i)) for i, piece in enumerate(pieces)}
    pattern = None
    at = len(pieces)
    if solved:
        motion = {"motion": text.formula(at)[0]}
        sources["f"] = _Source(_solved(system), motion, (n,))
        change = {"change": cache(lambda: _derived(system).formula(0)[0]())}
        sources["jac"] = _Source(_solved_jacobian(system), motion | change, (n, n))
    else:
        sources["f"] = _plain(Piece("f", system.explicit, (n,)), *text.formula(at))
        pattern = _sparse(rates, n)
        kept = None if pattern is None else [i * n + j for j in range(n) for i in _column(pattern, j)]
        piece = Piece("jac", rates, pattern or (n, n))
        sources["jac"] = _plain(piece, *text.formula(at + 1, kept))
    return Code(_compiled(sources, parameters) if compiled else _interpreted(sources, parameters), pattern)


def _plain(piece: Piece, lines: Callable[[], list[str]], full: bool) -> _Source:
    size = _size(piece.layout)
    zeros = [] if full else [f"for i in range({size}):", "    out[i] = 0.0"]
    name = f"formulas_of_{piece.name}"
    return _Source([*zeros, f"{name}(t, y, y, out, p)"], {name: lines}, piece.layout)


def _solved(system: System) -> list[str]:
    """out = (explicit, the first of mass⁻¹ force)."""
    n, explicit = len(system.y), len(system.explicit)
    return [
        *_accelerations(system),
        f"for i in range({explicit}):",
        "    out[i] = values[i]",
        f"for i in range({n - explicit}):",
        f"    out[{explicit} + i] = {_ACCELERATION}[i]",
    ]


def _solved_jacobian(system: System) -> list[str]:
    """The Jacobian of that: its rows solve mass · rows = ∂force/∂y - (∂mass/∂y) a."""
    n, k, explicit = len(system.y), len(system.force), len(system.explicit)
    return [
        *_accelerations(system),
        f"slopes = np.zeros({(explicit + k) * n})",
        f"change(t, y, {_ACCELERATION}, slopes, p)",
        f"rows = {_divided(system, f'slopes[{explicit * n}:].reshape(({k}, {n}))')}",
        f"for i in range({explicit * n}):",
        "    out[i] = slopes[i]",
        f"for i in range({n - explicit}):",
        f"    for j in range({n}):",
        f"        out[({explicit} + i) * {n} + j] = rows[i, j]",
    ]


def _accelerations(system: System) -> list[str]:
    """a = mass⁻¹ force."""
    k, names = len(system.force), ["left", "mass"] if system.factors else ["mass"]
    starts = [len(system.explicit) + i * k * k for i in range(len(names) + 1)]
    matrices = [
        f"{name} = values[{start}:{start + k * k}].reshape(({k}, {k}))"
        for name, start in zip(names, starts, strict=False)
    ]
    return [
        f"values = np.zeros({starts[-1] + k})",
        "motion(t, y, y, values, p)",
        *matrices,
        f"{_ACCELERATION} = {_divided(system, f'values[{starts[-1]}:]')}",
    ]


def _divided(system: System, right: str) -> str:
    """The text of mass⁻¹ right."""
    if system.factors is None:
        return f"np.linalg.solve(mass, {right})"
    inner = f"np.linalg.solve(mass, np.linalg.solve(left, {right}))"
    return f"np.linalg.solve(np.ascontiguousarray(left.T), {inner})"


def eliminated(system: System) -> System:
    """The same with factors of its mass, if eliminating coordinates with constant masses cancels terms of others.

    As with Euler's angles near gimbal lock: of I₁ sin²θ + I₃ cos²θ only the first term is left, which a mass matrix in
    floating point has lost where θ is small. Other masses stay as they are.
    """
    mass, n = system.mass, len(system.force)
    rest, left = mass.copy(), sympy.eye(n)
    waiting, cancels = set(range(n)), False
    while constant := [i for i in waiting if rest[i, i] != 0 and not rest[i, i].free_symbols & {*system.y, _TIME}]:
        pivot = constant[0]
        waiting.remove(pivot)
        coupled = [i for i in waiting if rest[i, pivot] != 0]
        for i in coupled:
            left[i, pivot] = rest[i, pivot] / rest[pivot, pivot]
        for i in coupled:
            for j in coupled:
                rest[i, j] = sympy.expand(rest[i, j] - left[i, pivot] * rest[pivot, j])
            cancels = cancels or _terms(rest[i, i]) < _terms(mass[i, i])
        for i in coupled:
            rest[i, pivot] = rest[pivot, i] = sympy.S.Zero
    return system._replace(factors=(left, rest)) if cancels else system


def _terms(expression: Any) -> int:
    return len(sympy.Add.make_args(sympy.expand(expression)))


def _interpreted(sources: dict[str, _Source], parameters: int) -> dict[str, Function]:
    """Functions of Python."""

    def text(name: str, source: _Source) -> str:
        parts = [_function(inner, "t, y, a, out, p", lines()) for inner, lines in source.formulas.items()]
        return "".join([*parts, _outer(name, source, parameters)])

    return {
        name: Formula(name, partial(text, name, source), _size(source.layout), source.layout, parameters > 0)
        for name, source in sources.items()
    }


def _compiled(sources: dict[str, _Source], parameters: int) -> dict[str, Function]:
    """Functions for numba."""
    from .machine import translated  # needs numba

    inner = {name: translated(name, lines) for source in sources.values() for name, lines in source.formulas.items()}
    return {
        name: compile(_executed(name, _outer(name, source, parameters), inner), inplace=True)
        for name, source in sources.items()
    }


def _outer(name: str, source: _Source, parameters: int) -> str:
    body = source.body if parameters else ["p = y  # there are none", *source.body]
    return _function(name, "t, y, out, p" if parameters else "t, y, out", body)


def _function(name: str, arguments: str, lines: list[str]) -> str:
    return "\n    ".join([f"def {name}({arguments}):", *(lines or ["pass"])]) + "\n"


def _size(layout: tuple[int, ...] | Pattern) -> int:
    return len(layout.indices) if isinstance(layout, Pattern) else math.prod(layout)


def _rates(system: System) -> list[Any]:
    """Rows of the Jacobian of the explicit part."""
    return [slope for e in system.explicit for slope in _gradient([e], system.y)]


def _derived(system: System) -> _Text:
    """Lines for these, then for ∂force/∂y - (∂mass/∂y) a with the accelerations a as symbols.

    The common subexpressions come first, then their derivatives, by the chain rule: each is small, and depends on few.
    """
    k, n = len(system.force), len(system.y)
    a = [sympy.Symbol(f"{_ACCELERATION}[{i}]", real=True) for i in range(k)]
    left = [
        sympy.Add(force, *(-system.mass[i, j] * a[j] for j in range(k) if system.mass[i, j] != 0))
        for i, force in enumerate(system.force)
    ]
    primal = _Text([[*system.explicit, *left]])
    slopes = {one: {j: sympy.S.One} for j, one in enumerate(system.y)}
    found: dict[Any, Any] = {}
    for name, expression in primal.found.items():
        found[name] = expression
        slopes[name] = {}
        for j, slope in _chained(expression, slopes).items():
            derivative = sympy.Symbol(f"{name}_{j}", real=True)
            found[derivative] = slope
            slopes[name][j] = slope if slope.is_Atom else derivative
    rows = [_chained(e, slopes) for e in primal.groups[0]]
    return _Text([[row.get(j, sympy.S.Zero) for row in rows for j in range(n)]], found)


def _chained(expression: Any, slopes: Mapping[Any, Mapping[int, Any]]) -> dict[int, Any]:
    """The derivatives of an expression with respect to the y that it depends on, of which its symbols have `slopes`."""
    parts: dict[int, list[Any]] = {}
    for one in sorted(expression.free_symbols & slopes.keys(), key=str):
        outer = expression.diff(one)
        for j, inner in slopes[one].items():
            parts.setdefault(j, []).append(outer * inner)
    sums = {j: sympy.Add(*terms) for j, terms in parts.items()}
    return {j: total for j, total in sums.items() if total != 0}


def _gradient(terms: Sequence[Any], y: Sequence[Any]) -> list[Any]:
    """The derivatives of a sum: of a long one, most terms do not depend on most of y."""
    known = [(term, term.free_symbols) for term in terms]
    return [sympy.Add(*(term.diff(one) for term, symbols in known if one in symbols)) for one in y]


def _matrices(system: System) -> list[Any]:
    """The entries of what f solves with."""
    return [e for matrix in system.factors or (system.mass,) for e in _flat(matrix)]


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
    """The text of groups of expressions with common subexpressions: those of `found`, or by a pass over all."""

    def __init__(self, groups: list[list[Any]], found: dict[Any, Any] | None = None) -> None:
        self.groups, self.found = groups, found or {}
        if found is None:
            names = sympy.numbered_symbols("x", real=True)
            pairs, reduced = sympy.cse([e for group in groups for e in group], symbols=names, order="none")
            ends = np.cumsum([0, *map(len, groups)])
            self.groups, self.found = [reduced[a:b] for a, b in pairwise(ends)], dict(pairs)
        self._printer = _Printer()

    def formula(self, group: int, kept: list[int] | None = None) -> tuple[Callable[[], list[str]], bool]:
        """Lines that store what is not zero, of all values or of those that are kept; and whether that is all."""
        values = self.groups[group] if kept is None else [self.groups[group][i] for i in kept]
        stored = [f"out[{i}] = {self._print(e)}" for i, e in enumerate(values) if e != 0]
        lines = [*self._assigned(values), *stored]
        return lambda: lines, len(stored) == len(values)

    def _assigned(self, values: Sequence[Any]) -> list[str]:
        """The subexpressions that the values need, in the order of the pass, in which each follows those it needs."""
        needed: set[Any] = set()
        waiting = [s for e in values for s in e.free_symbols if s in self.found]
        while waiting:
            if (one := waiting.pop()) not in needed:
                needed.add(one)
                waiting.extend(s for s in self.found[one].free_symbols if s in self.found)
        return [f"{one} = {self._print(e)}" for one, e in self.found.items() if one in needed]

    def _print(self, expression: Any) -> str:
        try:
            text: str = self._printer.doprint(expression)
        except NotImplementedError as error:
            found = sorted({str(one.func) for one in expression.atoms(sympy.Function)})
            raise ValueError(
                f"there is no code for one of {', '.join(found)}: use elementary functions or Piecewise ({error})"
            ) from None
        return text
