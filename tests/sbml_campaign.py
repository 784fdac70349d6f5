"""The SBML Test Suite: run its cases and write the conformance table of the docs.

``python tests/sbml_campaign.py [--method auto] [--table docs/howto/sbml-conformance.md] [cases ...]``; the cases lie in
``../shared/sbml-cases.tar.xz``, beside the project.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import csv
import json
import re
import signal
import sys
import tarfile
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from invariode import sbml

ROOT = Path(__file__).resolve().parents[1]


def shared(name):
    """The path of a file in `shared`, which lies beside the project or above it; None: it is not there."""
    return next((one / "shared" / name for one in ROOT.parents if (one / "shared" / name).exists()), None)


#: No case may take longer, in seconds.
LONGEST = 60


def unpacked(folder, names=None):
    """The folder of the cases; all, or those of these names."""
    with tarfile.open(shared("sbml-cases.tar.xz")) as archive:
        members = [
            one for one in archive if names is None or (one.name.split("/")[1:2] and one.name.split("/")[1] in names)
        ]
        archive.extractall(folder, members=members, filter="data")
    return Path(folder) / "sbml-cases"


class Case:
    """A case: its model, and what is expected."""

    def __init__(self, folder):
        self.folder, self.name = folder, folder.name
        text = (folder / "settings.txt").read_text()
        rows = list(csv.reader((folder / "results.csv").read_text().splitlines()))
        self.columns = [one.strip().strip('"') for one in rows[0]]
        self.expected = np.array([[float(x) for x in row] for row in rows[1:] if row])
        self.absolute, self.relative = (float(self.setting(text, one)) for one in ("absolute", "relative"))
        self.amounts, self.concentrations = (
            {x.strip() for x in self.setting(text, one).split(",") if x.strip()} for one in ("amount", "concentration")
        )
        tags = json.loads((folder / "tags.json").read_text())
        listed = ",".join(tags.get(one, "") for one in ("componentTags", "testTags")).split(",")
        # Some lists end with the next line of the case, "testType: TimeCourse".
        self.tags = [tag for one in listed if (tag := one.strip()) and not tag.startswith("testType:")]

    @staticmethod
    def setting(text, name):
        found = re.search(name + r":[ \t]*(.*)", text)
        return found.group(1).strip() if found else ""

    def selections(self, model):
        """The columns as `simulate` calls them."""
        found = []
        for name in self.columns[1:]:
            amount = name in self.amounts or (name not in self.concentrations and model.means_amount(name))
            found.append(name if amount or name not in model.species else f"[{name}]")
        return found

    def objection(self, **options):
        """Return the defect of the result; None: it is as expected."""
        model = sbml.load(self.folder / "model.xml", fast=options.pop("fast", "refuse"))
        times = self.expected[:, 0]
        table = model.simulate(0.0, times[-1], times, self.selections(model), **options)
        found = np.column_stack([times, table.array])
        near = np.abs(found - self.expected) <= self.absolute + self.relative * np.abs(self.expected)
        right = near | (found == self.expected) | (np.isnan(found) & np.isnan(self.expected))
        if right.all():
            return None
        i, j = np.argwhere(~right)[0]
        return f"{self.columns[j]} at t = {times[i]:g} is {found[i, j]:.9g}, expected {self.expected[i, j]:.9g}"


def too_long(*_):
    raise TimeoutError("it takes too long")


def outcome(case, longest=LONGEST, **options):
    """pass, wrong, refused or error, with the reason."""
    signal.alarm(longest)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            why = case.objection(**options)
    except sbml.UnsupportedError as error:
        return "refused", error.feature
    except Exception as error:  # whatever it is, it is counted
        return "error", f"{type(error).__name__}: {error}"[:200].replace("\n", " ")
    finally:
        signal.alarm(0)
    return ("pass", "") if why is None else ("wrong", why)


def table(results):
    """The conformance table by tag, in Markdown."""
    counts = collections.defaultdict(collections.Counter)
    for case, (kind, _), _ in results:
        for tag in ["all", *case.tags]:
            counts[tag][kind] += 1
    lines = ["| tag | cases | pass | refused | wrong or failed |", "|---|---|---|---|---|"]
    for tag in ["all", *sorted(counts.keys() - {"all"})]:
        n = counts[tag]
        lines.append(f"| {tag} | {sum(n.values())} | {n['pass']} | {n['refused']} | {n['wrong'] + n['error']} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="auto")
    parser.add_argument("--fast", default="refuse")
    parser.add_argument("--plain", action="store_true", help="without imposing moieties")
    parser.add_argument("--longest", type=int, default=LONGEST, help="seconds per case")
    parser.add_argument("--table", help="write the conformance table here")
    parser.add_argument("cases", nargs="*")
    given = parser.parse_args()
    signal.signal(signal.SIGALRM, too_long)
    with contextlib.ExitStack() as stack:
        folder = unpacked(stack.enter_context(tempfile.TemporaryDirectory()), {*given.cases} or None)
        results = []
        for path in sorted(folder.iterdir()):
            case = Case(path)
            start = time.perf_counter()
            found = outcome(case, given.longest, method=given.method, fast=given.fast, moieties=not given.plain)
            results.append((case, found, time.perf_counter() - start))
            if found[0] in ("wrong", "error"):
                print(case.name, *found, f"{results[-1][2]:.1f} s", flush=True)
    counts = collections.Counter(found[0] for _, found, _ in results)
    refused = collections.Counter(found[1] for _, found, _ in results if found[0] == "refused")
    seconds = [one for _, found, one in results if found[0] == "pass"]
    print(dict(counts), "refused:", dict(refused))
    print(f"median {1e3 * np.median(seconds):.1f} ms, longest {max(seconds):.1f} s")
    if given.table:
        Path(given.table).write_text(table(results) + "\n")
    return counts["wrong"] + counts["error"] > 0


if __name__ == "__main__":
    sys.exit(main())
