"""Graphs as machine code: LLVM's instructions for one number at a time, or for a vector of numbers in each node.

The operations and our elementary functions are the same in both, so that the bits are. Needs llvmlite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import itemgetter
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir

from ..._base.forks import compiling
from .nodes import Node, in_order
from .objects import NAME, CodeForm, object_file, target_machine
from .operations import DOUBLE, INDEX, POINTER, Operations
from .rolled import Group, rolled

#: LLVM takes more than linear time for long blocks, and for long code with optimisation: measured on chains of 10 and
#: 20 links. Instructions of a block, and of a function that is optimised.
_BLOCK, _OPTIMISED = 100, 3000
#: From so many nodes on repeated parts become loops.
_ROLLED = 300
#: Doubles that loops may keep on the stack.
_MOST_WORK = 2**15


def written(outputs: Sequence[Node], form: CodeForm) -> bytes:
    """Compile a function with these values to an `object_file`."""
    return compiled(form.lanes, lambda module: _NodeWriter(module, form), outputs)


def compiled(lanes: int, writer: Callable[[Any], Writer], outputs: Sequence[Node], level: int = 3) -> bytes:
    """Compile the module that a writer writes to an `object_file`, at a level of optimisation; 0: as it was written."""
    with compiling:
        module = ir.Module()
        module.triple = llvm.get_process_triple()
        loops = writer(module).write(outputs)
        machine, text = target_machine(), str(module)
        if lanes > 1:  # of whole registers; llvmlite's functions do not take this attribute
            text = text.replace(" nounwind", f' nounwind "prefer-vector-width"="{64 * lanes}"')
        made = llvm.parse_assembly(text)
        if level > 0:
            _optimise(made, machine, level, loop_vectorization=loops and lanes == 1)
        return object_file(machine.emit_object(made), lines=text.count("\n"))


def _optimise(module: Any, target: Any, level: int, loop_vectorization: bool) -> None:
    options = llvm.create_pipeline_tuning_options(speed_level=level)
    options.loop_vectorization, options.slp_vectorization = loop_vectorization, False
    options.loop_unrolling = options.loop_interleaving = False
    passes = llvm.create_pass_builder(target, options)
    manager = passes.getModulePassManager()
    manager.run(module, passes)
    dispose = getattr(llvm.ffi.lib, "LLVMPY_DisposeNewModulePassManger", None)
    if dispose and "_dispose" not in vars(type(manager)):  # llvmlite 0.50 never does: 57 kB for each function
        dispose(manager)


class Writer:
    """Writes one function of LLVM's.

    - `module`: module that the function is written to
    - `own`: invariode's elementary functions are called, not the mathematical library's
    - `lanes`: numbers in each value
    - `arguments`: the names and types of its arguments
    - `returned`: type of the returned value
    """

    def __init__(self, module: Any, own: bool, lanes: int, arguments: Mapping[str, Any], returned: Any) -> None:
        self._module = module
        self._function = ir.Function(module, ir.FunctionType(returned, list(arguments.values())), NAME)
        self._function.attributes.add("nounwind")
        self._given = dict(zip(arguments, self._function.args, strict=True))
        self._build = ir.IRBuilder(self._function.append_basic_block())
        self._ops = Operations(self._build, own, lanes)
        self._in_block = 0

    def write(self, outputs: Sequence[Node]) -> bool:
        """Write the function with these values; return whether it has loops."""
        loops = self._write(outputs)
        self._ops.finish()
        return loops

    def _write(self, outputs: Sequence[Node]) -> bool:
        raise NotImplementedError

    def _optimise(self, size: int) -> None:
        """Switch optimisation off where it would take too long."""
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

    @contextmanager
    def _loop(self, count: Any, first: int = 0) -> Iterator[Any]:
        """Over the numbers from `first` to below `count`, at least once."""
        build, before = self._build, self._build.block
        body, after = (self._function.append_basic_block() for _ in range(2))
        build.branch(body)
        build.position_at_end(body)
        k = build.phi(INDEX)
        k.add_incoming(INDEX(first), before)
        yield k
        following = build.add(k, INDEX(1), flags=("nsw", "nuw"))
        k.add_incoming(following, build.block)
        build.cbranch(build.icmp_signed("<", following, self._index(count)), body, after)
        build.position_at_end(after)
        self._in_block = 0

    def _index(self, index: Any) -> Any:
        """Return an index as a value, where it is a number."""
        return INDEX(index) if isinstance(index, int) else index

    def _place(self, name: str, index: Any) -> Any:
        lanes = self._ops.lanes
        if isinstance(index, int):
            index = INDEX(index * lanes)
        elif lanes > 1:
            index = self._build.mul(index, INDEX(lanes), flags=("nsw",))
        place = self._build.gep(self._given[name], [index], inbounds=True)
        return place if lanes == 1 else self._build.bitcast(place, self._ops.kind.as_pointer())

    def _load(self, name: str, index: Any) -> Any:
        return self._build.load(self._place(name, index), align=8)

    def _store(self, value: Any, name: str, index: Any) -> None:
        self._build.store(value, self._place(name, index), align=8)

    def _value(self, node: Node, a: list[Any]) -> Any:
        """Return the value of a node from those of its arguments."""
        if node.op == "t":
            return self._given["t"] if self._ops.lanes == 1 else self._load("t", 0)
        return self._load(node.op, node.value) if node.op in ("y", "p") else self._ops.value(node, a)


class _NodeWriter(Writer):
    """Writes the nodes of a graph into one function of LLVM's."""

    def __init__(self, module: Any, form: CodeForm) -> None:
        given = [POINTER, *[POINTER] * 4] if form.lanes > 1 else [DOUBLE, *[POINTER] * (2 if form.returns else 3)]
        names = ["unused"] * (form.lanes > 1) + ["t", "y"] + ["out"] * (not form.returns) + ["p"]
        arguments = dict(zip(names, given, strict=True))
        super().__init__(module, form.own, form.lanes, arguments, DOUBLE if form.returns else ir.VoidType())
        self._form = form

    def _write(self, outputs: Sequence[Node]) -> bool:
        return self._write_rolled(outputs) or self._write_straight(outputs)

    def _write_rolled(self, outputs: Sequence[Node]) -> bool:
        """Write the code with loops if the graph is large and has parts that repeat; return whether that was done."""
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
            self._store(values[node], "out", i)
            self._count(1)
        self._build.ret_void()
        return False

    def _write_groups(self, groups: Sequence[Group], size: int) -> None:
        self._optimise(sum(one.size for one in groups))
        for name in ("y", "out", "p"):
            self._given[name].add_attribute("noalias")
        self._given["work"] = self._build.alloca(DOUBLE, max(size, 1) * self._form.lanes)
        for group in groups:
            if len(group.runs) > 1:
                self._write_runs(group)
            elif group.is_loop:
                with self._loop(len(group.places)) as k:
                    self._write_member(group, lambda values: self._ops.listed(values, k))
            else:
                for member in range(len(group.places)):
                    self._write_member(group, itemgetter(member))
                    self._count(len(group.nodes))
        self._build.ret_void()

    def _write_runs(self, group: Group) -> None:
        """Write a loop over the trees of each run, within one over the runs."""
        build, runs = self._build, group.runs
        with self._loop(len(runs)) as run:
            first = self._ops.listed([one.start for one in runs], run)
            with self._loop(self._ops.listed([*map(len, runs)], run)) as k:
                member = build.add(first, k, flags=("nsw",))

                def at(values: list[Any]) -> Any:
                    """Return the index or number of this member: tables of indices have one entry for each run."""
                    if isinstance(values[0], float):
                        return self._ops.listed(values, member)
                    start = self._ops.listed([values[one.start] for one in runs], run)
                    return build.add(start, build.mul(k, INDEX(values[1] - values[0]), flags=("nsw",)), flags=("nsw",))

                self._write_member(group, at)

    def _write_member(self, group: Group, at: Callable[[list[Any]], Any]) -> None:
        """Write the value of one tree of a group; `at` returns its index or number in a place."""
        values: dict[Node, Any] = {}
        for node in group.nodes:
            leaf = group.leaves.get(node)
            if leaf is None:
                values[node] = self._value(node, [values[one] for one in node.arguments])
            elif leaf.kind == "number":
                number = at(leaf.values)
                values[node] = self._ops.constant(number) if isinstance(number, float) else self._ops.everywhere(number)
            else:
                values[node] = self._load(leaf.kind, at(leaf.values))
        self._store(values[group.nodes[-1]], group.target, at(group.places))
