"""A pytest plugin: runs one case of each test function, and writes which functions execute which lines of the package,
and the CPU seconds that all cases of each take, if they take as long, to the JSON file $COVERED. Needs `coverage`.

    COVERED=covered.json PYTHONPATH=src:tests/mutation python -m pytest -q -n 0 -p covered
"""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

PACKAGE = Path(__file__).parents[2] / "src" / "invariode"
measured = coverage.Coverage(data_file=None, source=[str(PACKAGE)])
measured.start()
cases: Counter[str] = Counter()
seconds: dict[str, float] = {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    first = {item.nodeid.partition("[")[0]: item for item in reversed(items)}
    cases.update(item.nodeid.partition("[")[0] for item in items)
    items[:] = reversed(first.values())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[object]:
    function = item.nodeid.partition("[")[0]
    measured.switch_context(function)
    start = time.process_time()
    result = yield
    seconds[function] = cases[function] * (time.process_time() - start)
    measured.switch_context("")
    return result


def pytest_sessionfinish() -> None:
    measured.stop()
    data = measured.get_data()
    lines = {
        str(Path(file).relative_to(PACKAGE)): {
            line: [one for one in functions if one] for line, functions in data.contexts_by_lineno(file).items()
        }
        for file in data.measured_files()
    }
    Path(os.environ["COVERED"]).write_text(json.dumps({"lines": lines, "seconds": seconds}))
