"""Data as arrays, dicts, pandas tables or labelled xarray arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array, real_numbers, shown

#: The name of the dimension of time in labelled arrays, which is that of `Solution.to_xarray`.
_TIME = "t"


class Data(NamedTuple):
    """Values by quantity and time; NaN where nothing was measured."""

    t: Array  # (n_t,)
    values: Array  # (m, n_t)
    names: list[str] | None  # of the quantities; None: the data have none


def read(t: Any, data: Any, m: int) -> Data:
    """Times and values, checked; `m` is the number of quantities of data without names."""
    if isinstance(data, Mapping) and not hasattr(data, "dims"):
        return _of_columns(t, data)
    if hasattr(data, "columns") and hasattr(data, "index"):
        return _of_columns(data.index.to_numpy() if t is None else t, {name: data[name] for name in data.columns})
    if hasattr(data, "data_vars"):
        if "y" not in data.data_vars:
            return _of_columns(data[_TIME].values if t is None else t, {k: v.values for k, v in data.data_vars.items()})
        data = data["y"]
    if hasattr(data, "dims") and hasattr(data, "coords"):
        return _labelled(t, data)
    times = _times(t)
    values = real_numbers("data", data)
    if values.ndim == 1:
        values = values[None]
    return Data(times, _checked(_oriented(values, len(times), m)), None)


def _times(t: Any) -> Array:
    if t is None:
        raise TypeError("t is missing: the times of the data")
    times = real_numbers("t", t)
    if times.ndim != 1 or not len(times) or not np.isfinite(times).all():
        raise ValueError(f"t must be the finite times of the data, of shape (n_t,), got {shown(t)}")
    return times


def _of_columns(t: Any, columns: Mapping[Any, Any]) -> Data:
    """A column for each quantity."""
    if isinstance(t, str):
        if t not in columns:
            raise ValueError(f"t names the column {t!r}, and the data have {', '.join(map(str, columns))}")
        columns = dict(columns)
        t = columns.pop(t)
    times = _times(t)
    rows = {str(name): real_numbers(f"data of {name}", column) for name, column in columns.items()}
    if not rows:
        raise ValueError("data have no columns of values")
    for name, row in rows.items():
        if row.shape != times.shape:
            raise ValueError(f"data of {name} must have one value for each of the {len(times)} times, got {row.shape}")
    return Data(times, _checked(np.array([*rows.values()])), [*rows])


def _labelled(t: Any, data: Any) -> Data:
    """A labelled array, with its dimensions in any order."""
    if _TIME not in data.dims or data.ndim > 2:
        raise ValueError(f"a labelled array of data has the dimensions {_TIME!r} and another one, got {data.dims}")
    other = [one for one in data.dims if one != _TIME]
    values = np.asarray(data.transpose(*other, _TIME).values, dtype=float).reshape(-1, data.sizes[_TIME])
    named = bool(other) and other[0] in data.coords
    names = [str(one) for one in data[other[0]].values] if named else None
    times = _times(data[_TIME].values if t is None else t)
    if values.shape[1] != len(times):
        raise ValueError(f"data have {values.shape[1]} times, and t has {len(times)}")
    return Data(times, _checked(values), names)


def _oriented(values: Array, count: int, m: int) -> Array:
    """Values of shape (m, n_t), like `sol.y`; those of shape (n_t, m) are transposed, an error if both are possible."""
    if values.shape == (m, count) == (count, m) and m > 1:
        raise ValueError(
            f"data of shape {values.shape} could have the times along either axis: give a dict, a DataFrame or a "
            "labelled array, which name the quantities"
        )
    if values.shape == (m, count):
        return values
    if values.shape == (count, m):
        return values.T
    expected = f"({m}, {count}), a row for each observed quantity and a column for each time"
    raise ValueError(f"data must have shape {expected}, got {values.shape}")


def _checked(values: Array) -> Array:
    if np.isinf(values).any():
        raise ValueError("data must be finite, or NaN where nothing was measured")
    if np.isnan(values).all():
        raise ValueError("data are NaN throughout: nothing was measured")
    return np.ascontiguousarray(values, dtype=float)
