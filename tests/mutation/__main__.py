"""How many mutants do the tests kill? Run by hand, from the root, with `coverage` installed; not in CI.

    COVERED=covered.json PYTHONPATH=src:tests/mutation python -m pytest -q -n 0 -p covered      # which tests run a line
    python tests/mutation package --covered covered.json                                        # 140 mutants
    python tests/mutation core --build build/mutants                                            # 60 mutants, one build

A mutant is one change that a test should see (`mutants.py`, `core_mutants.py`): chosen by a seed, so that the same ones
can be run before and after a change of the tests (`--tests` is a folder of other tests, `--only` names mutants). Those
of the package run against the tests that cover their line, the quickest first; those of the core against `FAST`.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import core_mutants
import mutants

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "invariode"

#: Tests of the core that take a few seconds each, two minutes together.
FAST = [
    "test_counts", "test_order", "test_guard", "test_events", "test_jumps", "test_dense", "test_projection",
    "test_bounds", "test_confined", "test_breakpoints", "test_extend", "test_checkpoints", "test_limits",
    "test_implicit", "test_stiff", "test_stiffness", "test_misfit", "test_krylov", "test_auto", "test_levels",
    "test_mechanics", "test_dissipation", "test_directions", "test_discontinuities", "test_interval", "test_lanes",
    "test_trust", "test_units", "test_callbacks", "test_jacobians", "test_binding", "test_taylor",
    "test_sensitivities_core",
]  # fmt: skip


def libraries() -> None:
    """Imported once, before each mutant is a fork of this process."""
    import xarray  # noqa: F401  # for its import alone


def outcome(tests: Path, names: list[str], environment: dict[str, str], folder: Path, seconds: float) -> str:
    """Of the named tests in a fork, with a limit of CPU time: 'killed' by a failure, a crash or the limit."""
    child = os.fork()
    if child == 0:
        out = os.open(folder / "out.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
        os.environ |= environment | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
        os.chdir(tests.parent)
        sys.path.insert(0, str(folder))
        import pytest

        code = 70
        with suppress(BaseException):
            code = int(pytest.main(["-q", "-x", "-n0", "--tb=line", "-p", "no:cacheprovider", *names]))
        os._exit(code)
    end = time.monotonic() + 10 * seconds  # of a test that waits for ever
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return "survived" if status == 0 else "killed"
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "killed"


def told(folder: Path) -> str:
    """The end of what the tests printed."""
    return (folder / "out.txt").read_text()[-2000:]


@contextmanager
def package_with(file: str, source: str) -> Iterator[Path]:
    """A folder with a package of links, one of its files replaced."""
    with tempfile.TemporaryDirectory() as name:
        for path in PACKAGE.rglob("*"):
            link = Path(name) / "invariode" / path.relative_to(PACKAGE)
            if path.is_file() and path.suffix != ".pyc":
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(path)
        if file:
            (Path(name) / "invariode" / file).unlink()
            (Path(name) / "invariode" / file).write_text(source, encoding="utf-8")
        yield Path(name)


def tests_of(mutant: mutants.Mutant, covered: dict[str, Any], seconds: float) -> tuple[list[str], float]:
    """The tests that run the line, the quickest first, as many as the time allows, but at least one; and their time."""
    took = covered["seconds"]
    names, total = [], 0.0
    for name in sorted(covered["lines"].get(mutant.file, {}).get(str(mutant.line), []), key=took.__getitem__):
        total += took[name]
        if names and total > seconds:
            return names, total - took[name]
        names.append(name)
    return names, total


def of_package(given: argparse.Namespace) -> Iterator[tuple[str, str]]:
    covered = json.loads(Path(given.covered).read_text())
    for number, mutant in enumerate(mutants.sample(PACKAGE, given.count, given.seed)):
        if given.only and number not in given.only:
            continue
        label = f"{number} {mutant.file}:{mutant.line} {mutant.kind}"
        names, expected = tests_of(mutant, covered, given.seconds / 2)
        if not names:
            yield label, "not covered"
            continue
        source = (PACKAGE / mutant.file).read_text(encoding="utf-8")
        with package_with(mutant.file, mutants.mutated(source, mutant)) as folder:
            yield label, outcome(given.tests, names, {}, folder, max(given.seconds, 2 * expected))


def of_core(given: argparse.Namespace) -> Iterator[tuple[str, str]]:
    chosen = core_mutants.build(ROOT, Path(given.build), given.count, given.seed)
    with package_with("", "") as folder:
        for extension in (folder / "invariode").glob("_core*.so"):
            extension.unlink()
        built = next(Path(given.build).glob("build/dev/_core*.so")).resolve()
        (folder / "invariode" / built.name).symlink_to(built)
        names = [str(given.tests / f"{name}.py") for name in FAST]
        if outcome(given.tests, names, {}, folder, given.seconds) == "killed":
            raise SystemExit(f"the tests fail without a mutant, or take more than {given.seconds} s:\n{told(folder)}")
        for number, about in enumerate(chosen):
            if given.only and number not in given.only:
                continue
            yield (
                f"{number} {about}",
                outcome(given.tests, names, {core_mutants.VARIABLE: str(number)}, folder, given.seconds),
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("of", choices=["package", "core"])
    parser.add_argument("--covered", default="covered.json")
    parser.add_argument("--build", default="build/mutants")
    parser.add_argument("--tests", type=lambda name: Path(name).resolve(), default=ROOT / "tests")
    parser.add_argument("--seed", type=int, default=26)
    parser.add_argument("--count", type=int)
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("--seconds", type=float, help="of CPU time, several times what the tests take")
    given = parser.parse_args()
    given.count = given.count or {"package": 140, "core": 60}[given.of]
    given.seconds = given.seconds or {"package": 60.0, "core": 600.0}[given.of]
    libraries()
    killed = run = 0
    for label, what in {"package": of_package, "core": of_core}[given.of](given):
        run += 1
        killed += what == "killed"
        print(f"{what:12} {label}", flush=True)
    print(f"{killed} of {run} killed")


if __name__ == "__main__":
    main()
