"""Functions of (t, y, *args) given by graphs: machine code for the core, Python's functions for everybody else."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ... import _core
from ..._base.arguments import Array
from ..compiled import CompiledFunction, Shape
from ..layout import TRUTHS, Arguments, Constant, Numbers, count_of
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

    def known(self, shape: Shape) -> Shape:
        """The shape with its arguments as they are handed over; functions that are traced alike have one."""
        return shape

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

    takes_any = True

    def __init__(self, fun: Any, inplace: bool, elementary: str, by: Literal["trace", "auto"]) -> None:
        super().__init__(fun, inplace, elementary)
        self.by = by
        self._graphs: dict[Shape, list[Node] | None] = {}
        #: How arguments are handed over: as they are, with those up to a rank as constants; None: all in one array.
        self._ways: dict[Shape, int | None] = {}

    def made_again(self) -> tuple[Any, ...]:
        return TracedFunction, (self.fun, self.inplace, self.elementary, self.by)

    def at(self, t: float, *vectors: Array, parameters: Array) -> Any:
        """The Python function, with the arguments of the problem."""
        arguments = _arguments(count_of(parameters))
        if self._takes(vectors, arguments):
            given = arguments.given(parameters)
            try:
                return self.fun(t, *vectors, *given)
            except (TypeError, IndexError):  # of a number: it takes all of them as one array
                if not arguments:
                    raise
        return super().at(t, *vectors, parameters=np.array(parameters))

    def _takes(self, vectors: Sequence[Any], arguments: Arguments) -> bool:
        """Whether it can be called as f(t, y, a, b)."""
        given = ["t", *vectors, *["out"] * self.inplace, *arguments.entries]
        try:
            inspect.signature(self.fun).bind(*given)
        except (TypeError, ValueError):
            return False
        return True

    def native(self, n: int, size: int, parameters: int, event: bool, second: int = 0) -> _core.Native:
        return self._machine_code(self.known(Shape(n, size, parameters, event, second)))

    def graph(self, shape: Shape) -> list[Node] | None:
        return self._graphs[self.known(shape)._replace(is_complex=False, real_time=False)]

    def constants(self, parameters: int) -> int:
        """Up to which rank the numbers of these arguments are constants of its code."""
        arguments = _arguments(parameters).fixed(TRUTHS)
        ways = [way for shape, way in self._ways.items() if shape.parameters == arguments]
        return max((way for way in ways if way is not None), default=TRUTHS)

    def known(self, shape: Shape) -> Shape:
        """The shape with its arguments as they are handed over; functions that are traced alike have one."""
        real = shape._replace(is_complex=False, real_time=False)
        if real in self._graphs:
            return shape
        arguments = _arguments(real.parameters)
        key = real._replace(parameters=arguments.fixed(TRUTHS))
        if key not in self._ways:
            self._ways[key] = self._find_way(real, arguments)
        way = self._ways[key]
        found = shape._replace(parameters=int(arguments) if way is None else arguments.fixed(way))
        real = found._replace(is_complex=False, real_time=False)
        if real not in self._graphs:  # the constants have other values than the first time
            try:
                self._graphs[real] = self._traced(real)
            except TraceError as error:
                raise self._untraceable(error) from None
        return found

    def _find_way(self, shape: Shape, arguments: Arguments) -> int | None:
        """The first way of handing over the arguments that can be traced."""
        errors = []
        ranks = sorted({TRUTHS, *arguments.ranks}) if self._takes(shape.vectors, arguments) else []
        ways = [(rank, shape._replace(parameters=arguments.fixed(rank))) for rank in ranks]
        whole = shape._replace(parameters=int(arguments))
        for way, handed in [*ways, *([(None, whole)] if arguments or not ways else [])]:
            try:
                self._graphs[handed] = self._traced(handed)
            except TraceError as error:
                errors.append(error)
                continue
            self.how = "trace" if way in (None, TRUTHS) else "trace, with arguments that are constants"
            return way
        if self.by == "trace" or any(isinstance(one, Constant) for one in arguments.entries):
            raise self._untraceable(errors[-1])
        self._graphs[whole] = None
        self.how = f"numba, as {errors[-1]}"
        return None

    def _untraceable(self, error: TraceError) -> TypeError:
        instead = ', or leave by="trace" out' if self.by == "trace" else ""
        return TypeError(f"compile({self.__name__}): {error}. Change that{instead}")

    def _traced(self, shape: Shape) -> list[Node]:
        """The values for arguments that are handed over like this."""
        whole = not isinstance(shape.parameters, Arguments)
        arguments = Arguments([Numbers(np.ones(shape.parameters), varying=True)]) if whole else shape.parameters
        arguments = arguments if (whole and shape.parameters) or not whole else Arguments([])
        inplace = shape.size if self.inplace and not shape.event else 0
        found = trace(self.fun, shape.n, arguments, second=shape.second, inplace=inplace)
        if len(found.outputs) != shape.size:
            raise TraceError(f"{self.__name__} returns {len(found.outputs)} values, expected {shape.size}")
        self._compare(found, shape, arguments)
        return found.outputs

    def _compare(self, found: Traced, shape: Shape, arguments: Arguments) -> None:
        """The graph with the function itself, at scattered points."""
        formula = Formula(self.__name__, lambda: found.outputs, (shape.size,))
        rng = np.random.default_rng(_SEED)
        own = arguments.values()
        for i, size in enumerate(_SIZES):
            t, y, p = rng.random(), size * rng.standard_normal(shape.n), rng.uniform(0.5, 2, len(own))
            p = np.where(arguments.known(), own, p) if i % 2 else own
            first = shape.n - shape.second
            vectors = [y[:first].copy(), *([y[first:].copy()] if shape.second else [])]
            out = np.full(shape.size, np.nan)
            given = [t, *vectors, *([out] if self.inplace and not shape.event else []), *arguments.given(p)]
            try:
                with np.errstate(all="ignore"):
                    returned = self.fun(*given)
                    expected = out if self.inplace and not shape.event else np.ravel(np.asarray(returned, dtype=float))
            except Exception:  # whatever it raises where it is not defined
                continue
            self._agree(t, np.asarray(formula(t, y, *p.tolist())), expected)

    def _agree(self, t: float, values: Array, expected: Array) -> None:
        scale = np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
        if expected.shape != values.shape:
            raise TraceError(f"{self.__name__} returns {expected.size} values, its graph {values.size}")
        wrong = np.isfinite(expected) & ~(np.abs(values - expected) <= _AGREEMENT * scale)
        if (wrong & np.isfinite(values)).any():
            i = int(np.argmax(wrong))
            raise TraceError(
                f"{self.__name__} cannot be traced: at t = {t:.6g} its value {i} is {expected[i]:.17g}, that of "
                f"the graph {values[i]:.17g}. It may be random, remember calls, or use what tracing does not see"
            )


def _in_one(count: int) -> Arguments:
    """So many numbers in one array."""
    return Arguments([Numbers(np.ones(count), varying=True)] if count else [])


def _arguments(parameters: int) -> Arguments:
    return parameters if isinstance(parameters, Arguments) else Arguments.single(parameters)
