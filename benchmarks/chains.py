"""Chains for 60 s against DAE solvers, IDA and those of scipy_dae: ``python benchmarks/chains.py [--write]``.

IDA gets the index-1 form q' = v, M v' = Q + Φᵀ λ, Φ v' = γ; scipy_dae, whose methods fail on that one, the form of its
examples: q' = v + Φᵀ μ, M v' = Q + Φᵀ λ, φ = 0, Φ v = 0 with λ and μ as derivatives (Gear, Gupta and Leimkuhler).
Ours computes Φ and γ from φ, the others get formulas for them. ``--write`` puts the table into docs/benchmarks.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np
from measure import machine, run, table
from numpy.typing import NDArray
from scipy_dae.integrate import solve_dae
from sksundae.ida import IDA

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from mechanisms import Case, closed_chain, spatial_chain

Array = NDArray[np.float64]
RTOL = 1e-6
OUTPUTS = 601
#: CPU seconds after which a contestant is stopped.
PATIENCE = 60.0


class Chain:
    """The index-1 form of unit masses between links of length 1: φ_i = |r_i - r_{i-1}|² - 1."""

    def __init__(self, case: Case, first: Array, last: Array | None) -> None:
        self.case, self.first, self.last = case, first, last
        self.dimension = len(first)
        self.n = len(case.q0)
        self.force = np.asarray(case.system.force(0.0, case.q0, case.v0))
        self.m = len(case.system.constraints(0.0, case.q0))

    def links(self, q: Array, ends: bool) -> Array:
        """Differences of neighbours; `ends`: of positions, else of velocities, which are 0 at the ends."""
        joints = [self.first[None] if ends else np.zeros((1, self.dimension)), q.reshape(-1, self.dimension)]
        if self.last is not None:
            joints.append(self.last[None] if ends else np.zeros((1, self.dimension)))
        difference: Array = np.diff(np.vstack(joints), axis=0)
        return difference

    def residual(self, t: float, y: Array, slope: Array) -> Array:
        """Of y = (q, v, λ)."""
        n = self.n
        q, v, multipliers = y[:n], y[n : 2 * n], y[2 * n :]
        d, rate = self.links(q, ends=True), self.links(v, ends=False)
        a = slope[n : 2 * n]
        bend = 2 * (d * self.links(a, ends=False)).sum(axis=1) + 2 * (rate**2).sum(axis=1)
        return np.concatenate([slope[:n] - v, a - self.force - self.pull(d, multipliers), bend])

    def stabilised(self, t: float, y: Array, slope: Array) -> Array:
        """Of y = (q, v, ∫λ, ∫μ), on both levels."""
        n, m = self.n, self.m
        q, v, by_level = y[:n], y[n : 2 * n], slope[2 * n :]
        d, rate = self.links(q, ends=True), self.links(v, ends=False)
        return np.concatenate(
            [
                slope[:n] - v - self.pull(d, by_level[m:]),
                slope[n : 2 * n] - self.force - self.pull(d, by_level[:m]),
                (d**2).sum(axis=1) - 1,
                2 * (d * rate).sum(axis=1),
            ]
        )

    def pull(self, d: Array, multipliers: Array) -> Array:
        """Φᵀ λ: of the link before, less that of the link after."""
        pull = 2 * d * multipliers[:, None]
        after = np.vstack([pull[1:], np.zeros((1, self.dimension))]) if self.last is None else pull[1:]
        bodies = self.n // self.dimension
        return np.asarray((pull[:bodies] - after[:bodies]).ravel())

    def start(self) -> tuple[Array, Array]:
        f = self.case.problem("none").fun
        y = np.concatenate([self.case.q0, self.case.v0])
        point = _Points(np.zeros(1), y[:, None])
        multipliers = self.case.system.multipliers(point)[:, 0]
        slope = np.asarray(f(0.0, y))
        return np.concatenate([y, multipliers]), np.concatenate([slope, np.zeros(self.m)])


class _Points:
    def __init__(self, t: Array, y: Array) -> None:
        self.t, self.y = t, y


class _PatienceError(Exception):
    """A contestant takes too long."""


def ida(chain: Chain, check: Callable[[], None]) -> tuple[Array, Array, str]:
    def residual(t: float, y: Array, slope: Array, out: Array) -> None:
        check()
        out[:] = chain.residual(t, y, slope)

    y, slope = chain.start()
    algebraic = list(range(2 * chain.n, 2 * chain.n + chain.m))
    solver = IDA(residual, rtol=RTOL, atol=RTOL, algebraic_idx=algebraic, max_num_steps=10**7)
    sol = solver.solve(np.linspace(*chain.case.t_span, OUTPUTS), y, slope)
    return np.asarray(sol.t), np.asarray(sol.y)[:, : 2 * chain.n].T, "" if sol.success else str(sol.message)


def scipy_dae(method: str, chain: Chain, check: Callable[[], None]) -> tuple[Array, Array, str]:
    def residual(t: float, y: Array, slope: Array) -> Array:
        check()
        return chain.stabilised(t, y, slope)

    y, slope = chain.start()
    n, m = 2 * chain.n, chain.m
    y, slope = np.append(y[:n], np.zeros(2 * m)), np.concatenate([slope[:n], y[n:], np.zeros(m)])
    t_eval = np.linspace(*chain.case.t_span, OUTPUTS)
    sol = solve_dae(residual, chain.case.t_span, y, slope, method=method, rtol=RTOL, atol=RTOL, t_eval=t_eval)
    return sol.t, sol.y[: 2 * chain.n], "" if sol.success else sol.message


def ours(method: str, chain: Chain, check: Callable[[], None]) -> tuple[Array, Array, str]:
    t_eval = np.linspace(*chain.case.t_span, OUTPUTS)
    sol = chain.case.problem().solve(method, rtol=RTOL, atol=RTOL, t_eval=t_eval)
    return sol.t, sol.y, "" if sol.success else sol.message


CONTESTANTS = {
    "ode45, in levels": partial(ours, "ode45"),
    "ode113, in levels": partial(ours, "ode113"),
    "IDA (scikit-sundae)": ida,
    "BDF (scipy_dae)": partial(scipy_dae, "BDF"),
    "Radau (scipy_dae)": partial(scipy_dae, "Radau"),
}


def contest(chain: Chain, solve: Callable[..., tuple[Array, Array, str]]) -> list[str]:
    start = process_time()

    def check() -> None:
        if process_time() - start > PATIENCE:
            raise _PatienceError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            t, y, message = solve(chain, check)
    except Exception as error:  # whatever a contestant raises is how it ends
        given_up = "not done" if isinstance(error, _PatienceError) else type(error).__name__
        return [f"{process_time() - start:.1f}", given_up, "–", "–"]
    elapsed = process_time() - start
    if message or not len(t) or t[-1] < chain.case.t_span[1]:
        return [f"{elapsed:.1f}", f"ends at t = {t[-1] if len(t) else 0:.3g}", "–", "–"]
    n = chain.n
    lengths = max(np.abs(chain.case.system.constraints(0.0, q)).max() for q in y[:n].T)
    energy = np.array([chain.case.system.energy(0.0, one[:n], one[n:]) for one in y.T])
    return [f"{elapsed:.1f}", "done", f"{lengths:.0e}", f"{np.abs(energy - energy[0]).max():.0e}"]


def report(repetitions: int) -> str:
    chains = {
        "planar, closed, 5 links": Chain(closed_chain(), np.zeros(2), np.array([2.0, 0.0])),
        "in space, 10 links": Chain(spatial_chain(), np.zeros(3), None),
    }
    rows = [[name, who, *contest(chain, solve)] for name, chain in chains.items() for who, solve in CONTESTANTS.items()]
    head = f"{machine('invariode', 'numpy', 'scikit-sundae', 'scipy_dae')}. CPU time of one run."
    return f"{head}\n\n{table(['60 s, rtol = atol = 1e-6', '', 's', '', 'φ', 'energy'], rows)}"


if __name__ == "__main__":
    run("chains", __doc__, report, repetitions=1)
