"""The gradient by one run backwards is that of the forward sensitivities, within some tolerances."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import METHODS

RTOL, ATOL = 1e-7, 1e-9
RATES = (1.5, 1.0, 3.0, 1.0)
START = [1.0, 1.0]
#: The last digits of the reference are those of an error of 1e-13.
GRADIENT = np.array([0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395])
#: In units of rtol, times the sizes of the terms: the errors of the two runs, on which the methods differ.
MOST = {2: 3000, 3: 1000}


def predators(t, y, a, b, c, d):
    return [a * y[0] - b * y[0] * y[1], -c * y[1] + d * y[0] * y[1]]


def conserved(t, y, a, b, c, d):
    return d * y[0] - c * np.log(y[0]) + b * y[1] - a * np.log(y[1])


def solved(method="dop853", t_span=(0, 10), **options):
    given = {"args": RATES, "rtol": RTOL, "atol": ATOL, "max_step": np.inf, "adjoint": True} | options
    return iv.solve_ivp(predators, t_span, START, method, **given)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_the_gradient_is_the_one_known(method, held):
    """G = ½ |y(10) − 1|², whose gradient is known, with the law held whose form depends on the parameters."""
    rtol = 1e-5 if method in ("ode23", "ode23s", "ode23t", "ode23tb") else RTOL
    sol = solved(method, invariants=conserved if held else None, rtol=rtol, atol=rtol / 100)
    found = sol.gradient(sol.y[:, -1] - 1)
    assert np.abs(found - GRADIENT).max() < MOST.get(iv.METHODS[method].order, 300) * rtol


@pytest.mark.parametrize("method", ["dop853", "ode15s"])
def test_costs_at_several_times_add_up(method):
    """The first and the last time among them, and one of them twice."""
    sol = solved(method, sensitivities=["b", "y0", "c"], t_eval=np.linspace(0, 10, 6))
    costs = np.random.default_rng(29).normal(size=sol.y.shape)
    expected = np.einsum("it,ikt->k", costs, sol.sensitivities)
    size = np.abs(sol.sensitivities).sum()
    assert np.abs(sol.gradient(costs) - expected).max() < 20 * RTOL * size
    twice = sol.gradient(np.repeat(costs[:, 2:3] / 2, 2, axis=1), t=[4.0, 4.0])
    assert np.array_equal(twice, sol.gradient(costs[:, 2], t=4.0))


@pytest.mark.parametrize("span", [(0, 3), (3, 0)])
def test_the_gradient_of_an_integral_is_that_of_one_more_component(span):
    def cost(t, y, a, b, c, d):
        return a * y[0] * y[1] + t * y[1]

    def with_cost(t, y, a, b, c, d):
        return [*predators(t, y[:2], a, b, c, d), cost(t, y, a, b, c, d)]

    sol = solved(t_span=span)
    more = iv.solve_ivp(
        with_cost, span, [*START, 0.0], "dop853", args=RATES, rtol=RTOL, atol=ATOL, sensitivities=["a", "d", "y0[1]"]
    )
    found = sol.gradient(integrand=cost, wrt=["a", "d", "y0[1]"])
    np.testing.assert_allclose(found, more.sensitivities[2, :, -1], rtol=100 * RTOL)


@pytest.mark.parametrize("method", ["ode45", "radau"])
def test_a_mass_matrix_and_what_depends_on_y0(method):
    """Against the forward run, with M neither diagonal nor symmetric, and with y0 a function of a parameter."""
    wanted = iv.Sensitivities(args=["a", "c"], y0=True, dy0dp=[[1.0, 0.0], [0.5, 2.0]])
    mass = np.array([[2.0, 1.0], [0.0, 1.0]]) if method == "radau" else None
    sol = solved(method, (0, 2), mass=mass, sensitivities=wanted)
    cost = np.array([1.0, -2.0])
    np.testing.assert_allclose(sol.gradient(cost), cost @ sol.sensitivities[:, :, -1], rtol=1e-4)


def test_each_of_many_parameters_has_its_derivative():
    """y'' + y = a sum of 60 pulses, each with a weight: y(3) answers a push at t by sin(3 − t)."""
    nodes = np.linspace(0, 3, 60)

    def pushed(t, y, weights):
        return [y[1], -y[0] + weights @ np.exp(-((t - nodes) ** 2))]

    sol = iv.solve_ivp(pushed, (0, 3), START, "dop853", args=(np.cos(nodes),), rtol=1e-9, atol=1e-11, adjoint=True)
    fine = np.linspace(0, 3, 20001)
    expected = [np.trapezoid(np.sin(3 - fine) * np.exp(-((fine - node) ** 2)), fine) for node in nodes]
    np.testing.assert_allclose(sol.gradient([1.0, 0.0]), expected, rtol=1e-7)


def test_a_jump_of_f_at_a_breakpoint_is_not_stepped_over():
    sol = iv.solve_ivp(
        lambda t, y, k: [-k * y[0] + (3.0 if t < 1 else 0.0)],
        (0, 2),
        [1.0],
        "dop853",
        args=(2.0,),
        rtol=1e-10,
        atol=1e-12,
        breakpoints=[1.0],
        adjoint=True,
        sensitivities=["k", "y0"],
    )
    np.testing.assert_allclose(sol.gradient([1.0]), sol.sensitivities[0, :, -1], rtol=1e-8)


def test_what_the_adjoint_does_not_follow_is_refused_by_name():
    hit = iv.Event(lambda t, y, *p: y[0] - 0.5, action=lambda t, y, *p: [1.0, y[1]])
    singular = np.diag([1.0, 0.0])
    for sol, message in (
        (solved(events=hit), "jumps by actions"),
        (solved(adjoint=False), "adjoint=True"),
        (solved(breakpoints={1.0: lambda t, y, *p: y}), "at t = 1.0"),
        (solved(t_span=(0, 1), nonnegative=True), "bounds"),
        (iv.solve_ivp(lambda t, y, k: [k * y[0] ** 2], (0, 2), [1.0], args=(1.0,), adjoint=True), "without success"),
        (
            iv.solve_ivp(lambda t, y, k: [-k if y[0] > 0.5 else -2 * k], (0, 1), [1.0], args=(0.3,), adjoint=True),
            "fun jumps",
        ),
        (
            iv.solve_ivp(
                lambda t, y, k: [-k * y[0], y[0] - y[1]],
                (0, 1),
                [1.0, 1.0],
                "radau",
                args=(1.0,),
                mass=singular,
                adjoint=True,
            ),
            "singular",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            sol.gradient(np.ones(len(sol.y)))


def test_wrong_input_is_said_by_name():
    sol = solved(t_span=(0, 1))
    for given, message in (
        ({}, "dG_dy"),
        ({"dG_dy": [1.0]}, r"dG_dy must have shape \(2,\)"),
        ({"dG_dy": [1.0, 1.0], "t": 2.0}, "t of gradient must be between 0.0 and 1.0"),
        ({"dG_dy": [1.0, 1.0], "dG_dp": [1.0]}, "dG_dp must have one number for each of 4"),
        ({"dG_dy": [1.0, 1.0], "wrt": "e"}, "no parameter 'e'"),
    ):
        with pytest.raises(ValueError, match=message):
            sol.gradient(**given)
