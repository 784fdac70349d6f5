"""An ensemble in parts, on whatever executor and into whatever store, is the ensemble at once, bit for bit."""

from __future__ import annotations

import pickle
import sys
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import invariode as iv
from cases import dealt
from ensembles import same
from invariode._ensemble.ensemble import _rows
from invariode._ensemble.executors import packed
from invariode._ensemble.sources import GivenRows, StreamedRows, digest

#: Trajectories that fail belong to many of these laws; that a warning says so is in tests/test_failures.py.
pytestmark = pytest.mark.filterwarnings("ignore::invariode.FailureWarning")

numba = pytest.importorskip("numba")

SIZE, SPAN = 23, (0.0, 4.0)
TIMES = [1.0, 2.5, 4.0]


def predators(t, y, a):
    if a > 1.9:
        raise ArithmeticError("too fast")
    return [a * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]


def crossing(t, y, a):
    return y[0] - 1.5


@iv.compile
def compiled(t, y, p):
    return p[0] * y[0] * (1 - y[1]), -y[1] * (1 - y[0])


@iv.compile
def compiled_crossing(t, y, p):
    return y[0] - 1.5


@iv.compile
def stiff(t, y, p):
    return y[1], p[0] * 1e3 * (1 - y[0] ** 2) * y[1] - y[0]


FORMS = {"native": (compiled, compiled_crossing), "python": (predators, crossing)}


def rows(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.uniform(0.5, 2, (size, 2)), rng.uniform(1, 2, (size, 1))


def solve(form: str, y0: Any = None, **options: Any) -> Any:
    fun, event = FORMS[form]
    states, args = rows()
    given = {"args": args} if y0 is None else {}
    return iv.solve_ensemble(fun, SPAN, states if y0 is None else y0, events=event, t_eval=TIMES, **given, **options)


class Immediate(Executor):
    """Solves where it is submitted, by way of pickles, and can fail as a pool of processes does."""

    def __init__(self, dies_at: int = 10**9) -> None:
        self.calls, self.dies_at = 0, dies_at

    def submit(self, call: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        from concurrent.futures.process import BrokenProcessPool

        self.calls += 1
        future: Future[Any] = Future()
        if self.calls >= self.dies_at:
            future.set_exception(BrokenProcessPool("a child process terminated abruptly"))
        else:
            future.set_result(pickle.loads(pickle.dumps(call(*pickle.loads(pickle.dumps(args))))))
        return future


# ----------------------------------------------------------------------------------------------------------------------
# Executors


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("length", [1, 7, SIZE, 1000])
def test_parts_are_the_whole(form: str, length: int) -> None:
    same(solve(form, executor=Immediate(), chunk=length), solve(form, workers=1))


@pytest.mark.parametrize("form", FORMS)
def test_the_size_of_a_part_is_found(form: str) -> None:
    executor = Immediate()
    same(solve(form, executor=executor), solve(form, workers=1))
    assert executor.calls >= 2  # the pilot, and parts


@pytest.mark.parametrize("kind", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_executors_of_the_standard_library(kind: Callable[[int], Executor]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # fork beside threads
        with kind(2) as executor:
            for form in FORMS:
                same(solve(form, executor=executor, chunk=5), solve(form, workers=1))


def test_rows_that_fail_do_so_in_parts_of_their_own_too() -> None:
    y0, args = rows()
    y0[4:11] = np.nan
    fun = FORMS["native"][0]
    whole = iv.solve_ensemble(fun, SPAN, y0, args=args)
    assert whole.failed.tolist() == list(range(4, 11))
    same(iv.solve_ensemble(fun, SPAN, y0, args=args, executor=Immediate(), chunk=5), whole)


def test_a_broken_executor_is_told() -> None:
    with pytest.raises(RuntimeError, match=r"lost trajectories 0 to 4.*resume=True"):
        solve("native", executor=Immediate(dies_at=1), chunk=5)
    with pytest.raises(TypeError, match="executor must be"):
        solve("native", executor=4)


def test_what_is_wrong_for_all_is_raised_at_once() -> None:
    executor = Immediate()
    with pytest.raises(TypeError, match="did you mean 'rtol'"):
        solve("python", executor=executor, rtoll=1)
    with pytest.raises(ValueError, match="unknown method"):
        solve("python", executor=executor, retry={"method": "ode46"})
    assert executor.calls == 0


def test_functions_of_a_script_travel() -> None:
    pytest.importorskip("cloudpickle")
    script: dict[str, Any] = {"__name__": "__main__", "iv": iv}
    exec("rate = 2.0\n\n@iv.compile\ndef fun(t, y, p):\n    return (-rate * p[0] * y[0],)", script)
    fun = pickle.loads(packed(script["fun"]))
    assert isinstance(fun, iv.CompiledFunction)
    assert fun is not script["fun"]
    given: dict[str, Any] = {"args": [[1.0], [2.0]], "workers": 1}
    same(iv.solve_ensemble(fun, (0, 1), [1.0], **given), iv.solve_ensemble(script["fun"], (0, 1), [1.0], **given))


def test_dask_and_a_worker_that_dies(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    zarr = pytest.importorskip("zarr")
    dask = pytest.importorskip("dask")
    with (
        warnings.catch_warnings(),
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),  # imports distributed once
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        warnings.simplefilter("ignore")  # of distributed and its event loop
        states, args = rows(120)
        whole = iv.solve_ensemble(compiled, SPAN, states, args=args, workers=1)

        def mortal() -> Iterator[Any]:
            for i in range(120):
                if i == 60:
                    client.run(
                        lambda: __import__("os")._exit(1), workers=[next(iter(client.nthreads()))], on_error="ignore"
                    )
                yield states[i], tuple(args[i].tolist())

        stored = iv.solve_ensemble(compiled, SPAN, mortal(), executor=client, chunk=10, store=tmp_path / "a.zarr")
        same(stored.load(), whole)
    assert zarr.open_group(tmp_path / "a.zarr", mode="r")["status"].shape == (120,)
    with pytest.raises(ValueError, match="client of Dask that has been closed"):
        iv.solve_ensemble(compiled, SPAN, states, args=args, executor=client)


# ----------------------------------------------------------------------------------------------------------------------
# Iterators


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("block", [None, 1, 4, 50])
def test_an_iterator_of_rows_is_an_array_of_them(form: str, block: int | None) -> None:
    y0, args = rows()
    pairs: Iterator[Any] = (
        zip(y0, map(tuple, args.tolist()), strict=True)
        if block is None
        else ((y0[i : i + block], args[i : i + block]) for i in range(0, SIZE, block))
    )
    same(solve(form, pairs, workers=1, chunk=6), solve(form, workers=1))


def test_an_iterator_is_not_read_far_ahead() -> None:
    read = 0

    def endless() -> Iterator[Any]:
        nonlocal read
        for i in range(10**9):
            read += 1
            if i == 5000:
                raise KeyboardInterrupt
            yield [1.0, 1.0 + i], (1.0,)

    with pytest.raises(KeyboardInterrupt):
        iv.solve_ensemble(compiled, (0, 0.1), endless(), chunk=10)
    assert read == 5001


def test_what_an_iterator_yields_is_checked() -> None:
    with pytest.raises(TypeError, match="must yield pairs"):
        iv.solve_ensemble(compiled, SPAN, iter([1.0]))
    with pytest.raises(ValueError, match="leave out args"):
        iv.solve_ensemble(compiled, SPAN, iter([]), args=(1.0,))
    with pytest.raises(ValueError, match="at least one row"):
        iv.solve_ensemble(compiled, SPAN, iter([]))
    with pytest.raises(ValueError, match="chunk, seed and resume"):
        iv.solve_ensemble(compiled, SPAN, [1.0, 1.0], args=(1.0,), seed=3)
    with pytest.raises(ValueError, match="seed and resume"):
        iv.solve_ensemble(compiled, SPAN, iter([([1.0, 1.0], (1.0,))]), seed=3)


def test_parts_have_all_rows_once_and_digests_tell_them_apart() -> None:
    y0, args = rows(50)
    given = list(GivenRows(y0, args).parts(8))
    problem = iv.Problem(lambda t, y, *args: y, (0, 1), y0[0])
    streamed = StreamedRows(((y0[i : i + 3], args[i : i + 3]) for i in range(0, 50, 3)), partial(_rows, problem))
    streamed.first(20)
    again = list(streamed.parts(8))
    assert [(p.number, p.start, digest(p)) for p in given] == [(p.number, p.start, digest(p)) for p in again]
    np.testing.assert_array_equal(np.concatenate([p.y0 for p in again]), y0)
    assert len({digest(p) for p in given}) == len(given)


# ----------------------------------------------------------------------------------------------------------------------
# Attempts


@pytest.mark.parametrize("executor", [None, Immediate()], ids=["at once", "in parts"])
def test_rows_that_failed_are_solved_again(executor: Any) -> None:
    limit = {"max_steps": 300}
    mu = np.array([[0.001], [1.0], [0.002], [2.0]])
    where = {} if executor is None else {"executor": executor, "chunk": 3}
    first = iv.solve_ensemble(stiff, (0, 2), [2.0, 0.0], args=mu, workers=1, **limit)
    assert first.failed.tolist() == [1, 3]
    out = iv.solve_ensemble(
        stiff, (0, 2), [2.0, 0.0], args=mu, workers=1, **limit, retry=[{"rtol": 1e-4}, {"method": "radau"}], **where
    )
    radau = iv.solve_ensemble(stiff, (0, 2), [2.0, 0.0], "radau", args=mu, workers=1, **limit)
    assert out.attempt.tolist() == [0, 2, 0, 2]
    assert out.failed.size == 0
    assert out.messages == {}
    np.testing.assert_array_equal(out.y_end[[0, 2]], first.y_end[[0, 2]])
    np.testing.assert_array_equal(out.y_end[[1, 3]], radau.y_end[[1, 3]])
    np.testing.assert_array_equal(out.stats.nfev[[1, 3]], radau.stats.nfev[[1, 3]])


def test_events_of_an_attempt_that_failed_are_gone() -> None:
    def solved(**options: Any) -> iv.EnsembleSolution:
        y0, args = rows()
        return iv.solve_ensemble(compiled, SPAN, y0, args=args, events=compiled_crossing, workers=1, **options)

    cut = {"max_steps": 5}
    assert solved(**cut).failed.size > 0
    again = solved(**cut, retry={"max_steps": None})
    np.testing.assert_array_equal(again.events[0].t, solved().events[0].t)
    np.testing.assert_array_equal(again.events[0].trajectory, solved().events[0].trajectory)


def test_retry_is_checked() -> None:
    with pytest.raises(ValueError, match="retry cannot change 'invariants'"):
        solve("native", retry={"invariants": None})
    with pytest.raises(TypeError, match="retry must be"):
        solve("native", retry=3)


# ----------------------------------------------------------------------------------------------------------------------
# Stores


def refused_or_same(path: Path, whole: Any) -> None:
    """A part without its digest counts as not solved."""
    try:
        found = iv.EnsembleStore(path).load()
    except ValueError as error:
        assert "out.zarr" in str(error) or "not solved yet" in str(error)
    else:
        same(found, whole)


class TestStore:
    @pytest.fixture(autouse=True)
    def zarr(self) -> Any:
        return pytest.importorskip("zarr")

    @dealt(form=FORMS, length=[6, 100])
    def test_it_holds_the_ensemble(self, form: str, length: int, tmp_path: Path) -> None:
        stored = solve(form, store=tmp_path / "out.zarr", chunk=length, workers=1, seed=5)
        whole = solve(form, workers=1)
        same(stored.load(), whole)
        assert stored.failed.tolist() == whole.failed.tolist()
        assert stored.messages == whole.messages
        assert stored.attributes["seed"] == 5
        assert len(stored) == SIZE
        assert stored.missing == 0
        same(iv.EnsembleStore(tmp_path / "out.zarr").load(), whole)

    def test_xarray_opens_it_with_names(self, tmp_path: Path) -> None:
        xarray = pytest.importorskip("xarray")
        y0, args = rows()
        solve("python", store=tmp_path / "out.zarr", chunk=6, workers=1)
        data = xarray.open_zarr(tmp_path / "out.zarr", chunks=None)
        assert data.sizes["trajectory"] == SIZE
        assert data.parameter.values.tolist() == ["a"]
        assert data.event.values.tolist() == ["crossing"]
        np.testing.assert_array_equal(data.y0.values, y0)
        np.testing.assert_array_equal(data.args.sel(parameter="a").values, args[:, 0])
        whole = solve("python", workers=1)
        np.testing.assert_array_equal(data.y.sel(component="y1", t=2.5).values, whole.y[:, 1, 1])
        np.testing.assert_array_equal(data.counts.sel(count="nfev").values, whole.stats.nfev)
        np.testing.assert_array_equal(iv.EnsembleStore(tmp_path / "out.zarr").to_xarray().status.values, whole.status)

    def test_what_is_missing_is_solved_after_a_crash(self, tmp_path: Path) -> None:
        y0, args = rows()
        given: dict[str, Any] = {"args": args, "store": tmp_path / "out.zarr"}
        with pytest.raises(RuntimeError, match="lost trajectories"):
            iv.solve_ensemble(compiled, SPAN, y0, **given, chunk=4, executor=Immediate(dies_at=4))
        partial = iv.EnsembleStore(tmp_path / "out.zarr")
        assert partial.missing == SIZE - 3 * 4
        assert "not solved yet" in repr(partial)
        with pytest.raises(ValueError, match="resume=True"):
            partial.load()
        executor = Immediate()
        for _ in range(2):  # the second time nothing is left
            stored = iv.solve_ensemble(compiled, SPAN, y0, **given, executor=executor, resume=True)
            same(stored.load(), iv.solve_ensemble(compiled, SPAN, y0, args=args, workers=1))
            assert executor.calls == -(-SIZE // 4) - 3

    def test_an_iterator_that_is_interrupted_is_resumed(self, tmp_path: Path) -> None:
        y0, args = rows(600)

        def source(last: int | None = None) -> Iterator[Any]:
            for i in range(0, 600, 50):
                if i == last:
                    raise KeyboardInterrupt
                yield y0[i : i + 50], args[i : i + 50]

        path = tmp_path / "out.zarr"
        with pytest.raises(KeyboardInterrupt):
            iv.solve_ensemble(compiled, SPAN, source(500), chunk=40, store=path)
        done = len(iv.EnsembleStore(path)) - iv.EnsembleStore(path).missing
        assert 0 < done < 500
        executor = Immediate()
        stored = iv.solve_ensemble(compiled, SPAN, source(), store=path, resume=True, executor=executor)
        assert executor.calls == (600 - done) // 40
        same(stored.load(), iv.solve_ensemble(compiled, SPAN, y0, args=args, workers=1))

    def test_it_is_not_overwritten(self, tmp_path: Path) -> None:
        solve("native", store=tmp_path / "out.zarr", chunk=6)
        with pytest.raises(FileExistsError, match="resume=True"):
            solve("native", store=tmp_path / "out.zarr", chunk=6)
        (tmp_path / "file").touch()
        for path in (tmp_path / "file", tmp_path / "file" / "out"):
            with pytest.raises(FileExistsError, match=r"store: .*file is a file, where a folder should be"):
                solve("native", store=path, chunk=6)
        for wrong in (3, b"out", [tmp_path]):
            with pytest.raises(TypeError, match=r"store must be a path, a URL or a store of zarr, got "):
                solve("native", store=wrong, chunk=6)
        with pytest.raises(ValueError, match="store = '' is not a name of a file"):
            solve("native", store="", chunk=6)

    @pytest.mark.parametrize(
        ("changed", "told"),
        [
            ({"rtol": 1e-5}, r"options\.rtol is 0\.001 there and 1e-05 now"),
            ({"method": "dop853"}, "method is 'ode45' there and 'dop853' now"),
            ({"seed": 6}, "seed is 5 there and 6 now"),
            ({"retry": {"rtol": 1e-9}}, "retry"),
            ({"t_eval": [1.0, 2.0]}, "t_eval"),
        ],
        ids=lambda one: str(one)[:12],
    )
    def test_a_store_of_another_problem_is_refused(self, changed: dict[str, Any], told: str, tmp_path: Path) -> None:
        y0, args = rows()
        given: dict[str, Any] = {"args": args, "store": tmp_path / "out.zarr", "chunk": 6, "resume": True, "seed": 5}
        iv.solve_ensemble(compiled, SPAN, y0, **given)
        with pytest.raises(ValueError, match=f"another problem: .*{told}"):
            iv.solve_ensemble(compiled, SPAN, y0, **{**given, **changed})
        with pytest.raises(ValueError, match="parts of 6 trajectories, got chunk=7"):
            iv.solve_ensemble(compiled, SPAN, y0, **{**given, "chunk": 7})
        with pytest.raises(ValueError, match="fun is"):
            iv.solve_ensemble(stiff, SPAN, y0, **given)
        with pytest.raises(ValueError, match="t_span is"):
            iv.solve_ensemble(compiled, (0, 3), y0, **given)
        with pytest.raises(ValueError, match="the number of trajectories is 23 there and 22 now"):
            iv.solve_ensemble(compiled, SPAN, y0[1:], **{**given, "args": args[1:]})
        with pytest.raises(ValueError, match="other y0 or args for trajectories 6 to 11"):
            iv.solve_ensemble(compiled, SPAN, np.vstack([y0[:6], y0[6:] + 1]), **given)

    def test_something_else_is_no_store(self, zarr: Any, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"nothing\.zarr does not exist"):
            iv.EnsembleStore(tmp_path / "nothing.zarr")
        zarr.create_group(tmp_path / "other.zarr")
        with pytest.raises(ValueError, match="was not written by solve_ensemble"):
            solve("native", store=tmp_path / "other.zarr", resume=True)

    def test_damage_is_never_loaded_as_values(self, tmp_path: Path) -> None:
        """A flipped bit, a lost or a swapped chunk, a lost array: an error that names the store, or the same values."""
        path = tmp_path / "out.zarr"
        whole = solve("native", store=path, chunk=12).load()
        chunks = sorted(one for one in path.rglob("*") if one.is_file() and one.name != "zarr.json")
        rng = np.random.default_rng(27)
        for chunk in rng.permutation(np.array(chunks, dtype=object))[:6]:
            original = chunk.read_bytes()
            flip = int(rng.integers(8 * len(original)))
            damaged = bytearray(original)
            damaged[flip // 8] ^= 1 << (flip % 8)
            chunk.write_bytes(damaged)
            refused_or_same(path, whole)
            chunk.unlink()
            refused_or_same(path, whole)
            chunk.write_bytes(original)
        for one, other in [*pairwise(chunks)][::6]:
            first, second = one.read_bytes(), other.read_bytes()
            one.write_bytes(second)
            other.write_bytes(first)
            refused_or_same(path, whole)
            one.write_bytes(first)
            other.write_bytes(second)
        same(iv.EnsembleStore(path).load(), whole)
        for name in ("y", "component", "checksum"):
            (path / name).rename(tmp_path / "away")
            with pytest.raises(ValueError, match=r"out\.zarr"):
                iv.EnsembleStore(path).load()
            (tmp_path / "away").rename(path / name)

    def test_invariants_and_complex_states(self, tmp_path: Path) -> None:
        def rotating(t: float, y: np.ndarray) -> Any:
            return 1j * y

        held = iv.Invariants(lambda t, y: abs(y[0]) ** 2, "3-point", names="modulus")
        y0 = np.exp(1j * np.arange(5))[:, None] * np.arange(1, 6)[:, None]
        whole = iv.solve_ensemble(rotating, (0, 1), y0, invariants=held, workers=1)
        stored = iv.solve_ensemble(rotating, (0, 1), y0, invariants=held, workers=1, store=tmp_path / "c", chunk=2)
        same(stored.load(), whole)
        assert stored.to_xarray().invariant.values.tolist() == ["modulus"]

    def test_memory_does_not_grow_with_the_number(self, tmp_path: Path) -> None:
        import tracemalloc

        def source(size: int) -> Iterator[Any]:
            for _ in range(size // 1000):
                yield np.ones((1000, 2)), np.ones((1000, 1))

        peaks = []
        for size in (4000, 10000):
            tracemalloc.start()
            iv.solve_ensemble(compiled, (0, 0.01), source(size), chunk=1000, store=tmp_path / f"{size}")
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        part = 128 * 1000  # a part's rows; of the six more, how many are written at a time depends on the machine
        assert peaks[1] < peaks[0] + 4 * part


def test_without_zarr_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ModuleNotFoundError, match=r"invariode\[cluster\]"):
        solve("native", store=tmp_path / "out.zarr")


def test_progress_of_a_resumed_store_ends_at_the_whole(tmp_path, monkeypatch):
    """Parts that earlier calls have solved count; and what the store holds can be written as netCDF."""
    pytest.importorskip("zarr")
    monkeypatch.setattr("invariode._base.progress.CALLS", 0.0)  # after each part
    options = {"store": tmp_path / "runs.zarr", "chunk": 4, "workers": 1, "seed": 1}
    y0 = np.arange(1.0, 21.0)[:, None]
    stopped = []

    def stop(done, size):
        if done >= 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        iv.solve_ensemble(lambda t, y: -y, (0, 1), y0, progress=stop, **options)
    store = iv.solve_ensemble(
        lambda t, y: -y, (0, 1), y0, progress=lambda *done: stopped.append(done), resume=True, **options
    )
    assert stopped[-1] == (20, 20)
    assert stopped[0][0] > 8
    assert all(not isinstance(one, dict) and one is not None for one in store.to_xarray().attrs.values())
