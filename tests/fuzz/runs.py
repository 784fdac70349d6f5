"""Right problems, put together at random: linear ones, whose solution is known, in every combination of options.

The oracle: the run succeeds, its error is of the size of the tolerance, no right invariant is accused, outputs are
where they were asked for, events are zeros of their functions, what a function raises comes out, and the same run
again is the same to the last bit.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Any

import numpy as np
from methods import GENERAL
from scipy import sparse
from scipy.linalg import expm

import invariode as iv

__all__ = ["right_run"]

#: The error that a run may have, in units of max(rtol |y|, atol) times the length of the interval: codes control the
#: error of a step, not of the solution. A wide bound, which tells a wrong answer from an inaccurate one.
ALLOWED = 1000


class DeliberateError(Exception):
    """Raised by a function of the user's."""


@dataclass
class Linear:
    """y' = λ (S - δ I) y with a skew-symmetric S: |y|² is conserved for δ = 0, and decays else."""

    A: Any
    y0: Any
    conserves: bool

    @classmethod
    def of(cls, random: Random) -> Linear:
        n, rng = random.choice([0, 1, 2, 2, 3, 4, 6]), np.random.default_rng(random.getrandbits(32))
        A = rng.normal(size=(n, n))
        is_complex, conserves = random.random() < 0.25, random.random() < 0.7
        if is_complex:
            A = A + 1j * rng.normal(size=(n, n))
        A = (A - A.conj().T) / max(2, n)
        if not conserves:
            A = A - random.choice([0.1, 1.0]) * np.eye(n)
        y0 = rng.normal(size=n) + (1j * rng.normal(size=n) if is_complex else 0)
        return cls(A, y0 * 10 ** random.uniform(-2, 2), conserves)

    def at(self, t: float) -> Any:
        return expm(self.A * t) @ self.y0


def _norm(t: float, y: Any) -> Any:
    return np.sum(y**2)


def _modulus(t: float, y: Any) -> Any:
    return np.sum(np.abs(y) ** 2)


def _invariants(random: Random, linear: Linear) -> Any:
    if not linear.conserves or random.random() < 0.3 or not len(linear.y0):
        return None  # of no components: there is nothing to conserve
    g = _modulus if np.iscomplexobj(linear.y0) else _norm
    jac: Any = random.choice([None, lambda t, y: 2 * y, "3-point", "2-point"])
    one = iv.Invariants(
        g,
        jac=jac,
        value=random.choice([None, float(g(0, linear.y0))]),
        iterations=random.choice([None, 1, 2]),
        when=random.choice(["always", "needed"]),
    )
    return random.choice([one, [one], g])


def _matrices(random: Random, method: str, linear: Linear) -> dict[str, Any]:
    if "jac" not in iv.METHODS[method].options:
        return {}
    A, n = linear.A, len(linear.y0)
    options: list[dict[str, Any]] = [
        {},
        {"jac": A},
        {"jac": lambda t, y: A},
        {"jac": sparse.csr_array(A)},
        {"jac": lambda t, y: sparse.coo_array(A)},
        {"jac_sparsity": np.ones((n, n))},
        {"lband": max(n - 1, 0), "uband": max(n - 1, 0)},
        {"mass": np.eye(n)},
        {"mass": lambda t: sparse.csc_array(np.eye(n))},
    ]
    if method == "ode23s":
        del options[-1]  # takes a constant mass matrix only, and says so
    return random.choice(options)


def _outputs(random: Random, t0: float, tf: float) -> dict[str, Any]:
    kind = random.choice(["steps", "times", "refined", "dense", "end"])
    if kind == "times":
        inside = sorted(random.uniform(0, 1) for _ in range(random.choice([0, 1, 5])))
        return {"t_eval": t0 + (tf - t0) * np.unique([*inside, 1.0]), "dense_output": random.random() < 0.3}
    return {"steps": {}, "refined": {"refine": random.choice([2, 4])}, "dense": {"dense_output": True},
            "end": {"keep": "end"}}[kind]  # fmt: skip


def right_run(random: Random) -> str | None:
    """Makes one. What is wrong with it, or None."""
    linear, method = Linear.of(random), random.choice(GENERAL)
    low_order = iv.METHODS[method].order <= 5
    rtol = 10 ** -random.uniform(2, 6 if low_order else 10)
    atol = rtol * float(np.abs(linear.y0).max(initial=0) or 1) * 10 ** -random.uniform(0, 3)
    tf = random.choice([-1, 1]) * random.uniform(0.5, 10)
    options: dict[str, Any] = {
        "method": method, "rtol": rtol, "atol": atol, "invariants": _invariants(random, linear),
        "interpolation": random.choice(["projected", "projected", "corrected", "raw"]),
        **_matrices(random, method, linear), **_outputs(random, 0.0, tf),
    }  # fmt: skip
    if random.random() < 0.3:
        options["first_step"] = random.choice([1e-6, 1e-2])
    if random.random() < 0.2:
        options["max_step"] = random.choice([abs(tf) / 3, np.inf])
    level = 0.5 * sum(linear.y0[:1].real)
    if random.random() < 0.5:
        options["events"] = lambda t, y: sum(y[:1].real) - level

    def run(fun: Callable[..., Any]) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return iv.solve_ivp(fun, (0, tf), linear.y0, **options)

    told = f"method={method}, n={len(linear.y0)}, tf={tf:.3g}, {options}"
    try:
        sol = run(lambda t, y: linear.A @ y)
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:300]} from {told}"
    wrong = _wrong_answer(sol, linear, tf, rtol, atol, options, level) or _wrong_exception(random, run, linear)
    if not wrong and _differ(sol, run(lambda t, y: linear.A @ y)):
        wrong = "the same run differs"
    return wrong and f"{wrong}; {told}"


def _differ(sol: Any, again: Any) -> bool:
    """Whether two runs are not the same to the last bit."""
    return not (np.array_equal(sol.t, again.t) and np.array_equal(sol.y, again.y) and sol.nfev == again.nfev)


def _wrong_answer(
    sol: Any, linear: Linear, tf: float, rtol: float, atol: float, options: dict[str, Any], level: float
) -> str | None:
    if not sol.success or sol.t_end != tf:
        return f"ended at {sol.t_end} with {sol.message}"
    if "t_eval" in options and not np.array_equal(sol.t, options["t_eval"]):
        return "the outputs are not at t_eval"
    if (np.diff(sol.t) * np.sign(tf) < 0).any():
        return "the outputs are not in order"
    size = max(np.abs(linear.at(tf)).max(initial=0), np.abs(linear.y0).max(initial=0)) or 1.0
    scale = (rtol * size + atol) * max(1.0, abs(tf))
    places = [(t, y) for t, y in zip(sol.t, sol.y.T, strict=True)][:: max(1, len(sol.t) // 5)]
    if sol.sol is not None:
        places += [(t, sol.sol(t)) for t in np.linspace(0, tf, 7)]
    for t, y in [*places, (sol.t[-1], sol.y[:, -1])]:
        error = float(np.abs(y - linear.at(t)).max(initial=0) / scale)
        if not error <= ALLOWED:
            return f"error of {error:.3g} tolerances at t = {t}"
    if sol.t_events is not None:
        for t, y in zip(sol.t_events[0], sol.y_events[0], strict=True):
            if abs(y[0].real - level) > 1e-9 * size + 10 * abs(linear.A[0] @ y) * np.spacing(abs(t)):
                return f"the event at t = {t} is no zero: {y[0].real - level}"
    return None


def _wrong_exception(random: Random, run: Callable[..., Any], linear: Linear) -> str | None:
    """f raises at a call of its own choice."""
    last, calls, raised = random.choice([1, 2, 7, 30, 200]), 0, DeliberateError()

    def raising(t: float, y: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == last:
            raise raised
        return linear.A @ y

    try:
        run(raising)
    except DeliberateError as error:
        return None if error is raised else "another exception than the one raised"
    return None if calls < last else "the exception of f was lost"
