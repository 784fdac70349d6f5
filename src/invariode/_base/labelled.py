"""Values with labels, put into the order of known names.

One rule holds wherever users give values that have names (components, parameters, measured quantities), in a dict, in a
table or Series of pandas, in a labelled array of xarray, or in a list of these. Labels that are text are matched with
the names, and a label that is no name is an error. Labels 0, 1, 2, … in order say nothing: these values are taken by
position, like those of an array. Any other labels, such as numbers in another order or times, are an error, since
nobody but the user knows what they count.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .suggestions import first_few, meant

#: Types of values without labels, of which nothing has to be found out.
_PLAIN = frozenset({float, int, bool, tuple, np.ndarray, np.float64, str, type(None)})


def is_table(value: object) -> bool:
    """Return whether a value has columns by name, as a DataFrame has."""
    return hasattr(value, "columns") and hasattr(value, "index")


def is_mapping(value: object) -> bool:
    """Return whether a value is a dict or the like, and no Dataset of xarray, which has the methods of one."""
    return isinstance(value, Mapping) and not hasattr(value, "dims")


def named(what: str, value: Any, known: Sequence[str] = ()) -> dict[str, Any] | None:
    """Return labelled values by name, numbers or columns; None if they have no labels, or count from 0.

    - `what`: its name in messages
    - `known`: names by which the labelled dimension of an array of xarray is found, if several dimensions have labels

    Raises ValueError: Its labels are neither text nor 0, 1, …, or a label repeats itself.
    """
    if type(value) in _PLAIN or isinstance(value, list):
        return None
    if is_mapping(value):
        labels, found = [*value], [*value.values()]
    elif hasattr(value, "data_vars"):
        labels, found = [*value.data_vars], [one.values for one in value.data_vars.values()]
    elif hasattr(value, "dims") and hasattr(value, "coords"):
        dim = _dimension(value, known)
        if dim is None:
            return None
        labels, found = value[dim].values.tolist(), [*np.moveaxis(value.values, value.dims.index(dim), 0)]
    elif is_table(value):
        labels, found = [*value.columns], [value.iloc[:, i].to_numpy() for i in range(len(value.columns))]
    elif hasattr(value, "index") and not callable(value.index):
        labels, found = [*value.index], [*value.tolist()]
    else:
        return None
    if not all(isinstance(one, str) for one in labels):
        if labels == [*range(len(labels))] and not is_mapping(value):
            return None
        raise ValueError(
            f"{what} is labelled with {first_few([*map(str, labels)])}, which are no names{_by_position(value)}"
        )
    if len(set(labels)) < len(labels):
        twice = next(one for i, one in enumerate(labels) if one in labels[:i])
        raise ValueError(f"{what} has the label {twice!r} twice")
    return dict(zip(labels, found, strict=True))


def by_name(what: str, value: Any, known: Sequence[str], whose: str, now: Any = None) -> Any:
    """Return labelled values in the order of the known names, along the last axis; values without labels unchanged.

    - `what`, `whose`: the values and the owners of the names in messages
    - `now`: the values that stay for names without a label, or a function that returns them; None: each name must
      have one

    Raises ValueError: A label is no name, or a name has no label.
    """
    if type(value) in _PLAIN:
        return value
    if isinstance(value, list):
        if not value or type(value[0]) in _PLAIN:
            return value
        return [by_name(what, one, known, whose, now) for one in value]
    found = named(what, value, known)
    if found is None:
        return value
    return in_order(what, found, known, whose, now, _by_position(value))


def in_order(
    what: str, found: Mapping[str, Any], known: Sequence[str], whose: str, now: Any = None, instead: str = ""
) -> NDArray[Any]:
    """Return values by name as an array in the order of the known names, along the last axis.

    Raises ValueError: As `by_name`.
    """
    require_names(what, found, known, whose, complete=now is None, instead=instead)
    if callable(now) and len(found) < len(known):
        now = now()
    chosen = [found[name] if name in found else now[i] for i, name in enumerate(known)]
    try:
        columns = np.broadcast_arrays(*(np.asarray(one) for one in chosen))
    except ValueError:
        sizes = ", ".join(f"{name} {np.shape(one)}" for name, one in zip(known, chosen, strict=True))
        raise ValueError(f"columns of {what} must be of one length, got {sizes}") from None
    return np.stack(columns, axis=-1)


def require_names(
    what: str, given: Collection[str], known: Sequence[str], whose: str, *, complete: bool, instead: str = ""
) -> None:
    """Require that every label is a known name and, if `complete`, that every name has a label.

    Raises ValueError: One is not, or has not; both lists are in the message.
    """
    listed = first_few([*known], 12)
    for label in given:
        if label not in known:
            raise ValueError(f"{what} names {label!r}{meant(label, known)}: the {whose} are {listed}{instead}")
    if complete and (missing := [one for one in known if one not in given]):
        names = first_few([*given], 12) or "nothing"
        raise ValueError(f"{what} is missing for {missing[0]!r}: it names {names}, and the {whose} are {listed}")


def row_labels(value: Any) -> Any | None:
    """Return the labels of the rows of a table, a dict of columns or a labelled array, as the index of pandas or an
    array; None if it has none, or if they count from 0."""
    if is_mapping(value):
        indices = (getattr(one, "index", None) for one in value.values())
        told = (_told(one) for one in indices if one is not None and not callable(one))
        return next((one for one in told if one is not None), None)
    if is_table(value):
        return _told(value.index)
    if hasattr(value, "dims") and hasattr(value, "coords") and len(value.dims):
        first = next(iter(value.dims))
        return _told(value[first].values) if first in value.coords else None
    return None


def _told(index: Any) -> Any | None:
    """Return an index, or None if it has no name and is nothing but 0, 1, 2, …"""
    values = np.asarray(index)
    counting = values.ndim == 1 and values.dtype.kind in "iu" and bool((values == np.arange(len(values))).all())
    return None if counting and getattr(index, "name", None) is None else index


def _dimension(array: Any, known: Sequence[str]) -> Any | None:
    """Return the dimension of a labelled array whose labels are names: the one that has known names, or else the last
    one whose labels are text; otherwise the last one if it has labels."""
    texts = [one for one in array.dims if one in array.coords and array[one].dtype.kind in "UO"]
    ours = [one for one in texts if set(array[one].values.tolist()) & set(known)]
    last = [one for one in [*array.dims][-1:] if one in array.coords]
    return next(iter(ours or texts[-1:] or last), None)


def _by_position(value: Any) -> str:
    """Return the end of a message: how the values can be given by position."""
    return "" if is_mapping(value) else "; by position: pass the values without labels, .to_numpy()"
