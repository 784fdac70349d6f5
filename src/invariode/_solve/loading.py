"""Reading the files that `Solution.save` writes."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any, Literal, NamedTuple, NoReturn, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, choice, extra_arguments, reals, shown, tolerances, warn
from .._base.files import ENSEMBLE, ENSEMBLE_VERSION, PathLike, about_of, read_arrays, unreadable
from .._core import MEMORY_VERSION, Dense
from .._laws.bound import BoundInvariants, Jump, bind
from .._problem.description import Description
from .._problem.grouped import Checkpoint
from .._problem.invariants import InvariantsLike, to_invariants
from .._problem.options import ExtensionOptions, Options
from .._results.export import FORMAT, PLAIN, VERSION
from .._results.result import BeforeProjection, DenseSolution, Names, Stats, Steps, at_events
from .._results.solution import Solution
from .._run.checkpoint import CHECKPOINT, CHECKPOINT_VERSION, Stored, read_checkpoint
from .._run.identity import Identity, known_identity, options_of, require_same
from .._run.plan import make_plan
from .._run.run import RunOrigin, Solved

__all__ = ["load"]

_Kind = TypeVar("_Kind")


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
    arrays = read_arrays(path)
    about = about_of(path, arrays, {FORMAT: VERSION, CHECKPOINT: CHECKPOINT_VERSION, ENSEMBLE: ENSEMBLE_VERSION})
    if about["format"] == ENSEMBLE:
        raise unreadable(path, "holds an ensemble: read it with invariode.EnsembleSolution.load(path)")
    if about["format"] == CHECKPOINT:
        if problem is None:
            raise unreadable(path, "is a checkpoint, which needs its problem: load(path, problem)")
        return _of_checkpoint(path, read_checkpoint(path, arrays, about), _Here(problem, options, trust))
    with _damage_of(path):
        solution, dense = _from_arrays(arrays, about)
    if problem is not None:
        origin = _origin_of_file(path, arrays, about, _Here(problem, options, trust), solution)
        solution = solution.changed(_origin=origin)
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


class _Here(NamedTuple):
    """What was given to go on with."""

    problem: Description
    options: Options
    trust: str | None


@contextmanager
def _damage_of(path: PathLike) -> Iterator[None]:
    """Whatever goes wrong inside is the file's fault: it is the only input."""
    try:
        yield
    except Exception as wrong:
        what = f"it has no {wrong}" if isinstance(wrong, KeyError) else f"{type(wrong).__name__}: {wrong}"
        raise unreadable(path, f"is damaged: {what}") from None


def _origin_of_file(
    path: PathLike, arrays: dict[str, Any], about: dict[str, Any], here: _Here, solution: Solution
) -> RunOrigin:
    """What it takes to go on, with the functions of the problem."""
    stored = about.get("origin")
    if not stored:
        raise unreadable(
            path,
            "does not hold the memory of its run: a former version of invariode, or a solution without functions, "
            "wrote it. Leave out the problem",
        )
    with _damage_of(path):
        who = known_identity(stored["identity"], _part(arrays, "origin.identity."))
        memory = _memory(arrays["origin.memory"], arrays["origin.y"], solution.y, stored)
        imposed = _of_type(stored["imposed"], bool)
    source = _source(path, who, stored, here)
    return RunOrigin(source, solution.t_end, arrays["origin.y"], stored["next_h"], memory, imposed)


def _memory(memory: Array, y_end: Array, y: Array, about: dict[str, Any]) -> bytes:
    """The memory of a run, whose end and next step are seen to be possible."""
    if y_end.shape != y.shape[:1] or y_end.dtype != y.dtype or memory.dtype != np.uint8:
        raise ValueError("the end of the run does not match")
    if about["next_h"] is not None and not _of_type(about["next_h"], float) >= 0:
        raise ValueError(f"the next step is {about['next_h']}")
    _of_type(about["memory_version"], int)
    return memory.tobytes()


def _of_type(value: Any, kind: type[_Kind]) -> _Kind:
    if type(value) is not kind:
        raise TypeError(f"{shown(value)} should be of type {kind.__name__}")
    return value


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


def _source(path: PathLike, who: Identity, about: dict[str, Any], here: _Here) -> Solved:
    if about["memory_version"] != MEMORY_VERSION:
        raise unreadable(
            path,
            f"has version {about['memory_version']} of the memory of a run; this is invariode {version('invariode')}, "
            f"which goes on from version {MEMORY_VERSION}: use the invariode that wrote it",
        )
    try:
        require_same(who, here.problem, here.options, here.trust)
        return Solved(here.problem, who.about["method"], options_of(who, here.options))
    except ValueError as differs:
        raise unreadable(path, f"cannot go on here: {differs}") from None


def _of_checkpoint(path: PathLike, stored: Stored, here: _Here) -> Solution:
    about, arrays = stored.about, stored.arrays
    with _damage_of(path):
        memory = _memory(arrays["memory"], arrays["y_end"], arrays["y"], about)
        known_identity(*stored.identity)
    source = _source(path, stored.identity, about, here)
    given = source.options.get("checkpoint")
    every = given.every if isinstance(given, Checkpoint) else stored.identity.about.get("every")
    try:
        source.options["checkpoint"] = Checkpoint(path) if every is None else Checkpoint(path, every=every)
        plan = make_plan(source.problem, source.method, source.options)
    except (TypeError, ValueError) as wrong:
        raise unreadable(path, f"cannot go on here: {wrong}") from None
    with _damage_of(path):
        n, m, events = len(here.problem.y0), len(plan.bound), len(here.problem.events)
        _require_shapes(arrays, n, m, arrays["value"])
        bound = dataclasses.replace(
            plan.bound, value=arrays["value"], jumps=_jumps(arrays), forward=plan.settings.forward, evaluations=0
        )
        described = json.loads(str(arrays["dense.about"])) if "dense.about" in arrays else {}
        dense = _dense(arrays, described, reals(arrays["y"]), m)
        origin = RunOrigin(
            source, about["t_end"], arrays["y_end"], about["next_h"], memory, checkpoint=stored.checkpoint
        )
        return Solution(
            t=arrays["t"],
            y=arrays["y"],
            sol=None if dense is None else DenseSolution(dense, arrays["y"].dtype, bound),
            **_outcome(arrays, about, events or None, n),
            t_end=about["t_end"],
            _invariants=bound,
            _drift=_drift(arrays, m),
            _rtol=plan.rtol,
            _atol=plan.atol,
            _names=plan.called,
            _origin=origin,
        )


# ----------------------------------------------------------------------------------------------------------------------
# What both kinds of files hold, each part seen to match the others


def _require_shapes(arrays: dict[str, Any], n: int, m: int, value: Array) -> None:
    """Raises a ValueError unless the outputs are n components at each t, and the m invariants have values."""
    t, y, rows = arrays["t"], arrays["y"], arrays["jumps.row"]
    if t.ndim != 1 or t.dtype != float or y.shape != (n, len(t)) or y.dtype not in (np.dtype(float), np.dtype(complex)):
        raise ValueError("arrays do not match")
    _require_floats(value, arrays["jumps.t"], arrays["jumps.value"])
    if value.shape != (m,) or arrays["jumps.value"].shape != (len(rows), m) or arrays["jumps.t"].shape != rows.shape:
        raise ValueError("invariants do not match")
    if rows.dtype.kind != "i" or not ((rows >= 0) & (rows <= len(t))).all():
        raise ValueError("jumps do not match")


def _require_floats(*arrays: Array) -> None:
    for array in arrays:
        if array.dtype != float:
            raise ValueError(f"an array is of type {array.dtype}")


def _tolerance(stored: Array, n: int) -> Any:
    """A number, or one for each of the n components, as it was given."""
    _require_floats(stored)
    if stored.shape not in ((), (n,)) or not np.isfinite(stored).all() or (stored < 0).any():
        raise ValueError(f"a tolerance is {shown(stored.tolist())}")
    return stored.tolist()


def _jumps(arrays: dict[str, Any]) -> tuple[Jump, ...]:
    return tuple(map(Jump, arrays["jumps.row"].tolist(), arrays["jumps.t"].tolist(), arrays["jumps.value"]))


def _drift(arrays: dict[str, Any], m: int) -> BeforeProjection:
    residual, distance = arrays["drift.residual"], arrays["drift.distance"]
    _require_floats(residual, distance)
    if residual.ndim != 1 or residual.shape != distance.shape or len(residual) < m:
        raise ValueError("drifts do not match")
    return BeforeProjection(residual, distance, float(arrays["drift.correction"]))


def _dense(arrays: dict[str, Any], about: dict[str, Any], n: int, m: int) -> Dense | None:
    """The continuous solution of n reals and m invariants, if there is one."""
    if not about:
        return None
    parts: dict[str, Any] = {name: one for name, one in _part(arrays, "dense.").items() if name != "about"}
    if about["m"] != m:
        raise ValueError("invariants do not match")
    if parts["y"].shape[1:] != (n,):
        raise ValueError("components do not match")
    try:
        return Dense.from_parts(**parts, **about)
    except TypeError:  # its text would be the signature of the binding
        raise ValueError("the parts of the continuous solution do not match") from None


def _outcome(arrays: dict[str, Any], about: dict[str, Any], events: int | None, n: int) -> dict[str, Any]:
    """The fields of a solution that are neither outputs nor functions."""
    numbered = range(events or 0)
    t_events, y_events = ([arrays[f"{what}.{e}"] for e in numbered] for what in ("t_events", "y_events"))
    for t, y in zip(t_events, y_events, strict=True):
        _require_floats(t, y.real)
        if t.ndim != 1 or (y.shape != (len(t), n) and (len(t) or y.shape != (0,))):
            raise ValueError("events do not match")
    kinds = {"message": str, "success": bool}
    return {
        "t_events": None if events is None else t_events,
        "y_events": None if events is None else [at_events(y) for y in y_events],
        **{name: _of_type(about[name], kinds.get(name, int)) for name in PLAIN},
        "stats": _stats(about["stats"]),
        "steps": _steps(arrays["steps"], about.get("methods", [""])) if "steps" in arrays else None,
    }


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
    _require_floats(*at_outputs)
    names = [str(name) for name in about["invariants"]]
    if y.ndim != 2 or any(one.shape != (len(names), len(t)) for one in at_outputs):
        raise ValueError("arrays do not match")
    _require_shapes(arrays, len(y), len(names), value)
    g = _StoredInvariants(
        [],
        value,
        names,
        (),
        np.zeros(0),
        None,
        jumps=_jumps(arrays),
        forward=_of_type(about["forward"], float),
        at_outputs=at_outputs,
        outputs=y,
    )
    dense = _dense(arrays, about["dense"], reals(y), len(names))
    solution = Solution(
        t=t,
        y=y,
        sol=None,
        **_outcome(arrays, about, about["events"], len(y)),
        t_end=_of_type(about["t_end"], float) if about["version"] > 1 else _last_time(arrays, dense),
        _invariants=g,
        _rtol=_tolerance(arrays["rtol"], len(y)),
        _atol=_tolerance(arrays["atol"], len(y)),
        _drift=_drift(arrays, len(names)),
        _names=Names(about["name"], about["title"], about["labels"], len(y), about["event_names"]),
    )
    for name, held in about.get("added", {}).items():
        solution[name] = arrays[held["array"]] if "array" in held else held["value"]
    return solution, dense


def _steps(rows: Array, methods: list[Any]) -> Steps:
    """Those of a file. In files of 0.1 rows do not say which of several methods made the step."""
    _require_floats(rows)
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
