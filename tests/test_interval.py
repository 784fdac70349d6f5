"""No run leaves its interval or takes a step longer than max_step, and every run ends, wherever f is undefined."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt, families

#: More evaluations than any of these runs takes before it ends.
MOST = 20_000


class RunawayError(Exception):
    """The run does not end."""


def watched(fun, undefined, span):
    """fun, NaN where `undefined(t)` is true, with the farthest t at which it was called, beyond the end of the span."""
    forward = np.sign(span[1] - span[0])
    seen = {"calls": 0, "beyond": -np.inf}

    def asked(t, y):
        seen["calls"] += 1
        seen["beyond"] = max(seen["beyond"], forward * (t - span[1]))
        if seen["calls"] > MOST:
            raise RunawayError
        return np.full(y.shape, np.nan) if undefined(t) else fun(t, y)

    return asked, seen


def relaxing(end_of_stiffness):
    """Stiff until then, hardly changing afterwards: `auto` hands over to its explicit member."""
    return lambda t, y: -(3000.0 if t < end_of_stiffness else 1e-3) * (y - np.cos(0.1 * t))


def within(sol, span, longest, breaks):
    """Steps are at most max_step long, those that land on the end or a breakpoint a tenth longer, and stay inside."""
    h, t = np.abs(sol.steps.h), sol.steps.t
    landing = np.isin(t, [*breaks, span[1]])
    room = 4 * np.spacing(np.abs(span).max())
    assert (h <= longest * np.where(landing, 1.1, 1) + room).all()
    assert t.size == 0 or (min(span) <= t.min() and t.max() <= max(span))


@dealt(method=FAMILIES, case=range(4))
def test_f_undefined_from_some_t_on(method, case):
    """The attempts end there, forwards and backwards, with a random max_step and breakpoints."""
    r = np.random.default_rng(case)
    span = (0.0, 11.0) if case % 2 == 0 else (3.0, -8.0)
    forward = np.sign(span[1] - span[0])
    longest = float(r.uniform(0.2, 2))
    breaks = sorted(r.uniform(min(span), max(span), int(r.integers(3))).tolist())
    end = float(r.uniform(min(span), max(span)))
    fun, seen = watched(lambda t, y: np.array([y[1], -y[0]]), lambda t: forward * (t - end) > 0, span)
    sol = iv.solve_ivp(fun, span, [1.0, 0.5], method, max_step=longest, breakpoints=breaks or None, rtol=1e-4)
    assert sol.status == -1
    assert abs(sol.t[-1] - end) <= 1e-6
    assert seen["beyond"] <= 0
    within(sol, span, longest, breaks)


@dealt(method=FAMILIES, span=[(0.0, 11.0), (11.0, 0.0)])
@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # where the equation stops being stiff
def test_f_undefined_for_a_while_after_any_step(method, span):
    """The law holds after a hand-over too, from which the member before goes on with its own, longer step."""
    base = relaxing(2.0)
    mirrored = base if span[0] == 0 else lambda t, y: -base(11 - t, y)
    options = {"max_step": 0.5, "atol": 1e-3, "rtol": 1e-3}
    explicit = "jac" not in iv.METHODS[method].options
    fun = mirrored if not explicit else lambda t, y: [np.cos(t)]
    plain = iv.solve_ivp(fun, span, [1.0], method, **options)
    forward = np.sign(span[1] - span[0])
    for at in plain.steps.t[-24:]:
        for wide in (0.1, 0.6, 3.0):
            asked, seen = watched(fun, lambda t, at=at, wide=wide: 0 < forward * (t - at) < wide, span)
            sol = iv.solve_ivp(asked, span, [1.0], method, **options)
            assert seen["beyond"] <= 0
            within(sol, span, 0.5, [])
            assert sol.success == (sol.t[-1] == span[1])


@families
def test_a_forcing_that_vanishes_at_both_ends_is_not_stepped_over(method):
    """sin² over its periods, from where it and y' are 0; without a limit on steps."""
    sol = iv.solve_ivp(
        lambda t, y: [np.sin(2 * np.pi * t) ** 2], (0, 1), [0.0], method, max_step=np.inf, rtol=1e-5, atol=1e-7
    )
    assert sol.y[0, -1] == pytest.approx(0.5, abs=1e-4)
