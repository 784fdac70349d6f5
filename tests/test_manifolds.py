"""Ready manifolds: their equations, exact Jacobians, and attitudes that stay attitudes."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import invariode as iv
from cases import families

EPS = np.finfo(float).eps
RANDOM = np.random.default_rng(14)

MANIFOLDS = {
    "vector": iv.UnitVector([3, 1]),
    "vectors": iv.UnitVector([[0, 4, 2], [5, 7, 6]]),
    "quaternion": iv.UnitQuaternion(range(2, 6)),
    "quaternions": iv.UnitQuaternion([[0, 1, 2, 3], [7, 6, 5, 4]]),
    "matrix": iv.RotationMatrix(np.arange(1, 10).reshape(3, 3)),
    "matrices": iv.RotationMatrix(np.arange(20)[::-1][:18].reshape(2, 9)),
}


@pytest.fixture(params=list(MANIFOLDS))
def manifold(request):
    return MANIFOLDS[request.param]


def test_jacobians_are_exact(manifold):
    """Im g(y + i h e_j) / h of a quadratic g has no error but rounding; for complex y as well."""
    h = 1e-30
    y = RANDOM.normal(size=20)
    steps = [manifold.fun(0.0, y + 1j * h * e).imag / h for e in np.eye(20)]
    np.testing.assert_allclose(manifold.jac(0.0, y), np.transpose(steps), rtol=4 * EPS, atol=0)
    z = y + 1j * RANDOM.normal(size=20)
    along = RANDOM.normal(size=20)
    difference = (manifold.fun(0.0, z + along) - manifold.fun(0.0, z - along)) / 2  # exact for quadratics
    np.testing.assert_allclose(manifold.jac(0.0, z) @ along, difference, rtol=100 * EPS)


def test_there_is_a_name_and_a_value_for_each_equation(manifold):
    m = len(manifold.fun(0.0, np.zeros(20)))
    assert len(set(manifold.names)) == len(manifold.value) == m
    assert m == {"v": 1, "q": 1, "m": 6}[next(k for k, v in MANIFOLDS.items() if v is manifold)[0]] * (
        2 if manifold in (MANIFOLDS["vectors"], MANIFOLDS["quaternions"], MANIFOLDS["matrices"]) else 1
    )


def test_rotations_are_on_their_manifold_and_others_are_not():
    for _ in range(5):
        q, _ = np.linalg.qr(RANDOM.normal(size=(3, 3)))
        attitude = iv.RotationMatrix(np.arange(9))
        np.testing.assert_allclose(attitude.fun(0.0, q.ravel()), attitude.value, atol=8 * EPS)
        stretched = q @ np.diag([1.0, 2.0, 1.0])
        assert abs(attitude.fun(0.0, stretched.ravel()) - attitude.value).max() > 2.9


def turning(t, y):
    """Two bodies that turn about space-fixed axes: R' = W R, row by row, then q' = ω q / 2."""
    w = np.array([[0, -0.3, 0.5], [0.3, 0, -1.0], [-0.5, 1.0, 0]])
    a, b, c = 1.0, 0.5, 0.3
    spin = np.array([[0, -a, -b, -c], [a, 0, -c, b], [b, c, 0, -a], [c, -b, a, 0]]) / 2
    return np.concatenate([(w @ y[:9].reshape(3, 3)).ravel(), spin @ y[9:13]])


BODIES = [iv.RotationMatrix(range(9)), iv.UnitQuaternion(range(9, 13))]
START = np.concatenate([np.eye(3).ravel(), [0.5, 0.5, 0.5, 0.5]])


@families
def test_attitudes_stay_attitudes_with_every_method(method):
    """Without projection the drift is that of its error; projected it is below a hundredth of the tolerance."""
    plain = iv.solve_ivp(turning, (0, 20), START, method, rtol=1e-4, atol=1e-4)
    held = iv.solve_ivp(turning, (0, 20), START, method, rtol=1e-4, atol=1e-4, invariants=BODIES)
    assert held.success
    assert abs(held.residual).max() < 1e-6
    R = plain.y[:9, -1].reshape(3, 3)
    assert abs(R.T @ R - np.eye(3)).max() > (1e-9 if method == "ode23t" else 1e-6)  # turns by nearly a Cayley map
    assert held.stats.derivatives == "given"


def test_in_the_core_they_are_the_same_functions(manifold):
    """`impose` with the core's own functions is that with Python's, to roundoff."""
    y0 = np.zeros(20)
    if isinstance(manifold, iv.RotationMatrix):
        for rows in np.unique(manifold._first, axis=0).reshape(-1, 3, 3):
            y0[rows[np.arange(3), np.arange(3)]] = 1.0
    else:
        y0[manifold._first[:, 0]] = 1.0
    fun, jac = manifold._in_core(20)
    rough = y0 + 0.05 * np.random.default_rng(2).normal(size=20)
    copy = iv.Invariants(manifold.fun, manifold.jac, manifold.value, manifold.names)
    first, second = (iv.impose(one, 0.0, rough) for one in (manifold, copy))
    np.testing.assert_allclose(first.y, second.y, rtol=100 * EPS, atol=100 * EPS)
    assert first.converged
    assert [type(one).__name__ for one in (fun, jac)] == ["_NativeQuadratic"] * 2
    for one in (fun, jac):
        assert pickle.loads(pickle.dumps(one))._made_of == one._made_of


def rigid_body(t, y):
    """q' = q ω / 2 and Euler's equations, principal moments 1, 2, 3; y = (q, ω)."""
    w, x, y_, z, a, b, c = y
    spin = [-x * a - y_ * b - z * c, w * a + y_ * c - z * b, w * b + z * a - x * c, w * c + x * b - y_ * a]
    return np.array([*(s / 2 for s in spin), -b * c, c * a, -a * b / 3])


def energy_and_momentum(t, y):
    """Twice the energy, and the angular momentum in space."""
    w, x, y_, z, a, b, c = y
    body = np.array([a, 2 * b, 3 * c])
    rows = np.array(
        [
            [w * w + x * x - y_ * y_ - z * z, 2 * (x * y_ - w * z), 2 * (x * z + w * y_)],
            [2 * (x * y_ + w * z), w * w - x * x + y_ * y_ - z * z, 2 * (y_ * z - w * x)],
            [2 * (x * z - w * y_), 2 * (y_ * z + w * x), w * w - x * x - y_ * y_ + z * z],
        ]
    )
    return np.array([a * a + 2 * b * b + 3 * c * c, *(rows @ body)])


@families
def test_attitude_energy_and_momentum_of_a_rigid_body_are_held_together(method):
    """Over 30 rotations about the middle axis, where it tumbles: to roundoff after two iterations."""
    held = [
        iv.Invariants(energy_and_momentum, names=["2E", "Lx", "Ly", "Lz"], iterations=2),
        iv.UnitQuaternion(range(4), iterations=2),
    ]
    start = [1, 0, 0, 0, 0.1, 1, 0.1]
    sol = iv.solve_ivp(rigid_body, (0, 190), start, method, rtol=1e-5, atol=1e-5, invariants=held)
    assert sol.success
    assert np.abs(np.linalg.norm(sol.y[:4], axis=0) - 1).max() < 20 * EPS
    assert np.abs(sol.residual).max() < 100 * EPS


def test_iterated_projection_reaches_roundoff():
    sol = iv.ode45(turning, (0, 20), START, invariants=BODIES, atol=1e-3).impose()
    assert abs(sol.residual).max() < 10 * EPS * 4


def test_impose_reaches_a_rotation_from_far_off():
    """If a singular value is small Newton's first step goes too far, and residuals fall only after it."""
    random = np.random.default_rng(0)
    attitude = iv.RotationMatrix(np.arange(9))
    for scale in (1e-3, 0.1, 0.3):
        rough = [np.linalg.qr(random.normal(size=(3, 3)))[0] + scale * random.normal(size=(3, 3)) for _ in range(100)]
        found = iv.impose(attitude, np.zeros(100), np.array(rough).reshape(100, 9).T, value=attitude.value)
        assert found.converged.mean() > (0.99 if scale > 0.1 else 0.999)
        near = found.y.T[found.converged].reshape(-1, 3, 3)
        assert abs(np.einsum("kji,kjl->kil", near, near) - np.eye(3)).max() < 40 * EPS


def test_a_start_far_off_is_refused():
    with pytest.raises(iv.InvariantError, match=r"\|q\|²"):
        iv.ode45(turning, (0, 1), 1.2 * START, invariants=BODIES[1])


def test_they_can_be_pickled(manifold):
    y = RANDOM.normal(size=20)
    copy = pickle.loads(pickle.dumps(manifold))
    np.testing.assert_array_equal(copy.fun(0.0, y), manifold.fun(0.0, y))
    assert repr(copy) == repr(manifold)


def test_names_can_be_given():
    assert iv.UnitQuaternion([[0, 1, 2, 3], [4, 5, 6, 7]]).names == ["|q1|²", "|q2|²"]
    assert iv.UnitQuaternion(range(4), name="hull").names == ["|hull|²"]
    assert iv.UnitVector([[0, 1], [2, 3]], name=["a", "b"]).names == ["|a|²", "|b|²"]


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: iv.UnitQuaternion([0, 1, 2]), ValueError, r"integers of shape \(4,\) or \(k, 4\), got shape \(3,\)"),
        (lambda: iv.UnitQuaternion([0, 1, 2, 2]), ValueError, "must be different, got 2 more than once"),
        (lambda: iv.UnitQuaternion([0, 1, 2, -1]), ValueError, "must not be negative, got -1"),
        (lambda: iv.UnitQuaternion(slice(0, 4)), TypeError, r"got slice\(0, 4, None\): give range"),
        (lambda: iv.UnitVector([0.5, 1]), TypeError, "must be integers"),
        (lambda: iv.UnitVector([]), ValueError, r"got shape \(0,\)"),
        (lambda: iv.RotationMatrix(range(8)), ValueError, r"\(3, 3\) or \(k, 3, 3\), got shape \(8,\)"),
        (lambda: iv.UnitVector([[0, 1], [2, 3]], name=["a"]), ValueError, "one str, or 2 str"),
        (lambda: iv.ode45(lambda t, y: -y, (0, 1), [1.0, 0], invariants=iv.UnitVector([0, 2])), ValueError, r"y\[2\]"),
    ],
)
def test_wrong_arguments_are_named(make, error, message):
    with pytest.raises(error, match=message):
        make()
