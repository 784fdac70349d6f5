"""Random runs that are interrupted, go on in another process, and are compared with the run that was never interrupted.

``python tests/interrupted.py N K [SEED [KIND]]`` is the campaign: N runs that stop at a random step and are saved, and
K processes that are killed at a random moment while they write checkpoints, of problems of one kind, as ``delayed``.
"""

from __future__ import annotations

import ast
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix

import invariode as iv

METHODS = tuple(name for name, about in iv.METHODS.items() if about.equations == "any")


@dataclass(frozen=True)
class Case:
    """A run in one go, and the accepted step after which it is interrupted."""

    method: str
    problem: Callable[[], iv.Problem]  # makes it anew, as another process does
    options: Mapping[str, Any]
    after: int

    def solve(self, **more: Any) -> iv.Solution:
        return self.problem().solve(self.method, **{**self.options, **more})

    @property
    def functions(self) -> dict[str, Any]:
        """The options that a file cannot hold."""
        return {name: one for name, one in self.options.items() if name == "breakpoints"}


# ----------------------------------------------------------------------------------------------------------------------
# Problems


def kepler(t, y):
    r3 = np.hypot(y[0], y[1]) ** 3
    return [y[2], y[3], -y[0] / r3, -y[1] / r3]


def energy(t, y):
    return (y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)


def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


def rates(t, y):
    a, b, c = y
    return [-2 * a + b * c, 2 * a - b * c - 5 * b * b, 5 * b * b]


def rates_jac(t, y):
    _, b, c = y
    return [[-2, c, b], [2, -c - 10 * b, -b], [0, 10 * b, 0]]


def forced(t, y):
    return [y[1], -y[0] - 0.1 * y[1] + (1.0 if int(t) % 2 else 0.0)]


def robertson(t, y):
    a, b, c = y
    return [-0.04 * a + 1e2 * b * c, 0.04 * a - 1e2 * b * c - 3e3 * b * b, a + b + c - 1]


def ball(t, y):
    return [y[1], -1.0]


def damped(t, y):
    return [y[1], -y[0] - 0.01 * y[1]]


def quadratic(t, y):
    return y[0] ** 2 + y[1] ** 2


def height(t, y):
    return y[0]


def bounced(t, y):
    return [0.0, -0.9 * y[1]]


def rotation(t, y):
    return 1j * y


def kick(t, y):
    return [y[0], y[1] + 0.5]


def varying_mass(t):
    return np.diag([2 + np.sin(t), 1.0])


def crossing(t, y):
    return y[1].real


PULSES = tuple(float(k) for k in range(1, 12))


def _events(rng: random.Random) -> list[iv.Event]:
    samples = rng.choice([None, 9])
    return [iv.Event(crossing, direction=rng.choice([-1, 0, 1]), **({} if samples is None else {"samples": samples}))]


def _orbit(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    laws = rng.choice(
        [None, [energy], [energy, momentum], [iv.Invariants(energy, when="needed"), iv.Invariants(momentum)]]
    )
    events = _events(rng) if rng.random() < 0.6 else None
    y0 = [0.4, 0.0, 0.0, 2.0]
    end = 12.0 if rng.random() < 0.8 else -12.0
    return lambda: iv.Problem(kepler, (0, end), y0, invariants=laws, events=events), {}


def _chemistry(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    laws = rng.choice([None, lambda t, y: y[0] + y[1] + y[2]])
    jac = rng.choice([None, rates_jac, lambda t, y: csc_matrix(rates_jac(t, y))]) if implicit else None
    return lambda: iv.Problem(rates, (0, 20), [1.0, 0, 0], nonnegative=True, invariants=laws, jac=jac), {}


def _pulses(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    points: list[Any] = [(t, kick) if t % 3 == 0 else t for t in PULSES]
    mass = varying_mass if implicit and rng.random() < 0.3 else None
    events = _events(rng) if rng.random() < 0.6 else None
    return lambda: iv.Problem(forced, (0, 12), [1.0, 0], mass=mass, events=events), {"breakpoints": points}


def _bouncing(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    event = iv.Event(height, direction=-1, action=bounced)
    laws = rng.choice([None, lambda t, y: y[1] ** 2 / 2 + y[0]])
    return lambda: iv.Problem(ball, (0, 8), [1.0, 0.0], events=event, invariants=laws), {"max_step": 0.2}


def _dissipating(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    return lambda: iv.Problem(damped, (0, 20), [1.0, 0.0], invariants=iv.Dissipated(quadratic)), {}


def _along_steps(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    law = iv.Invariants(energy, direction="stages")
    return lambda: iv.Problem(kepler, (0, 12), [0.4, 0.0, 0.0, 2.0], invariants=law), {}


def _complex(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    return lambda: iv.Problem(rotation, (0, 10), [1 + 0j, 0.5j], invariants=lambda t, y: abs(y[0]) ** 2), {}


def mackey_glass(t, y, z):
    return [0.25 * z[0, 0] / (1 + z[0, 0] ** 10) - 0.1 * y[0]]


def dosed(t, y):
    return [0.5 * y[0] + 0.2]


def _delayed(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    doses = [(10.0 * k, dosed) for k in range(1, 20)] if rng.random() < 0.5 else None
    delays = rng.choice([[15.0], [15.0, 4.0], [0.05]])
    options: dict[str, Any] = {} if doses is None else {"breakpoints": doses}
    return lambda: iv.Problem(mackey_glass, (0, 200), [1.2], delays=delays, history=1.0), options


def _algebraic(rng: random.Random, implicit: bool) -> tuple[Callable[[], iv.Problem], dict[str, Any]]:
    return lambda: iv.Problem(robertson, (0, 50), [1.0, 0, 0], mass=np.diag([1.0, 1, 0])), {}


def random_case(seed: int, method: str | None = None, only: str | None = None) -> Case:
    """Return the case of a seed, of a problem of one kind if its name is given."""
    rng = random.Random(seed)
    method = method or rng.choice([name for name in METHODS if only != "delayed" or iv.METHODS[name].delays])
    about = iv.METHODS[method]
    implicit = "jac" in about.options
    kinds = [_orbit, _orbit, _chemistry, _pulses, _bouncing, _complex, _dissipating, _along_steps]
    if about.mass == "any":
        kinds.append(_algebraic)
    if about.delays:
        kinds.append(_delayed)
    kind = rng.choice([one for one in kinds if only in (None, one.__name__.lstrip("_"))])
    if about.mass != "any" and kind is _pulses:
        implicit = False  # no M(t)
    problem, options = kind(rng, implicit)
    rtols = [1e-3, 1e-6, 1e-9] if about.order > 3 else [1e-3, 1e-6]
    options |= {"rtol": rng.choice(rtols), "atol": rng.choice([1e-6, 1e-9]), "dense_output": rng.random() < 0.6}
    output = rng.choice(["steps", "steps", "times", "refined", "end"])
    if output == "times":
        start, end = problem().t_span
        options["t_eval"] = np.linspace(start, end, 41)
    elif output == "refined":
        options["refine"] = 3
    elif output == "end":
        options |= {"keep": "end", "dense_output": False}
    if "fsal" in about.options:
        options["fsal"] = rng.choice(["reuse", "evaluate"])
    if "max_order" in about.options and rng.random() < 0.3:
        options["max_order"] = about.min_order + 2
    case = Case(method, problem, MappingProxyType(options), 0)
    steps = case.solve().stats.steps
    return Case(method, problem, case.options, rng.randrange(0, steps) + 1 if steps else 1)


# ----------------------------------------------------------------------------------------------------------------------
# Laws


def differences(a: iv.Solution, b: iv.Solution) -> list[str]:
    """In what two runs are not the same to the last bit."""
    found = [name for name in ("status", "message", "t_end") if a[name] != b[name]]
    found += [f"stats.{name}" for name in a.stats if a.stats[name] != b.stats[name]]
    pairs = [("t", a.t, b.t), ("y", a.y, b.y)]
    for name in ("t_events", "y_events"):
        pairs += [(name, *both) for both in zip(a[name] or (), b[name] or (), strict=True)]
    if a.steps is not None:
        pairs.append(("steps", a.steps._rows, b.steps._rows))
    if a.sol is not None and len(a.sol.ts):
        t = np.linspace(a.sol.ts[0], a.sol.ts[-1], 173)
        pairs += [("knots", a.sol.ts, b.sol.ts), ("sol", a.sol(t), b.sol(t))]
    pairs += [("drift", a._drift.residual, b._drift.residual), ("distance", a._drift.distance, b._drift.distance)]
    rows = [np.array([jump.row for jump in one._invariants.jumps]) for one in (a, b)]
    pairs.append(("jumps", *rows))
    return found + [name for name, x, y in pairs if x.shape != y.shape or x.tobytes() != y.tobytes()]


def interrupt(case: Case, path: Path) -> None:
    case.solve(max_steps=case.after).save(path)


def go_on(case: Case, path: Path) -> iv.Solution:
    problem = case.problem()
    return iv.load(path, problem, **case.functions).extend(problem.t_span[1], max_steps=None)


def in_another_process(seeds: list[int], folder: Path, methods: Mapping[int, str | None]) -> None:
    """Goes on with the saved runs of these seeds, and saves what they come to."""
    told = repr([(seed, methods.get(seed)) for seed in seeds])
    subprocess.run([sys.executable, __file__, "--go-on", str(folder), told], check=True)


def _go_on_with(folder: Path, told: list[tuple[int, str | None]]) -> None:
    for seed, method in told:
        go_on(random_case(seed, method), folder / f"{seed}.npz").save(folder / f"{seed}-on.npz")


def with_checkpoints(seed: int, path: Path, only: str | None = None) -> None:
    """The run, with a checkpoint after each step."""
    random_case(seed, only=only).solve(checkpoint=iv.Checkpoint(path, every=1e-9))


def killed(seed: int, path: Path, rng: random.Random, only: str | None = None) -> str:
    """Kills a process at a random moment of its run, and goes on: 'whole', 'not begun' or what differs."""
    case = random_case(seed, only=only)
    begin = time.perf_counter()
    with_checkpoints(seed, path, only)
    length = time.perf_counter() - begin
    for one in path.parent.glob(path.name + "*"):
        one.unlink()
    child = subprocess.Popen(
        [sys.executable, __file__, "--checkpoint", str(path), str(seed), *([only] if only else [])],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    child.stdout.readline()
    time.sleep(rng.random() * length)
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    if not path.exists():
        return "not begun"
    problem = case.problem()
    loaded = iv.load(path, problem, **case.functions)
    if loaded.status == -3:
        loaded.extend(problem.t_span[1])
        loaded = iv.load(path, problem, **case.functions)
    return ", ".join(differences(case.solve(), loaded)) or "whole"


def _campaign(runs: int, kills: int, seed: int = 0, only: str | None = None) -> int:
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seeds = list(range(seed, seed + runs))
        for one in seeds:
            interrupt(random_case(one), folder / f"{one}.npz")
        in_another_process(seeds, folder, {})
        for one in seeds:
            case = random_case(one)
            off = differences(case.solve(), iv.load(folder / f"{one}-on.npz", case.problem(), **case.functions))
            wrong += bool(off)
            if off:
                print(f"run {one} ({case.method}): {', '.join(off)}")
        rng = random.Random(seed)
        outcomes = [(one, killed(one, folder / f"{one}.checkpoint", rng, only)) for one in range(seed, seed + kills)]
        for one, outcome in outcomes:
            if outcome not in ("whole", "not begun"):
                wrong += 1
                print(f"kill {one}: {outcome}")
        begun = sum(outcome != "not begun" for _, outcome in outcomes)
    print(f"{runs} runs, {kills} kills of which {begun} after the first checkpoint: {wrong} wrong")
    return wrong


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("ignore")  # redundant invariants, stiffness: of no interest here
    if sys.argv[1] == "--go-on":
        _go_on_with(Path(sys.argv[2]), ast.literal_eval(sys.argv[3]))
    elif sys.argv[1] == "--checkpoint":
        print("begins", flush=True)
        with_checkpoints(int(sys.argv[3]), Path(sys.argv[2]), *sys.argv[4:])
    else:
        numbers = [int(one) for one in sys.argv[1:4]]
        sys.exit(_campaign(*numbers, *([0] * (3 - len(numbers))), *sys.argv[4:]) > 0)
