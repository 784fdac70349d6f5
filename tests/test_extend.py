"""An extension is the rest of the run: nothing is lost, doubled or bent where the parts meet."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit, families_and_series
from problems import PROBLEMS, blow_up, slack

TIGHT = {"rtol": 1e-8, "atol": 1e-10}
KEPLER = PROBLEMS["Kepler"]


def solve(method, t_span, y0=(0.4, 0.0, 0.0, 2.0), **options):
    return iv.solve_ivp(KEPLER.fun, t_span, y0, method, **{**TIGHT, **options})


def crossing(t, y):
    return y[1]


@dealt(method=METHODS, end=[9.0, 20.0])
def test_two_parts_are_one_run(method, end):
    about = {"invariants": KEPLER.invariants(), "events": crossing, "dense_output": True}
    first = solve(method, (0, 5), **about)
    sol, single = first.extend(end), solve(method, (0, end), **about)
    assert (sol.t[0], sol.t[-1], sol.status, sol.message) == (0, end, 0, single.message)
    assert (np.diff(sol.t) > 0).all()
    np.testing.assert_array_equal(sol.t[: len(first.t)], first.t)
    np.testing.assert_array_equal(sol.y[:, : len(first.t)], first.y)
    np.testing.assert_allclose(sol.y[:, -1], KEPLER.solution(end), atol=2e-5)
    np.testing.assert_allclose(sol.t_events[0], single.t_events[0], atol=2e-5)
    assert sol.y_events[0].shape == (len(sol.t_events[0]), 4)
    t = np.linspace(0, end, 400)
    np.testing.assert_allclose(sol.sol(t), single.sol(t), atol=5e-5)
    assert sol.stats.steps == len(sol.steps.t) == len(sol.t) - 1
    np.testing.assert_allclose(sol.steps.t, sol.t[1:], rtol=1e-15)
    for name in ("nfev", "projections", "ng"):
        assert sol.stats[name] > first.stats[name]
    assert sol.stats.failed >= first.stats.failed
    assert sol.nfev == sol.stats.nfev
    assert first.t[-1] == 5  # is as it was


@families_and_series
def test_three_parts_are_two(method):
    first = solve(method, (0, 3))
    sol = first.extend(4).extend(7)
    np.testing.assert_allclose(sol.y[:, -1], KEPLER.solution(7), atol=1e-5 * slack(method))
    again = copy.deepcopy(first).extend(4)
    np.testing.assert_array_equal(again.y, first.extend(4).y)


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_continuous_at_the_seam(method, problem):
    """Within the tolerance of test_dense, also where invariants are projected between steps."""
    middle = sum(problem.t_span) / 3
    sol = iv.solve_ivp(
        problem.fun, (problem.t_span[0], middle), problem.y0, method, invariants=problem.invariants(), dense_output=True
    ).extend(problem.t_span[1])
    np.testing.assert_array_equal(sol.sol.ts, sol.t)
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    around = sol.sol(np.nextafter(middle, [-np.inf, np.inf]))
    np.testing.assert_allclose(around[:, 0], around[:, 1], rtol=1e-12, atol=1e-12)


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_invariants_keep_their_old_values(method, problem):
    """The values are not those at the seam, which crude tolerances leave a little off."""
    end = problem.t_span[1]
    sol = iv.solve_ivp(problem.fun, (0, end / 4), problem.y0, method, invariants=problem.invariants())
    for k in (2, 3, 4):
        sol = sol.extend(k * end / 4)
    assert sol.success
    single = problem.solve(method)
    np.testing.assert_array_equal(sol.drift().value, single.drift().value)
    assert sol.drift().distance_after.max() < 1  # within the tolerance of what was held at first
    np.testing.assert_allclose(np.abs(sol.residual).max(), problem.drift(sol), atol=1e-14)


@families_and_series
def test_the_start_of_the_second_part_is_the_end_of_the_first_to_the_bit(method):
    """The start is not projected again, and f and g are not asked again whether g is an invariant."""
    raw = solve(method, (0, 5), rtol=1e-3, atol=1e-6, invariants=KEPLER.invariants(), interpolation="raw",
                events=iv.Event(lambda t, y: t - 4.321, terminal=True), dense_output=True)  # fmt: skip
    sol = raw.extend(10)
    assert sol.success
    np.testing.assert_array_equal(sol.sol(raw.t[-1]), raw.y[:, -1])


@families_and_series
def test_backwards(method):
    end = 0.5  # t = 0 is a crossing
    sol = solve(method, (20, 13), KEPLER.solution(20.0), events=crossing, dense_output=True).extend(end)
    single = solve(method, (20, end), KEPLER.solution(20.0), events=crossing)
    assert (np.diff(sol.t) < 0).all()
    np.testing.assert_allclose(sol.y[:, -1], KEPLER.solution(end), atol=1e-3)
    np.testing.assert_allclose(sol.t_events[0], single.t_events[0], atol=1e-3)
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)


@explicit_and_implicit
def test_complex_states(method):
    sol = iv.solve_ivp(lambda t, y: 1j * y, (0, 3), [1 + 0j], method, dense_output=True,
                       invariants=lambda t, y: abs(y[0]) ** 2, **TIGHT).extend(9)  # fmt: skip
    assert sol.y.dtype == complex
    np.testing.assert_allclose(sol.sol(7.3), np.exp([7.3j]), atol=1e-5)
    np.testing.assert_allclose(np.abs(sol.y), 1, atol=1e-12)


@families_and_series
def test_an_event_that_ended_the_run_is_not_found_again(method):
    """Whichever side of the root the final state lies on, and however often."""
    event = iv.Event(crossing, terminal=True)
    sol = solve(method, (0, 20), events=[event, lambda t, y: t - 10], dense_output=True)
    for _ in range(5):
        assert sol.status == 1
        sol = sol.extend(20)
    expected = solve(method, (0, 20), events=crossing).t_events[0]
    np.testing.assert_allclose(sol.t_events[0], expected[:6], atol=1e-4)
    assert len(sol.t_events[1]) == 1
    assert sol.t[-1] == sol.t_events[0][-1]
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    assert (sol.extend(20).status, sol.extend(20).t[-1]) == (0, 20)


@explicit_and_implicit
def test_occurrences_are_counted_on(method):
    """Twice in the first part and once in the second are the three that end a run."""
    event = iv.Event(crossing, terminal=3)
    sol = solve(method, (0, 8), events=event)
    assert (sol.status, len(sol.t_events[0])) == (0, 2)
    sol = sol.extend(20)
    assert (sol.status, len(sol.t_events[0])) == (1, 3)
    assert len(sol.extend(100).t_events[0]) == 6


@dealt(method=FAMILIES, shift=[-1e-9, 0.0, 1e-9])
def test_an_event_at_the_seam_is_found_once(method, shift):
    sol = iv.solve_ivp(lambda t, y: [1.0], (0, 4 + shift), [0.0], method, events=lambda t, y: t - 4).extend(10)
    np.testing.assert_allclose(sol.t_events[0], [4.0], atol=1e-14)


def bounce(**more):
    return iv.Event(lambda t, y: y[0], direction=-1, action=lambda t, y: [0.0, -0.8 * y[1]], **more)


@families_and_series
def test_jumps_go_on_and_each_piece_keeps_its_value(method):
    def ball(t, y):
        return [y[1], -1.0]

    def energy(t, y):
        return y[1] ** 2 / 2 + y[0]

    about = {"events": bounce(), "invariants": energy, "dense_output": True, **TIGHT}
    single = iv.solve_ivp(ball, (0, 6), [1.0, 0.0], method, **about)
    sol = iv.solve_ivp(ball, (0, 2), [1.0, 0.0], method, **about).extend(6)
    assert len(sol.t_events[0]) == len(single.t_events[0]) >= 3
    np.testing.assert_allclose(sol.t_events[0], single.t_events[0], atol=1e-9)
    assert np.abs(sol.residual).max() < 1e-12
    t = np.linspace(0, 6, 77)
    np.testing.assert_allclose(sol.sol(t), single.sol(t), atol=1e-7)
    np.testing.assert_allclose(sol.impose().sol(t), sol.sol(t), atol=1e-7)


@families_and_series
def test_a_jump_at_the_very_end(method):
    """The action is taken there, and the extension starts after it."""
    event = iv.Event(lambda t, y: t - 2, action=lambda t, y: [y[0] + 1])
    sol = iv.solve_ivp(lambda t, y: [0.0], (0, 2), [0.0], method, events=event, dense_output=True).extend(4)
    np.testing.assert_array_equal(sol.t_events[0], [2.0])
    np.testing.assert_array_equal(sol.sol([1.0, 2.0, 3.0]), [[0.0, 1.0, 1.0]])
    assert list(sol.y[0, sol.t == 2]) == [0.0, 1.0]


@explicit_and_implicit
def test_stopped_by_the_callback(method):
    sol = solve(method, (0, np.inf), callback=lambda t, y: t > 3)
    assert sol.status == 2
    assert sol.extend(10, callback=None).t[-1] == 10
    assert sol.extend(10).stats.steps == sol.stats.steps + 1


@explicit_and_implicit
def test_times_of_output(method):
    times = np.linspace(0, 10, 21)
    single = solve(method, (0, 10), t_eval=times)
    stop = iv.Event(lambda t, y: t - 4.2, terminal=True)
    sol = solve(method, (0, 10), t_eval=times, events=stop)
    np.testing.assert_array_equal(sol.t, times[:9])
    sol = sol.extend(10)  # those that are left
    np.testing.assert_array_equal(sol.t, times)
    np.testing.assert_allclose(sol.y, single.y, atol=1e-5)
    more = sol.extend(12, t_eval=[10, 11, 12])  # the point at 10 already exists
    np.testing.assert_array_equal(more.t, [*times, 11, 12])
    beyond = sol.extend(12)  # where none are left there is no output
    np.testing.assert_array_equal(beyond.t, times)
    at_once = sol.extend(13, t_eval=[13])
    np.testing.assert_allclose(beyond.extend(13, t_eval=[13]).y[:, -1], at_once.y[:, -1], atol=1e-5)
    assert beyond.t_end == 12
    with pytest.raises(ValueError, match=r"within `t_span`, \(10.0, 12.0\)"):
        sol.extend(12, t_eval=[9])
    with pytest.raises(ValueError, match="output at its steps"):
        solve(method, (0, 1)).extend(2, t_eval=[2])


@explicit_and_implicit
def test_times_beyond_an_extension_are_kept(method):
    times = np.linspace(0, 10, 21)
    sol = solve(method, (0, 10), t_eval=times, events=iv.Event(lambda t, y: t - 4.2, terminal=True))
    np.testing.assert_array_equal(sol.extend(6).extend(8).extend(10).t, times)
    chosen = sol.extend(6, t_eval=[5.1]).extend(10)
    np.testing.assert_array_equal(chosen.t, [*times[:9], 5.1, *times[13:]])


@explicit_and_implicit
def test_changing_what_was_given_or_returned_changes_nothing(method):
    expected = solve(method, (0, 3), keep="all").extend(5)
    sol = solve(method, (0, 3), keep="all")
    sol.y[:] = 0
    np.testing.assert_array_equal(sol.extend(5).y[:, -1], expected.y[:, -1])

    stop = iv.Event(lambda t, y: t - 2.5, terminal=True)
    given = {"t_eval": np.arange(6.0), "rtol": np.full(4, 1e-8), "atol": np.full(4, 1e-10)}
    first = solve(method, (0, 5), events=stop, invariants=KEPLER.invariants(), **given)
    expected, drift = first.extend(5), first.drift()
    for one in given.values():
        one *= 1e3
    np.testing.assert_array_equal(first.extend(5).t, expected.t)
    np.testing.assert_array_equal(first.extend(5).y, expected.y)
    np.testing.assert_array_equal(first.drift().distance_after, drift.distance_after)


@explicit_and_implicit
def test_the_action_of_an_event_that_ended_the_run_is_not_taken(method):
    event = iv.Event(lambda t, y: y[0] - 1, terminal=True, action=lambda t, y: [5.0])
    sol = iv.solve_ivp(lambda t, y: [1.0], (0, 10), [0.0], method, events=event)
    assert sol.y[0, -1] == pytest.approx(1)
    assert sol.extend(3).y[0, -1] == pytest.approx(3)


@dealt(method=FAMILIES, options=[{"keep": "end"}, {"keep": "outputs"}, {"refine": 4}, {"max_step": 0.1}])
def test_the_options_of_the_run_hold(method, options):
    sol = solve(method, (0, 2), **options).extend(4)
    assert len(sol.t) == 1 + (0 if options.get("keep") == "end" else sol.stats.steps * options.get("refine", 1))
    assert (sol.steps is None) == ("keep" in options)
    assert "max_step" not in options or np.diff(sol.t).max() <= 0.11 + 1e-15  # the last may be stretched by a tenth
    np.testing.assert_allclose(sol.y[:, -1], KEPLER.solution(4), atol=1e-6 * slack(method))


@explicit_and_implicit
def test_the_longest_step_is_that_of_the_whole_interval(method):
    sol = iv.solve_ivp(lambda t, y: [0.0], (0, 90), [1.0], method, max_step="tenth").extend(100)
    assert np.abs(sol.steps.h).max() <= 10
    assert sol.steps.h[-1] > (4 if iv.METHODS[method].fixed_order else 0)


def test_pairs_go_on_with_their_step(pair):
    first = solve(pair, (0, 5))
    sol = first.extend(5.5)
    at_seam = sol.steps.h[len(first.steps.t)]
    assert at_seam > 0.1 * first.steps.h[-2]
    chosen = first.extend(5.5, first_step=1e-3)
    assert chosen.steps.h[len(first.steps.t)] == pytest.approx(1e-3)


@explicit_and_implicit
def test_an_imposed_solution_stays_imposed(method):
    sol = solve(method, (0, 5), rtol=1e-4, atol=1e-6, invariants=KEPLER.invariants(), dense_output=True)
    imposed = sol.impose().extend(10)
    assert np.abs(imposed.residual).max() < 1e-14
    whole = sol.extend(10).impose()
    np.testing.assert_array_equal(imposed.y, whole.y)
    np.testing.assert_array_equal(imposed.sol([1.1, 7.3]), whole.sol([1.1, 7.3]))


def test_a_singular_mass_matrix():
    def robertson(t, y):
        a, b, c = y
        return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, a + b + c - 1]

    about = {"mass": np.diag([1.0, 1, 0]), "rtol": 1e-6, "atol": [1e-9, 1e-13, 1e-9], "dense_output": True}
    sol = iv.ode15s(robertson, (0, 1e3), [1.0, 0, 0], **about).extend(1e6)
    single = iv.ode15s(robertson, (0, 1e6), [1.0, 0, 0], **about)
    np.testing.assert_allclose(sol.y[:, -1], single.y[:, -1], rtol=1e-4)
    assert sol.njev > 1
    np.testing.assert_allclose(sol.sol(2e3), single.sol(2e3), rtol=1e-4)


@explicit_and_implicit
def test_from_nothing(method):
    sol = iv.solve_ivp(KEPLER.fun, (0, 0), KEPLER.y0, method, dense_output=True, **TIGHT)
    for end in (1, -1):
        longer = sol.extend(end)
        np.testing.assert_allclose(longer.y[:, -1], KEPLER.solution(end), atol=1e-6 * slack(method))
        np.testing.assert_array_equal(longer.sol(longer.t), longer.y)


@explicit_and_implicit
def test_to_where_it_is(method, tmp_path):
    """A job that is started again after it has finished returns what it has returned, any number of times."""
    path = tmp_path / "run"
    problem = iv.Problem(KEPLER.fun, (0, 2), KEPLER.y0)

    def job():
        return iv.load(path, problem).extend(2) if path.exists() else problem.solve(method, checkpoint=path, **TIGHT)

    first, second, third = job(), job(), job()
    for again in (second, third):
        np.testing.assert_array_equal(again.y, first.y)
        assert repr(again.stats) == repr(first.stats)
    assert job().extend(3).t[-1] == 3


@explicit_and_implicit
def test_it_is_saved_and_loaded_like_any_other(method, tmp_path):
    sol = solve(method, (0, 2), events=crossing, dense_output=True, invariants=KEPLER.invariants()).extend(5)
    sol.save(tmp_path / "orbit.npz")
    again = iv.load(tmp_path / "orbit.npz", invariants=KEPLER.invariants())
    np.testing.assert_array_equal(again.sol([1.1, 3.3]), sol.sol([1.1, 3.3]))
    with pytest.raises(ValueError, match="from a file"):
        again.extend(6)
    plain = pickle.loads(pickle.dumps(solve(method, (0, 2))))  # as before, whatever the functions are
    with pytest.raises(ValueError, match="a pickle"):
        plain.extend(6)


WRONG = {
    "not beyond": (dict(t_end=1.5), ValueError, r"t_end must be beyond the end of the run, t = 2\.0"),
    "the other way": (dict(t_end=-1), ValueError, "in its direction; got -1"),
    "NaN": (dict(t_end=np.nan), ValueError, "t_end must not be NaN"),
    "text": (dict(t_end="late"), TypeError, "t_end must be a real number"),
    "tolerance": (dict(t_end=3, rtol=1e-3), TypeError, "rtol cannot change within a run"),
    "method": (dict(t_end=3, methods="ode45"), TypeError, "unknown option 'methods'"),
    "misspelt": (dict(t_end=3, max_stepp=1), TypeError, "did you mean 'max_step'"),
}


@explicit_and_implicit
@pytest.mark.parametrize("name", WRONG)
def test_refused(method, name):
    options, error, message = WRONG[name]
    with pytest.raises(error, match=message):
        solve(method, (0, 2)).extend(**options)


@explicit_and_implicit
def test_a_run_that_failed_is_not_extended(method):
    sol = iv.solve_ivp(blow_up, (0, 2), [1.0], method)
    with pytest.raises(ValueError, match=r"a run that failed cannot be extended: .*t = "):
        sol.extend(3)


@pytest.mark.parametrize("method", ["ode15s", "ode23t", "ode23tb", "radau"])
def test_gmres_with_sensitivities_continues_bit_for_bit_wherever_a_limit_has_stopped_it(method):
    """Before a breakpoint with a jump of f and of y, at it, and behind it."""
    n = 8

    def chain(t, y, rate, inflow):
        flow = rate * np.concatenate([[inflow if t < 1 else 1.0], y])
        return flow[:-1] - flow[1:]

    options = {
        "args": (2.0, 0.3),
        "sensitivities": True,
        "linear_solver": "gmres",
        "breakpoints": [(1.0, lambda t, y, *args: 1.5 * y)],
        "keep": "end",
    }
    whole = iv.solve_ivp(chain, (0, 2), np.linspace(1, 2, n), method, **options)
    for steps in range(1, whole.stats.steps, whole.stats.steps // 5):
        part = iv.solve_ivp(chain, (0, 2), np.linspace(1, 2, n), method, max_steps=steps, **options)
        assert part.status == -3
        again = part.extend(2, max_steps=None)
        assert (again.y[:, -1] == whole.y[:, -1]).all()
        assert (again.sensitivities[..., -1] == whole.sensitivities[..., -1]).all()
