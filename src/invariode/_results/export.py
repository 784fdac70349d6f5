"""Solutions as data: labelled arrays, tables, and the files that `load` reads."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import os
import secrets
import stat
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, shown, warn
from .._base.files import path_of
from .result import Result

if TYPE_CHECKING:  # an extra, imported when it is used
    import pandas
    import xarray

__all__ = [
    "FORMAT",
    "PLAIN",
    "TEMPORARY",
    "VERSION",
    "Exports",
    "ensemble_to_dataframe",
    "ensemble_to_xarray",
    "save",
    "to_dataframe",
]
__all__ += ["take_mode", "to_xarray", "write_arrays"]

#: What every file says about itself, and the version of its contents: raised whenever they change.
FORMAT, VERSION = "invariode solution", 4

#: How deep lists and dicts may be nested in fields that the user adds.
_DEEPEST = 50

#: How the names of files end that are being written.
TEMPORARY = ".invariode-part"

#: The fields of a Solution that JSON takes as they are.
PLAIN = ("nfev", "njev", "nlu", "status", "message", "success")


class Exports(Result):
    """The data of a `Solution` in other forms, as its methods."""

    def to_xarray(self) -> xarray.Dataset:
        """The solution as a labelled data set of xarray, which can be written as netCDF.

        Returns
        -------
        xarray.Dataset
            `y` (component, t), with the problem's labels and the times as coordinates, complex if the problem is.
            With invariants, `residual` (invariant, t), and their first values as the coordinate `value`. For each event
            `y_events_NAME` (event_NAME, component) with its times as the coordinate `t_events_NAME`; events that share
            a name are numbered. If the steps were kept, `h, order, error, correction` (t_step). The attributes
            are the problem's name, the outcome, the tolerances, and all counts of `stats`.

        Raises
        ------
        ModuleNotFoundError
            xarray, of the extra `data`, is not installed.
        """
        return to_xarray(self)

    def to_dataframe(self) -> pandas.DataFrame:
        """The outputs as a table of pandas.

        Returns
        -------
        pandas.DataFrame
            One row per output, with the index `t`; a column per component under its label (complex ones have two,
            LABEL.real and LABEL.imag, so that they can be written), then ``residual of NAME`` for each invariant. Its
            `attrs` hold what the attributes of `to_xarray` do, and the invariants' values.

        Raises
        ------
        ModuleNotFoundError
            pandas, of the extra `data`, is not installed.
        """
        return to_dataframe(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes everything but the functions to one file, from which `invariode.load` makes an equal Solution.

        What the run remembers is in it too: ``load(path, problem).extend(tf)`` goes on to the last bit. The residuals
        of the invariants and their distances are evaluated for it, at all outputs, and f at the start, by which
        `invariode.load` tells whether a problem is the same. Fields that you have added are kept if they are numbers,
        text, None, lists or dicts of these, or arrays of numbers; a warning names the others.

        Parameters
        ----------
        path : str or path-like
            The file, under exactly this name; conventionally it ends in ``.npz``. An existing file is replaced, all at
            once when the new one is complete, and keeps its mode. A pipe or a device is written to.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        save(self, path)


# ----------------------------------------------------------------------------------------------------------------------
# Labelled arrays and tables


def to_xarray(solution: Result) -> xarray.Dataset:
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
        variables[f"y_events_{name}"] = ((f"event_{name}", "component"), y.reshape(len(t), len(solution.y)))
    if solution.steps is not None:
        coordinates["t_step"] = solution.steps.t
        variables["h"] = ("t_step", solution.steps.h, {"long_name": "size of the step"})
        variables["order"] = ("t_step", solution.steps.order)
        variables["error"] = ("t_step", solution.steps.error, {"long_name": "estimated error / rtol"})
        variables["correction"] = ("t_step", solution.steps.correction, {"long_name": "correction / rtol"})
        variables["method"] = ("t_step", solution.steps.method)
    attributes = {
        name: int(value) if isinstance(value, bool) else value  # netCDF has no booleans
        for name, value in _attributes(solution).items()
    }
    data: xarray.Dataset = xr.Dataset(variables, coordinates, attributes)
    return data


def to_dataframe(solution: Result) -> pandas.DataFrame:
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


def ensemble_to_xarray(ensemble: Any) -> xarray.Dataset:
    """See `EnsembleSolution.to_xarray`."""
    xr = _extra("xarray")
    whole = ("trajectory", "component", "t")
    variables: dict[str, Any] = {
        "y": (whole, ensemble.y),
        "y_end": (whole[:2], ensemble.y_end),
        **{name: ("trajectory", ensemble[name]) for name in ("t_end", "status", "attempt", "correction")},
        **{name: ("trajectory", counts) for name, counts in ensemble.stats.items()},
    }
    if ensemble.value.shape[1]:
        laws = ("value", "residual_before", "residual_after")
        variables |= {name: (("trajectory", "invariant"), ensemble[name]) for name in laws}
    coordinates = {
        "trajectory": np.arange(len(ensemble)),
        "component": ensemble.labels,
        "t": ensemble.t,
    }
    data: xarray.Dataset = xr.Dataset(variables, coordinates, {"invariode_version": version("invariode")})
    return data


def ensemble_to_dataframe(ensemble: Any) -> pandas.DataFrame:
    """See `EnsembleSolution.to_dataframe`."""
    pd = _extra("pandas")
    size, n, times = ensemble.y.shape
    t = ensemble.t_end if ensemble._final else np.tile(ensemble.t, size)
    index = pd.MultiIndex.from_arrays([np.repeat(np.arange(size), times), t], names=["trajectory", "t"])
    rows = ensemble.y.transpose(0, 2, 1).reshape(size * times, n)
    table: pandas.DataFrame = pd.DataFrame(rows, index=index, columns=ensemble.labels)
    return table[np.isfinite(rows).all(axis=1)]


def _extra(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        if missing.name != module:
            raise
        message = f'this needs {module}: pip install "invariode[data]"'
        raise ModuleNotFoundError(message, name=module) from None


def _labels(solution: Result) -> list[str]:
    return [str(label) for label in solution._names.components]


def _event_names(solution: Result) -> list[str]:
    """One distinct name per event, fit for a variable."""
    names = [_identifier(name) for name in solution._names.events]
    return names if len(set(names)) == len(names) else [f"{name}_{i}" for i, name in enumerate(names)]


def _identifier(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def _attributes(solution: Result) -> dict[str, Any]:
    """What is one value for the whole solution; Python's own types, so that netCDF and JSON take them."""
    known = {name: value for name, value in solution.stats.items() if value not in (None, ())}
    return {
        "name": solution._names.problem,
        "message": solution.message,
        "status": solution.status,
        "success": solution.success,
        "rtol": _tolerance(solution._rtol),
        "atol": _tolerance(solution._atol),
        **{name: json.dumps(value) if isinstance(value, dict) else value for name, value in known.items()},
        "invariode_version": version("invariode"),
    }


def _tolerance(given: ArrayLike) -> float | list[float]:
    """A number, also for an array of one, which netCDF does not tell from it."""
    values = np.asarray(given, dtype=float)
    return float(values.item()) if values.size == 1 else [float(one) for one in values]


# ----------------------------------------------------------------------------------------------------------------------
# Files: an .npz archive of arrays, and in `about` everything else, as JSON. Nothing in it is ever executed.


def save(solution: Result, path: str | os.PathLike[str]) -> None:
    """See `Solution.save`."""
    write_arrays(_to_arrays(solution), path)


def write_arrays(arrays: dict[str, Any], path: str | os.PathLike[str], durable: bool = False) -> None:
    """Writes an archive of arrays, which takes the place of one that is there when it is complete; `durable`: when it
    is on the disk."""
    path = path_of(path)
    try:
        there = os.stat(path)
    except FileNotFoundError:
        there = None
    if there is None or stat.S_ISREG(there.st_mode):
        target = Path(os.path.realpath(path))
        _replace(target, there, arrays, durable)
        if durable:
            _write_through(target.parent)
    else:  # a pipe, a device, where an archive cannot go back; of a directory this says what it is
        with open(path, "wb") as file:
            whole = io.BytesIO()
            np.savez(whole, **arrays)
            file.write(whole.getbuffer())


def _write_through(folder: Path) -> None:
    """Waits until the names in a folder are on the disk, where the system can say so."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _replace(target: Path, there: os.stat_result | None, arrays: dict[str, Any], durable: bool) -> None:
    """Writes the file beside the target, and puts it in its place once it is complete."""
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}{TEMPORARY}")
    try:
        nameless = _nameless(target.parent)
        with nameless or open(temporary, "xb") as file:
            if there is not None:
                take_mode(file.fileno(), there)
            np.savez(file, **arrays)
            file.flush()
            if durable:
                os.fsync(file.fileno())
            if nameless:  # src_dir_fd: without it Python's os.link does not follow symbolic links
                os.link(f"/proc/self/fd/{file.fileno()}", temporary, src_dir_fd=file.fileno(), follow_symlinks=True)
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _nameless(folder: Path) -> Any:
    """A file without a name, which is gone when the process is killed; None if the system has no such files."""
    if not hasattr(os, "O_TMPFILE") or not os.path.isdir("/proc/self/fd"):
        return None
    try:
        return os.fdopen(os.open(folder, os.O_TMPFILE | os.O_RDWR, 0o666), "w+b")
    except OSError:  # not on this file system
        return None


def take_mode(file: int, other: os.stat_result) -> None:
    """Gives a file the mode of another one, and its owner if we may."""
    if not hasattr(os, "fchmod"):
        return
    if other.st_uid != os.fstat(file).st_uid:
        with suppress(PermissionError):
            os.fchown(file, other.st_uid, other.st_gid)
    os.fchmod(file, stat.S_IMODE(other.st_mode))


def _to_arrays(solution: Result) -> dict[str, Any]:
    g, dense = solution._invariants, solution.sol
    pieces = g.pieces_of_output(len(solution.t))
    arrays: dict[str, Any] = {
        "t": solution.t,
        "y": solution.y,
        "rtol": np.asarray(solution._rtol, dtype=float),
        "atol": np.asarray(solution._atol, dtype=float),
        "drift.residual": solution._drift.residual,
        "drift.distance": solution._drift.distance,
        "drift.correction": np.asarray(solution._drift.correction),
        "invariants.value": g.value,
        "invariants.residual": solution.residual,
        "invariants.distance": g.distance(solution.t, solution.y, solution._rtol, solution._atol, pieces),
        "jumps.row": np.array([jump.row for jump in g.jumps], dtype=np.int64),
        "jumps.t": np.array([jump.t for jump in g.jumps], dtype=float),
        "jumps.value": np.array([jump.value for jump in g.jumps], dtype=float).reshape(len(g.jumps), len(g)),
    }
    if solution.steps is not None:
        arrays["steps"] = solution.steps._rows
    for what, events in (("t_events", solution.t_events), ("y_events", solution.y_events)):
        arrays |= {f"{what}.{i}": one for i, one in enumerate(events or ())}
    origin: dict[str, Any] | None = None
    if solution._origin is not None:
        origin, of_origin = solution._origin.stored()
        arrays |= {f"origin.{name}": one for name, one in of_origin.items()}
    parts = {} if dense is None else dense._dense.parts()
    arrays |= {f"dense.{name}": part for name, part in parts.items() if isinstance(part, np.ndarray)}
    added, of_added = _added(solution)
    arrays |= of_added
    about = {
        "format": FORMAT,
        "version": VERSION,
        "invariode": version("invariode"),
        "name": solution._names.problem,
        "labels": _labels(solution),
        "events": None if solution.t_events is None else len(solution.t_events),
        "title": solution._names.title,
        "event_names": solution._names.events,
        "invariants": g.names,
        "forward": g.forward,
        **{name: solution[name] for name in PLAIN},
        "t_end": solution.t_end,
        "stats": dict(solution.stats),
        "methods": [] if solution.steps is None else list(solution.steps._methods),
        "dense": {name: part for name, part in parts.items() if not isinstance(part, np.ndarray)},
        "imposed": dense is not None and dense._imposed is not None,
        "origin": origin,
        "added": added,
    }
    arrays["about"] = np.array(json.dumps(about))
    return arrays


def _added(solution: Result) -> tuple[dict[str, Any], dict[str, Array]]:
    """The fields that the user has added: by name, values in JSON's types or the names of arrays."""
    own = {field.name for field in dataclasses.fields(Result)}
    added: dict[str, Any] = {}
    arrays: dict[str, Array] = {}
    left_out: list[str] = []
    for name, value in solution.items():
        if name in own:
            continue
        if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biufc":
            array = f"added.{len(arrays)}"
            arrays[array] = np.asarray(value)
            added[name] = {"array": array}
        elif _is_plain(name) and _is_plain(value):
            added[name] = {"value": value}
        else:
            left_out.append(shown(name))
    if left_out:
        warn(f"save keeps numbers, text, lists, dicts and arrays, and leaves out the fields {', '.join(left_out)}")
    return added, arrays


def _is_plain(value: Any, depth: int = 0) -> bool:
    """Whether JSON gives the same value back."""
    if value is None or type(value) in (bool, int, float, str):
        return True
    if depth == _DEEPEST:
        return False
    if type(value) is dict:
        return all(type(name) is str and _is_plain(one, depth + 1) for name, one in value.items())
    return type(value) is list and all(_is_plain(one, depth + 1) for one in value)
