"""Why a trial of a fit has no value."""

from __future__ import annotations

from typing import NamedTuple


class Failed(NamedTuple):
    """What stands in place of the model's values."""

    reason: str
