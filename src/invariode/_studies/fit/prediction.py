"""Values of a fitted model at other times."""

from __future__ import annotations

from dataclasses import dataclass

from ..._base.arguments import Array
from ..._base.public import public
from ..._results.result import Record


@public
@dataclass(frozen=True, eq=False)
class Prediction(Record):
    """Values of a fitted model at given times, with bands.

    Attributes
    ----------
    t : ndarray, (n_t,)
        The times.
    y : ndarray, (m, n_t)
        The observed quantities.
    standard_error : ndarray, (m, n_t)
        Their standard errors, from those of the parameters.
    lower, upper : ndarray, (m, n_t)
        The ends of the band.
    names : list of str
        The quantities.
    """

    t: Array
    y: Array
    standard_error: Array
    lower: Array
    upper: Array
    names: list[str]
