"""Machine code that one process keeps is loaded by the next, and by nobody whom others could have fooled."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import invariode as iv

pytest.importorskip("llvmlite")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="nothing is kept there")

from invariode._functions.graph import objects, stored_code  # noqa: E402 -- needs llvmlite

SCRIPT = """
import invariode as iv
from invariode._functions.graph import objects
written = []
if {counting}:
    from invariode._functions.graph import machine
    emit = machine.compiled
    machine.compiled = lambda *a, **k: (written.append(1), emit(*a, **k))[1]
sol = iv.solve_ivp(iv.compile(lambda t, y, k: [-k * y[0] * y[1], y[0]]), (0, 1), [1.0, 0.5], "ode15s", args=(2.0,))
print(sol.y[:, -1].tobytes().hex(), len(written))
"""


def in_another_process(folder, counting=True):
    command = [sys.executable, "-c", SCRIPT.format(counting=counting)]
    environment = {**os.environ, "INVARIODE_CACHE": str(folder)}
    found = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout.split()
    return found[0], int(found[1])


@pytest.fixture
def cache(tmp_path):
    before = iv.code_cache()
    folder = tmp_path / "cache"
    yield iv.code_cache(folder)
    iv.code_cache(False if before is None else before)


def test_a_second_process_compiles_nothing_and_has_the_same_bits(tmp_path):
    folder = tmp_path / "cache"
    first, written = in_another_process(folder)
    assert written > 0
    assert in_another_process(folder) == (first, 0)
    assert in_another_process("off")[0] == first
    assert folder.stat().st_mode & 0o777 == 0o700
    assert all(one.stat().st_mode & 0o777 == 0o600 for one in folder.iterdir())
    for one in folder.iterdir():  # damage is told, and mended
        code = bytearray(one.read_bytes())
        code[-20] ^= 1
        one.write_bytes(code)
    assert in_another_process(folder) == (first, written)
    assert in_another_process(folder) == (first, 0)


def test_code_is_read_only_where_nobody_else_may_write(cache):
    name = stored_code.name_of(b"digest", "processor")
    assert name != stored_code.name_of(b"digest", "another processor")
    assert stored_code.read(name) is None
    stored_code.keep(name, b"code")
    assert stored_code.read(name) == b"code"
    assert stored_code.read(stored_code.name_of(b"another digest", "processor")) is None
    file = cache / name
    for path, mode in ((file, 0o660), (file, 0o602), (cache, 0o770), (cache, 0o707)):
        before = path.stat().st_mode & 0o777
        path.chmod(mode)
        assert stored_code.read(name) is None
        path.chmod(before)
        assert stored_code.read(name) == b"code"
    other = stored_code.name_of(b"a link", "processor")
    (cache / other).symlink_to(file)
    assert stored_code.read(other) is None
    (cache / other).unlink()
    file.rename(cache / other)  # the code of another graph under this name
    assert stored_code.read(other) is None


def test_a_linked_folder_one_of_others_and_a_full_disk_are_no_errors(cache, tmp_path, monkeypatch):
    linked = tmp_path / "linked"
    (tmp_path / "real").mkdir(mode=0o700)
    linked.symlink_to(tmp_path / "real")
    for folder in (linked, tmp_path / "file"):
        (tmp_path / "file").write_text("")
        iv.code_cache(folder)
        stored_code.keep("name", b"code")
        assert stored_code.read("name") is None
    assert not list((tmp_path / "real").iterdir())
    iv.code_cache(tmp_path / "of others")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    stored_code.keep("name", b"code")
    assert not list((tmp_path / "of others").iterdir())


def test_what_was_not_used_for_longest_goes(cache, monkeypatch):
    monkeypatch.setattr(stored_code, "_MOST_FILES", 3)
    for i, name in enumerate("abc"):
        stored_code.keep(name, b"code")
        os.utime(cache / name, (i, i))
    assert stored_code.read("a") == b"code"  # now it is the one that was used last
    stored_code.keep("d", b"code")
    assert sorted(one.name for one in cache.iterdir()) == ["a", "c", "d"]


def test_the_environment_and_the_function_switch_it_off(monkeypatch, tmp_path):
    before = iv.code_cache()
    for given, folder in (("off", None), ("0", None), (str(tmp_path), tmp_path), ("", stored_code._default())):
        monkeypatch.setenv("INVARIODE_CACHE", given)
        assert stored_code._by_environment() == folder
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if sys.platform != "darwin":
        assert stored_code._default() == tmp_path / "invariode"
    assert iv.code_cache(False) is None
    stored_code.keep("name", b"code")
    assert stored_code.read("name") is None
    with pytest.raises(TypeError, match="code_cache takes a folder, True or False, got 3"):
        iv.code_cache(3)
    iv.code_cache(False if before is None else before)
    assert objects.processor()
