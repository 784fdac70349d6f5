"""Models of SBML, and problems of PEtab: ``python benchmarks/models.py [solve] [load] [gradients] [accuracy] [fits]``.

The models are those of PEtab's benchmark collection, which lie in ``../shared/petab``. `solve` compares with
libRoadRunner, if it is there (``pip install libroadrunner``), by the process clock, interleaved: rtol 1e-8, atol 1e-12.
`accuracy` compares gradients with differences of likelihoods of runs with rtol 1e-12.
`fits` searches from points of a Latin hypercube; names of problems restrict it, as in ``fits Boehm --seeds 5``.
"""

from __future__ import annotations

import argparse
import json
import sys
import tarfile
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

import numpy as np
from measure import interleaved, ratio

import invariode as iv
from invariode import petab, sbml

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from sbml_campaign import shared

#: Models, and the ends of their simulations: that of Chen is before a switch at 1799.99, where CVODE gives up.
SOLVED = {"Boehm": 240.0, "Bachmann": 240.0, "SalazarCavazos": 180.0, "Chen": 1700.0}
STEADY = ("Bachmann", "Zheng", "Weber", "Bruno", "Lucarelli", "Brannmark", "Schwen", "SalazarCavazos")
#: Problems, the numbers of starts of a fit, and the log-likelihoods that it should find.
FITTED = {"Boehm": (50, -138.222), "Bruno": (100, 46.688), "Crauste": (100, -190.964)}
POINTS = 101
#: Problems whose gradients take minutes: 155 parameters of 500 states.
SLOW = ("Chen",)


def show(*parts: object) -> None:
    print(*parts, sep="  ", flush=True)


class Collection:
    """The unpacked problems, by the first part of their names."""

    def __init__(self, folder: str) -> None:
        with tarfile.open(shared("petab/benchmark.tar.xz")) as archive:
            archive.extractall(folder, filter="data")
        self._folders = {one.name.partition("_")[0]: one for one in sorted(Path(folder).iterdir()) if one.is_dir()}
        self.names = [*self._folders]
        wanted = json.loads(shared("petab/likelihoods.json").read_text())
        self.expected = {name.partition("_")[0]: one["log_likelihood"] for name, one in wanted.items()}

    def yaml(self, name: str) -> Path:
        found = [one for one in self._folders[name].glob("*.yaml") if "visual" not in one.name]
        return min(found, key=lambda one: len(one.name))

    def model(self, name: str) -> Path:
        return next(self._folders[name].glob("*.xml"))


def once(run: Callable[[], object]) -> tuple[object, float]:
    """The result of a call, and its processor time."""
    start = process_time()
    return run(), process_time() - start


def solve(problems: Collection, repetitions: int) -> None:
    try:
        import roadrunner
    except ModuleNotFoundError:
        roadrunner = None
    for name, end in SOLVED.items():
        model = sbml.load(problems.model(name))
        contestants = {"ours": lambda model=model, end=end: model.simulate(0, end, POINTS)}
        if roadrunner is not None:
            theirs = roadrunner.RoadRunner(str(problems.model(name)))
            theirs.integrator.relative_tolerance, theirs.integrator.absolute_tolerance = 1e-8, 1e-12

            def run(theirs=theirs, end=end):
                theirs.resetAll()
                return theirs.simulate(0, end, POINTS)

            contestants["theirs"] = run
        times = interleaved(contestants, repetitions, process_time)
        quotient = f"ratio {ratio(times['ours'], times['theirs']):.2f}" if roadrunner else ""
        show(f"solve {name}: ms", *(f"{one} {1e3 * median(taken):.2f}" for one, taken in times.items()), quotient)


def load(problems: Collection, repetitions: int) -> None:
    name, end = "Chen", SOLVED["Chen"]
    model, loaded = once(lambda: sbml.load(problems.model(name)))
    _, first = once(lambda: model.simulate(0, 1e-6 * end, 2))
    show(f"load {name}: s", f"{loaded:.2f}", f"with the first run {loaded + first:.2f}")


def gradients(problems: Collection, repetitions: int) -> None:
    for name in problems.names:
        if name in SLOW:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            objective = petab.load(problems.yaml(name)).objective()
            x = petab.load(problems.yaml(name)).nominal
            found, first = once(lambda objective=objective, x=x: objective(x))
            count = repetitions if first < 10 else 1
            others = [x + 1e-6 * (i + 1) for i in range(count)]  # nothing is kept of them
            taken = [once(lambda objective=objective, x=x: objective(x))[1] for x in others]
        expected = problems.expected.get(name)
        off = "" if expected is None else f"relative difference {abs(found.log_likelihood / expected - 1):.1e}"
        show(f"gradient {name}: ms", f"{1e3 * median(taken):.1f} (first {1e3 * first:.0f})", off)


def accuracy(problems: Collection, repetitions: int) -> None:
    """The errors of gradients, by differences of the fourth order along the two largest components and three others.

    They are relative to the largest component, and in standard deviations of the gradient, √F. The point is 0.02 beside
    the nominal one, where gradients vanish; the nominal one, if the runs fail beside it. The smaller one of two steps
    counts: 0.01 and 0.002 standard deviations of a parameter, at most 1 on its scale.
    """
    for name in problems.names:
        if name in SLOW:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem = petab.load(problems.yaml(name))
            value = petab.load(problems.yaml(name), rtol=1e-12, atol=1e-16).objective().value
            rng = np.random.default_rng(0)
            x = problem.nominal + 0.02 * rng.normal(size=len(problem.nominal))
            if not np.isfinite(value(x)):
                x = problem.nominal
            found = problem.objective()(x)
            deviation = np.maximum(np.sqrt(np.diag(found.fisher)), 1.0)
            off = np.zeros(len(x))
            for j in {*np.argsort(-np.abs(found.gradient))[:2].tolist(), *rng.permutation(len(x))[:3].tolist()}:
                differences = []
                for h in (0.01 / deviation[j], 0.002 / deviation[j]):
                    e = h * np.eye(len(x))[j]
                    near, far = (value(x + s * e) - value(x - s * e) for s in (1, 2))
                    differences.append(abs((8 * near - far) / (12 * h) - found.gradient[j]))
                off[j] = min(differences)
        relative, in_deviations = off.max() / np.abs(found.gradient).max(), (off / deviation).max()
        show(f"accuracy {name}: relative {relative:.1e}, in standard deviations {in_deviations:.1e}")


def steady(problems: Collection, repetitions: int) -> None:
    for name in STEADY:
        problem = sbml.load(problems.model(name)).problem((0, 1.0))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = iv.steady_state(problem)
            taken = [once(lambda problem=problem: iv.steady_state(problem))[1] for _ in range(repetitions)]
        totals = found.totals @ problem.y0
        off = np.abs(found.totals @ found.y - totals) / (np.abs(found.totals) @ np.abs(problem.y0) + 1e-300)
        show(f"steady {name}: ms", f"{1e3 * median(taken):.1f}", found.success, f"totals {off.max(initial=0):.1e}")


def fits(problems: Collection, names: list[str], seeds: int, starts: int | None) -> None:
    for name in names or [*FITTED]:
        count, best = FITTED[name]
        count = starts or count
        problem = petab.load(problems.yaml(name))
        for seed in range(1, seeds + 1):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                begin = perf_counter()
                found, taken = once(
                    lambda problem=problem, count=count, seed=seed: iv.fit(
                        problem.experiments, problem.parameters, starts=count, seed=seed
                    )
                )
            show(f"fit {name} from {count}, seed {seed}:", f"{found.log_likelihood:.6f} of {best}",
                 f"{taken:.1f} s, wall {perf_counter() - begin:.1f} s")  # fmt: skip


PARTS = {"solve": solve, "load": load, "gradients": gradients, "accuracy": accuracy, "steady": steady}


def chosen(given: list[str]) -> Iterator[str]:
    return (one for one in [*PARTS, "fits"] if one in given or not given)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"{', '.join(PARTS)}, fits; names of problems for fits")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--starts", type=int, default=None)
    given = parser.parse_args()
    names = [one for one in given.parts if one in FITTED]
    with tempfile.TemporaryDirectory() as folder:
        problems = Collection(folder)
        for part in chosen([one for one in given.parts if one not in FITTED]):
            if part == "fits":
                fits(problems, names, given.seeds, given.starts)
            else:
                PARTS[part](problems, given.repetitions)


if __name__ == "__main__":
    main()
