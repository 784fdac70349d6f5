"""Reading the files that `Solution.save` writes."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from typing import Any, Literal, Unpack

import numpy as np

from .._base.arguments import Array, choice, extra_arguments, quietly, reals, shown, weights_of
from .._base.files import PathLike, damage_of, unreadable
from .._base.formats import read, under
from .._base.package import version
from .._core import MEMORY_VERSION, Dense
from .._files.checkpoint import CHECKPOINT, read_checkpoint
from .._files.identity import Identity, known_identity, options_of, require_same
from .._laws.bound import BoundInvariants, bind
from .._problem.events import roots_among
from .._problem.given_options import checked
from .._problem.grouped import Checkpoint
from .._problem.invariants import InvariantsLike, to_invariants
from .._problem.methods import find_method
from .._problem.options import Options
from .._problem.problem import Problem
from .._results.result import DenseSolution, Origin
from .._results.saving import (
    SOLUTION,
    StoredInvariants,
    Unprojected,
    solution_of,
    stored_dense,
)
from .._results.solution import Solution
from .._run.run import RunOrigin, Solved


def load(
    path: str | os.PathLike[str],
    problem: Problem | None = None,
    *,
    invariants: InvariantsLike | None = None,
    args: Iterable[Any] | None = (),
    trust: Literal["code"] | None = None,
    **options: Unpack[Options],
) -> Solution:
    """Load a Solution from a file written by ``Solution.save`` or from a `checkpoint`.

    All its values, including those of ``sol(t)``, equal the original's to the last bit. The file holds no functions. If
    `problem` is given, the loaded Solution is equivalent to the original: ``extend`` continues it, to the last bit, as
    the uninterrupted run would have gone on, on the same machine with the same libraries. That needs functions of ``(t,
    y, *args)`` alone; internal state of your functions is not saved.

    Without it, `residual` and ``drift()`` are as they were when it was saved, and ``impose()`` needs `invariants`. So
    does ``sol(t)`` between the steps of a run that projects there (``interpolation="projected"``, the default): without
    them it warns once and returns the values of ``interpolation="corrected"``, continuous and of the same order but off
    the manifold.

    Parameters
    ----------
    path : str or path-like
        The file. A checkpoint has another beside it, with the output. While a run writes it, this is the run so far.
    problem : Problem, optional
        The problem of the run. A checkpoint needs it.
    invariants : callable, Invariants, or list or dict of these, optional
        Without a problem: the run's invariants, in their order. They are held at the values in the file.
    args : tuple, optional
        Their extra arguments.
    trust : {'code'}, optional
        Without it a problem whose functions have other code than those of the run is refused. With ``trust="code"``
        the functions may have been edited, or come from another version of Python: that they compute the same is then
        yours to know.
    **options
        With a problem: options of the run that are functions, `callback`, or `breakpoints` with actions. Others are in
        the file; one that is given must agree with it.

    Returns
    -------
    Solution

    Raises
    ------
    ValueError
        The file was not written by invariode, is damaged, or of another version; it belongs to another problem,
        by its sizes, events, arguments, y0, the value of `fun` at the start or the code of its functions, or to a run
        with other options, which the error names; or the invariants differ from the run's in their names or values.
    TypeError
        `path` is neither a str nor path-like.
    OSError
        It cannot be read.

    Examples
    --------
    >>> import invariode as iv, os, tempfile
    >>> oscillator = iv.Problem(lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0.0])
    >>> sol = oscillator.solve(dense_output=True)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sol.save(os.path.join(folder, "oscillator.npz"))
    ...     again = iv.load(os.path.join(folder, "oscillator.npz"), oscillator)
    >>> bool((again.sol(1.234) == sol.sol(1.234)).all())
    True
    >>> bool((again.extend(20).y == sol.extend(20).y).all())
    True
    """
    listed, extra = _invariants_of(problem, invariants, args, [*options, *["trust"] * (trust is not None)])
    if trust is not None:
        choice("trust", trust, ["code"])
    kind, fields = read(path, SOLUTION, CHECKPOINT)
    parts, checkpoint = [fields], None
    if kind is CHECKPOINT:
        if problem is None:
            raise unreadable(path, "is a checkpoint, which needs its problem: load(path, problem)")
        fields, parts, checkpoint = read_checkpoint(path, fields)
    with damage_of(path):
        dense = stored_dense(parts, reals(fields["y"]) * (1 + len(fields["sensitivities"] or ())), fields["t_end"])
        origin = None if fields["identity"] is None else _origin(fields)
        solution = solution_of(fields, Solution).changed(_origin=origin)
    if problem is not None:
        if origin is None:
            raise unreadable(path, "does not hold the memory of its run, which had no functions: leave out the problem")
        source = _source(path, origin, problem, options, trust)
        if kind is CHECKPOINT:
            given, every = source.options.get("checkpoint"), origin.known.about["every"]
            every = given.every if isinstance(given, Checkpoint) else every
            with damage_of(path):
                source.options["checkpoint"] = Checkpoint(path) if every is None else Checkpoint(path, every=every)
        with damage_of(path):
            for roots, state in zip(roots_among(problem.of_one_run().events), origin.roots, strict=True):
                roots.restore(state)
        way = origin.next_h, origin.memory, origin.roots, origin.imposed, checkpoint
        whole = RunOrigin(source, solution.t_end, origin.y, *way)
        solution = solution.changed(_origin=whole)
    if problem is not None or listed:
        start = _start(path, solution, dense) if problem is None else (problem.t_span[0], problem.y0)
        bound = _bind_again(path, solution, listed, start, extra)
        if solution._sensitivities is not None and bound.specs:
            bound = bound.varied(_tangents(path, solution, problem, bound))
        solution = solution.changed(_invariants=bound)
    if dense is None:
        return solution
    imposed = {"rtol": solution._rtol, "atol": solution._atol} if fields["imposed"] else None
    projects = fields["dense"]["interpolation"] == "projected" and len(solution._invariants) > 0
    kind_of_sol = Unprojected if (imposed or projects) and not listed else DenseSolution
    sol = kind_of_sol(dense, solution.y.dtype, solution._invariants, imposed)
    return solution.changed(sol=sol.after(None if problem is None else problem.history))


def _invariants_of(
    problem: object, invariants: InvariantsLike | None, args: Iterable[Any] | None, of_the_run: Sequence[str]
) -> tuple[list[Any], tuple[Any, ...]]:
    """The invariants and their extra arguments: those of the problem, or those given without one.

    `of_the_run` are the names of the options that need a problem.
    """
    if problem is None:
        listed, extra = to_invariants(invariants), extra_arguments(args)
        if extra and not listed:
            raise ValueError("args are the extra arguments of invariants, and no invariants are given")
        if of_the_run:
            raise ValueError(
                f"{of_the_run[0]} is an option of the run, which goes on with its problem: give problem too"
            )
        return listed, extra
    if not isinstance(problem, Problem):
        raise TypeError(
            f"problem must be a Problem, got {shown(problem)}; invariants are given by name. For the run of a function "
            "fun give load(path, Problem(fun, t_span, y0)), with the run's args, events and invariants"
        )
    if invariants is not None or args:
        raise ValueError("invariants and args are those of the problem: leave them out")
    return [*problem.invariants], problem.args


# ----------------------------------------------------------------------------------------------------------------------
# What it takes to go on


def _origin(fields: dict[str, Any]) -> _OriginInFile:
    who = known_identity(fields["identity"], under("identity", fields))
    memory = fields["memory"].tobytes(), fields["memory_version"]
    return _OriginInFile(who, fields["y_end"], fields["next_h"], *memory, fields["roots"], fields["imposed"])


def _source(path: PathLike, origin: _OriginInFile, problem: Problem, options: Options, trust: str | None) -> Solved:
    """Return the stored run, after a check that the problem and the options belong to it."""
    if origin.memory_version != MEMORY_VERSION:
        raise unreadable(
            path,
            f"has version {origin.memory_version} of the memory of a run; this is invariode {version()}, "
            f"which goes on from version {MEMORY_VERSION}: use the invariode that wrote it",
        )
    who, method = origin.known, origin.known.about["method"]
    try:
        require_same(who, problem, options, trust)
        whole = options_of(who, options)
        with quietly():
            checked(whole, find_method(method)[0])
    except (TypeError, ValueError) as wrong:
        raise unreadable(path, f"cannot go on here: {wrong}") from None
    return Solved(problem, method, whole)


@dataclasses.dataclass(frozen=True)
class _OriginInFile(Origin):
    """Identity, state and method history of a stored run, without its functions: needed to save the solution again."""

    known: Identity
    y: Array
    next_h: float | None
    memory: bytes
    memory_version: int
    roots: list[Any]
    imposed: bool
    source: None = None

    __reduce__ = object.__reduce__  # it has no functions

    def identity(self) -> Identity:
        return self.known

    def imposing(self) -> _OriginInFile:
        return dataclasses.replace(self, imposed=True)


def _tangents(path: PathLike, solution: Solution, problem: Problem | None, bound: BoundInvariants) -> Sequence[Any]:
    """Return the invariants onto whose tangents sensitivities are projected between the steps."""
    if problem is None:
        raise ValueError(
            f"the run in {os.fspath(path)} has sensitivities, which invariants alone do not project: give its problem, "
            "load(path, problem)"
        )
    from .._sensitivity.variations import make_variations

    weights = weights_of(solution._rtol, solution._atol, problem.y0)
    with quietly():
        return make_variations(problem, problem.y0, weights, bound.specs, []).tangents


#: At this many outputs the invariants given to `load` are compared with those of the run.
_COMPARED = 16


def _start(path: PathLike, solution: Solution, dense: Dense | None) -> tuple[float, Array]:
    """Return a point at which the invariants can be evaluated."""
    if len(solution.t):
        return float(solution.t[0]), solution.y[:, 0].copy()
    if dense is None:
        raise ValueError(f"the file {os.fspath(path)} has no point at which invariants could be evaluated")
    parts = dense.parts()
    return float(parts["t"][0]), parts["y"][0].view(solution.y.dtype)


def _bind_again(
    path: PathLike, solution: Solution, listed: list[Any], start: tuple[float, Array], args: tuple[Any, ...]
) -> BoundInvariants:
    """Return the stored invariants with their functions, after a check that these are unchanged."""
    stored, t, y = solution._invariants, solution.t, solution.y
    if listed and not len(stored):
        raise ValueError(f"invariants are given, but the run in {os.fspath(path)} had none")
    rtol, atol = solution._rtol, solution._atol
    bound = bind(listed, *start, args, weights_of(rtol, atol, start[1]).threshold)
    if bound.names != stored.names:
        raise ValueError(
            f"the invariants given are named {', '.join(bound.names)}, those of the run in {os.fspath(path)} "
            f"{', '.join(stored.names)}"
        )
    bound = dataclasses.replace(bound, value=stored.value, jumps=stored.jumps, forward=stored.forward)
    if not isinstance(stored, StoredInvariants) or stored.at_outputs is None:
        return bound
    some = np.unique(np.linspace(0, len(t) - 1, min(_COMPARED, len(t))).astype(int))
    pieces = stored.pieces_of_output(len(t))
    now = bound.distance(t[some], y[:, some], rtol, atol, pieces[some])
    before = stored.distance(t, y, rtol, atol)[:, some]
    # equal except for another machine's roundoff; differences below the tolerance are ignored
    differs = ~(np.abs(now - before) <= 1) & ~(now == before) & ~(np.isnan(now) & np.isnan(before))
    if differs.any():
        i, p = (int(one[0]) for one in np.nonzero(differs))
        raise ValueError(
            f"the invariant {bound.names[i]} is not that of the run in {os.fspath(path)}: at t = {t[some[p]]:.6g} the "
            f"solution is {now[i, p]:.3g} times the tolerance from its value, and was {before[i, p]:.3g} times"
        )
    return bound
