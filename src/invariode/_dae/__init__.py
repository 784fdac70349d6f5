"""Differential-algebraic equations F(t, y, y', *args) = 0 of any index: analysis, reduction, consistent starts."""
