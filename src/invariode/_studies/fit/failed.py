"""Reason why a trial of a fit has no value."""

from __future__ import annotations

from typing import NamedTuple


class Failed(NamedTuple):
    """Marker in the place of the model's values, with the reason of the failure."""

    reason: str
