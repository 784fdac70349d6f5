"""Graphs as machine code: LLVM's instructions for one number at a time, or for a vector of numbers in each node.

The operations and our elementary functions are the same in both, so that the bits are. Needs llvmlite.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from llvmlite import ir

from ... import _core
from ..elementary import FORMULAS, POWERS
from ..machine_code import Function, MachineCode, linked, optimise
from .nodes import ARITHMETIC, COMPARISONS, ELEMENTARY, Node, in_order

_DOUBLE, _INDEX, _BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(1)
_POINTER = _DOUBLE.as_pointer()
_NAME = "graph"
_SOLVE = "invariode_solve"

#: LLVM takes more than linear time for long blocks, and for long code with optimisation: measured on chains of 10 and
#: 20 links. Instructions of a block, and of a function that is optimised.
_BLOCK, _OPTIMISED = 100, 3000


class Form(NamedTuple):
    """What the code takes and gives.

    Attributes
    ----------
    returns : bool
        Whether it returns its one value, as events do; otherwise it stores its values.
    lanes : int
        So many numbers side by side: ``code(unused, t, y, out, p)`` with t (lanes,), y (n, lanes) and so on.
    is_complex : bool
        Complex y and values: the imaginary parts are a direction and the derivatives along it, which are the last half
        of the outputs.
    complex_time : bool
        t is complex too, the first of y.
    own : bool
        Whether our elementary functions are called, not the mathematical library's.
    """

    returns: bool = False
    lanes: int = 1
    is_complex: bool = False
    complex_time: bool = False
    own: bool = True


def machine_code(outputs: Sequence[Node], form: Form) -> MachineCode:
    """The code of a function with these values."""
    module = ir.Module()
    module.triple = llvm.get_process_triple()
    _Writer(module, form).write(outputs)
    machine = _machine(form)
    text = re.sub(r'@"(invariode_\w+)"', r"@\1", str(module))  # as LLVM itself writes names
    made = linked(text, 64 * form.lanes if form.lanes > 1 else 0)
    made.get_function(_NAME).linkage = llvm.Linkage.external
    optimise(made, machine, loop_vectorization=False)
    llvm.add_symbol(_SOLVE, _core.solve_address())
    engine = llvm.create_mcjit_compiler(made, machine)
    engine.finalize_object()
    return MachineCode(engine.get_function_address(_NAME), engine)


def _machine(form: Form) -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    features = llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=3, jit=True)


class _Writer:
    """Writes the nodes of a graph into one function of LLVM's."""

    def __init__(self, module: Any, form: Form) -> None:
        self._module, self._form = module, form
        self._kind = _DOUBLE if form.lanes == 1 else ir.VectorType(_DOUBLE, form.lanes)
        given = [_POINTER, *[_POINTER] * 4] if form.lanes > 1 else [_DOUBLE, *[_POINTER] * (2 if form.returns else 3)]
        if form.complex_time:
            given[0] = _POINTER
        self._function = ir.Function(module, ir.FunctionType(_DOUBLE if form.returns else ir.VoidType(), given), _NAME)
        self._function.attributes.add("nounwind")
        names = ["unused"] * (form.lanes > 1) + ["t", "y"] + ["out"] * (not form.returns) + ["p"]
        self._given = dict(zip(names, self._function.args, strict=True))
        self._build = ir.IRBuilder(self._function.append_basic_block())

    def write(self, outputs: Sequence[Node]) -> None:
        values: dict[Node, Any] = {}
        nodes = [*in_order(outputs)]
        if len(nodes) > _OPTIMISED:
            self._function.attributes.add("noinline")
            self._function.attributes.add("optnone")
        for count, node in enumerate(nodes, 1):
            values[node] = self._value(node, [values[one] for one in node.arguments])
            if count % _BLOCK == 0:
                following = self._function.append_basic_block()
                self._build.branch(following)
                self._build.position_at_end(following)
        if self._form.returns:
            self._build.ret(values[outputs[0]])
            return
        half = len(outputs) // 2
        for i, node in enumerate(outputs):
            place = 2 * (i % half) + i // half if self._form.is_complex else i
            self._store(values[node], place)
        self._build.ret_void()

    def _place(self, name: str, index: int) -> Any:
        place = self._build.gep(self._given[name], [_INDEX(index * self._form.lanes)])
        return place if self._form.lanes == 1 else self._build.bitcast(place, self._kind.as_pointer())

    def _load(self, name: str, index: int) -> Any:
        return self._build.load(self._place(name, index), align=8)

    def _store(self, value: Any, index: int) -> None:
        self._build.store(value, self._place("out", index), align=8)

    def _constant(self, number: float) -> Any:
        kind = self._kind
        return ir.Constant(kind, number) if kind is _DOUBLE else ir.Constant(kind, [_DOUBLE(number)] * self._form.lanes)

    def _given_value(self, node: Node) -> Any:
        """t, y, p, and the imaginary parts of t and y."""
        form, op = self._form, node.op
        if op == "p":
            return self._load("p", node.value)
        if not form.is_complex:
            if op == "y":
                return self._load("y", node.value)
            return self._given["t"] if form.lanes == 1 else self._load("t", 0)
        if op in ("t", "dt"):
            if form.complex_time:
                return self._load("y", int(op == "dt"))
            return self._given["t"] if op == "t" else self._constant(0.0)
        return self._load("y", 2 * (node.value + form.complex_time) + (op == "dy"))

    def _value(self, node: Node, a: list[Any]) -> Any:
        build, op = self._build, node.op
        if op == "number":
            return self._constant(node.value)
        if op in ("t", "y", "p", "dt", "dy"):
            return self._given_value(node)
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
            return build.load(build.gep(a[0], [_INDEX(node.value)]))
        special: dict[str, Callable[..., Any]] = {
            "negate": build.fneg,
            "and": build.and_,
            "or": build.or_,
            "not": build.not_,
            "select": build.select,
            "abs": lambda x: self._intrinsic("fabs", x),
            "floor": lambda x: self._intrinsic("floor", x),
            "ceil": lambda x: self._intrinsic("ceil", x),
            "minimum": lambda x, y: build.select(
                build.fcmp_ordered("<", y, x), y, x
            ),  # as Python's: the first of equals
            "maximum": lambda x, y: build.select(build.fcmp_ordered(">", y, x), y, x),
            "sign": self._sign,
            "modulo": self._modulo,
        }
        return special[op](*a) if op in special else self._library(op, a)

    def _intrinsic(self, name: str, *arguments: Any) -> Any:
        lanes = self._form.lanes
        name = f"llvm.{name}.{f'v{lanes}' if lanes > 1 else ''}f64"
        kind = ir.FunctionType(self._kind, [self._kind] * len(arguments))
        called = self._module.globals.get(name) or ir.Function(self._module, kind, name)
        return self._build.call(called, arguments)

    def _sign(self, x: Any) -> Any:
        one = self._intrinsic("copysign", self._constant(1.0), x)
        build, zero = self._build, self._constant(0.0)
        return build.select(
            build.fcmp_unordered("!=", x, zero), build.select(build.fcmp_unordered("uno", x, x), x, one), x
        )

    def _modulo(self, x: Any, y: Any) -> Any:
        """Python's: the sign is that of y."""
        build, rest = self._build, self._library("fmod", [x, y])
        zero = self._constant(0.0)
        differ = build.xor(build.fcmp_ordered("<", rest, zero), build.fcmp_ordered("<", y, zero))
        moved = build.select(differ, build.fadd(rest, y), rest)
        return build.select(build.fcmp_ordered("==", rest, zero), self._intrinsic("copysign", zero, y), moved)

    def _elementary(self, node: Node, a: list[Any]) -> Any:
        name = node.op
        if name == "sqrt":
            return self._intrinsic("sqrt", *a)
        exponent = node.arguments[-1]
        if name == "power":
            name = POWERS.get(exponent.value, "pow") if exponent.op == "number" else "pow"
        if name in FORMULAS and self._form.own:
            one = Function(name, self._form.lanes)
            known = self._module.globals.get(one.symbol)
            called = known or ir.Function(self._module, ir.FunctionType(self._kind, [self._kind]), one.symbol)
            return self._build.call(called, a[:1])
        return self._library("pow" if node.op == "power" else name, a)

    def _library(self, name: str, a: list[Any]) -> Any:
        """The mathematical library's, lane by lane."""
        kind = ir.FunctionType(_DOUBLE, [_DOUBLE] * len(a))
        called = self._module.globals.get(name) or ir.Function(self._module, kind, name)
        if self._form.lanes == 1:
            return self._build.call(called, a)
        result = ir.Constant(self._kind, ir.Undefined)
        for lane in (ir.IntType(32)(i) for i in range(self._form.lanes)):
            values = [self._build.extract_element(one, lane) for one in a]
            result = self._build.insert_element(result, self._build.call(called, values), lane)
        return result

    def _solved(self, node: Node, a: list[Any]) -> Any:
        """A pointer to the solution of a linear system, which the core solves."""
        k, m = node.value
        build = self._build
        with build.goto_entry_block():
            place = build.alloca(_DOUBLE, k * (k + m))
        for i, value in enumerate(a):
            build.store(value, build.gep(place, [_INDEX(i)]))
        kind = ir.FunctionType(ir.VoidType(), [_INDEX, _INDEX, _POINTER])
        called = self._module.globals.get(_SOLVE) or ir.Function(self._module, kind, _SOLVE)
        build.call(called, [_INDEX(k), _INDEX(m), place])
        return build.gep(place, [_INDEX(k * k)])
