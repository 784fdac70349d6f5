"""Functions of (t, y, *args) given by graphs: machine code for the core, Python's functions for everybody else."""

from __future__ import annotations

import inspect
from typing import Any, Literal

import numpy as np

from ..._base.arguments import Array
from ..compiled import CompiledFunction, Shape
from .nodes import Node, in_order
from .python import Formula
from .trace import Traced, trace
from .traced import TraceError


class OnGraph(CompiledFunction):
    """A function that is compiled from a graph, by LLVM alone.

    Attributes
    ----------
    exact : dict
        Its derivatives, by `Shape`.
    """

    def __init__(self, fun: Any, inplace: bool, elementary: str) -> None:
        super().__init__(fun, inplace, elementary)
        self.exact: dict[Shape, Any] = {}

    def graph(self, shape: Shape) -> list[Node] | None:
        """Its values for such arguments; None: it has no graph, and numba compiles it."""
        raise NotImplementedError

    def _make(self, shape: Shape) -> Any:
        outputs = None if shape.is_complex else self.graph(shape)
        if outputs is None:
            return super()._make(shape)
        from .machine import Form, machine_code  # needs llvmlite

        return machine_code(outputs, Form(returns=shape.event, own=self.elementary == "own"))

    def lane_code(self, shape: Shape, lanes: int) -> Any:
        """The code for this many points side by side; or why the function {f} has none; None: it has no graph."""
        outputs = self.graph(shape)
        if outputs is None:
            return None
        if any(node.op == "entry" for node in in_order(outputs)):
            return "{f} solves a linear system"
        from .machine import Form, machine_code

        return machine_code(outputs, Form(lanes=lanes, own=self.elementary == "own"))


class GraphFunction(OnGraph):
    """A formula as a compiled function.

    Parameters
    ----------
    formula : Formula
        The function.
    elementary : {"own", "libm"}
        As in `compile`.
    """

    fun: Formula

    def __init__(self, formula: Formula, elementary: str = "own") -> None:
        super().__init__(formula, inplace=False, elementary=elementary)
        self.how = "graph"

    @property
    def size(self) -> int:
        """How many values it has."""
        return len(self.fun.outputs)

    def made_again(self) -> tuple[Any, ...]:
        return GraphFunction, (self.fun, self.elementary)

    def graph(self, shape: Shape) -> list[Node]:
        if len(self.fun.outputs) != shape.size or shape.second:
            raise TypeError(f"{self.__name__} has {len(self.fun.outputs)} values of (t, y), expected {shape.size}")
        return self.fun.outputs


#: Where a graph is compared with its function: sizes of y, and the seed of the points.
_SIZES, _SEED = (1.0, 0.1, 10.0, 1.0, 0.5), 27
#: What roundoff may make of the difference of the two, in parts of the largest value.
_AGREEMENT = 1e-9


class TracedFunction(OnGraph):
    """A Python function that is called once with symbolic values when it is used in a problem.

    Parameters
    ----------
    fun, inplace, elementary
        As in `compile`.
    by : {"trace", "auto"}
        Whether numba may compile what cannot be traced.
    """

    def __init__(self, fun: Any, inplace: bool, elementary: str, by: Literal["trace", "auto"]) -> None:
        super().__init__(fun, inplace, elementary)
        self.by = by
        self._graphs: dict[Shape, list[Node] | None] = {}
        #: How args are handed over, by their number: one by one, or as one array.
        self._one_by_one: dict[int, bool] = {}

    def made_again(self) -> tuple[Any, ...]:
        return TracedFunction, (self.fun, self.inplace, self.elementary, self.by)

    def at(self, t: float, *vectors: Array, parameters: Array) -> Any:
        """The Python function, with the arguments of the problem as numbers one after the other."""
        count = len(parameters)
        known = self._one_by_one.get(count)
        if known or (known is None and self._takes(vectors, count)):
            try:
                return self.fun(t, *vectors, *parameters.tolist())
            except (TypeError, IndexError):  # of a number: it takes all of them as one array
                if known:
                    raise
        return super().at(t, *vectors, parameters=parameters)

    def _takes(self, vectors: tuple[Any, ...], count: int) -> bool:
        """Whether it can be called as f(t, y, a, b)."""
        try:
            inspect.signature(self.fun).bind(*["t", *vectors, *["out"] * self.inplace, *["a"] * count])
        except (TypeError, ValueError):
            return False
        return count > 0

    def graph(self, shape: Shape) -> list[Node] | None:
        key = Shape(shape.n, shape.size, shape.parameters, shape.event, shape.second)
        if key not in self._graphs:
            try:
                self._graphs[key] = self._traced(key)
                self.how = "trace"
            except TraceError as error:
                if self.by == "trace":
                    raise TypeError(
                        f'compile({self.__name__}): {error}. Change that, or leave by="trace" out'
                    ) from None
                self._graphs[key] = None
                self.how = f"numba, as {error}"
        return self._graphs[key]

    def _traced(self, shape: Shape) -> list[Node]:
        """The values, by the first way of handing over the arguments that works."""
        count = shape.parameters
        ways: list[tuple[tuple[int, ...], ...]] = [((count,),)] if count else [()]
        if self._takes(("y",) * len(shape.vectors), count):
            ways.insert(0, ((),) * count)
        errors = []
        for args in ways:
            try:
                inplace = shape.size if self.inplace and not shape.event else 0
                found = trace(self.fun, shape.n, args, second=shape.second, inplace=inplace)
                if len(found.outputs) != shape.size:
                    raise TraceError(f"{self.__name__} returns {len(found.outputs)} values, expected {shape.size}")
                self._compare(found, shape, args)
            except TraceError as error:
                errors.append(error)
                continue
            self._one_by_one[count] = args == ((),) * count and count > 0
            return found.outputs
        raise errors[0]

    def _compare(self, found: Traced, shape: Shape, args: tuple[tuple[int, ...], ...]) -> None:
        """The graph with the function itself, at scattered points."""
        formula = Formula(self.__name__, lambda: found.outputs, (shape.size,))
        rng = np.random.default_rng(_SEED)
        for size in _SIZES:
            t, y, p = rng.random(), size * rng.standard_normal(shape.n), rng.uniform(0.5, 2, shape.parameters)
            first = shape.n - shape.second
            vectors = [y[:first].copy(), *([y[first:].copy()] if shape.second else [])]
            out = np.full(shape.size, np.nan)
            given = [t, *vectors, *([out] if self.inplace and not shape.event else [])]
            given += p.tolist() if args != ((shape.parameters,),) else [p.copy()]
            try:
                with np.errstate(all="ignore"):
                    returned = self.fun(*given)
                    expected = out if self.inplace and not shape.event else np.ravel(np.asarray(returned, dtype=float))
            except Exception:  # whatever it raises where it is not defined
                continue
            values = np.asarray(formula(t, y, *p.tolist()))
            scale = np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
            wrong = np.isfinite(expected) & ~(np.abs(values - expected) <= _AGREEMENT * scale)
            if expected.shape != values.shape or (wrong & np.isfinite(values)).any():
                i = int(np.argmax(wrong)) if expected.shape == values.shape else 0
                raise TraceError(
                    f"{self.__name__} cannot be traced: at t = {t:.6g} its value {i} is {expected[i]:.17g}, that of "
                    f"the graph {values[i]:.17g}. It may be random, remember calls, or use what tracing does not see"
                )
