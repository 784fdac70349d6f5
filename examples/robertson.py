"""Robertson's kinetics
====================

Three species over eleven decades of time, stiff: three ways to tell ode15s about the problem. The sum of the
concentrations is linear and is kept without projection; it may also replace an equation, with a singular mass matrix.

Source: H. H. Robertson, The solution of a set of reaction rate equations, in J. Walsh (ed.), Numerical Analysis: An
Introduction, Academic Press, 1966, 178-182.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv


def rates(t, y):
    a, b, c = y
    return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, 3e7 * b * b]


def jacobian(t, y):
    _, b, c = y
    return [[-0.04, 1e4 * c, 1e4 * b], [0.04, -1e4 * c - 6e7 * b, -1e4 * b], [0, 6e7 * b, 0]]


def with_algebraic_sum(t, y):
    return [*rates(t, y)[:2], y.sum() - 1]


def main():
    options = {"rtol": 1e-6, "atol": [1e-10, 1e-14, 1e-10]}
    runs = {
        "differences": iv.ode15s(rates, (0, 4e11), [1, 0, 0], **options),
        "Jacobian": iv.ode15s(rates, (0, 4e11), [1, 0, 0], jac=jacobian, **options),
        "algebraic sum": iv.ode15s(with_algebraic_sum, (0, 4e11), [1, 0, 0], mass=np.diag([1, 1, 0]), **options),
    }
    for label, sol in runs.items():
        drift = np.abs(sol.y.sum(axis=0) - 1).max()
        print(f"{label:>13}: sum off by {drift:.1e}, {sol.stats.steps} steps, {sol.nfev} f, {sol.njev} Jacobians")

    figure, axes = plt.subplots(layout="constrained")
    sol = runs["Jacobian"]
    axes.semilogx(sol.t[1:], (sol.y[:, 1:].T * [1, 1e4, 1]), label=["A", "10⁴ B", "C"])
    axes.set(xlabel="t", ylabel="concentration", title="Robertson's problem, ode15s")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
