"""The continuous solution of a run that was not kept: parts of the run are solved again where they are needed.

The run remembers its whole state at every k-th accepted step. From there the same steps follow, bit for bit, as in a
run that is resumed.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import _core
from .._base.arguments import LARGEST_COUNT, Array, quietly
from .._plan.plan import Plan, solver
from .._results.result import DenseSolution, Result

#: So many sections are in memory at a time: a step backwards may begin in one and end in the next.
_IN_MEMORY = 2


class Sectioned(NamedTuple):
    """A run, or its extension, with what it remembers of its sections."""

    plan: Plan  # plan by which the steps were made
    #: For each section the accepted steps before it, its first t, and the internal state of the run there
    begins: list[tuple[int, float, bytes]]
    steps: int  # the accepted steps of the whole run

    @classmethod
    def of(cls, plan: Plan, run: _core.Run) -> Sectioned:
        """The sections of a run that has ended."""
        begins = run.take_sections()
        while begins and begins[-1][0] == run.steps:  # no step follows
            begins.pop()
        functions = plan.functions._replace(callback=None)  # it has let these steps pass
        course = plan.course._replace(times=None, max_points=LARGEST_COUNT, max_bytes=LARGEST_COUNT)
        settings = plan.settings._replace(
            refine=1,
            dense=True,
            sections=False,
            save_all=False,
            record=False,
            time_limit=math.inf,
        )
        return cls(
            plan._replace(functions=functions, course=course, settings=settings, checkpoint=None), begins, run.steps
        )


class _Section(NamedTuple):
    plan: Plan
    t: float
    memory: bytes
    steps: int  # in it
    last: int  # accepted steps of the run at its end

    def solved(self) -> _core.Dense:
        """Return the continuous solution of the section."""
        plan = self.plan._replace(settings=self.plan.settings._replace(max_steps=self.steps))
        with quietly():  # the run has warned
            run = solver(plan).resume(self.memory, False)
        dense = run.take_dense()
        if dense is None or run.steps != self.last:
            raise _not_the_same(run.t)
        return dense


def _not_the_same(t: float) -> ValueError:
    return ValueError(
        f"gradient: solved again from its checkpoints, the run took other steps up to t = {t:.6g}: a function of the "
        "problem depends on more than its arguments. Make it a function of these alone, or use adjoint=True"
    )


class SectionedSolution:
    """The solution as a function of t, like `DenseSolution`, of which two sections at a time are in memory.

    - `runs`: the run, and its extensions
    - `sol`: result of the run and its extensions
    - `y`, (n,): the state at the end
    - `imposed`: the solution is projected onto its invariants
    """

    def __init__(self, runs: Sequence[Sectioned], sol: Result, y: Array, *, imposed: bool) -> None:
        self._sol, self._y = sol, y
        self._imposed = {"rtol": sol._rtol, "atol": sol._atol} if imposed else None
        self._sections = [one for run in reversed(runs) for one in _sections(run)][::-1]
        self._forward = runs[-1].plan.course.forward
        self._begins = [self._forward * one.t for one in self._sections]
        self._solved: dict[int, DenseSolution] = {}  # the one used last is the last
        self._starts: dict[int, Array] = {}  # the first states of those that have been solved

    def __call__(self, t: Any) -> Array:
        times = np.asarray(t, dtype=float)
        if not self._sections:  # nothing was integrated
            return self._y.copy() if times.ndim == 0 else np.repeat(self._y[:, None], len(times), axis=1)
        if times.ndim == 0:
            return self._section(self._place(float(times)))(times)
        places = np.array([self._place(one) for one in times.tolist()], dtype=int)
        y = np.empty((len(self._y), len(times)), self._y.dtype)
        for place in np.unique(places):
            y[:, places == place] = self._section(int(place))(times[places == place])
        return y

    def knots(self) -> Iterator[Array]:
        """The ends of the steps of each section, its first t among them."""
        for place in range(len(self._sections)):
            yield self._section(place).ts

    def _place(self, t: float) -> int:
        """The section of t; where two meet, and the solution may jump, the later."""
        return max(bisect_right(self._begins, self._forward * t) - 1, 0)

    def _section(self, place: int) -> DenseSolution:
        found = self._solved.pop(place, None)
        if found is None:
            while len(self._solved) >= _IN_MEMORY:
                del self._solved[next(iter(self._solved))]
            dense, g = self._sections[place].solved(), self._sol._invariants
            ts = dense.knots()
            ends = DenseSolution(dense, self._y.dtype, g)(ts[[0, -1]])
            behind = self._sections[place + 1] if place + 1 < len(self._sections) else None
            t_end, y_end = (self._sol.t_end, self._y) if behind is None else (behind.t, self._starts.get(place + 1))
            if behind is not None and behind.plan is not self._sections[place].plan:
                y_end = None  # an extension may start beside it, on algebraic equations
            if ts[-1] != t_end or (y_end is not None and (ends[:, 1] != y_end).any()):
                raise _not_the_same(float(ts[-1]))
            self._starts[place] = ends[:, 0]
            found = DenseSolution(dense, self._y.dtype, g, self._imposed)
        self._solved[place] = found
        return found


def _sections(run: Sectioned) -> Iterator[_Section]:
    """Iterate over the sections from the last to the first."""
    last = run.steps
    for begin, t, memory in reversed(run.begins):
        yield _Section(run.plan, t, memory, last - begin, last)
        last = begin
