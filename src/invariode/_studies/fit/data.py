"""Data as arrays, dicts, pandas tables or labelled xarray arrays."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..._base.arguments import Array, real_numbers, shown
from ..._base.labelled import is_mapping
from ..._base.labelled import is_table as has_columns

#: The name of the dimension of time in labelled arrays, which is that of `Solution.to_xarray`.
_TIME = "t"

#: The name of a column of times, perhaps with a unit: t, time, Time [h].
_COLUMN = re.compile(r"(?:t|(?i:time))\s*(?:\[.*\]|\(.*\))?")


class Data(NamedTuple):
    """Values by quantity and time; NaN where nothing was measured."""

    t: Array  # (n_t,)
    values: Array  # (m, n_t)
    names: list[str] | None  # of the quantities; None: the data have none


def is_table(value: Any) -> bool:
    """Return whether a value is a table of data with its own times, not the times alone."""
    labelled = hasattr(value, "dims") and hasattr(value, "coords") and getattr(value, "ndim", 0) == 2
    return isinstance(value, Mapping) or has_columns(value) or labelled  # a Dataset is a Mapping


def read(t: Any, data: Any, m: int) -> Data:
    """Return times and values, checked; `m` is the number of quantities of data without names.

    Values with labels of time (the index of pandas, the coordinate "t" of xarray) are put into the order of `t`.
    """
    if is_mapping(data):
        return _of_columns(t, data)
    if has_columns(data):
        columns = _columns(data)
        if (t is None and column_of_times(columns) is None) or (isinstance(t, str) and t == data.index.name):
            t = _index_of_times(data.index, columns)
        return _of_columns(t, columns)
    if hasattr(data, "data_vars"):
        if "y" not in data.data_vars:
            return _of_columns(_times_of(data) if t is None else t, dict(data.data_vars))
        data = data["y"]
    if hasattr(data, "dims") and hasattr(data, "coords"):
        return _labelled(t, data)
    times = _times(t)
    if m > 1 and np.ndim(data) == 1 and isinstance(name := getattr(data, "name", None), str):  # a column of a table
        return _of_columns(t, {name: data})
    values = real_numbers("data", in_order(t, data, "data"))
    if values.ndim == 1:
        values = values[None]
    return Data(times, checked(_oriented(values, len(times), m)), None)


def in_order(t: Any, values: Any, what: str) -> Any:
    """Return values with labels of time in the order of the times `t`; values without labels unchanged.

    - `t`: the times, of shape (n_t,). If it has an index itself (a column of a table), values with an index are matched
      with that; otherwise numeric labels are times.
    - `values`: what is to be put in order, with the times along its last axis, or along the rows of a table
    - `what`: its name in messages

    Raises ValueError: The labels are other times, or repeat themselves where t has an index.
    """
    if is_mapping(values):
        return {name: in_order(t, one, f"{what} of {name}") for name, one in values.items()}
    if has_columns(values):
        return {name: in_order(t, one, f"{what} of {name}") for name, one in _columns(values).items()}
    labels = _labels(values)
    if labels is None:
        return values
    wanted, own = _labels(t), True
    if wanted is None:
        wanted, own = np.asarray(t), False
        if not hasattr(values, "dims") and _row_numbers(values):
            return values
        if labels.dtype.kind not in "biuf" or wanted.dtype.kind not in "biuf":
            return values  # names of rows say nothing about time
    array = np.asarray(values)
    if labels.shape == wanted.shape and bool((labels == wanted).all()):
        return array if array.ndim == 1 else values
    order, place = np.argsort(labels, kind="stable"), np.argsort(wanted, kind="stable")
    if labels.shape != wanted.shape or not bool((labels[order] == wanted[place]).all()):
        index = "the index of t" if own else "t"
        raise ValueError(
            f"{what} is labelled with {_few(labels)}, and {index} is {_few(wanted)}: leave t out if the labels are the "
            "times; if they are not, pass the values without them (to_numpy(), or reset_index(drop=True) of a table)"
        )
    if own and len(np.unique(labels)) < len(labels):
        raise ValueError(f"{what} and t have labels that repeat themselves, in another order: {_few(labels)}")
    source = np.empty(len(order), dtype=int)
    source[place] = order
    return array[..., source]


def _labels(values: Any) -> Array | None:
    """Return the labels of time of an array, or None if it has none."""
    if hasattr(values, "dims") and hasattr(values, "coords"):
        return np.asarray(values[_TIME].values) if _TIME in values.coords and values.dims[-1:] == (_TIME,) else None
    index = getattr(values, "index", None)
    return None if index is None or callable(index) else np.asarray(index)


def _row_numbers(values: Any) -> bool:
    """Return whether an index only counts rows from 0, as in a table without an index of its own."""
    index = values.index
    return type(index).__name__ == "RangeIndex" and index.start == 0 and index.step == 1


def _columns(table: Any) -> dict[Any, Any]:
    """Return the columns of a table by name.

    Raises ValueError: Two have one name.
    """
    if len(twice := table.columns[table.columns.duplicated()]):
        raise ValueError(f"the table has two columns {twice[0]!r}: leave one out")
    return {name: table[name] for name in table.columns}


def _index_of_times(index: Any, columns: Iterable[Any]) -> Array:
    """Return the index of a table as times: if it has a name, or if its labels are no integers or texts, which say
    which rows of another table these are.

    Raises ValueError: It has no name, and such labels.
    """
    if index.name is not None or index.dtype.kind in "fmM":
        return np.asarray(index)
    raise ValueError(
        f"the table has no column t or time, but {', '.join(map(str, columns))}, and its index has no name and "
        f"may count rows: name the column of times, such as t={str([*columns][-1])!r}; if the index holds them, "
        "table.rename_axis('t')"
    )


def _times_of(labelled: Any) -> Array:
    """Return the coordinate of times of an array or Dataset of xarray.

    Raises ValueError: No coordinate is named t or time.
    """
    name = column_of_times(labelled.coords)
    if name is None:
        raise ValueError(f"labelled data need a coordinate t or time, and have {', '.join(map(str, labelled.coords))}")
    return np.asarray(labelled[name].values)


def _few(labels: Array) -> str:
    return f"({', '.join(f'{one:g}' if labels.dtype.kind in 'iuf' else str(one) for one in labels[:6])}" + (
        ", …)" if len(labels) > 6 else ")"
    )


def _times(t: Any) -> Array:
    if t is None:
        raise TypeError("t is missing: the times of the data, or the name of their column unless it is t or time")
    times = real_numbers("t", t)
    if times.ndim == 1 and np.isnan(times).any():
        raise ValueError(f"t holds the times of the data, and t[{int(np.argmax(np.isnan(times)))}] is NaN")
    if times.ndim != 1 or not len(times) or not (np.isfinite(times) | (times == np.inf)).all():
        raise ValueError(f"t must be the times of the data, of shape (n_t,), got {shown(t)}")
    return times


def column_of_times(names: Iterable[Any]) -> str | None:
    """Return the name of the column of times, the shortest if several look like one."""
    return min((name for name in names if isinstance(name, str) and _COLUMN.fullmatch(name)), key=len, default=None)


def _of_columns(t: Any, columns: Mapping[Any, Any]) -> Data:
    """Return a column for each quantity."""
    t = column_of_times(columns) if t is None else t
    if isinstance(t, str):
        if t not in columns:
            raise ValueError(f"t names the column {t!r}, and the data have {', '.join(map(str, columns))}")
        columns = dict(columns)
        t = columns.pop(t)
    times = _times(t)
    columns = in_order(t, columns, "data")
    rows = {str(name): real_numbers(f"data of {name}", column) for name, column in columns.items()}
    if not rows:
        raise ValueError("data have no columns of values")
    for name, row in rows.items():
        if row.shape != times.shape:
            raise ValueError(f"data of {name} must have one value for each of the {len(times)} times, got {row.shape}")
    return Data(times, checked(np.array([*rows.values()])), [*rows])


def _labelled(t: Any, data: Any) -> Data:
    """Return a labelled array, with its dimensions in any order."""
    if _TIME not in data.dims and (name := column_of_times(data.dims)) is not None:
        data = data.rename({name: _TIME})
    if _TIME not in data.dims or data.ndim > 2:
        raise ValueError(f"a labelled array of data has the dimensions {_TIME!r} and another one, got {data.dims}")
    other = [one for one in data.dims if one != _TIME]
    named = bool(other) and other[0] in data.coords
    names = [str(one) for one in data[other[0]].values] if named else None
    times = _times(data[_TIME].values if t is None else t)
    rows = in_order(times if t is None else t, data.transpose(*other, _TIME), "data")
    values = np.asarray(rows, dtype=float).reshape(-1, data.sizes[_TIME])
    if values.shape[1] != len(times):
        raise ValueError(f"data have {values.shape[1]} times, and t has {len(times)}")
    return Data(times, checked(values), names)


def _oriented(values: Array, count: int, m: int) -> Array:
    """Return values of shape (m, n_t), like `sol.y`; those of shape (n_t, m) are transposed, an error if both are
    possible."""
    if values.shape == (m, count) == (count, m) and m > 1:
        raise ValueError(
            f"data of shape {values.shape} could have the times along either axis: give a dict, a DataFrame or a "
            "labelled array, which name the quantities"
        )
    if values.shape == (m, count):
        return values
    if values.shape == (count, m):
        return values.T
    if len(values) == 1 and values.shape[1] == count:
        raise ValueError(
            f"data of one quantity, and {m} components are observed: name it, as in {{'label': data}}, or pass observe="
        )
    expected = f"({m}, {count}), a row for each observed quantity and a column for each time"
    raise ValueError(f"data must have shape {expected}, got {values.shape}")


def checked(values: Array) -> Array:
    """Return values of the data, finite or NaN, not NaN throughout."""
    if np.isinf(values).any():
        raise ValueError("data must be finite, or NaN where nothing was measured")
    if np.isnan(values).all():
        raise ValueError("data are NaN throughout: nothing was measured")
    return np.ascontiguousarray(values, dtype=float)
