"""A function of (t, y, *args) given by a graph: machine code for the core, one of Python's for everybody else."""

from __future__ import annotations

from typing import Any

from ..compiled import CompiledFunction, Shape
from .derivatives import tangent
from .nodes import in_order
from .python import Formula


class GraphFunction(CompiledFunction):
    """A formula that is compiled for the problem it is used in, like what `compile` returns, but by LLVM alone.

    Its complex form is its derivative: the imaginary parts of y are a direction, and those of the values f_y times it.

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

    def __reduce__(self) -> tuple[Any, ...]:
        return GraphFunction, (self.fun, self.elementary)

    @property
    def jitted(self) -> Any:
        return self.fun

    def _make(self, shape: Shape) -> Any:
        from .machine import Form, machine_code  # needs llvmlite

        outputs = self.fun.outputs
        if len(outputs) != shape.size or shape.second:
            raise TypeError(f"{self.__name__} has {len(outputs)} values of (t, y), expected {shape.size}")
        if shape.is_complex:
            outputs = [*outputs, *tangent(outputs)]
        own = self.elementary == "own"
        return machine_code(outputs, Form(shape.event, 1, shape.is_complex, shape.complex_time, own))

    @property
    def solves_systems(self) -> bool:
        """Whether it solves linear systems, which is done for one point at a time."""
        return any(node.op == "entry" for node in in_order(self.fun.outputs))

    def lane_code(self, lanes: int) -> Any:
        """The code for this many points side by side."""
        from .machine import Form, machine_code

        return machine_code(self.fun.outputs, Form(lanes=lanes, own=self.elementary == "own"))
