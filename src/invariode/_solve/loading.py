"""Reading the files that `Solution.save` writes."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterable
from importlib.metadata import version
from typing import Any, Literal, NamedTuple, NoReturn, Unpack

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, choice, extra_arguments, quietly, reals, shown, tolerances, warn
from .._base.files import PathLike, damage_of, unreadable
from .._base.formats import Contents, read
from .._core import MEMORY_VERSION, Dense
from .._laws.bound import BoundInvariants, Jump, bind
from .._problem.description import Description
from .._problem.invariants import InvariantsLike, to_invariants
from .._problem.methods import find_method
from .._problem.options import ExtensionOptions, Options, checked
from .._results.result import BeforeProjection, DenseSolution, Names, Stats, Steps, at_events
from .._results.saving import OUTCOME, SOLUTION, Saved, prefixed
from .._results.solution import Solution
from .._run.checkpoint import CHECKPOINT, Checkpoint, read_checkpoint
from .._run.identity import known_identity, options_of, require_same
from .._run.run import RunOrigin, Solved

__all__ = ["load"]


def load(
    path: str | os.PathLike[str],
    problem: Description | None = None,
    *,
    invariants: InvariantsLike | None = None,
    args: Iterable[Any] | None = (),
    trust: Literal["code"] | None = None,
    **options: Unpack[Options],
) -> Solution:
    """The Solution that ``Solution.save`` wrote to a file, or that a run has come to in its `checkpoint`.

    All its values, including those of ``sol(t)``, equal the original's to the last bit. The file holds no functions.
    With the `problem` of the run the Solution is as good as the original: ``extend`` continues it, to the last bit, as
    the uninterrupted run would have gone on, on the same machine with the same libraries. That needs functions of
    ``(t, y, *args)`` alone; what functions remember by themselves is not in the file.

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
    invariants : callable, Invariants, or list of these, optional
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
        The file was not written by invariode, is damaged, or comes from a newer version; it belongs to another problem,
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
    if problem is None:
        listed, extra = to_invariants(invariants), extra_arguments(args)
        if extra and not listed:
            raise ValueError("args are the extra arguments of invariants, and no invariants are given")
        if options or trust is not None:
            raise ValueError(
                f"{next(iter(options), 'trust')} is an option of the run, which goes on with its problem: give problem "
                "too"
            )
    else:
        if not isinstance(problem, Description):
            raise TypeError(f"problem must be a Problem, got {shown(problem)}; invariants are given by name")
        if invariants is not None or args:
            raise ValueError("invariants and args are those of the problem: leave them out")
        listed, extra = problem.invariants, problem.args
    if trust is not None:
        choice("trust", trust, ["code"])
    contents = read(path, SOLUTION, CHECKPOINT)
    if contents.kind is SOLUTION:
        parts, checkpoint = [contents], None
    elif problem is None:
        raise unreadable(path, "is a checkpoint, which needs its problem: load(path, problem)")
    else:
        contents, parts, checkpoint = read_checkpoint(path, contents)
    with damage_of(path):
        dense = _dense(parts, reals(contents.arrays["y"]))
        solution = _solution(contents)
    if problem is not None:
        solution = solution.changed(_origin=_origin(path, contents, problem, options, trust, checkpoint))
    elif contents.about["identity"] is not None:
        solution = solution.changed(_origin=_OriginInFile(contents))
    if problem is not None or listed:
        start = _start(path, solution, dense) if problem is None else (problem.t_span[0], problem.y0)
        solution = solution.changed(_invariants=_bind_again(path, solution, listed, start, extra))
    if dense is None:
        return solution
    imposed = {"rtol": solution._rtol, "atol": solution._atol} if contents.about["imposed"] else None
    projects = contents.about["dense"]["interpolation"] == "projected" and len(solution._invariants) > 0
    kind = _Unprojected if (imposed or projects) and not listed else DenseSolution
    return solution.changed(sol=kind(dense, solution.y.dtype, solution._invariants, imposed))


# ----------------------------------------------------------------------------------------------------------------------
# What it takes to go on


def _origin(
    path: PathLike,
    contents: Contents,
    problem: Description,
    options: Options,
    trust: str | None,
    checkpoint: Checkpoint | None,
) -> RunOrigin:
    """What it takes to go on, with the functions of the problem."""
    about, arrays = contents.about, contents.arrays
    if about["identity"] is None:
        raise unreadable(
            path, "does not hold the memory of its run: a solution without functions wrote it. Leave out the problem"
        )
    with damage_of(path):
        who = known_identity(about["identity"], prefixed(arrays, "identity."))
        memory, y_end = arrays["memory"].tobytes(), arrays["y_end"]
    if about["memory_version"] != MEMORY_VERSION:
        raise unreadable(
            path,
            f"has version {about['memory_version']} of the memory of a run; this is invariode {version('invariode')}, "
            f"which goes on from version {MEMORY_VERSION}: use the invariode that wrote it",
        )
    try:
        require_same(who, problem, options, trust)
        whole = options_of(who, options)
        with quietly():
            checked(whole, find_method(who.about["method"])[0])
    except (TypeError, ValueError) as wrong:
        raise unreadable(path, f"cannot go on here: {wrong}") from None
    if checkpoint is not None:
        whole["checkpoint"] = os.fspath(path)
    source = Solved(problem, who.about["method"], whole)
    return RunOrigin(source, about["t_end"], y_end, about["next_h"], memory, about["imposed"], checkpoint)


class _OriginInFile(NamedTuple):
    """What a solution was made from, without the functions: to be saved again."""

    contents: Contents
    projected: bool = False  # since it was read

    @property
    def imposed(self) -> bool:
        return self.projected or self.contents.about["imposed"]

    def extend(self, sol: Solution, t_end: float, options: ExtensionOptions) -> NoReturn:
        raise ValueError(
            "this solution comes from a file, without the functions of its problem: it cannot be extended. That of "
            "load(path, problem) can"
        )

    def slopes(self, t: Array, y: Array) -> None:
        return None

    def field(self, y: Array) -> None:
        return None

    def identity(self) -> Saved:
        arrays = self.contents.arrays
        of_run = {name: one for name, one in arrays.items() if name.startswith("identity.")}
        return Saved({"identity": self.contents.about["identity"]}, of_run)

    def end(self) -> Saved:
        about, arrays = self.contents.about, self.contents.arrays
        return Saved(
            {name: about[name] for name in ("next_h", "memory_version")},
            {name: arrays[name] for name in ("y_end", "memory")},
        )

    def imposing(self) -> _OriginInFile:
        return self._replace(projected=True)


# ----------------------------------------------------------------------------------------------------------------------
# From the fields of a file, each of which is right by itself


def _solution(contents: Contents) -> Solution:
    """The solution without `sol`."""
    about, arrays = contents.about, contents.arrays
    t, y, names, events = arrays["t"], arrays["y"], about["invariants"], about["events"]
    if len(arrays["drift.residual"]) < len(names):
        raise ValueError("drifts do not match")
    number, stats = arrays["events.number"], about["stats"]
    jumps = zip(arrays["jumps.row"].tolist(), arrays["jumps.t"].tolist(), arrays["jumps.value"], strict=True)
    found = [[arrays[f"events.{what}"][number == e] for e in range(len(events or ()))] for what in "ty"]
    g = _StoredInvariants(
        [],
        arrays["invariants.value"],
        names,
        (),
        np.zeros(0),
        None,
        jumps=tuple(Jump(*jump) for jump in jumps),
        forward=about["forward"],
        at_outputs=(arrays.get("invariants.residual"), arrays.get("invariants.distance")),
        outputs=y,
    )
    solution = Solution(
        t=t,
        y=y,
        sol=None,
        t_events=None if events is None else found[0],
        y_events=None if events is None else [at_events(y) for y in found[1]],
        **{name: about[name] for name in OUTCOME},
        stats=Stats(**stats | {"discontinuities": tuple(stats["discontinuities"])}),
        steps=_steps(arrays["steps"], about["methods"]) if "steps" in arrays else None,
        _invariants=g,
        _rtol=arrays["rtol"].tolist(),
        _atol=arrays["atol"].tolist(),
        _drift=BeforeProjection(arrays["drift.residual"], arrays["drift.distance"], float(arrays["drift.correction"])),
        _names=Names(about["name"], about["title"], about["labels"], len(y), events or []),
    )
    for name, held in about["added"].items():
        solution[name] = arrays[held["array"]] if "array" in held else held["value"]
    return solution


def _steps(rows: Array, methods: list[str]) -> Steps:
    if not np.isin(rows[:, 5], np.arange(len(methods))).all():
        raise ValueError("steps do not match")
    return Steps(rows, methods)


def _dense(parts: list[Contents], n: int) -> Dense | None:
    """The continuous solution of n reals, if there is one, joined in pairs, so that each part is copied few times."""
    wholes = [_dense_part(part, n) for part in parts if part.about["dense"] is not None]
    while len(wholes) > 1:
        pairs = itertools.zip_longest(wholes[::2], wholes[1::2])
        wholes = [first if then is None else first.joined(then) for first, then in pairs]
    return wholes[0] if wholes else None


def _dense_part(part: Contents, n: int) -> Dense:
    arrays = prefixed(part.arrays, "dense.")
    if part.about["dense"]["m"] != part.arrays["jumps.value"].shape[1]:
        raise ValueError("invariants do not match")
    if arrays["y"].shape[1:] != (n,):
        raise ValueError("components do not match")
    try:
        return Dense.from_parts(**{"scale": None, **arrays, **part.about["dense"]})
    except TypeError:  # its text would be the signature of the binding
        raise ValueError("the parts of the continuous solution do not match") from None


@dataclasses.dataclass
class _StoredInvariants(BoundInvariants):
    """The invariants of a file, without functions: at its outputs, what was computed when it was saved."""

    at_outputs: tuple[Any, Any] = dataclasses.field(kw_only=True)  # residuals and distances, (m, n_t), or None
    outputs: Array = dataclasses.field(kw_only=True)  # y of the file

    def residual(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        self._require_outputs(y)
        return self.at_outputs[0]

    def distance(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> Array:
        self._require_outputs(y)
        return self.at_outputs[1]

    def _require_outputs(self, y: Array) -> None:
        if len(self) and y is not self.outputs and not np.array_equal(y, self.outputs, equal_nan=True):
            raise ValueError(
                f"the functions of the invariants {', '.join(self.names)} are not in the file, which has their "
                "residuals only at its outputs, and y has changed: give them, invariode.load(path, invariants=...)"
            )

    def impose(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> NoReturn:
        raise ValueError(
            f"the functions of the invariants {', '.join(self.names)} are not in the file: give them, "
            "invariode.load(path, invariants=...), or use invariode.impose(invariants, solution)"
        )


class _Unprojected(DenseSolution):
    """The continuous solution of a file, which needs functions to project and has none."""

    _told = False

    def __call__(self, t: ArrayLike) -> Array:
        if not self._told and (self._imposed or not np.isin(t, self.ts).all()):
            self._told = True
            warn(
                "sol(t) is not projected onto the invariants: their functions are not in the file; give them, "
                "invariode.load(path, invariants=...)"
            )
        return DenseSolution(self._dense, self._dtype, self._invariants)(t)


#: At this many outputs the invariants given to `load` are compared with those of the run.
_COMPARED = 16


def _start(path: PathLike, solution: Solution, dense: Dense | None) -> tuple[float, Array]:
    """A point at which invariants can be evaluated."""
    if len(solution.t):
        return float(solution.t[0]), solution.y[:, 0].copy()
    if dense is None:
        raise ValueError(f"the file {os.fspath(path)} has no point at which invariants could be evaluated")
    parts = dense.parts()
    return float(parts["t"][0]), parts["y"][0].view(solution.y.dtype)


def _bind_again(
    path: PathLike, solution: Solution, listed: list[Any], start: tuple[float, Array], args: tuple[Any, ...]
) -> BoundInvariants:
    """The invariants of the file with their functions, once these are seen to be the same."""
    stored, t, y = solution._invariants, solution.t, solution.y
    if listed and not len(stored):
        raise ValueError(f"invariants are given, but the run in {os.fspath(path)} had none")
    rtol, atol = solution._rtol, solution._atol
    bound = bind(listed, *start, args, tolerances(rtol, atol, start[1])[1])
    if bound.names != stored.names:
        raise ValueError(
            f"the invariants given are named {', '.join(bound.names)}, those of the run in {os.fspath(path)} "
            f"{', '.join(stored.names)}"
        )
    bound = dataclasses.replace(bound, value=stored.value, jumps=stored.jumps, forward=stored.forward, evaluations=0)
    if (
        not isinstance(stored, _StoredInvariants) or stored.at_outputs[1] is None
    ):  # of a checkpoint, whose code is that of the run
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
