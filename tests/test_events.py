"""Events: each sign change once, in time order, to a few ulp of t, with states on the solution and on the manifold."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt, explicit_and_implicit, families, families_and_series
from problems import PROBLEMS


def clock(t, y):
    """y0 is the time itself, exactly representable by every method."""
    return [1.0, -y[1]]


def at(*times):
    """An event with simple zeros at the given times."""

    def event(t, y):
        return np.prod([y[0] - s for s in times])

    return event


def run(method, events, t_span=(0, 10), **options):
    return iv.solve_ivp(clock, t_span, [t_span[0], 1.0], method, events=events, rtol=1e-6, **options)


@families_and_series
def test_roots_are_found_to_a_few_ulp(method):
    times = [0.3, 1.7, 4.00001, 9.99]
    sol = run(method, [at(s) for s in times])
    for s, found, states in zip(times, sol.t_events, sol.y_events, strict=True):
        assert len(found) == len(states) == 1
        assert abs(found[0] - s) <= 8 * np.spacing(10.0)
        np.testing.assert_allclose(states[0][0], found[0], rtol=1e-14)


@explicit_and_implicit
def test_several_roots_in_one_step_are_all_found_in_order(method):
    """Steps of length 1: three zeros between 4 and 5, of one function."""
    times = [4.1, 4.45, 4.8]
    sol = run(method, at(*times), max_step=1, first_step=1)
    np.testing.assert_allclose(sol.t_events[0], times, rtol=1e-14)


@families_and_series
def test_root_exactly_at_the_end_of_a_step_is_reported_once(method):
    sol = iv.solve_ivp(clock, (0, 10), [0, 0], method, events=lambda t, y: t - 4, max_step=1, first_step=1)
    assert 4.0 in sol.t
    np.testing.assert_array_equal(sol.t_events[0], [4.0])
    np.testing.assert_array_equal(sol.y_events[0][0], sol.y[:, list(sol.t).index(4.0)])
    at_the_end = run(method, lambda t, y: t - 10)
    np.testing.assert_array_equal(at_the_end.t_events[0], [10.0])


@explicit_and_implicit
def test_event_that_is_zero_at_the_start_sleeps_until_it_has_left_zero(method):
    assert run(method, at(0.0)).t_events[0].size == 0
    np.testing.assert_allclose(run(method, at(0.0, 3.0)).t_events[0], [3.0], rtol=1e-14)
    never = run(method, lambda t, y: 0.0)
    assert never.t_events[0].size == 0


@explicit_and_implicit
def test_touch_without_a_sign_change_is_no_event(method):
    sol = run(method, lambda t, y: (y[0] - 4.0) ** 2 * (1 if y[0] != 4.0 else 0), max_step=0.37)
    assert sol.t_events[0].size == 0


@explicit_and_implicit
@pytest.mark.parametrize(("direction", "expected"), [(1, [2.0, 6.0]), (-1, [4.0]), (0, [2.0, 4.0, 6.0])])
def test_direction(method, direction, expected):
    sol = run(method, iv.Event(at(2.0, 4.0, 6.0), direction=direction))
    np.testing.assert_allclose(sol.t_events[0], expected, rtol=1e-14)


@explicit_and_implicit
def test_direction_is_that_of_the_integration(method):
    """Backwards, a function that rises with t falls."""
    sol = run(method, [iv.Event(at(5.0), direction=-1), iv.Event(at(5.0), direction=1)], t_span=(10, 0))
    assert [len(found) for found in sol.t_events] == [1, 0]


@explicit_and_implicit
def test_backwards_in_the_order_of_integration(method):
    sol = run(method, at(2.0, 5.0, 7.0), t_span=(10, 0))
    np.testing.assert_allclose(sol.t_events[0], [7.0, 5.0, 2.0], rtol=1e-14)


@explicit_and_implicit
@pytest.mark.parametrize("count", [1, 2, 3])
def test_terminal_at_an_occurrence(method, count):
    times = [2.0, 3.0, 5.0]
    event = iv.Event(at(*times), terminal=count)
    sol = run(method, [event, at(2.5), at(9.0)], dense_output=True)
    assert sol.status == 1
    assert sol.success
    assert sol.message == "A termination event occurred."
    np.testing.assert_allclose(sol.t_events[0], times[:count], rtol=1e-14)
    assert len(sol.t_events[1]) == (count > 1)
    assert len(sol.t_events[2]) == 0
    assert sol.t[-1] == sol.t_events[0][-1] == sol.sol.t_max
    np.testing.assert_array_equal(sol.y[:, -1], sol.y_events[0][-1])
    np.testing.assert_array_equal(sol.sol(sol.t[-1]), sol.y[:, -1])


@explicit_and_implicit
def test_ties_with_the_terminal_event_are_reported_and_later_roots_dropped(method):
    """At one instant all; in the same step but later, none."""
    sol = run(method, [at(4.4), iv.Event(at(4.4), terminal=True), at(4.4), at(4.41)], max_step=1, first_step=1)
    assert [len(found) for found in sol.t_events] == [1, 1, 1, 0]
    assert sol.t_events[0][0] == pytest.approx(4.4, rel=1e-14)
    assert all(found[0] <= sol.t[-1] for found in sol.t_events[:3])


@explicit_and_implicit
def test_output_ends_with_the_terminal_event(method):
    event = iv.Event(at(4.4), terminal=True)
    at_times = run(method, event, t_eval=np.arange(0, 10.5, 0.5))
    np.testing.assert_array_equal(at_times.t, np.arange(0, 4.5, 0.5))
    refined = run(method, event, refine=4)
    assert refined.t[-1] == pytest.approx(4.4)
    assert (np.diff(refined.t) > 0).all()
    end = run(method, event, keep="end")
    assert end.t.shape == (1,)
    assert end.t[0] == refined.t[-1]


@explicit_and_implicit
def test_infinite_interval_is_cut_by_a_terminal_event(method):
    sol = run(method, iv.Event(at(123.0), terminal=True), t_span=(0, np.inf))
    assert sol.t[-1] == pytest.approx(123.0, rel=1e-13)
    still = iv.solve_ivp(lambda t, y: [0.0], (0, np.inf), [1.0], method, events=iv.Event(lambda t, y: t - 50, True))
    assert still.t[-1] == pytest.approx(50, rel=1e-13)


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_event_states_are_on_the_manifold(method, problem):
    """Located and returned on the projected solution: at every event of the run, and at the terminal one."""

    def crossing(t, y):
        return y[0] - problem.y0[0] + 0.1

    sol = problem.solve(method, events=iv.Event(crossing), refine=2)
    assert len(sol.t_events[0]) > 0
    residuals = sol._invariants.residual(sol.t_events[0], sol.y_events[0].T)
    assert np.abs(residuals).max() <= 1.01 * np.abs(sol.residual).max() + 1e-12
    for y in sol.y_events[0]:
        assert abs(crossing(0, y)) < 1e-11
    terminal = problem.solve(method, events=iv.Event(crossing, terminal=True))
    assert np.abs(terminal.residual[:, -1]).max() <= 1.01 * np.abs(sol.residual).max() + 1e-12


@families_and_series
def test_raw_and_corrected_event_states_are_on_their_interpolants(method):
    problem = PROBLEMS["Kepler"]
    for mode in ("corrected", "raw"):
        sol = problem.solve(method, events=lambda t, y: y[1], interpolation=mode, dense_output=True)
        assert len(sol.t_events[0]) > 0
        for t, y in zip(sol.t_events[0], sol.y_events[0], strict=True):
            np.testing.assert_allclose(sol.sol(t), y, rtol=1e-12, atol=1e-12)


@families_and_series
def test_no_event_is_lost_or_doubled_over_a_long_run(method):
    """sin t crosses zero at every multiple of π."""
    sol = iv.solve_ivp(
        lambda t, y: [y[1], -y[0]], (0, 100.5), [0, 1], method, rtol=1e-9, atol=1e-12, events=lambda t, y: y[0]
    )
    np.testing.assert_allclose(sol.t_events[0], np.pi * np.arange(1, 32), rtol=1e-6)


@explicit_and_implicit
def test_nan_is_an_error_that_names_the_event(method):
    def height(t, y):
        return np.nan if t > 5 else 1.0

    with pytest.raises(ValueError, match="event height returned NaN at t = "):
        run(method, height)


@explicit_and_implicit
def test_attributes_as_in_scipy(method):
    def plain(t, y):
        return y[0] - 3

    plain.terminal = True
    plain.direction = 1
    assert run(method, plain).status == 1
    plain.direction = -1
    assert run(method, [plain]).status == 0


def test_wrong_attributes():
    for terminal in (-1, 1.5, "yes"):
        with pytest.raises(ValueError, match="each event must be a boolean or positive integer"):
            run("ode45", iv.Event(at(1.0), terminal=terminal))
    with pytest.raises(TypeError, match="direction of"):
        run("ode45", iv.Event(at(1.0), direction="up"))
    with pytest.raises(TypeError, match="name of an event must be a string that is not empty"):
        iv.Event(at(1.0), name="")
    with pytest.raises(TypeError, match="an event must be a function"):
        run("ode45", [3])
    with pytest.raises(TypeError, match="events must be a function"):
        run("ode45", 3)


# ----------------------------------------------------------------------------------------------------------------------
# Several roots in a step

LONG = {"first_step": 1.0, "max_step": np.inf, "keep": "end"}


def one_long_step(method, event, **options):
    """y' = 1 from 0 to 1: one step, in which the solution is exact, with every method."""
    return iv.solve_ivp(lambda t, y: [1.0], (0, 1), [0.0], method, events=event, **LONG, **options)


def many_roots(roots):
    return lambda t, y: np.prod(4 * (y[0] - roots))


@dealt(method=FAMILIES, count=[1, 2, 5, 10, 20])
def test_adaptive_samples_find_all_roots_of_a_step(method, count):
    """Random ones, the closest at a distance of 1e-4; the usual points miss most of them."""
    rng = np.random.default_rng(count)
    for _ in range(5):
        roots = np.sort(rng.uniform(0.01, 0.99, count))
        if count > 1 and np.diff(roots).min() < 1e-4:
            continue
        found = one_long_step(method, iv.Event(many_roots(roots), samples="adaptive")).t_events[0]
        assert len(found) == count
        np.testing.assert_allclose(found, roots, atol=1e-9)


@dealt(method=FAMILIES, rate=[3, 10, 40])
def test_adaptive_samples_find_all_roots_of_sines(method, rate):
    found = one_long_step(method, iv.Event(lambda t, y: np.sin(rate * np.pi * y[0] + 0.3), samples="adaptive"))
    exact = (np.arange(1, rate + 1) * np.pi - 0.3) / (rate * np.pi)
    np.testing.assert_allclose(found.t_events[0], exact, rtol=1e-13)


@explicit_and_implicit
def test_so_many_samples_find_roots_between_them(method):
    """Two roots at a distance of 0.05 are seen by 40 points and not by the fewest."""
    roots = np.array([0.505, 0.555])
    about = many_roots(roots)
    np.testing.assert_allclose(one_long_step(method, iv.Event(about, samples=40)).t_events[0], roots, rtol=1e-13)
    assert len(one_long_step(method, iv.Event(about, samples=1)).t_events[0]) == 0


@explicit_and_implicit
def test_attribute_of_a_function(method):
    def event(t, y):
        return np.sin(40 * y[0] + 0.3)

    event.samples = "adaptive"
    assert len(one_long_step(method, event).t_events[0]) == 12


@families
def test_kinks_jumps_touches_and_noise_end(method):
    """Roots that no polynomial resolves are left to signs, after a bounded number of samples."""
    calls = 0

    def counted(fun):
        def event(t, y):
            nonlocal calls
            calls += 1
            return fun(y[0])

        return iv.Event(event, samples="adaptive")

    rng = np.random.default_rng(0)
    expected = {
        "kink": (lambda t: abs(t - 0.3) - 0.1, 2),
        "jump": (lambda t: 1.0 if t > 0.7 else -1.0, 1),
        "touch": (lambda t: (t - 0.4) ** 2 + 1e-30, 0),
        "constant": (lambda t: 2.0, 0),
        "zero": (lambda t: 0.0, 0),
        "infinite": (lambda t: np.inf if t < 0.5 else -1.0, 1),
        "noise": (lambda t: 1 + rng.normal() * 1e-3, 0),
    }
    for name, (fun, count) in expected.items():
        calls = 0
        assert len(one_long_step(method, counted(fun)).t_events[0]) == count, name
        assert calls < 4000, name


@explicit_and_implicit
def test_cubic_of_scipys_issue_9228(method):
    """y = (x + 6)(x + 2)(x - 2) has three zeros, two of which SciPy's solve_ivp steps over."""
    for samples in (None, "adaptive"):
        sol = iv.solve_ivp(
            lambda x, y: [3 * x**2 + 12 * x - 4], (-8, 4), [-120.0], method, max_step=np.inf,
            events=iv.Event(lambda x, y: y[0], samples=samples), rtol=1e-6,
        )  # fmt: skip
        np.testing.assert_allclose(sol.t_events[0], [-6, -2, 2], atol=1e-3)


@families_and_series
def test_adaptive_samples_on_the_manifold(method):
    """Events are located on the projected solution, backwards and with actions too."""
    kepler = PROBLEMS["Kepler"]
    about = {"invariants": kepler.invariants(), "rtol": 1e-6, "atol": 1e-8}
    usual = iv.solve_ivp(kepler.fun, (0, 10), kepler.y0, method, events=lambda t, y: y[1], **about)
    event = iv.Event(lambda t, y: y[1], samples="adaptive")
    sol = iv.solve_ivp(kepler.fun, (0, 10), kepler.y0, method, events=event, **about)
    assert len(sol.t_events[0]) == 3
    np.testing.assert_allclose(sol.t_events[0], usual.t_events[0], rtol=1e-13)
    back = iv.solve_ivp(kepler.fun, (10, 0.5), usual.y[:, -1], method, events=event, **about)
    assert len(back.t_events[0]) == len(sol.t_events[0])
    clock = iv.Event(lambda t, y: np.sin(np.pi * (t + 0.5)), action=lambda t, y: y + 1, samples="adaptive")
    jumps = iv.solve_ivp(lambda t, y: [0.0], (0, 4.2), [0.0], method, events=clock, max_step=np.inf)
    assert jumps.y[0, -1] == 4


@pytest.mark.parametrize(("samples", "error"), [(0, ValueError), (2.5, TypeError), ("many", ValueError)])
def test_wrong_samples(samples, error):
    with pytest.raises(error, match="samples of an event must be a positive integer"):
        iv.Event(lambda t, y: 1.0, samples=samples)


# ----------------------------------------------------------------------------------------------------------------------
# Pairs of roots, conditions, intervals of zeros


def test_pairs_of_roots_within_a_step_are_found(method):
    """The kink of a tent leaves two roots within a step: at random places, of widths down to a hundredth of it."""
    rng = np.random.default_rng(4451)
    for rtol in (1e-3, 1e-6, 1e-9):
        for width in (0.6, 0.1):
            low = rng.uniform(1, 9)
            sol = iv.solve_ivp(
                lambda t, y: [1.0], (0, 10), [0.0], method, rtol=rtol,
                events=lambda t, y, a=low, b=low + width: min(y[0] - a, b - y[0]),
            )  # fmt: skip
            np.testing.assert_allclose(sol.t_events[0], [low, low + width], rtol=1e-11)


@dealt(method=FAMILIES, count=[2, 5, 10, 20])
def test_random_roots_are_found_by_default(method, count):
    rng = np.random.default_rng(100 + count)
    for _ in range(5):
        roots = np.sort(rng.uniform(0.01, 0.99, count))
        if np.diff(roots).min() < 1e-3:
            continue
        np.testing.assert_allclose(one_long_step(method, many_roots(roots)).t_events[0], roots, atol=1e-9)


def test_pairs_are_found_in_ensembles_too():
    """Side by side in vector registers, as alone."""
    f = iv.compile(lambda t, y: [1.0])
    event = iv.compile(lambda t, y: np.minimum(y[0] - 4.5, 5.1 - y[0]), by="trace")
    y0 = np.linspace(0, 3, 16)[:, None]
    out = iv.solve_ensemble(f, (0, 10), y0, "dop853", events=event, max_step=np.inf)
    for i, start in enumerate(y0[:, 0]):
        np.testing.assert_allclose(out[i].t_events[0], [4.5 - start, 5.1 - start], rtol=1e-12)
        alone = iv.solve_ivp(f, (0, 10), [start], "dop853", events=event, max_step=np.inf)
        assert out[i].t_events[0].tolist() == alone.t_events[0].tolist()


@families
def test_an_event_far_from_zero_costs_the_usual_points(method):
    """Only where values leave room for a pair is an event resolved."""
    calls = {None: 0, "adaptive": 0}

    def counted(samples):
        def event(t, y):
            calls[samples] += 1
            return 10 + y[0]

        return iv.Event(event, samples=samples)

    for samples in calls:
        sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 20), [0.0, 1.0], method, events=counted(samples))
    most = max(iv.METHODS[method].order, 3) + 9  # points in a step: the degree of the extension
    assert calls[None] <= 1 + most * sol.stats.steps
    assert calls[None] < calls["adaptive"]


def condition(compiled: bool):
    def above(t, y):
        return y[0] > 0.5

    return iv.compile(above, by="trace") if compiled else above


@dealt(24, method=[*FAMILIES, "taylor"], compiled=[False, True], backwards=[False, True])
def test_a_condition_is_located_to_roundoff_in_either_direction(method, compiled, backwards):
    ends, start = ((1, 0), [1.0]) if backwards else ((0, 1), [0.0])
    for direction, count in ((0, 1), (1, int(not backwards)), (-1, int(backwards))):
        event = iv.Event(condition(compiled), direction=direction)
        sol = iv.solve_ivp(lambda t, y: [1.0], ends, start, method, events=event)
        np.testing.assert_allclose(sol.t_events[0], [0.5] * count, rtol=1e-13)


def branching(t, y):
    above = False
    if y[0] > 0.5:  # tracing follows both ways
        above = True
    return above


TRUTHS = [lambda t, y: y > 0.5, lambda t, y: bool(y[0] > 0.5), lambda t, y: [y[0] > 0.5], branching]


@pytest.mark.parametrize("above", TRUTHS)
def test_every_kind_of_truth_is_a_condition(above):
    for event in (above, iv.compile(above, by="trace")):
        for method in ("ode45", "taylor"):
            found = iv.solve_ivp(lambda t, y: [1.0], (0, 1), [0.0], method, events=event).t_events[0]
            np.testing.assert_allclose(found, [0.5], rtol=1e-13)
    assert len(iv.solve_ivp(lambda t, y: [1.0], (0, 1), [0.0], events=iv.Event(above, at_start=True)).t_events[0]) == 1


def test_numba_compiles_conditions():
    pytest.importorskip("numba")
    event = iv.compile(condition(False), by="numba")
    found = iv.solve_ivp(lambda t, y: [1.0], (0, 1), [0.0], events=event).t_events[0]
    np.testing.assert_allclose(found, [0.5], rtol=1e-13)


def test_an_event_that_is_zero_over_an_interval_is_reported_once_where_that_begins(method):
    events = [
        lambda t, y: min(y[0] - 0.3, 0.0),  # to the end
        lambda t, y: np.clip(y[0] - 0.6, 0, None) + min(y[0] - 0.3, 0.0),  # and rises
        lambda t, y: min(y[0] - 0.3, 0.0) - max(y[0] - 0.6, 0.0),  # and returns
    ]
    for options in ({}, LONG):
        sol = iv.solve_ivp(lambda t, y: [1.0], (0, 1), [0.0], method, events=events, **options)
        for found in sol.t_events:
            np.testing.assert_allclose(found, [0.3], rtol=1e-13)


def test_the_state_at_the_end_does_not_depend_on_the_output(method, tmp_path):
    """Nor on what comes between: files, pickles, ensembles. Whether there are values between steps is another run."""
    sol = run(method, None)
    for options in ({"t_eval": []}, {"keep": "end"}):
        other = run(method, None, **options)
        assert other.y_end.tolist() == sol.y_end.tolist() == sol.y[:, -1].tolist()
    sol = run(method, None, dense_output=True)
    early = run(method, None, t_eval=[1.0])
    assert run(method, None, t_eval=[1.0, 2.0]).y_end.tolist() == early.y_end.tolist() == sol.y_end.tolist()
    early.save(tmp_path / "run.npz")
    assert iv.load(tmp_path / "run.npz").y_end.tolist() == sol.y_end.tolist()
    assert pickle.loads(pickle.dumps(early)).y_end.tolist() == sol.y_end.tolist()
    assert early.extend(12.0).y_end[0] == pytest.approx(12)
    stopped = run(method, iv.Event(at(3.0), terminal=True), t_eval=[1.0])
    assert stopped.y_end[0] == pytest.approx(3, rel=1e-13)


def test_occurrences_are_found_by_the_name_of_their_event(tmp_path):
    """Times and states by name are those by number, in every kind of result."""
    events = [iv.Event(at(1.5, 3.5), name="gate"), iv.Event(at(0.0), name="start", at_start=True), at(9.5)]
    sol = run("ode45", events, sensitivities=["y0"])
    sol.save(tmp_path / "sol.npz")
    again = iv.load(tmp_path / "sol.npz"), pickle.loads(pickle.dumps(sol)), run("ode45", events, (0, 5)).extend(10)
    member = iv.solve_ensemble(clock, (0, 10), [[0.0, 1.0]] * 2, "ode45", events=events[::2])[1]
    dae = iv.solve_dae(lambda t, y, yp: [yp[0] - 1, y[1] - y[0]], (0, 10), [0, 0], [1, 1], events=events[::2])
    for one in (sol, *again, member, dae):
        for name, i in (("gate", 0), ("event", -1)):
            assert one.t_events[name] is one.t_events[i]
            assert one.y_events[name] is one.y_events[i]
        assert one.t_events["gate"] == pytest.approx([1.5, 3.5])
    assert sol.t_events["start"].tolist() == [0.0]
    assert sol.sensitivities_t_events["gate"] is not None
    with pytest.raises(ValueError, match=r"no event 'gat': there are gate, start, event; did you mean 'gate'\?"):
        sol.t_events["gat"]
    assert run("ode45", [at(1.0), at(2.0)]).t_events["event_1"] == pytest.approx([2.0])
    assert run("ode45", {"first": at(1.0), "then": iv.Event(at(2.0))}).t_events["then"] == pytest.approx([2.0])


def test_states_of_a_complex_problem_at_its_events_are_complex() -> None:
    def event(t, y):
        return y[0].real

    sol = iv.solve_ivp(
        lambda t, y: [1j * y[0], 2 * y[1]],
        (0, 5),
        [1.0, 1j],
        "dop853",
        rtol=1e-9,
        atol=1e-9,
        events=[event, lambda t, y: 1.0],
    )
    expected = np.array([[1j, 1j * np.exp(np.pi)], [-1j, 1j * np.exp(3 * np.pi)]])
    np.testing.assert_allclose(sol.y_events[0], expected, rtol=1e-6)
    assert sol.y_events[1].shape == (0,)
