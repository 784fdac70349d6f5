"""Derivatives of the solution with respect to parameters: values in closed form, laws, events, what is refused."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest

import invariode as iv
import invariode.scipy
from cases import FAMILIES, SERIES, dealt, explicit_and_implicit, families, families_and_series
from invariode._functions.directional import Directional, Given, Point
from invariode._problem.parameters import parameter_names, values_of, with_values

TOLERANCES = {"rtol": 1e-8, "atol": 1e-10}


def spring(t, y, w, c):
    return [y[1], -w * w * y[0] + c]


def swinging(t, w, c):
    """The solution of `spring` from (1, 0)."""
    return np.array([(1 - c / w**2) * np.cos(w * t) + c / w**2, -(w - c / w) * np.sin(w * t)])


def of_swinging(t, w, c, h=1e-30):
    """Its derivatives, of shape (n, k, n_t)."""
    columns = [swinging(t, w + 1j * h, c).imag / h, swinging(t, w, c + 1j * h).imag / h]
    return np.stack(columns, axis=1)


def lotka_volterra(t, y, p0, p1, p2, p3):
    return [p0 * y[0] - p1 * y[0] * y[1], -p2 * y[1] + p3 * y[0] * y[1]]


def kept(t, y, p0, p1, p2, p3):
    return p3 * y[0] - p2 * np.log(y[0]) + p1 * y[1] - p0 * np.log(y[1])


def robertson(t, y, k1, k2, k3):
    slow, fast = -k1 * y[0] + k2 * y[1] * y[2], k3 * y[1] ** 2
    return [slow, -slow - fast, fast]


RATES = (1.5, 1.0, 3.0, 1.0)
ROBERTSON = {"args": (0.04, 1e4, 3e7), "rtol": 1e-4, "atol": [1e-8, 1e-14, 1e-6]}


# ----------------------------------------------------------------------------------------------------------------------
# Names


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


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives of functions


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
        (robertson, None, "graph", 4e-16),
        (iv.compile(robertson), None, "graph", 4e-16),
        (guarded, None, "complex-step", 4e-16),
        (real_only, None, "differences", 1e-9),
        (real_only, Given(jac, dfdp), "given", 4e-16),
        (robertson, Given(None, dfdp), "given and graph", 4e-16),
        (guarded, Given(jac), "given and complex-step", 4e-16),
    ],
)
def test_derivatives_of_functions_are_the_same_however_they_are_formed(fun, given, how, tolerance):
    args, y = ROBERTSON["args"], np.array([0.9, 1e-5, 0.1])
    names = parameter_names(robertson, args, None, 3, wanted=True)
    S = np.random.default_rng(1).standard_normal((3, 3))
    made = Directional(fun, args, names, 3, given, at=Point(0.0, y))
    exact = S @ jac(0, y, *args).T + dfdp(0, y).T
    assert made.how == how
    np.testing.assert_allclose(made.tangent(0.0, np.vstack([y, S])), exact, rtol=tolerance)
    np.testing.assert_allclose(made.along(0.0, y, 0.0, S[1], np.eye(3)[1]), exact[1], rtol=tolerance)


def test_differences_are_used_with_a_warning():
    with pytest.warns(iv.AccuracyWarning, match=r"the derivatives of fun are differences, .* give jac, and"):
        sol = iv.solve_ivp(real_only, (0, 0.1), [1.0, 0, 0], "radau", **ROBERTSON, sensitivities=True)
    assert sol.stats.sensitivities == "differences"


def test_a_count_is_no_parameter():
    with pytest.raises(TypeError, match=r"no derivative with respect to steps = 3, .* name the other parameters"):
        iv.solve_ivp(
            lambda t, y, steps: [sum(y[0] for _ in range(steps))], (0, 1), [1.0], args=(3,), sensitivities=True
        )


# ----------------------------------------------------------------------------------------------------------------------
# Solutions


def test_sensitivities_are_as_accurate_as_the_solution(method):
    """Those of a frequency grow in proportion to t, and so do their errors, against those of y."""
    sol = iv.solve_ivp(spring, (0, 6), [1.0, 0.0], method, args=(1.5, 0.3), rtol=1e-6, atol=1e-8, sensitivities=True)
    error = np.abs(sol.y - swinging(sol.t, 1.5, 0.3)).max()
    assert np.abs(sol.sensitivities - of_swinging(sol.t, 1.5, 0.3)).max() <= 3 * 6 * error
    assert sol.stats.sensitivities == "graph"


@families
def test_units_of_parameters_change_nothing(method):
    """f(t, y, c q) has the derivative c ∂y/∂p, bit for bit if c is a power of 2: with thresholds atol / |p|."""
    run = {"method": method, "rtol": 1e-6, "sensitivities": True}
    plain = iv.solve_ivp(spring, (0, 2), [1.0, 0.0], args=(1.5, 0.3), **run)
    scaled = iv.solve_ivp(lambda t, y, w, q: spring(t, y, w, 4 * q), (0, 2), [1.0, 0.0], args=(1.5, 0.075), **run)
    assert np.array_equal(scaled.t, plain.t)
    assert np.array_equal(scaled.sensitivities[:, 1], 4 * plain.sensitivities[:, 1])


@families
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


@families
def test_a_run_in_two_parts_and_one_there_and_back_are_right(method):
    """∂y/∂p of the first part is ∂y0/∂p of the second; back at the start it is what it was, 0."""
    run = {"rtol": 1e-9, "atol": 1e-11}
    problem = iv.Problem(spring, (0, 1), [1.0, 0.0], args=(1.5, 0.3), sensitivities=True)
    first = problem.solve(method, **run)
    start = {"y0": first.y[:, -1], "sensitivities": iv.Sensitivities(True, dy0dp=first.sensitivities[:, :, -1])}
    then = problem.replace(t_span=(1, 2), **start).solve(method, **run)
    back = problem.replace(t_span=(1, 0), **start).solve(method, **run)
    accuracy = 3e-5 if iv.METHODS[method].order < 4 else 1e-6
    np.testing.assert_allclose(
        then.sensitivities[:, :, -1], of_swinging(np.array([2.0]), 1.5, 0.3)[:, :, 0], atol=accuracy
    )
    np.testing.assert_allclose(back.sensitivities[:, :, -1], 0, atol=accuracy)


@pytest.mark.parametrize("method", ["ode45", "dop853", "ode113", "radau"])
@pytest.mark.parametrize("invariants", [None, kept])
def test_the_gradient_of_lotka_and_volterra(method, invariants):
    """dG/dp of G = |u(10) - 1|² / 2, where the form of the invariant depends on p."""
    published = [0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395]
    options = {"args": RATES, "rtol": 1e-10, "atol": 1e-12, "sensitivities": True, "invariants": invariants}
    sol = iv.solve_ivp(lotka_volterra, (0, 10), [1.0, 1.0], method, **options)
    found = (sol.y[:, -1] - 1) @ sol.sensitivities[:, :, -1]
    np.testing.assert_allclose(found, published, rtol=0, atol=1e-8)


@families
def test_where_an_invariant_is_held_so_is_its_derivative(method):
    """d/dp of g(y, p) = g(y0, p) at steps and between them, to roundoff."""
    problem = iv.Problem(
        lotka_volterra, (0, 4), [1.0, 1.0], args=RATES, invariants=kept, sensitivities=[*range(4), "y0"]
    )
    sol = problem.solve(method, rtol=1e-5, dense_output=True)
    names = problem.parameters()
    law = Directional(kept, RATES, names, 2, at=Point(0.0, problem.y0))
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
    law = Directional(laws, (1.0,), problem.parameters(), 4, at=Point(0.0, y0))
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


@pytest.mark.parametrize("method", ["ode15s", "radau"])
def test_events_of_algebraic_components(method):
    """z = q y² with y = exp(−p t) is ½ at ln(2 q) / (2 p), and z' follows from its equation."""
    sol = iv.solve_ivp(
        lambda t, y, p, q: [-p * y[0], y[1] - q * y[0] ** 2],
        (0, 2),
        [1.0, 1.5],
        method,
        args=(0.7, 1.5),
        mass=np.diag([1.0, 0.0]),
        events=lambda t, y, p, q: y[1] - 0.5,
        sensitivities=True,
        **TOLERANCES,
    )
    time = np.log(3) / 1.4
    np.testing.assert_allclose(sol.t_events[0], [time], rtol=1e-6)
    np.testing.assert_allclose(sol.sensitivities_t_events[0], [[-time / 0.7, 1 / 2.1]], rtol=1e-5)


def of_heavy(t, y, m, k):
    return [y[1], -k * y[0] - y[1] ** 3]


def of_light(t, y, m, k):
    return [-k * y[0] + y[1], y[0] ** 2 - y[1]]


@pytest.mark.parametrize("method", [name for name, about in iv.METHODS.items() if about.mass == "any"])
@pytest.mark.parametrize(
    ("fun", "mass", "y0"),
    [
        (of_heavy, lambda t, m, k: np.array([[1, 0.1 * k], [0, m * (1 + 0.1 * np.sin(t))]]), [1.0, 0.0]),
        (of_light, lambda t, m, k: np.array([[m, 0], [0, 0]]), [0.5, 0.25]),
    ],
)
def test_masses_are_parameters(method, fun, mass, y0):
    """Singular ones too: the derivatives of the mass and of f are those of f solved for y′."""
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


@pytest.mark.parametrize("method", ["ode15s", "ode23t", "ode23tb", "auto"])
@pytest.mark.parametrize(
    ("given", "mass"),
    [
        ({}, None),
        ({"jac_product": product}, None),
        ({"preconditioner": diagonal}, None),
        ({"preconditioner": diagonal}, np.eye(12) + 0.1 * np.eye(12, k=1)),
    ],
)
def test_columns_are_solved_without_matrices(method, given, mass):
    """To the errors of the runs, also in parameters of other sizes."""
    y0, more = np.sin(np.linspace(0.2, 3, 12)), {} if mass is None or method == "auto" else {"mass": mass}
    more |= {"args": (1.0, 1e-3), "sensitivities": [0, 1, "y0[3]"], "rtol": 1e-6, "atol": 1e-8}
    direct = iv.solve_ivp(diffusion, (0, 0.2), y0, method, **more)
    sol = iv.solve_ivp(diffusion, (0, 0.2), y0, method, linear_solver=iv.GMRES(**given), **more)
    assert sol.stats.jacobian == "products"
    assert direct.stats.jacobian != "products"
    size = np.abs(direct.sensitivities).max(axis=(0, 2))[:, None]
    error = np.abs(sol.sensitivities[:, :, -1] - direct.sensitivities[:, :, -1]).T / size
    assert error.max() < 1e-4


def potential(t, y, w, c):
    """Of `spring`, which keeps it."""
    return y[1] ** 2 / 2 + w * w * y[0] ** 2 / 2 - c * y[0]


@families
def test_what_may_only_fall_has_derivatives(method):
    """Where it was imposed in a step its value stays, and so does its derivative, to roundoff."""
    given = {"args": (1.5, 0.4), "sensitivities": [*(0, 1), "y0"], "rtol": 1e-5, "atol": 1e-7}
    sol = iv.solve_ivp(spring, (0, 20), [1.0, 0.0], method, invariants=iv.Dissipated(potential), **given)
    (y, v), (Sy, Sv), (w, c) = sol.y, sol.sensitivities, (1.5, 0.4)
    of_p = np.stack([w * y**2, -y, 0 * y, 0 * y])
    value, rate = potential(0, sol.y, w, c), v * Sv + (w * w * y - c) * Sy + of_p
    assert (np.diff(value) <= 1e-14).all()
    imposed = np.abs(np.diff(value)) <= 4e-16
    size = np.abs(sol.sensitivities).max() * np.abs(sol.y).max()
    assert np.abs(np.diff(rate, axis=1)[:, imposed]).max(initial=0.0) < 1e-13 * size
    plain = iv.solve_ivp(spring, (0, 20), [1.0, 0.0], method, **given)
    off, as_plain = (np.abs(one.sensitivities[:, :2, -1] - of_swinging(20.0, w, c)).max() for one in (sol, plain))
    assert off < 1.5 * as_plain
    if method == "ode113":
        assert imposed.sum() > 50
    short = iv.solve_ivp(spring, (0, 1), [1.0, 0.0], method, invariants=iv.Dissipated(potential), adjoint=True, **given)
    with pytest.raises(ValueError, match="which steps Dissipated has moved"):
        short.gradient([1.0, 0.0])


def test_a_start_at_an_equilibrium_moves():
    """y stays, and its derivative with respect to where the equilibrium is does not."""
    sol = iv.solve_ivp(lambda t, y, p: [p - y[0]], (0, 3), [1.0], args=(1.0,), **TOLERANCES, sensitivities=True)
    np.testing.assert_allclose(sol.sensitivities[0, 0, -1], 1 - np.exp(-3), rtol=1e-7)


def test_inputs_and_arrays_of_parameters():
    tap = iv.Input([0, 1, 2], [1.0, 2.0, 0.5], kind="linear")
    problem = iv.Problem(lambda t, y, u, p: [p[0] * u - p[1] * y[0]], (0, 2), [0.0], args=([2.0, 0.0],), inputs=tap)
    sol = problem.replace(sensitivities="p[0]").solve("ode45", **TOLERANCES)
    np.testing.assert_allclose(sol.sensitivities[0, 0, -1], 1.5 + 1.25, rtol=1e-7)


def test_without_error_test_the_steps_are_those_of_y():
    run = {"args": RATES, "rtol": 1e-5}
    alone = iv.solve_ivp(lotka_volterra, (0, 5), [1.0, 1.0], **run)
    sol = iv.solve_ivp(
        lotka_volterra, (0, 5), [1.0, 1.0], **run, sensitivities=iv.Sensitivities(True, error_test=False)
    )
    assert np.array_equal(sol.t, alone.t)
    assert np.array_equal(sol.y, alone.y)


# ----------------------------------------------------------------------------------------------------------------------
# Events


def ball(t, y, g, e):
    return [y[1], -g]


def bounced(t, g, e):
    """A ball that falls from 1."""
    end = np.sqrt(2 / g)
    if t.real < end.real:
        return np.array([1 - g * t * t / 2, -g * t])
    speed = e * g * end
    while (end + 2 * speed / g).real < t:
        end, speed = end + 2 * speed / g, e * speed
    s = t - end
    return np.array([speed * s - g * s * s / 2, speed - g * s])


BOUNCE = iv.Event(lambda t, y, g, e: y[0], direction=-1, action=lambda t, y, g, e: [0.0, -e * y[1]])


@families
def test_a_bouncing_ball(method):
    """∂y/∂g and ∂y/∂e through impacts, whose times depend on both; and those of the times."""
    g, e = 9.81, 0.8
    run = {"args": (g, e), "rtol": 1e-9, "atol": 1e-11, "events": BOUNCE, "sensitivities": True}
    sol = iv.solve_ivp(ball, (0, 1.7), [1.0, 0.0], method, **run)
    exact = np.array([bounced(1.7, g + 1e-30j, e).imag, bounced(1.7, g, e + 1e-30j).imag]).T / 1e-30
    accuracy = 1e-4 if iv.METHODS[method].order < 4 else 1e-6
    np.testing.assert_allclose(sol.sensitivities[:, :, -1], exact, rtol=0, atol=accuracy)
    fall = np.sqrt(2 / g)
    np.testing.assert_allclose(sol.sensitivities_t_events[0][0], [-fall / (2 * g), 0], atol=accuracy)
    before, after = sol.sensitivities_events[0][0], sol.sensitivities_after_events[0][0]
    np.testing.assert_allclose(before, [[-(fall**2) / 2, 0], [-fall, 0]], atol=accuracy)
    assert after.shape == (2, 2)
    assert np.isclose(after[1, 1], g * fall, rtol=accuracy)


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
@families
def test_where_f_jumps_sensitivities_jump(method):
    """x' = -1 above p and -3 below: dx/dp = -2 there, to which the variational equation says 0."""
    sol = iv.solve_ivp(
        lambda t, y, p: [-1.0 if y[0] > p else -3.0], (0, 2), [2.0], method, args=(1.2,), sensitivities="p"
    )
    assert sol.sensitivities[0, 0, [0, -1]] == pytest.approx([0, -2], abs=1e-9)
    assert sol.t_events is None


STAIRS = {
    "floor": lambda t, y, a: [np.floor(a * t)],
    "ceil": lambda t, y, a: [np.ceil(a * t)],
    "truncated": lambda t, y, a: [np.trunc(a * t)],
    "modulo": lambda t, y, a: [2 * a * t - (a * t) % 1.0],
    "of 1 / a": lambda t, y, a: [(t - t % (1 / a)) * a],
    "heaviside": lambda t, y, a: [sum(np.heaviside(a * t - i, 0.5) for i in range(1, 4))],
}


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
@dealt(18, name=STAIRS, method=[*FAMILIES, *SERIES])
def test_sensitivities_jump_at_every_step_of_a_staircase(method, name):
    """The area below stairs of 0, 1, 2 and 3, each 1/a long, up to t = 3.6/a: (0 + 1 + 2)/a + 3 (t - 3/a)."""
    a, t0, tf = 0.8, 0.1, 4.5
    sol = iv.solve_ivp(STAIRS[name], (t0, tf), [0.0], method, args=(a,), rtol=1e-6, atol=1e-8, sensitivities=True)
    slopes = {"modulo": (tf**2 - t0**2) / 2}  # of the line that is added
    assert sol.sensitivities[0, 0, -1] == pytest.approx(6 / a**2 + slopes.get(name, 0), rel=1e-4)


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
@families_and_series
def test_stairs_may_depend_on_the_solution(method):
    """y' = 1 + floor(y/p): p, p/2 and p/3 until y = 3 p, and 4 from there on."""
    sol = iv.solve_ivp(
        lambda t, y, p: [1 + np.floor(y[0] / p)], (0, 1.8), [1e-3], method, args=(0.9,), rtol=1e-6, sensitivities="p"
    )
    assert sol.sensitivities[0, 0, -1] == pytest.approx(3 - 4 * (1 + 1 / 2 + 1 / 3), rel=1e-4)


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
def test_signs_are_conditions():
    """Dry friction p stops a block at v / p, and turns its force: v' = -p sign(v) - 1."""

    def block(t, y, p):
        return [-p * np.sign(y[0]) - 1]

    sol = iv.solve_ivp(block, (0, 2), [1.0], args=(0.5,), **TOLERANCES, sensitivities=["p", "y0"])
    # v = 1 - (1 + p) t until t = 1 / (1 + p), then -(1 - p) (t - 1 / (1 + p))
    assert sol.sensitivities[0, :, -1] == pytest.approx([2 - 1 / 1.5 - 0.5 / 1.5**2, 0.5 / 1.5], abs=1e-8)


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
@pytest.mark.parametrize("forward", [True, False])
def test_switches_in_time_that_are_parameters(forward):
    def growth(t, y, p):
        return [y[0] if t < p else 2 * y[0]]

    span = (0, 2) if forward else (2, 0)
    sol = iv.solve_ivp(growth, span, [1.0], args=(1.2,), **TOLERANCES, sensitivities="p")
    sign = -1 if forward else 1
    assert sol.sensitivities[0, 0, -1] == pytest.approx(sign * np.exp(-2.8 * sign), rel=1e-6)


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
def test_jumps_of_an_f_that_is_not_traced_are_a_warning():
    def falling(t, y, p):
        try:  # which tracing refuses
            return [-1.0 + 0 * y[0] if y[0].real > p.real else -3.0 + 0 * y[0]]
        finally:
            pass

    with pytest.warns(iv.AccuracyWarning, match=r"fun looks discontinuous at t = 0\.[78]\d*, and not all of its"):
        iv.solve_ivp(falling, (0, 2), [2.0], args=(np.float64(1.2),), **TOLERANCES, sensitivities=True)


def test_a_continuous_kink_is_no_jump():
    """No event, so that the steps are those of y, if f is continuous where its branches meet."""
    run = {"args": (0.5,), **TOLERANCES}
    sensitivities = iv.Sensitivities("p", error_test=False)
    kink = iv.compile(lambda t, y, p: [-y[0] if y[0] > p else -p])
    alone, sol = (iv.solve_ivp(kink, (0, 2), [1.0], **run, sensitivities=one) for one in (None, sensitivities))
    assert np.array_equal(sol.t, alone.t)


def test_doses_that_are_parameters():
    """y jumps by p at t = 1."""
    sol = iv.solve_ivp(
        lambda t, y, p: [-y[0]],
        (0, 2),
        [1.0],
        args=(0.7,),
        **TOLERANCES,
        breakpoints={1.0: lambda t, y, p: y + p},
        sensitivities=["p", "y0"],
    )
    np.testing.assert_allclose(sol.sensitivities[0, :, -1], [np.exp(-1), np.exp(-2)], rtol=1e-6)


def test_a_grazing_event_is_a_warning():
    """The top of a parabola touches zero."""
    top = iv.Event(lambda t, y, c: y[0] - c, action=lambda t, y, c: y)
    with pytest.warns(iv.AccuracyWarning, match="event event only grazes zero at t = "):
        iv.solve_ivp(
            lambda t, y, c: [1.0 - t], (0, 2), [0.0], args=(0.5 - 1e-5,), events=top, max_step=1e-3, sensitivities=True
        )


# ----------------------------------------------------------------------------------------------------------------------
# Results


def problem_with_everything(**changes):
    crossing = iv.Event(lambda t, y, *p: y[0] - 1, direction=1)
    description = {"args": RATES, "invariants": kept, "events": crossing, "labels": ["prey", "foxes"]}
    return iv.Problem(lotka_volterra, (0, 8), [1.0, 1.0], **{**description, "sensitivities": ["p1", "y0"], **changes})


def same(one, other):
    at = np.linspace(0, 8, 11)
    pairs = [
        (one.y, other.y),
        (one.sensitivities, other.sensitivities),
        (one.sol.sensitivities(at), other.sol.sensitivities(at)),
        *zip(one.sensitivities_events, other.sensitivities_events, strict=True),
        *zip(one.sensitivities_t_events, other.sensitivities_t_events, strict=True),
    ]
    return (
        all(np.array_equal(a, b, equal_nan=True) for a, b in pairs) and one.sensitivity_names == other.sensitivity_names
    )


@explicit_and_implicit
def test_extensions_files_and_checkpoints_are_the_run(method, tmp_path):
    problem = problem_with_everything()
    options = {"rtol": 1e-5, "dense_output": True}
    whole = problem.solve(method, **options)
    part = problem.solve(method, **options, max_steps=20)
    assert same(part.extend(8, max_steps=10**6), whole)
    part.save(tmp_path / "part.npz")
    assert same(iv.load(tmp_path / "part.npz", problem).extend(8, max_steps=10**6), whole)
    problem.solve(method, **options, checkpoint=iv.Checkpoint(tmp_path / "run", every=0.02))
    assert same(iv.load(tmp_path / "run", problem), whole)
    assert same(copy.deepcopy(whole), whole)
    with pytest.raises(
        ValueError, match=r"sensitivities: None here, \['p1', 'y0\[prey\]', 'y0\[foxes\]'\] in the file"
    ):
        iv.load(tmp_path / "part.npz", problem.replace(sensitivities=None))


def test_y_is_that_of_any_solution():
    """Shapes of y, its events and sol; sensitivities beside them."""
    sol = problem_with_everything().solve("ode45", t_eval=[0, 1, 8], dense_output=True)
    assert (sol.y.shape, sol.sensitivities.shape) == ((2, 3), (2, 3, 3))
    assert (sol.sol(1.0).shape, sol.sol.sensitivities(1.0).shape) == ((2,), (2, 3))
    assert sol.y_events[0].shape[1] == 2
    assert len(sol.drift().names) == 1
    np.testing.assert_array_equal(sol.sensitivities[:, 1:, 0], np.eye(2))
    end = problem_with_everything().solve("ode45", keep="end")
    assert end.sensitivities.shape == (2, 3, 1)
    plain = problem_with_everything(sensitivities=None).solve("ode45", dense_output=True)
    assert plain.sensitivities is None
    assert plain.stats.sensitivities is None
    with pytest.raises(ValueError, match="the run had no sensitivities: solve with sensitivities=True"):
        plain.sol.sensitivities(1.0)


def test_tables_have_them_by_name():
    pytest.importorskip("xarray")
    sol = problem_with_everything().solve("ode45", rtol=1e-4)
    data, table = sol.to_xarray(), sol.to_dataframe()
    np.testing.assert_array_equal(data.sensitivities.sel(component="foxes", parameter="p1"), sol.sensitivities[1, 0])
    np.testing.assert_array_equal(table["d foxes / d y0[prey]"], sol.sensitivities[1, 1])


def test_a_prepared_solver_has_the_values_of_its_call():
    problem = problem_with_everything(events=None, invariants=None)
    solver, other = problem.prepare("ode45"), (1.4, 1.1, 3.0, 1.0)
    assert np.array_equal(solver(args=other).sensitivities, problem.replace(args=other).solve("ode45").sensitivities)


@pytest.mark.parametrize("scale", [None, {"rate": 1.0}, {"rate": 1.0, "source": 1.0}, 1.0])
def test_a_prepared_solver_takes_the_sizes_of_its_call(scale):
    """Those that are not given are the values of the parameters."""
    grown = iv.compile(lambda t, y, rate, source: [-rate * y[0] + source])
    problem = iv.Problem(grown, (0, 3), [1.0], args=(1.0, 1e-6), sensitivities=iv.Sensitivities(scale=scale))
    solver, other = problem.prepare("ode45"), (2.0, 1e3)
    assert np.array_equal(solver(args=other).sensitivities, problem.replace(args=other).solve("ode45").sensitivities)


# ----------------------------------------------------------------------------------------------------------------------
# What is given, and what is refused


def decay(t, y, rate):
    return [-rate * y[0]]


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
    ("method", "options", "message"),
    [
        ("radau", {"linear_solver": "gmres", "sensitivities": True}, "radau solves for its stages together"),
        (
            "ode45",
            {"sensitivities": iv.Sensitivities(dfdp=lambda t, y, rate: [1.0, 2.0])},
            r"dfdp of fun must have shape",
        ),
        ("ode45", {"sensitivities": iv.Sensitivities(dy0dp=[1.0, 2.0])}, r"dy0dp must have shape \(1, 1\)"),
        ("ode45", {"sensitivities": iv.Sensitivities(scale=-1)}, "scale of Sensitivities must be positive, got -1"),
        ("ode45", {"sensitivities": iv.Sensitivities(scale={"ratio": 1})}, "did you mean 'rate'"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(method, options, message):
    with pytest.raises(ValueError, match=message):
        iv.solve_ivp(decay, (0, 1), [1.0], method, args=(2.0,), **options)


def test_fields_are_checked_when_they_are_made():
    with pytest.raises(TypeError, match="dfdp of Sensitivities must be a function"):
        iv.Sensitivities(dfdp=3)
    with pytest.raises(TypeError, match="error_test of Sensitivities must be True or False"):
        iv.Sensitivities(error_test=1)
    assert pickle.loads(pickle.dumps(iv.Sensitivities("rate"))).args == "rate"


@pytest.mark.parametrize("fun", [decay, iv.compile(decay)])
def test_trajectories_have_those_of_single_runs(fun, tmp_path):
    rows = {"y0": [[1.0], [2.0]], "args": [[1.0], [3.0]]}
    options = {"t_eval": [0.5, 1.0], "rtol": 1e-6, "sensitivities": ["rate", "y0"]}
    many = iv.solve_ensemble(fun, (0, 1), **rows, **options, workers=1)
    for i, (y0, args) in enumerate(zip(*rows.values(), strict=True)):
        alone = iv.solve_ivp(fun, (0, 1), y0, args=args, **options)
        assert np.array_equal(many.sensitivities[i], alone.sensitivities)
        assert np.array_equal(many[i].sensitivities, alone.sensitivities)
    assert many.stats.lanes == "one at a time: sensitivities are computed with each trajectory"
    many.save(tmp_path / "many.npz")
    again = iv.EnsembleSolution.load(tmp_path / "many.npz")
    assert np.array_equal(again.sensitivities, many.sensitivities)
    assert again.sensitivity_names == many[0].sensitivity_names == ["rate", "y0[0]"]
    final = iv.solve_ensemble(fun, (0, 1), **rows, rtol=1e-6, sensitivities="rate", workers=1)
    np.testing.assert_allclose(final.sensitivities[:, 0, 0, 0], -final.y_end[:, 0], rtol=1e-4)


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


# Of those that cannot be traced.
@pytest.mark.filterwarnings("ignore:sensitivities. the derivatives of fun:invariode.AccuracyWarning")
@pytest.mark.parametrize("method", ["dop853", "ode113", "ode15s", "radau"])
@pytest.mark.parametrize(
    ("fun", "more", "real"),
    [
        (precession, {}, {}),
        (iv.compile(precession), {}, {}),
        (untraced_precession, {}, {}),
        (condensate, {"breakpoints": {0.5: turned}}, {"breakpoints": {0.5: in_reals(turned)}}),
        (
            condensate,
            {"events": iv.Event(inside, action=turned), "invariants": lambda t, y, w, g: (abs(y) ** 2).sum()},
            {
                "events": iv.Event(lambda t, x, w, g: x[0] ** 2 + x[1] ** 2 - 0.7 * g, action=in_reals(turned)),
                "invariants": lambda t, x, w, g: x @ x,
            },
        ),
    ],
)
def test_complex_states_have_those_of_their_parts(method, fun, more, real):
    """The errors of two runs whose steps may differ."""
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


@pytest.mark.parametrize("times", [{"t_eval": [0.5, 1.0]}, {}])
def test_a_store_has_those_of_the_ensemble(times, tmp_path):
    pytest.importorskip("zarr")
    given = {"y0": [[1.0], [2.0], [3.0]], "args": [[1.0], [3.0], [np.nan]], "workers": 1, **times}
    given |= {"sensitivities": ["rate", "y0"], "on_failure": "return"}
    many = iv.solve_ensemble(decay, (0, 1), **given)
    store = iv.solve_ensemble(decay, (0, 1), **given, store=tmp_path / "store", chunk=2)
    loaded = store.load()
    np.testing.assert_array_equal(loaded.sensitivities, many.sensitivities)
    np.testing.assert_array_equal(loaded[1].sensitivities, many[1].sensitivities)
    assert loaded.sensitivity_names == store.to_xarray().sensitivity.values.tolist() == ["rate", "y0[0]"]
    other = {**given, "sensitivities": True}
    with pytest.raises(ValueError, match="belongs to another problem: sensitivities"):
        iv.solve_ensemble(decay, (0, 1), **other, store=tmp_path / "store", chunk=2, resume=True)


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
    assert sol.stats.sensitivities == "graph"
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


# ----------------------------------------------------------------------------------------------------------------------
# What is not followed is said


def switching(t, y, p):
    """−1 above p, −3 below: y(2) from 2 has the derivative −2."""
    return [np.where(y[0] > p, -1.0, -3.0)]


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
def test_conditions_of_f_are_no_events_of_the_user(tmp_path):
    problem = iv.Problem(switching, (0, 2), [2.0], args=(1.2,), events=[lambda t, y, p: y[0] - 1.6], sensitivities=True)
    for sol in (problem.solve(), problem.replace(t_span=(0, 0.1)).solve().extend(2.0)):
        assert len(sol.t_events) == len(sol.y_events) == len(sol.sensitivities_t_events) == 1
        assert sol.sensitivities[0, 0, -1] == pytest.approx(-2)
    sol.save(tmp_path / "sol.npz")
    assert sol.to_dataframe().shape[0] == len(sol.t)


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
def test_jumps_far_from_the_start_are_followed():
    sol = iv.solve_ivp(
        lambda t, y, p: [(t > 50) * switching(t, y, p)[0]],
        (0, 52),
        [2.0],
        args=(1.2,),
        breakpoints=[50],
        sensitivities=True,
    )
    assert sol.sensitivities[0, 0, -1] == pytest.approx(-2)


# The jumps are the test.
@pytest.mark.filterwarnings("ignore:.* fun looks discontinuous:invariode.DiscontinuityWarning")
def test_one_condition_written_in_two_ways():
    """As a difference it is known to be the same; times 2 it is not, which is said."""
    for other, same in ((lambda d: np.sign(d), True), (lambda d: np.where(2 * d > 0, 1.0, -1.0), False)):

        def fun(t, y, p, other=other):
            return [-4 + other(y[0] - p) + np.where(y[0] > p, 1.0, -1.0)]

        options = {"args": (1.2,), "sensitivities": True}
        if same:
            assert iv.solve_ivp(fun, (0, 2), [2.0], **options).sensitivities[0, 0, -1] == pytest.approx(-2)
            continue
        with pytest.warns(iv.AccuracyWarning, match="several conditions of fun change together at t = 0.4|0.3"):
            iv.solve_ivp(fun, (0, 2), [2.0], **options)


def test_an_input_that_is_compared_with_a_parameter_is_a_warning():
    problem = iv.Problem(
        lambda t, y, u, p: [np.where(u > p, -3.0, -1.0)],
        (0, 2),
        [2.0],
        args=(0.7,),
        inputs=[iv.Input([0, 2], [0.0, 2.0], "linear")],
        sensitivities=True,
    )
    with pytest.warns(iv.AccuracyWarning, match="if an input is compared"):
        problem.solve()


def test_complex_steps_that_fail_later_are_a_warning():
    ways = [abs, lambda x: x]

    def fun(t, y, p):
        return [-p * ways[int(t < 1)](y[0])]

    with pytest.warns(iv.AccuracyWarning, match="complex steps through fun do not give its derivatives"):
        iv.solve_ivp(fun, (0, 2), [1.0], args=(1.0,), breakpoints=[1.0], sensitivities=True)


def test_events_of_fast_problems_do_not_leave_where_f_is_defined():
    def fun(t, y, k):
        return [-k * math.sqrt(y[0])]

    sol = iv.solve_ivp(
        fun, (0, 1e-9), [1.0], args=(1e9,), events=lambda t, y, k: y[0] - 0.5, sensitivities=True, rtol=1e-8
    )
    assert sol.sensitivities[0, 0, -1] == pytest.approx(-5e-10, rel=1e-6)  # of (1 − k t / 2)²


def test_what_has_no_sensitivities_is_refused_by_name():
    with pytest.raises(ValueError, match="has an argument 'y0'"):
        iv.solve_ivp(lambda t, y, y0: [y0 - y[0]], (0, 1), [2.0], args=(0.5,), sensitivities="y0")
