"""Parameters by name: `Problem(parameters=...)`, a record in all functions of a problem."""

import pickle

import numpy as np
import pytest

import invariode as iv
from cases import explicit_and_implicit

NAMES = {"lambda": 0.5, "t": 2.0, "y": 0.3, "count": 1.0}


def named(t, y, p):
    return [-p["lambda"] * y[0] + p.y * y[1], p["t"] * y[0] - p["count"] * y[1]]


def plain(t, y, a, b, c, d):
    return [-a * y[0] + c * y[1], b * y[0] - d * y[1]]


def both(**options):
    return (
        iv.Problem(named, (0, 2), [1.0, 0.5], parameters=NAMES, **options),
        iv.Problem(plain, (0, 2), [1.0, 0.5], args=tuple(NAMES.values()), **options),
    )


@explicit_and_implicit
@pytest.mark.parametrize("compiled", [False, True])
def test_the_solution_is_that_of_arguments(method, compiled):
    ours, theirs = both(sensitivities=True)
    if compiled:
        ours, theirs = (one.replace(fun=iv.compile(one.fun, by="trace")) for one in (ours, theirs))
    a, b = ours.solve(method), theirs.solve(method)
    np.testing.assert_array_equal(a.y, b.y)
    np.testing.assert_array_equal(a.sensitivities, b.sensitivities)
    assert a.sensitivity_names == [*NAMES]


def test_names_select_parameters_and_replace_changes_them():
    problem = both()[0].replace(sensitivities=["t", "y0[0]", "lambda"])
    assert [one.name for one in problem.parameter_names()] == ["t", "y0[0]", "lambda"]
    other = problem.replace(parameters={"lambda": 7})
    assert other.parameters == {**NAMES, "lambda": 7.0}
    assert problem.parameters == NAMES
    assert problem.replace(y0=[2.0, 1.0]).parameters == NAMES
    with pytest.raises(ValueError, match=r"'lamda'.*lambda"):
        problem.replace(parameters={"lamda": 1})
    with pytest.raises(ValueError, match="takes no parameter 'k'"):
        problem.replace(sensitivities=["k"])


def test_the_record():
    seen = []
    iv.Problem(lambda t, y, p: seen.append(p) or [0.0], (0, 1), [1.0], parameters=NAMES).solve()
    p = seen[0]
    assert p["lambda"] == 0.5
    assert (p.t, p.y, p["count"], len(p), [*p.keys()]) == (2.0, 0.3, 1.0, 4, [*NAMES])
    assert pickle.loads(pickle.dumps(p)) == p
    with pytest.raises(KeyError, match="lambda"):
        p["lamda"]
    with pytest.raises(AttributeError, match="there is no parameter 'z'"):
        _ = p.z
    with pytest.raises(AttributeError, match="do not change"):
        p.t = 3.0


def test_every_function_of_the_problem_takes_the_record():
    """Events with actions, Jacobian, invariants, mass and inputs: the same run as with arguments."""
    options = {
        "events": [(lambda t, y, p: y[0] - p["level"], lambda t, y, p: [y[0] + p["dose"], y[1]]),
                   (lambda t, y, k, level, dose: y[0] - level, lambda t, y, k, level, dose: [y[0] + dose, y[1]])],
        "jac": [lambda t, y, p: [[-p.k, 0], [p.k, 0]], lambda t, y, k, level, dose: [[-k, 0], [k, 0]]],
        "mass": [lambda t, p: np.eye(2) * p.dose, lambda t, k, level, dose: np.eye(2) * dose],
    }  # fmt: skip
    funs = [
        lambda t, y, u, p: [-p.k * y[0] * u, p.k * y[0] * u],
        lambda t, y, u, k, level, dose: [-k * y[0] * u, k * y[0] * u],
    ]
    u, values = iv.Input([0, 5], [1.0, 2.0]), {"k": 1.0, "level": 0.4, "dose": 0.7}
    given = [{"parameters": values}, {"args": tuple(values.values())}]
    found = []
    for i in (0, 1):
        g, action = options["events"][i]
        problem = iv.Problem(
            funs[i],
            (0, 5),
            [1.0, 0.0],
            events=iv.Event(g, action=action),
            inputs=u,
            mass=options["mass"][i],
            **given[i],
        )
        found.append(problem.solve("ode15s", rtol=1e-7))
    np.testing.assert_array_equal(found[0].y, found[1].y)
    assert len(found[0].t_events[0]) > 1
    laws = [lambda t, y, p: p.k * (y[0] + y[1]), lambda t, y, k, level, dose: k * (y[0] + y[1])]
    found = [
        iv.Problem(funs[i], (0, 5), [1.0, 0.0], inputs=u, invariants=laws[i], **given[i]).solve("ode45") for i in (0, 1)
    ]
    np.testing.assert_array_equal(found[0].y, found[1].y)
    jacs = [
        iv.Problem(lambda t, y, p: [-p.k * y[0], p.k * y[0]], (0, 5), [1.0, 0], jac=options["jac"][0], **given[0]),
        iv.Problem(lambda t, y, k, *_: [-k * y[0], k * y[0]], (0, 5), [1.0, 0], jac=options["jac"][1], **given[1]),
    ]
    np.testing.assert_array_equal(*(one.solve("ode15s").y for one in jacs))


@pytest.mark.parametrize("compiled", [False, True])
def test_ensembles_and_prepared_solvers_take_names(compiled):
    problem, _ = both()
    if compiled:
        problem = problem.replace(fun=iv.compile(problem.fun))
    rates = [0.1, 0.7, 2.0]
    single = [problem.replace(parameters={"lambda": one}).solve("ode45", keep="end").y[:, -1] for one in rates]
    columns = {"lambda": rates, "t": 2.0}
    rows = [{"lambda": one} for one in rates]
    matrix = np.array([[one, 2.0, 0.3, 1.0] for one in rates])
    table = pytest.importorskip("pandas").DataFrame({"t": 2.0, "lambda": rates})
    for args in (columns, rows, matrix, table):
        many = problem.solve_ensemble(args=args, workers=1)
        np.testing.assert_array_equal(many.y_end if hasattr(many, "y_end") else many.y[:, :, -1], single)
    solver = problem.prepare("ode45", keep="end")
    for one, end in zip(rates, single, strict=True):
        np.testing.assert_array_equal(solver(args={"lambda": one}).y[:, -1], end)
    assert problem.solve_ensemble([[1.0, 2.0], [2.0, 1.0]], args={"t": 1.0}, workers=1).success.all()
    with pytest.raises(ValueError, match="one length"):
        problem.solve_ensemble(args={"lambda": [1, 2], "t": [1, 2, 3]})
    with pytest.raises(ValueError, match="parameters names 'k'"):
        problem.solve_ensemble(args={"k": [1, 2]})


def test_fits_name_them():
    problem, _ = both()
    t = np.linspace(0.2, 2, 8)
    data = problem.solve("ode45", t_eval=t, rtol=1e-9, atol=1e-12).y
    start = problem.replace(parameters={"lambda": 0.9})
    fit = iv.fit(start, t, data, {"lambda": (0.1, 2), "y0[0]": (0.5, 2)}, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose([*fit.parameters.values()], [0.5, 1.0], rtol=1e-6)


def test_gradients_name_them():
    problem = both()[0].replace(sensitivities=["lambda"])
    sol = problem.solve("ode45", rtol=1e-10, atol=1e-12, adjoint=True)
    forward = sol.sensitivities[0, 0, -1]
    assert float(sol.gradient(np.array([1.0, 0.0]))[0]) == pytest.approx(forward, rel=1e-6)


def test_saved_runs_know_their_parameters(tmp_path):
    problem, _ = both()
    sol = problem.solve("ode45")
    sol.save(tmp_path / "run.npz")
    again = iv.load(tmp_path / "run.npz", problem).extend(3.0)
    np.testing.assert_array_equal(again.y[:, -1], sol.extend(3.0).y[:, -1])
    with pytest.raises(ValueError, match="args"):
        iv.load(tmp_path / "run.npz", problem.replace(parameters={"lambda": 2.0})).extend(3.0)


def test_what_is_wrong_is_named():
    for wrong in ([1.0], {"k": "fast"}, {1: 2.0}):
        with pytest.raises(TypeError, match="parameter"):
            iv.Problem(named, (0, 1), [1.0], parameters=wrong)
    with pytest.raises(ValueError, match="args or parameters"):
        iv.Problem(named, (0, 1), [1.0], args=(1.0,), parameters=NAMES)


def test_arguments_of_fun_are_changed_by_name():
    """Without a record, the names are those that f has for its arguments; numbers in an array have theirs."""
    problem = iv.Problem(lambda t, y, k, p: [k * y[0] + p[1]], (0, 1), [1.0], args=(2.0, [3.0, 4.0]))
    other = problem.replace(args={"k": 5.0, "p[1]": 6.0})
    assert (other.args[0], [*other.args[1]]) == (5.0, [3.0, 6.0])
    assert problem.prepare("ode45")(args={"k": 5.0, "p[1]": 6.0}).y[0, -1] == other.solve("ode45").y[0, -1]
    single = [problem.replace(args={"k": one}).solve("ode45", keep="end").y[:, -1] for one in (1.0, 5.0)]
    for args in ({"k": [1.0, 5.0]}, [{"k": 1.0}, {"k": 5.0}]):
        np.testing.assert_array_equal(problem.solve_ensemble(args=args, workers=1).y_end, single)
    with pytest.raises(ValueError, match="takes no parameter 'kk'; parameters are k, p"):
        problem.replace(args={"kk": 1.0})
    with pytest.raises(TypeError, match=r"k is an argument of fun: replace\(args="):
        problem.replace(k=1.0)
    with pytest.raises(TypeError, match=r"change by name with replace\(args="):
        problem.replace(parameters={"k": 1.0})
    with pytest.raises(ValueError, match=r"args names 'kk'.*last arguments of fun are k; numbers by any name"):
        iv.Problem(lambda t, y, k: [k], (0, 1), [1.0], args={"kk": 1})


def test_parameters_by_name_for_a_function_of_single_arguments():
    """The message has the args that such a function takes; of many actions the first are named."""
    problem = iv.Problem(lambda t, y, k, c: [-k * c * y[0]], (0, 1), [1.0], parameters={"k": 2.0, "c": 3.0})
    with pytest.raises(TypeError) as raised:
        problem.solve()
    assert "give args=(2.0, 3.0)" in raised.value.__notes__[0]
    idle = [(t, lambda t, y: y) for t in range(9)]
    with pytest.raises(TypeError) as raised:
        iv.solve_ivp(lambda t, y, k: [-k * y[0]], (0, 9), [1.0], args=(1.0,), breakpoints=idle)
    assert raised.value.__notes__[0].count("breakpoint") == 3
    assert "and 6 more" in raised.value.__notes__[0]
