"""Sensitivities of complex states are those of the pairs of real and imaginary parts."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import dealt


def precession(t, y, w, g):
    """Two levels: analytic in y."""
    return [-1j * (w * y[0] + g * y[1]), -1j * (g * y[0] - w * y[1])]


def condensate(t, y, w, g):
    """With energies that depend on |y|²: not analytic."""
    a, b = precession(t, y, w, g)
    return [a - 1j * abs(y[0]) ** 2 * y[0], b - 1j * abs(y[1]) ** 2 * y[1]]


def untraced_precession(t, y, w, g):
    try:
        return np.array(precession(t, y, w, g))
    finally:
        pass


def in_reals(fun):
    def real(t, x, *args):
        values = fun(t, x[::2] + 1j * x[1::2], *args)
        return [part for value in values for part in (value.real, value.imag)]

    return real


def turned(t, y, w, g):
    return np.array([y[0] * np.exp(1j * g), w * y[1]])


def inside(t, y, w, g):
    return abs(y[0]) ** 2 - 0.7 * g


COMPLEX = {"args": (1.0, 1.1), "rtol": 1e-7, "atol": 1e-9, "sensitivities": True}


#: f, and what else the problem has, in complex and in real numbers.
PROBLEMS = {
    "analytic": (precession, {}, {}),
    "compiled": (iv.compile(precession), {}, {}),
    "untraced": (untraced_precession, {}, {}),
    "breakpoint": (condensate, {"breakpoints": {0.5: turned}}, {"breakpoints": {0.5: in_reals(turned)}}),
    "event": (
        condensate,
        {"events": iv.Event(inside, action=turned), "invariants": lambda t, y, w, g: (abs(y) ** 2).sum()},
        {
            "events": iv.Event(lambda t, x, w, g: x[0] ** 2 + x[1] ** 2 - 0.7 * g, action=in_reals(turned)),
            "invariants": lambda t, x, w, g: x @ x,
        },
    ),
}


# Of those that cannot be traced.
@pytest.mark.filterwarnings("ignore:sensitivities. the derivatives of fun:invariode.AccuracyWarning")
@dealt(10, name=PROBLEMS, method=["dop853", "ode113", "ode15s", "radau"])
def test_complex_states_have_those_of_their_parts(name, method):
    """The errors of two runs whose steps may differ."""
    fun, more, real = PROBLEMS[name]
    sol = iv.solve_ivp(fun, (0, 1), [1.0 + 0j, 0.5j], method, dense_output=True, **COMPLEX, **more)
    parts = iv.solve_ivp(in_reals(fun), (0, 1), [1.0, 0, 0, 0.5], method, **COMPLEX, **real)
    expected = parts.sensitivities[::2] + 1j * parts.sensitivities[1::2]
    np.testing.assert_allclose(sol.sensitivities[:, :, -1], expected[:, :, -1], atol=2e-5)
    np.testing.assert_allclose(sol.sol.sensitivities(1.0), sol.sensitivities[:, :, -1], atol=1e-15)
    if "events" in more:
        assert len(sol.t_events[0])
        after = parts.sensitivities_after_events[0]
        np.testing.assert_allclose(sol.sensitivities_t_events[0], parts.sensitivities_t_events[0], atol=2e-5)
        np.testing.assert_allclose(sol.sensitivities_after_events[0], after[:, ::2] + 1j * after[:, 1::2], atol=2e-5)


def test_complex_initial_values_are_parameters_of_an_analytic_f(tmp_path):
    given = {**COMPLEX, "sensitivities": iv.Sensitivities("w", y0=[1], dy0dp=[[1j], [0.5]])}
    problem = iv.Problem(precession, (0, 1), [1.0 + 0j, 0.5j], args=COMPLEX["args"], labels=["up", "down"])
    problem = problem.replace(sensitivities=given.pop("sensitivities"))
    sol = problem.solve("dop853", rtol=1e-10, atol=1e-12)
    assert sol.sensitivity_names == ["w", "y0[down]"]
    H = np.array([[1.0, 1.1], [1.1, -1.0]])
    omega = np.sqrt(1 + 1.1**2)  # H² = ω²
    propagator = np.cos(omega) * np.eye(2) - 1j * np.sin(omega) / omega * H
    np.testing.assert_allclose(sol.sensitivities[:, 1, -1], propagator[:, 1], atol=1e-9)
    start, still = np.array([1j, 0.5]), problem.replace(sensitivities="w").solve("dop853", rtol=1e-10, atol=1e-12)
    moved = still.sensitivities[:, 0, -1] + propagator @ start
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], moved, atol=1e-9)
    sol.save(tmp_path / "sol.npz")
    np.testing.assert_array_equal(iv.load(tmp_path / "sol.npz", problem).sensitivities, sol.sensitivities)
    rows = {"y0": [[1.0 + 0j, 0.5j]], "t_eval": [1.0], "workers": 1, "rtol": 1e-10, "atol": 1e-12}
    many = problem.replace(sensitivities=["y0[down]"]).solve_ensemble(method="dop853", **rows)
    np.testing.assert_allclose(many.sensitivities[0, :, 0, -1], propagator[:, 1], atol=1e-9)


def test_what_complex_problems_have_no_derivatives_of_is_refused_by_name():
    start = (0, 1), [1.0 + 0j, 0.5j], "ode15s"
    for fun, more, message in (
        (condensate, {"sensitivities": "y0"}, r"to y0\[0\]: fun is not analytic"),
        (precession, {"sensitivities": "y0", "events": inside}, r"to y0\[0\] of a complex problem .* with events"),
        (precession, {"mass": np.eye(2)}, "with a mass matrix"),
    ):
        with pytest.raises(ValueError, match=message):
            iv.solve_ivp(fun, *start, **{**COMPLEX, **more})
    problem = iv.Problem(precession, *start[:2], args=COMPLEX["args"], sensitivities=True)
    with pytest.raises(ValueError, match="check_sensitivities is for real problems"):
        iv.check_sensitivities(problem)
