"""Sensitivities through the events of SBML models, and through `Roots`."""

from __future__ import annotations

import numpy as np
import pytest

import invariode as iv
from cases import explicit_and_implicit
from test_petab import differences, written
from test_sbml import event, formula, model, parameter, reaction, species

sbml = pytest.importorskip("invariode.sbml")
petab = pytest.importorskip("invariode.petab")
pytest.importorskip("libsbml")

#: Two reactions with events that trigger each other: delays that depend on the state and on parameters, priorities,
#: values of the trigger's time and of that of the execution, an execution that is withdrawn, a volume that is assigned.
ASSIGNMENTS = ("P + q * S", "S * T + k * time", "0.1 * k + w * Q", "S + Q / 2")
TRIGGERS = ("S < T", "P > 1.1", "P > 1.1 && time > 0.05", "Q > 0.9", "time > 1.3 * k + 0.01")


def random_model(rng):
    """A model with three random events, and the names of its parameters."""

    def random_event(i):
        targets = rng.choice(["S", "P", "Q", "w"], size=2, replace=False)
        delay = rng.choice([None, "d * S + 0.1", "0.3 * k * T"])
        return event(
            f"e{i}",
            TRIGGERS[rng.integers(len(TRIGGERS))],
            {name: ASSIGNMENTS[rng.integers(len(ASSIGNMENTS))] for name in targets},
            delay=delay,
            priority=str(rng.integers(3) + 0.1 * i),
            at_trigger=str(rng.choice(["true", "false"])),
            persistent=str(rng.choice(["true", "false"])),
        )

    values = {name: round(float(rng.uniform(0.4, 1.2)), 3) for name in ("k", "d", "q", "T")}
    return model(
        species("S", 2, substance="false") + species("P", 0) + species("Q", 0.3, substance="false"),
        "".join(parameter(name, value) for name, value in values.items()) + parameter("w", 0.2, "false"),
        reactions=reaction("r", {"S": 1}, {"P": 1}, "k * S") + reaction("u", {"P": 1}, {"Q": 1}, "q * P"),
        events="".join(map(random_event, range(3))),
        size="0.8",
    ), [*values]


def central(problem, names, rtol=1e-11):
    """∂y/∂p at the end by differences of fourth order, and the counts of events in each of the runs."""
    p, h, counts = problem.parameters, 1e-4, []
    columns = []
    for name in names:
        ends = []
        for s in (1, -1, 2, -2):
            sol = problem.replace(parameters={name: p[name] * (1 + s * h)}).solve("dop853", rtol=rtol, atol=rtol / 100)
            ends.append(sol.y_end)
            counts.append([len(one) for one in sol.t_events])
        columns.append((8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h * p[name]))
    return np.array(columns).T, counts


METHODS = {
    **dict.fromkeys(("auto", "ode45", "dop853", "ode113", "ode15s", "radau", "ode78", "ode89", "taylor"), 1e-8),
    **dict.fromkeys(("ode23", "ode23t", "ode23tb", "ode23s"), 1e-5),
}


def test_sensitivities_of_random_models_are_differences_of_runs():
    """One model for each method; models are left out where neighbouring parameters have other events. Gradients, by
    runs backwards, are those of the sensitivities."""
    rng, waiting = np.random.default_rng(4), [*METHODS.items()]
    while waiting:
        text, names = random_model(rng)
        problem = sbml.load(text).problem((0, 3))
        expected, counts = central(problem, names)
        if any(one != counts[0] for one in counts) or sum(counts[0]) < 3:
            continue
        method, rtol = waiting.pop()
        sol = problem.replace(sensitivities=names).solve(method, rtol=rtol, atol=rtol / 100)
        error = np.abs(sol.sensitivities[:, :, -1] - expected).max() / np.abs(expected).max()
        assert error < 100 * rtol, (method, text)
        if method in ("auto", "dop853", "ode15s"):
            costs = rng.normal(size=len(expected))
            along = problem.solve(method, rtol=rtol, atol=rtol / 100, adjoint=True)
            assert along.gradient(costs, wrt=names) == pytest.approx(
                costs @ expected, rel=100 * rtol, abs=100 * rtol * np.abs(expected).max()
            )


@pytest.mark.parametrize("method", ["ode15s", "dop853"])
def test_algebraic_rules_after_events(method):
    """z = 3 - x² and x' = -k x; where z reaches 2 + a, which is at x = √(1 - a), x becomes 1 + b z, later x is zero."""
    text = model(
        "",
        parameter("x", 1.5, "false") + parameter("z", 1, "false") + parameter("w", 0, "false")
        + "".join(parameter(n, v) for n, v in (("k", 0.7), ("a", 0.3), ("b", 0.2))),
        f'<algebraicRule>{formula("z + x^2 - 3")}</algebraicRule><rateRule variable="x">{formula("-k * x")}</rateRule>',
        events=event("e", "z > 2 + a", {"x": "1 + b * z", "w": "a * z"}, priority="2")
        + event("then", "x > 1.2", {"w": "w * z"}, priority="1"),
    )  # fmt: skip
    m = sbml.load(text)
    problem = m.problem((0, 1.2))
    if method == "dop853":  # rules differentiated, and imposed
        p = problem.args[0]
        problem = m._problem((0.0, 1.2), np.array([*p]), problem.y0, True, explicit=True, events=problem.events)
    sol = problem.replace(sensitivities=["k", "a", "b"]).solve(method, rtol=1e-9, atol=1e-11)

    def exact(k, a, b):
        at, x0 = 0.5 * np.log(2.25 / (1 - a)) / k, 1 + b * (2 + a)
        x = x0 * np.exp(-k * (1.2 - at))
        z = 3 - x**2
        return {"x": x, "z": z, "w": a * (2 + a) * (3 - x0**2)}

    found = dict(zip(m.states, sol.sensitivities[:, :, -1], strict=True))
    for j in range(3):
        wanted = exact(*(np.array([0.7, 0.3, 0.2]) + 1e-30j * np.eye(3)[j]))
        for name, value in wanted.items():
            assert found[name][j] == pytest.approx(value.imag / 1e-30, abs=1e-6), (name, j)


def test_delayed_executions_have_derivatives_of_their_times():
    """x' = 1 from 0 reaches a at a; after a delay of b x it is g a: at 3, g a + 3 - a - a b."""
    text = model(
        "",
        parameter("x", 0, "false") + parameter("a", 1) + parameter("b", 0.5) + parameter("g", 2),
        f'<rateRule variable="x">{formula("1")}</rateRule>',
        events=event("e", "x >= a && time < 2", {"x": "g * x"}, delay="b * x"),
    )
    problem = sbml.load(text).problem((0, 3)).replace(sensitivities=["a", "b", "g"])
    for _ in range(2):  # a second run begins with nothing that waits
        sol = problem.solve("ode45", rtol=1e-9)
        assert sol.y_end[0] == pytest.approx(3.5)
        np.testing.assert_allclose(sol.sensitivities[0, :, -1], [2 - 1 - 0.5, -1, 1], atol=1e-8)
        np.testing.assert_allclose(sol.sensitivities_t_events[-1], [[1.5, 1, 0]], atol=1e-8)
    plain = problem.replace(sensitivities=None)
    found = plain.solve("ode45", rtol=1e-9, dense_output=True).gradient([1.0], wrt=["a", "b", "g"])
    np.testing.assert_allclose(found, [2 - 1 - 0.5, -1, 1], atol=1e-8)
    with pytest.raises(ValueError, match=r"gradient: Roots\(.*remember.*use adjoint=True"):
        plain.solve("ode45", adjoint="checkpoints").gradient([1.0])


def test_gradients_of_events_that_the_start_triggers():
    """Costs at several times of two events that are triggered at the start, with a delay that depends on the state, and
    values of the trigger's time and of that of the execution."""
    delay = {"delay": "b * x", "initial": "false"}
    text = model(
        "",
        parameter("x", 1.5, "false") + parameter("a", 1) + parameter("b", 0.5) + parameter("g", 2),
        f'<rateRule variable="x">{formula("1 - a * x")}</rateRule>',
        events=event("e", "x >= a", {"x": "g * x^2"}, **delay)
        + event("f", "x >= a", {"x": "g * x"}, at_trigger="false", **delay),
    )
    problem = sbml.load(text).problem((0, 3))
    names, t, costs = ["a", "b", "g", "y0[x]"], [0.5, 1.0, 3.0], np.array([[1.0, -2.0, 3.0]])
    S = problem.replace(sensitivities=names).solve("ode45", t_eval=t, rtol=1e-9, atol=1e-11).sensitivities
    found = problem.solve("ode45", rtol=1e-9, atol=1e-11, adjoint=True).gradient(costs, t=t, wrt=names)
    np.testing.assert_allclose(found, np.einsum("nt,nkt->k", costs, S[:, :, -len(t) :]), rtol=1e-7)


@explicit_and_implicit
def test_roots_that_remember_nothing_are_events(method):
    """S of a bouncing ball between two walls that move with p, by one function of two values, is that of two events."""

    def fun(t, y, p, e):
        return [-y[1], y[0] - p * t - 1, y[0] + 1 < 0]

    def on_roots(t, y, which, directions, p, e):
        if which[0] == 1:
            return [y[0], p - e * (y[1] - p), y[2] + y[0]]
        return [y[0], -e * y[1], y[2] * e] if which[0] == 2 and directions[0] > 0 else y

    top = iv.Event(lambda t, y, p, e: y[0] - p * t - 1, 0, 1, lambda t, y, p, e: on_roots(t, y, [1], [1], p, e))
    low = iv.Event(lambda t, y, p, e: y[0] + 1, 0, -1, lambda t, y, p, e: on_roots(t, y, [2], [1], p, e))
    apex = iv.Event(lambda t, y, p, e: -y[1])
    problem = iv.Problem(
        lambda t, y, p, e: [y[1], -0.3 * y[0], 0.0], (0, 8), [0.0, 2.0, 1.0], args=(0.02, 0.9), sensitivities=True
    )
    two = problem.replace(events=[apex, top, low]).solve(method, rtol=1e-8, atol=1e-10)
    one = problem.replace(events=iv.Roots(fun, 3, on_roots, stateless=True)).solve(method, rtol=1e-8, atol=1e-10)
    assert min(len(t) for t in one.t_events[1:]) > 1
    np.testing.assert_allclose(one.sensitivities[:, :, -1], two.sensitivities[:, :, -1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(one.sensitivities_t_events[1], two.sensitivities_t_events[1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(one.sensitivities_after_events[1], two.sensitivities_after_events[1], atol=1e-6)
    roots = problem.replace(events=iv.Roots(fun, 3, on_roots, stateless=True), sensitivities=None)
    along = roots.solve(method, rtol=1e-8, atol=1e-10, adjoint="checkpoints")
    expected = np.array([1, 2, 3]) @ one.sensitivities[:, :, -1]
    np.testing.assert_allclose(along.gradient([1, 2, 3], wrt=True), expected, rtol=1e-6)
    with pytest.raises(ValueError, match=r"sensitivities are not possible with Roots\(fun, 3\).*stateless=True"):
        problem.replace(events=iv.Roots(fun, 3, on_roots)).solve(method)


def test_gradients_of_problems_with_events(tmp_path):
    """Gradients of PEtab problems follow doses at an estimated time and level, and a start that an event changes."""
    text = model(
        species("A", 1) + species("B", 0),
        parameter("k1", 0.8) + parameter("k2", 0.6),
        reactions=reaction("r", {"A": 1}, {"B": 1}, "k1 * A - k2 * B"),
        events=event("dose", "time > k2 / 4", {"A": "A + k1"}, delay="0.1 * k1")
        + event("level", "B > 0.7 * k1", {"B": "B / 2"})
        + event("begin", "time >= 0", {"A": "A + k2"}, initial="false"),
    )
    table = "observableId\tsimulationConditionId\tmeasurement\ttime\tobservableParameters\tnoiseParameters\n"
    rows = "b\tafter\t1.5\t0.05\tscale\ts\nb\tafter\t2.0\t1\tscale\ts\na\tafter\t0.4\t1\t\t\na\tbefore\t0.8\t0.5\t\t\n"
    yaml = written(tmp_path, **{"model.xml": text, "measurements.tsv": table + rows})
    problem = petab.load(yaml, rtol=1e-10, atol=1e-13)
    objective, x = problem.objective(), problem.nominal + 0.05
    with pytest.warns(iv.AccuracyWarning, match="derivatives of y0 are differences"):
        found = objective(x)
    np.testing.assert_allclose(found.gradient, differences(objective, x), rtol=1e-5)
