"""The message about a failed run advises only what applies: the cause that the state of the run shows, and no change of
what the user has not given."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

import invariode as iv
from cases import IMPLICIT, METHODS, families

RTOLS = (1e-3, 1e-6, 1e-9)


def ended(fun: Any, tf: float, y0: Any, method: str, **options: Any) -> tuple[Any, list[str]]:
    """Return the solution of a run that may fail, and the texts of invariode's warnings."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        with np.errstate(all="ignore"):
            sol = iv.solve_ivp(fun, (0, tf), y0, method, max_steps=4000, **options)
    return sol, [str(one.message) for one in given if one.category is not RuntimeWarning]


def robertson(t: float, y: Any) -> list[float]:
    """With its conservation law where the third equation should be: an algebraic equation, without mass=."""
    a, b, c = 0.04 * y[0], 3e7 * y[1] ** 2, 1e4 * y[1] * y[2]
    return [c - a, a - c - b, y[0] + y[1] + y[2] - 1]


def overflows(t: float, y: Any) -> list[float]:
    with np.errstate(over="ignore"):
        return [np.exp(y[0] ** 2)]


#: f, y0, and a time after the singularity.
BLOW_UPS = {
    "square": (lambda t, y: [y[0] ** 2], [1.0], 5.0),
    "exp": (lambda t, y: [math.exp(min(y[0], 700.0))], [0.0], 5.0),
    "overflow": (overflows, [0.0], 5.0),
    "vertical tangent": (lambda t, y: [-1 / y[0]], [1.0], 5.0),
    "robertson": (robertson, [1.0, 0.0, 0.0], 40.0),
}


@pytest.mark.parametrize("method", METHODS)
def test_a_blow_up_is_no_discontinuity_and_no_fault_of_a_jacobian(method: str) -> None:
    failed = 0
    for name, (fun, y0, tf) in BLOW_UPS.items():
        for rtol in RTOLS:
            sol, said = ended(fun, tf, y0, method, rtol=rtol, atol=rtol)
            texts = [sol.message, *said]
            wrong = ("jac",) if name == "vertical tangent" else ("jac", "jump", "discontinuous")  # 1/y jumps at 0
            assert not [one for one in texts if any(word in one for word in wrong)], (name, rtol, texts)
            failed += sol.status == -1
            if sol.status == -1 and "below its smallest" in sol.message and name != "vertical tangent":
                assert "singularity" in sol.message, (name, rtol, sol.message)
    assert failed >= len(RTOLS)


def test_an_algebraic_equation_in_fun_is_named_unless_there_is_a_mass_matrix() -> None:
    sol, _ = ended(robertson, 40, [1.0, 0, 0], "ode15s")
    assert "pass mass=" in sol.message
    assert "1.91e+39" in sol.message
    massive, _ = ended(lambda t, y: [y[0] ** 2, y[0] - y[1]], 5, [1.0, 1.0], "ode15s", mass=np.diag([1.0, 0]))
    assert "singularity" in massive.message
    assert "mass=" not in massive.message


def root(x: Any) -> Any:
    with np.errstate(invalid="ignore"):
        return np.sqrt(x)


def logarithm(x: Any) -> Any:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(x)


#: f, y0, a time after the one at which a component reaches 0, and that component.
UNDEFINED = {
    "root": (lambda t, y: [-root(y[0])], [1.0], 3.0, 0),
    "log": (lambda t, y: [logarithm(y[0]) - 1], [1.0], 2.0, 0),
    "stiff": (lambda t, y: [-1e3 * (y[0] - root(y[1])), -root(y[1])], [1.0, 1.0], 3.0, 1),
    "many": (lambda t, y: [*(-y[:5] * 10), -root(y[5]), *(-y[6:])], [1.0] * 20, 3.0, 5),
}


@pytest.mark.parametrize("method", [one for one in METHODS if one != "taylor"])
def test_a_component_below_zero_of_which_fun_is_not_finite_is_named(method: str) -> None:
    for name, (fun, y0, tf, component) in UNDEFINED.items():
        for rtol in RTOLS:
            sol, said = ended(fun, tf, y0, method, rtol=rtol, atol=rtol)
            if sol.status >= 0:  # a step may end exactly at 0, and stay there
                assert sol.y[component, -1] == 0, (name, rtol)
                continue
            assert not [one for one in [sol.message, *said] if "jac" in one], (name, rtol, sol.message)
            if sol.status == -1:
                assert f"pass nonnegative=[{component}]" in sol.message, (name, rtol, sol.message)


def test_nonnegative_is_not_advised_where_it_is_given() -> None:
    fun, y0, tf, _ = UNDEFINED["log"]
    for method in ("ode45", "ode15s", "radau"):
        sol, _ = ended(fun, tf, y0, method, nonnegative=True)
        assert "nonnegative" not in sol.message


@pytest.mark.parametrize("method", IMPLICIT)
def test_a_jacobian_is_in_doubt_only_if_the_user_gave_one(method: str) -> None:
    def fun(t: float, y: Any) -> Any:
        return [-1 / y[0], -y[1]]

    for options, doubt in (
        ({"jac": lambda t, y: [[1 / y[0] ** 2, 0], [0, -1]]}, "A wrong jac may be"),
        ({"jac_sparsity": np.eye(2)}, "jac_sparsity or band"),
        ({}, ""),
    ):
        sol, _ = ended(fun, 5, [1.0, 1], method, **options)
        if "Newton" in sol.message:
            assert doubt in sol.message
        assert bool(doubt) >= ("jac" in sol.message)


def test_times_near_t0_that_cannot_be_told_apart_are_no_breakpoint() -> None:
    """h' = 1e-8/h in Unix seconds: within one spacing of t, h grows more than twentyfold."""
    for method in IMPLICIT:
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            sol = iv.solve_ivp(lambda t, h: 1e-8 / h, (1.6e9, 1.6e9 + 86400), [1e-8], method)
        assert not [one for one in given if "breakpoints" in str(one.message)], method
        assert "breakpoints" not in sol.message, method
        assert sol.success or "measure t from 1.6e+09" in sol.message, sol.message


@families
def test_listed_times_are_the_doubles_that_breakpoints_need(method: str) -> None:
    switch = 1 / 3
    jump: Any = lambda t, y: [float(str(-y[0])) + 9 * (float(str(t)) >= switch)]  # noqa: E731
    sol, said = ended(jump, 1, [1.0], method, rtol=1e-7, atol=1e-9)
    if sol.stats.discontinuities:
        assert f"breakpoints=[{switch!r}]" in said[0]


def test_inputs_that_begin_too_late_are_not_told_to_be_of_the_kind_that_they_are() -> None:
    late = iv.Input([1.0, 2], [0.0, 1])
    with pytest.raises(ValueError, match=r"give values from the start on$"):
        iv.Problem(lambda t, y, u: [u], (0, 3), [0.0], inputs=late)
    short = iv.Input([0.0, 2], [0.0, 1], "linear")
    with pytest.raises(ValueError, match="to the end, or kind='previous'"):
        iv.Problem(lambda t, y, u: [u], (0, 3), [0.0], inputs=short)
    with pytest.raises(ValueError, match=r"must increase, got 1, 1$"):
        iv.Input([0.0, 1, 1], [0.0, 1, 2])
    with pytest.raises(ValueError, match="kind='previous'"):
        iv.Input([0.0, 1, 1], [0.0, 1, 2], "linear")


def test_a_gradient_does_not_warn_of_the_end_of_the_run() -> None:
    """The values of f from there on have no part in it."""
    fun: Any = lambda t, y, p: [-p * y[0] + (1.0 if float(str(t)) < 2 else 0.0)]  # noqa: E731
    for method in ("ode45", "ode15s", "radau"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", iv.DiscontinuityWarning)
            sol = iv.solve_ivp(fun, (0, 2), [1.0], method, args=(0.5,), adjoint=True, rtol=1e-7, atol=1e-7)
        found = sol.gradient([1.0])  # d/dp of e^(-2p) + (1 - e^(-2p)) / p
        e, p = math.exp(-1.0), 0.5
        exact = -2 * e + (2 * e * p - (1 - e)) / p**2
        np.testing.assert_allclose(found, [exact], rtol=1e-5)


def test_a_gradient_whose_backward_run_fails_gives_the_time_of_the_problem() -> None:
    fun: Any = lambda t, y, p: [p * y[0] + np.sqrt(abs(4 - y[0]))]  # noqa: E731
    sol = iv.solve_ivp(fun, (0, 2), [1.0], "ode15s", args=(0.5,), adjoint=True, rtol=1e-9, atol=1e-9)
    with pytest.raises(iv.SolveError, match="run backwards from t = 2 fails at t = ") as raised:
        sol.gradient([1.0])
    assert "terminal event" not in str(raised.value)
    crossed = float(str(raised.value).partition("fails at t = ")[2].partition(":")[0])
    inside = iv.solve_ivp(fun, (0, 2), [1.0], "ode15s", args=(0.5,), t_eval=[crossed], rtol=1e-9, atol=1e-9)
    assert abs(inside.y[0, 0] - 4) < 1e-3


def test_smooth_problems_of_the_literature_are_solved_without_a_word() -> None:
    """Stiff E1 of Enright, Hull and Lindberg, and nonstiff E1 of Hull, Enright, Fellen and Sedgwick, by auto."""

    def stiff(t: float, y: Any) -> Any:
        return [
            y[1],
            y[2],
            y[3],
            (y[0] ** 2 - np.sin(y[0]) - 1e8) * y[0]
            + (y[1] * y[2] / (y[0] ** 2 + 1) - 4e6) * y[1]
            + (1 - 6e4) * y[2]
            + (10 * np.exp(-(y[3] ** 2)) - 4e2) * y[3]
            + 1,
        ]

    def bessel(t: float, y: Any) -> Any:
        return [y[1], -y[1] / (t + 1) - (1 - 0.25 / (t + 1) ** 2) * y[0]]

    for fun, y0, tf in ((stiff, [0.0] * 4, 1), (bessel, [0.6713967071418030, 0.09540051444747446], 20)):
        for k in range(2, 11):
            sol, said = ended(fun, tf, y0, "auto", rtol=10.0**-k, atol=10.0**-k)
            assert sol.success
            assert not said, (tf, k, said)


def test_functions_with_the_state_before_time_are_noticed():
    """By whatever name of the state; not where time is first, or the second is something else."""
    for fun in (lambda x, t: -x, lambda state, time: -state):
        with pytest.warns(UserWarning, match=r"is called as fun\(t, y\): swap them, or use odeint"):
            iv.solve_ivp(fun, (0, 1), [1.0])
    with pytest.warns(UserWarning, match=r"action has the parameters \(y, t\)"):
        iv.Event(lambda t, y: y[0], action=lambda y, t: y)
    for fun in (lambda t, T: -T, lambda time, t: -t, lambda s, theta: -theta):
        iv.solve_ivp(fun, (0, 1), [1.0], events=fun)


def test_exchanged_arguments_are_noticed_by_their_names():
    """One rule for all functions that users give: forces, residuals, Jacobians, invariants, second-order equations."""
    system = iv.MechanicalSystem
    calls = [
        (r"force has the parameters \(q, v, t\) and is called as force\(t, q, v\)", lambda f: system([1], f), 0),
        ("force", lambda f: system([1], f), 1),
        ("force", lambda f: system([1], f), 2),
        ("energy", lambda f: system([1], lambda t, q, v: [0], energy=f), 1),
        ("constraints", lambda f: system([1], lambda t, q, v: [0], constraints=f), 4),
        ("mass", lambda f: system(f, lambda t, q, v: [0]), 4),
        (r"F has the parameters \(t, yp, y\) and is called as F\(t, y, yp\)", lambda f: iv.Dae(f, 0, [1.0]), 3),
        ("jac", lambda f: iv.Problem(lambda t, y: -y, (0, 1), [1.0], jac=f), 4),
        ("the invariant", iv.Invariants, 4),
        ("fun", iv.SecondOrder, 4),
    ]
    functions = [
        lambda q, v, t: [v[0]],
        lambda t, v, q: [v[0]],
        lambda t, qdot, q: [q[0]],
        lambda t, yp, y: [y[0] - yp[0]],
        lambda q, t: [q[0]],
    ]
    for name, call, k in calls:
        with pytest.warns(UserWarning, match=name):
            call(functions[k])
    for force in (lambda t, q, v: [q[0]], lambda t, x, xdot: [x[0]], lambda time, y, w: [y[0]], lambda s, a, b: [a[0]]):
        system([1], force)


def test_misspelt_options_of_events_are_named():
    def down(t, y):
        return y[0] - 0.5

    with pytest.raises(TypeError, match="Event has no argument 'isterminal'; did you mean 'terminal'"):
        iv.Event(down, isterminal=True)
    down.terminate = True
    with pytest.warns(UserWarning, match="the attribute terminate of down has no meaning; did you mean terminal"):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], events=down)


@pytest.mark.parametrize(("given", "meant"), [("lsoda", "LSODA"), ("Ode45", "ode45"), ("vode", "ode15s")])
def test_methods_of_other_packages_have_counterparts(given, meant):
    with pytest.raises(ValueError, match=f"(did you mean|its counterpart is) '{meant}'"):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], given)


def test_an_inconsistent_start_names_the_equation_that_is_farthest_off():
    def no_solution(t, y):
        return [-y[0], y[1] ** 2 + 4]

    with pytest.raises(ValueError, match=r"the largest, component 1, is 13 at y0"):
        iv.solve_ivp(no_solution, (0, 1), [1.0, 3.0], "ode15s", mass=np.diag([1.0, 0.0]))
