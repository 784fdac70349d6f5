"""Values with labels mean the same in any order; a label that is no name is an error that shows both."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import invariode as iv
from invariode._base.labelled import by_name

pd = pytest.importorskip("pandas")
xr = pytest.importorskip("xarray")

STATES, NUMBERS = ("gut", "blood"), ("ka", "cl", "v")


def drug(t, y, ka, cl, v):
    return [-ka * y[0], ka * y[0] - cl / v * y[1]]


PROBLEM = iv.Problem(drug, (0, 4), [100.0, 1.0], args=(1.0, 5.0, 30.0), labels=STATES)
TIMES = np.array([1.0, 2.0, 4.0])
DATA = pd.DataFrame({"time": TIMES, "gut": [36.0, 14.0, 2.0], "blood": [55.0, 60.0, 45.0]})
BOUNDS = {"ka": (0.1, 10), "cl": (0.5, 50)}


def delayed(t, y, z):
    return [-z[0, 0], z[0, 0] - z[0, 1]]


def ends(made):
    return made.y_end if hasattr(made, "y_end") else made.y[:, -1]


def value(**options):
    return iv.objective(PROBLEM, DATA, parameters=BOUNDS, **options)([1.1, 4.0])


#: Entrances for one value of each name: the names, and what is computed from the values.
SINGLE = {
    "Problem(y0=)": (STATES, lambda x: ends(iv.Problem(drug, (0, 4), x, args=PROBLEM.args, labels=STATES).solve())),
    "Problem(y0=function)": (
        STATES,
        lambda x: ends(iv.Problem(drug, (0, 4), lambda *args: x, args=PROBLEM.args, labels=STATES).solve()),
    ),
    "Problem(args=)": (NUMBERS, lambda x: ends(iv.Problem(drug, (0, 4), [100.0, 1.0], args=x).solve())),
    "solve_ivp(args=)": (NUMBERS, lambda x: ends(iv.solve_ivp(drug, (0, 4), [100.0, 1.0], args=x))),
    "replace(y0=)": (STATES, lambda x: ends(PROBLEM.replace(y0=x).solve())),
    "replace(args=)": (NUMBERS, lambda x: ends(PROBLEM.replace(args=x).solve())),
    "prepare()(y0=)": (STATES, lambda x: ends(PROBLEM.prepare()(y0=x))),
    "prepare()(args=)": (NUMBERS, lambda x: ends(PROBLEM.prepare()(args=x))),
    "solve_ensemble(y0=)": (STATES, lambda x: ends(PROBLEM.solve_ensemble(x, workers=1))),
    "atol": (STATES, lambda x: ends(PROBLEM.solve(atol=x))),
    "history": (
        STATES,
        lambda x: ends(iv.Problem(delayed, (0, 1), [1, 2], delays=[0.3], history=x, labels=STATES).solve()),
    ),
    "start by history": (
        STATES,
        lambda x: ends(iv.Problem(delayed, (0, 1), None, delays=[0.3], history=x, labels=STATES).solve()),
    ),
    "sigma": (STATES, lambda x: value(sigma=x)),
    "objective": (("ka", "cl"), lambda x: iv.objective(PROBLEM, DATA, parameters=BOUNDS, sigma=1.0)(x)),
}

#: Entrances for rows of values.
ROWS = {
    "solve_ensemble(y0=)": (STATES, lambda x: ends(PROBLEM.solve_ensemble(x, workers=1))),
    "iv.solve_ensemble(args=)": (
        NUMBERS,
        lambda x: ends(iv.solve_ensemble(drug, (0, 4), [100.0, 1.0], args=x, workers=1)),
    ),
    "solve_ensemble(args=)": (NUMBERS, lambda x: ends(PROBLEM.solve_ensemble(args=x, workers=1))),
}


def single_containers(names, values):
    yield dict(zip(names, values, strict=True))
    yield pd.Series(values, index=list(names))
    yield xr.DataArray(values, dims="name", coords={"name": list(names)})


def row_containers(names, rows):
    yield pd.DataFrame(rows, columns=list(names), index=range(5, 5 + len(rows)))
    yield dict(zip(names, rows.T, strict=True))
    yield xr.DataArray(rows, dims=("row", "name"), coords={"name": list(names)})
    yield xr.Dataset({name: ("row", column) for name, column in zip(names, rows.T, strict=True)})
    yield [dict(zip(names, row, strict=True)) for row in rows.tolist()]
    yield [pd.Series(row, index=list(names)) for row in rows]


def test_labelled_values_go_by_name_at_every_entrance():
    for entrances, containers in ((SINGLE, single_containers), (ROWS, row_containers)):
        for what, (names, computed) in entrances.items():
            values = np.array([2.0, 3.0, 40.0][: len(names)])
            values = values if entrances is SINGLE else np.array([values, 1.5 * values])
            expected = computed(values.tolist() if entrances is SINGLE else values)
            for order in itertools.islice(itertools.permutations(range(len(names))), 1, None):
                for given in containers([names[i] for i in order], values[..., list(order)]):
                    np.testing.assert_array_equal(computed(given), expected, err_msg=f"{what}: {given}")
            for wrong in containers(["gutt", *names[1:]], values):
                with pytest.raises(ValueError, match=rf"'gutt'.*{names[-1]}"):
                    computed(wrong)


def test_labels_that_are_no_names_are_refused_and_counting_ones_say_nothing():
    assert by_name("x", pd.Series([1.0, 2.0]), STATES, "components").tolist() == [1.0, 2.0]
    assert by_name("x", pd.DataFrame([[1.0, 2.0]]), STATES, "components").shape == (1, 2)
    for other in (pd.Series([1.0, 2.0], index=[1, 0]), pd.Series([1.0, 2.0], index=[0.5, 1.5])):
        with pytest.raises(ValueError, match=r"no names; by position"):
            PROBLEM.replace(y0=other)
    with pytest.raises(ValueError, match=r"the label 'gut' twice"):
        PROBLEM.solve_ensemble(pd.DataFrame([[1.0, 2.0]], columns=["gut", "gut"]))
    for study in (
        lambda y: iv.impose(lambda t, y: y @ y, 0.0, y),
        lambda y: iv.check_invariants(lambda t, y: [y[1], -y[0]], lambda t, y: y @ y, 0.0, y),
    ):
        with pytest.raises(TypeError, match="by name for blood, gut"):  # there are no names to match these with
            study(pd.Series({"blood": 1.0, "gut": 2.0}))
    with pytest.raises(ValueError, match=r"missing for 'blood'"):
        iv.Problem(drug, (0, 1), {"gut": 1.0}, args=(1.0, 5.0, 30.0), labels=STATES)
    with pytest.raises(ValueError, match=r"columns of y0 must be of one length"):
        PROBLEM.solve_ensemble({"gut": [1.0, 2.0], "blood": [1.0, 2.0, 3.0]})


def test_labels_change_what_they_name_and_give_names_to_components_that_have_none():
    assert PROBLEM.replace(y0={"blood": 7.0}).y0.tolist() == [100.0, 7.0]
    assert PROBLEM.replace(args=pd.Series({"v": 10.0})).args == (1.0, 5.0, 10.0)
    record = iv.Problem(lambda t, y, p: [-p.ka * y[0]], (0, 1), [1.0], parameters={"ka": 1.0, "cl": 2.0})
    assert record.replace(args=pd.Series({"cl": 5.0})).parameters == {"ka": 1.0, "cl": 5.0}
    many = PROBLEM.solve_ensemble(pd.DataFrame({"gut": [50.0, 100.0]}), workers=1)
    np.testing.assert_array_equal(many.y_end[1], ends(PROBLEM.solve()))
    named = iv.Problem(drug, (0, 4), {"a": 100.0, "b": 0.0}, args={"v": 30.0, "ka": 1.0, "cl": 5.0})
    assert (named.labels, named.args) == (["a", "b"], (1.0, 5.0, 30.0))
    with pytest.raises(ValueError, match=r"'gut'.*y0, y1"):
        iv.Problem(drug, (0, 4), [1.0, 0.0], args=PROBLEM.args).replace(y0={"gut": 1.0})


def test_components_without_a_label_follow_the_arguments_where_y0_does():
    """y' = -k y from (2 k, 3 k²) at other k, with A given: B(1) = 3 k² exp(-k), and dB(1)/dk, for single runs and rows
    of an ensemble; A has the derivative of a given start."""

    def start(p):
        return [2 * p.k, 3 * p.k**2]

    plain = iv.Problem(lambda t, y, p: -p.k * y, (0, 1), start, labels=["A", "B"], parameters={"k": 0.5})
    problem, k = plain.replace(sensitivities=True), np.array([1.0, 2.0])
    slopes = np.column_stack([-np.array([5, 7]) * np.exp(-k), (6 * k - 3 * k**2) * np.exp(-k)])
    assert plain.replace(y0={"A": 5}).replace(y0={"B": 1}).replace(parameters={"k": 2}).y0.tolist() == [5, 1]
    for given in ({"A": [5.0, 7.0]}, [{"A": 5.0}, {"A": 7.0}]):
        assert plain.solve_ensemble(given, workers=1, t_eval=[0]).y[:, :, 0].tolist() == [[5, 0.75], [7, 0.75]]
        many = problem.solve_ensemble(given, args={"k": k}, workers=1, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(many.y_end[:, 1], 3 * k**2 * np.exp(-k), rtol=1e-7)
        np.testing.assert_allclose(many.sensitivities[:, :, 0, -1], slopes, rtol=1e-7, atol=1e-7)
    single = problem.replace(y0={"A": 7.0}, parameters={"k": 2.0}).solve(rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(single.sensitivities[:, 0, -1], slopes[1], rtol=1e-7, atol=1e-7)
    with pytest.raises(ValueError, match="y0 names 'C': the components are A, B"):
        plain.replace(y0={"C": 1.0})


def test_observe_selects_columns_of_a_table():
    both = iv.Experiment(PROBLEM, DATA)
    assert both.names == ["gut", "blood"]
    for given in (DATA, dict(DATA), DATA[["blood", "time", "gut"]]):
        for one in ("blood", 1, ["blood"]):
            found = iv.Experiment(PROBLEM, given, observe=one)
            assert (found.names, found.data.values.tolist()) == (["blood"], [DATA.blood.tolist()])
        swapped = iv.Experiment(PROBLEM, given, observe=["blood", "gut"])
        assert swapped.data.values.tolist() == [DATA.blood.tolist(), DATA.gut.tolist()]
    named = DATA.rename(columns={"blood": "DV"})[["time", "DV"]]
    assert iv.Experiment(PROBLEM, named, observe="blood").names == ["blood"]
    with pytest.raises(ValueError, match=r"observe names 'gut'.*columns of data are blood"):
        iv.Experiment(PROBLEM, DATA[["time", "blood"]], observe="gut")
    with pytest.raises(ValueError, match="component twice"):
        iv.Experiment(PROBLEM, DATA, observe=["blood", "gut", "blood"])
    with pytest.raises(ValueError, match="2 quantities, gut, blood, and 1"):
        iv.Experiment(PROBLEM, DATA, observe=lambda t, y, *args: y[1])
    with pytest.raises(ValueError, match="two columns 'blood'"):
        iv.Experiment(PROBLEM, pd.concat([DATA, DATA.blood], axis=1))
    text = DATA.astype(object)
    text.loc[1, "blood"] = "<0.3"
    with pytest.raises(TypeError, match=r"'<0\.3' at 1"):
        iv.Experiment(PROBLEM, text)


def test_an_unnamed_integer_index_is_no_time():
    for rows in ([0, 1, 2], [1, 2, 4]):
        table = DATA[["blood"]].set_axis(rows)
        with pytest.raises(ValueError, match="index has no name and may count rows"):
            iv.Experiment(PROBLEM, table)
    hours = table.rename_axis("hours")
    for made in (
        iv.Experiment(PROBLEM, table.rename_axis("t")),
        iv.Experiment(PROBLEM, table.set_axis(TIMES)),
        iv.Experiment(PROBLEM, "hours", hours),
        iv.Experiment(PROBLEM, xr.Dataset({"blood": ("time", DATA.blood)}, {"time": TIMES})),
        iv.Experiment(
            PROBLEM, data=xr.DataArray([DATA.blood], dims=("q", "time"), coords={"q": ["blood"], "time": TIMES})
        ),
    ):
        assert made.data.t.tolist() == TIMES.tolist()


def test_results_keep_labels_of_rows_and_parameters(tmp_path):
    """Results of part of a table join with the table."""
    table = pd.DataFrame({"cl": [3.0, 5.5, 8.0], "ka": [1.0, 1.1, 1.2]}, index=["P1", "P7", "P9"])
    part = table[table.cl > 5]
    many = PROBLEM.solve_ensemble(args=part, t_eval=TIMES, workers=1)
    many.save(tmp_path / "many.npz")
    for made in (many, iv.EnsembleSolution.load(tmp_path / "many.npz")):
        assert made.index.tolist() == ["P7", "P9"]
        rows = made.to_dataframe()
        assert rows.loc["P9", "cl"].tolist() == [8.0] * len(TIMES)
        joined = rows.reset_index().join(table.add_prefix("of table "), on="trajectory")
        assert (joined["cl"] == joined["of table cl"]).all()
        data = made.to_xarray()
        np.testing.assert_array_equal(data.y.sel(trajectory="P7"), many.y[0])
        assert data.ka.sel(trajectory="P9") == 1.2
    for index in (pd.to_datetime(["2026-01-01", "2026-02-01"]), pd.MultiIndex.from_product([["P1", "P7"], [1]])):
        many = PROBLEM.solve_ensemble(args=part.set_axis(index), workers=1)
        many.save(tmp_path / "other.npz")
        loaded = iv.EnsembleSolution.load(tmp_path / "other.npz")
        assert many.to_dataframe().index.get_level_values(0).tolist() == index.tolist()
        assert loaded.index.tolist() == loaded.to_xarray().trajectory.values.tolist() == [*map(str, index)]
    plain = PROBLEM.solve_ensemble(args=part.reset_index(drop=True), workers=1)
    assert plain.index.tolist() == [0, 1]
    with pytest.raises(ValueError, match="the rows of y0 and args have other labels, P9, P7 and P7, P9"):
        PROBLEM.solve_ensemble(pd.DataFrame({"gut": [1.0, 2.0]}, index=["P9", "P7"]), args=part)
    with pytest.raises(ValueError, match=r"y0\[gut\] is an initial value"):
        PROBLEM.solve_ensemble(args=pd.DataFrame({"y0[gut]": [50.0, 100.0]}))
    starts = pd.DataFrame({"gut": [1.0, np.nan]}, index=part.index)
    with pytest.warns(iv.FailureWarning, match=r"number 1 \(P9\)"):
        PROBLEM.solve_ensemble(starts, workers=1)
