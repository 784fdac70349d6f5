"""Units of time, state and invariants do not matter, nor does the order in which components are listed.

Multiplication by a power of two is exact, so that there nothing may change but exponents: every count, every digit.
Other factors and other orders of summation change roundings; a run then changes as it does with the last digit of y0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import invariode as iv
from cases import ALGEBRAIC, FAMILIES, METHODS, dealt, families
from problems import PROBLEMS, TestProblem, implicit, one_step, slack
from stiff import PROBLEMS as STIFF

FAR = (2.0**-30, 2.0**30)
#: The same in units of 1e-99 and 1e99: squares of such numbers are close to the ends of the range.
EXTREME = (2.0**-330, 2.0**330)
JACOBIANS = ["given", None, "2-point"]


@dataclasses.dataclass(frozen=True)
class Units:
    """Names of one unit of time, of the state and of the invariants of a problem in other units."""

    time: float = 1.0
    state: float = 1.0
    invariant: float = 1.0

    def fun(self, fun: Callable[..., Any]) -> Callable[..., Any]:
        return lambda t, y, *args: self.state / self.time * np.asarray(fun(t / self.time, y / self.state, *args))

    def g(self, g: Callable[..., Any]) -> Callable[..., Any]:
        return lambda t, y: self.invariant * np.asarray(g(t / self.time, y / self.state))

    def g_jacobian(self, jac: Callable[..., Any]) -> Callable[..., Any]:
        return lambda t, y: self.invariant / self.state * np.asarray(jac(t / self.time, y / self.state))

    def f_jacobian(self, jac: Callable[..., Any]) -> Callable[..., Any]:
        return lambda t, y, *args: jac(t / self.time, y / self.state, *args) / self.time

    def span(self, t_span: tuple[float, float]) -> tuple[float, float]:
        return self.time * t_span[0], self.time * t_span[1]


def invariants(problem: TestProblem, units: Units, jac: str | None) -> iv.Invariants:
    derivative = units.g_jacobian(problem.jac) if jac == "given" else jac
    return iv.Invariants(units.g(problem.g), derivative, problem.value)


#: Of each interval: every method meets an event there, is projected, and on most problems repeats a failed attempt.
PART = 1 / 3


def first(part: float, problem: TestProblem) -> tuple[float, float]:
    t0, tf = problem.t_span
    return t0, t0 + part * (tf - t0)


def solve(problem: TestProblem, method: str, units: Units, project: bool = True, jac: str | None = "given"):
    """Solve with an event and output between the steps, at the default tolerances."""
    return iv.solve_ivp(
        units.fun(problem.fun),
        units.span(first(PART, problem)),
        units.state * np.array(problem.y0, dtype=float),
        method,
        invariants=invariants(problem, units, jac) if project else None,
        atol=1e-6 * units.state,
        refine=3,
        events=lambda t, y: y[0] / units.state - problem.y0[0] + 0.1,
    )


def assert_same(scaled: iv.Solution, plain: iv.Solution, units: Units) -> None:
    assert scaled.status == plain.status, scaled.message
    assert dataclasses.asdict(scaled.stats) == dataclasses.asdict(plain.stats)
    np.testing.assert_array_equal(scaled.t, units.time * plain.t)
    np.testing.assert_array_equal(scaled.y, units.state * plain.y)
    for scaled_times, times in zip(scaled.t_events or (), plain.t_events or (), strict=True):
        np.testing.assert_array_equal(scaled_times, units.time * times)
    for scaled_states, states in zip(scaled.y_events or (), plain.y_events or (), strict=True):
        np.testing.assert_array_equal(scaled_states, units.state * states)


# ----------------------------------------------------------------------------------------------------------------------
# Powers of two


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_units_do_not_matter_without_invariants(method, problem):
    plain = solve(problem, method, Units(), project=False)
    for c in FAR:
        for units in (Units(time=c), Units(state=c)):
            assert_same(solve(problem, method, units, project=False), plain, units)


@dealt(method=METHODS, problem=PROBLEMS, jac=JACOBIANS)
def test_units_do_not_matter_with_invariants(method, problem, jac):
    plain = solve(problem, method, Units(), jac=jac)
    for c in FAR:
        for units in (Units(time=c), Units(state=c), Units(invariant=c)):
            assert_same(solve(problem, method, units, jac=jac), plain, units)


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_extreme_units_of_the_state_do_not_matter(method, problem):
    plain = solve(problem, method, Units())
    for units in (Units(state=c) for c in EXTREME):
        assert_same(solve(problem, method, units), plain, units)


@dealt(name=[name for name, one in STIFF.items() if len(one.y0) < 100], form=["given", "differences"])
def test_units_do_not_matter_to_newton(name, form):
    """f and its Jacobian may have any units, in ode15s."""
    one = STIFF[name]

    def run(units: Units) -> iv.Solution:
        return iv.ode15s(
            units.fun(one.fun),
            units.span(one.t_span),
            units.state * np.asarray(one.y0),
            rtol=1e-4,
            atol=1e-4 * units.state * one.scale,
            args=one.args,
            jac=units.f_jacobian(one.jac) if form == "given" else None,
            lband=one.lband,
            uband=one.uband,
        )

    plain = run(Units())
    for c in FAR:
        for units in (Units(time=c), Units(state=c)):
            assert_same(run(units), plain, units)


def rates(t, y):
    """The Robertson reaction, its third equation replaced by the sum."""
    a, b, c = y
    slow, fast = 0.04 * a - 1e4 * b * c, 3e7 * b * b
    return np.array([-slow, slow - fast, a + b + c - 1])


def turning(t, y):
    return np.array([y[1], -y[0]])


def mixing(t):
    return np.array([[2 + np.sin(t), 0], [0.5, 1]])


def follows(t, y):
    """y1 = y0 sin t, an algebraic equation that changes with time."""
    return np.array([np.cos(t) - y[0], y[1] - np.sin(t) * y[0]])


#: f, the end of the interval, y0, M (a function where it depends on time), and an invariant.
WITH_MASS = {
    "singular": (rates, 40, [1, 0, 0], np.diag([1.0, 1, 0]), None),
    "singular, moving": (follows, 10, [0.5, 0], np.diag([1.0, 0]), None),
    "singular, moving, invariant": (follows, 10, [0.5, 0], np.diag([1.0, 0]), lambda t, y: y[1] - np.sin(t) * y[0]),
    "regular": (lambda t, y: mixing(0) @ turning(t, y), 10, [1, 0], mixing(0), lambda t, y: y @ y),
    "changing": (lambda t, y: mixing(t) @ turning(t, y), 10, [1, 0], mixing, lambda t, y: y @ y),
    "changing, singular": (follows, 3, [0.5, 0], lambda t: np.diag([1 + t, 0]), None),
}


@dealt(8, method=ALGEBRAIC, name=WITH_MASS, units=[Units(time=c) for c in FAR] + [Units(state=c) for c in FAR])
@pytest.mark.filterwarnings("ignore:.*redundant:UserWarning")  # the invariant is the algebraic equation
def test_units_do_not_matter_with_mass_matrices(method, name, units):
    fun, end, y0, mass, g = WITH_MASS[name]

    def run(units: Units) -> iv.Solution:
        return iv.solve_ivp(
            units.fun(fun),
            units.span((0, end)),
            units.state * np.array(y0, dtype=float),
            method,
            mass=(lambda t: mass(t / units.time)) if callable(mass) else mass,
            atol=1e-6 * units.state,
            invariants=None if g is None else units.g(g),
        )

    plain = run(Units())
    assert plain.success, plain.message
    assert_same(run(units), plain, units)


@dealt(name=PROBLEMS, units=[Units(time=c) for c in FAR] + [Units(state=c) for c in FAR], jac=["given", None])
def test_the_check_of_invariants_knows_no_units(name, units, jac):
    problem = PROBLEMS[name]

    def check(units: Units) -> iv.CheckReport:
        y = units.state * np.array(problem.y0, dtype=float)
        return iv.check_invariants(units.fun(problem.fun), invariants(problem, units, jac), 0.3 * units.time, y)

    plain, scaled = check(Units()), check(units)
    assert plain.conserved.all()
    assert scaled.conserved.all(), scaled.findings


#: Around 1e-100, 1e-12, 1e12 and 1e100.
SIZES = (2.0**-332, 2.0**-40, 2.0**40, 2.0**332)


#: And of which degree its invariants are.
SEARCHED = {"rigid body": 2, "Henon-Heiles": 3, "Kepler": 2}


@dealt(8, name=SEARCHED, units=[Units(time=c) for c in SIZES] + [Units(state=c) for c in SIZES])
def test_the_search_for_invariants_knows_no_units(name, units):
    problem, degree = PROBLEMS[name], SEARCHED[name]

    def search(units: Units) -> list[iv.PolynomialInvariant]:
        y0 = units.state * np.array(problem.y0, dtype=float)
        return iv.find_invariants(units.fun(problem.fun), units.span((0, 10)), y0, degree)

    plain, scaled = search(Units()), search(units)
    assert plain
    assert [set(one.coefficients) for one in scaled] == [set(one.coefficients) for one in plain]
    for one, other in zip(plain, scaled, strict=True):
        first = sum(next(iter(one.coefficients)))
        for exponents, c in one.coefficients.items():
            expected = float(c) * units.state ** (first - sum(exponents))
            assert float(other.coefficients[exponents]) == pytest.approx(expected, rel=1e-8)


@families
def test_no_absolute_tolerance_means_no_unit(method):
    """A component of y0 is 0, so that nothing says how large it is."""
    sol = iv.solve_ivp(turning, (0, 5), [1.0, 0.0], method, atol=0, invariants=lambda t, y: y @ y)
    assert sol.success, sol.message


# ----------------------------------------------------------------------------------------------------------------------
# Roundings

TOLERANCES = {"rtol": 1e-6, "atol": 1e-9}
#: Changes by roundings are random: those of different kinds are of one size within this factor, and often closer.
ALIKE = 100


def end_state(problem: TestProblem, method: str, y0: np.ndarray, g: iv.Invariants) -> np.ndarray:
    """The state after a fifth of the interval, before the problem has amplified roundings much."""
    sol = iv.solve_ivp(problem.fun, first(1 / 5, problem), y0, method, invariants=g, keep="end", **TOLERANCES)
    assert sol.success, sol.message
    return sol.y[:, -1]


@dealt(method=FAMILIES, problem=PROBLEMS, jac=JACOBIANS)
def test_units_of_invariants_change_roundings_only(method, problem, jac):
    """By powers of ten: the solution moves as it does when the last digit of y0 changes."""
    y0, held = np.array(problem.y0, dtype=float), invariants(problem, Units(), jac)
    plain = end_state(problem, method, y0, held)
    ulp = np.spacing(np.maximum(np.abs(y0), 1e-3)) * np.arange(1, len(y0) + 1)
    level = problem.g(problem.t_span[0], y0) if problem.value is None else problem.value
    same_level = iv.Invariants(held.fun, held.jac, level)
    spread = max(
        np.abs(end_state(problem, method, y0 + sign * ulp, same_level) - plain).max() for sign in (-3, -1, 1, 3)
    )
    for factor in (1e-12, 1e12):
        scaled = end_state(problem, method, y0, invariants(problem, Units(invariant=factor), jac))
        assert np.abs(scaled - plain).max() <= ALIKE * spread + 1e-12


def permuted(problem: TestProblem, of_state: np.ndarray, of_invariants: np.ndarray) -> TestProblem:
    back = np.argsort(of_state)
    return dataclasses.replace(
        problem,
        fun=lambda t, y: np.asarray(problem.fun(t, y[back]))[of_state],
        y0=list(np.array(problem.y0)[of_state]),
        g=lambda t, y: np.atleast_1d(problem.g(t, y[back]))[of_invariants],
        jac=lambda t, y: np.asarray(problem.jac(t, y[back]))[of_invariants][:, of_state],
    )


@dealt(method=FAMILIES, problem=PROBLEMS, project=[False, True])
def test_the_order_of_components_does_not_matter(method, problem, project):
    order = np.arange(len(problem.y0))[::-1]
    g = np.arange(np.size(problem.g(0, np.array(problem.y0))))
    problem = dataclasses.replace(problem, t_span=first(PART, problem))
    plain = problem.solve(method, project, **TOLERANCES)
    turned = permuted(problem, order, g).solve(method, project, **TOLERANCES)
    if not (implicit(method) and one_step(method)):
        counts = (turned.stats.steps, turned.stats.failed, turned.nfev)
        assert counts == (plain.stats.steps, plain.stats.failed, plain.nfev)
    else:  # roundoff decides in some steps whether Newton's iteration goes on, which takes all stages of radau
        assert turned.stats.steps == pytest.approx(plain.stats.steps, rel=0.01)
        assert turned.nfev == pytest.approx(plain.nfev, rel=0.01 if iv.METHODS[method].fixed_order else 0.5)
    np.testing.assert_allclose(
        turned.y[:, -1], plain.y[order, -1], rtol=1e-6 * slack(method), atol=1e-6 * slack(method)
    )


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_the_order_of_invariants_does_not_matter(method, problem):
    state = np.arange(len(problem.y0))
    g = np.arange(np.size(problem.g(0, np.array(problem.y0))))[::-1]
    problem = dataclasses.replace(problem, t_span=first(PART, problem))
    plain = permuted(problem, state, g[::-1]).solve(method, **TOLERANCES)
    turned = permuted(problem, state, g).solve(method, **TOLERANCES)
    assert dataclasses.asdict(turned.stats) == dataclasses.asdict(plain.stats)
    np.testing.assert_allclose(turned.y, plain.y, rtol=1e-9, atol=1e-9)


def central_differences(fun: Callable[..., Any]) -> Callable[..., Any]:
    """∂f/∂y of a function of t and y; that of -f is the negative of it, to the last bit."""
    h = float(2.0**-17)

    def jac(t, y):
        columns = [(np.asarray(fun(t, y + h * e)) - np.asarray(fun(t, y - h * e))) / (2 * h) for e in np.eye(len(y))]
        return np.transpose(columns)

    return jac


@dealt(method=FAMILIES, problem=PROBLEMS, project=[False, True])
def test_the_direction_of_time_does_not_matter(method, problem, project):
    """s = -t: y' = f(t, y) is dy/ds = -f(-s, y), with the same steps and the same digits."""

    def forwards(t, y):  # may depend on t, and is searched for pulses as its counterpart is
        return np.asarray(problem.fun(t, y))

    def backwards(s, y):
        return -np.asarray(problem.fun(-s, y))

    def run(fun, t_span, g, jac):
        given = {"jac": central_differences(fun)} if "jac" in iv.METHODS[method].options else {}
        held = iv.Invariants(g, jac, problem.value) if project else None
        return iv.solve_ivp(fun, t_span, problem.y0, method, invariants=held, **given)

    t0, tf = first(PART, problem)
    plain = run(forwards, (t0, tf), problem.g, problem.jac)
    turned = run(backwards, (-t0, -tf), lambda s, y: problem.g(-s, y), lambda s, y: problem.jac(-s, y))
    assert_same(turned, plain, Units(time=-1))
