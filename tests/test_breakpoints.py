"""Breakpoints are reached exactly, seen from either side, and passed once; inputs from tables bring their own."""

from __future__ import annotations

import copy
import functools
import pickle

import numpy as np
import pytest
import scipy.integrate
from scipy.interpolate import CubicSpline

import invariode as iv
from cases import FAMILIES, METHODS, SERIES, dealt, explicit_and_implicit, families, families_and_series
from problems import PROBLEMS, slack

KEPLER = PROBLEMS["Kepler"]
TIGHT = {"rtol": 1e-8, "atol": 1e-10}

# Twenty square pulses in [0, 100], each of width 1e-3.
PULSES = 20
EDGES = np.sort(np.random.default_rng(18039).uniform(0, 100 - 1e-3, PULSES)[:, None] + [0, 1e-3], axis=0).ravel()
EDGES.sort()
AREA = 1e-3 * PULSES


#: Compiled once for all methods.
compiled = functools.cache(iv.compile)


def pulses(t, y):
    return [float(np.searchsorted(EDGES, t, side="right") % 2)]


def pulse_input():
    return iv.Input([0, *EDGES], [0, *np.tile([1.0, 0.0], PULSES)])


def assert_area(sol, area=AREA):
    """Each pulse is integrated exactly, but for roundoff."""
    assert sol.success
    assert abs(sol.y[0, -1] - area) < 1e-9


@dealt(method=FAMILIES, rtol=[1e-3, 1e-6])
def test_narrow_pulses_are_not_missed(method, rtol):
    sol = iv.solve_ivp(pulses, (0, 100), [0.0], method, breakpoints=EDGES, rtol=rtol)
    assert_area(sol)
    assert np.isin(EDGES, sol.t).all()  # to the bit
    assert (np.diff(sol.t) > 0).all()
    assert_area(iv.solve_ivp(pulses, (100, 0), [0.0], method, breakpoints=EDGES, rtol=rtol), -AREA)
    missed = iv.solve_ivp(pulses, (0, 100), [0.0], method, rtol=rtol)
    assert missed.y[0, -1] == 0  # which is what they are for


@explicit_and_implicit
def test_inputs_bring_their_breakpoints(method):
    problem = iv.Problem(lambda t, y, u: [u], (0, 100), [0.0], inputs=pulse_input())
    assert_area(problem.solve(method, rtol=1e-6))
    assert_area(problem.replace(t_span=(0, 50)).solve(method).extend(100))
    assert_area(pickle.loads(pickle.dumps(problem.inputs[0])) and problem.solve(method, t_eval=[1, 99, 100]))


@explicit_and_implicit
@pytest.mark.parametrize("jac", [False, True])
def test_native_functions_have_inputs_first_in_their_parameters(method, jac):
    """Compiled functions get the values that the Python functions get, to the last bit."""
    pytest.importorskip("numba")
    wind = iv.Input(np.linspace(0, 10, 7), np.random.default_rng(1).normal(size=(7, 2)), "linear")
    level = iv.Input([0, 3, 6], [1.0, 2.0, 0.5])

    def f(t, y, u, v, a):
        return [y[1] + u[0], -a * v * y[0] + u[1]]

    def slope(t, y, u, v, a):
        return [[0, 1], [-a * v, 0]]

    implicit = "jac" in iv.METHODS[method].options
    if jac and not implicit:
        return
    differences = "differences" if implicit else None  # native functions have complex steps by default
    about = {"inputs": [wind, level], "args": (3.0,), "jac": slope if jac else differences}
    python = iv.Problem(f, (0, 10), [1.0, 0.0], **about)
    native = python.replace(
        fun=compiled(blown),
        jac=compiled(slope_of_blown) if jac else differences,
    )
    np.testing.assert_array_equal(python.solve(method).y, native.solve(method).y)


def blown(t, y, p):
    return (y[1] + p[0], -p[3] * p[2] * y[0] + p[1])


def slope_of_blown(t, y, p):
    return (0.0, 1.0, -p[3] * p[2], 0.0)


@dealt(method=FAMILIES, backwards=[False, True])
def test_each_piece_sees_f_from_its_own_side(method, backwards):
    """No time outside of the piece in which the step is, and none that is a breakpoint."""
    points = [1.0, 1.5, 4.0]
    called = []

    def f(t, y):
        called.append(t)
        return [np.searchsorted(points, t) + np.sin(y[0])]

    span = (5.0, 0.0) if backwards else (0.0, 5.0)
    sol = iv.solve_ivp(f, span, [0.0], method, breakpoints=points, callback=lambda t, y: called.append(None), **TIGHT)
    assert sol.success
    calls, steps = np.array(called, dtype=float), np.flatnonzero([t is None for t in called])
    assert not np.isin(calls, points).any()
    for start, *inside in zip(sol.t, np.split(calls, steps), strict=True):
        times = np.array(inside).ravel()
        times = times[~np.isnan(times)]
        pieces = np.unique(np.searchsorted(points, times))
        assert len(pieces) <= 1 or start in points, (start, times)
    for point in points:  # the neighbours are what it sees instead
        assert np.isin(np.nextafter(point, [-9, 9]), calls).all()


@families
def test_order_is_not_lost_at_a_breakpoint(method):
    """y' = |t - 1| y: accurate to the tolerance in no more work than two runs, one for each side."""

    def f(t, y):
        return [abs(t - 1) * y[0]]

    sol = iv.solve_ivp(f, (0, 3), [1.0], method, breakpoints=[1.0], **TIGHT)
    np.testing.assert_allclose(sol.y[0, -1], np.exp(0.5 + 2), rtol=2e-6 * slack(method))
    parts = [iv.solve_ivp(f, span, [1.0], method, max_step=0.3, **TIGHT) for span in ((0, 1), (1, 3))]
    assert sol.nfev <= 1.2 * sum(part.nfev for part in parts) + 20


# ----------------------------------------------------------------------------------------------------------------------
# Actions


def dose(t, y):
    return y + 1


def decayed(*times):
    """At t = 4, from 1 at 0, with a dose of 1 at each of the times."""
    return np.exp(-4) + sum(np.exp(t - 4) for t in times)


@dealt(method=FAMILIES, at=[(1.0, 2.0, 3.0), (0.0,), (2.0, 2.0), (0.0, 4.0)])
@pytest.mark.filterwarnings("ignore:.* in breakpoints")  # of the part before the extension
def test_actions_are_taken_once_and_both_states_are_there(method, at):
    """At the start and at the end too; two at one time are two."""
    about = {"breakpoints": [(t, dose) for t in at], "dense_output": True, **TIGHT}
    sol = iv.solve_ivp(lambda t, y: -y, (0, 4), [1.0], method, **about)
    np.testing.assert_allclose(sol.y[0, -1], decayed(*at), rtol=1e-5)
    jumps = np.flatnonzero(np.diff(sol.t) == 0)
    np.testing.assert_array_equal(sol.t[jumps], np.unique(at))
    np.testing.assert_allclose(sol.y[0, jumps + 1] - sol.y[0, jumps], [at.count(t) for t in np.unique(at)], rtol=1e-15)
    np.testing.assert_array_equal(sol.sol(sol.t[jumps]), sol.y[:, jumps + 1])
    times = np.unique([*at, 0.5, 4.0])
    chosen = iv.solve_ivp(lambda t, y: -y, (0, 4), [1.0], method, t_eval=times, **about)
    np.testing.assert_array_equal(chosen.t, times)
    np.testing.assert_allclose(chosen.y, sol.sol(times), rtol=1e-6)
    two = iv.solve_ivp(lambda t, y: -y, (0, 2), [1.0], method, **about).extend(4)
    np.testing.assert_allclose(two.y[0, -1], decayed(*at), rtol=1e-5)
    assert (np.diff(two.t) == 0).sum() == len(jumps)


@explicit_and_implicit
@pytest.mark.parametrize("at", [(0.0,), (4.0,), (0.0, 0.0), (0.0, 4.0)])
def test_beyond_a_jump_at_its_end_a_continuous_solution_extends_the_step_beside_it(method, at, tmp_path):
    """In a file too."""
    about = {"breakpoints": [(t, dose) for t in at], "dense_output": True, **TIGHT}
    sol = iv.solve_ivp(decay, (0, 4), [1.0], method, **about)
    outside = sol.sol([-1e-3, 4 + 1e-3])[0]
    steps = iv.solve_ivp(decay, (0, 4), [1.0 + at.count(0.0)], method, dense_output=True, **TIGHT).sol
    np.testing.assert_allclose(outside, steps([-1e-3, 4 + 1e-3])[0], rtol=1e-5)
    sol.save(tmp_path / "a")
    t = np.linspace(-1, 5, 13)
    np.testing.assert_array_equal(iv.load(tmp_path / "a").sol(t), sol.sol(t))


def test_a_dict_has_actions_by_time(tmp_path):
    """A dict means the same as the list of its pairs, in runs and in files."""
    pairs = [(2.0, None), (1.0, dose)]
    by_time, listed = ({"breakpoints": given, **TIGHT} for given in (dict(pairs), pairs))
    sol, same = (iv.solve_ivp(decay, (0, 4), [1.0], **about) for about in (by_time, listed))
    np.testing.assert_allclose(sol.y[0, -1], decayed(1.0), rtol=1e-5)
    np.testing.assert_array_equal(sol.y, same.y)
    problem = iv.Problem(decay, (0, 4), [1.0])
    problem.solve(**by_time, max_steps=1).save(tmp_path / "a")
    went_on = iv.load(tmp_path / "a", problem, breakpoints=dict(pairs)).extend(4, max_steps=None)
    np.testing.assert_array_equal(went_on.y, same.y)
    with pytest.raises(TypeError, match=r"the action in breakpoints must be a function action\(t, y\), got 5"):
        iv.solve_ivp(decay, (0, 4), [1.0], breakpoints={1.0: 5})
    with pytest.raises(TypeError, match="a time in breakpoints must be a real number, got 'noon'"):
        iv.solve_ivp(decay, (0, 4), [1.0], breakpoints={"noon": dose})


def decay(t, y):
    return -y


@dealt(9, method=METHODS, how=["event", "callback", "limit"])
def test_what_ends_the_run_at_a_breakpoint_leaves_the_action_to_the_extension(method, how):
    """But a limit, which is checked once the breakpoint has been passed."""
    taken = []

    def act(t, y):
        taken.append(t)
        return y + 1

    ends = {
        "event": {"events": iv.Event(lambda t, y: t - 2, terminal=True)},
        "callback": {"callback": lambda t, y: t == 2},
        "limit": {"limits": iv.Limits(points=1000), "max_steps": 1, "max_step": 9, "first_step": 2},
    }[how]
    sol = iv.solve_ivp(lambda t, y: [0.0], (0, 4), [0.0], method, breakpoints=[(2.0, act)], t_eval=[1, 2, 3], **ends)
    assert (sol.t_end, len(taken)) == (2.0, how == "limit")
    assert sol.status == {"event": 1, "callback": 2, "limit": -3}[how]
    sol = sol.extend(4, **({"callback": None} if how == "callback" else {"max_steps": None}))
    assert taken == [2.0]
    np.testing.assert_array_equal(sol.t, [1, 2, 3])
    assert sol.y[0, 2] == 1


@families_and_series
def test_invariants_are_held_at_their_new_values(method):
    """A kick changes the energy; a demanded value has to be kept by the action."""

    def kick(t, y):
        return [*y[:2], *(1.05 * y[2:])]

    sol = iv.solve_ivp(
        KEPLER.fun, (0, 10), KEPLER.y0, method, invariants=KEPLER.invariants(), breakpoints=[(3.0, kick)], **TIGHT
    )
    assert sol.success
    assert np.abs(sol.residual).max() < 1e-9
    before, after = (KEPLER.g(0, sol.y[:, i])[0] for i in (0, -1))
    assert abs(after - before) > 1e-2

    def off(t, y):
        return [1.1 * y[0], *y[1:]]

    circle = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2 - 1, value=0)
    sol = iv.solve_ivp(
        lambda t, y: [-y[1], y[0]],
        (0, 3),
        [1.0, 0.0],
        method,
        invariants=circle,
        breakpoints=[(1.0, off)],
        on_failure="return",
    )
    assert sol.status == -2
    assert "After the action at t = 1" in sol.message


@families_and_series
def test_invariants_may_have_kinks_at_breakpoints(method):
    """y' = ramp'(t): y - ramp(t) is kept, and its derivative with respect to t jumps, without a false conviction."""

    def ramp(t):
        return max(t - 1, 0) ** 1 * 2 - max(t - 2, 0) * 5

    sol = iv.solve_ivp(
        lambda t, y: [2.0 * (t > 1) - 5.0 * (t > 2), y[0]],
        (0, 3),
        [0.0, 0.0],
        method,
        invariants=lambda t, y: y[0] - ramp(t),
        breakpoints=[1, 2],
        **TIGHT,
    )
    assert sol.status == 0
    assert np.abs(sol.residual).max() < 1e-12


def stiffness(t, k=1.7):
    return np.where(t < 1, 1.0, k)


def stiffened(t, y, k=1.7):
    """An oscillator whose spring becomes stiffer at t = 1."""
    return [y[1], -stiffness(t, k) * y[0]]


def energy(t, y, k=1.7):
    return y[1] ** 2 / 2 + stiffness(t, k) * y[0] ** 2 / 2


@dealt(method=[*FAMILIES, *SERIES], t_span=[(0, 2), (2, 0), (1, 0)], k=[1.7, 1.01])
def test_an_invariant_that_jumps_is_held_at_its_values_on_both_sides(method, t_span, k):
    """The energy jumps, y does not: held at its old value, it would take y to another orbit. Also where the run begins
    at the breakpoint."""
    given = {"breakpoints": [1.0], "args": (k,), "second_order": True, **TIGHT}
    free = iv.solve_ivp(stiffened, t_span, [1.0, 0.3], method, **given)
    sol = iv.solve_ivp(stiffened, t_span, [1.0, 0.3], method, invariants=energy, dense_output=True, **given)
    assert sol.success
    np.testing.assert_allclose(sol.y[:, -1], free.y[:, -1], rtol=0, atol=1e-5)
    assert np.abs(sol.residual).max() < 1e-12
    np.testing.assert_array_equal(*sol.y[:, sol.t == 1].T)  # both sides are in the output
    times = np.linspace(*t_span, 101)
    for side in (times < 1, times > 1):
        assert not side.any() or np.ptp(energy(times[side], sol.sol(times[side]), k)) < 1e-12
    assert np.abs(sol.impose().y - sol.y).max() < 1e-12


@dealt(method=["ode45", "ode15s"], how=["callback", "event"])
def test_an_invariant_jumps_where_an_extension_begins(method, how):
    """The run was stopped right at the breakpoint, before that was passed."""
    problem = iv.Problem(stiffened, (0, 2), [1.0, 0.3], args=(1.7,), invariants=energy)
    stop = {"callback": lambda t, y: t == 1} if how == "callback" else {}
    if how == "event":
        problem = problem.replace(events=iv.Event(lambda t, y, k: t - 1, terminal=True))
    sol = problem.solve(method, breakpoints=[1.0], **TIGHT, **stop)
    assert sol.t_end == 1
    sol = sol.extend(2, **({"callback": None} if stop else {}))
    assert sol.success
    free = iv.solve_ivp(stiffened, (0, 2), [1.0, 0.3], method, breakpoints=[1.0], args=(1.7,), **TIGHT)
    np.testing.assert_allclose(sol.y[:, -1], free.y[:, -1], rtol=0, atol=1e-5)
    assert np.abs(sol.residual).max() < 1e-12


@explicit_and_implicit
def test_a_function_that_only_falls_may_jump_at_breakpoints(method):
    """Behind the jump the energy, which is larger there, falls on."""
    problem = iv.Problem(lambda t, y: [y[1], -stiffness(t) * y[0] - 0.1 * y[1]], (0, 2), [1.0, 0.3])
    free = problem.solve(method, breakpoints=[1.0], **TIGHT)
    sol = problem.replace(invariants=iv.Dissipated(energy)).solve(method, breakpoints=[1.0], **TIGHT)
    np.testing.assert_array_equal(sol.y[:, -1], free.y[:, -1])


def test_a_demanded_value_that_an_invariant_leaves_in_a_jump_is_said_to_be_left():
    def circle(t, y):
        return y[0] ** 2 + y[1] ** 2 - (1 if t < 1 else 1.1)

    sol = iv.solve_ivp(
        lambda t, y: [-y[1], y[0]],
        (0, 2),
        [1.0, 0.0],
        invariants=iv.Invariants(circle, value=0),
        breakpoints=[1.0],
        on_failure="return",
    )
    assert sol.status == -2
    assert sol.t_end == 1
    assert "At the breakpoint t = 1 invariant circle jumps, and the solution violates it" in sol.message


@pytest.mark.parametrize("form", [lambda f: f, compiled])
def test_residuals_of_ensembles_are_those_of_each_piece(form):
    """Functions of t, whose last piece is not the first one; one that jumps; and a state after an action."""
    given = {"t_eval": [0, 0.5, 1, 1.5, 2], **TIGHT}
    start = [[1.0, 0.3], [0.5, 0.1]]
    rising = {"invariants": form(lambda t, y: y[0] - np.sin(t)), "breakpoints": [1.0]}
    jumping = {"invariants": form(lambda t, y: energy(t, y)), "breakpoints": [1.0]}
    kicked = {"invariants": form(lambda t, y: energy(t, y)), "breakpoints": {1.0: lambda t, y: 2 * y}}
    for fun, options in (
        (form(lambda t, y: [np.cos(t), -y[1]]), rising),
        (form(lambda t, y: stiffened(t, y)), jumping),
        (form(lambda t, y: stiffened(t, y)), kicked),
    ):
        many = iv.solve_ensemble(fun, (0, 2), start, workers=1, **given, **options)
        assert many.residual_after.max() < 1e-12
        for one, y0 in zip(many, start, strict=True):
            np.testing.assert_array_equal(one.y, iv.solve_ivp(fun, (0, 2), y0, **given, **options).y)
            if options is rising:
                assert np.abs(one.residual).max() < 1e-12
            else:
                with pytest.raises(ValueError, match="breakpoints that change the values of invariants"):
                    _ = one.residual


@explicit_and_implicit
def test_an_event_at_a_breakpoint_is_found_once(method):
    """Without an action the signs go on; f has a knee there."""
    sol = iv.solve_ivp(
        lambda t, y: [1.0 if t < 2 else 3.0], (0, 4), [0.0], method, events=[lambda t, y: t - 2, lambda t, y: y[0] - 2],
        breakpoints=[2.0],
    )  # fmt: skip
    assert [len(t) for t in sol.t_events] == [1, 1]
    np.testing.assert_allclose(np.ravel(sol.t_events), 2.0, rtol=1e-14)


@explicit_and_implicit
def test_an_event_and_a_dose_at_once(method):
    """First the event acts, then the dose."""
    double = iv.Event(lambda t, y: t - 2, action=lambda t, y: 2 * y)
    sol = iv.solve_ivp(lambda t, y: [1.0], (0, 3), [0.0], method, events=double, breakpoints=[(2.0, dose)])
    assert sol.y[0, -1] == pytest.approx(6)


@pytest.mark.parametrize("with_action", [False, True])
def test_algebraic_variables_jump_with_their_equations(with_action):
    """0 = z - u(t): z is u on each side, and both are in the output."""

    def f(t, y):
        return [y[1], y[1] - (1.0 if t < 2 else 5.0)]

    def act(t, y):
        return [y[0] + 1, y[1]]

    sol = iv.ode15s(
        f, (0, 4), [0.0, 1.0], mass=np.diag([1.0, 0.0]), breakpoints=[(2.0, act if with_action else None)], rtol=1e-8
    )
    assert sol.success
    i = np.flatnonzero(np.diff(sol.t) == 0)
    np.testing.assert_array_equal(sol.t[i], [2.0])
    np.testing.assert_allclose([sol.y[1, i], sol.y[1, i + 1]], [[1.0], [5.0]], rtol=1e-12)
    np.testing.assert_allclose(sol.y[0, -1], 2 + 10 + with_action, rtol=1e-7)


@explicit_and_implicit
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("native", [False, True])
def test_trajectories_of_an_ensemble(method, native, workers):
    pytest.importorskip("numba")
    f = compiled(switched) if native else switched
    act = compiled(add_one) if native else add_one
    about = {"breakpoints": [1.0, (2.0, act)], "t_eval": [0.5, 2.0, 3.0], **TIGHT}
    many = iv.solve_ensemble(f, (0, 3), [[1.0], [2.0], [3.0]], method, workers=workers, **about)
    for i, y0 in enumerate([1.0, 2.0, 3.0]):
        np.testing.assert_array_equal(many.y[i], iv.solve_ivp(f, (0, 3), [y0], method, **about).y)


def switched(t, y):
    return [-y[0] if t < 1.0 else y[0]]


def add_one(t, y):
    return [y[0] + 1.0]


@families_and_series
def test_pieces_may_be_as_narrow_as_they_like(method):
    points = [1.0, np.nextafter(1.0, 2), np.nextafter(1.0, 2) + 4e-16, 1 + 1e-12, 1 + 1e-12]
    sol = iv.solve_ivp(lambda t, y: [1.0], (0, 2), [0.0], method, breakpoints=points)
    assert sol.success
    assert sol.y[0, -1] == pytest.approx(2)


@explicit_and_implicit
def test_bare_ends_are_no_breakpoints(method):
    plain = iv.solve_ivp(KEPLER.fun, (0, 5), KEPLER.y0, method)
    far = iv.solve_ivp(KEPLER.fun, (0, 5), KEPLER.y0, method, breakpoints=[-1, 6, 1e300])
    np.testing.assert_array_equal(plain.y, far.y)
    assert plain.nfev == far.nfev


@explicit_and_implicit
def test_complex_states(method):
    sol = iv.solve_ivp(
        lambda t, y: 1j * y * (1 if t < 1 else 2),
        (0, 2),
        [1 + 0j],
        method,
        breakpoints=[(1, lambda t, y: 1j * y)],
        **TIGHT,
    )
    np.testing.assert_allclose(sol.y[:, -1], 1j * np.exp([3j]), atol=1e-5)


# ----------------------------------------------------------------------------------------------------------------------
# Inputs


@pytest.mark.parametrize("kind", ["previous", "linear", "cubic"])
@pytest.mark.parametrize("shape", [(6,), (6, 3)])
def test_an_input_is_the_function_of_its_table(kind, shape):
    rng = np.random.default_rng(3)
    t, values = np.sort(rng.uniform(0, 5, 6)), rng.normal(size=shape)
    u = iv.Input(t, values, kind)
    np.testing.assert_allclose(u(t), values, rtol=1e-13)
    x = rng.uniform(t[0], t[-1], 50)
    rows = values.reshape(6, -1)
    reference = {
        "previous": lambda: rows[np.searchsorted(t, x, side="right") - 1],
        "linear": lambda: np.stack([np.interp(x, t, column) for column in rows.T], axis=1),
        "cubic": lambda: CubicSpline(t, rows)(x),
    }[kind]()
    np.testing.assert_allclose(u(x), reference.reshape(50, *shape[1:]), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(u(float(x[0])), u(x)[0])
    np.testing.assert_array_equal(copy.deepcopy(u)(x), u(x))
    if kind == "previous":
        np.testing.assert_array_equal(u(np.nextafter(t[2], 0)), values[1])
        np.testing.assert_array_equal(u(t[-1] + 1e6), values[-1])


@dealt(method=FAMILIES, kind=["linear", "cubic"])
def test_a_measured_force(method, kind):
    """The area under a table, to the tolerance; of pairs, which are of order 2 and more, the broken line's exactly."""
    t = np.linspace(0, 4, 17)
    u = iv.Input(t, np.sin(t) + 0.3 * np.cos(7 * t), kind)
    sol = iv.Problem(lambda t, y, u: [u], (0, 4), [0.0], inputs=u).solve(method, **TIGHT)
    exact = scipy.integrate.trapezoid(u.values, t) if kind == "linear" else CubicSpline(t, u.values).integrate(0, 4)
    exactly = kind == "linear" and iv.METHODS[method].fixed_order
    np.testing.assert_allclose(sol.y[0, -1], exact, rtol=1e-12 if exactly else 1e-6)
    assert np.isin(t, sol.t).all()
    free = iv.Problem(lambda t, y, u: [u], (0, 4), [0.0], inputs=iv.Input(t, u.values, kind, breakpoints=False))
    assert not np.isin(t, free.solve(method).t).all()


WRONG = [
    (
        {"breakpoints": 3},
        TypeError,
        r"breakpoints must be a list of times or of pairs .* or a dict of actions by time, got 3",
    ),
    ({"breakpoints": ["soon"]}, TypeError, "a time in breakpoints must be a real number, got 'soon'"),
    ({"breakpoints": [np.inf]}, ValueError, "a time in breakpoints must be finite, got inf"),
    ({"breakpoints": [(1, 2, 3)]}, ValueError, r"must be times or pairs \(t, action\), got \(1, 2, 3\)"),
    ({"breakpoints": [(1, 2)]}, TypeError, r"the action in breakpoints must be a function action\(t, y\), got 2"),
    ({"breakpoints": [(0.5, lambda t, y: [np.nan])]}, ValueError, r"action in breakpoints returned NaN at t = 0\.5"),
    ({"breakpoints": [(0.5, lambda t, y: [1, 2])]}, ValueError, "the action at a breakpoint returned shape|expected"),
]


@dealt(method=METHODS, wrong=WRONG)
def test_wrong_breakpoints_are_refused(method, wrong):
    options, error, message = wrong
    with pytest.raises(error, match=message):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], method, **options)


WRONG_INPUTS = [
    (lambda: iv.Input([1, 1], [1, 2]), "times of an input must increase"),
    (lambda: iv.Input([1], [1], "linear"), "at least 2 finite numbers"),
    (lambda: iv.Input([1, 2], [1, 2, 3]), "one row for each of its 2 times"),
    (lambda: iv.Input([1, 2], [1, np.nan]), "values of an input must be finite"),
    (lambda: iv.Input([1, 2], [1, 2], "spline"), "kind must be one of 'previous', 'linear', 'cubic'"),
]


@pytest.mark.parametrize(("make", "message"), WRONG_INPUTS)
def test_wrong_inputs_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_problem_stays_in_the_table_of_its_inputs():
    u = iv.Input([0, 1, 2], [0, 1, 2], "linear")
    with pytest.raises(ValueError, match="leaves the table of Input"):
        iv.Problem(lambda t, y, u: [u], (0, 3), [0.0], inputs=u)
    sol = iv.Problem(lambda t, y, u: [u], (0, 1), [0.0], inputs=u).solve()
    with pytest.raises(ValueError, match="leaves the table of Input"):
        sol.extend(3)
    with pytest.raises(TypeError, match=r"inputs must be an invariode\.Input or a list"):
        iv.Problem(lambda t, y, u: [u], (0, 3), [0.0], inputs=[3])


def test_classes_for_scipy_say_what_they_cannot():
    import invariode.scipy

    with pytest.raises(TypeError, match="breakpoints is an option of solve_ivp, not of ODE45"):
        invariode.scipy.ODE45(lambda t, y: -y, 0, [1.0], 1, breakpoints=[0.5])


@dealt(method=FAMILIES, t0=[0.0, 1.0, -3.0])
def test_breakpoints_between_which_no_step_fits_are_one(method, t0):
    """Two near the start, three near t0 + 1: each action is taken, each jump seen, and no step is shorter than the
    smallest. f is called on neither side with a time between them."""
    near, later = 4 * abs(np.spacing(t0)), t0 + 1
    ulp = abs(np.spacing(later))
    points = [t0 + near / 2, t0 + near, later, later + 3 * ulp, later + 6 * ulp]
    taken, called = [], []

    def action(t, y):
        taken.append(t)
        return y + 1

    def f(t, y):
        called.append(t)
        return [float(np.searchsorted(points, t))]

    sol = iv.solve_ivp(f, (t0, t0 + 2), [0.0], method, breakpoints=[(t, action) for t in points])
    assert sol.success
    assert len(taken) == 5
    assert np.count_nonzero(np.diff(sol.t) == 0) == 2  # both sides of the two jumps
    assert np.diff(np.unique(sol.t)).min() >= 16 * abs(np.spacing(t0))
    assert not any(points[0] <= t <= points[1] or points[2] <= t <= points[4] for t in called)
    np.testing.assert_allclose(sol.y[0, -1], 5 + 2 + 5, rtol=1e-9)


@families_and_series
def test_a_breakpoint_at_the_smallest_double_is_passed(method):
    """The step to it would be so short that h times a coefficient is 0."""
    tiny = 5e-324
    for about in ({"breakpoints": [tiny]}, {"inputs": iv.Input([0.0, tiny, 1.0], [0.0, 0.0, 0.0])}):
        with_input = "inputs" in about
        problem = iv.Problem(
            (lambda t, y, u: [y[1], -y[0] + u]) if with_input else (lambda t, y: [y[1], -y[0]]),
            (0, 1),
            [1.0, 0.0],
            **({"inputs": about["inputs"]} if with_input else {}),
        )
        sol = problem.solve(method, breakpoints=about.get("breakpoints"))
        np.testing.assert_allclose(sol.y[:, -1], [np.cos(1), -np.sin(1)], rtol=1e-2)


def test_an_iterator_of_breakpoints_is_refused_at_every_way_in():
    """A second run, or row, would have none."""
    problem = iv.Problem(lambda t, y: -y, (0, 1), [1.0])
    ways = [
        problem.solve,
        problem.prepare,
        lambda breakpoints: problem.solve_ensemble([[1.0], [2.0]], workers=1, breakpoints=breakpoints),
    ]
    for way in ways:
        with pytest.raises(TypeError, match=r"breakpoints are read more than once.*give list\(breakpoints\)"):
            way(breakpoints=iter([0.3, 0.6]))


# ----------------------------------------------------------------------------------------------------------------------
# Of a problem


def elimination(t, y, k):
    return [-k * y[0]]


def bolus(t, y, k):
    return y + 10 * k


#: The second before the first, since runs take them in order.
DOSES = [(2.5, bolus), (1.0, bolus), 3.0]


def with_and_without():
    plain = iv.Problem(elimination, (0, 4), [1.0], args=(0.5,))
    return plain.replace(breakpoints=DOSES), plain


def assert_same(a, b):
    np.testing.assert_array_equal(a.t, b.t)
    np.testing.assert_array_equal(a.y, b.y)


@families_and_series
@pytest.mark.filterwarnings("ignore:.* in breakpoints")  # of the part before the extension
def test_breakpoints_of_a_problem_are_those_of_each_run(method, tmp_path):
    """Whatever is done with the problem, its bits are those of the run that is given the breakpoints as an option."""
    problem, plain = with_and_without()
    assert [point.t for point in problem.breakpoints] == [2.5, 1.0, 3.0]
    expected = plain.solve(method, breakpoints=DOSES)
    assert_same(problem.solve(method), expected)
    assert_same(plain.replace(breakpoints=DOSES[:1]).solve(method, breakpoints=DOSES[1:]), expected)
    assert_same(problem.replace(breakpoints=None).solve(method), plain.solve(method))
    short = problem.replace(t_span=(0, 2)).solve(method)
    whole = plain.replace(t_span=(0, 2)).solve(method, breakpoints=DOSES).extend(4)
    assert_same(short.extend(4), whole)
    short.save(tmp_path / "run.npz")
    assert_same(iv.load(tmp_path / "run.npz", problem).extend(4), whole)
    prepared = problem.prepare(method)
    for changes in ({"args": (0.7,)}, {"t_span": (0, 3)}, {"y0": [2.0]}):
        assert_same(prepared(**changes), plain.replace(**changes).solve(method, breakpoints=DOSES))
    many = problem.solve_ensemble([[1.0], [2.0]], method, workers=1)
    same = plain.solve_ensemble([[1.0], [2.0]], method, workers=1, breakpoints=DOSES)
    np.testing.assert_array_equal(many.y_end, same.y_end)


@explicit_and_implicit
def test_derivatives_know_the_breakpoints_of_a_problem(method):
    """S and the gradient are those of the solution in closed form, to 100 tolerances."""
    problem, plain = with_and_without()
    k, rtol = 0.5, 1e-8

    def end(k):
        return np.exp(-4 * k) + 10 * k * (np.exp(-3 * k) + np.exp(-1.5 * k))

    h = 1e-6
    exact = (end(k + h) - end(k - h)) / (2 * h)
    options = {"rtol": rtol, "atol": rtol}
    forward = problem.replace(sensitivities=["k"]).solve(method, **options)
    given = plain.replace(sensitivities=["k"]).solve(method, breakpoints=DOSES, **options)
    np.testing.assert_array_equal(forward.sensitivities, given.sensitivities)
    backward = problem.solve(method, dense_output=True, **options).gradient([1.0], wrt=["k"])
    np.testing.assert_allclose([forward.sensitivities[0, 0, -1], backward[0]], exact, rtol=100 * rtol)


def test_a_fit_has_the_doses_of_its_problem():
    problem, _ = with_and_without()
    times = np.array([0.5, 1.5, 2.0, 3.5])
    data = problem.replace(args=(0.8,)).solve("dop853", t_eval=times, rtol=1e-10, atol=1e-12).y[0]
    found = iv.fit(problem, times, data, {"k": (0, 2)}, method="dop853")
    assert abs(found.parameters["k"] - 0.8) < 1e-6


def test_a_steady_state_has_no_doses():
    problem = iv.Problem(lambda t, y: [1 - y[0]], (0, 1), [0.0], breakpoints=[(0.5, lambda t, y: y + 1)])
    np.testing.assert_allclose(iv.steady_state(problem).y, [1.0], rtol=1e-9)


@pytest.mark.filterwarnings("ignore:.* in breakpoints")  # of the part before the extension
def test_native_breakpoints_of_a_problem_are_not_lost_on_another_interval():
    fun, action = compiled(elimination), compiled(bolus)
    plain = iv.Problem(fun, (0, 4), [1.0], args=(0.5,))
    prepared = plain.replace(breakpoints={1.0: action}).prepare("ode45", keep="end")
    for span in ((0, 0.5), (0, 4)):
        expected = plain.replace(t_span=span).solve("ode45", breakpoints={1.0: action}, keep="end")
        assert_same(prepared(t_span=span), expected)


def larger_bolus(t, y, k):
    return y + 11 * k


def test_a_file_belongs_to_the_breakpoints_of_its_problem(tmp_path):
    problem, plain = with_and_without()
    file = tmp_path / "run.npz"
    problem.solve().save(file)
    with pytest.raises(ValueError, match="another problem: breakpoints"):
        iv.load(file, plain)
    with pytest.raises(ValueError, match=r"the code of the action at t = 2\.5"):
        iv.load(file, problem.replace(breakpoints=[(2.5, larger_bolus), (1.0, bolus), 3.0]))
    plain.solve().save(file)
    with pytest.raises(ValueError, match="another problem: breakpoints"):
        iv.load(file, problem)


def test_breakpoints_of_a_problem_are_checked_at_once_and_kept():
    times = [1.0, 2.0]
    problem = iv.Problem(elimination, (0, 4), [1.0], args=(0.5,), breakpoints=times)
    times[0] = 3.0
    assert [point.t for point in problem.breakpoints] == [1.0, 2.0]
    assert_same(pickle.loads(pickle.dumps(problem)).solve(), problem.solve())
    with pytest.raises(ValueError, match="a time in breakpoints must not be NaN"):
        problem.replace(breakpoints=[np.nan])


def test_actions_outside_the_interval_are_named():
    """A problem that is solved over another interval, and plain times, have no warning."""

    def dose(t, y):
        return y + 1

    def solve(points):
        return iv.solve_ivp(lambda t, y: -y, (0, 10), [1.0], breakpoints=points)

    with pytest.warns(UserWarning, match=r"The action in breakpoints at t = 12 is outside t_span = \(0.0, 10.0\)"):
        solve({5: dose, 12: dose})
    with pytest.warns(UserWarning, match="2 actions in breakpoints, the first at t = 11, are outside"):
        problem = iv.Problem(lambda t, y: -y, (0, 10), [1.0], breakpoints=[(11, dose), (12, dose)])
    problem.replace(name="again").solve()
    solve([10, 12]), solve([(0, dose), (10, dose)])
