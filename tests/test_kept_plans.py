"""Solves of one kind share what does not depend on the problem, and nobody can tell: same bits, errors, warnings."""

from __future__ import annotations

import copy
import gc
import pickle
import re
import threading
import warnings
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import invariode as iv
from cases import METHODS, dealt, families
from invariode._base.latest import Latest
from invariode._functions.graph.plain import use_of_time
from invariode._run import prepared

GENERAL = [name for name, method in METHODS.items() if method.equations == "any"]


def orbit(t, y, mu=1.0):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return y[2], y[3], -mu * y[0] / r3, -mu * y[1] / r3


def spiral(t, y, rate=0.3):
    return [y[1] - rate * y[0], -y[0], y[3], -np.sin(y[2]) + t / 10]


class Callable4:
    """Not a function, but called like one."""

    def __call__(self, t: float, y: Any) -> Any:
        return -y * (1 + t)

    def method(self, t: float, y: Any) -> Any:
        return y * np.cos(t)


START = np.array([0.8, 0.1, 0.0, 1.2])
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "function": orbit,
    "other function": spiral,
    "lambda": lambda t, y, *args: [y[1], -y[0], y[3], -2 * y[2]],
    "partial": partial(orbit, mu=1.2),
    "object": Callable4(),
    "method": Callable4().method,
}
PROBLEMS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "y0": {"y0": [0.9, 0.0, 0.2, 1.1]},
    "integers": {"y0": [1, 0, 0, 1]},
    "t_span": {"t_span": (0.5, 2)},
    "backwards": {"t_span": [0.0, -1.5]},
    "from minus zero": {"t_span": (-0.0, 1)},
    "nothing to do": {"t_span": (1, 1)},
    "times": {"t_eval": [0.25, 0.5, 1.0]},
    "other times": {"t_eval": np.linspace(0, 1, 7)},
    "breakpoints": {"breakpoints": [0.5]},
    "breakpoints in any order": {"breakpoints": np.array([0.7, 3.0, 0.0, 0.3])},
    "breakpoints backwards": {"t_span": (0, -1), "breakpoints": (-0.7, -0.3)},
}
OPTIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "tolerances": {"rtol": 1e-6, "atol": 1e-9},
    "dense": {"dense_output": True},
    "end": {"keep": "end"},
    "tenth": {"max_step": "tenth", "first_step": 1e-3},
    "whole numbers": {"max_step": 1, "max_steps": 5},
}


@pytest.fixture(autouse=True)
def _no_templates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared, "_kept", Latest())


def _timeless(value: Any) -> Any:
    """Without the seconds that messages of limits tell."""
    return re.sub(r"steps and \S+ s\.", "", value) if isinstance(value, str) else value


def bits(array: Any) -> tuple[tuple[int, ...], str, bytes]:
    return array.shape, array.dtype.str, array.tobytes()


def outcome(**call: Any) -> Any:
    """Return the outcome of a solve: its data, or its exception; and its warnings. The values of a whole run are given
    as bytes: NumPy compares numbers of lists one by one."""
    with warnings.catch_warnings(record=True) as told, np.errstate(all="ignore"):
        warnings.simplefilter("always")
        try:
            sol = iv.solve_ivp(**call)
        except Exception as error:
            return type(error), str(error), getattr(error, "__notes__", None), [str(one.message) for one in told]
        dense = sol.sol and bits(sol.sol(np.linspace(sol.t[0], sol.t[-1], 17)))
        steps = sol.steps and bits(sol.steps._rows)
        data = {name: _timeless(value) for name, value in sol.items() if name not in ("sol", "steps", "stats")}
        names = (sol._names, sol._rtol, sol._atol, sol._invariants.forward, sol._invariants.names, len(sol._invariants))
        origin = sol._origin
        extended = bits(sol.extend(sol.t_end + np.sign(sol.t_end or 1)).y) if sol.success else None
        ended = origin.t, bits(origin.y), origin.next_h, origin.memory, repr(origin.source.problem)
    return data, dense, steps, dict(sol.stats), names, ended, extended, [str(one.message) for one in told]


def alone(**call: Any) -> Any:
    """Return the outcome without templates."""
    known, prepared._kept = prepared._kept, Latest()
    try:
        return outcome(**call)
    finally:
        prepared._kept = known


def case(fun: str = "function", problem: str = "as it is", **more: Any) -> dict[str, Any]:
    return {"fun": FUNCTIONS[fun], "t_span": (0, 1), "y0": START, **PROBLEMS[problem], **more}


@dealt(18, fun=FUNCTIONS, start=PROBLEMS, options=OPTIONS, method=GENERAL)
def test_a_solve_by_a_template_is_a_solve(fun: str, start: str, options: str, method: str) -> None:
    given = {"method": method, **OPTIONS[options]}
    call = case(fun, start, **given)
    outcome(**{**call, "fun": spiral, "y0": np.array(call["y0"]) * 0.9, "args": (0.1,)})
    np.testing.assert_equal(outcome(**call), alone(**call))


@families
def test_one_plan_serves_all_problems_of_a_kind(method: str) -> None:
    for fun in FUNCTIONS:
        for problem in PROBLEMS:
            outcome(**case(fun, problem, method=method))
    every = {
        ("t_eval" in problem, "breakpoints" in problem, use_of_time(fun) == "none")
        for problem in PROBLEMS.values()
        for fun in FUNCTIONS.values()
    }
    kinds = every if METHODS[method].equations == "any" else {}
    assert len(prepared._kept) == len(kinds)


@dealt(
    26,
    method=["ode45", "auto", "ode15s"],
    wrong=[
        {"y0": [1.0, np.nan, 0.0, 1.0]},
        {"y0": [[1.0, 0.0, 0.0, 1.0]]},
        {"y0": "abcd"},
        {"y0": [None, 1.0, 2.0, 3.0]},
        {"t_span": 3.0},
        {"t_span": (np.inf, 1.0)},
        {"t_span": ("0", 1.0)},
        {"t_span": (0.0, 0.1), "first_step": 0.5},
        {"t_span": (0.0, np.nan)},
        {"args": 3.0},
        {"args": (1.0, 2.0)},
        {"fun": 3},
        {"fun": lambda t, y: y[:2]},
        {"fun": lambda t, y: None},
        {"fun": lambda t, y: y[:, None]},
        {"fun": lambda t, y: y / 0},
        {"fun": lambda t, y: [y[9]] * 4},
        {"t_eval": [0.5, 0.2]},
        {"t_eval": [2.0]},
        {"t_eval": "ab"},
        {"breakpoints": [0.5, np.nan]},
        {"breakpoints": ["0.5"]},
        {"breakpoints": True},
        {"callback": True},
        {"vectorized": 1},
        {"events": 3},
    ],
)
def test_errors_are_the_same(method: str, wrong: dict[str, Any]) -> None:
    own = {name: value for name, value in wrong.items() if name == "first_step"}
    right = case(method=method, **own)
    outcome(**right)
    outcome(**{**right, "t_eval": [0.5]})
    outcome(**{**right, "breakpoints": [0.5]})
    iv.odeint(lambda y, t: y, START, [0.0, 1.0], mxstep=100)
    call = {**right, **wrong}
    np.testing.assert_equal(outcome(**call), alone(**call))
    np.testing.assert_equal(outcome(**right), alone(**right))  # nothing of it is left


@pytest.mark.parametrize("equal", [(1, True), (1.0, 1), (1.0, np.float64(1.0)), (0, False), (1, 1.0)])
def test_equal_values_of_other_types_are_other_options(equal: tuple[Any, Any]) -> None:
    for name in ("max_step", "refine", "max_steps", "rtol", "dense_output"):
        for value in equal:
            call = case(**{name: value})
            np.testing.assert_equal(outcome(**call), alone(**call))


def test_what_draws_a_warning_draws_it_in_every_solve() -> None:
    for _ in range(3):
        with pytest.warns(UserWarning, match="no effect on ode45"):
            iv.solve_ivp(**case(max_order=3))
        with pytest.warns(UserWarning, match="too small"):
            iv.solve_ivp(**case(rtol=1e-17, atol=0.0, max_steps=3))
        with pytest.warns(iv.StiffnessWarning):
            iv.solve_ivp(lambda t, y: [-1e4 * (y[0] - np.cos(t))], (0, 1), [1.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(2):
            with pytest.raises(UserWarning, match="no effect on ode45"):
                iv.solve_ivp(**case(max_order=3))


def test_what_the_caller_changes_later_changes_no_solution() -> None:
    y0, args, times, tolerances = START.copy(), [1.1], np.array([0.5, 1.0]), np.full(4, 1e-6)
    for options in ({}, {"t_eval": times}, {"atol": tolerances}):
        first = outcome(**case(y0=y0, args=args, **options))
        sol = iv.solve_ivp(**case(y0=y0, args=args, **options))
        y0[:], args[0], times[:], tolerances[:] = 3.0, 9.0, [0.1, 0.2], 1e-1
        expected = alone(**case(args=[1.1], **{name: kept for name, kept in ORIGINAL.items() if name in options}))
        np.testing.assert_equal(first, expected)
        np.testing.assert_array_equal(sol._origin.source.problem.y0, START)
        y0[:], args[0], times[:], tolerances[:] = START, 1.1, [0.5, 1.0], 1e-6


def test_a_problem_keeps_its_arrays_as_they_were() -> None:
    k, y0, times = np.array([2.0]), np.array([1.0]), np.array([0.5, 1])
    jac, mass = np.array([[-2.0]]), np.array([[1.0]])
    problem = iv.Problem(lambda t, y, k: -k * y, (0, 1), y0, args=(k,), jac=jac, mass=mass)
    first = problem.solve("ode15s", t_eval=times)
    begun = iv.solve_ivp(lambda t, y, k: -k * y, (0, 1), y0, "ode15s", args=(k,))
    for changed in (k, jac, mass, y0, times):
        changed *= -0.1
    again = problem.solve("ode15s", t_eval=[0.5, 1])
    np.testing.assert_array_equal(first.y, again.y)
    assert abs(begun.extend(2).y[0, -1] - np.exp(-4)) < 1e-3


ORIGINAL = {"t_eval": np.array([0.5, 1.0]), "atol": np.full(4, 1e-6)}


FORMS: dict[str, list[Any]] = {
    "y0": [
        [1, 0, 0.0, 2],
        (1.0, 0.0, 0, np.float64(2)),
        np.array([1, 0, 0, 2]),
        np.array([1.0, 0, 0, 2], ">f8"),
        np.array([1.0, 0, 0, 2], np.float32),
        np.array([1, 0, 0, 2], object),
        np.array([1.0, 9.0, 0.0, 9.0, 0.0, 9.0, 2.0, 9.0])[::2],
    ],
    "t_span": [(0, 1), [0.0, 1], np.array([0.0, 1.0]), (np.float64(0), np.int64(1)), iter((False, 1.0))],
    "t_eval": [[0, 0.5, 1], (0.0, np.float64(0.5), 1), np.array([0.0, 0.5, 1.0]), np.linspace(0, 1, 5)[::2]],
    "breakpoints": [
        [0.25, 0.5],
        (0.5, np.float64(0.25)),
        np.array([0.25, 0.5]),
        [(0.25, None), 0.5],
        {0.5: None, 0.25: None},
    ],
    "args": [(1.25,), [1.25], np.array([1.25]), iter([1.25])],
}


@pytest.mark.parametrize("name", FORMS)
def test_the_form_of_an_argument_does_not_matter(name: str) -> None:
    """Some forms are read at once, in the binding, and some have to be looked at."""
    found = []
    for form in FORMS[name]:
        sol = iv.solve_ivp(**case(**{name: form}))
        assert (type(sol._origin.source.problem.t_span), sol._origin.source.problem.y0.dtype) == (tuple, float)
        assert not sol._origin.source.problem.y0.flags.writeable
        found.append((sol.t, sol.y, sol.steps and sol.steps._rows, sol.nfev, sol._origin.source.problem.args))
    for other in found[1:]:
        np.testing.assert_equal(other, found[0])


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda sol: pickle.loads(pickle.dumps(sol))])
def test_a_copy_has_what_nobody_has_asked_for(copied: Callable[[Any], Any]) -> None:
    asked, sol = iv.solve_ivp(**case()), iv.solve_ivp(**case())
    expected = (
        dict(asked.stats),
        asked.steps._rows,
        asked.steps.method,
        asked._names,
        asked._rtol,
        len(asked._invariants),
    )
    twin = copied(sol)
    assert vars(twin).keys() == vars(asked).keys()
    found = (dict(twin.stats), twin.steps._rows, twin.steps.method, twin._names, twin._rtol, len(twin._invariants))
    np.testing.assert_equal(found, expected)


def test_what_is_not_there_is_not_found_at_once_or_later() -> None:
    sol = iv.solve_ivp(**case())
    assert "steps" in dir(sol.stats)
    for _ in range(2):
        assert not hasattr(sol, "_nothing")
        assert not hasattr(sol.stats, "nothing")


@pytest.mark.parametrize("imaginary", [0, 1j])
def test_a_pattern_that_was_found_is_that_of_its_function(imaginary: complex) -> None:
    """The pattern is looked for from 200 reals on."""
    start = np.linspace(1, 2, 100) * (1 + imaginary)
    call = {"fun": lambda t, y: -y - y.sum() / 100, "t_span": (0, 1), "y0": start, "method": "ode15s"}
    iv.solve_ivp(**{**call, "fun": lambda t, y: -y})
    np.testing.assert_equal(outcome(**call), alone(**call))


@pytest.mark.parametrize("method", GENERAL)
def test_many_components_share_a_plan_where_no_pattern_is_looked_for(method: str) -> None:
    """Implicit methods look for one from 200 reals on."""
    start = np.linspace(0.5, 1.5, 200)
    call = {"fun": lambda t, y: -y * y, "t_span": (0, 1), "y0": start, "method": method}
    iv.solve_ivp(**call)
    assert len(prepared._kept) == ("jac" not in METHODS[method].options)
    others = {"y0": start[::-1] ** 2}, {"rtol": 1e-5, "atol": np.full(200, 1e-7)}, {"t_span": (0, -0.2)}
    for other in others:
        np.testing.assert_equal(outcome(**call | other), alone(**call | other))
    event = iv.Event(lambda t, y: y[7] - 0.5, action=lambda t, y: y + 0.1)
    besides: list[dict[str, Any]] = [
        {"nonnegative": [0, 199], "events": lambda t, y: y[7] - 0.5},
        {"events": event, "breakpoints": [0.3]},
        {"fun": lambda t, y: y[::-1] - y, "invariants": lambda t, y: y.sum(), "dense_output": True},
        {"y0": start * (1 + 1j)},
    ]
    for beside in besides:
        for _ in range(2):
            np.testing.assert_equal(outcome(**call | beside), alone(**call | beside))


def test_many_compiled_components_share_a_plan() -> None:
    def decay(t: float, y: Any, k: float) -> Any:
        return -k * y * y

    kept = iv.compile(decay)
    for k, size in ((1.0, 1.0), (2.0, 0.5), (3, 1.0)):
        call = {"t_span": (0, 1), "y0": size * np.linspace(0.5, 1.5, 300), "method": "dop853", "args": (k,)}
        for beside in ({}, {"invariants": lambda t, y, k: y[0] / y[1]}, {"bounds": (-1, 3)}):
            np.testing.assert_equal(outcome(fun=kept, **call | beside), outcome(fun=iv.compile(decay), **call | beside))
    assert len(kept.prepared) > 0


def test_an_array_that_a_function_has_changed_is_not_given_to_another() -> None:
    def swaps(t, y):
        slope = -y
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of NumPy 2.5; users still do it
            y.dtype = ">f8"
        return slope

    expected = iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]).y
    iv.solve_ivp(swaps, (0, 1), [1.0], max_steps=3)
    np.testing.assert_array_equal(iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]).y, expected)


def test_a_template_keeps_nothing_of_the_users() -> None:
    class Held:
        def __call__(self, t: float, y: Any, other: Any) -> Any:
            return -y

    for raises in (False, True):
        fun, argument = Held(), Held()
        kept = [weakref.ref(fun), weakref.ref(argument)]
        sol = iv.solve_ivp(fun, (0, 1), [1.0, 2.0], args=(argument,))
        if raises:
            with pytest.raises(ZeroDivisionError):
                iv.solve_ivp(lambda t, y, fun, other: [t / 0] * 2, (0, 1), [1.0, 2.0], args=(fun, argument))
        assert len(prepared._kept) == 1
        del sol, fun, argument
        gc.collect()
        assert [one() for one in kept] == [None, None]


def above(t, y, *args):
    return y[0] - 0.75


def momentum(t, y, *args):
    return y[0] * y[3] - y[1] * y[2]


def momentum_gradient(t, y, *args):
    return [y[3], -y[2], -y[1], y[0]]


def energy(t, y, *args):
    return (y[2] ** 2 + y[3] ** 2) / 2 - (y[0] ** 2 + y[1] ** 2) ** -0.5


def squares(t, y, *args):
    return [y[0] ** 2 + y[1] ** 2, y[2] ** 2 + y[3] ** 2]


def turned(t, y, *args):
    return [y[1], -y[0], y[3], -y[2]]


def reflected(t, y, *args):
    return [y[0], y[1], -y[2], y[3]]


def ending(t, y, *args):
    return y[0] - 0.7


ending.terminal, ending.direction = 2, -1  # type: ignore[attr-defined]  # as SciPy has them
#: What a problem may have besides f, and still share a plan.
DESCRIBED: dict[str, dict[str, Any]] = {
    "an event": {"events": above},
    "no events": {"events": []},
    "events": {"events": [ending, iv.Event(above, direction=1, samples=8)]},
    "an action": {"events": iv.Event(above, action=reflected)},
    "bounds": {"bounds": (-3, [3.0, 3.0, 4.0, 4.0])},
    "an invariant": {"invariants": momentum},
    "an invariant with its Jacobian": {"invariants": iv.Invariants(momentum, momentum_gradient, names="momentum")},
    "by differences": {"invariants": iv.Invariants(momentum, "3-point", when="needed")},
    "by complex steps": {"invariants": iv.Invariants(momentum, "complex-step")},
    "several": {"invariants": [energy, iv.Invariants(momentum, momentum_gradient)], "events": ending},
}
STARTS: dict[str, dict[str, Any]] = {name: PROBLEMS[name] for name in ("as it is", "y0", "t_span", "times")}


@dealt(40, described=DESCRIBED, start=STARTS, method=GENERAL, fun=["function", "lambda", "object"])
def test_whatever_a_problem_has_a_solve_by_a_kept_plan_is_a_solve(
    described: str, start: str, method: str, fun: str
) -> None:
    call = case(fun, start, **DESCRIBED[described], method=method)
    if fun == "object":
        call["invariants"] = None  # which it does not conserve
    outcome(**{**call, "y0": np.array(call["y0"]) * 0.99, "fun": FUNCTIONS[fun]})
    np.testing.assert_equal(outcome(**call), alone(**call))


@pytest.mark.parametrize("described", DESCRIBED)
def test_a_kept_plan_is_of_one_kind_and_keeps_no_function(described: str) -> None:
    for _ in range(2):
        fun = partial(orbit)
        held = weakref.ref(fun)
        iv.solve_ivp(**{**case(**DESCRIBED[described]), "fun": fun})
        del fun
        gc.collect()
        assert held() is None
        assert len(prepared._kept) == 1


def test_invariants_of_other_sizes_have_other_plans() -> None:
    """The values that hold are those at the start of each run."""
    iv.solve_ivp(turned, (0, 5), START, invariants=momentum, rtol=1e-6)
    for y0 in (START, START * 1.1, START * 0.9):
        sol = iv.solve_ivp(turned, (0, 5), y0, invariants=iv.Invariants(squares), rtol=1e-6)
        np.testing.assert_allclose(sol._invariants.value, squares(0, y0), rtol=1e-15)
        assert np.abs(sol.residual).max() < 1e-9
        with pytest.raises(iv.InvariantError, match="not conserved"):
            iv.solve_ivp(lambda t, y: [1.0, 0, 0, 0], (0, 5), y0, invariants=iv.Invariants(squares), rtol=1e-6)


def test_a_compiled_function_keeps_its_plans_until_it_has_captured_something_else() -> None:
    pytest.importorskip("llvmlite")
    rate = [1.0]

    def decay(t, y, k):
        return [-k * rate[0] * y[0]]

    compiled = iv.compile(decay)
    for method in ("ode45", "ode15s"):
        for k in (1.0, 2.0, 3.0, 2):
            for _ in range(2):
                sol = iv.solve_ivp(compiled, (0, 1), [1.0], method, args=(k,), rtol=1e-8, atol=1e-10)
                assert sol.y[0, -1] == pytest.approx(np.exp(-k * rate[0]), rel=1e-6)
        assert compiled.prepared
        rate[0] += 0.5


def test_fits_of_a_compiled_function_share_a_plan_and_have_the_results_of_fits_alone() -> None:
    pytest.importorskip("llvmlite")
    t, data, parameters = [0.5, 1.0, 2.0], [[0.8, 0.5, 0.1]], {"mu": iv.Parameter(1.1, (0.5, 2.0))}
    kinds, found = [], []
    for code in (iv.compile(orbit), iv.compile(orbit)):
        for _ in range(2):
            fit = iv.fit(iv.Problem(code, (0, 2), START, args=(1.0,)), t, data, parameters, observe=[0], sigma=0.1)
            kinds.append(len(code.prepared))
            found.append(fit.parameters["mu"])
    assert kinds == [1, 1, 1, 1]
    assert len({*found}) == 1


def test_compiled_events_and_invariants_share_the_plans_of_a_compiled_f() -> None:
    pytest.importorskip("llvmlite")
    level = [0.75]
    f, law, gradient, action = map(iv.compile, (turned, momentum, momentum_gradient, reflected))
    event = iv.compile(lambda t, y: y[0] - level[0])
    described: list[dict[str, Any]] = [
        {"events": event},
        {"events": iv.Event(event, action=action)},
        {"events": [above, event]},
        {"invariants": law},
        {"invariants": iv.Invariants(law, gradient), "events": event},
    ]
    for options in described:
        for level[0] in (0.75, 0.5):
            for y0 in (START, START * 0.99, START):
                call = {"fun": f, "t_span": (0, 3), "y0": y0, "method": "dop853", **options}
                shared = outcome(**call)
                kept, f.prepared = f.prepared, Latest()
                assert kept
                np.testing.assert_equal(outcome(**call), shared)
                f.prepared = kept


def test_nested_solves_and_threads_do_not_meet() -> None:
    def inner(t: float, y: Any) -> Any:
        return -y

    def outer(t: float, y: Any) -> Any:
        return iv.solve_ivp(inner, (0, 0.1), y, first_step=0.1).y[:, -1] * -1

    expected = alone(fun=outer, t_span=(0, 1), y0=[1.0, 2.0], first_step=0.1)
    for _ in range(2):
        np.testing.assert_equal(outcome(fun=outer, t_span=(0, 1), y0=[1.0, 2.0], first_step=0.1), expected)
    found: dict[int, Any] = {}

    def work(own: int) -> None:
        for k in range(own, 30, 3):
            found[k] = iv.solve_ivp(orbit, (0, 1 + k / 10), START, args=(1 + k / 10,)).y.tolist()

    threads = [threading.Thread(target=work, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k in range(30):
        assert found[k] == iv.solve_ivp(orbit, (0, 1 + k / 10), START, args=(1 + k / 10,)).y.tolist()


def test_so_many_templates_and_no_more() -> None:
    for k in range(Latest.most + 5):
        iv.solve_ivp(**case(rtol=1e-3 / (1 + k), t_span=(0, 0.01)))
    assert len(prepared._kept) == Latest.most
