"""Constant delays: known solutions by all methods, at steps and between; marks; steps longer than a delay; the past."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, explicit_and_implicit

TAKE_DELAYS = [name for name, about in iv.METHODS.items() if about.delays]
LOW_ORDER = [name for name in TAKE_DELAYS if METHODS[name].order < 4]

take_delays = pytest.mark.parametrize("method", TAKE_DELAYS)

#: Of the errors of a run, in units of its tolerance: those of steps are not controlled beyond their sum.
MOST_TOLERANCES = 100


def decay(t, y, z):
    return -z[0]


def series(t):
    """y' = -y(t - 1), y = 1 before 0, by the method of steps."""
    return sum((-1) ** k * (t - k + 1) ** k / math.factorial(k) for k in range(int(t) + 2))


def ddex1(t, y, z):
    return [z[0, 0], z[0, 0] + z[1, 1], y[1]]


def infection(t, y, z):
    return [-y[0] * z[0, 1] + z[1, 1], y[0] * z[0, 1] - y[1], y[1] - z[1, 1]]


def lemmings(t, y, z):
    return 3.5 * y * (1 - z[0] / 19)


def rotation(t, y, z):
    return [z[0, 0] * z[1, 1], -y[0] * z[1, 1]]


def mackey_glass(t, y, z):
    return 0.25 * z[0] / (1 + z[0] ** 10) - 0.1 * y


def population(t, y, z):
    return [0.25 * y[0] * (1 - y[0] / 200) - 0.01 * y[0] * y[1], -y[1] + 0.01 * z[0, 0] * z[0, 1]]


def by_name(t, y, z, gain, tau):
    return -gain * z[0]


#: f, tf, y0, history, delays, y(tf): the example of dde23 (exact), Hairer, Norsett & Wanner's infection model, lemmings
#: with y0 off the history, exercises of dde23's tutorial, a Mackey-Glass equation and a sine. The values that are not
#: exact are those on which dop853 at 1e-13 and radau at 1e-11 agree to at least nine digits.
KNOWN = {
    "ddex1": (ddex1, 5, [1, 1, 1], [1, 1, 1], [1, 0.2], [19.175, 176.42257844738, 190.34420193607]),
    "infection": (
        infection,
        40,
        [5, 0.1, 1],
        [5, 0.1, 1],
        [1, 10],
        [0.091249120566351, 0.0202995003351, 5.9884513790986],
    ),
    "lemmings": (lemmings, 10, [19.001], 19, 0.74, [18.940223280]),
    "rotation": (
        rotation,
        4,
        [0, 0],
        lambda t: [math.cos(t), math.sin(t)],
        [1, 2],
        [-0.22051597384548, -1.0184976868473],
    ),
    "Mackey-Glass": (mackey_glass, 100, [1], 1, 15, [1.2640841980157]),
    "sine": (decay, 2.5 * math.pi, [0], math.sin, math.pi / 2, [1]),
    "population": (population, 10, [80, 30], [80, 30], 1, None),
}


@take_delays
def test_known_solutions_are_met_within_tolerances(method):
    rtol = 1e-6 if method in LOW_ORDER else 1e-8
    for name, (f, tf, y0, history, delays, end) in KNOWN.items():
        options = {"delays": delays, "history": history, "atol": 1e-3 * rtol}
        sol = iv.solve_ivp(f, (0, tf), y0, method, rtol=rtol, **options)
        if end is None:
            end = iv.solve_ivp(f, (0, tf), y0, "dop853", rtol=1e-12, **options).y[:, -1]
        assert sol.success, name
        np.testing.assert_allclose(sol.y[:, -1], end, rtol=MOST_TOLERANCES * rtol, err_msg=name)


@take_delays
def test_values_between_steps_are_as_accurate(method):
    rtol = 1e-6 if method in LOW_ORDER else 1e-8
    sol = iv.solve_ivp(decay, (0, 8), [1.0], method, delays=1, history=1, rtol=rtol, atol=rtol, dense_output=True)
    t = np.linspace(0, 8, 333)
    assert np.abs(sol.sol(t)[0] - [series(s) for s in t]).max() < MOST_TOLERANCES * rtol


@take_delays
def test_steps_end_where_derivatives_jump_up_to_the_order(method):
    """Sums of delays are ends of steps to roundoff, as far as the method can notice a jump there."""
    sol = iv.solve_ivp(ddex1, (0, 3), [1, 1, 1], method, delays=[1.0, 0.3], history=[1, 1, 1], rtol=1e-5)
    for i in range(3):
        for j in range(7):
            if 0 < i + 0.3 * j < 3 and i + j <= iv.METHODS[method].order:
                assert np.abs(sol.t - (i + 0.3 * j)).min() < 1e-13


def test_delays_that_rounding_tells_apart_are_landed_on_once():
    """0.1 + 0.2 is not 0.3 in floating point; no step lies between."""
    sol = iv.solve_ivp(lambda t, y, z: -z.sum(axis=0), (0, 2), [1.0], "ode45", delays=[0.1, 0.2, 0.3], history=1)
    assert np.diff(sol.t).min() > 1e-6


def test_history_may_jump_and_be_a_function_or_a_solution():
    def steps(t):
        return (-1.0) ** np.floor(-5 * t)

    jumps = [-1, -0.8, -0.6, -0.4, -0.2]
    sol = iv.solve_ivp(lambda t, y, z: z[0], (0, 1), None, "ode45", delays=1, history=steps, breakpoints=jumps)
    assert abs(sol.y[0, -1] - 1.2) < 1e-13  # piecewise linear: exact but for roundoff
    first = iv.solve_ivp(decay, (0, 3), [1.0], "dop853", delays=1, history=1, rtol=1e-10, dense_output=True)
    then = iv.solve_ivp(decay, (3, 5), None, "dop853", delays=1, history=first, rtol=1e-10)
    assert abs(then.y[0, -1] - series(5)) < 1e-9
    args = iv.solve_ivp(
        by_name, (0, 5), [1.0], "dop853", delays="tau", args=(1.0, 1.0), history=lambda t, gain, tau: tau, rtol=1e-10
    )
    assert abs(args.y[0, -1] - series(5)) < 1e-9


@take_delays
def test_steps_may_be_longer_than_the_delay(method):
    """A pendulum with delayed damping: far fewer steps than delays, and the error that h <= tau gives."""

    def pendulum(t, y, z):
        return [y[1], -math.sin(y[0]) - 0.1 * z[0, 1]]

    tau, rtol = 0.01, 1e-4 if method in LOW_ORDER else 1e-6
    span, start = (0, 20), [1.0, 0.0]
    options = {"delays": tau, "history": start, "atol": 1e-2 * rtol}
    sol = iv.solve_ivp(pendulum, span, start, method, rtol=rtol, **options)
    exact = iv.solve_ivp(pendulum, span, start, "dop853", rtol=1e-10, **options)
    assert sol.stats.steps < 20 / tau / 4
    assert np.abs(sol.y[:, -1] - exact.y[:, -1]).max() < MOST_TOLERANCES * rtol


@pytest.mark.parametrize("method", ["ode15s", "ode23t", "ode23tb", "radau", "auto"])
def test_stiff_problems_with_a_short_delay(method):
    """Robertson's problem with a delay of 1e-4, over 14 decades of t: Newton's matrix has the derivatives with respect
    to delayed values too. Reference at t = 100: radau at 1e-7."""

    def robertson(t, y, z):
        slow, fast, last = 0.04 * y[0], 1e4 * z[0, 1] * y[2], 3e7 * y[1] ** 2
        return [-slow + fast, slow - fast - last, last]

    options = {"delays": 1e-4, "history": [1, 0, 0], "rtol": 1e-4, "atol": [1e-8, 1e-12, 1e-8]}
    sol = iv.solve_ivp(robertson, (0, 1e11), [1, 0, 0], method, max_steps=1000, **options)
    assert sol.success
    assert np.abs(sol.y.sum(axis=0) - 1).max() < 1e-8
    early = iv.solve_ivp(robertson, (0, 100), [1, 0, 0], method, **options)
    np.testing.assert_allclose(early.y[:, -1], [0.61723512, 6.1535945e-06, 0.38275873], rtol=1e-2)


def test_a_traced_jacobian_has_the_derivatives_along_short_delays():
    """It keeps Robertson's total to roundoff, which differences do not, and takes no evaluations of f."""

    def robertson(t, y, z):
        slow, fast, last = 0.04 * y[0], 1e4 * z[0, 1] * y[2], 3e7 * y[1] ** 2
        return [-slow + fast, slow - fast - last, last]

    options = {"delays": 1e-4, "history": [1, 0, 0], "rtol": 1e-4, "atol": [1e-8, 1e-12, 1e-8]}
    for f, jac in ((robertson, "trace"), (iv.compile(robertson, by="trace"), None)):
        sol = iv.solve_ivp(f, (0, 1e11), [1, 0, 0], "radau", jac=jac, **options)
        assert sol.stats.jacobian == "traced"
        assert sol.stats.steps < 250
        assert np.abs(sol.y.sum(axis=0) - 1).max() < 1e-14

    def chain(t, y, z, k):
        return -k * y * z[0] + np.roll(z[1], 1)

    problem = iv.Problem(chain, (0, 3), [1.0, 2, 3, 4], args=(2.0,), delays=[0.01, 0.5], history=[1.0] * 4)
    for more in ({}, {"jac_sparsity": np.ones((4, 4))}):
        exact, rough = (problem.replace(jac=jac, **more).solve("radau", rtol=1e-8) for jac in ("trace", "differences"))
        np.testing.assert_allclose(exact.y_end, rough.y_end, rtol=1e-8)
        assert exact.nfev < rough.nfev


@pytest.mark.parametrize("method", ["ode45", "dop853", "ode15s"])
def test_events_and_actions(method):
    """Suherman's suitcase: it hits the ground twice, which turns it around, and falls. Published times (dde23)."""
    gamma, beta, amplitude, omega = 0.248, 1.0, 0.75, 1.37
    eta, side = math.asin(gamma / amplitude), [1.0]

    def suitcase(t, y, z):
        push = amplitude * math.sin(omega * t + eta)
        return [y[1], math.sin(y[0]) - side[0] * gamma * math.cos(y[0]) - beta * z[0, 0] + push]

    def hit(t, y):
        side[0] = -side[0]
        return [0.0, 0.913 * y[1]]

    events = [iv.Event(lambda t, y: y[0], action=hit), iv.Event(lambda t, y: abs(y[0]) - math.pi / 2, terminal=True)]
    sol = iv.solve_ivp(
        suitcase, (0, 12), [0, 0], method, events=events, delays=0.1, history=[0, 0], rtol=1e-9, atol=1e-11
    )
    times = np.concatenate(sol.t_events)
    np.testing.assert_allclose(times, [4.516757065, 9.751053145, 11.670393497], rtol=1e-7)


@take_delays
def test_a_run_that_goes_on_is_the_run_that_was_not_interrupted(method, tmp_path):
    """Bit for bit, the past included, also from a file."""
    problem = iv.Problem(mackey_glass, (0, 80), [1.0], delays=[15.0], history=1)
    whole = problem.solve(method, rtol=1e-4)
    some = len(whole.t) // 2
    part = problem.solve(method, rtol=1e-4, max_steps=some)
    path = tmp_path / "part.npz"
    part.save(path)
    for interrupted in (part, iv.load(path, problem)):
        sol = interrupted.extend(80, max_steps=None)
        assert np.array_equal(sol.t, whole.t)
        assert np.array_equal(sol.y, whole.y)


def test_an_extension_keeps_marks_beyond_the_end():
    whole = iv.solve_ivp(decay, (0, 6), [1.0], "dop853", delays=1, history=1, rtol=1e-10)
    part = iv.solve_ivp(decay, (0, 2.5), [1.0], "dop853", delays=1, history=1, rtol=1e-10).extend(6)
    assert abs(part.y[0, -1] - whole.y[0, -1]) < 1e-9
    assert np.abs(part.t - 3).min() == 0


@explicit_and_implicit
def test_compiled_functions_are_as_python_ones(method):
    options = {"delays": ["tau"], "history": 1, "rtol": 1e-6}
    python = iv.solve_ivp(by_name, (0, 7), [1.0], method, args=(0.9, 1.0), **options)

    def fills(t, y, z, out, gain, tau):
        out[0] = -gain * z[0, 0]

    pytest.importorskip("llvmlite")
    for f in (iv.compile(by_name), iv.compile(fills, inplace=True)):
        compiled = iv.solve_ivp(f, (0, 7), [1.0], method, args=(0.9, 1.0), **options)
        np.testing.assert_allclose(compiled.y, python.y, rtol=1e-12)


def test_inputs_come_after_delayed_values():
    tap = iv.Input([0, 2, 3], [0.0, 1.0, 0.0])
    with_input = iv.Problem(lambda t, y, z, u: -z[0] + u, (0, 5), [1.0], inputs=tap, delays=1, history=1)
    by_hand = iv.Problem(lambda t, y, z: -z[0] + (2 <= t < 3), (0, 5), [1.0], delays=1, history=1, breakpoints=[2, 3])
    a, b = (one.solve("dop853", rtol=1e-10).y[0, -1] for one in (with_input, by_hand))
    assert abs(a - b) < 1e-9


@explicit_and_implicit
def test_bounds_and_invariants_hold(method):
    """An epidemic with a latent time tau: the total is conserved by f in exact arithmetic, and nobody is negative."""

    def epidemic(t, y, z):
        infections, onsets = 0.6 * y[0] * y[2], 0.6 * z[0, 0] * z[0, 2]
        return [-infections, infections - onsets, onsets - 0.2 * y[2], 0.2 * y[2]]

    start = [0.99, 0.0, 0.01, 0.0]
    sol = iv.solve_ivp(
        epidemic, (0, 100), start, method, delays=3, history=[0.0] * 4, rtol=1e-4, nonnegative=True,
        invariants=lambda t, y: y.sum(), dense_output=True,
    )  # fmt: skip
    y = sol.sol(np.linspace(0, 100, 1001))
    assert y.min() >= 0
    assert np.abs(y.sum(axis=0) - 1).max() < 1e-14


def test_dde23_is_matlabs_call():
    sol = iv.dde23(lambda t, y, Z: [Z[0, 0], Z[0, 0] + Z[1, 1], y[1]], [1, 0.2], [1, 1, 1], (0, 5), rtol=1e-6)
    np.testing.assert_allclose(sol.y[:, -1], KNOWN["ddex1"][-1], rtol=1e-4)
    jump = iv.dde23(lambda t, y, Z: 3.5 * y * (1 - Z[:, 0] / 19), 0.74, 19, (0, 10), [19.001], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(jump.y[:, -1], KNOWN["lemmings"][-1], rtol=1e-4)
    for option, instead in (("Jumps", "breakpoints="), ("InitialY", "y0="), ("method", "solve_ivp")):
        with pytest.raises(TypeError, match=instead):
            iv.dde23(lambda t, y, Z: [-Z[0, 0]], 1.0, 1.0, (0, 2), **{option: "radau"})


#: What is passed, and words of the error.
WRONG = [
    ({"delays": -0.5}, "a constant delay is positive"),
    ({"delays": 0}, "a term without delay is y itself"),
    ({"delays": lambda t: 1.0}, "vary with t or y are not supported"),
    ({"delays": [1.0, lambda t, y: 1.0]}, "delays\\[1\\] is a function"),
    ({"delays": []}, "positive numbers or names"),
    ({"delays": "tua"}, "no parameter 'tua'"),
    ({"history": None}, "need a history"),
    ({"delays": None}, "give delays too"),
    ({"history": [1.0, 2.0]}, "history has shape \\(2,\\), y0 has \\(1,\\)"),
    ({"history": lambda t: [1.0, 2.0]}, "history\\(t\\) returned shape \\(2,\\)"),
    ({"t_span": (1, 0)}, "a run backwards does not know"),
    ({"method": "radau", "jac": lambda t, y, z: [[0.0]]}, "jac with delays"),
    ({"method": "ode15s", "linear_solver": "gmres"}, "must be 'direct'"),
    ({"adjoint": True}, "adjoint equations look ahead"),
    ({"method": "radau", "mass": [[0.0]]}, "singular mass matrix are not supported"),
    *(({"method": name}, f"'{name}' takes no delays") for name, about in iv.METHODS.items() if not about.delays),
]


def test_what_is_wrong_or_not_supported_is_said():
    for given, words in WRONG:
        options = {"t_span": (0, 1), "y0": [1.0], "method": "ode45", "delays": 1.0, "history": 1.0, **given}
        with pytest.raises((ValueError, TypeError), match=words):
            iv.solve_ivp(lambda t, y, z, *args: -z[0], **options)
    with pytest.raises(TypeError) as told:
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], delays=1.0, history=1.0)
    assert "fun(t, y, z, *args)" in told.value.__notes__[0]
    problem = iv.Problem(decay, (0, 1), [1.0], delays=1, history=1)
    with pytest.raises(ValueError, match="without delays"):
        iv.steady_state(problem)


def test_memory_does_not_grow_with_the_number_of_steps():
    """A run remembers no more after 100 delays than twice what it remembers after 10."""
    options = {"delays": 1.0, "history": 1.0, "keep": "end", "rtol": 1e-3, "max_step": 0.05}
    sizes = [len(iv.solve_ivp(decay, (0, tf), [1.0], "ode23", **options)._origin.memory) for tf in (20, 200)]
    assert sizes[1] < 2 * sizes[0]


def test_replace_changes_delays_and_their_history():
    plain = iv.Problem(by_name, (0, 5), [1.0], args=(1.0, 1.0), delays="tau", history=1)
    other = plain.replace(delays=1.0, history=lambda t: 1.0, args=(1.0, 7.0))
    for problem in (plain, other, plain.replace(t_span=(0, 5)), other.replace(history=1)):
        assert abs(problem.solve("dop853", rtol=1e-10).y[0, -1] - series(5)) < 1e-9


def after(t, y, z, tau):
    return -z[0]


@take_delays
def test_the_derivative_with_respect_to_a_delay_jumps_with_the_marks(method):
    """y' = -y(t - tau), y = 1 before 0 and 2 at 0, tau = 1: dy/dtau at 3.7 is -1.6465 by the method of steps; without
    the jump of S at the image of the jump of y it is -1.19."""
    rtol = 1e-6 if method in LOW_ORDER else 1e-10
    sol = iv.solve_ivp(
        after, (0, 3.7), [2.0], method, delays="tau", args=(1.0,), history=1, sensitivities="tau", rtol=rtol,
        atol=1e-2 * rtol,
    )  # fmt: skip
    assert abs(sol.sensitivities[0, 0, -1] + 1.6465) < MOST_TOLERANCES * rtol


def coupled(t, y, z, a, tau, b):
    return [a * z[0, 1] - y[0] ** 3 * b, -z[1, 0] + np.sin(y[1])]


@explicit_and_implicit
@pytest.mark.parametrize("delays", [["tau", 1.0], ["tau", 0.02]])
def test_sensitivities_are_derivatives_of_the_solution(method, delays):
    """Against central differences of solutions at 1e-11, whose own errors are 1e-6; with a delay that steps exceed."""
    args, y0, step = np.array([1.1, 0.7, 0.3]), np.array([0.5, 0.2]), 1e-4
    problem = iv.Problem(
        coupled, (0, 5), y0, delays=delays, history=lambda t: [np.cos(t), np.sin(t)], args=tuple(args),
        sensitivities=["a", "tau", "b", "y0"],
    )  # fmt: skip
    S = problem.solve(method, rtol=1e-8, atol=1e-10).sensitivities[:, :, -1]

    def end(p):
        other = problem.replace(args=tuple(p[:3].tolist()), y0=p[3:], sensitivities=None)
        return other.solve("dop853", rtol=1e-11, atol=1e-13).y[:, -1]

    p = np.concatenate([args, y0])
    D = np.column_stack([(end(p + one) - end(p - one)) / (2 * step) for one in step * np.eye(5)])
    np.testing.assert_allclose(S, D, atol=1e-5 * np.abs(D).max())


def lifted(t, y, a, tau, b):
    return [y[0] + 0.3 * b, y[1] * 0.5]


def switched(t, y, z, a, tau, b):
    return [a * z[0, 1] - y[0] ** 3 * b + np.where(t > 2 * a, 0.5, 0.0), -z[0, 0] + np.sin(y[1])]


def complex_feedback(t, y, z, a, tau, b):
    return [1j * a * z[0, 0] - b * y[0]]


#: What a problem with y0 off its history has besides: S jumps at actions and at landings, and comes back by delays.
COMBINED = {
    "an action at a time of a parameter": {"events": iv.Event(lambda t, y, a, tau, b: t - 2 * a, action=lifted)},
    "an action of the state": {"events": iv.Event(lambda t, y, a, tau, b: y[1] + 1.5 * b, action=lifted)},
    "an action at a fixed time": {"breakpoints": [(2.0, lifted)]},
    "a regular mass matrix": {"mass": lambda t, a, tau, b: [[2.0 + a, 0.5], [0.1 * b, 1.5]]},
    "a history of the parameters": {"history": lambda t, a, tau, b: [np.cos(a * t) * 0.5, b * np.sin(tau * t) + 0.2]},
    "a start at that history": {"history": lambda t, a, tau, b: [a * np.cos(t), b * np.exp(tau * t)], "y0": None},
    "a condition on t": {"fun": switched},
    "delays of the same size": {"delays": ["tau", "b"], "args": (1.1, 0.7, 0.7)},
    "complex states": {
        "fun": complex_feedback, "y0": [1.2 + 0j], "history": lambda t, a, tau, b: np.exp(1j * a * t), "delays": "tau",
        "events": iv.Event(
            lambda t, y, a, tau, b: y[0].real - 0.2, action=lambda t, y, a, tau, b: [y[0] * 1j], direction=-1
        ),
    },
}  # fmt: skip


@pytest.mark.parametrize("what", COMBINED)
def test_sensitivities_jump_wherever_delays_bring_jumps_that_move(what):
    """Against differences of solutions, whose errors are 1e-7 of the largest derivative."""

    def two(t, y, z, a, tau, b):
        return [a * z[0, 1] - y[0] ** 3 * 0.3, -z[-1, 0] + np.sin(y[1])]

    given = {
        "fun": two, "t_span": (0, 5), "y0": [0.9, 0.1], "delays": ["tau"], "history": [0.5, 0.2],
        "args": (1.1, 0.7, 0.3), "sensitivities": True, **COMBINED[what],
    }  # fmt: skip
    problem, step = iv.Problem(**given), 1e-4
    method, exact = ("radau", "radau") if "mass" in given else ("dop853", "dop853")
    sol = problem.solve(method, rtol=1e-8, atol=1e-10)
    plain = problem.replace(sensitivities=None)

    def at(args):
        other = plain.replace(args=args).solve(exact, rtol=1e-11, atol=1e-13)
        return np.concatenate([other.y_end, *(other.t_events or [])])

    p = np.array(given["args"])
    D = np.column_stack([(at(tuple(p + d)) - at(tuple(p - d))) / (2 * step) for d in step * np.eye(3)])
    S = np.concatenate([sol.sensitivities[:, :, -1], *(sol.sensitivities_t_events or [])])
    np.testing.assert_allclose(S, D, atol=1e-6 * np.abs(D).max())


@explicit_and_implicit
def test_marks_are_the_images_of_jumps(method, tmp_path):
    """With their levels, also of a run in two parts, and from a file."""
    problem = iv.Problem(decay, (0, 3), [2.0], delays=1, history=1, breakpoints=[(0.5, lambda t, y: y + 1)])
    sol = problem.solve(method)
    part = problem.replace(t_span=(0, 1.2)).solve(method)
    part.save(tmp_path / "part.npz")
    for one in (sol, part.extend(3), iv.load(tmp_path / "part.npz", problem.replace(t_span=(0, 1.2))).extend(3)):
        np.testing.assert_allclose(one.marks.t, [0, 0.5, 1, 1.5, 2, 2.5, 3], rtol=1e-15)
        assert one.marks.level.tolist() == [0, 0, 1, 1, 2, 2, 3]
    assert iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]).marks.t.size == 0
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    ax = sol.plot(marks=True)
    assert sorted(line.get_xdata()[0] for line in ax.lines if len(set(line.get_xdata())) == 1) == sol.marks.t.tolist()


def test_an_initial_value_that_contradicts_the_history_is_named():
    """A component with E' = h(y) - h(y(t - tau)) must begin with what the history has brought in."""

    def latent(t, y, z):
        return [-0.6 * y[0] * y[2], 0.6 * y[0] * y[2] - 0.6 * z[0, 0] * z[0, 2], 0.6 * z[0, 0] * z[0, 2] - 0.2 * y[2]]

    def past(t):
        return [0.9, 0.0, 0.1 * np.exp(t)]

    inside = 0.6 * 0.9 * 0.1 * (1 - np.exp(-3))
    for method in ("ode45", "radau"):
        iv.solve_ivp(latent, (0, 1), [0.9, inside, 0.1], method, delays=3, history=past)
        with pytest.warns(iv.AccuracyWarning, match="y0\\[1\\] = 0 contradicts the history.*0.0513"):
            iv.solve_ivp(latent, (0, 1), [0.9, 0, 0.1], method, delays=3, history=past)
        iv.solve_ivp(infection, (0, 1), [5, 0.1, 1], method, delays=[1, 10], history=[5, 0.1, 1])


def test_a_fit_finds_a_delay():
    rng, t = np.random.default_rng(5), np.linspace(0.3, 12, 40)
    problem = iv.Problem(by_name, (0, 12), [1.0], delays="tau", history=1, args=(0.8, 1.1))
    clean = problem.solve("dop853", t_eval=t, rtol=1e-9).y[0]
    data = clean + 0.01 * rng.standard_normal(len(t))
    start = problem.replace(args=(1.0, 0.9))
    found = iv.fit(start, t, data, {"gain": (0.1, 3), "tau": (0.2, 3)}, method="dop853")
    assert abs(found.parameters["tau"] - 1.1) < 0.02
    assert abs(found.parameters["gain"] - 0.8) < 0.02


@explicit_and_implicit
def test_conditions_on_t_are_landings_as_without_delays(method):
    """Runs, also of compiled functions, land at them and at their images, and give the values of a run with breakpoints
    there; a condition on t and a delayed value is not one of them."""

    def pulsed(t, y, z, rate):
        return [-rate * z[0, 0] + np.where(t % 2 < 0.5, 1.0, 0.0) + np.where(z[0, 0] + t > 100, 1.0, 0.0)]

    given = {"delays": 1.0, "history": 1.0, "method": method, "args": (0.7,)}
    wanted = iv.solve_ivp(pulsed, (0, 5), [1.0], breakpoints=[0.5, 2, 2.5, 4, 4.5], **given)
    functions = [pulsed] if importlib.util.find_spec("llvmlite") is None else [pulsed, iv.compile(pulsed)]
    for f in functions:
        sol = iv.solve_ivp(f, (0, 5), [1.0], **given)
        np.testing.assert_allclose(sol.y_end, wanted.y_end, rtol=1e-13)
        assert {0.5, 2, 2.5, 4, 4.5, 1.5, 3} <= {*sol.t.tolist()}
        assert iv.solve_ivp(f, (0, 1), [1.0], **given).extend(5).y_end == pytest.approx(wanted.y_end, rel=1e-3)


def test_the_continuous_solution_is_the_history_before_the_start(tmp_path):
    problem = iv.Problem(decay, (0, 2), [1.0], delays=1, history=math.cos)
    sol = problem.solve("ode45", dense_output=True)
    sol.save(tmp_path / "sol.npz")
    for one in (sol, sol.extend(3), iv.load(tmp_path / "sol.npz", problem)):
        np.testing.assert_array_equal(one.sol([-0.5, -0.1])[0], [math.cos(-0.5), math.cos(-0.1)])
        assert one.sol(0.0)[0] == 1


@explicit_and_implicit
@pytest.mark.parametrize("compiled", [False, True])
def test_prepared_solvers_and_ensembles_take_other_delays(method, compiled):
    """Bit for bit the single solves, on several threads too."""
    if compiled:
        pytest.importorskip("llvmlite")
    f = iv.compile(by_name) if compiled else by_name
    problem = iv.Problem(f, (0, 5), [1.0], delays="tau", history=1, args=(1.0, 1.0))
    rows = [(1.0, tau) for tau in (0.5, 1.0, 1.5)]
    single = [problem.replace(args=row).solve(method).y[0, -1] for row in rows]
    prepared = problem.prepare(method)
    assert [prepared(args=row).y[0, -1] for row in rows] == single
    found = problem.solve_ensemble(np.ones((3, 1)), args=rows, method=method, workers=2, keep="end")
    assert found.y[:, 0, -1].tolist() == single
