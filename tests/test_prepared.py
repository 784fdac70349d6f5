"""A prepared solver gives what a solve of the changed problem gives: the same bits, counts, errors and extensions."""

from __future__ import annotations

import dataclasses
import pickle
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, dealt

numba = pytest.importorskip("numba")

SPAN = (0.0, 3.0)


def orbit(t, y, mu):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return y[2], y[3], -mu * y[0] / r3, -mu * y[1] / r3


def momentum(t, y, mu):
    return y[0] * y[3] - y[1] * y[2]


def apsis(t, y, mu):
    return y[0] * y[2] + y[1] * y[3]


# Native functions get their parameters as an array p.
orbit_code = iv.compile(lambda t, y, p: orbit_jit(t, y, p[0]))
momentum_code = iv.compile(lambda t, y, p: y[0] * y[3] - y[1] * y[2])
apsis_code = iv.compile(lambda t, y, p: y[0] * y[2] + y[1] * y[3])
orbit_jit = numba.njit(orbit, error_model="numpy")

FORMS = {"native": (orbit_code, momentum_code, apsis_code), "python": (orbit, momentum, apsis)}
START = np.array([0.8, 0.0, 0.0, 1.2])
CHANGES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "y0": {"y0": [0.9, 0.0, 0.0, 1.1]},
    "args": {"args": (1.1,)},
    "t_span": {"t_span": (0.5, 2.0)},
    "backwards": {"t_span": (0.0, -2.0)},
    "all": {"y0": np.array([1, 0, 0, 1]), "args": [2], "t_span": [0, 1]},
}
OPTIONS: dict[str, dict[str, Any]] = {
    "all": {},
    "end": {"keep": "end"},
    "dense": {"dense_output": True, "refine": 3},
    "capped": {"max_step": 0.05},
    "tenth": {"max_step": "tenth"},
}


def described(form: str, kept: bool = False, events: bool = False) -> iv.Problem:
    fun, g, event = FORMS[form]
    return iv.Problem(
        fun,
        SPAN,
        START,
        args=(1.0,),
        invariants=iv.Invariants(g, names="momentum") if kept else None,
        events=iv.Event(event) if events else None,
        labels=["x", "y", "u", "v"],
    )


def same(a: iv.Solution, b: iv.Solution) -> None:
    """All that is in them, bit for bit; functions of t at points between the steps."""
    assert list(a) == list(b)
    for name in a:
        if name == "steps":
            assert (a.steps is None) == (b.steps is None)
            if a.steps is not None:
                np.testing.assert_array_equal(a.steps._rows, b.steps._rows)
        elif name == "stats":
            assert dict(a.stats) == dict(b.stats)
        elif name == "sol":
            if a.sol is not None:
                times = np.linspace(a.t[0], a.t[-1], 37)
                np.testing.assert_array_equal(a.sol(times), b.sol(times))
        else:
            np.testing.assert_equal(a[name], b[name], err_msg=name)
    np.testing.assert_array_equal(a.residual, b.residual)
    assert repr(a.drift()) == repr(b.drift())


@dealt(form=FORMS, kept=[False, True], change=CHANGES, method=METHODS)
def test_a_call_is_a_solve(form: str, kept: bool, change: str, method: str) -> None:
    problem = described(form, kept, events=True)
    solver = problem.prepare(method)
    for _ in range(2):  # the second finds the solver as another call has left it
        same(solver(**CHANGES[change]), problem.replace(**CHANGES[change]).solve(method))
    same(solver(), problem.solve(method))


@dealt(8, form=FORMS, kept=[False, True], change=CHANGES, scale=[None, (1.0, 0.8)])
def test_sensitivities_too(form: str, kept: bool, change: str, scale: Any) -> None:
    """The scale is one that is given, or that follows from the values of the parameters."""
    problem = described(form, kept).replace(sensitivities=iv.Sensitivities(["args[0]", "y0[x]"], scale=scale))
    solver = problem.prepare("ode45")
    for _ in range(2):
        a, b = solver(**CHANGES[change]), problem.replace(**CHANGES[change]).solve("ode45")
        same(a, b)
        np.testing.assert_array_equal(a.sensitivities, b.sensitivities)


@pytest.mark.parametrize("form", FORMS)
def test_another_derivative_of_the_start_is_that_of_a_problem_that_has_it(form: str) -> None:
    """The law holds beside a change of everything else, and where the derivative is a function of the arguments."""
    matrix, change = np.arange(4.0).reshape(4, 1), {"y0": [0.9, 0.0, 0.0, 1.1], "args": (1.1,)}
    given = iv.Sensitivities(["args[0]"], dy0dp=lambda mu: mu * matrix)
    problem = described(form).replace(sensitivities=given)
    solver = problem.prepare("ode45")
    for dy0dp in (None, 3 * matrix, lambda mu: np.sin(mu) * matrix):
        wanted = given if dy0dp is None else dataclasses.replace(given, dy0dp=dy0dp)
        a, b = solver(**change, dy0dp=dy0dp), problem.replace(**change, sensitivities=wanted).solve("ode45")
        same(a, b)
        np.testing.assert_array_equal(a.sensitivities, b.sensitivities)
        np.testing.assert_array_equal(a.extend(4.0).sensitivities, b.extend(4.0).sensitivities)
    with pytest.raises(ValueError, match=r"dy0dp must have shape \(4, 1\)"):
        solver(dy0dp=np.zeros((4, 2)))
    with pytest.raises(ValueError, match="dy0dp is of no use without sensitivities"):
        described(form).prepare("ode45")(dy0dp=matrix)


@dealt(10, form=FORMS, options=OPTIONS, change=CHANGES)
def test_options_hold_in_every_call(form: str, options: str, change: str) -> None:
    problem, given = described(form), OPTIONS[options]
    solver = problem.prepare("ode45", **given)
    same(solver(**CHANGES[change]), problem.replace(**CHANGES[change]).solve("ode45", **given))


@pytest.mark.parametrize("form", FORMS)
def test_times_must_fit_the_interval_of_the_call(form: str) -> None:
    solver = described(form).prepare(t_eval=[1.0, 2.0])
    assert solver(y0=[1.0, 0.0, 0.0, 1.0]).t.tolist() == [1.0, 2.0]
    assert solver(t_span=(0.5, 2.5)).t.tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="Values in `t_eval` are not within"):
        solver(t_span=(0.0, 1.5))
    with pytest.raises(ValueError, match="`first_step` exceeds bounds"):
        described(form).prepare(first_step=0.5)(t_span=(0.0, 0.1))


@pytest.mark.parametrize(
    ("fun", "options"),
    [
        (lambda t, y: np.conj(y) * 1j - y, {}),
        (lambda t, y: [-1e4 * (y[0] - np.cos(t)), y[0] - y[1]], {"mass": np.diag([1.0, 0.0])}),
        (lambda t, y: [-y[1], y[0]], {"events": iv.Event(lambda t, y: y[1], at_start=True)}),
        (lambda t, y: [-y[1], y[0]], {"bounds": (-0.5, 2)}),
    ],
    ids=["complex", "algebraic", "at the start", "bounds"],
)
def test_problems_that_are_looked_at_anew(fun: Callable[..., Any], options: dict[str, Any]) -> None:
    start = [1 + 0j, 1j] if not options else [1.0, 0.0]
    method = "ode15s" if "mass" in options else "ode45"
    problem = iv.Problem(fun, (0, 1), start, **options)
    solver = problem.prepare(method)
    for y0 in (np.array(start), np.array(start) * 0.7):
        same(solver(y0=y0), problem.replace(y0=y0).solve(method))


@dealt(
    10,
    form=FORMS,
    wrong=[
        {"y0": [np.nan, 0.0, 0.0, 1.0]},
        {"y0": [1.0, 0.0]},
        {"y0": "abcd"},
        {"y0": [[1.0, 0.0, 0.0, 1.0]]},
        {"args": (1.0, 2.0)},
        {"args": ("a",)},
        {"args": 3.0},
        {"t_span": (0.0, np.nan)},
        {"t_span": 4.0},
        {"y0": [0.0, 0.0, 0.0, 0.0]},
    ],
)
def test_errors_are_those_of_a_solve(form: str, wrong: dict[str, Any]) -> None:
    def outcome(act: Callable[[], Any]) -> Any:
        try:
            sol = act()
        except Exception as error:
            return type(error), str(error)
        return sol.status, sol.message, sol.y.tolist()

    problem = described(form)
    solver = problem.prepare()
    with np.errstate(all="ignore"):
        one = outcome(lambda: solver(**wrong))
        other = outcome(lambda: problem.replace(**wrong).solve())
    np.testing.assert_equal(one, other)
    same(solver(), problem.solve())  # nothing of it is left


def test_an_exception_of_fun_comes_out_and_the_solver_goes_on() -> None:
    def fun(t: float, y: np.ndarray) -> Any:
        if y[0] > 5:
            raise ArithmeticError("too large")
        return y

    problem = iv.Problem(fun, (0, 1), [1.0])
    solver = problem.prepare()
    with pytest.raises(ArithmeticError, match="too large"):
        solver(y0=[4.0])
    same(solver(), problem.solve())


@pytest.mark.parametrize("form", FORMS)
def test_threads_do_not_disturb_each_other(form: str) -> None:
    problem = described(form, kept=True, events=True)
    solver = problem.prepare("ode45", rtol=1e-6)
    chosen = [(0.7 + 0.05 * i, 1.0 + 0.01 * i) for i in range(12)]
    expected = [problem.replace(y0=[x, 0, 0, 1.2], args=(mu,)).solve("ode45", rtol=1e-6) for x, mu in chosen]
    found: dict[int, iv.Solution] = {}

    def work(own: int) -> None:
        for i in range(own, len(chosen), 3):
            x, mu = chosen[i]
            found[i] = solver(y0=[x, 0, 0, 1.2], args=(mu,))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i, sol in enumerate(expected):
        same(found[i], sol)


def test_a_function_may_call_the_solver_that_calls_it() -> None:
    def fun(t: float, y: np.ndarray) -> Any:
        if t == 0 and y[0] == 1:
            inner.append(solver(y0=[0.5]))
        return -y

    inner: list[iv.Solution] = []
    problem = iv.Problem(fun, (0, 1), [1.0])
    solver = problem.prepare()
    same(solver(), problem.solve())
    assert inner
    same(inner[0], problem.replace(y0=[0.5]).solve())


@pytest.mark.parametrize("form", FORMS)
def test_a_solution_can_be_extended_and_pickled(form: str) -> None:
    problem = described(form)
    y0 = START * 1.1
    sol = problem.prepare("dop853")(y0=y0, args=(1.2,))
    y0[:] = 0  # the solution has its own
    other = problem.replace(y0=START * 1.1, args=(1.2,)).solve("dop853")
    same(sol.extend(4.0), other.extend(4.0))
    same(pickle.loads(pickle.dumps(sol)), pickle.loads(pickle.dumps(other)))


def test_what_is_wrong_for_every_call_is_an_error_at_once() -> None:
    problem = described("python")
    with pytest.raises(TypeError, match="did you mean 'rtol'"):
        problem.prepare(rtoll=1e-3)  # type: ignore[call-arg]  # that is the point
    with pytest.raises(ValueError, match="unknown method"):
        problem.prepare("ode46")  # type: ignore[arg-type]  # the same
    with pytest.warns(UserWarning, match="has no effect"):
        problem.prepare("ode45", max_order=3)


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # what explicit pairs say of jumps
@pytest.mark.parametrize("method", ["ode45", "taylor"])
@pytest.mark.parametrize("t_span", [(3.0, 5.0), (0.5, 5.0), (2.0, -1.0)])
def test_other_intervals_have_jumps_and_bounds_of_their_own(method, t_span):
    """Both are part of the series of f: at the times of the interval, in its direction."""
    jumping = iv.Problem(lambda t, y: [np.floor(t) - y[0]], (0, 2), [1.0])
    bounded = iv.Problem(lambda t, y: [0 * y[0] - 1.0], (0, 2), [1.0], nonnegative=True)
    for problem in (jumping, bounded):
        prepared = problem.prepare(method, max_steps=1000)
        same(prepared(t_span=t_span), problem.replace(t_span=t_span).solve(method, max_steps=1000))


def test_what_is_dissipated_backward_in_time_rises():
    pytest.importorskip("numba")
    falls = iv.Dissipated(iv.compile(lambda t, y: y[0] ** 2), names="square")
    problem = iv.Problem(iv.compile(lambda t, y: (-y[0],)), (0, 2), [1.0], invariants=falls)
    prepared = problem.prepare()
    backward = prepared(t_span=(2, 0))
    np.testing.assert_array_equal(backward.y, problem.replace(t_span=(2, 0)).solve().y)
    assert backward.success


def test_problems_with_sensitivities_share_a_plan_and_no_values():
    """A compiled f keeps the plan of its first problem with sensitivities; each other one gets what it gets alone."""
    pytest.importorskip("llvmlite")

    def falls(t, y, a, b):
        return [-a * y[0] + b * y[1], a * y[0] - b * y[1] ** 2]

    kept = iv.compile(falls)
    wanted: list[Any] = [True, "b", iv.Sensitivities(["a"], y0=[1], scale=[0.1, 2.0])]
    wanted += [iv.Sensitivities(True, dy0dp=[[1.0, 0.0], [0.0, one]]) for one in (1.0, 2.0)]
    wanted.append(iv.Sensitivities(True, error_test=False))
    options: dict[str, Any] = {"rtol": 1e-5, "atol": 1e-8}
    for span, y0, args in [
        ((0, 1), [1.0, 2.0], (0.5, 2.0)),
        ((2, 5), [0.3, 1.0], (1.5, 0.25)),
        ((1, 0), [1, 1], (1, 2)),
    ]:
        for one in wanted:
            problem = iv.Problem(kept, span, y0, args=args, sensitivities=one)
            alone = problem.replace(fun=iv.compile(falls)).solve(**options)
            for sol in (problem.solve(**options), problem.prepare(**options)()):
                assert sol.sensitivity_names == alone.sensitivity_names
                for name in ("t", "y", "sensitivities", "y_end"):
                    np.testing.assert_array_equal(getattr(sol, name), getattr(alone, name))


def times_added(t, y, times, dose):
    z = y[0]
    for _ in range(times):
        z = z + dose
    return [z]


def unchanged(t, y, times, dose):
    return [-0.1 * y[0]]


@pytest.mark.parametrize("where", ["run", "problem", "event"])
def test_constants_in_the_code_of_actions_are_those_of_each_call(where: str) -> None:
    add, half = iv.compile(times_added), iv.Event(iv.compile(lambda t, y, times, dose: t - 0.5))
    half.action = add
    described = {"run": {}, "problem": {"breakpoints": {0.5: add}}, "event": {"events": half}}[where]
    options: dict[str, Any] = {"breakpoints": {0.5: add}} if where == "run" else {}
    problem = iv.Problem(iv.compile(unchanged), (0, 1), [1.0], args=(2, 1.0), **described)
    alone = problem.replace(args=(3, 1.0)).solve(**options)
    assert problem.prepare(**options)(args=(3, 1.0)).y_end == alone.y_end
    with pytest.raises(ValueError, match="2 is a constant of the compiled code"):
        problem.solve_ensemble([[1.0]] * 2, args=[(2, 1.0), (3, 1.0)], **options)


@pytest.mark.parametrize(
    ("dose", "is_kept"),
    [
        (lambda t, y, k, d: [y[0] + d * k, y[1]], True),
        (lambda t, y, k, d: [y[0] + d * np.sqrt(y[1]), 0.5 * y[1]], False),  # whose slope is infinite at 0
    ],
    ids=["smooth", "singular"],
)
def test_sensitivities_after_doses_follow_the_args_of_each_call(dose: Callable[..., Any], is_kept: bool) -> None:
    fun, other = iv.compile(lambda t, y, k, d: [-k * y[0], k * y[0] - 0.1 * y[1]]), (0.7, 1.5)
    doses = {1.0: iv.compile(dose), 2.0: iv.compile(dose)}
    wanted = iv.Sensitivities(args=True, y0=True)
    problem = iv.Problem(fun, (0, 3), [1.0, 0.5], args=(0.5, 2.0), sensitivities=wanted)
    given: dict[str, Any] = {"method": "dop853", "rtol": 1e-9, "atol": 1e-11, "breakpoints": doses}
    solver = problem.prepare(**given)
    sol, alone = solver(args=other), problem.replace(args=other).solve(**given)
    assert solver._shared.prepared.any_y0 is is_kept
    np.testing.assert_array_equal(sol.sensitivities, alone.sensitivities)
    h = 1e-6
    for j, (k, d, a, b) in enumerate(np.eye(4) * h):
        ends = [
            problem.replace(args=(other[0] + s * k, other[1] + s * d), y0=[1 + s * a, 0.5 + s * b], sensitivities=None)
            .solve(**given)
            .y_end
            for s in (1, -1)
        ]
        np.testing.assert_allclose(sol.sensitivities[:, j, -1], (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("form", FORMS)
def test_results_of_one_solver_share_no_memory(form: str) -> None:
    """Values that are written into one result are neither in another nor in a later run."""

    def arrays(sol: iv.Solution) -> list[Any]:
        return [sol.t, sol.y, sol.y_end, *sol.t_events, *sol.y_events, sol.steps.h]

    problem = described(form, events=True)
    solver = problem.prepare("ode45")
    spoiled, other = solver(), solver()
    for mine in arrays(spoiled):
        assert not any(np.shares_memory(mine, one) for one in arrays(other))
        mine[...] = np.nan
    same(other, problem.solve("ode45"))
    same(solver(), other)
