"""Spellings and forms that belong to another package get a sentence that names the form here."""

from __future__ import annotations

import re
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import invariode as iv


def circle(t: float, y: Any) -> Any:
    return [y[1], -y[0]]


CALL = (circle, (0, 1), [1.0, 0.0])


def three(t: float, y: Any) -> Any:
    """MATLAB's form of an event."""
    return [y[0] - 0.5], [1], [0]


OPTIONS = {
    "RelTol": "pass rtol=",
    "AbsTol": "pass atol=",
    "InitialStep": "pass first_step=",
    "MaxStep": "write max_step=",
    "NonNegative": "write nonnegative=",
    "OutputFcn": "pass callback=",
    "Jacobian": "pass jac=",
    "step": "steps follow from rtol and atol",
    "dt": "steps follow from rtol and atol",
    "isterminal": "belongs to an event",
    "n_jobs": "pass workers=",
    "hmax": "pass max_step=",
    "mxstep": "pass max_steps=",
    "saveat": "pass t_eval=",
    "tcrit": "pass breakpoints=",
    "rtoll": "did you mean 'rtol'",
}

SLIPS: dict[str, tuple[Callable[[], Any], str]] = {
    "more times than two": (lambda: iv.ode45(circle, [0, 0.5, 1], [1.0, 0]), "t_eval=times"),
    "options as a fourth argument": (lambda: iv.ode45(*CALL, {"rtol": 1e-6}), "options by name"),
    "options as the method": (lambda: iv.solve_ivp(*CALL, {"rtol": 1e-6}), "options are passed by name"),
    "an event of MATLAB's form": (lambda: iv.solve_ivp(*CALL, events=three), "isterminal, direction] is events="),
    "components counted from one": (lambda: iv.solve_ivp(*CALL, nonnegative=[1, 2]), "counted from 0"),
    "one array as args": (
        lambda: iv.solve_ivp(lambda t, y, p: [-p[0] * y[0]], (0, 1), [1.0], args=[1.0, 2.0]),
        "pass one array or list as args=(p,)",
    ),
    "a mass matrix that depends on y": (
        lambda: iv.solve_ivp(*CALL, "ode15s", mass=lambda t, y: np.eye(2)),
        "M(t, y) is not supported, solve M y' = f for y' in fun; MechanicalSystem(M, force)",
    ),
    "an event of ode15i with y'": (
        lambda: iv.ode15i(lambda t, y, yp: yp + y, (0, 1), [1.0], [-1.0], events=lambda t, y, yp: y[0] - 0.5),
        "make it an unknown of its own, u, with the equation u - y' = 0",
    ),
    "an event of dde23 with Z": (
        lambda: iv.dde23(lambda t, y, Z: -Z[:, 0], [1.0], [1.0], (0, 1), events=lambda t, y, Z: y[0]),
        "events are called as event(t, y, *args), also with delays",
    ),
    "an action of a breakpoint without t": (
        lambda: iv.solve_ivp(*CALL, breakpoints=[(0.5, lambda y: y)]),
        "the action of the breakpoint at t = 0.5: called with t and y alone",
    ),
    "an output time beyond the end by rounding": (
        lambda: iv.solve_ivp(circle, (0, 0.3), [1.0, 0], t_eval=[0, 0.1 + 0.2]),
        "by rounding: numpy.clip",
    ),
    "a solution as CSV": (lambda: iv.solve_ivp(*CALL).save("run.csv"), "to_dataframe()"),
    "odeset": (lambda: iv.odeset, "options are keyword arguments"),
    "deval": (lambda: iv.deval, "sol.sol(t)"),
}


def said(call: Callable[[], Any]) -> str:
    """The message of the exception, its notes included."""
    with pytest.raises((TypeError, ValueError, AttributeError)) as caught:
        call()
    return "".join(traceback.format_exception_only(caught.value))


def test_options_of_other_packages_name_the_option_here() -> None:
    for name, expected in OPTIONS.items():
        text = said(lambda name=name: iv.solve_ivp(*CALL, **{name: 1e-3}))
        assert expected in text, name
        named = re.search(r"(?:pass|write) (\w+)=", text)
        assert named is None or "lband" in text or named[1] in {*iv._problem.options.TABLE, "method"}, name


@pytest.mark.parametrize("slip", SLIPS)
def test_forms_of_other_packages_name_the_form_here(slip: str) -> None:
    call, expected = SLIPS[slip]
    assert expected in said(call)
    assert not Path("run.csv").exists()


def test_values_of_several_fields_name_an_argument_that_they_do_not_have() -> None:
    """Python's own message names the method that makes the object, and no argument like the given one."""
    for cls in (
        iv.Banded, iv.Checkpoint, iv.Dae, iv.Dissipated, iv.Event, iv.GMRES, iv.Input, iv.Invariants, iv.Limits,
        iv.MechanicalSystem, iv.Roots, iv.Sensitivities,
    ):  # fmt: skip
        assert f"{cls.__name__} has no argument 'no_such'" in said(lambda cls=cls: cls(no_such=1))


def test_functions_with_y_before_t_are_named_where_t_is_first() -> None:
    """Nothing raises if y has one component; the solution is that of another problem."""
    with pytest.warns(UserWarning, match=r"parameters \(y, t\) and is called as fun\(t, y\)") as given:
        iv.solve_ivp(lambda y, t: -2 * y, (0, 1), [1.0])
    assert len(given) == 1
    with pytest.warns(UserWarning, match="tfirst=True"):
        iv.odeint(lambda t, y: -2 * y, [1.0], [0, 1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        iv.odeint(lambda y, t: -2 * y, [1.0], [0, 1])
        iv.odeint(lambda t, y: -2 * y, [1.0], [0, 1], tfirst=True)


@pytest.mark.parametrize("compiled", [False, True])
def test_nan_among_the_arguments_is_named(compiled: bool) -> None:
    def fun(t: float, y: Any, k: float, p: Any) -> Any:
        return [-k * p[1] * y[0]]

    if compiled:
        pytest.importorskip("llvmlite")
    for args, name in (((np.nan, [1.0, 1.0]), r"args\[0\] is NaN"), ((1.0, [1.0, np.nan]), r"args\[1\]\[1\] is NaN")):
        sol = iv.solve_ivp(iv.compile(fun) if compiled else fun, (0, 1), [1.0], args=args)
        assert sol.status == -1
        assert re.match(name, sol.message)


def test_a_film_is_not_a_still_picture() -> None:
    pytest.importorskip("matplotlib")
    film = iv.solve_ivp(*CALL, dense_output=True).animate(lambda t, y: [[0, 0], [y[0], y[1]]], frames=2)
    with pytest.raises(ValueError, match="still picture"):
        film.save("x.png")
