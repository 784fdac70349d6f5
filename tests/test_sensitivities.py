"""Derivatives of the solution with respect to parameters: values in closed form, and laws."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import ALGEBRAIC, dealt, explicit_and_implicit, families, families_and_series
from invariode._functions.derivatives import derivative_of
from invariode._functions.with_arguments import Point
from parametric import RATES, ROBERTSON, TOLERANCES, kept, lotka_volterra, of_swinging, robertson, spring, swinging


@families_and_series
def test_sensitivities_are_as_accurate_as_the_solution(method):
    """The sensitivity to a frequency grows in proportion to t, and so do its errors, against those of y."""
    sol = iv.solve_ivp(spring, (0, 6), [1.0, 0.0], method, args=(1.5, 0.3), rtol=1e-6, atol=1e-8, sensitivities=True)
    error = np.abs(sol.y - swinging(sol.t, 1.5, 0.3)).max()
    assert np.abs(sol.sensitivities - of_swinging(sol.t, 1.5, 0.3)).max() <= 3 * 6 * error
    assert sol.stats.sensitivities == "traced"


@explicit_and_implicit
def test_units_of_parameters_change_nothing(method):
    """f(t, y, c q) has the derivative c ∂y/∂p, bit for bit if c is a power of 2: with thresholds atol / |p|."""
    run = {"method": method, "rtol": 1e-6, "sensitivities": True}
    plain = iv.solve_ivp(spring, (0, 2), [1.0, 0.0], args=(1.5, 0.3), **run)
    scaled = iv.solve_ivp(lambda t, y, w, q: spring(t, y, w, 4 * q), (0, 2), [1.0, 0.0], args=(1.5, 0.075), **run)
    assert np.array_equal(scaled.t, plain.t)
    assert np.array_equal(scaled.sensitivities[:, 1], 4 * plain.sensitivities[:, 1])


@explicit_and_implicit
def test_the_order_of_parameters_is_that_of_the_columns(method):
    run = {"method": method, "args": (1.5, 0.3), "rtol": 1e-6}
    there, back = (
        iv.solve_ivp(spring, (0, 2), [1.0, 0.0], **run, sensitivities=order) for order in (["w", "c"], ["c", "w"])
    )
    assert np.array_equal(there.sensitivities, back.sensitivities[:, ::-1])


@explicit_and_implicit
def test_the_order_of_components_is_that_of_the_rows(method):
    def turned(t, y, w, c):
        return [-w * w * y[1] + c, y[0]]

    run = {"method": method, "args": (1.5, 0.3), **TOLERANCES, "sensitivities": True, "t_eval": [2.0]}
    one, other = iv.solve_ivp(spring, (0, 2), [1.0, 0], **run), iv.solve_ivp(turned, (0, 2), [0, 1.0], **run)
    np.testing.assert_allclose(one.sensitivities, other.sensitivities[::-1], rtol=1e-6)


@explicit_and_implicit
def test_a_run_in_two_parts_and_one_there_and_back_are_right(method):
    """∂y/∂p of the first part is ∂y0/∂p of the second; back at the start it is what it was, 0."""
    run = {"rtol": 1e-9, "atol": 1e-11}
    problem = iv.Problem(spring, (0, 1), [1.0, 0.0], args=(1.5, 0.3), sensitivities=True)
    first = problem.solve(method, **run)
    start = {"y0": first.y[:, -1], "sensitivities": iv.Sensitivities(True, dy0dp=first.sensitivities[:, :, -1])}
    then = problem.replace(t_span=(1, 2), **start).solve(method, **run)
    back = problem.replace(t_span=(1, 0), **start).solve(method, **run)
    end = of_swinging(np.array([2.0]), 1.5, 0.3)[:, :, 0]
    np.testing.assert_allclose(then.sensitivities[:, :, -1], end, atol=1e-6)
    np.testing.assert_allclose(back.sensitivities[:, :, -1], 0, atol=1e-6)


@dealt(method=["ode45", "dop853", "ode113", "radau"], invariants=[None, kept])
def test_the_gradient_of_lotka_and_volterra(method, invariants):
    """dG/dp of G = |u(10) - 1|² / 2, where the form of the invariant depends on p."""
    published = [0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395]
    options = {"args": RATES, "rtol": 1e-10, "atol": 1e-12, "sensitivities": True, "invariants": invariants}
    sol = iv.solve_ivp(lotka_volterra, (0, 10), [1.0, 1.0], method, **options)
    found = (sol.y[:, -1] - 1) @ sol.sensitivities[:, :, -1]
    np.testing.assert_allclose(found, published, rtol=0, atol=1e-8)


@explicit_and_implicit
def test_where_an_invariant_is_held_so_is_its_derivative(method):
    """d/dp of g(y, p) = g(y0, p) at steps and between them, to roundoff."""
    problem = iv.Problem(
        lotka_volterra, (0, 4), [1.0, 1.0], args=RATES, invariants=kept, sensitivities=[*range(4), "y0"]
    )
    sol = problem.solve(method, rtol=1e-5, dense_output=True)
    names = problem.parameter_names()
    law = derivative_of(kept, (None, 2), at=Point(0.0, problem.y0), args=RATES, names=names)
    start = law.tangent(0.0, np.vstack([problem.y0, sol.sensitivities[:, :, 0].T]))
    for t in [*sol.t[::7], 1.234, 2.345]:
        Y = np.vstack([sol.sol(t), sol.sol.sensitivities(t).T])
        size = np.abs(Y).max()
        np.testing.assert_allclose(law.tangent(t, Y), start, rtol=0, atol=1e-10 * size)


@pytest.mark.parametrize("direction", ["gradient", "stages"])
def test_corrections_along_stages_hold_derivatives_too(direction):
    def orbit(t, y, mu):
        r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
        return [y[2], y[3], -mu * y[0] / r3, -mu * y[1] / r3]

    def laws(t, y, mu):
        return [(y[2] ** 2 + y[3] ** 2) / 2 - mu / np.sqrt(y[0] ** 2 + y[1] ** 2), y[0] * y[3] - y[1] * y[2]]

    y0 = np.array([0.5, 0, 0, 3**0.5])
    held = iv.Invariants(laws, direction=direction)
    problem = iv.Problem(orbit, (0, 10), y0, args=(1.0,), invariants=held, sensitivities=True)
    sol = problem.solve("ode45", rtol=1e-5)
    law = derivative_of(laws, (None, 4), at=Point(0.0, y0), args=(1.0,), names=problem.parameter_names())
    start, end = (law.tangent(0.0, np.vstack([sol.y[:, i], sol.sensitivities[:, :, i].T])) for i in (0, -1))
    np.testing.assert_allclose(end, start, rtol=0, atol=1e-10)


@pytest.mark.parametrize("method", ["ode15s", "radau", "auto"])
def test_robertson_at_the_start_of_the_fast_phase(method):
    sol = iv.solve_ivp(robertson, (0, 0.4), [1.0, 0, 0], method, **ROBERTSON, sensitivities="k1")
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], [-0.35595257, 3.9025e-4, 0.35556231], rtol=1e-4)


def test_algebraic_equations_are_differentiated():
    """y0 + y1 + y2 = 1 as an equation: its derivatives hold from the start, which is made consistent."""

    def algebraic(t, y, k1, k2, k3):
        return [*robertson(t, y, k1, k2, k3)[:2], y[0] + y[1] + y[2] - 1]

    run = {**ROBERTSON, "mass": np.diag([1.0, 1.0, 0.0]), "sensitivities": ["k1", "y0[0]"]}
    sol = iv.solve_ivp(algebraic, (0, 0.4), [1.0, 0, 0.1], "ode15s", **run)
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], [-0.35595257, 3.9025e-4, 0.35556231], rtol=1e-3)
    np.testing.assert_allclose(sol.sensitivities.sum(axis=0), 0, atol=1e-15)


def of_heavy(t, y, m, k):
    return [y[1], -k * y[0] - y[1] ** 3]


def of_light(t, y, m, k):
    return [-k * y[0] + y[1], y[0] ** 2 - y[1]]


WITH_MASS = [
    (of_heavy, lambda t, m, k: np.array([[1, 0.1 * k], [0, m * (1 + 0.1 * np.sin(t))]]), [1.0, 0.0]),
    (of_light, lambda t, m, k: np.array([[m, 0], [0, 0]]), [0.5, 0.25]),
]


@dealt(6, method=ALGEBRAIC, system=WITH_MASS)
def test_masses_are_parameters(method, system):
    """Singular ones too: the derivatives of the mass and of f are those of f solved for y′."""
    fun, mass, y0 = system
    given = {"args": (2.0, 3.0), "rtol": 1e-7, "atol": 1e-9, "sensitivities": True}

    def solved(t, y, m, k):
        if fun is of_light:
            return [(-k * y[0] + y[0] ** 2) / m]
        return np.linalg.solve(mass(t, m, k), fun(t, y, m, k))

    sol = iv.solve_ivp(fun, (0, 1), y0, method, mass=mass, **given)
    expected = iv.solve_ivp(solved, (0, 1), y0[: len(solved(0, y0, 2.0, 3.0))], "dop853", **given)
    found = sol.sensitivities[: len(expected.y), :, -1]
    np.testing.assert_allclose(found, expected.sensitivities[:, :, -1], atol=3e-5)


def diffusion(t, y, k, source):
    """On 12 points, with a reaction."""
    z = np.zeros(1)
    flux = np.diff(np.concatenate([z, y, z]))
    return 144 * k * np.diff(flux) - y**3 + source


def product(t, y, v, k, source):
    z = np.zeros(1)
    return 144 * k * np.diff(np.diff(np.concatenate([z, v, z]))) - 3 * y**2 * v


def diagonal(t, y, c, k, source):
    return lambda r: r / (1 + c * 288 * k)


MATRIX_FREE = [
    ({}, None),
    ({"jac_product": product}, None),
    ({"preconditioner": diagonal}, None),
    ({"preconditioner": diagonal}, np.eye(12) + 0.1 * np.eye(12, k=1)),
]


@dealt(12, method=["auto", "ode15s", "ode23t", "ode23tb", "radau"], way=MATRIX_FREE)
def test_columns_are_solved_without_matrices(method, way):
    """To the errors of the runs, also in parameters of other sizes."""
    (given, mass), y0 = way, np.sin(np.linspace(0.2, 3, 12))
    more = {"mass": mass, "args": (1.0, 1e-3), "sensitivities": [0, 1, "y0[3]"], "rtol": 1e-6, "atol": 1e-8}
    direct = iv.solve_ivp(diffusion, (0, 0.2), y0, method, **more)
    sol = iv.solve_ivp(diffusion, (0, 0.2), y0, method, linear_solver=iv.GMRES(**given), **more)
    assert sol.stats.jacobian == "products"
    assert direct.stats.jacobian != "products"
    size = np.abs(direct.sensitivities).max(axis=(0, 2))[:, None]
    error = np.abs(sol.sensitivities[:, :, -1] - direct.sensitivities[:, :, -1]).T / size
    assert error.max() < 1e-4


def braked(t, y, w, d):
    return [y[1], -w * w * y[0] - d * y[1]]


def energy(t, y, w, d):
    """Return the energy of `braked`, which keeps it for d = 0."""
    return y[1] ** 2 / 2 + w * w * y[0] ** 2 / 2


@families
def test_what_may_only_fall_does_not_restrict_derivatives(method):
    """Without friction the energy stays, but its derivative with respect to friction does not."""
    w, tf = 1.5, 20.0
    rtol = 1e-6 if iv.METHODS[method].order == 2 else 1e-7
    given = {"args": (w, 0.0), "rtol": rtol, "atol": rtol / 100, "invariants": iv.Dissipated(energy)}
    sol = iv.solve_ivp(braked, (0, tf), [1.0, 0.0], method, **given, sensitivities=True)
    assert (np.diff(energy(0, sol.y, w, 0)) <= 1e-14).all()
    if method == "ode113":
        assert sol.stats.projections > 5
    angle = w * tf
    exact = [-tf * np.sin(angle), np.sin(angle) / (2 * w) - tf / 2 * np.cos(angle)]
    np.testing.assert_allclose(sol.sensitivities[0, :, -1], exact, atol=1e-2)
    along = iv.solve_ivp(braked, (0, tf), [1.0, 0.0], method, **given, adjoint=True)
    np.testing.assert_allclose(along.gradient([1.0, 0.0]), exact, atol=1e-2)


@families
def test_a_law_beside_what_may_only_fall_has_its_tangent(method):
    """The corrections of S for the law leave the derivative of the other function as it is."""

    def flow(t, y, k):
        return [-k * y[0] + y[1] - y[1], k * y[0] - 2 * y[1], 2 * y[1]]

    sol = iv.solve_ivp(
        flow, (0, 3), [1.0, 0.5, 0.0], method, args=(1.3,), rtol=1e-6, atol=1e-9, sensitivities=True,
        invariants=[iv.Invariants(lambda t, y, k: y[0] + y[1] + y[2]), iv.Dissipated(lambda t, y, k: y[0])],
    )  # fmt: skip
    assert np.abs(sol.sensitivities.sum(axis=0)).max() < 1e-15
    assert sol.sensitivities[0, 0, -1] == pytest.approx(-3 * np.exp(-3.9), abs=1e-5)


def test_a_start_at_an_equilibrium_moves():
    """y stays, and its derivative with respect to where the equilibrium is does not."""
    sol = iv.solve_ivp(lambda t, y, p: [p - y[0]], (0, 3), [1.0], args=(1.0,), **TOLERANCES, sensitivities=True)
    np.testing.assert_allclose(sol.sensitivities[0, 0, -1], 1 - np.exp(-3), rtol=1e-7)


def test_inputs_and_arrays_of_parameters():
    tap = iv.Input([0, 1, 2], [1.0, 2.0, 0.5], kind="linear")
    problem = iv.Problem(lambda t, y, u, p: [p[0] * u - p[1] * y[0]], (0, 2), [0.0], args=([2.0, 0.0],), inputs=tap)
    sol = problem.replace(sensitivities="p[0]").solve("ode45", **TOLERANCES)
    np.testing.assert_allclose(sol.sensitivities[0, 0, -1], 1.5 + 1.25, rtol=1e-7)
