"""Which cases a law is tested with. A case is worth its time if it can fail alone: all methods (the fixture `method`)
where the code under test is theirs, one of each family where it only meets their memory, two where it is the same for
all; and where several lists meet, some of their combinations instead of all (tests/mutation measures what is lost)."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable

import numpy as np
import pytest

import invariode as iv
from problems import implicit, switching

#: The methods for y' = f(t, y) with any f: over these the laws of steps, projection, events and output run. Those for
#: series and for second-order systems have fixtures of their own.
METHODS = {name: about for name, about in iv.METHODS.items() if about.equations == "any"}

#: One method of each family of formulas: its first one, of the explicit pairs the default method.
_FIRST = {about.family: name for name, about in reversed(list(METHODS.items()))}
FAMILIES = sorted((_FIRST | {METHODS["ode45"].family: "ode45"}).values(), key=list(METHODS).index)

#: The methods for stiff problems, and those of them that take M(t) and singular M.
IMPLICIT = [name for name in METHODS if implicit(name) and not switching(name)]
ALGEBRAIC = [name for name, about in METHODS.items() if about.mass == "any"]

#: The methods by Taylor series, for the laws whose f can be traced.
SERIES = [name for name, about in iv.METHODS.items() if about.equations == "graph"]

families = pytest.mark.parametrize("method", FAMILIES)
families_and_series = pytest.mark.parametrize("method", [*FAMILIES, *SERIES])
explicit_and_implicit = pytest.mark.parametrize("method", ["ode45", "ode15s"])

#: Fixtures that look up what a name stands for.
LOOKED_UP = ("problem", "run", "draw", "code", "algebraic_code")


@functools.cache
def places(count: int, lengths: tuple[int, ...]) -> list[tuple[int, ...]]:
    """`count` rows of the product of lists of such lengths, as places in them: each next one takes values that came
    least so far, and of those the pairs of values that came least."""
    left = np.array(list(itertools.product(*map(range, lengths))))
    sets = [[i] for i in range(len(lengths))], [*map(list, itertools.combinations(range(len(lengths)), 2))]
    came = [[np.zeros([lengths[i] for i in one], int) for one in several] for several in sets]
    rows = []
    for _ in range(count):
        often = [
            sum((counts[tuple(left[:, one].T)] for one, counts in zip(*both, strict=True)), np.zeros(len(left), int))
            for both in zip(sets, came, strict=True)
        ]
        least = np.lexsort(often[::-1])[0]
        row, left = left[least], np.delete(left, least, axis=0)
        for both in zip(sets, came, strict=True):
            for one, counts in zip(*both, strict=True):
                counts[tuple(row[one])] += 1
        rows.append(tuple(row.tolist()))
    return rows


def combinations(count: int, lists: list[list[object]]) -> list[tuple[object, ...]]:
    """`count` rows of the product of the lists, in which values and pairs of values come about equally often."""
    rows = places(count, tuple(map(len, lists)))
    return [tuple(values[i] for values, i in zip(lists, row, strict=True)) for row in rows]


def dealt(count: int | None = None, /, **lists: Iterable[object]) -> pytest.MarkDecorator:
    """Parametrize with `count` of the combinations of the lists; by default as many as the longest list has values, so
    that each value comes."""
    every = [list(values) for values in lists.values()]
    rows = combinations(count or max(map(len, every)), every)
    return pytest.mark.parametrize(tuple(lists), rows, indirect=[name for name in lists if name in LOOKED_UP])


class hidden:  # noqa: N801  # it reads like a function
    """A Python function as an object, which runs do not trace in passing, as it calls a function that is not
    known to have no effect: they meet its switching times unprepared."""

    def __init__(self, fun):
        self.fun = fun

    def __call__(self, *args):
        assert callable(self.fun)
        return self.fun(*args)
