"""Results by column name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._base.extras import extra
from .._base.suggestions import meant


class Table(Mapping[str, Array]):
    """Values over time by column name, as ``Model.simulate`` returns them.

    Attributes
    ----------
    columns : list of str
        The names.
    array : ndarray of shape (points, columns)
        The numbers; ``np.asarray(table)`` is the same.
    """

    def __init__(self, columns: Sequence[str], array: Array) -> None:
        self.columns, self.array = list(columns), array

    def __getitem__(self, name: str) -> Array:
        if name not in self.columns:
            raise KeyError(
                f"there is no column {name!r}{meant(name, self.columns)}: there are {', '.join(self.columns)}"
            )
        column: Array = self.array[:, self.columns.index(name)]
        return column

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.array, dtype=dtype) if copy or dtype is not None else self.array

    def to_pandas(self) -> Any:
        """Return a DataFrame. Needs pandas, of the extra `data`."""
        return extra("pandas", "a DataFrame needs", "data").DataFrame(self.array, columns=self.columns)

    def __repr__(self) -> str:
        return f"Table of {len(self.array)} points: {', '.join(self.columns)}"
