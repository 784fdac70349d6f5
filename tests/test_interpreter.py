"""When the interpreter ends, and beside other interpreters: threads that still solve end with the process, silently."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PRELUDE = """
import ctypes, threading, time
import numpy as np
import invariode as iv

started = set()

def began():
    started.add(threading.get_ident())

def python(t, y):
    began()
    return -y

@ctypes.CFUNCTYPE(None, ctypes.c_double, *[ctypes.POINTER(ctypes.c_double)] * 3)
def native(t, y, out, p):
    began()
    out[0] = -y[0]

def sleeping(t, y):
    began()
    time.sleep(0.001)
    return -y

def told(t, y):
    began()

endless = dict(t_span=(0, 1e9), y0=[1.0], max_step=1e-3, keep="end")
"""

#: What a daemon thread does: which functions ask for the interpreter, and from where.
ENDLESS = {
    "python": "iv.solve_ivp(python, **endless)",
    "sleeping": "iv.solve_ivp(sleeping, **endless)",
    "ctypes": "iv.solve_ivp(native, **endless)",
    "matrix": "iv.solve_ivp(python, method='ode15s', mass=lambda t: np.eye(1), **endless)",
    "event and callback": "iv.solve_ivp(python, events=lambda t, y: y[0] + 1, callback=told, **endless)",
    "invariant": "iv.solve_ivp(lambda t, y: (began(), 0 * y)[1], invariants=lambda t, y: y[0], **endless)",
    "stepper": "scipy.integrate.solve_ivp(python, (0, 1e9), [1.0], max_step=1e-3, method=invariode.scipy.ODE45)",
}
COMPILED = {
    "one": "iv.solve_ivp(compiled, callback=None, **endless)",
    "on threads": "iv.solve_ensemble(compiled, **(endless | {'y0': np.ones((4, 1))}), workers=2)",
}


def ends_with_daemons(prelude: str, what: list[str], wait: str) -> None:
    """Python up to 3.13 ends such threads by unwinding them, which the core's callbacks must not see."""
    threads = "\n".join(f"threading.Thread(target=lambda: {one}, daemon=True).start()" for one in what)
    code = f"{PRELUDE}{prelude}{threads}\n{wait}\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_interpreter_may_end_while_daemon_threads_solve() -> None:
    wait = f"while len(started) < {len(ENDLESS)}: time.sleep(0.05)\ntime.sleep(0.3)"
    ends_with_daemons("import scipy.integrate, invariode.scipy\n", list(ENDLESS.values()), wait)


def test_the_interpreter_may_end_while_daemon_threads_solve_compiled_problems() -> None:
    pytest.importorskip("numba")
    prelude = "compiled = iv.compile(lambda t, y: -y[0])\niv.solve_ivp(compiled, (0, 1), [1.0])\n"
    ends_with_daemons(prelude, list(COMPILED.values()), "time.sleep(0.3)")


def test_another_interpreter_is_told_that_it_cannot_have_the_package() -> None:
    """The import used to wait for the main interpreter for ever."""
    name = "_xxsubinterpreters" if sys.version_info < (3, 13) else "_interpreters"
    pytest.importorskip(name)
    code = (
        f"import {name} as interpreters, sys\n"
        "one = interpreters.create('legacy') if sys.version_info >= (3, 13) else interpreters.create()\n"
        "code = '''\nimport sys, warnings\nwarnings.simplefilter(\"ignore\")\n"
        "try:\n    import invariode\nexcept ImportError as error:\n    print(error, flush=True)\n'''\n"
        "interpreters.run_string(one, code)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert "main interpreter" in done.stdout or "subinterpreter" in done.stdout, done.stderr


def test_the_source_of_the_binding_has_no_other_way_into_the_interpreter() -> None:
    """nanobind's own is declared not to throw, so that the thread could not be kept."""
    folder = Path(__file__).parent.parent / "binding"
    for file in folder.glob("*.[ch]pp"):
        assert "nb::gil_scoped" not in file.read_text(), file
