"""Matrix-free Newton: GMRES solves what LU factors solve, without the Jacobian; what is kept, counted, continued and
refused."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, aslinearoperator, splu

import invariode as iv
from cases import METHODS, dealt

MATRIX_FREE = [name for name, about in METHODS.items() if "linear_solver" in about.options]
ALONE = [name for name in MATRIX_FREE if "prefer" not in METHODS[name].options]  # auto has an explicit way out
WITH_MATRIX = [name for name, about in METHODS.items() if "jac" in about.options and name not in MATRIX_FREE]

#: What makes a method with LU factors the one without: the order of radau is 5 unless max_order allows more.
LIKE = {name: {"max_order": 5} if name == "radau" else {} for name in MATRIX_FREE}

SIDE = 12
N = SIDE**2
_LINE = (
    sp.diags_array([np.ones(SIDE - 1), np.full(SIDE, -2.0), np.ones(SIDE - 1)], offsets=[-1, 0, 1]) * (SIDE + 1) ** 2
)
DIFFUSION = sp.csc_array(sp.kron(_LINE, sp.eye_array(SIDE)) + sp.kron(sp.eye_array(SIDE), _LINE))
_X = np.arange(1, SIDE + 1) / (SIDE + 1)
Y0 = np.outer(np.sin(np.pi * _X), np.sin(np.pi * _X) + 0.3 * np.sin(5 * np.pi * _X)).ravel()
EYE = sp.csc_array(sp.eye_array(N))


def reacting(t, y):
    """Diffusion and reaction on a square, 0 around it: eigenvalues down to -1300."""
    return DIFFUSION @ y + 5 * y * (1 - y) + np.sin(5 * t)


def jacobian(t, y):
    return sp.csc_array(DIFFUSION + sp.diags_array(5 - 10 * y))


def product(t, y, v):
    return DIFFUSION @ v + (5 - 10 * y) * v


def diffusive(t, y, c):
    """Without the reaction."""
    return splu(sp.csc_array(EYE - c * DIFFUSION))


def gmres(**options):
    """The options, with those of GMRES in one."""
    own = {name: options.pop(name) for name in ("dimension", "preconditioner", "jac_product") if name in options}
    return {"linear_solver": iv.GMRES(**own), **options}


def solve(method="ode15s", rtol=1e-4, **options):
    return iv.solve_ivp(reacting, (0, 0.5), Y0, method, rtol=rtol, atol=rtol, **gmres(**options))


FORMS = {
    "differences": {},
    "jac='differences'": {"jac": "differences"},
    "jac_product": {"jac_product": product},
    "jac, sparse": {"jac": jacobian},
    "jac, dense": {"jac": lambda t, y: jacobian(t, y).toarray()},
    "jac, operator": {"jac": lambda t, y: aslinearoperator(jacobian(t, y))},
    "jac, constant": {"jac": aslinearoperator(DIFFUSION)},  # not quite that of f
    "preconditioned": {"preconditioner": diffusive},
    "short cycles": {"dimension": 3},
}


@pytest.fixture(scope="module")
def exact():
    return iv.radau(reacting, (0, 0.5), Y0, rtol=1e-9, atol=1e-10, jac=jacobian).y[:, -1]


@dealt(method=MATRIX_FREE, form=FORMS)
def test_it_is_as_accurate_as_with_lu_factors(method, form, exact):
    """GMRES leaves a twentieth of what Newton's iteration may leave: a fraction of the tolerance in all."""
    for rtol in (1e-3, 1e-6):
        direct = iv.solve_ivp(reacting, (0, 0.5), Y0, method, rtol=rtol, atol=rtol, jac=jacobian, **LIKE[method])
        free = solve(method, rtol, **FORMS[form])
        assert free.success
        errors = [np.abs(sol.y[:, -1] - exact).max() for sol in (free, direct)]
        assert errors[0] < errors[1] + 0.5 * rtol
        if form != "jac, constant":
            assert free.stats.steps < 1.1 * direct.stats.steps


@pytest.mark.parametrize("method", MATRIX_FREE)
def test_counts(method):
    """Each iteration takes one product, in complex systems two, and y'' at the start another one; by differences each
    is a call of f. auto takes twelve more where it looks at the spectral radius: as it hands over, every 25 steps."""
    plain, given = solve(method), solve(method, jac_product=product)
    for sol in (plain, given):
        stats = sol.stats
        looks = sum(1 + (sol.steps.method == "ode15s").sum() // 25 for _ in range(stats.switches))
        products = stats.linear_iterations + 1 + 12 * looks
        assert products < stats.products < 2 * products if method == "radau" else stats.products == products
        assert stats.linear_iterations >= stats.nsolve > 0
        assert stats.njev == stats.nlu == 0
    assert plain.nfev > plain.stats.products
    assert given.nfev < given.stats.products
    direct = iv.solve_ivp(reacting, (0, 0.5), Y0, method, jac=jacobian)
    assert direct.stats.products == direct.stats.linear_iterations == 0


@pytest.mark.parametrize("method", MATRIX_FREE)
def test_a_preconditioner_saves_more_than_half_of_the_iterations(method):
    plain, preconditioned = solve(method, rtol=1e-3), solve(method, rtol=1e-3, preconditioner=diffusive)
    beyond_first = [sol.stats.linear_iterations - sol.stats.nsolve for sol in (plain, preconditioned)]
    assert 2 * beyond_first[1] < beyond_first[0]  # each solve takes one at least, also those of radau inside long steps
    assert 0 < preconditioned.stats.nlu < preconditioned.stats.steps


def test_all_forms_of_a_preconditioner_are_the_same():
    def operator(t, y, c):
        lu = diffusive(t, y, c)
        return LinearOperator((N, N), matvec=lu.solve, dtype=float)

    def function(t, y, c):
        return diffusive(t, y, c).solve

    ends = [solve(preconditioner=one).y[:, -1] for one in (diffusive, operator, function)]
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_scale_of_a_preconditioner_does_not_matter(scale):
    def scaled(t, y, c):
        lu = diffusive(t, y, c)
        return lambda b: scale * lu.solve(b)

    right, other = solve(preconditioner=diffusive), solve(preconditioner=scaled)
    assert np.abs(right.y[:, -1] - other.y[:, -1]).max() < 0.5e-4


def test_what_is_localised_is_solved_too():
    """The mean of a residual over many components hides one that is large: the largest one counts."""
    size = 2000

    def mostly_at_rest(t, y):
        slope = np.zeros(size)
        slope[:2] = 1e3 * (np.cos(t) - y[0]) + y[1], -10 * y[1]
        return slope

    sol = iv.ode15s(mostly_at_rest, (0, 1), np.ones(size), linear_solver="gmres", rtol=1e-6, atol=1e-9)

    def at_work(t, y):
        return mostly_at_rest(t, np.append(y, np.ones(size - 2)))[:2]

    few = iv.ode15s(at_work, (0, 1), [1.0, 1.0], rtol=1e-8)
    assert np.abs(sol.y[:2, -1] - few.y[:, -1]).max() < 1e-5


@pytest.mark.parametrize("method", ALONE)
def test_complex_states(method):
    """Complex states are pairs of reals, also in products and preconditioners."""
    A = 1j * DIFFUSION / 50 - 5 * EYE
    options = {"rtol": 1e-6, "atol": 1e-8}
    y0 = Y0 * np.exp(1j * Y0)
    exact = iv.solve_ivp(lambda t, y: A @ y, (0, 0.3), y0, "radau", jac=A, **options).y[:, -1]
    for form in ({}, {"jac": A}, {"preconditioner": lambda t, y, c: splu(sp.csc_array(EYE - c * A))}):
        sol = iv.solve_ivp(lambda t, y: A @ y, (0, 0.3), y0, method, **gmres(**form), **options)
        assert np.abs(sol.y[:, -1] - exact).max() < 1e-5


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("method", MATRIX_FREE)
def test_mass_matrices(method, moving):
    """M y' = M f, with a preconditioner, takes the steps of y' = f (auto with both of its members only there)."""
    M = sp.csc_array(sp.diags_array(np.linspace(1e-3, 10, N)) + sp.eye_array(N, k=1) * 1e-3)

    def mass(t):
        return M * (1 + t) if moving else M

    def weighted(t, y):
        return mass(t) @ reacting(t, y)

    sol = iv.solve_ivp(
        weighted,
        (0, 0.5),
        Y0,
        method,
        rtol=1e-4,
        atol=1e-4,
        linear_solver=iv.GMRES(preconditioner=lambda t, y, c: splu(sp.csc_array(mass(t) @ (EYE - c * DIFFUSION)))),
        mass=mass if moving else M,
    )
    plain = solve("ode15s" if method == "auto" else method, preconditioner=diffusive)
    assert abs(sol.stats.steps - plain.stats.steps) <= 5
    assert np.abs(sol.y[:, -1] - plain.y[:, -1]).max() < 1e-4


@pytest.mark.parametrize("order", [9, 13])
def test_radau_goes_up_to_the_order_it_is_allowed(order):
    options = {"rtol": 1e-8, "max_order": order}
    free = solve("radau", **options)
    direct = iv.solve_ivp(reacting, (0, 0.5), Y0, "radau", atol=1e-8, jac=jacobian, **options)
    assert set(free.steps.order) == set(direct.steps.order)
    assert max(free.steps.order) == order
    assert abs(free.stats.steps - direct.stats.steps) <= 3
    assert np.abs(free.y[:, -1] - direct.y[:, -1]).max() < 1e-9
    assert set(solve("radau", rtol=1e-8).steps.order) == {5}


@pytest.mark.parametrize("method", MATRIX_FREE)
def test_projection(method):
    """A law that is not linear is kept to the square of what a step changes, plain and with a preconditioner."""
    turn = sp.csc_array(DIFFUSION * 0.02)

    def rotating(t, y):
        u, v = y[:N], y[N:]
        return np.concatenate([turn @ v, -(turn @ u)])

    y0 = np.concatenate([Y0, 0 * Y0])
    size = iv.Invariants(lambda t, y: y @ y, jac=lambda t, y: 2 * y)
    free = iv.solve_ivp(rotating, (0, 2), y0, method, linear_solver="gmres", rtol=1e-4)
    drift = abs((free.y**2).sum(axis=0) - y0 @ y0).max()
    for form in ({}, {"preconditioner": lambda t, y, c: lambda b: b}):
        sol = iv.solve_ivp(rotating, (0, 2), y0, method, invariants=size, rtol=1e-4, **gmres(**form))
        assert sol.success
        assert abs(sol.residual).max() < 1e-4 * drift
        assert sol.stats.projections > 0


# ----------------------------------------------------------------------------------------------------------------------
# auto


def relaxation(t, y):
    return [y[1], 100 * (1 - y[0] ** 2) * y[1] - y[0]]


def relaxation_product(t, y, v):
    return [v[1], (-200 * y[0] * y[1] - 1) * v[0] + 100 * (1 - y[0] ** 2) * v[1]]


RELAXATION = {"differences": {}, "jac_product": {"jac_product": relaxation_product}}


@pytest.mark.parametrize("form", RELAXATION)
def test_auto_hands_over_where_it_does_with_matrices(form):
    options = {"rtol": 1e-5, "atol": 1e-8}
    direct = iv.solve_ivp(relaxation, (0, 220), [2.0, 0.0], "auto", **options)
    free = iv.solve_ivp(relaxation, (0, 220), [2.0, 0.0], "auto", **gmres(**RELAXATION[form]), **options)
    assert free.stats.switches == direct.stats.switches >= 3
    assert abs(free.y[0, -1] - direct.y[0, -1]) < 1e-3
    turns = [np.flatnonzero(sol.steps.method[1:] != sol.steps.method[:-1]) for sol in (free, direct)]
    np.testing.assert_allclose(*[sol.steps.t[at] for sol, at in zip((free, direct), turns, strict=True)], atol=5)


@pytest.mark.parametrize("form", RELAXATION)
def test_auto_continues_bit_for_bit_wherever_it_is_cut(form):
    options = {"rtol": 1e-4, **gmres(**RELAXATION[form])}
    whole = iv.solve_ivp(relaxation, (0, 220), [2.0, 0.0], "auto", **options)
    assert whole.stats.switches >= 3
    for steps in range(40, whole.stats.steps, 60):
        part = iv.solve_ivp(relaxation, (0, 220), [2.0, 0.0], "auto", max_steps=steps, **options)
        both = part.extend(220, max_steps=None)
        np.testing.assert_array_equal(both.t, whole.t)
        np.testing.assert_array_equal(both.y, whole.y)
        assert both.stats.products == whole.stats.products


def test_auto_needs_no_pattern_for_a_large_stiff_problem():
    """With matrices auto would be explicit throughout."""
    sol = iv.solve_ivp(lambda t, y: 1e4 * (np.cos(t) - y), (0, 3), np.ones(20_000), "auto", linear_solver="gmres")
    assert sol.stats.switches == 1
    np.testing.assert_allclose(sol.y[:, -1], np.cos(3), atol=1e-3)


def test_an_exception_in_a_look_at_the_spectral_radius_comes_out_unchanged():
    """The first product of all is one of the start of ode15s, the second one of the look."""
    calls = 0

    def product(t, y, v):
        nonlocal calls
        calls += 1
        if calls == 2:
            raise KeyError("the second one")
        return -1e4 * v

    with pytest.raises(KeyError, match="the second one"):
        iv.solve_ivp(
            lambda t, y: 1e4 * (np.cos(t) - y), (0, 3), [1.0], "auto", linear_solver=iv.GMRES(jac_product=product)
        )


# ----------------------------------------------------------------------------------------------------------------------
# What is kept


def no_flux(t, y):
    """The sum is kept."""
    flux = 400 * np.diff(y) * (1 + y[1:])
    return np.diff(flux, prepend=0, append=0)


def no_flux_product(t, y, v):
    flux = 400 * (np.diff(v) * (1 + y[1:]) + np.diff(y) * v[1:])
    return np.diff(flux, prepend=0, append=0)


@pytest.mark.parametrize("method", MATRIX_FREE)
def test_linear_invariants(method):
    """An invariant that vanishes on f vanishes on J v: exact products keep it to roundoff, differences to the noise of
    f over √ε, a preconditioner that does not know it to the tolerance. Projection repairs that."""
    y0 = 1 + np.cos(np.linspace(0, np.pi, 40)) ** 2
    rtol = 1e-5

    def drift(**options):
        sol = iv.solve_ivp(no_flux, (0, 0.5), y0, method, rtol=rtol, atol=rtol, **gmres(**options))
        assert sol.success
        return np.abs(sol.y.sum(axis=0) - y0.sum()).max() / y0.sum()

    def diagonal(t, y, c):
        return lambda b: b / (1 + 800 * c * (1 + y))

    assert drift(jac_product=no_flux_product) < 1e-12
    assert drift() < 1e-9
    preconditioned = drift(preconditioner=diagonal)
    assert 1e-12 < preconditioned < 10 * rtol
    assert drift(preconditioner=diagonal, invariants=lambda t, y: y.sum()) < 1e-14


@pytest.mark.parametrize("method", MATRIX_FREE)
def test_events_output_and_breakpoints_work_as_with_lu_factors(method):
    def middle(t, y):
        return y[N // 2] - 0.2

    options = {"events": middle, "dense_output": True, "breakpoints": [0.2], "rtol": 1e-6}
    free = iv.solve_ivp(reacting, (0, 0.5), Y0, method, linear_solver=iv.GMRES(preconditioner=diffusive), **options)
    direct = iv.solve_ivp(reacting, (0, 0.5), Y0, method, jac=jacobian, **LIKE[method], **options)
    assert len(free.t_events[0]) == len(direct.t_events[0]) > 0
    np.testing.assert_allclose(free.t_events[0], direct.t_events[0], atol=1e-4)
    t = np.linspace(0, 0.5, 7)
    np.testing.assert_allclose(free.sol(t), direct.sol(t), atol=1e-4)


@pytest.mark.parametrize("form", ["differences", "preconditioned"])
@pytest.mark.parametrize("method", MATRIX_FREE)
def test_runs_continue_bit_for_bit(method, form):
    whole = solve(method, **FORMS[form])
    half = solve(method, max_steps=whole.stats.steps // 2, **FORMS[form])
    assert half.status == -3
    both = half.extend(0.5, max_steps=None)
    np.testing.assert_array_equal(both.t, whole.t)
    np.testing.assert_array_equal(both.y, whole.y)
    # A preconditioner is set up again where the run was cut.
    assert both.stats.linear_iterations == whole.stats.linear_iterations


def test_runs_continue_from_a_file_with_their_solver(tmp_path):
    """The functions of GMRES are given again; they, and its numbers, must be those of the run."""
    file, own = tmp_path / "run", iv.GMRES(preconditioner=diffusive, dimension=8)
    problem = iv.Problem(reacting, (0, 0.5), Y0)
    whole = problem.solve("ode15s", linear_solver=own)
    half = problem.solve("ode15s", linear_solver=own, limits=iv.Limits(steps=20, time=1e6), checkpoint=file)
    for path in (file, tmp_path / "saved"):
        half.save(tmp_path / "saved")
        loaded = iv.load(path, problem, linear_solver=own)
        np.testing.assert_array_equal(loaded.extend(0.5, max_steps=None).y, whole.y)
        with pytest.raises(ValueError, match="the run has linear_solver with functions, which are not in the file"):
            iv.load(path, problem)
        for other in ("direct", iv.GMRES(preconditioner=diffusive, dimension=9), iv.GMRES(dimension=8)):
            with pytest.raises(ValueError, match=r"linear_solver has .* here, and .*'dimension': 8.* in the file"):
                iv.load(path, problem, linear_solver=other)
        with pytest.raises(ValueError, match="the code of preconditioner is not that of the run"):
            iv.load(path, problem, linear_solver=iv.GMRES(preconditioner=lambda t, y, c: splu(EYE), dimension=8))
        half = problem.solve("ode15s", linear_solver=own, limits=iv.Limits(steps=20, time=1e6))


# ----------------------------------------------------------------------------------------------------------------------
# Failure and misuse


@pytest.mark.parametrize("method", ALONE)
def test_systems_that_are_not_solved_are_a_failure_with_advice(method):
    """With a cyclic shift as preconditioner GMRES gets nowhere until its space is the whole one; and f is so large that
    it matters in the smallest step."""
    shift = {"preconditioner": lambda t, y, c: lambda b: np.roll(b, 1), "jac_product": lambda t, y, v: -1e20 * v}
    sol = iv.solve_ivp(lambda t, y: -1e20 * y, (1, 2), np.eye(40)[0], method, first_step=1e-3, **gmres(**shift))
    assert sol.status == -1
    assert "GMRES does not solve the linear systems" in sol.message
    assert "give a better preconditioner, or a larger GMRES" in sol.message


UNDEFINED = {
    "jac_product": ({"jac_product": lambda t, y, v: np.nan * v}, "by jac_product or jac, is NaN or infinite at t = "),
    "jac": ({"jac": lambda t, y: np.full((N, N), np.nan)}, "by jac_product or jac, is NaN or infinite at t = "),
    "preconditioner, NaN": ({"preconditioner": lambda t, y, c: lambda b: np.nan * b}, "returns NaN or infinity"),
    "preconditioner, 0": ({"preconditioner": lambda t, y, c: lambda b: 0 * b}, "returns 0 for a b that is not 0"),
}


@dealt(8, method=ALONE, form=UNDEFINED, t0=[0, 1])
def test_what_is_never_defined_ends_a_run_after_eight_attempts(method, form, t0):
    """The smallest step at t = 0 is so small that hundreds would follow."""
    options, message = UNDEFINED[form]
    sol = iv.solve_ivp(reacting, (t0, t0 + 0.5), Y0, method, **gmres(**options))
    assert (sol.status, sol.stats.steps, sol.stats.failed) == (-1, 0, 8)
    assert message in sol.message
    assert "leave it out" in sol.message
    assert f"The run ends at t = {float(t0)}." in sol.message


@pytest.mark.parametrize("method", ALONE)
def test_what_is_not_defined_farther_on_ends_a_run_there(method):
    sol = solve(method, jac_product=lambda t, y, v: product(t, y, v) if t < 0.3 else np.nan * v, max_step=0.02)
    assert sol.status == -1
    assert 0.299 < sol.t[-1] < 0.32  # radau: J belongs to the start of a step
    assert "is NaN or infinite at t = 0.3" in sol.message


@pytest.mark.parametrize("method", ALONE)
def test_what_is_undefined_now_and_then_costs_attempts_only(method):
    calls = 0

    def product_with_gaps(t, y, v):
        nonlocal calls
        calls += 1
        return product(t, y, v) if calls % 20 else np.nan * v

    sol = solve(method, jac_product=product_with_gaps)
    assert sol.success
    assert np.abs(sol.y[:, -1] - solve(method).y[:, -1]).max() < 1e-3


def test_native_products():
    """y and v one after the other, as machine code gets them: the bits of the Python function."""
    address = ctypes.CFUNCTYPE(None, ctypes.c_double, *[ctypes.POINTER(ctypes.c_double)] * 3)

    @address
    def native(t, yv, out, p):
        y, v = (np.ctypeslib.as_array(yv, (2 * N,))[k * N : (k + 1) * N] for k in (0, 1))
        np.ctypeslib.as_array(out, (N,))[:] = product(t, y, v)

    np.testing.assert_array_equal(solve(jac_product=native).y, solve(jac_product=product).y)


def test_exceptions_come_out_unchanged():
    class UsersError(Exception):
        pass

    def raising(*_):
        raise UsersError

    for options in (
        {"jac_product": raising},
        {"preconditioner": raising},
        {"preconditioner": lambda t, y, c: raising},
        {"jac": raising},
    ):
        with pytest.raises(UsersError):
            solve(**options)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"jac_product": lambda t, y, v: v[:-1]}, ValueError, r"jac_product\(t, y, v\) returned shape \(143,\)"),
        ({"jac_product": 3.0}, TypeError, "jac_product of GMRES must be a function"),
        ({"jac": "complex-step"}, ValueError, "with GMRES give"),
        ({"jac_product": product, "jac": jacobian}, ValueError, "say the same"),
        ({"jac": lambda t, y: np.eye(3)}, ValueError, r"jac\(t, y\) has shape \(3, 3\), expected shape \(144, 144\)"),
        ({"preconditioner": lambda t, y, c: 3.0}, TypeError, "expected an object with solve"),
        ({"preconditioner": lambda t, y, c: lambda b: b[:2]}, ValueError, r"preconditioner returned shape \(2,\)"),
        ({"preconditioner": lambda t, y, c: lambda b: 1j * b}, TypeError, "preconditioner returned complex numbers"),
        ({"preconditioner": aslinearoperator(DIFFUSION)}, TypeError, "preconditioner of GMRES must be a function"),
        ({"mass": EYE}, ValueError, "needs a preconditioner if there is a mass matrix"),
        (
            {"mass": sp.diags_array(np.append(0.0, np.ones(N - 1))), "preconditioner": diffusive},
            ValueError,
            "singular mass matrix",
        ),
        ({"dimension": 0}, ValueError, "dimension of GMRES must be a positive integer"),
    ],
)
def test_misuse_is_an_error(options, error, match):
    with pytest.raises(error, match=match):
        solve(**options)


@pytest.mark.parametrize("method", WITH_MATRIX)
def test_methods_that_need_exact_solutions_say_so(method):
    match = f"{method} has no iteration that would correct what GMRES leaves, .* use one of ode15s, "
    with pytest.raises(ValueError, match=match):
        solve(method)
    with pytest.raises(ValueError, match=match):
        solve("auto", prefer=("ode45", method))


def test_what_has_no_effect_draws_a_warning():
    for known in ({"jac_sparsity": DIFFUSION}, {"jac": iv.Banded(12, 12)}):
        with pytest.warns(UserWarning, match="has no effect with GMRES"):
            solve(**known)
    with pytest.raises(TypeError, match="LinearOperator, whose entries are not known: give linear_solver='gmres'"):
        iv.ode15s(reacting, (0, 0.01), Y0, jac=aslinearoperator(DIFFUSION))
