"""Constant delays: what they cost and how accurate they are, as a table: ``python benchmarks/delays.py [--fits 200]``.

The problems are those of dde23's tutorial, of RADAR5's manual and of the Mackey-Glass equation; reference values are
published, exact, or those on which two methods agree at 1e-11.
"""

from __future__ import annotations

import argparse
import math
import pathlib
import resource
import statistics
import tempfile
import time
import warnings

import numpy as np

import invariode as iv


def pendulum(t, y, z):
    return [y[1], -math.sin(y[0]) - 0.1 * z[0, 1]]


def robertson(t, y, z):
    slow, fast, last = 0.04 * y[0], 1e4 * z[0, 1] * y[2], 3e7 * y[1] ** 2
    return [-slow + fast, slow - fast - last, last]


def mackey_glass(t, y, z):
    return [0.25 * z[0, 0] / (1 + z[0, 0] ** 10) - 0.1 * y[0]]


def seir(t, y, z):
    infections, onsets = 0.6 * y[0] * y[2], 0.6 * z[0, 0] * z[0, 2]
    return [-infections, infections - onsets, onsets - 0.2 * y[2], 0.2 * y[2]]


def feedback(t, y, z, tau):
    return [-z[0, 0]]


def show(what, *values):
    print(f"{what:58}", *values)


def suitcase(method, rtol):
    gamma, amplitude, omega, side = 0.248, 0.75, 1.37, [1.0]
    eta = math.asin(gamma / amplitude)

    def f(t, y, z):
        push = amplitude * math.sin(omega * t + eta)
        return [y[1], math.sin(y[0]) - side[0] * gamma * math.cos(y[0]) - z[0, 0] + push]

    def hit(t, y):
        side[0] = -side[0]
        return [0.0, 0.913 * y[1]]

    # It starts from rest, where y, y' and y'' are 0 but for roundoff, whose sign is not an event.
    on_ground = iv.Event(lambda t, y: y[0] if t > 0.1 else 1.0, action=hit)
    events = [on_ground, iv.Event(lambda t, y: abs(y[0]) - math.pi / 2, terminal=True)]
    sol = iv.solve_ivp(
        f, (0, 12), [0, 0], method, events=events, delays=0.1, history=[0, 0], rtol=rtol, atol=rtol / 100
    )
    error = np.abs(np.concatenate(sol.t_events) / [4.51675706533, 9.75105314495, 11.67039349764] - 1).max()
    return f"{-math.log10(2 * error):.1f}"


def fits(count):
    rng, t, inside = np.random.default_rng(1), np.linspace(0.3, 12, 40), 0
    f = iv.compile(lambda t, y, z, gain, tau: [-gain * z[0, 0]])
    problem = iv.Problem(f, (0, 12), [1.0], delays="tau", history=1, args=(0.8, 1.1))
    clean = problem.solve("dop853", t_eval=t, rtol=1e-9).y[0]
    for _ in range(count):
        data = clean + 0.02 * rng.standard_normal(len(t))
        found = iv.fit(problem.replace(args=(1.0, 0.9)), t, data, {"gain": (0.1, 3), "tau": (0.2, 3)}, method="dop853")
        low, high = found.confidence()["tau"]
        inside += low <= 1.1 <= high
    return inside


def resumed(method):
    problem = iv.Problem(mackey_glass, (0, 6000), [1.0], delays=15.0, history=1)
    whole, times = problem.solve(method, rtol=1e-6, atol=1e-8), 0
    part = max(len(whole.t) // 101, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "run.npz"
        sol = problem.solve(method, rtol=1e-6, atol=1e-8, max_steps=part)
        while sol.t_end < 6000:
            sol.save(path)
            sol, times = iv.load(path, problem).extend(6000, max_steps=part), times + 1
    return times, np.array_equal(sol.t, whole.t) and np.array_equal(sol.y, whole.y)


def jitcdde_run(rtol):
    """Seconds of JiTCDDE to 1e4, without its compilation, and its error at 100; None: it is not installed."""
    try:
        from jitcdde import jitcdde, t, y
    except ImportError:
        return None
    equation, taken = jitcdde([0.25 * y(0, t - 15) / (1 + y(0, t - 15) ** 10) - 0.1 * y(0)], verbose=False), []
    equation.compile_C()
    for _ in range(3):
        equation.purge_past()
        equation.constant_past([1.0])
        equation.set_integration_parameters(rtol=rtol, atol=rtol)
        tic = time.perf_counter()
        equation.step_on_discontinuities()
        error = abs(equation.integrate(100)[0] - 1.2640841980157)
        equation.integrate(1e4)
        taken.append(time.perf_counter() - tic)
    return statistics.median(taken), error


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=0)
    parser.add_argument("--steps", type=float, default=1e6, help="of the run whose memory is measured")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for method in (name for name, about in iv.METHODS.items() if about.delays):
        rtol = 1e-8 if iv.METHODS[method].order < 4 else 1e-10
        show(f"suitcase, {method} at {rtol:g}: digits of three times", suitcase(method, rtol))
    sol = iv.solve_ivp(pendulum, (0, 20), [1.0, 0.0], "ode45", delays=0.01, history=[1.0, 0.0], rtol=1e-6)
    show("pendulum with delayed damping, tau 0.01, ode45 1e-6: steps", sol.stats.steps, "f", sol.nfev)
    for method, law, jac in (
        ("radau", None, None),
        ("radau", None, "trace"),
        ("ode15s", None, "trace"),
        ("radau", lambda t, y: y.sum(), None),
    ):
        sol = iv.solve_ivp(
            robertson, (0, 1e11), [1, 0, 0], method, delays=1e-4, history=[1, 0, 0], rtol=1e-4,
            atol=[1e-8, 1e-12, 1e-8], invariants=law, jac=jac,
        )  # fmt: skip
        off, imposed = np.abs(sol.y.sum(axis=0) - 1), ", total imposed" if law else f", {sol.stats.jacobian}"
        show(f"Robertson, tau 1e-4, to 1e11, {method}{imposed}: steps; sum", sol.stats.steps, f"{off.max():.1e}")
    f = iv.compile(mackey_glass)
    for rtol in (1e-5, 1e-8):
        options = {"delays": 15.0, "history": 1, "rtol": rtol, "atol": rtol}
        error = abs(iv.solve_ivp(f, (0, 100), [1.0], "ode45", **options).y[0, -1] - 1.2640841980157)
        taken = []
        for _ in range(5):
            tic = time.perf_counter()
            sol = iv.solve_ivp(f, (0, 1e4), [1.0], "ode45", **options)
            taken.append(time.perf_counter() - tic)
        show(f"Mackey-Glass, ode45 {rtol:g}: s to 1e4; steps; error at 100", f"{statistics.median(taken):.4f}",
             sol.stats.steps, f"{error:.1e}")  # fmt: skip
        if (other := jitcdde_run(rtol)) is not None:
            show(f"JiTCDDE {rtol:g}: s to 1e4; error at 100", f"{other[0]:.4f}", f"{other[1]:.1e}")
    for bounds, laws in ((None, None), (True, None), (True, lambda t, y: y.sum())):
        sol = iv.solve_ivp(
            seir, (0, 100), [0.99, 0.0, 0.01, 0.0], "ode15s", delays=3, history=[0.0] * 4, rtol=1e-3, dense_output=True,
            nonnegative=bounds, invariants=laws,
        )  # fmt: skip
        y = sol.sol(np.linspace(0, 100, 2001))
        show(f"SEIR, nonnegative {bounds}, total {laws is not None}: least; total", f"{y.min():.1e}",
             f"{np.abs(y.sum(axis=0) - 1).max():.1e}")  # fmt: skip
    sol = iv.solve_ivp(
        feedback, (0, 3.7), [2.0], "dop853", delays="tau", args=(1.0,), history=1, sensitivities="tau", rtol=1e-12,
        atol=1e-14,
    )  # fmt: skip
    show("dy(3.7)/dtau of y' = -y(t - tau): error", f"{abs(sol.sensitivities[0, 0, -1] + 1.6465):.1e}")
    for steps in (1e3, given.steps / 10, given.steps):
        sol = iv.solve_ivp(f, (0, steps * 1e-2), [1.0], "ode23", delays=0.5, history=1, max_step=1e-2, keep="end")
        resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        show(f"after {steps:g} steps: bytes remembered, kB of the process", len(sol._origin.memory), resident)
    for method in ("dop853", "radau"):
        show(f"runs resumed from files, {method}: how often; the same bits", *resumed(method))
    if given.fits:
        show(f"fits of tau within their 95 % interval, of {given.fits}", fits(given.fits))


if __name__ == "__main__":
    main()
