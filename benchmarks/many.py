"""What many solves cost: ``python benchmarks/many.py [--write]``; the trial on a cluster needs the extra `cluster`.

Loops of short solves from Python, small ensembles, and a million trajectories on a cluster of two workers on this
machine, one of which is killed, with a client that is interrupted. All results are compared before anything is printed.
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

import numpy as np
from measure import installed, interleaved, machine, ratio, spread, table, write_section
from numpy.typing import NDArray

import invariode as iv

Array = NDArray[np.float64]

PACKAGES = ("invariode", "numpy", "numba", "CyRK", "heyoka", "distributed", "zarr")
US = 1e-6
#: Of the loop of short solves: how many, over which interval, at which tolerance. One takes 20 to 50 µs.
LOOP, SHORT, TOLERANCE = 10_000, (0.0, 40.0), 1e-6
#: Of a result that is timed.
LARGEST_ERROR = 1e-3
#: Of the trial: trajectories in all and in a block of the iterator; the interval.
TRIAL, BLOCK, SPAN = 1_000_000, 10_000, (0.0, 10.0)
#: Trajectories in a part of it: a fifth of a second, so that there are many parts.
CHUNK = 20_000
#: Of the comparison with threads: parts of a second, so many for each worker.
WORKERS, PARTS = 2, 6


@iv.compile
def predators(t: float, y: Array, p: Array) -> tuple[float, float]:
    return p[0] * y[0] * (1.0 - y[1]), -y[1] * (1.0 - y[0])


def block(number: int, size: int = BLOCK) -> tuple[Array, Array]:
    """Initial values and parameters, the same for the same number."""
    random = np.random.default_rng([17, number])
    return random.uniform(0.5, 2.0, (size, 2)), random.uniform(1.0, 2.0, (size, 1))


# ----------------------------------------------------------------------------------------------------------------------
# Loops of short solves


def loops(repetitions: int) -> str:
    y0, args = block(0, LOOP)
    parameters = [(float(p),) for p in args[:, 0]]
    problem = iv.Problem(predators, SHORT, y0[0], args=parameters[0])
    options: dict[str, Any] = {"rtol": TOLERANCE, "atol": TOLERANCE}
    exact = iv.solve_ensemble(predators, SHORT, y0, "dop853", args=args, rtol=1e-13, atol=1e-13).y_end

    def each(solve: Callable[..., iv.Solution]) -> list[Array]:
        return [solve(y0=y, args=p).y[:, -1] for y, p in zip(y0, parameters, strict=True)]

    def anew(y0: Array, args: tuple[float]) -> iv.Solution:
        return problem.replace(y0=y0, args=args).solve("ode78", keep="end", **options)

    ends: dict[str, Callable[[], Any]] = {
        "invariode ode78, prepared": partial(each, problem.prepare("ode78", keep="end", **options)),
        "invariode ode45, prepared": partial(each, problem.prepare("ode45", keep="end", **options)),
        "invariode ode78, Problem.solve": partial(each, anew),
        "invariode ode78, solve_ensemble on 1 thread": lambda: (
            iv.solve_ensemble(predators, SHORT, y0, "ode78", args=args, workers=1, **options).y_end
        ),
        **with_heyoka(y0, args),
        **with_cyrk(y0, parameters),
    }
    errors = {name: float(np.median(np.abs(np.array(run()) - exact).max(axis=1))) for name, run in ends.items()}
    for name, error in errors.items():
        if not error <= LARGEST_ERROR:
            raise SystemExit(f"not timed: {name} is off by {error:.1e}")
    times = interleaved(ends, repetitions, process_time)
    rows = [
        [
            name,
            f"{errors[name]:.1e}",
            spread([s / LOOP for s in seconds], US, 1),
            f"{ratio(seconds, times['invariode ode78, prepared']):.2f}",
        ]
        for name, seconds in times.items()
    ]
    return table([f"{LOOP:,} short solves in a loop", "median error", "each, µs", "÷ prepared"], rows)


def with_heyoka(y0: Array, args: Array) -> dict[str, Callable[[], Any]]:
    if installed("heyoka") is None:
        return {}
    import heyoka

    x, y = heyoka.make_vars("x", "y")
    system = [(x, heyoka.par[0] * x * (1.0 - y)), (y, -y * (1.0 - x))]
    integrator = heyoka.taylor_adaptive(system, y0[0], tol=TOLERANCE, pars=args[0])

    def run() -> Array:
        ends = np.empty_like(y0)
        for i in range(len(y0)):
            integrator.time = SHORT[0]
            integrator.state[:] = y0[i]
            integrator.pars[:] = args[i]
            integrator.propagate_until(SHORT[1])
            ends[i] = integrator.state
        return ends

    return {"heyoka, one integrator": run}


def with_cyrk(y0: Array, parameters: list[tuple[float]]) -> dict[str, Callable[[], Any]]:
    if installed("CyRK") is None:
        return {}
    from CyRK import nbsolve_ivp

    def fun(t: float, y: Array, a: float) -> Array:
        dy = np.empty_like(y)
        dy[0] = a * y[0] * (1.0 - y[1])
        dy[1] = -y[1] * (1.0 - y[0])
        return dy

    import numba

    compiled = numba.njit(fun)
    solve = partial(nbsolve_ivp, compiled, SHORT, rk_method=2, rtol=TOLERANCE, atol=TOLERANCE, warnings=False)

    def run() -> list[Array]:
        return [solve(y0=y, args=p).y[:, -1] for y, p in zip(y0, parameters, strict=True)]

    return {"CyRK DOP853, nbsolve_ivp": run}


def fixed(repetitions: int) -> str:
    """What a call costs beyond its steps: solves over an interval of no length."""
    y0 = np.array([1.0, 3.0])
    still = iv.Problem(predators, (0.0, 0.0), y0, args=(2.0,))
    end, full = still.prepare(keep="end"), still.prepare()
    few = np.tile(y0, (4, 1))
    calls: dict[str, Callable[[], object]] = {
        "prepared, final state": lambda: end(y0=y0),
        "prepared, y0 and args, final state": lambda: end(y0=y0, args=(2.0,)),
        "prepared, all steps": lambda: full(y0=y0),
        "Problem.solve, final state": lambda: still.solve(keep="end"),
        "Problem.solve, all steps": lambda: still.solve(),
        "solve_ensemble of 4 rows": lambda: iv.solve_ensemble(predators, (0.0, 0.0), few, args=(2.0,)),
    }
    many = 500

    def each(call: Callable[[], object]) -> None:
        for _ in range(many):
            call()

    times = interleaved({name: partial(each, call) for name, call in calls.items()}, 4 * repetitions, process_time)
    rows = [[name, f"{min(s) / many / US:.1f}", f"{median(s) / many / US:.1f}"] for name, s in times.items()]
    return table(["a call without steps", "least, µs", "median, µs"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# On a cluster


def peak_memory(pid: int | None = None) -> float:
    """The largest resident memory of a process so far, MiB (Linux only)."""
    lines = Path(f"/proc/{pid or os.getpid()}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


class Trial:
    """A run into a store that loses a worker, is interrupted, and goes on."""

    def __init__(self, size: int, folder: Path, client: Any) -> None:
        self.size, self.path, self.client = size, folder / "trial.zarr", client
        self.killed = False

    def rows(self, interrupted: bool) -> Iterator[tuple[Array, Array]]:
        blocks = self.size // BLOCK
        for number in range(blocks):
            if number == blocks // 3 and not self.killed:
                os.kill(next(iter(self.client.run(os.getpid).values())), signal.SIGKILL)
                self.killed = True
            if interrupted and number == 2 * blocks // 3:
                signal.raise_signal(signal.SIGINT)
            yield block(number)

    def run(self, interrupted: bool) -> iv.EnsembleStore:
        options: dict[str, Any] = {"rtol": TOLERANCE, "atol": TOLERANCE, "store": self.path, "seed": 17, "chunk": CHUNK}
        return iv.solve_ensemble(predators, SPAN, self.rows(interrupted), executor=self.client, resume=True, **options)

    def compare(self) -> None:
        """That the store has, bit for bit, what threads of this process find."""
        data = iv.EnsembleStore(self.path)
        if data.missing or len(data) != self.size:
            raise SystemExit(f"{data} is not complete")
        stored = data.to_xarray()
        for number in range(self.size // BLOCK):
            y0, args = block(number)
            here = iv.solve_ensemble(predators, SPAN, y0, args=args, rtol=TOLERANCE, atol=TOLERANCE)
            there = stored.isel(trajectory=slice(number * BLOCK, (number + 1) * BLOCK))
            for name in ("y_end", "t_end", "status"):
                if not np.array_equal(there[name].values, here[name]):
                    raise SystemExit(f"{name} of block {number} is not that of a local solve")
            for name in ("steps", "failed", "nfev"):
                if not np.array_equal(there["counts"].sel(count=name).values, here.stats[name]):
                    raise SystemExit(f"{name} of block {number} is not that of a local solve")


def trial(size: int, folder: Path, client: Any) -> str:
    test = Trial(size, folder, client)
    start = perf_counter()
    try:
        test.run(interrupted=True)
        raise SystemExit("the interruption was not heard")
    except KeyboardInterrupt:
        pass
    first = perf_counter() - start
    kept = iv.EnsembleStore(test.path)
    done = len(kept) - kept.missing
    start = perf_counter()
    store = test.run(interrupted=False)
    second = perf_counter() - start
    workers = [peak_memory(pid) for pid in client.run(os.getpid).values()]
    mine = peak_memory()
    test.compare()
    rows = [
        ["trajectories", f"{len(store):,}"],
        ["of them in a part", f"{store.attributes['chunk']:,}"],
        ["in the store at Ctrl-C", f"{done:,}"],
        ["seconds until Ctrl-C, and after it", f"{first:.1f}, {second:.1f}"],
        ["peak memory of the client, with the scheduler, MiB", f"{mine:.0f}"],
        ["peak memory of the workers, MiB", ", ".join(f"{one:.0f}" for one in workers)],
        ["store on disk, bytes for each trajectory", f"{on_disk(test.path) / len(store):.0f}"],
        ["equal to a local solve", "to the last bit"],
    ]
    return table(["a worker killed at a third, Ctrl-C at two thirds", ""], rows)


def on_disk(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def against_threads(client: Any, folder: Path, repetitions: int) -> str:
    """Parts of a second on the workers, against threads of this process."""
    y0, args = block(0, 100_000)
    options: dict[str, Any] = {"rtol": TOLERANCE, "atol": TOLERANCE}
    start = perf_counter()
    iv.solve_ensemble(predators, SPAN, y0, args=args, workers=1, **options)
    chunk = int(len(y0) / (perf_counter() - start))
    y0, args = block(1, chunk * WORKERS * PARTS)
    local = partial(iv.solve_ensemble, predators, SPAN, y0, args=args, workers=WORKERS, **options)
    remote = partial(iv.solve_ensemble, predators, SPAN, y0, args=args, executor=client, chunk=chunk, **options)
    counter = iter(range(10**6))
    runs: dict[str, Callable[[], Any]] = {
        "threads": local,
        "workers": remote,
        "workers, store": lambda: remote(store=folder / f"{next(counter)}.zarr"),
        "threads, store": lambda: iv.solve_ensemble(
            predators,
            SPAN,
            y0,
            args=args,
            workers=WORKERS,
            chunk=WORKERS * chunk,
            store=folder / f"{next(counter)}.zarr",
            **options,
        ),
    }
    if not np.array_equal(local().y_end, remote().y_end):
        raise SystemExit("not timed: the workers' results are not those of the threads")
    spent: dict[str, list[float]] = {name: [] for name in runs}

    def noted(name: str) -> None:
        before = process_time() + sum(client.run(process_time).values())
        runs[name]()
        spent[name].append(process_time() + sum(client.run(process_time).values()) - before)

    walls = interleaved({name: partial(noted, name) for name in runs}, repetitions)
    rows = [
        [
            name,
            f"{len(y0) / median(walls[name]):,.0f}",
            f"{ratio(walls[name], walls['threads']):.3f}",
            f"{ratio(spent[name], spent['threads']):.3f}",
        ]
        for name in runs
    ]
    header = [f"{len(y0):,} trajectories, parts of {chunk:,}", "trajectories per second"]
    return table([*header, "time ÷ threads", "CPU time ÷ threads"], rows)


def tasks_and_bytes(client: Any, folder: Path) -> str:
    """What limits a large cluster: parts per second of the scheduler, and trajectories per second into a store."""
    y0, args = block(2, 3000)
    start = perf_counter()
    iv.solve_ensemble(predators, (0.0, 0.0), y0, args=args, executor=client, chunk=1)
    parts = len(y0) / (perf_counter() - start)
    y0, args = block(3, 2_000_000)
    start = perf_counter()
    iv.solve_ensemble(predators, (0.0, 0.0), y0, args=args, chunk=100_000, store=folder / "bytes.zarr", workers=WORKERS)
    rows = len(y0) / (perf_counter() - start)
    return table(
        ["limits, of a run that has nothing to integrate", ""],
        [
            ["parts per second, client and scheduler", f"{parts:,.0f}"],
            ["trajectories per second into a store", f"{rows:,.0f}"],
        ],
    )


def on_a_cluster(repetitions: int, size: int) -> list[str]:
    if installed("distributed") is None or installed("zarr") is None:
        return ["The extra `cluster` is not installed, and the trial on a cluster is left out."]
    from distributed import Client, LocalCluster

    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name,
        LocalCluster(
            n_workers=WORKERS, threads_per_worker=1, memory_limit="2GiB", dashboard_address=None, silence_logs=50
        ) as cluster,
        Client(cluster) as client,
    ):
        folder = Path(name)
        return [
            trial(size, folder, client),
            against_threads(client, folder, repetitions),
            tasks_and_bytes(client, folder),
        ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the tables in docs/benchmarks")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--size", type=int, default=TRIAL, help="trajectories of the trial")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of the packages compared
    cluster = on_a_cluster(arguments.repetitions, arguments.size)  # first: memory is measured where nothing else was
    parts = [
        f"{machine(*PACKAGES)}. Medians of {arguments.repetitions}.",
        fixed(arguments.repetitions),
        loops(arguments.repetitions),
        *cluster,
    ]
    text = "\n\n".join(parts)
    print(text)
    if arguments.write:
        write_section("many", text)


if __name__ == "__main__":
    main()
