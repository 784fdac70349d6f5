"""SciPy's `odeint` call: the same arguments, shapes and answers. Named where SciPy's own tests ask the same."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.integrate
from scipy.integrate import ODEintWarning

import invariode as iv
from cases import dealt, hidden
from stiff import robertson, robertson_jacobian

LIBRARIES = pytest.mark.parametrize("odeint", [scipy.integrate.odeint, iv.odeint], ids=["scipy", "invariode"])


def pendulum(y, t, b, c):
    theta, omega = y
    return [omega, -b * omega - c * np.sin(theta)]


@LIBRARIES
def test_the_documented_example(odeint):
    t = np.linspace(0, 10, 101)
    y = odeint(pendulum, [np.pi - 0.1, 0.0], t, args=(0.25, 5.0))
    assert y.shape == (101, 2)
    fine = iv.solve_ivp(
        lambda t, y: pendulum(y, t, 0.25, 5.0), (0, 10), y[0], "dop853", t_eval=t, rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(y, fine.y.T, atol=3e-6)


A = np.array([[-5.0, 2.0, 0.0], [1.0, -3.0, 1.0], [0.0, 2.0, -4.0]])
T = np.linspace(0, 2, 9)
Y0 = [1.0, 2.0, 3.0]


def exact(t):
    from scipy.linalg import expm

    return np.array([expm(A * one) @ Y0 for one in t])


def bands():
    """Return the bands of A, with the highest diagonal first: [i - j + mu, j]."""
    return np.array([[0, 2, 1], [-5, -3, -4], [1, 2, 0]], dtype=float)


WAYS = {
    "full": {"Dfun": lambda y, t: A},
    "full by columns": {"Dfun": lambda y, t: A.T, "col_deriv": True},
    "banded": {"Dfun": lambda y, t: bands(), "ml": 1, "mu": 1},
    "banded by columns": {"Dfun": lambda y, t: bands().T, "ml": 1, "mu": 1, "col_deriv": 1},
    "bands by differences": {"ml": 1, "mu": 1},
    "differences": {},
}


class TestJacobians:
    """odeint's test_odeint_banded_jacobian and its doubles with col_deriv and tfirst."""

    @dealt(12, way=WAYS, tfirst=[False, True])
    @LIBRARIES
    def test_all_ways(self, odeint, way, tfirst):
        options = dict(WAYS[way])
        if tfirst and "Dfun" in options:
            dfun = options["Dfun"]
            options["Dfun"] = lambda t, y: dfun(y, t)
        y, _ = odeint((lambda t, y: A @ y) if tfirst else (lambda y, t: A @ y), Y0, T, full_output=True,
                         tfirst=tfirst, **options)  # fmt: skip
        np.testing.assert_allclose(y, exact(T), atol=2e-6)

    @pytest.mark.parametrize("transposed", [False, True])
    def test_they_are_used_where_the_problem_is_stiff(self, transposed):
        calls = []

        def dfun(t, y):
            calls.append(t)
            return np.transpose(robertson_jacobian(t, y)) if transposed else robertson_jacobian(t, y)

        _, info = iv.odeint(
            robertson, [1.0, 0, 0], [0, 1, 1e3], Dfun=dfun, col_deriv=transposed, tfirst=True, full_output=True
        )
        assert info["nje"][-1] == len(calls) > 2

    def test_a_lower_band_alone_means_no_upper_one(self):
        lower = np.tril(A)
        y = iv.odeint(lambda y, t: lower @ y, Y0, T, ml=1)
        np.testing.assert_allclose(y, scipy.integrate.odeint(lambda y, t: lower @ y, Y0, T, ml=1), atol=1e-6)

    def test_it_says_which_kind_of_method_made_the_step(self):
        for options, used in (({"method": "ode15s"}, 2), ({"method": "ode45"}, 1)):
            info = iv.odeint(lambda y, t: A @ y, Y0, T, full_output=1, **options)[1]
            assert set(info["mused"]) == {used}
        info = iv.odeint(robertson, [1.0, 0, 0], np.logspace(-5, 3, 9), tfirst=True, full_output=1)[1]
        assert info["mused"][0] == 1
        assert info["mused"][-1] == 2


@LIBRARIES
def test_odeint_trivial_time(odeint):
    """One time: the state there, and nothing in the dictionary."""
    y, info = odeint(lambda y, t: -y, 1, [0], full_output=True)
    np.testing.assert_array_equal(y, [[1.0]])
    for name in ("hu", "tcur", "nst", "nfe", "nje", "nqu", "mused"):
        assert len(info[name]) == 0


@LIBRARIES
def test_repeated_t_values(odeint):
    """In both directions, at the start, in between, at the end; and everywhere."""
    a = -0.5
    for t in ([0, 0, 1, 1, 1, 2, 3, 3], [4, 4, 3, 2, 2, 1, 0, 0]):
        t = np.array(t, dtype=float)
        y = odeint(lambda y, t: a * y, 1.0, t)
        np.testing.assert_allclose(y[:, 0], np.exp(a * (t - t[0])), rtol=1e-6)
    np.testing.assert_array_equal(odeint(lambda y, t: a * y, [1.0, 2.0], [1.0, 1.0, 1.0]), [[1.0, 2.0]] * 3)


@LIBRARIES
def test_no_times_give_no_rows(odeint):
    """SciPy's shape."""
    assert odeint(lambda y, t: -y, [1.0, 2.0], []).shape == (0, 2)


@pytest.mark.parametrize("t", [[np.nan], [0, np.nan, 1], [-np.inf, 0], [0, np.inf]])
def test_times_that_are_not_finite_are_refused(t):
    with pytest.raises(ValueError, match=r"t must be a list of finite times, got (nan|-?inf)"):
        iv.odeint(lambda y, t: -y, [1.0], t)


@pytest.mark.parametrize("t", [[0, 1, 0.5], [0, 1, 1, 0], [1, 0, 2]])
def test_times_out_of_order_are_refused(t):
    with pytest.raises(ValueError, match="t must be a list of times in rising or falling order"):
        iv.odeint(lambda y, t: -y, 1.0, t)


@LIBRARIES
def test_odeint_errors(odeint):
    """Exceptions of func and Dfun come out as they are."""

    def fails(y, t):
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        odeint(fails, [1.0], [0, 1])
    with pytest.raises(ZeroDivisionError, match="mine"):
        odeint(lambda y, t: -100 * y, [1.0], [0, 1], Dfun=fails)


def test_odeint_bad_shapes():
    for y0, f, dfun in (
        ([[1.0]], lambda y, t: y, None),
        ([1.0], lambda y, t: [1.0, 2.0], None),
        ([1.0, 2.0], lambda y, t: y, lambda y, t: [[1.0]]),
    ):
        with pytest.raises(ValueError, match="shape"):
            iv.odeint(f, y0, [0, 1], Dfun=dfun)


@LIBRARIES
def test_extra_arguments_reach_func_and_dfun(odeint):
    seen = set()

    def f(y, t, *args):
        seen.add(("f", *args))
        return -100 * y

    def jac(y, t, *args):
        seen.add(("jac", *args))
        return [[-100.0]]

    odeint(f, [1.0], [0, 1], args=(1, 2), Dfun=jac)
    assert seen == {("f", 1, 2), ("jac", 1, 2)}


@LIBRARIES
def test_critical_points_are_not_stepped_across(odeint):
    """f is not defined after them; and where it jumps there, the answer is as exact as elsewhere."""
    reached = []

    def f(y, t):
        reached.append(t)
        return [1.0]

    odeint(f, [0.0], [0, 0.5, 1.0], tcrit=[1.0])
    assert max(reached) <= 1.0
    y = odeint(lambda y, t: [0.0 if t < 1 else 10.0], [0.0], [0, 0.9, 1.0, 1.5, 2.0], tcrit=[1.0])
    if odeint is iv.odeint:
        np.testing.assert_allclose(y[:, 0], [0, 0, 0, 5, 10], atol=1e-6)


def test_critical_points_backwards_and_outside():
    def f(y, t):
        return [np.sign(t - 1)]

    y = iv.odeint(f, [0.0], [2, 1.5, 0.5, 0], tcrit=[-3, 1.0, 5])
    np.testing.assert_allclose(y[:, 0], [0, -0.5, -0.5, 0], atol=1e-7)


def test_the_dictionary_tells_of_the_steps():
    counted = [0]

    def f(y, t):
        counted[0] += 1
        return [y[1], -y[0]]

    t = np.linspace(0, 10, 11)
    _, info = iv.odeint(f, [1.0, 0.0], t, full_output=True, tcrit=[5.5])
    assert info["nfe"][-1] == counted[0]
    assert (np.diff(info["nfe"]) >= 0).all()
    assert (np.diff(info["nst"]) >= 0).all()
    assert (info["tcur"] >= t[1:]).all()
    assert (info["tcur"] - info["hu"] <= t[1:]).all()
    assert info["nqu"].max() <= 12
    assert info["message"] == "Integration successful."
    theirs = scipy.integrate.odeint(f, [1.0, 0.0], t, full_output=True)[1]
    for name in set(info) - {"message"}:
        assert info[name].shape == theirs[name].shape
    jacobians = iv.odeint(f, [1.0, 0.0], t, full_output=True, Dfun=lambda y, t: [[0, 1], [-1, 0]])[1]["nje"]
    assert (np.diff(jacobians) >= 0).all()


def test_a_run_that_stops_warns_and_leaves_nan():
    with pytest.warns(ODEintWarning, match="mxstep = 3 steps between two times, at t = .*: raise mxstep"):
        y, info = iv.odeint(lambda y, t: [np.cos(40 * t)], [0.0], [0, 1e-9, 5], mxstep=3, full_output=1)
    assert np.isfinite(y[:2]).all()
    assert np.isnan(y[2]).all()
    assert "mxstep" in info["message"]
    with pytest.warns(ODEintWarning, match="t = 1"):
        y = iv.odeint(lambda y, t: y**2, [1.0], [0, 0.5, 2])
    np.testing.assert_allclose(y[:2, 0], [1, 2], rtol=1e-6)
    assert np.isnan(y[2, 0])


def test_orders_and_steps_are_limited():
    t = np.linspace(0, 3, 4)
    for method, limit in (("ode113", {"mxordn": 2}), ("ode15s", {"mxords": 2})):
        info = iv.odeint(lambda y, t: -y, [1.0], t, method=method, full_output=True, **limit)[1]
        assert info["nqu"].max() <= 2
    with pytest.warns(UserWarning, match="mxordn and mxords have no effect on auto"):
        iv.odeint(lambda y, t: -y, [1.0], t, mxords=2)
    info = iv.odeint(lambda y, t: -y, [1.0], t, hmax=0.01, h0=0.001, full_output=True, mxordn=99)[1]
    assert abs(info["hu"]).max() <= 0.01
    assert info["nst"][-1] >= 300


def test_what_has_no_effect_says_so(capsys):
    for option in ({"hmin": 0.1}, {"ixpr": 1}, {"mxhnil": 3}):
        with pytest.warns(UserWarning, match=f"{next(iter(option))} has no effect"):
            iv.odeint(lambda y, t: -y, [1.0], [0, 1], **option)
    iv.odeint(lambda y, t: -y, [1.0], [0, 1], printmessg=True)
    assert capsys.readouterr().out == "Integration successful.\n"


def test_the_order_of_arguments_changes_no_bit():
    """The order changes no bit with few and many further arguments, a lambda, a bound method and an object; functions
    keep their names in errors."""

    class Pendulum:
        def of_state(self, y, t, *args):
            return pendulum(y, t, 0.25, 5.0 + len(args))

        __call__ = of_state

    t = np.linspace(0, 3, 40)
    for fun in (Pendulum().of_state, Pendulum(), lambda y, t, *args: pendulum(y, t, 0.25, 5.0)):
        for args in ((), (1,), tuple(range(12))):
            for _ in range(2):
                y = iv.odeint(fun, [1.0, 0.5], t, args=args)
                first = iv.odeint(lambda t, y, *args, fun=fun: fun(y, t, *args), [1.0, 0.5], t, args=args, tfirst=True)
                np.testing.assert_array_equal(y, first)
    with pytest.raises(TypeError, match="pendulum") as info:
        iv.odeint(pendulum, [1.0, 0.5], t, args=(1.0,))
    assert info.value.__notes__


def turning(y, t):
    return np.where(t < 1, -y, 5 * y)


def test_rows_and_warnings_are_those_of_the_call_with_a_dictionary():
    t = np.linspace(0, 2, 21)
    stiff = {"func": lambda y, t: [-1e4 * (y[0] - np.cos(t))], "y0": [1.0], "t": t, "method": "ode45"}
    for call, warning in (
        ({"func": lambda y, t: [y[1], -y[0]], "y0": [1.0, 0.0], "t": t}, None),
        ({"func": lambda y, t: [y[1], -y[0]], "y0": [1.0, 0.0], "t": t[::-1], "tcrit": [0.7]}, None),
        ({"func": lambda y, t: y**2, "y0": [1.0], "t": t}, ODEintWarning),
        ({"func": lambda y, t: np.where(t % 0.3 < 0.1, -y, 5 * y), "y0": [1.0], "t": t}, None),
        (stiff, iv.StiffnessWarning),
        (
            {**stiff, "func": hidden(lambda y, t: np.where(t < 1, -y, 5 * y)), "method": "ode113"},
            iv.DiscontinuityWarning,
        ),
    ):
        told = []
        for full in (False, True):
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always")
                y = iv.odeint(**call, full_output=full)
            told.append(([(one.category, str(one.message)) for one in found], y[0] if full else y))
        np.testing.assert_equal(*told)
        assert [category for category, _ in told[0][0]] == ([] if warning is None else [warning])


def test_calls_of_one_kind_say_the_same():
    """Values that are equal and of another type are other arguments, and warnings come with every call."""
    t = np.linspace(0, 1, 5)
    for _ in range(2):
        with pytest.warns(UserWarning, match="hmin has no effect"):
            iv.odeint(lambda y, t: -y, [1.0], t, hmin=1e-3)
        iv.odeint(lambda y, t: -y, [1.0], t, mxstep=100)
        with pytest.raises(TypeError, match="mxstep must be an integer"):
            iv.odeint(lambda y, t: -y, [1.0], t, mxstep=100.0)
        for tolerance in (1e-6, [1e-6], np.array([1e-6])):
            np.testing.assert_allclose(iv.odeint(lambda y, t: -y, [1.0], t, rtol=tolerance)[:, 0], np.exp(-t), 1e-5)
        with pytest.raises(ValueError, match="nothing"):
            iv.odeint(lambda y, t: -y, [1.0], t, method="nothing")


def test_invariants_are_kept():
    t = np.linspace(0, 100, 11)
    y = iv.odeint(lambda y, t: [y[1], -y[0]], [1.0, 0.0], t, rtol=1e-3, atol=1e-6, invariants=lambda t, y: y @ y)
    assert abs((y**2).sum(axis=1) - 1).max() < 1e-5


def test_machine_code_takes_t_first():
    pytest.importorskip("numba")
    f = iv.compile(lambda t, y: (-y[0],))
    np.testing.assert_allclose(iv.odeint(f, [1.0], [0, 1], tfirst=True)[1], np.exp(-1), rtol=1e-6)
    with pytest.raises(TypeError, match="func is machine code, which takes t first: give tfirst=True"):
        iv.odeint(f, [1.0], [0, 1])
