"""The operations of graphs in LLVM's language, on a number or on a vector of them, with the same bits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir

from ..elementary import FORMULAS, POWERS
from ..elementary_code import Definitions, Function
from ..llvm_values import bits_of
from .nodes import ARITHMETIC, COMPARISONS, ELEMENTARY, Node
from .objects import SOLVE, SOLVE_SPARSE

DOUBLE, INDEX = ir.DoubleType(), ir.IntType(64)
POINTER = DOUBLE.as_pointer()


def constants(module: Any, kind: Any, numbers: Sequence[float]) -> Any:
    """An array of constants of one type, in the memory of a module."""
    table = ir.GlobalVariable(module, ir.ArrayType(kind, len(numbers)), f"table{len(module.globals)}")
    table.initializer = ir.Constant(table.value_type, [kind(one) for one in numbers])
    table.global_constant, table.linkage = True, "private"
    return table


class Operations:
    """Writes operations where a builder stands.

    - `build`: builder, at the position where operations are written
    - `own`: invariode's elementary functions are called, not the mathematical library's
    - `lanes`: numbers in each value
    - `beside`: operations of the same module, which share elementary functions and tables with these

    Attributes:
    - `kind`: LLVM's type of a value
    - `build`, `lanes`: as given
    """

    def __init__(self, build: Any, own: bool, lanes: int = 1, beside: Operations | None = None) -> None:
        self.build, self.module, self.lanes, self._is_own = build, build.module, lanes, own
        self.kind = DOUBLE if lanes == 1 else ir.VectorType(DOUBLE, lanes)
        self._own: Definitions = Definitions(build.module) if beside is None else beside._own
        self._tables: dict[tuple[int, ...], Any] = {} if beside is None else beside._tables

    def of_width(self, lanes: int) -> Operations:
        """Return the operations on vectors of `lanes` numbers, in the same code."""
        return Operations(self.build, self._is_own, lanes, self)

    def finish(self) -> None:
        """Everything is written."""
        self._own.finish()

    def listed(self, values: list[Any], k: Any) -> Any:
        """Return the k-th of the values: a constant, a progression, or looked up in a table."""
        first = values[0]
        if isinstance(first, float):
            if len({bits_of(one) for one in values}) == 1:
                return first
        else:
            step = values[1] - first
            if all(one == first + i * step for i, one in enumerate(values)):
                flags = ("nsw",)
                return self.build.add(self.build.mul(k, INDEX(step), flags=flags), INDEX(first), flags=flags)
        kind = DOUBLE if isinstance(first, float) else INDEX
        table = constants(self.module, kind, values)
        return self.build.load(self.build.gep(table, [INDEX(0), k], inbounds=True))

    def everywhere(self, number: Any) -> Any:
        """Return a vector with `number` in all lanes."""
        if self.lanes == 1:
            return number
        place = ir.IntType(32)
        first = self.build.insert_element(ir.Constant(self.kind, ir.Undefined), number, place(0))
        mask = ir.Constant(ir.VectorType(place, self.lanes), [place(0)] * self.lanes)
        return self.build.shuffle_vector(first, ir.Constant(self.kind, ir.Undefined), mask)

    def constant(self, number: float) -> Any:
        kind = self.kind
        return ir.Constant(kind, number) if kind is DOUBLE else ir.Constant(kind, [DOUBLE(number)] * self.lanes)

    def value(self, node: Node, a: list[Any]) -> Any:
        build, op = self.build, node.op
        if op == "number":
            return self.constant(node.value)
        if op in ARITHMETIC:
            names = {"add": build.fadd, "subtract": build.fsub, "multiply": build.fmul, "divide": build.fdiv}
            return names[op](*a)
        if op in COMPARISONS:
            compare = build.fcmp_unordered if op == "not_equal" else build.fcmp_ordered
            return compare(COMPARISONS[op], *a)
        if op in ELEMENTARY or op == "power":
            return self._elementary(node, a)
        if op == "solve":
            return self._solved(node, a)
        if op == "entry":
            return build.load(build.gep(a[0], [INDEX(node.value)]))
        if op in ("piece", "pick"):
            return self._each(lambda x: self._looked_up(node, x), a[0])
        special: dict[str, Callable[..., Any]] = {
            "negate": build.fneg,
            "and": build.and_,
            "or": build.or_,
            "not": build.not_,
            "select": build.select,
            "abs": lambda x: self.intrinsic("fabs", x),
            "floor": lambda x: self.intrinsic("floor", x),
            "ceil": lambda x: self.intrinsic("ceil", x),
            "minimum": lambda x, y: build.select(
                build.fcmp_ordered("<", y, x), y, x
            ),  # as Python's: the first of equals
            "maximum": lambda x, y: build.select(build.fcmp_ordered(">", y, x), y, x),
            "sign": self._sign,
            "modulo": self._modulo,
        }
        return special[op](*a) if op in special else self._library(op, a)

    def intrinsic(self, name: str, *arguments: Any) -> Any:
        lanes = self.lanes
        name = f"llvm.{name}.{f'v{lanes}' if lanes > 1 else ''}f64"
        kind = ir.FunctionType(self.kind, [self.kind] * len(arguments))
        called = self.module.globals.get(name) or ir.Function(self.module, kind, name)
        return self.build.call(called, arguments)

    def _sign(self, x: Any) -> Any:
        one = self.intrinsic("copysign", self.constant(1.0), x)
        build, zero = self.build, self.constant(0.0)
        return build.select(
            build.fcmp_unordered("!=", x, zero), build.select(build.fcmp_unordered("uno", x, x), x, one), x
        )

    def _modulo(self, x: Any, y: Any) -> Any:
        """Python's: the sign is that of y."""
        build, rest = self.build, self._library("fmod", [x, y])
        zero = self.constant(0.0)
        differ = build.xor(build.fcmp_ordered("<", rest, zero), build.fcmp_ordered("<", y, zero))
        moved = build.select(differ, build.fadd(rest, y), rest)
        return build.select(build.fcmp_ordered("==", rest, zero), self.intrinsic("copysign", zero, y), moved)

    def _elementary(self, node: Node, a: list[Any]) -> Any:
        name = node.op
        if name == "sqrt":
            return self.intrinsic("sqrt", *a)
        exponent = node.arguments[-1]
        if name == "power":
            name = POWERS.get(exponent.value, "pow") if exponent.op == "number" else "pow"
        if name in FORMULAS and self._is_own:
            return self.build.call(self._own.called(Function(name, self.lanes)), a[:1])
        return self._library("pow" if node.op == "power" else name, a)

    def _each(self, of: Callable[[Any], Any], a: Any) -> Any:
        """Lane by lane."""
        if self.lanes == 1:
            return of(a)
        result = ir.Constant(self.kind, ir.Undefined)
        for lane in (ir.IntType(32)(i) for i in range(self.lanes)):
            result = self.build.insert_element(result, of(self.build.extract_element(a, lane)), lane)
        return result

    def _looked_up(self, node: Node, x: Any) -> Any:
        """Look x up in a table of numbers: return how many are not above x, by bisection, or the number at index x."""
        build, numbers = self.build, [float(one) for one in node.value]
        if node.op == "pick":
            return self.entry_of(self.table(numbers), build.fptosi(x, INDEX))
        steps = len(numbers).bit_length()
        table = self.table(numbers + [math.inf] * (2**steps - 1 - len(numbers)))
        below: Any = INDEX(0)
        for step in (2**i for i in reversed(range(steps))):
            further = build.add(below, INDEX(step))
            number = self.entry_of(table, build.add(below, INDEX(step - 1)))
            below = build.select(build.fcmp_ordered("<=", number, x), further, below)
        return build.sitofp(below, DOUBLE)

    def table(self, numbers: list[float]) -> Any:
        """Constants in memory, once."""
        key = tuple(map(bits_of, numbers))
        if key not in self._tables:
            self._tables[key] = constants(self.module, DOUBLE, numbers)
        return self._tables[key]

    def entry_of(self, table: Any, index: Any) -> Any:
        return self.build.load(self.build.gep(table, [INDEX(0), index], inbounds=True))

    def _library(self, name: str, a: list[Any]) -> Any:
        """The mathematical library's, lane by lane."""
        kind = ir.FunctionType(DOUBLE, [DOUBLE] * len(a))
        called = self.module.globals.get(name) or ir.Function(self.module, kind, name)
        if self.lanes == 1:
            return self.build.call(called, a)
        result = ir.Constant(self.kind, ir.Undefined)
        for lane in (ir.IntType(32)(i) for i in range(self.lanes)):
            values = [self.build.extract_element(one, lane) for one in a]
            result = self.build.insert_element(result, self.build.call(called, values), lane)
        return result

    def _solved(self, node: Node, a: list[Any]) -> Any:
        """A pointer to the solution of a linear system, which the core solves."""
        k, m, places = node.value
        build = self.build
        with build.goto_entry_block():
            place = build.alloca(DOUBLE, len(a))
        for i, value in enumerate(a):
            build.store(value, build.gep(place, [INDEX(i)]))
        sizes = [INDEX(k), INDEX(m)]
        if not places:
            self._call(SOLVE, [*sizes, place])
        else:
            where = build.gep(constants(self.module, INDEX, places), [INDEX(0), INDEX(0)], inbounds=True)
            self._call(SOLVE_SPARSE, [*sizes, INDEX(len(places)), where, place])
        return build.gep(place, [INDEX(node.value.entries)])

    def _call(self, name: str, arguments: list[Any]) -> None:
        """Calls a function of the core that returns nothing."""
        kind = ir.FunctionType(ir.VoidType(), [one.type for one in arguments])
        self.build.call(self.module.globals.get(name) or ir.Function(self.module, kind, name), arguments)
