"""SciPy's classes `ode` and `complex_ode`: their calls, on our methods, with invariants. SciPy's own tests of them are
in test_scipys_own.py."""

from __future__ import annotations

import gc
import warnings
import weakref

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
from cases import METHODS, families
from problems import PROBLEMS

KEPLER = PROBLEMS["Kepler"]
TIMES = np.linspace(0, 4, 41)[1:]
#: The pairs end at the requested times; the others go beyond and interpolate.
PAIRS = [name for name, about in METHODS.items() if about.stages is not None]
GOING_ON = [name for name in METHODS if name not in PAIRS]
#: What stands for SciPy's integrators.
SCIPYS = {
    "vode": "ode113",
    "bdf": "BDF",
    "zvode": "ode113",  # with complex states
    "dopri5": "ode45",
    "dop853": "dop853",
    "lsoda": "auto",
}


class Counted:
    """A function that counts its calls."""

    def __init__(self, fun):
        self.fun, self.calls = fun, 0

    def __call__(self, t, y, *args):
        self.calls += 1
        return self.fun(t, y, *args)


def started(name, fun=KEPLER.fun, y0=tuple(KEPLER.y0), *, invariants=None, jac=None, **parameters):
    return iv.ode(fun, jac, invariants=invariants).set_integrator(name, **parameters).set_initial_value(y0)


def at_times(run, times=TIMES):
    found = []
    for t in times:
        found.append(run.integrate(t))
        assert run.successful()
        assert run.t == t
        assert run.y is found[-1]
    return np.array(found).T


@families
def test_states_at_the_requested_times_are_those_of_one_long_run(method):
    """Within a few tolerances, whether the method starts anew in each call or goes on."""
    order_two = iv.METHODS[method].order == 2
    rtol = 1e-5 if order_two else 1e-8
    y = at_times(started(method, rtol=rtol, atol=rtol))
    np.testing.assert_allclose(y, KEPLER.solution(TIMES), atol=(1e5 if order_two else 1e3) * rtol)


@families
def test_invariants_are_kept_in_every_call(method):
    """At their first values, not at those where a call begins: as well as in one run, so that nothing adds up."""
    y = at_times(started(method, invariants=KEPLER.g, rtol=1e-4))
    g = np.array([KEPLER.g(t, one) for t, one in zip(TIMES, y.T, strict=True)])
    one_run = KEPLER.solve(method, rtol=1e-4, atol=1e-12, t_eval=TIMES)
    assert np.abs(g - KEPLER.g(0, np.array(KEPLER.y0))).max() <= KEPLER.drift(one_run) + 1e-14


@pytest.mark.parametrize("method", GOING_ON)
def test_methods_that_go_on_evaluate_f_as_often_for_many_times_as_for_one(method):
    once, often = Counted(KEPLER.fun), Counted(KEPLER.fun)
    end = started(method, once, rtol=1e-6).integrate(TIMES[-1])
    y = at_times(started(method, often, rtol=1e-6))
    assert often.calls <= once.calls + iv.METHODS[method].extra
    np.testing.assert_array_equal(y[:, -1], end)


@pytest.mark.parametrize("method", PAIRS)
def test_pairs_end_at_the_requested_times(method):
    """f is never called beyond; a call is a solve from the last state, whose first step has the size that the last call
    has found, bit for bit."""
    seen = []
    run = started(method, lambda t, y: seen.append(t) or KEPLER.fun(t, y), rtol=1e-6)
    first = run.integrate(1.0)
    assert max(seen) <= 1.0
    second = run.integrate(2.5)
    options = {"rtol": 1e-6, "atol": 1e-12}
    one = iv.solve_ivp(KEPLER.fun, (0, 1), KEPLER.y0, method, **options)
    options["first_step"] = min(one._origin.next_h, 1.5)
    np.testing.assert_array_equal(first, one.y[:, -1])
    np.testing.assert_array_equal(second, iv.solve_ivp(KEPLER.fun, (1, 2.5), first, method, **options).y[:, -1])


@pytest.mark.parametrize("name", SCIPYS)
def test_scipys_names_stand_for_methods(name):
    method, fun = SCIPYS[name], lambda t, y: [y[1], -y[0]]
    about = {"method": "bdf"} if name == "bdf" else {}
    theirs = started("vode" if name == "bdf" else name, fun, [1.0, 0.5], rtol=1e-5, **about).integrate(2.0)
    y0 = np.array([1.0, 0.5], complex if name == "zvode" else float)
    ours = started(method, fun, y0, rtol=1e-5).integrate(2.0)
    assert theirs.dtype == y0.dtype
    np.testing.assert_array_equal(theirs, ours)


def test_names_are_found_as_scipy_finds_them():
    for given in ("", "VODE", "vo"):
        assert "vode" in repr(iv.ode(KEPLER.fun).set_integrator(given))
    assert "dopri5" in repr(iv.ode(KEPLER.fun).set_integrator("Dop"))
    assert "vode" in repr(iv.ode(KEPLER.fun).set_initial_value(KEPLER.y0))
    with pytest.raises(ValueError, match="No integrator name match with 'ode54'; did you mean 'ode45'"):
        iv.ode(KEPLER.fun).set_integrator("ode54")
    with pytest.raises(ValueError, match="zvode must be used with ode"):
        iv.complex_ode(KEPLER.fun).set_integrator("zvode")
    with pytest.raises(ValueError, match="method must be"):
        iv.ode(KEPLER.fun).set_integrator("vode", method="euler")


def test_orders_and_bands_are_passed_on():
    """Formulas of order 1 need more steps; bands fewer evaluations for a Jacobian."""

    def chain(t, y):
        return 50 * (np.append(0, y[:-1]) - 2 * y + np.append(y[1:], 0))

    calls = []
    for parameters in ({}, {"order": 1}, {"lband": 1, "uband": 1}):
        fun = Counted(chain)
        started("vode", fun, np.arange(8.0), method="bdf", rtol=1e-4, **parameters).integrate(1.0)
        calls.append(fun.calls)
    assert calls[1] > 2 * calls[0]
    assert calls[2] < calls[0]


@pytest.mark.parametrize("name", ["dopri5", "dop853", "vode", "lsoda", "ode15s"])
def test_unknown_parameters_are_refused_and_idle_ones_warned_of(name):
    with pytest.raises(TypeError, match=f"integrator '{name}' has no parameter 'rtoll'; did you mean 'rtol'"):
        iv.ode(KEPLER.fun).set_integrator(name, rtoll=1e-3)
    idle = {"dopri5": "safety", "dop853": "beta", "vode": "min_step", "lsoda": "max_order_ns"}.get(name)
    if idle:
        with pytest.warns(UserWarning, match=f"{idle} has no effect: it controls SciPy's {name}"):
            iv.ode(KEPLER.fun).set_integrator(name, **{idle: 1})
    iv.ode(KEPLER.fun).set_integrator(name, max_step=0, first_step=0.0, nsteps=0)  # SciPy's way to say: no limit


class TestStepping:
    @pytest.mark.parametrize("method", GOING_ON)
    def test_one_step_and_relax(self, method):
        """`step` returns the next end of a step, `relax` the first one at or beyond the requested time."""
        options = {"rtol": 1e-5, "atol": 1e-12, "max_steps": 40, "dense_output": True}  # values between steps are used
        ends = iv.solve_ivp(KEPLER.fun, (0, np.inf), KEPLER.y0, method, **options)
        run = started(method, rtol=1e-5)
        for i in (1, 2, 3):
            np.testing.assert_array_equal(run.integrate(1e3, step=True), ends.y[:, i])
            assert run.t == ends.t[i]
        beyond = float((ends.t[29] + ends.t[30]) / 2)
        np.testing.assert_array_equal(run.integrate(beyond, relax=True), ends.y[:, 30])
        inside = run.integrate(float(ends.t[30] * 0.25 + ends.t[29] * 0.75))  # back, within the last step
        assert run.t < ends.t[30]
        np.testing.assert_allclose(inside, KEPLER.solution(run.t), atol=1e-2)
        np.testing.assert_array_equal(run.integrate(1e3, step=True), ends.y[:, 30])

    def test_pairs_go_to_the_time_all_the_same(self):
        """SciPy's classes do so."""
        assert started("dopri5").integrate(1.0, step=True) is not None
        for library in (scipy.integrate, iv):
            run = library.ode(KEPLER.fun).set_integrator("dopri5").set_initial_value(KEPLER.y0)
            run.integrate(1.0, step=True)
            assert run.t == 1.0

    @families
    def test_backwards_and_back(self, method):
        """The direction may change in any call; the state is that of the start again."""
        low = iv.METHODS[method].order == 2
        run = started(method, rtol=1e-6 if low else 1e-9)
        run.integrate(2.0)
        run.integrate(-1.0)
        np.testing.assert_allclose(run.integrate(0.0), KEPLER.y0, atol=2e-2 if low else 1e-5)

    def test_the_same_time_is_the_same_state(self):
        run = started("lsoda")
        y = run.integrate(1.0)
        assert run.integrate(1.0) is y


@pytest.mark.parametrize("method", PAIRS)
def test_short_calls_in_a_row_cost_equally_many_evaluations(method):
    """Each restarts, with the size that the one before has found: no start is judged as one at rest, beside which f is
    looked at, however short the call."""
    calls = 0

    def circle(t, y):
        nonlocal calls
        calls += 1
        return [y[1], -y[0]]

    run = iv.ode(circle).set_integrator(method).set_initial_value([1.0, 0.0])
    run.integrate(1e-3)
    counts = set()
    for _ in range(60):
        calls = 0
        run.integrate(run.t + 1e-3)
        counts.add(calls)
    assert len(counts) == 1
    np.testing.assert_allclose(run.y, [np.cos(run.t), -np.sin(run.t)], atol=1e-6)


class TestSolout:
    @pytest.mark.parametrize("method", PAIRS)
    def test_it_sees_the_start_and_every_step(self, method):
        seen = []
        run = started(method, rtol=1e-5)
        run.set_solout(lambda t, y: seen.append((t, *y)))
        run.integrate(2.0)
        sol = iv.solve_ivp(KEPLER.fun, (0, 2), KEPLER.y0, method, rtol=1e-5, atol=1e-12)
        np.testing.assert_array_equal(np.array(seen), np.vstack([sol.t, sol.y]).T)
        assert run.get_return_code() == 1

    def test_minus_one_ends_the_call(self):
        run = started("dopri5")
        run.set_solout(lambda t, y: -1 if t > 1 else None)
        run.integrate(3.0)
        assert 1 < run.t < 3
        assert run.successful()
        assert run.get_return_code() == 2

    @pytest.mark.parametrize("method", GOING_ON)
    def test_methods_that_go_beyond_have_none(self, method):
        with pytest.raises(ValueError, match="selected integrator does not support solout, choose another one"):
            started(method).set_solout(lambda t, y: None)

    def test_complex_states_come_as_such(self):
        seen = []
        run = iv.complex_ode(lambda t, y: 1j * y).set_integrator("dopri5").set_initial_value([1.0])
        run.set_solout(lambda t, y: seen.append(y))
        run.integrate(1.0)
        assert all(y.dtype == complex for y in seen)


class TestParameters:
    @pytest.mark.parametrize("name", ["dopri5", "vode", "lsoda", "ode15s"])
    def test_the_method_starts_anew_with_other_parameters(self, name):
        """A rate that is set before each call acts in that call, exactly, even if the steps before led beyond it."""
        run = iv.ode(lambda t, y, rate: [rate]).set_integrator(name, rtol=1e-6).set_initial_value(0.0)
        for k, rate in enumerate((1.0, -2.0, 0.5), 1):
            run.set_f_params(rate).integrate(float(k))
        assert run.y[0] == pytest.approx(-0.5, abs=1e-6)

    @pytest.mark.parametrize("bands", [{}, {"lband": 0, "uband": 0}])
    def test_those_of_the_jacobian_are_its_own(self, bands):
        seen = []

        def jac(t, y, name):
            seen.append(name)
            return [[-1e3]]

        run = iv.ode(lambda t, y, rate: -rate * y, jac).set_integrator("vode", method="bdf", **bands)
        run.set_initial_value(1.0).set_f_params(1e3).set_jac_params("J")
        assert abs(run.integrate(1.0)[0]) < 1e-6
        assert {*seen} == {"J"}

    def test_invariants_take_those_of_f(self):
        """Invariants are held at their values where the parameters were set."""

        def radius(t, y, a):
            return a * (y @ y)

        run = iv.ode(lambda t, y, a: [a * y[1], -a * y[0]], invariants=radius).set_integrator("ode113", rtol=1e-3)
        run.set_initial_value([3.0, 4.0])
        for a in (1.0, 2.0, 3.0):
            run.set_f_params(a).integrate(run.t + 5)
        assert radius(0, run.y, 1.0) == pytest.approx(25, rel=1e-8)


class TestFailures:
    @pytest.mark.parametrize(("name", "code"), [("dopri5", -2), ("dop853", -2), ("vode", -1), ("lsoda", -1)])
    def test_too_many_steps(self, name, code):
        """The return code is SciPy's, and the state where the run came to; the next call goes on from there."""
        run = started(name, nsteps=3, rtol=1e-9)
        with pytest.warns(UserWarning, match=f"{name}: nsteps = 3 is reached at t = "):
            run.integrate(5.0)
        assert not run.successful()
        assert run.get_return_code() == code
        assert 0 < run.t < 5
        np.testing.assert_allclose(run.y, KEPLER.solution(run.t), atol=1e-6)
        theirs = scipy.integrate.ode(KEPLER.fun).set_integrator(name, nsteps=3, rtol=1e-9).set_initial_value(KEPLER.y0)
        with pytest.warns(UserWarning, match=name):
            theirs.integrate(5.0)
        assert theirs.get_return_code() == code
        assert run.set_initial_value(KEPLER.y0).successful()

    @pytest.mark.parametrize("name", ["dopri5", "vode"])
    def test_a_time_that_is_never_reached(self, name):
        with pytest.raises(ValueError, match="t = -inf is never reached: give a finite t, nsteps"):
            started(name).integrate(-np.inf)
        run = started(name, nsteps=3)
        with pytest.warns(UserWarning, match="nsteps = 3 is reached"):
            run.integrate(np.inf)
        assert run.t > 0

    @pytest.mark.parametrize(("name", "code"), [("dopri5", -3), ("vode", -4), ("lsoda", -4), ("ode15s", None)])
    def test_a_singularity(self, name, code):
        run = started(name, lambda t, y: y**2, (1.0,))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run.integrate(2.0)
        assert run.get_return_code() == code if code else run.get_return_code() < 0
        assert run.t == pytest.approx(1.0, abs=1e-3)

    @pytest.mark.parametrize(("name", "code"), [("dopri5", -1), ("vode", -3)])
    def test_what_is_not_defined_at_the_start(self, name, code):
        run = started(name, lambda t, y: [np.nan], (1.0,))
        with pytest.warns(UserWarning, match=f"{name}: fun is not finite at the start"):
            run.integrate(1.0)
        assert run.get_return_code() == code

    @pytest.mark.parametrize("name", ["dopri5", "vode"])
    def test_a_function_that_is_not_conserved(self, name):
        """The function is refused at the start, or the run fails where that shows."""
        with pytest.raises(iv.InvariantError):
            started(name, invariants=lambda t, y: y[1]).integrate(1.0)
        run = started(name, lambda t, y: [1.0 if t > 1 else 0.0], (1.0,), invariants=lambda t, y: y[0], max_step=0.1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run.integrate(5.0)
        assert not run.successful()
        assert run.t < 2

    @pytest.mark.parametrize("name", ["dopri5", "vode"])
    def test_an_exception_of_f_comes_out_and_the_next_call_starts_from_the_last_state(self, name):
        asked = {"fail": False}

        def fun(t, y):
            if asked["fail"]:
                raise KeyError("mine")
            return -y

        run = started(name, fun, (1.0,))
        run.integrate(1.0)
        asked["fail"] = True
        with pytest.raises(KeyError, match="mine"):
            run.integrate(20.0)
        asked["fail"] = False
        assert run.integrate(2.0)[0] == pytest.approx(np.exp(-2), abs=1e-5)


def test_compiled_functions_run_as_they_are():
    code = iv.compile(lambda t, y, a: [a * y[1], -a * y[0]])
    run = iv.ode(code).set_integrator("dop853", rtol=1e-9).set_initial_value([1.0, 0.0]).set_f_params(2.0)
    assert run.integrate(np.pi)[0] == pytest.approx(1, abs=1e-7)


def test_nothing_keeps_an_object_alive():
    run = iv.ode(lambda t, y: -y, lambda t, y: [[-1.0]], invariants=lambda t, y: 0.0 * y[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run.set_integrator("ode15s").set_initial_value(1.0).integrate(1.0)
    there = weakref.ref(run)
    del run
    gc.collect()
    assert there() is None


@families
def test_complex_states_are_those_of_solve_ivp(method):
    def fun(t, y):
        return 1j * y - 0.1 * np.conj(y)  # not analytic

    options = {"rtol": 1e-6, "atol": 1e-9}
    run = iv.complex_ode(fun).set_integrator(method, **options).set_initial_value([1.0, 1j])
    sol = iv.solve_ivp(fun, (0, 3), [1.0 + 0j, 1j], "dop853", rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(run.integrate(3.0), sol.y[:, -1], atol=1e-2 if iv.METHODS[method].order == 2 else 1e-4)
