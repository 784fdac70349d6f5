"""Initial values that are functions of the arguments."""

from __future__ import annotations

import numpy as np

import invariode as iv


def decay(t, y, k, a):
    return [-k * y[0], a - y[1]]


def start(k, a):
    return [a + k**2, 3.0]


def exact(k, a, t=1.5):
    return np.array([(a + k**2) * np.exp(-k * t), a + (3 - a) * np.exp(-t)])


def slopes(of, at):
    return np.array([np.imag(of(*(np.array(at) + 1e-30j * one))) / 1e-30 for one in np.eye(len(at))]).T


def test_the_start_follows_the_arguments():
    """In replace, prepared runs and ensembles; in sensitivities, also to initial values, and gradients; in fits."""
    at = (0.7, 1.3)
    problem = iv.Problem(decay, (0, 1.5), start, args=at)
    run = {"method": "dop853", "rtol": 1e-10, "atol": 1e-12}
    other = (0.4, 2.0)
    np.testing.assert_allclose(problem.solve(**run).y_end, exact(*at), rtol=1e-9)
    np.testing.assert_allclose(problem.replace(args=other).solve(**run).y_end, exact(*other), rtol=1e-9)
    solver = problem.prepare(**run)
    np.testing.assert_array_equal(solver(args=other).y_end, problem.replace(args=other).solve(**run).y_end)
    many = problem.solve_ensemble(args=[at, other], **run)
    np.testing.assert_allclose(many.y[:, :, -1] if many.y.ndim == 3 else many.y, [exact(*at), exact(*other)], rtol=1e-9)
    for names in (["k", "a"], ["a", "y0[0]"]):
        varied = problem.replace(sensitivities=names)
        wanted = slopes(exact, at)[:, 0 if names[0] == "k" else 1 :]
        found = varied.solve(**run).sensitivities[:, :, -1]
        np.testing.assert_allclose(found[:, : wanted.shape[1]], wanted, rtol=1e-8)
        again = varied.replace(args=other).solve(**run).sensitivities[:, 0, -1]
        np.testing.assert_allclose(again, slopes(exact, other)[:, 0 if names[0] == "k" else 1], rtol=1e-8)
    fixed = problem.replace(sensitivities=["a"]).replace(y0=[1.0, 3.0])  # another start, which a does not change
    np.testing.assert_allclose(fixed.solve(**run).sensitivities[0, 0, -1], 0, atol=1e-12)
    gradient = problem.solve(dense_output=True, **run).gradient([1.0, 0.0])
    np.testing.assert_allclose(gradient, slopes(exact, at)[0], rtol=1e-6)
    t = np.linspace(0.25, 1.5, 6)
    data = np.array([exact(*other, one) for one in t]).T
    fit = iv.fit(problem, t, data, {"k": (0, 5), "a": (0, 5)}, sigma=0.01)
    np.testing.assert_allclose([fit.parameters["k"], fit.parameters["a"]], other, rtol=1e-5)
