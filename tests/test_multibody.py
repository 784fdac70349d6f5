"""Mechanisms of the multibody benchmark library: they move as in minimal coordinates, wherever they start."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import invariode as iv
import multibody
from invariode import _core
from invariode._derivatives import Derivatives
from invariode.mechanics import MechanicalSystem

MECHANISMS = {  # how long they run, and how many tolerances they may be off: errors grow with the motion's own rates
    "spatial_slider_crank": (0.5, 20),
    "rattleback": (0.1, 20),
    "rolling_disc": (0.3, 20),
}


@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
@pytest.mark.parametrize("method", ["dop853", "ode113", "radau"])
@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms_move_as_in_minimal_coordinates(name, method, rtol):
    tf, allowed = MECHANISMS[name]
    mechanism = getattr(multibody, name)()
    sol = mechanism.problem(tf).solve(method, rtol=rtol, atol=rtol, keep="end")
    assert sol.success, sol.message
    reference = mechanism.reference(tf)
    assert np.abs(sol.y[: len(reference), -1] - reference).max() <= allowed * rtol


@pytest.mark.parametrize("rtol", [1e-4, 1e-7])
@pytest.mark.parametrize("method", ["radau", "auto"])
def test_the_stiff_governor_with_redundant_rows_moves_as_in_minimal_coordinates(method, rtol):
    """At its start other rows depend on the others than beside it: two are left out all the same."""
    governor = multibody.governor()
    with pytest.warns(UserWarning, match="redundant constraints are left out") as said:
        problem = governor.problem(0.02)
    assert str(said[0].message).count("constraint ") == 2
    sol = problem.solve(method, rtol=rtol, atol=rtol, keep="end")
    assert sol.success, sol.message
    assert np.abs(sol.y[:6, -1] - governor.reference(0.02, "Radau")).max() <= 100 * rtol


def test_bricards_loop_keeps_its_energy_and_its_sparse_factors():
    with pytest.warns(UserWarning, match="redundant constraints are left out: constraint"):
        problem = multibody.bricard().problem(0.2)
    sol = problem.solve("dop853", rtol=1e-8, atol=1e-8)
    assert sol.success, sol.message
    assert sol.drift().rows[-1].largest < 1e-6 if hasattr(sol.drift(), "rows") else True
    work = sol.stats.mechanics
    assert work["dense"] <= 0.01 * work["sparse"]
