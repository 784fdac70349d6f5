"""Forms of the Jacobian and of the mass matrix: every one gives the same solution, every error is named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

import invariode as iv
from cases import ALGEBRAIC, IMPLICIT, METHODS, dealt
from problems import implicit, slack, switching
from stiff import PROBLEMS

ROBERTSON = PROBLEMS["Robertson"]
BRUSSELATOR = PROBLEMS["Brusselator"]
N = 40


def diffusion(t, u):
    """u' = u_xx + u (1 − u), of bandwidth 1."""
    right, left = np.append(u[1:], u[-1]), np.append(u[0], u[:-1])
    return (right - 2 * u + left) * N + u * (1 - u)


def diffusion_jacobian(t, u):
    main = np.full(N, -2.0 * N)
    main[0] = main[-1] = -N
    return np.diag(main + 1 - 2 * u) + np.diag(np.full(N - 1, N), 1) + np.diag(np.full(N - 1, N), -1)


def packed(J: np.ndarray) -> np.ndarray:
    return np.array([np.append(0, np.diag(J, 1)), np.diag(J), np.append(np.diag(J, -1), 0)])


U0 = np.sin(np.linspace(0, 3, N)) ** 2
PATTERN = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) <= 1
FORMS = {
    "differences": {},
    "dense": {"jac": diffusion_jacobian},
    "list of lists": {"jac": lambda t, u: diffusion_jacobian(t, u).tolist()},
    "sparse csr": {"jac": lambda t, u: sparse.csr_array(diffusion_jacobian(t, u))},
    "sparse coo matrix": {"jac": lambda t, u: sparse.coo_matrix(diffusion_jacobian(t, u))},
    "banded": {"jac": lambda t, u: packed(diffusion_jacobian(t, u)), "lband": 1, "uband": 1},
    "banded differences": {"lband": 1, "uband": 1},
    "wider band": {"lband": 3, "uband": 2},
    "pattern": {"jac_sparsity": PATTERN},
    "sparse pattern": {"jac_sparsity": sparse.coo_array(PATTERN)},
}


@dealt(method=[*(name for name in filter(implicit, METHODS) if not switching(name)), "BDF"], form=FORMS)
def test_every_form_of_the_jacobian_gives_the_same_run(method, form):
    expected = iv.solve_ivp(diffusion, (0, 5), U0, method, jac=diffusion_jacobian, rtol=1e-6)
    sol = iv.solve_ivp(diffusion, (0, 5), U0, method, rtol=1e-6, **FORMS[form])
    assert sol.success
    assert (sol.stats.steps, sol.stats.failed, sol.nlu) == (expected.stats.steps, expected.stats.failed, expected.nlu)
    np.testing.assert_allclose(sol.y, expected.y, rtol=1e-5, atol=1e-8)


def wide_diffusion(t, u):
    padded = np.concatenate([u[:1], u, u[-1:]])
    return 40 * len(u) * np.diff(padded, 2) + u * (1 - u)


WIDE = iv.Problem(
    wide_diffusion,
    (0, 5),
    np.sin(np.linspace(0, 3, 250)) ** 2,
    jac_sparsity=sparse.diags_array([1.0, 1, 1], offsets=[-1, 0, 1], shape=(250, 250)),
)


def test_sparse_factors_serve_while_h_changes_little():
    """Fewer than of a banded J, for the same steps and the same solution."""
    kept = WIDE.solve("ode15s", rtol=1e-6)
    renewed = WIDE.replace(jac_sparsity=None, lband=1, uband=1).solve("ode15s", rtol=1e-6)
    assert kept.nlu < renewed.nlu
    assert abs(kept.stats.steps - renewed.stats.steps) <= renewed.stats.steps / 20
    np.testing.assert_allclose(kept.y[:, -1], renewed.y[:, -1], rtol=1e-5)


def test_a_run_with_kept_factors_goes_on_as_if_it_had_not_been_interrupted():
    whole = WIDE.solve("ode15s", rtol=1e-6)
    for steps in (5, 20, 40):
        part = WIDE.solve("ode15s", rtol=1e-6, max_steps=steps, on_failure="return")
        assert part.extend(5, max_steps=None).y.tobytes() == whole.y.tobytes()


def test_grouped_differences_cost_as_many_f_as_there_are_groups():
    one = iv.ode15s(diffusion, (0, 5), U0, jac=diffusion_jacobian)
    for options, groups in (({}, N), (FORMS["banded differences"], 3), (FORMS["pattern"], 3), (FORMS["wider band"], 6)):
        sol = iv.ode15s(diffusion, (0, 5), U0, **options)
        # each Jacobian but the first needs f at its point, too
        assert sol.nfev == one.nfev + sol.njev * (groups + 1) - 1


def test_constant_jacobian_is_never_evaluated(code):
    matrix = np.array([[-1.0, 100], [0, -200]])
    runs = [
        code(lambda t, y: matrix @ y, (0, 5), [1, 1], jac=jac)
        for jac in (matrix, sparse.csr_array(matrix), lambda t, y: matrix)
    ]
    assert runs[0].njev == runs[1].njev == 0
    assert runs[2].njev > 0
    assert np.array_equal(runs[2].y, runs[0].y)
    # Sparse factors round otherwise; an error estimate far below y, and with it h, magnifies that.
    np.testing.assert_allclose(runs[1].y, runs[0].y, rtol=1e-9, atol=1e-12)


def test_jacobian_function_is_called_as_often_as_counted(code):
    calls = []

    def jac(t, y, *args):
        calls.append((t, y.copy(), args))
        return ROBERTSON.jac(t, y)

    sol = code(lambda t, y, a: ROBERTSON.fun(t, y), (0, 1e3), ROBERTSON.y0, jac=jac, args=(3,))
    assert sol.njev == len(calls) > 2
    assert calls[0][0] == 0
    assert all(args == (3,) for _, _, args in calls)
    assert not np.array_equal(calls[0][1], calls[1][1])


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")
def test_sparsity_that_grows_during_the_run_is_followed(code):
    """A sparse Jacobian may leave out entries that are zero where it is evaluated."""

    def fun(t, y):
        return [-50 * (y[0] - np.cos(t)), -30 * y[1] + (y[0] * t if t > 1 else 0)]

    def jac(t, y):
        return sparse.csr_array([[-50, 0], [t if t > 1 else 0, -30]])

    sol = code(fun, (0, 5), [0, 1], jac=jac, rtol=1e-6)
    dense = code(fun, (0, 5), [0, 1], jac=lambda t, y: jac(t, y).toarray(), rtol=1e-6)
    assert sol.success
    np.testing.assert_allclose(sol.y[:, -1], dense.y[:, -1], rtol=1e-6)


@dealt(code=IMPLICIT, form=["differences", "dense", "sparse", "banded", "banded differences", "pattern"])
def test_complex_problems(code, form):
    """An analytic f: its complex Jacobian stands for the real one of the pairs."""
    A = np.array([[-1 + 20j, 3, 0], [2j, -300, 1j], [0, 5, -40 - 9j]])
    band = np.array([np.append(0, np.diag(A, 1)), np.diag(A), np.append(np.diag(A, -1), 0)])
    options = {
        "differences": {},
        "dense": {"jac": lambda t, z: A},
        "sparse": {"jac": sparse.csc_array(A)},
        "banded": {"jac": band, "lband": 1, "uband": 1},
        "banded differences": {"lband": 1, "uband": 1},
        "pattern": {"jac_sparsity": A != 0},
    }[form]
    z0 = np.array([1, 1j, 2 - 1j])
    sol = code(lambda t, z: A @ z, (0, 2), z0, rtol=1e-8, atol=1e-10, **options)
    values, vectors = np.linalg.eig(A)
    exact = vectors @ (np.exp(2 * values) * np.linalg.solve(vectors, z0))
    np.testing.assert_allclose(sol.y[:, -1], exact, atol=2e-6 * slack(code.__name__))
    reference = code(lambda t, z: A @ z, (0, 2), z0, rtol=1e-8, atol=1e-10, jac=A)
    assert sol.stats.steps == pytest.approx(reference.stats.steps, rel=0.05)


def test_complex_f_that_is_not_analytic(code):
    """z' = −100 z̄ …: no complex number stands for its derivative; differences of the pairs do."""
    sol = code(lambda t, z: -50 * (z + 0.9 * z.conj()), (0, 3), [1 + 1j], rtol=1e-6, atol=1e-12)
    assert sol.success
    np.testing.assert_allclose(sol.y[0, -1], 1j * np.exp(-5 * 3), rtol=1e-3)


REFUSED = {
    "shape": ({"jac": np.eye(2)}, ValueError, r"jac has shape \(2, 2\), expected shape \(3, 3\)"),
    "function's shape": (
        {"jac": lambda t, y: np.eye(2)},
        ValueError,
        r"jac\(t, y\) has shape \(2, 2\), expected shape \(3, 3\)",
    ),
    "function's shape, sparse": ({"jac": lambda t, y: sparse.eye_array(4)}, ValueError, r"shape \(4, 4\)"),
    "a vector": ({"jac": [1, 2, 3]}, ValueError, r"jac has shape \(3,\), expected shape \(3, 3\)"),
    "text": (
        {"jac": "exact"},
        ValueError,
        "jac must be a function, a matrix, 'trace', 'complex-step' or 'differences', got 'exact'",
    ),
    "text for a pattern": ({"jac_sparsity": "some"}, ValueError, "jac_sparsity must be a matrix, 'detect' or 'dense'"),
    "None": ({"jac": lambda t, y: None}, TypeError, r"jac\(t, y\) must hold numbers"),
    "complex": ({"jac": 1j * np.eye(3)}, TypeError, "jac is complex, expected real numbers"),
    "not packed": (
        {"jac": np.eye(3), "lband": 0, "uband": 1},
        ValueError,
        r"expected shape \(2, 3\) \(the bands, packed as \[uband \+ i - j, j\]\)",
    ),
    "band too wide": ({"lband": 3}, ValueError, "lband must be a bandwidth, an integer from 0 to 2, got 3"),
    "band negative": ({"uband": -1}, ValueError, "uband must be a bandwidth"),
    "band float": ({"uband": 1.5}, TypeError, "uband must be a bandwidth"),
    "band and pattern": ({"uband": 1, "jac_sparsity": np.eye(3)}, ValueError, "either jac_sparsity or lband and uband"),
    "pattern's shape": ({"jac_sparsity": np.eye(2)}, ValueError, r"jac_sparsity has shape \(2, 2\)"),
    "max_order 6": ({"max_order": 6}, ValueError, "max_order must be from 1 to 5 for ode15s, got 6"),
    "max_order 0": ({"max_order": 0}, ValueError, "max_order must be a positive integer"),
    "bdf": ({"bdf": "yes"}, TypeError, "bdf must be True or False"),
    "mass's shape": ({"mass": np.eye(2)}, ValueError, r"mass has shape \(2, 2\), expected shape \(3, 3\)"),
    "mass's shape later": (
        {"mass": lambda t: np.eye(3) if t == 0 else np.eye(2)},
        ValueError,
        r"mass has shape \(2, 2\)",
    ),
    "mass outside of the band": (
        {"mass": np.ones((3, 3)) + np.eye(3), "lband": 1, "uband": 1},
        ValueError,
        "mass has entries outside the band",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    options, error, message = REFUSED[name]
    with pytest.raises(error, match=message):
        iv.ode15s(ROBERTSON.fun, (0, 1), ROBERTSON.y0, **options)


def test_pattern_with_a_jacobian_is_warned_of():
    with pytest.warns(UserWarning, match="jac_sparsity has no effect together with jac"):
        iv.ode15s(ROBERTSON.fun, (0, 1), ROBERTSON.y0, jac=ROBERTSON.jac, jac_sparsity=np.eye(3))


def test_dense_jacobian_of_very_many_components_is_warned_of(monkeypatch):
    monkeypatch.setattr("invariode._linear.linear_terms._DENSE_LIMIT", 1000)
    with pytest.warns(UserWarning, match="a dense Jacobian of 12 components takes .* jac=Banded"):
        iv.ode15s(lambda t, y: -y, (0, 1), np.ones(12))


@pytest.mark.parametrize("wrong", ["jac", "mass"])
def test_exceptions_of_matrix_functions_come_out_unchanged(code, wrong):
    class MineError(Exception):
        pass

    def matrix(t, *_):
        if t > 0.01:
            raise MineError(t)
        return np.eye(3) if wrong == "mass" else ROBERTSON.jac(t, ROBERTSON.y0)

    if wrong == "mass" and iv.METHODS[code.__name__].mass != "any":
        pytest.skip("takes no M(t)")
    with pytest.raises(MineError):
        code(ROBERTSON.fun, (0, 1e6), ROBERTSON.y0, **{wrong: matrix})


def test_jacobian_that_is_not_finite_is_said(code):
    sol = code(ROBERTSON.fun, (0, 1e4), ROBERTSON.y0, jac=lambda t, y: np.full((3, 3), np.nan if t > 0.1 else 0.0))
    assert sol.status == -1
    assert "Jacobian of fun is NaN or infinite" in sol.message


def test_singular_iteration_matrix_is_said():
    """From t = 0.5 on y1 appears in no equation: M − h c J is singular for every h."""
    sol = iv.ode15s(
        lambda t, y: [-y[0], 0], (0, 1), [1, 1], mass=lambda t: np.diag([1.0, t < 0.5]), jac=np.diag([-1.0, 0])
    )
    assert sol.status == -1
    assert "The iteration matrix M - h c J is singular" in sol.message
    assert sol.t[-1] == pytest.approx(0.5, abs=0.02)


def test_pattern_that_misses_entries_is_enlarged_and_named():
    """The stiff coupling is not in the pattern: it takes hardly more steps than with all of it."""
    full = iv.ode15s(ROBERTSON.fun, (0, 100), ROBERTSON.y0, rtol=1e-4, atol=1e-8)
    with pytest.warns(UserWarning, match=r"jac_sparsity misses the entry \(1, 0\)"):
        missing = iv.ode15s(ROBERTSON.fun, (0, 100), ROBERTSON.y0, rtol=1e-4, atol=1e-8, jac_sparsity=np.eye(3))
    assert missing.success
    assert missing.stats.steps <= 1.1 * full.stats.steps
    np.testing.assert_allclose(missing.y[:, -1], full.y[:, -1], rtol=1e-2)


class TestMass:
    """M y' = f."""

    @dealt(10, code=IMPLICIT, form=["dense", "sparse", "function", "sparse function", "banded"])
    def test_multiplying_by_a_regular_matrix_reproduces_the_run(self, code, form):
        M = np.diag([2.0, 0.5, 4]) + np.diag([0.25, -0.5], 1)
        options = {
            "dense": {"mass": M},
            "sparse": {"mass": sparse.csr_array(M)},
            "function": {"mass": lambda t: M},
            "sparse function": {"mass": lambda t: sparse.csc_array(M), "jac_sparsity": np.ones((3, 3))},
            "banded": {"mass": M, "lband": 2, "uband": 2},
        }[form]
        if callable(options["mass"]) and iv.METHODS[code.__name__].mass != "any":
            pytest.skip("takes no M(t)")
        given = {"jac": ROBERTSON.jac, "mass": np.eye(3)}  # with M, ode15s does not look at old Jacobians
        plain = code(ROBERTSON.fun, (0, 1e4), ROBERTSON.y0, rtol=1e-5, atol=1e-9, **given)
        if form == "dense":
            options["jac"] = lambda t, y: M @ ROBERTSON.jac(t, y)
        sol = code(lambda t, y: M @ ROBERTSON.fun(t, y), (0, 1e4), ROBERTSON.y0, rtol=1e-5, atol=1e-9, **options)
        assert (sol.stats.steps, sol.stats.failed, sol.nlu) == (plain.stats.steps, plain.stats.failed, plain.nlu)
        looser = 10 if code is iv.radau else slack(code.__name__)  # a step may end one iteration earlier
        np.testing.assert_allclose(sol.y, plain.y, rtol=1e-6 * looser, atol=1e-12)

    def test_mass_that_depends_on_t(self, algebraic_code):
        """(1 + t²) y' = −2 t y + …: solution known."""
        sol = algebraic_code(
            lambda t, y: [-2 * t * y[0], -(2 + np.sin(t)) * y[1]],
            (0, 3),
            [1, 1],
            mass=lambda t: np.diag([1 + t * t, 2 + np.sin(t)]),
            rtol=1e-8,
            atol=1e-10,
        )
        np.testing.assert_allclose(sol.y[:, -1], [1 / 10, np.exp(-3)], rtol=1e-5)

    def test_arguments_are_handed_on(self, algebraic_code):
        sol = algebraic_code(lambda t, y, a: [-a * y[0]], (0, 1), [1], mass=lambda t, a: [[a]], args=(3.0,), rtol=1e-6)
        assert sol.y[0, -1] == pytest.approx(np.exp(-1), rel=1e-4)

    def test_complex(self, code):
        M = np.array([[1 + 1j]])
        sol = code(lambda t, z: (1 + 1j) * 2j * z, (0, 1), [1 + 0j], mass=M, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(sol.y[0, -1], np.exp(2j), atol=1e-5)

    def test_events_and_dense_output(self, code):
        sol = code(
            lambda t, y: [2 * y[1], -2 * y[0]],
            (0, 10),
            [0, 1],
            mass=2 * np.eye(2),
            rtol=1e-8,
            atol=1e-10,
            events=lambda t, y: y[0],
            dense_output=True,
        )
        np.testing.assert_allclose(sol.t_events[0], np.pi * np.arange(1, 4), atol=1e-5)
        np.testing.assert_allclose(sol.sol(1.0), [np.sin(1), np.cos(1)], atol=1e-6)


@pytest.mark.parametrize("mass", [lambda t: np.eye(2), np.diag([1.0, 0])], ids=["M(t)", "singular"])
@pytest.mark.parametrize("method", [name for name, about in METHODS.items() if about.mass == "regular"])
def test_a_method_for_constant_regular_mass_says_so(method, mass):
    with pytest.raises(ValueError, match=f"{method} takes a constant and regular mass matrix only; use ode15s"):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0, 0.0], method, mass=mass)


def robertson_dae(t, y):
    return [*ROBERTSON.fun(t, y)[:2], y.sum() - 1]


DAE_FORMS = {
    "dense": {"mass": np.diag([1.0, 1, 0])},
    "sparse": {"mass": sparse.diags_array([1.0, 1, 0]), "jac_sparsity": np.ones((3, 3))},
    "function": {"mass": lambda t: np.diag([1.0, 1, 0])},
    "banded": {"mass": np.diag([1.0, 1, 0]), "lband": 2, "uband": 2},
}


class TestDae:
    """Singular M, index 1."""

    @dealt(8, algebraic_code=ALGEBRAIC, form=DAE_FORMS)
    def test_robertson(self, algebraic_code, form):
        times = ROBERTSON.times
        sol = algebraic_code(
            robertson_dae, ROBERTSON.t_span, [1, 0, 0], t_eval=times, rtol=1e-6, atol=1e-6 * ROBERTSON.scale,
            **DAE_FORMS[form],
        )  # fmt: skip
        assert sol.success, sol.message
        assert ROBERTSON.error(sol.y) <= 50e-6
        assert np.abs(sol.y.sum(axis=0) - 1).max() < 1e-6

    @dealt(8, algebraic_code=ALGEBRAIC, form=DAE_FORMS)
    def test_start_is_made_consistent(self, algebraic_code, form):
        sol = algebraic_code(robertson_dae, (0, 100), [1, 0, 0.3], **DAE_FORMS[form])
        assert sol.stats.projected_start
        np.testing.assert_allclose(sol.y[:, 0], [1, 0, 0], atol=1e-14)
        exact = algebraic_code(robertson_dae, (0, 100), [1, 0, 0], **DAE_FORMS[form])
        assert not exact.stats.projected_start
        np.testing.assert_allclose(sol.y[:, -1], exact.y[:, -1], rtol=1e-3)

    def test_nonlinear_constraint(self, algebraic_code):
        """z³ + z = y, y' = −z: from z far off."""

        def fun(t, y):
            return [-y[1], y[1] ** 3 + y[1] - y[0]]

        sol = algebraic_code(fun, (0, 2), [2, 5], mass=np.diag([1.0, 0]), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(sol.y[:, 0], [2, 1], atol=1e-12)
        # with z as the independent variable (3 z² + 1) z' = −z: 3 z²/2 + log z + t is constant
        z = sol.y[1]
        np.testing.assert_allclose(1.5 * z**2 + np.log(z) + sol.t, 1.5, atol=2e-5)

    def test_mass_whose_null_space_is_not_evident(self, algebraic_code):
        """A system in other unknowns and equations: A M B y' = A f(B y)."""
        rng = np.random.default_rng(5)
        A, B = rng.normal(size=(2, 3, 3))
        y0 = np.linalg.solve(B, [1, 0, 0])
        sol = algebraic_code(
            lambda t, y: A @ robertson_dae(t, B @ y), (0, 100), y0, mass=A @ np.diag([1.0, 1, 0]) @ B, rtol=1e-7,
            atol=1e-11,
        )  # fmt: skip
        plain = algebraic_code(robertson_dae, (0, 100), [1, 0, 0], mass=np.diag([1.0, 1, 0]), rtol=1e-7, atol=1e-11)
        assert sol.success
        np.testing.assert_allclose((B @ sol.y)[:, -1], plain.y[:, -1], rtol=1e-4, atol=1e-9)

    def test_invariants_together_with_algebraic_equations(self, algebraic_code):
        """A pendulum whose tension is an unknown: an algebraic equation determines it, the constraints are kept."""

        def fun(t, y):
            x, z, u, v, tension = y
            return [u, v, -tension * x, -tension * z - 1, u * u + v * v - z - tension * (x * x + z * z)]

        def constraints(t, y):
            x, z, u, v, _ = y
            return [x * x + z * z - 1, x * u + z * v]

        mass = np.diag([1.0, 1, 1, 1, 0])
        options = {"mass": mass, "rtol": 1e-5, "atol": 1e-8}
        plain = algebraic_code(fun, (0, 20), [1, 0, 0, 0, 0], **options)
        held = iv.Invariants(constraints, value=0, names=["length", "velocity"])
        sol = algebraic_code(fun, (0, 20), [1, 0, 0, 0, 0], invariants=held, refine=3, dense_output=True, **options)
        assert sol.success, sol.message
        drift = max(np.abs(constraints(t, y)).max() for t, y in zip(plain.t, plain.y.T, strict=True))
        assert np.abs(sol.residual).max() < 1e-2 * drift
        algebraic = [fun(t, y)[4] for t, y in zip(sol.t[::3], sol.y[:, ::3].T, strict=True)]
        assert np.abs(algebraic).max() < 1e-6
        tight = iv.ode45(
            lambda t, y: fun(t, [*y, (y[2] ** 2 + y[3] ** 2 - y[1]) / (y[0] ** 2 + y[1] ** 2)])[:4],
            (0, 20), [1, 0, 0, 0], rtol=1e-12, atol=1e-12,
        )  # fmt: skip
        second_order = iv.METHODS[algebraic_code.__name__].order == 2  # ode23t: 116 rtol, ode23tb: 88 rtol
        assert np.abs(sol.y[:4, -1] - tight.y[:, -1]).max() < (200 if second_order else 100) * 1e-5

    def test_wrong_invariant_is_found(self, algebraic_code):
        held = iv.Invariants(lambda t, y: y[0] + 2 * y[1] + y[2], names="wrong sum")
        with pytest.raises(iv.InvariantError, match="wrong sum is not conserved"):
            algebraic_code(robertson_dae, (0, 100), [1, 0, 0], mass=np.diag([1.0, 1, 0]), invariants=held)

    def test_index_above_1_is_refused(self, algebraic_code):
        """The pendulum with its length as the algebraic equation: index 3."""

        def fun(t, y):
            x, z, u, v, tension = y
            return [u, v, -tension * x, -tension * z - 1, x * x + z * z - 1]

        with pytest.raises(ValueError, match=r"index 1 at t = 0\.0: .* solve_dae, .* differentiates constraints"):
            algebraic_code(fun, (0, 1), [1, 0, 0, 0, 0], mass=np.diag([1.0, 1, 1, 1, 0]))

    def test_start_without_consistent_values_is_refused(self, algebraic_code):
        with pytest.raises(ValueError, match="y0 does not satisfy the algebraic equations"):
            algebraic_code(lambda t, y: [-y[0], y[1] ** 2 + 1], (0, 1), [1, 0.5], mass=np.diag([1.0, 0]))

    def test_large_sparse_system(self, algebraic_code):
        """Diffusion whose boundary values are algebraic: rows of zeros in a sparse M."""
        n = 20_000
        x = np.linspace(0, 1, n)

        def fun(t, u):
            du = np.empty(n)
            du[1:-1] = (u[2:] - 2 * u[1:-1] + u[:-2]) * (n - 1) ** 2 * 1e-2
            du[0], du[-1] = u[0], u[-1]
            return du

        diagonal = np.ones(n)
        diagonal[[0, -1]] = 0
        pattern = sparse.diags_array([np.ones(n - 1), np.ones(n), np.ones(n - 1)], offsets=[-1, 0, 1])
        u0 = np.sin(np.pi * x) + 0.1 * (x == 0)
        sol = algebraic_code(fun, (0, 10), u0, mass=sparse.diags_array(diagonal), jac_sparsity=pattern, keep="end")
        assert sol.success
        np.testing.assert_allclose(sol.y[:, -1], np.sin(np.pi * x) * np.exp(-(np.pi**2) * 0.1), atol=2e-3)


@pytest.mark.parametrize("order", [1, 2, 5])
def test_max_order_of_ode15s(order):
    sol = iv.ode15s(ROBERTSON.fun, (0, 1e4), ROBERTSON.y0, max_order=order, rtol=1e-7, atol=1e-11)
    assert sol.success
    assert sol.steps.order.max() == order


@pytest.mark.parametrize(("given", "order"), [(5, 5), (8, 5), (9, 9), (13, 13), (None, 13)])
def test_max_order_of_radau(given, order):
    sol = iv.radau(ROBERTSON.fun, (0, 1e4), ROBERTSON.y0, max_order=given, rtol=1e-9, atol=1e-13)
    assert sol.success
    assert sol.steps.order.max() == order
    assert set(sol.steps.order) <= {5, 9, 13}
    looser = iv.radau(ROBERTSON.fun, (0, 1e4), ROBERTSON.y0, max_order=given, rtol=1e-6, atol=1e-10)
    assert looser.steps.order.max() == min(order, 9)  # seven stages do not pay there
    np.testing.assert_allclose(sol.y[:, -1], looser.y[:, -1], rtol=1e-5)


def test_radau_does_not_take_an_order_below_its_lowest():
    with pytest.raises(ValueError, match="max_order must be from 5 to 13 for radau, got 3"):
        iv.radau(ROBERTSON.fun, (0, 1), ROBERTSON.y0, max_order=3)


def test_order_of_radau_falls_where_newtons_iteration_is_slow():
    """Relaxation oscillations: high orders on the slow parts, low ones in the jumps between them."""
    sol = iv.radau(
        lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] * 100 - y[0]], (0, 300), [2, 0], rtol=1e-6, atol=1e-6,
        jac=lambda t, y: [[0, 1], [-200 * y[0] * y[1] - 1, 100 * (1 - y[0] ** 2)]],
    )  # fmt: skip
    change = np.diff(sol.steps.order)
    assert np.any(change > 0)
    assert np.any(change < 0)


@pytest.mark.parametrize("order", [1, 3, 7, 12])
def test_max_order_of_ode113(order):
    rtol = 1e-4 if order == 1 else 1e-13 if order == 12 else 1e-7
    sol = iv.ode113(lambda t, y: [y[1], -y[0]], (0, 20), [0, 1], max_order=order, rtol=rtol, atol=0.1 * rtol)
    assert sol.success
    assert sol.steps.order.max() == order


def test_backwards(code):
    """The Jacobian is the same: the first error estimate of ode23t has y'', and the roundoff of differences with it."""
    options = {"rtol": 1e-8, "atol": 1e-10}
    forward = code(diffusion, (0, 1), U0, jac=diffusion_jacobian, **options)
    jac = lambda t, u: -diffusion_jacobian(-t, u)  # noqa: E731  # beside the f that it belongs to
    mirrored = code(lambda t, u: -diffusion(-t, u), (0, -1), U0, jac=jac, **options)
    np.testing.assert_allclose(mirrored.t, -forward.t, rtol=1e-6 * slack(code.__name__))
    np.testing.assert_allclose(mirrored.y, forward.y, rtol=1e-6 * slack(code.__name__))


@dealt(algebraic_code=ALGEBRAIC, rtol=[1e-9, 1e-10, 1e-12])
def test_differences_see_every_column_of_an_algebraic_equation_also_where_atol_is_tiny(algebraic_code, rtol):
    """a + b + c = 1 at (1, 0, 0): increments of the size of atol would vanish beside 1."""

    def robertson(t, y):
        a, b, c = y
        return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, a + b + c - 1]

    if iv.METHODS[algebraic_code.__name__].order == 2 and rtol < 1e-10:
        pytest.skip("Newton's iteration would have to be more exact than roundoff")
    mass = [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
    sol = algebraic_code(robertson, (0, 400), [1, 0, 0], mass=mass, rtol=rtol, atol=1e-3 * rtol)
    assert sol.success
    np.testing.assert_allclose(sol.y.sum(axis=0), 1, atol=1e-14)


def _pointing_outside(form: str, index: int) -> sparse.sparray:
    """A sparse matrix of shape (2, 2), with one index that is not in it; no constructor of SciPy's has looked."""
    matrix = sparse.coo_array(np.array([[1.0, 2.0], [3.0, 4.0]])).asformat(form)
    if form == "coo":
        matrix.row[-1] = index
    elif form == "lil":
        matrix.rows[1][-1] = index
    else:
        matrix.indices[-1] = index
    return matrix


@dealt(form=["csc", "csr", "bsr", "coo", "lil"], index=[2, 10**8, -1])
def test_a_sparse_matrix_that_points_outside_of_its_shape_is_refused(form, index):
    """Whoever converts it writes there: the heap is damaged, and the process dies at some later time."""
    outside = _pointing_outside(form, index)

    def later(t, y):
        return outside if t > 0 else sparse.csc_array(np.eye(2))

    for options in (
        {"jac": outside},
        {"jac": lambda t, y: outside},
        {"jac": later},
        {"jac_sparsity": outside},
        {"mass": outside},
        {"mass": lambda t: outside},
        {"mass": outside, "lband": 1, "uband": 1},
        {"mass": outside, "jac": np.eye(2)},
    ):
        with pytest.raises(ValueError, match=r"is a sparse matrix whose indices do not fit its shape \(2, 2\)"):
            iv.ode15s(lambda t, y: -(y**3), (0, 100), [1.0, 2.0], **options)


@pytest.mark.parametrize("starts", [[0, 1, 9], [0, 9, 4], [3, 2, 4], [0, -5, 4], [0, 4]])
def test_a_sparse_matrix_whose_columns_are_no_columns_is_refused(starts):
    matrix = sparse.csc_array(np.ones((2, 2)))
    matrix.indptr = np.array(starts)
    with pytest.raises(ValueError, match="jac is a sparse matrix whose indices do not fit"):
        iv.ode15s(lambda t, y: -y, (0, 1), [1.0, 2.0], jac=matrix)


def test_diagonals_that_are_given_twice_are_refused():
    matrix = sparse.dia_array(([[1.0, 1.0], [2.0, 2.0]], [0, 1]), (2, 2))
    matrix.offsets = np.array([0, 0])
    with pytest.raises(ValueError, match="jac is a sparse matrix whose indices do not fit"):
        iv.ode15s(lambda t, y: -y, (0, 1), [1.0, 2.0], jac=matrix)


def test_a_mass_matrix_that_there_is_no_memory_for_is_not_called_singular(monkeypatch):
    def splu(matrix):
        raise RuntimeError("Not enough memory to perform factorization.")

    monkeypatch.setattr("scipy.sparse.linalg.splu", splu)
    with pytest.raises(MemoryError, match="no memory for the LU factors of mass"):
        iv.ode15s(lambda t, y: -y, (0, 1), np.ones(80), mass=sparse.csc_array(np.eye(80)))


def test_a_matrix_that_says_wrongly_of_itself_that_it_is_sorted_is_read_and_left_alone():
    """SciPy remembers that the rows of each column ascend; who changes the indices does not tell it."""
    a = np.array([[-2.0, 1.0], [1.0, -3.0]])
    matrix = sparse.csc_array(a)
    assert matrix.has_canonical_format
    matrix.indices[:] = [1, 0, 1, 0]
    matrix.data[:] = a.T.ravel()[[1, 0, 3, 2]]
    indices = matrix.indices.copy()
    sol = iv.ode15s(lambda t, y: a @ y, (0, 1), [1.0, 2.0], jac=matrix)
    same = iv.ode15s(lambda t, y: a @ y, (0, 1), [1.0, 2.0], jac=sparse.csc_array(a))
    np.testing.assert_array_equal(sol.y, same.y)
    np.testing.assert_array_equal(matrix.indices, indices)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize(
    "form", [np.array, sparse.csc_array, lambda m: lambda t: np.array(m), lambda m: lambda t: sparse.csr_array(m)]
)
def test_a_mass_matrix_that_is_not_finite_is_refused_by_its_entry(form, bad):
    with pytest.raises(ValueError, match=rf"mass.* must be finite, got mass.*\[0, 1\] = {bad}"):
        iv.ode15s(lambda t, y: -y, (0, 1), [1.0, 2.0], mass=form([[1.0, bad], [0.0, 1.0]]))
    with pytest.raises(ValueError, match=rf"mass.* must be finite, got mass.*\[0, 1\] = {bad}"):
        iv.ode15s(lambda t, y: -y, (0, 1), [1.0, 2j], mass=form([[1.0, bad], [0.0, 1.0]]))


@pytest.mark.parametrize("name", ["jac", "mass", "jac_sparsity"])
def test_a_ragged_matrix_is_refused_by_name(name):
    with pytest.raises(ValueError, match=f"{name} must be .* with rows of equal length"):
        iv.ode15s(lambda t, y: -y, (0, 1), [1.0, 2.0], **{name: [[1], [1, 2]]})
    if name == "jac":
        with pytest.raises(ValueError, match=r"jac\(t, y\) must be .* with rows of equal length"):
            iv.ode15s(lambda t, y: -y, (0, 1), [1.0, 2.0], jac=lambda t, y: [[1], [1, 2]])


def test_a_mass_matrix_that_is_nan_from_some_time_on_is_told(algebraic_code):
    def mass(t):
        return np.diag([1.0, 1.0 if t < 1 else np.nan])

    sol = algebraic_code(lambda t, y: -y, (0, 3), [1.0, 1.0], mass=mass)
    assert sol.status == -1
    assert sol.t[-1] == pytest.approx(1)
    assert "mass matrix becomes NaN" in sol.message
