"""Each example runs as it stands, returns its figure, and shows that what should be kept is kept."""

from __future__ import annotations

import ast
import re
import runpy
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))


@pytest.fixture(autouse=True)
def _no_windows():
    import matplotlib.pyplot as plt

    with mpl.rc_context({"backend": "Agg"}):
        yield
        plt.close("all")


def test_examples_say_what_they_are_and_where_they_are_from():
    assert len(EXAMPLES) >= 12
    for example in EXAMPLES:
        title, underline, *text = ast.get_docstring(ast.parse(example.read_text())).splitlines()
        assert underline == "=" * len(title), example.name
        assert any(line.startswith("Source: ") for line in text), example.name


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_draws_and_keeps_its_laws(example, capsys):
    """Plain and projected runs print their drifts first, others how far off they are."""
    figure = runpy.run_path(str(example), run_name="example")["main"]()
    assert isinstance(figure, Figure)
    figure.draw_without_rendering()
    found = (
        re.match(r" *([\w ]+?)(?::.*?| off by )(\d\.\de[+-]\d+)", line) for line in capsys.readouterr().out.splitlines()
    )
    off = {line[1]: float(line[2]) for line in found if line}
    if "plain" in off:
        assert off["projected"] < 1e-3 * off["plain"]
    else:
        assert off
        assert max(off.values()) < 1e-8
