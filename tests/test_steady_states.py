"""Steady states: where the solution goes, with exact totals and derivatives."""

from fractions import Fraction

import numpy as np
import pytest

import invariode as iv
from invariode._base.rational import fraction, left_null_space
from invariode._functions.graph.structure import linear_totals
from invariode._functions.graph.trace import trace


def enzyme(t, y, k1, k2, k3, k4):
    """S + E ⇌ C → P + E, P → S."""
    s, e, c, p = y
    bind, leave, make, back = k1 * s * e, k2 * c, k3 * c, k4 * p
    return [-bind + leave + back, -bind + leave + make, bind - leave - make, make - back]


def toggle(t, y, a, b):
    """Two genes that repress each other: two stable states with an unstable one between them."""
    return [a / (1 + y[1] ** 4) - y[0] + b * y[1], a / (1 + y[0] ** 4) - y[1] + b * y[0]]


def genes(t, y, k):
    return [k[0] - k[1] * y[0] * y[1], k[2] * y[0] - k[3] * y[1]]


PROBLEMS = {
    "enzyme": iv.Problem(enzyme, (0, 1), [2.0, 0.3, 0.1, 0.0], args=(1.0, 0.2, 0.7, 0.05), labels=["s", "e", "c", "p"]),
    "toggle": iv.Problem(toggle, (0, 1), [2.0, 0.1], args=(3.0, 0.02)),
    "genes": iv.Problem(genes, (0, 1), [0.0, 0.0], args=([1.0, 0.3, 2.0, 0.5],)),
    "stiff": iv.Problem(
        lambda t, y, k: [-0.04 * y[0] + k * y[1] * y[2] + 0.1 * y[2], 0.04 * y[0] - k * y[1] * y[2] - 3e7 * y[1] ** 2,
                         3e7 * y[1] ** 2 - 0.1 * y[2]], (0, 1), [1.0, 0.0, 0.0], args=(1e4,)),
}  # fmt: skip


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_state_is_the_end_of_a_long_run_with_the_totals_of_the_start(name):
    problem = PROBLEMS[name]
    found = iv.steady_state(problem)
    long = problem.replace(t_span=(0, 1e4)).solve("radau", rtol=1e-10, atol=1e-13).y[:, -1]
    assert found.success
    assert found.stable
    assert f"stable: {problem.labels[0]}={found.y[0]:.6g}" in str(found)
    np.testing.assert_allclose(found.y, long, rtol=1e-6, atol=1e-9)
    size = np.abs(found.totals) @ np.abs(found.y)
    assert (np.abs(found.totals @ (found.y - problem.y0)) <= 1e-14 * size).all()
    assert found.residual <= 1e-12 * max(np.abs(found.y).max(), 1)


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("compiled", [False, True])
def test_sensitivities_are_differences_of_states(name, compiled):
    """For all arguments and initial values: central differences, relative step 1e-5, of states within 1e-10."""
    problem = PROBLEMS[name].replace(sensitivities=iv.Sensitivities(args=True, y0=True))
    if compiled:
        problem = problem.replace(fun=iv.compile(problem.fun))
    found = iv.steady_state(problem)
    S, names = found.sensitivities, problem.parameter_names()
    assert found.sensitivity_names == [one.name for one in names]
    for j, one in enumerate(names):
        at = []
        for sign in (1, -1):
            if one.kind == "y0":
                y0 = problem.y0.copy()
                y0[one.index] += sign * 1e-5
                at.append(iv.steady_state(problem.replace(y0=y0, sensitivities=None)).y)
            else:
                flat = np.concatenate([np.ravel(x) for x in problem.args])
                step = 1e-5 * flat[j]
                flat[j] += sign * step
                args = (flat.tolist(),) if name == "genes" else tuple(flat.tolist())
                at.append(iv.steady_state(problem.replace(args=args, sensitivities=None)).y)
        h = 1e-5 if one.kind == "y0" else step
        np.testing.assert_allclose(S[:, j], (at[0] - at[1]) / (2 * h), rtol=1e-4, atol=1e-5 * np.abs(S).max())


def test_totals_are_found_in_the_structure_and_nowhere_else():
    """With slow exchange sampled Jacobians suggest a total that the system does not conserve."""

    def chain(t, y, k):
        a, b, c, d = y
        slow = 1e-9 * (b - c)
        return [-k * a + b, k * a - b - slow, slow - c * d, -c * d - 0.1 * d]

    assert linear_totals(trace(chain, 4, _args(1.0)).outputs) == []
    found = linear_totals(trace(enzyme, 4, _args(1.0, 1.0, 1.0, 1.0)).outputs)
    assert found == [{0: 1, 2: 1, 3: 1}, {1: 1, 2: 1}]


def _args(*values):
    from invariode._functions.layout import layout_of

    return layout_of(values)


def test_totals_of_products_written_in_other_ways():
    """(2 k a) b, -k (a - c) 0.3 and the like are multiplied out, with rational coefficients."""

    def f(t, y, k, v):
        a, _, c = y
        return [-0.3 * k * (a - c) / v, 0.1 * (k * a) / v - 0.1 * c * k / v, (a - c) * (0.2 * k / v)]

    found = linear_totals(trace(f, 3, _args(1.0, 2.0)).outputs)
    assert len(found) == 2
    rows = np.array([[one.get(i, 0) for i in range(3)] for one in found], float)
    np.testing.assert_array_equal(rows @ np.array([-3, 1, 2]), 0)


def test_elimination_is_exact():
    rng = np.random.default_rng(5)
    A = rng.integers(-3, 4, (9, 5))
    A[7], A[8] = A[0] + A[1], 2 * A[2] - A[3]
    rows = [{j: Fraction(int(x)) for j, x in enumerate(row)} for row in A]
    null = left_null_space(rows)
    assert len(null) == 9 - np.linalg.matrix_rank(A)
    for w in null:
        assert not sum(x * A[i] for i, x in w.items()).any()
    assert fraction(0.3) == Fraction(3, 10)
    assert fraction(1 / 3) == Fraction(1, 3)
    assert float(fraction(np.pi)) == np.pi


def test_absent_reactants_keep_their_partners_where_they_are():
    """A + E → B + E without E: A stays, and so does its derivative; E itself has none."""

    def f(t, y, k):
        v = k * y[0] * y[1]
        return [-v, 0 * v, v, 1 - y[3]]

    problem = iv.Problem(f, (0, 1), [2.0, 0.0, 0.0, 0.0], args=(1.0,), sensitivities=iv.Sensitivities(True, y0=True))
    found = iv.steady_state(problem)
    np.testing.assert_allclose(found.y, [2, 0, 0, 1], atol=1e-12)
    S = found.sensitivities
    np.testing.assert_allclose(
        S[:, [0, 1, 3, 4]], np.column_stack([np.zeros(4), *np.eye(4)[[0, 2]], np.zeros(4)]), atol=1e-12
    )
    assert np.isnan(S[:, 2]).all()


def test_rows_of_constant_components_hold_no_equations():
    """The roundoff of such rows, 1e-30 here, is not scaled up to an equation: derivatives of the others stay right."""
    from invariode._studies.steady import SteadyStates

    problem = iv.Problem(enzyme, (0, 1), [2.0, 0.3, 0.1, 0.0], args=(1.0, 0.2, 0.7, 0.05))
    states = SteadyStates(problem, ())
    J = np.vstack([np.eye(3, 4), [1e-30, 1e-30, 0, -0.05]])
    A, _ = states.system(J, np.zeros((0, 4)), np.ones(4), np.array([False, False, False, True]))
    np.testing.assert_array_equal(A[3], 0)
    np.testing.assert_array_equal(A[:, 3], 0)


def test_a_solution_passes_an_unstable_state_but_stays_at_one():
    def logistic(t, y):
        return [y[0] * (1 - y[0])]

    assert iv.steady_state(iv.Problem(logistic, (0, 1), [1e-12])).y == pytest.approx(1)
    there = iv.steady_state(iv.Problem(logistic, (0, 1), [0.0]))
    assert there.success
    assert not there.stable
    assert there.y == 0


def test_units_of_time_and_amount_do_not_matter():
    """y scales with the amounts, to roundoff amplified by Newton's tolerance."""
    plain = iv.steady_state(PROBLEMS["enzyme"])
    k1, k2, k3, k4 = PROBLEMS["enzyme"].args
    for a in (1e-9, 1e6):
        for s in (1e-6, 1e7):
            args = (k1 / a * s, k2 * s, k3 * s, k4 * s)
            found = iv.steady_state(PROBLEMS["enzyme"].replace(args=args, y0=a * PROBLEMS["enzyme"].y0))
            np.testing.assert_allclose(found.y, a * plain.y, rtol=1e-9)


def test_time_and_inputs_count_with_their_values_at_t0():
    u = iv.Input([0, 1, 2], [2.0, 5.0, 1.0])
    problem = iv.Problem(lambda t, y, u, k: [u * k + t - y[0]], (1.0, 2.0), [0.0], args=(3.0,), inputs=u)
    assert iv.steady_state(problem).y == pytest.approx(16.0)
    compiled = iv.Problem(iv.compile(lambda t, y, k: [k + t - y[0]]), (2.0, 3.0), [0.0], args=(3.0,))
    assert iv.steady_state(compiled).y == pytest.approx(5.0)


def test_a_mass_matrix_weighs_the_totals_and_its_algebraic_equations_hold():
    """2 a' = -a + b, 3 b' = a - b, 0 = c - a b: the total is 2 a + 3 b."""
    problem = iv.Problem(
        lambda t, y: [-y[0] + y[1], y[0] - y[1], y[2] - y[0] * y[1]], (0, 1), [1.0, 0.0, 0.0],
        mass=np.diag([2.0, 3.0, 0.0]))  # fmt: skip
    found = iv.steady_state(problem)
    np.testing.assert_allclose(found.y, [0.4, 0.4, 0.16], rtol=1e-12)
    with pytest.raises(ValueError, match="constant mass matrix"):
        iv.steady_state(problem.replace(mass=lambda t, y: np.eye(3)))


def test_functions_without_a_graph_take_totals_that_are_given():
    def untraceable(t, y, k):
        v = k * float(y[0]) - float(y[1])
        return np.array([-v, v])

    problem = iv.Problem(untraceable, (0, 1), [1.0, 0.0], args=(3.0,), labels=["a", "b"], sensitivities=True)
    for totals in ([[1, 1]], [{"a": 1, "b": 1}]):
        found = iv.steady_state(problem, totals=totals)
        np.testing.assert_allclose(found.y, [0.25, 0.75], rtol=1e-9)
        np.testing.assert_allclose(found.sensitivities.ravel(), [-1 / 16, 1 / 16], rtol=1e-6)
    with pytest.raises(ValueError, match="not conserved"):
        iv.steady_state(problem, totals=[[1, 2]])
    with pytest.raises(ValueError, match="did you mean"):
        iv.steady_state(problem, totals=[{"a": 1, "bb": 1}])


def test_a_formula_that_is_singular_where_f_is_not_has_steady_states():
    """√a b is 0 at a = b = 0, where its derivative is 0 · ∞ in the formula."""

    def fun(t, y, k):
        return [k - y[0], -y[1], np.sqrt(y[1]) * y[2] - 2 * y[2]]

    for form in (fun, iv.compile(fun)):
        for start in ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0]):
            found = iv.steady_state(iv.Problem(form, (0, 1), start, args=(3.0,), sensitivities=True))
            np.testing.assert_allclose(found.y, [3, 0, 0], atol=1e-12)
            np.testing.assert_allclose(found.sensitivities[:, 0], [1, 0, 0], atol=1e-12)


def test_a_count_has_no_derivative():
    problem = iv.Problem(
        lambda t, y, n: [sum(1.0 for _ in range(n)) - y[0]], (0, 1), [0.0], args=(3,), sensitivities=True
    )
    with pytest.raises(TypeError, match="no derivative with respect to n = 3"):
        iv.steady_state(problem)


def test_what_has_no_steady_state_says_so():
    growing = iv.Problem(lambda t, y: [1.0 + 0 * y[0]], (0, 1), [0.0])
    with pytest.warns(iv.FailureWarning, match="no steady state was found from"):
        found = iv.steady_state(growing)
    with pytest.raises(iv.SolveError, match="still moves"):
        iv.steady_state(growing, on_failure="raise")
    with pytest.warns(iv.FailureWarning):
        iv.steady_state(iv.Problem(lambda t, y: [y[0]], (0, 1), [1.0]))
    assert not found.success
    assert "still moves" in found.message
    assert "not reached" in repr(found)
    with pytest.raises(ValueError, match="there are no sensitivities"):
        _ = found.sensitivities
    with pytest.raises(TypeError, match=r"needs an invariode.Problem"):
        iv.steady_state(lambda t, y: y)
    with pytest.raises(ValueError, match="totals must be"):
        iv.steady_state(PROBLEMS["enzyme"], totals="all")


def test_a_start_that_leads_to_an_unstable_state_finds_it():
    """From the symmetric start of a toggle switch the solution stays symmetric, and from an unstable root it stays."""

    def toggle(t, y):
        return [4 / (1 + y[1] ** 2) - y[0], 4 / (1 + y[0] ** 2) - y[1]]

    u = 1.378796700129  # u + u³ = 4
    for start in ([1.0, 1.0], [u, u]):
        found = iv.steady_state(iv.Problem(toggle, (0, 1), start))
        assert (found.success, found.stable) == (True, False)
        assert found.y == pytest.approx([u, u], rel=1e-11)
    assert iv.steady_state(iv.Problem(toggle, (0, 1), [1.1, 1.0])).stable


def test_actions_of_breakpoints_do_not_count():
    """The message says so."""
    problem = iv.Problem(lambda t, y: [-y[0]], (0, 9), [1.0], breakpoints={3.0: lambda t, y: y + 1})
    found = iv.steady_state(problem)
    assert found.y == pytest.approx([0.0], abs=1e-9)
    assert "breakpoints, such as doses, do not count" in found.message


def test_a_mechanism_comes_to_rest_on_its_constraints():
    """A bead on a rod, pushed by a force F against its weight, damped: the rod points along (F, -m g), and pulls as
    much; derivatives of the place are those of the formula. Eigenvalues are of motions that the rod allows."""

    def force(t, q, v, F, weight):
        return np.array([F - 2 * v[0], -weight - 2 * v[1]])

    def rod(t, q, F, weight):
        return np.sqrt(q @ q) - 1

    F, weight = 0.75, 1.0
    arm = iv.MechanicalSystem([1, 1], force, rod, args=(F, weight))
    start = arm.problem((0, 1), [1, 0], [0, 0])
    found = iv.steady_state(start.replace(sensitivities=["F"]))
    assert (found.success, found.stable, len(found.eigenvalues)) == (True, True, 2)
    np.testing.assert_allclose(found.y, [0.6, -0.8, 0, 0], atol=1e-12)
    np.testing.assert_allclose(-arm.multipliers(found), [[1.25]], rtol=1e-10)
    np.testing.assert_allclose(arm.reactions(found)[:, 0], [-F, weight], rtol=1e-10)
    np.testing.assert_allclose(found.sensitivities[:, 0], [0.8**2 / 1.25, 0.6 * 0.8 / 1.25, 0, 0], atol=1e-6)


def test_an_invariant_selects_the_state_of_its_value():
    """y1 y2 is conserved, which no linear total says: the limit has the value of y0, and S that of its derivative."""

    def fun(t, y):
        rate = y[0] - y[1]
        return [-rate * y[0], rate * y[1]]

    product = lambda t, y: y[0] * y[1]  # noqa: E731
    problem = iv.Problem(fun, (0, 1), [4.0, 1.0], invariants=product, sensitivities=["y0[0]"])
    found = iv.steady_state(problem)
    np.testing.assert_allclose(found.y, [2, 2], rtol=1e-10)
    np.testing.assert_allclose(found.sensitivities[:, 0], [0.25, 0.25], rtol=1e-8)  # of √(y1 y2)
    assert len(found.eigenvalues) == 1


def test_a_lightly_damped_oscillation_dies_away_at_zero():
    """There no component has a size but that of the start, and the run keeps some tolerances of oscillation."""
    found = iv.steady_state(iv.Problem(lambda t, y: [y[1], -np.sin(y[0]) - 0.1 * y[1]], (0, 1), [1.0, 0.0]))
    assert (found.success, found.stable) == (True, True)
    np.testing.assert_allclose(found.y, 0, atol=1e-15)
