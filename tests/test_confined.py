"""Within bounds f is called nowhere else, laws may have roundoff in their coefficients, and exceptions come out."""

from __future__ import annotations

import warnings
from collections import Counter

import numpy as np
import pytest
from scipy.linalg import null_space

import invariode as iv
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families
from test_bounds import robertson, total

IMPLICIT = [name for name, method in METHODS.items() if "jac" in method.options]


def tank(t, y):
    return -np.sqrt(y)


def decay(t, y):
    return [-y[0], y[0] - 100 * y[1], 100 * y[1], 0.0]


def approaching(t, y):
    """A saturation: y = 1 - exp(-t) within [0, 1], with a rate that is not defined above 1."""
    return np.sqrt(1 - y) * np.sqrt(1 - y)


class Watched:
    """f, and the farthest outside of [lower, upper] that it was ever called."""

    def __init__(self, fun, lower, upper):
        self.fun, self.lower, self.upper, self.outside = fun, lower, upper, 0.0

    def __call__(self, t, y):
        self.outside = max(self.outside, *(self.lower - y), *(y - self.upper))
        return self.fun(t, y)


CASES = {
    "tank": (tank, (0, 10), [1.0], 0.0, np.inf),
    "tanks": (lambda t, y: [-np.sqrt(y[0]), np.sqrt(y[0]) - np.sqrt(y[1])], (0, 10), [1.0, 0.0], 0.0, np.inf),
    "saturation": (approaching, (0, 30), [0.0], 0.0, 1.0),
    "chain": (decay, (0, 3), [1.0, 0.0, 0.0, 0.0], 0.0, np.inf),
}


@dealt(name=CASES, rtol=[1e-3, 1e-6], method=METHODS)
def test_f_never_sees_a_value_outside_its_bounds(name, rtol, method):
    fun, t_span, y0, lower, upper = CASES[name]
    f = Watched(fun, lower, upper)
    with np.errstate(invalid="raise"):  # sqrt would say so too
        sol = iv.solve_ivp(f, t_span, y0, method, bounds=(lower, upper), rtol=rtol, max_steps=3000)
    assert sol.success, sol.message
    assert f.outside == 0


@pytest.mark.parametrize("method", IMPLICIT)
def test_nor_does_a_stiff_f_nor_one_with_algebraic_equations(method):
    f = Watched(robertson, 0, np.inf)
    assert iv.solve_ivp(f, (0, 4e6), [1.0, 0, 0], method, nonnegative=True, rtol=1e-4, atol=1e-8).success
    assert f.outside == 0
    if iv.METHODS[method].mass != "any":
        return
    f = Watched(lambda t, y: [*robertson(t, y)[:2], y.sum() - 1], 0, np.inf)
    assert iv.solve_ivp(f, (0, 4e6), [1.0, 0, 0], method, nonnegative=True, mass=np.diag([1.0, 1, 0])).success
    assert f.outside == 0


@dealt(rtol=[1e-2, 1e-4, 1e-8], method=FAMILIES)
def test_a_tank_that_drains_stays_empty(rtol, method):
    """y = (1 - t/2)² until t = 2; the last part, of the size of atol, may take any time."""
    sol = iv.solve_ivp(tank, (0, 10), [1.0], method, nonnegative=True, rtol=rtol, atol=1e-6, max_steps=3000)
    assert sol.success, sol.message
    exact = np.maximum(1 - sol.t / 2, 0) ** 2
    assert np.abs(sol.y[0] - exact).max() <= 10 * rtol + 1e-4
    assert sol.y[0, -1] <= 1e-6


@explicit_and_implicit
def test_a_start_outside_by_less_than_the_tolerance_is_moved_before_f_sees_it(method):
    f = Watched(lambda t, y: [-y[0], y[0]], 0, np.inf)
    assert iv.solve_ivp(f, (0, 1), [1.0, -1e-7], method, nonnegative=True).success
    assert f.outside == 0


@pytest.fixture(scope="module")
def drains():
    pytest.importorskip("numba")
    return iv.compile(lambda t, y: (-(y[0] ** 0.5),))


@explicit_and_implicit
def test_compiled_functions_are_confined_too(method, drains):
    sol = iv.solve_ivp(drains, (0, 10), [1.0], method, nonnegative=True, rtol=1e-4, max_steps=3000)
    assert sol.success, sol.message
    assert sol.y[0, -1] <= 1e-6


# ----------------------------------------------------------------------------------------------------------------------
# Laws with roundoff in their coefficients


@families
def test_roundoff_in_a_coefficient_does_not_hold_the_solution(method):
    def law(t, y):
        return [y[0] + y[1] + y[2], y[3] + 1e-17 * (y[0] - 0.7 * y[2])]

    options = {"nonnegative": True, "rtol": 1e-3, "max_steps": 3000}
    sol = iv.solve_ivp(decay, (0, 3), [1.0, 0, 0, 0], method, invariants=law, **options)
    assert sol.success, sol.message
    assert sol.y[0, -1] == pytest.approx(np.exp(-3), abs=2e-3)


@families
def test_roundoff_in_a_multiple_of_another_law_does_not_hold_the_solution(method):
    """At y[3] = 0 the second law is 1e-12 times the first, but for roundoff, which is 1e-3 of that."""

    def law(t, y):
        return [y[0] + y[1] + y[2], y[3] + 1e-12 * (y[0] + 1.001 * y[1] + y[2])]

    sol = iv.solve_ivp(decay, (0, 3), [1.0, 0, 0, 0], method, invariants=law, nonnegative=True, rtol=1e-6, atol=1e-9)
    assert sol.success, sol.message
    plain = iv.solve_ivp(decay, (0, 3), [1.0, 0, 0, 0], method, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(sol.y[:, -1], plain.y[:, -1], atol=1e-5)


def network(seed):
    """Mass action between 5 to 30 species, half of which are absent at the start."""
    random = np.random.default_rng(seed)
    n = int(random.integers(5, 31))
    m = int(random.integers(n // 2, n))
    change, order = np.zeros((n, m)), np.zeros((n, m), dtype=bool)
    for j in range(m):
        species = random.permutation(n)[: random.integers(2, 5)]
        cut = random.integers(1, len(species))
        change[species[:cut], j] = -1
        change[species[cut:], j] = 1
        order[species[:cut], j] = True
    rate = 10 ** random.uniform(-1, 2, m)
    y0 = np.where(random.random(n) < 0.5, random.random(n), 0.0)
    return (lambda t, y: change @ (rate * np.where(order.T, y, 1).prod(axis=1))), null_space(change.T).T, y0


@pytest.mark.parametrize("seed", range(6))
def test_networks_with_laws_from_a_null_space(seed):
    """If laws are imposed, the end is as near to the reference as a few tolerances; methods take turns."""
    fun, laws, y0 = network(seed)
    reference = iv.solve_ivp(fun, (0, 3), y0, "radau", rtol=1e-8, atol=1e-11).y[:, -1]
    names = list(METHODS)
    for method in (names[seed % len(names)], names[(seed + 5) % len(names)]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", iv.StiffnessWarning)
            sol = iv.solve_ivp(
                fun, (0, 3), y0, method, rtol=1e-5, atol=1e-8, nonnegative=True, invariants=lambda t, y: laws @ y
            )
        assert sol.success, (method, sol.message)
        assert np.abs(laws @ (sol.y - sol.y[:, :1])).max() <= 1e-12
        assert np.abs(sol.y[:, -1] - reference).max() <= 1e-3, method


# ----------------------------------------------------------------------------------------------------------------------
# Exceptions


class OurError(Exception):
    pass


class Calls:
    """Functions that count their calls at real y, of which number `last` of `name` raises."""

    def __init__(self, name=None, last=0):
        self.count, self.name, self.last = Counter(), name, last

    def of(self, name, fun):
        def call(t, y):
            if not np.iscomplexobj(y):  # where g is only tried
                self.count[name] += 1
                if name == self.name and self.count[name] == self.last:
                    raise OurError(name, self.last)
            return fun(t, y)

        return call


@dealt(8, given=[True, False], method=METHODS)
def test_an_exception_comes_out_as_itself_wherever_it_is_raised(given, method):
    def solve(calls):
        g = calls.of("g", lambda t, y: np.array([y[0] + y[1] + y[2], y[3]]))
        gjac = calls.of("gjac", lambda t, y: np.array([[1, 1, 1, 0.0], [0, 0, 0, 1]]))
        jac = calls.of("jac", lambda t, y: np.array([[-1, 0, 0, 0], [1, -20, 0, 0], [0, 20, 0, 0], [0, 0, 0, 0.0]]))
        more = {"jac": jac} if given and method in IMPLICIT else {}
        iv.solve_ivp(
            calls.of("f", lambda t, y: np.array([-y[0], y[0] - 20 * y[1], 20 * y[1], 0.0])),
            (0, 0.2),
            [1.0, 0, 0, 0],
            method,
            nonnegative=True,
            invariants=iv.Invariants(g, jac=gjac if given else "3-point"),
            events=calls.of("event", lambda t, y: y[0] - 0.9),
            **more,
        )

    solve(Calls())  # whose plan the others have in common
    plain = Calls()
    solve(plain)
    for name, count in plain.count.items():
        for k in {*range(1, min(count, 25) + 1), count}:
            with pytest.raises(OurError) as raised:
                solve(Calls(name, k))
            assert raised.value.args == (name, k)


def test_a_law_that_nothing_can_correct_changes_nothing():
    """The total of Robertson's problem is kept to roundoff with and without a law that no component can correct."""
    laws = [total, lambda t, y: [total(t, y[:3]), y[3]]]
    four = [robertson, lambda t, y: [*robertson(t, y[:3]), 0.0]]
    ends = [
        iv.solve_ivp(f, (0, 1e3), y0, "ode15s", nonnegative=True, invariants=law, rtol=1e-4, atol=1e-8).y[:3, -1]
        for f, y0, law in zip(four, ([1.0, 0, 0], [1.0, 0, 0, 0]), laws, strict=True)
    ]
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-3)
