"""The methods that a campaign draws from, by what they take for f."""

from __future__ import annotations

import invariode as iv

__all__ = ["FIRST_ORDER", "GENERAL"]

#: For any f.
GENERAL = [name for name, one in iv.METHODS.items() if one.equations == "any"]

#: And for f with an expression graph.
FIRST_ORDER = [name for name, one in iv.METHODS.items() if one.equations != "second-order"]
