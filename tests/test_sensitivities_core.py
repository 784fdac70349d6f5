"""The laws of sensitivities in the core, with tangents written by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, dealt, families
from core_problems import core_solver
from invariode import _core
from invariode._base.arguments import Weights
from invariode._problem.core_problem import CoreProblem, EventSpec, LinearTerms, VariationTerms
from variations import (
    MASSES,
    PROBLEMS,
    Points,
    bouncing_ball,
    kepler,
    lotka_volterra,
    pendulum,
    robertson,
    semi_explicit,
)

EPS = np.finfo(float).eps
EXPLICIT = [name for name, method in METHODS.items() if "jac" not in method.options]
STAGED = [name for name, method in METHODS.items() if method.stages is not None]

#: d/dp of |y(10) - 1|² / 2, Lotka-Volterra from (1, 1) with p = (1.5, 1, 3, 1).
GRADIENT = [0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395]


def gradient(points: Points) -> np.ndarray:
    return points.S[-1] @ (points.y[-1] - 1)


def off_tangent(problem, Y: np.ndarray, t: np.ndarray) -> float:
    """The largest |G S + g_p - dc/dp| of each invariant in units of the largest terms that it sums."""
    worst = 0.0
    start = problem.start.reshape(Y.shape[1:])
    for i, (_, gradient, dgdp, m) in enumerate(problem.invariants):
        rate = problem.tangent(i, 0, start) if problem.held else 0
        off, terms = [], []
        for at, one in zip(t, Y, strict=True):
            row = np.abs(np.reshape(gradient(at, one[0], problem.p), (m, -1)))
            terms.append(np.abs(one[1:]) @ row.T + np.abs(np.reshape(dgdp(at, one[0], problem.p), (-1, m))))
            off.append(np.abs(problem.tangent(i, at, one) - rate))
        worst = max(worst, (np.max(off, axis=0) / np.maximum(np.max(terms, axis=0), 1e-300)).max())
    return worst


@pytest.mark.parametrize("method", [*EXPLICIT])
def test_explicit_steps_are_differentiated_exactly(method):
    """Equal steps of an explicit formula are functions of p: complex steps through them give the same derivative, to
    roundoff of 40 steps."""
    problem, h = lotka_volterra(), 0.05
    loose = {"first_step": h, "max_step": h, "tf": 2.0, "project": False}  # rtol 1: no error limits the step
    ours = problem.run(method, 1.0, error_test=False, **loose)
    assert len(ours.t) == 41
    for j in range(4):
        p = problem.p.astype(complex)
        p[j] += 1e-30j

        def fun(t, y, p=p):
            return np.array([p[0] * y[0] - p[1] * y[0] * y[1], -p[2] * y[1] + p[3] * y[0] * y[1]])

        described = CoreProblem(n=4, complex=True, fun=fun, args=())
        solver = core_solver(method, described, Weights(1.0, 1.0), tf=2.0, max_step=h, first_step=h)
        t, y, *_ = solver.integrate(np.array([1.0, 0, 1.0, 0])).take_points()
        assert np.array_equal(t, ours.t)
        np.testing.assert_allclose(ours.S[:, j], y.imag.T / 1e-30, rtol=0, atol=1e-12 * np.abs(ours.S[:, j]).max())


@dealt(method=METHODS, project=[False, True])
def test_sensitivities_converge_with_the_tolerance(method, project):
    """100 times the accuracy of order 2, which takes 10 times the steps, with tolerances 1000 times as tight."""
    second_order = iv.METHODS[method].order == 2
    crude, fine = (1e-3, 1e-6) if second_order or method == "ode23" else (1e-5, 1e-8)
    errors = [np.abs(gradient(lotka_volterra().run(method, rtol, project=project)) - GRADIENT).max()
              for rtol in (crude, fine)]  # fmt: skip
    assert errors[1] < 0.03 * errors[0]
    assert errors[1] < 1e3 * fine


@dealt(method=[*STAGED, "ode23s", "ode23t", "ode23tb"], project=[False, True])
def test_sensitivities_have_the_order_of_the_method(method, project):
    """With half the step, S errs 2^q times less, where y does; the slope of two halvings is q within 0.6."""
    order = iv.METHODS[method].order
    longest = {2: 0.01, 3: 0.02, 5: 0.04, 8: 0.4, 9: 0.4}[order]
    problem = kepler(0.3)
    reference = problem.run("ode89", 1e-13, tf=2.0).S[-1]
    errors = []
    for h in (longest, longest / 2, longest / 4):
        loose = {"first_step": h, "max_step": h, "tf": 2.0, "project": project, "iterations": 3}
        rtol = 1e-2 if "jac" in iv.METHODS[method].options else 1.0  # Newton's iteration is to converge
        errors.append(np.abs(problem.run(method, rtol, **loose).S[-1] - reference).max())
    assert np.log2(errors[0] / errors[2]) / 2 > order - 0.6


@dealt(method=METHODS, name=PROBLEMS)
def test_sensitivities_lie_on_the_tangent_of_the_manifold(method, name):
    """G S + g_p = dc/dp to roundoff at every step and between them, also in levels, and where the form of g or the
    start depends on p."""
    problem = PROBLEMS[name]()
    points = problem.run(method, 1e-3, refine=3)
    assert off_tangent(problem, points.Y, points.t) < 20 * EPS
    assert off_tangent(problem, problem.run(method, 1e-3, project=False).Y[-1:], [0.0]) > 1e-10


def test_dense_output_is_on_the_tangent_too():
    problem = lotka_volterra()
    solver = problem.solver("ode45", 1e-3, dense=True)
    run = solver.integrate(problem.start)
    dense, times = run.take_dense(), np.linspace(0, problem.tf, 101)
    described = problem.description(atol=1e-3)
    Y = dense.evaluate(times, described)
    assert off_tangent(problem, Y.reshape(101, 5, 2), times) < 20 * EPS
    restored = _core.Dense.from_parts(**dense.parts())
    assert np.array_equal(restored.evaluate(times, described), Y)


@pytest.mark.parametrize("method", ["ode15s", "radau"])
def test_sums_of_sensitivities_stay_zero_where_the_sum_is_held(method):
    points = robertson().run(method, 1e-6, max_step=np.inf)
    assert np.abs(points.S.sum(axis=2)).max() <= 4 * EPS * np.abs(points.S).max()


@families
def test_without_an_error_test_the_state_takes_the_same_steps(method):
    """Every bit of y is that of a run without sensitivities."""
    problem = lotka_volterra()
    alone = problem.run(method, 1e-4, sensitivities=False)
    beside = problem.run(method, 1e-4, error_test=False)
    assert np.array_equal(alone.t, beside.t)
    assert np.array_equal(alone.y, beside.y)


@families
def test_units_of_parameters_do_not_matter(method):
    """With p in units 8 times as large S is 8 times as large, in every bit."""
    problem = lotka_volterra()
    larger = replace(
        problem,
        dfdp=lambda t, y, p: 8 * np.array(problem.dfdp(t, y, p)),
        invariants=tuple((g, G, lambda t, y, p, d=d: 8 * np.array(d(t, y, p)), m) for g, G, d, m in problem.invariants),
    )
    ours, theirs = problem.run(method, 1e-4, tf=3.0), larger.run(method, 1e-4, tf=3.0, scale=1 / 8)
    assert np.array_equal(ours.t, theirs.t)
    assert np.array_equal(8 * ours.S, theirs.S)


@families
def test_the_order_of_parameters_does_not_matter(method):
    problem, order = lotka_volterra(), [2, 0, 3, 1]
    other = replace(
        problem,
        dfdp=lambda t, y, p: np.array(problem.dfdp(t, y, p))[order],
        invariants=tuple((g, G, lambda t, y, p, d=d: np.array(d(t, y, p))[order], m)
                         for g, G, d, m in problem.invariants),
    )  # fmt: skip
    ours, theirs = problem.run(method, 1e-4, tf=3.0), other.run(method, 1e-4, tf=3.0)
    assert np.array_equal(ours.t, theirs.t)
    np.testing.assert_allclose(ours.S[:, order], theirs.S, rtol=1e-9, atol=1e-12)


@families
def test_an_interrupted_run_goes_on_to_the_last_bit(method):
    problem = pendulum()
    whole = problem.run(method, 1e-4)
    part = problem.solver(method, 1e-4, max_steps=7).integrate(problem.start)
    assert part.state == "limit_reached"
    rest = Points(problem.solver(method, 1e-4).resume(part.memory, False), 4)
    assert np.array_equal(rest.t, whole.t[-len(rest.t) :])
    assert np.array_equal(rest.Y, whole.Y[-len(rest.t) :])


def test_a_run_step_by_step_is_the_same_run():
    problem = lotka_volterra()
    points = problem.run("ode45", 1e-4)
    stepper = _core.Stepper(problem.solver("ode45", 1e-4), problem.start)
    for Y in points.Y[1:]:
        stepper.step()
        assert np.array_equal(stepper.y, Y.ravel())


@families
def test_impacts_move_sensitivities_with_the_time_of_the_event(method):
    """The ball is known exactly: its flights are parabolas."""
    ball = bouncing_ball()

    def exact(e, gravity):
        t, v = np.sqrt(2 / gravity), e * np.sqrt(2 * gravity)
        while t + 2 * v / gravity < ball.tf:
            t, v = t + 2 * v / gravity, e * v
        s = ball.tf - t
        return np.array([v * s - gravity * s * s / 2, v - gravity * s])

    e, gravity = ball.p
    d = 1e-6
    by_e = (exact(e + d, gravity) - exact(e - d, gravity)) / (2 * d)
    by_gravity = (exact(e, gravity + d) - exact(e, gravity - d)) / (2 * d)
    points = ball.run(method, 1e-6)
    np.testing.assert_allclose(points.S[-1], [by_e, by_gravity], atol=1e-8 if method != "ode15s" else 1e-4)


@families
def test_a_component_at_rest_on_a_bound_does_not_depend_on_parameters(method):
    """x' = -k from 1 rests at 0 from 1/k on, and z' = x ends at 1/(2k)."""
    infinity = np.full(2, np.inf)
    draining = replace(
        lotka_volterra(), fun=lambda t, y, p: [-p[0], y[0]], jac=lambda t, y, p: [[0, 0], [1, 0]],
        dfdp=lambda t, y, p: [[-1, 0]], p=np.ones(1), y0=np.array([1.0, 0]), S0=np.zeros((1, 2)), tf=2.0,
        invariants=(), bounds=(np.array([0, -np.inf]), infinity),
    )  # fmt: skip
    points = draining.run(method, 1e-5)
    assert np.all(points.S[points.t > 1.1, 0, 0] == 0)
    arrival = points.t[np.argmax(points.y[:, 0] == 0)]  # as far from 1 as the step that meets the bound errs
    np.testing.assert_allclose(points.S[-1, 0], [0, -0.5], atol=1e-4 + abs(arrival - 1))


@pytest.mark.parametrize("method", MASSES)
def test_algebraic_equations_hold_for_sensitivities_from_the_start_on(method):
    """z = q y²: dz/dp = 2 q y dy/dp + (0, y²), at the start to roundoff though dz/dq was given as 0."""
    problem = semi_explicit()
    points = problem.run(method, 1e-6)
    np.testing.assert_allclose(points.S[0], [[0, 0], [0, 1]], rtol=0, atol=4 * EPS)
    p, q = problem.p
    y = (1 + 2 * p * q * points.t[-1]) ** -0.5
    by_p, by_q = -(y**3) * q * points.t[-1], -(y**3) * p * points.t[-1]
    exact = [[by_p, 2 * q * y * by_p], [by_q, 2 * q * y * by_q + y * y]]
    np.testing.assert_allclose(points.S[-1], exact, atol=1e-4)


@pytest.mark.parametrize("method", MASSES)
def test_a_time_dependent_mass_matrix_belongs_to_sensitivities_too(method):
    """M(t) y' = M(t) A y has the solutions of y' = A y."""

    def mass(t):
        return np.array([[2 + np.sin(t), 0], [0.5, 1.0]])

    plain = replace(
        lotka_volterra(), fun=lambda t, y, p: [-p[0] * y[0], p[0] * y[0]], jac=lambda t, y, p: [[-p[0], 0], [p[0], 0]],
        dfdp=lambda t, y, p: [[-y[0], y[0]]], p=np.array([0.7]), y0=np.array([1.0, 0]), S0=np.zeros((1, 2)), tf=2.0,
        invariants=(),
    )  # fmt: skip
    massive = replace(
        plain, fun=lambda t, y, p: mass(t) @ plain.fun(t, y, p), jac=lambda t, y, p: mass(t) @ plain.jac(t, y, p),
        dfdp=lambda t, y, p: plain.dfdp(t, y, p) @ mass(t).T, mass=mass,
    )  # fmt: skip
    by_p = -2 * np.exp(-1.4)
    np.testing.assert_allclose(massive.run(method, 1e-5).S[-1, 0], [by_p, -by_p], atol=1e-3)


@families
def test_sensitivities_run_backwards(method):
    """Back from the end, the sensitivities to p are those at the start again."""
    problem = lotka_volterra()
    forth = problem.run(method, 1e-6, tf=2.0)
    back = replace(problem, y0=forth.y[-1], S0=forth.S[-1])
    settings = {"tf": -2.0}
    turned = replace(
        back, fun=lambda t, y, p: problem.fun(-t, y, p), jac=lambda t, y, p: problem.jac(-t, y, p),
        dfdp=lambda t, y, p: problem.dfdp(-t, y, p),
    ).run(method, 1e-6, **settings)  # fmt: skip
    np.testing.assert_allclose(turned.S[-1], problem.S0, atol=1e-3)


@families
def test_complex_states_have_complex_sensitivities(method):
    """y' = i p y: dy/dp = i t y. From `integrate_anew`, as prepared solvers call it."""
    variations = VariationTerms(1, lambda t, Y: 2j * Y[1:] + 1j * Y[:1], np.full((1, 2), 1e-5))
    linear = LinearTerms(structure="dense", n=2, lower=0, upper=0, kind="differences", jacobian=None, mass=None,
                          null_basis=lotka_volterra().null_basis, lapack=None)  # fmt: skip
    described = CoreProblem(n=2, complex=True, fun=lambda t, y: 2j * y, args=(), linear=linear, variations=variations)
    solver = core_solver(method, described, Weights(1e-5, 1.0))
    course = 0.0, 1.0, 0.1, None, 10**6, 10**9
    run = solver.integrate_anew(np.array([1.0, 0, 0, 0]), None, (), None, course, None, None, True, None, None, None)
    np.testing.assert_allclose(run.end, [np.exp(2j), 1j * np.exp(2j)], atol=1e-3)


def test_robertson_costs_no_more_steps_than_promised():
    """Up to 4e10 at rtol 1e-4 with atol (1e-8, 1e-14, 1e-6), S in the error test: at most 560 steps of ode15s, and S
    at the end within the 2 to 7 % of CVODES."""
    problem = robertson()
    atol = np.array([1e-8, 1e-14, 1e-6])
    k, n = problem.S0.shape
    variations = VariationTerms(k, problem.slope, atol[None, :] / problem.p[:, None])
    linear = LinearTerms(structure="dense", n=n, lower=0, upper=0, kind="function", mass=None, lapack=None,
                          jacobian=lambda t, y: np.array(problem.jac(t, y, problem.p), float),
                          null_basis=problem.null_basis)  # fmt: skip
    described = CoreProblem(n=n, complex=False, fun=lambda t, y: problem.fun(t, y, problem.p), args=(),
                            linear=linear, variations=variations)  # fmt: skip
    times = np.array([0.4, 4e7, 4e10])
    solver = core_solver("ode15s", described, Weights(1e-4, atol / 1e-4), tf=4e10, max_step=np.inf, times=times)
    points = Points(solver.integrate(problem.start), n)
    assert points.counts["steps"] <= 560
    np.testing.assert_allclose(points.S[0, 0], [-0.35595257, 3.9025e-4, 0.35556231], rtol=3e-5)
    np.testing.assert_allclose(points.S[1, 0, :2], [-2.59914e-3, -5.1943e-9], rtol=1e-3)
    np.testing.assert_allclose(points.S[2, 0, :2], [-2.60418e-6, -5.2084e-12], rtol=0.05)


def test_what_sensitivities_do_not_go_with_is_named():
    problem = lotka_volterra()
    description = problem.description

    def solver(described, method="ode45"):
        return core_solver(method, described, Weights(1e-3, 1.0))

    def described(**other):
        parts = {"n": 2, "complex": False, "fun": lambda t, y: y, "args": ()}
        return CoreProblem(**parts | other)

    def variations(k=1, tolerances=(1, 2), **other):
        return VariationTerms(k, lambda t, Y: Y[1:], np.ones(tolerances), **other)

    with pytest.raises(ValueError, match="tolerances of sensitivities do not fit 1 parameters of a problem of 2"):
        solver(described(variations=variations(tolerances=(2, 2))))
    event = EventSpec(lambda t, y: y[0], 0, 0, "e", lambda t, y: y, True, 0)
    with pytest.raises(ValueError, match="2 functions for 1 events"):
        solver(described(events=[event], variations=variations(events=[None, None])))
    with pytest.raises(ValueError, match="an event has an action and no jump"):
        solver(described(events=[event], variations=variations(events=[None])))
    with pytest.raises(ValueError, match="y0 has 2 reals, the problem has 10"):
        solver(description()).integrate(np.ones(2))
    wrong = solver(described(variations=VariationTerms(2, lambda t, Y: np.zeros(2), np.ones((2, 2)))))
    with pytest.raises(ValueError, match=r"the slope of the sensitivities returned shape \(2,\), expected shape"):
        wrong.integrate(np.ones(6))
