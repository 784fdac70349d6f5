"""Invariants in levels: what holds first is imposed first, in every method, and the default is as without levels."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import families, families_and_series


def swing(t, y):
    tension = (y[2] ** 2 + y[3] ** 2 - y[1]) / (y[0] ** 2 + y[1] ** 2)
    return [y[2], y[3], -tension * y[0], -tension * y[1] - 1]


def rod(t, y):
    return y[0] ** 2 + y[1] ** 2 - 1


def across(t, y):
    return y[0] * y[2] + y[1] * y[3]


def energy(t, y):
    return (y[2] ** 2 + y[3] ** 2) / 2 + y[1]


START = [1.0, 0.0, 0.0, 0.0]
LEVELS = [
    iv.Invariants(rod, value=0, names="rod", moves=[0, 1]),
    iv.Invariants(across, value=0, names="across", level=1, moves=[2, 3]),
    iv.Invariants(energy, names="energy", level=2),
]


@families
def test_every_method_keeps_all_levels_to_roundoff(method):
    sol = iv.solve_ivp(swing, (0, 20), START, method, rtol=1e-5, atol=1e-7, invariants=LEVELS)
    assert sol.success
    assert np.abs(sol.residual).max() < 1e-13


@families_and_series
def test_points_between_steps_are_on_the_manifold_too(method):
    sol = iv.solve_ivp(swing, (0, 5), START, method, rtol=1e-5, atol=1e-7, invariants=LEVELS, dense_output=True)
    t = np.linspace(0, 5, 301)
    y = sol.sol(t)
    assert max(np.abs(g(t, y)).max() for g in (rod, across, energy)) < 1e-10


def test_errors_of_velocities_do_not_move_positions():
    rough = np.array([0.6, 0.8, 4.0, 1.0])
    levels = iv.impose(LEVELS[:2], 0.0, rough)
    joint = iv.impose([iv.Invariants(rod, value=0), iv.Invariants(across, value=0)], 0.0, rough)
    assert levels.converged
    assert joint.converged
    np.testing.assert_array_equal(levels.y[:2], rough[:2])
    assert np.abs(joint.y[:2] - rough[:2]).max() > 0.1


@families_and_series
def test_level_0_that_moves_all_is_the_default_to_the_last_bit(method):
    held = [iv.Invariants(rod, value=0), iv.Invariants(across, value=0)]
    named = [iv.Invariants(rod, value=0, level=0, moves=None), iv.Invariants(across, value=0, level=0)]
    first, second = (iv.solve_ivp(swing, (0, 5), START, method, invariants=one) for one in (held, named))
    np.testing.assert_array_equal(first.y, second.y)


def test_a_redundant_invariant_of_a_later_level_is_named():
    again = iv.Invariants(lambda t, y: 3 * rod(t, y), value=0, names="rod again", level=1)
    with pytest.warns(UserWarning, match="rod again"):
        sol = iv.solve_ivp(swing, (0, 2), START, invariants=[iv.Invariants(rod, value=0), across, again])
    assert sol.success


def test_complex_problems_move_complex_components():
    def turn(t, z):
        return [1j * z[0], 2j * z[1]]

    held = [
        iv.Invariants(lambda t, z: abs(z[0]) ** 2, names="first", moves=[0]),
        iv.Invariants(lambda t, z: abs(z[0]) ** 2 + abs(z[1]) ** 2, names="both", level=1, moves=[1]),
    ]
    sol = iv.solve_ivp(turn, (0, 20), [1.0 + 0j, 1j], invariants=held)
    assert sol.success
    assert np.abs(np.abs(sol.y) - 1).max() < 1e-13


MASSES = np.array([1.0, 1.0, 50.0, 50.0])  # of a dumbbell: two ends, in the plane


def tumble(t, y):
    """Two masses, 1 and 50, on a rod of length 1, without other forces."""
    rod, speed = y[2:4] - y[:2], y[6:] - y[4:6]
    pull = (speed @ speed) / (rod @ rod) / (1 / MASSES[0] + 1 / MASSES[2])
    return np.concatenate([y[4:], pull * rod / MASSES[:2], -pull * rod / MASSES[2:]])


def length(t, y):
    return (y[2] - y[0]) ** 2 + (y[3] - y[1]) ** 2 - 1


def stretching(t, y):
    return (y[2] - y[0]) * (y[6] - y[4]) + (y[3] - y[1]) * (y[7] - y[5])


def dumbbell(metric):
    return [
        iv.Invariants(length, value=0, names="length", moves=range(4), metric=metric),
        iv.Invariants(stretching, value=0, names="stretching", level=1, moves=range(4, 8), metric=metric),
    ]


TUMBLING = np.array([0, 0, 1, 0, 0, -2.0, 0, 1.0])


@families_and_series
def test_corrections_in_the_metric_of_the_mass_change_no_momentum(method):
    """The corrections are what forces along the rod do. Plain methods keep linear functions of y;
    joint projection does not."""
    momentum = []
    for metric in (MASSES, None):
        sol = iv.solve_ivp(tumble, (0, 5), TUMBLING, method, rtol=1e-4, atol=1e-4, invariants=dumbbell(metric))
        assert sol.success
        assert np.abs(sol.residual).max() < 1e-13
        total = (MASSES[:, None] * sol.y[4:]).reshape(2, 2, -1).sum(axis=0)
        momentum.append(np.abs(total - total[:, :1]).max())
    explicit = ("ode23", "ode45", "dop853", "ode78", "ode89", "ode113")  # others solve equations, to the tolerance
    assert momentum[0] < (1e-10 if method in explicit else 1e-2)
    assert momentum[1] > (1e-9 if method == "ode23t" else 1e-6)  # whose plain steps keep the rod's length well too


def test_a_metric_may_be_a_diagonal_a_matrix_or_a_function():
    code = native_metrics()
    metrics = [MASSES, np.diag(MASSES), lambda t, y: MASSES, lambda t, y: np.diag(MASSES), *code]
    rough = TUMBLING + 0.05 * np.arange(8) % 0.3
    points = [iv.impose(dumbbell(metric), 0.0, rough).y for metric in metrics]
    for point in points[1:]:
        np.testing.assert_allclose(point, points[0], atol=1e-14)
    assert np.abs(points[0] - iv.impose(dumbbell(None), 0.0, rough).y).max() > 1e-3


def native_metrics():
    """The metric as machine code, where there is a compiler."""
    numba = pytest.importorskip("numba")
    double, pointer = numba.types.double, numba.types.CPointer(numba.types.double)

    @numba.cfunc(numba.void(double, pointer, pointer, pointer))
    def matrix(t, y, out, p):
        for i in range(16):
            out[i] = 0.0
        for i in range(4):
            out[5 * i] = 1.0 if i < 2 else 50.0

    return [matrix]


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        (np.ones(3), r"metric of invariant length must have shape \(4,\) or \(4, 4\)"),
        (np.ones((2, 3)), r"must have shape \(k,\) or \(k, k\)"),
        ([1.0, np.nan, 1, 1], "must be finite"),
        (lambda t, y: np.ones(8), r"returned another shape than \(4,\) or \(4, 4\)"),
    ],
)
def test_metrics_of_another_size_are_refused(metric, message):
    with pytest.raises(ValueError, match=message):
        iv.solve_ivp(tumble, (0, 1), TUMBLING, invariants=dumbbell(metric))


def test_a_level_has_one_metric():
    held = dumbbell(MASSES)
    held.append(iv.Invariants(lambda t, y: y[4], names="other", level=1, moves=range(4, 8), metric=np.ones(4)))
    with pytest.raises(ValueError, match="level 1 and have different metrics"):
        iv.solve_ivp(tumble, (0, 1), TUMBLING, invariants=held)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"level": -1}, ValueError, "level"),
        ({"level": 0.5}, ValueError, "level"),
        ({"moves": 3}, TypeError, "moves"),
        ({"moves": []}, ValueError, "moves"),
        ({"moves": [1, 1]}, ValueError, "moves"),
        ({"moves": [-1]}, ValueError, "moves"),
    ],
)
def test_wrong_levels_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        iv.Invariants(rod, **options)


def test_what_does_not_fit_the_problem_is_refused():
    with pytest.raises(ValueError, match="4 components"):
        iv.solve_ivp(swing, (0, 1), START, invariants=iv.Invariants(rod, moves=[4]))
    with pytest.raises(ValueError, match="level 0 and may move different"):
        iv.solve_ivp(swing, (0, 1), START, invariants=[iv.Invariants(rod, moves=[0]), iv.Invariants(across)])


@pytest.mark.parametrize("method", ["radau", "ode15s"])
def test_levels_are_imposed_beside_algebraic_equations(method):
    """The tension is an algebraic variable: it follows the corrections of the levels, and all hold to roundoff."""

    def with_tension(t, y):
        f = swing(t, [*y[:4]])
        force = y[2] ** 2 + y[3] ** 2 - y[1] - y[4] * (y[0] ** 2 + y[1] ** 2)
        return [*f[:2], -y[4] * y[0], -y[4] * y[1] - 1, force]

    mass = np.diag([1.0, 1, 1, 1, 0])
    given = {"mass": mass, "invariants": LEVELS[:2], "rtol": 1e-5, "atol": 1e-7}
    sol = iv.solve_ivp(with_tension, (0, 5), [*START, 0], method, **given)
    assert sol.success
    assert np.abs(sol.residual).max() < 1e-13
    _, z, u, v, tension = sol.y
    np.testing.assert_allclose(tension, u**2 + v**2 - z, atol=1e-9)
    angle = iv.solve_ivp(lambda t, a: [a[1], -np.sin(a[0])], (0, 5), [np.pi / 2, 0], "dop853", rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(sol.y_end[:2], [np.sin(angle.y_end[0]), -np.cos(angle.y_end[0])], atol=3e-4)


def test_components_at_bounds_stay_there_in_a_metric():
    """The other components take their share: the square of the total is imposed, and nothing leaves its bound."""

    def total(t, y):
        return (y[0] + y[1] + y[2]) ** 2

    for metric in ([1.0, 2.0, 3.0], [[2.0, 1, 0], [1, 3, 1], [0, 1, 4]]):
        sol = iv.solve_ivp(
            lambda t, y: [-50 * y[0], 50 * y[0] - y[1], y[1]],
            (0, 10),
            [1.0, 0, 0],
            "ode15s",
            rtol=0.1,
            atol=0.01,
            invariants=iv.Invariants(total, metric=metric),
            nonnegative=True,
        )
        assert sol.y.min() == 0
        np.testing.assert_allclose(sol.y.sum(axis=0), 1, atol=1e-14)
