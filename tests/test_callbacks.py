"""User functions: exceptions come out unchanged, results in any common form are read, arguments may be kept."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import textwrap
import threading
import time
import traceback
import weakref

import numpy as np
import pytest

import invariode as iv
from cases import FAMILIES, dealt, explicit_and_implicit, families
from problems import PROBLEMS, slack


def decay(t, y):
    return [-y[0], -2 * y[1]]


def total(t, y):
    return y[0] ** 2 / y[1]


class Boom(Exception):  # noqa: N818  # what a user's own exception may well be called
    pass


def failing(after, result):
    """A function that raises at a call."""
    calls = 0

    def fun(t, y):
        nonlocal calls
        calls += not np.iscomplexobj(y)  # complex y only asks whether the function takes it
        if calls > after:
            raise Boom(f"call {calls}")
        return result(t, y)

    return fun


ROLES = {
    "fun": lambda bad: {"fun": failing(bad, decay)},
    "invariant": lambda bad: {"invariants": failing(bad, total)},
    "Jacobian": lambda bad: {
        "invariants": iv.Invariants(total, failing(bad, lambda t, y: [2 * y[0] / y[1], -(y[0] ** 2) / y[1] ** 2]))
    },
    "event": lambda bad: {"events": failing(bad, lambda t, y: y[0] - 0.5)},
    "callback": lambda bad: {"callback": failing(bad, lambda t, y: None)},
}


@dealt(15, method=FAMILIES, role=ROLES, after=[0, 1, 2, 7, 30])
def test_exceptions_come_out_unchanged_and_the_next_solve_works(method, role, after):
    options = {"fun": decay, **ROLES[role](after)}
    fun = options.pop("fun")
    with pytest.raises(Boom, match=rf"call {after + 1}") as caught:
        iv.solve_ivp(fun, (0, 3), [1, 1], method, max_step=0.05, dense_output=True, **options)
    assert any(frame.name == "fun" for frame in traceback.extract_tb(caught.tb))
    assert caught.value.__cause__ is None
    assert iv.solve_ivp(decay, (0, 3), [1, 1], method, invariants=total).success


def test_exceptions_in_dense_output_and_impose():
    raised = False

    def g(t, y):
        if raised:
            raise Boom
        return total(t, y)

    sol = iv.solve_ivp(decay, (0, 1), [1, 1], invariants=g, dense_output=True)
    raised = True
    for use in (lambda: sol.sol(0.123), sol.impose, lambda: sol.residual, lambda: iv.impose(g, sol)):
        with pytest.raises(Boom):
            use()


@pytest.mark.parametrize(
    "form",
    [
        list,
        tuple,
        np.array,
        lambda v: np.array(v, dtype=np.longdouble),
        lambda v: [np.float64(x) for x in v],
        lambda v: np.array([*v, 0.0])[:2],
        lambda v: np.array([[x, 0] for x in v])[:, 0],
        lambda v: np.array(v, dtype=object),
        lambda v: np.ma.masked_array(v),
    ],
)
def test_results_in_any_common_form(form):
    expected = iv.solve_ivp(decay, (0, 1), [1, 1])
    sol = iv.solve_ivp(lambda t, y: form(decay(t, y)), (0, 1), [1, 1])
    np.testing.assert_array_equal(sol.y, expected.y)


def masked(values):
    return np.ma.masked_array(values, np.ones(np.shape(values)))


MASKED = [
    {"fun": lambda t, y: masked(decay(t, y))},
    {"fun": lambda t, y: masked(decay(t, y)), "vectorized": True},
    {"fun": lambda t, y: masked(decay(t, y)) if t > 0.5 else decay(t, y)},
    {"fun": lambda t, y: masked(decay(t, y)), "y0": [1, 1j]},
    {"events": lambda t, y: np.ma.masked},
    {"events": iv.Event(lambda t, y: y[0] - 0.9, action=lambda t, y: masked(y))},
    {"jac": lambda t, y: masked(-np.eye(2)) if t > 0 else -np.eye(2), "method": "ode23s"},
]


def test_masked_results_are_refused():
    """The number under a mask is no value."""
    for given in MASKED:
        with pytest.raises(ValueError, match="masked entries, which have no values"):
            iv.solve_ivp(**{"fun": decay, "t_span": (0, 1), "y0": [1, 1], **given})


@pytest.mark.parametrize("number", [float, np.float64, np.array, lambda v: [v], lambda v: np.array([v]), int])
def test_one_number(number):
    sol = iv.solve_ivp(
        lambda t, y: number(2), (0, 1), [0], events=lambda t, y: number(round(float(y[0]) - 0.99)), invariants=None
    )
    assert sol.y[0, -1] == pytest.approx(2)


def test_integers_and_big_integers():
    assert iv.solve_ivp(lambda t, y: [1, 10**30], (0, 1), [0, 0]).success


@explicit_and_implicit
def test_same_buffer_may_be_returned_every_time(method):
    buffer = np.empty(2)

    def fun(t, y):
        buffer[:] = decay(t, y)
        return buffer

    np.testing.assert_array_equal(
        iv.solve_ivp(fun, (0, 1), [1, 1], method).y, iv.solve_ivp(decay, (0, 1), [1, 1], method).y
    )


@explicit_and_implicit
@pytest.mark.parametrize("keep", [lambda y: y, lambda y: y[:1], memoryview, lambda y: y.T])
def test_arguments_may_be_kept(method, keep):
    """An array, a view of it or a memoryview that someone holds is never written to again."""
    kept, copies = [], []

    def fun(t, y):
        kept.append(keep(y))
        copies.append(y.copy())
        return decay(t, y)

    iv.solve_ivp(fun, (0, 1), [1, 1], method)
    for view, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(np.asarray(view), copy[: len(view)])


@explicit_and_implicit
def test_arguments_may_be_changed(method):
    """The array is the callee's: writing to it, resizing or locking it does not reach the solver."""

    def fun(t, y):
        result = decay(t, y)
        y[:] = np.nan
        y.resize((3, 1), refcheck=False)
        y.flags.writeable = False
        return result

    np.testing.assert_array_equal(
        iv.solve_ivp(fun, (0, 1), [1, 1], method).y, iv.solve_ivp(decay, (0, 1), [1, 1], method).y
    )


@families
def test_f_never_sees_what_is_not_finite(method):
    """A stage that overflows fails the attempt; f is not asked beyond."""
    seen = []

    def fun(t, y):
        seen.append(y.copy())
        return [np.inf] if y[0] > 2 else [y[0] ** 2]

    sol = iv.solve_ivp(fun, (0, 10), [1.0], method)
    assert sol.status == -1
    assert np.isfinite(seen).all()
    assert "component 0 of fun is NaN or infinite" in sol.message


@dealt(method=FAMILIES, bad=[np.nan, np.inf])
def test_f_that_is_not_finite(method, bad):
    at_start = iv.solve_ivp(lambda t, y: [1.0, bad], (0, 1), [0, 0], method)
    assert (at_start.status, at_start.success) == (-1, False)
    assert "component 1" in at_start.message
    assert at_start.t.tolist() == [0]
    np.testing.assert_array_equal(at_start.y[:, 0], [0, 0])
    later = iv.solve_ivp(lambda t, y: [1.0, bad if t > 0.5 else 1.0], (0, 1), [0, 0], method)
    assert later.status == -1
    assert later.t[-1] == pytest.approx(0.5)
    assert "component 1" in later.message
    passing = iv.solve_ivp(lambda t, y: [np.log(1e-3 - y[0]) if y[0] < 1e-3 else bad], (0, 1), [0.0], method)
    assert passing.status == 0  # only attempts that went too far were cut

    def overflow():
        return math.exp(1000)

    same = iv.solve_ivp(lambda t, y: [np.log(1e-3 - y[0]) if y[0] < 1e-3 else overflow()], (0, 1), [0.0], method)
    np.testing.assert_array_equal(same.y, passing.y)
    ending = iv.Problem(lambda t, y, last: [1.0 if t <= last else overflow()], (0, 1), [0.0], args=(0.5,))
    solver = ending.prepare(method)
    for last in (0.5, -1.0):
        with pytest.raises(OverflowError) as caught:  # what f raises wherever the run goes on comes out
            solver(args=(last,))
        assert traceback.extract_tb(caught.tb)[-1].name == "overflow"


WRONG_RESULTS = [
    (lambda t, y: [1.0], r"fun\(t, y\) returned shape \(1,\), expected shape \(2,\)"),
    (lambda t, y: np.ones((2, 2)), r"returned shape \(2, 2\), expected shape \(2,\)"),
    (lambda t, y: np.ones((2, 1)), r"returned shape \(2, 1\), expected shape \(2,\)"),
    (lambda t, y: 1.0, r"returned shape \(\), expected shape \(2,\)"),
    (lambda t, y: None, r"fun\(t, y\) returned None \(is a `return` missing\?\)"),
    (lambda t, y: (v for v in y), "returned a generator that is not an array of numbers"),
    (lambda t, y: [[1.0], [1.0, 2.0]], "returned a list that is not an array of numbers"),
]


@pytest.mark.parametrize(("fun", "message"), WRONG_RESULTS)
def test_wrong_shapes(fun, message):
    with pytest.raises(ValueError, match=message):
        iv.solve_ivp(fun, (0, 1), [1, 1])


@dealt(
    returned=["ab", ["a", "b"], [1j, 1.0], np.array([1, 1j]), {"a": 1}, [None, None], [1.0], np.ones((2, 2)), None],
    options=[{}, {"method": "rkn64", "second_order": True}],
)
def test_wrong_values_are_said_to_be_those_of_f(returned, options):
    """Wherever they are read: in the core, and before it in the test for second-order equations."""
    with pytest.raises((TypeError, ValueError), match=r"fun\(t, y\) return"):
        iv.solve_ivp(lambda t, y: returned, (0, 1), [1, 1], **options)
    if returned is None:
        with pytest.raises(ValueError, match=r"fun\(t, y\) returned None \(is a `return` missing\?\)"):
            iv.solve_ivp(lambda t, y: returned, (0, 1), [1, 1], vectorized=True, **options)


def test_complex_values_in_a_real_problem_say_what_to_do():
    with pytest.raises(TypeError, match="give a complex y0"):
        iv.solve_ivp(lambda t, y: 1j * y, (0, 1), [1.0, 1.0])


def test_wrong_shapes_of_invariants_and_jacobians():
    with pytest.raises(ValueError, match=r"invariant g returned shape \(1, 2\)"):
        iv.solve_ivp(decay, (0, 1), [1, 1], invariants=lambda t, y: np.ones((1, 2)))
    with pytest.raises(
        ValueError, match=r"Jacobian of invariant total returned shape \(2, 1\), expected shape \(1, 2\) or \(2,\)"
    ):
        iv.solve_ivp(decay, (0, 1), [1, 1], invariants=iv.Invariants(total, jac=lambda t, y: np.ones((2, 1))))
    shrinking = failing(10**9, lambda t, y: [1.0, 1.0] if t == 0 else [1.0])
    with pytest.raises(ValueError, match=r"returned shape \(1,\), expected shape \(2,\)"):
        iv.solve_ivp(decay, (0, 1), [1, 1], invariants=shrinking, check=False)


@explicit_and_implicit
def test_callback_is_called_after_each_step_and_stops(method):
    seen = []
    sol = iv.solve_ivp(decay, (0, 3), [1, 1], method, callback=lambda t, y: seen.append((t, *y)))
    assert sol.status == 0
    np.testing.assert_array_equal(np.array(seen).T, np.vstack([sol.t, sol.y])[:, 1:])
    stopped = iv.solve_ivp(decay, (0, 3), [1, 1], method, callback=lambda t, y: t > 1)
    assert stopped.status == 2
    assert stopped.success
    assert stopped.message == "The callback stopped the integration."
    assert stopped.t[-2] <= 1 < stopped.t[-1]


@explicit_and_implicit
def test_extra_arguments_reach_every_function(method):
    def fun(t, y, a, b):
        return [-a * y[0], -b * y[1]]

    def g(t, y, a, b):
        return y[0] ** (b / a) / y[1]

    def event(t, y, a, b):
        return y[0] - np.exp(-a)

    sol = iv.solve_ivp(fun, (0, 2), [1, 1], method, args=(0.5, 1.5), invariants=g, events=event, rtol=1e-8, atol=1e-10)
    assert sol.t_events[0][0] == pytest.approx(1, rel=1e-7 * slack(method))
    assert np.abs(sol.residual).max() < 1e-9
    many = iv.solve_ivp(lambda t, y, *a: [sum(a)], (0, 1), [0], args=range(20))
    assert many.y[0, -1] == pytest.approx(190)


@explicit_and_implicit
def test_nested_solves(method):
    """f may solve another problem: nothing is shared between runs."""

    def fun(t, y):
        inner = iv.solve_ivp(lambda s, z: [-z[0]], (0, 1), [y[0]], method, rtol=1e-8)
        return [-inner.y[0, -1]]

    sol = iv.solve_ivp(fun, (0, 1), [1.0], method, rtol=1e-6)
    assert sol.y[0, -1] == pytest.approx(np.exp(-np.exp(-1)), rel=1e-5)


@explicit_and_implicit
def test_runs_in_threads_do_not_disturb_each_other(method):
    problem = PROBLEMS["Kepler"]
    expected = problem.solve(method, rtol=1e-6)
    results = [None] * 6

    def work(i):
        results[i] = problem.solve(method, rtol=1e-6)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for result in results:
        np.testing.assert_array_equal(result.y, expected.y)


@explicit_and_implicit
def test_nothing_is_kept_alive(method):
    class Right:
        def __call__(self, t, y):
            return decay(t, y)

    fun = Right()
    alive = weakref.ref(fun)
    sol = iv.solve_ivp(fun, (0, 1), [1, 1], method, dense_output=True)
    dense = sol.sol
    del fun, sol  # a solution has its functions, for `extend`
    assert alive() is None
    assert dense(0.5).shape == (2,)


@explicit_and_implicit
@pytest.mark.parametrize("returned", [np.ones(2), np.zeros(0), np.ones((1, 2))], ids=lambda a: str(a.shape))
def test_an_array_is_neither_stop_nor_go_on(method, returned):
    with pytest.raises(ValueError, match=r"callback\(t, y\) returned an array of shape .*, expected True to stop"):
        iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0], method, callback=lambda t, y: returned)


@explicit_and_implicit
@pytest.mark.parametrize("complex_y0", [1.0, 1j])
def test_an_integer_beyond_the_range_of_a_double_is_the_functions_fault(method, complex_y0):
    with pytest.raises(ValueError, match=r"fun\(t, y\) returned an integer too large for a double"):
        iv.solve_ivp(lambda t, y: [10**400], (0, 1), [complex_y0], method)


def test_ctrl_c(tmp_path):
    """KeyboardInterrupt within 0.1 s of the next call of f."""
    script = tmp_path / "forever.py"
    script.write_text(
        textwrap.dedent("""
        import time
        import invariode as iv
        print("ready", flush=True)
        try:
            iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 1e12), [1, 0], rtol=1e-10, keep="end")
        except KeyboardInterrupt:
            print(time.time(), flush=True)
        """)
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.3)
    sent = time.time()
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert float(out) - sent < 2  # a generous bound: this is no timed test
    assert process.returncode == 0
