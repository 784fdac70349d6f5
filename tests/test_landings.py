"""Steps end where f switches as a function of t alone, whichever method, direction and kind of function."""

from __future__ import annotations

import copy
import itertools
import math
import sys
import types
import warnings
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import invariode as iv
from cases import FAMILIES, SERIES, dealt, families, families_and_series, hidden
from invariode._base.record import record_of
from invariode._functions.graph.plain import plain_graph, use_of_time
from invariode._functions.layout import layout_of
from invariode._sensitivity.landings import schedule_of

SPLINE = CubicSpline([0.0, 2.0, 5.0, 9.0, 12.0], [0.0, 1.0, -1.0, 0.5, 0.0])
STEPS = iv.Input([0.0, 1.0, 2.5, 4.0], [0.0, 1.0, -1.0, 0.5])
#: Functions of t on (0, 12), and where they, or their derivatives, jump.
SWITCHING = {
    "pulse": (lambda t: 3.0 if 1 <= t <= 1.5 else 0.0, [1, 1.5]),
    "periodic": (lambda t: 2.0 if t % 2.3 < 1.1 else 0.0, [2.3 * k + s for k in range(6) for s in (0, 1.1)]),
    "floor": (lambda t: math.floor(0.7 * t), [k / 0.7 for k in range(9)]),
    "ceil": (lambda t: np.ceil(-0.7 * t + 0.2), [(k + 0.2) / 0.7 for k in range(9)]),
    "remainder": (lambda t: (2 * t + 1) % 3.1, [(3.1 * k - 1) / 2 for k in range(9)]),
    "doses": (lambda t: 1.0 if t - 5 * math.floor(t / 5) < 0.3 else 0.0, [0.3, 5, 5.3, 10, 10.3]),
    "abs": (lambda t: abs(t - 3) + np.abs(np.sin(t)), [3, math.pi, 2 * math.pi, 3 * math.pi]),
    "limited": (lambda t: min(max(t - 2, 0.0), 3.0), [2, 5]),
    "table": (lambda t: np.interp(t, [0.0, 1.0, 2.5, 4.0], [0.0, 1.0, 1.0, 0.0]), [1, 2.5, 4]),
    "spline": (lambda t: SPLINE(t), [2, 5, 9]),
    "input": (lambda t: STEPS(t), [1, 2.5, 4]),
    "sine": (
        lambda t: 1.0 if np.sin(2 * t) > 0.3 else 0.0,
        [(x + 2 * math.pi * k) / 2 for k in range(4) for x in (math.asin(0.3), math.pi - math.asin(0.3))],
    ),
    "nested": (lambda t: 1.0 if t % 5 % 2 < 0.7 else 0.0, [0.7, 2, 2.7, 4, 4.7, 5, 5.7, 7, 7.7, 9, 9.7, 10, 10.7]),
    "heaviside": (lambda t: np.heaviside(t - 4, 0.5) * np.sign(t - 7), [4, 7]),
    "accelerating": (
        lambda t: 1.0 if t * t % 40 < 10 else 0.0,
        [math.sqrt(40 * k + s) for k in range(4) for s in (0, 10)],
    ),
}


#: Errors in tolerances; those of the trapezoidal rule are as large for u = 3 sin 2t.
FACTOR = {"ode23t": 30}


def exact(u, breaks, t0, y0, t, rate=0.5):
    """y' = u(t) − rate y from (t0, y0): by Gauss's formula between the breaks, where u is smooth."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    ends = np.unique(np.concatenate([[t0, t], [one for one in breaks if min(t0, t) < one < max(t0, t)]]))
    y = y0 * np.exp(-rate * (t - t0))
    for a, b in itertools.pairwise(ends if t >= t0 else ends[::-1]):
        parts = math.ceil(abs(b - a))
        for i in range(parts):
            low, high = a + (b - a) * i / parts, a + (b - a) * (i + 1) / parts
            s = 0.5 * (low + high) + 0.5 * (high - low) * nodes
            values = np.array([float(u(one)) for one in s])
            y += 0.5 * (high - low) * weights @ (values * np.exp(rate * (s - t)))
    return y


@dealt(method=[*FAMILIES, *SERIES], name=SWITCHING)
def test_values_are_those_of_the_exact_solution(method, name):
    """To ten tolerances, forwards and backwards, for Python and compiled functions, which take the same steps."""
    u, breaks = SWITCHING[name]
    for t0, tf, rate in ((0.0, 12.0, 2.0), (12.0, 0.0, -2.0)):

        def f(t, y, rate=rate):
            return [u(t) - rate * y[0]]

        inside = [one for one in breaks if 1e-9 < one < 12 - 1e-9]
        for rtol in (1e-3, 1e-6):
            atol = 1e-2 * rtol
            sols = [iv.solve_ivp(one, (t0, tf), [1.0], method, rtol=rtol, atol=atol) for one in (f, iv.compile(f))]
            y = exact(u, breaks, t0, 1.0, tf, rate)
            for sol in sols:
                assert abs(sol.y[0, -1] - y) <= FACTOR.get(method, 10) * (rtol * np.abs(sol.y).max() + atol)
                assert all(np.abs(sol.t - one).min() < 1e-12 * 12 for one in inside)
                assert sol.stats.discontinuities == ()


@families_and_series
def test_an_infusion_that_steps_would_pass_over(method):
    k = 0.1
    for kind in (iv.compile, lambda fun: fun):
        fun = kind(lambda t, X, k: [-k * X[0] + (3000.0 if 1 <= t <= 1.5 else 0.0)])
        sol = iv.solve_ivp(fun, (0, 30), [0.0], method, args=(k,))
        right = 3000 / k * (1 - math.exp(-0.5 * k)) * math.exp(-28.5 * k)
        assert sol.y[0, -1] == pytest.approx(right, rel=10 * 1e-3)


@dealt(method=[*FAMILIES, *SERIES], span=[(0, 10), (10, 0)])
def test_sensitivities_jump_at_times_that_depend_on_parameters(method, span):
    """∫ of 1.0 if t % p < q: 4 q + (10 − 4 p) at (p, q) = (2.3, 1.1)."""
    for kind in (iv.compile, lambda fun: fun):
        fun = kind(lambda t, y, p, q: [1.0 if t % p < q else 0.0])
        sol = iv.solve_ivp(fun, span, [0.0], method, args=(2.3, 1.1), sensitivities=True, adjoint=True, rtol=1e-6)
        sign = math.copysign(1, span[1] - span[0])
        assert sol.y[0, -1] == pytest.approx(sign * (4 * 1.1 + 10 - 4 * 2.3), rel=1e-9)
        assert sol.sensitivities[0, :, -1] == pytest.approx([-4 * sign, 4 * sign], rel=1e-9)
        assert sol.gradient([1.0]) == pytest.approx([-4 * sign, 4 * sign], rel=1e-9)


@families
def test_sensitivities_to_the_times_of_a_dose(method):
    """y' = a u(t) − k y with u = 1 from b to b + d: closed forms."""
    a, b, d, k, tf = 2.0, 1.3, 0.6, 0.4, 6.0
    value = lambda a, b, d, k: a / k * (np.exp(-k * (tf - b - d)) - np.exp(-k * (tf - b)))  # noqa: E731
    p = np.array([a, b, d, k])
    right = [np.imag(value(*(p + 1e-30j * one))) / 1e-30 for one in np.eye(4)]
    fun = lambda t, y, a, b, d, k: [(a if b < t < b + d else 0.0) - k * y[0]]  # noqa: E731
    sol = iv.solve_ivp(fun, (0, tf), [0.0], method, args=(a, b, d, k), rtol=1e-7, sensitivities=True, adjoint=True)
    assert sol.sensitivities[0, :, -1] == pytest.approx(right, abs=1e-4)
    assert sol.gradient([1.0]) == pytest.approx(right, abs=1e-4)


def test_landings_are_generated_as_the_run_proceeds():
    """83 334 doses of two hours a day: y' = u − y/10, periodic, so that the last value is known."""
    fun = iv.compile(lambda t, y: [(1.0 if t % 24 < 2 else 0.0) - 0.1 * y[0]])
    sol = iv.solve_ivp(fun, (0, 1e6), [0.0], "ode23", rtol=1e-4, atol=1e-8, keep="end")
    day = math.exp(-2.4)
    at_zero = 10 * (1 - math.exp(-0.2)) * math.exp(-2.2) / (1 - day)  # at the beginning of each day
    hours = 1e6 % 24
    right = (at_zero * math.exp(-0.2) + 10 * (1 - math.exp(-0.2))) * math.exp(-0.1 * (hours - 2))
    assert sol.y[0, -1] == pytest.approx(right, rel=1e-3)
    assert sol.stats.steps >= 2 * 41666


@pytest.mark.filterwarnings("ignore::invariode.DiscontinuityWarning")  # what then happens in the run
def test_conditions_that_change_too_often_are_named():
    for fun in (lambda t, y: [1.0 if t % 1e-9 < 5e-10 else 0.0], lambda t, y: [math.floor(1e9 * t) % 2]):
        with pytest.warns(iv.AccuracyWarning, match=r"(modulo|floor).* changes about .* times between t0 and tf"):
            iv.solve_ivp(fun, (0, 1e6), [0.0], max_steps=3, on_failure="return")


COUNT = 0


def test_functions_whose_tracing_could_be_noticed_are_not_traced():
    """Such functions write to what is not theirs, call what is not known, or read what may have effects."""
    seen, table, settings = [0], {}, types.SimpleNamespace(last=2.0)
    array, counts = np.zeros(3), np.zeros(2, dtype=int)

    class Recorder:
        def __init__(self):
            self.times, self.last = [], 3.0

        def seen(self, t):
            self.times.append(t)
            return t

        @property
        def counted(self):
            self.times[:] = [*self.times, 1]
            return 3.0

    class Aware(Recorder):
        def __getattribute__(self, name):
            seen.append(name)
            return object.__getattribute__(self, name)

    class Sized(dict):
        pass

    recorder, aware, sized = Recorder(), Aware(), Sized(a=3.0)

    def counting(t, y):
        seen[0] += 1
        return [1.0 if t < 3 else 0.0]

    def nonlocal_one(t, y):
        nonlocal array
        array = array + 1
        return [1.0 if t < 3 else 0.0]

    def global_one(t, y):
        global COUNT
        COUNT += 1
        return [1.0 if t < 3 else 0.0]

    def remembering(t, y):
        table[t] = y
        return [1.0 if t < 3 else 0.0]

    def appending(t, y):
        seen.append(t)
        return [1.0 if t < 3 else 0.0]

    def filling(t, y):
        np.add(array, 1, out=array)
        return [1.0 if t < 3 else 0.0]

    def counting_in_array(t, y):
        counts[0] += 1
        return [1.0 if t < 3 else 0.0]

    def counting_later(t, y):
        if t < 3:
            counts[:] = counts + 1
        return [1.0 if t < 3 else 0.0]

    def aliased(t, y):
        mine = array
        mine += 1
        return [1.0 if t < 3 else 0.0]

    def of_objects(t, y):
        return [1.0 if recorder.seen(t) < 3 else 0.0]

    def of_properties(t, y):
        return [1.0 if t < recorder.counted else 0.0]

    def of_aware_objects(t, y):
        return [1.0 if t < aware.last else 0.0]

    def of_a_derived_dict(t, y):
        return [1.0 if t < sized["a"] else 0.0]

    def of_a_call(t, y):
        recorder.times.append(t)
        return [1.0 if t < 3 else 0.0]

    def writing(t, y):
        np.copyto(array, 1.0)
        return [1.0 if t < 3 else 0.0]

    def setting(t, y):
        settings.last = t
        return [1.0 if t < 3 else 0.0]

    def printing(t, y):
        print(t)
        return [1.0 if t < 3 else 0.0]

    def random_one(t, y):
        return [np.random.default_rng().normal() if t < 3 else 0.0]

    def calling(t, y):
        return counting(t, y)

    for fun in (
        *(counting, nonlocal_one, global_one, remembering, appending, filling, aliased, setting, printing, random_one),
        *(
            counting_in_array,
            counting_later,
            calling,
            of_objects,
            of_properties,
            of_aware_objects,
            of_a_derived_dict,
            of_a_call,
            writing,
        ),
    ):
        before = copy.deepcopy((seen, table, vars(settings), array.tolist(), counts.tolist(), COUNT, recorder.times))
        assert use_of_time(fun) != "switches" or plain_graph(fun, 1, layout_of(())) is None
        assert before == (seen, table, vars(settings), array.tolist(), counts.tolist(), COUNT, recorder.times)


FROM, TO = 40.0, 40.5
#: With others after the end.
PULSES = [(FROM + 100 * k, TO + 100 * k) for k in range(30)]


def between(t, times):
    return 1.0 if times[0] <= t < times[1] else 0.0


class Held:
    """Times as attributes of an object, one of them as a property; what it does besides cannot be traced."""

    from_ = FROM

    def __init__(self):
        self.length, self.stream, self.parts = TO - FROM, sys.stdout, {"times": np.array([FROM, TO])}

    @property
    def to(self):
        return self.from_ + self.length

    def pulse(self, t):
        return 1.0 if self.from_ <= t < self.to else 0.0

    def of_table(self, t):
        return between(t, self.parts["times"])

    def __call__(self, t):
        return self.pulse(t)

    def show(self):
        try:
            print(self, file=self.stream)
        finally:
            self.stream.flush()


class Space:
    low, high = FROM, TO


@dataclass(slots=True)
class Slotted:
    low: float
    high: float


class Named(NamedTuple):
    low: float
    high: float


def ways():
    """A pulse by all ways of holding its times: a function of t and further arguments, and these arguments."""
    held, table, simple = Held(), {"times": [FROM, TO]}, types.SimpleNamespace(low=FROM, high=TO, at=np.array([FROM]))
    by_name = {"record": record_of({"low": FROM, "high": TO}), "tuple": Named(FROM, TO), "slots": Slotted(FROM, TO)}
    by_name |= {"namespace": simple, "class": Space}
    columns = np.array([(FROM, TO)], dtype=[("low", float), ("high", float)])
    pair, given, doubled = (held.pulse, held), {"times": (FROM, TO)}, np.array([80, 81])
    yield "numbers", lambda t, a, b: 1.0 if a <= t < b else 0.0, (FROM, TO)
    yield "a dict", lambda t: between(t, table["times"]), ()
    yield "an array of integers", lambda t: between(t, doubled / 2), ()
    yield "a dict among args", lambda t, of: between(t, of["times"]), (table,)
    yield "a tuple of functions", lambda t, of=pair: of[0](t) * of[1](t), ()
    yield "a dict of keywords", lambda t: between(t, **given), ()
    yield "a method", held.pulse, ()
    yield "an array of an object", held.of_table, ()
    yield "an object that is called", held, ()
    yield "an array of a namespace", lambda t: 1.0 if simple.at[0] <= t < simple.at[0] + 0.5 else 0.0, ()
    yield "a partial function", partial(between, times=(FROM, TO)), ()
    yield "any", lambda t: 1.0 if any(a <= t < b for a, b in PULSES) else 0.0, ()
    yield "all", lambda t: 0.0 if all(t < a or t >= b for a, b in PULSES) else 1.0, ()
    yield "sum", lambda t: 1.0 * sum(a <= t < b for a, b in PULSES), ()
    yield "next", lambda t: next((1.0 for a, b in PULSES[:1] if a <= t < b), 0.0), ()
    yield "piecewise", lambda t: np.piecewise(t, [(a <= t) & (t < b) for a, b in PULSES], [1.0] * len(PULSES)), ()
    yield "functions of piecewise", lambda t: np.piecewise(t, (t >= FROM) & (t < TO), [lambda s: s / s, 0.0]), ()
    yield "columns", lambda t: 1.0 if columns["low"][0] <= t < columns["high"][0] else 0.0, ()
    yield "columns among args", lambda t, of: 1.0 if of["low"][0] <= t < of["high"][0] else 0.0, (columns,)
    yield "a table", iv.Input([0.0, FROM, TO], [0.0, 1.0, 0.0]), ()
    for name, one in by_name.items():
        yield f"attributes: {name}", lambda t, of=one: 1.0 if of.low <= t < of.high else 0.0, ()
        yield f"attributes among args: {name}", lambda t, of: 1.0 if of.low <= t < of.high else 0.0, (one,)


#: Solutions at 100 of y' = u, by each function that takes u, and what they are for a pulse of length 1/2 at 40.
FACES = {
    "solve_ivp": (lambda f, g, args, m: iv.solve_ivp(f, (0, 100), [0.0], m, args=args).y[0, -1], 0.5),
    "partial": (lambda f, g, args, m: iv.solve_ivp(partial(f), (0, 100), [0.0], m, args=args).y[0, -1], 0.5),
    "compile": (lambda f, g, args, m: iv.solve_ivp(iv.compile(f), (0, 100), [0.0], m, args=args).y[0, -1], 0.5),
    "prepare": (lambda f, g, args, m: iv.Problem(f, (0, 100), [0.0], args=args).prepare(m)().y[0, -1], 0.5),
    "ensemble": (
        lambda f, g, args, m: iv.solve_ensemble(f, (0, 100), [[0.0], [1.0]], m, args=args, workers=1).y_end[0, 0],
        0.5,
    ),
    "odeint": (lambda f, g, args, m: iv.odeint(lambda y, t, *p: f(t, y, *p), [0.0], [0, 100.0], args)[-1, 0], 0.5),
    "ode": (
        lambda f, g, args, m: (
            iv.ode(f).set_integrator("dop853").set_f_params(*args).set_initial_value([0.0], 0.0).integrate(100.0)[0]
        ),
        0.5,
    ),
    "delays": (
        lambda f, g, args, m: iv.solve_ivp(
            lambda t, y, z, *p: f(t, y, *p), (0, 100), [0.0], m, args=args, delays=9, history=0
        ).y[0, -1],
        0.5,
    ),
    "inputs": (
        lambda f, g, args, m: (
            iv.Problem(
                lambda t, y, u, *p: [u * f(t, y, *p)[0]], (0, 100), [0.0], args=args, inputs=iv.Input([0], [2.0])
            )
            .solve(m)
            .y[0, -1]
        ),
        1.0,
    ),
    "SecondOrder": (
        lambda f, g, args, m: iv.solve_ivp(iv.SecondOrder(f), (0, 100), [0.0, 0], m, args=args).y[1, -1],
        0.5,
    ),
    "rkn86": (
        lambda f, g, args, m: iv.solve_ivp(iv.SecondOrder(f), (0, 100), [0, 0.0], "rkn86", args=args).y[1, -1],
        0.5,
    ),
    "solve_dae": (
        lambda f, g, args, m: iv.solve_dae(
            lambda t, y, yp, *p: [yp[0] - f(t, y, *p)[0]], (0, 100), [0.0], args=args, method=m
        ).y[0, -1],
        0.5,
    ),
    "force": (
        lambda f, g, args, m: iv.MechanicalSystem([1], g, args=args).problem((0, 100), [0], [0]).solve(m).y[1, -1],
        0.5,
    ),
    "mass": (
        lambda f, g, args, m: (
            iv.MechanicalSystem(lambda t, q, *p: [[1 + f(t, q, *p)[0]]], lambda t, q, v, *p: [1.0], args=args)
            .problem((0, 100), [0], [0])
            .solve(m)
            .y[1, -1]
        ),
        99.75,
    ),
    "kinematics": (
        lambda f, g, args, m: (
            iv.MechanicalSystem([1], lambda t, q, v, *p: [0.0], kinematics=g, args=args)
            .problem((0, 100), [0], [0])
            .solve(m)
            .y[0, -1]
        ),
        0.5,
    ),
}


def test_a_switch_in_time_is_a_landing_by_whatever_function_it_enters():
    """A pulse of any function that a run calls as f is seen, wherever the function holds its times. A function is read
    before it is known who calls it, so each way meets a third of the callers, and each caller a third of the ways."""
    lost = []
    for i, (way, u, args) in enumerate(ways()):
        for k, (face, (solve, right)) in [*enumerate(FACES.items())][i % 3 :: 3]:
            found = solve(
                lambda t, y, *p, u=u: [u(t, *p)],
                lambda t, q, v, *p, u=u: [u(t, *p)],
                args,
                ("ode45", "radau")[(i // 3 + k) % 2],
            )
            if not abs(found - right) <= 2e-6 * right:
                lost.append((way, face, found))
    assert not lost


def test_a_table_with_names_is_one_of_its_columns():
    """Runs are the same, bit for bit, whether a table is read as one array with names or as two arrays."""
    times = np.linspace(0.0, 9.0, 37)
    table = np.zeros(37, dtype=[("t", float), ("u", float)])
    table["t"], table["u"] = times, np.sin(times**2)
    of_table = iv.ode45(lambda t, y: [np.interp(t, table["t"], table["u"]) - y[0]], (0, 9), [0.0], rtol=1e-8)
    of_columns = iv.ode45(lambda t, y: [np.interp(t, times, np.sin(times**2)) - y[0]], (0, 9), [0.0], rtol=1e-8)
    assert np.array_equal(of_table.y, of_columns.y)
    assert np.isin(times, of_table.t).all()


def test_a_function_is_traced_for_what_it_uses_when_it_runs():
    """Closures, helpers and lists have their values of that moment."""
    times = [1.0, 2.0]

    def rate(t):
        return 5.0 if times[0] < t < times[1] else 0.0

    def fun(t, y):
        return [rate(t)]

    assert iv.solve_ivp(fun, (0, 10), [0.0]).y[0, -1] == pytest.approx(5, rel=1e-9)
    times[:] = [3.0, 7.0]
    assert iv.solve_ivp(fun, (0, 10), [0.0]).y[0, -1] == pytest.approx(20, rel=1e-9)


@families_and_series
def test_runs_go_on_bit_for_bit(method, tmp_path):
    """Interrupted anywhere, extended, and loaded from a file."""

    @iv.compile
    def fun(t, y):
        return [y[1], -y[0] + (1.0 if t % 0.7 < 0.2 else 0.0) * (2.0 if t < 3.0 else 1.0)]

    problem = iv.Problem(fun, (0, 8), [1.0, 0.0])
    whole = problem.solve(method, rtol=1e-6)
    for steps in (1, 7, whole.stats.steps // 2):
        part = problem.solve(method, rtol=1e-6, max_steps=steps, on_failure="return")
        part.save(tmp_path / "part.npz")
        for sol in (part, iv.load(tmp_path / "part.npz", problem)):
            sol = sol.extend(8, max_steps=100_000)
            assert np.array_equal(sol.t, whole.t)
            assert np.array_equal(sol.y, whole.y)
            assert dict(sol.stats) == dict(whole.stats)


@families_and_series
def test_ensembles_and_prepared_solvers_do_the_same(method):
    """The law holds where each row has its own times."""
    fun = iv.compile(lambda t, y, p: [(1.0 if t % p < 0.5 else 0.0) - y[0]])
    rows = np.array([[1.1], [2.3], [3.7]])
    many = iv.solve_ensemble(fun, (0, 9), [0.3], method, args=rows, rtol=1e-5, workers=1)
    problem = iv.Problem(fun, (0, 9), [0.3], args=(1.0,))
    prepared = problem.prepare(method, rtol=1e-5)
    for i, row in enumerate(rows):
        alone = problem.replace(args=tuple(row)).solve(method, rtol=1e-5)
        assert np.array_equal(many.y_end[i], alone.y[:, -1])
        again = prepared(args=tuple(row))
        assert np.array_equal(again.t, alone.t)
        assert np.array_equal(again.y, alone.y)
    fixed = iv.compile(lambda t, y, p: [p * (1.0 if t % 2 < 0.5 else 0.0) - y[0]])
    together = iv.solve_ensemble(fixed, (0, 9), [0.3], method, args=rows, rtol=1e-5, workers=2)
    for i, row in enumerate(rows):
        alone = iv.solve_ivp(fixed, (0, 9), [0.3], method, args=tuple(row), rtol=1e-5)
        assert np.array_equal(together.y_end[i], alone.y[:, -1])


@families
def test_landings_meet_everything_else(method):
    """Events, actions, breakpoints with doses, bounds, invariants and output times on landings: y' = −y/2 + u(t)."""
    u = lambda t: 2.0 if t % 4 < 1 else 0.0  # noqa: E731
    breaks = [0, 1, 4, 5, 8, 9]
    problem = iv.Problem(
        lambda t, y: [(2.0 if t % 4 < 1 else 0.0) - 0.5 * y[0], 1.0, -y[2] + y[3], y[2] - y[3]],
        (0, 10),
        [0.5, 0.0, 1.0, 2.0],
        events=iv.Event(lambda t, y: y[1] - 5.0, action=lambda t, y: [y[0] + 1.0, *y[1:]]),
        invariants=iv.Invariants(lambda t, y: y[2] + y[3], jac=lambda t, y: [[0, 0, 1.0, 1.0]]),
        nonnegative=True,
    )
    dose = lambda t, y: [y[0] + 3.0, *y[1:]]  # noqa: E731
    times = [0.0, 1.0, 4.0, 5.0, 6.5, 10.0]
    sol = problem.solve(method, rtol=1e-6, atol=1e-8, breakpoints={4.0: dose}, t_eval=times, dense_output=True)
    y4 = exact(u, breaks, 0, 0.5, 4.0) + 3
    y5 = exact(u, breaks, 4, y4, 5.0) + 1
    assert sol.t_events[0] == pytest.approx([5.0], abs=1e-9)
    at = dict(zip(sol.t.tolist(), sol.y[0].tolist(), strict=True))
    assert at[1.0] == pytest.approx(exact(u, breaks, 0, 0.5, 1.0), abs=1e-4)
    assert at[6.5] == pytest.approx(exact(u, breaks, 5, y5, 6.5), abs=1e-4)
    assert at[10.0] == pytest.approx(exact(u, breaks, 5, y5, 10.0), abs=1e-4)
    assert sol.sol(3.3)[0] == pytest.approx(exact(u, breaks, 0, 0.5, 3.3), abs=1e-4)
    assert sol.y[2] + sol.y[3] == pytest.approx(3, abs=1e-9)


def test_a_mass_matrix_and_algebraic_equations():
    """Algebraic variables jump with their equations."""
    for method in ("ode15s", "radau", "ode23t"):
        sol = iv.solve_ivp(
            lambda t, y: [-y[0] + y[1], y[1] - (2.0 if t >= 1.5 else 1.0)],
            (0, 3),
            [0.0, 1.0],
            method,
            mass=np.diag([1.0, 0.0]),
            rtol=1e-6,
            atol=1e-8,
        )
        right = (1 - math.exp(-1.5)) * math.exp(-1.5) + 2 * (1 - math.exp(-1.5))
        assert sol.y[:, -1] == pytest.approx([right, 2.0], abs=1e-4)


def test_where_nothing_is_known_runs_are_as_before():
    """A function hidden from tracing takes the steps it took, and f is called as often as it is counted."""
    calls = []

    def fun(t, y):
        calls.append(t)
        return [-y[0] + (1.0 if t < 2 else 0.0)]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", iv.DiscontinuityWarning)
        sol = iv.solve_ivp(hidden(fun), (0, 10), [1.0], rtol=1e-6)
        assert len(calls) == sol.nfev + sol.stats.nfev_check
        same = iv.solve_ivp(fun, (0, 10), [1.0], rtol=1e-6)
    assert np.array_equal(sol.t, same.t)


def test_times_are_doubles_that_people_write():
    """If a line or a period leads to a double exactly, that is the landing."""
    problem = iv.Problem(lambda t, y: [1.0 if 1 <= t <= 1.5 or t % 24 < 2 else np.floor(t / 7)], (0, 100), [0.0])
    times = schedule_of(problem, layout_of(())).landings.apart(0, 100, np.zeros(0))
    expected = sorted({1, 1.5, *range(0, 100, 24), *range(2, 100, 24), *range(0, 100, 7)})
    assert np.array_equal(times, expected)


@pytest.mark.parametrize("method", ["ode45", "ode15s", "radau"])
def test_a_pulse_of_a_table_that_fun_calls_is_seen(method):
    """A table of its own in a closure or among the arguments is seen like one among the inputs, though f does not
    compare anything."""
    values = np.zeros(1001)
    values[500] = 1.0
    pulse = iv.Input(np.linspace(0, 100, 1001), values)
    runs = [
        iv.solve_ivp(lambda t, y: [pulse(t)], (0, 100), [0.0], method),
        iv.solve_ivp(lambda t, y, u: [u(t)], (0, 100), [0.0], method, args=(pulse,)),
        iv.Problem(lambda t, y, u: [u], (0, 100), [0.0], inputs=pulse).solve(method),
    ]
    assert [sol.y[0, -1] for sol in runs] == pytest.approx([0.1] * 3, rel=1e-6)
