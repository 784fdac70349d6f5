"""Sensitivities: which parameters, derivatives of functions with respect to them, and what is refused."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from scipy import sparse

import invariode as iv
import invariode.scipy
from invariode._functions.derivatives import Given, derivative_of
from invariode._functions.with_arguments import Point
from invariode._problem.parameters import parameter_names, values_of, with_values
from parametric import ROBERTSON, TOLERANCES, decay, robertson


def nothing(t, y, k1, k2, p):
    return y


ARGS = (1.0, 2, np.array([3.0, 4.0, 5.0]))


class TestNames:
    @pytest.mark.parametrize(
        ("wanted", "names"),
        [
            (True, ["k1", "k2", "p[0]", "p[1]", "p[2]"]),
            ("k2", ["k2"]),
            (["p[2]", 0], ["p[2]", "k1"]),
            ("p", ["p[0]", "p[1]", "p[2]"]),
            ("args[1]", ["k2"]),
            (["y0[prey]", "y0[1]"], ["y0[prey]", "y0[foxes]"]),
            ("y0", ["y0[prey]", "y0[foxes]"]),
        ],
    )
    def test_are_those_of_the_arguments_of_f_and_of_components(self, wanted, names):
        found = parameter_names(nothing, ARGS, ["prey", "foxes"], 2, wanted)
        assert [one.name for one in found] == names

    def test_of_further_arguments_are_their_places(self):
        found = parameter_names(lambda t, y, *args: y, (1.0, [2.0, True, (3.0,)], "x"), None, 1, wanted=True)
        assert [one.name for one in found] == ["args[0]", "args[1][0]", "args[1][2][0]"]

    def test_values_come_back_from_where_they_were_put(self):
        names = parameter_names(nothing, ARGS, None, 2, [1, "p[1]", "y0[0]"])
        args, y0 = with_values(ARGS, np.array([7.0, 8.0]), names, [10.0, 20.0, 30.0])
        assert values_of(args, y0, names).tolist() == [10.0, 20.0, 30.0]
        assert values_of(ARGS, np.array([7.0, 8.0]), names).tolist() == [2.0, 4.0, 7.0]

    @pytest.mark.parametrize(
        ("wanted", "error", "message"),
        [
            ("k_2", ValueError, r"nothing takes no parameter 'k_2'; parameters are k1, k2, .*did you mean 'k2'\?"),
            ("y0[pray]", ValueError, r"did you mean 'y0\[prey\]'\?"),
            (3, ValueError, "there is no argument 3, args has 3: k1, k2"),
            (1.5, TypeError, "must be True, names or indices of arguments, got 1.5"),
            (["k1", 0], ValueError, "k1 is given twice"),
            ([], ValueError, "must name a parameter"),
        ],
    )
    def test_that_nothing_has_are_refused_with_the_nearest(self, wanted, error, message):
        with pytest.raises(error, match=message):
            iv.Problem(nothing, (0, 1), [1.0, 2.0], args=ARGS, labels=["prey", "foxes"], sensitivities=wanted)


def real_only(t, y, k1, k2, k3):
    return [math.fsum([value]) for value in robertson(t, y, k1, k2, k3)]


def guarded(t, y, k1, k2, k3):
    try:  # which tracing refuses
        return np.array(robertson(t, y, k1, k2, k3))
    finally:
        pass


def jac(t, y, k1, k2, k3):
    row, last = [-k1, k2 * y[2], k2 * y[1]], [0.0, 2 * k3 * y[1], 0.0]
    return np.array([row, [-a - b for a, b in zip(row, last, strict=True)], last])


def dfdp(t, y, *rates):
    a, b, c = -y[0], y[1] * y[2], y[1] ** 2
    return np.array([[a, b, 0.0], [-a, -b, -c], [0.0, 0.0, c]])


@pytest.mark.parametrize(
    ("fun", "given", "how", "tolerance"),
    [
        (robertson, None, "traced", 4e-16),
        (iv.compile(robertson), None, "traced", 4e-16),
        (guarded, None, "complex step", 4e-16),
        (real_only, None, "differences", 1e-9),
        (real_only, Given(jac, dfdp), "given", 4e-16),
        (robertson, Given(None, dfdp), "given and traced", 4e-16),
        (guarded, Given(jac), "given and complex step", 4e-16),
    ],
)
def test_derivatives_of_functions_are_the_same_however_they_are_formed(fun, given, how, tolerance):
    args, y = ROBERTSON["args"], np.array([0.9, 1e-5, 0.1])
    names = parameter_names(robertson, args, None, 3, wanted=True)
    S = np.random.default_rng(1).standard_normal((3, 3))
    made = derivative_of(fun, (None, 3), given, at=Point(0.0, y), args=args, names=names)
    exact = S @ jac(0, y, *args).T + dfdp(0, y).T
    assert made.how == how
    np.testing.assert_allclose(made.tangent(0.0, np.vstack([y, S])), exact, rtol=tolerance)
    np.testing.assert_allclose(made.along(0.0, y, 0.0, S[1], np.eye(3)[1]), exact[1], rtol=tolerance)


def test_differences_are_used_with_a_warning():
    with pytest.warns(iv.AccuracyWarning, match=r"the derivatives of fun are differences, .* give jac, and"):
        sol = iv.solve_ivp(real_only, (0, 0.1), [1.0, 0, 0], "radau", **ROBERTSON, sensitivities=True)
    assert sol.stats.sensitivities == "differences"


def test_every_form_of_a_jacobian_that_runs_take_serves_their_sensitivities():
    """A function, machine code, a constant, a sparse matrix and bands all give S and the gradient, without warnings, of
    an f that can neither be traced nor take complex numbers."""

    def turn(t, y, w):
        try:
            return [w * float(y[1]), -w * float(y[0])]
        finally:
            pass

    def square(t, y, w):
        return [[0.0, w], [-w, 0.0]]

    def bands(t, y, w):
        return [[0.0, w], [0.0, 0.0], [-w, 0.0]]

    given = iv.Sensitivities(dfdp=lambda t, y, w: [y[1], -y[0]])  # a column as a vector
    forms = [square, iv.compile(square), square(0, 0, 2.0), lambda t, y, w: sparse.csr_array(square(t, y, w))]
    forms += [iv.Banded(1, 1, one) for one in (bands, iv.compile(bands), bands(0, 0, 2.0))]
    for jac in forms:
        sol = iv.solve_ivp(turn, (0, 1), [1.0, 0.0], "ode15s", args=(2.0,), jac=jac, rtol=1e-7, atol=1e-9,
                           sensitivities=given, adjoint=True)  # fmt: skip
        assert sol.stats.sensitivities == "given"
        np.testing.assert_allclose(sol.sensitivities[:, 0, -1], [-np.sin(2), -np.cos(2)], atol=2e-5)
        np.testing.assert_allclose(sol.gradient([1.0, 0.0]), -np.sin(2), atol=2e-5)
        assert iv.check_sensitivities(
            iv.Problem(turn, (0, 1), [1.0, 0.0], args=(2.0,), jac=jac, sensitivities=given)
        ).ok

    def square_of_radius(t, y, w):
        try:
            return y @ y
        finally:
            pass

    radius = iv.Invariants(square_of_radius, jac=iv.compile(lambda t, y, w: [2 * y[0], 2 * y[1]]))
    sol = iv.solve_ivp(turn, (0, 1), [1.0, 0.0], "ode15s", args=(2.0,), jac=square, rtol=1e-7, invariants=radius,
                       sensitivities=given)  # fmt: skip
    assert "invariant square_of_radius: given and complex step" in sol.stats.sensitivities


def test_a_count_is_no_parameter():
    with pytest.raises(TypeError, match=r"no derivative with respect to steps = 3, .* name the other parameters"):
        iv.solve_ivp(
            lambda t, y, steps: [sum(y[0] for _ in range(steps))], (0, 1), [1.0], args=(3,), sensitivities=True
        )


def test_given_derivatives_are_compared():
    right = iv.Sensitivities(dfdp=lambda t, y, rate: [[-y[0]]], dy0dp=[[2.0]])
    wrong = iv.Sensitivities(dfdp=lambda t, y, rate: [[y[0]]], dy0dp=[[3.0]])
    problem = iv.Problem(decay, (0, 1), [2.0], args=(2.0,), sensitivities=right, jac=[[-2.0]])
    assert iv.check_sensitivities(problem, y0=lambda rate: [rate**2 / 2]).ok
    report = iv.check_sensitivities(problem.replace(sensitivities=wrong), y0=lambda rate: [rate**2 / 2])
    assert report.findings == [
        "dfdp[0, 0], of rate, is 2 at t = 0; expected -2",
        "dy0dp[0, 0], of rate, is 3; expected 2",
    ]
    assert "dfdp" in str(report)


def test_the_start_depends_on_a_parameter():
    given = iv.Sensitivities(dy0dp=lambda rate: [[2 * rate]])
    sol = iv.solve_ivp(decay, (0, 1), [4.0], args=(2.0,), **TOLERANCES, sensitivities=given)
    assert sol.sensitivities[0, 0, -1] == pytest.approx((4 - 4) * np.exp(-2), abs=1e-7)


def test_scales_set_the_tolerance():
    """A parameter of larger scale has a smaller threshold, and the steps are shorter."""
    few, many = (
        iv.solve_ivp(
            decay, (0, 1), [1e-9], args=(0.0,), atol=1e-6, sensitivities=iv.Sensitivities(scale={"rate": scale})
        ).stats.steps
        for scale in (1.0, 1e9)
    )
    assert few <= many


@pytest.mark.parametrize(
    ("sensitivities", "message"),
    [
        (iv.Sensitivities(dfdp=lambda t, y, rate: [1.0, 2.0]), r"dfdp of fun has shape"),
        (iv.Sensitivities(dy0dp=[1.0, 2.0]), r"dy0dp must have shape \(1, 1\)"),
        (iv.Sensitivities(scale=-1), "scale of Sensitivities must be positive, got -1"),
        (iv.Sensitivities(scale={"ratio": 1}), "did you mean 'rate'"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(sensitivities, message):
    with pytest.raises(ValueError, match=message):
        iv.solve_ivp(decay, (0, 1), [1.0], args=(2.0,), sensitivities=sensitivities)


def test_fields_are_checked_when_they_are_made():
    with pytest.raises(TypeError, match="dfdp of Sensitivities must be a function"):
        iv.Sensitivities(dfdp=3)
    with pytest.raises(TypeError, match="error_test of Sensitivities must be True or False"):
        iv.Sensitivities(error_test=1)
    assert pickle.loads(pickle.dumps(iv.Sensitivities("rate"))).args == "rate"


def test_steppers_refuse_them():
    with pytest.raises(ValueError, match="steps y alone: sensitivities are those of solve_ivp"):
        invariode.scipy.ODE45(lambda t, y: -y, 0, [1.0], 1, sensitivities="y0")


@pytest.mark.parametrize("compiled", [True, False])
def test_problems_from_formulas_name_their_parameters(compiled):
    sympy = pytest.importorskip("sympy")
    from invariode import symbolic

    x, v, k = sympy.symbols("x v k")
    problem = symbolic.equations({x: v, v: -k * x}, parameters={k: 2.25}).problem((0, 1), [1.0, 0.0], compiled=compiled)
    sol = problem.replace(sensitivities=["k", "y0[x]"]).solve("ode45", **TOLERANCES)
    assert sol.stats.sensitivities == "traced"
    np.testing.assert_allclose(sol.sensitivities[0, :, -1], [-np.sin(1.5) / 3, np.cos(1.5)], rtol=1e-6)


@pytest.mark.parametrize(
    ("y0", "error", "message"),
    [
        ([1.5], TypeError, "y0 of Sensitivities must be True, labels or indices, got 1.5"),
        (1, ValueError, "y0 of Sensitivities has components 0 to 0, got 1"),
    ],
)
def test_components_are_labels_or_indices(y0, error, message):
    with pytest.raises(error, match=message):
        iv.Problem(decay, (0, 1), [1.0], args=(2.0,), sensitivities=iv.Sensitivities(y0=y0))


def test_complex_steps_that_fail_later_are_a_warning():
    ways = [abs, lambda x: x]

    def fun(t, y, p):
        return [-p * ways[int(t < 1)](y[0])]

    with pytest.warns(iv.AccuracyWarning, match="complex steps through fun do not give its derivatives"):
        iv.solve_ivp(fun, (0, 2), [1.0], args=(1.0,), breakpoints=[1.0], sensitivities=True)


def test_what_has_no_sensitivities_is_refused_by_name():
    with pytest.raises(ValueError, match="has an argument 'y0'"):
        iv.solve_ivp(lambda t, y, y0: [y0 - y[0]], (0, 1), [2.0], args=(0.5,), sensitivities="y0")


@pytest.mark.parametrize("mass", [np.diag([1.0, 0.0]), np.diag([1.0, 2.0])])
def test_beside_a_mass_matrix_fun_need_not_be_traceable(mass):
    """The derivatives of fun are complex steps then, as without one."""

    def fun(t, y, rate):
        if type(y) is not np.ndarray:
            raise TypeError("not an array")
        return [-rate * y[0], y[0] - y[1]]

    sol = iv.solve_ivp(fun, (0, 1), [1.0, 1.0], "radau", args=(0.5,), rtol=1e-8, mass=mass, sensitivities=True)
    assert sol.sensitivities[0, 0, -1] == pytest.approx(-np.exp(-0.5), abs=1e-6)
