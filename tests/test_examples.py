"""Each example runs as it stands, writes its plot, and shows that projection reduces the drift, if it is about that."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
PNG = b"\x89PNG"


def test_there_are_examples():
    assert EXAMPLES


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs_and_writes_its_plot(example, tmp_path):
    plot = tmp_path / "plot.png"
    done = subprocess.run(
        [sys.executable, "-W", "error", str(example), str(plot)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg"},
    )
    assert done.returncode == 0, done.stderr
    assert plot.read_bytes().startswith(PNG)
    drifts = [float(re.search(r"\d(\.\d)?e-\d+", line)[0]) for line in done.stdout.splitlines()]
    if done.stdout.lstrip().startswith("plain"):
        plain, projected = drifts
        assert projected < 1e-3 * plain
    else:
        assert max(drifts) < 1e-8
