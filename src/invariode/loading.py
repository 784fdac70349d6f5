"""Reading the files that `Solution.save` writes."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from importlib.metadata import version
from typing import Any, NamedTuple, NoReturn, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ._arguments import Array, extra_arguments, reals, shown, tolerances, warn
from ._bound_invariants import BoundInvariants, Jump, bind
from ._core import MEMORY_VERSION, Dense
from ._files import PathLike, about_of, read_arrays, unreadable
from ._identity import Identity, options_of, require_same
from ._options import ExtensionOptions, Options
from .checkpoint import CHECKPOINT, CHECKPOINT_VERSION, Stored, dense_of, read_checkpoint
from .description import Description
from .export import FORMAT, PLAIN, VERSION
from .invariants import InvariantsLike, to_invariants
from .plan import make_plan
from .result import BeforeProjection, DenseSolution, Names, Stats, Steps
from .run import RunOrigin, Solved
from .solution import Solution

__all__ = ["load"]


def load(
    path: str | os.PathLike[str],
    problem: Description | None = None,
    *,
    invariants: InvariantsLike | None = None,
    args: Iterable[Any] | None = (),
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
        The file. A checkpoint has another beside it, with the output.
    problem : Problem, optional
        The problem of the run. A checkpoint needs it.
    invariants : callable, Invariants, or list of these, optional
        Without a problem: the run's invariants, in their order. They are held at the values in the file.
    args : tuple, optional
        Their extra arguments.
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
        by its sizes, events, arguments, y0 or the value of `fun` at the start, or to a run with other options, which
        the error names; or the invariants differ from the run's in their names or values.
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
        if options:
            raise ValueError(
                f"{next(iter(options))} is an option of the run, which goes on with its problem: give problem too"
            )
    else:
        if not isinstance(problem, Description):
            raise TypeError(f"problem must be a Problem, got {shown(problem)}; invariants are given by name")
        if invariants is not None or args:
            raise ValueError("invariants and args are those of the problem: leave them out")
        listed, extra = problem.invariants, problem.args
    arrays = read_arrays(path)
    about = about_of(path, arrays, {FORMAT: VERSION, CHECKPOINT: CHECKPOINT_VERSION})
    if about["format"] == CHECKPOINT:
        if problem is None:
            raise unreadable(path, "is a checkpoint, which needs its problem: load(path, problem)")
        return _of_checkpoint(path, read_checkpoint(path, arrays, about), problem, options)
    try:
        solution, dense = _from_arrays(arrays, about)
    except Exception as wrong:  # whatever it is: the file is the only input
        raise unreadable(path, f"is damaged: {type(wrong).__name__}: {wrong}") from None
    if problem is not None:
        solution = solution.changed(_origin=_origin_of_file(path, arrays, about, problem, options, solution.t_end))
    elif about.get("origin"):
        solution = solution.changed(_origin=_OriginInFile(about["origin"], _part(arrays, "origin.")))
    if listed:
        solution = solution.changed(_invariants=_bind_again(path, solution, dense, listed, extra))
    elif problem is not None:
        stored = solution._invariants
        none = bind([], problem.t_span[0], problem.y0, extra, np.zeros(len(problem.y0)))
        none = dataclasses.replace(none, jumps=stored.jumps, forward=stored.forward)
        solution = solution.changed(_invariants=none)
    if dense is None:
        return solution
    imposed = {"rtol": solution._rtol, "atol": solution._atol} if about.get("imposed") else None
    projects = imposed or (about["dense"]["interpolation"] == "projected" and len(solution._invariants) > 0)
    kind = _Unprojected if projects and not listed else DenseSolution
    return solution.changed(sol=kind(dense, solution.y.dtype, solution._invariants, imposed))


def _origin_of_file(
    path: PathLike, arrays: dict[str, Any], about: dict[str, Any], problem: Description, given: Options, t_end: float
) -> RunOrigin:
    """What it takes to go on, with the functions of the problem."""
    stored = about.get("origin")
    if not stored:
        raise unreadable(
            path,
            "does not hold the memory of its run: a former version of invariode, or a solution without functions, "
            "wrote it. Leave out the problem",
        )
    who = Identity(stored["identity"], _part(arrays, "origin.identity."))
    source = _source(path, who, stored, problem, given)
    memory = arrays["origin.memory"].tobytes()
    return RunOrigin(source, t_end, arrays["origin.y"], stored["next_h"], memory, stored["imposed"])


def _part(arrays: dict[str, Any], prefix: str) -> dict[str, Array]:
    return {name.removeprefix(prefix): one for name, one in arrays.items() if name.startswith(prefix)}


class _OriginInFile(NamedTuple):
    """What a solution was made from, without the functions: to be saved again."""

    about: dict[str, Any]
    arrays: dict[str, Array]

    def extend(self, sol: Solution, t_end: float, options: ExtensionOptions) -> NoReturn:
        raise ValueError(
            "this solution comes from a file, without the functions of its problem: it cannot be extended. That of "
            "load(path, problem) can"
        )

    def slopes(self, t: Array, y: Array) -> None:
        return None

    def field(self, y: Array) -> None:
        return None

    def stored(self) -> tuple[dict[str, Any], dict[str, Array]]:
        return self.about, self.arrays

    def imposing(self) -> _OriginInFile:
        return self._replace(about={**self.about, "imposed": True})


def _source(path: PathLike, who: Identity, about: dict[str, Any], problem: Description, given: Options) -> Solved:
    if about["memory_version"] != MEMORY_VERSION:
        raise unreadable(
            path,
            f"has version {about['memory_version']} of the memory of a run; this is invariode {version('invariode')}, "
            f"which goes on from version {MEMORY_VERSION}: use the invariode that wrote it",
        )
    try:
        require_same(who, problem)
        return Solved(problem, who.about["method"], options_of(who, given))
    except ValueError as differs:
        raise unreadable(path, f"cannot go on here: {differs}") from None


def _of_checkpoint(path: PathLike, stored: Stored, problem: Description, given: Options) -> Solution:
    about, arrays = stored.about, stored.arrays
    source = _source(path, stored.identity, about, problem, given)
    source.options["checkpoint"] = os.fspath(path)
    plan = make_plan(source.problem, source.method, source.options)
    jumps = map(Jump, arrays["jumps.row"].tolist(), arrays["jumps.t"].tolist(), arrays["jumps.value"])
    bound = dataclasses.replace(
        plan.bound, value=arrays["value"], jumps=tuple(jumps), forward=plan.settings.forward, evaluations=0
    )
    dense = dense_of(arrays)
    events = range(len(problem.events))
    t_end, y_end = about["t_end"], arrays["y_end"]
    origin = RunOrigin(source, t_end, y_end, about["next_h"], arrays["memory"].tobytes(), checkpoint=stored.checkpoint)
    return Solution(
        t=arrays["t"],
        y=arrays["y"],
        sol=None if dense is None else DenseSolution(dense, arrays["y"].dtype, bound),
        t_events=[arrays[f"t_events.{e}"] for e in events] if events else None,
        y_events=[arrays[f"y_events.{e}"] for e in events] if events else None,
        **{name: about[name] for name in PLAIN},
        stats=_stats(about["stats"]),
        steps=_steps(arrays["steps"], about["methods"]) if "steps" in arrays else None,
        t_end=t_end,
        _invariants=bound,
        _drift=BeforeProjection(arrays["drift.residual"], arrays["drift.distance"], float(arrays["drift.correction"])),
        _rtol=plan.rtol,
        _atol=plan.atol,
        _names=plan.called,
        _origin=origin,
    )


@dataclasses.dataclass
class _StoredInvariants(BoundInvariants):
    """The invariants of a file, without functions: at its outputs, what was computed when it was saved."""

    at_outputs: tuple[Array, Array] = dataclasses.field(kw_only=True)  # residuals and distances, (m, n_t)
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


def _from_arrays(arrays: dict[str, Any], about: dict[str, Any]) -> tuple[Solution, Dense | None]:
    """The solution without `sol`, and the core of that."""
    t, y, value = arrays["t"], arrays["y"], arrays["invariants.value"]
    at_outputs = arrays["invariants.residual"], arrays["invariants.distance"]
    names = [str(name) for name in about["invariants"]]
    size = (len(names), len(t))
    if t.ndim != 1 or y.ndim != 2 or y.shape[1] != len(t) or any(one.shape != size for one in at_outputs):
        raise ValueError("arrays do not match")
    if value.shape != (len(names),) or arrays["jumps.value"].shape != (len(arrays["jumps.t"]), len(names)):
        raise ValueError("invariants do not match")
    jumps = map(Jump, arrays["jumps.row"].tolist(), arrays["jumps.t"].tolist(), arrays["jumps.value"])
    g = _StoredInvariants(
        [],
        value,
        names,
        (),
        np.zeros(0),
        None,
        jumps=tuple(jumps),
        forward=about["forward"],
        at_outputs=at_outputs,
        outputs=y,
    )
    dense = None
    if about["dense"]:
        parts = {name.removeprefix("dense."): part for name, part in arrays.items() if name.startswith("dense.")}
        if about["dense"]["m"] != len(names):
            raise ValueError("invariants do not match")
        if parts["y"].shape[1:] != (reals(y),):
            raise ValueError("components do not match")
        dense = Dense.from_parts(**parts, **about["dense"])
    events = about["events"]
    solution = Solution(
        t=t,
        y=y,
        sol=None,
        t_events=None if events is None else [arrays[f"t_events.{i}"] for i in range(events)],
        y_events=None if events is None else [arrays[f"y_events.{i}"] for i in range(events)],
        **{name: about[name] for name in PLAIN},
        t_end=about["t_end"] if about["version"] > 1 else _last_time(arrays, dense),
        stats=_stats(about["stats"]),
        steps=_steps(arrays["steps"], about.get("methods", [""])) if "steps" in arrays else None,
        _invariants=g,
        _rtol=arrays["rtol"].tolist(),
        _atol=arrays["atol"].tolist(),
        _drift=BeforeProjection(arrays["drift.residual"], arrays["drift.distance"], float(arrays["drift.correction"])),
        _names=Names(about["name"], about["title"], about["labels"], len(y), about["event_names"]),
    )
    return solution, dense


def _steps(rows: Array, methods: list[Any]) -> Steps:
    """Those of a file. In files of 0.1 rows do not say which of several methods made the step."""
    if rows.shape[1:] == (5,):
        rows = np.hstack([rows, np.zeros((len(rows), 1))])
    if rows.shape[1:] != (6,) or not np.isin(rows[:, 5], np.arange(len(methods))).all():
        raise ValueError("steps do not match")
    return Steps(rows, [str(one) for one in methods])


def _last_time(arrays: dict[str, Any], dense: Dense | None) -> float:
    """Where the run of a file of version 1 ended, which does not say it: the last step where steps were kept, else the
    last output, NaN without any."""
    if dense is not None:
        return float(dense.knots()[-1])
    if len(arrays.get("steps", ())):
        return float(arrays["steps"][-1, 0])
    return float(arrays["t"][-1]) if len(arrays["t"]) else float("nan")


#: At this many outputs the invariants given to `load` are compared with those of the run.
_COMPARED = 16


def _bind_again(
    path: PathLike, solution: Solution, dense: Dense | None, listed: list[Any], args: tuple[Any, ...]
) -> BoundInvariants:
    """The invariants of the file with their functions, once these are seen to be the same."""
    stored, t, y = solution._invariants, solution.t, solution.y
    if not len(stored):
        raise ValueError(f"invariants are given, but the run in {os.fspath(path)} had none")
    if len(t):
        t0, y0 = float(t[0]), y[:, 0].copy()
    elif dense is not None:
        parts = dense.parts()
        t0, y0 = float(parts["t"][0]), parts["y"][0].view(y.dtype)
    else:
        raise ValueError(f"the file {os.fspath(path)} has no point at which invariants could be evaluated")
    rtol, atol = solution._rtol, solution._atol
    bound = bind(listed, t0, y0, args, tolerances(rtol, atol, y0)[1])
    if bound.names != stored.names:
        raise ValueError(
            f"the invariants given are named {', '.join(bound.names)}, those of the run in {os.fspath(path)} "
            f"{', '.join(stored.names)}"
        )
    bound = dataclasses.replace(bound, value=stored.value, jumps=stored.jumps, forward=stored.forward)
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


def _stats(stored: dict[str, Any]) -> Stats:
    """What a file has; those of former versions have less, and JSON has no tuples."""
    return Stats(
        **{
            "switches": 0,
            "products": 0,
            "linear_iterations": 0,
            **stored,
            "discontinuities": tuple(stored.get("discontinuities", ())),
        }
    )
