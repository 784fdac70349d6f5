"""Reading the files that `Solution.save` writes."""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
from collections.abc import Iterable
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ._arguments import Array, extra_arguments, reals, tolerances, warn
from ._core import Dense
from .export import FORMAT, PLAIN, VERSION
from .invariants import BoundInvariants, InvariantsLike, Jump, bind, to_invariants
from .result import BeforeProjection, DenseSolution, Names, Stats, Steps
from .solution import Solution

if TYPE_CHECKING:  # needs a tenth of the time of our own import
    from zipfile import ZipFile, ZipInfo

__all__ = ["load"]


def load(
    path: str | os.PathLike[str], invariants: InvariantsLike | None = None, args: Iterable[Any] | None = ()
) -> Solution:
    """The Solution that ``Solution.save`` wrote to a file.

    All its values, including those of ``sol(t)``, equal the original's to the last bit. The file holds no functions:
    `residual` and ``drift()`` are as they were when it was saved. ``impose()`` needs `invariants`, and so does
    ``sol(t)`` between the steps of a run that projects there (``interpolation="projected"``, the default): without
    them it warns once and returns the values of ``interpolation="corrected"``, continuous and of the same order but off
    the manifold.

    Parameters
    ----------
    path : str or path-like
        The file.
    invariants : callable, Invariants, or list of these, optional
        The run's invariants, in their order. They are held at the values in the file.
    args : tuple, optional
        Their extra arguments.

    Returns
    -------
    Solution

    Raises
    ------
    ValueError
        The file was not written by `Solution.save`, is damaged, or comes from a newer version of invariode; or the
        invariants differ from the run's in their names or values.
    OSError
        It cannot be read.

    Examples
    --------
    >>> import invariode as iv, os, tempfile
    >>> sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0.0], dense_output=True)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sol.save(os.path.join(folder, "oscillator.npz"))
    ...     again = iv.load(os.path.join(folder, "oscillator.npz"))
    >>> bool((again.sol(1.234) == sol.sol(1.234)).all())
    True
    """
    listed, extra = to_invariants(invariants), extra_arguments(args)
    if extra and not listed:
        raise ValueError("args are the extra arguments of invariants, and no invariants are given")
    arrays, about = _read(path)
    try:
        solution, dense = _from_arrays(arrays, about)
    except Exception as wrong:  # whatever it is: the file is the only input
        raise _unreadable(path, f"is damaged: {type(wrong).__name__}: {wrong}") from None
    if listed:
        bound = _bind_again(path, solution, dense, listed, extra)
        solution = solution.changed(_invariants=bound)
    if dense is None:
        return solution
    imposed = {"rtol": solution._rtol, "atol": solution._atol} if about.get("imposed") else None
    projects = imposed or (about["dense"]["interpolation"] == "projected" and len(solution._invariants) > 0)
    kind = _Unprojected if projects and not listed else DenseSolution
    return solution.changed(sol=kind(dense, solution.y.dtype, solution._invariants, imposed))


@dataclasses.dataclass
class _StoredInvariants(BoundInvariants):
    """The invariants of a file, without functions: at its outputs, what was computed when it was saved."""

    at_outputs: tuple[Array, Array] = dataclasses.field(kw_only=True)  # residuals and distances, (m, n_t)

    def residual(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        return self.at_outputs[0]

    def distance(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> Array:
        return self.at_outputs[1]

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


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """All arrays of the file, with every byte checked, and its description of itself."""
    import zipfile

    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            file.seek(0)
            incomplete = file.read(2) == b"PK"
            raise _unreadable(path, "is incomplete" if incomplete else "was not written by Solution.save")
        file.seek(0)
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                if sum(member.file_size for member in members) > os.fstat(file.fileno()).st_size:
                    raise ValueError("it says that its arrays are larger than the file")
                contents = {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}
        except OSError as wrong:
            if wrong.errno not in (None, errno.EINVAL):  # a position before the start of the file; a decompressor's
                raise
            raise _unreadable(path, "is damaged") from None
        except Exception as wrong:  # of the archive and of each kind of compression
            raise _unreadable(path, f"is damaged: {wrong}") from None
    return contents, _about(path, str(contents.get("about", "")))


def _array(archive: ZipFile, member: ZipInfo) -> Array:
    """An array whose header agrees with its size; the archive checks its bytes as they are read."""
    header = np.lib.format
    with archive.open(member) as stream:
        try:
            read = {(1, 0): header.read_array_header_1_0, (2, 0): header.read_array_header_2_0}
            shape, by_columns, dtype = read[header.read_magic(stream)](stream)
            size = math.prod(shape) * dtype.itemsize
        except Exception as wrong:  # a header is Python's text: tokenizer, parser and NumPy have an error each
            raise ValueError(f"{member.filename} is not an array: {type(wrong).__name__}: {wrong}") from None
        contents = stream.read()
    kinds = "U" if member.filename == "about.npy" else "fci"
    if dtype.kind not in kinds or size != len(contents) or min(shape, default=0) < 0:
        raise ValueError(f"{member.filename} is of {len(contents)} bytes, and says {shape} of {dtype}")
    array = np.frombuffer(contents, dtype).reshape(shape, order="F" if by_columns else "C")
    return array.astype(dtype.newbyteorder("="))  # a copy, which may be written to


def _about(path: str | os.PathLike[str], text: str) -> dict[str, Any]:
    try:
        about = json.loads(text)
    except (ValueError, RecursionError):
        about = None
    if not isinstance(about, dict) or about.get("format") != FORMAT or not isinstance(about.get("version"), int):
        raise _unreadable(path, "was not written by Solution.save")
    if about["version"] > VERSION:
        raise _unreadable(
            path,
            f"has version {about['version']} of the format, written by invariode {about.get('invariode')}; this is "
            f"invariode {version('invariode')}, which reads versions up to {VERSION}: upgrade it",
        )
    return about


def _unreadable(path: str | os.PathLike[str], what: str) -> ValueError:
    return ValueError(f"the file {os.fspath(path)} {what}")


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
        [], value, names, (), np.zeros(0), None, jumps=tuple(jumps), forward=about["forward"], at_outputs=at_outputs
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
        stats=Stats(**about["stats"]),
        steps=Steps(arrays["steps"]) if "steps" in arrays else None,
        _invariants=g,
        _rtol=arrays["rtol"].tolist(),
        _atol=arrays["atol"].tolist(),
        _drift=BeforeProjection(arrays["drift.residual"], arrays["drift.distance"], float(arrays["drift.correction"])),
        _names=Names(about["name"], about["title"], about["labels"], len(y), about["event_names"]),
    )
    return solution, dense


def _last_time(arrays: dict[str, Any], dense: Dense | None) -> float:
    """Where the run of a file of version 1 ended, which does not say it: the last step where steps were kept, else the
    last output, NaN without any."""
    if dense is not None:
        return float(dense.knots()[-1])
    if len(arrays.get("steps", ())):
        return float(arrays["steps"][-1, 0])
    return float(arrays["t"][-1]) if len(arrays["t"]) else float("nan")


#: At so many outputs the invariants given to `load` are compared with those of the run.
_COMPARED = 16


def _bind_again(
    path: str | os.PathLike[str], solution: Solution, dense: Dense | None, listed: list[Any], args: tuple[Any, ...]
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
    # equal but for the roundoff of another machine; what the tolerance does not see is not held against them
    differs = ~(np.abs(now - before) <= 1) & ~(now == before) & ~(np.isnan(now) & np.isnan(before))
    if differs.any():
        i, p = (int(one[0]) for one in np.nonzero(differs))
        raise ValueError(
            f"the invariant {bound.names[i]} is not that of the run in {os.fspath(path)}: at t = {t[some[p]]:.6g} the "
            f"solution is {now[i, p]:.3g} times the tolerance from its value, and was {before[i, p]:.3g} times"
        )
    return bound
