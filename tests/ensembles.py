"""When two ensembles have the same results, for the tests of each way to solve one."""

from __future__ import annotations

import numpy as np

import invariode as iv


def same(a: iv.EnsembleSolution, b: iv.EnsembleSolution) -> None:
    for name in a.keys():  # noqa: SIM118 - a loop over it goes over trajectories
        if name in ("messages", "events", "stats"):
            continue
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    assert a.messages == b.messages
    for name in a.stats:
        np.testing.assert_array_equal(a.stats[name], b.stats[name], err_msg=name)
    for one, other in zip(a.events, b.events, strict=True):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)
