"""Wrong arguments are refused at the call, by name, with the value and what was expected."""

from __future__ import annotations

import copy
import pickle
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy

import invariode as iv
from cases import METHODS, explicit_and_implicit
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
    "y0 inf": (
        dict(y0=[1, np.inf]),
        ValueError,
        r"All components of the initial state `y0` must be finite, got y0\[1\] = inf",
    ),
    "rtol text": (dict(rtol="small"), TypeError, "rtol must be a number"),
    "rtol NaN": (dict(rtol=np.nan), ValueError, "rtol must be finite"),
    "atol inf": (dict(atol=np.inf), ValueError, "atol must be finite"),
    "atol matrix": (dict(atol=[[1.0]]), ValueError, "atol must be a number or have shape"),
    "t_eval text": (dict(t_eval=["a"]), TypeError, "t_eval must hold real numbers"),
    "t_eval NaN": (dict(t_eval=[np.nan]), ValueError, "Values in `t_eval` are not within"),
    "dense_output": (dict(dense_output="yes"), TypeError, "dense_output must be True or False"),
    "check": (dict(check=1), TypeError, 'check must be True, False or "strict"'),
    "refine 0": (dict(refine=0), ValueError, "refine must be a positive integer"),
    "refine float": (dict(refine=2.5), TypeError, "refine must be a positive integer"),
    "interpolation": (dict(interpolation="projcted"), ValueError, "did you mean 'projected'"),
    "fsal": (dict(fsal=True, method="ode45"), ValueError, "fsal must be one of 'reuse', 'evaluate', got True"),
    "keep": (dict(keep="last"), ValueError, "keep must be one of 'all', 'outputs', 'end'"),
    "keep and t_eval": (dict(keep="end", t_eval=[1.0]), ValueError, "t_eval, dense_output and adjoint=True need"),
    "keep and dense": (dict(keep="end", dense_output=True), ValueError, "t_eval, dense_output and adjoint=True need"),
    "callback": (dict(callback=3), TypeError, "callback must be a function"),
    "unknown option": (dict(rtoll=1e-3), TypeError, "unknown option 'rtoll'; did you mean 'rtol'"),
    "far unknown option": (dict(zzz=1), TypeError, "unknown option 'zzz'$"),
    "method": (dict(method="ode46"), ValueError, "unknown method 'ode46'; did you mean 'ode45'"),
    "method type": (dict(method=45), TypeError, "`method` must be one of .*, by name; got 45"),
    "events": (dict(events=3), TypeError, "events must be a function"),
    "invariants": (dict(invariants=3), TypeError, r"invariants must be a function g\(t, y\)"),
    "invariants: key": (dict(invariants={3: decay}), TypeError, "keys of a dict of invariants are their names"),
    "invariants: value": (dict(invariants={"a": 3}), TypeError, "'a' must be a function"),
    "invariants: names": (dict(invariants={"a": iv.Invariants(decay, names="b")}), ValueError, "names of its own: b"),
    "invariants text": (dict(invariants="energy"), TypeError, "invariants must be"),
    "invariant None": (dict(invariants=lambda t, y: None), ValueError, "invariant g returned None"),
    "invariant complex": (dict(invariants=lambda t, y: 1j), ValueError, "expected a real number"),
    "y0 ragged": (dict(y0=[1, [2, 3]]), ValueError, "y0 must be a number or an array .*, with rows of equal length"),
    "y0 digits": (dict(y0=["1", "2"]), TypeError, "y0 must hold numbers"),
    "y0 dates": (dict(y0=np.array(["2020-01-01"], "M8[D]")), TypeError, "y0 must hold numbers"),
    "y0 with None": (dict(y0=[None, 1.0]), TypeError, "y0 must hold numbers"),
    "y0 set": (dict(y0={1.0}), ValueError, r"`y0` must be 1-dimensional, got shape \(\): {1.0}"),
    "y0 number": (dict(y0=1.0), ValueError, r"got shape \(\): 1.0; a list or an array of numbers, for one component"),
    "y0 column": (dict(y0=[[1], [2]]), ValueError, r"got shape \(2, 1\): .*; numpy.ravel makes it so"),
    "t_eval number": (
        dict(t_eval=100),
        ValueError,
        r"the times themselves, as in numpy.linspace\(t0, tf, 101\), got 100",
    ),
    "args text": (dict(args="2"), TypeError, r"give a tuple of the extra arguments, for one args=\('2',\)"),
    "events text": (
        dict(events="zero"),
        TypeError,
        r"events must be a function event\(t, y\) or a list .*, got 'zero'",
    ),
    "event lambda": (dict(events=lambda t, y: y), ValueError, r"^event returned shape \(2,\)"),
    "fixed steps": (dict(method="rk4"), ValueError, "'rk4'; there are no methods of fixed step. `method` must"),
    "y0 huge": (dict(y0=[10**400]), ValueError, "y0 must be within the range of a double"),
    "t_span huge": (dict(t_span=(0, 10**9999)), ValueError, r"t_span\[1\] must be within .* got an integer of 332"),
    "t_span array": (dict(t_span=(0, np.ones(1))), TypeError, r"t_span\[1\] must be a real number"),
    "rtol ragged": (dict(rtol=[[1], [1, 2]]), ValueError, "rtol must be a number or an array of numbers, with rows"),
    "rtol None": (dict(rtol=None), TypeError, "rtol must be a number or 2 numbers, got None"),
    "t_eval ragged": (dict(t_eval=[[1], [1, 2]]), ValueError, "t_eval must be a number or an array of numbers"),
    "max_step text": (
        dict(max_step="1"),
        ValueError,
        "max_step must be a positive number or 'tenth', of the interval; got '1'",
    ),
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


@explicit_and_implicit
@pytest.mark.parametrize("name", [name for name in CALLS if name.startswith("invariant ")])
def test_values_of_invariants_are_refused_in_every_method(method, name):
    """The values of g show when it is called."""
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
        (dict(fun=energy, level=2**64), ValueError, "level of an invariant must be an integer from 0 to 2147483647"),
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
        iv.solve_ivp(decay, (0, 1), [1, 2], jac=np.eye(2))
        iv.solve_ivp(decay, (0, 1), [1, 2], refine=3, t_eval=[0.5])
        iv.ode45(decay, (0, 1), [1, 2], rtol=1e-20)
        iv.Problem(decay, (0, 1), [1, 2]).solve(rtol=1e-20)
    assert [w.filename for w in warned] == [__file__] * 5


@explicit_and_implicit
def test_pure_relative_control_at_zero_is_explained(method):
    """atol = 0 at a component that starts at 0 and leaves: no step is small enough, and the message says why."""
    sol = iv.solve_ivp(lambda t, y: [np.cos(t + y[0])], (0, 1), [0.0], method, atol=0)
    if sol.status == -1:
        assert "pure relative error control is impossible" in sol.message
    kept = iv.solve_ivp(lambda t, y: [0.0, -y[1]], (0, 1), [0, 1], method, atol=0)
    assert kept.success  # a zero error counts as 0


def test_a_dict_gives_invariants_their_names():
    """In their order, without a change of what is given; the run is that of the list."""
    angle, length = (lambda t, y: y[0] ** 2 + y[1] ** 2), iv.Invariants(lambda t, y: y @ y, when="needed")
    problem = iv.Problem(lambda t, y: [y[1], -y[0], 0.0], (0, 5), [1.0, 0.0, 1.0])
    sol = problem.replace(invariants={"angle": angle, "length": length}).solve()
    assert sol.drift().names == ["angle", "length"]
    assert length.names is None
    np.testing.assert_array_equal(sol.y, problem.replace(invariants=[angle, length]).solve().y)
    assert "radius" in str(iv.check_invariants(problem.fun, {"radius": angle}, 0, problem.y0))


def test_a_solution_says_what_gives_its_continuous_solution():
    assert "dense_output=True" in repr(iv.ode45(decay, (0, 1), [1.0]))
    assert "dense_output=True" not in repr(iv.ode45(decay, (0, 1), [1.0], dense_output=True))


def test_repr_and_iteration():
    sol = iv.solve_ivp(decay, (0, 1), [1, 2], dense_output=True, events=energy)
    text = repr(sol)
    assert "message: The solver successfully reached" in text
    assert "array of shape (2, " in text
    assert "_rtol" not in text
    assert set(dict(sol)) == set(sol.keys())
    assert sol.stats["steps"] == sol.stats.steps == len(sol.steps.t) == len(sol.t) - 1
    end = iv.solve_ivp(decay, (0, 1), [1, 2], keep="end")
    assert end.steps is None
    assert end.t.tolist() == [1]
    with pytest.raises(ValueError, match="corrections"):
        _ = end.correction
    with pytest.raises(ValueError, match="had no invariants"):
        sol.impose()
    assert sol.residual.shape == (0, len(sol.t))


def test_registry():
    for name, method in METHODS.items():
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
    assert iv.solve_ivp(fun, (0, 1), [], keep="end").t.tolist() == [1]
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
    "terminal 2⁶³": (dict(terminal=2**63), ValueError, r"each event must be .* below 2\*\*53"),
    "terminal inf": (
        dict(terminal=np.inf),
        ValueError,
        "each event must be a boolean or positive integer, .*; that of event is inf",
    ),
    "terminal half": (dict(terminal=1.5), ValueError, "that of event is 1.5"),
    "terminal text": (dict(terminal="yes"), ValueError, "that of event is 'yes'"),
    "terminal array": (dict(terminal=np.array([1, 0])), ValueError, r"that of event is array\("),
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


class TestProblemsDoNotChange:
    def test_an_argument_is_changed_by_replace_only(self):
        problem = iv.Problem(decay, (0, 1), [1, 2])
        for name in ("jac", "y0", "t_span", "args", "fun"):
            with pytest.raises(AttributeError, match=rf"does not change, and {name} cannot be set: .*replace\({name}="):
                setattr(problem, name, None)
        with pytest.raises(AttributeError, match="it has only its arguments"):
            problem.colour = "red"
        with pytest.raises(AttributeError, match="cannot be deleted"):
            del problem.y0
        with pytest.raises(ValueError, match="read-only"):
            problem.y0[0] = 3.0
        assert problem.replace(y0=[3, 4]).solve().y[:, 0].tolist() == [3, 4]
        assert pickle.loads(pickle.dumps(problem)).y0.tolist() == copy.deepcopy(problem).y0.tolist() == [1, 2]

    def test_another_start_has_all_that_is_not_the_start_of_the_problem(self):
        """By the short way too, which reads nothing else again."""
        given = [
            {"invariants": lambda t, y, k: y[0] / y[1], "labels": ["a", "b"], "name": "closed"},
            {"events": lambda t, y, k: y[0] - 1.5, "bounds": (-10.0, 10.0)},
            {"nonnegative": [1], "breakpoints": {0.5: lambda t, y, k: 2 * y}},
            {"jac": [[-1.0, 0.0], [0.0, -1.0]], "mass": [[1.0, 0.0], [0.0, 2.0]]},
            {"inputs": iv.Input([0.0, 1.0], [1.0, 2.0])},
            {"sensitivities": True},
        ]
        for more in given:
            fun = (lambda t, y, u, k: [-k * u * y[0], k * y[1]]) if "inputs" in more else (lambda t, y, k: -k * y)
            problem = iv.Problem(fun, (0, 1), [1.0, 2.0], args=(1.0,), **more)
            for changes in ({"y0": [2.0, 1.0]}, {"args": (3.0,)}, {"y0": [2, 1], "args": (0.5,)}, {}):
                anew = iv.Problem(fun, (0, 1), **{"y0": [1.0, 2.0], "args": (1.0,), **more, **changes})
                sols = [
                    one.solve("ode15s" if "mass" in more else "ode45") for one in (problem.replace(**changes), anew)
                ]
                assert len({(one.y.tobytes(), repr(one), one.stats.nfev) for one in sols}) == 1
        problem = iv.Problem(fun, (0, 1), [1.0, 2.0], args=(1.0,), labels=["a", "b"], bounds=(-1.0, 5.0))
        for wrong, error in (({"y0": [1.0]}, "labels"), ({"y0": [1j, 2.0]}, "bounds"), ({"y0": [np.nan, 1.0]}, "y0")):
            with pytest.raises(ValueError, match=error):
                problem.replace(**wrong)
        assert problem.replace(args=None).args == ()
        assert problem.replace(args={"k": 2}).args == (2,)

    def test_a_fourth_argument_by_position_is_refused_by_the_name_that_users_know(self):
        with pytest.raises(TypeError, match=r"^Problem takes fun, t_span and y0 by position .* got \(1,\) as a fourth"):
            iv.Problem(decay, (0, 1), [1, 2], (1,))
        missing = r"^Problem\.__init__\(\) missing {} required positional arguments: .*'t_span'(,|) and 'y0'"
        for given, count in (((), 3), ((decay,), 2)):
            with pytest.raises(TypeError, match=missing.format(count)):
                iv.Problem(*given)
        with pytest.raises(TypeError, match=r"^Problem\.replace\(\) takes 1 positional argument"):
            iv.Problem(decay, (0, 1), [1, 2]).replace([1, 0])


MATRICES = {
    "jac word": (
        dict(jac="garbage"),
        "jac must be a function, a matrix, 'trace', 'complex-step' or 'differences', got 'garbage'",
    ),
    "jac shape": (dict(jac=np.eye(3)), r"jac has shape \(3, 3\), expected shape \(2, 2\)"),
    "lband negative": (dict(lband=-7), "lband must be a bandwidth, an integer from 0 to 1, got -7"),
    "uband huge": (dict(uband=10**5000), "uband must be a bandwidth, .* got an integer of 16610 bits"),
    "pattern number": (dict(jac_sparsity=3), r"jac_sparsity has shape \(1, 1\), expected shape \(2, 2\)"),
    "pattern word": (dict(jac_sparsity="dens"), "jac_sparsity must be a matrix, 'detect' or 'dense', got 'dens'"),
    "pattern and bands": (dict(jac_sparsity=np.eye(2), lband=1), "give either jac_sparsity or lband and uband"),
    "mass shape": (dict(mass=np.eye(3)), r"mass has shape \(3, 3\), expected shape \(2, 2\)"),
}


@pytest.mark.filterwarnings("ignore:option")
@pytest.mark.parametrize("name", MATRICES)
def test_wrong_matrices_are_refused_whatever_the_method_uses(name):
    """A method without Jacobians, one with, and none at all."""
    wrong, message = MATRICES[name]
    for method in ("ode45", "ode15s"):
        with pytest.raises(ValueError, match=message):
            iv.solve_ivp(decay, (0, 2), [1, 2], method, **wrong)
    with pytest.raises(ValueError, match=message):
        iv.Problem(decay, (0, 2), [1, 2], **wrong)


class TestBlame:
    """The note about args is given for a call that failed, not for whatever failed in a function."""

    @staticmethod
    def notes(error):
        return " ".join(getattr(error.value, "__notes__", ()))

    def test_errors_inside_of_a_function_are_its_own(self):
        def failing(t, y, a):
            return len(a)

        with pytest.raises(TypeError, match="has no len") as raised:
            iv.solve_ivp(failing, (0, 1), [1.0], args=(1,), events=lambda t, y: 1.0)
        assert self.notes(raised) == ""

    def test_a_call_without_args_is_explained(self):
        """A function of other parameters than t and y is named, whichever of the problem's it is."""
        wrong = {
            "fun": dict(fun=lambda t, y, k: y),
            "event": dict(events=lambda y: y[0]),
            "invariant g": dict(invariants=lambda y: y),
        }
        for name, given in wrong.items():
            with pytest.raises(TypeError, match="positional argument") as raised:
                iv.solve_ivp(**{"fun": decay, "t_span": (0, 1), "y0": [1.0, 2.0], **given})
            assert self.notes(raised) == f"{name}: called with t and y alone; args=(a, b) passes further arguments"
        with pytest.raises(TypeError, match="positional argument") as raised:  # as MATLAB's OutputFcn
            iv.solve_ivp(decay, (0, 1), [1.0, 2.0], callback=lambda t, y, flag: False)
        assert self.notes(raised).startswith("callback: called with t and y alone")

    def test_a_function_without_args_is_named(self):
        def level(t, y):
            return y[0]

        with pytest.raises(TypeError, match="positional arguments") as raised:
            iv.solve_ivp(lambda t, y, a: [a], (0, 1), [1.0], args=(1,), events=level)
        assert "event level does not take them" in self.notes(raised)

    def test_inputs_are_arguments_too(self):
        def level(t, y):
            return y[0]

        problem = iv.Problem(
            lambda t, y, u, a: [a * u], (0, 1), [1.0], args=(1,), events=level, inputs=iv.Input([0], [1.0])
        )
        with pytest.raises(TypeError) as raised:
            problem.solve()
        assert "and event level does not take them" in self.notes(raised)
        assert "fun" not in self.notes(raised).partition("events, and")[2]

    def test_a_compiled_f_of_another_length_is_told_so(self):
        pytest.importorskip("numba")
        for n, fun in ((1, lambda t, y: np.ones(1)), (3, lambda t, y: [1.0, 2.0, 3.0])):
            with pytest.raises(ValueError, match=rf"returned {n} values? at t = 0\.0, expected 2, one for each"):
                iv.solve_ivp(iv.compile(fun), (0, 1), [1, 2])

    def test_mechanisms_have_a_name_of_their_own(self):
        ball = iv.MechanicalSystem([1.0], lambda t, q, v: [-9.81])
        assert ball.problem((0, 1), [1.0], [0.0]).name == "mechanism"


class TestShapesOfScipy:
    """SciPy's for what did not occur."""

    def test_events(self):
        def never(t, y):
            return y[0] + 10

        for events in (None, [], [never]):
            theirs = scipy.integrate.solve_ivp(decay, (0, 1), [1, 2], events=events)
            ours = iv.solve_ivp(decay, (0, 1), [1, 2], events=events)
            again = iv.Problem(decay, (0, 1), [1, 2], events=events).replace(y0=[1, 2]).solve()
            for name in ("t_events", "y_events"):
                for sol in (ours, again):
                    if theirs[name] is None:
                        assert sol[name] is None
                    else:
                        assert [one.shape for one in sol[name]] == [one.shape for one in theirs[name]]

    def test_what_did_not_occur_joins_what_does(self):
        sol = iv.solve_ivp(lambda t, y: [1.0, 0.0], (0, 1), [0, 0], events=lambda t, y: y[0] - 1.5, invariants=second)
        assert sol.y_events[0].shape == (0,)
        assert sol.impose().y_events[0].shape == (0,)
        assert sol.to_xarray()["y_events_event"].shape == (0, 2)
        assert sol.extend(2).y_events[0].shape == (1, 2)

    def test_no_components(self):
        sol = iv.solve_ivp(lambda t, y: [], (0, 1), [])
        assert sol.plot().lines[:] == []
        assert len(sol.to_dataframe()) == 2
        sol.plot_steps()
        plt.close("all")


def second(t, y):
    return y[1]


DEEP: list = []
for _ in range(1000):
    DEEP = [DEEP]
HUGE = 10**5000

#: Calls that raised errors of NumPy, of Python or of the binding.
RAW = {
    "masked y0": (
        (lambda: iv.Problem(decay, (0, 1), np.ma.masked_equal([1.0, 2.0], 2)), "y0 has masked entries"),
        (lambda: iv.solve_ensemble(decay, (0, 1), [[1.0]], args=np.ma.masked_equal([[1.0]], 1)), "args has masked"),
        (lambda: iv.solve_ensemble(decay, (0, 1), [[1.0]], args=[np.ma.masked_equal([1.0], 1)]), "a row of args has"),
    ),
    "masked t_eval": (
        (lambda: iv.ode45(decay, (0, 1), [1], t_eval=np.ma.masked_equal([0, 1], 1)), "t_eval has masked"),
        (lambda: iv.ode45(decay, (0, 1), [1], dense_output=True).sol(np.ma.masked_equal([0.5], 0.5)), "t has masked"),
    ),
    "masked mass": (lambda: iv.ode15s(decay, (0, 1), [1], mass=np.ma.masked_equal([[1]], 1)), "mass has masked"),
    "masked bounds": (lambda: iv.ode45(decay, (0, 1), [1], bounds=(np.ma.masked_equal([0], 0), 1)), "has masked"),
    "masked first_step": (lambda: iv.ode45(decay, (0, 1), [1], first_step=np.ma.masked), "first_step must be a real"),
    "masked args of compiled functions": (
        lambda: iv.ode45(iv.compile(lambda t, y, p: -p[0] * y), (0, 1), [1], args=(np.ma.masked_equal([1.0, 2], 1),)),
        "an array in args has masked entries",
    ),
    "complex first_step": (
        lambda: iv.ode45(decay, (0, 1), [1], first_step=np.complex128(0.1 + 1j)),
        "first_step must be a real number",
    ),
    "t_eval iterator": (lambda: iv.ode45(decay, (0, 1), [1], t_eval=(t for t in (0.5,))), "t_eval must hold real"),
    "breakpoints bytes": (
        lambda: iv.ode45(decay, (0, 1), [1], breakpoints=memoryview(b"ab")),
        "must be a list of times",
    ),
    "direction array": (lambda: iv.Invariants(second, direction=np.ones(2)), "direction must be one of"),
    "moves number": (lambda: iv.Invariants(second, moves=3), "moves must be a list of indices"),
    "moves huge": (lambda: iv.Invariants(second, moves=[HUGE, HUGE]), "moves must list different components"),
    "level huge": (lambda: iv.Invariants(second, level=-HUGE), "level of an invariant must be"),
    "invariants deep": (lambda: iv.ode45(decay, (0, 1), [1], invariants=DEEP), "invariants must be a function"),
    "samples array": (lambda: iv.Event(second, samples=np.ones(2)), "samples of an event must be"),
    "event direction": (
        lambda: iv.ode45(decay, (0, 1), [1], events=iv.Event(second, direction=[1])),
        "direction of second",
    ),
    "indices ragged": (lambda: iv.UnitVector([[0], [1, 2]]), "indices of UnitVector must be"),
    "indices number": (lambda: iv.RotationMatrix(HUGE), "indices of RotationMatrix must be"),
    "name number": (lambda: iv.UnitVector([0, 1], name=3), "name must be one str"),
    "name deep": (lambda: iv.UnitVector([0, 1], name=DEEP), "name must be one str"),
    "nonnegative huge": (lambda: iv.ode45(decay, (0, 1), [1], nonnegative=HUGE), "there is no component an integer of"),
    "lanes huge": (lambda: iv.solve_ensemble(decay, (0, 1), [[1]], lanes=HUGE), 'lanes must be "auto" or 1'),
    "args rows": (lambda: iv.solve_ensemble(decay, (0, 1), [[1]], args=[HUGE]), "args of an ensemble must be"),
    "span": (lambda: iv.find_invariants(decay, (0, float("inf")), [1]), "t_span must be finite"),
    **{
        f"odeint {name}": (lambda name=name: iv.odeint(decay, [1.0], [0, 1], tfirst=True, **{name: np.ones(2)}), name)
        for name in ("full_output", "ml", "mu", "ixpr", "mxstep", "mxhnil", "mxordn", "mxords")
    },
    "odeint tfirst": (
        lambda: iv.odeint(decay, [1.0], [0, 1], tfirst=np.ones(2)),
        "tfirst must be an integer or a flag",
    ),
    "odeint hmin": (
        (lambda: iv.odeint(decay, [1.0], [0, 1], tfirst=True, hmin=np.ones(2)), "hmin"),
        (lambda: iv.odeint(decay, [1.0], [0, 1], tfirst=True, hmax=-1), "^hmax must be positive.*, got -1"),
        (lambda: iv.odeint(decay, [1.0], [0, 1], tfirst=True, h0=-1.0), "^h0 must be positive.*, got -1"),
    ),
    "odeint printmessg": (lambda: iv.odeint(decay, [1], [0, 1], tfirst=1, printmessg="no"), "printmessg must be"),
    "odeint y0": (lambda: iv.odeint(decay, [1, [2, 3]], [0, 1], tfirst=1), "y0 must be a number or an array"),
}


@pytest.mark.parametrize("name", RAW)
def test_errors_are_in_our_own_words(name):
    several = RAW[name] if isinstance(RAW[name][0], tuple) else (RAW[name],)
    for call, message in several:
        with pytest.raises((TypeError, ValueError), match=message):
            call()


# ----------------------------------------------------------------------------------------------------------------------
# Units


class Stripped(np.ndarray):
    """An array with a unit that NumPy forgets, as astropy's quantities are."""

    unit = "cm"

    def to_value(self, unit):
        return np.asarray(self)


class Measured:
    """A number or array with units, as pint's quantities are."""

    units = "centimeter"

    def __init__(self, magnitude):
        self.magnitude = magnitude

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.magnitude, dtype)

    def __float__(self):
        return float(self.magnitude)

    def __len__(self):
        return len(self.magnitude)

    def __getitem__(self, i):
        return Measured(self.magnitude[i])


@pytest.mark.parametrize("kind", [lambda x: np.array(x, dtype=float).view(Stripped), Measured])
def test_quantities_are_refused_by_name(kind):
    """A number in whatever unit is never taken for a plain number."""

    def f(t, y, k=1.0):
        return [-k * y[0], 0.0]

    def solved(t_span=(0, 1), y0=(2.0, 0.0), **options):
        return iv.solve_ivp(f, t_span, list(y0) if isinstance(y0, tuple) else y0, **options)

    problem = iv.Problem(f, (0, 1), [2.0, 0.0], args=(1.0,))
    compiled = problem.replace(fun=iv.compile(lambda t, y, k: [-k * y[0], 0.0 * y[1]]))
    calls = {
        "y0": lambda: solved(y0=kind([200.0, 0.0])),
        "y0[0]": lambda: solved(y0=[kind(200.0), 0.0]),
        "args[0]": lambda: solved(args=(kind(3.0),)),
        "atol": lambda: solved(atol=kind([1e-6, 1e-6])),
        "rtol": lambda: solved(rtol=kind(1e-6)),
        "t_span": lambda: solved(t_span=kind([0.0, 1.0])),
        "t_span[1]": lambda: solved(t_span=(0, kind(1.0))),
        "t_eval": lambda: solved(t_eval=kind([0.5, 1.0])),
        "first_step": lambda: solved(first_step=kind(0.1)),
    }
    for name, call in calls.items():
        with pytest.raises(TypeError, match=rf"{re.escape(name)} is a quantity in (cm|centimeter)"):
            call()
    for one in (problem, compiled):
        prepared = one.prepare()
        with pytest.raises(TypeError, match=r"args\[0\] is a quantity"):
            prepared(args=(kind(3.0),))
        with pytest.raises(TypeError, match="y0 is a quantity"):
            prepared(y0=kind([200.0, 0.0]))
        with pytest.raises(TypeError, match="y0 is a quantity"):
            one.solve_ensemble(kind([[200.0, 0.0]]), workers=1)


@pytest.mark.parametrize("kind", [lambda x: np.array(x, dtype=float).view(Stripped), Measured])
def test_quantities_that_functions_return_are_refused_by_name(kind):
    decay: dict[str, object] = {"fun": lambda t, y: -y, "t_span": (0, 1), "y0": [1.0], "method": "ode15s"}
    for changed in (
        {"fun": lambda t, y: kind(-y)},
        {"events": lambda t, y: kind(y - 0.5)},
        {"jac": lambda t, y: kind([[-1.0]])},
        {"invariants": lambda t, y: kind(y)},
    ):
        with pytest.raises(TypeError, match=r"quantity (with unit|in) '?(cm|centimeter)"):
            iv.solve_ivp(**(decay | changed))


def test_a_label_is_no_unit():
    """Arrays of numbers that only say what they are in, as xarray's do, are arrays of numbers."""

    class Labelled(np.ndarray):
        units = "m"

    y0 = np.array([1.0]).view(Labelled)
    assert iv.solve_ivp(lambda t, y: -y, (0, 1), y0).success
