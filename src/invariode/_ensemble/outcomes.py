"""Outcomes of trajectories, as arrays with a row for each: of a whole ensemble or of a part."""

from __future__ import annotations

import dataclasses
import pickle
import traceback
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import _core
from .._base.arguments import Array
from .ensemble_solution import EnsembleEvents


def counts_by_name(counts: Array) -> dict[str, Any]:
    """Return the statistics of trajectories from rows of counts. The last four are warnings, of which "stiff" is one
    more."""
    by_name = dict(zip(_core.COUNTS, counts.T, strict=True))
    del by_name["dropped"], by_name["harmed"], by_name["fallen"]
    return by_name


#: The status of a trajectory that is not solved, by Ctrl-C or not yet, and its message.
UNSOLVED = -128
NOT_SOLVED = "not solved: Ctrl-C stopped the ensemble"


@dataclasses.dataclass
class Outcomes:
    """Rows of the fields of `EnsembleSolution` of the same names, and of the counts of the core."""

    y: Array
    t_end: Array
    y_end: Array
    status: Array
    counts: Array
    clipped_amount: Array
    stiff_since: Array  # NaN where it is not
    discontinuity: Array  # the first one
    accumulation: Array
    value: Array
    residual_before: Array
    residual_after: Array
    correction: Array
    S: Array  # sensitivities, (rows, n, k, n_t), of k = 0 parameters without them
    S_end: Array
    messages: dict[int, str]
    events: list[EnsembleEvents]
    lanes: str  # as `EnsembleStats` says it
    error: tuple[int, BaseException] | None = None  # of the first trajectory that raised one
    attempt: Array = dataclasses.field(init=False)
    interrupted: bool = dataclasses.field(init=False, default=False)  # by Ctrl-C: some rows are not solved

    def __post_init__(self) -> None:
        self.attempt = np.zeros(len(self.status), dtype=np.int8)

    def __len__(self) -> int:
        return len(self.status)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state, with counts as small integers, since counts are most of the data that a worker returns."""
        largest = max(int(self.counts.max(initial=0)), -int(self.counts.min(initial=0)))
        error = None if self.error is None else (self.error[0], picklable(self.error[1]))
        return {**self.__dict__, "counts": self.counts.astype(np.min_scalar_type(-largest - 1)), "error": error}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, counts=state["counts"].astype(np.int64))

    @property
    def failed(self) -> Array:
        """The rows that failed."""
        return np.flatnonzero(self.status < 0)

    def leave(self, rows: Array) -> None:
        """Mark rows as not solved; what was written into them in part is removed."""
        self.interrupted = True
        self.status[rows] = UNSOLVED
        for name in ("y", "y_end", "S", "S_end", "value", "stiff_since", "discontinuity", "accumulation"):
            getattr(self, name)[rows] = np.nan
        for i in rows.tolist():
            self.messages[i] = NOT_SOLVED

    def replace(self, rows: Array, other: Outcomes, attempt: int) -> None:
        """Put the outcomes of another attempt in the place of these rows if it did not fail."""
        better = np.flatnonzero(other.status >= 0)
        if not better.size:
            return
        places = rows[better]
        for name in ROWS:
            getattr(self, name)[places] = getattr(other, name)[better]
        self.attempt[places] = attempt
        for i in places.tolist():
            self.messages.pop(i, None)
        if self.error is not None and self.error[0] not in self.messages:  # the next one is of the other attempt
            self.error = None if other.error is None else (int(rows[other.error[0]]), other.error[1])
        for e, (old, new) in enumerate(zip(self.events, other.events, strict=True)):
            stays, comes = ~np.isin(old.trajectory, places), np.isin(new.trajectory, better)
            pairs = {name: (old[name][stays], new[name][comes]) for name in old}
            pairs["trajectory"] = pairs["trajectory"][0], rows[pairs["trajectory"][1]]
            self.events[e] = in_order(**{name: np.concatenate(pair) for name, pair in pairs.items()})


#: The arrays of `Outcomes` that every run fills.
ROWS = tuple(
    field.name
    for field in dataclasses.fields(Outcomes)
    if field.name not in ("messages", "events", "lanes", "error", "interrupted", "attempt")
)


def joined(parts: Sequence[Outcomes]) -> Outcomes:
    """Return the outcomes of parts of an ensemble, one after the other."""
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    whole = Outcomes(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in ROWS},
        messages={
            start + i: text for start, part in zip(starts, parts, strict=False) for i, text in part.messages.items()
        },
        events=[
            EnsembleEvents(
                np.concatenate([start + one.trajectory for start, one in zip(starts, these, strict=False)]),
                np.concatenate([one.t for one in these]),
                np.concatenate([one.y for one in these]),
            )
            for these in zip(*(part.events for part in parts), strict=True)
        ],
        lanes="; ".join(dict.fromkeys(part.lanes for part in parts)),
        error=next(
            ((start + one.error[0], one.error[1]) for start, one in zip(starts, parts, strict=False) if one.error), None
        ),
    )
    whole.interrupted = any(part.interrupted for part in parts)
    whole.attempt = np.concatenate([part.attempt for part in parts])
    return whole


def in_order(trajectory: Array, t: Array, y: Array) -> EnsembleEvents:
    """Return occurrences as trajectories ended, by trajectory; those of each one are in order."""
    order = np.argsort(trajectory, kind="stable")
    return EnsembleEvents(trajectory[order], t[order], y[order])


def picklable(error: BaseException | None) -> BaseException | None:
    """Return an exception that can be pickled, with its traceback, which cannot, as a note."""
    if error is None or error.__traceback__ is None:
        return error
    try:
        alike: BaseException = pickle.loads(pickle.dumps(error))
    except Exception:  # whatever the user's class does
        alike = RuntimeError(f"{type(error).__name__}: {error}")
    alike.add_note(f"In the process that solved the trajectory:\n{''.join(traceback.format_exception(error))}")
    return alike
