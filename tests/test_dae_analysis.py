"""Analysis and consistent starts of differential-algebraic equations of any index."""

from __future__ import annotations

import re

import numpy as np
import pytest

import invariode as iv
from dae_problems import (
    GRAVITY,
    PROBLEMS,
    pendula,
    pendulum,
)
from invariode._dae.linear_systems import orientations

pytestmark = pytest.mark.filterwarnings("ignore:initial values were moved")


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
            r"Too many equations: F\[1\], F\[2\] \(2\) contain only z \(1\).*x, y \(2\) only in F\[0\]",
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


def test_an_equation_that_stops_to_determine_its_unknown_is_named():
    """Where a branch that a state selects has none of it, unknowns become infinite, and F = 0 does not hold."""
    for method in ("auto", "dop853"):
        with pytest.raises((iv.InvariantError, iv.SolveError), match=r"F\[1\]"):
            iv.solve_dae(
                lambda t, y, yp: [yp[0] + 1, np.where(y[0] > 0.5, y[1] - y[0], y[0] - 0.2)],
                (0, 2),
                [1, 1],
                method=method,
                on_failure="raise",
            )


def test_what_solve_dae_does_not_take_is_named():
    """Options of other problems say what to do instead; F that returns something else says what it returned."""

    def decay(t, y, yp):
        return [yp[0] + y[0]]

    for given in ({"order": 2}, {"args": (1.0,)}):
        with pytest.raises(TypeError, match=r"F is called as F\(t, y, yp.*\).*, and decay takes \(t, y, yp\)"):
            iv.solve_dae(decay, (0, 1), [1], **given)
    with pytest.raises(ValueError, match=r"rkn86 is for y'' = f\(t, y\), and solve_dae reduces F to y' = f"):
        iv.solve_dae(decay, (0, 1), [1], method="rkn86")
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
    np.testing.assert_array_equal(dae.consistent("x").y, dae.consistent(["x"]).y)
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


def test_singular_points_that_a_run_passes_are_named():
    """The run that passes a point where the determinant of a block of J changes its sign warns, with every kind of
    method, and names the equations and unknowns. A state that an action moves to the other side, and an equation that
    switches, pass no such point."""
    cases = (
        (lambda t, y, yp: [yp[0] - y[1], (t - 1) * y[1] - y[0]], [1, -1], r"F\[1\] did not determine y\[0\]'"),
        (lambda t, y, yp: [yp[0] + y[0], (t - 1) * y[1] - 1], [1, -1], r"F\[1\] .* y\[1\] where ∂F\[1\]/∂y\[1\], now"),
        (
            lambda t, y, yp: [yp[0] + y[1] + y[0], y[1] + y[2] - 1, t * y[1] + y[2] - t],
            [1, 1, 0],
            r"F\[1\], F\[2\] did not determine y\[1\], y\[2\] where their matrix was singular, between t = ",
        ),
    )
    for (F, y0, message), method in zip(cases, ("dop853", "radau", "ode15s"), strict=True):
        with pytest.warns(UserWarning, match=message):
            iv.solve_dae(F, (0, 2), y0, method=method, nonnegative=False, keep="end")

    def branches(t, y, yp):
        return [yp[0] - 1, y[0] * y[1] - 1, np.where(y[0] < 2, 1.0, -1.0) * y[2] - 1]

    across = iv.Event(lambda t, y: y[0] + 0.5, action=lambda t, y: [1.0, 1.0, 1.0])
    sol = iv.solve_dae(branches, (0, 2), [-1, -1, 1], events=across)
    np.testing.assert_allclose(sol.y_end, [2.5, 0.4, -1], rtol=1e-3)


def test_the_sign_of_a_determinant_is_that_of_sparse_factors_too():
    rng = np.random.default_rng(3)
    for _ in range(4):
        A = np.where(rng.uniform(size=(130, 130)) < 0.1, rng.standard_normal((130, 130)), 0) + np.eye(130)
        rows, columns = A.nonzero()
        entries = np.column_stack([A[rows, columns], np.full(len(rows), np.nan)])
        signs = orientations(rows, columns, entries, len(A))
        assert signs[0] == np.linalg.slogdet(A)[0] != 0
        assert not signs[1] > 0
        assert not signs[1] < 0


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
    """One constraint: on the circle, the nearest point in the weights of the values is found by Gauss and Newton."""
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
