"""Functions for the tests of tracing."""

from __future__ import annotations

import numpy as np

import invariode as iv

K = np.array([[1.0, 2.0], [3.0, -4.0]])


def lotka_volterra(t, z, a, b, c, d):
    x, y = z
    return [a * x - b * x * y, -c * y + d * x * y]


class hidden:  # noqa: N801 - a namespace
    value = 1.0


def ends(fun, args, **options):
    return iv.solve_ivp(fun, (0, 1), [1.0, 0.5], args=args, rtol=1e-7, atol=1e-9, **options).y[:, -1]
