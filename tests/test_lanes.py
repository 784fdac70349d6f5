"""Trajectories side by side have the bits of single solves, whatever the instructions, threads and neighbours."""

from __future__ import annotations

import math
from collections import OrderedDict

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, SERIES, dealt
from invariode import _core
from invariode._functions import lanes
from invariode._functions.graph import objects
from problems import PROBLEMS

numba = pytest.importorskip("numba")

#: Trajectories that fail belong to many of these laws; that a warning says so is in tests/test_failures.py.
pytestmark = pytest.mark.filterwarnings("ignore::invariode.FailureWarning")  # failing trajectories are in the tests

SIZE = 60
SETS = [name for name, _ in _core.instruction_sets()]
PAIRS = [name for name, method in METHODS.items() if method.stages]
LANED = [*PAIRS, *SERIES]


def lotka_volterra(t, y, p):
    return p[0] * y[0] - y[0] * y[1], y[0] * y[1] - y[1]


def pendulum(t, y, p):
    return y[1], -math.sin(y[0]) - 0.1 * p[0] * y[1] + math.exp(-t)


def branching(t, y, out, p):
    force = -y[0] if y[0] > 0 else -p[0] * y[0]
    out[0] = y[1]
    out[1] = force


def undefined_beyond(t, y, p):
    return math.sqrt(2 * p[0] - t) - y[1], y[0]


def half_filled(t, y, out, p):
    out[0] = y[1]
    if p[0] < 2:
        out[1] = -y[0]


def oscillator(t, y, p):
    return y[1], -p[0] * y[0] ** 3


def energy(t, y, p):
    return 0.25 * p[0] * y[0] ** 4 + 0.5 * y[1] ** 2


def energy_slope(t, y, p):
    return p[0] * y[0] ** 3, y[1]


def energy_misread(t, y, p):
    """The equations keep it for p = 1 alone."""
    return 0.25 * y[0] ** 4 + 0.5 * y[1] ** 2


def slope_misread(t, y, p):
    return y[0] ** 3, y[1]


COMPILED = {
    "polynomials": iv.compile(lotka_volterra),
    "elementary functions": iv.compile(pendulum),
    "branches, in place": iv.compile(branching, inplace=True),
    "not filled for some": iv.compile(half_filled, inplace=True),
    "undefined for some": iv.compile(undefined_beyond),
    "quartic": iv.compile(oscillator),
}
FROM_GRAPH = iv.Invariants(iv.compile(energy), names="energy")
ENERGY = iv.Invariants(iv.compile(energy), iv.compile(energy_slope), names="energy")


@pytest.fixture(autouse=True)
def small_ensembles_too(monkeypatch):
    monkeypatch.setattr(lanes, "FEWEST", 0)


def rows():
    random = np.random.default_rng(3)
    return random.uniform(0.5, 3, (SIZE, 2)), random.uniform(0.5, 3, (SIZE, 1))


def solve(fun, method="ode45", **options):
    y0, p = rows()
    given = {"args": p, "workers": 1, "rtol": 1e-5, **options}
    return iv.solve_ensemble(fun, (0, 4), y0, method, **given)


def same(a, b):
    for name in ("y", "t_end", "y_end", "status", "value", "residual_before", "residual_after", "correction"):
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    for name in a.stats:
        np.testing.assert_array_equal(a.stats[name], b.stats[name], err_msg=name)
    assert a.messages == b.messages
    for one, other in zip(a.events, b.events, strict=True):
        for name in ("trajectory", "t", "y"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(
    ("instructions", "name"),
    [(SETS[0], name) for name in COMPILED if name != "quartic"] + [(one, "elementary functions") for one in SETS[1:]],
)
def test_results_depend_on_no_instructions_threads_or_neighbours(name, instructions, monkeypatch):
    monkeypatch.setattr(lanes, "FORCED", instructions)
    fun = COMPILED[name]
    alone = solve(fun, lanes=1)
    assert alone.stats.lanes == "one at a time: lanes=1"
    for workers in (1, 3):
        found = solve(fun, workers=workers)
        same(found, alone)
        assert instructions in found.stats.lanes
    y0, p = rows()
    some = slice(5, 22)
    part = iv.solve_ensemble(fun, (0, 4), y0[some], args=p[some], workers=1, rtol=1e-5)
    np.testing.assert_array_equal(part.y_end, alone.y_end[some])


@pytest.mark.parametrize("instructions", SETS)
@pytest.mark.parametrize("invariant", [ENERGY, FROM_GRAPH], ids=["its gradient given", "not given"])
def test_an_invariant_is_held_as_without_lanes(instructions, invariant, monkeypatch):
    monkeypatch.setattr(lanes, "FORCED", instructions)
    alone = solve(COMPILED["quartic"], lanes=1, invariants=invariant)
    assert alone.stats.lanes == "one at a time: lanes=1"
    for workers in (1, 3):
        found = solve(COMPILED["quartic"], workers=workers, invariants=invariant)
        same(found, alone)
        assert found.stats.lanes.endswith(f"lanes, {instructions}")
    assert (found.residual_after < 1e-9).all()


@dealt(12, method=LANED, invariants=[None, ENERGY], interpolation=["projected", "raw"])
def test_output_at_times_is_that_of_single_solves(method, invariants, interpolation):
    options = {"t_eval": [0, 0.1, 0.10001, 1, 2.5, 4], "invariants": invariants, "interpolation": interpolation}
    found = solve(COMPILED["quartic"], method, **options)
    assert "lanes, " in found.stats.lanes
    y0, p = rows()
    for i in range(0, SIZE, 11):
        about = {"args": tuple(p[i]), "rtol": 1e-5, **options}
        one = iv.solve_ivp(COMPILED["quartic"], (0, 4), y0[i], method, **about)
        np.testing.assert_array_equal(found.y[i], one.y)
        for count in ("steps", "nfev", "ng", "ngjac", "nfev_check", "projections"):
            assert found.stats[count][i] == one.stats[count]


FALLING = iv.Event(iv.compile(lambda t, y, p: y[0]), direction=-1)
THIRD = iv.Event(iv.compile(lambda t, y, p: y[1] - p[0]), terminal=3)


@pytest.mark.parametrize("method", PAIRS)
@pytest.mark.parametrize("invariants", [None, ENERGY])
def test_events_are_those_of_single_solves(method, invariants):
    options = {"events": [FALLING, THIRD], "t_eval": np.linspace(0, 9, 28), "invariants": invariants}
    y0, p = rows()
    found, alone = (
        iv.solve_ensemble(COMPILED["quartic"], (0, 9), y0, method, args=p, workers=2, **options, **how)
        for how in ({}, {"lanes": 1})
    )
    same(found, alone)
    assert "lanes, " in found.stats.lanes
    assert set(found.status) == {0, 1}
    for i in range(0, SIZE, 11):
        one = iv.solve_ivp(COMPILED["quartic"], (0, 9), y0[i], method, args=tuple(p[i]), **options)
        assert one.status == found.status[i]
        np.testing.assert_array_equal(found.y[i, :, : len(one.t)], one.y)
        for event, t, y in zip(found.events, one.t_events, one.y_events, strict=True):
            np.testing.assert_array_equal(event.t[event.trajectory == i], t)
            np.testing.assert_array_equal(event.y[event.trajectory == i], y.reshape(len(t), one.y.shape[0]))


@pytest.fixture(scope="module", params=["Henon-Heiles", "rigid body"])
def held(request):
    """A problem of the registry with the first of its invariants, compiled."""
    problem = PROBLEMS[request.param]
    f, g, jacobian = (numba.njit(one) for one in (problem.fun, problem.g, problem.jac))
    one = np.ndim(problem.g(0, np.array(problem.y0))) == 0
    first = iv.compile((lambda t, y: g(t, y)) if one else (lambda t, y: g(t, y)[0]))
    about = iv.Invariants(first, iv.compile(lambda t, y: jacobian(t, y)[0]), names="g")
    return iv.compile(lambda t, y: f(t, y)), about, problem.y0


@pytest.mark.parametrize("method", LANED)
def test_problems_keep_their_invariant_in_every_method(held, method):
    fun, invariant, y0 = held
    random = np.random.default_rng(len(method))
    y0 = np.array(y0) * random.uniform(0.97, 1.03, (40, len(y0)))
    options = {"invariants": invariant, "workers": 2, "rtol": random.choice([1e-4, 1e-6, 1e-9]), "atol": 1e-9}
    if random.random() < 0.5:
        options["t_eval"] = np.linspace(0, 3, 31)
    alone = iv.solve_ensemble(fun, (0, 3), y0, method, lanes=1, **options)
    found = iv.solve_ensemble(fun, (0, 3), y0, method, **options)
    same(found, alone)
    assert "lanes, " in found.stats.lanes


def test_a_function_that_f_does_not_keep_is_refused_in_lanes_too():
    wrong = iv.Invariants(iv.compile(energy_misread), iv.compile(slope_misread), names="energy")
    y0 = rows()[0]
    p = np.where(np.arange(SIZE) % 5 == 1, 1.0 + rows()[1][:, 0], 1.0)[:, None]
    options = {"args": p, "workers": 1, "invariants": wrong, "rtol": 1e-5}
    found = iv.solve_ensemble(COMPILED["quartic"], (0, 4), y0, **options)
    assert (found.failed == np.flatnonzero(p[:, 0] != 1)).all()
    assert f"{len(found.failed)} whose invariant asked" in found.stats.lanes
    same(found, iv.solve_ensemble(COMPILED["quartic"], (0, 4), y0, lanes=1, **options))


@pytest.mark.parametrize("method", LANED)
def test_every_method_gives_its_single_solves(method):
    found = solve(COMPILED["polynomials"], method, atol=[1e-8, 1e-5], first_step=0.01, max_step=0.5)
    assert "lanes" in found.stats.lanes
    y0, p = rows()
    for i in range(0, SIZE, 7):
        about = {"args": tuple(p[i]), "rtol": 1e-5, "atol": [1e-8, 1e-5], "first_step": 0.01, "max_step": 0.5}
        one = iv.solve_ivp(COMPILED["polynomials"], (0, 4), y0[i], method, keep="end", **about)
        np.testing.assert_array_equal(found.y_end[i], one.y[:, -1])
        for count in ("steps", "failed", "nfev"):
            assert found.stats[count][i] == one.stats[count]


@pytest.mark.parametrize("instructions", SETS)
@pytest.mark.parametrize("name", ["polynomials", "elementary functions", "undefined for some"])
def test_series_depend_on_no_instructions_neighbours_or_failures(name, instructions, monkeypatch):
    """Steps fail in some lanes, are of very different lengths, and some trajectories end where f does."""
    monkeypatch.setattr(lanes, "FORCED", instructions)
    options = {"method": "taylor", "rtol": 1e-9, "atol": 1e-11, "t_eval": np.linspace(0, 4, 7)}
    found, alone = (solve(COMPILED[name], workers=2, **options, **how) for how in ({}, {"lanes": 1}))
    same(found, alone)
    assert instructions in found.stats.lanes
    y0, p = rows()
    order = np.random.default_rng(5).permutation(SIZE)[:37]
    some = iv.solve_ensemble(COMPILED[name], (0, 4), y0[order], args=p[order], workers=1, **options)
    np.testing.assert_array_equal(some.y, found.y[order])
    if name == "undefined for some":
        assert 0 < len(found.failed) < SIZE
        assert f"{len(found.failed)} trajectories one at a time" in found.stats.lanes


def pulsed(t, y, p):
    return y[1], -y[0] + math.exp(-((200 * (t - p[0])) ** 2))


def test_attempts_that_fail_in_some_lanes_are_those_of_single_solves():
    """Pulses of f between two steps, each trajectory with its own."""
    fun, options = iv.compile(pulsed), {"method": "taylor", "rtol": 1e-9, "atol": 1e-9}
    found, alone = (solve(fun, **options, **how) for how in ({}, {"lanes": 1}))
    same(found, alone)
    assert 0 < np.count_nonzero(found.stats.failed) < SIZE
    assert found.stats.lanes.endswith("lanes, " + SETS[0])


def test_failures_are_told_as_without_lanes():
    found = solve(COMPILED["undefined for some"])
    assert 0 < (found.status < 0).sum() < SIZE
    assert f"{(found.status < 0).sum()} trajectories one at a time" in found.stats.lanes


def test_a_limit_of_steps_is_that_of_single_solves():
    found, alone = (solve(COMPILED["quartic"], max_steps=40, **how) for how in ({}, {"lanes": 1}))
    assert found.messages.keys() == alone.messages.keys()  # they tell the seconds
    found.messages = alone.messages
    same(found, alone)
    assert 0 < len(found.failed) < SIZE
    assert f"{len(found.failed)} that reached max_steps" in found.stats.lanes


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"method": "ode113"}, "explicit Runge-Kutta pair"),
        ({"method": "taylor", "events": iv.Event(iv.compile(lambda t, y, p: y[0]))}, "along Taylor polynomials"),
        ({"t_eval": [1.0, 2.0], "keep": "all"}, "recorded"),
        ({"events": iv.Event(iv.compile(lambda t, y, p: y[0] - p[0]), samples=9)}, "samples"),
        ({"limits": iv.Limits(time=100.0)}, "limited"),
        ({"nonnegative": True}, "bounds"),
        ({"invariants": [ENERGY, iv.Invariants(iv.compile(lambda t, y, p: y[0]), names="x")]}, "several invariants"),
        ({"invariants": ENERGY, "fsal": "evaluate"}, "evaluated again"),
    ],
)
def test_what_lanes_cannot_do_is_done_one_at_a_time(options, why):
    assert why in solve(COMPILED["quartic"], **options).stats.lanes


def test_branches_of_f_end_the_steps_of_series_one_at_a_time():
    assert "changes its branch" in solve(COMPILED["branches, in place"], "taylor").stats.lanes


def test_series_in_loops_are_solved_one_at_a_time():
    """Such series fill the vector registers with the members of one trajectory."""
    fun = iv.compile(lambda t, y, p: [-p[0] * sum(y[j] * y[i] / (j + 1) for j in range(30)) for i in range(30)])
    y0 = np.random.default_rng(2).uniform(0, 1, (5, 30))
    found = iv.solve_ensemble(fun, (0, 1), y0, "taylor", args=(0.1,), workers=1)
    assert "fills the vector registers" in found.stats.lanes


def growing(t, y, p):
    total = 0.0
    while total < p[0]:
        total += 0.25
    return total - y[0], y[0]


def array_made(t, y, p):
    return np.array([y[1], -p[0] * y[0]])


@pytest.mark.parametrize(("fun", "by"), [(growing, "auto"), (array_made, "numba")])
def test_functions_without_a_form_for_lanes_say_why(fun, by):
    found = solve(iv.compile(fun, by=by))
    assert found.stats.lanes.startswith("one at a time: ")
    assert "has no graph" in found.stats.lanes
    assert found.success.all()


def test_few_trajectories_are_not_worth_the_compiler(monkeypatch):
    monkeypatch.setattr(lanes, "FEWEST", 1000)
    assert "fewer than 1000" in solve(iv.compile(lotka_volterra)).stats.lanes
    monkeypatch.setattr(objects, "_kept", OrderedDict())
    assert "fewer trajectories than 4000" in solve(iv.compile(lotka_volterra), "taylor", rtol=1e-7).stats.lanes


@pytest.mark.parametrize("wrong", [2, True, "all", None])
def test_lanes_are_auto_or_one(wrong):
    with pytest.raises(ValueError, match='lanes must be "auto" or 1'):
        solve(COMPILED["polynomials"], lanes=wrong)
