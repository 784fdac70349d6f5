"""An ensemble is the single solves of its rows, whoever makes them, and no row disturbs another."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import invariode as iv

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


def same(a: iv.EnsembleSolution, b: iv.EnsembleSolution) -> None:
    for name in a:
        if name in ("messages", "events", "stats"):
            continue
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    assert a.messages == b.messages
    for name in a.stats:
        np.testing.assert_array_equal(a.stats[name], b.stats[name], err_msg=name)
    for one, other in zip(a.events, b.events, strict=True):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)


@pytest.mark.parametrize("kind", FUNCTIONS)
@pytest.mark.parametrize("t_eval", [None, TIMES], ids=["end", "t_eval"])
def test_each_row_is_the_single_solve_of_it(method, kind, t_eval):
    out = solve(kind, method, workers=2 if kind == "native" else 1, size=6, t_eval=t_eval)
    fun, invariants, event = FUNCTIONS[kind]
    y0, mu = rows(6)
    for i in range(6):
        about = {"args": tuple(mu[i]), "invariants": invariants, "events": event, "rtol": 1e-5}
        one = iv.solve_ivp(fun, SPAN, y0[i], method, t_eval=t_eval, save="end" if t_eval is None else "all", **about)
        np.testing.assert_array_equal(out.y[i], one.y)
        assert out.t_end[i] == SPAN[1]
        assert out.status[i] == one.status == 0
        for name in ("steps", "failed", "nfev", "njev", "nlu", "projections", "ngjac", "nfev_check"):
            assert out.stats[name][i] == one.stats[name], name
        np.testing.assert_allclose(out.residual_after[i], np.abs(one.residual).max(axis=1), rtol=1e-12, atol=1e-15)
        np.testing.assert_array_equal(out.residual_before[i], one.drift().residual_before)
        np.testing.assert_array_equal(out.value[i], one.drift().value)
        here = out.events[0].trajectory == i
        np.testing.assert_array_equal(out.events[0].t[here], one.t_events[0])
        np.testing.assert_array_equal(out.events[0].y[here], one.y_events[0])


@pytest.mark.parametrize("kind", FUNCTIONS)
@pytest.mark.parametrize("t_eval", [None, TIMES], ids=["end", "t_eval"])
def test_the_number_of_workers_changes_no_bit(kind, t_eval):
    first = solve(kind, workers=1, t_eval=t_eval)
    assert first.success.all()
    for workers in (2, 5):
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
    assert (np.delete(demanded.status, 3) == -3).all()
    assert "not on the manifold" in demanded.messages[0]


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_a_trajectory_that_fails_is_a_status_and_disturbs_no_other(kind):
    y0, _ = rows()
    good = solve(kind)
    bad = y0.copy()
    bad[3] = np.nan
    bad[11] = 0.0  # into the centre: f is not finite
    out = solve(kind, y0=bad)
    assert (out.status[[3, 11]] == [-3, -3 if kind == "python" else out.status[11]]).all()
    assert not out.success[[3, 11]].any()
    assert sorted(out.messages) == [3, 11]
    assert "finite" in out.messages[3]
    rest = np.setdiff1d(np.arange(SIZE), [3, 11])
    np.testing.assert_array_equal(out.y[rest], good.y[rest])
    assert "38 reached the end, 2 failed (the first, number 3" in repr(out)


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
    np.testing.assert_array_equal(out.status, np.where(hit, -3, 0))
    first = int(np.flatnonzero(hit)[0])
    assert out.messages[first] == f"RuntimeError: mu is {mu[first, 0]:.3f}"


def test_a_process_that_dies_takes_only_its_trajectory_with_it():
    y0, mu = rows()
    out = iv.solve_ensemble(dying, SPAN, y0, args=mu, workers=2)
    np.testing.assert_array_equal(out.status, np.where(mu[:, 0] > 1.9, -3, 0))
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
        ({"save": "all"}, ValueError, "t_eval"),
        ({"t_eval": [13.0]}, ValueError, "t_eval must lie"),
        ({"y0": np.zeros((0, 4)), "args": (1.0,)}, ValueError, "at least one row"),
    ],
)
def test_what_is_wrong_for_all_is_an_exception(wrong, error, text):
    y0, mu = rows()
    given = {"y0": y0, "args": mu, **wrong}
    with pytest.raises(error, match=text):
        iv.solve_ensemble(kepler_code, SPAN, given.pop("y0"), given.pop("method", "ode45"), **given)


def test_where_processes_start_afresh_functions_must_be_picklable(monkeypatch):
    import multiprocessing

    monkeypatch.setattr(multiprocessing, "get_context", lambda: real("spawn"))
    y0, mu = rows(4)
    with pytest.raises(TypeError, match=r"define them in a module, compile them .*workers=1"):
        iv.solve_ensemble(lambda t, y, m: kepler(t, y, m), SPAN, y0, args=mu, workers=2)


def real(name: str):
    from multiprocessing import context

    return context._concrete_contexts[name]


def test_the_bar_counts_trajectories(capsys):
    out = solve("native", progress=True)
    assert out.success.all()
    assert "100%" in capsys.readouterr().err


def test_ctrl_c_ends_threads_at_once(tmp_path):
    script = tmp_path / "forever.py"
    script.write_text(
        "import numpy as np, invariode as iv\n"
        "f = iv.compile(lambda t, y: (y[1], -y[0]))\n"
        "print('started', flush=True)\n"
        "iv.solve_ensemble(f, (0, 1e9), np.ones((4, 2)), max_step=0.01, workers=2)\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(3)  # numba compiles meanwhile
    sent = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert time.monotonic() - sent < 10
    assert "KeyboardInterrupt" in errors
