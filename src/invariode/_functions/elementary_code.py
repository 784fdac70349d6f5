"""Our elementary functions as code of LLVM's, for one number or a vector of them."""

from __future__ import annotations

from typing import Any, NamedTuple

from llvmlite import ir

from .elementary import FORMULAS, LARGEST, TwoFormulas
from .llvm_values import Value

#: More calls of our functions in one code are not inlined: they would take long to compile.
MOST_INLINED = 32


class Function(NamedTuple):
    """Elementary function of invariode, of a number or of a vector."""

    name: str
    lanes: int = 1

    @property
    def symbol(self) -> str:
        """Name of the function in LLVM's language."""
        return f"invariode_{self.name}" + (f"_v{self.lanes}" if self.lanes > 1 else "")

    @property
    def kind(self) -> Any:
        """LLVM's type of the argument and the value."""
        return ir.DoubleType() if self.lanes == 1 else ir.VectorType(ir.DoubleType(), self.lanes)


class Definitions:
    """Our functions in a module, each defined when it is first called."""

    def __init__(self, module: Any) -> None:
        self._module, self._called = module, dict[Function, Any]()
        self._calls = 0

    def called(self, one: Function) -> Any:
        """LLVM's function, for one more call."""
        self._calls += 1
        if one not in self._called:
            self._called[one] = self._written(one)
        return self._called[one]

    def finish(self) -> None:
        """Few calls are inlined."""
        if self._calls <= MOST_INLINED:
            for function in self._called.values():
                function.attributes.add("alwaysinline")

    def _start(self, name: str, result: Any, arguments: list[Any]) -> Any:
        """A builder at the beginning of a new function."""
        function = ir.Function(self._module, ir.FunctionType(result, arguments), name)
        function.attributes.add("nounwind")
        return ir.IRBuilder(function.append_basic_block())

    def _written(self, one: Function) -> Any:
        """The function: straight-line code, and one branch for unusual arguments."""
        formula = FORMULAS[one.name]
        unusual = self._unusual(one, formula)
        builder = self._start(one.symbol, one.kind, [one.kind])
        x = Value(builder, builder.function.args[0])
        value, is_usual = formula.usual(x), formula.is_usual(x)
        start, rare, end = builder.block, *(builder.append_basic_block(name) for name in ("rare", "end"))
        builder.cbranch(_all(is_usual).ir, end, rare).set_weights([1 << 20, 1])
        builder.position_at_end(rare)
        others = is_usual.choose(LARGEST, x)  # the formulas for unusual arguments may not hold for usual ones
        replaced = is_usual.choose(value, Value(builder, builder.call(unusual, [others.ir])))
        builder.branch(end)
        builder.position_at_end(end)
        result = builder.phi(one.kind)
        result.add_incoming(value.ir, start)
        result.add_incoming(replaced.ir, rare)
        builder.ret(result)
        builder.function.linkage = "private"
        return builder.function

    def _unusual(self, one: Function, formula: TwoFormulas) -> Any:
        """The function for unusual arguments, which is not inlined."""
        name = f"{one.symbol}_unusual"
        if name in self._module.globals:
            return self._module.globals[name]
        alone = self._unusual(Function(one.name), formula) if one.lanes > 1 and formula.one_at_a_time else None
        builder = self._start(name, one.kind, [one.kind])
        function = builder.function
        function.linkage = "private"
        function.attributes.add("noinline")
        if alone is None:
            builder.ret(formula.unusual(Value(builder, function.args[0])).ir)
            return function
        result = ir.Constant(one.kind, ir.Undefined)
        for lane in range(one.lanes):
            place = ir.Constant(ir.IntType(32), lane)
            result = builder.insert_element(
                result, builder.call(alone, [builder.extract_element(function.args[0], place)]), place
            )
        builder.ret(result)
        return function


def _all(truths: Value) -> Value:
    kind = truths.ir.type
    if not isinstance(kind, ir.VectorType):
        return truths
    together = Value(truths.builder, truths.builder.bitcast(truths.ir, ir.IntType(kind.count)))
    return together.compared("==", -1)
