"""Solutions as data: labelled arrays, tables, and files."""

from __future__ import annotations

import dataclasses
import errno
import importlib
import json
import os
import secrets
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ._arguments import Array, extra_arguments, reals, tolerances, warn
from ._core import Dense
from ._types import InvariantsLike
from .invariants import BoundInvariants, bind, to_invariants
from .solution import DenseSolution, Names, Solution, Stats, Steps

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["load", "save", "to_dataframe", "to_xarray"]

#: What every file says of itself, and the version of its contents: raised whenever they change.
_FORMAT, _VERSION = "invariode solution", 1


# ----------------------------------------------------------------------------------------------------------------------
# Labelled arrays and tables


def to_xarray(solution: Solution) -> xarray.Dataset:
    """See `Solution.to_xarray`."""
    xr = _extra("xarray")
    variables: dict[str, Any] = {"y": (("component", "t"), solution.y)}
    coordinates: dict[str, Any] = {"component": _labels(solution), "t": solution.t}
    g = solution._invariants
    if len(g):
        coordinates["invariant"] = list(g.names)
        coordinates["value"] = ("invariant", g.value)
        variables["residual"] = (("invariant", "t"), solution.residual, {"long_name": "g - value"})
    for name, t, y in zip(_event_names(solution), solution.t_events or (), solution.y_events or (), strict=True):
        coordinates[f"t_events_{name}"] = (f"event_{name}", t)
        variables[f"y_events_{name}"] = ((f"event_{name}", "component"), y)
    if solution.steps is not None:
        coordinates["t_step"] = solution.steps.t
        variables["h"] = ("t_step", solution.steps.h, {"long_name": "size of the step"})
        variables["order"] = ("t_step", solution.steps.order)
        variables["error"] = ("t_step", solution.steps.error, {"long_name": "estimated error / rtol"})
        variables["correction"] = ("t_step", solution.steps.correction, {"long_name": "correction / rtol"})
    attributes = {
        name: int(value) if isinstance(value, bool) else value  # netCDF has no truth values
        for name, value in _attributes(solution).items()
    }
    data: xarray.Dataset = xr.Dataset(variables, coordinates, attributes)
    return data


def to_dataframe(solution: Solution) -> pandas.DataFrame:
    """See `Solution.to_dataframe`."""
    pd = _extra("pandas")
    columns: list[tuple[str, Array]] = []
    for label, values in zip(_labels(solution), solution.y, strict=True):
        if np.iscomplexobj(values):
            columns += [(f"{label}.real", values.real), (f"{label}.imag", values.imag)]
        else:
            columns.append((label, values))
    g = solution._invariants
    if len(g):
        columns += [(f"residual of {name}", row) for name, row in zip(g.names, solution.residual, strict=True)]
    rows = np.array([values for _, values in columns]).reshape(len(columns), len(solution.t)).T
    table: pandas.DataFrame = pd.DataFrame(
        rows, index=pd.Index(solution.t, name="t"), columns=[name for name, _ in columns]
    )
    table.attrs = _attributes(solution)
    if len(g):
        table.attrs["invariants"] = dict(zip(g.names, g.value.tolist(), strict=True))
    return table


def _extra(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        if missing.name != module:
            raise
        message = f"this needs {module}: pip install invariode[data]"
        raise ModuleNotFoundError(message, name=module) from None


def _labels(solution: Solution) -> list[str]:
    return [str(label) for label in solution._names.components]


def _event_names(solution: Solution) -> list[str]:
    """One distinct name per event, fit for a variable."""
    names = [_identifier(name) for name in solution._names.events]
    return names if len(set(names)) == len(names) else [f"{name}_{i}" for i, name in enumerate(names)]


def _identifier(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def _attributes(solution: Solution) -> dict[str, Any]:
    """What is one value for the whole solution; Python's own types, so that netCDF and JSON take them."""
    return {
        "name": solution._names.problem,
        "message": solution.message,
        "status": solution.status,
        "success": solution.success,
        "rtol": _tolerance(solution._rtol),
        "atol": _tolerance(solution._atol),
        **{name: value for name, value in solution.stats.items() if value is not None},
        "invariode_version": version("invariode"),
    }


def _tolerance(given: ArrayLike) -> float | list[float]:
    """A number, also for an array of one, which netCDF does not tell from it."""
    values = np.asarray(given, dtype=float)
    return float(values.item()) if values.size == 1 else [float(one) for one in values]


# ----------------------------------------------------------------------------------------------------------------------
# Files: an .npz archive of arrays, and in `about` all that is no array, as JSON. Nothing in it is ever executed.


def save(solution: Solution, path: str | os.PathLike[str]) -> None:
    """See `Solution.save`."""
    arrays = _to_arrays(solution)
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        with open(temporary, "xb") as file:
            np.savez(file, **arrays)
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def load(
    path: str | os.PathLike[str], invariants: InvariantsLike | None = None, args: Iterable[Any] | None = ()
) -> Solution:
    """The Solution that ``Solution.save`` wrote to a file.

    All its values, those of ``sol(t)`` included, are those of the original to the last bit. Functions are not in the
    file: `residual` and ``drift()`` are what they were when it was saved, and ``impose()`` needs `invariants`. So does
    ``sol(t)`` between the steps of a run that projects there (``interpolation="projected"``, the default): without
    them it warns once and returns the values of ``interpolation="corrected"``, continuous and of the same order but off
    the manifold.

    Parameters
    ----------
    path : str or path-like
        The file.
    invariants : callable, Invariants, or list of these, optional
        The invariants that the run had, in their order. They are held at the values in the file.
    args : tuple, optional
        Their extra arguments.

    Returns
    -------
    Solution

    Raises
    ------
    ValueError
        The file was not written by `Solution.save`, is damaged, or is of a newer version of invariode; or the
        invariants are not those of the run, by their names or by their values.
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
    except (KeyError, TypeError, ValueError, AttributeError, MemoryError) as wrong:
        raise _unreadable(path, f"is damaged: {type(wrong).__name__}: {wrong}") from None
    if listed:
        bound = _bind_again(path, solution, dense, listed, extra)
        solution = dataclasses.replace(solution, _invariants=bound)
    if dense is None:
        return solution
    imposed = {"rtol": solution._rtol, "atol": solution._atol} if about["imposed"] else None
    projects = imposed or (about["dense"]["interpolation"] == "projected" and len(solution._invariants) > 0)
    kind = _Unprojected if projects and not listed else DenseSolution
    return dataclasses.replace(solution, sol=kind(dense, solution.y.dtype, solution._invariants, imposed))


@dataclasses.dataclass
class _StoredInvariants(BoundInvariants):
    """Those of a file, without functions: at its outputs what was computed when it was saved."""

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
    """That of a file which needs functions to project, and has none."""

    _told = False

    def __call__(self, t: ArrayLike) -> Array:
        if not self._told and (self._imposed or not np.isin(t, self.ts).all()):
            self._told = True
            warn(
                "sol(t) is not projected onto the invariants: their functions are not in the file; give them, "
                "invariode.load(path, invariants=...)"
            )
        return DenseSolution(self._dense, self._dtype, self._invariants)(t)


def _to_arrays(solution: Solution) -> dict[str, Any]:
    g, dense = solution._invariants, solution.sol
    residual, distance, correction = solution._drift
    pieces = g.pieces_of_output(len(solution.t))
    arrays: dict[str, Any] = {
        "t": solution.t,
        "y": solution.y,
        "rtol": np.asarray(solution._rtol, dtype=float),
        "atol": np.asarray(solution._atol, dtype=float),
        "drift.residual": residual,
        "drift.distance": distance,
        "drift.correction": np.asarray(correction),
        "invariants.value": g.value,
        "invariants.residual": solution.residual,
        "invariants.distance": g.distance(solution.t, solution.y, solution._rtol, solution._atol, pieces),
        "jumps.row": np.array([row for row, _, _ in g.jumps], dtype=np.int64),
        "jumps.t": np.array([t for _, t, _ in g.jumps], dtype=float),
        "jumps.value": np.array([value for _, _, value in g.jumps], dtype=float).reshape(len(g.jumps), len(g)),
    }
    if solution.steps is not None:
        arrays["steps"] = solution.steps._rows
    for what, events in (("t_events", solution.t_events), ("y_events", solution.y_events)):
        arrays |= {f"{what}.{i}": one for i, one in enumerate(events or ())}
    parts = {} if dense is None else dense._dense.parts()
    arrays |= {f"dense.{name}": part for name, part in parts.items() if isinstance(part, np.ndarray)}
    about = {
        "format": _FORMAT,
        "version": _VERSION,
        "invariode": version("invariode"),
        "name": solution._names.problem,
        "labels": _labels(solution),
        "events": None if solution.t_events is None else len(solution.t_events),
        "title": solution._names.title,
        "event_names": solution._names.events,
        "invariants": g.names,
        "forward": g.forward,
        **{name: solution[name] for name in _PLAIN},
        "stats": dict(solution.stats),
        "dense": {name: part for name, part in parts.items() if not isinstance(part, np.ndarray)},
        "imposed": dense is not None and dense._imposed is not None,
    }
    arrays["about"] = np.array(json.dumps(about))
    return arrays


#: The fields of a Solution that JSON takes as they are.
_PLAIN = ("nfev", "njev", "nlu", "status", "message", "success")


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """All arrays of the file, every byte of it checked, and what it says of itself."""
    import zipfile
    import zlib

    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            file.seek(0)
            incomplete = file.read(2) == b"PK"
            raise _unreadable(path, "is incomplete" if incomplete else "was not written by Solution.save")
        file.seek(0)
        try:
            with zipfile.ZipFile(file) as archive:
                if (changed := archive.testzip()) is not None:
                    raise ValueError(f"{changed} has changed")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                contents = dict(arrays)
        except (ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as wrong:
            raise _unreadable(path, f"is damaged: {wrong}") from None
        except OSError as wrong:
            if wrong.errno != errno.EINVAL:  # which is a position before the start of the file
                raise
            raise _unreadable(path, "is damaged") from None
    return contents, _about(path, str(contents.get("about", "")))


def _about(path: str | os.PathLike[str], text: str) -> dict[str, Any]:
    try:
        about = json.loads(text)
    except json.JSONDecodeError:
        about = None
    if not isinstance(about, dict) or about.get("format") != _FORMAT or not isinstance(about.get("version"), int):
        raise _unreadable(path, "was not written by Solution.save")
    if about["version"] > _VERSION:
        raise _unreadable(
            path,
            f"has version {about['version']} of the format, written by invariode {about.get('invariode')}; this is "
            f"invariode {version('invariode')}, which reads versions up to {_VERSION}: upgrade it",
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
    jumps = zip(arrays["jumps.row"].tolist(), arrays["jumps.t"].tolist(), arrays["jumps.value"], strict=True)
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
        **{name: about[name] for name in _PLAIN},
        stats=Stats(**about["stats"]),
        steps=Steps(arrays["steps"]) if "steps" in arrays else None,
        _invariants=g,
        _rtol=arrays["rtol"].tolist(),
        _atol=arrays["atol"].tolist(),
        _drift=(arrays["drift.residual"], arrays["drift.distance"], float(arrays["drift.correction"])),
        _names=Names(about["name"], about["title"], about["labels"], len(y), about["event_names"]),
    )
    return solution, dense


#: At so many outputs the invariants given to `load` are compared with those of the run.
_COMPARED = 16


def _bind_again(
    path: str | os.PathLike[str], solution: Solution, dense: Dense | None, listed: list[Any], args: tuple[Any, ...]
) -> BoundInvariants:
    """The invariants of the file with their functions, once these are seen to be the same."""
    stored, t, y = solution._invariants, solution.t, solution.y
    if not len(stored):
        raise ValueError(f"invariants are given, and the run in {os.fspath(path)} had none")
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
