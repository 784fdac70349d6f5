"""Initial values that contradict the history of a problem with delays.

If y_i' = h(y) − h(y(t − τ)), as for those who are infected and not yet ill, y_i − ∫ h(y(s)) ds over [t − τ, t] is
conserved. It is 0 if y_i holds what has come in during the last τ, and whatever y0 differs from that stays in y_i.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from .._base.arguments import Array
from .._functions.graph.nodes import Node, in_order
from .._functions.graph.switches import evaluated
from .._functions.layout import layout_of
from .._problem.problem import Problem
from .._sensitivity.landings import graph_of_python, of_past

#: Differences of y0 from what the history says, relative to both, that are not reported: the integral is a sum.
_SAME = 1e-3
#: Terms that cancel, relative to each.
_CANCELS = 1e-10
#: Parts of the history between its jumps, and points in each, of the integral over it.
_PARTS, _POINTS = 8, 8
_SEED = 11


def contradiction(problem: Problem) -> str | None:
    """Return a message that names the first component whose initial value contradicts the history; None: there is
    none, or f is not a function whose formula can be read."""
    delays, n, args = problem.delays, len(problem.y0), problem.args
    if delays is None or problem.inputs or problem.y0.dtype.kind == "c":
        return None
    made = graph_of_python(problem)
    if made is None:
        return None
    outputs, p, t0 = of_past(made.outputs, delays.count * n, n), layout_of(args).numbers, problem.t_span[0]
    for i, value in enumerate(outputs):
        j = _one_delay(value, n)
        if j is None:
            continue
        flow = _Flow(value, t0, n, n * delays.count, n * (1 + j), p)
        if not flow.passes_through(np.maximum(np.abs(problem.y0), np.abs(delays.before(t0, args)))):
            continue
        tau = delays.values(args, problem.y0)[j]
        jumps = [one.t for one in problem.breakpoints if t0 - tau < one.t < t0]
        times, weights = _rule([t0 - tau, *sorted(jumps), t0])
        content = sum(w * flow(delays.before(t, args), flow.none) for t, w in zip(times, weights, strict=True))
        start = float(problem.y0[i])
        if abs(start - content) > _SAME * max(abs(start), abs(content)):
            name = f"y0[{i}]" if problem._labels is None else f"y0 of {problem._labels[i]!r}"
            return (
                f"{name} = {start:g} contradicts the history: fun takes away from this component what it has added "
                f"{tau:g} earlier, and that is {content:g} in the history. The difference stays in the component "
                "throughout: change y0 or the history if it holds nothing else"
            )
    return None


def _one_delay(value: Node, n: int) -> int | None:
    """Return the delay of a value of y and of one y(t − τ_j), and not of t; None: it is another one."""
    nodes = list(in_order([value]))
    places = {node.value for node in nodes if node.op == "y"}
    past = {place // n - 1 for place in places if place >= n}
    of_both = len(past) == 1 and any(place < n for place in places)
    return past.pop() if of_both and all(node.op != "t" for node in nodes) else None


class _Flow:
    """A component of f as a function of y and of one delayed value."""

    def __init__(self, value: Node, t: float, n: int, past: int, place: int, p: Array) -> None:
        self._value, self._t, self._place, self._p = evaluated([value]), t, place, p
        self._x, self.none = np.zeros(n + past), np.zeros(n)

    def __call__(self, y: Array, z: Array) -> float:
        n = len(self.none)
        self._x[:n], self._x[self._place : self._place + n] = y, z
        with np.errstate(all="ignore"):
            return float(self._value(self._t, self._x, self._p)[0])

    def passes_through(self, sizes: Array) -> bool:
        """Return whether it is h(y) − h(z) with h(0) = 0, at random values of these sizes."""
        rng = np.random.default_rng(_SEED)
        a, b = (np.where(sizes > 0, sizes, 1.0) * rng.uniform(0.2, 1, len(sizes)) for _ in range(2))
        enters, leaves = self(a, self.none), self(self.none, b)
        size = _CANCELS * (abs(enters) + abs(leaves))
        none = abs(self(a, a)), abs(self(b, b)), abs(self(a, b) - enters - leaves)
        return bool(0 < size < np.inf and max(none) <= size)


def _rule(ends: Sequence[float]) -> tuple[Array, Array]:
    """Return the points and weights of an integral over the intervals between these times."""
    x, w = np.polynomial.legendre.leggauss(_POINTS)
    knots = np.unique(np.concatenate([np.linspace(a, b, _PARTS + 1) for a, b in pairwise(ends)]))
    half, middle = np.diff(knots) / 2, (knots[1:] + knots[:-1]) / 2
    return (middle[:, None] + half[:, None] * x).ravel(), (half[:, None] * w).ravel()
