"""A wrong invariant is refused at the start or ends the run, by name; a right one is never accused."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families
from problems import (
    PROBLEMS,
    jacobi_integral,
    kepler,
    kepler_invariants,
    lotka_volterra,
    lotka_volterra_invariant,
    pendulum,
    rigid_body,
    three_body,
)


def oscillator(t, y):
    return [y[1], -4 * y[0]]


def damped(t, y):
    return [y[1], -4 * y[0] - 1e-3 * y[1]]


def driven(t, y):
    return [y[1], -4 * y[0] + 0.01 * np.sin(t)]


def oscillator_energy(t, y):
    return y[1] ** 2 / 2 + 2 * y[0] ** 2


ORBIT = [0.4, 0, 0, 2]
WRONG = {
    "missing factor": (oscillator, [1, 0.3], lambda t, y: y[1] ** 2 + 2 * y[0] ** 2),
    "sign": (oscillator, [1, 0.3], lambda t, y: y[1] ** 2 / 2 - 2 * y[0] ** 2),
    "wrong stiffness": (oscillator, [1, 0.3], lambda t, y: y[1] ** 2 / 2 + 2.02 * y[0] ** 2),
    "dissipative": (damped, [1, 0.3], oscillator_energy),
    "forced": (driven, [1, 0.3], oscillator_energy),
    "sign of the potential": (kepler, ORBIT, lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 + 1 / np.hypot(y[0], y[1])),
    "potential 1/r²": (kepler, ORBIT, lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - 1 / (y[0] ** 2 + y[1] ** 2)),
    "wrong mass": (kepler, ORBIT, lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - 1.01 / np.hypot(y[0], y[1])),
    "momentum with a plus": (kepler, ORBIT, lambda t, y: y[0] * y[3] + y[1] * y[2]),
    "exchanged rates": (lotka_volterra, [1, 3], lambda t, y: lotka_volterra_invariant(t, y[::-1])),
    "of another problem": (lotka_volterra, [1, 3], lambda t, y: y @ y),
    "energy in the rotating frame": (
        three_body,
        PROBLEMS["three-body"].y0,
        lambda t, y: jacobi_integral(t, y) + y[0] ** 2,
    ),
    "Coriolis": (three_body, PROBLEMS["three-body"].y0, lambda t, y: y[0] * y[3] - y[1] * y[2]),
    "wrong inertia": (rigid_body, [0.2, 1, 1], lambda t, y: y[0] ** 2 + 1.1 * y[1] ** 2),
    "explicit time": (oscillator, [1, 0.3], lambda t, y: oscillator_energy(t, y) + 0.1 * t),
    "a component": (oscillator, [1, 0.3], lambda t, y: y[0]),
    "kinetic energy alone": (kepler, ORBIT, lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2),
    "wrong exponent": (lotka_volterra, [1, 3], lambda t, y: y[0] - np.log(y[0]) + y[1] - 2 * np.log(y[1])),
    "mass that is lost": (lambda t, y: [-y[0], 0.999 * y[0]], [1, 0.5], lambda t, y: y[0] + y[1]),
    "clock of another frequency": (lambda t, y: [np.cos(t)], [0.5], lambda t, y: y[0] - np.sin(1.001 * t) / 1.001),
}


@dealt(method=METHODS, name=WRONG, rtol=[1e-3, 1e-6])
def test_wrong_invariants_are_found(method, name, rtol):
    fun, y0, wrong = WRONG[name]
    invariants = iv.Invariants(wrong, names="suspect")
    with pytest.raises(iv.InvariantError, match="suspect is not conserved") as found:
        iv.solve_ivp(fun, (0, 50), y0, method, rtol=rtol, atol=rtol * 1e-3, invariants=invariants)
    if (sol := found.value.solution) is not None:  # the run had begun
        assert sol.status == -2
        assert sol.t[-1] < 50
        assert sol.steps is not None
        assert len(sol.steps.t) == sol.stats.steps == len(sol.t) - 1


@dealt(24, method=METHODS, problem=PROBLEMS, rtol=[1e-2, 1e-3, 1e-4, 1e-6, 1e-8])
@pytest.mark.filterwarnings("ignore:overflow")  # in stages of attempts that are far too long
def test_right_invariants_are_never_accused(method, problem, rtol):
    t0, tf = problem.t_span
    if rtol < 1e-5:  # many steps: a third of the interval is enough, as in the core's test of a long run
        tf = t0 + (tf - t0) / 3
    for jac in (True, False):
        sol = iv.solve_ivp(
            problem.fun,
            (t0, tf),
            problem.y0,
            method,
            rtol=rtol,
            atol=1e-3 * rtol,
            invariants=problem.invariants(jac=jac),
        )
        assert sol.success, sol.message


HARD = {
    "value 0": (lambda t, y: [y[1], y[0]], [1, 1], lambda t, y: y[1] ** 2 - y[0] ** 2),
    "huge": (kepler, ORBIT, lambda t, y: 1e200 * kepler_invariants(t, y)[0]),
    "tiny": (kepler, ORBIT, lambda t, y: 1e-200 * kepler_invariants(t, y)[0]),
    "offset": (kepler, ORBIT, lambda t, y: 1e6 + kepler_invariants(t, y)[0]),
    "time-dependent": (lambda t, y: [np.cos(t), y[0] - np.sin(t)], [0, 2], lambda t, y: y[0] - np.sin(t)),
    "explicit time that cancels": (lambda t, y: [1.0, -y[1]], [0, 1], lambda t, y: np.exp(t) * y[1]),
    "close approach": (kepler, [0.02, 0, 0, (1.98 / 0.02) ** 0.5], kepler_invariants),
    "a power": (oscillator, [1, 0.3], lambda t, y: oscillator_energy(t, y) ** 5),
    "nearly an equilibrium": (lotka_volterra, [1.0001, 1.0001], lotka_volterra_invariant),
    "logarithms": (lotka_volterra, [1, 3], lambda t, y: y[0] - np.log(y[0]) + 2 * (y[1] - np.log(y[1]))),
    "in metres and seconds": (
        lambda t, y: [y[2], y[3], *(-1.327e20 * y[:2] / np.hypot(y[0], y[1]) ** 3)],
        [1.5e11, 0, 0, 3e4],
        lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - 1.327e20 / np.hypot(y[0], y[1]),
    ),
    "far below the tolerance": (oscillator, [1e-12, 3e-13], oscillator_energy),
    "one component": (lambda t, y: [0 * y[0]], [2.0], lambda t, y: y[0]),
    "time itself": (lambda t, y: [1.0], [0.0], lambda t, y: y[0] - t),
    "fast time": (
        lambda t, y: [50 * np.cos(50 * t), y[0] - np.sin(50 * t)],
        [0, 2],
        lambda t, y: y[0] - np.sin(50 * t),
    ),
    "quartic": (lambda t, y: [y[1], -(y[0] ** 3)], [1, 0], lambda t, y: y[1] ** 2 / 2 + y[0] ** 4 / 4),
    "root of it": (oscillator, [1, 0.3], lambda t, y: np.sqrt(oscillator_energy(t, y))),
    "its reciprocal": (oscillator, [1, 0.3], lambda t, y: 1 / oscillator_energy(t, y)),
    "two that nearly agree": (
        kepler,
        ORBIT,
        lambda t, y: [kepler_invariants(t, y)[0], kepler_invariants(t, y)[0] + 0.1 * kepler_invariants(t, y)[1]],
    ),
    "through a singularity of the gradient": (
        lambda t, y: [y[1], -np.sign(y[0]) * abs(y[0]) ** 0.5],
        [1, 0],
        lambda t, y: y[1] ** 2 / 2 + abs(y[0]) ** 1.5 / 1.5,
    ),
}


def test_the_lists_are_long_enough():
    assert len(WRONG) >= 20
    assert len(HARD) >= 20


def rates(t, y):
    return [1.6 * y[0] * (1 - y[1]), -0.7 * y[1] * (1 - y[0])]


def logarithms(t, y):
    return 0.7 * (y[0] - np.log(y[0])) + 1.6 * (y[1] - np.log(y[1])) if min(y) > 0 else np.nan


@pytest.mark.filterwarnings("ignore:.* fell below 0")  # runs without bounds do
@families
def test_difference_jacobian_close_to_where_g_ends(method):
    """A population far below its absolute tolerance: increments of that size would leave the domain of g."""
    sol = iv.solve_ivp(rates, (0, 40), [9.0, 3.0], method, rtol=1e-5, atol=1e-3, invariants=logarithms)
    assert sol.success, sol.message
    assert sol.y.min() < np.cbrt(np.finfo(float).eps) * 1e-3 / 1e-5  # the increment that atol suggests
    plain = iv.solve_ivp(rates, (0, 40), [9.0, 3.0], method, rtol=1e-5, atol=1e-3)
    drift = [logarithms(t, y) - logarithms(0, plain.y[:, 0]) for t, y in zip(plain.t, plain.y.T, strict=True)]
    assert not np.abs(drift).max() < 2 * np.abs(sol.residual).max()  # NaN where the plain run leaves the domain


@explicit_and_implicit
def test_given_jacobian_is_not_accused_where_differences_are_coarse(method):
    """If thr is far above y, the increments of the check are not small for g: they do not judge the entries."""
    exact = iv.Invariants(logarithms, jac=lambda t, y: [0.7 * (1 - 1 / y[0]), 1.6 * (1 - 1 / y[1])])
    sol = iv.solve_ivp(rates, (0, 1), [3e-3, 1.5], method, rtol=1e-5, atol=1e-3, invariants=exact)
    assert sol.success, sol.message


def pendulum_energy(t, y):
    return y[1] ** 2 / 2 - np.cos(y[0])


def spring(t, y):
    q, r = y[:2], np.linalg.norm(y[:2])
    return [*y[2:], *(-4 * (r - 1) * q / r)]


DAY0, TURN = 2460000.5, 2 * np.pi / 1.5  # Julian days

#: fun, span, y0, invariant, options: where increments, roundoff or complex steps mislead.
MISLEADING = {
    "thr far above y": (
        lambda t, y: [y[1], -np.sin(y[0])],
        (0, 10),
        [1, 0.5],
        pendulum_energy,
        {"rtol": 1e-12},
    ),
    "an orbit, thr far above y": (kepler, (0, 5), ORBIT, kepler_invariants, {"rtol": 1e-11}),
    "a spring at rest length": (
        spring,
        (0, 10),
        [1, 0, 0.3, 0.5],
        lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 + 2 * (np.linalg.norm(y[:2]) - 1) ** 2,
        {},
    ),
    "an absolute value at 0": (
        lambda t, y: [y[1], -y[0] * abs(y[0])],
        (0, 20),
        [0, 1],
        lambda t, y: y[1] ** 2 / 2 + abs(y[0]) ** 3 / 3,
        {},
    ),
    "a real part": (
        lambda t, y: [y[1], -y[0]],
        (0, 20),
        [1, 0],
        lambda t, y: y[0] ** 2 + np.real(y[1]) ** 2,
        {},
    ),
    "a clearance": (
        lambda t, y: [y[1], -np.sign(y[0]) * max(abs(y[0]) - 0.5, 0)],
        (0, 20),
        [0, 1],
        lambda t, y: y[1] ** 2 / 2 + np.maximum(np.abs(y[0]) - 0.5, 0) ** 2 / 2,
        {},
    ),
    "large t": (
        lambda t, y: [-TURN * y[1], TURN * y[0]],
        (DAY0, DAY0 + 6),
        [1, 0.2],
        lambda t, y: y[0] * np.cos(TURN * (t - DAY0)) + y[1] * np.sin(TURN * (t - DAY0)),
        {},
    ),
    "a fading term": (
        lambda t, y: [np.exp(-t), -y[1]],
        (0, 30),
        [1, 1],
        lambda t, y: y[0] + np.exp(-t),
        {"rtol": 1e-9, "atol": 1e-9},
    ),
    "a tiny first step": (
        lambda t, y: [np.cos(t)],
        (0, 1),
        [1],
        lambda t, y: y[0] - np.sin(t),
        {"first_step": 1e-10, "rtol": 1e-9, "atol": 1e-9},
    ),
    "a stationary point": (
        lambda t, y: [y[1], -y[0]],
        (0, 20),
        [np.sqrt(np.pi), 0],
        lambda t, y: np.cos(y[0] ** 2 + y[1] ** 2),
        {"rtol": 1e-3, "atol": 1e-3},
    ),
    "products that underflow": (
        lambda t, y: [-y[0], 2 * y[1]],
        (0, 300),
        [1, 1],
        lambda t, y: y[0] ** 2 * y[1],
        {"rtol": 1e-6, "atol": 0},
    ),
}


@dealt(method=METHODS, name=MISLEADING)
def test_right_invariants_where_derivatives_mislead(method, name):
    fun, span, y0, g, options = MISLEADING[name]
    sol = iv.solve_ivp(fun, span, y0, method, invariants=g, **options)
    assert sol.success, sol.message


@explicit_and_implicit
def test_projection_is_as_good_where_thr_is_far_above_y(method):
    """Increments as large as thr would make Jacobians by differences worthless."""
    held = iv.Invariants(kepler_invariants, jac="3-point")
    sol = iv.solve_ivp(kepler, (0, 5), ORBIT, method, rtol=1e-10, invariants=held)
    assert np.abs(sol.residual).max() < 1e-9


#: What a right invariant gets added, which is 0 at the start.
LATE = {
    "a switch": (lambda t: 0.3 * (1 + np.tanh(2 * (t - 10))), {}),
    "a ramp": (lambda t: 0.03 * np.maximum(t - 1, 0), {}),
    "a parabola": (lambda t: 0.003 * np.maximum(t - 2, 0) ** 2, {}),
    "a steep ramp": (lambda t: 0.1 * np.maximum(t - 1, 0), {}),
    "an oscillation": (lambda t: 1e-3 * np.sin(t) ** 2, {"rtol": 1e-9, "atol": 1e-12}),
}


@dealt(method=FAMILIES, name=LATE)
def test_invariants_that_begin_to_change_with_t_are_found(method, name):
    added, options = LATE[name]
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -y[0]],
        (0, 20),
        [1, 0],
        method,
        invariants=lambda t, y: y[0] ** 2 + y[1] ** 2 + added(t),
        on_failure="return",
        **options,
    )
    assert sol.status == -2
    assert "not conserved" in sol.message


@pytest.mark.parametrize("method", ["ode23", "ode45", "ode113", "ode15s"])
def test_a_jacobian_that_goes_wrong_later_is_blamed_not_its_invariant(method):
    wrong = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2, jac=lambda t, y: [2 * y[0], 2.01 * y[1]])
    sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1, 0], method, invariants=wrong, on_failure="return")
    assert sol.status == -2
    assert "The Jacobian of invariant" in sol.message
    assert "y[1]" in sol.message


def test_complex_steps_are_given_up_where_they_are_wrong():
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -np.sign(y[0]) * max(abs(y[0]) - 0.5, 0)],
        (0, 20),
        [0, 0.4],
        invariants=lambda t, y: y[1] ** 2 / 2 + np.maximum(np.abs(y[0]) - 0.5, 0) ** 2 / 2,
    )
    assert sol.success
    assert "central differences" in sol.stats.derivatives


@dealt(8, method=METHODS, when=["always", "needed"])
def test_an_invariant_that_becomes_undefined_ends_the_run_there(method, when):
    held = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2 if t < 5 else np.nan, when=when)
    sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1, 0], method, invariants=held)
    assert sol.status == -1
    assert sol.t[-1] < 5.000001


def test_a_right_jacobian_is_not_called_wrong_beside_the_manifold():
    held = iv.Invariants(lambda t, y: y @ y, jac=lambda t, y: 2 * y, value=1)
    report = iv.check_invariants(lambda t, y: [-y[1], y[0]], held, 0, [0.8003, 0.6004])
    assert report.ok, report


@dealt(method=METHODS, name=HARD)
def test_right_invariants_that_are_hard(method, name):
    fun, y0, g = HARD[name]
    sol = iv.solve_ivp(fun, (0, 10), y0, method, invariants=g)
    assert sol.success, sol.message


@explicit_and_implicit
def test_critical_point_at_the_start(method):
    """The energy is stationary where the oscillator rests: it is left out, without a word, since nothing moves."""
    sol = iv.solve_ivp(oscillator, (0, 10), [0, 0], method, invariants=oscillator_energy)
    assert sol.success
    assert not sol.y.any()


@explicit_and_implicit
def test_position_constraint_alone_is_told_to_need_its_derivative(method):
    invariants = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2 - 1, value=0, names="length")
    sol = iv.solve_ivp(pendulum, (0, 50), [1, 0, 0, 0], method, invariants=invariants, on_failure="return")
    assert sol.status == -2
    assert "length is not conserved" in sol.message
    assert "A hidden constraint is missing" in sol.message


@explicit_and_implicit
def test_wrong_jacobian_is_refused_and_the_entry_named(method):
    problem = PROBLEMS["Kepler"]

    def wrong(t, y):
        J = np.array(problem.jac(t, y))
        J[1, 3] *= 1.01
        return J

    invariants = iv.Invariants(problem.g, wrong, names=["energy", "momentum"])
    with pytest.raises(
        iv.InvariantError, match=r"Jacobian of invariant momentum is wrong .* entry for y\[3\] is 0\.404,"
    ):
        iv.solve_ivp(problem.fun, problem.t_span, problem.y0, method, invariants=invariants)
    assert iv.solve_ivp(problem.fun, (0, 1), problem.y0, method, invariants=invariants, check=False).success


@explicit_and_implicit
def test_wrong_jacobian_of_a_complex_problem_names_the_part(method):
    invariants = iv.Invariants(lambda t, z: abs(z[0]) ** 2, jac=lambda t, z: 2 * z.conj())
    with pytest.raises(iv.InvariantError, match=r"entry for y\[0\] \(imaginary part\)"):
        iv.solve_ivp(lambda t, z: 1j * z, (0, 1), [1 + 1j], method, invariants=invariants)


@explicit_and_implicit
def test_check_false_takes_the_user_at_their_word(method):
    fun, y0, wrong = WRONG["dissipative"]
    sol = iv.solve_ivp(fun, (0, 5), y0, method, invariants=wrong, check=False)
    assert sol.success
    assert sol.stats.nfev_check == iv.solve_ivp(fun, (0, 5), y0, method).stats.nfev_check  # of Jacobians of f


def test_invariant_that_is_not_finite_at_the_start():
    with pytest.raises(ValueError, match="invariant g is not finite at t = 0"):
        iv.solve_ivp(oscillator, (0, 1), [1, 0], invariants=lambda t, y: np.inf)
    root = iv.Invariants(lambda t, y: np.sqrt(y[1]), jac=lambda t, y: [0, np.inf], names=["root"])
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(iv.InvariantError, match="invariant root, or its Jacobian, is not finite at the start"),
    ):
        iv.solve_ivp(oscillator, (0, 1), [1, 0], invariants=root)


@explicit_and_implicit
def test_a_derivative_that_is_nan_where_its_function_is_given_stops_the_solution(method):
    """As that of fun does: at the start it is an error, later the end of the run, which names the invariant."""
    for start in (0.0, 0.5):
        energy = iv.Invariants(
            oscillator_energy, jac=lambda t, y, start=start: np.array([4 * y[0], y[1]]) * (np.nan if t >= start else 1)
        )
        options = {"method": method, "invariants": energy, "on_failure": "return"}
        if start == 0:
            with pytest.raises(iv.InvariantError, match="or its Jacobian, is not finite at the start"):
                iv.solve_ivp(oscillator, (0, 1), [1, 0], **options)
            continue
        sol = iv.solve_ivp(oscillator, (0, 1), [1, 0], **options)
        assert sol.status < 0
        assert sol.t[-1] < start
        assert "oscillator_energy, or its Jacobian, is not defined" in sol.message
    assert not iv.impose(iv.Invariants(lambda t, y: y @ y, jac=lambda t, y: y * np.nan, value=1), 0, [1, 0.1]).converged


def test_a_formula_of_ours_that_is_nan_where_its_function_is_not_is_replaced_by_differences():
    """x² log x² at 0, whose derivative has the term 2 x log x."""
    pytest.importorskip("llvmlite")

    @iv.compile
    def g(t, y):
        return y[0] ** 2 * np.log(y[0] ** 2 + (y[0] == 0)) + y[1]

    sol = iv.solve_ivp(lambda t, y: [0.0, 0.0], (0, 1), [0.0, 1.0], invariants=g)
    assert sol.success


@dealt(method=METHODS, problem=PROBLEMS)
@pytest.mark.filterwarnings("ignore:overflow")
def test_size_of_corrections_stays_in_the_range_known_for_right_invariants(method, problem):
    """Below 100 rtol for rtol <= 1e-2: where the guard draws the line."""
    for rtol in (1e-2, 1e-3, 1e-4, 1e-6):
        sol = problem.solve(method, rtol=rtol)
        assert sol.correction.max() < 100


def pulsed(k):
    """A pendulum with a short torque late in [0, 60], and its start: random case k, whose energy changes by more than
    20 rtol for every rtol up to 1e-3."""
    r = np.random.default_rng(k)
    while True:
        when, wide, much = r.uniform(30, 55), r.uniform(0.3, 1), r.choice([-1, 1]) * 10 ** r.uniform(-1, 0.3)
        y0 = [r.uniform(0.3, 2.5), r.uniform(-0.5, 0.5)]

        def fun(t, y, when=when, wide=wide, much=much):
            return [y[1], -np.sin(y[0]) + much * np.exp(-(((t - when) / wide) ** 2) / 2)]

        true = iv.solve_ivp(fun, (0, 60), y0, "dop853", rtol=1e-9, atol=1e-12, max_step=0.2)
        if abs(swing(0, true.y[:, -1]) - swing(0, y0)) > 20e-3:
            return fun, y0, wide


def swing(t, y):
    return y[1] ** 2 / 2 - np.cos(y[0])


@pytest.fixture(scope="module")
def pulses():
    return [pulsed(k) for k in range(8)]


@families
def test_a_law_that_is_broken_for_a_while_is_refused_however_late(method, pulses):
    """Steps resolve the pulse; suspicions that were unfounded before do not hide it."""
    for fun, y0, wide in pulses:
        options = {"max_step": wide / 2, "invariants": swing, "keep": "end", "on_failure": "return"}
        sol = iv.solve_ivp(fun, (0, 60), y0, method, **options)
        assert sol.status == -2


@families
def test_looks_at_unfounded_suspicions_are_few(method):
    """One in 64 steps, and a few more where suspicions vary in size."""
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -np.sin(y[0])], (0, 300), [2.0, 0.1], method, atol=1e-6, invariants=swing, keep="end"
    )
    assert sol.success
    assert sol.stats.nfev_check <= 16 + sol.stats.steps / 16
