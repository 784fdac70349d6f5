"""A pytest plugin: writes which test functions execute which lines of the package, and the CPU seconds of each, to the
JSON file $COVERED. All cases run: what one of them executes, another may not. Needs `coverage`.

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
seconds: Counter[str] = Counter()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[object]:
    function = item.nodeid.partition("[")[0]
    measured.switch_context(function)
    start = time.process_time()
    result = yield
    seconds[function] += time.process_time() - start
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
