"""Where f jumps and that makes attempts fail, a run says so; where f is smooth, none does."""

from __future__ import annotations

import math
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, IMPLICIT, METHODS, dealt, explicit_and_implicit, families, hidden
from invariode import scipy as classes
from problems import PROBLEMS
from stiff import PROBLEMS as STIFF

untold = pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")


@iv.compile
def switched(t, y, p):
    """Decays to 0, and to p[1] from p[0] on, by a clock that is a component: what t alone decides would be known."""
    return (-y[0] + (p[1] if y[1] >= p[0] else 0.0), 1.0)


def with_a_jump(k: int):
    """Random problem k: f, the interval, y0 and when f jumps, by 0.3 to 30 times its other terms."""
    r = np.random.default_rng(k)
    scale = 10 ** r.uniform(-2, 2)
    tf, jump, much = 10 * scale, scale * r.uniform(1, 9), 10 ** r.uniform(-0.5, 1.5)
    if k % 3 == 0:
        A = (r.normal(size=(3, 3)) - 1.5 * np.eye(3)) / scale
        b = r.normal(size=3) / scale
        return (
            hidden(lambda t, y: A @ y + b * (np.sin(t / scale) + much * (t >= jump))),
            (0, tf),
            r.normal(size=3),
            jump,
        )
    if k % 3 == 1:
        return (
            hidden(lambda t, y: np.array([y[1], much * (t >= jump) - np.sin(y[0])]) / scale),
            (0, tf),
            np.array([r.uniform(-2, 2), 0]),
            jump,
        )
    rate = 10 ** r.uniform(1, 2)
    return (
        hidden(lambda t, y: np.array([rate * (np.cos(t / scale) + much * (t >= jump) - y[0]), -y[1]]) / scale),
        (0, tf),
        np.array([1.0, 1]),
        jump,
    )


@dealt(method=FAMILIES, rtol=[1e-3, 1e-6])
def test_jumps_are_named_to_the_last_bit(method, rtol):
    """Nearly all where four attempts or more fail (docs/algorithms.md, 'Jumps of f'), and no other time."""
    found = looked = 0
    for k in range(6):
        fun, span, y0, jump = with_a_jump(k)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", iv.DiscontinuityWarning)
            sol = iv.solve_ivp(fun, span, y0, method, rtol=rtol, atol=1e-2 * rtol, keep="end")
        named = sol.stats.discontinuities
        assert named in ((), (jump,))
        assert sol.stats.nfev_check <= 256 + 60 + (sol.stats.steps + sol.stats.failed) / 4
        if sol.stats.failed >= (4 if rtol < 1e-3 else 8):
            looked += 1
            found += bool(named)
    assert found >= 0.8 * looked
    assert looked >= (4 if rtol < 1e-3 else 0)


@dealt(method=FAMILIES, problem=PROBLEMS)
def test_smooth_problems_have_none(method, problem):
    """At random tolerances; all other tests of the package are such tests too, since warnings are errors."""
    for rtol in 10.0 ** -np.random.default_rng(len(method + problem.name)).uniform(
        2.5, 8 - 3 * (method[:5] == "ode23"), 2
    ):
        assert problem.solve(method, project=False, rtol=rtol, atol=1e-3 * rtol).stats.discontinuities == ()


@dealt(name=["Robertson", "HIRES", "Oregonator", "van der Pol, mu = 1e3"], code=IMPLICIT)
def test_the_fast_phases_of_stiff_problems_are_none(name, code):
    p = STIFF[name]
    sol = code(p.fun, p.t_span, p.y0, args=p.args or None, rtol=1e-5, atol=1e-5 * p.scale, keep="end")
    assert sol.stats.discontinuities == ()


@pytest.mark.parametrize(
    "fun",
    [
        lambda t, y: [abs(np.sin(3 * t))],
        lambda t, y: [abs(t - 1) ** -0.5],
        lambda t, y: [1 / (1 - t)],
        lambda t, y: [np.tanh(1000 * (t - 1))],
    ],
    ids=["kinks", "integrable pole", "pole", "steep"],
)
def test_only_jumps_are_named(fun):
    sol = iv.ode45(hidden(fun), (0, 3.1), [1.0], rtol=1e-6)
    assert sol.stats.failed >= 3
    assert sol.stats.discontinuities == ()


@explicit_and_implicit
def test_a_run_says_it_once_and_what_to_try(method):
    with pytest.warns(iv.DiscontinuityWarning, match=f"{method}: fun looks discontinuous at t = 3, 5, where") as said:
        sol = iv.solve_ivp(
            hidden(lambda t, y: [-y[0] + 9 * (3 <= t < 5)]), (0, 10), [1.0], method, rtol=1e-6, atol=1e-9
        )
    assert len(said) == 1
    assert sol.stats.discontinuities == (3, 5)
    assert "Fun looks discontinuous at t = 3, 5" in sol.message
    assert "breakpoints=[3, 5]" in sol.message


@explicit_and_implicit
def test_breakpoints_silence_it_and_save_the_failures(method):
    problem = iv.Problem(hidden(lambda t, y: [-y[0] + 9 * (3 <= t < 5)]), (0, 10), [1.0])
    with pytest.warns(iv.DiscontinuityWarning):
        without = problem.solve(method, rtol=1e-6, atol=1e-9)
    sol = problem.solve(method, rtol=1e-6, atol=1e-9, breakpoints=without.stats.discontinuities)
    assert sol.stats.discontinuities == ()
    assert sol.stats.failed < without.stats.failed
    assert sol.nfev < without.nfev


@families
@untold
def test_every_evaluation_is_counted(method):
    calls = 0

    def fun(t, y):
        nonlocal calls
        assert 0 <= t <= 10
        calls += 1
        return [-y[0] + 9 * (t >= 3)]

    sol = iv.solve_ivp(fun, (0, 10), [1.0], method, rtol=1e-6, atol=1e-9)
    assert sol.stats.nfev_check > 0
    assert calls >= sol.nfev + sol.stats.nfev_check
    if sol.njev == 0:
        assert calls == sol.nfev + sol.stats.nfev_check


@families
@untold
def test_where_the_smallest_step_fails_the_message_names_the_jump(method):
    """Seconds of a clock: doubles are 1e-7 apart there."""
    start = 1e9
    sol = iv.solve_ivp(
        hidden(lambda t, y: [-y[0] + 1e8 * (t >= start + 3)]), (start, start + 10), [1.0], method, rtol=1e-6, keep="end"
    )
    assert sol.status == -1
    assert sol.stats.discontinuities == (start + 3,)
    assert "below its smallest size" in sol.message
    assert "breakpoints=[1000000003]" in sol.message
    assert "singularity" not in sol.message


@untold
def test_at_a_limit_the_message_names_it():
    sol = iv.ode45(hidden(lambda t, y: [-y[0] + 9 * (t >= 3)]), (0, 100), [1.0], rtol=1e-6, max_steps=60)
    assert sol.status == -3
    assert "max_steps = 60 is reached" in sol.message
    assert "discontinuous at t = 3" in sol.message


@families
@untold
def test_jumps_where_y_decides_are_found_where_the_solution_crosses(method):
    """A relay: f jumps at y = 1, which the solution passes at t = log 2."""
    sol = iv.solve_ivp(lambda t, y: [2 - y[0] if y[0] < 1 else 5 - y[0]], (0, 2), [0.0], method, rtol=1e-6, atol=1e-9)
    assert np.allclose(sol.stats.discontinuities, [np.log(2)], rtol=1e-2)


@explicit_and_implicit
@untold
def test_backwards_too(method):
    sol = iv.solve_ivp(hidden(lambda t, y: [y[0] + 9 * (t <= 3)]), (10, 0), [1.0], method, rtol=1e-6, atol=1e-9)
    assert sol.stats.discontinuities == (3,)


@untold
def test_where_f_jumps_all_the_time_the_search_ends():
    sol = iv.ode45(hidden(lambda t, y: [-y[0] + 9 * (np.floor(10 * t) % 2)]), (0, 40), [1.0], rtol=1e-6, keep="end")
    found = np.array(sol.stats.discontinuities)
    assert 20 <= len(found) <= 64
    assert np.abs(10 * found - np.round(10 * found)).max() < 1e-12
    # To name jumps, and to look for sticking, 256 and a quarter of the attempts each; to keep steps over jumps accurate
    # 4096 and the attempts.
    assert sol.stats.nfev_check <= 2 * 256 + 4096 + 60 + 1.5 * (sol.stats.steps + sol.stats.failed)
    assert sol.stats.nfev_check < sol.nfev / 3
    assert f"and at {len(found) - 4} or more other times (stats.discontinuities)" in sol.message


@dealt(method=IMPLICIT, rtol=[1e-3, 1e-6, 1e-9], unit=[1e-6, 1.0])
@untold
def test_a_run_may_start_where_f_jumps_with_y(method, rtol, unit):
    """f at the start is that of one side, and at the first iterates that of the other: y₁ = 1 - exp(-5 t), y₀ = t."""
    sol = iv.solve_ivp(
        lambda t, y: [unit, 5 * (unit * (y[0] > 0) - y[1])], (0, 2), [0.0, 0.0], method, rtol=rtol, atol=rtol * unit
    )
    assert sol.success
    assert sol.y[1, -1] == pytest.approx(unit * (1 - np.exp(-10)), rel=100 * rtol)


def climbed(y: float, t: float) -> float:
    """y(t) of y' = 1.1 - 0.3 floor(2 y)."""
    while True:
        level = math.floor(2 * y)
        duration = ((level + 1) / 2 - y) / (1.1 - 0.3 * level)
        if duration >= t:
            return y + (1.1 - 0.3 * level) * t
        y, t = (level + 1) / 2, t - duration


@dealt(jac=[None, [[0.0]]], rtol=[1e-4, 1e-6, 1e-8, 1e-10])
@untold
def test_radau_sees_a_jump_from_beyond_which_all_stages_come(jac, rtol):
    """An estimate with f at y + e in place of f(y) is 0 where e crosses the jump as all stages do."""
    for end in (1.0, 2.0, 3.0, 4.0):
        sol = iv.solve_ivp(
            lambda t, y: [1.1 - 0.3 * math.floor(2 * y[0])], (0, end), [0.2], "radau", rtol=rtol, atol=rtol, jac=jac
        )
        assert abs(sol.y[0, -1] - climbed(0.2, end)) <= 100 * rtol


class Staircase:
    """y' = a - b y > 0 with a and b that jump where y and t pass random places."""

    END = 4.0

    def __init__(self, seed: int) -> None:
        r = np.random.default_rng(seed)
        self.levels = np.sort(r.uniform(0.3, 2.5, r.integers(1, 5)))
        self.times = np.sort(r.uniform(0.2, 3.8, r.integers(0, 3)))
        shape = len(self.times) + 1, len(self.levels) + 1
        self.a = np.maximum(r.uniform(0.3, 2, shape) * 10 ** r.uniform(-0.5, 0.5), 0.35)
        self.b = r.uniform(-0.3, 0.05, shape[1]) * (seed % 3 > 0)
        self.y0 = r.uniform(0.05, 0.25)

    def rates(self, t: float, y: float) -> tuple[float, float]:
        level = np.searchsorted(self.levels, y, side="right")
        return self.a[np.searchsorted(self.times, t, side="right"), level], self.b[level]

    def __call__(self, t, y):
        a, b = self.rates(t, y[0])
        return [a - b * y[0]]

    def at_end(self) -> float:
        t, y = 0.0, self.y0
        while t < self.END:
            a, b = self.rates(t, y)
            passed = np.searchsorted(self.times, t, side="right")
            rest = min([self.END, *self.times[passed:]]) - t
            above = self.levels[np.searchsorted(self.levels, y, side="right") :]
            level = above[0] if len(above) else np.inf
            reached = y + a * rest if b == 0 else a / b + (y - a / b) * math.exp(-b * rest)
            if reached < level:
                t, y = t + rest, reached
            else:
                t += (level - y) / a if b == 0 else -math.log((level - a / b) / (y - a / b)) / b
                y = level
        return y


#: The most of 30 runs in which the error of a pair is more than 100 tolerances, since its estimate is small by chance
#: where its slopes are like those of a smooth f (docs/known-limits.md).
BY_CHANCE = {"ode45": 3, "dop853": 1, "ode78": 2}


@pytest.mark.parametrize("method", METHODS)
@untold
def test_random_jumps_in_y_and_t_are_crossed_within_100_tolerances(method):
    beyond = 0
    for seed in range(10):
        fun = Staircase(seed)
        exact = fun.at_end()
        for rtol in (1e-3, 1e-5, 1e-7):
            sol = iv.solve_ivp(hidden(fun), (0, fun.END), [fun.y0], method, rtol=rtol, atol=rtol, keep="end")
            assert sol.success
            beyond += bool(abs(sol.y[0, -1] - exact) > 100 * rtol * (1 + exact))
    assert beyond <= BY_CHANCE.get(method, 0)


@pytest.mark.parametrize("method", ["ode45", "dop853"])
@untold
def test_a_jump_is_found_beside_a_larger_smooth_change_of_f(method):
    """Halving a step towards the larger change of f would lead away from the jump: errors of 10 to 50 tolerances."""
    size, rtol = 100.0, 1e-6
    for at in np.random.default_rng(7).uniform(1, 9, 12):
        fun = hidden(lambda t, y, at=at: [size * math.cos(t) + (t > at)])
        sol = iv.solve_ivp(fun, (0, 10), [0.0], method, rtol=rtol, atol=rtol)
        exact = size * np.sin(sol.t) + np.maximum(0, sol.t - at)
        assert abs(sol.y[0] - exact).max() <= 5 * rtol * size  # what a step over a jump may leave


@dealt(method=[*METHODS, "ode23s"], rtol=[1e-4, 1e-6, 1e-8, 1e-10])
@untold
def test_steps_down_a_staircase(method, rtol):
    """y' = -ceil(10.5 y) / 10, a case of the SBML Test Suite, decays in straight lines."""
    if METHODS[method].order <= 3:
        rtol = max(rtol, 1e-6)
    y, rest, level = 1.0, 2.0, 11
    while (duration := (y - (level - 1) / 10.5) / (level / 10)) < rest:
        y, rest, level = (level - 1) / 10.5, rest - duration, level - 1
    y -= level / 10 * rest
    sol = iv.solve_ivp(hidden(lambda t, y: [-math.ceil(10.5 * y[0]) / 10]), (0, 2), [1.0], method, rtol=rtol, atol=rtol)
    assert abs(sol.y[0, -1] - y) <= 100 * rtol


def sliding(t, y):
    return [-1.0 if y[0] > 0.5 else 1.0]


@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")
@pytest.mark.parametrize("method", METHODS)
def test_every_method_says_that_a_solution_sticks(method):
    for rtol in (1e-3, 1e-5):
        with pytest.warns(iv.DiscontinuityWarning, match="the solution sticks where fun jumps"):
            sol = iv.solve_ivp(hidden(sliding), (0, 50), [0.0], method, rtol=rtol, atol=0.1 * rtol, max_steps=4000)
        assert abs(sol.y[0, -1] - 0.5) <= 20 * rtol


@untold
@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")
@pytest.mark.parametrize("method", ["ode45", "ode113", "ode15s", "radau", "ode23s"])
def test_a_run_that_would_follow_it_for_a_million_steps_ends_with_these_words_unless_it_has_a_limit(method):
    problem = iv.Problem(hidden(sliding), (0, 1e6), [0.0])
    sol = problem.solve(method, rtol=1e-3, atol=1e-4)
    assert sol.status == -3
    assert "the solution sticks where fun jumps" in sol.message.lower()
    assert sol.y[0, -1] == pytest.approx(0.5, abs=0.02)
    assert problem.solve(method, rtol=1e-3, atol=1e-4, max_steps=3000).stats.steps == 3000


@untold
@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")
def test_auto_comes_to_the_end_where_its_solution_sticks():
    sol = iv.solve_ivp(hidden(sliding), (0, 2), [0.0], "auto", rtol=1e-3, max_steps=10_000)
    assert sol.success
    assert sol.y[0, -1] == pytest.approx(0.5, abs=1e-3)
    assert set(sol.steps.method) == {"ode113", "ode15s"}
    assert sol.steps.method[-1] == "ode113"


@explicit_and_implicit
@untold
def test_an_extension_remembers_and_a_file_does(method, tmp_path: Path):
    problem = iv.Problem(switched, (0, 5), [1.0, 0.0], args=(3.0, 20.0))
    half = problem.solve(method, rtol=1e-6)
    half.save(tmp_path / "half.npz")
    whole = problem.replace(t_span=(0, 8)).solve(method, rtol=1e-6)
    for sol in (half.extend(8), iv.load(tmp_path / "half.npz", problem).extend(8)):
        assert sol.stats.discontinuities == half.stats.discontinuities
        assert np.allclose(sol.stats.discontinuities, [3.0], rtol=1e-3)
    inside = problem.replace(t_span=(0, 8)).solve(method, rtol=1e-6, max_steps=whole.stats.steps // 3)
    inside = inside.extend(8, max_steps=1000)
    assert dict(inside.stats) == dict(whole.stats)


@pytest.mark.parametrize("how", ["lanes", "threads", "processes", "parts", "store"])
def test_ensembles_tell_where(how, tmp_path: Path):
    """In lanes, in the core one at a time, in Python, in parts and from a store: the first jump of each."""
    N = 5
    args = np.column_stack([np.arange(1.0, N + 1), [9.0, 0, 9, 0, 9]])
    fun = switched if how != "processes" else lambda t, y, *p: switched.fun(t, y, p)
    given = {
        "lanes": {},
        "threads": {"lanes": 1},
        "processes": {},
        "parts": {"executor": ThreadPoolExecutor(1), "chunk": 2},
        "store": {"store": tmp_path / "out.zarr", "chunk": 2},
    }[how]
    if how == "store":
        pytest.importorskip("zarr")
    with pytest.warns(iv.DiscontinuityWarning, match="ode45: fun looks discontinuous in 3 trajectories") as said:
        m = iv.solve_ensemble(fun, (0, 10), [1.0, 0.0], args=args, rtol=1e-6, workers=1, **given)
    assert len(said) == 1
    m = m.load() if how == "store" else m
    assert np.allclose(m.stats.discontinuity, [1, np.nan, 3, np.nan, 5], rtol=1e-3, equal_nan=True)
    alone = [iv.Problem(switched, (0, 10), [1.0, 0.0], args=tuple(row)) for row in args]
    for i in (2, 3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", iv.DiscontinuityWarning)
            one = alone[i].solve(rtol=1e-6, keep="end")
        assert m[i].stats.discontinuities == one.stats.discontinuities
        assert m[i].stats.nfev_check == one.stats.nfev_check


@untold
def test_a_saved_ensemble_keeps_it(tmp_path: Path):
    m = iv.solve_ensemble(switched, (0, 10), [1.0, 0.0], args=[[3.0, 9.0], [4.0, 0.0]], rtol=1e-6, workers=1)
    m.save(tmp_path / "m.npz")
    again = iv.EnsembleSolution.load(tmp_path / "m.npz")
    first, second = (one.stats.discontinuities for one in again)
    assert np.allclose(first, [3.0], rtol=1e-3)
    assert second == ()


@explicit_and_implicit
def test_the_classes_for_scipy_say_it_once(method):
    run = getattr(classes, {"auto": "LSODA"}.get(method, method.upper()), None)
    if run is None:
        pytest.skip("no class of this method")
    with pytest.warns(iv.DiscontinuityWarning, match="discontinuous at t = 3") as said:
        solver = run(hidden(lambda t, y: [-y[0] + 9 * (t >= 3)]), 0, [1.0], 10, rtol=1e-6, atol=1e-9)
        while solver.status == "running":
            solver.step()
    assert len(said) == 1


def test_exceptions_of_the_search_come_out():
    """Evaluations in the search are evaluations: what they raise ends the run."""

    class BrokenError(Exception):
        pass

    seen = []

    def fun(t, y):
        seen.append(t)
        if len(seen) > 2 and abs(t - 3) < 1e-9 and t != 3:
            raise BrokenError
        return [-y[0] + 9 * (t >= 3)]

    with pytest.raises(BrokenError):
        iv.ode45(fun, (0, 10), [1.0], rtol=1e-6)


def floor(t, y):
    return y[0]


def bouncing(restitution, method, **options):
    """A ball that is dropped on a floor; the last impact is at `end`."""
    hit = iv.Event(floor, direction=-1, action=lambda t, y: [0.0, -restitution * y[1]])
    end = np.sqrt(2.0) * (1 + 2 * restitution / (1 - restitution))
    return iv.solve_ivp(lambda t, y: [y[1], -1.0], (0, 2 * end), [1.0, 0.0], method, events=hit, **options), end


@dealt(method=FAMILIES, restitution=[0.4, 0.8])
def test_impacts_that_accumulate_are_named(method, restitution):
    """A ball falls through the floor when its flights are shorter than what a step shows: that is said, once."""
    with pytest.warns(iv.DiscontinuityWarning, match=r"floor: its actions came closer and closer") as said:
        sol, end = bouncing(restitution, method)
    assert len(said) == 1
    assert "Floor: its actions came closer" in sol.message
    assert sol.success
    assert sol.y[0, -1] < -0.1
    named = float(str(said[0].message).partition("until t = ")[2].split()[0])
    assert named == pytest.approx(sol.t_events[0][-1], rel=1e-11)
    assert named == pytest.approx(end, rel=0.05)


@explicit_and_implicit
def test_impacts_are_named_in_a_run_that_goes_on_too(method, tmp_path):
    """The memory of a run knows how its impacts went."""
    sol, end = bouncing(0.8, method, max_steps=60)
    with pytest.warns(iv.DiscontinuityWarning, match="floor: its actions came closer"):
        sol.extend(2 * end, max_steps=None)


@pytest.mark.parametrize("how", ["threads", "processes", "store"])
def test_ensembles_tell_whose_impacts_accumulate(how, tmp_path: Path):
    """The ball that is thrown far up does not come down again; one warning for the others, with the last times."""
    kind = iv.compile if how == "threads" else lambda fun: fun
    bounce = iv.Event(kind(floor), direction=-1, action=kind(lambda t, y: [0.0, -0.8 * y[1]]))
    problem = iv.Problem(kind(lambda t, y: [y[1], -1.0]), (0, 30), [1.0, 0.0], events=bounce)
    given = {"store": tmp_path / "out.zarr"} if how == "store" else {}
    if how == "store":
        pytest.importorskip("zarr")
    y0 = [[1.0, 0.0], [1.0, 90.0], [2.0, 0.0]]
    with pytest.warns(iv.DiscontinuityWarning, match="ode45: in 2 trajectories the actions of an event came closer"):
        m = problem.solve_ensemble(y0=y0, workers=1, **given)
    m = m.load() if how == "store" else m
    m.save(tmp_path / "m.npz")
    for found in (m, iv.EnsembleSolution.load(tmp_path / "m.npz")):
        for i in (0, 2):
            assert found.stats.accumulation[i] == m[i].t_events[0][-1]
        assert np.isnan(found.stats.accumulation[1])


@explicit_and_implicit
def test_actions_that_do_not_accumulate_are_not_named(method):
    """Impacts that are few, that end at rest, that keep their distance, or that switch and let the solution pass."""
    short = iv.Event(floor, direction=-1, action=lambda t, y: [0.0, -0.8 * y[1]])
    at_rest = iv.Event(floor, direction=-1, action=lambda t, y: [0.0, -0.5 * y[1]] if y[1] < -0.1 else [1e-9, 0.0])
    through = iv.Event(floor, action=lambda t, y: 0.9 * y)
    for fun, y0, event in (
        (lambda t, y: [y[1], -1.0], [1.0, 0.0], short),
        (lambda t, y: [y[1], -1.0 if y[0] > 1e-8 else 0.0], [1.0, 0.0], at_rest),
        (lambda t, y: [y[1], -((1 + t) ** 2) * y[0]], [1.0, 0.0], through),
    ):
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*closer and closer")
            warnings.filterwarnings("ignore", message=".*looks discontinuous")
            iv.solve_ivp(fun, (0, 6), y0, method, events=event)


def block(t, y):
    """Driven less than the friction that holds it: at first it slides, then it sticks."""
    return [y[1], 0.5 * np.sin(t) - np.sign(y[1])]


@dealt(method=FAMILIES, rtol=[1e-3, 1e-6], y0=[[0.0, 1.0], [0.0, 1e-9]])
@pytest.mark.filterwarnings("ignore::invariode.StiffnessWarning")  # which it is too, in a sense
def test_a_solution_that_sticks_where_f_jumps_is_told(method, rtol, y0):
    """Implicit methods may fail there instead, at last or in most attempts, and name the jump."""
    with pytest.warns(iv.DiscontinuityWarning, match="fun") as said:
        sol = iv.solve_ivp(block, (0, 100), y0, method, rtol=rtol, atol=1e-3 * rtol, max_steps=2000)
    (text,) = [str(one.message) for one in said if one.category is iv.DiscontinuityWarning]
    if sol.status == -1 or sol.stats.failed > sol.stats.steps:
        assert "sticks where fun jumps" in text or "looks discontinuous" in text
        assert "wrong Jacobian" not in sol.message  # no jac was given, and the jump is what is wrong
        return
    assert "sticks where fun jumps" in text
    since = float(text.partition("from t = ")[2].split()[0])
    assert since <= sol.t[-1] * (1 + 1e-5)
    if y0[1] == 1:
        assert since == pytest.approx(1.42, abs=0.2)  # where it would come to rest
    assert "sticks where fun jumps" in sol.message
