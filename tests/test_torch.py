"""Solutions as functions for PyTorch have the values and derivatives of the run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import invariode as iv

torch = pytest.importorskip("torch")
bridge = pytest.importorskip("invariode.torch")

RTOL = 1e-8
OPTIONS = {"method": "dop853", "rtol": RTOL, "atol": RTOL / 100}


def predators(t, y, a, rest):
    return [a * y[0] - rest[0] * y[0] * y[1], -rest[1] * y[1] + rest[2] * y[0] * y[1]]


RATES = (1.5, np.array([1.0, 3.0, 1.0]))
PROBLEM = iv.Problem(predators, (0, 10), [1.0, 1.0], args=RATES, labels=["prey", "predators"])
#: dG/dp of G = ½ |y(10) − 1|².
GRADIENT = np.array([0.6219615855514, 0.0680014041508, 0.1691764639959, 0.27256069395])
TIMES = np.linspace(0, 10, 5)


def moving(value, dtype=torch.float64):
    return torch.tensor(value, dtype=dtype, requires_grad=True)


@pytest.mark.parametrize("adjoint", [False, True])
def test_the_gradient_is_the_one_known(adjoint):
    p = moving(RATES[0]), moving(RATES[1])
    cost = 0.5 * ((bridge.solve(PROBLEM, args=p, adjoint=adjoint, **OPTIONS) - 1) ** 2).sum()
    cost.backward()
    np.testing.assert_allclose([p[0].grad, *p[1].grad], GRADIENT, atol=1000 * RTOL)


@pytest.mark.parametrize("adjoint", [False, True])
def test_values_and_derivatives_are_those_of_the_run(adjoint):
    """For y0 and one of the arguments together."""
    sol = PROBLEM.replace(sensitivities=iv.Sensitivities(args="rest", y0=True)).solve(**OPTIONS, t_eval=TIMES)
    y0, rest, w = moving([1.0, 1.0]), moving(RATES[1]), np.random.default_rng(29).normal(size=sol.y.shape)
    found = bridge.solve(PROBLEM, y0, (RATES[0], rest), t=TIMES, adjoint=adjoint, **OPTIONS)
    np.testing.assert_allclose(found.detach(), sol.y, rtol=100 * RTOL)
    (found * torch.from_numpy(w)).sum().backward()
    exact = np.einsum("it,ikt->k", w, sol.sensitivities)
    size = np.abs(sol.sensitivities).sum()
    np.testing.assert_allclose([*rest.grad, *y0.grad], exact, atol=20 * RTOL * size if adjoint else 1e-12 * size)


def test_single_precision_is_that_of_tensors_alone():
    """Each gradient has the type of its tensor; the run is in double precision."""
    a, rest = moving(1.1, torch.float32), torch.tensor(RATES[1], dtype=torch.float32)
    found = bridge.solve(PROBLEM, args=(a.detach(), rest), **OPTIONS)
    assert found.dtype == torch.float32
    exact = PROBLEM.replace(args=(float(a.detach()), RATES[1])).solve(**OPTIONS).y[:, -1]
    assert np.array_equal(found, exact.astype(np.float32))
    mixed = bridge.solve(PROBLEM, args=(a, moving(RATES[1])), **OPTIONS)
    assert mixed.dtype == torch.float64
    mixed.sum().backward()
    assert a.grad.dtype == torch.float32


BLOW_UP = iv.Problem(lambda t, y, k: [k * y[0] ** 2], (0, 2), [1.0], args=(1.0,))


@pytest.mark.parametrize("adjoint", [False, True])
def test_runs_that_fail_raise_or_are_nan(adjoint):
    times, k = [0.5, 1.5], moving(1.0)
    with pytest.raises(iv.SolveError, match="Unable to meet the tolerances"):
        bridge.solve(BLOW_UP, args=(k,), t=times, adjoint=adjoint)
    found = bridge.solve(BLOW_UP, args=(k,), t=times, adjoint=adjoint, on_failure="return", rtol=1e-8)
    assert float(found[0, 0].detach()) == pytest.approx(2, rel=1e-6)
    assert np.isnan(float(found[0, 1].detach()))
    found[0, 0].backward()
    assert np.isnan(float(k.grad))


def test_an_end_that_depends_on_parameters_is_refused():
    end = iv.Event(lambda t, y, k: y[0] - 2, terminal=True)
    with pytest.raises(iv.SolveError, match="before the end of the output"):
        bridge.solve(BLOW_UP.replace(events=end))


def test_second_derivatives_are_refused():
    """Second derivatives are not zero."""
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        torch.autograd.functional.hessian(lambda k: bridge.solve(BLOW_UP, args=(k,), t=[0.5]).sum(), moving(1.0))


def test_tensors_within_lists_have_gradients_or_are_refused():
    """Never are they without one in silence."""
    decay = iv.Problem(lambda t, y, k: [-k[0] * y[0]], (0, 1), [1.0], args=([0.5],))
    with pytest.raises(TypeError, match=r"args\[0\] is a list that contains tensors"):
        bridge.solve(decay, None, ([moving(0.5)],))
    with pytest.raises(TypeError, match=r"args\[0\] is a tuple that contains tensors"):
        bridge.solve(decay, None, ((1.0, [moving(0.5)]),))
    y0 = moving(1.0)
    bridge.solve(decay, [y0], **OPTIONS).sum().backward()
    assert y0.grad == pytest.approx(np.exp(-0.5), rel=1e-6)


def test_what_does_not_fit_is_said_before_the_run():
    for y0, args, options, message in (
        (torch.ones(3, 2), None, {}, r"shape \(2,\), got \(3, 2\)"),
        (torch.ones(2, 1), None, {}, r"got \(2, 1\)"),
        ([1.0], None, {}, r"got \(1,\)"),
        (1j * torch.ones(2), None, {}, "y0 is complex"),
        (None, (1.0,), {}, "args must have 2 entries"),
        (None, (torch.tensor(1j, requires_grad=True), RATES[1]), {}, "complex and requires a gradient"),
        (None, None, {"method": "ode46"}, "did you mean 'ode45'"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            bridge.solve(PROBLEM, y0, args, **options)


def test_the_page_is_right():
    """The page's code for PyTorch runs, one block after the other."""
    page = Path(__file__).parents[1] / "docs" / "howto" / "jax_torch.md"
    namespace: dict[str, object] = {}
    blocks = re.findall(r"```\{code-block\} python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    for block in blocks:
        if "jax" not in block:
            exec(block, namespace)
    assert "invariode.torch" in "".join(blocks)
