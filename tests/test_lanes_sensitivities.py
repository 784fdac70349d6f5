"""Sensitivities side by side have the bits of single solves: y and S, their counts, failures and invariants."""

from __future__ import annotations

import math

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, SERIES, dealt
from invariode import _core
from invariode._functions import lanes

pytest.importorskip("numba")
pytestmark = pytest.mark.filterwarnings("ignore::invariode.FailureWarning")  # failing trajectories are in the tests

SIZE = 40
SETS = [name for name, _ in _core.instruction_sets()]
PAIRS = [name for name, method in METHODS.items() if method.stages]
COUNTS = ("steps", "failed", "nfev", "ng", "ngjac", "nfev_check", "projections")


def predators(t, y, a, b):
    return a * y[0] - y[0] * y[1], y[0] * y[1] - b * y[1]


def pendulum(t, y, a, b):
    return y[1], -a * math.sin(y[0]) - 0.1 * b * y[1] + math.exp(-t)


def undefined_beyond(t, y, a, b):
    return math.sqrt(2 * a - t) - y[1], b * y[0]


def first_integral(t, y, a, b):
    """Return the invariant of `predators`: its form depends on the parameters."""
    return y[0] - b * math.log(y[0]) + y[1] - a * math.log(y[1])


FUNCTIONS = {"polynomials": predators, "elementary functions": pendulum, "undefined for some": undefined_beyond}
COMPILED = {name: iv.compile(one) for name, one in FUNCTIONS.items()}
HELD = iv.Invariants(iv.compile(first_integral), names="first integral")
DEMANDED = iv.Invariants(iv.compile(first_integral), value=2.5, names="first integral")

SENSITIVITIES = {
    "all arguments": True,
    "one of them, and y0": iv.Sensitivities(args="b", y0=True),
    "initial values": "y0",
    "not in the error test": iv.Sensitivities(args=True, error_test=False),
    "scales given": iv.Sensitivities(args=True, y0=[1], scale={"a": 3.0}),
    "a start that depends on them": iv.Sensitivities(args=["a"], dy0dp=[[0.5], [-2.0]]),
}


@pytest.fixture(autouse=True)
def small_ensembles_too(monkeypatch):
    monkeypatch.setattr(lanes, "FEWEST", 0)


def rows(kind=""):
    random = np.random.default_rng(11)
    y0, p = random.uniform(0.5, 3, (SIZE, 2)), random.uniform(0.5, 3, (SIZE, 2))
    if kind == "zeros":
        y0[::5, 0] = 0
        p[::7, 1] = 0
    if kind == "demanded":
        x, y = y0[:, 0], 1.5 + y0[:, 1]
        y0[:, 1], p[:, 0] = y, (x - p[:, 1] * np.log(x) + y - 2.5) / np.log(y)
    return y0, p


def solve(name, method="ode45", kind="", **options):
    y0, p = rows(kind)
    given = {"args": p, "workers": 1, "rtol": 1e-5, "sensitivities": True, **options}
    return iv.solve_ensemble(COMPILED[name], (0, 4), y0, method, **given)


def same(a, b):
    for name in ("y", "t_end", "y_end", "status", "value", "residual_before", "residual_after", "correction"):
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    np.testing.assert_array_equal(a.sensitivities, b.sensitivities)
    for name in a.stats:
        np.testing.assert_array_equal(a.stats[name], b.stats[name], err_msg=name)
    assert a.messages == b.messages


def same_as_single(found, name, method, kind="", **options):
    """Some of the trajectories against `solve_ivp`."""
    y0, p = rows(kind)
    for i in [*range(0, SIZE, 9), *found.failed[:2]]:
        about = {"args": tuple(p[i]), "rtol": 1e-5, "sensitivities": True, **options}
        one = iv.solve_ivp(COMPILED[name], (0, 4), y0[i], method, **about)
        assert one.status == found.status[i]
        reached = slice(None) if "t_eval" in options else slice(-1, None)
        points = len(one.t[reached])
        y, S = (found.y, found.sensitivities) if one.success or "t_eval" in options else (found.y_end[..., None], None)
        np.testing.assert_array_equal(y[i][..., :points], one.y[..., reached])
        if S is not None:
            np.testing.assert_array_equal(S[i][..., :points], one.sensitivities[..., reached])
        for count in COUNTS:
            assert found.stats[count][i] == one.stats[count], count


@pytest.mark.parametrize("instructions", SETS)
@pytest.mark.parametrize("name", COMPILED)
def test_results_depend_on_no_instructions_threads_or_neighbours(name, instructions, monkeypatch):
    monkeypatch.setattr(lanes, "FORCED", instructions)
    alone = solve(name, lanes=1)
    assert alone.stats.lanes == "one at a time: lanes=1"
    for workers in (1, 3):
        found = solve(name, workers=workers)
        same(found, alone)
        assert f"lanes, {instructions}" in found.stats.lanes
    same_as_single(found, name, "ode45")
    assert (len(found.failed) > 0) == (name == "undefined for some")
    some, (y0, p) = slice(5, 22), rows()
    part = iv.solve_ensemble(COMPILED[name], (0, 4), y0[some], args=p[some], rtol=1e-5, sensitivities=True)
    np.testing.assert_array_equal(part.sensitivities, found.sensitivities[some])


@pytest.mark.parametrize("method", PAIRS)
@pytest.mark.parametrize("invariants", [None, HELD, DEMANDED], ids=["free", "held", "demanded"])
def test_every_method_gives_its_single_solves(method, invariants):
    options = {"invariants": invariants, "t_eval": [0, 0.1, 0.10001, 1, 2.5, 4], "sensitivities": [*"ab", "y0"]}
    kind = "demanded" if invariants is DEMANDED else ""
    found, alone = (solve("polynomials", method, kind, **options, **how) for how in ({}, {"lanes": 1}))
    assert "lanes, " in found.stats.lanes
    same(found, alone)
    same_as_single(found, "polynomials", method, kind, **options)


@dealt(12, wanted=SENSITIVITIES, method=["ode45", "dop853"], atol=[1e-6, [1e-8, 1e-5], 0.0], held=[False, True])
def test_every_selection_gives_its_single_solves(wanted, method, atol, held):
    """Tolerances follow from each trajectory's values, some of which are zero."""
    kind = "" if held else "zeros"
    options = {"sensitivities": SENSITIVITIES[wanted], "atol": atol, "invariants": HELD if held else None}
    found = solve("polynomials", method, kind, **options)
    assert "lanes, " in found.stats.lanes
    same_as_single(found, "polynomials", method, kind, **options)


@dealt(6, method=["ode23", "ode45", "dop853"], interpolation=["projected", "raw"], invariants=[None, HELD])
def test_relative_tolerances_of_components_and_limits(method, interpolation, invariants):
    options = {
        "rtol": [1e-5, 1e-4],
        "t_eval": np.linspace(0, 4, 9),
        "first_step": 0.01,
        "max_step": 0.5,
        "max_steps": 60,
        "interpolation": interpolation,
        "invariants": invariants,
    }
    found, alone = (solve("polynomials", method, **options, **how) for how in ({}, {"lanes": 1}))
    assert found.messages.keys() == alone.messages.keys()  # they tell the seconds
    found.messages = alone.messages
    same(found, alone)
    assert "lanes, " in found.stats.lanes


def test_sensitivities_count_in_the_error_test():
    """From where y is an equilibrium, S alone makes the steps shorter, in its own weights."""
    fun = iv.compile(lambda t, y, a: [a * y[0] * (1 - y[0])])
    a = np.linspace(1, 4, SIZE)[:, None]
    options = {"args": a, "rtol": 1e-6, "workers": 1}
    within, beside = (
        iv.solve_ensemble(fun, (0, 3), [1.0], sensitivities=iv.Sensitivities(y0=True, error_test=one), **options)
        for one in (True, False)
    )
    assert "lanes, " in within.stats.lanes
    assert "lanes, " in beside.stats.lanes
    assert (within.stats.steps > 2 * beside.stats.steps).all()
    np.testing.assert_allclose(within.sensitivities[:, 0, 0, 0], np.exp(-3 * a[:, 0]), atol=1e-6)


def test_the_tangent_is_held():
    """∇g S + g_p stays what it was, in every trajectory, where y alone on its manifold would leave it."""
    y0, p = rows()
    found = solve("polynomials", "ode45", invariants=HELD, sensitivities=["a", "b", "y0"], rtol=1e-3)
    (x, y), S, (a, b) = found.y_end.T, found.sensitivities[..., 0], p.T
    gradient = np.stack([1 - b / x, 1 - a / y], 1)
    start = np.stack([1 - b / y0[:, 0], 1 - a / y0[:, 1]], 1)
    found_rates = np.einsum("ri,rij->rj", gradient, S) + np.stack([-np.log(y), -np.log(x), 0 * x, 0 * x], 1)
    held_rates = np.concatenate([-np.log(y0[:, ::-1]), start], 1)
    np.testing.assert_allclose(found_rates, held_rates, rtol=1e-11, atol=1e-11)


SCARCE = iv.Event(iv.compile(lambda t, y, a, b: y[0] - 0.4), terminal=True)
BESIDE = {
    "an invariant": {"invariants": HELD},
    "a terminal event": {"events": SCARCE},
    "bounds": {"nonnegative": True},
    "breakpoints": {"breakpoints": [1.0, 2.5]},
}


@dealt(2 * len([*METHODS, *SERIES]), method=[*METHODS, *SERIES], beside=["nothing", *BESIDE], atol=[1e-6, 0.0])
def test_every_method_on_threads_gives_its_single_solves(method, beside, atol):
    """One trajectory at a time, without the interpreter."""
    options = {"sensitivities": ["a", "y0"], "t_eval": [0.7, 2.0, 4.0], "atol": atol, **BESIDE.get(beside, {})}
    found = solve("polynomials", method, workers=2, lanes=1, **options)
    assert found.stats.lanes == "one at a time: lanes=1"
    same_as_single(found, "polynomials", method, **options)


def test_algebraic_equations_are_solved_with_each_trajectory():
    fun = iv.compile(lambda t, y, a: [-a * y[0], y[0] ** 2 - y[1]])
    options = {"mass": np.diag([1.0, 0.0]), "sensitivities": ["a", "y0[0]"], "rtol": 1e-6, "atol": 0.0}
    y0, a = [[1.0, 1.0], [2.0, 3.9]], [[1.0], [2.0]]
    found = iv.solve_ensemble(fun, (0, 1), y0, "ode15s", args=a, workers=1, **options)
    assert "algebraic equations" in found.stats.lanes
    one = iv.solve_ivp(fun, (0, 1), y0[1], "ode15s", args=a[1], **options)
    np.testing.assert_array_equal(found.sensitivities[1, ..., 0], one.sensitivities[..., -1])


def precession(t, y, w, g):
    return -1j * (w * y[0] + g * y[1]), -1j * (g * y[0] - w * y[1])


@pytest.mark.parametrize("wanted", [True, ["g", "y0"]])
@pytest.mark.parametrize("method", ["ode45", "ode15s"])
def test_complex_states(wanted, method):
    fun, (y0, p) = iv.compile(precession), rows()
    y0 = y0 + 1j * y0[::-1]
    options = {"t_eval": [1.0, 2.0], "rtol": 1e-5, "sensitivities": wanted}
    found = iv.solve_ensemble(fun, (0, 2), y0, method, args=p, workers=1, **options)
    why = "explicit Runge-Kutta pair" if method == "ode15s" else "lanes, "
    assert (why if wanted is True else "must be analytic") in found.stats.lanes
    for i in (0, 21):
        one = iv.solve_ivp(fun, (0, 2), y0[i], method, args=tuple(p[i]), **options)
        np.testing.assert_array_equal(found.y[i], one.y)
        np.testing.assert_array_equal(found.sensitivities[i], one.sensitivities)


def branching(t, y, a, b):
    return y[1], -(a if y[0] > b else 2 * a) * y[0]


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # of f with branches
@pytest.mark.parametrize(
    ("fun", "options", "why"),
    [
        (branching, {}, "f has branches"),
        (predators, {"sensitivities": iv.Sensitivities("a", dy0dp=lambda a, b: [[a], [b]])}, "dy0dp is a function"),
        (predators, {"method": "taylor"}, "expanded in series"),
        (predators, {"events": iv.Event(iv.compile(lambda t, y, a, b: y[0] - a))}, "events and sensitivities"),
        (predators, {"nonnegative": True}, "bounds"),
        (predators, {"method": "ode15s"}, "explicit Runge-Kutta pair"),
    ],
)
def test_what_lanes_cannot_do_is_done_one_at_a_time(fun, options, why):
    y0, p = rows()
    code, given = iv.compile(fun), {"sensitivities": True, "method": "ode45", **options}
    found = iv.solve_ensemble(code, (0, 1), y0[:12], args=p[:12], rtol=1e-5, workers=1, **given)
    assert found.stats.lanes.startswith("one at a time: ")
    assert why in found.stats.lanes
    for i in (0, 11):
        one = iv.solve_ivp(code, (0, 1), y0[i], args=tuple(p[i]), rtol=1e-5, **given)
        np.testing.assert_array_equal(found.y_end[i], one.y[:, -1])
        np.testing.assert_array_equal(found.sensitivities[i, ..., 0], one.sensitivities[..., -1])


def test_functions_in_python_say_so():
    found = iv.solve_ensemble(predators, (0, 1), [[1.0, 2.0]], args=(1.0, 2.0), sensitivities="a", workers=1)
    assert found.stats.lanes == "one at a time: functions are in Python"
