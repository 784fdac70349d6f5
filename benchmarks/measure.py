"""How all benchmarks measure, name the machine, and write their tables into the pages of docs/benchmarks."""

from __future__ import annotations

import argparse
import gc
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter

from tabulate import tabulate

PAGES = Path(__file__).parents[1] / "docs" / "benchmarks"

#: Seconds, one per repetition, of everything that ran in turn.
Times = Mapping[str, Sequence[float]]


def interleaved(
    contestants: Mapping[str, Callable[[], object]], repetitions: int, clock: Callable[[], float] = perf_counter
) -> Times:
    """Times A B C A B C ...: what disturbs the machine disturbs all of them. One round before warms up."""
    times: dict[str, list[float]] = {name: [] for name in contestants}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for repetition in range(-1, repetitions):
            for name, run in contestants.items():
                start = clock()
                run()
                elapsed = clock() - start
                if repetition >= 0:
                    times[name].append(elapsed)
            gc.collect()
    finally:
        if collecting:
            gc.enable()
    return times


def ratio(a: Iterable[float], b: Iterable[float]) -> float:
    """Median over the repetitions of a / b: neighbours in time are compared."""
    return statistics.median(x / y for x, y in zip(a, b, strict=True))


def spread(seconds: Sequence[float], unit: float, digits: int = 2) -> str:
    """Median, smallest and largest, in multiples of `unit` seconds."""
    median, low, high = (x / unit for x in (statistics.median(seconds), min(seconds), max(seconds)))
    return f"{median:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"


def growth(run: Callable[[], object]) -> int:
    """Bytes by which the peak of resident memory during `run` exceeds what was resident before (Linux only).

    Not of getrusage: its peak is that of the whole life of the process, and begins with the parent's.
    """
    Path("/proc/self/clear_refs").write_text("5")  # the peak is what is resident now
    before = _resident("VmRSS")
    kept = run()
    peak = _resident("VmHWM")
    del kept
    return peak - before


def in_fresh_process(script: str, *arguments: str) -> str:
    """What the script prints when it is run on its own: memory is measured where nothing else has been."""
    command = [sys.executable, script, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def _resident(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


def machine(*packages: str) -> str:
    """The machine and the versions that the figures are from."""
    versions = ", ".join(f"{package} {installed(package) or 'not installed'}" for package in packages)
    return f"{_cpu()}, {os.cpu_count()} cores, {platform.system()}; Python {platform.python_version()}, {versions}"


def installed(package: str) -> str | None:
    """Version of the package, or None."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table that is also aligned as plain text: the first column to the left, the others to the right."""
    alignment = ["left", *["right"] * (len(header) - 1)]
    return tabulate(list(rows), header, tablefmt="pipe", disable_numparse=True, colalign=alignment)


def folded(summary: str, *parts: str) -> str:
    """Parts of a report behind a line to click on, for those who want every figure."""
    body = "\n\n".join(filter(None, parts))
    return f"<details>\n<summary>{summary}</summary>\n\n{body}\n\n</details>"


def run(name: str, document: str | None, report: Callable[[int], str], repetitions: int) -> None:
    """The command line of a benchmark: prints its report, with --write into the section of that name too."""
    parser = argparse.ArgumentParser(description=document)
    parser.add_argument("--write", action="store_true", help="replace the tables in docs/benchmarks")
    parser.add_argument("--repetitions", type=int, default=repetitions)
    arguments = parser.parse_args()
    text = report(arguments.repetitions)
    print(text)
    if arguments.write:
        write_section(name, text)


def write_section(name: str, text: str) -> None:
    """Replaces what stands between the markers of the section, in the page of docs/benchmarks that has them."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    for page in sorted(PAGES.glob("*.md")):
        before, found_begin, rest = page.read_text(encoding="utf-8").partition(begin)
        _, found_end, after = rest.partition(end)
        if found_begin and found_end:
            page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}", encoding="utf-8")
            return
    raise SystemExit(f"no page of {PAGES} has a section between {begin} and {end}: add one")
