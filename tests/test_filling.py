"""A function that fills its third argument is the function that returns these values, bit for bit, wherever f is
called."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import invariode as iv
from cases import families

Y0 = [1.0, 0.0, 0.0, 1.2]


def returning(t, y, m, k=0.0):
    r = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -m * y[0] / r - k * y[2], -m * y[1] / r - k * y[3]]


def filling(t, y, out, m, k=0.0):
    r = (y[0] ** 2 + y[1] ** 2) ** 1.5
    out[:2] = y[2:]
    out[2] = -m * y[0] / r - k * y[2]
    out[3] = -m * y[1] / r - k * y[3]


def angular_momentum(t, y, m, k=0.0):
    return y[0] * y[3] - y[1] * y[2]


def crossing(t, y, m, k=0.0):
    return y[1]


def same(a, b):
    assert (a.status, a.nfev) == (b.status, b.nfev)
    for name in ("t", "y", "y_events", "sensitivities"):
        left, right = getattr(a, name), getattr(b, name)
        assert (left is None) == (right is None)
        if left is not None:
            assert all(map(np.array_equal, left, right))


@families
def test_runs_are_the_same_with_whatever_else_a_problem_has(method):
    breaks = [1.0]
    for options in (
        {},
        {
            "invariants": angular_momentum,
            "events": iv.Event(crossing, action=lambda t, y, *p: -y),
            "breakpoints": breaks,
        },
        {"sensitivities": ["m", "y0[0]"], "args": (1.1,)},
        {"bounds": (-4, 4), "dense_output": True, "args": (1.0, 0.1)},
    ):
        options = {"args": (1.0,), **options}
        a = iv.solve_ivp(returning, (0, 3), Y0, method, **options)
        b = iv.solve_ivp(filling, (0, 3), Y0, method, inplace=True, **options)
        same(a, b)
        same(a.extend(4.0), b.extend(4.0))


def test_traced_and_compiled_functions_take_it_as_it_is_called():
    same(
        iv.solve_ivp(returning, (0, 3), Y0, "taylor", args=(1.0,)),
        iv.solve_ivp(filling, (0, 3), Y0, "taylor", args=(1.0,), inplace=True),
    )
    problem = iv.Problem(filling, (0, 3), Y0, args=(1.0,), inplace=True)
    for fun in (iv.compile(problem.fun), iv.compile(filling, inplace=True)):
        same(
            iv.solve_ivp(iv.compile(returning), (0, 3), Y0, args=(1.0,)),
            iv.solve_ivp(fun, (0, 3), Y0, args=(1.0,), inplace=True),
        )
    with pytest.raises(TypeError, match="compiled as a function that returns its values"):
        iv.solve_ivp(iv.compile(returning), (0, 3), Y0, args=(1.0,), inplace=True)
    assert problem.replace(args=(2.0,)).inplace
    assert np.array_equal(problem.slope.fun(0.0, np.array(Y0), 1.0), returning(0.0, Y0, 1.0))


def test_complex_states_second_order_ensembles_steppers_and_inputs():
    def rotated(t, y, out):
        out[0] = 1j * y[0]

    a = iv.solve_ivp(lambda t, y: [1j * y[0]], (0, 2), [1.0 + 0j])
    same(a, iv.solve_ivp(rotated, (0, 2), [1.0 + 0j], inplace=True))

    def attraction(t, q, out):
        np.divide(-q, np.linalg.norm(q) ** 3, out=out)

    fall = iv.SecondOrder(lambda t, q: -q / np.linalg.norm(q) ** 3)
    for method in ("rkn64", "ode45"):
        b = iv.solve_ivp(iv.SecondOrder(attraction), (0, 2), Y0, method, inplace=True)
        same(iv.solve_ivp(fall, (0, 2), Y0, method), b)

    rows = np.array([Y0, [1.1, 0.0, 0.0, 1.0]])
    many = [
        iv.solve_ensemble(fun, (0, 3), rows, args=(1.0,), inplace=inplace, workers=1)
        for fun, inplace in ((returning, False), (filling, True))
    ]
    assert np.array_equal(many[0].y_end, many[1].y_end)

    from invariode.scipy import ODE45

    steppers = [ODE45(returning_alone, 0.0, Y0, 1.0), ODE45(filling_alone, 0.0, Y0, 1.0, inplace=True)]
    for stepper in steppers:
        while stepper.status == "running":
            stepper.step()
    assert np.array_equal(steppers[0].y, steppers[1].y)

    def driven(t, y, out, u):
        out[:] = -y + u

    push = iv.Input([0, 1, 2], [0.0, 1.0, 0.0])
    same(
        iv.Problem(lambda t, y, u: -y + u, (0, 2), [1.0], inputs=push).solve(),
        iv.Problem(driven, (0, 2), [1.0], inputs=push, inplace=True).solve(),
    )


def returning_alone(t, y):
    return returning(t, y, 1.0)


def filling_alone(t, y, out):
    filling(t, y, out, 1.0)


def test_arrays_are_the_callees_to_keep():
    """The solver fills an array that somebody has kept no second time."""
    kept = []

    def keeping(t, y, out):
        out[0] = -y[0]
        kept.append((y, out))

    iv.solve_ivp(keeping, (0, 1), [1.0], inplace=True)
    assert len(kept) > 5
    assert all(out[0] == -y[0] for y, out in kept)


def test_what_is_wrong_is_said():
    with pytest.raises(TypeError, match="returned a list, and with inplace=True its values are those that it writes"):
        iv.solve_ivp(lambda t, y, out: [0.0], (0, 1), [1.0], inplace=True)

    def half(t, y, out):
        out[0] = 1.0

    sol = iv.solve_ivp(half, (0, 1), [1.0, 2.0], inplace=True)
    assert sol.status < 0
    assert "component 1 is NaN" in sol.message
    with pytest.raises(ValueError, match="vectorized and inplace exclude each other"):
        iv.solve_ivp(half, (0, 1), [1.0], inplace=True, vectorized=True)
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        iv.solve_ivp(lambda t, y, out, k: None, (0, 1), [1.0], inplace=True)
    assert pickle.loads(pickle.dumps(iv.Problem(filling, (0, 1), Y0, inplace=True).fun)).__wrapped__ is filling
