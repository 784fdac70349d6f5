"""From numba's code to machine code, with our elementary functions in place of the mathematical library's.

numba leaves calls such as ``call double @llvm.sin.f64(double %x)`` in its intermediate representation, also those of
the user's helpers. They get other names here, and LLVM inlines what `_elementary` defines under these names.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from llvmlite import ir

from .elementary import FORMULAS, LARGEST, LIBRARY, POWERS, Formula
from .llvm_values import Value

#: More calls of our functions in one code are not inlined: they would take long to compile.
MOST_INLINED = 32

_LIBRARY = re.compile(rf"@(?:llvm\.)?({'|'.join(LIBRARY)})(?:\.(?:v(\d+))?f64)?\(")
_CONSTANT = r"[-+.e\d]+"
#: A power with a constant exponent, which for vectors is one number in several spellings.
_POWER = re.compile(
    r"@(?:llvm\.)?pow(?:\.(?:v(?P<lanes>\d+))?f64)?\((?P<x>[^()]+), (?:"
    rf"double (?P<one>{_CONSTANT})|<\d+ x double> (?:splat \(double (?P<all>{_CONSTANT})\)"
    rf"|<double (?P<each>{_CONSTANT})(?:, double (?P=each))*>))\)"
)
_OURS = re.compile(rf"call [^@\n]*@invariode_({'|'.join(FORMULAS)})(?:_([vm])(\d+))?\(")
#: Keeps functions that nobody calls yet.
_KEPT = "@llvm.compiler.used = appending global"


class MachineCode(NamedTuple):
    """An address, and what keeps the code there alive."""

    address: int
    owner: Any


class Function(NamedTuple):
    """One of ours, of a number or of a vector, with a mask or without."""

    name: str
    lanes: int = 1
    masked: bool = False

    @property
    def symbol(self) -> str:
        """What it is called in LLVM's language."""
        return f"invariode_{self.name}" + (f"_{'m' if self.masked else 'v'}{self.lanes}" if self.lanes > 1 else "")

    @property
    def kind(self) -> Any:
        """LLVM's type of the argument and the value."""
        return ir.DoubleType() if self.lanes == 1 else ir.VectorType(ir.DoubleType(), self.lanes)

    @property
    def arguments(self) -> list[Any]:
        """LLVM's types of these."""
        return [self.kind, ir.VectorType(ir.IntType(1), self.lanes)] if self.masked else [self.kind]


def own(text: str) -> tuple[str, list[Function]]:
    """Code that calls our functions in place of the library's, and which."""
    calls: set[Function] = set()

    def renamed(match: re.Match[str]) -> str:
        one = Function(match[1], int(match[2] or 1))
        calls.add(one)
        return f"@{one.symbol}("

    def renamed_power(match: re.Match[str]) -> str:
        name = POWERS.get(float(match["one"] or match["all"] or match["each"]))
        if name is None:
            return match[0]
        one = Function(name, int(match["lanes"] or 1))
        calls.add(one)
        return f"@{one.symbol}({match['x']})"

    lines = (line for line in text.splitlines() if not (line.startswith("declare ") and _LIBRARY.search(line)))
    return _POWER.sub(renamed_power, _LIBRARY.sub(renamed, "\n".join(lines))), sorted(calls)


def side_by_side(calls: Iterable[Function], lanes: int) -> list[Function]:
    """The forms for that many numbers of what is called for one."""
    names = sorted({one.name for one in calls if one.lanes == 1})
    return [Function(name, lanes, masked) for name in names for masked in (False, True)]


def declarations(calls: Iterable[Function], forms: Iterable[Function] = ()) -> str:
    """Of functions without side effects, which LLVM's loop vectoriser replaces by these forms."""
    forms, lines = [*forms], []
    for one in sorted({*calls, *forms}):
        side_effects = "memory(none) nounwind willreturn"
        lines.append(f"declare {one.kind} @{one.symbol}({', '.join(map(str, one.arguments))}) {side_effects}")
        variants = [form for form in forms if form.name == one.name and one.lanes == 1]
        if variants:  # vector function ABI: N or M is without or with mask, v an argument that is a vector
            names = ",".join(
                f"_ZGV_LLVM_{'M' if form.masked else 'N'}{form.lanes}v_{one.symbol}({form.symbol})" for form in variants
            )
            lines[-1] += f' "vector-function-abi-variant"="{names}"'
    if forms:  # otherwise what nobody calls yet would be dropped
        kept = ", ".join(f"ptr @{form.symbol}" for form in forms)
        lines.append(f'@llvm.compiler.used = appending global [{len(forms)} x ptr] [{kept}], section "llvm.metadata"')
    return "".join(f"\n{line}" for line in lines) + "\n"


def with_own(code: Any) -> MachineCode | None:
    """numba's C function with our elementary functions; None: it calls none of these."""
    text, calls = own(code._library.get_llvm_str())
    if not calls:
        return None
    module = linked(text + declarations(calls))
    hide(module, code._wrapper_name)
    target = machine()
    optimise(module, target, loop_vectorization=True)
    return finished(module, target, code._wrapper_name, code)


def linked(text: str, width: int = 0) -> Any:
    """The module of code that calls our functions, with their definitions for registers of `width` bits."""
    module = llvm.parse_assembly("\n".join(line for line in text.splitlines() if not line.startswith(_KEPT)))
    calls = [Function(name, int(lanes or 1), kind == "m") for name, kind, lanes in _OURS.findall(text)]
    defined = ir.Module()
    defined.triple, defined.data_layout = module.triple, module.data_layout
    _Definitions(defined).add(sorted(set(calls)))
    definitions = str(defined)
    if width:
        definitions = definitions.replace(" nounwind", f' nounwind "prefer-vector-width"="{width}"')
    module.link_in(llvm.parse_assembly(definitions))
    for function in (module.get_function(one.symbol) for one in set(calls)):
        function.linkage = llvm.Linkage.private
        if len(calls) <= MOST_INLINED:
            function.add_function_attribute("alwaysinline")
    return module


def hide(module: Any, entry: str) -> None:
    """Make all functions private but one."""
    for function in module.functions:
        if not function.is_declaration and function.name != entry:
            function.linkage = llvm.Linkage.private


class _Definitions:
    """Our functions as LLVM's."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def add(self, functions: Iterable[Function]) -> None:
        for one in functions:
            self._masked(one) if one.masked else self._defined(one)

    def _start(self, name: str, result: Any, arguments: list[Any]) -> Any:
        """A builder at the beginning of a new function."""
        function = ir.Function(self._module, ir.FunctionType(result, arguments), name)
        function.attributes.add("nounwind")
        return ir.IRBuilder(function.append_basic_block())

    def _defined(self, one: Function) -> Any:
        """The function: straight-line code, and one branch for unusual arguments."""
        if one.symbol in self._module.globals:
            return self._module.globals[one.symbol]
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
        return builder.function

    def _unusual(self, one: Function, formula: Formula) -> Any:
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

    def _masked(self, one: Function) -> None:
        """Of the lanes in the mask only; the others get 1, which is usual."""
        inner = self._defined(one._replace(masked=False))
        builder = self._start(one.symbol, one.kind, one.arguments)
        x, mask = (Value(builder, argument) for argument in builder.function.args)
        builder.ret(builder.call(inner, [mask.choose(x, 1.0).ir]))


def _all(truths: Value) -> Value:
    kind = truths.ir.type
    if not isinstance(kind, ir.VectorType):
        return truths
    together = Value(truths.builder, truths.builder.bitcast(truths.ir, ir.IntType(kind.count)))
    return together.compared("==", -1)


def machine() -> Any:
    """A target machine with numba's own options: the code must have the same bits."""
    from numba.core.registry import cpu_target

    codegen: Any = cpu_target.target_context.codegen()
    options: dict[str, Any] = {"opt": 3}
    codegen._tm_features = codegen._customize_tm_features()
    codegen._customize_tm_options(options)
    return llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(**options)


def optimise(module: Any, target: Any, loop_vectorization: bool) -> None:
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization, options.slp_vectorization = loop_vectorization, False
    options.loop_unrolling = options.loop_interleaving = False
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)


def finished(module: Any, target: Any, entry: str, code: Any) -> MachineCode:
    """The machine code of a module that numba's `code` became, from its entry."""
    engine = llvm.create_mcjit_compiler(module, target)
    engine.finalize_object()
    for name in (one.name for one in module.global_variables if one.name.startswith("_ZN08NumbaEnv")):
        mine, numbas = (side.get_global_value_address(name) for side in (engine, code._library.codegen._engine))
        if mine and numbas:
            ctypes.c_void_p.from_address(mine).value = ctypes.c_void_p.from_address(numbas).value
    return MachineCode(engine.get_function_address(entry), (engine, code))
