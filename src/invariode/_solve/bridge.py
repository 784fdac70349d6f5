"""Runs as functions of initial values and arguments, with derivatives: what `invariode.jax` and `invariode.torch` call.

Operands are tuples: y0, then each of `args`. The functions return arrays of doubles; what derivatives are with respect
to is chosen by the places of operands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, output_times, shown
from .._base.failures import SolveError
from .._base.latest import Latest
from .._base.types import MethodName
from .._functions.contents import content
from .._problem.options import Options
from .._problem.problem import Problem
from .._problem.sensitivities import Sensitivities
from .._results.solution import Solution
from .prepared_solver import PreparedSolver

Operands: TypeAlias = Sequence[Any]

#: Options that the bridge sets itself.
_OWN = ("t_eval", "dense_output", "keep", "refine", "progress")


class Bridge:
    """The solution of a problem at given times, or at the end, as a function of operands.

    Parameters
    ----------
    problem : Problem
        The problem, whose y0 and args the operands replace.
    t : array_like of shape (n_t,), or None
        The times. None: the end.
    method, options
        Those of the runs.

    Attributes
    ----------
    shape : tuple of int
        That of the solution: (n, n_t), or (n,).
    adjoint : bool
        Whether derivatives are wanted by the adjoint.
    faces : Latest
        What `invariode.jax` has made of the bridge.

    Raises
    ------
    TypeError, ValueError
        As for `Problem.solve`.
    """

    @staticmethod
    def of(problem: Problem, t: ArrayLike | None, method: MethodName, options: Options) -> Bridge:
        """Return the bridge of an earlier call with equal contents, or make it."""
        key = content((problem, None if t is None else np.asarray(t), method, dict(options)))
        return _bridges.find(key, lambda: Bridge(problem, t, method, options))

    def __init__(self, problem: Problem, t: ArrayLike | None, method: MethodName, options: Options) -> None:
        if not isinstance(problem, Problem):
            raise TypeError(f"solve needs an invariode.Problem, got {shown(problem)}")
        if np.iscomplexobj(problem.y0):
            raise ValueError("solve takes problems with real y0")
        for name in _OWN:
            if name in options:
                raise TypeError(
                    f"{name} is no option of this solve, which sets it itself; t= are the times of the output"
                )
        self.adjoint = bool(options.get("adjoint"))
        self._problem, self._method = problem, method
        self._failures_are_nan = options.get("on_failure", "raise") == "return"
        self._options: Options = {**options, "on_failure": options.get("on_failure", "raise")}
        self._t = None if t is None else output_times(t, *problem.t_span)
        n = len(problem.y0)
        self.shape = (n,) if self._t is None else (n, len(self._t))
        self._solvers = Latest[tuple[int, ...] | None, PreparedSolver]()
        self._solver(())  # what is wrong with the method and the options is said here, not by a callback
        self.faces = Latest[Any, Callable[..., Any]]()

    def operands(self, y0: Any, args: Iterable[Any] | None) -> list[Any]:
        """Return the operands of a call: y0, then each of args; of the problem what is None.

        Raises
        ------
        TypeError, ValueError
            y0 does not fit the problem, or args are not as many as those of the problem.
        """
        y0 = self._problem.y0 if y0 is None else y0
        given = self._problem.args if args is None else tuple(args)
        shape, expected = tuple(np.shape(y0)), (len(self._problem.y0),)
        if shape != expected:
            raise ValueError(f"y0 must have shape {expected}, got {shape}: call solve for each state, as jax.vmap does")
        if "complex" in str(getattr(y0, "dtype", None) or np.asarray(y0).dtype):
            raise TypeError("y0 is complex, and the problem is real: write it in real and imaginary parts")
        if len(given) != len(self._problem.args) and self._problem.args:
            raise TypeError(
                f"args must have {len(self._problem.args)} entries, as those of the problem, got {len(given)}"
            )
        return [y0, *given]

    def values(self, operands: Operands) -> Array:
        """Solve the problem for these operands; return y of the shape `shape`."""
        return self.outputs(self._run(operands, ()))

    def outputs(self, sol: Solution) -> Array:
        """Return y of a run, of the shape `shape`; NaN at output times that the run did not reach."""
        return self._outputs(sol, sol.y)

    def tangent(self, operands: Operands, wanted: tuple[int, ...]) -> tuple[Array, list[Array]]:
        """Return y and its derivatives with respect to the wanted operands, of the shape of y followed by the
        operand's."""
        if not wanted:
            return self.values(operands), []
        sol = self._run(operands, wanted)
        S = np.moveaxis(self._outputs(sol, sol.sensitivities), 1, -1)  # the parameters last
        return self.outputs(sol), _parted(S, operands, wanted)

    def solution(self, operands: Operands) -> Solution:
        """Run the problem for these operands and return the solution whose adjoint is wanted."""
        return self._run(operands, None)

    def pullback(self, sol: Solution, operands: Operands, wanted: tuple[int, ...], weights: Array) -> list[Array]:
        """Return the gradients of Σ weights · solution with respect to the wanted operands, by the adjoint."""
        if self._reached(sol):
            found = sol.gradient(weights, wrt=self._selected(wanted), t=self._t)
        else:  # the solution is NaN
            found = np.full(sum(np.size(operands[i]) for i in wanted), np.nan)
        return _parted(found, operands, wanted)

    def _run(self, operands: Operands, wanted: tuple[int, ...] | None) -> Solution:
        y0, *args = (one if not isinstance(one, np.ndarray) or one.ndim else one.item() for one in operands)
        sol = self._solver(wanted)(y0=np.reshape(y0, len(self._problem.y0)), args=tuple(args))
        if not (self._reached(sol) or self._failures_are_nan):
            raise SolveError(
                f"{sol.message} The run ended at t = {sol.t_end:.6g}, before the end of the output, which must not "
                "depend on y0 and args: give times t before it, or on_failure='return' for NaN after it",
                sol,
            )
        return sol

    def _reached(self, sol: Solution) -> bool:
        """Return whether the run reached all output times."""
        return sol.status == 0 if self._t is None else len(sol.t) == len(self._t)

    def _outputs(self, sol: Solution, values: Array) -> Array:
        """Return `values` at the output times, or at the end; NaN at times that the run did not reach."""
        if self._t is None:
            return values[..., -1] if self._reached(sol) else np.full(values.shape[:-1], np.nan)
        missing = np.full((*values.shape[:-1], len(self._t) - values.shape[-1]), np.nan)
        return np.concatenate([values, missing], axis=-1)

    def _solver(self, wanted: tuple[int, ...] | None) -> PreparedSolver:
        """Return the solver with sensitivities to the wanted operands, or, for the adjoint, with None."""
        return self._solvers.find(wanted, lambda: self._prepared(wanted))

    def _prepared(self, wanted: tuple[int, ...] | None) -> PreparedSolver:
        options = self._options.copy()
        if wanted is not None:
            options["adjoint"] = False
        if self._t is not None:
            options["t_eval"] = self._t
        elif options.get("adjoint") is not True:
            options["keep"] = "end"
        problem = self._problem.replace(sensitivities=self._selected(wanted) if wanted else None)
        if self._t is not None:
            problem = problem.replace(t_span=(problem.t_span[0], float(self._t[-1])))
        return PreparedSolver(problem, self._method, options)

    def _selected(self, wanted: tuple[int, ...]) -> Sensitivities:
        """Return the problem's settings of sensitivities, for these operands alone."""
        args = [i - 1 for i in _in_order(wanted) if i]
        given = self._problem.sensitivities or Sensitivities()
        return replace(given, args=args or None, y0=0 in wanted, dy0dp=None)


#: Bridges by the contents of their problems, times, methods and options.
_bridges: Latest[Any, Bridge] = Latest()


def leaves(value: Any) -> Iterator[Any]:
    """Yield the values within nested lists, tuples and dicts."""
    if isinstance(value, (list, tuple)):
        for one in value:
            yield from leaves(one)
    elif isinstance(value, dict):
        for one in value.values():
            yield from leaves(one)
    else:
        yield value


def _in_order(wanted: Sequence[int]) -> list[int]:
    """Return the operands in the order in which sensitivities list them: the arguments, then y0."""
    return sorted(wanted, key=lambda i: (i == 0, i))


def _parted(found: Array, operands: Operands, wanted: tuple[int, ...]) -> list[Array]:
    """Return, for each of the wanted operands, its part of derivatives whose last axis is that of all their numbers."""
    ordered = _in_order(wanted)
    parts = np.split(found, np.cumsum([np.size(operands[i]) for i in ordered])[:-1], axis=-1)
    return [np.reshape(parts[ordered.index(i)], (*found.shape[:-1], *np.shape(operands[i]))) for i in wanted]
