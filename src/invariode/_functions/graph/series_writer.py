"""Common base of the writers of Taylor coefficients, unrolled or in loops: the form of the code, and reciprocals."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

from llvmlite import ir

from ..llvm_values import Value
from .machine import Writer
from .objects import SeriesForm
from .operations import DOUBLE, POINTER, Operations


class Inverse(NamedTuple):
    """1/d as a sum of two numbers, exact to twice the digits: the quotient x/d is the nearest number, but for one in
    2^50 that is the next one (Brisebarre and Muller 2008). A division would take longer."""

    high: Value
    low: Value

    def times(self, x: Value) -> Value:
        """The quotient."""
        return x.times_plus(self.high, x * self.low)


def inverse_of(d: float) -> tuple[float, float]:
    """Return the reciprocal of a number as a sum of two doubles."""
    high = 1 / d
    return high, float((1 - Fraction(high) * Fraction(d)) / Fraction(d))


class SeriesWriter(Writer):
    """Writes the function of Taylor coefficients."""

    def __init__(self, module: Any, form: SeriesForm) -> None:
        numbers = DOUBLE if form.lanes == 1 else POINTER
        arguments = {"t": numbers, "unit": numbers, "y": POINTER, "out": POINTER, "p": POINTER}
        if form.lanes > 1:
            arguments = {"unused": POINTER, **arguments}
        super().__init__(module, form.own, form.lanes, arguments, ir.VoidType())
        self._form = form
        for name in ("y", "out", "p"):
            self._given[name].add_attribute("noalias")

    def _of(self, number: Any) -> Value:
        return Value(self._build, number)

    @property
    def _unit(self) -> Any:
        return self._given["unit"] if self._ops.lanes == 1 else self._load("unit", 0)

    def _inverse(self, d: Value | None, multiple: float, ops: Operations) -> Inverse:
        """Return the reciprocal of d · multiple, where d is known when the code runs and `multiple` now, as numbers of
        these operations."""
        if d is None:
            return Inverse(*(self._of(ops.constant(one)) for one in inverse_of(multiple)))
        d = d if multiple == 1 else d * multiple
        one = self._of(ops.constant(1.0))
        first = one / d
        return Inverse(first, (-d).times_plus(first, one) * first)

    def _constant(self, number: float) -> Value:
        return self._of(self._ops.constant(number))
