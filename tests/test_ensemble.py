"""An ensemble is the single solves of its rows, whoever makes them, and no row disturbs another."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
import tracemalloc
import warnings
from contextlib import suppress

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt
from ensembles import same

#: Trajectories that fail belong to many of these laws; that a warning says so is in tests/test_failures.py.
pytestmark = pytest.mark.filterwarnings("ignore::invariode.FailureWarning")

numba = pytest.importorskip("numba")

SIZE = 40
SPAN = (0.0, 12.0)
TIMES = np.linspace(0, 12, 9)


def kepler(t, y, mu):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return y[2], y[3], -mu * y[0] / r3, -mu * y[1] / r3


def integrals(t, y, mu):
    energy = (y[2] * y[2] + y[3] * y[3]) / 2 - mu / (y[0] * y[0] + y[1] * y[1]) ** 0.5
    return energy, y[0] * y[3] - y[1] * y[2]


def apsis(t, y, mu):
    return y[0] * y[2] + y[1] * y[3]


# The native functions get their parameters as an array p.
kepler_code = iv.compile(lambda t, y, p: kepler_jit(t, y, p[0]))
integrals_code = iv.compile(lambda t, y, p: integrals_jit(t, y, p[0]))
apsis_code = iv.compile(lambda t, y, p: apsis_jit(t, y, p[0]))
kepler_jit, integrals_jit, apsis_jit = (numba.njit(f, error_model="numpy") for f in (kepler, integrals, apsis))

FUNCTIONS = {
    "native": (kepler_code, iv.Invariants(integrals_code, names=["energy", "momentum"]), iv.Event(apsis_code)),
    "python": (kepler, iv.Invariants(integrals, "3-point", names=["energy", "momentum"]), iv.Event(apsis)),
}


def rows(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    e = rng.uniform(0, 0.8, size)  # the costs of the trajectories differ
    mu = rng.uniform(0.5, 2, size)
    speed = np.sqrt(mu * (1 + e) / (1 - e))
    return np.column_stack([1 - e, 0 * e, 0 * e, speed]), mu[:, None]


def solve(kind: str, method: str = "ode45", workers: int = 2, size: int = SIZE, **options) -> iv.EnsembleSolution:
    fun, invariants, event = FUNCTIONS[kind]
    y0, mu = rows(size)
    given = {"invariants": invariants, "events": event, "args": mu, "workers": workers, "rtol": 1e-5, **options}
    return iv.solve_ensemble(fun, SPAN, options.pop("y0", y0), method, **{k: v for k, v in given.items() if k != "y0"})


def same_counts(out: iv.EnsembleSolution, i: int, one: iv.Solution) -> None:
    in_other_words = {"stiff", "stiff_since", "discontinuity", "accumulation"}
    for name in out.stats.keys() - in_other_words:
        assert out.stats[name][i] == one.stats[name], name
    assert out.stats.stiff[i] == (one.stats.stiff_since is not None)
    for name, alone in (("stiff_since", one.stats.stiff_since), ("discontinuities", one.stats.discontinuities[:1])):
        assert out[i].stats[name] == alone, name


@dealt(method=FAMILIES, kind=FUNCTIONS, t_eval=[None, TIMES])
def test_each_row_is_the_single_solve_of_it(method, kind, t_eval):
    out = solve(kind, method, workers=2 if kind == "native" else 1, size=6, t_eval=t_eval)
    fun, invariants, event = FUNCTIONS[kind]
    y0, mu = rows(6)
    for i in range(6):
        about = {"args": tuple(mu[i]), "invariants": invariants, "events": event, "rtol": 1e-5}
        one = iv.solve_ivp(fun, SPAN, y0[i], method, t_eval=t_eval, keep="end" if t_eval is None else "all", **about)
        np.testing.assert_array_equal(out.y[i], one.y)
        assert out.t_end[i] == SPAN[1]
        assert out.status[i] == one.status == 0
        same_counts(out, i, one)
        np.testing.assert_allclose(out.residual_after[i], np.abs(one.residual).max(axis=1), rtol=1e-12, atol=1e-15)
        np.testing.assert_array_equal(out.residual_before[i], one.drift().residual_before)
        np.testing.assert_array_equal(out.value[i], one.drift().value)
        here = out.events[0].trajectory == i
        np.testing.assert_array_equal(out.events[0].t[here], one.t_events[0])
        np.testing.assert_array_equal(out.events[0].y[here], one.y_events[0])


@pytest.mark.parametrize(("kind", "t_eval", "workers"), [
    ("native", None, 2), ("native", TIMES, 5), ("python", None, 5), ("python", TIMES, 2),
])  # fmt: skip
def test_the_number_of_workers_changes_no_bit(kind, t_eval, workers):
    first = solve(kind, workers=1, t_eval=t_eval)
    assert first.success.all()
    same(first, solve(kind, workers=workers, t_eval=t_eval))


def test_each_trajectory_holds_its_own_value():
    out = solve("native")
    y0, mu = rows()
    for i in range(SIZE):
        np.testing.assert_allclose(out.value[i], integrals(0, y0[i], mu[i, 0]), rtol=1e-15)
    assert (out.residual_after < 1e-8).all()
    assert (out.residual_before.max(axis=0) > 1e-8).all()
    assert len(np.unique(out.value[:, 0])) == SIZE
    demanded = solve(
        "native", invariants=iv.Invariants(integrals_code, value=out.value[3], names=["energy", "momentum"])
    )
    assert demanded.status[3] == 0
    assert (np.delete(demanded.status, 3) == -4).all()
    assert "not on the manifold" in demanded.messages[0]


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_a_trajectory_that_fails_is_a_status_and_disturbs_no_other(kind):
    y0, _ = rows()
    good = solve(kind)
    bad = y0.copy()
    bad[3] = np.nan
    bad[11] = 0.0  # into the centre: f is not finite
    out = solve(kind, y0=bad)
    assert (out.status[[3, 11]] == [-4, -4 if kind == "python" else out.status[11]]).all()
    assert not out.success[[3, 11]].any()
    assert sorted(out.messages) == [3, 11]
    assert "finite" in out.messages[3]
    rest = np.setdiff1d(np.arange(SIZE), [3, 11])
    np.testing.assert_array_equal(out.y[rest], good.y[rest])
    assert "38 reached the end, 2 failed (the first, number 3" in repr(out)


@pytest.mark.parametrize("demanded", [False, True])
@pytest.mark.parametrize("fun", [kepler, kepler_code], ids=["python", "native"])
@pytest.mark.parametrize("g", [integrals, integrals_code], ids=["python g", "native g"])
def test_counts_are_those_of_single_solves_however_jacobians_are_had(fun, g, demanded):
    y0, mu = rows(3)
    value = integrals(0, y0[0], mu[0, 0]) if demanded else None
    invariants = iv.Invariants(g, value=value, names=["energy", "momentum"])
    about = {"invariants": invariants, "events": iv.Event(apsis_code)}
    out = iv.solve_ensemble(fun, SPAN, y0, args=mu, workers=1, **about)
    for i in range(1 if demanded else 3):  # the others are off the value that is demanded
        same_counts(out, i, iv.solve_ivp(fun, SPAN, y0[i], args=tuple(mu[i]), keep="end", **about))


turn_code = iv.compile(lambda t, y, p: (p[0] * y[1], -p[0] * y[0]))


@pytest.mark.parametrize("workers", [1, 2])
def test_threads_and_processes_agree_on_rows_that_fail(workers):
    held = iv.Invariants(iv.compile(lambda t, y, p: y[0] ** 2 + y[1] ** 2), names="square")
    y0 = [[1.0, 0.0], [np.nan, 0.0], [0.0, 2.0], [3.0, 4.0]]
    rates = np.array([[1.0], [1.0], [3.0], [0.5]])
    about = {"args": rates, "invariants": held, "t_eval": np.linspace(0, 4, 9), "rtol": 1e-6}

    def undefined_later(t, y, rate):
        return y[0] if t < 1.3 or rate < 2 else np.nan

    native = iv.Event(iv.compile(lambda t, y, p: y[0] if t < 1.3 or p[0] < 2 else np.nan))
    threads = iv.solve_ensemble(turn_code, (0, 4), y0, events=native, **about)
    processes = iv.solve_ensemble(turn_code, (0, 4), y0, events=undefined_later, workers=workers, **about)
    np.testing.assert_array_equal(threads.status, [0, -4, -4, 0])
    assert 0 < threads.t_end[2] < 4
    assert (threads.stats.steps[[0, 2, 3]] > 0).all()
    assert np.isnan(threads.value[1]).all()
    assert threads.messages[1] == "ValueError: All components of the initial state `y0` must be finite, got y0[0] = nan"
    assert "returned NaN at t = " in threads.messages.pop(2)
    assert "undefined_later returned NaN at t = " in processes.messages.pop(2)
    same(threads, processes)


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_events_that_do_not_occur_have_no_rows(kind):
    fun, _, _ = FUNCTIONS[kind]
    y0, mu = rows(4)
    never = iv.compile(lambda t, y, p: y[0] - 50)
    seldom = iv.compile(lambda t, y, p: y[0] + 1.5)
    out = iv.solve_ensemble(fun, SPAN, y0, args=mu, events=[never, seldom], workers=1)
    assert out.success.all()
    assert [out.events[0][name].shape for name in ("trajectory", "t", "y")] == [(0,), (0,), (0, 4)]
    assert 0 < len(np.unique(out.events[1].trajectory)) < 4
    assert (np.diff(out.events[1].trajectory) >= 0).all()


def raising(t, y, mu):
    if mu > 1.9 and t > 1:
        raise RuntimeError(f"mu is {mu:.3f}")
    return kepler(t, y, mu)


def dying(t, y, mu):
    if mu > 1.9:
        os._exit(3)
    return kepler(t, y, mu)


@pytest.mark.parametrize("workers", [1, 2])
def test_an_exception_becomes_the_status_of_its_trajectory(workers):
    y0, mu = rows()
    out = iv.solve_ensemble(raising, SPAN, y0, args=mu, workers=workers)
    hit = mu[:, 0] > 1.9
    assert 0 < hit.sum() < SIZE
    np.testing.assert_array_equal(out.status, np.where(hit, -4, 0))
    first = int(np.flatnonzero(hit)[0])
    assert out.messages[first] == f"RuntimeError: mu is {mu[first, 0]:.3f}"


@pytest.mark.parametrize("method", ["ode45", "ode15s"])
def test_a_compiled_f_of_another_length_is_told_as_of_a_single_run(method):
    """The values of such an f are NaN in the core, which alone would say that fun is not finite at the start."""
    pytest.importorskip("numba")
    of_p = values_code()
    many = {"args": [(2.0,), (3.0,), (2.0,), (1.0,)], "on_failure": "return"}
    out = iv.solve_ensemble(of_p, (0, 1), np.ones((4, 2)), method, **many)
    np.testing.assert_array_equal(out.status, [0, -4, 0, -4])
    assert np.isnan(out.y[[1, 3]]).all()
    assert out.messages.keys() == {1, 3}
    for i, text in out.messages.items():
        with pytest.raises(ValueError, match=r"compile\(values\) returned") as alone:
            iv.solve_ivp(of_p, (0, 1), np.ones(2), method, args=many["args"][i])
        assert text == f"ValueError: {alone.value}"


def values(t, y, p):
    return np.ones(int(p[0]))


@functools.cache
def values_code():
    return iv.compile(values)


def test_a_process_that_dies_takes_only_its_trajectory_with_it():
    y0, mu = rows()
    out = iv.solve_ensemble(dying, SPAN, y0, args=mu, workers=2)
    np.testing.assert_array_equal(out.status, np.where(mu[:, 0] > 1.9, -4, 0))
    assert "worker process died" in out.messages[int(np.flatnonzero(mu[:, 0] > 1.9)[0])]


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_terminal_events_end_trajectories_where_they_occur(kind):
    _, _, event = FUNCTIONS[kind]
    out = solve(kind, events=iv.Event(event.fun, terminal=2), t_eval=TIMES)
    ended = out.status == 1
    assert ended.any()
    for i in np.flatnonzero(ended):
        times = out.events[0].t[out.events[0].trajectory == i]
        assert len(times) == 2
        assert out.t_end[i] == times[-1]
        np.testing.assert_array_equal(out.y_end[i], out.events[0].y[out.events[0].trajectory == i][-1])
        np.testing.assert_array_equal(np.isnan(out.y[i]).any(axis=0), times[-1] < TIMES)


def test_rows_of_y0_or_of_args_or_of_both():
    y0, mu = rows()
    both = iv.solve_ensemble(kepler_code, SPAN, y0, args=mu)
    assert both.y.shape == (SIZE, 4, 1)
    for i in (0, 17):
        by_args = iv.solve_ensemble(kepler_code, SPAN, y0[i], args=mu)
        by_states = iv.solve_ensemble(kepler_code, SPAN, y0, args=tuple(mu[i]))
        np.testing.assert_array_equal(by_args.y_end[i], both.y_end[i])
        np.testing.assert_array_equal(by_states.y_end[i], both.y_end[i])
    one = iv.solve_ensemble(kepler_code, SPAN, y0[0], args=tuple(mu[0]))
    np.testing.assert_array_equal(one.y_end, both.y_end[:1])


def test_rows_of_a_list_are_handed_over_as_they_are():
    seen = set()

    def f(t, y, n, name, more):
        seen.add((type(n), name, more))
        return [-n * y[0]]

    out = iv.solve_ensemble(f, (0, 1), [1.0], args=[[1, "one", None], (2, "two", "x")], workers=1)
    assert out.success.all()
    assert seen == {(int, "one", None), (int, "two", "x")}

    y0, mu = rows(3)
    code = iv.compile(lambda t, y, p: kepler_jit(t, y, p[0] * p[1] * p[2]))
    flat = iv.solve_ensemble(code, SPAN, y0, args=[[m, 1.0, 1.0] for m in mu[:, 0]])
    nested = iv.solve_ensemble(code, SPAN, y0, args=[[np.array([m, 1.0]), 1.0] for m in mu[:, 0]])
    np.testing.assert_array_equal(nested.y_end, flat.y_end)


def test_complex_results_of_threads_keep_the_signs_of_zeros():
    rest = iv.compile(lambda t, y: (0.0, 0.0, 0.0, 0.0))  # pairs of reals
    y0 = np.array([[complex(-0.0, 1), complex(2, -0.0)], [complex(-0.0, -0.0), 3]])
    out = iv.solve_ensemble(rest, (0, 1), y0, t_eval=[0, 1])
    for i in range(2):
        one = iv.solve_ivp(rest, (0, 1), y0[i], t_eval=[0, 1])
        np.testing.assert_array_equal(out.y[i], one.y)
        for part in (np.real, np.imag):
            np.testing.assert_array_equal(np.signbit(part(out.y[i])), np.signbit(part(one.y)))
            np.testing.assert_array_equal(np.signbit(part(out.y[i, :, 0])), np.signbit(part(y0[i])))


def test_complex_problems_backwards_and_stiff_ones():
    def turn(t, y, w):
        return [1j * w * y[0]]

    w = np.array([[1.0], [2.0], [3.0]])
    out = iv.solve_ensemble(turn, (1, 0), [1 + 0j], args=w, workers=1, rtol=1e-8, atol=1e-10, t_eval=[1, 0.5, 0])
    np.testing.assert_allclose(out.y[:, 0], np.exp(1j * w * (np.array([1, 0.5, 0]) - 1)), atol=1e-6)

    robertson = iv.compile(
        lambda t, y, p: (
            -p[0] * y[0] + 1e4 * y[1] * y[2],
            p[0] * y[0] - 1e4 * y[1] * y[2] - 3e7 * y[1] ** 2,
            3e7 * y[1] ** 2,
        )
    )
    rates = np.linspace(0.02, 0.06, 8)[:, None]
    out = iv.solve_ensemble(robertson, (0, 1e4), [1, 0, 0], "ode15s", args=rates, rtol=1e-6, atol=1e-10)
    assert out.success.all()
    np.testing.assert_allclose(out.y_end.sum(axis=1), 1, atol=1e-9)
    assert (np.diff(out.y_end[:, 0]) < 0).all()  # the faster the first reaction, the less is left


def test_singular_mass_matrices_start_consistently_in_each_trajectory():
    decay = iv.compile(lambda t, y, p: (-p[0] * y[0], y[0] + y[1] - 1))
    rates = np.array([[0.5], [1.0], [2.0]])
    y0 = [[1, 0], [1, 0.05], [0.5, 0.4]]  # the latter two are moved
    out = iv.solve_ensemble(decay, (0, 1), y0, "ode15s", args=rates, mass=[[1, 0], [0, 0]], rtol=1e-8, atol=1e-10)
    assert out.success.all()
    np.testing.assert_allclose(out.y_end.sum(axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(out.y_end[:2, 0], np.exp(-rates[:2, 0]), rtol=1e-6)


def test_counts_with_singular_mass_matrices_are_those_of_single_solves():
    decay = iv.compile(lambda t, y, p: (-p[0] * y[0] * y[2], p[0] * y[0] * y[2], y[0] + y[1] + y[2] - 3))
    y0 = np.array([[1, 0, 2], [1, 0, 1.7]])
    total = iv.Invariants(iv.compile(lambda t, y, p: y[0] + y[1]), names="total")
    about = {"mass": np.diag([1, 1, 0]), "invariants": total, "rtol": 1e-6}
    out = iv.solve_ensemble(decay, (0, 1), y0, "ode15s", args=[[0.5], [1.0]], **about)
    for i, rate in enumerate((0.5, 1.0)):
        one = iv.solve_ivp(decay, (0, 1), y0[i], "ode15s", args=(rate,), keep="end", **about)
        np.testing.assert_array_equal(out.y_end[i], one.y[:, -1])
        same_counts(out, i, one)


def test_starts_that_singular_mass_matrices_refuse_are_told_apart():
    equations = iv.compile(
        lambda t, y, p: (-y[0] + np.sqrt(p[2]), p[0] * (y[1] - y[0]) + p[1] * (y[1] ** 2 + 1)),
    )
    p = [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, -1.0]]
    # (The exact Jacobian leads from y0 straight to the singular point of the third.)
    about = {"method": "ode15s", "mass": np.diag([1, 0]), "jac": "differences"}
    y0 = [1.0, 1.0]
    out = iv.solve_ensemble(equations, (0, 1), y0, args=p, **about)
    np.testing.assert_array_equal(out.status, [0, -4, -4, -1])
    for i in (1, 2):
        with pytest.raises(ValueError, match="algebraic") as refused:
            iv.solve_ivp(equations, (0, 1), y0, args=tuple(p[i]), **about)
        assert f"ValueError: {refused.value}".startswith(out.messages[i])  # a single run names the residual, too
        assert np.isnan(out.y_end[i]).all()
    assert "Differences of fun do not prove that" in out.messages[1]
    assert "no consistent values" in out.messages[2]
    assert out.messages[3] == iv.solve_ivp(equations, (0, 1), y0, args=tuple(p[3]), **about).message
    assert "fun is not finite at the start" in out.messages[3]


def test_what_the_options_warn_of_is_said_once():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solve("python", workers=1, size=4, rtol=1e-20, first_step=1e-3, max_step=6.0, method="ode23", bdf=True)
    assert sorted(str(one.message).split("`")[0].strip() for one in said) == [
        "At least one element of",
        "option 'bdf' has no effect on ode23",
    ]


def test_states_at_times_are_not_copied():
    y0 = np.ones((1000, 2), dtype=complex)
    code = iv.compile(lambda t, y: (y[1], -y[0], y[3], -y[2]))
    iv.solve_ensemble(code, (0, 1), y0[:16], t_eval=[1])  # imports, and compiles, for lanes too
    tracemalloc.start()  # sees what numpy allocates, not the arrays of the core
    try:
        out = iv.solve_ensemble(code, (0, 1), y0, t_eval=np.linspace(0, 1, 200))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert out.y.nbytes == 1000 * 2 * 200 * 16
    assert peak < out.y.nbytes / 4


def test_redundant_invariants_are_said_once():
    y0, mu = rows()
    twice = iv.Invariants(
        iv.compile(lambda t, y, p: (y[0] * y[3] - y[1] * y[2], 2 * (y[0] * y[3] - y[1] * y[2]))),
        names=["once", "twice"],
    )
    with pytest.warns(UserWarning, match=f"redundant in {SIZE} trajectories"):
        out = iv.solve_ensemble(kepler_code, SPAN, y0, args=mu, invariants=twice)
    assert out.success.all()


@pytest.mark.parametrize(
    ("wrong", "error", "text"),
    [
        ({"y0": np.zeros((2, 2, 2))}, ValueError, r"shape \(N, n\) or \(n,\)"),
        ({"args": [1.0, 2.0]}, ValueError, r"shape \(N, k\)"),
        ({"args": np.ones((3, 1))}, ValueError, "40 rows and args has 3"),
        ({"workers": 0}, ValueError, "workers"),
        ({"rtoll": 1e-3}, TypeError, "did you mean 'rtol'"),
        ({"method": "ode46"}, ValueError, "did you mean"),
        ({"dense_output": True}, ValueError, "dense_output"),
        ({"refine": 4}, ValueError, "refine"),
        ({"keep": "all"}, ValueError, "t_eval"),
        ({"keep": "outputs"}, ValueError, "keep='outputs' of an ensemble needs t_eval"),
        ({"keep": "ends"}, ValueError, "did you mean 'end'"),
        ({"keep": 7}, ValueError, "keep must be one of"),
        ({"keep": "end", "t_eval": [1.0]}, ValueError, 'keep="end" keeps only the final state'),
        ({"t_span": 1}, ValueError, r"t_span must be a pair \(t0, tf\), got 1"),
        ({"args": [[1.0], [1.0, 2.0]]}, ValueError, r"one length, got lengths \[1, 2\]"),
        ({"args": ["a", "b"]}, ValueError, "got 'a' as a row"),
        ({"args": np.ones(3)}, ValueError, r"for one parameter args\[:, None\]; got shape \(3,\)"),
        ({"t_eval": [13.0]}, ValueError, "Values in `t_eval` are not within"),
        ({"y0": np.zeros((0, 4)), "args": (1.0,)}, ValueError, "at least one row"),
    ],
)
def test_what_is_wrong_for_all_is_an_exception(wrong, error, text):
    y0, mu = rows()
    given = {"y0": y0, "args": mu, **wrong}
    with pytest.raises(error, match=text):
        iv.solve_ensemble(
            kepler_code, given.pop("t_span", SPAN), given.pop("y0"), given.pop("method", "ode45"), **given
        )


def test_the_bar_counts_trajectories(capsys):
    out = solve("native", progress=True)
    assert out.success.all()
    assert "100%" in capsys.readouterr().err


FOREVER = """
import os, signal, sys, threading
import numpy as np, invariode as iv
f = lambda t, y: (y[1], -y[0])
if {native}:
    f = iv.compile(f)
iv.solve_ivp(f, (0, 1), [1, 1])  # compiles
def interrupt():
    print("interrupted", flush=True)
    os.kill(os.getpid(), signal.SIGINT)  # this process alone, as `kill` does
threading.Timer(0.5, interrupt).start()
iv.solve_ensemble(f, (0, 1e9), np.ones((4, 2)), max_step=0.01, workers=2, progress={progress})
"""


@pytest.mark.parametrize(("native", "progress"), [(True, False), (False, True)], ids=["threads", "processes, progress"])
def test_ctrl_c_ends_all_at_once(tmp_path, native, progress):
    script = tmp_path / "forever.py"
    script.write_text(FOREVER.format(native=native, progress=progress))
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    try:
        process.stdout.readline()
        sent = time.monotonic()
        _, errors = process.communicate(timeout=20)  # workers that live on keep its pipes open
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert time.monotonic() - sent < 10
    assert "KeyboardInterrupt: Ctrl-C stopped the ensemble: 0 of 4 trajectories are solved" in errors
    assert "SystemError" not in errors


def test_invariants_have_as_many_values_in_every_row():
    def g(t, y):
        return y if y[0] < 1 else [*y, 0.0]

    with pytest.raises(ValueError, match="the invariants have 2 values in row 1 of y0, and 1 in the first one"):
        iv.solve_ensemble(lambda t, y: 0 * y, (0, 1), [[0.5], [1.5]], invariants=g, workers=1)


def test_wrong_numbers_of_columns_fail_before_the_run():
    """One error for all rows, and f is not called."""

    def f(t, y, k):
        raise AssertionError("called")

    problem = iv.Problem(f, (0, 1), [1.0, 0.0], args=(1.0,))
    for states in (np.ones((4, 3)), np.ones((4, 1)), np.ones(3)):
        with pytest.raises(ValueError, match="must have n = 2 columns"):
            problem.solve_ensemble(states, workers=1)
    with pytest.raises(ValueError, match="must have n = 2 columns"):
        problem.solve_ensemble(iter([(np.ones(3), (1.0,))]), workers=1)
    for args in (np.ones((4, 2)), [(1.0, 2.0)] * 4, (1.0, 2.0)):
        with pytest.raises(TypeError, match="2 values, and f cannot be called with them"):
            problem.solve_ensemble(args=args, workers=1)
    with pytest.raises(TypeError, match="2 values, and f cannot be called with them"):
        iv.solve_ensemble(f, (0, 1), np.ones((4, 2)), args=np.ones((4, 2)), workers=1)
