"""Values between steps are as accurate as those at the steps: error control includes the continuous extension."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import invariode as iv
from cases import ALGEBRAIC, IMPLICIT, METHODS, dealt
from problems import switching

#: The methods whose error estimate at the ends of steps does not see stiff components and algebraic variables, and
#: which therefore test their extensions where these are used.
TESTED = ["radau", "ode23t", "ode23tb"]

#: The others, whose steps are the same with and without output.
SAME = [name for name in METHODS if name not in TESTED and not switching(name)]

#: The law: between steps an error is at most this many times the larger one of the error at the steps and a tolerance.
MOST = 10

Exact = Callable[[np.ndarray], np.ndarray]


def relaxing(rate: float) -> tuple[iv.Problem, Exact]:
    """y' = -rate (y - cos t) - sin t from the slow solution, cos t."""
    return (
        iv.Problem(lambda t, y: [-rate * (y[0] - np.cos(t)) - np.sin(t)], (0, 10), [1.0]),
        lambda t: np.array([np.cos(t)]),
    )


def algebraic() -> tuple[iv.Problem, Exact]:
    """A slow decay beside 0 = y1 - sin 5t, which no differential equation ties to the length of steps."""
    return (
        iv.Problem(lambda t, y: [-0.1 * y[0], y[1] - np.sin(5 * t)], (0, 10), [1.0, 0.0], mass=np.diag([1.0, 0.0])),
        lambda t: np.array([np.exp(-0.1 * t), np.sin(5 * t)]),
    )


def places(t: np.ndarray, count: int = 20) -> np.ndarray:
    """Points inside the steps that end at the times t."""
    inside = np.arange(1, count) / count
    return (t[:-1, None] + np.diff(t)[:, None] * inside).ravel()


def errors(sol: iv.Solution, exact: Exact, tolerance: float) -> tuple[float, float]:
    """The largest errors at steps and between them, in units of tolerance (1 + |y|)."""

    def largest(t: np.ndarray, y: np.ndarray) -> float:
        return float((abs(y - exact(t)) / (tolerance * (1 + abs(exact(t))))).max())

    t = places(sol.t)
    return largest(sol.t, sol.y), largest(t, sol.sol(t))


def excess(sol: iv.Solution, exact: Exact, tolerance: float) -> float:
    """By which part of what the law allows the error between steps is exceeded; 1 at most if the law holds."""
    assert sol.success, sol.message
    at_steps, between = errors(sol, exact, tolerance)
    return between / (MOST * max(at_steps, 1))


def tolerances(method: str) -> list[float]:
    """Return the tolerances that suit its order."""
    return [1e-3, 1e-4, 1e-5] if METHODS[method].order == 2 else [1e-3, 1e-4, 1e-6, 1e-8]


@pytest.mark.parametrize("method", [*IMPLICIT, "auto"])
def test_stiff_components_are_within_the_tolerance_between_steps(method):
    for rate in 10.0 ** np.arange(0, 9):
        problem, exact = relaxing(rate)
        for tolerance in tolerances(method):
            sol = problem.solve(method, rtol=tolerance, atol=tolerance, dense_output=True)
            assert excess(sol, exact, tolerance) <= 1, (rate, tolerance, errors(sol, exact, tolerance))


@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")
@pytest.mark.parametrize("method", [name for name in METHODS if name not in [*IMPLICIT, "auto"]])
def test_mildly_stiff_components_too(method):
    """The steps of explicit methods are limited by stability there."""
    for rate in (1.0, 10.0, 100.0, 300.0):
        problem, exact = relaxing(rate)
        for tolerance in (1e-3, 1e-6):
            sol = problem.solve(method, rtol=tolerance, atol=tolerance, dense_output=True)
            assert excess(sol, exact, tolerance) <= 1, (rate, tolerance, errors(sol, exact, tolerance))


@pytest.mark.parametrize("method", ALGEBRAIC)
def test_algebraic_variables_are_within_the_tolerance_between_steps(method):
    problem, exact = algebraic()
    for tolerance in tolerances(method):
        sol = problem.solve(method, rtol=tolerance, atol=tolerance, dense_output=True)
        assert excess(sol, exact, tolerance) <= 1, (tolerance, errors(sol, exact, tolerance))


@pytest.mark.parametrize("method", ALGEBRAIC)
def test_all_events_are_found_in_stiff_and_algebraic_components(method):
    """sin 5t passes 0.5 sixteen times in (0, 10), and cos t passes 0 three times."""
    crossings = np.sort([(where + 2 * np.pi * k) / 5 for where in (np.pi / 6, 5 * np.pi / 6) for k in range(8)])
    for tolerance in tolerances(method):
        options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance}
        problem, _ = algebraic()
        sol = problem.replace(events=[lambda t, y: y[1] - 0.5]).solve(method, **options)
        # An error of ten tolerances (1 + 1/2) moves an event by it over the slope, 5 cos(pi/6).
        np.testing.assert_allclose(sol.t_events[0], crossings, rtol=0, atol=15 * tolerance / (5 * np.cos(np.pi / 6)))
        problem, _ = relaxing(1e6)
        sol = problem.replace(events=[lambda t, y: y[0]]).solve(method, **options)
        np.testing.assert_allclose(sol.t_events[0], np.pi / 2 + np.pi * np.arange(3), rtol=0, atol=10 * tolerance)


@pytest.mark.parametrize("method", TESTED)
def test_random_stiff_problems_are_within_the_tolerance_between_steps(method):
    """Sums of three oscillations, followed at random rates, through linear, cubic and algebraic equations and M(t)."""
    rng = np.random.default_rng(20)
    for kind in 5 * ["linear", "cubic", "algebraic", "M(t)"]:
        w, a, start = rng.uniform(0.3, 8, 3), rng.normal(size=3), rng.uniform(0, 6, 3)
        rate, slow, tf = 10 ** rng.uniform(1, 8), rng.uniform(0.05, 1), rng.uniform(3, 10)

        def phi(t, w=w, a=a, start=start):
            return (a * np.sin(np.multiply.outer(t, w) + start)).sum(axis=-1)

        def slope(t, w=w, a=a, start=start):
            return (a * w * np.cos(np.multiply.outer(t, w) + start)).sum(axis=-1)

        def fun(t, y, kind=kind, rate=rate, slow=slow, phi=phi, slope=slope):
            if kind == "algebraic":
                return [-slow * y[0], (y[1] - phi(t)) * (1 + 0.1 * y[0])]
            if kind == "cubic":
                return [-slow * y[0], -rate * (y[1] - phi(t) + 0.3 * (y[1] ** 3 - phi(t) ** 3)) + slope(t)]
            plain = [-slow * y[0], -rate * (y[1] - phi(t)) + slope(t)]
            return plain if kind == "linear" else weights(t) * plain

        def weights(t):
            return np.array([1 + 0.5 * np.sin(t), 2 + np.cos(t)])

        mass = {"algebraic": np.diag([1.0, 0.0]), "M(t)": lambda t: np.diag(weights(t))}.get(kind)
        problem = iv.Problem(fun, (0, tf), [1.0, float(phi(0.0))], mass=mass)

        def exact(t, slow=slow, phi=phi):
            return np.array([np.exp(-slow * t), phi(t)])

        tolerance = float(rng.choice(tolerances(method)))
        sol = problem.solve(method, rtol=tolerance, atol=tolerance, dense_output=True)
        assert excess(sol, exact, tolerance) <= 1, (kind, rate, tolerance, errors(sol, exact, tolerance))


# ----------------------------------------------------------------------------------------------------------------------
# Neighbours: sin 5t, followed at a rate of 1e6, or as an algebraic variable, in every kind of problem


RATE = 1e6


def stiff(t, y, *_):
    return [-0.1 * y[0], -RATE * (y[1] - np.sin(5 * t)) + 5 * np.cos(5 * t)]


def exact_stiff(t):
    return np.array([np.exp(-0.1 * t), np.sin(5 * t)])


def neighbours() -> dict[str, tuple[iv.Problem, dict[str, Any], Exact]]:
    """Problems, options and solutions by name."""
    span, start = (0, 5), [1.0, 0.0]
    stay = {2.0: lambda t, y: y}

    def double_at_event(t, y):
        return [y[0] * 0 + np.exp(-0.1 * t), y[1]]  # where it is already: the run restarts

    reset = iv.Event(lambda t, y: t - 2.5, action=double_at_event)
    return {
        "banded": (iv.Problem(stiff, span, start, lband=0, uband=0), {}, exact_stiff),
        "sparse": (iv.Problem(stiff, span, start, jac_sparsity=np.eye(2)), {}, exact_stiff),
        "matrix-free": (iv.Problem(stiff, span, start), {"linear_solver": "gmres"}, exact_stiff),
        "an exact Jacobian": (iv.Problem(stiff, span, start, jac=np.diag([-0.1, -RATE])), {}, exact_stiff),
        "raw": (iv.Problem(stiff, span, start), {"interpolation": "raw"}, exact_stiff),
        "breakpoints with actions": (iv.Problem(stiff, span, start), {"breakpoints": stay}, exact_stiff),
        "events with actions": (iv.Problem(stiff, span, start, events=[reset]), {}, exact_stiff),
        "backwards": (
            iv.Problem(
                lambda t, y: [-0.1 * y[0], RATE * (y[1] - np.sin(5 * t)) + 5 * np.cos(5 * t)],
                (5, 0),
                exact_stiff(5.0),
            ),
            {},
            exact_stiff,
        ),
        "within bounds": (
            iv.Problem(
                lambda t, y: [-0.1 * y[0], -RATE * (y[1] - 1.2 - np.sin(5 * t)) + 5 * np.cos(5 * t)],
                span,
                [1.0, 1.2],
                nonnegative=True,
            ),
            {},
            lambda t: np.array([np.exp(-0.1 * t), 1.2 + np.sin(5 * t)]),
        ),
        "complex": (
            iv.Problem(
                lambda t, y: [-0.1 * y[0], -RATE * (y[1] - np.exp(5j * t)) + 5j * np.exp(5j * t)], span, [1, 1 + 0j]
            ),
            {},
            lambda t: np.array([np.exp(-0.1 * t) + 0j, np.exp(5j * t)]),
        ),
        "an invariant": (
            iv.Problem(
                lambda t, y: [-0.1 * y[0], -RATE * (y[1] - np.sin(5 * t)) + 5 * np.cos(5 * t), 0.1 * y[0]],
                span,
                [1.0, 0.0, 0.0],
                invariants=lambda t, y: y[0] + y[2],
            ),
            {},
            lambda t: np.array([np.exp(-0.1 * t), np.sin(5 * t), 1 - np.exp(-0.1 * t)]),
        ),
        "an invariant and an algebraic equation": (
            iv.Problem(
                lambda t, y: [-0.1 * y[0], y[1] - np.sin(5 * t), 0.1 * y[0]],
                span,
                [1.0, 0.0, 0.0],
                mass=np.diag([1.0, 0.0, 1.0]),
                invariants=lambda t, y: y[0] + y[2],
            ),
            {},
            lambda t: np.array([np.exp(-0.1 * t), np.sin(5 * t), 1 - np.exp(-0.1 * t)]),
        ),
        "a singular M(t)": (
            iv.Problem(
                lambda t, y: [-0.1 * y[0] * (2 + np.sin(t)), y[1] - np.sin(5 * t)],
                span,
                start,
                mass=lambda t: np.diag([2 + np.sin(t), 0.0]),
            ),
            {},
            exact_stiff,
        ),
    }


@dealt(39, method=TESTED, name=list(neighbours()))
def test_the_law_holds_in_every_kind_of_problem(method, name):
    problem, options, exact = neighbours()[name]
    tolerance = 1e-4 if METHODS[method].order == 2 else 1e-6
    sol = problem.solve(method, rtol=tolerance, atol=tolerance, dense_output=True, **options)
    assert excess(sol, exact, tolerance) <= 1, errors(sol, exact, tolerance)


@pytest.mark.parametrize("method", TESTED)
@pytest.mark.parametrize("explicit", ["ode113", "ode45"])
def test_methods_that_take_turns_look_between_the_steps_of_theirs(method, explicit):
    problem, exact = relaxing(1e6)
    tolerance = 1e-4
    sol = problem.solve("auto", prefer=(explicit, method), rtol=tolerance, atol=tolerance, dense_output=True)
    assert excess(sol, exact, tolerance) <= 1


@pytest.mark.parametrize("method", TESTED)
def test_sensitivities_are_within_the_tolerance_between_steps(method):
    """y1 follows p sin 5t, and its derivative sin 5t."""
    tolerance = 1e-4 if METHODS[method].order == 2 else 1e-6

    def fun(t, y, p):
        return [-0.1 * y[0], -RATE * (y[1] - p * np.sin(5 * t)) + 5 * p * np.cos(5 * t)]

    problem = iv.Problem(fun, (0, 5), [1.0, 0.0], args=(1.0,), sensitivities=["p"])
    times = np.linspace(0, 5, 401)
    sol = problem.solve(method, rtol=tolerance, atol=tolerance, t_eval=times)
    for found in (sol.y[1], sol.sensitivities[1, 0]):
        assert (abs(found - np.sin(5 * times)) <= MOST * tolerance * (1 + abs(np.sin(5 * times)))).all()


@pytest.mark.parametrize("method", TESTED)
def test_algebraic_variables_may_jump_and_have_kinks(method):
    """The steps become as short as times allow, and the run goes on."""
    tolerance = 1e-5
    times = np.linspace(0, 6, 601)
    for g in (lambda t: np.where(t > np.pi, 1.0, -1.0), lambda t: abs(np.sin(2 * t))):
        sol = iv.solve_ivp(
            lambda t, y, g=g: [-0.1 * y[0], y[1] - float(g(t))],
            (0, 6),
            [1.0, float(g(0.0))],
            method,
            mass=np.diag([1.0, 0.0]),
            rtol=tolerance,
            atol=tolerance,
            t_eval=times,
        )
        assert sol.success
        assert (abs(sol.y[1] - g(times)) <= 2 * MOST * tolerance).all()  # of |y| up to 1


# ----------------------------------------------------------------------------------------------------------------------
# The choice: output may shorten steps, never lengthen them


def uses() -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    """All ways to use values between steps: what they add to a problem, and to its options."""
    return {
        "dense_output": ({}, {"dense_output": True}),
        "t_eval": ({}, {"t_eval": [0.1]}),
        "refine": ({}, {"refine": 2}),
        "events": ({"events": [lambda t, y: y[0] + 10]}, {}),
        "adjoint": ({}, {"adjoint": True}),
        "checkpoints of the adjoint": ({}, {"adjoint": "checkpoints"}),
    }


#: Ways to use steps alone.
STEPS_ALONE: dict[str, dict[str, Any]] = {
    "nothing": {},
    "the end": {"keep": "end"},
    "output at the ends": {"t_eval": [0.0, 4.0]},
    "refine without output": {"keep": "end", "refine": 1},
}


def plain_problem() -> iv.Problem:
    return relaxing(1e4)[0].replace(t_span=(0, 4))


def shape_of(sol: iv.Solution) -> tuple[Any, ...]:
    """Return a key that tells two sequences of steps apart."""
    return sol.stats.steps, sol.stats.failed, sol.t_end, *sol.y[:, -1]


@pytest.mark.parametrize("method", TESTED)
def test_each_use_of_values_between_steps_has_the_same_steps(method):
    problem = plain_problem()
    plain = [shape_of(problem.solve(method, **options)) for options in STEPS_ALONE.values()]
    assert len(set(plain)) == 1
    found = set()
    for described, options in uses().values():
        sol = problem.replace(**described).solve(method, **options)
        found.add((sol.stats.steps, sol.stats.failed))
    assert len(found) == 1
    assert found != {plain[0][:2]}


@pytest.mark.parametrize("method", SAME)
def test_the_steps_of_the_other_methods_do_not_depend_on_output(method):
    problem = relaxing(10)[0]
    plain = problem.solve(method)
    for described, options in uses().values():
        sol = problem.replace(**described).solve(method, **options)
        assert (sol.stats.steps, sol.stats.failed) == (plain.stats.steps, plain.stats.failed)


@pytest.mark.parametrize("method", TESTED)
def test_components_on_which_no_later_step_depends_do_not_shorten_the_steps_of_runs_without_output(method):
    """radau looks inside such steps too, for what f does there: only what is left of it at their ends counts."""
    problems = [algebraic()[0], *(relaxing(rate)[0] for rate in (1e4, 1e6, 1e8))]
    for problem in problems:
        for rtol in tolerances(method):
            plain, dense = (
                problem.solve(method, rtol=rtol, atol=rtol, dense_output=one).stats for one in (False, True)
            )
            assert plain.steps <= dense.steps


@pytest.mark.parametrize("method", TESTED)
def test_output_proposes_no_longer_steps(method):
    """Where the steps of a run and of the same run with output first differ, those with output are shorter; unless the
    run without output has tried a longer one, which has failed."""
    seen = 0
    for rate in 10.0 ** np.arange(0, 9):
        problem = relaxing(rate)[0]
        plain, dense = (problem.solve(method, dense_output=one).t for one in (False, True))
        count = min(len(plain), len(dense))
        apart = np.flatnonzero(plain[:count] != dense[:count])
        if not len(apart):
            continue
        failed = [problem.solve(method, max_steps=int(k)).stats.failed for k in (apart[0] - 1, apart[0])]
        if failed[0] == failed[1]:
            seen += 1
            assert dense[apart[0]] < plain[apart[0]]
    assert seen > 3


@pytest.mark.parametrize("method", TESTED)
def test_a_run_that_goes_on_keeps_the_choice_bit_for_bit(method, tmp_path):
    """In memory and from a file, even if no output is left to come."""
    problem = relaxing(1e5)[0]
    steps = problem.solve(method, dense_output=True).t
    few = int((steps < 1).sum())  # after the outputs, and long before the end
    runs: list[tuple[dict[str, Any], dict[str, Any]]] = [
        ({}, {"dense_output": True}),
        ({"events": [lambda t, y: y[0] + 10]}, {}),
        ({}, {"t_eval": [0.1, 0.2, 10.0]}),
    ]
    for number, (described, options) in enumerate(runs):
        posed, path = problem.replace(**described), tmp_path / str(number)
        whole = posed.solve(method, **options)
        assert whole.stats.steps == len(steps) - 1
        limits = {"max_steps": few, **options}
        limited = posed.solve(method, **limits)
        assert limited.status == -3
        assert limited.t_end > 0.2
        posed.solve(method, checkpoint=path, **limits)
        for begun in (limited, iv.load(path, posed)):
            again = begun.extend(10, max_steps=None)
            assert again.stats.steps == whole.stats.steps
            np.testing.assert_array_equal(again.t, whole.t)
            np.testing.assert_array_equal(again.y, whole.y)
