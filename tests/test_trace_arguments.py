"""Traced functions take arguments of any kind, and branches cost one path where they can."""

from __future__ import annotations

import math

import numpy as np
import pytest

import invariode as iv
from invariode._functions.graph.python import Formula
from invariode._functions.graph.trace import trace

pytest.importorskip("llvmlite")
from traced_functions import K, ends


class Spring:
    def __init__(self, k):
        self.k = k

    def force(self, x):
        return -self.k * x


def many_kinds(t, y, a, matrix, options, spring, count, pair, damped):
    slopes = np.zeros(2)
    for i in range(count):
        slopes[i] = options["drive"] * np.sin(t) - a * y[i]
    low, high = pair
    slopes += np.array([low * y[1], spring.force(y[0]) + high])
    return matrix @ slopes - (0.1 * y if damped else 0)


KINDS = (2.0, np.array([[1.0, 0.2], [0.3, 1.0]]), {"drive": 0.5}, Spring(3.0), 2, [0.3, 0.4], True)


def test_arguments_of_any_kind_are_those_of_the_function():
    """Numbers are parameters, everything else is a constant; another value of either is noticed."""
    code = iv.compile(many_kinds, by="trace")
    changes = [{}, {0: 2.5}, {1: np.eye(2)}, {2: {"drive": 0.7}}, {3: Spring(1.0)}, {4: 1}, {5: (0.1, 0.2)}, {6: False}]
    for change in changes:
        args = tuple(change.get(i, one) for i, one in enumerate(KINDS))
        np.testing.assert_allclose(ends(code, args), ends(many_kinds, args), rtol=1e-9, err_msg=repr(change))
    options = KINDS[2]
    before = ends(code, KINDS)
    options["drive"] = 0.9
    after = ends(code, KINDS)
    np.testing.assert_allclose(after, ends(many_kinds, KINDS), rtol=1e-9)
    options["drive"] = 0.5
    assert abs(after - before).max() > 1e-3


def test_events_invariants_jacobians_and_actions_take_the_same_arguments():
    def fun(t, y, k, names):
        return [y[1], -k[names["stiffness"]] * y[0]]

    def energy(t, y, k, names):
        return y[1] ** 2 + k[names["stiffness"]] * y[0] ** 2

    def jac(t, y, k, names):
        return [[0, 1], [-k[names["stiffness"]], 0]]

    def turning(t, y, k, names):
        return y[1] - 0.1 * k[0]

    def kick(t, y, k, names):
        return np.array([y[0], y[1] + k[0]])

    def run(wrap):
        return iv.solve_ivp(
            wrap(fun),
            (0, 6),
            [1.0, 0.0],
            "ode15s",
            args=(np.array([0.2, 4.0]), {"stiffness": 1}),
            invariants=iv.Invariants(wrap(energy), names="energy"),
            events=iv.Event(wrap(turning)),
            jac=wrap(jac),
            breakpoints=[(3.0, wrap(kick))],
            rtol=1e-6,
        )

    plain, code = run(lambda f: f), run(lambda f: iv.compile(f, by="trace"))
    assert plain.stats.steps == code.stats.steps
    assert len(code.t_events[0]) == len(plain.t_events[0]) > 2
    np.testing.assert_allclose(code.t_events[0], plain.t_events[0], rtol=1e-9)
    np.testing.assert_allclose(code.y[:, -1], plain.y[:, -1], rtol=1e-9)


def test_inputs_come_before_arguments():
    u = iv.Input([0.0, 1.0, 2.0], [[0.0, 1.0], [1.0, 0.0], [2.0, 0.5]], kind="linear")
    for fun in (lambda t, y, u, a, b: [u[0] * a["k"] - b * y[0] + u[1]], lambda t, y, *p: [p[0][0] - p[2] * y[0]]):
        runs = [
            iv.Problem(one, (0, 2), [1.0], args=({"k": 2.0}, 0.5), inputs=u).solve("ode45", rtol=1e-6)
            for one in (fun, iv.compile(fun, by="trace"))
        ]
        np.testing.assert_allclose(runs[1].y[:, -1], runs[0].y[:, -1], rtol=1e-12)


def test_arguments_that_do_not_fit_one_by_one_are_one_array():
    code = iv.compile(lambda t, y, p: [p[0] * y[1] - p[2], -p[1] * y[0]], by="trace")
    np.testing.assert_allclose(ends(code, (1.0, [2.0, 3.0])), ends(lambda t, y, *_: code(t, y, [1.0, 2.0, 3.0]), ()))


def test_an_undefined_path_is_not_a_wrong_number_of_arguments():
    """Where f reads p[0], p stands for all arguments, even if another path does not use it."""
    code = iv.compile(lambda t, y, p: y if t < 2 else p[0] * y, by="trace")
    end = iv.solve_ivp(code, (0, 3), [1.0], args=(2.0,), breakpoints=[2.0], rtol=1e-6, atol=1e-8).y[0, -1]
    assert math.isclose(end, math.exp(4), rel_tol=1e-4)


def test_prepared_solvers_and_ensembles_notice_arguments_that_are_constants():
    rows = [(a, *KINDS[1:]) for a in (1.0, 2.0, 3.0)]
    code = iv.compile(many_kinds, by="trace")
    found = iv.solve_ensemble(code, (0, 1), [[1.0, 0.5]] * 3, args=rows, rtol=1e-7, atol=1e-9)
    for row, end in zip(rows, found.y_end, strict=True):
        np.testing.assert_allclose(end, ends(many_kinds, row), rtol=1e-9)
    solver = iv.Problem(code, (0, 1), [1.0, 0.5], args=KINDS).prepare("ode45", rtol=1e-7, atol=1e-9)
    for i, value in ((2, {"drive": 0.1}), (4, 1)):
        other = (*KINDS[:i], value, *KINDS[i + 1 :])
        np.testing.assert_allclose(solver(args=other).y[:, -1], ends(many_kinds, other), rtol=1e-9)
        with pytest.raises(ValueError, match="args of a compiled ensemble"):
            iv.solve_ensemble(code, (0, 1), [[1.0, 0.5]] * 2, args=[KINDS, other])


def branches_everywhere(t, y):
    """Branches that assign, in loops and in each other; that return; conditions of several parts; temporary names."""
    slopes = np.zeros(len(y))
    for i in range(len(y)):
        if y[i] > 0 and not 0.2 < t < 0.3:
            slopes[i] = -y[i]
        elif y[i] < -1 or t > 2:
            twice = 2 * y[i]
            slopes[i] = twice**2
        else:
            slopes[i] += 1.0
    total = sum(slopes)
    if total > 1:
        return slopes / total
    before = total
    if y[0] > y[1]:
        total -= 1
        slopes -= 0.5
    return np.append(slopes[:-1], total - before)


def test_branches_that_assign_or_return_cost_one_path():
    """Seven on components, with conditions of several parts: 2^7 paths and more if they were followed one by one."""
    found = trace(branches_everywhere, 7)
    assert found.paths == 1
    formula = Formula("f", lambda: found.outputs, (7,))
    rng = np.random.default_rng(27)
    for _ in range(50):
        t, y = rng.uniform(0, 3), 1.5 * rng.standard_normal(7)
        np.testing.assert_array_equal(formula(t, y), branches_everywhere(t, y))


def index_by_branch(t, y):
    k = 0 if y[0] > 0 else 1
    return [K[k, 0] * y[0], K[0, k] * y[1]]


def test_branches_that_are_no_selections_are_paths():
    """An index that a branch chooses is known on each path."""
    found = trace(index_by_branch, 2)
    assert found.paths == 2
    formula = Formula("f", lambda: found.outputs, (2,))
    for y in ([1.0, 2.0], [-1.0, 2.0]):
        np.testing.assert_array_equal(formula(0.0, y), index_by_branch(0.0, y))
