"""Initial values of SBML models are functions of their parameters."""

from __future__ import annotations

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import invariode as iv
from test_sbml import event, formula, model, parameter, reaction, species

sbml = pytest.importorskip("invariode.sbml")

INITIAL = "".join(
    f'<initialAssignment symbol="{name}">{formula(one)}</initialAssignment>'
    for name, one in (("S", "2 * a + b"), ("a", "k + b"), ("b", "k * k"))
)
CHAIN = model(
    species("S", 1, substance="false") + species("P", 0.5, substance="false"),
    "".join(parameter(name, value) for name, value in (("k", 0.5), ("a", 0), ("b", 0), ("lambda", 0.3))),
    reactions=reaction("r", {"S": 1}, {"P": 1}, "lambda * S"),
    events=event("e", "P > k", {"S": "S + a"}, delay="k"),
    initial=INITIAL,
    size="2",
)


def test_initial_assignments_follow_the_parameters():
    """S = 2 a + b with a = k + b and b = k², in a volume c: y0 and its derivatives, through an event too."""
    loaded = sbml.load(CHAIN)
    problem = pickle.loads(pickle.dumps(loaded)).problem((0, 3))
    names, run = ["k", "lambda", "c"], {"method": "radau", "rtol": 1e-10, "atol": 1e-12}
    assert problem.y0[0] == 2 * (2 * 0.5 + 3 * 0.25)
    np.testing.assert_allclose(problem.replace(parameters={"k": 0.8}).y0, loaded.problem((0, 3), k=0.8).y0)
    found = problem.replace(sensitivities=names).solve(**run).sensitivities[:, :, -1]
    for j, name in enumerate(names):
        h = 1e-4 * problem.parameters[name]
        ends = [
            loaded.problem((0, 3), **{name: problem.parameters[name] + s * h}).solve(**run).y_end
            for s in (1, -1, 2, -2)
        ]
        expected = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)
        np.testing.assert_allclose(found[:, j], expected, rtol=1e-6, atol=1e-6)


def test_fits_of_models_follow_initial_assignments_and_events():
    loaded = sbml.load(CHAIN)
    t = np.linspace(0.3, 3, 10)
    run = {"method": "radau", "rtol": 1e-9, "atol": 1e-12}
    data = loaded.problem((0, 3), k=0.62, **{"lambda": 0.41}).solve(t_eval=t, **run).y
    fit = iv.fit(loaded.problem((0, 3)), t, data, {"k": (0.1, 2), "lambda": (0.1, 1)}, sigma=0.01, **run)
    np.testing.assert_allclose([fit.parameters["k"], fit.parameters["lambda"]], [0.62, 0.41], rtol=1e-4)


def test_runs_of_models_with_events_go_on_with_what_waits(tmp_path):
    """A dose with a lag: `extend` finds what waits, whatever other runs have begun, from a file too, bit for bit; a
    dose at the start depends on its parameter; problems can be pickled after runs with sensitivities."""
    text = model(
        species("D", 0),
        parameter("dose", 5) + parameter("lag", 0.7),
        reactions=reaction("e", {"D": 1}, {}, "D"),
        events=event("first", "time >= 0", {"D": "dose"}, initial="false")
        + event("second", "time >= 0.5", {"D": "D + dose"}, delay="lag", at_trigger="false"),
    )
    problem = sbml.load(text).problem((0, 1))
    run = {"method": "dop853", "rtol": 1e-10, "atol": 1e-12}
    varied = problem.replace(sensitivities=["dose", "lag"])
    sol = pickle.loads(pickle.dumps([varied.solve(**run), varied][1])).solve(**run).extend(4)
    np.testing.assert_allclose(sol.y_end[0], 5 * (np.exp(-4) + np.exp(-2.8)), rtol=1e-8)
    expected = [np.exp(-4) + np.exp(-2.8), 5 * np.exp(-2.8)]
    np.testing.assert_allclose(sol.sensitivities[0, :, -1], expected, rtol=1e-6)
    assert problem.replace(parameters={"dose": 2.0}).y0[0] == 2
    first = problem.solve(**run)
    first.save(tmp_path / "run.npz")
    other = problem.replace(parameters={"dose": 2.0}).solve(**run).extend(2)
    early = problem.replace(t_span=(0, 0.3)).solve(**run)
    problem.solve(**run, adjoint=True).gradient([1.0])
    for _ in range(2):  # an extension is no part of the run either
        for one, dose in ((first, 5), (other, 2), (early, 5)):
            expected = dose * (np.exp(-4) + np.exp(-2.8))
            np.testing.assert_allclose(one.extend(4).y_end[0], expected, rtol=1e-8)
    for known in (problem, sbml.load(text).problem((0, 1))):
        np.testing.assert_array_equal(iv.load(tmp_path / "run.npz", known).extend(4).y_end, first.extend(4).y_end)
    varied.solve(**run).save(tmp_path / "varied.npz")
    again = iv.load(tmp_path / "varied.npz", varied).extend(4)
    np.testing.assert_array_equal(again.sensitivities[..., -1], sol.sensitivities[..., -1])
    problem.solve(**run, checkpoint=tmp_path / "kept")
    np.testing.assert_array_equal(iv.load(tmp_path / "kept", problem).extend(4).y_end, first.extend(4).y_end)


def test_runs_of_one_model_at_the_same_time_do_not_disturb_each_other():
    """Threads, with a delayed dose at each rise of an oscillation: bit for bit what each
    run gives alone, by `solve` and by a prepared solver."""
    text = model(
        species("D", 0),
        parameter("dose", 5) + parameter("lag", 0.3),
        reactions=reaction("e", {"D": 1}, {}, "D"),
        events=event("rise", "sin(6 * time) > 0.2", {"D": "D + dose"}, delay="lag", priority="D"),
    )
    problem = sbml.load(text).problem((0, 6))
    doses = [1.0, 2.0, 3.0, 4.0]
    alone = [problem.replace(parameters={"dose": one}).solve("ode23").y for one in doses]
    prepared = problem.prepare("ode23")
    interval, _ = sys.getswitchinterval(), sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as pool:
            at_once = [*pool.map(lambda one: problem.replace(parameters={"dose": one}).solve("ode23").y, doses)]
            shared = [*pool.map(lambda one: prepared(args={"dose": one}).y, doses)]
    finally:
        sys.setswitchinterval(interval)
    for found in (at_once, shared):
        for one, expected in zip(found, alone, strict=True):
            np.testing.assert_array_equal(one, expected)
