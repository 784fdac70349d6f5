"""Solutions as data: what xarray, pandas and files get is what the solution has, and comes back to the last bit."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import threading
import zipfile

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import invariode as iv
from cases import FAMILIES, METHODS, dealt, explicit_and_implicit
from problems import PROBLEMS, blow_up
from test_jumps import ball, bounce, energy, floor

KEPLER = PROBLEMS["Kepler"]


def kepler_problem(**about):
    about = dict(name="Kepler", labels=["x", "z", "u", "v"]) | about
    named = iv.Invariants(KEPLER.g, KEPLER.jac, names=["energy", "momentum"])
    return iv.Problem(KEPLER.fun, (0, 10), KEPLER.y0, invariants=named, **about)


def apsis(t, y):
    return y[0] * y[2] + y[1] * y[3]


def never(t, y):
    return 1.0


def wave(t, y):
    return [1j * y[0] + 0.1 * y[1], -0.1 * y[0]]


def norm(t, y):
    return abs(y[0]) ** 2 + abs(y[1]) ** 2


def norm_jacobian(t, y):
    return [2 * y]


def bouncing(method, **options):
    hit = iv.Event(floor, direction=-1, terminal=6, action=bounce)
    return iv.solve_ivp(ball, (0, 100), [1.0, 0.0], method, events=hit, invariants=energy, **options)


def complex_wave(method, **options):
    spans = dict(t_span=(0, -7), y0=[1, 1j])  # backwards too
    held = iv.Invariants(norm, norm_jacobian)
    return iv.solve_ivp(wave, spans["t_span"], spans["y0"], method, invariants=held, **options)


#: Every kind of solution, by name: (method) -> Solution, invariants.
RUNS = {
    "plain": (lambda method, **o: KEPLER.solve(method, False, **o), None),
    "constraints": (lambda method, **o: PROBLEMS["pendulum"].solve(method, **o), PROBLEMS["pendulum"].invariants()),
    "vector tolerances": (
        lambda method, **o: KEPLER.solve(method, rtol=[1e-3, 1e-4, 1e-3, 1e-5], atol=[1e-6, 1e-7, 1e-8, 1e-6], **o),
        KEPLER.invariants(),
    ),
    "jumps": (bouncing, energy),
    "complex, backwards": (complex_wave, iv.Invariants(norm, norm_jacobian)),
    "failed": (lambda method, **o: iv.solve_ivp(blow_up, (0, 2), [1.0], method, **o), None),
    "nothing": (lambda method, **o: iv.solve_ivp(lambda t, y: [], (0, 1), [], method, **o), None),
    "no time": (lambda method, **o: iv.solve_ivp(lambda t, y: -y, (1, 1), [1.0], method, **o), None),
}


@pytest.fixture(params=list(RUNS))
def run(request):
    return RUNS[request.param]


def times(sol, count=301):
    """Inside and a little outside the interval."""
    margin = 0.1 * (sol.t_max - sol.t_min)
    return np.linspace(sol.t_min - margin, sol.t_max + margin, count)


def assert_same(a, b):
    """All that is public and not a function, to the last bit; types too."""
    assert list(a) == list(b)
    for name in ("t", "y"):
        assert a[name].dtype == b[name].dtype
        np.testing.assert_array_equal(a[name], b[name])
    for name in ("t_events", "y_events"):
        assert (a[name] is None) == (b[name] is None)
        for one, other in zip(a[name] or (), b[name] or (), strict=True):
            assert (one.dtype, one.shape) == (other.dtype, other.shape)
            np.testing.assert_array_equal(one, other)
    for name in ("nfev", "njev", "nlu", "status", "message", "success"):
        assert type(a[name]) is type(b[name])
        assert a[name] == b[name]
    assert dict(a.stats) == dict(b.stats)
    assert (a.steps is None) == (b.steps is None)
    for name in a.steps or ():
        np.testing.assert_array_equal(a.steps[name], b.steps[name])
    np.testing.assert_array_equal(a.residual, b.residual)
    for name, value in a.drift().items():
        np.testing.assert_array_equal(value, b.drift()[name])
    assert repr(a.drift()) == repr(b.drift())
    assert repr(a) == repr(b)


@dealt(method=METHODS, run=RUNS, interpolation=["corrected", "raw"])
def test_a_file_gives_back_every_value_to_the_last_bit(method, run, interpolation, tmp_path):
    solve, _ = run
    sol = solve(method, dense_output=True, interpolation=interpolation)
    sol.save(tmp_path / "solution.npz")
    again = iv.load(tmp_path / "solution.npz")
    assert_same(sol, again)
    np.testing.assert_array_equal(sol.sol.ts, again.sol.ts)
    np.testing.assert_array_equal(sol.sol(times(sol.sol)), again.sol(times(sol.sol)))
    xr.testing.assert_identical(again.to_xarray(), sol.to_xarray())
    pd.testing.assert_frame_equal(again.to_dataframe(), sol.to_dataframe(), check_exact=True)
    assert again.to_dataframe().attrs == sol.to_dataframe().attrs
    again.save(tmp_path / "again.npz")
    with np.load(tmp_path / "solution.npz") as first, np.load(tmp_path / "again.npz") as second:
        assert set(first) == set(second)
        for name in first:
            np.testing.assert_array_equal(first[name], second[name])


@dealt(method=FAMILIES, run=RUNS)
def test_with_its_invariants_a_projected_solution_is_the_same_function(method, run, tmp_path):
    solve, invariants = run
    sol = solve(method, dense_output=True)
    sol.save(tmp_path / "solution.npz")
    again = iv.load(tmp_path / "solution.npz", invariants=invariants)
    assert_same(sol, again)
    np.testing.assert_array_equal(sol.sol(times(sol.sol)), again.sol(times(sol.sol)))
    if invariants is not None:
        imposed, expected = again.impose(), sol.impose()
        assert_same(imposed, expected)
        np.testing.assert_array_equal(imposed.sol(times(sol.sol)), expected.sol(times(sol.sol)))
        imposed.save(tmp_path / "imposed.npz")
        back = iv.load(tmp_path / "imposed.npz", invariants=invariants)
        np.testing.assert_array_equal(back.sol(times(sol.sol)), expected.sol(times(sol.sol)))


@explicit_and_implicit
def test_without_them_it_is_the_corrected_one_and_says_so_once(method, tmp_path):
    sol = KEPLER.solve(method, dense_output=True)
    corrected = KEPLER.solve(method, dense_output=True, interpolation="corrected")
    sol.save(tmp_path / "solution.npz")
    again = iv.load(tmp_path / "solution.npz")
    np.testing.assert_array_equal(again.sol(sol.t), sol.y)  # at the ends of the steps there is nothing to project
    with pytest.warns(UserWarning, match="not projected onto the invariants: their functions are not in the file"):
        values = again.sol(times(sol.sol))
    np.testing.assert_array_equal(values, corrected.sol(times(sol.sol)))
    again.sol(times(sol.sol))


@explicit_and_implicit
def test_only_the_final_state(method, tmp_path):
    sol = bouncing(method, keep="end")
    sol.save(tmp_path / "end.npz")
    again = iv.load(tmp_path / "end.npz")
    assert_same(sol, again)
    assert again.sol is None
    assert again.steps is None
    with pytest.raises(ValueError, match="did not keep the corrections of its steps: solve with keep"):
        again.correction  # noqa: B018  # the property raises


def test_a_mass_matrix_with_algebraic_equations(tmp_path):
    """The invariants between the steps are the user's, at the steps the algebraic equations are among them."""

    def fun(t, y):
        return [y[1], -y[0], y[0] + y[1] - y[2]]

    def radius(t, y):
        return y[0] ** 2 + y[1] ** 2

    mass = np.diag([1, 1, 0])
    sol = iv.ode15s(fun, (0, 5), [1, 0, 1], mass=mass, invariants=radius, dense_output=True)
    sol.save(tmp_path / "dae.npz")
    again = iv.load(tmp_path / "dae.npz", invariants=radius)
    assert_same(sol, again)
    np.testing.assert_array_equal(sol.sol(times(sol.sol)), again.sol(times(sol.sol)))


def test_arguments_of_the_invariants_are_given_again(tmp_path):
    def oscillator(t, y, k):
        return [y[1], -k * y[0]]

    def energy(t, y, k):
        return y[1] ** 2 + k * y[0] ** 2

    sol = iv.solve_ivp(oscillator, (0, 5), [1, 0], args=(4.0,), invariants=energy, dense_output=True)
    sol.save(tmp_path / "solution.npz")
    again = iv.load(tmp_path / "solution.npz", invariants=energy, args=(4.0,))
    np.testing.assert_array_equal(sol.sol(times(sol.sol)), again.sol(times(sol.sol)))
    with pytest.raises(ValueError, match=r"the invariant energy is not that of the run in .*: at t = 0 the sol"):
        iv.load(tmp_path / "solution.npz", invariants=energy, args=(5.0,))
    with pytest.raises(ValueError, match=r"named work, those of the run in .* energy"):
        iv.load(tmp_path / "solution.npz", invariants=iv.Invariants(energy, names="work"), args=(4.0,))
    with pytest.raises(ValueError, match="no invariants are given"):
        iv.load(tmp_path / "solution.npz", args=(4.0,))


def test_invariants_that_the_run_did_not_have_are_refused(tmp_path):
    KEPLER.solve("ode45", False).save(tmp_path / "plain.npz")
    with pytest.raises(ValueError, match=r"invariants are given, but the run in .* had none"):
        iv.load(tmp_path / "plain.npz", invariants=KEPLER.invariants())


@explicit_and_implicit
def test_impose_of_a_loaded_solution_says_what_it_lacks(method, tmp_path):
    sol = KEPLER.solve(method)
    sol.save(tmp_path / "solution.npz")
    again = iv.load(tmp_path / "solution.npz")
    with pytest.raises(ValueError, match=r"are not in the file: .*invariode\.impose\(invariants, solution\)"):
        again.impose()
    np.testing.assert_array_equal(iv.impose(KEPLER.invariants(), again).y, iv.impose(KEPLER.invariants(), sol).y)


def test_the_file_has_exactly_the_name_given_and_replaces_one_that_is_there(tmp_path):
    for name in ("a.npz", "b", "c.dat"):
        (tmp_path / name).write_text("old")
        KEPLER.solve("ode45").save(str(tmp_path / name))
        assert iv.load(str(tmp_path / name)).success
    assert sorted(os.listdir(tmp_path)) == ["a.npz", "b", "c.dat"]


def test_a_file_that_cannot_be_written_leaves_nothing_and_the_old_one(tmp_path, monkeypatch):
    sol = KEPLER.solve("ode45")
    with pytest.raises(FileNotFoundError):
        sol.save(tmp_path / "missing" / "a.npz")
    sol.save(tmp_path / "a.npz")

    def full(file, **arrays):
        file.write(b"PK")
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="no space left"):
        sol.save(tmp_path / "a.npz")
    assert os.listdir(tmp_path) == ["a.npz"]
    assert_same(iv.load(tmp_path / "a.npz"), sol)


@pytest.mark.skipif(os.name == "nt", reason="modes, links and pipes of POSIX")
class TestTargets:
    """A target that exists is written to as it is: its mode, what a link points at, a pipe, a device."""

    @pytest.mark.parametrize("mode", [0o600, 0o640, 0o777])
    def test_a_file_keeps_its_mode(self, tmp_path, mode):
        (tmp_path / "a.npz").write_text("old")
        (tmp_path / "a.npz").chmod(mode)
        KEPLER.solve("ode45").save(tmp_path / "a.npz")
        assert stat.S_IMODE((tmp_path / "a.npz").stat().st_mode) == mode
        assert iv.load(tmp_path / "a.npz").success

    def test_a_new_file_has_the_mode_of_new_files(self, tmp_path):
        KEPLER.solve("ode45").save(tmp_path / "a.npz")
        (tmp_path / "plain").touch()
        assert (tmp_path / "a.npz").stat().st_mode == (tmp_path / "plain").stat().st_mode

    @pytest.mark.parametrize("there", [True, False])
    def test_a_link_stays_and_its_target_is_written(self, tmp_path, there):
        (tmp_path / "folder").mkdir()
        target = tmp_path / "folder" / "a.npz"
        if there:
            target.write_text("old")
        (tmp_path / "link.npz").symlink_to(target)
        KEPLER.solve("ode45").save(tmp_path / "link.npz")
        assert (tmp_path / "link.npz").is_symlink()
        assert iv.load(target).success

    def test_a_pipe_is_written_to(self, tmp_path):
        os.mkfifo(tmp_path / "pipe")
        sol = KEPLER.solve("ode45")
        writer = threading.Thread(target=sol.save, args=[tmp_path / "pipe"])
        writer.start()
        (tmp_path / "a.npz").write_bytes((tmp_path / "pipe").read_bytes())
        writer.join()
        assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
        assert_same(iv.load(tmp_path / "a.npz"), sol)

    def test_a_device_stays_a_device(self, tmp_path):
        (tmp_path / "null").symlink_to(os.devnull)
        KEPLER.solve("ode45").save(tmp_path / "null")
        assert stat.S_ISCHR(os.stat(os.devnull).st_mode)

    def test_a_directory_is_no_file(self, tmp_path):
        with pytest.raises(IsADirectoryError):
            KEPLER.solve("ode45").save(tmp_path)

    @pytest.mark.skipif(not hasattr(os, "O_TMPFILE"), reason="files without names are Linux's")
    def test_a_process_that_is_killed_while_it_saves_leaves_nothing(self, tmp_path):
        code = (
            "import os, signal, sys, numpy as np, invariode as iv\n"
            "def killed(file, **arrays):\n"
            "    file.write(b'PK'); file.flush(); os.kill(os.getpid(), signal.SIGKILL)\n"
            "np.savez = killed\n"
            "iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]).save(sys.argv[1])\n"
        )
        done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.npz")])
        assert done.returncode == -signal.SIGKILL
        assert os.listdir(tmp_path) == []

    def test_where_no_file_can_be_without_a_name_one_with_a_name_is_put_in_place(self, tmp_path, monkeypatch):
        monkeypatch.delattr(os, "O_TMPFILE", raising=False)
        (tmp_path / "a.npz").write_text("old")
        KEPLER.solve("ode45").save(tmp_path / "a.npz")
        assert os.listdir(tmp_path) == ["a.npz"]
        assert iv.load(tmp_path / "a.npz").success


def npy(header: str, contents: bytes = b"", version: tuple[int, int] = (1, 0)) -> bytes:
    """An array in NumPy's format with any header."""
    text = header.encode("latin1")
    return b"\x93NUMPY" + bytes(version) + len(text).to_bytes(2 if version == (1, 0) else 4, "little") + text + contents


def described(shape: object, dtype: object = "<f8") -> str:
    return repr({"descr": dtype, "fortran_order": False, "shape": shape}) + "\n"


HOSTILE = {
    "no array": b"",
    "bytes": b"text",
    "tokens": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (3,)"),
    "unclosed text": npy('"' * 3),
    "nested": npy("(" * 5000 + ")" * 5000),
    "signs": npy("-" * 9000 + "1"),
    "operations": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (3**9**9,)}"),
    "long header": npy(" " * 60000),
    "no dict": npy("[]\n"),
    "version 9": npy(described((1,)), bytes(8), (9, 0)),
    "huge": npy(described((10**15,)), bytes(8)),
    "huger": npy(described((2**64, 2**64)), bytes(8)),
    "negative": npy(described((-1, -1)), bytes(8)),
    "too long": npy(described((1,)), bytes(16)),
    "objects": npy(described((1,), "|O"), bytes(8)),
    "structured": npy(described((1,), [("a", "<f8")]), bytes(8)),
    "dates": npy(described((1,), "<M8[s]"), bytes(8)),
    "text": npy(described((2,), "<U1"), bytes(8)),
    "complex": npy(described((1,), "<c16"), bytes(16)),
    "nothing": npy(described((0,))),
}


@dealt(name=HOSTILE, member=["t.npy", "y.npy", "dense.data.npy", "invariants.value.npy", "t", "about.npy"])
def test_a_hostile_member_is_damage_whatever_numpy_thinks_of_it(tmp_path, name, member):
    KEPLER.solve("ode45", dense_output=True).save(tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "a.npz") as old, zipfile.ZipFile(tmp_path / "b.npz", "w") as new:
        for info in old.infolist():
            if info.filename not in (member, f"{member}.npy"):
                new.writestr(info, old.read(info))
        new.writestr(member, HOSTILE[name])
    with pytest.raises(ValueError, match=r"the file .*b\.npz (is damaged|was not written by Solution\.save)"):
        iv.load(tmp_path / "b.npz")


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000, '{"format": ' * 20_000, "\\ud800", "nan"])
def test_a_hostile_description_is_not_one(tmp_path, text):
    np.savez(tmp_path / "a.npz", about=np.array(text))
    with pytest.raises(ValueError, match=r"the file .*a\.npz was not written by Solution\.save"):
        iv.load(tmp_path / "a.npz")


@pytest.mark.parametrize("changes", [
    {"imposed": None}, {"dense": {"interpolation": 3}}, {"dense": 7}, {"forward": "x"}, {"status": []},
    {"stats": None}, {"events": "x"}, {"events": 10**9}, {"labels": 3}, {"event_names": None}, {"invariants": 5},
], ids=str)  # fmt: skip
def test_a_hostile_description_of_a_solution_is_damage_or_does_no_harm(tmp_path, changes):
    KEPLER.solve("ode45", dense_output=True).save(tmp_path / "a.npz")
    changed(tmp_path / "a.npz", tmp_path / "b.npz", about=changes)
    try:
        sol = iv.load(tmp_path / "b.npz")
    except ValueError as refused:
        assert "is damaged" in str(refused)
    else:
        sol.sol(sol.t)


def test_a_compressed_file_larger_than_it_says_is_damage(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.npy", npy(described((10**6,)), bytes(8 * 10**6)))
    with pytest.raises(ValueError, match="is damaged: its header declares arrays larger than the file"):
        iv.load(tmp_path / "bomb.npz")


def test_other_files_are_refused_by_name(tmp_path):
    path = tmp_path / "other.npz"
    refused = r"the file .*other\.npz was not written by Solution\.save"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=refused):
        iv.load(path)
    path.write_text("t,y\n0,1\n")
    with pytest.raises(ValueError, match=refused):
        iv.load(path)
    for about in ({}, {"about": np.array("{")}, {"about": np.array("[]")}, {"about": np.array('{"format": "x"}')}):
        np.savez(path, t=np.zeros(3), **about)
        with pytest.raises(ValueError, match=refused):
            iv.load(path)
    with pytest.raises(FileNotFoundError):
        iv.load(tmp_path / "none.npz")


def test_nothing_is_unpickled(tmp_path):
    np.savez(tmp_path / "bad.npz", about=np.array([print], dtype=object))
    with pytest.raises(ValueError, match=r"the file .*bad\.npz is damaged"):
        iv.load(tmp_path / "bad.npz")


def test_a_damaged_file_is_refused_wherever_the_damage_is(tmp_path):
    path = tmp_path / "a.npz"
    KEPLER.solve("ode45", dense_output=True).save(path)
    whole = path.read_bytes()
    for size in range(2, len(whole), len(whole) // 50):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"the file .*a\.npz is incomplete"):
            iv.load(path)
    rng = np.random.default_rng(1)
    sol = KEPLER.solve("ode45", dense_output=True)
    for at in rng.integers(0, len(whole), 200):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        try:
            again = iv.load(path)
        except ValueError as refused:
            assert "a.npz" in str(refused)
        else:  # a byte that nobody reads, as a date in the archive
            assert_same(again, sol)


def changed(path, to, **changes):
    """The file with other arrays, as nobody but another program writes it."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive}
    about = json.loads(str(arrays["about"]))
    about.update(changes.pop("about", {}))
    arrays.update(changes, about=np.array(json.dumps(about)))
    np.savez(to, **{name: array for name, array in arrays.items() if array is not None})


@pytest.mark.parametrize(("number", "remedy"), [(99, "upgrade it"), (4, "use the invariode that wrote it, or solve")])
def test_another_version_is_refused_by_kind_number_and_writer(tmp_path, number, remedy):
    KEPLER.solve("ode45").save(tmp_path / "a.npz")
    changed(tmp_path / "a.npz", tmp_path / "b.npz", about={"version": number, "invariode": "9.1"})
    refused = rf"b\.npz is of kind 'solution' in version {number} of the format, written by invariode 9\.1; .* {remedy}"
    with pytest.raises(ValueError, match=refused):
        iv.load(tmp_path / "b.npz")


@explicit_and_implicit
def test_continuous_output_that_could_not_be_evaluated_is_refused(method, tmp_path):
    """Nothing that a file says makes the core read where it must not."""
    bouncing(method, dense_output=True).save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as archive:
        parts = {name: archive[name] for name in archive if name.startswith("dense.")}
        plain, jumps = json.loads(str(archive["about"]))["dense"], len(archive["jumps.t"])
    offset, end, knots = parts["dense.offset"], parts["dense.end"], parts["dense.t"]
    first = end.copy()
    first[0] = knots[0]
    jump = end.copy()
    jump[3] = knots[3]
    wrong = [
        {"dense.t": knots[:-1]},
        {"dense.y": parts["dense.y"][:, :1]},
        {"dense.end": end[1:]},
        {"dense.end": first},
        {"dense.end": jump},
        {"dense.offset": offset + 1},
        {"dense.offset": offset[::-1].copy()},
        {"dense.offset": offset * 1000},
        {"dense.data": parts["dense.data"][:-1]},
        {"dense.data": np.zeros(0)},
        {"dense.data": None},
        {"dense.threshold": np.zeros(5)},
        {"dense.scale": np.zeros(5)},
        *({"about": {"dense": plain | {"m": m}}} for m in (0, 2, 2**62, -1)),
        {"about": {"dense": plain | {"interpolation": "cubic"}}},
        {"about": {"dense": plain | {"extension": "Taylor"}}},
        {"dense.threshold": parts["dense.threshold"] * np.nan},
        *({"about": {"dense": plain | {"rtol": rtol}}} for rtol in ("x", 0.0, -1.0, np.nan)),
        {"about": {"invariants": ["a", "b"]}},
        {"about": {"stats": {}}},
        {"invariants.value": np.zeros(0)},
        {"invariants.value": np.zeros(2)},
        {"invariants.value": np.array(1.0)},
        {"jumps.value": np.zeros((len(knots), 0))},
        {"jumps.value": np.zeros((jumps, 2))},
        {"dense.y": parts["dense.y"][:, 0]},
        {"t": np.zeros(3)},
        {"y": None},
    ]
    for changes in wrong:
        changed(tmp_path / "a.npz", tmp_path / "b.npz", **changes)
        with pytest.raises(ValueError, match=r"the file .*b\.npz is damaged"):
            iv.load(tmp_path / "b.npz")


def test_files_need_numpy_only(tmp_path):
    """Neither xarray nor pandas is imported by the package or for a file."""
    code = (
        "import sys, invariode as iv\n"
        "sol = iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], dense_output=True)\n"
        f"sol.save({str(tmp_path / 'a.npz')!r}); iv.load({str(tmp_path / 'a.npz')!r})\n"
        "assert not {'xarray', 'pandas', 'pyarrow', 'h5netcdf'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("module", ["xarray", "pandas"])
def test_what_is_missing_says_how_it_is_had(module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    sol = KEPLER.solve("ode45")
    with pytest.raises(ModuleNotFoundError, match=rf'{module}: pip install "invariode\[data\]"'):
        sol.to_xarray() if module == "xarray" else sol.to_dataframe()


@explicit_and_implicit
def test_data_set_has_names_coordinates_and_attributes(method):
    sol = kepler_problem(events=[apsis, never]).solve(method)
    ds = sol.to_xarray()
    assert ds.y.dims == ("component", "t")
    np.testing.assert_array_equal(ds.y, sol.y)
    np.testing.assert_array_equal(ds.y.sel(component="u"), sol.y[2])
    np.testing.assert_array_equal(ds.t, sol.t)
    assert list(ds.component.values) == ["x", "z", "u", "v"]
    np.testing.assert_array_equal(ds.residual.sel(invariant="momentum"), sol.residual[1])
    np.testing.assert_array_equal(ds.value, sol.drift().value)
    np.testing.assert_array_equal(ds.t_events_apsis, sol.t_events[0])
    np.testing.assert_array_equal(ds.y_events_apsis, sol.y_events[0])
    assert ds.y_events_apsis.dims == ("event_apsis", "component")
    assert ds.sizes["event_never"] == 0
    for name in ("h", "order", "error", "correction"):
        np.testing.assert_array_equal(ds[name], sol.steps[name])
        assert ds[name].dims == ("t_step",)
    np.testing.assert_array_equal(ds.t_step, sol.steps.t)
    assert ds.attrs["name"] == "Kepler"
    assert (ds.attrs["rtol"], ds.attrs["atol"]) == (1e-3, 1e-6)
    for name in ("message", "status", "success"):
        assert ds.attrs[name] == sol[name]
    for name, value in sol.stats.items():
        assert ds.attrs.get(name) == (None if value == () else value)  # empty values are left out
    assert ds.attrs["invariode_version"] == iv.__version__
    asked = iv.Problem(lambda t, y, a, b: [-a * b * y[0]], (1, 2), [1.0], args=(0.5, 2)).solve("auto").to_xarray().attrs
    assert (asked["method"], asked["args"]) == ("auto", [0.5, 2.0])


def test_data_set_of_a_plain_run_has_no_more_than_it_knows():
    ds = iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0, 2.0], keep="end").to_xarray()
    assert set(ds.variables) == {"y", "t", "component"}
    assert list(ds.component.values) == ["y0", "y1"]
    assert ds.attrs["name"] == "problem"
    assert "derivatives" not in ds.attrs


def test_events_of_the_same_name_are_numbered():
    events = [lambda t, y: y[0] - 0.5, lambda t, y: y[0] - 0.4]
    ds = iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], events=events).to_xarray()
    assert {"t_events_event_0", "t_events_event_1"} <= set(ds.coords)


@dealt(method=FAMILIES, run=RUNS)
def test_netcdf_round_trip(method, run, tmp_path):
    solve, _ = run
    ds = solve(method).to_xarray()
    ds.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as again:
        xr.testing.assert_identical(again.load(), ds)
        assert again.y.dtype == ds.y.dtype


@explicit_and_implicit
def test_netcdf_round_trip_of_labels_events_and_steps(method, tmp_path):
    labels = ["ξ", "z/R", "u 1", ""]
    ds = kepler_problem(events=[apsis, never], labels=labels, name="").solve(method).to_xarray()
    ds.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as again:
        xr.testing.assert_identical(again.load(), ds)


@explicit_and_implicit
def test_table_has_components_and_residuals(method):
    sol = kepler_problem().solve(method)
    table = sol.to_dataframe()
    assert table.index.name == "t"
    assert list(table) == ["x", "z", "u", "v", "residual of energy", "residual of momentum"]
    np.testing.assert_array_equal(table.index, sol.t)
    np.testing.assert_array_equal(table[["x", "z", "u", "v"]], sol.y.T)
    np.testing.assert_array_equal(table["residual of momentum"], sol.residual[1])
    assert table.attrs["success"] is True
    assert table.attrs["steps"] == sol.stats.steps
    assert table.attrs["invariants"] == dict(zip(["energy", "momentum"], sol.drift().value, strict=True))


@explicit_and_implicit
def test_table_of_a_complex_solution_has_two_columns_per_component(method):
    sol = complex_wave(method)
    table = sol.to_dataframe()
    assert list(table) == ["y0.real", "y0.imag", "y1.real", "y1.imag", "residual of norm"]
    np.testing.assert_array_equal(table["y1.real"] + 1j * table["y1.imag"], sol.y[1])


@dealt(method=FAMILIES, run=RUNS)
def test_csv_and_parquet_round_trip(method, run, tmp_path):
    solve, _ = run
    table = solve(method).to_dataframe()
    table.to_csv(tmp_path / "a.csv")
    again = pd.read_csv(tmp_path / "a.csv", dtype=str).astype(float).set_index("t")  # pandas would round
    pd.testing.assert_frame_equal(again, table, check_exact=True, check_column_type=False)
    table.to_parquet(tmp_path / "a.parquet")
    again = pd.read_parquet(tmp_path / "a.parquet")
    pd.testing.assert_frame_equal(again, table, check_exact=True, check_column_type=False)
    assert again.attrs == table.attrs
