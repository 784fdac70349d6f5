"""What the annotations say, in the package as installed: typical code is right, and wrong calls are wrong."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CODE = Path(__file__).parent / "typing"

CONFIGURATION = """
[mypy]
strict = True
enable_error_code = ignore-without-code

# Of these the code and what it calls have no types: reading them takes mypy longer than all the rest.
[mypy-dask.*,distributed.*,jinja2.*,rich.*,scipy.stats.*,typer.*,xarray.*,zarr.*]
follow_imports = skip
follow_imports_for_stubs = True
"""


def test_mypy_finds_what_is_marked_and_nothing_else(tmp_path):
    """An `ignore` that is not needed is an error too: of a wrong call that mypy accepts."""
    pytest.importorskip("mypy")
    config = tmp_path / "mypy.ini"
    config.write_text(CONFIGURATION)
    command = [sys.executable, "-m", "mypy", "--config-file", config, "--cache-dir", os.devnull, CODE]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
