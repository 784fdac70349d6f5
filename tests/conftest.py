"""Fixtures: every law runs over the registry of methods and over the problems."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from zlib import crc32

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for `from problems import …`
os.environ.setdefault("MPLBACKEND", "Agg")  # no windows
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # on a busy machine its threads wait for each other for seconds
os.environ["INVARIODE_CACHE"] = "off"  # tests change how code is written, which its name does not show

import invariode as iv
from cases import ALGEBRAIC, IMPLICIT, METHODS
from problems import PROBLEMS, TestProblem

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore Ctrl-C, so would the tests


# Files whose cases differ in what an interpreter decides, so that a case can fail on one interpreter alone. Elsewhere
# the cases of a test are methods, problems and options, which the core tells apart, so one case of each test is enough.
BY_INTERPRETER = [
    *("test_trace", "test_trace_arguments", "test_trace_code", "test_graph", "test_landings"),  # bytecode of f
    *("test_contents", "test_kept_plans", "test_code_cache"),  # whether two functions are equal, by code and closure
    *("test_checkpoints", "test_file_contents", "test_shared_files"),  # identity of functions in files
    *("test_callbacks", "test_binding", "test_filling", "test_remarks"),  # the C API: calls, exceptions, warnings
    *("test_interpreter", "test_processes", "test_limits", "test_progress"),  # threads, forks, signals
    *("test_options", "test_parameters", "test_cli_help"),  # signatures, annotations, docstrings
]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--part",
        choices=("interpreter", "one-case"),
        help="the files BY_INTERPRETER, alone or with one case of the others",
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the files that `--part interpreter` does not name."""
    chosen = collection_path.is_dir() or collection_path.stem in BY_INTERPRETER
    return None if chosen or config.getoption("--part") != "interpreter" else True


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """Each worker begins to collect at another file: in a new environment what is imported is compiled, and workers in
    step would each compile all of it."""
    report = yield
    if (worker := os.environ.get("PYTEST_XDIST_WORKER")) and collector.path == Path(__file__).parent:
        files = report.result
        first = len(files) * int(worker.removeprefix("gw")) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        report.result = files[first:] + files[:first]
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path)
    if config.getoption("--part") != "one-case":
        return
    assert all((Path(__file__).parent / f"{name}.py").exists() for name in BY_INTERPRETER)
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        whole = item.path.stem in BY_INTERPRETER
        cases.setdefault(item.nodeid if whole else item.nodeid.partition("[")[0], []).append(item)
    chosen = [found[crc32(name.encode()) % len(found)] for name, found in cases.items()]
    left = set(chosen)
    config.hook.pytest_deselected(items=[item for item in items if item not in left])
    items[:] = chosen


def pytest_collection_finish() -> None:
    """The items, the modules and what they hold stay to the end, so garbage collection need not search them each time;
    numba and SymPy allocate so much that it also took place too often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000)


@pytest.fixture(scope="module")
def few_objects() -> None:
    """Garbage collections by the tests of a file need not search what was there before it: that takes half a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _figures_are_closed() -> Iterator[None]:
    yield
    if (pyplot := sys.modules.get("matplotlib.pyplot")) is not None:
        pyplot.close("all")


@pytest.fixture
def command_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The problem files of the command, in the current directory."""
    from command_files import FILES

    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture(params=list(METHODS))
def method(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=[name for name, method in METHODS.items() if method.stages is not None])
def pair(request: pytest.FixtureRequest) -> str:
    """The explicit Runge-Kutta pairs."""
    return str(request.param)


@pytest.fixture(params=IMPLICIT)
def code(request: pytest.FixtureRequest) -> Callable[..., iv.Solution]:
    """The functions of the methods for stiff problems."""
    return getattr(iv, request.param)


@pytest.fixture(params=ALGEBRAIC)
def algebraic_code(request: pytest.FixtureRequest) -> Callable[..., iv.Solution]:
    """Yield the methods that take M(t), and singular M."""
    return getattr(iv, request.param)


@pytest.fixture(params=list(PROBLEMS))
def problem(request: pytest.FixtureRequest) -> TestProblem:
    return PROBLEMS[request.param]
