"""An ensemble as single results, pictures, labelled arrays, tables and files: as single solves give them."""

from __future__ import annotations

import pickle

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import invariode as iv

#: Trajectories that fail belong to many of these laws; that a warning says so is in tests/test_failures.py.
pytestmark = pytest.mark.filterwarnings("ignore::invariode.FailureWarning")


def rotation(t, y, w):
    return [w * y[1], -w * y[0]]


def radius(t, y, w):
    return y[0] ** 2 + y[1] ** 2


def crossing(t, y, w):
    return y[0]


STARTS, RATES, TIMES = [[1.0, 0.0], [2.0, 0.0], [0.0, 3.0]], [[1.0], [2.0], [0.5]], np.linspace(0, 4, 9)


def ensemble(**options):
    given = {"t_eval": TIMES, "invariants": radius, "events": crossing, **options}
    return iv.solve_ensemble(rotation, (0, 4), STARTS, args=RATES, workers=1, **given)


def single(i, **options):
    given = {"t_eval": TIMES, "invariants": radius, "events": crossing, **options}
    return iv.solve_ivp(rotation, (0, 4), STARTS[i], args=tuple(RATES[i]), **given)


@pytest.mark.parametrize("options", [{}, {"t_eval": None}, {"events": None}, {"invariants": None}])
def test_a_trajectory_is_the_result_of_a_single_solve(options):
    m = ensemble(**options)
    for i, one in enumerate(m):
        alone = single(i, **{**options, **({"keep": "end"} if "t_eval" in options else {})})
        assert isinstance(one, iv.Solution)
        np.testing.assert_array_equal(one.t, alone.t)
        np.testing.assert_array_equal(one.y, alone.y)
        for name in ("nfev", "status", "message", "success", "t_end"):
            assert one[name] == alone[name], name
        assert {**one.stats, "derivatives": None} == {**alone.stats, "derivatives": None}
        for name in ("t_events", "y_events"):
            assert (one[name] is None) == (alone[name] is None)
            for ours, theirs in zip(one[name] or (), alone[name] or (), strict=True):
                np.testing.assert_array_equal(ours, theirs)
        assert one.drift().names == alone.drift().names
        np.testing.assert_array_equal(one.residual, alone.residual)
        np.testing.assert_array_equal(one.drift().residual_before, alone.drift().residual_before)


def test_it_is_a_sequence_of_trajectories_with_fields():
    m = ensemble()
    assert len(m) == len(list(m)) == 3
    np.testing.assert_array_equal(m[-1].y, m[2].y)
    assert m["y"] is m.y
    assert "y" in m
    assert "nothing" not in m
    assert dict(m)["status"] is m.status
    with pytest.raises(IndexError, match="there is no trajectory 3: choose from 0 to 2"):
        m[3]
    with pytest.raises(KeyError):
        m["nothing"]


def test_one_that_failed_says_why_and_has_what_it_reached():
    m = iv.solve_ensemble(lambda t, y: y**2, (0, 2), [[0.1], [1.0]], t_eval=[0, 0.5, 2], workers=1)
    assert m[0].success
    assert not m[1].success
    assert m[1].message == m.messages[1]
    assert m[1].t.tolist() == [0, 0.5]


@pytest.mark.parametrize("kind", ["bands", "quantiles", "spaghetti"])
def test_pictures_have_the_quantiles_of_the_trajectories(kind):
    starts = np.linspace(0, 1, 21)[:, None]
    m = iv.solve_ensemble(lambda t, y: 0 * y, (0, 1), starts, t_eval=[0, 0.5, 1], workers=1)
    ax = Figure().add_subplot()
    assert m.plot(kind, ax=ax) is ax
    levels = sorted({round(float(line.get_ydata()[0]), 9) for line in ax.lines if len(line.get_ydata())})
    assert levels == {"bands": [0.5], "quantiles": [0.05, 0.25, 0.5, 0.75, 0.95]}.get(
        kind, starts.ravel().round(9).tolist()
    )
    if kind == "bands":
        extents = [area.get_paths()[0].vertices[:, 1] for area in ax.collections if area.get_paths()]
        np.testing.assert_allclose([(y.min(), y.max()) for y in extents], [(0.05, 0.95), (0.25, 0.75)])
    assert ax.get_ylabel() == "y0"
    assert len(plt.get_fignums()) == 0
    m.plot(kind)
    assert len(plt.get_fignums()) == 1


def test_the_keys_of_thin_lines_can_be_seen():
    ax = ensemble().plot("spaghetti", ax=Figure(layout="constrained").add_subplot())
    for key in ax.get_legend().legend_handles:
        assert key.get_alpha() in (None, 1)
        assert key.get_linewidth() > 1


def test_pictures_need_times_and_known_kinds():
    with pytest.raises(ValueError, match="has only final states: for a picture solve it with times in t_eval"):
        ensemble(t_eval=None).plot()
    with pytest.raises(ValueError, match="kind must be one of 'bands', 'quantiles', 'spaghetti', got 'lines'"):
        ensemble().plot("lines")


def test_statistics_show_their_ranges():
    m = iv.solve_ensemble(lambda t, y, a: -a * y, (0, 1), [1.0], args=[[1.0], [100.0]], workers=1)
    low, high = m.stats.nfev
    assert f"nfev: {low} to {high}" in repr(m.stats)
    assert "clipped" not in repr(m.stats)
    assert "lanes: one at a time: functions are in Python" in repr(m.stats)


def test_labelled_arrays_and_tables():
    pytest.importorskip("xarray")
    m = ensemble()
    data, table = m.to_xarray(), m.to_dataframe()
    np.testing.assert_array_equal(data.y.sel(trajectory=1, component="y1"), m.y[1, 1])
    np.testing.assert_array_equal(data.residual_after, m.residual_after)
    np.testing.assert_array_equal(data.nfev, m.stats.nfev)
    np.testing.assert_array_equal(table.loc[2, "y0"], m.y[2, 0])
    failed = iv.solve_ensemble(lambda t, y: y**2, (0, 2), [[0.1], [1.0]], t_eval=[0, 0.5, 2], workers=1)
    assert len(failed.to_dataframe()) == 5


@pytest.mark.parametrize("kind", ["bands", "quantiles", "spaghetti"])
def test_imaginary_parts_are_drawn_too(kind):
    """y' = i y from 1: cos t and sin t."""
    times = np.linspace(0, 3, 7)
    m = iv.solve_ensemble(lambda t, y: 1j * y, (0, 3), [[1 + 0j], [1 + 0j]], t_eval=times, workers=1, rtol=1e-6)
    ax = m.plot(kind, ax=Figure().add_subplot())
    bands = ["90 % of the trajectories", "50 % of the trajectories"] if kind == "bands" else []
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["Re y0", "Im y0", *bands]
    drawn = [(line.get_linestyle(), line.get_ydata()) for line in ax.lines if len(line.get_ydata())]
    for dashes, expected in (("-", np.cos(times)), ("--", np.sin(times))):
        curves = [values for look, values in drawn if look == dashes]
        assert curves
        for values in curves:
            np.testing.assert_allclose(values, expected, atol=1e-3)


def test_files_and_pickles_give_back_every_value(tmp_path):
    m = ensemble()
    m.save(tmp_path / "m.npz")
    for again in (iv.EnsembleSolution.load(tmp_path / "m.npz"), pickle.loads(pickle.dumps(m))):
        for name in m.keys():  # noqa: SIM118 - m is no dict: a loop goes over trajectories
            if name not in ("events", "stats", "messages"):
                np.testing.assert_array_equal(again[name], m[name])
                assert again[name].dtype == m[name].dtype
        assert again.messages == m.messages
        for a, b in zip(again.events, m.events, strict=True):
            np.testing.assert_array_equal(a.t, b.t)
        np.testing.assert_array_equal(again.stats.nfev, m.stats.nfev)
        np.testing.assert_array_equal(again[1].y, m[1].y)
        np.testing.assert_array_equal(again[1].drift().residual_before, m[1].drift().residual_before)
    with pytest.raises(
        ValueError,
        match=r"m\.npz is of kind 'ensemble' in version \d+ .*: read it with invariode\.EnsembleSolution\.load",
    ):
        iv.load(tmp_path / "m.npz")
    (tmp_path / "other.npz").write_bytes(b"PK nothing")
    single(0).save(tmp_path / "single.npz")
    for name, wrong in (
        ("other", "is incomplete"),
        ("single", r"is of kind 'solution' in .*: read it with invariode\.load"),
    ):
        with pytest.raises(ValueError, match=rf"{name}\.npz {wrong}"):
            iv.EnsembleSolution.load(tmp_path / f"{name}.npz")


def test_native_trajectories_know_their_invariants_too():
    pytest.importorskip("numba")
    f = iv.compile(lambda t, y, p: (p[0] * y[1], -p[0] * y[0]))
    g = iv.compile(lambda t, y, p: y[0] ** 2 + y[1] ** 2)
    invariant = iv.Invariants(g, names="radius")
    m = iv.solve_ensemble(f, (0, 4), STARTS, args=np.array(RATES), t_eval=TIMES, invariants=invariant)
    alone = iv.solve_ivp(f, (0, 4), STARTS[2], args=tuple(RATES[2]), t_eval=TIMES, invariants=invariant)
    np.testing.assert_array_equal(m[2].residual, alone.residual)


class TestEnsemblesOfAProblem:
    """`Problem.solve_ensemble` solves, for each row, the problem with that y0 and those args."""

    def problem(self, compiled=False):
        schedule = iv.Input([0, 1, 2], [0.0, 1.0, 0.0])

        def fed(t, y, u, a):
            return [u - a * y[0], -y[1]]

        def native(t, y, p):
            return p[0] - p[1] * y[0], -y[1]

        if compiled:
            pytest.importorskip("numba")
        fun = iv.compile(native) if compiled else fed
        known = {"labels": ["fed", "free"], "nonnegative": ["free"], "bounds": (None, [0.5, np.inf])}
        return iv.Problem(fun, (0, 3), [0.2, 2.0], args=(2.0,), inputs=schedule, **known)

    @pytest.mark.parametrize("compiled", [False, True])
    def test_labels_inputs_and_bounds_of_the_problem_work(self, compiled):
        problem, times = self.problem(compiled), [0.5, 1.5, 3]
        many = problem.solve_ensemble(args=[[1.0], [2.0]], t_eval=times, workers=1)
        assert many.labels == many[0].to_dataframe().columns.tolist() == ["fed", "free"]
        for i, rate in enumerate((1.0, 2.0)):
            np.testing.assert_array_equal(many.y[i], problem.replace(args=(rate,)).solve(t_eval=times).y)
        assert many.y[:, 0].max() <= 0.5 < problem.replace(bounds=None, args=(1.0,)).solve().y[0].max()

    def test_what_is_not_given_is_that_of_the_problem(self):
        problem = self.problem()
        one = problem.solve().y[:, -1]
        rows = problem.solve_ensemble([[0.2, 2.0], [0.3, 2.0]], workers=1).y_end
        streamed = problem.solve_ensemble(iter([([0.2, 2.0], None), ([0.3, 2.0], None)]), workers=1).y_end
        for first in (problem.solve_ensemble(workers=1).y_end[0], rows[0], streamed[0]):
            np.testing.assert_array_equal(first, one)
        np.testing.assert_array_equal(streamed[1], rows[1])

    def test_labels_come_back_from_files(self, tmp_path):
        many = self.problem().solve_ensemble(workers=1)
        many.save(tmp_path / "many.npz")
        assert iv.EnsembleSolution.load(tmp_path / "many.npz").labels == ["fed", "free"]


@pytest.mark.parametrize("named", [True, False])
def test_tables_and_rows_of_arguments_are_matched_by_name(named):
    """Columns in another order than f has its arguments, as a table, a dict or a list of dicts; not by position."""
    pd = pytest.importorskip("pandas")
    if named:
        problem = iv.Problem(
            lambda t, y, p: [y[1], -p.k * y[0] - p.c * y[1]], (0, 1), [1.0, 0.0], parameters={"k": 1.0, "c": 0.0}
        )
    else:
        problem = iv.Problem(lambda t, y, k, c: [y[1], -k * y[0] - c * y[1]], (0, 1), [1.0, 0.0], args=(1.0, 0.0))
    table = pd.DataFrame({"c": [0.1, 0.2], "k": [4.0, 1.0]})
    expected = [problem.replace(args=row).solve().y_end for row in table.to_dict("records")]
    for args in (table, table.to_dict("records"), table.to_dict("list"), table[["k", "c"]]):
        np.testing.assert_array_equal(problem.solve_ensemble(args=args, workers=1).y_end, expected)
    with pytest.raises(ValueError, match=r"'kk'.*did you mean 'k'"):
        problem.solve_ensemble(args=table.rename(columns={"k": "kk"}), workers=1)
