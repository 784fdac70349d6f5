"""The private core: what it is handed is of the right size, or refused."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, METHODS, dealt, families
from core_problems import core_solver
from invariode import Event, _core, solve_ivp
from invariode._base.arguments import Weights
from invariode._plan.plan import solver as planned_solver
from invariode._plan.planning import make_plan
from invariode._problem.core_problem import CoreProblem, EventSpec, InvariantSpec, LinearTerms
from invariode._problem.problem import Problem

n, m = 2, 1
NOTHING = np.zeros(0)


def f(t: float, y: Any) -> list[float]:
    return [y[1], -y[0]]


def energy(t: float, y: Any) -> float:
    return float(y[0] ** 2 + y[1] ** 2)


def problem(**changed: Any) -> CoreProblem:
    given: dict[str, Any] = dict(
        n=n,
        complex=False,
        fun=f,
        args=(),
        invariants=[InvariantSpec(energy, "3-point", m, "energy", True)],
        value=np.ones(m),
    )
    return CoreProblem(**{**given, **changed})


def tolerances(size: int = n) -> Weights:
    return Weights(1e-6, np.full(size, 1e-3))


def solver(settings: dict[str, Any] | None = None, method: str = "ode45", **changed: Any) -> _core.Solver:
    return core_solver(method, problem(**changed), tolerances(), **(settings or {}))


def linear(**changed: Any) -> LinearTerms:
    empty = np.zeros(1, np.int32), np.zeros(0, np.int32), NOTHING
    given: dict[str, Any] = dict(
        structure="dense", n=n, lower=0, upper=0, kind="differences", jacobian=None, mass=None, null_basis=empty,
        lapack=None,
    )  # fmt: skip
    return LinearTerms(**{**given, **changed})


def columns(starts: list[int], rows: list[int]) -> tuple[Any, Any, Any]:
    return np.array(starts, np.int32), np.array(rows, np.int32), np.ones(len(rows))


t, y = np.zeros(3), np.ones((3, n))
y0 = np.array([0.6, 0.8])  # on the manifold
MISFITS: dict[str, Callable[[], object]] = {
    "y0": lambda: solver().integrate(np.ones(n + 1)),
    "y0 of a stepper": lambda: _core.Stepper(solver(), np.ones(n - 1)),
    "values": lambda: solver(value=np.ones(m + 1)),
    "tolerances": lambda: core_solver("ode45", problem(), tolerances(n + 1)),
    "no f": lambda: solver(fun=None),
    "no method": lambda: solver(method="ode46"),
    "no Jacobian": lambda: solver(method="ode15s"),
    "refine": lambda: solver({"refine": 0}),
    "fsal": lambda: solver({"fsal": "never"}),
    "memory": lambda: solver().resume(bytes(8), False),
    "rows of residual": lambda: _core.residual(t, y[:2], problem()),
    "columns of residual": lambda: _core.residual(t, np.ones((3, n + 1)), problem()),
    "values of distance": lambda: _core.distance(t, y, problem(value=NOTHING), tolerances()),
    "columns of impose": lambda: _core.impose(t, np.ones((3, n - 1)), problem(), tolerances()),
    "tolerances of impose": lambda: _core.impose(t, y, problem(), tolerances(n + 1)),
    "point of examine": lambda: _core.examine(0, np.ones(n + 1), problem(), tolerances()),
    "f of examine": lambda: _core.examine(0, np.ones(n), problem(fun=None), tolerances()),
    "start without a mass": lambda: _core.consistent_start(0, np.ones(n), problem(), tolerances()),
    "no solvers": lambda: _core.integrate_all([], y, np.zeros((3, 0)), None),
    "no solvers for lanes": lambda: _core.integrate_all([], y, np.zeros((3, 0)), None, ("baseline", [])),
    "functions of Python on threads": lambda: _core.integrate_all([solver()], y, np.zeros((3, 0)), None),
    "Jacobian of another size": lambda: solver(method="ode15s", linear=linear(n=n + 1)),
    "constant Jacobian": lambda: solver(method="ode15s", linear=linear(kind="constant", jacobian=np.ones((n, n + 1)))),
    "bands": lambda: solver(
        method="ode15s", linear=linear(structure="banded", upper=1, kind="constant", jacobian=np.ones((n + 1, n)))
    ),
    "columns of a pattern": lambda: solver(
        method="ode15s", linear=linear(structure="sparse", jacobian=columns([0, 2, 1], [0, 1]))
    ),
    "rows of a pattern": lambda: solver(
        method="ode15s", linear=linear(structure="sparse", jacobian=columns([0, 1, 2], [0, 2]))
    ),
    "rows out of order": lambda: solver(
        method="ode15s", linear=linear(structure="sparse", jacobian=columns([0, 2, 2], [1, 0]))
    ),
    "null space": lambda: solver(
        method="ode15s", linear=linear(mass=np.eye(n), null_basis=columns([0, 1], [n]))
    ),
    "Jacobian function": lambda: solver(
        method="ode15s", linear=linear(kind="function", jacobian=lambda t, y: np.ones((n + 1, n)))
    ).integrate(y0),
}  # fmt: skip


@pytest.mark.parametrize("misfit", MISFITS.values(), ids=MISFITS)
def test_what_does_not_fit_is_refused(misfit: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=r"\w{3}"):
        misfit()


def test_what_fits_is_taken() -> None:
    assert solver().integrate(y0).state == "reached_end"
    assert solver(method="ode15s", linear=linear()).integrate(y0).state == "reached_end"
    assert _core.residual(t, y, problem()).tolist() == [[1.0]] * 3


@pytest.mark.parametrize("extra", [0, 8, 9, 30])
def test_any_number_of_arguments_is_handed_over(extra: int) -> None:
    args = tuple(object() for _ in range(extra))
    seen = []

    def fun(t: float, y: Any, *given: Any) -> list[float]:
        seen.append(given)
        return [0.0, 0.0]

    solver(fun=fun, args=args, invariants=[], value=NOTHING).integrate(y0)
    assert seen
    assert all(given == args for given in seen)


def test_an_event_that_never_occurs_has_empty_arrays() -> None:
    event = EventSpec(lambda t, y: 1.0, 0, 0, "never", None, True)
    ((times, states),) = solver(events=[event]).integrate(y0).take_events(1)
    assert times.shape == (0,)
    assert states.shape == (0, n)


@pytest.mark.parametrize("kind", ["function", "event", "matrix", "callback"])
def test_a_function_that_owns_its_problem_is_collected(kind: str) -> None:
    class Owner:
        held: Any

        def __call__(self, t: float, y: Any = None) -> list[float]:
            return [0.0, 0.0]

    owner = Owner()
    given: dict[str, Any] = {
        "function": {"fun": owner},
        "event": {"events": [EventSpec(owner, 0, 0, "e", None, True)]},
        "matrix": {"linear": linear(kind="function", jacobian=owner, mass=owner)},
        "callback": {"callback": owner},
    }[kind]
    owner.held = problem(**given), solver(**given)
    gone = weakref.ref(owner)
    del owner, given
    gc.collect()
    assert gone() is None


def test_the_registry_has_a_row_for_each_method() -> None:
    assert [row["name"] for row in _core.methods()] == [*iv.METHODS]


def stepped(method: str, y0: Any = y0, **options: Any) -> _core.Stepper:
    """y'' = -y from 0 to 2 in the hands of the core."""
    describing = {key: options.pop(key) for key in ("events",) if key in options}
    plan = make_plan(Problem(f, (0, 2), y0, **describing), method, {"keep": "end", **options})
    return _core.Stepper(planned_solver(plan), y0)


@families
def test_the_result_of_a_stepped_run_may_be_asked_for_at_any_time(method: str) -> None:
    """Asking changes nothing, not even with GMRES, whose memory is given back when a run has ended."""
    options = {"linear_solver": "gmres"} if "linear_solver" in METHODS[method].options else {}
    asked, alone = stepped(method, **options), stepped(method, **options)
    while alone.state == "running":
        alone.step()
        asked.result()
        asked.step()
        result = asked.result()
        assert result.state == asked.state == alone.state
        assert (asked.t, asked.h, asked.nfev) == (alone.t, alone.h, alone.nfev)
        np.testing.assert_array_equal(asked.y, alone.y)
    assert result.t_end == asked.t == 2


@dealt(method=FAMILIES, jump=["breakpoint", "breakpoint with an action", "event with an action"])
def test_the_last_step_is_the_one_before_a_jump(method: str, jump: str) -> None:
    """The interpolant of the last step is that of the whole solution, up to the state before the action."""
    options: dict[str, Any] = {
        "breakpoint": {"breakpoints": [0.5]},
        "breakpoint with an action": {"breakpoints": [(0.5, lambda t, y: y + 1)]},
        "event with an action": {"events": Event(lambda t, y: y[1], action=lambda t, y: y + 1)},
    }[jump]
    whole = solve_ivp(f, (0, 2), y0, method, dense_output=True, **options)
    stepper = stepped(method, **options)
    old, jumps = 0.0, 0
    while stepper.state == "running":
        before = stepper.y
        stepper.step()
        inside = np.linspace(old, stepper.t, 5)
        dense = stepper.interpolant()
        np.testing.assert_array_equal(dense.evaluate(inside[1:-1], None).T, whole.sol(inside[1:-1]))
        np.testing.assert_array_equal(dense.evaluate(inside[:1], None)[0], before)
        ends = dense.evaluate(inside[-1:], None)[0]
        jumps += not np.array_equal(ends, stepper.y)
        assert abs(ends - dense.evaluate(inside[-1:] - 1e-9 * (inside[-1] - old), None)[0]).max() < 1e-8
        old = stepper.t
    assert bool(jumps) == (jump != "breakpoint")


def test_what_was_handed_over_is_not_there_twice() -> None:
    run = solver({"dense": True}).integrate(y0)
    run.take_points()
    with pytest.raises(RuntimeError, match="handed over already"):
        run.take_points()
    assert run.take_dense() is not None
    assert run.take_dense() is None
