"""SciPy's own tests of `solve_ivp` and its classes, of `odeint` and of `ode`, with ours in their place."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterator
from operator import attrgetter
from typing import Any

import pytest

import invariode as iv
import invariode.scipy as plugin

theirs = pytest.importorskip("scipy.integrate._ivp.tests.test_ivp", reason="SciPy was installed without its tests")
older = pytest.importorskip("scipy.integrate.tests.test_integrate", reason="SciPy was installed without its tests")

#: What does not hold here. docs/scipy.md has the differences, here in their order.
DIFFER = {
    "test_integration": "radau evaluates f 41 times where SciPy allows 39",
    "test_integration_complex": "DOP853 evaluates f 46 times where SciPy allows 34: its first step is at most a tenth",
    "test_integration_const_jac": "radau needs 21 factorisations where SciPy allows 14",
    "test_events": "at one event y is off by 1.1 times the tolerance that the test allows; shapes agree",
    "test_t_eval_early_event": "empty t and y are arrays, not lists",
    "test_max_step": "no step is below 16 units of roundoff of t: max_step = 1e-20 is not an error",
    "test_first_step": "BDF is ode15s, whose steps are longer: an error of 5.3 in units of the tolerances, not below 5",
    "test_classes": "the class LSODA evaluates f when it is made",
}
#: Of its own parts, which are not ours.
OTHERS = ("test_OdeSolution", "test_inital_maxstep", "test_ConstantDenseOutput", "test_num_jac", "test_num_jac_sparse")
CLASSES = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")


def cases() -> Iterator[Any]:
    """Each test with each of its parameters."""
    for name, test in vars(theirs).items():
        if not (name.startswith("test_") and inspect.isfunction(test)) or name in DIFFER or name in OTHERS:
            continue
        marks = [mark.args for mark in getattr(test, "pytestmark", []) if mark.name == "parametrize"]
        for values in itertools.product(*(values for _, values in marks)):
            arguments = dict(zip((argument for argument, _ in marks), values, strict=True))
            yield pytest.param(test, arguments, id="-".join([name, *map(str, values)]))


@pytest.mark.parametrize(("test", "arguments"), [*cases()])
@pytest.mark.filterwarnings("ignore:option 'jac' has no effect", "ignore::invariode.DiscontinuityWarning")
def test_that_hold(test, arguments, monkeypatch):
    monkeypatch.setattr(theirs, "solve_ivp", iv.solve_ivp)
    for name in CLASSES:
        monkeypatch.setattr(theirs, name, getattr(plugin, name))
    if "num_parallel_threads" in inspect.signature(test).parameters:
        arguments = {**arguments, "num_parallel_threads": 1}
    test(**arguments)


#: What does not hold of `odeint`; of `ode` and `complex_ode` everything does.
OLDER_DIFFER = {
    "TestOde.test_concurrent_fail": "in versions of SciPy that cannot, two objects are not used side by side",
    "TestOdeint.test_odeint": "bands are given as a Jacobian without ml and mu, and their shape is checked",
    "test_odeint_errors": "f that returns a string is a TypeError",
    "test_odeint_bad_shapes": "wrong shapes are a ValueError",
}


def older_cases() -> Iterator[Any]:
    """Each test function, and each method of a test class."""
    for name, one in vars(older).items():
        if name.startswith("test_") and name not in OLDER_DIFFER:
            yield pytest.param(lambda one=one: one, id=name)
        elif name.startswith("Test") and inspect.isclass(one):
            tests = (f"{name}.{test}" for test in dir(one) if test.startswith("test_"))
            for test in (test for test in tests if test not in OLDER_DIFFER):
                yield pytest.param(lambda one=one, test=test: getattr(one(), test.partition(".")[2]), id=test)


@pytest.mark.parametrize("case", [*older_cases()])
def test_of_older_functions(case, monkeypatch):
    for name in ("odeint", "ode", "complex_ode"):
        monkeypatch.setattr(older, name, getattr(iv, name))
    monkeypatch.setattr(older.TestOde, "ode_class", iv.ode)
    monkeypatch.setattr(older.TestComplexOde, "ode_class", iv.complex_ode)
    test = case()
    threads = {"num_parallel_threads": 1} if "num_parallel_threads" in inspect.signature(test).parameters else {}
    test(**threads)


def test_that_do_not_hold_are_there():
    assert [name for name in (*DIFFER, *OTHERS) if not hasattr(theirs, name)] == []
    for name in OLDER_DIFFER:
        assert attrgetter(name)(older)
