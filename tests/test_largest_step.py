"""Steps have SciPy's limit, none, except in the functions with MATLAB's names, which have MATLAB's, a tenth."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
import invariode.scipy as plugin
from cases import families

SPAN = (2.0, 32.0)
TENTH = 3.0
#: The last step may be longer by this factor, to land on the end.
STRETCHED = 1.1


def drift(t, y):
    """y = t + constant: no step is too long."""
    return np.ones(1)


def longest(sol):
    return np.abs(np.diff(sol.t)).max()


def same(a, b):
    return np.array_equal(a.t, b.t) and np.array_equal(a.y, b.y)


@families
def test_without_a_limit_steps_grow_beyond_a_tenth(method):
    """In every way in, bit for bit as with an infinite max_step."""
    free = iv.solve_ivp(drift, SPAN, [0.0], method, max_step=np.inf)
    assert longest(free) > STRETCHED * TENTH
    assert same(iv.solve_ivp(drift, SPAN, [0.0], method), free)
    problem = iv.Problem(drift, SPAN, [0.0])
    assert same(problem.solve(method), free)
    assert same(problem.prepare(method)(), free)
    assert problem.solve_ensemble([[0.0]], method, workers=1).stats.steps[0] == free.stats.steps
    in_scipy = scipy.integrate.solve_ivp(drift, SPAN, [0.0], method=getattr(plugin, method.upper()))
    np.testing.assert_array_equal(in_scipy.t, free.t)


def test_functions_with_names_of_matlab_keep_its_limit(method):
    """Theirs alone: METHODS says which."""
    own = iv.METHODS[method].max_step
    assert own == ("tenth" if method.startswith("ode") else np.inf)
    sol = getattr(iv, method)(drift, SPAN, [0.0], refine=1)
    assert same(sol, iv.solve_ivp(drift, SPAN, [0.0], method, max_step=own))
    assert (longest(sol) <= STRETCHED * TENTH) == (own == "tenth")
    assert inspect.signature(getattr(iv, method)).parameters["max_step"].default == own
    assert longest(getattr(iv, method)(drift, SPAN, [0.0], refine=1, max_step=np.inf)) > STRETCHED * TENTH


@families
def test_a_tenth_is_that_of_the_interval(method):
    """The interval is the one that is solved: another one of a prepared solver, the whole one of an extension."""
    problem = iv.Problem(drift, SPAN, [0.0])
    sol = problem.solve(method, max_step="tenth")
    assert same(sol, problem.solve(method, max_step=TENTH))
    other = (5.0, -15.0)
    prepared = problem.prepare(method, max_step="tenth")(t_span=other)
    assert same(prepared, problem.replace(t_span=other).solve(method, max_step=2.0))
    longer = sol.extend(2 * SPAN[1])
    assert TENTH * STRETCHED < longest(longer) <= STRETCHED * (2 * SPAN[1] - SPAN[0]) / 10
    endless = iv.Event(lambda t, y: t - 40.0, terminal=True)
    free = iv.solve_ivp(drift, (0, np.inf), [0.0], method, max_step="tenth", events=endless)
    assert same(free, iv.solve_ivp(drift, (0, np.inf), [0.0], method, events=endless))


def test_odeint_has_no_limit_either():
    limited = iv.odeint(lambda y, t: [1.0], [0.0], SPAN, hmax=TENTH, full_output=True)[1]
    free = iv.odeint(lambda y, t: [1.0], [0.0], SPAN, full_output=True)[1]
    assert free["nst"][-1] < limited["nst"][-1]
    landing = iv.ode45(drift, (0, 2.09), [0.0], max_step=1.0, first_step=1.0, refine=1)
    np.testing.assert_array_equal(landing.t, [0, 1, 2.09])  # to land, a step may be a tenth longer


@pytest.mark.parametrize("wrong", ["third", "", "Tenth"])
def test_another_word_is_refused(wrong):
    with pytest.raises(
        ValueError, match=f"max_step must be a positive number or 'tenth', of the interval; got '{wrong}'"
    ):
        iv.solve_ivp(drift, SPAN, [0.0], max_step=wrong)
