"""Graphs as machine code: LLVM's instructions for one number at a time, or for a vector of numbers in each node.

The operations and our elementary functions are the same in both, so that the bits are. Needs llvmlite.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from llvmlite import ir

from ... import _core
from ..elementary import FORMULAS, POWERS
from ..elementary_code import Definitions, Function
from ..llvm_values import bits_of
from .nodes import ARITHMETIC, COMPARISONS, ELEMENTARY, Node, as_rows, in_order
from .rolled import Group, rolled

_DOUBLE, _INDEX, _BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(1)
_POINTER = _DOUBLE.as_pointer()
_NAME = "graph"
_SOLVE = "invariode_solve"

#: LLVM takes more than linear time for long blocks, and for long code with optimisation: measured on chains of 10 and
#: 20 links. Instructions of a block, and of a function that is optimised.
_BLOCK, _OPTIMISED = 100, 3000
#: From so many nodes on repeated parts become loops.
_ROLLED = 300
#: Codes that are kept for equal graphs, and those, in the order of their last use.
_MOST_KEPT = 256
_kept: OrderedDict[bytes, MachineCode] = OrderedDict()
_keeping = threading.Lock()
#: Doubles that loops may keep on the stack.
_MOST_WORK = 2**15


class MachineCode(NamedTuple):
    """An address, and what keeps the code there alive."""

    address: int
    owner: Any


class Form(NamedTuple):
    """What the code takes and gives.

    Attributes
    ----------
    returns : bool
        Whether it returns its one value, as events do; otherwise it stores its values.
    lanes : int
        So many numbers side by side: ``code(unused, t, y, out, p)`` with t (lanes,), y (n, lanes) and so on.
    own : bool
        Whether our elementary functions are called, not the mathematical library's.
    """

    returns: bool = False
    lanes: int = 1
    own: bool = True


def machine_code(outputs: Sequence[Node], form: Form) -> MachineCode:
    """The code of a function with these values: that of an equal graph, if that has been compiled in this process."""
    key = hashlib.sha256(repr((form, as_rows(outputs))).encode()).digest()
    with _keeping:
        if key in _kept:
            _kept.move_to_end(key)
            return _kept[key]
    made = _compiled(outputs, form)
    with _keeping:
        _kept[key] = made
        if len(_kept) > _MOST_KEPT:
            _kept.popitem(last=False)
    return made


def _compiled(outputs: Sequence[Node], form: Form) -> MachineCode:
    module = ir.Module()
    module.triple = llvm.get_process_triple()
    loops = _Writer(module, form).write(outputs)
    machine, text = _machine(form), str(module)
    if form.lanes > 1:  # of whole registers; llvmlite's functions do not take this attribute
        text = text.replace(" nounwind", f' nounwind "prefer-vector-width"="{64 * form.lanes}"')
    made = llvm.parse_assembly(text)
    _optimise(made, machine, loop_vectorization=loops and form.lanes == 1)
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


def _optimise(module: Any, target: Any, loop_vectorization: bool) -> None:
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization, options.slp_vectorization = loop_vectorization, False
    options.loop_unrolling = options.loop_interleaving = False
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)


class _Writer:
    """Writes the nodes of a graph into one function of LLVM's."""

    def __init__(self, module: Any, form: Form) -> None:
        self._module, self._form = module, form
        self._kind = _DOUBLE if form.lanes == 1 else ir.VectorType(_DOUBLE, form.lanes)
        given = [_POINTER, *[_POINTER] * 4] if form.lanes > 1 else [_DOUBLE, *[_POINTER] * (2 if form.returns else 3)]
        self._function = ir.Function(module, ir.FunctionType(_DOUBLE if form.returns else ir.VoidType(), given), _NAME)
        self._function.attributes.add("nounwind")
        names = ["unused"] * (form.lanes > 1) + ["t", "y"] + ["out"] * (not form.returns) + ["p"]
        self._given = dict(zip(names, self._function.args, strict=True))
        self._build = ir.IRBuilder(self._function.append_basic_block())
        self._in_block = 0
        self._own = Definitions(module)

    def write(self, outputs: Sequence[Node]) -> bool:
        """The function with these values; whether it has loops."""
        loops = self._write_rolled(outputs) or self._write_straight(outputs)
        self._own.finish()
        return loops

    def _write_rolled(self, outputs: Sequence[Node]) -> bool:
        """With loops, if it is large and has parts that repeat."""
        nodes = [*in_order(outputs)]
        large = len(nodes) + len(outputs) >= _ROLLED and not self._form.returns
        groups = rolled(outputs) if large else None
        if groups is not None and groups[1] * self._form.lanes <= _MOST_WORK:
            self._write_groups(*groups)
            return True
        return False

    def _write_straight(self, outputs: Sequence[Node]) -> bool:
        nodes = [*in_order(outputs)]
        self._optimise(len(nodes))
        values: dict[Node, Any] = {}
        for node in nodes:
            values[node] = self._value(node, [values[one] for one in node.arguments])
            self._count(1)
        if self._form.returns:
            self._build.ret(values[outputs[0]])
            return False
        for i, node in enumerate(outputs):
            self._store(values[node], i)
            self._count(1)
        self._build.ret_void()
        return False

    def _optimise(self, size: int) -> None:
        """Not where that takes too long."""
        if size > _OPTIMISED:
            self._function.attributes.add("noinline")
            self._function.attributes.add("optnone")

    def _count(self, instructions: int) -> None:
        """A new block where one has become long."""
        self._in_block += instructions
        if self._in_block >= _BLOCK:
            following = self._function.append_basic_block()
            self._build.branch(following)
            self._build.position_at_end(following)
            self._in_block = 0

    def _write_groups(self, groups: Sequence[Group], size: int) -> None:
        self._optimise(sum(one.size for one in groups))
        for name in ("y", "out", "p"):
            self._given[name].add_attribute("noalias")
        self._given["work"] = self._build.alloca(_DOUBLE, max(size, 1) * self._form.lanes)
        for group in groups:
            if group.is_loop:
                with self._loop(len(group.places)) as k:
                    self._write_member(group, lambda values: self._listed(values, k))
                continue
            for member in range(len(group.places)):
                self._write_member(group, lambda values: values[member])
                self._count(len(group.nodes))
        self._build.ret_void()

    @contextmanager
    def _loop(self, count: int) -> Iterator[Any]:
        """Over that many numbers, from 0."""
        build, before = self._build, self._build.block
        body, after = (self._function.append_basic_block() for _ in range(2))
        build.branch(body)
        build.position_at_end(body)
        k = build.phi(_INDEX)
        k.add_incoming(_INDEX(0), before)
        yield k
        following = build.add(k, _INDEX(1), flags=("nsw", "nuw"))
        k.add_incoming(following, build.block)
        build.cbranch(build.icmp_signed("<", following, _INDEX(count)), body, after)
        build.position_at_end(after)
        self._in_block = 0

    def _write_member(self, group: Group, at: Callable[[list[Any]], Any]) -> None:
        """The value of one tree: `at` tells its index or number in a place."""
        values: dict[Node, Any] = {}
        for node in group.nodes:
            leaf = group.leaves.get(node)
            if leaf is None:
                values[node] = self._value(node, [values[one] for one in node.arguments])
            elif leaf.kind == "number":
                number = at(leaf.values)
                values[node] = self._constant(number) if isinstance(number, float) else self._everywhere(number)
            else:
                values[node] = self._load(leaf.kind, at(leaf.values))
        self._build.store(values[group.nodes[-1]], self._place(group.target, at(group.places)), align=8)

    def _listed(self, values: list[Any], k: Any) -> Any:
        """The k-th of these: a constant, a progression, or looked up."""
        first = values[0]
        if isinstance(first, float):
            if len({bits_of(one) for one in values}) == 1:
                return first
        else:
            step = values[1] - first
            if all(one == first + i * step for i, one in enumerate(values)):
                flags = ("nsw",)
                return self._build.add(self._build.mul(k, _INDEX(step), flags=flags), _INDEX(first), flags=flags)
        kind = _DOUBLE if isinstance(first, float) else _INDEX
        table = ir.GlobalVariable(self._module, ir.ArrayType(kind, len(values)), f"table{len(self._module.globals)}")
        table.initializer = ir.Constant(table.value_type, [kind(one) for one in values])
        table.global_constant, table.linkage = True, "private"
        return self._build.load(self._build.gep(table, [_INDEX(0), k], inbounds=True))

    def _everywhere(self, number: Any) -> Any:
        """In all lanes."""
        if self._form.lanes == 1:
            return number
        place = ir.IntType(32)
        first = self._build.insert_element(ir.Constant(self._kind, ir.Undefined), number, place(0))
        mask = ir.Constant(ir.VectorType(place, self._form.lanes), [place(0)] * self._form.lanes)
        return self._build.shuffle_vector(first, ir.Constant(self._kind, ir.Undefined), mask)

    def _place(self, name: str, index: Any) -> Any:
        lanes = self._form.lanes
        if isinstance(index, int):
            index = _INDEX(index * lanes)
        elif lanes > 1:
            index = self._build.mul(index, _INDEX(lanes), flags=("nsw",))
        place = self._build.gep(self._given[name], [index], inbounds=True)
        return place if self._form.lanes == 1 else self._build.bitcast(place, self._kind.as_pointer())

    def _load(self, name: str, index: Any) -> Any:
        return self._build.load(self._place(name, index), align=8)

    def _store(self, value: Any, index: int) -> None:
        self._build.store(value, self._place("out", index), align=8)

    def _constant(self, number: float) -> Any:
        kind = self._kind
        return ir.Constant(kind, number) if kind is _DOUBLE else ir.Constant(kind, [_DOUBLE(number)] * self._form.lanes)

    def _given_value(self, node: Node) -> Any:
        """t, y and p."""
        if node.op == "t":
            return self._given["t"] if self._form.lanes == 1 else self._load("t", 0)
        return self._load(node.op, node.value)

    def _value(self, node: Node, a: list[Any]) -> Any:
        build, op = self._build, node.op
        if op == "number":
            return self._constant(node.value)
        if op in ("t", "y", "p"):
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
            return self._build.call(self._own.called(Function(name, self._form.lanes)), a[:1])
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
