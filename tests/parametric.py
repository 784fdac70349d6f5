"""Problems with parameters, and derivatives of their solutions: in closed form, or published."""

from __future__ import annotations

import numpy as np

TOLERANCES = {"rtol": 1e-8, "atol": 1e-10}


def spring(t, y, w, c):
    return [y[1], -w * w * y[0] + c]


def swinging(t, w, c):
    """The solution of `spring` from (1, 0)."""
    return np.array([(1 - c / w**2) * np.cos(w * t) + c / w**2, -(w - c / w) * np.sin(w * t)])


def of_swinging(t, w, c, h=1e-30):
    """Derivatives of the solution, of shape (n, k, n_t)."""
    columns = [swinging(t, w + 1j * h, c).imag / h, swinging(t, w, c + 1j * h).imag / h]
    return np.stack(columns, axis=1)


def lotka_volterra(t, y, p0, p1, p2, p3):
    return [p0 * y[0] - p1 * y[0] * y[1], -p2 * y[1] + p3 * y[0] * y[1]]


def kept(t, y, p0, p1, p2, p3):
    return p3 * y[0] - p2 * np.log(y[0]) + p1 * y[1] - p0 * np.log(y[1])


def robertson(t, y, k1, k2, k3):
    slow, fast = -k1 * y[0] + k2 * y[1] * y[2], k3 * y[1] ** 2
    return [slow, -slow - fast, fast]


RATES = (1.5, 1.0, 3.0, 1.0)
ROBERTSON = {"args": (0.04, 1e4, 3e7), "rtol": 1e-4, "atol": [1e-8, 1e-14, 1e-6]}


def decay(t, y, rate):
    return [-rate * y[0]]
