"""Gradients by the adjoint of algebraic equations, mass matrices, bounds and complex states."""

from __future__ import annotations

import types

import numpy as np
import pytest

import invariode as iv
from cases import dealt
from gradients import ATOL, RATES, RTOL, START, both_ways, predators, solved
from invariode._adjoint.jumps import at_bounds
from test_sensitivities_complex import condensate, in_reals, inside, precession, turned, untraced_precession


def robertson(t, y, k1, k2, k3):
    a, b, c = y
    return [-k1 * a + k2 * b * c, k1 * a - k2 * b * c - k3 * b * b, a + b + c - 1]


@pytest.mark.parametrize("method", ["ode15s", "radau"])
@pytest.mark.parametrize("doses", [{}, {10.0: lambda t, y, k1, k2, k3: [0.9 * y[0], y[1], y[2] + 0.1 * k1]}])
def test_algebraic_equations_have_multipliers(method, doses):
    """Costs of algebraic components too, at several times, and doses that are made consistent."""
    sol = iv.solve_ivp(
        robertson,
        (0, 40),
        [1.0, 0.0, 0.0],
        method,
        args=(0.04, 1e4, 3e7),
        mass=np.diag([1.0, 1.0, 0.0]),
        breakpoints=doses,
        rtol=1e-7,
        atol=[1e-10, 1e-14, 1e-10],
        dense_output=True,
        sensitivities=True,
    )
    both_ways(sol, times=[0.0, 0.3, 10.0, 25.0, 40.0], rtol=1e-5)


@pytest.mark.parametrize("singular", [False, True])
def test_masses_are_parameters(singular):
    sol = iv.solve_ivp(
        lambda t, y, m, k: [-k * y[0] + y[1], y[0] ** 2 - y[1]],
        (0, 1),
        [0.5, 0.25],
        "radau",
        args=(2.0, 3.0),
        mass=lambda t, m, k: [[m, 0.0 if singular else 0.1 * k], [0, 0.0 if singular else m * k]],
        rtol=1e-9,
        atol=1e-11,
        sensitivities=True,
        dense_output=True,
    )
    both_ways(sol, rtol=1e-7)


def of_rank_one(t, m, k):
    """Singular, a function of t and of parameters."""
    return (m + np.sin(k * t)) * np.outer([0.9, 0.4], [1.0, 0.2])


def pumped_algebra(method, mass=of_rank_one, **options):
    return iv.solve_ivp(
        lambda t, y, m, k: [-k * y[0] + y[1], y[0] ** 2 - y[1] + 0.1 * m * t],
        y0=[0.5, 0.25],
        method=method,
        mass=mass,
        max_step=np.inf,
        **{"args": (2.0, 3.0), "t_span": (0, 1), **options},
    )


DOSE = {"breakpoints": {0.4: lambda t, y, m, k: [0.9 * y[0] + 0.01 * k, y[1]]}}


@pytest.mark.parametrize(("method", "span", "more"), [
    ("ode15s", (0, 0.6), {}), ("ode15s", (0.6, 0), DOSE), ("radau", (0, 0.6), DOSE), ("radau", (0.6, 0), {}),
])  # fmt: skip
def test_algebraic_equations_of_a_mass_matrix_that_depends_on_t(method, span, more):
    """Each two of method, direction and doses together: all three meet nowhere in the code."""
    given = {"rtol": 1e-7, "atol": 1e-9, "sensitivities": ["m", "k", "y0[0]"], "dense_output": True}
    both_ways(pumped_algebra(method, t_span=span, **given, **more), rtol=1e-5)


def test_events_beside_algebraic_equations_of_a_mass_matrix_that_depends_on_t():
    """Against differences of runs: their times, and the last state."""
    given = {"rtol": 1e-10, "atol": 1e-12, "events": lambda t, y, m, k: y[0] - 0.3}
    sol = pumped_algebra("radau", sensitivities=True, **given)
    assert len(sol.t_events[0])
    for j, size in enumerate((1e-4, 1e-4)):
        args = np.array([[2.0, 3.0]] * 2)
        args[:, j] += [-size, size]
        low, high = (pumped_algebra("radau", **given, args=tuple(one)) for one in args)
        slope = (high.y[:, -1] - low.y[:, -1]) / (2 * size)
        np.testing.assert_allclose(sol.sensitivities[:, j, -1], slope, atol=1e-6)
        of_time = (high.t_events[0] - low.t_events[0]) / (2 * size)
        np.testing.assert_allclose(sol.sensitivities_t_events[0][:, j], of_time, atol=1e-6)


@pytest.mark.parametrize("tf", [2.0, np.inf])
def test_a_mass_matrix_that_does_not_depend_on_its_parameter_at_the_start(tf):
    """Nor on t, if the run has no end but an event: as y' = f / M."""
    given = {"args": (3.0,), "rtol": 1e-9, "atol": 1e-11, "sensitivities": True}
    given["events"] = iv.Event(lambda t, y, k: t - 2.0, terminal=True)
    sol = iv.solve_ivp(lambda t, y, k: -y, (0, tf), [1.0], "radau", mass=lambda t, k: [[2 + np.sin(k * t)]], **given)
    plain = iv.solve_ivp(lambda t, y, k: [-y[0] / (2 + np.sin(k * t))], (0, tf), [1.0], "radau", **given)
    np.testing.assert_allclose(sol.sensitivities[0, 0, -1], plain.sensitivities[0, 0, -1], rtol=1e-6)


def test_algebraic_equations_that_turn_are_refused():
    def turning(t, m, k):
        return m * np.outer([np.cos(t), np.sin(t)], [1.0, 0.2])

    sol = pumped_algebra("radau", turning, adjoint=True)
    with pytest.raises(ValueError, match=r"null spaces .* are not those of the start at t = "):
        sol.gradient([1.0, 0.0], wrt="y0")


def test_a_mass_matrix_that_depends_on_t():
    sol = iv.solve_ivp(
        predators,
        (0, 2),
        START,
        "radau",
        args=RATES,
        mass=lambda t, *p: np.array([[2.0 + np.sin(t), 1.0], [0.0, 1.0 + t]]),
        rtol=RTOL,
        atol=ATOL,
        dense_output=True,
        sensitivities=["a", "c", "y0"],
    )
    both_ways(sol, rtol=10 * RTOL)


def test_a_component_at_rest_on_a_bound_pulls_nothing():
    """The component arrives at 0 at sin t = −½, and leaves where cos t is positive again."""
    sol = iv.solve_ivp(
        lambda t, y, a, b: [a * np.cos(t), y[0] ** 2 - b * y[1] + a * y[0]],
        (0, 6),
        [0.5, 1.0],
        "dop853",
        args=(1.0, 0.4),
        nonnegative=True,
        rtol=RTOL,
        atol=ATOL,
        dense_output=True,
        sensitivities=[0, 1, "y0"],
    )
    assert sol.stats.clipped
    both_ways(sol, times=[1.0, 3.0, 4.2, 5.5, 6.0], rtol=10 * RTOL)


@pytest.mark.parametrize("method", ["ode23s", "ode23t", "ode23tb", "radau"])
def test_what_rests_at_a_bound_is_told_by_the_slope_of_y_and_not_by_f(method):
    """Component 0 starts at its bound with y0' = 0, while M couples its f with that of component 1; dy1(3)/dk is
    −4.5 exp(−1.8), within 100 tolerances, of a method of order 2 by a backward run of its own."""
    M = np.array([[2.0, 0.5, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])

    def fun(t, y, k):
        return M @ np.array([-0.8 * y[0], 0.8 * y[0] - k * y[1], k * y[1]])

    sol = iv.solve_ivp(
        fun, (0, 3), [0.0, 1.5, 1.0], method, args=(0.6,), mass=M, nonnegative=True, rtol=RTOL, atol=RTOL, adjoint=True
    )
    np.testing.assert_allclose(sol.gradient([0.0, 1.0, 0.0]), -4.5 * np.exp(-1.8), rtol=100 * RTOL)


@pytest.mark.parametrize("method", ["ode23s", "ode15s", "radau"])
def test_a_component_at_rest_pulls_nothing_through_its_own_row_of_a_mass_matrix(method):
    """y0' = −p until y0 rests at 0, where row 0 of M is negative: f leads upwards, y0' downwards."""
    M = np.diag([-2.0, 4.0])

    def fun(t, y, p, k):
        return M @ np.array([-p, y[0] - k * y[1]])

    sol = iv.solve_ivp(
        fun,
        (0, 1),
        [0.5, 1.5],
        method,
        args=(0.9, 0.6),
        mass=M,
        nonnegative=[0],
        rtol=1e-6,
        atol=1e-8,
        dense_output=True,
        sensitivities=["p", "k", "y0"],
    )
    assert sol.stats.clipped
    both_ways(sol, times=[1.0], rtol=1e-5)


def test_a_component_at_rest_that_a_singular_mass_matrix_couples_is_refused():
    """The component's own equation is not known: the core does not change f there, and moves y alone."""
    M = np.array([[2.0, 0.5, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    points = np.zeros((3, 4))
    points[0] = [0.5, 0.0, 0.0, 0.0]

    class Line:
        ts = np.array([0.0, 1.0, 2.0, 3.0])

        def __call__(self, t):
            return np.array([np.interp(t, self.ts, row) for row in points])

    def fun(t, y):
        return [-2.0, -1.0, y[2]]

    held = iv.Problem(fun, (0, 3), points[:, 0], mass=M, nonnegative=[0])
    sol = types.SimpleNamespace(stats=types.SimpleNamespace(clipped=1.0), t_end=3.0)
    with pytest.raises(ValueError, match="component 0 rests at a bound from t = 1"):
        at_bounds(held, sol, Line(), 1.0, 1e-6)


def test_bounds_that_are_never_met_do_not_matter():
    assert np.array_equal(solved(nonnegative=True).gradient([1.0, 0.0]), solved().gradient([1.0, 0.0]))


def test_what_the_adjoint_does_not_follow_is_refused_by_name():
    singular = np.diag([1.0, 0.0])
    twice = {"breakpoints": [(0.5, lambda t, y, k: [y[0] + 1, y[1]]), (0.5, lambda t, y, k: [2 * y[0], y[1]])]}

    def decay(t, y, k):
        return [-k * y[0], y[0] - y[1]]

    given, start = {"args": (1.0,), "adjoint": True}, (decay, (0, 1), [1.0, 1.0], "radau")
    for sol, message in (
        (solved(adjoint=False), "adjoint=True"),
        (iv.solve_ivp(lambda t, y, k: [k * y[0] ** 2], (0, 2), [1.0], **given), "without success"),
        (iv.solve_ivp(*start, mass=singular, **twice, **given), "together with others"),
        (
            iv.solve_ivp(lambda t, y, k: [-k if y[0] > 0.5 else -2 * k], (0, 1), [1.0], "radau", mass=[[2.0]], **given),
            "fun jumps",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            sol.gradient(np.ones(len(sol.y)))


@pytest.mark.filterwarnings("ignore:sensitivities. the derivatives of fun:invariode.AccuracyWarning")
@dealt(10, method=["dop853", "ode113", "ode15s", "radau"], case=[
    (precession, {}),
    (untraced_precession, {}),
    (condensate, {"breakpoints": {0.5: turned}, "atol": [1e-9, 2e-9]}),
    (condensate, {"events": iv.Event(inside, action=turned), "invariants": lambda t, y, w, g: (abs(y) ** 2).sum()}),
    (lambda t, y, w, g: [-1j * w * y[0] * (2.0 if abs(y[1]) > g / 2 else 1.0), -g * y[0]], {}),
])  # fmt: skip
def test_complex_states_have_the_gradient_of_their_sensitivities(method, case):
    """To arguments, which are real, for any f: dG is the real part of dG_dy dy. The run backwards is of any
    method: each meets two or three of the problems."""
    fun, more = case
    given = {"args": (1.0, 1.1), "rtol": RTOL, "atol": ATOL, "sensitivities": True, "dense_output": True}
    sol = iv.solve_ivp(fun, (0, 1), [1.0 + 0j, 0.5j], method, **given | more)
    assert "events" not in more or len(sol.t_events[0])
    both_ways(sol, rtol=100 * RTOL)


@pytest.mark.parametrize("fun", [precession, condensate])
def test_complex_initial_values_have_a_gradient_for_any_f(fun):
    """∂G/∂Re y0 − i ∂G/∂Im y0, which is that of the real problem; if f is analytic it is dG_dy S."""
    given = {"args": (1.0, 1.1), "rtol": 1e-9, "atol": 1e-11, "adjoint": True}
    sol = iv.solve_ivp(fun, (0, 1), [1.0 + 0j, 0.5j], "dop853", **given)
    cost = np.array([1.0 - 2.0j, 0.3j])
    found = sol.gradient(cost, [0.1, 0.2], wrt=["g", "y0[1]"], integrand=lambda t, y, w, g: abs(y[0]) ** 2)
    parts = iv.solve_ivp(in_reals(fun), (0, 1), [1.0, 0.0, 0.0, 0.5], "dop853", **given)
    real = parts.gradient(
        [1.0, 2.0, 0.0, -0.3],
        wrt=["args[1]", "y0[2]", "y0[3]"],
        integrand=lambda t, x, w, g: x[0] ** 2 + x[1] ** 2,
    )
    np.testing.assert_allclose(found, [real[0] + 0.1, real[1] - 1j * real[2] + 0.2], atol=1e-7)
    if fun is precession:
        start = {name: one for name, one in given.items() if name != "adjoint"}
        S = iv.solve_ivp(fun, (0, 1), [1.0 + 0j, 0.5j], "dop853", **start, sensitivities="y0").sensitivities
        np.testing.assert_allclose(sol.gradient(cost, wrt="y0"), cost @ S[:, :, -1], atol=1e-7)


def test_wrong_input_is_said_by_name():
    sol = solved(t_span=(0, 1))
    for given, message in (
        ({}, "dG_dy"),
        ({"dG_dy": [1.0]}, r"dG_dy must have shape \(2,\)"),
        ({"dG_dy": [1.0, 1.0], "t": 2.0}, "t of gradient must be between 0.0 and 1.0"),
        ({"dG_dy": [1.0, 1.0], "dG_dp": [1.0]}, "dG_dp must have one number for each of 4"),
        ({"dG_dy": [1.0, 1.0], "wrt": "e"}, "no parameter 'e'"),
        ({"dG_dy": [1.0, np.nan]}, r"dG_dy and dG_dp must be finite, got \[1.0, nan\]"),
        ({"dG_dy": [1.0, 1.0], "t": [[0.5]]}, r"and times of shape \(1, 1\)"),
        ({"integrand": lambda t, y, *args: y}, "integrand must return one number, got array"),
        ({"integrand": lambda t, y, *args: y[0] + 1j}, "integrand must be real, got"),
        ({"integrand": 3}, r"integrand must be a function g\(t, y, \*args\), got 3"),
        (
            {"integrand": lambda t, y: y[0]},
            r"integrand is called with t, y and args = \(.*define it with \(t, y, \*args",
        ),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            sol.gradient(**given)


@dealt(method=["ode45", "ode15s"], adjoint=[True, "checkpoints"])
def test_laws_that_jump_at_a_breakpoint_take_new_values_there(method, adjoint):
    """The energy of a spring that becomes stiffer; with costs at the breakpoint and at the end."""

    def stiffness(t, k):
        return np.where(t < 1, 1.0, k)

    sol = iv.solve_ivp(
        lambda t, y, k: [y[1], -stiffness(t, k) * y[0]],
        (0, 2),
        [1.0, 0.3],
        method,
        args=(1.7,),
        invariants=lambda t, y, k: y[1] ** 2 / 2 + stiffness(t, k) * y[0] ** 2 / 2,
        breakpoints=[1.0],
        t_eval=[1.0, 2.0],
        sensitivities=["k", "y0"],
        rtol=1e-8,
        atol=1e-10,
        adjoint=adjoint,
    )
    costs = np.array([[1.0, 2.0], [3.0, -1.0]])
    expected = np.einsum("it,ikt->k", costs, sol.sensitivities)
    np.testing.assert_allclose(sol.gradient(costs, t=sol.t), expected, rtol=0, atol=1e-5)


def test_costs_at_times_that_are_as_far_from_the_end_add_up():
    """10 - 0.3 is 10 - (0.1 + 0.2)."""
    sol = iv.solve_ivp(lambda t, y, a: [-a * y[0]], (0, 10), [1.0], args=(0.5,), rtol=1e-9, atol=1e-12, adjoint=True)
    np.testing.assert_allclose(sol.gradient([[1.0, 1.0]], t=[0.3, 0.1 + 0.2]), 2 * -0.3 * np.exp(-0.15), rtol=1e-7)


def test_a_solution_from_a_file_has_no_gradient(tmp_path):
    solved(t_span=(0, 1)).save(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"without the functions of its problem: it has no gradient\. Solve it again"):
        iv.load(tmp_path / "a.npz").gradient([1.0, 0.0])
