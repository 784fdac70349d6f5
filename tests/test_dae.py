"""Differential-algebraic equations of any index: analysis, consistent starts, solutions on all hidden constraints."""

from __future__ import annotations

import pickle
import re
import struct

import numpy as np
import pytest

import invariode as iv
from dae_problems import (
    GRAVITY,
    PROBLEMS,
    chain,
    crane_solution,
    pendula,
    pendulum,
    reactor_solution,
    transistors,
)
from invariode._base.arguments import EPS
from invariode._dae.expressions import Values
from invariode._functions.graph.derivatives import jacobian
from invariode._functions.graph.rounding import bounds

pytestmark = pytest.mark.filterwarnings("ignore:initial values were moved")


def off_constraints(sol: iv.Solution) -> float:
    """The largest residual of all constraints at the outputs, in units of a bound of its roundoff: that of its
    operations, and of the rounding of what they are applied to."""
    origin = sol._origin
    p, worst = np.array(origin.source.problem.args), 0.0
    for level in origin.reduction.levels:
        rows = jacobian(level.in_states, [origin.reduction.graph.y(k) for k in range(len(origin.reduction.states))])
        entries = [(i, k, node) for i, row in enumerate(rows) for k, node in row.items()]
        values, slopes = Values(level.in_states, p), Values([node for *_, node in entries], p)
        for t, state in zip(sol.t.tolist(), origin.reduced.y.T, strict=True):
            error = np.array(bounds(level.in_states, t, state.tolist(), p.tolist())) + 1e-30
            for (i, k, _), slope in zip(entries, slopes(t, state), strict=True):
                error[i] += EPS * abs(slope * state[k])
            worst = max(worst, float((np.abs(values(t, state)) / error).max()))
    return worst


# ----------------------------------------------------------------------------------------------------------------------
# Analysis


def test_index_and_freedom_follow_from_the_equations():
    for name, problem in PROBLEMS.items():
        dae = problem.analysed()
        assert (dae.index, dae.freedom) == (problem.index or dae.index, problem.freedom), name
    for count in (3, 6):
        dae = pendula(count).analysed()
        assert (dae.index, dae.freedom) == (2 * count + 1, 2 * count)


def test_what_was_analysed_can_be_read():
    dae = iv.Dae(pendulum, 0, [1, 0, 0], names=["x", "z", "tension"], equations=["along x", "along z", "rod"], order=2)
    c, d = dae.offsets
    assert (c.tolist(), d.tolist()) == ([0, 0, 2], [2, 2, 0])
    assert dae.blocks == [(["along x", "along z", "rod"], dae.blocks[0][1])]
    assert sorted(dae.blocks[0][1]) == ["tension", "x''", "z''"]
    assert dae.repairs == []
    text = str(dae)
    assert "3 equations, index 3, 2 degrees of freedom, 2 constraints" in text
    assert re.search(r"rod +2 ", text)


def test_singular_equations_are_combined_with_numbers_and_with_expressions():
    """Numbers are recognised as such; expressions are those of the theorem."""
    assert len(PROBLEMS["transistors"].analysed().repairs) == 3
    (repair,) = PROBLEMS["ring modulator"].analysed().repairs
    assert "F[2] - F[3] + F[4] - F[5]" in repair
    (repair,) = PROBLEMS["robot arm"].analysed().repairs
    assert "(...)" in repair


def _within_functions():
    """Equations that no linear combination repairs, with solutions: derivatives occur together within functions."""

    def nedialkov(t, y, yp, ypp):  # Tan, Nedialkov and Pryce's example: only the substitution x + y y' is allowed
        x, dx, v, dv, ddv = np.sin(t), np.cos(t), np.cos(t) + 2, -np.sin(t), -np.cos(t)
        return [
            y[0] + np.exp(-yp[0] - y[1] * ypp[1]) - x - np.exp(-dx - v * ddv),
            y[0] + y[1] * yp[1] + y[1] ** 2 - x - v * dv - v**2,
        ]

    def rates(t, y, yp, k):  # a sum with a factor that depends on t; k makes them a family
        sum_, exact = yp[0] + k * t * yp[1], np.cos(t) - t * np.sin(t)
        return [np.exp(sum_) - np.exp(exact), sum_ + y[0] - y[1] - exact - np.sin(t) + np.cos(t)]

    def three(t, y, yp):  # three derivatives in one sum, and two of them in another
        total, exact = yp[0] + yp[1] + yp[2], np.cos(t) - np.sin(t) + 1
        return [
            np.sinh(total) + y[0] - np.sinh(exact) - np.sin(t),
            yp[1] - 2 * yp[2] + y[2] + np.sin(t) + 2 - t,
            total**3 + y[1] - exact**3 - np.cos(t),
        ]

    return {
        "substitution of x + y y'": (nedialkov, [0, 3], [1, 0], (), 2, lambda t: [np.sin(t), np.cos(t) + 2], 1),
        "a factor of t": (rates, [0, 1], [1, 0], (1.0,), 1, lambda t: [np.sin(t), np.cos(t)], 1),
        "three derivatives": (three, [0, 1, 0], [1, 0, 1], (), 1, lambda t: [np.sin(t), np.cos(t), t], 2),
    }


def test_expressions_in_which_derivatives_occur_together_become_unknowns():
    """If no combination is allowed, the unknowns of F have the known solutions, by explicit and implicit methods."""
    for name, (F, y0, yp0, args, order, exact, freedom) in _within_functions().items():
        dae = iv.Dae(F, 0, y0, yp0, args=args, order=order)
        assert dae.freedom == freedom, name
        assert any(re.search(r"w1 = .* is a new unknown", one) for one in dae.repairs), name
        for method in ("dop853", "radau") if order == 2 else ("dop853",):
            sol = dae.solve((0, 1), method, fixed=[0], rtol=1e-9, atol=[1e-11] * len(y0), dense_output=True)
            assert sol.success
            np.testing.assert_allclose(sol.y, np.array(np.broadcast_arrays(*exact(sol.t))), atol=1e-7)
            np.testing.assert_allclose(sol.sol(0.7), exact(0.7), atol=1e-6)


def test_substituted_unknowns_follow_actions_and_parameters():
    """After an action the new unknowns are those of the changed values; derivatives are those of differences."""
    F, y0, yp0, args, *_ = _within_functions()["a factor of t"]

    def kick(t, y, k):
        return [y[0] + 0.125, y[1] + 0.125]  # the equations determine y[0] - y[1]

    half = iv.Event(lambda t, y, k: t - 0.5, action=kick)
    given = {"rtol": 1e-10, "atol": 1e-12, "method": "dop853"}
    sol = iv.solve_dae(F, (0, 0.5), y0, yp0, args=args, **given)
    moved = iv.solve_dae(F, (0, 1), y0, yp0, args=args, events=half, **given)
    after = iv.solve_dae(F, (0.5, 1), np.array(sol.y_end) + 0.125, sol.yp[:, -1], args=args, **given)
    np.testing.assert_allclose(moved.y_end, after.y_end, atol=1e-9)
    sensitive = iv.solve_dae(F, (0, 1), y0, yp0, args=args, sensitivities=True, **given)
    more, less = (iv.solve_dae(F, (0, 1), y0, yp0, args=(1 + d,), **given).y_end for d in (1e-5, -1e-5))
    np.testing.assert_allclose(sensitive.sensitivities[:, 0, -1], (more - less) / 2e-5, atol=1e-6)


def test_a_term_that_cancels_exactly_is_absent():
    dae = iv.Dae(lambda t, y, yp: [yp[0] + 0.0 * yp[1] + y[1], y[0] - np.sin(t) + 0 * yp[0] * yp[1]], 0, [0, 0])
    assert dae.freedom == 0
    dae = iv.Dae(
        lambda t, y, yp: [yp[0] * y[1] + y[0] * yp[1] - (y[0] * yp[1] + yp[0] * y[1]) + y[0] - np.cos(t), yp[1] - y[0]],
        *(0, [1, 0]),
    )
    assert dae.freedom == 1


def test_a_derivative_that_vanishes_near_the_start_is_not_absent():
    """A saturated tanh, and a branch that is not taken, have no influence near the start, but at the end."""

    def valve(t, y, yp):
        return [yp[0] - 10, y[1] - (1 + np.tanh(1000 * (y[0] - 5)))]

    def branch(t, y, yp):
        return [yp[0] - 10, y[1] - (y[0] - 5 if y[0] > 5 else 0.0)]

    def feedback(t, y, yp):
        return [yp[0] + (y[0] if y[0] > 0.5 else 2 * y[1]), y[1] - y[0] ** 2]

    def steps(t, y, yp):
        return [yp[0] - 10, y[1] - np.floor(y[0] / 3)]

    for F, end in ((valve, 2.0), (branch, 5.0), (steps, 3.0)):
        sol = iv.solve_dae(F, (0, 1), [0, 0], method="dop853", rtol=1e-6, atol=1e-8)
        assert sol.success
        assert sol.y[1, -1] == pytest.approx(end, abs=1e-12)
    sol = iv.solve_dae(feedback, (0, 3), [1, 1], method="dop853", rtol=1e-8, atol=1e-10)
    assert sol.y[0, -1] == pytest.approx(1 / (2 + 2 * (3 - np.log(2))), rel=1e-7)  # e^-t until 1/2, then 1/(2 + 2 s)


# ----------------------------------------------------------------------------------------------------------------------
# Equations that are no DAE that can be solved


def _wrong():
    t_only = {"y0": [0, 0, 0], "yp0": [0, 0, 1]}
    volts = {"names": ["V1", "V2", "V3"], "equations": ["node 1", "node 2", "node 3"]}
    return {
        "too many for z, too few for x, y": (
            lambda t, y, yp: [y[0] + y[1] - np.sin(t), y[2] - np.sin(t), yp[2] - np.cos(t)],
            {**t_only, "names": ["x", "y", "z"]},
            r"Too many equations: F\[1\], F\[2\] \(2\) contain only z \(1\).*x, y \(2\) are only in F\[0\]",
        ),
        "no ground": (
            lambda t, y, yp: [
                1e-6 * (yp[0] - yp[1]) + (y[0] - y[2]) / 1e3,
                -1e-6 * (yp[0] - yp[1]) + (y[1] - y[2]) / 1e3,
                (y[2] - y[0]) / 1e3 + (y[2] - y[1]) / 1e3,
            ],
            {"y0": [1.0, 0, 0], **volts},
            r"node . \+ node . \+ node . contains no unknown.*redundant; V1, V2, V3 are determined only up to a "
            r"constant.*ground one",
        ),
        "no ground, and currents that do not add up": (
            lambda t, y, yp: [y[0] - y[1] + 1, y[1] - y[0] + 1],
            {"y0": [1.0, 0]},
            r"F\[.\] \+ F\[.\] contains no unknown.*contradict each other",
        ),
        "a constraint twice": (
            lambda t, y, yp, ypp: [
                ypp[0] + y[0] * (y[2] + y[3]),
                ypp[1] + y[1] * (y[2] + y[3]) + GRAVITY,
                y[0] ** 2 + y[1] ** 2 - 1,
                2 * y[0] ** 2 + 2 * y[1] ** 2 - 2,
            ],
            {"y0": [1.0, 0, 0, 0], "order": 2},
            r"F\[2\] - 0.5 F\[3\] contains no unknown.*redundant; so at least one equation is missing",
        ),
        "a constraint twice, with different lengths": (
            lambda t, y, yp: [yp[0] - y[1], y[0] - 1, 2 * y[0] - 3],
            {"y0": [1.0, 0, 0]},
            r"Too many equations: F\[1\], F\[2\].*contain only y\[0\]",
        ),
        "an equation without unknowns": (
            lambda t, y, yp: [yp[0] + y[1], np.sin(t) + 0 * y[0]],
            {"y0": [1.0, 0]},
            r"F\[1\] contains no unknown, and it cannot be satisfied",
        ),
        "fewer equations than unknowns": (
            lambda t, y, yp: [yp[0], yp[1], y[0]],
            {"y0": [1.0, 0, 0, 0]},
            "F returns 3 residuals for 4 unknowns",
        ),
        "terms that cancel in a function": (
            lambda t, y, yp: [np.sin(yp[0] * yp[1]) + y[1] - np.sin(1.0), (yp[0] * yp[1]) ** 3 + y[0] - 1],
            {"y0": [0.1, 0.1], "yp0": [0.4, 0.3]},
            r"F\[0\], F\[1\] do not determine y\[.\]', y\[.\]'.*introduce a new unknown",
        ),
        "a guess of the wrong length": (
            lambda t, y, yp: [yp[0]],
            {"y0": [1.0], "yp0": [1.0, 2.0]},
            "yp0 must have 1 values",
        ),
        "a constraint that follows from another one": (
            lambda t, y, yp, ypp: [
                ypp[0] + y[0] * (y[2] + y[3]),
                ypp[1] + y[1] * (y[2] + y[3]) + GRAVITY,
                y[0] ** 2 + y[1] ** 2 - 1,
                np.sqrt(y[0] ** 2 + y[1] ** 2) - 1,
            ],
            {"y0": [1.0, 0, 0, 0], "order": 2},
            r"F\[2\], F\[3\] do not determine.*or leave out an equation that follows from the others",
        ),
        "no unknown": (lambda t, y, yp: [], {"y0": []}, "y0 is empty"),
        "a guess that is NaN": (lambda t, y, yp: [yp[0]], {"y0": [1.0], "yp0": [np.nan]}, r"yp0\[0\] = nan"),
        "an order that F does not have": (lambda t, y, yp: [yp[0]], {"y0": [1.0], "order": 3}, "order must be 1"),
    }


def test_wrong_equations_are_named():
    for name, (F, given, message) in _wrong().items():
        with pytest.raises(ValueError, match=r"\w") as raised:
            iv.Dae(F, 0, **given)
        assert re.search(message, str(raised.value)), name


def test_what_solve_dae_does_not_take_is_named():
    """Options of other problems say what to do instead; F that returns something else says what it returned."""

    def decay(t, y, yp):
        return [yp[0] + y[0]]

    for name, message in (("delays", "solve_ivp"), ("inputs", "call the Input"), ("mass", "write M y' in F")):
        with pytest.raises(TypeError, match=f"solve_dae takes no {name}: .*{message}"):
            iv.solve_dae(decay, (0, 1), [1], **{name: [1.0]})
    with pytest.raises(TypeError, match="unknown option 'rtoll'"):
        iv.solve_dae(decay, (0, 1), [1], rtoll=1e-3)
    for F, message in (
        (lambda t, y, yp: [yp[0] + 1j * y[0]], "F returns complex values: write"),
        (lambda t, y, yp: {"a": yp[0]}, "F must return 1 numbers"),
    ):
        with pytest.raises(TypeError, match=message):
            iv.solve_dae(F, (0, 1), [1])


def test_of_unknowns_with_one_name_the_value_of_the_differential_one_counts():
    """y[1] = y[0] renames, and 0 is a guess of the algebraic y[1]; the value of a fixed unknown counts in any case."""

    def equations(t, y, yp):
        return [yp[0] + y[1], y[1] - y[0]]

    np.testing.assert_allclose(iv.solve_dae(equations, (0, 1), [1, 0], rtol=1e-9).y_end, np.exp(-1), rtol=1e-7)
    for fixed, value in (("y[1]", 3.0), ("y[0]", 2.0)):
        np.testing.assert_array_equal(iv.Dae(equations, 0, [2, 3]).consistent([fixed]).y, value)


def test_values_that_cannot_be_fixed_are_named():
    dae = iv.Dae(pendulum, 0, [0.6, -0.7, 0], names=["x", "z", "tension"], order=2)
    with pytest.raises(iv.InvariantError, match=r"too many values are fixed.*F\[2\] relates x, z, all of which"):
        dae.consistent(["x", "z"])
    with pytest.raises(ValueError, match="there is no unknown 'tensoin'; did you mean 'tension'"):
        dae.consistent(["tensoin"])
    with pytest.raises(ValueError, match="fixed must list names"):
        dae.consistent([(0, 1)])


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")
def test_singular_points_are_named_by_equation_and_unknown():
    """At the start as an error; on the way, at an impasse point, as the reason why the run ends there."""

    def equations(t, y, yp):
        return [yp[0] + 1, y[0] - y[1] ** 2]

    with pytest.raises(iv.InvariantError, match=r"singular point: F\[1\] does not determine y\[1\]"):
        iv.Dae(equations, 0, [0, 0]).consistent()
    for method in ("dop853", "radau", "ode15s"):
        sol = iv.solve_dae(equations, (0, 2), [1, 1], method=method, rtol=1e-6, atol=1e-8)
        assert sol.status == -1
        assert sol.t_end == pytest.approx(1, abs=1e-6)
        assert re.search(r"F\[1\] no longer determines y\[1\]'?: ∂F\[1\]/∂y\[1\] = ", sol.message), sol.message
    with pytest.raises(iv.SolveError, match="no longer determines"):
        iv.solve_dae(equations, (0, 2), [1, 1], method="dop853", on_failure="raise")


# ----------------------------------------------------------------------------------------------------------------------
# Starts


def test_a_start_satisfies_all_constraints_and_moves_what_is_not_fixed():
    dae = iv.Dae(pendulum, 0, [0.6, -0.7, 0], [0.3, 1, 0], names=["x", "z", "tension"], order=2)
    for fixed in ((), ("x", "x'"), ("x'", "z'"), ("z",), (1,)):
        start = dae.consistent(fixed)
        (x, z, tension), (u, v, _) = start.y, start.yp
        assert x**2 + z**2 == pytest.approx(1, abs=1e-14)
        assert x * u + z * v == pytest.approx(0, abs=1e-14)
        assert tension == pytest.approx(u**2 + v**2 - GRAVITY * z, abs=1e-12)
        given = dict(zip(["x", "z", "x'", "z'"], [0.6, -0.7, 0.3, 1.0], strict=True))
        now = dict(zip(given, [x, z, u, v], strict=True))
        for name, value in given.items():
            assert now[name] == pytest.approx(value + start.moved.get(name, 0), abs=1e-9)
            if name in fixed or (name == "z" and 1 in fixed):
                assert now[name] == value


def test_the_nearest_start_is_that_of_least_change():
    """Of one constraint: on the circle, the nearest point in the weights of the values is found by Gauss and Newton."""
    start = iv.Dae(pendulum, 0, [0.6, -0.8, 0], [0.8, 0.6, 0], order=2).consistent()
    np.testing.assert_array_equal(start.y[:2], [0.6, -0.8])  # consistent ones stay
    np.testing.assert_array_equal(start.yp[:2], [0.8, 0.6])
    assert {*start.moved} <= {"y[2]", "y[2]'"}


def test_initial_values_that_are_moved_are_reported():
    with pytest.warns(UserWarning, match=r"moved onto the constraints: y\[0\] from 0.9 to"):
        iv.solve_dae(pendulum, (0, 0.1), [0.9, 0, 0], order=2)


def test_decic_takes_masks():
    def equations(t, y, yp):
        return [yp[0] + y[0] - y[1], y[0] ** 2 - y[1]]

    y0, yp0 = iv.decic(equations, 0, [2, 0], [1, 0], [0, 0], None)
    np.testing.assert_allclose([y0, yp0], [[2, 4], [2, 8]], rtol=1e-13)
    with pytest.raises(ValueError, match="2 zeros and ones"):
        iv.decic(equations, 0, [2, 0], [1], [0, 0], None)


# ----------------------------------------------------------------------------------------------------------------------
# Solutions


def test_solutions_agree_with_references():
    """The problems that have one, with a method that suits them, at its tolerance; all derivatives satisfy F."""
    cases = {
        "pendulum": ("dop853", 1e-8, 1e-7),
        "two pendula": ("radau", 1e-8, 1e-8),
        "squeezer": ("dop853", 1e-8, 1e-8),
        "car axis": ("radau", 1e-6, 1e-7),
        "transistors": ("radau", 1e-8, 1e-8),
        "akzo": ("radau", 1e-6, 1e-6),
        "robertson": ("radau", 1e-6, 1e-6),
        "weissinger": ("dop853", 1e-8, 1e-9),
    }
    for name, (method, rtol, error) in cases.items():
        problem = PROBLEMS[name]
        sol = problem.solve(method, rtol, 1e-14 if name == "robertson" else None)
        assert sol.success, name
        assert problem.error(sol) <= error, name
        if problem.order == 1:
            left = [problem.F(t, y, yp) for t, y, yp in zip(sol.t, sol.y.T, sol.yp.T, strict=True)]
            assert np.abs(left).max() < 1e-6 * max(1, np.abs(sol.yp).max()), name


def test_prescribed_motion_has_no_error_whatever_the_tolerance():
    for name, exact in (("crane", crane_solution), ("reactor", reactor_solution), ("robot arm", None)):
        problem = PROBLEMS[name]
        sol = problem.solve("dop853", 1e-4)
        assert problem.error(sol) <= 1e-13
        if exact is not None:
            expected = np.array([exact(t) for t in sol.t]).T
            assert (np.abs(sol.y - expected) / np.maximum(np.abs(expected), 1e-2)).max() < 1e-13
    times = np.linspace(0, 3, 7)  # no state at all
    sol = PROBLEMS["Gear and Petzold"].solve("dop853", 1e-4, t_eval=times)
    np.testing.assert_allclose(sol.y, [np.exp(-times) - 0.7 * times * np.cos(times), np.cos(times)], atol=1e-14)
    np.testing.assert_allclose(sol.yp[1], -np.sin(times), atol=1e-14)


@pytest.mark.slow
def test_all_constraints_are_satisfied_to_roundoff_by_every_method_at_every_tolerance():
    """At the steps and between them, in units of a bound of roundoff; index 3 to 9."""
    cases = [PROBLEMS["pendulum"], PROBLEMS["two pendula"], PROBLEMS["squeezer"], pendula(4)]
    for k, (method, rtol) in enumerate(
        (method, rtol) for method in ("dop853", "ode113", "ode15s", "radau", "taylor") for rtol in (1e-3, 1e-9)
    ):
        problem = cases[k % len(cases)]
        times = np.linspace(*problem.t_span, 5)
        for options in ({}, {"t_eval": times}):
            sol = problem.solve(method, rtol, **options)
            assert sol.success
            assert off_constraints(sol) <= 10, (method, rtol)


def test_constraints_that_switch_with_t():
    """Unknowns that t alone determines follow, from tables too, also from one that begins with the run. Any other
    constraint that jumps ends the run there, and the message names it."""

    def follow(t, y, yp):
        x, v, force = y
        return [yp[0] - v, yp[1] - force, x - np.minimum(t, 1.0)]

    times = np.linspace(0, 2, 21)
    path = np.sin(times)

    def track(t, y, yp, table):
        return [yp[0] + y[0] - y[1], y[0] - table(t)]

    for method in ("dop853", "radau"):
        sol = iv.solve_dae(follow, (0, 2), [0, 1, 0], method=method, t_eval=[0.9, 1.1])
        np.testing.assert_allclose(sol.y, [[0.9, 1], [1, 0], [0, 0]], atol=1e-14)
        for table in (iv.Input(times, path, "linear"), lambda t: np.interp(t, times, path)):
            sol = iv.solve_dae(track, (0, 2), [0, 0], args=(table,), method=method, t_eval=[0.05, 1.05])
            slopes = np.diff(path)[[0, 10]] / 0.1
            values = np.interp([0.05, 1.05], times, path)
            np.testing.assert_allclose(sol.y, [values, values + slopes], atol=1e-12)
    with pytest.raises(iv.InvariantError, match=r"F\[2\] = 0 jumps by 2 right after the start, .* such as t >= 0"):
        iv.solve_dae(
            lambda t, y, yp: [yp[0] - y[1], yp[2] + y[2] - y[1], y[0] - np.where(t > 0, 1.0, -1.0)], (0, 1), [1, 0, 1]
        )
    sol = iv.solve_dae(
        lambda t, y, yp: [yp[0] - y[1], yp[1] - y[2], y[0] - (0.0 if t < 1 else 0.5), yp[3] - y[0]],
        (0, 2),
        [0, 0, 0, 0],
        on_failure="return",
    )
    assert sol.status < 0
    assert sol.t_end == pytest.approx(1, abs=1e-12)
    assert re.search(r"F\[2\] = 0 jumps there by 0\.5, which takes an impulse", sol.message)


def test_tables_of_inputs_are_traced():
    """An Input in F, of each kind and of several columns, gives the solution of solve_ivp with it."""
    times = np.linspace(0, 2, 9)
    for kind in ("previous", "linear", "cubic"):
        for values in (np.cos(times), np.stack([np.cos(times), times], axis=1)):
            u = iv.Input(times, values, kind)
            given = {"rtol": 1e-9, "atol": 1e-11, "method": "dop853"}
            expected = iv.solve_ivp(
                lambda t, y, u: [np.sum(u(t)) - y[0]], (0, 2), [0], args=(u,), breakpoints=times, **given
            )
            sol = iv.solve_dae(
                lambda t, y, yp, u: [yp[0] + y[0] - y[1], y[1] - np.sum(u(t))], (0, 2), [0, 0], args=(u,), **given
            )
            assert sol.y_end[0] == pytest.approx(expected.y_end[0], rel=1e-7)


def test_roundoff_of_cancellation_is_no_violation():
    """The check accepts a voltage that is a difference of nearly equal ones, at times far beyond the time constant."""
    slow = iv.solve_dae(
        lambda t, y, yp: [
            (np.sin(t / 1e12) - y[0]) / 1e3 - 1e-6 * (yp[0] - yp[1]),
            1e-6 * (yp[0] - yp[1]) - y[1] / 1e3,
        ],
        (0, 1e12),
        [0, 0],
        rtol=1e-6,
        atol=1e-9,
    )
    assert slow.success
    np.testing.assert_allclose(slow.y_end, [np.sin(1), 0], atol=1e-8)


def test_a_first_order_form_is_solved_as_the_second_order_form():
    """u = x' renames, so that the states, the steps and the digits are the same."""
    for method in ("dop853", "radau", "ode15s"):
        one, two = (PROBLEMS[name].solve(method, 1e-6) for name in ("pendulum", "pendulum, first order"))
        assert one.nfev == two.nfev
        np.testing.assert_array_equal(one.y, two.y[[0, 1, 4]])
        np.testing.assert_array_equal(one.yp[:2], two.y[2:4])


def test_equations_that_are_not_linear_in_what_they_determine():
    """As algebraic equations for methods that take a singular mass matrix, and differentiated for the others."""
    problem = PROBLEMS["resistor"]
    reference = problem.solve("radau", 1e-11).y[:, -1]
    for method in ("dop853", "taylor", "radau", "ode15s", "auto"):
        sol = problem.solve(method, 1e-7)
        np.testing.assert_allclose(sol.y[:, -1], reference, atol=1e-5)
        assert sol.reduced.y.shape[0] == 2
    short = iv.solve_dae(
        PROBLEMS["ring modulator"].F, (0, 5e-5), np.zeros(15), method="radau", rtol=1e-4, atol=1e-6, keep="end"
    )
    assert short.success


def test_large_systems_are_sparse():
    """A chain agrees with MechanicalSystem; index 9, whose Jacobian is formed by products, with dop853."""
    links = 30
    problem = chain(links, end=0.1)
    sol = problem.solve("dop853", 1e-6)

    def force(t, q, v):
        return np.tile([0, -GRAVITY], links)

    def lengths(t, q):
        d = np.concatenate([q[:2], q[2:] - q[:-2]])
        return (d[::2] ** 2 + d[1::2] ** 2 - 1 / links**2) / 2

    q0 = np.asarray(problem.y0)[: 2 * links]
    system = iv.MechanicalSystem(np.ones(2 * links), force, lengths).problem((0, 0.1), q0, 0 * q0)
    expected = system.solve("dop853", rtol=1e-6, atol=1e-8)
    assert sol.nfev == expected.nfev
    np.testing.assert_allclose(sol.y[: 2 * links, -1], expected.y[: 2 * links, -1], atol=1e-12)

    a, b = (pendula(4).solve(method, rtol).y[:, -1] for method, rtol in (("dop853", 1e-6), ("radau", 1e-8)))
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


# ----------------------------------------------------------------------------------------------------------------------
# Neighbours


def swing(t, y, yp, ypp, g, length):
    return [ypp[0] + y[0] * y[2], ypp[1] + y[1] * y[2] + g, y[0] ** 2 + y[1] ** 2 - length**2]


NAMED = {"order": 2, "names": ["x", "z", "tension"], "args": (GRAVITY, 1.0), "rtol": 1e-9, "atol": 1e-11}


def swung(end=2.0, **options):
    return iv.solve_dae(swing, (0, end), [1, 0, 0], **{**NAMED, "method": "dop853", **options})


def test_events_are_functions_of_the_unknowns():
    def at_bottom(t, y, g, length):
        return y[0]

    sol = swung(events=at_bottom)
    assert sol.y_events[0].shape == (len(sol.t_events[0]), 3)
    np.testing.assert_allclose(sol.y_events[0], [[0, -1, 3 * GRAVITY]] * len(sol.t_events[0]), atol=1e-7)
    ended = swung(events=iv.Event(at_bottom, terminal=True))
    assert ended.status == 1
    assert ended.t_end == sol.t_events[0][0]
    gone_on = ended.extend(2.0)
    assert gone_on.t_end == pytest.approx(sol.t_events[0][1], abs=1e-8)


def test_actions_change_unknowns_and_derivatives():
    """An elastic wall at x = 0 reflects the velocity; the motion is that from the other side, mirrored."""

    def wall(t, y, g, length):
        return y[0]

    t_hit = swung(events=wall).t_events[0][0]
    velocity = {}

    def bounce(t, y, g, length):
        velocity["before"] = -np.sqrt(2 * g)
        return y, [np.sqrt(2 * g), 0, 0]

    sol = swung(2 * t_hit - 1e-3, events=iv.Event(wall, direction=-1, action=bounce))
    plain = swung(2 * t_hit - 1e-3)
    np.testing.assert_allclose(sol.y[:, -1], plain.y[:, -1] * [-1, 1, 1], atol=1e-6)
    unchanged = swung(events=iv.Event(wall, direction=-1, action=lambda t, y, g, length: y))
    np.testing.assert_allclose(unchanged.y[:, -1], swung().y[:, -1], atol=1e-6)
    with pytest.raises(ValueError, match=r"must return y of shape \(3,\), or a pair"):
        swung(events=iv.Event(wall, direction=-1, action=lambda t, y, g, length: [1.0]))
    stopped = swung(breakpoints=[(0.5, lambda t, y, g, length: (y, [0, 0, 0]))])
    after = np.flatnonzero(stopped.t == 0.5)[-1]
    np.testing.assert_allclose(stopped.yp[:2, after], 0, atol=1e-12)


def test_output_dense_output_and_direction():
    times = np.linspace(0, 2, 9)
    sol, dense = swung(t_eval=times), swung(dense_output=True)
    np.testing.assert_allclose(dense.sol(times), sol.y, atol=1e-7)
    np.testing.assert_allclose(dense.sol.yp(times), sol.yp, atol=1e-6)
    assert dense.sol(0.5).shape == (3,)
    np.testing.assert_allclose(np.hypot(*dense.sol(times)[:2]), 1, atol=1e-14)
    back = iv.solve_dae(swing, (2, 0), sol.y[:, -1], sol.yp[:, -1], method="dop853", **NAMED)
    np.testing.assert_allclose(back.y[:, -1], [1, 0, 0], atol=1e-6)


def test_runs_are_extended_saved_loaded_and_pickled(tmp_path):
    half = swung(1.0, method="ode113")
    assert len(half.extend(2.0).t) > len(half.t)
    np.testing.assert_allclose(half.extend(2.0).y[:, -1], swung().y[:, -1], atol=1e-6)
    half.save(tmp_path / "half.npz")
    loaded = iv.load(tmp_path / "half.npz")
    for name in ("t", "y", "yp", "residual"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(half, name))
    assert repr(loaded.drift()) == repr(half.drift())
    dense = swung(dense_output=True)
    copy = pickle.loads(pickle.dumps(dense))
    np.testing.assert_array_equal(copy.sol(0.3), dense.sol(0.3))
    with pytest.warns(UserWarning, match="leaves out sol"):
        dense.save(tmp_path / "dense.npz")


def test_the_problem_of_a_dae_is_one_like_any_other(tmp_path):
    """In ensembles, prepared solvers and checkpoints; `solution` expresses what it returns in the unknowns."""
    dae = iv.Dae(swing, 0, [1, 0, 0], args=(GRAVITY, 1.0), order=2, names=["x", "z", "tension"])
    problem = dae.problem((0, 1))
    assert problem.labels == ["x", "z", "x'", "z'"]
    options = {"method": "dop853", "rtol": 1e-9, "atol": 1e-11}
    alone = problem.replace(args=(9.0, 1.0)).solve(**options)
    many = problem.solve_ensemble(args=[(GRAVITY, 1.0), (9.0, 1.0)], workers=1, **options)
    np.testing.assert_array_equal(many.y[1, :, -1], alone.y[:, -1])
    np.testing.assert_array_equal(problem.prepare(**options)(args=(9.0, 1.0)).y, alone.y)
    sol = dae.solution(alone)
    np.testing.assert_allclose(sol.y[2], sol.yp[0] ** 2 + sol.yp[1] ** 2 - 9.0 * sol.y[1], atol=1e-12)
    path = tmp_path / "run.npz"
    whole = dae.solve((0, 1), checkpoint=path, **options)
    np.testing.assert_array_equal(dae.solution(iv.load(path, problem)).y, whole.y)
    with pytest.raises(ValueError, match="not one of a problem of this Dae"):
        dae.solution(iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]))


def test_bounds_are_those_of_unknowns_that_are_not_formulas():
    """Unknowns renamed with a sign have bounds too; a bound of a formula is an error that names the unknown."""

    def decay(t, y, yp):
        x, minus, twice = y
        return [yp[0] + 50 * x, minus + x, twice - 2 * x - 1]

    names, no = ["x", "minus", "twice"], np.inf
    given = {"names": names, "rtol": 0.1, "atol": 0.01, "method": "ode15s"}
    assert iv.solve_dae(decay, (0, 10), [1, -1, 3], **given).y[0].min() < 0
    for limits in ({"nonnegative": "x"}, {"bounds": ([-no, -1, -no], [no, 0, no])}):
        sol = iv.solve_dae(decay, (0, 10), [1, -1, 3], **limits, **given)
        assert sol.y[0].min() >= 0 >= sol.y[1].max()
        dae = iv.Dae(decay, 0, [1, -1, 3], names=names)
        np.testing.assert_array_equal(
            dae.problem((0, 10), **limits).solve("ode15s", rtol=0.1, atol=0.01).y[0], sol.y[1]
        )
    with pytest.raises(ValueError, match=r"twice cannot have bounds: .* it as a formula .* possible for x, minus"):
        iv.solve_dae(decay, (0, 10), [1, -1, 3], nonnegative=True, **given)
    with pytest.raises(TypeError, match="nonnegative needs its expressions"):
        iv.solve_dae(opaque(decay), (0, 10), [1, -1, 3], nonnegative=True, **given)
    nonlinear = iv.solve_dae(  # an algebraic variable of methods with a singular mass matrix
        lambda t, y, yp: [yp[0] + y[1], y[1] ** 3 + y[1] - y[0]], (0, 9), [1, 0.7], method="radau", nonnegative=[1]
    )
    assert nonlinear.y[1].min() >= 0


def test_sensitivities_are_those_of_the_unknowns():
    sol = swung(sensitivities=["g"])
    assert sol.sensitivity_names == ["g"]
    step = 1e-5
    more, less = (swung(args=(GRAVITY + d, 1.0), rtol=1e-12, atol=1e-14).y[:, -1] for d in (step, -step))
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], (more - less) / (2 * step), rtol=1e-6)


def test_times_of_events_have_derivatives():
    """∂τ/∂g of each pass at x = 0.3 is that of differences, and so are those of the unknowns before the events."""

    def pass_(t, y, g, length):
        return y[0] - 0.3

    sol = swung(sensitivities=["g"], events=pass_, rtol=1e-10, atol=1e-12)
    step = 1e-4
    more, less = (
        swung(args=(GRAVITY + d, 1.0), events=pass_, rtol=1e-12, atol=1e-14).t_events[0] for d in (step, -step)
    )
    assert len(sol.t_events[0]) >= 2
    np.testing.assert_allclose(sol.sensitivities_t_events[0][:, 0], (more - less) / (2 * step), rtol=1e-6)
    # along the solution y(τ): dx/dg + x' dτ/dg = 0
    S, slopes = sol.sensitivities_events[0][:, 0, 0], sol.sensitivities_t_events[0][:, 0]
    speeds = np.sqrt(np.maximum(2 * GRAVITY * -sol.y_events[0][:, 1], 0)) * np.abs(sol.y_events[0][:, 1])
    np.testing.assert_allclose(np.abs(S), np.abs(speeds * slopes), rtol=1e-6)


def test_gradients_are_those_of_functions_of_the_unknowns():
    """One backward run gives what forward sensitivities give: at the end, and at several times, tensions included."""
    sol = swung(sensitivities=True, rtol=1e-10, atol=1e-12, dense_output=True, t_eval=[0.3, 0.8, 1.1])
    weights = np.arange(9.0).reshape(3, 3) - 3
    np.testing.assert_allclose(sol.gradient(weights), np.einsum("im,ikm->k", weights, sol.sensitivities), rtol=1e-6)
    np.testing.assert_allclose(
        sol.gradient(weights[0], [0.5, 0.0], t=[1.1]), weights[0] @ sol.sensitivities[:, :, 2] + [0.5, 0], rtol=1e-6
    )
    np.testing.assert_allclose(
        sol.gradient([1.0, 2.0, 3.0], wrt="g"), [[1, 2, 3] @ sol._sensitivities.end[:, 0]], rtol=1e-6
    )
    with pytest.raises(ValueError, match="takes no integrand"):
        sol.gradient(integrand=lambda t, y, g, length: y[0])


def test_parameters_of_a_dae_are_fitted():
    """`fit` of the problem of a Dae, with data of a component and times of an event."""
    t = np.linspace(0.2, 1.4, 7)
    dae = iv.Dae(swing, 0, [1, 0, 0], args=(9.0, 1.0), order=2, names=["x", "z", "tension"])
    event = iv.Event(lambda t, y, g, length: y[1] + 0.5, name="half")
    truth = swung(t_eval=t, events=lambda t, y, g, length: y[1] + 0.5, rtol=1e-10, atol=1e-12)
    problem = dae.problem((0, 1.5)).replace(events=event)
    fit = iv.fit(problem, t, {"x": truth.y[0]}, {"g": (5, 15)}, sigma=0.01, method="dop853")
    assert fit.parameters["g"] == pytest.approx(GRAVITY, rel=1e-6)
    times = iv.Experiment(problem, event_times={"half": truth.t_events[0][:1]}, event_sigma=0.01)
    fit = iv.fit([times], {"g": (5, 15)}, method="dop853")
    assert fit.parameters["g"] == pytest.approx(GRAVITY, rel=1e-6)


def test_arguments_that_decide_loops_are_constants():
    """A count is a constant of the expressions, and no parameter of the problem; numbers stay parameters."""

    def equations(t, y, yp, count, rate):
        total = sum(y[0] for _ in range(count))
        return [yp[0] + rate * total, y[1] - total]

    dae = iv.Dae(equations, 0, [1.0, 0], args=(3, 0.5))
    problem = dae.problem((0, 1))
    assert problem.args == (0.5,)
    sol = problem.replace(args=(0.25,)).solve("dop853", rtol=1e-9, atol=1e-11)
    assert dae.solution(sol).y[1, -1] == pytest.approx(3 * np.exp(-0.75), rel=1e-8)


def test_tolerances_may_be_given_for_each_unknown():
    sol = swung(atol=[1e-9, 1e-11, 1e-3])
    np.testing.assert_allclose(sol.y[:, -1], swung().y[:, -1], atol=1e-6)
    with pytest.raises(ValueError, match="one value per unknown, 3"):
        swung(atol=[1e-9, 1e-11])


def test_a_traced_function_is_taken_as_it_is():
    compiled = iv.solve_dae(iv.compile(swing), (0, 2), [1, 0, 0], method="dop853", **NAMED)
    np.testing.assert_array_equal(compiled.y, swung().y)


def test_ode15i_solves_matlabs_example():
    F = PROBLEMS["weissinger"].F
    y0, yp0 = iv.decic(F, 1, [np.sqrt(1.5)], [1], [0], [0])
    sol = iv.ode15i(F, (1, 10), y0, yp0, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(sol.y[0], np.sqrt(sol.t**2 + 0.5), rtol=1e-4)
    assert {*sol.steps.method} == {"ode15s"}


def test_stiff_amplifier_with_the_default_method():
    sol = iv.solve_dae(transistors, (0, 0.2), PROBLEMS["transistors"].y0, rtol=1e-5, atol=1e-7)
    assert PROBLEMS["transistors"].error(sol) < 1e-3


# ----------------------------------------------------------------------------------------------------------------------
# Functions that cannot be traced


def opaque(equations):
    """The same residuals, computed from bytes, which symbolic values do not become."""

    def unpacked(t, y, yp, *args):
        given = struct.pack(f"{2 * len(y)}d", *y, *yp)
        unpacked.calls += 1
        values = struct.unpack(f"{2 * len(y)}d", given)
        return equations(t, values[: len(y)], values[len(y) :], *args)

    unpacked.calls = 0
    return unpacked


def test_functions_that_cannot_be_traced_are_solved_as_they_stand_up_to_index_1():
    """Index 0 and 1, with y' behind a singular matrix, nonlinear in y'; with fewer calls than IDA at equal error."""
    cases = {
        "robertson": (1e-6, 1e-12, 3e-5, 1741),
        "akzo": (1e-6, 1e-8, 3e-6, 471),
        "transistors": (1e-4, 1e-6, 1e-3, 38890),
    }
    for name, (rtol, atol, error, calls_of_ida) in cases.items():
        problem = PROBLEMS[name]
        start = problem.analysed().consistent()
        F = opaque(problem.F)
        sol = iv.solve_dae(F, problem.t_span, start.y, start.yp, rtol=rtol, atol=atol, keep="end")
        assert problem.error(sol) < error, name
        assert sol.nfev <= F.calls <= calls_of_ida, name
        exact = iv.solve_dae(F, problem.t_span, start.y, start.yp, method="radau", rtol=rtol, atol=atol, keep="end")
        assert problem.error(exact) < error / 10, name
    problem = PROBLEMS["weissinger"]
    sol = iv.solve_dae(opaque(problem.F), (1, 10), problem.y0, [0.8], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(sol.y[0], np.sqrt(sol.t**2 + 0.5), rtol=1e-6)
    np.testing.assert_allclose(sol.yp[0], sol.t / sol.y[0], rtol=1e-5)


def test_what_needs_expressions_says_so():
    F = opaque(PROBLEMS["akzo"].F)
    y0 = PROBLEMS["akzo"].y0
    with pytest.raises(
        TypeError, match=r"F cannot be traced: .* cannot be solved either: its index is above 1: .*y\[4\]"
    ):
        iv.solve_dae(opaque(PROBLEMS["pendulum, first order"].F), (0, 1), [1, 0, 0, 0, 0])
    with pytest.raises(TypeError, match="fixed needs its expressions"):
        iv.solve_dae(F, (0, 1), y0, fixed=[0])
    with pytest.raises(TypeError, match="sensitivities needs its expressions"):
        iv.solve_dae(F, (0, 1), y0, sensitivities=True)
    with pytest.raises(ValueError, match="not by dop853"):
        iv.solve_dae(F, (0, 1), y0, method="dop853")
    with pytest.raises(TypeError, match="F cannot be traced"):
        iv.Dae(F, 0, y0)
    with pytest.raises(TypeError, match="combinations of derivatives in F change"):
        iv.solve_dae(opaque(lambda t, y, yp: [y[0] * yp[0] - 1, yp[1]]), (0, 1), [0, 0])


def test_residual_forms_have_neighbours_too():
    """Events, actions, extension, dense output and tolerances for each unknown."""

    def equations(t, y, yp, rate):
        return [yp[0] + rate * y[0], y[1] - y[0] ** 2]

    F = opaque(equations)
    given = {"args": (2.0,), "rtol": 1e-8, "atol": [1e-10, 1e-10]}
    sol = iv.solve_dae(F, (0, 1), [1, 0], events=lambda t, y, rate: y[1] - 0.25, dense_output=True, **given)
    assert sol.t_events[0][0] == pytest.approx(np.log(2) / 2, abs=1e-7)
    assert sol.sol(0.5)[1] == pytest.approx(np.exp(-2), rel=1e-6)
    assert sol.extend(2.0).y[1, -1] == pytest.approx(np.exp(-8), rel=1e-5)
    double = iv.Event(lambda t, y, rate: y[0] - 0.5, action=lambda t, y, rate: [2 * y[0], 0])
    doubled = iv.solve_dae(F, (0, 0.5), [1, 0], events=double, **given)
    assert len(doubled.t_events[0]) == 1
    np.testing.assert_allclose(doubled.y_end, [2 * np.exp(-1), 4 * np.exp(-2)], rtol=1e-6)
    for method in ("dop853", "radau"):  # traced, with an algebraic equation that is not linear
        nonlinear = iv.solve_dae(
            lambda t, y, yp: [yp[0] + 2 * y[0], y[1] ** 3 + y[1] - y[0]],
            (0, 0.5),
            [1, 0.7],
            method=method,
            events=iv.Event(lambda t, y: y[0] - 0.5, action=lambda t, y: [1.0, 0.6823278038280193]),
            rtol=1e-8,
            atol=1e-10,
        )
        assert nonlinear.y[0, -1] == pytest.approx(2 * np.exp(-1), rel=1e-6)


def test_residual_forms_take_jacobians_and_their_structure():
    """A rod whose ends are held has one solution by differences, by groups of columns and with exact derivatives, dense
    or sparse; with bands a Jacobian takes 6 calls instead of 2 n."""
    import scipy.sparse as sp

    def made(n):
        A = sp.diags_array([np.ones(n - 1), -2 * np.ones(n), np.ones(n - 1)], offsets=[-1, 0, 1]).tolil()
        A[0] = A[n - 1] = 0
        A[0, 0] = A[n - 1, n - 1] = -1
        D = sp.diags_array(np.r_[0.0, np.ones(n - 2), 0.0])
        F = opaque(lambda t, y, yp, k: D @ yp - k * (A @ y) - np.r_[1.0, np.zeros(n - 2), 0.5])
        return F, sp.csc_array(A), sp.csc_array(D)

    def solved(n, **given):
        F, _, _ = made(n)
        sol = iv.solve_dae(F, (0, 1), np.r_[0.5, np.zeros(n - 1)], args=(2.0,), rtol=1e-6, atol=1e-8, **given)
        return sol.y_end, sol.nfev, sol.stats.njev

    n = 12
    _, A, D = made(n)
    plain, _, _ = solved(n)
    pattern = (A != 0, D != 0)
    for given in (
        {"lband": 1, "uband": 1},
        {"jac_sparsity": pattern},
        {"jac": lambda t, y, yp, k: (-k * A.toarray(), D.toarray())},
        {"jac": lambda t, y, yp, k: (-k * A, D)},
        {"jac": lambda t, y, yp, k: (-k * A, D), "method": "radau"},
    ):
        y, calls, _ = solved(n, **given)
        np.testing.assert_allclose(y, plain, rtol=2e-4, atol=1e-6)
        assert calls < solved(n, **{name: one for name, one in given.items() if name == "method"})[1]
    (_, many, count), (_, calls, _) = solved(48), solved(48, lband=1, uband=1)
    assert many - calls > 0.8 * count * (2 * 48 - 2 - 6)
    with pytest.raises(TypeError, match="jac is for an F that cannot be traced"):
        iv.solve_dae(lambda t, y, yp: [yp[0] + y[0]], (0, 1), [1.0], jac=lambda t, y, yp: ([[1]], [[1]]))
    with pytest.raises(ValueError, match="the pair"):
        solved(n, jac=lambda t, y, yp, k: A.toarray())
    with pytest.raises(ValueError, match="either jac, or"):
        solved(n, jac=lambda t, y, yp, k: (A, D), lband=1)
