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

from ..llvm_values import Value
from .machine import compiled
from .nodes import Node
from .objects import SeriesForm
from .operations import INDEX
from .recurrences import UNWEIGHTED, Program, Sum, linear, minus, plus, program
from .series_loops import Looped
from .series_writer import Inverse, SeriesWriter, inverse_of

#: Passes of optimisation take up to a third of the time, and the code is no faster: it has been written without what
#: they could remove (Kepler's orbit, the restricted three-body problem, the outer solar system at orders 15 and 19).
_LEVEL = 0


#: Products up to which every coefficient is written out: twice as fast as loops (the restricted three-body problem at
#: order 19), but more take longer than 0.3 s to compile.
_MOST_PRODUCTS = 2500


def is_small(found: Program, order: int) -> bool:
    """Return whether the coefficients are written out, as those of linear systems always are."""
    return found.sums * order * (order + 1) // 2 <= _MOST_PRODUCTS or found.solves


def written(outputs: Sequence[Node], form: SeriesForm) -> bytes:
    """Compile the Taylor coefficients for y' = these values, or for these values along a polynomial, to an
    `object_file`."""
    found = program(outputs)
    writer = Unrolled if is_small(found, form.order) else Looped
    return compiled(form.lanes, lambda module: writer(module, form, found), outputs, _LEVEL)


class Unrolled(SeriesWriter):
    """Writer of every coefficient by instructions of its own."""

    def __init__(self, module: Any, form: SeriesForm, found: Program) -> None:
        super().__init__(module, form)
        self._program = found

    def _write(self, outputs: Sequence[Node]) -> bool:
        self._known: dict[Node, list[Any]] = {node: [] for node in self._program.nodes}
        self._inverses: dict[tuple[Node | None, float], Inverse] = {}
        self._units: dict[int, Inverse] = {}
        self._multiples: dict[tuple[Node, int, float], Any] = {}
        self._entries: dict[tuple[Node, int, int], Value] = {}
        n, last = self._form.n, self._form.order
        graph = outputs[0].graph
        y = [graph.y(i) for i in range(n)]
        for one in y:
            self._known.setdefault(one, [])
        unit = self._of(self._unit)
        for k in range(last + 1):
            for i, one in enumerate(y):
                self._known[one].append(
                    self._solution(outputs[i], unit, k) if k and not self._form.along else self._given_row(k, i)
                )
            if k == last and not self._form.along:
                self._store_row(y, k)
                break
            for node in self._program.nodes:
                if node.op != "y" and (k == 0 or node in self._program.moving):
                    self._known[node].append(self._coefficient(node, k))
                    self._count(k + 1)
            self._store_row(outputs if self._form.along else y, k)
        self._build.ret_void()
        return False

    def _given_row(self, k: int, i: int) -> Value:
        return self._of(self._load("y", k * self._form.n + i))

    def _store_row(self, nodes: Sequence[Node], k: int) -> None:
        for i, node in enumerate(nodes):
            value = self._now(node, k)
            self._store(self._ops.constant(value) if isinstance(value, float) else value.ir, "out", k * len(nodes) + i)

    def _now(self, node: Node, k: int) -> Any:
        known = self._known[node]
        return known[k] if k < len(known) else 0.0

    def _solution(self, slope: Node, unit: Value, k: int) -> Any:
        """y_k = unit f_{k−1} / k. Products with a power of two are exact."""
        f = self._now(slope, k - 1)
        if isinstance(f, float):
            return f
        if k not in self._units:
            high, low = inverse_of(float(k))
            self._units[k] = Inverse(unit * high, unit * low)
        return self._units[k].times(f)

    def _coefficient(self, node: Node, k: int) -> Any:
        if k == 0:
            return self._of(self._value(node, [self._known[one][0].ir for one in node.arguments]))
        if node.op == "t":
            return self._of(self._unit) if k == 1 else 0.0
        if self._program.degrees[node] < k:
            return 0.0
        if node.op in ("solve", "entry"):
            return self._of_system(node, k)
        at = _CodeOfCoefficients(self, k)
        if node not in self._program.rules:
            return linear(node, at, self._program.degrees)
        made = self._program.rules[node]
        number = made.numerator(at, *(self._sum(one, k) for one in made.sums))
        if made.divisor is None and made.multiple == 0:
            return number
        return self._over(number, made.divisor, made.multiple * k or 1.0)

    def _over(self, number: Value, divisor: Node | None, multiple: float) -> Value:
        """The number over the coefficient 0 of a node, and over a number."""
        if (divisor, multiple) not in self._inverses:
            by = None if divisor is None else self._known[divisor][0]
            self._inverses[divisor, multiple] = self._inverse(by, multiple)
        return self._inverses[divisor, multiple].times(number)

    def _sum(self, total: Sum, k: int) -> Any:
        """The sum, the terms with the newest factors last: the others need not wait for them."""
        if total.is_square:
            return self._square(total, k)
        terms = []
        for j in sorted(range(total.first, k - total.last + 1), key=lambda j: (max(j, k - j), j)):
            left, right = self._now(total.left, j), self._now(total.right, k - j)
            if isinstance(left, float) or isinstance(right, float):
                continue
            slope, base = total.weight
            weight = slope * j - base * k if total.weight != UNWEIGHTED else 1.0
            if weight == 0:
                continue
            if 2 * j > k:  # the older factor is ready
                right = self._times(total.right, k - j, weight)
            else:
                left = self._times(total.left, j, weight)
            terms.append((left, right))
        old = max(len(terms) - 2, 0)
        return self._chain(self._sum_of(terms[:old]), terms[old:])

    def _times(self, node: Node, k: int, weight: float) -> Any:
        """A coefficient with a factor."""
        if weight == 1:
            return self._now(node, k)
        key = (node, k, weight)
        if key not in self._multiples:
            self._multiples[key] = self._now(node, k) * weight
        return self._multiples[key]

    def _square(self, total: Sum, k: int) -> Any:
        """Pairs of equal terms, and the one in the middle."""
        pairs = []
        for j in reversed(range(total.first, (k + 1) // 2)):
            left, right = self._now(total.left, j), self._now(total.left, k - j)
            if not isinstance(left, float) and not isinstance(right, float):
                pairs.append((j, left, right))
        found = self._sum_of([one[1:] for one in pairs[:-1]])
        found = 0.0 if isinstance(found, float) else found + found
        if k % 2 == 0 and k // 2 >= total.first:
            middle = self._now(total.left, k // 2)
            found = found if isinstance(middle, float) else self._chain(found, [(middle, middle)])
        return self._chain(found, [(self._times(total.left, j, 2.0), right) for j, _, right in pairs[-1:]])

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
        numbers = [self._known[one][0] for one in node.arguments[: form.entries]]
        for i in range(form.k):
            for c in range(form.m):
                terms = [
                    (a, x)
                    for j in range(1, k + 1)
                    for row, one in matrix[i].items()
                    if not isinstance(a := self._now(one, j), float)
                    and not isinstance(x := self._entry(node, row * form.m + c, k - j), float)
                ]
                side = minus(self._now(right[i][c], k), self._sum_of(terms))
                numbers.append(self._constant(side) if isinstance(side, float) else side)
        return self._of(self._ops.value(node, [one.ir for one in numbers]))

    def _entry(self, system: Node, index: int, k: int) -> Any:
        """A number of the solution, whether or not an expression uses it."""
        solution = self._now(system, k)
        if isinstance(solution, float):
            return solution
        key = (system, index, k)
        if key not in self._entries:
            self._entries[key] = self._of(self._build.load(self._build.gep(solution.ir, [INDEX(index)])))
        return self._entries[key]


class _CodeOfCoefficients:
    """Known coefficients when those of order k are computed."""

    def __init__(self, writer: Unrolled, k: int) -> None:
        self._writer, self._k = writer, k
        self.k = float(k)

    def now(self, node: Node) -> Any:
        return self._writer._now(node, self._k)

    def first(self, node: Node) -> Any:
        return self._writer._known[node][0]

    def over(self, number: Any, node: Node) -> Any:
        return self._writer._over(number, node, 1.0)
