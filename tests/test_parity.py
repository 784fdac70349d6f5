"""The calls of scipy.integrate.solve_ivp run unchanged: same arguments, fields, shapes, exceptions."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
from problems import slack

#: SciPy's name, and what it stands for here.
NAMES = {about.scipy_name: (name, dict(about.scipy_options)) for name, about in iv.METHODS.items() if about.scipy_name}
LIBRARIES = pytest.mark.parametrize("solve_ivp", [scipy.integrate.solve_ivp, iv.solve_ivp], ids=["scipy", "invariode"])


def decay(t, y):
    return -0.5 * y


def cannon(t, y):
    return [y[1], -0.5]


def hit_ground(t, y):
    return y[0]


hit_ground.terminal = True
hit_ground.direction = -1


def apex(t, y):
    return y[1]


@pytest.mark.parametrize("name", NAMES)
@LIBRARIES
def test_documented_calls(solve_ivp, name):
    """The examples of SciPy's documentation."""
    sol = solve_ivp(decay, [0, 10], [2, 4, 8], method=name)
    assert sol.y.shape == (3, len(sol.t))
    np.testing.assert_allclose(sol.y[:, -1], np.array([2, 4, 8]) * np.exp(-5), rtol=2e-2)

    sol = solve_ivp(decay, [0, 10], [2, 4, 8], name, t_eval=[0, 1, 2, 4, 10])
    np.testing.assert_array_equal(sol.t, [0, 1, 2, 4, 10])
    assert sol.y.shape == (3, 5)

    sol = solve_ivp(cannon, [0, 100], [0, 10], name, events=(hit_ground, apex), dense_output=True)
    assert sol.status == 1
    np.testing.assert_allclose(sol.t_events[0], [40], rtol=1e-6)
    np.testing.assert_allclose(sol.t_events[1], [20], rtol=1e-6)
    np.testing.assert_allclose(sol.sol(sol.t_events[1][0]), [100, 0], atol=1e-4)
    np.testing.assert_allclose(sol.y_events[1], [[100, 0]], atol=1e-4)
    assert sol.sol(np.linspace(0, 40, 7)).shape == (2, 7)

    def lotka_volterra(t, z, a, b, c, d):
        x, y = z
        return [a * x - b * x * y, -c * y + d * x * y]

    sol = solve_ivp(lotka_volterra, [0, 15], [10, 5], name, args=(1.5, 1, 3, 1), dense_output=True)
    assert sol.sol(np.linspace(0, 15, 300)).T.shape == (300, 2)

    if solve_ivp is iv.solve_ivp or name not in ("Radau", "LSODA"):  # SciPy's take no complex y
        sol = solve_ivp(lambda t, y: 1j * y, [0, 1], [1 + 0j], name)
        assert sol.y.dtype == complex


FIELDS = ["t", "y", "sol", "t_events", "y_events", "nfev", "njev", "nlu", "status", "message", "success"]


@pytest.mark.parametrize(
    "options", [{}, {"events": apex}, {"t_eval": [1, 2]}, {"dense_output": True}, {"events": [apex, hit_ground]}]
)
def test_fields(options):
    theirs = scipy.integrate.solve_ivp(cannon, [0, 50], [0, 10], **options)
    ours = iv.solve_ivp(cannon, [0, 50], [0, 10], **options)
    for field in FIELDS:
        a, b = theirs[field], ours[field]
        assert b is getattr(ours, field)
        assert (a is None) == (b is None), field
        if field not in ("sol", "y_events", "t_events"):
            assert isinstance(b, type(a)), field
        if isinstance(a, list):
            assert [len(x) for x in a] == [len(x) for x in b]
    assert theirs.message == ours.message
    assert set(FIELDS) <= set(ours.keys())
    assert "t" in ours
    assert "nothing" not in ours
    with pytest.raises(KeyError):
        ours["nothing"]
    with pytest.raises(AttributeError):
        ours.nothing  # noqa: B018  # the access is the test


CORNERS = {
    "zero-length interval": ((0, 0), [1, 2], {}),
    "zero-length interval, dense": ((0, 0), [1, 2], {"dense_output": True}),
    "empty y0": ((0, 1), [], {}),
    "one ulp": ((1.0, np.nextafter(1.0, 2)), [1, 2], {}),
    "integers": ((0, 1), [1, 2], {"t_eval": [0, 1]}),
    "tuple y0": ((0, 1), (1.0, 2.0), {}),
    "backwards": ((1, 0), [1, 2], {}),
    "backwards with times": ((1, 0), [1, 2], {"t_eval": [1, 0.5, 0]}),
    "no times": ((0, 1), [1, 2], {"t_eval": []}),
    "boolean y0": ((0, 1), [True, False], {}),
    "first_step": ((0, 1), [1, 2], {"first_step": 0.1}),
    "max_step inf": ((0, 1), [1, 2], {"max_step": np.inf}),
    "vector atol": ((0, 1), [1, 2], {"atol": [1e-6, 1e-8]}),
    "vector rtol": ((0, 1), [1, 2], {"rtol": [1e-3, 1e-5]}),
    "zero atol": ((0, 1), [1, 2], {"atol": 0}),
    "vectorized": ((0, 1), [1, 2], {"vectorized": True}),
}


@pytest.mark.parametrize("name", CORNERS)
def test_corner_cases(name):
    t_span, y0, options = CORNERS[name]
    theirs = scipy.integrate.solve_ivp(decay, t_span, y0, **options)
    ours = iv.solve_ivp(decay, t_span, y0, **options)
    assert (theirs.status, theirs.success) == (ours.status, ours.success)
    if len(theirs.t):
        np.testing.assert_array_equal([theirs.t[0], theirs.t[-1]], [ours.t[0], ours.t[-1]])
        np.testing.assert_allclose(ours.y[:, -1], theirs.y[:, -1], rtol=1e-3)
        assert ours.y.shape[0] == theirs.y.shape[0]
        assert len(theirs.t) == len(ours.t) or options.get("t_eval") is None
    else:
        assert len(ours.t) == 0
    if theirs.sol:
        np.testing.assert_allclose(theirs.sol(t_span[0]), ours.sol(t_span[0]))


REFUSED = {
    "y0 matrix": ([0, 1], [[1.0]], {}),
    "y0 scalar": ([0, 1], 1.0, {}),
    "y0 NaN": ([0, 1], [np.nan], {}),
    "t_span of three": ([0, 1, 2], [1], {}),
    "times outside": ([0, 1], [1], {"t_eval": [0, 2]}),
    "times unsorted": ([0, 1], [1], {"t_eval": [0.5, 0.2]}),
    "times a matrix": ([0, 1], [1], {"t_eval": [[0.5]]}),
    "negative atol": ([0, 1], [1], {"atol": -1}),
    "atol shape": ([0, 1], [1], {"atol": [1, 2]}),
    "first_step 0": ([0, 1], [1], {"first_step": 0}),
    "first_step too long": ([0, 1], [1], {"first_step": 2}),
    "max_step 0": ([0, 1], [1], {"max_step": 0}),
    "unknown method": ([0, 1], [1], {"method": "RK47"}),
    "args": ([0, 1], [1], {"args": 5}),
}


@pytest.mark.parametrize("name", REFUSED)
def test_same_kind_of_exception(name):
    t_span, y0, options = REFUSED[name]
    with pytest.raises((ValueError, TypeError)) as theirs:
        scipy.integrate.solve_ivp(decay, t_span, y0, **options)
    with pytest.raises(theirs.type):
        iv.solve_ivp(decay, t_span, y0, **options)


#: Options of SciPy's methods that not every method of ours can use. min_step is LSODA's; none of ours takes it.
SELECTIVE = ["jac", "jac_sparsity", "lband", "uband", "min_step", "max_order", "bdf"]
UNUSED = {"bdf": True, "lband": 0, "uband": 0}


def test_options_that_the_method_cannot_use_are_warned_of(method):
    for option in SELECTIVE:
        if option not in iv.METHODS[method].options:
            with pytest.warns(UserWarning, match=f"option '{option}' has no effect on {method}"):
                assert iv.solve_ivp(decay, (0, 1), [1], method, **{option: UNUSED.get(option, 1)}).success


def test_rtol_is_raised_as_in_scipy():
    for solve_ivp in (scipy.integrate.solve_ivp, iv.solve_ivp):
        with pytest.warns(UserWarning, match="rtol"):
            assert solve_ivp(decay, (0, 1), [1], rtol=1e-20).success


def test_names_of_scipy_are_the_same_methods():
    for theirs, (ours, options) in NAMES.items():
        expected = iv.solve_ivp(decay, (0, 1), [1], ours, **options).y
        np.testing.assert_array_equal(iv.solve_ivp(decay, (0, 1), [1], theirs).y, expected)
        as_class = iv.solve_ivp(decay, (0, 1), [1], getattr(scipy.integrate, theirs))
        np.testing.assert_array_equal(as_class.y, expected)


def test_steps_agree_in_accuracy(method):
    """At the same tolerances the error is not larger than with SciPy's pair of the same name, within a factor."""

    def error(solve_ivp, name):
        sol = solve_ivp(lambda t, y: [y[1], -y[0]], (0, 20), [0, 1], method=name, rtol=1e-6, atol=1e-8)
        return abs(sol.y[0, -1] - np.sin(20))

    theirs = next((name for name, (ours, _) in NAMES.items() if ours == method), "LSODA")
    assert error(iv.solve_ivp, method) < 3 * slack(method) * error(scipy.integrate.solve_ivp, theirs)


def test_no_warnings_where_scipy_gives_none():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        iv.solve_ivp(decay, (0, 1), [1, 2], "RK45", None, True, None, False, None, rtol=1e-6, atol=1e-8, max_step=0.1)


def test_a_vectorized_function_may_return_a_list():
    def fun(t, y):
        return [y[1], -y[0]]

    ours = iv.solve_ivp(fun, (0, 1), [1.0, 0.0], vectorized=True)
    np.testing.assert_array_equal(ours.y, iv.solve_ivp(fun, (0, 1), [1.0, 0.0]).y)
