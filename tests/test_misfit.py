"""A Jacobian that does not describe f leads to no wrong solution without a word: jumps, patterns, bands, `jac`."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

import invariode as iv
import stiff_ends
from cases import IMPLICIT, dealt
from stiff import PROBLEMS as STIFF

TOLERANCES = [1e-3, 1e-6, 1e-8]

#: Friction, in units of the stiffness. From y = 1 at rest the body slides with y = 1/4 + 3/4 cos t until t = π.
FRICTION, SPAN = 0.25, (0.0, 3.0)
EXACT = np.array([FRICTION + 0.75 * math.cos(3), -0.75 * math.sin(3)])


@pytest.fixture(params=IMPLICIT)
def method_code(request):
    return request.param


def friction(t, y):
    return [y[1], -y[0] - FRICTION * np.sign(y[1])]


def sliding(t, y):
    """Return f as long as the body moves."""
    return [y[1], -y[0] + FRICTION]


def sharp(t, y):
    """A smooth f that bends within 1e-10, with its exact Jacobian."""
    return [y[1], -y[0] - FRICTION * np.tanh(1e10 * y[1])]


def sharp_jacobian(t, y):
    return [[0, 1], [-1, -FRICTION * 1e10 / np.cosh(min(abs(1e10 * y[1]), 300.0)) ** 2]]


def error(sol, rtol):
    """In tolerances."""
    return np.abs(sol.y[:, -1] - EXACT).max() / rtol


@dealt(10, method_code=IMPLICIT, fun=[friction, sharp], rtol=TOLERANCES)
@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")
def test_a_start_on_a_jump_costs_no_accuracy(method_code, fun, rtol):
    """Increments of 1e-14 straddle the jump. The error is that of a smooth start, and what the first step adds, for
    which the jump is an error of a tolerance or some: 10 of them."""
    given = {"rtol": rtol, "atol": rtol}
    smooth = error(iv.solve_ivp(sliding, SPAN, [1.0, 0.0], method_code, **given), rtol)
    for jac in (None, sharp_jacobian) if fun is sharp else (None,):
        sol = iv.solve_ivp(fun, SPAN, [1.0, 0.0], method_code, jac=jac, **given)
        assert sol.success
        assert error(sol, rtol) <= 3 * smooth + 20


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")
def test_a_restart_on_a_jump_costs_no_accuracy(method_code):
    """An event stops the body for an instant, where friction turns around."""
    rtol = 1e-6
    rest = iv.Event(lambda t, y: y[1], direction=1, action=lambda t, y: [y[0], 0.0])
    sol = iv.solve_ivp(friction, (0.0, 6.0), [1.0, 0.0], method_code, events=rest, rtol=rtol, atol=rtol)
    assert sol.success
    exact = np.array([-FRICTION - 0.25 * math.cos(6 - math.pi), 0.25 * math.sin(6 - math.pi)])
    assert np.abs(sol.y[:, -1] - exact).max() <= 200 * rtol


# ----------------------------------------------------------------------------------------------------------------------
# Stiffness that fades


def fading(t, highest, width):
    """From that to 1e-3 around t = 20, by a factor of ten over about 2.3 widths."""
    return 10 ** (-3 + (math.log10(highest) + 3) / (1 + math.exp(min((t - 20) / width, 700))))


def damped(highest, width):
    return lambda t, y: [y[1], -y[0] - fading(t, highest, width) * y[1]]


def two_masses(t, y):
    force = fading(t, 1e6, 0.5) * (y[2] - y[3])
    return [y[2], y[3], -1.5 * y[0] + 0.5 * y[1] - force, 0.5 * y[0] - 1.5 * y[1] + force]


def follower(t, y):
    return [-10 * fading(t, 1e5, 0.4) * (y[0] - math.cos(t)), y[0] - y[1]]


FADING = {  # with a tolerance at which ode23s sees where the stiffness ends
    "slow": (damped(1e6, 2.0), [1.0, 0.0], 1e-5),
    "fast": (damped(1e5, 0.5), [1.0, 0.0], 1e-5),
    "two masses": (two_masses, [1.0, -0.5, 0.0, 0.0], 1e-5),
    "follower": (follower, [1.0, 0.0], 1e-3),
}


@functools.cache
def faded(what):
    """At t = 60, and the error of ode23s, which takes a Jacobian in each step."""
    fun, y0, rtol = FADING[what]
    exact = iv.solve_ivp(fun, (0, 60), y0, "radau", rtol=1e-10, atol=1e-11, max_step=0.05).y[:, -1]
    anew = iv.solve_ivp(fun, (0, 60), y0, "ode23s", rtol=rtol, atol=rtol).y[:, -1]
    return exact, np.abs(anew - exact).max()


@dealt(8, what=FADING, method=["ode15s", "ode23t", "ode23tb", "radau"])
def test_a_jacobian_from_stiffer_times_costs_no_accuracy(method, what):
    """Newton's updates are too small then to show what they leave. Errors are at most a few times those of a method of
    order 2 that always has the right Jacobian, or a few tolerances (without looks: up to 3e8 of them)."""
    fun, y0, rtol = FADING[what]
    exact, error_of_ode23s = faded(what)
    sol = iv.solve_ivp(fun, (0, 60), y0, method, rtol=rtol, atol=rtol)
    assert sol.success
    assert np.abs(sol.y[:, -1] - exact).max() <= 3 * error_of_ode23s + 10 * rtol


SMOOTH = [name for name, problem in STIFF.items() if problem.mass is None and len(problem.y0) < 100]


@pytest.mark.parametrize("method", ["ode15s", "ode23t", "ode23tb"])
def test_residuals_change_no_step_where_f_is_smooth(method):
    """With a mass matrix, be it the identity, residuals are not tested: the steps are those of the plain iteration."""
    for name in SMOOTH:
        p = STIFF[name]
        for rtol in (1e-2, 1e-3, 1e-5):
            given = {"args": p.args, "jac": p.jac, "rtol": rtol, "atol": rtol * p.scale, "keep": "end"}
            sol, plain = (
                iv.solve_ivp(p.fun, p.t_span, p.y0, method, **given, **mass)
                for mass in ({}, {"mass": np.eye(len(p.y0))})
            )
            for count in ("steps", "failed", "nfev", "nlu", "nsolve"):
                assert sol.stats[count] == plain.stats[count], (name, rtol)


# ----------------------------------------------------------------------------------------------------------------------
# Structures


def circle(t, y):
    return [y[1], -y[0]]


WRONG = {
    "jac_sparsity": ({"jac_sparsity": np.eye(2)}, r"jac_sparsity misses the entry \(1, 0\)"),
    "bands": ({"lband": 0, "uband": 0}, r"the bands of the Jacobian miss the entry \(1, 0\).*give jac=Banded\(1, 1\)"),
}


@dealt(10, method_code=IMPLICIT, what=WRONG, rtol=TOLERANCES)
def test_a_structure_that_misses_entries_is_named_and_costs_no_accuracy(method_code, what, rtol):
    """Columns that share a row would otherwise be differenced together."""
    structure, message = WRONG[what]
    given = {"rtol": rtol, "atol": rtol / 1000}
    with pytest.warns(UserWarning, match=message) as told:
        sol = iv.solve_ivp(circle, (0, 1), [1.0, 0.0], method_code, **structure, **given)
    assert len(told) == 1
    right = iv.solve_ivp(circle, (0, 1), [1.0, 0.0], method_code, **given)
    errors = [np.abs(one.y[:, -1] - [math.cos(1), -math.sin(1)]).max() / rtol for one in (sol, right)]
    assert sol.success
    assert errors[0] <= 5 * errors[1] + 10


def coupled(n):
    """Stiff reactions along a line, and one that acts from one end on the other."""

    def fun(t, y):
        dy = 1e3 * np.diff(y, prepend=0, append=0, n=2)
        dy[0] += 1e5 * y[-1]
        return dy

    return fun, np.linspace(1, 2, n)


@dealt(10, method_code=IMPLICIT, how=["pattern", "bands"], jac=["differences", "complex-step"])
def test_one_missing_entry_of_many_is_named(method_code, how, jac):
    n = 20
    fun, y0 = coupled(n)
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1
    structure = {"jac_sparsity": near} if how == "pattern" else {"lband": 1, "uband": 1}
    with pytest.warns(UserWarning, match=r"the entry \(0, 19\): .* component 0 of fun changes with y\[19\]"):
        sol = iv.solve_ivp(fun, (0, 1e-3), y0, method_code, rtol=1e-5, jac=jac, **structure)
    whole = iv.solve_ivp(fun, (0, 1e-3), y0, method_code, rtol=1e-5)
    np.testing.assert_allclose(sol.y[:, -1], whole.y[:, -1], rtol=1e-3)


def test_a_wrong_jac_is_named(method_code):
    """A sign is wrong. What is only rough, as the diagonal of a matrix in which it dominates, is nobody's business."""
    A = np.array([[-10.0, 3.0], [2.0, -10.0]])

    def solved(jac):
        return iv.solve_ivp(lambda t, y: A @ y, (0, 1), [1.0, 1.0], method_code, jac=jac)

    for wrong in (-A, lambda t, y: -A):
        with pytest.warns(UserWarning, match=r"jac does not fit fun at t = 0: .* component 0 of fun changes by 0"):
            solved(wrong)
    solved(np.diag(np.diag(A)))
    solved(lambda t, y: 1.5 * A)


def test_a_run_whose_pattern_has_grown_goes_on_from_a_file(method_code, tmp_path):
    fun, y0 = coupled(20)
    near = np.abs(np.subtract.outer(np.arange(20), np.arange(20))) <= 1
    for k, structure in enumerate(({"jac_sparsity": near}, {"lband": 1, "uband": 1})):
        problem = iv.Problem(fun, (0, 1e-2), y0, **structure)
        with pytest.warns(UserWarning, match="the entry"):
            part = problem.solve(method_code, max_steps=5)
        part.save(tmp_path / f"{k}.npz")
        with pytest.warns(UserWarning, match="the entry"):
            on, here = iv.load(tmp_path / f"{k}.npz", problem).extend(1e-2), part.extend(1e-2)
        np.testing.assert_array_equal(on.y, here.y)


# ----------------------------------------------------------------------------------------------------------------------
# What the tests cost


def test_evaluations_that_test_jacobians_are_counted_apart(method_code):
    """f is called nfev + nfev_check times, and the test takes one call where nothing is wrong."""
    calls = []

    def fun(t, y):
        calls.append(t)
        return [y[1], -y[0]]

    sol = iv.solve_ivp(fun, (0, 1), [1.0, 0.0], method_code, nonnegative=False)
    assert len(calls) == sol.nfev + sol.stats.nfev_check
    assert 1 <= sol.stats.nfev_check <= 1 + math.log2(sol.njev)


# ----------------------------------------------------------------------------------------------------------------------
# Iterates far away


@pytest.mark.parametrize("method", [name for name in IMPLICIT if iv.METHODS[name].mass == "any"])
def test_iterates_may_go_where_an_exponential_overflows(method, monkeypatch):
    """The transistor amplifier with math.exp as it is, which raises from 18 V on; its supply is 6 V."""
    monkeypatch.setattr(stiff_ends, "transistor", lambda v: stiff_ends.SATURATION * math.exp(v / stiff_ends.THERMAL))
    mass, y0 = stiff_ends.AMPLIFIER_MASS, stiff_ends.AMPLIFIER_START
    for rtol in (1e-2, 1e-3):
        sol = iv.solve_ivp(stiff_ends.amplifier, (0, 0.2), y0, method, mass=mass, rtol=rtol, atol=rtol, keep="end")
        assert sol.success


def diode(v, saturation):
    return saturation * (math.exp(v / 0.026) - 1)


def clipper(volts, resistance, capacity, saturation):
    """A diode between a node and the ground, behind a resistor: where it blocks, f is linear."""

    def f(t, y):
        return [((volts * math.sin(100 * math.pi * t) - y[0]) / resistance - diode(y[0], saturation)) / capacity]

    return f


def rectifier(t, y):
    """A diode charges a large capacitor, from a node with a small one."""
    current = diode(y[0] - y[1], 6.08e-15)
    return [((33.6 * math.sin(100 * math.pi * t) - y[0]) / 3.34 - current) / 4.63e-12, (current - y[1] / 1e4) / 1e-6]


def valve(stiffness):
    """Between two tanks; it opens and closes as the flow does."""

    def f(t, y):
        flow = stiffness * max(0.0, y[0] - y[1])
        return [math.cos(t) - flow, flow - y[1]]

    return f


def bouncing(t, y):
    """A ball on a stiff ground that damps."""
    depth = max(0.0, -y[0])
    return [y[1], max(0.0, 26675222.931563813 * depth**1.5 * (1 - 0.4634365502056113 * y[1])) - 9.81]


@pytest.mark.filterwarnings("ignore:.*fun looks discontinuous")  # where the valve closes it nearly is
@pytest.mark.parametrize("method", IMPLICIT)
def test_diodes_and_valves_open_and_close_within_a_step(method):
    """Where it starts, the prediction lies where the exponential is huge, and one update with the J of the blocked
    diode leads far away; that was taken for the solution, since the last iterations had converged at once. Where it
    blocks, J is much too large, and every update with it too small to show what is left. The sources end at 0."""
    slow = method == "ode23s"  # which takes many more steps
    circuits = [(73.6, 1.05, 5.82e-9, 7.3e-11), (32.0, 207.0, 3.15e-11, 2.92e-15), (68.3, 329.0, 3.72e-10, 9.58e-13)]
    for volts, *rest in circuits:
        for rtol in (1e-3, 1e-4, 1e-5)[: 1 if slow else 3]:
            sol = iv.solve_ivp(clipper(volts, *rest), (0, 0.04), [0.0], method, rtol=rtol, atol=1e-3 * rtol)
            assert sol.success
            assert -1.01 * volts <= sol.y.min() <= sol.y.max() < 1
            assert abs(sol.y[0, -1]) < 1000 * rtol * volts
    exact = iv.solve_ivp(rectifier, (0, 0.04), [0.0, 0.0], "ode15s", rtol=1e-8, atol=1e-10)
    for rtol in np.geomspace(3e-4, 3e-5, 9)[: 1 if slow else 9]:
        sol = iv.solve_ivp(rectifier, (0, 0.04), [0.0, 0.0], method, rtol=rtol, atol=1e-3 * rtol)
        assert np.abs(sol.y[:, -1] - exact.y[:, -1]).max() < 1000 * rtol * 33.6
    allowed = 1000 if slow else 200
    for stiffness, start in ((1e3, 1.0), (1e5, 1.0), (1e7, 0.0)):  # at 1e7 differences lead through the closed valve
        opening = valve(stiffness), (0, 10), [start, start]
        exact = iv.solve_ivp(*opening, "radau", rtol=1e-10, atol=1e-12, keep="end")
        for rtol in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)[: 2 if slow else 5]:
            for atol in (rtol, 1e-3 * rtol):
                sol = iv.solve_ivp(*opening, method, rtol=rtol, atol=atol, keep="end", max_steps=20000)
                assert sol.success, sol.message
                assert np.abs(sol.y[:, -1] - exact.y[:, -1]).max() < allowed * rtol
    parted = {"rtol": 1e-3, "atol": 1e-3, "breakpoints": [0.5, 1.7, 7.05]}
    whole = iv.solve_ivp(*opening, method, **parted)
    for steps in (5, 30, 45, 70):  # among them some after which Newton's iteration has to leave less than elsewhere
        part = iv.solve_ivp(*opening, method, **parted, max_steps=steps)
        if not part.success:
            np.testing.assert_array_equal(part.extend(10, max_steps=None).y, whole.y)
    sol = iv.solve_ivp(bouncing, (0, 1), [0.2, 0.0], method, rtol=1e-3, atol=1e-6)
    assert np.abs(sol.y[0]).max() < 0.21


@pytest.mark.parametrize("method", ["ode15s", "radau"])
def test_bands_of_an_f_that_mixes_everything_cost_as_many_evaluations_as_columns(method):
    """The search gives up after some evaluations, says which entry is missing, and columns are differenced one by one:
    at most n evaluations for each Jacobian, 60 for a search, and no arithmetic of order n³."""
    n, calls = 400, 0

    def f(t, y):
        nonlocal calls
        calls += 1
        slope = -2 * y
        slope[1:] += y[:-1]
        slope[:-1] += y[1:]
        return 50 * slope + 0.5 * y.mean()

    given = {"rtol": 1e-3, "atol": 1e-6}
    with pytest.warns(UserWarning, match="mixes nearly all components, so leave the bands out") as caught:
        sol = iv.solve_ivp(f, (0, 0.5), np.linspace(0, 1, n), method, lband=1, uband=1, **given)
    assert sol.success
    i, j = map(int, str(caught[0].message).split("entry (")[1].split(")")[0].split(","))
    assert abs(i - j) > 1
    stats = sol.stats
    assert calls <= stats.nfev + stats.nfev_check + (n + 60) * (stats.njev + 2)
    whole = iv.solve_ivp(f, (0, 0.5), np.linspace(0, 1, n), "ode15s", jac_sparsity=np.eye(n, k=0) != 2, **given)
    np.testing.assert_allclose(sol.y_end, whole.y_end, atol=1e-3)


def test_bands_with_a_far_entry_of_a_large_system():
    """A single entry outside the bands is found among 50,000 components, whose pairs an int cannot count."""
    n = 50_000

    def f(t, y):
        slope = -2 * y
        slope[1:] += y[:-1]
        slope[7] += y[-3]
        return slope

    with pytest.warns(UserWarning, match=r"miss the entry \(7, 49997\)"):
        sol = iv.solve_ivp(f, (0, 1e-3), np.ones(n), "ode15s", lband=1, uband=1, max_steps=3)
    assert sol.stats.steps == 3


def test_a_given_jacobian_that_fits_at_the_start_alone_is_named(method_code):
    """Robertson's, transposed: at the start, where half of the entries are 0, it does no harm."""

    def f(t, y):
        slow, fast = 0.04 * y[0] - 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
        return [-slow, slow - fast, fast]

    def jac(t, y):
        slow, fast = np.array([0.04, -1e4 * y[2], -1e4 * y[1]]), np.array([0.0, 6e7 * y[1], 0.0])
        return np.array([-slow, slow - fast, fast])

    given = {"rtol": 1e-6, "atol": 1e-10, "max_steps": 300}
    with pytest.warns(UserWarning, match="jac does not fit fun at t = "):
        iv.solve_ivp(f, (0, 4e6), [1, 0, 0], method_code, jac=lambda t, y: jac(t, y).T, **given)
    iv.solve_ivp(f, (0, 4e6), [1, 0, 0], method_code, jac=jac, **given)  # warnings are errors
