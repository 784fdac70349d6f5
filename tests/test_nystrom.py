"""Second-order equations: the Runge-Kutta-Nyström pairs, and what states such a problem."""

from __future__ import annotations

import ctypes
import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from mpmath import mpf

import invariode as iv
from cases import explicit_and_implicit
from nystrom_pairs import ROUNDOFF, at, complete, defect, derivative, tableau

PAIRS = [name for name, about in iv.METHODS.items() if about.equations == "second-order"]
pairs = pytest.mark.parametrize("method", PAIRS)
CORE = Path(__file__).parents[1] / "core" / "methods"
TOLERANCES = {"rtol": 1e-9, "atol": 1e-11}
ECCENTRICITY, TURNS = 0.3, 3
START = [1 - ECCENTRICITY, 0, 0, np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY))]
SPAN = (0, TURNS * 2 * np.pi)


def attraction(t, q):
    return -q / np.hypot(*q) ** 3


def first_order(t, y):
    return np.concatenate([y[2:], attraction(t, y[:2])])


def integrals(t, y):
    return [(y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.hypot(y[0], y[1]), y[0] * y[3] - y[1] * y[2]]


def energy(t, y):
    return integrals(t, y)[0]


def apsis(t, y):
    return y[0] * y[2] + y[1] * y[3]


def spring(t, q, w, c):
    return [-w * w * q[0] + c]


def orbit(method, **options):
    return iv.solve_ivp(iv.SecondOrder(attraction), SPAN, START, method, **{**TOLERANCES, **options})


def same(a, b):
    return np.array_equal(a.t, b.t) and np.array_equal(a.y, b.y)


# ----------------------------------------------------------------------------------------------------------------------
# Coefficients


def written(method):
    """The numbers in the header of a tableau."""
    text = re.sub(r" *//.*\n", "\n", (CORE / f"{method}.hpp").read_text())
    found = {}
    for key, block in re.findall(r"\.(\w+) = (\{.*?\}),\n(?=    \.|\};)", text, re.DOTALL):
        rows = json.loads(re.sub(r"\s+", "", block).replace("{", "[").replace("}", "]"))
        found[key] = rows[0] if isinstance(rows[0], list) else rows
    return found


@pytest.mark.slow
@pairs
def test_the_numbers_in_the_core_are_those_derived(method):
    assert written(method) == tableau(method)


@pytest.mark.slow
@pairs
def test_the_order_conditions_hold_with_sixty_digits(method):
    """Both formulas and the extension meet them, up to the order that the method states."""
    about = iv.METHODS[method]
    pair, weights = complete(method)
    theta = mpf(3) / 7
    q, v = at(weights, theta), at(derivative(weights), theta)
    lower = {"rkn64": 4, "rkn86": 6, "rkn1210": 10}[method]
    for w, order, place in [
        ((pair.b_bar, pair.b), (about.order, about.order), 1),
        ((pair.lower_b_bar, pair.lower_b), (lower, lower), 1),
        ((q, v), (about.extension_order + 1, about.extension_order), theta),
    ]:
        for weight, highest, position in zip(w, order, (True, False), strict=True):
            for one in range(1 + position, highest + 1):
                assert defect(pair, weight, one, position=position, theta=place) < ROUNDOFF


# ----------------------------------------------------------------------------------------------------------------------
# Runs


@pairs
def test_accuracy_and_evaluations(method):
    """The error of an orbit follows the tolerance, and f is evaluated as often as the registry states."""
    about = iv.METHODS[method]
    plain, dense = orbit(method), orbit(method, dense_output=True)
    assert np.abs(plain.y[:, -1] - START).max() < 100 * TOLERANCES["rtol"]
    attempts = plain.stats.steps + plain.stats.failed
    spared = 0 if "fsal" in about.options else plain.stats.failed
    assert plain.nfev == 1 + about.stages * attempts - spared
    assert same(plain, dense)
    assert dense.nfev == plain.nfev + about.extra * plain.stats.steps


@pairs
def test_values_between_steps_are_as_accurate(method):
    """Velocities are the derivatives of positions in the raw extension, and values near to the solution."""
    sol = orbit(method, dense_output=True, interpolation="raw")
    t = np.linspace(*SPAN, 301)
    exact = orbit("ode89", rtol=1e-13, atol=1e-15, t_eval=t)
    assert np.abs(sol.sol(t) - exact.y).max() < 300 * TOLERANCES["rtol"]
    inside, h = (sol.t[:-1] + sol.t[1:]) / 2, 1e-4 * np.diff(sol.t)
    slope = (sol.sol(inside + h)[:2] - sol.sol(inside - h)[:2]) / (2 * h)
    assert np.abs(slope - sol.sol(inside)[2:]).max() < 1e-7  # h² q''' / 6 and roundoff


@pairs
def test_invariants_are_held(method):
    sol = orbit(method, invariants=integrals)
    assert sol.success
    assert sol.stats.projections == sol.stats.steps
    assert np.abs(sol.residual).max() < 1e-13
    assert np.abs(sol.y[:, -1] - START).max() < 100 * TOLERANCES["rtol"]


@pytest.mark.parametrize("method", [name for name in PAIRS if "fsal" in iv.METHODS[name].options])
def test_a_projection_of_velocities_keeps_the_last_acceleration(method):
    """f at the end of the step is that of the projected one: evaluating it again changes no bit."""
    held = iv.Invariants(energy, moves=[2, 3])
    reused, again = (orbit(method, invariants=held, fsal=fsal) for fsal in ("reuse", "evaluate"))
    assert reused.stats.projections == reused.stats.steps
    assert same(reused, again)
    assert reused.nfev < again.nfev <= reused.nfev + again.stats.steps  # none where nothing was left to project


@pairs
def test_backwards(method):
    there = orbit(method)
    back = iv.solve_ivp(iv.SecondOrder(attraction), SPAN[::-1], there.y[:, -1], method, **TOLERANCES)
    assert np.abs(back.y[:, -1] - START).max() < 100 * TOLERANCES["rtol"]


@pairs
def test_units_of_time_and_length_change_no_bit(method):
    """Powers of two: t by 1/T, q by L, v by L T, accelerations by L T²."""
    T, L = 2.0**20, 2.0**-7
    units = np.array([L, L, L * T, L * T])
    plain = orbit(method, atol=1e-11)
    scaled = iv.solve_ivp(
        iv.SecondOrder(lambda t, q: attraction(t * T, q / L) * L * T * T),
        (0, SPAN[1] / T),
        units * START,
        method,
        rtol=1e-9,
        atol=1e-11 * units,
    )
    assert np.array_equal(plain.t, scaled.t * T)
    assert np.array_equal(plain.y, scaled.y / units[:, None])


@pairs
def test_a_run_goes_on_to_the_last_bit(method, tmp_path):
    """The law holds from a file: what the sums have lost is remembered."""
    whole, part = orbit(method, invariants=energy), orbit(method, invariants=energy, max_steps=7)
    assert same(whole, part.extend(SPAN[1], max_steps=None))
    part.save(tmp_path / "orbit.npz")
    problem = iv.Problem(iv.SecondOrder(attraction), SPAN, START, invariants=energy)
    assert same(whole, iv.load(tmp_path / "orbit.npz", problem).extend(SPAN[1], max_steps=None))


@pairs
def test_events_and_jumps(method):
    """Every apsis is found, half a period apart; an impact starts the method again."""
    sol = orbit(method, events=apsis)
    expected = np.pi * np.arange(1, 2 * TURNS)
    assert len(sol.t_events[0]) in (len(expected), len(expected) + 1)  # the last one is the end
    assert np.abs(sol.t_events[0][: len(expected)] - expected).max() < 100 * TOLERANCES["rtol"]

    bounce = iv.Event(lambda t, y: y[0], direction=-1, action=lambda t, y: [0.0, -y[1]])
    fall = iv.solve_ivp(iv.SecondOrder(lambda t, q: [-2.0]), (0, 5), [1.0, 0.0], method, events=bounce, **TOLERANCES)
    assert np.abs(fall.t_events[0] - [1, 3, 5][: len(fall.t_events[0])]).max() < 1e-8
    assert len(fall.t_events[0]) >= 2


@pairs
def test_sensitivities(method):
    """Derivatives of positions and velocities to parameters and initial values, in closed form."""
    w, c = 2.0, 0.5
    sol = iv.solve_ivp(
        iv.SecondOrder(spring), (0, 4), [1.0, 0.0], method, args=(w, c), sensitivities=["w", "y0[0]"], **TOLERANCES
    )
    t, h = sol.t, 1e-30
    wc = w + 1j * h
    exact = np.array([((1 - c / wc**2) * np.cos(wc * t) + c / wc**2).imag, (-(wc - c / wc) * np.sin(wc * t)).imag]) / h
    assert np.abs(sol.sensitivities[:, 0] - exact).max() < 1e-7
    assert np.abs(sol.sensitivities[:, 1] - [np.cos(w * t), -w * np.sin(w * t)]).max() < 1e-7


@pytest.mark.parametrize("method", PAIRS)
def test_roundoff_does_not_add_up(method):
    """Over 20000 steps so short that only roundoff is left, the energy stays within a few units, not √steps or more."""
    sol = iv.solve_ivp(
        iv.SecondOrder(lambda t, q: -q),
        (0, 400),
        [1.0, 0.0],
        method,
        max_step=0.02,
        first_step=0.02,
        rtol=1e-12,
        atol=1e-12,
        keep="end",
    )
    assert abs(np.sum(sol.y**2) - 1) < 8 * np.finfo(float).eps


# ----------------------------------------------------------------------------------------------------------------------
# What states a problem


@pairs
def test_both_ways_to_state_it_are_the_same(method):
    stated = iv.solve_ivp(first_order, SPAN, START, method, second_order=True, **TOLERANCES)
    assert same(orbit(method), stated)
    assert orbit(method).nfev == stated.nfev


@explicit_and_implicit
def test_other_methods_integrate_the_first_order_form(method):
    assert same(orbit(method), iv.solve_ivp(first_order, SPAN, START, method, **TOLERANCES))


@pytest.mark.parametrize("method", [*PAIRS, "dop853", "taylor", "ode15s"])
@pytest.mark.parametrize("stated", ["SecondOrder", "compiled", "option"])
def test_there_are_as_many_velocities_as_positions(method, stated):
    fun = iv.SecondOrder(lambda t, q: -q)
    given = {"SecondOrder": fun, "compiled": iv.compile(fun), "option": lambda t, y: [y[1], -y[0], 0.0]}[stated]
    with pytest.raises(ValueError, match="as many velocities as positions: y0 has 3 components"):
        iv.solve_ivp(given, (0, 1), [1.0, 2.0, 3.0], method, second_order=stated == "option")


def test_machine_code():
    """As f of (t, q), with its parameters, and compiled from Python, in all three ways."""
    kind = ctypes.CFUNCTYPE(None, ctypes.c_double, *[ctypes.POINTER(ctypes.c_double)] * 3)

    @kind
    def code(t, q, out, p):
        out[0] = -p[0] * p[0] * q[0] + p[1]

    def solve(fun, **options):
        return iv.solve_ivp(fun, (0, 4), [1.0, 0.0], "rkn86", args=(2.0, 0.5), **TOLERANCES, **options)

    python = solve(iv.SecondOrder(spring))
    for fun in (code, iv.compile(spring), iv.compile(spring, by="numba")):
        if fun is not code and fun.how == "numba":
            fun = iv.compile(lambda t, q, p: (-p[0] * p[0] * q[0] + p[1],), by="numba")
        assert same(python, solve(iv.SecondOrder(fun)))
    assert same(python, solve(iv.compile(iv.SecondOrder(spring))))


def test_ensembles_and_prepared_solvers():
    """Give what single solves give; lanes are refused by name."""
    problem = iv.Problem(iv.compile(iv.SecondOrder(spring)), (0, 4), [1.0, 0.0], args=(2.0, 0.5))
    starts = [[1.0, 0.0], [0.5, 1.0]]
    single = [problem.replace(y0=y0).solve("rkn1210", **TOLERANCES).y[:, -1] for y0 in starts]
    many = problem.solve_ensemble(starts, "rkn1210", **TOLERANCES)
    assert np.array_equal(many.y[..., -1], single)
    solver = problem.prepare("rkn1210", **TOLERANCES)
    assert all(np.array_equal(solver(y0=y0).y[:, -1], one) for y0, one in zip(starts, single, strict=True))


def until_it_converges(t, q, p):
    """-E of Kepler's equation E - p sin E = q, by a loop that cannot be traced."""
    E, change = q[0], q[0] / q[0]
    while abs(change) > 1e-15:
        change = (E - p[0] * np.sin(E) - q[0]) / (1 - p[0] * np.cos(E))
        E = E - change
    return [-E]


def test_what_cannot_be_traced_is_compiled_by_numba():
    """The accelerations are too, in both orders of compile and SecondOrder."""

    def solve(fun):
        return iv.solve_ivp(fun, (0, 1), [1.0, 0.0], "rkn86", args=(0.1,), **TOLERANCES)

    python = solve(iv.SecondOrder(lambda t, q, p: until_it_converges(t, q, [p])))
    for compiled in (iv.compile(iv.SecondOrder(until_it_converges)), iv.SecondOrder(iv.compile(until_it_converges))):
        assert np.abs(solve(compiled).y[:, -1] - python.y[:, -1]).max() < 1e-13


@pairs
def test_the_gradient_by_a_run_backwards(method):
    """λ has no second-order equation; its run has another method."""
    sol = iv.solve_ivp(
        iv.SecondOrder(spring), (0, 4), [1.0, 0.0], method, args=(2.0, 0.5), sensitivities=True, dense_output=True,
        **TOLERANCES,
    )  # fmt: skip
    assert np.abs(sol.gradient([1.0, 2.0]) - np.array([1.0, 2.0]) @ sol.sensitivities[:, :, -1]).max() < 1e-6


def test_taylor_takes_accelerations():
    for fun in (iv.SecondOrder(spring), iv.SecondOrder(iv.compile(spring))):
        sol = iv.solve_ivp(fun, (0, 4), [1.0, 0.0], "taylor", args=(2.0, 0.0), **TOLERANCES)
        assert np.abs(sol.y[:, -1] - [np.cos(8), -2 * np.sin(8)]).max() < 1e-7


def test_inputs_complex_states_and_pickles():
    force = iv.Input([0, 1, 2], [0.0, 1.0, 1.0], "linear")
    sol = iv.Problem(iv.SecondOrder(lambda t, q, u: [u]), (0, 2), [0.0, 0.0], inputs=force).solve("rkn64", **TOLERANCES)
    assert np.allclose(sol.y[:, -1], [1 / 6 + 0.5 + 0.5, 1.5], rtol=1e-9)
    for fun in (lambda t, q: -q, iv.compile(lambda t, q: [-q[0]]), iv.compile(lambda t, q: -q)):
        wave = iv.solve_ivp(iv.SecondOrder(fun), (0, np.pi), [1j, 1.0 + 0j], "rkn1210", **TOLERANCES)
        assert np.allclose(wave.y[:, -1], [-1j, -1.0], atol=1e-8)
    again = pickle.loads(pickle.dumps(iv.SecondOrder(attraction)))
    assert same(orbit("rkn64"), iv.solve_ivp(again, SPAN, START, "rkn64", **TOLERANCES))


def damped(t, y, c):
    return [y[1], -y[0] - c * y[1]]


def damped_later(t, y):
    return damped(t, y, max(0.0, t - 1))


@pairs
def test_velocities_that_matter_later_are_refused(method):
    """A drag that begins after the start, or with other arguments than those tested there."""
    stated = {"y0": [1.0, 0.0], "second_order": True}
    later = iv.Problem(damped_later, (0, 1), **stated)
    with pytest.raises(ValueError, match=r"component 1 of fun depends on the velocities.*the solution is wrong"):
        later.solve(method, **TOLERANCES).extend(3)
    for fun in (damped, iv.compile(damped)):
        problem = iv.Problem(fun, (0, 3), args=(0.0,), **stated)
        with pytest.raises(ValueError, match="with other parameters: the sensitivities do too"):
            problem.replace(sensitivities=["c"]).solve(method)
        with pytest.raises(ValueError, match=r"at t = 0\.0\. rkn64"):
            problem.prepare(method)(args=(0.1,))
        many = problem.solve_ensemble([[1.0, 0.0]] * 2, method, args=[(0.0,), (0.1,)], on_failure="return")
        assert many.status.tolist() == [0, many.status[1]]
        assert not many.success[1]


def test_an_f_without_a_value_is_not_said_to_depend_on_velocities():
    nowhere = iv.solve_ivp(lambda t, y: [y[1], np.nan], (0, 1), [1.0, 0.0], "rkn64", second_order=True)
    assert nowhere.message.startswith("fun is not finite at the start")


@pytest.mark.parametrize(
    ("fun", "options", "message"),
    [
        (first_order, {}, r"rkn86 is for y'' = f\(t, y\).*pass invariode.SecondOrder.*second_order=True"),
        (
            lambda t, y: [*y[2:], *(-y[:2] - 0.1 * y[2:])],
            {"second_order": True},
            "component 2 of fun depends on the velo",
        ),
        (lambda t, y: [*y[:2], *y[:2]], {"second_order": True}, r"the first 2 values of fun are not the velocities"),
        (iv.SecondOrder(attraction), {"y0": START[:3]}, "as many velocities as positions: y0 has 3"),
        (iv.SecondOrder(attraction), {"bounds": (-9, 9)}, "does not take bounds"),
        (iv.SecondOrder(attraction), {"mass": np.eye(4)}, "cannot use a mass matrix"),
    ],
)
def test_what_is_refused(fun, options, message):
    y0 = options.pop("y0", START)
    with pytest.raises(ValueError, match=message):
        iv.solve_ivp(fun, SPAN, y0, "rkn86", **options)


@pairs
def test_columns_and_a_tolerance_for_each_component(method):
    """f of columns of positions; SciPy's arrays of tolerances."""

    def columns(t, q):  # without powers: NumPy's of arrays and of numbers round differently on some processors
        square = q[:1] ** 2 + q[1:] ** 2
        return -q / (square * np.sqrt(square))

    one_by_one, together = (
        iv.solve_ivp(iv.SecondOrder(columns), SPAN, START, method, vectorized=vectorized, **TOLERANCES)
        for vectorized in (False, True)
    )
    assert same(one_by_one, together)
    assert same(orbit(method), orbit(method, rtol=[1e-9] * 4))


def test_second_order_of_no_function():
    with pytest.raises(TypeError, match=r"SecondOrder takes a function f\(t, q\), got 3"):
        iv.SecondOrder(3)
