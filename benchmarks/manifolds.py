"""What projections cost, and a rigid body over 1e5 rotations: ``python benchmarks/manifolds.py``.

With ``--write``, or ``make bench``, the tables go into docs/benchmarks.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from statistics import median
from time import process_time

import numpy as np
from measure import interleaved, machine, run, table
from numpy.typing import NDArray

import invariode as iv
from invariode import problems

Array = NDArray[np.float64]
Function = Callable[[float, Array], Array]


@partial(iv.compile, inplace=True)
def spinning(t, y, dy):
    """Eight unit quaternions that turn about a fixed axis."""
    for i in range(0, 32, 4):
        dy[i], dy[i + 1], dy[i + 2], dy[i + 3] = -y[i + 1] / 2, y[i] / 2, y[i + 3] / 2, -y[i + 2] / 2


@partial(iv.compile, inplace=True)
def turning(t, y, dy):
    """Four rotation matrices, R' = W R, row by row."""
    for i in range(0, 36, 9):
        for c in range(i, i + 3):
            dy[c] = -y[c + 3]
            dy[c + 3] = y[c] - 0.5 * y[c + 6]
            dy[c + 6] = 0.5 * y[c + 3]


def in_python(manifold: iv.Invariants) -> iv.Invariants:
    """The same equations as functions of Python."""
    return iv.Invariants(manifold.fun, manifold.jac, manifold.value, manifold.names)


def gain(repetitions: int) -> str:
    quaternions, matrices = np.tile([1.0, 0, 0, 0], 8), np.tile(np.eye(3).ravel(), 4)
    cases = {
        "1 quaternion": (spinning, quaternions, iv.UnitQuaternion(range(4))),
        "8 quaternions": (spinning, quaternions, iv.UnitQuaternion(np.arange(32).reshape(8, 4))),
        "1 rotation matrix": (turning, matrices, iv.RotationMatrix(np.arange(9))),
        "4 rotation matrices": (turning, matrices, iv.RotationMatrix(np.arange(36).reshape(4, 9))),
    }
    rows = []
    for name, (fun, y0, manifold) in cases.items():
        problems = {
            way: iv.Problem(fun, (0, 200), y0, invariants=held)
            for way, held in (("plain", None), ("native", manifold), ("Python", in_python(manifold)))
        }
        runs = {way: partial(p.solve, "ode45", rtol=1e-6, atol=1e-6, keep="end") for way, p in problems.items()}
        steps = {way: go().stats.steps for way, go in runs.items()}
        times = interleaved(runs, repetitions, process_time)
        rows.append([name, *(f"{1e6 * median(times[way]) / steps[way]:.1f}" for way in runs)])
    return table(["µs per step of ode45, f compiled", "plain", "native", "Python"], rows)


#: Oscillators, in rows of so many values of g.
SPRINGS = {"m = 10, n = 40": (10, 40), "m = 100, n = 200": (100, 200), "m = 300, n = 600": (300, 600)}


def springs(m: int, n: int) -> tuple[Function, Function]:
    """n / 2 oscillators, and m sums of their energies, of one or two each."""
    half = n // 2
    stiffness = np.linspace(1, 2, half)

    def f(t: float, y: Array) -> Array:
        return np.concatenate([y[half:], -stiffness * y[:half]])

    def g(t: float, y: Array) -> Array:
        each: Array = (y[half:] ** 2 + stiffness * y[:half] ** 2) / 2
        return each[:m] + each[m:] if m < half else each

    return f, g


def python_gradients(repetitions: int) -> str:
    """A step of ode45 and dop853 with g in Python and no `jac`: its Jacobian by a trace, and by complex steps."""
    rows = []
    for name, (m, n) in SPRINGS.items():
        f, g = springs(m, n)
        start = np.concatenate([np.ones(n // 2), np.zeros(n // 2)])
        ways = {"plain": None, "traced": g}
        if m < 300:  # then it takes most of a minute
            ways["complex steps"] = iv.Invariants(g, jac="complex-step")
        for method in ("ode45", "dop853"):
            runs = {
                way: partial(iv.solve_ivp, f, (0, 50), start, method, rtol=1e-6, atol=1e-6, invariants=held)
                for way, held in ways.items()
            }
            steps = {way: go().stats.steps for way, go in runs.items()}
            times = interleaved(runs, repetitions, process_time)
            each = {way: 1e6 * median(times[way]) / steps[way] for way in runs}
            row = [f"{value:.0f}" for value in each.values()]
            rows.append([f"{name}, {method}", *row, *["–"] * (3 - len(row))])
    return table(["µs per step, f and g in Python", "plain", "traced", "complex steps"], rows)


#: Principal moments of inertia of a body without forces.
_A, _B, _C = 1.0, 2.0, 3.0


@partial(iv.compile, inplace=True)
def body(t, y, dy):
    """q' = q ω / 2 with y = (q, ω), and Euler's equations."""
    w, x, y_, z, a, b, c = y[0], y[1], y[2], y[3], y[4], y[5], y[6]
    dy[0] = (-x * a - y_ * b - z * c) / 2
    dy[1] = (w * a + y_ * c - z * b) / 2
    dy[2] = (w * b + z * a - x * c) / 2
    dy[3] = (w * c + x * b - y_ * a) / 2
    dy[4] = (_B - _C) * b * c / _A
    dy[5] = (_C - _A) * c * a / _B
    dy[6] = (_A - _B) * a * b / _C


@partial(iv.compile, inplace=True)
def kept(t, y, g):
    """Twice the energy, and the angular momentum in space."""
    w, x, y_, z = y[0], y[1], y[2], y[3]
    a, b, c = _A * y[4], _B * y[5], _C * y[6]
    g[0] = a * y[4] + b * y[5] + c * y[6]
    g[1] = (w * w + x * x - y_ * y_ - z * z) * a + 2 * (x * y_ - w * z) * b + 2 * (x * z + w * y_) * c
    g[2] = 2 * (x * y_ + w * z) * a + (w * w - x * x + y_ * y_ - z * z) * b + 2 * (y_ * z - w * x) * c
    g[3] = 2 * (x * z - w * y_) * a + 2 * (y_ * z + w * x) * b + (w * w - x * x - y_ * y_ + z * z) * c


def evaluations() -> str:
    """Return evaluations of g and of its Jacobian a step, of the steps alone and with three outputs in each."""
    rows = []
    for method in ("ode45", "dop853", "ode113", "ode15s", "radau", "taylor"):
        for tolerance in (1e-3, 1e-6, 1e-9):
            solve = partial(problems.kepler().solve, method, rtol=tolerance, atol=tolerance)
            row = [f"{method}, {tolerance:.0e}"]
            for stats in (solve(keep="end").stats, solve(refine=4).stats):
                row += [f"{stats.ng / stats.steps:.2f}", f"{stats.ngjac / stats.steps:.2f}"]
            rows.append(row)
    return table(["a step of Kepler's problem", "g", "Jacobian", "g, refine=4", "Jacobian, refine=4"], rows)


def chords() -> str:
    """Return corrections to roundoff of outputs within steps, with gradients at the point or from the step's ends."""
    rows = []
    for method in ("ode45", "dop853"):
        for tolerance in (1e-3, 1e-6, 1e-9):
            counts = np.mean(list(corrections_within_steps(method, tolerance)), axis=0)
            rows.append([f"{method}, {tolerance:.0e}", *(f"{count:.1f}" for count in counts)])
    return table(["corrections, Kepler's problem", "J at the point", "of the nearer end", "interpolated"], rows)


def corrections_within_steps(method: str, tolerance: float) -> Iterator[list[int]]:
    """Yield how many corrections each kind of gradient takes at a quarter, the middle and three quarters of a step."""
    problem = problems.kepler()
    (held,) = problem.invariants
    g, gradient = (lambda t, y, f=f: np.array(f(t, y)) for f in (held.fun, held.jac))
    sol = problem.solve(method, rtol=tolerance, atol=tolerance, dense_output=True, interpolation="corrected")
    for (t0, t1), (y0, y1) in zip(itertools.pairwise(sol.t), itertools.pairwise(sol.y.T), strict=True):
        w = np.maximum(np.maximum(abs(y0), abs(y1)), 1.0)  # atol = rtol
        for theta in (0.25, 0.5, 0.75):
            t = t0 + theta * (t1 - t0)
            target = (1 - theta) * g(t0, y0) + theta * g(t1, y1)
            ends = gradient(t0, y0), gradient(t1, y1)
            kinds = (None, ends[theta >= 0.5], (1 - theta) * ends[0] + theta * ends[1])
            counts = []
            for J in kinds:
                y, count, size = sol.sol(t), -1, np.inf
                while size > 1e-15 and count < 9:
                    rows = (gradient(t, y) if J is None else J) * w
                    step = w * np.linalg.lstsq(rows, g(t, y) - target)[0]
                    y, count, size = y - step, count + 1, np.max(abs(step / w))
                counts.append(count)
            yield counts


ROTATIONS = 10**5
TUMBLING = np.array([1, 0, 0, 0, 0.1, 1.0, 0.1])  # about the middle axis, where rotation is unstable


def rotations() -> str:
    """|q| - 1, energy and angular momentum after 1e5 rotations; everything native, Jacobians by differences."""
    attitude = iv.UnitQuaternion(range(4))
    held = {
        "nothing": None,
        "norm of q": [attitude],
        "norm, energy, momentum": [attitude, iv.Invariants(kept, names=["2E", "Lx", "Ly", "Lz"])],
    }
    rate = np.linalg.norm(TUMBLING[4:])
    rows = []
    for name, invariants in held.items():
        problem = iv.Problem(body, (0, 2 * np.pi * ROTATIONS / rate), TUMBLING, invariants=invariants)
        start = process_time()
        sol = problem.solve("dop853", rtol=1e-6, atol=1e-6, keep="end", max_step=np.inf)
        elapsed = process_time() - start
        reached, before = (values(y) for y in (sol.y[:, -1], TUMBLING))
        off = [f"{abs(np.linalg.norm(sol.y[:4, -1]) - 1):.0e}", f"{abs(reached[0] / before[0] - 1):.0e}"]
        off.append(f"{np.linalg.norm(reached[1:] - before[1:]) / np.linalg.norm(before[1:]):.0e}")
        rows.append([name, str(sol.stats.steps), *off, f"{elapsed:.1f}"])
    return table(["held over 1e5 rotations, dop853, 1e-6", "steps", "norm - 1", "energy", "momentum", "s"], rows)


def values(y: Array) -> Array:
    g = np.empty(4)
    kept.fun(0.0, y, g)
    return g


def report(repetitions: int) -> str:
    tables = [gain(repetitions), python_gradients(repetitions), evaluations(), chords(), rotations()]
    return "\n\n".join([machine("invariode", "numpy", "numba"), *tables])


if __name__ == "__main__":
    run("manifolds", __doc__, report, repetitions=5)
