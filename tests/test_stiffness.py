"""Explicit methods say when stability limits their steps, and only then."""

from __future__ import annotations

import warnings
from functools import cache
from math import comb

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, dealt
from invariode import scipy as classes
from problems import PROBLEMS

EXPLICIT = [name for name, method in METHODS.items() if "jac" not in method.options]


@iv.compile
def van_der_pol(t, y):
    return y[1], 1e3 * (1 - y[0] ** 2) * y[1] - y[0]


@iv.compile
def robertson(t, y):
    a, b, c = y
    return -0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, 3e7 * b * b


@iv.compile
def linear(t, y):
    return -1e3 * (y[0] - np.cos(t)), -y[1]


@iv.compile
def spiral(t, y):
    """The fast part has eigenvalues -300 ± 1000 i."""
    return -300 * y[0] + 1000 * y[1], -1000 * y[0] - 300 * y[1], -y[2]


STIFF = {
    "van der Pol": (van_der_pol, 20, [2.0, 0]),
    "Robertson": (robertson, 40, [1.0, 0, 0]),
    "linear": (linear, 10, [0.0, 1]),
    "spiral": (spiral, 10, [1.0, 0, 1]),
}


@dealt(8, method=EXPLICIT, name=STIFF, rtol=[1e-3, 1e-6])
def test_stiff_problems_are_called_stiff_by_explicit_methods(method, name, rtol):
    fun, tf, y0 = STIFF[name]
    with pytest.warns(iv.StiffnessWarning, match=f"{method}: since t = .* limited by stability.*try ode15s") as said:
        sol = iv.solve_ivp(fun, (0, tf), y0, method, rtol=rtol, atol=1e-3 * rtol, keep="end", nonnegative=False)
    assert len(said) == 1
    assert sol.success or name == "Robertson"  # at crude tolerances a negative concentration may explode
    assert 0 <= sol.stats.stiff_since < 0.2 * tf
    assert "limited by stability" in sol.message


@dealt(method=EXPLICIT, name=PROBLEMS)
@pytest.mark.filterwarnings("ignore:overflow")
def test_no_other_problem_is_called_stiff(method, name):
    """At crude and at tight tolerances, plain and projected."""
    problem = PROBLEMS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error", iv.StiffnessWarning)
        for project in (False, True):
            for rtol in (1e-2, 1e-4, 1e-7):
                if rtol < 1e-4 and METHODS[method].order < 5:
                    continue
                invariants = problem.invariants() if project else None
                sol = iv.solve_ivp(
                    problem.fun, problem.t_span, problem.y0, method, rtol=rtol, atol=1e-3 * rtol, invariants=invariants
                )
                assert sol.stats.stiff_since is None


def test_implicit_methods_say_nothing():
    fun, tf, y0 = STIFF["linear"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sol = iv.ode15s(fun, (0, tf), y0)
    assert sol.stats.stiff_since is None


@cache
def damped():
    """Damping grows from nothing to 2000 at t = 10."""
    return iv.compile(lambda t, y: (-1000 * (1 + np.tanh(t - 10)) * (y[0] - np.cos(t)) - np.sin(t), -y[1]))


@pytest.mark.parametrize("method", EXPLICIT)
def test_stiffness_that_begins_later_is_dated(method):
    with pytest.warns(iv.StiffnessWarning):
        sol = iv.solve_ivp(damped(), (0, 20), [1.0, 1], method, rtol=1e-6, atol=1e-9, keep="end")
    assert 2 < sol.stats.stiff_since < 11


def test_an_extension_remembers():
    fun, tf, y0 = STIFF["linear"]
    with pytest.warns(iv.StiffnessWarning):
        first = iv.ode45(fun, (0, tf), y0)
        both = first.extend(1.5 * tf)
    assert both.stats.stiff_since == first.stats.stiff_since


def radius(k: int, x: float) -> float:
    """Return the spectral radius of the companion matrix of ode113's formulas of order k (PECE, local extrapolation),
    for h λ = −x and equal steps."""
    gamma = [1.0]
    for m in range(1, k + 1):
        gamma.append(1 - sum(gamma[j] / (m + 1 - j) for j in range(m)))
    difference = [[(-1) ** j * comb(i, j) for j in range(k)] for i in range(k)]
    predictor, defect = np.array(gamma[:k]) @ difference, np.sum(difference, axis=0)
    companion = np.eye(k, k=-1)
    predicted = -x * predictor
    predicted[0] += 1
    companion[0] = predicted + gamma[k] * (-x * predicted + x * defect)
    return float(np.abs(np.linalg.eigvals(companion)).max())


#: As they stand in core/methods/adams.cpp.
ADAMS_LIMITS = (2.0, 2.4, 1.93, 1.41, 1.04, 0.77, 0.58, 0.44, 0.34, 0.26, 0.21, 0.16)


@pytest.mark.parametrize("k", range(1, 13))
def test_limits_of_the_adams_formulas_are_those_of_their_companion_matrices(k):
    """Order 12 is unstable, by 1 % in a step at most, from 0.06 on already."""
    limit = ADAMS_LIMITS[k - 1]
    assert radius(k, limit - 0.01) < (1 + 1e-9 if k < 12 else 1.0105)
    assert radius(k, limit + 0.02) > 1


@pytest.mark.parametrize("method", EXPLICIT)
def test_an_ensemble_says_it_once_and_tells_which(method):
    with pytest.warns(
        iv.StiffnessWarning, match="in 2 trajectories stability, not accuracy, limits most steps"
    ) as said:
        m = iv.solve_ensemble(
            lambda t, y, rate: [-rate * (y[0] - np.cos(t))],
            (0, 10),
            np.ones((3, 1)),
            method=method,
            args=np.array([[1e3], [1.0], [2e3]]),
            workers=1,
        )
    assert len(said) == 1
    assert m.stats.stiff.tolist() == [1, 0, 1]
    assert [one.stats.stiff_since is None for one in m] == [False, True, False]
    assert [0 <= since < 2 for since in m.stats.stiff_since] == [True, False, True]


@pytest.mark.parametrize("method", EXPLICIT)
def test_the_classes_for_scipy_say_it_once(method):
    solver = getattr(classes, method.upper())
    with pytest.warns(iv.StiffnessWarning, match="since t = .* limited by stability") as said:
        run = solver(lambda t, y: [-1e3 * (y[0] - np.cos(t))], 0, [1.0], 10)
        while run.status == "running":
            run.step()
    assert len(said) == 1
