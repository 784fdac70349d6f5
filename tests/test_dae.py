"""Solutions of differential-algebraic equations of any index satisfy all hidden constraints."""

from __future__ import annotations

import pickle
import re

import numpy as np
import pytest

import invariode as iv
from dae_problems import (
    GRAVITY,
    PROBLEMS,
    chain,
    crane_solution,
    opaque,
    pendula,
    reactor_solution,
    transistors,
)
from invariode._base.arguments import EPS
from invariode._dae.expressions import Values
from invariode._functions.graph.differentiation import jacobian
from invariode._functions.graph.rounding import bounds

pytestmark = pytest.mark.filterwarnings("ignore:initial values were moved")


def off_constraints(sol: iv.Solution, most: int = 25) -> float:
    """The largest residual of all constraints at `most` of the outputs, in units of a bound of its roundoff: that of
    its operations, and of the rounding of what they are applied to."""
    origin = sol._origin
    p, worst = np.array(origin.source.problem.args), 0.0
    for level in origin.reduction.levels:
        rows = jacobian(level.in_states, [origin.reduction.graph.y(k) for k in range(len(origin.reduction.states))])
        entries = [(i, k, node) for i, row in enumerate(rows) for k, node in row.items()]
        values, slopes = Values(level.in_states), Values([node for *_, node in entries])
        for at in np.unique(np.linspace(0, len(sol.t) - 1, most).astype(int)):
            t, state = float(sol.t[at]), origin.reduced.y[:, at]
            error = np.array(bounds(level.in_states, t, state.tolist(), p.tolist())) + 1e-30
            for (i, k, _), slope in zip(entries, slopes(t, state, p), strict=True):
                error[i] += EPS * abs(slope * state[k])
            worst = max(worst, float((np.abs(values(t, state, p)) / error).max()))
    return worst


# ----------------------------------------------------------------------------------------------------------------------
# Solutions


def test_solutions_agree_with_references():
    """The problems that have one, with a method that suits them, at its tolerance; all derivatives satisfy F."""
    cases = {
        "pendulum": ("dop853", 1e-8, 1e-7),
        "two pendula": ("radau", 1e-8, 1e-8),
        "squeezer": ("dop853", 1e-8, 1e-8),
        "car axis": ("radau", 1e-6, 1e-7),
        "transistors": ("radau", 1e-8, 1e-8),
        "akzo": ("radau", 1e-6, 1e-6),
        "robertson": ("radau", 1e-6, 1e-6),
        "weissinger": ("dop853", 1e-8, 1e-9),
    }
    for name, (method, rtol, error) in cases.items():
        problem = PROBLEMS[name]
        sol = problem.solve(method, rtol, 1e-14 if name == "robertson" else None)
        assert sol.success, name
        assert problem.error(sol) <= error, name
        if problem.order == 1:
            left = [problem.F(t, y, yp) for t, y, yp in zip(sol.t, sol.y.T, sol.yp.T, strict=True)]
            assert np.abs(left).max() < 1e-6 * max(1, np.abs(sol.yp).max()), name


def test_prescribed_motion_has_no_error_whatever_the_tolerance():
    for name, exact in (("crane", crane_solution), ("reactor", reactor_solution), ("robot arm", None)):
        problem = PROBLEMS[name]
        sol = problem.solve("dop853", 1e-4)
        assert problem.error(sol) <= 1e-13
        if exact is not None:
            expected = np.array([exact(t) for t in sol.t]).T
            assert (np.abs(sol.y - expected) / np.maximum(np.abs(expected), 1e-2)).max() < 1e-13
    times = np.linspace(0, 3, 7)  # no state at all
    sol = PROBLEMS["Gear and Petzold"].solve("dop853", 1e-4, t_eval=times)
    np.testing.assert_allclose(sol.y, [np.exp(-times) - 0.7 * times * np.cos(times), np.cos(times)], atol=1e-14)
    np.testing.assert_allclose(sol.yp[1], -np.sin(times), atol=1e-14)


@pytest.mark.slow
def test_all_constraints_are_satisfied_to_roundoff_by_every_method_at_every_tolerance():
    """At the steps and between them, in units of a bound of roundoff; index 3 to 9."""
    cases = [PROBLEMS["pendulum"], PROBLEMS["two pendula"], PROBLEMS["squeezer"], pendula(4)]
    methods = [name for name, one in iv.METHODS.items() if one.equations != "second-order"]
    for k, method in enumerate(methods):
        rtol = (1e-3, 1e-6, 1e-5)[k % 3]
        sol = cases[k % len(cases)].solve(method, rtol, refine=2)
        assert sol.success
        assert off_constraints(sol, 10) <= 10, (method, rtol)


def test_constraints_that_switch_with_t():
    """Unknowns that t alone determines follow, from tables too, also from one that begins with the run, in a run, in
    its extension and as a problem, with their sensitivities. Any other constraint that jumps ends the run there, and
    the message names it."""

    def follow(t, y, yp, rate):
        x, v, force = y
        return [yp[0] - v, yp[1] - force, x - np.minimum(rate * t, 1.0)]

    times = np.linspace(0, 2, 21)
    path = np.sin(times)

    def track(t, y, yp, table):
        return [yp[0] + y[0] - y[1], y[0] - table(t)]

    for method in ("dop853", "radau"):
        given = {"args": (0.8,), "method": method}
        sol = iv.solve_dae(follow, (0, 2), [0, 1, 0], t_eval=[1, 1.5], sensitivities=True, **given)
        np.testing.assert_allclose(sol.y, [[0.8, 1], [0.8, 0], [0, 0]], atol=1e-14)
        np.testing.assert_allclose(sol.sensitivities[:, 0], [[1, 0], [1, 0], [0, 0]], atol=1e-14)
        part = iv.solve_dae(follow, (0, 1), [0, 1, 0], **given)
        problem = iv.Dae(follow, 0, [0, 1, 0], args=(0.8,)).problem((0, 2))
        for other in (part.extend(2), problem.solve(method)):
            np.testing.assert_allclose(other.y_end[:2], [1, 0], atol=1e-14)
            assert 1.25 in other.t
        for table in (iv.Input(times, path, "linear"), lambda t: np.interp(t, times, path)):
            sol = iv.solve_dae(track, (0, 2), [0, 0], args=(table,), method=method, t_eval=[0.05, 1.05])
            slopes = np.diff(path)[[0, 10]] / 0.1
            values = np.interp([0.05, 1.05], times, path)
            np.testing.assert_allclose(sol.y, [values, values + slopes], atol=1e-12)
    with pytest.raises(iv.InvariantError, match=r"F\[2\] = 0 jumps by 2 right after the start, .* such as t >= 0"):
        iv.solve_dae(
            lambda t, y, yp: [yp[0] - y[1], yp[2] + y[2] - y[1], y[0] - np.where(t > 0, 1.0, -1.0)], (0, 1), [1, 0, 1]
        )
    sol = iv.solve_dae(
        lambda t, y, yp: [yp[0] - y[1], yp[1] - y[2], y[0] - (0.0 if t < 1 else 0.5), yp[3] - y[0]],
        (0, 2),
        [0, 0, 0, 0],
        on_failure="return",
    )
    assert sol.status < 0
    assert sol.t_end == pytest.approx(1, abs=1e-12)
    assert re.search(r"F\[2\] = 0 jumps there by 0\.5, which takes an impulse", sol.message)


def test_tables_of_inputs_are_traced():
    """An Input in F, of each kind and of several columns, gives the solution of solve_ivp with it."""
    times = np.linspace(0, 2, 9)
    for kind in ("previous", "linear", "cubic"):
        for values in (np.cos(times), np.stack([np.cos(times), times], axis=1)):
            u = iv.Input(times, values, kind)
            given = {"rtol": 1e-9, "atol": 1e-11, "method": "dop853"}
            expected = iv.solve_ivp(
                lambda t, y, u: [np.sum(u(t)) - y[0]], (0, 2), [0], args=(u,), breakpoints=times, **given
            )
            sol = iv.solve_dae(
                lambda t, y, yp, u: [yp[0] + y[0] - y[1], y[1] - np.sum(u(t))], (0, 2), [0, 0], args=(u,), **given
            )
            assert sol.y_end[0] == pytest.approx(expected.y_end[0], rel=1e-7)


def test_roundoff_of_cancellation_is_no_violation():
    """The check accepts a voltage that is a difference of nearly equal ones, at times far beyond the time constant."""
    slow = iv.solve_dae(
        lambda t, y, yp: [
            (np.sin(t / 1e12) - y[0]) / 1e3 - 1e-6 * (yp[0] - yp[1]),
            1e-6 * (yp[0] - yp[1]) - y[1] / 1e3,
        ],
        (0, 1e12),
        [0, 0],
        rtol=1e-6,
        atol=1e-9,
    )
    assert slow.success
    np.testing.assert_allclose(slow.y_end, [np.sin(1), 0], atol=1e-8)


def test_a_first_order_form_is_solved_as_the_second_order_form():
    """u = x' renames, so that the states, the steps and the digits are the same."""
    for method in ("dop853", "radau", "ode15s"):
        one, two = (PROBLEMS[name].solve(method, 1e-6) for name in ("pendulum", "pendulum, first order"))
        assert one.nfev == two.nfev
        np.testing.assert_array_equal(one.y, two.y[[0, 1, 4]])
        np.testing.assert_array_equal(one.yp[:2], two.y[2:4])


def test_equations_that_are_not_linear_in_what_they_determine():
    """They are algebraic equations for methods that take a singular mass matrix, and differentiated for the others."""
    problem = PROBLEMS["resistor"]
    reference = problem.solve("radau", 1e-11).y[:, -1]
    for method in ("dop853", "taylor", "radau", "ode15s", "auto"):
        sol = problem.solve(method, 1e-7)
        np.testing.assert_allclose(sol.y[:, -1], reference, atol=1e-5)
        assert sol.reduced.y.shape[0] == 2
    short = iv.solve_dae(
        PROBLEMS["ring modulator"].F, (0, 5e-5), np.zeros(15), method="radau", rtol=1e-4, atol=1e-6, keep="end"
    )
    assert short.success


def test_large_systems_are_sparse():
    """A chain agrees with MechanicalSystem; index 9, whose Jacobian is formed by products, with dop853."""
    links = 30
    problem = chain(links, end=0.1)
    sol = problem.solve("dop853", 1e-6)

    def force(t, q, v):
        return np.tile([0, -GRAVITY], links)

    def lengths(t, q):
        d = np.concatenate([q[:2], q[2:] - q[:-2]])
        return (d[::2] ** 2 + d[1::2] ** 2 - 1 / links**2) / 2

    q0 = np.asarray(problem.y0)[: 2 * links]
    system = iv.MechanicalSystem(np.ones(2 * links), force, lengths).problem((0, 0.1), q0, 0 * q0)
    expected = system.solve("dop853", rtol=1e-6, atol=1e-8)
    assert sol.nfev == expected.nfev
    np.testing.assert_allclose(sol.y[: 2 * links, -1], expected.y[: 2 * links, -1], atol=1e-12)

    a, b = (pendula(4).solve(method, rtol).y[:, -1] for method, rtol in (("dop853", 1e-6), ("radau", 1e-8)))
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


# ----------------------------------------------------------------------------------------------------------------------
# Neighbours


def swing(t, y, yp, ypp, g, length):
    return [ypp[0] + y[0] * y[2], ypp[1] + y[1] * y[2] + g, y[0] ** 2 + y[1] ** 2 - length**2]


NAMED = {"order": 2, "names": ["x", "z", "tension"], "args": (GRAVITY, 1.0), "rtol": 1e-9, "atol": 1e-11}


def swung(end=2.0, **options):
    return iv.solve_dae(swing, (0, end), [1, 0, 0], **{**NAMED, "method": "dop853", **options})


def test_events_are_functions_of_the_unknowns():
    def at_bottom(t, y, g, length):
        return y[0]

    sol = swung(events=at_bottom)
    assert sol.y_events[0].shape == (len(sol.t_events[0]), 3)
    np.testing.assert_allclose(sol.y_events[0], [[0, -1, 3 * GRAVITY]] * len(sol.t_events[0]), atol=1e-7)
    ended = swung(events=iv.Event(at_bottom, terminal=True))
    assert ended.status == 1
    assert ended.t_end == sol.t_events[0][0]
    gone_on = ended.extend(2.0)
    assert gone_on.t_end == pytest.approx(sol.t_events[0][1], abs=1e-8)


def test_actions_change_unknowns_and_derivatives():
    """An elastic wall at x = 0 reflects the velocity; the motion is that from the other side, mirrored."""

    def wall(t, y, g, length):
        return y[0]

    t_hit = swung(events=wall).t_events[0][0]
    velocity = {}

    def bounce(t, y, g, length):
        velocity["before"] = -np.sqrt(2 * g)
        return y, [np.sqrt(2 * g), 0, 0]

    sol = swung(2 * t_hit - 1e-3, events=iv.Event(wall, direction=-1, action=bounce))
    plain = swung(2 * t_hit - 1e-3)
    np.testing.assert_allclose(sol.y[:, -1], plain.y[:, -1] * [-1, 1, 1], atol=1e-6)
    unchanged = swung(events=iv.Event(wall, direction=-1, action=lambda t, y, g, length: y))
    np.testing.assert_allclose(unchanged.y[:, -1], swung().y[:, -1], atol=1e-6)
    with pytest.raises(ValueError, match=r"must return y of shape \(3,\), or a pair"):
        swung(events=iv.Event(wall, direction=-1, action=lambda t, y, g, length: [1.0]))
    stopped = swung(breakpoints=[(0.5, lambda t, y, g, length: (y, [0, 0, 0]))])
    after = np.flatnonzero(stopped.t == 0.5)[-1]
    np.testing.assert_allclose(stopped.yp[:2, after], 0, atol=1e-12)


def test_output_dense_output_and_direction():
    times = np.linspace(0, 2, 9)
    sol, dense = swung(t_eval=times), swung(dense_output=True)
    np.testing.assert_allclose(dense.sol(times), sol.y, atol=1e-7)
    np.testing.assert_allclose(dense.sol.yp(times), sol.yp, atol=1e-6)
    assert dense.sol(0.5).shape == (3,)
    np.testing.assert_allclose(np.hypot(*dense.sol(times)[:2]), 1, atol=1e-14)
    back = iv.solve_dae(swing, (2, 0), sol.y[:, -1], sol.yp[:, -1], method="dop853", **NAMED)
    np.testing.assert_allclose(back.y[:, -1], [1, 0, 0], atol=1e-6)


def test_runs_are_extended_saved_loaded_and_pickled(tmp_path):
    half = swung(1.0, method="ode113")
    assert len(half.extend(2.0).t) > len(half.t)
    np.testing.assert_allclose(half.extend(2.0).y[:, -1], swung().y[:, -1], atol=1e-6)
    half.save(tmp_path / "half.npz")
    loaded = iv.load(tmp_path / "half.npz")
    for name in ("t", "y", "yp", "residual"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(half, name))
    assert repr(loaded.drift()) == repr(half.drift())
    dense = swung(dense_output=True)
    copy = pickle.loads(pickle.dumps(dense))
    np.testing.assert_array_equal(copy.sol(0.3), dense.sol(0.3))
    with pytest.warns(UserWarning, match="leaves out sol"):
        dense.save(tmp_path / "dense.npz")


def test_the_problem_of_a_dae_is_one_like_any_other(tmp_path):
    """In ensembles, prepared solvers and checkpoints; `solution` expresses what it returns in the unknowns."""
    dae = iv.Dae(swing, 0, [1, 0, 0], args=(GRAVITY, 1.0), order=2, names=["x", "z", "tension"])
    problem = dae.problem((0, 1))
    assert problem.labels == ["x", "z", "x'", "z'"]
    options = {"method": "dop853", "rtol": 1e-9, "atol": 1e-11}
    alone = problem.replace(args=(9.0, 1.0)).solve(**options)
    many = problem.solve_ensemble(args=[(GRAVITY, 1.0), (9.0, 1.0)], workers=1, **options)
    np.testing.assert_array_equal(many.y[1, :, -1], alone.y[:, -1])
    np.testing.assert_array_equal(problem.prepare(**options)(args=(9.0, 1.0)).y, alone.y)
    sol = dae.solution(alone)
    np.testing.assert_allclose(sol.y[2], sol.yp[0] ** 2 + sol.yp[1] ** 2 - 9.0 * sol.y[1], atol=1e-12)
    path = tmp_path / "run.npz"
    whole = dae.solve((0, 1), checkpoint=path, **options)
    np.testing.assert_array_equal(dae.solution(iv.load(path, problem)).y, whole.y)
    with pytest.raises(ValueError, match="not one of a problem of this Dae"):
        dae.solution(iv.solve_ivp(lambda t, y: -y, (0, 1), [1.0]))


def test_bounds_are_those_of_unknowns_that_are_not_formulas():
    """Unknowns renamed with a sign have bounds too; a bound of a formula is an error that names the unknown."""

    def decay(t, y, yp):
        x, minus, twice = y
        return [yp[0] + 50 * x, minus + x, twice - 2 * x - 1]

    names, no = ["x", "minus", "twice"], np.inf
    given = {"names": names, "rtol": 0.1, "atol": 0.01, "method": "ode15s"}
    assert iv.solve_dae(decay, (0, 10), [1, -1, 3], **given).y[0].min() < 0
    for limits in ({"nonnegative": "x"}, {"bounds": ([-no, -1, -no], [no, 0, no])}):
        sol = iv.solve_dae(decay, (0, 10), [1, -1, 3], **limits, **given)
        assert sol.y[0].min() >= 0 >= sol.y[1].max()
        dae = iv.Dae(decay, 0, [1, -1, 3], names=names)
        np.testing.assert_array_equal(
            dae.problem((0, 10), **limits).solve("ode15s", rtol=0.1, atol=0.01).y[0], sol.y[1]
        )
    with pytest.raises(ValueError, match=r"twice cannot have bounds: .* it as a formula .* possible for x, minus"):
        iv.solve_dae(decay, (0, 10), [1, -1, 3], nonnegative=True, **given)
    with pytest.raises(TypeError, match="nonnegative needs its expressions"):
        iv.solve_dae(opaque(decay), (0, 10), [1, -1, 3], nonnegative=True, **given)
    nonlinear = iv.solve_dae(  # an algebraic variable of methods with a singular mass matrix
        lambda t, y, yp: [yp[0] + y[1], y[1] ** 3 + y[1] - y[0]], (0, 9), [1, 0.7], method="radau", nonnegative=[1]
    )
    assert nonlinear.y[1].min() >= 0

    def together(t, y, yp):
        return [yp[0] + yp[1] + 2, y[0] - y[1]]

    sol = iv.solve_dae(together, (0, 1), [0.5, 0.5], nonnegative=[0], method="radau")  # comes to rest at t = 1/2
    assert sol.y.min() >= 0
    assert sol.y_end.max() < 1e-12


def test_sensitivities_are_those_of_the_unknowns():
    sol = swung(sensitivities=["g"])
    assert sol.sensitivity_names == ["g"]
    step = 1e-5
    more, less = (swung(args=(GRAVITY + d, 1.0), rtol=1e-12, atol=1e-14).y[:, -1] for d in (step, -step))
    np.testing.assert_allclose(sol.sensitivities[:, 0, -1], (more - less) / (2 * step), rtol=1e-6)


def test_the_start_follows_parameters_of_constraints():
    """a + b + c = 1, b = K a, (a + b)' = -k a with c = 0 fixed at the start: a(0) = 1 / (1 + K), in sensitivities,
    ensembles, prepared runs and fits."""

    def equilibrium(t, y, yp, K, k):
        a, b, c = y
        return [b - K * a, yp[0] + yp[1] + k * a, a + b + c - 1]

    def exact(t, K, k):
        return np.exp(-k * t / (1 + K)) / (1 + K)

    at, step, run = (2.0, 0.5), 1e-6, {"method": "dop853", "rtol": 1e-10, "atol": 1e-12}
    dae = iv.Dae(equilibrium, 0, [0.3, 0.7, 0], names=["a", "b", "c"], args=at)
    problem = dae.problem((0, 3), fixed=["c"])
    for method in ("dop853", "radau"):
        sol = dae.solve((0, 3), fixed=["c"], sensitivities=True, **(run | {"method": method}))
        wanted = [
            (exact(sol.t, 2 + d, 0.5 + e) - exact(sol.t, 2 - d, 0.5 - e)) / 2e-6 for d, e in ((step, 0), (0, step))
        ]
        np.testing.assert_allclose(sol.sensitivities[0], wanted, atol=1e-8)
        np.testing.assert_allclose(sol.sensitivities.sum(axis=0), 0, atol=1e-11)
    rows = [at, (1.0, 0.8)]
    for args, y in zip(rows, problem.solve_ensemble(args=rows, **run).y, strict=True):
        assert np.ravel(y[0])[-1] == pytest.approx(exact(3, *args), rel=1e-8)
    assert problem.prepare(**run)(args=rows[1]).y_end == pytest.approx(problem.replace(args=rows[1]).solve(**run).y_end)
    t = np.linspace(0.3, 3, 7)
    found = iv.fit(problem, t, exact(t, 1.0, 0.8), {"K": (0, 5), "k": (0, 5)}, observe=lambda t, y, K, k: y[0])
    np.testing.assert_allclose([*found.parameters.values()], [1.0, 0.8], rtol=1e-5)


def test_times_of_events_have_derivatives():
    """∂τ/∂g of each pass at x = 0.3 is that of differences, and so are those of the unknowns before the events."""

    def pass_(t, y, g, length):
        return y[0] - 0.3

    sol = swung(sensitivities=["g"], events=pass_, rtol=1e-10, atol=1e-12)
    step = 1e-4
    more, less = (
        swung(args=(GRAVITY + d, 1.0), events=pass_, rtol=1e-12, atol=1e-14).t_events[0] for d in (step, -step)
    )
    assert len(sol.t_events[0]) >= 2
    np.testing.assert_allclose(sol.sensitivities_t_events[0][:, 0], (more - less) / (2 * step), rtol=1e-6)
    # along the solution y(τ): dx/dg + x' dτ/dg = 0
    S, slopes = sol.sensitivities_events[0][:, 0, 0], sol.sensitivities_t_events[0][:, 0]
    speeds = np.sqrt(np.maximum(2 * GRAVITY * -sol.y_events[0][:, 1], 0)) * np.abs(sol.y_events[0][:, 1])
    np.testing.assert_allclose(np.abs(S), np.abs(speeds * slopes), rtol=1e-6)


def test_gradients_are_those_of_functions_of_the_unknowns():
    """One backward run gives what forward sensitivities give: at the end, and at several times, tensions included."""
    sol = swung(sensitivities=True, rtol=1e-10, atol=1e-12, dense_output=True, t_eval=[0.3, 0.8, 1.1])
    weights = np.arange(9.0).reshape(3, 3) - 3
    np.testing.assert_allclose(sol.gradient(weights), np.einsum("im,ikm->k", weights, sol.sensitivities), rtol=1e-6)
    np.testing.assert_allclose(
        sol.gradient(weights[0], [0.5, 0.0], t=[1.1]), weights[0] @ sol.sensitivities[:, :, 2] + [0.5, 0], rtol=1e-6
    )
    np.testing.assert_allclose(
        sol.gradient([1.0, 2.0, 3.0], wrt="g"), [[1, 2, 3] @ sol._sensitivities.end[:, 0]], rtol=1e-6
    )
    with pytest.raises(ValueError, match="takes no integrand"):
        sol.gradient(integrand=lambda t, y, g, length: y[0])


def test_parameters_of_a_dae_are_fitted():
    """`fit` of the problem of a Dae, with data of a component and times of an event."""
    t = np.linspace(0.2, 1.4, 7)
    dae = iv.Dae(swing, 0, [1, 0, 0], args=(9.0, 1.0), order=2, names=["x", "z", "tension"])
    event = iv.Event(lambda t, y, g, length: y[1] + 0.5, name="half")
    truth = swung(t_eval=t, events=lambda t, y, g, length: y[1] + 0.5, rtol=1e-10, atol=1e-12)
    problem = dae.problem((0, 1.5)).replace(events=event)
    fit = iv.fit(problem, t, {"x": truth.y[0]}, {"g": (5, 15)}, sigma=0.01, method="dop853")
    assert fit.parameters["g"] == pytest.approx(GRAVITY, rel=1e-6)
    times = iv.Experiment(problem, event_times={"half": truth.t_events[0][:1]}, event_sigma=0.01)
    fit = iv.fit([times], {"g": (5, 15)}, method="dop853")
    assert fit.parameters["g"] == pytest.approx(GRAVITY, rel=1e-6)


def test_arguments_that_decide_loops_are_constants():
    """A count is a constant of the expressions, and no parameter of the problem; numbers stay parameters."""

    def equations(t, y, yp, count, rate):
        total = sum(y[0] for _ in range(count))
        return [yp[0] + rate * total, y[1] - total]

    dae = iv.Dae(equations, 0, [1.0, 0], args=(3, 0.5))
    problem = dae.problem((0, 1))
    assert problem.args == (0.5,)
    sol = problem.replace(args=(0.25,)).solve("dop853", rtol=1e-9, atol=1e-11)
    assert dae.solution(sol).y[1, -1] == pytest.approx(3 * np.exp(-0.75), rel=1e-8)


def test_tolerances_may_be_given_for_each_unknown():
    sol = swung(atol=[1e-9, 1e-11, 1e-3])
    np.testing.assert_allclose(sol.y[:, -1], swung().y[:, -1], atol=1e-6)
    with pytest.raises(ValueError, match="one value per unknown, 3"):
        swung(atol=[1e-9, 1e-11])


def test_a_traced_function_is_taken_as_it_is():
    compiled = iv.solve_dae(iv.compile(swing), (0, 2), [1, 0, 0], method="dop853", **NAMED)
    np.testing.assert_array_equal(compiled.y, swung().y)


def test_ode15i_solves_matlabs_example():
    F = PROBLEMS["weissinger"].F
    y0, yp0 = iv.decic(F, 1, [np.sqrt(1.5)], [1], [0], [0])
    sol = iv.ode15i(F, (1, 10), y0, yp0, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(sol.y[0], np.sqrt(sol.t**2 + 0.5), rtol=1e-4)
    assert {*sol.steps.method} == {"ode15s"}


def test_stiff_amplifier_with_the_default_method():
    sol = iv.solve_dae(transistors, (0, 0.2), PROBLEMS["transistors"].y0, rtol=1e-5, atol=1e-7)
    assert PROBLEMS["transistors"].error(sol) < 1e-3
