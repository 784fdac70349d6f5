"""Taylor coefficients of solutions and of functions along polynomials, as machine code.

    void jet(double t, double unit, const double* y, double* out, const double* p)

Row k of out, of order + 1, has the coefficients of s^k: of the solution through (t, y) at t + unit s, of shape
(order + 1, n); or of a function with m values along a polynomial whose coefficients are y, (order + 1, n), of shape
(order + 1, m). In lanes every number, t and unit too, is a row of that many, and an unused pointer comes first.

A product and a sum are rounded once, by fma: the bits are the same on every processor, even where the library has to
compute it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir

from ..llvm_values import Value
from .machine import compiled
from .nodes import Node
from .objects import SeriesForm
from .operations import INDEX
from .recurrences import UNWEIGHTED, Program, Sum, alike, linear, minus, plus, program
from .series_loops import Looped
from .series_writer import Inverse, SeriesWriter, inverse_of

#: Passes of optimisation take up to a third of the time, and the code is no faster: it has been written without what
#: they could remove (Kepler's orbit, the restricted three-body problem, the outer solar system at orders 15 and 19).
_LEVEL = 0


#: Products up to which every coefficient is written out: two to four times as fast as loops (the restricted three-body
#: problem, three and four bodies in a plane), but more take longer than 0.3 s to compile.
_MOST_PRODUCTS = 3500


def is_small(found: Program, order: int) -> bool:
    """Return whether the coefficients are written out, as those of linear systems always are."""
    return found.sums * order * (order + 1) // 2 <= _MOST_PRODUCTS or found.solves


def written(outputs: Sequence[Node], form: SeriesForm) -> bytes:
    """Compile the Taylor coefficients for y' = these values, or for these values along a polynomial, to an
    `object_file`."""
    found = program(outputs)
    writer = Unrolled if is_small(found, form.order) else Looped
    return compiled(form.lanes, lambda module: writer(module, form, found), outputs, _LEVEL)


#: One node, whose coefficients are numbers, or two, whose coefficients are vectors of two numbers.
Group = tuple[Node, ...]


class Unrolled(SeriesWriter):
    """Writer of every coefficient by instructions of its own; where two nodes take the same operations, these are done
    on vectors of two numbers."""

    def __init__(self, module: Any, form: SeriesForm, found: Program) -> None:
        super().__init__(module, form)
        self._program = found
        self._unit_read = self._of(self._unit)
        self._wide = {1: self._ops, 2: self._ops.of_width(2)} if form.lanes == 1 else {1: self._ops}
        self._known: dict[Group, list[Any]] = {}
        self._places: dict[Node, tuple[Group, int]] = {}
        self._gathered: dict[tuple[Group, int], Any] = {}
        self._inverses: dict[tuple[Group | None, float, int], Inverse] = {}
        self._units: dict[tuple[int, int], Inverse] = {}
        self._multiples: dict[tuple[Group, int, float], Any] = {}
        self._entries: dict[tuple[Node, int, int], Value] = {}

    def _write(self, outputs: Sequence[Node]) -> bool:
        n, last, along = self._form.n, self._form.order, self._form.along
        y = [outputs[0].graph.y(i) for i in range(n)]
        width = 1 if along else max(self._wide)
        rows = [tuple(y[i : i + width]) for i in range(0, n, width)]
        groups = self._grouped()
        for group in (*rows, *groups):
            self._known[group] = []
            self._places |= {node: (group, place) for place, node in enumerate(group)}
        for k in range(last + 1):
            for group in rows:
                if k == 0 or along:
                    value = self._vector([self._of(self._load("y", k * n + one.value)) for one in group])
                else:
                    value = self._solution(tuple(outputs[one.value] for one in group), k)
                self._known[group].append(value)
            if k == last and not along:
                self._store_row(y, k)
                break
            for group in groups:
                if k == 0 or group[0] in self._program.moving:
                    self._known[group].append(self._coefficient(group, k))
                    self._count(k + 1)
            self._store_row(outputs if along else y, k)
        self._build.ret_void()
        return False

    def _grouped(self) -> list[Group]:
        """Return the nodes other than y in groups, each after the groups that it needs. A node is paired with the one
        that has most of its operands beside those of the first already."""
        found: dict[Group, None] = {}

        def beside(group: Group) -> int:
            operands = zip(*(node.arguments for node in group), strict=True)
            return sum(one is other or (one, other) in found for one, other in operands)

        for nodes in alike(self._program):
            waiting = [*nodes]
            pairs = len(self._wide) > 1 and nodes[0] in self._program.moving and nodes[0].op not in ("solve", "entry")
            while waiting:
                group: Group = (waiting.pop(0),)
                if pairs and waiting:
                    group = max(((*group, one) for one in waiting), key=beside)
                    waiting.remove(group[1])
                found[group] = None
        return [*found]

    def _now(self, nodes: Group, k: int) -> Any:
        """Coefficient k of nodes; the number 0 if that of all of them is known to be 0."""
        known = self._known.get(nodes)
        if known is not None:
            return known[k] if k < len(known) else 0.0
        if (nodes, k) not in self._gathered:
            if len(nodes) > 1:
                found = self._vector([self._now((one,), k) for one in nodes])
            else:
                group, place = self._places[nodes[0]]
                found = self._now(group, k)
                if not isinstance(found, float):
                    found = self._of(self._build.extract_element(found.ir, ir.IntType(32)(place)))
            self._gathered[nodes, k] = found
        return self._gathered[nodes, k]

    def _vector(self, numbers: Sequence[Any]) -> Any:
        """Return numbers beside each other; of one, the number."""
        if len(numbers) == 1 or all(isinstance(one, float) for one in numbers):
            return numbers[0]
        each = [self._ops.constant(one) if isinstance(one, float) else one.ir for one in numbers]
        found = ir.Constant(ir.VectorType(each[0].type, len(each)), ir.Undefined)
        for place, one in enumerate(each):
            found = self._build.insert_element(found, one, ir.IntType(32)(place))
        return self._of(found)

    def _store_row(self, nodes: Sequence[Node], k: int) -> None:
        left = [*nodes]
        while left:
            at = k * len(nodes) + len(nodes) - len(left)
            group, _ = self._places[left[0]]
            group = group if tuple(left[: len(group)]) == group else (left[0],)
            del left[: len(group)]
            value, place = self._now(group, k), self._place("out", at)
            kind = self._wide[len(group)].kind
            number = self._wide[len(group)].constant(value) if isinstance(value, float) else value.ir
            self._build.store(number, self._build.bitcast(place, kind.as_pointer()), align=8)

    def _solution(self, slope: Group, k: int) -> Any:
        """y_k = unit f_{k−1} / k. Products with a power of two are exact."""
        f, width = self._now(slope, k - 1), len(slope)
        if isinstance(f, float):
            return f
        if (k, width) not in self._units:
            parts = [self._unit_read * one for one in inverse_of(float(k))]
            self._units[k, width] = Inverse(*(self._vector([one] * width) for one in parts))
        return self._units[k, width].times(f)

    def _coefficient(self, group: Group, k: int) -> Any:
        node, rules = group[0], self._program.rules
        if k == 0:
            return self._vector(
                [self._of(self._value(one, [self._now((each,), 0).ir for each in one.arguments])) for one in group]
            )
        if node.op == "t":
            return self._unit_read if k == 1 else 0.0
        if self._program.degrees[node] < k:
            return 0.0
        if node.op in ("solve", "entry"):
            return self._of_system(node, k)
        if node not in rules:
            at = _CodeOfCoefficients(self, k, [one.arguments for one in group])
            return linear(node, at, self._program.degrees)
        made, of_group = rules[node], [rules[one] for one in group]
        at = _CodeOfCoefficients(self, k, [one.now for one in of_group])
        sums = zip(*(one.sums for one in of_group), strict=True)
        number = made.numerator(at, *(self._sum(one, k) for one in sums))
        if made.divisor is None and made.multiple == 0:
            return number
        divisors = tuple(one.divisor for one in of_group if one.divisor is not None)
        return self._over(number, divisors, made.multiple * k or 1.0, len(group))

    def _over(self, number: Value, divisors: Group, multiple: float, width: int) -> Value:
        """The number over the coefficient 0 of nodes, if any, and over a number."""
        key = divisors, multiple, width
        if key not in self._inverses:
            by = self._now(divisors, 0) if divisors else None
            self._inverses[key] = self._inverse(by, multiple, self._wide[width])
        return self._inverses[key].times(number)

    def _sum(self, totals: Sequence[Sum], k: int) -> Any:
        """The sum, the terms with the newest factors last: the others need not wait for them."""
        total = totals[0]
        lefts, rights = tuple(one.left for one in totals), tuple(one.right for one in totals)
        if total.is_square:
            return self._square(lefts, total.first, k)
        terms = []
        for j in sorted(range(total.first, k - total.last + 1), key=lambda j: (max(j, k - j), j)):
            left, right = self._now(lefts, j), self._now(rights, k - j)
            if isinstance(left, float) or isinstance(right, float):
                continue
            slope, base = total.weight
            weight = slope * j - base * k if total.weight != UNWEIGHTED else 1.0
            if weight == 0:
                continue
            if 2 * j > k:  # the older factor is ready
                right = self._times(rights, k - j, weight)
            else:
                left = self._times(lefts, j, weight)
            terms.append((left, right))
        old = max(len(terms) - 2, 0)
        return self._chain(self._sum_of(terms[:old]), terms[old:])

    def _times(self, nodes: Group, k: int, weight: float) -> Any:
        """A coefficient with a factor."""
        if weight == 1:
            return self._now(nodes, k)
        key = (nodes, k, weight)
        if key not in self._multiples:
            self._multiples[key] = self._now(nodes, k) * weight
        return self._multiples[key]

    def _square(self, nodes: Group, first: int, k: int) -> Any:
        """Pairs of equal terms, and the one in the middle."""
        pairs = []
        for j in reversed(range(first, (k + 1) // 2)):
            left, right = self._now(nodes, j), self._now(nodes, k - j)
            if not isinstance(left, float) and not isinstance(right, float):
                pairs.append((j, left, right))
        found = self._sum_of([one[1:] for one in pairs[:-1]])
        found = 0.0 if isinstance(found, float) else found + found
        if k % 2 == 0 and k // 2 >= first:
            middle = self._now(nodes, k // 2)
            found = found if isinstance(middle, float) else self._chain(found, [(middle, middle)])
        return self._chain(found, [(self._times(nodes, j, 2.0), right) for j, _, right in pairs[-1:]])

    def _sum_of(self, terms: Sequence[tuple[Value, Value]]) -> Any:
        """The sum of products, in two chains."""
        return plus(self._chain(0.0, terms[::2]), self._chain(0.0, terms[1::2]))

    def _chain(self, total: Any, terms: Sequence[tuple[Value, Value]]) -> Any:
        """A sum and products, one after the other."""
        for left, right in terms:
            total = left * right if isinstance(total, float) else left.times_plus(right, total)
        return total

    def _of_system(self, node: Node, k: int) -> Any:
        """A_0 X_k = B_k − Σ A_j X_{k−j}."""
        if node.op == "entry":
            return self._entry(node.arguments[0], node.value, k)
        form = node.value
        matrix, right = form.matrix(node.arguments), form.right(node.arguments)
        numbers = [self._now((one,), 0) for one in node.arguments[: form.entries]]
        for i in range(form.k):
            for c in range(form.m):
                terms = [
                    (a, x)
                    for j in range(1, k + 1)
                    for row, one in matrix[i].items()
                    if not isinstance(a := self._now((one,), j), float)
                    and not isinstance(x := self._entry(node, row * form.m + c, k - j), float)
                ]
                side = minus(self._now((right[i][c],), k), self._sum_of(terms))
                numbers.append(self._constant(side) if isinstance(side, float) else side)
        return self._of(self._ops.value(node, [one.ir for one in numbers]))

    def _entry(self, system: Node, index: int, k: int) -> Any:
        """A number of the solution, whether or not an expression uses it."""
        solution = self._now((system,), k)
        if isinstance(solution, float):
            return solution
        key = (system, index, k)
        if key not in self._entries:
            self._entries[key] = self._of(self._build.load(self._build.gep(solution.ir, [INDEX(index)])))
        return self._entries[key]


class _CodeOfCoefficients:
    """Known coefficients when those of order k are computed, of the nodes that the members of a group need: the first
    one's stand for those of all."""

    def __init__(self, writer: Unrolled, k: int, needed: Sequence[Sequence[Node]]) -> None:
        self._writer, self._k = writer, k
        self._groups: dict[Node, Group] = {group[0]: group for group in zip(*needed, strict=True)}
        self.k = float(k)

    def now(self, node: Node) -> Any:
        return self._writer._now(self._groups[node], self._k)

    def first(self, node: Node) -> Any:
        return self._writer._now(self._groups[node], 0)

    def over(self, number: Any, node: Node) -> Any:
        group = self._groups[node]
        return self._writer._over(number, group, 1.0, len(group))
