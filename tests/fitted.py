"""Models and data of the tests of fits."""

from __future__ import annotations

import numpy as np

import invariode as iv

T = np.linspace(0.2, 4, 12)


def line(t, y, slope):
    return [slope]


def decay(t, y, k, c):
    return [-k * y[0] + c]


def volterra(t, y, a, b, c, d):
    return [a * y[0] - b * y[0] * y[1], -c * y[1] + d * y[0] * y[1]]


def straight(**options):
    """y = y0 + slope t, linear in both."""
    return iv.Problem(line, (0, 5), [1.0], args=(0.5,), labels=["y"], **options)


def decaying(y0=2.0, args=(0.7, 0.1), tf=5.0):
    return iv.Problem(decay, (0, tf), [y0], args=args, labels=["x"])


def hunting():
    return iv.Problem(volterra, (0, 6), [1.0, 1.0], args=(1.5, 1.0, 3.0, 1.0), labels=["prey", "predators"])


def noisy(problem, t, sigma, seed=5):
    y = problem.solve("dop853", t_eval=t, rtol=1e-11, atol=1e-13).y
    return y + sigma * np.random.default_rng(seed).normal(size=y.shape)


LINE = {"y0[y]": iv.Parameter(0.0), "slope": iv.Parameter(1.0)}
LINE_DATA = noisy(straight(), T, 0.1)
