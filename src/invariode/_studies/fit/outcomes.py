"""Results that may not be there."""

from __future__ import annotations

from typing import NamedTuple


class Failed(NamedTuple):
    """Why the model has no value for a trial."""

    reason: str
