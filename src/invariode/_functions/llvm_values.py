"""Numbers of LLVM's language with the operators of arithmetic, so that formulas read as formulas."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir

_WORD = ir.IntType(64)


def bits_of(x: float) -> int:
    return int(struct.unpack("<Q", struct.pack("<d", x))[0])


def _operator(of_numbers: str, of_integers: str) -> Callable[[Value, Value | float], Value]:
    """An operator of two values, or of a value and a constant, by its instructions."""

    def applied(one: Value, other: Value | float) -> Value:
        return one._made(of_numbers if one._element == "double" else of_integers, one.ir, one._like(other))

    return applied


class Value:
    """A number, integer or truth of LLVM's language, or a vector of them; operators append instructions."""

    def __init__(self, builder: Any, ir: Any) -> None:
        self.builder, self.ir = builder, ir

    @property
    def _element(self) -> str:
        return str(getattr(self.ir.type, "element", self.ir.type))

    def _like(self, other: Value | float) -> Any:
        """A value, or a constant of the same type."""
        if isinstance(other, Value):
            return other.ir
        kind = self.ir.type
        if not isinstance(kind, ir.VectorType):
            return ir.Constant(kind, other)
        return ir.Constant(kind, [ir.Constant(kind.element, other)] * kind.count)

    def _made(self, instruction: str, *operands: Any) -> Value:
        return Value(self.builder, getattr(self.builder, instruction)(*operands))

    __add__, __sub__, __mul__ = (_operator(*names) for names in (("fadd", "add"), ("fsub", "sub"), ("fmul", "mul")))
    __and__, __or__, __xor__ = (_operator(name, name) for name in ("and_", "or_", "xor"))
    __lshift__, __rshift__ = (_operator(name, name) for name in ("shl", "lshr"))  # zeros come in

    def __rsub__(self, other: float) -> Value:
        return Value(self.builder, self._like(other)) - self

    def __truediv__(self, other: Value | float) -> Value:
        return self._made("fdiv", self.ir, self._like(other))

    def __rtruediv__(self, other: float) -> Value:
        return Value(self.builder, self._like(other)) / self

    def __neg__(self) -> Value:
        return self._made("fneg" if self._element == "double" else "neg", self.ir)

    def leading_zeros(self) -> Value:
        """Return the number of leading zeros of an integer; for 0 the number of its bits."""
        return self._made("ctlz", self.ir, ir.Constant(ir.IntType(1), 0))

    def _called(self, name: str, *arguments: Value) -> Value:
        """The value of an external function of such values."""
        kind, module = self.ir.type, self.builder.module
        function = module.globals.get(name) or ir.Function(module, ir.FunctionType(kind, [kind] * len(arguments)), name)
        return Value(self.builder, self.builder.call(function, [one.ir for one in arguments]))

    def _intrinsic(self, name: str, *others: Value) -> Value:
        vector = isinstance(self.ir.type, ir.VectorType)
        return self._called(f"llvm.{name}.{f'v{self.ir.type.count}' if vector else ''}f64", self, *others)

    def square_root(self) -> Value:
        """Correctly rounded, by the processor's instruction."""
        return self._intrinsic("sqrt")

    def floor(self) -> Value:
        """Return the largest integer that is not above this number."""
        return self._intrinsic("floor")

    def times_plus(self, factor: Value, term: Value) -> Value:
        """The product and the sum, rounded once."""
        return self._intrinsic("fma", factor, term)

    def library_power(self, exponent: float) -> Value:
        """Return this number to the power `exponent`, by the mathematical library."""
        return self._called("pow", self, Value(self.builder, self._like(exponent)))

    def compared(self, sign: str, other: Value | float) -> Value:
        """False where a number is NaN."""
        compare = "fcmp_ordered" if self._element == "double" else "icmp_signed"
        return self._made(compare, sign, self.ir, self._like(other))

    def choose(self, yes: Value | float, no: Value | float) -> Value:
        """Select `yes` where this truth value is true, else `no`."""
        known = yes if isinstance(yes, Value) else no
        assert isinstance(known, Value)
        return self._made("select", self.ir, known._like(yes), known._like(no))

    def resized(self, width: int) -> Value:
        """Return this integer with `width` bits: extended by zeros, or without its high bits."""
        return self._made("trunc" if width < self.ir.type.width else "zext", self.ir, ir.IntType(width))

    @property
    def as_number(self) -> Value:
        """The number that is equal to one nonnegative integer."""
        return self._made("uitofp", self.ir, ir.DoubleType())

    def _cast(self, element: Any) -> Value:
        vector = isinstance(self.ir.type, ir.VectorType)
        return self._made("bitcast", self.ir, ir.VectorType(element, self.ir.type.count) if vector else element)

    @property
    def bits(self) -> Value:
        return self._cast(_WORD)

    @property
    def number(self) -> Value:
        return self._cast(ir.DoubleType())


def looked_up(table: Sequence[int], index: Value, count: int) -> list[Value]:
    """Return `count` words of 64 bits of a table, from an index on; loads one by one are no slower than a gather."""
    builder, kind = index.builder, index.ir.type
    lanes = kind.count if isinstance(kind, ir.VectorType) else 0
    stored = ir.GlobalVariable(builder.module, ir.ArrayType(_WORD, len(table)), f"{builder.function.name}_table")
    stored.initializer = ir.Constant(stored.value_type, list(table))
    stored.global_constant, stored.linkage = True, "private"

    def word(at: Any) -> Any:
        return builder.load(builder.gep(stored, [ir.Constant(_WORD, 0), at], inbounds=True))

    found = []
    for places in (index + i if i else index for i in range(count)):
        loaded = ir.Constant(kind, ir.Undefined) if lanes else word(places.ir)
        for lane in (ir.Constant(ir.IntType(32), i) for i in range(lanes)):
            loaded = builder.insert_element(loaded, word(builder.extract_element(places.ir, lane)), lane)
        found.append(Value(builder, loaded))
    return found
