"""Derivatives of functions whose formula is singular where the function is not, however they are formed and used."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, SERIES, dealt
from invariode._base.matrices import as_matrix
from invariode._functions.derivatives import derivative_of
from invariode._functions.with_arguments import Point
from invariode._studies.fit import fit as fitting
from invariode._studies.fit.uncertainty import _inverse


def hill(t, x, n, K):
    return [1 / (1 + (x[1] / K) ** n) - 0.5 * x[0], 0.3 * x[0] - 0.2 * x[1]]


def untraced(fun):
    """Return the function in a form that cannot be traced."""

    def with_try(t, y, *args):
        try:
            return fun(t, y, *args)
        finally:
            pass

    return with_try


#: f, its interval, start, parameters, the options, and ∂y/∂p at the end.
SINGULAR = {
    "power of t": (
        lambda t, y, n: [t**n],
        (0, 2),
        [0.0],
        (2.5,),
        {},
        [[2**3.5 / 3.5 * (np.log(2) - 1 / 3.5)]],
    ),
    "Hill": (hill, (0, 20), [0.0, 0.0], (2.5, 0.4), {}, [[-0.06029], [-0.08662]]),
    "norm": (
        lambda t, y, k: [-k * y[0], -k * y[1], np.linalg.norm(y[:2]) + k],
        (0, 1),
        [0.0, 0.0, 0.0],
        (1.5,),
        {},
        [[0.0], [0.0], [1.0]],
    ),
    "root of squares": (
        lambda t, y, k: [-k * y[0], -k * y[1], np.sqrt(y[0] ** 2 + y[1] ** 2) + k],
        (0, 1),
        [0.0, 0.0, 0.0],
        (1.5,),
        {},
        [[0.0], [0.0], [1.0]],
    ),
    "hypot": (
        lambda t, y, k: [-k * y[0], -k * y[1], np.hypot(y[0], y[1]) + k],
        (0, 1),
        [0.0, 0.0, 0.0],
        (1.5,),
        {},
        [[0.0], [0.0], [1.0]],
    ),
    "mask": (
        lambda t, y, n: [(t > 0.5) * np.abs(t - 0.5) ** n],
        (0, 1.5),
        [0.0],
        (2.5,),
        {"breakpoints": [0.5]},
        [[-1 / 3.5**2]],
    ),
    "an empty tank": (
        lambda t, y, k: [-k * np.sqrt(y[0]) - 0.1 + 0.5 * (t > 1.0), k * np.sqrt(y[0]) - y[1]],
        (0, 4),
        [0.0, 1.0],
        (1.5,),
        {"nonnegative": True, "breakpoints": [1.0]},
        [[-0.0946722], [0.0097996]],
    ),
}
#: Of the references with few digits, and of methods of order 2.
CLOSE = 2e-5


@pytest.mark.filterwarnings("ignore::invariode.AccuracyWarning")  # of differences, where f is not traced
@dealt(
    len(METHODS) * len(SINGULAR) // 2,
    method=METHODS,
    name=SINGULAR,
    form=["Python", "compiled", "untraced"],
)
def test_a_formula_that_is_singular_where_the_function_is_not_has_its_derivatives(method, name, form):
    """0ⁿ, the norm of 0, masked branches, and √h of what a bound holds at 0: forwards and backwards."""
    fun, span, start, args, options, expected = SINGULAR[name]
    fun = {"Python": lambda f: f, "compiled": iv.compile, "untraced": untraced}[form](fun)
    tol = 1e-5 if iv.METHODS[method].order <= 2 or method == "ode23" else 1e-7
    sol = iv.solve_ivp(
        fun, span, start, method, args=args, rtol=tol, atol=tol / 10, sensitivities=True, adjoint=True, **options
    )
    assert sol.success, sol.message
    close = CLOSE + 100 * tol
    np.testing.assert_allclose(sol.sensitivities[:, :1, -1], expected, rtol=0, atol=close)
    if (method, name) == ("ode23s", "an empty tank"):
        return  # λ' is infinite where the tank begins to fill, the end of the run backwards: ode23s says that it fails
    for i, one in enumerate(np.eye(len(start))):
        np.testing.assert_allclose(sol.gradient(one)[:1], expected[i], rtol=0, atol=close)


@pytest.mark.parametrize("name", ["power of t", "Hill"])
def test_a_fit_starts_where_the_formula_of_a_derivative_is_singular(name):
    """Data without noise give the parameters back."""
    fun, span, start, args, options, _ = SINGULAR[name]
    times = np.linspace(*span, 9)[1:]
    problem = iv.Problem(fun, span, start, args=args)
    data = problem.solve("dop853", t_eval=times, rtol=1e-10, atol=1e-12, **options).y
    names = iv.Problem(fun, span, start, args=args, sensitivities=True).parameter_names()
    around = {one.name: iv.Parameter(1.1 * value, (0.2, 5.0)) for one, value in zip(names, args, strict=True)}
    found = iv.fit(problem, times, data, around, sigma=1e-3, rtol=1e-8)
    np.testing.assert_allclose([found.parameters[one.name] for one in names], args, rtol=1e-4)


def test_a_function_without_a_derivative_is_named_with_its_argument():
    """√y leaves 0 faster than any multiple of y: dy/dk does not exist at the start, and the message says of what."""
    sol = iv.solve_ivp(lambda t, y, k: [-np.sqrt(k - y[0])], (0, 1), [1.0], "dop853", args=(1.0,), sensitivities=True)
    assert "sqrt((k - y[0])) has none" in sol.message
    assert "Correct fun or y0" not in sol.message


@pytest.mark.parametrize("how", ["traced", "differences"])
def test_derivatives_that_are_not_finite_are_mended_from_one_side(how):
    """x^0.5 y at (0, 0), along y alone: 0 · ∞ in the formula, and 0 in truth; x^1.5 is defined on one side of 0."""

    def fun(t, y, n):
        return [y[1] * y[0] ** 0.5, y[0] ** 1.5, abs(y[0]) ** n]

    at = Point(0.0, np.array([0.5, 1.0]))
    problem = iv.Problem(fun, (0, 1), at.y, args=(2.5,), sensitivities=True)
    names = problem.parameter_names()
    made = derivative_of(fun if how == "traced" else untraced(fun), (3, 2), at=at, args=(2.5,), names=names)
    assert made.how == how
    origin = np.zeros(2)
    found = made.columns(0.0, origin, np.zeros(2), np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]))
    np.testing.assert_array_equal(found, np.zeros((2, 3)))
    np.testing.assert_allclose(made.along(0.0, origin, 0.0, np.array([1.0, 0.0]), np.zeros(1))[1], 0.0, atol=1e-2)


def test_an_invariant_is_held_where_the_formula_of_its_derivative_is_singular():
    """a √b at a = b = 0 is defined on one side of b and has the derivative 0, in the formula 0 · ∞: with derivatives by
    complex steps, from the graph and by differences."""

    def turn(t, y):
        return [y[1], -y[0], 0 * y[2], 0 * y[3]]

    def g(t, y):
        return y[0] ** 2 + y[1] ** 2 + y[2] * np.sqrt(y[3])

    def of_reals(t, y):
        return g(t, [float(one) for one in y])

    forms = {"complex step": g, "traced": iv.compile(g), "differences": of_reals}
    for method in ("ode45", "ode15s", "radau"):
        for how, invariant in forms.items():
            with np.errstate(invalid="ignore"):  # outside the domain of g
                sol = iv.solve_ivp(turn, (0, 10), [1.0, 0.0, 0.0, 0.0], method, invariants=invariant)
            assert sol.success
            assert how in sol.stats.derivatives
            assert np.abs(sol.residual).max() < 1e-6  # the tolerance is 1e-3


def test_given_matrices_have_one_form():
    """A row, a column and a number may be given as such, by everything that takes a matrix."""
    row, column = as_matrix("jac", [1.0, 2.0], (1, 2)), as_matrix("jac", [1.0, 2.0], (2, 1))
    assert (row.shape, column.shape) == ((1, 2), (2, 1))
    assert as_matrix("jac", -3.0, (1, 1)).shape == as_matrix("jac", [-3.0], (1, 1)).shape == (1, 1)
    with pytest.raises(ValueError, match=r"jac has shape \(2,\) at t = 0.5, expected shape \(2, 2\)"):
        as_matrix("jac", [1.0, 2.0], (2, 2), at=0.5)


@pytest.mark.filterwarnings("ignore::invariode.AccuracyWarning")
@pytest.mark.parametrize("method", ["dop853", "ode15s", "radau"])
def test_a_gradient_of_an_invariant_and_a_rate_are_given_as_users_write_them(method):
    """jac of shape (n,) for one invariant, and [−k] for one component, where nothing can be traced."""

    @untraced
    def circle(t, y, w):
        return [w * y[1], -w * y[0]]

    radius = iv.Invariants(untraced(lambda t, y, w: y @ y), jac=lambda t, y, w: 2 * y)
    sol = iv.solve_ivp(circle, (0, 1), [1.0, 0.0], method, args=(2.0,), invariants=radius, rtol=1e-7, atol=1e-9,
                       sensitivities=True, adjoint=True)  # fmt: skip
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], [-np.sin(2), -np.cos(2)], atol=1e-5)
    np.testing.assert_allclose(sol.gradient([1.0, 0.0]), -np.sin(2), atol=1e-5)
    given = {"jac": lambda t, y, k: [-k]} if "jac" in METHODS[method].options else {}
    decay = untraced(lambda t, y, k: [-k * y[0]])
    sol = iv.solve_ivp(decay, (0, 1), [1.0], method, args=(2.0,), rtol=1e-7, atol=1e-9, sensitivities=True,
                       adjoint=True, **given)  # fmt: skip
    np.testing.assert_allclose([sol.sensitivities[0, 0, -1], *sol.gradient([1.0])], -np.exp(-2), atol=1e-5)


def test_a_start_at_rest_without_a_series():
    """t^2.5 is 0 at 0 and has no Taylor series there: the solution rests for the smallest step, and is right."""
    for method in SERIES:
        given = {"args": (2.5,), "sensitivities": True, "rtol": 1e-8, "atol": 1e-10}
        sol = iv.solve_ivp(lambda t, y, n: [t**n], (0, 2), [0.0], method, **given)
        assert sol.success
        y = 2**3.5 / 3.5
        np.testing.assert_allclose(sol.y_end, y, rtol=1e-6)
        np.testing.assert_allclose(sol.sensitivities[0, 0, -1], y * (np.log(2) - 1 / 3.5), rtol=1e-6)


# ----------------------------------------------------------------------------------------------------------------------
# Beside derivatives


def decaying(sigma=None, **options):
    problem = iv.Problem(lambda t, y, k: [-k * y[0]], (0, 4), [7.0], args=(1.0,))
    times = np.linspace(0.5, 4, 12)
    noise = 0.01 * np.random.default_rng(3).standard_normal(12)
    data = 7 * (np.exp(-0.5 * times) + noise)
    return iv.fit(problem, times, data, {"k": (0, 5)}, sigma=sigma, **options), times, data


def test_chi_squared_without_sigma_is_the_variance_of_the_data():
    found, times, data = decaying()
    squares = np.sum((7 * np.exp(-found.parameters["k"] * times) - data) ** 2)
    np.testing.assert_allclose(found.reduced_chi_squared, squares / 11, rtol=1e-3)
    np.testing.assert_allclose(found.reduced_chi_squared, found.sigma**2, rtol=1e-12)
    known, *_ = decaying(sigma=0.07)
    np.testing.assert_allclose(known.reduced_chi_squared, squares / 11 / 0.07**2, rtol=1e-3)


def test_a_fit_keeps_its_result_if_the_standard_errors_cannot_be_computed(monkeypatch):
    def fails(*args):
        raise MemoryError

    expected, *_ = decaying(sigma=0.07)
    monkeypatch.setattr(fitting, "uncertainty", fails)
    with pytest.warns(UserWarning, match="MemoryError"):
        found, *_ = decaying(sigma=0.07)
    assert found.parameters == expected.parameters
    assert np.isnan(found.standard_errors["k"])


def test_the_covariance_of_a_hundred_thousand_data_takes_no_square_matrix_of_them():
    rows = np.random.default_rng(1).standard_normal((100_000, 3))
    covariance, groups = _inverse(rows, 1e-10)
    np.testing.assert_allclose(covariance, np.linalg.inv(rows.T @ rows), rtol=1e-9, atol=1e-12)
    assert groups == []
    _, groups = _inverse(np.ones((2, 3)), 1e-10)
    assert len(groups) == 2


def test_no_points_have_residuals_of_each_value():
    for invariants, m in ((lambda t, y: y @ y, 1), ([lambda t, y: y, lambda t, y: y[0]], 3)):
        assert iv.impose(invariants, [], np.zeros((2, 0))).residual.shape == (m, 0)
    named = iv.Invariants(lambda t, y: [y[0], 1 / 0], names=["a", "b"])
    assert iv.impose(named, [], np.zeros((2, 0))).residual.shape == (2, 0)
