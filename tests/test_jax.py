"""Solutions as functions for JAX have the values and derivatives of the run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import invariode as iv
from invariode._solve.bridge import Bridge

jax = pytest.importorskip("jax")
jnp = pytest.importorskip("jax.numpy")
bridge = pytest.importorskip("invariode.jax")

RTOL = 1e-8
OPTIONS = {"method": "dop853", "rtol": RTOL, "atol": RTOL / 100}


@pytest.fixture(autouse=True)
def _doubles():
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


def predators(t, y, a, rest):
    return [a * y[0] - rest[0] * y[0] * y[1], -rest[1] * y[1] + rest[2] * y[0] * y[1]]


RATES = (1.5, np.array([1.0, 3.0, 1.0]))
PROBLEM = iv.Problem(predators, (0, 10), [1.0, 1.0], args=RATES, labels=["prey", "predators"])
#: dG/dp of G = ½ |y(10) − 1|².
GRADIENT = np.array([0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395])
TIMES = np.linspace(0, 10, 5)


def cost(p, **options):
    return 0.5 * jnp.sum((bridge.solve(PROBLEM, args=(p[0], p[1:]), **OPTIONS, **options) - 1) ** 2)


@pytest.mark.parametrize("adjoint", [False, True])
def test_the_gradient_is_the_one_known(adjoint):
    """Alone, compiled, and for several parameters at once."""
    p = jnp.concatenate([jnp.array(RATES[:1]), RATES[1]])
    gradient = jax.grad(lambda p: cost(p, adjoint=adjoint))
    np.testing.assert_allclose(gradient(p), GRADIENT, atol=1000 * RTOL)
    compiled = jax.jit(jax.vmap(gradient))(jnp.stack([p, 1.1 * p]))
    np.testing.assert_allclose(compiled, [gradient(p), gradient(1.1 * p)], rtol=1e-12)


def test_values_and_derivatives_are_those_of_the_run():
    """In both modes, for y0 and an array of arguments together."""
    sol = PROBLEM.replace(sensitivities=iv.Sensitivities(args="rest", y0=True)).solve(**OPTIONS, t_eval=TIMES)

    def solved(y0, rest):
        return bridge.solve(PROBLEM, y0, (RATES[0], rest), t=TIMES, **OPTIONS)

    point = (jnp.array([1.0, 1.0]), jnp.array(RATES[1]))
    assert np.array_equal(solved(*point), PROBLEM.solve(**OPTIONS, t_eval=TIMES).y)
    for jacobian in (jax.jacfwd, jax.jacrev):
        of_y0, of_rest = jacobian(solved, (0, 1))(*point)
        np.testing.assert_allclose(of_rest, np.moveaxis(sol.sensitivities[:, :3], 1, 2), rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(of_y0, np.moveaxis(sol.sensitivities[:, 3:], 1, 2), rtol=1e-12, atol=1e-14)


def test_what_is_held_is_held_in_derivatives_too():
    total = iv.Problem(
        lambda t, y, k: [-k * y[0], k * y[0]], (0, 5), [1.0, 0.5], args=(1.0,), invariants=lambda t, y, k: y[0] + y[1]
    )
    slopes = jax.jacrev(lambda y0, k: bridge.solve(total, y0, (k,)).sum(), (0, 1))(jnp.array([1.0, 0.5]), 1.0)
    np.testing.assert_allclose(slopes[0], [1, 1], rtol=1e-14)
    np.testing.assert_allclose(slopes[1], 0, atol=1e-14)


def test_single_precision_is_that_of_the_result_alone():
    """By JAX's default, y0 and arguments are rounded, and the run is not."""
    jax.config.update("jax_enable_x64", False)
    found = bridge.solve(PROBLEM, [0.1, 0.2], (jnp.float32(1.1), RATES[1]), **OPTIONS)
    assert found.dtype == jnp.float32
    args = (float(np.float32(1.1)), RATES[1])
    exact = PROBLEM.replace(y0=np.array([0.1, 0.2], np.float32).astype(float), args=args).solve(**OPTIONS)
    assert np.array_equal(found, exact.y[:, -1].astype(np.float32))
    slope = jax.grad(lambda a: bridge.solve(PROBLEM, args=(a, RATES[1]), **OPTIONS)[0])(1.5)
    assert slope.dtype == jnp.float32


BLOW_UP = iv.Problem(lambda t, y, k: [k * y[0] ** 2], (0, 2), [1.0], args=(1.0,))


def test_runs_that_fail_raise_or_are_nan():
    times = [0.5, 1.5]
    with pytest.raises(jax.errors.JaxRuntimeError, match="Unable to meet the tolerances"):
        bridge.solve(BLOW_UP, t=times)
    for adjoint in (False, True):
        given = {"on_failure": "return", "adjoint": adjoint, "rtol": 1e-8}
        found = bridge.solve(BLOW_UP, t=times, **given)
        assert found[0, 0] == pytest.approx(2, rel=1e-6)
        assert np.isnan(found[0, 1])
        assert np.isnan(bridge.solve(BLOW_UP, **given)).all()
        assert np.isnan(jax.grad(lambda k, given=given: bridge.solve(BLOW_UP, args=(k,), t=times, **given)[0, 0])(1.0))


def test_an_end_that_depends_on_parameters_is_refused():
    end = iv.Event(lambda t, y, k: y[0] - 2, terminal=True)
    with pytest.raises(jax.errors.JaxRuntimeError, match="before the end of the output"):
        bridge.solve(BLOW_UP.replace(events=end))


def test_derivatives_that_there_are_not_are_refused():
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.hessian(lambda k: bridge.solve(BLOW_UP, args=(k,), t=[0.5])[0, 0])(1.0)
    with pytest.raises(TypeError, match="give one array"):
        bridge.solve(PROBLEM, args=(1.5, [jnp.array(1.0), 3.0, 1.0]))
    for problem, options, message in (
        (predators, {}, "needs an invariode.Problem"),
        (PROBLEM.replace(y0=[1j, 1.0]), {}, "real y0"),
        (PROBLEM, {"t_eval": [1.0]}, "t_eval is no option"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            bridge.solve(problem, **options)


POWERS = iv.Problem(lambda t, y, k, n: [-k * y[0] ** n, 1.0], (0, 1), [1.0, 0.0], args=(0.5, 2))


def test_integers_and_truth_values_may_be_traced():
    """Integers and truth values have no derivatives, and do not keep others from having theirs."""

    def solved(k, n, **options):
        return bridge.solve(POWERS, args=(k, n), rtol=RTOL, atol=RTOL, **options)[0]

    np.testing.assert_allclose(
        jax.jit(solved)(0.5, 3), POWERS.replace(args=(0.5, 3)).solve(rtol=RTOL, atol=RTOL).y[0, -1]
    )
    exact = -1.0 * (1 + 2 * 0.5) ** -1.5  # y = (1 + 2 k t)**-1/2 for n = 3
    for adjoint in (False, True):
        slope = jax.jit(jax.grad(lambda k, n, adjoint=adjoint: solved(k, n, adjoint=adjoint)))
        assert slope(0.5, 3) == pytest.approx(exact, rel=1e-6)
    branches = iv.Problem(lambda t, y, down: -y if down else y, (0, 1), [1.0], args=(True,))
    ends = [jax.jit(lambda b: bridge.solve(branches, args=(b,)))(one)[0] for one in (True, False)]
    np.testing.assert_allclose(ends, [np.exp(-1), np.exp(1)], rtol=1e-3)


def test_what_does_not_fit_is_said_by_the_call_and_not_by_its_callback():
    for y0, args, options, message in (
        (jnp.ones((3, 2)), None, {}, r"shape \(2,\), got \(3, 2\)"),
        (jnp.ones((2, 1)), None, {}, r"got \(2, 1\)"),
        ([1.0], None, {}, r"got \(1,\)"),
        (1j * jnp.ones(2), None, {}, "y0 is complex"),
        ([1j, 0], None, {}, "y0 is complex"),
        (None, (1.0,), {}, "args must have 2 entries"),
        (None, (1j * jnp.ones(()), 2), {}, "complex array"),
        (None, None, {"method": "ode46"}, "did you mean 'ode45'"),
        (None, None, {"rtoll": 1e-3}, "did you mean 'rtol'"),
    ):
        for call in (lambda f: f(), lambda f: jax.jit(f)()):
            with pytest.raises((TypeError, ValueError), match=message):
                call(lambda y0=y0, args=args, options=options: bridge.solve(POWERS, y0, args, **options))


def test_calls_without_jit_compile_once(monkeypatch):
    """A problem that is planned, and a function that JAX traces, are kept for calls with equal contents."""
    made = []
    prepare = Bridge._prepared
    monkeypatch.setattr(Bridge, "_prepared", lambda self, wanted: made.append(wanted) or prepare(self, wanted))
    factor = [1.0]
    problem = iv.Problem(lambda t, y, k: -k * factor[0] * y, (0, 1), [1.0], args=(0.5,))
    slope = jax.grad(lambda k: bridge.solve(problem, args=(k,))[0])
    for k in (0.5, 0.6, 0.7):
        slope(k)
    assert made == [(), (1,)]
    factor[0] = 2.0  # f is another function
    assert bridge.solve(problem, args=(0.5,))[0] == pytest.approx(np.exp(-1), rel=1e-3)
    assert len(made) == 3


def test_the_page_is_right():
    """The page's code for JAX runs, one block after the other."""
    page = Path(__file__).parents[1] / "docs" / "howto" / "jax_torch.md"
    namespace: dict[str, object] = {}
    blocks = re.findall(r"```\{code-block\} python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    for block in blocks:
        if "torch" not in block:
            exec(block, namespace)
    assert "invariode.jax" in "".join(blocks)
