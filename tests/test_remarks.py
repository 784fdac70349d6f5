"""Warnings are given when they are established, by the thread that waits for the run: not at its end alone."""

from __future__ import annotations

import _thread
import time
import warnings
from typing import Any

import pytest

import invariode as iv


def robertson(t: float, y: Any) -> Any:
    slow, fast, back = 0.04 * y[0], 3e7 * y[1] ** 2, 1e4 * y[1] * y[2]
    return [back - slow, slow - back - fast, fast]


CALL: tuple[Any, ...] = ((0, 1e7), [1.0, 0, 0], "ode45")  # minutes


def forms() -> list[Any]:
    """f called as it is, with a plan of its own, and without Python."""
    runs: list[Any] = [
        lambda: iv.solve_ivp(robertson, *CALL),
        lambda: iv.solve_ivp(robertson, *CALL, invariants=lambda t, y: y[0] + y[1] + y[2]),
    ]
    try:
        compiled = iv.compile(robertson)
    except ModuleNotFoundError:
        return runs
    return [*runs, lambda: iv.solve_ivp(compiled, *CALL)]


@pytest.mark.parametrize("form", range(3))
def test_a_filter_that_makes_the_warning_an_error_ends_a_long_run(form: int) -> None:
    run = forms()[min(form, len(forms()) - 1)]
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(iv.StiffnessWarning, match="limited by stability"):
            run()
    assert time.process_time() - began < 30  # the run would take minutes


@pytest.mark.thread_unsafe
def test_ctrl_c_gives_the_warnings_first() -> None:
    """After so many calls that the run is known to be stiff, which take less than a second."""
    calls = 0

    def interrupted(t: float, y: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 50_000:
            _thread.interrupt_main()
        return robertson(t, y)

    with pytest.warns(iv.StiffnessWarning) as given, pytest.raises(KeyboardInterrupt):
        iv.solve_ivp(interrupted, *CALL)
    assert len(given) == 1


def test_a_warning_is_given_once() -> None:
    """A run of more than a second says it on the way, and not again at its end."""
    with pytest.warns(iv.StiffnessWarning) as given:
        sol = iv.solve_ivp(robertson, *CALL, limits=iv.Limits(time=1.5))
    assert sol.status == -3
    assert len(given) == 1
