"""A failed run says so as it is asked to: by its status, by a warning, or by an exception that has the results so far;
and no result of a failed trajectory can be mistaken for that of one that reached the end."""

from __future__ import annotations

import pickle
import traceback

import numpy as np
import pytest

import invariode as iv

numba = pytest.importorskip("numba")


def explosion(t, y):
    """From 1 it reaches infinity at t = 1."""
    return [y[0] ** 2]


def drifting(t, y):
    """|y|² is conserved up to t = 1."""
    return [y[1], -y[0] - max(t - 1, 0) * y[1]]


def square(t, y):
    return y @ y


#: What fails, with which status, and the exception that says so.
FAILURES = {
    -1: (explosion, [1.0], {}, iv.SolveError),
    -2: (drifting, [1.0, 0.5], {"invariants": square}, iv.InvariantError),
    -3: (explosion, [1.0], {"max_steps": 3}, iv.SolveError),
}


@pytest.mark.parametrize("status", FAILURES)
class TestRun:
    def test_it_returns_warns_or_raises(self, status):
        fun, y0, options, error = FAILURES[status]
        sol = iv.solve_ivp(fun, (0, 3), y0, on_failure="return", **options)
        assert sol.status == status
        if status == -2:
            with pytest.raises(iv.InvariantError) as contradicted:
                iv.solve_ivp(fun, (0, 3), y0, **options)
            np.testing.assert_array_equal(contradicted.value.solution.y, sol.y)
        else:
            assert iv.solve_ivp(fun, (0, 3), y0, **options).status == status
        with pytest.warns(iv.FailureWarning) as told:
            iv.solve_ivp(fun, (0, 3), y0, on_failure="warn", **options)
        assert told[0].filename == __file__
        with pytest.raises(error) as raised:
            iv.solve_ivp(fun, (0, 3), y0, on_failure="raise", **options)
        if status != -3:  # which states the seconds
            assert str(told[0].message) == str(raised.value) == sol.message
        np.testing.assert_array_equal(raised.value.solution.y, sol.y)
        assert raised.value.solution.status == status

    def test_prepared_solvers_do_the_same(self, status):
        fun, y0, options, error = FAILURES[status]
        solver = iv.Problem(fun, (0, 3), y0, invariants=options.get("invariants")).prepare(
            on_failure="raise", **{name: value for name, value in options.items() if name != "invariants"}
        )
        with pytest.raises(error) as raised:
            solver()
        assert raised.value.solution.status == status
        with pytest.raises(error):
            solver(y0=np.array(y0) * 1.01)

    def test_extensions_do_the_same(self, status):
        fun, y0, options, error = FAILURES[status]
        half = iv.solve_ivp(fun, (0, 0.2), y0, on_failure="raise", **{**options, "max_steps": None})
        with pytest.raises(error) as raised:
            half.extend(3, max_steps=options.get("max_steps"))
        assert raised.value.solution.t[0] == 0
        assert half.extend(3, max_steps=options.get("max_steps"), on_failure="return").status == status


def test_errors_travel_with_their_solutions():
    with pytest.raises(iv.SolveError) as raised:
        iv.solve_ivp(explosion, (0, 3), [1.0], on_failure="raise")
    again = pickle.loads(pickle.dumps(raised.value))
    assert str(again) == str(raised.value)
    np.testing.assert_array_equal(again.solution.y, raised.value.solution.y)


def test_refused_starts_are_of_the_same_kind():
    """One `except` is enough, whether y0 shows that an invariant is wrong or a later point does."""
    with pytest.raises(iv.SolveError) as raised:
        iv.solve_ivp(lambda t, y: [y[1], -2 * y[0]], (0, 3), [1.0, 0.5], invariants=square, on_failure="raise")
    assert isinstance(raised.value, iv.InvariantError)
    assert isinstance(raised.value, ValueError)
    assert raised.value.solution is None


def test_a_failure_after_an_event_at_the_start_raises_too():
    start = iv.Event(lambda t, y: y[0] - 1, at_start=True)
    with pytest.raises(iv.SolveError) as raised:
        iv.solve_ivp(explosion, (0, 3), [1.0], events=start, on_failure="raise")
    assert raised.value.solution.t_events[0].tolist() == [0]


def typo(t, y):
    return [undefined]  # noqa: F821  # raises NameError: the test


def some_explode(t, y):
    return [y[0] ** 2]


MANY = {"Python": some_explode, "compiled": iv.compile(lambda t, y: y[0] * y[0])}
STARTS = [[0.1], [2.0], [0.2], [1.0]]  # the second and the fourth reach infinity before t = 2


class TestEnsemble:
    def test_an_exception_in_all_trajectories_leaves_no_states(self):
        for workers in (1, 2):
            with pytest.warns(iv.FailureWarning, match=r"^3 of 3 .*the first, number 0: NameError: .*'undefined'"):
                many = iv.solve_ensemble(typo, (0, 1), np.ones((3, 1)), workers=workers)
            assert np.isnan(many.y).all()
            assert np.isnan(many.y_end).all()
            assert len(many.to_dataframe()) == len(many[0].t) == 0
            assert isinstance(many.exception, NameError)
            assert "in typo" in "".join(traceback.format_exception(many.exception))
            assert isinstance(pickle.loads(pickle.dumps(many)).exception, NameError)

    @pytest.mark.parametrize("kind", MANY)
    @pytest.mark.parametrize("t_eval", [None, [2.0], [0.25, 2.0]])
    def test_the_states_of_those_that_failed_are_nan_where_they_did_not_get(self, kind, t_eval):
        with pytest.warns(iv.FailureWarning, match="2 of 4 trajectories failed; the first, number 1: Unable to meet"):
            many = iv.solve_ensemble(MANY[kind], (0, 2), STARTS, workers=1, t_eval=t_eval)
        assert many.failed.tolist() == [1, 3]
        assert np.isnan(many.y[[1, 3], 0, -1]).all()
        np.testing.assert_allclose(many.y[[0, 2], 0, -1], [0.125, 1 / 3], rtol=1e-2)
        assert (many.t_end[[1, 3]] < 1.01).all()
        assert (many.y_end[[1, 3]] > 100).all()
        rows = many.to_dataframe()
        assert rows.loc[(0, 2.0)].item() == many.y[0, 0, -1]
        assert (1, 2.0) not in rows.index

    def test_it_warns_returns_or_raises(self):
        silent = iv.solve_ensemble(explosion, (0, 2), STARTS, workers=1, on_failure="return")
        assert silent.exception is None
        with pytest.raises(iv.SolveError, match="2 of 4 trajectories failed; the first, number 1") as raised:
            iv.solve_ensemble(explosion, (0, 2), STARTS, workers=1, on_failure="raise")
        np.testing.assert_array_equal(raised.value.solution.y, silent.y)
        with pytest.raises(iv.SolveError) as raised:
            iv.solve_ensemble(typo, (0, 2), STARTS, workers=2, on_failure="raise")
        assert isinstance(raised.value.__cause__, NameError)
        with pytest.raises(ValueError, match="on_failure must be one of 'return', 'warn', 'raise', got 'ignore'"):
            iv.solve_ensemble(typo, (0, 2), STARTS, on_failure="ignore")

    def test_in_parts_and_stores_the_first_is_the_first_of_all(self, tmp_path):
        rows = iter([(one, ()) for one in STARTS])
        with pytest.warns(iv.FailureWarning, match="2 of 4 .* number 1: "):
            many = iv.solve_ensemble(explosion, (0, 2), rows, workers=1, chunk=1)
        assert many.failed.tolist() == [1, 3]
        pytest.importorskip("zarr")
        with pytest.warns(iv.FailureWarning, match="2 of 4 .* number 1: "):
            kept = iv.solve_ensemble(explosion, (0, 2), STARTS, workers=1, chunk=3, store=tmp_path / "many")
        np.testing.assert_array_equal(kept.load().y, many.y)
        with pytest.raises(iv.SolveError, match=r"4 of 4 .* NameError") as raised:
            iv.solve_ensemble(typo, (0, 2), STARTS, workers=1, store=tmp_path / "typo", on_failure="raise")
        assert raised.value.solution.failed.tolist() == [0, 1, 2, 3]

    def test_what_a_retry_cures_is_no_failure(self):
        def sometimes(t, y, limit):
            if y[0] > limit:
                raise ArithmeticError("too high")
            return [1.0]

        about = {"args": [[0.5], [5.0]], "workers": 1}
        with pytest.warns(iv.FailureWarning, match="1 of 2 .* number 0: ArithmeticError: too high"):
            many = iv.solve_ensemble(sometimes, (0, 1), [0.0], **about)
        assert str(many.exception) == "too high"
        # max_step keeps the stages of all steps below the limit of the second attempt
        low = {"args": [[1.001], [5.0]], "workers": 1, "rtol": 1e-3}
        many = iv.solve_ensemble(sometimes, (0, 1), [0.0], retry={"max_step": 0.01}, **low)
        assert many.exception is None
        assert many.success.all()

    def test_single_trajectories_have_their_own_times(self):
        """This holds too if the state at t_eval is the final state, as that of a solution at rest is."""
        rest = iv.solve_ensemble(lambda t, y: [0.0], (0, 1), [[1.0], [2.0]], t_eval=[0.5], workers=1)
        assert rest[1].t.tolist() == [0.5]
        assert rest.to_dataframe().index.get_level_values("t").tolist() == [0.5, 0.5]
        stop = iv.Event(lambda t, y: y[0] - 1, terminal=True)
        moving = iv.solve_ensemble(lambda t, y: [1.0], (0, 2), [[0.0], [3.0]], events=stop, workers=1)
        for one in (moving, pickle.loads(pickle.dumps(moving))):
            np.testing.assert_allclose(one.to_dataframe().index.get_level_values("t"), [1, 2], rtol=1e-12)
            np.testing.assert_allclose(one[0].t, [1], rtol=1e-12)

    def test_drift_is_known_where_actions_change_values(self):
        """The residuals of a ball whose energy is halved in each impact are kept, but not those at single outputs."""
        impact = iv.Event(lambda t, y: y[0], direction=-1, action=lambda t, y: [0.0, -0.7 * y[1]])
        law = iv.Invariants(lambda t, y: 9.81 * y[0] + y[1] ** 2 / 2, names="energy")
        about = {"events": impact, "invariants": law, "t_eval": [0.1, 1.0]}
        many = iv.solve_ensemble(lambda t, y: [y[1], -9.81], (0, 1), [[1.0, 0.0]], workers=1, **about)
        alone = iv.solve_ivp(lambda t, y: [y[1], -9.81], (0, 1), [1.0, 0.0], **about)
        for one in (many[0], pickle.loads(pickle.dumps(many))[0]):
            drift = one.drift()
            np.testing.assert_array_equal(drift.residual_before, alone.drift().residual_before)
            np.testing.assert_allclose(drift.residual_after, alone.drift().residual_after, atol=1e-12)
            with pytest.raises(ValueError, match="solve this trajectory alone"):
                one.residual  # noqa: B018  # raises: the test
        assert many[0].drift().names == ["energy"]


def test_the_residual_is_that_of_the_outputs_as_they_are():
    sol = iv.solve_ivp(drifting, (0, 0.5), [1.0, 0.5], invariants=square)
    before = sol.residual
    assert np.abs(before).max() < 1e-9
    sol.y = 2 * sol.y
    np.testing.assert_allclose(sol.residual, 3 * 1.25, rtol=1e-9)
    sol.y[:] = 0
    np.testing.assert_allclose(sol.residual, -1.25)
    assert sol.drift().residual_after == 1.25


def test_a_file_knows_residuals_only_at_its_outputs(tmp_path):
    iv.solve_ivp(drifting, (0, 0.5), [1.0, 0.5], invariants=square).save(tmp_path / "run.npz")
    sol = iv.load(tmp_path / "run.npz")
    assert np.abs(sol.residual).max() < 1e-9
    sol.y = 2 * sol.y
    with pytest.raises(ValueError, match="the functions of the invariants square are not in the file"):
        sol.residual  # noqa: B018  # raises: the test
