"""Solutions as data: labelled arrays and tables."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .._base import arguments
from .._base.arguments import Array
from .._base.formats import write
from .._base.package import extra, version
from .._problem.methods import find_method
from .result import Result
from .saving import SOLUTION, require_whole
from .sensitivity_data import named

_TABLE, _LABELLED = "write sol.to_dataframe() in that format", "write sol.to_xarray() in that format"
#: Endings of files in other formats, and how to write these.
_OTHER_FORMATS = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".xlsx", ".parquet", ".json"), _TABLE),
    **dict.fromkeys((".nc", ".h5", ".hdf5", ".zarr"), _LABELLED),
    ".mat": "pass sol.t and sol.y to scipy.io.savemat",
    ".png": "save a picture with sol.plot()",
}

if TYPE_CHECKING:  # an extra, imported when it is used
    import pandas
    import xarray


class Exports(Result):
    """The data of a `Solution` in other forms, as its methods."""

    def to_xarray(self) -> xarray.Dataset:
        """Return the solution as a labelled data set of xarray, which can be written as netCDF.

        Returns
        -------
        xarray.Dataset
            `y` (component, t), with the problem's labels and the times as coordinates, complex if the problem is.
            `sensitivities` (component, parameter, t), if there are any.
            With invariants, `residual` (invariant, t), and their first values as the coordinate `value`. For each event
            `y_events_NAME` (event_NAME, component) with its times as the coordinate `t_events_NAME`; events that share
            a name are numbered. If the steps were kept, `h, order, error, correction` (t_step). The attributes
            are the problem's name, the outcome, the tolerances, and all counts of `stats`.

        Raises
        ------
        ModuleNotFoundError
            xarray, of the extra `data`, is not installed.
        """
        xr = extra("xarray", "this needs", "data")
        variables: dict[str, Any] = {"y": (("component", "t"), self.y)}
        coordinates: dict[str, Any] = {"component": _labels(self), "t": self.t}
        g = self._invariants
        if len(g):
            coordinates["invariant"] = list(g.names)
            coordinates["value"] = ("invariant", g.value)
            variables["residual"] = (("invariant", "t"), self.residual, {"long_name": "g - value"})
        S = self._sensitivities
        if S is not None:
            coordinates["parameter"] = S.names
            variables["sensitivities"] = (("component", "parameter", "t"), S.values, {"long_name": "dy / dp"})
        for name, t, y in zip(_event_names(self), self.t_events or (), self.y_events or (), strict=True):
            coordinates[f"t_events_{name}"] = (f"event_{name}", t)
            variables[f"y_events_{name}"] = ((f"event_{name}", "component"), y.reshape(len(t), len(self.y)))
        if self.steps is not None:
            coordinates["t_step"] = self.steps.t
            variables["h"] = ("t_step", self.steps.h, {"long_name": "size of the step"})
            variables["order"] = ("t_step", self.steps.order)
            variables["error"] = ("t_step", self.steps.error, {"long_name": "estimated error / rtol"})
            variables["correction"] = ("t_step", self.steps.correction, {"long_name": "correction / rtol"})
            variables["method"] = ("t_step", self.steps.method)
        about = {
            name: int(value) if isinstance(value, bool) else value  # netCDF has no booleans
            for name, value in attributes(self).items()
        }
        data: xarray.Dataset = xr.Dataset(variables, coordinates, about)
        return data

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the outputs as a table of pandas.

        Returns
        -------
        pandas.DataFrame
            One row per output, with the index `t`; a column per component under its label (complex ones have two,
            LABEL.real and LABEL.imag, so that they can be written), with sensitivities ``d LABEL / d PARAMETER``, then
            ``residual of NAME`` for each invariant. Its
            `attrs` hold what the attributes of `to_xarray` do, and the invariants' values.

        Raises
        ------
        ModuleNotFoundError
            pandas, of the extra `data`, is not installed.
        """
        pd = extra("pandas", "this needs", "data")
        columns: list[tuple[str, Array]] = []
        for label, values in zip(_labels(self), self.y, strict=True):
            if np.iscomplexobj(values):
                columns += [(f"{label}.real", values.real), (f"{label}.imag", values.imag)]
            else:
                columns.append((label, values))
        S = self._sensitivities
        if S is not None:
            names = named(S.names, _labels(self))
            columns += zip(names, S.values.reshape(len(names), len(self.t)), strict=True)
        g = self._invariants
        if len(g):
            columns += [(f"residual of {name}", row) for name, row in zip(g.names, self.residual, strict=True)]
        rows = np.array([values for _, values in columns]).reshape(len(columns), len(self.t)).T
        table: pandas.DataFrame = pd.DataFrame(
            rows, index=pd.Index(self.t, name="t"), columns=[name for name, _ in columns]
        )
        table.attrs = attributes(self)
        if len(g):
            table.attrs["invariants"] = dict(zip(g.names, g.value.tolist(), strict=True))
        return table

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything but the functions to one file, from which `invariode.load` makes an equal Solution.

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
        ValueError
            Fields are missing, or t and y do not fit each other; the name ends like that of another format.
        OSError
            The file cannot be written.
        """
        require_whole(self)
        ending = Path(arguments.path("path", path)).suffix.lower()
        if ending in _OTHER_FORMATS:
            raise ValueError(
                f"save writes NPZ files, and {os.fspath(path)!r} ends in {ending}: {_OTHER_FORMATS[ending]}"
            )
        write(path, SOLUTION, SOLUTION.taken(self))


# ----------------------------------------------------------------------------------------------------------------------
# Labelled arrays and tables


def ensemble_to_xarray(ensemble: Any) -> xarray.Dataset:
    """See `EnsembleSolution.to_xarray`."""
    xr = extra("xarray", "this needs", "data")
    whole = ("trajectory", "component", "t")
    variables: dict[str, Any] = {
        "y": (whole, ensemble.y),
        "y_end": (whole[:2], ensemble.y_end),
        **{name: ("trajectory", ensemble[name]) for name in ("t_end", "status", "attempt", "correction")},
        **{name: ("trajectory", counts) for name, counts in ensemble.stats.items()},
    }
    if ensemble.sensitivities is not None:
        variables["sensitivities"] = ((*whole[:2], "parameter", "t"), ensemble.sensitivities)
    if ensemble.value.shape[1]:
        laws = ("value", "residual_before", "residual_after")
        variables |= {name: (("trajectory", "invariant"), ensemble[name]) for name in laws}
    coordinates = {
        "trajectory": ensemble.index,
        "component": ensemble.labels,
        "t": ensemble.t,
        **({} if ensemble.sensitivities is None else {"parameter": ensemble.sensitivity_names}),
    }
    for name, values in ensemble.parameters.items():
        coordinates[f"args[{name}]" if name in coordinates or name in variables else name] = ("trajectory", values)
    data: xarray.Dataset = xr.Dataset(variables, coordinates, {"invariode_version": version()})
    return data


def ensemble_to_dataframe(ensemble: Any) -> pandas.DataFrame:
    """See `EnsembleSolution.to_dataframe`."""
    pd = extra("pandas", "this needs", "data")
    size, n, times = ensemble.y.shape
    t = ensemble.t_end if ensemble._final else np.tile(ensemble.t, size)
    labels = ensemble.index.repeat(times)
    index = pd.MultiIndex.from_arrays([labels, t], names=["trajectory", "t"])
    rows = ensemble.y.transpose(0, 2, 1).reshape(size * times, n)
    table: pandas.DataFrame = pd.DataFrame(rows, index=index, columns=ensemble.labels)
    for name, values in ensemble.parameters.items():
        table[f"args[{name}]" if name in ensemble.labels else name] = values.repeat(times)
    return table[np.isfinite(rows).all(axis=1)]


def _labels(solution: Result) -> list[str]:
    return [str(label) for label in solution._names.components]


def _event_names(solution: Result) -> list[str]:
    """Return one distinct name per event, fit for a variable."""
    names = ["".join(c if c.isalnum() else "_" for c in name) for name in solution._names.events]
    return names if len(set(names)) == len(names) else [f"{name}_{i}" for i, name in enumerate(names)]


def attributes(solution: Result) -> dict[str, Any]:
    """Return the fields that have one value for the whole solution, in Python's own types, which netCDF and JSON
    take."""
    known = {name: value for name, value in solution.stats.items() if value not in (None, ())}
    return {
        "name": solution._names.problem,
        "message": solution.message,
        "status": solution.status,
        "success": solution.success,
        **_asked(solution),
        "rtol": _tolerance(solution._rtol),
        "atol": _tolerance(solution._atol),
        **{name: json.dumps(value) if isinstance(value, dict) else value for name, value in known.items()},
        "invariode_version": version(),
    }


#: A file writes out no more arguments.
_FEW = 8


def _asked(solution: Result) -> dict[str, Any]:
    """Return the method, and the arguments if they are a few numbers, of a solution that knows its run."""
    origin = solution._origin
    if origin is None:
        return {}
    if origin.source is None:  # it comes from a file
        about = origin.identity().about
        method, args = about["method"], about["problem"]["args"]
    else:
        method, args = find_method(origin.source.method)[0].name, origin.source.problem.args
    values = [np.asarray(one) for one in args or ()]
    numbers = all(one.ndim == 0 and one.dtype.kind in "iuf" and np.isfinite(one) for one in values)
    return {"method": method} | ({"args": _tolerance(values)} if numbers and 0 < len(values) <= _FEW else {})


def _tolerance(given: ArrayLike) -> float | list[float]:
    """Return a tolerance as a number if it is one, or an array of one, which netCDF cannot distinguish."""
    values = np.asarray(given, dtype=float)
    return float(values.item()) if values.size == 1 else [float(one) for one in values]
