"""Taylor coefficients of large graphs, as loops over the order in which equal operations are done side by side.

Nodes of one kind that do not need each other are a group. Its values lie one after the other: `first` has all
coefficients of order 0, `now` those of order k, and `work` a history of those that sums need. Members are sorted by
where their arguments are, so that these are often neighbours too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

from llvmlite import ir

from ..llvm_values import Value
from .nodes import Node
from .objects import SeriesForm
from .operations import DOUBLE, INDEX, POINTER, constants
from .recurrences import UNWEIGHTED, Program, Rule, Sum, alike, linear
from .series_writer import Inverse, SeriesWriter, inverse_of

#: Numbers in a vector; where registers are shorter it takes several.
_WIDTH = 8
#: Vectors that are summed side by side: additions need not wait for each other.
_SIDE_BY_SIDE = 4
#: From this many vectors on they are a loop; at order 0, which is computed once, from fewer.
_LOOPED, _LOOPED_AT_0 = 16, 3
#: Doubles that are kept on the stack; more are allocated.
_MOST_ON_STACK = 2**15


class Row(NamedTuple):
    """Coefficients of nodes by order.

    Attributes
    ----------
    name : str
        The array.
    start, stride : int
        Position of coefficients 0, and the distance to those of the next order.
    """

    name: str
    start: int
    stride: int


class Packed(NamedTuple):
    """Coefficients that are copied together."""

    row: Row  # to where
    nodes: list[Node]  # whose
    lag: int  # 0: before they are needed at the same order; 1: when an order is complete


class Members(NamedTuple):
    """Nodes of one kind."""

    nodes: list[Node]  # in the order of their places
    start: int  # the place of the first one
    rules: list[Rule]  # theirs, if they are not linear
    moving: bool  # coefficients of order k are needed


class Chunk(NamedTuple):
    """Members that are computed at once: how many, from which one on. `valid` of them are there; the last one is
    repeated."""

    start: Any
    width: int
    valid: int


def chunks(count: int, width: int) -> list[Chunk]:
    """Split `count` members into vectors of full width and a shorter one for the rest."""
    full = [Chunk(i, width, width) for i in range(0, count - width + 1, width)]
    rest = count - len(full) * width
    return [*full, *([Chunk(len(full) * width, 1 << (rest - 1).bit_length(), rest)] if rest else [])]


def padded(count: int, width: int) -> int:
    """Places that their vectors fill."""
    last = chunks(count, width)[-1]
    return int(last.start) + last.width


class Looped(SeriesWriter):
    """Loops over the order, and vectors of equal operations."""

    def __init__(self, module: Any, form: SeriesForm, found: Program) -> None:
        super().__init__(module, form)
        self._program = found
        self._width = _WIDTH if form.lanes == 1 else 1
        self._wide = {width: self._ops if width == 1 else self._ops.of_width(width) for width in (1, 2, 4, 8)}
        self._groups: list[Members] = []
        self._places: dict[Node, int] = {}
        self._count_of_places = self._size = 0
        self._histories: dict[int, Row] = {}
        self._packed: dict[tuple[int, tuple[Node, ...]], Packed] = {}
        self._inverses: dict[int, Row] = {}
        self._looped = _LOOPED_AT_0

    def _write(self, outputs: Sequence[Node]) -> bool:
        self._y = [outputs[0].graph.y(i) for i in range(self._form.n)]
        self._arrange()
        operands = [self._operands(group) for group in self._groups]
        with self._memory():
            self._begin(outputs)
            self._looped = _LOOPED
            last = self._form.order + self._form.along
            if last > 1:
                with self._loop(last, first=1) as k:
                    self._write_order(outputs, k, operands)
        self._build.ret_void()
        return True

    # Where everything is

    def _arrange(self) -> None:
        """Arrange the nodes in groups, each after the groups it needs."""
        self._put(self._y)
        for some in alike(self._program):
            nodes = sorted(some, key=lambda node: [self._places[one] for one in node.arguments])
            moving = nodes[0] in self._program.moving
            rules = [self._program.rules[one] for one in nodes] if moving and nodes[0] in self._program.rules else []
            self._groups.append(Members(nodes, self._put(nodes), rules, moving))

    def _put(self, nodes: Sequence[Node]) -> int:
        start = self._count_of_places
        self._places |= {node: start + i for i, node in enumerate(nodes)}
        self._count_of_places += padded(len(nodes), self._width) if nodes else 0
        return start

    def _room(self, count: int) -> int:
        """A place for so many numbers in `work`."""
        start = self._size
        self._size += count
        return start

    def _operands(self, group: Members) -> list[tuple[Row, Row]]:
        """Return the rows that hold the two factors of each sum of a group, and allocate those that are missing."""
        if not group.rules:
            return []
        if group.rules[0].divisor is not None:
            size = padded(len(group.nodes), self._width)
            self._inverses[group.start] = Row("work", self._room(2 * size), size)
        found = []
        for i in range(len(group.rules[0].sums)):
            sums = [one.sums[i] for one in group.rules]
            found.append(
                (self._row([s.left for s in sums], sums[0].last), self._row([s.right for s in sums], sums[0].first))
            )
        return found

    def _row(self, nodes: list[Node], lag: int) -> Row:
        places = [self._places[one] for one in nodes]
        neighbours = places == list(range(places[0], places[0] + len(places)))
        whole = len(nodes) == padded(len(nodes), self._width)
        if neighbours and nodes[-1].op == "y" and nodes[0].op == "y" and whole:
            return Row("y" if self._form.along else "out", places[0], self._form.n)
        owner = next((g for g in self._groups if g.start <= places[0] < g.start + len(g.nodes)), None)
        if neighbours and owner is not None and places[-1] < owner.start + len(owner.nodes):
            size = padded(len(owner.nodes), self._width)
            if owner.start not in self._histories:
                self._histories[owner.start] = Row("work", self._room((self._form.order + 1) * size + _WIDTH), size)
            row = self._histories[owner.start]
            return row._replace(start=row.start + places[0] - owner.start)
        key = (lag, tuple(nodes))
        if key not in self._packed:
            size = padded(len(nodes), self._width)
            row = Row("work", self._room((self._form.order + 1) * size), size)
            self._packed[key] = Packed(row, nodes, lag)
        return self._packed[key].row

    @contextmanager
    def _memory(self) -> Iterator[None]:
        """Arrays for the time of the call."""
        build, lanes = self._build, self._form.lanes
        places = self._count_of_places + _WIDTH
        total = (2 * places + self._size) * lanes
        allocate = ir.FunctionType(POINTER, [INDEX])
        if total <= _MOST_ON_STACK:
            memory = build.alloca(DOUBLE, total)
        else:
            memory = build.call(ir.Function(self._module, allocate, "malloc"), [INDEX(8 * total)])
        for i, name in enumerate(("first", "now", "work")):
            self._given[name] = build.gep(memory, [INDEX(i * places * lanes)], inbounds=True)
        yield
        if total > _MOST_ON_STACK:
            build.call(ir.Function(self._module, ir.FunctionType(ir.VoidType(), [POINTER]), "free"), [memory])

    # Vectors

    def _vector(self, name: str, index: Any, width: int) -> Any:
        """A pointer to so many neighbours."""
        place = self._place(name, index)
        return place if width == 1 else self._build.bitcast(place, self._wide[width].kind.as_pointer())

    def _read(self, name: str, index: Any, width: int) -> Value:
        return self._of(self._build.load(self._vector(name, index, width), align=8))

    def _keep(self, value: Value, name: str, index: Any, width: int) -> None:
        self._build.store(value.ir, self._vector(name, index, width), align=8)
        self._count(2)

    def _gathered(self, name: str, indices: list[int], chunk: Chunk, *, strict: bool = False) -> Value:
        """Numbers of an array at the indices of the members. Strict: there is nothing after the last one."""
        neighbours = indices == list(range(indices[0], indices[0] + len(indices)))
        if not isinstance(chunk.start, int):
            if neighbours:
                return self._read(name, self._plus(chunk.start, indices[0]), chunk.width)
            table = constants(self._module, INDEX, [*indices, *[indices[-1]] * _WIDTH])
            at: list[Any] = [
                self._build.load(self._build.gep(table, [INDEX(0), self._plus(chunk.start, i)], inbounds=True))
                for i in range(chunk.width)
            ]
        else:
            at = indices[chunk.start : chunk.start + chunk.valid]
            if at == list(range(at[0], at[0] + len(at))) and not (strict and chunk.valid < chunk.width):
                return self._read(name, at[0], chunk.width)
            at = [*at, *[at[-1]] * (chunk.width - chunk.valid)]
        if chunk.width == 1:
            return self._read(name, at[0], 1)
        found = ir.Constant(self._wide[chunk.width].kind, ir.Undefined)
        for i, one in enumerate(at):
            found = self._build.insert_element(found, self._load(name, one), ir.IntType(32)(i))
        self._count(2 * chunk.width)
        return self._of(found)

    def _plus(self, index: Any, more: int) -> Any:
        if isinstance(index, int):
            return index + more
        return self._build.add(index, INDEX(more), flags=("nsw",)) if more else index

    def _numbers(self, values: list[float], chunk: Chunk) -> Value:
        """Constants."""
        kind = self._wide[chunk.width].kind
        if len({*map(repr, values)}) == 1:
            return self._of(self._wide[chunk.width].constant(values[0]))
        if isinstance(chunk.start, int):
            own = values[chunk.start : chunk.start + chunk.valid]
            own += [own[-1]] * (chunk.width - chunk.valid)
            if chunk.width == 1:
                return self._constant(own[0])
            return self._of(ir.Constant(kind, [DOUBLE(one) for one in own]))
        table = self._ops.table([*values, *[values[-1]] * _WIDTH])
        place = self._build.gep(table, [INDEX(0), chunk.start], inbounds=True)
        if chunk.width == 1:
            return self._of(self._ops.everywhere(self._build.load(place)))
        return self._of(self._build.load(self._build.bitcast(place, kind.as_pointer()), align=8))

    def _values(self, name: str, nodes: Sequence[Node], chunk: Chunk) -> Value:
        """Coefficients of nodes, one for each member."""
        if all(one.op == "number" for one in nodes):
            return self._numbers([one.value if name == "first" else 0.0 for one in nodes], chunk)
        return self._gathered(name, [self._places[one] for one in nodes], chunk)

    def _firsts(self, nodes: Sequence[Node], chunk: Chunk) -> Value:
        """Coefficients of order 0; truths are kept as numbers."""
        found = self._values("first", nodes, chunk)
        if not nodes[0].is_truth:
            return found
        return self._of(self._build.fcmp_unordered("!=", found.ir, self._wide[chunk.width].constant(0.0)))

    def _everywhere(self, number: Any, width: int) -> Value:
        """Return one number for all members, and for all lanes."""
        return self._of(self._wide[width].everywhere(number))

    def _each_chunk(self, count: int, write: Callable[[Chunk], None]) -> None:
        """Call `write` for each chunk of members, in a loop if there are many."""
        found = chunks(count, self._width)
        full = [one for one in found if one.valid == self._width]
        if len(full) < self._looped:
            full = []
        else:
            with self._loop(len(full)) as i:
                start = i if self._width == 1 else self._build.mul(i, INDEX(self._width), flags=("nsw",))
                write(Chunk(start, self._width, self._width))
        for one in found[len(full) :]:
            write(one)

    # Order 0

    def _begin(self, outputs: Sequence[Node]) -> None:
        """Write all coefficients of order 0, the first of y' and the reciprocals that some of them need."""
        self._each_chunk(len(self._y), self._begin_y)
        for group in self._groups:
            self._each_chunk(len(group.nodes), partial(self._begin_members, group))
        for group in self._groups:
            if group.start in self._inverses:
                self._each_chunk(len(group.nodes), partial(self._invert, group))
        self._pack("first", INDEX(0), [*self._packed.values()])
        self._end_order("first", outputs, INDEX(0))

    def _begin_y(self, chunk: Chunk) -> None:
        value = self._gathered("y", list(range(self._form.n)), chunk, strict=True)
        self._keep(value, "first", chunk.start, chunk.width)
        if not self._form.along:
            self._output(value, INDEX(0), self._form.n, chunk)

    def _begin_members(self, group: Members, chunk: Chunk) -> None:
        model, wide = group.nodes[0], self._wide[chunk.width]
        if model.op == "number":
            value = self._numbers([one.value for one in group.nodes], chunk).ir
        elif model.op == "p":
            value = self._gathered("p", [one.value for one in group.nodes], chunk, strict=True).ir
        elif model.op == "t":
            value = self._value(model, [])
        else:
            arguments = [
                self._firsts([one.arguments[i] for one in group.nodes], chunk).ir for i in range(len(model.arguments))
            ]
            value = wide.value(model, arguments)
        if model.is_truth:
            value = self._build.select(value, wide.constant(1.0), wide.constant(0.0))
        at = self._plus(chunk.start, group.start)
        self._keep(self._of(value), "first", at, chunk.width)
        if not group.moving:
            self._keep(self._of(wide.constant(0.0)), "now", at, chunk.width)
        self._remember(group, self._of(value), INDEX(0), chunk)

    def _invert(self, group: Members, chunk: Chunk) -> None:
        divisors = [one.divisor for one in group.rules if one.divisor is not None]
        d = self._firsts(divisors, chunk)
        multiple = group.rules[0].multiple or 1.0
        d = d if multiple == 1 else d * multiple
        one = self._of(self._wide[chunk.width].constant(1.0))
        high = one / d
        row = self._inverses[group.start]
        self._keep(high, "work", self._plus(chunk.start, row.start), chunk.width)
        self._keep(
            (-d).times_plus(high, one) * high, "work", self._plus(chunk.start, row.start + row.stride), chunk.width
        )

    # Order k

    def _write_order(self, outputs: Sequence[Node], k: Any, operands: Sequence[list[tuple[Row, Row]]]) -> None:
        if self._form.along:
            self._each_chunk(self._form.n, lambda chunk: self._next_given(k, chunk))
        waiting = {one.row: one for one in self._packed.values() if not one.lag}
        for group, rows in zip(self._groups, operands, strict=True):
            if not group.moving:
                continue
            self._pack("now", k, [waiting.pop(row) for pair in rows for row in dict.fromkeys(pair) if row in waiting])
            if group.nodes[0].op == "t":
                is_first = self._of(self._build.icmp_signed("==", k, INDEX(1)))
                value = is_first.choose(self._of(self._unit), self._constant(0.0))
                self._keep(value, "now", group.start, 1)
                self._remember(group, value, k, Chunk(0, 1, 1))
            elif group.rules:
                self._next_sums(group, rows, k)
            else:
                self._each_chunk(len(group.nodes), partial(self._next_linear, group, k))
        self._pack("now", k, [one for one in self._packed.values() if one.lag])
        self._end_order("now", outputs, k)

    def _next_given(self, k: Any, chunk: Chunk) -> None:
        """Write the next coefficients of y, which are those of a given polynomial."""
        before = self._build.mul(k, INDEX(self._form.n), flags=("nsw",))
        for i in range(chunk.valid):
            at = self._build.add(before, self._index(self._plus(chunk.start, i)), flags=("nsw",))
            self._keep(self._read("y", at, 1), "now", self._plus(chunk.start, i), 1)

    def _next_linear(self, group: Members, k: Any, chunk: Chunk) -> None:
        model = group.nodes[0]
        nodes = {one: [each.arguments[i] for each in group.nodes] for i, one in enumerate(model.arguments)}
        self._finish(group, linear(model, _Now(self, nodes, k, chunk), self._program.degrees), k, chunk)

    def _finish(self, group: Members, value: Value, k: Any, chunk: Chunk) -> None:
        self._keep(value, "now", self._plus(chunk.start, group.start), chunk.width)
        self._remember(group, value, k, chunk)

    def _remember(self, group: Members, value: Value, k: Any, chunk: Chunk) -> None:
        row = self._histories.get(group.start)
        if row is not None:
            self._keep(value, row.name, self._at(row, k, chunk.start), chunk.width)

    def _pack(self, name: str, k: Any, rows: Sequence[Packed]) -> None:
        for row, nodes, _ in rows:

            def copy(chunk: Chunk, row: Row = row, nodes: list[Node] = nodes) -> None:
                self._keep(self._values(name, nodes, chunk), row.name, self._at(row, k, chunk.start), chunk.width)

            self._each_chunk(len(nodes), copy)

    def _end_order(self, name: str, outputs: Sequence[Node], k: Any) -> None:
        """The values of order k; of a solution the next coefficients, y_k+1 = unit f_k / (k + 1)."""
        if self._form.along:
            self._each_chunk(
                len(outputs), lambda chunk: self._output(self._values(name, outputs, chunk), k, len(outputs), chunk)
            )
            return
        following = self._build.add(k, INDEX(1), flags=("nsw",))

        def advance(chunk: Chunk) -> None:
            unit = self._everywhere(self._unit, chunk.width) if self._form.lanes == 1 else self._of(self._unit)
            high, low = self._inverse_of_order(following, chunk.width)
            value = Inverse(high * unit, low * unit).times(self._values(name, outputs, chunk))
            self._keep(value, "now", chunk.start, chunk.width)
            self._output(value, following, self._form.n, chunk)

        self._each_chunk(self._form.n, advance)

    def _output(self, value: Value, k: Any, n: int, chunk: Chunk) -> None:
        """Store members of a chunk in row k of n of the output."""
        at = self._at(Row("out", 0, n), k, chunk.start)
        if chunk.valid == chunk.width:
            self._keep(value, "out", at, chunk.width)
            return
        for i in range(chunk.valid):
            one = self._build.extract_element(value.ir, ir.IntType(32)(i))
            self._keep(self._of(one), "out", self._plus(at, i), 1)

    def _at(self, row: Row, k: Any, start: Any) -> Any:
        """Return the position of the coefficients k of members."""
        before = self._build.mul(k, INDEX(row.stride), flags=("nsw",))
        return self._build.add(before, self._index(self._plus(start, row.start)), flags=("nsw",))

    def _inverse_of_order(self, k: Any, width: int) -> Inverse:
        """1/k."""
        parts = [inverse_of(float(i)) for i in range(1, self._form.order + 1)]
        tables = (self._ops.table([0.0, *(one[i] for one in parts)]) for i in range(2))
        return Inverse(*(self._everywhere(self._ops.entry_of(one, k), width) for one in tables))

    # Sums

    def _next_sums(self, group: Members, rows: list[tuple[Row, Row]], k: Any) -> None:
        """Blocks of vectors side by side, and what remains."""
        found = chunks(len(group.nodes), self._width)
        full = [one for one in found if one.valid == self._width]
        blocks = len(full) // _SIDE_BY_SIDE
        if blocks * _SIDE_BY_SIDE >= _LOOPED:
            with self._loop(blocks) as i:
                start = self._build.mul(i, INDEX(_SIDE_BY_SIDE * self._width), flags=("nsw",))
                places = [self._plus(start, j * self._width) for j in range(_SIDE_BY_SIDE)]
                self._next_block(group, rows, k, [Chunk(one, self._width, self._width) for one in places])
            full = full[blocks * _SIDE_BY_SIDE :]
        for i in range(0, len(full), _SIDE_BY_SIDE):
            self._next_block(group, rows, k, full[i : i + _SIDE_BY_SIDE])
        if found[-1].valid < self._width:
            self._next_block(group, rows, k, found[-1:])

    def _next_block(self, group: Members, rows: list[tuple[Row, Row]], k: Any, block: list[Chunk]) -> None:
        made = group.rules[0]
        sums = [self._summed(one, *pair, k, block) for one, pair in zip(made.sums, rows, strict=True)]
        nodes = {one: [each.now[i] for each in group.rules] for i, one in enumerate(made.now)}
        for i, chunk in enumerate(block):
            value = made.numerator(_Now(self, nodes, k, chunk), *(one[i] for one in sums))
            if made.divisor is not None:
                row = self._inverses[group.start]
                high, low = (
                    self._read("work", self._plus(chunk.start, row.start + part * row.stride), chunk.width)
                    for part in range(2)
                )
                value = Inverse(high, low).times(value)
                value = self._inverse_of_order(k, chunk.width).times(value) if made.multiple else value
            elif made.multiple:
                value = self._inverse_of_order(k, chunk.width).times(value)
            self._finish(group, value, k, chunk)

    def _summed(self, total: Sum, left: Row, right: Row, k: Any, block: list[Chunk]) -> list[Value]:
        """The sum for the members of each chunk."""
        build, width = self._build, block[0].width

        def factor(row: Row, j: Any, chunk: Chunk) -> Value:
            return self._read(row.name, self._at(row, j, chunk.start), width)

        def add(j: Any, before: list[Value]) -> list[Value]:
            other = build.sub(k, j, flags=("nsw",))
            pairs = [(factor(left, j, one), factor(right, other, one)) for one in block]
            if total.weight != UNWEIGHTED:
                weight = self._weight(total, j, k, width)
                pairs = [(one * weight, other) for one, other in pairs]
            return [a.times_plus(b, one) for (a, b), one in zip(pairs, before, strict=True)]

        zeros = [self._of(self._wide[width].constant(0.0)) for _ in block]
        if not total.is_square:
            return self._accumulated(total.first, build.sub(k, INDEX(total.last - 1)), zeros, add)
        half = self._accumulated(total.first, build.lshr(build.add(k, INDEX(1)), INDEX(1)), zeros, add)
        middle = build.lshr(k, INDEX(1))
        is_even = self._of(build.icmp_signed("==", build.and_(k, INDEX(1)), INDEX(0)))
        found = []
        for one, chunk in zip(half, block, strict=True):
            square = is_even.choose(factor(left, middle, chunk), zeros[0])
            found.append(square.times_plus(square, one + one))
        return found

    def _weight(self, total: Sum, j: Any, k: Any, width: int) -> Value:
        a, b = total.weight
        value = self._of(self._build.sitofp(j, DOUBLE))
        value = value if a == 1 else value * a
        value = value - self._of(self._build.sitofp(k, DOUBLE)) * b if b else value
        return self._everywhere(value.ir, width)

    def _accumulated(
        self, first: int, end: Any, start: list[Value], add: Callable[[Any, list[Value]], list[Value]]
    ) -> list[Value]:
        """A loop over j from `first` to below `end`, perhaps never."""
        build, before = self._build, self._build.block
        head, body, after = (self._function.append_basic_block() for _ in range(3))
        build.branch(head)
        build.position_at_end(head)
        j = build.phi(INDEX)
        sums = [build.phi(one.ir.type) for one in start]
        j.add_incoming(INDEX(first), before)
        for phi, one in zip(sums, start, strict=True):
            phi.add_incoming(one.ir, before)
        build.cbranch(build.icmp_signed("<", j, end), body, after)
        build.position_at_end(body)
        found = add(j, [self._of(one) for one in sums])
        following = build.add(j, INDEX(1), flags=("nsw",))
        j.add_incoming(following, build.block)
        for phi, one in zip(sums, found, strict=True):
            phi.add_incoming(one.ir, build.block)
        build.branch(head)
        build.position_at_end(after)
        self._in_block = 0
        return [self._of(one) for one in sums]


class _Now:
    """Known coefficients of order k of the members of a chunk."""

    def __init__(self, writer: Looped, nodes: dict[Node, list[Node]], k: Any, chunk: Chunk) -> None:
        self._writer, self._nodes, self._order, self._chunk = writer, nodes, k, chunk

    @property
    def k(self) -> Value:
        writer = self._writer
        return writer._everywhere(writer._build.sitofp(self._order, DOUBLE), self._chunk.width)

    def now(self, node: Node) -> Any:
        if self._writer._program.degrees[node] == 0:
            return 0.0
        return self._writer._values("now", self._nodes[node], self._chunk)

    def first(self, node: Node) -> Value:
        return self._writer._firsts(self._nodes[node], self._chunk)

    def over(self, number: Any, node: Node) -> Value:
        quotient: Value = number / self.first(node)
        return quotient
