"""Functions of (t, y, *args) given by graphs: machine code for the core, Python's functions for everybody else."""

from __future__ import annotations

import inspect
import random
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ... import _core
from ..._base.arguments import Array
from ..._base.forks import compiling
from ..compiled import CompiledFunction, condition_value
from ..layout import NO_ARGUMENTS, TRUTHS, ArgumentLayout, Constant, Shape
from .nodes import Node, TraceError, in_order
from .python import Formula

if TYPE_CHECKING:  # the tracer is imported when a function is traced
    from .trace import Traced


class OnGraph(CompiledFunction):
    """A function that is compiled from a graph, by LLVM alone.

    - `exact`: its derivatives, by `Shape`
    """

    def __init__(self, fun: Any, inplace: bool, elementary: str) -> None:
        super().__init__(fun, inplace)
        self.elementary = elementary

    def _forget(self) -> None:
        super()._forget()
        self.exact: dict[Shape, Any] = {}

    def graph(self, shape: Shape) -> list[Node] | None:
        """Return the nodes of its values for arguments of this shape; None if it has no graph and numba compiles it."""
        raise NotImplementedError

    def known(self, shape: Shape) -> Shape:
        """Return the shape with its arguments as they are handed over; functions that are traced alike have one."""
        return shape

    def _make(self, shape: Shape) -> Any:
        outputs = None if shape.is_complex else self.graph(shape)
        if outputs is None:
            return super()._make(shape)
        from .codes import machine_code  # needs llvmlite
        from .objects import CodeForm

        return machine_code(outputs, CodeForm(returns=shape.event, own=self.elementary == "own"))

    def lane_code(self, shape: Shape, lanes: int) -> Any:
        """The code for this many points side by side; or why the function {f} has none; None: it has no graph."""
        outputs = self.graph(shape)
        if outputs is None:
            return None
        if any(node.op == "entry" for node in in_order(outputs)):
            return "{f} solves a linear system"
        from .codes import machine_code
        from .objects import CodeForm

        return machine_code(outputs, CodeForm(lanes=lanes, own=self.elementary == "own"))


class GraphFunction(OnGraph):
    """A formula as a compiled function.

    - `formula`: the function
    - `elementary`: as in `compile`
    """

    fun: Formula

    def __init__(self, formula: Formula, elementary: str = "own", how: str = "graph") -> None:
        super().__init__(formula, inplace=False, elementary=elementary)
        self.how = how

    @property
    def size(self) -> int:
        """Number of values of the function."""
        return len(self.fun.outputs)

    def made_again(self) -> tuple[Any, ...]:
        return GraphFunction, (self.fun, self.elementary, self.how)

    def graph(self, shape: Shape) -> list[Node]:
        if len(self.fun.outputs) != shape.size or shape.second:
            raise TypeError(f"{self.__name__} has {len(self.fun.outputs)} values of (t, y), expected {shape.size}")
        return self.fun.outputs


#: Where a graph is compared with its function: sizes of y, and the seed of the points.
_SIZES, _SEED = (1.0, 0.1, 10.0, 1.0, 0.5, 30.0, 3.0), 27
#: The times, and whether y is positive there, where roots and logarithms are defined.
_TIMES, _POSITIVE = (0.3, 0.0, 3.0, 0.7, 30.0, 1000.0, 10.0), (False, False, False, True, False, True, True)
#: By how much the bound of roundoff may be exceeded: it is of first order.
_SAFETY = 16.0


class TracedFunction(OnGraph):
    """A Python function that is called once with symbolic values when it is used in a problem.

    - `fun`, `inplace`, `elementary`: as in `compile`
    - `by`: with "auto" numba may compile a function that cannot be traced
    """

    _takes_any = True

    def __init__(
        self, fun: Any, inplace: bool, elementary: str, by: Literal["trace", "auto"], is_complex: bool = False
    ) -> None:
        super().__init__(fun, inplace, elementary)
        self.by, self.is_complex = by, is_complex

    def _forget(self) -> None:
        super()._forget()
        self._of_complex: TracedFunction | None = None
        self._graphs: dict[Shape, list[Node] | None] = {}
        #: How arguments are handed over: as they are, with those up to a rank as constants; None: all in one array.
        self._ways: dict[Shape, int | None] = {}
        #: Graphs that have not been compared with the function in a run.
        self.outputs: list[list[Node]] = []

    def made_again(self) -> tuple[Any, ...]:
        return TracedFunction, (self.fun, self.inplace, self.elementary, self.by, self.is_complex)

    def of_complex(self) -> TracedFunction:
        """Return the function of complex y, which is traced as pairs of real numbers."""
        if self.is_complex:
            return self
        if self._of_complex is None:
            self._of_complex = TracedFunction(self.fun, self.inplace, self.elementary, self.by, is_complex=True)
        return self._of_complex

    def at(self, t: float, *vectors: Array, parameters: ArgumentLayout) -> Any:
        """Call the Python function with the arguments of the problem."""
        if self._binds([t, *vectors, *parameters.entries]):
            given = parameters.given(parameters.numbers)
            try:
                return self.fun(t, *vectors, *given)
            except (TypeError, IndexError):  # of a number: it takes all of them as one array
                if not parameters.size:
                    raise
        return super().at(t, *vectors, parameters=parameters)

    def _binds(self, given: Sequence[Any]) -> bool:
        """Return whether the function can be called with these arguments."""
        try:
            inspect.signature(self.fun).bind(*given)
        except (TypeError, ValueError):
            return False
        return True

    def native(
        self, n: int, size: int, parameters: ArgumentLayout = NO_ARGUMENTS, event: bool = False, second: int = 0
    ) -> _core.Native:
        return self._machine_code(self.known(Shape(n, size, parameters, event, second)))

    def graph(self, shape: Shape) -> list[Node] | None:
        return self._graphs[self.known(shape)._replace(is_complex=False, real_time=False)]

    def constants(self, parameters: ArgumentLayout) -> int:
        """Return the rank up to which the numbers of these arguments are constants of the code."""
        arguments = parameters.fixed(TRUTHS)
        ways = [way for shape, way in self._ways.items() if shape.parameters == arguments]
        return max((way for way in ways if way is not None), default=TRUTHS)

    def known(self, shape: Shape) -> Shape:
        """Return the shape with its arguments as they are handed over; functions that are traced alike have one."""
        real = shape._replace(is_complex=False, real_time=False)
        if real in self._graphs:
            return shape
        with compiling:
            arguments = real.parameters
            key = real._replace(parameters=arguments.fixed(TRUTHS))
            if key not in self._ways:
                self._ways[key] = self._find_way(real, arguments)
            way = self._ways[key]
            found = shape._replace(parameters=arguments.whole() if way is None else arguments.fixed(way))
            real = found._replace(is_complex=False, real_time=False)
            if real not in self._graphs:  # the constants have other values than the first time
                try:
                    self._graphs[real] = self._traced(real)
                except TraceError as error:
                    raise self._untraceable(error) from None
            return found

    def _find_way(self, shape: Shape, arguments: ArgumentLayout) -> int | None:
        """The first way of handing over the arguments that can be traced."""
        errors = []
        first = ["t", *shape.vectors, *["out"] * (self.inplace and not shape.event)]
        given = [*first, *arguments.entries]
        ranks = sorted({TRUTHS, *arguments.ranks}) if self._binds(given) else []
        ways = [(rank, shape._replace(parameters=arguments.fixed(rank))) for rank in ranks]
        whole = shape._replace(parameters=arguments.whole())
        for way, handed in [*ways, *([(None, whole)] if arguments.size or not ways else [])]:
            try:
                self._graphs[handed] = self._traced(handed)
            except TraceError as error:
                errors.append(error)
                continue
            self.how = "trace" if way in (None, TRUTHS) else "trace, with arguments that are constants"
            return way
        why = errors[-1] if len(arguments.entries) == 1 or not ways else errors[len(ways) - 1]
        if not ways and not self._binds([*first, "p"]):
            took, count = inspect.signature(self.fun), len(arguments.entries)
            raise TypeError(
                f"compile({self.__name__}): it takes {took}, and is called with {', '.join(first)} and {count} args"
            )
        if self.by == "trace" or self.is_complex or any(isinstance(one, Constant) for one in arguments.entries):
            raise self._untraceable(why)
        self._graphs[whole] = None
        self.how = f"numba, as {why}"
        return None

    def _check_call(self, names: list[str]) -> None:
        try:
            super()._check_call(names)
        except TypeError as error:  # of a function of several arguments, which only tracing takes as they are
            why = self.how.removeprefix("numba, as ")
            raise TypeError(f"compile({self.__name__}): {why}, and numba takes another form: {error}") from None

    def _cannot_compile(self, error: Exception, parameters: int = 0) -> TypeError:
        text = str(super()._cannot_compile(error, parameters))
        return TypeError(text if self.how == "numba" else f"{text}\nIt was left to {self.how}")

    def _untraceable(self, error: TraceError) -> TypeError:
        instead = ', or leave by="trace" out' if self.by == "trace" else ""
        return TypeError(f"compile({self.__name__}): {error}. Change that{instead}")

    def _traced(self, shape: Shape) -> list[Node]:
        """The values for arguments that are handed over like this; where y is complex and the function takes pairs of
        real numbers, as other machine code does, of these."""
        try:
            return self._followed(shape)
        except TraceError as error:
            if not self.is_complex:
                raise
            self.is_complex = False
            try:
                return self._followed(shape)
            except TraceError:
                self.is_complex = True
                raise error from None

    def _followed(self, shape: Shape) -> list[Node]:
        from .trace import trace

        inplace = shape.size if self.inplace and not shape.event else 0
        found = trace(
            self.fun,
            shape.n,
            shape.parameters,
            second=shape.second,
            inplace=inplace,
            is_complex=self.is_complex,
            conditions=shape.event,
        )
        if len(found.outputs) != shape.size:
            raise TraceError(f"{self.__name__} returns {len(found.outputs)} values, expected {shape.size}")
        self._compare(found, shape, shape.parameters)
        self.outputs.append(found.outputs)
        return found.outputs

    def _compare(self, found: Traced, shape: Shape, arguments: ArgumentLayout) -> None:
        """The graph with the function itself, at scattered points."""
        formula = Formula(self.__name__, lambda: found.outputs, (shape.size,))
        rng = random.Random(_SEED)  # numpy.random takes longer to import than all of this
        own = arguments.numbers
        for i, size in enumerate(_SIZES):
            t, y = _TIMES[i], size * np.array([rng.gauss(0, 1) for _ in range(shape.n)])
            p = np.array([rng.uniform(0.5, 2) for _ in own])
            y = np.abs(y) if _POSITIVE[i] else y
            p = np.where(arguments.known(), own, p) if i % 2 else own
            first = shape.n - shape.second
            vectors = [y[:first].copy(), *([y[first:].copy()] if shape.second else [])]
            out = np.full(shape.size, np.nan)
            kind = complex if self.is_complex else float
            vectors = [one.view(kind) for one in vectors]
            given = [t, *vectors, *([out.view(kind)] if self.inplace and not shape.event else []), *arguments.given(p)]
            try:
                with np.errstate(all="ignore"):
                    returned = self.fun(*given)
                    filled = self.inplace and not shape.event
                    returned = condition_value(returned) if shape.event else returned
                    expected = out if filled else np.ravel(np.asarray(returned, dtype=kind)).view(float)
            except Exception:  # whatever it raises where it is not defined
                continue
            try:
                values = np.asarray(formula(t, y, *p.tolist()))
            except (ArithmeticError, ValueError, IndexError) as error:
                raise TraceError(f"{self.__name__} cannot be traced: its graph raises {error!r}") from error
            if not np.isfinite(expected).all():
                values = np.where(np.isfinite(expected) & np.isfinite(values), values, expected)
            if objection := _difference(found.outputs, t, y, p, (values, expected)):
                raise TraceError(
                    f"{self.__name__} cannot be traced: at t = {t:.6g} {objection}. It may be random, remember calls, "
                    "or use what tracing does not see"
                )

    def disagreement(self, t: float, y: Array, values: Array, parameters: ArgumentLayout) -> str | None:
        """Describe how the values of the code differ from those of the Python function; None if they agree to
        roundoff."""
        try:
            with np.errstate(all="ignore"):
                expected = self._called(t, y, parameters, len(values))
        except Exception as error:  # whatever it raises
            return f"it raises {type(error).__name__}: {error}" if np.isfinite(values).all() else None
        outputs = self.graph(Shape(len(y), len(values), parameters, event=False))
        return None if outputs is None else _difference(outputs, t, y, parameters.numbers, (values, expected))

    def _called(self, t: float, y: Array, parameters: ArgumentLayout, size: int) -> Array:
        """The values of the Python function at one point."""
        kind = complex if self.is_complex else float
        y = y.copy().view(kind)
        if not self.inplace:
            return np.ravel(np.asarray(self.at(t, y, parameters=parameters), dtype=kind)).view(float)
        out = np.full(size, np.nan)
        self.at(t, y, out.view(kind), parameters=parameters)
        return out


def _difference(outputs: list[Node], t: float, y: Array, p: Array, found: tuple[Array, Array]) -> str | None:
    """Describe the values of a graph and the expected ones if they differ by more than roundoff; else return None."""
    values, expected = found
    if expected.shape != values.shape:
        return f"it has {expected.size} values, its graph {values.size}"
    wrong = ~((values == expected) | (np.isnan(values) & np.isnan(expected)))
    if not wrong.any():
        return None
    from .rounding import bounds

    wrong &= ~(np.abs(values - expected) <= _SAFETY * np.array(bounds(outputs, t, y.tolist(), p.tolist())))
    i = int(np.argmax(wrong))
    return f"its value {i} is {expected[i]:.17g}, that of the graph {values[i]:.17g}" if wrong[i] else None
