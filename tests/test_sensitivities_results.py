"""Sensitivities of a solution: in its parts, files, tables, prepared solvers, ensembles and stores."""

from __future__ import annotations

import copy

import numpy as np
import pytest

import invariode as iv
from cases import explicit_and_implicit
from parametric import RATES, decay, kept, lotka_volterra


def problem_with_everything(**changes):
    crossing = iv.Event(lambda t, y, *p: y[0] - 1, direction=1)
    description = {"args": RATES, "invariants": kept, "events": crossing, "labels": ["prey", "foxes"]}
    return iv.Problem(lotka_volterra, (0, 8), [1.0, 1.0], **{**description, "sensitivities": ["p1", "y0"], **changes})


def same(one, other):
    at = np.linspace(0, 8, 11)
    pairs = [
        (one.y, other.y),
        (one.sensitivities, other.sensitivities),
        (one.sol.sensitivities(at), other.sol.sensitivities(at)),
        *zip(one.sensitivities_events, other.sensitivities_events, strict=True),
        *zip(one.sensitivities_t_events, other.sensitivities_t_events, strict=True),
    ]
    return (
        all(np.array_equal(a, b, equal_nan=True) for a, b in pairs) and one.sensitivity_names == other.sensitivity_names
    )


@explicit_and_implicit
def test_extensions_files_and_checkpoints_are_the_run(method, tmp_path):
    problem = problem_with_everything()
    options = {"rtol": 1e-5, "dense_output": True}
    whole = problem.solve(method, **options)
    part = problem.solve(method, **options, max_steps=20)
    assert same(part.extend(8, max_steps=10**6), whole)
    part.save(tmp_path / "part.npz")
    assert same(iv.load(tmp_path / "part.npz", problem).extend(8, max_steps=10**6), whole)
    problem.solve(method, **options, checkpoint=iv.Checkpoint(tmp_path / "run", every=0.02))
    assert same(iv.load(tmp_path / "run", problem), whole)
    assert same(copy.deepcopy(whole), whole)
    with pytest.raises(
        ValueError, match=r"sensitivities: None here, \['p1', 'y0\[prey\]', 'y0\[foxes\]'\] in the file"
    ):
        iv.load(tmp_path / "part.npz", problem.replace(sensitivities=None))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ode15s", "ode23t", "ode23tb", "radau"])
def test_the_next_step_is_that_of_the_whole_run_wherever_it_stops(method):
    """Nothing of S depends on what attempts have left in memory that is not kept."""

    def spun(t, y, a):
        slope = np.array([1.3, 0.7, 1.9]) * y + 0.4 * a * y**3
        turn = np.array([[0, 1.0, -0.5], [-1, 0, 0.8], [0.5, -0.8, 0]])
        return turn @ slope * (1 + np.cos(y[0]))

    problem = iv.Problem(
        spun,
        (0, 8),
        [1.0, -0.7, 0.4],
        args=(1.2,),
        invariants=lambda t, y, a: 0.5 * np.sum(np.array([1.3, 0.7, 1.9]) * y * y) + 0.1 * a * np.sum(y**4),
        sensitivities="a",
    )
    given = {"rtol": 1e-3, "atol": 1e-5, "max_step": 0.5}
    whole = problem.solve(method, **given)
    for k in range(18, 92, 7 if method == "radau" else 5):
        if k + 1 >= len(whole.t):
            break
        sol = problem.solve(method, max_steps=k, **given).extend(8, max_steps=1)
        np.testing.assert_array_equal(sol.sensitivities, whole.sensitivities[:, :, : k + 2])


def test_y_is_that_of_any_solution():
    """Shapes of y, its events and sol; sensitivities beside them."""
    sol = problem_with_everything().solve("ode45", t_eval=[0, 1, 8], dense_output=True)
    assert (sol.y.shape, sol.sensitivities.shape) == ((2, 3), (2, 3, 3))
    assert (sol.sol(1.0).shape, sol.sol.sensitivities(1.0).shape) == ((2,), (2, 3))
    assert sol.y_events[0].shape[1] == 2
    assert len(sol.drift().names) == 1
    np.testing.assert_array_equal(sol.sensitivities[:, 1:, 0], np.eye(2))
    end = problem_with_everything().solve("ode45", keep="end")
    assert end.sensitivities.shape == (2, 3, 1)
    plain = problem_with_everything(sensitivities=None).solve("ode45", dense_output=True)
    assert plain.sensitivities is None
    assert plain.stats.sensitivities is None
    with pytest.raises(ValueError, match="the run had no sensitivities: solve with sensitivities=True"):
        plain.sol.sensitivities(1.0)


def test_tables_have_them_by_name():
    pytest.importorskip("xarray")
    sol = problem_with_everything().solve("ode45", rtol=1e-4)
    data, table = sol.to_xarray(), sol.to_dataframe()
    np.testing.assert_array_equal(data.sensitivities.sel(component="foxes", parameter="p1"), sol.sensitivities[1, 0])
    np.testing.assert_array_equal(table["d foxes / d y0[prey]"], sol.sensitivities[1, 1])


def test_a_prepared_solver_has_the_values_of_its_call():
    problem = problem_with_everything(events=None, invariants=None)
    solver, other = problem.prepare("ode45"), (1.4, 1.1, 3.0, 1.0)
    assert np.array_equal(solver(args=other).sensitivities, problem.replace(args=other).solve("ode45").sensitivities)


@pytest.mark.parametrize("scale", [None, {"rate": 1.0}, {"rate": 1.0, "source": 1.0}, 1.0])
def test_a_prepared_solver_takes_the_sizes_of_its_call(scale):
    """Sizes that are not given are the values of the parameters."""
    grown = iv.compile(lambda t, y, rate, source: [-rate * y[0] + source])
    problem = iv.Problem(grown, (0, 3), [1.0], args=(1.0, 1e-6), sensitivities=iv.Sensitivities(scale=scale))
    solver, other = problem.prepare("ode45"), (2.0, 1e3)
    assert np.array_equal(solver(args=other).sensitivities, problem.replace(args=other).solve("ode45").sensitivities)


@pytest.mark.parametrize("fun", [decay, iv.compile(decay)])
def test_trajectories_have_those_of_single_runs(fun, tmp_path):
    rows = {"y0": [[1.0], [2.0]], "args": [[1.0], [3.0]]}
    options = {"t_eval": [0.5, 1.0], "rtol": 1e-6, "sensitivities": ["rate", "y0"]}
    many = iv.solve_ensemble(fun, (0, 1), **rows, **options, workers=1)
    for i, (y0, args) in enumerate(zip(*rows.values(), strict=True)):
        alone = iv.solve_ivp(fun, (0, 1), y0, args=args, **options)
        assert np.array_equal(many.sensitivities[i], alone.sensitivities)
        assert np.array_equal(many[i].sensitivities, alone.sensitivities)
    why = "functions are in Python" if fun is decay else "fewer than 1000 trajectories"
    assert why in many.stats.lanes
    many.save(tmp_path / "many.npz")
    again = iv.EnsembleSolution.load(tmp_path / "many.npz")
    assert np.array_equal(again.sensitivities, many.sensitivities)
    assert again.sensitivity_names == many[0].sensitivity_names == ["rate", "y0[0]"]
    final = iv.solve_ensemble(fun, (0, 1), **rows, rtol=1e-6, sensitivities="rate", workers=1)
    np.testing.assert_allclose(final.sensitivities[:, 0, 0, 0], -final.y_end[:, 0], rtol=1e-4)


@pytest.mark.parametrize("times", [{"t_eval": [0.5, 1.0]}, {}])
def test_a_store_has_those_of_the_ensemble(times, tmp_path):
    pytest.importorskip("zarr")
    given = {"y0": [[1.0], [2.0], [3.0]], "args": [[1.0], [3.0], [np.nan]], "workers": 1, **times}
    given |= {"sensitivities": ["rate", "y0"], "on_failure": "return"}
    many = iv.solve_ensemble(decay, (0, 1), **given)
    store = iv.solve_ensemble(decay, (0, 1), **given, store=tmp_path / "store", chunk=2)
    loaded = store.load()
    np.testing.assert_array_equal(loaded.sensitivities, many.sensitivities)
    np.testing.assert_array_equal(loaded[1].sensitivities, many[1].sensitivities)
    assert loaded.sensitivity_names == store.to_xarray().sensitivity.values.tolist() == ["rate", "y0[0]"]
    other = {**given, "sensitivities": True}
    with pytest.raises(ValueError, match="belongs to another problem: sensitivities"):
        iv.solve_ensemble(decay, (0, 1), **other, store=tmp_path / "store", chunk=2, resume=True)
