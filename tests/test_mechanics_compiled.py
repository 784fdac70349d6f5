"""Constrained mechanics of compiled functions: the motions of Python ones, and messages as good."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

import invariode as iv
from invariode._mechanics.system import MechanicalSystem
from mechanisms import circle, gravity, swing
from test_mechanics import BAD, INERTIA


def compiled_pendulum(**given):
    """Return a pendulum of length p[0], a body with an angle and a rod, so that M, Q and φ have several components."""
    pytest.importorskip("numba")
    functions = {
        "mass": iv.compile(lambda t, q, p: (1.0, 1.0)),
        "force": iv.compile(lambda t, q, v, p: (0.0, -1.0)),
        "constraints": iv.compile(lambda t, q, p: q[0] ** 2 + q[1] ** 2 - p[0] ** 2),
        "energy": iv.compile(lambda t, q, v, p: (v[0] ** 2 + v[1] ** 2) / 2 + q[1]),
        "args": (2.0,),
    } | given
    return MechanicalSystem(**functions)


def pythons_pendulum():
    return MechanicalSystem(
        lambda t, q, length: [1, 1],
        lambda t, q, v, length: [0, -1],
        lambda t, q, length: q[0] ** 2 + q[1] ** 2 - length**2,
        energy=lambda t, q, v, length: (v[0] ** 2 + v[1] ** 2) / 2 + q[1],
        args=(2.0,),
    )


OPTIONS = {"method": "ode45", "rtol": 1e-7, "atol": 1e-9}


@pytest.mark.parametrize("part", ["all", "constraints", "energy"])
def test_compiled_functions_and_mixed_ones_give_the_same_motion(part):
    expected = pythons_pendulum().problem((0, 3), [2, 0], [0, 0]).solve(**OPTIONS)
    in_python = {
        name: getattr(pythons_pendulum(), name)
        for name in ("mass", "force", "constraints", "energy")
        if part not in ("all", name)
    }
    sol = compiled_pendulum(**in_python).problem((0, 3), [2, 0], [0, 0]).solve(**OPTIONS)
    np.testing.assert_allclose(sol.y[:, -1], expected.y[:, -1], rtol=1e-9, atol=1e-10)


def test_with_compiled_functions_alone_no_python_is_called(monkeypatch):
    system = compiled_pendulum()
    problem = system.problem((0, 3), [2, 0], [0, 0])
    first = problem.solve(**OPTIONS)

    def called(*args):
        raise AssertionError("a compiled function was called from Python")

    for name in ("force", "constraints", "mass", "energy"):
        monkeypatch.setattr(getattr(system, name), "fun", called)
    np.testing.assert_array_equal(problem.solve(**OPTIONS).y, first.y)
    together = iv.solve_ensemble(
        problem.fun,
        (0, 3),
        np.tile(problem.y0, (4, 1)),
        args=np.full((4, 1), 2.0),
        invariants=problem.invariants,
        workers=2,
        **OPTIONS,
    )
    assert together.success.all()
    np.testing.assert_array_equal(together.y_end, np.tile(first.y[:, -1], (4, 1)))


def test_an_ensemble_changes_the_arguments_of_compiled_mechanics():
    problem = compiled_pendulum().problem((0, 3), [2, 0], [0, 0])
    lengths = np.array([[0.5], [1.0], [2.0]])
    starts = np.array([[length, 0, 0, 0] for length in lengths[:, 0]])
    found = iv.solve_ensemble(
        problem.fun, (0, 3), starts, args=lengths, invariants=problem.invariants, workers=2, **OPTIONS
    )
    assert found.success.all()
    np.testing.assert_allclose(np.hypot(found.y_end[:, 0], found.y_end[:, 1]), lengths[:, 0], rtol=1e-14)
    np.testing.assert_allclose(found.y_end[0, 1] / 0.5, problem_of_length(1.0, 3 / np.sqrt(0.5)), rtol=1e-5)


def problem_of_length(length, tf):
    """The height at tf of a pendulum of unit gravity, in units of its length."""
    problem = pythons_pendulum().problem((0, 3), [2, 0], [0, 0])
    return problem.replace(args=(length,), y0=[length, 0, 0, 0], t_span=(0, tf)).solve(**OPTIONS).y[1, -1] / length


def test_functions_with_math_have_exact_derivatives_too():
    pytest.importorskip("llvmlite")
    system = MechanicalSystem(
        [1, 1], gravity, iv.compile(lambda t, q: math.sqrt(q[0] ** 2 + q[1] ** 2) - math.cos(0.0))
    )
    sol = system.problem((0, 3), [1, 0], [0, 0]).solve(**OPTIONS)
    assert sol.stats.mechanics["derivatives"] == {"constraints": "traced"}
    expected = swing().problem((0, 3), [1, 0], [0, 0]).solve(**OPTIONS)
    np.testing.assert_allclose(sol.y[:, -1], expected.y[:, -1], atol=1e-8)


def test_compiled_constraints_without_a_complex_form_have_differences():
    pytest.importorskip("numba")
    rod = iv.compile(lambda t, q: math.hypot(q[0], q[1]) - 1, by="numba")
    sol = swing(rod).problem((0, 3), [1, 0], [0, 0]).solve(**OPTIONS)
    expected = swing().problem((0, 3), [1, 0], [0, 0]).solve(**OPTIONS)
    np.testing.assert_allclose(sol.y[:, -1], expected.y[:, -1], atol=1e-6)


def test_machine_code_tells_the_number_of_its_constraints_by_their_names():
    numba = pytest.importorskip("numba")
    pointer = numba.types.CPointer(numba.types.double)

    @numba.cfunc(numba.void(numba.types.double, pointer, pointer, pointer))
    def circle_code(t, q, out, p):
        out[0] = (q[0] ** 2 + q[1] ** 2 - 1) / 2

    with pytest.raises(ValueError, match="names="):
        swing(circle_code).problem((0, 3), [1, 0], [0, 0])
    problem = swing(iv.Invariants(circle_code, value=0, names=["rod"])).problem((0, 3), [1, 0], [0, 0])
    assert [one.names for one in problem.invariants] == [["rod"], ["rate of rod"]]
    expected = swing().problem((0, 3), [1, 0], [0, 0]).solve(**OPTIONS)
    np.testing.assert_allclose(problem.solve(**OPTIONS).y[:, -1], expected.y[:, -1], atol=1e-7)


def test_a_rotating_body_of_compiled_functions():
    pytest.importorskip("numba")

    def spin(t, q, v):
        w, x, y, z = q[0], q[1], q[2], q[3]
        a, b, c = v[0], v[1], v[2]
        return (
            (-x * a - y * b - z * c) / 2,
            (w * a + y * c - z * b) / 2,
            (w * b + z * a - x * c) / 2,
            (w * c + x * b - y * a) / 2,
        )

    def euler(t, q, v):
        return v[1] * v[2] * (2.0 - 3.0), v[2] * v[0] * (3.0 - 1.0), v[0] * v[1] * (1.0 - 2.0)

    def level(t, q):
        return 2 * (q[1] * q[3] - q[0] * q[2])

    def solved(euler, level, spin):
        system = MechanicalSystem(INERTIA, euler, level, kinematics=spin)
        return system.problem((0, 5), [1, 0, 0, 0], [1, 0, 0.5]).solve("dop853", rtol=1e-9, atol=1e-11)

    ours, expected = solved(*map(iv.compile, (euler, level, spin))), solved(euler, level, spin)
    np.testing.assert_allclose(ours.y[:, -1], expected.y[:, -1], atol=1e-9)


def test_multipliers_belong_to_the_arguments_of_the_solution():
    """At rest the rod carries the weight, m g, with Φ = 2 q: λ = -m / (2 L)."""
    system = MechanicalSystem(
        lambda t, q, m, length: [m, m],
        lambda t, q, v, m, length: [0, -m],
        lambda t, q, m, length: q[0] ** 2 + q[1] ** 2 - length**2,
        args=(1.0, 1.0),
    )
    first = system.problem((0, 1), [0, -1], [0, 0])
    heavy = first.replace(args=(3.0, 2.0), y0=[0, -2, 0, 0]).solve()
    np.testing.assert_allclose(system.multipliers(heavy)[0], -3 / 4, rtol=1e-12)
    alone = type("Points", (), {"t": heavy.t, "y": heavy.y})
    np.testing.assert_allclose(system.multipliers(alone, args=(3.0, 2.0)), system.multipliers(heavy))
    np.testing.assert_allclose(system.reactions(heavy)[1], 3, rtol=1e-12)


@pytest.mark.parametrize(
    ("constraints", "kind"),
    [(circle, "complex step"), (lambda t, q: abs(q[0] ** 2 + q[1] ** 2) - 1, "differences")],
)
def test_stats_tell_kinds_and_cost_of_derivatives(constraints, kind):
    calls = {"constraints": 0, "force": 0}

    def counted(t, q):
        calls["constraints"] += 1
        return constraints(t, q)

    def weight(t, q, v):
        calls["force"] += 1
        return gravity(t, q, v)

    problem = MechanicalSystem([1, 1], weight, counted).problem((0, 1), [1, 0], [0, 0])
    calls.update(constraints=0, force=0)
    sol = problem.solve("ode23")
    told = sol.stats.mechanics
    assert told["derivatives"] == {"constraints": kind}
    assert told["dense"] == told["force"] == calls["force"] >= sol.nfev
    assert 0 <= calls["constraints"] - told["constraints"] <= 5  # values at the start: of φ, and of φ' by differences
    assert told["sparse"] == told["mass"] == told["jacobian"] == 0
    assert sol.extend(2).stats.mechanics["force"] > told["force"]
    assert iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]).stats.mechanics is None


COMPILED_BAD = {
    "contradiction": {"constraints": lambda t, q: (q[0] ** 2 + q[1] ** 2 - 1, q[0] ** 2 + q[1] ** 2 - 4)},
    "no positions": {"constraints": lambda t, q: (q[0] - 1, 0 * t)},
    "square of v": {"velocity_constraints": lambda t, q, v: v[0] ** 2 - v[1]},
    "force of another size": {"force": lambda t, q, v: (0.0, 0.0, 0.0)},
    "constraint NaN": {"constraints": lambda t, q: np.nan * q[0]},
    "kinematics of another size": {"kinematics": lambda t, q, v: v[:1]},
    "jacobian of another size": {"jacobian": lambda t, q: (1.0, 2.0, 3.0), "constraints": circle},
}


@cache
def weight():
    return iv.compile(lambda t, q, v: (0.0, -1.0))


@pytest.mark.parametrize("name", COMPILED_BAD)
def test_bad_input_of_compiled_functions_is_refused_in_words(name):
    pytest.importorskip("numba")
    error, message, _ = BAD[name]
    if name in ("force of another size", "jacobian of another size"):
        error, message = TypeError, "returns 3 values, expected 2"  # as everywhere that `compile` is used
    given = {part: iv.compile(function) for part, function in COMPILED_BAD[name].items()}
    arguments = {"mass": [1, 1], "force": weight()} | given
    with pytest.raises(error, match=message):
        MechanicalSystem(**arguments).problem((0, 1), [1, 0], [0, 1])


@pytest.mark.parametrize(
    "constraints",
    [lambda t, q: abs(q[0] ** 2 + q[1] ** 2) - 1, lambda t, q: max(q[0] ** 2 + q[1] ** 2, 0.25) - 1],
    ids=["abs", "max"],
)
def test_compiled_constraints_with_corners_are_differentiated_rightly(constraints):
    pytest.importorskip("numba")
    sol = swing(iv.compile(constraints)).problem((0, 3), [1, 0], [0, 0]).solve(**OPTIONS)
    expected = swing().problem((0, 3), [1, 0], [0, 0]).solve(**OPTIONS)
    np.testing.assert_allclose(sol.y[:, -1], expected.y[:, -1], atol=1e-6)


def test_a_singular_position_on_the_way_of_compiled_functions():
    pytest.importorskip("numba")
    crank = iv.compile(lambda t, q: math.sin(q[0]) - math.sin(q[1]))
    system = MechanicalSystem([1, 1], iv.compile(lambda t, q, v: (0.0, 0.0)), crank)
    sol = system.problem((0, 3), [0, 0], [1, 1]).solve("ode45", rtol=1e-6, atol=1e-8)
    assert np.abs(np.sin(sol.y[0]) - np.sin(sol.y[1])).max() < 1e-12
    assert sol.success or (sol.status == -1 and "at t = 1.5" in sol.message)
