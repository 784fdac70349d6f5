"""Tracing: f, called with symbolic values, becomes a graph.

f itself is not changed: a copy of it runs, in which numpy, math and a few of Python's functions take traced values; its
helpers, methods and partial functions are copied too. Where Python asks whether a condition holds, one answer is given
and the other remembered; f runs again until all paths are known, and their outcomes become selections.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import PACKAGE, call_name, raised_in
from ..layout import ArgumentLayout, Numbers
from .complexes import TracedComplex, pair
from .copies import Copies
from .nodes import Graph, Node, TraceError
from .traced import TracedArray, cells_of, wrapped
from .universal import condition, number


class TraceLimits(NamedTuple):
    """Limits of tracing: paths through branches on values, decisions on one of them, nodes of the graph, and operations
    on all paths together. Nodes and operations are counted where a decision is taken, nodes also `anywhere`. None
    depends on the clock, so that the same function is always compiled by the same compiler. `numpy`: the names in NumPy
    that may be used; None: all."""

    paths: int = 512
    decisions: int = 60
    nodes: int = 200_000
    operations: int = 400_000  # about 5 s
    anywhere: bool = False
    numpy: frozenset[str] | None = None


#: For what a run does in passing: beyond these counts it does without.
IN_PASSING = TraceLimits(paths=16, decisions=8, nodes=5000, anywhere=True)


class Traced(NamedTuple):
    """A traced function."""

    outputs: list[Node]  # its values, one after the other
    shape: tuple[int, ...]  # shape of the returned value
    paths: int  # number of paths through the branches of the function


def trace(
    fun: Callable[..., Any],
    n: int,
    args: ArgumentLayout | None = None,
    *,
    second: int = 0,
    inplace: int = 0,
    is_complex: bool = False,
    conditions: bool = False,
    limits: TraceLimits | None = None,
) -> Traced:
    """The graph of a function of (t, y, *args).

    - `fun`: the function
    - `n`: the components of y
    - `args`: its further arguments, whose numbers are the parameters, one after the other
    - `second`: the function takes two vectors, of n - second and second components, which follow each other in y
    - `inplace`: number of values that the function writes to an argument after these; 0: it returns them
    - `is_complex`: the function takes complex y, of n / 2 components, and returns complex values: all as pairs of real
      numbers
    - `conditions`: truth values count as 1 or -1, as those of events do, not as 1 or 0
    - `limits`: beyond them it is refused

    Returns Traced:

    Raises TraceError: It cannot be traced: the message names the line and the reason.
    """
    args, limits = ArgumentLayout() if args is None else args, limits or TraceLimits()
    given = (fun, n - second, second, args, inplace, limits, is_complex, conditions)
    first = _Tracing(*given)
    try:
        found = first.traced(alone=True)
    except TraceError:  # of too many decisions, say, of which selections need none
        if not first.decides:
            raise
        found = None
    if found is not None:
        return found
    try:
        found = _Tracing(*given, selections=True).traced()
    except TraceError:  # an index, say, that only a single path knows
        found = None
    found = found or _Tracing(*given).traced()
    assert found is not None
    return found


#: What f raises where it is not defined.
_UNDEFINED = (ArithmeticError, ValueError, AssertionError, RuntimeError)


def _is_of_user(error: BaseException) -> bool:
    """Return whether the user's code raised an error, and neither NumPy nor the tracer."""
    file = raised_in(error)
    unlike = (RecursionError, NotImplementedError)
    return not (isinstance(error, unlike) or file.startswith(PACKAGE) or "site-packages" in file)


class _Tracing:
    """Trace of one function, along each of its paths."""

    def __init__(
        self,
        fun: Callable[..., Any],
        n: int,
        second: int,
        args: ArgumentLayout,
        inplace: int,
        limits: TraceLimits,
        is_complex: bool,
        conditions: bool,
        selections: bool = False,
    ) -> None:
        self._name, self._sizes, self._args = call_name(fun, "f"), [n, *([second] if second else [])], args
        self._inplace, self._limits, self._is_complex = inplace, limits, is_complex
        self._number, self.numpy = condition if conditions else number, limits.numpy
        self._graph = Graph(limits.nodes if limits.anywhere else None)
        self._copies = Copies(self, selections)
        self._fun = self._copies.of(fun)
        self._decisions: list[tuple[Node, bool, bool]] = []  # condition, answer, whether the other one has been given
        self._at = 0

    @property
    def decides(self) -> bool:
        """True if a condition has been decided on the path that was followed last."""
        return bool(self._decisions)

    def traced(self, alone: bool = False) -> Traced | None:
        """The graph, or None if it has several paths and `alone` is true."""
        known: list[tuple[list[tuple[Node, bool]], list[Node] | None]] = []
        shape: tuple[int, ...] = ()
        while True:
            self._at = 0
            found = self._followed(known)
            outputs = None if found is None else [self._number(one) for one in found.ravel()]
            if found is not None:
                shape = found.shape
            known.append(([(condition, answer) for condition, answer, _ in self._decisions[: self._at]], outputs))
            while self._decisions and self._decisions[-1][2]:
                self._decisions.pop()
            if not self._decisions:
                break
            if alone:
                return None
            condition, answer, _ = self._decisions[-1]
            self._decisions[-1] = (condition, not answer, True)
            if len(known) >= self._limits.paths:
                raise TraceError(self._refused(f"more than {self._limits.paths} paths through its branches"))
        sizes = {len(outputs) for _, outputs in known if outputs is not None}
        if len(sizes) != 1:
            raise TraceError(self._refused(f"its branches return {', '.join(map(str, sorted(sizes)))} values"))
        size = sizes.pop()
        undefined = [self._graph.node(math.nan)] * size
        return Traced(self._merged([(d, o or undefined) for d, o in known], 0), shape, len(known))

    def _followed(self, known: Sequence[Any]) -> Any:
        """Return the values on one path; None if f raises there, as it does for values where it is not defined."""
        graph = self._graph
        given: list[Any] = [wrapped(graph.t, self.decide)]
        first = 0
        for size in self._sizes:
            y = self._array([graph.y(first + i) for i in range(size)], (size,))
            given.append(TracedComplex(y[::2].copy(), y[1::2].copy()) if self._is_complex else y)
            first += size
        out: Any = self._array([graph.node(math.nan)] * self._inplace, (self._inplace,)) if self._inplace else None
        if out is not None and self._is_complex:
            out = TracedComplex(out[::2].copy(), out[1::2].copy())
        given += [] if out is None else [out]
        try:
            given += self._args.made(self._parameter, self._copies.of)
            with np.errstate(all="ignore"):  # what there is to say of numbers in it, a call of the function itself says
                returned = self._fun(*given)
            values = out if out is not None else returned
            if self._number is condition and isinstance(values, (bool, np.bool_)):  # of a branch
                values = 1.0 if values else -1.0
            return cells_of(pair(values, self._real).interleaved() if self._is_complex else values, graph)
        except TraceError as error:
            raise TraceError(self._refused(str(error), error)) from None
        except _UNDEFINED as error:
            if self._decisions and _is_of_user(error) and "read-only" not in str(error):
                return None
            raise TraceError(self._refused(f"{type(error).__name__}: {error}", error)) from error
        except Exception as error:
            raise TraceError(self._refused(f"{type(error).__name__}: {error}", error)) from error

    @property
    def _real(self) -> TracedArray:
        return self._array([self._graph.t], ())

    def _parameter(self, numbers: Numbers, place: int) -> Any:
        """Return an argument of the traced function: its value if it is a constant, else an array of parameters."""
        if numbers.fixed:
            return self._copies.of(numbers.value)
        cells = self._array([self._graph.p(place + i) for i in range(math.prod(numbers.shape))], numbers.shape)
        cells.cells.flags.writeable = False
        return cells

    def _array(self, nodes: Sequence[Node], shape: tuple[int, ...]) -> TracedArray:
        cells = np.empty(len(nodes), dtype=object)
        cells[:] = nodes
        return TracedArray(cells.reshape(shape), self.decide)

    def decide(self, condition: Node) -> bool:
        """Return the truth value of a condition for Python: as decided before, or true."""
        if condition.op == "number":
            return bool(condition.value)
        for known, answer, _ in self._decisions[: self._at]:
            if known is condition:
                return answer
        if self._at == len(self._decisions):
            if len(self._decisions) >= self._limits.decisions:
                raise TraceError(
                    f"more than {self._limits.decisions} decisions on one path: a loop that ends where values do"
                )
            for count, most in (
                (len(self._graph), self._limits.nodes),
                (self._graph.operations, self._limits.operations),
            ):
                if count > most:
                    raise TraceError(f"more than {most} operations")
            self._decisions.append((condition, True, False))
        elif self._decisions[self._at][0] is not condition:
            raise TraceError("it does not do the same for the same values: it is random, or remembers calls")
        answer = self._decisions[self._at][1]
        self._at += 1
        return answer

    def _merged(self, paths: Sequence[tuple[list[tuple[Node, bool]], list[Node]]], depth: int) -> list[Node]:
        """The outcomes of paths that agree in their first decisions, as selections by the further ones."""
        if len(paths) == 1:
            return paths[0][1]
        condition = paths[0][0][depth][0]
        yes, no = (
            self._merged([one for one in paths if one[0][depth][1] is answer], depth + 1) for answer in (True, False)
        )
        return [self._graph.select(condition, a, b) for a, b in zip(yes, no, strict=True)]

    def _refused(self, why: str, error: BaseException | None = None) -> str:
        line = ""
        position = error.__traceback__ if error is not None else None
        while position is not None:
            code = position.tb_frame.f_code
            if not code.co_filename.startswith(PACKAGE) and "site-packages" not in code.co_filename:
                line = f" at line {position.tb_lineno} of {code.co_filename}"
            position = position.tb_next
        return f"{self._name} cannot be traced{line}: {why}"
