"""The comparison of a compiled f with the Python function that it was made of, along a solution."""

from __future__ import annotations

from typing import Literal

import numpy as np

from .._base.arguments import Array, warn
from .._functions.compiled import native_parameters
from .._functions.graph.function import TracedFunction
from .._problem.problem import Problem
from .._results.solution import Solution


def uncompared(problem: Problem) -> TracedFunction | None:
    """Return f if it was compiled from graphs that no run has compared with the Python function yet, else None."""
    fun = problem.fun
    return fun if isinstance(fun, TracedFunction) and fun.outputs and problem.delays is None else None


def compare(problem: Problem, sol: Solution, check: bool | Literal["strict"]) -> None:
    """Compare f as it was compiled with the Python function at the accepted points 1, 2, 4, 8, ... of a run and near
    its end.

    Raises ValueError: They differ by more than roundoff, and `check` is "strict". Otherwise that is a warning.
    """
    traced = uncompared(problem) if check else None
    if traced is None:
        return
    t, y = np.asarray(sol.t), np.asarray(sol.y)
    last = len(t) - 1
    near_end = {3 * last // 4, last} if len(t) else set()
    chosen = sorted({min(2**i, last) for i in range(len(t).bit_length())} | near_end)
    objection = _difference(problem, traced, t[chosen], y[:, chosen])
    if objection is None:
        traced.outputs.clear()
        return
    text = (
        f"{traced!r} differs from the function that it was made of: {objection}. It may use something that has changed "
        'since, or that tracing does not see; by="numba", or the function itself, does without tracing'
    )
    if check == "strict":
        raise ValueError(text)
    warn(text)


def _difference(problem: Problem, traced: TracedFunction, t: Array, y: Array) -> str | None:
    compiled = problem.slope(t, y)
    for at, state, values in zip(t.tolist(), y.T, compiled.T, strict=True):
        parameters = native_parameters((*(u(at) for u in problem.inputs), *problem.args), [traced])
        found = traced.disagreement(at, state.view(float), values.view(float), parameters)
        if found is not None:
            return f"at t = {at:.6g} {found}"
    return None
