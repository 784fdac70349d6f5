"""The sensitivities of a solution, as data."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .._base.arguments import Array


class AtEvents(NamedTuple):
    """Sensitivities at the occurrences of each event."""

    before: list[Array]  # (occurrences, n, k)
    after: list[Array]  # after the action
    times: list[Array]  # ∂τ/∂p, (occurrences, k)

    def joined(self, then: AtEvents) -> AtEvents:
        """Return these sensitivities followed by those of the rest of a run."""
        return AtEvents(
            *([np.concatenate(pair) for pair in zip(a, b, strict=True)] for a, b in zip(self, then, strict=True))
        )


@dataclasses.dataclass
class SensitivityData:
    """S = ∂y/∂p of a solution."""

    names: list[str]  # the parameters
    values: Array  # (n, k, n_t): at the outputs
    end: Array  # (n, k): where the run ended
    events: AtEvents | None  # at events, if they were recorded

    def joined(self, then: SensitivityData, points: int) -> SensitivityData:
        """Return the first outputs, and those of the rest of the run."""
        events = None if self.events is None or then.events is None else self.events.joined(then.events)
        return SensitivityData(
            self.names, np.concatenate([self.values[:, :, :points], then.values], axis=2), then.end, events
        )


def states_and_sensitivities(Y: Array, n: int, k: int) -> tuple[Array, Array]:
    """Return y (n, n_t) and S (n, k, n_t) of columns Y ((1 + k) n, n_t); or those of one point."""
    parts = Y.reshape(1 + k, n, *Y.shape[1:])
    return parts[0], parts[1:].swapaxes(0, 1)


def named(names: Sequence[str], labels: Sequence[str]) -> list[str]:
    """Return the names of derivatives in tables, component by component."""
    return [f"d {label} / d {name}" for label in labels for name in names]
