"""Wrong arguments are refused at the call, by name, with the value and what was expected."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from problems import cost_of_pair


def decay(t, y):
    return [-v for v in y]


def energy(t, y):
    return y[0]


CALLS = {
    "fun": (dict(fun=3), TypeError, r"fun must be a function f\(t, y\), got 3"),
    "t_span number": (dict(t_span=3), ValueError, "t_span must be a pair"),
    "t_span NaN": (dict(t_span=(0, np.nan)), ValueError, r"t_span\[1\] must not be NaN"),
    "t_span infinite start": (dict(t_span=(-np.inf, 0)), ValueError, r"t_span\[0\] must be finite"),
    "t_span text": (dict(t_span=("a", 1)), TypeError, r"t_span\[0\] must be a real number, got 'a'"),
    "y0 text": (dict(y0=["a"]), TypeError, "y0 must hold numbers"),
    "y0 inf": (dict(y0=[1, np.inf]), ValueError, r"y0 must be finite, got y0\[1\] = inf"),
    "rtol text": (dict(rtol="small"), TypeError, "rtol must be a number"),
    "rtol NaN": (dict(rtol=np.nan), ValueError, "rtol must be finite"),
    "atol inf": (dict(atol=np.inf), ValueError, "atol must be finite"),
    "atol matrix": (dict(atol=[[1.0]]), ValueError, "atol must be a number or have shape"),
    "t_eval text": (dict(t_eval=["a"]), TypeError, "t_eval must hold real numbers"),
    "t_eval NaN": (dict(t_eval=[np.nan]), ValueError, "t_eval must lie within"),
    "dense_output": (dict(dense_output="yes"), TypeError, "dense_output must be True or False"),
    "check": (dict(check=1), TypeError, "check must be True or False"),
    "refine 0": (dict(refine=0), ValueError, "refine must be a positive integer"),
    "refine float": (dict(refine=2.5), TypeError, "refine must be a positive integer"),
    "interpolation": (dict(interpolation="projcted"), ValueError, "did you mean 'projected'"),
    "fsal": (dict(fsal=True, method="ode45"), ValueError, "fsal must be one of 'reuse', 'evaluate', got True"),
    "save": (dict(save="last"), ValueError, "save must be one of 'all', 'outputs', 'end'"),
    "save and t_eval": (dict(save="end", t_eval=[1.0]), ValueError, "t_eval and dense_output need"),
    "save and dense": (dict(save="end", dense_output=True), ValueError, "t_eval and dense_output need"),
    "callback": (dict(callback=3), TypeError, "callback must be a function"),
    "unknown option": (dict(rtoll=1e-3), TypeError, "unknown option 'rtoll'; did you mean 'rtol'"),
    "far unknown option": (dict(zzz=1), TypeError, "unknown option 'zzz'$"),
    "method": (dict(method="ode46"), ValueError, "unknown method 'ode46'; did you mean 'ode45'"),
    "method type": (dict(method=45), TypeError, "method must be the name of a method"),
    "events": (dict(events={}), TypeError, "events must be a function"),
    "invariants": (dict(invariants=3), TypeError, r"invariants must be a function g\(t, y\)"),
    "invariants text": (dict(invariants="energy"), TypeError, "invariants must be"),
    "invariant None": (dict(invariants=lambda t, y: None), ValueError, "invariant g returned None"),
    "invariant complex": (dict(invariants=lambda t, y: 1j), ValueError, "expected a real number"),
    "y0 ragged": (dict(y0=[1, [2, 3]]), ValueError, "y0 must be a number or an array .*, with rows of equal length"),
    "y0 digits": (dict(y0=["1", "2"]), TypeError, "y0 must hold numbers"),
    "y0 dates": (dict(y0=np.array(["2020-01-01"], "M8[D]")), TypeError, "y0 must hold numbers"),
    "y0 with None": (dict(y0=[None, 1.0]), TypeError, "y0 must hold numbers"),
    "y0 set": (dict(y0={1.0}), ValueError, r"y0 must be 1-dimensional, got shape \(\): {1.0}"),
    "y0 huge": (dict(y0=[10**400]), ValueError, "y0 must be within the range of a double"),
    "t_span huge": (dict(t_span=(0, 10**9999)), ValueError, r"t_span\[1\] must be within .* got an integer of 332"),
    "t_span array": (dict(t_span=(0, np.ones(1))), TypeError, r"t_span\[1\] must be a real number"),
    "rtol ragged": (dict(rtol=[[1], [1, 2]]), ValueError, "rtol must be a number or an array of numbers, with rows"),
    "rtol None": (dict(rtol=None), TypeError, "rtol must be a number or 2 numbers, got None"),
    "t_eval ragged": (dict(t_eval=[[1], [1, 2]]), ValueError, "t_eval must be a number or an array of numbers"),
    "max_step text": (dict(max_step="1"), TypeError, "max_step must be a real number, got '1'"),
    "first_step array": (dict(first_step=np.ones(1)), TypeError, "first_step must be a real number"),
    "refine 2³¹": (dict(refine=2**31), ValueError, "refine must be at most 2147483647, got 2147483648"),
    "dense_output array": (dict(dense_output=np.array([1, 0])), TypeError, r"True or False, got array\(\[1, 0\]\)"),
    "vectorized text": (dict(vectorized="x"), TypeError, "vectorized must be True or False, got 'x'"),
    "vectorized array": (dict(vectorized=np.array([1, 0])), TypeError, "vectorized must be True or False"),
    "invariant ragged": (dict(invariants=lambda t, y: [1, [2, 3]]), ValueError, "what invariant g returns must be"),
    "invariant huge": (dict(invariants=lambda t, y: 10**400), ValueError, "what invariant g returns must be within"),
    "invariant empty": (dict(invariants=lambda t, y: []), ValueError, "invariant g returned shape"),
}


@pytest.mark.parametrize("name", CALLS)
def test_refused(name):
    """These checks come before the method starts: one method is enough."""
    changed, error, message = CALLS[name]
    with pytest.raises(error, match=message):
        iv.solve_ivp(**{"fun": decay, "t_span": (0, 2), "y0": [1, 2]} | changed)


@pytest.mark.parametrize("name", [name for name in CALLS if name.startswith("invariant ")])
def test_values_of_invariants_are_refused_in_every_method(method, name):
    """What g returns shows when it is called."""
    changed, error, message = CALLS[name]
    with pytest.raises(error, match=message):
        iv.solve_ivp(decay, (0, 2), [1, 2], method, **changed)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (dict(fun=3), TypeError, "the invariant must be a function"),
        (dict(fun=energy, jac=3), TypeError, "jac of the invariant must be a function"),
        (dict(fun=energy, value="a"), TypeError, "value of an invariant must be a number"),
        (dict(fun=energy, value=np.nan), ValueError, "value of an invariant must be finite"),
        (dict(fun=energy, value=[[1.0]]), ValueError, r"of shape \(m,\)"),
        (dict(fun=energy, names=3), TypeError, "names"),
        (dict(fun=energy, names=[1]), TypeError, "names of invariants must be str"),
        (dict(fun=energy, iterations=0), ValueError, "iterations must be a positive integer"),
        (dict(fun=energy, iterations=2**31), ValueError, "iterations must be at most 2147483647"),
        (dict(fun=energy, value=[]), ValueError, r"of shape \(m,\) with m >= 1, got \[\]"),
        (dict(fun=energy, names=[]), ValueError, "names of an invariant must be one str for each of its values"),
        (dict(fun=energy, value=[1, [2, 3]]), ValueError, "value of an invariant must be .* rows of equal length"),
    ],
)
def test_refused_invariants(arguments, error, message):
    with pytest.raises(error, match=message):
        iv.Invariants(**arguments)


def test_sizes_that_show_only_with_the_problem():
    with pytest.raises(ValueError, match=r"value of invariant energy must have shape \(1,\)"):
        iv.solve_ivp(decay, (0, 1), [1, 2], invariants=iv.Invariants(energy, value=[1, 2]))
    with pytest.raises(ValueError, match="returns 1 values and has 2 names"):
        iv.solve_ivp(decay, (0, 1), [1, 2], invariants=iv.Invariants(energy, names=["a", "b"]))


def test_mass_needs_a_method_that_can_use_it(method):
    if "mass" in iv.METHODS[method].options:
        assert iv.solve_ivp(decay, (0, 2), [1, 2], method, mass=np.eye(2)).success
    else:
        with pytest.raises(ValueError, match="explicit and cannot use a mass matrix; use ode15s"):
            iv.solve_ivp(decay, (0, 2), [1, 2], method, mass=np.eye(2))


def test_problem():
    with pytest.raises(TypeError, match="invariants describes the problem"):
        iv.Problem(decay, (0, 1), [1, 2]).solve(invariants=energy)
    with pytest.raises(ValueError, match="labels must name the 2 components"):
        iv.Problem(decay, (0, 1), [1, 2], labels=["x"])
    problem = iv.Problem(decay, (0, 1), [1, 2], name="decay", labels=["a", "b"])
    assert repr(problem) == "Problem('decay', t_span=(0.0, 1.0), n=2)"
    np.testing.assert_array_equal(problem.solve("ode23").y, iv.solve_ivp(decay, (0, 1), [1, 2], "ode23").y)


def test_y0_is_copied():
    y0 = np.array([1.0, 2.0])
    problem = iv.Problem(decay, (0, 1), y0)
    y0[:] = 5
    np.testing.assert_array_equal(problem.y0, [1, 2])
    problem.solve()
    np.testing.assert_array_equal(problem.y0, [1, 2])


def test_refine_that_has_no_effect_is_warned_of(method):
    with pytest.warns(UserWarning, match="refine has no effect together with t_eval"):
        iv.solve_ivp(decay, (0, 1), [1, 2], method, refine=3, t_eval=[0.5])


def test_warnings_point_at_the_caller():
    with pytest.warns(UserWarning) as warned:
        iv.solve_ivp(decay, (0, 1), [1, 2], rtol=1e-20)
        iv.solve_ivp(decay, (0, 1), [1, 2], jac=3)
        iv.solve_ivp(decay, (0, 1), [1, 2], refine=3, t_eval=[0.5])
        iv.ode45(decay, (0, 1), [1, 2], rtol=1e-20)
        iv.Problem(decay, (0, 1), [1, 2]).solve(rtol=1e-20)
    assert [w.filename for w in warned] == [__file__] * 5


def test_pure_relative_control_at_zero_is_explained(method):
    """atol = 0 at a component that starts at 0 and leaves: no step is small enough, and the message says why."""
    sol = iv.solve_ivp(lambda t, y: [np.cos(t + y[0])], (0, 1), [0.0], method, atol=0)
    if sol.status == -1:
        assert "pure relative error control is impossible" in sol.message
    kept = iv.solve_ivp(lambda t, y: [0.0, -y[1]], (0, 1), [0, 1], method, atol=0)
    assert kept.success  # a zero error counts as 0


def test_repr_and_iteration():
    sol = iv.solve_ivp(decay, (0, 1), [1, 2], dense_output=True, events=energy)
    text = repr(sol)
    assert "message: The solver successfully reached" in text
    assert "array of shape (2, " in text
    assert "_rtol" not in text
    assert set(dict(sol)) == set(sol.keys())
    assert sol.stats["steps"] == sol.stats.steps == len(sol.steps.t) == len(sol.t) - 1
    end = iv.solve_ivp(decay, (0, 1), [1, 2], save="end")
    assert end.steps is None
    assert end.t.tolist() == [1]
    with pytest.raises(ValueError, match="corrections"):
        _ = end.correction
    with pytest.raises(ValueError, match="had no invariants"):
        sol.impose()
    assert sol.residual.shape == (0, len(sol.t))


def test_registry():
    for name, method in iv.METHODS.items():
        assert name == method.name
        assert method.source
        assert getattr(iv, name)(decay, (0, 1), [1, 2]).success
        sol = iv.solve_ivp(decay, (0, 1), [1, 2], name)
        if method.stages:
            assert sol.nfev == cost_of_pair(sol, name)
            looked_into = iv.solve_ivp(decay, (0, 1), [1, 2], name, refine=2)
            assert looked_into.nfev == sol.nfev + method.extra * sol.stats.steps
        assert method.min_order <= sol.steps.order.min() <= sol.steps.order.max() <= method.order
    with pytest.raises(TypeError):
        iv.METHODS["new"] = None


def test_no_equations_have_a_solution_at_all_times_asked_for():
    def fun(t, y):
        return []

    assert iv.solve_ivp(fun, (0, 1), []).t.tolist() == [0, 1]
    assert iv.solve_ivp(fun, (0, 1), [], t_eval=[0, 0.5, 1]).t.tolist() == [0, 0.5, 1]
    assert iv.solve_ivp(fun, (0, 1), [], t_eval=[]).y.shape == (0, 0)
    assert iv.solve_ivp(fun, (0, 1), [], save="end").t.tolist() == [1]
    dense = iv.solve_ivp(fun, (0, 1), [], dense_output=True)
    assert dense.extend(2).sol([0.5, 1.5]).shape == (0, 2)


def test_an_empty_state_may_have_a_jacobian():
    asked = []

    def jac(t, y):
        asked.append(len(y))
        return np.zeros((0, 0))

    for given in ({"jac": jac}, {"jac": np.zeros((0, 0))}, {"lband": 0, "uband": 0}, {"mass": np.zeros((0, 0))}):
        assert iv.solve_ivp(lambda t, y: y, (0, 1), [], "ode15s", **given).t.tolist() == [0, 1]
    assert set(asked) == {0}


EVENTS = {
    "terminal 2⁶³": (dict(terminal=2**63), ValueError, r"terminal of event must be .* below 2\*\*53"),
    "terminal inf": (dict(terminal=np.inf), ValueError, "terminal of event must be a boolean or a positive integer"),
    "terminal half": (dict(terminal=1.5), ValueError, "terminal of event must be"),
    "terminal text": (dict(terminal="yes"), ValueError, "terminal of event must be .* got 'yes'"),
    "terminal array": (dict(terminal=np.array([1, 0])), ValueError, r"terminal of event must be .* got array\("),
    "direction NaN": (dict(direction=np.nan), ValueError, "direction of event must not be NaN"),
    "direction array": (dict(direction=np.ones(2)), TypeError, "direction of event must be a real number"),
    "direction None": (dict(direction=None), TypeError, "direction of event must be a real number"),
    "rehold array": (dict(rehold=np.ones(2)), TypeError, "rehold must be True or False"),
}


@pytest.mark.parametrize("name", EVENTS)
def test_refused_events(name):
    changed, error, message = EVENTS[name]
    with pytest.raises(error, match=message):
        iv.solve_ivp(decay, (0, 1), [1.0], events=iv.Event(lambda t, y: y[0], **changed))


PROBLEMS = {
    "labels number": (dict(labels=3), TypeError, "labels must be a list of 2 str, got 3"),
    "labels numbers": (dict(labels=[1, 2]), TypeError, "labels must be a list of 2 str"),
    "labels lists": (dict(labels=[["a"], ["b"]]), TypeError, "labels must be a list of 2 str"),
    "labels text": (dict(labels="ab"), TypeError, "labels must be a list of 2 str"),
    "labels missing": (dict(labels=["a"]), ValueError, "labels must name the 2 components"),
    "labels twice": (dict(labels=["a", "a"]), ValueError, "labels must differ"),
    "name": (dict(name=3), TypeError, "name of the problem must be a str, got 3"),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_refused_problems(name):
    changed, error, message = PROBLEMS[name]
    with pytest.raises(error, match=message):
        iv.Problem(decay, (0, 1), [1.0, 2.0], **changed)


@pytest.mark.parametrize("none", [[], None, [None]], ids=repr)
def test_something_must_be_there_to_look_at(none):
    """Nothing to check or to impose is an error, and no read through null pointers."""
    with pytest.raises(ValueError, match="check_invariants needs at least one invariant"):
        iv.check_invariants(decay, none, 0, [1.0])
    with pytest.raises(ValueError, match="impose needs at least one invariant"):
        iv.impose(none, 0, [1.0])


@pytest.mark.parametrize(("t", "y", "message"), [
    (0, [], r"y must have shape \(n,\) or \(n, n_t\) with n >= 1, got \(0,\)"),
    (0, [[1], [2, 3]], "y must be .* with rows of equal length"),
    (0, 1.0, r"y must have shape"),
    (np.nan, [1.0], "t must be finite"),
    ([0, 1], [1.0], "t must have one time per point"),
])  # fmt: skip
def test_refused_points(t, y, message):
    with pytest.raises(ValueError, match=message):
        iv.impose(energy, t, y)


def test_times_of_dense_output_are_numbers():
    sol = iv.solve_ivp(decay, (0, 1), [1.0], dense_output=True).sol
    for wrong, error in (([1, [2, 3]], ValueError), ("1", TypeError), (None, TypeError), (1j, TypeError)):
        with pytest.raises(error, match=r"^t must"):
            sol(wrong)
