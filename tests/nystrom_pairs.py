"""The Runge-Kutta-Nyström pairs as printed, their order conditions, and how their continuous extensions are derived.

``python tests/nystrom_pairs.py rkn86`` writes the numbers of core/methods/rkn86.hpp. Everything is computed with 60
digits from data/nystrom_pairs.json, the coefficients as their authors print them; r is the root of 8581.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from mpmath import lu_solve, matrix, mp, mpf, sqrt

mp.dps = 60
#: What is left of exact cancellation: rkn1210 has coefficients of size 50, printed with some 50 digits.
ROUNDOFF = mpf(10) ** -50
#: Coefficients that are smaller are 0; the smallest others are of size 1e-6.
NOISE = mpf(10) ** -40
_PRINTED = json.loads((Path(__file__).parent / "data" / "nystrom_pairs.json").read_text())

Numbers = list[mpf]
#: A tree of f: its leaves, derivatives of y by velocities, and the trees below its derivatives by positions.
Tree = tuple[int, tuple["Tree", ...]]

#: Times of the extensions' further stages. Each of their arguments is a value of the extension before it, whose order
#: in q stands in front; after them stands that of the extension itself, which is as high as the stages permit. For
#: rkn1210 four of them, or five that lie symmetrically, permit no more than order 10.
EXTENSIONS = {
    "rkn64": (6, [], 6),
    "rkn86": (6, ["1/4", "1/2", "3/4"], 8),
    "rkn1210": (9, ["1/7", "2/7", "1/2", "2/3", "6/7"], 11),
}


def number(text: str) -> mpf:
    """p/q, or p + q r with such p and q."""
    values = [_rational(part) for part in text.replace("- ", "+ -").removesuffix(" r").split(" + ")]
    return values[0] + (values[1] * sqrt(mpf(8581)) if text.endswith("r") else 0)


def _rational(text: str) -> mpf:
    top, _, bottom = text.partition("/")
    return mpf(top) / mpf(bottom or 1)


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair whose last stage is f at the end of the step, and further stages after it."""

    c: Numbers
    A: list[Numbers]
    b_bar: Numbers
    b: Numbers
    lower_b_bar: Numbers
    lower_b: Numbers
    last: int
    _sums: dict[Tree, Numbers] = field(default_factory=dict)

    def with_stage(self, c: mpf, row: Numbers) -> Pair:
        return replace(self, c=[*self.c, c], A=[*self.A, row], _sums={})

    def stage_sums(self, tree: Tree) -> Numbers:
        """Φ_i of the tree, for all stages."""
        if tree not in self._sums:
            sums = [x ** tree[0] for x in self.c]
            for branch in tree[1]:
                below = self.stage_sums(branch)
                sums = [x * _product(row, below) for x, row in zip(sums, self.A, strict=True)]
            self._sums[tree] = sums
        return self._sums[tree]


def _product(row: Numbers, values: Numbers) -> mpf:
    return sum((a * y for a, y in zip(row, values, strict=False) if a), mpf(0))


def printed(name: str) -> Pair:
    """The pair as its authors give it, with f at the end as its last stage."""
    given = _PRINTED[name]
    A = [[number(x) for x in row] for row in given["A"]]
    rows = {key: [number(x) for x in given[key]] for key in ("c", "b_bar", "b", "lower_b_bar", "lower_b")}
    if A[-1] != rows["b_bar"][:-1]:
        A.append(rows["b_bar"])
        rows = {key: [*row, mpf(key == "c")] for key, row in rows.items()}
    return Pair(A=A, last=len(A) - 1, **rows)


# ----------------------------------------------------------------------------------------------------------------------
# Order conditions


@cache
def trees(order: int) -> list[Tree]:
    """The special Nyström trees of so many nodes whose root is an f (Hairer, Nørsett, Wanner I, section II.14)."""
    found: list[Tree] = []

    def fill(left: int, highest: tuple[int, int], branches: list[Tree]) -> None:
        found.append((left, tuple(branches)))
        for r in range(1, left):  # a branch of r nodes, and the node that it hangs from
            for k, one in enumerate(trees(r)):
                if (r, k) <= highest:
                    fill(left - r - 1, (r, k), [*branches, one])

    fill(order - 1, (order, 0), [])
    return found


@cache
def nodes(tree: Tree) -> int:
    return 1 + tree[0] + sum(1 + nodes(branch) for branch in tree[1])


@cache
def factor(tree: Tree) -> mpf:
    """Return the factor of f = factor t^(nodes − 1) on the exact solution."""
    product = mpf(1)
    for branch in tree[1]:
        product *= factor(branch) / (nodes(branch) * (nodes(branch) + 1))
    return product


def defect(pair: Pair, w: Numbers, order: int, *, position: bool, theta: mpf | int = 1) -> mpf:
    """The largest residual in the conditions of this order alone, of a sum h² Σ w_i F_i or h Σ w_i F_i at t + θ h."""
    r = order - position
    exact = mpf(theta) ** order / (r * (r + 1) if position else r)
    return max(abs(_product(w, pair.stage_sums(tree)) - exact * factor(tree)) for tree in trees(r))


# ----------------------------------------------------------------------------------------------------------------------
# Extensions
#
# A polynomial that meets q, v and f at both ends is the quintic Hermite interpolant plus θ³ (1−θ)³ R(θ), with weights R
# of the stages. On a tree of order ρ, where q = factor θ^(ρ+1) / (ρ (ρ+1)), the interpolant misses θ³ (1−θ)³ Q(θ), a
# known Q: each power of R has linear equations of its own, one for each tree. Their solution of least norm is taken.

#: What elimination leaves of 0: the weights are known to ROUNDOFF.
_NOTHING = mpf(10) ** -40
_EDGE = [mpf(x) for x in (0, 0, 0, 1, -3, 3, -1)]  # θ³ (1−θ)³


def hermite(value: mpf, slope: mpf, curvature0: mpf, curvature1: mpf) -> Numbers:
    """The quintic from 0 with slope 0 to value and slope, with these second derivatives."""
    a, b, c = value - curvature0 / 2, slope - curvature0, curvature1 - curvature0
    return [mpf(0), mpf(0), curvature0 / 2, 10 * a - 4 * b + c / 2, -15 * a + 7 * b - c, 6 * a - 3 * b + c / 2]


def missed(power: int) -> Numbers:
    """Q of θ^power."""
    left = [-x for x in hermite(mpf(1), mpf(power), mpf(2 * (power == 2)), mpf(power * (power - 1)))]
    left += [mpf(0)] * (power + 1 - len(left))
    left[power] += 1
    quotient = [mpf(0)] * max(power - 5, 0)
    for k in range(power, 5, -1):
        quotient[k - 6] = -left[k]
        left = [x + left[k] * _EDGE[i - k + 6] if 0 <= i - k + 6 < 7 else x for i, x in enumerate(left)]
    return quotient


def independent(rows: list[tuple[Numbers, Numbers]]) -> list[tuple[Numbers, Numbers]]:
    """Independent ones of the equations Σ a_i x_i = b, for several b, by elimination; they must not contradict."""
    found = []
    for _ in range(len(rows[0][0])):
        size, i, j = max((abs(x), i, j) for i, (a, _) in enumerate(rows) for j, x in enumerate(a))
        if size < _NOTHING:
            break
        a, b = rows.pop(i)
        a, b = [x / a[j] for x in a], [x / a[j] for x in b]
        found.append((a, b))
        rows = [_without(row, j, (a, b)) for row in rows]
    left = max(abs(x) for _, b in rows for x in b)
    if left > _NOTHING:
        raise ArithmeticError(f"these stages do not permit this order: {mp.nstr(left, 3)} is left")
    return found


def _without(row: tuple[Numbers, Numbers], j: int, other: tuple[Numbers, Numbers]) -> tuple[Numbers, Numbers]:
    """The equation without its j-th unknown."""
    f = row[0][j]
    if f == 0:
        return row
    return tuple([x - f * y for x, y in zip(*sides, strict=True)] for sides in zip(row, other, strict=True))


def least_norm(equations: list[tuple[Numbers, Numbers]], k: int) -> Numbers:
    """The least x with the k-th right-hand sides."""
    gram = matrix([[sum(x * y for x, y in zip(a, b, strict=True)) for b, _ in equations] for a, _ in equations])
    multipliers = lu_solve(gram, matrix([b[k] for _, b in equations]))
    return [
        sum(m * a[i] for m, (a, _) in zip(multipliers, equations, strict=True)) for i in range(len(equations[0][0]))
    ]


def extension(pair: Pair, order: int) -> list[Numbers]:
    """Weights of the stages as polynomials in θ, coefficients of θ⁰, θ¹, …, of order `order` in q."""
    equations = []
    for r in range(1, order):
        Q = missed(r + 1)
        for tree in trees(r):
            scale = factor(tree) / (r * (r + 1))
            equations.append((pair.stage_sums(tree), [scale * (Q[e] if e < len(Q) else 0) for e in range(order - 5)]))
    equations = independent(equations)
    R = [least_norm(equations, e) for e in range(order - 5)]
    weights = []
    for i in range(len(pair.c)):
        b_bar, b = (row[i] if i < len(row) else mpf(0) for row in (pair.b_bar, pair.b))
        polynomial = hermite(b_bar, b, mpf(i == 0), mpf(i == pair.last)) + [mpf(0)] * (order - 5)
        for e, row in enumerate(R):
            for k, x in enumerate(_EDGE):
                polynomial[e + k] += row[i] * x
        weights.append(polynomial)
    return weights


def at(weights: list[Numbers], theta: mpf) -> Numbers:
    return [sum(x * theta**k for k, x in enumerate(row)) for row in weights]


def derivative(weights: list[Numbers]) -> list[Numbers]:
    return [[k * x for k, x in enumerate(row)][1:] for row in weights]


def nested(weights: list[Numbers]) -> list[Numbers]:
    """The coefficients of θ (B₀ + (1−θ) (B₁ + θ (B₂ + …))), of polynomials that vanish at 0."""
    rows = []
    for row in weights:
        B = list(row[1:])
        for j in range(0, len(B), 2):  # B_j + … is what is left of 1, θ, …: its value at 0 is B_j, and the rest is θ …
            for i in range(len(B) - 2, j - 1, -1):
                B[i] += B[i + 1]
            for i in range(j + 1, len(B)):
                B[i] = -B[i]
        rows.append(B)
    return rows


@cache
def complete(name: str) -> tuple[Pair, list[Numbers]]:
    """The pair with the further stages of its extension, and the extension's weights for q."""
    first, times, order = EXTENSIONS[name]
    pair = printed(name)
    between = extension(pair, first)
    for time in map(_rational, times):
        pair = pair.with_stage(time, at(between, time))
    return pair, extension(pair, order)


def tableau(name: str) -> dict[str, list]:
    """The numbers of the tableau in the core, as doubles."""
    pair, weights = complete(name)
    stages, size = pair.last + 1, len(pair.c)

    def doubles(row: Numbers, length: int = 0) -> list[float]:
        return [0.0 if abs(x) < NOISE else float(x) for x in [*row, *[mpf(0)] * (length - len(row))]]

    degree = len(weights[0]) - 1
    return {
        "c": doubles(pair.c),
        "A": [doubles(row, 0) for row in pair.A],
        "b": doubles(pair.b, 0),
        "E_q": doubles([x - y for x, y in zip(pair.b_bar, pair.lower_b_bar, strict=True)][:stages]),
        "E_v": doubles([x - y for x, y in zip(pair.b, pair.lower_b, strict=True)][:stages]),
        "B_q": [doubles(row, degree) for row in nested(weights)][:size],
        "B_v": [doubles(row, degree) for row in nested(derivative(weights))][:size],
    }


def main(name: str) -> None:
    def shown(x: float) -> str:
        return str(int(x)) if x == int(x) and abs(x) < 100 else repr(x)

    for key, rows in tableau(name).items():
        if isinstance(rows[0], list):
            print(f".{key} = {{{{" + ",\n".join("{" + ", ".join(map(shown, row)) + "}" for row in rows) + "}},")
        else:
            print(f".{key} = {{" + ", ".join(map(shown, rows)) + "},")


if __name__ == "__main__":
    main(sys.argv[1])
